"""Shaping the beam with the subreflector: the actuators that correct a dish also steer its beam, broaden it, or fit it into a mask.

The same surrogate as for corrections, towards several directions at once: exact paths, currents held for each step. Climbs begin at the
correction by least squares and at places around it.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.antenna import Antenna
from dishmap.rf.climb import DAMPING, HOPELESS, RIDGE_DB, SETTLED_DB, Aim, aim_of, convex
from dishmap.rf.correct import judging_sources
from dishmap.rf.correction import Correction, correction_of, no_correction
from dishmap.rf.deformation import Deformation
from dishmap.rf.farfield import far_field
from dishmap.rf.feed import ludwig_axes, polarization_axes
from dishmap.rf.goals import Broaden, Goal, Mask, cost, directions, figure
from dishmap.rf.limits import Limits, best_step, limits_up_to, reached, value_names, whole, within
from dishmap.rf.pattern import decibels
from dishmap.rf.sources import illuminated, search_nodes, wavelength_of
from dishmap.rf.starts import Start, away, least_squares
from dishmap.rf.surrogate import DB, Traced, Tracer, linear_tracer, tracer

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# A lowest gain is smoothed by so many dB, step after step.
SMOOTH_DB = (2.0, 0.5, 0.15)
QUICK_STEPS, STEPS, EXACT, SAME = 15, 20, 3, 1e-4
# Starts leave the correction along so many ways, by so many wavelengths of path (rms).
WAYS, WAVES = 4, (0.15, 0.4)


@dataclass(frozen=True)
class BeamShaped:
    """A command that shapes the beam, and how well.

    correction, names, units: as of a correction; directions_uv (D, 2): that the goal looks at; before_dbi, after_dbi (D,): gains towards
    them by full physical optics; before_db, after_db: the goal's figure: gain towards the direction, lowest gain over the disc, or minus
    the worst violation of the mask; bound_dbi: what no actuator could pass, a disc lit evenly by all power, NaN for other goals; met:
    whether a mask is kept, or the figure rose; limits: names of limits reached; converged; starts: how many.
    """

    correction: Correction
    names: tuple[str, ...]
    units: tuple[str, ...]
    frequency_ghz: float
    directions_uv: Array
    before_dbi: Array
    after_dbi: Array
    before_db: float
    after_db: float
    bound_dbi: float
    met: bool
    limits: tuple[str, ...]
    converged: bool
    starts: int


def target_beam(
    antenna: Antenna,
    deformation: Deformation,
    frequency_ghz: float,
    goal: Goal,
    shape: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> BeamShaped:
    """The values of the actuators that bring the beam nearest to a goal.

    shape: whether a subreflector that can change its shape does so. Raises InputError for a goal that is out of reach or contradicts
    itself.
    """
    wavelength = wavelength_of(antenna, frequency_ghz)
    aim = aim_of(np.array([wavelength]), antenna.reflector.diameter_mm, False)
    uv = directions(goal, aim.reach)
    nodes = search_nodes(antenna, deformation, wavelength, float(np.hypot(*uv.T).max()))
    trace = tracer(antenna, illuminated(antenna, deformation, nodes))
    before = _gains(antenna, deformation, no_correction(antenna), wavelength, uv)
    correction, after, settled, count, known = no_correction(antenna), before, True, 0, np.zeros(0)
    # a rigid pose first, then bends of more and more degrees, each begun at the best before: being able to do more never gives less
    degree = antenna.actuators.shape_degree if shape else 0
    for step in (0, *range(2, degree + 1)):
        limits = limits_up_to(antenna.actuators, step)
        known = np.pad(known, (0, len(limits.used) - len(known)))
        values, rested, begun = _nearest(trace, aim, limits, goal, uv, progress, known, step in (0, 2, degree))
        one = correction_of(within(antenna.actuators, whole(limits, values)))
        gains, count = _gains(antenna, deformation, one, wavelength, uv), count + begun
        if figure(goal, gains) >= figure(goal, after):
            correction, after, settled, known = one, gains, rested, values
    names, units = zip(*value_names(antenna.actuators), strict=True)
    bound = 10 * np.log10(2 / (1 - np.cos(np.radians(goal.radius_deg)))) if isinstance(goal, Broaden) else np.nan
    achieved = figure(goal, after)
    return BeamShaped(
        correction=correction,
        names=names,
        units=units,
        frequency_ghz=float(frequency_ghz),
        directions_uv=uv,
        before_dbi=before,
        after_dbi=after,
        before_db=figure(goal, before),
        after_db=achieved,
        bound_dbi=float(bound),
        met=achieved > -0.05 if isinstance(goal, Mask) else achieved > figure(goal, before),
        limits=reached(antenna.actuators, correction),
        converged=settled,
        starts=count,
    )


def _gains(antenna: Antenna, deformation: Deformation, correction: Correction, wavelength: float, uv: Array) -> Array:
    currents = judging_sources(antenna, deformation, correction, wavelength)
    return decibels(np.abs(far_field(currents, wavelength, uv[:, 0], uv[:, 1], antenna.feed.polarization)[0]) ** 2)


def _nearest(
    trace: Tracer, aim: Aim, limits: Limits, goal: Goal, uv: Array, progress: Callable[[int, int], None] | None, known: Array, wide: bool
) -> tuple[Array, bool, int]:
    """The best values (P,), whether the search came to rest, and how many starts there were.

    known (P,): where it begins, with exact paths; wide: whether at other places too.
    """
    tell = progress or (lambda done, whole_of_it: None)
    finals = [_descend(trace, aim, limits, goal, uv, known, SMOOTH_DB, STEPS)]
    if not wide:
        return finals[0][0], finals[0][2], 1
    middle = uv.mean(axis=0) if not isinstance(goal, Mask) else np.zeros(2)
    best = least_squares(trace, aim, limits, middle)
    quick = linear_tracer(best.traced)
    shift = 2 * np.pi / aim.wavenumbers[0]
    starts = [best.start, Start(np.zeros(len(limits.used)), middle)]
    if len(uv) > 1:
        starts += [away(best, sign * far * shift * way, aim, limits) for way in best.ways[:WAYS] for far in WAVES for sign in (-1, 1)]
    ends = []
    for i, start in enumerate(starts):
        ends.append(_descend(quick, aim, limits, goal, uv, start.values, SMOOTH_DB[:1], QUICK_STEPS))
        tell(i + 1, len(starts) + EXACT)
    ends.sort(key=lambda e: e[1])
    # ends at one cost are one place
    distinct = [e for i, e in enumerate(ends) if i == 0 or e[1] - ends[i - 1][1] > SAME]
    for i, (values, _, _) in enumerate(distinct[:EXACT]):
        with suppress(InputError):
            finals.append(_descend(trace, aim, limits, goal, uv, values, SMOOTH_DB[1:], STEPS))
        tell(len(starts) + i + 1, len(starts) + EXACT)
    values, _, settled = min(finals, key=lambda e: e[1])
    return values, settled, len(starts) + 1


def _descend(
    trace: Tracer, aim: Aim, limits: Limits, goal: Goal, uv: Array, values: Array, smooth: tuple[float, ...], steps: int
) -> tuple[Array, float, bool]:
    """Descend to the least cost; values (P,), cost with the last smoothing, and whether it came to rest."""
    here, settled = trace(whole(limits, values)), False
    k = float(aim.wavenumbers[0])
    for smoothing in smooth:
        damping, settled = DAMPING, False
        for _ in range(steps):
            level, slope, bend = _quadratic(here, k, limits, goal, uv, values, smoothing)
            while damping < HOPELESS:
                step = best_step(slope, convex(bend, damping), limits, values, np.zeros(0), limits.scale, 1.0)
                hoped = abs(slope @ (step / limits.scale))
                settled = bool(hoped < 10 * SETTLED_DB)
                there = None if settled else _tried(trace, limits, values + step, here)
                if settled or (there is not None and level - _level(there, here, k, limits, goal, uv, smoothing) > 0.05 * hoped):
                    break
                damping = max(10 * damping, DAMPING)
            if settled or there is None or damping >= HOPELESS:
                break
            here, values, damping = there, values + step, damping / 10
    return values, _level(here, here, k, limits, goal, uv, smooth[-1]), settled


def _tried(trace: Tracer, limits: Limits, values: Array, near: Traced) -> Traced | None:
    try:
        return trace(whole(limits, values), near)
    except InputError:
        return None


def _level(there: Traced, lit: Traced, k: float, limits: Limits, goal: Goal, uv: Array, smoothing: float) -> float:
    """The cost with the currents of the place `lit`, and the ridge."""
    place = there.values[limits.used] / limits.scale
    return cost(goal, gains_dbi(terms(there, lit, k, uv), k), smoothing)[0] + RIDGE_DB * float(place @ place)


def terms(there: Traced, lit: Traced, k: float, uv: Array) -> Complex:
    """What currents add to the fields towards directions (D, 2): (N, D), with the moments of the place `lit`."""
    direction = np.column_stack([uv, np.sqrt(1 - (uv**2).sum(axis=1))])
    axes, _ = polarization_axes(there.polarization, 1, *ludwig_axes(direction))
    phase = k * (there.point_mm @ direction.T - there.path_mm[:, None])
    return np.asarray((lit.moment @ axes.conj().T) * np.exp(1j * phase))


def gains_dbi(shares: Complex, k: float) -> Array:
    """Gains (D,) of what currents add (N, D)."""
    return np.asarray(20 * np.log10(np.maximum(np.abs(shares.sum(axis=0)), 1e-300) * k / np.sqrt(4 * np.pi)))


def _quadratic(
    here: Traced, k: float, limits: Limits, goal: Goal, uv: Array, values: Array, smoothing: float
) -> tuple[float, Array, Array]:
    """Cost, slope (P,) and second derivatives (P, P) per full stroke; gains as in `surrogate.lobe`, all directions at once."""
    share = terms(here, here, k, uv)
    level, first, second = cost(goal, gains_dbi(share, k), smoothing)
    share = share / share.sum(axis=0)
    slopes = -k * here.by_values[:, limits.used] * limits.scale
    mean = share.T @ slopes
    rows, place = -2 * DB * mean.imag, values / limits.scale
    spread = (slopes * (share.real @ first)[:, None]).T @ slopes - ((mean * first[:, None]).T @ mean).real
    bend = rows.T @ second @ rows - 2 * DB * spread
    bend += 2 * RIDGE_DB * np.eye(len(place))
    return level + RIDGE_DB * float(place @ place), rows.T @ first + 2 * RIDGE_DB * place, bend
