"""Gain as a function of what the actuators do, with its derivatives, cheap enough to climb.

The field towards a direction r is a sum over currents, E = sum c exp(j k (r . p - L)). The paths L are exact, with their derivative to
every actuator by Fermat's principle. The co-polar moments c change slowly, but where a subreflector moves far for its size they do; their
relative derivatives are differences, made new now and then. With q the terms of the sum over E (complex weights that add up to 1),
s the derivatives of the phase and t those of ln c,

    d ln|E|^2 = 2 Re sum q (t + j s),    d2 ln|E|^2 = -2 Re (sum q s s' - (sum q s)(sum q s)'),

the latter without the second derivatives of paths and moments: it is the covariance of phase slopes over the aperture.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.antenna import Antenna
from dishmap.rf.correction import correction_of
from dishmap.rf.feed import ludwig_axes, polarization_axes
from dishmap.rf.pattern import direction_of
from dishmap.rf.sources import Illuminated, sources_after

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Derivative of a power ratio's dB to its natural logarithm.
DB = 10 / np.log(10)
# Share of a full stroke over which differences are taken: far above rounding, far below any curvature.
SMALL = 1e-3


@dataclass(frozen=True)
class Traced:
    """The antenna with its actuators in one place.

    values (P,): of the actuators; path_mm (N,); by_values (N, P): its derivatives; point_mm (N, 3); moment (N, 3), zero where no ray
    arrives; reflection_mm (N, 3): on the subreflector; direction (N, 3): of arrival; polarization: of the beam.
    """

    values: Array
    path_mm: Array
    by_values: Array
    point_mm: Array
    moment: Complex
    reflection_mm: Array
    direction: Array
    polarization: str


@dataclass(frozen=True)
class Lobe:
    """Gain towards one direction: its dB, and first and second derivatives to (values, u, v): (P + 2,), (P + 2, P + 2)."""

    gain_dbi: float
    slope: Array
    bend: Array


class Tracer(Protocol):
    """A function from values (P,) to the antenna there; `near`: the antenna in a place not far away, which saves time."""

    def __call__(self, values: Array, near: Traced | None = None) -> Traced:
        """Trace."""
        ...


def tracer(antenna: Antenna, dish: Illuminated) -> Tracer:
    """Exact paths and currents; the function raises InputError where the subreflector hits something."""

    def traced(values: Array, near: Traced | None = None) -> Traced:
        start = None if near is None else near.reflection_mm
        found = sources_after(antenna, dish, correction_of(values), start)
        rays = found.rays
        wanted = antenna.feed.polarization
        return Traced(values, rays.path_mm, rays.by_values, found.point_mm, found.moment, rays.reflection_mm, rays.direction, wanted)

    return traced


def linear_tracer(at: Traced) -> Tracer:
    """Paths that change linearly from those at one place, currents that do not change: for searches over many starts."""

    def traced(values: Array, near: Traced | None = None) -> Traced:
        return replace(at, values=values, path_mm=at.path_mm + at.by_values @ (values - at.values))

    return traced


def fading(trace: Tracer, here: Traced, used: NDArray[np.int64], scale: Array) -> Complex:
    """Relative derivatives (N, P) of the moments to the values `used` (P,), by differences over a small share of their `scale` (P,)."""
    weight = (np.abs(here.moment) ** 2).sum(axis=1)
    out = np.zeros((len(weight), len(used)), complex)
    for column, (index, full) in enumerate(zip(used, scale, strict=True)):
        for step in (SMALL * full, -SMALL * full):
            moved = here.values.copy()
            moved[index] += step
            with suppress(InputError):
                after = trace(moved, here).moment
                # where no ray arrives before or after, there is nothing to follow
                seen = (weight > 0) & after.any(axis=1)
                change = ((after - here.moment) * here.moment.conj()).sum(axis=1)
                out[seen, column] = change[seen] / weight[seen] / step
                break
    return out


def co_moment(traced: Traced, uv: Array) -> Complex:
    """Moments (N,) along the co-polar unit vector of a direction (u, v)."""
    direction = direction_of(uv)[None, :]
    co, _ = polarization_axes(traced.polarization, 1, *ludwig_axes(direction))
    return np.asarray(traced.moment @ co[0].conj())


def gain_dbi(traced: Traced, moment: Complex, wavenumber: float, uv: Array) -> float:
    """Co-polar gain towards (u, v) with given moments (N,)."""
    phase = wavenumber * (traced.point_mm @ direction_of(uv) - traced.path_mm)
    return _decibels(abs(moment @ np.exp(1j * phase)), wavenumber)


def lobe(traced: Traced, moment: Complex, wavenumber: float, uv: Array, used: NDArray[np.int64], fade: Complex | None = None) -> Lobe:
    """Co-polar gain towards (u, v) with given moments (N,), and how it changes with the values `used` (P,) and the direction.

    fade (N, P): relative derivatives of the moments to the actuators, None for none.
    """
    r = direction_of(uv)
    share = moment * np.exp(1j * wavenumber * (traced.point_mm @ r - traced.path_mm))
    total = share.sum()
    share = share / total
    slopes = wavenumber * phase_slopes(traced, r, used)
    mean = share @ slopes
    second = (slopes * share.real[:, None]).T @ slopes - (mean[:, None] * mean[None, :]).real
    slope = -2 * DB * mean.imag
    if fade is not None:
        slope[: fade.shape[1]] += 2 * DB * (share @ fade).real
    return Lobe(_decibels(abs(total), wavenumber), slope, -2 * DB * second)


def phase_slopes(traced: Traced, direction: Array, used: NDArray[np.int64]) -> Array:
    """Derivatives (N, P + 2) of r . p - path, in mm, to the values `used` (P,) and to u and v."""
    x, y, z = traced.point_mm.T
    u, v, w = direction
    return np.column_stack([-traced.by_values[:, used], x - u / w * z, y - v / w * z])


def _decibels(total: float, wavenumber: float) -> float:
    return float(20 * np.log10(max(total, 1e-300) * wavenumber / np.sqrt(4 * np.pi)))
