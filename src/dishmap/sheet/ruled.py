"""The lines of a grid on paper: strips along their edges, laid flat as the piece is that they are printed on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dishmap.sheet.outline import inside
from dishmap.sheet.pieces import BORDER_MM, Piece
from dishmap.sheet.shapes import Ink
from dishmap.targets.gridlines import GridLines
from dishmap.targets.pattern import Pattern

Array = NDArray[np.float64]

# Corners along an edge, in steps of the lattice: a chord of 3 mm is off by 0.1 micrometres at the edge of a gore.
STEP = 0.25


def with_lines(piece: Piece, pattern: Pattern, ground_mm: Array | None = None) -> Piece:
    """The piece with a grid's lines, if the pattern has any.

    ground_mm: the piece's outline (m, 2) on the surface, seen along the axis: only lines over it are drawn, a little beyond it too, since
    they are cut off at the outline; None draws all and makes the piece as large as they are.
    """
    if not pattern.lines:
        return piece
    lines = GridLines(pattern)
    inks = []
    for number in range(len(pattern.lines)):
        start, stop = lines.start_t[number], lines.stop_t[number]
        t = np.concatenate([[start], np.arange(np.floor(start / STEP) + 1, np.ceil(stop / STEP)) * STEP, [stop]])
        for again, run in enumerate(_runs(lines.points_mm(number, t)[:, :2], ground_mm)):
            half = lines.width_mm[number] / 2
            edges = [lines.points_mm(number, t[run], across)[:, :2] for across in (-half, half)]
            name = f"line-{number}" + ("" if ground_mm is None else f"-{piece.name.replace(' ', '-')}" + f"-{again}" * bool(again))
            inks.append(Ink(polygons_mm=(piece.map.to_flat(np.concatenate([edges[0], edges[1][::-1]])),), name=name))
    if ground_mm is not None:
        return replace(piece, lines=tuple(inks))
    corners = np.concatenate([ink.polygons_mm[0] for ink in inks])
    low, high = np.minimum(piece.low_mm, corners.min(axis=0) - BORDER_MM), np.maximum(piece.high_mm, corners.max(axis=0) + BORDER_MM)
    return replace(piece, lines=tuple(inks), low_mm=low, high_mm=high)


def _runs(points: Array, ground: Array | None) -> list[slice]:
    """Stretches of points (K, 2) over the ground, each with one point more at either end."""
    if ground is None:
        return [slice(None)]
    over = np.concatenate([[False], inside(points, ground), [False]])
    # two points beyond the outline on either side of a short gap are one stretch
    over[1:-1] |= over[:-2] | over[2:]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], over[1:-1], [False]]).astype(int)))
    return [slice(a, b) for a, b in edges.reshape(-1, 2) if b - a > 1]
