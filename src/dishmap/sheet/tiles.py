"""Large pieces cut into tiles that fit the paper: where the cuts go, so that none crosses a target if that can be avoided."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.errors import InputError
from dishmap.sheet.paper import words_of
from dishmap.sheet.pieces import TAB_MM, Piece
from dishmap.sheet.shapes import edge_points

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Each tile is printed beyond its cuts by this, to be glued under its neighbour, unless another overlap is given.
OVERLAP_MM = 10.0
# Free paper between a cut and the ink.
CLEARANCE_MM, ROUNDING_MM = 0.3, 1e-9
# A cut that avoids the ink makes a tile smaller, but not by more than this part.
SMALLEST_PART = 0.4
# More sheets than this are a mistake in the units.
LARGEST_PAGES = 400
# Crosses on the cuts, which both neighbours show, lie this far apart or more, at the first free one of places so close; their arms.
CROSS_STEP_MM, CROSS_TRY_MM, CROSS_ARM_MM = 40.0, 2.0, 2.5


@dataclass(frozen=True)
class Tile:
    """Part of a piece: own (n,) which of its targets; the box between the cuts and what is printed of it; row, column from the lower left.

    crossing (n,): which of the own targets reach over a cut, and so need a tab.
    """

    row: int
    column: int
    own: Index
    crossing: Index
    cut_low: Array
    cut_high: Array
    low: Array
    high: Array


def tiles_of(piece: Piece, room_mm: Array, overlap_mm: float = OVERLAP_MM) -> tuple[list[Tile], Array]:
    """Tiles of a piece that fit room_mm (2,), and the places (c, 2) of the crosses that neighbours share.

    Raises InputError when the paper is smaller than a target, or when too many sheets would be needed.
    """
    reach = float(piece.keep_mm[:, 2].max(initial=0.0))
    if 2 * reach > room_mm.min():
        raise InputError(
            f"a target of {2 * reach:.4g} mm does not fit on the {words_of(room_mm)} mm that the paper has room for; take larger paper"
        )
    _check_count(piece, room_mm, overlap_mm)
    cuts = [_cuts(piece, axis, float(room_mm[axis]), overlap_mm) for axis in (0, 1)]
    edges = [[piece.low_mm[k], *cuts[k][0], piece.high_mm[k]] for k in (0, 1)]
    grow = [cuts[k][1] for k in (0, 1)]
    tiles = []
    for row, (bottom, top) in enumerate(pairwise(edges[1])):
        for column, (left, right) in enumerate(pairwise(edges[0])):
            tiles.append(_tile(piece, row, column, np.array([left, bottom]), np.array([right, top]), np.array(grow)))
    return [tile for tile in tiles if len(tile.own) or not len(piece.keep_mm)], _crosses(piece, edges)


def _check_count(piece: Piece, room: Array, overlap: float) -> None:
    if (room <= 2 * overlap).any():
        raise InputError(f"an overlap of {overlap:g} mm leaves nothing of the {words_of(room)} mm that the paper has room for")
    size = piece.high_mm - piece.low_mm
    count = float(np.prod(np.where(size <= room, 1, np.maximum(2, np.floor(size / (room - 2 * overlap))))))
    if count > LARGEST_PAGES:
        raise InputError(
            f"{piece.name} of {words_of(size)} mm needs {count:.0f} sheets or more; "
            f"up to {LARGEST_PAGES} are made: take larger paper, or check that sizes are in mm"
        )


def _cuts(piece: Piece, axis: int, room: float, overlap: float) -> tuple[list[float], float]:
    """Cuts along an axis, and how far tiles are printed beyond them: the overlap, or more where targets reach over a cut."""
    low, high = float(piece.low_mm[axis]), float(piece.high_mm[axis])
    if high - low <= room:
        return [], overlap
    center, reach = piece.keep_mm[:, axis], piece.keep_mm[:, 2] + CLEARANCE_MM
    cuts = _walk(low, high, room, overlap, center, reach)
    crossed = (np.abs(np.array(cuts)[:, None] - center) < reach - CLEARANCE_MM / 2).any() if len(center) and cuts else False
    wider = float(max(overlap, piece.keep_mm[:, 2].max(initial=0.0) + TAB_MM))
    if not crossed or wider == overlap:
        return cuts, overlap
    if room <= 2 * wider:
        raise InputError(
            f"no cut passes between the targets, and tabs of {wider:.4g} mm around them leave nothing of {room:.4g} mm of paper; "
            "take larger paper"
        )
    return _walk(low, high, room, wider, center, reach), wider


def _walk(low: float, high: float, room: float, overlap: float, center: Array, reach: Array) -> list[float]:
    """Cuts as far apart as the room allows, each moved back to where it crosses no target if there is such a place."""
    cuts: list[float] = []
    start, last = low, low
    while high - start > room:
        most = start + room - overlap
        cut = _free_cut(last + SMALLEST_PART * (most - last), most, center, reach)
        cuts.append(cut)
        start, last = cut - overlap, cut
    return cuts


def _free_cut(least: float, most: float, center: Array, reach: Array) -> float:
    """The last place from `least` to `most` that meets nothing (c,) within reach, as near to the middle of its gap as can be; or `most`."""
    cut = most
    while (hit := np.abs(center - cut) < reach - ROUNDING_MM).any():
        cut = float((center - reach)[hit].min())
        if cut < least:
            return most
    before, after = (center + reach)[center < cut], (center - reach)[center > cut]
    return float(np.clip((before.max(initial=least) + after.min(initial=max(most, cut))) / 2, least, most))


def _tile(piece: Piece, row: int, column: int, cut_low: Array, cut_high: Array, grow: Array) -> Tile:
    keep = piece.keep_mm
    inside = ((keep[:, :2] >= cut_low) & (keep[:, :2] < cut_high)).all(axis=1)
    own = np.flatnonzero(inside)
    # the outer edges of the piece are no cuts
    is_cut = np.concatenate([cut_low > piece.low_mm, cut_high < piece.high_mm])
    over = np.concatenate([keep[own, :2] - keep[own, 2:] < cut_low, keep[own, :2] + keep[own, 2:] > cut_high], axis=1)
    low, high = (np.where(is_cut[:2], cut_low - grow, cut_low), np.where(is_cut[2:], cut_high + grow, cut_high))
    return Tile(row, column, own, own[(over & is_cut).any(axis=1)], cut_low, cut_high, low, high)


def _crosses(piece: Piece, edges: list[list[float]]) -> Array:
    """Places (c, 2) on the cuts that are free of ink, at the meetings of cuts and borders and every CROSS_STEP_MM between them."""
    found: list[Array] = []
    free = _free_of(piece)
    for axis in (0, 1):
        other = 1 - axis
        along = np.array([*edges[other], *np.arange(edges[other][0], edges[other][-1], CROSS_TRY_MM)])
        for cut in edges[axis][1:-1]:
            places = np.empty((len(along), 2))
            places[:, axis], places[:, other] = cut, along
            taken = np.zeros((0, 2))
            for place in places[free(places)]:
                near = np.linalg.norm(taken - place, axis=1).min(initial=np.inf)
                if near >= CROSS_STEP_MM:
                    taken = np.vstack([taken, place])
            found.append(taken)
    return np.unique(np.round(np.concatenate([np.zeros((0, 2)), *found]), 6), axis=0)


def _free_of(piece: Piece) -> Callable[[Array], NDArray[np.bool_]]:
    """A function that says which places (N, 2) have room for a cross."""
    keep = piece.keep_mm
    if not len(keep):
        return lambda places: np.ones(len(places), dtype=bool)
    edges = edge_points(piece.lines, CROSS_ARM_MM / 2)
    tree, reach = cKDTree(keep[:, :2]), keep[:, 2] + CROSS_ARM_MM

    def free(places: Array) -> NDArray[np.bool_]:
        near = tree.query_ball_point(places, float(reach.max()))
        apart = np.array([all(np.linalg.norm(keep[hits, :2] - p, axis=1) > reach[hits]) for p, hits in zip(places, near, strict=True)])
        return apart & (cKDTree(edges).query(places)[0] > CROSS_ARM_MM) if len(edges) else apart

    return free
