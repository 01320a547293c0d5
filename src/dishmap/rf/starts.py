"""Where climbs begin: the least-squares answer, and places around it where phases have wrapped.

Least squares on the path error is the answer of long wavelengths. At short ones, where what no actuator can remove exceeds a fraction of
a wavelength, the gain has several maxima (a dish bent into a saddle has two good foci, and the middle between them is a poor place), so
climbs begin at many places and along a chain of falling wavelengths.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.climb import Aim, climb
from dishmap.rf.limits import Limits, best_step, whole
from dishmap.rf.pattern import direction_of
from dishmap.rf.surrogate import Traced, Tracer, phase_slopes

Array = NDArray[np.float64]

STEPS = 4
# Root mean square change of path, in mm, that makes a full stroke worth its while in the least-squares answer.
WORTH_MM = 0.01
# Residual phase (rad, weighted rms) below which there is one maximum, the one next to least squares.
ONE_MAXIMUM_RAD = 0.6
# Places around the answer: along so many directions that change paths most, by so many wavelengths of path (rms), all combinations of the
# first ones and each alone at twice that.
COMBINED, ALONE, WAVES = 3, 6, 0.2
# Frequencies of the chain, as shares of those asked for.
CHAIN = (0.15, 0.3, 0.5, 0.7, 0.85)


@dataclass(frozen=True)
class Start:
    """Values (P,) that move, and a direction (u, v)."""

    values: Array
    uv: Array


@dataclass(frozen=True)
class Best:
    """The least-squares answer: its place, the antenna there, the residual path (weighted rms, mm), and ways to leave it.

    ways (W, P + 2): changes of the values and of u, v that change the paths by 1 mm rms each, largest reach first; reach_mm (W,): rms
    change of path over a full stroke.
    """

    start: Start
    traced: Traced
    residual_mm: float
    ways: Array
    reach_mm: Array


def least_squares(trace: Tracer, aim: Aim, limits: Limits, towards: Array | None = None) -> Best:
    """Values and a direction whose paths are most alike, weighed by the amplitude, within the limits.

    towards (2,): the direction where it starts, and where it stays if the aim is not free; None for the boresight.
    """
    count, free = len(limits.used), 2 if aim.free else 0
    values, uv = np.zeros(count), np.zeros(2) if towards is None else towards
    scale = np.concatenate([limits.scale, np.full(free, aim.unit)])
    here = trace(whole(limits, values))
    for _ in range(STEPS):
        slopes, error, weight = _weighted(here, limits, uv, aim.free)
        bend = slopes.T @ (weight[:, None] * slopes) * np.outer(scale, scale) + WORTH_MM**2 * np.eye(len(scale))
        slope = slopes.T @ (weight * error) * scale
        slope[:count] += WORTH_MM**2 * values / limits.scale
        step = best_step(slope, bend, limits, values, uv[:free], scale, aim.reach)
        try:
            there = trace(whole(limits, values + step[:count]), here)
        except InputError:
            break
        here, values = there, values + step[:count]
        if free:
            uv = uv + step[count:]
    slopes, error, weight = _weighted(here, limits, uv, aim.free)
    ways, reach = _ways(slopes, weight, limits, free)
    return Best(Start(values, uv), here, float(np.sqrt(weight @ error**2)), ways, reach)


def starts_around(best: Best, trace: Tracer, aim: Aim, limits: Limits) -> list[Start]:
    """Where to climb from, the least-squares answer first; `trace` is a cheap one."""
    starts = [best.start]
    shortest = 2 * np.pi / aim.wavenumbers.max()
    if best.residual_mm * aim.wavenumbers.max() < ONE_MAXIMUM_RAD:
        return starts
    starts.append(Start(np.zeros(len(limits.used)), np.zeros(2)))
    starts.append(_chained(best, trace, aim, limits))
    useful = best.ways[best.reach_mm > WAVES * shortest / 4]
    ways = [np.array(signs) @ useful[: len(signs)] for signs in product((-1, 0, 1), repeat=min(COMBINED, len(useful))) if any(signs)]
    ways += [2 * sign * way for way in useful[:ALONE] for sign in (-1, 1)]
    return starts + [away(best, WAVES * shortest * way, aim, limits) for way in ways]


def _chained(best: Best, trace: Tracer, aim: Aim, limits: Limits) -> Start:
    """Climb at falling wavelengths, each from where the last one ended."""
    values, uv = best.start.values, np.tile(best.start.uv, (len(aim.wavenumbers), 1))
    for share in CHAIN:
        summit = climb(trace, replace(aim, wavenumbers=aim.wavenumbers * share), limits, values, uv, fades=False)
        values, uv = summit.values, summit.uv
    return Start(values, uv.mean(axis=0))


def _weighted(here: Traced, limits: Limits, uv: Array, free: bool) -> tuple[Array, Array, Array]:
    """Slopes (N, P or P + 2) and error (N,) of the path towards a direction, less their means, and weights (N,) that add up to 1."""
    weight = np.linalg.norm(here.moment, axis=1)
    weight = weight / weight.sum()
    direction = direction_of(uv)
    slopes = phase_slopes(here, direction, limits.used)[:, : None if free else len(limits.used)]
    error = here.point_mm @ direction - here.path_mm
    return slopes - weight @ slopes, error - weight @ error, weight


def _ways(slopes: Array, weight: Array, limits: Limits, free: int) -> tuple[Array, Array]:
    """The principal ways in which the actuators change paths, with the pointing that follows them."""
    count = len(limits.used)
    own = np.asarray(slopes[:, :count] * limits.scale, dtype=float)
    turn = slopes[:, count:]
    follow = np.zeros((free, count))
    if free:
        follow = -np.linalg.solve(turn.T @ (weight[:, None] * turn), turn.T @ (weight[:, None] * own))
        own += turn @ follow
    square, vectors = np.linalg.eigh(own.T @ (weight[:, None] * own))
    order = np.argsort(square)[::-1]
    reach = np.sqrt(np.maximum(square[order], 1e-30))
    parts = vectors[:, order] / reach
    both = np.vstack([parts * limits.scale[:, None], follow @ parts, np.zeros((2 - free, count))])
    return both.T, reach


def away(best: Best, way: Array, aim: Aim, limits: Limits) -> Start:
    """The answer left along a way, as far as the limits allow."""
    count = len(limits.used)
    values, step = best.start.values, way[:count]
    # the longest part of the way that stays within boxes and stroke
    room = np.where(limits.used < 5, (limits.scale - np.sign(step) * values) / np.maximum(np.abs(step), 1e-300), np.inf)
    share = min(1.0, float(room.min(initial=1.0)))
    if len(limits.heights):
        rise, now = limits.heights @ step, limits.heights @ values
        share = min(share, float(((limits.stroke_mm - np.sign(rise) * now) / np.maximum(np.abs(rise), 1e-300)).min()))
    share = max(share, 0.0)
    return Start(values + share * step, np.clip(best.start.uv + share * way[count:], -aim.reach, aim.reach))
