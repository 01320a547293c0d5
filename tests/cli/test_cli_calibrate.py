"""`dishmap calibrate` with boards of circles, other formats, and mistakes: one sentence and exit code 2."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from cli_words import dishmap, refused

from dishmap.camera import charuco
from dishmap.camera.model import Camera
from dishmap.cli import board_options
from dishmap.cli import calibrate as words_of
from dishmap.io.camera_file import read_camera, read_views
from dishmap.io.camera_formats import SUFFIXES
from dishmap.io.pattern_file import write_pattern
from dishmap.sheet import boards
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene, Sensor
from dishmap.transforms import Pose

CAMERA = Camera(640, 480, [520.0, 521.0], [322.0, 237.0], [-0.2, 0.06, 0.0005, -0.0003, -0.005])
BOARD = boards.rings_board((7, 5), 20.0)


@pytest.fixture(scope="module")
def ring_photographs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Ten photographs of a ring board and one of another size's name, none of it."""
    folder, rng, names = tmp_path_factory.mktemp("rings"), np.random.default_rng(1), []
    while len(names) < 10:
        turn = Pose.from_rotation_vector(np.append(rng.uniform(-0.6, 0.6, 2), rng.uniform(-0.4, 0.4)), np.zeros(3)).rotation
        pose = Pose(turn @ np.diag([1.0, -1.0, -1.0]), np.append(rng.uniform(-25, 25, 2), rng.uniform(170, 230)))
        if not CAMERA.contains(CAMERA.project(pose.apply(BOARD.center_mm)), 14.0).all():
            continue
        names.append(folder / f"ring{len(names)}.png")
        cv2.imwrite(str(names[-1]), simulate(Scene(BOARD, CAMERA, pose, sensor=Sensor(noise_grey=1.0)), rng).image)
    return names


def test_the_words_are_those_of_the_library() -> None:
    assert board_options.BOARDS == boards.BOARDS == tuple(board_options.TAKES)
    assert board_options.DICTIONARIES == charuco.DICTIONARIES
    assert set(words_of.FORMATS) == set(SUFFIXES)


def test_a_ring_board(ring_photographs: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "camera.yaml"
    done = dishmap(
        *["calibrate", *ring_photographs, "--board", "rings", "--corners", "7x5", "--square-mm", 20, "--lens", 5],
        *["--format", "mrcal", "--format", "ros", "--working-mm", 500, "--out", out],
    )
    assert done.exit_code == 0, done.stderr
    camera = read_camera(out)
    assert camera.covariance is not None
    assert np.abs(camera.focal_px - CAMERA.focal_px).max() < 5 * np.sqrt(np.diag(camera.covariance))[:2].max()
    # what a chessboard of as many corners would not give: a few hundredths of a pixel in the focal length
    assert np.abs(camera.focal_px - CAMERA.focal_px).max() < 0.3
    for suffix in (".cameramodel", ".ros.yaml"):
        assert read_camera(out.with_suffix(suffix)).parameters.tolist() == camera.parameters.tolist()
    assert len(read_views(out)) == 10
    page = out.with_suffix(".html").read_text()
    for heading in ("What to photograph next", "Expected projection error of the camera", "How well shapes are known", "Lens", "Board"):
        assert f"<h2>{heading}</h2>" in page
    # the distance at which the user will measure, in all that is said of it
    assert "Shapes at 500 mm are projected to" in done.stdout
    assert "Expected error of shapes at 500 mm" in page
    assert "the cameras from two halves of the views, at 500 mm" in page
    assert re.search(r"the scatter of \d+ refits", page)
    assert re.search(r"next: the board in ", done.stdout)


@pytest.mark.usefixtures("no_checks")
def test_a_pattern_file_as_board(ring_photographs: list[Path], tmp_path: Path) -> None:
    write_pattern(tmp_path / "board.json", BOARD)
    out = tmp_path / "camera.yaml"
    done = dishmap("calibrate", *ring_photographs, "--board", tmp_path / "board.json", "--out", out)
    assert done.exit_code == 0, done.stderr
    assert "lens: opencv5 is the leanest" in done.stdout or "lens: opencv5 has the smallest" in done.stdout
    assert np.abs(read_camera(out).focal_px - CAMERA.focal_px).max() < 0.3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--board", "rings", "--corners", "7x5"], "--board rings needs --corners and --square-mm"),
        (["--board", "hexagons"], "--board takes chessboard, charuco, circles, acircles, rings or a file that says what is printed"),
        (["--board", "board.json", "--corners", "7x5"], "a board's file says itself what is printed; leave out --corners"),
        (
            ["--board", "chessboard", "--corners", "7x5", "--square-mm", 20, "--radius-mm", 3],
            "--radius-mm means nothing to --board chessboard",
        ),
        (["--board", "rings", "--corners", "7x5", "--square-mm", 20, "--marker-mm", 3], "--marker-mm means nothing to --board rings"),
        (["--board", "nowhere.json"], "cannot read the board file nowhere.json: No such file"),
        (["--board", "sheets.pdf"], "or a file that says what is printed (board.json, pattern.json as"),
        (["--board", "chessboard", "--corners", "7x5", "--square-mm", 20, "--no-orientation-marks"], "--no-orientation-marks means"),
        (["--board", "chessboard", "--corners", "7x5", "--square-mm", 20, "--dictionary", "4x4_50"], "--dictionary means nothing to"),
        (["--board", "circles", "--corners", "7x5", "--square-mm", 20], "no photograph shows the board: ring0.png"),
        (["--board", "charuco", "--corners", "7x5", "--square-mm", 20], "only 0 corners of the ChArUco board were found"),
        (["--board", "rings", "--corners", "7x5", "--square-mm", 20, "--radius-mm", 12], "targets 0 and 1 touch"),
    ],
)
def test_mistakes(ring_photographs: list[Path], tmp_path: Path, words: list[object], message: str) -> None:
    done = dishmap("calibrate", *ring_photographs[:3], *words, "--out", tmp_path / "camera.yaml")
    assert done.exit_code == 2
    assert message in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("no_checks")
def test_a_format_that_cannot_hold_the_lens(ring_photographs: list[Path], tmp_path: Path) -> None:
    words = ["--board", "rings", "--corners", "7x5", "--square-mm", 20, "--lens", 5, "--format", "kalibr", "--out", tmp_path / "c.yaml"]
    assert "Kalibr's radtan lens has 4 coefficients, and this camera 5; calibrate with --lens 4" in refused(
        dishmap("calibrate", *ring_photographs, *words)
    )
    assert not list(tmp_path.iterdir())


def test_two_photographs_are_too_few(ring_photographs: list[Path], tmp_path: Path) -> None:
    words = ["--board", "rings", "--corners", "7x5", "--square-mm", 20, "--out", tmp_path / "c.yaml"]
    assert "2 view(s) of the board were given; at least 3" in refused(dishmap("calibrate", *ring_photographs[:2], *words))
