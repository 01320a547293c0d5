"""A piece of flat paper: the targets on it, its outline, and how it goes back onto the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.sheet.flatten import FlatMap
from dishmap.sheet.shapes import Ink, Shape
from dishmap.targets.pattern import Pattern

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
    the point that is laid in its place, so that a print of the wrong size is off by nothing there; note: how to place it, in words.
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

    @property
    def strain(self) -> float:
        """Largest part by which a length in a target differs between paper and surface."""
        return float(np.abs(1 - self.stretch).max(initial=0.0))


def flat_piece(name: str, pattern: Pattern, flat: FlatMap, target: Index, outline: Array | None, anchor: Array, note: str = "") -> Piece:
    """The piece with some of a pattern's targets (n,), within an outline (m, 2) or as large as its ink."""
    center = flat.to_flat(pattern.center_mm[target, :2])
    x, y = flat.axes(center)
    angle = np.arctan2((pattern.x_axis[target] * y).sum(axis=1), (pattern.x_axis[target] * x).sum(axis=1))
    reach = reach_mm(pattern)[target]
    stretch = flat.stretch(center, reach)
    keep = np.column_stack([center, reach])
    border = reach[:, None] + (BORDER_MM if outline is None else TAB_MM)
    corners = np.concatenate([center - border, center + border, *([] if outline is None else [outline])])
    return Piece(name, target, center, angle, stretch, keep, (), outline, corners.min(axis=0), corners.max(axis=0), flat, anchor, note)


def target_ink(pattern: Pattern, piece: Piece, which: int) -> Ink:
    """The ink of target number `which` of a piece: circles of their true radii, turned as the target is."""
    index = int(piece.target[which])
    kind, angle = pattern.kind_of(index), piece.angle_rad[which]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return Ink(piece.center_mm[which] + kind.center_mm @ turn.T, kind.radius_mm, name=f"target-{pattern.ids[index]}")


def reach_mm(pattern: Pattern) -> Array:
    """Radius (N,) about each target's origin that holds its ink."""
    return np.array([kind.extent_mm for kind in (pattern.kinds[name] for name in pattern.kind_names)])
