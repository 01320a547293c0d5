"""Sheets of paper: sizes, margins, and the strips that carry scale bars and names."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.sheet.shapes import Line, Shape, Words

Array = NDArray[np.float64]

SIZES_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
# Few printers reach nearer to the edge than 5 mm, none beyond 4 m.
MARGIN_MM = 10.0
LARGEST_PAPER_MM = 4000.0
# Strips along the left and the lower edge for scale bars and names.
STRIP_MM = 9.0
# Lengths of the scale bars: callipers commonly reach 150 mm.
BARS_MM = (100.0, 50.0)
TICK_MM, BAR_AT_MM, WORDS_MM = 3.0, 2.0, 2.5
# Width of a letter over its height in Helvetica, on average.
LETTER_WIDTH = 0.75
# Beside a bar with less room than this stands its length alone.
LONG_WORDS_MM = 50.0


@dataclass(frozen=True)
class Paper:
    """Paper of a size in mm; nothing is printed nearer to its edges than the margin."""

    width_mm: float
    height_mm: float
    margin_mm: float = MARGIN_MM

    def __post_init__(self) -> None:
        size = (self.width_mm, self.height_mm)
        if not all(math.isfinite(value) and 0 < value <= LARGEST_PAPER_MM for value in size):
            raise InputError(f"paper of {size[0]:g}x{size[1]:g} mm cannot be; give a size in mm up to {LARGEST_PAPER_MM:g}")
        if not (math.isfinite(self.margin_mm) and self.margin_mm >= 0):
            raise InputError(f"a margin of {self.margin_mm:g} mm cannot be; it must be 0 or more")
        if min(self.room_mm) < BARS_MM[-1]:
            raise InputError(
                f"paper of {size[0]:g}x{size[1]:g} mm with {self.margin_mm:g} mm margins leaves {words_of(self.room_mm)} mm to print on; "
                f"{BARS_MM[-1]:g} mm each way are needed for the scale bars alone"
            )

    @property
    def room_mm(self) -> Array:
        """Width and height (2,) of what is left for pieces."""
        return np.array([self.width_mm, self.height_mm]) - 2 * self.margin_mm - STRIP_MM

    @property
    def corner_mm(self) -> Array:
        """Lower left corner (2,) of what is left for pieces."""
        return np.full(2, self.margin_mm + STRIP_MM)

    @property
    def bar_mm(self) -> float:
        """Length of the scale bars."""
        return next(bar for bar in BARS_MM if bar <= self.room_mm.min())

    @property
    def turned(self) -> Paper:
        """The same paper on its side."""
        return Paper(self.height_mm, self.width_mm, self.margin_mm)


def words_of(size_mm: Array) -> str:
    """Width and height as in 190x277."""
    return "x".join(f"{value:.4g}" for value in size_mm)


def paper_of(words: str, margin_mm: float = MARGIN_MM) -> Paper:
    """Paper by name (A4, A3, letter) or size (200x300, in mm). Raises InputError for others."""
    size = SIZES_MM.get(words.lower())
    if size is None:
        try:
            width, height = (float(part) for part in words.lower().removesuffix("mm").rstrip("_ ").split("x"))
        except ValueError:
            raise InputError(f"unknown paper {words!r}; use A4, A3, letter, or width and height in mm such as 200x300") from None
        size = (width, height)
    return Paper(*size, margin_mm)


def strips(paper: Paper, words: str) -> tuple[Shape, ...]:
    """Scale bars to the right and upwards, and a line of words."""
    start, at, bar = paper.margin_mm + STRIP_MM, paper.margin_mm + BAR_AT_MM, paper.bar_mm
    shapes: list[Shape] = []
    for swap in (False, True):
        lines = [[[start, at], [start + bar, at]], *([[x, at - TICK_MM / 2], [x, at + TICK_MM / 2]] for x in (start, start + bar))]
        shapes += [Line(np.array(line)[:, ::-1] if swap else np.array(line)) for line in lines]
    room = paper.room_mm - bar - 3
    for upwards, at_mm in ((False, [start + bar + 3, at - 1]), (True, [at + 1, start + bar + 3])):
        said = f"{bar:g} mm" + " between the middles of the ticks" * bool(room[int(upwards)] > LONG_WORDS_MM)
        shapes.append(Words(np.array(at_mm), said, min(WORDS_MM, _fitting(said, room[int(upwards)])), upwards))
    shapes.append(Words(np.array([start, at + 3]), words, min(WORDS_MM, _fitting(words, paper.room_mm[0]))))
    return tuple(shapes)


def _fitting(words: str, room_mm: float) -> float:
    return max(0.5, room_mm / (LETTER_WIDTH * len(words)))
