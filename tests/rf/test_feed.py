"""The feed: power, tapers, Ludwig's axes, hands, and tables against the feeds that they were made from."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.antenna import CutTable, Feed
from dishmap.rf.feed import FeedField, feed_field, ludwig_axes, polarization_axes, radiated

Array = NDArray[np.float64]

# of the integral below over the sphere
POWER = 1e-6
ROUNDING = 1e-12
# a spline over a Gaussian of 12 dB at 63 degrees with steps of 5 degrees, in dB; and cross-polar field in it over the peak
TABLE_DB, TABLE_CROSS = 0.005, 1e-4


def directions(theta: Array, phi: Array) -> Array:
    theta, phi = np.broadcast_arrays(theta, phi)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1).reshape(-1, 3)


def power(field: FeedField, widest: float = np.pi, pieces: int = 1) -> float:
    """Over the sphere, by a product of Gauss-Legendre in theta (in geometric pieces) and equal steps of azimuth."""
    x, w = np.polynomial.legendre.leggauss(300)
    total = 0.0
    ends = np.concatenate([[0.0], widest * 4.0 ** np.arange(-pieces + 1, 1)])
    for a, b in itertools.pairwise(ends):
        theta = a + (b - a) * (x + 1) / 2
        phi = 2 * np.pi * np.arange(36) / 36
        e = radiated(field, directions(theta[:, None], phi)).reshape(300, 36, 3)
        total += float(((np.abs(e) ** 2).sum(axis=2).mean(axis=1) * np.sin(theta) * w).sum() * np.pi * (b - a))
    return total


@pytest.mark.parametrize("polarization", ["x", "y", "right", "left"])
@pytest.mark.parametrize(
    "feed",
    [
        Feed("gaussian", 12.0),
        Feed("cosine", 12.0),
        Feed("cosine", exponent=0.7),
        Feed("cosine", exponent=1000.0),
        Feed("aperture", 12.0),
        Feed("aperture", 0.3),
    ],
)
def test_the_power_is_one(feed: Feed, polarization: str) -> None:
    feed = Feed(feed.kind, feed.edge_taper_db, feed.exponent, polarization)
    field = feed_field(feed, np.radians(63), 1)
    if feed.kind == "cosine":
        assert power(field, np.pi / 2, 4) == pytest.approx(1, abs=POWER)
    else:
        # an aperture's field grows towards the back before it falls
        assert power(field) == pytest.approx(1, abs=1e-4 if feed.edge_taper_db == 0.3 else POWER)


@pytest.mark.parametrize("kind", ["gaussian", "aperture"])
@pytest.mark.parametrize("edge", [1e-4, 1e-3, 0.02, 0.9, 2.0])
def test_the_power_is_one_however_narrow_the_beam(kind: str, edge: float) -> None:
    assert power(feed_field(Feed(kind, 12.0), edge, 2), np.pi, 12) == pytest.approx(1, abs=POWER)


@given(st.floats(0.02, 1.5), st.floats(0.1, 40))
def test_tapers_at_the_rim(edge: float, taper: float) -> None:
    at = directions(np.array([0.0, edge]), np.array(0.7))
    for kind, space in (("gaussian", 1.0), ("cosine", 1.0), ("aperture", np.cos(edge / 2) ** 2)):
        field = np.linalg.norm(radiated(feed_field(Feed(kind, taper), edge, 1), at), axis=1)
        assert 20 * np.log10(field[0] / (field[1] * space)) == pytest.approx(taper, abs=1e-9)


@given(st.floats(0, 3.1), st.floats(-7, 7))
def test_ludwig_axes_are_transverse_and_right_handed(theta: float, phi: float) -> None:
    r = directions(np.array(theta), np.array(phi))
    x, y = ludwig_axes(r)
    assert np.abs([np.linalg.norm(x) - 1, np.linalg.norm(y) - 1, (x * r).sum(), (y * r).sum(), (x * y).sum()]).max() < 1e-10
    assert np.abs(np.cross(x, y) - r).max() < 1e-10
    # Ludwig (1973), table 1, definition 3: i_ref = sin(phi) theta + cos(phi) phi for y
    along = np.array([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)])
    around = np.array([-np.sin(phi), np.cos(phi), 0.0])
    assert np.abs(x[0] - (np.cos(phi) * along - np.sin(phi) * around)).max() < 1e-10
    assert np.abs(y[0] - (np.sin(phi) * along + np.cos(phi) * around)).max() < 1e-10


def test_axes_are_carried_along_great_circles_without_turning() -> None:
    """Parallel transport, step by step: the projection of the last vector on the next tangent plane."""
    theta = np.linspace(0, 2.5, 20001)
    path = directions(theta, np.array(0.8))
    vector = np.array([1.0, 0.0, 0.0])
    for r in path[1:]:
        vector = vector - (vector @ r) * r
        vector /= np.linalg.norm(vector)
    assert np.abs(ludwig_axes(path[-1:])[0][0] - vector).max() < 1e-3


@pytest.mark.parametrize(("polarization", "hand", "sense"), [("right", 1, 1), ("left", 1, -1), ("right", -1, -1), ("left", -1, 1)])
def test_circular_hands(polarization: str, hand: int, sense: int) -> None:
    """IEEE: a right-hand wave turns clockwise for one who looks along its way, from x towards y when it goes to +z."""
    co, cross = polarization_axes(polarization, hand, *ludwig_axes(np.array([[0.0, 0.0, 1.0]])))
    for axis, turns in ((co[0], sense), (cross[0], -sense)):
        now, later = (np.real(axis * np.exp(1j * phase)) for phase in (0.0, 0.1))
        assert np.sign(now[0] * later[1] - now[1] * later[0]) == turns
    assert abs((co * cross.conj()).sum()) < ROUNDING
    assert np.linalg.norm(co) == pytest.approx(1) == np.linalg.norm(cross)


def gaussian_table(step: float, azimuths: int, cross: float = 0.0, last: float = 180.0, first: float = 0.0) -> CutTable:
    theta = np.arange(0, last + step / 2, step)
    co = 10 ** (-12 / 20 * (theta / 63) ** 2)
    phi = first + np.arange(azimuths) * 360.0 / azimuths
    turn = cross * np.sin(2 * np.radians(phi))[:, None] * np.sin(np.radians(theta))[None] ** 2
    return CutTable(theta, phi, np.tile(co, (azimuths, 1)) * np.exp(0.3j), turn * np.exp(0.3j))


@pytest.mark.parametrize("polarization", ["x", "y", "right", "left"])
@pytest.mark.parametrize("first", [0.0, 10.0])
def test_a_table_gives_back_the_feed_that_it_was_made_of(polarization: str, first: float) -> None:
    edge = np.radians(63)
    exact = feed_field(Feed("gaussian", 12.0, polarization=polarization), edge, 1)
    # a table holds fields along x and y; before one reflection circular feeds have the other hand
    along = polarization_axes(polarization, -1, np.eye(3)[:1], np.eye(3)[1:2])[0][0]
    plain = gaussian_table(5.0, 8, first=first)
    mixed = CutTable(plain.theta_deg, plain.phi_deg, along[0] * plain.co, along[1] * plain.co)
    table = feed_field(Feed("cut", polarization=polarization, table=mixed), edge, 1)
    r = directions(np.linspace(0, edge, 40)[:, None], np.linspace(-4, 4, 33))
    a, b = radiated(exact, r), radiated(table, r) * np.exp(-0.3j)
    assert np.abs(20 * np.log10(np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1))).max() < TABLE_DB
    co, cross = polarization_axes(polarization, -1, *ludwig_axes(r))
    peak = np.abs(a).max()
    assert np.abs((b * cross.conj()).sum(axis=1)).max() < TABLE_CROSS * peak
    assert np.abs(((a - b) * co.conj()).sum(axis=1)).max() < 1e-3 * peak
    assert power(table) == pytest.approx(1, abs=1e-4)


def test_a_table_keeps_its_cross_polar_field_between_its_azimuths() -> None:
    field = feed_field(Feed("cut", table=gaussian_table(5.0, 8, cross=0.2)), np.radians(63), 2)
    theta, phi = np.radians([20.0, 45.0, 60.0])[:, None], np.radians([3.0, 22.5, 100.0, 351.0])
    r = directions(theta, phi)
    e = radiated(field, r)
    co, cross = polarization_axes("x", 1, *ludwig_axes(r))
    ratio = (e * cross.conj()).sum(axis=1) / (e * co.conj()).sum(axis=1)
    expected = 0.2 * np.sin(2 * phi) * np.sin(theta) ** 2 / 10 ** (-12 / 20 * (np.degrees(theta) / 63) ** 2)
    assert np.abs(ratio.reshape(3, 4) - expected).max() < 1e-4


def test_a_table_has_nothing_beyond_its_end() -> None:
    field = feed_field(Feed("cut", table=gaussian_table(5.0, 8, last=100.0)), np.radians(63), 1)
    assert not radiated(field, directions(np.array([1.8, 3.0]), np.array(0.3))).any()
    assert power(field, np.radians(100)) == pytest.approx(1, abs=POWER)


def test_feeds_that_cannot_be() -> None:
    for feed in (Feed("cosine", 12.0), Feed("cosine", exponent=2.0)):
        with pytest.raises(InputError, match=r"within 90 degrees of its axis, but the rim lies at 100"):
            feed_field(feed, np.radians(100), 1)
    with pytest.raises(InputError, match=r"table ends at 60 degrees from its axis, but the rim of the reflector lies at 63"):
        feed_field(Feed("cut", table=gaussian_table(5.0, 8, last=60.0)), np.radians(63), 1)
    with pytest.raises(InputError, match=r"has 2 azimuths"):
        feed_field(Feed("cut", table=gaussian_table(5.0, 2)), np.radians(63), 1)
    uneven = gaussian_table(5.0, 4)
    with pytest.raises(InputError, match=r"equal steps around the axis"):
        feed_field(
            Feed("cut", table=CutTable(uneven.theta_deg, np.array([0.0, 45.0, 90.0, 180.0]), uneven.co, uneven.cross)), np.radians(63), 1
        )
    with pytest.raises(InputError, match=r"holds no power"):
        feed_field(Feed("cut", table=CutTable(uneven.theta_deg, uneven.phi_deg, 0 * uneven.co, uneven.cross * 0)), np.radians(63), 1)
