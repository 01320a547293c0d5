"""Which of the four arms of a crossing are there: lines end, break, and are hidden."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.grid_fit import HALF, NodeFit
from dishmap.targets.grid_pixels import NodePixels
from dishmap.targets.grid_shapes import CELL, NodeShapes
from dishmap.targets.lattice_map import LatticeMaps

Array = NDArray[Any]
Bool = NDArray[Any]

# An arm shows less than this part of the contrast of the two best: it is not there.
LEAST_PART = 0.5
# An arm is seen if so many pixels' worth of it lie clear of the other line.
LEAST_PIXELS = 1.0
# Blurs from the other line's edge at which an arm begins.
CLEAR_BLURS = 2.0


def clear_of_ends(shapes: NodeShapes, maps: LatticeMaps, reach_px: float) -> NodeShapes:
    """The shapes with arms that end within a node's cell cut short of their ends, by the reach of the blur."""
    step = np.linalg.norm(maps.step_px, axis=1)
    short = np.maximum(shapes.arms - reach_px / step[:, :, None], 0.0)
    return replace(shapes, arms=np.where(shapes.arms < CELL, short, shapes.arms))


def arms_there(pixels: NodePixels, fit: NodeFit, x: Array, crossing_blur_px: float) -> Bool:
    """Where (n, 2, 2) the arm of each band on its negative and positive side shows ink; fit: of all pixels, at x (n, G)."""
    single = fit.light.astype(np.float32)
    ground = single[:, :1] + single[:, 1:2] * pixels.s + single[:, 2:3] * pixels.t
    depth = (ground - pixels.grey) * pixels.used
    amount = np.zeros((len(x), 2, 2))
    pixel_count = np.zeros((len(x), 2, 2))
    for band in (0, 1):
        own, other = (_outside_px(pixels, x, k) for k in (band, 1 - band))
        clear = (own < 0) & (other > np.float32(CLEAR_BLURS * crossing_blur_px)) & pixels.used
        for side, sign in ((0, -1), (1, 1)):
            here = fit.cover * (clear & (sign * pixels.across[1 - band] > 0))
            pixel_count[:, band, side] = here.sum(axis=1)
            amount[:, band, side] = (here * depth).sum(axis=1) / np.maximum((here * fit.cover).sum(axis=1), 1e-6)
    amount[pixel_count < LEAST_PIXELS] = 0.0
    usual = np.sort(amount.reshape(len(x), 4), axis=1)[:, 2]
    return np.asarray(amount > np.maximum(LEAST_PART * usual, 0.0)[:, None, None])


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
