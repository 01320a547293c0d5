"""`dishmap map`: measure all targets in one photograph."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import click

from dishmap.cli.options import (
    PATH,
    SPACECRAFT_KEY,
    assumption_options,
    assumptions_of,
    camera_option,
    hint_for,
    hint_of,
    hint_options,
    out_folder,
)
from dishmap.cli.outcome import print_summary, write_outcome
from dishmap.cli.terminal import progress


@click.command("map")
@click.argument("photo", type=PATH)
@camera_option
@click.option("--pattern", "pattern_file", type=PATH, required=True, help="Pattern file (JSON).")
@out_folder
@hint_options
@click.option(
    "--method",
    type=click.Choice(["pose", "paper"]),
    default="pose",
    show_default=True,
    help="Fit to the raw pixels, or the paper's Algorithm 1 (of a grid: 2).",
)
@click.option(
    "--surface", metavar="BASIS", help="plane, polynomial:DEGREE, zernike:DEGREE, paraboloid or cylinder.  [default: as the pattern's]"
)
@click.option("--spacecraft", type=PATH, metavar="FILE", help="Pose of the spacecraft's frame (JSON, spacecraft_from_camera).")
@assumption_options
def map_command(
    photo: Path,
    camera_file: Path,
    pattern_file: Path,
    out: Path,
    pose_guess: Path | None,
    upright: bool,
    anchors: tuple[tuple[int, float, float], ...],
    method: str,
    surface: str | None,
    spacecraft: Path | None,
    **assumed: Any,
) -> None:
    """Measure all targets in one photograph, and fit a surface through them."""
    from dishmap.io.atomic import output_folder
    from dishmap.io.camera_file import read_camera
    from dishmap.io.images import read_gray
    from dishmap.io.pattern_file import read_pattern
    from dishmap.io.pose_file import read_pose
    from dishmap.io.results import Provenance
    from dishmap.pipeline import map_photograph
    from dishmap.surface.fit import parse_basis

    assumptions = assumptions_of(method, **assumed)
    hint = hint_of(pose_guess, upright, anchors)
    basis = None if surface is None else parse_basis(surface)
    camera, pattern = read_camera(camera_file), read_pattern(pattern_file)
    frame = None if spacecraft is None else read_pose(spacecraft, SPACECRAFT_KEY)
    inputs = {"photograph": photo, "camera": camera_file, "pattern": pattern_file, "pose_guess": pose_guess, "spacecraft": spacecraft}
    with output_folder(out):
        begin = time.perf_counter()
        image, hint = read_gray(photo), hint_for(hint, photo)
        read = time.perf_counter()
        with progress("measuring") as tell:
            result = map_photograph(image, camera, pattern, hint, method, basis, assumptions, tell)
        seconds = {"read_photograph": read - begin, "map": time.perf_counter() - read}
        given = {what: path for what, path in inputs.items() if path is not None}
        provenance = Provenance(camera, given, hint, assumptions, frame, seconds)
        write_outcome(out, result, image, photo.name, provenance)
    print_summary(result, str(photo), out)
