"""Target kinds and patterns: their geometry against the shared patterns and the surface's equation; orientation marks by brute force."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dishmap.errors import PatternError
from dishmap.targets.builders import (
    KIND_BUILDERS,
    LARGEST_COUNT,
    WHYCON_RATIO,
    concentric,
    disc,
    dish,
    multi_circular,
    odd_kind,
    plate,
    ring,
    whycon,
)
from dishmap.targets.pattern import Pattern
from dishmap.targets.symmetry import symmetry_poses

DATA = Path(os.environ.get("DISHMAP_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
# the shared files give 6 decimals of mm and 12 of axes
FILE_ROUNDING_MM = 1e-6
FILE_ROUNDING_AXIS = 1e-11
ROUNDING_MM = 1e-9


def shared_pattern(name: str) -> dict:
    path = DATA / name / "pattern.json"
    if not path.is_file():
        pytest.skip(f"needs {path}; set DISHMAP_DATA")
    return json.loads(path.read_text())


def assert_same_as_file(pattern: Pattern, content: dict) -> None:
    targets = content["targets"]
    assert pattern.ids.tolist() == [t["id"] for t in targets]
    np.testing.assert_allclose(pattern.center_mm, [t["center_mm"] for t in targets], atol=FILE_ROUNDING_MM)
    np.testing.assert_allclose(pattern.x_axis, [t["x_axis"] for t in targets], atol=FILE_ROUNDING_AXIS)
    np.testing.assert_allclose(pattern.normal, [t["normal"] for t in targets], atol=FILE_ROUNDING_AXIS)
    circles = content["target_kinds"]["multi4"]["circles"]
    kind = pattern.kinds["multi4"]
    assert kind.center_mm.tolist() == [c["center_mm"] for c in circles]
    assert kind.radius_mm.tolist() == [c["radius_mm"] for c in circles]
    assert kind.dark.tolist() == [c["inside"] == "dark" for c in circles]


def test_plate_is_the_shared_plate() -> None:
    content = shared_pattern("plate")
    assert_same_as_file(plate(5, 6, 45.0), content)
    with pytest.raises(AssertionError):
        assert_same_as_file(plate(5, 6, 45.001), content)


def test_dish_is_the_shared_dish() -> None:
    assert_same_as_file(dish(600.0, 300.0, spacing_mm=45.0), shared_pattern("dish"))


def test_plate_runs_row_by_row_from_the_top_left() -> None:
    pattern = plate(2, 3, 10.0, disc(2.0))
    expected = [[-10, 5], [0, 5], [10, 5], [-10, -5], [0, -5], [10, -5]]
    np.testing.assert_allclose(pattern.center_mm[:, :2], expected, atol=ROUNDING_MM)
    assert pattern.ids.tolist() == list(range(6))


@settings(max_examples=30, deadline=None)
@given(st.floats(200, 3000), st.floats(0.3, 1.0), st.floats(0.06, 0.2), st.booleans())
def test_dish_lies_on_its_paraboloid_within_its_rim(diameter: float, f_over_d: float, part: float, middle: bool) -> None:
    focal, spacing = diameter * f_over_d, diameter * part
    pattern = dish(diameter, focal, spacing, disc(0.2 * spacing), center_target=middle)
    x, y, z = pattern.center_mm.T
    np.testing.assert_allclose(z, (x**2 + y**2) / (4 * focal), atol=ROUNDING_MM * diameter)
    gradient = np.column_stack([-x / (2 * focal), -y / (2 * focal), np.ones_like(x)])
    np.testing.assert_allclose(np.cross(gradient, pattern.normal), 0, atol=1e-12)
    assert (pattern.normal[:, 2] > 0).all()
    # outwards along the surface: no part across the radius, rising
    np.testing.assert_allclose(x * pattern.x_axis[:, 1] - y * pattern.x_axis[:, 0], 0, atol=ROUNDING_MM * diameter)
    assert (x * pattern.x_axis[:, 0] + y * pattern.x_axis[:, 1] >= 0).all()
    assert np.hypot(x, y).max() + 0.2 * spacing <= diameter / 2 * (1 + 1e-9)
    distance = np.linalg.norm(pattern.center_mm[:, None] - pattern.center_mm, axis=-1) + spacing * np.eye(len(pattern))
    # the chord of six on a circle is the spacing; half a step between circles leaves at least 0.9 of it
    assert distance.min() > 0.9 * spacing


def test_kinds_have_the_printed_sizes() -> None:
    assert disc(4.0).radius_mm.tolist() == [4.0]
    assert not disc().has_light_edges
    assert ring(6.0, 2.0).radius_mm.tolist() == [6.0, 2.0]
    assert ring(6.0, 2.0).dark.tolist() == [True, False]
    assert concentric((2.0, 8.0, 6.0, 4.0)).radius_mm.tolist() == [8.0, 6.0, 4.0, 2.0]
    assert concentric((2.0, 8.0, 6.0, 4.0)).dark.tolist() == [True, False, True, False]
    assert whycon(12.2).radius_mm.tolist() == pytest.approx([12.2, 5.0])
    assert all(kind().turns_freely for name, kind in KIND_BUILDERS.items() if name != "multi")


@pytest.mark.parametrize("count", [2, 3, 4, 6])
def test_group_has_equal_sides(count: int) -> None:
    kind = multi_circular(count, 5.0, 3.0, 20.0)
    corner = kind.center_mm[kind.parent < 0]
    assert len(corner) == count
    around = np.linalg.norm(corner - np.roll(corner, 1, axis=0), axis=1)
    np.testing.assert_allclose(around, 20.0, atol=1e-8)
    np.testing.assert_allclose(corner.mean(axis=0), 0.0, atol=1e-8)
    # the lowest side lies along x
    assert corner[0, 1] == pytest.approx(corner[1, 1]) or count == 2


def test_group_of_discs_and_group_of_one() -> None:
    assert multi_circular(3, 5.0, 0.0, 20.0).dark.all()
    assert multi_circular(1).center_mm.tolist() == [[0, 0], [0, 0]]


@pytest.mark.parametrize("kind", [disc(), ring(), concentric(), whycon(), multi_circular(), multi_circular(3, 4.0, 0.0)])
def test_odd_kind_has_the_same_outlines_and_another_look(kind) -> None:
    odd = odd_kind(kind)
    outer, odd_outer = kind.parent < 0, odd.parent < 0
    assert odd.center_mm[odd_outer].tolist() == kind.center_mm[outer].tolist()
    assert odd.radius_mm[odd_outer].tolist() == kind.radius_mm[outer].tolist()
    assert len(odd.radius_mm) != len(kind.radius_mm)


PATTERNS = {
    "3x3": lambda: plate(3, 3, 45.0, orientation_marks=True),
    "5x6": lambda: plate(5, 6, 45.0, orientation_marks=True),
    "5x6 discs": lambda: plate(5, 6, 45.0, disc(), "disc", orientation_marks=True),
    "10x10 rings": lambda: plate(10, 10, 20.0, ring(), "ring", orientation_marks=True),
    "dish": lambda: dish(600.0, 300.0, orientation_marks=True),
    "small dish": lambda: dish(300.0, 150.0, orientation_marks=True),
}


@pytest.mark.parametrize("name", PATTERNS)
def test_orientation_marks_leave_no_symmetry(name: str) -> None:
    pattern = PATTERNS[name]()
    odd = [kind.endswith("-odd") for kind in pattern.kind_names]
    assert 0 < sum(odd) < 0.5 * len(pattern)
    assert symmetry_poses(pattern) == []


def test_orientation_marks_are_the_same_every_time() -> None:
    assert PATTERNS["5x6"]().kind_names == PATTERNS["5x6"]().kind_names


@pytest.mark.parametrize("name", ["5x6", "10x10 rings"])
def test_two_hidden_targets_leave_every_turn_and_shift_visible(name: str) -> None:
    """By brute force over all turns and shifts of the lattice that keep two thirds of the targets on targets."""
    pattern = PATTERNS[name]()
    pitch = 45.0 if name == "5x6" else 20.0
    look = {tuple(np.round(c / pitch * 2).astype(int)): k for c, k in zip(pattern.center_mm[:, :2], pattern.kind_names, strict=True)}
    tried = 0
    for a, b in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        for dx in range(-20, 21):
            for dy in range(-20, 21):
                moved = {p: (a * p[0] - b * p[1] + dx, b * p[0] + a * p[1] + dy) for p in look}
                wrong = [p for p, q in moved.items() if q in look and look[q] != look[p]]
                if sum(q in look for q in moved.values()) < 2 / 3 * len(look) or (a, dx, dy) == (1, 0, 0):
                    continue
                tried += 1
                # one hidden target spoils its own look and that of the target that lands on it
                assert len(wrong) > 4
    assert tried > 4


def test_too_small_for_orientation_marks() -> None:
    with pytest.raises(PatternError, match="1 targets are too few for orientation marks"):
        plate(1, 1, 45.0, orientation_marks=True)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: plate(5, 6, 23.0), r"a pitch of 23 mm is too small: targets 0 and 1 touch; their radius is 14.9 mm"),
        (lambda: plate(0, 6, 45.0), "rows must be 1 or more, not 0"),
        (lambda: plate(5, 6, float("nan")), "pitch_mm must be a positive number, not nan"),
        (lambda: plate(5, 6, -45.0), "pitch_mm must be a positive number, not -45.0"),
        (lambda: plate(500, 600, 45.0), f"rows 500 x columns 600 is more than {LARGEST_COUNT} targets"),
        (lambda: dish(600.0, 0.0), "focal_length_mm must be a positive number, not 0.0"),
        (lambda: dish(600.0, 300.0, 0.5), f"is more than {LARGEST_COUNT} targets"),
        (lambda: dish(600.0, 300.0, 20.0), "a spacing of 20 mm is too small: targets"),
        (lambda: dish(20.0, 300.0), "no target of radius 14.9 mm fits on a dish of 20 mm"),
        (lambda: whycon(6.0, 1.2), "ratio lies between 0 and 1, not 1.2"),
        (lambda: concentric((5.0, 5.0)), "different radii"),
        (lambda: multi_circular(40), "1 to 12 of them, not 40"),
        (lambda: multi_circular(side_mm=-1.0), "side of a group of rings must be a positive number of mm, not -1.0"),
        (lambda: multi_circular(side_mm=8.0), "cross; they must be disjoint or nested"),
        (lambda: ring(3.0, -1.0), "radius_mm must lie between"),
    ],
)
def test_impossible_sizes_are_refused(make, text: str) -> None:
    with pytest.raises(PatternError, match=text):
        make()


def test_whycon_ratio_is_that_of_the_system() -> None:
    assert pytest.approx(0.41, abs=0.001) == WHYCON_RATIO
