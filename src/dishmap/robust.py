"""Robust least squares: the paper's Algorithm 4 ("minimum LAR"), for linear and for smooth non-linear models.

Iteratively reweighted least squares with leverage-adjusted residuals r_adj = r / sqrt(1 - h), standardised as
u = r_adj / (K s), and bisquare weights (1 - u^2)^2 for |u| < 1, else 0. K = 4.685 gives 95 % efficiency for Gaussian noise.
The scale is s = MAD / 0.6745 with the MAD of MATLAB's `robustfit`: the median of the absolute adjusted residuals about
zero, leaving out the P - 1 smallest (P coefficients make as many residuals small). Standard errors as there too, after
DuMouchel & O'Brien (1989), "Integrating a robust option into a multiple regression computing environment".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.errors import FitError, InputError

Array = NDArray[np.float64]
Model = Callable[[Array], tuple[Array, Array]]

TUNING = 4.685
MAD_OF_SIGMA = 0.6745
MAX_ITERATIONS = 200
FREE_ITERATIONS = 50
# Converged when no fitted value moves by more than this part of the scale.
CONVERGED = 1e-8
# As `robustfit`: with a (nearly) exact fit the scale is kept above this part of the spread of the values, or rounding
# errors would be called outliers.
SMALLEST_SCALE = 1e-6
# As `robustfit`: the leverage of a point that alone determines a coefficient is 1, and its residual is 0 whatever it is.
LARGEST_LEVERAGE = 0.9999
# Relative singular value of the scaled design below which coefficients are not determined.
RANK_TOLERANCE = 1e-10
STARTS = ("least-absolute", "least-squares", "given")
ABSOLUTE_STEPS = 30
# Steps to the minimum for one set of weights; while the weights still change, one is enough.
INNER_STEPS = 50
REWEIGHTED_STEPS = 1


@dataclass(frozen=True)
class RobustFit:
    """Result of a robust fit of P coefficients to N values.

    coefficients (P,); covariance (P, P); weights (N,): bisquare weights, 0 for outliers; residuals (N,): value minus model,
    in the values' unit; adjusted (N,): residuals over sigma and over sqrt(1 - leverage); leverage (N,); scale: s, and
    spread: the robust standard deviation behind the covariance, both in the values' unit, or in sigmas where those were
    given; converged and iterations: how the reweighting ended; sensitivity (P, N): d coefficients / d values at the end.
    """

    coefficients: Array
    covariance: Array
    weights: Array
    residuals: Array
    adjusted: Array
    leverage: Array
    scale: float
    spread: float
    converged: bool
    iterations: int
    sensitivity: Array


def robust_linear_fit(
    design: ArrayLike,
    values: ArrayLike,
    sigma: ArrayLike | None = None,
    tuning: float = TUNING,
    start: str = "least-absolute",
    initial: ArrayLike | None = None,
) -> RobustFit:
    """Fit values (N,) by design (N, P) times coefficients (P,), robustly (Algorithm 4).

    sigma (N,): the values' own standard deviations, used as prior weights 1 / sigma^2; the covariance then never claims less
    than they do. start: `least-squares` as the paper and `robustfit` have it, or `least-absolute`, from which the same
    iteration also holds when up to about 40 % of the values are far off to one side, or `given` for `initial` (P,).
    Raises FitError for fewer than P + 1 values or coefficients that are not determined, InputError for unusable arrays.
    """
    x, y = np.asarray(design, dtype=float), np.asarray(values, dtype=float)
    if x.ndim != 2 or y.shape != x.shape[:1]:
        raise InputError(f"a linear fit needs a design (N, P) and values (N,), not {x.shape} and {y.shape}")
    return robust_fit(lambda b: (y - x @ b, x), np.zeros(x.shape[1]) if initial is None else initial, y, sigma, tuning, start)


def robust_fit(
    model: Model,
    initial: ArrayLike,
    values: ArrayLike,
    sigma: ArrayLike | None = None,
    tuning: float = TUNING,
    start: str = "least-absolute",
) -> RobustFit:
    """Fit a smooth model robustly: as `robust_linear_fit`, with a step of Levenberg and Marquardt for each new set of weights.

    model(b) gives the residuals (N,), value minus model, and the derivative of the model (N, P), at coefficients b;
    initial (P,): where to begin; values (N,): only their spread is used, as the scale of an exact fit.
    """
    b = np.asarray(initial, dtype=float)
    prior = _prior(values, sigma)
    if start not in STARTS:
        raise InputError(f"unknown start {start!r} of a robust fit; use one of {', '.join(STARTS)}")
    if len(prior) <= b.size:
        raise FitError(f"{len(prior)} points are too few to fit {b.size} coefficients; at least {b.size + 1} are needed")
    if not all(np.isfinite(part).all() for part in model(b)):
        raise InputError("a fit needs finite numbers; the values or the design hold NaN or infinity")
    whitened = _whitened(model, prior)
    floor = SMALLEST_SCALE * float(np.std(np.asarray(values, dtype=float) / prior)) or 1.0
    plain = _solve(whitened, b, np.ones(len(prior)), INNER_STEPS)
    least_squares = float(np.linalg.norm(whitened(plain)[0]) / np.sqrt(len(prior) - b.size))
    if start != "given":
        b = plain if start == "least-squares" else _least_absolute(whitened, plain, floor)
    return _reweight(whitened, b, prior, tuning, floor, least_squares, sigma is not None)


def bisquare_weights(u: ArrayLike) -> Array:
    """Tukey's bisquare weights of standardised residuals: (1 - u^2)^2 within |u| < 1, else 0."""
    u = np.asarray(u, dtype=float)
    return np.where(np.abs(u) < 1, (1 - u**2) ** 2, 0.0)


def mad_scale(residuals: ArrayLike, coefficients: int = 1) -> float:
    """Robust standard deviation MAD / 0.6745 of residuals (N,) about zero, as `robustfit`: without the P - 1 smallest."""
    size = np.sort(np.abs(np.asarray(residuals, dtype=float)))
    return float(np.median(size[max(1, min(coefficients, size.size)) - 1 :]) / MAD_OF_SIGMA)


def _whitened(model: Model, prior: Array) -> Model:
    """The model in units of the prior sigmas, remembering its last value: steps end where the next begins."""
    last: list[tuple[Array, tuple[Array, Array]]] = []

    def whitened(at: Array) -> tuple[Array, Array]:
        if not last or not np.array_equal(last[0][0], at):
            r, jacobian = model(at)
            last[:] = [(at, (r / prior, jacobian / prior[:, None]))]
        return last[0][1]

    return whitened


def _prior(values: ArrayLike, sigma: ArrayLike | None) -> Array:
    n = np.size(values)
    prior = np.ones(n) if sigma is None else np.asarray(sigma, dtype=float)
    if prior.shape != (n,):
        raise InputError(f"sigma must be one number for each of {n} values, not of shape {prior.shape}")
    if not (np.isfinite(prior).all() and (prior > 0).all()):
        raise InputError("sigma must be positive, finite numbers")
    return prior


def _reweight(model: Model, b: Array, prior: Array, tuning: float, floor: float, least_squares: float, known: bool) -> RobustFit:
    """The loop of Algorithm 4 in whitened units, and its statistics."""
    converged, iterations, scale = False, 0, floor
    weights = np.ones(len(prior))
    while not converged and iterations < MAX_ITERATIONS:
        iterations += 1
        r, jacobian = model(b)
        leverage = _leverage(jacobian)
        adjusted = r / np.sqrt(1 - leverage)
        # the median can hop between two values for ever: held, the scale lets the weights settle
        scale = max(mad_scale(adjusted, b.size), floor) if iterations <= FREE_ITERATIONS else scale
        weights = bisquare_weights(adjusted / (tuning * scale))
        before, b = b, _solve(model, b, weights, REWEIGHTED_STEPS)
        converged = bool(np.abs(jacobian @ (b - before)).max() <= CONVERGED * scale)
    r, jacobian = model(b)
    leverage = _leverage(jacobian)
    adjusted = r / np.sqrt(1 - leverage)
    spread = _spread(adjusted, leverage, b.size, scale, tuning, least_squares)
    inverse = _inverse(jacobian)
    # true sigmas make a spread of 1 but for chance; a smaller one is chance, not knowledge
    factor = max(spread, 1.0) if known else spread
    return RobustFit(
        coefficients=b,
        covariance=factor**2 * inverse @ inverse.T,
        weights=weights,
        residuals=r * prior,
        adjusted=adjusted,
        leverage=leverage,
        scale=scale,
        spread=spread,
        converged=converged,
        iterations=iterations,
        sensitivity=_sensitivity(jacobian, weights) / prior,
    )


def _spread(adjusted: Array, leverage: Array, count: int, scale: float, tuning: float, least_squares: float) -> float:
    """Robust standard deviation of the noise (`statrobustsigma` of robustfit, after Street, Carroll & Ruppert 1988)."""
    n = len(adjusted)
    u = adjusted / (tuning * scale)
    inside = np.abs(u) < 1
    phi = u * bisquare_weights(u)
    slope = float(np.mean(np.where(inside, (1 - u**2) * (1 - 5 * u**2), 0.0)))
    if slope <= 0:
        return least_squares
    variance = float(((1 - leverage) * phi**2).sum() / (n - count))
    robust = (1 + count / n * (1 - slope) / slope) * np.sqrt(variance) * tuning * scale / slope
    # shrunk towards the least-squares value where that is larger, more so for few values
    return float(max(robust, np.sqrt((least_squares**2 * count**2 + robust**2 * n) / (count**2 + n))))


def _least_absolute(model: Model, b: Array, floor: float) -> Array:
    """Coefficients near the least sum of absolute residuals, by reweighting with 1/|r|: only a place to start from."""
    for _ in range(ABSOLUTE_STEPS):
        r, jacobian = model(b)
        middle = max(float(np.median(np.abs(r))), floor)
        before, b = b, _solve(model, b, 1 / np.maximum(np.abs(r), 1e-3 * middle), REWEIGHTED_STEPS)
        if np.abs(jacobian @ (b - before)).max() <= 5e-2 * middle:
            break
    return b


def _solve(model: Model, b: Array, weights: Array, steps: int) -> Array:
    """Weighted least squares by steps of Levenberg and Marquardt: for a linear model the first is the answer."""
    root = np.sqrt(weights)
    if np.count_nonzero(weights) < b.size:
        raise FitError(f"only {np.count_nonzero(weights)} points agree with each other, too few to fit {b.size} coefficients")
    r, jacobian = model(b)
    cost, damping = float((weights * r**2).sum()), 0.0
    taken = 0
    for _ in range(INNER_STEPS):
        step = _step(root[:, None] * jacobian, root * r, damping)
        r_new, jacobian_new = model(b + step)
        cost_new = float((weights * r_new**2).sum())
        if not cost_new <= cost:
            if np.linalg.norm(root * (jacobian @ step)) <= 1e-8 * np.sqrt(cost):
                break  # what the step would gain is below rounding
            damping = max(10 * damping, 1e-4)
            continue
        b, r, jacobian, damping = b + step, r_new, jacobian_new, damping / 10 if damping > 1e-8 else 0.0
        # at the minimum no column of the Jacobian explains any more of the residuals
        slope = np.abs((weights * r) @ jacobian) / np.maximum(np.linalg.norm(root[:, None] * jacobian, axis=0), 1e-300)
        taken += 1
        if taken == steps or slope.max() <= 1e-11 * np.sqrt(cost) or cost - cost_new <= 1e-15 * cost:
            break
        cost = cost_new
    return b


def _step(jacobian: Array, r: Array, damping: float) -> Array:
    u, singular, vt, size = _scaled_svd(jacobian)
    return np.asarray(vt.T @ (singular / (singular**2 + damping * singular[0] ** 2) * (u.T @ r)) / size)


def _scaled_svd(jacobian: Array) -> tuple[Array, Array, Array, Array]:
    """SVD of the Jacobian with its columns scaled to length 1, and the lengths (P,). Raises FitError when rank is lacking."""
    size = np.linalg.norm(jacobian, axis=0)
    size = np.where(size > 0, size, 1.0)
    u, singular, vt = np.linalg.svd(jacobian / size, full_matrices=False)
    if not singular[-1] > RANK_TOLERANCE * singular[0]:
        rank = int((singular > RANK_TOLERANCE * singular[0]).sum())
        raise FitError(f"the points determine only {rank} of {len(size)} coefficients: they are too few or lie too regularly (on a line?)")
    return u, singular, vt, size


def _leverage(jacobian: Array) -> Array:
    """Diagonal of the hat matrix, of the least-squares fit without robust weights."""
    u = _scaled_svd(jacobian)[0]
    return np.minimum((u**2).sum(axis=1), LARGEST_LEVERAGE)


def _inverse(jacobian: Array) -> Array:
    """A matrix B (P, P) with B B^T = (J^T J)^-1."""
    _, singular, vt, size = _scaled_svd(jacobian)
    return np.asarray(vt.T / singular / size[:, None])


def _sensitivity(jacobian: Array, weights: Array) -> Array:
    """Derivative of the coefficients by the values (P, N), of the weighted fit."""
    root = np.sqrt(weights)
    u, singular, vt, size = _scaled_svd(root[:, None] * jacobian)
    return np.asarray((vt.T / singular) @ u.T / size[:, None] * root)
