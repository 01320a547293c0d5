"""Records of analyses of gain for the tests of what is said, drawn and written of them: a real dish of 300 mm, corrections by hand."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from dishmap.rf.analysis import Change, RfAnalysis, RfOptions
from dishmap.rf.antenna import Actuators, Antenna, Feed, Reflector, Subreflector
from dishmap.rf.best_fit import best_fit
from dishmap.rf.correct import CorrectionFound
from dishmap.rf.correction import correction_of, no_correction
from dishmap.rf.deformation import undeformed
from dishmap.rf.limits import value_names
from dishmap.rf.margin import Margin
from dishmap.rf.modes import modes_of
from dishmap.rf.shape_field import ShapeField, deformation_of, draws
from dishmap.rf.sources import sampled, sources
from dishmap.rf.state import antenna_state

PRIME = Antenna(Reflector(300.0, 150.0), Feed("gaussian", 12.0))
SHAPING = Antenna(
    Reflector(300.0, 150.0),
    Feed("gaussian", 12.0, polarization="right"),
    Subreflector("cassegrain", 110.0, 4.0),
    actuators=Actuators(shift_mm=(2.0, 2.0, 2.0), shape_degree=2, shape_stroke_mm=1.0),
)
OFFSET = Antenna(Reflector(300.0, 200.0, 190.0), Feed("gaussian", 12.0))
TERMS = ((2, -2), (2, 0), (2, 2), (3, 1))
SIZES_MM = np.array([0.05, 0.4, 0.3, 0.1])
SIGMA_MM = 0.01


def field_of(antenna: Antenna) -> ShapeField:
    """A dish with defocus, astigmatism and coma, each known to SIGMA_MM, from targets all over it but a part of the rim."""
    radius, center = antenna.reflector.diameter_mm / 2, antenna.reflector.center_mm
    side = np.linspace(-radius, radius, 15)
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    places = center + places[(np.hypot(*places.T) < 0.95 * radius) & (places[:, 0] < 0.6 * radius)]
    return ShapeField(
        terms=TERMS,
        mean_mm=SIZES_MM,
        factor_mm=SIGMA_MM * np.eye(len(TERMS)),
        center_mm=center,
        radius_mm=radius,
        places_mm=places,
        spacing_mm=float(side[1] - side[0]),
        response=np.zeros((len(TERMS), len(places))),
        own_mm=0.0,
        left_out=(),
    )


@cache
def analysis_of(antenna: Antenna, frequencies_ghz: tuple[float, ...] = (20.0,), correct: bool = True) -> RfAnalysis:
    """An analysis whose corrections were not sought but made up; everything else is as `analyse` makes it."""
    if not correct:
        whole = analysis_of(antenna, frequencies_ghz)
        modes = {"measured": whole.modes["measured"]}
        return replace(whole, states=whole.states[:2], modes=modes, corrections={}, recovered={}, margins={})
    field, still = field_of(antenna), no_correction(antenna)
    shape, drawn = deformation_of(field), draws(field, np.random.default_rng(3), 20)
    states = [
        antenna_state("design", antenna, undeformed(antenna.reflector), still, frequencies_ghz),
        antenna_state("measured", antenna, shape, still, frequencies_ghz, drawn),
    ]
    values = still.values
    values[:5] = [0.1, -0.05, 0.3, 0.2, -0.1]
    names = ["corrected", "shaped"][: 1 + bool(antenna.actuators.shape_degree)]
    corrections = {}
    for name in names:
        moved = correction_of(values + 0.02 * (np.arange(len(values)) > 4) * (name == "shaped"))
        states.append(antenna_state(name, antenna, shape, moved, frequencies_ghz, drawn))
        corrections[name] = _found(antenna, moved.values, frequencies_ghz)
    currents = sources(antenna, shape, still, sampled(antenna, shape, 15.0))
    radius = antenna.reflector.diameter_mm / 2
    count = len(frequencies_ghz)
    sigmas = np.array([0.01, 0.1])
    loss = np.tile(sigmas[:, None] ** 2, (1, count))
    return RfAnalysis(
        antenna=antenna,
        field=field,
        quantity="shape",
        options=RfOptions(frequencies_ghz, True, draws=20),
        best_fit=best_fit(antenna, shape, currents, field.factor_mm),
        states=tuple(states),
        modes={
            state.name: tuple(
                modes_of((r.path.xy_mm - field.center_mm) / radius, r.path.half_path_mm, r.path.weight, r.wavelength_mm)
                for r in state.readings
            )
            for state in states[1:]
        },
        corrections=corrections,
        lost=(Change(-1.25, 0.03, -1.31, -1.19),) * count,
        recovered={name: (Change(0.75, 0.02, 0.71, 0.79),) * count for name in names},
        margins={
            name: Margin(sigmas, frequencies_ghz, loss, 2 * loss, sigmas < 0.05, np.full(len(corrections[name].names), 0.004))
            for name in names
        },
        target_beam=None,
        extrapolated_share=0.12,
    )


def _found(antenna: Antenna, values: Any, frequencies_ghz: tuple[float, ...]) -> CorrectionFound:
    count = len(frequencies_ghz)
    names, units = zip(*value_names(antenna.actuators), strict=True)
    return CorrectionFound(
        correction=correction_of(values),
        names=names,
        units=units,
        pointing="free",
        frequencies_ghz=frequencies_ghz,
        before_dbi=np.full(count, 33.0),
        before_uv=np.zeros((count, 2)),
        after_dbi=np.full(count, 33.75),
        after_uv=np.zeros((count, 2)),
        check_db=np.zeros(count),
        limits=("shift_z",),
        converged=True,
        starts=5,
        agreeing=4,
        spread_db=0.2,
        improved=True,
        lost_share=0.004,
    )


def changed(analysis: RfAnalysis, **changes: Any) -> RfAnalysis:
    """The same analysis with other fields."""
    return replace(analysis, **changes)
