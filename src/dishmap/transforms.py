"""Rigid transforms that name both of their frames at the place of use, as in `camera_from_dish`.

`camera_from_dish.apply(points_dish)` gives points in the camera frame; transforms chain as
`camera_from_dish @ dish_from_target`, where the inner frame names must meet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.errors import InputError

Array = NDArray[np.float64]

# A rotation matrix read from a file may carry rounding; beyond this it is no rotation (file with 6 digits: 1e-6).
ROTATION_TOLERANCE = 1e-5


@dataclass(frozen=True)
class Pose:
    """A rigid transform: `x_outer = rotation @ x_inner + translation_mm`.

    rotation: (3, 3), orthonormal with determinant +1; translation_mm: (3,).
    """

    rotation: Array
    translation_mm: Array

    def __post_init__(self) -> None:
        rotation = np.asarray(self.rotation, dtype=float)
        translation = np.asarray(self.translation_mm, dtype=float)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise InputError(f"a pose needs a 3x3 rotation and 3 numbers of translation, not {rotation.shape} and {translation.shape}")
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
            raise InputError("a pose needs finite numbers; it holds NaN or infinity")
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
            raise InputError("the rotation of a pose is not orthonormal and right-handed")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation_mm", translation)

    @staticmethod
    def identity() -> Pose:
        """Return the transform that changes nothing."""
        return Pose(np.eye(3), np.zeros(3))

    @staticmethod
    def from_rotation_vector(rotation_vector_rad: ArrayLike, translation_mm: ArrayLike) -> Pose:
        """Make a pose from a rotation vector (3,) in radians and a translation (3,) in mm."""
        return Pose(rotation_from_vector(np.asarray(rotation_vector_rad, dtype=float)), np.asarray(translation_mm, dtype=float))

    @property
    def rotation_vector_rad(self) -> Array:
        """The rotation as axis times angle (3,), radians."""
        return vector_from_rotation(self.rotation)

    def apply(self, points_mm: ArrayLike) -> Array:
        """Transform points (..., 3)."""
        return np.asarray(points_mm, dtype=float) @ self.rotation.T + self.translation_mm

    def rotate(self, directions: ArrayLike) -> Array:
        """Rotate directions (..., 3) without the translation."""
        return np.asarray(directions, dtype=float) @ self.rotation.T

    def inverse(self) -> Pose:
        """Return the transform the other way round."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation_mm)

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.rotation @ other.rotation, self.rotation @ other.translation_mm + self.translation_mm)


def cross_matrix(vectors: ArrayLike) -> Array:
    """Return matrices (..., 3, 3) with `cross_matrix(a) @ b == cross(a, b)`."""
    v = np.asarray(vectors, dtype=float)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - np.swapaxes(out, -1, -2)


def rotation_from_vector(rotation_vector_rad: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians (Rodrigues' formula)."""
    v = np.asarray(rotation_vector_rad, dtype=float)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    k = cross_matrix(v)
    # sin(a)/a and (1-cos(a))/a^2, with sinc forms that stay exact through zero
    return np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (k @ k)


def right_jacobian(rotation_vector_rad: ArrayLike) -> Array:
    """J (3, 3) of a rotation vector v (3,) with exp(v + d) = exp(v) exp(J d) for small d (Sola et al. 2018, eq. 143)."""
    v = np.asarray(rotation_vector_rad, dtype=float)
    angle, k = float(np.linalg.norm(v)), cross_matrix(v)
    if angle < 1e-4:
        return np.asarray(np.eye(3) - k / 2 + k @ k / 6)
    return np.asarray(np.eye(3) - (1 - np.cos(angle)) / angle**2 * k + (angle - np.sin(angle)) / angle**3 * k @ k)


def vector_from_rotation(rotation: ArrayLike) -> Array:
    """Rotation vector (3,) in radians of one rotation matrix (3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(np.asarray(rotation, dtype=float)).as_rotvec(), dtype=float)


def angle_between_rad(a: ArrayLike, b: ArrayLike) -> Array:
    """Angle between directions (..., 3), exact for small angles where arccos is not."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))
