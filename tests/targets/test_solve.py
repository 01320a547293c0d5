"""Small systems against numpy, and that one which cannot be solved spoils no other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dishmap.targets.solve import inverse_each, inverse_scaled, solve_each, solve_scaled

Array = NDArray[np.float64]

# Solving after scaling leaves rounding times the condition of the scaled matrix.
SOLVED_PART = 1e-6


@st.composite
def scaled_systems(draw: st.DrawFn) -> tuple[Array, Array]:
    """Positive definite systems whose unknowns have scales from 1e-4 to 1e4, as mm, rad and px have."""
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    columns = rng.standard_normal((3, 40, 5)) * 10.0 ** rng.uniform(-4, 4, (3, 1, 5))
    return np.swapaxes(columns, 1, 2) @ columns, rng.standard_normal((3, 5))


@given(scaled_systems())
def test_scaled_solution_and_inverse_are_those_of_numpy(system: tuple[Array, Array]) -> None:
    matrix, right = system
    scale = 1 / np.sqrt(np.diagonal(matrix, axis1=1, axis2=2))
    expected = np.linalg.solve(matrix, right[..., None])[..., 0]
    np.testing.assert_allclose(solve_scaled(matrix, right) / scale, expected / scale, atol=SOLVED_PART * np.abs(expected / scale).max())
    unit = inverse_scaled(matrix) / scale[:, :, None] / scale[:, None, :]
    np.testing.assert_allclose(unit, np.linalg.inv(matrix) / scale[:, :, None] / scale[:, None, :], atol=SOLVED_PART * np.abs(unit).max())


def test_a_system_that_cannot_be_solved_moves_nothing_and_spoils_no_other() -> None:
    good = np.diag([2.0, 4.0])
    matrix = np.stack([good, np.full((2, 2), np.nan), np.zeros((2, 2))])
    right = np.array([[2.0, 4.0], [1.0, 1.0], [0.0, 0.0]])
    np.testing.assert_allclose(solve_scaled(matrix, right), [[1, 1], [0, 0], [0, 0]], atol=1e-9)
    inverse = inverse_scaled(matrix[:2])
    np.testing.assert_allclose(inverse[0], np.diag([0.5, 0.25]))
    assert np.isnan(inverse[1]).all()


@pytest.mark.parametrize("bad", [np.zeros((2, 2)), np.ones((2, 2)), np.full((2, 2), np.nan)])
@pytest.mark.parametrize("place", [0, 2, 4])
def test_only_the_singular_system_gets_zeros(bad: Array, place: int) -> None:
    matrix = np.array([np.diag([1.0 + k, 2.0]) for k in range(5)])
    matrix[place] = bad
    right = np.ones((5, 2, 3))
    expected = np.array([np.tile([[1 / (1.0 + k)], [0.5]], (1, 3)) for k in range(5)])
    expected[place] = 0.0
    np.testing.assert_allclose(solve_each(matrix, right), expected)
    others = np.arange(5) != place
    np.testing.assert_allclose(inverse_each(matrix)[others] @ matrix[others], np.tile(np.eye(2), (4, 1, 1)), atol=1e-15)
    assert (inverse_each(matrix)[place] == 0).all()
