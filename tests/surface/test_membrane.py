"""Displacement fields on the surface and how a membrane slides: against differences, rigid motions and a sphere's closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dishmap.surface.membrane import Fields, bent, disc_points, membrane, sliding, tangent_axes
from dishmap.targets.pattern import Surface
from dishmap.transforms import rotation_from_vector

DISH = Surface("paraboloid", 600.0, 300.0)
FLAT = Surface("plane", 600.0)
# Central differences over 1e-3 mm of fields that bend over 100 mm: truncation 1e-9, rounding 1e-10 of a unit displacement.
DIFFERENCE = 1e-7
STEP_MM = 1e-3


def surface_points(surface: Surface, xy: np.ndarray) -> np.ndarray:
    return np.concatenate([xy, surface.height_mm(xy)[:, None]], axis=1)


@pytest.mark.parametrize("surface", [DISH, FLAT])
@pytest.mark.parametrize("axial", [False, True])
def test_gradients_are_those_of_the_moves(surface: Surface, axial: bool) -> None:
    fields = Fields(surface, 300.0, 5)
    xy = np.array([[10.0, -20.0], [150.0, 80.0], [-200.0, 120.0]])
    axes = tangent_axes(surface, xy)
    at = fields.axial if axial else fields.at
    for k in range(2):
        step = STEP_MM * axes[:, :2, k]
        ends = [at(xy + sign * step, tangent_axes(surface, xy + sign * step)).move for sign in (1, -1)]
        assert (ends[0] - ends[1]) / (2 * STEP_MM) == pytest.approx(at(xy, axes).gradient[:, :, k], abs=DIFFERENCE)


@pytest.mark.parametrize("surface", [DISH, FLAT])
def test_the_disc_rule_integrates_polynomials_exactly(surface: Surface) -> None:
    xy, weight = disc_points(2.0, 8)
    # over a disc of radius R: area pi R^2; x^2: pi R^4 / 4; x^4 y^4: 3 pi R^10 / 640
    assert weight.sum() == pytest.approx(4 * np.pi, rel=1e-12)
    assert weight @ xy[:, 0] ** 2 == pytest.approx(4 * np.pi, rel=1e-12)
    assert weight @ (xy[:, 0] ** 4 * xy[:, 1] ** 4) == pytest.approx(3 * np.pi * 2**10 / 640, rel=1e-12)


def test_rigid_motions_stretch_nothing() -> None:
    """A translation and a turn, written in the fields, have no strain energy."""
    fields = Fields(DISH, 300.0, 14)
    form = membrane(fields)
    xy, _ = disc_points(290.0, 30)
    axes = tangent_axes(DISH, xy)
    points = surface_points(DISH, xy)
    move = fields.at(xy, axes).move.reshape(3 * len(xy), -1)
    for wanted in (np.tile([1.0, 0, 0], (len(xy), 1)), np.cross([0, 1e-2, 0], points), np.cross([0, 0, 1e-2], points)):
        found = np.linalg.lstsq(move, wanted.ravel(), rcond=None)[0]
        assert np.abs(move @ found - wanted.ravel()).max() < 1e-4 * np.abs(wanted).max()
        # a strain of 1e-7 would be 0.03 micrometres over the dish
        assert found @ form.energy @ found < 1e-14


def test_a_slide_has_less_strain_than_any_other() -> None:
    fields = Fields(DISH, 300.0, 6)
    form, count = membrane(fields), len(fields.normal_terms)
    slide = sliding(form, count)
    rng = np.random.default_rng(4)
    along = rng.standard_normal(count)
    best = np.concatenate([along, slide @ along])
    energy = best @ form.energy @ best
    for _ in range(20):
        other = best.copy()
        change = rng.standard_normal(slide.shape[0]) * 0.1
        # other slides that stay in place on the whole
        held = form.held[:, count:]
        change -= np.linalg.pinv(held) @ (held @ change)
        other[count:] += change
        assert other @ form.energy @ other > energy
    assert form.held[:, count:] @ best[count:] == pytest.approx(0.0, abs=1e-9)


def test_a_flat_membrane_does_not_slide() -> None:
    fields = Fields(FLAT, 300.0, 5)
    assert np.abs(sliding(membrane(fields), len(fields.normal_terms))).max() < 1e-10


def test_a_spherical_cap_under_uniform_lift_slides_as_its_closed_form() -> None:
    """A shallow cap of radius R lifted by w everywhere: strain -w/R per axis; the slide u = w r / R relieves all of it.

    Shallow shells: e_rr = u' - w/R, e_tt = u/r - w/R (Timoshenko and Woinowsky-Krieger, Theory of Plates and Shells, 1959, section 108).
    """
    shallow = Surface("paraboloid", 20.0, 500.0)
    fields = Fields(shallow, 10.0, 4)
    count = len(fields.normal_terms)
    along = np.zeros(count)
    along[0] = 1.0
    found = np.concatenate([along, sliding(membrane(fields), count) @ along])
    xy = np.array([[2.0, 0.0], [0.0, 7.0], [-3.0, 4.0]])
    move = fields.at(xy, tangent_axes(shallow, xy)).move @ found
    # the slope at the rim is 0.01, so terms of its square are left out: 1e-4 of the slide
    assert move[:, :2] + xy / 1000.0 == pytest.approx(xy / 1000.0, abs=2e-6)


@given(turn=st.tuples(*[st.floats(-0.5, 0.5)] * 3), a=st.floats(-0.01, 0.01), b=st.floats(-0.01, 0.01), c=st.floats(-0.01, 0.01))
def test_bending_is_taken_apart_exactly(turn: tuple[float, float, float], a: float, b: float, c: float) -> None:
    """A stretch followed by a rotation, both recovered."""
    axes = tangent_axes(DISH, np.array([[120.0, -60.0]]))
    strain = np.array([[a, c], [c, b]])
    rotation = rotation_from_vector(np.array(turn))
    deformed = rotation @ axes[0] @ (np.eye(2) + strain)
    found_turn, found = bent((deformed - axes[0])[None], axes)
    frame = np.concatenate([axes[0], np.cross(axes[0, :, 0], axes[0, :, 1])[:, None]], axis=1)
    assert found[0] == pytest.approx(strain, abs=1e-12)
    assert frame @ found_turn[0] @ frame.T == pytest.approx(rotation, abs=1e-12)
