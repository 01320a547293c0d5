"""Fit of a circle's pose to points of its image: robust, with covariance, with or without a prior pose.

Fitted are move (3) along the camera's axes in mm, turn (3) about the circle's own axes in rad, and nuisances held by their priors: an
offset of all edges outwards in px (a camera's tone curve moves a light-dark edge) and an error of the radius in mm, which both look like a
distance; and in mm the waves of a bent rim, across the surface and along it, of which those of two periods look like a tilt (those of three
and four keep a fit from telling the two apart by its model's last decimals). Without a prior pose the turn about z is left alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.difference.circle import circle_points
from dishmap.errors import MeasurementError
from dishmap.robust import bisquare_weights, mad_scale
from dishmap.transforms import Pose, cross_matrix, rotation_from_vector, vector_from_rotation

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

POSE, TURN_Z, TILT = slice(0, 6), 5, slice(3, 5)
BENT_WAVES = (2, 3, 4)
NUISANCES = 2 + 4 * len(BENT_WAVES)
NUMBERS = 6 + NUISANCES
STEPS = 60
# Bisquare tuning, as the paper's Algorithm 4
TUNING = 4.685
# After the reweighting a point within so many sigmas counts in full, one beyond not at all: one of 2000 good ones is lost.
USED_SIGMAS = 3.5
# Waves along the rim that no pose makes: their power over that of white noise says what the waves hold that a pose does make.
WAVES = range(3, 9)
# 12 numbers of variance 1 have a mean square above this in one case of a thousand.
WHITE_POWER = 2.74
# Where a chi-square has risen by this much, nothing of a distribution is left.
GRID_RISE = 40.0
GRID = 81


@dataclass(frozen=True)
class PoseData:
    """What a pose is fitted to.

    points_px, normal (N, 2) and sigma_px (N,): the circle's image, measured along its outward normals; prior: a pose with its
    covariance (6, 6) of (move in mm, turn in rad), or None; sigma_offset_px, sigma_radius_mm and sigma_bend_mm (of each wave) of the
    nuisances; lean_rad: angle between the surface's normal at the rim and z.
    """

    camera: Camera
    radius_mm: float
    height_mm: float
    points_px: Array
    normal: Array
    sigma_px: Array
    prior: tuple[Pose, Array] | None
    sigma_offset_px: float
    sigma_radius_mm: float
    sigma_bend_mm: float
    lean_rad: float

    @cached_property
    def sights(self) -> Array:
        """Unit rays (N, 3) in the camera frame through the points."""
        return self.camera.unproject(self.points_px)


@dataclass(frozen=True)
class PoseFit:
    """A pose with the nuisances (K,), their covariance (6 + K, 6 + K), which points were used (N,), residuals in px (N,) and the cost."""

    pose: Pose
    nuisance: Array
    covariance: Array
    used: Flags
    residual_px: Array
    cost: float


def fit_pose(data: PoseData, start: Pose) -> PoseFit:
    """Fit robustly: bisquare weights to convergence, then all points within `USED_SIGMAS` alike.

    Raises MeasurementError when too few points agree.
    """
    pose, nuisance = start, np.zeros(NUISANCES)
    weights = np.ones(len(data.points_px))
    damping = 1e-6
    for _ in range(STEPS):
        residual, _ = rows(data, pose, nuisance)
        count = len(weights)
        scale = max(mad_scale(residual[:count], 6), 1.0)
        weights = bisquare_weights(residual[:count] / (TUNING * scale)) / scale**2
        pose, nuisance, damping, size = _step(data, pose, nuisance, weights, damping)
        if size < 1e-4:
            break
    residual, _ = rows(data, pose, nuisance)
    count = len(weights)
    used = np.abs(residual[:count]) < USED_SIGMAS * max(mad_scale(residual[:count], 6), 1.0)
    if used.sum() < 3 * NUMBERS:
        raise MeasurementError(f"only {used.sum()} points of the rim agree with each other; is the whole rim in view?")
    return settled(data, pose, nuisance, used)


def settled(data: PoseData, pose: Pose, nuisance: Array, used: Flags, frozen: tuple[int, ...] = ()) -> PoseFit:
    """Least squares over the points used (N,), numbers `frozen` left as they are, and what it leaves."""
    weights = used.astype(float)
    damping = 1e-9
    for _ in range(STEPS):
        pose, nuisance, damping, size = _step(data, pose, nuisance, weights, damping, frozen)
        if size < 1e-7:
            break
    residual, jacobian = rows(data, pose, nuisance)
    count = len(used)
    weight = np.concatenate([weights, np.ones(len(residual) - count)])
    free = _free(data, frozen)
    covariance = np.zeros((NUMBERS, NUMBERS))
    covariance[np.ix_(free, free)] = _inverse((jacobian[:, free] * weight[:, None]).T @ jacobian[:, free])
    cost = float((weight * residual**2).sum())
    return PoseFit(pose, nuisance, covariance, used, residual[:count] * data.sigma_px, cost)


def rows(data: PoseData, pose: Pose, nuisance: Array) -> tuple[Array, Array]:
    """Residuals (M,) in sigmas, measured less model, and the model's derivative (M, 6 + K).

    M: N points, K nuisances and, with a prior, its 6 numbers. A point is compared with the circle's point on the same radius.
    """
    radius = data.radius_mm + nuisance[1]
    rays = data.sights @ pose.rotation
    eye = pose.inverse().translation_mm
    # the nearest point of the circle lies on the radius through the point's own sight
    reach = (data.height_mm - eye[2]) / rays[:, 2]
    angle = np.arctan2(eye[1] + reach * rays[:, 1], eye[0] + reach * rays[:, 0])
    cos, sin = np.cos(angle), np.sin(angle)
    outwards = np.stack([cos, sin, np.zeros(len(angle))], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    across_surface = np.cos(data.lean_rad) * up - np.sin(data.lean_rad) * outwards
    along_surface = np.cos(data.lean_rad) * outwards + np.sin(data.lean_rad) * up
    waves = np.stack([wave(k * angle) for k in BENT_WAVES for wave in (np.cos, np.sin)], axis=1)
    bends = np.concatenate([waves[:, :, None] * direction[:, None] for direction in (across_surface, along_surface)], axis=1)
    local = circle_points(radius, data.height_mm, angle) + nuisance[2:] @ bends
    pixels, by_point = data.camera.project_with_point_jacobian(pose.apply(local))
    across = (data.normal[:, None, :] @ by_point)[:, 0]
    residual = ((data.points_px - pixels) * data.normal).sum(axis=1) - nuisance[0]
    turned = across @ pose.rotation
    by_turn = -(turned[:, None, :] @ cross_matrix(local))[:, 0]
    by_radius, by_bend = (turned * outwards).sum(axis=1), (bends @ turned[:, :, None])[..., 0]
    jacobian = np.column_stack([across, by_turn, np.ones(len(angle)), by_radius, by_bend])
    sigmas = np.concatenate([[data.sigma_offset_px, data.sigma_radius_mm], np.full(NUISANCES - 2, data.sigma_bend_mm)])
    stiff = np.diag(1 / np.maximum(sigmas, 1e-9))
    values, by = [residual / data.sigma_px, -stiff @ nuisance], [jacobian / data.sigma_px[:, None], np.pad(stiff, ((0, 0), (6, 0)))]
    if data.prior is not None:
        expected, covariance = data.prior
        root = np.linalg.cholesky(np.linalg.inv(covariance)).T
        turn = vector_from_rotation(expected.rotation.T @ pose.rotation)
        values.append(-root @ np.concatenate([pose.translation_mm - expected.translation_mm, turn]))
        by.append(np.pad(root, ((0, 0), (0, NUISANCES))))
    return np.concatenate(values), np.concatenate(by)


def misfit_inflation(data: PoseData, fit: PoseFit) -> float:
    """Factor on the data's variance for what is no white noise of the claimed size: a bent rim, or edges off in long stretches.

    The mean square of the residuals, or the power of their waves of 3 to 8 periods around the rim where that is clearly larger:
    a shape that makes those makes waves of 0 to 2 periods too, which the pose takes up.
    """
    z = (fit.residual_px / data.sigma_px)[fit.used]
    white = max(float((z**2).sum() / (len(z) - 5)), 1.0)
    offset = (data.points_px - data.points_px.mean(axis=0))[fit.used]
    angle = np.arctan2(offset[:, 1], offset[:, 0])
    design = np.concatenate([[np.cos(k * angle), np.sin(k * angle)] for k in WAVES]).T
    turned = np.linalg.qr(design)[0].T @ z
    power = float((turned**2).mean())
    return max(white, power) if power > WHITE_POWER * white else white


def merged(data: PoseData, fits: tuple[PoseFit, PoseFit]) -> PoseFit:
    """Mean and covariance over both mirrored poses and all between, for a rim seen straight on.

    There the residuals are quadratic in the tilt: they are computed at six tilts about the middle of both poses, with all other
    numbers at their best, and the tilt is integrated over on a grid.
    """
    used = fits[0].used & fits[1].used
    middle = _between(fits[0].pose, fits[1].pose, data.height_mm)
    nodes = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1]], dtype=float)
    size = 1e-3
    for _ in range(8):
        solved = [settled(data, _tilted(middle, size * node, data.height_mm), fits[0].nuisance, used, (3, 4)) for node in nodes]
        weight = np.concatenate([used, np.ones(len(rows(data, middle, np.zeros(NUISANCES))[0]) - len(used))])
        values = np.stack([rows(data, s.pose, s.nuisance)[0] * weight for s in solved])
        shape = np.linalg.solve(_quadratic(nodes), values)
        gram = shape @ shape.T
        tilt = np.stack(np.meshgrid(*[np.linspace(-1, 1, GRID)] * 2), axis=-1).reshape(-1, 2)
        chi = np.einsum("ni,ij,nj->n", _quadratic(tilt), gram, _quadratic(tilt))
        chi -= chi.min()
        edge = float(chi[np.abs(tilt).max(axis=1) > 0.999].min())
        if GRID_RISE <= edge <= 20 * GRID_RISE:
            break
        size *= float(np.clip((3 * GRID_RISE / max(edge, 1e-3)) ** 0.25, 0.2, 5.0))
    else:
        raise MeasurementError("the tilt of a rim that is seen straight on could not be bounded; give a prior pose")
    return _moments(data, solved, middle, nodes, tilt, np.exp(-0.5 * chi))


def _moments(data: PoseData, solved: list[PoseFit], middle: Pose, nodes: Array, tilt: Array, weight: Array) -> PoseFit:
    """Mean and covariance of all numbers, from their course over the tilt and the tilt's distribution on the grid."""
    numbers = np.stack([np.concatenate([_difference(middle, s.pose), s.nuisance]) for s in solved])
    course = _quadratic(tilt) @ np.linalg.solve(_quadratic(nodes), numbers)
    weight = weight / weight.sum()
    mean = weight @ course
    spread = (course - mean) * np.sqrt(weight)[:, None]
    pose = Pose(middle.rotation @ rotation_from_vector(mean[3:6]), middle.translation_mm + mean[:3])
    base = settled(data, pose, mean[6:], solved[0].used, (3, 4))
    return PoseFit(pose, mean[6:], base.covariance + spread.T @ spread, base.used, base.residual_px, base.cost)


def _quadratic(tilt: Array) -> Array:
    x, y = tilt.T
    return np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y], axis=1)


def _between(a: Pose, b: Pose, height_mm: float) -> Pose:
    """The pose half way between two; the circle's centre half way, too."""
    half = rotation_from_vector(vector_from_rotation(a.rotation.T @ b.rotation) / 2)
    center = 0.5 * (a.apply([0.0, 0.0, height_mm]) + b.apply([0.0, 0.0, height_mm]))
    rotation = a.rotation @ half
    return Pose(rotation, center - height_mm * rotation[:, 2])


def _tilted(pose: Pose, tilt_rad: Array, height_mm: float) -> Pose:
    """A pose turned about its own x and y by a tilt (2,), the circle's centre held."""
    rotation = pose.rotation @ rotation_from_vector(np.array([*tilt_rad, 0.0]))
    return Pose(rotation, pose.apply([0.0, 0.0, height_mm]) - height_mm * rotation[:, 2])


def _difference(a: Pose, b: Pose) -> Array:
    return np.concatenate([b.translation_mm - a.translation_mm, vector_from_rotation(a.rotation.T @ b.rotation)])


def _free(data: PoseData, frozen: tuple[int, ...]) -> list[int]:
    return [k for k in range(NUMBERS) if k not in frozen and (k != TURN_Z or data.prior is not None)]


def _inverse(normal: Array) -> Array:
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.asarray(np.linalg.pinv(normal / np.outer(size, size), rcond=1e-14, hermitian=True) / np.outer(size, size))


def _step(
    data: PoseData, pose: Pose, nuisance: Array, weights: Array, damping: float, frozen: tuple[int, ...] = ()
) -> tuple[Pose, Array, float, float]:
    """One step of Levenberg and Marquardt at fixed weights (N,); also the damping for the next, and the step's size in sigmas."""
    residual, jacobian = rows(data, pose, nuisance)
    weight = np.concatenate([weights, np.ones(len(residual) - len(weights))])
    free = _free(data, frozen)
    by = jacobian[:, free]
    normal, gradient = (by * weight[:, None]).T @ by, by.T @ (weight * residual)
    cost = float((weight * residual**2).sum())
    while damping < 1e8:
        step = np.zeros(NUMBERS)
        step[free] = np.linalg.solve(normal + np.diag(damping * np.diag(normal) + 1e-300), gradient)
        new = Pose(pose.rotation @ rotation_from_vector(step[3:6]), pose.translation_mm + step[:3])
        moved, _ = rows(data, new, nuisance + step[6:])
        # a step that gains less than rounding is no failure
        if np.isfinite(moved).all() and float((weight * moved**2).sum()) <= cost * (1 + 1e-12):
            return new, nuisance + step[6:], damping * 0.1, float(np.abs(by @ step[free]).max())
        damping = max(10 * damping, 1e-9)
    return pose, nuisance, damping, 0.0
