"""Measured states of a dish without photographs: true poses, or true poses with the noise of a given information."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.difference.bound import change_information
from dishmap.difference.response import pose_response
from dishmap.simulate.deform import Deformation, deform
from dishmap.simulate.scene import facing_pose
from dishmap.targets.bound import pattern_information
from dishmap.targets.builders import dish
from dishmap.targets.pattern import Pattern, bent_print_mm
from dishmap.targets.pose import TargetPoses
from dishmap.targets.scene_noise import NoiseModel
from dishmap.transforms import Pose, rotation_from_vector

Array = NDArray[np.float64]

CAMERA = Camera(3000, 3000, np.full(2, 1700.0), np.full(2, 1499.5))
DISH = dish(600.0, 300.0, spacing_mm=85.0)
AT = facing_pose(665.0, 0.03)
RIM_MM = 300.0
CONTRAST, PSF_PX = 75.0, 0.8
NORMAL_SIGMA_RAD = 2e-4
STEP_MM = 0.05


@lru_cache(maxsize=1)
def information() -> Array:
    """Fisher information (N, 7, 7) of one photograph of DISH."""
    return pattern_information(CAMERA, DISH, np.arange(len(DISH)), AT, CONTRAST, PSF_PX)


def true_poses(pattern: Pattern, deformation: Deformation, camera_from_dish: Pose) -> tuple[Array, Array, Array]:
    """Positions (N, 3), rotations (N, 3, 3) in the camera frame and strains of the prints (N, 3: xx, yy, xy), by differences."""
    steps = STEP_MM * np.array([[0.0, 0.0], [1, 0], [-1, 0], [0, 1], [0, -1]])

    def places(state: Deformation) -> Array:
        local = bent_print_mm(np.broadcast_to(steps, (len(pattern), 5, 2)), pattern.curvature_per_mm)
        nominal = pattern.center_mm[:, None] + local @ np.swapaxes(pattern.axes, 1, 2)
        return camera_from_dish.apply(deform(state, pattern.surface, nominal, RIM_MM))

    now = places(deformation)
    tangent = np.stack([now[:, 1] - now[:, 2], now[:, 3] - now[:, 4]], axis=-1) / (2 * STEP_MM)
    u, stretch, vt = np.linalg.svd(tangent, full_matrices=False)
    flat = u @ vt
    strain = np.swapaxes(vt, 1, 2) @ ((stretch - 1)[:, :, None] * vt)
    rotation = np.concatenate([flat, np.cross(flat[..., 0], flat[..., 1])[..., None]], axis=-1)
    return now[:, 0], rotation, np.stack([strain[:, 0, 0], strain[:, 1, 1], strain[:, 0, 1]], axis=-1)


def state(deformation: Deformation | None = None, rng: Generator | None = None, camera_from_dish: Pose = AT) -> TargetPoses:
    """What a photograph of DISH in some state would give; without a generator it is without noise."""
    n, lam = len(DISH), information()
    position, rotation, strain = true_poses(DISH, deformation or Deformation(), camera_from_dish)
    _, by_strain = pose_response(CAMERA, DISH, np.arange(n), camera_from_dish)
    seen = np.einsum("nij,nj->ni", by_strain, strain)
    prior = np.zeros((n, 7))
    prior[:, 3:5], prior[:, 6] = NORMAL_SIGMA_RAD**-2, 0.1**-2
    posterior = lam + prior[:, :, None] * np.eye(7)
    # the likelihood's own maximum scatters by its information; the estimate is drawn to the prior (true normals, no ink spread)
    noise = np.zeros((n, 7)) if rng is None else np.einsum("nij,nj->ni", np.linalg.cholesky(lam), rng.standard_normal((n, 7)))
    error = np.linalg.solve(posterior, (noise + np.einsum("nij,nj->ni", lam[:, :, :6], seen))[..., None])[..., 0]
    covariance = np.linalg.inv(posterior)[:, :6, :6]
    position = position + error[:, :3]
    rotation = rotation @ rotation_from_vector(error[:, 3:6])
    center, by_point = CAMERA.project_with_point_jacobian(position)
    return TargetPoses(
        index=np.arange(n),
        ids=DISH.ids,
        position_mm=position,
        normal=rotation[..., 2],
        rotation=rotation,
        covariance=covariance,
        information=lam,
        pull=prior * error,
        prior=prior,
        center_px=center,
        covariance_px2=by_point @ covariance[:, :3, :3] @ np.swapaxes(by_point, 1, 2),
        sigma_normal_rad=np.sqrt(covariance[:, 3, 3] + covariance[:, 4, 4]),
        calibration_jacobian=np.zeros((n, 3, len(CAMERA.parameters))),
        blur_px=np.full(n, PSF_PX),
        offset_mm=error[:, 6],
        contrast=np.full(n, 150.0),
        noise=np.full(n, 2.0),
        kept=np.ones(n),
        quality=np.zeros(n, np.int64),
        camera_from_dish=AT,
        normal_sigma_rad=NORMAL_SIGMA_RAD,
        noise_model=NoiseModel(4.0, 0.0, 1.0),
        log_gamma=0.0,
        rejected=(),
    )


def change_sigma_mm() -> Array:
    """Sigma (N,) of each target's depth change on its own."""
    lam = change_information(CAMERA, DISH, np.arange(len(DISH)), AT, CONTRAST, PSF_PX)
    return np.sqrt(np.linalg.inv(lam + 1e-9 * np.eye(6))[:, 2, 2])
