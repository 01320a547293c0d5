"""Photographs of grids with truth, drawn by exact coverage through the whole camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.simulate.contour import add_curve, finish, polyline
from dishmap.transforms import Pose, rotation_from_vector

Array = NDArray[np.float64]

PITCH_MM, WIDTH_MM, SIDE_MM = 12.0, 1.0, 5.0
LIGHT, DARK = 200.0, 40.0
# Pieces of a printed edge per pitch: straight to 1/100 px in these scenes.
PIECES = 4


@dataclass(frozen=True)
class GridScene:
    """A grid of columns x rows nodes about the pattern's origin, on a surface height(x, y), before a camera."""

    camera: Camera
    pose: Pose
    columns: int
    rows: int
    height_mm: Callable[[Array], Array] = lambda xy: np.zeros(xy.shape[:-1])

    def lattice(self) -> NDArray[np.int64]:
        return np.stack(np.meshgrid(np.arange(self.columns), np.arange(self.rows), indexing="ij"), axis=-1).reshape(-1, 2)

    def pixels(self, lattice: Array) -> Array:
        xy = (np.asarray(lattice) - [(self.columns - 1) / 2, (self.rows - 1) / 2]) * PITCH_MM
        points = np.concatenate([xy, self.height_mm(xy)[..., None]], axis=-1)
        return self.camera.project(self.pose.apply(points))

    def coverage(self, outlines: Sequence[Array], blur_px: float) -> Array:
        """Coverage (H, W) of disjoint polygons (K, 2), in lattice units."""
        buffer = np.zeros((self.camera.height_px, self.camera.width_px))
        for corners in outlines:
            sides = np.roll(corners, -1, axis=0) - corners
            pieces = np.maximum(1, np.ceil(PIECES * np.linalg.norm(sides, axis=1))).astype(int)
            edge = [c + s * np.arange(n)[:, None] / n for c, s, n in zip(corners, sides, pieces, strict=True)]
            points, dv = polyline(self.pixels(np.concatenate(edge)), blur_px)
            if (points[:, 0] * dv).sum() < 0:
                dv = -dv
            add_curve(buffer, (0, 0), points, dv, blur_px)
        return np.asarray(finish(buffer))


def box(low: Sequence[float], high: Sequence[float]) -> Array:
    return np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]], dtype=float)


def camera(width: int = 640, height: int = 480, focal: float = 700.0) -> Camera:
    return Camera(width, height, [focal, focal], [(width - 1) / 2, (height - 1) / 2], [-0.15, 0.05, 0.0, 0.0])


def look(tilt_deg: float = 0.0, towards_deg: float = 30.0, roll_deg: float = 0.0, distance_mm: float = 250.0) -> Pose:
    """A camera at a distance from the pattern's origin, that tilted about an axis in the image, and turned about its own axis."""
    axis = np.radians(towards_deg)
    tilt = rotation_from_vector(np.radians(tilt_deg) * np.array([np.cos(axis), np.sin(axis), 0.0]))
    roll = rotation_from_vector(np.array([0.0, 0.0, np.radians(roll_deg)]))
    return Pose(roll @ tilt @ np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, distance_mm]))


def line_photograph(
    scene: GridScene,
    rng: np.random.Generator,
    blur_px: float = 0.8,
    noise: float = 1.0,
    broken: float = 0.0,
    marked: Sequence[tuple[int, int]] = (),
    overhang: float = 0.25,
) -> NDArray[np.uint8]:
    """Crossing lines; of a part of the segments the middle is missing; half-pitch squares in marked cells (their lower corners)."""
    half = WIDTH_MM / PITCH_MM / 2
    light = np.ones((scene.camera.height_px, scene.camera.width_px))
    for axis, (count, length) in enumerate(((scene.columns, scene.rows), (scene.rows, scene.columns))):
        outlines = []
        for line in range(count):
            gaps = np.flatnonzero(rng.random(length - 1) < broken) + 0.5
            ends = np.concatenate([[-overhang], np.stack([gaps - 0.25, gaps + 0.25], axis=1).ravel(), [length - 1 + overhang]])
            for start, end in ends.reshape(-1, 2):
                corners = box((line - half, start), (line + half, end))
                outlines.append(corners if axis == 0 else corners[:, ::-1])
        light *= 1 - scene.coverage(outlines, blur_px)
    light *= 1 - scene.coverage([box((c + 0.25, r + 0.25), (c + 0.75, r + 0.75)) for c, r in marked], blur_px)
    return photograph(1 - light, rng, noise)


def square_photograph(
    scene: GridScene,
    rng: np.random.Generator,
    blur_px: float = 0.8,
    noise: float = 1.0,
    opened: Sequence[tuple[int, int]] = (),
    missing: Sequence[tuple[int, int]] = (),
) -> NDArray[np.uint8]:
    """Separate squares, some of them open (a light square of half the side nested), some of them missing."""
    half = SIDE_MM / PITCH_MM / 2
    places = [tuple(p) for p in scene.lattice().tolist() if tuple(p) not in missing]
    ink = scene.coverage([box((c - half, r - half), (c + half, r + half)) for c, r in places], blur_px)
    ink -= scene.coverage([box((c - half / 2, r - half / 2), (c + half / 2, r + half / 2)) for c, r in opened], blur_px)
    return photograph(ink, rng, noise)


def photograph(ink: Array, rng: np.random.Generator, noise: float) -> NDArray[np.uint8]:
    """Grey levels of ink coverage, with light that falls off to one side by a third."""
    shade = np.linspace(1.0, 0.67, ink.shape[1])
    light = (LIGHT - (LIGHT - DARK) * ink) * shade + rng.normal(0.0, noise, ink.shape)
    return np.clip(np.round(light), 0, 255).astype(np.uint8)


def matched(scene: GridScene, place_px: Array, lattice: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64], int]:
    """Found nodes against the truth.

    Distance (M,) px of each place to the true node nearest to it, that node's lattice place (M, 2), and how many of the given
    lattice places differ from these by other than one shift and quarter turn.
    """
    truth = scene.lattice()
    away = np.linalg.norm(place_px[:, None] - scene.pixels(truth)[None], axis=2)
    nearest = truth[np.argmin(away, axis=1)]
    wrong = len(lattice)
    for quarter in range(4):
        turned = lattice @ np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), quarter)
        _, counts = np.unique(nearest - turned, axis=0, return_counts=True)
        wrong = min(wrong, len(lattice) - int(counts.max()))
    return away.min(axis=1), nearest, wrong
