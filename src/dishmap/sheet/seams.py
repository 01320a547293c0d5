"""Seams between the gores of a dish: lines from an inner to an outer circle that wind between the targets.

Each is the cheapest way through a grid of places around its straight meridian, found row by row (dynamic programming): ink costs
far more than any detour, and a detour costs more than none. Neighbouring seams keep to places of their own, so none cross.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

# Distance of rows along the meridian, places in a row, how many places to either side the next row may go.
ROW_MM, PLACES, SIDESTEPS = 2.0, 41, 3
# A seam uses this part of the way to its neighbour.
ROOM = 0.45
# Free paper that is wanted between a seam and the ink.
CLEARANCE_MM = 1.5
# Costs: ink, each step to the side, and the square of the distance from the straight meridian in units of the room.
INK_COST, STEP_COST, DETOUR_COST = 1e4, 1.0, 1.0


@dataclass(frozen=True)
class Seams:
    """Seams of one zone: way_mm (R,) along the meridian, azimuth_rad (n, R) rising from seam to seam, crossed: targets that they cut."""

    way_mm: Array
    azimuth_rad: Array
    crossed: frozenset[int]


@dataclass(frozen=True)
class Ground:
    """What seams run through: targets at point_mm (N, 3) with ink up to reach_mm (N,), and the dish's radius and height over the way."""

    point_mm: Array
    reach_mm: Array
    focal_length_mm: float

    def points(self, radius: Array, azimuth: Array) -> Array:
        """Points (..., 3) of the dish."""
        return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), radius**2 / (4 * self.focal_length_mm) + 0 * azimuth], axis=-1)


def find_seams(ground: Ground, way_mm: Array, radius: Array, count: int, phase: float) -> Seams:
    """`count` seams over the rows way_mm (R,) at distances `radius` (R,) from the axis; the first leaves from azimuth `phase`."""
    offset = np.linspace(-ROOM, ROOM, PLACES) * 2 * np.pi / count
    straight = phase + 2 * np.pi * np.arange(count) / count
    azimuth = straight[:, None, None] + offset
    cost = DETOUR_COST * (offset / (ROOM * 2 * np.pi / count)) ** 2 + INK_COST * _inked(ground, ground.points(radius[:, None], azimuth))
    chosen = _cheapest(np.broadcast_to(cost, (count, len(way_mm), PLACES)))
    found = straight[:, None] + offset[chosen]
    points = ground.points(radius, found).reshape(-1, 3)
    near = cKDTree(points).query_ball_point(ground.point_mm, ground.reach_mm) if len(ground.point_mm) else []
    return Seams(way_mm, found, frozenset(k for k, hits in enumerate(near) if hits))


def _inked(ground: Ground, points: Array) -> Array:
    """How deep points (n, R, P, 3) lie in ink or its surroundings: 0 outside, above 1 within."""
    if not len(ground.point_mm):
        return np.zeros(points.shape[:-1])
    count = min(3, len(ground.point_mm))
    distance, index = cKDTree(ground.point_mm).query(points.reshape(-1, 3), k=list(range(1, count + 1)))
    free = (distance - ground.reach_mm[index]).min(axis=1).reshape(points.shape[:-1])
    return np.where(free < CLEARANCE_MM, 1 + np.maximum(CLEARANCE_MM - free, 0), 0.0)


def _cheapest(cost: Array) -> NDArray[np.int64]:
    """Place in each row (n, R) on the cheapest way through costs (n, R, P)."""
    seams, rows, places = cost.shape
    steps = np.arange(-SIDESTEPS, SIDESTEPS + 1)
    total, origin = cost[:, 0], np.zeros((rows, seams, places), dtype=np.int64)
    for row in range(1, rows):
        padded = np.pad(total, ((0, 0), (SIDESTEPS, SIDESTEPS)), constant_values=np.inf)
        ways = np.stack([padded[:, SIDESTEPS + s : SIDESTEPS + s + places] + STEP_COST * abs(s) for s in steps])
        best = ways.argmin(axis=0)
        origin[row] = np.arange(places) + steps[best]
        total = np.take_along_axis(ways, best[None], axis=0)[0] + cost[:, row]
    chosen = np.zeros((seams, rows), dtype=np.int64)
    chosen[:, -1] = total.argmin(axis=1)
    for row in range(rows - 1, 0, -1):
        chosen[:, row - 1] = origin[row, np.arange(seams), chosen[:, row]]
    return chosen
