"""The views of a calibration as one least-squares problem, which can be solved again from any start with any weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dishmap.camera import bundle as ba
from dishmap.camera.board import BENDS, BoardView, bends_of, board_frame, outline_shift
from dishmap.camera.bundle import BoardCorners, Bundle, Prior

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A sheet on a plate bows by less than this part of its half side (sigma): 1 mm on a board of 200 mm.
BEND_PART = 0.01
# Centres of outlines follow the camera; this many rounds bring them to rest, or a change below this many px.
MOST_ROUNDS, RESTING_PX = 6, 1e-6


@dataclass(frozen=True)
class Problem:
    """Views of one board by one camera.

    middle_mm, half_mm: frame of the bends (`board_frame`); expected (P,): camera parameters that the prior is about;
    flat: the board is taken as flat.
    """

    views: tuple[BoardView, ...]
    middle_mm: Array
    half_mm: float
    expected: Array
    flat: bool = False

    def of_views(self, views: Sequence[BoardView]) -> Problem:
        """The same problem with other views."""
        return replace(self, views=tuple(views))

    @property
    def has_circles(self) -> bool:
        """Whether the views hold outlines of circles."""
        return any(view.radius_mm is not None for view in self.views)

    def joined(self) -> BoardCorners:
        """All corners as they were measured."""
        bounds = np.cumsum([0, *(len(view.pixels) for view in self.views)])
        board = np.concatenate([view.board_mm for view in self.views])
        pixels = np.concatenate([view.pixels for view in self.views])
        return BoardCorners(pixels, board, bounds, bends_of(board, self.middle_mm, self.half_mm))

    def corners(self, bundle: Bundle) -> BoardCorners:
        """All corners; circles' outlines are replaced by the images of their centres, as this bundle sees the difference."""
        plain = self.joined()
        if not self.has_circles:
            return plain
        radius = np.concatenate([np.zeros(len(v.pixels)) if v.radius_mm is None else v.radius_mm for v in self.views])
        points = bundle.turned(plain) + bundle.translation_mm[plain.view]
        shift = outline_shift(bundle.camera, points, self._tangents(bundle, plain), radius)
        return replace(plain, pixels=plain.pixels - np.where(np.isfinite(shift), shift, 0.0))

    def _tangents(self, bundle: Bundle, corners: BoardCorners) -> Array:
        """Two unit vectors in the plane of the bent board at each corner (M, 3, 2), in the camera frame."""
        step = 1e-3 * self.half_mm
        tangents = np.zeros((len(corners.pixels), 3, 2))
        for axis in (0, 1):
            offset = np.zeros(3)
            offset[axis] = step
            rise = bends_of(corners.board_mm + offset, self.middle_mm, self.half_mm) - bends_of(
                corners.board_mm - offset, self.middle_mm, self.half_mm
            )
            tangents[:, axis, axis], tangents[:, 2, axis] = 1.0, rise @ bundle.bend_mm / (2 * step)
        return np.asarray(bundle.rotation[corners.view] @ tangents)

    def free(self, bundle: Bundle, camera: bool = True) -> Mask:
        """Which shared parameters are estimated: all, or all but the camera's; bends only where the board may bend."""
        count = len(bundle.camera.parameters)
        return np.concatenate([np.full(count, camera), np.full(len(BENDS), camera and not self.flat)])

    def prior(self, bundle: Bundle, corners: BoardCorners, weights: Array | None = None) -> Prior:
        """What is known before, weighed against the noise that the residuals show."""
        camera = bundle.camera
        radius = float((np.linalg.norm(corners.pixels - camera.principal_px, axis=1) / camera.focal_px.min()).max())
        residuals = bundle.residuals(corners)
        noise = ba.scale_px(residuals if weights is None else residuals[weights > 0])
        return Prior(self.expected, radius, noise, BEND_PART * self.half_mm)

    def solve(
        self, start: Bundle, weights: Array | None = None, free: Mask | None = None, robust: bool = False, prior: Prior | None = None
    ) -> Bundle:
        """The bundle that fits best; weights (M,), free, robust: see `bundle.adjust`."""
        bundle, free = start, self.free(start) if free is None else free
        corners = self.corners(bundle)
        for _ in range(MOST_ROUNDS):
            bundle = ba.adjust(bundle, corners, free, prior or self.prior(bundle, corners), weights, robust)
            if not self.has_circles:
                break
            before, corners = corners, self.corners(bundle)
            if np.abs(corners.pixels - before.pixels).max() < RESTING_PX:
                break
        return bundle


def problem_of(views: Sequence[BoardView], expected: Array, flat: bool = False) -> Problem:
    """The problem of these views, with the board's frame taken from them."""
    middle, half = board_frame(views)
    return Problem(tuple(views), middle, half, expected, flat)
