"""Board files: what is written is read; what is not a board is refused in one sentence."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dishmap.errors import InputError
from dishmap.io.board_file import format_board, read_drawn
from dishmap.io.pattern_file import write_pattern
from dishmap.sheet.boards import CornerBoard, charuco, chessboard, rings_board
from dishmap.targets.pattern import Pattern


@pytest.mark.parametrize("board", [chessboard((9, 6), 20.0), charuco((8, 5), 25.0, 18.0, "4x4_50")], ids=["chessboard", "charuco"])
def test_boards_are_read_as_they_were_written(tmp_path: Path, board: CornerBoard) -> None:
    for number, drawn in enumerate((board, board.scaled(np.array([0.997123456, 1.00123]))), start=1):
        file = tmp_path / f"{number}.json"
        file.write_text(format_board(drawn))
        read = read_drawn(file)
        assert isinstance(read, CornerBoard)
        assert (read.kind, read.corners, read.dictionary) == (drawn.kind, drawn.corners, drawn.dictionary)
        # six digits of a millimetre
        assert read.square_mm == pytest.approx(drawn.square_mm, abs=5.1e-7)
        assert read.marker_mm == (None if drawn.marker_mm is None else pytest.approx(drawn.marker_mm, abs=5.1e-7))
        assert format_board(read) == format_board(drawn) or np.allclose(read.corners_mm, drawn.corners_mm, atol=1e-5)


def test_pattern_files_are_read_too(tmp_path: Path) -> None:
    write_pattern(tmp_path / "pattern.json", rings_board((7, 5), 20.0))
    assert isinstance(read_drawn(tmp_path / "pattern.json"), Pattern)


def changed(**keys: Any) -> str:
    return json.dumps({k: v for k, v in (json.loads(format_board(chessboard((9, 6), 20.0))) | keys).items() if v is not ...})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not valid JSON"),
        ("[1, 2]", "needed"),
        ('{"format": "dishmap-sheets/1", "drawn": "board.json"}', "lists the sheets; give board.json beside it"),
        ('{"format": "dishmap-board/2"}', "has the format 'dishmap-board/2'"),
        (changed(square=20), "unknown key 'square'; a board file has format, board, corners, square_mm"),
        (changed(corners=...), "the file lacks the key 'corners'"),
        (changed(board="hexagons"), "board must be 'chessboard' or 'charuco', not 'hexagons'"),
        (changed(square_mm=[20.0, -20.0]), "square_mm.1 must be greater than 0, not -20.0"),
        (changed(square_mm=[20.0, 25.0]), "square_mm .20, 25. are no sides of a square"),
        (changed(square_mm=[0.02, 0.02]), "squares of 0.02 mm make a board of 9x6 corners 0.16 mm long; .* is it in millimetres?"),
        (changed(square_mm=[20.5, 20.5]), "corners_mm does not agree with corners and square_mm; change both"),
        (changed(dictionary="4x4_50"), "marker_mm and dictionary mean nothing to a chessboard"),
        (changed(board="charuco"), "a ChArUco board needs marker_mm and dictionary"),
        (changed(board="charuco", marker_mm=[15.0, 15.0], dictionary="9x9"), "unknown dictionary '9x9'"),
    ],
)
def test_what_is_no_board(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "board.json").write_text(text)
    with pytest.raises(InputError, match=message) as error:
        read_drawn(tmp_path / "board.json")
    assert str(error.value).startswith(f"{tmp_path / 'board.json'}")
    assert "\n" not in str(error.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot read the board file .*: No such file or directory"):
        read_drawn(tmp_path / "none.json")
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is no board file: it is not text in UTF-8"):
        read_drawn(tmp_path / "bytes.json")
