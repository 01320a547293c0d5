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
from dishmap.targets.threshold import edge_points, ink_contours, noise_level, reduced_image, sampled, white_level

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
# A square's middle and outer part: where they are looked at, in half sides. One is open when its middle's darkness over that of the outer
# part is below this part of what most of so many squares around show; where blur has filled the middle, below a larger part, if the
# middle is also less dark than theirs by this factor. (A square that is merely faint has a usual ratio.)
MIDDLE_PART, FRAME_PART = 0.15, 0.76
OPEN_RATIO, OPEN_RATIO_FAINT, OPEN_DEPTH, COMPARED = 0.8, 0.93, 0.75, 25


def find_squares(gray: NDArray[Any]) -> Nodes:
    """Dark squares of an image (H, W), uint8 or uint16. Axes are half sides."""
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
    return Nodes(center[dark], right_handed(axes[dark]))


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


def open_squares(gray: NDArray[Any], nodes: Nodes, step_px: Array) -> Flags:
    """Which squares (K,) have a light middle; step_px (K, 2, 2): steps of their lattice.

    The darkness of the middle against that of the square's outer part, both below the ground half way to the next squares, is compared
    with what most of the nearest squares show: so blur, which fills a small middle, does not hide it.
    """
    image = reduced_image(gray, 1, white_level(gray))
    patch = np.stack(np.meshgrid(*[MIDDLE_PART * np.array([-1.0, 0.0, 1.0])] * 2), axis=-1).reshape(-1, 2)
    along = np.array([(x, y) for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))], dtype=float)
    frame = (FRAME_PART * along[:, None] + patch).reshape(-1, 2)
    corners = np.array([(x, y) for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    middle, outer = (np.median(sampled(image, nodes.place_px[:, None] + at @ nodes.axes), axis=1) for at in (patch, frame))
    ground = np.median(sampled(image, nodes.place_px[:, None] + corners @ np.swapaxes(step_px, 1, 2)), axis=1)
    depth = ground - middle
    ratio = depth / np.maximum(ground - outer, 1.0)
    _, near = cKDTree(nodes.place_px).query(nodes.place_px, k=min(COMPARED, len(nodes)))
    ratio, depth = (value / np.maximum(np.median(value[near], axis=1), 1e-3) for value in (ratio, depth))
    return np.asarray((ratio < OPEN_RATIO) | ((ratio < OPEN_RATIO_FAINT) & (depth < OPEN_DEPTH)))
