"""Figures of drawn surfaces are those of the exact computation, and their mean and width are those of the gain's own distribution."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.rf.antenna import Antenna, Feed, Reflector, Subreflector
from dishmap.rf.beam import Beam, main_beam
from dishmap.rf.correction import no_correction
from dishmap.rf.deformation import Deformation
from dishmap.rf.gain import path_error
from dishmap.rf.sources import Sources, sampled, sources, wavelength_of
from dishmap.rf.spread import NAMES, Spread, spread
from dishmap.surface.zernike import zernike_terms

Array = NDArray[np.float64]

FREQUENCY_GHZ, DIAMETER_MM = 30.0, 600.0
TERMS = tuple(t for t in zernike_terms(6) if t[0] > 1)
# Shapes drawn 0.03 mm a term about one of 0.1 mm a term: what is not linear in paths is (0.1 mm)^2 / 600 mm, 1e-5 wavelengths, but currents
# also turn with the slopes, here a few parts in 10^4, which the drawn surfaces' do not; cuts go through the mean surface's peak.
GAIN_DB, DIRECTION, WIDTH_DEG, SIDELOBE_DB, RMS_MM = 3e-3, 2e-6, 1e-3, 0.15, 2e-5
PRIME = Antenna(Reflector(DIAMETER_MM, 300.0), Feed("aperture", 12.0))
CASSEGRAIN = Antenna(Reflector(DIAMETER_MM, 300.0), Feed("gaussian", 12.0), Subreflector("cassegrain", 220.0, 4.0))
OFFSET = Antenna(Reflector(DIAMETER_MM, 400.0, 350.0), Feed("gaussian", 10.0))


def shaped(antenna: Antenna, coefficients: Array) -> Deformation:
    return Deformation(TERMS, coefficients, antenna.reflector.center_mm, antenna.reflector.diameter_mm / 2)


def made(antenna: Antenna, coefficients: Array) -> tuple[Sources, Beam, float]:
    wavelength = wavelength_of(antenna, FREQUENCY_GHZ)
    deformation = shaped(antenna, coefficients)
    currents = sources(antenna, deformation, no_correction(antenna), sampled(antenna, deformation, wavelength, 0.1))
    return currents, main_beam(currents, wavelength, DIAMETER_MM, "x"), wavelength


@pytest.mark.parametrize("antenna", [PRIME, CASSEGRAIN, OFFSET], ids=["prime", "cassegrain", "offset"])
def test_a_drawn_surface_has_the_figures_of_the_exact_computation(antenna: Antenna) -> None:
    rng = np.random.default_rng(3)
    mean = 0.1 * rng.normal(size=len(TERMS))
    drawn = mean + 0.03 * rng.normal(size=(2, len(TERMS)))
    currents, beam, wavelength = made(antenna, mean)
    found = spread(currents, shaped(antenna, mean), drawn, beam, wavelength, DIAMETER_MM, "x")
    for k, coefficients in enumerate(drawn):
        exact, own, _ = made(antenna, coefficients)
        left = path_error(exact, wavelength, own.u, own.v)
        expected = [own.gain_dbi, own.boresight_dbi, own.u, own.v, *own.width_deg, *own.sidelobe_db, left.weighted_rms_mm, left.ruze_db]
        limits = [GAIN_DB, GAIN_DB, DIRECTION, DIRECTION, WIDTH_DEG, WIDTH_DEG, SIDELOBE_DB, SIDELOBE_DB, RMS_MM, GAIN_DB]
        for name, value, limit in zip(NAMES, expected, limits, strict=True):
            assert abs(found.of(name)[k] - value) < limit, name
        # and it is not the mean surface's
        assert abs(found.of("gain_dbi")[k] - beam.gain_dbi) > 3 * GAIN_DB


def test_an_uncertain_perfect_dish_costs_what_its_variance_says() -> None:
    # gain is stationary there: the mean loss is Ruze's for the variance of the weighted half-path error, and never a gain
    rng = np.random.default_rng(5)
    sigma_mm = 0.05
    drawn = sigma_mm * rng.normal(size=(300, len(TERMS)))
    currents, beam, wavelength = made(PRIME, np.zeros(len(TERMS)))
    found = spread(currents, shaped(PRIME, np.zeros(len(TERMS))), drawn, beam, wavelength, DIAMETER_MM, "x")
    loss = beam.gain_dbi - found.of("gain_dbi")
    assert loss.min() > 0
    # the next order is half a percent, and the draws are the same
    assert loss.mean() == pytest.approx(found.of("ruze_db").mean(), rel=0.02)
    assert loss.mean() > 3 * GAIN_DB


def test_sigma_and_interval_are_those_of_the_draws() -> None:
    values = np.zeros((1001, len(NAMES)))
    values[:, 0] = np.linspace(0.0, 1.0, 1001)
    values[::2, NAMES.index("sidelobe_0_db")] = np.nan
    values[:, NAMES.index("sidelobe_90_db")] = np.nan
    floor = np.zeros(len(NAMES))
    floor[NAMES.index("boresight_dbi")] = 0.3
    one = Spread(values, floor)
    assert one.interval("gain_dbi") == pytest.approx((0.025, 0.975), abs=1e-12)
    assert one.sigma("gain_dbi") == pytest.approx(np.sqrt(1 / 12), rel=1e-2)
    # draws that agree are still no better than the computation
    assert one.sigma("boresight_dbi") == pytest.approx(0.3)
    assert one.interval("boresight_dbi") == pytest.approx((-0.3, 0.3))
    # a lobe that some draws do not have is described by the others, one that none has by nothing
    assert one.sigma("sidelobe_0_db") == 0.0
    assert np.isnan(one.sigma("sidelobe_90_db"))
    assert np.isnan(one.interval("sidelobe_90_db")).all()
