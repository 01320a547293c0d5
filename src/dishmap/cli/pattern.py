"""`dishmap pattern`: write the file of a pattern to be printed."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dishmap.cli.options import POSITIVE, F, Number, Numbers, out_file
from dishmap.cli.terminal import say
from dishmap.errors import InputError

if TYPE_CHECKING:
    from dishmap.targets.pattern import Pattern, TargetKind

# Tests hold these to SURFACE_NAMES of `dishmap.targets.grid_builders` and KIND_BUILDERS of `builders`, which are not loaded for the sake of
# a help text.
SURFACES = ("plane", "dish", "cylinder")
KINDS = ("disc", "ring", "concentric", "multi", "whycon")


def _kind_options(command: F) -> F:
    options = [
        click.option(
            "--kind", type=click.Choice(KINDS), default="multi", show_default=True, help="Kind of target; multi is a group of rings."
        ),
        click.option("--radius-mm", type=POSITIVE, help="Of a disc.  [default: 5]"),
        click.option("--outer-radius-mm", type=POSITIVE, help="Of a ring.  [default: 5; whycon: 6]"),
        click.option("--inner-radius-mm", type=Number(-1e-12), help="Of a ring; 0 makes multi a group of discs.  [default: 3]"),
        click.option("--ratio", type=Number(0.0, 1.0), help="Inner over outer radius of whycon.  [default: 0.41]"),
        click.option("--radii-mm", type=Numbers(), metavar="R,R,...", help="Of concentric circles.  [default: 10,8,6,4]"),
        click.option("--count", type=click.IntRange(1, 12), help="Rings of multi.  [default: 4]"),
        click.option("--side-mm", type=POSITIVE, help="Side of the polygon on whose corners the rings of multi lie.  [default: 14]"),
        click.option("--orientation-marks", is_flag=True, help="Let a few targets look different, so that no turn is ambiguous."),
        click.option("--name", default="", help="Name of the pattern, written into the file."),
        out_file("Pattern file (JSON)"),
    ]
    for option in reversed(options):
        command = option(command)
    return command


@click.group("pattern")
def pattern_group() -> None:
    """Write a pattern file: what is printed, and where."""


@pattern_group.command("plate")
@click.option("--rows", type=click.IntRange(1), required=True, help="Rows of targets.")
@click.option("--columns", type=click.IntRange(1), required=True, help="Columns of targets.")
@click.option("--pitch-mm", type=POSITIVE, required=True, help="From target to target, both ways.")
@_kind_options
def plate_command(out: Path, **options: Any) -> None:
    """A flat plate of targets on a square lattice."""
    _write(plate_of(**options), out)


@pattern_group.command("dish")
@click.option("--diameter-mm", type=POSITIVE, required=True, help="Of the rim.")
@click.option("--focal-length-mm", type=POSITIVE, required=True, help="Of the paraboloid.")
@click.option("--spacing-mm", type=POSITIVE, default=45.0, show_default=True, help="From circle to circle, and along each.")
@click.option("--margin-mm", type=Number(), help="From the outermost targets' centres to the rim.  [default: the targets' radius]")
@click.option("--no-center-target", is_flag=True, help="Leave the vertex free.")
@_kind_options
def dish_command(out: Path, **options: Any) -> None:
    """A paraboloid with targets on concentric circles."""
    _write(dish_of(**options), out)


class PatternGroup(click.Group):
    """A group whose first word is a command, or else a pattern file, which is for its command PATTERN."""

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[str | None, click.Command | None, list[str]]:
        """The command of that name, or the one for pattern files."""
        if args and args[0] not in self.commands and not args[0].startswith("-"):
            return "PATTERN", self.commands["PATTERN"], args
        return super().resolve_command(ctx, args)


def pattern_in(file: Path, group: click.Group) -> Pattern:
    """The pattern of a file given as first word to a PatternGroup. Raises InputError for a word that is neither file nor command."""
    from dishmap.io.pattern_file import read_pattern

    if not file.suffix and not file.exists():
        words = ", ".join(name for name in group.commands if name != "PATTERN")
        raise InputError(f"{str(file)!r} is neither a pattern file nor one of {words}; give one of these")
    return read_pattern(file)


def own_options(command: click.Command) -> list[click.Parameter]:
    """The options that say what a pattern is, as `dishmap pattern` has them."""
    return [option for option in command.params if option.name != "out"]


def plate_of(rows: int, columns: int, pitch_mm: float, orientation_marks: bool, name: str, **kind: Any) -> Pattern:
    """The plate that the options of `pattern plate` describe."""
    from dishmap.targets.builders import plate

    target, kind_name = kind_of(**kind)
    return plate(rows, columns, pitch_mm, target, kind_name, orientation_marks, name)


def dish_of(
    diameter_mm: float,
    focal_length_mm: float,
    spacing_mm: float,
    margin_mm: float | None,
    no_center_target: bool,
    orientation_marks: bool,
    name: str,
    **kind: Any,
) -> Pattern:
    """The dish that the options of `pattern dish` describe."""
    from dishmap.targets.builders import dish

    target, kind_name = kind_of(**kind)
    return dish(diameter_mm, focal_length_mm, spacing_mm, target, kind_name, orientation_marks, margin_mm, not no_center_target, name)


def _grid_options(command: F) -> F:
    options = [
        click.option("--columns", type=click.IntRange(1), required=True, help="Places along x."),
        click.option("--rows", type=click.IntRange(1), required=True, help="Places along y."),
        click.option("--pitch-mm", type=POSITIVE, required=True, help="From place to place along the surface."),
        click.option("--line-mm", type=POSITIVE, help="Width of the lines of a grid of lines."),
        click.option("--square-mm", type=POSITIVE, help="Side of the squares of a grid of squares."),
        click.option("--surface", type=click.Choice(SURFACES), default="plane", show_default=True, help="What the grid is printed on."),
        click.option("--diameter-mm", type=POSITIVE, help="Of a dish's rim."),
        click.option("--focal-length-mm", type=POSITIVE, help="Of a dish."),
        click.option("--cylinder-radius-mm", type=Number(), help="Of a cylinder along y: negative if it is hollow towards the camera."),
        click.option("--orientation-marks", is_flag=True, help="Let a few squares be open, or put squares into a few cells between lines."),
        click.option("--name", default="", help="Name of the pattern, written into the file."),
        out_file("Pattern file (JSON)"),
    ]
    for option in reversed(options):
        command = option(command)
    return command


@pattern_group.command("grid")
@_grid_options
def grid_command(out: Path, **options: Any) -> None:
    """A grid of lines or of separate squares."""
    _write(grid_of(**options), out)


def grid_of(
    columns: int,
    rows: int,
    pitch_mm: float,
    line_mm: float | None,
    square_mm: float | None,
    surface: str,
    diameter_mm: float | None,
    focal_length_mm: float | None,
    cylinder_radius_mm: float | None,
    orientation_marks: bool,
    name: str,
) -> Pattern:
    """The grid that the options describe. Sizes that are lacking or that this surface does not have are usage errors."""
    from dishmap.targets.grid_builders import SURFACE_NAMES, grid, grid_surface

    sizes = {"diameter_mm": diameter_mm, "focal_length_mm": focal_length_mm, "cylinder_radius_mm": cylinder_radius_mm}
    for size, value in sizes.items():
        if (value is None) == (size in SURFACE_NAMES[surface]):
            said = "needs" if value is None else "does not take"
            raise click.UsageError(f"--surface {surface} {said} {_word(size)}")
    if (line_mm is None) == (square_mm is None):
        raise click.UsageError("a grid is made of lines or of squares: give --line-mm or --square-mm, and not both")
    return grid(columns, rows, pitch_mm, line_mm, square_mm, grid_surface(surface, **sizes), orientation_marks, name)


def kind_of(kind: str, **sizes: Any) -> tuple[TargetKind, str]:
    """The kind of target that the options describe, and its name. A size that this kind does not have is a usage error."""
    from dishmap.targets.builders import KIND_BUILDERS

    build = KIND_BUILDERS[kind]
    given = {name: value for name, value in sizes.items() if value is not None}
    takes = list(inspect.signature(build).parameters)
    for name in given:
        if name not in takes:
            raise click.UsageError(f"{_word(name)} is no size of --kind {kind}, which takes {', '.join(map(_word, takes))}")
    count = given.get("count", inspect.signature(build).parameters["count"].default) if kind == "multi" else ""
    return build(**given), f"{kind}{count}"


def _word(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _write(pattern: Pattern, out: Path) -> None:
    from dishmap.io.atomic import output_folder
    from dishmap.io.pattern_file import write_pattern

    with output_folder(out.parent):
        write_pattern(out, pattern)
    say(f"{out}: {len(pattern)} targets ({', '.join(pattern.kinds)})")
    say_identity(pattern)


def say_identity(pattern: Pattern) -> None:
    """Say what a photograph of the pattern would leave open."""
    from dishmap.targets.symmetry import symmetry_poses

    same = len(symmetry_poses(pattern))
    if same:
        say(
            f"  the pattern looks the same after {same} turn{'s' * (same > 1)}, so `dishmap map` needs --upright or --pose-guess; "
            "--orientation-marks avoids that"
        )
    if pattern.is_grid and len(pattern.kinds) == 1:
        say("  the grid is uniform, and a photograph of a part of it could be of any part; --orientation-marks avoids that too")
