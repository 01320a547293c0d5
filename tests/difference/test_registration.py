from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.difference.registration import register
from dishmap.errors import FitError, InputError

Array = NDArray[np.float64]

# Rounding of a least-squares fit over a picture of 1000 px.
EXACT_PX = 1e-9
SCALE, TURN_RAD, SHIFT_PX = 1.013, 0.02, np.array([7.0, -4.0])


def places(rng: np.random.Generator, count: int = 40) -> Array:
    return rng.uniform(0, 1000, (count, 2))


def moved(p: Array) -> Array:
    c, s = np.cos(TURN_RAD), np.sin(TURN_RAD)
    return SCALE * p @ np.array([[c, -s], [s, c]]).T + SHIFT_PX


def test_a_similarity_is_recovered_from_the_targets_that_both_images_share() -> None:
    rng = np.random.default_rng(1)
    p, ids = places(rng), rng.permutation(100)[:40]
    q, order = moved(p), rng.permutation(40)[:33]
    found = register(ids[3:], p[3:], ids[order], q[order])
    common = np.sort(ids[[i for i in order if i >= 3]])
    assert np.array_equal(found.ids, common)
    assert np.array_equal(ids[3:][found.reference_row], common)
    assert np.array_equal(ids[order][found.current_row], common)
    assert found.scale == pytest.approx(SCALE, abs=1e-12)
    assert found.rotation_rad == pytest.approx(TURN_RAD, abs=1e-12)
    assert np.abs(found.registered_px - moved(p)[np.argsort(ids)][np.isin(np.sort(ids), common)]).max() < EXACT_PX
    assert np.abs(p[5] @ found.matrix.T + found.shift_px - q[5]).max() < EXACT_PX
    assert np.abs(found.residual_px).max() < EXACT_PX
    assert found.converged


def test_targets_that_moved_on_their_own_do_not_pull_the_others() -> None:
    rng = np.random.default_rng(2)
    p = places(rng)
    q = moved(p) + 0.01 * rng.standard_normal(p.shape)
    # a fifth of them, all to one side
    q[:8] += [3.0, 1.0]
    found = register(np.arange(40), p, np.arange(40), q)
    assert not found.weights[:8].any()
    assert found.weights[8:].min() > 0
    # 0.01 px over 32 targets with a reach of 400 px: scale to 1e-5, in 5 sigmas
    assert abs(found.scale - SCALE) < 5 * 0.01 / (400 * np.sqrt(32))
    assert np.abs(found.residual_px[:8] - [3.0, 1.0]).max() < 0.05


def test_the_covariance_is_that_of_repeated_trials() -> None:
    rng = np.random.default_rng(3)
    p, ids = places(rng), np.arange(40)
    trials, claimed = [], []
    for _ in range(300):
        found = register(ids, p, ids, moved(p) + 0.05 * rng.standard_normal(p.shape))
        middle = p.mean(axis=0) @ found.matrix.T + found.shift_px
        trials.append([np.log(found.scale), found.rotation_rad, *middle])
        claimed.append(found.covariance)
    scatter, claim = np.cov(np.array(trials).T), np.mean(claimed, axis=0)
    # 300 trials know a standard deviation to 4 %
    assert np.sqrt(np.diag(scatter) / np.diag(claim)) == pytest.approx(1.0, abs=0.15)
    # and a correlation to 0.06
    unit = np.sqrt(np.outer(np.diag(claim), np.diag(claim)))
    assert np.abs((scatter - claim) / unit)[~np.eye(4, dtype=bool)].max() < 0.2


def test_too_few_common_targets_are_refused() -> None:
    p = places(np.random.default_rng(4), 5)
    with pytest.raises(FitError, match="2 targets in common; a registration needs at least 3"):
        register([1, 2, 3, 4, 5], p, [4, 5, 6, 7, 8], p)
    assert len(register([1, 2, 3, 4, 5], p, [3, 4, 5, 6, 7], moved(p)).ids) == 3


@pytest.mark.parametrize(
    ("ids", "points", "message"),
    [
        ([1, 1, 2], np.eye(3, 2), "ids of the current must differ"),
        ([1, 2, 3], np.full((3, 2), np.nan), "NaN or infinity"),
        ([1, 2], np.eye(3, 2), "as many centres"),
    ],
)
def test_unusable_arrays_are_refused(ids: list[int], points: Array, message: str) -> None:
    with pytest.raises(InputError, match=message):
        register([1, 2, 3], np.eye(3, 2), ids, points)


def test_targets_in_one_place_are_refused() -> None:
    with pytest.raises(FitError, match="determine only"):
        register([1, 2, 3], np.ones((3, 2)), [1, 2, 3], np.ones((3, 2)))
