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

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.edges import MOTION_TERMS, LocalMaps, Patches, edge_distance, monomials
from dishmap.targets.light import GROUND, INK, LIGHT, TINY, dark_over_light, light_and_weights, light_columns, ridge, toned
from dishmap.targets.pattern import TargetKind
from dishmap.targets.solve import products, solve_each

Array = NDArray[Any]
Single = NDArray[Any]
Bool = NDArray[Any]
# Columns of pixels, the circle whose edge they are at, and which circles (C,) are near them.
Part = tuple[slice, int, Bool]

# Geometry parameters of a target: 3 moves (mm), 3 turns (rad), edge offset (mm), edge offset (px), blur s (px), log gamma.
GEOMETRY = 10
ALONG, OFFSET_MM, OFFSET_PX, BLUR, TONE = 2, 6, 7, 8, 9
# What pixels may hardly tell apart: ink that lies outwards by some px or by some mm, where a target faces the camera; for a disc both from
# a move along the line of sight.
ALIKE = (OFFSET_PX, ALONG, OFFSET_MM)
# Half width of the band of pixels used, in blurs: beyond it the edge changes the pixel by under 0.2 % of the contrast.
BAND_BLURS, BAND_EXTRA_PX = 2.5, 0.5
# Above this product of curvature and blur the series for curved edges leaves more than 0.001 px; see tests.
LARGEST_CURVED = 0.22
FINE_FACTOR, FINE_BLUR_PX = 3, 0.4
# A circle at least this many blurs away covers a pixel wholly or not at all: what is left is under 3e-5 of the contrast.
FAR_BLURS = 4.0
# A lens that changes its scale over the blur shifts edges by as much as half the change times the blur squared; where that is less
# than this the plane is taken as affine about each pixel.
LARGEST_SHIFT_PX = 2e-4
# Pixels handled at once: fewer cost the overhead of numpy's calls, more leave the processor's cache.
PIXELS_AT_ONCE = 40000
# Halves of the coefficients of t^5 to t in formula 7.1.26 of Abramowitz and Stegun, Handbook of Mathematical Functions.
ERF_TERMS = (0.5307027145, -0.7265760135, 0.7107068705, -0.142248368, 0.127414796)


@dataclass(frozen=True)
class Rings:
    """Rings of a kind: circle centres (R, C, 2), radii (R, C) in mm, ink sign (R, C): +1 dark inside, -1 light, 0 unused."""

    center_mm: Single
    radius_mm: Single
    sign: Single

    def __len__(self) -> int:
        return len(self.radius_mm)

    @property
    def gap_mm(self) -> Single:
        """Least distance (R, C, C) between the edges of two circles of a ring; infinite from or to an unused one."""
        apart = np.linalg.norm(self.center_mm[:, :, None] - self.center_mm[:, None], axis=3)
        mine, other = self.radius_mm[:, :, None], self.radius_mm[:, None]
        used = (self.sign[:, :, None] != 0) & (self.sign[:, None] != 0)
        return np.where(used, np.maximum(np.abs(mine - other) - apart, apart - mine - other), np.float32(np.inf))

    @property
    def ink_around(self) -> Single:
        """Ink (R, C, C) that the second circle lays over the edge of the first: its sign if it holds the first, else 0."""
        apart = np.linalg.norm(self.center_mm[:, :, None] - self.center_mm[:, None], axis=3)
        holds = apart + self.radius_mm[:, :, None] <= self.radius_mm[:, None]
        return holds * self.sign[:, None]


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
    shape: (H, W) of each ring's full window if the pixels are a whole window (fine rings), else None: blocks of 2x2, in the
    order of the circle whose edge they are at. ends (C,): the column after each circle's last; clear_px (M, C, C): how far all
    pixels at the first circle's edge are from the second's, at least.
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
    ends: tuple[int, ...] = ()
    clear_px: Single | None = None
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
        names = ("ring", "s", "t", "grey", "used", "clear_px", "blocked", "saturated")
        mine: dict[str, Any] = {n: None if getattr(self, n) is None else getattr(self, n)[rows] for n in names}
        return replace(self, patches=patches, **mine)

    def every(self, step: int) -> RingPixels:
        """Keep every `step`-th pixel, for the first coarse steps of a fit (bands only)."""
        if step == 1 or self.shape is not None:
            return self
        s, t, grey, used = (np.ascontiguousarray(values[:, ::step]) for values in (self.s, self.t, self.grey, self.used))
        return replace(self, s=s, t=t, grey=grey, used=used, ends=tuple(-(-end // step) for end in self.ends))

    def parts(self, rows: slice, blur_px: float) -> list[Part]:
        """The parts of rings `rows`: the columns at each circle's edge, and which circles are not FAR_BLURS away there."""
        assert self.clear_px is not None
        near = self.clear_px[rows].min(axis=0, initial=np.inf) < FAR_BLURS * blur_px
        return [(slice(a, b), i, near[i]) for i, (a, b) in enumerate(zip((0, *self.ends), self.ends, strict=False))]


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
    second: Single | None
    motion: Single
    degree: int
    center_mm: Single
    radius_mm: Single
    sign: Single
    ink_around: Single
    offset_px: Single
    blur_px: Single


def _look(rows: slice, pixels: RingPixels, rings: Rings, maps: LocalMaps, state: State) -> _Look:
    target, ring = pixels.target[rows], pixels.ring[rows]
    shift_px = 0.5 * maps.bend_per_px[rows] * state.blur_px[target] ** 2
    single = [np.asarray(v[target], np.float32) for v in (state.offset_mm, state.offset_px, state.blur_px)]
    sign = rings.sign[ring]
    return _Look(
        maps.plane[rows].astype(np.float32),
        maps.second[rows].astype(np.float32) if shift_px.max(initial=0.0) > LARGEST_SHIFT_PX else None,
        maps.motion[rows].astype(np.float32),
        maps.degree,
        rings.center_mm[ring],
        # ink spread moves dark edges out and light edges in
        rings.radius_mm[ring] + sign * single[0][:, None],
        sign,
        rings.ink_around[ring],
        single[1],
        single[2],
    )


def _coverage(look: _Look, s: Single, t: Single, blur_px: Single, parts: list[Part], out: Single) -> tuple[Single, Single]:
    """Ink coverage (M, n) and each circle's edge weight (M, C, n); the derivative by the geometry is put into `out` (M, G, n)."""
    mono = monomials(s, t, look.degree)
    six = look.plane @ mono
    second = None if look.second is None else look.second @ mono
    cover = np.empty(s.shape, np.float32)
    edges = np.zeros((len(s), look.radius_mm.shape[1], s.shape[1]), np.float32)
    pull = np.zeros((len(s), 2, 1, s.shape[1]), np.float32)
    out[:, 6:] = 0
    for columns, own, near in parts:
        # circles far from an edge hold all of it, or nothing
        cover[:, columns] = (look.ink_around[:, own] * ~near).sum(axis=1, keepdims=True)
        into = (cover[:, columns], edges[..., columns], pull[:, :, 0, columns], out[..., columns])
        for c in np.flatnonzero(near):
            _add_edge(look, int(c), six[..., columns], None if second is None else second[..., columns], blur_px, into)
    motion = look.motion @ mono[:, None, :MOTION_TERMS]
    motion *= pull
    np.add(motion[:, 0], motion[:, 1], out=out[:, :6])
    return cover, edges


def _add_edge(
    look: _Look, c: int, six: Single, second: Single | None, blur_px: Single, into: tuple[Single, Single, Single, Single]
) -> None:
    """Add circle `c` to coverage, edge weights, pull (M, 2, n) on the image, and the derivatives by offsets and blur.

    The work is done in place: passes over memory are what it costs.
    """
    cover, edges, pull, out = into
    sign, b = look.sign[:, c, None], blur_px[:, None]
    d, nu, nv, px_per_mm, kb = edge_distance(six, look.center_mm[:, c], look.radius_mm[:, c], second)
    kb *= b
    square = kb * kb
    shift = square * np.float32(0.75)
    shift += 1
    shift *= kb
    shift *= np.float32(0.5) * b
    d -= shift
    d += sign * look.offset_px[:, None]
    square *= np.float32(0.25)
    square += 1
    square *= b
    inverse = np.divide(1, square, out=square)
    d *= inverse
    density = np.multiply(d, d, out=shift)
    density *= np.float32(-0.5)
    np.exp(density, out=density)
    cover += sign * normal_distribution(d, density)
    density *= inverse
    density *= np.abs(sign) * np.float32(0.3989423)
    edges[:, c] = density
    out[:, OFFSET_PX] += density
    px_per_mm *= density
    out[:, OFFSET_MM] += px_per_mm
    density *= sign
    nu *= density
    nv *= density
    pull[:, 0] += nu
    pull[:, 1] += nv
    d += kb
    d *= density
    out[:, BLUR] -= d


def normal_distribution(z: Single, bell: Single) -> Single:
    """Phi(z) to 1e-7, given bell = exp(-z^2 / 2): formula 7.1.26 of Abramowitz and Stegun, several times faster than ndtr."""
    t = np.abs(z)
    t *= np.float32(0.3275911 / np.sqrt(2))
    t += 1
    np.divide(1, t, out=t)
    out = t * np.float32(ERF_TERMS[0])
    for term in ERF_TERMS[1:]:
        out += np.float32(term)
        out *= t
    out *= bell
    # here is the tail beyond |z|
    np.subtract(np.float32(0.5), out, out=out)
    np.copysign(out, z, out=out)
    out += np.float32(0.5)
    return out


def coverage_columns(
    rows: slice, pixels: RingPixels, rings: Rings, maps: LocalMaps, state: State, out: Single | None = None
) -> tuple[Single, Single, Single]:
    """Ink coverage of rings `rows` (M, n), its derivative by the geometry (M, G, n), edge weights of circles (M, C, n).

    `maps` are those of `pixels.patches`; `state` holds the batch's targets; the derivative is put into `out` if given.
    """
    look = _look(rows, pixels, rings, maps, state)
    s, t = pixels.s[rows], pixels.t[rows]
    if out is None:
        out = np.empty((len(s), GEOMETRY, s.shape[1]), np.float32)
    if pixels.shape is not None:
        cover, out[:], edges = _fine_columns(rows, pixels, look)
    else:
        cover, edges = _coverage(look, s, t, look.blur_px, pixels.parts(rows, float(look.blur_px.max(initial=0))), out)
    return cover, out, edges


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
    whole = (slice(None), 0, np.ones(look.radius_mm.shape[1], bool))
    columns = np.empty((len(s), GEOMETRY, s.shape[1]), np.float32)
    cover, edges = _coverage(look, s * ~outside, t * ~outside, np.full(len(blur), FINE_BLUR_PX, np.float32), [whole], columns)
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


def batches(rings: int, pixels: int) -> list[slice]:
    """Equal shares of `rings` with `pixels` each, small enough for the processor's cache."""
    count = max(1, min(rings, -(-rings * pixels // PIXELS_AT_ONCE)))
    ends = [rings * i // count for i in range(count + 1)]
    return [slice(a, b) for a, b in pairwise(ends)]


def ring_sums(pixels: RingPixels, rings: Rings, maps: LocalMaps, state: State, weighting: Weighting) -> tuple[RingSums, Single]:
    """One pass over the pixels: normal equations of every ring at the present state, and the residuals (M, n) in grey levels."""
    parts, residuals = [], []
    for rows in batches(*pixels.s.shape):
        sums, residual = _sums(rows, pixels, rings, maps, state, weighting)
        parts.append(sums)
        residuals.append(residual)
    fields = RingSums.__dataclass_fields__
    return RingSums(*(np.concatenate([getattr(p, f) for p in parts]) for f in fields)), np.concatenate(residuals)


def _sums(rows: slice, pixels: RingPixels, rings: Rings, maps: LocalMaps, state: State, weighting: Weighting) -> tuple[RingSums, Single]:
    used, grey = pixels.used[rows].astype(np.float32), pixels.grey[rows]
    s, t = pixels.s[rows], pixels.t[rows]
    # geometry, light and grey level of each pixel, filled and weighted in place
    every = np.empty((len(s), GEOMETRY + LIGHT + 1, s.shape[1]), np.float32)
    cover, geometry, edges = coverage_columns(rows, pixels, rings, maps, state, every[:, :GEOMETRY])
    log_gamma = np.asarray(state.log_gamma[pixels.target[rows], None], np.float32)
    bent, slope, geometry[:, TONE] = toned(np.clip(cover, 0, 1), dark_over_light(cover, grey, used), log_gamma)
    light_columns(s, t, bent, every[:, GEOMETRY:-1])
    every[:, -1] = grey
    every[:, GEOMETRY:] *= used[:, None]
    cut = None if weighting.cut is None else weighting.cut[rows, None].astype(np.float32)
    light, robust = light_and_weights(every[:, GEOMETRY:], used if pixels.blocked is None else used * ~pixels.blocked[rows], used, cut)
    single = light.astype(np.float32)
    model = (single[:, None] @ every[:, GEOMETRY:-1])[:, 0]
    residual = every[:, -1] - model
    variance = np.maximum(np.float32(weighting.base) + np.float32(weighting.slope) * np.maximum(model, 0), TINY)
    root = np.sqrt(robust / variance)
    step = single[:, INK] - single[:, GROUND]
    contrast = (step[:, :1] + step[:, 1:2] * s + step[:, 2:] * t) * root
    geometry[:, TONE] *= contrast
    contrast *= slope
    geometry[:, :TONE] *= contrast[:, None]
    every[:, -1] = residual
    every[:, GEOMETRY:] *= root[:, None]
    sums = products(every, ALIKE)
    kept = np.ones(edges.shape[:2])
    if robust is not used:
        whole = (edges @ used[..., None])[..., 0]
        # unused circles, and rings without pixels, count as whole
        kept = np.where(whole > TINY, (edges @ robust[..., None])[..., 0] / np.maximum(whole, TINY), 1.0).astype(float)
    return RingSums(sums[:, :-1, :-1], sums[:, :-1, -1], light, sums[:, -1, -1], robust.sum(axis=1, dtype=float), kept), residual


def without_light(sums: RingSums) -> tuple[Array, Array]:
    """Normal equations of the geometry alone (M, G, G), (M, G), with each ring's own light levels eliminated (Schur)."""
    g = slice(0, GEOMETRY)
    cross, own = sums.normal[:, g, GEOMETRY:], sums.normal[:, GEOMETRY:, GEOMETRY:].copy()
    own[:, range(LIGHT), range(LIGHT)] += ridge(own)
    solved = solve_each(own, np.concatenate([np.swapaxes(cross, 1, 2), sums.right[:, GEOMETRY:, None]], axis=2))
    normal = sums.normal[:, g, g] - cross @ solved[..., :GEOMETRY]
    right = sums.right[:, g] - (cross @ solved[..., GEOMETRY:])[..., 0]
    return normal, right
