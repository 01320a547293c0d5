"""Patterns against physical optics written once more, from text-book formulas, over another grid, with nothing taken from rf.

The feed's field is written in its own spherical coordinates (Balanis, Antenna Theory, section 15.4), the surface is differentiated by
differences, Zernike terms are their sums of factorials, and the far field is in theta and phi before Ludwig's third definition.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.rf.antenna import Antenna, Feed, Reflector
from dishmap.rf.correction import no_correction
from dishmap.rf.deformation import Deformation
from dishmap.rf.farfield import far_field
from dishmap.rf.sources import sampled, sources, wavelength_of
from dishmap.surface.zernike import zernike_terms

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# down to -40 dB of the peak: Simpson's rule over 161 rings leaves 1e-6 of the peak, 0.001 dB there
PATTERN_DB, FLOOR_DB = 0.01, -40.0
TAPER_DB = 12.0


def factorial_zernike(n: int, m: int, x: Array, y: Array) -> Array:
    rho, theta = np.hypot(x, y), np.arctan2(y, x)
    radial = sum(
        (-1) ** k
        * math.factorial(n - k)
        / (math.factorial(k) * math.factorial((n + abs(m)) // 2 - k) * math.factorial((n - abs(m)) // 2 - k))
        * rho ** (n - 2 * k)
        for k in range((n - abs(m)) // 2 + 1)
    )
    return np.asarray(radial * (np.cos(m * theta) if m >= 0 else np.sin(-m * theta)))


def point(x: Array, y: Array, f: float, offset: float, radius: float, terms: dict[tuple[int, int], float]) -> Array:
    d = np.zeros_like(x)
    for (n, m), value in terms.items():
        d = d + value * factorial_zernike(n, m, (x - offset) / radius, y / radius)
    n0 = np.stack([-x / (2 * f), -y / (2 * f), np.ones_like(x)], axis=-1)
    return np.stack([x, y, (x**2 + y**2) / (4 * f)], axis=-1) + d[..., None] * n0 / np.linalg.norm(n0, axis=-1, keepdims=True)


def feed_at(points: Array, f: float, axis_rad: float, edge_rad: float, sign: float) -> Complex:
    """Field of a Gaussian Huygens feed at F1, polarised along x in its plane, with sign +1 for x and the other axis else."""
    z = np.array([np.sin(axis_rad), 0.0, -np.cos(axis_rad)])
    x = np.array([np.cos(axis_rad), 0.0, np.sin(axis_rad)])
    y = np.cross(z, x)
    way = points - [0, 0, f]
    r = np.linalg.norm(way, axis=-1)
    theta = np.arctan2(np.hypot(way @ x, way @ y), way @ z)
    phi = np.arctan2(way @ y, way @ x)
    at = np.linspace(0, np.pi, 40001)
    pattern = 10 ** (-TAPER_DB / 20 * (at / edge_rad) ** 2)
    power = 2 * np.pi * np.trapezoid(pattern**2 * np.sin(at), at)
    amplitude = 10 ** (-TAPER_DB / 20 * (theta / edge_rad) ** 2) / np.sqrt(power) / r
    ct, st, cp, sp = (t[..., None] for t in (np.cos(theta), np.sin(theta), np.cos(phi), np.sin(phi)))
    e_theta, e_phi = ct * cp * x + ct * sp * y - st * z, -sp * x + cp * y
    along_x, along_y = cp * e_theta - sp * e_phi, sp * e_theta + cp * e_phi
    field = along_x + 0j if sign > 0 else along_y + 0j
    return np.asarray(amplitude[..., None] * field)


def textbook(
    u: Array, v: Array, wavelength: float, offset: float, terms: dict[tuple[int, int], float], y_polarised: bool = False
) -> tuple[Complex, Complex]:
    """Gain-normalised co and cross field of a 600 mm dish with f = 300 mm; Simpson along the radius, equal steps around."""
    f, radius, k = 300.0, 300.0, 2 * np.pi / wavelength
    rings, spokes = 161, 240
    rho = np.linspace(0, 1, rings)
    simpson = np.where(np.arange(rings) % 2, 4.0, 2.0) / (3 * (rings - 1))
    simpson[[0, -1]] /= 2
    phi = 2 * np.pi * np.arange(spokes) / spokes
    r, p = np.meshgrid(rho * radius, phi, indexing="ij")
    x, y = offset + r * np.cos(p), r * np.sin(p)
    h = 1e-3
    points = point(x, y, f, offset, radius, terms)
    by_x = (point(x + h, y, f, offset, radius, terms) - point(x - h, y, f, offset, radius, terms)) / (2 * h)
    by_y = (point(x, y + h, f, offset, radius, terms) - point(x, y - h, f, offset, radius, terms)) / (2 * h)
    area = np.cross(by_x, by_y) * (r * simpson[:, None] * radius * 2 * np.pi / spokes)[..., None]
    ends = [math.atan2(e, f - e**2 / (4 * f)) for e in (offset - radius, offset + radius)]
    e = feed_at(points, f, sum(ends) / 2, (ends[1] - ends[0]) / 2, -1.0 if y_polarised else 1.0)
    way = points - [0, 0, f]
    distance = np.linalg.norm(way, axis=-1)
    current = 2 * np.cross(area, np.cross(way / distance[..., None], e)) * np.exp(-1j * k * distance)[..., None]
    flat, places = current.reshape(-1, 3), points.reshape(-1, 3)
    theta, azimuth = np.arcsin(np.hypot(u, v)), np.arctan2(v, u)
    co, cross = np.empty(len(u), complex), np.empty(len(u), complex)
    for i, (t, a) in enumerate(zip(theta, azimuth, strict=True)):
        out = np.array([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)])
        total = np.exp(1j * k * (places @ out)) @ flat
        e_theta = total @ [np.cos(t) * np.cos(a), np.cos(t) * np.sin(a), -np.sin(t)]
        e_phi = total @ [-np.sin(a), np.cos(a), 0.0]
        x_like = e_theta * np.cos(a) - e_phi * np.sin(a)
        y_like = e_theta * np.sin(a) + e_phi * np.cos(a)
        co[i], cross[i] = (y_like, x_like) if y_polarised else (x_like, y_like)
    scale = -1j * k / np.sqrt(4 * np.pi)
    return scale * co, scale * cross


def random_terms() -> dict[tuple[int, int], float]:
    terms = [t for t in zernike_terms(6) if t[0] > 1]
    values = np.random.default_rng(12).normal(size=len(terms))
    # 1 mm rms over the disc: the mean square of an unnormalised term is (2 if m = 0 else 1) / (2 (n + 1))
    mean2 = sum(v**2 * (1.0 if m == 0 else 0.5) / (n + 1) for (n, m), v in zip(terms, values, strict=True))
    return {t: float(v / np.sqrt(mean2)) for t, v in zip(terms, values, strict=True)}


DIRECTIONS = np.concatenate([np.linspace(-0.12, 0.12, 31)[:, None] * [np.cos(a), np.sin(a)] for a in np.radians([0.0, 45.0, 90.0])])
CASES = [
    ("perfect", 0.0, False, "x"),
    ("deformed", 0.0, True, "x"),
    ("offset", 350.0, False, "x"),
    ("offset_y", 350.0, False, "y"),
    ("offset_deformed", 350.0, True, "y"),
]


@pytest.mark.parametrize(("offset", "deformed", "polarization"), [c[1:] for c in CASES], ids=[c[0] for c in CASES])
def test_patterns_against_direct_integration(offset: float, deformed: bool, polarization: str) -> None:
    whole = Antenna(Reflector(600, 300, offset), Feed("gaussian", TAPER_DB, polarization=polarization))
    wavelength = wavelength_of(whole, 30.0)
    terms = random_terms() if deformed else {}
    d = Deformation(tuple(terms), np.array(list(terms.values())), whole.reflector.center_mm, 300.0)
    made = sources(whole, d, no_correction(whole), sampled(whole, d, wavelength, 0.12))
    u, v = DIRECTIONS.T
    co, cross = far_field(made, wavelength, u, v, polarization)
    co_ref, cross_ref = textbook(u, v, wavelength, offset, terms, polarization == "y")
    if polarization == "y":
        # the feed's own y axis is dish -y: only the sign of the whole field
        sign = np.sign((co * co_ref.conj()).sum().real)
        co_ref, cross_ref = sign * co_ref, sign * cross_ref
    peak = np.abs(co_ref).max()
    for ours, theirs in ((co, co_ref), (cross, cross_ref)):
        seen = np.abs(theirs) > peak * 10 ** (FLOOR_DB / 20)
        # centred dishes cross-polarise less than that
        assert seen.sum() > 5 or (theirs is cross_ref and not offset)
        assert not seen.any() or np.abs(20 * np.log10(np.abs(ours[seen]) / np.abs(theirs[seen]))).max() < PATTERN_DB
        # phases too: the error is far below the field everywhere
        assert np.abs(ours - theirs).max() < 1e-4 * peak


def test_the_comparison_sees_a_slightly_wrong_dish() -> None:
    """Two hundredths of a millimetre of astigmatism exceed the tolerance."""
    u, v = DIRECTIONS.T
    right, _ = textbook(u, v, 10.0, 0.0, {})
    wrong, _ = textbook(u, v, 10.0, 0.0, {(2, 2): 0.02})
    seen = np.abs(right) > np.abs(right).max() * 10 ** (FLOOR_DB / 20)
    assert np.abs(20 * np.log10(np.abs(wrong[seen]) / np.abs(right[seen]))).max() > PATTERN_DB
