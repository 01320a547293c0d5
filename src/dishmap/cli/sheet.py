"""`dishmap sheet`: paper to print, for patterns and calibration boards."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dishmap.cli.options import PATH, POSITIVE, F, Grid, Number, Numbers, out_folder, refuse_overwriting
from dishmap.cli.pattern import (
    PatternGroup,
    dish_command,
    dish_of,
    grid_command,
    grid_of,
    own_options,
    pattern_in,
    plate_command,
    plate_of,
    say_identity,
)
from dishmap.cli.terminal import say

if TYPE_CHECKING:
    from dishmap.sheet.boards import CornerBoard
    from dishmap.sheet.sheets import Sheets
    from dishmap.targets.pattern import Pattern

# Tests hold these to `dishmap.sheet.boards` and `dishmap.sheet.markers`, which are not loaded for the sake of a help text.
BOARDS = ("chessboard", "charuco", "circles", "acircles", "rings")
DICTIONARIES = ("4x4_50", "4x4_250", "5x5_100", "5x5_1000", "6x6_250")
CORNER_MARKS = ("aruco", "apriltag")
# So many numbers are listed in a message.
LISTED = 8
# Ellipses by less than this part look no more tilted than 2 degrees.
UNEVEN = 0.0006
SHEET_OPTIONS = ("paper", "paper_margin_mm", "overlap_mm", "corner_marks", "measured_mm", "largest_strain_percent")


class Measured(click.ParamType):  # type: ignore[type-arg]  # generic in click's latest versions only
    """Two lengths with an x between them, such as 99.7x100.1."""

    name = "lengths"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> list[float]:
        """The two lengths, or a usage error."""
        numbers = Numbers().convert(str(value).lower().replace("x", ","), param, ctx)
        if len(numbers) != 2:
            self.fail(f"{value!r} is not of the form 99.7x100.1 (the bars to the right and upwards, in mm)", param, ctx)
        return numbers


def _sheet_options(command: F) -> F:
    bars = "Lengths of the printed scale bars, to the right and upwards: writes the pattern as printed, instead of sheets."
    options = [
        click.option("--paper", default="A4", show_default=True, metavar="A4|A3|letter|WxH", help="Paper, by name or size in mm."),
        click.option("--paper-margin-mm", type=Number(-1e-12), default=10.0, show_default=True, help="What the printer leaves free."),
        click.option("--overlap-mm", type=Number(-1e-12), default=10.0, show_default=True, help="Of sheets that are glued together."),
        click.option("--corner-marks", type=click.Choice(CORNER_MARKS), help="Add marks 0 to 3 at the corners of a flat pattern."),
        click.option("--measured-mm", type=Measured(), metavar="XxY", help=bars),
        out_folder,
    ]
    for option in reversed(options):
        command = option(command)
    return command


_strain_option = click.option(
    "--largest-strain-percent",
    type=Number(0.0, 100.0),
    default=0.2,
    show_default=True,
    help="How much larger than on the dish a target may be printed; smaller takes more gores.",
)


@click.group("sheet", cls=PatternGroup, subcommand_metavar="PATTERN|plate|dish|grid|board [OPTIONS]...")
def sheet_group() -> None:
    """Print a pattern or a calibration board at true scale: PDF and SVG, with the pattern file beside them."""


@sheet_group.command("PATTERN")
@click.argument("pattern_file", type=PATH, metavar="PATTERN")
@_strain_option
@_sheet_options
def file_command(pattern_file: Path, largest_strain_percent: float, out: Path, **options: Any) -> None:
    """Sheets of a pattern file."""
    pattern = pattern_in(pattern_file, sheet_group)
    for name in ("pattern.json", "pattern-printed.json"):
        refuse_overwriting(out / name, [pattern_file])
    _make(pattern, out, largest_strain_percent=largest_strain_percent, **options)


@sheet_group.command("plate", params=own_options(plate_command))
@_sheet_options
def plate_sheet(out: Path, **options: Any) -> None:
    """Sheets of a flat plate of targets."""
    _make(plate_of(**_without_sheet_options(options)), out, **_only_sheet_options(options))


@sheet_group.command("dish", params=own_options(dish_command))
@_strain_option
@_sheet_options
def dish_sheet(out: Path, **options: Any) -> None:
    """Gores of a dish, to glue on or to cut stencils from."""
    _make(dish_of(**_without_sheet_options(options)), out, **_only_sheet_options(options))


@sheet_group.command("grid", params=own_options(grid_command))
@_strain_option
@_sheet_options
def grid_sheet(out: Path, **options: Any) -> None:
    """Sheets of a grid of lines or squares; a cylinder's unrolled, a dish's as cap and gores."""
    _make(grid_of(**_without_sheet_options(options)), out, **_only_sheet_options(options))


@sheet_group.command("board")
@click.option("--kind", type=click.Choice(BOARDS), required=True, help="Kind of board; acircles is OpenCV's asymmetric grid.")
@click.option("--corners", type=Grid(), metavar="NxM", help="Inner corners of a chessboard or ChArUco board along x and y.")
@click.option("--square-mm", type=POSITIVE, help="Side of its squares.")
@click.option("--marker-mm", type=POSITIVE, help="Side of a ChArUco board's marks.  [default: 3/4 of the squares]")
@click.option("--dictionary", type=click.Choice(DICTIONARIES), help="Of a ChArUco board's marks.  [default: 5x5_1000]")
@click.option("--grid", type=Grid(), metavar="NxM", help="Circles or rings along x and y.")
@click.option("--pitch-mm", type=POSITIVE, help="From circle to circle; of acircles, between neighbouring rows.")
@click.option("--radius-mm", type=POSITIVE, help="Of a circle, or a ring's outer edge.  [default: 0.3 to 0.4 of the pitch]")
@click.option("--inner-radius-mm", type=POSITIVE, help="Of a ring's hole.  [default: half of the outer one]")
@click.option("--no-orientation-marks", is_flag=True, help="Let all circles or rings look alike.")
@_sheet_options
def board_sheet(kind: str, out: Path, **options: Any) -> None:
    """Sheets of a board to calibrate a camera with."""
    from dishmap.sheet import boards

    given = {name: value for name, value in _without_sheet_options(options).items() if value not in (None, False)}
    build, needs, takes = {
        "chessboard": (boards.chessboard, ("corners", "square_mm"), ()),
        "charuco": (boards.charuco, ("corners", "square_mm"), ("marker_mm", "dictionary")),
        "circles": (boards.circles_board, ("grid", "pitch_mm"), ("radius_mm", "no_orientation_marks")),
        "acircles": (boards.asymmetric_board, ("grid", "pitch_mm"), ("radius_mm",)),
        "rings": (boards.rings_board, ("grid", "pitch_mm"), ("radius_mm", "inner_radius_mm", "no_orientation_marks")),
    }[kind]
    _check_words(kind, given, needs, takes)
    if "no_orientation_marks" in given:
        given["marks"] = not given.pop("no_orientation_marks")
    _make(build(**given), out, board=True, **_only_sheet_options(options))  # type: ignore[operator]


def _check_words(kind: str, given: dict[str, Any], needs: tuple[str, ...], takes: tuple[str, ...]) -> None:
    """Raise a usage error for options that this kind of board does not have, or lacks."""
    for name in given:
        if name not in needs + takes:
            raise click.UsageError(f"{_word(name)} is nothing of --kind {kind}, which takes {', '.join(map(_word, needs + takes))}")
    for name in needs:
        if name not in given:
            raise click.UsageError(f"--kind {kind} needs {_word(name)}")


def _word(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _only_sheet_options(options: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if name in SHEET_OPTIONS}


def _without_sheet_options(options: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if name not in SHEET_OPTIONS}


def _make(
    what: Pattern | CornerBoard,
    out: Path,
    paper: str,
    paper_margin_mm: float,
    overlap_mm: float,
    corner_marks: str | None,
    measured_mm: list[float] | None,
    largest_strain_percent: float = 0.2,
    board: bool = False,
) -> None:
    """Write the sheets of a pattern or a board, or with measured bars what they became. board: it is for calibration."""
    from dishmap.io.atomic import output_folder, write_text
    from dishmap.io.sheet_file import drawn_name, format_drawn, write_sheets
    from dishmap.sheet.boards import CornerBoard
    from dishmap.sheet.paper import paper_of
    from dishmap.sheet.sheets import as_printed, board_sheets, pattern_sheets

    on = paper_of(paper, paper_margin_mm)
    with output_folder(out):
        if isinstance(what, CornerBoard):
            sheets = board_sheets(what, on, overlap_mm, corner_marks)
        else:
            sheets = pattern_sheets(what, on, overlap_mm, largest_strain_percent / 100, corner_marks)
        if measured_mm is not None:
            name = drawn_name(what, printed=True)
            write_text(out / name, format_drawn(as_printed(sheets, measured_mm)))
        else:
            write_sheets(out, sheets)
    if measured_mm is not None:
        _say_printed(sheets, measured_mm, out / name)
    else:
        _say_sheets(sheets, out, board)


def _say_printed(sheets: Sheets, measured_mm: list[float], file: Path) -> None:
    from dishmap.targets.pattern import Pattern

    scale = [measured / sheets.paper.bar_mm for measured in measured_mm]
    say(f"{file}: as printed, {100 * (scale[0] - 1):+.2f} % along x and {100 * (scale[1] - 1):+.2f} % along y of the sheets")
    uneven = abs(scale[0] / scale[1] - 1)
    if uneven >= UNEVEN and isinstance(sheets.what, Pattern) and not sheets.what.is_grid:
        say(
            f"  circles are ellipses by {uneven:.2%}, which a pattern file cannot hold: places are right, but a target seen face on looks "
            "tilted; better print on a printer that is even both ways"
        )


def _say_sheets(sheets: Sheets, out: Path, board: bool) -> None:
    from dishmap.io.sheet_file import PDF_NAME, drawn_name

    paper = sheets.paper
    many = f"{len(sheets.pages)} sheet{'s' * (len(sheets.pages) > 1)}"
    say(f"{out / PDF_NAME}: {many} of {paper.width_mm:g}x{paper.height_mm:g} mm; each is there as SVG too")
    say(f"{out / drawn_name(sheets.what)}: what is printed, for `dishmap {'calibrate --board' if board else 'map --pattern'}`")
    if len(sheets.pieces) > 1 or sheets.strain > 0:
        pieces = f"{len(sheets.pieces)} piece{'s' * (len(sheets.pieces) > 1)}"
        say(f"  {pieces}; a length in a target is printed up to {sheets.strain:.3%} longer than it is on the dish")
    _say_cuts(sheets, board)
    _say_identity(sheets)
    say(f"  print at 100 %, measure both bars, and if they are not {paper.bar_mm:g} mm run this again with --measured-mm XxY")


def _say_cuts(sheets: Sheets, board: bool) -> None:
    from dishmap.targets.pattern import Pattern

    what = sheets.what
    for cut, by in ((sheets.cut_by_edges, "the edge of a gore"), (sheets.cut_by_pages, "the edge of a sheet")):
        if cut and isinstance(what, Pattern):
            names = [str(int(what.ids[k])) if k < len(what) else f"corner mark {k - len(what)}" for k in cut]
            listed = ", ".join(names[:LISTED]) + (f" and {len(names) - LISTED} more" if len(names) > LISTED else "")
            say(f"  {len(names)} target{'s' * (len(names) > 1)} reach over {by} ({listed}): cut around the tabs, glue them on top")
        elif cut:
            say(f"  {len(cut)} corners or marks of the board lie on {by}: take larger paper")
    if board and len(sheets.pages) > 1:
        say("  a board glued of several sheets is hardly flat and true at its joints; larger paper is better")


def _say_identity(sheets: Sheets) -> None:
    from dishmap.targets.pattern import Pattern

    if not isinstance(sheets.what, Pattern):
        if sheets.what.dictionary is None and sheets.what.corners[0] == sheets.what.corners[1]:
            say(
                "  the board looks the same after a quarter turn, so a printer that is uneven along x and y cannot be allowed for; "
                "take more corners one way"
            )
    else:
        say_identity(sheets.what)
