"""Where the printed lines of a grid run on the nominal surface.

A line's middle is a smooth curve through its targets: a cubic spline of their flat coordinates (`targets.flat`) over the steps of the
lattice, going on straight beyond both ends. Lattices that are straight on the paper, as those of `builders`, are met exactly. The
line has its width along the surface, at right angles to its middle.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from dishmap.errors import PatternError
from dishmap.targets.flat import from_flat_mm, to_flat_mm
from dishmap.targets.pattern import GridLine, Pattern, bent_print_mm

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Tangents are central differences over this part of a lattice step: right to 1e-8.
TANGENT_STEP = 1e-4
# Rounds that bring a line's end to its length beyond the last target: each gains two digits or more.
END_ROUNDS = 6


class GridLines:
    """All lines of a grid as curves; a place on one is (line, t, across).

    line: index into `pattern.lines`; t: steps of the lattice from the line's first target; across_mm: to the left of the line's
    way as seen from the front, along the surface. target_t: for each line, t of its targets, in their order; start_t and stop_t (L,): where
    lines end, overhang included; crossing_line and crossing_t (N, 2): line and t that go through each target, first the line along
    which the lattice's column changes. Raises PatternError for a pattern without lines.
    """

    def __init__(self, pattern: Pattern) -> None:
        if not pattern.lines or pattern.lattice is None:
            raise PatternError("the pattern has no lines; a grid of squares is printed target by target")
        self.pattern = pattern
        self._row = {int(i): k for k, i in enumerate(pattern.ids)}
        self._flat = to_flat_mm(pattern.surface, pattern.center_mm[:, :2])
        self._off = pattern.center_mm[:, 2] - pattern.surface.height_mm(pattern.center_mm[:, :2])
        self.target_t = tuple(self._steps(line) for line in pattern.lines)
        self._last_t = np.array([t[-1] for t in self.target_t])
        self._lay()
        overhang = np.array([line.overhang_mm for line in pattern.lines])
        every = np.arange(len(pattern.lines))
        self.start_t = self._beyond(every, np.zeros(len(every)), -overhang)
        self.stop_t = self._beyond(every, self._last_t, overhang)

    @cached_property
    def width_mm(self) -> Array:
        """Widths of the lines (L,)."""
        return np.array([line.width_mm for line in self.pattern.lines])

    @cached_property
    def _crossings(self) -> tuple[Index, Array]:
        through: list[list[tuple[bool, int, float]]] = [[] for _ in range(len(self.pattern))]
        for number, line in enumerate(self.pattern.lines):
            rows = [self._row[i] for i in line.ids]
            move = np.abs(np.diff(self._lattice[rows], axis=0)).sum(axis=0)
            for row, t in zip(rows, self.target_t[number].tolist(), strict=True):
                through[row].append((bool(move[1] > move[0]), number, t))
        pairs = [sorted(two) for two in through]
        line_index = np.array([[number for _, number, _ in two] for two in pairs])
        return line_index, np.array([[t for _, _, t in two] for two in pairs])

    @property
    def crossing_line(self) -> Index:
        """The two lines through each target (N, 2)."""
        return self._crossings[0]

    @property
    def crossing_t(self) -> Array:
        """Where on these two lines each target lies (N, 2)."""
        return self._crossings[1]

    def points_mm(self, line: ArrayLike, t: ArrayLike, across_mm: ArrayLike = 0.0) -> Array:
        """Points (..., 3) in the dish frame; line, t and across_mm broadcast to (...). NaN beyond a cylinder's facing half."""
        line, t, across = np.broadcast_arrays(np.asarray(line), np.asarray(t, dtype=float), np.asarray(across_mm, dtype=float))
        point, tangent = self._middle(line, t)
        if not across.any():
            return point
        surface, xy = self.pattern.surface, point[..., :2]
        normal = surface.normal(xy)
        # a line that leaves the nominal surface still has its width along it
        along = tangent - (tangent * normal).sum(axis=-1, keepdims=True) * normal
        along /= np.linalg.norm(along, axis=-1, keepdims=True)
        left = np.cross(normal, along)
        moves = np.stack([np.zeros_like(across), across], axis=-1)[..., None, :]
        local = bent_print_mm(moves, surface.curvature_per_mm(xy, along, left))[..., 0, :]
        return np.asarray(point + local[..., :1] * along + local[..., 1:2] * left + local[..., 2:] * normal)

    def tangent_mm(self, line: ArrayLike, t: ArrayLike) -> Array:
        """Derivatives (..., 3) of the middle of a line by t, in mm for a step of the lattice."""
        line, t = np.broadcast_arrays(np.asarray(line), np.asarray(t, dtype=float))
        return self._middle(line, t)[1]

    @property
    def _lattice(self) -> Index:
        assert self.pattern.lattice is not None
        return self.pattern.lattice

    def _steps(self, line: GridLine) -> Array:
        place = self._lattice[[self._row[i] for i in line.ids]]
        return np.concatenate([[0.0], np.cumsum(np.abs(np.diff(place, axis=0)).max(axis=1))])

    def _lay(self) -> None:
        """Put the splines of all lines end to end, so that any points of any lines are found at once."""
        self._span = 2.0 + self._last_t.max()
        breaks, pieces = [], []
        for number, (line, knots) in enumerate(zip(self.pattern.lines, self.target_t, strict=True)):
            rows = [self._row[i] for i in line.ids]
            spline = CubicSpline(knots, np.column_stack([self._flat[rows], self._off[rows]]))
            breaks.append(knots[:-1] + number * self._span)
            pieces.append(np.moveaxis(spline.c, 1, 0))
        self._breaks, self._pieces = np.concatenate(breaks), np.concatenate(pieces)

    def _middle(self, line: Index, t: Array) -> tuple[Array, Array]:
        """Points and derivatives by t (..., 3) of the middles of lines."""
        place, change = self._spline(line, t)
        steps = TANGENT_STEP * np.array([-1.0, 0.0, 1.0])[(slice(None), *[None] * (place.ndim))]
        surface = self.pattern.surface
        flat = place + steps * change
        xy = from_flat_mm(surface, flat[..., :2])
        points = np.concatenate([xy, (surface.height_mm(xy) + flat[..., 2])[..., None]], axis=-1)
        return points[1], (points[2] - points[0]) / (2 * TANGENT_STEP)

    def _spline(self, line: Index, t: Array) -> tuple[Array, Array]:
        """Flat coordinates and rise over the surface (..., 3), and their derivatives; straight beyond the ends."""
        within = np.clip(t, 0.0, self._last_t[line])
        key = line * self._span + within
        piece = np.searchsorted(self._breaks, key, side="right") - 1
        x = (key - self._breaks[piece])[..., None]
        c3, c2, c1, c0 = np.moveaxis(self._pieces[piece], -2, 0)
        value, change = c0 + x * (c1 + x * (c2 + x * c3)), c1 + x * (2 * c2 + 3 * x * c3)
        return value + (t - within)[..., None] * change, change

    def _beyond(self, line: Index, t: Array, overhang_mm: Array) -> Array:
        """T at a way along the surface beyond t (L,)."""
        nodes, weights = np.polynomial.legendre.leggauss(4)
        end = t.copy()
        for _ in range(END_ROUNDS):
            at = t[:, None] + 0.5 * (nodes + 1) * (end - t)[:, None]
            speed = np.linalg.norm(self._middle(line[:, None], at)[1], axis=-1) @ (0.5 * weights)
            end = t + overhang_mm / speed
        return end
