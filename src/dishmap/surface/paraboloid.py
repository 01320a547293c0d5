"""The paraboloid in any place and attitude: distance of points to it, its height along z, and their derivatives.

With the axis a towards the focus, q = p - vertex, w = a . q and c = 1 / (4 focal length), points of it have
g = w - c (q . q - w^2) = 0; the gradient of g, a (1 + 2 c w) - 2 c q, has the length sqrt(1 + 4 c^2 rho^2) there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.errors import FitError
from dishmap.transforms import cross_matrix, right_jacobian, rotation_from_vector

Array = NDArray[np.float64]

FOOT_STEPS = 50
# The search for the axis: at most so far from the mean plane's normal (tangent of 60 degrees), 9 x 9 directions on each of
# five grids, on so many of the points.
LARGEST_START_TILT, START_GRID, START_LEVELS, START_POINTS = 1.7, 4, 5, 200
# Bow of the points over their size below which only rounding makes a curvature.
SMALLEST_BOW = 1e-10
NAMES = ("vertex_x", "vertex_y", "vertex_z", "axis_x", "axis_y", "axis_z", "focal_length")
UNITS = ("mm", "mm", "mm", "1", "1", "1", "mm")


@dataclass(frozen=True)
class Placement:
    """Where the six parameters of a paraboloid are counted from: vertex = origin_mm + p[:3], axis = z of rotation turned by p[3:5].

    The parameters are the vertex's shift in mm, a turn about x and y in radians, and the curvature c in 1/mm.
    """

    origin_mm: Array
    rotation: Array

    def vertex_axis_focal(self, parameters: Array) -> Array:
        """The seven numbers of NAMES (7,) for the six parameters."""
        axis = self.rotation @ rotation_from_vector([*parameters[3:5], 0.0])[:, 2]
        return np.concatenate([self.origin_mm + parameters[:3], axis, [0.25 / parameters[5]]])

    def spread(self, parameters: Array) -> Array:
        """Derivative of `vertex_axis_focal` (7, 6)."""
        out = np.zeros((7, 6))
        out[:3, :3] = np.eye(3)
        turn = rotation_from_vector([*parameters[3:5], 0.0])
        # a turn d to the right of the rotation moves its z axis by d x z
        out[3:6, 3:5] = (self.rotation @ turn @ -cross_matrix([0.0, 0.0, 1.0]) @ right_jacobian([*parameters[3:5], 0.0]))[:, :2]
        out[6, 5] = -0.25 / parameters[5] ** 2
        return out


def start_placement(points_mm: ArrayLike) -> tuple[Placement, Array]:
    """A placement and parameters (6,) near the best paraboloid through points (N, 3).

    For a given axis the rest is linear, w = A + B u + C v + D (u^2 + v^2), so the axis alone is searched for, on grids that
    narrow about the mean plane's normal: an offset dish shows its axis only by how its curvature differs across it.
    Raises FitError when the points show no curvature.
    """
    p = np.asarray(points_mm, dtype=float)
    middle = p.mean(axis=0)
    frame = np.linalg.svd(p - middle, full_matrices=False)[2].T
    frame = frame * np.array([1.0, 1.0, np.linalg.det(frame)])
    size = float(np.linalg.norm(p - middle, axis=1).max()) or 1.0
    some = (p - middle)[:: max(1, len(p) // START_POINTS)] @ frame / size
    tilt, step = np.zeros(2), LARGEST_START_TILT / START_GRID
    for _ in range(START_LEVELS):
        grid = np.arange(-START_GRID, START_GRID + 1) * step
        tilts = tilt + np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
        tilt = tilts[np.argmin(_quadrics(some, tilts)[2])]
        step /= START_GRID / 2
    rotation, (a, bx, by, bow) = (found[0] for found in _quadrics(some, tilt[None])[:2])
    if abs(bow) < SMALLEST_BOW:
        raise FitError("the points lie in a plane: they show no curvature for a paraboloid; fit a plane")
    vertex = rotation @ [-bx / (2 * bow), -by / (2 * bow), a - (bx**2 + by**2) / (4 * bow)]
    # the axis points to the focus
    upright = rotation if bow > 0 else rotation * np.array([1.0, -1.0, -1.0])
    return Placement(middle, frame @ upright), np.concatenate([size * frame @ vertex, [0.0, 0.0, abs(bow) / size]])


def _quadrics(points: Array, tilts: Array) -> tuple[Array, Array, Array]:
    """Frames (T, 3, 3) whose z leans by tangents (T, 2), the quadrics (T, 4) of points (N, 3) in them, the squares left (T,)."""
    lean = np.hypot(tilts[:, 0], tilts[:, 1])
    turn = np.arctan(lean) / np.where(lean > 0, lean, 1.0)
    rotation = rotation_from_vector(np.column_stack([-tilts[:, 1] * turn, tilts[:, 0] * turn, np.zeros_like(turn)]))
    u, v, w = np.moveaxis(points @ rotation, -1, 0)
    matrix = np.stack([np.ones_like(u), u, v, u**2 + v**2], axis=-1)
    across = np.swapaxes(matrix, 1, 2)
    # the ridge, far below any curvature, keeps points on a line from being singular
    coefficients = np.linalg.solve(across @ matrix + 1e-14 * len(points) * np.eye(4), across @ w[..., None])
    return rotation, coefficients[..., 0], ((w[..., None] - matrix @ coefficients) ** 2).sum(axis=(1, 2))


def distances(points_mm: ArrayLike, placement: Placement, parameters: Array) -> tuple[Array, Array, Array]:
    """Signed distances of points (N, 3), positive on the focus's side, with unit normals at their feet.

    Returns distances (N,), their derivatives to the parameters (N, 6), and the normals (N, 3) in the points' frame. The
    distance is the exact orthogonal one (Newton's method for the foot), for points nearer than the centre of curvature.
    """
    p = np.asarray(points_mm, dtype=float)
    turn = rotation_from_vector([*parameters[3:5], 0.0])
    rotation, c = placement.rotation @ turn, parameters[5]
    local = (p - placement.origin_mm - parameters[:3]) @ rotation
    radius = np.hypot(local[:, 0], local[:, 1])
    foot = _foot_radius(radius, local[:, 2], c)
    outward = local[:, :2] / np.where(radius > 0, radius, 1.0)[:, None]
    normal = np.column_stack([-2 * c * foot[:, None] * outward, np.ones_like(foot)]) / np.sqrt(1 + 4 * c**2 * foot**2)[:, None]
    gap = local - np.column_stack([foot[:, None] * outward, c * foot**2])
    by = np.empty((len(p), 6))
    by[:, :3] = -normal @ rotation.T
    by[:, 3:5] = _cross(normal, local) @ right_jacobian([*parameters[3:5], 0.0])[:, :2]
    by[:, 5] = -(foot**2) * normal[:, 2]
    return (gap * normal).sum(axis=1), by, normal @ rotation.T


def height_along_z(xy_mm: ArrayLike, seven: Array) -> tuple[Array, Array]:
    """Height z (...,) of the paraboloid NAMES (7,) at (..., 2), and its derivatives to the seven (..., 7); NaN where no surface is.

    Of two heights the one on the vertex's side is given.
    """
    xy = np.asarray(xy_mm, dtype=float)
    vertex, axis, c = seven[:3], seven[3:6], 0.25 / seven[6]
    q = np.concatenate([xy - vertex[:2], np.zeros((*xy.shape[:-1], 1))], axis=-1)
    w = q @ axis
    # g of q + t z is quadratic in t: -c (1 - az^2) t^2 + (az + 2 c w az) t + w - c (q.q - w^2)
    square, linear, constant = -c * (1 - axis[2] ** 2), axis[2] * (1 + 2 * c * w), w - c * ((q**2).sum(axis=-1) - w**2)
    with np.errstate(invalid="ignore", divide="ignore"):
        t = -2 * constant / (linear + np.sign(axis[2]) * np.sqrt(linear**2 - 4 * square * constant))
        q = q + t[..., None] * np.array([0.0, 0.0, 1.0])
        w = q @ axis
        gradient = axis * (1 + 2 * c * w)[..., None] - 2 * c * q
        by_axis = q * (1 + 2 * c * w)[..., None]
        by_focal = ((q**2).sum(axis=-1) - w**2) * c / seven[6]
        by = -np.concatenate([-gradient, by_axis, by_focal[..., None]], axis=-1) / gradient[..., 2:]
    return vertex[2] + t, by


def _foot_radius(radius: Array, w: Array, c: float) -> Array:
    """Distance from the axis (N,) of the nearest point of w = c r^2: the root of 2 c^2 r^3 + (1 - 2 c w) r = radius."""
    foot = radius.copy()
    for _ in range(FOOT_STEPS):
        step = (2 * c**2 * foot**3 + (1 - 2 * c * w) * foot - radius) / np.maximum(6 * c**2 * foot**2 + 1 - 2 * c * w, 1e-6)
        foot = foot - step
        if not (np.abs(step) > 1e-14 * np.maximum(foot, 1e-300)).any():
            break
    return foot


def _cross(a: Array, b: Array) -> Array:
    """Cross products (N, 3); numpy's own is slow for so few rows."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)
