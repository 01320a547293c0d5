"""Which of the four arms of a crossing are there: lines end, break, and are hidden."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.grid_fit import HALF
from dishmap.targets.grid_pixels import NodePixels
from dishmap.targets.grid_shapes import CELL, NodeShapes
from dishmap.targets.lattice_map import LatticeMaps

Array = NDArray[Any]
Bool = NDArray[Any]

# An arm that shows less than this part of the contrast of the opposite one is not there, nor a line that shows so little of the other's.
# Of a line that is thin beside the blur, a place that is a little off hides much.
LEAST_PART, LEAST_LINE_PART = 0.5, 0.2
# An arm is seen if so many pixels' worth of it lie clear of the other line.
LEAST_PIXELS = 0.2
# Blurs from the other line's edge at which an arm begins.
CLEAR_BLURS = 1.5


def clear_of_ends(shapes: NodeShapes, maps: LatticeMaps, reach_px: float) -> NodeShapes:
    """The shapes with arms cut to a node's own cell, and short of their ends by the reach of the blur."""
    step = np.linalg.norm(maps.step_px, axis=1)
    return replace(shapes, arms=np.clip(shapes.arms - reach_px / step[:, :, None], 0.0, CELL))


def arms_there(pixels: NodePixels, light: Array, cover: NDArray[Any], x: Array, blur_px: float) -> Bool:
    """Where (n, 2, 2) the arm of each band on its negative and positive side shows ink, by what `levels_at` says at x (n, G)."""
    single = light.astype(np.float32)
    ground = single[:, :1] + single[:, 1:2] * pixels.s + single[:, 2:3] * pixels.t
    depth = (ground - pixels.grey) * pixels.used
    amount = np.zeros((len(x), 2, 2))
    pixel_count = np.zeros((len(x), 2, 2))
    for band in (0, 1):
        own, other = (_outside_px(pixels, x, k) for k in (band, 1 - band))
        clear = (own < 0) & (other > np.float32(CLEAR_BLURS * blur_px)) & pixels.used
        for side, sign in ((0, -1), (1, 1)):
            here = cover * (clear & (sign * pixels.across[1 - band] > 0))
            pixel_count[:, band, side] = here.sum(axis=1)
            amount[:, band, side] = (here * depth).sum(axis=1) / np.maximum((here * cover).sum(axis=1), 1e-6)
    amount[pixel_count < LEAST_PIXELS] = 0.0
    line = np.maximum(amount.max(axis=2, keepdims=True), 0.0)
    there = (amount > LEAST_PART * line) & (line > LEAST_LINE_PART * line.max(axis=1, keepdims=True))
    return np.asarray(there)


def without_arms(pixels: NodePixels, x: Array, there: Bool, reach_px: float) -> NodePixels:
    """The pixels without those on the side of an arm that is not there."""
    used = pixels.used.copy()
    for band in (0, 1):
        near = _outside_px(pixels, x, band) < reach_px
        for side, sign in ((0, -1), (1, 1)):
            gone = ~there[:, band, side]
            if gone.any():
                used[gone] &= ~(near[gone] & (sign * pixels.across[1 - band][gone] > 0))
    return replace(pixels, used=used)


def _outside_px(pixels: NodePixels, x: Array, band: int) -> NDArray[Any]:
    """How far (n, P) pixels lie outside a band, negative inside."""
    half = x[:, HALF][:, band, None].astype(np.float32)
    return np.asarray((np.abs(pixels.across[band]) - half) * pixels.scale[band])
