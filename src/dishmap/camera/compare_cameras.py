"""How far two cameras differ, as a map of pixels over the picture, and the cameras from two halves of a calibration's views.

Two calibrations put the camera itself in slightly different places: a turn and a shift of the camera's frame change no measured
shape. They are fitted to points at the working distance and removed, as mrcal-show-projection-diff does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.board import BoardView
from dishmap.camera.calibrate import Calibration, calibrate
from dishmap.camera.model import Camera
from dishmap.camera.screening import FEWEST_VIEWS
from dishmap.errors import CameraError, DishmapError
from dishmap.transforms import cross_matrix, rotation_from_vector

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

GRID = (24, 32)
MOTION_STEPS = 10
# The area that corners cover: cells of the grid with a corner within this many cells.
COVER_CELLS = 1.0
FEWEST_POINTS = 6


@dataclass(frozen=True)
class CameraDifference:
    """Second camera minus first on a grid over the picture.

    pixels (R, C, 2): where; shift_px (R, C, 2): how far the second camera sees the same point from there, the motion between
    the two frames removed; covered (R, C): where corners were seen. NaN where a lens model does not reach.
    """

    pixels: Array
    shift_px: Array
    covered: Mask

    @property
    def length_px(self) -> Array:
        """Length of the difference (R, C), px."""
        return np.asarray(np.linalg.norm(self.shift_px, axis=-1))

    @property
    def covered_rms_px(self) -> float:
        """Root mean square length over the covered area, px."""
        return float(np.sqrt(np.nanmean(self.length_px[self.covered] ** 2)))

    @property
    def covered_max_px(self) -> float:
        """Largest length over the covered area, px."""
        return float(np.nanmax(self.length_px[self.covered]))


def picture_grid(width_px: int, height_px: int, grid: tuple[int, int] = GRID) -> Array:
    """Pixels (R, C, 2) spread evenly over a picture, from edge to edge."""
    rows, columns = grid
    return np.stack(np.meshgrid(np.linspace(-0.5, width_px - 0.5, columns), np.linspace(-0.5, height_px - 0.5, rows)), axis=-1)


def covered_area(pixels: Array, seen_px: Array) -> Mask:
    """Which points of a grid (R, C, 2) have a corner of seen_px (N, 2) within a cell of the grid."""
    step = np.array([pixels[0, 1, 0] - pixels[0, 0, 0], pixels[1, 0, 1] - pixels[0, 0, 1]])
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(seen_px / step).query(pixels / step, distance_upper_bound=COVER_CELLS * np.sqrt(2))
    return np.asarray(np.isfinite(distance))


def camera_difference(first: Camera, second: Camera, distance_mm: float, *seen_px: Array) -> CameraDifference:
    """Compare two cameras of one picture size over points at a distance.

    seen_px, each (N, 2): where corners were seen, for the first camera and for the second; the area that all of them cover is called
    covered, and there the motion between the frames is fitted (everywhere without). distance_mm: from the camera to the points,
    infinity to allow a turn only. Raises CameraError for cameras of different pictures.
    """
    if (first.width_px, first.height_px) != (second.width_px, second.height_px):
        raise CameraError(
            f"cameras of {first.width_px}x{first.height_px} and {second.width_px}x{second.height_px} px cannot be compared; "
            "both need pictures of one size"
        )
    pixels = picture_grid(first.width_px, first.height_px)
    covered = np.ones(pixels.shape[:2], dtype=bool)
    for seen in seen_px:
        covered &= covered_area(pixels, seen)
    rays = first.unproject(pixels)
    near = np.isfinite(distance_mm)
    points = rays * (distance_mm / rays[..., 2:] if near else 1.0)
    moved = _moved(second, points, pixels, covered, near)
    return CameraDifference(pixels, second.project(moved) - pixels, covered)


def _moved(camera: Camera, points: Array, pixels: Array, covered: Mask, near: bool) -> Array:
    """Points (R, C, 3) after the small motion with which a camera sees them nearest to pixels, where covered."""
    moved = points
    for _ in range(MOTION_STEPS):
        seen, by_point = camera.project_with_point_jacobian(moved)
        residual = pixels - seen
        good = covered & np.isfinite(residual).all(axis=-1) & np.isfinite(by_point).all(axis=(-2, -1))
        if good.sum() < FEWEST_POINTS:
            return moved
        turn = -by_point[good] @ cross_matrix(moved[good])
        design = np.concatenate([turn, by_point[good]], axis=-1) if near else turn
        scale = np.linalg.norm(design, axis=(0, 1))
        step = np.linalg.lstsq((design / scale).reshape(-1, design.shape[-1]), residual[good].ravel(), rcond=None)[0] / scale
        moved = moved @ rotation_from_vector(step[None, :3])[0].T + (step[3:] if near else 0.0)
        if np.abs(step[:3]).max() < 1e-12:
            break
    return moved


@dataclass(frozen=True)
class Halves:
    """Cameras from two halves of the views, and how they differ.

    focal_sigmas: difference of the focal lengths (2,) over its claimed sigma. distance_mm: at which they are compared.
    """

    cameras: tuple[Camera, Camera]
    difference: CameraDifference
    distance_mm: float
    focal_sigmas: Array


def split_views(views: Sequence[BoardView]) -> tuple[list[BoardView], list[BoardView]]:
    """Every other view: people change what they do along a series, and so both halves hold all of it."""
    return list(views[::2]), list(views[1::2])


def halves_of(calibration: Calibration) -> Halves | None:
    """Calibrate each half of the views alone and compare; None when there are too few views or a half is no calibration."""
    if len(calibration.views) < 2 * FEWEST_VIEWS:
        return None
    camera = calibration.camera
    try:
        made = [
            calibrate(half, camera.width_px, camera.height_px, calibration.lens, not calibration.board.free)
            for half in split_views(calibration.views)
        ]
    except DishmapError:
        return None
    first, second = made[0].camera, made[1].camera
    distance = working_distance_mm(calibration)
    seen = [np.concatenate([view.pixels for view in half.views]) for half in made]
    assert first.covariance is not None
    assert second.covariance is not None
    sigma = np.sqrt(np.diag(first.covariance)[:2] + np.diag(second.covariance)[:2])
    apart = (second.focal_px - first.focal_px) / sigma
    return Halves((first, second), camera_difference(first, second, distance, *seen), distance, apart)


def working_distance_mm(calibration: Calibration) -> float:
    """Median distance of the boards' middles along the camera's axis, mm."""
    middle = np.append(calibration.board.middle_mm, 0.0)
    return float(np.median([pose.apply(middle)[2] for pose in calibration.poses]))
