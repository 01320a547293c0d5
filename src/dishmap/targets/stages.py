"""The stages of measuring targets: start from ellipses, coarse fit, what all targets share, full fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.camera.model import Camera
from dishmap.targets.adjust import (
    Adjusted,
    Batch,
    Priors,
    adjust,
    by_target,
    with_other_priors,
    with_rest,
)
from dishmap.targets.detect import Detections
from dishmap.targets.edges import Poses, local_maps
from dishmap.targets.identify import Identity
from dishmap.targets.neighbours import Ink, clear_of_neighbours, ink_of
from dishmap.targets.pattern import Pattern, TargetKind
from dishmap.targets.pixels import TONE, RingPixels, State, Weighting, rings_of
from dishmap.targets.scene_noise import (
    LEAST_NORMAL_SIGMA_RAD,
    ROBUST_TO_SIGMA,
    STRAY_SIGMAS,
    NoiseModel,
    free_tilt,
    noise_model,
    normal_spread,
)
from dishmap.targets.solve import inverse_each, inverse_scaled
from dishmap.targets.start import EllipsePoints, centers_of, ellipse_points, fit_ellipses, nominal_poses, pair_circles, rigid_pose
from dishmap.targets.window import minor_radius_px, outline, patches_around, ring_areas, ring_layout, ring_pixels
from dishmap.transforms import Pose, angle_between_rad

Array = NDArray[Any]
Index = NDArray[np.int64]
Bool = NDArray[Any]

# First guesses, wide enough for any sharp photograph.
FIRST_BLUR_PX, FIRST_LOG_BLUR_SIGMA = 0.9, 1.0
FIRST_BAND_BLUR_PX = 1.5
# Tone curves from gamma 0.4 to 2.7 lie within two of these.
FIRST_LOG_GAMMA_SIGMA = 0.5
LEAST_LOG_GAMMA_SIGMA = 1e-3
FIRST_NORMAL_SIGMA_RAD = np.radians(12.0)
COARSE_PIXELS = 1200
FIRST_STEPS, COARSE_STEPS, FULL_STEPS = 3, 8, 8
COARSE_ENOUGH = 0.9
# Targets in one group: bounds memory, and keeps the windows of a group about equally large.
GROUP_SIZE = 96
# Residuals beyond this many sigma and this share of the contrast are not noise but glare, dirt or something in front.
CUT_SIGMAS, CUT_CONTRAST = 8.0, 0.1
# A ring of which less than this share of an edge survives is left out, when the target has others.
LEAST_KEPT = 0.7
LEAST_CONTRAST_SHARE = 0.5
# Share of an edge below which something is in front of it, and how far from the lost pixels its border reaches, in blurs.
OCCLUDED_BELOW, OBSTACLE_BLURS = 0.97, 2.0
# A ring's cut may exceed the picture's usual one, relative to contrast, by this factor, and its blur the usual blur.
WIDEST_CUT, WIDEST_BLUR = 1.5, 1.3


@dataclass(frozen=True)
class Assumptions:
    """What is assumed of print and camera; each is a sigma of a prior that the image can override.

    ink_spread_fraction: how far printed edges may lie outwards, as a share of the kind's largest radius.
    tone_shift_px: how far the camera's tone curve may shift a dark-light edge. normal_sigma_deg: how far targets' normals may
    stray from the pattern's surface; None learns it from the photograph.
    """

    ink_spread_fraction: float = 0.02
    tone_shift_px: float = 0.3
    normal_sigma_deg: float | None = None


@dataclass(frozen=True)
class Group:
    """Targets of one kind and similar size in the image that are adjusted together.

    glare (T,): whose light was found to bend more than the model allows; ambiguous (T,): whose pixels fit a mirrored normal as well;
    None before that was looked at.
    """

    kind: TargetKind
    index: Index
    poses: Poses
    batch: Batch
    state: State
    glare: Bool | None = None
    ambiguous: Bool | None = None

    def outlines(self) -> Array:
        """Projected outlines of all circles (T, C, Q, 2) at the group's poses."""
        return outline(self.batch.camera, self.poses, self.batch.curvature_per_mm, self.kind.center_mm, self.kind.radius_mm)


@dataclass(frozen=True)
class Coarse:
    """A group after the coarse fit, with what it says per ring: cut (M,) of residuals, kept (M, C)."""

    group: Group
    adjusted: Adjusted
    pixels: RingPixels
    cut: Array


@dataclass(frozen=True)
class Shared:
    """What all targets of the photograph share.

    camera_from_dish: rigid pose of the pattern; noise; normal_sigma_rad: spread of normals about the pattern's surface;
    log_gamma of the tone curve and its sigma; cut_share: usual cut of a ring's residuals over its contrast.
    """

    camera_from_dish: Pose
    noise: NoiseModel
    normal_sigma_rad: float
    log_gamma: float
    log_gamma_sigma: float
    cut_share: float


# A group after the full fit, with its pixels.
Fit = tuple[Group, Adjusted, RingPixels]


def start_groups(
    camera: Camera, pattern: Pattern, detections: Detections, identity: Identity, assumptions: Assumptions
) -> tuple[list[Group], list[tuple[int, str]]]:
    """First poses of all named targets, in groups; and (id, reason) of those that reach beyond the image."""
    groups: list[Group] = []
    rejected: list[tuple[int, str]] = []
    owner = pattern.marks.target[identity.mark]
    for name, kind in pattern.kinds.items():
        index = np.array([i for i in np.unique(owner) if pattern.kind_names[i] == name], dtype=np.int64)
        if not len(index):
            continue
        poses = nominal_poses(pattern, index, identity.camera_from_dish)
        order = np.argsort(np.linalg.norm(poses.position_mm, axis=1), kind="stable")
        for part in np.array_split(order, -(-len(order) // GROUP_SIZE)):
            group = _first_group(camera, pattern, kind, index[part], poses.take(part), assumptions)
            expected = wholly_inside(group)
            group = _on_ellipses(group, pattern, detections, identity)
            inside = wholly_inside(group)
            for i, there in zip(group.index[~inside], expected[~inside], strict=True):
                rejected.append(
                    (int(pattern.ids[i]), "too little of it was seen to find its place" if there else "it reaches beyond the image")
                )
            if inside.any():
                groups.append(regroup(group, inside))
    return groups, rejected


def tracked_groups(
    camera: Camera, pattern: Pattern, index: Index, poses: Poses, blur_px: Array, assumptions: Assumptions
) -> tuple[list[Group], list[tuple[int, str]]]:
    """Targets number `index` (T,) at poses and with blurs (T,) known beforehand, in groups; (id, reason) of those beyond the image."""
    groups: list[Group] = []
    rejected: list[tuple[int, str]] = []
    names = np.array(pattern.kind_names)[index]
    for name in np.unique(names):
        rows = np.flatnonzero(names == name)
        order = rows[np.argsort(np.linalg.norm(poses.position_mm[rows], axis=1), kind="stable")]
        for part in np.array_split(order, -(-len(order) // GROUP_SIZE)):
            group = _first_group(camera, pattern, pattern.kinds[str(name)], index[part], poses.take(part), assumptions)
            group = replace(group, state=replace(group.state, blur_px=blur_px[part]))
            inside = wholly_inside(group)
            rejected += [(int(pattern.ids[i]), "it reaches beyond the image") for i in group.index[~inside]]
            if inside.any():
                groups.append(regroup(group, inside))
    return groups, rejected


def printed_ink(camera: Camera, pattern: Pattern, groups: list[Group], camera_from_dish: Pose) -> Ink:
    """Where the ink of all targets is: of the groups' at their poses, of the others on the undeformed pattern."""
    parts = [(group.kind, group.index, group.poses) for group in groups]
    rest = np.setdiff1d(np.arange(len(pattern)), [i for group in groups for i in group.index])
    for name, kind in pattern.kinds.items():
        index = np.array([i for i in rest if pattern.kind_names[i] == name], dtype=np.int64)
        if len(index):
            parts.append((kind, index, nominal_poses(pattern, index, camera_from_dish)))
    return ink_of(camera, pattern, parts)


def wholly_inside(group: Group) -> Bool:
    """Where (T,) all of a target lies inside the image."""
    return np.asarray(group.batch.camera.contains(group.outlines(), margin_px=1.0).all(axis=(1, 2)))


def regroup(group: Group, keep: Bool) -> Group:
    """The targets `keep` of a group."""
    priors = group.batch.priors
    priors = replace(priors, normal=priors.normal[keep], normal_sigma_rad=priors.normal_sigma_rad[keep])
    batch = replace(group.batch, priors=priors, curvature_per_mm=group.batch.curvature_per_mm[keep])
    return Group(group.kind, group.index[keep], group.poses.take(keep), batch, group.state.take(keep))


def _first_group(camera: Camera, pattern: Pattern, kind: TargetKind, index: Index, poses: Poses, assumptions: Assumptions) -> Group:
    count = len(index)
    priors = Priors(
        normal=poses.rotation[..., 2],
        normal_sigma_rad=np.full(count, FIRST_NORMAL_SIGMA_RAD),
        offset_mm_sigma=assumptions.ink_spread_fraction * float(kind.radius_mm.max()),
        offset_px_sigma=assumptions.tone_shift_px,
        blur_px=FIRST_BLUR_PX,
        log_blur_sigma=FIRST_LOG_BLUR_SIGMA,
        log_gamma=0.0,
        log_gamma_sigma=FIRST_LOG_GAMMA_SIGMA,
        turns_freely=kind.turns_freely,
    )
    batch = Batch(camera, pattern.curvature_per_mm[index], rings_of(kind), priors)
    zero = np.zeros(count)
    return Group(kind, index, poses, batch, State(zero, zero, np.full(count, FIRST_BLUR_PX), zero))


def _on_ellipses(group: Group, pattern: Pattern, detections: Detections, identity: Identity) -> Group:
    marks = pattern.marks
    place = np.full(len(pattern), -1)
    place[group.index] = np.arange(len(group.index))
    mine = place[marks.target[identity.mark]] >= 0
    mark, detection = identity.mark[mine], identity.detection[mine]
    rows = np.array(pair_circles(group.kind, marks.circle[mark], detection, detections.parent, detections.semi_axes_px))
    ellipse = rows[:, 2]
    points = ellipse_points(detections.center_px[ellipse], detections.semi_axes_px[ellipse], detections.angle_rad[ellipse])
    target = place[marks.target[mark]][rows[:, 0]]
    # the nominal pose can be many pixels off on a bent surface: bring each target over its ellipses first
    poses = _shifted(group, points, target, rows[:, 1])
    whole = np.zeros((1, 2)), np.array([group.kind.extent_mm])
    patches = patches_around(group.batch.camera, poses, group.batch.curvature_per_mm, whole, FIRST_BAND_BLUR_PX)
    return replace(group, poses=fit_ellipses(group.batch, group.kind, poses, patches, EllipsePoints(points, target, rows[:, 1])))


def _shifted(group: Group, points: Array, target: Index, circle: Index) -> Poses:
    """Poses moved sideways so that the projected circles' middles lie on the ellipses' middles, on average."""
    outlines = group.outlines().mean(axis=2)
    gap = points.mean(axis=1) - outlines[target, circle]
    count = np.maximum(np.bincount(target, minlength=len(group.poses)), 1)[:, None]
    shift = by_target(gap, target, len(group.poses)) / count
    camera = group.batch.camera
    center, _ = centers_of(camera, group.poses, group.batch.curvature_per_mm)
    distance = np.linalg.norm(group.poses.position_mm, axis=1, keepdims=True)
    position = camera.unproject(center + np.nan_to_num(shift)) * distance
    return Poses(group.poses.rotation, np.where(np.isfinite(position), position, group.poses.position_mm))


def layout(image: NDArray[Any], group: Group, blur_px: float, band_blur_px: float) -> tuple[Batch, RingPixels]:
    """Rings and pixels of a group for a given blur, in a band wide enough for `band_blur_px`."""
    outlines = group.outlines()
    rings, members, fine = ring_layout(group.kind, outlines, minor_radius_px(outlines) / group.kind.radius_mm, blur_px)
    batch = replace(group.batch, rings=rings)
    areas = ring_areas(group.kind, members)
    patches = patches_around(batch.camera, group.poses, batch.curvature_per_mm, areas, band_blur_px)
    ends = outline(batch.camera, group.poses, batch.curvature_per_mm, *areas).reshape(len(patches.target), -1, 2)
    half = np.nan_to_num(np.abs(ends - patches.anchor_px[:, None]).max(axis=(1, 2)), nan=1.0)
    maps = local_maps(batch.camera, group.poses, batch.curvature_per_mm, patches, still=True)
    return batch, ring_pixels(image, rings, maps, patches, half, band_blur_px, fine)


def coarse_fit(image: NDArray[Any], group: Group, ink: Ink) -> Coarse:
    """Fit every fourth pixel of a wide band, first all of them, then without outliers."""
    batch, pixels = _coarse_layout(image, group, ink, FIRST_BLUR_PX, FIRST_BAND_BLUR_PX)
    first = adjust(batch, pixels, group.poses, group.state, Weighting(1.0, 0.0, None), FIRST_STEPS)
    blur = float(np.median(first.state.blur_px))
    if blur > FIRST_BAND_BLUR_PX and np.isfinite(first.poses.position_mm).all():
        # what a blurred ring sees of its neighbours, or a model too simple for it, would pass for a tone curve
        batch, pixels = _coarse_layout(image, replace(group, poses=first.poses, state=first.state), ink, blur, blur)
        first = adjust(batch, pixels, first.poses, first.state, Weighting(1.0, 0.0, None), FIRST_STEPS)
    cut = residual_cut(first, pixels)
    second = adjust(batch, pixels, first.poses, first.state, Weighting(1.0, 0.0, cut), COARSE_STEPS, COARSE_ENOUGH)
    return Coarse(replace(group, poses=second.poses, state=second.state, batch=batch), second, pixels, residual_cut(second, pixels))


def _coarse_layout(image: NDArray[Any], group: Group, ink: Ink, blur_px: float, band_blur_px: float) -> tuple[Batch, RingPixels]:
    batch, pixels = layout(image, group, blur_px, band_blur_px)
    # one pixel of each block of 2x2, and fewer blocks of large rings
    pixels = pixels.every(4 * max(1, pixels.s.shape[1] // COARSE_PIXELS))
    return batch, clear_of_neighbours(pixels, group.index, ink, np.full(len(group.index), blur_px))


def residual_cut(adjusted: Adjusted, pixels: RingPixels) -> Array:
    """Residual (M,) in grey levels beyond which a pixel of a ring is an outlier."""
    absolute = np.where(pixels.used, np.abs(adjusted.residual), np.nan)
    with np.errstate(all="ignore"):
        sigma = ROBUST_TO_SIGMA * np.nan_to_num(_nan_median(absolute), nan=1.0)
    return np.maximum(np.maximum(CUT_SIGMAS * sigma, CUT_CONTRAST * np.abs(ring_contrast(adjusted))), 1.0)


def _nan_median(values: Array) -> Array:
    """Median of each row without NaN; NaN sorts last."""
    ordered = np.sort(values, axis=1)
    middle = np.maximum(np.isfinite(values).sum(axis=1) - 1, 0) // 2
    return ordered[np.arange(len(values)), middle]


def learn(camera: Camera, pattern: Pattern, start: Pose, coarse: list[Coarse], assumptions: Assumptions) -> Shared:
    """Rigid pose of the pattern, noise of the photograph, and how far normals stray, from all coarse fits."""
    index = np.concatenate([c.group.index for c in coarse])
    centers = np.concatenate([centers_of(camera, c.group.poses, c.group.batch.curvature_per_mm)[0] for c in coarse])
    good = np.isfinite(centers).all(axis=1)
    pose = rigid_pose(pattern, index[good], camera, centers[good], start) if good.sum() >= 4 else start
    noise = noise_model([c.pixels.grey for c in coarse], [c.adjusted.residual for c in coarse], [c.pixels.used for c in coarse])
    shares = np.concatenate([c.cut / np.maximum(ring_contrast(c.adjusted), 1.0) for c in coarse])
    rest = (*shared_tone(coarse), float(np.median(shares)))
    if assumptions.normal_sigma_deg is not None:
        return Shared(pose, noise, max(np.radians(assumptions.normal_sigma_deg), LEAST_NORMAL_SIGMA_RAD), *rest)
    fits = [(c.adjusted, c.group.batch.priors, pose.rotate(pattern.normal[c.group.index])) for c in coarse]
    return Shared(pose, noise, spread_of_normals(fits, 1.0), *rest)


def spread_of_normals(fits: list[tuple[Adjusted, Priors, Array]], inflation: float) -> float:
    """`normal_spread` over all targets of some fits, each with its priors and the expected normals (T, 3)."""
    tilt, covariance = zip(*(free_tilt(adjusted, priors, expected) for adjusted, priors, expected in fits), strict=True)
    settled = np.concatenate([adjusted.converged for adjusted, _, _ in fits])
    return normal_spread(np.concatenate(tilt)[settled], inflation * np.concatenate(covariance)[settled], FIRST_NORMAL_SIGMA_RAD)


def shared_tone(coarse: list[Coarse]) -> tuple[float, float]:
    """Log gamma of the photograph and its sigma, from all targets: one camera has one tone curve."""
    value = np.concatenate([c.adjusted.state.log_gamma for c in coarse])
    variance = np.concatenate([inverse_scaled(c.adjusted.information)[:, TONE, TONE] for c in coarse])
    good = np.isfinite(variance) & (variance > 0) & np.concatenate([c.adjusted.converged for c in coarse])
    if good.sum() < 4:
        return 0.0, FIRST_LOG_GAMMA_SIGMA
    # take each target's prior out again, then pool; the median keeps a few strange targets from deciding
    data = np.maximum(1 / variance[good] - FIRST_LOG_GAMMA_SIGMA**-2, 1e-9)
    free = value[good] / np.maximum(variance[good] * data, 1e-9)
    near = np.abs(free - np.median(free)) < STRAY_SIGMAS / np.sqrt(data) + 1e-3
    # and put the prior in once, for all
    total = data[near].sum() + FIRST_LOG_GAMMA_SIGMA**-2
    return float((data[near] * free[near]).sum() / total), max(float(total**-0.5), LEAST_LOG_GAMMA_SIGMA)


def full_fit(image: NDArray[Any], pattern: Pattern, coarse: Coarse, shared: Shared, ink: Ink) -> Fit:
    """Fit all pixels of the band, with the photograph's noise and the surface's normals."""
    group = coarse.group
    expected = shared.camera_from_dish.rotate(pattern.normal[group.index])
    blur = float(np.median(group.state.blur_px))
    priors = replace(group.batch.priors, normal=expected, normal_sigma_rad=_prior_sigma(coarse, expected, shared), blur_px=blur)
    priors = replace(priors, log_gamma=shared.log_gamma, log_gamma_sigma=shared.log_gamma_sigma)
    poses, state = with_other_priors(coarse.adjusted, group.batch.priors, priors)
    group = replace(group, poses=poses, state=state, batch=replace(group.batch, priors=priors))
    # something in front of a target widens its blur: no target may seem much less sharp than the others
    blurs = np.minimum(group.state.blur_px, WIDEST_BLUR * blur)
    widest = float(np.quantile(blurs, 0.9))
    batch, pixels = layout(image, group, widest, widest)
    pixels = clear_of_neighbours(pixels, group.index, ink, np.maximum(blurs, blur))
    cut, pixels = _without_bad_rings(coarse, pixels, shared)
    weighting = Weighting(shared.noise.base, shared.noise.slope, cut)
    adjusted = adjust(batch, pixels, group.poses, group.state, weighting, FULL_STEPS)
    strays = angle_between_rad(adjusted.poses.rotation[..., 2], expected) > STRAY_SIGMAS * shared.normal_sigma_rad
    if (strays & (priors.normal_sigma_rad < FIRST_NORMAL_SIGMA_RAD)).any():
        sigma = np.where(strays, FIRST_NORMAL_SIGMA_RAD, priors.normal_sigma_rad)
        batch = replace(batch, priors=replace(priors, normal_sigma_rad=sigma))
        adjusted = adjust(batch, pixels, adjusted.poses, adjusted.state, weighting, FULL_STEPS)
    adjusted, pixels = _clear_of_obstacles(batch, pixels, adjusted, weighting)
    return replace(group, batch=batch, poses=adjusted.poses, state=adjusted.state), adjusted, pixels


def _prior_sigma(coarse: Coarse, expected: Array, shared: Shared) -> Array:
    """Prior sigma (T,) on normals: that of the surface, but wide for targets whose pixels plainly say otherwise.

    Twice STRAY_SIGMAS, because a target seen face on shows the size of its tilt through noise alone at about twice the sigma
    that its normal equations give.
    """
    tilt, covariance = free_tilt(coarse.adjusted, coarse.group.batch.priors, expected)
    width = covariance + shared.normal_sigma_rad**2 * np.eye(2)
    far = np.einsum("ti,tij,tj->t", tilt, inverse_each(width), tilt) > (2 * STRAY_SIGMAS) ** 2
    return np.where(far & coarse.adjusted.converged, FIRST_NORMAL_SIGMA_RAD, shared.normal_sigma_rad)


def _clear_of_obstacles(batch: Batch, pixels: RingPixels, fit: Adjusted, weighting: Weighting) -> tuple[Adjusted, RingPixels]:
    """Fit targets that lost part of an edge once more, without the pixels beside the lost ones.

    At the border of whatever is in front, pixels are a mixture that passes for noise but pulls on the edge.
    """
    assert weighting.cut is not None
    lost = (np.abs(fit.residual) > weighting.cut[:, None]) & pixels.used
    rows = np.flatnonzero((fit.sums.kept.min(axis=1) < OCCLUDED_BELOW) & lost.any(axis=1))
    if not len(rows):
        return fit, pixels
    blocked = np.zeros_like(pixels.used) if pixels.blocked is None else pixels.blocked.copy()
    for row in rows:
        place = np.stack([pixels.s[row], pixels.t[row]], axis=1) * pixels.patches.scale_px[row]
        far, _ = cKDTree(place[lost[row]]).query(place)
        blocked[row] |= far < OBSTACLE_BLURS * fit.state.blur_px[pixels.target[row]] + 1.0
    pixels = replace(pixels, blocked=blocked)
    again = np.zeros(len(fit.poses), bool)
    again[pixels.target[rows]] = True
    return with_rest(batch, pixels, replace(fit, converged=fit.converged & ~again), weighting, FULL_STEPS), pixels


def _without_bad_rings(coarse: Coarse, pixels: RingPixels, shared: Shared) -> tuple[Array, RingPixels]:
    """Cuts (M,) for the pixels' rings, and the pixels without rings of which little can be seen."""
    count, target = len(coarse.group.poses), coarse.pixels.target
    contrast = ring_contrast(coarse.adjusted)
    usual = by_target(contrast[:, None], target, count)[:, 0] / np.maximum(np.bincount(target, minlength=count), 1)
    # something in front of a ring widens its own residuals: no ring may differ much more than the picture's rings do
    cut = np.minimum(coarse.cut, np.maximum(WIDEST_CUT * shared.cut_share * usual[target], CUT_SIGMAS * np.sqrt(shared.noise.base)))
    if len(pixels.ring) != len(target):
        return by_target(cut[:, None], target, count)[pixels.target, 0] / np.bincount(target, minlength=count)[pixels.target], pixels
    bad = (coarse.adjusted.sums.kept.min(axis=1) < LEAST_KEPT) | (contrast < LEAST_CONTRAST_SHARE * usual[target])
    good = np.bincount(target, weights=~bad, minlength=count)
    drop = bad & (good[target] > 0)
    return cut, replace(pixels, used=pixels.used & ~drop[:, None])


def ring_contrast(adjusted: Adjusted) -> Array:
    """Ground minus ink level (M,) of each ring, grey levels."""
    return np.asarray(adjusted.sums.light[:, 0] - adjusted.sums.light[:, 3])
