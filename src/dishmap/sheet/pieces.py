"""A piece of flat paper: the targets on it, its outline, and how it goes back onto the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.sheet.flatten import FlatMap
from dishmap.sheet.shapes import Ink, Shape
from dishmap.targets.pattern import Pattern, bent_print_mm

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Free paper around what is printed on a piece without an outline of its own.
BORDER_MM = 4.0
# Paper around a target that reaches over an edge, which is cut out with it as a tab.
TAB_MM = 1.5


@dataclass(frozen=True)
class Piece:
    """Flat paper with targets, in its own millimetres.

    target (n,): indices into the pattern; center_mm (n, 2), angle_rad (n,) of their x axes from the paper's x; stretch (n,): length
    on the surface over length on the paper, the one farthest from 1 in the target; keep_mm (k, 3): x, y and radius of what no cut
    may cross (the targets, corner marks, or a board's corners); extra: what is printed besides targets; outline_mm (m, 2): closed,
    where to cut, None for a plane; low_mm, high_mm (2,): the box of all of it; map: how it goes onto the surface; anchor_mm (2,):
    the point that is laid in its place, so that a print of the wrong size is off by nothing there; note: how to place it, in words;
    lines: the ink of a grid's lines, to be cut off at the outline.
    """

    name: str
    target: Index
    center_mm: Array
    angle_rad: Array
    stretch: Array
    keep_mm: Array
    extra: tuple[Shape, ...]
    outline_mm: Array | None
    low_mm: Array
    high_mm: Array
    map: FlatMap
    anchor_mm: Array
    note: str = ""
    lines: tuple[Ink, ...] = ()

    @property
    def strain(self) -> float:
        """Largest part by which a length in a target differs between paper and surface."""
        return float(np.abs(1 - self.stretch).max(initial=0.0))


def flat_piece(name: str, pattern: Pattern, flat: FlatMap, target: Index, outline: Array | None, anchor: Array, note: str = "") -> Piece:
    """The piece with some of a pattern's targets (n,), within an outline (m, 2) or as large as its ink."""
    center = flat.to_flat(pattern.center_mm[target, :2])
    x, y = flat.axes(center)
    angle = np.arctan2((pattern.x_axis[target] * y).sum(axis=1), (pattern.x_axis[target] * x).sum(axis=1))
    middle, reach = (of_all[target] for of_all in ink_places(pattern))
    keep = np.column_stack([flat.to_flat(middle[:, :2]), reach])
    stretch = flat.stretch(keep[:, :2], strained_mm(pattern)[target])
    border = reach[:, None] + (BORDER_MM if outline is None else TAB_MM)
    corners = np.concatenate([keep[:, :2] - border, keep[:, :2] + border, *([] if outline is None else [outline])])
    return Piece(name, target, center, angle, stretch, keep, (), outline, corners.min(axis=0), corners.max(axis=0), flat, anchor, note)


def target_ink(pattern: Pattern, piece: Piece, which: int) -> Ink:
    """The ink of target number `which` of a piece: circles of their true radii and polygons, turned as the target is."""
    index = int(piece.target[which])
    kind, angle = pattern.kind_of(index), piece.angle_rad[which]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    polygons = tuple(piece.center_mm[which] + polygon.corners_mm @ turn.T for polygon in kind.polygons)
    return Ink(piece.center_mm[which] + kind.center_mm @ turn.T, kind.radius_mm, polygons, f"target-{pattern.ids[index]}")


def ink_places(pattern: Pattern) -> tuple[Array, Array]:
    """Points (N, 3) in the dish frame and radii (N,) about them that hold each target's own ink; the radius is 0 where there is none.

    The point is the target's origin but for polygons, which may lie beside it.
    """
    middle, reach = np.zeros((len(pattern), 2)), np.zeros(len(pattern))
    for name, kind in pattern.kinds.items():
        own = np.array([kind_name == name for kind_name in pattern.kind_names])
        reach[own] = kind.extent_mm
        if kind.polygons:
            corners = np.concatenate([polygon.corners_mm for polygon in kind.polygons])
            middle[own] = (corners.min(axis=0) + corners.max(axis=0)) / 2
            reach[own] = np.linalg.norm(corners - middle[own][0], axis=1).max()
    beside = bent_print_mm(middle[:, None], pattern.curvature_per_mm)[:, 0]
    return pattern.center_mm + np.einsum("nij,nj->ni", pattern.axes, beside), reach


def strained_mm(pattern: Pattern) -> Array:
    """Radius (N,) about the middle of each target's ink within which paper must keep its lengths: of that ink, and half a step of lines."""
    reach = ink_places(pattern)[1]
    if not pattern.lines:
        return reach
    gap = cKDTree(pattern.center_mm).query(pattern.center_mm, k=[2])[0][:, 0]
    return np.maximum(reach, gap / 2)
