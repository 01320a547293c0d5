"""The files of an analysis of gain, but its report: summary.json, tables, the correction, the deformed surface, patterns, rf.nc."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.io.atomic import write_files
from dishmap.io.csv_table import format_csv
from dishmap.io.cuts_csv import format_cuts_csv
from dishmap.io.grasp_pattern import format_cuts, format_grd
from dishmap.io.results import json_text, sha256_of, versions
from dishmap.io.rf_correction import CORRECTION_FILES, correction_content, correction_files
from dishmap.io.rf_netcdf import Variable, cut_variables, grid_variables, netcdf_bytes
from dishmap.io.rf_surface import regular_fields, surface_files
from dishmap.rf.analysis import RfAnalysis
from dishmap.rf.antenna import Antenna
from dishmap.rf.best_fit import NAMES as FIT_NAMES
from dishmap.rf.shape_field import ShapeField
from dishmap.rf.spread import NAMES as SPREAD_NAMES
from dishmap.rf.state import Reading, State
from dishmap.surface.zernike import term_name

Array = NDArray[np.float64]

SUMMARY_FORMAT = "dishmap-rf/1"
GAIN_COLUMNS = (
    *("state", "frequency_ghz", "gain_dbi", "sigma_gain_dbi", "low95_gain_dbi", "high95_gain_dbi", "loss_db", "ruze_db"),
    *("weighted_half_path_rms_mm", "half_path_rms_mm", "boresight_dbi", "sigma_boresight_dbi", "u", "sigma_u", "v", "sigma_v"),
    *("width_0_deg", "sigma_width_0_deg", "width_90_deg", "sigma_width_90_deg"),
    *("sidelobe_0_db", "sigma_sidelobe_0_db", "sidelobe_90_db", "sigma_sidelobe_90_db", "cross_db"),
    *("spillover", "illumination", "blockage", "phase", "rest", "efficiency"),
)
MODE_COLUMNS = ("state", "frequency_ghz", "n", "m", "name", "half_path_mm", "orientation_deg", "alone_db", "won_back_db")


@dataclass(frozen=True)
class RfProvenance:
    """What an analysis was made from: inputs, what each file is -> its path; seconds: name of a step -> time it took."""

    inputs: Mapping[str, str | Path] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)


def rf_files(analysis: RfAnalysis, provenance: RfProvenance) -> dict[str, str | bytes]:
    """All files of an analysis but its report: name -> content. Raises InputError when an input file cannot be read again."""
    files: dict[str, str | bytes] = {
        "gain.csv": format_csv(GAIN_COLUMNS, gain_table(analysis)),
        "modes.csv": format_csv(MODE_COLUMNS, _modes(analysis)),
        **(correction_files(analysis) if analysis.corrections or analysis.target_beam else {}),
        **surface_files(analysis.state("measured").deformation, analysis.antenna.reflector, analysis.field.places_mm),
    }
    names, cuts = [state.name for state in analysis.states], [[r.cuts for r in state.readings] for state in analysis.states]
    files["cuts.csv"] = format_cuts_csv(names, analysis.options.frequencies_ghz, cuts)
    for state in analysis.states:
        for reading in state.readings:
            files |= _pattern_files(state, reading, analysis.antenna.feed.polarization)
    files["rf.nc"] = _netcdf(analysis)
    return {**files, "summary.json": rf_summary(analysis, provenance)}


def write_rf(folder: str | Path, files: Mapping[str, str | bytes]) -> None:
    """Write the files of an analysis into an existing folder, all or none.

    A correction or patterns that an earlier analysis left there and this one does not have are removed. Raises InputError when a file
    cannot be written.
    """
    write_files(folder, files)
    for old in (*(Path(folder) / name for name in CORRECTION_FILES), *Path(folder).glob("pattern_*GHz.*")):
        if old.name not in files:
            with suppress(FileNotFoundError):
                old.unlink()


def pattern_name(state: str, frequency_ghz: float) -> str:
    """The name of a pattern's file, without its ending."""
    return f"pattern_{state.replace(' ', '_')}_{frequency_ghz:g}GHz"


def _pattern_files(state: State, reading: Reading, polarization: str) -> dict[str, str]:
    name = pattern_name(state.name, reading.frequency_ghz)
    text = f"dishmap, {state.name}, {reading.frequency_ghz:g} GHz"
    return {
        f"{name}.cut": format_cuts(reading.cuts, polarization, text),
        f"{name}.grd": format_grd([reading.grid], [reading.frequency_ghz], polarization),
    }


def gain_table(analysis: RfAnalysis) -> list[dict[str, Any]]:
    """Rows of `gain.csv`: every state at every frequency."""
    design, counting = analysis.states[0].readings, analysis.options.counting
    rows = []
    for state in analysis.states:
        for reading, ideal in zip(state.readings, design, strict=True):
            beam, budget = reading.beam, asdict(reading.budget)
            budget["efficiency"] = budget.pop("total")
            row = {
                "state": state.name,
                "frequency_ghz": reading.frequency_ghz,
                "gain_dbi": beam.gain_dbi,
                "loss_db": getattr(ideal.beam, counting) - getattr(beam, counting),
                "ruze_db": reading.path.ruze_db,
                "weighted_half_path_rms_mm": reading.path.weighted_rms_mm,
                "half_path_rms_mm": reading.path.rms_mm,
                **{name: getattr(beam, name) for name in ("boresight_dbi", "u", "v", "cross_db")},
                **dict(zip(("width_0_deg", "width_90_deg"), beam.width_deg, strict=True)),
                **dict(zip(("sidelobe_0_db", "sidelobe_90_db"), beam.sidelobe_db, strict=True)),
                **budget,
            }
            if reading.spread is not None:
                row |= {f"sigma_{name}": reading.spread.sigma(name) for name in SPREAD_NAMES}
                row["low95_gain_dbi"], row["high95_gain_dbi"] = reading.spread.interval("gain_dbi")
            rows.append(row)
    return rows


def _modes(analysis: RfAnalysis) -> Iterator[dict[str, Any]]:
    for state, by_frequency in analysis.modes.items():
        for frequency, rows in zip(analysis.options.frequencies_ghz, by_frequency, strict=True):
            for row in rows:
                name = term_name(row.n, row.m).removesuffix("_cos")
                values = (state, frequency, row.n, row.m, name, row.amplitude_mm, row.orientation_deg, row.alone_db, row.removed_db)
                yield dict(zip(MODE_COLUMNS, values, strict=True))


def rf_summary(analysis: RfAnalysis, provenance: RfProvenance) -> str:
    """The text of `summary.json`. Raises InputError when an input file cannot be read again."""
    options, known = analysis.options, analysis.field
    fit = analysis.best_fit
    columns = zip(FIT_NAMES, fit.values, fit.sigma, strict=True)
    content: dict[str, Any] = {
        "format": SUMMARY_FORMAT,
        "versions": versions(),
        "inputs": {what: {"path": str(path), "sha256": sha256_of(path)} for what, path in provenance.inputs.items()},
        "antenna": antenna_content(analysis.antenna),
        "quantity": analysis.quantity,
        "options": {name: getattr(options, name) for name in ("frequencies_ghz", "correct", "pointing", "draws", "seed")},
        "shape": {
            "targets": len(known.places_mm),
            "spacing_mm": known.spacing_mm,
            "own_mm": known.own_mm,
            "left_out": list(known.left_out),
            "extrapolated_share": analysis.extrapolated_share,
            "terms": [list(term) for term in known.terms],
            "coefficients_mm": known.mean_mm.tolist(),
            "sigma_mm": np.sqrt((known.factor_mm**2).sum(axis=1)).tolist(),
        },
        "best_fit": {
            **{name: {"value": float(value), "sigma": float(sigma)} for name, value, sigma in columns},
            "half_path_rms_mm": fit.half_path_rms_mm,
            "weighted_half_path_rms_mm": fit.weighted_half_path_rms_mm,
        },
        "states": gain_table(analysis),
        "lost": [asdict(change) for change in analysis.lost],
        "recovered": {name: [asdict(change) for change in changes] for name, changes in analysis.recovered.items()},
        "corrections": correction_content(analysis),
        "modes": list(_modes(analysis)),
        "margins": {name: _plain(asdict(margin)) for name, margin in analysis.margins.items()},
        "seconds": {name: round(value, 3) for name, value in provenance.seconds.items()},
    }
    return json_text(content)


def antenna_content(antenna: Antenna) -> dict[str, Any]:
    """An antenna in JSON; of a tabulated feed only that it is one, the file stands among the inputs."""
    content: dict[str, Any] = {one.name: None if (part := getattr(antenna, one.name)) is None else asdict(part) for one in fields(antenna)}
    content["feed"].pop("table")
    return content


def _netcdf(analysis: RfAnalysis) -> bytes:
    """All arrays: patterns, cuts, gain over frequency, displacement and its sigma over the aperture."""
    names, frequencies, states = [s.name for s in analysis.states], analysis.options.frequencies_ghz, analysis.states
    sweep = Variable(("sweep_ghz",), states[0].sweep_ghz, "GHz", "frequency", True)
    gain = Variable(("state", "sweep_ghz"), np.array([state.sweep_dbi for state in states]), "dB", "gain over isotropic at the beam's peak")
    variables = {
        **grid_variables(names, frequencies, [[r.grid for r in state.readings] for state in states]),
        **cut_variables(names, frequencies, [[r.cuts for r in state.readings] for state in states]),
        "sweep_ghz": sweep,
        "sweep_dbi": gain,
        **regular_fields(analysis.field),
        **_shape_variables(analysis.field),
    }
    return netcdf_bytes(variables, {"title": "dishmap rf", "quantity": analysis.quantity, "pointing": analysis.options.pointing})


def _shape_variables(shape: ShapeField) -> dict[str, Variable]:
    """The Zernike terms of the shape over the aperture's disc, with their whole covariance."""
    orders = np.array(shape.terms, dtype=float)
    return {
        "term_n": Variable(("term",), orders[:, 0], "1", "degree of the Zernike term"),
        "term_m": Variable(("term",), orders[:, 1], "1", "order of the Zernike term, negative for the sine"),
        "coefficient": Variable(("term",), shape.mean_mm, "mm", "displacement along the normal in unnormalised Zernike terms"),
        "coefficient_covariance": Variable(
            ("term", "term_too"), shape.factor_mm @ shape.factor_mm.T, "mm2", "covariance of the coefficients between terms"
        ),
    }


def _plain(value: Any) -> Any:
    """Arrays as lists, also inside mappings."""
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    return value.tolist() if isinstance(value, np.ndarray) else value
