"""Options that say what is known before two states are compared, and how their words become priors."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import click

from dishmap.cli.options import POSITIVE, Number

if TYPE_CHECKING:
    from dishmap.difference.priors import Priors

F = TypeVar("F", bound=Callable[..., Any])

SLIDES = ("least_strain", "normal", "axial", "any")
# More ids than any pattern has: a range such as 0-1000000 is a mistake.
MOST_IDS = 100_000
_MEAN_SIGMA = re.compile(r"(.+?)(?:\+-|\+/-|±)(.+)")


class Strain(click.ParamType):  # type: ignore[type-arg]  # generic in click's latest versions only
    """`rigid`, `free` or a standard deviation such as 1e-5."""

    name = "strain"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str | float:
        """The word or the number, or a usage error."""
        if value in ("rigid", "free"):
            return str(value)
        try:
            return float(value)
        except ValueError:
            self.fail(f"{value!r} is not rigid, free or a standard deviation such as 1e-5", param, ctx)


class MeanSigma(click.ParamType):  # type: ignore[type-arg]  # generic in click's latest versions only
    """A mean and its standard deviation, such as 20+-5."""

    name = "mean+-sigma"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        """The two numbers, or a usage error."""
        if isinstance(value, tuple):
            return value
        parts = _MEAN_SIGMA.fullmatch(str(value).replace(" ", ""))
        try:
            mean, sigma = (float(part) for part in parts.groups()) if parts else (math.nan, math.nan)
        except ValueError:
            mean = sigma = math.nan
        if not (math.isfinite(mean) and math.isfinite(sigma)):
            self.fail(f"{value!r} is not of the form 20+-5 (a mean and its standard deviation)", param, ctx)
        return mean, sigma


class Smoothness(click.ParamType):  # type: ignore[type-arg]  # generic in click's latest versions only
    """How far and how smoothly, such as 0.2:150."""

    name = "amplitude_mm:length_mm"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        """The two lengths, or a usage error."""
        if isinstance(value, tuple):
            return value
        parts = str(value).split(":")
        if len(parts) != 2:
            self.fail(f"{value!r} is not of the form 0.2:150 (amplitude and correlation length in mm)", param, ctx)
        return POSITIVE.convert(parts[0], param, ctx), POSITIVE.convert(parts[1], param, ctx)


class Ids(click.ParamType):  # type: ignore[type-arg]  # generic in click's latest versions only
    """Ids and ranges of them, such as 0,1,5-8."""

    name = "ids"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        """The ids, or a usage error."""
        if isinstance(value, tuple):
            return value
        ids: set[int] = set()
        for part in str(value).split(","):
            ends = re.fullmatch(r"\s*(\d{1,9})(?:-(\d{1,9}))?\s*", part, re.ASCII)
            first, last = (int(ends[1]), int(ends[2] or ends[1])) if ends else (1, 0)
            if not first <= last < first + MOST_IDS:
                self.fail(f"{value!r} is not of the form 0,1,5-8 (ids and ranges of ids)", param, ctx)
            ids |= set(range(first, last + 1))
        return tuple(sorted(ids))


def prior_options(command: F) -> F:
    """What is known beforehand of how the surface may move."""
    options = (
        click.option("--still", is_flag=True, help="The surface moves as a rigid body: only its motion is estimated."),
        click.option(
            "--strain",
            type=Strain(),
            metavar="rigid|free|SIGMA",
            help="Whether the surface, and prints on it, stretch: not at all, by any amount, or with this sigma.  [default: learnt]",
        ),
        click.option(
            "--slide",
            type=click.Choice(SLIDES),
            help="How points follow a displacement: with the least strain, along normals, along the boresight, or in any smooth way.  "
            "[default: weighed]",
        ),
        click.option(
            "--expansion-ppm",
            type=MeanSigma(),
            metavar="MEAN+-SIGMA",
            help="How much the surface expanded.  [default: none, unless the picture's scale changed by more than 0.1 %]",
        ),
        click.option(
            "--focal-drift",
            type=Number(),
            default=0.0,
            help="By which part the focal length may have changed: sigma.  [default: 0]",
        ),
        click.option(
            "--smoothness",
            type=Smoothness(),
            metavar="AMPLITUDE_MM:LENGTH_MM",
            help="How far the surface moves along its normal, and over which length that changes.  [default: learnt]",
        ),
        click.option("--rigid-ids", type=Ids(), metavar="IDS", help="Targets on rigid parts, such as 0,1,5-8."),
    )
    for option in reversed(options):
        command = option(command)
    return command


def priors_of(
    method: str,
    still: bool,
    strain: str | float | None,
    slide: str | None,
    expansion_ppm: tuple[float, float] | None,
    focal_drift: float,
    smoothness: tuple[float, float] | None,
    rigid_ids: tuple[int, ...] | None,
) -> Priors:
    """The priors that the options give. Raises a usage error for a method that takes none, InputError for impossible ones."""
    from dishmap.difference.priors import Priors

    amplitude, length = smoothness or (None, None)
    given = Priors(still, amplitude, length, strain, slide, expansion_ppm, focal_drift, rigid_ids or ())
    if method == "paper" and given != Priors():
        raise click.UsageError(
            "--still, --strain, --slide, --expansion-ppm, --focal-drift, --smoothness and --rigid-ids mean nothing to --method paper; "
            "leave them out"
        )
    return given
