"""Places on a pattern's surface: where rays meet it, and which mark is there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.layout import Layout
from dishmap.targets.pattern import Surface

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MOST_CELLS = 2_000_000
# Farther than any pattern reaches.
NOWHERE_MM = 1e7


def meet_surface(surface: Surface, origin: Array, ray: Array) -> Array:
    """Distance (...) along unit rays (..., 3) from origins (..., 3) to the front of the nominal surface; NaN where there is none.

    Origins and rays in the dish frame. z = curvature * (x^2 + y^2) is a quadratic equation along the ray, and of its two
    solutions the one where the ray falls on the front is meant.
    """
    curvature = 0.0 if surface.kind == "plane" or surface.focal_length_mm is None else 1 / (4 * surface.focal_length_mm)
    a = curvature * (ray[..., 0] ** 2 + ray[..., 1] ** 2)
    b = 2 * curvature * (origin[..., 0] * ray[..., 0] + origin[..., 1] * ray[..., 1]) - ray[..., 2]
    c = curvature * (origin[..., 0] ** 2 + origin[..., 1] ** 2) - origin[..., 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(b * b - 4 * a * c)
        # each form is exact where the other loses digits or divides by zero
        t = np.where(b > 0, -2 * c / (b + root), (root - b) / (2 * a))
        return np.where((t > 0) & (t < NOWHERE_MM), t, np.nan)


class MarkGrid:
    """The mark near a place, looked up in a raster of x and y, in which marks stand apart by several cells."""

    def __init__(self, layout: Layout, reach_mm: float) -> None:
        self.layout, self.reach = layout, reach_mm
        low, high = layout.center_mm[:, :2].min(axis=0) - 2 * reach_mm, layout.center_mm[:, :2].max(axis=0) + 2 * reach_mm
        self.cell = max(reach_mm / 2, float(np.sqrt(np.prod(high - low) / MOST_CELLS)))
        self.low = low
        self.shape = np.ceil((high - low) / self.cell).astype(int) + 1
        self.table = np.full(self.shape[0] * self.shape[1], -1)
        home = np.floor((layout.center_mm[:, :2] - low) / self.cell).astype(int)
        steps = int(np.ceil(reach_mm / self.cell)) + 1
        offsets = np.stack(np.meshgrid(np.arange(-steps, steps + 1), np.arange(-steps, steps + 1)), axis=-1).reshape(-1, 2)
        # the nearest cells last, so that they stay
        for offset in offsets[np.argsort(-np.abs(offsets).max(axis=1))]:
            cells = home + offset
            good = ((cells >= 0) & (cells < self.shape)).all(axis=1)
            self.table[cells[good, 0] * self.shape[1] + cells[good, 1]] = np.flatnonzero(good)

    def nearest(self, places_mm: Array) -> Index:
        """The mark within reach of each place (..., 3), or -1; also where a place is NaN."""
        places_mm = np.nan_to_num(places_mm, nan=NOWHERE_MM).clip(-NOWHERE_MM, NOWHERE_MM)
        cells = np.floor((places_mm[..., :2] - self.low) / self.cell)
        inside = ((cells >= 0) & (cells < self.shape)).all(axis=-1)
        flat = np.where(inside, cells[..., 0] * self.shape[1] + cells[..., 1], 0).astype(np.int64)
        mark = np.where(inside, self.table[flat], -1)
        far = ((places_mm - self.layout.center_mm[mark]) ** 2).sum(axis=-1) > self.reach**2
        return np.where(far, -1, mark)
