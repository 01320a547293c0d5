"""What a camera's calibration leaves unknown, as a map of pixels over the picture: the paper's Fig. 1.

The covariance of the camera parameters is propagated to the projection of fixed directions of the camera frame. A direction is
enough: where a ray meets the picture does not depend on the depth along it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.camera.model import Camera
from dishmap.errors import CameraError
from dishmap.transforms import cross_matrix

Array = NDArray[np.float64]

GRID = (24, 32)
# The area that corners cover: points of the grid with a corner within this many cells.
COVER_CELLS = 1.0
# A motion is fitted over at least so many points.
FEWEST_POINTS = 6


@dataclass(frozen=True)
class ProjectionError:
    """Expected projection error on a grid over the picture.

    pixels (R, C, 2): where; covariance_px2 (R, C, 2, 2): of the projected pixel. NaN where the lens model does not reach.
    """

    pixels: Array
    covariance_px2: Array

    @property
    def sigma_px(self) -> Array:
        """Root mean square length of the error (R, C), px: the root of the covariance's trace."""
        return np.asarray(np.sqrt(np.trace(self.covariance_px2, axis1=-2, axis2=-1)))

    @property
    def rms_px(self) -> float:
        """Root mean square of the error over the whole picture, px."""
        return float(np.sqrt(np.nanmean(self.sigma_px**2)))


def picture_grid(width_px: int, height_px: int, grid: tuple[int, int] = GRID) -> Array:
    """Pixels (R, C, 2) spread evenly over a picture, from edge to edge."""
    rows, columns = grid
    return np.stack(np.meshgrid(np.linspace(-0.5, width_px - 0.5, columns), np.linspace(-0.5, height_px - 0.5, rows)), axis=-1)


def covered_area(pixels: Array, seen_px: Array) -> NDArray[np.bool_]:
    """Which points of a grid (R, C, 2) have a corner of seen_px (N, 2) within a cell of the grid."""
    from scipy.spatial import cKDTree

    step = np.array([pixels[0, 1, 0] - pixels[0, 0, 0], pixels[1, 0, 1] - pixels[0, 0, 1]])
    distance, _ = cKDTree(seen_px / step).query(pixels / step, distance_upper_bound=COVER_CELLS * np.sqrt(2))
    return np.asarray(np.isfinite(distance))


def scene_points(camera: Camera, pixels: Array, distance_mm: float) -> Array:
    """Points (..., 3) seen at pixels (..., 2), on a plane across the axis at a distance; unit rays for an infinite one."""
    rays = camera.unproject(pixels)
    return rays * (distance_mm / rays[..., 2:]) if np.isfinite(distance_mm) else rays


def projection_error(
    camera: Camera,
    grid: tuple[int, int] = GRID,
    remove_rotation: bool = False,
    distance_mm: float | None = None,
    covered: NDArray[np.bool_] | None = None,
) -> ProjectionError:
    """Return the expected projection error of a calibrated camera over its picture.

    grid: rows and columns of points, spread evenly from edge to edge. remove_rotation: leave out the part that a small
    turn of the camera explains best. Nothing measured in the camera's own picture can see that part apart from the camera's
    attitude, so this is the error of shapes; without it, of directions. distance_mm: leave out the part that a small turn
    and shift explain best, for points at this distance: the error of shapes there. covered (R, C): fit the motion over these points only.
    Raises CameraError when the camera carries no covariance.
    """
    if camera.covariance is None:
        raise CameraError("this camera carries no covariance; calibrate it with `dishmap calibrate` to get one")
    if min(grid) < 2:
        raise CameraError(f"a map of the projection error needs at least 2x2 points, not {grid[0]}x{grid[1]}")
    pixels = picture_grid(camera.width_px, camera.height_px, grid)
    jacobian = direction_jacobian(camera, pixels)
    if remove_rotation or distance_mm is not None:
        points = scene_points(camera, pixels, np.inf if distance_mm is None else distance_mm)
        jacobian = _without_motion(camera, points, jacobian, distance_mm is not None, covered)
    covariance = jacobian @ camera.covariance @ np.swapaxes(jacobian, -1, -2)
    return ProjectionError(pixels, covariance)


def direction_jacobian(camera: Camera, pixels: ArrayLike) -> Array:
    """Derivative (..., 2, P) of the projection of fixed directions, those now seen at `pixels` (..., 2), by the camera parameters."""
    return camera.project_with_jacobians(camera.unproject(pixels))[2]


def _without_motion(camera: Camera, points: Array, jacobian: Array, shift: bool, covered: NDArray[np.bool_] | None) -> Array:
    """Take from each parameter's field of pixel shifts the turn (and shift) that fits it best over all points, or those covered."""
    _, by_point = camera.project_with_point_jacobian(points)
    motion = -by_point @ cross_matrix(points)
    if shift:
        motion = np.concatenate([motion, by_point], axis=-1)
    good = np.isfinite(jacobian).all(axis=(-2, -1)) & np.isfinite(motion).all(axis=(-2, -1))
    if covered is not None:
        good &= covered
    if good.sum() < FEWEST_POINTS:
        return jacobian
    design = motion[good].reshape(-1, motion.shape[-1])
    scale = np.linalg.norm(design, axis=0)
    fitted, *_ = np.linalg.lstsq(design / scale, jacobian[good].reshape(len(design), -1), rcond=None)
    return jacobian - motion @ (fitted / scale[:, None])
