"""The correction of a deformed dish: where the subreflector (or the feed at the prime focus) belongs, and what shape it should have.

One set of actuator values for all frequencies, so that the mean gain in dB is largest: at the beam's own peak when the antenna is pointed
anew, or at the boresight. Climbs begin at the least-squares answer and, where phases wrap, at many places around it on a linear model
of the paths; the best of those are climbed with exact paths. What comes out is judged apart, by full physical optics on more nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.antenna import Antenna
from dishmap.rf.beam import FARTHEST, REACH, beam_peak
from dishmap.rf.climb import Aim, Summit, aim_of, climb
from dishmap.rf.correction import RIGID, Correction, correction_of, no_correction
from dishmap.rf.deformation import Deformation
from dishmap.rf.farfield import far_field
from dishmap.rf.limits import Limits, limits_of, reached, value_names, within
from dishmap.rf.pattern import decibels
from dishmap.rf.sources import Sources, illuminated, sampled, search_nodes, sources, wavelength_of
from dishmap.rf.starts import Start, least_squares, starts_around
from dishmap.rf.surrogate import Tracer, co_moment, gain_dbi, linear_tracer, tracer

Array = NDArray[np.float64]

POINTINGS = ("free", "fixed")
# So many of the best summits on the linear model are climbed again with exact paths; two closer than this in mean gain are one.
EXACT, SAME_DB = 3, 1e-3
# Starts that end within this of the best one agree with it.
AGREE_DB = 0.01
# A correction that raises the mean gain by less is none.
LEAST_GAIN_DB = 2e-3


@dataclass(frozen=True)
class CorrectionFound:
    """A correction and what it does at F frequencies.

    correction: values within the actuators' limits, zero where `improved` is false; names, units: of its values; pointing: `free` or
    `fixed`; before_dbi, after_dbi (F,): co-polar gain at the directions before_uv, after_uv (F, 2), by full physical optics; check_db (F,):
    after_dbi less what the search itself had found, whose nodes are fewer; limits: names of limits reached; converged: whether the best
    climb came to rest; starts: how many climbs were begun; agreeing: how many of them ended within AGREE_DB of the best; spread_db: the
    best mean gain less the worst; improved: whether the mean gain rises at all.
    """

    correction: Correction
    names: tuple[str, ...]
    units: tuple[str, ...]
    pointing: str
    frequencies_ghz: tuple[float, ...]
    before_dbi: Array
    before_uv: Array
    after_dbi: Array
    after_uv: Array
    check_db: Array
    limits: tuple[str, ...]
    converged: bool
    starts: int
    agreeing: int
    spread_db: float
    improved: bool


def best_correction(
    antenna: Antenna,
    deformation: Deformation,
    frequencies_ghz: Sequence[float],
    pointing: str = "free",
    shape: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> CorrectionFound:
    """The values of the actuators that give the largest mean gain in dB over some frequencies.

    pointing: `free`: the antenna is pointed anew, gain counts at the beam's peak; `fixed`: at the boresight. shape: whether a subreflector
    that can change its shape does so. progress: called with climbs done and all of them. Raises InputError for a frequency that is too low
    or an unknown pointing, FitError when the deformed antenna has no main beam near the boresight.
    """
    if pointing not in POINTINGS:
        raise InputError(f"the pointing must be 'free' or 'fixed', not {pointing!r}")
    if not len(frequencies_ghz):
        raise InputError("a correction needs at least one frequency in GHz")
    wavelengths = np.array([wavelength_of(antenna, f) for f in frequencies_ghz])
    aim = aim_of(wavelengths, antenna.reflector.diameter_mm, pointing == "free")
    trace = tracer(antenna, illuminated(antenna, deformation, search_nodes(antenna, deformation, float(wavelengths.min()))))
    before, before_uv = judged(antenna, deformation, no_correction(antenna), wavelengths, aim.free)
    summit, ends = _highest(trace, aim, limits_of(antenna.actuators, shape), progress)
    if len(summit.values) > len(RIGID):
        # phases are not all that counts: a rigid pose that does better is the answer
        rigid, _ = _highest(trace, aim, limits_of(antenna.actuators, False), None)
        summit = max(summit, rigid, key=lambda s: s.mean_dbi)
    correction = correction_of(within(antenna.actuators, summit.traced.values))
    after, after_uv = judged(antenna, deformation, correction, wavelengths, aim.free)
    check = after - _searched(trace, correction, aim, after_uv)
    improved = bool(after.mean() > before.mean() + LEAST_GAIN_DB)
    names, units = zip(*value_names(antenna.actuators), strict=True)
    return CorrectionFound(
        correction=correction if improved else no_correction(antenna),
        names=names,
        units=units,
        pointing=pointing,
        frequencies_ghz=tuple(float(f) for f in frequencies_ghz),
        before_dbi=before,
        before_uv=before_uv,
        after_dbi=after if improved else before,
        after_uv=after_uv if improved else before_uv,
        check_db=check,
        limits=reached(antenna.actuators, correction) if improved else (),
        converged=summit.settled,
        starts=len(ends),
        agreeing=int((ends > ends.max() - AGREE_DB).sum()),
        spread_db=float(np.ptp(ends)),
        improved=improved,
    )


def judged(antenna: Antenna, deformation: Deformation, correction: Correction, wavelengths_mm: Array, free: bool) -> tuple[Array, Array]:
    """Co-polar gain in dBi (F,) by full physical optics, at the beam's peak (free) or the boresight, and those directions (F, 2).

    Raises FitError when there is no main beam near the boresight.
    """
    gains, places = [], []
    for wavelength in wavelengths_mm:
        currents = judging_sources(antenna, deformation, correction, wavelength)
        uv = beam_peak(currents, wavelength, antenna.reflector.diameter_mm, antenna.feed.polarization) if free else (0.0, 0.0)
        field, _ = far_field(currents, wavelength, uv[:1], uv[1:], antenna.feed.polarization)
        gains.append(float(decibels(np.abs(field) ** 2)[0]))
        places.append(uv)
    return np.array(gains), np.array(places)


def judging_sources(antenna: Antenna, deformation: Deformation, correction: Correction, wavelength_mm: float) -> Sources:
    """Currents at nodes that resolve all directions in which a main beam is looked for."""
    widest = np.sqrt(2) * min(REACH * wavelength_mm / antenna.reflector.diameter_mm, FARTHEST)
    return sources(antenna, deformation, correction, sampled(antenna, deformation, wavelength_mm, widest))


def _highest(trace: Tracer, aim: Aim, limits: Limits, progress: Callable[[int, int], None] | None) -> tuple[Summit, Array]:
    """The best summit, and mean gains (S,) at which the climbs ended."""
    tell = progress or (lambda done, whole_of_it: None)
    best = least_squares(trace, aim, limits)
    quick = linear_tracer(best.traced)
    starts = starts_around(best, quick, aim, limits)
    fades = not len(limits.heights)
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


def _searched(trace: Tracer, correction: Correction, aim: Aim, uv: Array) -> Array:
    """Gains (F,) at the directions (F, 2), on the nodes of the search."""
    here = trace(correction.values)
    return np.array([gain_dbi(here, co_moment(here, one), k, one) for k, one in zip(aim.wavenumbers, uv, strict=True)])
