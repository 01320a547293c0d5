"""The paper's on-board difference between a reference and a current image (section 5, Algorithm 3): the baseline.

The reference's surface is known from the laboratory; the current image gives centres only. Registration, the ratio of the
distances of pairs, what a ratio means in mm, confidence and normal analysis, levels, and the minimum LAR surface. Where the
text leaves a choice: docs/method-paper.md, "Differences".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.spatial import cKDTree

from dishmap.camera.model import Camera
from dishmap.difference.levels import Estimates, average, delaunay_pairs, level, level_0
from dishmap.difference.ratio import (
    EPSILON,
    RatioMap,
    consistency,
    depth_sensitivity_per_mm,
    normal_sensitivity_per_mm,
    pairs_within,
    ratio_map,
)
from dishmap.difference.registration import Registration, register
from dishmap.errors import CameraError, FitError, InputError
from dishmap.robust import robust_linear_fit
from dishmap.surface.cloud import PointCloud
from dishmap.surface.fit import Basis, SurfaceFit, fit_surface, surface_heights
from dishmap.transforms import Pose

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Normals = Literal["none", "reference", "turned"]
Frame = Callable[[Array], Array]

METHOD = "paper"
NORMALS: tuple[Normals, ...] = ("none", "reference", "turned")
# Neighbours by default: on a square lattice 1 is the next target, 1.41 the one across the diagonal, 2 the next but one.
NEIGHBOUR_PITCHES = 1.6
# A pair that answers to displacement by less than this part of what one across the line of sight does lies so steeply that
# foreshortening undoes what distance does: its ratio says next to nothing.
LEAST_ANSWER = 0.2
# Central differences through a change of frame: far above rounding, far below the distance of targets.
FRAME_STEP_PX = 0.1


@dataclass(frozen=True)
class Centers:
    """Centres of targets in an undistorted image: ids (N,), center_px (N, 2), covariance_px2 (N, 2, 2) or None if unknown.

    Raises InputError for arrays that do not fit.
    """

    ids: Ints
    center_px: Array
    covariance_px2: Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "ids", np.asarray(self.ids, dtype=np.int64))
        n = self.ids.size
        for name, shape in (("center_px", (n, 2)), ("covariance_px2", (n, 2, 2))):
            value = getattr(self, name)
            if value is None and name == "covariance_px2":
                continue
            object.__setattr__(self, name, np.asarray(value, dtype=float))
            if np.shape(value) != shape:
                raise InputError(f"{n} centres need {name} of shape {shape}, not {np.shape(value)}")


@dataclass(frozen=True)
class PaperDifference:
    """What changed, by the paper's method; T common targets, M pairs. Displacements are along the reference normal, towards the camera.

    registration: with ids (T,). ratios: the ratio map, after the registration's scale is taken out. confidence (M,): weight of
    each ratio, 0 if not used. entries: each ratio in mm. levels: level 0, 1, ... in mm, one row per target; places x, y of the
    dish frame. place_mm (T, 2): of the targets themselves. surface: LAR surface, height = displacement over x, y; its covariance
    is from the centres' noise, NaN where that is unknown. displacement_mm, depth_change_mm (T,): of this surface at the targets, the
    latter along the camera's z; sigma_displacement_mm (T,): NaN where unknown; it holds the centres' noise only, not what the
    method leaves out. extrapolated (T,): the target lies outside the places the surface was fitted to.
    common_depth_change_mm: what the registration's scale alone means at the mean depth. normals, reach_mm: as used.
    """

    registration: Registration
    ratios: RatioMap
    confidence: Array
    entries: Estimates
    levels: tuple[Estimates, ...]
    place_mm: Array
    surface: SurfaceFit
    displacement_mm: Array
    depth_change_mm: Array
    sigma_displacement_mm: Array
    extrapolated: NDArray[np.bool_]
    common_depth_change_mm: float
    normals: Normals
    reach_mm: float
    method: str = METHOD

    @property
    def ids(self) -> Ints:
        """Ids (T,) of the targets, ascending."""
        return self.registration.ids


def paper_difference(
    reference: Centers,
    current: Centers,
    lab: PointCloud,
    camera: Camera,
    camera_from_dish: Pose,
    *,
    basis: Basis | None = None,
    normals: Normals = "turned",
    reach_mm: float | None = None,
    surface_level: int | None = 1,
    epsilon: float = EPSILON,
    in_antenna: tuple[Frame, Frame] | None = None,
) -> PaperDifference:
    """The difference map by Algorithm 3.

    reference, current: centres in undistorted images of `camera`, which has no distortion; lab: the reference's targets in the camera
    frame, with normals; camera_from_dish: of the reference. basis: of the surface over x, y of the dish, by default a plane.
    normals: what a ratio means in mm: by the text's formula (`none`), with foreshortening by the normals of the `reference`, or also with
    the turn that the change itself gives to each pair (`turned`). reach_mm: longest pair, by default the nearest neighbours,
    `inf` for all pairs. surface_level: which level the surface goes through; None for the ratio map itself. in_antenna: two functions,
    for the reference and the current image, from pixels (K, 2) about the principal point to coordinates relative to the contour.
    Raises InputError, CameraError, and FitError for fewer than 3 common targets or too few for the basis.
    """
    basis = basis or Basis()
    _check(lab, camera, basis, normals, surface_level)
    frames = in_antenna or (None, None)
    before, now = _in_frame(reference, camera, frames[0]), _in_frame(current, camera, frames[1])
    known = np.isin(before.ids, lab.ids)
    before = Centers(before.ids[known], before.center_px[known], None if before.covariance_px2 is None else before.covariance_px2[known])
    found = register(before.ids, before.center_px, now.ids, now.center_px)
    position, normal = _of_lab(lab, found.ids)
    place = camera_from_dish.inverse().apply(position)[:, :2]
    reach = reach_mm if reach_mm is not None else NEIGHBOUR_PITCHES * _pitch(place)
    ratios = _ratios(found, before, now, place, reach, epsilon)
    by = (depth_sensitivity_per_mm if normals == "none" else normal_sensitivity_per_mm)(position, normal, ratios.pair)
    ratios = replace(ratios, used=ratios.used & (by.sum(axis=1) > LEAST_ANSWER / position[ratios.pair, 2].mean(axis=1)))
    _check_used(ratios, reach)
    entries = displacement_entries(ratios, found.scale, by, consistency(ratios))
    if normals == "turned":
        plain = _surface(entries, basis)
        entries = turned_entries(entries, ratios.pair, by, place, lambda xy: _design(plain, xy))
    levels = target_levels(entries, ratios.pair, place, max(1, surface_level or 0))
    surface = _surface(entries, basis) if surface_level is None else _surface(levels[surface_level], basis, found.ids)
    heights = surface_heights(surface, *place.T)
    return PaperDifference(
        registration=found,
        ratios=ratios,
        confidence=entries.weight,
        entries=entries,
        levels=levels,
        place_mm=place,
        surface=surface,
        displacement_mm=heights.height_mm,
        depth_change_mm=heights.height_mm * normal[:, 2],
        sigma_displacement_mm=heights.sigma_mm,
        extrapolated=heights.extrapolated,
        common_depth_change_mm=float(position[:, 2].mean() * (1 / found.scale - 1)),
        normals=normals,
        reach_mm=float(reach),
    )


def _ratios(found: Registration, before: Centers, now: Centers, place_mm: Array, reach_mm: float, epsilon: float) -> RatioMap:
    """The ratio map of registered targets; their noise is turned and scaled with the reference's centres."""
    noise_before = None if before.covariance_px2 is None else before.covariance_px2[found.reference_row]
    return ratio_map(
        found.registered_px,
        now.center_px[found.current_row],
        pairs_within(place_mm, reach_mm if np.isfinite(reach_mm) else None),
        place_mm=place_mm,
        reference_covariance_px2=None if noise_before is None else found.matrix @ noise_before @ found.matrix.T,
        current_covariance_px2=None if now.covariance_px2 is None else now.covariance_px2[found.current_row],
        epsilon=epsilon,
    )


def displacement_entries(ratios: RatioMap, scale: float, by: Array, weight: Array) -> Estimates:
    """Each ratio as a displacement in mm: (1 - 1 / (scale r)) / answer, at its mid-point on the surface.

    scale: the registration's, taken out of the ratios and here put back; by (M, 2): d log r by the displacement of each end, the
    answer being their sum; with answer 1 / z this is the text's dz = z (1 / r - 1). weight (M,): consistency; the entries' weights
    are that over the variance of the entry, or over what equal noise of all centres would make it.
    """
    answer = by.sum(axis=1)
    whole = scale * ratios.ratio
    on = weight > 0
    safe = np.where(on, answer, 1.0)
    value = np.where(on, (1 - 1 / whole) / safe, np.nan)
    noise = None if ratios.noise is None else diags_array(np.where(on, 1 / (whole * safe), 0.0)) @ ratios.noise
    variance = 1 / (safe * ratios.distance_px) ** 2 if noise is None else np.asarray(noise.power(2).sum(axis=1))
    if noise is not None and not (variance[on] > 0).all():
        raise InputError("some centres claim no error at all; give covariances that are true, or none")
    confidence = np.where(on, weight / np.where(on, variance, 1.0), 0.0)
    assert ratios.mid_mm is not None
    return level_0(ratios.mid_mm, value, confidence / confidence.max(), noise)


def turned_entries(entries: Estimates, pair: Ints, by: Array, place_mm: Array, design: Frame) -> Estimates:
    """The entries (M,) of pairs (M, 2) without what the turn of the surface did to them (`normals="turned"`).

    Where the displacement differs from one end of a pair to the other, the pair turns, and away from the axis that lengthens
    or shortens it: a plate that tilts has ratios 1.5 times as steep as its depth. The smooth displacement (columns `design` (K, 2) ->
    (K, P)) that explains all ratios through both ends is fitted by Algorithm 4, and each entry loses the difference between what
    it says with its two ends apart and with both at its mid-point.
    """
    i, j = pair.T
    on = entries.weight > 0
    ends = design(place_mm)
    apart = by[:, :1] * ends[i] + by[:, 1:] * ends[j]
    answer = by.sum(axis=1)
    relative = entries.value[on] * answer[on]
    fit = robust_linear_fit(apart[on], relative, answer[on] / np.sqrt(entries.weight[on]))
    bias = np.where(on[:, None], apart / np.where(on, answer, 1.0)[:, None] - design(entries.place), 0.0)
    noise = entries.noise
    if noise is not None:
        noise = noise - bias @ ((fit.sensitivity * answer[on]) @ noise[on])
    return replace(entries, value=entries.value - bias @ fit.coefficients, noise=noise)


def target_levels(entries: Estimates, pair: Ints, place_mm: Array, number: int) -> tuple[Estimates, ...]:
    """Levels 0 to `number` of the targets (T, 2): level 0 averages the entries of a target's own pairs (M, 2)."""
    m = np.arange(len(pair))
    members = csr_array((np.ones(2 * len(m)), (pair.T.ravel(), np.tile(m, 2))), shape=(len(place_mm), len(m)))
    return level(average(entries, members), delaunay_pairs(place_mm), number)


def _surface(estimates: Estimates, basis: Basis, ids: Ints | None = None) -> SurfaceFit:
    """LAR surface through the estimates, unweighted as in the paper; its covariance is that of their noise, NaN if unknown."""
    on = np.isfinite(estimates.value)
    count = int(on.sum())
    flat = np.zeros((count, 3, 3))
    fit = fit_surface(
        PointCloud(
            ids=(np.arange(len(on)) if ids is None else ids)[on],
            position_mm=np.column_stack([estimates.place[on], estimates.value[on]]),
            normal=np.tile([0.0, 0.0, 1.0], (count, 1)),
            center_px=np.zeros((count, 2)),
            covariance_mm2=flat,
            sigma_normal_rad=np.zeros(count),
            covariance_px2=flat[:, :2, :2],
            calibration_jacobian=None,
            quality=np.zeros(count, dtype=np.int64),
            frame="dish",
        ),
        basis,
        weighted=False,
    )
    if estimates.noise is None:
        return replace(fit, covariance=np.full_like(fit.covariance, np.nan))
    design = _design(fit, estimates.place[on])
    heavy = fit.weights[:, None] * design
    factor = np.linalg.solve(heavy.T @ design, np.asarray(heavy.T @ estimates.noise[on]))
    return replace(fit, covariance=factor @ factor.T)


def _design(fit: SurfaceFit, xy_mm: Array) -> Array:
    """Columns (K, P) of a surface that is linear in its coefficients: its heights with each coefficient 1 and the others 0."""
    units = np.eye(len(fit.coefficients))
    return np.stack([surface_heights(replace(fit, coefficients=one), *xy_mm.T).height_mm for one in units], axis=1)


def _check(lab: PointCloud, camera: Camera, basis: Basis, normals: str, surface_level: int | None) -> None:
    if surface_level is not None and surface_level < 0:
        raise InputError(f"the surface goes through level 0 or a higher one, or None for the ratio map, not {surface_level}")
    if normals not in NORMALS:
        raise InputError(f"unknown normals {normals!r}; use one of {', '.join(NORMALS)}")
    if basis.along_normal:
        raise InputError(f"a difference is a height over x, y: use a plane, polynomial or zernike surface, not a {basis.kind}")
    if camera.model != "opencv" or camera.distortion.any():
        raise CameraError("the paper's difference works on centres in undistorted images: give those and their pinhole camera")
    if lab.frame != "camera":
        raise InputError(f"the map from the laboratory must be in the camera frame of the reference, not in {lab.frame!r}")


def _check_used(ratios: RatioMap, reach_mm: float) -> None:
    if not ratios.used.any():
        raise FitError(
            f"of {len(ratios)} pairs of targets up to {reach_mm:.0f} mm apart none changed its distance by less than "
            f"{100 * ratios.epsilon:g} %: check the ids, or raise reach_mm or epsilon"
        )


def _in_frame(centers: Centers, camera: Camera, frame: Frame | None) -> Centers:
    """Centres in square pixels about the principal point, or in the frame of the contour where one is given."""
    focal = float(np.sqrt(camera.focal_px.prod()))
    stretch = focal / camera.focal_px
    at = (centers.center_px - camera.principal_px) * stretch
    covariance = None if centers.covariance_px2 is None else centers.covariance_px2 * np.outer(stretch, stretch)
    if frame is None:
        return Centers(centers.ids, at, covariance)
    steps = FRAME_STEP_PX * np.eye(2)
    by = np.stack([(frame(at + s) - frame(at - s)) / (2 * FRAME_STEP_PX) for s in steps], axis=-1)
    turned = None if covariance is None else by @ covariance @ np.swapaxes(by, 1, 2)
    return Centers(centers.ids, frame(at), turned)


def _of_lab(lab: PointCloud, ids: Ints) -> tuple[Array, Array]:
    """Positions and normals (T, 3) of the targets named."""
    order = np.argsort(lab.ids)
    row = order[np.searchsorted(lab.ids, ids, sorter=order)]
    return lab.position_mm[row], lab.normal[row]


def _pitch(place_mm: Array) -> float:
    """The usual distance from a target to the next."""
    return float(np.median(cKDTree(place_mm).query(place_mm, k=2)[0][:, 1]))
