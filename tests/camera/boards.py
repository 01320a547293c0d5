"""Simulated photographs of boards of circles and of chessboards, and corners of chessboards, for the tests of calibration."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dishmap.camera.board import BENDS, CURVES, SHAPE_TERMS, STRETCHES, BoardView, shapes_of
from dishmap.camera.chessboard import chessboard_mm
from dishmap.camera.model import Camera
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene, Sensor
from dishmap.targets.pattern import Pattern
from dishmap.transforms import Pose, rotation_from_vector

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


def corner_views(
    rng: np.random.Generator,
    camera: Camera,
    count: int,
    noise_px: float = 0.1,
    bend_mm: float = 0.0,
    stretch_mm: float = 0.0,
    print_mm: float = 0.0,
    motion_mm: float = 0.0,
    curve_mm: float = 0.0,
    tilt_rad: float = 0.6,
) -> list[BoardView]:
    """Views of a chessboard with noise on its corners.

    Sigmas of what is wrong with the board, the same in all views: bend_mm of each of its bends, stretch_mm of stretch and skew, print_mm
    of each printed point, curve_mm of each curve of the print.
    motion_mm: sigma of the board's shift and turn (at half its side) while the rows of a picture are read.
    tilt_rad: of boards about two axes, at most.
    """
    middle, half = CORNERS.mean(axis=0), float(np.ptp(CORNERS, axis=0).max()) / 2
    printed = CORNERS - middle
    terms = np.zeros(len(SHAPE_TERMS))
    terms[: -len(CURVES)] = rng.normal(size=len(BENDS) + len(STRETCHES)) * ([bend_mm] * len(BENDS) + [stretch_mm] * len(STRETCHES))
    if curve_mm:
        terms[-len(CURVES) :] = rng.normal(size=len(CURVES)) * curve_mm
    printed += shapes_of(printed, np.zeros(2), half) @ terms
    if print_mm:
        printed[:, :2] += rng.normal(size=(len(CORNERS), 2)) * print_mm
    poses = poses_in_view(rng, camera, printed, count, tilt_rad)
    pixels = [moving_corners(camera, pose, printed, rng.normal(size=6) * motion_mm / ([half] * 3 + [1.0] * 3)) for pose in poses]
    return [BoardView(f"{k}", seen + rng.normal(size=seen.shape) * noise_px, CORNERS) for k, seen in enumerate(pixels)]


def moving_corners(camera: Camera, pose: Pose, points_mm: Array, motion: Array) -> Array:
    """Pixels of points (N, 3) on a board that turns by motion[:3] about its middle and shifts by motion[3:] while the rows are read."""
    arms = points_mm @ pose.rotation.T
    pixels = camera.project(arms + pose.translation_mm)
    if motion.any():
        for _ in range(8):  # when a point is read depends on where it is seen: each round is some hundred times nearer
            when = ((pixels[:, 1] + 0.5) / camera.height_px - 0.5)[:, None]
            turned = np.einsum("nij,nj->ni", rotation_from_vector(when * motion[:3]), arms)
            pixels = camera.project(turned + pose.translation_mm + when * motion[3:])
    return pixels


def chessboard_photographs(
    rng: np.random.Generator, camera: Camera, corners: tuple[int, int], square_mm: float, count: int, noise_grey: float = 1.5
) -> tuple[list[tuple[str, Gray]], list[Pose]]:
    """Photographs (name, gray) of a flat chessboard with these inner corners, and the poses in them."""
    columns, rows = corners
    outline = square_mm * np.array(
        [[x, y, 0.0] for x in (-(columns + 1) / 2, (columns + 1) / 2) for y in (-(rows + 1) / 2, (rows + 1) / 2)]
    )
    poses: list[Pose] = []
    while len(poses) < count:  # the renderer needs rays all over the box that holds the board; some lenses end in the picture's corners
        pose = poses_in_view(rng, camera, outline, 1)[0]
        seen = camera.project(pose.apply(outline))
        box = np.stack(np.meshgrid(*np.stack([seen.min(axis=0) - 20, seen.max(axis=0) + 20], axis=-1)), axis=-1)
        if np.isfinite(camera.unproject(box)).all():
            poses.append(pose)
    return [(f"{k}.png", chessboard_photograph(rng, camera, pose, corners, square_mm, noise_grey)) for k, pose in enumerate(poses)], poses


def chessboard_photograph(
    rng: np.random.Generator, camera: Camera, pose: Pose, corners: tuple[int, int], square_mm: float, noise_grey: float
) -> NDArray[np.uint8]:
    """One photograph, the board's middle at the pose: 4x4 samples a pixel, blurred by 0.7 px, with noise.

    Where on the board a sample lies is interpolated by splines between exact rays 8 px apart. A sample near an edge is grey by how
    much of it the edge leaves, so that edges are where they should be to some thousandths of a pixel.
    """
    from scipy.interpolate import RectBivariateSpline

    step, fine = 8.0, 4
    columns, rows = corners
    grid = np.stack(np.meshgrid(np.linspace(-1, columns, 50), np.linspace(-1, rows, 50), [0.0]), axis=-1).reshape(-1, 3)
    seen = camera.project(pose.apply((grid - [(columns - 1) / 2, (rows - 1) / 2, 0.0]) * square_mm))
    low = np.maximum(np.floor(seen.min(axis=0)).astype(int) - 6, 0)
    high = np.minimum(np.ceil(seen.max(axis=0)).astype(int) + 7, [camera.width_px, camera.height_px])
    u, v = (np.linspace(a - 0.5, b - 0.5, int((b - a) / step) + 4) for a, b in zip(low, high, strict=True))
    rays = camera.unproject(np.stack(np.meshgrid(u, v), axis=-1))
    assert np.isfinite(rays).all()
    inverse = pose.rotation.T
    origin, along = inverse @ -pose.translation_mm, rays @ inverse.T
    board = origin[:2] - along[..., :2] * (origin[2] / along[..., 2])[..., None]
    column, row = ((np.arange(fine * a, fine * b) + 0.5) / fine - 0.5 for a, b in zip(low, high, strict=True))
    shade = np.ones((len(row), len(column)), dtype=np.float32)
    inside = shade > 0
    for axis, inner in enumerate(corners):
        x = RectBivariateSpline(v, u, board[..., axis] / square_mm + (inner - 1) / 2)(row, column).astype(np.float32)
        width = np.hypot(np.gradient(x, axis=0), np.gradient(x, axis=1))  # of a sample, in squares
        nearest = np.clip(np.rint(x), 0, inner - 1)
        edge = np.clip(2 * (x - nearest) / width, -1, 1)
        shade *= np.where(nearest % 2 == 0, edge, -edge)
        inside &= (x > -1) & (x < inner)
    light = cv2.GaussianBlur(np.where(inside, 110 + 85 * shade, 195).astype(np.float32), (0, 0), 0.7 * fine)
    gray = np.full((camera.height_px, camera.width_px), 195.0)
    box = tuple(int(n) for n in high - low)
    gray[low[1] : high[1], low[0] : high[0]] = cv2.resize(light, box, interpolation=cv2.INTER_AREA)
    return np.clip(np.rint(gray + rng.normal(size=gray.shape) * noise_grey), 0, 255).astype(np.uint8)
