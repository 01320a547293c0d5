"""Options that several commands share, and how their words become records."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from dishmap.errors import InputError

if TYPE_CHECKING:
    from dishmap.targets.identify import Hint
    from dishmap.targets.stages import Assumptions

F = TypeVar("F", bound=Callable[..., Any])

# Whoever reads a file says what is wrong with it, permissions too.
PATH = click.Path(path_type=Path, readable=False)
CAMERA_KEY, SPACECRAFT_KEY = "camera_from_dish", "spacecraft_from_camera"


class Number(click.ParamType):  # type: ignore[type-arg]  # generic in click's latest versions only
    """A finite number above `above`, and at most `most`."""

    name = "number"

    def __init__(self, above: float = -math.inf, most: float = math.inf) -> None:
        self.above, self.most = above, most

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number, or a usage error."""
        try:
            number = float(value)
        except (TypeError, ValueError):
            self.fail(f"{value!r} is not a number", param, ctx)
        if not (math.isfinite(number) and self.above < number <= self.most):
            limits = f" above {self.above:g}" if math.isfinite(self.above) else ""
            limits += f" up to {self.most:g}" if math.isfinite(self.most) else ""
            self.fail(f"a finite number{limits} is needed, not {value}", param, ctx)
        return number


POSITIVE = Number(above=0.0)


class Numbers(click.ParamType):  # type: ignore[type-arg]  # generic in click's latest versions only
    """Numbers with commas between them, such as 10,8,6."""

    name = "numbers"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> list[float]:
        """The numbers, or a usage error."""
        if isinstance(value, list):
            return value
        return [POSITIVE.convert(part, param, ctx) for part in str(value).split(",")]


class Grid(click.ParamType):  # type: ignore[type-arg]  # generic in click's latest versions only
    """Two whole numbers, such as 14x19; `what` they are is said where they are refused."""

    name = "columnsxrows"

    def __init__(self, what: str = "inner corners along the two sides") -> None:
        self.what = what

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """The two numbers, or a usage error."""
        if isinstance(value, tuple):
            return value
        parts = str(value).lower().split("x")
        if len(parts) != 2 or not all(part.isascii() and part.isdecimal() and len(part) < 7 for part in parts):
            self.fail(f"{value!r} is not of the form 14x19 ({self.what})", param, ctx)
        return int(parts[0]), int(parts[1])


def camera_option(command: F) -> F:
    """`--camera FILE`."""
    return click.option("--camera", "camera_file", type=PATH, required=True, help="Camera file (OpenCV YAML).")(command)


def out_file(what: str) -> Callable[[F], F]:
    """`--out FILE`."""
    return click.option("--out", type=PATH, required=True, help=f"{what} to write.")


def out_folder(command: F) -> F:
    """`--out DIR`."""
    text = "Folder for the results; made if it is not there, other files in it are left alone."
    return click.option("--out", type=PATH, required=True, metavar="DIR", help=text)(command)


class Anchor(click.ParamType):  # type: ignore[type-arg]  # generic in click's latest versions only
    """A target's id and its place in the photograph, such as 17@1203.5,866."""

    name = "id@u,v"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, float, float]:
        """The id, u and v."""
        if isinstance(value, tuple):
            return value
        ident, _, place = str(value).partition("@")
        parts = place.split(",")
        if not (ident.isascii() and ident.isdecimal() and len(ident) < 10 and len(parts) == 2):
            self.fail(f"{value!r} is not of the form 17@1203.5,866 (a target's id, and where it is: u,v in px)", param, ctx)
        u, v = (Number().convert(part, param, ctx) for part in parts)
        return int(ident), u, v


def hint_options(command: F) -> F:
    """`--pose-guess FILE`, `--upright` and `--anchor ID@U,V`: which way round the pattern is."""
    guess = "Approximate pose of the pattern, within 20 degrees and 100 mm (JSON, camera_from_dish)."
    upright = "The camera looks along the pattern's -z with its y up in the photograph, within 45 degrees."
    anchor = "A target of a grid and where it is in the photograph: px as in points.csv, within half a step. May be repeated."
    command = click.option("--anchor", "anchors", type=Anchor(), multiple=True, metavar="ID@U,V", help=anchor)(command)
    command = click.option("--upright", is_flag=True, help=upright)(command)
    return click.option("--pose-guess", type=PATH, metavar="FILE", help=guess)(command)


def hint_of(pose_guess: Path | None, upright: bool, anchors: tuple[tuple[int, float, float], ...]) -> Hint:
    """The hint that the options give. Raises a usage error for a guess beside others, InputError for a bad file."""
    from dishmap.io.pose_file import read_pose
    from dishmap.targets.identify import Anchors, PoseGuess, Upright

    if pose_guess is not None and (upright or anchors):
        raise click.UsageError("give --pose-guess alone, or --upright and --anchor without it")
    if pose_guess is not None:
        return PoseGuess(read_pose(pose_guess, CAMERA_KEY))
    straight = Upright() if upright else None
    if anchors:
        import numpy as np

        return Anchors(tuple(ident for ident, _, _ in anchors), np.array([[u, v] for _, u, v in anchors]), straight)
    return straight


def hint_for(hint: Hint, photo: Path) -> Hint:
    """The hint for the pixels of a photograph: what is upright as viewers show it, after the turn of its EXIF, may lie in them."""
    from dishmap.io.images import read_turn_deg
    from dishmap.targets.identify import Anchors, Upright

    if isinstance(hint, Anchors) and hint.upright is not None:
        return replace(hint, upright=Upright(read_turn_deg(photo)))
    return Upright(read_turn_deg(photo)) if isinstance(hint, Upright) else hint


def assumption_options(command: F) -> F:
    """What is assumed of print and camera, as sigmas."""
    spread = "How far printed edges may lie outwards: sigma, in percent of the largest radius of a target.  [default: 2]"
    tone = "How far the camera's tone curve may shift an edge: sigma.  [default: 0.3]"
    normal = "How far normals stray from the pattern's surface: sigma.  [default: learnt from the photograph]"
    command = click.option("--normal-sigma-deg", type=Number(0.0, 90.0), help=normal)(command)
    command = click.option("--tone-shift-px", type=Number(0.0, 10.0), help=tone)(command)
    return click.option("--ink-spread-percent", type=Number(0.0, 100.0), help=spread)(command)


def assumptions_of(
    method: str, ink_spread_percent: float | None, tone_shift_px: float | None, normal_sigma_deg: float | None
) -> Assumptions:
    """The assumptions that the options give. Raises a usage error for a method that makes none."""
    from dishmap.targets.stages import Assumptions

    given: dict[str, Any] = {
        "ink_spread_fraction": None if ink_spread_percent is None else ink_spread_percent / 100,
        "tone_shift_px": tone_shift_px,
        "normal_sigma_deg": normal_sigma_deg,
    }
    given = {name: value for name, value in given.items() if value is not None}
    if given and method == "paper":
        raise click.UsageError(
            "--ink-spread-percent, --tone-shift-px and --normal-sigma-deg mean nothing to --method paper; leave them out"
        )
    return Assumptions(**given)


def refuse_overwriting(out: Path, inputs: list[Path]) -> None:
    """Raise InputError when the output would take the place of an input."""
    for given in inputs:
        try:
            same = out.exists() and given.exists() and out.samefile(given)
        except (OSError, ValueError):
            same = False  # whoever reads or writes it will say what is wrong with it
        if same:
            raise InputError(f"--out {out} would overwrite the input {given}; give another name")
