"""Corrections: what a displaced subreflector causes is undone, what none can cause stays, limits hold, and wraps are climbed over."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from dishmap.errors import FitError, InputError
from dishmap.rf import sources as nodes
from dishmap.rf.antenna import Actuators
from dishmap.rf.beam import peak
from dishmap.rf.correct import CorrectionFound, best_correction, judged
from dishmap.rf.correction import correction_of, no_correction
from dishmap.rf.deformation import Deformation, undeformed
from dishmap.rf.farfield import far_field
from dishmap.rf.sources import illuminated, sampled, sources_after
from dishmap.surface.zernike import zernike_matrix, zernike_terms
from tests.rf.dishes import CASSEGRAIN, PRIME, SHAPED, bent, half_path_mode, undone_by

WAVELENGTHS_MM = np.array([299.792458 / 30.0])
# what is left after undoing something that the actuators can do: the ridge on the actuators and second orders of the path
UNDONE_DB = 0.01
# the searched and the judged gain are one integral on different nodes
CHECK_DB = 1e-6
# where a bend nearly focuses light on a spot of the dish, the fewer nodes of the search see less of it
BENT_CHECK_DB = 0.02
# reference losses were computed with half-path errors in the aperture plane and another taper's shape
REFERENCE_DB = 0.03
# the ridge costs this for each actuator at its full stroke
RIDGE_DB = 0.03
# bends of two degrees are told apart by the ridge and the ends of climbs
SAME_DB = 1e-3
WIDE = replace(PRIME, actuators=Actuators(shift_mm=(40.0, 40.0, 40.0)))


def ideal_dbi(antenna=CASSEGRAIN) -> float:
    return float(judged(antenna, undeformed(antenna.reflector), no_correction(antenna), WAVELENGTHS_MM, True)[0][0])


def loss(found: CorrectionFound, antenna=CASSEGRAIN) -> tuple[float, float]:
    return ideal_dbi(antenna) - found.before_dbi[0], ideal_dbi(antenna) - found.after_dbi[0]


@pytest.mark.parametrize(
    ("antenna", "values"),
    [
        (PRIME, [0.0, 0.0, 2.0, 0.0, 0.0]),
        (PRIME, [3.0, -1.0, 1.0, 0.0, 0.0]),
        (CASSEGRAIN, [0.0, 0.0, 2.0, 0.0, 0.0]),
        (CASSEGRAIN, [0.5, 0.3, -1.0, 0.3, -0.2]),
    ],
)
def test_what_a_displaced_subreflector_causes_is_undone(antenna, values) -> None:
    found = best_correction(antenna, undone_by(np.array(values), antenna), [30.0])
    before, after = loss(found, antenna)
    assert before > 3 * UNDONE_DB or abs(values[2]) < 2
    assert after < UNDONE_DB
    assert found.converged
    assert found.improved or before < UNDONE_DB
    assert np.abs(found.check_db).max() < CHECK_DB


def test_a_subreflector_that_is_out_of_place_by_a_known_shift_is_sent_there() -> None:
    found = best_correction(CASSEGRAIN, undone_by(np.array([0.0, 0.0, 2.0, 0.0, 0.0]), CASSEGRAIN), [30.0])
    # nearer to the dish the light is more even, which is worth a tenth of a millimetre of phase
    assert found.correction.shift_mm[2] == pytest.approx(2.0, abs=0.2)
    assert found.names[2] == "shift_z"
    assert found.units[2] == "mm"


@pytest.mark.parametrize(
    ("n", "m", "before", "after"),
    [(2, 0, 1.61, 0.0), (3, 1, 1.50, None), (4, 0, 1.85, 1.52), (2, 2, 1.15, 1.15), (3, 3, 1.03, 1.03)],
)
def test_half_a_millimetre_of_one_mode_costs_and_keeps_what_the_reference_says(n, m, before, after) -> None:
    found = best_correction(PRIME, half_path_mode(n, m, 0.5), [30.0])
    measured = loss(found, PRIME)
    assert measured[0] == pytest.approx(before, abs=REFERENCE_DB)
    # coma of this size needs 40 mm of the feed, which has 10
    if after is None:
        assert "shift_x" in found.limits
    else:
        # a feed's shift makes a path of cos(theta), not exactly the mode: the reference has the mode cancelled
        assert measured[1] == pytest.approx(after, abs=0.04)


@pytest.mark.parametrize("terms", [{"z22": 1.0}, {"z33": 1.0}, {"z3m3": 0.6, "z2m2": -0.6}])
def test_a_subreflector_that_bends_recovers_what_no_pose_does(terms) -> None:
    deformation = bent(**terms)
    rigid = best_correction(SHAPED, deformation, [30.0], shape=False)
    shaped = best_correction(SHAPED, deformation, [30.0])
    before, after = loss(shaped)
    assert before > 0.3
    assert loss(rigid)[1] > 0.95 * before
    # bending moves light, which costs some
    assert after < 0.35 * before
    assert abs(shaped.lost_share) < 0.02
    assert np.abs(shaped.check_db).max() < BENT_CHECK_DB


@pytest.mark.parametrize("terms", [{"z22": 0.5, "z20": 0.4, "z33": 0.3, "z31": 0.2, "z40": 0.15}, {"z44": 0.3, "z2m2": 0.4}])
def test_a_higher_degree_never_gives_less(terms) -> None:
    gains = [best_correction(CASSEGRAIN, bent(**terms), [30.0]).after_dbi[0]]
    for degree in (2, 3, 4):
        found = best_correction(replace(CASSEGRAIN, actuators=Actuators(shape_degree=degree, shape_stroke_mm=3.0)), bent(**terms), [30.0])
        assert found.after_dbi[0] > gains[-1] - SAME_DB
        gains.append(found.after_dbi[0])
    # most of what is left by the best pose is won back, and no antenna better than the one designed is made of it
    assert gains[-1] - gains[0] > 0.5 * (ideal_dbi() - gains[0])
    assert gains[-1] < ideal_dbi() + 0.05


def test_a_bend_is_judged_the_same_on_twice_the_nodes(monkeypatch) -> None:
    deformation = bent(z22=0.7, z31=0.3)
    found = best_correction(SHAPED, deformation, [30.0])
    monkeypatch.setattr(nodes, "RINGS", tuple(2 * v for v in nodes.RINGS))
    monkeypatch.setattr(nodes, "SPOKES", tuple(2 * v for v in nodes.SPOKES))
    again, _ = judged(SHAPED, deformation, found.correction, WAVELENGTHS_MM, True)
    assert again == pytest.approx(found.after_dbi, abs=CHECK_DB)


@pytest.mark.parametrize("terms", [{"z22": 1.0}, {"z33": 1.0}])
def test_what_no_pose_undoes_gets_none(terms) -> None:
    found = best_correction(CASSEGRAIN, bent(**terms), [30.0])
    assert not found.improved
    assert not found.correction.values.any()
    assert np.array_equal(found.after_dbi, found.before_dbi)


def test_limits_hold_and_are_named() -> None:
    tight = replace(CASSEGRAIN, actuators=Actuators(shift_mm=(1.0, 1.0, 0.5), tilt_deg=(0.0, 0.0)))
    found = best_correction(tight, bent(z20=0.5), [30.0])
    assert found.limits == ("shift_z",)
    assert abs(found.correction.shift_mm[2]) == pytest.approx(0.5)
    assert not found.correction.tilt_deg.any()
    assert found.improved


def test_the_stroke_of_a_bending_subreflector_holds_everywhere_and_is_named() -> None:
    tight = replace(SHAPED, actuators=Actuators(shape_degree=4, shape_stroke_mm=0.2))
    found = best_correction(tight, bent(z22=1.0), [30.0])
    assert "shape_stroke" in found.limits
    rho, phi = np.meshgrid(np.linspace(0, 1, 101), np.linspace(0, 2 * np.pi, 361))
    terms = tuple(t for t in zernike_terms(4) if t[0] > 1)
    height = zernike_matrix(terms, (rho * np.cos(phi)).ravel(), (rho * np.sin(phi)).ravel()) @ found.correction.shape_mm
    # a fan of this density misses less than a thousandth of the stroke
    assert np.abs(height).max() <= 0.2 * 1.001
    assert np.abs(height).max() > 0.15


def test_an_undeformed_dish_needs_no_correction() -> None:
    found = best_correction(SHAPED, undeformed(SHAPED.reflector), [30.0, 12.5])
    assert not found.improved
    assert not found.correction.values.any()
    assert found.limits == ()


def test_feed_tilts_that_only_shift_the_light_stay_small() -> None:
    found = best_correction(PRIME, bent(z20=0.3), [30.0])
    # degrees of 3: the ridge holds back what gains under a thousandth of a dB
    assert np.abs(found.correction.tilt_deg).max() < 0.01
    assert np.abs(found.correction.shift_mm[:2]).max() < 0.01


def test_several_wraps_are_climbed_over() -> None:
    # at 30 GHz the path errors span 2.4 wavelengths: least squares, and climbs from where things are, end on lower maxima
    deformation = bent(z22=6.0, z31=2.0)
    found = best_correction(WIDE, deformation, [30.0])
    assert found.starts > 10
    assert found.spread_db > 0.5
    # brute force ascends the full gain itself, without a ridge, from a coarse grid over what matters by symmetry
    best = max(ascended(deformation, np.array([x, 0.0, z, 0.0, 0.0])) for x in (-15, 0) for z in (-30, 0, 30))
    assert found.after_dbi[0] > best - RIDGE_DB
    assert found.after_dbi[0] > found.before_dbi[0] + 2.0


def ascended(deformation: Deformation, start: np.ndarray) -> float:
    """The best gain on the way uphill from one place, by a simplex."""

    def cost(move):
        values = np.clip(start + [move[0], 0.0, move[1], 0.0, move[2]], -40.0, 40.0)
        values[3:] = np.clip(values[3:], -3.0, 3.0)
        dish = illuminated(WIDE, deformation, sampled(WIDE, deformation, 10.0))
        currents = sources_after(WIDE, dish, correction_of(values))
        u = np.linspace(-0.05, 0.05, 24)
        field = far_field(currents, WAVELENGTHS_MM[0], u, np.zeros(24), "x")[0]
        with suppress(FitError):
            uv = peak(currents, WAVELENGTHS_MM[0], (float(u[np.argmax(np.abs(field))]), 0.0), "x")
            field = far_field(currents, WAVELENGTHS_MM[0], uv[:1], uv[1:], "x")[0]
        return -20 * np.log10(np.abs(field).max())

    simplex = np.array([[0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 1.0]])
    return -minimize(cost, np.zeros(3), method="Nelder-Mead", options={"maxfev": 40, "initial_simplex": simplex}).fun


def test_one_correction_serves_several_frequencies() -> None:
    told: list[tuple[int, int]] = []
    found = best_correction(PRIME, bent(z20=0.5, z31=0.2), [12.5, 30.0], progress=lambda done, count: told.append((done, count)))
    assert found.after_uv.shape == (2, 2)
    assert (found.after_dbi > found.before_dbi).all()
    assert told[-1][0] == told[-1][1]


def test_fixed_pointing_counts_the_boresight() -> None:
    found = best_correction(PRIME, bent(z11=0.5, z20=0.3), [30.0], pointing="fixed")
    assert not found.after_uv.any()
    assert found.after_dbi[0] > found.before_dbi[0] + 0.1
    # a tilted dish can be pointed back by shifting the feed
    assert abs(found.correction.shift_mm[0]) > 0.1


def test_wrong_questions_are_refused() -> None:
    with pytest.raises(InputError, match=r"'free' or 'fixed', not 'loose'"):
        best_correction(PRIME, undeformed(PRIME.reflector), [30.0], pointing="loose")
    with pytest.raises(InputError, match="at least one frequency"):
        best_correction(PRIME, undeformed(PRIME.reflector), [])
