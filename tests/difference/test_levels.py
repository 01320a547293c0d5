from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.difference.levels import average, covariance, delaunay_pairs, level, level_0, next_level, sigma
from dishmap.errors import FitError, InputError

Array = NDArray[np.float64]

LATTICE = np.stack(np.meshgrid(np.arange(6.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
LINE = np.array([[0, 1], [1, 2]])


def matrix_of(pairs: NDArray[np.int64], weight: Array) -> Array:
    """The averaging as a dense matrix, written down row by row."""
    n = len(weight)
    near = [{k} for k in range(n)]
    for a, b in pairs:
        near[a].add(int(b))
        near[b].add(int(a))
    out = np.zeros((n, n))
    for row, members in enumerate(near):
        total = sum(weight[m] for m in members)
        for m in members:
            out[row, m] = weight[m] / total
    return out


def mean_weights(pairs: NDArray[np.int64], weight: Array) -> Array:
    inside = matrix_of(pairs, np.ones(len(weight))) > 0
    return np.array([weight[row].mean() for row in inside])


def test_levels_are_powers_of_the_averaging_matrix() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 10, (30, 2))
    pairs = delaunay_pairs(points)
    value, weight, root = rng.standard_normal(30), rng.uniform(0.2, 2, 30), rng.standard_normal((30, 7))
    levels = level(level_0(points, value, weight, root), pairs, 3)
    by = np.eye(30)
    for found in levels:
        assert found.value == pytest.approx(by @ value, abs=1e-12)
        assert found.place == pytest.approx(by @ points, abs=1e-12)
        assert found.weight == pytest.approx(weight, abs=1e-12)
        assert covariance(found) == pytest.approx(by @ root @ root.T @ by.T, abs=1e-12)
        assert sigma(found) == pytest.approx(np.sqrt(np.diag(by @ root @ root.T @ by.T)), abs=1e-12)
        by, weight = matrix_of(pairs, weight) @ by, mean_weights(pairs, weight)


def test_shared_members_make_averages_correlated() -> None:
    first = next_level(level_0(np.zeros((3, 1)), np.array([3.0, 6.0, 9.0]), noise=np.eye(3)), LINE)
    assert first.value == pytest.approx([4.5, 6.0, 7.5])
    expected = [[1 / 2, 1 / 3, 1 / 4], [1 / 3, 1 / 3, 1 / 3], [1 / 4, 1 / 3, 1 / 2]]
    assert covariance(first) == pytest.approx(np.array(expected))
    # taken as independent, the middle of the next level would claim a third less
    middle = np.array([1 / 6 + 1 / 9, 1 / 3 + 1 / 9, 1 / 6 + 1 / 9])
    assert sigma(next_level(first, LINE))[1] == pytest.approx(np.linalg.norm(middle))
    assert np.linalg.norm(middle) > 1.4 * np.sqrt((1 / 2 + 1 / 3 + 1 / 2) / 9)


def test_a_linear_field_stays_as_it_is_at_the_averaged_places() -> None:
    rng = np.random.default_rng(2)
    field = 2.0 + LATTICE @ [0.3, -0.7]
    for found in level(level_0(LATTICE, field, rng.uniform(0.1, 1, 30)), delaunay_pairs(LATTICE), 4):
        assert found.value == pytest.approx(2.0 + found.place @ [0.3, -0.7], abs=1e-12)
    # the places do move, at the border: with places left where they were this would fail
    moved = level(level_0(LATTICE, field), delaunay_pairs(LATTICE), 1)[1]
    assert np.abs(moved.value - field).max() > 0.2


def test_estimates_of_no_weight_do_not_count() -> None:
    value = np.array([1.0, np.nan, 5.0])
    found = next_level(level_0(np.array([[0.0], [np.nan], [4.0]]), value, [1, 0, 1], np.eye(3)), LINE)
    assert found.value == pytest.approx([1.0, 3.0, 5.0])
    assert found.place[:, 0] == pytest.approx([0.0, 2.0, 4.0])
    assert sigma(found) == pytest.approx([1.0, np.sqrt(0.5), 1.0])


def test_a_group_without_members_is_nan() -> None:
    found = average(level_0(np.zeros((3, 2)), np.ones(3), noise=np.eye(3)), [[1, 1, 0], [0, 0, 0]])
    assert found.value[0] == 1.0
    assert np.isnan(found.value[1])
    assert np.isnan(found.place[1]).all()
    assert np.isnan(sigma(found)[1])
    assert found.weight[1] == 0.0


def test_unknown_noise_stays_unknown() -> None:
    found = next_level(level_0(LATTICE, LATTICE[:, 0]), delaunay_pairs(LATTICE))
    assert np.isnan(sigma(found)).all()
    assert np.isnan(covariance(found)).all()


def test_a_neighbour_that_is_named_twice_counts_once() -> None:
    start = level_0(LATTICE, LATTICE[:, 0] ** 2)
    pairs = delaunay_pairs(LATTICE)
    assert next_level(start, np.concatenate([pairs, pairs[:, ::-1]])).value == pytest.approx(next_level(start, pairs).value)


def test_delaunay_neighbours_of_a_lattice_are_its_sides_and_one_diagonal_of_each_square() -> None:
    jitter = LATTICE + 0.01 * np.random.default_rng(3).standard_normal(LATTICE.shape)
    pairs = delaunay_pairs(jitter)
    length = np.linalg.norm(jitter[pairs[:, 0]] - jitter[pairs[:, 1]], axis=1)
    # 25 + 24 sides, 20 squares; slivers along the border are longer than 1.8 and left out
    assert len(pairs) == 25 + 24 + 20
    assert length.max() < 1.5


def test_points_on_a_line_have_no_triangulation() -> None:
    with pytest.raises(FitError, match="lie on one line"):
        delaunay_pairs(np.column_stack([np.arange(5.0), np.zeros(5)]))
    with pytest.raises(FitError, match="at least 3 points"):
        delaunay_pairs(np.zeros((2, 2)))


def test_unusable_input_is_refused() -> None:
    with pytest.raises(InputError, match="estimates need place"):
        level_0(np.zeros((3, 2)), np.zeros(2))
    with pytest.raises(InputError, match="not negative"):
        level_0(np.zeros((2, 2)), np.zeros(2), [1, -1])
    with pytest.raises(InputError, match="that counts is NaN"):
        level_0(np.zeros((2, 2)), [0.0, np.nan])
    with pytest.raises(InputError, match="column for each of the 2 estimates"):
        average(level_0(np.zeros((2, 2)), np.zeros(2)), np.ones((1, 3)))
    with pytest.raises(InputError, match="0 or more"):
        level(level_0(np.zeros((2, 2)), np.zeros(2)), np.zeros((0, 2), dtype=int), -1)
