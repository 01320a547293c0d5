"""Light that bends across a ring more than the model of its pixels knows: a reflection beside it.

Such light leaves a pattern in the residuals: smooth over the ring, where noise is not. Rings that show it are fitted further
with light of the fourth degree, whose uncertainty then stands in the covariance.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri

from dishmap.targets.adjust import LARGEST_TURN_RAD, Adjusted, Batch, by_target, moved_by, prior_terms
from dishmap.targets.edges import Poses, monomials
from dishmap.targets.light import GROUND, INK, LIGHT, TONE_RATIOS, light_columns, ridge, toned
from dishmap.targets.pixels import GEOMETRY, TONE, RingPixels, State, coverage_columns
from dishmap.targets.scene_noise import NoiseModel
from dishmap.targets.solve import solve_each, solve_scaled

Array = NDArray[Any]
Bool = NDArray[Any]

# The model's light is of the second degree (6 terms); what is looked for is of the third and fourth.
KNOWN_TERMS, DEGREE = 6, 4
EXTRA_TERMS = 9
# Share of clean targets that may be said to be lit unevenly, and that may be given more freedom of light than they need.
FALSE_PART, FREED_PART = 2e-3, 0.02
# Residuals count up to this many sigma, so that a speck of dirt is no pattern.
CLIP_SIGMAS = 5.0
# A pattern of less than this part of the contrast is the model's own error, which shows where noise is next to nothing.
LEAST_PATTERN = 5e-4
# With this many rings, a pattern that half of them show is no reflection but the lens or the print.
ENOUGH_RINGS = 8
TARGETS_AT_ONCE = 8
STEPS, CLIPPED_AGAIN = 4, 2


def pattern_of_residuals(fit: Adjusted, pixels: RingPixels, noise: NoiseModel, rows: Bool | slice = slice(None)) -> Array:
    """Chi-square (M,), with EXTRA_TERMS degrees of freedom for clean rings, of third and fourth degree patterns in residuals.

    rows: the rings that are asked for, all by default.
    """
    residual, used = fit.residual[rows], pixels.used[rows]
    scale = (fit.noise_variance[pixels.target[rows], None] * noise.inflation).astype(np.float32)
    variance = noise.variance(pixels.grey[rows] - residual).astype(np.float32) * scale
    seen = used if pixels.blocked is None else used & ~pixels.blocked[rows]
    weight = (seen & (residual * residual < np.float32(CLIP_SIGMAS**2) * variance)) / variance
    pull = weight * residual
    s, t = pixels.s[rows], pixels.t[rows]
    if pixels.shape is None:
        # blocks of four neighbours: smooth light is the same in all of them
        weight, pull = (v[:, ::4] + v[:, 1::4] + v[:, 2::4] + v[:, 3::4] for v in (weight, pull))
        s, t = s[:, ::4], t[:, ::4]
    terms = monomials(s, t, DEGREE)
    normal = ((terms * weight[:, None]) @ np.swapaxes(terms, 1, 2)).astype(float)
    square = _rise(normal, (terms @ pull[..., None])[..., 0].astype(float), KNOWN_TERMS)
    light = fit.sums.light[rows]
    return np.where(square > (LEAST_PATTERN * (light[:, 0] - light[:, 3])) ** 2 * normal[:, 0, 0], square, 0.0)


def _rise(normal: Array, right: Array, known: int) -> Array:
    """How much more of chi-square (M,) all terms explain than the first `known` do."""
    first = slice(0, known)
    whole = (right * solve_scaled(normal, right)).sum(axis=1)
    return np.maximum(whole - (right[:, first] * solve_scaled(normal[:, first, first], right[:, first])).sum(axis=1), 0.0)


def usual_pattern(squares: Array) -> float:
    """How many times larger than chance the patterns (M,) of all rings of a photograph are, 1 at least."""
    return max(float(np.median(squares)) / float(chdtri(EXTRA_TERMS, 0.5)), 1.0) if len(squares) >= ENOUGH_RINGS else 1.0


def chance_of_even_light(square: Array, target: NDArray[np.int64], count: int) -> Array:
    """Chance (count,) that an evenly lit target would show as large a pattern (M,) in one of its rings; `target` (M,) of each."""
    largest = np.zeros(count)
    np.maximum.at(largest, target, square)
    return np.asarray(np.bincount(target, minlength=count) * chdtrc(EXTRA_TERMS, largest))


def with_curved_light(batch: Batch, pixels: RingPixels, fit: Adjusted, targets: Bool, noise: NoiseModel) -> Adjusted:
    """`fit` with the chosen targets (T,) fitted further, with light of their rings up to the fourth degree."""
    chosen = np.flatnonzero(targets)
    if not len(chosen):
        return fit
    rotation, position = fit.poses.rotation.copy(), fit.poses.position_mm.copy()
    state = {name: getattr(fit.state, name).copy() for name in State.__dataclass_fields__}
    data, information = fit.data_information.copy(), fit.information.copy()
    for few in np.array_split(chosen, -(-len(chosen) // TARGETS_AT_ONCE)):
        poses, nuisances, data[few], information[few] = _fitted(batch, pixels, fit, few, noise)
        rotation[few], position[few] = poses.rotation, poses.position_mm
        for name, values in state.items():
            values[few] = getattr(nuisances, name)
    return replace(fit, poses=Poses(rotation, position), state=State(**state), data_information=data, information=information)


def _fitted(
    batch: Batch, pixels: RingPixels, fit: Adjusted, few: NDArray[np.int64], noise: NoiseModel
) -> tuple[Poses, State, Array, Array]:
    """Poses and state of the targets `few`, and their information without and with priors."""
    chosen = np.isin(np.arange(len(fit.poses)), few)
    rows, number = chosen[pixels.target], np.cumsum(chosen) - 1
    own = pixels.only(rows, number)
    some = replace(batch, curvature_per_mm=batch.curvature_per_mm[few])
    priors = replace(batch.priors, normal=batch.priors.normal[few], normal_sigma_rad=batch.priors.normal_sigma_rad[few])
    poses, state, light, variance = fit.poses.take(few), fit.state.take(few), fit.sums.light[rows], fit.noise_variance[few]
    for _ in range(STEPS):
        normal, right, light = _without_curved_light(some, own, poses, state, light, variance, noise)
        data = by_target(normal, own.target, len(few)) / variance[:, None, None]
        precision, pull = prior_terms(poses, state, priors)
        information = data + precision[:, :, None] * np.eye(GEOMETRY)
        delta = solve_scaled(information, by_target(right, own.target, len(few)) / variance[:, None] + pull)
        delta *= np.minimum(1.0, LARGEST_TURN_RAD / np.maximum(np.abs(delta[:, 3:6]).max(axis=1), 1e-12))[:, None]
        poses, state = moved_by(poses, state, delta)
    return poses, state, data, information


def _without_curved_light(
    batch: Batch, pixels: RingPixels, poses: Poses, state: State, light: Array, variance: Array, noise: NoiseModel
) -> tuple[Array, Array, Array]:
    """Normal equations (M, G, G), (M, G) of the geometry, light up to the fourth degree eliminated; and the light's first terms."""
    cover, geometry, _ = coverage_columns(slice(0, len(pixels.ring)), pixels, batch.rings, batch.maps(poses, pixels.patches), state)
    ratio = np.clip(light[:, 3:4] / np.maximum(light[:, :1], 1e-6), *TONE_RATIOS).astype(np.float32)
    bent, slope, geometry[:, TONE] = toned(np.clip(cover, 0, 1), ratio, np.asarray(state.log_gamma[pixels.target, None], np.float32))
    geometry[:, :TONE] *= slope[:, None]
    extra = monomials(pixels.s, pixels.t, DEGREE)[:, KNOWN_TERMS:]
    columns = np.concatenate([light_columns(pixels.s, pixels.t, bent), extra], axis=1).astype(float)
    seen = pixels.used if pixels.blocked is None else pixels.used & ~pixels.blocked
    spread = noise.variance((light[:, None] @ columns[:, :LIGHT])[:, 0])
    weight = seen / spread
    own = (columns * weight[:, None]) @ np.swapaxes(columns, 1, 2)
    own += ridge(own)[..., None] * np.eye(own.shape[1])
    grey = pixels.grey.astype(float)
    bound = CLIP_SIGMAS * np.sqrt(spread * variance[pixels.target, None])
    levels = _levels(columns, own, weight, grey)
    for _ in range(CLIPPED_AGAIN):
        model = (levels[:, None] @ columns)[:, 0]
        levels = _levels(columns, own, weight, model + np.clip(grey - model, -bound, bound))
    residual = np.clip(grey - (levels[:, None] @ columns)[:, 0], -bound, bound)
    step = levels[:, INK] - levels[:, GROUND]
    contrast = step[:, :1] + step[:, 1:2] * pixels.s + step[:, 2:] * pixels.t
    shape = geometry * (contrast * weight)[:, None]
    cross = shape @ np.swapaxes(columns, 1, 2)
    normal = shape @ np.swapaxes(geometry * contrast[:, None], 1, 2) - cross @ solve_each(own, np.swapaxes(cross, 1, 2))
    return normal, (shape @ residual[..., None])[..., 0], levels[:, :LIGHT]


def _levels(columns: Array, own: Array, weight: Array, grey: Array) -> Array:
    """Light levels (M, L) of weighted least squares with normal matrix `own`."""
    return np.asarray(solve_each(own, columns @ (weight * grey)[..., None])[..., 0])
