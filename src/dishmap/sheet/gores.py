"""A paraboloid as pieces of flat paper: a cap around the vertex and zones of gores around it.

Paper laid on a dish must shrink along the edges of a piece, by about K t^2 / 2 at a distance t from a gore's middle line (K: Gauss's
curvature), and what is printed there with it. So pieces are kept small: each zone gets the fewest gores with which no target
shrinks by more than the limit anywhere in it. Zones part where a circle meets no target, and the seams between gores wind
between the targets. Where no such way is free, a target is printed whole on the piece that holds its centre, on a tab over the edge.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.errors import PatternError
from dishmap.sheet.flatten import AlongMeridian, AroundVertex
from dishmap.sheet.pieces import Piece, flat_piece, ink_places, strained_mm
from dishmap.sheet.ruled import with_lines
from dishmap.sheet.seams import CLEARANCE_MM, ROOM, ROW_MM, Ground, Seams, find_seams
from dishmap.sheet.shapes import Line
from dishmap.targets.flat import meridian_mm, radius_mm
from dishmap.targets.pattern import Pattern

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# A target may be printed larger than it will be on the surface by this part, unless another limit is given.
LARGEST_STRAIN = 0.002
# Gores of one zone: two would be halves of a ring; more than the last are slivers.
COUNTS = range(3, 361)
# How many more gores than the limit asks for are tried for seams that cut no target, and from how many first azimuths each.
MORE_GORES, PHASES = 3, (0.0, 0.5)
# Points along an edge that is an arc, and ticks across seams that match between neighbours: where, and how long.
ARC_STEP_MM, TICKS_AT, TICK_MM = 2.0, (0.25, 0.75), 3.0


@dataclass(frozen=True)
class _Dish:
    """The targets of a pattern in polar coordinates: way_mm (N,) from the vertex along the meridian, azimuth (N,), reach_mm (N,).

    These are of point_mm (N, 3), the middle of each target's own ink; strained_mm (N,): about it, where the strain counts.
    limit: of the strain; room_mm: width and height that a piece should not exceed.
    """

    pattern: Pattern
    focal_length_mm: float
    rim_mm: float
    way_mm: Array
    azimuth: Array
    reach_mm: Array
    point_mm: Array
    strained_mm: Array
    limit: float
    room_mm: tuple[float, float]

    def within(self, inner: float, outer: float) -> Index:
        """Targets with centres from one way to another."""
        return np.flatnonzero((self.way_mm >= inner) & (self.way_mm < outer))


@dataclass(frozen=True)
class _Zone:
    """A ring of gores from one way along the meridian to another; owner (n,): the gore that holds each target."""

    inner_mm: float
    outer_mm: float
    seams: Seams
    target: Index
    owner: Index


def dish_pieces(
    pattern: Pattern, largest_strain: float = LARGEST_STRAIN, room_mm: tuple[float, float] = (np.inf, np.inf)
) -> tuple[Piece, ...]:
    """Cap and gores for a pattern on a paraboloid, without pieces that hold no target.

    largest_strain: largest part by which any length in a target may be printed longer than it is on the surface; room_mm: width and
    height of paper into which pieces should fit, where circles free of targets allow it. Raises PatternError when a single target is
    already too large for the limit.
    """
    dish = _dish(pattern, largest_strain, room_mm)
    edges = _free_circles(dish)
    empty = max((edge for edge in edges if not len(dish.within(0, edge))), default=0.0)
    cap = max((edge for edge in edges if _cap_fits(dish, edge)), default=empty)
    pieces = [_cap(dish, cap)] if cap > 0 and len(dish.within(0, cap)) else []
    inner, number = cap, 0
    while inner < edges[-1]:
        number += 1
        zone = _next_zone(dish, inner, [edge for edge in edges if edge > inner])
        pieces += _gores(dish, zone, number)
        inner = zone.outer_mm
    return tuple(pieces)


def cut_targets(pieces: tuple[Piece, ...]) -> list[int]:
    """Indices of targets that reach over their piece's outline."""
    found = []
    for piece in pieces:
        if piece.outline_mm is not None:
            distance = np.linalg.norm(piece.keep_mm[:, None, :2] - piece.outline_mm[None], axis=-1).min(axis=1)
            found += [int(k) for k in piece.target[distance < piece.keep_mm[:, 2]]]
    return sorted(found)


def _dish(pattern: Pattern, limit: float, room_mm: tuple[float, float]) -> _Dish:
    focal = pattern.surface.focal_length_mm
    if focal is None:
        raise PatternError("gores are made of a paraboloid; this pattern's surface is a plane")
    point, reach = ink_places(pattern)
    strained = strained_mm(pattern)
    way = meridian_mm(np.hypot(*point[:, :2].T), focal)
    rim = float((way + reach).max()) + 2 * CLEARANCE_MM
    if pattern.surface.diameter_mm is not None:
        rim = max(rim - 2 * CLEARANCE_MM, float(meridian_mm(np.array(pattern.surface.diameter_mm / 2), focal)))
    # a target alone in the middle of its piece, at the vertex, where the curvature is largest
    least = float(1 - AlongMeridian(focal, 0.0).stretch(np.zeros((1, 2)), strained.max(keepdims=True))[0])
    if least > limit:
        raise PatternError(
            f"a target of radius {strained.max():.4g} mm shrinks by {least:.2%} when it is laid on a dish of focal length {focal:g} mm, "
            f"beyond the limit of {limit:.2%}: take smaller targets, or allow {100 * least:.2g} percent or more"
        )
    azimuth = np.arctan2(point[:, 1], point[:, 0])
    return _Dish(pattern, focal, rim, way, azimuth, reach, point, strained, limit, room_mm)


def _free_circles(dish: _Dish) -> list[float]:
    """Ways from the vertex at which a circle meets no target: before the first one, amid gaps, behind the last, and the rim.

    A circle cannot pass between the squares of a lattice, and lines may be cut, so that in a grid there is one every step.
    """
    low, high = dish.way_mm - dish.reach_mm, dish.way_mm + dish.reach_mm
    order = np.argsort(low)
    reached = np.maximum.accumulate(high[order])
    gap = low[order][1:] - reached[:-1]
    middle = (low[order][1:] + reached[:-1]) / 2
    first, last = float(low.min()) - 2 * CLEARANCE_MM, float(high.max()) + 2 * CLEARANCE_MM
    inner = [first, *(float(m) for m in middle[gap > 2 * CLEARANCE_MM]), last]
    if dish.pattern.is_grid:
        step = float(np.median(cKDTree(dish.pattern.center_mm).query(dish.pattern.center_mm, k=[2])[0]))
        inner = np.arange(step, last, step).tolist()
    return [*(edge for edge in inner if 0 < edge < dish.rim_mm), dish.rim_mm]


def _cap_fits(dish: _Dish, edge: float) -> bool:
    if 2 * edge > min(dish.room_mm):
        return False
    inside = dish.within(0, edge)
    flat = np.column_stack([dish.way_mm[inside], np.zeros(len(inside))])
    return bool((1 - AroundVertex(dish.focal_length_mm).stretch(flat, dish.strained_mm[inside]) <= dish.limit).all())


def _cap(dish: _Dish, edge: float) -> Piece:
    angle = np.linspace(0, 2 * np.pi, max(24, int(2 * np.pi * edge / ARC_STEP_MM)) + 1)
    outline = edge * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    note = "around the vertex, its tick at azimuth 0"
    tick = Line(np.array([[edge - TICK_MM, 0.0], [edge, 0.0]]))
    flat = AroundVertex(dish.focal_length_mm)
    piece = _with_extra(flat_piece("cap", dish.pattern, flat, dish.within(0, edge), outline, np.zeros(2), note), tick)
    return with_lines(piece, dish.pattern, flat.to_surface(outline))


def _next_zone(dish: _Dish, inner: float, edges: list[float]) -> _Zone:
    """The widest zone from `inner` on whose seams cut no target, or the narrowest with the fewest cut.

    Seams cut lines anyway, and orientation marks among them are few: there it is the widest with the fewest marks cut.
    """
    for outer in reversed(edges):
        least = _fewest(dish, inner, outer)
        found: list[_Zone] = []
        # seams that wind around marks make gores wider, and so there must be more of them
        more = max(MORE_GORES, least // 2) if dish.pattern.lines else MORE_GORES
        for count in range(least, least + more):
            if not _too_long(dish, inner, outer, count) and not _too_narrow(dish, dish.within(inner, outer), count):
                for zone in _zones(dish, inner, outer, count):
                    if not zone.seams.crossed:
                        return zone
                    found.append(zone)
        if dish.pattern.lines and found:
            return min(found, key=lambda zone: len(zone.seams.crossed))
    for count in range(_fewest(dish, inner, edges[0]), COUNTS[-1] + 1):
        zones = list(_zones(dish, inner, edges[0], count))
        if zones:
            return min(zones, key=lambda zone: len(zone.seams.crossed))
    raise PatternError(
        f"no number of gores up to {COUNTS[-1]} keeps the strain below {dish.limit:.2%}; allow more, or take smaller targets"
    )


def _zones(dish: _Dish, inner: float, outer: float, count: int) -> Iterator[_Zone]:
    """Zones with this number of gores within the limit."""
    target = dish.within(inner, outer)
    way = np.linspace(inner, outer, max(2, int(np.ceil((outer - inner) / ROW_MM)) + 1))
    ground = Ground(dish.point_mm[target], dish.reach_mm[target], dish.focal_length_mm)
    for phase in PHASES:
        seams = find_seams(ground, way, radius_mm(way, dish.focal_length_mm), count, phase * 2 * np.pi / count)
        zone = _Zone(inner, outer, seams, target, _owners(dish, target, seams))
        if _zone_strain(dish, zone) <= dish.limit:
            yield zone


def _too_narrow(dish: _Dish, target: Index, count: int) -> bool:
    """Whether a gore cannot hold the innermost target of its zone."""
    if not len(target):
        return False
    first = target[np.argmin(dish.way_mm[target])]
    return bool(2 * np.pi * radius_mm(dish.way_mm[first], dish.focal_length_mm) / count < 2 * dish.reach_mm[first])


def _too_long(dish: _Dish, inner: float, outer: float, count: int) -> bool:
    """Whether a gore is longer than the paper: its foot is an arc, whose ends lie lower than its middle."""
    return outer - inner * np.cos(np.pi / count) > dish.room_mm[1]


def _fewest(dish: _Dish, inner: float, outer: float) -> int:
    """The fewest gores with straight seams that can keep the limit and the paper's width, each about the middle of its targets."""
    target = dish.within(inner, outer)
    radius = radius_mm(dish.way_mm[target], dish.focal_length_mm)
    gauss = 1 / (4 * dish.focal_length_mm**2) / (1 + radius**2 / (4 * dish.focal_length_mm**2)) ** 2
    # a winding seam on either side may make a gore wider
    widest = 2 * np.pi * outer * (1 + ROOM)
    for count in COUNTS:
        if widest / count > dish.room_mm[0] and count < COUNTS[-1]:
            continue
        owner = np.floor(np.mod(dish.azimuth[target], 2 * np.pi) / (2 * np.pi) * count).astype(int)
        aside = radius * np.abs(np.sin(dish.azimuth[target] - _middles(dish.azimuth[target], owner, count)[owner]))
        # winding seams can do a little better than straight ones
        if (gauss * (aside + dish.strained_mm[target]) ** 2 / 2 <= 1.2 * dish.limit).all():
            return count
    return COUNTS[-1]


def _middles(azimuth: Array, owner: Index, count: int) -> Array:
    """Azimuth (count,) half way between the outermost targets of each gore; the gore's own middle where it has none."""
    middle = 2 * np.pi * (np.arange(count) + 0.5) / count
    turn = np.angle(np.exp(1j * (azimuth - middle[owner])))
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, owner, turn)
    np.maximum.at(high, owner, turn)
    held = np.isfinite(low)
    return np.asarray(middle + np.where(held, low, 0.0) / 2 + np.where(held, high, 0.0) / 2)


def _owners(dish: _Dish, target: Index, seams: Seams) -> Index:
    """The gore (n,) between whose seams each target's centre lies; gore k lies from seam k to the next."""
    count = len(seams.azimuth_rad)
    at = np.stack([np.interp(dish.way_mm[target], seams.way_mm, row) for row in seams.azimuth_rad])
    turn = np.mod(dish.azimuth[target] - at, 2 * np.pi)
    return np.asarray(turn.argmin(axis=0)) % count


def _zone_maps(dish: _Dish, zone: _Zone) -> list[AlongMeridian]:
    count = len(zone.seams.azimuth_rad)
    middle = zone.seams.azimuth_rad.mean(axis=1) + np.pi / count
    turn = np.angle(np.exp(1j * (dish.azimuth[zone.target] - middle[zone.owner])))
    maps = []
    for k in range(count):
        own = turn[zone.owner == k]
        maps.append(AlongMeridian(dish.focal_length_mm, float(middle[k] + ((own.min() + own.max()) / 2 if len(own) else 0.0))))
    return maps


def _zone_strain(dish: _Dish, zone: _Zone) -> float:
    """Largest strain in a target of the zone: all are turned to the meridian of azimuth 0, to be mapped at once."""
    if not len(zone.target):
        return 0.0
    middle = np.array([flat.azimuth_rad for flat in _zone_maps(dish, zone)])[zone.owner]
    radius, turn = radius_mm(dish.way_mm[zone.target], dish.focal_length_mm), dish.azimuth[zone.target] - middle
    flat = AlongMeridian(dish.focal_length_mm, 0.0)
    at = flat.to_flat(radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1))
    return float(np.abs(1 - flat.stretch(at, dish.strained_mm[zone.target])).max())


def _gores(dish: _Dish, zone: _Zone, number: int) -> list[Piece]:
    """The pieces of a zone, named by zone and gore, counter-clockwise from the x axis."""
    count = len(zone.seams.azimuth_rad)
    pieces = []
    for k, flat in enumerate(_zone_maps(dish, zone)):
        own = zone.target[zone.owner == k]
        if not len(own) and not dish.pattern.lines:
            continue
        here, following = zone.seams.azimuth_rad[k], zone.seams.azimuth_rad[(k + 1) % count] + 2 * np.pi * (k + 1 == count)
        ground = _around(dish, zone, here, following)
        outline = flat.to_flat(ground)
        degrees = np.degrees(flat.azimuth_rad) % 360
        note = f"middle line at azimuth {degrees:.3f} degrees, from {zone.inner_mm:.2f} to {zone.outer_mm:.2f} mm along the surface"
        anchor = np.array([0.0, (zone.inner_mm + zone.outer_mm) / 2])
        piece = flat_piece(f"gore {number}.{k + 1:02d}", dish.pattern, flat, own, outline, anchor, note)
        piece = _with_extra(piece, *_ticks(dish, zone, flat, (here, following)))
        pieces.append(with_lines(piece, dish.pattern, ground))
    return pieces


def _around(dish: _Dish, zone: _Zone, here: Array, following: Array) -> Array:
    """The outline of a gore on the dish, seen along the axis (m, 2), closed."""
    way, inner, outer = zone.seams.way_mm, zone.inner_mm, zone.outer_mm
    top = np.linspace(here[-1], following[-1], max(2, int(outer * (following[-1] - here[-1]) / ARC_STEP_MM)))
    foot = np.linspace(following[0], here[0], max(2, int(inner * (following[0] - here[0]) / ARC_STEP_MM)))
    ways = np.concatenate([way, np.full(len(top), outer), way[::-1], np.full(len(foot), inner)])
    azimuth = np.concatenate([here, top, following[::-1], foot])
    radius = radius_mm(ways, dish.focal_length_mm)
    return radius[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)


def _ticks(dish: _Dish, zone: _Zone, flat: AlongMeridian, sides: tuple[Array, Array]) -> list[Line]:
    """The ends of the middle line, and short lines across both seams that match those of the neighbours."""
    ends = ((zone.inner_mm, zone.inner_mm + TICK_MM), (zone.outer_mm - TICK_MM, zone.outer_mm))
    lines = [Line(np.array([[0.0, a], [0.0, b]])) for a, b in ends]
    way = zone.inner_mm + np.array(TICKS_AT) * (zone.outer_mm - zone.inner_mm)
    radius = radius_mm(way, dish.focal_length_mm)
    for seam, inwards in zip(sides, (1, -1), strict=True):
        on_seam = np.interp(way, zone.seams.way_mm, seam)
        azimuth = np.stack([on_seam, on_seam + inwards * TICK_MM / np.maximum(radius, TICK_MM)], axis=1)
        points = flat.to_flat((radius[:, None, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)).reshape(-1, 2))
        lines += [Line(pair) for pair in points.reshape(-1, 2, 2)]
    return lines


def _with_extra(piece: Piece, *lines: Line) -> Piece:
    """The piece with lines added, but for those that would touch a target."""
    free = [line for line in lines if not _touches(line, piece.keep_mm)]
    return replace(piece, extra=(*piece.extra, *free))


def _touches(line: Line, keep: Array) -> bool:
    points = np.linspace(line.points_mm[0], line.points_mm[-1], 7)
    return bool((np.linalg.norm(points[:, None] - keep[:, :2], axis=-1) < keep[:, 2] + line.width_mm).any())
