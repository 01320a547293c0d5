"""`dishmap sheet`: its files, its words, and bad input: one sentence, exit code 2, and nothing written."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from printing import SvgPage, dishmap, placed_shifts

from dishmap.cli import sheet as words_of_the_program
from dishmap.errors import InputError, PatternError
from dishmap.io.pattern_file import read_pattern, write_pattern
from dishmap.sheet.boards import BOARDS
from dishmap.sheet.markers import DICTIONARIES
from dishmap.sheet.paper import Paper, paper_of
from dishmap.sheet.pdf import pdf_bytes
from dishmap.sheet.sheets import CORNER_MARKS, pattern_sheets
from dishmap.sheet.tiles import tiles_of
from dishmap.targets.builders import disc, dish, plate
from dishmap.targets.pattern import Pattern

PLATE = ["plate", "--rows", 4, "--columns", 4, "--pitch-mm", 45]
CHESS = ["board", "--kind", "chessboard", "--corners", "9x6", "--square-mm", 20]


def refused(done: Result) -> str:
    """What a command said that has refused: on standard error alone."""
    assert done.exit_code == 2, (done.exit_code, done.output, done.exception)
    assert done.stdout == ""
    return done.stderr


def test_words_are_those_of_the_functions() -> None:
    assert words_of_the_program.BOARDS == BOARDS
    assert words_of_the_program.CORNER_MARKS == CORNER_MARKS
    assert set(words_of_the_program.DICTIONARIES) == set(DICTIONARIES) - set(CORNER_MARKS)


def test_a_pattern_file_is_printed_and_written_beside_the_sheets(tmp_path: Path) -> None:
    pattern = plate(4, 5, 45.0, orientation_marks=True)
    write_pattern(tmp_path / "mine.json", pattern)
    done = dishmap("sheet", tmp_path / "mine.json", "--out", tmp_path / "out")
    assert done.exit_code == 0, (done.output, done.exception)
    assert "looks the same" not in done.stdout
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"sheets.pdf", "sheets.json", "pattern.json", "sheet-001.svg"} <= names
    assert (tmp_path / "out" / "pattern.json").read_text() == (tmp_path / "mine.json").read_text()


def test_the_same_words_give_the_same_bytes(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        assert dishmap("sheet", *PLATE, "--out", tmp_path / folder).exit_code == 0
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name


def test_symmetry_is_said(tmp_path: Path) -> None:
    assert "looks the same after 3 turns" in dishmap("sheet", *PLATE, "--out", tmp_path / "a").stdout
    assert "looks the same" not in dishmap("sheet", *PLATE, "--orientation-marks", "--out", tmp_path / "b").stdout
    rings = ["board", "--kind", "rings", "--grid", "7x9", "--pitch-mm", 20]
    assert "looks the same" not in dishmap("sheet", *rings, "--out", tmp_path / "c").stdout
    assert "looks the same after 1 turn," in dishmap("sheet", *rings, "--no-orientation-marks", "--out", tmp_path / "d").stdout


def test_boards_are_said_to_be_better_on_one_sheet_and_not_square(tmp_path: Path) -> None:
    rings = ["board", "--kind", "rings", "--pitch-mm", 25, "--out", tmp_path]
    assert "glued of several sheets is hardly flat" in dishmap("sheet", *rings, "--grid", "12x9").stdout
    assert "glued of several sheets" not in dishmap("sheet", *rings, "--grid", "7x6").stdout
    assert "glued of several sheets" not in dishmap("sheet", *PLATE, "--paper", "120x120", "--out", tmp_path).stdout
    square = dishmap("sheet", "board", "--kind", "chessboard", "--corners", "6x6", "--square-mm", 20, "--out", tmp_path).stdout
    assert "the board looks the same after a quarter turn" in square
    assert "take more corners one way" in square
    assert "quarter turn" not in dishmap("sheet", *CHESS, "--out", tmp_path).stdout
    assert "board.json: what is printed, for `dishmap calibrate --board`" in square


def test_targets_without_a_free_cut_lie_on_tabs_and_are_said(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    xy = np.zeros((0, 2))
    for point in rng.uniform(-200, 200, (4000, 2)):
        if not len(xy) or np.linalg.norm(xy - point, axis=1).min() > 22:
            xy = np.vstack([xy, point])
    n = len(xy)
    along, up = np.tile([1.0, 0, 0], (n, 1)), np.tile([0, 0, 1.0], (n, 1))
    pattern = Pattern("crowd", plate(1, 1, 1e3).surface, {"d": disc(9.0)}, np.arange(n), ("d",) * n, np.c_[xy, np.zeros(n)], along, up)
    write_pattern(tmp_path / "crowd.json", pattern)
    done = dishmap("sheet", tmp_path / "crowd.json", "--overlap-mm", 4, "--out", tmp_path / "out")
    assert done.exit_code == 0, (done.output, done.exception)
    said = re.search(r"(\d+) targets reach over the edge of a sheet", done.stdout)
    assert said is not None
    assert 0 < int(said[1]) < n / 2
    listing, seen = json.loads((tmp_path / "out" / "sheets.json").read_text()), []
    for number, (entry,) in placed_shifts(listing).items():
        for name, circles in SvgPage(tmp_path / "out" / listing["pages"][number - 1]).circles.items():
            index = int(name.removeprefix("target-"))
            assert np.abs(circles[0, :2] - entry["shift_mm"] - xy[index]).max() < 1e-5
            # whole, with its tab, on the paper
            assert (circles[0, :2] - 9 >= listing["margin_mm"]).all()
            assert (circles[0, :2] + 9 <= np.array(listing["paper_mm"]) - listing["margin_mm"] + 1e-6).all()
            seen.append(index)
    assert sorted(seen) == list(range(n))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([*PLATE, "--paper", "A9"], "unknown paper 'A9'; use A4, A3, letter, or width and height"),
        ([*PLATE, "--paper", "-200x300"], "paper of -200x300 mm cannot be"),
        ([*PLATE, "--paper", "nanx300"], "cannot be"),
        ([*PLATE, "--paper", "40x60"], "40x60 mm with 10 mm margins leaves 11x31 mm to print on; 50 mm each way are needed"),
        ([*PLATE, "--paper-margin-mm", "-3"], "finite number"),
        ([*PLATE, "--paper-margin-mm", "100"], "100 mm margins leaves -?[0-9]"),
        ([*PLATE, "--overlap-mm", "nan"], "finite number"),
        (["plate", "--rows", 9, "--columns", 9, "--pitch-mm", 45, "--overlap-mm", 95], "an overlap of 95 mm leaves nothing"),
        (
            ["plate", "--rows", 3, "--columns", 3, "--pitch-mm", 400, "--kind", "disc", "--radius-mm", 120],
            "a target of 240 mm does not fit",
        ),
        (["plate", "--rows", 100, "--columns", 100, "--pitch-mm", 250], "needs [0-9]+ sheets or more; up to 400 are made"),
        (["board", "--kind", "mirror"], "'mirror' is not one of"),
        (["board", "--kind", "chessboard", "--corners", "9x6"], "--kind chessboard needs --square-mm"),
        ([*CHESS, "--pitch-mm", 4], "--pitch-mm is nothing of --kind chessboard, which takes --corners, --square-mm"),
        (["board", "--kind", "chessboard", "--corners", "1x6", "--square-mm", 20], "3 to 200 inner corners"),
        (["board", "--kind", "chessboard", "--corners", "190x190", "--square-mm", 500], "is it in millimetres"),
        (["board", "--kind", "chessboard", "--corners", "60x60", "--square-mm", 80, "--paper", "200x200"], "up to 400 are made"),
        (["board", "--kind", "charuco", "--corners", "9x6", "--square-mm", 20, "--marker-mm", 25], "smaller than its squares"),
        (["board", "--kind", "charuco", "--corners", "20x20", "--square-mm", 20, "--dictionary", "4x4_50"], "marks 0 to 49, not 50"),
        (["board", "--kind", "charuco", "--corners", "9x6", "--square-mm", 20, "--corner-marks", "aruco"], "marks of its own"),
        (["board", "--kind", "rings", "--grid", "9x6", "--pitch-mm", 20, "--inner-radius-mm", 9], "smaller than the ring"),
        (["board", "--kind", "acircles", "--grid", "4x11", "--pitch-mm", 20, "--radius-mm", 15], "touch at a pitch of 20 mm"),
        (["board", "--kind", "acircles", "--grid", "1x2", "--pitch-mm", 20], "at least 2 columns and 3 rows"),
        ([*PLATE, "--measured-mm", "99.7"], "not of the form 99.7x100.1"),
        ([*PLATE, "--measured-mm", "9.97x10.01"], "do not belong to bars of 100 mm"),
        ([*PLATE, "--measured-mm", "97x100"], "its circles are ellipses"),
        (["dish", "--diameter-mm", 300, "--focal-length-mm", 60], "take smaller targets, or allow"),
        (["dish", "--diameter-mm", 300, "--focal-length-mm", 300, "--corner-marks", "aruco"], "corner marks belong to flat patterns"),
        (["dish", "--diameter-mm", 300, "--focal-length-mm", 300, "--largest-strain-percent", 0], "finite number above 0"),
        (["plat", "--rows", 3], "'--rows'"),
        (["plat"], "'plat' is neither a pattern file nor one of plate, dish, grid, board"),
        (["gone.json"], "cannot read the pattern file gone.json"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(words: list[object], message: str, tmp_path: Path) -> None:
    said = refused(dishmap("sheet", *words, "--out", tmp_path / "new" / "out"))
    assert re.search(message, said), said
    if said.startswith("dishmap: "):
        assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_the_input_is_not_overwritten(tmp_path: Path) -> None:
    write_pattern(tmp_path / "pattern.json", plate(2, 2, 45.0))
    before = (tmp_path / "pattern.json").read_bytes()
    assert "would overwrite the input" in refused(dishmap("sheet", tmp_path / "pattern.json", "--out", tmp_path))
    assert (tmp_path / "pattern.json").read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


def test_broken_pattern_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_text('{"format": "dishmap-pattern/1"}')
    assert "lacks the key" in refused(dishmap("sheet", tmp_path / "bad.json", "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_targets_off_the_surface_are_refused() -> None:
    flat = plate(3, 3, 45.0)
    lifted, leaning = flat.center_mm.copy(), flat.normal.copy()
    lifted[4, 2], leaning[4] = 0.5, [0.0, np.sin(0.02), np.cos(0.02)]
    for pattern in (replace(flat, center_mm=lifted), replace(flat, normal=leaning)):
        with pytest.raises(PatternError, match=r"target 4 stands .* print the pattern that was designed"):
            pattern_sheets(pattern, paper_of("A4"))


def test_names_with_odd_letters_go_into_the_files(tmp_path: Path) -> None:
    done = dishmap("sheet", *PLATE, "--name", "plate (Ø 3\\ <&> 漢", "--out", tmp_path)
    assert done.exit_code == 0, (done.output, done.exception)
    assert "plate (Ø 3\\ <&> 漢" in SvgPage(tmp_path / "sheet-001.svg").words[-1]
    assert read_pattern(tmp_path / "pattern.json").name == "plate (Ø 3\\ <&> 漢"
    title = "/Title (plate \\(Ø 3\\\\ <&> ?)"
    assert title.encode("cp1252") in (tmp_path / "sheets.pdf").read_bytes()


def test_the_pdf_asks_for_no_scaling_and_is_well_formed() -> None:
    sheets = pattern_sheets(plate(5, 6, 45.0), paper_of("letter"))
    data = pdf_bytes(sheets.pages, "a plate")
    assert b"/PrintScaling /None" in data
    assert data.count(b"/Type /Page ") == len(sheets.pages) == 2
    place = int(re.search(rb"startxref\n(\d+)\n%%EOF\n$", data)[1])  # type: ignore[index]
    assert data[place:].startswith(b"xref\n")
    for number, row in enumerate(re.findall(rb"(\d{10}) 00000 n \n", data), start=1):
        assert data[int(row) :].startswith(b"%d 0 obj\n" % number)


def test_functions_refuse_what_the_options_would() -> None:
    pattern = plate(3, 3, 45.0)
    for call, message in (
        (lambda: Paper(200.0, 300.0, -1.0), "a margin of -1 mm cannot be"),
        (lambda: pattern_sheets(pattern, paper_of("A4"), overlap_mm=-1.0), "an overlap of -1 mm cannot be"),
        (lambda: pattern_sheets(pattern, paper_of("A4"), corner_marks="stag"), "unknown corner marks 'stag'"),
        (lambda: pattern_sheets(dish(300, 300), paper_of("A4"), largest_strain=2.0), "between 0 and 100 percent, not 200"),
    ):
        with pytest.raises(InputError, match=message):
            call()


@pytest.mark.parametrize("pitch_mm", [21.0, 26.5, 33.0, 47.0, 61.3, 95.0])
@pytest.mark.parametrize("stagger", [False, True])
def test_cuts_pass_between_targets_where_they_can(pitch_mm: float, stagger: bool) -> None:
    """Discs of 20 mm with 1 mm and more between their columns; every second row is moved, which leaves only its own gaps free."""
    piece = pattern_sheets(plate(15, 12, pitch_mm, disc(10.0)), paper_of("A3")).pieces[0]
    if stagger:
        moved = np.where(np.arange(len(piece.keep_mm)) // 12 % 2 == 0, 0.0, pitch_mm)
        keep = piece.keep_mm + np.column_stack([moved, 0 * moved, 0 * moved])
        piece = replace(piece, keep_mm=keep, high_mm=piece.high_mm + [pitch_mm, 0])
    tiles, crosses = tiles_of(piece, paper_of("A4").room_mm)
    assert sorted(np.concatenate([tile.own for tile in tiles]).tolist()) == list(range(len(piece.keep_mm)))
    for tile in tiles:
        keep = piece.keep_mm[tile.own]
        assert len(tile.crossing) == 0
        assert (keep[:, :2] - keep[:, 2:] > tile.cut_low).all()
        assert (keep[:, :2] + keep[:, 2:] < tile.cut_high).all()
        assert (tile.high - tile.low <= paper_of("A4").room_mm + 1e-9).all()
    assert len(crosses)
