"""Dark squares of a photograph: contours whose moments are those of a parallelogram, with centre and sides.

The area moments of a contour follow from its points by Green's theorem. Those of second order take any parallelogram to a square of
known size; the fourth-order moment of that, the integral of (x + iy)^4, is real and negative along the sides and so gives their direction.
Neither needs corners, so squares of a few pixels, blurred round, keep their sides.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.targets.grid_nodes import Nodes, right_handed
from dishmap.targets.threshold import edge_points, ink_contours, noise_level, reduced_image, white_level

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Above this many pixels the search runs at half resolution first, and at full resolution where squares have a half side below
# COARSE_PX there.
HALVE_ABOVE_PX = 6_000_000
COARSE_PX = 2.5
# Contours: fewest points, and the part of them that must lie on an edge.
FEWEST_POINTS, LEAST_GOOD_POINTS = 8, 0.6
# A parallelogram's area is 12 sqrt(det covariance); that of its blurred image falls a little towards an ellipse's (by 1.047).
LARGEST_AREA_OFF = 0.12
# |integral z^4| / integral |z|^4 is 0.43 for a square, 0 for a disc or an ellipse, less for a square that is blurred round.
LEAST_SQUARENESS = 0.1
# Of a square with unit variances: half of a side, area, and the integral of |z|^4.
HALF_SIDE, SQUARE_AREA, SQUARE_FOURTH = 3**0.5, 12.0, 33.6
SMALLEST_HALF_SIDE_PX, LEAST_SIDE_RATIO = 1.2, 0.1
# An open square has a light square about the same middle, to this part of its half side, and of this part of its sides.
SAME_MIDDLE, OPEN_SIDES = 0.25, (0.2, 0.9)


def find_squares(gray: NDArray[Any]) -> Nodes:
    """Dark squares of an image (H, W), uint8 or uint16; `marked` where a light square is nested in one. Axes are half sides."""
    white = white_level(gray)
    base = 2 if gray.size > HALVE_ABOVE_PX else 1
    nodes = _search(gray, base, white)
    if base > 1:
        half = np.sqrt(np.abs(np.linalg.det(nodes.axes)))
        if not len(nodes) or np.median(half) < COARSE_PX * base:
            return _search(gray, 1, white)
    return nodes


def _search(gray: NDArray[Any], reduction: int, white: float) -> Nodes:
    image = reduced_image(gray, reduction, white)
    image, threshold, outlines = ink_contours(image, noise_level(image))
    contours = [c for c in outlines if len(c) >= FEWEST_POINTS]
    if not contours:
        return Nodes.none()
    points, starts, counts, dark, good, _ = edge_points(image, threshold, contours)
    enough = np.add.reduceat(good.astype(float), starts) >= LEAST_GOOD_POINTS * counts
    # from a point of its own, lest large numbers cancel
    origin = points[starts]
    center, axes, square = _parallelograms(points - np.repeat(origin, counts, axis=0), starts, counts)
    keep = enough & square
    center = (center + origin)[keep] * reduction + (reduction - 1) / 2
    axes, dark = axes[keep] * reduction, dark[keep]
    nodes = Nodes(center[dark], right_handed(axes[dark]), np.zeros(int(dark.sum()), dtype=bool))
    return Nodes(nodes.place_px, nodes.axes, _is_open(nodes, center[~dark], axes[~dark]))


def _parallelograms(points: Array, starts: NDArray[np.int64], counts: NDArray[np.int64]) -> tuple[Array, Array, Flags]:
    """Middle (M, 2) and half sides (M, 2, 2) of closed contours, and which of them are parallelograms (M,)."""
    following = np.arange(1, len(points) + 1)
    following[starts + counts - 1] = starts
    p, q = points, points[following]
    twice = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    area = np.add.reduceat(twice, starts) / 2
    safe = np.where(np.abs(area) < 1.0, np.inf, area)
    center = np.add.reduceat(twice[:, None] * (p + q), starts, axis=0) / (6 * safe[:, None])
    shift = np.repeat(center, counts, axis=0)
    p, q = p - shift, q - shift
    twice = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    s = p + q
    second = np.stack([s[:, i] * s[:, j] + p[:, i] * p[:, j] + q[:, i] * q[:, j] for i, j in ((0, 0), (0, 1), (1, 1))], axis=1)
    root, size = _root(np.add.reduceat(twice[:, None] * second, starts, axis=0) / (24 * safe[:, None]))
    # to unit variances; along the sides of a square the fourth moment is real and negative
    inverse = np.linalg.inv(root)
    z, w = (np.einsum("nij,nj->ni", np.repeat(inverse, counts, axis=0), v) @ np.array([1.0, 1j]) for v in (p, q))
    weight = twice / np.repeat(size, counts)
    fourth = np.add.reduceat(weight * (z**4 + z**3 * w + z**2 * w**2 + z * w**3 + w**4), starts) / 30
    turn = np.angle(-fourth * np.sign(area)) / 4
    direction = np.stack([np.cos(turn), np.sin(turn), -np.sin(turn), np.cos(turn)], axis=-1).reshape(-1, 2, 2)
    axes = HALF_SIDE * np.einsum("nij,nkj->nki", root, direction)
    length = np.linalg.norm(axes, axis=2)
    good = np.abs(np.abs(safe) / size / SQUARE_AREA - 1) < LARGEST_AREA_OFF
    good &= np.abs(fourth) > LEAST_SQUARENESS * SQUARE_FOURTH
    good &= (length.min(axis=1) >= SMALLEST_HALF_SIDE_PX) & (length.min(axis=1) >= LEAST_SIDE_RATIO * length.max(axis=1))
    return center, axes, good


def _root(covariance: Array) -> tuple[Array, Array]:
    """Square roots (M, 2, 2) of covariances (M, 3: xx, xy, yy), and of their determinants (M,); of the unit matrix for unsound ones."""
    xx, xy, yy = covariance.T
    determinant = xx * yy - xy**2
    sound = (determinant > 1e-6) & (xx + yy > 0)
    xx, xy, yy, determinant = (np.where(sound, value, unit) for value, unit in ((xx, 1.0), (xy, 0.0), (yy, 1.0), (determinant, 1.0)))
    # (S + sqrt(det) 1) / sqrt(trace + 2 sqrt(det)), from the Cayley-Hamilton theorem
    size = np.sqrt(determinant)
    root = np.stack([xx + size, xy, xy, yy + size], axis=-1).reshape(-1, 2, 2) / np.sqrt(xx + yy + 2 * size)[:, None, None]
    return root, size


def _is_open(nodes: Nodes, light_px: Array, light_axes: Array) -> Flags:
    """Which nodes have a light square about their middle."""
    if not len(nodes) or not len(light_px):
        return np.zeros(len(nodes), dtype=bool)
    distance, nearest = cKDTree(light_px).query(nodes.place_px)
    size, inner = (np.sqrt(np.abs(np.linalg.det(a))) for a in (nodes.axes, light_axes[nearest]))
    ratio = inner / size
    return np.asarray((distance < SAME_MIDDLE * size) & (ratio > OPEN_SIDES[0]) & (ratio < OPEN_SIDES[1]))
