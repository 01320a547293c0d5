"""The far field of currents: E(r) = -j k / sqrt(4 pi) sum M_t exp(j k (r . p - path)), M_t the part of the moment across r.

Its square is the gain (Balanis, Antenna Theory, section 12.2, with fields over the feed's power). Sums for many directions are
non-uniform fast Fourier transforms (finufft, type 3); for few they are plain sums.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.rf.feed import ludwig_axes, polarization_axes
from dishmap.rf.pattern import Cut, PatternGrid
from dishmap.rf.sources import Sources

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Error of the transform, relative to the largest field: -120 dB of the peak.
TRANSFORM_ERROR = 1e-6
# Up to so many directions plain sums are faster.
FEW = 24


def far_field(sources: Sources, wavelength_mm: float, u: ArrayLike, v: ArrayLike, polarization: str) -> tuple[Complex, Complex]:
    """Co- and cross-polar field (D,) at direction cosines u, v (D,), for directions in front of the dish (u^2 + v^2 < 1)."""
    u, v = np.asarray(u, dtype=float), np.asarray(v, dtype=float)
    direction = np.stack([u, v, np.sqrt(1 - u**2 - v**2)], axis=1)
    k = 2 * np.pi / wavelength_mm
    vector = summed(sources, k, direction)
    co_axis, cross_axis = polarization_axes(polarization, 1, *ludwig_axes(direction))
    scale = -1j * k / np.sqrt(4 * np.pi)
    return scale * (vector * co_axis.conj()).sum(axis=1), scale * (vector * cross_axis.conj()).sum(axis=1)


def summed(sources: Sources, wavenumber: float, direction: Array) -> Complex:
    """Sum (D, 3) of all moments, each with its phase towards unit directions (D, 3)."""
    start = sources.moment * np.exp(-1j * wavenumber * sources.rays.path_mm)[:, None]
    if len(direction) <= FEW:
        return np.asarray(np.exp(1j * wavenumber * (direction @ sources.point_mm.T)) @ start)
    import finufft

    # phases towards the middle of the directions are taken out, so that the transform sees the small rest
    middle = (direction.min(axis=0) + direction.max(axis=0)) / 2
    start = start * np.exp(1j * wavenumber * (sources.point_mm @ middle))[:, None]
    x, y, z = np.ascontiguousarray(sources.point_mm.T)
    a, b, c = np.ascontiguousarray(wavenumber * (direction - middle).T)
    return np.asarray(
        finufft.nufft3d3(x, y, z, np.ascontiguousarray(start.T), a, b, c, eps=TRANSFORM_ERROR, isign=1, nthreads=1).T, dtype=complex
    )


def pattern_grid(sources: Sources, wavelength_mm: float, u: Array, v: Array, polarization: str) -> PatternGrid:
    """The field over direction cosines u (X,) and v (Y,); NaN behind the dish."""
    across, up = np.meshgrid(u, v)
    inside = across**2 + up**2 < 1
    co, cross = (np.full(across.shape, np.nan + 0j) for _ in range(2))
    co[inside], cross[inside] = far_field(sources, wavelength_mm, across[inside], up[inside], polarization)
    return PatternGrid(u, v, co, cross)


def pattern_cut(sources: Sources, wavelength_mm: float, theta_deg: Array, phi_deg: float, polarization: str) -> Cut:
    """The field at angles theta (T,) from the boresight, within 90 degrees either way, in the plane of azimuth phi."""
    sine = np.sin(np.radians(theta_deg))
    phi = np.radians(phi_deg)
    return Cut(theta_deg, phi_deg, *far_field(sources, wavelength_mm, sine * np.cos(phi), sine * np.sin(phi), polarization))
