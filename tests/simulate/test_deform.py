"""Displacement fields against their formulas, and the order in which a point is moved."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dishmap.errors import InputError
from dishmap.simulate.deform import Bump, Crease, Deformation, Gores, ZernikeTerm, deform, displacement_mm
from dishmap.targets.pattern import Surface
from dishmap.transforms import Pose

# Double precision on lengths of some hundred millimetres
EXACT_MM = 1e-10
DISH = Surface("paraboloid", 600.0, 300.0)


def test_fields_have_their_values_where_they_are_known() -> None:
    rim = np.array([[300.0, 0.0], [0.0, 300.0], [0.0, 0.0]])
    assert displacement_mm(Deformation(zernike=(ZernikeTerm(2, 2, 0.5),)), rim, 300.0) == pytest.approx([0.5, -0.5, 0], abs=EXACT_MM)
    assert displacement_mm(Deformation(zernike=(ZernikeTerm(2, 0, 0.5),)), rim, 300.0) == pytest.approx([0.5, 0.5, -0.5], abs=EXACT_MM)
    bump = Deformation(bumps=(Bump((10.0, 20.0), 5.0, -0.3),))
    assert displacement_mm(bump, [[10, 20], [13, 24]], 300.0) == pytest.approx([-0.3, -0.3 * np.exp(-0.5)], abs=EXACT_MM)
    crease = Deformation(creases=(Crease((10.0, 0.0), np.pi / 4, 3.0, 0.2),))
    assert displacement_mm(crease, [[60, 50], [10, 3 * np.sqrt(2)]], 300.0) == pytest.approx([0.2, 0.2 * np.exp(-0.5)], abs=EXACT_MM)
    gores = Deformation(gores=(Gores(8, -0.4),))
    angle = np.arange(8) * np.pi / 4
    ribs = 300 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    between = 150 * np.stack([np.cos(angle + np.pi / 8), np.sin(angle + np.pi / 8)], axis=-1)
    assert displacement_mm(gores, ribs, 300.0) == pytest.approx(np.zeros(8), abs=EXACT_MM)
    assert displacement_mm(gores, between, 300.0) == pytest.approx(np.full(8, -0.1), abs=EXACT_MM)


def test_fields_add_up() -> None:
    xy = np.array([[30.0, -20.0], [100.0, 50.0]])
    terms, bumps, gores = (ZernikeTerm(3, 1, 0.2),), (Bump((0.0, 0.0), 50.0, 0.1),), (Gores(6, 0.3),)
    parts = [Deformation(zernike=terms), Deformation(bumps=bumps), Deformation(gores=gores)]
    whole = Deformation(zernike=terms, bumps=bumps, gores=gores)
    assert displacement_mm(whole, xy, 300.0) == pytest.approx(sum(displacement_mm(part, xy, 300.0) for part in parts), abs=EXACT_MM)


@given(x=st.floats(-290, 290), y=st.floats(-50, 50), size_mm=st.floats(-3, 3), ppm=st.floats(-3000, 3000))
def test_points_grow_then_rise_towards_the_focus_then_move(x: float, y: float, size_mm: float, ppm: float) -> None:
    point = np.array([x, y, (x * x + y * y) / 1200])
    motion = Pose.from_rotation_vector([0.1, -0.2, 0.3], [5.0, 6.0, 7.0])
    state = Deformation(zernike=(ZernikeTerm(0, 0, size_mm),), expansion_ppm=ppm, slide="normal", motion=motion)
    moved = motion.inverse().apply(deform(state, DISH, point, 300.0))
    normal = np.array([-x / 600, -y / 600, 1.0])
    expected = point * (1 + ppm * 1e-6) + size_mm * normal / np.linalg.norm(normal)
    assert moved == pytest.approx(expected, abs=EXACT_MM)
    if abs(size_mm) > 1e-3 and ppm == 0:
        # a positive piston brings every point nearer to the focus
        focus = np.array([0.0, 0.0, 300.0])
        assert (np.linalg.norm(moved - focus) < np.linalg.norm(point - focus)) == (size_mm > 0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ZernikeTerm(2, 1, 0.1), "there is no Zernike term n=2, m=1"),
        (lambda: ZernikeTerm(2, 2, float("nan")), "a Zernike term needs a finite size_mm, not nan"),
        (lambda: Bump((0.0, 0.0), 0.0, 0.1), r"a bump needs a positive sigma_mm, not 0\.0"),
        (lambda: Bump((0.0, np.inf), 1.0, 0.1), "a bump needs a finite center_y_mm, not inf"),
        (lambda: Crease((0.0, 0.0), 0.0, -1.0, 0.1), r"a crease needs a positive sigma_mm, not -1\.0"),
        (lambda: Gores(1, 0.1), "gores need a count of at least 2 ribs, not 1"),
        (lambda: Deformation(expansion_ppm=1e6), r"expansion_ppm must lie within \+-50000 parts per million, not 1000000\.0"),
    ],
)
def test_impossible_fields_are_refused(make, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match=message):
        make()
