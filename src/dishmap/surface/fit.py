"""A smooth surface through a point cloud, robustly (the paper's Algorithm 4), with covariance.

Plane, polynomial and Zernike surfaces are heights z over x, y of the cloud's frame, linear in their coefficients; what is
left over is measured along z, its sigma being that of z minus slope times x, y. A paraboloid or cylinder may lie in any attitude; what
is left over is the exact orthogonal distance, since that is what a dish's error means and it does not depend on the frame: positive on the
focus's side of a paraboloid, on the side of +z of a cylinder. Either way a point's own covariance, seen along that direction, is its
prior weight.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.special import ndtr, stdtrit

from dishmap.errors import FitError, InputError
from dishmap.quality import Quality
from dishmap.robust import TUNING, RobustFit, mad_scale, robust_fit, robust_linear_fit
from dishmap.surface import cylinder, paraboloid
from dishmap.surface.cloud import PointCloud
from dishmap.surface.zernike import LARGEST_DEGREE, term_name, zernike_gradient, zernike_matrix, zernike_terms

Array = NDArray[np.float64]

KINDS = ("plane", "polynomial", "zernike", "paraboloid", "cylinder")
DEGREE_KINDS = ("polynomial", "zernike")
# Twice: sigmas along z need the surface's slope, which the first pass gives.
PASSES = 2
# The MAD of n values knows their scale as well as a standard deviation of 0.37 n does.
MAD_EFFICIENCY = 0.37
# A curvature less than this many sigmas above zero is no paraboloid.
LEAST_CURVATURE_SIGMAS = 5.0


@dataclass(frozen=True)
class _Oriented:
    """A surface that may lie in any attitude.

    names, units of the numbers reported; start(points): placement and parameters; distances(points, placement, parameters); reported
    and spread(placement, parameters): those numbers and their derivative; height(xy, numbers). Curvature is the last parameter.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    parameters: int
    start: Callable[[Array], tuple[Any, Array]]
    distances: Callable[[Array, Any, Array], tuple[Array, Array, Array]]
    reported: Callable[[Any, Array], Array]
    spread: Callable[[Any, Array], Array]
    height: Callable[[Array, Array], tuple[Array, Array]]
    curvature: str
    instead: str


ORIENTED = {
    "paraboloid": _Oriented(
        paraboloid.NAMES,
        paraboloid.UNITS,
        6,
        paraboloid.start_placement,
        paraboloid.distances,
        paraboloid.Placement.vertex_axis_focal,
        paraboloid.Placement.spread,
        paraboloid.height_along_z,
        "1/(4 f)",
        "measure a larger part of the dish",
    ),
    "cylinder": _Oriented(
        cylinder.NAMES,
        cylinder.UNITS,
        5,
        cylinder.start_generator,
        cylinder.distances,
        cylinder.Generator.point_axis_radius,
        cylinder.Generator.spread,
        cylinder.height_along_z,
        "1/radius",
        "measure more of it around its axis",
    ),
}


@dataclass(frozen=True)
class Basis:
    """What kind of surface to fit.

    kind: `plane`, `polynomial`, `zernike`, `paraboloid` or `cylinder`; degree: of a polynomial or of Zernike terms; radius_mm: of the
    Zernike disc (default: the farthest point), or the length by which a polynomial's x and y are divided; center_mm: x, y of
    the middle of the disc (default 0, 0) or of the plane's or polynomial's origin (default: the points' mean).
    """

    kind: str = "plane"
    degree: int = 1
    radius_mm: float | None = None
    center_mm: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            near = difflib.get_close_matches(self.kind, KINDS, n=1, cutoff=0.0)[0]
            raise InputError(f"unknown surface {self.kind!r}; the nearest is {near!r} (all: {', '.join(KINDS)})")
        if self.kind in DEGREE_KINDS and not 0 <= self.degree <= LARGEST_DEGREE:
            raise InputError(f"the degree of a {self.kind} surface lies between 0 and {LARGEST_DEGREE}, not {self.degree}")
        if self.radius_mm is not None and not (np.isfinite(self.radius_mm) and self.radius_mm > 0):
            raise InputError(f"the radius of a surface must be a positive number of mm, not {self.radius_mm}")

    @property
    def along_normal(self) -> bool:
        """True for a surface in any attitude, to which distances are measured along its normal; False for a height over x, y."""
        return self.kind in ORIENTED


@dataclass(frozen=True)
class SurfaceFit:
    """A fitted surface; N points, P coefficients.

    basis: with degree, radius and centre filled in; frame: of the cloud; names, units (P,) of the coefficients (P,);
    covariance (P, P): from the points' own noise, scaled by what is left over; calibration_covariance (P, P): the part that
    all points share through the camera, or None if not asked for. ids (N,); weights (N,): bisquare, 0 where left out;
    residual_mm (N,): point minus surface, along z or, for a paraboloid or cylinder, along its normal; off_surface (N,): where that is
    more than the noise explains. sigma_mm: robust standard deviation of the residuals; rms_mm: theirs without those off the
    surface; noise_factor: what is left over in units of the points' claimed sigmas (1 when those are true and the surface
    can follow the points), None when unweighted. converged, iterations: of the reweighting. hull_mm (H, 2): outline of the
    points used, counter-clockwise.
    """

    basis: Basis
    frame: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    coefficients: Array
    covariance: Array
    calibration_covariance: Array | None
    ids: NDArray[np.int64]
    weights: Array
    residual_mm: Array
    off_surface: NDArray[np.bool_]
    sigma_mm: float
    rms_mm: float
    noise_factor: float | None
    converged: bool
    iterations: int
    hull_mm: Array


@dataclass(frozen=True)
class SurfaceHeights:
    """Heights z (...,) of a surface in its frame with their sigmas; extrapolated where outside the outline of the points."""

    height_mm: Array
    sigma_mm: Array
    extrapolated: NDArray[np.bool_]


def parse_basis(text: str) -> Basis:
    """The basis of a text such as `plane`, `polynomial:3`, `zernike:6`, `paraboloid` or `cylinder`. Raises InputError."""
    kind, colon, degree = text.strip().lower().partition(":")
    if not colon:
        return Basis(kind, 4 if kind in DEGREE_KINDS else 1)
    if kind in KINDS and kind not in DEGREE_KINDS:
        raise InputError(f"a {kind} takes no degree, so write {kind!r} alone, not {text!r}")
    if not degree.isdecimal():
        raise InputError(f"the degree in {text!r} must be a whole number, as in {kind}:4")
    return Basis(kind, int(degree))


def fit_surface(
    cloud: PointCloud,
    basis: Basis | None = None,
    weighted: bool = True,
    camera_covariance: ArrayLike | None = None,
    start: str = "least-absolute",
) -> SurfaceFit:
    """Fit a surface (default: a plane) to the cloud, in the cloud's frame.

    weighted: whether the points' own covariances weigh them (the paper's algorithm does not). camera_covariance (P, P): makes
    `calibration_covariance`, through the cloud's Jacobian. start: see `dishmap.robust.robust_linear_fit`.
    Raises FitError when the points are too few for the surface, or do not determine it.
    """
    basis = basis or Basis()
    basis = basis if basis.along_normal else _resolved(basis, cloud.position_mm)
    _check_count(basis, len(cloud))
    if basis.along_normal:
        fit, normal, coefficients, spread = _fit_oriented(cloud, basis.kind, weighted, start)
    else:
        fit, normal = _fit_heights(cloud, basis, weighted, start)
        coefficients, spread = fit.coefficients, np.eye(len(fit.coefficients))
    calibration = None if camera_covariance is None else _shared(cloud, camera_covariance, spread @ fit.sensitivity, normal)
    names, units = _names_units(basis)
    off = _off_surface(fit, weighted)
    return SurfaceFit(
        basis=basis,
        frame=cloud.frame,
        names=names,
        units=units,
        coefficients=coefficients,
        covariance=spread @ fit.covariance @ spread.T,
        calibration_covariance=calibration,
        ids=cloud.ids,
        weights=fit.weights,
        residual_mm=fit.residuals,
        off_surface=off,
        sigma_mm=mad_scale(fit.residuals / np.sqrt(1 - fit.leverage), len(fit.coefficients)),
        rms_mm=float(np.sqrt(np.mean(fit.residuals[~off] ** 2))),
        noise_factor=fit.spread if weighted else None,
        converged=fit.converged,
        iterations=fit.iterations,
        hull_mm=_hull(cloud.position_mm[(fit.weights > 0) & ~off, :2]),
    )


def surface_heights(fit: SurfaceFit, x_mm: ArrayLike, y_mm: ArrayLike) -> SurfaceHeights:
    """Heights of a fitted surface at x, y (broadcast together) of its frame.

    The sigma is that of the surface itself, own noise and, where the fit has it, calibration together. NaN where a
    paraboloid or cylinder has no point above x, y.
    """
    x, y = np.broadcast_arrays(np.asarray(x_mm, dtype=float), np.asarray(y_mm, dtype=float))
    if fit.basis.along_normal:
        height, by = ORIENTED[fit.basis.kind].height(np.stack([x, y], axis=-1), fit.coefficients)
    else:
        by = _design(fit.basis, x.ravel(), y.ravel()).reshape(*x.shape, -1)
        height = by @ fit.coefficients
    covariance = fit.covariance if fit.calibration_covariance is None else fit.covariance + fit.calibration_covariance
    variance = np.einsum("...i,ij,...j->...", by, covariance, by)
    return SurfaceHeights(np.asarray(height), np.sqrt(np.maximum(variance, 0.0)), ~_inside(fit.hull_mm, x, y))


@dataclass(frozen=True)
class Radius:
    """Radius of a fitted cylinder, positive where it bulges to +z of its frame; its sigma from the points' noise, and from calibration.

    The latter is NaN where the fit does not hold it.
    """

    radius_mm: float
    sigma_radius_mm: float
    calibration_sigma_radius_mm: float


def radius_of(fit: SurfaceFit) -> Radius | None:
    """The radius of a cylinder, None of other surfaces."""
    if "radius" not in fit.names:
        return None
    k, shared = fit.names.index("radius"), fit.calibration_covariance
    sigma = float(np.sqrt(fit.covariance[k, k]))
    return Radius(float(fit.coefficients[k]), sigma, float("nan") if shared is None else float(np.sqrt(shared[k, k])))


def flag_off_surface(cloud: PointCloud, fit: SurfaceFit) -> PointCloud:
    """The cloud with the bit OFF_SURFACE set on the points that the fit found off the surface. Raises InputError for another cloud."""
    if not np.array_equal(cloud.ids, fit.ids):
        raise InputError("the surface was fitted to other points than those to be flagged")
    return replace(cloud, quality=cloud.quality | np.where(fit.off_surface, int(Quality.OFF_SURFACE), 0))


def _resolved(basis: Basis, position: Array) -> Basis:
    xy = position[:, :2]
    mean = xy.mean(axis=0) if len(xy) else np.zeros(2)
    center = basis.center_mm or ((0.0, 0.0) if basis.kind == "zernike" else (float(mean[0]), float(mean[1])))
    farthest = float(np.hypot(*(xy - center).T).max(initial=0.0)) or 1.0
    return Basis(
        basis.kind, 1 if basis.kind == "plane" else basis.degree, 1.0 if basis.kind == "plane" else basis.radius_mm or farthest, center
    )


def _check_count(basis: Basis, points: int) -> None:
    count = ORIENTED[basis.kind].parameters if basis.along_normal else (basis.degree + 1) * (basis.degree + 2) // 2
    if points > count:
        return
    most = max((d for d in range(LARGEST_DEGREE + 1) if (d + 1) * (d + 2) // 2 < points), default=-1)
    what = f"{basis.kind} surface of degree {basis.degree}" if basis.kind in DEGREE_KINDS else basis.kind
    instead = f"use degree {most} or lower, or " if basis.kind in DEGREE_KINDS and most >= 0 else ""
    raise FitError(
        f"{points} targets are too few for a {what}, which has {count} coefficients: {instead}measure at least {count + 1} targets"
    )


def _fit_heights(cloud: PointCloud, basis: Basis, weighted: bool, start: str) -> tuple[RobustFit, Array]:
    """The fit of z, and d residual / d position (N, 3)."""
    x, y, z = cloud.position_mm.T
    design = _design(basis, x, y)
    by_x, by_y = _design_slopes(basis, x, y)
    normal = np.tile([0.0, 0.0, 1.0], (len(x), 1))
    initial = None
    for _ in range(PASSES if weighted else 1):
        fit = robust_linear_fit(design, z, _sigma_along(cloud, normal) if weighted else None, TUNING, start, initial)
        initial, start = fit.coefficients, "given"
        normal = np.column_stack([-by_x @ fit.coefficients, -by_y @ fit.coefficients, np.ones_like(z)])
    return fit, normal


def _fit_oriented(cloud: PointCloud, kind: str, weighted: bool, start: str) -> tuple[RobustFit, Array, Array, Array]:
    """The fit of P parameters, d residual / d position (N, 3), the numbers reported (K,) and their derivative (K, P)."""
    shape = ORIENTED[kind]
    placement, parameters = shape.start(cloud.position_mm)

    def model(at: Array) -> tuple[Array, Array]:
        distance, by, _ = shape.distances(cloud.position_mm, placement, at)
        return distance, -by

    values, _, normal = shape.distances(cloud.position_mm, placement, np.array([*parameters[:-1], 0.0]))
    for _ in range(PASSES):
        noise = _sigma_along(cloud, normal) if weighted else None
        try:
            fit = robust_fit(model, parameters, values, noise, TUNING, start)
        except FitError as error:
            raise FitError(f"the points do not determine a {kind} (are they flat?): {error}") from error
        parameters, start = fit.coefficients, "given"
        normal = shape.distances(cloud.position_mm, placement, parameters)[2]
    curvature, sigma = parameters[-1], float(np.sqrt(fit.covariance[-1, -1]))
    # the start turns a paraboloid's focus to its hollow side, so that its curvature is positive; a cylinder may be hollow
    if not (curvature if kind == "paraboloid" else abs(curvature)) > LEAST_CURVATURE_SIGMAS * sigma:
        raise FitError(
            f"the points show no curvature for a {kind}: {shape.curvature} is {curvature:.3g} with a sigma of {sigma:.3g} per mm; "
            f"fit a plane or {shape.instead}"
        )
    return fit, normal, shape.reported(placement, parameters), shape.spread(placement, parameters)


def _sigma_along(cloud: PointCloud, normal: Array) -> Array:
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", normal, cloud.covariance_mm2, normal))
    if not (sigma > 0).all():
        raise FitError("some points claim no error at all, so they cannot be weighed; give covariances, or fit unweighted")
    return np.asarray(sigma)


def _shared(cloud: PointCloud, camera_covariance: ArrayLike, sensitivity: Array, normal: Array) -> Array:
    """Covariance (P, P) of the coefficients from the camera's calibration."""
    if cloud.calibration_jacobian is None:
        raise InputError("these points carry no Jacobian to the camera's parameters; fit without camera_covariance")
    covariance = np.asarray(camera_covariance, dtype=float)
    if covariance.shape != (cloud.calibration_jacobian.shape[-1],) * 2:
        raise InputError(f"the camera's covariance must be square of size {cloud.calibration_jacobian.shape[-1]}, not {covariance.shape}")
    by = sensitivity @ np.einsum("ni,nip->np", normal, cloud.calibration_jacobian)
    return np.asarray(by @ covariance @ by.T)


def _off_surface(fit: RobustFit, weighted: bool) -> NDArray[np.bool_]:
    """Where a residual is beyond the bisquare's reach, as far as the scale is known.

    With claimed sigmas the scale is not taken below them; without, a scale from few points is itself uncertain, and the limit
    is that of Student's t for as many degrees of freedom, for the same chance of a false alarm.
    """
    if weighted:
        return np.asarray(np.abs(fit.adjusted) > TUNING * max(fit.scale, 1.0))
    freedom = max(1.0, MAD_EFFICIENCY * (len(fit.adjusted) - len(fit.coefficients)))
    return np.asarray(np.abs(fit.adjusted) > fit.scale * stdtrit(freedom, ndtr(TUNING)))


def _exponents(degree: int) -> list[tuple[int, int]]:
    return [(total - j, j) for total in range(degree + 1) for j in range(total + 1)]


def _names_units(basis: Basis) -> tuple[tuple[str, ...], tuple[str, ...]]:
    if basis.along_normal:
        return ORIENTED[basis.kind].names, ORIENTED[basis.kind].units
    if basis.kind == "plane":
        return ("height", "slope_x", "slope_y"), ("mm", "mm/mm", "mm/mm")
    if basis.kind == "polynomial":
        names = tuple(f"x{i}y{j}" for i, j in _exponents(basis.degree))
    else:
        names = tuple(term_name(n, m) for n, m in zernike_terms(basis.degree))
    return names, ("mm",) * len(names)


def _scaled(basis: Basis, x: Array, y: Array) -> tuple[Array, Array, float]:
    (cx, cy), radius = basis.center_mm or (0.0, 0.0), basis.radius_mm or 1.0
    return (x - cx) / radius, (y - cy) / radius, radius


def _design(basis: Basis, x: Array, y: Array) -> Array:
    u, v, _ = _scaled(basis, x, y)
    if basis.kind == "zernike":
        return zernike_matrix(zernike_terms(basis.degree), u, v)
    return np.stack([u**i * v**j for i, j in _exponents(basis.degree)], axis=-1)


def _design_slopes(basis: Basis, x: Array, y: Array) -> tuple[Array, Array]:
    """Derivatives (N, P) of the design along x and y, per mm."""
    u, v, radius = _scaled(basis, x, y)
    if basis.kind == "zernike":
        pairs = [zernike_gradient(n, m, u, v) for n, m in zernike_terms(basis.degree)]
        return np.stack([p[0] for p in pairs], axis=-1) / radius, np.stack([p[1] for p in pairs], axis=-1) / radius
    powers = _exponents(basis.degree)
    by_x = np.stack([i * u ** max(i - 1, 0) * v**j for i, j in powers], axis=-1)
    by_y = np.stack([j * u**i * v ** max(j - 1, 0) for i, j in powers], axis=-1)
    return by_x / radius, by_y / radius


def _hull(xy: Array) -> Array:
    try:
        return np.asarray(xy[ConvexHull(xy).vertices])
    except QhullError as error:
        raise FitError("the points left on the surface lie on one line in x, y, so they span no surface") from error


def _inside(hull: Array, x: Array, y: Array) -> NDArray[np.bool_]:
    """Where points lie in a convex, counter-clockwise outline (H, 2), its edge included to rounding."""
    edge = np.roll(hull, -1, axis=0) - hull
    length = np.hypot(edge[:, 0], edge[:, 1])
    cross = edge[:, 0] * (y[..., None] - hull[:, 1]) - edge[:, 1] * (x[..., None] - hull[:, 0])
    return np.asarray((cross >= -1e-9 * length * length.sum()).all(axis=-1))
