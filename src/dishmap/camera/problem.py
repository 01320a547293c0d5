"""The views of a calibration as one least-squares problem, which can be solved again from any start with any weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dishmap.camera import adjustment as ba
from dishmap.camera.board import BENDS, CURVES, SHAPE_TERMS, STRETCHES, BoardView, board_frame, outline_shift, point_index, shapes_of
from dishmap.camera.bundle import BoardCorners, Bundle, Prior
from dishmap.camera.model import Camera

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A sheet on a plate bows by less than this part of its half side (sigma): 1 mm on a board of 200 mm.
BEND_PART = 0.01
# Printers stretch one side against the other by some parts in a thousand, and rollers that slip and worn paper paths curve lines as much.
STRETCH_PART = CURVE_PART = 0.002
# How a picture is read: all at once, or line by line.
READOUTS = ("global", "rows", "columns")
# Centres of outlines follow the camera; this many rounds bring them to rest, or a change below this many px.
MOST_ROUNDS, RESTING_PX = 6, 1e-6


@dataclass(frozen=True)
class Problem:
    """Views of one board by one camera.

    size_px: width and height of the pictures; middle_mm, half_mm: frame of the board's shape (`board_frame`); points_mm (N, 3): its points;
    expected (P,): camera parameters that the prior is about; flat: the board is taken as exact; readout: one of READOUTS. noise_px:
    sigma of a
    measured coordinate, taken from the residuals where it is 0; print_mm, motion_mm: how far a printed point is off (sigma), and how far
    the board moves while a picture is read; 0 where that is not estimated. curved: whether curves of the print are estimated too.
    """

    views: tuple[BoardView, ...]
    size_px: tuple[int, int]
    middle_mm: Array
    half_mm: float
    points_mm: Array
    expected: Array
    flat: bool = False
    readout: str = "global"
    noise_px: float = 0.0
    print_mm: float = 0.0
    motion_mm: float = 0.0
    curved: bool = False

    def of_views(self, views: Sequence[BoardView]) -> Problem:
        """The same problem with other views."""
        return replace(self, views=tuple(views))

    @property
    def has_circles(self) -> bool:
        """Whether the views hold outlines of circles."""
        return any(view.radius_mm is not None for view in self.views)

    @cached_property
    def joined(self) -> BoardCorners:
        """All corners as they were measured."""
        bounds = np.cumsum([0, *(len(view.pixels) for view in self.views)])
        board = np.concatenate([view.board_mm for view in self.views])
        pixels = np.concatenate([view.pixels for view in self.views])
        shapes = shapes_of(board, self.middle_mm, self.half_mm)
        axis = {"rows": 1, "columns": 0}.get(self.readout)
        when = np.zeros(len(pixels)) if axis is None else (pixels[:, axis] + 0.5) / self.size_px[axis] - 0.5
        return BoardCorners(pixels, board, bounds, shapes, point_index(self.points_mm, board), when, self.middle_mm)

    def start(self, camera: Camera, rotation: Array, translation_mm: Array) -> Bundle:
        """A bundle with the board as designed and at rest."""
        return Bundle(
            camera, rotation, translation_mm, np.zeros(len(SHAPE_TERMS)), np.zeros((len(self.points_mm), 2)), np.zeros((len(rotation), 6))
        )

    def corners(self, bundle: Bundle) -> BoardCorners:
        """All corners; circles' outlines are replaced by the images of their centres, as this bundle sees the difference."""
        plain = self.joined
        if not self.has_circles:
            return plain
        radius = np.concatenate([np.zeros(len(v.pixels)) if v.radius_mm is None else v.radius_mm for v in self.views])
        points = bundle.points(plain)
        shift = outline_shift(bundle.camera, points, self._tangents(bundle, plain), radius)
        return replace(plain, pixels=plain.pixels - np.where(np.isfinite(shift), shift, 0.0))

    def _tangents(self, bundle: Bundle, corners: BoardCorners) -> Array:
        """Two unit vectors in the plane of the bent board at each corner (M, 3, 2), in the camera frame."""
        step = 1e-3 * self.half_mm
        tangents = np.zeros((len(corners.pixels), 3, 2))
        for axis in (0, 1):
            offset = np.zeros(3)
            offset[axis] = step
            rise = shapes_of(corners.board_mm + offset, self.middle_mm, self.half_mm) - shapes_of(
                corners.board_mm - offset, self.middle_mm, self.half_mm
            )
            tangents[:, axis, axis], tangents[:, 2, axis] = 1.0, rise[:, 2] @ bundle.shape_mm / (2 * step)
        return np.asarray(bundle.rotation[corners.view] @ tangents)

    def free(self, bundle: Bundle, camera: bool = True) -> Mask:
        """Which shared parameters are estimated: all, or none of a known camera and board; no shape of an exact board."""
        count = len(bundle.camera.parameters)
        shape = np.full(len(SHAPE_TERMS), camera and not self.flat)
        shape[-len(CURVES) :] &= self.curved
        return np.concatenate([np.full(count, camera), shape])

    def prior(self, bundle: Bundle, corners: BoardCorners, weights: Array | None = None) -> Prior:
        """What is known before, weighed against the noise that the residuals show."""
        camera = bundle.camera
        radius = float((np.linalg.norm(corners.pixels - camera.principal_px, axis=1) / camera.focal_px.min()).max())
        residuals = bundle.residuals(corners)
        noise = (
            max(self.noise_px, ba.SMALLEST_SCALE_PX)
            if self.noise_px
            else ba.scale_px(residuals if weights is None else residuals[weights > 0])
        )
        shape = self.half_mm * np.array([BEND_PART] * len(BENDS) + [STRETCH_PART] * len(STRETCHES) + [CURVE_PART] * len(CURVES))
        motion = self.motion_mm * np.array([1 / self.half_mm] * 3 + [1.0] * 3) if self.motion_mm else None
        return Prior(self.expected, radius, noise, shape, self.print_mm, motion)

    def solve(
        self, start: Bundle, weights: Array | None = None, free: Mask | None = None, robust: bool = False, near: bool = False
    ) -> Bundle:
        """The bundle that fits best; weights (M,), free, robust, near: see `adjustment.adjust`."""
        bundle, free = start, self.free(start) if free is None else free
        corners = self.corners(bundle)
        for _ in range(MOST_ROUNDS):
            bundle = ba.adjust(bundle, corners, free, self.prior(bundle, corners), weights, robust, near)
            if not self.has_circles:
                break
            before, corners = corners, self.corners(bundle)
            if np.abs(corners.pixels - before.pixels).max() < RESTING_PX:
                break
        return bundle


def problem_of(views: Sequence[BoardView], camera: Camera, flat: bool = False, readout: str = "global") -> Problem:
    """The problem of these views, with the board's frame and points taken from them; camera: of the pictures' size, as expected."""
    middle, half = board_frame(views)
    points = np.unique(np.concatenate([view.board_mm for view in views]).round(6), axis=0)
    return Problem(tuple(views), (camera.width_px, camera.height_px), middle, half, points, camera.parameters, flat, readout)
