"""Level_0 of a grid as the paper has it (section 4.3): crossings of lines by corner refinement, squares by "regression to square".

Both in the undistorted image, with straight edges over the short way that is looked at. Crossings: OpenCV's cornerSubPix, the point
that all gradients around are at right angles to. Squares: half-level points along each side as for ellipses (`subpixel`), a line
through those of each side by least squares, four corners where the lines meet, and the centre where the diagonals do.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dishmap.targets.grid_shapes import NodeShapes
from dishmap.targets.subpixel import LEAST_SHARE, PROFILE_PX, edge_points

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Half the window about a crossing: this part of a step, clear of a mark that begins at a quarter of it, or half the line and its edges.
WINDOW_PART, EDGE_PX, LEAST_WINDOW_PX = 0.2, 2.5, 3
# cornerSubPix moves a place until it moves by less than this.
CORNER_STEPS, CORNER_PX = 60, 1e-4
# Starts are moved by this much, so that even a place that was exact moves.
NUDGE_PX = 0.02
# A place farther than this part of a step from where it was found is another thing's.
FARTHEST_PART = 0.15
# Profiles along a side stand within this part of its half, and reach out up to this part of it, or of the gap.
ALONG_SIDE, PROFILES, ACROSS_PART = 0.75, 16, 0.45
# Half-level points about a straight side scatter by less than this.
LARGEST_RMS_PX = 0.5
# Corners in the target's own axes, and the axis that is constant along the side from each corner to the next, with its sign.
CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def level_0_px(image: NDArray[np.generic], shapes: NodeShapes, place_px: Array, step_px: Array) -> Array:
    """Refined places (K, 2) of nodes near `place_px` (K, 2), NaN where there is none.

    image (H, W), grey and undistorted; step_px (K, 2, 2): columns d place / d column and d place / d row.
    """
    refined = _crossings(image, shapes, place_px, step_px) if shapes.crossing else _squares(image, shapes, place_px, step_px)
    step = np.linalg.norm(step_px, axis=1).min(axis=1)
    # comparisons with NaN are false
    near = np.linalg.norm(refined - place_px, axis=1) < FARTHEST_PART * step
    return np.where(near[:, None], refined, np.nan)


def _crossings(image: NDArray[np.generic], shapes: NodeShapes, place_px: Array, step_px: Array) -> Array:
    step = np.linalg.norm(step_px, axis=1)
    # band 0 lies across the row's step
    half_line = (shapes.half * step[:, ::-1]).max(axis=1)
    window = np.maximum(WINDOW_PART * step.min(axis=1), np.maximum(half_line + EDGE_PX, LEAST_WINDOW_PX))
    size = np.rint(np.nan_to_num(window)).astype(int)
    last = np.array(image.shape[::-1]) - 1
    inside = ((place_px - size[:, None] - 1 >= 0) & (place_px + size[:, None] + 1 <= last)).all(axis=1) & np.isfinite(step).all(axis=1)
    out = np.full(place_px.shape, np.nan)
    grey: NDArray[Any] = image if image.dtype == np.uint8 else image.astype(np.float32)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, CORNER_STEPS, CORNER_PX)
    for half in np.unique(size[inside]):
        rows = np.flatnonzero(inside & (size == half))
        start = (place_px[rows, None] + NUDGE_PX).astype(np.float32)
        corners = cv2.cornerSubPix(grey, start.copy(), (int(half), int(half)), (-1, -1), stop)
        # a place without gradients, or one that runs away, is given back as it was
        out[rows] = np.where((corners != start).any(axis=2), corners[:, 0], np.nan)
    return out


def _squares(image: NDArray[np.generic], shapes: NodeShapes, place_px: Array, step_px: Array) -> Array:
    out = np.full(place_px.shape, np.nan)
    rows = np.flatnonzero(np.isfinite(step_px).all(axis=(1, 2)))
    if not len(rows):
        return out
    # the half of band 0 is the square's reach along the row's step
    reach = shapes.half[rows, ::-1]
    corners = place_px[rows, None] + np.einsum("kij,kqj->kqi", step_px[rows], CORNERS * reach[:, None])
    for _ in range(2):
        corners, good = _square_corners(image, corners, reach)
    centers = diagonals_meet(corners)
    out[rows[good]] = centers[good]
    return out


def _square_corners(image: NDArray[np.generic], corners: Array, reach: Array) -> tuple[Array, Flags]:
    """Corners (K, 4, 2) where lines through the half-level points of the four sides meet, and which squares show all sides."""
    start, along = corners, np.roll(corners, -1, axis=1) - corners
    length = np.linalg.norm(along, axis=2)
    outward = np.stack([along[..., 1], -along[..., 0]], axis=2) / length[..., None]
    # away from the middle, whichever way round the corners go
    away = (outward * (start + 0.5 * along - corners.mean(axis=1, keepdims=True))).sum(axis=2)
    outward *= np.sign(away)[..., None]
    side = length.min(axis=1)
    gap = side * ((0.5 - reach) / reach).min(axis=1)
    width = np.clip(ACROSS_PART * np.minimum(side / 2, gap), *PROFILE_PX)
    t = 0.5 + 0.5 * ALONG_SIDE * np.linspace(-1, 1, PROFILES)
    on = start[:, :, None] + t[:, None] * along[:, :, None]
    flat = (-1, PROFILES, 2)
    points, valid = edge_points(image, on.reshape(flat), np.broadcast_to(outward[:, :, None], on.shape).reshape(flat), np.repeat(width, 4))
    line, rms = _lines(points, valid)
    good = (valid.mean(axis=1) >= LEAST_SHARE) & (rms < LARGEST_RMS_PX)
    line, good = line.reshape(-1, 4, 3), good.reshape(-1, 4).all(axis=1)
    meet = np.cross(np.roll(line, 1, axis=1), line)
    good &= (np.abs(meet[..., 2]) > 1e-6).all(axis=1)
    return np.where(good[:, None, None], meet[..., :2] / np.where(good[:, None, None], meet[..., 2:], 1.0), corners), good


def _lines(points: Array, valid: Flags) -> tuple[Array, Array]:
    """Least-squares lines (M, 3), a u + b v + c = 0 with unit (a, b), through valid points (M, N, 2), and their rms (M,)."""
    weight = valid.astype(float)
    count = np.maximum(weight.sum(axis=1), 1.0)
    middle = np.einsum("mn,mni->mi", weight, points) / count[:, None]
    arm = (points - middle[:, None]) * weight[..., None]
    values, vectors = np.linalg.eigh(np.swapaxes(arm, 1, 2) @ arm)
    normal = vectors[:, :, 0]
    return np.column_stack([normal, -(normal * middle).sum(axis=1)]), np.sqrt(np.maximum(values[:, 0], 0.0) / count)


def diagonals_meet(corners: Array) -> Array:
    """Where the diagonals of quadrilaterals (K, 4, 2) meet (K, 2)."""
    first, second = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    between = corners[:, 1] - corners[:, 0]
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    part = (between[:, 0] * second[:, 1] - between[:, 1] * second[:, 0]) / np.where(cross == 0, 1.0, cross)
    return np.asarray(corners[:, 0] + part[:, None] * first)
