"""Surfaces through clouds: exact without noise, equal to other implementations, true sigmas when sampled, blind to outliers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize_scalar

from dishmap.errors import FitError, InputError
from dishmap.quality import Quality
from dishmap.surface.cloud import PointCloud, select_points, transform_cloud
from dishmap.surface.fit import Basis, fit_surface, flag_off_surface, parse_basis, surface_heights
from dishmap.surface.zernike import zernike
from dishmap.transforms import Pose

Array = NDArray[np.float64]

# sums of some hundred terms of size 100 mm in double precision
EXACT_MM = 1e-9
# two minimisers that stop at 1e-8 of the noise
SAME_MM = 1e-5
# 80 draws estimate a standard deviation to 8 %, a mean over a dozen heights to 5 %; three times that
DRAWS, SAMPLING = 80, 0.15


def cloud_of(position: Array, covariance: Array | float = 0.01, jacobian: Array | None = None, frame: str = "dish") -> PointCloud:
    n = len(position)
    covariance = np.broadcast_to(covariance * np.eye(3) if np.isscalar(covariance) else covariance, (n, 3, 3))
    up = np.tile([0.0, 0.0, 1.0], (n, 1))
    small = np.tile(np.eye(2) * 1e-4, (n, 1, 1))
    return PointCloud(
        np.arange(n), position, up, position[:, :2], covariance, np.full(n, 0.01), small, jacobian, np.zeros(n, dtype=int), frame
    )


def disc_xy(n: int, radius: float, seed: int = 0) -> Array:
    """Points spread evenly over a disc (sunflower), the outermost at the rim."""
    k = np.arange(n)
    rho, theta = radius * np.sqrt((k + 0.5) / (n - 0.5)), np.pi * (3 - np.sqrt(5)) * k + seed
    return np.column_stack([rho * np.cos(theta), rho * np.sin(theta)])


def dish(n: int = 130, focal: float = 300.0) -> Array:
    xy = disc_xy(n, 280.0)
    return np.column_stack([xy, (xy**2).sum(axis=1) / (4 * focal)])


def test_plane_is_exact_without_noise() -> None:
    xy = np.add(disc_xy(30, 100.0), [500.0, -200.0])
    fit = fit_surface(cloud_of(np.column_stack([xy, 7 + xy @ [0.2, -0.1]]), frame="camera"))
    assert (fit.names, fit.units, fit.frame) == (("height", "slope_x", "slope_y"), ("mm", "mm/mm", "mm/mm"), "camera")
    assert fit.basis.center_mm == pytest.approx(xy.mean(axis=0))
    np.testing.assert_allclose(fit.coefficients, [7 + xy.mean(axis=0) @ [0.2, -0.1], 0.2, -0.1], atol=EXACT_MM)
    assert fit.rms_mm < EXACT_MM
    assert not fit.off_surface.any()
    np.testing.assert_allclose(surface_heights(fit, 0.0, [0.0, 10.0]).height_mm, [7, 6], atol=1e-8)


def test_polynomial_is_exact_without_noise_far_from_the_origin() -> None:
    xy = np.add(disc_xy(60, 100.0), [800.0, 300.0])
    x, y = (xy - [800, 300]).T / 100
    z = 3 + x - 2 * y + 0.5 * x * y + x**3 - 4 * x * y**2
    fit = fit_surface(cloud_of(np.column_stack([xy, z])), Basis("polynomial", 3, 100.0, (800.0, 300.0)))
    found = dict(zip(fit.names, fit.coefficients, strict=True))
    expected = {"x0y0": 3, "x1y0": 1, "x0y1": -2, "x1y1": 0.5, "x3y0": 1, "x1y2": -4}
    assert found == pytest.approx({name: expected.get(name, 0.0) for name in fit.names}, abs=EXACT_MM)


def test_zernike_is_exact_without_noise() -> None:
    xy = disc_xy(80, 250.0)
    rho, theta = np.hypot(*xy.T) / 300, np.arctan2(xy[:, 1], xy[:, 0])
    z = 5 + 1.5 * zernike(2, 2, rho, theta) - 0.5 * zernike(3, -1, rho, theta) + 18.75 * zernike(2, 0, rho, theta)
    fit = fit_surface(cloud_of(np.column_stack([xy, z])), Basis("zernike", 4, 300.0))
    found = dict(zip(fit.names, fit.coefficients, strict=True))
    expected = {"piston": 5, "astigmatism_cos": 1.5, "coma_sin": -0.5, "defocus": 18.75}
    assert found == pytest.approx({name: expected.get(name, 0.0) for name in fit.names}, abs=EXACT_MM)
    # with another radius the same numbers would be wrong
    other = fit_surface(cloud_of(np.column_stack([xy, z])), Basis("zernike", 4, 301.0))
    assert np.abs(other.coefficients - fit.coefficients).max() > 0.1


def test_zernike_radius_defaults_to_the_farthest_point() -> None:
    assert fit_surface(cloud_of(dish()), Basis("zernike", 2)).basis.radius_mm == pytest.approx(280.0)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (3.1, 0.1, 0.0), (0.7, -0.9, 0.4)])
def test_paraboloid_is_exact_without_noise(turn: tuple[float, ...]) -> None:
    pose = Pose.from_rotation_vector(turn, [10.0, -5.0, 700.0])
    fit = fit_surface(transform_cloud(cloud_of(dish()), pose, "camera"), Basis("paraboloid"))
    found = dict(zip(fit.names, fit.coefficients, strict=True))
    assert [found[f"vertex_{a}"] for a in "xyz"] == pytest.approx([10, -5, 700], abs=1e-6)
    assert [found[f"axis_{a}"] for a in "xyz"] == pytest.approx(pose.rotation[:, 2], abs=1e-8)
    assert found["focal_length"] == pytest.approx(300, abs=1e-6)
    assert fit.rms_mm < 1e-8


def noisy_dish(rng: np.random.Generator, sigma: float = 0.05, n: int = 130) -> Array:
    return dish(n) + sigma * rng.normal(size=(n, 3))


def test_paraboloid_equals_a_fit_with_another_parametrisation() -> None:
    """Orthogonal distances by a one-dimensional search, rotation by two tangents, weights taken over: scipy's minimum is ours."""
    points = noisy_dish(np.random.default_rng(1), n=40) @ Pose.from_rotation_vector([0.2, 0.1, 0.0], [0, 0, 0]).rotation.T
    fit = fit_surface(cloud_of(points), Basis("paraboloid"), weighted=False)

    def residuals(p: Array) -> Array:
        axis = np.array([p[3], p[4], 1.0]) / np.sqrt(1 + p[3] ** 2 + p[4] ** 2)
        q = points - p[:3]
        w = q @ axis
        r = np.sqrt(np.maximum((q**2).sum(axis=1) - w**2, 0))
        out = []
        for ri, wi in zip(r, w, strict=True):
            foot = minimize_scalar(lambda t, ri=ri, wi=wi: (t - ri) ** 2 + (t * t / (4 * p[5]) - wi) ** 2, (ri - 1, ri + 1), tol=1e-12)
            out.append(np.sqrt(foot.fun) * np.sign(wi - ri**2 / (4 * p[5])))
        return np.sqrt(fit.weights) * np.array(out)

    other = least_squares(
        residuals, [0.0, 0.0, 0.0, fit.coefficients[3] / fit.coefficients[5], -0.2, 290.0], x_scale=[1, 1, 1, 0.01, 0.01, 10]
    )
    assert other.x[5] == pytest.approx(fit.coefficients[6], abs=1e-3)
    np.testing.assert_allclose(other.x[:3], fit.coefficients[:3], atol=1e-2)
    np.testing.assert_allclose(residuals(other.x), np.sqrt(fit.weights) * fit.residual_mm, atol=1e-4)


def test_heights_equal_weighted_polyfit() -> None:
    """At the final weights the polynomial is the weighted least-squares one, by normal equations in plain powers of x and y."""
    rng = np.random.default_rng(2)
    xy = disc_xy(90, 1.0)
    variance = rng.uniform(0.5, 2.0, 90)
    z = xy[:, 0] ** 2 + 0.1 * rng.standard_t(3, 90)
    covariance = variance[:, None, None] * np.diag([0.0, 0.0, 0.01])
    fit = fit_surface(cloud_of(np.column_stack([xy, z]), covariance), Basis("polynomial", 2))
    x, y = xy.T
    a = np.column_stack([np.ones(90), x, y, x * x, x * y, y * y])
    w = fit.weights / variance
    b = np.linalg.solve(a.T @ (w[:, None] * a), a.T @ (w * z))
    np.testing.assert_allclose(surface_heights(fit, x, y).height_mm, a @ b, atol=SAME_MM)
    np.testing.assert_allclose(fit.residual_mm, z - a @ b, atol=SAME_MM)


@pytest.mark.parametrize("kind", ["plane", "zernike:4", "paraboloid"])
def test_outliers_are_found_and_do_not_matter(kind: str) -> None:
    rng = np.random.default_rng(4)
    position = noisy_dish(rng)
    if kind == "plane":
        position[:, 2] = 0.05 * rng.normal(size=130)
    clean = fit_surface(cloud_of(position, 0.05**2), parse_basis(kind))
    bad = rng.permutation(130)[:25]
    spoilt = position.copy()
    spoilt[bad, 2] += rng.uniform(2.0, 30.0, 25)
    fit = fit_surface(cloud_of(spoilt, 0.05**2), parse_basis(kind))
    assert set(np.flatnonzero(fit.off_surface)) >= set(bad)
    assert fit.off_surface.sum() <= 26
    assert not clean.off_surface.any()
    x, y = disc_xy(50, 250.0).T
    heights, sure = surface_heights(fit, x, y), surface_heights(clean, x, y)
    assert (np.abs(heights.height_mm - sure.height_mm) / heights.sigma_mm).max() < 4
    flagged = flag_off_surface(cloud_of(spoilt), fit)
    assert ((flagged.quality & Quality.OFF_SURFACE) > 0).tolist() == fit.off_surface.tolist()


@pytest.mark.parametrize("kind", ["plane", "polynomial:2", "zernike:3", "paraboloid"])
def test_claimed_sigmas_of_heights_are_the_sampled_ones(kind: str) -> None:
    """With errors along a slanted line of sight, other for each point, as a camera makes them."""
    rng = np.random.default_rng(5)
    truth = dish(60) if kind != "plane" else dish(60) * [1, 1, 0] + dish(60)[:, :1] * [0, 0, 0.5]
    ray = truth - [30.0, 20.0, 600.0]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    sigma = rng.uniform(0.05, 0.2, 60)
    covariance = sigma[:, None, None] ** 2 * (ray[:, :, None] * ray[:, None, :]) + 1e-4 * np.eye(3)
    root = np.linalg.cholesky(covariance)
    x, y = disc_xy(12, 200.0).T
    found = []
    for _ in range(DRAWS):
        position = truth + np.einsum("nij,nj->ni", root, rng.normal(size=(60, 3)))
        fit = fit_surface(cloud_of(position, covariance), parse_basis(kind))
        heights = surface_heights(fit, x, y)
        found.append((heights.height_mm, heights.sigma_mm, fit.noise_factor))
    height, claimed, factor = (np.array(column) for column in zip(*found, strict=True))
    ratio = height.std(axis=0) / np.sqrt((claimed**2).mean(axis=0))
    assert ratio.mean() == pytest.approx(1.0, abs=SAMPLING)
    assert factor.mean() == pytest.approx(1.0, abs=0.1)
    expected = (x**2 + y**2) / 1200 if kind != "plane" else 0.5 * x
    np.testing.assert_allclose((height.mean(axis=0) - expected) / height.std(axis=0), 0, atol=0.45)


def test_calibration_covariance_is_that_of_sampled_cameras() -> None:
    rng = np.random.default_rng(6)
    position = dish(60)
    jacobian = np.stack([position * 1e-3, np.tile([0.0, 0.0, 1.0], (60, 1))], axis=-1)
    camera = np.array([[4.0, 0.3], [0.3, 0.05]])
    for kind in ("zernike:4", "paraboloid"):
        cloud = cloud_of(position, 1e-4, jacobian)
        fit = fit_surface(cloud, parse_basis(kind), camera_covariance=camera)
        shifts = rng.multivariate_normal([0, 0], camera, 40)
        fits = [fit_surface(replace(cloud, position_mm=position + jacobian @ shift), parse_basis(kind)) for shift in shifts]
        sampled = np.std([surface_heights(f, 100.0, 50.0).height_mm for f in fits])
        assert surface_heights(fit, 100.0, 50.0).sigma_mm == pytest.approx(sampled, rel=0.33)
        assert fit.calibration_covariance is not None


def test_unweighted_is_the_papers_algorithm() -> None:
    """Without covariances, every point counts alike; a scale from few points is itself uncertain, and says so."""
    rng = np.random.default_rng(7)
    false_alarms = 0
    for _ in range(100):
        xy = disc_xy(8, 100.0)
        fit = fit_surface(cloud_of(np.column_stack([xy, rng.normal(size=8)]), 1e-12), weighted=False)
        assert fit.noise_factor is None
        false_alarms += int(fit.off_surface.any())
    assert false_alarms <= 1


def test_extrapolation_is_marked() -> None:
    position = dish()
    position[:, 0] += 50.0
    fit = fit_surface(cloud_of(position), Basis("zernike", 4))
    x, y = np.meshgrid(np.linspace(-400, 400, 33), np.linspace(-400, 400, 33))
    heights = surface_heights(fit, x, y)
    rho = np.hypot(x - 50, y)
    assert heights.extrapolated[rho > 280].all()
    assert not heights.extrapolated[rho < 255].any()
    # the points themselves are not outside of their own outline
    assert not surface_heights(fit, position[:, 0], position[:, 1]).extrapolated.any()
    # and far outside the surface is far less sure than inside
    assert heights.sigma_mm[rho > 400].min() > 3 * heights.sigma_mm[rho < 200].max()


@pytest.mark.parametrize(
    ("basis", "count", "text"),
    [
        (Basis(), 3, "3 targets are too few for a plane, which has 3 coefficients: measure at least 4 targets"),
        (
            Basis("zernike", 8),
            30,
            "too few for a zernike surface of degree 8, which has 45 coefficients: use degree 6 or lower, or measure at least 46",
        ),
        (Basis("polynomial", 2), 6, "use degree 1 or lower, or measure at least 7 targets"),
        (Basis("paraboloid"), 6, "6 targets are too few for a paraboloid, which has 6 coefficients: measure at least 7 targets"),
        (Basis(), 0, "0 targets are too few for a plane"),
        (Basis("polynomial", 2), 0, "0 targets are too few for a polynomial surface of degree 2, which has 6 coefficients: measure"),
    ],
)
def test_too_few_targets(basis: Basis, count: int, text: str) -> None:
    with pytest.raises(FitError, match=text):
        fit_surface(select_points(cloud_of(dish()), np.arange(130) < count), basis)


def test_points_that_do_not_determine_the_surface() -> None:
    line = np.column_stack([np.arange(10.0), 2 * np.arange(10.0), np.zeros(10)])
    with pytest.raises(FitError, match="determine only 2 of 3 coefficients"):
        fit_surface(cloud_of(line))
    xy = disc_xy(40, 100.0)
    flat = np.column_stack([xy, 0.1 * np.random.default_rng(0).normal(size=40)])
    with pytest.raises(FitError, match=r"are they flat\?|no curvature for a paraboloid"):
        fit_surface(cloud_of(flat), Basis("paraboloid"))
    with pytest.raises(FitError, match="claim no error at all"):
        fit_surface(cloud_of(dish(), 0.0))


def test_wrong_cloud_and_missing_jacobian_are_refused() -> None:
    cloud = cloud_of(dish())
    fit = fit_surface(cloud, Basis("zernike", 2))
    with pytest.raises(InputError, match="fitted to other points"):
        flag_off_surface(select_points(cloud, np.arange(129)), fit)
    with pytest.raises(InputError, match="carry no Jacobian"):
        fit_surface(cloud, camera_covariance=np.eye(2))


@pytest.mark.parametrize(
    ("text", "basis"),
    [
        ("plane", Basis("plane")),
        ("polynomial:3", Basis("polynomial", 3)),
        ("Zernike:6", Basis("zernike", 6)),
        ("zernike", Basis("zernike", 4)),
        ("paraboloid", Basis("paraboloid")),
    ],
)
def test_basis_from_a_text(text: str, basis: Basis) -> None:
    assert parse_basis(text) == basis


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("zernik:4", "unknown surface 'zernik'; the nearest is 'zernike'"),
        ("plane:2", "a plane takes no degree"),
        ("zernike:x", "must be a whole number, as in zernike:4"),
        ("zernike:-1", "must be a whole number"),
        ("polynomial:99", "the degree of a polynomial surface lies between 0 and 60, not 99"),
    ],
)
def test_basis_that_is_none(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_basis(text)
