"""Tables of an analysis of gain, as heads and rows of ready texts: for its report and for the terminal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dishmap.difference_verdict import with_sigma
from dishmap.rf.analysis import BEAM, DESIGN, RfAnalysis
from dishmap.rf.best_fit import NAMES
from dishmap.rf.correct import CorrectionFound
from dishmap.rf.correction import bent_degree, shape_terms
from dishmap.rf.gain import Budget
from dishmap.rf.limits import farthest_mm
from dishmap.rf.modes import Mode
from dishmap.rf.pattern import decibels
from dishmap.rf.state import Reading, State
from dishmap.rf.target_beam import BeamShaped
from dishmap.rf_verdict import gain_of, loss_of
from dishmap.surface.zernike import term_name

Array = NDArray[np.float64]
Table = tuple[list[str], list[list[str]]]

NONE = "-"
DB_DECIMALS, DEG_DECIMALS, MM_DECIMALS = 3, 4, 4
# Modes that cost less are not told.
LEAST_DB = 5e-4
# Sigmas of actuators below this, in mm or degrees, are rounding.
LEAST_SIGMA = 1e-7
# Cross-polar fields below this are rounding.
NO_CROSS_DB = -150.0
PARTS = ("spillover", "illumination", "blockage", "phase", "rest", "total")
FIT_NAMES = {
    "vertex_x_mm": "vertex x (mm)",
    "vertex_y_mm": "vertex y (mm)",
    "vertex_z_mm": "vertex z (mm)",
    "axis_x_deg": "turn of the axis about x (°)",
    "axis_y_deg": "turn of the axis about y (°)",
    "focal_length_mm": "focal length (mm)",
}


def brief_rows(analysis: RfAnalysis) -> Table:
    """A row for each frequency and state, as a terminal can hold it."""
    heads = ["GHz", "state", "gain dBi", "loss dB", "Ruze dB", "off boresight deg", "width deg", "sidelobes dB"]
    rows = []
    for place, state, reading in each_reading(analysis):
        beam = reading.beam
        widths = " x ".join(_plain(width, np.nan, 3) for width in beam.width_deg)
        lobes = ", ".join(_plain(lobe, np.nan, 1) for lobe in beam.sidelobe_db)
        rows.append([*_gain_cells(analysis, place, state, reading), f"{off_boresight_deg(reading):.3f}", widths, lobes])
    return heads, rows


def gain_rows(analysis: RfAnalysis) -> Table:
    """A row for each frequency and state: gain, loss with Ruze's estimate beside, and the path error behind them."""
    heads = [
        "GHz",
        "state",
        "gain (dBi)",
        "loss (dB)",
        "Ruze (dB)",
        "on the boresight (dBi)",
        "half-path error, rms (mm)",
        "unweighted (mm)",
    ]
    rows = []
    for place, state, reading in each_reading(analysis):
        path, sigma = reading.path, float("nan") if reading.spread is None else reading.spread.sigma("boresight_dbi")
        rms_sigma = float("nan") if reading.spread is None else reading.spread.sigma("weighted_rms_mm")
        rows.append(
            [
                *_gain_cells(analysis, place, state, reading),
                _plain(reading.beam.boresight_dbi, sigma, DB_DECIMALS),
                _plain(path.weighted_rms_mm, rms_sigma, MM_DECIMALS),
                f"{path.rms_mm:.{MM_DECIMALS}f}",
            ]
        )
    return heads, rows


def beam_rows(analysis: RfAnalysis) -> Table:
    """A row for each frequency and state: direction, widths and sidelobes of the main beam."""
    heads = ["GHz", "state", "u (1e-3)", "v (1e-3)", "off boresight (°)", "width φ 0° (°)", "width φ 90° (°)"]
    heads += ["sidelobe φ 0° (dB)", "sidelobe φ 90° (dB)", "cross-polar (dB)"]
    rows = []
    for _, state, reading in each_reading(analysis):
        beam = reading.beam
        values = (1e3 * beam.u, 1e3 * beam.v, *beam.width_deg, *beam.sidelobe_db)
        names = ("u", "v", "width_0_deg", "width_90_deg", "sidelobe_0_db", "sidelobe_90_db")
        decimals = (2, 2, DEG_DECIMALS, DEG_DECIMALS, 2, 2)
        sigma = [float("nan") if reading.spread is None else reading.spread.sigma(name) for name in names]
        sigma[:2] = [1e3 * one for one in sigma[:2]]
        cells = [_plain(*one) for one in zip(values, sigma, decimals, strict=True)]
        cells.insert(2, f"{off_boresight_deg(reading):.{DEG_DECIMALS}f}")
        cross = f"{beam.cross_db:.1f}" if beam.cross_db > NO_CROSS_DB else "none"
        rows.append([f"{reading.frequency_ghz:g}", state.name, *cells, cross])
    return heads, rows


def _gain_cells(analysis: RfAnalysis, place: int, state: State, reading: Reading) -> list[str]:
    """Frequency, state, gain, loss and Ruze's estimate; the design has no loss."""
    cells = [f"{reading.frequency_ghz:g}", state.name, _plain(*gain_of(analysis, reading), DB_DECIMALS)]
    if state.name == DESIGN:
        return [*cells, NONE, NONE]
    return [*cells, _plain(*loss_of(analysis, state, place), DB_DECIMALS), f"{reading.path.ruze_db:.{DB_DECIMALS}f}"]


def budget_rows(analysis: RfAnalysis) -> Table:
    """The factors of the efficiency of every state, in percent with their dB."""
    heads = ["GHz", "state", *PARTS]
    rows = [
        [f"{reading.frequency_ghz:g}", state.name, *(_share(reading.budget, part) for part in PARTS)]
        for _, state, reading in each_reading(analysis)
    ]
    return heads, rows


def best_fit_rows(analysis: RfAnalysis) -> Table:
    """The best-fit paraboloid and how it differs from the nominal one."""
    fit = analysis.best_fit
    nominal = [0.0, 0.0, 0.0, 0.0, 0.0, analysis.antenna.reflector.focal_length_mm]
    rows = [
        [FIT_NAMES[name], f"{usual:g}", with_sigma(float(value), float(sigma), "")]
        for name, usual, value, sigma in zip(NAMES, nominal, fit.values, fit.sigma, strict=True)
    ]
    return ["", "nominal", "best fit"], rows


def term_label(term: tuple[int, int]) -> str:
    """`astigmatism cos (2, 2)`, `term (8, 8)` for one without a name."""
    name = term_name(*term)
    return f"{'term' if name.startswith('z_') else name.replace('_', ' ')} ({term[0]}, {term[1]})"


def mode_label(n: int, m: int) -> str:
    """`astigmatism (2, 2)`, whatever its orientation."""
    return term_label((n, m)).replace(" cos (", " (")


def by_order(analysis: RfAnalysis, state: str, place: int) -> dict[tuple[int, int], Mode]:
    """The modes of a state at the frequency at `place`, by degree and order."""
    return {(mode.n, mode.m): mode for mode in analysis.modes[state][place]}


def dear_modes(analysis: RfAnalysis, place: int, most: int) -> list[Mode]:
    """Modes of the first state that cost LEAST_DB or more in any state at the frequency at `place`, at least one; up to `most`."""
    names = list(analysis.modes)
    first = analysis.modes[names[0]][place]
    others = [by_order(analysis, name, place) for name in names]
    costs = [max(max(abs(rows[m.n, m.m].removed_db), abs(rows[m.n, m.m].alone_db)) for rows in others) for m in first]
    return ([mode for mode, cost in zip(first, costs, strict=True) if cost >= LEAST_DB] or list(first[:1]))[:most]


def mode_rows(analysis: RfAnalysis, place: int, most: int) -> Table:
    """The modes that cost most in the measured state at the frequency at `place`, with what is left of them in the others."""
    names = list(analysis.modes)
    heads = ["mode (n, m)"]
    for name in names:
        # what each costs alone is told of the first state only: a page is no wider
        heads += [f"{name}: size (mm)", "towards (°)", *(["alone (dB)"] if name == names[0] else []), "won back (dB)"]
    rows = []
    for first in dear_modes(analysis, place, most):
        cells = [mode_label(first.n, first.m)]
        for name in names:
            mode = by_order(analysis, name, place)[first.n, first.m]
            cells += [_plain(mode.amplitude_mm, float("nan"), MM_DECIMALS), f"{round(mode.orientation_deg) + 0}" if mode.m else NONE]
            costs = (mode.alone_db, mode.removed_db) if name == names[0] else (mode.removed_db,)
            cells += [_plain(value, float("nan"), DB_DECIMALS) for value in costs]
        rows.append(cells)
    return heads, rows


def commands_of(analysis: RfAnalysis) -> dict[str, CorrectionFound | BeamShaped]:
    """Everything that the actuators may be told, by the state it makes."""
    beam = analysis.target_beam
    return {**analysis.corrections, **({} if beam is None else {BEAM: beam})}


def values_sigma(analysis: RfAnalysis, name: str) -> Array:
    """What the map's covariance does to the actuators' values of a correction; 0 where that is not known, as for a beam."""
    margin = analysis.margins.get(name)
    return np.zeros(len(commands_of(analysis)[name].names)) if margin is None else margin.values_sigma


def correction_rows(analysis: RfAnalysis, name: str) -> Table:
    """The actuators' values of a correction, or of a beam that is made with them, with sigmas from the map, and their strokes."""
    found, moves = commands_of(analysis)[name], analysis.antenna.actuators
    strokes = [*moves.shift_mm, *moves.tilt_deg]
    sigmas = values_sigma(analysis, name)
    rows = []
    for value_name, unit, value, sigma, stroke in zip(found.names, found.units, found.correction.values, sigmas, strokes, strict=False):
        at = "at its limit" if value_name in found.limits else ""
        told = _with_sigma(value, sigma)
        rows.append([value_name.replace("_", " "), unit, told, f"± {stroke:g}" if stroke else "fixed", at])
    degree = bent_degree(moves, found.correction)
    if degree:
        for term, value, sigma in zip(shape_terms(moves), found.correction.shape_mm, sigmas[len(strokes) :], strict=True):
            if term[0] <= degree:
                rows.append([f"shape, {term_label(term)}", "mm", _with_sigma(value, sigma), "", ""])
        if degree < moves.shape_degree:
            rows.append([f"shape, above degree {degree}", "mm", "not used", "", ""])
        farthest, at = farthest_mm(moves, found.correction.shape_mm), "at its limit" if "shape_stroke" in found.limits else ""
        rows.append(["shape, farthest point", "mm", f"{farthest:.{MM_DECIMALS}f}", f"± {moves.shape_stroke_mm:g}", at])
    return ["actuator", "unit", "value", "stroke", ""], rows


def each_reading(analysis: RfAnalysis) -> list[tuple[int, State, Reading]]:
    """Frequencies one after the other, with all states of each."""
    count = len(analysis.states[0].readings)
    return [(place, state, state.readings[place]) for place in range(count) for state in analysis.states]


def off_boresight_deg(reading: Reading) -> float:
    """Angle between the beam's peak and the boresight."""
    return float(np.degrees(np.arcsin(np.hypot(reading.beam.u, reading.beam.v))))


def _signed(value: float) -> str:
    # + 0.0 turns what rounds to minus zero into zero
    return f"{round(float(value), MM_DECIMALS) + 0.0:+.{MM_DECIMALS}f}"


def _with_sigma(value: float, sigma: float) -> str:
    # the tilt of a feed at the prime focus changes its light, not paths: the map says nothing of it
    return with_sigma(float(value), float(sigma), "", sign=True) if sigma > LEAST_SIGMA else _signed(value)


def _plain(value: float, sigma: float, decimals: int) -> str:
    if not np.isfinite(value):
        return NONE
    return with_sigma(value, sigma, "") if np.isfinite(sigma) and sigma > 0 else f"{round(value, decimals) + 0.0:.{decimals}f}"


def _share(budget: Budget, part: str) -> str:
    value = float(getattr(budget, part))
    return f"{100 * value:.2f} % ({round(float(decibels(np.array(value))), DB_DECIMALS) + 0.0:+.{DB_DECIMALS}f} dB)"
