"""The normal of a small flat patch from the image of four of its points, for many patches at once.

IPPE (Collins and Bartoli, "Infinitesimal Plane-Based Pose Estimation", 2014): the homography's derivative at the patch's middle,
seen along the line of sight, is the patch's first two axes over its depth. Its larger singular value is 1 / depth, the smaller one
shortened by the cosine of the tilt, and the tilt may go either way: two poses. Both are refined to the least squared distance in the
image, and the better one is taken.

EPnP is what the paper names. OpenCV's fails on four points of a plane (docs/method-paper.md), so it is here for comparison.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dishmap.transforms import angle_between_rad, cross_matrix, rotation_from_vector

Array = NDArray[np.float64]

STEPS = 6
FIRST_DAMPING = 1e-4
# Tilts that differ by less are one.
SAME_RAD = 1e-3


@dataclass(frozen=True)
class PlaneNormals:
    """Unit normals (K, 3) towards the camera; square, other (K,): sums of squared distances in the image of this tilt and of the other one.

    other is infinite where both refinements end at one tilt.
    """

    normal: Array
    square: Array
    other: Array


def sight_axes(ray: Array) -> Array:
    """Rotations (K, 3, 3) into cameras that look along rays (K, 3): rows are their x and y axis and the ray, of unit length."""
    z = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=1)


def turned(rotation: Array, seen: Array) -> Array:
    """Points (K, P, 2), x/z and y/z, after turning the camera by rotations (K, 3, 3)."""
    rays = np.concatenate([seen, np.ones((*seen.shape[:-1], 1))], axis=-1) @ np.swapaxes(rotation, 1, 2)
    return np.asarray(rays[..., :2] / rays[..., 2:])


def ippe_normals(plane_mm: Array, seen: Array) -> PlaneNormals:
    """Normals of patches with points plane_mm (K, 4, 2) about their middle, seen at x/z, y/z (K, 4, 2): IPPE and refinement."""
    middle = _homography(plane_mm, seen)[:, :, 2]
    turn = sight_axes(middle)
    derivative = _homography(plane_mm, turned(turn, seen))
    # the middle is seen at 0, 0: there the derivative of (h1 . q / h3 . q) is h1, with h3 = (., ., 1)
    _, stretch, right = np.linalg.svd(derivative[:, :2, :2])
    axes = derivative[:, :2, :2] / stretch[:, :1, None]
    # what the axes lack in length goes along the line of sight, either way
    depth_part = np.sqrt(np.maximum(1 - (stretch[:, 1:] / stretch[:, :1]) ** 2, 0.0)) * right[:, 1]
    at = turn[:, 2] / stretch[:, :1]
    found = []
    for sign in (1.0, -1.0):
        first = np.concatenate([axes, sign * depth_part[:, None]], axis=1)
        rotation = np.concatenate([first, np.cross(first[:, :, 0], first[:, :, 1])[:, :, None]], axis=2)
        found.append(_refined(np.swapaxes(turn, 1, 2) @ rotation, at.copy(), plane_mm, seen))
    (one, one_square), (two, two_square) = found
    better = one_square <= two_square
    normal = _towards_camera(np.where(better[:, None], one, two), at)
    same = angle_between_rad(one, two) < SAME_RAD
    return PlaneNormals(normal, np.minimum(one_square, two_square), np.where(same, np.inf, np.maximum(one_square, two_square)))


def epnp_normals(plane_mm: Array, seen: Array) -> Array:
    """Normals (K, 3) of the same patches by OpenCV's EPnP, towards the camera; NaN where it gives none."""
    points = np.concatenate([plane_mm, np.zeros((*plane_mm.shape[:-1], 1))], axis=-1)
    out = np.full((len(points), 3), np.nan)
    for row, (point, image) in enumerate(zip(points, seen, strict=True)):
        done, turn, _ = cv2.solvePnP(point, np.ascontiguousarray(image), np.eye(3), None, flags=cv2.SOLVEPNP_EPNP)
        if done:
            out[row] = rotation_from_vector(turn[:, 0])[:, 2]
    return _towards_camera(out, np.concatenate([seen.mean(axis=1), np.ones((len(seen), 1))], axis=1))


def _towards_camera(normal: Array, at: Array) -> Array:
    return np.where((normal * at).sum(axis=1, keepdims=True) > 0, -normal, normal)


def _homography(plane: Array, seen: Array) -> Array:
    """Homographies (K, 3, 3) with H33 = 1 that take four points (K, 4, 2) of planes to the image (K, 4, 2)."""
    size = np.abs(plane).max(axis=(1, 2), keepdims=True)
    unit = plane / size
    rows = np.concatenate([unit, np.ones((*unit.shape[:2], 1))], axis=2)
    matrix, nothing = np.empty((len(plane), 8, 8)), np.zeros_like(rows)
    matrix[:, :4] = np.concatenate([rows, nothing, -seen[..., :1] * unit], axis=2)
    matrix[:, 4:] = np.concatenate([nothing, rows, -seen[..., 1:] * unit], axis=2)
    h = np.linalg.solve(matrix, np.concatenate([seen[..., 0], seen[..., 1]], axis=1)[..., None])[..., 0]
    out = np.concatenate([h, np.ones((len(h), 1))], axis=1).reshape(-1, 3, 3)
    out[:, :, :2] /= size
    return np.asarray(out)


def _refined(rotation: Array, at: Array, plane: Array, seen: Array) -> tuple[Array, Array]:
    """Normals (K, 3) and sums of squares (K,) after damped Gauss-Newton steps on poses (K, 3, 3), (K, 3) of all patches at once."""
    damping = np.full((len(at), 1), FIRST_DAMPING)
    residual, point, arm = _residual(rotation, at, plane, seen)
    square = (residual**2).sum(axis=(1, 2))
    for _ in range(STEPS):
        by_image = np.zeros((*plane.shape[:2], 2, 3))
        by_image[..., 0, 0] = by_image[..., 1, 1] = 1 / point[..., 2]
        by_image[..., 2] = -point[..., :2] / point[..., 2:] ** 2
        jacobian = np.concatenate([-by_image @ cross_matrix(arm), by_image], axis=3).reshape(len(at), -1, 6)
        normal = np.swapaxes(jacobian, 1, 2) @ jacobian
        normal[:, range(6), range(6)] *= 1 + damping
        step = np.linalg.solve(normal, np.swapaxes(jacobian, 1, 2) @ residual.reshape(len(at), -1, 1))[..., 0]
        new_rotation, new_at = rotation_from_vector(step[:, :3]) @ rotation, at + step[:, 3:]
        new_residual, new_point, new_arm = _residual(new_rotation, new_at, plane, seen)
        new_square = (new_residual**2).sum(axis=(1, 2))
        better = (new_square <= square) & (new_point[..., 2] > 0).all(axis=1)
        damping = np.where(better[:, None], damping * 0.1, damping * 20)
        pairs = ((rotation, new_rotation), (at, new_at), (residual, new_residual), (point, new_point), (arm, new_arm), (square, new_square))
        for old, new in pairs:
            old[better] = new[better]
    return rotation[:, :, 2], square


def _residual(rotation: Array, at: Array, plane: Array, seen: Array) -> tuple[Array, Array, Array]:
    """Seen less predicted (K, 4, 2), points in the camera frame (K, 4, 3), and those from the patch's middle."""
    arm = plane @ np.swapaxes(rotation[:, :, :2], 1, 2)
    point = arm + at[:, None]
    return seen - point[..., :2] / point[..., 2:], point, arm
