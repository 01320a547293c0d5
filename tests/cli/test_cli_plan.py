"""`dishmap plan`: words in, table, warnings and files out; what it refuses."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from cli_words import dishmap, refused

from dishmap.camera.model import Camera
from dishmap.io.camera_file import write_camera
from dishmap.io.pattern_file import write_pattern
from dishmap.targets.builders import disc, plate

PLATE = ["plan", "plate", "--rows", 3, "--columns", 4, "--pitch-mm", 40]
LENS = ["--sensor", "640x480", "--fov-deg", 24]


@pytest.fixture
def no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """A report of one line, for tests that look at something else: drawing takes longer than planning."""
    monkeypatch.setattr("dishmap.planning_report.plan_report", lambda cases, title, inputs: f"<title>{title}</title>")


def test_a_plate_and_its_files(tmp_path: Path) -> None:
    done = dishmap(*PLATE, *LENS, "--distance-mm", 650, "--out", tmp_path / "out")
    assert done.exit_code == 0, (done.output, done.exception)
    assert "12 of 12" in done.stdout
    assert "change of shape (mm)" in done.stdout
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["plan.csv", "report.html", "summary.json"]
    with (tmp_path / "out" / "plan.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["id"] for row in rows] == [str(i) for i in range(12)]
    assert all(float(row["sigma_depth_mm"]) > 0 and row["problem"] == "" for row in rows)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    (case,) = summary["cases"]
    assert case["counts"] == {"in_pattern": 12, "measurable": 12}
    depth = [float(row["sigma_depth_mm"]) for row in rows]
    assert case["sigmas"]["sigma_depth_mm"]["worst"] == pytest.approx(max(depth), rel=1e-5)
    assert case["shared_calibration"]["known"] is False
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    for words in ("All 12 targets can be measured", "What the camera will see", "What was assumed", "24 deg, 650 mm"):
        assert words in page


@pytest.mark.usefixtures("no_report")
def test_lenses_and_distances_are_compared(tmp_path: Path) -> None:
    words = [*PLATE, "--sensor", "640x480", "--fov-deg", "24,40", "--distance-mm", "650,1,900", "--out", tmp_path]
    done = dishmap(*words)
    assert done.exit_code == 0, (done.output, done.exception)
    lines = [line for line in done.stdout.splitlines() if " deg, " in line]
    assert [line.strip()[:14].strip() for line in lines[:6]] == [f"{f} deg, {d} mm" for f in (24, 40) for d in (650, 1, 900)]
    # one that cannot be made leaves a row without numbers, and says why
    assert lines[1].split()[4:] == ["0", *["-"] * 6]
    assert "24 deg, 1 mm: no target of the pattern can be measured" in done.stdout
    cases = {case["name"]: case for case in json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["cases"]}
    depth = {name: case["sigmas"]["sigma_depth_mm"]["median"] for name, case in cases.items() if not case["problem"]}
    assert set(depth) == {f"{f} deg, {d} mm" for f in (24, 40) for d in (650, 900)}
    # nearer and longer lenses are better
    assert depth["24 deg, 650 mm"] < min(depth["24 deg, 900 mm"], depth["40 deg, 650 mm"])
    assert max(depth["24 deg, 900 mm"], depth["40 deg, 650 mm"]) < depth["40 deg, 900 mm"]


@pytest.mark.usefixtures("no_report")
def test_a_lens_in_mm_is_the_same_as_its_field_of_view(tmp_path: Path) -> None:
    """A sensor 640 x 5 um = 3.2 mm wide behind a lens of 1.6 / tan(12 deg) mm."""
    lens = 1.6 / np.tan(np.radians(12.0))
    for name, words in (("fov", LENS), ("lens", ["--sensor", "640x480", "--lens-mm", lens, "--pixel-um", 5])):
        assert dishmap(*PLATE, *words, "--distance-mm", 650, "--out", tmp_path / name).exit_code == 0
    fov, mm = (json.loads((tmp_path / name / "summary.json").read_text(encoding="utf-8"))["cases"][0] for name in ("fov", "lens"))
    assert mm["sigmas"]["sigma_depth_mm"]["median"] == pytest.approx(fov["sigmas"]["sigma_depth_mm"]["median"], rel=1e-6)


@pytest.mark.usefixtures("no_report")
def test_a_camera_file_brings_its_calibration(tmp_path: Path) -> None:
    camera = Camera(640, 480, [1500.0, 1500.0], [319.5, 239.5], covariance=np.diag([4.0, 4.0, 9.0, 9.0]))
    write_camera(tmp_path / "camera.yaml", camera)
    write_pattern(tmp_path / "pattern.json", plate(3, 4, 40.0))
    pose = {"camera_from_dish": {"rotation_vector_deg": [180, 0, 0], "translation_mm": [0, 0, 650]}}
    (tmp_path / "pose.json").write_text(json.dumps(pose))
    words = ["plan", tmp_path / "pattern.json", "--camera", tmp_path / "camera.yaml", "--out", tmp_path / "out"]
    done = dishmap(*words, "--pose-guess", tmp_path / "pose.json")
    assert done.exit_code == 0, (done.output, done.exception)
    assert "calibration's part of depth (mm)" in done.stdout
    assert "Absolute depth is limited by the calibration" in done.stdout
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert set(summary["inputs"]) == {"pattern", "camera", "pose_guess"}
    shared = summary["cases"][0]["shared_calibration"]
    # two pixels in 1500, of fx and of fy, each half of the scale
    assert shared["sigma_rms_mm"][2] > 650 * 2 / 1500 / np.sqrt(2)


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--distance-mm", 300], "cannot be measured: not wholly in the picture"),
        (["--distance-mm", 4000], "flagged too_small"),
        (["--distance-mm", 2000, "--blur-px", 2], "not resolved"),
        (["--distance-mm", 650, "--tilt-deg", 60], "seen at more than 50°"),
        (["--distance-mm", 650, "--contrast-to-noise", 5], "some targets may not be found"),
        (["--distance-mm", 650, "--smoothness", "0.0001:50"], "hardly show a change of 0.00010 mm"),
    ],
)
def test_warnings(tmp_path: Path, words: list[object], said: str) -> None:
    done = dishmap(*PLATE, *LENS, *words, "--out", tmp_path)
    assert done.exit_code == 0, (done.output, done.exception)
    assert said in done.stdout


@pytest.mark.usefixtures("no_report")
def test_discs_and_single_targets_are_warned_of(tmp_path: Path) -> None:
    done = dishmap(*PLATE, "--kind", "disc", *LENS, "--distance-mm", 650, "--out", tmp_path)
    assert "flagged weak_depth" in done.stdout
    write_pattern(tmp_path / "one.json", plate(1, 1, 40.0, disc(8.0)))
    done = dishmap("plan", tmp_path / "one.json", *LENS, "--distance-mm", 650, "--out", tmp_path)
    assert "A difference needs at least 3 targets" in done.stdout


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--sensor", "0x0", "--fov-deg", 75, "--distance-mm", 650], "image size must be positive, not 0x0"),
        (["--sensor", "640x480", "--fov-deg", 180, "--distance-mm", 650], "is no pinhole's"),
        ([*LENS, "--distance-mm", 0.65], "is the distance really in mm?"),
        ([*LENS, "--distance-mm", 1e7], "too small to be found"),
        ([*LENS, "--distance-mm", 650, "--contrast-to-noise", 1], "shows no targets"),
        ([*LENS, "--distance-mm", 650, "--blur-px", 50], "the blur must lie between"),
        ([*LENS, "--distance-mm", ",".join(map(str, range(600, 625)))], "25 combinations of lens and distance are too many"),
    ],
)
def test_what_cannot_be_planned_is_refused(tmp_path: Path, words: list[object], said: str) -> None:
    assert said in refused(dishmap(*PLATE, *words, "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([*LENS], "give --distance-mm"),
        (["--distance-mm", 650], "give --sensor WxH with --fov-deg"),
        (["--sensor", "640x480", "--distance-mm", 650], "give --sensor WxH with --fov-deg"),
        ([*LENS, "--lens-mm", 8, "--pixel-um", 3, "--distance-mm", 650], "give --sensor WxH with --fov-deg"),
        (["--sensor", "640x480", "--lens-mm", 8, "--distance-mm", 650], "give --sensor WxH with --fov-deg"),
        (["--sensor", "640", "--fov-deg", 75, "--distance-mm", 650], "pixels along the width and the height"),
        ([*LENS, "--camera", "c.yaml", "--distance-mm", 650], "a --camera file holds its sensor and lens"),
        ([*LENS, "--distance-mm", 650, "--pose-guess", "p.json"], "give either --pose-guess, or --distance-mm"),
        ([*LENS, "--distance-mm", -650], "a finite number above 0 is needed"),
        ([*LENS, "--distance-mm", 650, "--smoothness", "0.1"], "is not of the form 0.2:150"),
        ([*LENS, "--distance-mm", 650, "--slide", "sideways"], "is not one of"),
    ],
)
def test_words_that_do_not_go_together(tmp_path: Path, words: list[object], said: str) -> None:
    done = dishmap(*PLATE, *words, "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert said in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_first_word_that_is_no_pattern(tmp_path: Path) -> None:
    said = refused(dishmap("plan", "antenna", *LENS, "--distance-mm", 650, "--out", tmp_path / "out"))
    assert "'antenna' is neither a pattern file nor one of plate, dish" in said
