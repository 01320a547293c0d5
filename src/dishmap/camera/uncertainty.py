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


def projection_error(camera: Camera, grid: tuple[int, int] = GRID, remove_rotation: bool = False) -> ProjectionError:
    """Return the expected projection error of a calibrated camera over its picture.

    grid: rows and columns of points, spread evenly from edge to edge. remove_rotation: leave out the part that a small
    turn of the camera explains best over the whole picture. Nothing measured in the camera's own picture can see that
    part apart from the camera's attitude, so this is the error of shapes; without it, of directions.
    Raises CameraError when the camera carries no covariance.
    """
    if camera.covariance is None:
        raise CameraError("this camera carries no covariance; calibrate it with `dishmap calibrate` to get one")
    rows, columns = grid
    if rows < 2 or columns < 2:
        raise CameraError(f"a map of the projection error needs at least 2x2 points, not {rows}x{columns}")
    u, v = np.linspace(-0.5, camera.width_px - 0.5, columns), np.linspace(-0.5, camera.height_px - 0.5, rows)
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    jacobian = direction_jacobian(camera, pixels)
    if remove_rotation:
        jacobian = _without_rotation(camera, pixels, jacobian)
    covariance = jacobian @ camera.covariance @ np.swapaxes(jacobian, -1, -2)
    return ProjectionError(pixels, covariance)


def direction_jacobian(camera: Camera, pixels: ArrayLike) -> Array:
    """Derivative (..., 2, P) of the projection of fixed directions, those now seen at `pixels` (..., 2), by the camera parameters."""
    return camera.project_with_jacobians(camera.unproject(pixels))[2]


def _without_rotation(camera: Camera, pixels: Array, jacobian: Array) -> Array:
    """Take from each parameter's field of pixel shifts the rotation that fits it best over all points."""
    rays = camera.unproject(pixels)
    _, by_point, _ = camera.project_with_jacobians(rays)
    turn = -by_point @ cross_matrix(rays)
    good = np.isfinite(jacobian).all(axis=(-2, -1)) & np.isfinite(turn).all(axis=(-2, -1))
    design = turn[good].reshape(-1, 3)
    fitted, *_ = np.linalg.lstsq(design, jacobian[good].reshape(len(design), -1), rcond=None)
    return jacobian - turn @ fitted
