"""The model of the raw pixels around printed circles, and its normal equations.

Each outermost circle with what is nested in it is one ring here. Its pixels follow

    I(u, v) = ground(u, v) (1 - c) + ink(u, v) c + bend(u, v),   c = sum over circles of +-Phi(d / s)

with planar ground and ink levels of each ring, a quadratic bend of the light over both (glare, shading), d the signed
distance to the projected circle and s the total blur
(s^2 = psf^2 + 1/12 for the pixel's own area). A camera's tone curve, level = light^(1 / gamma), bends c (`toned`).
Curved edges: averaging Phi((d - k t^2 / 2) / s) over the blur along the edge
(curvature k) shifts the edge by k s^2 / 2 (1 + 3/4 k^2 s^2) and widens it by k^2 s^4 / 2. Where k s is too large for that
series the ring is computed on a finer grid with little blur and then blurred exactly (`_fine_columns`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from dishmap.targets.edges import MOTION_TERMS, LocalMaps, Patches, edge_distance, monomials
from dishmap.targets.pattern import TargetKind

Array = NDArray[Any]
Single = NDArray[Any]
Bool = NDArray[Any]

# Geometry parameters of a target: 3 moves (mm), 3 turns (rad), edge offset (mm), edge offset (px), blur s (px), log gamma.
GEOMETRY = 10
OFFSET_MM, OFFSET_PX, BLUR, TONE = 6, 7, 8, 9
# Light parameters of a ring: ground level and slopes, ink level and slopes, bend (grey levels, in local units).
LIGHT = 9
GROUND, INK, BEND = slice(0, 3), slice(3, 6), slice(6, 9)
# Half width of the band of pixels used, in blurs: beyond it the edge changes the pixel by under 0.2 % of the contrast.
BAND_BLURS, BAND_EXTRA_PX = 2.5, 0.5
# Above this product of curvature and blur the series for curved edges leaves more than 0.001 px; see tests.
LARGEST_CURVED = 0.22
FINE_FACTOR, FINE_BLUR_PX = 3, 0.4
# Pixels handled at once, so that the working arrays stay in the processor's cache.
PIXELS_AT_ONCE = 24000
TINY = np.float32(1e-6)
# Share of the cut up to which a residual keeps its full weight.
TAPER = np.float32(0.65)
# Ink over ground, as far as a tone curve is followed.
TONE_RATIOS = (0.02, 0.95)


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

    ring (M,): which ring of its kind; patches: the area around each ring, with its target; s, t (M, n): coordinates of the
    pixels in the patch; grey (M, n): the photograph; used (M, n): false for padding and pixels left out.
    shape: (H, W) of each ring's full window if the pixels are a whole window (fine rings), else None: blocks of 2x2.
    saturated (M,): share of the ring's pixels at the end of the scale, which are not used.
    blocked (M, n): pixels that count as lost to something in front of the print, or None where nothing is.
    """

    ring: NDArray[np.int64]
    patches: Patches
    s: Single
    t: Single
    grey: Single
    used: Bool
    shape: tuple[int, int] | None = None
    blocked: Bool | None = None
    saturated: Array | None = None

    @property
    def target(self) -> NDArray[np.int64]:
        """The target of each ring (M,)."""
        return self.patches.target

    def only(self, rows: Bool, number: NDArray[np.int64]) -> RingPixels:
        """The rings `rows` (M,), with targets renumbered by `number`."""
        p = self.patches
        patches = Patches(number[p.target[rows]], p.center_mm[rows], p.reach_mm[rows], p.anchor_px[rows], p.scale_px[rows])
        blocked = None if self.blocked is None else self.blocked[rows]
        return RingPixels(self.ring[rows], patches, self.s[rows], self.t[rows], self.grey[rows], self.used[rows], self.shape, blocked)

    def every(self, step: int) -> RingPixels:
        """Keep every `step`-th pixel, for the first coarse steps of a fit (bands only)."""
        if step == 1 or self.shape is not None:
            return self
        cut = (slice(None), slice(None, None, step))
        s, t, grey, used = (np.ascontiguousarray(values[cut]) for values in (self.s, self.t, self.grey, self.used))
        return RingPixels(self.ring, self.patches, s, t, grey, used)


@dataclass(frozen=True)
class State:
    """Nuisances of T targets that the geometry needs, each (T,).

    offset_mm and offset_px: ink moved outwards; blur_px; log_gamma: of the tone curve.
    """

    offset_mm: Array
    offset_px: Array
    blur_px: Array
    log_gamma: Array

    def take(self, index: NDArray[np.int64] | Bool) -> State:
        """The nuisances of the targets at `index`."""
        return State(self.offset_mm[index], self.offset_px[index], self.blur_px[index], self.log_gamma[index])


@dataclass(frozen=True)
class RingSums:
    """What a pass over the pixels leaves of M rings.

    normal (M, G+L, G+L) and right (M, G+L): weighted normal equations, geometry first; light (M, L) the levels used;
    square (M,): weighted sum of squared residuals; weight (M,): sum of robust weights; kept (M, C): share of each circle's
    edge information that robust weighting left.
    """

    normal: Array
    right: Array
    light: Array
    square: Array
    weight: Array
    kept: Array


@dataclass(frozen=True)
class Weighting:
    """How pixels are weighted: variance = base + slope * grey level (floored), cut (M,): residual beyond which a pixel is out."""

    base: float
    slope: float
    cut: Array | None


@dataclass(frozen=True)
class _Look:
    """What the coverage of some rings depends on, in single precision: local polynomials, circles, offsets and blur."""

    plane: Single
    motion: Single
    degree: int
    center_mm: Single
    radius_mm: Single
    sign: Single
    offset_px: Single
    blur_px: Single


def _look(rows: slice, pixels: RingPixels, rings: Rings, maps: LocalMaps, state: State) -> _Look:
    target, ring = pixels.target[rows], pixels.ring[rows]
    single = [np.asarray(v[target], np.float32) for v in (state.offset_mm, state.offset_px, state.blur_px)]
    sign = rings.sign[ring]
    return _Look(
        maps.plane[rows].astype(np.float32),
        maps.motion[rows].astype(np.float32),
        maps.degree,
        rings.center_mm[ring],
        # ink spread moves dark edges out and light edges in
        rings.radius_mm[ring] + sign * single[0][:, None],
        sign,
        single[1],
        single[2],
    )


def _coverage(look: _Look, s: Single, t: Single, blur_px: Single) -> tuple[Single, Single, Single]:
    """Ink coverage (M, n), its derivative by the geometry (M, G, n) and each circle's edge weight (M, C, n)."""
    mono = monomials(s, t, look.degree)
    six = look.plane @ mono
    cover = np.zeros(s.shape, np.float32)
    pull_u, pull_v = np.zeros_like(cover), np.zeros_like(cover)
    out = np.zeros((len(s), GEOMETRY, s.shape[1]), np.float32)
    edges = np.empty((len(s), look.radius_mm.shape[1], s.shape[1]), np.float32)
    b = blur_px[:, None]
    for c in range(look.radius_mm.shape[1]):
        sign = look.sign[:, c, None]
        d, nu, nv, px_per_mm, k = edge_distance(six, look.center_mm[:, c], look.radius_mm[:, c])
        d += sign * look.offset_px[:, None]
        kb = k * b
        square = kb * kb
        d -= (0.5 * b) * kb * (1 + np.float32(0.75) * square)
        inverse = 1 / (b * (1 + np.float32(0.25) * square))
        d *= inverse
        cover += sign * ndtr(d)
        density = np.exp(np.float32(-0.5) * d * d)
        density *= inverse
        density *= np.float32(0.3989423)
        edges[:, c] = density * np.abs(sign)
        out[:, OFFSET_PX] += edges[:, c]
        out[:, OFFSET_MM] += edges[:, c] * px_per_mm
        density *= sign
        pull_u += density * nu
        pull_v += density * nv
        d += kb
        d *= density
        out[:, BLUR] -= d
    few = mono[:, :MOTION_TERMS]
    np.matmul(look.motion[:, 0], few, out=out[:, :6])
    out[:, :6] *= pull_u[:, None]
    second = look.motion[:, 1] @ few
    second *= pull_v[:, None]
    out[:, :6] += second
    return cover, out, edges


def coverage_columns(rows: slice, pixels: RingPixels, rings: Rings, maps: LocalMaps, state: State) -> tuple[Single, Single, Single]:
    """Ink coverage of rings `rows` (M, n), its derivative by the geometry (M, G, n), edge weights of circles (M, C, n).

    `maps` are those of `pixels.patches`; `state` holds the batch's targets.
    """
    look = _look(rows, pixels, rings, maps, state)
    if pixels.shape is None:
        return _coverage(look, pixels.s[rows], pixels.t[rows], look.blur_px)
    return _fine_columns(rows, pixels, look)


def _fine_columns(rows: slice, pixels: RingPixels, look: _Look) -> tuple[Single, Single, Single]:
    """As `_coverage`, but on a grid three times finer with a blur of 0.4 px, then blurred to the full width."""
    assert pixels.shape is not None
    height, width = pixels.shape
    blur = look.blur_px
    step = 1 / (FINE_FACTOR * pixels.patches.scale_px[rows])
    margin = FINE_FACTOR * int(np.ceil(4 * blur.max()))
    fine_h, fine_w = FINE_FACTOR * height + 2 * margin, FINE_FACTOR * width + 2 * margin
    # the middle one of each three fine samples sits on the pixel's centre
    first = margin + 1
    j, i = np.mgrid[:fine_h, :fine_w].reshape(2, -1)
    s = (pixels.s[rows, :1] + (i - first) * step[:, None]).astype(np.float32)
    t = (pixels.t[rows, :1] + (j - first) * step[:, None]).astype(np.float32)
    # the window's corners lie beyond the patch, where its polynomials mean nothing; no edge is there
    outside = s * s + t * t > 1
    cover, columns, edges = _coverage(look, s * ~outside, t * ~outside, np.full(len(blur), FINE_BLUR_PX, np.float32))
    cover[outside] = 0
    columns *= ~outside[:, None]
    edges *= ~outside[:, None]
    extra = np.sqrt(np.maximum(blur.astype(float) ** 2 - FINE_BLUR_PX**2, 1e-4))
    down, down_by = _blur_matrix(height, fine_h, first, extra)
    across, across_by = _blur_matrix(width, fine_w, first, extra)

    def blurred(values: Single, down: Single, across: Single) -> Single:
        image = values.reshape(len(values), -1, fine_h, fine_w)
        return (down[:, None] @ image @ np.swapaxes(across, 1, 2)[:, None]).reshape(len(values), -1, height * width)

    out = blurred(columns, down, across)
    by_extra = blurred(cover, down_by, across) + blurred(cover, down, across_by)
    out[:, BLUR] = by_extra[:, 0] * (blur / extra)[:, None]
    return blurred(cover, down, across)[:, 0], out.astype(np.float32), blurred(edges, down, across)


def _blur_matrix(size: int, fine: int, first: int, extra: Array) -> tuple[Single, Single]:
    """Matrices (M, size, fine) that blur fine samples by `extra` px and pick the pixels, and their derivative by extra."""
    distance = (np.arange(fine)[None, :] - (first + FINE_FACTOR * np.arange(size))[:, None]) / FINE_FACTOR
    z2 = (distance[None] / extra[:, None, None]) ** 2
    kernel = np.exp(-0.5 * z2) / (np.sqrt(2 * np.pi) * extra[:, None, None] * FINE_FACTOR)
    return kernel.astype(np.float32), (kernel * (z2 - 1) / extra[:, None, None]).astype(np.float32)


def toned(cover: Single, dark_over_light: Single, log_gamma: Single) -> tuple[Single, Single, Single]:
    """Coverage (M, n) as a tone curve shows it, its derivative by the true coverage, and by log gamma.

    With levels G of the ground and K of the ink, light adds as G^gamma (1 - c) + K^gamma c; the level recorded is the 1/gamma
    power of that, and lies the returned part of the way from G to K. dark_over_light (M, 1) is K / G.
    """
    gamma = np.exp(log_gamma)
    power = dark_over_light**gamma
    light = 1 - (1 - power) * cover
    log_light = np.log(light)
    level = np.exp(log_light / gamma)
    scale = 1 / (1 - dark_over_light)
    slope = level / light * ((1 - power) * scale / gamma)
    by_gamma = (log_light / gamma - power * np.log(dark_over_light) * cover / light) * level * scale
    return (1 - level) * scale, slope, by_gamma


def light_columns(s: Single, t: Single, cover: Single) -> Single:
    """Derivative of the pixels by the ring's light levels (M, L, n): ground and ink, each level and two slopes, and the bend."""
    out = np.empty((len(cover), LIGHT, cover.shape[1]), np.float32)
    np.subtract(1, cover, out=out[:, 0])
    out[:, 3] = cover
    for column, place in ((1, s), (2, t)):
        np.multiply(out[:, 0], place, out=out[:, column])
        np.multiply(out[:, 3], place, out=out[:, column + 3])
    for column, first, second in ((6, s, s), (7, s, t), (8, t, t)):
        np.multiply(first, second, out=out[:, column])
    return out


def solve_light(columns: Single, grey: Single, weight: Single) -> Array:
    """Best light levels (M, L) of each ring for a given coverage; slopes lean weakly towards zero so that tiny rings hold."""
    weighted = columns * weight[:, None]
    normal = (weighted @ np.swapaxes(columns, 1, 2)).astype(float)
    right = (weighted @ grey[..., None]).astype(float)
    normal[:, range(LIGHT), range(LIGHT)] += _ridge(normal)
    return np.linalg.solve(normal, right)[..., 0]


def _ridge(normal: Array) -> Array:
    return 1e-7 * np.maximum(np.trace(normal, axis1=1, axis2=2), 1e-9)[:, None]


def ring_sums(pixels: RingPixels, rings: Rings, maps: LocalMaps, state: State, weighting: Weighting) -> tuple[RingSums, Single]:
    """One pass over the pixels: normal equations of every ring at the present state, and the residuals (M, n) in grey levels."""
    parts, residuals = [], []
    many = max(1, PIXELS_AT_ONCE // max(1, pixels.s.shape[1]))
    for begin in range(0, len(pixels.ring), many):
        rows = slice(begin, begin + many)
        sums, residual = _sums(rows, pixels, rings, maps, state, weighting)
        parts.append(sums)
        residuals.append(residual)
    fields = RingSums.__dataclass_fields__
    return RingSums(*(np.concatenate([getattr(p, f) for p in parts]) for f in fields)), np.concatenate(residuals)


def _sums(rows: slice, pixels: RingPixels, rings: Rings, maps: LocalMaps, state: State, weighting: Weighting) -> tuple[RingSums, Single]:
    cover, geometry, edges = coverage_columns(rows, pixels, rings, maps, state)
    used, grey = pixels.used[rows].astype(np.float32), pixels.grey[rows]
    s, t = pixels.s[rows], pixels.t[rows]
    log_gamma = np.asarray(state.log_gamma[pixels.target[rows], None], np.float32)
    bent, slope, geometry[:, TONE] = toned(np.clip(cover, 0, 1), _dark_over_light(cover, grey, used), log_gamma)
    columns = light_columns(s, t, bent)
    seen = used if pixels.blocked is None else used * ~pixels.blocked[rows]
    light, model = _levels(columns, grey, seen)
    robust = seen
    if weighting.cut is not None:
        cut = weighting.cut[rows, None].astype(np.float32)
        robust = _tapered(grey - model, cut, seen)
        if not np.array_equal(robust, seen):
            # the levels were found with the outliers in; once more without them
            light, model = _levels(columns, grey, robust)
            robust = _tapered(grey - model, cut, seen)
    residual = grey - model
    variance = np.maximum(np.float32(weighting.base) + np.float32(weighting.slope) * np.maximum(model, 0), TINY)
    weight = robust / variance
    root = np.sqrt(weight)
    step = (light[:, INK] - light[:, GROUND]).astype(np.float32)
    contrast = (step[:, :1] + step[:, 1:2] * s + step[:, 2:] * t) * root
    every = np.empty((len(s), GEOMETRY + LIGHT, s.shape[1]), np.float32)
    np.multiply(geometry[:, :TONE], (contrast * slope)[:, None], out=every[:, :TONE])
    np.multiply(geometry[:, TONE], contrast, out=every[:, TONE])
    np.multiply(columns, root[:, None], out=every[:, GEOMETRY:])
    normal = (every @ np.swapaxes(every, 1, 2)).astype(float)
    right = (every @ (residual * root)[..., None])[..., 0].astype(float)
    whole = (edges @ used[..., None])[..., 0]
    # unused circles, and rings without pixels, count as whole
    kept = np.where(whole > TINY, (edges @ robust[..., None])[..., 0] / np.maximum(whole, TINY), 1.0)
    square = np.einsum("mn,mn,mn->m", weight, residual, residual).astype(float)
    return RingSums(normal, right, light, square, robust.sum(axis=1, dtype=float), kept.astype(float)), residual


def _dark_over_light(cover: Single, grey: Single, used: Single) -> Single:
    """Ink level over ground level (M, 1) of each ring, from a fit of the two levels alone; it only bends the tone curve."""
    ink = cover * used
    a, b, c = used.sum(axis=1), ink.sum(axis=1), np.einsum("mn,mn->m", ink, cover)
    p, q = np.einsum("mn,mn->m", grey, used), np.einsum("mn,mn->m", grey, ink)
    determinant = np.maximum(a * c - b * b, TINY)
    ground, step = (c * p - b * q) / determinant, (a * q - b * p) / determinant
    ratio = (ground + step) / np.maximum(ground, TINY)
    return np.clip(ratio, *TONE_RATIOS)[:, None].astype(np.float32)


def _levels(columns: Single, grey: Single, weight: Single) -> tuple[Array, Single]:
    light = solve_light(columns, grey, weight)
    return light, (light[:, None].astype(np.float32) @ columns)[:, 0]


def _tapered(residual: Single, cut: Single, used: Single) -> Single:
    """Weights that are 1 up to TAPER of the cut and fall to 0 at the cut, so that Gaussian noise loses nothing."""
    x = residual / cut
    if not (np.abs(x) * used > TAPER).any():
        return used
    return np.square(np.clip((1 - x * x) * np.float32(1 / (1 - TAPER**2)), 0, 1)) * used


def without_light(sums: RingSums) -> tuple[Array, Array]:
    """Normal equations of the geometry alone (M, G, G), (M, G), with each ring's own light levels eliminated (Schur)."""
    g = slice(0, GEOMETRY)
    cross, own = sums.normal[:, g, GEOMETRY:], sums.normal[:, GEOMETRY:, GEOMETRY:].copy()
    own[:, range(LIGHT), range(LIGHT)] += _ridge(own)
    solved = np.linalg.solve(own, np.concatenate([np.swapaxes(cross, 1, 2), sums.right[:, GEOMETRY:, None]], axis=2))
    normal = sums.normal[:, g, g] - cross @ solved[..., :GEOMETRY]
    right = sums.right[:, g] - (cross @ solved[..., GEOMETRY:])[..., 0]
    return normal, right
