"""correction.json and correction.csv: what the actuators are to do, with the sign convention beside it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.io.csv_table import format_csv
from dishmap.io.results import json_text
from dishmap.rf.analysis import BEAM, RfAnalysis
from dishmap.rf.correct import CorrectionFound
from dishmap.rf.correction import RIGID
from dishmap.rf.target_beam import BeamShaped

Array = NDArray[np.float64]

FORMAT = "dishmap-correction/1"
CORRECTION_FILES = ("correction.json", "correction.csv")
COLUMNS = ("state", "actuator", "value", "sigma", "unit", "stroke", "at_limit")
FRAME = (
    "dish frame: origin at the vertex of the nominal paraboloid, z along the boresight towards the focus, right-handed",
    "turn first: tilt_x, tilt_y is the rotation vector (right-handed) about the subreflector's vertex, or the phase centre of a feed at "
    "the prime focus; then shift_x, shift_y, shift_z, positive along the axes of the dish",
    "shape: unnormalised Zernike terms of the subreflector's height along its own z, over the disc of its rim, positive towards +z",
)


def correction_files(analysis: RfAnalysis) -> dict[str, str]:
    """Both files: name -> text."""
    found_all = correction_content(analysis)
    content = {"format": FORMAT, "convention": list(FRAME), "corrections": found_all}
    rows = [
        {"state": name, "actuator": one["name"], **{key: one[key] for key in ("value", "sigma", "unit", "stroke", "at_limit")}}
        for name, found in found_all.items()
        for one in found["actuators"]
    ]
    return {"correction.json": json_text(content), "correction.csv": format_csv(COLUMNS, rows, (*FRAME, *_before_and_after(analysis)))}


def correction_content(analysis: RfAnalysis) -> dict[str, Any]:
    """Every correction in JSON: its actuators, limits, and gain before and after by frequency; of a target beam its figure."""
    beam = analysis.target_beam
    out: dict[str, Any] = {
        name: {
            "actuators": _actuators(analysis, found, analysis.margins[name].values_sigma),
            "limits": list(found.limits),
            "pointing": found.pointing,
            "frequencies_ghz": list(found.frequencies_ghz),
            "before_dbi": found.before_dbi.tolist(),
            "after_dbi": found.after_dbi.tolist(),
            "check_db": found.check_db.tolist(),
            "lost_share": found.lost_share,
            "improved": bool(found.improved),
            "converged": bool(found.converged),
            "starts": int(found.starts),
            "agreeing": int(found.agreeing),
        }
        for name, found in analysis.corrections.items()
    }
    if beam is not None:
        out[BEAM] = {
            "actuators": _actuators(analysis, beam, np.full(len(beam.names), np.nan)),
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


def _actuators(analysis: RfAnalysis, found: CorrectionFound | BeamShaped, sigmas: Array) -> list[dict[str, Any]]:
    """Value of each actuator, its sigma from the map's covariance (none for a beam), stroke, and whether it is at its limit."""
    moves = analysis.antenna.actuators
    strokes = [*moves.shift_mm, *moves.tilt_deg]
    strokes += [moves.shape_stroke_mm] * (len(found.names) - len(RIGID))
    rows = zip(found.names, found.units, found.correction.values, sigmas, strokes, strict=True)
    return [
        {
            "name": name,
            "value": float(value),
            "sigma": float(sigma) if np.isfinite(sigma) else None,
            "unit": unit,
            "stroke": float(stroke),
            "at_limit": _limit_of(name) in found.limits,
        }
        for name, unit, value, sigma, stroke in rows
    ]


def _limit_of(name: str) -> str:
    return name if name in RIGID else "shape_stroke"


def _before_and_after(analysis: RfAnalysis) -> list[str]:
    """Half-path rms of every state, as lines of a header."""
    return [
        f"{state.name}: illumination-weighted half-path error {reading.path.weighted_rms_mm:.4f} mm rms, "
        f"gain {reading.beam.gain_dbi:.3f} dBi at {reading.frequency_ghz:g} GHz"
        for state in analysis.states
        for reading in state.readings
    ]
