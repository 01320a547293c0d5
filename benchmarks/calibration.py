"""Calibration: simulated and real. Are parameters as wrong as they claim, and what is left of the projection error?

    scripts/bench calibration

Corners: many calibrations of 20 views by lenses of 75 and 110 degrees, chi-square of all parameters' errors together. Photographs: a
chessboard, found and fitted as in real ones; a ring board and a board of discs through the simulator, and what taking centres of outlines
for images of centres would cost. Real: the chessboard of data/cylinder (rms as OpenCV counts it and per coordinate as mrcal does; what the
residuals are made of; difference of two halves) and data/dotplate. Replica: corners made with the poses, print and motions found there.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from _common import QUICK, Array, data_folder, print_table

from dishmap.camera.board import BoardView
from dishmap.camera.calibrate import Calibration, calibrate
from dishmap.camera.chessboard import find_boards
from dishmap.camera.circle_board import find_circle_boards, measured_views
from dishmap.camera.compare_cameras import camera_difference, halves_of
from dishmap.camera.lens_choice import choose_lens
from dishmap.camera.problem import BEND_PART, STRETCH_PART
from dishmap.camera.resample import resample
from dishmap.io.images import read_gray
from dishmap.sheet.boards import circles_board, rings_board

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "camera"))
from boards import chessboard_photographs, corner_views, photographs, wide_camera
from dotplate import HEIGHT_PX, WIDTH_PX, survey

RUNS = 20 if QUICK else 200
VIEWS = 20
# `scripts/bench calibration PART...` runs only these functions.
ONLY = [name for name in sys.argv[1:] if not name.startswith("-")]
WORKING_MM = 1000.0
# Boards bow and stretch anew in each run, by as much as is thought possible of one of 200 mm.
BEND_MM, STRETCH_MM = BEND_PART * 100.0, STRETCH_PART * 100.0


def simulated_corners() -> None:
    rows = []
    for degrees in (75.0, 110.0):
        camera, rng = wide_camera(degrees, 1920, 1440), np.random.default_rng(int(degrees))
        scores, inside, shapes, ratio = [], [], [], []
        for run in range(RUNS):
            made = calibrate(corner_views(rng, camera, VIEWS, 0.1, BEND_MM, STRETCH_MM), 1920, 1440)
            error, covariance = made.camera.parameters - camera.parameters, made.camera.covariance
            assert covariance is not None
            scores.append(float(error @ np.linalg.solve(covariance, error)) / len(error))
            inside.append(float((np.abs(error) < 1.96 * np.sqrt(np.diag(covariance))).mean()))
            shapes.append(camera_difference(camera, made.camera, WORKING_MM, _seen(made.views)).covered_rms_px)
            if run < 5:
                known = resample(made, np.random.default_rng(run))
                ratio.append(np.nan if known is None else known.ratio)
        spread = np.sqrt(2 / 9 / RUNS)
        rows.append((degrees, RUNS, np.mean(scores), spread, 100 * np.mean(inside), np.median(shapes), np.max(shapes), np.mean(ratio)))
    heads = ("lens deg", "runs", "chi2/P", "its sigma", "in 1.96 sigma %", "px at 1 m", "worst px", "sampled/claimed")
    print_table(heads, rows, f"Corners with 0.1 px of noise, {VIEWS} views: errors against claims; error of shapes where corners were seen")


def simulated_chessboards() -> None:
    rows = []
    for degrees in (75.0, 110.0):
        camera, rng = wide_camera(degrees, 1920, 1440), np.random.default_rng(3)
        shots, _ = chessboard_photographs(rng, camera, (12, 9), 20.0, 6 if QUICK else VIEWS)
        start = time.perf_counter()
        search = find_boards(shots, (12, 9), 20.0)
        each = (time.perf_counter() - start) / len(shots)
        made = calibrate(search.views, 1920, 1440)
        wrong, known = camera_difference(camera, made.camera, WORKING_MM, _seen(made.views)), resample(made, rng)
        assert known is not None
        off = float(made.camera.focal_px[0] - camera.focal_px[0])
        rows.append((degrees, len(made.views), made.sigma_px, off, wrong.covered_rms_px, wrong.covered_max_px, known.ratio, each))
    heads = ("lens deg", "views", "noise px", "focal error px", "px at 1 m", "largest px", "sampled/claimed", "s a view")
    print_table(heads, rows, "Photographs of a flat chessboard, found and fitted")


def simulated_circles() -> None:
    rows = []
    for degrees in (75.0, 110.0):
        camera = wide_camera(degrees, 1920, 1440)
        for name, board in (("rings", rings_board((12, 9), 20.0)), ("discs", circles_board((12, 9), 20.0))):
            shots, _ = photographs(np.random.default_rng(3), camera, board, 6 if QUICK else VIEWS)
            search = find_circle_boards(shots, board)
            outlines = search.found.views
            rough = calibrate(outlines, 1920, 1440)
            start = time.perf_counter()
            views, _ = measured_views(shots, board, search, rough)
            each = (time.perf_counter() - start) / len(views)
            plain = calibrate([replace(view, radius_mm=None) for view in outlines], 1920, 1440)
            for how, made in (("ellipse centres", plain), ("outlines", rough), ("raw pixels", calibrate(views, 1920, 1440))):
                wrong = camera_difference(camera, made.camera, WORKING_MM, _seen(views))
                off = float(made.camera.focal_px[0] - camera.focal_px[0])
                rows.append((degrees, name, how, len(made.views), made.sigma_px, off, wrong.covered_rms_px, wrong.covered_max_px, each))
    heads = ("lens deg", "board", "centres from", "views", "noise px", "focal error px", "px at 1 m", "largest px", "s a view")
    print_table(heads, rows, "Photographs of boards of circles")


def cylinder_boards() -> None:
    folder = data_folder("cylinder")
    if folder is None:
        return
    files = sorted((folder / "boards").glob("*.jpg"))
    start = time.perf_counter()
    search = find_boards(((file.name, read_gray(file)) for file in files), (14, 19), 10.0)
    found = time.perf_counter() - start
    start = time.perf_counter()
    chosen, choice = choose_lens(search.views, search.width_px, search.height_px)
    solved = time.perf_counter() - start
    size = (search.width_px, search.height_px)
    rows = [_row(f"{lens}, exact board, still", calibrate(search.views, *size, lens, True)) for lens in ("opencv5", "opencv8", "opencv12")]
    rows += [_row(f"{lens}, still", calibrate(search.views, *size, lens)) for lens in ("opencv5", "opencv12")]
    rows += [
        _row(f"{lens}, moving", calibrate(search.views, *size, lens, readout="columns")) for lens in ("opencv5", "opencv8", "opencv12")
    ]
    print_table(HEADS, rows, f"data/cylinder/boards: {len(search.views)} views found in {found:.1f} s, solved in {solved:.1f} s")
    print(choice.reason, choice.readout_reason, sep="\n")
    known = resample(chosen, np.random.default_rng(1))
    assert known is not None
    print(f"error of shapes at {known.distance_mm:.0f} mm: claimed {known.covered_rms_px:.3f} px, sampled {known.ratio:.2f} times that")
    replica(chosen)


def replica(found: Calibration) -> None:
    """How wrong cameras are when poses, print, motions and noise are those found in the real photographs."""
    bundle, problem, rows = found.bundle, found.problem, []
    corners, size = problem.corners(bundle), (found.camera.width_px, found.camera.height_px)
    exact = corners.pixels - bundle.residuals(corners)
    for seed in range(2 if QUICK else 5):
        noisy = exact + np.random.default_rng(seed).normal(size=exact.shape) * found.sigma_px
        views = [replace(view, pixels=noisy[at]) for view, at in zip(problem.views, corners.slices, strict=True)]
        kinds = {"exact board, still": (True, "global"), "still": (False, "global"), "moving": (False, found.readout)}
        for name, (flat, readout) in kinds.items():
            made = calibrate(views, *size, found.lens, flat, readout)
            wrong = camera_difference(found.camera, made.camera, 338.0, exact)
            rows.append((seed, name, made.rms_px / np.sqrt(2), wrong.covered_rms_px, wrong.covered_max_px))
    heads = ("run", f"{found.lens}", "rms per coordinate px", "wrong at 338 mm px", "largest px")
    print_table(heads, rows, "Replica: corners as in the real photographs, of a known camera")


def dot_plates() -> None:
    folder = data_folder("dotplate")
    if folder is None:
        return
    files = sorted(folder.glob("*.jpg"))
    shots = [(file.name, read_gray(file)) for file in files]
    plate = survey(files)[2]
    search = find_circle_boards(shots, plate)
    outlines = calibrate(search.found.views, WIDTH_PX, HEIGHT_PX)
    views, _ = measured_views(shots, plate, search, outlines)
    rows = [_row("outlines", outlines), _row("raw pixels", calibrate(views, WIDTH_PX, HEIGHT_PX))]
    rows.append(_row("raw pixels, flat", calibrate(views, WIDTH_PX, HEIGHT_PX, flat=True)))
    print_table(HEADS, rows, f"data/dotplate as a board of circles: {len(views)} views, opencv5")


HEADS = (
    *("lens", "rms px", "per coordinate", "noise px", "print mm", "motion mm", "fx px", "sigma", "sag mm"),
    *("halves px", "largest px", "fx sigmas apart"),
)


def _row(name: str, made: Calibration) -> tuple[object, ...]:
    halves = halves_of(made)
    assert made.camera.covariance is not None
    focal = (made.camera.focal_px[0], np.sqrt(made.camera.covariance[0, 0]), made.board.sag_mm)
    own = (name, made.rms_px, made.rms_px / np.sqrt(2), made.sigma_px, made.board.print_sigma_mm, made.motion_sigma_mm)
    if halves is None:
        return (*own, *focal, "", "", "")
    return (*own, *focal, halves.difference.covered_rms_px, halves.difference.covered_max_px, abs(halves.focal_sigmas[0]))


def _seen(views: tuple[BoardView, ...] | list[BoardView]) -> Array:
    return np.concatenate([view.pixels for view in views])


def main() -> None:
    for part in (simulated_corners, simulated_chessboards, simulated_circles, cylinder_boards, dot_plates):
        if not ONLY or part.__name__ in ONLY:
            part()


if __name__ == "__main__":
    main()
