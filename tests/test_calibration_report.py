"""The report of a calibration: it says what was checked, what is doubtful and what to do next; its pictures can be drawn."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from dishmap.calibration_report import Checks, calibration_report, headline, remarks_on
from dishmap.camera.advice import suggestions
from dishmap.camera.board import SHAPE_TERMS
from dishmap.camera.calibrate import Calibration, calibrate
from dishmap.camera.compare_cameras import halves_of
from dishmap.camera.lens_choice import choose_lens
from dishmap.camera.model import Camera
from dishmap.camera.resample import resample
from dishmap.io.camera_file import read_views, write_camera
from dishmap.plot.calibration import distortion_map, field_maps, residual_vectors

sys.path.insert(0, str(Path(__file__).parent / "camera"))
from boards import corner_views, wide_camera

CAMERA = wide_camera(75.0)


@cache
def made() -> tuple[Calibration, Checks]:
    views = corner_views(np.random.default_rng(1), CAMERA, 12)
    calibration, choice = choose_lens(views, 960, 720)
    sampled = resample(calibration, np.random.default_rng(0), 10)
    return calibration, Checks(choice, halves_of(calibration), sampled, suggestions(calibration))


def test_the_page_says_what_was_checked() -> None:
    calibration, checks = made()
    image = np.full((720, 960), 120, np.uint8)
    html = calibration_report(calibration, "A <camera>", checks, image, {"photographs": "a & b"})
    assert checks.halves is not None
    assert checks.resampled is not None
    for words in ("A &lt;camera&gt;", "a &amp; b", "What to photograph next", "Two halves differ by", "Sampled over claimed", "(chosen)"):
        assert words in html
    assert html.count("<img ") == 6
    # the photograph lies under the map of expected errors
    assert "data:image/jpeg" in html
    assert calibration_report(calibration, "A <camera>", checks, image, {"photographs": "a & b"}) == html
    assert f"Shapes at {checks.resampled.distance_mm:.0f} mm are projected to" in headline(calibration, checks)
    assert not re.search(r"https?://(?!www\.w3\.org)", re.sub(r"data:[^\"']+", "", html))


def test_doubts_are_said() -> None:
    calibration, checks = made()
    assert checks.resampled is not None
    assert checks.halves is not None
    known = replace(checks.resampled, sampled_px=2 * checks.resampled.predicted_px)
    halves = replace(checks.halves, focal_sigmas=np.array([4.0, -5.0]))
    said = " ".join(remarks_on(calibration, replace(checks, resampled=known, halves=halves)))
    assert "Resampling scatters 2.00 times as much as claimed" in said
    assert "differ by 5.00 sigmas: was the focus fixed" in said
    said = " ".join(remarks_on(replace(calibration, view_weight=np.array([0.3, *[1.0] * 11]), rejected={"x.jpg": "it is blurred"}), checks))
    assert "Noisier than the other views, and weighed down: 0 (30%)" in said
    assert "x.jpg was left out: it is blurred." in said


def test_what_the_camera_says_of_the_print_is_said() -> None:
    calibration, checks = made()
    assert not any("fx and fy" in said or "from square" in said or "would be" in said for said in remarks_on(calibration, checks))
    # a printer that makes squares 1.5 % taller, and the file as designed
    rng = np.random.default_rng(2)
    views = [replace(view, board_mm=view.board_mm / [1, 1.015, 1]) for view in corner_views(rng, CAMERA, 12)]
    said = " ".join(remarks_on(calibrate(views, 960, 720, flat=True), Checks()))
    assert re.search(r"fx and fy differ by [01]\.\d%, and .* are the squares of the board square\? Measure its scale", said)
    # where the board may be stretched, it is
    said = " ".join(remarks_on(calibrate(views, 960, 720), Checks()))
    assert re.search(r"The board's squares seem to be 1\.[3-6]% from square: .* Measure its scale along x and along y", said)
    assert "fx and fy" not in said


@pytest.mark.parametrize(("unit", "size"), [(1 / 25.4, "7.87x5.51"), (0.1, "20x14"), (25.4, "5080x3556")])
def test_sizes_in_other_units_are_noticed(unit: float, size: str) -> None:
    """A board of 200x140 mm given in inches or centimetres as if they were mm, or in mm times 25.4."""
    calibration, _ = made()
    views = [replace(view, board_mm=view.board_mm * unit) for view in calibration.views]
    said = " ".join(remarks_on(calibrate(views, 960, 720), Checks()))
    assert f"The board would be {size} mm" in said
    assert "its size was not given in millimetres" in said


def test_photographs_without_a_board_are_named_on_the_page() -> None:
    calibration, _ = made()
    checks = Checks(not_found={"blank.png": "the photograph is blank"})
    html = calibration_report(calibration, "camera", checks)
    assert "blank.png was left out: the photograph is blank." in html
    assert "12 of 13" in html
    assert "200x140" in html


def test_a_bent_board_and_lost_corners_are_said() -> None:
    calibration, checks = made()
    bent = replace(calibration.board, shape_mm=np.eye(len(SHAPE_TERMS))[0], covariance_mm2=np.eye(len(SHAPE_TERMS)) * 1e-4)
    used = (np.arange(88) > 5, *calibration.used[1:])
    said = " ".join(remarks_on(replace(calibration, board=bent, used=used), checks))
    assert "The board is not flat, by 1.00 mm" in said
    assert re.search(r"0: 6 corners left out: \(0, 0\) mm, [\d.]+ px off; .* and 2 more\.", said)
    flat = calibrate(calibration.views, 960, 720, flat=True)
    assert "The board was taken as flat and printed exactly." in calibration_report(flat, "flat", Checks())


@pytest.mark.parametrize("model", ["opencv", "fisheye"])
def test_pictures_of_any_lens(model: str) -> None:
    camera = Camera(640, 480, [120.0, 121.0], [320.0, 240.0], [0.05, -0.01, 0.003, -0.0005], model)
    assert distortion_map(camera).startswith("<svg")
    assert distortion_map(Camera(640, 480, [500.0, 500.0], [320.0, 240.0])).startswith("<svg")


def test_pictures_of_nothing() -> None:
    pixels = np.stack(np.meshgrid([-0.5, 99.5], [-0.5, 79.5]), axis=-1)
    nothing = np.full((2, 2), np.nan)
    assert field_maps(pixels, [("", nothing)], np.zeros((2, 2), bool), "px").startswith("<svg")
    assert field_maps(pixels, [("", np.zeros((2, 2)))], np.ones((2, 2), bool), "px").startswith("<svg")
    used = np.ones(3, bool)
    assert residual_vectors(np.zeros((3, 2)), np.zeros((3, 2)), used, 100, 80).startswith("<svg")


def test_circles_are_kept_in_the_camera_file(tmp_path: Path) -> None:
    calibration, _ = made()
    views = tuple(replace(view, radius_mm=np.full(88, 5.0)) for view in calibration.views)
    write_camera(tmp_path / "camera.yaml", calibration.camera, replace(calibration, views=views))
    assert [view.radius_mm.tolist() for view in read_views(tmp_path / "camera.yaml") if view.radius_mm is not None] == [[5.0] * 88] * 12
