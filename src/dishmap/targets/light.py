"""The light of a ring: levels of ground and ink, the tone curve between them, and which pixels show neither.

The levels enter the model of the pixels linearly, so that they are solved for at every pass and never iterated.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.solve import products, solve_each

Array = NDArray[Any]
Single = NDArray[Any]

# Light parameters of a ring: ground level and slopes, ink level and slopes, bend (grey levels, in local units).
LIGHT = 9
GROUND, INK, BEND = slice(0, 3), slice(3, 6), slice(6, 9)
TINY = np.float32(1e-6)
# Share of the cut up to which a residual keeps its full weight.
TAPER = np.float32(0.65)
# Ink over ground, as far as a tone curve is followed.
TONE_RATIOS = (0.02, 0.95)


def toned(cover: Single, dark_over_light: Single, log_gamma: Single) -> tuple[Single, Single, Single]:
    """Coverage (M, n) as a tone curve shows it, its derivative by the true coverage, and by log gamma.

    With levels G of the ground and K of the ink, light adds as G^gamma (1 - c) + K^gamma c; the level recorded is the 1/gamma
    power of that, and lies the returned part of the way from G to K. dark_over_light (M, 1) is K / G.
    """
    gamma = np.exp(log_gamma)
    power = dark_over_light**gamma
    scale = 1 / (1 - dark_over_light)
    light = cover * (power - 1)
    light += 1
    log_level = np.log(light)
    log_level *= 1 / gamma
    level = np.exp(log_level)
    by_light = np.divide(level, light, out=light)
    log_level *= level * scale
    log_level -= cover * by_light * (scale * power * np.log(dark_over_light))
    return (1 - level) * scale, by_light * ((1 - power) * scale / gamma), log_level


def light_columns(s: Single, t: Single, cover: Single, out: Single | None = None) -> Single:
    """Derivative of the pixels by the ring's light levels (M, L, n): ground and ink, each level and two slopes, and the bend."""
    if out is None:
        out = np.empty((len(cover), LIGHT, cover.shape[1]), np.float32)
    np.subtract(1, cover, out=out[:, 0])
    out[:, 3] = cover
    for column, place in ((1, s), (2, t)):
        np.multiply(out[:, 0], place, out=out[:, column])
        np.multiply(out[:, 3], place, out=out[:, column + 3])
    for column, first, second in ((6, s, s), (7, s, t), (8, t, t)):
        np.multiply(first, second, out=out[:, column])
    return out


def solve_light(weighted: Single) -> Array:
    """Best light levels (M, L) of each ring for a given coverage; slopes lean weakly towards zero so that tiny rings hold.

    weighted (M, L + 1, n): the columns of `light_columns` and the grey levels, times the roots of the weights.
    """
    sums = products(weighted)
    normal = sums[:, :LIGHT, :LIGHT]
    normal[:, range(LIGHT), range(LIGHT)] += ridge(normal)
    return solve_each(normal, sums[:, :LIGHT, LIGHT:])[..., 0]


def ridge(normal: Array) -> Array:
    """What is added to the diagonals of normal matrices (M, L, L) of light levels: (M, 1)."""
    return 1e-7 * np.maximum(np.trace(normal, axis1=1, axis2=2), 1e-9)[:, None]


def light_and_weights(rows: Single, seen: Single, used: Single, cut: Single | None) -> tuple[Array, Single]:
    """Light levels (M, L) and weights (M, n) of pixels, from the rows of `solve_light` with weights `used` (0 or 1).

    `seen` are weights of what is to be looked at, a part of `used`; `cut` (M, 1) is that of `Weighting`.
    """

    def levels(weight: Single) -> tuple[Array, Single]:
        light = solve_light(rows if weight is used else rows * np.sqrt(weight)[:, None])
        return light, rows[:, LIGHT] - (light[:, None].astype(np.float32) @ rows[:, :LIGHT])[:, 0]

    light, residual = levels(seen)
    if cut is None:
        return light, seen
    robust = _tapered(residual, cut, seen)
    if robust is not seen:
        # the levels were found with the outliers in; once more without them
        light, residual = levels(robust)
        robust = _tapered(residual, cut, seen)
    return light, robust


def dark_over_light(cover: Single, grey: Single, used: Single) -> Single:
    """Ink level over ground level (M, 1) of each ring, from a fit of the two levels alone; it only bends the tone curve."""
    ink = cover * used
    a, b, c = used.sum(axis=1), ink.sum(axis=1), np.einsum("mn,mn->m", ink, cover)
    p, q = np.einsum("mn,mn->m", grey, used), np.einsum("mn,mn->m", grey, ink)
    determinant = np.maximum(a * c - b * b, TINY)
    ground, step = (c * p - b * q) / determinant, (a * q - b * p) / determinant
    ratio = (ground + step) / np.maximum(ground, TINY)
    return np.clip(ratio, *TONE_RATIOS)[:, None].astype(np.float32)


def _tapered(residual: Single, cut: Single, used: Single) -> Single:
    """Weights that are 1 up to TAPER of the cut and fall to 0 at the cut, so that Gaussian noise loses nothing."""
    x = residual / cut
    if not (np.abs(x) * used > TAPER).any():
        return used
    return np.square(np.clip((1 - x * x) * np.float32(1 / (1 - TAPER**2)), 0, 1)) * used
