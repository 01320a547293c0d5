"""A circle of known radius seen by a camera: where it shows, and the two poses that an outline allows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.difference.profile import Pieces
from dishmap.errors import MeasurementError
from dishmap.robust import bisquare_weights, mad_scale
from dishmap.transforms import Pose

Array = NDArray[np.float64]

# Points along the outline for the conic, and along the circle to measure the length of its image.
OUTLINE_POINTS, FEWEST_POINTS = 720, 20
CIRCLE_POINTS = 2048
REWEIGHTED_STEPS = 30
# A cone through five points, tried so often; the best leaves the least distance to this part of the outline. Where half of the
# outline is the rim, 3 % of the trials have all five on it.
TRIALS, TRUE_PART = 400, 0.45
# Bisquare tuning, as the paper's Algorithm 4
TUNING = 4.685


def circle_points(radius_mm: float, height_mm: float, angle_rad: Array) -> Array:
    """Points (N, 3) of the circle about the z axis at a height, at angles (N,) from x towards y."""
    return np.stack([radius_mm * np.cos(angle_rad), radius_mm * np.sin(angle_rad), np.full(angle_rad.shape, height_mm)], axis=-1)


def circle_pieces(camera: Camera, camera_from_circle: Pose, radius_mm: float, height_mm: float, longest: int, shortest_px: float) -> Pieces:
    """Pieces of a circle's image, equally long: at most `longest` of them, each at least `shortest_px` long.

    Raises MeasurementError when part of the circle has no image.
    """

    def image(angle: Array) -> Array:
        return camera.project(camera_from_circle.apply(circle_points(radius_mm, height_mm, angle)))

    turn = np.linspace(0.0, 2 * np.pi, CIRCLE_POINTS + 1)
    closed = image(turn)
    if not np.isfinite(closed).all():
        raise MeasurementError("part of the dish's rim lies outside the lens's field; a photograph of the whole rim is needed")
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    count = int(np.clip(way[-1] / shortest_px, 8, longest))
    angle, step = np.interp((np.arange(count) + 0.5) / count * way[-1], way, turn), np.pi / count
    before, middle, after = image(angle - step), image(angle), image(angle + step)
    along = after - before
    length = np.linalg.norm(along, axis=1)
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1) / length[:, None]
    outwards = np.sign(((middle - closed[:-1].mean(axis=0)) * normal).sum(axis=1))
    normal *= outwards[:, None]
    bend = ((before + after - 2 * middle) * normal).sum(axis=1) / (0.5 * length) ** 2
    return Pieces(middle, normal, -bend, float(way[-1] / count))


def circle_poses(camera: Camera, outline_px: Array, radius_mm: float, height_mm: float) -> tuple[Pose, Pose]:
    """The two poses of a circle about z at `height_mm` whose image runs through most points of an outline (K, 2), its z towards the camera.

    The rays of the outline are generators of a cone of second degree, which is cut in circles by two families of planes
    (the axes of its quadratic form give them; e.g. Chen et al. 2004, "Camera calibration with two arbitrary coplanar circles").
    Parts of the outline that do not follow the cone get no weight. The turn about z leaves y up in the image.
    Raises MeasurementError when the outline is no image of a circle.
    """
    rays = camera.unproject(outline_px[:: max(1, len(outline_px) // OUTLINE_POINTS)])
    rays = rays[np.isfinite(rays).all(axis=1)]
    if len(rays) < FEWEST_POINTS:
        raise MeasurementError("the dish's outline lies outside the lens's field; a photograph of the whole rim is needed")
    cone = _cone(rays)
    values, axes = np.linalg.eigh(cone)
    # two axes of one sign and one of the other
    if np.sign(values).sum() > 0:
        values, axes = -values[::-1], axes[:, ::-1]
    if not values[0] <= values[1] < 0 < values[2]:
        raise MeasurementError("the dish's outline is not the image of a circle; is the whole rim in view, and nothing else as light?")
    low, middle, high = values
    a, b = np.sqrt(max(middle - low, 0.0) / (high - low)), np.sqrt((high - middle) / (high - low))
    first, second = (_pose(cone, rays.mean(axis=0), axes @ np.array([sign * a, 0.0, b]), radius_mm, height_mm) for sign in (1.0, -1.0))
    return first, second


def upright_pose(z_axis: Array, origin_mm: Array) -> Pose:
    """A pose whose z is given (3,) in the camera frame, turned about it so that y points up in the image as far as it can."""
    x = np.cross([0.0, -1.0, 0.0], z_axis)
    x /= np.linalg.norm(x)
    return Pose(np.stack([x, np.cross(z_axis, x), z_axis], axis=1), origin_mm)


def _cone(rays: Array) -> Array:
    """Symmetric matrix (3, 3) of the cone ray^T Q ray = 0 through most of the rays (N, 3), least squares in angular distance.

    It starts from the best of many cones through five of the rays (least quantile of distances; Rousseeuw 1984), so that up to half of
    the outline may run elsewhere, and goes on with bisquare weights.
    """
    x, y, z = rays.T
    monomials = np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z], axis=1)
    # a fixed seed: the same outline always gives the same cone
    five = np.random.default_rng(20180917).integers(len(rays), size=(TRIALS, 5))
    tried = _matrices(np.linalg.svd(monomials[five])[2][:, -1])
    turned = rays @ tried
    distances = np.abs((turned * rays).sum(axis=-1)) / np.maximum(np.linalg.norm(turned, axis=-1), 1e-12)
    matrix = tried[np.argmin(np.partition(distances, int(TRUE_PART * len(rays)), axis=1)[:, int(TRUE_PART * len(rays))])]
    for _ in range(REWEIGHTED_STEPS):
        distance = _distance(rays, matrix)
        robust = bisquare_weights(distance / (TUNING * max(mad_scale(distance, 5), 1e-12)))
        weights = np.sqrt(robust) / np.maximum(np.linalg.norm(rays @ matrix, axis=1), 1e-12)
        matrix = _matrices(np.linalg.svd(monomials * weights[:, None], full_matrices=False)[2][-1])
    return matrix


def _matrices(q: Array) -> Array:
    """Symmetric matrices (..., 3, 3) of coefficients (..., 6) of x^2, y^2, z^2, 2xy, 2xz, 2yz."""
    return np.asarray(q[..., [[0, 3, 4], [3, 1, 5], [4, 5, 2]]])


def _distance(rays: Array, matrix: Array) -> Array:
    """Angular distance (N,) of rays from a cone, to first order."""
    turned = rays @ matrix
    return np.asarray((turned * rays).sum(axis=1) / np.maximum(2 * np.linalg.norm(turned, axis=1), 1e-12))


def _pose(cone: Array, sight: Array, normal: Array, radius_mm: float, height_mm: float) -> Pose:
    """Pose of the circle of known radius in which planes of one normal (3,) cut a cone (3, 3) about a sight (3,)."""
    axis = normal if normal @ sight < 0 else -normal
    frame = upright_pose(axis, np.zeros(3))
    # in the plane one unit before the camera: x = a e1 + b e2 - axis, a circle's equation in a and b
    across = np.column_stack([frame.rotation[:, :2], -axis])
    equation = across.T @ cone @ across
    size = 0.5 * (equation[0, 0] + equation[1, 1])
    middle = -equation[:2, 2] / size
    scale = radius_mm / np.sqrt(max(middle @ middle - equation[2, 2] / size, 1e-12))
    center = scale * (across @ np.array([*middle, 1.0]))
    return Pose(frame.rotation, center - height_mm * axis)
