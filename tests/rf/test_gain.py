"""Budget, path error and Ruze's formula against numbers from elsewhere, and the best-fit paraboloid against a known one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.errors import FitError
from dishmap.rf.antenna import Antenna, Blockage, Feed, Reflector
from dishmap.rf.beam import main_beam
from dishmap.rf.best_fit import BestFit, best_fit
from dishmap.rf.correction import no_correction
from dishmap.rf.deformation import Deformation, undeformed
from dishmap.rf.gain import budget, path_error, ruze_loss_db
from dishmap.rf.sources import Sources, sampled, sources, wavelength_of
from dishmap.surface.zernike import zernike_terms

Array = NDArray[np.float64]

DIAMETER_MM, FOCAL_MM = 600.0, 300.0
PRIME = Antenna(Reflector(DIAMETER_MM, FOCAL_MM), Feed("aperture", 12.0))
# Sums of smooth functions over the aperture are good to rounding; factors below hold to that.
FACTOR = 1e-6


def built(antenna: Antenna, deformation: Deformation, wavelength_mm: float) -> Sources:
    return sources(antenna, deformation, no_correction(antenna), sampled(antenna, deformation, wavelength_mm, 0.1))


@pytest.mark.parametrize(
    ("rms_mm", "ghz", "db"), [(0.1, 12.5, 0.012), (0.3, 12.5, 0.107), (0.5, 12.5, 0.298), (0.1, 30.0, 0.069), (0.5, 30.0, 1.717)]
)
def test_ruze_gives_the_tabulated_losses(rms_mm: float, ghz: float, db: float) -> None:
    # half-path rms, frequency, loss to the three places of a table made elsewhere
    assert ruze_loss_db(rms_mm, 299.792458 / ghz) == pytest.approx(db, abs=1e-3)


def test_a_gaussian_aperture_has_the_efficiencies_of_the_integral() -> None:
    wavelength = wavelength_of(PRIME, 30.0)
    currents = built(PRIME, undeformed(PRIME.reflector), wavelength)
    beam = main_beam(currents, wavelength, DIAMETER_MM, "x")
    parts = budget(currents, wavelength, DIAMETER_MM, beam.u, beam.v, beam.gain_dbi)
    # field exp(-b r^2), b = 12 dB: (1 - e^-b)^2 / (b / 2 (1 - e^-2b)), and the power within the rim is 1 - 10^-1.2
    b = 12 / 20 * np.log(10)
    assert parts.illumination == pytest.approx(2 * (1 - np.exp(-b)) ** 2 / (b * (1 - np.exp(-2 * b))), abs=FACTOR)
    assert parts.spillover == pytest.approx(1 - 10**-1.2, abs=FACTOR)
    assert (parts.blockage, parts.phase, parts.rest) == pytest.approx((1.0, 1.0, 1.0), abs=FACTOR)
    product = parts.spillover * parts.illumination * parts.blockage * parts.phase * parts.rest
    assert parts.total == pytest.approx(product, rel=1e-12)


def test_central_blockage_takes_its_share_of_the_field() -> None:
    antenna = Antenna(PRIME.reflector, PRIME.feed, blockage=Blockage(diameter_mm=120.0))
    wavelength = wavelength_of(antenna, 30.0)
    currents = built(antenna, undeformed(antenna.reflector), wavelength)
    beam = main_beam(currents, wavelength, DIAMETER_MM, "x")
    parts = budget(currents, wavelength, DIAMETER_MM, beam.u, beam.v, beam.gain_dbi)
    b = 12 / 20 * np.log(10)
    left = 1 - (1 - np.exp(-b * 0.2**2)) / (1 - np.exp(-b))
    assert parts.blockage == pytest.approx(left**2, abs=FACTOR)
    # what is blocked does not count as spilt
    assert parts.spillover == pytest.approx(1 - 10**-1.2, abs=FACTOR)


def test_the_half_path_error_of_a_shallow_rise_is_the_rise() -> None:
    # on a long focus, half the path error is the displacement itself; astigmatism has neither mean nor tilt
    antenna = Antenna(Reflector(DIAMETER_MM, 6000.0), Feed("aperture", 1e-3))
    deformation = Deformation(((2, 2),), np.array([0.2]), np.zeros(2), DIAMETER_MM / 2)
    wavelength = wavelength_of(antenna, 30.0)
    currents = built(antenna, deformation, wavelength)
    found = path_error(currents, wavelength, 0.0, 0.0)
    # rms of r^2 cos 2 phi over the unit disc is 1 / sqrt 6; the cosine of half the rim's angle is 1 - 3e-4
    assert found.rms_mm == pytest.approx(0.2 / np.sqrt(6), rel=1e-3)
    assert found.weighted_rms_mm == pytest.approx(found.rms_mm, rel=1e-3)
    top = np.argmax(found.half_path_mm)
    assert abs(found.xy_mm[top, 0]) > abs(found.xy_mm[top, 1])


def rises_to(vertex_mm: Array, turn_rad: Array, focal_mm: float) -> Deformation:
    """Zernike terms of the normal displacement that makes the nominal dish into another paraboloid, nearly; fitted on a fine grid."""
    rng = np.random.default_rng(0)
    r, phi = np.sqrt(rng.random(4000)), 2 * np.pi * rng.random(4000)
    xy = 300.0 * np.stack([r * np.cos(phi), r * np.sin(phi)], axis=1)
    base = np.column_stack([xy, (xy**2).sum(axis=1) / (4 * FOCAL_MM)])
    normal = np.column_stack([-xy / (2 * FOCAL_MM), np.ones(len(xy))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    ax, ay = turn_rad
    turn = np.array([[1, 0, ay], [0, 1, -ax], [-ay, ax, 1]])
    d = np.zeros(len(xy))
    for _ in range(30):
        q = (base + d[:, None] * normal - vertex_mm) @ turn
        d -= (q[:, 2] - (q[:, :2] ** 2).sum(axis=1) / (4 * focal_mm)) * normal[:, 2]
    from dishmap.surface.zernike import zernike_matrix

    terms = zernike_terms(10)
    design = zernike_matrix(terms, *(xy / 300.0).T)
    coefficients = np.linalg.lstsq(design, d, rcond=None)[0]
    assert np.abs(design @ coefficients - d).max() < 1e-6
    return Deformation(terms, coefficients, np.zeros(2), 300.0)


def fitted(deformation: Deformation, sigma_mm: float = 0.0) -> BestFit:
    currents = built(PRIME, deformation, 10.0)
    return best_fit(PRIME, deformation, currents, sigma_mm * np.eye(len(deformation.terms)))


def test_the_best_fit_of_another_paraboloid_is_that_paraboloid() -> None:
    vertex, turn, focal = np.array([0.3, -0.2, 0.4]), np.radians([0.05, -0.03]), 303.0
    found = fitted(rises_to(vertex, turn, focal))
    # Zernike terms of degree 10 follow it to 1e-6 mm, and a turn of 0.05 degree is its own matrix to 4e-7
    assert found.values[:3] == pytest.approx(vertex, abs=2e-3)
    assert np.radians(found.values[3:5]) == pytest.approx(turn, abs=2e-6)
    assert found.values[5] == pytest.approx(focal, abs=2e-3)
    # that matrix times a depth of 75 mm
    assert found.weighted_half_path_rms_mm < 5e-5


def test_sigmas_of_the_best_fit_are_those_of_fits_to_drawn_surfaces() -> None:
    rng = np.random.default_rng(2)
    terms = tuple(t for t in zernike_terms(4) if t[0] > 1)
    sigma_mm = 0.02
    claimed = fitted(Deformation(terms, np.zeros(len(terms)), np.zeros(2), 300.0), sigma_mm).sigma
    values = np.array([fitted(Deformation(terms, sigma_mm * rng.normal(size=len(terms)), np.zeros(2), 300.0)).values for _ in range(60)])
    # 60 draws know a standard deviation to 9 %
    assert values.std(axis=0) == pytest.approx(claimed, rel=0.3)


def test_a_surface_without_any_paraboloid_is_refused() -> None:
    wild = Deformation(((2, 0),), np.array([-4000.0]), np.zeros(2), 300.0)
    nodes = sampled(PRIME, undeformed(PRIME.reflector), 10.0)
    made = sources(PRIME, wild, no_correction(PRIME), nodes)
    with pytest.raises(FitError, match="did not converge"):
        best_fit(PRIME, wild, made, np.zeros((1, 1)))
