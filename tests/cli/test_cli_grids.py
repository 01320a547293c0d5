"""Grids from the command line: photographs of a printed grid become maps, differences and reports, as those of circles do."""

from __future__ import annotations

import csv
import html
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_words import dishmap, refused
from click.testing import Result

from dishmap.errors import InputError
from dishmap.io.camera_file import read_camera
from dishmap.io.images import read_gray
from dishmap.io.pattern_file import read_pattern, write_pattern
from dishmap.pipeline import Map, map_photograph
from dishmap.plot.outlines import outlines_of, unused_outlines
from dishmap.targets.grid_builders import grid
from dishmap.targets.identify import Upright
from dishmap.targets.track import track_targets
from dishmap.verdict import numbers_of, side_warning

SCENARIO = """
format = "dishmap-scenario/1"
seed = 3
pattern.grid = { columns = 12, rows = 9, pitch_mm = 12, square_mm = 5, surface = "plane" }
camera = { width_px = 640, height_px = 480, focal_px = 700, distortion = [-0.1, 0.02, 0.0, 0.0, 0.0] }
pose = { distance_mm = 220, tilt_deg = 8, tilt_direction_deg = 30 }
sensor = { noise_grey = 1.0, psf_sigma_px = 0.7 }
states = [{ name = "ref" }, { name = "still" }, { name = "bent", zernike = [{ term = "astigmatism_cos", size_mm = 0.3 }] }]
"""
TUBE = SCENARIO.replace('square_mm = 5, surface = "plane"', 'line_mm = 1, surface = "cylinder", cylinder_radius_mm = 70').replace(
    "tilt_deg = 8", "tilt_deg = 15"
)
TUBE = TUBE[: TUBE.index("states")] + 'states = [{ name = "ref" }]'
# Half of what a square lacks to its neighbour would be another one; a tenth of the pitch is a drawing that can be trusted.
DRAWN_PX = 1.0


def shots(folder: Path, scenario: str) -> Path:
    (folder / "scenario.toml").write_text(scenario)
    done = dishmap("simulate", folder / "scenario.toml", "--out", folder / "shots")
    assert done.exit_code == 0, done.stderr
    return folder / "shots"


@pytest.fixture(scope="module")
def flat(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shots(tmp_path_factory.mktemp("flat"), SCENARIO)


@pytest.fixture(scope="module")
def mapped(flat: Path) -> tuple[Path, Result]:
    done = dishmap(*words(flat, "map", "ref.png"), "--upright", "--out", flat / "map")
    assert done.exit_code == 0, (done.output, done.exception)
    return flat / "map", done


@pytest.fixture(scope="module")
def covered(flat: Path) -> Map:
    """A map of the photograph with a hole in it, and a square beyond the border covered."""
    image = read_gray(flat / "ref.png").copy()
    image[200:240, 300:340] = 220
    pattern = read_pattern(flat / "pattern.json")
    return map_photograph(image, read_camera(flat / "camera.yaml"), pattern, Upright())


def words(folder: Path, command: str, *photographs: str) -> list[object]:
    named = [folder / name for name in photographs]
    return [command, *named, "--camera", folder / "camera.yaml", "--pattern", folder / "pattern.json"]


def rows_of(table: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(table.read_text(encoding="utf-8").splitlines()))


def text_of(page: Path) -> str:
    whole = re.sub(r"<script.*?</script>", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return html.unescape(re.sub(r"<[^>]*>", " ", whole))


def test_a_map_of_squares_says_what_it_learnt(mapped: tuple[Path, Result]) -> None:
    out, done = mapped
    assert "108 of 108 targets measured" in done.stdout
    assert "learnt of the print: printing error" in done.stdout
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    sheet = summary["sheet"]
    # the simulated print is perfect, the edges lie where the file has them to some micrometres
    assert sheet["measured_side_mm"] == pytest.approx(5.0, abs=0.02)
    # no printing errors, no strain: noise is what is left, on the smooth surface as on the rigid plate
    rings = sheet["reprojection"]
    assert rings["smooth_rms_px"] == pytest.approx(rings["noise_px"], rel=0.3)
    assert rings["rigid_rms_px"] == pytest.approx(rings["noise_px"], rel=0.4)
    assert rings["smooth_limit"] == rings["rigid_limit"] == "noise"
    assert summary["assumptions"] is not None
    ids = [int(row["id"]) for row in rows_of(out / "points.csv")]
    assert ids == sorted(ids)
    said = text_of(out / "report.html")
    for part in ("What the grid showed of its print", "Reprojection to the smooth surface", "Errors of a grid's targets go together"):
        assert part in said


def test_a_difference_of_squares_from_a_measurement_and_two_frames(mapped: tuple[Path, Result], flat: Path) -> None:
    more = ["--reference-frame", flat / "still.png", "--upright", "--method", "all", "--out", flat / "diff"]
    done = dishmap(*words(flat, "diff", "map/measurement.npz", "bent.png"), *more)
    assert done.exit_code == 0, (done.output, done.exception)
    rows = rows_of(flat / "diff" / "difference.csv")
    truth = {int(row["id"]): float(row["displacement_mm"]) for row in rows_of(flat / "truth.csv") if row["image"] == "bent.png"}
    error = np.array([float(row["displacement_mm"]) - truth[int(row["id"])] for row in rows])
    sigma = np.array([float(row["sigma_displacement_mm"]) for row in rows])
    assert len(rows) == 108
    # the plate is bent by 0.12 mm rms; errors of neighbours go together, so few independent ones are counted
    assert np.sqrt((error**2).mean()) < 0.01
    assert (np.abs(error) < 3 * sigma).mean() > 0.9
    assert (flat / "diff" / "difference_paper.csv").exists()
    assert "The shape changed by" in text_of(flat / "diff" / "report.html")


def test_a_cylinder_has_a_radius(tmp_path: Path) -> None:
    tube = shots(tmp_path, TUBE)
    done = dishmap(*words(tube, "map", "ref.png"), "--upright", "--out", tube / "own")
    assert done.exit_code == 0, (done.output, done.exception)
    flat = grid(12, 9, 12.0, line_width_mm=1.0)
    write_pattern(tube / "pattern.json", flat)
    done = dishmap(*words(tube, "map", "ref.png"), "--upright", "--surface", "cylinder", "--out", tube / "flat")
    assert done.exit_code == 0, (done.output, done.exception)
    for folder in ("own", "flat"):
        surface = json.loads((tube / folder / "summary.json").read_text(encoding="utf-8"))["surface"]
        assert surface["kind"] == "cylinder"
        assert surface["radius_mm"] == pytest.approx(70.0, abs=0.1)
        assert surface["sigma_radius_mm"] > 0
        names = [c["name"] for c in json.loads((tube / folder / "surface.json").read_text(encoding="utf-8"))["coefficients"]]
        assert names[-1] == "radius"
    assert "radius 70." in done.stdout
    assert "Radius of the cylinder" in text_of(tube / "flat" / "report.html")
    # an unrolled sheet follows no rigid pose; its shape is what is seen
    assert json.loads((tube / "flat" / "summary.json").read_text(encoding="utf-8"))["sheet"]["reprojection"]["rigid_limit"] == "shape"


def test_anchors_stand_in_the_summary(flat: Path) -> None:
    row = rows_of(flat / "truth.csv")[0]
    anchor = f"{row['id']}@{float(row['u_px']):.0f},{float(row['v_px']):.0f}"
    done = dishmap(*words(flat, "map", "ref.png"), "--anchor", anchor, "--upright", "--out", flat / "anchored")
    assert done.exit_code == 0, (done.output, done.exception)
    hint = json.loads((flat / "anchored" / "summary.json").read_text(encoding="utf-8"))["hint"]
    assert hint["kind"] == "anchors"
    assert f"{hint['anchors'][0]['id']}@{hint['anchors'][0]['u_px']:.0f},{hint['anchors'][0]['v_px']:.0f}" == anchor
    # the same target a column further is no way in which the grid can lie
    wrong = f"1@{float(row['u_px']):.0f},{float(row['v_px']):.0f}"
    done = dishmap(*words(flat, "map", "ref.png"), "--anchor", wrong, "--upright", "--out", flat / "no")
    assert "in no way that has all anchors" in refused(done)


def test_outlines_are_where_squares_are(covered: Map) -> None:
    outlines = outlines_of(covered, numbers_of(covered))
    assert len(outlines) == len(covered.pattern)
    states = {o.state for o in outlines}
    assert {"good", "missing"} <= states
    truth = covered.camera.project(covered.camera_from_dish.apply(covered.pattern.center_mm))
    for outline in outlines:
        (index,) = np.flatnonzero(covered.pattern.ids == int(outline.label))
        assert np.linalg.norm(outline.label_px - truth[index]) < DRAWN_PX
        corners = outline.strokes_px[0]
        # a square of 5 mm at 220 mm is 16 px wide
        assert np.ptp(corners, axis=0) == pytest.approx([15.9, 15.9], abs=2.5)
        assert np.linalg.norm(corners[:4].mean(axis=0) - truth[index]) < DRAWN_PX
    assert unused_outlines(covered) == []


def test_a_wrong_side_is_said(covered: Map) -> None:
    assert side_warning(covered) == ""
    assert covered.poses.sheet is not None  # type: ignore[union-attr]
    wrong = replace(covered.poses, sheet=replace(covered.poses.sheet, spread_mm=-0.3))  # type: ignore[union-attr, type-var]
    said = side_warning(replace(covered, poses=wrong))
    assert re.search(r"side of squares seems wrong: it says 5 mm, and they measure 4\.4\d\d ±", said)


def test_what_does_not_apply_to_grids_is_refused(flat: Path, covered: Map, tmp_path: Path) -> None:
    said = refused(dishmap(*words(flat, "map", "ref.png"), "--upright", "--normal-sigma-deg", 1, "--out", tmp_path / "x"))
    assert "a grid learns what ink and surface do" in said
    assert not (tmp_path / "x").exists()
    said = refused(
        dishmap("calibrate", *[flat / f"{n}.png" for n in ("ref", "still", "bent")], "--board", flat / "pattern.json", "--out", "c")
    )
    assert "is a grid, and a calibration board is" in said
    said = refused(dishmap("plan", flat / "pattern.json", "--camera", flat / "camera.yaml", "--distance-mm", 300, "--out", tmp_path / "p"))
    assert "a grid of squares or lines cannot be planned" in said
    image = np.zeros((covered.camera.height_px, covered.camera.width_px), np.uint8)
    with pytest.raises(InputError, match="is a grid, which is found anew in every photograph"):
        track_targets(image, covered.camera, covered.pattern, covered.poses)  # type: ignore[arg-type]
