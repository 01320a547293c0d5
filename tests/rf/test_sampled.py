"""Nodes are fine enough: twice as many rings and spokes change nothing that is said; and what cannot be computed is refused."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf import sources as module
from dishmap.rf.antenna import Antenna, Blockage, Feed, Reflector, Subreflector
from dishmap.rf.correction import Correction, no_correction
from dishmap.rf.deformation import Deformation
from dishmap.rf.farfield import far_field
from dishmap.rf.sources import sampled, search_nodes, sources, wavelength_of
from dishmap.surface.zernike import zernike_terms

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

GAIN_DB, PATTERN_DB, FLOOR_DB = 1e-4, 0.1, -40.0
# a search needs to tell summits apart by thousandths of a dB
SEARCH_DB = 2e-4

DISH, OFFSET = Reflector(600, 300), Reflector(600, 300, 350.0)
FEED = Feed("gaussian", 12.0)
CASSEGRAIN = Subreflector("cassegrain", 220.0, 4.0)


def random_terms() -> dict[tuple[int, int], float]:
    terms = zernike_terms(12)[3:]
    values = np.random.default_rng(0).normal(size=len(terms))
    return dict(zip(terms, 3 * values / np.linalg.norm(values), strict=True))


CASES: dict[str, tuple[Antenna, dict[tuple[int, int], float], float, float]] = {
    "perfect": (Antenna(DISH, FEED), {}, 30.0, 0.02),
    "perfect_wide": (Antenna(DISH, FEED), {}, 30.0, 0.8),
    "random": (Antenna(DISH, FEED), random_terms(), 30.0, 0.3),
    "spokes": (Antenna(DISH, FEED), {(12, 12): 3.0}, 30.0, 0.02),
    "rings": (Antenna(DISH, FEED), {(12, 0): 3.0}, 30.0, 0.02),
    # a thin film far out of shape at W band: 20 wavelengths of path
    "w_band": (Antenna(DISH, FEED), {(12, 12): 3.0}, 100.0, 0.02),
    "shadow_struts": (Antenna(DISH, FEED, CASSEGRAIN, Blockage(None, 4, 20.0, 45.0)), random_terms(), 30.0, 0.3),
    "three_struts": (Antenna(DISH, FEED, CASSEGRAIN, Blockage(None, 3, 8.0)), {}, 30.0, 0.6),
    "offset": (Antenna(OFFSET, FEED), random_terms(), 30.0, 0.3),
    "cut_shadow": (Antenna(Reflector(600, 300, 280.0), FEED, None, Blockage(150.0)), {}, 30.0, 0.1),
}


def fields(case: str, finer: float, monkeypatch: pytest.MonkeyPatch) -> Complex:
    whole, terms, frequency, widest = CASES[case]
    with monkeypatch.context() as patch:
        patch.setattr(module, "RINGS", tuple(finer * v for v in module.RINGS))
        patch.setattr(module, "SPOKES", tuple(finer * v for v in module.SPOKES))
        wavelength = wavelength_of(whole, frequency)
        d = Deformation(tuple(terms), np.array(list(terms.values())), whole.reflector.center_mm, 300.0)
        made = sources(whole, d, no_correction(whole), sampled(whole, d, wavelength, widest))
    w = np.linspace(-widest, widest, 101)
    return far_field(made, wavelength, np.concatenate([w, 0 * w, 0.6 * w]), np.concatenate([0 * w, w, 0.8 * w]), "x")[0]


@pytest.mark.parametrize("case", CASES)
def test_twice_as_many_nodes_change_nothing(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    plain, twice = fields(case, 1.0, monkeypatch), fields(case, 2.0, monkeypatch)
    peak = np.abs(twice).max()
    assert abs(20 * np.log10(np.abs(plain).max() / peak)) < GAIN_DB
    seen = np.abs(twice) > peak * 10 ** (FLOOR_DB / 20)
    assert np.abs(20 * np.log10(np.abs(plain[seen]) / np.abs(twice[seen]))).max() < PATTERN_DB


@pytest.mark.parametrize("case", ["perfect", "random", "spokes", "shadow_struts", "offset", "cut_shadow"])
def test_a_search_on_fewer_nodes_sees_the_same_gain(case: str) -> None:
    whole, terms, frequency, _ = CASES[case]
    wavelength = wavelength_of(whole, frequency)
    d = Deformation(tuple(terms), np.array(list(terms.values())), whole.reflector.center_mm, 300.0)
    few, many = search_nodes(whole, d, wavelength), sampled(whole, d, wavelength, 0.02)
    assert few.lit < 0.6 * many.lit
    u = np.array([0.0, 0.008, 0.0])
    fields = [far_field(sources(whole, d, no_correction(whole), nodes), wavelength, u, u[::-1], "x")[0] for nodes in (few, many)]
    gains = [20 * np.log10(np.abs(one)) for one in fields]
    assert np.abs(gains[0] - gains[1])[gains[1] > gains[1].max() - 10].max() < SEARCH_DB


def test_a_subreflector_that_is_too_small_has_no_hard_edge() -> None:
    whole = Antenna(DISH, FEED, Subreflector("cassegrain", 220.0, 4.0, 80.0), Blockage(0.0))
    d, wavelength = Deformation((), np.zeros(0), np.zeros(2), 300.0), 10.0
    for shift in (0.0, 1.0, 2.0):
        moved = Correction(np.array([shift, 0.0, -shift]), np.zeros(2), np.zeros(0))
        gains = [
            far_field(sources(whole, d, moved, n(whole, d, wavelength)), wavelength, [0.0], [0.0], "x")[0] for n in (search_nodes, sampled)
        ]
        assert abs(20 * np.log10(np.abs(gains[0] / gains[1]))[0]) < SEARCH_DB


def test_nodes_that_ignore_how_steep_the_shape_is_would_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    twice = fields("w_band", 2.0, monkeypatch)
    monkeypatch.setattr(module, "_steepest", lambda *_: np.zeros(2))
    few = fields("w_band", 1.0, monkeypatch)
    seen = np.abs(twice) > np.abs(twice).max() * 10 ** (FLOOR_DB / 20)
    assert np.abs(20 * np.log10(np.abs(few[seen]) / np.abs(twice[seen]))).max() > PATTERN_DB


def test_frequencies_that_physical_optics_cannot_do() -> None:
    small = Antenna(Reflector(60, 30), FEED)
    with pytest.raises(InputError, match=r"at 10 GHz the aperture is 2 wavelengths across.*ask for 15 GHz or more"):
        wavelength_of(small, 10.0)
    assert wavelength_of(small, 15.0) == pytest.approx(19.986, abs=1e-3)
    for wrong in (0.0, -3.0, np.nan, np.inf):
        with pytest.raises(InputError, match=r"positive number of GHz"):
            wavelength_of(small, wrong)


def test_subreflectors_that_enter_the_dish() -> None:
    whole = Antenna(DISH, FEED, CASSEGRAIN)
    wavelength = wavelength_of(whole, 30.0)
    d = Deformation((), np.zeros(0), np.zeros(2), 300.0)
    with pytest.raises(InputError, match=r"mm into the dish; give it a shorter stroke"):
        sources(whole, d, Correction(np.array([0, 0, -290.0]), np.zeros(2), np.zeros(0)), sampled(whole, d, wavelength))


def test_shapes_in_the_wrong_units_are_refused_before_they_fill_the_memory() -> None:
    whole = Antenna(DISH, FEED)
    with pytest.raises(InputError, match=r"phases over the aperture reach .* radians.*check the units of the shape"):
        sampled(whole, Deformation(((2, 2), (4, 0)), np.array([4000.0, 900.0]), np.zeros(2), 300.0), 10.0)
