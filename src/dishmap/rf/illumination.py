"""Illumination held as designed, so that a subreflector that bends corrects a dish and does not become another antenna.

A subreflector that bends moves light about. Asked for gain alone it would light the dish more evenly, or draw light away from what is
blocked and from the rim, up to where rays cross, and would promise more gain than the undeformed antenna has. But a subreflector of some
ten wavelengths cannot do that: by diffraction, light follows only bends much wider than sqrt(wavelength x distance / 2). So a search for
a bend counts the gain with phases by exact rays and the illumination as designed, less

    max(0, -mean change)  +  PRICE x mean |change|,

changes of the illumination in dB, means weighed by the field: light that misses the dish costs what it costs, light won counts nothing,
and light moved has a price. Both are rounded off at zero. Where a ray is lost or light changes many times over, the search does not go.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.surrogate import Traced, Tracer

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Price of light that is moved, dB per dB; below ROUND_DB a change costs its square; FARTHEST_DB is the largest change anywhere.
PRICE, ROUND_DB, FARTHEST_DB = 0.3, 0.5, 6.0
# Missing light is rounded off over so many dB, and begins to count so many of them below zero, so that none is sought.
MISSING_DB, BELOW = 0.006, 8
DB = 20 / np.log(10)


def held_as_designed(trace: Tracer, design: Complex, lit: int) -> Tracer:
    """The same antenna with moments of the size that those of the design (N, 3) have, less what changes of the light cost.

    lit: how many of the nodes, the first ones, cover the aperture. The function raises InputError where a ray is lost, or light changes by
    more than FARTHEST_DB, beside what `trace` raises.
    """
    size = _size(design)
    seen = size > 0
    share = np.where(np.arange(len(size)) < lit, size, 0.0)[seen]
    share = share / share.sum()

    def traced(values: Array, near: Traced | None = None) -> Traced:
        there = trace(values, near)
        now = _size(there.moment)[seen]
        if not (now > 0).all():
            raise InputError("rays are lost; bend the subreflector less")
        change = DB * np.log(now / size[seen])
        if not (np.abs(change) <= FARTHEST_DB).all():
            raise InputError(f"the light changes by more than {FARTHEST_DB:g} dB; bend the subreflector less")
        missing = MISSING_DB * np.logaddexp(-(share @ change) / MISSING_DB - BELOW, 0.0)
        moved = np.sqrt(change**2 + ROUND_DB**2) - ROUND_DB
        factor = np.zeros(len(size))
        # a price that each place pays for itself is, to the first order, the mean of all prices
        factor[seen] = np.exp(-(change + missing + PRICE * moved) / DB)
        return replace(there, moment=there.moment * factor[:, None])

    return traced


def _size(moment: Complex) -> Array:
    return np.sqrt((np.abs(moment) ** 2).sum(axis=1))
