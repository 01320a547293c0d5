"""The outline of the dish in a photograph, in whole pixels, as the paper finds it (section 5, Fig. 10).

(a) `binarise`; (b) `clean_crossings`, where ribs cross the rim; (c) `dish_component`, of the connected components;
(d) `hull_outline`. `dish_outline` is the four in a row, on a reduced picture: it says where to look, not where the rim is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dishmap.errors import ImageError, MeasurementError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# The outline is searched at this size: a pixel of it is a few of the photograph's, which the edge search then bridges.
LONGEST_SIDE_PX = 1200
# What is narrower than this part of the dish's radius is a rib. Ribs of 12 mm on a dish of 600 mm are a third of it.
RIB_PART = 0.15
SMALLEST_RADIUS_PX = 20.0
# A dish that ribs cut into sectors grows at least so much when they are joined: two halves would double.
SECTORS_GAIN = 1.3
NEAR_HULL_PX = 2.0
# The border of the picture shows the background when at least this part of it is of one class.
BACKGROUND_PART = 0.6


@dataclass(frozen=True)
class Outline:
    """Outline of the dish in px of the photograph.

    hull_px (K, 2): the paper's convex hull; border_px (L, 2): pixels on the border of the dish's component that lie at the hull;
    light: the dish is lighter than what is around it; reduction: of the picture in which it was found.
    """

    hull_px: Array
    border_px: Array
    light: bool
    reduction: int


def dish_outline(gray: NDArray[Any], rib_width_px: float | None = None) -> Outline:
    """Find the dish's outline in a grey photograph (H, W).

    rib_width_px: width of the widest rib that crosses the rim; by default 15 % of the dish's radius.
    Raises MeasurementError when nothing like a whole dish is in the picture, ImageError for an array that is no grey picture.
    """
    if gray.ndim != 2 or not gray.size or gray.dtype.kind not in "uif":
        raise ImageError(f"a rim is searched in a grey image (H, W) of numbers, not in {gray.dtype} {gray.shape}; convert it first")
    reduction = max(1, int(np.ceil(max(gray.shape) / LONGEST_SIDE_PX)))
    mask, light = binarise(reduced(gray, reduction))
    width = RIB_PART * float(np.sqrt(mask.sum() / np.pi)) if rib_width_px is None else rib_width_px / reduction
    cleaned = clean_crossings(mask, width)
    dish, joined = dish_component(cleaned), dish_component(join_sectors(cleaned, width))
    # closing also ties the dish to what lies beside it, so it must be needed
    if joined.sum() > SECTORS_GAIN * dish.sum():
        dish = joined
    if np.sqrt(dish.sum() / np.pi) * reduction < SMALLEST_RADIUS_PX:
        raise MeasurementError("no dish stands out from its background in the photograph; a rim needs another grey level beyond it")
    if dish[[0, -1]].any() or dish[:, [0, -1]].any():
        raise MeasurementError(
            "the dish's outline reaches the border of the photograph, so its rim is out of view or merges with the background; "
            "a photograph of the whole rim against another grey level is needed"
        )
    hull = hull_outline(dish)
    return Outline((hull + 0.5) * reduction - 0.5, (border_at_hull(dish, hull) + 0.5) * reduction - 0.5, light, reduction)


def reduced(gray: NDArray[Any], factor: int) -> NDArray[np.uint8]:
    """The picture (H, W) averaged over blocks of factor x factor pixels and stretched to 8 bit; rows and columns left over are dropped."""
    h, w = max(1, gray.shape[0] // factor), max(1, gray.shape[1] // factor)
    small = cv2.resize(gray[: h * factor, : w * factor].astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
    low, high = float(small.min()), float(small.max())
    return np.asarray(np.rint((small - low) * (255 / max(high - low, 1e-6))), dtype=np.uint8)


def binarise(picture: NDArray[np.uint8]) -> tuple[Mask, bool]:
    """Otsu's two classes of an 8-bit picture (H, W): true where it is not as most of its border, and whether that is the light class."""
    _, classes = cv2.threshold(picture, 0, 1, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    border = np.concatenate([classes[0], classes[-1], classes[:, 0], classes[:, -1]])
    share = float(border.mean())
    if max(share, 1 - share) < BACKGROUND_PART:
        raise MeasurementError(
            "the border of the photograph shows no uniform background to see the rim against; the whole rim must be in the picture"
        )
    light = share < 0.5
    return (classes > 0) == light, light


def clean_crossings(mask: Mask, width_px: float) -> Mask:
    """Take away ribs up to `width_px` wide where they cross the rim of a mask (H, W): its holes filled, then opened with a disc."""
    return np.asarray(cv2.morphologyEx(_filled(mask), cv2.MORPH_OPEN, _disc(width_px)) > 0)


def join_sectors(mask: Mask, width_px: float) -> Mask:
    """Close cuts up to `width_px` wide between parts of a mask (H, W), as ribs make that run right across the dish in front of it."""
    disc = _disc(width_px)
    size = disc.shape[0]
    # beyond the picture lies nothing to close a gap with
    wide = cv2.copyMakeBorder(mask.astype(np.uint8), size, size, size, size, cv2.BORDER_CONSTANT, value=0)
    return np.asarray(cv2.morphologyEx(wide, cv2.MORPH_CLOSE, disc)[size:-size, size:-size] > 0)


def dish_component(mask: Mask) -> Mask:
    """The largest connected component of a mask (H, W), its holes filled; empty for an empty mask."""
    filled = _filled(mask)
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(filled, connectivity=4)
    if count < 2:
        return np.zeros(mask.shape, dtype=bool)
    return np.asarray(labels == 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA])))


def _disc(width_px: float) -> NDArray[np.uint8]:
    size = 2 * int(np.ceil((width_px + 1) / 2)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), dtype=np.uint8)


def hull_outline(mask: Mask) -> Array:
    """Convex hull (K, 2) of the pixel centres of a mask, in its pixels."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return np.zeros((0, 2))
    return np.asarray(cv2.convexHull(np.concatenate(contours))[:, 0], dtype=float)


def border_at_hull(mask: Mask, hull: Array) -> Array:
    """Border pixels (L, 2) of a mask that lie within `NEAR_HULL_PX` of its convex hull (K, 2): what of the hull is rim.

    Where a rib leaves a bump of two pixels the hull spans ten degrees of the rim by chords; a cut into the dish leaves a chord too.
    """
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    border = np.concatenate(contours)[:, 0].astype(float)
    along = np.roll(hull, -1, axis=0) - hull
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    distance = np.abs(border @ normal.T - (hull * normal).sum(axis=1))
    return np.asarray(border[distance.min(axis=1) <= NEAR_HULL_PX])


def _filled(mask: Mask) -> NDArray[np.uint8]:
    """A mask with its holes filled, as 0 and 1."""
    out = np.zeros(mask.shape, dtype=np.uint8)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(out, contours, -1, 1, cv2.FILLED)
    return out
