"""The correction of a deformed dish: where the subreflector (or the feed at the prime focus) belongs, and what shape it should have.

One set of actuator values for all frequencies, so that the mean gain in dB is largest: at the beam's own peak when the antenna is pointed
anew, or at the boresight. Climbs begin at the least-squares answer and, where phases wrap, at many places around it on a linear model
of the paths; the best of those are climbed with exact paths. A rigid pose is the one with the largest gain. A bend is sought with the
illumination held as designed, since ray optics promises too much of a small subreflector that moves light about; among the bends found
and the rigid pose the one with the largest gain is the answer. What comes out is judged apart, by full physical optics on more nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.antenna import Antenna
from dishmap.rf.beam import FARTHEST, REACH, beam_peak
from dishmap.rf.bending import best_bend
from dishmap.rf.climb import Aim, aim_of
from dishmap.rf.correction import Correction, correction_of, no_correction
from dishmap.rf.deformation import Deformation
from dishmap.rf.farfield import far_field
from dishmap.rf.limits import limits_of, reached, value_names, within
from dishmap.rf.pattern import decibels
from dishmap.rf.sources import Illuminated, Sources, illuminated, sampled, search_nodes, sources, sources_after, wavelength_of
from dishmap.rf.summits import highest
from dishmap.rf.surrogate import Tracer, co_moment, gain_dbi, tracer

Array = NDArray[np.float64]

POINTINGS = ("free", "fixed")
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
    best mean gain less the worst; improved: whether the mean gain rises at all; lost_share: of the power that the dish received before,
    what misses it after the correction, negative where it receives more.
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
    lost_share: float


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
    that can change its shape does so: that never gives less than the rigid pose, nor a higher degree less than a lower one (to 1e-3 dB).
    Light that a bend could win, by lighting the dish better than designed, is not sought. progress: called with what is done and all of
    it. Raises InputError for a frequency that is too low or an unknown pointing, FitError when the deformed antenna has no main beam near
    the boresight.
    """
    if pointing not in POINTINGS:
        raise InputError(f"the pointing must be 'free' or 'fixed', not {pointing!r}")
    if not len(frequencies_ghz):
        raise InputError("a correction needs at least one frequency in GHz")
    wavelengths = np.array([wavelength_of(antenna, f) for f in frequencies_ghz])
    aim = aim_of(wavelengths, antenna.reflector.diameter_mm, pointing == "free")
    dish = illuminated(antenna, deformation, search_nodes(antenna, deformation, float(wavelengths.min())))
    trace = tracer(antenna, dish)
    before, before_uv = judged(antenna, deformation, no_correction(antenna), wavelengths, aim.free)
    bends = shape and antenna.actuators.shape_degree > 0
    tell = progress or (lambda done, whole_of_it: None)
    summit, ends = highest(trace, aim, limits_of(antenna.actuators, False), progress=None if bends else tell)
    if bends:
        summit, ends = best_bend(antenna.actuators, trace, dish.nodes.lit, aim, summit, tell)
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
        lost_share=_lost_share(antenna, dish, correction) if improved else 0.0,
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


def _lost_share(antenna: Antenna, dish: Illuminated, correction: Correction) -> float:
    lit = slice(0, dish.nodes.lit)
    before, after = (sources_after(antenna, dish, c).arriving[lit].sum() for c in (no_correction(antenna), correction))
    return float(1 - after / before)


def _searched(trace: Tracer, correction: Correction, aim: Aim, uv: Array) -> Array:
    """Gains (F,) at the directions (F, 2), on the nodes of the search."""
    here = trace(correction.values)
    return np.array([gain_dbi(here, co_moment(here, one), k, one) for k, one in zip(aim.wavenumbers, uv, strict=True)])
