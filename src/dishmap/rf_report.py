"""The report of an analysis of gain: one HTML page that works offline, and says first what the shape costs and what wins it back.

The same input gives the same page, byte for byte, with the same versions of the libraries that are listed at its end.
"""

from __future__ import annotations

import numpy as np

from dishmap.page import bullet_list, charts, fact_grid, figure, page, paragraph, section, table, verdict_box
from dishmap.plot.rf_antenna import antenna_sides, dish_factor, move_factor
from dishmap.plot.rf_bars import margin_curves, mode_bars
from dishmap.plot.rf_maps import aperture_maps, sigma_field
from dishmap.plot.rf_pattern import gain_curves, pattern_cuts, pattern_maps
from dishmap.report import inputs_section
from dishmap.rf.analysis import BEAM, MEASURED, SHAPED, RfAnalysis
from dishmap.rf.aperture import spread_evenly
from dishmap.rf.deformation import displacement
from dishmap.rf.shape_field import extrapolated, sigma_at
from dishmap.rf.state import Reading
from dishmap.rf_assumptions import NOT_MODELLED, assumptions
from dishmap.rf_tables import beam_rows, best_fit_rows, budget_rows, by_order, correction_rows, dear_modes, gain_rows, mode_label, mode_rows
from dishmap.rf_verdict import QUANTITIES, beam_words, highest, light_words, rf_verdict, target_sigma_mm, what_moves
from dishmap.verdict import number

# The displacement and its sigma are drawn from so many places.
PLACES = 3000
# Modes beyond these are in modes.csv.
MOST_MODES = 14
# Degrees of phase for each wavelength of path, twice since the error is half the path.
PHASE_DEG = 720.0


def rf_report(analysis: RfAnalysis, title: str, inputs: dict[str, str]) -> str:
    """The report of an analysis as one HTML page.

    title: the page's heading; inputs: what the analysis was made from, by name, listed at its end.
    """
    verdict = rf_verdict(analysis)
    body = [
        verdict_box(verdict.headline, bool(verdict.warnings)),
        fact_grid((fact.name, fact.value, fact.detail) for fact in verdict.facts),
        section("What to know", bullet_list(verdict.warnings)) if verdict.warnings else "",
        _gain(analysis),
        _correction(analysis),
        _target_beam(analysis),
        _modes(analysis),
        _margin(analysis),
        _surface(analysis),
        _paths(analysis),
        *(_pattern(analysis, place) for place in range(len(analysis.states[0].readings))),
        section("What was assumed", bullet_list(assumptions(analysis))),
        section("What is not modelled", bullet_list(NOT_MODELLED)),
        inputs_section(inputs),
    ]
    return page(title, body)


def _gain(analysis: RfAnalysis) -> str:
    curve = figure(
        gain_curves(analysis.states),
        "Gain at the beam's peak against frequency, of the best estimate of the surface. Dots and bars: at the frequencies asked for, "
        "with the "
        "middle 95 % of surfaces drawn from the map.",
        "Curves of gain against frequency.",
    )
    about = paragraph(
        "Values of the best estimate of the surface ± one standard deviation, that of surfaces drawn from the map; the design has none. "
        "Loss: "
        "against the design. Ruze: 685.81 (ε/λ)² dB with ε the illumination-weighted rms half-path error at the beam's peak, as a "
        "cross-check."
    )
    beams = paragraph(
        "u, v: direction cosines of the peak, sin θ cos φ and sin θ sin φ. Widths: full, at half power. Sidelobes: the higher of the "
        "first ones on "
        "either side, below the peak. Cross-polar: the largest near the beam, below the peak (Ludwig's third definition)."
    )
    parts = paragraph(
        "Efficiency is gain over (π D/λ)². Spillover: power that meets the dish; illumination: evenness of the field over the aperture; "
        "blockage: what shadows leave; phase: what path errors leave at the beam's peak; rest: polarisation and what is not so simple."
    )
    tables = [about, table(*gain_rows(analysis)), "<h3>Beam</h3>", beams, table(*beam_rows(analysis))]
    return section("Gain", *tables, "<h3>Efficiency</h3>", parts, table(*budget_rows(analysis)), curve)


def _correction(analysis: RfAnalysis) -> str:
    # what moves is drawn as corrected; where only a beam was asked for, as that beam has it
    beams = [] if analysis.target_beam is None else [BEAM]
    last = analysis.state([MEASURED, *(analysis.corrections or beams)][-1])
    dish, moved = dish_factor(analysis.antenna, last.deformation), move_factor(analysis.antenna, last.correction)
    who = what_moves(analysis)
    caption = "The antenna along x and along y, sections through the middle of the aperture, projected; rays as designed."
    caption += f" Deformation of the dish drawn {dish:g} times enlarged." if dish else ""
    larger = "" if moved == 1 else f", motion drawn {moved:g} times enlarged"
    caption += f" Blue: the {who} in the state `{last.name}`{larger}." if moved else ""
    sides = figure(antenna_sides(analysis.antenna, last.deformation, last.correction), caption, "The antenna from its two sides.")
    about = (
        f"Shift of the {who} in dish axes, after a turn (rotation vector about x and y, right-handed) about its "
        f"{'vertex' if analysis.antenna.subreflector else 'phase centre'}."
    )
    if any(np.any(found.correction.shape_mm) for found in analysis.corrections.values()):
        about += (
            " Shape: unnormalised Zernike terms of its height along z, over its rim's disc. Values of a bend have no sigma: many bends are "
            "nearly as good, and another map leads to another of them."
        )
    parts = []
    for name, found in analysis.corrections.items():
        told = f" {found.starts} starts, {found.agreeing} of which ended at this one." if found.starts > 1 else ""
        parts += [
            f"<h3>{'Rigid pose' if name == 'corrected' else 'Pose and shape'}</h3>",
            table(*correction_rows(analysis, name), (0, 1, 4)),
            paragraph(light_words(found.lost_share) + told),
        ]
    return section("Correction" if analysis.corrections else "Antenna", sides, paragraph(about) if parts else "", *parts)


def _target_beam(analysis: RfAnalysis) -> str:
    """What was asked of the beam and what came of it."""
    beam = analysis.target_beam
    if beam is None:
        return ""
    words = paragraph(beam_words(analysis))
    rows = table(*correction_rows(analysis, BEAM), (0, 1, 4))
    return section("Target beam", words, rows)


def _modes(analysis: RfAnalysis) -> str:
    if not analysis.modes:
        return ""
    frequencies, top = analysis.options.frequencies_ghz, highest(analysis)
    names = list(analysis.modes)
    first = dear_modes(analysis, top, MOST_MODES)
    removed = np.array([[by_order(analysis, name, top)[mode.n, mode.m].removed_db for mode in first] for name in names])
    chart = figure(
        mode_bars([mode_label(mode.n, mode.m) for mode in first], names, removed),
        f"What removing each mode of the half-path error would win back at {frequencies[top]:g} GHz, pointed anew, the dearest first.",
        "Bars of dB lost to each mode.",
    )
    about = paragraph(
        "Modes of the half-path error, weighed by the illumination: Zernike terms (n, m) with the sine and cosine term of one order "
        "together. Size: "
        "at the rim. Towards: azimuth of the first maximum, from x towards y. Alone: what the mode would cost if it were the only one. "
        "Won back: what "
        "removing it would win now; negative where it partly undoes others."
    )
    tables = []
    for place, frequency in enumerate(frequencies):
        tables += [f"<h3>{frequency:g} GHz</h3>", table(*mode_rows(analysis, place, MOST_MODES), (0,))]
    return section("Modes by what they cost", chart, about, *tables)


def _margin(analysis: RfAnalysis) -> str:
    if not analysis.margins:
        return ""
    curves = {name: (margin.sigma_mm, margin.mean_db.mean(axis=1)) for name, margin in analysis.margins.items()}
    rough = " That of a bend is rough: many bends are nearly as good, and the one found is not the very best." if SHAPED in curves else ""
    chart = figure(
        margin_curves(curves, target_sigma_mm(analysis)),
        "What a correction leaves on the table because it was made from a map with this much noise of each target: mean over maps and "
        "over the "
        f"frequencies asked for. Dashed: the median sigma of this map at its targets.{rough}",
        "Curves of gain left against the noise of the map.",
    )
    return section("How good must the map be?", chart)


def _surface(analysis: RfAnalysis) -> str:
    measured, field = analysis.states[1], analysis.field
    xy = spread_evenly(PLACES, field.center_mm, field.radius_mm)
    value, _ = displacement(measured.deformation, xy)
    sigma, beyond = sigma_at(field, xy), extrapolated(field, xy)
    far = " Hatched: extrapolated, farther from any target than their spacing allows." if beyond.any() else ""
    moved = figure(
        aperture_maps([xy], [value], [""], field.center_mm, field.radius_mm, "displacement (mm)"),
        f"Displacement along the nominal normal, positive towards the focus: {QUANTITIES[analysis.quantity]}.",
        f"Map of the displacement, {number(float(np.sqrt(np.mean(value**2))))} mm rms.",
    )
    unsure = figure(
        sigma_field(xy, sigma, beyond, field.places_mm, field.center_mm, field.radius_mm, "sigma of the displacement (mm)"),
        f"Sigma of the displacement; dots: the targets.{far}",
        "Map of the sigma of the displacement.",
    )
    fit = analysis.best_fit
    rest = figure(
        aperture_maps([fit.xy_mm], [fit.residual_mm], [""], field.center_mm, field.radius_mm, "from the best fit (mm)"),
        f"Distance of the surface from the best-fit paraboloid, along the normal: half-path {number(fit.half_path_rms_mm)} mm rms, "
        f"{number(fit.weighted_half_path_rms_mm)} mm with the illumination.",
        "Map of the residuals to the best-fit paraboloid.",
    )
    about = paragraph("The paraboloid that fits the deformed dish best, half-path errors weighed by the illumination.")
    return section(
        "Surface", charts(moved, unsure), "<h3>Best-fit paraboloid</h3>", about, charts(table(*best_fit_rows(analysis), (0,)), rest)
    )


def _paths(analysis: RfAnalysis) -> str:
    """Half-path errors before and after; the places of states differ, the scale of colours does not."""
    readings = [state.readings[0] for state in analysis.states[1:]]
    names = [
        f"{state.name}: {number(reading.path.weighted_rms_mm)} mm rms" for state, reading in zip(analysis.states[1:], readings, strict=True)
    ]
    chart = figure(
        aperture_maps(*_fields(readings, [1.0] * len(readings)), names, *_disc(analysis), "half-path error (mm)"),
        "Half of what the path from the feed over the dish to the beam's peak is too short, piston and pointing taken out; rms with the "
        "illumination. Unwrapped: from the geometry, not from phases.",
        "Maps of the half-path error before and after.",
    )
    return section("Path error over the aperture", chart)


def _pattern(analysis: RfAnalysis, place: int) -> str:
    readings = [state.readings[place] for state in analysis.states]
    names = [state.name for state in analysis.states]
    frequency = readings[0].frequency_ghz
    scales = [PHASE_DEG / reading.wavelength_mm for reading in readings[1:]]
    phase = figure(
        aperture_maps(*_fields(readings[1:], scales), names[1:], *_disc(analysis), "aperture phase (°)"),
        "Phase over the aperture towards the beam's peak, piston and pointing taken out; positive where the path is too short.",
        "Maps of the aperture phase.",
    )
    cuts = figure(
        pattern_cuts(readings, names, 1),
        "Cuts through the boresight, co-polar, of the best estimate of the surface; dotted: cross-polar (Ludwig's third definition).",
        "Cuts of the pattern.",
    )
    maps = figure(
        pattern_maps(readings, names),
        "Co-polar gain over direction cosines in the dish frame; crosses: the beam's peak.",
        "Maps of the pattern.",
    )
    return section(f"Phase and pattern at {frequency:g} GHz", phase, cuts, maps)


def _fields(readings: list[Reading], scale: list[float]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    return [r.path.xy_mm for r in readings], [k * r.path.half_path_mm for r, k in zip(readings, scale, strict=True)]


def _disc(analysis: RfAnalysis) -> tuple[np.ndarray, float]:
    main = analysis.antenna.reflector
    return main.center_mm, main.diameter_mm / 2
