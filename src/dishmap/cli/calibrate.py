"""`dishmap calibrate`: a camera from photographs of a board."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dishmap.cli.board_options import board_file, board_of, board_options
from dishmap.cli.options import PATH, POSITIVE, out_file, refuse_overwriting
from dishmap.cli.terminal import progress, say, table
from dishmap.errors import InputError, MeasurementError

if TYPE_CHECKING:
    from dishmap.calibration_report import Checks
    from dishmap.camera.board import BoardView
    from dishmap.camera.calibrate import Calibration
    from dishmap.camera.lens_choice import LensChoice
    from dishmap.io.images import Gray
    from dishmap.sheet.boards import CornerBoard
    from dishmap.targets.pattern import Pattern

# Tests hold these to `dishmap.camera.calibrate.LENSES`, `dishmap.camera.problem.READOUTS` and `dishmap.io.camera_formats.SUFFIXES`, which
# are not loaded for a help text.
LENSES = {"4": "opencv4", "5": "opencv5", "8": "opencv8", "12": "opencv12", "fisheye": "fisheye"}
FORMATS = ("ros", "mrcal", "kalibr")
READOUTS = ("global", "rows", "columns")
# The resampling draws the same noise every time, so that the same photographs give the same page.
SEED = 1
# Of photographs left out, so many are named in an error.
LISTED = 3


@dataclass(frozen=True)
class Solver:
    """How the camera is solved for, as the options say."""

    lens: str
    flat: bool
    readout: str


@click.command("calibrate")
@click.argument("photos", nargs=-1, required=True, type=PATH, metavar="PHOTOS...")
@board_options
@click.option("--flat-board", is_flag=True, help="The board is flat and printed exactly (glass): learn no bend, stretch or print error.")
@click.option(
    "--lens",
    type=click.Choice(["auto", *LENSES]),
    default="auto",
    show_default=True,
    help="Number of OpenCV's lens coefficients, or fisheye; auto takes the leanest that is as good as any on views held out.",
)
@click.option(
    "--readout",
    type=click.Choice(["auto", *READOUTS]),
    default="auto",
    show_default=True,
    help="How the camera reads a picture: all at once (global shutter, or nothing moves), or by rows or columns while the board moves.",
)
@click.option("--format", "formats", type=click.Choice(FORMATS), multiple=True, help="Write the camera for another program too.")
@click.option("--working-mm", type=POSITIVE, help="How far away you will measure: errors are stated for there.  [default: at the boards]")
@out_file("Camera file (OpenCV YAML)")
def calibrate_command(
    photos: Sequence[Path],
    board: str,
    flat_board: bool,
    lens: str,
    readout: str,
    formats: Sequence[str],
    working_mm: float | None,
    out: Path,
    **described: Any,
) -> None:
    """Calibrate a camera from 10 to 20 photographs of a flat board, tilted to all sides, with fixed focus and zoom."""
    from threadpoolctl import threadpool_limits

    from dishmap.io.atomic import check_target, output_folder, write_files
    from dishmap.io.camera_file import camera_text
    from dishmap.io.camera_formats import SUFFIXES, camera_in_format

    what = board_of(board, **described)
    files = {form: out.with_suffix(SUFFIXES[form]) for form in formats}
    page = out.with_suffix(".html")
    if out in (page, *files.values()):
        raise InputError(f"--out {out} is the name of another file that is written; give one that ends in .yaml")
    for file in (out, page, *files.values()):
        refuse_overwriting(file, [*photos, *board_file(board)])
        check_target(file)
    # lens models and refits run two at a time; BLAS threads besides would stand in their way
    with output_folder(out.parent), threadpool_limits(limits=1, user_api="blas"):
        names = _names(photos)
        result, choice, not_found = _calibrated(what, photos, names, Solver(lens, flat_board, readout))
        texts = {form: camera_in_format(result.camera, form, out.stem) for form in files}
        checks = replace(_checks(result, choice, working_mm), not_found=not_found)
        made = {out.name: camera_text(result.camera, result), **{files[form].name: text for form, text in texts.items()}}
        write_files(out.parent, made | {page.name: _page(result, checks, photos, names, out)})
    _report(result, checks, names, [out, *files.values()])
    say(f"report: {page}")


def _names(photos: Sequence[Path]) -> list[str]:
    """What each photograph is called: its file's name, or its path where two files have the same name."""
    short = [photo.name for photo in photos]
    names = short if len(set(short)) == len(short) else [str(photo) for photo in photos]
    if len(set(names)) < len(names):
        raise InputError(f"{next(n for n in names if names.count(n) > 1)} is given twice; give each photograph once")
    return names


def _photographs(photos: Sequence[Path], names: Sequence[str]) -> Iterator[tuple[str, Gray]]:
    """Name and pixels of each photograph. Raises InputError for one that is given twice: it would count as two views."""
    from dishmap.io.images import read_gray

    known: dict[bytes, str] = {}
    for photo, name in zip(photos, names, strict=True):
        gray = read_gray(photo)
        same = known.setdefault(hashlib.blake2b(gray.tobytes()).digest(), name)
        if same != name:
            raise InputError(f"{same} and {name} are the same photograph; give each once")
        yield name, gray


def _calibrated(
    board: Pattern | CornerBoard, photos: Sequence[Path], names: Sequence[str], solver: Solver
) -> tuple[Calibration, LensChoice | None, dict[str, str]]:
    """The calibration, why its lens was chosen, and the photographs without a board."""
    from dishmap.camera.charuco import find_charuco_boards
    from dishmap.camera.chessboard import find_boards
    from dishmap.targets.pattern import Pattern

    if isinstance(board, Pattern):
        return _from_circles(board, photos, names, solver)
    with progress("looking for the board") as tell:
        given = _photographs(photos, names)
        if board.dictionary is None or board.marker_mm is None:
            search = find_boards(given, board.corners, board.square_mm, len(photos), tell)
        else:
            marker_mm = sum(board.marker_mm) / 2  # the marks name the corners and are not measured
            search = find_charuco_boards(given, board.corners, board.square_mm, marker_mm, board.dictionary, len(photos), tell)
    _check_enough(len(search.views), search.rejected)
    return *_solved(search.views, search.width_px, search.height_px, solver), search.rejected


def _from_circles(
    pattern: Pattern, photos: Sequence[Path], names: Sequence[str], solver: Solver
) -> tuple[Calibration, LensChoice | None, dict[str, str]]:
    from dishmap.camera.circle_board import find_circle_boards, measured_views

    with progress("looking for the board") as tell:
        search = find_circle_boards(_photographs(photos, names), pattern, len(photos), tell)
    found = search.found
    _check_enough(len(found.views), found.rejected)
    rough, _ = _solved(found.views, found.width_px, found.height_px, solver)
    with progress("measuring the targets") as tell:
        views, lost = measured_views(_photographs(photos, names), pattern, search, rough, len(photos), tell)
    left_out = {**found.rejected, **rough.rejected, **lost}
    _check_enough(len(views), left_out)
    return *_solved(views, found.width_px, found.height_px, solver), left_out


def _check_enough(count: int, left_out: dict[str, str]) -> None:
    """Raise MeasurementError when photographs that were left out are why too few remain, with the reasons of some."""
    from dishmap.camera.screening import FEWEST_VIEWS

    if count < FEWEST_VIEWS and left_out:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(left_out.items())[:LISTED])
        more = f"; and {len(left_out) - LISTED} more" if len(left_out) > LISTED else ""
        raise MeasurementError(
            f"only {count} of {count + len(left_out)} photographs show the board well enough, and at least {FEWEST_VIEWS} are needed; "
            f"left out: {reasons}{more}"
        )


def _solved(views: Sequence[BoardView], width_px: int, height_px: int, solver: Solver) -> tuple[Calibration, LensChoice | None]:
    from dishmap.camera.calibrate import calibrate
    from dishmap.camera.lens_choice import choose_lens, likely_readout

    if solver.lens != "auto":
        lens, readout = LENSES[solver.lens], "global" if solver.readout == "auto" else solver.readout
        made = calibrate(views, width_px, height_px, lens, solver.flat, readout)
        if solver.readout == "auto" and (moving := likely_readout(made)[0]) != readout:
            made = calibrate(views, width_px, height_px, lens, solver.flat, moving)
        return made, None
    with progress("trying lens models") as tell:
        return choose_lens(views, width_px, height_px, solver.flat, solver.readout, tell)


def _checks(result: Calibration, choice: LensChoice | None, working_mm: float | None) -> Checks:
    import numpy as np

    from dishmap.calibration_report import Checks
    from dishmap.camera.advice import suggestions
    from dishmap.camera.compare_cameras import halves_of
    from dishmap.camera.resample import resample

    with progress("checking the claims") as tell:
        sampled = resample(result, np.random.default_rng(SEED), progress=tell, distance_mm=working_mm)
    return Checks(choice, halves_of(result, working_mm), sampled, suggestions(result, distance_mm=working_mm))


def _page(result: Calibration, checks: Checks, photos: Sequence[Path], names: Sequence[str], out: Path) -> str:
    """The report, with the photograph of the typical view under its first map."""
    import numpy as np

    from dishmap.calibration_report import calibration_report
    from dishmap.io.images import read_gray

    typical = result.view_names[int(np.argsort(result.view_rms_px)[len(result.views) // 2])]
    image = read_gray(photos[list(names).index(typical)])
    inputs = {"photographs": ", ".join(names), "photograph shown": typical, "camera file": out.name}
    return calibration_report(result, f"Calibration of {out.name}", checks, image, inputs)


def _report(result: Calibration, checks: Checks, names: Sequence[str], files: Sequence[Path]) -> None:
    import numpy as np

    from dishmap.calibration_report import board_words, headline, remarks_on
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
    taken = f"{len(result.views)} of {len(names)} photographs used"
    say(f"{taken}, rms {result.rms_px:.3f} px, corners cover {result.coverage:.0%} of the picture")
    say(board_words(result))
    say(headline(result, checks))
    if checks.choice is not None:
        say(f"lens: {checks.choice.reason}")
        if checks.choice.readout_reason:
            say(f"readout: {checks.choice.readout_reason}")
    assert camera.covariance is not None
    sigmas = np.sqrt(np.diag(camera.covariance))
    values = zip(camera.parameter_names, camera.parameters, sigmas, strict=True)
    say(table(["", "value", "sigma"], [[n, f"{v:.6g}", f"{s:.2g}"] for n, v, s in values]))
    for remark in remarks_on(result, checks):
        say(f"  note: {remark}")
    if checks.suggestions:
        say(f"  next: {checks.suggestions[0].words}")
    say(f"camera file: {', '.join(map(str, files))}")
