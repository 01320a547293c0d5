"""Least-squares fit of two bands to the raw pixels at each node of a grid, many nodes at once, each on its own.

Free at a node: offset and half width of each band, slope and bend of its level line (held by what the neighbours say of them), blur, and
light: a plane of ground and a level of ink that is shaded alike. Gauss-Newton with limited steps, and weights against what hides the print.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.grid_pixels import NodePixels
from dishmap.targets.light import TAPER, TINY
from dishmap.targets.pixels import normal_distribution
from dishmap.targets.solve import solve_each, solve_scaled

Array = NDArray[Any]
# float32: enough for pixels
Single = NDArray[Any]
Bool = NDArray[Any]

# Parameters of a node, each for band 0 and 1, in lattice units; blur in px. A coarse fit of lines stops short of slopes and bends.
OFFSET, HALF, BLUR, SLOPE, BEND, INNER = slice(0, 2), slice(2, 4), 4, slice(5, 7), slice(7, 9), slice(9, 11)
HELD, PLAIN, NESTED = 5, 9, 11
# Ground, its two slopes, ink.
LIGHT = 4
# No edge is felt beyond.
FARTHEST_BLURS = np.float32(6.0)
# Bands nearly at right angles need no correction for the angle between them; crossings hardly, as what is left out is the same on both
# sides of the middle.
UPRIGHT, UPRIGHT_CROSSING = 0.005, 0.05
LARGEST_STEP_PX, LARGEST_PART = 1.0, 0.3
SHARPEST_PX, WIDEST_PX = 0.35, 10.0
# Settled when what a Gauss-Newton step leaves to do is a small part of sigma, or of a pixel: see `targets.adjust`.
LEFT_BLURS, STEP_SIGMAS, STEP_PX, SETTLED_PX = 6.0, 0.04, 1e-4, 0.3
INK_SHARES = (0.0, 0.98)
ROOT_2_PI = np.float32(np.sqrt(2 * np.pi))


@dataclass(frozen=True)
class NodePriors:
    """Mean (n, G) and precision (n, G, G) of the parameters beforehand."""

    mean: Array
    precision: Array


@dataclass(frozen=True)
class NodeFit:
    """Result for n nodes.

    x (n, G): parameters; ink_share (n,): ink over ground; light (n, 4): ground, slopes, ink; normal (n, G + 4, G + 4): of the pixels
    alone, in units of 1 / variance of the noise model; prior (n, G, G), mean (n, G): precision and mean beforehand; converged (n,);
    weight, square (n,): sums of weights and of weighted squares of residuals after the step; kept, whole (n,): share of the edges' length
    that was used, of all and of that which was looked at; residual, model, robust, cover (n, P): before the step; white (n, P): residuals
    after it in sigmas of the noise.
    """

    x: Array
    ink_share: Array
    light: Array
    normal: Array
    prior: Array
    mean: Array
    converged: Bool
    weight: Array
    square: Array
    kept: Array
    whole: Array
    residual: Single
    model: Single
    robust: Single
    cover: Single
    white: Single


@dataclass(frozen=True)
class Weights:
    """Noise variance = base + slope * grey level; not `known`: in units that are scaled by what is left.

    cut: residuals beyond so many sigmas and such a part of the contrast are left out; None: none is.
    """

    base: float
    slope: float
    cut: tuple[float, float] | None
    known: bool = True


def _band(pixels: NodePixels, x: Array, band: int, half: Array) -> tuple[Single, Single, Single, Single]:
    """Coverage of one band (n, P), and its derivatives by offset, half width and blur."""
    scale = pixels.scale[band]
    offset, half, blur = (np.asarray(value, np.float32)[:, None] for value in (x[:, band], half, x[:, BLUR]))
    if x.shape[1] == HELD:
        middle = pixels.across[band] - offset
    else:
        slope, bend = (np.asarray(x[:, part.start + band], np.float32)[:, None] for part in (SLOPE, BEND))
        along = pixels.across[1 - band]
        middle = along * (np.float32(0.5) * bend)
        middle += slope
        middle *= along
        middle += offset
        np.subtract(pixels.across[band], middle, out=middle)
    middle *= scale
    width = half * scale
    inverse = 1 / blur
    pull = np.float32(0.5) * blur * blur * pixels.curve[band]
    sides = []
    for side, sign in enumerate((np.float32(1), np.float32(-1))):
        z = width + middle if side == 0 else width - middle
        z *= inverse
        np.clip(z, -FARTHEST_BLURS, FARTHEST_BLURS, out=z)
        z *= 1 + sign * (pixels.bend[band, side] * blur) * z
        z += sign * (pull[side] * inverse)
        bell = z * z
        bell *= np.float32(-0.5)
        np.exp(bell, out=bell)
        sides.append((z, bell, normal_distribution(z, bell)))
    (z_low, bell_low, low), (z_high, bell_high, high) = sides
    low += high
    low -= 1
    inverse = inverse / ROOT_2_PI
    bell_low *= inverse
    bell_high *= inverse
    z_low *= bell_low
    z_high *= bell_high
    z_low += z_high
    np.negative(z_low, out=z_low)
    by_half = bell_low + bell_high
    by_half *= scale
    bell_high -= bell_low
    bell_high *= scale
    return low, bell_high, by_half, z_low


def _meeting(pixels: NodePixels, x: Array, bands: Sequence[tuple[Single, ...]], upright: float = UPRIGHT) -> Single:
    """Coverage (n, P) common to two bands.

    Two half planes under one round blur are a bivariate normal distribution whose correlation is the cosine between their normals; the
    series in that cosine (Pearson 1900) is that of Hermite polynomials, the first two of which the derivatives hold.
    """
    (one, one_offset, _, one_blur), (two, two_offset, _, two_blur) = bands
    both = one * two
    if np.abs(pixels.skew).max(initial=0) > upright:
        first = one_offset * two_offset
        first /= pixels.scale[0]
        first /= pixels.scale[1]
        second = one_blur * two_blur
        second *= pixels.skew
        second *= np.float32(0.5)
        first += second
        first *= pixels.skew
        first *= np.asarray(x[:, BLUR] ** 2, np.float32)[:, None]
        both += first
    return both


def coverage(pixels: NodePixels, x: Array, crossing: bool, out: Single) -> Single:
    """Ink coverage (n, P) of all nodes and its derivative by the parameters, put into `out` (n, G, P)."""
    bands = [_band(pixels, x, k, x[:, HALF][:, k]) for k in (0, 1)]
    cover = _meeting(pixels, x, bands, UPRIGHT_CROSSING if crossing else UPRIGHT)
    if crossing:
        np.subtract(bands[0][0], cover, out=cover)
        cover += bands[1][0]
    for k in (0, 1):
        part = 1 - bands[1 - k][0] if crossing else bands[1 - k][0]
        _, by_offset, by_half, by_blur = bands[k]
        np.multiply(by_offset, part, out=out[:, k])
        np.multiply(by_half, part, out=out[:, HALF.start + k])
        if x.shape[1] > HELD:
            along, slope, bend = pixels.across[1 - k], out[:, SLOPE.start + k], out[:, BEND.start + k]
            np.multiply(out[:, k], along, out=slope)
            np.multiply(slope, along, out=bend)
            bend *= np.float32(0.5)
        by_blur *= part
        if k:
            out[:, BLUR] += by_blur
        else:
            out[:, BLUR] = by_blur
    if x.shape[1] == NESTED:
        _take_out_light(pixels, x, cover, out)
    return cover


def _take_out_light(pixels: NodePixels, x: Array, cover: Single, out: Single) -> None:
    """Subtract the light rectangle inside, in place."""
    bands = [_band(pixels, x, k, x[:, INNER][:, k]) for k in (0, 1)]
    cover -= _meeting(pixels, x, bands)
    for k in (0, 1):
        part = bands[1 - k][0]
        _, by_offset, by_half, by_blur = bands[k]
        along = pixels.across[1 - k]
        by_offset *= part
        out[:, k] -= by_offset
        by_offset *= along
        out[:, SLOPE.start + k] -= by_offset
        by_offset *= along
        by_offset *= np.float32(0.5)
        out[:, BEND.start + k] -= by_offset
        np.multiply(by_half, -part, out=out[:, INNER.start + k])
        by_blur *= part
        out[:, BLUR] -= by_blur


def light_rows(pixels: NodePixels, cover: Single, ink_share: Array, out: Single) -> None:
    """Derivative of the pixels by the light levels, put into `out` (n, LIGHT, P): ink is shaded as the ground is."""
    np.subtract(1, cover, out=out[:, 0])
    shaded = cover * np.asarray(ink_share, np.float32)[:, None]
    shaded += out[:, 0]
    np.multiply(shaded, pixels.s, out=out[:, 1])
    np.multiply(shaded, pixels.t, out=out[:, 2])
    out[:, 3] = cover


def solve_light(rows: Single, weight: Single) -> Array:
    """Best light levels (n, LIGHT) for rows (n, LIGHT + 1, P) of the levels and the grey, with weights (n, P)."""
    sums = ((rows * weight[:, None]) @ np.swapaxes(rows, 1, 2)).astype(float)
    normal = sums[:, :LIGHT, :LIGHT]
    normal[:, range(LIGHT), range(LIGHT)] += 1e-6 * np.maximum(np.trace(normal, axis1=1, axis2=2), 1e-9)[:, None]
    return solve_each(normal, sums[:, :LIGHT, LIGHT:])[..., 0]


def levels_at(pixels: NodePixels, x: Array, ink_share: Array, crossing: bool) -> tuple[Array, Single, Single]:
    """Best light levels (n, LIGHT) at given parameters, the coverage and the residuals (n, P) there."""
    every = np.empty((len(x), LIGHT + 1, pixels.s.shape[1]), np.float32)
    cover = coverage(pixels, x, crossing, np.empty((len(x), x.shape[1], pixels.s.shape[1]), np.float32))
    light_rows(pixels, cover, ink_share, every)
    every[:, -1] = pixels.grey
    light = solve_light(every, pixels.used.astype(np.float32))
    return light, cover, pixels.grey - (light[:, None].astype(np.float32) @ every[:, :-1])[:, 0]


def one_step(
    pixels: NodePixels, x: Array, ink_share: Array, priors: NodePriors, weights: Weights, crossing: bool, light: Array | None = None
) -> NodeFit:
    """One pass over the pixels of n nodes and one Gauss-Newton step; light (n, LIGHT): levels to start from, the best ones if None."""
    count, size = x.shape
    every = np.empty((count, size + LIGHT + 1, pixels.s.shape[1]), np.float32)
    cover = coverage(pixels, x, crossing, every[:, :size])
    light_rows(pixels, cover, ink_share, every[:, size:])
    every[:, -1] = pixels.grey
    used = pixels.used.astype(np.float32)
    if light is None:
        light = solve_light(every[:, size:], used)
    single = light.astype(np.float32)
    model = (single[:, None] @ every[:, size:-1])[:, 0]
    residual = np.subtract(pixels.grey, model)
    variance = np.maximum(np.float32(weights.base) + np.float32(weights.slope) * np.maximum(model, 0), TINY)
    # the ground minus the ink at each pixel
    contrast = single[:, 1:2] * pixels.s + single[:, 2:3] * pixels.t
    contrast *= (np.asarray(ink_share, np.float32) - 1)[:, None]
    contrast += single[:, 3:4] - single[:, :1]
    robust = used if weights.cut is None else _tapered(residual, _cut(residual, used, variance, light, weights), used)
    shares = _shares(pixels, every, robust, used) if weights.known else (np.ones(count), np.ones(count))
    root = np.sqrt(robust / variance)
    every[:, -1] = residual
    contrast *= root
    every[:, :size] *= contrast[:, None]
    every[:, size:] *= root[:, None]
    # not a product of one array with itself, for which a routine is called that is several times slower on small matrices
    sums = (every[:, :-1] @ np.swapaxes(every, 1, 2)).astype(float)
    weight = robust.sum(axis=1, dtype=float)
    noise = np.ones(count)
    if not weights.known:
        noise = np.maximum(np.einsum("np,np->n", every[:, -1], every[:, -1]) / np.maximum(weight - size - LIGHT, 1.0), 1e-9)
    delta, sigmas = _solved(sums, x, priors, noise)
    new, converged = _moved(pixels, x, delta[:, :size], sigmas)
    white = every[:, -1] - (delta[:, None].astype(np.float32) @ every[:, :-1])[:, 0]
    square = np.einsum("np,np->n", white, white).astype(float)
    light = light + delta[:, size:]
    ratio = np.clip(light[:, 3] / np.maximum(light[:, 0], 1e-3), *INK_SHARES)
    return NodeFit(
        x=new,
        ink_share=ratio,
        light=light,
        normal=sums[:, :, :-1],
        prior=priors.precision,
        mean=priors.mean,
        converged=converged,
        weight=weight,
        square=square,
        kept=shares[0],
        whole=shares[1],
        residual=residual,
        model=model,
        robust=robust,
        cover=cover,
        white=white,
    )


def _shares(pixels: NodePixels, columns: Single, robust: Single, used: Single) -> tuple[Array, Array]:
    """Shares (n,) of the edges' length that were used: of all, and of what was looked at."""
    edge = np.abs(columns[:, 0]) / np.maximum(pixels.scale[0], TINY) + np.abs(columns[:, 1]) / np.maximum(pixels.scale[1], TINY)
    seen = (edge * robust).sum(axis=1)
    kept, whole = (seen / np.maximum((edge * some).sum(axis=1), TINY) for some in (pixels.expected, used))
    return kept.astype(float), whole.astype(float)


def _cut(residual: Single, used: Single, variance: Single, light: Array, weights: Weights) -> Single:
    assert weights.cut is not None
    sigmas, part = weights.cut
    contrast = np.asarray(part * np.abs(light[:, :1] - light[:, 3:4]), np.float32)
    return np.maximum(np.maximum(np.float32(sigmas) * np.sqrt(variance), contrast), 1)


def _tapered(residual: Single, cut: Single, used: Single) -> Single:
    """Weights that are 1 up to TAPER of the cut and fall to 0 at the cut."""
    x = residual / cut
    if not (np.abs(x) * used > TAPER).any():
        return used
    return np.square(np.clip((1 - x * x) * np.float32(1 / (1 - TAPER**2)), 0, 1)) * used


def _solved(sums: Array, x: Array, priors: NodePriors, noise: Array) -> tuple[Array, Array]:
    """Step (n, G + LIGHT) of the parameters and the light, and its size in sigmas of them (n,)."""
    size = x.shape[1]
    normal, right = sums[:, :, :-1] / noise[:, None, None], sums[:, :, -1] / noise[:, None]
    normal[:, :size, :size] += priors.precision
    normal[:, range(size, size + LIGHT), range(size, size + LIGHT)] *= 1 + 1e-9
    right[:, :size] -= (priors.precision @ (x - priors.mean)[..., None])[..., 0]
    delta = solve_scaled(normal, right)
    sigmas = np.sqrt(np.maximum((delta * (normal @ delta[..., None])[..., 0]).sum(axis=1) / size, 0))
    return delta, sigmas


def _moved(pixels: NodePixels, x: Array, delta: Array, sigmas: Array) -> tuple[Array, Bool]:
    step_px = pixels.unit_px
    move = np.abs(delta[:, OFFSET]).max(axis=1) * step_px + np.abs(delta[:, HALF]).max(axis=1) * step_px + np.abs(delta[:, BLUR])
    left = np.minimum(move / (LEFT_BLURS * x[:, BLUR]), 1.0)
    converged = ((sigmas * left < STEP_SIGMAS) & (move < SETTLED_PX)) | (move < STEP_PX)
    largest = np.maximum(np.abs(delta[:, OFFSET]).max(axis=1) * step_px, 1e-9)
    new = x + delta * np.minimum(1.0, LARGEST_STEP_PX / largest)[:, None]
    for part in (HALF, INNER):
        if part.start < x.shape[1]:
            new[:, part] = np.clip(new[:, part], (1 - LARGEST_PART) * x[:, part], (1 + LARGEST_PART) * x[:, part])
    new[:, BLUR] = np.clip(x[:, BLUR] * np.exp(np.clip(delta[:, BLUR] / x[:, BLUR], -0.5, 0.5)), SHARPEST_PX, WIDEST_PX)
    return new, np.asarray(converged & np.isfinite(new).all(axis=1))
