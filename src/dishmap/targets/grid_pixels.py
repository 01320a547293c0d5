"""The pixels along the edges at each node of a grid, and the model of what they show: two bands of ink under one blur.

Each pixel is carried through the lattice map: its coordinate across each band, and pixels per lattice unit there. An edge is where the
coordinate has a given value; its distance follows along the gradient, to second order, and an edge that bends is seen shifted by half its
curvature times the blur squared (both as in `targets.edges`). Pixels are chosen in strips along the edges, by blocks of 2x2 neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.edges import monomials
from dishmap.targets.grid_shapes import CELL, NodeShapes
from dishmap.targets.lattice_map import BY_FIRST, BY_SECOND, DEGREE, LatticeMaps
from dishmap.targets.window import gather, places_of

Array = NDArray[Any]
# float32: enough for pixels
Single = NDArray[Any]
Bool = NDArray[Any]

# A strip longer or wider than this belongs to a node that went astray.
LONGEST_STRIP_PX, WIDEST_STRIP_PX = 600, 400
# Offsets of the four pixels of a block, across and along a strip.
ROW, COLUMN = (0, 1, 0, 1), (0, 0, 1, 1)


@dataclass(frozen=True)
class Strip:
    """Pixels to look at for n nodes: around the level line `level` (n,) of band `band`, from `start` to `end` (n,) along it.

    half (n,): lattice units to each side that belong to the strip, besides the reach of the blur in pixels.
    """

    band: int
    level: Array
    start: Array
    end: Array
    half: Array


@dataclass(frozen=True)
class NodePixels:
    """Pixels of n nodes, padded to the longest (n, P).

    across (2, n, P): coordinate across each band, which is the one along the other; scale (2, n, P): pixels per lattice unit across it;
    s, t: pixel offsets over `unit_px` (n,); grey; expected: near an edge; used: expected, inside the image, not at the end of the scale and
    clear of other ink; saturated (n,): share of the expected ones; middle_out (n,): the node's own place is not inside the image.
    skew (n, P): cosine between the gradients of both coordinates; bend (2, 2, n, 1): half the second derivative along the gradient over
    the first, at the lower and the upper edge of each band; curve: curvature of the level lines there (1/px).
    """

    across: Single
    scale: Single
    s: Single
    t: Single
    unit_px: Array
    grey: Single
    expected: Bool
    used: Bool
    saturated: Array
    skew: Single
    bend: Single
    curve: Single

    def take(self, rows: Bool) -> NodePixels:
        """The pixels of some nodes."""
        last = {"across": 1, "scale": 1, "bend": 2, "curve": 2}
        return NodePixels(*(np.compress(rows, getattr(self, name), last.get(name, 0)) for name in self.__dataclass_fields__))


def strips_of(shapes: NodeShapes, half: Array, maps: LatticeMaps, reach_px: float) -> list[Strip]:
    """The strips of n nodes: the bands themselves for lines, their edges for rectangles (and those of the light one inside)."""
    count = len(half)
    step = np.linalg.norm(maps.step_px, axis=1)
    if shapes.crossing:
        none = np.zeros(count)
        return [Strip(k, none, -shapes.arms[:, k, 0], shapes.arms[:, k, 1], half[:, k]) for k in (0, 1)]
    out = []
    for size in (half, shapes.inner):
        if not size.any():
            continue
        for k in (0, 1):
            # along band 0 runs the coordinate that band 1 is across
            end = np.minimum(size[:, 1 - k] + reach_px / step[:, k], CELL) * (size[:, k] > 0)
            out += [Strip(k, sign * size[:, k], -end, end, np.zeros(count)) for sign in (-1.0, 1.0)]
    return out


def node_pixels(image: NDArray[Any], maps: LatticeMaps, shapes: NodeShapes, half: Array, reach_px: float, every: int = 1) -> NodePixels:
    """Pixels of n nodes within `reach_px` of edges; half (n, 2): half widths in lattice units; every: all pixels, or each 4th or 8th."""
    strips = strips_of(shapes, half, maps, reach_px)
    places = [_strip_places(maps, strip, reach_px, every) for strip in strips]
    u, v, listed = (np.concatenate([place[i] for place in places], axis=1) for i in (0, 1, 2))
    scale = maps.scale_px[:, None]
    s, t = ((x - maps.origin_px[:, i : i + 1]) / scale for i, x in ((0, u), (1, v)))
    s, t = s.astype(np.float32), t.astype(np.float32)
    across, per_unit, skew = _lattice_of(maps, s, t)
    expected = _chosen(strips, [place[0].shape[1] for place in places], across, per_unit, reach_px) & listed
    if shapes.crossing and np.isfinite(shapes.boxes).any():
        expected &= ~_in_boxes(shapes.boxes, across, per_unit, reach_px)
    grey, inside, full = gather(image, u, v)
    bend, curve = _shape_at_edges(maps, half)
    share = (expected & full & inside).sum(axis=1) / np.maximum(expected.sum(axis=1), 1)
    return NodePixels(across, per_unit, s, t, maps.scale_px, grey, expected, expected & inside & ~full, share, skew, bend, curve)


def _strip_places(maps: LatticeMaps, strip: Strip, reach_px: float, every: int) -> tuple[NDArray[np.int32], NDArray[np.int32], Bool]:
    """Pixels u, v (n, P) that hold the strip, block by block of 2x2 neighbours, and which are no padding.

    every: 4 or 8 for one pixel of each block, or of each second.
    """
    along = np.stack([strip.start, 0.5 * (strip.start + strip.end), strip.end], axis=1)
    level = np.broadcast_to(strip.level[:, None], along.shape)
    ab = np.stack([along, level] if strip.band == 0 else [level, along], axis=-1)
    points = maps.place_px(ab)
    chord = points[:, 2] - points[:, 0]
    steep = np.abs(chord[:, 1]) > np.abs(chord[:, 0])
    # the parabola minor(major) through three points of the level line
    major, minor = np.where(steep[:, None], points[..., 1], points[..., 0]), np.where(steep[:, None], points[..., 0], points[..., 1])
    first, last = np.floor(major.min(axis=1)), np.ceil(major.max(axis=1))
    gap = np.maximum(np.abs(major[:, 2] - major[:, 0]), 1e-3) * np.where(major[:, 2] < major[:, 0], -1, 1)
    slope = (minor[:, 2] - minor[:, 0]) / gap
    sag = minor[:, 1] - minor[:, 0] - slope * (major[:, 1] - major[:, 0])
    lean = np.sqrt(1 + (np.abs(slope) + 4 * np.abs(sag / gap)) ** 2)
    across = np.linalg.norm(maps.step_px[:, :, 1 - strip.band], axis=1)
    thick = (1.1 * strip.half * across + reach_px) * lean + 0.5 * np.abs(slope)
    length = 2 * int(np.ceil(0.5 * (min(float((last - first).max()), LONGEST_STRIP_PX) + 1)))
    width = 2 * int(np.ceil(min(float(thick.max()), WIDEST_STRIP_PX)))
    pair = first[:, None] + np.arange(0, length, 4 if every == 8 else 2)
    x = (pair + 0.5 - major[:, :1]) / gap[:, None]
    middle = minor[:, :1] + slope[:, None] * (pair + 0.5 - major[:, :1]) + 4 * sag[:, None] * x * (1 - x)
    low, pair = np.round(middle - 0.5 * (width - 1)).astype(np.int32), pair.astype(np.int32)
    # corners of blocks of 2x2 (n, pairs along, pairs across), and those of them that may hold pixels of the strip
    one = low[..., None] + np.arange(0, width, 2, dtype=np.int32)
    near = (np.abs(one + 0.5 - middle[..., None]) < thick[:, None, None] + 0.5) & (pair <= last[:, None])[..., None]
    two = np.broadcast_to(pair[..., None], one.shape)
    if every > 1:
        # pixels of odd and even lines in turn, so that an edge along a line of pixels is not missed
        one = one + (np.arange(pair.shape[1], dtype=np.int32) % 2)[:, None]
    block, used = places_of(near.reshape(len(first), -1))
    one, two = (np.take_along_axis(x.reshape(len(first), -1), block, axis=1) for x in (one, two))
    if every == 1:
        square = (*one.shape, 4)
        one = np.broadcast_to(one[..., None] + np.array(ROW, np.int32), square).reshape(len(first), -1)
        two = np.broadcast_to(two[..., None] + np.array(COLUMN, np.int32), square).reshape(len(first), -1)
        used = np.repeat(used, 4, axis=1)
    return np.where(steep[:, None], one, two), np.where(steep[:, None], two, one), used


def _lattice_of(maps: LatticeMaps, s: Single, t: Single) -> tuple[Single, Single, Single]:
    """Coordinates across the bands (2, n, P), pixels per lattice unit across them, and the cosine (n, P) between their gradients."""
    # band 0 is across b
    coefficients = maps.inverse[:, ::-1]
    scale = maps.scale_px[:, None, None]
    six = np.concatenate([coefficients, coefficients @ BY_FIRST / scale, coefficients @ BY_SECOND / scale], axis=1)
    values = six.astype(np.float32) @ monomials(s, t, DEGREE)
    by_u, by_v = values[:, 2:4], values[:, 4:6]
    skew = by_u[:, 0] * by_u[:, 1]
    skew += by_v[:, 0] * by_v[:, 1]
    by_u *= by_u
    by_v *= by_v
    by_u += by_v
    np.maximum(by_u, np.float32(1e-12), out=by_u)
    np.sqrt(by_u, out=by_u)
    scale_px = np.empty((2, *s.shape), np.float32)
    np.divide(1, np.moveaxis(by_u, 1, 0), out=scale_px)
    skew *= scale_px[0]
    skew *= scale_px[1]
    return np.ascontiguousarray(np.moveaxis(values[:, :2], 1, 0)), scale_px, skew


def _chosen(strips: list[Strip], lengths: list[int], across: Single, scale: Single, reach_px: float) -> Bool:
    """Which pixels (n, P) lie in the strip that they were listed for, and in none before it."""
    out = np.empty(across.shape[1:], bool)
    end = 0
    for number, (strip, length) in enumerate(zip(strips, lengths, strict=True)):
        part = slice(end, end + length)
        end += length
        own = (np.abs(across[:, :, part]) < CELL).all(axis=0)
        own &= _in_strip(strip, across[:, :, part], scale[:, :, part], reach_px)
        for before in strips[:number]:
            own &= ~_in_strip(before, across[:, :, part], scale[:, :, part], reach_px)
        out[:, part] = own
    return out


def _in_strip(strip: Strip, across: Single, scale: Single, reach_px: float) -> Bool:
    level, half, start, end = (x[:, None].astype(np.float32) for x in (strip.level, strip.half, strip.start, strip.end))
    away = (np.abs(across[strip.band] - level) - half) * scale[strip.band]
    along = across[1 - strip.band]
    return np.asarray((away < np.float32(reach_px)) & (along >= start) & (along <= end))


def _in_boxes(boxes: Array, across: Single, scale: Single, reach_px: float) -> Bool:
    out = np.zeros(across.shape[1:], bool)
    margin = np.float32(reach_px) / scale
    for a_low, a_high, b_low, b_high in np.moveaxis(boxes.astype(np.float32), 0, 2)[..., None]:
        a, b = across[1], across[0]
        # a comparison with NaN, for no box, is false
        out |= (a > a_low - margin[1]) & (a < a_high + margin[1]) & (b > b_low - margin[0]) & (b < b_high + margin[0])
    return out


def _shape_at_edges(maps: LatticeMaps, half: Array) -> tuple[Single, Single]:
    """Bend and curvature (2, 2, n, 1) of the level lines at the middles of both bands' edges."""
    inverse, scale = maps.inverse[:, ::-1], maps.scale_px[:, None, None]
    ab = np.zeros((len(half), 4, 2))
    for k in (0, 1):
        # band 0 is across b
        ab[:, [2 * k, 2 * k + 1], 1 - k] = half[:, k : k + 1] * [-1.0, 1.0]
    st = (maps.place_px(ab) - maps.origin_px[:, None]) / scale
    basis = monomials(st[..., 0], st[..., 1], DEGREE)
    by_u, by_v = inverse @ BY_FIRST / scale, inverse @ BY_SECOND / scale
    gu, gv = by_u @ basis, by_v @ basis
    uu, uv, vv = (d @ basis / scale for d in (by_u @ BY_FIRST, by_u @ BY_SECOND, by_v @ BY_SECOND))
    length = np.maximum(np.hypot(gu, gv), 1e-12)
    nu, nv = gu / length, gv / length
    along = (uu * nu * nu + 2 * uv * nu * nv + vv * nv * nv) / length
    curve = (uu + vv) / length - along

    def at_edges(values: Array) -> Single:
        own = np.stack([values[:, k, 2 * k : 2 * k + 2].T for k in (0, 1)])
        return np.asarray(own[..., None], np.float32)

    return at_edges(0.5 * along), at_edges(curve)
