"""From paper to camera: boards are printed by an uneven printer, photographed, and calibrated with the file that says what came out."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from cli_words import dishmap, refused

from dishmap.camera.model import Camera
from dishmap.io.camera_file import read_camera

sys.path.insert(0, str(Path(__file__).parents[1] / "camera"))
sys.path.insert(0, str(Path(__file__).parents[1] / "sheet"))
from printing import needs_poppler
from prints import print_photographs

CAMERA = Camera(640, 480, [500.0, 501.0], [322.0, 237.0], [-0.2, 0.06, 0.0005, -0.0003, -0.005])
# What the printer does to lengths along x and y.
SCALE = (0.985, 1.003)
# The uneven print makes fx / fy wrong by 1.8 %, a ninth of that is what six views must tell apart.
RATIO = 0.002


@needs_poppler
@pytest.mark.usefixtures("no_checks")
@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("chessboard", ["--corners", "11x7", "--square-mm", 20]),
        ("charuco", ["--corners", "11x7", "--square-mm", 20, "--dictionary", "4x4_250"]),
        ("circles", ["--grid", "11x7", "--pitch-mm", 22]),
    ],
)
def test_a_board_as_printed(kind: str, words: list[object], tmp_path: Path) -> None:
    sheet = ["sheet", "board", "--kind", kind, *words, "--out", tmp_path]
    bars = "x".join(f"{100 * part:g}" for part in SCALE)
    for more in ([], ["--measured-mm", bars]):
        done = dishmap(*sheet, *more)
        assert done.exit_code == 0, done.stderr
    assert ("circles are ellipses by 1.79%" in done.stdout) == (kind == "circles")
    name = "pattern" if kind == "circles" else "board"
    photos = print_photographs(tmp_path / "sheets.pdf", CAMERA, 6, SCALE)
    done = dishmap("calibrate", *photos, "--board", tmp_path / f"{name}-printed.json", "--lens", 5, "--out", tmp_path / "camera.yaml")
    assert done.exit_code == 0, done.stderr
    assert "6 of 6 photographs used" in done.stdout
    camera = read_camera(tmp_path / "camera.yaml")
    assert camera.covariance is not None
    sigma = np.sqrt(np.diag(camera.covariance))[:2]
    assert (np.abs(camera.focal_px - CAMERA.focal_px) < 5 * sigma + 0.05).all()
    assert camera.focal_px[0] / camera.focal_px[1] == pytest.approx(CAMERA.focal_px[0] / CAMERA.focal_px[1], rel=RATIO)
    if kind == "chessboard":  # the file as designed is wrong, and is said to be
        done = dishmap("calibrate", *photos, "--board", tmp_path / "board.json", "--lens", 5, "--out", tmp_path / "wrong.yaml")
        uneven = re.search(r"The board's squares seem to be ([\d.]+)% from square", done.stdout)
        # to a tenth of it: six views, and the middle of two sides is not one of them
        assert uneven is not None
        assert float(uneven.group(1)) == pytest.approx(100 * (SCALE[1] / SCALE[0] - 1), rel=0.1)
        listed = dishmap("calibrate", *photos, "--board", tmp_path / "sheets.json", "--out", tmp_path / "listed.yaml")
        assert "sheets.json lists the sheets; give board.json beside it" in refused(listed)
