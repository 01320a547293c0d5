"""Modes: what was put in comes out, with what it costs by direct integration."""

from __future__ import annotations

import numpy as np
import pytest

from dishmap.errors import InputError
from dishmap.rf.modes import modes_of
from dishmap.surface.zernike import zernike_xy

WAVELENGTH_MM = 10.0
# rounding of least squares
ROUNDING = 1e-9


def disc(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    rho, step = np.polynomial.legendre.leggauss(count)
    rho, step = (rho + 1) / 2, step / 2
    phi = 2 * np.pi * np.arange(96) / 96
    xy = np.stack([np.outer(rho, np.cos(phi)).ravel(), np.outer(rho, np.sin(phi)).ravel()], axis=1)
    return xy, np.repeat(rho * step, 96)


def test_one_mode_comes_out_with_its_amplitude_and_orientation() -> None:
    xy, area = disc()
    turn = np.radians(25.0)
    half = 0.3 * (np.cos(2 * turn) * zernike_xy(2, 2, *xy.T) + np.sin(2 * turn) * zernike_xy(2, -2, *xy.T)) + 0.7 + 0.2 * xy[:, 0]
    first, *rest = modes_of(xy, half, area, WAVELENGTH_MM)
    assert (first.n, first.m) == (2, 2)
    assert first.amplitude_mm == pytest.approx(0.3, abs=ROUNDING)
    assert first.orientation_deg == pytest.approx(25.0, abs=1e-6)
    assert first.removed_db == pytest.approx(first.alone_db, abs=1e-6)
    assert max(abs(row.amplitude_mm) for row in rest) < ROUNDING


def test_defocus_of_a_uniform_disc_costs_sinc_squared() -> None:
    xy, area = disc()
    half = -0.4 * zernike_xy(2, 0, *xy.T)
    first, *_ = modes_of(xy, half, area, WAVELENGTH_MM)
    # phase 4 pi a (2 rho^2 - 1) / wavelength: linear in rho^2, from -beta to beta
    beta = 4 * np.pi * 0.4 / WAVELENGTH_MM
    assert first.amplitude_mm == pytest.approx(-0.4, abs=ROUNDING)
    assert first.alone_db == pytest.approx(-20 * np.log10(np.sin(beta) / beta), abs=1e-6)


def test_coma_alone_is_pointed_anew() -> None:
    xy, area = disc()
    half = 0.2 * zernike_xy(3, 1, *xy.T)
    coma = next(row for row in modes_of(xy, half, area, WAVELENGTH_MM) if (row.n, row.m) == (3, 1))
    u = np.linspace(-1, 1, 2001)
    fields = [abs((area * np.exp(1j * (4 * np.pi / WAVELENGTH_MM * half + a * xy[:, 0]))).sum()) for a in u]
    # a grid of 0.001 rad misses the peak by under 1e-5 dB
    assert coma.alone_db == pytest.approx(-20 * np.log10(max(fields) / area.sum()), abs=1e-5)


def test_too_few_nodes_are_refused() -> None:
    with pytest.raises(InputError, match="need more nodes than 20"):
        modes_of(np.zeros((20, 2)), np.zeros(20), np.ones(20), WAVELENGTH_MM)
