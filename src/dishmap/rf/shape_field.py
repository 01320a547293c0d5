"""The statistical shape of the main reflector: what measured targets say of its whole aperture, in Zernike terms with covariance.

What is known at the targets is carried over to the aperture by a smooth field that is learnt from them (`smooth_fit`). Between targets the
covariance is a little larger than at them; beyond their outline and in gaps it grows as fast as surfaces of that kind may bend.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import Delaunay, QhullError, cKDTree
from threadpoolctl import threadpool_limits

from dishmap.errors import InputError
from dishmap.quality import Quality
from dishmap.rf.antenna import Reflector
from dishmap.rf.deformation import Deformation
from dishmap.rf.smooth_fit import Values, fit_smooth
from dishmap.rf.smooth_terms import Terms, narrowed, terms_for
from dishmap.surface.zernike import zernike_matrix

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# A place is extrapolated when the nearest target is farther than this many spacings: a gap of about two, or one beyond the outline.
REACH_SPACINGS = 1.3
# The middle of four targets on a square is nearer than their spacing by this.
SPACING_PER_REACH = float(np.sqrt(2))
# Targets may lie this far outside the aperture, in radii: on its rim, or where it was cut a little smaller.
LARGEST_OUTSIDE = 1.05
# A target that moved on its own (a label that came off) says nothing of the surface. When more than this share did, the surface is strange.
LARGEST_LOOSE = 0.3
# What of the covariance's trace is not worth a column.
LEAST_COLUMN = 1e-12
LEAST_TARGETS = 6
# How well sizes are learnt: the standard deviation of their logarithm.
SIZE_DOUBT = 0.5


@dataclass(frozen=True)
class ShapeField:
    """What is known of the displacement of the main reflector along its nominal normal, in mm, positive towards the focus.

    terms: (n, m) of T unnormalised Zernike terms on the aperture's disc with center_mm (2,) and radius_mm, in nominal x and y; mean_mm (T,)
    and factor_mm (T, R) of their coefficients, whose covariance is factor factor^T. places_mm (N, 2): the targets it rests on; spacing_mm:
    typical distance between them; response (T, N): of the coefficients to displacements of those targets, all that was learnt taken as
    known; own_mm: rms of what targets do on their own, beyond the field; left_out: ids of targets that moved apart from the surface.
    """

    terms: Terms
    mean_mm: Array
    factor_mm: Array
    center_mm: Array
    radius_mm: float
    places_mm: Array
    spacing_mm: float
    response: Array
    own_mm: float
    left_out: tuple[int, ...]


def deformation_of(field: ShapeField, coefficients_mm: ArrayLike | None = None) -> Deformation:
    """The mean deformation, or that of other coefficients (T,), such as a row of `draws`."""
    coefficients = field.mean_mm if coefficients_mm is None else np.asarray(coefficients_mm, dtype=float)
    return Deformation(field.terms, coefficients, field.center_mm, field.radius_mm)


def draws(field: ShapeField, rng: Generator, count: int) -> Array:
    """Coefficients (count, T) in mm of surfaces that may be the true one, with the field's mean and covariance.

    How rough a surface is was learnt from that one surface, so each draw has a size of its own: sums of squares over many terms, as a loss
    of gain is, would otherwise seem known far too well.
    """
    size = np.exp(SIZE_DOUBT * rng.standard_normal((count, 1)) - SIZE_DOUBT**2)
    return np.asarray(field.mean_mm + size * (rng.standard_normal((count, field.factor_mm.shape[1])) @ field.factor_mm.T))


def sigma_at(field: ShapeField, xy_mm: ArrayLike) -> Array:
    """Standard deviation (N,) of the displacement in mm at nominal places (N, 2)."""
    x, y = ((np.asarray(xy_mm, dtype=float) - field.center_mm) / field.radius_mm).T
    return np.asarray(np.sqrt(((zernike_matrix(field.terms, x, y) @ field.factor_mm) ** 2).sum(axis=1)))


def extrapolated(field: ShapeField, xy_mm: ArrayLike) -> NDArray[np.bool_]:
    """Which places (N, 2) lie beyond the targets' outline or in a gap between them, by more than about a spacing."""
    distance, _ = cKDTree(field.places_mm).query(np.asarray(xy_mm, dtype=float))
    return np.asarray(distance > REACH_SPACINGS * field.spacing_mm)


@dataclass(frozen=True)
class TargetValues:
    """Displacements along the normal of N targets in mm: ids (N,), nominal places (N, 2), value (N,), quality (N,) bits.

    The errors have covariance factor factor^T + diag(own), factor (N, R), own (N,) in mm^2. settled: values are a posterior's (what is
    thought after all that was seen), else measured ones.
    """

    ids: Ints
    places_mm: Array
    value_mm: Array
    factor_mm: Array
    own_mm2: Array
    quality: Ints
    settled: bool


def shape_field(targets: TargetValues, reflector: Reflector) -> ShapeField:
    """The shape of the whole aperture from values at targets.

    Targets with the flag `off_surface` are left out, unless that would be many. Raises InputError for targets beyond the aperture, too few,
    or in a line.
    """
    _check_inside(targets, reflector)
    keep = (targets.quality & int(Quality.OFF_SURFACE)) == 0
    if keep.mean() < 1 - LARGEST_LOOSE:
        keep = np.ones(len(keep), dtype=bool)
    left_out = tuple(int(i) for i in targets.ids[~keep])
    values = (targets.value_mm[keep], targets.factor_mm[keep], targets.own_mm2[keep], targets.settled)
    return _fitted(targets.places_mm[keep], values, reflector.center_mm, reflector.diameter_mm / 2, left_out)


def response_to_noise(field: ShapeField, sigma_mm: float) -> Array:
    """Response (T, N) of the coefficients to the displacements of the field's targets, had each an independent error of sigma_mm.

    The larger the errors, the more they are smoothed away; the true shape is taken as the field's mean.
    """
    x, y = ((field.places_mm - field.center_mm) / field.radius_mm).T
    n = len(field.places_mm)
    values = (zernike_matrix(field.terms, x, y) @ field.mean_mm, np.zeros((n, 0)), np.full(n, sigma_mm**2), False)
    return _fitted(field.places_mm, values, field.center_mm, field.radius_mm, ()).response


def _fitted(
    places: Array, of_targets: tuple[Array, Array, Array, bool], center: Array, radius: float, left_out: tuple[int, ...]
) -> ShapeField:
    """The field through value, factor and own variances of targets at places, settled or not."""
    spacing = _spacing_mm(places)
    # terms grow steeply beyond their disc, so one is taken that holds all targets
    wide = max(radius, float(np.linalg.norm(places - center, axis=1).max()))
    terms = terms_for(len(places))
    values = Values((places - center) / wide, *of_targets)
    # matrices of some hundred rows: threads would cost more than they bring, far more on a busy machine
    with threadpool_limits(limits=1, user_api="blas"):
        fit = fit_smooth(values, terms, spacing / wide)
        inner = narrowed(terms, radius / wide) if wide > radius else np.eye(len(terms))
        factor = _factor(inner @ fit.covariance_mm2 @ inner.T)
    return ShapeField(terms, inner @ fit.mean_mm, factor, center, radius, places, spacing, inner @ fit.response, fit.own_mm, left_out)


def _check_inside(targets: TargetValues, reflector: Reflector) -> None:
    if len(targets.ids) < LEAST_TARGETS:
        raise InputError(f"{len(targets.ids)} targets are too few for the shape of a reflector; it needs at least {LEAST_TARGETS}")
    radius = reflector.diameter_mm / 2
    distance = np.linalg.norm(targets.places_mm - reflector.center_mm, axis=1)
    far = int(np.argmax(distance))
    if distance[far] > LARGEST_OUTSIDE * radius:
        x, y = reflector.center_mm
        raise InputError(
            f"target {targets.ids[far]} lies {distance[far]:.4g} mm from the centre ({x:g}, {y:g}) mm of the aperture, whose radius is "
            f"{radius:g} mm; give the antenna on which the targets were printed, with its diameter_mm and offset_mm"
        )


def _spacing_mm(places: Array) -> float:
    """Typical distance of neighbours among places (N, 2): from the circles through triples of neighbours, empty of others.

    Raises InputError for places in a line.
    """
    try:
        corners = places[Delaunay(places).simplices]
    except QhullError as error:
        raise InputError("the targets lie in a line, which shows no shape; measure targets all over the aperture") from error
    a, b, c = (np.linalg.norm(corners[:, i] - corners[:, j], axis=1) for i, j in ((0, 1), (1, 2), (2, 0)))
    (ux, uy), (vx, vy) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    area = 0.5 * np.abs(ux * vy - uy * vx)
    with np.errstate(divide="ignore"):
        return SPACING_PER_REACH * float(np.median(a * b * c / (4 * area)))


def _factor(covariance: Array) -> Array:
    """A factor (T, R) of a covariance (T, T), without columns that hold only rounding."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    keep = values > LEAST_COLUMN * max(float(values.sum()), 0.0)
    return np.asarray(vectors[:, keep] * np.sqrt(values[keep]))
