"""Grids drawn exactly: lines and rectangles on any smooth surface through any lens, with exact coverage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.simulate.contour import add_curve, finish, signed_area
from dishmap.targets.pattern import GridLine, Pattern, Polygon, Surface, TargetKind
from dishmap.transforms import Pose, rotation_from_vector

Array = NDArray[np.float64]

# Gauss's rule on pieces of one blur along the true curve: four nodes leave 3e-8 of an edge's peak, three some 1e-6.
NODES = 3
# Part of a side over which its direction is taken.
TINY = 1e-4
Lift = Callable[[Array], Array]


def flat(xy_mm: Array) -> Array:
    return np.concatenate([xy_mm, np.zeros((*xy_mm.shape[:-1], 1))], axis=-1)


def cylinder(radius_mm: float) -> Lift:
    """A sheet wrapped round a cylinder along y."""

    def lift(xy_mm: Array) -> Array:
        turn = xy_mm[..., 0] / radius_mm
        return np.stack([radius_mm * np.sin(turn), xy_mm[..., 1], radius_mm * (np.cos(turn) - 1)], axis=-1)

    return lift


def bowl(focal_mm: float) -> Lift:
    """A paraboloid over x, y."""

    def lift(xy_mm: Array) -> Array:
        return np.concatenate([xy_mm, (xy_mm**2).sum(axis=-1, keepdims=True) / (4 * focal_mm)], axis=-1)

    return lift


def facing(distance_mm: float, turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Pose:
    """Pose camera_from_dish of a pattern seen from its front, turned about its own x, y and z."""
    rotation = rotation_from_vector(np.array([np.pi, 0, 0]))
    for axis, angle in zip(np.eye(3), np.radians(turn_deg), strict=True):
        rotation = rotation @ rotation_from_vector(angle * axis)
    return Pose(rotation, np.array([0.0, 0.0, distance_mm]))


def line_grid(columns: int, rows: int, pitch_mm: float, width_mm: float, overhang_mm: float | None = None) -> Pattern:
    """Crossings of lines on a plane, centred."""
    lattice, center = _lattice(columns, rows, pitch_mm)
    ids = 1 + np.arange(len(lattice)).reshape(rows, columns)
    overhang = pitch_mm / 2 if overhang_mm is None else overhang_mm
    lines = [GridLine(tuple(row.tolist()), width_mm, overhang) for row in (*ids, *ids.T)]
    kind = TargetKind(np.zeros((0, 2)), np.zeros(0), np.zeros(0, bool))
    return _pattern(lattice, center, {"crossing": kind}, tuple(lines))


def square_grid(columns: int, rows: int, pitch_mm: float, side_mm: float, light_mm: float = 0.0) -> Pattern:
    """Separate squares on a plane, centred; light_mm: side of a light square in each."""
    lattice, center = _lattice(columns, rows, pitch_mm)
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    polygons = [Polygon(corners * side_mm)] + ([Polygon(corners * light_mm, dark=False)] if light_mm else [])
    kind = TargetKind(np.zeros((0, 2)), np.zeros(0), np.zeros(0, bool), tuple(polygons))
    return _pattern(lattice, center, {"square": kind}, ())


def _lattice(columns: int, rows: int, pitch_mm: float) -> tuple[NDArray[np.int64], Array]:
    row, column = np.divmod(np.arange(columns * rows), columns)
    lattice = np.stack([column, row], axis=1)
    center = flat((lattice - 0.5 * np.array([columns - 1, rows - 1])) * pitch_mm)
    return lattice, center


def _pattern(lattice: NDArray[np.int64], center: Array, kinds: dict[str, TargetKind], lines: tuple[GridLine, ...]) -> Pattern:
    count = len(lattice)
    axes = np.tile([1.0, 0.0, 0.0], (count, 1)), np.tile([0.0, 0.0, 1.0], (count, 1))
    return Pattern("grid", Surface("plane"), kinds, np.arange(count) + 1, tuple(kinds) * count, center, *axes, lattice, lines)


@dataclass
class Drawing:
    """Coverage of ink (H, W) of shapes on a lifted plane; the truth of any printed point."""

    camera: Camera
    pose: Pose
    lift: Lift
    psf_px: float
    cover: Array = field(init=False)

    def __post_init__(self) -> None:
        self.cover = np.zeros((self.camera.height_px, self.camera.width_px))

    def place_px(self, xy_mm: Array) -> Array:
        """Image of printed positions."""
        return self.camera.project(self.pose.apply(self.lift(np.asarray(xy_mm, dtype=float))))

    def add(self, corners_mm: Array, sign: float = 1.0) -> None:
        """Add the inside of a polygon of the flat sheet, whose sides bend with the surface."""
        corners = np.asarray(corners_mm, dtype=float)
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        parts = []
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            length = np.linalg.norm(np.diff(self.place_px(start + np.linspace(0, 1, 9)[:, None] * (end - start)), axis=0), axis=1).sum()
            count = max(2, int(np.ceil(length / self.psf_px)))
            along = ((np.arange(count)[:, None] + 0.5 * (nodes + 1)) / count).ravel()[:, None]
            ahead, behind = (self.place_px(start + (along + step) * (end - start)) for step in (TINY, -TINY))
            dv = (ahead - behind)[:, 1] / (2 * TINY) * np.tile(0.5 * weights / count, count)
            parts.append((self.place_px(start + along * (end - start)), dv))
        points, dv = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
        if signed_area(points, dv) < 0:
            dv = -dv
        low, high = np.floor(points.min(axis=0) - 8 * self.psf_px - 2), np.ceil(points.max(axis=0) + 8 * self.psf_px + 2)
        low, high = np.maximum(low, 0).astype(int), np.minimum(high, np.array(self.cover.shape[::-1]) - 1).astype(int)
        if (high < low).any():
            return
        part = np.zeros((high[1] - low[1] + 1, high[0] - low[0] + 1))
        add_curve(part, (int(low[0]), int(low[1])), points, dv, self.psf_px)
        self.cover[low[1] : high[1] + 1, low[0] : high[0] + 1] += sign * finish(part)

    def add_box(self, x_mm: tuple[float, float], y_mm: tuple[float, float], sign: float = 1.0) -> None:
        """Add a rectangle of the flat sheet."""
        self.add(np.array([[x_mm[0], y_mm[0]], [x_mm[1], y_mm[0]], [x_mm[1], y_mm[1]], [x_mm[0], y_mm[1]]]), sign)

    def add_pattern(self, pattern: Pattern, wider_mm: float = 0.0) -> None:
        """Add all ink of a grid on a plane; wider_mm: how far edges lie outwards."""
        center = pattern.center_mm[:, :2]
        for place, name in zip(center, pattern.kind_names, strict=True):
            for polygon in pattern.kinds[name].polygons:
                grow = wider_mm if polygon.dark else -wider_mm
                self.add(place + polygon.corners_mm + grow * np.sign(polygon.corners_mm), 1.0 if polygon.dark else -1.0)
        row_of = {int(i): row for row, i in enumerate(pattern.ids)}
        boxes: list[list[tuple[Array, Array]]] = [[], []]
        for line in pattern.lines:
            ends = np.sort(center[[row_of[line.ids[0]], row_of[line.ids[-1]]]], axis=0)
            along = int(np.argmax(ends[1] - ends[0]))
            grow = np.full(2, 0.5 * line.width_mm + wider_mm)
            grow[along] = line.overhang_mm
            boxes[along].append((ends[0] - grow, ends[1] + grow))
            self.add_box((ends[0][0] - grow[0], ends[1][0] + grow[0]), (ends[0][1] - grow[1], ends[1][1] + grow[1]))
        for low_one, high_one in boxes[0]:
            for low_two, high_two in boxes[1]:
                low, high = np.maximum(low_one, low_two), np.minimum(high_one, high_two)
                if (high > low).all():
                    self.add_box((low[0], high[0]), (low[1], high[1]), -1.0)

    def image(self, ground: float = 200.0, ink: float = 30.0) -> Array:
        """Grey levels without noise."""
        return ground + (ink - ground) * self.cover
