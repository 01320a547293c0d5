"""The far field of flat apertures with known patterns, transforms against plain sums, circular polarisation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar
from scipy.special import j1

from dishmap.rf.antenna import Antenna, Feed, Reflector
from dishmap.rf.aperture import ApertureNodes, aperture_nodes
from dishmap.rf.beam import main_beam
from dishmap.rf.correction import Correction, no_correction
from dishmap.rf.deformation import Deformation
from dishmap.rf.farfield import far_field, pattern_cut, pattern_grid, summed
from dishmap.rf.rays import Rays
from dishmap.rf.sources import Sources, sampled, sources, wavelength_of
from dishmap.surface.zernike import zernike_terms

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# what design figures are given to, and the quadrature reaches by far
GAIN_DB = 1e-3
# of the beam width
WIDTH = 1e-3
# sidelobes are known to two decimals
SIDELOBE_DB = 6e-3
DIAMETER_MM, WAVELENGTH_MM = 600.0, 10.0


def flat(shape: Callable[[Array], Array | Complex], polarization: Complex | None = None, rings: int = 60) -> tuple[Sources, float]:
    """A flat aperture that a wave from above lights with `shape` of rho, with power 1 over it; and its efficiency by plain integration."""
    whole = Antenna(Reflector(DIAMETER_MM, 300.0), Feed("gaussian", 12.0))
    nodes = aperture_nodes(whole, rings, 160, 0.0)
    e = np.array([1.0, 0, 0], complex) if polarization is None else polarization
    field = np.asarray(shape(np.linalg.norm(nodes.xy_mm, axis=1) / (DIAMETER_MM / 2)), complex)
    area = np.pi * DIAMETER_MM**2 / 4
    rho = (np.arange(200000) + 0.5) / 200000
    mean, mean2 = (float(np.abs(np.mean(2 * rho * v))) for v in (shape(rho), np.abs(shape(rho)) ** 2))
    return sheet(nodes, field / np.sqrt(area * mean2), e), mean**2 / mean2


def sheet(nodes: ApertureNodes, field: Complex, e: Complex) -> Sources:
    n = len(field)
    down, up = np.tile([0.0, 0.0, -1.0], (n, 1)), np.tile([0.0, 0.0, 1.0], (n, 1))
    vector = field[:, None] * e
    moment = 2 * np.cross(up, np.cross(down, vector)) * nodes.weight_mm2[:, None]
    rays = Rays(np.zeros(n), down, vector, np.zeros((n, 5)), np.zeros(n, bool), np.full((n, 3), np.nan))
    return Sources(nodes, up, np.column_stack([nodes.xy_mm, np.zeros(n)]), moment, rays, np.abs(field) ** 2 * nodes.weight_mm2)


def gain(made: Sources, sine: Array | float) -> Array:
    """In the plane across the polarisation, where a flat sheet has no obliquity."""
    v = np.atleast_1d(np.asarray(sine, dtype=float))
    return np.abs(far_field(made, WAVELENGTH_MM, 0 * v, v, "x")[0]) ** 2


def half_power_width(made: Sources) -> float:
    """In wavelengths over diameters, of the sine."""
    peak = gain(made, 0.0)[0]
    scale = WAVELENGTH_MM / DIAMETER_MM
    return 2 * float(brentq(lambda w: gain(made, w * scale)[0] / peak - 0.5, 0.2, 1.0))


def first_sidelobe_db(made: Sources) -> float:
    """Below the peak, by a fine scan and a search about its first maximum after a minimum."""
    scale = WAVELENGTH_MM / DIAMETER_MM
    w = np.linspace(0.3, 4, 800)
    level = gain(made, w * scale)
    null = int(np.flatnonzero((level[1:-1] < level[:-2]) & (level[1:-1] < level[2:]))[0]) + 1
    top = null + int(np.flatnonzero((level[null + 1 : -1] > level[null:-2]) & (level[null + 1 : -1] > level[null + 2 :]))[0]) + 1
    best = minimize_scalar(lambda x: -gain(made, x * scale)[0], bounds=(w[top - 2], w[top + 2]), method="bounded", options={"xatol": 1e-8})
    return float(10 * np.log10(-best.fun / gain(made, 0.0)[0]))


def taper(rho: Array) -> Array:
    return np.asarray(10 ** (-12 / 20 * rho**2))


@pytest.mark.parametrize(
    ("shape", "efficiency", "width", "sidelobe_db"),
    [
        (np.ones_like, 1.0, 1.029, -17.57),
        (lambda rho: 1 - rho**2, 0.75, 1.270, -24.64),
        (taper, 0.8664, 1.1765, -26.36),
    ],
    ids=["uniform", "parabolic", "gaussian"],
)
def test_apertures_in_every_text_book(shape: Callable[[Array], Array], efficiency: float, width: float, sidelobe_db: float) -> None:
    made, integrated = flat(shape)
    assert integrated == pytest.approx(efficiency, abs=5e-5)
    expected = integrated * (np.pi * DIAMETER_MM / WAVELENGTH_MM) ** 2
    assert 10 * np.log10(gain(made, 0.0)[0] / expected) == pytest.approx(0, abs=GAIN_DB)
    assert half_power_width(made) == pytest.approx(width, rel=WIDTH)
    assert first_sidelobe_db(made) == pytest.approx(sidelobe_db, abs=SIDELOBE_DB)
    # and so the record of the beam says, in the same plane
    beam = main_beam(made, WAVELENGTH_MM, DIAMETER_MM, "x")
    assert beam.gain_dbi == pytest.approx(10 * np.log10(expected), abs=GAIN_DB)
    assert np.hypot(beam.u, beam.v) < 1e-9
    assert np.radians(beam.width_deg[1]) * DIAMETER_MM / WAVELENGTH_MM == pytest.approx(width, rel=WIDTH)
    assert beam.sidelobe_db[1] == pytest.approx(sidelobe_db, abs=SIDELOBE_DB)


def test_the_uniform_disc_is_airys_pattern() -> None:
    made, _ = flat(np.ones_like)
    v = np.linspace(0.001, 0.5, 300)
    x = np.pi * DIAMETER_MM / WAVELENGTH_MM * v
    airy = np.pi * DIAMETER_MM / WAVELENGTH_MM * np.abs(2 * j1(x) / x)
    assert np.abs(np.sqrt(gain(made, v)) - airy).max() < 1e-5 * airy[0]


@pytest.mark.parametrize("beta", [0.5, np.pi / 2, 3.0, 5.0])
def test_quadratic_phase_costs_sinc_squared(beta: float) -> None:
    """A phase of beta rho^2 over a uniform disc: (sin(beta / 2) / (beta / 2))^2."""
    made, _ = flat(lambda rho: np.exp(1j * beta * rho**2))
    ratio = gain(made, 0.0)[0] / (np.pi * DIAMETER_MM / WAVELENGTH_MM) ** 2
    assert 10 * np.log10(ratio / np.sinc(beta / 2 / np.pi) ** 2) == pytest.approx(0, abs=GAIN_DB)


def test_a_phase_ramp_steers_where_the_wave_goes() -> None:
    """Fields that lag more towards +y, as exp(-j k y s), leave towards +y at the sine s."""
    made, _ = flat(np.ones_like)
    lag = np.exp(-2j * np.pi / WAVELENGTH_MM * 0.1 * made.point_mm[:, 1])
    steered = Sources(made.nodes, made.normal, made.point_mm, made.moment * lag[:, None], made.rays, made.arriving)
    assert gain(steered, 0.1)[0] == pytest.approx(gain(made, 0.0)[0], rel=1e-9)
    assert gain(steered, -0.1)[0] < 1e-2 * gain(steered, 0.1)[0]


@pytest.mark.parametrize(("polarization", "turn"), [("right", -1j), ("left", 1j)])
def test_circular_polarisation_of_a_flat_aperture(polarization: str, turn: complex) -> None:
    """A wave (x - j y) going up is right-handed: all its field on the axis is co-polar."""
    made, _ = flat(np.ones_like, np.array([1.0, turn, 0.0]) / np.sqrt(2))
    co, cross = far_field(made, WAVELENGTH_MM, [0.0], [0.0], polarization)
    assert np.abs(cross[0]) < 1e-12 * np.abs(co[0])
    x, y = (far_field(made, WAVELENGTH_MM, [0.0], [0.0], p)[0][0] for p in "xy")
    assert y / x == pytest.approx(turn)


def bent_sources() -> tuple[Antenna, Sources, float]:
    whole = Antenna(Reflector(600, 300, 350.0), Feed("gaussian", 12.0))
    terms = zernike_terms(6)[3:]
    coefficients = np.random.default_rng(8).normal(0, 0.4, len(terms))
    d = Deformation(terms, coefficients, whole.reflector.center_mm, 300.0)
    wavelength = wavelength_of(whole, 30.0)
    correction = Correction(np.array([2.0, 1.0, 3.0]), np.array([1.0, 0.5]), np.zeros(0))
    return whole, sources(whole, d, correction, sampled(whole, d, wavelength, 0.5)), wavelength


def test_transforms_are_sums() -> None:
    _, made, wavelength = bent_sources()
    k = 2 * np.pi / wavelength
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-0.5, 0.5, (2, 400))
    direction = np.stack([u, v, np.sqrt(1 - u**2 - v**2)], axis=1)
    fast = summed(made, k, direction)
    slow = np.concatenate([summed(made, k, part) for part in np.split(direction, 40)])
    peak = np.abs(np.exp(-1j * k * made.rays.path_mm) @ made.moment).max()
    # the transform's error, 1e-6 of the largest field that the moments could make, is 120 dB below a focused beam
    assert np.abs(fast - slow).max() < 3e-6 * np.abs(made.moment).sum(axis=0).max()
    assert np.abs(fast - slow).max() < 1e-4 * peak


def test_grids_and_cuts_are_the_same_field() -> None:
    _, made, wavelength = bent_sources()
    u, v = np.linspace(-0.2, 0.2, 9), np.linspace(-0.1, 0.1, 5)
    grid = pattern_grid(made, wavelength, u, v, "x")
    assert grid.co.shape == (5, 9)
    co, cross = far_field(made, wavelength, [u[7]], [v[1]], "x")
    peak = np.abs(grid.co).max()
    assert abs(grid.co[1, 7] - co[0]) < 1e-5 * peak
    assert abs(grid.cross[1, 7] - cross[0]) < 1e-5 * peak
    cut = pattern_cut(made, wavelength, np.array([-3.0, 0.0, 3.0]), 90.0, "x")
    below, _ = far_field(made, wavelength, [0.0], [-np.sin(np.radians(3.0))], "x")
    assert cut.co[0] == pytest.approx(below[0], abs=1e-9 * peak)
    wide = pattern_grid(made, wavelength, np.array([0.0, 0.8]), np.array([0.0, 0.8]), "x")
    assert np.isnan(wide.co[1, 1])
    assert np.isfinite(wide.co[0]).all()


def test_a_feed_moved_to_plus_x_sends_the_beam_to_minus_x() -> None:
    whole = Antenna(Reflector(600, 600), Feed("gaussian", 12.0))
    wavelength = wavelength_of(whole, 30.0)
    d = Deformation((), np.zeros(0), np.zeros(2), 300.0)
    nodes = sampled(whole, d, wavelength, 0.1)
    made = sources(whole, d, Correction(np.array([10.0, 0, 0]), np.zeros(2), np.zeros(0)), nodes)
    u = np.linspace(-0.04, 0.04, 161)
    top = u[np.argmax(np.abs(far_field(made, wavelength, u, 0 * u, "x")[0]))]
    # beam deviation factor of f/D 1: 0.9 to 1 (Lo 1960)
    assert -10 / 600 < top < -0.88 * 10 / 600
    still = sources(whole, d, no_correction(whole), nodes)
    assert u[np.argmax(np.abs(far_field(still, wavelength, u, 0 * u, "x")[0]))] == pytest.approx(0, abs=1e-12)
