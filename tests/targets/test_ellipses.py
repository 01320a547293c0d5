from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dishmap.targets.ellipses import contour_spread, ellipse_matrices, enclosing, fit_ellipses, invert_2x2, root_det

Array = NDArray[np.float64]

# Points lie exactly on the ellipse: what is left is rounding of sums of fourth powers.
EXACT_PX = 1e-6
# A twelfth of a contour pushed out by 2 px moves the centre of a fit without weights by a third of a pixel.
NICK_CENTER_PX = 0.15
# Of a square of half side 1, rho^2 = 1 + s^2 has mean 4/3 and mean square 28/15: a spread of sqrt(28/15 * 9/16 - 1).
SQUARE_SPREAD = np.sqrt(0.05)


def outline(center: Array, semi_axes: Array, angle: float, count: int = 60, start: float = 0.0) -> Array:
    t = start + 2 * np.pi * np.arange(count) / count
    return center + np.stack([np.cos(t), np.sin(t)], axis=1) @ ellipse_matrices(semi_axes, np.array(angle))


def fit_one(points: Array) -> tuple[Array, Array, float, float]:
    fits = fit_ellipses(points, np.array([0]), np.ones(len(points)))
    return fits.center[0], fits.semi_axes[0], float(fits.angle_rad[0]), float(fits.rms[0])


@given(
    st.tuples(st.floats(-2000, 2000), st.floats(-2000, 2000)),
    st.floats(2, 300),
    st.floats(0.25, 0.95),
    st.floats(-1.5, 1.5),
    st.floats(0, 6),
)
def test_points_on_an_ellipse_give_it_back(center: tuple[float, float], major: float, ratio: float, angle: float, start: float) -> None:
    axes = np.array([major, ratio * major])
    found_center, found_axes, found_angle, rms = fit_one(outline(np.array(center), axes, angle, start=start))
    tolerance = EXACT_PX * (1 + major)
    assert found_center == pytest.approx(center, abs=tolerance)
    assert found_axes == pytest.approx(axes, abs=tolerance)
    # the ends of the major axis, which tells angle and length together
    end = np.array([np.cos(found_angle), np.sin(found_angle)])
    assert abs(end @ [np.cos(angle), np.sin(angle)]) == pytest.approx(1.0, abs=1e-6)
    assert rms < tolerance


def test_many_contours_are_fitted_as_one_by_one(rng: np.random.Generator) -> None:
    contours = [outline(rng.uniform(0, 99, 2), rng.uniform([8, 4], [20, 8]), rng.uniform(-1, 1), n) for n in (20, 33, 90)]
    contours = [c + rng.normal(0, 0.3, c.shape) for c in contours]
    starts = np.cumsum([0, *map(len, contours[:-1])])
    together = fit_ellipses(np.concatenate(contours), starts, np.ones(sum(map(len, contours))))
    for k, contour in enumerate(contours):
        center, axes, angle, rms = fit_one(contour)
        assert together.center[k] == pytest.approx(center, abs=1e-9)
        assert together.semi_axes[k] == pytest.approx(axes, abs=1e-9)
        assert (together.angle_rad[k], together.rms[k]) == pytest.approx((angle, rms), abs=1e-9)


def test_noisy_points_agree_with_opencv(rng: np.random.Generator) -> None:
    """OpenCV's AMS fit is another estimator; both stay within the noise of each other, and of the truth."""
    sigma, center, axes = 0.2, np.array([50.0, 40.0]), np.array([20.0, 12.0])
    points = outline(center, axes, 0.5) + rng.normal(0, sigma, (60, 2))
    found, found_axes, _, rms = fit_one(points)
    theirs = cv2.fitEllipseAMS(points.astype(np.float32))
    assert found == pytest.approx(center, abs=4 * sigma / np.sqrt(60))
    assert found == pytest.approx(theirs[0], abs=4 * sigma / np.sqrt(60))
    assert found_axes == pytest.approx(np.sort(theirs[1])[::-1] / 2, abs=4 * sigma / np.sqrt(60))
    assert rms == pytest.approx(sigma, rel=0.35)


def test_a_nick_hardly_moves_the_fit() -> None:
    center, axes = np.array([0.0, 0.0]), np.array([15.0, 10.0])
    points = outline(center, axes, 0.3)
    points[:5] *= 1.15
    found, _, _, _ = fit_one(points)
    plain = cv2.fitEllipseAMS(points.astype(np.float32))[0]
    assert np.linalg.norm(found) < NICK_CENTER_PX < np.linalg.norm(plain)


def test_points_on_a_line_are_no_ellipse() -> None:
    line = np.stack([np.arange(20.0), 2 * np.arange(20.0)], axis=1)
    _, axes, _, rms = fit_one(line)
    assert not np.isfinite(axes).all() or rms > 1.0
    hyperbola = np.stack([np.cosh(np.linspace(-2, 2, 30)), np.sinh(np.linspace(-2, 2, 30))], axis=1)
    both = np.concatenate([hyperbola, -hyperbola])
    _, axes, _, rms = fit_one(both)
    assert not np.isfinite(axes).all() or rms > 0.1 * np.abs(both).max()


def test_spread_tells_ellipses_from_squares() -> None:
    side = np.linspace(-1, 1, 50, endpoint=False)
    one = np.ones_like(side)
    square = np.concatenate([np.stack(p, axis=1) for p in ((side, -one), (one, side), (-side, one), (-one, -side))])
    turned = square @ np.array([[3.0, 1.0], [0.2, 1.5]])
    ellipse = outline(np.array([5.0, 6.0]), np.array([9.0, 4.0]), 1.0)
    points, starts = np.concatenate([ellipse, square, turned]), np.array([0, len(ellipse), len(ellipse) + len(square)])
    spread = contour_spread(points, starts)
    assert spread[0] < 1e-9
    assert spread[1:] == pytest.approx([SQUARE_SPREAD] * 2, abs=1e-3)


def test_enclosing_finds_the_smallest_around() -> None:
    #         big   ring outer, inner   alone   beside ring inner
    center = np.array([[50.0, 50], [40, 40], [40.3, 40], [200, 50], [60, 60]])
    axes = np.array([[40.0, 38], [8, 7], [4, 3.6], [8, 7], [3, 3]])
    parent = enclosing(center, axes, np.zeros(5))
    assert parent.tolist() == [-1, 0, 1, -1, 0]
    # one that sticks out is not inside
    assert enclosing(np.array([[0.0, 0], [7, 0]]), np.array([[8.0, 8], [4, 4]]), np.zeros(2)).tolist() == [-1, -1]


def test_small_matrices(rng: np.random.Generator) -> None:
    m = rng.normal(size=(7, 2, 2))
    assert invert_2x2(m) == pytest.approx(np.linalg.inv(m), rel=1e-9)
    assert root_det(m) == pytest.approx(np.sqrt(np.abs(np.linalg.det(m))), rel=1e-9)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(11)
