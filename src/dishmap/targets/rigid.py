"""Rigid pose of a pattern from matched points, robust and fast: damped Gauss-Newton steps with Cauchy weights.

The lens is linearised about each seen point, so a step costs no lens model: a point p is off a seen ray by the tangents
t = B'p / (d'p), B the axes at right angles to the ray d, and M t pixels away from where it was seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.transforms import Pose, cross_matrix, rotation_from_vector

Array = NDArray[np.float64]

STEPS = 12
# Residuals below this count fully, whatever their scatter: far above the noise of a centre, far below a wrong match.
FLOOR_PX = 0.3
# A step that changes the pixels by less, in sigmas, ends the search.
SMALLEST_STEP = 0.02
# Steps and floor of the fit that lets the surface bend.
BENT_STEPS, BENT_FLOOR_PX = 4, 0.1


@dataclass(frozen=True)
class Sights:
    """Seen points as rays: ray (n, 3) unit, tangent (n, 3, 2) axes across it, px_per_tangent (n, 2, 2)."""

    ray: Array
    tangent: Array
    px_per_tangent: Array

    def take(self, index: NDArray[np.int64]) -> Sights:
        """The sights at `index`."""
        return Sights(self.ray[index], self.tangent[index], self.px_per_tangent[index])


def sights_of(camera: Camera, place_px: Array) -> Sights:
    """Places (n, 2) px of a photograph as rays; NaN where the lens model does not hold."""
    ray = camera.unproject(place_px)
    tangent = tangent_axes(ray)
    _, by_point = camera.project_with_point_jacobian(ray)
    with np.errstate(invalid="ignore"):
        return Sights(ray, tangent, by_point @ tangent)


def tangent_axes(ray: Array) -> Array:
    """Axes (N, 3, 2) at right angles to unit rays (N, 3), the first towards image x, the second towards image y."""
    x = np.array([1.0, 0.0, 0.0]) - ray * ray[:, :1]
    norm = np.linalg.norm(x, axis=1, keepdims=True)
    # a ray along x itself (a lens of 180 degrees) takes any axis
    x = np.where(norm > 1e-6, x / np.maximum(norm, 1e-6), [0.0, 0.0, -1.0])
    return np.stack([x, np.cross(ray, x)], axis=-1)


@dataclass(frozen=True)
class RigidFit:
    """A pose camera_from_dish with its cost, the robust sigma of a coordinate (px), and its covariance.

    covariance (6, 6): of a turn about `middle_mm` (rad, camera axes) and a shift (mm).
    """

    pose: Pose
    cost: float
    sigma_px: float
    covariance: Array
    middle_mm: Array


def robust_pose(pose: Pose, points_mm: Array, sights: Sights, steps: int = STEPS) -> RigidFit | None:
    """Refine a pose so that points (n, 3) are seen at their sights, in at most `steps` steps.

    None when points cannot be seen from the first pose.
    """
    middle = points_mm.mean(axis=0)
    arm = points_mm - middle
    across = sights.px_per_tangent @ np.swapaxes(sights.tangent, 1, 2)
    # the pose as a rotation and the camera point of the middle
    rotation, at = pose.rotation, pose.apply(middle)
    residual, square, along = _residual(rotation, at, arm, sights.ray, across)
    if along.min() <= 0:
        return None
    damping = 1e-4
    for _ in range(steps):
        sigma = _sigma(square)
        jacobian = _jacobian(rotation, arm, sights.ray, across, residual, along)
        normal, gradient = _normal_equations(residual, square, jacobian, sigma)
        cost = _cost(square, sigma)
        accepted = False
        while not accepted and damping < 1e6:
            damped = normal.copy()
            damped.flat[::7] *= 1 + damping
            step = np.linalg.solve(damped, gradient)
            turned, moved = _small_turn(step[:3]) @ rotation, at + step[3:]
            new_residual, new_square, new_along = _residual(turned, moved, arm, sights.ray, across)
            accepted = bool(new_along.min() > 0) and _cost(new_square, sigma) <= cost
            damping = damping * 0.1 if accepted else damping * 20
        if not accepted:
            break
        largest = np.abs(jacobian @ step).max()
        rotation, at, residual, square, along = turned, moved, new_residual, new_square, new_along
        if largest < SMALLEST_STEP * sigma:
            break
    sigma = _sigma(square)
    normal, _ = _normal_equations(residual, square, _jacobian(rotation, arm, sights.ray, across, residual, along), sigma)
    return RigidFit(
        Pose(rotation, at - rotation @ middle), _cost(square, FLOOR_PX), sigma, np.asarray(np.linalg.inv(normal) * sigma**2), middle
    )


def unbent_misfit(pose: Pose, points_mm: Array, normals: Array, sights: Sights, bend_mm: float) -> float:
    """Robust sigma (px) of what neither a pose nor bending explains.

    That is of residuals across the images of the normals (n, 3), after a pose fit in which each point may also move by
    `bend_mm` (sigma) along its normal. A bent surface moves marks along the normal only (stretching is far smaller), so a
    right match leaves noise here, however much the surface is bent; a wrong one does not.
    """
    middle = points_mm.mean(axis=0)
    arm = points_mm - middle
    across = sights.px_per_tangent @ np.swapaxes(sights.tangent, 1, 2)
    rotation, at = pose.rotation, pose.apply(middle)
    residual, _, along = _residual(rotation, at, arm, sights.ray, across)
    for step_number in range(BENT_STEPS + 1):
        jacobian = _jacobian(rotation, arm, sights.ray, across, residual, along)
        # px per mm along the normal, and the unit vector across it
        lift = (jacobian[:, :, 3:] @ (normals @ rotation.T)[:, :, None])[..., 0]
        length = np.linalg.norm(lift, axis=1, keepdims=True)
        side = np.where(length > 1e-9, lift / np.maximum(length, 1e-9), [1.0, 0.0])[:, ::-1] * [-1.0, 1.0]
        off = (side * residual[..., 0]).sum(axis=1)
        sigma = max(math.sqrt(float(np.median(off**2)) / 0.4549), BENT_FLOOR_PX)
        if step_number == BENT_STEPS:
            break
        # inverse covariance of sigma^2 (across) and sigma^2 + (bend * lift)^2 (along the lift)
        forward = side[:, ::-1] * [1.0, -1.0]
        softened = 1 / (1 + (bend_mm * length / sigma) ** 2)
        weight = side[:, :, None] * side[:, None, :] + softened[..., None] * forward[:, :, None] * forward[:, None, :]
        weight = weight / (1 + off**2 / (6 * sigma**2))[:, None, None]
        rows = (weight @ jacobian).reshape(-1, 6).T
        normal = rows @ jacobian.reshape(-1, 6)
        normal.flat[::7] *= 1 + 1e-6
        normal.flat[::7] += 1e-12 * normal.trace()
        step = np.linalg.solve(normal, rows @ residual.reshape(-1))
        turned, moved = _small_turn(step[:3]) @ rotation, at + step[3:]
        new_residual, _, new_along = _residual(turned, moved, arm, sights.ray, across)
        if new_along.min() <= 0:
            break
        rotation, at, residual, along = turned, moved, new_residual, new_along
    return sigma


def other_tilt(pose: Pose, middle_mm: Array, normal: Array) -> Pose:
    """The pose with a normal mirrored about the line of sight to `middle_mm`: the second solution of a small flat patch."""
    at = pose.apply(middle_mm)
    axis = np.cross(pose.rotate(normal), -at / np.linalg.norm(at))
    sine = float(np.linalg.norm(axis))
    turn = rotation_from_vector(2 * axis * (np.arcsin(min(1.0, sine)) / max(sine, 1e-12)))
    rotation = turn @ pose.rotation
    return Pose(rotation, at - rotation @ middle_mm)


def pose_jacobians(pose: Pose, points_mm: Array, middle_mm: Array) -> Array:
    """Derivative of camera points (n, 3, 6) by a turn about `middle_mm` and a shift."""
    out = np.empty((len(points_mm), 3, 6))
    out[:, :, :3] = -cross_matrix(pose.rotate(points_mm - middle_mm))
    out[:, :, 3:] = np.eye(3)
    return out


def _residual(rotation: Array, at: Array, arm: Array, ray: Array, across: Array) -> tuple[Array, Array, Array]:
    """Seen less predicted (n, 2, 1) px, its squared length (n,), and the depth (n,) of the points along their rays."""
    moved = arm @ rotation.T + at
    along = np.einsum("ni,ni->n", moved, ray)
    residual = across @ (moved / -np.where(along > 0, along, 1.0)[:, None])[:, :, None]
    return residual, np.einsum("nij,nij->n", residual, residual), along


def _jacobian(rotation: Array, arm: Array, ray: Array, across: Array, residual: Array, along: Array) -> Array:
    """Derivative (n, 2, 6) of the predicted px by a turn about the middle and a shift."""
    by_point = (across + residual * ray[:, None, :]) / along[:, None, None]
    out = np.empty((len(arm), 2, 6))
    # d(R a)/d(turn) = -[R a]x, and -b'[v]x = (v x b)' for each row b
    x, y, z = (rotation @ arm.T)[:, :, None]
    out[:, :, 0] = y * by_point[:, :, 2] - z * by_point[:, :, 1]
    out[:, :, 1] = z * by_point[:, :, 0] - x * by_point[:, :, 2]
    out[:, :, 2] = x * by_point[:, :, 1] - y * by_point[:, :, 0]
    out[:, :, 3:] = by_point
    return out


def _sigma(square: Array) -> float:
    # the median of the squared length of two normal numbers is 2 ln 2 of their variance
    middle = len(square) // 2
    return max(math.sqrt(float(np.partition(square, middle)[middle]) / (2 * math.log(2))), FLOOR_PX)


def _cost(square: Array, sigma: float) -> float:
    return float(np.log1p(square / (6 * sigma**2)).sum())


def _normal_equations(residual: Array, square: Array, jacobian: Array, sigma: float) -> tuple[Array, Array]:
    weight = 1 / (1 + square / (6 * sigma**2))
    rows = (jacobian * weight[:, None, None]).reshape(-1, 6).T
    normal = rows @ jacobian.reshape(-1, 6)
    # few points on a line leave directions open: a trace of stiffness keeps the equations solvable
    normal.flat[::7] *= 1 + 1e-9
    normal.flat[::7] += 1e-12 * normal.trace()
    return normal, rows @ residual.reshape(-1)


def _small_turn(vector: NDArray[np.floating[Any]]) -> Array:
    """Rotation matrix of one rotation vector (Rodrigues' formula), without the cost of `rotation_from_vector`'s generality."""
    x, y, z = (float(v) for v in vector)
    angle = math.sqrt(x * x + y * y + z * z)
    a = math.sin(angle) / angle if angle > 1e-9 else 1.0
    b = (1 - math.cos(angle)) / angle**2 if angle > 1e-4 else 0.5
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + a * k + b * (k @ k)
