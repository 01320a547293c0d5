"""Printed grids measured by simple means: middles of line by their weight, squares by their moments, gores laid back on the dish."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from printing import INCH_MM, SvgPage, dishmap, needs_poppler, on_paper_mm, placed_shifts, rendered
from test_gores import laid, laid_cap, way_mm

from dishmap.io.pattern_file import read_pattern
from dishmap.sheet.paper import paper_of
from dishmap.sheet.sheets import as_printed, pattern_sheets
from dishmap.targets.grid_builders import grid
from dishmap.targets.pattern import Pattern, Surface

Array = NDArray[np.float64]

# What is asked of a print: half a pixel at 600 dpi.
PRINT_MM, DPI = 0.02, 600
# Numbers in SVG files are rounded to a nanometre.
ROUNDING_MM = 5e-6
PITCH_MM, LINE_MM, SQUARE_MM = 12.0, 1.0, 8.0
FOCAL_MM = 150.0
LINES = ["grid", "--columns", 22, "--rows", 12, "--pitch-mm", PITCH_MM, "--line-mm", LINE_MM, "--orientation-marks"]
SQUARES = ["--pitch-mm", PITCH_MM, "--square-mm", SQUARE_MM, "--orientation-marks"]
BENT = ["grid", "--columns", 13, "--rows", 17, *SQUARES, "--surface", "cylinder", "--cylinder-radius-mm", 57]
DISH = ["grid", "--columns", 25, "--rows", 25, "--pitch-mm", PITCH_MM, "--line-mm", LINE_MM, "--orientation-marks"]
DISH += ["--surface", "dish", "--diameter-mm", 300, "--focal-length-mm", FOCAL_MM]


def make(tmp_path: Path, words: list[object]) -> tuple[Pattern, dict]:
    done = dishmap("sheet", *words, "--out", tmp_path)
    assert done.exit_code == 0, (done.output, done.stderr, done.exception)
    return read_pattern(tmp_path / "pattern.json"), json.loads((tmp_path / "sheets.json").read_text())


def weighed(dark: Array, low: float, high: float) -> tuple[float, float]:
    """Middle and width, in px, of the dark along a profile from one pixel to another."""
    first = round(low)
    part = dark[first : round(high) + 1]
    return float(first + (part @ np.arange(len(part))) / part.sum()), float(part.sum())


@needs_poppler
def test_tiled_lines_measure_as_their_pattern_file_says(tmp_path: Path) -> None:
    """Each crossing is where the middles of its arms' profiles say, and lines are as wide as they should be."""
    pattern, listing = make(tmp_path, LINES)
    assert len(listing["pages"]) > 1
    height, seen = listing["paper_mm"][1], set()
    px = DPI / INCH_MM
    for number, image in enumerate(rendered(tmp_path / "sheets.pdf", DPI), start=1):
        (entry,) = placed_shifts(listing)[number]
        dark = 1 - image.astype(float) / 255
        for row in entry["targets"]:
            index = int(np.flatnonzero(pattern.ids == row["id"])[0])
            x, y = (pattern.center_mm[index, :2] + entry["shift_mm"]) * [px, -px] + [-0.5, height * px - 0.5]
            # no tile ends within 2 mm of a crossing; marks stand 3 mm away
            found = []
            for picture, (along, across) in ((dark, (x, y)), (dark.T, (y, x))):
                arms = [weighed(picture[round(across + step)], along - 1.2 * px, along + 1.2 * px) for step in (-1.5 * px, 1.5 * px)]
                found.append(np.mean([middle for middle, _ in arms]))
                assert np.abs(np.array([width for _, width in arms]) / px - LINE_MM).max() < PRINT_MM
            assert np.hypot(found[0] - x, found[1] - y) / px < PRINT_MM
            seen.add(index)
    assert len(seen) == len(pattern) == 22 * 12


@needs_poppler
@pytest.mark.parametrize("dpi", [300, 600])
def test_squares_for_a_cylinder_measure_as_they_unroll(dpi: int, tmp_path: Path) -> None:
    pattern, listing = make(tmp_path, BENT)
    assert len(listing["pages"]) == 1
    (entry,) = listing["placed"]
    dark = 1 - rendered(tmp_path / "sheets.pdf", dpi, snapped=False)[0].astype(float) / 255
    angle = np.arctan2(pattern.center_mm[:, 0], pattern.center_mm[:, 2] + 57)
    unrolled = np.column_stack([57 * angle, pattern.center_mm[:, 1]]) + entry["shift_mm"]
    px, height = dpi / INCH_MM, listing["paper_mm"][1]
    for k, (x, y) in enumerate(unrolled):
        corner = np.round(np.array([x, height - y]) * px - PITCH_MM / 2 * px).astype(int)
        own = dark[corner[1] : corner[1] + round(PITCH_MM * px), corner[0] : corner[0] + round(PITCH_MM * px)]
        moments = cv2.moments(own)
        found = on_paper_mm(corner + [moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]], dpi, height)
        assert np.hypot(*(found - [x, y])) < PRINT_MM
        # as a solid square or one with a hole of half its side
        side = np.sqrt(moments["m00"] / (0.75 if pattern.kind_names[k] == "square-open" else 1.0)) / px
        assert abs(side - SQUARE_MM) < PRINT_MM


def test_lines_on_gores_laid_back_on_the_dish_are_whole_and_in_their_place(tmp_path: Path) -> None:
    pattern, listing = make(tmp_path, DISH)
    assert pattern.lattice is not None
    azimuth = {piece["name"]: piece["azimuth_deg"] for piece in listing["pieces"]}
    covered: dict[int, list[float]] = {}
    worst, widths = 0.0, []
    for number, entries in placed_shifts(listing).items():
        page = SvgPage(tmp_path / listing["pages"][number - 1])
        for entry in entries:
            degrees, own = azimuth[entry["piece"]], entry["piece"].replace(" ", "-")
            for name, polygons in page.polygons.items():
                _, line, piece = [*name.split("-", 2), ""][:3] if name.startswith("line-") else ("", "", "")
                # a line that leaves a piece and comes back stands there twice
                if piece != own and not piece.startswith(f"{own}-"):
                    continue
                polygon = polygons[0] - entry["shift_mm"]
                for pair in list(zip(polygon[: len(polygon) // 2], polygon[::-1], strict=False))[::3]:
                    points = [laid_cap(p, FOCAL_MM) if degrees is None else laid(p, np.radians(degrees), FOCAL_MM) for p in pair]
                    off, along = from_line(pattern, int(line), np.mean(points, axis=0))
                    worst = max(worst, off)
                    widths.append(np.linalg.norm(points[0] - points[1]))
                    covered.setdefault(int(line), []).append(along)
    # the mean of both edges lies a micrometre under the surface
    assert worst < 2e-3
    assert np.abs(np.array(widths) - LINE_MM).max() < 1e-3
    assert len(covered) == len(pattern.lines)
    # pieces of every line are found all along it
    for line, places in covered.items():
        count = len(pattern.lines[line].ids)
        assert np.diff(np.sort([-0.5, *places, count - 0.5])).max() < 1.3


def from_line(pattern: Pattern, number: int, point: Array) -> tuple[float, float]:
    """How far a point is from a line's middle on the flat cap, by quadrature, and where along it in steps."""
    assert pattern.lattice is not None
    place = pattern.lattice[[int(np.flatnonzero(pattern.ids == i)[0]) for i in pattern.lines[number].ids[:2]]] - 12.0
    radius = np.hypot(*point[:2])
    flat = point[:2] / radius * way_mm(radius, FOCAL_MM) if radius else point[:2]
    axis = int(place[0, 0] == place[1, 0])
    return abs(flat[1 - axis] - PITCH_MM * place[0, 1 - axis]), float(flat[axis] / PITCH_MM - place[0, axis])


def test_a_print_that_is_uneven_makes_rectangles_and_lines_of_two_widths() -> None:
    paper, scale = paper_of("A4"), np.array([0.997, 1.001])
    lines = grid(12, 9, PITCH_MM, line_width_mm=LINE_MM, orientation_marks=True)
    printed = as_printed(pattern_sheets(lines, paper), (99.7, 100.1))
    assert isinstance(printed, Pattern)
    assert np.abs(printed.center_mm[:, :2] - lines.center_mm[:, :2] * scale).max() < ROUNDING_MM
    assert {round(line.width_mm, 9) for line in printed.lines[:9]} == {1.001}
    assert {round(line.width_mm, 9) for line in printed.lines[9:]} == {0.997}
    assert [printed.lines[k].overhang_mm for k in (0, 20)] == pytest.approx([6 * 0.997, 6 * 1.001])
    corners = printed.kinds["crossing-marked"].polygons[0].corners_mm
    assert np.abs(corners - lines.kinds["crossing-marked"].polygons[0].corners_mm * scale).max() < ROUNDING_MM
    assert printed.lattice is not None
    assert printed.lattice.tolist() == np.asarray(lines.lattice).tolist()
    squares = grid(9, 9, PITCH_MM, square_mm=SQUARE_MM, surface=Surface("cylinder", radius_mm=57.0))
    printed = as_printed(pattern_sheets(squares, paper), (99.7, 100.1))
    assert isinstance(printed, Pattern)
    angle = np.arctan2(printed.center_mm[:, 0], printed.center_mm[:, 2] + 57)
    assert 57 * angle == pytest.approx(0.997 * PITCH_MM * (np.tile(np.arange(9), 9) - 4), abs=1e-6)
    assert np.ptp(printed.kinds["square"].polygons[0].corners_mm, axis=0) == pytest.approx(SQUARE_MM * scale)


def test_corner_marks_are_for_planes(tmp_path: Path) -> None:
    done = dishmap("sheet", *BENT, "--corner-marks", "aruco", "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert "leave them out for a cylinder" in done.stderr
