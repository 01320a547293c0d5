"""Surfaces in GRASP's files: layouts, what is written is read, and files that are not what they seem."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dishmap.errors import InputError
from dishmap.io.grasp_surface import (
    SurfaceGrid,
    SurfacePoints,
    SurfaceRim,
    format_grid,
    format_points,
    format_rim,
    grid_object,
    parse_grid,
    parse_points,
    parse_rim,
    points_object,
    read_grid,
    rim_object,
)

# Numbers stand in files with 11 digits.
DIGITS = 1e-10

# A paraboloid z = (x^2 + y^2) / 4 over x 1, 2, 3 and y 10, 20, four values a line wherever a column of y ends.
GRID = """\
 Surface z-values for reflector: main_reflector, with unit: in.
  0.1000000000E+01  0.1000000000E+02  0.3000000000E+01  0.2000000000E+02
 3 2
  0.2525000000E+02  0.1002500000E+03  0.2600000000E+02  0.1010000000E+03
  0.2725000000E+02  0.1022500000E+03
"""
POINTS = """\
points of a main reflector
written by some program
  4

 0.0  0.0  0.5-101
 1.0  0.0  0.1D+00
 1.0,-1.0,-2.E-1
 0.0  1.0  3
"""
RIM = "rim, moved\n4\n27.57\t0.00\n37.02\t-13.36\n45.49\t-27.25\n27.57 0.00\n"

lengths = st.floats(-1e4, 1e4)


def test_a_grid_as_grasp_writes_it() -> None:
    grid = parse_grid(GRID, unit="in")
    assert grid.text == "Surface z-values for reflector: main_reflector, with unit: in."
    assert grid.x_mm / 25.4 == pytest.approx([1, 2, 3])
    assert grid.y_mm / 25.4 == pytest.approx([10, 20])
    assert grid.z_mm / 25.4 == pytest.approx(np.add.outer(grid.y_mm**2, grid.x_mm**2) / 4 / 25.4**2)
    assert parse_grid(GRID, unit="m").z_mm == pytest.approx(grid.z_mm / 25.4 * 1000)


def test_a_grid_is_written_in_that_layout() -> None:
    grid = parse_grid(GRID)
    lines, again = GRID.splitlines(), format_grid(grid).splitlines()
    assert again[0] == lines[0].strip()
    for one, two in zip(lines[1:], again[1:], strict=True):
        assert [float(word) for word in one.split()] == [float(word) for word in two.split()]


def test_points_and_rims_as_other_programs_write_them() -> None:
    surface = parse_points(POINTS, unit="mm")
    assert surface.text == "points of a main reflector written by some program"
    assert surface.points_mm.tolist() == [[0, 0, 0.5e-101], [1, 0, 0.1], [1, -1, -0.2], [0, 1, 3]]
    rim = parse_rim(RIM)
    assert rim.text == "rim, moved"
    assert rim.points_mm.tolist() == [[27.57, 0], [37.02, -13.36], [45.49, -27.25], [27.57, 0]]


def test_points_are_written_in_metres_where_their_object_looks_for_them() -> None:
    points = np.array([[1.0, 2, 3], [4, 5, 6], [7, 8, 9]])
    lines = format_points(SurfacePoints(points, "a dish")).splitlines()
    assert lines[0] == "a dish [x y z in m]"
    text = points_object("dish.points", "dish.sfc")
    number, start = (int(found) for found in re.findall(r"line: (\d+)", text))
    assert int(lines[number - 1]) == 3
    assert [[float(word) for word in line.split()] for line in lines[start - 1 :]] == (points / 1000).tolist()
    assert "\n".join(line.rstrip() for line in text.splitlines()) == (
        "dish.points  irregular_xy_grid_triangulation\n(\n"
        "  file_name        : dish.sfc,\n"
        "  file_xyz_number  : struct(in_file: yes, line: 2, column: 1),\n"
        "  file_xyz_values  : struct(start_line: 3, x_column: 1, y_column: 2, z_column: 3),\n"
        "  interpolation    : linear\n)"
    )


def test_objects_of_grids_and_rims() -> None:
    members = dict(re.findall(r"(\w+) +: ([^,\n]+)", grid_object("dish", "dish.sfc")))
    assert members == {"file_name": "dish.sfc", "xy_unit": "mm", "z_unit": "mm"}
    members = dict(re.findall(r"(\w+) +: ([^,\n]+)", rim_object("rim", "dish.rim", 90)))
    assert members == {"file_name": "dish.rim", "unit": "mm", "number_of_points": "90"}
    for bad in ("a b", "", "a,b", "a(b"):
        with pytest.raises(InputError, match=r"cannot stand in a \.tor file"):
            grid_object("dish", bad)


@given(
    hnp.arrays(float, st.tuples(st.integers(2, 7), st.integers(2, 7)), elements=lengths),
    st.tuples(lengths, lengths),
    st.tuples(st.floats(0.1, 100), st.floats(0.1, 100)),
    st.text(),
)
def test_any_grid_reads_back(z_mm: np.ndarray, start: tuple[float, float], step: tuple[float, float], text: str) -> None:
    x, y = (one + by * np.arange(n) for one, by, n in zip(start, step, z_mm.shape[::-1], strict=True))
    back = parse_grid(format_grid(SurfaceGrid(x, y, z_mm, text)))
    for one, two in ((x, back.x_mm), (y, back.y_mm), (z_mm, back.z_mm)):
        assert np.abs(one - two).max() <= DIGITS * max(1.0, np.abs(one).max())
    assert back.text == " ".join(text.split())


@given(hnp.arrays(float, st.tuples(st.integers(3, 20), st.just(3)), elements=lengths), st.text())
def test_any_points_and_rims_read_back(points: np.ndarray, text: str) -> None:
    surface = parse_points(format_points(SurfacePoints(points, text)))
    assert np.abs(surface.points_mm - points).max() <= DIGITS * max(1.0, np.abs(points).max())
    assert surface.text == " ".join(text.split())
    rim = parse_rim(format_rim(SurfaceRim(points[:, :2], text)))
    assert np.abs(rim.points_mm - points[:, :2]).max() <= DIGITS * max(1.0, np.abs(points).max())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (GRID.replace(" 3 2\n", " 3 3\n"), "^s ends after 5 lines, where 3 more of 9 numbers .heights at 3 x 3 nodes. should follow"),
        (
            GRID.replace(" 3 2\n", " 100000 100000\n"),
            "^s, line 3: 10000000000 numbers .* are announced, and the rest",
        ),
        (GRID.replace(" 3 2\n", " 3 1.5\n"), "line 3: NX NY must be whole numbers, not 3 1.5"),
        (GRID.replace(" 3 2\n", " 3\n"), "line 3: NX NY are needed .2 numbers., not '3'"),
        (GRID.replace(" 3 2\n", " -3 -2\n"), "line 3: a grid needs two or more nodes"),
        (GRID.replace("0.3000000000E+01", "0.1000000000E+01"), "line 3: a grid needs two or more nodes along rising x and y"),
        (GRID.replace("0.2600000000E+02", "NaN"), "line 4: 'NaN' is no finite number"),
        (GRID.replace("0.2600000000E+02", "26,O"), "line 4: 'O' is no number|more numbers"),
        (GRID + "1.0\n", "line 6: more follows than the file announces"),
        (GRID.replace("0.1022500000E+03", "1 2 3"), "line 5: 2 more numbers than the 6"),
        ("", "^s ends after 0 lines, where a line of text should follow"),
    ],
)
def test_grids_that_are_not_read(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_grid(text, "s")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (POINTS.replace("  4\n", "  2\n"), "line 3: the number of points must be three or more, not '2'"),
        (POINTS.replace("  4\n", "  999999999\n"), "2999999997 numbers .* announced"),
        (POINTS.replace("  4\n", "  99999999999999\n"), "number of points must be three or more, not '9999"),
        (POINTS.replace("  4\n", "  5\n"), "3 more of 15 numbers"),
        (POINTS.replace("  4\n", "  3\n"), "line 8: more follows"),
        ("a\nb\n", "^p ends after 2 lines, where a line with the number of points should follow"),
    ],
)
def test_points_that_are_not_read(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_points(text, "p")


def test_what_cannot_be_written() -> None:
    x = np.array([0.0, 1.0, 2.0])
    with pytest.raises(InputError, match="rise in equal steps"):
        format_grid(SurfaceGrid(np.array([0.0, 1.0, 3.0]), x, np.zeros((3, 3))))
    with pytest.raises(InputError, match="where the surface is not known, write points instead"):
        format_grid(SurfaceGrid(x, x, np.full((3, 3), np.nan)))
    with pytest.raises(InputError, match="three or more"):
        format_points(SurfacePoints(np.zeros((2, 3))))
    with pytest.raises(InputError, match="three or more"):
        format_rim(SurfaceRim(np.full((4, 2), np.inf)))


def test_files_that_are_no_text(tmp_path: Path) -> None:
    path = tmp_path / "a.sfc"
    with pytest.raises(InputError, match="cannot read the surface file"):
        read_grid(path)
    path.write_bytes(b"\x00\x01")
    with pytest.raises(InputError, match="is no surface file: it is not text"):
        read_grid(path)
    path.write_bytes("Fl\xe4che".encode("latin-1") + GRID[GRID.index("\n") :].encode())
    assert read_grid(path).z_mm.shape == (2, 3)
    with pytest.raises(InputError, match="unknown unit of length 'inch'; GRASP's are mm, cm"):
        read_grid(path, "inch")
