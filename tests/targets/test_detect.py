from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.errors import ImageError
from dishmap.targets import detect
from dishmap.targets.detect import Detections, find_ellipses

Array = NDArray[np.float64]

# A raw-pixel fit follows; what the ellipses must reach is a part of a pixel.
CENTER_PX, AXIS_PX = 0.1, 0.25
# Half a pixel is what contours through pixel centres, or a wrong halving, would be off.
HALF_PIXEL = 0.5
FINE = 8
DARK, LIGHT = 30.0, 180.0


class Canvas:
    """A picture drawn by counting sub-pixels: an image independent of the project's own simulator."""

    def __init__(self, width: int, height: int, grey: float = LIGHT) -> None:
        self.image = np.full((height, width), grey)

    def ellipse(self, center: tuple[float, float], semi_axes: tuple[float, float], angle: float = 0.0, grey: float = DARK) -> None:
        reach = max(semi_axes) + 2
        u0, v0 = (int(max(0, np.floor(c - reach))) for c in center)
        u1 = int(min(self.image.shape[1], np.ceil(center[0] + reach)))
        v1 = int(min(self.image.shape[0], np.ceil(center[1] + reach)))
        sub = (np.arange(FINE) + 0.5) / FINE - 0.5
        u = (np.arange(u0, u1)[:, None] + sub).ravel() - center[0]
        v = (np.arange(v0, v1)[:, None] + sub).ravel() - center[1]
        c, s = np.cos(angle), np.sin(angle)
        along, across = (c * u + s * v[:, None]) / semi_axes[0], (-s * u + c * v[:, None]) / semi_axes[1]
        inside = (along**2 + across**2 <= 1).reshape(v1 - v0, FINE, u1 - u0, FINE).mean(axis=(1, 3))
        patch = self.image[v0:v1, u0:u1]
        patch += inside * (grey - patch)

    def photograph(self, blur_px: float = 0.7, noise: float = 0.0, seed: int = 0) -> NDArray[np.uint8]:
        image = cv2.GaussianBlur(self.image, (0, 0), blur_px)
        image = image + np.random.default_rng(seed).normal(0, max(noise, 1e-9), image.shape)
        return np.clip(np.round(image), 0, 255).astype(np.uint8)


def nearest(found: Detections, center: tuple[float, float], dark: bool) -> int:
    index = np.flatnonzero(found.dark == dark)
    assert len(index), "nothing of that kind was found"
    return int(index[np.argmin(np.linalg.norm(found.center_px[index] - center, axis=1))])


def test_ellipse_is_measured_without_the_half_pixel_of_contours() -> None:
    canvas = Canvas(120, 100)
    canvas.ellipse((60.3, 47.8), (20.4, 12.7), 0.6)
    found = find_ellipses(canvas.photograph())
    assert len(found) == 1
    assert found.dark[0]
    assert found.center_px[0] == pytest.approx((60.3, 47.8), abs=CENTER_PX)
    assert found.semi_axes_px[0] == pytest.approx((20.4, 12.7), abs=AXIS_PX)
    assert found.angle_rad[0] == pytest.approx(0.6, abs=0.03)
    assert found.contrast[0] == pytest.approx(LIGHT - DARK, rel=0.1)
    assert found.residual_px[0] < CENTER_PX
    assert found.parent[0] == -1
    # the check above can fail: the contour of ink pixels itself is half a pixel inside
    assert AXIS_PX < HALF_PIXEL


def test_ring_is_a_dark_ellipse_with_a_light_one_inside() -> None:
    canvas = Canvas(100, 100)
    canvas.ellipse((50.2, 49.9), (15, 14))
    canvas.ellipse((50.2, 49.9), (9, 8.4), grey=LIGHT)
    found = find_ellipses(canvas.photograph())
    outer, inner = nearest(found, (50.2, 49.9), True), nearest(found, (50.2, 49.9), False)
    assert len(found) == 2
    assert found.parent[inner] == outer
    assert found.parent[outer] == -1
    assert found.semi_axes_px[inner] == pytest.approx((9, 8.4), abs=AXIS_PX)


@pytest.mark.parametrize("blur_px", [0.5, 2.0])
def test_one_search_finds_circles_of_any_size(blur_px: float) -> None:
    radii = [4.0, 6.0, 12.0, 30.0, 80.0, 200.0]
    canvas = Canvas(1000, 560)
    centers = [(30.4, 40.0), (80.1, 60.7), (140.0, 80.2), (230.7, 120.4), (400.0, 150.5), (750.3, 280.6)]
    for center, radius in zip(centers, radii, strict=True):
        canvas.ellipse(center, (radius, radius))
    found = find_ellipses(canvas.photograph(blur_px, noise=1.5))
    assert found.dark.sum() == len(radii)
    for center, radius in zip(centers, radii, strict=True):
        index = nearest(found, center, True)
        assert found.center_px[index] == pytest.approx(center, abs=CENTER_PX)
        # a disc under blur of half its size looks smaller at half its contrast
        assert found.semi_axes_px[index].mean() == pytest.approx(radius, abs=AXIS_PX + blur_px**2 / radius)


def test_smallest_circles_are_found_when_sharp() -> None:
    canvas = Canvas(200, 150)
    centers = [(20.0 + 25 * i + 0.13 * i, 20 + 22.0 * j - 0.21 * j) for i in range(7) for j in range(5)]
    for center in centers:
        canvas.ellipse(center, (3.0, 3.0))
    found = find_ellipses(canvas.photograph(0.6, noise=1.0))
    distance, _ = cKDTree(found.center_px).query(centers)
    assert len(found) == len(centers)
    assert distance.max() < 2 * CENTER_PX


def close_rings(radius: float, pitch: float) -> tuple[Canvas, list[tuple[float, float]]]:
    """Rings at a pitch of so many radii; that of a four-ring target is 2.8, and less where it is tilted."""
    canvas = Canvas(260, 220)
    centers = [(25.3 + pitch * radius * i, 24.6 + pitch * radius * j) for i in range(12) for j in range(10)]
    for center in centers:
        canvas.ellipse(center, (radius, radius))
        canvas.ellipse(center, (0.6 * radius, 0.6 * radius), grey=LIGHT)
    return canvas, centers


@pytest.mark.parametrize(("radius", "pitch", "noise"), [(5.0, 2.8, 0.0), (5.0, 2.8, 4.0), (6.0, 2.6, 0.0), (6.0, 2.6, 4.0)])
def test_rings_that_blur_runs_together_are_found_one_by_one(radius: float, pitch: float, noise: float) -> None:
    canvas, centers = close_rings(radius, pitch)
    found = find_ellipses(canvas.photograph(2.0, noise))
    distance, nearest_ring = cKDTree(centers).query(found.center_px[found.dark])
    assert sorted(nearest_ring) == list(range(len(centers)))
    # rings of the rim are drawn to the side that has no neighbour; noise moves a pale outline by a part of a pixel
    assert distance.max() < (0.8 if noise else 0.5)
    # the outline of a blurred ring lies outside, by half a blur or so
    assert np.abs(np.sqrt(found.semi_axes_px[found.dark].prod(axis=1)) - radius).max() < 1.3


def test_the_halfway_threshold_alone_runs_them_together() -> None:
    """The test above can fail: without the second threshold most of these rings are not found."""
    canvas, centers = close_rings(6.0, 2.6)
    found, _, clumps = detect._search(canvas.photograph(2.0), 1, 0.0)
    assert found.dark.sum() < 0.5 * len(centers)
    assert len(clumps)


def test_flat_ink_has_no_holes_by_noise() -> None:
    canvas = Canvas(700, 400)
    centers = [(60.0 + 95.3 * i, 60.0 + 90.6 * j) for i in range(7) for j in range(4)]
    for k, center in enumerate(centers):
        canvas.ellipse(center, (5.0 + k, 5.0 + k))
    found = find_ellipses(canvas.photograph(1.5, noise=4.0))
    assert found.dark.all()
    assert len(found) == len(centers)


def test_shading_of_ten_to_one_and_dark_surroundings_hide_nothing() -> None:
    canvas = Canvas(900, 600)
    centers = [(90.0 + 100 * i, 80.0 + 110 * j) for i in range(8) for j in range(5)]
    for center in centers:
        canvas.ellipse(center, (14, 11), 0.4)
    light = np.geomspace(0.12, 1.2, 900)
    canvas.image = canvas.image * light
    canvas.image[:55] = canvas.image[:, :62] = 3.0
    found = find_ellipses(canvas.photograph(0.8, noise=0.7))
    dark = found.center_px[found.dark]
    distance, _ = cKDTree(dark).query(centers)
    assert distance.max() < 2 * CENTER_PX
    assert len(dark) == len(centers)


def test_squares_triangles_and_noise_are_no_circles() -> None:
    image = np.full((300, 400), LIGHT)
    rng = np.random.default_rng(4)
    for k in range(12):
        size, turn, at = rng.uniform(8, 40), rng.uniform(0, 3), np.array([40 + 60 * (k % 6), 70 + 150 * (k // 6)])
        corners = 3 + k % 2
        t = turn + 2 * np.pi * np.arange(corners) / corners
        cv2.fillPoly(image, [np.round(at + size * np.stack([np.cos(t), np.sin(t)], axis=1)).astype(np.int32)], DARK)
    image = cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(0, 3, image.shape)
    assert len(find_ellipses(np.clip(image, 0, 255).astype(np.uint8))) == 0
    assert len(find_ellipses(np.clip(rng.normal(100, 10, (200, 300)), 0, 255).astype(np.uint8))) == 0


def test_circles_cut_by_the_border_are_left_out() -> None:
    canvas = Canvas(120, 90)
    canvas.ellipse((60, 45), (12, 12))
    canvas.ellipse((5, 45), (12, 12))
    canvas.ellipse((60, 86), (12, 12))
    found = find_ellipses(canvas.photograph())
    assert found.center_px.tolist() == [pytest.approx([60, 45], abs=CENTER_PX)]


def test_sixteen_bits_give_what_eight_give() -> None:
    canvas = Canvas(150, 100)
    canvas.ellipse((70.2, 50.9), (15, 11), 0.2)
    eight = find_ellipses(canvas.photograph(noise=1.0))
    fine = cv2.GaussianBlur(canvas.image, (0, 0), 0.7)
    sixteen = find_ellipses(np.round(fine * 257 / 8).astype(np.uint16))
    assert sixteen.center_px == pytest.approx(eight.center_px, abs=CENTER_PX)
    assert sixteen.contrast[0] == pytest.approx((LIGHT - DARK) * 257 / 8, rel=0.1)


@pytest.fixture(scope="module")
def large_image() -> tuple[NDArray[np.uint8], list[tuple[float, float]]]:
    canvas = Canvas(3200, 2400)
    centers = [(300.3 + 400 * i, 250.6 + 400 * j) for i in range(7) for j in range(5)]
    for center in centers:
        canvas.ellipse(center, (24, 19), 0.3)
        canvas.ellipse(center, (14, 11), 0.3, grey=LIGHT)
    return canvas.photograph(noise=2.0), centers


def test_half_resolution_keeps_full_resolution_coordinates(large_image: tuple[NDArray[np.uint8], list[tuple[float, float]]]) -> None:
    image, centers = large_image
    assert image.size > detect.HALVE_ABOVE_PX
    for full in (False, True):
        found = find_ellipses(image, full_resolution=full)
        dark = found.center_px[found.dark]
        distance, index = cKDTree(dark).query(centers)
        assert len(dark) == len(centers)
        # a halving that forgets the pixel's centre is half a pixel off in each direction
        assert np.abs((dark[index] - centers).mean(axis=0)).max() < CENTER_PX / 2
        assert distance.max() < 2 * CENTER_PX
        assert found.semi_axes_px[found.dark].mean(axis=0) == pytest.approx((24, 19), abs=AXIS_PX)


def test_large_image_of_small_circles_is_searched_in_full() -> None:
    canvas = Canvas(3200, 2400)
    centers = [(100.3 + 150 * i, 120.6 + 150 * j) for i in range(20) for j in range(14)]
    for center in centers:
        canvas.ellipse(center, (4.0, 3.2))
    found = find_ellipses(canvas.photograph(0.6, noise=1.0))
    distance, _ = cKDTree(found.center_px[found.dark]).query(centers)
    assert (distance < 2 * CENTER_PX).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (50, 1), (2, 2), (3, 3), (12, 12), (64, 64)])
def test_images_with_nothing_in_them_give_nothing(shape: tuple[int, int]) -> None:
    for grey in (0, 128, 255):
        found = find_ellipses(np.full(shape, grey, dtype=np.uint8))
        assert len(found) == 0
        assert found.center_px.shape == found.semi_axes_px.shape == (0, 2)


@pytest.mark.parametrize("image", [np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4)), np.zeros((0, 4), np.uint8)])
def test_other_arrays_are_refused(image: NDArray[np.uint8]) -> None:
    with pytest.raises(ImageError, match=r"grey image .* of uint8 or uint16, not in"):
        find_ellipses(image)


def test_every_circle_of_the_shared_dish_is_found(shared_data: Path) -> None:
    image = cv2.imread(str(shared_data / "dish" / "ref.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    found = find_ellipses(image)
    # 130 targets of four rings; the rim is one more light ellipse around them
    rings = found.semi_axes_px[:, 0] < 40
    assert (found.dark & rings).sum() == (~found.dark & rings).sum() == 130 * 4
    assert found.dark[found.parent[~found.dark & rings]].all()
