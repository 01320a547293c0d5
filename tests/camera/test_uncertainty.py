"""The map of expected projection error: against sampled cameras, and against cases that can be worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.camera.uncertainty import direction_jacobian, projection_error
from dishmap.errors import CameraError
from dishmap.transforms import rotation_from_vector

Array = NDArray[np.float64]

LENS = Camera(2304, 1728, np.array([1674.3, 1676.2]), np.array([1158.83, 858.37]), np.array([-0.215, 0.072, 0.0006, -0.0004, -0.009]))
SIGMAS = np.array([1.5, 1.6, 0.8, 0.7, 2e-3, 5e-3, 2e-4, 2e-4, 4e-3])
# relative; 4,000 samples give a sigma to 1.1 %, and the worst of 48 points to some 4 %
SAMPLED = 0.06


def uncertain() -> Camera:
    rng = np.random.default_rng(2)
    root = np.diag(SIGMAS) @ (np.eye(9) + 0.3 * rng.normal(size=(9, 9)))
    covariance = root @ root.T
    return replace(LENS, covariance=(covariance + covariance.T) / 2)


def cameras(camera: Camera, count: int) -> list[Camera]:
    assert camera.covariance is not None
    rng = np.random.default_rng(3)
    return [camera.with_parameters(p) for p in rng.multivariate_normal(camera.parameters, camera.covariance, count)]


def test_sigma_is_that_of_sampled_cameras() -> None:
    camera = uncertain()
    found = projection_error(camera, (6, 8))
    rays = camera.unproject(found.pixels)
    shifts = np.array([other.project(rays) - found.pixels for other in cameras(camera, 4000)])
    expected = np.sqrt((shifts**2).sum(axis=-1).mean(axis=0))
    assert np.abs(found.sigma_px / expected - 1).max() < SAMPLED
    by_axis = (shifts**2).mean(axis=0)
    assert np.abs(np.diagonal(found.covariance_px2, axis1=-2, axis2=-1) / by_axis - 1).max() < 2.5 * SAMPLED


def test_what_a_rotation_cannot_take_away_is_that_of_sampled_cameras() -> None:
    camera = uncertain()
    found = projection_error(camera, (6, 8), remove_rotation=True)
    rays = camera.unproject(found.pixels)
    left = []
    for other in cameras(camera, 500):
        target = other.project(rays) - found.pixels
        vector = np.zeros(3)
        for _ in range(3):  # Gauss-Newton on the rotation itself, by differences
            now = camera.project(rays @ rotation_from_vector(vector).T) - found.pixels
            step = 1e-6
            columns = [
                (camera.project(rays @ rotation_from_vector(vector + step * np.eye(3)[k]).T) - found.pixels - now) / step for k in range(3)
            ]
            design = np.stack([c.ravel() for c in columns], axis=1)
            vector = vector + np.linalg.lstsq(design, (target - now).ravel(), rcond=None)[0]
        left.append(target - (camera.project(rays @ rotation_from_vector(vector).T) - found.pixels))
    expected = np.sqrt((np.array(left) ** 2).sum(axis=-1).mean(axis=0))
    assert np.abs(found.sigma_px / expected - 1).max() < 2.5 * SAMPLED
    assert found.rms_px < projection_error(camera, (6, 8)).rms_px


def test_an_uncertain_principal_point_moves_everything_alike() -> None:
    camera = Camera(640, 480, np.array([500.0, 500.0]), np.array([319.5, 239.5]), covariance=np.diag([0.0, 0.0, 0.3**2, 0.4**2]))
    found = projection_error(camera)
    assert found.sigma_px.shape == (24, 32)
    assert found.sigma_px == pytest.approx(np.full((24, 32), 0.5))
    # a turn of the camera does nearly the same to the picture, more nearly the longer the lens
    long = replace(camera, focal_px=np.array([20000.0, 20000.0]))
    assert projection_error(camera, remove_rotation=True).rms_px < 0.1
    assert projection_error(long, remove_rotation=True).rms_px < 1e-3


def test_an_uncertain_focal_length_grows_from_the_middle() -> None:
    camera = Camera(640, 480, np.array([500.0, 500.0]), np.array([319.5, 239.5]), covariance=np.diag([1.0, 1.0, 0.0, 0.0]))
    camera = replace(camera, covariance=np.array([[1.0, 1, 0, 0], [1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]))
    found = projection_error(camera, (25, 33))
    radius = np.linalg.norm(found.pixels - camera.principal_px, axis=-1)
    assert found.sigma_px == pytest.approx(radius / 500)
    assert found.sigma_px[12, 16] == pytest.approx(0, abs=1e-12)
    # no rotation looks like a zoom
    assert projection_error(camera, (25, 33), remove_rotation=True).sigma_px == pytest.approx(radius / 500, abs=1e-9)


def test_grid_reaches_from_edge_to_edge() -> None:
    pixels = projection_error(uncertain(), (3, 5)).pixels
    assert pixels.shape == (3, 5, 2)
    assert pixels[0, 0].tolist() == [-0.5, -0.5]
    assert pixels[-1, -1].tolist() == [2303.5, 1727.5]


def test_beyond_the_lens_it_is_nan_and_the_rest_is_not() -> None:
    folding = Camera(
        2000, 2000, np.array([1000.0, 1000.0]), np.array([999.5, 999.5]), np.array([-0.3, 0.0, 0.0, 0.0]), covariance=np.eye(8) * 1e-6
    )
    for remove in (False, True):
        found = projection_error(folding, (9, 9), remove_rotation=remove)
        assert np.isnan(found.sigma_px[0, 0])
        assert np.isfinite(found.sigma_px[4, 4])
        assert np.isfinite(found.rms_px)


def test_direction_jacobian_is_that_of_the_projection() -> None:
    pixels = np.array([[100.0, 200.0], [2000.0, 1500.0]])
    jacobian = direction_jacobian(LENS, pixels)
    step = np.array([0.0, 0, 0, 0, 1e-6, 0, 0, 0, 0])
    moved = LENS.with_parameters(LENS.parameters + step).project(LENS.unproject(pixels))
    assert jacobian[..., 4] == pytest.approx((moved - pixels) / 1e-6, rel=1e-4)


def test_a_camera_without_covariance_is_refused() -> None:
    with pytest.raises(CameraError, match="this camera carries no covariance; calibrate it with"):
        projection_error(LENS)
    with pytest.raises(CameraError, match="needs at least 2x2 points, not 1x5"):
        projection_error(uncertain(), (1, 5))
