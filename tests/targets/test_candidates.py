from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import WIDE

from dishmap.camera.model import Camera
from dishmap.targets.builders import concentric, disc, ring
from dishmap.targets.candidates import mark_candidates
from dishmap.targets.detect import Detections
from dishmap.targets.ellipses import enclosing
from dishmap.targets.layout import layout_of
from dishmap.targets.markgrid import MarkGrid, meet_surface
from dishmap.targets.pattern import Pattern, Surface, TargetKind
from dishmap.targets.rigid import tangent_axes

Array = NDArray[np.float64]

CAMERA = Camera(1000, 800, [900.0, 900.0], [500.0, 400.0])
# Rounding of a quadratic equation whose terms are of the order of the distance.
MEETS_MM = 1e-6


def pattern_of(*kinds: TargetKind) -> Pattern:
    n = len(kinds)
    center = np.array([[60.0 * i, 0.0, 0.0] for i in range(n)])
    names = [str(i) for i in range(n)]
    axes = np.tile([[1.0, 0, 0]], (n, 1)), np.tile([[0, 0, 1.0]], (n, 1))
    return Pattern("p", Surface(), dict(zip(names, kinds, strict=True)), np.arange(n), names, center, *axes)


def drawn(*circles: tuple[float, float, bool], contrast: float = 100.0, at: tuple[float, float] = (400.0, 300.0)) -> Detections:
    """Circles (radius px, contrast as a part, dark) about one place."""
    radius, part, dark = (np.array(c) for c in zip(*circles, strict=True))
    center, axes = np.tile(at, (len(radius), 1)), np.stack([radius, radius], axis=1)
    zeros = np.zeros(len(radius))
    return Detections(center, axes, zeros, dark.astype(bool), enclosing(center, axes, zeros), contrast * part, zeros)


def test_type_is_told_by_what_lies_inside() -> None:
    marks = pattern_of(disc(5.0), ring(5.0, 3.0), concentric((10.0, 8.0, 6.0, 4.0))).marks
    ratios = marks.type_ratios
    plain, hollow, double = (ratios.index(r) for r in ((), (0.6,), (0.8, 0.6, 0.4)))
    expected = {
        plain: drawn((30, 1, True)),
        hollow: drawn((30, 1, True), (18, 1, False)),
        double: drawn((40, 1, True), (32, 1, False), (24, 1, True), (16, 1, False)),
    }
    for column, detections in expected.items():
        found = mark_candidates(detections, marks, CAMERA)
        assert found.detection.tolist() == [0]
        assert found.is_type[0].tolist() == [k == column for k in range(3)]


def test_dirt_in_a_disc_is_no_hole_but_a_print_is() -> None:
    marks = pattern_of(disc(5.0)).marks
    assert mark_candidates(drawn((30, 1, True), (4, 1, False)), marks, CAMERA).is_type.all()
    assert mark_candidates(drawn((30, 1, True), (12, 0.2, False)), marks, CAMERA).is_type.all()
    assert len(mark_candidates(drawn((30, 1, True), (12, 1, False)), marks, CAMERA)) == 0


def test_hole_may_only_be_missing_where_blur_or_glare_can_close_it() -> None:
    marks = pattern_of(ring(5.0, 3.0)).marks
    large = mark_candidates(drawn((30, 1, True)), marks, CAMERA)
    assert not large.is_type.any()
    assert large.may_be_type.all()
    small = mark_candidates(drawn((6, 1, True)), marks, CAMERA)
    assert small.is_type.all()


def test_circles_of_a_whole_mark_are_no_marks_themselves() -> None:
    marks = pattern_of(disc(5.0), concentric((10.0, 8.0, 6.0, 4.0))).marks
    found = mark_candidates(drawn((40, 1, True), (32, 1, False), (24, 1, True), (16, 1, False)), marks, CAMERA)
    assert found.detection.tolist() == [0]


def test_shape_is_the_ellipse_in_tangents_of_angles() -> None:
    """A circle straight ahead of a pinhole spans radius over focal length."""
    found = mark_candidates(drawn((9, 1, True), at=(500.0, 400.0)), pattern_of(disc(5.0)).marks, CAMERA)
    assert found.shape[0] == pytest.approx(np.eye(2) * 0.01)
    assert np.linalg.det(found.px_per_tangent[0]) == pytest.approx(900.0**2)


@given(st.floats(20, 980), st.floats(20, 730))
def test_tangent_axes_are_right_handed_with_the_ray(u: float, v: float) -> None:
    ray = WIDE.unproject(np.array([[u, v]]))
    axes = tangent_axes(ray)[0]
    whole = np.column_stack([axes, ray[0]])
    assert whole @ whole.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(whole) == pytest.approx(1.0)
    step = WIDE.project(ray[0] + 1e-3 * axes.T) - [u, v]
    # the first axis runs with u, the second with v
    assert step[0, 0] > 0 < step[1, 1]


@given(st.floats(-250, 250), st.floats(-250, 250), st.floats(-600, 600), st.floats(50, 900), st.booleans())
def test_rays_meet_the_front_of_the_surface(x: float, y: float, off: float, height: float, flat: bool) -> None:
    surface = Surface() if flat else Surface("paraboloid", 600.0, 300.0)
    place = np.array([x, y, float(surface.height_mm(np.array([x, y])))])
    eye = np.array([off, -0.5 * off, height + 100.0])
    ray = (place - eye) / np.linalg.norm(place - eye)
    if ray @ surface.normal(place[:2]) > -0.05:
        return
    t = meet_surface(surface, eye, ray)
    assert eye + t * ray == pytest.approx(place, abs=MEETS_MM * (1 + abs(off) + height))


def test_rays_that_pass_the_surface_by_meet_nothing() -> None:
    assert np.isnan(meet_surface(Surface(), np.array([0.0, 0, 100]), np.array([0.0, 0, 1])))
    assert np.isnan(meet_surface(Surface("paraboloid", 600.0, 300.0), np.array([0.0, 0, -50]), np.array([1.0, 0, 0])))


def test_grid_finds_the_mark_within_reach_and_no_other() -> None:
    rng = np.random.default_rng(1)
    layout = layout_of(pattern_of(*[disc(5.0)] * 9))
    grid = MarkGrid(layout, 15.0)
    places = np.column_stack([rng.uniform(-50, 550, 400), rng.uniform(-40, 40, 400), rng.uniform(-5, 5, 400)])
    distance = np.linalg.norm(places[:, None] - layout.center_mm, axis=2)
    expected = np.where(distance.min(axis=1) <= 15.0, distance.argmin(axis=1), -1)
    assert (grid.nearest(places) == expected).all()
    assert 20 < (expected >= 0).sum() < 200
    assert grid.nearest(np.array([[np.nan, 0.0, 0.0]])).tolist() == [-1]
