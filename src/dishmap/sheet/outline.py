"""What tells people where to cut and which piece is which: outlines with tabs around targets that an edge meets, and names."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.sheet.pieces import TAB_MM, Piece
from dishmap.sheet.shapes import Line, Words, edge_points

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

TAB_POINTS = 73
# Letters of a piece's name, the step of the search for a free place for it, and free paper around it.
NAME_MM, NAME_STEP_MM, NAME_MARGIN_MM = 2.0, 3.0, 1.0
# Between the lines of a grid there may be room for small letters only.
SMALL_NAMES_MM = (1.3, 0.9)
# Width of a letter over its height in Helvetica, for the longest of words.
LETTER_WIDTH = 0.8


def cut_lines(outline_mm: Array, keep_mm: Array) -> list[Line]:
    """Lines along an outline (m, 2), closed, and around every one of keep_mm (k, 3: x, y, radius) that reaches over it."""
    closed = np.concatenate([outline_mm, outline_mm[:1]])
    near = np.linalg.norm(keep_mm[:, None, :2] - closed[None], axis=-1).min(axis=1, initial=np.inf) < keep_mm[:, 2]
    tabs = keep_mm[near] + np.array([0.0, 0.0, TAB_MM])
    lines = _runs(closed, ~_in_circles(closed, tabs))
    angle = np.linspace(0, 2 * np.pi, TAB_POINTS)
    for number, (x, y, radius) in enumerate(tabs):
        circle = np.array([x, y]) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        others = np.delete(tabs, number, axis=0)
        lines += _runs(circle, ~inside(circle, outline_mm) & ~_in_circles(circle, others))
    return lines


def name_words(piece: Piece, low: Array, high: Array) -> list[Words]:
    """The piece's name at a free place inside its outline and within the box low, high (2,); nothing where there is none."""
    if piece.outline_mm is None:
        return []
    sizes = (NAME_MM, *SMALL_NAMES_MM) if piece.lines else (NAME_MM,)
    return next((words for size in sizes if (words := _name_words(piece, low, high, size))), [])


def _name_words(piece: Piece, low: Array, high: Array, size_mm: float) -> list[Words]:
    """The name in letters of this height where there is room for them."""
    assert piece.outline_mm is not None
    width = LETTER_WIDTH * size_mm * len(piece.name)
    first, last = low + NAME_MARGIN_MM, high - NAME_MARGIN_MM - np.array([width, size_mm])
    x, y = (np.arange(a, b, NAME_STEP_MM) for a, b in zip(first, last, strict=True))
    if not (len(x) and len(y)):
        return []
    corner = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    # between lines the box must be looked at closely
    along = np.linspace(0, 1, 25 if piece.lines else 5)
    box = np.stack(np.meshgrid(along * width, np.array([0.0, 1.0]) * size_mm), axis=-1).reshape(-1, 2)
    points = corner[:, None] + box
    marks = np.concatenate([piece.outline_mm, *(line.points_mm for line in piece.extra if isinstance(line, Line))])
    free = cKDTree(marks).query(points.reshape(-1, 2))[0].reshape(points.shape[:2]).min(axis=1) > NAME_MARGIN_MM
    edges = edge_points(piece.lines, NAME_MARGIN_MM / 2)
    if len(edges):
        free &= cKDTree(edges).query(points.reshape(-1, 2))[0].reshape(points.shape[:2]).min(axis=1) > NAME_MARGIN_MM / 2
    for x_mm, y_mm, radius in piece.keep_mm:
        free &= np.linalg.norm(points - np.array([x_mm, y_mm]), axis=-1).min(axis=1) > radius + NAME_MARGIN_MM
    free[free] = inside(points[free].reshape(-1, 2), piece.outline_mm).reshape(-1, len(box)).all(axis=1)
    if not free.any():
        return []
    best = corner[free][np.argmin(np.linalg.norm(corner[free] - piece.anchor_mm, axis=1))]
    return [Words(best, piece.name, size_mm)]


def inside(points: Array, polygon: Array) -> Flags:
    """Whether points (N, 2) lie inside a closed polygon (m, 2): an odd number of its edges are to their right."""
    x, y = points[:, 0][:, None], points[:, 1][:, None]
    (x1, y1), (x2, y2) = polygon.T, np.roll(polygon, -1, axis=0).T
    between = (y1 > y) != (y2 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = x1 + (y - y1) / (y2 - y1) * (x2 - x1)
    return np.asarray((between & (x < crossing)).sum(axis=1) % 2 == 1)


def _in_circles(points: Array, circles: Array) -> Flags:
    if not len(circles):
        return np.zeros(len(points), dtype=bool)
    return np.asarray((np.linalg.norm(points[:, None] - circles[:, :2], axis=-1) < circles[:, 2]).any(axis=1))


def _runs(points: Array, shown: Flags) -> list[Line]:
    """The shown stretches of a line through points."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], shown, [False]]).astype(int)))
    return [Line(points[a:b]) for a, b in edges.reshape(-1, 2) if b - a > 1]
