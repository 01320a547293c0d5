"""Choosing the pixels of the photograph that carry a target's edges."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.targets.edges import LocalMaps, Poses, monomials, project_printed
from dishmap.targets.pattern import TargetKind
from dishmap.targets.pixels import BAND_BLURS, BAND_EXTRA_PX, LARGEST_CURVED, RingPixels, Rings, rings_of

Array = NDArray[np.float64]

OUTLINE_POINTS = 16
# The blur of one ring must not reach the next: this many blurs of ground between them, else they are modelled together.
RING_GAP_BLURS = 5.0
# A ring's window is at most this wide; larger targets use fewer of their pixels (every k-th).
LARGEST_WINDOW_PX = 400


def outline(camera: Camera, poses: Poses, curvature_per_mm: Array, center_mm: Array, radius_mm: Array) -> Array:
    """Pixels (T, C, Q, 2) on the projected outlines of circles (C, 2), (C,) of T targets."""
    angle = 2 * np.pi * np.arange(OUTLINE_POINTS) / OUTLINE_POINTS
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    xy = center_mm[:, None] + radius_mm[:, None, None] * circle
    pixels, _ = project_printed(camera, poses, curvature_per_mm, xy.reshape(-1, 2))
    return pixels.reshape(len(poses), len(radius_mm), OUTLINE_POINTS, 2)


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


def ring_pixels(
    image: NDArray[np.generic], rings: Rings, maps: LocalMaps, outlines: Array, members: list[list[int]], blur_px: float, fine: bool
) -> RingPixels:
    """Pixels of every ring of T targets: the band along its edges, or its whole window for fine rings.

    outlines (T, C, Q, 2) of the kind's circles; members: for each ring the outermost circles (into C) in it.
    """
    reach = BAND_BLURS * blur_px + BAND_EXTRA_PX
    points = [outlines[:, group].reshape(len(outlines), -1, 2) for group in members]
    low = np.stack([p.min(axis=1) for p in points], axis=1).reshape(-1, 2)
    high = np.stack([p.max(axis=1) for p in points], axis=1).reshape(-1, 2)
    target = np.repeat(np.arange(len(outlines)), len(points))
    ring = np.tile(np.arange(len(points)), len(outlines))
    middle = np.round(0.5 * (low + high))
    half = np.ceil((0.5 * (high - low)).max(axis=1) + reach + 1)
    if fine:
        return _whole_windows(image, maps, target, ring, middle, int(half.max()))
    return _bands(image, rings, maps, target, ring, middle, half, reach)


def _gather(image: NDArray[np.generic], u: NDArray[np.int64], v: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    height, width = image.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    flat = np.clip(v, 0, height - 1) * width + np.clip(u, 0, width - 1)
    return image.reshape(-1)[flat].astype(np.float32), inside


def _whole_windows(image, maps: LocalMaps, target, ring, middle: Array, half: int) -> RingPixels:
    side = 2 * half + 1
    j, i = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    u, v = middle[:, :1].astype(int) + i, middle[:, 1:].astype(int) + j
    grey, inside = _gather(image, u, v)
    anchor, scale = maps.anchor_px[target], maps.scale_px[target]
    s = ((u - anchor[:, :1]) / scale[:, None]).astype(np.float32)
    t = ((v - anchor[:, 1:]) / scale[:, None]).astype(np.float32)
    return RingPixels(target, ring, s, t, grey, inside, (side, side))


def _bands(image, rings: Rings, maps: LocalMaps, target, ring, middle: Array, half: Array, reach: float) -> RingPixels:
    """Pixels within `reach` of any edge, chosen by 2x2 blocks, every k-th of them for very large rings."""
    stride = int(np.ceil(2 * half.max() / LARGEST_WINDOW_PX))
    side = int(np.ceil(half.max() / stride)) * 2
    offsets = stride * np.arange(-(side // 2), side // 2 + 1, 2)
    j, i = np.meshgrid(offsets, offsets, indexing="ij")
    # the middle of each block of two by two (strided) pixels
    s, t = _local(maps, target, middle[:, :1] + i.ravel() + 0.5 * stride, middle[:, 1:] + j.ravel() + 0.5 * stride)
    six = monomials(s, t, 2) @ _plane_to_second_order(maps)[target].astype(np.float32)
    near = np.zeros(s.shape, bool)
    for c in range(rings.radius_mm.shape[1]):
        dx, dy = six[..., 0] - rings.center_mm[ring, c, :1], six[..., 1] - rings.center_mm[ring, c, 1:]
        rho = np.sqrt(dx * dx + dy * dy) + np.float32(1e-9)
        gu, gv = dx * six[..., 2] + dy * six[..., 4], dx * six[..., 3] + dy * six[..., 5]
        near |= (np.abs(rings.radius_mm[ring, c][:, None] - rho) * rho < (reach + 0.5 * stride) * np.sqrt(gu * gu + gv * gv)) & (
            rings.sign[ring, c] != 0
        )[:, None]
    row, block = np.nonzero(near)
    counts = near.sum(axis=1)
    place = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    u = np.zeros((len(near), max(int(counts.max()), 1) * 4), np.int64)
    v, used = np.zeros_like(u), np.zeros(u.shape, bool)
    base_u = middle[row, 0].astype(int) + i.ravel()[block]
    base_v = middle[row, 1].astype(int) + j.ravel()[block]
    for k in range(4):
        u[row, 4 * place + k], v[row, 4 * place + k] = base_u + stride * (k % 2), base_v + stride * (k // 2)
        used[row, 4 * place + k] = True
    u, v = np.where(used, u, middle[:, :1].astype(int)), np.where(used, v, middle[:, 1:].astype(int))
    grey, inside = _gather(image, u, v)
    s, t = _local(maps, target, u, v)
    return RingPixels(target, ring, s, t, grey, used & inside)


def _local(maps: LocalMaps, target, u, v) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    anchor, scale = maps.anchor_px[target], maps.scale_px[target]
    s, t = (u - anchor[:, :1]) / scale[:, None], (v - anchor[:, 1:]) / scale[:, None]
    return s.astype(np.float32), t.astype(np.float32)


def _plane_to_second_order(maps: LocalMaps) -> Array:
    return maps.plane[:, : len(monomials(np.zeros(1), np.zeros(1), 2)[0])]
