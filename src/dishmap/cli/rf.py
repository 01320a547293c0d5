"""`dishmap rf`: what a measured shape costs in gain, and how the subreflector or the feed wins it back."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dishmap.cli.options import PATH, Numbers, out_folder
from dishmap.cli.terminal import progress, say, table
from dishmap.errors import InputError

if TYPE_CHECKING:
    from dishmap.rf.analysis import RfAnalysis
    from dishmap.rf.antenna import Antenna
    from dishmap.rf.goals import Goal

FREQUENCY = "--frequency-ghz"
REPORT = "report.html"
# What is beyond was typed in another unit.
HIGHEST_GHZ = 3000.0


class SeveralNumbers(click.Command):
    """A command whose option FREQUENCY takes all numbers that follow it."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Give each further number an option of its own."""
        return super().parse_args(ctx, repeated(args))


def repeated(args: list[str]) -> list[str]:
    """Words in which FREQUENCY stands before every number that follows it: click's options take one word each."""
    out: list[str] = []
    taking = False
    for place, word in enumerate(args):
        if word == "--":
            return [*out, *args[place:]]
        first = bool(out) and out[-1] == FREQUENCY
        if taking and not first and _is_number(word):
            out.append(FREQUENCY)
        taking = word == FREQUENCY or (taking and (first or _is_number(word)))
        out.append(word)
    return out


def _is_number(word: str) -> bool:
    try:
        return bool([float(part) for part in word.split(",")])
    except ValueError:
        return False


@click.command("rf", cls=SeveralNumbers)
@click.argument("shape", type=PATH)
@click.option("--antenna", "antenna_file", type=PATH, required=True, help="Antenna file (TOML).")
@click.option(
    FREQUENCY,
    "frequencies",
    type=Numbers(),
    multiple=True,
    required=True,
    metavar="GHZ...",
    help="One or more frequencies.",
)
@out_folder
@click.option(
    "--correct", is_flag=True, help="Find the pose (and shape, where it can change) of the subreflector or feed that wins most back."
)
@click.option(
    "--pointing",
    type=click.Choice(["free", "fixed"]),
    default="free",
    show_default=True,
    help="Whether the antenna is pointed anew, so that gain counts at the beam's peak, or gain counts on the boresight.",
)
@click.option(
    "--target-beam",
    metavar="GOAL",
    help="A beam to make with the same actuators: steer:THETA,PHI, broaden:RADIUS_DEG or mask:FILE.",
)
@click.option("--whole-motion", is_flag=True, help="Take the rigid motion of the dish as its own, not as the camera's.")
@click.option("--camera", "camera_file", type=PATH, help="Camera file of a map.  [default: the one that its summary.json names]")
@click.option("--pattern", "pattern_file", type=PATH, help="Pattern file of a map.  [default: the one that its summary.json names]")
def rf_command(shape: Path, antenna_file: Path, out: Path, **given: Any) -> None:
    """What the SHAPE of a dish costs in gain, and how the subreflector (or the feed at the prime focus) wins it back.

    SHAPE is a folder that `dishmap diff` or `dishmap map` left, or its difference.npz, difference.csv or measurement.npz.
    """
    from dishmap.io.antenna_file import read_antenna
    from dishmap.io.atomic import output_folder
    from dishmap.io.camera_file import read_camera
    from dishmap.io.pattern_file import read_pattern
    from dishmap.io.shape_input import read_shape_field, shape_file
    from dishmap.rf.analysis import RfOptions, analyse

    begin = time.perf_counter()
    antenna = read_antenna(antenna_file)
    options = RfOptions(frequencies_of(given["frequencies"]), given["correct"], given["pointing"], goal_of(given["target_beam"]))
    quantity = quantity_of(shape_file(shape), given["whole_motion"])
    camera_file, pattern_file = given["camera_file"], given["pattern_file"]
    check_asked(antenna, options.goal is not None, quantity, {"--camera": camera_file, "--pattern": pattern_file})
    if out.resolve() == shape_file(shape).parent.resolve():
        raise InputError(f"--out {out} is the folder of the shape, whose own report and summary would be lost; give another folder")
    camera = None if camera_file is None else read_camera(camera_file)
    pattern = None if pattern_file is None else read_pattern(pattern_file)
    field = read_shape_field(shape, antenna.reflector, "shape" if quantity == "surface" else quantity, camera, pattern)
    read = time.perf_counter()
    mask = mask_of(given["target_beam"])
    inputs = inputs_of(shape, antenna_file) | {
        what: path for what, path in (("camera", camera_file), ("pattern", pattern_file), ("mask", mask)) if path is not None
    }
    with output_folder(out):
        with progress("from shape to gain") as tell:
            analysis = analyse(field, quantity, antenna, options, lambda what, done, total: tell(done, total))
        leave(analysis, inputs, {"read": read - begin, "analyse": time.perf_counter() - read}, title_of(shape), out)
    print_analysis(analysis, title_of(shape), out)


def check_asked(antenna: Antenna, beam: bool, quantity: str, of_maps: dict[str, Path | None]) -> None:
    """Raises InputError for a beam to make without anything that moves, and for files that only a map needs beside a difference."""
    moves = antenna.actuators
    if beam and not any((*moves.shift_mm, *moves.tilt_deg, moves.shape_degree)):
        raise InputError("--target-beam needs something that moves, and all strokes in [actuators] are 0; give some, or leave it out")
    named = next((option for option, path in of_maps.items() if path is not None), None)
    if named is not None and quantity != "surface":
        raise InputError(f"{named} is for a map of `dishmap map`, and the shape is a difference, which needs none; leave it out")


def frequencies_of(given: tuple[list[float], ...]) -> tuple[float, ...]:
    """All frequencies, as given. Raises InputError for one that is given twice, or in another unit."""
    frequencies = tuple(frequency for some in given for frequency in some)
    if max(frequencies) > HIGHEST_GHZ:
        raise InputError(f"{FREQUENCY} {max(frequencies):g} is beyond {HIGHEST_GHZ:g} GHz; frequencies are in GHz, not in MHz or Hz")
    twice = next((f for f in frequencies if frequencies.count(f) > 1), None)
    if twice is not None:
        raise InputError(f"{FREQUENCY} names {twice:g} GHz twice; name each frequency once")
    return frequencies


def goal_of(given: str | None) -> Goal | None:
    """The goal in the words of --target-beam. Raises InputError for words that are none."""
    from dishmap.io.mask_file import read_mask
    from dishmap.rf.goals import Broaden, Steer

    if given is None:
        return None
    kind, _, rest = given.partition(":")
    try:
        if kind == "steer":
            theta, phi = (float(part) for part in rest.split(","))
            if abs(theta) < 90 and math.isfinite(phi):
                return Steer.degrees(theta, phi)
        if kind == "broaden":
            return Broaden(float(rest))
    except ValueError:
        pass
    if kind == "mask" and rest:
        return read_mask(rest)
    raise InputError(f"--target-beam {given!r} is none of steer:THETA,PHI (degrees), broaden:RADIUS_DEG and mask:FILE")


def mask_of(given: str | None) -> Path | None:
    """The file that --target-beam names, if it does."""
    return Path(given.removeprefix("mask:")) if given is not None and given.startswith("mask:") else None


def quantity_of(file: Path, whole_motion: bool) -> str:
    """What the shape in a file is of. Raises InputError for the motion of a map, which has none."""
    from dishmap.io.difference_map_file import is_difference_map

    if file.suffix.lower() != ".csv" and not is_difference_map(file):
        if whole_motion:
            raise InputError(f"--whole-motion asks for the motion between two states, and {file} is a map of one; leave it out")
        return "surface"
    return "displacement" if whole_motion else "shape"


def inputs_of(shape: Path, antenna_file: Path) -> dict[str, Path]:
    """What each of the files behind a shape and an antenna is -> its path."""
    from dishmap.io.antenna_file import feed_path
    from dishmap.io.shape_input import shape_file

    feed = feed_path(antenna_file)
    return {"shape": shape_file(shape), "antenna": antenna_file, **({} if feed is None else {"feed": feed})}


def leave(analysis: RfAnalysis, inputs: dict[str, Path], seconds: dict[str, float], title: str, out: Path) -> None:
    """Write all files of an analysis."""
    from dishmap.io.rf_results import RfProvenance, rf_files, write_rf
    from dishmap.rf_report import rf_report

    files = rf_files(analysis, RfProvenance(inputs, seconds))
    page = rf_report(analysis, title, {what: str(path) for what, path in inputs.items()})
    write_rf(out, {**files, REPORT: page})


def title_of(shape: Path) -> str:
    """The heading of a report."""
    return f"Gain with the shape of {shape}"


def print_analysis(analysis: RfAnalysis, title: str, out: Path) -> None:
    """Print what the shape costs and what wins it back."""
    from dishmap.rf_tables import brief_rows, commands_of, correction_rows
    from dishmap.rf_verdict import rf_verdict

    verdict = rf_verdict(analysis)
    say(title)
    say(f"  {verdict.headline}")
    say(table(*brief_rows(analysis)))
    for name in commands_of(analysis):
        heads, rows = correction_rows(analysis, name)
        say(f"  {name}:")
        say(table(heads, rows))
    for warning in verdict.warnings:
        say(f"  {warning.replace('`', '')}")
    say(f"report: {out / REPORT}")
