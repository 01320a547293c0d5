"""Find circles in a photograph: local threshold, contours, ellipses (the paper's section 4.2, step 1).

The threshold is local (`targets/threshold.py`). Blur fills narrow gaps and small holes to beyond it: small circles run together
and lose their holes. Where contours are small or no ellipses, a second threshold is tried, the mean of a few pixels around. It
follows the sign of the curvature of the grey levels, which parts two edges as long as there is any dip between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dishmap.errors import ImageError
from dishmap.targets.ellipses import Fits, contour_spread, enclosing, fit_ellipses
from dishmap.targets.threshold import (
    LEAST_CONTRAST,
    concatenated,
    edge_points,
    ink_contours,
    noise_level,
    reduced_image,
    row_bands,
    signed_area,
    white_level,
    window_edges,
)

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Above this many pixels the search runs at half resolution first.
HALVE_ABOVE_PX = 6_000_000
# Circles found at half resolution with a smaller half axis than this are too coarse there, and so is the search when
# more than the given part of its circles, or of its contours of one blob each, is that small.
COARSE_PX = 4.0
COARSE_PART = 0.2
# Search by the local mean: smoothing of the image and of the mean (sigmas in px); contrast in sigmas of the noise before smoothing
# (which leaves 0.28 of it); how far pixels see each other.
MEAN_SMOOTH_PX, MEAN_PX, MEAN_CONTRAST_SIGMAS, MEAN_MARGIN_PX = 1.0, 2.2, 2.4, 12
# It is made in bands that hold dark, or light, ellipses of a smaller half axis than this, or a contour of no ellipse that is not
# wider than circles that run together are (area over length of its outline); it gives ellipses up to the last half axis.
CLOSE_BELOW_PX, CLOSE_BELOW_LIGHT_PX, CLUMP_WIDTH_PX, CLOSE_UP_TO_PX = 10.0, 5.0, 14.0, 14.0
# A second, coarser search finds large circles with ragged edges.
SECOND_REDUCTION = 4
# Contours: fewest points; the largest spread (see `contour_spread`), to which each pixel of a small contour adds; and the
# limits that an ellipse must meet.
FEWEST_POINTS = 8
LARGEST_SPREAD = (0.16, 2.2)
LEAST_GOOD_POINTS = 0.6
SMALLEST_SEMI_AXIS_PX = 1.2
LEAST_AXIS_RATIO = 0.2
RMS_PX, RMS_PART = 0.12, 0.03
# The first numbers for the search by the local mean: a tilted circle blurred by half of its small axis is lens-shaped.
LARGEST_SPREAD_BY_MEAN, RMS_PX_BY_MEAN = (0.22, 2.2), 0.22
AREA_TOLERANCE = 0.2
# Two finds are the same circle when the centres agree to this many px of the coarser one and the sizes to this part; by the local
# mean, blurred rings are larger and their holes smaller.
SAME_CENTER_PX, SAME_SIZE, SAME_SIZE_BY_MEAN = 1.5, 0.1, 0.3


@dataclass(frozen=True)
class Detections:
    """Ellipses found in an image, in full-resolution pixels; (0, 0) is the centre of the top-left pixel.

    center_px (M, 2); semi_axes_px (M, 2), major first; angle_rad (M,) of the major axis from +u towards +v; dark (M,): the
    inside is darker; parent (M,): index of the smallest ellipse around each, or -1; contrast (M,) between inside and
    outside at the edge, grey levels; residual_px (M,): rms distance of the contour to the ellipse. Ellipses that the
    border of the image cuts are not listed.
    """

    center_px: Array
    semi_axes_px: Array
    angle_rad: Array
    dark: NDArray[np.bool_]
    parent: NDArray[np.int64]
    contrast: Array
    residual_px: Array

    def __len__(self) -> int:
        return len(self.center_px)


def find_ellipses(gray: NDArray[Any], full_resolution: bool = False) -> Detections:
    """Find the circles of an image as ellipses.

    gray: (H, W) uint8 or uint16. full_resolution: search a large image at full resolution even where half seems enough.
    Raises ImageError when the image is not such an array.
    """
    if gray.ndim != 2 or gray.dtype not in (np.uint8, np.uint16) or not gray.size:
        raise ImageError(
            f"circles are searched in a grey image (H, W) of uint8 or uint16, not in {gray.dtype} {gray.shape}; convert it first"
        )
    white = white_level(gray)
    halve = gray.size > HALVE_ABOVE_PX and not full_resolution
    base = 2 if halve else 1
    image = reduced_image(gray, base, white)
    noise = noise_level(image)
    found, small = _search_closely(image, base, noise)
    if halve and _too_coarse(found, base, small):
        found, _ = _search_closely(reduced_image(gray, 1, white), 1, noise * 2)
    if min(image.shape) >= 16 * SECOND_REDUCTION:
        second = 2 * SECOND_REDUCTION if halve else SECOND_REDUCTION
        coarse, *_ = _search(reduced_image(image, SECOND_REDUCTION, 255.0), second, noise / SECOND_REDUCTION)
        found = _merged(found, coarse, SAME_SIZE)
    return _detections(found, white / 255.0)


@dataclass(frozen=True)
class _Found:
    """Ellipses in full-resolution pixels; reduction (M,) at which each was found."""

    center: Array
    semi_axes: Array
    angle: Array
    dark: NDArray[np.bool_]
    contrast: Array
    residual: Array
    reduction: Array

    def take(self, index: NDArray[Any]) -> _Found:
        return _Found(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def _search_closely(image: Image, reduction: int, noise: float) -> tuple[_Found, int]:
    """All ellipses of one image, those that run together too; also how many small blobs its contours hold."""
    found, small, unclear = _search(image, reduction, noise)
    fine = found.semi_axes[:, 1] < np.where(found.dark, CLOSE_BELOW_PX, CLOSE_BELOW_LIGHT_PX) * reduction
    v, reach = found.center[fine, 1] / reduction, found.semi_axes[fine, 0] / reduction
    rows = np.concatenate([unclear, np.column_stack([v - reach, v + reach])])
    bands = [(top, bottom) for top, bottom in row_bands(len(image)) if ((rows[:, 0] < bottom) & (rows[:, 1] >= top)).any()]
    if not bands:
        return found, small
    return _merged(found, _search_by_mean(image, reduction, noise, bands), SAME_SIZE_BY_MEAN), small


def _search(image: Image, reduction: int, noise: float) -> tuple[_Found, int, Array]:
    """All ellipses of one image; how many small blobs its contours hold; first and last rows (U, 2) of clumps that are no ellipse."""
    image, threshold, outlines = ink_contours(image, noise)
    small = sum(1 for c in outlines if 4 <= len(c) < FEWEST_POINTS)
    contours = [c for c in outlines if len(c) >= FEWEST_POINTS]
    found, which = _ellipses(image, threshold, contours, reduction, LARGEST_SPREAD, RMS_PX)
    rest = [contours[i] for i in np.setdiff1d(np.arange(len(contours)), which)]
    rows = [(c[:, 0, 1].min(), c[:, 0, 1].max()) for c in rest if cv2.contourArea(c) <= CLUMP_WIDTH_PX * len(c)]
    return found, small, np.array(rows, dtype=float).reshape(-1, 2)


def _search_by_mean(image: Image, reduction: int, noise: float, bands: list[tuple[int, int]]) -> _Found:
    """Small ellipses in bands of rows of one image, whose threshold is the mean of a few pixels around."""
    least_contrast = min(max(LEAST_CONTRAST, MEAN_CONTRAST_SIGMAS * noise), 255.0)
    smooth, mean, ink = image.copy(), np.zeros_like(image), np.zeros_like(image)
    for top, bottom in bands:
        first, last = max(0, top - MEAN_MARGIN_PX), min(len(image), bottom + MEAN_MARGIN_PX)
        inner = slice(top - first, bottom - first)
        part = np.asarray(cv2.GaussianBlur(image[first:last], (0, 0), MEAN_SMOOTH_PX), dtype=np.uint8)
        smooth[top:bottom] = part[inner]
        mean[top:bottom] = cv2.GaussianBlur(image[first:last], (0, 0), MEAN_PX)[inner]
        edges = window_edges(part, least_contrast)[2][inner]
        cv2.bitwise_and(cv2.compare(smooth[top:bottom], mean[top:bottom], cv2.CMP_LT), edges, dst=ink[top:bottom])
    outlines, _ = cv2.findContours(ink, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    contours = [np.asarray(c, dtype=np.int32) for c in outlines if len(c) >= FEWEST_POINTS]
    found, _ = _ellipses(smooth, mean, contours, reduction, LARGEST_SPREAD_BY_MEAN, RMS_PX_BY_MEAN)
    return found.take(np.flatnonzero((found.contrast >= least_contrast) & (found.semi_axes[:, 0] <= CLOSE_UP_TO_PX * reduction)))


def _ellipses(
    image: Image, threshold: Image, contours: list[NDArray[np.int32]], reduction: int, largest_spread: tuple[float, float], rms_px: float
) -> tuple[_Found, NDArray[np.int64]]:
    """Ellipses of the contours that pass all tests, in full-resolution pixels, and which contours these are."""
    if not contours:
        return _nothing(), np.zeros(0, dtype=np.int64)
    points, starts = concatenated(contours)
    counts = np.diff(np.append(starts, len(points)))
    which = np.flatnonzero(contour_spread(points, starts) < largest_spread[0] + largest_spread[1] / counts)
    if not len(which):
        return _nothing(), which
    moved, starts, counts, dark, good, contrast = edge_points(image, threshold, [contours[i] for i in which])
    weights = good.astype(float)
    enough = np.add.reduceat(weights, starts) >= np.maximum(LEAST_GOOD_POINTS * counts, FEWEST_POINTS - 2)
    fits = fit_ellipses(moved, starts, weights)
    contrast_mean = np.add.reduceat(contrast * weights, starts) / np.maximum(np.add.reduceat(weights, starts), 1.0)
    with np.errstate(invalid="ignore"):
        keep = enough & _is_ellipse(fits, np.abs(signed_area(moved, starts, counts)), rms_px)
    found = _Found(
        fits.center * reduction + (reduction - 1) / 2,
        fits.semi_axes * reduction,
        fits.angle_rad,
        dark,
        contrast_mean,
        fits.rms * reduction,
        np.full(len(starts), float(reduction)),
    )
    return found.take(np.flatnonzero(keep)), which[keep]


def _is_ellipse(fits: Fits, area: Array, rms_px: float) -> NDArray[np.bool_]:
    major, minor = fits.semi_axes.T
    return np.asarray(
        (minor >= SMALLEST_SEMI_AXIS_PX)
        & (minor >= LEAST_AXIS_RATIO * major)
        & (fits.rms <= rms_px + RMS_PART * np.sqrt(major * minor))
        & (np.abs(area / (np.pi * major * minor) - 1) <= AREA_TOLERANCE)
    )


def _too_coarse(found: _Found, reduction: int, small_blobs: int) -> bool:
    """Whether many circles, or many blobs that are no circles at this resolution, are too small for it."""
    dark = found.dark
    small = int((found.semi_axes[dark, 1] < COARSE_PX * reduction).sum())
    return not dark.any() or small > COARSE_PART * dark.sum() or small_blobs > dark.sum() / COARSE_PART


def _merged(fine: _Found, coarse: _Found, same_size: float) -> _Found:
    """Both sets, without those of the second search that the first one has with sizes to this part."""
    from scipy.spatial import cKDTree

    if not len(coarse.center) or not len(fine.center):
        return fine if not len(coarse.center) else coarse
    tolerance = SAME_CENTER_PX * coarse.reduction[0]
    a, b = (np.column_stack([f.center, np.log(f.semi_axes.prod(axis=1)) / 2 * tolerance / same_size]) for f in (fine, coarse))
    distance, _ = cKDTree(np.column_stack([a, 1e9 * fine.dark])).query(np.column_stack([b, 1e9 * coarse.dark]), p=np.inf)
    new = coarse.take(np.flatnonzero(distance > tolerance))
    return _Found(*(np.concatenate([getattr(fine, n), getattr(new, n)]) for n in fine.__dataclass_fields__))


def _nothing() -> _Found:
    none = np.zeros(0)
    return _Found(np.zeros((0, 2)), np.zeros((0, 2)), none, np.zeros(0, dtype=bool), none, none, none)


def _detections(found: _Found, grey_levels: float) -> Detections:
    parent = enclosing(found.center, found.semi_axes, found.angle)
    contrast = found.contrast * grey_levels
    return Detections(found.center, found.semi_axes, found.angle, found.dark, parent, contrast, found.residual)
