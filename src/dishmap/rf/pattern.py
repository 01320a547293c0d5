"""Far-field patterns as records: cuts and grids of co- and cross-polar field (Ludwig's third definition).

Fields are complex and scaled so that |co|^2 + |cross|^2 is the gain over an isotropic radiator of the feed's whole power (a ratio, not
dB); their phase is that at the dish frame's origin. u = sin(theta) cos(phi), v = sin(theta) sin(phi) are direction cosines in the dish
frame, theta counted from its z axis, the boresight. For x polarisation co is along Ludwig's x, for `right` it is right-hand circular.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Cut:
    """The field along a great circle through the boresight: theta_deg (T,) may be negative; phi_deg: its azimuth; co, cross (T,)."""

    theta_deg: Array
    phi_deg: float
    co: Complex
    cross: Complex


@dataclass(frozen=True)
class PatternGrid:
    """The field over direction cosines: u (X,), v (Y,); co, cross (Y, X), NaN where u^2 + v^2 >= 1."""

    u: Array
    v: Array
    co: Complex
    cross: Complex


def direction_of(uv: ArrayLike) -> Array:
    """Unit vector (3,) of direction cosines (u, v)."""
    u, v = np.asarray(uv, dtype=float)
    return np.array([u, v, np.sqrt(1 - u**2 - v**2)])


def decibels(power: Array) -> Array:
    """Ten times the decimal logarithm of powers of any shape; -inf where there is none."""
    with np.errstate(divide="ignore"):
        return np.asarray(10 * np.log10(power))
