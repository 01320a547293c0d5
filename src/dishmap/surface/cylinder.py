"""The circular cylinder in any place and attitude: distance of points to it, its height along z, and their derivatives.

It is described at one of its generators, so that a sheet that hardly bends is described as well as a tube: in axes (u across, v along the
generator, w along its normal) with the curvature c, positive for a cylinder that bulges along its normal, a point has the distance

    (c (u^2 + w^2) + 2 w) / (D + 1),   D = sqrt(c^2 u^2 + (1 + c w)^2),

which is sqrt(u^2 + (w + 1/c)^2) - 1/c without the difference of large numbers (Pratt 1987 of circles).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.errors import FitError
from dishmap.transforms import cross_matrix, right_jacobian, rotation_from_vector

Array = NDArray[np.float64]

# The search for the axis: directions over a hemisphere, then 5 x 5 about the best on each of so many grids that narrow; on so many of the
# points, and again without those farthest off, so that a few strays do not lead it.
DIRECTIONS, START_GRID, START_LEVELS, START_POINTS = 200, 2, 8, 200
ROUNDS, KEPT_PART = 3, 0.7
# Points around more of the circle than this (distance of their mean from the axis over the radius) have no side of their own.
OWN_SIDE = 0.4
# Curvature times the points' size below which only rounding makes it.
SMALLEST_BOW = 1e-10
NAMES = ("point_x", "point_y", "point_z", "axis_x", "axis_y", "axis_z", "radius")
UNITS = ("mm", "mm", "mm", "1", "1", "1", "mm")
SHIFT, TURN, CURVATURE = 0, slice(1, 4), 4


@dataclass(frozen=True)
class Generator:
    """Where the five parameters of a cylinder are counted from: origin_mm near it, rotation with columns across, along the axis, normal.

    The parameters are a shift along that normal in mm, a turn about the three axes in radians, and the curvature c in 1/mm. Distances are
    positive on the normal's side, and so is the radius of a cylinder that bulges to it.
    """

    origin_mm: Array
    rotation: Array

    def point_axis_radius(self, parameters: Array) -> Array:
        """The seven numbers of NAMES (7,): the point of the axis that faces the origin, the axis, the radius."""
        turned = self.rotation @ rotation_from_vector(parameters[TURN])
        radius = 1 / parameters[CURVATURE]
        point = self.origin_mm + parameters[SHIFT] * self.rotation[:, 2] - radius * turned[:, 2]
        return np.concatenate([point, turned[:, 1], [radius]])

    def spread(self, parameters: Array) -> Array:
        """Derivative of `point_axis_radius` (7, 5)."""
        turned = self.rotation @ rotation_from_vector(parameters[TURN])
        by_turn = right_jacobian(parameters[TURN])
        radius = 1 / parameters[CURVATURE]
        out = np.zeros((7, 5))
        out[:3, SHIFT] = self.rotation[:, 2]
        # a turn d to the right of the rotation moves its axes a by d x a
        out[:3, TURN] = -radius * turned @ -cross_matrix([0.0, 0.0, 1.0]) @ by_turn
        out[:3, CURVATURE] = radius**2 * turned[:, 2]
        out[3:6, TURN] = turned @ -cross_matrix([0.0, 1.0, 0.0]) @ by_turn
        out[6, CURVATURE] = -(radius**2)
        return out


def start_generator(points_mm: ArrayLike) -> tuple[Generator, Array]:
    """A generator and parameters (5,) near the best cylinder through points (N, 3).

    For a given axis the rest is a circle through the points seen along it, so the axis alone is searched for. The normal is the one of
    the points' side, on the side of +z; where points lie all around, the cylinder bulges. Raises FitError for points without curvature.
    """
    p = np.asarray(points_mm, dtype=float)
    middle = np.median(p, axis=0)
    size = float(np.linalg.norm(p - middle, axis=1).max()) or 1.0
    some = (p - middle)[:: max(1, len(p) // START_POINTS)] / size
    kept = np.ones(len(some), bool)
    for _ in range(ROUNDS):
        axis = _best_axis(some[kept])
        frame, circle, _ = _circles(some[kept], axis[None])
        off = np.abs(_algebraic(some @ frame[0][:, :2], circle[0]))
        kept = off <= np.quantile(off, KEPT_PART)
    square, *linear, _ = circle[0]
    if abs(square) < SMALLEST_BOW:
        raise FitError("the points lie in a plane: they show no curvature for a cylinder; fit a plane")
    across = frame[0][:, :2]
    # the constraint on circles makes 2 |square| the curvature
    center, radius = -np.array(linear) / (2 * square), 0.5 / abs(square)
    side = (some[kept] @ across).mean(axis=0) - center
    outward = across @ side / max(float(np.linalg.norm(side)), 1e-12)
    upward = across @ across.T @ np.array([0.0, 0.0, 1.0])
    bulges = True
    if np.linalg.norm(side) < OWN_SIDE * radius and np.linalg.norm(upward) > OWN_SIDE:
        outward = upward / np.linalg.norm(upward)
    elif outward[2] < -1e-9:
        bulges = False
    normal = outward if bulges else -outward
    along = axis if axis[np.argmax(np.abs(axis))] > 0 else -axis
    origin = middle + size * (across @ center + radius * outward)
    sign = 1.0 if bulges else -1.0
    return Generator(origin, np.column_stack([np.cross(along, normal), along, normal])), np.array([0, 0, 0, 0, sign / (radius * size)])


def _best_axis(points: Array) -> Array:
    """The direction (3,) along which points (N, 3) look most like a circle."""
    k = np.arange(DIRECTIONS) + 0.5
    # a sunflower over the hemisphere
    z, angle = 1 - k / DIRECTIONS, np.pi * (1 + np.sqrt(5)) * k
    directions = np.column_stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z])
    step = 0.7 * np.sqrt(2 * np.pi / DIRECTIONS)
    best = directions[np.argmin(_circles(points, directions)[2])]
    grid = np.arange(-START_GRID, START_GRID + 1)
    for _ in range(START_LEVELS):
        frame = _frames(best[None])[0]
        lean = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2) * (step / START_GRID)
        directions = frame[:, 2] + lean @ frame[:, :2].T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        best = directions[np.argmin(_circles(points, directions)[2])]
        step /= START_GRID
    return np.asarray(best)


def _frames(axis: Array) -> Array:
    """Rotations (T, 3, 3) whose last column is each axis (T, 3)."""
    other = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    across = np.cross(axis, other)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([across, np.cross(axis, across), axis], axis=-1)


def _circles(points: Array, axis: Array) -> tuple[Array, Array, Array]:
    """Frames (T, 3, 3) of axes (T, 3), circles (T, 4) through points (N, 3) seen along them, and the mean squares left (T,).

    A circle or line a (x^2 + y^2) + b x + c y + d = 0 under b^2 + c^2 - 4 a d = 1 (Pratt 1987): the left side is then nearly the distance.
    """
    frame = _frames(axis)
    x, y = np.moveaxis(points @ frame[..., :2], -1, 0)
    matrix = np.stack([x**2 + y**2, x, y, np.ones_like(x)], axis=-1)
    moment = np.swapaxes(matrix, 1, 2) @ matrix / len(points)
    inverse = np.zeros((4, 4))
    inverse[0, 3] = inverse[3, 0] = -0.5
    inverse[1, 1] = inverse[2, 2] = 1.0
    values, vectors = np.linalg.eig(inverse @ moment)
    values = values.real
    # one eigenvalue is negative; the smallest of the others is the circle's
    chosen = np.argmin(np.where(values < -1e-13, np.inf, values), axis=1)
    rows = np.arange(len(axis))
    circle = vectors.real[rows, :, chosen]
    norm = circle[:, 1] ** 2 + circle[:, 2] ** 2 - 4 * circle[:, 0] * circle[:, 3]
    circle = circle / np.sqrt(np.maximum(norm, 1e-300))[:, None]
    return frame, circle, np.where(norm > 0, ((matrix @ circle[..., None])[..., 0] ** 2).mean(axis=1), np.inf)


def _algebraic(xy: Array, circle: Array) -> Array:
    return np.asarray(circle[0] * (xy**2).sum(axis=1) + xy @ circle[1:3] + circle[3])


def distances(points_mm: ArrayLike, generator: Generator, parameters: Array) -> tuple[Array, Array, Array]:
    """Signed distances of points (N, 3), positive on the normal's side, with unit normals of the surface there.

    Returns distances (N,), their derivatives to the parameters (N, 5), and the normals (N, 3) in the points' frame.
    """
    p = np.asarray(points_mm, dtype=float)
    rotation, c = generator.rotation @ rotation_from_vector(parameters[TURN]), parameters[CURVATURE]
    local = (p - generator.origin_mm - parameters[SHIFT] * generator.rotation[:, 2]) @ rotation
    u, w = local[:, 0], local[:, 2]
    square, rise = u**2 + w**2, 1 + c * w
    # over the axis itself no direction is the right one
    far = np.maximum(np.hypot(c * u, rise), 1e-12)
    distance = (c * square + 2 * w) / (far + 1)
    normal = np.column_stack([c * u / far, np.zeros_like(u), rise / far])
    by = np.empty((len(p), 5))
    by[:, SHIFT] = -(normal @ rotation.T) @ generator.rotation[:, 2]
    by[:, TURN] = np.cross(normal, local) @ right_jacobian(parameters[TURN])
    by[:, CURVATURE] = (square - distance * (c * u**2 + rise * w) / far) / (far + 1)
    return distance, by, normal @ rotation.T


def height_along_z(xy_mm: ArrayLike, seven: Array) -> tuple[Array, Array]:
    """Height z (...,) of the cylinder NAMES (7,) at (..., 2), and its derivatives to the seven (..., 7); NaN beside it.

    Of two heights the upper is given of a cylinder with a positive radius, the lower of one with a negative radius.
    """
    xy = np.asarray(xy_mm, dtype=float)
    point, axis, radius = seven[:3], seven[3:6], seven[6]
    q = np.concatenate([xy - point[:2], np.zeros((*xy.shape[:-1], 1))], axis=-1)
    along = q @ axis
    # |q + t z - its part along the axis|^2 = radius^2 is quadratic in t
    square, half = 1 - axis[2] ** 2, -along * axis[2]
    constant = (q**2).sum(axis=-1) - along**2 - radius**2
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (-half + np.sign(radius) * np.sqrt(half**2 - square * constant)) / square
        q = q + t[..., None] * np.array([0.0, 0.0, 1.0])
        along = q @ axis
        outward = q - along[..., None] * axis
        by = -np.concatenate([-outward, -along[..., None] * q, np.full((*t.shape, 1), -radius)], axis=-1) / outward[..., 2:]
    return point[2] + t, by
