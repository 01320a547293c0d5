"""Sheets to print: the whole way from a pattern or a board to pages, and what is to be known of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError, PatternError
from dishmap.sheet.boards import CornerBoard, board_piece
from dishmap.sheet.flatten import Flat
from dishmap.sheet.gores import LARGEST_STRAIN, cut_targets, dish_pieces
from dishmap.sheet.layout import Placement, lay_out
from dishmap.sheet.markers import marker_polygons
from dishmap.sheet.paper import Paper
from dishmap.sheet.pieces import BORDER_MM, Piece, flat_piece, target_ink
from dishmap.sheet.printed import print_scale, printed_pattern
from dishmap.sheet.ruled import with_lines
from dishmap.sheet.shapes import Ink, Page
from dishmap.sheet.tiles import OVERLAP_MM
from dishmap.targets.pattern import Pattern

Array = NDArray[np.float64]

CORNER_MARKS = ("aruco", "apriltag")
# A target this far off the surface, or leaning so much, would not be what the pattern file says once it is printed.
LARGEST_OFF_MM, LARGEST_LEAN_DEG = 0.01, 0.1
# A corner mark is as large as a target, within these limits, with this much free paper around it.
MARK_RANGE_MM, MARK_GAP_PART = (12.0, 60.0), 0.25


@dataclass(frozen=True)
class CornerMark:
    """A mark at a corner of a flat pattern: its number in the dictionary, its middle (2,) in the pattern's frame, its side."""

    dictionary: str
    number: int
    center_mm: Array
    side_mm: float


@dataclass(frozen=True)
class Sheets:
    """Pages to print and what they hold: `what` is the pattern or the board, placements say which piece lies where."""

    what: Pattern | CornerBoard
    paper: Paper
    pieces: tuple[Piece, ...]
    pages: tuple[Page, ...]
    placements: tuple[Placement, ...]
    corner_marks: tuple[CornerMark, ...] = ()

    @property
    def strain(self) -> float:
        """Largest part by which a length in a target is printed longer than it will be on the surface."""
        return max(piece.strain for piece in self.pieces)

    @property
    def cut_by_edges(self) -> list[int]:
        """Indices of targets that reach over the edge of a gore."""
        return cut_targets(self.pieces)

    @property
    def cut_by_pages(self) -> list[int]:
        """Indices of targets (or of a board's corners and marks) that reach over the cut between two pages."""
        found: set[int] = set()
        for place in self.placements:
            target = self.pieces[place.piece].target
            found |= {int(target[k]) if len(target) else int(k) for k in place.tabs if k < len(target) or not len(target)}
        return sorted(found)


def pattern_sheets(
    pattern: Pattern,
    paper: Paper,
    overlap_mm: float = OVERLAP_MM,
    largest_strain: float = LARGEST_STRAIN,
    corner_marks: str | None = None,
) -> Sheets:
    """Sheets of a pattern at true scale: one piece for a plate or an unrolled cylinder, cap and gores for a dish.

    corner_marks: `aruco` (4x4_50) or `apriltag` (36h11), numbers 0 to 3 from the upper left clockwise, for plates. Raises
    InputError when a target does not fit on the paper, PatternError when the strain's limit cannot be kept or targets are off the surface.
    """
    _check_overlap(overlap_mm)
    _check_on_surface(pattern)
    marks: tuple[CornerMark, ...] = ()
    if pattern.surface.kind == "paraboloid":
        if corner_marks is not None:
            raise InputError("corner marks belong to flat patterns and boards; a dish has no corners: leave them out")
        if not 0 < largest_strain < 1:
            raise InputError(f"the largest strain must lie between 0 and 100 percent, not {100 * largest_strain:g}")
        pieces = dish_pieces(pattern, largest_strain, (float(paper.room_mm.min()), float(paper.room_mm.max())))
    else:
        if corner_marks is not None and pattern.surface.kind != "plane":
            raise InputError("corner marks belong to flat patterns and boards; leave them out for a cylinder")
        whole = flat_piece(pattern.name or "pattern", pattern, Flat(pattern.surface), np.arange(len(pattern)), None, np.zeros(2))
        piece, marks = _with_corner_marks(with_lines(whole, pattern), corner_marks)
        pieces = (piece,)
    pages, placements = lay_out(pieces, lambda piece, k: target_ink(pattern, piece, k), paper, pattern.name or "pattern", overlap_mm)
    return Sheets(pattern, _used(paper, pages), pieces, pages, placements, marks)


def board_sheets(board: CornerBoard, paper: Paper, overlap_mm: float = OVERLAP_MM, corner_marks: str | None = None) -> Sheets:
    """Sheets of a chessboard or ChArUco board at true scale. Raises InputError as `pattern_sheets` does."""
    _check_overlap(overlap_mm)
    if corner_marks is not None and board.dictionary is not None:
        raise InputError("a ChArUco board has marks of its own, which corner marks would be taken for; leave --corner-marks out")
    piece, marks = _with_corner_marks(board_piece(board), corner_marks)
    pages, placements = lay_out((piece,), lambda piece, k: Ink(), paper, piece.name, overlap_mm)
    return Sheets(board, _used(paper, pages), (piece,), pages, placements, marks)


def as_printed(sheets: Sheets, measured_mm: Sequence[float]) -> Pattern | CornerBoard:
    """The pattern or board as printed, from the measured lengths of the scale bars to the right and upwards.

    Raises InputError for lengths that cannot be.
    """
    scale = print_scale(measured_mm, sheets.paper.bar_mm)
    if isinstance(sheets.what, CornerBoard):
        return sheets.what.scaled(scale)
    return printed_pattern(sheets.what, sheets.pieces, scale)


def _check_overlap(overlap_mm: float) -> None:
    if not (np.isfinite(overlap_mm) and overlap_mm >= 0):
        raise InputError(f"an overlap of {overlap_mm:g} mm cannot be; it must be 0 or more")


def _check_on_surface(pattern: Pattern) -> None:
    """Raise PatternError for targets that stand off the nominal surface or lean: paper that is laid on it cannot hold them."""
    xy = pattern.center_mm[:, :2]
    off = np.abs(pattern.center_mm[:, 2] - pattern.surface.height_mm(xy))
    lean = np.degrees(np.arccos(np.clip((pattern.normal * pattern.surface.normal(xy)).sum(axis=1), -1, 1)))
    worst = int(np.argmax(off / LARGEST_OFF_MM + lean / LARGEST_LEAN_DEG))
    if off[worst] > LARGEST_OFF_MM or lean[worst] > LARGEST_LEAN_DEG:
        raise PatternError(
            f"target {pattern.ids[worst]} stands {off[worst]:.3g} mm off the pattern's surface and leans by {lean[worst]:.2g} degrees; "
            "sheets lie on the surface, so print the pattern that was designed, not one that was measured"
        )


def _used(paper: Paper, pages: Sequence[Page]) -> Paper:
    return paper if pages[0].width_mm == paper.width_mm else paper.turned


def _with_corner_marks(piece: Piece, dictionary: str | None) -> tuple[Piece, tuple[CornerMark, ...]]:
    """The piece with four marks outside of its corners, and where they are."""
    if dictionary is None:
        return piece, ()
    if dictionary not in CORNER_MARKS:
        raise InputError(f"unknown corner marks {dictionary!r}; use one of {', '.join(CORNER_MARKS)}")
    side = float(np.clip(2 * piece.keep_mm[:, 2].max(), *MARK_RANGE_MM))
    out = side / 2 + MARK_GAP_PART * side
    low, high = piece.low_mm - out, piece.high_mm + out
    corners = np.array([[low[0], high[1]], [high[0], high[1]], [high[0], low[1]], [low[0], low[1]]])
    marks = tuple(CornerMark(dictionary, number, corner, side) for number, corner in enumerate(corners))
    half = np.array([-side / 2, side / 2])
    ink = tuple(
        Ink(polygons_mm=marker_polygons(dictionary, mark.number, mark.center_mm + half, side), name=f"corner-{mark.number}")
        for mark in marks
    )
    keep = np.concatenate([piece.keep_mm, [[*mark.center_mm, side / 2 + BORDER_MM / 2] for mark in marks]])
    border = side / 2 + BORDER_MM
    return replace(piece, extra=(*piece.extra, *ink), keep_mm=keep, low_mm=low - border, high_mm=high + border), marks
