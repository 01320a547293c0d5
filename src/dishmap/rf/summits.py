"""The highest of the summits that climbs from many starts reach."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.climb import Aim, Summit, climb
from dishmap.rf.limits import Limits
from dishmap.rf.starts import Start, least_squares, starts_around
from dishmap.rf.surrogate import Tracer, linear_tracer

Array = NDArray[np.float64]

# So many of the best summits on the linear model are climbed again with exact paths; two closer than this in mean gain are one.
EXACT, SAME_DB = 3, 1e-3


def highest(
    trace: Tracer, aim: Aim, limits: Limits, fades: bool = True, progress: Callable[[int, int], None] | None = None
) -> tuple[Summit, Array]:
    """The best summit, and mean gains (S,) at which the climbs ended; fades: whether currents change with the actuators, as in `climb`."""
    tell = progress or (lambda done, whole_of_it: None)
    best = least_squares(trace, aim, limits)
    quick = linear_tracer(best.traced)
    starts = starts_around(best, quick, aim, limits)
    ends = []
    for i, start in enumerate(starts):
        ends.append(climb(quick, aim, limits, *_of(start, aim), fades=False))
        tell(i + 1, len(starts) + EXACT)
    summits = []
    for end in _different(ends)[:EXACT]:
        # the exact antenna may not be able to go where the linear one went
        with suppress(InputError):
            summits.append(climb(trace, aim, limits, end.values, end.uv, fades))
        tell(len(starts) + len(summits), len(starts) + EXACT)
    if not summits:
        summits.append(climb(trace, aim, limits, *_of(best.start, aim), fades))
    tell(len(starts) + EXACT, len(starts) + EXACT)
    return max(summits, key=lambda s: s.mean_dbi), np.array([e.mean_dbi for e in ends])


def _of(start: Start, aim: Aim) -> tuple[Array, Array]:
    return start.values, np.tile(start.uv, (len(aim.wavenumbers), 1))


def _different(ends: list[Summit]) -> list[Summit]:
    """Summits from the highest down, each height once."""
    kept: list[Summit] = []
    for end in sorted(ends, key=lambda e: -e.mean_dbi):
        if not kept or kept[-1].mean_dbi - end.mean_dbi > SAME_DB:
            kept.append(end)
    return kept
