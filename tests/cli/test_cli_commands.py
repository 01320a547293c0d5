"""The other commands, and the program as a process: help at once, versions, Ctrl-C."""

from __future__ import annotations

import os
import re
import resource
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from board_shots import board_photographs
from cli_words import dishmap, map_words, refused

from dishmap.camera.calibrate import LENSES
from dishmap.camera.model import Camera
from dishmap.camera.problem import READOUTS
from dishmap.cli import calibrate as calibrate_words
from dishmap.cli import demo, demo_gain, pattern
from dishmap.io.camera_file import read_camera, read_views, write_camera
from dishmap.io.images import read_gray
from dishmap.io.pattern_file import read_pattern
from dishmap.io.pose_file import read_pose
from dishmap.io.scenario_file import read_scenario
from dishmap.io.truth_file import read_truth
from dishmap.simulate.scenario import simulate_states
from dishmap.targets.builders import KIND_BUILDERS
from dishmap.targets.grid_builders import SURFACE_NAMES
from dishmap.targets.pattern import Surface
from dishmap.targets.symmetry import symmetry_poses

ROOT = Path(__file__).resolve().parents[2]
# Of the processor's time, which a busy machine does not change.
LONGEST_HELP_SECONDS = 0.4
HEAVY = ("cv2", "scipy", "pydantic", "matplotlib", "plotly", "rich", "numpy")


def start(*words: object, **options: object) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    # a shell's background jobs are started deaf to Ctrl-C, and would pass that on
    hears = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)}
    command = [sys.executable, "-m", "dishmap", *map(str, words)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, **hears, **options)  # type: ignore[call-overload]


def test_help_comes_at_once() -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    said, _ = start("--help").communicate()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert all(name in said for name in ("calibrate", "demo", "map", "pattern", "simulate", "undistort"))
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < LONGEST_HELP_SECONDS


def test_help_loads_nothing_heavy() -> None:
    code = f"import sys, dishmap.cli.app; print([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env={"PYTHONPATH": str(ROOT / "src")})
    assert done.stdout.strip() == "[]"


def test_version_and_the_installed_name() -> None:
    assert re.fullmatch(r"dishmap \S+\n", dishmap("--version").stdout)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    module, _, function = project["scripts"]["dishmap"].partition(":")
    assert callable(getattr(__import__(module, fromlist=[function]), function))


def test_words_are_those_of_the_functions() -> None:
    assert set(pattern.KINDS) == set(KIND_BUILDERS)
    assert list(pattern.SURFACES) == list(SURFACE_NAMES)
    assert set(calibrate_words.LENSES.values()) == set(LENSES)
    assert calibrate_words.READOUTS == READOUTS


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_stopping_leaves_nothing(sent: signal.Signals, tmp_path: Path) -> None:
    process = start("demo", "--out", tmp_path / "out")
    assert process.stdout is not None
    # the folder is there and the photograph on its way
    assert process.stdout.readline().startswith("photographing")
    time.sleep(0.3)
    process.send_signal(sent)
    _, said = process.communicate(timeout=60)
    if sent == signal.SIGINT:
        assert (process.returncode, said) == (130, "dishmap: stopped; no file was left half-written\n")
    else:
        assert (process.returncode, said) == (128 + signal.SIGTERM, "")
    assert list(tmp_path.iterdir()) == []


def test_a_reader_that_goes_away_is_no_error(shot: Path, tmp_path: Path) -> None:
    process = start("pattern", "plate", "--rows", 2, "--columns", 3, "--pitch-mm", 40, "--out", tmp_path / "p.json")
    assert process.stdout is not None
    process.stdout.close()
    assert process.stderr is not None
    with process.stderr:
        assert process.stderr.read() == ""
    process.wait()


@pytest.mark.parametrize("kind", pattern.KINDS)
def test_patterns_of_every_kind(kind: str, tmp_path: Path) -> None:
    sizes = {
        "disc": ["--radius-mm", 6],
        "ring": ["--outer-radius-mm", 6, "--inner-radius-mm", 4],
        "concentric": ["--radii-mm", "6,4.5,2"],
        "multi": ["--count", 3, "--outer-radius-mm", 4, "--inner-radius-mm", 0, "--side-mm", 12],
        "whycon": ["--outer-radius-mm", 6, "--ratio", 0.5],
    }[kind]
    out = tmp_path / "new" / "pattern.json"
    words = ["pattern", "plate", "--rows", 3, "--columns", 4, "--pitch-mm", 40, "--kind", kind, *sizes, "--out", out]
    done = dishmap(*words)
    assert done.exit_code == 0, done.stderr
    # three on a triangle show which way is up
    assert ("looks the same after 1 turn" in done.stdout) == (kind != "multi")
    made = read_pattern(out)
    assert len(made) == 12
    radii = {"disc": [6], "ring": [6, 4], "concentric": [6, 4.5, 2], "multi": [4, 4, 4], "whycon": [6, 3]}[kind]
    assert made.kind_of(0).radius_mm.tolist() == radii


def test_dish_pattern_with_marks(tmp_path: Path) -> None:
    words = ["pattern", "dish", "--diameter-mm", 600, "--focal-length-mm", 300, "--spacing-mm", 60, "--name", "mine"]
    out = tmp_path / "dish.json"
    assert dishmap(*words, "--orientation-marks", "--no-center-target", "--margin-mm", 40, "--out", out).exit_code == 0
    made = read_pattern(out)
    assert (made.name, made.surface.diameter_mm, made.surface.focal_length_mm) == ("mine", 600, 300)
    radius = np.hypot(made.center_mm[:, 0], made.center_mm[:, 1])
    assert (radius.min(), radius.max()) == (pytest.approx(60), pytest.approx(240))
    assert symmetry_poses(made) == []


@pytest.mark.parametrize(
    ("words", "surface", "said"),
    [
        (["--line-mm", 1, "--orientation-marks"], Surface(), "crossing, crossing-marked"),
        (["--square-mm", 8], Surface(), "looks the same after 1 turn"),
        (["--square-mm", 8, "--surface", "cylinder", "--cylinder-radius-mm", -80], Surface("cylinder", radius_mm=-80.0), "(square)"),
        (
            ["--line-mm", 1, "--surface", "dish", "--diameter-mm", 300, "--focal-length-mm", 150],
            Surface("paraboloid", 300.0, 150.0),
            "a photograph of a part of it could be of any part",
        ),
    ],
)
def test_grid_patterns(words: list[object], surface: Surface, said: str, tmp_path: Path) -> None:
    out = tmp_path / "grid.json"
    done = dishmap("pattern", "grid", "--columns", 8, "--rows", 7, "--pitch-mm", 12, *words, "--out", out)
    assert done.exit_code == 0, done.output
    assert said in " ".join(done.stdout.split())
    made = read_pattern(out)
    assert (len(made), made.surface, made.is_grid) == (56, surface, True)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "give --line-mm or --square-mm"),
        (["--line-mm", 1, "--square-mm", 3], "and not both"),
        (["--line-mm", 1, "--surface", "dish", "--diameter-mm", 300], "--surface dish needs --focal-length-mm"),
        (["--line-mm", 1, "--cylinder-radius-mm", 57], "--surface plane does not take --cylinder-radius-mm"),
        (["--line-mm", 6], "too wide for a pitch of 12 mm"),
    ],
)
def test_grid_pattern_mistakes(words: list[object], said: str, tmp_path: Path) -> None:
    done = dishmap("pattern", "grid", "--columns", 8, "--rows", 7, "--pitch-mm", 12, *words, "--out", tmp_path / "grid.json")
    assert done.exit_code == 2
    assert said in done.stderr
    assert not list(tmp_path.iterdir())


def test_pattern_mistakes(tmp_path: Path) -> None:
    words = ["pattern", "plate", "--rows", 3, "--columns", 4, "--out", tmp_path / "p.json"]
    assert "too small" in refused(dishmap(*words, "--pitch-mm", 20))
    done = dishmap(*words, "--pitch-mm", 40, "--kind", "disc", "--side-mm", 3)
    assert (done.exit_code, "--side-mm is no size of --kind disc, which takes --radius-mm" in done.stderr) == (2, True)
    for number in ("nan", "-3", "0", "inf", "many"):
        assert dishmap(*words, "--pitch-mm", number).exit_code == 2
    assert list(tmp_path.iterdir()) == []


def test_simulate_writes_what_map_reads(shot: Path) -> None:
    scenario = read_scenario(shot.parent / "scenario.toml")
    name, expected = next(iter(simulate_states(scenario)))
    assert (read_gray(shot / f"{name}.png") == expected.image).all()
    truth = read_truth(shot / "truth.csv")[f"{name}.png"]
    assert truth.center_mm == pytest.approx(expected.truth.center_mm, abs=1e-9)
    scene = scenario.states[0].scene
    assert read_camera(shot / "camera.yaml").parameters == pytest.approx(scene.camera.parameters)
    assert len(read_pattern(shot / "pattern.json")) == 20
    pose = read_pose(shot / "pose.json", "camera_from_dish")
    assert pose.rotation == pytest.approx(scene.camera_from_dish.rotation, abs=1e-9)


def test_simulate_makes_each_state_with_its_own_noise(shot: Path, tmp_path: Path) -> None:
    text = (shot.parent / "scenario.toml").read_text()
    (tmp_path / "two.toml").write_text(text.replace('[{ name = "ref" }]', '[{ name = "ref" }, { name = "again" }]'))
    done = dishmap("simulate", tmp_path / "two.toml", "--out", tmp_path / "two")
    assert done.exit_code == 0, done.stderr
    scenario = read_scenario(tmp_path / "two.toml")
    for name, expected in simulate_states(scenario):
        assert (read_gray(tmp_path / "two" / f"{name}.png") == expected.image).all()
    assert "try: dishmap map" in done.stdout
    assert "the scenario's own folder" in refused(dishmap("simulate", tmp_path / "two.toml", "--out", tmp_path))


def test_undistort_takes_the_lens_out(shot: Path, tmp_path: Path) -> None:
    out, camera_out = tmp_path / "flat.tif", tmp_path / "flat.yaml"
    words = ["undistort", shot / "ref.png", "--camera", shot / "camera.yaml", "--zoom", 0.9, "--out", out, "--camera-out", camera_out]
    assert dishmap(*words).exit_code == 0
    camera, flat = read_camera(shot / "camera.yaml"), read_camera(camera_out)
    assert flat.focal_px == pytest.approx(0.9 * camera.focal_px)
    assert not flat.distortion.any()
    # an independent one: OpenCV's
    image = read_gray(shot / "ref.png")
    grid = cv2.initUndistortRectifyMap(camera.matrix, camera.distortion, None, flat.matrix, (640, 480), cv2.CV_32FC1)
    expected = cv2.remap(image, grid[0], grid[1], cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_CONSTANT)
    assert np.abs(read_gray(out).astype(int) - expected).mean() < 0.1
    assert "must end in one of .png" in refused(dishmap(*words[:-3], tmp_path / "flat.xyz"))


def test_calibrate_writes_a_camera_and_says_how_good_it_is(tmp_path: Path) -> None:
    photos = board_photographs(tmp_path)
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((480, 640), 128, np.uint8))
    out = tmp_path / "camera.yaml"
    words = ["calibrate", *photos, blank, "--board", "chessboard", "--corners", "9x7", "--square-mm", 10, "--lens", "4", "--out", out]
    done = dishmap(*words)
    assert done.exit_code == 0, done.stderr
    assert "blank.png was left out: the photograph is blank; it needs to show the board." in done.stdout
    assert "8 of 9 photographs used" in done.stdout
    assert len(re.findall(r"view\d.png +63/63 +0\.\d+", done.stdout)) == 8
    camera = read_camera(out)
    assert camera.covariance is not None
    sigma = np.sqrt(np.diag(camera.covariance))[:2]
    assert np.abs(camera.focal_px - 700).max() < 5 * sigma.max()
    assert sigma.max() < 7
    assert len(read_views(out)) == 8


def test_calibrate_mistakes(shot: Path, tmp_path: Path) -> None:
    out = tmp_path / "camera.yaml"
    words = ["--square-mm", 10, "--out", out]
    assert "no photograph shows the board" in refused(dishmap("calibrate", shot / "ref.png", "--corners", "5x7", *words))
    assert "given twice" in refused(dishmap("calibrate", shot / "ref.png", shot / "ref.png", "--corners", "5x7", *words))
    assert "not a picture" in refused(dishmap("calibrate", shot / "camera.yaml", "--corners", "5x7", *words))
    assert "in millimetres?" in refused(dishmap("calibrate", shot / "ref.png", "--corners", "14x19", "--square-mm", 25000, "--out", out))
    for corners in ("14", "14x", "axb", "14x19x3"):
        done = dishmap("calibrate", shot / "ref.png", "--corners", corners, *words)
        assert (done.exit_code, "is not of the form 14x19" in done.stderr) == (2, True)
    assert list(tmp_path.iterdir()) == []


# Sizes of the shape that no photograph holds (the sag between ribs at the very rim), in gain.
GAIN_ROUNDING_DB = 0.01


@pytest.mark.usefixtures("short_report")
def test_demo_compares_with_the_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from dataclasses import replace

    # the same scene by a camera with fewer pixels
    scene = demo.demo_scene()
    small = Camera(1536, 1152, scene.camera.focal_px / 3, scene.camera.principal_px / 3, scene.camera.distortion)
    monkeypatch.setattr(demo, "demo_scene", lambda: replace(scene, camera=small, background=()))
    monkeypatch.setattr(demo_gain, "FREQUENCIES_GHZ", (12.5,))
    monkeypatch.setattr("dishmap.rf_report.rf_report", lambda analysis, title, inputs: title)
    done = dishmap("demo", "--out", tmp_path / "demo")
    assert done.exit_code == 0, done.stderr
    names = {path.name for path in (tmp_path / "demo").iterdir()}
    results = {"points.csv", "points.ply", "surface.json", "summary.json", "report.html", "measurement.npz", "change", "gain"}
    assert names == {"photograph.png", "later.png", "camera.yaml", "pattern.json", "antenna.toml", "truth.csv", *results}
    assert "130 of 130 targets measured" in done.stdout
    (inside,) = re.findall(r"z \(depth\) mm +[\d.]+ +[\d.]+ +(\d+)%", done.stdout)
    # 95 in 100 of 130 are 117 to 130 (4 sigma)
    assert int(inside) >= 88
    # from photograph to corrected gain: claims are set beside the truth, and hold
    rows = re.findall(r"(?:lost|won back) at 12.5 GHz, dB +([\d.]+) ± ([\d.]+) +([\d.]+)", done.stdout)
    assert len(rows) == 2
    for claimed, sigma, true in ((float(cell) for cell in row) for row in rows):
        assert abs(claimed - true) < 4 * sigma + GAIN_ROUNDING_DB
    again = re.findall(r"dishmap ((?:map|diff|rf) .*)", done.stdout)
    assert [words.split()[0] for words in again] == ["map", "diff", "rf"]
    assert dishmap(*again[0].split()).exit_code == 0


def test_writing_a_camera_and_mapping_with_it_needs_no_other_words(shot: Path, tmp_path: Path) -> None:
    # the fewest words of the README, with a camera that OpenCV itself has written
    camera = read_camera(shot / "camera.yaml")
    storage = cv2.FileStorage(str(tmp_path / "cv.yaml"), cv2.FILE_STORAGE_WRITE)
    for key, value in (("image_width", 640), ("image_height", 480), ("camera_matrix", camera.matrix)):
        storage.write(key, value)
    storage.write("distortion_coefficients", camera.distortion[:, None])
    storage.release()
    words = map_words(shot)
    words[words.index("--camera") + 1] = tmp_path / "cv.yaml"
    assert "could sit in 2 ways" in refused(dishmap(*words, "--out", tmp_path / "out"))
    write_camera(tmp_path / "ours.yaml", camera)
    assert read_camera(tmp_path / "cv.yaml").parameters == pytest.approx(read_camera(tmp_path / "ours.yaml").parameters)
