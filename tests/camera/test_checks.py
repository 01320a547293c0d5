"""What is found out about a calibration: lens choice by hold-out, difference of halves, resampling, advice."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from boards import CORNERS, corner_views, wide_camera
from numpy.typing import NDArray

from dishmap.camera.advice import suggestions
from dishmap.camera.board import BoardView
from dishmap.camera.calibrate import Calibration, calibrate
from dishmap.camera.compare_cameras import camera_difference, halves_of, split_views, working_distance_mm
from dishmap.camera.lens_choice import choose_lens, held_out_errors
from dishmap.camera.model import Camera
from dishmap.camera.resample import resample
from dishmap.camera.uncertainty import covered_area, picture_grid, projection_error
from dishmap.errors import CameraError, InputError
from dishmap.transforms import Pose

Array = NDArray[np.float64]
CAMERA = wide_camera(75.0)


@cache
def made(count: int = 16, seed: int = 1) -> Calibration:
    return calibrate(corner_views(np.random.default_rng(seed), CAMERA, count), CAMERA.width_px, CAMERA.height_px)


@pytest.mark.parametrize(
    ("camera", "lens"),
    [
        (CAMERA, "opencv5"),
        (Camera(960, 720, [420.0, 421.0], [485.0, 352.0], [0.05, -0.02, 0.004, -0.001], "fisheye"), "fisheye"),
        (Camera(960, 720, [600.0, 601.0], [485.0, 352.0], [8.1, 4.2, 5e-4, -3e-4, 0.3, 8.5, 7.4, 1.4]), "opencv8"),
        (Camera(960, 720, [626.0, 627.0], [485.0, 352.0], [-0.2, 0.05, 5e-4, -3e-4, 0, 0, 0, 0, 0.02, -0.02, -0.015, 0.03]), "opencv12"),
    ],
)
def test_the_lens_is_found(camera: Camera, lens: str) -> None:
    views = corner_views(np.random.default_rng(3), camera, 20, 0.03)
    calibration, choice = choose_lens(views, 960, 720)
    assert choice.lens == calibration.lens == lens
    assert lens in choice.reason
    best = next(trial for trial in choice.trials if trial.lens == lens)
    # views that a camera never saw fit with the noise of corners: 0.03 px in each of two coordinates
    assert best.held_out_px == pytest.approx(0.03 * np.sqrt(2), rel=0.15)
    assert [trial.lens for trial in choice.trials] == ["opencv5", "fisheye", "opencv8", "opencv12"]


def test_held_out_views_fit_worse_than_their_own() -> None:
    calibration = made()
    errors = held_out_errors(calibration, [f"{k}" for k in range(17)])
    assert np.isnan(errors[16])
    assert errors[:16].mean() > calibration.view_rms_px.mean()
    assert errors[:16].mean() < 1.3 * calibration.view_rms_px.mean()


def test_few_views_take_the_leanest_lens() -> None:
    calibration, choice = choose_lens(corner_views(np.random.default_rng(4), CAMERA, 6), 960, 720)
    assert calibration.lens == "opencv5"
    assert "6 views are too few to hold some out (8 are needed)" in choice.reason
    with pytest.raises(InputError, match="at least 3 in different directions"):
        choose_lens([], 960, 720)


def test_views_from_one_side_take_the_leanest_lens() -> None:
    rng, views, middle = np.random.default_rng(8), [], CORNERS.mean(axis=0)
    warp = rng.normal(size=(len(CORNERS), 3)) * [0.1, 0.1, 0.0]  # mm, the print
    while len(views) < 16:
        pose = Pose.from_rotation_vector(np.append(rng.uniform(-0.09, 0.09, 2), 0.0), np.append(rng.uniform(-30, 30, 2), 260))
        pixels = CAMERA.project(pose.apply(CORNERS - middle + warp)) + rng.normal(size=(len(CORNERS), 2)) * 0.01
        if CAMERA.contains(pixels).all():
            views.append(BoardView(f"{len(views)}", pixels, CORNERS))
    calibration, choice = choose_lens(views, 960, 720)
    assert calibration.lens == "opencv5"
    assert "a richer lens model would learn the errors of the print" in choice.reason


def test_motion_between_cameras_is_no_difference() -> None:
    rays = CAMERA.unproject(picture_grid(960, 720, (4, 5)))
    assert np.isfinite(rays).all()
    same = camera_difference(CAMERA, CAMERA, 700.0)
    assert same.length_px.max() < 1e-6
    moved = replace(CAMERA, principal_px=CAMERA.principal_px + [3.0, -2.0])
    far, near = camera_difference(CAMERA, moved, np.inf), camera_difference(CAMERA, moved, 700.0)
    # a shift of the principal point is a turn, but for the distortion, which moves too
    assert far.covered_rms_px < 1.0
    assert near.covered_rms_px <= far.covered_rms_px
    longer = replace(CAMERA, focal_px=CAMERA.focal_px * 1.01)
    # a longer focal length is a shift along the axis for points in a plane, again but for the distortion
    assert camera_difference(CAMERA, longer, 700.0).covered_rms_px < 0.5 * camera_difference(CAMERA, longer, np.inf).covered_rms_px


def test_cameras_of_different_pictures_are_not_compared() -> None:
    with pytest.raises(CameraError, match="cameras of 960x720 and 480x360 px cannot be compared"):
        camera_difference(CAMERA, wide_camera(75.0, 480, 360), 700.0)


def test_halves_differ_by_what_their_sigmas_say() -> None:
    calibration = made(20)
    halves = halves_of(calibration)
    assert halves is not None
    assert np.abs(halves.focal_sigmas).max() < 3
    predicted = [projection_error(c, (24, 32), distance_mm=halves.distance_mm, covered=halves.difference.covered) for c in halves.cameras]
    covered = halves.difference.covered
    expected = np.sqrt(np.mean(sum(p.sigma_px[covered] ** 2 for p in predicted)))
    # one draw of some ten parameters: within a factor of two
    assert 0.4 < halves.difference.covered_rms_px / expected < 2.0
    assert [len(half) for half in split_views(calibration.views)] == [10, 10]
    assert halves_of(replace(calibration, views=calibration.views[:5])) is None


def test_the_covered_area_is_where_corners_are() -> None:
    pixels = picture_grid(960, 720)
    covered = covered_area(pixels, np.array([[480.0, 360.0]]))
    # within one and a half cells of 31 and 31 px
    assert 4 <= covered.sum() <= 9
    assert np.linalg.norm(pixels[covered] - [480, 360], axis=-1).max() < 45


def test_resampling_scatters_as_claimed() -> None:
    known = resample(made(), np.random.default_rng(0), 100)
    assert known is not None
    # 100 refits of a dozen parameters: the ratio of rms values scatters by some 4 %
    assert known.ratio == pytest.approx(1.0, abs=0.15)
    assert known.covered_rms_px < 0.1
    # it can fail: a claim that is too small by a third is seen
    camera = made().camera
    assert camera.covariance is not None
    bold = replace(made(), camera=replace(camera, covariance=camera.covariance * 0.45))
    doubted = resample(bold, np.random.default_rng(0), 60)
    assert doubted is not None
    assert doubted.ratio > 1.25


def test_resampling_follows_noise_that_views_share() -> None:
    rng = np.random.default_rng(5)
    views = []
    for view in corner_views(rng, CAMERA, 20, 0.05):
        across = (view.board_mm[:, :2] - view.board_mm[:, :2].mean(axis=0)) / 110
        bend = rng.normal(size=(3, 2)) * 0.3
        warp = np.stack([across[:, 0] ** 2, across.prod(axis=1), across[:, 1] ** 2], axis=1) @ bend
        views.append(replace(view, pixels=view.pixels + warp))
    calibration = calibrate(views, 960, 720)
    assert calibration.inflation > 1.5
    known = resample(calibration, np.random.default_rng(1), 100)
    assert known is not None
    assert known.ratio == pytest.approx(1.0, abs=0.15)


def test_advice_lowers_the_error_as_promised() -> None:
    """Views in one corner of the picture only: the advice sends the board elsewhere, and taking it helps by what it says."""
    rng = np.random.default_rng(6)
    left = [view for view in corner_views(rng, CAMERA, 60) if view.pixels[:, 0].mean() < 430][:12]
    calibration = calibrate(left, 960, 720)
    advice = suggestions(calibration)
    assert "right" in advice[0].words
    assert advice[0].after_px < 0.8 * advice[0].before_px
    assert [a.after_px for a in advice] == sorted((a.after_px for a in advice), reverse=True)
    distance = working_distance_mm(calibration)
    now = projection_error(calibration.camera, (9, 12), distance_mm=distance).rms_px
    assert now == pytest.approx(advice[0].before_px, rel=0.35)


def test_autofocus_is_noticed() -> None:
    rng, views = np.random.default_rng(7), []
    middle = CORNERS.mean(axis=0)
    while len(views) < 14:
        focus = replace(CAMERA, focal_px=CAMERA.focal_px * (1 + 0.02 * rng.normal()))
        turn = np.append(rng.uniform(-0.7, 0.7, 2), rng.uniform(-0.5, 0.5))
        pose = Pose.from_rotation_vector(turn, np.append(rng.uniform(-60, 60, 2), rng.uniform(230, 320)))
        pixels = focus.project(pose.apply(CORNERS - middle)) + rng.normal(size=(len(CORNERS), 2)) * 0.05
        if focus.contains(pixels).all():
            views.append(BoardView(f"{len(views)}", pixels, CORNERS))
    notes = calibrate(views, 960, 720).notes
    assert any("the focal length seems to differ from view to view by" in note for note in notes)
    assert not any("focal length seems" in note for note in made().notes)
