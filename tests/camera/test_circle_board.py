"""Boards of circles: labelled without a camera, never wrongly; solved without the bias of ellipse centres; measured in raw pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from boards import photographs, poses_in_view, wide_camera
from numpy.typing import NDArray

from dishmap.camera.board import OUTLINE_POINTS, BoardView, outline_shift
from dishmap.camera.board_labels import label_board
from dishmap.camera.calibrate import calibrate
from dishmap.camera.circle_board import find_circle_boards, measured_views
from dishmap.camera.compare_cameras import camera_difference
from dishmap.camera.model import Camera
from dishmap.errors import IdentityError, InputError, MeasurementError
from dishmap.sheet.boards import asymmetric_board, circles_board, rings_board
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene
from dishmap.targets.builders import dish, multi_circular, plate
from dishmap.targets.detect import find_ellipses
from dishmap.targets.pattern import Pattern

Array = NDArray[np.float64]

BOARDS = {
    "rings": rings_board((9, 7), 20.0),
    "circles": circles_board((9, 7), 20.0),
    "acircles": asymmetric_board((5, 9), 16.0),
    "groups": plate(4, 5, 34.0, multi_circular(), "multi4", True, "groups"),
}


@pytest.mark.parametrize("board", BOARDS)
@pytest.mark.parametrize("degrees", [40.0, 75.0, 105.0])
def test_labels_are_right(board: str, degrees: float) -> None:
    pattern, camera = BOARDS[board], wide_camera(degrees)
    labelled = 0
    for name, gray in (shots := photographs(np.random.default_rng(1), camera, pattern, 3))[0]:
        pose = shots[1][int(name[0])]
        found = find_ellipses(gray)
        try:
            labels = label_board(found, pattern, camera.width_px, camera.height_px)
        except IdentityError:
            continue
        labelled += 1
        off = found.center_px[labels.detection] - camera.project(pose.apply(pattern.marks.center_mm[labels.mark]))
        # perspective moves the centres of outlines by a pixel or two; a wrong name is a pitch off, over 20 px
        assert np.linalg.norm(off, axis=1).max() < 4
        assert len(labels.mark) > 0.85 * len(pattern.marks.target)
    assert labelled >= 2


def test_a_board_without_marks_is_taken_upright_if_all_of_it_is_seen() -> None:
    pattern, camera = circles_board((9, 7), 20.0, marks=False), wide_camera(60.0)
    pose = poses_in_view(np.random.default_rng(2), camera, pattern.center_mm, 1, 0.4)[0]
    found = find_ellipses(simulate(Scene(pattern, camera, pose), np.random.default_rng(0)).image)
    labels = label_board(found, pattern, 960, 720)
    assert len(labels.mark) == 63
    off = found.center_px[labels.detection] - camera.project(pose.apply(pattern.marks.center_mm[labels.mark]))
    assert np.linalg.norm(off, axis=1).max() < 4
    # of a larger board a part may lie anywhere
    with pytest.raises(
        IdentityError, match=r"could lie in \d+ ways over the 63 circles seen; show all of it, or print it with orientation"
    ):
        label_board(found, circles_board((11, 9), 20.0, marks=False), 960, 720)


def test_a_mirrored_photograph_is_refused() -> None:
    pattern, camera = BOARDS["rings"], wide_camera(60.0)
    gray = photographs(np.random.default_rng(3), camera, pattern, 1)[0][0][1]
    with pytest.raises(
        IdentityError, match=r"\d of them look unlike the marks of their places; check .* that the photograph is not mirrored"
    ):
        label_board(find_ellipses(np.ascontiguousarray(gray[:, ::-1])), pattern, 960, 720)


def test_another_board_is_refused() -> None:
    gray = photographs(np.random.default_rng(4), wide_camera(60.0), BOARDS["rings"], 1)[0][0][1]
    with pytest.raises(IdentityError):
        label_board(find_ellipses(gray), BOARDS["groups"], 960, 720)
    with pytest.raises(IdentityError, match="only 0 of 0 ellipses look like marks of the board"):
        label_board(find_ellipses(np.full((720, 960), 90, np.uint8)), BOARDS["rings"], 960, 720)


def test_the_shift_of_an_outline_is_that_of_its_area() -> None:
    camera = wide_camera(75.0)
    axes = np.array([[1.0, 0.0], [0.0, np.cos(0.7)], [0.0, np.sin(0.7)]])
    center, radius = np.array([60.0, 40.0, 300.0]), 12.0
    # the area's centre from many small pieces of the disc, each with the area that it has in the picture
    r, phi = (np.arange(200) + 0.5) / 200 * radius, 2 * np.pi * (np.arange(360) + 0.5) / 360
    flat = np.stack([np.outer(r, np.cos(phi)), np.outer(r, np.sin(phi))], axis=-1).reshape(-1, 2)
    pixels, by_point = camera.project_with_point_jacobian(center + flat @ axes.T)
    area = np.abs(np.linalg.det(by_point @ axes)) * np.linalg.norm(flat, axis=1)
    truth = (pixels * area[:, None]).sum(axis=0) / area.sum() - camera.project(center)
    made = outline_shift(camera, center[None], axes[None], np.array([radius]))[0]
    assert np.abs(truth).max() > 0.3
    # px: the pieces are small enough for this
    assert made == pytest.approx(truth, abs=1e-5)
    assert OUTLINE_POINTS == 24
    assert outline_shift(camera, center[None], axes[None], np.zeros(1)).tolist() == [[0.0, 0.0]]


def test_circles_are_solved_without_bias() -> None:
    camera, pattern = wide_camera(75.0), BOARDS["circles"]
    rng, views = np.random.default_rng(5), []
    for k, pose in enumerate(poses_in_view(rng, camera, pattern.center_mm, 12)):
        points = pose.apply(pattern.center_mm)
        radius = np.full(len(points), 6.0)
        shift = outline_shift(camera, points, np.tile(pose.rotation[:, :2], (len(points), 1, 1)), radius)
        pixels = camera.project(points) + shift + rng.normal(size=shift.shape) * 0.003
        views.append(BoardView(f"{k}", pixels, pattern.center_mm, radius))
    made = calibrate(views, 960, 720)
    naive = calibrate([replace(view, radius_mm=None) for view in views], 960, 720)
    assert made.camera.covariance is not None
    sigma = np.sqrt(np.diag(made.camera.covariance))
    assert (np.abs(made.camera.parameters - camera.parameters) < 4 * sigma).all()
    assert made.sigma_px == pytest.approx(0.003, rel=0.1)
    # taken as the images of centres, the same numbers give another camera
    assert (np.abs(naive.camera.parameters - camera.parameters) > 8 * sigma).any()


def test_a_ring_board_measured_in_raw_pixels_gives_the_camera() -> None:
    camera, pattern = wide_camera(75.0), BOARDS["rings"]
    shots, _ = photographs(np.random.default_rng(6), camera, pattern, 8)
    told: list[tuple[int, int]] = []
    search = find_circle_boards([*shots, ("blank.png", np.full((720, 960), 90, np.uint8))], pattern, 9, lambda a, b: told.append((a, b)))
    assert list(search.found.rejected) == ["blank.png"]
    assert told[-1] == (9, 9)
    rough = calibrate(search.found.views, 960, 720)
    views, lost = measured_views(shots, pattern, search, rough)
    assert lost == {}
    made = calibrate(views, 960, 720)
    seen = np.concatenate([view.pixels for view in views])
    # px at 1 m, where the goal is 0.02
    assert camera_difference(camera, made.camera, 1000.0, seen).covered_rms_px < 0.005
    assert made.sigma_px < 0.7 * rough.sigma_px


def test_what_is_no_board() -> None:
    gray = np.full((72, 96), 90, np.uint8)
    curved: Pattern = dish(300.0, 150.0)
    with pytest.raises(InputError, match="is not flat; a calibration board is a plane"):
        find_circle_boards([("a", gray)], curved)
    with pytest.raises(InputError, match="no photographs were given"):
        find_circle_boards([], BOARDS["rings"])
    with pytest.raises(MeasurementError, match="no photograph shows the board: a: only 0 of 0"):
        find_circle_boards([("a", gray)], BOARDS["rings"])
    with pytest.raises(InputError, match="a has 96x72 px and b 72x96: calibrate each size apart"):
        find_circle_boards([("a", gray), ("b", gray.T.copy())], BOARDS["rings"])
    with pytest.raises(InputError, match="needs a radius_mm of 0 or more for each circle"):
        BoardView("a", np.zeros((3, 2)), np.zeros((3, 3)), np.full(3, -1.0))


def test_camera_helper_is_as_wide_as_it_says() -> None:
    camera: Camera = wide_camera(75.0)
    assert np.degrees(2 * np.arctan(480 / camera.focal_px[0])) == pytest.approx(75.0)
