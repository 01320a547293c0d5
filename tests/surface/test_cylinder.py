"""The cylinder's geometry against points of known distance, its derivatives against differences, and fits of it against sampling."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dishmap.errors import FitError
from dishmap.surface.cloud import PointCloud, transform_cloud
from dishmap.surface.cylinder import Generator, distances, height_along_z, start_generator
from dishmap.surface.fit import Basis, fit_surface, surface_heights
from dishmap.transforms import Pose, rotation_from_vector

Array = NDArray[np.float64]

DIFFERENCE = 1e-6
STEPS = np.array([1e-3, 1e-6, 1e-6, 1e-6, 1e-8])
# 80 draws estimate a standard deviation to 8 %; three times that
DRAWS, SAMPLING = 80, 0.25

turns = st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-2, 2))
leans = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
# hollow ones too, from a rod to a sheet that hardly bends
radii = st.floats(40, 1e5) | st.floats(-1e5, -40)


def somewhere(turn: tuple[float, ...], lean: tuple[float, ...], radius: float) -> tuple[Generator, Array]:
    return Generator(np.array([10.0, -20.0, 700.0]), rotation_from_vector(np.array(turn))), np.array([2.0, *lean, 1 / radius])


def around(angle: Array, along: Array, off: Array, radius: float) -> tuple[Array, Array]:
    """Points at distances `off` (N,) from a cylinder along y that touches z = 0 at x = 0, and its normals (N, 3)."""
    normal = np.column_stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)])
    return (radius + off)[:, None] * normal + np.column_stack([0 * along, along, 0 * along - radius]), normal


@given(turns, leans, radii)
def test_distance_is_that_with_which_points_were_made(turn: tuple[float, ...], lean: tuple[float, ...], radius: float) -> None:
    generator, parameters = somewhere(turn, lean, radius)
    off = np.linspace(-20, 20, 9)
    angle = np.linspace(-1, 1, 9) * min(1.4, 100 / abs(radius))
    points, normal = around(angle, 50 * np.cos(7 * off), off, radius)
    rotation = generator.rotation @ rotation_from_vector(parameters[1:4])
    placed = points @ rotation.T + generator.origin_mm + 2.0 * generator.rotation[:, 2]
    found, _, found_normal = distances(placed, generator, parameters)
    np.testing.assert_allclose(found, off, atol=1e-8)
    np.testing.assert_allclose(found_normal, normal @ rotation.T, atol=1e-9)


@given(turns, leans, radii)
def test_derivatives_of_distances_and_numbers(turn: tuple[float, ...], lean: tuple[float, ...], radius: float) -> None:
    generator, parameters = somewhere(turn, lean, radius)
    points = np.random.default_rng(0).uniform(-30, 30, (8, 3)) + generator.origin_mm
    _, by, normal = distances(points, generator, parameters)
    for k, step in enumerate(STEPS):
        moved = [parameters + sign * step * np.eye(5)[k] for sign in (1, -1)]
        slope = (distances(points, generator, moved[0])[0] - distances(points, generator, moved[1])[0]) / (2 * step)
        np.testing.assert_allclose(by[:, k], slope, rtol=1e-5, atol=1e-5 * max(1.0, np.abs(by[:, k]).max()))
    along = [distances(points + sign * DIFFERENCE * np.eye(3)[0], generator, parameters)[0] for sign in (1, -1)]
    np.testing.assert_allclose((along[0] - along[1]) / (2 * DIFFERENCE), normal[:, 0], atol=1e-6)
    spread = generator.spread(parameters)
    for k, step in enumerate([1e-3, 1e-6, 1e-6, 1e-6, 1e-6 / abs(radius)]):
        ahead, behind = (generator.point_axis_radius(parameters + sign * step * np.eye(5)[k]) for sign in (1, -1))
        np.testing.assert_allclose(spread[:, k], (ahead - behind) / (2 * step), rtol=1e-4, atol=1e-5 * np.abs(spread[:, k]).max())


@given(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.sampled_from([57.0, -57.0, 400.0]))
def test_heights_lie_on_the_cylinder(tip: float, turn: float, radius: float) -> None:
    generator = Generator(np.array([1.0, 2.0, 30.0]), rotation_from_vector(np.array([tip, 0.0, turn])))
    seven = generator.point_axis_radius(np.array([0.0, 0, 0, 0, 1 / radius]))
    xy = np.array([[5.0, -3.0], [-12.0, 8.0]])
    z, by = height_along_z(xy, seven)
    found, _, normal = distances(np.column_stack([xy, z]), generator, np.array([0.0, 0, 0, 0, 1 / radius]))
    np.testing.assert_allclose(found, 0, atol=1e-9)
    # of the two heights the one whose normal shows up
    assert (normal[:, 2] > 0).all()
    for k in range(7):
        step = 1e-5 * np.eye(7)[k]
        slope = (height_along_z(xy, seven + step)[0] - height_along_z(xy, seven - step)[0]) / 2e-5
        # off the unit axis the formula is free, so only what keeps it one is compared
        if k not in (3, 4, 5):
            np.testing.assert_allclose(by[:, k], slope, rtol=1e-5, atol=1e-7)
    turned = generator.spread(np.array([0.0, 0, 0, 0, 1 / radius]))[:, 1:4]
    for k in range(3):
        parameters = np.array([0.0, *(1e-6 * np.eye(3)[k]), 1 / radius])
        slope = (height_along_z(xy, generator.point_axis_radius(parameters))[0] - z) / 1e-6
        np.testing.assert_allclose(by @ turned[:, k], slope, rtol=1e-3, atol=1e-3)
    assert np.isnan(height_along_z(np.array([[1000.0, 1000.0]]), seven)[0]).all()


def cloud_of(position: Array, covariance: Array | float = 0.01, jacobian: Array | None = None) -> PointCloud:
    n = len(position)
    covariance = np.broadcast_to(covariance * np.eye(3) if np.isscalar(covariance) else covariance, (n, 3, 3))
    up = np.tile([0.0, 0.0, 1.0], (n, 1))
    small = np.tile(np.eye(2) * 1e-4, (n, 1, 1))
    return PointCloud(
        np.arange(n), position, up, position[:, :2], covariance, np.full(n, 0.01), small, jacobian, np.zeros(n, dtype=int), "dish"
    )


def tube(radius: float = 57.0, reach_rad: float = 1.1, columns: int = 12, rows: int = 15) -> Array:
    """Squares printed on the front of a cylinder along y."""
    angle, along = (g.ravel() for g in np.meshgrid(np.linspace(-reach_rad, reach_rad, columns), np.linspace(-100, 100, rows)))
    return around(angle, along, np.zeros(angle.size), radius)[0]


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.3, -0.4, 1.0), (0.0, 0.5, -1.4)])
@pytest.mark.parametrize("radius", [57.0, -57.0, 900.0])
def test_cylinder_is_exact_without_noise(turn: tuple[float, ...], radius: float) -> None:
    pose = Pose.from_rotation_vector(turn, [10.0, -5.0, 700.0])
    fit = fit_surface(transform_cloud(cloud_of(tube(radius, min(1.1, 60 / abs(radius)))), pose, "dish"), Basis("cylinder"))
    found = dict(zip(fit.names, fit.coefficients, strict=True))
    assert found["radius"] == pytest.approx(radius, abs=1e-6 * abs(radius))
    axis = fit.coefficients[3:6]
    assert abs(axis @ pose.rotation[:, 1]) == pytest.approx(1.0, abs=1e-12)
    # the point lies on the true axis
    apart = fit.coefficients[:3] - pose.apply([0.0, 0.0, -radius])
    assert np.linalg.norm(apart - (apart @ axis) * axis) < 1e-5
    assert fit.rms_mm < 1e-8
    assert np.abs(surface_heights(fit, *pose.apply(tube(radius, 0.01)).T[:2]).height_mm - pose.apply(tube(radius, 0.01))[:, 2]).max() < 1e-6


def test_points_all_around_a_tube_and_along_z() -> None:
    whole = tube(30.0, np.pi * 0.98, 40, 6)
    for turn in ([0.0, 0.0, 0.0], [np.pi / 2, 0.0, 0.0]):
        fit = fit_surface(transform_cloud(cloud_of(whole), Pose.from_rotation_vector(turn, [0.0, 0.0, 0.0]), "dish"), Basis("cylinder"))
        assert fit.coefficients[6] == pytest.approx(30.0, abs=1e-6)


def test_claimed_sigmas_are_the_sampled_ones() -> None:
    """With errors along lines of sight, as a camera makes them; of the radius, the axis and heights."""
    rng = np.random.default_rng(3)
    truth = tube()
    ray = truth - [30.0, 20.0, 500.0]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    sigma = rng.uniform(0.05, 0.2, len(truth))
    covariance = sigma[:, None, None] ** 2 * (ray[:, :, None] * ray[:, None, :]) + 1e-4 * np.eye(3)
    root = np.linalg.cholesky(covariance)
    found, claimed, factor = [], [], []
    for _ in range(DRAWS):
        position = truth + np.einsum("nij,nj->ni", root, rng.normal(size=truth.shape))
        fit = fit_surface(cloud_of(position, covariance), Basis("cylinder"))
        heights = surface_heights(fit, [0.0, 30.0, -40.0], [0.0, 50.0, -50.0])
        found.append(np.concatenate([fit.coefficients[[3, 5, 6]], heights.height_mm]))
        claimed.append(np.concatenate([np.diag(fit.covariance)[[3, 5, 6]], heights.sigma_mm**2]))
        factor.append(fit.noise_factor)
    np.testing.assert_allclose(np.std(found, axis=0) / np.sqrt(np.mean(claimed, axis=0)), 1.0, atol=SAMPLING)
    assert np.mean(factor) == pytest.approx(1.0, abs=0.1)
    sure = np.std(found, axis=0) / np.sqrt(DRAWS)
    assert abs(np.mean(found, axis=0)[2] - 57.0) < 4 * sure[2]


def test_calibration_part_is_that_of_moved_cameras() -> None:
    truth = tube()
    jacobian = np.stack([truth * 1e-3, np.tile([0.0, 0.0, 1.0], (len(truth), 1))], axis=-1)
    fit = fit_surface(cloud_of(truth, 1e-4, jacobian), Basis("cylinder"), camera_covariance=np.diag([4.0, 0.0]))
    moved = fit_surface(cloud_of(truth + jacobian @ [2.0, 0.0], 1e-4), Basis("cylinder"))
    assert fit.calibration_covariance is not None
    # a scene that is larger by 0.2 % makes the radius so
    assert np.sqrt(fit.calibration_covariance[6, 6]) == pytest.approx(abs(moved.coefficients[6] - 57.0), rel=0.02)


def test_outliers_are_found_and_do_not_matter() -> None:
    rng = np.random.default_rng(4)
    truth = tube()
    position = truth + 0.05 * rng.normal(size=truth.shape)
    bad = rng.permutation(len(truth))[: len(truth) // 5]
    spoilt = position.copy()
    spoilt[bad, 2] += rng.uniform(3.0, 60.0, len(bad))
    clean, fit = (fit_surface(cloud_of(p, 0.05**2), Basis("cylinder")) for p in (position, spoilt))
    # at the sides a shift along z hardly leaves the surface
    told = np.abs(distances(spoilt, *start_generator(truth))[0]) > 0.5
    assert told[bad].all()
    assert set(np.flatnonzero(fit.off_surface)) >= set(np.flatnonzero(told))
    assert fit.off_surface.sum() <= told.sum() + 2
    assert abs(fit.coefficients[6] - clean.coefficients[6]) < 4 * np.sqrt(fit.covariance[6, 6])


def test_what_shows_no_curvature_is_refused() -> None:
    rng = np.random.default_rng(5)
    flat = np.column_stack([rng.uniform(-100, 100, (60, 2)), 0.1 * rng.normal(size=60)])
    with pytest.raises(FitError, match=r"are they flat\?|no curvature for a cylinder"):
        fit_surface(cloud_of(flat), Basis("cylinder"))
    with pytest.raises(FitError, match=r"lie in a plane|are they flat"):
        fit_surface(cloud_of(flat * [1, 1, 0]), Basis("cylinder"))
    with pytest.raises(FitError, match="5 targets are too few for a cylinder, which has 5 coefficients: measure at least 6"):
        fit_surface(cloud_of(flat[:5]), Basis("cylinder"))
