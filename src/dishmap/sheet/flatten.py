"""Maps between a surface and the flat paper that is laid on it.

No piece of a paraboloid is flat, so paper laid on it must give somewhere. Both maps keep all lengths away from one line or point, and
lengths across those ways are longer on the paper than on the surface by a little: the paper must shrink there. `stretch` says by how much.

- `AroundVertex`: lengths along the meridians are true, those along the parallels are r / s of the paper's (r: distance from the axis,
  s: from the vertex along the surface).
- `AlongMeridian`: lengths along a meridian are true, and so are those along the geodesics that leave it at right angles (Fermi
  coordinates; do Carmo, Differential Geometry, 4.6). Across these, the ratio follows Jacobi's equation j'' = -K j, about 1 - K t^2 / 2 at a
  distance t, with Gauss's curvature K.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.flat import NEWTON_MM, NEWTON_STEPS, from_flat_mm, meridian_mm, radius_mm, ratio, to_flat_mm
from dishmap.targets.pattern import Surface

Array = NDArray[np.float64]

# Runge-Kutta steps along a geodesic: right to 3e-6 mm over 100 mm on a dish of 100 mm focal length.
STEPS = 12


class FlatMap(Protocol):
    """A map between positions on a surface, seen along its axis (N, 2), and positions on flat paper (N, 2), both in mm."""

    def to_flat(self, xy_mm: Array) -> Array:
        """Where points of the surface lie on the paper."""

    def to_surface(self, flat_mm: Array) -> Array:
        """Where points of the paper lie on the surface."""

    def axes(self, flat_mm: Array) -> tuple[Array, Array]:
        """Unit vectors (N, 3) along the surface into which the paper's x and y go."""

    def stretch(self, flat_mm: Array, reach_mm: Array) -> Array:
        """Length on the surface over length on the paper (N,): the one farthest from 1 within reach_mm (N,) of each point."""


@dataclass(frozen=True)
class Flat:
    """A plane, or a cylinder unrolled: all lengths stay."""

    surface: Surface = field(default_factory=Surface)

    def to_flat(self, xy_mm: Array) -> Array:
        """Where points of the surface lie on the paper."""
        return to_flat_mm(self.surface, xy_mm)

    def to_surface(self, flat_mm: Array) -> Array:
        """Where points of the paper lie on the surface."""
        return from_flat_mm(self.surface, flat_mm)

    def axes(self, flat_mm: Array) -> tuple[Array, Array]:
        """Unit vectors (N, 3) along the surface into which the paper's x and y go."""
        y = np.tile([0.0, 1.0, 0.0], (len(flat_mm), 1))
        return np.cross(y, self.surface.normal(self.to_surface(flat_mm))), y

    def stretch(self, flat_mm: Array, reach_mm: Array) -> Array:
        """One everywhere."""
        return np.ones(len(flat_mm))


@dataclass(frozen=True)
class AroundVertex:
    """A paraboloid flattened about its vertex; the paper's x and y are the dish's."""

    focal_length_mm: float

    @property
    def _surface(self) -> Surface:
        return Surface("paraboloid", focal_length_mm=self.focal_length_mm)

    def to_flat(self, xy_mm: Array) -> Array:
        """Where points of the surface lie on the paper."""
        return to_flat_mm(self._surface, xy_mm)

    def to_surface(self, flat_mm: Array) -> Array:
        """Where points of the paper lie on the surface."""
        return from_flat_mm(self._surface, flat_mm)

    def axes(self, flat_mm: Array) -> tuple[Array, Array]:
        """Unit vectors (N, 3) along the surface into which the paper's x and y go."""
        way = np.hypot(*flat_mm.T)
        c, s = (np.where(way > 0, flat_mm[:, k] / np.where(way > 0, way, 1.0), 1.0 - k) for k in (0, 1))
        slope = radius_mm(way, self.focal_length_mm) / (2 * self.focal_length_mm)
        outward = np.column_stack([c, s, slope]) / np.hypot(1, slope)[:, None]
        around = np.column_stack([-s, c, np.zeros_like(c)])
        return c[:, None] * outward - s[:, None] * around, s[:, None] * outward + c[:, None] * around

    def stretch(self, flat_mm: Array, reach_mm: Array) -> Array:
        """Length along the parallel over length on the paper (N,), where it is least."""
        way = np.hypot(*flat_mm.T) + reach_mm
        return ratio(radius_mm(way, self.focal_length_mm), way)


@dataclass(frozen=True)
class AlongMeridian:
    """A paraboloid flattened about the meridian at an azimuth: the paper's y is the way along it from the vertex.

    The printed side faces the focus, so the paper's x runs against the azimuth.
    """

    focal_length_mm: float
    azimuth_rad: float

    def to_flat(self, xy_mm: Array) -> Array:
        """Where points of the surface lie on the paper, by Newton's method on `to_surface`."""
        xy = np.asarray(xy_mm, dtype=float)
        point = np.column_stack([xy, (xy**2).sum(axis=1) / (4 * self.focal_length_mm)])
        radius, turn = np.hypot(*xy.T), np.arctan2(xy[:, 1], xy[:, 0]) - self.azimuth_rad
        way = meridian_mm(radius, self.focal_length_mm)
        flat = np.column_stack([-way * np.sin(turn), way * np.cos(turn)])
        for _ in range(NEWTON_STEPS):
            at, along, across, ratio = self._walk(flat)
            step = np.column_stack([((point - at) * along).sum(axis=1), ((point - at) * across).sum(axis=1) / ratio])
            flat = flat + step
            if np.abs(step).max(initial=0.0) < NEWTON_MM:
                break
        return flat

    def to_surface(self, flat_mm: Array) -> Array:
        """Where points of the paper lie on the surface."""
        return self._walk(np.asarray(flat_mm, dtype=float))[0][:, :2]

    def axes(self, flat_mm: Array) -> tuple[Array, Array]:
        """Unit vectors (N, 3) along the surface into which the paper's x and y go."""
        _, along, across, _ = self._walk(flat_mm)
        return along, across

    def stretch(self, flat_mm: Array, reach_mm: Array) -> Array:
        """Length along the meridian over length on the paper (N,), where it is least."""
        farthest = flat_mm[:, 0] + np.copysign(reach_mm, flat_mm[:, 0])
        return self._walk(np.column_stack([farthest, flat_mm[:, 1]]))[3]

    def _walk(self, flat_mm: Array) -> tuple[Array, Array, Array, Array]:
        """From the meridian along the geodesic: points (N, 3), directions along it and across it, and Jacobi's ratio (N,)."""
        f = self.focal_length_mm
        radius = radius_mm(flat_mm[:, 1], f)
        c, s = np.cos(self.azimuth_rad), np.sin(self.azimuth_rad)
        point = np.column_stack([radius * c, radius * s, radius**2 / (4 * f)])
        outward = np.column_stack([np.full_like(radius, c), np.full_like(radius, s), radius / (2 * f)])
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        state = np.concatenate([point.T, np.cross(outward, _normal(point, f)).T, [np.ones_like(radius), np.zeros_like(radius)]])
        h = flat_mm[:, 0] / STEPS
        for _ in range(STEPS):
            k1 = _change(state, f)
            k2 = _change(state + h / 2 * k1, f)
            k3 = _change(state + h / 2 * k2, f)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + _change(state + h * k3, f))
        point, along = state[:3].T, state[3:6].T
        return point, along, np.cross(_normal(point, f), along), state[6]


def _change(state: Array, f: float) -> Array:
    """Derivative of (point, direction, j, j') (8, N) along a geodesic: it bends with the surface only, p'' = II(p', p') n."""
    x, y, _, vx, vy, vz, ratio, slope = state
    steep = 1 + (x**2 + y**2) / (4 * f**2)
    lift = (vx**2 + vy**2) / (2 * f * steep)
    gauss = 1 / (4 * f**2) / steep**2
    return np.array([vx, vy, vz, -lift * x / (2 * f), -lift * y / (2 * f), lift, slope, -gauss * ratio])


def _normal(point: Array, f: float) -> Array:
    normal = np.column_stack([-point[:, :2] / (2 * f), np.ones(len(point))])
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))
