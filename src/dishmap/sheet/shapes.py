"""What stands on a page: ink, lines and words, in millimetres, x to the right and y up from the page's lower left corner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Thin enough to cut along, thick enough for any printer.
LINE_MM = 0.15


def _no_points() -> Array:
    return np.zeros((0, 2))


@dataclass(frozen=True)
class Ink:
    """Black areas as one path: circles center_mm (C, 2), radius_mm (C,), and closed polygons (P, 2).

    What lies inside an even number of them is not printed, so that a circle in a circle makes a ring and nothing white is painted.
    """

    center_mm: Array = field(default_factory=_no_points)
    radius_mm: Array = field(default_factory=lambda: np.zeros(0))
    polygons_mm: tuple[Array, ...] = ()
    name: str = ""

    def moved(self, shift_mm: Array) -> Ink:
        """The same ink elsewhere."""
        return Ink(self.center_mm + shift_mm, self.radius_mm, tuple(p + shift_mm for p in self.polygons_mm), self.name)


@dataclass(frozen=True)
class Line:
    """A thin line through points (N, 2)."""

    points_mm: Array
    width_mm: float = LINE_MM

    def moved(self, shift_mm: Array) -> Line:
        """The same line elsewhere."""
        return Line(self.points_mm + shift_mm, self.width_mm)


@dataclass(frozen=True)
class Words:
    """A line of text that begins at at_mm (2,), with letters of this height; `upwards` runs it from the bottom to the top."""

    at_mm: Array
    text: str
    height_mm: float = 2.5
    upwards: bool = False

    def moved(self, shift_mm: Array) -> Words:
        """The same words elsewhere."""
        return Words(self.at_mm + shift_mm, self.text, self.height_mm, self.upwards)


Shape = Ink | Line | Words


@dataclass(frozen=True)
class Group:
    """Shapes of which only what lies in clip_mm (left, bottom, right, top) and within outline_mm (m, 2) is printed; None prints all."""

    shapes: tuple[Shape, ...]
    clip_mm: tuple[float, float, float, float] | None = None
    outline_mm: Array | None = None


@dataclass(frozen=True)
class Page:
    """A sheet of paper and what is on it."""

    name: str
    width_mm: float
    height_mm: float
    groups: tuple[Group, ...]


def cross(at_mm: Array, arm_mm: float) -> tuple[Line, Line]:
    """Two lines that cross at a point (2,)."""
    return tuple(Line(np.array([at_mm - arm, at_mm + arm])) for arm in (np.array([arm_mm, 0.0]), np.array([0.0, arm_mm])))  # type: ignore[return-value]


def edge_points(inks: Sequence[Ink], step_mm: float) -> Array:
    """Points (N, 2) along the edges of polygons, no farther apart than a step."""
    found = [_no_points()]
    for polygon in (polygon for ink in inks for polygon in ink.polygons_mm):
        for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
            count = max(1, int(np.ceil(np.linalg.norm(b - a) / step_mm)))
            found.append(a + (b - a) * (np.arange(count) / count)[:, None])
    return np.concatenate(found)
