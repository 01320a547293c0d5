"""The subreflector as a surface: foci, derivatives, reflection; what is moved and bent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.antenna import Actuators, Antenna, Feed, Reflector, Subreflector, sub_vertex_z_mm
from dishmap.rf.correction import Correction, no_correction, shape_terms
from dishmap.rf.subreflector import lit_disc, nominal_reflection, patch, rim_disc, shape_heights, sub_surface

Array = NDArray[np.float64]

# rounding of distances of a few hundred mm
ROUNDING_MM = 1e-10
# central differences with steps of 1e-3 mm of surfaces whose third derivatives stay under 1e-3 / mm^2
DIFFERENCE = 1e-6
KINDS = ["cassegrain", "gregorian"]


def antenna(kind: str, magnification: float = 4.0, offset_mm: float = 0.0, degree: int = 0, foci_mm: float = 220.0) -> Antenna:
    actuators = Actuators(shape_degree=degree, shape_stroke_mm=3.0) if degree else Actuators()
    return Antenna(Reflector(600, 300, offset_mm), Feed("gaussian", 12.0), Subreflector(kind, foci_mm, magnification), actuators=actuators)


def moved(whole: Antenna, seed: int = 3, bent_mm: float = 0.1) -> Correction:
    rng = np.random.default_rng(seed)
    bend = rng.normal(0, bent_mm, len(shape_terms(whole.actuators)))
    return Correction(rng.normal(0, 3, 3), rng.normal(0, 1, 2), bend)


@given(st.sampled_from(KINDS), st.floats(1.5, 50), st.floats(20, 290), st.floats(0, 6.28), st.floats(0, 1))
def test_the_conic_has_its_foci(kind: str, magnification: float, foci: float, azimuth: float, share: float) -> None:
    whole = antenna(kind, magnification, foci_mm=foci)
    surface = sub_surface(whole, no_correction(whole))
    rho = share * rim_disc(whole.reflector, whole.subreflector)[1]  # type: ignore[arg-type]
    q = patch(surface, rho * np.array([[np.cos(azimuth), np.sin(azimuth)]])).point_mm[0]
    to_f1, to_f2 = np.linalg.norm(q - [0, 0, 300.0]), np.linalg.norm(q - [0, 0, 300.0 - foci])
    c = foci / 2
    # hyperboloid: r2 - r1 = 2 a = 2 c / e; ellipsoid: r1 + r2 = 2 a
    m = magnification
    constant = foci * (m - 1) / (m + 1) if kind == "cassegrain" else foci * (m + 1) / (m - 1)
    assert (to_f2 - to_f1 if kind == "cassegrain" else to_f1 + to_f2) == pytest.approx(constant, abs=ROUNDING_MM * (1 + constant / c))
    # equivalent focal length: tan(feed angle / 2) = tan(psi / 2) / M
    psi = np.arctan2(rho, abs(300.0 - q[2])) if kind == "gregorian" else np.arctan2(rho, 300.0 - q[2])
    seen = np.arctan2(rho, q[2] - 300.0 + foci)
    assert np.tan(seen / 2) == pytest.approx(np.tan(psi / 2) / m, abs=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_the_vertex_lies_where_drawings_put_it(kind: str) -> None:
    """By hand: c = 110, M = 4: a = 110 * 3/5 = 66 (hyperboloid), 110 * 5/3 = 183.33 (ellipsoid); the middle is at z = 190."""
    sub = Subreflector(kind, 220.0, 4.0)
    assert sub_vertex_z_mm(Reflector(600, 300), sub) == pytest.approx(256.0 if kind == "cassegrain" else 190 + 550 / 3)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("degree", [0, 2, 6])
@pytest.mark.parametrize("offset", [0.0, 380.0])
def test_derivatives_against_differences(kind: str, degree: int, offset: float) -> None:
    whole = antenna(kind, offset_mm=offset, degree=degree)
    surface = sub_surface(whole, moved(whole))
    rng = np.random.default_rng(1)
    xy = rng.uniform(-0.6, 0.6, (40, 2)) * surface.radius_mm + [surface.center_mm, 0.0]
    here, step = patch(surface, xy), 1e-3
    for k, d in enumerate(step * np.eye(2)):
        before, after = patch(surface, xy - d), patch(surface, xy + d)
        assert np.abs((after.point_mm - before.point_mm) / (2 * step) - here.first[:, :, k]).max() < DIFFERENCE
        assert np.abs((after.first - before.first) / (2 * step) - here.bend[:, None, :, k] * here.axis[:, None]).max() < DIFFERENCE


@pytest.mark.parametrize("kind", KINDS)
def test_shape_terms_bend_along_its_axis(kind: str) -> None:
    whole = antenna(kind, degree=4)
    flat = moved(whole, bent_mm=0.0)
    xy = np.random.default_rng(2).uniform(-30, 30, (20, 2))
    for t in range(len(flat.shape_mm)):
        shape = np.zeros_like(flat.shape_mm)
        shape[t] = 0.7
        moves = patch(sub_surface(whole, Correction(flat.shift_mm, flat.tilt_deg, shape)), xy).point_mm
        still = patch(sub_surface(whole, flat), xy).point_mm
        surface = sub_surface(whole, flat)
        heights = shape_heights(surface, xy)[:, t]
        assert np.abs(moves - still - 0.7 * heights[:, None] * surface.rotation[:, 2]).max() < ROUNDING_MM
    # defocus is -1 in the middle, +1 at the rim, along z
    surface = sub_surface(whole, no_correction(whole))
    defocus = shape_heights(surface, np.array([[0.0, 0.0], [0.0, surface.radius_mm]]))[:, shape_terms(whole.actuators).index((2, 0))]
    assert np.abs(defocus - [-1, 1]).max() < ROUNDING_MM


def test_tilts_turn_about_the_vertex_by_the_right_hand() -> None:
    whole = antenna("cassegrain")
    surface = sub_surface(whole, Correction(np.array([1.0, 2.0, 3.0]), np.array([2.0, 0.0]), np.zeros(0)))
    q = patch(surface, np.array([[0.0, 0.0], [0.0, 1e-3]])).point_mm
    assert np.abs(q[0] - [1, 2, 259]).max() < ROUNDING_MM
    # a positive turn about x takes y towards z
    assert (q[1, 2] - q[0, 2]) / (q[1, 1] - q[0, 1]) == pytest.approx(np.tan(np.radians(2)), abs=1e-4)


@given(st.sampled_from(KINDS), st.floats(0, 0.999), st.floats(0, 6.28), st.sampled_from([0.0, 350.0, -380.0]), st.floats(1.6, 20))
def test_nominal_rays_obey_the_law_of_reflection(kind: str, share: float, azimuth: float, offset: float, magnification: float) -> None:
    whole = antenna(kind, magnification, offset)
    assert whole.subreflector is not None
    x, y = np.array([offset, 0]) + 300 * share * np.array([np.cos(azimuth), np.sin(azimuth)])
    p = np.array([[x, y, (x**2 + y**2) / 1200]])
    q = nominal_reflection(whole.reflector, whole.subreflector, p)
    here = patch(sub_surface(whole, no_correction(whole)), q[:, :2])
    assert np.abs(here.point_mm - q).max() < 1e-8
    normal = np.cross(here.first[0, :, 0], here.first[0, :, 1])
    normal /= np.linalg.norm(normal)
    a, b = q[0] - [0, 0, 80.0], p[0] - q[0]
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    assert np.abs(a - 2 * (a @ normal) * normal - b).max() < 1e-9


def test_the_rim_is_the_one_that_rays_need_unless_given() -> None:
    center, radius = rim_disc(Reflector(600, 300), Subreflector("cassegrain", 220, 4))
    # by hand: the rim is seen at psi = 2 atan(300 / 600), r = l / (1 + e cos psi) with l = 66 (e^2 - 1), e = 5/3
    psi = 2 * np.arctan(0.5)
    assert radius == pytest.approx(66 * (25 / 9 - 1) / (1 + 5 / 3 * np.cos(psi)) * np.sin(psi))
    assert center == pytest.approx(0, abs=ROUNDING_MM)
    assert rim_disc(Reflector(600, 300), Subreflector("cassegrain", 220, 4, 70.0))[1] == 35.0
    assert (
        rim_disc(Reflector(600, 300, 380.0), Subreflector("gregorian", 220, 4))[0]
        < 0
        < rim_disc(Reflector(600, 300, 380.0), Subreflector("cassegrain", 220, 4))[0]
    )


def test_no_hyperboloid_reaches_the_rim_of_a_very_deep_dish() -> None:
    with pytest.raises(InputError, match=r"magnification 1.4 .*give a magnification over 2.25"):
        Antenna(Reflector(600, 100), Feed("gaussian", 12.0), Subreflector("cassegrain", 50, 1.4))
    with pytest.raises(InputError, match=r"behind the vertex of the dish"):
        Antenna(Reflector(600, 300), Feed("gaussian", 12.0), Subreflector("cassegrain", 3000, 8))


@pytest.mark.parametrize(("kind", "offset"), [("cassegrain", 0.0), ("gregorian", 0.0), ("cassegrain", 340.0), ("gregorian", 340.0)])
def test_a_rim_smaller_than_needed_lights_a_smaller_disc(kind: str, offset: float) -> None:
    whole = antenna(kind, offset_mm=offset)
    assert whole.subreflector is not None
    center, needed = rim_disc(whole.reflector, whole.subreflector)
    for share in (1.0, 1.2):
        middle, radius = lit_disc(replace(whole, subreflector=replace(whole.subreflector, diameter_mm=2 * share * needed)))
        assert (middle[0], middle[1], radius) == (offset, 0.0, 300.0)
    small = replace(whole, subreflector=replace(whole.subreflector, diameter_mm=1.6 * needed))
    middle, radius = lit_disc(small)
    assert radius < 270
    # rays to the edges of the disc in the plane of symmetry meet the subreflector at its rim
    x = middle[0] + np.array([-radius, radius])
    at = nominal_reflection(whole.reflector, whole.subreflector, np.stack([x, 0 * x, x**2 / 1200], axis=1))
    assert np.sort(at[:, 0]) == pytest.approx([center - 0.8 * needed, center + 0.8 * needed], abs=1e-9)
