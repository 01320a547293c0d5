"""What a grid's pattern file says is printed at each node, in lattice coordinates: bands of ink, how far they go, what else is near."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import PatternError
from dishmap.targets.pattern import Pattern, TargetKind

Array = NDArray[Any]
Index = NDArray[np.int64]

# Half a lattice step to each side is a node's own.
CELL = 0.5
# A line counts as along the lattice's rows or columns, and a rectangle as centred, to within this many mm.
TOLERANCE_MM = 1e-3


@dataclass(frozen=True)
class NodeShapes:
    """The print at N nodes as two bands: band 0 across b (along the columns' direction), band 1 across a.

    crossing: ink is the union of both bands (lines), else their intersection (a rectangle); half (N, 2): half the width of each band in
    lattice units; inner (N, 2): of the light rectangle nested in it, 0 where there is none; arms (N, 2, 2): how far each band goes to the
    negative and the positive side, infinite if it does not end there; boxes (N, B, 4): a from, a to, b from, b to of other ink nearby,
    NaN for none; pitch_mm (2,): of columns and of rows.
    """

    crossing: bool
    half: Array
    inner: Array
    arms: Array
    boxes: Array
    pitch_mm: Array

    def take(self, rows: Any) -> NodeShapes:
        """The shapes at some nodes."""
        return NodeShapes(self.crossing, self.half[rows], self.inner[rows], self.arms[rows], self.boxes[rows], self.pitch_mm)


def node_shapes(pattern: Pattern) -> NodeShapes:
    """Shapes at all targets of a grid pattern. Raises PatternError for a pattern without lattice, or with shapes that are not bands."""
    if pattern.lattice is None:
        raise PatternError("the pattern is no grid: its targets have no place in a lattice; give one made of squares or lines")
    pitch = _pitch_mm(pattern)
    if pattern.lines:
        half, arms = _lines(pattern, pitch)
        return NodeShapes(True, half, np.zeros_like(half), arms, _boxes(pattern, pitch), pitch)
    sizes = {name: _rectangles_mm(name, kind) for name, kind in pattern.kinds.items()}
    half, inner = (np.array([sizes[name][i] for name in pattern.kind_names]) / pitch[::-1] for i in (0, 1))
    return NodeShapes(False, half, inner, np.full((len(half), 2, 2), np.inf), np.full((len(half), 1, 4), np.nan), pitch)


def _pitch_mm(pattern: Pattern) -> Array:
    """Distance of next neighbours along columns' and rows' directions."""
    assert pattern.lattice is not None
    place = {tuple(key): i for i, key in enumerate(pattern.lattice.tolist())}
    out = []
    for da, db in ((1, 0), (0, 1)):
        pairs = [(i, place[a + da, b + db]) for (a, b), i in place.items() if (a + da, b + db) in place]
        lengths = [np.linalg.norm(pattern.center_mm[i] - pattern.center_mm[j]) for i, j in pairs]
        out.append(float(np.median(lengths)) if lengths else np.nan)
    if not np.isfinite(out).any():
        raise PatternError("no two targets of the pattern are neighbours in its lattice")
    return np.where(np.isfinite(out), out, np.nanmax(out))


def _rectangles_mm(name: str, kind: TargetKind) -> tuple[Array, Array]:
    """Half the sides (across b, across a) of a kind's dark rectangle and of the light one in it, 0 for none."""
    sizes = []
    for polygon in kind.polygons:
        reach = np.abs(polygon.corners_mm).max(axis=0)
        signs = np.array(sorted(map(tuple, np.sign(polygon.corners_mm))))
        square = len(polygon.corners_mm) == 4 and np.array_equal(signs, [[-1, -1], [-1, 1], [1, -1], [1, 1]])
        if not (square and np.abs(np.abs(polygon.corners_mm) - reach).max() < TOLERANCE_MM):
            raise PatternError(f"target kind {name!r} of the grid must be one rectangle along its axes, centred, or two nested")
        sizes.append(reach[::-1])
    if len(sizes) > 2 or not kind.polygons[0].dark or (len(sizes) == 2 and not (sizes[1] < sizes[0]).all()):
        raise PatternError(f"target kind {name!r} of the grid must be a dark rectangle, with at most one light rectangle inside")
    return sizes[0], sizes[1] if len(sizes) == 2 else np.zeros(2)


def _lines(pattern: Pattern, pitch_mm: Array) -> tuple[Array, Array]:
    assert pattern.lattice is not None
    half, arms = np.zeros((len(pattern), 2)), np.full((len(pattern), 2, 2), np.inf)
    row_of = {int(i): row for row, i in enumerate(pattern.ids)}
    for line in pattern.lines:
        rows = np.array([row_of[i] for i in line.ids])
        fixed = np.ptp(pattern.lattice[rows], axis=0) == 0
        if not fixed.any():
            raise PatternError(f"the line through target {line.ids[0]} runs neither along a row nor along a column of the lattice")
        # a line with its row fixed is a band across b
        band = 0 if fixed[1] else 1
        half[rows, band] = 0.5 * line.width_mm / pitch_mm[1 - band]
        order = np.argsort(pattern.lattice[rows, band])
        for side, end in ((0, order[0]), (1, order[-1])):
            arms[rows[end], band, side] = line.overhang_mm / pitch_mm[band]
    if not half.all():
        raise PatternError("at each target of a grid of lines one line must run along the row and one along the column")
    return half, arms


def _boxes(pattern: Pattern, pitch_mm: Array) -> Array:
    """Boxes of marks' ink near each node of a grid of lines."""
    assert pattern.lattice is not None
    place = {tuple(key): i for i, key in enumerate(pattern.lattice.tolist())}
    found: list[list[Array]] = [[] for _ in place]
    for i, name in enumerate(pattern.kind_names):
        for polygon in pattern.kinds[name].polygons:
            low, high = polygon.corners_mm.min(axis=0) / pitch_mm, polygon.corners_mm.max(axis=0) / pitch_mm
            # the nodes whose own cells the ink is in
            for a in range(int(np.ceil(low[0] - CELL)), int(np.floor(high[0] + CELL)) + 1):
                for b in range(int(np.ceil(low[1] - CELL)), int(np.floor(high[1] + CELL)) + 1):
                    node = place.get((pattern.lattice[i, 0] + a, pattern.lattice[i, 1] + b))
                    if node is not None:
                        found[node].append(np.array([low[0] - a, high[0] - a, low[1] - b, high[1] - b]))
    out = np.full((len(found), max(1, *(len(boxes) for boxes in found)), 4), np.nan)
    for node, boxes in enumerate(found):
        out[node, : len(boxes)] = boxes or out[node, :0]
    return out
