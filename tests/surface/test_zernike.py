"""Zernike terms against closed formulas, orthogonality integrals and the factorial sum, and their gradient against differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dishmap.errors import InputError
from dishmap.surface.zernike import (
    LARGEST_DEGREE,
    parse_term,
    term_name,
    zernike,
    zernike_gradient,
    zernike_matrix,
    zernike_monomials,
    zernike_sum,
    zernike_terms,
    zernike_xy,
)

# rounding of double precision in sums of a few terms of size 1
ROUNDING = 1e-12
# central differences with a step of 1e-6 of a function whose third derivative stays under 1e4 inside the disc
DIFFERENCE_TOLERANCE = 1e-6

# Born & Wolf, table 9.1, and Noll (1976), table 1, without normalisation
CLOSED = {
    (0, 0): lambda r, t: np.ones_like(r),
    (1, 1): lambda r, t: r * np.cos(t),
    (1, -1): lambda r, t: r * np.sin(t),
    (2, 0): lambda r, t: 2 * r**2 - 1,
    (2, 2): lambda r, t: r**2 * np.cos(2 * t),
    (2, -2): lambda r, t: r**2 * np.sin(2 * t),
    (3, 1): lambda r, t: (3 * r**3 - 2 * r) * np.cos(t),
    (3, -1): lambda r, t: (3 * r**3 - 2 * r) * np.sin(t),
    (3, 3): lambda r, t: r**3 * np.cos(3 * t),
    (3, -3): lambda r, t: r**3 * np.sin(3 * t),
    (4, 0): lambda r, t: 6 * r**4 - 6 * r**2 + 1,
    (4, 2): lambda r, t: (4 * r**4 - 3 * r**2) * np.cos(2 * t),
    (4, -4): lambda r, t: r**4 * np.sin(4 * t),
    (5, 1): lambda r, t: (10 * r**5 - 12 * r**3 + 3 * r) * np.cos(t),
    (6, 0): lambda r, t: 20 * r**6 - 30 * r**4 + 12 * r**2 - 1,
}


def polar_grid() -> tuple[np.ndarray, np.ndarray]:
    return np.meshgrid(np.linspace(0, 1, 21), np.linspace(-np.pi, np.pi, 37))


@pytest.mark.parametrize("term", CLOSED)
def test_equals_closed_formula(term: tuple[int, int]) -> None:
    rho, theta = polar_grid()
    np.testing.assert_allclose(zernike(*term, rho, theta), CLOSED[term](rho, theta), atol=ROUNDING)


@pytest.mark.parametrize("term", zernike_terms(9))
def test_equals_factorial_sum(term: tuple[int, int]) -> None:
    n, m = term
    rho, theta = polar_grid()
    radial = sum(
        (-1) ** k
        * math.factorial(n - k)
        / (math.factorial(k) * math.factorial((n + abs(m)) // 2 - k) * math.factorial((n - abs(m)) // 2 - k))
        * rho ** (n - 2 * k)
        for k in range((n - abs(m)) // 2 + 1)
    )
    angular = np.cos(m * theta) if m >= 0 else np.sin(-m * theta)
    np.testing.assert_allclose(zernike(n, m, rho, theta), radial * angular, atol=1e3 * ROUNDING)


def test_orthogonal_over_the_disc_with_the_known_norms() -> None:
    terms = zernike_terms(8)
    # exact quadrature: Gauss-Legendre in rho^2, equal steps in theta
    node, weight = np.polynomial.legendre.leggauss(12)
    square, theta = np.meshgrid((node + 1) / 2, 2 * np.pi * np.arange(24) / 24, indexing="ij")
    weights = np.repeat(weight[:, None] / 4, 24, axis=1).ravel() * 2 * np.pi / 24
    rho = np.sqrt(square).ravel()
    matrix = zernike_matrix(terms, rho * np.cos(theta.ravel()), rho * np.sin(theta.ravel()))
    gram = matrix.T @ (weights[:, None] * matrix)
    norms = [np.pi / (n + 1) * (1.0 if m == 0 else 0.5) for n, m in terms]
    np.testing.assert_allclose(gram, np.diag(norms), atol=ROUNDING)


@pytest.mark.parametrize("degree", [5, 20, LARGEST_DEGREE])
def test_one_at_the_rim(degree: int) -> None:
    for m in range(degree % 2, degree + 1, 2):
        assert zernike(degree, m, 1.0, 0.0) == pytest.approx(1.0, abs=1e-9)
        # between -1 and 1 inside: a sum of factorials would lose this at high degrees
        assert np.abs(zernike(degree, m, np.linspace(0, 1, 201), 0.3)).max() <= 1 + 1e-9


@given(st.sampled_from(zernike_terms(8)), st.floats(-1, 1), st.floats(-1, 1))
def test_gradient_equals_differences(term: tuple[int, int], x: float, y: float) -> None:
    step = 1e-6
    by_x, by_y = zernike_gradient(*term, x, y)
    scale = max(1.0, np.hypot(x, y) ** 8)
    assert by_x == pytest.approx(
        (zernike_xy(*term, x + step, y) - zernike_xy(*term, x - step, y)) / (2 * step), abs=DIFFERENCE_TOLERANCE * scale, rel=1e-6
    )
    assert by_y == pytest.approx(
        (zernike_xy(*term, x, y + step) - zernike_xy(*term, x, y - step)) / (2 * step), abs=DIFFERENCE_TOLERANCE * scale, rel=1e-6
    )


def test_matrix_and_sum_equal_the_terms_one_by_one() -> None:
    # recurrences lose a digit in ten degrees
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-1.05, 1.05, (2, 200))
    x[0] = y[0] = 0.0
    terms = zernike_terms(30)[::-1]
    each = np.stack([zernike_xy(n, m, x, y) for n, m in terms], axis=-1)
    assert np.abs(zernike_matrix(terms, x, y) - each).max() < 1e-10 * np.abs(each).max()
    coefficients = rng.normal(size=len(terms))
    slopes = np.stack([np.stack(zernike_gradient(n, m, x, y), axis=-1) for n, m in terms], axis=-1)
    value, gradient = zernike_sum(terms, coefficients, x, y)
    assert np.abs(value - each @ coefficients).max() < 1e-10 * np.abs(each).max()
    assert np.abs(gradient - slopes @ coefficients).max() < 1e-10 * np.abs(slopes).max()
    assert zernike_matrix((), x, y).shape == (200, 0)
    assert not zernike_sum((), (), x, y)[1].any()


def test_gradient_is_finite_at_the_origin() -> None:
    assert zernike_gradient(1, 1, 0.0, 0.0) == (pytest.approx(1.0), pytest.approx(0.0))
    assert zernike_gradient(3, -1, 0.0, 0.0) == (pytest.approx(0.0), pytest.approx(-2.0))


def test_terms_are_in_the_ansi_order() -> None:
    assert zernike_terms(2) == ((0, 0), (1, -1), (1, 1), (2, -2), (2, 0), (2, 2))
    # OSA/ANSI index j = (n (n + 2) + m) / 2
    assert [(n * (n + 2) + m) // 2 for n, m in zernike_terms(10)] == list(range(66))


@pytest.mark.parametrize(
    ("term", "name"),
    [
        ((0, 0), "piston"),
        ((1, 1), "tip"),
        ((1, -1), "tilt"),
        ((2, 0), "defocus"),
        ((2, 2), "astigmatism_cos"),
        ((2, -2), "astigmatism_sin"),
        ((3, 1), "coma_cos"),
        ((3, -3), "trefoil_sin"),
        ((4, 0), "spherical"),
        ((4, 2), "secondary_astigmatism_cos"),
        ((5, -1), "secondary_coma_sin"),
        ((6, 0), "secondary_spherical"),
        ((8, 8), "z_8_8"),
    ],
)
def test_names(term: tuple[int, int], name: str) -> None:
    assert term_name(*term) == name
    assert parse_term(name) == term


def test_every_name_reads_back() -> None:
    terms = zernike_terms(14)
    assert [parse_term(term_name(*term)) for term in terms] == list(terms)
    assert len({term_name(*term) for term in terms}) == len(terms)


@pytest.mark.parametrize(
    ("text", "term"), [("astig", (2, 2)), ("astig_sin", (2, -2)), ("Coma", (3, 1)), ("2,-2", (2, -2)), ("z_9_-1", (9, -1))]
)
def test_short_names(text: str, term: tuple[int, int]) -> None:
    assert parse_term(text) == term


def test_unknown_name_gives_the_nearest() -> None:
    with pytest.raises(InputError, match="'astigmatsm_cos'; the nearest name is 'astigmatism_cos'"):
        parse_term("astigmatsm_cos")


@pytest.mark.parametrize(("n", "m"), [(2, 1), (1, 3), (-1, 1), (LARGEST_DEGREE + 1, 1)])
def test_impossible_terms_are_refused(n: int, m: int) -> None:
    with pytest.raises(InputError, match=f"no Zernike term n={n}, m={m}"):
        zernike(n, m, 0.5, 0.0)


def test_terms_as_polynomials_are_the_same_terms() -> None:
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-0.8, 0.8, (2, 200))
    terms = zernike_terms(12)
    powers, matrix = zernike_monomials(terms)
    values = (x[:, None] ** powers[:, 0] * y[:, None] ** powers[:, 1]) @ matrix
    # coefficients of degree 12 reach 1e4, which takes four digits from the rounding
    assert values == pytest.approx(zernike_matrix(terms, x, y), abs=1e4 * ROUNDING)
