"""A deformed main reflector: displacement along its nominal normal in Zernike terms over the aperture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.rf.antenna import Reflector
from dishmap.surface.zernike import zernike_sum

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Deformation:
    """How far the surface moved along its nominal unit normal, in mm, positive towards the focus.

    terms: (n, m) of unnormalised Zernike terms (T); coefficients_mm (T,); center_mm (2,), radius_mm: of their disc, in nominal x and y.
    """

    terms: tuple[tuple[int, int], ...]
    coefficients_mm: Array
    center_mm: Array
    radius_mm: float


def undeformed(reflector: Reflector) -> Deformation:
    """No deformation at all."""
    return Deformation((), np.zeros(0), reflector.center_mm, reflector.diameter_mm / 2)


def displacement(deformation: Deformation, xy_mm: ArrayLike) -> tuple[Array, Array]:
    """Displacement (N,) in mm at nominal places (N, 2), and its gradient (N, 2) over x and y."""
    x, y = ((np.asarray(xy_mm, dtype=float) - deformation.center_mm) / deformation.radius_mm).T
    value, gradient = zernike_sum(deformation.terms, deformation.coefficients_mm, x, y)
    return value, gradient / deformation.radius_mm
