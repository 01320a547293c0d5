"""What is learnt beside the camera: errors of the print, motion while pictures are read; and the elimination that makes it quick."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from boards import CORNERS, corner_views, wide_camera
from numpy.typing import NDArray

from dishmap.camera.board import CURVES
from dishmap.camera.bundle import BoardCorners, Bundle, Prior
from dishmap.camera.calibrate import Calibration, calibrate
from dishmap.camera.compare_cameras import camera_difference
from dishmap.camera.elimination import best_step, marginals, normal_equations
from dishmap.camera.lens_choice import choose_lens, motion_part
from dishmap.camera.model import Camera
from dishmap.errors import InputError

Array = NDArray[np.float64]
CAMERA = wide_camera(75.0)
NOISE_PX, PRINT_MM, MOTION_MM = 0.03, 0.05, 0.5


@cache
def made(print_mm: float = 0.0, motion_mm: float = 0.0, readout: str = "global", flat: bool = False, seed: int = 1) -> Calibration:
    views = corner_views(np.random.default_rng(seed), CAMERA, 20, NOISE_PX, print_mm=print_mm, motion_mm=motion_mm)
    return calibrate(views, CAMERA.width_px, CAMERA.height_px, flat=flat, readout=readout)


def wrong_px(calibration: Calibration) -> float:
    seen = np.concatenate([view.pixels for view in calibration.views])
    return camera_difference(CAMERA, calibration.camera, 300.0, seen).covered_rms_px


def test_a_print_is_learnt_point_by_point() -> None:
    found = made(PRINT_MM)
    # 88 points: their sigma is known to 5 %
    assert found.board.print_sigma_mm == pytest.approx(PRINT_MM, rel=0.2)
    assert found.sigma_px == pytest.approx(NOISE_PX, rel=0.05)
    believed = made(PRINT_MM, flat=True)
    assert believed.sigma_px > 3 * found.sigma_px
    assert wrong_px(found) < 0.5 * wrong_px(believed)
    again = made(PRINT_MM, seed=2)  # the points' errors are those of another board
    assert abs(np.corrcoef(found.board.print_mm.ravel(), again.board.print_mm.ravel())[0, 1]) < 0.3


def test_an_exact_print_is_left_alone() -> None:
    found = made()
    assert found.board.print_sigma_mm == 0
    assert not found.board.print_mm.any()
    assert found.sigma_px == pytest.approx(NOISE_PX, rel=0.05)


def test_motion_while_rows_are_read_is_learnt() -> None:
    found, still = made(motion_mm=MOTION_MM, readout="rows"), made(motion_mm=MOTION_MM)
    # 40 sideways shifts: their sigma is known to 11 %
    assert found.motion_sigma_mm == pytest.approx(MOTION_MM, rel=0.4)
    assert found.sigma_px == pytest.approx(NOISE_PX, rel=0.05)
    assert still.sigma_px > 2.5 * found.sigma_px
    # one camera's error is a draw, so of three
    better = [wrong_px(made(motion_mm=MOTION_MM, readout="rows", seed=seed)) for seed in (1, 2, 3)]
    assert sum(better) < 0.5 * sum(wrong_px(made(motion_mm=MOTION_MM, seed=seed)) for seed in (1, 2, 3))


def test_how_pictures_were_read_is_found() -> None:
    views = corner_views(np.random.default_rng(4), CAMERA, 16, NOISE_PX, motion_mm=MOTION_MM)
    calibration, choice = choose_lens(views, CAMERA.width_px, CAMERA.height_px)
    assert calibration.readout == "rows"
    assert "pictures were read by rows while board or camera moved" in choice.readout_reason
    assert motion_part(made(motion_mm=MOTION_MM), "rows") > motion_part(made(motion_mm=MOTION_MM), "columns")
    assert abs(motion_part(made(), "rows")) < 0.1
    with pytest.raises(InputError, match="unknown readout 'upwards'; use one of global, rows, columns"):
        calibrate(views, CAMERA.width_px, CAMERA.height_px, readout="upwards")


def test_claims_hold_with_print_and_motion() -> None:
    """Mahalanobis length of 9 parameters' errors: the prior's share of them is small."""
    scores = []
    for seed in range(12):
        views = corner_views(np.random.default_rng(50 + seed), CAMERA, 16, NOISE_PX, 0.3, 0.2, PRINT_MM, MOTION_MM)
        camera = calibrate(views, CAMERA.width_px, CAMERA.height_px, readout="rows").camera
        error = camera.parameters - CAMERA.parameters
        assert camera.covariance is not None
        scores.append(error @ np.linalg.solve(camera.covariance, error) / len(error))
    # 12 runs of 9: 14 %; with 16 views the covariance itself is noisy
    assert 0.5 < np.mean(scores) < 1.6


def test_a_curved_print_seen_from_nearly_one_side_keeps_focal_length_within_its_claim() -> None:
    lens = Camera(1920, 1440, np.array([5000.0, 5005.0]), np.array([965.0, 712.0]), np.array([-0.1, 0.05, 0.0003, -0.0002, 0.0]))
    scores = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        found = calibrate(corner_views(rng, lens, 14, 0.05, print_mm=0.02, curve_mm=0.2, tilt_rad=0.08), 1920, 1440)
        assert found.board.curved
        assert found.camera.covariance is not None
        sigma = np.sqrt(found.camera.covariance[:2, :2].sum()) / 2
        scores.append(float((found.camera.focal_px - lens.focal_px).mean() / sigma))
    # rms of five unit Gaussians: 1.75 is passed by chance once in 100
    assert np.sqrt(np.mean(np.square(scores))) < 1.75


def test_curves_are_left_alone_where_views_differ() -> None:
    assert not made(0.1).board.curved
    assert not made(0.1).board.shape_mm[-len(CURVES) :].any()


def small_system() -> tuple[Bundle, BoardCorners, NDArray[np.bool_], Prior]:
    views = corner_views(np.random.default_rng(5), CAMERA, 6, NOISE_PX, print_mm=PRINT_MM, motion_mm=MOTION_MM)
    calibration = calibrate(views, CAMERA.width_px, CAMERA.height_px, readout="rows")
    problem = replace(calibration.problem, print_mm=PRINT_MM, motion_mm=MOTION_MM)
    rng, bundle = np.random.default_rng(6), calibration.bundle
    off = replace(bundle, print_mm=rng.normal(size=(len(CORNERS), 2)) * 0.02, motion=rng.normal(size=(6, 6)) * [0.003] * 6)
    return off, problem.corners(off), problem.free(off), problem.prior(off, problem.joined)


def whole_jacobian(bundle: Bundle, corners: BoardCorners, free: NDArray[np.bool_]) -> Array:
    """Derivatives of all residuals (2 M, S + 72 + 2 N) by central differences, of projections: minus those of residuals."""
    sizes = (int(free.sum()), 72, 2 * len(CORNERS))
    columns = []
    for k in range(sum(sizes)):
        step = 1e-6 * max(1.0, abs(bundle.shared[k])) if k < sizes[0] else 1e-6
        ends = []
        for sign in (1.0, -1.0):
            change = np.zeros(sum(sizes))
            change[k] = sign * step
            shared, poses, prints = np.split(change, np.cumsum(sizes)[:2])
            ends.append(bundle.moved(free, shared, poses.reshape(6, 12), prints.reshape(-1, 2)).residuals(corners).ravel())
        columns.append((ends[1] - ends[0]) / (2 * step))
    return np.stack(columns, axis=1)


def test_elimination_gives_the_whole_systems_answer() -> None:
    bundle, corners, free, prior = small_system()
    equations = normal_equations(bundle, corners, free, np.ones(len(corners.pixels)), prior)
    jacobian, residual = whole_jacobian(bundle, corners, free), bundle.residuals(corners).ravel()
    precision = np.concatenate(
        [prior.precision(bundle)[free], np.tile(prior.pose_precision, 6), np.full(2 * len(CORNERS), prior.print_precision)]
    )
    poses = np.concatenate([np.zeros((6, 6)), bundle.motion], axis=1)
    pull = np.concatenate([prior.pull(bundle)[free], poses.ravel(), bundle.print_mm.ravel()])
    scale = 1 / np.sqrt((jacobian**2).sum(axis=0) + precision)
    inverse = np.linalg.inv((jacobian.T @ jacobian + np.diag(precision)) * np.outer(scale, scale)) * np.outer(scale, scale)
    answer = inverse @ (jacobian.T @ residual - precision * pull)
    step, gain = best_step(equations)
    assert step.prints is not None
    found = np.concatenate([step.shared, step.poses.ravel(), step.prints.ravel()])
    sigma = np.sqrt(np.diag(inverse))
    # differences of 1e-6 leave 1e-3 of a sigma for noise of 1 px
    assert np.abs((found - answer) / sigma).max() < 1e-3 * np.abs(answer / sigma).max()
    assert gain == pytest.approx(float(answer @ (jacobian.T @ residual - precision * pull)), rel=1e-3)
    known, count = marginals(equations), len(step.shared)
    assert np.sqrt(np.diag(known.covariance)) == pytest.approx(sigma[:count], rel=1e-3)
    assert np.sqrt(known.prints).ravel() == pytest.approx(sigma[-2 * len(CORNERS) :], rel=1e-3)
    assert np.sqrt(known.motion) == pytest.approx(sigma[count : count + 72].reshape(6, 12)[:, 6:], rel=1e-3)
    assert pytest.approx((inverse @ jacobian.T)[:count], rel=1e-2, abs=1e-3 * sigma[:count].max()) == known.influence.reshape(-1, count).T
