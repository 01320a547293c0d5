"""Surfaces for GRASP: .sfc files (a regular grid, or points anywhere), .rim files, and the objects of a .tor file that name them.

Records are in millimetres. Of GRASP's manual nothing was at hand: the layouts are those of sample files and open readers
(`docs/rf-files.md`). Numbers keep 11 digits.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.io.grasp_text import Lines, grasp_text, joined, one_line, rows

Array = NDArray[np.float64]

# GRASP's units of length.
MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "km": 1e6, "in": 25.4, "ft": 304.8}
# An object for points anywhere has no member for a unit as far as samples show, so its file is in metres.
POINTS_UNIT = "m"
PER_LINE = 4
# Numbers have 11 digits, so equal steps differ by a little.
STEP_TOLERANCE = 1e-8


@dataclass(frozen=True)
class SurfaceGrid:
    """Heights z_mm (Y, X) over x_mm (X,) and y_mm (Y,), each rising in equal steps; text: what it is."""

    x_mm: Array
    y_mm: Array
    z_mm: Array
    text: str = ""


@dataclass(frozen=True)
class SurfacePoints:
    """Points (N, 3) of a surface, at least three, in any order; text: what it is."""

    points_mm: Array
    text: str = ""


@dataclass(frozen=True)
class SurfaceRim:
    """Corners (N, 2) of a rim in x and y, in order around it; text: what it is."""

    points_mm: Array
    text: str = ""


def format_grid(grid: SurfaceGrid) -> str:
    """The text of a .sfc file of a regular grid, in mm. Raises InputError when the grid is not regular or holds no number somewhere."""
    x, y, z = grid.x_mm, grid.y_mm, grid.z_mm
    for name, axis in (("x", x), ("y", y)):
        step = np.diff(axis)
        if len(axis) < 2 or not (step > 0).all() or np.ptp(step) > STEP_TOLERANCE * np.abs(axis).max():
            raise InputError(f"a .sfc file needs two or more {name} that rise in equal steps")
    if z.shape != (len(y), len(x)) or not np.isfinite(z).all():
        raise InputError("a .sfc file needs a finite height at every node; where the surface is not known, write points instead")
    # y runs fastest
    values = z.T.ravel()
    full = len(values) - len(values) % PER_LINE
    lines = [*rows(values[:full].reshape(-1, PER_LINE)), *(rows(values[None, full:]) if full < len(values) else [])]
    limits = rows(np.array([[x[0], y[0], x[-1], y[-1]]]))
    return joined([one_line(grid.text), *limits, f"{len(x):6d} {len(y):6d}", *lines])


def parse_grid(text: str, source: str = "the surface", unit: str = "mm") -> SurfaceGrid:
    """The grid of the text of a .sfc file in a unit of length that its .tor object says. Raises InputError, naming the line."""
    scale, lines = _scale(unit), Lines(text, source)
    title = lines.line("a line of text").strip()
    xs, ys, xe, ye = lines.numbers("XS YS XE YE")
    nx, ny = lines.integers("NX NY")
    if nx < 2 or ny < 2 or not (xe > xs and ye > ys):
        raise lines.error(f"a grid needs two or more nodes along rising x and y, not {nx} and {ny} from {xs:g}, {ys:g} to {xe:g}, {ye:g}")
    z = lines.block(nx * ny, f"heights at {nx} x {ny} nodes").reshape(nx, ny)
    lines.finish()
    return SurfaceGrid(np.linspace(xs, xe, nx) * scale, np.linspace(ys, ye, ny) * scale, z.T * scale, title)


def read_grid(path: str | os.PathLike[str], unit: str = "mm") -> SurfaceGrid:
    """Read a .sfc file of a regular grid. Raises InputError."""
    return parse_grid(grasp_text(path, "surface file"), str(path), unit)


def format_points(surface: SurfacePoints) -> str:
    """The text of a .sfc file of points anywhere, in metres: a line of text, how many, and x y z of each. Raises InputError."""
    points = surface.points_mm
    if points.ndim != 2 or points.shape[1:] != (3,) or len(points) < 3 or not np.isfinite(points).all():
        raise InputError("a surface of points needs three or more, each with finite x, y and z")
    title = f"{one_line(surface.text)} [x y z in {POINTS_UNIT}]".strip()
    return joined([title, f"{len(points):8d}", *rows(points / MM[POINTS_UNIT])])


def parse_points(text: str, source: str = "the surface", unit: str = POINTS_UNIT) -> SurfacePoints:
    """The points of a text of free lines, then a line with their number, then x y z of each. Raises InputError, naming the line.

    The line with the number is the first that holds one whole number alone.
    """
    scale, lines = _scale(unit), Lines(text, source)
    titles: list[str] = []
    while not (line := lines.line("a line with the number of points").strip()).isdecimal():
        titles.append(line)
    count = _count(line, lines)
    values = lines.block(3 * count, f"x y z of {count} points").reshape(count, 3)
    lines.finish()
    return SurfacePoints(values * scale, one_line(" ".join(titles)).removesuffix(f"[x y z in {unit}]").strip())


def read_points(path: str | os.PathLike[str], unit: str = POINTS_UNIT) -> SurfacePoints:
    """Read a .sfc file of points anywhere. Raises InputError."""
    return parse_points(grasp_text(path, "surface file"), str(path), unit)


def format_rim(rim: SurfaceRim) -> str:
    """The text of a .rim file, in mm. Raises InputError."""
    points = rim.points_mm
    if points.ndim != 2 or points.shape[1:] != (2,) or len(points) < 3 or not np.isfinite(points).all():
        raise InputError("a rim needs three or more points, each with finite x and y")
    return joined([one_line(rim.text), f"{len(points):8d}", *rows(points)])


def parse_rim(text: str, source: str = "the rim", unit: str = "mm") -> SurfaceRim:
    """The rim of the text of a .rim file: a line of text, the number of points, x y of each. Raises InputError, naming the line."""
    scale, lines = _scale(unit), Lines(text, source)
    title = lines.line("a line of text").strip()
    count = _count(lines.line("the number of points").strip(), lines)
    values = lines.block(2 * count, f"x y of {count} points").reshape(count, 2)
    lines.finish()
    return SurfaceRim(values * scale, title)


def read_rim(path: str | os.PathLike[str], unit: str = "mm") -> SurfaceRim:
    """Read a .rim file. Raises InputError."""
    return parse_rim(grasp_text(path, "rim file"), str(path), unit)


def grid_object(name: str, file_name: str) -> str:
    """The object of a .tor file for a .sfc file of a regular grid in mm. Raises InputError for a name that GRASP cannot have."""
    return _object(name, "regular_xy_grid", file_name=file_name, xy_unit="mm", z_unit="mm")


def points_object(name: str, file_name: str) -> str:
    """The object of a .tor file for a file of `format_points`: the number on its second line, the points from its third."""
    number = "struct(in_file: yes, line: 2, column: 1)"
    values = "struct(start_line: 3, x_column: 1, y_column: 2, z_column: 3)"
    return _object(
        name,
        "irregular_xy_grid_triangulation",
        file_name=file_name,
        file_xyz_number=number,
        file_xyz_values=values,
        interpolation="linear",
    )


def rim_object(name: str, file_name: str, count: int) -> str:
    """The object of a .tor file for a .rim file of so many points in mm."""
    return _object(name, "tabulated_rim_xy", file_name=file_name, unit="mm", number_of_points=str(count))


def _object(name: str, kind: str, **members: str) -> str:
    for value in (name, members["file_name"]):
        if not value or any(letter.isspace() or letter in ",:()" for letter in value):
            raise InputError(f"{value!r} cannot stand in a .tor file: names have no blanks, commas, colons or brackets")
    text = ",\n".join(f"  {key:<16} : {value}" for key, value in members.items())
    return f"{name}  {kind}\n(\n{text}\n)\n"


def _scale(unit: str) -> float:
    if unit not in MM:
        raise InputError(f"unknown unit of length {unit!r}; GRASP's are {', '.join(MM)}")
    return MM[unit]


def _count(line: str, lines: Lines) -> int:
    if not (line.isascii() and line.isdecimal() and len(line) < 10 and int(line) >= 3):
        raise lines.error(f"the number of points must be three or more, not {line[:30]!r}")
    return int(line)
