"""Boards to calibrate a camera with.

Boards of circles are patterns like any other (`circles_board`, `rings_board`, `asymmetric_board`); chessboards and ChArUco boards, which
have corners instead of circles, are a `CornerBoard`. All have the layout that OpenCV's detectors expect.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.chessboard import chessboard_mm
from dishmap.errors import InputError
from dishmap.sheet.flatten import Flat
from dishmap.sheet.markers import DICTIONARIES, marker_polygons
from dishmap.sheet.pieces import Piece
from dishmap.sheet.shapes import Ink
from dishmap.targets.builders import disc, plate, ring
from dishmap.targets.pattern import Pattern, Surface

Array = NDArray[np.float64]

BOARDS = ("chessboard", "charuco", "circles", "acircles", "rings")
# Radii over the pitch: large, so that many pixels count, with as much free paper between circles as OpenCV's detectors like.
DISC_PART, RING_PART, ASYMMETRIC_PART = 0.3, 0.35, 0.4
# Radius of a ring's hole over its own.
HOLE_PART = 0.5
# Side of a ChArUco board's marks over its squares.
MARKER_PART = 0.75
# No cut comes nearer to a corner than this part of a square: a photograph shows it there. A mark is kept with its rim.
CORNER_PART, MARKER_RIM = 0.05, 1.02
# Light paper around a chessboard, in squares: its detectors need some.
BORDER_SQUARES = 0.5


@dataclass(frozen=True)
class CornerBoard:
    """A chessboard, or a ChArUco board when `dictionary` is given.

    corners: inner corners along x and y; square_mm: their distances as printed along x and y; marker_mm: sides of the
    marks. Corners are counted from the upper left, x to the right and y down. The upper left square is dark on a ChArUco board, as OpenCV
    wants it, and light on a chessboard, where `find_chessboard` begins to count.
    """

    kind: str
    corners: tuple[int, int]
    square_mm: tuple[float, float]
    marker_mm: tuple[float, float] | None = None
    dictionary: str | None = None

    @property
    def corners_mm(self) -> Array:
        """Inner corners (columns * rows, 2) from the first one."""
        return np.asarray(chessboard_mm(self.corners, 1.0)[:, :2] * self.square_mm)

    def scaled(self, scale: Array) -> CornerBoard:
        """The board as a printer with errors of scale (2,) along x and y prints it."""
        square = (self.square_mm[0] * float(scale[0]), self.square_mm[1] * float(scale[1]))
        marker = None if self.marker_mm is None else (self.marker_mm[0] * float(scale[0]), self.marker_mm[1] * float(scale[1]))
        return CornerBoard(self.kind, self.corners, square, marker, self.dictionary)


def chessboard(corners: tuple[int, int], square_mm: float) -> CornerBoard:
    """A chessboard. Raises InputError for sizes that no board has."""
    chessboard_mm(corners, square_mm)
    return CornerBoard("chessboard", corners, (square_mm, square_mm))


def charuco(corners: tuple[int, int], square_mm: float, marker_mm: float | None = None, dictionary: str = "5x5_1000") -> CornerBoard:
    """A ChArUco board; marks in the light squares, numbered row by row. Raises InputError for sizes that no board has."""
    chessboard_mm(corners, square_mm)
    if dictionary not in DICTIONARIES:
        raise InputError(f"unknown dictionary {dictionary!r}; use one of {', '.join(DICTIONARIES)}")
    side = MARKER_PART * square_mm if marker_mm is None else marker_mm
    if not 0 < side < square_mm:
        raise InputError(f"the marks of a ChArUco board are smaller than its squares of {square_mm:g} mm, not {side:g} mm")
    return CornerBoard("charuco", corners, (square_mm, square_mm), (side, side), dictionary)


def circles_board(grid: tuple[int, int], pitch_mm: float, radius_mm: float | None = None, marks: bool = True) -> Pattern:
    """Discs on a square lattice of columns x rows, some of them with a hole as orientation marks. Raises PatternError as `plate` does."""
    columns, rows = grid
    kind = disc(DISC_PART * pitch_mm if radius_mm is None else radius_mm)
    return plate(rows, columns, pitch_mm, kind, "disc", marks, f"circles-{columns}x{rows}")


def rings_board(
    grid: tuple[int, int], pitch_mm: float, radius_mm: float | None = None, inner_radius_mm: float | None = None, marks: bool = True
) -> Pattern:
    """Rings on a square lattice of columns x rows, some of them without the hole as orientation marks. Raises PatternError as `plate`."""
    columns, rows = grid
    outer = RING_PART * pitch_mm if radius_mm is None else radius_mm
    inner = HOLE_PART * outer if inner_radius_mm is None else inner_radius_mm
    if inner >= outer:
        raise InputError(f"the hole of a ring is smaller than the ring: {inner:g} mm is no radius for one in {outer:g} mm")
    kind = ring(outer, inner)
    return plate(rows, columns, pitch_mm, kind, "ring", marks, f"rings-{columns}x{rows}")


def asymmetric_board(grid: tuple[int, int], pitch_mm: float, radius_mm: float | None = None) -> Pattern:
    """OpenCV's asymmetric grid: rows of `columns` discs 2 pitch_mm apart, pitch_mm from row to row, every second row moved by pitch_mm.

    Raises InputError for fewer than 2 columns or 3 rows, PatternError for discs that touch.
    """
    columns, rows = grid
    if columns < 2 or rows < 3:
        raise InputError(f"an asymmetric grid needs at least 2 columns and 3 rows, not {columns}x{rows}")
    row, column = np.divmod(np.arange(rows * columns), columns)
    xy = pitch_mm * np.stack([2 * column + row % 2, -row], axis=1).astype(float)
    center = np.column_stack([xy - (xy.min(axis=0) + xy.max(axis=0)) / 2, np.zeros(len(xy))])
    radius = ASYMMETRIC_PART * pitch_mm if radius_mm is None else radius_mm
    if 2 * radius >= np.sqrt(2) * pitch_mm:
        raise InputError(
            f"discs of radius {radius:g} mm touch at a pitch of {pitch_mm:g} mm; the radius must be below {pitch_mm / np.sqrt(2):.4g} mm"
        )
    along, up = np.tile([1.0, 0.0, 0.0], (len(xy), 1)), np.tile([0.0, 0.0, 1.0], (len(xy), 1))
    name = f"acircles-{columns}x{rows}"
    return Pattern(name, Surface(), {"disc": disc(radius)}, np.arange(len(xy)), ("disc",) * len(xy), center, along, up)


def board_piece(board: CornerBoard) -> Piece:
    """The board on flat paper, its middle at the origin, with its squares and marks."""
    square = np.array(board.square_mm)
    size = (np.array(board.corners) + 1) * square
    upper_left = np.array([-size[0] / 2, size[1] / 2])
    down = np.array([1.0, -1.0])
    corners = upper_left + (board.corners_mm + square) * down
    keep = [np.column_stack([corners, np.full(len(corners), CORNER_PART * square.min())])]
    extra = [_squares(board, upper_left)]
    if board.dictionary is not None and board.marker_mm is not None:
        side = board.marker_mm[0]
        for number, (row, column) in enumerate(_cells(board, dark=False)):
            middle = upper_left + (np.array([column, row]) + 0.5) * square * down
            polygons = marker_polygons(board.dictionary, number, middle - side / 2 * down, side)
            extra.append(Ink(polygons_mm=polygons, name=f"mark-{number}"))
            # cuts run along x or y, so half a side is enough
            keep.append(np.array([[*middle, MARKER_RIM * side / 2]]))
    half = size / 2 + BORDER_SQUARES * square
    none, name = np.zeros(0), f"{board.kind}-{board.corners[0]}x{board.corners[1]}"
    nobody = (none.astype(int), np.zeros((0, 2)), none, none)
    return Piece(name, *nobody, np.concatenate(keep), tuple(extra), None, -half, half, Flat(), np.zeros(2))


def _squares(board: CornerBoard, upper_left: Array) -> Ink:
    w, h = board.square_mm
    box = np.array([[0.0, 0.0], [w, 0.0], [w, -h], [0.0, -h]])
    places = [upper_left + np.array([column * w, -row * h]) for row, column in _cells(board, dark=True)]
    return Ink(polygons_mm=tuple(box + place for place in places), name="squares")


def _cells(board: CornerBoard, dark: bool) -> list[tuple[int, int]]:
    """Rows and columns of the dark or the light squares, row by row."""
    columns, rows = board.corners[0] + 1, board.corners[1] + 1
    even_is_dark = board.dictionary is not None
    return [(row, column) for row in range(rows) for column in range(columns) if ((row + column) % 2 == 0) == (dark == even_is_dark)]
