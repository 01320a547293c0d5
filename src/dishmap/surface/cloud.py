"""The measured points of one photograph, with what is known about their errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.errors import InputError
from dishmap.transforms import Pose

Array = NDArray[np.float64]

FRAMES = ("camera", "dish", "spacecraft")
# Normals are unit vectors to rounding, or to what a file with 6 digits keeps.
NORMAL_TOLERANCE = 1e-5


@dataclass(frozen=True)
class PointCloud:
    """Centres of targets in one frame; N points, P camera parameters.

    ids (N,); position_mm (N, 3); normal (N, 3): unit, towards the camera's side; center_px (N, 2): the centre's projection;
    covariance_mm2 (N, 3, 3), sigma_normal_rad (N,) and covariance_px2 (N, 2, 2): from each target's own pixel noise alone,
    independent from target to target; calibration_jacobian (N, 3, P): d position / d camera parameters, which all points
    share, or None where it is not known; quality (N,): bits of `dishmap.quality`; frame: one of FRAMES.
    Raises InputError when arrays disagree or hold NaN.
    """

    ids: NDArray[np.int64]
    position_mm: Array
    normal: Array
    center_px: Array
    covariance_mm2: Array
    sigma_normal_rad: Array
    covariance_px2: Array
    calibration_jacobian: Array | None
    quality: NDArray[np.int64]
    frame: str

    def __post_init__(self) -> None:
        n = np.size(self.ids)
        shapes = {
            "position_mm": (3,),
            "normal": (3,),
            "center_px": (2,),
            "covariance_mm2": (3, 3),
            "sigma_normal_rad": (),
            "covariance_px2": (2, 2),
        }
        for name, shape in shapes.items():
            self._set(name, np.asarray(getattr(self, name), dtype=float), (n, *shape))
        for name in ("ids", "quality"):
            self._set(name, np.asarray(getattr(self, name), dtype=np.int64), (n,))
        if self.calibration_jacobian is not None:
            jacobian = np.asarray(self.calibration_jacobian, dtype=float)
            self._set("calibration_jacobian", jacobian, (n, 3, jacobian.shape[-1] if jacobian.ndim else 0))
        if self.frame not in FRAMES:
            raise InputError(f"unknown frame {self.frame!r}; use one of {', '.join(FRAMES)}")
        if np.unique(self.ids).size != n:
            raise InputError("the ids of a point cloud must differ")
        if n and np.abs(np.linalg.norm(self.normal, axis=1) - 1).max() > NORMAL_TOLERANCE:
            raise InputError("the normals of a point cloud must be unit vectors")

    def _set(self, name: str, value: NDArray[np.generic], shape: tuple[int, ...]) -> None:
        if value.shape != shape:
            raise InputError(f"a point cloud of {shape[0]} points needs {name} of shape {shape}, not {value.shape}")
        if not np.isfinite(np.asarray(value, dtype=float)).all():
            raise InputError(f"{name} of a point cloud holds NaN or infinity")
        object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.ids)


def transform_cloud(cloud: PointCloud, pose: Pose, frame: str) -> PointCloud:
    """The cloud in another frame, `pose` being `frame_from_<cloud.frame>`: positions, normals, covariances, Jacobian.

    The pose is taken as exact; image quantities stay. Raises InputError for an unknown frame.
    """
    turn = pose.rotation
    jacobian = cloud.calibration_jacobian
    return replace(
        cloud,
        position_mm=pose.apply(cloud.position_mm),
        normal=pose.rotate(cloud.normal),
        covariance_mm2=turn @ cloud.covariance_mm2 @ turn.T,
        calibration_jacobian=None if jacobian is None else turn @ jacobian,
        frame=frame,
    )


def select_points(cloud: PointCloud, keep: ArrayLike) -> PointCloud:
    """The points of a boolean mask (N,) or of indices (K,)."""
    keep = np.asarray(keep)
    names = ("ids", "position_mm", "normal", "center_px", "covariance_mm2", "sigma_normal_rad", "covariance_px2", "quality")
    jacobian = cloud.calibration_jacobian
    chosen = {name: getattr(cloud, name)[keep] for name in names}
    return replace(cloud, calibration_jacobian=None if jacobian is None else jacobian[keep], **chosen)


def calibration_factor_mm(cloud: PointCloud, camera_covariance: ArrayLike) -> Array:
    """Errors that all points share through the camera's calibration, as a factor F (N, 3, P).

    camera_covariance (P, P), in the order of the Jacobian's parameters. Two coordinates a, b of any two points covary by
    F[a] . F[b]: the factor stands for the full (3N, 3N) covariance without writing it out.
    Raises InputError when the cloud has no Jacobian or the covariance does not fit it.
    """
    if cloud.calibration_jacobian is None:
        raise InputError("these points carry no Jacobian to the camera's parameters, so their shared error is not known")
    covariance = np.asarray(camera_covariance, dtype=float)
    n = cloud.calibration_jacobian.shape[-1]
    if covariance.shape != (n, n) or not np.isfinite(covariance).all():
        raise InputError(f"the camera's covariance must be {n}x{n} finite numbers, not {covariance.shape}")
    # eigenvectors rather than Cholesky: a covariance with fixed parameters is only semi-definite
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray(cloud.calibration_jacobian @ (vectors * np.sqrt(np.maximum(values, 0.0))))


def calibration_covariance_mm2(cloud: PointCloud, camera_covariance: ArrayLike) -> Array:
    """Covariance (N, 3, 3) of each point from the camera's calibration; between points see `calibration_factor_mm`."""
    factor = calibration_factor_mm(cloud, camera_covariance)
    return np.asarray(factor @ np.swapaxes(factor, -1, -2))
