"""What is kept of a difference: the same covariance in fewer columns."""

from __future__ import annotations

import numpy as np
from differences import DISH, joint_of
from hypothesis import given, settings
from hypothesis import strategies as st

from dishmap.difference.saved import LEFT_TO_OWN, compact, saved_difference

# Rounding of products of some hundred numbers.
ROUNDING = 1e-12


@given(seed=st.integers(0, 2**32), rows=st.integers(1, 12), columns=st.integers(0, 40), rank=st.integers(0, 8))
@settings(max_examples=60, deadline=None)
def test_covariance_is_kept_with_fewer_columns(seed: int, rows: int, columns: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((rows, rank)) @ rng.standard_normal((rank, columns)) * 10.0 ** rng.uniform(-6, 2)
    own = rng.random(rows)
    found, found_own = compact(factor, own)
    whole, again = factor @ factor.T, found @ found.T
    trace = np.trace(whole)
    assert found.shape[1] <= min(rows, columns, rank)
    assert np.abs(np.diag(again) + found_own - np.diag(whole) - own).max() <= ROUNDING * (1 + trace)
    assert np.abs(again - whole).max() <= 1.01 * LEFT_TO_OWN * trace + ROUNDING * trace


def test_weak_columns_become_own_variance() -> None:
    factor = np.diag([1.0, 0.9 * LEFT_TO_OWN**0.5])
    found, own = compact(factor, np.zeros(2))
    assert found.shape == (2, 1)
    assert np.allclose(own, [0.0, 0.81 * LEFT_TO_OWN], rtol=1e-12, atol=0)
    # a little stronger, and it stays
    assert compact(np.diag([1.0, 1.1 * LEFT_TO_OWN**0.5]), np.zeros(2))[0].shape == (2, 2)


def test_columns_of_a_joint_estimate() -> None:
    rng = np.random.default_rng(1)
    joint = joint_of(DISH, shape_factor=rng.standard_normal((len(DISH), 3 * len(DISH))), displacement_factor=np.ones((len(DISH), 5)))
    saved = saved_difference(joint, DISH)
    assert saved.surface == DISH.surface
    assert saved.shape_factor.shape == (len(DISH), len(DISH))
    assert saved.displacement_factor.shape == (len(DISH), 1)
    assert np.allclose(saved.shape_factor @ saved.shape_factor.T, joint.shape_factor @ joint.shape_factor.T)
    assert np.array_equal(saved.shape_mm, joint.shape_mm)
    assert np.array_equal(saved.displacement_mm, joint.displacement_mm)
