"""Ready-made grids: where their places lie, what their marks tell apart, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad

from dishmap.errors import PatternError
from dishmap.targets.grid_builders import grid
from dishmap.targets.pattern import Pattern, Surface

Array = NDArray[np.float64]

DISH = Surface("paraboloid", 600.0, 300.0)
BOWL = Surface("paraboloid", 280.0, 140.0)


def test_a_plate_of_lines() -> None:
    pattern = grid(4, 3, 12.0, line_width_mm=1.0)
    assert pattern.is_grid
    assert pattern.lattice is not None
    # ids from the top left, row by row; rows grow upwards
    assert pattern.center_mm[0].tolist() == [-18.0, 12.0, 0.0]
    assert pattern.center_mm[-1].tolist() == [18.0, -12.0, 0.0]
    assert pattern.lattice[[0, 3, 4, 11]].tolist() == [[0, 2], [3, 2], [0, 1], [3, 0]]
    assert [line.ids for line in pattern.lines[:1] + pattern.lines[3:4]] == [(0, 1, 2, 3), (8, 4, 0)]
    assert {(line.width_mm, line.overhang_mm) for line in pattern.lines} == {(1.0, 6.0)}
    assert list(pattern.kinds) == ["crossing"]
    assert np.abs(pattern.axes - np.eye(3)).max() < 1e-12


def test_squares_on_a_cylinder_keep_their_distances_along_it() -> None:
    pattern = grid(9, 5, 12.0, square_mm=8.0, surface=Surface("cylinder", radius_mm=57.0))
    assert not pattern.lines
    angle = np.arctan2(pattern.center_mm[:, 0], pattern.center_mm[:, 2] + 57)
    assert np.hypot(pattern.center_mm[:, 0], pattern.center_mm[:, 2] + 57) == pytest.approx(57.0)
    assert 57 * angle == pytest.approx(12 * (np.tile(np.arange(9), 5) - 4), abs=1e-9)
    expected = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], axis=1)
    assert np.abs(pattern.x_axis - expected).max() < 1e-6


def test_a_dish_has_its_places_at_true_ways_along_meridians() -> None:
    pattern = grid(60, 60, 12.0, line_width_mm=1.0, surface=DISH)
    assert pattern.lattice is not None
    step = pattern.lattice - 29.5
    for k in (0, 100, 700, 1500):
        radius = np.hypot(*pattern.center_mm[k, :2])
        way = quad(lambda r: np.hypot(1, r / 600), 0, radius)[0]
        assert way == pytest.approx(12 * np.hypot(*step[k]), abs=1e-6)
        assert pattern.center_mm[k, :2] / radius == pytest.approx(step[k] / np.hypot(*step[k]), abs=1e-9)
    assert pattern.center_mm[:, 2] == pytest.approx((pattern.center_mm[:, :2] ** 2).sum(axis=1) / 1200)
    # as many as fit, and no ink beyond the rim: ends of lines lie 6 mm beyond the last crossings
    rim = quad(lambda r: np.hypot(1, r / 600), 0, 300)[0]
    far = 12 * np.abs(step)
    assert np.hypot(far.max(axis=1) + 6, far.min(axis=1)).max() <= rim
    assert len(pattern) > 0.9 * np.pi * (rim - 12) ** 2 / 144
    assert min(len(line.ids) for line in pattern.lines) >= 2


@pytest.mark.parametrize("ink", [{"line_width_mm": 1.0}, {"square_mm": 7.0}], ids=["lines", "squares"])
@pytest.mark.parametrize(("columns", "rows", "surface"), [(14, 11, Surface()), (13, 13, Surface()), (24, 24, BOWL)])
def test_marks_tell_every_wrong_turn_and_shift_apart(columns: int, rows: int, surface: Surface, ink: dict) -> None:
    """Each move with a third of the places in common is tried by hand."""
    pattern = grid(columns, rows, 12.0, surface=surface, orientation_marks=True, **ink)
    looks = signs(pattern)
    least, corners = len(looks), len(looks) / 3
    for quarter in range(4):
        turned = {turn(place, quarter): look for place, look in looks.items()}
        low, high = np.min(list(turned), axis=0) - 1, np.max(list(turned), axis=0) + 1
        for shift in shifts(looks, low, high):
            if quarter == 0 and shift == (0, 0):
                continue
            common = [(looks[p], turned[q]) for p in looks if (q := (p[0] - shift[0], p[1] - shift[1])) in turned]
            if len(common) >= corners:
                least = min(least, sum(a != b for a, b in common))
    assert least >= 3
    # every third of the pattern, cut either way, shows some
    marked = np.array([place for place, look in looks.items() if look])
    for axis in (0, 1):
        cuts = np.quantile(np.array(list(looks))[:, axis], [1 / 3, 2 / 3])
        assert (np.bincount(np.digitize(marked[:, axis], cuts), minlength=3) >= 2).all()
    assert pattern.kind_names == grid(columns, rows, 12.0, surface=surface, orientation_marks=True, **ink).kind_names


def signs(pattern: Pattern) -> dict[tuple[int, int], bool]:
    """Which squares are open, or which cells between lines hold a mark, by twice their place about the middle."""
    assert pattern.lattice is not None
    odd = {tuple(p) for p, name in zip(pattern.lattice.tolist(), pattern.kind_names, strict=True) if name.endswith(("open", "marked"))}
    places = {tuple(p) for p in pattern.lattice.tolist()}
    if pattern.lines:
        places = {(c, r) for c, r in places if {(c + 1, r), (c, r + 1), (c + 1, r + 1)} <= places}
    assert odd <= places
    return {(2 * c + 1, 2 * r + 1): (c, r) in odd for c, r in places}


def turn(place: tuple[int, int], quarter: int) -> tuple[int, int]:
    for _ in range(quarter):
        place = (-place[1], place[0])
    return place


def shifts(looks: dict[tuple[int, int], bool], low: Array, high: Array) -> list[tuple[int, int]]:
    """All even shifts for which boxes of places overlap by more than half in either way; a third of an area needs that much of one."""
    first, last = np.min(list(looks), axis=0), np.max(list(looks), axis=0)
    span = (last - first + 2) * 2 // 3
    middle = (first + last - low - high) // 2
    ranges = [range(int(m - m % 2 - s), int(m - m % 2 + s + 1), 2) for m, s in zip(middle, span, strict=True)]
    return [(a, b) for a in ranges[0] for b in ranges[1]]


@pytest.mark.parametrize(
    ("call", "text"),
    [
        ({"columns": 4, "rows": 3}, "lines or of squares"),
        ({"columns": 4, "rows": 3, "line_width_mm": 1.0, "square_mm": 2.0}, "and not both"),
        ({"columns": 0, "rows": 3, "line_width_mm": 1.0}, "columns must be 1 or more"),
        ({"columns": 4, "rows": 3, "line_width_mm": -1.0}, "line_width_mm must be a positive number"),
        ({"columns": 4, "rows": 3, "line_width_mm": 6.0}, "too wide for a pitch of 12 mm"),
        ({"columns": 4, "rows": 3, "square_mm": 11.5}, "nearly touch at a pitch of 12 mm"),
        ({"columns": 1, "rows": 3, "line_width_mm": 1.0}, "no grid of 1 x 3 places"),
        ({"columns": 20, "rows": 3, "square_mm": 6.0, "surface": Surface("cylinder", radius_mm=57.0)}, "20 columns at 12 mm do not fit"),
        ({"columns": 20, "rows": 3, "square_mm": 6.0, "surface": Surface("paraboloid", 8.0, 4.0)}, "no grid of 20 x 3 places"),
        ({"columns": 2, "rows": 2, "line_width_mm": 1.0, "orientation_marks": True}, "too few for orientation marks"),
    ],
)
def test_impossible_grids(call: dict, text: str) -> None:
    with pytest.raises(PatternError, match=text):
        grid(pitch_mm=12.0, **call)
