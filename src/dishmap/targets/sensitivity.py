"""How a measured pose would change with the camera's parameters, and what its mirrored twin is."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.adjust import Batch
from dishmap.targets.edges import Poses, project_printed
from dishmap.targets.pattern import TargetKind, bent_print_mm
from dishmap.targets.solve import solve_each
from dishmap.targets.window import OUTLINE_POINTS
from dishmap.transforms import rotation_from_vector

Array = NDArray[Any]


def outline_samples(kind: TargetKind) -> tuple[Array, Array]:
    """Printed positions (Q, 2) around all circles, and the mm of edge each stands for (Q,)."""
    angle = 2 * np.pi * (np.arange(OUTLINE_POINTS) + 0.5) / OUTLINE_POINTS
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    xy = (kind.center_mm[:, None] + kind.radius_mm[:, None, None] * circle).reshape(-1, 2)
    return xy, np.repeat(2 * np.pi * kind.radius_mm / OUTLINE_POINTS, OUTLINE_POINTS)


def edge_normals(pixels: Array, kind: TargetKind) -> tuple[Array, Array]:
    """Unit normals (T, Q, 2) of projected outlines and px of edge per sample (T, Q), by differences along each circle."""
    around = pixels.reshape(len(pixels), len(kind.radius_mm), OUTLINE_POINTS, 2)
    along = 0.5 * (np.roll(around, -1, axis=2) - np.roll(around, 1, axis=2)).reshape(pixels.shape)
    length = np.maximum(np.linalg.norm(along, axis=2), 1e-9)
    return np.stack([along[..., 1], -along[..., 0]], axis=-1) / length[..., None], length


def calibration_jacobian(batch: Batch, kind: TargetKind, poses: Poses, edge_information: Array) -> Array:
    """D position (camera frame, mm) / d camera parameters (T, 3, P): how the fit follows when the camera is a little different.

    edge_information (T,): information per px of edge (1 / px^2 per px), so that the prior on normals has its due weight.
    """
    xy, _ = outline_samples(kind)
    pixels, motion = project_printed(batch.camera, poses, batch.curvature_per_mm, xy)
    local = bent_print_mm(np.broadcast_to(xy, (len(poses), *xy.shape)), batch.curvature_per_mm)
    points = poses.in_camera(local)
    _, _, by_camera = batch.camera.project_with_jacobians(points)
    normals, length = edge_normals(pixels, kind)
    pose_columns = np.einsum("tqk,tqkp->tqp", normals, motion)
    camera_columns = np.einsum("tqk,tqkc->tqc", normals, by_camera)
    weighted = pose_columns * (length * edge_information[:, None])[..., None]
    information = np.swapaxes(weighted, 1, 2) @ pose_columns
    information[:, [3, 4], [3, 4]] += batch.priors.normal_sigma_rad[:, None] ** -2.0
    information[:, 5, 5] += 1e-6 + (1e8 if batch.priors.turns_freely else 0.0)
    change = -solve_each(information, np.swapaxes(weighted, 1, 2) @ camera_columns)
    return poses.steps @ change[:, :3]


def mirrored_normals(poses: Poses) -> Array:
    """Normals (T, 3) mirrored about the lines of sight.

    Under weak perspective a plane and its mirror image about the line of sight look alike (Schweighofer and Pinz 2006).
    """
    ray = poses.position_mm / np.linalg.norm(poses.position_mm, axis=1, keepdims=True)
    normal = poses.rotation[..., 2]
    return 2 * (normal * ray).sum(axis=1, keepdims=True) * ray - normal


def mirrored(poses: Poses) -> Poses:
    """Poses at the same places, turned the shortest way to the mirrored normals."""
    normal, other = poses.rotation[..., 2], mirrored_normals(poses)
    axis = np.cross(normal, other)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sine, (normal * other).sum(axis=1, keepdims=True))
    return Poses(rotation_from_vector(axis / np.maximum(sine, 1e-15) * angle) @ poses.rotation, poses.position_mm)
