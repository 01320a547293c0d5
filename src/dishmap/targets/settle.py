"""What is settled once all targets are fitted: uneven light, the spread of normals, and which of two mirrored normals is right."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.adjust import Adjusted, Batch, Priors, by_target, prior_terms, with_other_priors, with_rest
from dishmap.targets.edges import Poses
from dishmap.targets.glare import FALSE_PART, FREED_PART, chance_of_even_light, pattern_of_residuals, usual_pattern, with_curved_light
from dishmap.targets.pixels import GEOMETRY, RingPixels, State, Weighting
from dishmap.targets.scene_noise import NoiseModel
from dishmap.targets.sensitivity import mirrored, mirrored_normals
from dishmap.targets.stages import FIRST_NORMAL_SIGMA_RAD, Fit, Shared, residual_cut, spread_of_normals
from dishmap.transforms import angle_between_rad, rotation_from_vector

Array = NDArray[Any]
Bool = NDArray[Any]

# Two poses whose chi-squares differ by less than this (3 sigma, however far apart they are) cannot be told apart.
MIRROR_CHI_SQUARE = 9.0
MIRROR_STEPS, SETTLE_STEPS = 10, 3
# A fit within this many sigma of facing the camera is tried again from this many sigma aside.
FRONTAL_SIGMAS, TIP_SIGMAS = 3.0, 3.0
TIP_AXIS = np.array([0.8, 0.6, 0.0])
# Chi-square of a pixel that only one of two fits counts as an outlier.
OUTLIER_CHI_SQUARE = 25.0


def with_clear_light(fits: list[Fit], noise: NoiseModel) -> list[Fit]:
    """The fits, with more freedom of the light for targets whose residuals show that they are lit unevenly."""
    squares = [pattern_of_residuals(adjusted, pixels, noise) for _, adjusted, pixels in fits]
    usual = usual_pattern(np.concatenate(squares))
    out = []
    for (group, adjusted, pixels), square in zip(fits, squares, strict=True):
        chance = chance_of_even_light(square / usual, pixels.target, len(group.index))
        if (chance < FREED_PART).any():
            # residuals were last looked at a step before the end of the fit, and that step leaves a pattern too
            suspects = chance < FREED_PART
            adjusted, rows = _looked_at(group.batch, adjusted, pixels, suspects, noise), suspects[pixels.target]
            square[rows] = pattern_of_residuals(adjusted, pixels, noise, rows)
            chance = chance_of_even_light(square / usual, pixels.target, len(group.index))
            adjusted = with_curved_light(group.batch, pixels, adjusted, chance < FREED_PART, noise)
        group = replace(group, poses=adjusted.poses, state=adjusted.state, glare=chance < FALSE_PART)
        out.append((group, adjusted, pixels))
    return out


def _looked_at(batch: Batch, fit: Adjusted, pixels: RingPixels, targets: Bool, noise: NoiseModel) -> Adjusted:
    """A fit with its targets (T,) carried a little further, and their residuals seen from where they were."""
    weighting = Weighting(noise.base, noise.slope, residual_cut(fit, pixels))
    more = with_rest(batch, pixels, replace(fit, converged=~targets), weighting, SETTLE_STEPS)
    return replace(more, converged=fit.converged)


def with_learnt_normals(fits: list[Fit], shared: Shared, inflation: float) -> tuple[list[Fit], Shared]:
    """Learn the spread of normals again from all pixels, and hold each target's normal by it.

    The coarse fits know tilts half as well as the full ones, and so leave the spread more open than it is. No pixel is visited again:
    normal equations say where a fit goes when its prior changes. `inflation` is that of the noise (see `NoiseModel`).
    """
    spread = spread_of_normals([(adjusted, group.batch.priors, group.batch.priors.normal) for group, adjusted, _ in fits], inflation)
    out = []
    for group, adjusted, pixels in fits:
        before = group.batch.priors
        sigma = np.where(before.normal_sigma_rad < FIRST_NORMAL_SIGMA_RAD, spread, before.normal_sigma_rad)
        priors = replace(before, normal_sigma_rad=sigma)
        moved = with_priors(adjusted, before, priors)
        group = replace(group, batch=replace(group.batch, priors=priors), poses=moved.poses, state=moved.state)
        out.append((group, moved, pixels))
    return out, replace(shared, normal_sigma_rad=spread)


def with_priors(fit: Adjusted, before: Priors, after: Priors) -> Adjusted:
    """A converged fit as it would have been with other priors."""
    poses, state = with_other_priors(fit, before, after)
    information = fit.data_information.copy()
    information[:, range(GEOMETRY), range(GEOMETRY)] += prior_terms(poses, state, after)[0]
    return replace(fit, poses=poses, state=state, information=information)


def with_likelier_normals(fits: list[Fit], noise: NoiseModel) -> list[Fit]:
    """The fits, with the mirrored pose where it suits pixels and surface better, and `ambiguous` where neither is clearly better.

    Under weak perspective a plane and its mirror image about the line of sight look alike (Schweighofer and Pinz 2006). A fit keeps
    to the side it starts from, so both are fitted to the same pixels.
    """
    out = []
    for group, adjusted, pixels in fits:
        frontal = _could_be_a_saddle(group.batch, adjusted)
        if frontal.any():
            adjusted, _ = _likelier(group.batch, pixels, adjusted, frontal, _tipped(adjusted), noise)
        doubtful = _could_be_mirrored(group.batch, adjusted)
        if doubtful.any():
            adjusted, ambiguous = _likelier(group.batch, pixels, adjusted, doubtful, mirrored(adjusted.poses), noise)
            group = replace(group, ambiguous=ambiguous)
        out.append((replace(group, poses=adjusted.poses, state=adjusted.state), adjusted, pixels))
    return out


def _tilt_sigma(fit: Adjusted) -> Array:
    """Roughly the sigma (T,) of tilts, rad: a little small, as if all else were known."""
    return np.asarray((0.5 * np.diagonal(fit.information, axis1=1, axis2=2)[:, 3:5].sum(axis=1)) ** -0.5)


def _could_be_a_saddle(batch: Batch, fit: Adjusted) -> Bool:
    """Where (T,) the target seems to face the camera though the surface leaves it free: half way between two mirrored poses."""
    sigma = _tilt_sigma(fit)
    frontal = angle_between_rad(fit.poses.rotation[..., 2], mirrored_normals(fit.poses)) < FRONTAL_SIGMAS * sigma
    return np.asarray(frontal & (batch.priors.normal_sigma_rad > 2 * sigma) & fit.converged)


def _tipped(fit: Adjusted) -> Poses:
    """Poses turned by some sigmas about an axis that no pattern is likely to lie along."""
    turn = TIP_SIGMAS * _tilt_sigma(fit)[:, None] * TIP_AXIS
    return Poses(fit.poses.rotation @ rotation_from_vector(turn), fit.poses.position_mm)


def _could_be_mirrored(batch: Batch, fit: Adjusted) -> Bool:
    """Where (T,) the mirrored normal lies far enough away to matter, and the surface alone does not exclude it."""
    normal, other, priors = fit.poses.rotation[..., 2], mirrored_normals(fit.poses), batch.priors
    prior = angle_between_rad(other, priors.normal) ** 2 - angle_between_rad(normal, priors.normal) ** 2
    out = (angle_between_rad(normal, other) > 2 * _tilt_sigma(fit)) & (prior < MIRROR_CHI_SQUARE * priors.normal_sigma_rad**2)
    return np.asarray(out & fit.converged)


def _likelier(batch: Batch, pixels: RingPixels, fit: Adjusted, doubtful: Bool, start: Poses, noise: NoiseModel) -> tuple[Adjusted, Bool]:
    """The fit, from where it is or from `start`, that suits the `doubtful` targets (T,) better; and where that is not certain."""
    weighting = Weighting(noise.base, noise.slope, residual_cut(fit, pixels))

    def fitted(poses: Poses, state: State, steps: int) -> Adjusted:
        return with_rest(batch, pixels, replace(fit, poses=poses, state=state, converged=~doubtful), weighting, steps)

    # a pass sees the pixels from where it begins: one step more, for the chi-square of where a fit has ended
    here = replace(fitted(fit.poses, fit.state, 1), poses=fit.poses, state=fit.state)
    ended = fitted(start, fit.state, MIRROR_STEPS)
    there = fitted(ended.poses, ended.state, SETTLE_STEPS)
    there = replace(fitted(there.poses, there.state, 1), poses=there.poses, state=there.state)
    rise = chi_square_rise(batch.priors, pixels, here, there, noise)
    apart = angle_between_rad(fit.poses.rotation[..., 2], there.poses.rotation[..., 2]) > 2 * _tilt_sigma(there)
    apart &= doubtful
    better = apart & there.converged & (rise < 0)
    if better.any():
        rotation = np.where(better[:, None, None], there.poses.rotation, fit.poses.rotation)
        poses = Poses(rotation, np.where(better[:, None], there.poses.position_mm, fit.poses.position_mm))
        state = State(*(np.where(better, getattr(there.state, f), getattr(fit.state, f)) for f in State.__dataclass_fields__))
        fit = with_rest(batch, pixels, replace(fit, poses=poses, state=state, converged=fit.converged & ~better), weighting, SETTLE_STEPS)
    unsettled = ~there.converged & (rise < 0)
    return fit, apart & (unsettled | (np.abs(rise) < MIRROR_CHI_SQUARE))


def chi_square_rise(priors: Priors, pixels: RingPixels, here: Adjusted, there: Adjusted, noise: NoiseModel) -> Array:
    """By how much chi-square (T,), of pixels and priors together, is larger `there` than `here`."""
    return _chi_square(priors, pixels, there, here.noise_variance, noise) - _chi_square(priors, pixels, here, here.noise_variance, noise)


def _chi_square(priors: Priors, pixels: RingPixels, fit: Adjusted, variance: Array, noise: NoiseModel) -> Array:
    """Chi-square (T,) of a fit for a noise variance (T,), pixels and priors together, but for a constant."""
    # what robust weights leave out is not for free
    square = by_target(fit.sums.square - OUTLIER_CHI_SQUARE * fit.sums.weight, pixels.target, len(fit.poses))
    precision, pull = prior_terms(fit.poses, fit.state, priors)
    return np.asarray(square / (variance * noise.inflation) + (pull**2 / precision).sum(axis=1))
