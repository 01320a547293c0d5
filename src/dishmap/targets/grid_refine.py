"""Crossings to a fraction of a pixel, and which cells are filled: profiles across the lines, along the local map of the lattice.

The lines through a crossing are followed along the curves that the local map of its neighbours gives, so that neither perspective
nor a bent surface moves what is found; the darkness on profiles across gives each line's offset. It is also how a crossing that
is only predicted is confirmed: there must be ink of both lines.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.grid_crossings import Level
from dishmap.targets.grid_map import LocalMap
from dishmap.targets.threshold import noise_level, sampled

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

# Profiles stand at these parts of a step to both sides of a crossing, and reach this part of the other step, or so many pixels of the
# level, to both sides of the line.
ALONG = np.array([0.16, 0.24, 0.32])
ACROSS, ACROSS_PX, SAMPLES = 0.22, 5.0, 17
# The line's darkness above this part of its peak counts; it must lie within this part of the profile, with light on both sides that
# differs by less than this part of the peak, and be this deep in grey levels of 255 and sigmas of the noise.
ABOVE, WITHIN, EVEN = 0.3, 0.8, 0.7
LEAST_DEPTH, LEAST_DEPTH_NOISE = 6.0, 3.0
# A filled cell: the darkness of its middle against that of the crossings around, and the part of a cell's width at which its ground is
# looked at.
FILLED, GROUND_AT, MIDDLE_AT = 0.5, 0.13, 0.08


def refine_crossings(levels: list[Level], reduction: Ints, there: LocalMap) -> tuple[Array, Ints]:
    """Places (T, 2) px of crossings near those of a local map, and how many of the four arms show ink (T, 2: along columns, rows).

    reduction (T,): the level in which each is looked at. A place is NaN where ink of a line is missing on both sides.
    """
    place, arms = np.full(there.place_px.shape, np.nan), np.zeros((len(reduction), 2), dtype=np.int64)
    for level in levels:
        chosen = np.flatnonzero((reduction == level.reduction) & np.isfinite(there.place_px).all(axis=1))
        if len(chosen):
            place[chosen], arms[chosen] = _refined(level, there.take(chosen))
    return place, arms


def _refined(level: Level, there: LocalMap) -> tuple[Array, Ints]:
    scale = level.reduction
    middle = (there.place_px - (scale - 1) / 2) / scale
    least = max(LEAST_DEPTH, LEAST_DEPTH_NOISE * noise_level(level.image))
    normals, offsets, arms = [], [], []
    for axis in range(2):
        along, bend, other = there.step_px[..., axis] / scale, there.bend_px[..., axis] / scale, there.step_px[..., 1 - axis] / scale
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
        reach = np.minimum(ACROSS * np.abs((other * normal).sum(axis=1)), ACROSS_PX)
        t = np.concatenate([-ALONG, ALONG])
        line = middle[:, None] + t[:, None] * along[:, None] + t[:, None] ** 2 / 2 * bend[:, None]
        offset, seen = _line_offsets(level.image, line, normal, reach, least)
        sides = np.stack([seen[:, : len(ALONG)], seen[:, len(ALONG) :]], axis=1)
        # each side counts once, so that a side with a missing profile does not pull
        count = sides.sum(axis=2)
        total = np.where(seen, offset, 0.0).reshape(len(offset), 2, -1).sum(axis=2) / np.maximum(count, 1)
        arms.append((count > 0).sum(axis=1))
        offsets.append(total.sum(axis=1) / np.maximum(arms[-1], 1))
        normals.append(normal)
    matrix = np.stack(normals, axis=1)
    sound = (np.abs(np.linalg.det(matrix)) > 0.1) & (arms[0] > 0) & (arms[1] > 0)
    step = np.linalg.solve(np.where(sound[:, None, None], matrix, np.eye(2)), np.stack(offsets, axis=1)[..., None])[..., 0]
    place = (middle + step) * scale + (scale - 1) / 2
    return np.where(sound[:, None], place, np.nan), np.stack(arms, axis=1)


def _line_offsets(image: NDArray[np.uint8], line: Array, normal: Array, reach: Array, least: float) -> tuple[Array, Flags]:
    """Offset (T, P) px along the normal (T, 2) of a dark line near points (T, P, 2) of an image, and where one is seen."""
    s = np.linspace(-1.0, 1.0, SAMPLES)
    points = line[:, :, None] + (s[:, None] * reach[:, None, None])[:, None] * normal[:, None, None]
    light = sampled(image, points)
    left, right = light[..., :3].mean(axis=-1), light[..., -3:].mean(axis=-1)
    depth = left[..., None] + (right - left)[..., None] * (s + 1) / 2 - light
    peak = depth.max(axis=-1)
    at = np.abs(s[np.argmax(depth, axis=-1)])
    weight = np.maximum(depth - ABOVE * peak[..., None], 0.0)
    offset = (weight * s).sum(axis=-1) / np.maximum(weight.sum(axis=-1), 1e-9) * reach[:, None]
    h, w = image.shape
    inside = ((line > 1) & (line < [w - 2, h - 2])).all(axis=-1)
    # beside a line it is equally light on both sides; beside the edge of something dark it is not
    return offset, (peak > least) & (at < WITHIN) & (np.abs(right - left) < EVEN * peak) & inside


def whole_cells(level: Level, table: Array) -> tuple[Array, Ints]:
    """Corners (K, 4, 2), in px of the level, of the cells of a table of places (C, R, 2) that are whole, and their lower corners (K, 2)."""
    corners = np.stack([table[:-1, :-1], table[1:, :-1], table[:-1, 1:], table[1:, 1:]], axis=2)
    cells = np.argwhere(np.isfinite(corners).all(axis=(2, 3)))
    return (corners[cells[:, 0], cells[:, 1]] - (level.reduction - 1) / 2) / level.reduction, cells


def filled_cells(level: Level, table: Array) -> Ints:
    """Lower corners (K, 2) of the cells of a table of crossings (C, R, 2) whose middle is as dark as the lines."""
    around, cells = whole_cells(level, table)
    if not len(cells):
        return cells
    far = [GROUND_AT, 1 - GROUND_AT]
    near = [0.5 - MIDDLE_AT, 0.5, 0.5 + MIDDLE_AT]
    ground, middle = (np.array([(x, y) for x in at for y in at]) for at in (far, near))
    light, center = (sampled(level.image, bilinear(around, xy)) for xy in (ground, middle))
    dark = sampled(level.image, around)
    contrast = np.median(light, axis=1) - np.median(dark, axis=1)
    filled = np.median(light, axis=1) - center.mean(axis=1) > FILLED * contrast
    return np.asarray(cells[filled & (contrast > LEAST_DEPTH)])


def bilinear(corners: Array, xy: Array) -> Array:
    """Points (K, Q, 2) at fractions xy (Q, 2) of cells with corners (K, 4, 2)."""
    x, y = xy.T
    weight = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=1)
    return np.asarray(np.einsum("qc,kcd->kqd", weight, corners))
