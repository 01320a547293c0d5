"""`dishmap calibrate`: a camera from photographs of a board."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dishmap.cli.options import PATH, POSITIVE, F, Grid, out_file, refuse_overwriting
from dishmap.cli.terminal import progress, say, table
from dishmap.errors import InputError

if TYPE_CHECKING:
    from dishmap.calibration_report import Checks
    from dishmap.camera.board import BoardView
    from dishmap.camera.calibrate import Calibration
    from dishmap.camera.lens_choice import LensChoice
    from dishmap.io.images import Gray
    from dishmap.targets.pattern import Pattern

# Tests hold these to `dishmap.camera.calibrate.LENSES`, `dishmap.sheet.boards.BOARDS`, `dishmap.camera.charuco.DICTIONARIES` and
# `dishmap.io.camera_formats.SUFFIXES`, which are not loaded for the sake of a help text.
LENSES = {"4": "opencv4", "5": "opencv5", "8": "opencv8", "12": "opencv12", "fisheye": "fisheye"}
BOARDS = ("chessboard", "charuco", "circles", "acircles", "rings")
DICTIONARIES = ("4x4_50", "4x4_250", "5x5_100", "5x5_1000", "6x6_250")
FORMATS = ("ros", "mrcal", "kalibr")
# The resampling draws the same noise every time, so that the same photographs give the same page.
SEED = 1


@dataclass(frozen=True)
class Board:
    """The board as the options describe it."""

    kind: str
    corners: tuple[int, int] | None
    square_mm: float | None
    radius_mm: float | None
    marks: bool
    marker_mm: float | None
    dictionary: str


def _board_options(command: F) -> F:
    options = [
        click.option(
            "--board", default="chessboard", show_default=True, metavar="|".join((*BOARDS, "PATTERN.json")), help="What is photographed."
        ),
        click.option(
            "--corners", type=Grid(), metavar="NxM", help="Inner corners (where four squares meet), or circles, along the two sides."
        ),
        click.option("--square-mm", type=POSITIVE, help="Side of a square, or pitch of circles, as printed: measure it."),
        click.option("--radius-mm", type=POSITIVE, help="Of circles, or of rings.  [default: as `dishmap sheet board` prints them]"),
        click.option("--no-orientation-marks", "plain", is_flag=True, help="Circles or rings that all look alike."),
        click.option("--marker-mm", type=POSITIVE, help="Side of the marks of a ChArUco board.  [default: 0.75 of a square]"),
        click.option("--dictionary", type=click.Choice(DICTIONARIES), default="5x5_1000", show_default=True, help="Of a ChArUco board."),
        click.option("--flat-board", is_flag=True, help="The board is flat (glass): do not allow for a bend."),
    ]
    for option in reversed(options):
        command = option(command)
    return command


@click.command("calibrate")
@click.argument("photos", nargs=-1, required=True, type=PATH, metavar="PHOTOS...")
@_board_options
@click.option(
    "--lens",
    type=click.Choice(["auto", *LENSES]),
    default="auto",
    show_default=True,
    help="Number of OpenCV's lens coefficients, or fisheye; auto takes the leanest that is as good as any on views held out.",
)
@click.option("--format", "formats", type=click.Choice(FORMATS), multiple=True, help="Write the camera for another program too.")
@out_file("Camera file (OpenCV YAML)")
def calibrate_command(
    photos: Sequence[Path],
    board: str,
    corners: tuple[int, int] | None,
    square_mm: float | None,
    radius_mm: float | None,
    plain: bool,
    marker_mm: float | None,
    dictionary: str,
    flat_board: bool,
    lens: str,
    formats: Sequence[str],
    out: Path,
) -> None:
    """Calibrate a camera from 10 to 20 photographs of a flat board, tilted to all sides, with fixed focus and zoom."""
    from dishmap.io.atomic import output_folder, write_text
    from dishmap.io.camera_file import write_camera
    from dishmap.io.camera_formats import SUFFIXES, camera_in_format

    described = _checked(Board(board, corners, square_mm, radius_mm, not plain, marker_mm, dictionary))
    files = {form: out.with_suffix(SUFFIXES[form]) for form in formats}
    page = out.with_suffix(".html")
    for file in (out, page, *files.values()):
        refuse_overwriting(file, list(photos))
    with output_folder(out.parent):
        names = _names(photos)
        result, choice, not_found = _calibrated(described, photos, names, lens, flat_board)
        texts = {form: camera_in_format(result.camera, form, out.stem) for form in files}
        checks = _checks(result, choice)
        write_camera(out, result.camera, result)
        for form, text in texts.items():
            write_text(files[form], text)
        write_text(page, _page(result, checks, photos, names, out))
    _report(result, checks, not_found, names, [out, *files.values()])
    say(f"report: {page}")


def _checked(board: Board) -> Board:
    """The board, or a usage error for options that do not go together."""
    if board.kind not in BOARDS and not board.kind.lower().endswith(".json"):
        raise click.UsageError(f"--board takes {', '.join(BOARDS)} or a pattern file that ends in .json, not {board.kind!r}")
    if board.kind in BOARDS and (board.corners is None or board.square_mm is None):
        raise click.UsageError(f"--board {board.kind} needs --corners and --square-mm")
    if board.kind not in BOARDS and (board.corners is not None or board.square_mm is not None or board.radius_mm is not None):
        raise click.UsageError("a pattern file says itself what is printed; leave out --corners, --square-mm and --radius-mm")
    if board.radius_mm is not None and board.kind not in ("circles", "acircles", "rings"):
        raise click.UsageError(f"--radius-mm means nothing to --board {board.kind}; leave it out")
    if board.marker_mm is not None and board.kind != "charuco":
        raise click.UsageError(f"--marker-mm means nothing to --board {board.kind}; leave it out")
    return board


def _names(photos: Sequence[Path]) -> list[str]:
    """What each photograph is called: its file's name, or its path where two files have the same name."""
    short = [photo.name for photo in photos]
    names = short if len(set(short)) == len(short) else [str(photo) for photo in photos]
    if len(set(names)) < len(names):
        raise InputError(f"{next(n for n in names if names.count(n) > 1)} is given twice; give each photograph once")
    return names


def _photographs(photos: Sequence[Path], names: Sequence[str]) -> Iterator[tuple[str, Gray]]:
    from dishmap.io.images import read_gray

    for photo, name in zip(photos, names, strict=True):
        yield name, read_gray(photo)


def _calibrated(
    board: Board, photos: Sequence[Path], names: Sequence[str], lens: str, flat: bool
) -> tuple[Calibration, LensChoice | None, dict[str, str]]:
    """The calibration, why its lens was chosen, and the photographs without a board."""
    if board.kind not in ("chessboard", "charuco"):
        return _from_circles(_pattern(board), photos, names, lens, flat)
    from dishmap.camera.charuco import find_charuco_boards
    from dishmap.camera.chessboard import find_boards

    assert board.corners is not None
    assert board.square_mm is not None
    with progress("looking for the board") as tell:
        given = _photographs(photos, names)
        if board.kind == "chessboard":
            search = find_boards(given, board.corners, board.square_mm, len(photos), tell)
        else:
            search = find_charuco_boards(given, board.corners, board.square_mm, board.marker_mm, board.dictionary, len(photos), tell)
    return *_solved(search.views, search.width_px, search.height_px, lens, flat), search.rejected


def _from_circles(
    pattern: Pattern, photos: Sequence[Path], names: Sequence[str], lens: str, flat: bool
) -> tuple[Calibration, LensChoice | None, dict[str, str]]:
    from dishmap.camera.circle_board import find_circle_boards, measured_views

    with progress("looking for the board") as tell:
        search = find_circle_boards(_photographs(photos, names), pattern, len(photos), tell)
    found = search.found
    rough, _ = _solved(found.views, found.width_px, found.height_px, lens, flat)
    with progress("measuring the targets") as tell:
        views, lost = measured_views(_photographs(photos, names), pattern, search, rough, len(photos), tell)
    left_out = {**found.rejected, **rough.rejected, **lost}
    return *_solved(views, found.width_px, found.height_px, lens, flat), left_out


def _solved(views: Sequence[BoardView], width_px: int, height_px: int, lens: str, flat: bool) -> tuple[Calibration, LensChoice | None]:
    from dishmap.camera.calibrate import calibrate
    from dishmap.camera.lens_choice import choose_lens

    if lens != "auto":
        return calibrate(views, width_px, height_px, LENSES[lens], flat), None
    with progress("trying lens models") as tell:
        return choose_lens(views, width_px, height_px, flat, tell)


def _pattern(board: Board) -> Pattern:
    """The pattern of a board of circles."""
    if board.kind not in BOARDS:
        from dishmap.io.pattern_file import read_pattern

        return read_pattern(board.kind)
    from dishmap.sheet.boards import asymmetric_board, circles_board, rings_board

    assert board.corners is not None
    assert board.square_mm is not None
    if board.kind == "acircles":
        return asymmetric_board(board.corners, board.square_mm, board.radius_mm)
    if board.kind == "rings":
        return rings_board(board.corners, board.square_mm, board.radius_mm, marks=board.marks)
    return circles_board(board.corners, board.square_mm, board.radius_mm, board.marks)


def _checks(result: Calibration, choice: LensChoice | None) -> Checks:
    import numpy as np

    from dishmap.calibration_report import Checks
    from dishmap.camera.advice import suggestions
    from dishmap.camera.compare_cameras import halves_of
    from dishmap.camera.resample import resample

    with progress("checking the claims") as tell:
        sampled = resample(result, np.random.default_rng(SEED), progress=tell)
    return Checks(choice, halves_of(result), sampled, suggestions(result))


def _page(result: Calibration, checks: Checks, photos: Sequence[Path], names: Sequence[str], out: Path) -> str:
    """The report, with the photograph of the typical view under its first map."""
    import numpy as np

    from dishmap.calibration_report import calibration_report
    from dishmap.io.images import read_gray

    typical = result.view_names[int(np.argsort(result.view_rms_px)[len(result.views) // 2])]
    image = read_gray(photos[list(names).index(typical)])
    inputs = {"photographs": ", ".join(names), "photograph shown": typical, "camera file": out.name}
    return calibration_report(result, f"Calibration of {out.name}", checks, image, inputs)


def _report(result: Calibration, checks: Checks, not_found: dict[str, str], names: Sequence[str], files: Sequence[Path]) -> None:
    import numpy as np

    from dishmap.calibration_report import headline, remarks_on
    from dishmap.transforms import angle_between_rad

    camera = result.camera
    rows = []
    for view, inlier, rms, residual, pose in zip(
        result.views, result.used, result.view_rms_px, result.residuals_px, result.poses, strict=True
    ):
        largest = float(np.linalg.norm(residual[inlier], axis=1).max())
        tilt = float(np.degrees(angle_between_rad(pose.rotation[:, 2], np.array([0.0, 0.0, 1.0]))))
        rows.append([view.name, f"{inlier.sum()}/{len(inlier)}", f"{rms:.3f}", f"{largest:.2f}", f"{min(tilt, 180 - tilt):.0f}"])
    say(table(["photograph", "corners", "rms px", "largest px", "tilt deg"], rows))
    rejected = {**not_found, **result.rejected}
    for name in names:
        if name in rejected:
            say(f"  left out: {name}: {rejected[name]}")
    taken = f"{len(result.views)} of {len(names)} photographs used"
    say(f"{taken}, rms {result.rms_px:.3f} px, corners cover {result.coverage:.0%} of the picture")
    say(headline(result, checks))
    if checks.choice is not None:
        say(f"lens: {checks.choice.reason}")
    assert camera.covariance is not None
    sigmas = np.sqrt(np.diag(camera.covariance))
    values = zip(camera.parameter_names, camera.parameters, sigmas, strict=True)
    say(table(["", "value", "sigma"], [[n, f"{v:.6g}", f"{s:.2g}"] for n, v, s in values]))
    for remark in remarks_on(result, checks):
        say(f"  note: {remark}")
    if checks.suggestions:
        say(f"  next: {checks.suggestions[0].words}")
    say(f"camera file: {', '.join(map(str, files))}")
