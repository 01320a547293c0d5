"""Charts of an antenna's gain: what they show is where it should be, and nothing breaks without a correction or off the axis."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from dishmap.plot.rf_antenna import antenna_sides, dish_factor, move_factor
from dishmap.plot.rf_bars import margin_curves, mode_bars
from dishmap.plot.rf_maps import aperture_maps, sigma_field
from dishmap.plot.rf_pattern import gain_curves, pattern_cuts, pattern_maps
from dishmap.rf.antenna import Actuators, Antenna, Feed, Reflector, Subreflector
from dishmap.rf.correction import Correction, correction_of, no_correction
from dishmap.rf.deformation import Deformation, undeformed
from dishmap.rf.state import State, antenna_state

SVG = "{http://www.w3.org/2000/svg}"
PRIME = Antenna(Reflector(600.0, 300.0), Feed("aperture", 12.0))
OFFSET = Antenna(Reflector(600.0, 300.0, 350.0), Feed("gaussian", 12.0))
CASSEGRAIN = Antenna(
    Reflector(600.0, 300.0),
    Feed("gaussian", 12.0),
    Subreflector("cassegrain", 220.0, 4.0),
    actuators=Actuators(shape_degree=3, shape_stroke_mm=2.0),
)
GREGORIAN = Antenna(Reflector(600.0, 300.0, 400.0), Feed("gaussian", 12.0), Subreflector("gregorian", 220.0, 4.0))
ANTENNAS = {"prime": PRIME, "offset": OFFSET, "cassegrain": CASSEGRAIN, "gregorian": GREGORIAN}
MOVE = np.array([0.2, -0.1, 1.2, 0.3, -0.2])


def bent(antenna: Antenna, size_mm: float = 0.5) -> Deformation:
    return Deformation(((2, 0), (2, 2)), np.array([0.3, size_mm]), antenna.reflector.center_mm, antenna.reflector.diameter_mm / 2)


def moved(antenna: Antenna) -> Correction:
    values = no_correction(antenna).values
    values[:5] = MOVE
    return correction_of(values)


def is_svg(text: str) -> bool:
    return ET.fromstring(text).tag == f"{SVG}svg" and not re.search(r"\bnan\b", re.sub(r'base64,[^"]*', "", text))


@pytest.fixture(scope="module")
def states() -> list[State]:
    still = no_correction(PRIME)
    drawn = bent(PRIME).coefficients_mm + 0.02 * np.random.default_rng(2).normal(size=(20, 2))
    return [
        antenna_state("design", PRIME, undeformed(PRIME.reflector), still, (12.5,)),
        antenna_state("measured", PRIME, bent(PRIME), still, (12.5,), drawn),
    ]


def test_patterns_and_curves(states: list[State]) -> None:
    readings, names = [s.readings[0] for s in states], [s.name for s in states]
    for some in (readings, readings[1:]):
        shown = names[-len(some) :]
        assert is_svg(pattern_cuts(some, shown, len(some) - 1))
        assert is_svg(pattern_maps(some, shown))
    assert is_svg(gain_curves(states))
    assert is_svg(gain_curves(states[:1]))


def test_aperture_maps(states: list[State]) -> None:
    paths = [s.readings[0].path for s in states]
    places = [path.xy_mm for path in paths]
    svg = aperture_maps(places, [path.half_path_mm for path in paths], ["a", "b"], np.zeros(2), 300.0, "mm")
    assert is_svg(svg)
    # two fields and a scale of colours, each a raster: a page of many maps must stay small
    assert svg.count("<image") == 3
    assert len(svg) < 400_000
    # nothing at all is drawn as such
    assert is_svg(aperture_maps(places[:1], [np.zeros(len(places[0]))], ["flat"], np.zeros(2), 300.0, "mm"))


@pytest.mark.parametrize("part", ["none", "some", "all"])
def test_sigma_is_hatched_where_it_is_extrapolated(states: list[State], part: str) -> None:
    xy = states[0].readings[0].path.xy_mm
    far = {"none": np.inf, "some": 200.0, "all": -1.0}[part]
    beyond = np.hypot(*xy.T) > far
    svg = sigma_field(xy, 0.02 + 1e-6 * (xy**2).sum(axis=1), beyond, xy[::50], np.zeros(2), 300.0, "mm")
    assert is_svg(svg)
    assert ("<pattern" in svg) == (part != "none")


@pytest.mark.parametrize("name", ANTENNAS)
def test_sides_of_every_kind_of_antenna(name: str) -> None:
    antenna = ANTENNAS[name]
    for deformation in (bent(antenna), undeformed(antenna.reflector)):
        for correction in (moved(antenna), no_correction(antenna)):
            assert is_svg(antenna_sides(antenna, deformation, correction))


@pytest.mark.parametrize("name", ANTENNAS)
def test_motions_are_drawn_large_enough_to_see(name: str) -> None:
    antenna, deformation = ANTENNAS[name], bent(ANTENNAS[name])
    assert 0.01 * 600 < dish_factor(antenna, deformation) * 0.8 < 0.06 * 600
    assert 0.02 * 600 < move_factor(antenna, moved(antenna)) * MOVE.max() < 0.07 * 600
    # a motion as large as the picture itself is drawn at true scale, none as none
    far = correction_of(1000 * moved(antenna).values)
    assert move_factor(antenna, far) == 1.0
    assert move_factor(antenna, no_correction(antenna)) == dish_factor(antenna, undeformed(antenna.reflector)) == 0.0


def test_bars_and_margin() -> None:
    loss = np.array([[0.8, 0.4], [-0.01, 0.39]])
    assert is_svg(mode_bars(["defocus", "astigmatism"], ["measured", "corrected"], loss))
    assert is_svg(mode_bars(["defocus", "astigmatism"], ["measured"], loss[:1]))
    error = np.array([0.01, 0.1, 1.0])
    # nothing left on the table has no logarithm
    assert is_svg(margin_curves({"corrected": (error, error**2), "shaped": (error, 0 * error)}, 0.05))
    assert is_svg(margin_curves({"corrected": (error, error**2)}, 0.001))
