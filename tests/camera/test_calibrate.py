"""Calibration from simulated corners: noiseless exact, covariance as sampled, bad views and corners named; and the real boards."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.camera.adjustment import adjust
from dishmap.camera.board import SHAPE_TERMS, BoardView, bends_of
from dishmap.camera.bundle import BoardCorners, Bundle, Prior
from dishmap.camera.calibrate import LENSES, Calibration, calibrate
from dishmap.camera.chessboard import chessboard_mm, find_chessboard
from dishmap.camera.elimination import normal_equations, reduced, step_in_sigmas
from dishmap.camera.model import Camera
from dishmap.errors import InputError, MeasurementError
from dishmap.transforms import Pose

Array = NDArray[np.float64]

# px; without noise a prior of the width of the picture, worth a hundredth of a pixel, leaves this in focal lengths of 500 to 12000 px
EXACT_PX = 2e-3
EXACT_FIT_PX = 1e-6
# sigmas; OpenCV's least squares has no prior, and ours is worth this much
SAME_IN_SIGMAS = 0.02
BOARD = chessboard_mm((9, 6), 30.0)
WIDTH, HEIGHT = 1280, 960


def camera_of(focal: float, distortion: list[float], model: str = "opencv", scale: float = 1.0) -> Camera:
    size = np.array([WIDTH, HEIGHT]) * scale
    return Camera(int(size[0]), int(size[1]), np.array([focal, focal + 5]), size / 2 + [10, -9], np.array(distortion), model)


PLAIN = camera_of(1100.0, [-0.2, 0.08, 0.001, -0.0005, -0.02])
CAMERAS: dict[str, tuple[Camera, str, float]] = {
    "usual": (PLAIN, "opencv5", 900.0),
    "four terms": (camera_of(1100.0, [0.2, 0.1, 0.001, -0.0005]), "opencv4", 900.0),
    "90 degrees": (camera_of(640.0, [-0.28, 0.1, 0.001, -0.0005, -0.018]), "opencv5", 500.0),
    "16 megapixels": (camera_of(2700.0, [-0.25, 0.07, 0.0003, -0.0005, -0.008], scale=3.6), "opencv5", 600.0),
    "long lens": (camera_of(12000.0, [-0.1, 0.5, 0.001, -0.0005], scale=2.0), "opencv4", 4000.0),
    "fisheye 120": (camera_of(550.0, [0.02, -0.01, 0.003, -0.001], "fisheye"), "fisheye", 350.0),
    "fisheye 185": (camera_of(310.0, [0.05, -0.01, 0.003, -0.0005], "fisheye"), "fisheye", 250.0),
}


def simulated(
    rng: np.random.Generator,
    camera: Camera = PLAIN,
    count: int = 10,
    noise_px: float = 0.1,
    bend_mm: float = 0.0,
    distance_mm: float = 900.0,
    tilt_rad: float = 0.6,
    common_mm: Array | None = None,
) -> list[BoardView]:
    """Views of a board at random poses that put all of it in the picture.

    bend_mm: how far each view's board is bent, anew in each; common_mm (3,): bends that all views share.
    """
    middle = BOARD.mean(axis=0)
    across = (BOARD - middle) / np.ptp(BOARD, axis=0).max() * 2
    views: list[BoardView] = []
    while len(views) < count:
        rotation = np.append(rng.uniform(-tilt_rad, tilt_rad, 2), rng.uniform(-0.5, 0.5))
        ray = camera.unproject(
            rng.uniform([0.25 * camera.width_px, 0.25 * camera.height_px], [0.75 * camera.width_px, 0.75 * camera.height_px])
        )
        pose = Pose.from_rotation_vector(rotation, ray / ray[2] * distance_mm * rng.uniform(0.8, 1.4))
        printed = BOARD - middle
        a, b, c = rng.normal(size=3) * bend_mm
        printed[:, 2] += a * (across[:, 0] ** 2 - 0.3) + b * across[:, 0] * across[:, 1] + c * (across[:, 1] ** 2 - 0.15)
        if common_mm is not None:
            printed[:, 2] += bends_of(BOARD, middle[:2], np.ptp(BOARD, axis=0).max() / 2) @ common_mm
        pixels = camera.project(pose.apply(printed)) + rng.normal(size=(len(BOARD), 2)) * noise_px
        if camera.contains(pixels).all():
            views.append(BoardView(f"view {len(views)}", pixels, BOARD))
    return views


def run(views: list[BoardView], camera: Camera = PLAIN, lens: str = "opencv5") -> Calibration:
    return calibrate(views, camera.width_px, camera.height_px, lens)


def sigmas(calibration: Calibration) -> Array:
    assert calibration.camera.covariance is not None
    return np.sqrt(np.diag(calibration.camera.covariance))


@pytest.mark.parametrize("name", CAMERAS)
def test_noiseless_is_exact(name: str) -> None:
    camera, lens, distance = CAMERAS[name]
    made = run(simulated(np.random.default_rng(3), camera, noise_px=0.0, distance_mm=distance), camera, lens)
    assert made.rms_px < EXACT_FIT_PX
    assert np.abs(made.camera.parameters - camera.parameters).max() < EXACT_PX
    assert made.rejected == {}
    assert all(used.all() for used in made.used)


@pytest.mark.parametrize("name", ["usual", "90 degrees", "fisheye 120"])
def test_a_bent_board_is_learnt(name: str) -> None:
    camera, lens, distance = CAMERAS[name]
    bend = np.array([1.5, -0.6, 0.9])
    views = simulated(np.random.default_rng(4), camera, count=15, noise_px=0.02, distance_mm=distance, common_mm=bend)
    made, flat = run(views, camera, lens), calibrate(views, camera.width_px, camera.height_px, lens, flat=True)
    assert made.sigma_px == pytest.approx(0.02, rel=0.1)
    assert (np.abs(made.board.bend_mm - bend) < 4 * made.board.sigma_mm).all()
    assert (np.abs(made.camera.parameters - camera.parameters) < 4 * sigmas(made)).all()
    assert made.board.sigma_mm.max() < 0.1
    assert made.board.sag_mm == pytest.approx(np.ptp(square_heights(bend)), rel=0.1)
    # taken as flat the same corners miss by far more than their noise
    assert flat.sigma_px > 3 * made.sigma_px
    assert flat.board.bend_mm.tolist() == [0, 0, 0]


def square_heights(bend: Array) -> Array:
    x, y = np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41))
    return np.asarray(bend[0] * x**2 + bend[1] * x * y + bend[2] * y**2)


def test_a_noisy_view_weighs_less_and_keeps_sigmas_true() -> None:
    rng = np.random.default_rng(21)
    views = simulated(rng, count=12)
    noisy = replace(views[2], pixels=views[2].pixels + rng.normal(size=(len(BOARD), 2)) * 0.2)
    made = run([*views[:2], noisy, *views[3:]])
    assert made.rejected == {}
    assert made.view_weight[2] < 0.6
    assert np.median(made.view_weight) == 1.0
    assert made.sigma_px == pytest.approx(0.1, rel=0.1)


def test_outliers_are_named() -> None:
    views = simulated(np.random.default_rng(22), count=8)
    moved = views[3].pixels.copy()
    moved[11] += 5.0
    made = run([*views[:3], replace(views[3], pixels=moved), *views[4:]])
    assert list(made.outliers) == ["view 3"]
    assert made.outliers["view 3"][0].startswith("(60, 30) mm, 7")


def test_the_exactness_can_fail() -> None:
    views = simulated(np.random.default_rng(3), noise_px=0.0)
    moved = views[0].pixels.copy()
    moved[0] += 0.006  # under what counts as an outlier
    made = run([replace(views[0], pixels=moved), *views[1:]])
    assert made.rms_px > 10 * EXACT_FIT_PX


def test_poses_residuals_and_rms_belong_together() -> None:
    views = simulated(np.random.default_rng(5), count=8)
    made = run(views)
    assert made.view_names == tuple(view.name for view in views)
    for view, pose, residual, rms in zip(made.views, made.poses, made.residuals_px, made.view_rms_px, strict=True):
        assert np.allclose(view.pixels - made.camera.project(pose.apply(made.board.bent(view.board_mm))), residual, atol=1e-9)
        assert rms == pytest.approx(np.sqrt((residual**2).sum(axis=1).mean()))
    assert made.rms_px == pytest.approx(np.sqrt((made.view_rms_px**2).mean()))
    assert made.sigma_px == pytest.approx(0.1, rel=0.1)  # 864 numbers: 2.4 %


def test_same_camera_as_opencv_finds() -> None:
    views = simulated(np.random.default_rng(6), count=12, noise_px=0.2)
    board = [BOARD.astype(np.float32)] * 12
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-14)
    rms, matrix, distortion, *_ = cv2.calibrateCamera(
        board, [view.pixels.astype(np.float32) for view in views], (WIDTH, HEIGHT), np.eye(3), np.zeros(5), flags=0, criteria=criteria
    )
    made = calibrate(views, WIDTH, HEIGHT, flat=True)
    theirs = np.concatenate([matrix[[0, 1, 0, 1], [0, 1, 2, 2]], np.ravel(distortion)[:5]])
    assert (np.abs(made.camera.parameters - theirs) < SAME_IN_SIGMAS * sigmas(made)).all()
    assert made.rms_px == pytest.approx(rms, rel=1e-4)


@cache
def sampled(count: int, bend_mm: float, runs: int) -> tuple[Array, Array, Array]:
    """Errors (R, 9), covariances (R, 9, 9) and inflations (R,) of many small calibrations."""
    rng = np.random.default_rng(count)
    made = [run(simulated(rng, count=count, bend_mm=bend_mm)) for _ in range(runs)]
    errors = np.array([m.camera.parameters - PLAIN.parameters for m in made])
    return errors, np.array([m.camera.covariance for m in made]), np.array([m.inflation for m in made])


def coverage(errors: Array, covariances: Array) -> float:
    """How many errors lie within 1.96 sigma."""
    return float((np.abs(errors) < 1.96 * np.sqrt(np.einsum("nii->ni", covariances))).mean())


def chi_square(errors: Array, covariances: Array) -> float:
    """Mean squared Mahalanobis length over its number of parameters: 1 when covariances are true."""
    return float(np.mean([e @ np.linalg.solve(c, e) for e, c in zip(errors, covariances, strict=True)]) / errors.shape[1])


def test_claimed_covariance_is_true_for_independent_noise() -> None:
    errors, covariances, inflations = sampled(12, 0.0, 40)
    # 40 runs of 9 correlated parameters: the share within 1.96 sigma scatters by some 2 %
    assert 0.91 < coverage(errors, covariances) < 0.99
    assert 0.7 < chi_square(errors, covariances) < 1.3
    assert np.median(inflations) < 1.1
    # the test can fail: sigmas claimed too small by 1.4 are seen
    assert coverage(errors, covariances / 2) < 0.91


def test_claimed_covariance_is_true_for_boards_bent_anew_in_each_view() -> None:
    errors, covariances, inflations = sampled(12, 0.5, 40)
    assert 0.90 < coverage(errors, covariances) < 0.99
    assert 0.6 < chi_square(errors, covariances) < 1.6
    # plain least squares believes in sigmas that are three times too small here
    assert np.median(inflations) > 2
    plain = covariances / (inflations**2)[:, None, None]
    assert coverage(errors, plain) < 0.7


def test_more_views_make_smaller_sigmas() -> None:
    few, many = run(simulated(np.random.default_rng(8), count=8)), run(simulated(np.random.default_rng(8), count=32))
    assert 1.4 < np.median(sigmas(few) / sigmas(many)) < 3.6


@pytest.mark.parametrize("lens", ["opencv8", "opencv12"])
def test_terms_that_stand_in_for_each_other_do_not_run_away(lens: str) -> None:
    # a plain lens leaves k1 and k4 free to trade places
    camera, _, distance = CAMERAS["90 degrees"]
    made = run(simulated(np.random.default_rng(9), camera, count=15, distance_mm=distance), camera, lens)
    assert made.sigma_px == pytest.approx(0.1, rel=0.1)
    assert np.abs(made.camera.distortion).max() < 20
    assert (np.abs(made.camera.parameters[:4] - camera.parameters[:4]) < 4 * sigmas(made)[:4]).all()
    if lens == "opencv8":  # prism terms trade with the camera's attitude too, so with 12 only the sigmas can be right
        seen = np.concatenate([view.pixels for view in made.views])
        assert np.median(np.linalg.norm(made.camera.project(camera.unproject(seen)) - seen, axis=1)) < 1.0


@pytest.mark.parametrize(("share", "size_px"), [(0.05, 1.0), (0.05, 20.0), (0.12, 20.0)])
def test_outlier_corners_are_left_out(share: float, size_px: float) -> None:
    rng = np.random.default_rng(10)
    clean = simulated(rng, count=12)
    views, spoilt = [], []
    for view in clean:
        bad = rng.random(len(BOARD)) < share
        shift = rng.uniform(0, 2 * np.pi, len(BOARD))
        moved = view.pixels + bad[:, None] * size_px * np.stack([np.cos(shift), np.sin(shift)], axis=1)
        views.append(replace(view, pixels=np.clip(moved, 0, [WIDTH - 1, HEIGHT - 1])))
        spoilt.append(bad)
    made, best = run(views), run(clean)
    assert np.concatenate(made.used).tolist() == (~np.concatenate(spoilt)).tolist()
    assert made.rejected == {}
    assert made.sigma_px == pytest.approx(0.1, rel=0.1)
    assert (np.abs(made.camera.parameters - best.camera.parameters) < 1.5 * sigmas(best)).all()


@pytest.mark.parametrize("kind", ["shuffled", "transposed", "random", "blurred"])
def test_a_bad_view_is_named_and_left_out(kind: str) -> None:
    rng = np.random.default_rng(11)
    views = simulated(rng, count=10)
    good = views[3].pixels
    bad = {
        "shuffled": rng.permutation(good),
        "transposed": good.reshape(6, 9, 2).swapaxes(0, 1).reshape(-1, 2),
        "random": rng.uniform(0, [WIDTH - 1, HEIGHT - 1], good.shape),
        "blurred": np.clip(good + rng.normal(size=good.shape) * 3, 0, [WIDTH - 1, HEIGHT - 1]),
    }[kind]
    made = run([*views[:3], replace(views[3], pixels=bad), *views[4:]])
    assert list(made.rejected) == ["view 3"]
    assert "times those of the typical view" in made.rejected["view 3"] or "of its corners are outliers" in made.rejected["view 3"]
    best = run([*views[:3], *views[4:]])
    assert (np.abs(made.camera.parameters - best.camera.parameters) < SAME_IN_SIGMAS * sigmas(best)).all()


def test_a_third_of_bad_views_is_survived() -> None:
    rng = np.random.default_rng(12)
    views = [replace(v, pixels=rng.permutation(v.pixels)) if k in (1, 4, 7, 9) else v for k, v in enumerate(simulated(rng, count=12))]
    made = run(views)
    assert sorted(made.rejected) == ["view 1", "view 4", "view 7", "view 9"]
    assert (np.abs(made.camera.parameters - PLAIN.parameters) < 5 * sigmas(made)).all()


def parallel(rng: np.random.Generator, tilt: Array, wobble_rad: float = 0.0) -> list[BoardView]:
    views: list[BoardView] = []
    while len(views) < 10:
        rotation = tilt + np.append(rng.uniform(-wobble_rad, wobble_rad, 2), 0.0)
        pose = Pose.from_rotation_vector(rotation, np.array([0, 0, 950.0]) + rng.uniform(-120, 120, 3))
        pixels = PLAIN.project(pose.apply(BOARD - BOARD.mean(axis=0))) + rng.normal(size=(54, 2)) * 0.1
        if PLAIN.contains(pixels).all():
            views.append(BoardView(f"{len(views)}", pixels, BOARD))
    return views


@pytest.mark.parametrize("tilt", [np.zeros(3), np.array([0.5, 0.0, 0.0])])
def test_views_in_one_direction_are_refused(tilt: Array) -> None:
    with pytest.raises(
        MeasurementError, match=r"all views show the board in one direction \(within [012].\d degrees\).* tilt the board by 20 to 40"
    ):
        run(parallel(np.random.default_rng(13), tilt))


def test_copies_of_one_view_are_refused() -> None:
    view = simulated(np.random.default_rng(14), count=1)[0]
    with pytest.raises(MeasurementError, match="all views show the board in one direction"):
        run([replace(view, name=f"copy {k}") for k in range(12)])


def test_views_that_hardly_differ_are_refused_or_noted() -> None:
    with pytest.raises(MeasurementError, match=r"the views do not determine \w\w \(sigma .* px at a focal length of .*\); add views"):
        run(parallel(np.random.default_rng(15), np.zeros(3), wobble_rad=0.05))
    made = run(simulated(np.random.default_rng(15), count=30, noise_px=0.02, tilt_rad=0.08))
    assert any("the board's directions differ by" in note for note in made.notes)


def test_weak_calibrations_say_so() -> None:
    made = run(simulated(np.random.default_rng(16), count=4, noise_px=0.02))
    assert any("only 4 views were used" in note for note in made.notes)
    assert any("of the picture; the camera is extrapolated elsewhere" in note for note in made.notes)
    assert run(simulated(np.random.default_rng(16), count=25)).notes == ()


def changed(views: list[BoardView], kind: str) -> list[BoardView]:
    rng = np.random.default_rng(0)
    if kind == "few":
        return views[:2]
    if kind == "same name":
        return [views[0], *views[1:], replace(views[1], name=views[0].name)]
    if kind == "few corners":
        return [BoardView(v.name, v.pixels[:8], v.board_mm[:8]) for v in views]
    if kind == "one row":
        return [BoardView(v.name, np.tile(v.pixels[:9], (2, 1)), np.tile(v.board_mm[:9], (2, 1))) for v in views]
    if kind == "curved":
        return [replace(v, board_mm=v.board_mm + np.outer(v.board_mm[:, 0] ** 2 / 500, [0, 0, 1])) for v in views]
    if kind == "all random":
        return [replace(v, pixels=rng.uniform(0, 900, v.pixels.shape)) for v in views]
    return [replace(v, pixels=rng.permutation(v.pixels)) for v in views]


@pytest.mark.parametrize(
    ("kind", "error", "message"),
    [
        ("few", InputError, r"2 view\(s\) of the board were given; at least 3 in different directions"),
        ("same name", InputError, "two views of the board have the same name"),
        ("few corners", InputError, "view view 0 has 8 corners; at least 12 are needed"),
        ("one row", InputError, "not spread over a flat board"),
        ("curved", InputError, "not spread over a flat board"),
        ("all random", MeasurementError, "are corners and board in the same order|do not determine"),
        ("all shuffled", MeasurementError, "are corners and board in the same order|do not determine"),
    ],
)
def test_impossible_input(kind: str, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message) as caught:
        run(changed(simulated(np.random.default_rng(17), count=8), kind))
    assert "\n" not in str(caught.value)


def test_corners_outside_the_picture_are_refused() -> None:
    views = simulated(np.random.default_rng(18), count=5)
    with pytest.raises(InputError, match=r"has corners outside a picture of 640x480 px; is it of another size\?"):
        calibrate(views, 640, 480)


def test_unknown_lens() -> None:
    with pytest.raises(InputError, match="unknown lens 'opencv6'; use one of opencv4, opencv5, opencv8, opencv12, fisheye"):
        run(simulated(np.random.default_rng(19), count=4), lens="opencv6")
    assert set(LENSES) == {"opencv4", "opencv5", "opencv8", "opencv12", "fisheye"}


# five lens terms, focal lengths and principal point, and the board's shape
SHARED = 9 + len(SHAPE_TERMS)


def small_bundle() -> tuple[Bundle, BoardCorners]:
    views = simulated(np.random.default_rng(20), count=4, noise_px=0.05)
    made = run(views)
    return made.bundle, made.problem.joined


def test_eliminating_the_poses_gives_the_whole_systems_answer() -> None:
    bundle, corners = small_bundle()
    rng = np.random.default_rng(0)
    free = np.ones(SHARED, dtype=bool)
    off = bundle.moved(free, bundle.shared * 1e-3, rng.normal(size=(4, 6)) * ([1e-3] * 3 + [0.3] * 3))
    prior = Prior(bundle.camera.parameters, 0.6, 0.1, np.ones(len(SHAPE_TERMS)))
    equations = normal_equations(off, corners, free, np.ones(len(corners.pixels)), prior)
    whole = np.zeros((SHARED + 24, SHARED + 24))
    side = np.zeros(SHARED + 24)
    whole[:SHARED, :SHARED], side[:SHARED] = (
        equations.shared.sum(axis=0) + np.diag(equations.prior),
        equations.shared_side.sum(axis=0) + equations.prior_side,
    )
    for v in range(4):
        own = slice(SHARED + 6 * v, SHARED + 6 + 6 * v)
        whole[:SHARED, own], whole[own, :SHARED], whole[own, own] = equations.mixed[v], equations.mixed[v].T, equations.pose[v]
        side[own] = equations.pose_side[v]
    answer = np.linalg.solve(whole, side)
    matrix, right, by_shared, plain = reduced(equations)
    shared = np.linalg.solve(matrix.sum(axis=0) + np.diag(equations.prior), right.sum(axis=0) + equations.prior_side)
    assert shared == pytest.approx(answer[:SHARED], rel=1e-4)  # curves of four views make the system nearly singular
    assert (plain - by_shared @ shared).ravel() == pytest.approx(answer[SHARED:], rel=1e-3, abs=1e-7)


def test_the_right_side_is_the_gradient() -> None:
    bundle, corners = small_bundle()
    free = np.ones(SHARED, dtype=bool)
    bundle = bundle.moved(free, bundle.shared * 1e-3, np.full((4, 6), 1e-2))
    prior = Prior(bundle.camera.parameters, 0.6, 0.1, np.ones(len(SHAPE_TERMS)))
    equations = normal_equations(bundle, corners, free, np.ones(len(corners.pixels)), prior)

    def cost(shared_step: Array, pose_steps: Array) -> float:
        return float((bundle.moved(free, shared_step, pose_steps).residuals(corners) ** 2).sum())

    for k in range(SHARED):
        step = np.eye(SHARED)[k] * 1e-6 * max(1.0, abs(bundle.shared[k]))
        slope = (cost(step, np.zeros((4, 6))) - cost(-step, np.zeros((4, 6)))) / (2 * step[k])
        assert slope == pytest.approx(-2 * equations.shared_side.sum(axis=0)[k], rel=1e-4)
    for k in range(6):
        poses = np.zeros((4, 6))
        poses[2, k] = 1e-6
        slope = (cost(np.zeros(SHARED), poses) - cost(np.zeros(SHARED), -poses)) / 2e-6
        assert slope == pytest.approx(-2 * equations.pose_side[2, k], rel=1e-4)


def test_a_fit_that_stopped_early_is_seen() -> None:
    bundle, corners = small_bundle()
    free, prior = np.ones(SHARED, dtype=bool), Prior(bundle.camera.parameters, 0.6, 0.1, np.ones(len(SHAPE_TERMS)))
    weights = np.ones(len(corners.pixels))
    off = bundle.moved(free, np.array([1.0, 1.0, *[0.0] * (SHARED - 2)]), np.zeros((4, 6)))
    assert step_in_sigmas(normal_equations(off, corners, free, weights, prior), 0.05) > 1
    back = adjust(off, corners, free, prior)
    assert step_in_sigmas(normal_equations(back, corners, free, weights, prior), 0.05) < 1e-3
    assert back.camera.parameters == pytest.approx(adjust(bundle, corners, free, prior).camera.parameters, rel=1e-4)


def test_corners_beyond_the_lens_do_not_stop_a_robust_fit() -> None:
    bundle, corners = small_bundle()
    behind = replace(bundle, translation_mm=bundle.translation_mm * np.array([[1.0], [1.0], [1.0], [-1.0]]))
    free, prior = np.ones(SHARED, dtype=bool), Prior(bundle.camera.parameters, 0.6, 0.3, np.ones(len(SHAPE_TERMS)))
    assert np.isnan(behind.residuals(corners)[-1]).all()
    back = adjust(behind, corners, free, prior, robust=True)
    assert np.isfinite(back.camera.parameters).all()
    assert np.abs(back.residuals(corners)[: 3 * len(BOARD)]).max() < 2


def test_real_boards(shared_data: Path) -> None:
    names = sorted((shared_data / "cylinder" / "boards").glob("*.jpg"))[::2]
    board = chessboard_mm((14, 19), 10.0)
    views = []
    for name in names:
        picture = cv2.imread(str(name), cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        views.append(BoardView(name.name, find_chessboard(picture.astype(np.uint8), (14, 19)), board))
    made = calibrate(views, 2464, 3280, flat=True)
    rms, matrix, *_ = cv2.calibrateCamera(
        [board.astype(np.float32)] * len(views), [v.pixels.astype(np.float32) for v in views], (2464, 3280), np.eye(3), np.zeros(5)
    )
    assert made.rejected == {}
    # noisy views weigh less here, which OpenCV does not know
    assert made.rms_px == pytest.approx(rms, rel=0.05)
    assert (np.abs(made.camera.matrix - matrix)[[0, 1, 0, 1], [0, 1, 2, 2]] < sigmas(made)[:4]).all()
    # the board is bent by hand, so corners of a view are far from independent
    assert made.inflation > 3
    bent = calibrate(views, 2464, 3280)
    assert bent.rms_px < made.rms_px
    assert bent.sigma_px < 0.31
