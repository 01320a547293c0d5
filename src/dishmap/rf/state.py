"""One state of the antenna (as designed, as measured, as corrected) at the frequencies asked for."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import FitError
from dishmap.rf.antenna import Antenna
from dishmap.rf.beam import Beam, main_beam, peak
from dishmap.rf.correction import Correction
from dishmap.rf.deformation import Deformation
from dishmap.rf.farfield import far_field, pattern_cut, pattern_grid
from dishmap.rf.gain import Budget, PathError, budget, path_error
from dishmap.rf.pattern import Cut, PatternGrid, decibels
from dishmap.rf.sources import LEAST_WAVELENGTHS, LIGHT_MM_GHZ, sampled, sources, wavelength_of
from dishmap.rf.spread import Spread, spread

Array = NDArray[np.float64]

# Patterns reach so many times wavelength over diameter from the boresight, grids with so many directions a side, cuts with so many.
PATTERN_REACH, GRID_SIDE, CUT_COUNT = 12.0, 201, 401
# Never beyond this sine of the angle from the boresight.
WIDEST = 0.9
# Azimuths of the cuts that are kept.
PATTERN_CUTS_DEG = (0.0, 45.0, 90.0, 135.0)
# The curve of gain against frequency: from this part of the lowest frequency to this of the highest.
SWEEP, SWEEP_COUNT = (0.5, 1.25), 31


@dataclass(frozen=True)
class Reading:
    """What the antenna does at one frequency. spread: of surfaces drawn from the map, None for the design."""

    frequency_ghz: float
    wavelength_mm: float
    beam: Beam
    budget: Budget
    path: PathError
    grid: PatternGrid
    cuts: tuple[Cut, ...]
    spread: Spread | None


@dataclass(frozen=True)
class State:
    """The antenna with a deformation and a correction.

    name: `design`, `measured`, `corrected` (a rigid pose) or `shaped`; readings: one for each frequency; sweep_ghz (S,) and sweep_dbi (S,):
    gain at the beam's peak against frequency.
    """

    name: str
    deformation: Deformation
    correction: Correction
    readings: tuple[Reading, ...]
    sweep_ghz: Array
    sweep_dbi: Array


def antenna_state(
    name: str,
    antenna: Antenna,
    deformation: Deformation,
    correction: Correction,
    frequencies_ghz: tuple[float, ...],
    drawn_mm: Array | None = None,
) -> State:
    """The antenna at some frequencies; drawn_mm (K, T): coefficients of surfaces drawn from the map.

    Raises InputError for a frequency that is too low, FitError when there is no main beam near the boresight.
    """
    readings = tuple(_reading(antenna, deformation, correction, f, drawn_mm) for f in frequencies_ghz)
    across, gain = _sweep(antenna, deformation, correction, frequencies_ghz, readings)
    return State(name, deformation, correction, readings, across, gain)


def _reading(antenna: Antenna, deformation: Deformation, correction: Correction, frequency: float, drawn: Array | None) -> Reading:
    wavelength, diameter, wanted = wavelength_of(antenna, frequency), antenna.reflector.diameter_mm, antenna.feed.polarization
    widest = min(PATTERN_REACH * wavelength / diameter, WIDEST)
    fine = sources(antenna, deformation, correction, sampled(antenna, deformation, wavelength, np.sqrt(2) * widest))
    beam = main_beam(fine, wavelength, diameter, wanted)
    some = None
    if drawn is not None:
        coarse = sources(antenna, deformation, correction, sampled(antenna, deformation, wavelength))
        some = spread(coarse, deformation, drawn, beam, wavelength, diameter, wanted)
    side = np.linspace(-widest, widest, GRID_SIDE)
    # cuts in equal steps of the angle, as files of cuts have them
    reach = np.degrees(np.arcsin(widest))
    angles = np.linspace(-reach, reach, CUT_COUNT)
    return Reading(
        frequency_ghz=frequency,
        wavelength_mm=wavelength,
        beam=beam,
        budget=budget(fine, wavelength, diameter, beam.u, beam.v, beam.gain_dbi),
        path=path_error(fine, wavelength, beam.u, beam.v),
        grid=pattern_grid(fine, wavelength, side, side, wanted),
        cuts=tuple(pattern_cut(fine, wavelength, angles, phi, wanted) for phi in PATTERN_CUTS_DEG),
        spread=some,
    )


def _sweep(
    antenna: Antenna, deformation: Deformation, correction: Correction, frequencies: tuple[float, ...], readings: tuple[Reading, ...]
) -> tuple[Array, Array]:
    """Gain at the peak over frequency, NaN where none was found; each peak is looked for near that of the nearest frequency asked for."""
    lowest = LEAST_WAVELENGTHS * LIGHT_MM_GHZ / antenna.reflector.diameter_mm
    across = np.linspace(max(SWEEP[0] * min(frequencies), lowest), SWEEP[1] * max(frequencies), SWEEP_COUNT)
    nodes = sampled(antenna, deformation, LIGHT_MM_GHZ / across[-1])
    # currents do not depend on the frequency, only their phases do
    currents = sources(antenna, deformation, correction, nodes)
    gain = np.full(SWEEP_COUNT, np.nan)
    for i, frequency in enumerate(across):
        near = readings[int(np.argmin(np.abs(np.log(np.array(frequencies) / frequency))))].beam
        with suppress(FitError):
            u, v = peak(currents, LIGHT_MM_GHZ / frequency, (near.u, near.v), antenna.feed.polarization)
            field = far_field(currents, LIGHT_MM_GHZ / frequency, [u], [v], antenna.feed.polarization)[0]
            gain[i] = decibels(np.abs(field) ** 2)[0]
    return across, gain
