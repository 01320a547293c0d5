"""Flat coordinates of nominal surfaces: positions on paper that is laid on the surface about its vertex.

On a plane they are x and y. A cylinder unrolls: the way round it and y, all lengths true. On a paraboloid lengths along meridians are true:
a point lies at its way along the surface from the vertex, in its own direction. The maps are smooth everywhere, at the vertex too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.targets.pattern import Surface

Array = NDArray[np.float64]

# Newton steps for the way back along a meridian, and where they may end.
NEWTON_STEPS = 12
NEWTON_MM = 1e-9


def to_flat_mm(surface: Surface, xy_mm: ArrayLike) -> Array:
    """Flat coordinates (..., 2) of points of the surface at x and y (..., 2); NaN beside a cylinder."""
    xy = np.asarray(xy_mm, dtype=float)
    if surface.kind == "cylinder" and surface.radius_mm is not None:
        radius = abs(surface.radius_mm)
        with np.errstate(invalid="ignore"):
            return np.stack([radius * np.arcsin(xy[..., 0] / radius), xy[..., 1]], axis=-1)
    if surface.kind == "paraboloid" and surface.focal_length_mm is not None:
        radius = np.linalg.norm(xy, axis=-1)
        return np.asarray(xy * ratio(meridian_mm(radius, surface.focal_length_mm), radius)[..., None])
    return xy.copy()


def from_flat_mm(surface: Surface, flat: ArrayLike) -> Array:
    """X and y (..., 2) of flat coordinates (..., 2) in mm; NaN beyond the half of a cylinder that faces the camera."""
    flat = np.asarray(flat, dtype=float)
    if surface.kind == "cylinder" and surface.radius_mm is not None:
        radius = abs(surface.radius_mm)
        turn = flat[..., 0] / radius
        return np.stack([np.where(np.abs(turn) <= np.pi / 2, radius * np.sin(turn), np.nan), flat[..., 1]], axis=-1)
    if surface.kind == "paraboloid" and surface.focal_length_mm is not None:
        way = np.linalg.norm(flat, axis=-1)
        return np.asarray(flat * ratio(radius_mm(way, surface.focal_length_mm), way)[..., None])
    return flat.copy()


def meridian_mm(radius: ArrayLike, focal_length_mm: float) -> Array:
    """Way along a meridian of a paraboloid from the vertex to a distance from the axis (...), both in mm."""
    x = np.asarray(radius, dtype=float) / (2 * focal_length_mm)
    return np.asarray(focal_length_mm * (x * np.hypot(1, x) + np.arcsinh(x)))


def radius_mm(way: ArrayLike, focal_length_mm: float) -> Array:
    """Distance from the axis at a way along a meridian from the vertex (...), both in mm: the inverse of `meridian_mm`."""
    way = np.asarray(way, dtype=float)
    radius = way / np.sqrt(1 + np.abs(way) / (4 * focal_length_mm))
    for _ in range(NEWTON_STEPS):
        step = (way - meridian_mm(radius, focal_length_mm)) / np.hypot(1, radius / (2 * focal_length_mm))
        radius = radius + step
        if np.abs(step).max(initial=0.0) < NEWTON_MM:
            break
    return np.asarray(radius)


def ratio(a: Array, b: Array) -> Array:
    """The ratio of two lengths (...), and 1 where both vanish."""
    return np.asarray(np.where(b > 0, a / np.where(b > 0, b, 1.0), 1.0))
