"""Bundle adjustment: Levenberg-Marquardt on a camera, a board and its poses, and the scale of what is left."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.bundle import BoardCorners, Bundle, Mask, Prior
from dishmap.camera.elimination import LEAST_DAMPING, Step, best_step, normal_equations
from dishmap.errors import CameraError

Array = NDArray[np.float64]

FIRST_DAMPING, MOST_DAMPING = 1e-3, 1e12
# From a start near the minimum full steps are tried at once, and 0.01 sigma of it is near enough.
NEAR_DAMPING, NEAR_GAIN = 1e-10, 1e-8
# Where a full step lowers the sum of squares by what it should, to this part of the sum, the problem is linear and the step led to the
# minimum: what is left to gain is smaller than the difference. 0.03 sigma for 10000 residuals.
LINEAR_PART = 1e-7
MOST_STEPS = 100
# A step that is expected to lower the sum of squares by less than this part of it changes no parameter by 1e-5 sigma.
RELATIVE_GAIN = 1e-12
# Below this rms the residuals are rounding errors of the projection.
ROUNDING_PX = 1e-11
# Half weight at this many sigmas in the robust start: what fits keeps its say, what is far off loses it.
CAUCHY_SIGMAS = 3.0
# rms of one coordinate from the median length of 2D residuals: sqrt(2 ln 2)
MEDIAN_OF_RAYLEIGH = 1.1774
SMALLEST_SCALE_PX = 0.002


def adjust(
    start: Bundle,
    corners: BoardCorners,
    free: Mask,
    prior: Prior,
    weights: Array | None = None,
    robust: bool = False,
    near: bool = False,
) -> Bundle:
    """Fit a bundle to corners by Levenberg-Marquardt.

    free (P + F,): shared parameters to estimate; poses always are. weights (M,): of the corners, 1 by default. robust: weigh by
    Cauchy's function of the residual in units of the overall scale instead, again at every step. near: the start is near the minimum.
    Returns the best bundle reached; `step_in_sigmas` tells whether that is the minimum.
    """
    bundle, damping = start, NEAR_DAMPING if near else FIRST_DAMPING
    enough = 1e-6 if robust else NEAR_GAIN if near else RELATIVE_GAIN
    fixed = np.ones(len(corners.pixels)) if weights is None else weights
    residuals = bundle.residuals(corners)
    for _ in range(MOST_STEPS):
        weight = _cauchy(residuals) if robust else fixed
        cost = _cost(residuals, weight) + prior.cost(bundle)
        if not np.isfinite(cost):
            break
        equations = normal_equations(bundle, corners, free, weight, prior)
        accepted = False
        while damping < MOST_DAMPING and not accepted:
            step, gain = best_step(equations, damping)
            # in the robust start the weights move too, and finer convergence is left to the fit after it
            if gain <= enough * cost + len(fixed) * ROUNDING_PX**2:
                return bundle
            trial = _try_move(bundle, free, step) if gain < np.inf else bundle
            moved = trial.residuals(corners)
            lower = cost - _cost(moved, weight) - prior.cost(trial)
            accepted, full = lower > 0, damping <= NEAR_DAMPING
            damping = max(damping / 10, LEAST_DAMPING) if accepted else damping * 10
        if not accepted:
            return bundle
        bundle, residuals = trial, moved
        if near and full and abs(lower - gain) <= LINEAR_PART * cost:
            break
    return bundle


def _try_move(bundle: Bundle, free: Mask, step: Step) -> Bundle:
    """The bundle after a step; the same bundle, which lowers nothing, when no camera has such parameters."""
    try:
        return bundle.moved(free, step.shared, step.poses, step.prints)
    except CameraError:
        return bundle


def _cost(residuals: Array, weights: Array) -> float:
    """Weighted sum of squares; infinite when a point with weight is beyond the lens model."""
    square = (residuals**2).sum(axis=1)
    total = float((weights * square)[weights > 0].sum())
    return total if np.isfinite(total) else np.inf


def scale_px(residuals: Array) -> float:
    """Robust sigma of one coordinate of 2D residuals (M, 2), px, never below two thousandths of a pixel."""
    length = np.linalg.norm(residuals, axis=-1)
    length = np.where(np.isfinite(length), length, np.inf)
    return max(float(np.median(length)) / MEDIAN_OF_RAYLEIGH, SMALLEST_SCALE_PX)


def _cauchy(residuals: Array) -> Array:
    length = np.linalg.norm(residuals, axis=-1)
    return np.where(np.isfinite(length), 1 / (1 + (length / (CAUCHY_SIGMAS * scale_px(residuals))) ** 2), 0.0)
