"""Steps within limits against a general solver, and what limits say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from dishmap.rf.antenna import Actuators
from dishmap.rf.correction import correction_of
from dishmap.rf.limits import best_step, limits_of, reached, value_names, whole, within

BENDING = Actuators(shift_mm=(2.0, 1.0, 3.0), tilt_deg=(1.0, 0.5), shape_degree=3, shape_stroke_mm=0.5)
# SLSQP ends within this of the least value; ours is exact
SOLVER = 1e-6


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_the_step_is_the_best_one_within_the_limits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    limits = limits_of(BENDING, True)
    count = len(limits.used)
    values = within(BENDING, whole(limits, rng.normal(size=count) * limits.scale / 4))[limits.used]
    root = rng.normal(size=(count + 2, count + 2))
    bend, slope = root @ root.T + 0.1 * np.eye(count + 2), 20 * rng.normal(size=count + 2)
    scale = np.concatenate([limits.scale, [0.01, 0.01]])
    turned = np.array([0.003, -0.01])
    step = best_step(slope, bend, limits, values, turned, scale, 0.012)

    def cost(d):
        return slope @ d + d @ bend @ d / 2

    rows = [
        {"type": "ineq", "fun": lambda d: limits.stroke_mm - limits.heights @ (values + d[:count] * limits.scale)},
        {"type": "ineq", "fun": lambda d: limits.stroke_mm + limits.heights @ (values + d[:count] * limits.scale)},
        {"type": "ineq", "fun": lambda d: 1 - (values / limits.scale + d[:count])[:5]},
        {"type": "ineq", "fun": lambda d: 1 + (values / limits.scale + d[:count])[:5]},
        {"type": "ineq", "fun": lambda d: 1.2 - np.abs(turned / 0.01 + d[count:])},
    ]
    ours = step / scale
    for row in rows:
        assert row["fun"](ours).min() > -1e-9
    other = minimize(cost, np.zeros(count + 2), jac=lambda d: slope + bend @ d, constraints=rows, method="SLSQP", options={"maxiter": 300})
    assert cost(ours) <= other.fun + SOLVER * max(1.0, abs(other.fun))


def test_a_step_without_limits_is_newtons() -> None:
    limits = limits_of(Actuators(), False)
    bend, slope = np.diag(np.arange(1.0, 6.0)), 1e-3 * np.ones(5)
    step = best_step(slope, bend, limits, np.zeros(5), np.zeros(0), limits.scale, 1.0)
    assert step == pytest.approx(-slope / np.arange(1.0, 6.0) * limits.scale)


def test_actuators_without_a_stroke_do_not_move() -> None:
    limits = limits_of(Actuators(shift_mm=(0.0, 1.0, 2.0), tilt_deg=(0.0, 0.0)), True)
    assert limits.used.tolist() == [1, 2]
    assert whole(limits, np.array([5.0, 6.0])).tolist() == [0.0, 5.0, 6.0, 0.0, 0.0]


def test_values_beyond_their_limits_are_held_to_them_and_named() -> None:
    values = np.array([3.0, -5.0, 1.0, 0.2, -0.5, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    held = within(BENDING, values)
    assert held[:5].tolist() == [2.0, -1.0, 1.0, 0.2, -0.5]
    # defocus alone is highest at the rim and lowest in the middle, by its coefficient
    assert held[6] == pytest.approx(0.5)
    assert reached(BENDING, correction_of(held)) == ("shift_x", "shift_y", "tilt_y", "shape_stroke")
    assert reached(BENDING, correction_of(held * 0.9)) == ()


def test_values_have_names_and_units() -> None:
    names = value_names(BENDING)
    assert names[0] == ("shift_x", "mm")
    assert names[4] == ("tilt_y", "deg")
    assert names[6] == ("shape_defocus", "mm")
    assert len(names) == 5 + 7
