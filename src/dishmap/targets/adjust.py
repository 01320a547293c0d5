"""Least-squares adjustment of target poses to the raw pixels of their rings.

All targets of a kind are adjusted at once, each on its own: six pose parameters, edge offset (in mm and in px) and blur per
target, planar light levels per ring. Gauss-Newton with limited steps; robust weights against glare, dirt and occlusion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.targets.edges import LocalMaps, Patches, Poses, local_maps
from dishmap.targets.pixels import (
    BLUR,
    GEOMETRY,
    OFFSET_MM,
    OFFSET_PX,
    TONE,
    RingPixels,
    Rings,
    RingSums,
    State,
    Weighting,
    ring_sums,
    without_light,
)
from dishmap.targets.solve import solve_each, solve_scaled
from dishmap.transforms import rotation_from_vector

Array = NDArray[Any]

# The parameters that say where a target is, and how far its ink spread.
POSE_AND_OFFSET = [*range(6), OFFSET_MM]
# A step moves no edge by more than this, so that the linear model holds (edges are about a blur wide).
LARGEST_STEP_PX = 1.5
LARGEST_TURN_RAD = 0.2
NEW_FIELDS_RAD = 0.01
SHARPEST_BLUR_PX, WIDEST_BLUR_PX = 0.3, 12.0
STRONGEST_LOG_GAMMA = 1.2
# Converged when the next step would be under 4 % of the estimate's own sigma, or the step itself is under 2e-4 px.
STEP_SIGMAS, STEP_PX, SETTLED_PX = 0.04, 2e-4, 0.3
LEFT_BLURS = 6.0
MOST_CONVERGED = 0.5
# A turn about the normal is unknown for targets of one centre; this prior merely keeps it at zero.
NO_TURN_SIGMA_RAD = 1e-4


@dataclass(frozen=True)
class Priors:
    """What is assumed of each target before its pixels are seen; sigma values, all broadcast to (T,).

    normal (T, 3): expected normal in the camera frame, towards the camera; normal_sigma_rad (T,); offset_mm_sigma (ink spread),
    offset_px_sigma (blooming), blur_px and log_blur_sigma, log_gamma (tone curve) and its sigma; turns_freely: the kind has one centre.
    """

    normal: Array
    normal_sigma_rad: Array
    offset_mm_sigma: float
    offset_px_sigma: float
    blur_px: float
    log_blur_sigma: float
    log_gamma: float
    log_gamma_sigma: float
    turns_freely: bool


@dataclass(frozen=True)
class Batch:
    """Fixed inputs of an adjustment of T targets of one kind."""

    camera: Camera
    curvature_per_mm: Array
    rings: Rings
    priors: Priors

    def maps(self, poses: Poses, patches: Patches, before: LocalMaps | None = None) -> LocalMaps:
        """The local maps of patches of the batch's targets at `poses`; motion fields are taken from `before` if given."""
        return local_maps(self.camera, poses, self.curvature_per_mm, patches, before)


@dataclass(frozen=True)
class Adjusted:
    """Result of `adjust`.

    poses and state (nuisances); information and data_information (T, G, G): the normal matrix with and without the priors, in
    units of the noise variance; converged (T,); sums and residual: of the last pass; noise_variance (T,), grey^2.
    """

    poses: Poses
    state: State
    information: Array
    data_information: Array
    converged: NDArray[Any]
    sums: RingSums
    residual: NDArray[Any]
    noise_variance: Array


def by_target(values: Array, target: NDArray[np.int64], count: int) -> Array:
    """Sum rows of `values` (M, ...) over the rings of each of `count` targets."""
    out = np.zeros((count, *values.shape[1:]))
    np.add.at(out, target, values)
    return out


def prior_terms(poses: Poses, state: State, priors: Priors) -> tuple[Array, Array]:
    """Prior information (T, G) (diagonal) and the pull (T, G) towards the prior means at the present state."""
    count = len(poses)
    precision = np.full((count, GEOMETRY), 1e-12)
    pull = np.zeros((count, GEOMETRY))
    expected = np.einsum("tji,tj->ti", poses.rotation, priors.normal)
    precision[:, 3:5] = priors.normal_sigma_rad[:, None] ** -2.0
    # turning about x by a tips the normal to (0, -a), about y by b to (b, 0)
    pull[:, 3], pull[:, 4] = -expected[:, 1], expected[:, 0]
    if priors.turns_freely:
        precision[:, 5] = NO_TURN_SIGMA_RAD**-2
    for column, value, mean, sigma in (
        (OFFSET_MM, state.offset_mm, 0.0, priors.offset_mm_sigma),
        (OFFSET_PX, state.offset_px, 0.0, priors.offset_px_sigma),
        (BLUR, state.blur_px, priors.blur_px, priors.log_blur_sigma * priors.blur_px),
        (TONE, state.log_gamma, priors.log_gamma, priors.log_gamma_sigma),
    ):
        precision[:, column] = sigma**-2
        pull[:, column] = mean - value
    return precision, precision * pull


def on_pose_and_offset(information: Array, precision: Array, steps: Array) -> tuple[Array, Array]:
    """Information (T, G, G) of a fit reduced to (move along camera axes in mm, turn about target axes in rad, edge offset in mm).

    precision (T, G): of the priors; those of blur, tone curve and blooming are kept, and these three eliminated. steps (T, 3, 3): axes of
    the moves. Returns the information (T, 7, 7), without the priors on the seven, and the turn (T, 7, 7) from the fit's axes.
    """
    rest = [OFFSET_PX, BLUR, TONE]
    full = information.copy()
    full[:, rest, rest] += precision[:, rest]
    cross = full[:, POSE_AND_OFFSET][:, :, rest]
    kept = full[:, POSE_AND_OFFSET][:, :, POSE_AND_OFFSET] - cross @ solve_each(full[:, rest][:, :, rest], np.swapaxes(cross, 1, 2))
    axes = np.zeros_like(kept)
    axes[:, :3, :3], axes[:, 3:, 3:] = steps, np.eye(4)
    return axes @ kept @ np.swapaxes(axes, 1, 2), axes


def adjust(batch: Batch, pixels: RingPixels, poses: Poses, state: State, weighting: Weighting, steps: int, enough: float = 1.0) -> Adjusted:
    """Run up to `steps` Gauss-Newton steps from `poses` and `state`, until a share `enough` of the targets has converged.

    Once most targets have converged, the others go on alone.
    """
    maps = batch.maps(poses, pixels.patches)
    for step in range(1, steps + 1):
        fit, turning = _one_step(batch, pixels, poses, state, weighting, maps)
        poses, state = fit.poses, fit.state
        share = fit.converged.mean()
        # the last step was a small part of sigma: the sums before it serve as those after it
        if share >= enough or step == steps:
            break
        if share > MOST_CONVERGED:
            return with_rest(batch, pixels, fit, weighting, steps - step)
        # the motion fields only steer: they are made anew when targets turn, not at every step
        maps = batch.maps(poses, pixels.patches, None if turning else maps)
    return fit


def _one_step(batch: Batch, pixels: RingPixels, poses: Poses, state: State, weighting: Weighting, maps: LocalMaps) -> tuple[Adjusted, bool]:
    """One pass over the pixels and one step; and whether some target turned enough to need new motion fields."""
    count = len(poses)
    sums, residual = ring_sums(pixels, batch.rings, maps, state, weighting)
    freedom = np.maximum(by_target(sums.weight, pixels.target, count) - GEOMETRY, 1.0)
    variance = np.maximum(by_target(sums.square, pixels.target, count) / freedom, 1e-12)
    normal, right = without_light(sums)
    data = by_target(normal, pixels.target, count) / variance[:, None, None]
    precision, pull = prior_terms(poses, state, batch.priors)
    information = data.copy()
    information[:, range(GEOMETRY), range(GEOMETRY)] += precision
    delta = solve_scaled(information, by_target(right, pixels.target, count) / variance[:, None] + pull)
    sigmas = np.sqrt(np.maximum(np.einsum("tg,tgh,th->t", delta, information, delta) / GEOMETRY, 0))
    move_px = _largest_motion_px(delta, maps, pixels.target, count)
    # a Gauss-Newton step of x px leaves a few tenths of x^2 / blur to do: what is left is judged, not what was done
    left = np.minimum(move_px / (LEFT_BLURS * state.blur_px), 1.0)
    converged = ((sigmas * left < STEP_SIGMAS) & (move_px < SETTLED_PX)) | (move_px < STEP_PX)
    turn = np.linalg.norm(delta[:, 3:6], axis=1)
    limit = np.minimum(1.0, np.minimum(LARGEST_STEP_PX / np.maximum(move_px, 1e-9), LARGEST_TURN_RAD / np.maximum(turn, 1e-9)))
    poses, state = moved_by(poses, state, delta * np.nan_to_num(limit)[:, None])
    good = converged & np.isfinite(poses.position_mm).all(axis=1) & np.isfinite(information).all(axis=(1, 2))
    turning = float(np.nan_to_num(turn).max(initial=0.0)) > NEW_FIELDS_RAD
    return Adjusted(poses, state, information, data, good, sums, residual, variance), turning


def with_rest(batch: Batch, pixels: RingPixels, fit: Adjusted, weighting: Weighting, steps: int) -> Adjusted:
    """`fit` with the targets that have not converged adjusted further."""
    rest = ~fit.converged
    rings = rest[pixels.target]
    number = np.cumsum(rest) - 1
    priors = replace(batch.priors, normal=batch.priors.normal[rest], normal_sigma_rad=batch.priors.normal_sigma_rad[rest])
    some = replace(batch, curvature_per_mm=batch.curvature_per_mm[rest], priors=priors)
    cut = None if weighting.cut is None else weighting.cut[rings]
    more = adjust(some, pixels.only(rings, number), fit.poses.take(rest), fit.state.take(rest), replace(weighting, cut=cut), steps)

    def merged(old: Array, new: Array, where: Array) -> Array:
        out = old.copy()
        out[where] = new
        return out

    return Adjusted(
        Poses(merged(fit.poses.rotation, more.poses.rotation, rest), merged(fit.poses.position_mm, more.poses.position_mm, rest)),
        State(*(merged(getattr(fit.state, f), getattr(more.state, f), rest) for f in State.__dataclass_fields__)),
        merged(fit.information, more.information, rest),
        merged(fit.data_information, more.data_information, rest),
        merged(fit.converged, more.converged, rest),
        RingSums(*(merged(getattr(fit.sums, f), getattr(more.sums, f), rings) for f in RingSums.__dataclass_fields__)),
        merged(fit.residual, more.residual, rings),
        merged(fit.noise_variance, more.noise_variance, rest),
    )


def with_other_priors(fit: Adjusted, before: Priors, after: Priors) -> tuple[Poses, State]:
    """Where a converged fit would have gone with other priors, from its normal equations alone."""
    _, old = prior_terms(fit.poses, fit.state, before)
    precision, new = prior_terms(fit.poses, fit.state, after)
    information = fit.data_information.copy()
    information[:, range(GEOMETRY), range(GEOMETRY)] += precision
    delta = solve_scaled(information, new - old)
    # targets that did not converge, or would go far, stay where they are
    delta *= (np.abs(delta[:, 3:6]).max(axis=1) < LARGEST_TURN_RAD)[:, None] & fit.converged[:, None]
    return moved_by(fit.poses, fit.state, delta)


def _largest_motion_px(delta: Array, maps: LocalMaps, target: NDArray[np.int64], count: int) -> Array:
    """Rough bound on how far a step moves any printed point, px, plus how much it changes blur and offset."""
    fields = np.einsum("mkgl,mg->mkl", maps.motion[..., :3], delta[target, :6])
    image = np.linalg.norm(fields[..., 0], axis=1) + np.linalg.norm(fields[..., 1:], axis=(1, 2))
    out = np.zeros(count)
    np.maximum.at(out, target, image)
    return np.asarray(out + np.abs(delta[:, OFFSET_PX]) + np.abs(delta[:, BLUR]))


def moved_by(poses: Poses, state: State, delta: Array) -> tuple[Poses, State]:
    """Poses and state after a step (T, G) of all geometry parameters; blur and tone curve stay within reason."""
    position = poses.position_mm + np.einsum("tij,tj->ti", poses.steps, delta[:, :3])
    rotation = poses.rotation @ rotation_from_vector(delta[:, 3:6])
    blur = np.clip(state.blur_px * np.exp(np.clip(delta[:, BLUR] / state.blur_px, -0.5, 0.5)), SHARPEST_BLUR_PX, WIDEST_BLUR_PX)
    tone = np.clip(state.log_gamma + delta[:, TONE], -STRONGEST_LOG_GAMMA, STRONGEST_LOG_GAMMA)
    return Poses(rotation, position), State(state.offset_mm + delta[:, OFFSET_MM], state.offset_px + delta[:, OFFSET_PX], blur, tone)
