"""Ellipses in bulk: fits to many contours at once, and which ellipse lies in which.

Points of all contours stand in one array, contour after contour, with the index at which each starts; sums over a
contour are `np.add.reduceat`. No Python loop runs over contours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# A contour whose first fit leaves more than this (px, and part of its radius) is fitted again with points that lie this
# many times the rms off losing most of their weight: a nick or a touching speck then does not bend the ellipse.
REFIT_RMS_PX, REFIT_RMS_PART = 0.1, 0.01
ROBUST_RMS = 1.5
# Room for rounding in divisions, for numbers of order one.
TINY = 1e-12
# How far beyond an ellipse, in its own radii, the one inside may reach (contour noise of small circles).
NESTING_SLACK = 0.1


@dataclass(frozen=True)
class Fits:
    """Ellipses fitted to M contours.

    center (M, 2); semi_axes (M, 2), major first; angle_rad (M,) of the major axis from +u towards +v; rms (M,): distance
    of the points to the ellipse. Where no ellipse fits, semi_axes are NaN.
    """

    center: Array
    semi_axes: Array
    angle_rad: Array
    rms: Array


def matrices_2x2(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Matrices [[a, b], [c, d]] (..., 2, 2)."""
    return np.stack([np.stack([a, b], axis=-1), np.stack([c, d], axis=-1)], axis=-2)


def invert_2x2(m: Array) -> Array:
    """Inverses of matrices (..., 2, 2); a good deal faster than LAPACK on many small ones."""
    a, b, c, d = m[..., 0, 0], m[..., 0, 1], m[..., 1, 0], m[..., 1, 1]
    return matrices_2x2(d, -b, -c, a) / (a * d - b * c)[..., None, None]


def root_det(m: Array) -> Array:
    """Root of the absolute determinant of matrices (..., 2, 2): the mean scale of a map."""
    return np.asarray(np.sqrt(np.abs(m[..., 0, 0] * m[..., 1, 1] - m[..., 0, 1] * m[..., 1, 0])))


def ellipse_matrices(semi_axes: Array, angle_rad: Array) -> Array:
    """Symmetric matrices (M, 2, 2) that map the unit circle to each ellipse about its centre."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    major, minor = semi_axes[..., 0], semi_axes[..., 1]
    cross = (major - minor) * c * s
    return matrices_2x2(major * c * c + minor * s * s, cross, cross, major * s * s + minor * c * c)


def contour_spread(points: Array, starts: Index) -> Array:
    """Relative standard deviation (M,) of the squared radius of each contour, scaled to unit second moments.

    Zero for an ellipse sampled evenly; 0.22 for parallelograms. A cheap test before anything is fitted.
    """
    counts = _counts(points, starts)
    x, y = _centred(points, starts, counts)[0].T
    xx, xy, yy = x * x, x * y, y * y
    a, b, c = (np.add.reduceat(t, starts) / counts for t in (xx, xy, yy))
    quartic = [np.add.reduceat(t, starts) / counts for t in (xx * xx, xx * xy, xx * yy, xy * yy, yy * yy)]
    det = np.maximum(a * c - b * b, TINY)
    # mean of (c x^2 - 2 b x y + a y^2)^2 / det^2; the mean of the squared radius itself is 2
    parts = (c * c, -4 * b * c, 4 * b * b + 2 * a * c, -4 * a * b, a * a)
    square = sum(part * q for part, q in zip(parts, quartic, strict=True))
    return np.sqrt(np.maximum(square / det**2 / 4 - 1, 0.0))


def fit_ellipses(points: Array, starts: Index, weights: Array) -> Fits:
    """Fit one ellipse to each contour by least squares, those with ragged contours a second time with robust weights.

    points (N, 2) and weights (N,), contour after contour; starts (M,) index of each contour's first point. The squared
    algebraic distance is least with the mean of the quadratic part held fixed: on points scaled to unit second moments,
    where the contour is nearly a unit circle, that is twice the geometric distance, with no bias to small ellipses.
    """
    fits = _fit(points, starts, weights)
    counts = _counts(points, starts)
    ragged = fits.rms > REFIT_RMS_PX + REFIT_RMS_PART * np.sqrt(fits.semi_axes.prod(axis=1))
    if not ragged.any():
        return fits
    chosen = np.repeat(ragged, counts)
    points, weights, counts = points[chosen], weights[chosen], counts[ragged]
    starts = np.cumsum(counts) - counts
    some = Fits(*(getattr(fits, name)[ragged] for name in Fits.__dataclass_fields__))
    limit = ROBUST_RMS * np.repeat(some.rms, counts)
    again = _fit(points, starts, weights / (1 + (ellipse_distance(points, some, counts) / limit) ** 4))
    # the residual that is reported belongs to the points as given
    distance = ellipse_distance(points, again, counts)
    rms = np.sqrt(np.add.reduceat(weights * distance**2, starts) / np.maximum(np.add.reduceat(weights, starts), TINY))
    for name, values in (("center", again.center), ("semi_axes", again.semi_axes), ("angle_rad", again.angle_rad), ("rms", rms)):
        getattr(fits, name)[ragged] = values
    return fits


def ellipse_distance(points: Array, fits: Fits, counts: Index) -> Array:
    """Signed distance (N,) of contour points to their ellipse, outside positive (Sampson's first-order distance)."""
    inverse = invert_2x2(np.where(np.isfinite(fits.semi_axes[:, :1, None]), ellipse_matrices(fits.semi_axes, fits.angle_rad), np.eye(2)))
    p, q, r = (np.repeat(inverse[:, i, j], counts) for i, j in ((0, 0), (0, 1), (1, 1)))
    x, y = (points - np.repeat(fits.center, counts, axis=0)).T
    u, v = p * x + q * y, q * x + r * y
    return np.asarray(0.5 * (u * u + v * v - 1) / np.maximum(np.hypot(p * u + q * v, q * u + r * v), TINY))


def _counts(points: Array, starts: Index) -> Index:
    return np.diff(np.append(starts, len(points)))


def _centred(points: Array, starts: Index, counts: Index, weights: Array | None = None) -> tuple[Array, Array, Array]:
    """Points about their contour's mean in units of its rms radius, the means (M, 2), and the radii (M,)."""
    w = np.ones(len(points)) if weights is None else weights
    total = np.maximum(np.add.reduceat(w, starts), TINY)
    mean = np.stack([np.add.reduceat(w * points[:, k], starts) for k in (0, 1)], axis=1) / total[:, None]
    offset = points - np.repeat(mean, counts, axis=0)
    radius = np.sqrt(np.add.reduceat(w * (offset[:, 0] ** 2 + offset[:, 1] ** 2), starts) / total)
    radius = np.maximum(radius, TINY)
    return offset / np.repeat(radius, counts)[:, None], mean, radius


def _fit(points: Array, starts: Index, weights: Array) -> Fits:
    """Conics v = (A, B, C, D, E, F) with least v'Sv for a fixed mean of A x^2 + B x y + C y^2; S the scatter of monomials."""
    counts = _counts(points, starts)
    scaled, mean, radius = _centred(points, starts, counts, weights)
    x, y = scaled.T
    total = np.maximum(np.add.reduceat(weights, starts), TINY)
    powers_x, powers_y = [weights], [np.ones_like(y)]
    for _ in range(4):
        powers_x.append(powers_x[-1] * x)
        powers_y.append(powers_y[-1] * y)
    sums = {(i, j): np.add.reduceat(powers_x[i] * powers_y[j], starts) / total for i in range(5) for j in range(5 - i)}
    monomials = ((2, 0), (1, 1), (0, 2), (1, 0), (0, 1), (0, 0))
    scatter = np.stack([np.stack([sums[a + c, b + d] for c, d in monomials], axis=-1) for a, b in monomials], axis=-2)
    quadratic = np.stack([sums[2, 0], sums[1, 1], sums[0, 2]] + [np.zeros(len(starts))] * 3, axis=-1)
    conic = np.linalg.solve(scatter + TINY * np.eye(6), quadratic[..., None])[..., 0]
    scale = (conic * quadratic).sum(axis=1)
    conic = conic / np.where(np.abs(scale) > TINY, scale, np.nan)[:, None]
    misfit = np.einsum("mi,mij,mj->m", conic, scatter, conic)
    return _from_conics(conic, mean, radius, np.sqrt(np.maximum(misfit, 0.0)))


def _from_conics(conic: Array, mean: Array, radius: Array, misfit: Array) -> Fits:
    """Ellipses of conics in coordinates about `mean` in units of `radius`; misfit (M,): rms algebraic distance."""
    a, b, c, d, e, f = conic.T
    b = b / 2
    det = a * c - b * b
    with np.errstate(invalid="ignore", divide="ignore"):
        center = np.stack([b * e - c * d, b * d - a * e], axis=-1) / (2 * det)[:, None]
        level = -f - 0.5 * (d * center[:, 0] + e * center[:, 1])
        # the squared half axes are level over the eigenvalues of [[a, b], [b, c]]
        half, difference = (a + c) / 2, np.hypot((a - c) / 2, b)
        squares = np.stack([level / (half - difference), level / (half + difference)], axis=-1)
        good = (det > TINY) & (level > 0) & np.isfinite(squares).all(axis=1) & (squares > 0).all(axis=1)
        angle = 0.5 * np.arctan2(-2 * b, c - a)
        semi_axes = np.sqrt(np.where(good[:, None], squares, np.nan)) * radius[:, None]
        # f = rho^2 - level and level is near one, so half of it is the distance in units of the local radius
        rms = 0.5 * misfit / level * np.sqrt(semi_axes.prod(axis=1))
    return Fits(mean + np.nan_to_num(center) * radius[:, None], semi_axes, angle, rms)


def enclosing(center: Array, semi_axes: Array, angle_rad: Array) -> Index:
    """Index (M,) of the smallest ellipse around each ellipse, -1 where there is none.

    One ellipse lies in another when its centre does, and its four vertices too but for a tenth of the outer's radius.
    """
    from scipy.spatial import cKDTree

    m = len(center)
    parent = np.full(m, -1, dtype=np.int64)
    if m < 2:
        return parent
    tree = cKDTree(center)
    hits = tree.query_ball_point(center, semi_axes[:, 0])
    outer = np.repeat(np.arange(m), np.fromiter(map(len, hits), dtype=np.int64, count=m))
    inner = np.concatenate([np.asarray(h, dtype=np.int64) for h in hits])
    area = semi_axes.prod(axis=1)
    keep = area[inner] < area[outer]
    outer, inner = outer[keep], inner[keep]
    unit = invert_2x2(ellipse_matrices(semi_axes, angle_rad))[outer]
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    major, minor = np.stack([c, s], axis=-1) * semi_axes[:, :1], np.stack([-s, c], axis=-1) * semi_axes[:, 1:]
    inside = np.ones(len(outer), dtype=bool)
    for vertex in (major, -major, minor, -minor):
        x, y = (center[inner] + vertex[inner] - center[outer]).T
        u, v = unit[:, 0, 0] * x + unit[:, 0, 1] * y, unit[:, 1, 0] * x + unit[:, 1, 1] * y
        inside &= u * u + v * v < (1 + NESTING_SLACK) ** 2
    outer, inner = outer[inside], inner[inside]
    # largest first, so that the smallest is written last
    order = np.argsort(-area[outer], kind="stable")
    parent[inner[order]] = outer[order]
    return parent
