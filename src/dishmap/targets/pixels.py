"""The model of the raw pixels around printed circles, and its normal equations.

Each outermost circle with what is nested in it is one ring here. Its pixels follow

    I(u, v) = ground(u, v) (1 - c) + ink(u, v) c,   c = sum over circles of +-Phi(d / s)

with planar ground and ink levels of each ring, d the signed distance to the projected circle and s the total blur
(s^2 = psf^2 + 1/12 for the pixel's own area). Curved edges: averaging Phi((d - k t^2 / 2) / s) over the blur along the edge
(curvature k) shifts the edge by k s^2 / 2 (1 + 3/4 k^2 s^2) and widens it by k^2 s^4 / 2. Where k s is too large for that
series the ring is computed on a finer grid with little blur and then blurred exactly (`_fine_columns`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from dishmap.targets.edges import MOTION_TERMS, LocalMaps, edge_distance, monomials
from dishmap.targets.pattern import TargetKind

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Bool = NDArray[np.bool_]

# Geometry parameters of a target: 3 moves (mm), 3 turns (rad), edge offset (mm), edge offset (px), blur s (px).
GEOMETRY = 9
OFFSET_MM, OFFSET_PX, BLUR = 6, 7, 8
# Light parameters of a ring: ground level and slopes, ink level and slopes (grey levels, and per local unit).
LIGHT = 6
# Half width of the band of pixels used, in blurs: beyond it the edge changes the pixel by under 0.2 % of the contrast.
BAND_BLURS, BAND_EXTRA_PX = 3.0, 0.8
# Above this product of curvature and blur the series for curved edges leaves more than 0.001 px; see tests.
LARGEST_CURVED = 0.22
FINE_FACTOR, FINE_BLUR_PX = 3, 0.4
RINGS_AT_ONCE = 48
TINY = np.float32(1e-6)


@dataclass(frozen=True)
class Rings:
    """Rings of a kind: circle centres (R, C, 2), radii (R, C) in mm, ink sign (R, C): +1 dark inside, -1 light, 0 unused."""

    center_mm: Single
    radius_mm: Single
    sign: Single

    def __len__(self) -> int:
        return len(self.radius_mm)


def rings_of(kind: TargetKind, together: bool = False) -> Rings:
    """Split a target kind into its rings, each outermost circle first; unused places have sign 0.

    `together` makes all circles one ring: for targets so small in the image that the blur of one ring reaches the next.
    """
    groups = [list(np.flatnonzero(kind.outermost == outer)) for outer in np.flatnonzero(kind.parent < 0)]
    if together:
        groups = [[i for group in groups for i in group]]
    most = max(map(len, groups))
    index = np.array([group + [group[0]] * (most - len(group)) for group in groups])
    used = np.array([[True] * len(group) + [False] * (most - len(group)) for group in groups])
    sign = np.where(kind.dark[index], 1.0, -1.0) * used
    return Rings(kind.center_mm[index].astype(np.float32), kind.radius_mm[index].astype(np.float32), sign.astype(np.float32))


@dataclass(frozen=True)
class RingPixels:
    """Pixels of M rings of one batch, padded to n each.

    target, ring (M,): which target of the batch and which ring of its kind; s, t (M, n): local coordinates of the pixels
    (see LocalMaps); grey (M, n): the photograph; used (M, n): false for padding and pixels left out.
    shape: (H, W) of each ring's full window if the pixels are a whole window (fine rings), else None.
    """

    target: NDArray[np.int64]
    ring: NDArray[np.int64]
    s: Single
    t: Single
    grey: Single
    used: Bool
    shape: tuple[int, int] | None = None

    def every(self, step: int) -> RingPixels:
        """Keep every `step`-th pixel, for the first coarse steps of a fit (bands only)."""
        if step == 1 or self.shape is not None:
            return self
        cut = np.s_[:, ::step]
        return RingPixels(self.target, self.ring, self.s[cut], self.t[cut], self.grey[cut], self.used[cut])

    def part(self, rows: slice) -> RingPixels:
        """The rings `rows` alone."""
        return RingPixels(self.target[rows], self.ring[rows], self.s[rows], self.t[rows], self.grey[rows], self.used[rows], self.shape)


@dataclass(frozen=True)
class State:
    """Nuisances of T targets that the geometry needs: offset_mm, offset_px (ink moved outwards), blur_px, each (T,)."""

    offset_mm: Array
    offset_px: Array
    blur_px: Array


@dataclass(frozen=True)
class RingSums:
    """What a pass over the pixels leaves of M rings.

    normal (M, G+L, G+L) and right (M, G+L): weighted normal equations, geometry first; light (M, L) the levels used;
    square (M,): weighted sum of squared residuals; weight (M,): sum of weights; kept (M, C): share of each circle's edge
    information that robust weighting left; count (M,): number of pixels.
    """

    normal: Array
    right: Array
    light: Array
    square: Array
    weight: Array
    kept: Array
    count: Array


@dataclass(frozen=True)
class Weighting:
    """How pixels are weighted: variance = base + slope * grey level (floored), cut (M,): residual beyond which a pixel is out."""

    base: float
    slope: float
    cut: Array | None


def _coverage(six: Single, rings: Rings, ring: NDArray[np.int64], offset_mm: Single, offset_px: Single, blur: Single, motion: Single, mono: Single):
    """Ink coverage (M, n), its derivative by the geometry (M, n, G) and each circle's edge weight (M, C, n)."""
    cover = np.zeros(six.shape[:-1], np.float32)
    pull_u, pull_v, by_mm, by_px, by_blur = (np.zeros_like(cover) for _ in range(5))
    edges = np.empty((len(six), rings.radius_mm.shape[1], six.shape[1]), np.float32)
    for c in range(rings.radius_mm.shape[1]):
        sign = rings.sign[ring, c][:, None]
        radius = (rings.radius_mm[ring, c] + rings.sign[ring, c] * offset_mm)[:, None]
        d, nu, nv, px_per_mm, k = edge_distance(six, rings.center_mm[ring, c][:, None], radius)
        # ink spread moves dark edges out and light edges in
        d += sign * offset_px[:, None]
        b = blur[:, None]
        ks = k * b
        ks *= ks
        s = b * (1 + 0.25 * ks)
        d -= 0.5 * k * b * b * (1 + 0.75 * ks)
        z = d / s
        cover += sign * ndtr(z)
        density = np.exp(-0.5 * z * z)
        density *= np.float32(0.3989423) / s
        edges[:, c] = np.abs(sign) * density
        density *= sign
        pull_u += density * nu
        pull_v += density * nv
        density *= sign
        by_px += density
        by_mm += density * px_per_mm
        density *= sign
        by_blur -= density * (z + k * b)
    return cover, _geometry(mono, motion, pull_u, pull_v, by_mm, by_px, by_blur), edges


def _geometry(mono: Single, motion: Single, pull_u: Single, pull_v: Single, by_mm: Single, by_px: Single, by_blur: Single) -> Single:
    out = np.empty((*pull_u.shape, GEOMETRY), np.float32)
    few = mono[..., :MOTION_TERMS]
    np.matmul(few, motion[..., 0, :], out=out[..., :6])
    out[..., :6] *= pull_u[..., None]
    second = few @ motion[..., 1, :]
    second *= pull_v[..., None]
    out[..., :6] += second
    out[..., OFFSET_MM], out[..., OFFSET_PX], out[..., BLUR] = by_mm, by_px, by_blur
    return out


def coverage_columns(pixels: RingPixels, rings: Rings, maps: LocalMaps, state: State):
    """Ink coverage of the pixels (M, n), its derivative by the geometry parameters (M, n, G), edge weights (M, C, n).

    `maps` and `state` are those of the batch's targets; rows of `pixels` pick theirs by `pixels.target`.
    """
    which = pixels.target
    plane, motion = maps.plane[which].astype(np.float32), maps.motion[which].astype(np.float32)
    args = tuple(v[which].astype(np.float32) for v in (state.offset_mm, state.offset_px))
    blur = state.blur_px[which].astype(np.float32)
    if pixels.shape is None:
        mono = monomials(pixels.s, pixels.t)
        return _coverage(mono @ plane, rings, pixels.ring, *args, blur, motion, mono)
    return _fine_columns(pixels, rings, maps, plane, motion, args, blur)


def _fine_columns(pixels: RingPixels, rings: Rings, maps: LocalMaps, plane: Single, motion: Single, args: tuple[Single, Single], blur: Single):
    """As `_coverage`, but on a grid three times finer with a blur of 0.4 px, then blurred to the full width."""
    assert pixels.shape is not None
    height, width = pixels.shape
    step = 1 / (FINE_FACTOR * maps.scale_px[pixels.target])
    margin = FINE_FACTOR * int(np.ceil(4 * blur.max()))
    fine_h, fine_w = FINE_FACTOR * height + 2 * margin, FINE_FACTOR * width + 2 * margin
    # the middle one of each three fine samples sits on the pixel's centre
    first = margin + 1
    j, i = np.mgrid[:fine_h, :fine_w].reshape(2, -1)
    s = (pixels.s[:, :1] + (i - first) * step[:, None]).astype(np.float32)
    t = (pixels.t[:, :1] + (j - first) * step[:, None]).astype(np.float32)
    mono = monomials(s, t)
    start = np.full(len(blur), FINE_BLUR_PX, np.float32)
    cover, columns, edges = _coverage(mono @ plane, rings, pixels.ring, *args, start, motion, mono)
    extra = np.sqrt(np.maximum(blur.astype(float) ** 2 - FINE_BLUR_PX**2, 1e-4))
    rows, rows_by = _blur_matrix(height, fine_h, first, extra)
    cols, cols_by = _blur_matrix(width, fine_w, first, extra)

    def blurred(values: Single, down: Single, across: Single) -> Single:
        image = values.reshape(len(values), fine_h, fine_w, -1).transpose(0, 3, 1, 2)
        out = down[:, None] @ image @ np.swapaxes(across, -1, -2)[:, None]
        return out.transpose(0, 2, 3, 1).reshape(len(values), height * width, -1)

    out = blurred(columns, rows, cols)
    by_extra = blurred(cover[..., None], rows_by, cols) + blurred(cover[..., None], rows, cols_by)
    out[..., BLUR] = by_extra[..., 0] * (blur / extra)[:, None]
    edge = blurred(edges.transpose(0, 2, 1), rows, cols).transpose(0, 2, 1)
    return blurred(cover[..., None], rows, cols)[..., 0], out, edge


def _blur_matrix(size: int, fine: int, first: int, extra: Array) -> tuple[Single, Single]:
    """Matrices (M, size, fine) that blur fine samples by `extra` px and pick the pixels, and their derivative by extra."""
    distance = (np.arange(fine)[None, :] - (first + FINE_FACTOR * np.arange(size))[:, None]) / FINE_FACTOR
    z2 = (distance[None] / extra[:, None, None]) ** 2
    kernel = np.exp(-0.5 * z2) / (np.sqrt(2 * np.pi) * extra[:, None, None] * FINE_FACTOR)
    return kernel.astype(np.float32), (kernel * (z2 - 1) / extra[:, None, None]).astype(np.float32)


def light_columns(pixels: RingPixels, cover: Single) -> Single:
    """Derivative of the pixels by the ring's light levels (M, n, L): ground and ink, each level and two slopes."""
    # slopes are about the ring's own middle, so that levels and slopes are nearly independent
    s, t = (v - v.mean(axis=1, keepdims=True) for v in (pixels.s, pixels.t))
    out = np.empty((*cover.shape, LIGHT), np.float32)
    out[..., 0], out[..., 3] = 1 - cover, cover
    for column, place in ((1, s), (2, t)):
        np.multiply(out[..., 0], place, out=out[..., column])
        np.multiply(out[..., 3], place, out=out[..., column + 3])
    return out


def solve_light(pixels: RingPixels, columns: Single, weight: Single) -> Array:
    """Best light levels (M, L) of each ring for a given coverage; slopes lean weakly towards zero so that tiny rings hold."""
    weighted = columns * weight[..., None]
    normal = (np.swapaxes(weighted, 1, 2) @ columns).astype(float)
    right = (np.swapaxes(weighted, 1, 2) @ pixels.grey[..., None])[..., 0].astype(float)
    diagonal = np.maximum(np.trace(normal, axis1=1, axis2=2), 1e-9)[:, None]
    normal[:, range(LIGHT), range(LIGHT)] += 1e-7 * diagonal
    return np.linalg.solve(normal, right[..., None])[..., 0]


def ring_sums(pixels: RingPixels, rings: Rings, maps: LocalMaps, state: State, weighting: Weighting) -> tuple[RingSums, Single]:
    """One pass over the pixels: normal equations of every ring at the present state, and the residuals (M, n) in grey levels."""
    parts, residuals = [], []
    for begin in range(0, len(pixels.ring), RINGS_AT_ONCE):
        rows = slice(begin, begin + RINGS_AT_ONCE)
        cut = None if weighting.cut is None else weighting.cut[rows]
        sums, residual = _sums(pixels.part(rows), rings, maps, state, weighting, cut)
        parts.append(sums)
        residuals.append(residual)
    fields = RingSums.__dataclass_fields__
    return RingSums(*(np.concatenate([getattr(p, f) for p in parts]) for f in fields)), np.concatenate(residuals)


def _sums(pixels: RingPixels, rings: Rings, maps: LocalMaps, state: State, weighting: Weighting, cut: Array | None) -> tuple[RingSums, Single]:
    cover, geometry, edges = coverage_columns(pixels, rings, maps, state)
    used = pixels.used.astype(np.float32)
    columns = light_columns(pixels, cover)
    light = solve_light(pixels, columns, used)
    residual = pixels.grey - (columns @ light[..., None].astype(np.float32))[..., 0]
    robust = used
    if cut is not None:
        for _ in range(2):
            # the levels were found with the outliers in; once more without them
            x = residual / cut[:, None].astype(np.float32)
            robust = used * np.square(np.maximum(1 - x * x, 0))
            light = solve_light(pixels, columns, robust)
            residual = pixels.grey - (columns @ light[..., None].astype(np.float32))[..., 0]
    model = pixels.grey - residual
    variance = np.maximum(np.float32(weighting.base) + np.float32(weighting.slope) * np.maximum(model, 0), TINY)
    weight = robust / variance
    light32 = light.astype(np.float32)
    contrast = (columns[..., :3] + columns[..., 3:]) @ (light32[:, 3:] - light32[:, :3])[..., None]
    every = np.concatenate([geometry * contrast, columns], axis=-1)
    weighted = np.swapaxes(every * weight[..., None], 1, 2)
    normal = (weighted @ every).astype(float)
    right = (weighted @ residual[..., None])[..., 0].astype(float)
    edge_all = (edges * used[:, None]).sum(axis=2)
    kept = (edges * robust[:, None]).sum(axis=2) / np.maximum(edge_all, TINY)
    square = (weight * residual * residual).sum(axis=1, dtype=float)
    return RingSums(normal, right, light, square, robust.sum(axis=1, dtype=float), kept.astype(float), used.sum(axis=1, dtype=float)), residual


def without_light(sums: RingSums) -> tuple[Array, Array]:
    """Normal equations of the geometry alone (M, G, G), (M, G), with each ring's own light levels eliminated (Schur)."""
    g = slice(0, GEOMETRY)
    cross, own = sums.normal[:, g, GEOMETRY:], sums.normal[:, GEOMETRY:, GEOMETRY:].copy()
    diagonal = np.maximum(np.trace(own, axis1=1, axis2=2), 1e-9)[:, None]
    own[:, range(LIGHT), range(LIGHT)] += 1e-7 * diagonal
    solved = np.linalg.solve(own, np.concatenate([np.swapaxes(cross, 1, 2), sums.right[:, GEOMETRY:, None]], axis=2))
    normal = sums.normal[:, g, g] - cross @ solved[..., :GEOMETRY]
    right = sums.right[:, g] - (cross @ solved[..., GEOMETRY:])[..., 0]
    return normal, right
