"""The smooth fit against plain formulas on dense matrices: estimates, covariances, likelihoods and their slopes."""

from __future__ import annotations

import numpy as np
import pytest

from dishmap.rf.smooth_fit import BROAD, Values, _View, fit_smooth
from dishmap.rf.smooth_terms import matern_root, terms_for
from dishmap.surface.zernike import zernike_matrix

RNG = np.random.default_rng(6)
XY = np.sqrt(RNG.random(40))[:, None] * np.stack([np.cos(turn := 2 * np.pi * RNG.random(40)), np.sin(turn)], axis=1)
TERMS = terms_for(40)
AT = zernike_matrix(TERMS, *XY.T)
PLACES = [TERMS.index(term) for term in BROAD[0]]
ROOT = matern_root(TERMS, 0.5)
# Variance of a broad term that stands for an endless one in the plain formulas, and what that and rounding leave of differences.
ENDLESS, CLOSE = 1e3, 1e-4
SIZES = [(0.3, 0.05), (0.05, 0.2), (1.0, 0.01)]


def values(settled: bool) -> Values:
    shared = 0.1 * RNG.standard_normal((40, 3))
    return Values(XY, np.sin(3 * XY[:, 0]) + RNG.normal(0, 0.1, 40), shared, 0.02 * RNG.random(40), settled)


def plain_prior(amplitude: float) -> np.ndarray:
    prior = amplitude**2 * ROOT @ ROOT.T
    prior[PLACES, PLACES] += ENDLESS
    return prior


def after(prior: np.ndarray, gain: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Covariance of what a gain leaves of a prior, with the noise that it lets in; written so that no large numbers cancel."""
    left = np.eye(len(TERMS)) - gain @ AT
    return left @ prior @ left.T + gain @ noise @ gain.T


@pytest.mark.parametrize(("amplitude", "own"), SIZES)
def test_measured_values_give_what_regression_gives(amplitude: float, own: float) -> None:
    one, prior = values(settled=False), plain_prior(amplitude)
    mean, covariance, response = _View(one, AT, PLACES, ROOT).field(amplitude, own**2)
    noise = one.factor_mm @ one.factor_mm.T + np.diag(one.own_mm2 + own**2)
    gain = prior @ AT.T @ np.linalg.inv(AT @ prior @ AT.T + noise)
    assert np.abs(response - gain).max() < CLOSE
    assert np.abs(mean - gain @ one.mean_mm).max() < CLOSE
    assert np.abs(covariance - after(prior, gain, noise)).max() < CLOSE


@pytest.mark.parametrize(("amplitude", "own"), SIZES)
def test_settled_values_are_extended(amplitude: float, own: float) -> None:
    one, prior = values(settled=True), plain_prior(amplitude)
    mean, covariance, response = _View(one, AT, PLACES, ROOT).field(amplitude, own**2)
    gain = prior @ AT.T @ np.linalg.inv(AT @ prior @ AT.T + own**2 * np.eye(40))
    doubt = one.factor_mm @ one.factor_mm.T + np.diag(one.own_mm2)
    assert np.abs(response - gain).max() < CLOSE
    assert np.abs(mean - gain @ one.mean_mm).max() < CLOSE
    assert np.abs(covariance - after(prior, gain, own**2 * np.eye(40) + doubt)).max() < CLOSE


@pytest.mark.parametrize("settled", [True, False])
def test_likelihoods_and_their_slopes(settled: bool) -> None:
    one = values(settled)
    view = _View(one, AT, PLACES, ROOT)
    loss = view._settled_loss if settled else view._measured_loss
    doubt = one.factor_mm @ one.factor_mm.T + np.diag(one.own_mm2)
    ours, plain = [], []
    for logs in ([0.0, -2.0], [-1.0, -3.0], [0.7, -1.0]):
        value, slope = loss(np.array(logs))
        step = 1e-5 * np.eye(2)
        assert np.allclose(slope, [(loss(logs + s)[0] - loss(logs - s)[0]) / 2e-5 for s in step], rtol=1e-5, atol=1e-4)
        amplitude, own = view._sizes(np.array(logs))
        variance = AT @ plain_prior(amplitude) @ AT.T + own * np.eye(40) + (0 if settled else doubt)
        seen = np.outer(one.mean_mm, one.mean_mm) + (doubt if settled else 0)
        plain.append(0.5 * (np.trace(np.linalg.solve(variance, seen)) + np.linalg.slogdet(variance)[1]))
        ours.append(value)
    # what does not depend on the sizes is left out of ours
    assert np.allclose(np.diff(ours), np.diff(plain), rtol=CLOSE, atol=0.01)


def test_shared_errors_stay_in_the_covariance() -> None:
    one = values(settled=False)
    x = XY[:, 0]
    shared = Values(XY, one.mean_mm, 0.5 * (x**3)[:, None], one.own_mm2, settled=False)
    apart = Values(XY, one.mean_mm, np.zeros((40, 0)), one.own_mm2, settled=False)
    line = zernike_matrix(TERMS, np.linspace(-0.9, 0.9, 7), np.zeros(7))
    doubtful, sure = (line @ fit_smooth(v, TERMS, 0.2).covariance_mm2 @ line.T for v in (shared, apart))
    # twice 0.5 * 0.9^3 from one end of the line to the other, and the covariance says that the ends go against each other
    ends = np.array([-1.0, 0, 0, 0, 0, 0, 1.0])
    assert np.sqrt(ends @ (doubtful - sure) @ ends) == pytest.approx(0.73, rel=0.2)
