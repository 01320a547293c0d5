"""The paraboloid's geometry against brute force, and its derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import minimize

from dishmap.errors import FitError
from dishmap.surface.paraboloid import Placement, distances, height_along_z, start_placement
from dishmap.transforms import rotation_from_vector

Array = NDArray[np.float64]

# a minimiser that works on squared distances keeps half of the digits
BRUTE_MM = 1e-5
DIFFERENCE = 1e-6
STEPS = np.array([1e-3, 1e-3, 1e-3, 1e-6, 1e-6, 1e-9])

turns = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
leans = st.tuples(st.floats(-0.8, 0.8), st.floats(-0.8, 0.8))


def somewhere(turn: tuple[float, ...], lean: tuple[float, ...], focal: float) -> tuple[Placement, Array]:
    return Placement(np.array([10.0, -20.0, 700.0]), rotation_from_vector(np.array(turn))), np.array([3.0, -5.0, 2.0, *lean, 0.25 / focal])


def points_near(placement: Placement, parameters: Array, off: Array, seed: int = 0) -> tuple[Array, Array]:
    """Points at known distances `off` (N,) from the paraboloid along its normals, and the normals (N, 3)."""
    rng = np.random.default_rng(seed)
    c = parameters[5]
    u, v = rng.uniform(-200, 200, (2, len(off)))
    normal = np.column_stack([-2 * c * u, -2 * c * v, np.ones_like(u)])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    local = np.column_stack([u, v, c * (u**2 + v**2)]) + off[:, None] * normal
    rotation = placement.rotation @ rotation_from_vector(np.array([*parameters[3:5], 0.0]))
    return local @ rotation.T + placement.origin_mm + parameters[:3], normal @ rotation.T


@given(turns, leans, st.floats(150, 1000))
def test_distance_is_that_with_which_points_were_made(turn: tuple[float, ...], lean: tuple[float, ...], focal: float) -> None:
    placement, parameters = somewhere(turn, lean, focal)
    off = np.linspace(-20, 20, 9)
    points, normal = points_near(placement, parameters, off)
    found, _, found_normal = distances(points, placement, parameters)
    np.testing.assert_allclose(found, off, atol=1e-9)
    np.testing.assert_allclose(found_normal, normal, atol=1e-9)


def test_distance_is_the_shortest() -> None:
    placement, parameters = somewhere((0.0, 0.0, 0.0), (0.0, 0.0), 300.0)
    placement = Placement(np.zeros(3), np.eye(3))
    parameters[:3] = 0
    for point in np.random.default_rng(1).uniform([-300, -300, -50], [300, 300, 200], (10, 3)):
        best = minimize(
            lambda uv, p=point: (uv[0] - p[0]) ** 2 + (uv[1] - p[1]) ** 2 + ((uv**2).sum() / 1200 - p[2]) ** 2, point[:2], tol=1e-14
        )
        assert abs(distances(point[None], placement, parameters)[0][0]) == pytest.approx(np.sqrt(best.fun), abs=BRUTE_MM)


@given(turns, leans, st.floats(150, 1000))
def test_derivatives_equal_differences(turn: tuple[float, ...], lean: tuple[float, ...], focal: float) -> None:
    placement, b = somewhere(turn, lean, focal)
    points, _ = points_near(placement, b, np.linspace(-5, 5, 6))
    _, by, _ = distances(points, placement, b)
    spread = placement.spread(b)
    for i, step in enumerate(STEPS):
        e = np.eye(6)[i] * step
        difference = (distances(points, placement, b + e)[0] - distances(points, placement, b - e)[0]) / (2 * step)
        np.testing.assert_allclose(by[:, i], difference, rtol=1e-4, atol=DIFFERENCE * np.abs(by[:, i]).max() + DIFFERENCE)
        seven = (placement.vertex_axis_focal(b + e) - placement.vertex_axis_focal(b - e)) / (2 * step)
        np.testing.assert_allclose(spread[:, i], seven, rtol=1e-4, atol=1e-6)


@given(st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4)), st.floats(150, 1000), st.booleans())
def test_height_lies_on_the_surface(lean: tuple[float, ...], focal: float, down: bool) -> None:
    placement, b = somewhere((np.pi, 0.0, 0.0) if down else (0.0, 0.0, 0.0), lean, focal)
    seven = placement.vertex_axis_focal(b)
    x, y = np.random.default_rng(0).uniform(-40, 40, (2, 12)) + placement.origin_mm[:2, None]
    z, by = height_along_z(np.column_stack([x, y]), seven)
    np.testing.assert_allclose(distances(np.column_stack([x, y, z]), placement, b)[0], 0, atol=1e-9)
    # the vertex itself is a point of the surface, so of two heights the right one was taken
    assert height_along_z(seven[:2], seven)[0] == pytest.approx(seven[2], abs=1e-9)
    for i, step in enumerate([1e-3, 1e-3, 1e-3, 1e-6, 1e-6, 1e-6, 1e-3]):
        e = np.eye(7)[i] * step
        xy = np.column_stack([x, y])
        difference = (height_along_z(xy, seven + e)[0] - height_along_z(xy, seven - e)[0]) / (2 * step)
        np.testing.assert_allclose(by[:, i], difference, rtol=1e-3, atol=1e-4)


def test_no_height_where_there_is_no_surface() -> None:
    # lying on its side, a paraboloid ends in y
    seven = np.array([0.0, 0.0, 0.0, 0.0, np.sin(1.2), np.cos(1.2), 100.0])
    z, _ = height_along_z(np.array([[0.0, 10.0], [0.0, -1e4]]), seven)
    assert np.isfinite(z[0])
    assert np.isnan(z[1])


@pytest.mark.parametrize("offset", [0.0, 300.0, 600.0])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (3.1, 0.0, 0.3), (1.2, -0.8, 0.5)])
def test_start_is_near_even_for_an_offset_dish(offset: float, turn: tuple[float, ...]) -> None:
    rng = np.random.default_rng(3)
    xy = np.add(rng.uniform(-300, 300, (150, 2)), [offset, 0.0])
    rotation = rotation_from_vector(np.array(turn))
    points = np.column_stack([xy, (xy**2).sum(axis=1) / 1200]) @ rotation.T + [5.0, 6.0, 900.0]
    placement, parameters = start_placement(points)
    seven = placement.vertex_axis_focal(parameters)
    # the last grid's step is 1.5 degrees; the fit does the rest
    assert np.degrees(np.arccos(min(1.0, seven[3:6] @ rotation[:, 2]))) < 3
    assert seven[6] == pytest.approx(300, rel=0.1)
    assert np.abs(distances(points, placement, parameters)[0]).max() < 10


def test_a_plane_has_no_curvature() -> None:
    xy = np.random.default_rng(0).uniform(-100, 100, (30, 2))
    with pytest.raises(FitError, match="lie in a plane"):
        start_placement(np.column_stack([xy, xy @ [0.3, -0.2]]))
