"""The whole analysis of a made-up map, whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dishmap.errors import InputError
from dishmap.rf.analysis import CORRECTED, DESIGN, MEASURED, SHAPED, RfAnalysis, RfOptions, analyse
from dishmap.rf.antenna import Actuators, Antenna, Feed, Reflector, Subreflector
from dishmap.rf.correct import judged
from dishmap.rf.deformation import Deformation
from dishmap.rf.shape_field import ShapeField, TargetValues, shape_field
from dishmap.rf.sources import wavelength_of
from dishmap.surface.zernike import zernike_matrix

GHZ = 20.0
MAIN = Reflector(600.0, 300.0)
ANTENNA = Antenna(
    MAIN,
    Feed("gaussian", 12.0),
    Subreflector("cassegrain", 220.0, 4.0),
    actuators=Actuators((10.0, 10.0, 10.0), (5.0, 5.0), shape_degree=2, shape_stroke_mm=3.0),
)
TRUTH = Deformation(((2, 0), (2, 2), (3, 1)), np.array([0.5, 0.4, 0.2]), np.zeros(2), 300.0)
SIGMA_MM = 0.01


def made_up() -> ShapeField:
    rng = np.random.default_rng(4)
    x, y = (g.ravel() for g in np.meshgrid(np.arange(-280, 281, 56.0), np.arange(-280, 281, 56.0)))
    inside = np.hypot(x, y) < 295
    places = np.column_stack([x[inside], y[inside]])
    n = len(places)
    value = zernike_matrix(TRUTH.terms, *(places / 300.0).T) @ TRUTH.coefficients_mm + SIGMA_MM * rng.normal(size=n)
    none = np.zeros((n, 0))
    return shape_field(TargetValues(np.arange(n), places, value, none, np.full(n, SIGMA_MM**2), np.zeros(n, np.int64), False), MAIN)


@pytest.fixture(scope="module")
def result() -> RfAnalysis:
    return analyse(made_up(), "shape", ANTENNA, RfOptions((GHZ,), correct=True, draws=40))


def test_the_truth_lies_within_the_claims(result: RfAnalysis) -> None:
    wavelength = np.array([wavelength_of(ANTENNA, GHZ)])
    for name in (MEASURED, CORRECTED, SHAPED):
        state = result.state(name)
        spread = state.readings[0].spread
        assert spread is not None
        truth = judged(ANTENNA, TRUTH, state.correction, wavelength, free=True)[0][0]
        low, high = spread.interval("gain_dbi")
        # 95 % intervals of one map: twice as far is one in 10^4
        assert abs(truth - (low + high) / 2) < high - low
    lost = result.lost[0]
    assert lost.low_db <= lost.mean_db + 2e-3
    assert -0.4 < lost.mean_db < -0.2
    assert 1e-3 < lost.sigma_db < 0.02


def test_corrections_win_back_and_shapes_win_more(result: RfAnalysis) -> None:
    pose, bend = result.recovered[CORRECTED][0], result.recovered[SHAPED][0]
    assert 0.05 < pose.mean_db < bend.mean_db <= -result.lost[0].mean_db + 0.02
    gains = {state.name: state.readings[0].beam.gain_dbi for state in result.states}
    assert pose.mean_db == pytest.approx(gains[CORRECTED] - gains[MEASURED])
    assert [*gains] == [DESIGN, MEASURED, CORRECTED, SHAPED]
    # what a pose cannot undo is named first: astigmatism
    assert (result.modes[CORRECTED][0][0].n, result.modes[CORRECTED][0][0].m) == (2, 2)
    # and a map as good as this one leaves less on the table than a bad one
    left = result.margins[CORRECTED].mean_db[:, 0]
    assert left[0] < 0.01 < left[-1]


def test_the_best_fit_is_that_of_a_longer_focus(result: RfAnalysis) -> None:
    # 0.5 mm of defocus, positive at the rim, over 75 mm of depth shortens 300 mm by about 2 x 0.5 / 75 of it
    assert 290 < result.best_fit.values[5] < 299
    assert result.best_fit.weighted_half_path_rms_mm < result.state(MEASURED).readings[0].path.weighted_rms_mm
    assert result.extrapolated_share == pytest.approx(0.0, abs=0.02)


def test_impossible_options_are_refused() -> None:
    with pytest.raises(InputError, match="at least one frequency"):
        RfOptions(())
    with pytest.raises(InputError, match="unknown pointing"):
        RfOptions((GHZ,), pointing="sideways")
    with pytest.raises(InputError, match="draws"):
        RfOptions((GHZ,), draws=1)
    with pytest.raises(InputError, match="needs 3; ask for"):
        analyse(made_up(), "shape", ANTENNA, RfOptions((0.5,)))


def test_fixed_pointing_counts_gain_at_the_boresight() -> None:
    field = made_up()
    tilted = replace(field, mean_mm=field.mean_mm + 1.0 * np.array([term == (1, 1) for term in field.terms]))
    antenna = replace(ANTENNA, actuators=Actuators((0.0, 0.0, 0.0), (0.0, 0.0)))
    free, fixed = (analyse(tilted, "shape", antenna, RfOptions((GHZ,), pointing=p, draws=20)).lost[0].mean_db for p in ("free", "fixed"))
    assert fixed < free - 0.01
