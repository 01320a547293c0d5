"""Pieces onto pages: small pieces share a page, large ones are cut into tiles, and every page says what it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.sheet.outline import cut_lines, name_words
from dishmap.sheet.paper import Paper, strips
from dishmap.sheet.pieces import Piece
from dishmap.sheet.shapes import LINE_MM, Group, Ink, Page, Shape, cross
from dishmap.sheet.tiles import CROSS_ARM_MM, LARGEST_PAGES, OVERLAP_MM, Tile, tiles_of

Array = NDArray[np.float64]
Index = NDArray[np.int64]
InkOf = Callable[[Piece, int], Ink]

# Free paper between pieces that share a page.
GAP_MM = 4.0
# So many pieces are listed by name on their page.
LISTED = 4


@dataclass(frozen=True)
class Placement:
    """A piece, or a tile of it, on a page: shift_mm (2,) takes the piece's millimetres to the page's; tabs: targets over a tile's cuts."""

    page: int
    piece: int
    tile: str
    shift_mm: Array
    own: Index
    tabs: Index


def lay_out(
    pieces: Sequence[Piece], ink_of: InkOf, paper: Paper, title: str, overlap_mm: float = OVERLAP_MM
) -> tuple[tuple[Page, ...], tuple[Placement, ...]]:
    """Pages and what lies where on them; ink_of(piece, k) draws target number k of a piece.

    The paper is used upright or on its side, whichever takes fewer pages. Raises InputError as `tiles_of` does.
    """
    ways, problems = [], []
    for turned in (paper, paper.turned):
        try:
            ways.append((turned, _place(pieces, turned, overlap_mm)))
        except InputError as error:
            problems.append(error)
    if not ways:
        raise problems[0]
    # the first of equals: upright as given
    used, (places, groups, count) = min(ways, key=lambda way: way[1][2])
    if count > LARGEST_PAGES:
        raise InputError(
            f"{count} sheets would be needed; up to {LARGEST_PAGES} are made: take larger paper, or check that sizes are in mm"
        )
    drawn: list[list[Group]] = [[] for _ in range(count)]
    for place, (low, high, tile, crosses) in zip(places, groups, strict=True):
        piece = pieces[place.piece]
        shapes = [shape.moved(place.shift_mm) for shape in _shapes(piece, place, tile, crosses, ink_of, low, high)]
        # lines along the border are printed in their whole width
        box = np.concatenate([low + place.shift_mm - LINE_MM, high + place.shift_mm + LINE_MM])
        clip = (float(box[0]), float(box[1]), float(box[2]), float(box[3]))
        drawn[place.page].append(Group(tuple(shapes), clip))
        if piece.lines:
            outline = None if piece.outline_mm is None else piece.outline_mm + place.shift_mm
            drawn[place.page].append(Group(tuple(ink.moved(place.shift_mm) for ink in piece.lines), clip, outline))
    pages = []
    for number, content in enumerate(drawn, start=1):
        own = [_name(pieces, place) for place in places if place.page == number - 1]
        # pieces lie in their order, so the first and the last say enough
        names = ", ".join(own) if len(own) <= LISTED else f"{own[0]} to {own[-1]}"
        words = f"{title}: sheet {number} of {count}: {names}. Print at 100 %, do not fit to the page."
        head = Group(strips(used, words))
        pages.append(Page(f"{title}, sheet {number} of {count}: {names}", used.width_mm, used.height_mm, (head, *content)))
    return tuple(pages), tuple(places)


_Drawn = tuple[Array, Array, Tile | None, Array]


def _place(pieces: Sequence[Piece], paper: Paper, overlap: float) -> tuple[list[Placement], list[_Drawn], int]:
    """Placements, what is drawn of each (low, high, tile, crosses), and the number of pages."""
    room = paper.room_mm
    places: list[Placement] = []
    drawn: list[_Drawn] = []
    page = 0
    small = []
    for number, piece in enumerate(pieces):
        if (piece.high_mm - piece.low_mm <= room).all():
            small.append(number)
            continue
        tiles, crosses = tiles_of(piece, room, overlap)
        for tile in tiles:
            name = f"{chr(ord('A') + tile.column) if tile.column < 26 else f'{tile.column + 1}-'}{tile.row + 1}"
            places.append(Placement(page, number, name, paper.corner_mm - tile.low, tile.own, tile.crossing))
            drawn.append((tile.low, tile.high, tile, crosses))
            page += 1
    for number, (on_page, corner) in _shelves(pieces, small, room).items():
        piece = pieces[number]
        none = np.zeros(0, dtype=int)
        places.append(Placement(page + on_page, number, "", paper.corner_mm + corner - piece.low_mm, np.arange(len(piece.target)), none))
        drawn.append((piece.low_mm, piece.high_mm, None, np.zeros((0, 2))))
    return places, drawn, max((place.page for place in places), default=-1) + 1


def _shelves(pieces: Sequence[Piece], small: Sequence[int], room: Array) -> dict[int, tuple[int, Array]]:
    """Page and lower left corner for each small piece: rows from below, in the given order, in which neighbours have about one height."""
    found: dict[int, tuple[int, Array]] = {}
    page, corner, shelf = 0, np.zeros(2), 0.0
    for number in small:
        size = pieces[number].high_mm - pieces[number].low_mm
        if corner[0] + size[0] > room[0]:
            corner, shelf = np.array([0.0, corner[1] + shelf + GAP_MM]), 0.0
        if corner[1] + size[1] > room[1]:
            page, corner, shelf = page + 1, np.zeros(2), 0.0
        found[number] = (page, corner)
        corner, shelf = corner + np.array([size[0] + GAP_MM, 0.0]), max(shelf, float(size[1]))
    return found


def _shapes(piece: Piece, place: Placement, tile: Tile | None, crosses: Array, ink_of: InkOf, low: Array, high: Array) -> list[Shape]:
    shapes: list[Shape] = [ink_of(piece, int(k)) for k in place.own if k < len(piece.target)]
    shapes += piece.extra
    if piece.outline_mm is not None:
        shapes += cut_lines(piece.outline_mm, piece.keep_mm)
        shapes += name_words(piece, low if tile is None else tile.cut_low, high if tile is None else tile.cut_high)
    corners = np.array([[x, y] for x in (piece.low_mm[0], piece.high_mm[0]) for y in (piece.low_mm[1], piece.high_mm[1])])
    marks = crosses if piece.outline_mm is not None else np.concatenate([crosses, corners])
    near = ((marks > low - CROSS_ARM_MM) & (marks < high + CROSS_ARM_MM)).all(axis=1)
    for mark in marks[near]:
        shapes += cross(mark, CROSS_ARM_MM)
    if tile is not None and len(tile.crossing):
        (left, bottom), (right, top) = tile.cut_low, tile.cut_high
        box = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
        shapes += cut_lines(_finely(box), piece.keep_mm[tile.own])
    return shapes


def _finely(box: Array) -> Array:
    """A polygon with points close together, so that lines along it can leave out tabs."""
    sides = zip(box, np.roll(box, -1, axis=0), strict=True)
    return np.concatenate([np.linspace(a, b, max(2, int(np.linalg.norm(b - a))), endpoint=False) for a, b in sides])


def _name(pieces: Sequence[Piece], place: Placement) -> str:
    return f"{pieces[place.piece].name} {place.tile}".rstrip()
