"""Surfaces, target kinds and patterns: geometry against differences and quadrature, mistakes by their text."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from dishmap.errors import PatternError
from dishmap.targets.builders import concentric, disc, dish, multi_circular, odd_kind, plate, ring, whycon
from dishmap.targets.pattern import GridLine, Pattern, Polygon, Surface, TargetKind, bent_print_mm

ROUNDING = 1e-12
# central differences with steps of 1e-3 mm of a surface curved by 1/600 mm
DIFFERENCE = 1e-6

places = st.tuples(st.floats(-300, 300), st.floats(-300, 300)).map(np.array)
focals = st.floats(100, 1000)


def kind(circles: list[tuple[float, float, float, bool]]) -> TargetKind:
    table = np.array(circles, dtype=float).reshape(-1, 4)
    return TargetKind(table[:, :2], table[:, 2], table[:, 3] > 0)


def two_targets(**changes: object) -> Pattern:
    fields: dict = {
        "name": "two",
        "surface": Surface(),
        "kinds": {"disc": disc(5.0)},
        "ids": [3, 7],
        "kind_names": ("disc", "disc"),
        "center_mm": [[0.0, 0, 0], [30, 0, 0]],
        "x_axis": [[1.0, 0, 0], [0, 1, 0]],
        "normal": [[0.0, 0, 1], [0, 0, 1]],
    }
    return Pattern(**{**fields, **changes})


@given(places, focals)
def test_normal_is_across_the_surface(xy: np.ndarray, focal: float) -> None:
    surface = Surface("paraboloid", 600.0, focal)
    step = 1e-3
    height = [surface.height_mm(xy + d) for d in ([step, 0], [-step, 0], [0, step], [0, -step])]
    tangents = np.array([[2 * step, 0, height[0] - height[1]], [0, 2 * step, height[2] - height[3]]]) / (2 * step)
    assert np.abs(tangents @ surface.normal(xy)).max() < DIFFERENCE
    assert surface.normal(xy)[2] > 0
    assert np.linalg.norm(surface.normal(xy)) == pytest.approx(1.0, abs=ROUNDING)


def test_the_focus_lies_where_it_should() -> None:
    """A ray along the boresight, mirrored at the surface, meets the axis at the focal length."""
    surface = Surface("paraboloid", 600.0, 300.0)
    for xy in ([50.0, 20.0], [-280.0, 10.0]):
        n, point = surface.normal(np.array(xy)), np.array([*xy, surface.height_mm(np.array(xy))])
        ray = np.array([0.0, 0, -1]) - 2 * n[2] * -n
        at = point + ray * -(point[0] / ray[0])
        np.testing.assert_allclose(at, [0, 0, 300], atol=1e-9)


@given(places, focals, st.floats(-np.pi, np.pi))
def test_curvature_is_that_of_the_surface(xy: np.ndarray, focal: float, turn: float) -> None:
    """Where a normal section rises above the tangent plane, to second order."""
    surface = Surface("paraboloid", 600.0, focal)
    n = surface.normal(xy)
    first = np.cross([0.0, 1.0, 0.0], n)
    first /= np.linalg.norm(first)
    second = np.cross(n, first)
    x_axis, y_axis = np.cos(turn) * first + np.sin(turn) * second, -np.sin(turn) * first + np.cos(turn) * second
    curvature = surface.curvature_per_mm(xy, x_axis, y_axis)
    center = np.array([*xy, surface.height_mm(xy)])

    def stand_off(a: float, b: float) -> float:
        """Distance along n from the tangent plane to the surface above a x_axis + b y_axis, by Newton's method."""
        foot, t = center + a * x_axis + b * y_axis, 0.0
        for _ in range(20):
            p = foot + t * n
            t -= (p[2] - surface.height_mm(p[:2])) / (n[2] - n[:2] @ p[:2] / (2 * focal))
        return t

    step = 0.5
    found = [stand_off(a, b) * 2 / step**2 for a, b in ((step, 0.0), (0.0, step), (step, step))]
    found_back = [stand_off(-a, -b) * 2 / step**2 for a, b in ((step, 0.0), (0.0, step), (step, step))]
    even = (np.array(found) + found_back) / 2
    expected = [curvature[0, 0], curvature[1, 1], curvature[0, 0] + curvature[1, 1] + 2 * curvature[0, 1]]
    np.testing.assert_allclose(even, expected, atol=1e-4 / focal, rtol=1e-5)


def test_a_plane_is_flat() -> None:
    surface = Surface()
    xy = np.array([[1.0, 2.0], [30.0, -4.0]])
    assert not surface.height_mm(xy).any()
    assert surface.normal(xy).tolist() == [[0, 0, 1], [0, 0, 1]]
    axes = np.tile(np.eye(3), (2, 1, 1))
    assert not surface.curvature_per_mm(xy, axes[:, 0], axes[:, 1]).any()


def test_a_print_keeps_its_lengths_on_the_surface() -> None:
    """Along the section through the vertex, 40 mm of paper cover 40 mm of arc."""
    focal, length = 150.0, 40.0
    curvature = Surface("paraboloid", 600.0, focal).curvature_per_mm(np.zeros(2), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
    x, y, z = bent_print_mm(np.array([[length, 0.0]]), curvature)[0]
    arc = quad(lambda r: np.hypot(1, r / (2 * focal)), 0, x)[0]
    # fifth order in length over radius of curvature: 40 (40/300)^4 / 10 = 0.001
    assert arc == pytest.approx(length, abs=2e-3)
    assert z == pytest.approx(x * x / (4 * focal), abs=0.03)
    assert y == 0
    # unbent, it would be 0.1 mm too long
    assert quad(lambda r: np.hypot(1, r / (2 * focal)), 0, length)[0] - length > 0.1


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        (("sphere",), "unknown surface 'sphere'; use one of plane, paraboloid"),
        (("paraboloid", 600.0), "a paraboloid needs focal_length_mm"),
        (("paraboloid", 600.0, -1.0), "focal_length_mm must lie between 0 and 100000 mm, not -1.0"),
        (("plane", 0.0), "diameter_mm must lie between"),
        (("paraboloid", 600.0, float("nan")), "focal_length_mm must lie between 0 and 100000 mm, not nan"),
    ],
)
def test_impossible_surfaces(fields: tuple, text: str) -> None:
    with pytest.raises(PatternError, match=text):
        Surface(*fields)


def test_parents_of_nested_circles() -> None:
    rings = concentric((10.0, 8.0, 6.0, 4.0))
    assert rings.parent.tolist() == [-1, 0, 1, 2]
    assert rings.outermost.tolist() == [0, 0, 0, 0]
    group = multi_circular()
    assert group.parent.tolist() == [-1, 0, -1, 2, -1, 4, -1, 6]
    assert group.outermost.tolist() == [0, 0, 2, 2, 4, 4, 6, 6]
    assert group.gap_mm == pytest.approx(4.0)
    assert group.extent_mm == pytest.approx(7 * np.sqrt(2) + 5)
    # two dark dots in one light hole
    dots = kind([(0, 0, 10, True), (0, 0, 8, False), (-3, 0, 2, True), (3, 0, 2, True)])
    assert dots.parent.tolist() == [-1, 0, 1, 1]
    assert dots.outermost.tolist() == [0, 0, 0, 0]


def test_what_a_kind_can_tell() -> None:
    assert disc().turns_freely
    assert ring().turns_freely
    assert not multi_circular().turns_freely
    assert not disc().has_light_edges
    assert whycon().has_light_edges
    assert disc().gap_mm == np.inf


@pytest.mark.parametrize(
    ("circles", "text"),
    [
        ([(0, 0, 5, True), (6, 0, 5, True)], "circles 0 and 1 of a target kind cross; they must be disjoint or nested"),
        ([(0, 0, 5, True), (3, 0, 3, False)], "circles 0 and 1 of a target kind cross"),
        ([(0, 0, 5, True), (0, 0, 5, False)], "circles 0 and 1 of a target kind cross"),
        ([(0, 0, 5, True), (0, 0, 3, True)], "circle 1 of a target kind has the colour of what surrounds it"),
        ([(0, 0, 5, False)], "circle 0 of a target kind has the colour of what surrounds it; nested circles alternate, outermost are dark"),
        ([(0, 0, 5, True), (0, 0, 4, False), (0, 0, 2, False)], "circle 2 of a target kind has the colour"),
        ([(0, 0, -5, True)], "radius_mm must lie between 0.01 and 100000, not -5.0"),
        ([(0, 0, 0.005, True)], "radius_mm must lie between 0.01 and 100000, not 0.005"),
        ([(0, 0, np.nan, True)], "radius_mm must lie between .* not nan"),
        ([(np.inf, 0, 5, True)], "center_mm must be finite"),
    ],
)
def test_impossible_kinds(circles: list, text: str) -> None:
    with pytest.raises(PatternError, match=text):
        kind(circles)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"ids": [3, 3]}, "target id 3 is given twice; ids must differ"),
        ({"ids": [3]}, "each target needs id, kind, center_mm, x_axis and normal"),
        ({"ids": [], "kind_names": (), "center_mm": [], "x_axis": [], "normal": []}, "at least one target"),
        ({"kind_names": ("disc", "ring")}, "target kind 'ring' is used but not defined; defined are disc"),
        ({"center_mm": [[0, 0, 0], [np.nan, 0, 0]]}, "center_mm must be finite and within 100000 mm"),
        ({"center_mm": [[0, 0, 0], [2e5, 0, 0]]}, "center_mm must be finite and within 100000 mm"),
        ({"center_mm": [[0, 0, 0], [4, 0, 0]]}, "targets 3 and 7 lie on top of each other"),
        ({"x_axis": [[1, 0, 0], [0, 0.99, 0]]}, "x_axis and normal of target 7 must be unit vectors at right angles"),
        ({"x_axis": [[0.6, 0, 0.8], [0, 1, 0]]}, "x_axis and normal of target 3 must be unit vectors at right angles"),
        ({"normal": [[0, 0, 1], [0, 0, np.nan]]}, "x_axis and normal of target 7"),
    ],
)
def test_impossible_patterns(changes: dict, text: str) -> None:
    with pytest.raises(PatternError, match=text):
        two_targets(**changes)


def test_axes_are_rotations_from_target_to_dish() -> None:
    pattern = dish(600.0, 300.0, 90.0)
    assert np.linalg.det(pattern.axes) == pytest.approx(np.ones(len(pattern)), abs=ROUNDING)
    np.testing.assert_allclose(pattern.axes[..., 0], pattern.x_axis)
    np.testing.assert_allclose(pattern.axes[..., 2], pattern.normal)
    # second target of `two_targets`: its x points along y, so its y points along -x
    assert two_targets().axes[1, :, 1].tolist() == [-1, 0, 0]
    assert two_targets().kind_of(1) is two_targets().kinds["disc"] or two_targets().kind_of(1).radius_mm.tolist() == [5.0]


def test_marks_of_a_plate_are_its_rings() -> None:
    pattern = plate(2, 2, 45.0)
    marks = pattern.marks
    assert marks.target.tolist() == np.repeat(np.arange(4), 4).tolist()
    np.testing.assert_allclose(marks.center_mm[:4, :2], pattern.center_mm[0, :2] + [[-7, -7], [7, -7], [7, 7], [-7, 7]])
    assert set(marks.radius_mm) == {5.0}
    assert set(marks.type_index) == {0}
    assert marks.type_ratios == ((0.6,),)


def test_marks_lie_on_the_dish_and_keep_their_distance() -> None:
    pattern = dish(600.0, 300.0, 90.0)
    marks = pattern.marks
    # third order along the geodesic: 10 mm (10/600)^3
    assert np.abs(marks.center_mm[:, 2] - pattern.surface.height_mm(marks.center_mm[:, :2])).max() < 1e-3
    chord = np.linalg.norm(marks.center_mm - pattern.center_mm[marks.target], axis=1)
    # a chord is shorter than its arc of 9.9 mm by 9.9^3 / 24 R^2, R from 600 mm on
    assert (np.hypot(7, 7) - chord >= 0).all()
    assert (np.hypot(7, 7) - chord).max() < 2e-4


def test_marks_that_look_different_are_of_different_types() -> None:
    base = plate(1, 5, 45.0)
    kinds = {"a": ring(5.0, 3.0), "b": ring(5.0, 3.0), "c": ring(4.0, 2.4), "d": disc(5.0), "e": odd_kind(disc(5.0))}
    marks = replace(base, kinds=kinds, kind_names=tuple("abcde")).marks
    assert marks.type_index[0] == marks.type_index[1]
    assert len(set(marks.type_index)) == 4
    ratios = [marks.type_ratios[t] for t in marks.type_index]
    assert ratios == [(0.6,), (0.6,), (0.6,), (), (pytest.approx(50 / 122, abs=1e-6),)]


def test_records_cannot_be_changed() -> None:
    pattern = two_targets()
    with pytest.raises(AttributeError):
        pattern.name = "other"  # type: ignore[misc]
    assert len(pattern) == 2


def squares(**changes: object) -> Pattern:
    """Two squares of 4 mm on a lattice of 12 mm."""
    square = Polygon([[-2.0, -2], [2, -2], [2, 2], [-2, 2]])
    kinds = {"disc": TargetKind(np.zeros((0, 2)), [], [], (square,))}
    return two_targets(**{"kinds": kinds, "lattice": [[0, 0], [1, 0]], **changes})


def crossings(**changes: object) -> Pattern:
    """Four crossings of two lines along x and two along y."""
    fields: dict = {
        "ids": [0, 1, 2, 3],
        "kinds": {"crossing": TargetKind(np.zeros((0, 2)), [], [])},
        "kind_names": ("crossing",) * 4,
        "center_mm": [[0.0, 0, 0], [12, 0, 0], [0, 12, 0], [12, 12, 0]],
        "x_axis": np.tile([1.0, 0, 0], (4, 1)),
        "normal": np.tile([0.0, 0, 1], (4, 1)),
        "lattice": [[0, 0], [1, 0], [0, 1], [1, 1]],
        "lines": [GridLine(ids, 1.0, 6.0) for ids in ((0, 1), (2, 3), (0, 2), (1, 3))],
    }
    return two_targets(**{**fields, **changes})


def test_grids_of_squares_and_of_lines() -> None:
    assert squares().is_grid
    assert crossings().is_grid
    assert not two_targets().is_grid
    assert squares().kind_of(0).extent_mm == pytest.approx(np.sqrt(8))
    assert crossings().kind_of(0).extent_mm == 0


@pytest.mark.parametrize(
    ("make", "changes", "text"),
    [
        (crossings, {"lattice": None}, "target 0 has no circles, so it belongs to a grid and needs its place in the lattice"),
        (crossings, {"lines": []}, "targets of kind 'crossing' have no ink and no lines cross there"),
        (crossings, {"lines": [GridLine((0, 1), 1.0)]}, "1 lines go through target 0; two cross at each target"),
        (crossings, {"lines": [GridLine((0, 9), 1.0)]}, "a line goes through target 9, which the pattern does not have"),
        (squares, {"lattice": [[0, 0], [0, 0]]}, r"two targets have the place \[0, 0\] in the lattice"),
        (squares, {"lattice": [[0, 0]]}, "each target of a grid needs its place"),
        (two_targets, {"lattice": [[0, 0], [1, 0]]}, "target 3 is made of circles; a pattern is made of circles or is a grid, not both"),
        (two_targets, {"lines": [GridLine((3, 7), 1.0)]}, "lines go through the targets of a grid"),
    ],
)
def test_impossible_grids(make, changes: dict, text: str) -> None:
    with pytest.raises(PatternError, match=text):
        make(**changes)


def squares_at(*parts: tuple[float, float, bool]) -> TargetKind:
    """Squares along x: where, their half side, and whether they are dark."""
    unit = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    return TargetKind(np.zeros((0, 2)), [], [], tuple(Polygon(half * unit + [x, 0], dark) for x, half, dark in parts))


def test_nested_and_disjoint_polygons() -> None:
    kind = squares_at((0.0, 4.0, True), (0.5, 2.0, False), (9.0, 1.0, True), (0.5, 1.0, True))
    assert kind.extent_mm == pytest.approx(np.hypot(10, 1))


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: GridLine((1,), 1.0), "two or more different targets"),
        (lambda: GridLine((1, 2, 1), 1.0), "two or more different targets"),
        (lambda: GridLine((1, 2), 0.0), "width_mm must lie between"),
        (lambda: GridLine((1, 2), 1.0, -1.0), "overhang_mm must lie between"),
        (lambda: Polygon([[0, 0], [1, 0]]), "three or more corners_mm"),
        (lambda: Polygon([[0, 0], [1, 0], [2, 0]]), "holds no ink"),
        (lambda: squares_at((0.0, 4.0, False)), "polygon 0 of a target kind has the colour of what surrounds it"),
        (lambda: squares_at((0.0, 4.0, True), (0.5, 1.0, True)), "polygon 1 of a target kind has the colour of what surrounds it"),
        (lambda: squares_at((0.0, 4.0, True), (3.0, 4.0, False)), "polygons 0 and 1 of a target kind cross"),
        (lambda: Surface("cylinder"), "a cylinder needs radius_mm"),
        (lambda: Surface("cylinder", radius_mm=0.0), "radius_mm must not be 0"),
    ],
)
def test_impossible_parts_of_grids(make, text: str) -> None:
    with pytest.raises(PatternError, match=text):
        make()


@pytest.mark.parametrize("radius_mm", [57.0, -57.0])
def test_cylinder(radius_mm: float) -> None:
    """A bulging cylinder's axis lies at z = -R, a hollow one's at z = +|R|; the normal is radial and has z > 0."""
    surface = Surface("cylinder", radius_mm=radius_mm)
    xy = np.array([[0.0, 3.0], [20.0, -8.0], [-50.0, 100.0]])
    axis = np.stack([np.zeros(3), xy[:, 1], np.full(3, -radius_mm)], axis=1)
    point = np.column_stack([xy, surface.height_mm(xy)])
    radial = (point - axis) * np.sign(radius_mm)
    assert np.abs(np.linalg.norm(radial, axis=1) - 57).max() < 1e-12
    assert np.abs(surface.normal(xy) - radial / 57).max() < 1e-12
    step = 1e-3
    for k, move in enumerate(np.eye(2) * step):
        rise = (surface.height_mm(xy + move) - surface.height_mm(xy - move)) / (2 * step)
        assert np.abs(surface.slope(xy)[:, k] - rise).max() < DIFFERENCE
        turn = (surface.slope(xy + move) - surface.slope(xy - move)) / (2 * step)
        assert np.abs(surface.bend_per_mm(xy)[..., k] - turn).max() < DIFFERENCE
    # along the circle a bulging surface bends away from its normal by 1/R, along the axis not at all
    along = np.cross([0.0, 1.0, 0.0], surface.normal(xy))
    bend = surface.curvature_per_mm(xy, along, np.tile([0.0, 1, 0], (3, 1)))
    assert np.abs(bend - np.diag([-1 / radius_mm, 0])).max() < 1e-12
    assert np.isnan(surface.height_mm(np.array([[60.0, 0]]))).all()
