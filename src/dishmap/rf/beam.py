"""The main beam: where it points, how wide it is, and its first sidelobes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from dishmap.errors import FitError
from dishmap.rf.farfield import far_field, pattern_grid
from dishmap.rf.feed import ludwig_axes, polarization_axes
from dishmap.rf.pattern import decibels, direction_of
from dishmap.rf.sources import Sources

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# The peak is looked for on a grid that reaches so many times wavelength over diameter, in so fine steps; nodes must resolve its corners.
REACH, STEP = 6.0, 0.25
FARTHEST = 0.7
NEWTON_STEPS, STILL = 20, 1e-10
# Cuts through the peak: how far and how finely, in wavelengths over diameters.
CUT_REACH, CUT_STEP = 5.0, 0.05
# Azimuths of the principal cuts.
CUTS_DEG = (0.0, 90.0)


@dataclass(frozen=True)
class Beam:
    """The main beam of one pattern.

    u, v: direction cosines of its peak; gain_dbi there, co-polar; boresight_dbi: at u = v = 0; width_deg (2,): full width at half power in
    the planes of CUTS_DEG through the peak; sidelobe_db (2,): the higher one of the first sidelobes on either side, below the peak
    (negative), NaN where the pattern has no lobe within the cut; cross_db: largest cross-polar gain near the beam relative to the peak.
    """

    u: float
    v: float
    gain_dbi: float
    boresight_dbi: float
    width_deg: tuple[float, float]
    sidelobe_db: tuple[float, float]
    cross_db: float


def main_beam(sources: Sources, wavelength_mm: float, diameter_mm: float, polarization: str) -> Beam:
    """The main beam of currents on an aperture of this diameter. Raises FitError when there is none near the boresight."""
    unit = wavelength_mm / diameter_mm
    u, v, cross = _coarse_peak(sources, wavelength_mm, unit, polarization)
    u, v = peak(sources, wavelength_mm, (u, v), polarization)
    t = cut_angles_rad(wavelength_mm, diameter_mm)
    at = np.concatenate([[[u, v], [0.0, 0.0]], *(cut_directions(u, v, phi, t) for phi in CUTS_DEG)])
    power = decibels(np.abs(far_field(sources, wavelength_mm, at[:, 0], at[:, 1], polarization)[0]) ** 2)
    figures = [cut_figures(t, part) for part in power[2:].reshape(len(CUTS_DEG), -1)]
    widths, lobes = zip(*figures, strict=True)
    first, second = (float(np.degrees(w)) for w in widths)
    return Beam(u, v, float(power[0]), float(power[1]), (first, second), (lobes[0], lobes[1]), float(cross - power[0]))


def beam_peak(sources: Sources, wavelength_mm: float, diameter_mm: float, polarization: str) -> tuple[float, float]:
    """Direction (u, v) of the main beam's peak. Raises FitError when there is none near the boresight."""
    u, v, _ = _coarse_peak(sources, wavelength_mm, wavelength_mm / diameter_mm, polarization)
    return peak(sources, wavelength_mm, (u, v), polarization)


def peak(sources: Sources, wavelength_mm: float, start: tuple[float, float], polarization: str) -> tuple[float, float]:
    """Direction (u, v) of the largest co-polar gain near a start, by Newton's method on its logarithm.

    Raises FitError when the search does not settle.
    """
    k = 2 * np.pi / wavelength_mm
    u, v = start
    axes = ludwig_axes(direction_of((u, v))[None])
    co_axis = polarization_axes(polarization, 1, *axes)[0][0]
    moment = sources.moment @ co_axis.conj()
    x, y, z = sources.point_mm.T
    for _ in range(NEWTON_STEPS):
        w = np.sqrt(1 - u**2 - v**2)
        wave = moment * np.exp(1j * k * (u * x + v * y + w * z - sources.rays.path_mm))
        gradient, hessian = log_gain_slopes(wave, k, x - z * u / w, y - z * v / w)
        step = uphill(gradient, hessian)
        u, v = u + step[0], v + step[1]
        if np.hypot(*step) < STILL or not u**2 + v**2 < 1:
            break
    if not (u**2 + v**2 < 1 and np.hypot(*step) < 1e3 * STILL):
        raise FitError("the direction of the beam's peak was not found; the pattern may have no main beam at this frequency")
    return float(u), float(v)


def log_gain_slopes(wave: Complex, k: float, by_u: Array, by_v: Array) -> tuple[Array, Array]:
    """Gradient (2,) and second derivatives (2, 2) of log |sum of waves|^2 over u, v, whose paths (N,) grow by these (N,) each."""
    total = wave.sum()
    one = np.array([(wave * by_u).sum(), (wave * by_v).sum()]) * 1j * k / total
    cross = (wave * by_u * by_v).sum()
    two = -(k**2) * np.array([[(wave * by_u**2).sum(), cross], [cross, (wave * by_v**2).sum()]]) / total
    return 2 * one.real, 2 * (two - np.outer(one, one)).real


def cut_angles_rad(wavelength_mm: float, diameter_mm: float) -> Array:
    """Angles of a cut through the peak, from one side to the other; the middle one is zero."""
    unit = min(wavelength_mm / diameter_mm, np.pi / 2 / CUT_REACH * 0.95)
    count = round(CUT_REACH / CUT_STEP)
    return np.asarray(np.arange(-count, count + 1) * CUT_STEP * unit)


def cut_directions(u: float, v: float, phi_deg: float, angle_rad: Array) -> Array:
    """Direction cosines (A, 2) along the great circle through (u, v) that leaves it in the plane of azimuth phi."""
    middle = direction_of((u, v))
    along = np.array([np.cos(np.radians(phi_deg)), np.sin(np.radians(phi_deg)), 0.0])
    along = along - (along @ middle) * middle
    along /= np.linalg.norm(along)
    way: Array = np.cos(angle_rad)[:, None] * middle[:2] + np.sin(angle_rad)[:, None] * along[:2]
    return way


def cut_figures(angle_rad: Array, power_db: Array) -> tuple[float, float]:
    """Full width at half power (rad) and the higher first sidelobe (dB below the cut's peak) of a cut (A,); NaN where it shows none."""
    spline = CubicSpline(angle_rad, np.maximum(power_db, power_db.max() - 100.0))
    turns = spline.derivative().roots(extrapolate=False)
    bends = spline.derivative(2)(turns)
    tops, dips = turns[bends < 0], turns[bends > 0]
    if not len(tops):
        return float("nan"), float("nan")
    top = float(tops[np.argmax(spline(tops))])
    level = float(spline(top))
    crossings = spline.solve(level - 10 * np.log10(2.0), extrapolate=False)
    before, after = crossings[crossings < top], crossings[crossings > top]
    width = float(after.min() - before.max()) if len(before) and len(after) else float("nan")
    lobes = []
    for side in (-1, 1):
        nulls = dips[side * (dips - top) > 0]
        if len(nulls):
            null = nulls[np.argmin(np.abs(nulls - top))]
            beyond = tops[side * (tops - null) > 0]
            if len(beyond):
                lobes.append(float(spline(beyond[np.argmin(np.abs(beyond - null))])) - level)
    return width, max(lobes, default=float("nan"))


def _coarse_peak(sources: Sources, wavelength_mm: float, unit: float, polarization: str) -> tuple[float, float, float]:
    """The best direction of a grid about the boresight, and the largest cross-polar gain on it in dBi."""
    reach = min(REACH * unit, FARTHEST)
    side = np.linspace(-reach, reach, 2 * int(np.ceil(reach / (STEP * unit))) + 1)
    grid = pattern_grid(sources, wavelength_mm, side, side, polarization)
    power = np.nan_to_num(np.abs(grid.co) ** 2)
    row, column = np.unravel_index(np.argmax(power), power.shape)
    if {int(row), int(column)} & {0, len(side) - 1}:
        raise FitError(
            f"the strongest direction lies {np.degrees(reach):.3g} degrees or more from the boresight; "
            "the deformation tilts or scatters the beam beyond what is looked at, or nothing of the aperture is left free"
        )
    cross = float(decibels(np.nanmax(np.abs(grid.cross) ** 2)))
    return float(side[column]), float(side[row]), cross


def uphill(gradient: Array, hessian: Array) -> Array:
    """Newton's step towards a maximum, along the gradient's sense also where the function is not concave."""
    values, vectors = np.linalg.eigh(hessian)
    return np.asarray(vectors @ ((vectors.T @ gradient) / np.maximum(np.abs(values), 1e-300)))
