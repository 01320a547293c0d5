"""The ink of a grid's lines in the image, as closed curves with exact coverage: `line_curves`.

Coverage of a union of lines is the sum of the lines' coverages less that of the places where two of them cross. Both are regions
bounded by pieces of the same edges: a strip by its two edges and its ends; a crossing by the edges of either line, or by an end that
lies within the other line. So the union is exact as long as no three lines, and no end and edge of one crossing, meet in a point.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.simulate.contour import panel_nodes, reach_px, smooth_pieces
from dishmap.simulate.forward import line_facing, line_points
from dishmap.simulate.scene import Scene
from dishmap.targets.gridlines import GridLines

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Half a step of the lattice is one piece of an edge, and is looked at in so many places for whether it is seen.
PIECE_STEPS = 0.5
LOOKS = 4
# Halvings of where a line passes out of sight: 1e-9 of a step.
HALVINGS = 28
# Newton's steps to the corner of a crossing, whose sides are nearly straight, and the step of its derivatives.
CORNER_STEPS = 6
CORNER_STEP = 1e-5
# Places along either line, over half a step to both sides of a crossing, where its ink is looked for.
INK_LOOKS = 16


@dataclass(frozen=True)
class _Stretch:
    """A piece of a line that has ink and is seen: from start_t to stop_t; width_mm as printed, ink spread included."""

    line: int
    start_t: float
    stop_t: float
    width_mm: float


@dataclass(frozen=True)
class _Side:
    """A straight way in the coordinates (t, across) of a line, from one (2,) to another."""

    line: int
    start: tuple[float, float]
    stop: tuple[float, float]


def line_curves(scene: Scene) -> tuple[Array, Array]:
    """Samples (K, 2) in the image of the outlines of all lines' ink, and the changes of v (K,) they stand for, for `add_curve`."""
    lines = GridLines(scene.pattern)
    stretches = _stretches(scene, lines)
    loops = [_strip(one) for one in stretches]
    count = len(loops)
    loops += _crossings(lines, stretches)
    if not loops:
        return np.zeros((0, 2)), np.zeros(0)
    pieces, loop = _pieces(lines, loops)
    points, dv, piece = smooth_pieces(scene.camera.project(line_points(scene, lines, *pieces)), scene.sensor.psf_sigma_px)
    owner = loop[piece]
    # areas about each loop's own first sample, for the sake of digits
    first = np.zeros((len(loops), 2))
    first[owner[::-1]] = points[::-1]
    area = np.bincount(owner, (points[:, 0] - first[owner, 0]) * dv, len(loops))
    sign = np.sign(area) * np.where(np.arange(len(loops)) < count, 1.0, -1.0)
    return points, sign[owner] * dv


def crossing_ink(scene: Scene) -> tuple[Array, Flags]:
    """Where the ink of each crossing lies in the image: places (N, 2 INK_LOOKS, 2) in px, and which of them are printed and seen.

    They are the middles of equal parts of both lines within half a step of the lattice, as far as the unbroken lines reach.
    """
    lines = GridLines(scene.pattern)
    offset = (np.arange(INK_LOOKS) + 0.5) / INK_LOOKS - 0.5
    line = np.repeat(lines.crossing_line, INK_LOOKS, axis=1)
    low = np.maximum(lines.crossing_t - 0.5, lines.start_t[lines.crossing_line])[..., None]
    high = np.minimum(lines.crossing_t + 0.5, lines.stop_t[lines.crossing_line])[..., None]
    t = (0.5 * (low + high) + offset * (high - low)).reshape(line.shape)
    px = scene.camera.project(line_points(scene, lines, line, t))
    seen = line_facing(scene, lines, line.ravel(), t.ravel()).reshape(line.shape) & np.isfinite(px).all(axis=-1)
    for gap in scene.line_gaps:
        seen &= ~((line == gap.line) & (t > gap.start_t) & (t < gap.stop_t))
    return px, seen


def _stretches(scene: Scene, lines: GridLines) -> list[_Stretch]:
    """What is printed and seen of every line."""
    line, start, stop = (np.array(x) for x in zip(*_printed(scene, lines), strict=True))
    count = np.maximum(2, np.ceil((stop - start) / PIECE_STEPS * LOOKS).astype(np.int64) + 1)
    first = np.cumsum(count) - count
    part = (np.arange(count.sum()) - np.repeat(first, count)) / np.repeat(count - 1, count)
    t = np.repeat(start, count) + part * np.repeat(stop - start, count)
    seen = _seen(scene, lines, np.repeat(line, count), t)
    change = np.flatnonzero((seen[1:] != seen[:-1]) & (part[1:] > 0))
    low, high, on = t[change], t[change + 1], np.repeat(line, count)[change]
    for _ in range(HALVINGS if len(change) else 0):
        middle = 0.5 * (low + high)
        same = _seen(scene, lines, on, middle) == seen[change]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    # the side that is seen of each place where a line passes out of sight, and ends that are seen
    edge = np.where(seen[change], low, high)
    found = []
    for k, number in enumerate(line.tolist()):
        own = edge[(change >= first[k]) & (change < first[k] + count[k])].tolist()
        ends = [*([start[k]] if seen[first[k]] else []), *own, *([stop[k]] if seen[first[k] + count[k] - 1] else [])]
        width = scene.pattern.lines[number].width_mm + 2 * scene.ink_spread_mm
        found += [_Stretch(number, float(a), float(b), width) for a, b in zip(ends[::2], ends[1::2], strict=True)]
    return found


def _printed(scene: Scene, lines: GridLines) -> list[tuple[int, float, float]]:
    """Line, start_t and stop_t of all printed pieces of lines: gaps taken out, ends and gaps moved by the ink's spread."""
    found = []
    for number in range(len(scene.pattern.lines)):
        ends = np.array([lines.start_t[number], lines.stop_t[number]])
        spread = scene.ink_spread_mm / np.linalg.norm(lines.tangent_mm(number, ends), axis=-1)
        pieces = [(float(ends[0] - spread[0]), float(ends[1] + spread[1]))]
        for gap in (gap for gap in scene.line_gaps if gap.line == number):
            low, high = gap.start_t + spread.mean(), gap.stop_t - spread.mean()
            if high > low:
                pieces = [(a, b) for start, stop in pieces for a, b in ((start, min(stop, low)), (max(start, high), stop)) if b > a]
        found += [(number, *piece) for piece in pieces]
    return found


def _seen(scene: Scene, lines: GridLines, line: NDArray[np.int64], t: Array) -> Flags:
    """Which places (K,) of lines face the camera and are imaged, not farther outside the image than a step of the lattice."""
    half = lines.width_mm[line] / 2 + max(scene.ink_spread_mm, 0.0)
    px = scene.camera.project(line_points(scene, lines, line[:, None], t[:, None], half[:, None] * np.array([-1.0, 0.0, 1.0])))
    with np.errstate(invalid="ignore"):
        step = scene.camera.project(line_points(scene, lines, line, t + 1)) - px[:, 1]
        room = reach_px(scene.sensor.psf_sigma_px) + np.nan_to_num(np.linalg.norm(step, axis=-1), nan=0.0)[:, None]
        size = np.array([scene.camera.width_px, scene.camera.height_px])
        near = ((px.max(axis=1) > -room) & (px.min(axis=1) < size - 1 + room)).all(axis=-1)
    return line_facing(scene, lines, line, t) & near & np.isfinite(px).all(axis=(1, 2))


def _strip(one: _Stretch) -> list[_Side]:
    """The outline of a stretch: one edge, the end, back along the other edge, and the first end."""
    half = one.width_mm / 2
    corners = [(one.start_t, -half), (one.stop_t, -half), (one.stop_t, half), (one.start_t, half)]
    return [_Side(one.line, a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]


def _crossings(lines: GridLines, stretches: Iterable[_Stretch]) -> list[list[_Side]]:
    """Outlines of the places where two lines' ink lies on top of each other."""
    of_line: dict[int, list[_Stretch]] = {}
    for one in stretches:
        of_line.setdefault(one.line, []).append(one)
    pairs = [
        (target, one, other)
        for target, (a, b) in enumerate(lines.crossing_line.tolist())
        for one, other in itertools.product(of_line.get(a, ()), of_line.get(b, ()))
    ]
    if not pairs:
        return []
    target = np.array([target for target, _, _ in pairs])
    line, at = lines.crossing_line[target], lines.crossing_t[target]
    half = 0.5 * np.array([(one.width_mm, other.width_mm) for _, one, other in pairs])
    ends = np.array([[(one.start_t, one.stop_t), (other.start_t, other.stop_t)] for _, one, other in pairs])
    along = lines.tangent_mm(line, at)
    cross = np.cross(along[:, 0], along[:, 1])
    # each line's way, in its own t, from the middle of the crossing to the other line's edge
    room = half[:, ::-1] * np.linalg.norm(along, axis=-1)[:, ::-1] / np.linalg.norm(cross, axis=-1)[:, None]
    kept = ((ends[..., 0] < at + room) & (ends[..., 1] > at - room)).all(axis=1)
    turn = np.sign((cross * lines.pattern.normal[target]).sum(axis=1))
    place, cut = _corners(at[kept], half[kept], turn[kept], ends[kept], room[kept])
    place = _meet(lines, line[kept], place, cut)
    return [_outline(*one) for one in zip(line[kept].tolist(), place, cut, strict=True)]


def _corners(at: Array, half: Array, turn: Array, ends: Array, room: Array) -> tuple[Array, Flags]:
    """About where the corners of M crossings lie: (t, across) on the first line, then on the second (M, 4, 4); and how sides are bounded.

    A crossing has four sides, where the first line begins and ends to be on the second, and the other way round. Such a side
    lies at an edge of the other line, or is `cut` (M, 4 corners, 2 lines): the line itself ends there. turn (M,): 1 where the second
    line runs to the left of the first, else -1.
    """
    place = np.zeros((len(at), 4, 4))
    cut = np.zeros((len(at), 4, 2), dtype=bool)
    for corner, highs in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
        for me, high in enumerate(highs):
            other, sign, left = 1 - me, 2 * high - 1, (-turn, turn)[me]
            edge, end = at[:, me] + sign * room[:, me], ends[:, me, high]
            ended = end * sign < edge * sign
            place[:, corner, 2 * me] = np.where(ended, end, edge)
            place[:, corner, 2 * other + 1] = left * half[:, other] * np.where(ended, (end - at[:, me]) / room[:, me], sign)
            cut[:, corner, me] = ended
    return place, cut


def _meet(lines: GridLines, line: NDArray[np.int64], place: Array, cut: Flags) -> Array:
    """Corners (M, 4, 4) by Newton's method: their places on both lines are one point.

    Two of the four coordinates are held: for each of the lines its t where it is cut, else across on the other line.
    """
    place = place.copy()
    free = np.stack([np.where(cut[..., 0], 3, 0), np.where(cut[..., 1], 1, 2)], axis=-1)
    first, second = line[:, None, 0], line[:, None, 1]

    def apart(p: Array) -> Array:
        return lines.points_mm(first, p[..., 0], p[..., 1]) - lines.points_mm(second, p[..., 2], p[..., 3])

    for _ in range(CORNER_STEPS):
        moves = CORNER_STEP * np.eye(4)[free]
        columns = [(apart(place + move) - apart(place - move)) / (2 * CORNER_STEP) for move in np.moveaxis(moves, -2, 0)]
        jacobian = np.stack(columns, axis=-1)
        normal = np.swapaxes(jacobian, -1, -2) @ jacobian
        step = np.linalg.solve(normal, np.swapaxes(jacobian, -1, -2) @ apart(place)[..., None])[..., 0]
        np.put_along_axis(place, free, np.take_along_axis(place, free, axis=-1) - step, axis=-1)
    return place


def _outline(line: list[int], place: Array, cut: Flags) -> list[_Side]:
    """The four sides between a crossing's corners (4, 4): along the line at whose edge a side lies, or across the one that is cut."""
    sides = []
    for corner, bounded in enumerate((1, 0, 1, 0)):
        on = bounded if cut[corner, bounded] else 1 - bounded
        start, stop = place[corner, 2 * on : 2 * on + 2].tolist(), place[(corner + 1) % 4, 2 * on : 2 * on + 2].tolist()
        sides.append(_Side(line[on], (start[0], start[1]), (stop[0], stop[1])))
    return sides


def _pieces(lines: GridLines, loops: list[list[_Side]]) -> tuple[tuple[NDArray[np.int64], Array, Array], NDArray[np.int64]]:
    """Line, t and across (P, PANEL_NODES) of the sides of loops, cut at every half step of the lattice, and the loop (P,) of each piece."""
    starts, stops, line, loop = [], [], [], []
    for number, sides in enumerate(loops):
        for side in sides:
            low, high = sorted((side.start[0], side.stop[0]))
            inner = np.arange(np.floor(low / PIECE_STEPS) + 1, np.ceil(high / PIECE_STEPS)) * PIECE_STEPS
            part = np.concatenate([[0.0], (inner - low) / (high - low), [1.0]]) if len(inner) else np.array([0.0, 1.0])
            if side.start[0] > side.stop[0]:
                part = 1 - part[::-1]
            way = np.array(side.start) + part[:, None] * (np.array(side.stop) - np.array(side.start))
            starts.append(way[:-1])
            stops.append(way[1:])
            line += [side.line] * (len(way) - 1)
            loop += [number] * (len(way) - 1)
    start, stop = np.concatenate(starts), np.concatenate(stops)
    at = start[:, None] + panel_nodes()[:, None] * (stop - start)[:, None]
    return (np.broadcast_to(np.array(line)[:, None], at.shape[:2]), at[..., 0], at[..., 1]), np.array(loop)
