"""Climbing to the best values of the actuators: Newton's method on a sum of gains, within the limits.

One unknown vector holds the P values that may move and, where the antenna is pointed anew, u and v for each frequency. Each step
minimises a quadratic model, made convex and damped (Levenberg-Marquardt), within the limits.

A rigid subreflector that moves far for its size also shifts the light on the dish. A climb that `fades` counts that: a step is kept when
the gain with the new currents rises. How currents change is costly to know, so it is made new only when the climb comes to rest without.
Other climbs hold the currents of each place for the step from there, and correct phases only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.beam import FARTHEST, REACH
from dishmap.rf.limits import Limits, best_step, whole
from dishmap.rf.surrogate import Traced, Tracer, co_moment, fading, gain_dbi, lobe

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# A full stroke costs so many dB: what does nothing else for the gain stays at zero, and what does is not held back.
RIDGE_DB = 1e-2
STEPS, RENEWALS = 60, 6
# Steps end when the best one would gain less than this, dB.
SETTLED_DB = 1e-5
# Damping, in dB per square of a full stroke: at first, when hopeless, and at least.
DAMPING, HOPELESS, LEAST_DAMPING = 1e-3, 1e6, 1e-9
# Curvature that is never undercut, in the same units.
FLAT_DB = 1e-9


@dataclass(frozen=True)
class Aim:
    """What is maximised: the mean gain in dB over wavenumbers (F,) per mm; free: each at its own direction, else at the boresight.

    unit: a width of the beam, as a sine; reach: how far u and v may go.
    """

    wavenumbers: Array
    free: bool
    unit: float
    reach: float

    @property
    def extra(self) -> int:
        """How many unknowns beside the actuators."""
        return 2 * len(self.wavenumbers) if self.free else 0


def aim_of(wavelengths_mm: Array, diameter_mm: float, free: bool) -> Aim:
    """The aim for wavelengths (F,) and an aperture, with directions inside those where a main beam is looked for."""
    unit = float(wavelengths_mm.min() / diameter_mm)
    return Aim(2 * np.pi / wavelengths_mm, free, unit, min((REACH - 1) * unit, FARTHEST / 2))


@dataclass(frozen=True)
class Place:
    """Values (P,), directions uv (F, 2), and the antenna there."""

    values: Array
    uv: Array
    traced: Traced


@dataclass(frozen=True)
class Summit:
    """Where a climb ended: values (P,), directions uv (F, 2), mean gain in dB, the antenna there, and whether it came to rest."""

    values: Array
    uv: Array
    mean_dbi: float
    traced: Traced
    settled: bool


def climb(trace: Tracer, aim: Aim, limits: Limits, values: Array, uv: Array, fades: bool = True) -> Summit:
    """Climb from values (P,) and directions (F, 2); fades: whether currents change with the actuators.

    Raises InputError when the start itself cannot be.
    """
    here = Place(values, uv, trace(whole(limits, values)))
    fade: Complex | None = None
    damping, settled, renewed, fresh = DAMPING, False, 0, not fades
    for _ in range(STEPS):
        there, damping, settled = _stepped(trace, here, aim, limits, fade, fades, damping)
        if there is not None:
            here, fresh = there, not fades
        elif fresh or renewed == RENEWALS:
            break
        else:
            fade, fresh, renewed, damping = fading(trace, here.traced, limits.used, limits.scale), True, renewed + 1, DAMPING
    return Summit(here.values, here.uv, mean_gain_dbi(here, aim), here.traced, settled)


def _stepped(
    trace: Tracer, here: Place, aim: Aim, limits: Limits, fade: Complex | None, fades: bool, damping: float
) -> tuple[Place | None, float, bool]:
    """The next place, or None where there is no better one; the damping; whether it is because nothing is left to gain."""
    scale = np.concatenate([limits.scale, np.full(aim.extra, aim.unit)])
    slope, bend = model(here, aim, limits, fade)
    level = _level(here, here, aim) + _ridge(here, limits)
    while damping < HOPELESS:
        curved = convex(bend * np.outer(scale, scale), damping)
        step = best_step(slope * scale, curved, limits, here.values, here.uv.ravel()[: aim.extra], scale, aim.reach)
        if abs(slope @ step) < SETTLED_DB:
            return None, damping, True
        there = _moved(trace, here, aim, limits, step)
        if there is not None:
            gained = level - _level(there, there if fades else here, aim) - _ridge(there, limits)
            if gained > 0.05 * abs(slope @ step):
                return there, max(damping / 10, LEAST_DAMPING), False
        damping = max(damping * 10, DAMPING / 10)
    return None, damping, False


def _level(place: Place, lit: Place, aim: Aim) -> float:
    """Minus the mean gain in dB, with the currents of the place `lit`."""
    parts = zip(aim.wavenumbers, place.uv, lit.uv, strict=True)
    return -float(np.mean([gain_dbi(place.traced, co_moment(lit.traced, old), k, uv) for k, uv, old in parts]))


def mean_gain_dbi(place: Place, aim: Aim) -> float:
    """The mean gain in dB at a place."""
    return -_level(place, place, aim)


def _ridge(place: Place, limits: Limits) -> float:
    return RIDGE_DB * float(((place.values / limits.scale) ** 2).sum())


def _moved(trace: Tracer, here: Place, aim: Aim, limits: Limits, step: Array) -> Place | None:
    """The place a step away, or None where it cannot be."""
    count = len(here.values)
    values = here.values + step[:count]
    uv = here.uv + step[count:].reshape(-1, 2) if aim.free else here.uv
    try:
        return Place(values, uv, trace(whole(limits, values), here.traced))
    except InputError:
        return None


def model(here: Place, aim: Aim, limits: Limits, fade: Complex | None) -> tuple[Array, Array]:
    """Slope (Q,) and second derivatives (Q, Q) of what is minimised."""
    count = len(here.values)
    slope, bend = np.zeros(count + aim.extra), np.zeros((count + aim.extra,) * 2)
    slope[:count] = 2 * RIDGE_DB * here.values / limits.scale**2
    bend[np.arange(count), np.arange(count)] = 2 * RIDGE_DB / limits.scale**2
    share = 1 / len(aim.wavenumbers)
    for i, (k, uv) in enumerate(zip(aim.wavenumbers, here.uv, strict=True)):
        own = lobe(here.traced, co_moment(here.traced, uv), k, uv, limits.used, fade)
        to = [*range(count), count + 2 * i, count + 2 * i + 1][: len(slope) if aim.free else count]
        slope[to] -= share * own.slope[: len(to)]
        bend[np.ix_(to, to)] -= share * own.bend[: len(to), : len(to)]
    return slope, bend


def convex(bend: Array, damping: float) -> Array:
    """Second derivatives with their signs made positive, so that a step leads downhill also from a saddle."""
    values, vectors = np.linalg.eigh(bend)
    return np.asarray((vectors * np.maximum(np.abs(values) + damping, FLAT_DB)) @ vectors.T)
