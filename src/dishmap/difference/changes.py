"""What two measured photographs say of how each target moved: from two sets of poses to one Gaussian likelihood per target.

The reference pose of a target is unknown too, and so is the spread of its ink; both are the same in both photographs, so they are
eliminated target by target. What is then left of an error that both photographs share (a target printed a little off, a normal that
neither photograph shows, ink that ran) cancels in the change.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.difference.response import pose_response
from dishmap.errors import MeasurementError
from dishmap.targets.pattern import Pattern
from dishmap.targets.pose import TARGET_COLUMNS, TargetPoses, select_targets
from dishmap.transforms import Pose, cross_matrix, rotation_from_vector

Array = NDArray[Any]
Index = NDArray[np.int64]

# A rigid motion has six parameters and a target gives three; three targets leave something to check.
LEAST_TARGETS = 3
ALIGN_STEPS = 30
# Weights of the first alignment fall beyond this many median distances.
ALIGN_CUT = 4.0
# Added to information so that matrices of what nothing shows (the turn of a lone ring, the depth of a lone crossing) stay regular: a sigma
# of 10^6 mm or rad, and no less than rounding allows beside what the pixels show best.
LEAST_PRIOR, LEAST_SHARE = 1e-12, 1e-10
# A direction counts as seen when its information, in units of those of the six, exceeds this.
LEAST_SEEN = 1e-7


@dataclass(frozen=True)
class TargetChanges:
    """Changes of N targets seen in both states, in coordinates where a rigid motion `moved` has been taken out.

    index: place in the pattern; ids; rotation (N, 3, 3): camera_from_target in the reference, moved. The log-likelihood of a true
    change x = (move along camera axes in mm, turn about target axes in rad) is score . x - x . information x / 2 with
    information (N, 6, 6) and score (N, 6). by_strain (N, 6, 3): change that a strain xx, yy, xy of the print looks like; by_focal
    (N, 6): the same for a focal length that grew, per unit; by_calibration (N, 6, P): what is left of the calibration's error in a
    difference. moved: camera_from_camera rigid motion, reference to current; position_mm (N, 3): the reference's, moved, where the
    likelihood of targets of which only their places are seen is linear; du_dv_px (N, 2): motion of the centre in the image;
    covariance_du_dv_px2 (N, 2, 2); quality (N,): bits of either photograph.
    """

    index: Index
    ids: Index
    rotation: Array
    information: Array
    score: Array
    by_strain: Array
    by_focal: Array
    by_calibration: Array
    moved: Pose
    position_mm: Array
    du_dv_px: Array
    covariance_du_dv_px2: Array
    quality: Index

    def __len__(self) -> int:
        return len(self.ids)

    @cached_property
    def directions(self) -> Index:
        """How many of a target's six directions the photographs show (N,): all of a group of rings, 2 of a crossing of lines."""
        scale = np.sqrt(np.diagonal(self.information, axis1=1, axis2=2))
        even = self.information / np.maximum(scale[:, :, None] * scale[:, None, :], LEAST_PRIOR)
        return np.asarray((np.linalg.eigvalsh(even) > LEAST_SEEN).sum(axis=1))


def combine_frames(frames: list[TargetPoses]) -> TargetPoses:
    """One measurement from several photographs of the same state by the same fixed camera.

    Likelihoods multiply; the priors on normals and ink count once. Targets that only some frames show are kept. Covariances of a grid's
    targets become those of frames without common errors, which is what differences ask for: printing errors cancel in them. Raises
    MeasurementError for an empty list.
    """
    if not frames:
        raise MeasurementError("no photograph was given to average")
    out = frames[0]
    for other in frames[1:]:
        out = _merged(out, other)
    return out


def _merged(a: TargetPoses, b: TargetPoses) -> TargetPoses:
    _, in_a, in_b = np.intersect1d(a.index, b.index, return_indices=True)
    only = np.setdiff1d(np.arange(len(b)), in_b)
    shift = _between(select_targets(a, in_a), select_targets(b, in_b))
    pull_b = b.pull[in_b] + np.einsum("nij,nj->ni", b.information[in_b], shift)
    information = a.information.copy()
    information[in_a] += b.information[in_b]
    step, moved_covariance = _balanced(select_targets(a, in_a), information[in_a], pull_b)
    # a target of a grid is held by all others, not by priors of its own: its pixels pull on wherever it is put
    free = _is_free(a)[in_a]
    step[free], moved_covariance[free] = _between_both(a.covariance[in_a[free]], b.covariance[in_b[free]], shift[free])
    pull = a.pull.copy()
    pull[in_a] += pull_b - np.einsum("nij,nj->ni", information[in_a], step)
    position, rotation, offset = a.position_mm.copy(), a.rotation.copy(), a.offset_mm.copy()
    position[in_a] += step[:, :3]
    rotation[in_a] = rotation[in_a] @ rotation_from_vector(step[:, 3:6])
    offset[in_a] += step[:, 6]
    covariance = a.covariance.copy()
    covariance[in_a] = moved_covariance
    quality = a.quality.copy()
    quality[in_a] |= b.quality[in_b]
    inside = {
        "position_mm": position,
        "rotation": rotation,
        "normal": rotation[..., 2],
        "offset_mm": offset,
        "information": information,
        "pull": pull,
        "covariance": covariance,
        "sigma_normal_rad": np.sqrt(covariance[:, 3, 3] + covariance[:, 4, 4]),
        "quality": quality,
        **_averaged_centers(a, b, in_a, in_b),
    }
    columns: dict[str, Any] = {
        name: np.concatenate([inside.get(name, getattr(a, name)), getattr(b, name)[only]]) for name in TARGET_COLUMNS
    }
    order = np.argsort(columns["index"])
    return replace(a, **{name: values[order] for name, values in columns.items()})


def _balanced(a: TargetPoses, information: Array, pull: Array) -> tuple[Array, Array]:
    """Steps (N, 7) from estimates at the balance of pixels and priors, and covariances (N, 6, 6), once further pixels pull (N, 7).

    information (N, 7, 7): of all pixels. The priors of `a` stay in force, so that its own pixels and they go on cancelling.
    """
    posterior = information + _held(a.prior, information)
    return np.linalg.solve(posterior, pull[..., None])[..., 0], np.linalg.inv(posterior)[:, :6, :6]


def _between_both(one: Array, other: Array, shift: Array) -> tuple[Array, Array]:
    """Steps (N, 7) from one estimate towards another, a shift (N, 7) away, by their covariances (N, 6, 6), and the mean's covariance."""
    gain = one @ np.linalg.inv(one + other)
    step = 0.5 * shift
    step[:, :6] = (gain @ shift[:, :6, None])[..., 0]
    covariance = one - gain @ one
    return step, 0.5 * (covariance + np.swapaxes(covariance, 1, 2))


def _averaged_centers(a: TargetPoses, b: TargetPoses, in_a: Index, in_b: Index) -> dict[str, Array]:
    center, covariance = a.center_px.copy(), a.covariance_px2.copy()
    first, second = np.linalg.inv(a.covariance_px2[in_a]), np.linalg.inv(b.covariance_px2[in_b])
    both = np.linalg.inv(first + second)
    covariance[in_a] = both
    center[in_a] = np.einsum("nij,nj->ni", both @ first, a.center_px[in_a]) + np.einsum("nij,nj->ni", both @ second, b.center_px[in_b])
    return {"center_px": center, "covariance_px2": covariance}


def _between(a: TargetPoses, b: TargetPoses) -> Array:
    """From poses a to poses b (N, 7): move along camera axes, turn about target axes, edge offset."""
    turn = small_turn(np.swapaxes(a.rotation, 1, 2) @ b.rotation)
    return np.concatenate([b.position_mm - a.position_mm, turn, (b.offset_mm - a.offset_mm)[:, None]], axis=1)


def small_turn(rotation: Array) -> Array:
    """Rotation vectors (N, 3) of rotations (N, 3, 3) under half a turn."""
    skew = 0.5 * np.stack(
        [rotation[:, 2, 1] - rotation[:, 1, 2], rotation[:, 0, 2] - rotation[:, 2, 0], rotation[:, 1, 0] - rotation[:, 0, 1]], axis=-1
    )
    sine = np.linalg.norm(skew, axis=1, keepdims=True)
    angle = np.arctan2(sine, 0.5 * (np.trace(rotation, axis1=1, axis2=2)[:, None] - 1))
    return skew * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)


def rigid_alignment(reference_mm: Array, current_mm: Array, covariance_mm2: Array) -> Pose:
    """The rigid motion that takes points (N, 3) nearly onto others, robust to some that moved on their own.

    covariance_mm2 (N, 3, 3) of the differences. Gauss-Newton with weights that fall with the distance; the start is Kabsch's.
    Raises MeasurementError for fewer than LEAST_TARGETS points.
    """
    if len(reference_mm) < LEAST_TARGETS:
        raise MeasurementError(
            f"only {len(reference_mm)} targets were measured in both photographs; a difference needs at least {LEAST_TARGETS}"
        )
    information = np.linalg.inv(covariance_mm2)
    pose = kabsch(reference_mm, current_mm)
    for _ in range(ALIGN_STEPS):
        at = pose.apply(reference_mm)
        gap, middle = current_mm - at, at.mean(axis=0)
        distance = np.sqrt(np.einsum("ni,nij,nj->n", gap, information, gap))
        cut = ALIGN_CUT * max(float(np.median(distance)), 1e-9)
        weight = np.clip(1 - (distance / cut) ** 2, 0, None) ** 2
        columns = rigid_columns(at - middle)
        weighted = np.swapaxes(columns, 1, 2) @ (information * weight[:, None, None])
        step = np.linalg.solve((weighted @ columns).sum(axis=0), (weighted @ gap[..., None]).sum(axis=0)[:, 0])
        turn = rotation_from_vector(step[3:])
        pose = Pose(turn, middle + step[:3] - turn @ middle) @ pose
        if np.linalg.norm(step[:3]) < 1e-9 and np.linalg.norm(step[3:]) < 1e-12:
            break
    # products of rotations drift from orthonormal by rounding
    left, _, right = np.linalg.svd(pose.rotation)
    return Pose(left @ right, pose.translation_mm)


def rigid_columns(points: Array) -> Array:
    """Displacement (N, 3, 6) of points (N, 3) under small moves (mm) and turns (rad) about the origin."""
    return np.concatenate([np.broadcast_to(np.eye(3), (len(points), 3, 3)), -cross_matrix(points)], axis=2)


def kabsch(a: Array, b: Array) -> Pose:
    """Least-squares rigid motion from points a to points b (Kabsch 1976)."""
    middle_a, middle_b = a.mean(axis=0), b.mean(axis=0)
    u, _, vt = np.linalg.svd((a - middle_a).T @ (b - middle_b))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation = vt.T @ sign @ u.T
    return Pose(rotation, middle_b - rotation @ middle_a)


def target_changes(reference: TargetPoses, current: TargetPoses, camera: Camera, pattern: Pattern) -> TargetChanges:
    """How every target that both states show moved. Raises MeasurementError when they have fewer than LEAST_TARGETS in common."""
    _, in_reference, in_current = np.intersect1d(reference.index, current.index, return_indices=True)
    before, after = select_targets(reference, in_reference), select_targets(current, in_current)
    covariance = before.covariance[:, :3, :3] + after.covariance[:, :3, :3]
    moved = rigid_alignment(before.position_mm, after.position_mm, covariance)
    aligned = replace(before, position_mm=moved.apply(before.position_mm), rotation=moved.rotation @ before.rotation)
    turned = np.zeros((7, 7))
    turned[:3, :3], turned[3:, 3:] = moved.rotation, np.eye(4)
    after = _seen_from(aligned, after, camera)
    information, score = _eliminated(before, after, _between(aligned, after), _carried(before, aligned, turned))
    camera_before, _ = pose_response(camera, pattern, before.index, reference.camera_from_dish)
    camera_after, strain = pose_response(camera, pattern, before.index, moved @ reference.camera_from_dish)
    focal = -camera_after[..., :2] @ camera.parameters[:2]
    return TargetChanges(
        index=before.index,
        ids=before.ids,
        rotation=aligned.rotation,
        information=information,
        score=score,
        by_strain=strain,
        by_focal=focal,
        by_calibration=camera_after - turned[:6, :6] @ camera_before,
        moved=moved,
        position_mm=aligned.position_mm,
        du_dv_px=after.center_px - before.center_px,
        covariance_du_dv_px2=before.covariance_px2 + after.covariance_px2,
        quality=before.quality | after.quality,
    )


def _carried(before: TargetPoses, aligned: TargetPoses, turned: Array) -> Array:
    """How an error of each reference pose (N, 7, 7) shows after the motion `turned` (7, 7): as that has it, but for targets of a grid.

    These know their depth from all others, and their errors of depth are common: with each free on its own, the smallest turn of a line of
    sight would make an error of depth look like a move across it. They are taken along from line of sight to line of sight.
    """
    out = np.tile(turned, (len(before), 1, 1))
    free = _is_free(before)
    here, there = (
        p / np.linalg.norm(p, axis=1, keepdims=True) for p in (before.position_mm[free] @ turned[:3, :3].T, aligned.position_mm[free])
    )
    axis, cosine = np.cross(here, there), (here * there).sum(axis=1)[:, None, None]
    cross = cross_matrix(axis)
    # the least rotation from one direction to another
    out[free, :3, :3] = (np.eye(3) + cross + cross @ cross / (1 + cosine)) @ turned[:3, :3]
    return out


def shows_place_only(information: Array) -> NDArray[np.bool_]:
    """Where (N,) pixels say nothing of turns and ink (N, 7, 7): the crossings of lines."""
    return np.asarray(~information[:, 3:, 3:].any(axis=(1, 2)))


def move_of_pixels(by_point: Array) -> Array:
    """The least move (N, 3, 2), in mm, that shifts the images of points by one pixel; by_point (N, 2, 3): d pixels / d point."""
    return np.asarray(np.swapaxes(by_point, 1, 2) @ np.linalg.inv(by_point @ np.swapaxes(by_point, 1, 2)))


def _seen_from(aligned: TargetPoses, after: TargetPoses, camera: Camera) -> TargetPoses:
    """The current state with the likelihood of crossings taken at the reference's places, moved, instead of at its own.

    A crossing's own depth comes from all others, and where the surface has stretched it is off by more than a linear likelihood bears.
    """
    rows = np.flatnonzero(shows_place_only(after.information))
    if not len(rows):
        return after
    seen, by_point = camera.project_with_point_jacobian(after.position_mm[rows])
    back = move_of_pixels(by_point)
    weight = np.swapaxes(back, 1, 2) @ after.information[rows, :3, :3] @ back
    pulled = np.einsum("nji,nj->ni", back, after.pull[rows, :3])
    measured = seen + np.linalg.solve(weight, pulled[..., None])[..., 0]
    there, by_point = camera.project_with_point_jacobian(aligned.position_mm[rows])
    turned = np.swapaxes(by_point, 1, 2) @ weight
    information, pull = after.information.copy(), after.pull.copy()
    information[rows, :3, :3] = turned @ by_point
    pull[rows, :3] = (turned @ (measured - there)[..., None])[..., 0]
    position, rotation = after.position_mm.copy(), after.rotation.copy()
    position[rows], rotation[rows] = aligned.position_mm[rows], aligned.rotation[rows]
    return replace(after, information=information, pull=pull, position_mm=position, rotation=rotation)


def changed_information(before: Array, after: Array, prior: Array) -> Array:
    """Information (N, 6, 6) on the change from those of two photographs (N, 7, 7) and the priors (N, 7) of the reference."""
    a = before + _held(prior, before)
    change = after - after @ np.linalg.inv(a + after) @ after
    return np.asarray(0.5 * (change + np.swapaxes(change, 1, 2)))[:, :6, :6]


def _eliminated(before: TargetPoses, after: TargetPoses, between: Array, carried: Array) -> tuple[Array, Array]:
    """Information (N, 6, 6) and score (N, 6) of the change, the reference's own pose and the ink's spread eliminated.

    carried (N, 7, 7): how errors of the reference show after its rigid motion. With e the error of the reference estimate (pose and edge
    offset) and y = x - between that of the change, the photographs say
    q e - e A e / 2 - (e + y) B (e + y) / 2 + p (e + y), A and B their informations (A with its priors), q and p their pulls: q is 0 where
    the reference is at its balance. Over the best e this is -y (B - B M B) y / 2 + (p - B M (p + q)) y, M = (A + B)^-1.
    """
    a = carried @ (before.information + _held(before.prior, before.information)) @ np.swapaxes(carried, 1, 2)
    b = after.information
    b_m = b @ np.linalg.inv(a + b)
    information = b - b_m @ b
    own = (carried @ _unbalanced(before)[..., None])[..., 0]
    score = after.pull - np.einsum("nij,nj->ni", b_m, after.pull + own)
    # edge offsets do not change between the photographs, so the last part of y is known
    offset = -between[:, 6]
    change = information[:, :6, :6]
    score = score[:, :6] - information[:, :6, 6] * offset[:, None]
    change = 0.5 * (change + np.swapaxes(change, 1, 2))
    return change, score + np.einsum("nij,nj->ni", change, between[:, :6])


def _unbalanced(poses: TargetPoses) -> Array:
    """What still pulls (N, 7) at the estimates.

    Nothing where a target's own priors hold it against its pixels; the pixels where its estimate came from all targets together (a grid's).
    """
    return np.where(_is_free(poses)[:, None], poses.pull, 0.0)


def _is_free(poses: TargetPoses) -> NDArray[np.bool_]:
    """Targets (N,) without priors of their own: a grid's."""
    return np.asarray(~(poses.prior > 0).any(axis=1))


def _held(prior: Array, information: Array) -> Array:
    """Precision (N, 7, 7) of the priors (N, 7), and as much as keeps the sum with `information` (N, 7, 7) regular."""
    least = LEAST_PRIOR + LEAST_SHARE * np.diagonal(information, axis1=1, axis2=2).max(axis=1)
    return np.eye(7) * (prior + least[:, None])[:, :, None]
