"""What the map's uncertainty does to gain and beam: the figures of surfaces drawn from it.

A drawn surface differs from the mean one by so little that its paths are linear in the difference: a rise along the normal changes the
path by the normal times (arriving direction - departing direction), exactly so to the first order (Fermat). Fields are not linear: gain
is stationary at a perfect surface, so that an uncertain map always costs some.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.rf.beam import CUTS_DEG, Beam, cut_angles_rad, cut_directions, cut_figures, log_gain_slopes, uphill
from dishmap.rf.deformation import Deformation
from dishmap.rf.feed import ludwig_axes, polarization_axes
from dishmap.rf.gain import path_towards, ruze_loss_db
from dishmap.rf.pattern import decibels, direction_of
from dishmap.rf.sources import Sources, illumination
from dishmap.surface.zernike import zernike_matrix

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

NEWTON_STEPS = 8
NAMES = (
    *("gain_dbi", "boresight_dbi", "u", "v", "width_0_deg", "width_90_deg", "sidelobe_0_db", "sidelobe_90_db"),
    *("weighted_rms_mm", "ruze_db"),
)


# No figure is claimed better than this, whatever the map says: what physical optics, and paths to the first order with currents that do
# not turn with the slopes, leave out. Gains and sidelobes in dB, direction cosines, widths relative to themselves, path errors none.
FLOOR_DB, FLOOR_DIRECTION, FLOOR_WIDTH, FLOOR_SIDELOBE_DB = 1e-3, 1e-6, 2e-4, 0.02


@dataclass(frozen=True)
class Spread:
    """Figures (K, len(NAMES)) of K drawn surfaces, and the floor of each figure's sigma (len(NAMES),)."""

    draws: Array
    floor: Array

    def of(self, name: str) -> Array:
        """All draws (K,) of one figure."""
        return np.asarray(self.draws[:, NAMES.index(name)])

    def sigma(self, name: str) -> float:
        """Standard deviation of one figure, of the draws that have it, NaN where none has."""
        known = self.of(name)[np.isfinite(self.of(name))]
        return float(np.hypot(known.std(), self.floor[NAMES.index(name)])) if len(known) else float("nan")

    def interval(self, name: str) -> tuple[float, float]:
        """The middle 95 % of one figure, NaN where no draw has it."""
        known, floor = self.of(name)[np.isfinite(self.of(name))], float(self.floor[NAMES.index(name)])
        if not len(known):
            return float("nan"), float("nan")
        low, high = np.percentile(known, [2.5, 97.5])
        return float(low) - floor, float(high) + floor


def spread(
    sources: Sources,
    deformation: Deformation,
    drawn_mm: Array,
    beam: Beam,
    wavelength_mm: float,
    diameter_mm: float,
    polarization: str,
) -> Spread:
    """Figures of surfaces with coefficients drawn_mm (K, T), near the deformation of which sources and beam were made."""
    k = 2 * np.pi / wavelength_mm
    middle = direction_of((beam.u, beam.v))
    co_axis = polarization_axes(polarization, 1, *ludwig_axes(middle[None]))[0][0]
    wave = (sources.moment @ co_axis.conj()) * np.exp(1j * k * (sources.point_mm @ middle - sources.rays.path_mm))
    x, y = ((sources.nodes.xy_mm - deformation.center_mm) / deformation.radius_mm).T
    # the mean surface goes along as the last one, to show what a sum with one polarisation for all directions leaves out of its figures
    moved = np.concatenate([drawn_mm - deformation.coefficients_mm, np.zeros((1, len(deformation.terms)))])
    rise = zernike_matrix(deformation.terms, x, y) @ moved.T
    change = (sources.normal * (sources.rays.direction - middle)).sum(axis=1)[:, None] * rise
    waves = wave[:, None] * np.exp(-1j * k * change)
    peaks = np.array([_peak(waves[:, d], sources.point_mm, k, beam) for d in range(waves.shape[1])])
    reference = abs(wave.sum()) ** 2
    at_boresight = _towards(waves, sources.point_mm, k, middle, np.zeros((1, 2)))[0]
    bore = beam.gain_dbi + decibels(np.abs(at_boresight) ** 2 / reference)
    cuts = _cut_figures(waves, sources.point_mm, k, beam, wavelength_mm, diameter_mm)
    rms = _weighted_rms(sources, beam, change, peaks)
    ruze = np.array([ruze_loss_db(value, wavelength_mm) for value in rms])
    gain = beam.gain_dbi + decibels(peaks[:, 2] / reference)
    figures = np.column_stack([gain, bore, peaks[:, :2], cuts, rms, ruze])
    known = [beam.gain_dbi, beam.boresight_dbi, beam.u, beam.v, *beam.width_deg, *beam.sidelobe_db]
    figures[:, : len(known)] += np.nan_to_num(known - figures[-1, : len(known)])
    widths = FLOOR_WIDTH * np.nan_to_num(beam.width_deg)
    floor = [FLOOR_DB, FLOOR_DB, FLOOR_DIRECTION, FLOOR_DIRECTION, *widths, FLOOR_SIDELOBE_DB, FLOOR_SIDELOBE_DB, 0.0, FLOOR_DB]
    return Spread(figures[:-1], np.array(floor))


def _peak(wave: Complex, points: Array, k: float, beam: Beam) -> tuple[float, float, float]:
    """Direction and power of the peak of one drawn surface, from waves (N,) towards the mean surface's peak."""
    middle = direction_of((beam.u, beam.v))
    u, v = beam.u, beam.v
    for _ in range(NEWTON_STEPS):
        here = direction_of((u, v))
        now = wave * np.exp(1j * k * (points @ (here - middle)))
        slopes = [points[:, i] - points[:, 2] * at / here[2] for i, at in enumerate((u, v))]
        gradient, hessian = log_gain_slopes(now, k, *slopes)
        step = uphill(gradient, hessian)
        u, v = u + step[0], v + step[1]
        if np.hypot(*step) < 1e-9:
            break
    return u, v, float(abs(now.sum()) ** 2)


def _towards(waves: Complex, points: Array, k: float, middle: Array, uv: Array) -> Complex:
    """Fields (D, K) of waves (N, K) towards directions (D, 2), which the waves have towards `middle`."""
    direction = np.column_stack([uv, np.sqrt(1 - (uv**2).sum(axis=1))])
    return np.asarray(np.exp(1j * k * ((direction - middle) @ points.T)) @ waves)


def _cut_figures(waves: Complex, points: Array, k: float, beam: Beam, wavelength_mm: float, diameter_mm: float) -> Array:
    """Widths in degrees and sidelobes in dB (K, 4) in the principal cuts through the mean surface's peak."""
    angles = cut_angles_rad(wavelength_mm, diameter_mm)
    middle = direction_of((beam.u, beam.v))
    widths, lobes = [], []
    for phi in CUTS_DEG:
        power = decibels(np.abs(_towards(waves, points, k, middle, cut_directions(beam.u, beam.v, phi, angles))) ** 2)
        figures = np.array([cut_figures(angles, column) for column in power.T])
        widths.append(np.degrees(figures[:, 0]))
        lobes.append(figures[:, 1])
    return np.column_stack([*widths, *lobes])


def _weighted_rms(sources: Sources, beam: Beam, change: Array, peaks: Array) -> Array:
    """Illumination-weighted rms half-path error (K,), each at its own peak (K, 3), for changes of the path (N, K)."""
    lit = slice(0, sources.nodes.lit)
    weight = illumination(sources)
    turned = np.stack([direction_of((u, v)) for u, v in peaks[:, :2]], axis=1) - direction_of((beam.u, beam.v))[:, None]
    path = path_towards(sources, beam.u, beam.v)[lit, None] + change[lit] - sources.point_mm[lit] @ turned
    half = path / 2 - weight @ path / 2 / weight.sum()
    return np.asarray(np.sqrt(weight @ half**2 / weight.sum()))
