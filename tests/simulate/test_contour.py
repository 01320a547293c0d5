"""Coverage of pixels against areas and integrals computed in other ways."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import dblquad
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from dishmap.simulate.contour import add_curve, circle, finish, polyline, signed_area, spectral_dv

Array = NDArray[np.float64]

# The trapezoid rule's own error at one step per sigma is 3e-9.
EXACT_COVERAGE = 2e-8
# Squares of quad's own tolerance.
QUADRATURE_COVERAGE = 1e-7
# Counting 64 x 64 points per pixel leaves this much in single pixels of a small disc.
COUNTED_COVERAGE = 2e-3


def coverage(points: Array, dv: Array, shape: tuple[int, int], sigma_px: float, corner: tuple[int, int] = (0, 0)) -> Array:
    buffer = np.zeros(shape)
    add_curve(buffer, corner, points, dv, sigma_px)
    return np.asarray(finish(buffer))


@pytest.mark.parametrize("sigma_px", [0.3, 0.8, 3.0])
def test_disc_at_single_pixels_equals_the_double_integral(sigma_px: float) -> None:
    center, radius = (9.3, 8.6), 3.7
    image = coverage(*circle(center, radius, sigma_px), (18, 20), sigma_px)

    def weight(x: float) -> float:
        return float(ndtr((x + 0.5) / sigma_px) - ndtr((x - 0.5) / sigma_px))

    for u, v in ((9, 8), (13, 8), (11, 11), (6, 10)):
        # polar coordinates about the disc's centre: a smooth integrand on a rectangle
        value, _ = dblquad(
            lambda r, t, u=u, v=v: r * weight(u - center[0] - r * np.cos(t)) * weight(v - center[1] - r * np.sin(t)),
            0,
            2 * np.pi,
            0,
            radius,
        )
        assert abs(image[v, u] - value) < QUADRATURE_COVERAGE


@pytest.mark.parametrize("sigma_px", [0.3, 1.0])
def test_disc_equals_counted_points(sigma_px: float) -> None:
    fine, center, radius = 64, (11.37, 10.81), 2.4
    image = coverage(*circle(center, radius, sigma_px), (22, 23), sigma_px)
    v, u = ((np.arange(n * fine) + 0.5) / fine - 0.5 for n in image.shape)
    inside = ((u - center[0]) ** 2 + (v[:, None] - center[1]) ** 2 < radius**2).astype(float)
    counted = gaussian_filter(inside, sigma_px * fine, truncate=6).reshape(22, fine, 23, fine).mean(axis=(1, 3))
    assert np.abs(image - counted).max() < COUNTED_COVERAGE
    # a hundredth of a pixel to the side is seen
    moved = coverage(*circle((11.38, 10.81), radius, sigma_px), (22, 23), sigma_px)
    assert np.abs(moved - counted).max() > 1.5 * COUNTED_COVERAGE


def test_half_plane_is_the_integral_of_a_gaussian() -> None:
    sigma_px, edge = 0.7, 20.25
    square = np.array([[edge, -100.0], [200.0, -100.0], [200.0, 100.0], [edge, 100.0]])
    image = coverage(*polyline(square, sigma_px), (3, 40), sigma_px)
    x = (np.arange(40) - edge)[:, None] + ((np.arange(2000) + 0.5) / 2000 - 0.5)
    assert np.abs(image - ndtr(x / sigma_px).mean(axis=1)).max() < 1e-6


def test_polyline_of_uneven_pieces_is_as_even_as_its_area() -> None:
    # pieces of all lengths: inside, every row must still sum to one
    angle = np.sort(np.random.default_rng(1).uniform(0, 2 * np.pi, 900))
    corners = np.array([150.0, 140.0]) + 120 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    image = coverage(*polyline(corners, 0.8), (280, 300), 0.8)
    v, u = np.mgrid[:280, :300]
    assert np.abs(image[np.hypot(u - 150, v - 140) < 110] - 1).max() < 1e-6
    x, y = corners.T
    assert image.sum() == pytest.approx(0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum(), rel=1e-7)


def test_parts_of_a_curve_outside_the_buffer_still_count() -> None:
    sigma_px = 0.8
    points, dv = circle((10.2, 12.7), 9.0, sigma_px)
    whole = coverage(points, dv, (40, 40), sigma_px, (-8, -6))
    for corner, shape in (((0, 0), (14, 9)), ((8, 10), (5, 20)), ((14, -2), (30, 3)), ((25, 0), (5, 5))):
        part = coverage(points, dv, shape, sigma_px, corner)
        expected = np.zeros(shape)
        rows, columns = np.arange(shape[0]) + corner[1] + 6, np.arange(shape[1]) + corner[0] + 8
        inside = np.ix_(rows < 40, columns < 40)
        expected[inside] = whole[np.ix_(rows[rows < 40], columns[columns < 40])]
        assert np.abs(part - expected).max() < EXACT_COVERAGE


@given(
    radius=st.floats(0.5, 60),
    sigma_px=st.floats(0.5, 3),
    u=st.floats(-0.5, 0.5),
    v=st.floats(-0.5, 0.5),
)
def test_blur_and_pixels_keep_area_and_centre(radius: float, sigma_px: float, u: float, v: float) -> None:
    size = 2 * int(radius + 6 * sigma_px + 3)
    image = coverage(*circle((size / 2 + u, size / 2 + v), radius, sigma_px), (size, size), sigma_px)
    assert image.sum() == pytest.approx(np.pi * radius**2, abs=3e-4)
    # pixels at one per pixel alias a little of a sigma of 0.5 px
    assert (image.sum(axis=0) @ np.arange(size)) / image.sum() - size / 2 == pytest.approx(u, abs=2e-3 if sigma_px < 0.7 else 1e-5)


def test_area_and_derivative_of_an_ellipse() -> None:
    t = np.arange(64) * (2 * np.pi / 64)
    points = np.stack([5 * np.cos(t), 2 * np.sin(t) + 0.3 * np.cos(t)], axis=-1)
    dv = spectral_dv(points[:, 1])
    assert np.abs(dv - (2 * np.cos(t) - 0.3 * np.sin(t)) * (2 * np.pi / 64)).max() < 1e-12
    assert signed_area(points, dv) == pytest.approx(10 * np.pi, rel=1e-12)
    assert signed_area(points[::-1], -dv[::-1]) == pytest.approx(-10 * np.pi, rel=1e-12)
