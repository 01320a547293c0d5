"""Sheets for tests: grids bent in known ways, seen without pixels."""

from __future__ import annotations

import numpy as np

from dishmap.camera.model import Camera
from dishmap.targets.grid_builders import grid
from dishmap.targets.grid_sheet import Sheet, estimate_sheet
from dishmap.targets.pattern import Pattern
from dishmap.transforms import Pose, rotation_from_vector

CAMERA = Camera(4608, 3456, np.array([3000.0, 3000]), np.array([2303.5, 1727.5]), np.array([-0.1, 0.02, 1e-4, -1e-4, 0]))
PITCH_MM = 12.0
TILTED = Pose(np.diag([1.0, -1, -1]) @ rotation_from_vector(np.array([0.2, 0.1, 0.0])), np.array([10.0, 5.0, 700.0]))


def flat(columns: int = 12, rows: int = 9) -> Pattern:
    return grid(columns, rows, PITCH_MM, line_width_mm=1.0)


def on_cylinder(pattern: Pattern, radius_mm: float) -> np.ndarray:
    """Where a flat pattern's targets lie once it is wrapped, without stretch, on a cylinder about an axis along y."""
    x, y, _ = pattern.center_mm.T
    return np.column_stack([radius_mm * np.sin(x / radius_mm), y, radius_mm * np.cos(x / radius_mm) - radius_mm])


def seen_places(points_mm: np.ndarray, camera: Camera = CAMERA, pose: Pose = TILTED) -> np.ndarray:
    return camera.project(pose.apply(points_mm))


def sheet_of(pattern: Pattern, measured: np.ndarray, sigma_px: float, index: np.ndarray | None = None, camera: Camera = CAMERA) -> Sheet:
    """The sheet through places (N, m) of targets `index`, all by default, which are believed to sigma_px."""
    index = np.arange(len(pattern)) if index is None else index
    covariance = np.tile(sigma_px**2 * np.eye(measured.shape[1]), (len(index), 1, 1))
    return estimate_sheet(camera, pattern, index, measured, covariance)
