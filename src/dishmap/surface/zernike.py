"""Zernike polynomials on the unit disc, unnormalised: every radial part is 1 at the rim.

Z(n, m) = R(n, |m|)(rho) cos(m theta) for m >= 0 and R(n, |m|)(rho) sin(|m| theta) for m < 0, with
R(n, m)(rho) = rho^m P_k^(0,m)(2 rho^2 - 1), k = (n - m)/2, P the Jacobi polynomial (Born & Wolf, Principles of Optics,
section 9.2.1, up to their normalisation). Terms are named by (n, m) or in words, as `astigmatism_cos`.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Sequence
from functools import cache
from math import comb, factorial

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import eval_jacobi

from dishmap.errors import InputError

Array = NDArray[np.float64]

# Far above any shape that targets can resolve; a larger one is a mistake in the input.
LARGEST_DEGREE = 60

_ORDERS = ("", "secondary_", "tertiary_", "quaternary_")
_FAMILIES = {2: "astigmatism", 3: "trefoil", 4: "tetrafoil", 5: "pentafoil", 6: "hexafoil"}
_SHORT = {"astig": "astigmatism", "focus": "defocus", "x_tilt": "tip", "y_tilt": "tilt"}


def zernike(n: int, m: int, rho: ArrayLike, theta_rad: ArrayLike) -> Array:
    """Zernike term (n, m) at polar coordinates of the unit disc, broadcast together.

    m > 0 is the cosine term, m < 0 the sine term. Holds outside the disc too, where it grows as rho^n.
    Raises InputError for an impossible (n, m).
    """
    rho, theta = np.asarray(rho, dtype=float), np.asarray(theta_rad, dtype=float)
    return zernike_xy(n, m, rho * np.cos(theta), rho * np.sin(theta))


def zernike_xy(n: int, m: int, x: ArrayLike, y: ArrayLike) -> Array:
    """Zernike term (n, m) at Cartesian coordinates in units of the disc's radius, broadcast together."""
    z, square, k, order = _prepare(n, m, x, y)
    radial = eval_jacobi(k, 0, order, 2 * square - 1)
    return np.asarray(radial * _part(z**order, m))


def zernike_gradient(n: int, m: int, x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
    """Derivatives of the term (n, m) along x and y, per radius, at Cartesian coordinates in units of the radius."""
    z, square, k, order = _prepare(n, m, x, y)
    radial = eval_jacobi(k, 0, order, 2 * square - 1)
    # d/ds P_k^(0,m)(2s - 1) = (k + m + 1) P_{k-1}^(1,m+1)(2s - 1), s = rho^2
    slope = (k + order + 1) * eval_jacobi(k - 1, 1, order + 1, 2 * square - 1) if k else np.zeros_like(square)
    turn = _part(z**order, m)
    power = order * z ** (order - 1) if order else np.zeros_like(z)
    by_x = 2 * z.real * slope * turn + radial * _part(power, m)
    by_y = 2 * z.imag * slope * turn + radial * _part(1j * power, m)
    return np.asarray(by_x), np.asarray(by_y)


def zernike_terms(max_degree: int) -> tuple[tuple[int, int], ...]:
    """All (n, m) up to a degree, in the OSA/ANSI order: n rising, in each m from -n to n in steps of 2."""
    _check(max_degree, max_degree)
    return tuple((n, m) for n in range(max_degree + 1) for m in range(-n, n + 1, 2))


def zernike_matrix(terms: Sequence[tuple[int, int]], x: ArrayLike, y: ArrayLike) -> Array:
    """Values (..., T) of terms (n, m) at points (...,) in units of the radius: the design matrix of a fit."""
    out = np.zeros((np.size(x), len(terms)))
    for order, members, z, t in _orders(terms, x, y):
        power = z**order
        for k, radial in enumerate(_jacobi(order, max(members), t)):
            for column, m in members.get(k, ()):
                out[:, column] = radial * _part(power, m)
    return out.reshape(*np.shape(x), len(terms))


def zernike_sum(terms: Sequence[tuple[int, int]], coefficients: ArrayLike, x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
    """Sum (N,) of terms (T) times coefficients (T,) at points (N,) in units of the radius, and its gradient (N, 2) per radius."""
    factor = np.asarray(coefficients, dtype=float)
    value, gradient = np.zeros(np.size(x)), np.zeros((np.size(x), 2))
    for order, members, z, t in _orders(terms, x, y):
        # a cos(m theta) + b sin(m theta) = Re (a - j b) exp(j m theta)
        both = np.zeros(max(members) + 1, complex)
        for k, places in members.items():
            for place, m in places:
                both[k] += factor[place] if m >= 0 else -1j * factor[place]
        total, slope = np.zeros(len(t), complex), np.zeros(len(t), complex)
        before, now, by_before, by_now = np.zeros_like(t), np.ones_like(t), np.zeros_like(t), np.zeros_like(t)
        for k, weight in enumerate(both):
            total += weight * now
            slope += weight * by_now
            rise, shift, back = _recurrence(order, k)
            before, now, by_before, by_now = (
                now,
                (rise * t + shift) * now - back * before,
                by_now,
                (rise * t + shift) * by_now + rise * now - back * by_before,
            )
        power = z**order
        turn = order * z ** max(order - 1, 0) * total
        # t = 2 rho^2 - 1
        outward = 4 * (power * slope).real
        value += (power * total).real
        gradient += np.stack([outward * z.real + turn.real, outward * z.imag - turn.imag], axis=1)
    return value, gradient


@cache
def zernike_monomials(terms: tuple[tuple[int, int], ...]) -> tuple[NDArray[np.int64], Array]:
    """Terms (T) as polynomials: powers (K, 2) of x and y, in units of the radius, and coefficients (K, T).

    Fast for many points and with all derivatives, but for low degrees only: from about the 20th on, large terms cancel.
    """
    degree = max((n for n, _ in terms), default=0)
    powers = [(p, q) for p in range(degree + 1) for q in range(degree + 1 - p)]
    place = {power: i for i, power in enumerate(powers)}
    matrix = np.zeros((len(powers), len(terms)))
    for column, (n, m) in enumerate(terms):
        _check(n, m)
        order, k = abs(m), (n - abs(m)) // 2
        for s in range(k + 1):
            radial = (-1) ** s * factorial(n - s) // (factorial(s) * factorial((n + order) // 2 - s) * factorial(k - s))
            for a in range(k - s + 1):
                for b in range(order + 1):
                    # (x^2 + y^2)^(k-s) (x + i y)^order, its real or imaginary part
                    turn = 1j**b if m >= 0 else 1j ** (b + 3)
                    power = (2 * (k - s - a) + order - b, 2 * a + b)
                    matrix[place[power], column] += radial * comb(k - s, a) * comb(order, b) * turn.real
    return np.array(powers), matrix


def term_name(n: int, m: int) -> str:
    """The name of a term: `piston`, `tip` (cos), `tilt` (sin), `defocus`, `astigmatism_cos`, ...; `z_9_-1` for those without one."""
    _check(n, m)
    order, k = abs(m), (n - abs(m)) // 2
    if order == 0:
        family, k, suffix = (("piston", "defocus")[k], 0, "") if k < 2 else ("spherical", k - 2, "")
    elif order == 1:
        family, k, suffix = (("tip" if m > 0 else "tilt"), 0, "") if k == 0 else ("coma", k - 1, _suffix(m))
    else:
        family, suffix = _FAMILIES.get(order, ""), _suffix(m)
    return f"{_ORDERS[k]}{family}{suffix}" if family and k < len(_ORDERS) else f"z_{n}_{m}"


def parse_term(name: str) -> tuple[int, int]:
    """The (n, m) of a name as `term_name` gives it, or as `2,-2` or `z_2_-2`; without `_cos` or `_sin` the cosine term is meant.

    Raises InputError with the nearest name when there is no such term.
    """
    text = name.strip().lower().replace(" ", "_")
    numbers = re.fullmatch(r"z?[_(]?(\d+)[,_]_?(-?\d+)\)?", text)
    if numbers:
        n, m = int(numbers[1]), int(numbers[2])
        _check(n, m)
        return n, m
    stem = re.sub(r"_(cos|sin)$", "", text)
    text = text.replace(stem, _SHORT.get(stem, stem), 1)
    for candidate in (text, f"{text}_cos"):
        if candidate in _BY_NAME:
            return _BY_NAME[candidate]
    near = difflib.get_close_matches(text, _BY_NAME, n=1, cutoff=0.0)
    raise InputError(f"unknown Zernike term {name!r}; the nearest name is {near[0]!r}, and numbers as '2,-2' (n, m) are understood too")


def _orders(
    terms: Sequence[tuple[int, int]], x: ArrayLike, y: ArrayLike
) -> Iterator[tuple[int, dict[int, list[tuple[int, int]]], NDArray[np.complex128], Array]]:
    """Terms by their |m|: it, k = (n - |m|) / 2 -> (place, m) of the terms, the points as complex numbers, and t = 2 rho^2 - 1."""
    z = np.ravel(np.asarray(x, dtype=float)) + 1j * np.ravel(np.asarray(y, dtype=float))
    t = 2 * (z.real**2 + z.imag**2) - 1
    orders: dict[int, dict[int, list[tuple[int, int]]]] = {}
    for place, (n, m) in enumerate(terms):
        _check(n, m)
        orders.setdefault(abs(m), {}).setdefault((n - abs(m)) // 2, []).append((place, m))
    for order, members in orders.items():
        yield order, members, z, t


def _jacobi(order: int, last: int, t: Array) -> Iterator[Array]:
    """Jacobi polynomials P_k^(0,m)(t) for k = 0 to `last`."""
    before, now = np.zeros_like(t), np.ones_like(t)
    for k in range(last + 1):
        yield now
        rise, shift, back = _recurrence(order, k)
        before, now = now, (rise * t + shift) * now - back * before


def _recurrence(m: int, k: int) -> tuple[float, float, float]:
    """P_(k+1) = (a t + b) P_k - c P_(k-1) for P^(0,m) (Abramowitz and Stegun 22.7.1)."""
    if k == 0:
        return (m + 2) / 2, -m / 2, 0.0
    both = 2 * (k + 1) * (k + m + 1) * (2 * k + m)
    return (
        (2 * k + m) * (2 * k + m + 1) * (2 * k + m + 2) / both,
        -(m**2) * (2 * k + m + 1) / both,
        2 * k * (k + m) * (2 * k + m + 2) / both,
    )


def _prepare(n: int, m: int, x: ArrayLike, y: ArrayLike) -> tuple[NDArray[np.complex128], Array, int, int]:
    _check(n, m)
    z = np.asarray(x, dtype=float) + 1j * np.asarray(y, dtype=float)
    return z, z.real**2 + z.imag**2, (n - abs(m)) // 2, abs(m)


def _part(z: NDArray[np.complex128], m: int) -> Array:
    return np.asarray(z.real if m >= 0 else z.imag)


def _suffix(m: int) -> str:
    return "_cos" if m > 0 else "_sin"


def _check(n: int, m: int) -> None:
    if not (0 <= abs(m) <= n <= LARGEST_DEGREE) or (n - m) % 2:
        raise InputError(f"there is no Zernike term n={n}, m={m}: it needs |m| <= n <= {LARGEST_DEGREE} and n - m even")


_BY_NAME = {term_name(n, m): (n, m) for n, m in zernike_terms(12)}
