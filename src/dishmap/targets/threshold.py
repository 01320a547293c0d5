"""Local threshold and contours: where a photograph is ink, and its outlines to a fraction of a pixel.

The threshold of a pixel is half way between the darkest and the lightest pixel of a small window around it, so it follows
shading of any strength and needs no idea of a size: only the neighbourhood of edges is ever told apart, and something
large shows as the contour of its edge. A contour that does not follow an edge is dropped point by point, when it
is moved to the crossing of the threshold between two pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]

# Half width of the window whose darkest and lightest pixels give the threshold. It must hold both sides of an edge blurred
# by 2 px (sigma); a larger one would let dark surroundings into the windows of circles near them.
WINDOW_PX = 5
# The window must hold at least this contrast, as a part of its lightest pixel, in grey levels of 255, and in sigmas of
# the noise (the range of 121 normal numbers is 5.4 sigmas).
LEAST_RELATIVE_CONTRAST = 0.15
LEAST_CONTRAST = 5.0
LEAST_CONTRAST_SIGMAS = 8.0
# Above this noise (grey levels of 255) the image is smoothed by a 3x3 kernel first, which leaves this part of it.
SMOOTH_ABOVE_NOISE, SMOOTHED_NOISE = 2.0, 0.4
# Rows treated at a time, to keep the memory small.
BAND_ROWS = 512


def ink_contours(image: Image, noise: float) -> tuple[Image, Image, list[NDArray[np.int32]]]:
    """The image (smoothed where `noise` asks for it), the threshold of each pixel, and the outlines (K, 1, 2) of ink and of holes in it."""
    if noise > SMOOTH_ABOVE_NOISE:
        image, noise = np.asarray(cv2.GaussianBlur(image, (3, 3), 0), dtype=np.uint8), noise * SMOOTHED_NOISE
    threshold, ink = binarise(image, min(max(LEAST_CONTRAST, LEAST_CONTRAST_SIGMAS * noise), 255.0))
    outlines, _ = cv2.findContours(ink, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return image, threshold, [np.asarray(c, dtype=np.int32) for c in outlines]


def edge_points(
    image: Image, threshold: Image, contours: list[NDArray[np.int32]]
) -> tuple[Array, NDArray[np.int64], NDArray[np.int64], Flags, Flags, Array]:
    """The points of outlines on the edges that they follow.

    Returns points (N, 2), where each outline starts and how many points it has (M,), whether its inside is dark (M,), which points (N,)
    lie on an edge, and the contrast (N,) there.
    """
    points, starts = concatenated(contours)
    counts = np.diff(np.append(starts, len(points)))
    # OpenCV runs around ink one way and around holes in it the other way
    dark = signed_area(points, starts, counts) > 0
    mean = np.stack([np.add.reduceat(points[:, k], starts) for k in (0, 1)], axis=1) / counts[:, None]
    outward = (points - np.repeat(mean, counts, axis=0)) * np.repeat(np.where(dark, 1.0, -1.0), counts)[:, None]
    moved, good, contrast = to_crossing(image, threshold, points, outward)
    return moved, starts, counts, dark, good, contrast


def white_level(gray: NDArray[Any]) -> float:
    """Grey level that becomes 255: all of an 8-bit image, and the light end of the pixels of a 16-bit one."""
    if gray.dtype == np.uint8:
        return 255.0
    sample = gray[:: max(1, gray.shape[0] // 500), :: max(1, gray.shape[1] // 500)]
    return float(max(1.2 * np.percentile(sample, 99.5), 255.0))


def reduced_image(image: NDArray[Any], factor: int, white: float) -> Image:
    """The image averaged over blocks of factor x factor pixels, as 8 bit; rows and columns left over are dropped."""
    h, w = image.shape[0] // factor, image.shape[1] // factor
    if factor > 1:
        image = cv2.resize(image[: h * factor, : w * factor], (w, h), interpolation=cv2.INTER_AREA)
    if image.dtype != np.uint8:
        image = cv2.convertScaleAbs(image, alpha=255.0 / white)
    return np.ascontiguousarray(image)


def noise_level(image: Image) -> float:
    """Standard deviation of the noise, grey levels: from the median difference of diagonal 2x2 sums."""
    rows = image[:: max(1, image.shape[0] // 64)].astype(np.int16)
    if rows.shape[1] < 4:
        return 0.0
    second = rows[:, 2:] - 2 * rows[:, 1:-1] + rows[:, :-2]
    return float(1.4826 * np.median(np.abs(second)) / np.sqrt(6.0))


def binarise(image: Image, least_contrast: float) -> tuple[Image, Image]:
    """Threshold of each pixel, and where the image is ink (255)."""
    threshold, ink = np.empty_like(image), np.empty_like(image)
    for top, bottom in row_bands(len(image)):
        first, last = max(0, top - WINDOW_PX), min(len(image), bottom + WINDOW_PX)
        inner = slice(top - first, bottom - first)
        low, high, edges = (part[inner] for part in window_edges(image[first:last], least_contrast))
        cv2.addWeighted(low, 0.5, high, 0.5, 0.0, dst=threshold[top:bottom])
        cv2.bitwise_and(cv2.compare(image[top:bottom], threshold[top:bottom], cv2.CMP_LT), edges, dst=ink[top:bottom])
    return threshold, ink


def window_edges(image: Image, least_contrast: float) -> tuple[Image, Image, Image]:
    """Darkest and lightest pixel of the window around each pixel, and where these are far enough apart for an edge (255)."""
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * WINDOW_PX + 1, 2 * WINDOW_PX + 1))
    low, high = (np.asarray(f(image, kernel), dtype=np.uint8) for f in (cv2.erode, cv2.dilate))
    # contrast of the window against its own limit: high - low > max(least, part * high)
    limit = np.maximum(cv2.convertScaleAbs(high, alpha=LEAST_RELATIVE_CONTRAST), np.uint8(least_contrast))
    return low, high, np.asarray(cv2.compare(cv2.subtract(high, low), limit, cv2.CMP_GT), dtype=np.uint8)


def row_bands(rows: int) -> Iterator[tuple[int, int]]:
    """First row, and the row after the last, of each band of an image of so many rows."""
    for top in range(0, rows, BAND_ROWS):
        yield top, min(rows, top + BAND_ROWS)


def concatenated(contours: list[NDArray[np.int32]]) -> tuple[Array, NDArray[np.int64]]:
    """All points (N, 2) of the contours, and where each contour starts (M,)."""
    points = np.concatenate(contours)[:, 0].astype(float)
    return points, np.cumsum([0] + [len(c) for c in contours[:-1]])


def signed_area(points: Array, starts: NDArray[np.int64], counts: NDArray[np.int64]) -> Array:
    """Area (M,) of each closed contour, negative when it runs from +u towards +v."""
    following = np.arange(1, len(points) + 1)
    following[starts + counts - 1] = starts
    x, y = points.T
    return np.asarray(np.add.reduceat(x[following] * y - x * y[following], starts) / 2)


def to_crossing(image: Image, threshold: Image, points: Array, outward: Array) -> tuple[Array, NDArray[np.bool_], Array]:
    """Move contour pixels (N, 2), the last ink before the ground, to where the grey level crosses the threshold.

    outward (N, 2): direction from the ink to the ground, roughly. The crossing is taken between the pixel and that one of
    its four neighbours which is lighter and lies best in this direction, by linear interpolation: so the contour lies
    neither on the inner nor on the outer side. Returns the points, where there is a crossing, and the contrast there.
    """
    h, w = image.shape
    x, y = points.T.astype(np.intp)
    good = (x > 0) & (y > 0) & (x < w - 1) & (y < h - 1)
    flat, at = image.ravel(), np.where(good, y * w + x, 0)
    here, level = flat[at].astype(np.float32), threshold.ravel()[at].astype(np.float32)
    towards = (outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)).astype(np.float32)
    best, best_value = np.zeros_like(here), here
    step = np.zeros_like(towards)
    for k, direction in ((1, (1, 0)), (-1, (-1, 0)), (w, (0, 1)), (-w, (0, -1))):
        value = flat[np.where(good, at + k, 0)].astype(np.float32)
        score = (value - here) * np.maximum(towards[:, 0] * direction[0] + towards[:, 1] * direction[1], 0)
        better = score > best
        best, best_value = np.where(better, score, best), np.where(better, value, best_value)
        step[better] = direction
    good &= best_value > level
    part = np.where(good, (level - here) / np.where(good, best_value - here, 1), 0)
    contrast = 2 * (level - darkest_nearby(flat, at, w, here))
    return points + step * np.clip(part, 0, 1)[:, None], good, np.asarray(contrast, dtype=float)


def darkest_nearby(flat: Image, at: NDArray[np.intp], width: int, here: NDArray[np.float32]) -> NDArray[np.float32]:
    """Darkest of the pixel and its eight neighbours, so that the contrast counts the ink's own depth."""
    for k in (1, -1, width, -width, width + 1, width - 1, -width + 1, -width - 1):
        here = np.minimum(here, flat[np.clip(at + k, 0, flat.size - 1)])
    return here


def sampled(image: NDArray[np.uint8], points: Array) -> Array:
    """Grey levels of an image at points (..., 2), bilinear, repeated beyond the border."""
    flat = points.reshape(-1, points.shape[-2], 2).astype(np.float32)
    out = np.empty(flat.shape[:2])
    # OpenCV maps hold less than 32768 rows
    for start in range(0, len(flat), 30_000):
        part = flat[start : start + 30_000]
        out[start : start + 30_000] = cv2.remap(image, part[..., 0], part[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out.reshape(points.shape[:-1]))
