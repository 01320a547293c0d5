"""Whether a walk over crossings skipped a line: between neighbours on a lattice there must be no further line.

Where a bent surface turns away, lines come closer and closer and run together, while the last one stands out again; a walk may then take it
for the next one. Beside a line, half way to the mark that a cell may hold, the lines that cross it show as dips of the grey level.
Two crossings n steps apart have at most n - 1 of them between. Crossings that no such pair joins to the rest are dropped.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from dishmap.targets.grid_crossings import Level
from dishmap.targets.grid_map import LocalMap, local_map
from dishmap.targets.grid_refine import LEAST_DEPTH
from dishmap.targets.grid_walk import BRIDGE, table_of
from dishmap.targets.threshold import noise_level, sampled

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

# Samples per step, on tracks so far to both sides of a line, in steps.
SAMPLES, ASIDE = 12, 0.14
# A dip is the lowest of the samples up to a quarter of a step to both sides, and lower than the lightest on either side by this part of the
# range on the track, and this many sigmas of the noise.
QUARTER, DIP_PART, DIP_NOISE = 3, 0.12, 2.5
# Pairs beside a pair (and itself) that have a say in whether it is clear, what part of them must be, and how many to bridge a gap.
VOTERS, MOST_CLEAR, BRIDGE_VOTES = 9, 0.7, 3


def unskipped(levels: list[Level], reduction: Ints, place_px: Array, lattice: Ints) -> Flags:
    """Which crossings (K,) belong to the largest part that neighbours join without a line between that the lattice does not count.

    reduction (K,): the level that shows each best.
    """
    table, low = table_of(place_px, lattice, BRIDGE)
    number = np.full(table.shape[:2], -1)
    number[tuple((lattice - low).T)] = np.arange(len(lattice))
    there = local_map(table, lattice - low, itself=True)
    at = (lattice - low).T
    joins = []
    for axis in range(2):
        a, b, apart = _neighbours(number, at.T, axis)
        clear = np.zeros(len(a), dtype=bool)
        for level in levels:
            here = np.flatnonzero(np.minimum(reduction[a], reduction[b]) == level.reduction)
            if len(here):
                clear[here] = _dips(level, place_px[a[here]], place_px[b[here]], there.take(a[here]), axis, apart[here]) < apart[here]
        joins.append(np.stack([a, b])[:, _upheld(clear, apart, at[:, [a, b]], number.shape, axis)])
    a, b = np.concatenate(joins, axis=1)
    _, part = connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(len(lattice),) * 2), directed=False)
    return np.asarray(part == np.argmax(np.bincount(part)))


def _neighbours(number: Ints, at: Ints, axis: int) -> tuple[Ints, Ints, Ints]:
    """Each crossing (E,), the next one along an axis, and how many steps apart they are; number: the crossing at each lattice place."""
    way = np.eye(2, dtype=np.int64)[axis]
    first, second, apart = [], [], []
    left = np.arange(len(at))
    for steps in range(1, BRIDGE + 1):
        other = number[tuple((at[left] + steps * way).T)]
        met = other >= 0
        first.append(left[met])
        second.append(other[met])
        apart.append(np.full(int(met.sum()), steps))
        left = left[~met]
    return np.concatenate(first), np.concatenate(second), np.concatenate(apart)


def _upheld(clear: Flags, apart: Ints, at: Ints, shape: tuple[int, ...], axis: int) -> Flags:
    """Pairs (E,) that are clear and that the pairs beside them uphold; at (2, 2, E): lattice places of both ends.

    A line that runs on is not seen between every pair, so most beside it must be clear too. Over a gap there may be nothing to see: only
    several pairs side by side bridge it.
    """
    keep = clear.copy()
    for steps in range(1, BRIDGE + 1):
        chosen = np.flatnonzero(apart == steps)
        for end in range(2):
            place = tuple(at[:, end, chosen])
            pairs, cleared = np.zeros(shape), np.zeros(shape)
            pairs[place], cleared[place] = 1.0, clear[chosen]
            among, yes = (VOTERS * uniform_filter1d(t, VOTERS, axis=1 - axis, mode="constant")[place] for t in (pairs, cleared))
            keep[chosen] &= (yes > MOST_CLEAR * among) & ((steps == 1) | (yes > BRIDGE_VOTES - 0.5))
    return keep


def _dips(level: Level, start: Array, end: Array, there: LocalMap, axis: int, apart: Ints) -> Ints:
    """How many lines (N,) show between crossings (N, 2) px `apart` (N,) steps from each other, on the side that shows fewer.

    there: the local map at the first ones.
    """
    along, curve, other = there.step_px[..., axis], there.bend_px[..., axis] / 2, there.step_px[:, None, :, 1 - axis]
    # the local map's curve, made to end where the other crossing is
    steps = apart[:, None].astype(float)
    along = along + (end - start - steps * along - steps**2 * curve) / steps
    t = np.arange(BRIDGE * SAMPLES + 1) / SAMPLES
    t = np.minimum(t, steps)[..., None]
    line = start[:, None] + t * along[:, None] + t**2 * curve[:, None]
    noise = noise_level(level.image)
    between = (t[..., 0] > QUARTER / SAMPLES - 1e-9) & (t[..., 0] < steps - QUARTER / SAMPLES + 1e-9)
    counts = []
    for side in (-ASIDE, ASIDE):
        light = sampled(level.image, (line + side * other - (level.reduction - 1) / 2) / level.reduction)
        light[:, 1:-1] = (light[:, :-2] + light[:, 1:-1] + light[:, 2:]) / 3
        depth = np.maximum(light.max(axis=1) - light.min(axis=1), 0.0)
        prominence = np.maximum(DIP_PART * depth, DIP_NOISE * noise)[:, None]
        lowest = minimum_filter1d(light, 2 * QUARTER + 1, axis=1) == light
        before, after = (maximum_filter1d(light, QUARTER + 1, axis=1, origin=shift) for shift in (QUARTER // 2, -(QUARTER // 2) - 1))
        dip = lowest & between & (light < np.minimum(before, after) - prominence)
        counts.append(np.where(depth > LEAST_DEPTH, dip.sum(axis=1), 0))
    return np.asarray(np.minimum(*counts))
