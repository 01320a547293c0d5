"""Crossings of dark lines in a photograph: dark blobs of its Hessian from which two lines go out.

Along a line the grey levels do not curve, so that the determinant of the second derivatives is large only where two lines cross
(Beaudet 1978). It is looked for at several reductions of the image; each shows lines of half a pixel to three pixels. On a ring
around a crossing the lines show as dark arms, opposite ones in pairs; they give the two directions, and tell a crossing from a
corner or a dot.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.targets.grid_nodes import Nodes, right_handed
from dishmap.targets.threshold import noise_level, reduced_image, white_level

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]

# The derivative kernels' sigma and half width, in pixels of a level.
SIGMA_PX, HALF_WIDTH_PX = 1.3, 4
# Least root of the determinant: in grey levels of 255 per px^2, and in sigmas of the noise (a second derivative at this sigma
# has 0.13 of the noise).
LEAST_RESPONSE, LEAST_RESPONSE_NOISE = 0.7, 0.6
# Smallest side of the coarsest level, and the largest count of responses that are looked at in one level.
SMALLEST_LEVEL_PX, MOST_RESPONSES = 60, 40_000
# The ring on which arms are looked for: radius in px of the level, samples on half of it.
RING_PX, RING_SAMPLES = 3.6, 24
# The lines' directions differ by more than this many samples of 7.5 degrees; the weaker arm's part of the stronger.
LEAST_ANGLE, LEAST_ARM = 3, 0.3
# A ring sample is dark beyond half of the depth; wider dark sectors than this, in samples, are no line.
WIDEST_ARM = 9
# Two levels see the same crossing within this distance, px of the coarser one.
SAME_PX = 2.5


@dataclass(frozen=True)
class Level:
    """The image at one reduction (a power of two of full resolution)."""

    image: Image
    reduction: int


def levels_of(gray: NDArray[Any], finest: int) -> list[Level]:
    """The image reduced by `finest`, by twice that, and so on, finest first."""
    levels = [Level(reduced_image(gray, finest, white_level(gray)), finest)]
    while min(levels[-1].image.shape) >= 2 * SMALLEST_LEVEL_PX and levels[-1].reduction < 16:
        last = levels[-1]
        levels.append(Level(reduced_image(last.image, 2, 255.0), 2 * last.reduction))
    return levels


def find_crossings(levels: list[Level]) -> tuple[Nodes, NDArray[np.int64]]:
    """Crossings of dark lines in any of the levels, with unit directions as axes; and the reduction (M,) that shows each best."""
    found = [_crossings_of(level) for level in levels]
    place, axes, response = (np.concatenate([f[k] for f in found]) for k in range(3))
    reduction = np.concatenate([np.full(len(f[0]), level.reduction) for f, level in zip(found, levels, strict=True)])
    keep = _best(place, response, reduction)
    nodes = Nodes(place[keep], right_handed(axes[keep]))
    return nodes, reduction[keep]


def _best(place: Array, response: Array, reduction: NDArray[np.int64]) -> Flags:
    """Which crossings have no stronger one beside them."""
    keep = np.ones(len(place), dtype=bool)
    if len(place) < 2:
        return keep
    tree = cKDTree(place)
    for size in np.unique(reduction):
        coarser = np.flatnonzero(reduction == size)
        pairs = cKDTree(place[coarser]).sparse_distance_matrix(tree, SAME_PX * size, output_type="ndarray")
        a, b = coarser[pairs["i"]], pairs["j"]
        valid = (reduction[b] <= size) & (a != b)
        a, b = a[valid], b[valid]
        stronger = (response[a] > response[b]) | ((response[a] == response[b]) & (a < b))
        keep[np.where(stronger, b, a)] = False
    return keep


def _crossings_of(level: Level) -> tuple[Array, Array, Array]:
    """Places (M, 2) px, unit axes (M, 2, 2) and responses (M,) of the crossings in one level."""
    image = level.image
    response, smoothed = _responses(image)
    peak = np.asarray(cv2.dilate(response, np.ones((3, 3), dtype=np.uint8)))
    least = max(LEAST_RESPONSE, LEAST_RESPONSE_NOISE * noise_level(image))
    margin = HALF_WIDTH_PX
    inner = slice(margin, -margin)
    v, u = np.nonzero((response >= np.maximum(peak, least))[inner, inner])
    u, v = u + margin, v + margin
    if not len(u):
        return np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0)
    strength = response[v, u].astype(float)
    if len(u) > MOST_RESPONSES:
        strongest = np.argpartition(-strength, MOST_RESPONSES)[:MOST_RESPONSES]
        u, v, strength = u[strongest], v[strongest], strength[strongest]
    place = np.stack([u, v], axis=1) + _to_minimum(smoothed, u, v)
    axes, crossing = _arms(image, place)
    scale = level.reduction
    return place[crossing] * scale + (scale - 1) / 2, axes[crossing], strength[crossing]


def _responses(image: Image) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Root of the Hessian's determinant where the image is dark against its surroundings, else 0; and the smoothed image."""
    x = np.arange(-HALF_WIDTH_PX, HALF_WIDTH_PX + 1, dtype=float)
    smooth = np.exp(-0.5 * (x / SIGMA_PX) ** 2)
    smooth /= smooth.sum()
    first, second = -x / SIGMA_PX**2 * smooth, (x**2 / SIGMA_PX**4 - 1 / SIGMA_PX**2) * smooth
    second -= second.mean()
    second *= 2 / (second * x**2).sum()
    first /= -(first * x).sum()

    def filtered(across: Array, down: Array) -> NDArray[np.float32]:
        return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, across, down), dtype=np.float32)

    xx, yy, xy = np.maximum(filtered(second, smooth), 0), np.maximum(filtered(smooth, second), 0), filtered(first, first)
    np.multiply(xx, yy, out=xx)
    np.multiply(xy, xy, out=xy)
    np.subtract(xx, xy, out=xx)
    return np.sqrt(np.maximum(xx, 0, out=xx), out=xx), filtered(smooth, smooth)


def _to_minimum(smoothed: NDArray[np.float32], u: NDArray[Any], v: NDArray[Any]) -> Array:
    """From pixels to the minimum of the smoothed image beside each (M, 2), at most a pixel away."""
    around = {(i, j): smoothed[v + j, u + i].astype(float) for i in (-1, 0, 1) for j in (-1, 0, 1)}
    gu, gv = (around[1, 0] - around[-1, 0]) / 2, (around[0, 1] - around[0, -1]) / 2
    uu, vv = (around[1, 0] + around[-1, 0] - 2 * around[0, 0]), (around[0, 1] + around[0, -1] - 2 * around[0, 0])
    uv = (around[1, 1] + around[-1, -1] - around[1, -1] - around[-1, 1]) / 4
    determinant = uu * vv - uv**2
    safe = np.where(determinant > 1e-6, determinant, np.inf)
    step = np.stack([(uv * gv - vv * gu) / safe, (uv * gu - uu * gv) / safe], axis=1)
    return np.asarray(np.clip(step, -1.0, 1.0))


def _arms(image: Image, place: Array) -> tuple[Array, Flags]:
    """Unit directions (M, 2, 2) of the two lines through places (M, 2) of an image, and where there are two."""
    angle = np.arange(2 * RING_SAMPLES) * (np.pi / RING_SAMPLES)
    ring = RING_PX * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = (place[:, None] + ring).astype(np.float32)
    light = cv2.remap(image, points[..., 0], points[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)
    # a median of three samples' sum: noise down, arms kept
    light = light + np.roll(light, 1, axis=1) + np.roll(light, -1, axis=1)
    ground = np.partition(light, -RING_SAMPLES // 2, axis=1)[:, -RING_SAMPLES // 2]
    dark = np.maximum(ground[:, None] - light, 0.0)
    both = dark[:, :RING_SAMPLES] + dark[:, RING_SAMPLES:]
    rows = np.arange(len(place))
    peak = (both >= np.roll(both, 1, axis=1)) & (both > np.roll(both, -1, axis=1))
    first = np.argmax(both, axis=1)
    apart = np.abs((np.arange(RING_SAMPLES) - first[:, None] + RING_SAMPLES // 2) % RING_SAMPLES - RING_SAMPLES // 2)
    others = np.where(peak & (apart > LEAST_ANGLE), both, -1.0)
    second = np.argmax(others, axis=1)
    strong, weak = both[rows, first], others[rows, second]
    good = (strong > 0) & (weak > LEAST_ARM * strong)
    good &= _width(dark, first) & _width(dark, second)
    directions = np.stack([_refined(both, first), _refined(both, second)], axis=1) * (np.pi / RING_SAMPLES)
    return np.stack([np.cos(directions), np.sin(directions)], axis=2), good


def _width(dark: Array, at: NDArray[np.int64]) -> Flags:
    """Whether the dark sector around sample `at` or opposite of it, whichever is darker, is as narrow as a line."""
    rows, count = np.arange(len(dark)), dark.shape[1]
    opposite = at + RING_SAMPLES
    at = np.where(dark[rows, opposite] > dark[rows, at], opposite, at)
    half = WIDEST_ARM // 2 + 1
    depth = dark[rows, at]
    left, right = dark[rows, (at - half) % count], dark[rows, (at + half) % count]
    return np.asarray(np.minimum(left, right) < 0.6 * depth)


def _refined(both: Array, at: NDArray[np.int64]) -> Array:
    """The peak near sample `at`, to a fraction of a sample, by a parabola."""
    rows = np.arange(len(both))
    left, middle, right = (both[rows, (at + k) % RING_SAMPLES] for k in (-1, 0, 1))
    bend = 2 * middle - left - right
    return np.asarray(at + np.clip(np.where(bend > 0, (right - left) / (2 * np.maximum(bend, 1e-9)), 0.0), -0.5, 0.5))
