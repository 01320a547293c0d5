"""Choosing the pixels of the photograph that carry a target's edges."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.targets.edges import SMALLEST_SLOPE, LocalMaps, Patches, Poses, plane_at_offsets
from dishmap.targets.pattern import TargetKind, bent_print_mm
from dishmap.targets.pixels import BAND_BLURS, BAND_EXTRA_PX, LARGEST_CURVED, RingPixels, Rings, batches, rings_of

Array = NDArray[Any]
Index = NDArray[np.int64]

OUTLINE_POINTS = 16
# The blur of one ring must not reach the next: this many blurs of ground between them, else they are modelled together.
RING_GAP_BLURS = 5.0
# A ring's window is at most this wide; larger targets use fewer of their pixels (every k-th). Rings that need the fine grid are
# smaller by their nature, unless a fit has gone astray.
LARGEST_WINDOW_PX, LARGEST_FINE_PX = 400, 200


def outline(camera: Camera, poses: Poses, curvature_per_mm: Array, center_mm: Array, radius_mm: Array) -> Array:
    """Pixels (T, C, Q, 2) on the projected outlines of circles (C, 2), (C,) of T targets."""
    angle = 2 * np.pi * np.arange(OUTLINE_POINTS) / OUTLINE_POINTS
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    xy = center_mm[:, None] + radius_mm[:, None, None] * circle
    local = bent_print_mm(np.broadcast_to(xy.reshape(-1, 2), (len(poses), xy.size // 2, 2)), curvature_per_mm)
    pixels = camera.project(poses.in_camera(local))
    return pixels.reshape(len(poses), len(radius_mm), OUTLINE_POINTS, 2)


def minor_radius_px(outlines: Array) -> Array:
    """Least distance (T, C) from the middle of projected circles to their outlines (T, C, Q, 2): the minor semi-axis."""
    return np.asarray(np.linalg.norm(outlines - outlines.mean(axis=2, keepdims=True), axis=3).min(axis=2))


def sharpest_curvature_per_px(outlines: Array) -> Array:
    """Largest curvature (T, C) of projected circles from their outlines: a / b^2 of the ellipse through them."""
    centered = outlines - outlines.mean(axis=2, keepdims=True)
    scatter = np.swapaxes(centered, 2, 3) @ centered * (2 / OUTLINE_POINTS)
    squares = np.linalg.eigvalsh(np.nan_to_num(scatter, nan=1.0))
    return np.asarray(np.sqrt(squares[..., 1]) / np.maximum(squares[..., 0], 1e-6))


def ring_layout(kind: TargetKind, outlines: Array, scale_px_per_mm: Array, blur_px: float) -> tuple[Rings, list[list[int]], bool]:
    """The rings of a kind as they must be modelled at this blur, the outermost circles in each, and whether they need the fine grid."""
    together = kind.gap_mm * float(np.min(scale_px_per_mm)) < RING_GAP_BLURS * blur_px
    fine = float(np.max(sharpest_curvature_per_px(outlines))) * blur_px > LARGEST_CURVED
    outer = [int(i) for i in np.flatnonzero(kind.parent < 0)]
    return rings_of(kind, together), [outer] if together else [[i] for i in outer], fine


def patches_around(camera: Camera, poses: Poses, curvature_per_mm: Array, areas: tuple[Array, Array], blur_px: float) -> Patches:
    """Patches that hold areas (R, 2) centres and (R,) radii in mm of each of T targets, and the band around them.

    Their order is target by target; anchors are whole pixels.
    """
    center, radius = areas
    count = len(poses)
    ends = outline(camera, poses, curvature_per_mm, center, radius)
    middle = np.nan_to_num(ends.mean(axis=2)).reshape(-1, 2)
    half = np.linalg.norm(ends - ends.mean(axis=2, keepdims=True), axis=3)
    band = BAND_BLURS * blur_px + BAND_EXTRA_PX + 2.0
    narrow = np.maximum(np.nan_to_num(half.min(axis=2), nan=1.0).reshape(-1), 0.5)
    wide = np.nan_to_num(half.max(axis=2), nan=1.0).reshape(-1)
    grow = 1 + band / narrow
    return Patches(
        target=np.repeat(np.arange(count), len(radius)),
        center_mm=np.tile(center, (count, 1)),
        reach_mm=np.tile(radius, count) * grow,
        anchor_px=np.round(middle),
        scale_px=np.maximum(wide * grow, 1.0),
    )


def ring_areas(kind: TargetKind, members: list[list[int]]) -> tuple[Array, Array]:
    """Centre (R, 2) and radius (R,) in mm of a circle about each ring: its outermost circle, or the whole target."""
    centers = np.array([kind.center_mm[group].mean(axis=0) for group in members])
    reach = [(np.linalg.norm(kind.center_mm[g] - c, axis=1) + kind.radius_mm[g]).max() for g, c in zip(members, centers, strict=True)]
    return centers, np.array(reach)


def ring_pixels(
    image: NDArray[Any], rings: Rings, maps: LocalMaps, patches: Patches, half_px: Array, blur_px: float, fine: bool
) -> RingPixels:
    """Pixels of the rings of T targets: the band along their edges, or their whole window for fine rings.

    half_px (M,): half the size of the ring's outline; `maps` are those of `patches`, one for each ring.
    """
    reach = BAND_BLURS * blur_px + BAND_EXTRA_PX
    ring = np.tile(np.arange(len(rings)), len(patches.target) // len(rings))
    half = np.ceil(half_px + reach + 1)
    if fine:
        return _whole_windows(image, rings, maps, patches, ring, min(int(half.max()), LARGEST_FINE_PX // 2), reach)
    return _bands(image, rings, maps, patches, ring, half, reach)


def gather(image: NDArray[Any], u: Index, v: Index) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Grey levels, whether inside the image, and whether at the end of the scale."""
    height, width = image.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    if not inside.all():
        u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
    grey = np.take(image.reshape(-1), v * width + u)
    full = np.iinfo(image.dtype).max if image.dtype.kind in "ui" else np.inf
    return grey.astype(np.float32), inside, grey >= full


def _whole_windows(
    image: NDArray[Any], rings: Rings, maps: LocalMaps, patches: Patches, ring: Index, half: int, reach: float
) -> RingPixels:
    side = 2 * half + 1
    dv, du = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    anchor = patches.anchor_px.astype(int)
    grey, inside, full = gather(image, anchor[:, :1] + du, anchor[:, 1:] + dv)
    scale = patches.scale_px[:, None]
    s, t = (du / scale).astype(np.float32), (dv / scale).astype(np.float32)
    # a window may reach into the next target: only pixels near this one's edges count
    near = inside & _at_edges(rings, maps, patches, ring, (du, dv), reach).any(axis=0)
    return RingPixels(ring, patches, s, t, grey, near & ~full, (side, side), saturated=_share(near & full, near))


def _bands(image: NDArray[Any], rings: Rings, maps: LocalMaps, patches: Patches, ring: Index, half: Array, reach: float) -> RingPixels:
    """Pixels within `reach` of any edge, chosen by 2x2 blocks; every k-th row and column for very large rings."""
    stride = int(np.ceil(2 * half.max() / LARGEST_WINDOW_PX))
    size = int(np.ceil(half.max() / stride / 2)) * 2
    offsets = stride * np.arange(-size, size + 1, 2, dtype=np.int32)
    dv, du = (x.ravel() for x in np.meshgrid(offsets, offsets, indexing="ij"))
    # a block is chosen by its middle
    at = _at_edges(rings, maps, patches, ring, (du + 0.5 * stride, dv + 0.5 * stride), reach)
    block, used = (np.concatenate(values, axis=1) for values in zip(*map(places_of, at), strict=True))
    ends = tuple(4 * int(end) for end in np.cumsum([_most(near) for near in at]))
    corners = stride * np.array([[0, 1, 0, 1], [0, 0, 1, 1]], np.int32)
    out_u, out_v = (np.take(d[:, None] + c, block, axis=0).reshape(len(block), -1) for d, c in zip((du, dv), corners, strict=True))
    used = np.repeat(used, 4, axis=1)
    anchor = patches.anchor_px.astype(np.int32)
    grey, inside, full = gather(image, anchor[:, :1] + out_u, anchor[:, 1:] + out_v)
    scale = patches.scale_px[:, None].astype(np.float32)
    s, t = out_u.astype(np.float32) / scale, out_v.astype(np.float32) / scale
    clear = rings.gap_mm[ring] / maps.mm_per_px[0][:, None, None] - (reach + stride)
    return RingPixels(ring, patches, s, t, grey, used & inside & ~full, None, ends, clear, saturated=_share(used & full, used))


def _most(chosen: NDArray[Any]) -> int:
    return max(int(chosen.sum(axis=1).max(initial=0)), 1)


def places_of(chosen: NDArray[Any]) -> tuple[Index, NDArray[Any]]:
    """Columns (M, n) of what is chosen in each row, and whether a column stands for anything: rows are padded to the longest."""
    used = np.arange(_most(chosen)) < chosen.sum(axis=1)[:, None]
    # what is not used points to the middle of the window
    out = np.full(used.shape, chosen.shape[1] // 2)
    out[used] = np.flatnonzero(chosen) % chosen.shape[1]
    return out, used


def _share(some: NDArray[Any], of: NDArray[Any]) -> Array:
    return np.asarray(some.sum(axis=1) / np.maximum(of.sum(axis=1), 1))


def _at_edges(
    rings: Rings, maps: LocalMaps, patches: Patches, ring: Index, offsets_px: tuple[NDArray[Any], NDArray[Any]], reach_px: float
) -> NDArray[np.bool_]:
    """Which (C, M, n) circle's edge is the nearest within `reach_px` of points at offsets (n,), (n,) from each patch's anchor.

    To first order, which is enough to choose pixels.
    """
    du, dv = offsets_px
    center, radius = rings.center_mm, np.where(rings.sign != 0, rings.radius_mm, np.float32(np.inf))
    out = np.empty((radius.shape[1], len(ring), len(du)), bool)
    for rows in batches(len(ring), len(du)):
        x, y, xu, xv, yu, yv = np.moveaxis(plane_at_offsets(maps, patches, rows, du, dv), 1, 0)
        least = np.full(x.shape, reach_px, np.float32)
        for c in range(len(out)):
            if c == 0 or not np.array_equal(center[:, c], center[:, c - 1]):
                dx, dy = x - center[ring[rows], c, :1], y - center[ring[rows], c, 1:]
                rho = np.sqrt(dx * dx + dy * dy)
                gu, gv = dx * xu + dy * yu, dx * xv + dy * yv
                px_per_mm = rho / np.sqrt(np.maximum(gu * gu + gv * gv, np.float32(SMALLEST_SLOPE)))
            gap_px = np.abs(radius[ring[rows], c, None] - rho)
            gap_px *= px_per_mm
            np.less(gap_px, least, out=out[c, rows])
            np.minimum(least, gap_px, out=least)
            out[:c, rows] &= ~out[c, rows]
    return out & (du * du + dv * dv < patches.scale_px[:, None] ** 2)
