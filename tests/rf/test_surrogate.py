"""The surrogate's derivatives against differences."""

from __future__ import annotations

import numpy as np

from dishmap.rf.limits import limits_of, whole
from dishmap.rf.sources import illuminated, sampled
from dishmap.rf.surrogate import co_moment, fading, gain_dbi, linear_tracer, lobe, tracer
from tests.rf.dishes import SHAPED, bent

K = 2 * np.pi / 10.0
DEFORMATION = bent(z22=0.4, z31=0.3, z20=0.2)
UV = np.array([0.004, -0.003])
STEP = 1e-4
# central differences with steps of 1e-4 of gains whose third derivatives stay under 1e3 per unit: dB per mm, degree or, for u and v,
# whose slopes are a thousand times larger, milliradian
SLOPE_TOLERANCE = 1e-4


def scene():
    limits = limits_of(SHAPED.actuators, True)
    trace = tracer(SHAPED, illuminated(SHAPED, DEFORMATION, sampled(SHAPED, DEFORMATION, 10.0)))
    values = whole(limits, 0.1 * np.cos(np.arange(len(limits.used))))
    return limits, trace, values


def test_slopes_of_the_gain_with_currents_held_agree_with_differences() -> None:
    limits, trace, values = scene()
    here = trace(values)
    moment = co_moment(here, UV)
    slope = lobe(here, moment, K, UV, limits.used).slope
    for i in range(len(values)):
        step = STEP * np.eye(len(values))[i]
        up, down = (gain_dbi(trace(values + s * step), moment, K, UV) for s in (1, -1))
        assert abs((up - down) / (2 * STEP) - slope[i]) < SLOPE_TOLERANCE
    for i in range(2):
        step = 1e-3 * STEP * np.eye(2)[i]
        up, down = (gain_dbi(here, moment, K, UV + s * step) for s in (1, -1))
        assert abs((up - down) / (2 * STEP) - 1e-3 * slope[len(values) + i]) < SLOPE_TOLERANCE


def test_second_derivatives_agree_with_differences_of_slopes_where_paths_are_linear() -> None:
    limits, trace, values = scene()
    here = trace(values)
    moment, line = co_moment(here, UV), linear_tracer(here)
    own = lobe(here, moment, K, UV, limits.used)
    for i in range(len(values)):
        step = STEP * np.eye(len(values))[i]
        up, down = (lobe(line(values + s * step), moment, K, UV, limits.used).slope for s in (1, -1))
        assert np.abs((up - down)[: len(values)] / (2 * STEP) - own.bend[i, : len(values)]).max() < SLOPE_TOLERANCE


def test_slopes_of_the_gain_with_new_currents_agree_with_differences() -> None:
    _, trace, values = scene()
    rigid = limits_of(SHAPED.actuators, False)
    here = trace(values)
    fade = fading(trace, here, rigid.used, rigid.scale)
    with_fade = lobe(here, co_moment(here, UV), K, UV, rigid.used, fade).slope
    without = lobe(here, co_moment(here, UV), K, UV, rigid.used).slope
    for i in range(5):
        step = 1e-3 * np.eye(len(values))[i]
        up, down = (gain_dbi(there, co_moment(there, UV), K, UV) for there in (trace(values + step), trace(values - step)))
        # differences of differences: a hundredth of a dB over a full stroke of 10 mm
        assert abs((up - down) / 2e-3 - with_fade[i]) < 1e-3
    assert np.abs(with_fade - without).max() > 1e-2
