"""`dishmap calibrate`: a camera from photographs of a board."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dishmap.cli.options import PATH, POSITIVE, Grid, out_file, refuse_overwriting
from dishmap.cli.terminal import progress, say, table
from dishmap.errors import InputError

if TYPE_CHECKING:
    from dishmap.camera.calibrate import Calibration
    from dishmap.io.images import Gray

# A test holds these to `dishmap.camera.calibrate.LENSES`.
LENSES = {"4": "opencv4", "5": "opencv5", "8": "opencv8", "12": "opencv12", "fisheye": "fisheye"}


@click.command("calibrate")
@click.argument("photos", nargs=-1, required=True, type=PATH, metavar="PHOTOS...")
@click.option("--board", type=click.Choice(["chessboard"]), default="chessboard", show_default=True, help="What is photographed.")
@click.option("--corners", type=Grid(), required=True, metavar="NxM", help="Inner corners (where four squares meet) along the two sides.")
@click.option("--square-mm", type=POSITIVE, required=True, help="Side of a square as printed: measure it.")
@click.option(
    "--lens", type=click.Choice(list(LENSES)), default="5", show_default=True, help="Number of OpenCV's lens coefficients, or fisheye."
)
@out_file("Camera file (OpenCV YAML)")
def calibrate_command(photos: Sequence[Path], board: str, corners: tuple[int, int], square_mm: float, lens: str, out: Path) -> None:
    """Calibrate a camera from 10 to 20 photographs of a flat board, tilted to all sides, with fixed focus and zoom."""
    from dishmap.camera.calibrate import calibrate
    from dishmap.camera.chessboard import find_boards
    from dishmap.io.atomic import output_folder, write_text
    from dishmap.io.camera_file import write_camera
    from dishmap.report import calibration_report

    page = out.with_suffix(".html")
    for file in (out, page):
        refuse_overwriting(file, list(photos))
    with output_folder(out.parent):
        names = _names(photos)
        with progress("looking for the board") as tell:
            search = find_boards(_photographs(photos, names), corners, square_mm, len(photos), tell)
        result = calibrate(search.views, search.width_px, search.height_px, LENSES[lens])
        write_camera(out, result.camera, result)
        write_text(page, calibration_report(result, f"Calibration of {out.name}"))
    _report(result, search.rejected, names, out)
    say(f"report: {page}")


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


def _report(result: Calibration, not_found: dict[str, str], names: Sequence[str], out: Path) -> None:
    import numpy as np

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
    assert camera.covariance is not None
    sigmas = np.sqrt(np.diag(camera.covariance))
    values = zip(camera.parameter_names, camera.parameters, sigmas, strict=True)
    say(table(["", "value", "sigma"], [[n, f"{v:.6g}", f"{s:.2g}"] for n, v, s in values]))
    for note in result.notes:
        say(f"  note: {note}")
    say(f"camera file: {out}")
