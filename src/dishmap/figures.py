"""A map or a difference in a few numbers, and two methods beside each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.compare import Difference, DifferenceTable
from dishmap.difference.changes import rigid_columns
from dishmap.errors import MeasurementError
from dishmap.pipeline import Map
from dishmap.quality import Quality
from dishmap.targets.pose import TargetPoses

Array = NDArray[np.float64]

# The undeformed pattern is off by its shape where it is off by this much more than all else leaves.
SHAPE_SHOWS = 2.0


@dataclass(frozen=True)
class Figures:
    """One table in a few numbers: root mean squares over its targets, in mm, and the largest change of shape; sigmas NaN if unknown."""

    targets: int
    displacement_rms_mm: float
    sigma_displacement_rms_mm: float
    depth_change_rms_mm: float
    sigma_depth_change_rms_mm: float
    shape_rms_mm: float
    sigma_shape_rms_mm: float
    largest_shape_mm: float
    largest_shape_id: int


@dataclass(frozen=True)
class Reprojection:
    """How well the places of a grid's clean targets are explained: root mean square distances in the photograph, px.

    smooth_rms_px: from the smooth surface through the targets; rigid_rms_px: from the undeformed pattern in its best rigid pose. noise_px,
    printing_px, calibration_px (NaN if unknown): what the photograph's noise, printing errors and the error of the calibration (without
    what a rigid motion explains) would leave. smooth_limit, rigid_limit: which of them is largest, or `shape` where the surface's own shape
    explains most.
    """

    smooth_rms_px: float
    rigid_rms_px: float
    noise_px: float
    printing_px: float
    calibration_px: float
    smooth_limit: str
    rigid_limit: str


@dataclass(frozen=True)
class Apart:
    """How far two methods disagree over the targets that both give: root mean squares in mm."""

    targets: int
    displacement_rms_mm: float
    depth_change_rms_mm: float
    shape_rms_mm: float


def reprojection_of(result: Map) -> Reprojection | None:
    """How well places of a grid are explained; None for targets made of circles, and for the paper's method."""
    poses = result.poses
    if not isinstance(poses, TargetPoses) or poses.sheet is None:
        return None
    clean = poses.quality == 0
    used = clean if clean.any() else (poses.quality & int(Quality.OUTLIER)) == 0
    sheet, calibration = poses.sheet, _calibration_px(result.camera, poses.position_mm[used])
    known = {"noise": sheet.noise_rms_px, "printing": sheet.print_rms_px}
    smooth_limit = max(known, key=known.__getitem__)
    known["calibration"] = calibration if np.isfinite(calibration) else 0.0
    expected = float(np.sqrt(sum(part**2 for part in known.values())))
    limit = "shape" if sheet.rigid_rms_px > SHAPE_SHOWS * max(expected, sheet.fit_rms_px) else max(known, key=known.__getitem__)
    return Reprojection(sheet.fit_rms_px, sheet.rigid_rms_px, sheet.noise_rms_px, sheet.print_rms_px, calibration, smooth_limit, limit)


def _calibration_px(camera: Camera, position_mm: Array) -> float:
    """Root mean square error of the images of points (N, 3) by the camera's calibration, what a rigid motion of them explains left out."""
    if camera.covariance is None:
        return float("nan")
    _, by_point, by_parameter = camera.project_with_jacobians(position_mm)
    motion = (by_point @ rigid_columns(position_mm - position_mm.mean(axis=0))).reshape(-1, 6)
    change = by_parameter.reshape(len(motion), -1)
    scale = np.linalg.norm(motion, axis=0)
    change = change - motion @ (np.linalg.lstsq(motion / scale, change, rcond=None)[0] / scale[:, None])
    return float(np.sqrt(np.einsum("ni,ij,nj->", change, camera.covariance, change) / len(position_mm)))


def figures_of(table: DifferenceTable) -> Figures:
    """The few numbers of a table, which must have a row."""
    largest = int(np.argmax(np.abs(table.shape_mm)))
    return Figures(
        targets=len(table),
        displacement_rms_mm=_rms(table.displacement_mm),
        sigma_displacement_rms_mm=_rms(table.sigma_displacement_mm),
        depth_change_rms_mm=_rms(table.depth_change_mm),
        sigma_depth_change_rms_mm=_rms(table.sigma_depth_change_mm),
        shape_rms_mm=_rms(table.shape_mm),
        sigma_shape_rms_mm=_rms(table.sigma_shape_mm),
        largest_shape_mm=float(table.shape_mm[largest]),
        largest_shape_id=int(table.ids[largest]),
    )


def apart(one: DifferenceTable, other: DifferenceTable) -> Apart:
    """How far two tables disagree. Raises MeasurementError when they have no target in common."""
    ids, a, b = np.intersect1d(one.ids, other.ids, return_indices=True)
    if not len(ids):
        raise MeasurementError("the two methods have no target in common")
    return Apart(
        targets=len(ids),
        displacement_rms_mm=_rms(one.displacement_mm[a] - other.displacement_mm[b]),
        depth_change_rms_mm=_rms(one.depth_change_mm[a] - other.depth_change_mm[b]),
        shape_rms_mm=_rms(one.shape_mm[a] - other.shape_mm[b]),
    )


def distance_mm(result: Difference) -> float:
    """Mean distance of the targets from the camera along its axis, in the reference: what expansion is confused with, per unit."""
    return float(result.reference.camera_from_dish.apply(result.table.nominal_mm)[:, 2].mean())


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
