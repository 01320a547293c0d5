"""Energy in the far field, and subreflectors against their equivalent paraboloids."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.rf.antenna import Antenna, Blockage, Feed, Reflector, Subreflector
from dishmap.rf.correction import no_correction
from dishmap.rf.deformation import Deformation, undeformed
from dishmap.rf.farfield import far_field
from dishmap.rf.sources import Sources, sampled, sources, wavelength_of

Array = NDArray[np.float64]

# Currents by physical optics radiate what the dish intercepts but for its edge, whose share is about the taper there times wavelength
# over diameter: 1e-3 at 60 wavelengths and 12 dB.
ENERGY = 1e-3
# rounding of gains
SAME_DB = 1e-9


def lit(whole: Antenna, widest: float, deformation: Deformation | None = None) -> tuple[Sources, float]:
    wavelength = wavelength_of(whole, 30.0)
    d = deformation or undeformed(whole.reflector)
    return sources(whole, d, no_correction(whole), sampled(whole, d, wavelength, widest)), wavelength


def radiated_forward(made: Sources, wavelength: float, polarization: str) -> float:
    """Gain over the front hemisphere, by Gauss-Legendre in theta and equal steps around, over 4 pi."""
    x, w = np.polynomial.legendre.leggauss(220)
    theta = np.pi / 4 * (x + 1)
    phi = 2 * np.pi * (np.arange(440) + 0.5) / 440
    u, v = (np.sin(theta)[:, None] * f(phi) for f in (np.cos, np.sin))
    co, cross = far_field(made, wavelength, u.ravel(), v.ravel(), polarization)
    gain = (np.abs(co) ** 2 + np.abs(cross) ** 2).reshape(u.shape)
    return float((gain.mean(axis=1) * np.sin(theta) * w).sum() * np.pi / 4 * 2 * np.pi / (4 * np.pi))


CASES = {
    "prime": Antenna(Reflector(600, 300), Feed("gaussian", 12.0)),
    "cassegrain": Antenna(
        Reflector(600, 300), Feed("gaussian", 12.0, polarization="right"), Subreflector("cassegrain", 220, 4), Blockage(0.0)
    ),
    # seen under less than 90 degrees, so that the beam which makes the dish's shadow stays behind it
    "offset": Antenna(Reflector(600, 500, 350.0), Feed("gaussian", 12.0, polarization="y")),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("bent_mm", [0.0, 1.0])
def test_the_front_receives_what_the_dish_intercepts(name: str, bent_mm: float) -> None:
    whole = CASES[name]
    bend = Deformation(((2, 2), (3, 1), (4, -2)), bent_mm * np.array([1.0, 0.6, -0.5]), whole.reflector.center_mm, 300.0)
    made, wavelength = lit(whole, 1.0, bend)
    intercepted = float(made.arriving.sum())
    assert 0.8 < intercepted < 1
    assert radiated_forward(made, wavelength, whole.feed.polarization) == pytest.approx(intercepted, rel=ENERGY)


def boresight_db(made: Sources, wavelength: float, polarization: str) -> tuple[float, float]:
    co, cross = far_field(made, wavelength, [0.0], [0.0], polarization)
    return float(20 * np.log10(np.abs(co[0]))), float(np.abs(cross[0]) / np.abs(co[0]))


@pytest.mark.parametrize("kind", ["cassegrain", "gregorian"])
@pytest.mark.parametrize("polarization", ["x", "y", "right", "left"])
@pytest.mark.parametrize("magnification", [2.0, 4.0])
def test_a_perfect_subreflector_is_its_equivalent_paraboloid(kind: str, polarization: str, magnification: float) -> None:
    """Hannan (1961): the same feed, a focal length M times as long; near the beam, where the depth of the dish shows no difference."""
    feed = Feed("gaussian", 12.0, polarization=polarization)
    whole = Antenna(Reflector(600, 300), feed, Subreflector(kind, 220.0, magnification), Blockage(0.0))
    longer = Antenna(Reflector(600, 300 * magnification), feed)
    (made, wavelength), (equal, _) = lit(whole, 0.05), lit(longer, 0.05)
    (one, cross), (two, _) = boresight_db(made, wavelength, polarization), boresight_db(equal, wavelength, polarization)
    assert one == pytest.approx(two, abs=SAME_DB)
    assert cross < 1e-10
    v = np.linspace(0, 0.035, 36)
    a, b = (np.abs(far_field(s, wavelength, 0.6 * v, 0.8 * v, polarization)[0]) for s in (made, equal))
    # over two wavelengths / diameter, of fields that the dishes' depths turn by up to k * 56 mm * v^2 / 2 = 0.02 rad
    assert np.abs(a - b).max() < 2e-3 * b[0]


@pytest.mark.parametrize("kind", ["cassegrain", "gregorian"])
def test_the_same_field_over_the_same_dish_is_the_same_pattern(kind: str) -> None:
    """Feeds that are given by the field over the aperture make it with and without a subreflector, so that all directions agree."""
    feed = Feed("aperture", 12.0)
    made, wavelength = lit(Antenna(Reflector(600, 300), feed, Subreflector(kind, 220.0, 4.0), Blockage(0.0)), 0.5)
    equal, _ = lit(Antenna(Reflector(600, 300), feed), 0.5)
    v = np.linspace(-0.5, 0.5, 20)
    for ours, theirs in zip(far_field(made, wavelength, 0.3 * v, v, "x"), far_field(equal, wavelength, 0.3 * v, v, "x"), strict=True):
        assert np.abs(np.abs(ours) - np.abs(theirs)).max() < 1e-9 * np.abs(equal.moment).sum()
    assert np.abs(np.abs(made.rays.field) - np.abs(equal.rays.field)).max() < 1e-10 * np.abs(equal.rays.field).max()


def test_uniform_light_is_the_text_books_efficiency() -> None:
    """-12 dB: 0.8664 of the disc and 1 - 10^-1.2 of the power; a dish's currents lose a hundredth of a percent to its depth."""
    made, wavelength = lit(Antenna(Reflector(600, 300), Feed("aperture", 12.0)), 0.0)
    db, _ = boresight_db(made, wavelength, "x")
    t = 1.2 * np.log(10)
    efficiency = 4 / t * (1 - np.exp(-t / 2)) ** 2 / (1 - np.exp(-t)) * (1 - np.exp(-t))
    assert db == pytest.approx(10 * np.log10(efficiency * (np.pi * 600 / wavelength) ** 2), abs=1e-3)
    assert efficiency / (1 - 10**-1.2) == pytest.approx(0.8664, abs=5e-5)


def test_a_central_shadow_takes_away_its_field() -> None:
    """The field on the axis is that of the annulus: (G0 - G1) of Gaussians over discs."""
    feed = Feed("aperture", 12.0)
    db = []
    for blocked in (0.0, 120.0):
        made, wavelength = lit(Antenna(Reflector(600, 300), feed, None, Blockage(blocked)), 0.0)
        db.append(boresight_db(made, wavelength, "x")[0])
    t = 1.2 * np.log(10) / 2
    share = (1 - np.exp(-t * 0.2**2)) / (1 - np.exp(-t))
    # the middle of a dish is flat: 1e-4 of the field
    assert db[1] - db[0] == pytest.approx(20 * np.log10(1 - share), abs=2e-3)
