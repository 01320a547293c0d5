"""Undistortion against cv2, and a straight line that becomes straight."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.camera.undistort import check_size, pinhole_camera, undistort_image, undistort_points
from dishmap.errors import CameraError, ImageError

# px; cv2's own inverse is run to this
SAME_POINT_PX = 1e-6
# grey levels of 255; 1/32 px of rounded position and another kernel, on a picture blurred by 3 px
SAME_PICTURE = 3
# px and grey levels of 255; spots of 1.5 px (sigma) in a picture resampled at positions rounded to 1/32 px
CENTROID_PX, SPOT_LEVELS = 0.02, 3.0
SPOT_PX = 1.5

LENS = np.array([-0.22, 0.06, 0.001, -0.0007, -0.005])
CAMERA = Camera(640, 480, np.array([520.0, 523.0]), np.array([322.0, 237.0]), LENS)
FISHEYE = Camera(640, 480, np.array([300.0, 300.0]), np.array([322.0, 237.0]), np.array([0.02, -0.01, 0.002, -0.0005]), "fisheye")


DIRECTIONS = np.array([[x, y, 1.0] for x in (-0.42, -0.1, 0.4) for y in (-0.3, 0.05, 0.3)])


def spots(camera: Camera, columns: Any, rows: Any) -> NDArray[np.float64]:
    """Gaussian spots at the projections of DIRECTIONS, at any positions of the camera's picture."""
    picture = np.full(np.shape(rows), 20.0)
    for u, v in camera.project(DIRECTIONS):
        picture += 200 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * SPOT_PX**2))
    return picture


def photograph(camera: Camera, dtype: Any = np.uint8) -> NDArray[Any]:
    rows, columns = np.mgrid[: camera.height_px, : camera.width_px]
    picture = spots(camera, columns, rows) * (257 if dtype == np.uint16 else 1)
    return picture.astype(dtype) if dtype == np.float32 else np.rint(picture).astype(dtype)


def centroid(picture: NDArray[Any], near: NDArray[np.float64]) -> NDArray[np.float64]:
    column, row = np.rint(near).astype(int)
    window = picture[row - 7 : row + 8, column - 7 : column + 8].astype(float)
    window -= np.median(window[:2])
    offset = np.arange(-7, 8)
    return np.array([column + (window.sum(0) @ offset) / window.sum(), row + (window.sum(1) @ offset) / window.sum()])


def test_points_as_cv2() -> None:
    pixels = np.random.default_rng(0).uniform([0, 0], [639, 479], (200, 2))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 500, 1e-12)
    theirs = cv2.undistortPoints(pixels[:, None], CAMERA.matrix, LENS, None, None, CAMERA.matrix, criteria)
    assert np.abs(undistort_points(CAMERA, pixels) - np.asarray(theirs).reshape(-1, 2)).max() < SAME_POINT_PX


def test_fisheye_points_as_cv2() -> None:
    pixels = np.random.default_rng(0).uniform([60, 40], [580, 440], (200, 2))
    theirs = cv2.fisheye.undistortPoints(pixels[:, None], FISHEYE.matrix, FISHEYE.distortion, None, None, FISHEYE.matrix)
    assert np.abs(undistort_points(FISHEYE, pixels) - np.asarray(theirs).reshape(-1, 2)).max() < 1e-3  # cv2 stops at 1e-8 rad


def test_a_line_becomes_straight() -> None:
    line = np.stack([np.linspace(-0.5, 0.5, 50), np.linspace(0.2, 0.35, 50), np.ones(50)], axis=1)
    seen = CAMERA.project(line)
    straight = undistort_points(CAMERA, seen)

    def bend(points: NDArray[np.float64]) -> float:
        return float(np.linalg.svd(points - points.mean(axis=0))[1][1])

    assert bend(seen) > 3
    assert bend(straight) < 1e-6


def test_points_without_a_ray_are_nan() -> None:
    folding = Camera(2000, 2000, np.array([1000.0, 1000.0]), np.array([999.5, 999.5]), np.array([-0.3, 0.0, 0.0, 0.0]))
    assert np.isnan(undistort_points(folding, [[0.0, 0.0]])).all()
    # more than 90 degrees off the axis there is a ray but no pinhole
    wide = Camera(1000, 1000, np.array([250.0, 250.0]), np.array([499.5, 499.5]), np.zeros(4), "fisheye")
    assert np.isnan(undistort_points(wide, [[0.0, 499.5]])).all()


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["opencv", "fisheye"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_the_new_picture_shows_what_the_new_camera_sees(camera: Camera, dtype: Any) -> None:
    picture, new = undistort_image(camera, photograph(camera, dtype))
    assert picture.dtype == dtype
    assert not new.distortion.any()
    # cv2 says where each new pixel comes from; what was there is known in closed form
    map_of: Any = cv2.fisheye.initUndistortRectifyMap if camera.model == "fisheye" else cv2.initUndistortRectifyMap
    columns, rows = map_of(camera.matrix, camera.distortion, np.eye(3), new.matrix, (640, 480), cv2.CV_32FC1)
    expected = spots(camera, columns, rows)
    got = picture / (257 if dtype == np.uint16 else 1)
    assert np.abs(got - expected).max() < SPOT_LEVELS
    for near in new.project(DIRECTIONS):
        assert np.abs(centroid(got, near) - centroid(expected, near)).max() < CENTROID_PX
    # the test can fail: in the photograph itself the spots are pixels away
    assert np.abs(camera.project(DIRECTIONS) - new.project(DIRECTIONS)).max() > 3


def test_picture_as_cv2() -> None:
    photo = cv2.GaussianBlur(np.random.default_rng(2).integers(0, 255, (480, 640)).astype(np.uint8), (0, 0), 3)
    photo = cv2.normalize(photo, None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]
    theirs = cv2.undistort(photo, CAMERA.matrix, LENS)
    ours, new = undistort_image(CAMERA, photo)
    assert np.abs(ours.astype(int) - theirs)[5:-5, 5:-5].max() <= SAME_PICTURE
    assert (new.matrix == CAMERA.matrix).all()


def test_zoom_brings_the_corners_in() -> None:
    whole = pinhole_camera(CAMERA, 0.7)
    white = np.full((480, 640), 255, np.uint8)
    assert (undistort_image(CAMERA, white)[0] == 255).all()
    zoomed, camera = undistort_image(CAMERA, white, whole)
    assert camera is whole
    assert zoomed[0, 0] == 0
    assert whole.contains(undistort_points(CAMERA, [[0, 0], [639, 0], [0, 479], [639, 479]], whole)).all()
    assert not pinhole_camera(CAMERA).contains(undistort_points(CAMERA, [[0, 0]])).any()


def test_the_new_picture_may_have_another_size_and_colour_stays() -> None:
    colour = np.dstack([photograph(CAMERA)] * 3)
    colour[..., 1] = 7
    small = Camera(200, 150, np.array([160.0, 160.0]), np.array([99.5, 74.5]))
    picture, _ = undistort_image(CAMERA, colour, small)
    assert picture.shape == (150, 200, 3)
    assert (picture[10:-10, 10:-10, 1] == 7).all()


def test_no_lens_changes_nothing() -> None:
    photo = np.random.default_rng(3).integers(0, 255, (480, 640)).astype(np.uint8)
    assert (undistort_image(pinhole_camera(CAMERA), photo)[0] == photo).all()


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((600, 800), "the photograph has 800x600 px but the camera 640x480: use the camera file"),
        ((640, 480), "turned by a quarter"),
        ((480,), "0x0 px"),
    ],
)
def test_a_photograph_of_another_size_is_refused(shape: tuple[int, ...], message: str) -> None:
    with pytest.raises(CameraError, match=message):
        undistort_image(CAMERA, np.zeros(shape, np.uint8))
    with pytest.raises(CameraError, match=message):
        check_size(CAMERA, np.zeros(shape, np.uint8))


def test_other_types_are_refused() -> None:
    with pytest.raises(ImageError, match="must be 8-bit, 16-bit or float32"):
        undistort_image(CAMERA, np.zeros((480, 640), np.int64))
    long = Camera(40_000, 20, np.array([9000.0, 9000.0]), np.array([19999.5, 9.5]))
    with pytest.raises(ImageError, match="pictures up to 32766 px on a side"):
        undistort_image(long, np.zeros((20, 40_000), np.uint8))


@pytest.mark.parametrize("zoom", [0.0, -1.0, np.nan, np.inf])
def test_a_zoom_must_be_positive(zoom: float) -> None:
    with pytest.raises(CameraError, match="zoom must be a positive number"):
        pinhole_camera(CAMERA, zoom)
