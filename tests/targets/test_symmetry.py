"""Symmetries of patterns against groups known by construction."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dishmap.targets.builders import disc, dish, multi_circular, plate, ring
from dishmap.targets.grid_builders import grid, marked_crossing
from dishmap.targets.pattern import Pattern, Surface
from dishmap.targets.symmetry import symmetry_poses
from dishmap.transforms import Pose, rotation_from_vector

ANGLE_TOLERANCE_DEG = 1e-6
# the motion is fitted to all marks, so only rounding is left
MOTION_TOLERANCE_MM = 1e-8
# 0.05 s for a plate; the circle has 999 motions, the most that 1000 marks can have
LIMIT_S = 3.0


def turns_deg(pattern: Pattern) -> list[float]:
    return sorted(round(float(np.degrees(pose.rotation_vector_rad[2])) % 360, 6) for pose in symmetry_poses(pattern))


def circle_of_discs(count: int, odd: int | None = None, radius_mm: float = 100.0, middle: tuple[float, float] = (0.0, 0.0)) -> Pattern:
    angle = 2 * np.pi * np.arange(count) / count
    center = np.column_stack([radius_mm * np.cos(angle) + middle[0], radius_mm * np.sin(angle) + middle[1], np.zeros(count)])
    names = tuple("odd" if i == odd else "disc" for i in range(count))
    along, up = np.tile([1.0, 0, 0], (count, 1)), np.tile([0, 0, 1.0], (count, 1))
    return Pattern("circle", Surface(), {"disc": disc(5.0), "odd": ring(5.0, 2.0)}, np.arange(count), names, center, along, up)


@pytest.mark.parametrize(
    ("pattern", "turns"),
    [
        (plate(5, 6, 45.0), [180]),
        (plate(5, 5, 45.0, disc(), "disc"), [90, 180, 270]),
        (plate(1, 2, 45.0, disc(), "disc"), [180]),
        (plate(1, 1, 45.0, disc(), "disc"), []),
        (plate(1, 1, 45.0), [90, 180, 270]),
        (plate(1, 1, 45.0, multi_circular(3, side_mm=20.0)), [120, 240]),
        (circle_of_discs(7), [360 * k / 7 for k in range(1, 7)]),
        (circle_of_discs(7, odd=2), []),
        (dish(200.0, 100.0, kind=disc(), kind_name="disc"), [60, 120, 180, 240, 300]),
        (dish(200.0, 100.0), [180]),
        (dish(600.0, 300.0), []),
    ],
)
def test_known_groups(pattern: Pattern, turns: list[float]) -> None:
    assert turns_deg(pattern) == pytest.approx(turns, abs=ANGLE_TOLERANCE_DEG)


@pytest.mark.parametrize("pattern", [plate(4, 4, 30.0), circle_of_discs(9, middle=(300.0, -50.0)), dish(200.0, 100.0)])
def test_each_pose_carries_the_marks_onto_marks_of_their_type(pattern: Pattern) -> None:
    poses = symmetry_poses(pattern)
    assert poses
    marks = pattern.marks
    for pose in poses:
        distance = np.linalg.norm(pose.apply(marks.center_mm)[:, None] - marks.center_mm, axis=-1)
        assert distance.min(axis=1).max() < MOTION_TOLERANCE_MM
        assert (marks.type_index[distance.argmin(axis=1)] == marks.type_index).all()


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 12), st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-3, 3)), st.floats(-500, 500))
def test_the_group_moves_with_the_pattern(count: int, vector: tuple[float, float, float], shift: float) -> None:
    """Turned out of the dish frame, a pattern keeps its motions: they are about its own axis, not about z."""
    flat = circle_of_discs(count)
    move = Pose(rotation_from_vector(np.array(vector)), np.array([shift, -shift, 10.0]))
    center, along, up = move.apply(flat.center_mm), move.rotate(flat.x_axis), move.rotate(flat.normal)
    moved = Pattern("moved", flat.surface, flat.kinds, flat.ids, flat.kind_names, center, along, up)
    poses = symmetry_poses(moved)
    assert len(poses) == count - 1
    for pose in poses:
        np.testing.assert_allclose(pose.rotate(up[0]), up[0], atol=1e-9)


def test_tolerance_decides_what_counts_as_equal() -> None:
    exact = plate(3, 4, 45.0, disc(5.0), "disc")
    center = exact.center_mm.copy()
    center[0, 0] += 0.5
    bent = Pattern("bent", exact.surface, exact.kinds, exact.ids, exact.kind_names, center, exact.x_axis, exact.normal)
    # default: 0.2 of 5 mm, so that half a millimetre does not tell the two ends apart
    assert turns_deg(bent) == pytest.approx([180], abs=0.5)
    assert symmetry_poses(bent, tolerance_mm=0.1) == []


def test_sorted_by_angle_and_without_identity() -> None:
    angles = [np.linalg.norm(pose.rotation_vector_rad) for pose in symmetry_poses(circle_of_discs(11))]
    assert angles == sorted(angles)
    assert min(angles) > 0.5


@pytest.mark.parametrize("pattern", [plate(25, 40, 45.0), circle_of_discs(1000, radius_mm=2000.0)], ids=["plate", "circle"])
def test_fast_for_a_thousand_targets(pattern: Pattern) -> None:
    start = time.process_time()
    poses = symmetry_poses(pattern)
    assert time.process_time() - start < LIMIT_S
    assert len(poses) in (1, 999)


@pytest.mark.parametrize("ink", [{"line_width_mm": 1.0}, {"square_mm": 8.0}], ids=["lines", "squares"])
@pytest.mark.parametrize(
    ("columns", "rows", "surface", "expected"),
    [
        (7, 5, Surface(), [180.0]),
        (6, 6, Surface(), [90.0, 180.0, 270.0]),
        (6, 6, Surface("cylinder", radius_mm=57.0), [180.0]),
        (12, 12, Surface("paraboloid", 120.0, 60.0), [90.0, 180.0, 270.0]),
        (12, 9, Surface("paraboloid", 120.0, 60.0), [180.0]),
    ],
)
def test_grids_look_the_same_after_quarter_turns(columns: int, rows: int, surface: Surface, expected: list[float], ink: dict) -> None:
    pattern = grid(columns, rows, 12.0, surface=surface, **ink)
    assert turns_deg(pattern) == expected
    poses = symmetry_poses(pattern)
    for pose in poses:
        moved = pose.apply(pattern.center_mm)
        assert np.linalg.norm(moved[:, None] - pattern.center_mm, axis=-1).min(axis=1).max() < 1e-9
    assert symmetry_poses(grid(columns, rows, 12.0, surface=surface, orientation_marks=True, **ink)) == []


def test_the_mark_of_a_crossing_stands_in_the_middle_of_its_cell() -> None:
    """One mark in the middle cell of an even grid keeps all quarter turns; beside it, none."""
    plain = grid(6, 6, 12.0, line_width_mm=1.0)
    kinds = {**plain.kinds, "crossing-marked": marked_crossing(12.0)}
    for place, expected in (((2, 2), [90.0, 180.0, 270.0]), ((2, 3), [])):
        names = ["crossing-marked" if tuple(p) == place else "crossing" for p in np.asarray(plain.lattice).tolist()]
        assert turns_deg(replace(plain, kinds=kinds, kind_names=names)) == expected
