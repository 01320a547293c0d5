"""The Gaussian core: against the same posterior written out in full, and derivatives against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from difference.states import AT, CAMERA, DISH, state

from dishmap.difference.changes import TargetChanges, target_changes
from dishmap.difference.joint import RANGES, Evidence, Sizes, _steps, learn_sizes, log_evidence, posterior
from dishmap.difference.model import BLOCKS, Columns, columns_of, smooth_kernel, surfaces_of
from dishmap.simulate.deform import Bump, Deformation, ZernikeTerm

SIZES = Sizes(normal_mm=0.1, slide_strain=2e-6, rough_mm=0.003, print_strain=2e-6, expansion=1e-4, focal=1e-5)
NAMES = tuple(RANGES)


def made(way: str = "least_strain", seed: int | None = 1, bend: Deformation | None = None) -> tuple[TargetChanges, Columns, Evidence]:
    rng = None if seed is None else np.random.default_rng(seed)
    bend = Deformation(zernike=(ZernikeTerm(2, 2, 0.2),), bumps=(Bump((80.0, 40.0), 70.0, 0.1),)) if bend is None else bend
    changes = target_changes(state(rng=rng), state(bend, rng), CAMERA, DISH)
    surfaces = surfaces_of(DISH, changes.index)
    columns = columns_of(changes, DISH, CAMERA, AT, surfaces, smooth_kernel(surfaces, 180.0), way)
    return (
        changes,
        columns,
        Evidence(changes.information, changes.score, 0.0, columns, 40.0, np.zeros(0, np.int64), np.zeros(len(DISH), bool)),
    )


def scales(columns: Columns, sizes: Sizes) -> np.ndarray:
    by_block = [1.0, sizes.expansion, sizes.focal, 1.0, sizes.normal_mm, sizes.slide_strain]
    assert BLOCKS == ("rigid", "expansion", "focal", "calibration", "normal", "slide")
    return np.array(by_block)[columns.block]


def written_out(evidence: Evidence, sizes: Sizes) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean and covariance of all unknowns (coefficients, then each target's own), and the log evidence, by dense algebra."""
    columns, n = evidence.columns, len(evidence.score)
    own = np.zeros((n, 6))
    own[:, 0] = sizes.normal_mm**2 * columns.unexplained[:, 0] + sizes.rough_mm**2
    own[:, 1:3] = (sizes.normal_mm**2 * columns.unexplained[:, 1] + (sizes.rough_mm / evidence.rough_length_mm) ** 2)[:, None]
    own[:, 3:] = sizes.print_strain**2
    scale = np.concatenate([scales(columns, sizes), np.sqrt(own.ravel())])
    k = len(columns.block)
    design = np.zeros((n, 6, k + 6 * n))
    design[:, :, :k] = columns.change
    for i in range(n):
        design[i, :, k + 6 * i : k + 6 * i + 6] = columns.local[i]
    design = design.reshape(6 * n, -1) * scale
    whole = np.zeros((6 * n, 6 * n))
    for i in range(n):
        whole[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = evidence.information[i]
    normal = np.eye(len(scale)) + design.T @ whole @ design
    right = design.T @ evidence.score.ravel()
    mean = np.linalg.solve(normal, right)
    value = 0.5 * right @ mean - 0.5 * np.linalg.slogdet(normal)[1]
    return scale * mean, scale[:, None] * np.linalg.inv(normal) * scale, float(value)


@pytest.mark.parametrize("way", ["least_strain", "normal", "axial", "any"])
def test_the_posterior_is_that_of_all_unknowns_written_out(way: str) -> None:
    _, columns, evidence = made(way)
    found = posterior(evidence, SIZES)
    mean, covariance, value = written_out(evidence, SIZES)
    k, n = len(columns.block), len(evidence.score)
    spread = np.sqrt(np.diag(covariance))
    # conditioning: free rigid motions of 10 mm beside micrometres
    assert (found.mean - mean[:k]) / spread[:k] == pytest.approx(np.zeros(k), abs=1e-4)
    assert found.factor @ found.factor.T == pytest.approx(covariance[:k, :k], rel=1e-4, abs=1e-9 * np.diag(covariance)[:k].max())
    assert found.local_mean == pytest.approx(mean[k:].reshape(n, 6), abs=1e-6)
    own = found.local_covariance + found.local_by @ found.factor @ (found.local_by @ found.factor).swapaxes(1, 2)
    for i in (0, 7):
        block = covariance[k + 6 * i : k + 6 * i + 6, k + 6 * i : k + 6 * i + 6]
        assert own[i] == pytest.approx(block, rel=1e-4, abs=1e-12)
    assert found.log_evidence == pytest.approx(value, abs=1e-3)
    assert log_evidence(evidence, SIZES) == pytest.approx(value, abs=1e-3)


def test_steps_follow_the_slope_of_the_evidence() -> None:
    """The Newton step's slope against differences of the log evidence in the logarithm of each size."""
    _, _, evidence = made()
    at = posterior(evidence, SIZES)
    from dishmap.difference.joint import _second_moments

    sums = _second_moments(evidence, at, NAMES)
    for name in NAMES:
        ends = [log_evidence(evidence, replace(SIZES, **{name: getattr(SIZES, name) * np.exp(sign * 1e-3)})) for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / 2e-3
        assert sums[name][0] == pytest.approx(slope, rel=0.02, abs=0.02), name
    assert set(_steps(evidence, at, NAMES)) == set(NAMES)


def test_learnt_sizes_are_where_the_evidence_is_largest() -> None:
    _, _, evidence = made()
    learnt = learn_sizes(lambda at: evidence, SIZES, NAMES, {})
    assert learnt.converged
    best = log_evidence(evidence, learnt.posterior.sizes)
    for name in NAMES:
        for factor in (0.3, 3.0):
            # the broad prior of a size and the end of the search are worth less than a nat
            assert (
                log_evidence(evidence, replace(learnt.posterior.sizes, **{name: getattr(learnt.posterior.sizes, name) * factor})) < best + 1
            )


def test_columns_are_the_slopes_of_what_is_seen() -> None:
    """Each way's normal columns against states deformed a little by the same Zernike term."""
    small = 1e-2
    for way, slide in (("least_strain", "least_strain"), ("normal", "normal")):
        bend = Deformation(zernike=(ZernikeTerm(2, 2, small),), slide=slide)
        changes, columns, evidence = made(way, None, bend)
        # a wide prior and no noise: the posterior mean is the deformation itself
        wide = replace(SIZES, normal_mm=1.0, rough_mm=0.0, slide_strain=0.0, print_strain=0.0, expansion=0.0, focal=0.0)
        found = posterior(evidence, wide)
        move = columns.move @ found.mean + np.einsum("nij,nj->ni", columns.local_move, found.local_mean)
        rim = DISH.center_mm[changes.index, :2] / 300.0
        truth = small * (rim[:, 0] ** 2 - rim[:, 1] ** 2)
        # a little of it went into the rigid alignment
        carried = (AT.inverse() @ changes.moved @ AT).apply(DISH.center_mm + move) - DISH.center_mm
        # the smooth prior and the slides' degree leave 0.4 %
        assert (carried * DISH.normal).sum(axis=1) == pytest.approx(truth, abs=0.01 * small)
