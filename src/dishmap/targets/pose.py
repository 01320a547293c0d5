"""Pose of every named target from the raw pixels, with covariance (method `pose`).

The chain: nominal pose -> detected ellipses -> coarse fit to every fourth pixel of a wide band -> what the whole picture
says of blur, noise and of how far normals stray from the pattern's surface -> full fit to all pixels of the band.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from dishmap.camera.model import Camera
from dishmap.errors import CameraError, ImageError, MeasurementError
from dishmap.quality import Quality, is_rejected, names
from dishmap.targets.adjust import POSE_AND_OFFSET, Adjusted, Priors, by_target, on_pose_and_offset, prior_terms
from dishmap.targets.detect import Detections
from dishmap.targets.identify import Identity
from dishmap.targets.neighbours import Ink
from dishmap.targets.pattern import Pattern
from dishmap.targets.pixels import GEOMETRY, OFFSET_MM, OFFSET_PX, RingPixels
from dishmap.targets.scene_noise import NoiseModel, inflation_of
from dishmap.targets.sensitivity import calibration_jacobian
from dishmap.targets.settle import with_clear_light, with_learnt_normals, with_likelier_normals
from dishmap.targets.solve import inverse_scaled
from dishmap.targets.stages import (
    OCCLUDED_BELOW,
    Assumptions,
    Coarse,
    Fit,
    Group,
    Shared,
    coarse_fit,
    full_fit,
    learn,
    printed_ink,
    regroup,
    start_groups,
    wholly_inside,
)
from dishmap.targets.start import centers_of
from dishmap.targets.window import minor_radius_px
from dishmap.transforms import Pose

Array = NDArray[Any]
Index = NDArray[np.int64]

SMALLEST_RADIUS_PX = 2.0
# Sums of squares of larger grey levels leave the range of single precision.
LARGEST_GREY = 1e15
# Share of an edge that must be left for a target to be measured.
HIDDEN_BELOW = 0.5
# Residual variance over the photograph's noise at which the model is said not to fit.
POOR_FIT_RATIO = 2.5
# The least contrast in sigmas, and as a part of the ground's light.
LEAST_CONTRAST_SIGMAS, LEAST_CONTRAST_PART = 4.0, 0.01
# Pixels over which misfit is coherent (2 sqrt(pi) blurs squared, for a sharp image), and the allowance for a hidden edge.
COHERENT_PIXELS, OBSTACLE_ALLOWANCE = 9.0, 30.0
# Share of a ring's pixels at the end of the scale from which glare is said.
MOST_SATURATED = 0.02
# Depth leans on the assumed edge offset when knowing the offset would shrink its sigma by more than this.
WEAK_DEPTH_RATIO = 2.0


@dataclass(frozen=True)
class SheetSummary:
    """What the joint estimate of a grid learnt of its sheet (`grid_sheet`), and how well places fit it.

    print_mm: printing error of a target's place, per axis; strain: of single lattice cells; smooth_strain: of each smooth strain over the
    sheet; rough_mm: third derivatives along the normal, mm per lattice step cubed; side_mm: printed side of squares by the pattern file,
    spread_mm: how far their edges lie outside it, sigma_spread_mm, all three 0 for crossings. Root mean squares over clean targets, of
    distances in the photograph: fit_rms_px between measured places and the smooth surface, of which noise_rms_px is expected from the
    photograph's noise and print_rms_px from printing errors; rigid_rms_px between them and the undeformed pattern in its rigid pose.
    """

    print_mm: float
    strain: float
    smooth_strain: float
    rough_mm: float
    side_mm: float
    spread_mm: float
    sigma_spread_mm: float
    fit_rms_px: float
    noise_rms_px: float
    print_rms_px: float
    rigid_rms_px: float

    @property
    def measured_side_mm(self) -> float:
        """The side of squares as the photograph has it, in lengths of the pattern's pitch; 0 for crossings."""
        return self.side_mm + 2 * self.spread_mm


@dataclass(frozen=True)
class TargetPoses:
    """Measured targets (N,), in the camera frame.

    index: place in the pattern; ids; position_mm, normal (N, 3), normal towards the camera; rotation (N, 3, 3)
    camera_from_target; covariance (N, 6, 6) of (move along camera axes in mm, turn about target axes in rad) from this
    photograph's noise; information (N, 7, 7) and pull (N, 7): what the pixels alone say of a change of (move, turn, edge
    offset in mm), as the Gaussian log-likelihood pull . x - x . information x / 2, without the priors on normal and
    edge offset that `covariance` holds; prior (N, 7): the precision of those priors; center_px (N, 2) and covariance_px2
    (N, 2, 2) of the projected target centre; sigma_normal_rad (N,) root mean square angle; calibration_jacobian (N, 3, P)
    d position / d camera parameters; blur_px (N,) total blur, offset_mm (N,) edge offset, contrast, noise (N,) grey levels;
    kept (N,) smallest share of a circle's edge that was used; quality (N,) bits of `Quality`.
    camera_from_dish: rigid pose of the undeformed pattern; normal_sigma_rad: spread of normals about the pattern's surface,
    used as a prior; noise_model: of the photograph; rejected: (id, reason) of named targets that could not be measured; sheet: what
    was learnt of a grid, None for targets made of circles.
    """

    index: Index
    ids: Index
    position_mm: Array
    normal: Array
    rotation: Array
    covariance: Array
    information: Array
    pull: Array
    prior: Array
    center_px: Array
    covariance_px2: Array
    sigma_normal_rad: Array
    calibration_jacobian: Array
    blur_px: Array
    offset_mm: Array
    contrast: Array
    noise: Array
    kept: Array
    quality: Index
    camera_from_dish: Pose
    normal_sigma_rad: float
    noise_model: NoiseModel
    log_gamma: float
    rejected: tuple[tuple[int, str], ...]
    sheet: SheetSummary | None = None

    def __len__(self) -> int:
        return len(self.ids)


def measure_targets(
    image: NDArray[Any],
    camera: Camera,
    pattern: Pattern,
    detections: Detections,
    identity: Identity,
    assumptions: Assumptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> TargetPoses:
    """Measure the pose of every named target from the raw pixels of `image` (H, W), any real dtype.

    `detections` and `identity` come from `find_ellipses` and `identify`. Targets that cannot be measured are listed in
    `rejected` with the reason. Raises ImageError if the image holds NaN, CameraError if its size is not the camera's,
    MeasurementError if no target can be measured. `progress(done, total)` is called after each group of targets.
    """
    check_image(image, camera)
    # thousands of small matrix products: threads would cost more than they bring, far more on a busy machine
    # what overflows belongs to a target that the fit left, which is then rejected
    with threadpool_limits(limits=1, user_api="blas"), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        assumptions = assumptions or Assumptions()
        groups, rejected = start_groups(camera, pattern, detections, identity, assumptions)
        tell = progress or (lambda done, total: None)
        return measure_groups(image, camera, pattern, groups, rejected, identity.camera_from_dish, assumptions, tell)


# The fields of TargetPoses with one row for each target.
TARGET_COLUMNS = (
    *("index", "ids", "position_mm", "normal", "rotation", "covariance", "information", "pull", "prior", "center_px", "covariance_px2"),
    *("sigma_normal_rad", "calibration_jacobian", "blur_px", "offset_mm", "contrast", "noise", "kept", "quality"),
)


def select_targets(poses: TargetPoses, rows: Index) -> TargetPoses:
    """The targets in rows (K,) of a measurement."""
    columns: dict[str, Any] = {name: getattr(poses, name)[rows] for name in TARGET_COLUMNS}
    return replace(poses, **columns)


def measure_groups(
    image: NDArray[Any],
    camera: Camera,
    pattern: Pattern,
    groups: list[Group],
    rejected: list[tuple[int, str]],
    camera_from_dish: Pose,
    assumptions: Assumptions,
    tell: Callable[[int, int], None],
) -> TargetPoses:
    """Measure targets from their first poses; `rejected` holds those left out before. See `measure_targets`."""
    total = 2 * len(groups)
    coarse = []
    ink = printed_ink(camera, pattern, groups, camera_from_dish)
    for group in groups:
        fit = _coarse_fit(image, pattern, group, ink, rejected)
        coarse += [] if fit is None else [fit]
        tell(len(coarse), total)
    if not coarse:
        raise MeasurementError(
            "no named target lies wholly inside the image; move the camera back or turn it so that whole targets are seen"
        )
    shared = learn(camera, pattern, camera_from_dish, coarse, assumptions)
    ink = printed_ink(camera, pattern, [fit.group for fit in coarse], shared.camera_from_dish)
    fits = []
    for fit in coarse:
        fits.append(full_fit(image, pattern, fit, shared, ink))
        tell(len(coarse) + len(fits), total)
    return _collect(image, pattern, fits, shared, assumptions, rejected)


def _coarse_fit(image: NDArray[Any], pattern: Pattern, group: Group, ink: Ink, rejected: list[tuple[int, str]]) -> Coarse | None:
    """Coarse fit of the targets that it does not lead astray; the others are added to `rejected`. None if none is left.

    They are taken out at once, because one that seems huge would spoil the windows of all others, which share one size.
    """
    while len(group.index):
        fit = coarse_fit(image, group, ink)
        good = np.isfinite(fit.adjusted.poses.position_mm).all(axis=1) & wholly_inside(fit.group)
        if good.all():
            return fit
        rejected += [(int(pattern.ids[i]), "its pixels do not look like the printed target") for i in group.index[~good]]
        group = regroup(group, good)
    return None


def check_image(image: NDArray[Any], camera: Camera) -> None:
    """Raise ImageError or CameraError unless `image` is a grey picture of the camera's size without NaN."""
    check_pixels(image)
    if image.shape != (camera.height_px, camera.width_px):
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise CameraError(
            f"the photograph is {size} px but the camera was calibrated at {camera.width_px}x{camera.height_px} px; "
            "use the camera file made for photographs of this size, without cropping or scaling"
        )


def check_pixels(image: NDArray[Any]) -> None:
    """Raise ImageError unless `image` is a grey picture without NaN."""
    if image.ndim != 2 or not image.size:
        raise ImageError(f"the image must be one grey picture (height, width), not an array of shape {image.shape}")
    if image.dtype.kind == "f" and not np.isfinite(image).all():
        raise ImageError("the image holds NaN or infinite pixels; give finite grey levels")
    if image.dtype.itemsize > 4 or image.dtype.kind == "f":
        largest = max(abs(float(image.max())), abs(float(image.min())))
        if largest > LARGEST_GREY:
            raise ImageError(f"the image holds a grey level of {largest:.3g}; scale them to 0 to 255 for black to white")


def _collect(
    image: NDArray[Any],
    pattern: Pattern,
    fits: list[Fit],
    shared: Shared,
    assumptions: Assumptions,
    rejected: list[tuple[int, str]],
) -> TargetPoses:
    blocks = [(a.residual, p.used) for _, a, p in fits if p.shape is None]
    noise = replace(shared.noise, inflation=inflation_of([r for r, _ in blocks], [u for _, u in blocks]))
    if assumptions.normal_sigma_deg is None:
        fits, shared = with_learnt_normals(fits, shared, noise.inflation)
    fits = with_clear_light(with_likelier_normals(fits, noise), noise)
    parts = [_results(image, group, adjusted, pixels, noise) for group, adjusted, pixels in fits]
    every = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.argsort(every["index"])
    every = {name: values[order] for name, values in every.items()}
    bits = every["quality"]
    out = is_rejected(bits) | (every["kept"] < HIDDEN_BELOW)
    for i in np.flatnonzero(out):
        why = names(int(bits[i] & ~0)) if is_rejected(bits[i]) else "more than half of one of its edges is hidden"
        rejected.append((int(pattern.ids[every["index"][i]]), why.replace("|", ", ").replace("_", " ")))
    kept = {name: values[~out] for name, values in every.items()}
    return TargetPoses(
        ids=pattern.ids[kept["index"]],
        camera_from_dish=shared.camera_from_dish,
        normal_sigma_rad=shared.normal_sigma_rad,
        noise_model=noise,
        log_gamma=shared.log_gamma,
        rejected=tuple(sorted(rejected)),
        sheet=None,
        **kept,
    )


def _results(image: NDArray[Any], group: Group, adjusted: Adjusted, pixels: RingPixels, noise: NoiseModel) -> dict[str, Array]:
    """Columns of TargetPoses for one group, keyed by field name."""
    count, batch, poses = len(group.index), group.batch, adjusted.poses
    data = adjusted.data_information / noise.inflation
    prior = adjusted.information - adjusted.data_information
    covariance = inverse_scaled(data + prior)
    kept = _kept(adjusted, pixels, count)
    enlarged = allowance(adjusted.noise_variance, kept)
    pose_covariance = covariance[:, :6, :6] * enlarged[:, None, None]
    steps = poses.steps
    turned = np.zeros((count, 6, 6))
    turned[:, :3, :3], turned[:, 3:, 3:] = steps, np.eye(3)
    center, by_pose = centers_of(batch.camera, poses, batch.curvature_per_mm)
    number = np.maximum(np.bincount(pixels.target, minlength=count), 1)
    light = by_target(adjusted.sums.light, pixels.target, count) / number[:, None]
    contrast = light[:, 0] - light[:, 3]
    sigma = np.sqrt(noise.variance(np.maximum(light[:, 0], 1.0)) * adjusted.noise_variance)
    edge_information = contrast**2 / (2 * np.sqrt(np.pi) * np.maximum(sigma, 1e-6) ** 2 * adjusted.state.blur_px * noise.inflation)
    columns = {
        "index": group.index,
        "position_mm": poses.position_mm,
        "normal": poses.rotation[..., 2],
        "rotation": poses.rotation,
        "covariance": turned @ pose_covariance @ np.swapaxes(turned, 1, 2),
        "center_px": center,
        "covariance_px2": by_pose @ pose_covariance @ np.swapaxes(by_pose, 1, 2),
        "sigma_normal_rad": np.sqrt(pose_covariance[:, 3, 3] + pose_covariance[:, 4, 4]),
        "calibration_jacobian": calibration_jacobian(batch, group.kind, poses, edge_information),
        "blur_px": adjusted.state.blur_px,
        "offset_mm": adjusted.state.offset_mm,
        "contrast": contrast,
        "noise": sigma,
        "kept": kept,
    }
    columns["information"], columns["pull"], columns["prior"] = _likelihood(batch.priors, adjusted, noise.inflation * enlarged)
    columns["quality"] = _quality(image, group, adjusted, pixels, columns, data + prior, light[:, 0])
    return columns


def _likelihood(priors: Priors, adjusted: Adjusted, enlarged: Array) -> tuple[Array, Array, Array]:
    """What the pixels alone say of pose and edge offset: information (T, 7, 7) and pull (T, 7) at the estimate; the priors (T, 7).

    There the pixels' pull and the priors' cancel, so the pixels pull against the priors. Blur, tone curve and blooming keep
    their priors and are eliminated. `enlarged` (T,) divides both, as it multiplies covariances.
    """
    precision, pull = prior_terms(adjusted.poses, adjusted.state, priors)
    information, axes = on_pose_and_offset(adjusted.data_information, precision, adjusted.poses.steps)
    against = -pull[:, POSE_AND_OFFSET]
    return (
        information / enlarged[:, None, None],
        np.einsum("tij,tj->ti", axes, against) / enlarged[:, None],
        precision[:, POSE_AND_OFFSET],
    )


def allowance(misfit: Array, kept: Array) -> Array:
    """Factor (T,) on covariances for what is no noise: a model that does not fit, or an edge that is partly hidden.

    Misfit is common to the pixels within a blur of each other, where noise is not; what is left beside an obstacle is pulled
    by its border. Both allowances were set so that flagged targets in simulated clutter keep their claimed sigmas.
    """
    poor = np.where(misfit > POOR_FIT_RATIO, COHERENT_PIXELS * (1 - 1 / np.maximum(misfit, 1.0)), 0.0)
    return np.asarray(1 + poor + np.where(kept < OCCLUDED_BELOW, OBSTACLE_ALLOWANCE * (1 - kept), 0.0))


def _kept(adjusted: Adjusted, pixels: RingPixels, count: int) -> Array:
    """Smallest share of any circle's edge that was used, over the rings that were not left out."""
    out = np.ones(count)
    seen = pixels.used.any(axis=1)
    np.minimum.at(out, pixels.target[seen], adjusted.sums.kept[seen].min(axis=1))
    return np.where(np.bincount(pixels.target[seen], minlength=count) > 0, out, 0.0)


def _quality(
    image: NDArray[Any],
    group: Group,
    adjusted: Adjusted,
    pixels: RingPixels,
    columns: dict[str, Array],
    information: Array,
    ground: Array,
) -> Index:
    count = len(group.index)
    bits = np.zeros(count, np.int64)

    def flag(where: Array, bit: Quality) -> None:
        bits[where] |= int(bit)

    outlines = group.outlines()
    flag(~np.asarray(group.batch.camera.contains(outlines, margin_px=1.0).all(axis=(1, 2))), Quality.CLIPPED)
    known = [columns[name].reshape(count, -1) for name in ("position_mm", "rotation", "covariance", "covariance_px2")]
    known += [columns[name].reshape(count, -1) for name in ("information", "pull", "prior", "calibration_jacobian")]
    finite = np.isfinite(np.concatenate(known, axis=1)).all(axis=1)
    flag(~(adjusted.converged & finite), Quality.NOT_CONVERGED)
    least = np.maximum(LEAST_CONTRAST_SIGMAS * columns["noise"], LEAST_CONTRAST_PART * ground)
    flag(columns["contrast"] < least, Quality.NO_CONTRAST)
    flag(adjusted.noise_variance > POOR_FIT_RATIO, Quality.POOR_FIT)
    flag(minor_radius_px(outlines).min(axis=1) < SMALLEST_RADIUS_PX, Quality.TOO_SMALL)
    bright, lost = _lost_edges(adjusted, pixels, count)
    dropped = np.bincount(pixels.target[~pixels.used.any(axis=1)], minlength=count) > 0
    flag(lost & bright, Quality.GLARE)
    if group.glare is not None:
        flag(group.glare, Quality.GLARE)
    flag((lost & ~bright) | dropped, Quality.OCCLUDED)
    if group.ambiguous is not None:
        flag(group.ambiguous, Quality.AMBIGUOUS_NORMAL)
    flag(rests_on_offset(information), Quality.WEAK_DEPTH)
    return bits


def rests_on_offset(information: Array) -> NDArray[np.bool_]:
    """Where (T,) knowing the edge offset would shrink the sigma along the line of sight by WEAK_DEPTH_RATIO; (T, G, G) with priors."""
    rest = [i for i in range(GEOMETRY) if i not in (OFFSET_MM, OFFSET_PX)]
    free = inverse_scaled(information)[:, 2, 2]
    fixed = inverse_scaled(information[:, rest][:, :, rest])[:, 2, 2]
    return np.asarray(free > WEAK_DEPTH_RATIO**2 * fixed)


def _lost_edges(adjusted: Adjusted, pixels: RingPixels, count: int) -> tuple[Array, Array]:
    """Whether what is in front of each target is brighter than the model (T,), and whether any edge was lost (T,)."""
    lost = np.zeros(count, bool)
    seen = pixels.used.any(axis=1)
    np.logical_or.at(lost, pixels.target[seen], adjusted.sums.kept[seen].min(axis=1) < OCCLUDED_BELOW)
    extreme = np.where(pixels.used, adjusted.residual, 0.0)
    highest, lowest = np.zeros(count), np.zeros(count)
    np.maximum.at(highest, pixels.target, extreme.max(axis=1))
    np.minimum.at(lowest, pixels.target, extreme.min(axis=1))
    saturated = np.zeros(count, bool)
    if pixels.saturated is not None:
        np.logical_or.at(saturated, pixels.target, pixels.saturated > MOST_SATURATED)
    return (highest > -lowest) | saturated, lost | saturated
