"""Simulated photographs of boards of circles, and corners of chessboards, for the tests of calibration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.board import BENDS, BoardView, bends_of
from dishmap.camera.chessboard import chessboard_mm
from dishmap.camera.model import Camera
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene, Sensor
from dishmap.targets.pattern import Pattern
from dishmap.transforms import Pose

Array = NDArray[np.float64]
Gray = NDArray[np.uint8] | NDArray[np.uint16]

# The camera looks along the pattern's -z with its y up.
FACING = np.diag([1.0, -1.0, -1.0])
CORNERS = chessboard_mm((11, 8), 20.0)


def wide_camera(degrees: float, width: int = 960, height: int = 720) -> Camera:
    """A camera of this field of view across, with the distortion that such lenses have."""
    focal = width / 2 / np.tan(np.radians(degrees / 2))
    distortion = [-0.25, 0.09, 0.0005, -0.0003, -0.012] if degrees < 90 else [-0.18, 0.03, 0.0005, -0.0003, -0.002]
    return Camera(width, height, np.array([focal, focal * 1.002]), np.array([width / 2 + 5, height / 2 - 8]), np.array(distortion))


def poses_in_view(rng: np.random.Generator, camera: Camera, points_mm: Array, count: int, tilt_rad: float = 0.6) -> list[Pose]:
    """Poses of a board, its points (N, 3) about the origin, that put all of it into the picture, tilted and turned at random."""
    size, poses = float(np.ptp(points_mm[:, :2], axis=0).max()), []
    while len(poses) < count:
        turn = Pose.from_rotation_vector(np.append(rng.uniform(-tilt_rad, tilt_rad, 2), rng.uniform(-0.5, 0.5)), np.zeros(3)).rotation
        ray = camera.unproject(
            rng.uniform([0.25 * camera.width_px, 0.25 * camera.height_px], [0.75 * camera.width_px, 0.75 * camera.height_px])
        )
        distance = size * camera.focal_px[0] / (rng.uniform(0.5, 0.8) * camera.height_px)
        pose = Pose(turn @ FACING, ray / ray[2] * distance)
        if camera.contains(camera.project(pose.apply(points_mm)), 12.0).all():
            poses.append(pose)
    return poses


def photographs(rng: np.random.Generator, camera: Camera, pattern: Pattern, count: int) -> tuple[list[tuple[str, Gray]], list[Pose]]:
    """Photographs (name, gray) of a pattern and the poses in them."""
    poses = poses_in_view(rng, camera, pattern.center_mm, count)
    sensor = Sensor(noise_grey=1.5)
    return [
        (f"{k}.png", simulate(Scene(pattern, camera, pose, sensor=sensor, ink_spread_mm=0.05), rng).image) for k, pose in enumerate(poses)
    ], poses


def corner_views(rng: np.random.Generator, camera: Camera, count: int, noise_px: float = 0.1, bend_mm: float = 0.0) -> list[BoardView]:
    """Views of a chessboard with noise on its corners; bend_mm: sigma of each of its bends, which all views share."""
    middle = CORNERS.mean(axis=0)
    printed = CORNERS - middle
    printed[:, 2] += bends_of(printed, np.zeros(2), float(np.ptp(printed, axis=0).max()) / 2) @ rng.normal(size=len(BENDS)) * bend_mm
    poses = poses_in_view(rng, camera, printed, count)
    return [
        BoardView(f"{k}", camera.project(pose.apply(printed)) + rng.normal(size=(len(CORNERS), 2)) * noise_px, CORNERS)
        for k, pose in enumerate(poses)
    ]
