"""The Cramer-Rao bound of a target's pose: what no unbiased method can beat for given contrast, noise and blur.

It comes from the same Fisher information as the fit, evaluated at the truth: all pixels near the edges, white noise, with
the light levels of each ring, blur and edge offsets unknown. A closed form for one edge, as a check: a pixel of edge
length locates a straight edge of blur s to sqrt(2 sqrt(pi) s) / C px across it, with C = contrast / noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.camera.model import Camera
from dishmap.errors import InputError
from dishmap.targets.adjust import Batch, Priors, by_target, on_pose_and_offset, prior_terms
from dishmap.targets.edges import Poses
from dishmap.targets.light import light_columns
from dishmap.targets.neighbours import Ink, clear_of_neighbours
from dishmap.targets.pattern import Pattern, TargetKind
from dishmap.targets.pixels import ALIKE, RingSums, State, coverage_columns, rings_of, without_light
from dishmap.targets.solve import inverse_scaled, products
from dishmap.targets.stages import FIRST_LOG_BLUR_SIGMA, GROUP_SIZE, Assumptions, Group, layout, printed_ink
from dishmap.targets.start import centers_of, nominal_poses
from dishmap.transforms import Pose

Array = NDArray[Any]

# Wide enough to say nothing of the normal.
FREE_NORMAL_SIGMA_RAD = np.pi
# The pixel's own area adds to the blur of the optics: 1/12 px^2 per axis.
PIXEL_VARIANCE_PX2 = 1 / 12


@dataclass(frozen=True)
class Bound:
    """Least errors of T targets.

    covariance_px2 (T, 2, 2) of the projected centre; covariance_mm2 (T, 3, 3) of the position in the camera frame; depth_mm (T,)
    along the camera's z and normal_rad (T,), root mean square angle, are standard deviations.
    """

    covariance_px2: Array
    covariance_mm2: Array
    depth_mm: Array
    normal_rad: Array


def edge_sigma_px(blur_px: float, contrast_to_noise: float) -> float:
    """Bound on the place of a straight edge from one pixel of its length, px: sqrt(2 sqrt(pi) s) / C."""
    return float(np.sqrt(2 * np.sqrt(np.pi) * blur_px) / contrast_to_noise)


def target_bound(
    camera: Camera,
    kind: TargetKind,
    poses: Poses,
    contrast_to_noise: float,
    psf_sigma_px: float,
    curvature_per_mm: ArrayLike | None = None,
    normal_sigma_rad: float = FREE_NORMAL_SIGMA_RAD,
    assumptions: Assumptions | None = None,
) -> Bound:
    """Bound for targets of one kind at `poses` (camera_from_target).

    contrast_to_noise: ground minus ink over the noise of a pixel. normal_sigma_rad: prior on normals, none by default;
    curvature_per_mm (T, 2, 2) of the surface, flat by default. Raises InputError for impossible numbers.
    """
    if not (contrast_to_noise > 0 and psf_sigma_px > 0 and normal_sigma_rad > 0):
        raise InputError("a bound needs a positive contrast-to-noise ratio, blur and normal sigma")
    curvature = np.zeros((len(poses), 2, 2)) if curvature_per_mm is None else np.asarray(curvature_per_mm, dtype=float)
    group = _group(camera, kind, poses, curvature, psf_sigma_px, normal_sigma_rad, assumptions or Assumptions())
    information = group_information(group, contrast_to_noise)
    precision, _ = prior_terms(poses, group.state, group.batch.priors)
    covariance = inverse_scaled(information + precision[:, :, None] * np.eye(precision.shape[1]))[:, :6, :6]
    _, by_pose = centers_of(camera, poses, curvature)
    position = poses.steps @ covariance[:, :3, :3] @ np.swapaxes(poses.steps, 1, 2)
    return Bound(
        by_pose @ covariance @ np.swapaxes(by_pose, 1, 2),
        position,
        np.sqrt(position[:, 2, 2]),
        np.sqrt(covariance[:, 3, 3] + covariance[:, 4, 4]),
    )


def pattern_information(
    camera: Camera,
    pattern: Pattern,
    index: NDArray[np.int64],
    camera_from_dish: Pose,
    contrast_to_noise: float,
    psf_sigma_px: float,
    assumptions: Assumptions | None = None,
) -> Array:
    """Fisher information (N, 7, 7) on (move along camera axes in mm, turn about target axes in rad, edge offset in mm) of targets.

    The targets number `index` (N,) lie where the undeformed pattern puts them; light, blur, tone and blooming are unknown.
    """
    out = np.zeros((len(index), 7, 7))
    groups = pattern_groups(camera, pattern, index, camera_from_dish, psf_sigma_px, assumptions or Assumptions())
    ink = printed_ink(camera, pattern, groups, camera_from_dish)
    for group in groups:
        precision, _ = prior_terms(group.poses, group.state, group.batch.priors)
        full = group_information(group, contrast_to_noise, ink)
        out[np.searchsorted(index, group.index)], _ = on_pose_and_offset(full, precision, group.poses.steps)
    return out


def pattern_groups(
    camera: Camera, pattern: Pattern, index: NDArray[np.int64], camera_from_dish: Pose, psf_sigma_px: float, assumptions: Assumptions
) -> list[Group]:
    """Targets number `index` (rising) where the undeformed pattern puts them, in groups of one kind and similar distance."""
    groups: list[Group] = []
    names = np.array(pattern.kind_names)[index]
    for name in np.unique(names):
        mine = index[names == name]
        poses = nominal_poses(pattern, mine, camera_from_dish)
        order = np.argsort(np.linalg.norm(poses.position_mm, axis=1), kind="stable")
        for part in np.array_split(order, -(-len(order) // GROUP_SIZE)):
            curvature = pattern.curvature_per_mm[mine[part]]
            kind = pattern.kinds[str(name)]
            group = _group(camera, kind, poses.take(part), curvature, psf_sigma_px, FREE_NORMAL_SIGMA_RAD, assumptions)
            groups.append(replace(group, index=mine[part]))
    return groups


def pattern_bound(camera: Camera, pattern: Pattern, poses: Poses, contrast_to_noise: float, psf_sigma_px: float) -> Bound:
    """`target_bound` for every target of a pattern, in its order, at `poses` (N)."""
    parts: list[tuple[NDArray[np.int64], Bound]] = []
    for name, kind in pattern.kinds.items():
        index = np.flatnonzero([k == name for k in pattern.kind_names])
        if len(index):
            bound = target_bound(camera, kind, poses.take(index), contrast_to_noise, psf_sigma_px, pattern.curvature_per_mm[index])
            parts.append((index, bound))
    order = np.argsort(np.concatenate([index for index, _ in parts]))
    columns = (np.concatenate([getattr(b, f) for _, b in parts])[order] for f in Bound.__dataclass_fields__)
    return Bound(*columns)


def _group(
    camera: Camera, kind: TargetKind, poses: Poses, curvature: Array, psf_sigma_px: float, normal_sigma_rad: float, assumptions: Assumptions
) -> Group:
    """Targets of one kind at `poses`, with the priors of a fit and the blur of the optics."""
    count = len(poses)
    blur = float(np.hypot(psf_sigma_px, PIXEL_VARIANCE_PX2**0.5))
    priors = Priors(
        poses.rotation[..., 2],
        np.full(count, normal_sigma_rad),
        assumptions.ink_spread_fraction * float(kind.radius_mm.max()),
        assumptions.tone_shift_px,
        blur,
        FIRST_LOG_BLUR_SIGMA,
        0.0,
        1.0,
        kind.turns_freely,
    )
    state = State(np.zeros(count), np.zeros(count), np.full(count, blur), np.zeros(count))
    return Group(kind, np.arange(count), poses, Batch(camera, curvature, rings_of(kind), priors), state)


def group_information(group: Group, contrast_to_noise: float, ink: Ink | None = None) -> Array:
    """Fisher information (T, G, G) of the geometry of a group's targets, light levels eliminated, priors not counted.

    ink: of the whole picture, beside which pixels are left out as the fit leaves them out; none by default.
    """
    camera, blur = group.batch.camera, group.state.blur_px
    blank = np.zeros((camera.height_px, camera.width_px), np.uint8)
    batch, pixels = layout(blank, group, float(blur[0]), float(blur[0]))
    if ink is not None:
        pixels = clear_of_neighbours(pixels, group.index, ink, blur)
    maps = batch.maps(group.poses, pixels.patches)
    rows = slice(0, len(pixels.ring))
    cover, geometry, _ = coverage_columns(rows, pixels, batch.rings, maps, group.state)
    every = np.concatenate([-geometry, light_columns(pixels.s, pixels.t, cover)], axis=1) * pixels.used[:, None]
    normal = products(every, ALIKE)
    empty = np.zeros(len(normal))
    sums = RingSums(normal, np.zeros(normal.shape[:2]), empty, empty, empty, empty)
    return by_target(without_light(sums)[0], pixels.target, len(group.poses)) * contrast_to_noise**2
