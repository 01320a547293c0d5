"""How noisy the corners are, how far the print is off, and how far the board moved while pictures were read: learnt from the residuals.

Errors of the print are the same in all views, motions the same over all of a view, noise is new in each corner. All three are Gaussian
with a
sigma that makes the residuals most likely (evidence maximisation: MacKay 1992, "Bayesian interpolation", section 4: squared size over the
number of parameters that the data determine). A print without visible errors is taken as exact. Freeing a board's points is Strobl and
Hirzinger 2011, "More accurate pinhole camera calibration with imperfect planar target"; the sigma keeps them from going where views say
little.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dishmap.camera import elimination as el
from dishmap.camera.bundle import POSE, Bundle
from dishmap.camera.problem import Problem

Array = NDArray[np.float64]

# Fewer views tell little about points of a board.
FEWEST_PRINT_VIEWS = 6
# Points lie off by more than chance lets them by at least so many sigmas of a chi-square, or the print is exact.
PRINT_SIGMAS = 4.0
# Print errors or motions under this part of what all corners together can see of them are none.
SMALLEST_PART = 0.5
# Of a motion's six parts, the shifts across the line of sight say how large all of it is: shifts along it look like a tilt.
SIDEWAYS = slice(3, 5)
MOST_ROUNDS, SAME_PART = 12, 0.1
# Without noise there is nothing to learn from.
LEAST_NOISE_PX = 1e-6


def learnt(problem: Problem, bundle: Bundle, weights: Array) -> tuple[Problem, Bundle]:
    """The problem with its noise, print and motion sigmas, and its solution; weights (M,) of the corners."""
    problem = _begun(problem, bundle, weights)
    for _ in range(MOST_ROUNDS):
        bundle = problem.solve(bundle, weights, near=True)
        before, problem = problem, _updated(problem, bundle, weights)
        if not problem.print_mm:
            bundle = replace(bundle, print_mm=np.zeros_like(bundle.print_mm))
        if not problem.motion_mm:
            bundle = replace(bundle, motion=np.zeros_like(bundle.motion))
        if not (problem.print_mm or problem.motion_mm or before.print_mm or before.motion_mm) or _same(before, problem):
            break
    return problem, problem.solve(bundle, weights, near=True)


def _equations(problem: Problem, bundle: Bundle, weights: Array) -> el.NormalEquations:
    corners = problem.corners(bundle)
    return el.normal_equations(bundle, corners, problem.free(bundle), weights, problem.prior(bundle, corners, weights))


def _begun(problem: Problem, bundle: Bundle, weights: Array) -> Problem:
    """Where to start: all that is left may be noise, print or motion."""
    equations = _equations(problem, bundle, weights)
    noise = float(np.sqrt((equations.residual**2).sum() / max(2 * (weights > 0).sum() - POSE * len(problem.views), 1)))
    if noise < LEAST_NOISE_PX:
        return problem
    scale_mm = noise / _px_per_mm(bundle)
    prints, motion = problem.print_mm, problem.motion_mm
    if not (problem.flat or prints) and len(problem.views) >= FEWEST_PRINT_VIEWS and _print_shows(problem, bundle, weights, noise):
        prints = scale_mm
    if problem.readout != "global" and not motion:
        motion = 3 * scale_mm
    return replace(problem, print_mm=prints, motion_mm=motion)


def _px_per_mm(bundle: Bundle) -> float:
    return float(bundle.camera.focal_px.mean() / np.median(np.abs(bundle.translation_mm[:, 2])))


def _print_shows(problem: Problem, bundle: Bundle, weights: Array, noise_px: float) -> bool:
    """Whether the points' mean residuals over the views are larger than chance allows."""
    points = _equations(replace(problem, print_mm=1e3 * problem.half_mm), bundle, weights).points
    assert points is not None
    square = np.einsum("ni,nij,nj->", points.side, points.inverse, points.side) / noise_px**2
    degrees = points.side.size
    return bool(square > degrees + PRINT_SIGMAS * np.sqrt(2 * degrees))


def _updated(problem: Problem, bundle: Bundle, weights: Array) -> Problem:
    equations = _equations(problem, bundle, weights)
    prior = problem.prior(bundle, problem.corners(bundle), weights)
    known = el.marginals(equations)
    determined = len(equations.prior) - float(equations.prior @ np.diag(known.covariance)) + POSE * len(problem.views)
    prints = motion = 0.0
    if problem.print_mm:
        seen = bundle.print_mm.size - prior.print_precision * float(known.prints.sum())
        prints = _sigma(float((bundle.print_mm**2).sum()), seen, bundle.print_mm.size, problem.print_mm)
        determined += seen
    if problem.motion_mm:
        by_part = 1 - known.motion * prior.pose_precision[POSE:]
        determined += float(by_part.sum())
        sideways = bundle.motion[:, SIDEWAYS]
        motion = _sigma(float((sideways**2).sum()), float(by_part[:, SIDEWAYS].sum()), sideways.size, problem.motion_mm)
    noise = np.sqrt((equations.residual**2).sum() / max(2 * (weights > 0).sum() - determined, 1.0))
    return replace(problem, noise_px=float(noise), print_mm=prints, motion_mm=motion)


def _sigma(square: float, seen: float, count: int, before: float) -> float:
    """Sigma of parameters whose squares sum to `square`, of which so many of `count` are seen; 0 where they are lost in the noise."""
    part = max(seen / count, 1e-9)
    sigma = np.sqrt(square / (part * count))
    # part = s^2 / (s^2 + e^2) for parameters of sigma s seen with error e
    error = before * np.sqrt(1 / part - 1)
    return float(sigma) if sigma > SMALLEST_PART * error else 0.0


def _same(before: Problem, after: Problem) -> bool:
    pairs = ((before.noise_px, after.noise_px), (before.print_mm, after.print_mm), (before.motion_mm, after.motion_mm))
    return all(abs(a - b) <= SAME_PART * max(a, b) for a, b in pairs)
