"""A bundle: one camera, the board's shape and print, and its pose in each view; and what is known of them beforehand.

Camera parameters and the terms of the board's shape are called *shared*: each view has them in common.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.transforms import rotation_from_vector

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

POSE = 6
# Powers of the radius with which k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 act, relative to the radius itself.
OPENCV_POWERS, FISHEYE_POWERS = (2, 4, 1, 1, 6, 2, 4, 6, 1, 3, 1, 3), (2, 4, 6, 8)
STIFFNESS = 0.5


@dataclass(frozen=True)
class BoardCorners:
    """Corners of all views in one run: pixels (M, 2), board_mm (M, 3), where each view starts (V + 1,), how the board can deform.

    shapes (M, 3, F): how far each corner moves, in mm, when a term of the board's shape has size 1 mm (`board.shapes_of`). point (M,):
    which point of the board each corner is. when (M,): when it was read, in units of the picture's readout from its middle, -0.5 to 0.5;
    zero where all of a picture is taken at once. middle_mm (2,): about which the board turns while it is read.
    """

    pixels: Array
    board_mm: Array
    bounds: NDArray[np.int64]
    shapes: Array
    point: NDArray[np.int64]
    when: Array
    middle_mm: Array

    @cached_property
    def slices(self) -> list[slice]:
        """The rows of each view."""
        return [slice(a, b) for a, b in zip(self.bounds[:-1], self.bounds[1:], strict=True)]

    @cached_property
    def view(self) -> NDArray[np.int64]:
        """Index of the view of each corner (M,)."""
        return np.repeat(np.arange(len(self.bounds) - 1), np.diff(self.bounds))


@dataclass(frozen=True)
class Bundle:
    """A camera, the board's pose in each view, camera from board: rotation (V, 3, 3), translation_mm (V, 3), and the board itself.

    shape_mm (F,): terms of the board's shape; print_mm (N, 2): error of each of its printed points, x and y. motion (V, 6): by how much
    the board turned about its middle (radians, camera's axes) and moved (mm) during the readout of each picture.
    """

    camera: Camera
    rotation: Array
    translation_mm: Array
    shape_mm: Array
    print_mm: Array
    motion: Array

    @property
    def shared(self) -> Array:
        """Camera parameters, then terms of the board's shape (P + F,)."""
        return np.concatenate([self.camera.parameters, self.shape_mm])

    def residuals(self, corners: BoardCorners) -> Array:
        """Measured minus projected (M, 2), px; NaN where the lens model does not reach."""
        return corners.pixels - self.camera.project(self.points(corners))

    def points(self, corners: BoardCorners) -> Array:
        """Corners (M, 3) in the camera's frame at the moment when each was read."""
        turned = self.turned(corners)
        moved = self.translation_mm[corners.view]
        if self.motion.any():
            motion = self.motion[corners.view] * corners.when[:, None]
            moved = moved + np.cross(motion[:, :3], self.arms(corners, turned)) + motion[:, 3:]
        return np.asarray(turned + moved)

    def turned(self, corners: BoardCorners) -> Array:
        """Corners of the deformed board (M, 3), turned as the camera sees them but not yet shifted."""
        board = corners.board_mm + corners.shapes @ self.shape_mm
        board[:, :2] += self.print_mm[corners.point]
        return np.einsum("mij,mj->mi", self.rotation[corners.view], board)

    def arms(self, corners: BoardCorners, turned: Array) -> Array:
        """From the board's middle to its turned corners (M, 3)."""
        return np.asarray(turned - (self.rotation[:, :, :2] @ corners.middle_mm)[corners.view])

    def moved(self, free: Mask, shared_step: Array, pose_steps: Array, print_step: Array | None = None) -> Bundle:
        """Return the bundle after a step: rotations turned on the left, all else added.

        pose_steps: (V, 6), or (V, 12) with motions; print_step (N, 2).
        """
        shared = self.shared
        shared[free] += shared_step
        rotation = rotation_from_vector(pose_steps[:, :3]) @ self.rotation
        out = replace(self.with_shared(shared), rotation=rotation, translation_mm=self.translation_mm + pose_steps[:, 3:POSE])
        if pose_steps.shape[1] > POSE:
            out = replace(out, motion=self.motion + pose_steps[:, POSE:])
        return out if print_step is None else replace(out, print_mm=self.print_mm + print_step)

    def with_shared(self, shared: Array) -> Bundle:
        """The bundle with other camera parameters and shape (P + F,)."""
        count = len(self.camera.parameters)
        return replace(self, camera=self.camera.with_parameters(shared[:count]), shape_mm=shared[count:])

    def of_views(self, keep: Mask) -> Bundle:
        """The bundle of some of the views (V,)."""
        return replace(self, rotation=self.rotation[keep], translation_mm=self.translation_mm[keep], motion=self.motion[keep])


@dataclass(frozen=True)
class Prior:
    """How freely parameters may move: it decides only what the corners leave open.

    About `expected` (P,), the focal lengths may move by themselves and the principal point by the half picture; at `radius` (tangent
    off the axis, of the farthest corner), each lens term may move a point by STIFFNESS of its distance from the axis.
    Without this the terms of a rational lens, which can stand in for each other, run away, and so does the focal length when
    all views are alike. shape_mm (F,): sigmas of the terms of the board's shape. print_mm: of each printed coordinate; motion (6,): of
    turns (radians) and shifts (mm) during a readout; both about none, and not estimated at all where they are 0. noise_px: sigma of one
    measured coordinate, which says what a corner weighs against the prior.
    """

    expected: Array
    radius: float
    noise_px: float
    shape_mm: Array
    print_mm: float = 0.0
    motion: Array | None = None

    def precision(self, bundle: Bundle) -> Array:
        """Precision of each shared parameter times the noise's variance (P + F,), in px^2 over the parameter's unit squared."""
        camera = bundle.camera
        powers = (FISHEYE_POWERS if camera.model == "fisheye" else OPENCV_POWERS)[: camera.distortion.size]
        lens = STIFFNESS / self.radius ** np.array(powers, dtype=float)
        place = [camera.width_px / 2, camera.height_px / 2]
        return (self.noise_px / np.concatenate([self.expected[:2], place, lens, self.shape_mm])) ** 2

    @property
    def pose_precision(self) -> Array:
        """The same of a view's pose, of which nothing is known, and motion (6,) or (12,)."""
        return np.concatenate([np.zeros(POSE), [] if self.motion is None else (self.noise_px / self.motion) ** 2])

    @property
    def print_precision(self) -> float:
        """The same of a printed coordinate; 0 where print errors are not estimated."""
        return (self.noise_px / self.print_mm) ** 2 if self.print_mm else 0.0

    def pull(self, bundle: Bundle) -> Array:
        """Distance of the shared parameters from what is expected (P + F,)."""
        return np.concatenate([bundle.camera.parameters - self.expected, bundle.shape_mm])

    def cost(self, bundle: Bundle) -> float:
        """What it adds to the sum of squares, px^2."""
        total = float(self.precision(bundle) @ self.pull(bundle) ** 2) + self.print_precision * float((bundle.print_mm**2).sum())
        return total if self.motion is None else total + float((bundle.motion**2 @ self.pose_precision[POSE:]).sum())
