"""`dishmap diff` on small simulated photographs: known changes in, the same changes out; its files, its words, its refusals."""

from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from cli_words import dishmap, refused
from click.testing import Result
from numpy.typing import NDArray

from dishmap.compare import DifferenceTable
from dishmap.io.camera_file import read_camera, write_camera
from dishmap.io.difference_file import read_difference
from dishmap.io.difference_map_file import read_difference_map
from dishmap.io.pattern_file import read_pattern
from dishmap.io.picture_file import picture_bytes
from dishmap.io.pose_file import read_pose
from dishmap.io.truth_file import read_truth

Array = NDArray[np.float64]

SCENARIO = """
format = "dishmap-scenario/1"
seed = 5
pattern.plate = { rows = 4, columns = 5, pitch_mm = 40 }
camera = { width_px = 640, height_px = 480, focal_px = 800, distortion = [-0.1, 0.02, 0.0, 0.0, 0.0] }
pose = { distance_mm = 420, tilt_deg = 15, tilt_direction_deg = 30 }
sensor = { noise_grey = 1.0, psf_sigma_px = 0.7 }

[[states]]
name = "ref"
[[states]]
name = "again"
[[states]]
name = "bent"
zernike = [{ term = "astigmatism_cos", size_mm = 0.8 }]
[[states]]
name = "moved"
zernike = [{ term = "astigmatism_cos", size_mm = 0.8 }]
motion = { rotation_vector_deg = [0.05, -0.03, 0.02], translation_mm = [0.2, -0.1, 0.15] }
"""
# Of the 20 correlated targets of one photograph.
FARTHEST_SIGMAS = 3.0
# What the table rounds to, with the rms of 20 rows.
ROUNDING_MM = 2e-6
FILES = {"difference.csv", "difference.npz", "difference.ply", "surface.json", "summary.json", "report.html"}


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ref.png, again.png (the same state), bent.png, moved.png, camera, pattern, pose and truth."""
    folder = tmp_path_factory.mktemp("states")
    (folder / "scenario.toml").write_text(SCENARIO)
    done = dishmap("simulate", folder / "scenario.toml", "--out", folder / "shots")
    assert done.exit_code == 0, done.stderr
    return folder / "shots"


@pytest.fixture(scope="module")
def saved(shots: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The measurement that `dishmap map` saves of the reference."""
    out = tmp_path_factory.mktemp("map")
    patch = pytest.MonkeyPatch()
    patch.setattr("dishmap.report.map_report", lambda *_: "")
    done = dishmap("map", shots / "ref.png", *setting(shots), "--upright", "--out", out)
    patch.undo()
    assert done.exit_code == 0, done.stderr
    return out / "measurement.npz"


@pytest.fixture(scope="module")
def compared(shots: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """The folder of three states compared with the reference by both methods, and what the program said."""
    out = tmp_path_factory.mktemp("compared") / "out"
    patch = pytest.MonkeyPatch()
    patch.setattr("dishmap.difference_report.difference_report", lambda *_: "")
    done = diff(shots, "ref", "again", "bent", "moved", out, "--upright", "--method", "all")
    patch.undo()
    assert done.exit_code == 0, (done.output, done.exception)
    return out, done


@pytest.fixture(autouse=True)
def _short_report(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """A report of one line: drawing takes longer than measuring."""
    if "real_report" not in request.fixturenames:
        monkeypatch.setattr("dishmap.difference_report.difference_report", lambda result, image, title, inputs: title)


@pytest.fixture
def real_report() -> None:
    """Marks a test that wants the whole report."""


def setting(shots: Path) -> list[object]:
    return ["--camera", shots / "camera.yaml", "--pattern", shots / "pattern.json"]


def diff(shots: Path, *rest: Any) -> Result:
    """`diff` of photographs of the folder, given by name, then the folder for results and options."""
    names = [word for word in rest if isinstance(word, str) and (shots / f"{word}.png").exists()]
    out, *options = (word for word in rest if word not in names)
    return dishmap("diff", *(shots / f"{name}.png" for name in names), *setting(shots), "--out", out, *options)


def true_changes(shots: Path, name: str) -> tuple[Array, Array, Array]:
    """Displacement along nominal normals, change of depth (N,) and motion in the photograph (N, 2)."""
    truth, pattern = read_truth(shots / "truth.csv"), read_pattern(shots / "pattern.json")
    before, after = truth["ref.png"], truth[f"{name}.png"]
    move = after.center_mm - before.center_mm
    normal = read_pose(shots / "pose.json", "camera_from_dish").rotate(pattern.normal)
    return (move * normal).sum(axis=1), move[:, 2], after.center_px - before.center_px


def farthest_sigmas(table: DifferenceTable, true: tuple[Array, Array, Array]) -> float:
    along = (table.displacement_mm - true[0]) / table.sigma_displacement_mm
    deep = (table.depth_change_mm - true[1]) / table.sigma_depth_change_mm
    return float(np.abs([along, deep]).max())


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("name", ["again", "bent", "moved"])
def test_known_changes_come_out(name: str, shots: Path, compared: tuple[Path, Result]) -> None:
    folder = compared[0] / name
    assert {path.name for path in folder.iterdir()} == FILES | {"difference_paper.csv", "difference_paper.ply", "surface_paper.json"}
    table, true = read_difference(folder / "difference.csv"), true_changes(shots, name)
    assert table.ids.tolist() == list(range(20))
    assert table.nominal_mm == pytest.approx(read_pattern(shots / "pattern.json").center_mm, abs=1e-6)
    assert farthest_sigmas(table, true) < FARTHEST_SIGMAS
    # 0.05 px of noise would be far too much, and a wrong sign or frame makes 0.3 px
    assert np.abs(table.du_dv_px - true[2]).max() < 0.02
    # the test can fail: another state's truth is a hundred sigmas off
    other = true_changes(shots, "again" if name != "again" else "bent")
    assert farthest_sigmas(table, other) > 50


def test_the_shape_is_the_displacement_without_its_rigid_motion(shots: Path, compared: tuple[Path, Result]) -> None:
    bent, moved = (read_difference(compared[0] / name / "difference.csv") for name in ("bent", "moved"))
    # the same bend, once with a rigid motion of 0.3 mm on top
    assert rms(bent.displacement_mm - moved.displacement_mm) > 0.1
    assert np.abs((bent.shape_mm - moved.shape_mm) / np.hypot(bent.sigma_shape_mm, moved.sigma_shape_mm)).max() < FARTHEST_SIGMAS


def test_the_paper_s_method_gives_no_nan_and_no_sigma(shots: Path, compared: tuple[Path, Result]) -> None:
    text = (compared[0] / "moved" / "difference_paper.csv").read_text()
    assert "nan" not in text.lower()
    table, true = read_difference(compared[0] / "moved" / "difference_paper.csv"), true_changes(shots, "moved")
    assert np.isnan(table.sigma_shape_mm).all()
    # distances tell a bend of a plate to half of its size, see docs/method-paper.md
    assert rms(table.displacement_mm - true[0]) < 0.5 * rms(true[0])
    assert np.abs(table.du_dv_px - true[2]).max() < 0.05
    # what is left as shape has no tilt and no piston
    columns = np.column_stack([np.ones(20), table.nominal_mm[:, :2]])
    assert np.abs(columns.T @ table.shape_mm / np.linalg.norm(columns, axis=0)).max() < 1e-5


def test_summaries_agree_with_the_tables(shots: Path, compared: tuple[Path, Result]) -> None:
    folder, said = compared
    with (folder / "summary.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["state"] for row in rows] == ["again", "bent", "moved"]
    for row in rows:
        summary = json.loads((folder / row["state"] / "summary.json").read_text())
        table = read_difference(folder / row["state"] / "difference.csv")
        beside = read_difference(folder / row["state"] / "difference_paper.csv")
        for name in ("displacement", "depth_change", "shape"):
            for what, value in ((f"{name}_rms_mm", f"{name}_mm"), (f"sigma_{name}_rms_mm", f"sigma_{name}_mm")):
                assert summary["joint"][what] == pytest.approx(rms(getattr(table, value)), abs=ROUNDING_MM)
                assert float(row[what]) == pytest.approx(summary["joint"][what], rel=1e-8)
        assert float(row["paper_shape_rms_mm"]) == pytest.approx(rms(beside.shape_mm), abs=ROUNDING_MM)
        assert summary["apart"]["shape_rms_mm"] == pytest.approx(rms(table.shape_mm - beside.shape_mm), abs=ROUNDING_MM)
        assert row["changed"] == {"again": "no"}.get(row["state"], "yes")
        assert summary["joint"]["significance"]["changed"] is (row["changed"] == "yes")
        assert (row["problem"], row["converged"], row["targets"]) == ("", "yes", "20")
        assert summary["counts"] == {"in_pattern": 20, "reference": 20, "current": 20, "compared": 20, "flagged": 0}
        assert "not known" in said.stdout
    # 100 ppm of the mean distance of the targets
    assert summary["joint"]["expansion"]["distance_mm_per_100_ppm"] == pytest.approx(0.042, rel=1e-3)
    # the motion that was given, in the dish frame, beside the share of the bend that looks like it
    still = json.loads((folder / "bent" / "summary.json").read_text())["joint"]["rigid_motion"]
    motion, sigma = summary["joint"]["rigid_motion"], summary["joint"]["rigid_motion"]["sigma_rotation_deg"]
    turn = np.subtract(motion["dish_from_dish"]["rotation_vector_deg"], still["dish_from_dish"]["rotation_vector_deg"])
    assert np.abs((turn - [0.05, -0.03, 0.02]) / sigma).max() < FARTHEST_SIGMAS * np.sqrt(2)
    assert shots.name in summary["inputs"]["reference"]["path"]


def test_the_surfaces_run_through_the_tables(shots: Path, compared: tuple[Path, Result]) -> None:
    folder = compared[0] / "bent"
    surface, table = json.loads((folder / "surface.json").read_text()), read_difference(folder / "difference.csv")
    assert (surface["format"], surface["quantity"], surface["basis"]["degree"]) == ("dishmap-surface/1", "displacement_mm", 2)
    assert table.displacement_mm - heights(surface, table) == pytest.approx(
        [r["residual_mm"] for r in surface["residuals"]], abs=ROUNDING_MM
    )
    # the paper's displacement is its surface, at measured places that differ from the nominal ones by some 0.01 mm
    paper, beside = json.loads((folder / "surface_paper.json").read_text()), read_difference(folder / "difference_paper.csv")
    assert paper["quantity"] == "displacement_mm"
    assert beside.displacement_mm == pytest.approx(heights(paper, beside), abs=1e-3)
    assert all(0 < c["sigma"] < 0.1 for c in surface["coefficients"])
    # the paper gives no uncertainty
    assert [c["sigma"] for c in paper["coefficients"]] == [None] * 6
    surface, table = json.loads((folder / "surface.json").read_text())["shape"], read_difference(folder / "difference.csv")
    assert surface["quantity"] == "shape_mm"
    assert table.shape_mm - heights(surface, table) == pytest.approx([r["residual_mm"] for r in surface["residuals"]], abs=ROUNDING_MM)
    # the true bend in the same terms; a rigid motion takes none of those of second degree
    u, v = ((table.nominal_mm[:, :2] - surface["basis"]["center_mm"]) / surface["basis"]["radius_mm"]).T
    true = np.linalg.lstsq(np.stack([np.ones(20), u, v, u**2, u * v, v**2], axis=1), true_changes(shots, "bent")[0], rcond=None)[0]
    found = surface["coefficients"][3:]
    assert [one["name"] for one in found] == ["x2y0", "x1y1", "x0y2"]
    for one, size in zip(found, true[3:], strict=True):
        assert abs(one["value"] - size) < FARTHEST_SIGMAS * one["sigma"] < 0.02
    assert true[3] - true[5] > 0.5


def heights(surface: dict[str, Any], table: DifferenceTable) -> Array:
    """A polynomial surface of a surface file at the targets."""
    u, v = ((table.nominal_mm[:, :2] - surface["basis"]["center_mm"]) / surface["basis"]["radius_mm"]).T
    out = np.zeros(len(table))
    for one in surface["coefficients"]:
        powers = re.fullmatch(r"x(\d)y(\d)", one["name"])
        assert powers is not None
        out += one["value"] * u ** int(powers[1]) * v ** int(powers[2])
    return out


def test_words_of_several_states(compared: tuple[Path, Result]) -> None:
    folder, said = compared
    lines = said.stdout.splitlines()
    assert said.stderr == ""
    assert lines[0].startswith("again: No significant change of shape: ")
    (bent,) = (line for line in lines if line.startswith("bent: "))
    found = re.match(r"bent: The shape changed by ([\d.]+) ± [\d.]+ mm rms", bent)
    assert found is not None
    assert float(found[1]) == pytest.approx(rms(read_difference(folder / "bent" / "difference.csv").shape_mm), abs=1e-4)
    assert sum(line.split()[:2] == ["apart", "20"] for line in lines) == 3
    assert str(folder / "summary.csv") in lines[-1]


@pytest.mark.usefixtures("real_report")
def test_one_state_with_its_report_and_words(shots: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    (out / "difference_paper.csv").write_text("of an earlier run")
    done = diff(shots, "ref", "bent", out, "--upright", "--expansion-ppm", "10+-20", "--slide", "normal", "--surface", "zernike:2")
    assert done.exit_code == 0, (done.output, done.exception)
    assert {path.name for path in out.iterdir()} == FILES | {"summary.csv", "notes.txt"}
    assert "20 of 20 targets compared" in done.stdout
    assert "the shape changed by" in done.stdout.lower()
    assert "rigid motion in the dish frame: x " in done.stdout
    assert "expansion: 10 ± 20 ppm given" in done.stdout
    assert "each 100 ppm would be 0.042 mm of distance" in done.stdout
    assert f"report: {out / 'report.html'}" in done.stdout
    summary = json.loads((out / "summary.json").read_text())
    assert summary["joint"]["expansion"]["assumed_mean_ppm"] == pytest.approx(10)
    assert summary["joint"]["priors"]["slide"] == "normal"
    assert json.loads((out / "surface.json").read_text())["basis"]["kind"] == "zernike"
    assert farthest_sigmas(read_difference(out / "difference.csv"), true_changes(shots, "bent")) < FARTHEST_SIGMAS
    assert "<html" in (out / "report.html").read_text()


def test_a_saved_measurement_gives_the_same_as_its_photograph(
    shots: Path, saved: Path, compared: tuple[Path, Result], tmp_path: Path
) -> None:
    # the saved pose names the current photograph: no word on which way is up
    done = dishmap("diff", saved, shots / "moved.png", *setting(shots), "--out", tmp_path / "out", "--method", "all")
    assert done.exit_code == 0, done.stderr
    ours, theirs = (read_difference(folder / "difference.csv") for folder in (tmp_path / "out", compared[0] / "moved"))
    assert np.abs((ours.displacement_mm - theirs.displacement_mm) / ours.sigma_displacement_mm).max() < 0.01
    # the paper's own centres are not in the file; those of the fitted targets come with sigmas
    paper = json.loads((tmp_path / "out" / "summary.json").read_text())["paper"]
    assert paper["centers"] == "fitted"
    beside = read_difference(tmp_path / "out" / "difference_paper.csv")
    assert (beside.sigma_shape_mm > 0).all()


def test_the_same_photograph_twice_is_told(shots: Path, saved: Path, tmp_path: Path) -> None:
    for reference in (shots / "ref.png", saved):
        out = tmp_path / reference.stem
        done = dishmap("diff", reference, shots / "ref.png", *setting(shots), "--upright", "--out", out, "--method", "all")
        assert done.exit_code == 0, done.stderr
        assert "same photograph" in done.stdout
        for name in ("difference.csv", "difference_paper.csv"):
            table = read_difference(out / name)
            assert np.abs(table.displacement_mm).max() < 1e-3
        assert json.loads((out / "summary.json").read_text())["same_photograph"] is True


def test_frames_of_one_state_are_averaged(shots: Path, compared: tuple[Path, Result], tmp_path: Path) -> None:
    scenario = SCENARIO.split("[[states]]", maxsplit=1)[0].replace("seed = 5", "seed = 6") + '[[states]]\nname = "more"\n'
    bend = '[[states]]\nname = "bend"\nzernike = [{ term = "astigmatism_cos", size_mm = 0.8 }]\n'
    (tmp_path / "more.toml").write_text(scenario + bend)
    assert dishmap("simulate", tmp_path / "more.toml", "--out", tmp_path / "more").exit_code == 0
    frame = ["--reference-frame", tmp_path / "more" / "more.png"]
    current = [shots / "bent.png", tmp_path / "more" / "bend.png"]
    words = ["diff", shots / "ref.png", *current, *setting(shots), "--upright", "--out", tmp_path / "out", "--same-state", *frame]
    done = dishmap(*words, "--method", "all")
    assert done.exit_code == 0, done.stderr
    table, single = read_difference(tmp_path / "out" / "difference.csv"), read_difference(compared[0] / "bent" / "difference.csv")
    assert farthest_sigmas(table, true_changes(shots, "bent")) < FARTHEST_SIGMAS
    # twice the photographs in both states: variances of what is no prior's are halved
    assert np.median(table.sigma_displacement_mm / single.sigma_displacement_mm) == pytest.approx(2**-0.5, abs=0.1)
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["frames"] == {"reference": 2, "current": 2}
    assert all(path.is_file() for path in (tmp_path / "out").iterdir())


def test_the_covariance_is_that_of_the_table(compared: tuple[Path, Result]) -> None:
    folder = compared[0] / "bent"
    table, saved = read_difference(folder / "difference.csv"), read_difference_map(folder / "difference.npz")
    assert saved.ids.tolist() == table.ids.tolist()
    assert np.abs(saved.shape_mm - table.shape_mm).max() < ROUNDING_MM
    for factor, own, sigma in (
        (saved.shape_factor, saved.shape_own_mm2, table.sigma_shape_mm),
        (saved.displacement_factor, saved.displacement_own_mm2, table.sigma_displacement_mm),
    ):
        # the table keeps 6 digits
        assert np.allclose(np.sqrt((factor**2).sum(axis=1) + own), sigma, rtol=1e-5, atol=0)


def test_the_paper_s_method_alone(shots: Path, compared: tuple[Path, Result], tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "difference.npz").write_text("of an earlier run")
    done = diff(shots, "ref", "bent", tmp_path / "out", "--upright", "--method", "paper")
    assert done.exit_code == 0, done.stderr
    assert (tmp_path / "out" / "difference.csv").read_text() == (compared[0] / "bent" / "difference_paper.csv").read_text()
    assert not (tmp_path / "out" / "difference.npz").exists()
    assert "not known" in done.stdout
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["joint"], summary["apart"], summary["paper"]["centers"]) == (None, None, "paper")


def test_what_is_out_of_view_is_told_and_the_rest_compared(shots: Path, tmp_path: Path) -> None:
    image = cv2.imread(str(shots / "bent.png"), cv2.IMREAD_GRAYSCALE)
    # 70 grey is neither paper nor ink; the first column of targets is lost
    image[:, :150] = 70
    (tmp_path / "part.png").write_bytes(picture_bytes(image))
    done = dishmap("diff", shots / "ref.png", tmp_path / "part.png", *setting(shots), "--upright", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    table, (along, deep, pixels) = read_difference(tmp_path / "out" / "difference.csv"), true_changes(shots, "bent")
    assert table.ids.tolist() == [i for i in range(20) if i % 5]
    assert farthest_sigmas(table, (along[table.ids], deep[table.ids], pixels[table.ids])) < FARTHEST_SIGMAS
    assert "16 of 20 targets compared" in done.stdout
    assert "left out: 4 (0, 5, 10, 15): " in done.stdout


def test_one_bad_photograph_of_several_does_not_take_the_others_along(shots: Path, tmp_path: Path) -> None:
    (tmp_path / "dark.png").write_bytes(picture_bytes(np.full((480, 640), 30, np.uint8)))
    words = ["diff", shots / "ref.png", tmp_path / "dark.png", shots / "again.png", *setting(shots), "--upright"]
    done = dishmap(*words, "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert re.search(r"^dishmap: 1 of 2 states could not be compared \(.*dark\.png: .*; the others are in ", done.stderr)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["again", "summary.csv"]
    with (tmp_path / "out" / "summary.csv").open(newline="") as stream:
        bad, good = csv.DictReader(stream)
    assert "dark.png" in bad["problem"]
    assert bad["shape_rms_mm"] == ""
    assert (good["state"], good["problem"]) == ("again", "")


def test_when_all_fail_nothing_is_left(shots: Path, tmp_path: Path) -> None:
    for name in ("one.png", "two.png"):
        (tmp_path / name).write_bytes(picture_bytes(np.full((480, 640), 30, np.uint8)))
    words = ["diff", shots / "ref.png", tmp_path / "one.png", tmp_path / "two.png", *setting(shots), "--upright"]
    assert "none of the 2 states could be compared" in refused(dishmap(*words, "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def scaled_camera(shots: Path, tmp_path: Path) -> Path:
    camera = read_camera(shots / "camera.yaml")
    write_camera(tmp_path / "other.yaml", camera.with_parameters(camera.parameters * [1.01, 1.01, *[1] * 7]))
    return tmp_path / "other.yaml"


def other_pattern(tmp_path: Path) -> Path:
    words = ["pattern", "plate", "--rows", 4, "--columns", 5, "--pitch-mm", 41, "--out", tmp_path / "other.json"]
    assert dishmap(*words).exit_code == 0
    return tmp_path / "other.json"


def test_a_saved_measurement_by_another_camera_or_pattern_is_refused(shots: Path, saved: Path, tmp_path: Path) -> None:
    words = ["diff", saved, shots / "bent.png", "--out", tmp_path / "out"]
    camera, pattern = ["--camera", shots / "camera.yaml"], ["--pattern", shots / "pattern.json"]
    assert "another camera file" in refused(dishmap(*words, "--camera", scaled_camera(shots, tmp_path), *pattern))
    assert "another pattern file" in refused(dishmap(*words, *camera, "--pattern", other_pattern(tmp_path)))
    assert not (tmp_path / "out").exists()


def test_photographs_that_do_not_fit(shots: Path, tmp_path: Path) -> None:
    (tmp_path / "small.png").write_bytes(picture_bytes(np.full((240, 320), 90, np.uint8)))
    out = ["--out", tmp_path / "out"]
    for pair in ((tmp_path / "small.png", shots / "ref.png"), (shots / "ref.png", tmp_path / "small.png")):
        said = refused(dishmap("diff", *pair, *setting(shots), "--upright", *out))
        assert "small.png: the photograph is 320x240 px but the camera was calibrated at 640x480 px" in said
    assert not (tmp_path / "out").exists()


def test_a_photograph_that_shows_too_little_is_refused_by_name(shots: Path, tmp_path: Path) -> None:
    image = cv2.imread(str(shots / "bent.png"), cv2.IMREAD_GRAYSCALE)
    # 70 grey is neither paper nor ink; two columns of targets are left, which a shift by a column explains as well
    image[:, 330:] = 70
    (tmp_path / "left.png").write_bytes(picture_bytes(image))
    words = ["diff", shots / "ref.png", tmp_path / "left.png", *setting(shots), "--pose-guess", shots / "pose.json"]
    said = refused(dishmap(*words, "--out", tmp_path / "out"))
    assert re.search(r"left\.png: the pattern 'plate-4x5' could sit in \d ways", said), said


def damaged(saved: Path, tmp_path: Path) -> list[Path]:
    data = saved.read_bytes()
    (tmp_path / "cut.npz").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.npz").write_text("not an archive")
    np.savez(tmp_path / "foreign.npz", ids=np.arange(3))
    return [tmp_path / f"{name}.npz" for name in ("cut", "text", "foreign")]


def test_a_damaged_measurement_is_refused(shots: Path, saved: Path, tmp_path: Path) -> None:
    for path in damaged(saved, tmp_path):
        said = refused(dishmap("diff", path, shots / "bent.png", *setting(shots), "--out", tmp_path / "out"))
        assert f"{path} is no whole measurement of dishmap; make it again with `dishmap map`" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("current", "options", "message"),
    [
        (["bent"], ["--same-state"], "only one was given"),
        (["bent", "bent"], [], "two current photographs are called 'bent'"),
        (["bent", "bent"], ["--same-state"], "are the same photograph"),
        (["bent"], ["--reference-frame", "ref.png"], "are the same photograph"),
        (["gone"], [], "there is no such file"),
        (["."], [], "it is not a file"),
        (["bent"], ["--surface", "paraboloid"], "not a paraboloid"),
        (["bent"], ["--surface", "spline"], "spline"),
        (["bent"], ["--focal-drift", "0.5"], "focal drift must lie between 0 and 0.1"),
        (["bent"], ["--expansion-ppm", "0+-1e6"], "standard deviation of the expansion must lie between 0 and 50000 ppm"),
        (["bent"], ["--strain", "7"], "strain must lie between 0 and 0.1"),
        (["bent"], ["--still", "--smoothness", "1:100"], "has no smoothness"),
        (["bent"], ["--rigid-ids", "3,77"], "77"),
    ],
)
def test_what_cannot_be_done_is_refused_in_a_sentence(
    current: list[str], options: list[str], message: str, shots: Path, tmp_path: Path
) -> None:
    photographs = [shots if name == "." else shots / f"{name}.png" for name in current]
    options = [str(shots / word) if word.endswith(".png") else word for word in options]
    words = ["diff", shots / "ref.png", *photographs, *setting(shots), "--upright", "--out", tmp_path / "out", *options]
    assert message in refused(dishmap(*words))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--expansion-ppm", "20"], "not of the form 20\\+-5"),
        (["--strain", "soft"], "not rigid, free or a standard deviation"),
        (["--smoothness", "1"], "not of the form 0.2:150"),
        (["--smoothness", "1:-3"], "above 0"),
        (["--rigid-ids", "5-1"], "not of the form 0,1,5-8"),
        (["--method", "paper", "--still"], "mean nothing to --method paper"),
        (["--slide", "sideways"], "least_strain"),
    ],
)
def test_words_that_are_not_understood(options: list[str], message: str, shots: Path, tmp_path: Path) -> None:
    done = diff(shots, "ref", "bent", tmp_path / "out", "--upright", *options)
    assert done.exit_code == 2
    assert re.search(message, " ".join(done.stderr.replace("│", " ").split()))
    assert not (tmp_path / "out").exists()


def test_a_measurement_is_no_current_photograph(shots: Path, saved: Path, tmp_path: Path) -> None:
    said = refused(dishmap("diff", shots / "ref.png", saved, *setting(shots), "--out", tmp_path / "out"))
    assert "can only be the REFERENCE" in said


def test_one_photograph_does_not_stand_on_both_sides_of_an_average(shots: Path, saved: Path, tmp_path: Path) -> None:
    out = [*setting(shots), "--upright", "--out", tmp_path / "out"]
    said = refused(dishmap("diff", shots / "ref.png", shots / "ref.png", shots / "again.png", *out, "--same-state"))
    assert "ref.png is also a photograph of the reference" in said
    said = refused(dishmap("diff", saved, shots / "bent.png", *out, "--reference-frame", shots / "ref.png"))
    assert "ref.png is another measurement of a photograph that is there already" in said


@pytest.mark.parametrize("more", [[], ["--method", "all"]])
def test_a_surface_that_cannot_be_fitted_is_told(more: list[str], shots: Path, tmp_path: Path) -> None:
    done = diff(shots, "ref", "bent", tmp_path / "out", "--upright", "--surface", "zernike:6", "--focal-drift", "1e-5", *more)
    assert done.exit_code == 0, done.stderr
    assert "no surface through the shape: 20 targets are too few" in done.stdout
    assert ("the paper's method failed: " in done.stdout) is bool(more)
    assert "focal length: changed by" in done.stdout
    surface, summary = (json.loads((tmp_path / "out" / name).read_text()) for name in ("surface.json", "summary.json"))
    assert (surface["fitted"], surface["shape"]["fitted"], summary["paper"], summary["apart"]) == (False, False, None, None)
    assert set(summary["problems"]) == {"displacement", "shape", *(["paper"] if more else [])}


def test_out_that_is_a_file(shots: Path, tmp_path: Path) -> None:
    shutil.copy(shots / "pattern.json", tmp_path / "out")
    assert str(tmp_path / "out") in refused(diff(shots, "ref", "bent", tmp_path / "out", "--upright"))
