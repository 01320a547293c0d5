"""Nodes of the aperture: areas and moments of the disc, of shadows and of struts, against closed formulas and other integration."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dishmap.rf.antenna import Antenna, Blockage, Feed, Reflector, Subreflector
from dishmap.rf.aperture import ApertureNodes, aperture_nodes
from dishmap.rf.sources import shadow_mm
from dishmap.rf.subreflector import rim_disc

Array = NDArray[np.float64]

# relative rounding of sums over a few thousand nodes
ROUNDING = 1e-11
# where the rim cuts a shadow its spokes have kinks between its spokes: the error of its area falls as
# steps^-1.5, here with 200 of them, relative to the shadow's
CUT_SHADOW = 1e-3
# plain count over a grid of a 2000th of the diameter, relative to the strut's area: cells along the edges, half of them counted
COUNTED = 5e-3


def antenna(diameter_mm: float = 600.0, offset_mm: float = 0.0, blockage: Blockage | None = None) -> Antenna:
    return Antenna(Reflector(diameter_mm, 300.0, offset_mm), Feed("gaussian", 12.0), None, blockage or Blockage())


def moment(nodes: ApertureNodes, p: int, q: int, middle: Array) -> float:
    x, y = (nodes.xy_mm - middle).T
    return float((nodes.weight_mm2 * x**p * y**q).sum())


@given(st.floats(10, 5000), st.floats(-3000, 3000), st.integers(6, 30), st.integers(16, 90))
def test_the_disc_has_its_area_and_moments(diameter: float, offset: float, rings: int, spokes: int) -> None:
    whole = antenna(diameter, offset)
    nodes = aperture_nodes(whole, rings, spokes, 0.0)
    r = diameter / 2
    middle = whole.reflector.center_mm
    assert nodes.lit == rings * spokes == len(nodes.weight_mm2)
    # x^p y^q over a disc
    for (p, q), expected in {
        (0, 0): np.pi * r**2,
        (1, 0): 0.0,
        (2, 0): np.pi * r**4 / 4,
        (1, 1): 0.0,
        (4, 0): np.pi * r**6 / 8,
        (2, 2): np.pi * r**6 / 24,
        (4, 4): np.pi * r**10 * 3 / 640,
    }.items():
        scale = np.pi * r ** (2 + p + q)
        # offsets of thousands beside a diameter of ten cost four digits of the difference
        assert abs(moment(nodes, p, q, middle) - expected) < ROUNDING * scale * (1 + abs(offset) / r)


@given(st.floats(0.01, 0.99))
def test_a_shadow_on_the_axis_leaves_an_annulus(share: float) -> None:
    nodes = aperture_nodes(antenna(), 20, 40, 300 * share)
    inner = 300 * share
    assert moment(nodes, 0, 0, np.zeros(2)) == pytest.approx(np.pi * (300**2 - inner**2), abs=ROUNDING * np.pi * 300**2)
    assert moment(nodes, 2, 0, np.zeros(2)) == pytest.approx(np.pi * (300**4 - inner**4) / 4, abs=ROUNDING * 300**4)
    assert (nodes.weight_mm2[: nodes.lit] > 0).all()
    assert (nodes.weight_mm2[nodes.lit :] <= 0).all()


def lens(a: float, b: float, apart: float) -> float:
    """Area common to two circles (any table of plane figures)."""
    if apart >= a + b:
        return 0.0
    if apart <= abs(a - b):
        return float(np.pi * min(a, b) ** 2)
    # circles that touch are off by rounding
    one = a**2 * np.arccos(np.clip((apart**2 + a**2 - b**2) / (2 * apart * a), -1, 1))
    two = b**2 * np.arccos(np.clip((apart**2 + b**2 - a**2) / (2 * apart * b), -1, 1))
    kite = 0.5 * np.sqrt(max((-apart + a + b) * (apart + a - b) * (apart - a + b) * (apart + a + b), 0.0))
    return float(one + two - kite)


@given(st.floats(0, 900), st.floats(20, 500), st.floats(-300, 300))
@example(446.0, 337.0, 0.0)
@example(1.75, 20.0, -299.0)
def test_a_shadow_that_the_rim_cuts_is_a_lens(offset: float, shadow: float, at: float) -> None:
    nodes = aperture_nodes(antenna(offset_mm=offset), 20, 200, shadow, at)
    shaded = -nodes.weight_mm2[nodes.lit :].sum()
    assert shaded == pytest.approx(lens(300.0, shadow, abs(offset - at)), abs=CUT_SHADOW * np.pi * shadow**2)
    inside = np.linalg.norm(nodes.xy_mm - [offset, 0.0], axis=1) <= 300 * (1 + ROUNDING)
    assert (inside | (nodes.weight_mm2 == 0)).all()


@pytest.mark.parametrize(
    ("struts", "width", "angle", "shadow", "offset"),
    [
        (3, 30.0, 90.0, 60.0, 0.0),
        (4, 20.0, 33.0, 0.0, 0.0),
        (2, 40.0, 10.0, 0.0, 0.0),
        (1, 25.0, 200.0, 80.0, 0.0),
        (4, 30.0, 0.0, 60.0, 250.0),
    ],
)
def test_struts_cover_strips_that_do_not_overlap(struts: int, width: float, angle: float, shadow: float, offset: float) -> None:
    nodes = aperture_nodes(antenna(offset_mm=offset, blockage=Blockage(2 * shadow, struts, width, angle)), 30, 200, shadow)
    step = 0.3
    axis = np.arange(-300 + step / 2, 300, step)
    x, y = np.meshgrid(axis + offset, axis)
    inside = (x - offset) ** 2 + y**2 < 300**2
    # struts begin where neighbours no longer overlap
    clear = max(shadow, width / 2 / np.sin(np.pi / struts) if struts > 2 else 0.0)
    covered = np.zeros(x.shape, bool)
    for k in range(struts):
        t = np.radians(angle) + 2 * np.pi * k / struts
        along, across = x * np.cos(t) + y * np.sin(t), -x * np.sin(t) + y * np.cos(t)
        covered |= (along > 0) & (np.abs(across) < width / 2)
    covered &= inside & (x**2 + y**2 > clear**2)
    disc = inside & (x**2 + y**2 < shadow**2)
    strips = -nodes.weight_mm2[nodes.lit :].sum() - disc.sum() * step**2
    assert strips == pytest.approx(covered.sum() * step**2, rel=COUNTED)
    turned = aperture_nodes(antenna(offset_mm=offset, blockage=Blockage(2 * shadow, struts, 1.02 * width, angle)), 30, 200, shadow)
    assert abs(-turned.weight_mm2[turned.lit :].sum() - disc.sum() * step**2 - covered.sum() * step**2) > COUNTED * covered.sum() * step**2


def test_a_subreflector_off_the_axis_shades_what_is_under_it() -> None:
    sub = Subreflector("cassegrain", 220.0, 4.0)
    whole = Antenna(Reflector(600, 300, 380.0), Feed("gaussian", 12.0), sub)
    center, radius = rim_disc(whole.reflector, sub)
    assert shadow_mm(whole) == (radius, center)
    nodes = aperture_nodes(whole, 30, 200, *shadow_mm(whole))
    shaded = -nodes.weight_mm2[nodes.lit :].sum()
    assert shaded == pytest.approx(lens(300.0, radius, 380.0 - center), abs=CUT_SHADOW * np.pi * radius**2)
    assert shaded > 1000


def test_what_is_given_as_blocked_counts_before_the_subreflector() -> None:
    sub = Subreflector("cassegrain", 220.0, 4.0)
    assert shadow_mm(Antenna(Reflector(600, 300), Feed("gaussian", 12.0), sub, Blockage(150.0))) == (75.0, 0.0)
    assert shadow_mm(Antenna(Reflector(600, 300), Feed("gaussian", 12.0))) == (0.0, 0.0)
    gregorian = Antenna(Reflector(600, 300, 380.0), Feed("gaussian", 12.0), Subreflector("gregorian", 220.0, 4.0))
    nodes = aperture_nodes(gregorian, 20, 60, *shadow_mm(gregorian))
    assert nodes.weight_mm2[nodes.lit :].sum() == 0
