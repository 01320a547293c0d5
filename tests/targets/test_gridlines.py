"""Where lines run, against curves that are known by their equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

from dishmap.errors import PatternError
from dishmap.targets.grid_builders import grid
from dishmap.targets.gridlines import GridLines
from dishmap.targets.pattern import GridLine, Pattern, Surface

Array = NDArray[np.float64]

# The promise for where ink lies.
PLACE_MM = 1e-3
FOCAL_MM, RADIUS_MM, PITCH_MM = 300.0, 57.0, 12.0
DISH = Surface("paraboloid", 600.0, FOCAL_MM)


def way_mm(radius: float) -> float:
    """Length of a meridian from the vertex to a distance from the axis, by integration."""
    return quad(lambda r: np.hypot(1, r / (2 * FOCAL_MM)), 0, radius, epsabs=1e-10)[0]


def dish_point(step: Array) -> Array:
    """The point of the dish that lies at pitch |step| along the meridian in the direction of step."""
    way = PITCH_MM * float(np.hypot(*step))
    radius = brentq(lambda r: way_mm(r) - way, 0, 400, xtol=1e-10) if way else 0.0
    angle = np.arctan2(step[1], step[0])
    return np.array([radius * np.cos(angle), radius * np.sin(angle), radius**2 / (4 * FOCAL_MM)])


def geodesic(start: Array, direction: Array, length: float) -> Array:
    """Where a geodesic of the dish ends: the acceleration is normal to the surface."""

    def change(_: float, state: Array) -> Array:
        x, y, _, vx, vy, vz = state
        steep = 1 + (x**2 + y**2) / (4 * FOCAL_MM**2)
        push = (vx**2 + vy**2) / (2 * FOCAL_MM * steep)
        return np.array([vx, vy, vz, -push * x / (2 * FOCAL_MM), -push * y / (2 * FOCAL_MM), push])

    return solve_ivp(change, (0, length), np.concatenate([start, direction]), rtol=1e-11, atol=1e-11).y[:3, -1]


def on_dish(line: GridLine, pattern: Pattern, t: float) -> Array:
    assert pattern.lattice is not None
    lattice = pattern.lattice - (pattern.lattice.min(axis=0) + pattern.lattice.max(axis=0)) / 2
    first, second = (lattice[pattern.ids.tolist().index(i)] for i in line.ids[:2])
    return first + t * (second - first)


def test_middles_on_a_dish_are_straight_on_its_flat_cap() -> None:
    pattern = grid(45, 45, PITCH_MM, line_width_mm=1.0, surface=DISH)
    lines = GridLines(pattern)
    for number in (3, 20, 50, 70, 85):
        for t in (-0.3, 0.0, 0.37, 1.5, 7.81):
            expected = dish_point(on_dish(pattern.lines[number], pattern, t))
            assert lines.points_mm(number, t) == pytest.approx(expected, abs=1e-6)


def test_edges_on_a_dish_lie_half_a_width_along_geodesics() -> None:
    pattern = grid(45, 45, PITCH_MM, line_width_mm=1.0, surface=DISH)
    lines = GridLines(pattern)
    for number, t in ((2, 3.3), (20, 1.25), (60, 20.7), (85, 4.0)):
        here, ahead, behind = (dish_point(on_dish(pattern.lines[number], pattern, t + d)) for d in (0, 1e-4, -1e-4))
        normal = np.array([-here[0] / (2 * FOCAL_MM), -here[1] / (2 * FOCAL_MM), 1.0])
        left = np.cross(normal, ahead - behind)
        left /= np.linalg.norm(left)
        # 5 mm is far more than half a line; there is where terms left out would show
        for across, tolerance in ((0.5, 1e-6), (-0.5, 1e-6), (5.0, PLACE_MM)):
            expected = geodesic(here, np.sign(across) * left, abs(across))
            assert np.abs(lines.points_mm(number, t, across) - expected).max() < tolerance
            # the tangent plane alone is farther off
            if across == 5.0:
                assert np.abs(here + across * left - expected).max() > 10 * PLACE_MM


@pytest.mark.parametrize("radius_mm", [RADIUS_MM, -RADIUS_MM])
def test_lines_on_a_cylinder(radius_mm: float) -> None:
    pattern = grid(11, 7, PITCH_MM, line_width_mm=1.0, surface=Surface("cylinder", radius_mm=radius_mm))
    lines = GridLines(pattern)
    t, across = np.meshgrid(np.linspace(-0.5, 6.5, 29), [-0.5, 0.0, 0.5])

    def wrapped(way: Array, y: Array) -> Array:
        return np.stack([RADIUS_MM * np.sin(way / RADIUS_MM), y, radius_mm * (np.cos(way / RADIUS_MM) - 1)], axis=-1)

    # the first line is the top row, from the left; line 7 the left column, upwards: its left is -x
    assert np.abs(lines.points_mm(0, t, across) - wrapped(PITCH_MM * (t - 5), PITCH_MM * 3 + across)).max() < 1e-6
    assert np.abs(lines.points_mm(7, t, across) - wrapped(-PITCH_MM * 5 - across, PITCH_MM * (t - 3))).max() < 1e-6
    assert lines.start_t == pytest.approx(-0.5, abs=1e-9)
    assert np.isnan(lines.points_mm(0, 13.0)).any()


def test_bent_lines_pass_through_their_targets_and_overhang_by_their_length() -> None:
    """Targets whose flat places lie on a circle: a spline is as good as the promise between them."""
    pattern = grid(9, 3, PITCH_MM, line_width_mm=1.0, surface=DISH)
    angle = (np.arange(9) - 4) * PITCH_MM / 400
    flat = np.stack([np.stack([(400 + 12 * row) * np.sin(angle), 400 - (400 + 12 * row) * np.cos(angle)], axis=1) for row in (1, 0, -1)])
    center = np.array([dish_point(place / PITCH_MM) for place in flat.reshape(-1, 2)])
    lines = GridLines(replace(pattern, center_mm=center, normal=DISH.normal(center[:, :2]), x_axis=tangents(center)))
    assert np.abs(lines.points_mm(lines.crossing_line, lines.crossing_t) - center[:, None]).max() < 1e-9
    for t in np.linspace(0.1, 7.9, 14):
        turn = (t - 4) * PITCH_MM / 400
        expected = dish_point(np.array([400 * np.sin(turn), 400 - 400 * np.cos(turn)]) / PITCH_MM)
        assert np.abs(lines.points_mm(1, t) - expected).max() < PLACE_MM
    t = np.linspace(8, lines.stop_t[1], 2001)
    length = np.linalg.norm(np.diff(lines.points_mm(1, t), axis=0), axis=1).sum()
    assert length == pytest.approx(PITCH_MM / 2, abs=1e-6)


def tangents(center: Array) -> Array:
    x = np.cross([0.0, 1.0, 0.0], DISH.normal(center[:, :2]))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def test_a_target_missing_from_a_line_leaves_its_step() -> None:
    whole = grid(5, 3, PITCH_MM, line_width_mm=1.0)
    kept = np.delete(np.arange(15), 7)
    assert whole.lattice is not None
    lines = tuple(replace(line, ids=tuple(i for i in line.ids if i != 7)) for line in whole.lines)
    pattern = Pattern(
        "gap", whole.surface, whole.kinds, whole.ids[kept], ("crossing",) * 14, *(x[kept] for x in (whole.center_mm, whole.x_axis)),
        whole.normal[kept], whole.lattice[kept], lines,
    )  # fmt: skip
    found = GridLines(pattern)
    assert found.target_t[1].tolist() == [0, 1, 3, 4]
    assert found.points_mm(1, 2.0) == pytest.approx([0, 0, 0], abs=1e-12)
    # first the row's line (0 is the top), then the column's
    assert found.crossing_line[8].tolist() == [1, 7]
    assert found.crossing_t[8].tolist() == [4.0, 1.0]


def test_squares_have_no_lines() -> None:
    with pytest.raises(PatternError, match="has no lines"):
        GridLines(grid(3, 3, 12.0, square_mm=8.0))
