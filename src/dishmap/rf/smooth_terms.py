"""Zernike terms of smooth random surfaces: how large they are expected to be, and how they go over to a smaller disc.

Two families. A Matern 5/2 field (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, 4.2) is the same everywhere and
knows nothing of a rim: bumps, creases, cloth between ribs. Independent Zernike terms whose variance falls with their degree alone are
steepest at the rim, where a free edge bends farthest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dishmap.surface.membrane import disc_points
from dishmap.surface.zernike import zernike_matrix, zernike_terms

Array = NDArray[np.float64]
Terms = tuple[tuple[int, int], ...]

# Terms for each target: as many as resolve more than the targets do. Below the smallest degree nothing is smooth enough, and above the
# largest nothing comes of the cost: a wave over a thirteenth of the diameter.
TERMS_PER_TARGET, SMALLEST_DEGREE, LARGEST_DEGREE = 2.5, 4, 24
# Matern fields: how many lengths, from the finest that can be told to the longest, in radii.
LENGTHS, LONGEST = 4, 2.0
# Independent terms: the variance of a term with unit mean square over the disc falls as (n + 1)^-power, or as exp(-(n / degree)^2).
POWERS, DEGREES = (2.0, 3.0, 4.0, 6.0), (3.0, 5.0, 8.0, 12.0)
# Beyond the exact degree of a rule for polynomials, for the kernel, which is none.
MORE_DEGREE = 16


def terms_for(targets: int) -> Terms:
    """All terms up to the degree that fits so many targets."""
    degree = int(np.floor(np.sqrt(2 * TERMS_PER_TARGET * targets) - 1.5))
    return zernike_terms(int(np.clip(degree, SMALLEST_DEGREE, LARGEST_DEGREE)))


def candidate_roots(terms: Terms, finest: float) -> list[Array]:
    """Square roots (T, T) of the covariances of terms under every kind of surface that is weighed; finest: in radii of the disc."""
    n = np.array([n for n, _ in terms])
    shortest = min(max(finest, np.pi / float(n.max())), LONGEST)
    falls = [(n + 1.0) ** -power for power in POWERS] + [np.exp(-((n / degree) ** 2)) for degree in DEGREES]
    return [matern_root(terms, length) for length in np.geomspace(shortest, LONGEST, LENGTHS)] + [falling_root(terms, v) for v in falls]


def falling_root(terms: Terms, variance: Array) -> Array:
    """A square root (T, T) of the covariance of independent terms of these variances (T,) as their mean squares over the disc."""
    return np.diag(np.sqrt(variance / mean_square(terms)))


def mean_square(terms: Terms) -> Array:
    """Mean square (T,) of unnormalised terms over the disc (Born and Wolf, 9.2.1)."""
    return np.array([(0.5 if m else 1.0) / (n + 1) for n, m in terms])


def matern_root(terms: Terms, length: float) -> Array:
    """A square root (T, T) of the covariance of the terms of a Matern field of unit variance; terms: all up to some degree.

    A term is the field's projection on its polynomial. Around the axis the field is a Fourier series of independent parts, so terms of
    different m are independent, and within one m the covariance is a double integral over the radius.
    """
    degree = max(n for n, _ in terms)
    node, weight = np.polynomial.legendre.leggauss(degree + MORE_DEGREE // 2)
    radius, weight = np.sqrt(0.5 * (node + 1)), 0.25 * weight
    turns = 4 * (degree + MORE_DEGREE)
    angle = 2 * np.pi * np.arange(turns) / turns
    square = radius[:, None, None] ** 2 + radius[:, None] ** 2 - 2 * radius[:, None, None] * radius[:, None] * np.cos(angle)
    series = np.fft.rfft(matern(np.sqrt(np.maximum(square, 0.0)) / length)).real / turns
    out = np.zeros((len(terms), len(terms)))
    place = {term: i for i, term in enumerate(terms)}
    for m in range(degree + 1):
        degrees = range(m, degree + 1, 2)
        twice = 2 * (np.array(degrees)[:, None] + 1)
        radial = zernike_matrix([(n, m) for n in degrees], radius, np.zeros_like(radius)).T * twice * weight
        block = radial @ series[:, :, m] @ radial.T * (2 if m else 1)
        values, vectors = np.linalg.eigh(0.5 * (block + block.T))
        for sign in (1, -1) if m else (1,):
            rows = [place[n, sign * m] for n in degrees]
            out[np.ix_(rows, rows)] = vectors * np.sqrt(np.maximum(values, 0.0))
    return out


def matern(distance: Array) -> Array:
    """Correlation of a Matern 5/2 field at distances (...) in units of its length."""
    scaled = np.sqrt(5) * distance
    return np.asarray((1 + scaled + scaled**2 / 3) * np.exp(-scaled))


def narrowed(terms: Terms, share: float) -> Array:
    """A matrix (T, T) from coefficients on a disc to those of the same polynomial on the concentric disc `share` times as large.

    terms: all up to some degree.
    """
    degree = max(n for n, _ in terms)
    points, weight = disc_points(1.0, 2 * degree)
    x, y = points.T
    projection = (zernike_matrix(terms, x, y) * weight[:, None]).T / (np.pi * mean_square(terms)[:, None])
    return np.asarray(projection @ zernike_matrix(terms, share * x, share * y))
