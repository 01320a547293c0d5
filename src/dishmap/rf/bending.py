"""The best shape of a subreflector that can change it: degree by degree, each from the best of the one before.

Of all places reached, the one with the largest gain by exact rays and currents is the answer, the rigid pose among them: a subreflector
that can do more never does worse. Places are sought in two ways: phases alone, which ends where all currents add up whatever becomes of
the light; and with the illumination held as designed (`illumination`).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.antenna import Actuators
from dishmap.rf.climb import Aim, Place, Summit, climb, mean_gain_dbi
from dishmap.rf.illumination import held_as_designed
from dishmap.rf.limits import Limits, limits_up_to, whole
from dishmap.rf.summits import highest
from dishmap.rf.surrogate import Tracer

Array = NDArray[np.float64]

LOWEST_DEGREE = 2


def best_bend(
    actuators: Actuators, trace: Tracer, lit: int, aim: Aim, rigid: Summit, progress: Callable[[int, int], None]
) -> tuple[Summit, Array]:
    """The best summit, and mean gains (S,) at which climbs for phases ended at the highest degree.

    trace: the antenna with currents as they are, of which the first `lit` cover the aperture; rigid: the summit of a rigid pose, whose
    values are those of RIGID that move.
    """
    held = held_as_designed(trace, trace(np.zeros(limits_up_to(actuators, LOWEST_DEGREE).size)).moment, lit)
    best = start = rigid
    ends = np.zeros(0)
    for degree in range(LOWEST_DEGREE, actuators.shape_degree + 1):
        limits = limits_up_to(actuators, degree)
        phases, ends = highest(trace, aim, limits, fades=False)
        reached = []
        for begin in (start, phases):
            with suppress(InputError):
                reached.append(climb(held, aim, limits, _padded(begin.values, limits), begin.uv))
        if reached:
            start = max(reached, key=lambda s: s.mean_dbi)
        with suppress(InputError):
            held(whole(limits, phases.values))
            reached.append(phases)
        best = max([best, *(_as_it_is(trace, aim, limits, one) for one in reached)], key=lambda s: s.mean_dbi)
        progress(degree - LOWEST_DEGREE + 1, actuators.shape_degree - LOWEST_DEGREE + 1)
    return best, ends


def _padded(values: Array, limits: Limits) -> Array:
    """Values that move at a lower degree, with zeros for terms that are new: those come last."""
    return np.concatenate([values, np.zeros(len(limits.used) - len(values))])


def _as_it_is(trace: Tracer, aim: Aim, limits: Limits, summit: Summit) -> Summit:
    """A summit with the currents that are there."""
    there = trace(whole(limits, summit.values))
    return replace(summit, traced=there, mean_dbi=mean_gain_dbi(Place(summit.values, summit.uv, there), aim))
