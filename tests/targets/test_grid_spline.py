"""Tensor splines over a lattice and their block-tridiagonal systems, against dense algebra and exact polynomials."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dishmap.targets.grid_blocks import Blocks, factor
from dishmap.targets.grid_spline import CELL, Spline, fit_spline, spline_over

# Relative to numbers of size one; systems of some hundred unknowns with conditions of some hundred.
ROUNDING = 1e-9

counts = st.tuples(st.integers(1, 6), st.integers(1, 6))


def dense(blocks: Blocks) -> np.ndarray:
    m, s = blocks.diagonal.shape[:2]
    out = np.zeros((m * s, m * s))
    for k in range(m):
        out[k * s : (k + 1) * s, k * s : (k + 1) * s] = blocks.diagonal[k]
        if k:
            out[k * s : (k + 1) * s, (k - 1) * s : k * s] = blocks.below[k - 1]
            out[(k - 1) * s : k * s, k * s : (k + 1) * s] = blocks.below[k - 1].T
    return out


@settings(max_examples=25, deadline=None)
@given(counts, st.integers(0, 2**32 - 1))
def test_cells_make_the_same_system_as_dense_algebra(count: tuple[int, int], seed: int) -> None:
    spline, rng = Spline(np.zeros(2), 1.0, count), np.random.default_rng(seed)
    rows = rng.normal(size=(spline.cells, 60, CELL))
    blocks = spline.assembled(np.swapaxes(rows, 1, 2) @ rows, 1.0)
    matrix, unknown = dense(blocks), (3 * spline.controls[:, :, None] + np.arange(3)).reshape(spline.cells, CELL)
    wanted = np.eye(spline.unknowns)
    for own, where in zip(rows, unknown, strict=True):
        wanted[np.ix_(where, where)] += own.T @ own
    assert np.abs(matrix - wanted).max() < ROUNDING * np.abs(wanted).max()

    found, right = factor(blocks), rng.normal(size=(spline.unknowns, 2))
    inverse = np.linalg.inv(matrix)
    assert np.abs(found.solve(right) - inverse @ right).max() < ROUNDING * np.abs(inverse @ right).max()
    assert np.abs(found.solve(right[:, 0]) - inverse @ right[:, 0]).max() < ROUNDING * np.abs(inverse @ right).max()
    assert found.log_determinant == pytest.approx(np.linalg.slogdet(matrix)[1], rel=ROUNDING)
    of_cells = spline.inverse_of_cells(found.inverse())
    for own, where in zip(of_cells, unknown, strict=True):
        assert np.abs(own - inverse[np.ix_(where, where)]).max() < ROUNDING * np.abs(inverse).max()


def test_a_matrix_that_is_not_positive_definite_is_refused() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        factor(Blocks(-np.eye(3)[None], np.zeros((0, 3, 3))))


@settings(max_examples=25, deadline=None)
@given(counts, st.floats(0.5, 4.0), st.integers(0, 2**32 - 1))
def test_cubics_are_followed_exactly_with_their_derivatives(count: tuple[int, int], knot: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    spline = Spline(rng.normal(size=2), knot, count)
    size = knot * np.array(count)
    places = spline.low + size * rng.uniform(size=(40 * spline.cells, 2))
    coefficients = rng.normal(size=(4, 4)) / np.array([1, 1, 2, 6])[:, None] / np.array([1, 1, 2, 6])

    def value(at: np.ndarray, by: tuple[int, int] = (0, 0)) -> np.ndarray:
        x, y = ((at - spline.low) / size).T
        table = np.polynomial.polynomial.polyder(np.polynomial.polynomial.polyder(coefficients, by[0], axis=0), by[1], axis=1)
        return np.polynomial.polynomial.polyval2d(x, y, table) / size[0] ** by[0] / size[1] ** by[1]

    control = fit_spline(spline, places, value(places)[:, None], np.ones(len(places)), 1e-12)
    cell = spline.cell_of(places)
    for by in ((0, 0), (1, 0), (0, 1), (1, 1), (3, 0), (2, 1)):
        found = (spline.weights(cell, places, by)[:, None] @ control[spline.controls[cell]])[:, 0, 0]
        # smoothing by 1e-12 and one division by the cell's size for each derivative
        assert np.abs(found - value(places, by)).max() < 1e-4 / min(1.0, size.min() ** sum(by))


def test_nodes_lie_in_the_middles_of_cells_and_rows_go_to_their_cells() -> None:
    lattice = np.stack(np.meshgrid(np.arange(-3, 7), np.arange(2, 9)), axis=-1).reshape(-1, 2).astype(float)
    spline = spline_over(lattice, 24)
    assert (spline.knot, spline.count) == (1.0, (10, 7))
    assert np.abs(spline.corner(spline.cell_of(lattice)) + 0.5 - lattice).max() < ROUNDING
    coarse = spline_over(lattice, 4)
    assert (coarse.knot, coarse.count) == (3.0, (4, 3))
    grouped = coarse.grouped(coarse.cell_of(lattice))
    assert sorted(grouped[grouped < len(lattice)]) == list(range(len(lattice)))
    assert all((coarse.cell_of(lattice[row[row < len(lattice)]]) == cell).all() for cell, row in enumerate(grouped))
