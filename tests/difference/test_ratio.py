from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.difference.ratio import (
    consistency,
    depth_sensitivity_per_mm,
    normal_sensitivity_per_mm,
    pairs_within,
    ratio_map,
)
from dishmap.errors import InputError
from dishmap.transforms import rotation_from_vector

Array = NDArray[np.float64]

FOCAL_PX = 1500.0
LATTICE = np.stack(np.meshgrid(45.0 * np.arange(5), 45.0 * np.arange(4)), axis=-1).reshape(-1, 2) - [90.0, 67.5]


def project(points: Array) -> Array:
    return FOCAL_PX * points[..., :2] / points[..., 2:]


def plane(depth_mm: float, tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> tuple[Array, Array]:
    """Positions and normals (T, 3) of the lattice on a plane."""
    turn = rotation_from_vector(np.array(tilt))
    flat = np.column_stack([LATTICE, np.zeros(len(LATTICE))])
    return flat @ turn.T + [30.0, -20.0, depth_mm], np.tile(turn @ [0.0, 0.0, -1.0], (len(flat), 1))


def test_all_pairs_or_those_within_reach() -> None:
    everything = pairs_within(LATTICE)
    assert everything.shape == (190, 2)
    assert len(np.unique(everything, axis=0)) == 190
    assert (everything[:, 0] < everything[:, 1]).all()
    length = np.linalg.norm(LATTICE[everything[:, 0]] - LATTICE[everything[:, 1]], axis=1)
    assert np.array_equal(pairs_within(LATTICE, 70.0), everything[length <= 70.0])
    # 16 + 15 along the lattice and 24 across its 12 squares
    assert len(pairs_within(LATTICE, 70.0)) == 16 + 15 + 24


def test_a_plate_parallel_to_the_image_shrinks_as_its_depth_grows() -> None:
    near, _ = plane(1000.0)
    far, _ = plane(1002.0)
    found = ratio_map(project(near), project(far), pairs_within(LATTICE), place_mm=LATTICE)
    assert found.ratio == pytest.approx(1000 / 1002, rel=1e-12)
    assert found.used.all()
    i, j = found.pair.T
    assert found.mid_mm == pytest.approx((LATTICE[i] + LATTICE[j]) / 2)
    assert found.mid_px == pytest.approx((project(near)[i] + project(near)[j]) / 2)
    assert found.distance_px == pytest.approx(1.5 * np.linalg.norm(LATTICE[i] - LATTICE[j], axis=1))
    assert np.isnan(found.sigma_ratio).all()
    assert found.noise is None


def test_the_gate_leaves_out_ratios_beyond_epsilon() -> None:
    p = project(plane(1000.0)[0])
    q = p * 1.004
    q[0] += [4.0, 0.0]
    found = ratio_map(p, q, pairs_within(LATTICE, 50.0), epsilon=0.01)
    # the target at the corner has one neighbour along x, 67.5 px off; across, 4 px change the distance by little
    alone = (found.pair == [0, 1]).all(axis=1)
    assert np.array_equal(found.used, ~alone)
    assert ratio_map(p, q, pairs_within(LATTICE, 50.0), epsilon=0.1).used.all()


def test_sigma_and_correlations_of_ratios_are_those_of_repeated_trials() -> None:
    rng = np.random.default_rng(5)
    p, q = project(plane(1000.0)[0]), project(plane(1003.0, (0.2, 0.1, 0.0))[0])
    count = len(p)
    root_p, root_q = (0.05 * (np.eye(2) + 0.5 * rng.standard_normal((count, 2, 2))) for _ in range(2))
    pair = pairs_within(LATTICE, 70.0)
    cov = [r @ np.swapaxes(r, 1, 2) for r in (root_p, root_q)]
    found = ratio_map(p, q, pair, reference_covariance_px2=cov[0], current_covariance_px2=cov[1], epsilon=0.5)

    def noisy(points: Array, root: Array) -> Array:
        return points + np.einsum("tij,tj->ti", root, rng.standard_normal((count, 2)))

    trials = np.log([ratio_map(noisy(p, root_p), noisy(q, root_q), pair, epsilon=0.5).ratio for _ in range(2000)])
    sampled, claimed = np.cov(trials.T), (found.noise @ found.noise.T).toarray()
    # 2000 trials know a standard deviation to 1.6 %; the largest of 55 is within 3.5 times that
    assert np.sqrt(np.diag(sampled) / np.diag(claimed)) == pytest.approx(1.0, abs=0.06)
    assert found.sigma_ratio == pytest.approx(found.ratio * np.sqrt(np.diag(claimed)))
    unit = np.sqrt(np.outer(np.diag(claimed), np.diag(claimed)))
    assert np.abs((sampled - claimed) / unit).max() < 0.12
    # pairs that share a target are far from independent
    assert np.abs(claimed / unit)[~np.eye(len(pair), dtype=bool)].max() > 0.4


def test_equal_noise_gives_root_two_sigma_over_distance() -> None:
    p = project(plane(1000.0)[0])
    noise = np.tile(0.04**2 * np.eye(2), (len(p), 1, 1))
    found = ratio_map(p, p, pairs_within(LATTICE), reference_covariance_px2=0 * noise, current_covariance_px2=noise)
    assert found.sigma_ratio == pytest.approx(np.sqrt(2) * 0.04 / found.distance_px, rel=1e-12)


@pytest.mark.parametrize("tilt", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.0), (0.0, 0.9, 0.2)])
def test_sensitivity_to_the_ends_is_that_of_the_projection(tilt: tuple[float, float, float]) -> None:
    position, normal = plane(800.0, tilt)
    # a bent surface: normals of the two ends differ
    normal = normal + 0.1 * np.random.default_rng(6).standard_normal(normal.shape)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    pair = pairs_within(LATTICE, 70.0)
    by = normal_sensitivity_per_mm(position, normal, pair)
    step = 1e-3
    for (i, j), found in zip(pair, by, strict=True):
        mean = normal[i] + normal[j]
        mean /= np.linalg.norm(mean)
        for end in (0, 1):
            change = []
            for sign in (1.0, -1.0):
                ends = position[[i, j]].copy()
                ends[end] += sign * step * mean
                change.append(np.log(np.linalg.norm(np.subtract(*project(ends)))))
            # central differences over 0.001 mm: truncation and rounding under 1e-10 per mm, the values being 1e-3 and more
            assert found[end] == pytest.approx((change[0] - change[1]) / (2 * step), abs=1e-9)


def test_for_a_plate_parallel_to_the_image_the_answer_is_one_over_depth() -> None:
    position, normal = plane(800.0)
    pair = pairs_within(LATTICE)
    for sensitivity in (normal_sensitivity_per_mm, depth_sensitivity_per_mm):
        assert sensitivity(position, normal, pair).sum(axis=1) == pytest.approx(1 / 800.0, rel=1e-12)
    # on a tilted plate the text's formula is off
    position, normal = plane(800.0, (0.4, 0.0, 0.0))
    exact = normal_sensitivity_per_mm(position, normal, pair).sum(axis=1)
    assert np.abs(depth_sensitivity_per_mm(position, normal, pair).sum(axis=1) / exact - 1).max() > 0.05


def test_a_ratio_that_disagrees_with_those_around_it_has_no_weight() -> None:
    rng = np.random.default_rng(7)
    p = project(plane(1000.0)[0])
    q = p * 0.998 + 0.005 * rng.standard_normal(p.shape)
    q[7] += [0.6, 0.3]
    found = ratio_map(p, q, pairs_within(LATTICE, 50.0))
    weight, bad = consistency(found), (found.pair == 7).any(axis=1)
    step = found.step_reference_px[bad]
    # pairs across the error hardly see it
    along = np.abs(step @ [0.6, 0.3]) / np.linalg.norm(step, axis=1) > 0.2
    assert not weight[bad][along].any()
    assert np.median(weight[~bad]) > 0.8


def test_consistency_is_zero_outside_the_gate_and_one_without_noise() -> None:
    p = project(plane(1000.0)[0])
    q = p * 0.998
    exact = ratio_map(p, q, pairs_within(LATTICE, 50.0))
    assert consistency(exact) == pytest.approx(1.0, abs=1e-6)
    assert not consistency(ratio_map(p, q, pairs_within(LATTICE, 50.0), epsilon=0.001)).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"epsilon": 0.0}, "epsilon .* between 0 and 1"),
        ({"current_px": np.zeros((3, 2))}, "one shape"),
        ({"registered_px": np.zeros((20, 2))}, "in one place"),
        ({"current_covariance_px2": np.zeros((20, 2, 2))}, "both images, or of neither"),
        ({"reference_covariance_px2": np.zeros((20, 2)), "current_covariance_px2": np.zeros((20, 2))}, "covariances must be finite"),
    ],
)
def test_unusable_input_is_refused(change: dict[str, object], message: str) -> None:
    good: dict[str, object] = {"registered_px": LATTICE, "current_px": LATTICE, "pair": pairs_within(LATTICE)}
    with pytest.raises(InputError, match=message):
        ratio_map(**{**good, **change})  # type: ignore[arg-type]
