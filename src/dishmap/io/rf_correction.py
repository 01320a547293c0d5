"""correction.json and correction.csv: what the actuators are to do, with the sign convention beside it."""

from __future__ import annotations

from typing import Any

from dishmap.io.csv_table import format_csv
from dishmap.io.results import json_text
from dishmap.rf.analysis import BEAM, RfAnalysis
from dishmap.rf.correction import RIGID, Correction

FORMAT = "dishmap-correction/1"
CORRECTION_FILES = ("correction.json", "correction.csv")
COLUMNS = ("state", "actuator", "value", "unit", "stroke", "at_limit")
FRAME = (
    "dish frame: origin at the vertex of the nominal paraboloid, z along the boresight towards the focus, right-handed",
    "turn first: tilt_x, tilt_y is the rotation vector (right-handed) about the subreflector's vertex, or the phase centre of a feed at "
    "the "
    "prime focus; then shift_x, shift_y, shift_z, positive along the axes of the dish",
    "shape: unnormalised Zernike terms of the subreflector's height along its own z, over the disc of its rim, positive towards +z",
)


def correction_files(analysis: RfAnalysis) -> dict[str, str]:
    """Both files: name -> text."""
    found_all = correction_content(analysis)
    content = {"format": FORMAT, "convention": list(FRAME), "corrections": found_all}
    rows = [
        {"state": name, "actuator": one["name"], **{key: one[key] for key in ("value", "unit", "stroke", "at_limit")}}
        for name, found in found_all.items()
        for one in found["actuators"]
    ]
    return {"correction.json": json_text(content), "correction.csv": format_csv(COLUMNS, rows, (*FRAME, *_before_and_after(analysis)))}


def correction_content(analysis: RfAnalysis) -> dict[str, Any]:
    """Every correction in JSON: its actuators, limits, and gain before and after by frequency; of a target beam its figure."""
    beam = analysis.target_beam
    out: dict[str, Any] = {
        name: {
            "actuators": _actuators(analysis, found.names, found.units, found.correction, found.limits),
            "limits": list(found.limits),
            "pointing": found.pointing,
            "frequencies_ghz": list(found.frequencies_ghz),
            "before_dbi": found.before_dbi.tolist(),
            "after_dbi": found.after_dbi.tolist(),
            "check_db": found.check_db.tolist(),
            "improved": bool(found.improved),
            "converged": bool(found.converged),
            "starts": int(found.starts),
            "agreeing": int(found.agreeing),
        }
        for name, found in analysis.corrections.items()
    }
    if beam is not None:
        out[BEAM] = {
            "actuators": _actuators(analysis, beam.names, beam.units, beam.correction, beam.limits),
            "limits": list(beam.limits),
            "frequency_ghz": beam.frequency_ghz,
            "before_db": beam.before_db,
            "after_db": beam.after_db,
            "bound_dbi": beam.bound_dbi,
            "met": bool(beam.met),
            "converged": bool(beam.converged),
            "starts": int(beam.starts),
        }
    return out


def _actuators(
    analysis: RfAnalysis, names: tuple[str, ...], units: tuple[str, ...], correction: Correction, limits: tuple[str, ...]
) -> list[dict[str, Any]]:
    moves = analysis.antenna.actuators
    strokes = [*moves.shift_mm, *moves.tilt_deg]
    strokes += [moves.shape_stroke_mm] * (len(names) - len(RIGID))
    return [
        {"name": name, "value": float(value), "unit": unit, "stroke": float(stroke), "at_limit": _limit_of(name) in limits}
        for name, unit, value, stroke in zip(names, units, correction.values, strokes, strict=True)
    ]


def _limit_of(name: str) -> str:
    return name if name in RIGID else "shape_stroke"


def _before_and_after(analysis: RfAnalysis) -> list[str]:
    """Half-path rms of every state, as lines of a header."""
    return [
        f"{state.name}: illumination-weighted half-path error {reading.path.weighted_rms_mm:.4f} mm rms, gain "
        f"{reading.beam.gain_dbi:.3f} dBi "
        f"at {reading.frequency_ghz:g} GHz"
        for state in analysis.states
        for reading in state.readings
    ]
