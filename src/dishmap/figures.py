"""A difference in a few numbers, and two methods beside each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.compare import Difference, DifferenceTable
from dishmap.errors import MeasurementError

Array = NDArray[np.float64]


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
class Apart:
    """How far two methods disagree over the targets that both give: root mean squares in mm."""

    targets: int
    displacement_rms_mm: float
    depth_change_rms_mm: float
    shape_rms_mm: float


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
