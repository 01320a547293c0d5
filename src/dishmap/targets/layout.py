"""A pattern's marks as the search needs them: neighbours of each mark, in its own plane, and their spacing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.targets.pattern import Pattern, Surface

Array = NDArray[np.float64]
Index = NDArray[np.int64]

NEIGHBOURS = 16


@dataclass(frozen=True)
class Layout:
    """Marks of a pattern (K) with their neighbours (K, N), nearest first.

    center_mm (K, 3), axes (K, 3, 3) x, y and normal, radius_mm, type_index, target (K,); neighbour (K, N): indices, -1 where
    the pattern has fewer; offset_mm (K, N, 2): neighbours in the mark's own plane; spacing_mm (K,): to the nearest mark; pitch_mm:
    from target to target, in the median; surface: the nominal one.
    """

    center_mm: Array
    axes: Array
    radius_mm: Array
    type_index: Index
    target: Index
    neighbour: Index
    offset_mm: Array
    spacing_mm: Array
    pitch_mm: float
    surface: Surface

    def __len__(self) -> int:
        return len(self.center_mm)


def layout_of(pattern: Pattern) -> Layout:
    """Make the layout of a pattern."""
    marks = pattern.marks
    k = len(marks.radius_mm)
    axes = pattern.axes[marks.target]
    count = min(NEIGHBOURS, k - 1)
    neighbour = np.full((k, NEIGHBOURS), -1)
    offset = np.full((k, NEIGHBOURS, 2), np.nan)
    spacing = 4 * marks.radius_mm
    if count:
        distance, index = cKDTree(marks.center_mm).query(marks.center_mm, k=count + 1)
        neighbour[:, :count] = index[:, 1:]
        relative = marks.center_mm[index[:, 1:]] - marks.center_mm[:, None]
        offset[:, :count] = relative @ axes[:, :, :2]
        spacing = distance[:, 1]
    return Layout(
        marks.center_mm,
        axes,
        marks.radius_mm,
        marks.type_index,
        marks.target,
        neighbour,
        offset,
        spacing,
        _pitch(pattern, spacing),
        pattern.surface,
    )


def _pitch(pattern: Pattern, spacing: Array) -> float:
    """Median distance of a target to the nearest other one; of marks, if there is one target only."""
    if len(pattern) < 2:
        return float(np.median(spacing))
    distance, _ = cKDTree(pattern.center_mm).query(pattern.center_mm, k=2)
    return float(np.median(distance[:, 1]))
