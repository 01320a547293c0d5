"""Gain left on the table because the map is not exact: corrections made from noisy maps, judged on the true dish.

About the correction made from the truth, the best values follow the map linearly (implicit function theorem): with z the unknowns and c the
coefficients of the map, dz = -H_zz^-1 H_zc dc, H the second derivatives of the gain, within the limits. Where the noise is too large for
that, each map's correction is climbed to, on linear paths, and its difference to what the same climb makes of the exact map is taken. What
each correction gives on the true dish is the whole sum over the aperture, with exact paths and the currents that it makes.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.antenna import Antenna
from dishmap.rf.beam import log_gain_slopes, uphill
from dishmap.rf.climb import Aim, Place, aim_of, climb, convex, model
from dishmap.rf.correct import CorrectionFound
from dishmap.rf.deformation import Deformation
from dishmap.rf.limits import Limits, best_step, limits_of, whole, within
from dishmap.rf.pattern import direction_of
from dishmap.rf.sources import illuminated, sampled, wavelength_of
from dishmap.rf.surrogate import DB, Traced, Tracer, co_moment, fading, gain_dbi, linear_tracer, phase_slopes, tracer
from dishmap.surface.zernike import zernike_matrix

Array = NDArray[np.float64]

# Maps whose noise changes phases by more (rms, rad) are climbed for, one by one.
LINEAR_RAD = 0.5
POINTING_STEPS = 4
# A value this near to its limit, as a share of the stroke, is held by it.
HELD = 1e-3
# Curvature along the ways of the actuators is taken over a step that costs so much, dB, at most this share of the full strokes.
SHIFT_DB, SHIFT = 0.1, 0.1


@dataclass(frozen=True)
class Margin:
    """Loss of gain in dB against the correction made from the truth, for S sigmas of each target and F frequencies.

    mean_db, high_db (S, F): mean and 90th percentile over draws; linear (S,): whether the linear response was used. values_sigma (P,): what
    the map's own covariance does to all values of a rigid correction, in their units; 0 for those that a limit holds or that do not move.
    NaN for a bend: many of them are nearly as good, and another map leads to another one, farther off than slopes at this one say.
    """

    sigma_mm: Array
    frequencies_ghz: tuple[float, ...]
    mean_db: Array
    high_db: Array
    linear: NDArray[np.bool_]
    values_sigma: Array


def gain_margin(
    antenna: Antenna,
    deformation: Deformation,
    found: CorrectionFound,
    terms: Sequence[tuple[int, int]],
    responses: Sequence[Array],
    factor_mm: Array,
    sigmas_mm: Sequence[float],
    rng: Generator,
    draws: int = 100,
) -> Margin:
    """What noise of the map costs the correction `found` for a deformation that is taken as the truth.

    sigmas_mm: of each of N targets, independent; responses (T, N): for each of these, coefficients of the terms (T), on the deformation's
    disc, for each mm of displacement of a target; factor_mm (T, R): of the covariance of the map's coefficients; draws: an even number.
    Whether the shape moves is as in `found`. Raises InputError for a response or factor that does not fit its terms.
    """
    for what, matrix in (*(("response", one) for one in responses), ("factor", factor_mm)):
        if matrix.ndim != 2 or len(matrix) != len(terms):
            raise InputError(f"the {what} must have a row for each of the {len(terms)} terms, not the shape {matrix.shape}")
    shaped = bool(found.correction.shape_mm.any())
    limits = limits_of(antenna.actuators, shaped)
    about = _about(antenna, deformation, found, limits, terms)
    half = rng.standard_normal(((draws + 1) // 2, responses[0].shape[1]))
    # in pairs of opposite noise: what is left of a slope at the best place cancels, and the mean is that of the curvature
    noise = np.concatenate([half, -half])
    mean, high, linear = [], [], []
    for sigma, response in zip(sigmas_mm, responses, strict=True):
        unit = noise @ response.T
        small = bool(sigma * _phase_rms(about, unit) < LINEAR_RAD)
        losses = np.array([_loss(about, limits, sigma * change, small) for change in unit])
        mean.append(losses.mean(axis=0))
        high.append(np.percentile(losses, 90, axis=0))
        linear.append(small)
    own = np.full(limits.size, np.nan) if shaped else _values_sigma(about, limits, factor_mm)
    return Margin(np.array(sigmas_mm, float), found.frequencies_ghz, np.array(mean), np.array(high), np.array(linear), own)


@dataclass(frozen=True)
class _About:
    """The true dish under its best correction: where it is, how paths (N, T) follow the map, and the quadratic model there.

    trace: the antenna with other values; base (P,), base_uv (F, 2): the correction, and best_dbi (F,) with it; place: where the model is;
    climbed (P,): where a climb on linear paths ends from there without noise.
    """

    antenna: Antenna
    trace: Tracer
    base: Array
    base_uv: Array
    place: Place
    climbed: Array
    aim: Aim
    by_map: Array
    slope: Array
    bend: Array
    mixed: Array
    best_dbi: Array


def _about(antenna: Antenna, deformation: Deformation, found: CorrectionFound, limits: Limits, terms: Sequence[tuple[int, int]]) -> _About:
    wavelengths = np.array([wavelength_of(antenna, f) for f in found.frequencies_ghz])
    nodes = sampled(antenna, deformation, float(wavelengths.min()))
    dish = illuminated(antenna, deformation, nodes)
    trace = tracer(antenna, dish)
    here = trace(found.correction.values)
    place = Place(found.correction.values[limits.used], found.after_uv, here)
    aim = aim_of(wavelengths, antenna.reflector.diameter_mm, found.pointing == "free")
    if len(limits.heights):
        # a bend is not where phases alone would have it; what an error of the map does is counted from there, with the currents of the bend
        rest = climb(linear_tracer(here), aim, limits, place.values, place.uv, fades=False)
        here, place = rest.traced, Place(rest.values, rest.uv, rest.traced)
    fade = None if len(limits.heights) else fading(trace, here, limits.used, limits.scale)
    slope, bend = model(place, aim, limits, fade)
    # at the best place only limits hold back what the slope asks for; the rest of it is rounding of the search
    held = np.zeros(len(slope), bool)
    held[: len(limits.used)] = np.abs(place.values) > (1 - HELD) * limits.scale
    if not len(limits.heights) or np.abs(limits.heights @ place.values).max() < (1 - HELD) * limits.stroke_mm:
        slope = np.where(held, slope, 0.0)
    x, y = ((nodes.xy_mm - deformation.center_mm) / deformation.radius_mm).T
    # a rise along the normal changes the path by n . (b - r); b is the direction in which the path grows with the point
    towards = here.direction - np.array([0.0, 0.0, 1.0])
    by_map = (dish.normal * towards).sum(axis=1)[:, None] * zernike_matrix(tuple(terms), x, y)
    mixed = _mixed(place, aim, limits, by_map)
    base, base_uv = found.correction.values[limits.used], found.after_uv
    climbed = climb(linear_tracer(here), aim, limits, place.values, place.uv, fades=False).values
    about = _About(antenna, trace, base, base_uv, place, climbed, aim, by_map, slope, bend, mixed, np.zeros(len(wavelengths)))
    about = replace(about, best_dbi=_given(about, limits, base))
    return replace(about, bend=_stiffened(about, limits))


def _values_sigma(about: _About, limits: Limits, factor_mm: Array) -> Array:
    """Standard deviations (P, of the whole vector) of the values that maps with this factor (T, R) of their covariance ask for."""
    count = len(limits.used)
    free = np.ones(len(about.bend), bool)
    free[:count] = np.abs(about.place.values) <= (1 - HELD) * limits.scale
    scale = np.concatenate([limits.scale, np.full(about.aim.extra, about.aim.unit)])[free]
    bend = convex(about.bend[np.ix_(free, free)] * np.outer(scale, scale), 0.0)
    moved = np.zeros((len(about.bend), factor_mm.shape[1]))
    moved[free] = scale[:, None] * np.linalg.solve(bend, scale[:, None] * (about.mixed[free] @ factor_mm))
    return whole(limits, np.sqrt((moved[:count] ** 2).sum(axis=1)))


def _stiffened(about: _About, limits: Limits) -> Array:
    """Second derivatives (Q, Q) with what moving light adds along the ways (principal axes) of the actuators.

    Phases alone leave some ways nearly free (a subreflector shifted and tilted so that paths stay), along which light leaves the dish.
    """
    count, scale = len(limits.used), limits.scale
    own, across, turn = about.bend[:count, :count], about.bend[:count, count:], about.bend[count:, count:]
    free = (own - across @ np.linalg.solve(turn, across.T) if len(turn) else own) * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(free)
    more = np.zeros(count)
    for i, (value, way) in enumerate(zip(values, vectors.T, strict=True)):
        step = min(SHIFT, np.sqrt(2 * SHIFT_DB / max(value, 1e-12)))
        with suppress(InputError):
            both = [_given(about, limits, about.base + sign * step * way * scale).mean() for sign in (-1, 1)]
            more[i] = max((2 * about.best_dbi.mean() - sum(both)) / step**2 - value, 0.0)
    out = about.bend.copy()
    out[:count, :count] += (vectors * more) @ vectors.T / np.outer(scale, scale)
    return out


def _mixed(place: Place, aim: Aim, limits: Limits, by_map: Array) -> Array:
    """Derivatives (Q, T) of the slope of what is minimised to the map's coefficients."""
    count = len(place.values)
    out = np.zeros((count + aim.extra, by_map.shape[1]))
    for i, (k, uv) in enumerate(zip(aim.wavenumbers, place.uv, strict=True)):
        r = direction_of(uv)
        share = co_moment(place.traced, uv) * np.exp(1j * k * (place.traced.point_mm @ r - place.traced.path_mm))
        share = share / share.sum()
        own, other = k * phase_slopes(place.traced, r, limits.used), -k * by_map
        covariance = (own * share.real[:, None]).T @ other - ((share @ own)[:, None] * (share @ other)[None, :]).real
        to = [*range(count), count + 2 * i, count + 2 * i + 1] if aim.free else [*range(count)]
        out[to] += 2 * DB / len(aim.wavenumbers) * covariance[: len(to)]
    return out


def _loss(about: _About, limits: Limits, change: Array, small: bool) -> Array:
    """Loss (F,) of the correction that a map off by coefficients (T,) asks for."""
    here, aim, count = about.place, about.aim, len(limits.used)
    if small:
        scale = np.concatenate([limits.scale, np.full(aim.extra, aim.unit)])
        slope = (about.slope + about.mixed @ change) * scale
        turned = here.uv.ravel()[: aim.extra]
        step = best_step(slope, convex(about.bend * np.outer(scale, scale), 0.0), limits, here.values, turned, scale, aim.reach)
        moved = step[:count]
    else:
        seen = replace(here.traced, path_mm=here.traced.path_mm + about.by_map @ change)
        moved = climb(linear_tracer(seen), aim, limits, here.values, here.uv, fades=False).values - about.climbed
    values = within(about.antenna.actuators, whole(limits, about.base + moved))[limits.used]
    return about.best_dbi - _given(about, limits, values)


def _given(about: _About, limits: Limits, values: Array) -> Array:
    """Gain in dB (F,) on the true dish with values (P,) of the actuators, pointed anew where that is free."""
    aim, count, uv = about.aim, len(limits.used), about.base_uv
    there = about.trace(whole(limits, values), about.place.traced)
    if aim.free:
        # the beam follows the actuators; Newton's method finds its peak from where it went to the first order
        follow = -np.linalg.solve(about.bend[count:, count:], about.bend[count:, :count] @ (values - about.base))
        uv = uv + follow.reshape(-1, 2)
    return np.array([_peak_dbi(there, k, one, aim.free) for k, one in zip(aim.wavenumbers, uv, strict=True)])


def _peak_dbi(traced: Traced, k: float, uv: Array, free: bool) -> float:
    """Gain at the peak near a direction, or towards it where the pointing is fixed."""
    moment = co_moment(traced, uv)
    x, y, z = traced.point_mm.T
    for _ in range(POINTING_STEPS if free else 0):
        r = direction_of(uv)
        wave = moment * np.exp(1j * k * (traced.point_mm @ r - traced.path_mm))
        gradient, hessian = log_gain_slopes(wave, k, x - z * r[0] / r[2], y - z * r[1] / r[2])
        uv = uv + uphill(gradient, hessian)
    return gain_dbi(traced, moment, k, uv)


def _phase_rms(about: _About, unit: Array) -> float:
    """Phase (rad, weighted rms over aperture and draws) that maps with coefficients (D, T) add at the highest frequency."""
    weight = np.linalg.norm(about.place.traced.moment, axis=1)
    path = about.by_map @ unit.T
    path = path - weight @ path / weight.sum()
    return float(about.aim.wavenumbers.max() * np.sqrt((weight @ path**2 / weight.sum()).mean()))
