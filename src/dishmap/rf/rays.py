"""Exact rays from the feed to the dish: path, direction, field, and how the path changes with every actuator.

At the prime focus a ray is a straight line. Off a subreflector it is the one whose path is stationary (Fermat), found by Newton's method
for each point of the dish; its field follows from the power in the cone between neighbouring rays, and the derivative of its path to
anything that moves the subreflector is that of the path at a fixed point of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.antenna import Antenna
from dishmap.rf.correction import Correction
from dishmap.rf.feed import FeedField, feed_field, radiated
from dishmap.rf.subreflector import Patch, SubSurface, local_xy, nominal_reflection, patch, shape_heights, sub_surface
from dishmap.transforms import right_jacobian, rotation_from_vector

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Newton's method for the point of reflection: steps, when a step is the last one, in mm (the next would be the square of it, over the size
# of the subreflector), and above which last step there is no such point.
STEPS, STILL_MM, FOUND_MM = 30, 1e-5, 1e-4
LONGEST_STEP = 0.3


@dataclass(frozen=True)
class Rays:
    """Rays from the feed to N points of the dish.

    path_mm (N,): from the feed's phase centre; direction (N, 3): of arrival; field (N, 3): electric field there without the phase of the
    path, for a feed that radiates unit power; by_values (N, 5 + T): derivative of the path to the values of the correction (mm per mm
    or degree); lost (N,): no ray arrives, or several do, crossing off a bent subreflector. reflection_mm (N, 3): where the
    subreflector was met, NaN at the prime focus.
    """

    path_mm: Array
    direction: Array
    field: Complex
    by_values: Array
    lost: NDArray[np.bool_]
    reflection_mm: Array


@dataclass(frozen=True)
class FeedPlace:
    """Where a feed stands and how: phase centre (3,), rotation dish_from_feed (3, 3), and its field."""

    center_mm: Array
    rotation: Array
    field: FeedField


def feed_place(antenna: Antenna) -> FeedPlace:
    """The feed in its nominal place, with its axis in the middle of the cone of rays to the rim."""
    main, sub = antenna.reflector, antenna.subreflector
    edges = main.offset_mm + np.array([-0.5, 0.5]) * main.diameter_mm
    rim = np.stack([edges, np.zeros(2), edges**2 / (4 * main.focal_length_mm)], axis=1)
    if sub is None:
        center, seen = main.focus_mm, rim
        down = -1.0
    else:
        center, seen = main.focus_mm - [0.0, 0.0, sub.foci_distance_mm], nominal_reflection(main, sub, rim)
        down = 1.0
    way = seen - center
    angle = np.arctan2(way[:, 0], down * way[:, 2])
    middle, edge = float(angle.mean()), float(abs(np.ptp(angle)) / 2)
    z = np.array([np.sin(middle), 0.0, down * np.cos(middle)])
    y = np.array([0.0, down, 0.0])
    rotation = np.stack([np.cross(y, z), y, z], axis=1)
    return FeedPlace(center, rotation, feed_field(antenna.feed, edge, 1 if sub is None else 2))


def trace(antenna: Antenna, feed: FeedPlace, points_mm: Array, correction: Correction, near_mm: Array | None = None) -> Rays:
    """Rays from the feed to points (N, 3) of the dish, after a correction.

    near_mm (N, 3): points of reflection of a correction that differs little, which saves time. Raises InputError when the subreflector
    would reach the dish or the feed.
    """
    if antenna.subreflector is None:
        return _straight(feed, points_mm, correction)
    surface = sub_surface(antenna, correction)
    return _reflected(antenna, surface, feed, points_mm, correction, near_mm)


def _straight(feed: FeedPlace, points: Array, correction: Correction) -> Rays:
    """From a feed that was tilted about its phase centre and shifted."""
    turn = rotation_from_vector([*np.radians(correction.tilt_deg), 0.0]) @ feed.rotation
    way = points - (feed.center_mm + correction.shift_mm)
    path = np.linalg.norm(way, axis=1)
    direction = way / path[:, None]
    field = radiated(feed.field, direction @ turn) @ turn.T / path[:, None]
    by = np.zeros((len(points), 5))
    by[:, :3] = -direction
    return Rays(path, direction, field, by, np.zeros(len(points), bool), np.full_like(points, np.nan))


def _reflected(antenna: Antenna, surface: SubSurface, feed: FeedPlace, points: Array, correction: Correction, near: Array | None) -> Rays:
    assert antenna.subreflector is not None
    xy = local_xy(surface, nominal_reflection(antenna.reflector, antenna.subreflector, points) if near is None else near)
    xy, found, here = _stationary(surface, feed.center_mm, points, xy)
    a, b, d1, d2 = _ways(here.point_mm, feed.center_mm, points)
    hessian = _hessian(here, a, b, d1, d2)
    # off the nominal subreflector a path is shortest or longest; one that is neither has passed a caustic, and is one of several
    lost = ~found | (_det(hessian) <= 0)
    _check_clear(antenna, feed, here.point_mm[~lost])
    normal = _cross(here.first[:, :, 0], here.first[:, :, 1])
    amplitude = np.sqrt(_concentration(normal, hessian, a, b, d1, d2))
    normal /= np.sqrt(_dot(normal, normal))[:, None]
    sent = radiated(feed.field, a @ feed.rotation) @ feed.rotation.T
    field = (2 * _dot(normal, sent)[:, None] * normal - sent) * amplitude[:, None]
    field[lost] = 0.0
    return Rays(d1 + d2, b, field, _by_values(surface, here, xy, a - b, correction), lost, here.point_mm)


def _stationary(surface: SubSurface, start: Array, points: Array, xy: Array) -> tuple[Array, NDArray[np.bool_], Patch]:
    """Own x, y (N, 2) of the points of reflection, whether they were found, and the subreflector there."""
    reach = LONGEST_STEP * surface.radius_mm
    for _ in range(STEPS):
        here = patch(surface, xy)
        a, b, d1, d2 = _ways(here.point_mm, start, points)
        gap = a - b
        gradient = np.stack([_dot(here.first[:, :, 0], gap), _dot(here.first[:, :, 1], gap)], axis=1)
        step = -_solve(_hessian(here, a, b, d1, d2), gradient[..., None])[..., 0]
        long = np.sqrt(step[:, 0] ** 2 + step[:, 1] ** 2)
        xy = xy + step * np.minimum(1.0, reach / np.maximum(long, 1e-300))[:, None]
        if (long < STILL_MM).all():
            break
    return xy, np.asarray(long < FOUND_MM), patch(surface, xy)


def _ways(q: Array, start: Array, points: Array) -> tuple[Array, Array, Array, Array]:
    up, down = q - start, points - q
    d1, d2 = np.sqrt(_dot(up, up)), np.sqrt(_dot(down, down))
    return up / d1[:, None], down / d2[:, None], d1, d2


def _hessian(here: Patch, a: Array, b: Array, d1: Array, d2: Array) -> Array:
    """Second derivative (N, 2, 2) of the path to the point of reflection."""
    e, f = np.ascontiguousarray(here.first[:, :, 0]), np.ascontiguousarray(here.first[:, :, 1])
    a_e, a_f, b_e, b_f = _dot(a, e), _dot(a, f), _dot(b, e), _dot(b, f)
    bow = (a - b) @ here.axis
    both = 1 / d1 + 1 / d2
    out = np.empty((len(a), 2, 2))
    out[:, 0, 0] = bow * here.bend[:, 0, 0] + _dot(e, e) * both - a_e**2 / d1 - b_e**2 / d2
    out[:, 1, 1] = bow * here.bend[:, 1, 1] + _dot(f, f) * both - a_f**2 / d1 - b_f**2 / d2
    out[:, 0, 1] = out[:, 1, 0] = bow * here.bend[:, 0, 1] + _dot(e, f) * both - a_e * a_f / d1 - b_e * b_f / d2
    return out


def _dot(p: Any, q: Any) -> Any:
    """Products (N,) of vectors (N, 3)."""
    return p[:, 0] * q[:, 0] + p[:, 1] * q[:, 1] + p[:, 2] * q[:, 2]


def _cross(p: Array, q: Array) -> Array:
    """Vector products (N, 3): numpy's own are slow."""
    (a, b, c), (d, e, f) = p.T, q.T
    return np.stack([b * f - c * e, c * d - a * f, a * e - b * d], axis=1)


def _concentration(normal: Array, hessian: Array, a: Array, b: Array, d1: Array, d2: Array) -> Array:
    """Solid angle (N,) at the feed for each area across the arriving ray: how much power arrives there, in 1/mm^2.

    A step e across the ray at the dish moves the point of reflection by H^-1 Q' e / d2, by the implicit function theorem, and the departing
    ray by Q of that over d1; areas follow by determinants. normal (N, 3): product of the columns of Q.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.abs(_dot(a, normal) * _dot(b, normal) / _det(hessian)) / (d1 * d2) ** 2)


def _det(matrix: Array) -> Array:
    return np.asarray(matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] * matrix[:, 1, 0])


def _by_values(surface: SubSurface, here: Patch, xy: Array, gap: Array, correction: Correction) -> Array:
    """Derivative of the path to shift, tilt and shape: gap = a - b, times how the point of reflection is carried."""
    out = np.empty((len(xy), 5 + len(surface.terms)))
    out[:, :3] = gap
    arm = here.point_mm - surface.vertex_mm
    # d(R p) = (J w) x (R p), J the left Jacobian: the right one of the opposite turn
    spin = right_jacobian([*-np.radians(correction.tilt_deg), 0.0])[:, :2] * np.radians(1.0)
    out[:, 3:5] = _cross(arm, gap) @ spin
    if surface.terms:
        out[:, 5:] = (gap @ surface.rotation[:, 2])[:, None] * shape_heights(surface, xy)
    return out


def _check_clear(antenna: Antenna, feed: FeedPlace, points: Array) -> None:
    """Raise InputError when the subreflector, where rays meet it (N, 3), touches the dish or lies behind the feed."""
    x, y, z = points.T
    gap = z - (x**2 + y**2) / (4 * antenna.reflector.focal_length_mm)
    if (gap <= 0).any():
        raise InputError(
            f"the subreflector would reach {-gap.min():.4g} mm into the dish; give it a shorter stroke, or a smaller foci_distance_mm"
        )
    if (z <= feed.center_mm[2]).any():
        raise InputError("the subreflector would lie behind the feed's phase centre; give a larger foci_distance_mm or a shorter stroke")


def _solve(matrix: Array, right: Array) -> Array:
    """Solutions (N, 2, K) of two equations each, matrices symmetric: numpy's own loop is slow for so many small ones."""
    p, q, s = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
    scale = 1 / (p * s - q * q)
    first, second = right[:, 0], right[:, 1]
    out = np.empty_like(right)
    out[:, 0] = (scale * s)[:, None] * first - (scale * q)[:, None] * second
    out[:, 1] = (scale * p)[:, None] * second - (scale * q)[:, None] * first
    return out
