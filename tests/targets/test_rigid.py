from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import FISHEYE, WIDE

from dishmap.camera.model import Camera
from dishmap.targets.rigid import RigidFit, other_tilt, robust_pose, sights_of, unbent_misfit
from dishmap.transforms import Pose, rotation_from_vector

Array = NDArray[np.float64]

TRUTH = Pose(np.diag([1.0, -1.0, -1.0]) @ rotation_from_vector([0.3, -0.2, 0.4]), np.array([20.0, -10.0, 500.0]))
START = Pose(rotation_from_vector([0.08, -0.06, 0.1]) @ TRUTH.rotation, TRUTH.translation_mm + [15.0, -20.0, 40.0])
# The lens is linearised about what is seen, so the exact pose leaves nothing.
EXACT_TURN_RAD, EXACT_SHIFT_MM = 1e-6, 1e-3
NOISE_PX = 0.2


def points(rng: np.random.Generator, count: int = 40) -> Array:
    xy = rng.uniform(-150, 150, (count, 2))
    return np.column_stack([xy, (xy**2).sum(axis=1) / 1200])


def difference(fit: RigidFit | None, truth: Pose) -> tuple[float, float]:
    assert fit is not None
    turn = np.linalg.norm((fit.pose @ truth.inverse()).rotation_vector_rad)
    return float(turn), float(np.linalg.norm(fit.pose.translation_mm - truth.translation_mm))


@pytest.mark.parametrize("camera", [WIDE, FISHEYE], ids=["wide", "fisheye"])
def test_exact_points_give_the_exact_pose(camera: Camera) -> None:
    p = points(np.random.default_rng(1))
    turn, shift = difference(robust_pose(START, p, sights_of(camera, camera.project(TRUTH.apply(p)))), TRUTH)
    assert turn < EXACT_TURN_RAD
    assert shift < EXACT_SHIFT_MM


def test_a_quarter_of_wrong_points_does_little_harm() -> None:
    """OpenCV's least squares, from the same points, is thrown off."""
    rng = np.random.default_rng(2)
    p = points(rng)
    pixels = WIDE.project(TRUTH.apply(p)) + rng.normal(0, NOISE_PX, (40, 2))
    clean = difference(robust_pose(START, p, sights_of(WIDE, pixels)), TRUTH)
    pixels[:10] += rng.uniform(10, 25, (10, 2))
    robust = difference(robust_pose(START, p, sights_of(WIDE, pixels)), TRUTH)
    assert robust[0] < 3 * clean[0] + 1e-3
    _, turn, shift = cv2.solvePnP(p, pixels, WIDE.matrix, WIDE.distortion)
    plain = Pose.from_rotation_vector(turn.ravel(), shift.ravel())
    assert np.linalg.norm((plain @ TRUTH.inverse()).rotation_vector_rad) > 5 * robust[0]


def test_covariance_is_that_of_many_trials() -> None:
    rng = np.random.default_rng(3)
    p = points(rng, 30)
    pixels = WIDE.project(TRUTH.apply(p))
    trials = []
    for _ in range(150):
        # noise well above the floor under which residuals count fully
        fit = robust_pose(TRUTH, p, sights_of(WIDE, pixels + rng.normal(0, 1.0, pixels.shape)))
        assert fit is not None
        turn = (fit.pose @ TRUTH.inverse()).rotation_vector_rad
        middle = fit.pose.apply(fit.middle_mm) - TRUTH.apply(fit.middle_mm)
        trials.append((np.concatenate([turn, middle]), np.diag(fit.covariance)))
    scatter = np.std([t for t, _ in trials], axis=0)
    claimed = np.sqrt(np.mean([c for _, c in trials], axis=0))
    # 150 trials tell a sigma to 6 %; robust weights cost some more
    assert scatter / claimed == pytest.approx(np.ones(6), abs=0.3)


def test_points_behind_the_camera_give_no_pose() -> None:
    p = points(np.random.default_rng(4))
    sights = sights_of(WIDE, WIDE.project(TRUTH.apply(p)))
    assert robust_pose(Pose(TRUTH.rotation, -TRUTH.translation_mm), p, sights) is None


def test_other_tilt_mirrors_the_normal_about_the_line_of_sight() -> None:
    middle, normal = np.array([10.0, 20.0, 0.0]), np.array([0.0, 0.0, 1.0])
    other = other_tilt(TRUTH, middle, normal)
    at = TRUTH.apply(middle)
    assert other.apply(middle) == pytest.approx(at)
    sight = at / np.linalg.norm(at)
    n, m = TRUTH.rotate(normal), other.rotate(normal)
    assert m == pytest.approx(2 * (n @ sight) * sight - n)
    again = other_tilt(other, middle, normal)
    assert again.rotation == pytest.approx(TRUTH.rotation)


def test_misfit_forgives_bending_but_not_sliding() -> None:
    rng = np.random.default_rng(5)
    p = points(rng, 60)
    normals = np.column_stack([-p[:, :2] / 600, np.ones(60)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    bump = 6.0 * np.sin(p[:, :1] / 60) * np.cos(p[:, 1:2] / 50)
    bent = sights_of(WIDE, WIDE.project(TRUTH.apply(p + bump * normals)))
    slid = sights_of(WIDE, WIDE.project(TRUTH.apply(p + bump * np.array([0.8, 0.6, 0.0]))))
    stiff = robust_pose(TRUTH, p, bent)
    assert stiff is not None
    assert stiff.sigma_px > 0.5
    assert unbent_misfit(stiff.pose, p, normals, bent, 6.0) < 0.15
    assert unbent_misfit(TRUTH, p, normals, slid, 6.0) > 0.45
