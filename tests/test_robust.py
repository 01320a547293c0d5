"""Algorithm 4 against MATLAB's published example, a plain transcription of its formulas, sampling, and its own symmetries."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dishmap.errors import FitError, InputError
from dishmap.robust import TUNING, bisquare_weights, mad_scale, robust_fit, robust_linear_fit

Array = NDArray[np.float64]

# MATLAB's documentation gives 4 decimals
PRINTED = 6e-5
# two implementations that both stop when steps are below 1e-8 of the scale
SAME = 1e-6
# 250 draws estimate a standard deviation to 4.5 %; not quite three times that
SAMPLING = 0.12

# Documentation of robustfit, "Compare robust and least-squares regression": x = (1:10)', y = 10 - 2*x + randn(10,1),
# y(10) = 0, with rng('default'); the documented results are 7.8518, -1.3644 for least squares and 8.4504, -1.5278.
MATLAB_RANDN = [
    *(0.537667139546100, 1.833885014595086, -2.258846861003648, 0.862173320368121, 0.318765239858981),
    *(-1.307688296305273, -0.433592022305684, 0.342624466538650, 3.578396939725760, 2.769437029884877),
]


def line(n: int) -> Array:
    x = np.arange(1.0, n + 1)
    return np.column_stack([np.ones(n), x])


def matlab_example() -> tuple[Array, Array]:
    x = line(10)
    y = 10 - 2 * x[:, 1] + np.array(MATLAB_RANDN)
    y[9] = 0.0
    return x, y


def transcribed(x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Algorithm 4 with robustfit's details by normal equations: coefficients, weights, standard errors."""
    n, p = x.shape
    inverse = np.linalg.inv(x.T @ x)
    h = np.minimum(np.diag(x @ inverse @ x.T), 0.9999)
    b = inverse @ x.T @ y
    ols = np.sqrt(((y - x @ b) ** 2).sum() / (n - p))
    for _ in range(200):
        radj = (y - x @ b) / np.sqrt(1 - h)
        s = max(np.median(np.sort(np.abs(radj))[p - 1 :]) / 0.6745, 1e-6 * y.std())
        u = radj / (4.685 * s)
        w = np.where(np.abs(u) < 1, (1 - u**2) ** 2, 0)
        b = np.linalg.solve(x.T @ (w[:, None] * x), x.T @ (w * y))

    def phi(v: Array) -> Array:
        return v * np.where(np.abs(v) < 1, (1 - v**2) ** 2, 0)

    step = 1e-4
    m1 = np.mean((phi(u + step) - phi(u - step)) / (2 * step))
    m2 = ((1 - h) * phi(u) ** 2).sum() / (n - p)
    robust = (1 + p / n * (1 - m1) / m1) * np.sqrt(m2) * s * 4.685 / m1
    sigma = max(robust, np.sqrt((ols**2 * p**2 + robust**2 * n) / (p**2 + n)))
    return b, w, sigma * np.sqrt(np.diag(inverse))


def test_matlabs_published_example() -> None:
    x, y = matlab_example()
    # the data are the documented ones: plain least squares gives the documented line
    np.testing.assert_allclose(np.linalg.lstsq(x, y)[0], [7.8518, -1.3644], atol=PRINTED)
    fit = robust_linear_fit(x, y, start="least-squares")
    np.testing.assert_allclose(fit.coefficients, [8.4504, -1.5278], atol=PRINTED)
    assert fit.converged
    # ... and another constant would not have given it
    other = robust_linear_fit(x, y, tuning=4.685 * 1.01, start="least-squares")
    assert np.abs(other.coefficients - [8.4504, -1.5278]).max() > 10 * PRINTED


@pytest.mark.parametrize("seed", range(8))
def test_equals_the_transcribed_formulas(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = np.column_stack([np.ones(40), rng.normal(size=(40, 3))])
    y = x @ [1.0, -2.0, 3.0, 0.5] + rng.standard_t(3, size=40)
    fit = robust_linear_fit(x, y, start="least-squares")
    b, w, error = transcribed(x, y)
    np.testing.assert_allclose(fit.coefficients, b, atol=SAME)
    np.testing.assert_allclose(fit.weights, w, atol=SAME)
    np.testing.assert_allclose(np.sqrt(np.diag(fit.covariance)), error, rtol=1e-5)
    np.testing.assert_allclose(fit.residuals, y - x @ b, atol=1e-5)


def test_both_starts_end_at_the_same_fit_of_ordinary_data() -> None:
    rng = np.random.default_rng(3)
    x = np.column_stack([np.ones(200), rng.normal(size=(200, 4))])
    y = x @ np.ones(5) + rng.normal(size=200)
    a, b = (robust_linear_fit(x, y, start=start) for start in ("least-squares", "least-absolute"))
    np.testing.assert_allclose(a.coefficients, b.coefficients, atol=SAME)


@pytest.mark.parametrize(("part", "size"), [(0.1, 5.0), (0.3, 10.0), (0.4, 100.0)])
def test_outliers_to_one_side_do_not_matter(part: float, size: float) -> None:
    rng = np.random.default_rng(7)
    n = 120
    x = np.column_stack([np.ones(n), rng.uniform(-1, 1, (n, 2))])
    truth = np.array([10.0, 1.0, -2.0])
    noise = 0.1
    y = x @ truth + noise * rng.normal(size=n)
    bad = rng.permutation(n)[: int(part * n)]
    y[bad] += size
    fit = robust_linear_fit(x, y)
    error = np.abs(fit.coefficients - truth) / np.sqrt(np.diag(fit.covariance))
    assert fit.converged
    assert (fit.weights[bad] == 0).all()
    assert np.count_nonzero(fit.weights == 0) <= len(bad) + 2
    assert error.max() < 4
    # least squares, beside it, is off by far more
    assert abs(np.linalg.lstsq(x, y)[0][0] - truth[0]) > 0.5 * part * size


def test_more_than_half_wrong_follows_the_majority() -> None:
    rng = np.random.default_rng(5)
    x = line(101)
    y = np.where(np.arange(101) % 2 == 0, 3.0, 50.0) + 0.01 * rng.normal(size=101)
    fit = robust_linear_fit(x[:, :1], y)
    # 51 values say 3, 50 say 50: the one estimate or the other or a wide one, but never a narrow one between
    assert abs(fit.coefficients[0] - 3) < 0.1 or np.sqrt(fit.covariance[0, 0]) > 1


def test_exact_values_with_one_outlier() -> None:
    x = line(20)
    y = x @ [3.0, 0.25]
    y[4] += 1.0
    fit = robust_linear_fit(x, y)
    np.testing.assert_allclose(fit.coefficients, [3.0, 0.25], atol=1e-9)
    assert np.flatnonzero(fit.weights < 0.5).tolist() == [4]
    assert fit.converged


def test_an_exact_fit_has_no_outliers() -> None:
    x = line(20)
    for y in (x @ [3.0, 0.25], np.zeros(20), np.full(20, 1e6)):
        fit = robust_linear_fit(x, y)
        assert fit.weights.min() > 0.99
        np.testing.assert_allclose(fit.residuals, 0, atol=1e-9 * max(1, abs(y).max()))
        assert fit.converged


def test_more_than_half_of_the_values_exact() -> None:
    """The scale is 0 then: what is not exact is an outlier."""
    x = line(21)
    y = x @ [1.0, 2.0]
    y[::3] += np.linspace(0.5, 3.0, 7)
    fit = robust_linear_fit(x, y)
    np.testing.assert_allclose(fit.coefficients, [1.0, 2.0], atol=1e-6)
    assert (fit.weights[::3] == 0).all()


@given(st.integers(0, 1000), st.floats(0.01, 100), st.lists(st.floats(-10, 10), min_size=2, max_size=2))
def test_moves_with_the_values(seed: int, factor: float, shift: list[float]) -> None:
    """Scaling the values and adding a line to them scales the line and adds to it; weights stay."""
    rng = np.random.default_rng(seed)
    x = np.column_stack([np.ones(30), rng.normal(size=30)])
    y = x @ [1.0, 2.0] + rng.standard_t(2, size=30)
    a = robust_linear_fit(x, y, start="least-squares")
    b = robust_linear_fit(x, factor * y + x @ shift, start="least-squares")
    np.testing.assert_allclose(b.coefficients, factor * a.coefficients + shift, rtol=1e-5, atol=1e-5 * factor)
    np.testing.assert_allclose(a.weights, b.weights, atol=1e-5)
    assert b.spread == pytest.approx(factor * a.spread, rel=1e-5)


def test_order_of_the_points_does_not_matter() -> None:
    x, y = matlab_example()
    turn = np.random.default_rng(0).permutation(10)
    a, b = robust_linear_fit(x, y), robust_linear_fit(x[turn], y[turn])
    np.testing.assert_allclose(a.coefficients, b.coefficients, atol=SAME)
    np.testing.assert_allclose(a.weights[turn], b.weights, atol=SAME)


def test_claimed_covariance_is_the_sampled_one() -> None:
    rng = np.random.default_rng(11)
    x = np.column_stack([np.ones(60), rng.uniform(-1, 1, (60, 2))])
    fits = [robust_linear_fit(x, x @ [1.0, 2.0, 3.0] + 0.3 * rng.normal(size=60)) for _ in range(300)]
    sampled = np.std([f.coefficients for f in fits], axis=0)
    claimed = np.sqrt(np.mean([np.diag(f.covariance) for f in fits], axis=0))
    np.testing.assert_allclose(claimed, sampled, rtol=SAMPLING)
    assert np.mean([f.spread for f in fits]) == pytest.approx(0.3, rel=0.05)


def test_prior_sigmas_weigh_and_bound_the_covariance() -> None:
    rng = np.random.default_rng(12)
    sigma = rng.uniform(0.4, 2.0, 80)
    x = np.column_stack([np.ones(80), rng.uniform(-1, 1, 80)])
    fits = [robust_linear_fit(x, x @ [1.0, 2.0] + sigma * rng.normal(size=80), sigma) for _ in range(250)]
    sampled = np.std([f.coefficients for f in fits], axis=0)
    best = np.sqrt(np.diag(np.linalg.inv(x.T @ (x / sigma[:, None] ** 2))))
    # bisquare weights cost 5 % of variance against the best linear estimate
    np.testing.assert_allclose(sampled, 1.026 * best, rtol=SAMPLING)
    claimed = np.array([np.sqrt(np.diag(f.covariance)) for f in fits])
    np.testing.assert_allclose(claimed.mean(axis=0), sampled, rtol=SAMPLING)
    assert (claimed >= best * (1 - 1e-9)).all()


def test_sensitivity_is_the_response_to_a_small_change() -> None:
    x, y = matlab_example()
    fit = robust_linear_fit(x, y, np.linspace(1, 2, 10))
    # the weighted normal equations at the fitted weights
    w = fit.weights / np.linspace(1, 2, 10) ** 2
    np.testing.assert_allclose(fit.sensitivity, np.linalg.solve(x.T @ (w[:, None] * x), x.T * w), atol=1e-10)


def test_nonlinear_model_with_outliers() -> None:
    rng = np.random.default_rng(4)
    t = np.linspace(0, 4, 60)
    y = 5 * np.exp(-0.7 * t) + 1 + 0.01 * rng.normal(size=60)
    y[10:20] += 2.0

    def model(b: Array) -> tuple[Array, Array]:
        e = np.exp(-b[1] * t)
        return y - b[0] * e - b[2], np.column_stack([e, -b[0] * t * e, np.ones(60)])

    fit = robust_fit(model, [1.0, 0.2, 0.0], y)
    assert fit.converged
    assert (fit.weights[10:20] == 0).all()
    assert (np.abs(fit.coefficients - [5, 0.7, 1]) < 4 * np.sqrt(np.diag(fit.covariance))).all()
    # at the fit the weighted residuals are orthogonal to the derivatives
    r, jacobian = model(fit.coefficients)
    assert np.abs(jacobian.T @ (fit.weights * r)).max() < 1e-7
    # the same minimum by another library, over the points that were kept
    from scipy.optimize import least_squares

    root = np.sqrt(fit.weights)
    other = least_squares(lambda b: root * model(b)[0], [4.0, 0.5, 0.5], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(fit.coefficients, other.x, atol=SAME)


def test_weights_and_scale_are_the_published_formulas() -> None:
    np.testing.assert_allclose(bisquare_weights([0, 0.5, -0.5, 1, -3]), [1, 0.5625, 0.5625, 0, 0])
    # median of |r| is 3; without the smallest one 3.5; without two 4
    assert mad_scale([1, -2, 3, -4, 5], 1) == pytest.approx(3 / 0.6745)
    assert mad_scale([1, -2, 3, -4, 5], 2) == pytest.approx(3.5 / 0.6745)
    assert mad_scale([1, -2, 3, -4, 5], 3) == pytest.approx(4 / 0.6745)
    assert TUNING == 4.685


@pytest.mark.parametrize(
    ("x", "y", "sigma", "error", "text"),
    [
        (line(2), [1, 2], None, FitError, "2 points are too few to fit 2 coefficients; at least 3 are needed"),
        (np.ones((5, 2)), np.arange(5), None, FitError, "the points determine only 1 of 2 coefficients"),
        (line(4), [1, 2, np.nan, 4], None, InputError, "hold NaN or infinity"),
        (line(4), [1, 2, 3], None, InputError, r"not \(4, 2\) and \(3,\)"),
        (line(4), [1, 2, 3, 4], [1, 1, 0, 1], InputError, "sigma must be positive"),
        (line(4), [1, 2, 3, 4], [1, 1], InputError, "one number for each of 4 values"),
    ],
)
def test_unusable_input_is_refused(x, y, sigma, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        robust_linear_fit(x, y, sigma)


def test_unknown_start_is_refused() -> None:
    with pytest.raises(InputError, match="unknown start 'huber' of a robust fit; use one of least-absolute, least-squares, given"):
        robust_linear_fit(line(4), [1, 2, 3, 4], start="huber")
