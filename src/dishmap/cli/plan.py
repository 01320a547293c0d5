"""`dishmap plan`: what a camera, a lens, a distance and a pattern would give, before they are bought."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dishmap.cli.options import (
    CAMERA_KEY,
    PATH,
    POSITIVE,
    F,
    Grid,
    Number,
    Numbers,
    assumption_options,
    assumptions_of,
    out_folder,
    refuse_overwriting,
)
from dishmap.cli.pattern import PatternGroup, dish_command, dish_of, own_options, pattern_in, plate_command, plate_of
from dishmap.cli.prior_options import SLIDES, Smoothness
from dishmap.cli.terminal import progress, say, table
from dishmap.errors import InputError

if TYPE_CHECKING:
    from dishmap.camera.model import Camera
    from dishmap.planning import PlannedCase
    from dishmap.targets.pattern import Pattern
    from dishmap.transforms import Pose

PLAN, SUMMARY, REPORT = "plan.csv", "summary.json", "report.html"
# More cases than a page can show.
MOST_CASES = 24
ASSUMED = ("ink_spread_percent", "tone_shift_px", "normal_sigma_deg")


def _plan_options(command: F) -> F:
    smooth = (
        "How far the surface strays from its nominal shape, and moves between two photographs, and over which length that changes.  "
        "[default: 0.1 over half of the rim's radius]"
    )
    options = [
        click.option("--camera", "camera_file", type=PATH, help="Camera file of a camera that is there; else --sensor and a lens."),
        click.option("--sensor", type=Grid("pixels along the width and the height"), metavar="WxH", help="Size of the picture in pixels."),
        click.option("--fov-deg", type=Numbers(), metavar="F,F,...", help="Field of view of the lens across the width; several compare."),
        click.option("--lens-mm", type=Numbers(), metavar="L,L,...", help="Focal length of the lens instead, with --pixel-um."),
        click.option("--pixel-um", type=POSITIVE, help="From pixel to pixel of the sensor."),
        click.option("--distance-mm", type=Numbers(), metavar="D,D,...", help="From the pattern's middle to the lens; several compare."),
        click.option("--tilt-deg", type=Number(-90.0, 90.0), help="Of the pattern from facing the camera.  [default: 0]"),
        click.option("--tilt-direction-deg", type=Number(), help="Of the axis that it is tilted about, from its x.  [default: 0]"),
        click.option("--pose-guess", type=PATH, metavar="FILE", help="Pose of the pattern instead of distance and tilt (JSON)."),
        click.option("--contrast-to-noise", type=POSITIVE, default=40.0, show_default=True, help="Ground minus ink over a pixel's noise."),
        click.option("--blur-px", type=POSITIVE, default=0.8, show_default=True, help="Sigma of the lens's blur; pixels add theirs."),
        click.option("--smoothness", type=Smoothness(), metavar="AMPLITUDE_MM:LENGTH_MM", help=smooth),
        click.option(
            "--slide", type=click.Choice(SLIDES), default=SLIDES[0], show_default=True, help="How points follow a displacement, see diff."
        ),
        assumption_options,
        out_folder,
    ]
    for option in reversed(options):
        command = option(command)
    return command


@click.group("plan", cls=PatternGroup, subcommand_metavar="PATTERN|plate|dish [OPTIONS]...")
def plan_group() -> None:
    """Predict how well a camera would measure a pattern, before either is bought: sigmas per target, warnings, and a picture."""


@plan_group.command("PATTERN")
@click.argument("pattern_file", type=PATH, metavar="PATTERN")
@_plan_options
def file_plan(pattern_file: Path, out: Path, **options: Any) -> None:
    """Plan for the pattern of a file."""
    _make(pattern_in(pattern_file, plan_group), pattern_file, out, **options)


@plan_group.command("plate", params=own_options(plate_command))
@_plan_options
def plate_plan(**options: Any) -> None:
    """Plan for a flat plate of targets."""
    shape, rest = _divided(options, plate_command)
    _make(plate_of(**shape), None, **rest)


@plan_group.command("dish", params=own_options(dish_command))
@_plan_options
def dish_plan(**options: Any) -> None:
    """Plan for a dish."""
    shape, rest = _divided(options, dish_command)
    _make(dish_of(**shape), None, **rest)


def _divided(options: dict[str, Any], command: click.Command) -> tuple[dict[str, Any], dict[str, Any]]:
    """The options that say what the pattern is, and the others."""
    own = {str(option.name) for option in own_options(command)}
    return {name: v for name, v in options.items() if name in own}, {name: v for name, v in options.items() if name not in own}


def _make(
    pattern: Pattern,
    pattern_file: Path | None,
    out: Path,
    camera_file: Path | None,
    pose_guess: Path | None,
    contrast_to_noise: float,
    blur_px: float,
    smoothness: tuple[float, float] | None,
    slide: str,
    **options: Any,
) -> None:
    """Plan all cases and write the files."""
    from dishmap.io.atomic import output_folder, write_files
    from dishmap.io.plan_file import format_plans, plans_text
    from dishmap.planning import DEFAULT_AMPLITUDE_MM, Conditions
    from dishmap.planning_report import plan_report

    assumptions = assumptions_of("pose", **{name: options.pop(name) for name in ASSUMED})
    amplitude, length = smoothness or (DEFAULT_AMPLITUDE_MM, None)
    conditions = Conditions(contrast_to_noise, blur_px, amplitude, length, slide, assumptions)
    cameras = _cameras(camera_file, **{name: options.pop(name) for name in ("sensor", "fov_deg", "lens_mm", "pixel_um")})
    asked = list(product(cameras, _poses(pose_guess, **options)))
    if len(asked) > MOST_CASES:
        raise InputError(f"{len(asked)} combinations of lens and distance are too many to compare; give at most {MOST_CASES}")
    files = {"pattern": pattern_file, "camera": camera_file, "pose_guess": pose_guess}
    inputs = {what: path for what, path in files.items() if path is not None}
    for name in (PLAN, SUMMARY, REPORT):
        refuse_overwriting(out / name, list(inputs.values()))
    with output_folder(out):
        cases = _planned(pattern, asked, conditions)
        title = f"Plan: {pattern.name or 'a pattern'} of {len(pattern)} targets"
        report = plan_report(cases, title, {what: str(path) for what, path in inputs.items()})
        write_files(out, {PLAN: format_plans(cases), SUMMARY: plans_text(cases, inputs), REPORT: report})
    _say_plans(cases, out)


def _planned(pattern: Pattern, asked: list[tuple[tuple[str, Camera], tuple[str, Pose]]], conditions: Any) -> list[PlannedCase]:
    """A plan for each camera and pose. Raises the first's error when none can be made."""
    from dishmap.planning import PlannedCase, plan

    cases, first = [], None
    with progress("planning") as tell:
        for number, ((lens, camera), (place, pose)) in enumerate(asked):
            name = f"{lens}, {place}"
            try:
                cases.append(PlannedCase(name, plan(camera, pattern, pose, conditions)))
            except InputError as error:
                first = first or error
                cases.append(PlannedCase(name, None, str(error)))
            tell(number + 1, len(asked))
    if first is not None and all(case.plan is None for case in cases):
        raise first
    return cases


def _cameras(
    camera_file: Path | None,
    sensor: tuple[int, int] | None,
    fov_deg: list[float] | None,
    lens_mm: list[float] | None,
    pixel_um: float | None,
) -> list[tuple[str, Camera]]:
    """Name and camera of each lens to compare. Raises a usage error when the words do not make a camera."""
    import numpy as np

    from dishmap.io.camera_file import read_camera
    from dishmap.planning import camera_of_lens

    if camera_file is not None:
        if any(given is not None for given in (sensor, fov_deg, lens_mm, pixel_um)):
            raise click.UsageError("a --camera file holds its sensor and lens; leave out --sensor, --fov-deg, --lens-mm and --pixel-um")
        return [(camera_file.stem, read_camera(camera_file))]
    if sensor is None or (fov_deg is None) == (lens_mm is None) or (lens_mm is None) != (pixel_um is None):
        raise click.UsageError("give --sensor WxH with --fov-deg, or with --lens-mm and --pixel-um; or give a --camera file")
    if lens_mm is None or pixel_um is None:
        return [(f"{fov:g} deg", camera_of_lens(*sensor, fov)) for fov in fov_deg or ()]
    half_mm = 0.5e-3 * pixel_um * sensor[0]
    return [(f"{lens:g} mm lens", camera_of_lens(*sensor, float(np.degrees(2 * np.arctan2(half_mm, lens))))) for lens in lens_mm]


def _poses(
    pose_guess: Path | None, distance_mm: list[float] | None, tilt_deg: float | None, tilt_direction_deg: float | None
) -> list[tuple[str, Pose]]:
    """Name and camera_from_dish of each place to compare. Raises a usage error when both a pose and a distance are given, or none."""
    import numpy as np

    from dishmap.io.pose_file import read_pose
    from dishmap.simulate.scene import facing_pose

    if pose_guess is not None:
        if any(given is not None for given in (distance_mm, tilt_deg, tilt_direction_deg)):
            raise click.UsageError("give either --pose-guess, or --distance-mm and its tilt, not both")
        return [(pose_guess.stem, read_pose(pose_guess, CAMERA_KEY))]
    if distance_mm is None:
        raise click.UsageError("give --distance-mm, from the pattern's middle to the lens, or --pose-guess")
    tilt, direction = np.radians(tilt_deg or 0.0), np.radians(tilt_direction_deg or 0.0)
    return [(f"{distance:g} mm", facing_pose(distance, tilt, direction)) for distance in distance_mm]


def _say_plans(cases: list[PlannedCase], out: Path) -> None:
    from dishmap.planning_report import comparison_rows
    from dishmap.planning_verdict import plan_verdict

    say("one sigma, median over targets (worst):")
    heads, rows = comparison_rows(cases)
    # one case reads better downwards
    say(table(("", rows[0][0]), list(zip(heads[1:], rows[0][1:], strict=True))) if len(cases) == 1 else table(heads, rows))
    for case in cases:
        told = [case.problem] if case.plan is None else list(plan_verdict(case.plan).warnings)
        for warning in told:
            say(f"  {warning}" if len(cases) == 1 else f"  {case.name}: {warning}")
    say(f"report: {out / REPORT}")
