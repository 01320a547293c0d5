"""Grow a local match over the whole pattern, from neighbour to neighbour.

A mark is predicted by a rigid pose of the printed pattern plus a smooth correction from the residuals of its own matched
neighbours, so a surface that is bent by much more than the spacing of its marks is still followed; each match must then
agree with a prediction from its neighbours without it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.camera.model import Camera
from dishmap.targets.candidates import Candidates
from dishmap.targets.ellipses import invert_2x2, root_det
from dishmap.targets.layout import Layout
from dishmap.targets.markgrid import MarkGrid
from dishmap.targets.rigid import STEPS, RigidFit, other_tilt, pose_jacobians, robust_pose, unbent_misfit
from dishmap.transforms import Pose

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Index = NDArray[np.int64]

# A match lies within this part of the spacing of marks from its prediction, while the match still grows.
GATE_SPACING = 0.25
# At the end it also lies within this part of the mark's radius, this many robust sigmas of all such residuals, or these px.
GATE_RADIUS, GATE_SIGMAS, GATE_PX = 0.35, 6.0, 0.7
# Sizes agree with the prediction to this part, after the common ratio (ink spread, threshold) is taken out; small ones to px.
SIZE_TOLERANCE, SIZE_TOLERANCE_PX = 0.2, 0.5
# A mark of which printed circles are not seen must agree better: to this part of the limits above.
DAMAGED_GATE = 0.5
# A mark with fewer matched neighbours, but some, is predicted only if the rigid pose is known this well, as a part of its
# spacing. Farther away a bent surface could bring the wrong mark to the predicted place.
FEWEST_NEIGHBOURS = 3
RIGID_SIGMA = 0.05
# Where it has no matched neighbour at all, the surface must so far be this stiff, and the mark not beyond this many times the
# reach of the matches: what bending they hide grows with the square of the distance.
STIFF_PART, STIFF_REACH = 0.015, 1.6
# Ridge of the local correction: weight of "no offset", "no gradient" and "the usual size", in matched neighbours.
RIDGE_OFFSET, RIDGE_GRADIENT, RIDGE_SIZE = 0.005, 0.05, 0.1
# Look-alikes count within this many spacings, up to this ratio of sizes.
STRANGER_PART, STRANGER_SIZE = 1.5, 1.3
MOST_WAVES = 60
# Waves without progress after which growth ends; the tilt's other sign is tried in the first waves, when the patch is small.
IDLE_WAVES = 3
TILT_WAVES = 2
# Marks seen more obliquely than this cosine are not looked for.
LEAST_FACING = 0.1
FEWEST_MATCHES = 3
# A surface bends by up to about this part of its half size; a placement is clean when a bent one leaves less than this part of
# the distance between targets.
BEND_PART, CLEAN_PART = 0.03, 0.02
MOST_POSE_MARKS = 100
WAVE_STEPS = 4


@dataclass(frozen=True)
class Scene:
    """What is searched in: candidates with a tree over their centres, the pattern's layout with a grid over it, the camera."""

    candidates: Candidates
    tree: cKDTree
    layout: Layout
    grid: MarkGrid
    camera: Camera


@dataclass(frozen=True)
class Prediction:
    """Where and how each mark should be seen (K): from the rigid pose and its matched neighbours, never from itself.

    predicted_px (K, 2), NaN where it cannot be seen; affine (K, 2, 2): px per mm of the mark's own plane; support (K,):
    matched neighbours; residual_mm (K,): of each match, in the mark's plane, NaN without a match; log_ratio (K,): log of
    seen over predicted size that the neighbours let expect (ink spread, threshold, a bent surface); log_size (K,): what the
    match has beyond that; known (K,): the prediction can be trusted.
    """

    predicted_px: Array
    affine: Array
    support: Index
    residual_mm: Array
    log_ratio: Array
    log_size: Array
    known: Flags


@dataclass(frozen=True)
class Embedding:
    """One placement of the pattern: the rigid fit, the candidate (K,) of each mark or -1, the predictions.

    misfit_px: what bending along the surface's normal does not explain, robust sigma of a coordinate.
    """

    fit: RigidFit
    candidate: Index
    prediction: Prediction
    misfit_px: float

    @property
    def count(self) -> int:
        """Number of matched marks."""
        return int((self.candidate >= 0).sum())


def grow(scene: Scene, pose: Pose, marks: Index, candidates: Index) -> Embedding | None:
    """Grow the match of `marks` with `candidates` (both (n,)) from a first pose; None if it falls apart."""
    match = np.full(len(scene.layout), -1)
    match[marks] = candidates
    most, idle = 0, 0
    for wave in range(MOST_WAVES):
        fit = fit_pose(scene, pose, match, try_other=wave < TILT_WAVES, steps=WAVE_STEPS)
        if fit is None:
            return None
        pose = fit.pose
        prediction = _predict(scene, fit, match)
        before, match = match, _extended(scene, prediction, _cleaned(scene, prediction, match, final=False), damaged=False)
        if (match == before).all():
            break
        count = int((match >= 0).sum())
        idle = 0 if count > most else idle + 1
        most = max(most, count)
        if idle == IDLE_WAVES:
            break
    return _finished(scene, pose, match)


def _finished(scene: Scene, pose: Pose, match: Index) -> Embedding | None:
    """Apply the tight limits, let damaged marks in, and give the embedding."""
    fit = fit_pose(scene, pose, match, try_other=True)
    if fit is None:
        return None
    prediction = _predict(scene, fit, match)
    kept = _trusted(scene, prediction, _cleaned(scene, prediction, match, final=True))
    whole = _extended(scene, prediction, kept, damaged=True)
    if (whole == match).all():
        return _embedding(scene, fit, match, prediction)
    fit = fit_pose(scene, fit.pose, whole, try_other=False)
    if fit is None:
        return None
    prediction = _predict(scene, fit, whole)
    # what was let in must agree with its neighbours, and so must those that lost some
    final = _trusted(scene, prediction, _cleaned(scene, prediction, whole, final=True))
    if (final >= 0).sum() < FEWEST_MATCHES:
        return None
    return _embedding(scene, fit, final, _predict(scene, fit, final))


def _embedding(scene: Scene, fit: RigidFit, match: Index, prediction: Prediction) -> Embedding:
    marks = np.flatnonzero(match >= 0)
    return Embedding(fit, match, prediction, misfit_of(scene, fit.pose, marks, match[marks]))


def misfit_of(scene: Scene, pose: Pose, marks: Index, candidates: Index) -> float:
    """Robust sigma (px) of what neither a pose nor bending along the normal explains in a match."""
    layout = scene.layout
    few = slice(None, None, 1 + len(marks) // MOST_POSE_MARKS)
    marks, candidates = marks[few], candidates[few]
    points = layout.center_mm[marks]
    bend = BEND_PART * float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())
    return unbent_misfit(pose, points, layout.axes[marks, :, 2], scene.candidates.sights.take(candidates), bend)


def fit_pose(scene: Scene, pose: Pose, match: Index, try_other: bool, steps: int = STEPS) -> RigidFit | None:
    """Rigid pose of the matched marks from a first guess, if asked also from the guess with the opposite tilt."""
    marks = np.flatnonzero(match >= 0)
    if len(marks) < FEWEST_MATCHES:
        return None
    # a pose from some of very many marks is as good for prediction
    marks = marks[:: 1 + len(marks) // MOST_POSE_MARKS]
    points, seen = scene.layout.center_mm[marks], scene.candidates.sights.take(match[marks])
    best = robust_pose(pose, points, seen, steps)
    if try_other and best is not None:
        guess = other_tilt(best.pose, best.middle_mm, scene.layout.axes[marks, :, 2].mean(axis=0))
        other = robust_pose(guess, points, seen, steps)
        if other is not None and other.cost < best.cost:
            best = other
    return best


def _predict(scene: Scene, fit: RigidFit, match: Index) -> Prediction:
    layout, candidates = scene.layout, scene.candidates
    points = fit.pose.apply(layout.center_mm)
    pixels, by_point, _ = scene.camera.project_with_jacobians(points)
    axes = fit.pose.rotation @ layout.axes
    affine = by_point @ axes[:, :, :2]
    facing = -(axes[:, :, 2] * points).sum(axis=1) / np.linalg.norm(points, axis=1)
    pixels[facing < LEAST_FACING] = np.nan
    matched = match >= 0
    residual = np.where(matched[:, None], candidates.center_px[match] - pixels, 0.0)
    matched &= np.isfinite(residual).all(axis=1)
    offset, gradient, support = _local_correction(layout, matched, np.nan_to_num(residual))
    predicted, affine = pixels + offset, affine + gradient
    # how well the rigid pose itself places each mark
    by_pose = by_point @ pose_jacobians(fit.pose, layout.center_mm, fit.middle_mm)
    rigid_px = np.sqrt(np.maximum(((by_pose @ fit.covariance) * by_pose).sum(axis=(1, 2)), 0.0))
    scale = root_det(affine)
    with np.errstate(invalid="ignore", divide="ignore"):
        rigid = (rigid_px < RIGID_SIGMA * scale * layout.spacing_mm) & (fit.sigma_px < 2 * RIGID_SIGMA * scale * layout.spacing_mm)
        stiff = (fit.sigma_px < STIFF_PART * scale * layout.spacing_mm) & _within_reach(layout.center_mm, matched)
        known = np.isfinite(predicted).all(axis=1) & ((support >= FEWEST_NEIGHBOURS) | (rigid & ((support > 0) | stiff)))
        size = scale * layout.radius_mm
        log_size = np.where(matched, np.log(candidates.size_px[match] / size), np.nan)
        in_plane = np.einsum("kij,kj->ki", invert_2x2(affine), candidates.center_px[match] - predicted)
    log_ratio = _local_ratio(layout, matched, log_size)
    distance = np.where(matched, np.linalg.norm(in_plane, axis=1), np.nan)
    return Prediction(predicted, affine, support, distance, log_ratio, log_size - log_ratio, known)


def _local_ratio(layout: Layout, matched: Flags, log_size: Array) -> Array:
    """Mean (K,) of the matched neighbours' log sizes, drawn a little to the median of all."""
    middle = float(np.median(log_size[matched])) if matched.any() else 0.0
    weight = _neighbour_weights(layout, matched)
    total = (weight * np.nan_to_num(log_size)[layout.neighbour]).sum(axis=1) + RIDGE_SIZE * middle
    return np.asarray(total / (weight.sum(axis=1) + RIDGE_SIZE))


def _neighbour_weights(layout: Layout, matched: Flags) -> Array:
    """Weight (K, N) of each neighbour: near ones count most, those without a match not at all."""
    near = matched[layout.neighbour] & (layout.neighbour >= 0)
    place = np.nan_to_num(layout.offset_mm) / layout.spacing_mm[:, None, None]
    return near / (1 + (place**2).sum(axis=2) ** 2)


def _within_reach(places: Array, matched: Flags) -> Flags:
    if not matched.any():
        return matched
    distance = np.linalg.norm(places - places[matched].mean(axis=0), axis=1)
    return np.asarray(distance <= STIFF_REACH * distance[matched].max())


def _local_correction(layout: Layout, matched: Flags, residual: Array) -> tuple[Array, Array, Index]:
    """Offset (K, 2) px, gradient (K, 2, 2) px per mm, and number (K,) of matched neighbours behind them.

    A ridge fit of residual = offset + gradient * (place in the mark's plane) to the matched neighbours, near ones first.
    """
    k = len(layout)
    offset, gradient = np.zeros((k, 2)), np.zeros((k, 2, 2))
    weight = _neighbour_weights(layout, matched)
    support = (weight > 0).sum(axis=1)
    rows = np.flatnonzero(support)
    weight = weight[rows]
    place = np.nan_to_num(layout.offset_mm[rows]) / layout.spacing_mm[rows, None, None]
    columns = np.concatenate([np.ones((*place.shape[:2], 1)), place], axis=2)
    weighted = np.swapaxes(columns * weight[..., None], 1, 2)
    normal = weighted @ columns + np.diag([RIDGE_OFFSET, RIDGE_GRADIENT, RIDGE_GRADIENT])
    solution = np.linalg.solve(normal, weighted @ residual[layout.neighbour[rows]])
    offset[rows] = solution[:, 0]
    gradient[rows] = np.swapaxes(solution[:, 1:], 1, 2) / layout.spacing_mm[rows, None, None]
    return offset, gradient, support


def misfit_part(layout: Layout, placement: Embedding) -> float:
    """What neither a pose nor bending along the normal explains, as a part of the distance between targets."""
    scale = root_det(placement.prediction.affine[placement.candidate >= 0])
    return placement.misfit_px / (float(np.median(scale)) * layout.pitch_mm)


def is_clean(layout: Layout, placement: Embedding) -> bool:
    """Whether a pose and bending along the normal explain the matches."""
    return misfit_part(layout, placement) < CLEAN_PART


def limits_mm(scene: Scene, prediction: Prediction, final: bool) -> Array:
    """Largest distance (K,) mm in the mark's plane between a match and its prediction."""
    layout = scene.layout
    loose = GATE_SPACING * layout.spacing_mm
    if not final:
        return loose
    scale = root_det(np.nan_to_num(prediction.affine))
    trusted = prediction.residual_mm[prediction.known & np.isfinite(prediction.residual_mm)]
    sigma = 1.4826 * float(np.median(trusted)) if len(trusted) else 0.0
    tight = np.maximum(GATE_RADIUS * layout.radius_mm, GATE_SIGMAS * sigma)
    return np.minimum(loose, np.maximum(tight, GATE_PX / np.maximum(scale, 1e-9)))


def size_limits(layout: Layout, prediction: Prediction) -> Array:
    """Largest difference (K,) of log sizes between a match and its prediction."""
    size = root_det(np.nan_to_num(prediction.affine)) * layout.radius_mm
    return np.log1p(SIZE_TOLERANCE + SIZE_TOLERANCE_PX / np.maximum(size, 1.0))


def _cleaned(scene: Scene, prediction: Prediction, match: Index, final: bool) -> Index:
    """Matches without those that disagree with the prediction from their neighbours."""
    with np.errstate(invalid="ignore"):
        far = prediction.residual_mm > limits_mm(scene, prediction, final)
        odd = np.abs(prediction.log_size) > size_limits(scene.layout, prediction)
    lost = ~np.isfinite(prediction.predicted_px).all(axis=1)
    # in the first waves nothing is known well, and the seed itself must be allowed to stay
    lost |= prediction.known & (far | odd) if not final else far | odd | ~prediction.known
    return np.where((match >= 0) & ~lost, match, -1)


def _trusted(scene: Scene, prediction: Prediction, match: Index) -> Index:
    """Matches without those among more circles that look like marks and fit nowhere than circles that fit.

    A part of the pattern that is matched one mark off has such circles all around it.
    """
    centers = scene.candidates.center_px
    like = _look_alikes(scene, prediction)
    radius_of = STRANGER_PART * root_det(np.nan_to_num(prediction.affine)) * scene.layout.spacing_mm
    for _ in range(MOST_WAVES):
        marks = np.flatnonzero(match >= 0)
        strange = like.copy()
        strange[match[marks]] = False
        if not strange.any() or not len(marks):
            break
        places, radius = centers[match[marks]], radius_of[marks]
        around = cKDTree(centers[strange]).query_ball_point(places, radius, return_length=True)
        fitting = cKDTree(places).query_ball_point(places, radius, return_length=True) - 1
        bad = around > np.maximum(fitting, 1)
        if not bad.any():
            break
        match = match.copy()
        match[marks[bad]] = -1
    return match


def _look_alikes(scene: Scene, prediction: Prediction) -> Flags:
    """Candidates (N,) that look like marks in type and size and lie among the predicted marks."""
    layout, candidates = scene.layout, scene.candidates
    seen = np.flatnonzero(np.isfinite(prediction.predicted_px).all(axis=1))
    if not len(seen):
        return np.zeros(len(candidates), dtype=bool)
    distance, nearest = cKDTree(prediction.predicted_px[seen]).query(candidates.center_px)
    mark = seen[nearest]
    scale = root_det(prediction.affine[mark])
    size = np.log(candidates.size_px / (scale * layout.radius_mm[mark])) - prediction.log_ratio[mark]
    like = candidates.is_type.any(axis=1) & (np.abs(size) < np.log(STRANGER_SIZE))
    return np.asarray(like & (distance < STRANGER_PART * scale * layout.spacing_mm[mark]))


def clashes(scene: Scene, prediction: Prediction, match: Index) -> tuple[int, int]:
    """Number of marks in whose place a whole mark of another type is seen, and of those that have more printed in them."""
    layout, candidates = scene.layout, scene.candidates
    free = np.flatnonzero((match < 0) & prediction.known)
    if not len(free):
        return 0, 0
    _, nearest = scene.tree.query(prediction.predicted_px[free])
    away = candidates.center_px[nearest] - prediction.predicted_px[free]
    in_plane = np.linalg.norm((invert_2x2(prediction.affine[free]) @ away[:, :, None])[..., 0], axis=1)
    there = in_plane <= limits_mm(scene, prediction, final=True)[free]
    types = layout.type_index[free]
    other = there & candidates.is_type[nearest].any(axis=1) & ~candidates.is_type[nearest, types]
    return int(other.sum()), int((other & candidates.has_more[nearest, types]).sum())


def strangers(scene: Scene, prediction: Prediction, match: Index) -> int:
    """Number of candidates among the predicted marks that look like marks but are none."""
    like = _look_alikes(scene, prediction)
    like[match[match >= 0]] = False
    return int(like.sum())


def _extended(scene: Scene, prediction: Prediction, match: Index, damaged: bool) -> Index:
    """Matches with those marks added that have a candidate where they should be."""
    layout, candidates = scene.layout, scene.candidates
    open_marks = np.flatnonzero((match < 0) & prediction.known)
    if not len(open_marks) or not len(candidates):
        return match
    _, nearest = scene.tree.query(prediction.predicted_px[open_marks])
    taken = np.isin(nearest, match[match >= 0])
    fits = candidates.may_be_type if damaged else candidates.is_type
    part = DAMAGED_GATE if damaged else 1.0
    difference = candidates.center_px[nearest] - prediction.predicted_px[open_marks]
    in_plane = np.linalg.norm(np.einsum("kij,kj->ki", invert_2x2(prediction.affine[open_marks]), difference), axis=1)
    size = root_det(prediction.affine[open_marks]) * layout.radius_mm[open_marks]
    log_size = np.log(candidates.size_px[nearest] / size) - prediction.log_ratio[open_marks]
    good = ~taken & fits[nearest, layout.type_index[open_marks]]
    good &= in_plane <= part * limits_mm(scene, prediction, final=damaged)[open_marks]
    good &= np.abs(log_size) <= part * size_limits(layout, prediction)[open_marks]
    chosen, nearest, order = open_marks[good], nearest[good], np.argsort((in_plane / layout.spacing_mm[open_marks])[good])
    _, first = np.unique(nearest[order], return_index=True)
    grown = match.copy()
    grown[chosen[order][first]] = nearest[order][first]
    return grown
