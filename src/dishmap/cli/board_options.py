"""Options that describe a calibration board, and the board that they mean."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dishmap.cli.options import POSITIVE, F, Grid

if TYPE_CHECKING:
    from dishmap.sheet.boards import CornerBoard
    from dishmap.targets.pattern import Pattern

# Tests hold these to `dishmap.sheet.boards.BOARDS` and `dishmap.camera.charuco.DICTIONARIES`, which are not loaded for a help text.
BOARDS = ("chessboard", "charuco", "circles", "acircles", "rings")
DICTIONARIES = ("4x4_50", "4x4_250", "5x5_100", "5x5_1000", "6x6_250")
# Options beside --corners and --square-mm that each kind of board takes.
TAKES = {
    "chessboard": (),
    "charuco": ("marker_mm", "dictionary"),
    "circles": ("radius_mm", "no_orientation_marks"),
    "acircles": ("radius_mm",),
    "rings": ("radius_mm", "no_orientation_marks"),
}


def board_options(command: F) -> F:
    """`--board` and the options that say more of it; `board_of` makes the board of them."""
    options = [
        click.option(
            "--board",
            default="chessboard",
            show_default=True,
            metavar="|".join((*BOARDS, "FILE.json")),
            help="What is photographed. A file that `dishmap sheet` wrote (board.json, pattern-printed.json, ...) says all of it.",
        ),
        click.option(
            "--corners", type=Grid(), metavar="NxM", help="Inner corners (where four squares meet), or circles, along the two sides."
        ),
        click.option("--square-mm", type=POSITIVE, help="Side of a square, or pitch of circles, as printed: measure it."),
        click.option("--radius-mm", type=POSITIVE, help="Of circles, or of rings.  [default: as `dishmap sheet board` prints them]"),
        click.option("--no-orientation-marks", is_flag=True, help="Circles or rings that all look alike."),
        click.option("--marker-mm", type=POSITIVE, help="Side of the marks of a ChArUco board.  [default: 0.75 of a square]"),
        click.option("--dictionary", type=click.Choice(DICTIONARIES), help="Of a ChArUco board.  [default: 5x5_1000]"),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def board_file(board: str) -> list[Path]:
    """The file that `--board` names, if it names one."""
    return [] if board in BOARDS else [Path(board)]


def board_of(board: str, **given: Any) -> Pattern | CornerBoard:
    """The board that the options describe.

    Raises a usage error for options that do not go together, InputError for a board that cannot be or a file that is none.
    """
    words = {name: value for name, value in given.items() if value not in (None, False)}
    if board not in BOARDS:
        return _of_file(board, words)
    _check(board, words)
    from dishmap.sheet import boards

    corners, size = words.pop("corners"), words.pop("square_mm")
    if "no_orientation_marks" in words:
        words["marks"] = not words.pop("no_orientation_marks")
    build = {
        "chessboard": boards.chessboard,
        "charuco": boards.charuco,
        "circles": boards.circles_board,
        "acircles": boards.asymmetric_board,
        "rings": boards.rings_board,
    }[board]
    return build(corners, size, **words)  # type: ignore[operator]


def _of_file(file: str, words: dict[str, Any]) -> Pattern | CornerBoard:
    from dishmap.io.board_file import read_drawn

    if not file.lower().endswith(".json"):
        raise click.UsageError(
            f"--board takes {', '.join(BOARDS)} or a file that says what is printed (board.json, pattern.json as `dishmap sheet` writes "
            f"them), not {file!r}"
        )
    if words:
        names = ", ".join(_option(name) for name in words)
        raise click.UsageError(f"a board's file says itself what is printed; leave out {names}")
    return read_drawn(file)


def _check(board: str, words: dict[str, Any]) -> None:
    for name in words:
        if name not in ("corners", "square_mm", *TAKES[board]):
            raise click.UsageError(f"{_option(name)} means nothing to --board {board}; leave it out")
    if "corners" not in words or "square_mm" not in words:
        raise click.UsageError(f"--board {board} needs --corners and --square-mm")


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"
