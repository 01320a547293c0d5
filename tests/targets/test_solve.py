"""Small systems against numpy, and that one which cannot be solved spoils no other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dishmap.targets.solve import inverse_each, inverse_scaled, products, solve_each, solve_scaled

Array = NDArray[np.float64]

# Solving after scaling leaves rounding times the condition of the scaled matrix.
SOLVED_PART = 1e-6
# Sums of products in single precision, over the lengths of the columns.
SUMMED_PART = 1e-6
# What tells columns apart that are alike to 1e-5, and how well it is to be known.
APART, APART_KNOWN = 1e-5, 1e-3


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


def lengths(columns: NDArray[np.float32]) -> Array:
    size = np.linalg.norm(columns.astype(float), axis=2)
    return np.asarray(size[:, :, None] * size[:, None])


def test_products_of_columns_are_those_of_double_precision() -> None:
    columns = (np.random.default_rng(3).standard_normal((4, 7, 300)) * 10.0 ** np.arange(-3, 4)[:, None]).astype(np.float32)
    expected = columns.astype(float) @ np.swapaxes(columns.astype(float), 1, 2)
    for alike in ((), (2, 0, 5), (6, 3)):
        assert np.abs((products(columns.copy(), alike) - expected) / lengths(columns)).max() < SUMMED_PART


def test_columns_that_are_nearly_alike_are_told_apart() -> None:
    """Three columns that differ by 1e-5 of themselves: the least eigenvalue of their products is 1e-10, far below single precision."""
    rng = np.random.default_rng(4)
    columns = rng.standard_normal((20, 6, 400))
    columns[:, 1] = 0.3 * columns[:, 0] + APART * rng.standard_normal((20, 400))
    columns[:, 4] = columns[:, 0] - 2.0 * columns[:, 1] + APART * rng.standard_normal((20, 400))
    single = columns.astype(np.float32)
    exact = single.astype(float) @ np.swapaxes(single.astype(float), 1, 2)
    expected = np.linalg.eigvalsh(exact / lengths(single))[:, 0]
    assert (expected > 0).all()
    assert (expected < 10 * APART**2).all()
    found = np.linalg.eigvalsh(products(single.copy(), (0, 1, 4)) / lengths(single))[:, 0]
    np.testing.assert_allclose(found, expected, rtol=APART_KNOWN)
    # products as they come do not tell
    assert (np.linalg.eigvalsh(products(single.copy()) / lengths(single))[:, 0] < 0).any()


def test_columns_of_nothing_have_no_products() -> None:
    assert not products(np.zeros((2, 4, 10), np.float32), (0, 2, 3)).any()
