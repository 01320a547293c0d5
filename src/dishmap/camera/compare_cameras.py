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
from dishmap.camera.uncertainty import covered_area, picture_grid, scene_points
from dishmap.errors import CameraError, DishmapError
from dishmap.transforms import cross_matrix, rotation_from_vector

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MOTION_STEPS = 10
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
    points = scene_points(first, pixels, distance_mm)
    moved = _moved(second, points, pixels, covered, bool(np.isfinite(distance_mm)))
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


def halves_of(calibration: Calibration, distance_mm: float | None = None) -> Halves | None:
    """Calibrate each half of the views alone and compare; None when there are too few views or a half is no calibration.

    distance_mm: where they are compared, by default where the boards were.
    """
    if len(calibration.views) < 2 * FEWEST_VIEWS:
        return None
    camera = calibration.camera
    try:
        made = [
            calibrate(half, camera.width_px, camera.height_px, calibration.lens, not calibration.board.free, calibration.readout)
            for half in split_views(calibration.views)
        ]
    except DishmapError:
        return None
    first, second = made[0].camera, made[1].camera
    distance = distance_mm or working_distance_mm(calibration)
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
