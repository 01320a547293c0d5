"""Gain lost to surface errors: the design's row of astigmatism, and random surfaces against Ruze (1966)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.rf.antenna import Antenna, Feed, Reflector
from dishmap.rf.correction import no_correction
from dishmap.rf.deformation import Deformation, displacement, undeformed
from dishmap.rf.farfield import far_field
from dishmap.rf.sources import Sources, sampled, sources, wavelength_of
from dishmap.surface.zernike import zernike_matrix, zernike_terms

Array = NDArray[np.float64]

# The row is an integral over the aperture without polarisation. Currents on a sloping surface are stronger for one linear polarisation, and
# weaker for the other, in proportion to the slopes; the mean of both keeps their squares.
ROW_DB, POLARISED_DB = 0.003, 0.025
DISH = Antenna(Reflector(600, 300), Feed("aperture", 12.0))
WAVELENGTH_MM = wavelength_of(DISH, 30.0)


def on_axis(made: Sources, polarization: str = "x") -> float:
    return float(np.abs(far_field(made, WAVELENGTH_MM, [0.0], [0.0], polarization)[0][0]) ** 2)


def lit(deformation: Deformation, polarization: str = "x") -> Sources:
    whole = replace(DISH, feed=replace(DISH.feed, polarization=polarization))
    return sources(whole, deformation, no_correction(whole), sampled(whole, deformation, WAVELENGTH_MM))


def axial(xy: Array, rms_mm: float) -> Array:
    """Astigmatism along z, of this rms over the disc: rho^2 cos(2 phi) has sqrt(1/6)."""
    return np.asarray(np.sqrt(6) * rms_mm * (xy[:, 0] ** 2 - xy[:, 1] ** 2) / 300**2)


def along_normals(rms_mm: float, degree: int = 12) -> Deformation:
    """The same surface as displacement along nominal normals: where those meet it, by fixed-point iteration, then Zernike terms."""
    side = np.linspace(-300, 300, 61)
    xy = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    xy = xy[np.linalg.norm(xy, axis=1) <= 300]
    normal = np.column_stack([-xy / 600, np.ones(len(xy))])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    start = np.column_stack([xy, (xy**2).sum(axis=1) / 1200])
    d = np.zeros(len(xy))
    for _ in range(60):
        at = start + d[:, None] * normal
        gap = (at[:, :2] ** 2).sum(axis=1) / 1200 + axial(at[:, :2], rms_mm) - at[:, 2]
        d += gap * normal[:, 2]
    assert np.abs(gap).max() < 1e-10
    terms = zernike_terms(degree)
    coefficients = np.linalg.lstsq(zernike_matrix(terms, *(xy.T / 300)), d, rcond=None)[0]
    fitted = Deformation(terms, coefficients, np.zeros(2), 300.0)
    assert np.abs(displacement(fitted, xy)[0] - d).max() < 1e-6
    return fitted


@pytest.mark.parametrize(("rms_mm", "loss_db"), [(0.2, 0.137), (0.5, 0.852), (1.0, 3.357)])
def test_the_row_of_astigmatism(rms_mm: float, loss_db: float) -> None:
    """f/D 0.5, 30 GHz, -12 dB. First the row itself, by plain sums over rings; then by currents on the exact surface."""
    rho, phi = np.meshgrid((np.arange(400) + 0.5) / 400, 2 * np.pi * np.arange(60) / 60)
    xy = 300 * np.stack([rho * np.cos(phi), rho * np.sin(phi)], axis=-1).reshape(-1, 2)
    rho2 = rho.ravel() ** 2
    weight = np.sqrt(rho2) * 10 ** (-12 / 20 * rho2)
    path = 2 * axial(xy, rms_mm) / (1 + rho2 / 4)
    row = np.abs((weight * np.exp(2j * np.pi / WAVELENGTH_MM * path)).sum() / weight.sum()) ** 2
    assert -10 * np.log10(row) == pytest.approx(loss_db, abs=1e-3)
    bent, still = along_normals(rms_mm), undeformed(DISH.reflector)
    losses = [10 * np.log10(on_axis(lit(still, p), p) / on_axis(lit(bent, p), p)) for p in ("x", "y", "right")]
    assert np.mean(losses[:2]) == pytest.approx(loss_db, abs=ROW_DB)
    assert losses[2] == pytest.approx(loss_db, abs=ROW_DB)
    assert losses[0] == pytest.approx(loss_db, abs=POLARISED_DB)


def test_a_displacement_towards_the_focus_shortens_the_path_by_twice_its_half_path() -> None:
    """D cos(theta / 2), twice, with tan(theta / 2) = rho / 2 f; the way out counts from the moved point."""
    small = Deformation(((0, 0),), np.array([1e-3]), np.zeros(2), 300.0)
    still, moved = lit(undeformed(DISH.reflector)), lit(small)
    path = (moved.rays.path_mm - moved.point_mm[:, 2]) - (still.rays.path_mm - still.point_mm[:, 2])
    rho2 = (still.nodes.xy_mm**2).sum(axis=1) / 600**2
    assert np.abs(path + 2e-3 / np.sqrt(1 + rho2)).max() < 1e-8


def ruze(sigma: float, correlation: float, efficiency: float) -> float:
    """Mean gain over the perfect one, Ruze's (8) with the scattered term: phases of variance sigma^2, correlated as exp(-t^2 / c^2).

    correlation: c over the diameter; efficiency: of the aperture's distribution.
    """
    series = sum(sigma ** (2 * n) / (n * float(np.prod(np.arange(1, n + 1)))) for n in range(1, 40))
    return float(np.exp(-(sigma**2)) * (1 + (2 * correlation) ** 2 / efficiency * series))


def mean_loss(correlation_mm: float, half_path_mm: float, count: int) -> tuple[float, float]:
    """Mean gain over the perfect one with its standard error, of random Gaussian fields as sums of many waves."""
    made = lit(undeformed(DISH.reflector))
    rng = np.random.default_rng(77)
    perfect, gains = on_axis(made), []
    for _ in range(count):
        # exp(-t^2 / c^2) has the spectrum of normal wave vectors of deviation sqrt(2) / c
        waves = rng.normal(0, np.sqrt(2) / correlation_mm, (2, 150))
        phase = made.nodes.xy_mm @ waves + rng.uniform(0, 2 * np.pi, 150)
        half_path = half_path_mm * np.sqrt(2 / 150) * np.cos(phase).sum(axis=1)
        gains.append(on_axis(replace(made, rays=replace(made.rays, path_mm=made.rays.path_mm - 2 * half_path))) / perfect)
    return float(np.mean(gains)), float(np.std(gains) / np.sqrt(count))


@pytest.mark.parametrize("correlation", [0.05, 0.1, 0.2, 0.5])
def test_ruze_overstates_the_loss_of_correlated_surfaces(correlation: float) -> None:
    half_path_mm = 0.6
    sigma = 4 * np.pi * half_path_mm / WAVELENGTH_MM
    mean, error = mean_loss(600 * correlation, half_path_mm, 150)
    assert mean > np.exp(-(sigma**2)) - 2 * error
    with_scatter = ruze(sigma, correlation, 0.8664)
    if correlation <= 0.1:
        # his scattered term holds for many patches over the aperture, and a flat illumination over each
        assert mean == pytest.approx(with_scatter, abs=3 * error + 0.1 * (with_scatter - np.exp(-(sigma**2))))
    if correlation >= 0.2:
        assert mean > np.exp(-(sigma**2)) + 3 * error


def test_ruzes_series_alone() -> None:
    """Small errors lose 4.343 * sigma^2 dB; large patches give gain back."""
    assert pytest.approx(-10 * np.log10(ruze(4 * np.pi * 0.5 / 10, 1e-6, 1.0)), rel=1e-4) == 685.81 * (0.5 / 10) ** 2
    assert ruze(0.7, 0.1, 1.0) > ruze(0.7, 0.05, 1.0) > np.exp(-0.49)
