"""The feed's far field, scaled so that the power it radiates in all directions is 1.

Directions are unit vectors in the feed's own frame, z along its axis. A Huygens source has the field of Ludwig's third definition,
co-polar only (Ludwig 1973): the vector at the axis, carried along the great circle to the direction without turning.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.interpolate import RectBivariateSpline
from scipy.signal import resample

from dishmap.errors import InputError
from dishmap.rf.antenna import CutTable, Feed

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# A table is interpolated around the axis by its Fourier series, onto so many azimuths, and by splines between those; some are repeated
# on either side, so that the splines do not see an end.
AROUND, WRAPPED = 144, 4


@dataclass(frozen=True)
class FeedField:
    """A feed that sees the antenna's rim at edge_rad from its axis; hand: +1, or -1 where circular polarisation is the mirrored one."""

    feed: Feed
    edge_rad: float
    hand: int
    scale: float
    splines: tuple[RectBivariateSpline, ...] = ()


def feed_field(feed: Feed, edge_rad: float, reflections: int) -> FeedField:
    """The feed of an antenna whose rim lies edge_rad from its axis, before so many reflections.

    Raises InputError when it cannot be: a cosine feed that would have to look sideways or back, a table that ends before the rim.
    """
    hand = -1 if reflections % 2 else 1
    if feed.kind == "cut":
        assert feed.table is not None
        return _tabulated(feed, feed.table, edge_rad, hand)
    if feed.kind == "cosine" and edge_rad >= np.pi / 2:
        raise InputError(
            f"a cosine feed radiates within 90 degrees of its axis, but the rim lies at {np.degrees(edge_rad):.4g} degrees; "
            "use a gaussian feed or a longer focal length"
        )
    one = FeedField(feed, edge_rad, hand, 1.0)
    return FeedField(feed, edge_rad, hand, float((2 * np.pi * _power(one)) ** -0.5))


def radiated(field: FeedField, direction: Array) -> Complex:
    """Electric field (N, 3) at unit directions (N, 3), times distance, without the phase of the distance, in the feed's frame."""
    along_x, along_y = ludwig_axes(direction)
    if field.splines:
        assert field.feed.table is not None
        first = np.radians(field.feed.table.phi_deg[0])
        theta = np.arccos(np.clip(direction[:, 2], -1, 1))
        phi = first + np.mod(np.arctan2(direction[:, 1], direction[:, 0]) - first, 2 * np.pi)
        parts = [spline.ev(phi, theta) for spline in field.splines]
        inside = theta <= np.radians(field.feed.table.theta_deg[-1])
        # a table says itself how the feed is polarised
        co, cross = inside * (parts[0] + 1j * parts[1]), inside * (parts[2] + 1j * parts[3])
        return np.asarray(field.scale * (co[:, None] * along_x + cross[:, None] * along_y))
    co_axis, _ = polarization_axes(field.feed.polarization, field.hand, along_x, along_y)
    return np.asarray(field.scale * _profile(field, direction[:, 2])[:, None] * co_axis)


def ludwig_axes(direction: Array) -> tuple[Array, Array]:
    """Unit vectors (N, 3) of Ludwig's third definition along x and y at unit directions (N, 3)."""
    bend = (direction + [0.0, 0.0, 1.0]) / np.maximum(1 + direction[:, 2:], 1e-300)
    return np.array([1.0, 0.0, 0.0]) - direction[:, :1] * bend, np.array([0.0, 1.0, 0.0]) - direction[:, 1:2] * bend


def polarization_axes(polarization: str, hand: int, along_x: Array, along_y: Array) -> tuple[Complex, Complex]:
    """Unit vectors (N, 3) of the co- and cross-polar field; right-hand circular is (x - j y) / sqrt 2 with time as exp(+j w t)."""
    if polarization == "x":
        return along_x.astype(complex), along_y.astype(complex)
    if polarization == "y":
        return along_y.astype(complex), along_x.astype(complex)
    turn = -1j * hand if polarization == "right" else 1j * hand
    return (along_x + turn * along_y) / np.sqrt(2), (along_x - turn * along_y) / np.sqrt(2)


def _profile(field: FeedField, cosine: Array) -> Array:
    """Amplitude over the cosine of the angle from the axis, 1 on it."""
    feed, edge = field.feed, field.edge_rad
    if feed.kind == "cosine":
        q = feed.exponent or -feed_taper(feed) / (20 * np.log10(np.cos(edge)))
        return np.asarray(np.maximum(cosine, 0.0) ** q)
    if feed.kind == "gaussian":
        return np.asarray(10 ** (-feed_taper(feed) / 20 * (np.arccos(np.clip(cosine, -1, 1)) / edge) ** 2))
    # over the aperture the field is the feed's times cos^2 of half the angle, over the equivalent focal length
    half2 = np.maximum((1 + cosine) / 2, 1e-12)
    return np.asarray(10 ** (-feed_taper(feed) / 20 * ((1 / half2 - 1) / np.tan(edge / 2) ** 2)) / half2)


def _power(field: FeedField) -> float:
    """Integral of the squared profile over the cosine, in pieces that double from half the rim's angle: the beam may be very narrow."""
    ends = [0.0, *(field.edge_rad / 2 * 2.0 ** np.arange(60))]
    ends = [*(t for t in ends if t < np.pi), np.pi]
    pieces = (quad(lambda t: _profile(field, np.array([np.cos(t)]))[0] ** 2 * np.sin(t), a, b)[0] for a, b in pairwise(ends))
    return float(sum(pieces))


def feed_taper(feed: Feed) -> float:
    """The edge taper in dB; a feed that is given by an exponent or a table has none here."""
    assert feed.edge_taper_db is not None
    return feed.edge_taper_db


def _tabulated(feed: Feed, table: CutTable, edge_rad: float, hand: int) -> FeedField:
    last = float(table.theta_deg[-1])
    if last < np.degrees(edge_rad):
        raise InputError(
            f"the feed's table ends at {last:.4g} degrees from its axis, but the rim of the reflector lies at "
            f"{np.degrees(edge_rad):.4g} degrees; give a table that reaches beyond the rim"
        )
    theta, count = np.radians(table.theta_deg), len(table.phi_deg)
    phi = np.radians(table.phi_deg[0]) + 2 * np.pi * np.arange(count) / count
    if count < 3 or np.abs(np.radians(table.phi_deg) - phi).max() > 1e-6:
        raise InputError(
            f"the feed's table has {count} azimuths, from {table.phi_deg[0]:.4g} to {table.phi_deg[-1]:.4g} degrees; "
            "it needs three or more in equal steps around the axis"
        )
    wrapped = phi[0] + 2 * np.pi * np.arange(-WRAPPED, AROUND + WRAPPED) / AROUND
    full = [resample(part, AROUND, axis=0) for part in (table.co, table.cross)]
    rows = [np.concatenate([part[-WRAPPED:], part, part[:WRAPPED]]) for part in full]
    degree = min(3, len(theta) - 1)
    splines = tuple(RectBivariateSpline(wrapped, theta, part, kx=3, ky=degree) for row in rows for part in (row.real, row.imag))
    field = FeedField(feed, edge_rad, hand, 1.0, splines)
    t, w = np.polynomial.legendre.leggauss(400)
    theta, step = theta[-1] * (t + 1) / 2, theta[-1] * w / 2
    around = 2 * np.pi * np.arange(72) / 72
    tt, pp = (g.ravel() for g in np.meshgrid(theta, around, indexing="ij"))
    direction = np.stack([np.sin(tt) * np.cos(pp), np.sin(tt) * np.sin(pp), np.cos(tt)], axis=1)
    density = (np.abs(radiated(field, direction)) ** 2).sum(axis=1).reshape(len(theta), -1).mean(axis=1)
    power = float(2 * np.pi * (density * np.sin(theta) * step).sum())
    if not power > 0:
        raise InputError("the feed's table holds no power; give fields that are not zero everywhere")
    return FeedField(feed, edge_rad, hand, power**-0.5, splines)
