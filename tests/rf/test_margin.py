"""Loss by noise of the map, linear response against corrections made anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dishmap.errors import InputError
from dishmap.rf import margin as margin_module
from dishmap.rf.correct import best_correction, judged
from dishmap.rf.margin import gain_margin
from dishmap.surface.zernike import zernike_matrix, zernike_terms
from tests.rf.dishes import CASSEGRAIN, PRIME, RADIUS_MM, SHAPED, bent

TERMS = tuple(t for t in zernike_terms(4) if t[0] > 0)
TRUTH = bent(z20=0.3, z22=0.3, z31=0.2)
# losses are squares of small command errors: a quarter of them for currents that follow the commands and the ridge
SHARE = 0.25
FACTOR = 0.01 * np.eye(len(TERMS))


def response() -> np.ndarray:
    rng = np.random.default_rng(3)
    rho, phi = np.sqrt(rng.uniform(0, 1, 90)), rng.uniform(0, 2 * np.pi, 90)
    return np.linalg.pinv(zernike_matrix(((0, 0), *TERMS), rho * np.cos(phi), rho * np.sin(phi)))[1:]


@pytest.mark.parametrize("antenna", [PRIME, CASSEGRAIN])
def test_the_linear_loss_is_that_of_corrections_made_from_noisy_maps(antenna) -> None:
    found = best_correction(antenna, TRUTH, [30.0])
    sigma, draws = 1.0, 6
    got = gain_margin(antenna, TRUTH, found, TERMS, [response()], FACTOR, [sigma], np.random.default_rng(4), draws)
    half = np.random.default_rng(4).standard_normal((draws // 2, 90)) @ response().T
    losses = []
    for change in (*half, *-half):
        values = dict(zip(TERMS, sigma * change, strict=True))
        for term, value in zip(TRUTH.terms, TRUTH.coefficients_mm, strict=True):
            values[term] = values.get(term, 0.0) + value
        seen = replace(TRUTH, terms=tuple(values), coefficients_mm=np.array(list(values.values())))
        correction = best_correction(antenna, seen, [30.0]).correction
        losses.append(found.after_dbi[0] - judged(antenna, TRUTH, correction, np.array([9.9930819]), True)[0][0])
    assert got.linear[0]
    assert got.mean_db[0, 0] == pytest.approx(np.mean(losses), rel=SHARE, abs=2e-3)


def test_loss_grows_with_the_square_of_the_noise_and_with_more_actuators() -> None:
    sigmas = [0.005, 0.05, 0.5]
    loss = {}
    for name, shape in (("rigid", False), ("shape", True)):
        found = best_correction(SHAPED, TRUTH, [30.0, 12.5], shape=shape)
        got = gain_margin(SHAPED, TRUTH, found, TERMS, [response()] * 3, FACTOR, sigmas, np.random.default_rng(5), 30)
        loss[name] = got.mean_db
        assert (got.high_db[1:] > got.mean_db[1:]).all()
    # the shape follows noise that no pose can follow
    assert (loss["shape"][2] > loss["rigid"][2]).all()
    assert loss["rigid"][2, 0] / loss["rigid"][1, 0] == pytest.approx(100, rel=0.3)


def test_large_noise_is_climbed_for() -> None:
    found = best_correction(PRIME, TRUTH, [30.0])
    got = gain_margin(PRIME, TRUTH, found, TERMS, [response()] * 2, FACTOR, [0.1, 8.0], np.random.default_rng(6), 5)
    assert got.linear.tolist() == [True, False]
    assert got.mean_db[1, 0] > got.mean_db[0, 0]


def test_linear_and_climbed_losses_agree_where_both_hold(monkeypatch) -> None:
    found = best_correction(SHAPED, TRUTH, [30.0])
    linear = gain_margin(SHAPED, TRUTH, found, TERMS, [response()], FACTOR, [0.1], np.random.default_rng(7), 5)
    monkeypatch.setattr(margin_module, "LINEAR_RAD", 0.0)
    climbed = gain_margin(SHAPED, TRUTH, found, TERMS, [response()], FACTOR, [0.1], np.random.default_rng(7), 5)
    assert climbed.mean_db[0, 0] == pytest.approx(linear.mean_db[0, 0], rel=SHARE, abs=1e-4)
    # other maps lead to other bends: no slope at this one tells how far
    assert found.correction.shape_mm.any()
    assert np.isnan(linear.values_sigma).all()


@pytest.mark.parametrize("antenna", [PRIME, CASSEGRAIN])
def test_sigmas_of_the_values_are_those_of_corrections_made_anew(antenna) -> None:
    found = best_correction(antenna, TRUTH, [30.0])
    sigma = 0.02
    factor = sigma * np.eye(len(TERMS))
    claimed = gain_margin(antenna, TRUTH, found, TERMS, [response()], factor, [0.1], np.random.default_rng(4), 2).values_sigma
    rng, values = np.random.default_rng(9), []
    for _ in range(12):
        change = dict(zip(TERMS, sigma * rng.standard_normal(len(TERMS)), strict=True))
        for term, value in zip(TRUTH.terms, TRUTH.coefficients_mm, strict=True):
            change[term] = change.get(term, 0.0) + value
        seen = replace(TRUTH, terms=tuple(change), coefficients_mm=np.array(list(change.values())))
        values.append(best_correction(antenna, seen, [30.0]).correction.values)
    spread = np.std(values, axis=0)
    # 12 draws know a standard deviation to a fifth; light that moves is known along the principal ways only
    assert (claimed[:3] > 0.4 * spread[:3]).all()
    assert (claimed[:3] < 2.5 * spread[:3]).all()


def test_a_response_that_does_not_fit_is_refused() -> None:
    found = best_correction(PRIME, TRUTH, [30.0])
    with pytest.raises(InputError, match="a row for each of the 14 terms"):
        gain_margin(PRIME, TRUTH, found, TERMS, [response()[1:]], FACTOR, [0.1], np.random.default_rng(8))
    assert TRUTH.radius_mm == RADIUS_MM
