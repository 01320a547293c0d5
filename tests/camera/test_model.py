"""The camera model against cv2, its Jacobians against differences, and the way back against the way there."""

from __future__ import annotations

import warnings
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.errors import CameraError

Array = NDArray[np.float64]

# px; both sides are double precision with pixel numbers of some thousands
SAME_PROJECTION_PX = 1e-9
# relative; central differences with a step of 1e-6 leave about 1e-9 of rounding and curvature
SAME_DERIVATIVE = 1e-6
# px; unproject promises 1e-9 px, and the projection back adds rounding
ROUND_TRIP_PX = 1e-8

DISTORTIONS = {
    "pinhole": ("opencv", []),
    "opencv4": ("opencv", [-0.22, 0.08, 0.001, -0.0007]),
    "opencv5": ("opencv", [-0.22, 0.08, 0.001, -0.0007, -0.012]),
    "opencv8": ("opencv", [0.4, 0.05, 0.001, -0.0007, 0.003, 0.7, 0.12, 0.01]),
    "opencv12": ("opencv", [0.4, 0.05, 0.001, -0.0007, 0.003, 0.7, 0.12, 0.01, 0.002, -0.001, 0.0015, 0.0005]),
    "fisheye": ("fisheye", [0.03, -0.012, 0.004, -0.001]),
}


def camera_of(name: str) -> Camera:
    model, distortion = DISTORTIONS[name]
    return Camera(1920, 1080, np.array([1100.0, 1105.0]), np.array([955.0, 545.0]), np.array(distortion), model)


def points_before(camera: Camera, count: int = 200, half_angle_tan: float = 0.9) -> Array:
    rng = np.random.default_rng(5)
    xy = rng.uniform(-half_angle_tan, half_angle_tan, (count, 2))
    depth = rng.uniform(200.0, 3000.0, (count, 1))
    return np.concatenate([xy, np.ones((count, 1))], axis=1) * depth


def projected_by_cv2(camera: Camera, points: Array, distortion: Array | None = None) -> Array:
    k = camera.distortion if distortion is None else distortion
    function: Any = cv2.fisheye.projectPoints if camera.model == "fisheye" else cv2.projectPoints
    if camera.model == "fisheye":
        return np.asarray(function(points[:, None], np.zeros(3), np.zeros(3), camera.matrix, k)[0]).reshape(-1, 2)
    return np.asarray(function(points, np.zeros(3), np.zeros(3), camera.matrix, k)[0]).reshape(-1, 2)


@pytest.mark.parametrize("name", DISTORTIONS)
def test_projects_as_cv2_does(name: str) -> None:
    camera, points = camera_of(name), points_before(camera_of(name))
    assert np.abs(camera.project(points) - projected_by_cv2(camera, points)).max() < SAME_PROJECTION_PX


@pytest.mark.parametrize("name", [name for name, (_, k) in DISTORTIONS.items() if k])
def test_the_comparison_with_cv2_sees_each_coefficient(name: str) -> None:
    camera, points = camera_of(name), points_before(camera_of(name))
    for k in range(camera.distortion.size):
        other = camera.distortion.copy()
        other[k] += 1e-6
        assert np.abs(camera.project(points) - projected_by_cv2(camera, points, other)).max() > 100 * SAME_PROJECTION_PX


def test_fisheye_sees_what_lies_beside_and_behind_it() -> None:
    camera = Camera(1000, 1000, np.array([320.0, 320.0]), np.array([500.0, 500.0]), np.array([0.03, -0.01, 0.002, -0.0002]), "fisheye")
    angle = np.radians(95.0)
    pixel = camera.project([np.sin(angle) * 100, 0.0, np.cos(angle) * 100])
    k1, k2, k3, k4 = camera.distortion
    # the documented polynomial, written out
    expected = 320.0 * (angle + k1 * angle**3 + k2 * angle**5 + k3 * angle**7 + k4 * angle**9)
    assert pixel == pytest.approx([500.0 + expected, 500.0], abs=SAME_PROJECTION_PX)


@pytest.mark.parametrize("name", DISTORTIONS)
def test_jacobians_against_differences(name: str) -> None:
    camera, points = camera_of(name), points_before(camera_of(name), 40)
    pixels, by_point, by_parameter = camera.project_with_jacobians(points)
    assert (pixels == camera.project(points)).all()
    for axis in range(3):
        step = 1e-6 * points[:, 2:3] * np.eye(3)[axis]
        slope = (camera.project(points + step) - camera.project(points - step)) / (2e-6 * points[:, 2:3])
        assert np.abs(by_point[..., axis] - slope).max() < SAME_DERIVATIVE * np.abs(by_point).max()
    for k, value in enumerate(camera.parameters):
        step_size = 1e-6 * max(abs(value), 1.0)
        moved = [camera.with_parameters(camera.parameters + sign * step_size * np.eye(len(camera.parameters))[k]) for sign in (1, -1)]
        slope = (moved[0].project(points) - moved[1].project(points)) / (2 * step_size)
        assert np.abs(by_parameter[..., k] - slope).max() < SAME_DERIVATIVE * max(1.0, np.abs(by_parameter[..., k]).max())


def test_jacobian_of_the_fisheye_holds_on_the_axis() -> None:
    camera = camera_of("fisheye")
    point = np.array([0.0, 0.0, 500.0])
    _, by_point, by_parameter = camera.project_with_jacobians(point)
    assert by_point == pytest.approx(np.array([[1100.0 / 500, 0, 0], [0, 1105.0 / 500, 0]]))
    assert np.isfinite(by_parameter).all()


@given(
    st.sampled_from(sorted(DISTORTIONS)),
    st.floats(-0.8, 0.8),
    st.floats(-0.8, 0.8),
    st.floats(10.0, 1e5),
)
def test_unproject_undoes_project(name: str, x: float, y: float, depth_mm: float) -> None:
    camera = camera_of(name)
    point = np.array([x, y, 1.0]) * depth_mm
    ray = camera.unproject(camera.project(point))
    assert np.linalg.norm(ray) == pytest.approx(1.0, abs=1e-12)
    assert np.abs(camera.project(ray) - camera.project(point)).max() < ROUND_TRIP_PX
    assert np.abs(ray - point / np.linalg.norm(point)).max() < ROUND_TRIP_PX / 500  # the least slope here is over 500 px per unit


@given(st.sampled_from(sorted(DISTORTIONS)), st.floats(-0.5, 1919.5), st.floats(-0.5, 1079.5))
def test_project_undoes_unproject(name: str, u: float, v: float) -> None:
    camera = camera_of(name)
    assert np.abs(camera.project(camera.unproject([u, v])) - [u, v]).max() < ROUND_TRIP_PX


def test_unproject_reaches_farther_than_cv2_does() -> None:
    # at the corner of a 116 degree lens cv2's fixed-point loop is still pixels off after its default steps; Newton's method is not
    camera = Camera(4608, 3456, np.array([2600.0, 2600.0]), np.array([2303.5, 1727.5]), np.array([-0.24, 0.06, 0.0004, -0.0003, -0.006]))
    corner = np.array([[30.0, 30.0]])
    theirs = np.asarray(cv2.undistortPoints(corner[:, None], camera.matrix, camera.distortion)).reshape(-1, 2)
    back = camera.project(np.append(theirs[0], 1.0))
    assert np.abs(back - corner).max() > 1.0
    assert np.abs(camera.project(camera.unproject(corner)) - corner).max() < ROUND_TRIP_PX


def test_nan_beyond_the_fold_of_the_lens() -> None:
    # r (1 - 0.3 r^2) turns back at r = sqrt(1 / 0.9) = 1.054
    camera = Camera(2000, 2000, np.array([1000.0, 1000.0]), np.array([999.5, 999.5]), np.array([-0.3, 0.0, 0.0, 0.0]))
    assert camera.widest == pytest.approx(np.sqrt(1 / 0.9), rel=3e-3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        inside, outside, behind, beside = camera.project([[1.04, 0, 1], [1.06, 0, 1], [0.1, 0, -1], [1, 0, 0]])
    assert np.isfinite(inside).all()
    assert np.isnan([outside, behind, beside]).all()
    # the fold's own radius is the largest that has a ray: 1.054 * 2 / 3
    assert np.isfinite(camera.unproject([999.5 + 700.0, 999.5])).all()
    assert np.isnan(camera.unproject([999.5 + 704.0, 999.5])).all()
    assert np.isnan(camera.project_with_jacobians([1.06, 0, 1])[0]).all()


def test_a_point_outside_the_picture_still_has_a_pixel() -> None:
    camera = camera_of("pinhole")
    assert camera.project([0.9, 0.9, 1.0])[0] > camera.width_px


def test_contains_uses_the_outer_edges_of_pixels() -> None:
    camera = camera_of("pinhole")
    assert camera.contains([[-0.5, -0.5], [1919.5, 1079.5], [-0.6, 3], [3, 1079.6], [np.nan, 3]]).tolist() == [
        True,
        True,
        False,
        False,
        False,
    ]
    assert camera.contains([[1.0, 5.0], [0.5, 5.0]], margin_px=1.5).tolist() == [True, False]


def test_shapes_of_any_rank() -> None:
    camera = camera_of("opencv8")
    points = points_before(camera, 24).reshape(2, 3, 4, 3)
    assert camera.project(points).shape == (2, 3, 4, 2)
    assert camera.unproject(camera.project(points)).shape == (2, 3, 4, 3)
    assert camera.project_with_jacobians(points)[2].shape == (2, 3, 4, 2, 12)


def test_parameters_and_names_belong_together() -> None:
    camera = camera_of("opencv5")
    assert camera.parameter_names == ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    assert (camera.with_parameters(camera.parameters).parameters == camera.parameters).all()
    assert camera_of("fisheye").parameter_names == ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width_px": 0}, "image size must be positive, not 0x1080"),
        ({"focal_px": np.array([1100.0, -1.0])}, "focal length must be positive"),
        ({"focal_px": np.array([1100.0, np.nan])}, "focal_px needs 2 finite numbers"),
        ({"principal_px": np.array([1.0])}, "principal_px needs 2 finite numbers"),
        ({"distortion": np.zeros(3)}, "takes 0 or 4 or 5 or 8 or 12 coefficients, not 3"),
        ({"distortion": np.array([0.1, np.inf, 0, 0])}, "distortion coefficients must be finite"),
        ({"model": "fisheye", "distortion": np.zeros(5)}, "fisheye lens model takes 4 coefficients, not 5"),
        ({"model": "omni"}, "unknown lens model 'omni'; use one of opencv, fisheye"),
        ({"covariance": np.eye(3)}, "covariance must be 4x4 finite numbers"),
        ({"covariance": np.full((4, 4), np.nan)}, "covariance must be 4x4 finite numbers"),
    ],
)
def test_impossible_cameras_are_refused(change: dict[str, Any], message: str) -> None:
    good: dict[str, Any] = {
        "width_px": 1920,
        "height_px": 1080,
        "focal_px": np.array([1100.0, 1105.0]),
        "principal_px": np.array([955.0, 545.0]),
    }
    Camera(**good)
    with pytest.raises(CameraError, match=message):
        Camera(**(good | change))
