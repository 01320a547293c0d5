"""How the targets of a grid are drawn over the photograph: outlines of squares, or small crosses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.pipeline import Map
from dishmap.targets.grid_detect import GridDetections
from dishmap.targets.grid_identify import GridIdentity
from dishmap.targets.grid_map import local_map
from dishmap.targets.grid_walk import SURE, table_of
from dishmap.targets.pose import TargetPoses

Array = NDArray[np.float64]

# Corners of a square and arms of a crossing, in halves of its size along columns and rows; the size of a cross, in steps.
OUTLINE = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [1.0, 1.0]])
ARMS = np.array([[[-1.0, 0.0], [1.0, 0.0]], [[0.0, -1.0], [0.0, 1.0]]])
CROSS = 0.5
# Targets that were not seen are drawn where their neighbours, up to so many columns and rows away, predict them.
FARTHEST = 2


def grid_shapes(result: Map) -> tuple[Array, list[tuple[Array, ...]]]:
    """Places (N, 2) of all targets of a grid, NaN where nothing says where they are, and the strokes of each, in pixels.

    Measured targets are drawn where they were measured, others where they were found, or where their neighbours predict them: a flat
    pattern may be wrapped round anything, so that its rigid pose says little of places.
    """
    found, identity, lattice = result.detections, result.identity, result.pattern.lattice
    assert isinstance(found, GridDetections)
    assert isinstance(identity, GridIdentity)
    assert lattice is not None
    place = np.full((len(lattice), 2), np.nan)
    step = np.zeros((len(lattice), 2, 2))
    place[identity.index], step[identity.index] = found.place_px[identity.detection], found.step_px[identity.detection]
    table, low = table_of(place[identity.index], lattice[identity.index], FARTHEST)
    unseen = np.flatnonzero(np.isnan(place[:, 0]))
    at = lattice[unseen] - low
    inside = ((at >= 0) & (at < table.shape[:2])).all(axis=1)
    unseen, at = unseen[inside], at[inside]
    predicted = local_map(table, at)
    sure = predicted.sigma < SURE
    place[unseen[sure]], step[unseen[sure]] = predicted.place_px[sure], predicted.step_px[sure]
    place[result.poses.index] = result.cloud.center_px
    return place, node_strokes(result, place, step)


def node_strokes(result: Map, place_px: Array, step_px: Array) -> list[tuple[Array, ...]]:
    """Strokes of nodes at places (K, 2) with steps of the lattice (K, 2, 2)."""
    pattern = result.pattern
    if pattern.lines:
        shapes, part = ARMS, CROSS
    else:
        shapes, part = OUTLINE[None], _side_mm(result) / _pitch_mm(result)
    ends = place_px[:, None, None] + 0.5 * part * np.einsum("nij,spj->nspi", step_px, shapes)
    return [tuple(strokes) for strokes in ends]


def _side_mm(result: Map) -> float:
    """The side of squares as measured, or else as printed."""
    if isinstance(result.poses, TargetPoses) and result.poses.sheet is not None:
        return result.poses.sheet.measured_side_mm
    return 2 * float(np.median([np.abs(kind.polygons[0].corners_mm).max() for kind in result.pattern.kinds.values()]))


def _pitch_mm(result: Map) -> float:
    """The usual distance to the next target, along the surface or nearly so."""
    center = result.pattern.center_mm
    return float(np.median(cKDTree(center).query(center, k=2)[0][:, 1]))
