"""The files of an analysis of gain are read back with other readers and hold its figures."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rf_analyses import OFFSET, PRIME, SHAPING, analysis_of, changed

from dishmap.io.grasp_pattern import parse_cuts, parse_grd
from dishmap.io.grasp_surface import parse_grid, parse_points, parse_rim
from dishmap.io.rf_netcdf import parse_netcdf
from dishmap.io.rf_results import RfProvenance, gain_table, rf_files, write_rf
from dishmap.io.rf_surface import deformed_height_mm
from dishmap.rf.antenna import Antenna
from dishmap.rf.deformation import Deformation, displacement, undeformed

# Files of GRASP have 11 digits.
ROUNDING = 1e-9


@pytest.fixture(scope="module")
def files() -> dict[str, str | bytes]:
    return rf_files(analysis_of(SHAPING, (15.0, 20.0)), RfProvenance())


def text_of(files: dict[str, str | bytes], name: str) -> str:
    content = files[name]
    assert isinstance(content, str)
    return content


def rows_of(files: dict[str, str | bytes], name: str) -> list[dict[str, str]]:
    lines = [line for line in text_of(files, name).splitlines() if not line.startswith("#")]
    return list(csv.DictReader(io.StringIO("\n".join(lines))))


def test_which_files(files: dict[str, str | bytes]) -> None:
    tables = {"summary.json", "gain.csv", "modes.csv", "cuts.csv", "rf.nc", "correction.json", "correction.csv"}
    surface = {"surface_deformed.sfc", "points.xyz", "aperture.rim", "surface.tor"}
    states, frequencies = ("design", "measured", "corrected", "shaped"), ("15", "20")
    patterns = {f"pattern_{s}_{f}GHz.{kind}" for s in states for f in frequencies for kind in ("cut", "grd")}
    assert set(files) == tables | surface | patterns
    assert not {"correction.json", "correction.csv"} & set(rf_files(analysis_of(PRIME, correct=False), RfProvenance()))


def test_summary_and_gain_hold_the_record(files: dict[str, str | bytes]) -> None:
    analysis = analysis_of(SHAPING, (15.0, 20.0))
    summary = json.loads(text_of(files, "summary.json"))
    assert summary["format"] == "dishmap-rf/1"
    rows = rows_of(files, "gain.csv")
    assert len(rows) == len(summary["states"]) == 8
    for row, told in zip(rows, summary["states"], strict=True):
        reading = next(r for r in analysis.state(row["state"]).readings if r.frequency_ghz == float(row["frequency_ghz"]))
        assert told["gain_dbi"] == reading.beam.gain_dbi
        assert float(row["gain_dbi"]) == pytest.approx(reading.beam.gain_dbi, rel=1e-8)
        assert float(row["efficiency"]) == pytest.approx(reading.budget.total, rel=1e-8)
        factors = np.prod([float(row[name]) for name in ("spillover", "illumination", "blockage", "phase", "rest")])
        assert factors == pytest.approx(float(row["efficiency"]), rel=1e-6)
        if reading.spread is None:
            assert row["sigma_gain_dbi"] == ""
        else:
            assert float(row["sigma_gain_dbi"]) == pytest.approx(reading.spread.sigma("gain_dbi"), rel=1e-8)
    assert summary["lost"][1]["mean_db"] == -1.25
    assert summary["recovered"]["shaped"][0] == {"mean_db": 0.75, "sigma_db": 0.02, "low_db": 0.71, "high_db": 0.79}
    assert summary["shape"]["coefficients_mm"] == analysis.field.mean_mm.tolist()
    assert summary["antenna"]["subreflector"]["magnification"] == 4.0
    first = rows_of(files, "modes.csv")[0]
    assert (first["name"], float(first["won_back_db"])) == ("defocus", pytest.approx(analysis.modes["measured"][0][0].removed_db, rel=1e-8))


def test_loss_counts_where_the_pointing_says() -> None:
    plain = analysis_of(PRIME, correct=False)
    fixed = changed(plain, options=replace(plain.options, pointing="fixed"))
    for analysis, name in ((plain, "gain_dbi"), (fixed, "boresight_dbi")):
        design, measured = (getattr(state.readings[0].beam, name) for state in analysis.states)
        assert gain_table(analysis)[1]["loss_db"] == design - measured
    assert gain_table(fixed)[1]["loss_db"] > gain_table(plain)[1]["loss_db"]


def test_a_bend_has_no_sigma_in_any_file() -> None:
    plain = analysis_of(SHAPING)
    margin = plain.margins["shaped"]
    unknown = replace(margin, values_sigma=np.full(len(margin.values_sigma), np.nan))
    files = rf_files(changed(plain, margins={**plain.margins, "shaped": unknown}), RfProvenance())
    assert {row["sigma"] for row in rows_of(files, "correction.csv") if row["state"] == "shaped"} == {""}
    assert "NaN" not in text_of(files, "correction.json") + text_of(files, "summary.json")
    assert set(json.loads(text_of(files, "summary.json"))["margins"]["shaped"]["values_sigma"]) == {None}


def test_correction_has_its_sign_convention(files: dict[str, str | bytes]) -> None:
    found = analysis_of(SHAPING, (15.0, 20.0)).corrections
    content = json.loads(text_of(files, "correction.json"))
    assert content["format"] == "dishmap-correction/1"
    for name, one in found.items():
        values = [actuator["value"] for actuator in content["corrections"][name]["actuators"]]
        assert values == one.correction.values.tolist()
        assert content["corrections"][name]["lost_share"] == one.lost_share
        assert [float(row["value"]) for row in rows_of(files, "correction.csv") if row["state"] == name] == pytest.approx(values)
    head = [line for line in text_of(files, "correction.csv").splitlines() if line.startswith("#")]
    assert any("positive along the axes of the dish" in line for line in head)
    assert any("corrected: illumination-weighted half-path error" in line for line in head)
    assert [row["actuator"] for row in rows_of(files, "correction.csv") if row["at_limit"] == "yes"] == ["shift_z", "shift_z"]


@pytest.mark.parametrize("antenna", [SHAPING, OFFSET], ids=["centred", "offset"])
def test_deformed_surface_is_where_its_points_are(antenna: Antenna) -> None:
    analysis = analysis_of(antenna, correct=False)
    files = rf_files(analysis, RfProvenance())
    shape, main = analysis.states[1].deformation, antenna.reflector
    points = parse_points(text_of(files, "points.xyz")).points_mm
    nominal = analysis.field.places_mm
    f = main.focal_length_mm
    normal = np.column_stack([-nominal / (2 * f), np.ones(len(nominal))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    start = np.column_stack([nominal, (nominal**2).sum(axis=1) / (4 * f)])
    assert points == pytest.approx(start + displacement(shape, nominal)[0][:, None] * normal, abs=ROUNDING * f)
    # the grid passes through them: by direct search of the height, and by interpolation in the file
    assert deformed_height_mm(shape, main, points[:, :2]) == pytest.approx(points[:, 2], abs=ROUNDING * f)
    from scipy.interpolate import RectBivariateSpline

    grid = parse_grid(text_of(files, "surface_deformed.sfc"))
    inside = np.linalg.norm(nominal - main.center_mm, axis=1) < 0.8 * main.diameter_mm / 2
    height = RectBivariateSpline(grid.y_mm, grid.x_mm, grid.z_mm)(points[inside, 1], points[inside, 0], grid=False)
    assert height == pytest.approx(points[inside, 2], abs=1e-6)
    rim = parse_rim(text_of(files, "aperture.rim")).points_mm
    assert np.linalg.norm(rim - main.center_mm, axis=1) == pytest.approx(main.diameter_mm / 2)


def test_the_surface_goes_on_beyond_the_aperture_without_growing() -> None:
    shape = Deformation(((8, 0),), np.array([1.0]), np.zeros(2), 150.0)
    corner = np.array([[150.0, 150.0]])
    nominal = deformed_height_mm(undeformed(PRIME.reflector), PRIME.reflector, corner)
    assert abs(deformed_height_mm(shape, PRIME.reflector, corner) - nominal)[0] < 2.0


def test_patterns_read_back(files: dict[str, str | bytes]) -> None:
    reading = analysis_of(SHAPING, (15.0, 20.0)).state("shaped").readings[1]
    cuts = parse_cuts(text_of(files, "pattern_shaped_20GHz.cut"), polarization="right")
    assert [cut.phi_deg for cut in cuts] == [0.0, 45.0, 90.0, 135.0]
    (grid,) = parse_grd(text_of(files, "pattern_shaped_20GHz.grd"), polarization="right")
    size = np.nanmax(np.abs(grid.co))
    assert np.abs(cuts[2].co - reading.cuts[2].co).max() < ROUNDING * size
    assert np.nanmax(np.abs(grid.co - reading.grid.co)) < ROUNDING * size


def test_netcdf_holds_patterns_and_maps(files: dict[str, str | bytes]) -> None:
    analysis = analysis_of(SHAPING, (15.0, 20.0))
    content = files["rf.nc"]
    assert isinstance(content, bytes)
    variables, attributes = parse_netcdf(content)
    assert attributes["quantity"] == "shape"
    assert list(variables["state"].values) == ["design", "measured", "corrected", "shaped"]
    np.testing.assert_array_equal(variables["grid_co"].values[3, 1], analysis.states[3].readings[1].grid.co)
    np.testing.assert_array_equal(variables["sweep_dbi"].values[1], analysis.states[1].sweep_dbi)
    field, moved = analysis.field, variables["displacement_mm"].values
    x, y = (variables[name].values for name in ("x_mm", "y_mm"))
    row, column = 40, 70
    wanted = displacement(analysis.states[1].deformation, np.array([[x[column], y[row]]]))[0]
    assert moved[row, column] == pytest.approx(wanted[0], abs=1e-12)
    assert np.isnan(moved[0, 0])
    assert np.isfinite(moved).sum() == np.isfinite(variables["sigma_displacement_mm"].values).sum()
    # beyond 0.6 of the radius along x there is no target
    assert variables["extrapolated"].values[60, np.argmin(np.abs(x - field.center_mm[0] - 0.9 * field.radius_mm))] == 1


def test_old_corrections_and_patterns_do_not_stay(tmp_path: Path, files: dict[str, str | bytes]) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    write_rf(tmp_path, files)
    fewer = rf_files(analysis_of(PRIME, correct=False), RfProvenance())
    write_rf(tmp_path, fewer)
    assert {path.name for path in tmp_path.iterdir()} == {*fewer, "notes.txt"}
