"""The joint bound: how well two photographs can show the shape of a surface's change, whatever the method.

From the same Fisher information as the estimate (all pixels near the edges, light, blur and offsets unknown), for a stated model of the
change. For a linear Gaussian model the Cramer-Rao bound is the posterior covariance at the true sizes of the priors, and is reached.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.camera.model import Camera
from dishmap.difference.changes import TargetChanges, changed_information, rigid_columns
from dishmap.difference.joint import Evidence, Sizes, posterior
from dishmap.difference.model import WAYS, columns_of, smooth_kernel, surfaces_of
from dishmap.difference.response import pose_response
from dishmap.errors import InputError
from dishmap.targets.bound import pattern_information
from dishmap.targets.grid_bound import grid_information
from dishmap.targets.pattern import Pattern
from dishmap.targets.stages import Assumptions
from dishmap.transforms import Pose

Array = NDArray[Any]

# Far wider than any spread of normals about the pattern's surface that a reference has.
NORMAL_SIGMA_RAD = np.radians(2.0)


def change_information(
    camera: Camera, pattern: Pattern, index: NDArray[np.int64], camera_from_dish: Pose, contrast_to_noise: float, psf_sigma_px: float
) -> Array:
    """Fisher information (N, 6, 6) of two equal photographs on the change of each target, its own pose and ink spread unknown.

    Raises MeasurementError for a grid of which `index` holds no neighbours in two directions.
    """
    of_one = grid_information if pattern.is_grid else pattern_information
    one = of_one(camera, pattern, index, camera_from_dish, contrast_to_noise, psf_sigma_px)
    return information_of_two(pattern, index, one, NORMAL_SIGMA_RAD, Assumptions())


def information_of_two(pattern: Pattern, index: NDArray[np.int64], one: Array, normal_sigma_rad: float, assumptions: Assumptions) -> Array:
    """`change_information` from that of one photograph (N, 7, 7); normal_sigma_rad: what is known of normals beforehand.

    Targets of grids have no priors of their own, as in `targets.grid_poses`.
    """
    prior = np.zeros((len(index), 7))
    if not pattern.is_grid:
        largest = np.array([pattern.kind_of(int(i)).radius_mm.max() for i in index])
        prior[:, 3:5] = normal_sigma_rad**-2.0
        prior[:, 6] = (assumptions.ink_spread_fraction * largest) ** -2.0
    return changed_information(one, one, prior)


def joint_bound(
    camera: Camera,
    pattern: Pattern,
    camera_from_dish: Pose,
    contrast_to_noise: float,
    psf_sigma_px: float,
    amplitude_mm: float,
    length_mm: float,
    way: str = "least_strain",
    strain: float = 0.0,
    index: ArrayLike | None = None,
) -> tuple[Array, Array]:
    """Least standard deviations (N,) in mm of the shape (rigid motion removed) and of the total displacement along the normal.

    For a smooth displacement of standard deviation `amplitude_mm` and correlation length `length_mm`, followed as `way` says, with
    prints that stretch on their own by `strain`; camera motion free. index (N,): the targets that are seen, all by default. Raises
    InputError for an unknown way.
    """
    seen = np.arange(len(pattern)) if index is None else np.asarray(index, dtype=np.int64)
    information = change_information(camera, pattern, seen, camera_from_dish, contrast_to_noise, psf_sigma_px)
    return shape_bound(camera, pattern, seen, camera_from_dish, information, amplitude_mm, length_mm, way, strain)


def shape_bound(
    camera: Camera,
    pattern: Pattern,
    index: NDArray[np.int64],
    camera_from_dish: Pose,
    information: Array,
    amplitude_mm: float,
    length_mm: float,
    way: str,
    strain: float = 0.0,
) -> tuple[Array, Array]:
    """`joint_bound` of targets number `index` (N,) whose changes are known with a given information (N, 6, 6)."""
    if way not in WAYS:
        raise InputError(f"unknown slide {way!r}; use one of {', '.join(WAYS)}")
    changes = blank_changes(camera, pattern, index, camera_from_dish, information)
    surfaces = surfaces_of(pattern, index)
    columns = columns_of(changes, pattern, camera, camera_from_dish, surfaces, smooth_kernel(surfaces, length_mm), way)
    evidence = Evidence(information, changes.score, 0.0, columns, length_mm, np.zeros(0, np.int64), np.zeros(len(index), bool))
    found = posterior(evidence, Sizes(amplitude_mm, 0.0, 0.0, strain))
    factor = (columns.move + columns.local_move @ found.local_by) @ found.factor
    normal, own = pattern.normal[index], found.local_covariance[:, 0, 0]
    return _along(without_rigid(factor, pattern.center_mm[index]), normal, own), _along(factor, normal, own)


def _along(factor: Array, normal: Array, own: Array) -> Array:
    return np.sqrt((np.einsum("ni,nik->nk", normal, factor) ** 2).sum(axis=1) + own)


def without_rigid(displacement: Array, points: Array) -> Array:
    """Displacements (N, 3, K) of points (N, 3) less their best-fit rigid motion."""
    flat = rigid_columns(points).reshape(-1, 6)
    solved = np.linalg.lstsq(flat, displacement.reshape(len(flat), -1), rcond=None)[0]
    return np.asarray(displacement - (flat @ solved).reshape(displacement.shape))


def blank_changes(camera: Camera, pattern: Pattern, index: NDArray[np.int64], camera_from_dish: Pose, information: Array) -> TargetChanges:
    """Changes of zero with a given information (N, 6, 6), for targets where the undeformed pattern lies."""
    count = len(index)
    by_camera, by_strain = pose_response(camera, pattern, index, camera_from_dish)
    return TargetChanges(
        index=index,
        ids=pattern.ids[index],
        rotation=camera_from_dish.rotation @ pattern.axes[index],
        information=information,
        score=np.zeros((count, 6)),
        by_strain=by_strain,
        by_focal=-by_camera[..., :2] @ camera.parameters[:2],
        by_calibration=np.zeros_like(by_camera),
        moved=Pose.identity(),
        position_mm=camera_from_dish.apply(pattern.center_mm[index]),
        du_dv_px=np.zeros((count, 2)),
        covariance_du_dv_px2=np.zeros((count, 2, 2)),
        quality=np.zeros(count, np.int64),
    )
