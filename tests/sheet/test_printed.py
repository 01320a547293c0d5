"""The pattern as printed: what a printer with errors of scale puts on paper, and what the program writes of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from printing import SvgPage, dishmap, placed_shifts
from test_gores import laid, laid_cap

from dishmap.io.pattern_file import format_pattern, read_pattern
from dishmap.sheet.boards import chessboard
from dishmap.sheet.paper import paper_of
from dishmap.sheet.sheets import as_printed, board_sheets, pattern_sheets
from dishmap.targets.builders import dish, multi_circular, plate
from dishmap.targets.pattern import Pattern

# Numbers in SVG files are rounded to a nanometre.
ROUNDING_MM = 5e-6
SCALE = np.array([0.997, 1.001])


def circle_places(pattern: Pattern) -> np.ndarray:
    """x, y, z of every circle's middle (as flat targets) and its radius, target by target."""
    rows = []
    for k in range(len(pattern)):
        kind = pattern.kind_of(k)
        middle = pattern.center_mm[k] + kind.center_mm @ pattern.axes[k][:, :2].T
        rows.append(np.column_stack([middle, kind.radius_mm]))
    return np.concatenate(rows)


def test_a_plate_follows_both_scales_and_keeps_areas(tmp_path: Path) -> None:
    words = ["plate", "--rows", 5, "--columns", 6, "--pitch-mm", 45, "--orientation-marks", "--out", tmp_path]
    assert dishmap("sheet", *words).exit_code == 0
    drawn = (tmp_path / "pattern.json").read_text()
    done = dishmap("sheet", *words, "--measured-mm", "99.7x100.1")
    assert done.exit_code == 0, (done.output, done.exception)
    assert "-0.30 % along x and +0.10 % along y" in done.stdout
    assert "ellipses by 0.40%" in done.stdout
    assert (tmp_path / "pattern.json").read_text() == drawn
    before, after = circle_places(read_pattern(tmp_path / "pattern.json")), circle_places(read_pattern(tmp_path / "pattern-printed.json"))
    assert np.abs(after[:, :2] - before[:, :2] * SCALE).max() < ROUNDING_MM
    assert np.abs(after[:, 3] - before[:, 3] * np.sqrt(SCALE.prod())).max() < ROUNDING_MM


def test_true_scale_changes_nothing() -> None:
    for pattern in (plate(4, 5, 45.0), dish(400, 300)):
        printed = as_printed(pattern_sheets(pattern, paper_of("A4")), (100.0, 100.0))
        assert isinstance(printed, Pattern)
        assert printed.kind_names == pattern.kind_names
        for name in ("center_mm", "x_axis", "normal"):
            assert np.abs(getattr(printed, name) - getattr(pattern, name)).max() < 1e-7
        assert np.abs(circle_places(printed) - circle_places(pattern)).max() < 1e-6


def test_a_dish_is_what_its_scaled_gores_give_when_laid(tmp_path: Path) -> None:
    words = ["dish", "--diameter-mm", 400, "--focal-length-mm", 300, "--out", tmp_path]
    assert dishmap("sheet", *words).exit_code == 0
    assert dishmap("sheet", *words, "--measured-mm", "99.7x100.1").exit_code == 0
    printed, listing = read_pattern(tmp_path / "pattern-printed.json"), json.loads((tmp_path / "sheets.json").read_text())
    pieces = {piece["name"]: piece for piece in listing["pieces"]}
    compared = 0
    for number, entries in placed_shifts(listing).items():
        page = SvgPage(tmp_path / listing["pages"][number - 1])
        for entry in entries:
            anchor, degrees = np.array(pieces[entry["piece"]]["anchor_mm"]), pieces[entry["piece"]]["azimuth_deg"]
            for row in entry["targets"]:
                circles = page.circles[f"target-{row['id']}"][:: 2 if len(page.circles[f"target-{row['id']}"]) == 8 else 1, :2]
                flat = anchor + (np.vstack([circles.mean(axis=0), circles]) - entry["shift_mm"] - anchor) * SCALE
                on_dish = np.array([laid_cap(p, 300.0) if degrees is None else laid(p, np.radians(degrees), 300.0) for p in flat])
                index = int(np.flatnonzero(printed.ids == row["id"])[0])
                assert np.linalg.norm(on_dish[0] - printed.center_mm[index]) < 1e-4
                # the strain of the gore, 0.2 % of 10 mm
                assert np.linalg.norm(on_dish[1:] - printed.marks.center_mm[printed.marks.target == index], axis=1).max() < 0.02
                compared += 1
    assert compared == len(printed)


def test_turned_targets_get_kinds_of_their_own() -> None:
    # four rings at 30 degrees become a parallelogram; at 120 degrees the same one is seen from another side
    base = plate(1, 3, 45.0, multi_circular())
    angle = np.radians([0.0, 30.0, 120.0])
    x_axis = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(3)])
    pattern = Pattern("turned", base.surface, base.kinds, base.ids, base.kind_names, base.center_mm, x_axis, base.normal)
    printed = as_printed(pattern_sheets(pattern, paper_of("A4")), (99.0, 100.0))
    assert isinstance(printed, Pattern)
    assert len(printed.kinds) == 3
    assert np.abs(circle_places(printed)[:, :2] - circle_places(pattern)[:, :2] * [0.99, 1.0]).max() < 1e-6
    assert "multi4~3" in format_pattern(printed)


def test_a_chessboard_follows_both_scales(tmp_path: Path) -> None:
    printed = as_printed(board_sheets(chessboard((9, 6), 20.0), paper_of("A4")), (99.7, 100.1))
    assert not isinstance(printed, Pattern)
    assert printed.square_mm == pytest.approx((19.94, 20.02))
    words = ["board", "--kind", "chessboard", "--corners", "9x6", "--square-mm", 20, "--out", tmp_path, "--measured-mm", "99.7x100.1"]
    assert dishmap("sheet", *words).exit_code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["board-printed.json"]
    assert json.loads((tmp_path / "board-printed.json").read_text())["corners_mm"][10] == pytest.approx([19.94, 20.02])


def test_small_paper_has_shorter_bars(tmp_path: Path) -> None:
    words = ["plate", "--rows", 2, "--columns", 2, "--pitch-mm", 40, "--paper", "105x148", "--out", tmp_path]
    assert "50 mm" in dishmap("sheet", *words).stdout
    assert json.loads((tmp_path / "sheets.json").read_text())["bar_mm"] == 50
    assert "do not belong to bars of 50 mm" in dishmap("sheet", *words, "--measured-mm", "99.7x100.1").stderr
    assert dishmap("sheet", *words, "--measured-mm", "49.9x50").exit_code == 0
