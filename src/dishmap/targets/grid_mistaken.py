"""What a photograph shows in which the grid was not found: another kind of grid, a chessboard, or something too fine to resolve.

Squares and the dark fields of a chessboard look like crossings to a search for dark blobs with arms, and form a lattice. Between
neighbours that are separate squares there is no ink; beside the places of a chessboard's lattice there is ink, where lines have ground.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.grid_crossings import Level
from dishmap.targets.grid_refine import bilinear, whole_cells
from dishmap.targets.threshold import sampled

Array = NDArray[np.float64]

# Where a cell is looked at, in parts of it: along its sides, beside its corners (chessboards are dark there), and where it is ground.
BESIDE, GROUND = 0.2, 0.35
# A side shows ink beyond this part of the depth, and most sides do; ground beside a crossing is below the other.
INK, MOST_SIDES, DARK_BESIDE = 0.25, 0.5, 0.78
# A fine grid: windows of so many pixels of which most have the strongest part of their spectrum at a period below the last one, so many
# times over the median there. Periods above the first are shading.
WINDOW_PX, LONGEST_PX, FINE_PX, PEAK_TIMES = 256, 60.0, 9.0, 150.0

LINES, SQUARES, CHESSBOARD = "a grid of lines", "separate squares", "a chessboard"


def kind_of(level: Level, table: Array) -> str:
    """What a table of dark places (C, R, 2) on a lattice is: `LINES`, `SQUARES` or `CHESSBOARD`."""
    around, _ = whole_cells(level, table)
    if not len(around):
        return LINES
    sides = np.array([(0.5, 0.0), (0.5, 1.0), (0.0, 0.5), (1.0, 0.5)])
    beside, ground = (np.array([(x, y) for x in (at, 1 - at) for y in (at, 1 - at)]) for at in (BESIDE, GROUND))
    ground = np.concatenate([ground, [(0.5, 0.5)]])
    corners = sampled(level.image, around).mean(axis=1, keepdims=True)
    light, dark = sampled(level.image, bilinear(around, ground)).max(axis=1, keepdims=True), corners
    depth = np.maximum(light - dark, 1.0)
    on_side, next_to = ((light - sampled(level.image, bilinear(around, at))) / depth for at in (sides, beside))
    if np.median(next_to) > DARK_BESIDE:
        return CHESSBOARD
    return LINES if (on_side > INK).mean() > MOST_SIDES else SQUARES


def fine_period_px(image: NDArray[Any]) -> float:
    """The period of the texture that makes most of five windows of an image, if it is too fine to resolve; else 0."""
    height, width = image.shape
    size = min(WINDOW_PX, height, width)
    if size < WINDOW_PX // 4:
        return 0.0
    window = np.hanning(size)[:, None] * np.hanning(size)
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
    fine, any_ = frequency > 1 / FINE_PX, frequency > 1 / LONGEST_PX
    found = []
    for down, right in ((0.5, 0.5), (0.3, 0.3), (0.3, 0.7), (0.7, 0.3), (0.7, 0.7)):
        v, u = int(down * (height - size)), int(right * (width - size))
        patch = image[v : v + size, u : u + size].astype(float)
        power = np.where(any_, np.abs(np.fft.rfft2((patch - patch.mean()) * window)) ** 2, 0.0)
        peak = np.unravel_index(np.argmax(power), power.shape)
        if fine[peak] and power[peak] > PEAK_TIMES * max(float(np.median(power[fine])), 1e-9):
            found.append(1 / frequency[peak])
    return float(np.median(found)) if len(found) >= 3 else 0.0
