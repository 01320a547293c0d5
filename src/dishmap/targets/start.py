"""First poses of targets: from the pattern's rigid pose, then from the ellipses that were detected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.targets.adjust import Batch, by_target, prior_terms
from dishmap.targets.edges import MOTION_TERMS, Patches, Poses, edge_distance, monomials, project_printed
from dishmap.targets.pattern import Pattern, TargetKind
from dishmap.targets.pixels import GEOMETRY, OFFSET_PX, State
from dishmap.targets.solve import solve_scaled
from dishmap.transforms import Pose, cross_matrix, rotation_from_vector

Array = NDArray[Any]
Index = NDArray[np.int64]

ELLIPSE_POINTS = 12
# What a detected ellipse is good for, shared over its points: its errors are common to all of them.
ELLIPSE_SIGMA_PX = 0.25 * ELLIPSE_POINTS**0.5
ELLIPSE_CUT_PX = 2.5
ELLIPSE_STEPS = 4
# Turns about a target's own normal: one circle of a group does not show them, so each step is held to about this.
SPIN, SPIN_STEP_RAD = 5, 0.1
RIGID_STEPS = 10


@dataclass(frozen=True)
class EllipsePoints:
    """Points on detected ellipses of T targets: pixels (E, Q, 2), and for each ellipse its target and circle (E,)."""

    pixels: Array
    target: Index
    circle: Index


def nominal_poses(pattern: Pattern, index: Index, camera_from_dish: Pose) -> Poses:
    """Poses of targets number `index` on the undeformed pattern."""
    return Poses(camera_from_dish.rotation @ pattern.axes[index], camera_from_dish.apply(pattern.center_mm[index]))


def ellipse_points(center_px: Array, semi_axes_px: Array, angle_rad: Array) -> Array:
    """Points (E, Q, 2) on ellipses: centres (E, 2), semi-axes (E, 2), direction of the first axis (E,)."""
    phase = 2 * np.pi * np.arange(ELLIPSE_POINTS) / ELLIPSE_POINTS
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    first, second = np.stack([cos, sin], axis=-1), np.stack([-sin, cos], axis=-1)
    return (
        center_px[:, None]
        + (semi_axes_px[:, :1] * np.cos(phase))[..., None] * first[:, None]
        + (semi_axes_px[:, 1:] * np.sin(phase))[..., None] * second[:, None]
    )


def pair_circles(kind: TargetKind, outer_circle: Index, detection: Index, parent: Index, semi_axes_px: Array) -> list[tuple[int, int, int]]:
    """Which detected ellipse is which circle: rows of (match, circle, detection), outermost and nested ones.

    outer_circle, detection (K,): matched outermost circles and their ellipses; parent (M,): the detections' nesting.
    """
    size = np.sqrt(semi_axes_px.prod(axis=1)).tolist()
    children: dict[int, list[int]] = {}
    for inner in np.flatnonzero(parent >= 0).tolist():
        children.setdefault(int(parent[inner]), []).append(inner)
    nested = {int(c): np.flatnonzero((kind.outermost == c) & (kind.parent >= 0)).tolist() for c in np.flatnonzero(kind.parent < 0)}
    radius = kind.radius_mm.tolist()
    rows = []
    for match, (circle, ellipse) in enumerate(zip(outer_circle.tolist(), detection.tolist(), strict=True)):
        rows.append((match, circle, ellipse))
        for inner in [c for e in children.get(ellipse, []) for c in (e, *children.get(e, []))]:
            ratio = size[inner] / size[ellipse]
            nearest = min(nested[circle], key=lambda n: abs(radius[n] / radius[circle] - ratio), default=None)
            if nearest is not None and abs(radius[nearest] / radius[circle] - ratio) < 0.15 * ratio:
                rows.append((match, nearest, inner))
    return rows


def fit_ellipses(batch: Batch, kind: TargetKind, poses: Poses, patches: Patches, points: EllipsePoints) -> Poses:
    """Improve poses so that detected ellipses lie on the projected circles (Gauss-Newton, a few steps).

    `patches` holds one patch around each whole target.
    """
    count = len(poses)
    sign = np.where(kind.dark[points.circle], 1.0, -1.0)[:, None]
    st = (points.pixels - patches.anchor_px[points.target][:, None]) / patches.scale_px[points.target][:, None, None]
    state = State(np.zeros(count), np.zeros(count), np.full(count, batch.priors.blur_px), np.zeros(count))
    center, radius = kind.center_mm[points.circle], kind.radius_mm[points.circle]
    for _ in range(ELLIPSE_STEPS):
        maps = batch.maps(poses, patches)
        basis = monomials(st[..., 0], st[..., 1], maps.degree)
        distance, nu, nv, *_ = edge_distance(maps.plane[points.target] @ basis, center, radius)
        motion = maps.motion[points.target] @ basis[:, None, :MOTION_TERMS]
        columns = np.zeros((len(distance), GEOMETRY, distance.shape[1]))
        columns[:, :6] = nu[:, None] * motion[:, 0] + nv[:, None] * motion[:, 1]
        columns[:, OFFSET_PX] = sign
        weight = np.maximum(1 - (distance / ELLIPSE_CUT_PX) ** 2, 0.05) / ELLIPSE_SIGMA_PX**2
        weighted = columns * weight[:, None]
        normal = by_target(weighted @ np.swapaxes(columns, 1, 2), points.target, count)
        right = -by_target((weighted @ distance[..., None])[..., 0], points.target, count)
        precision, pull = prior_terms(poses, state, batch.priors)
        normal[:, range(GEOMETRY), range(GEOMETRY)] += precision
        normal[:, SPIN, SPIN] += 1 / SPIN_STEP_RAD**2
        delta = solve_scaled(normal, right + pull)
        turn = np.linalg.norm(delta[:, 3:6], axis=1, keepdims=True)
        delta[:, 3:6] *= np.minimum(1, 0.3 / np.maximum(turn, 1e-12))
        position = poses.position_mm + np.einsum("tij,tj->ti", poses.steps, delta[:, :3])
        poses = Poses(poses.rotation @ rotation_from_vector(delta[:, 3:6]), position)
    return poses


def rigid_pose(pattern: Pattern, index: Index, camera: Camera, center_px: Array, start: Pose) -> Pose:
    """Pose of the undeformed pattern that fits target centres (N, 2) best, with weights against the badly bent ones."""
    pose = start
    for _ in range(RIGID_STEPS):
        local = pattern.center_mm[index] @ pose.rotation.T
        predicted, by_point, _ = camera.project_with_jacobians(local + pose.translation_mm)
        residual = center_px - predicted
        size = np.linalg.norm(residual, axis=1)
        scale = max(float(np.median(size)), 1e-3)
        weight = 1 / np.maximum(size / (2 * scale), 1.0)
        columns = np.concatenate([by_point, by_point @ -cross_matrix(local)], axis=2)
        normal = np.einsum("n,nki,nkj->ij", weight, columns, columns)
        delta = solve_scaled(normal[None], np.einsum("n,nki,nk->i", weight, columns, residual)[None])[0]
        pose = Pose(rotation_from_vector(delta[3:]) @ pose.rotation, pose.translation_mm + delta[:3])
        if np.abs(delta).max() < 1e-7:
            break
    return pose


def centers_of(camera: Camera, poses: Poses, curvature_per_mm: Array) -> tuple[Array, Array]:
    """Projected target centres (T, 2) and their derivative by the six pose parameters (T, 2, 6)."""
    pixels, motion = project_printed(camera, poses, curvature_per_mm, np.zeros((1, 2)))
    return pixels[:, 0], motion[:, 0]
