"""Printed pages measured with our own detector, and with OpenCV's for its boards: what is on paper is what the pattern file says."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from printing import INCH_MM, SvgPage, dishmap, needs_poppler, on_paper_mm, placed_shifts, rendered
from scipy.spatial import cKDTree

from dishmap.camera.chessboard import find_chessboard
from dishmap.camera.model import Camera
from dishmap.io.pattern_file import read_pattern
from dishmap.targets.detect import Detections, find_ellipses
from dishmap.targets.identify import identify
from dishmap.targets.pattern import Pattern

# What is asked of a print: half a pixel at 600 dpi.
PRINT_MM = 0.02
# Numbers in SVG files are rounded to a nanometre.
ROUNDING_MM = 3e-6

PLATE = ["plate", "--rows", 5, "--columns", 6, "--pitch-mm", 45, "--orientation-marks"]


def make(tmp_path: Path, *words: object) -> Path:
    out = tmp_path / "out"
    done = dishmap("sheet", *words, "--out", out)
    assert done.exit_code == 0, (done.output, done.stderr, done.exception)
    return out


def circles_of(pattern: Pattern, index: int, center: np.ndarray, angle: float) -> np.ndarray:
    """Circles (C, 3) of a target laid at a place and angle."""
    kind = pattern.kind_of(index)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.column_stack([center + kind.center_mm @ turn.T, kind.radius_mm])


def measured_circles(found: Detections, dpi: int, height_mm: float) -> np.ndarray:
    """Circles (M, 4): x, y, radius in mm, and 1 where the inside is dark."""
    return np.column_stack(
        [
            on_paper_mm(found.center_px, dpi, height_mm),
            np.sqrt(found.semi_axes_px.prod(axis=1)) * INCH_MM / dpi,
            found.dark.astype(float),
        ]
    )


@needs_poppler
@pytest.mark.parametrize("dpi", [300, 600])
def test_a_tiled_plate_measures_as_its_pattern_file_says(dpi: int, tmp_path: Path) -> None:
    out = make(tmp_path, *PLATE)
    pattern, listing = read_pattern(out / "pattern.json"), json.loads((out / "sheets.json").read_text())
    assert len(listing["pages"]) == 2
    together, height = [], listing["paper_mm"][1]
    for number, image in enumerate(rendered(out / "sheets.pdf", dpi), start=1):
        (entry,) = placed_shifts(listing)[number]
        circles = measured_circles(find_ellipses(image), dpi, height)
        circles[:, :2] -= entry["shift_mm"]
        together.append(circles)
    found = np.concatenate(together)
    expected = np.concatenate([circles_of(pattern, k, pattern.center_mm[k, :2], 0.0) for k in range(len(pattern))])
    dark = np.concatenate([pattern.kind_of(k).dark for k in range(len(pattern))])
    for sense in (True, False):
        # letters of the words hold circles of half a millimetre; those of the pattern have 3 and 5
        printed = found[(found[:, 3] == sense) & (found[:, 2] > 2)]
        wanted = expected[dark == sense]
        assert len(printed) == len(wanted)
        distance, index = cKDTree(printed[:, :2]).query(wanted[:, :2])
        assert distance.max() < PRINT_MM
        assert np.abs(printed[index, 2] - wanted[:, 2]).max() < PRINT_MM


def test_the_svg_pages_hold_each_target_once_and_to_the_nanometre(tmp_path: Path) -> None:
    out = make(tmp_path, *PLATE, "--paper", "letter")
    pattern, listing = read_pattern(out / "pattern.json"), json.loads((out / "sheets.json").read_text())
    seen = []
    for number, name in enumerate(listing["pages"], start=1):
        page = SvgPage(out / name)
        assert page.size_mm == tuple(listing["paper_mm"])
        (entry,) = placed_shifts(listing)[number]
        for key, circles in page.circles.items():
            index = int(np.flatnonzero(pattern.ids == int(key.removeprefix("target-")))[0])
            wanted = circles_of(pattern, index, pattern.center_mm[index, :2] + entry["shift_mm"], 0.0)
            assert np.abs(circles - wanted).max() < ROUNDING_MM
            # whole on its page, within the margins
            assert (circles[:, :2] - circles[:, 2:] > listing["margin_mm"]).all()
            assert (circles[:, :2] + circles[:, 2:] < np.array(page.size_mm) - listing["margin_mm"]).all()
            seen.append(index)
    assert sorted(seen) == list(range(len(pattern)))


def test_neighbouring_pages_share_their_crosses(tmp_path: Path) -> None:
    out = make(tmp_path, "plate", "--rows", 12, "--columns", 9, "--pitch-mm", 45)
    listing = json.loads((out / "sheets.json").read_text())
    crosses = {}
    for number, name in enumerate(listing["pages"], start=1):
        (entry,) = placed_shifts(listing)[number]
        lines = [line for line in SvgPage(out / name).lines if len(line) == 2]
        middle = {tuple(np.round(line.mean(axis=0), 5)) for line in lines if abs(line[0, 0] - line[1, 0]) < 1e-9}
        middle &= {tuple(np.round(line.mean(axis=0), 5)) for line in lines if abs(line[0, 1] - line[1, 1]) < 1e-9}
        crosses[entry["tile"]] = {tuple(np.round(np.array(m) - entry["shift_mm"], 4)) for m in middle}
    assert len(crosses) == len(listing["pages"]) > 4
    for tile, own in crosses.items():
        right, above = chr(ord(tile[0]) + 1) + tile[1:], tile[0] + str(int(tile[1:]) + 1)
        for other in (right, above):
            if other in crosses:
                # two fix shift and turn
                assert len(own & crosses[other]) >= 2, (tile, other)


@needs_poppler
def test_the_scale_bars_are_as_long_as_they_say(tmp_path: Path) -> None:
    out, dpi = make(tmp_path, *PLATE), 600
    listing = json.loads((out / "sheets.json").read_text())
    image, bar = rendered(out / "sheets.pdf", dpi)[0], listing["bar_mm"]
    start, at, height = listing["margin_mm"] + 9, listing["margin_mm"] + 2, listing["paper_mm"][1]
    for flipped in (image, image[::-1].T):
        # counted from the lower left corner, a bar to the right is a row of the picture turned upside down, and a bar upwards a column
        from_below = flipped[::-1] if flipped is image else flipped
        row = round((at + 1.0) * dpi / INCH_MM)
        dark = 255.0 - from_below[row].astype(float)
        ticks = []
        for place in (start, start + bar):
            near = np.arange(round((place - 0.6) * dpi / INCH_MM), round((place + 0.6) * dpi / INCH_MM))
            assert dark[near].sum() > 0
            ticks.append(float((near * dark[near]).sum() / dark[near].sum()))
        assert abs((ticks[1] - ticks[0]) * INCH_MM / dpi - bar) < PRINT_MM
    assert height == 297.0


@needs_poppler
@pytest.mark.parametrize(
    "words",
    [
        ["plate", "--rows", 4, "--columns", 4, "--pitch-mm", 45, "--orientation-marks"],
        ["board", "--kind", "rings", "--grid", "9x12", "--pitch-mm", 18],
        ["board", "--kind", "circles", "--grid", "9x12", "--pitch-mm", 18, "--corner-marks", "aruco", "--paper", "A3"],
    ],
)
def test_a_print_with_orientation_marks_needs_no_hint(words: list[object], tmp_path: Path) -> None:
    out, dpi, away = make(tmp_path, *words), 200, 1000.0
    pattern, listing = read_pattern(out / "pattern.json"), json.loads((out / "sheets.json").read_text())
    (image,) = rendered(out / "sheets.pdf", dpi)
    # the page as a camera sees it that looks straight at it, upside down
    image = np.ascontiguousarray(image[::-1, ::-1])
    scale, (height, width) = dpi / INCH_MM, image.shape
    camera = Camera(width, height, focal_px=[scale * away, scale * away], principal_px=[(width - 1) / 2, (height - 1) / 2])
    found = find_ellipses(image)
    identity = identify(found, pattern, camera)
    marks, (entry,) = pattern.marks, listing["placed"]
    at = (
        on_paper_mm(np.array([width - 1, height - 1]) - found.center_px[identity.detection], dpi, listing["paper_mm"][1])
        - entry["shift_mm"]
    )
    assert len(np.unique(marks.target[identity.mark])) == len(pattern)
    assert np.linalg.norm(at - marks.center_mm[identity.mark, :2], axis=1).max() < 0.1


@needs_poppler
def test_a_chessboard_measures_as_its_file_says(tmp_path: Path) -> None:
    out, dpi = make(tmp_path, "board", "--kind", "chessboard", "--corners", "9x6", "--square-mm", 20), 600
    board, listing = json.loads((out / "board.json").read_text()), json.loads((out / "sheets.json").read_text())
    (image,) = rendered(out / "sheets.pdf", dpi)
    corners = on_paper_mm(find_chessboard(image, (9, 6)), dpi, listing["paper_mm"][1])
    expected = np.array(board["corners_mm"])
    # its frame has y down and begins at the first corner, as the detector numbers them; 600 dpi, as poppler puts straight edges to
    # a quarter of a pixel
    moved = (corners - corners.mean(axis=0)) * [1, -1]
    assert np.linalg.norm(moved - (expected - expected.mean(axis=0)), axis=1).max() < PRINT_MM


@needs_poppler
@pytest.mark.parametrize("corners", [(9, 6), (6, 5), (8, 6)])
def test_opencv_finds_every_corner_of_a_charuco_board(corners: tuple[int, int], tmp_path: Path) -> None:
    size = f"{corners[0]}x{corners[1]}"
    out, dpi = make(tmp_path, "board", "--kind", "charuco", "--corners", size, "--square-mm", 20, "--dictionary", "4x4_50"), 200
    board, listing = json.loads((out / "board.json").read_text()), json.loads((out / "sheets.json").read_text())
    (image,) = rendered(out / "sheets.pdf", dpi)
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    theirs = cv2.aruco.CharucoBoard((corners[0] + 1, corners[1] + 1), board["square_mm"][0], board["marker_mm"][0], words)
    found, ids, _, _ = cv2.aruco.CharucoDetector(theirs).detectBoard(image)
    assert ids is not None
    assert sorted(ids.ravel().tolist()) == list(range(corners[0] * corners[1]))
    at = on_paper_mm(found.reshape(-1, 2), dpi, listing["paper_mm"][1])
    wanted = np.array(board["corners_mm"])[ids.ravel()] * [1, -1]
    # poppler puts straight edges to a quarter of a pixel, either way
    assert np.linalg.norm(at - at.mean(axis=0) - wanted + wanted.mean(axis=0), axis=1).max() < 0.35 * INCH_MM / dpi


@needs_poppler
def test_opencv_finds_an_asymmetric_grid(tmp_path: Path) -> None:
    out, dpi = make(tmp_path, "board", "--kind", "acircles", "--grid", "4x11", "--pitch-mm", 18), 100
    (image,) = rendered(out / "sheets.pdf", dpi)
    found, centers = cv2.findCirclesGrid(image, (4, 11), flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
    assert found
    pattern = read_pattern(out / "pattern.json")
    steps = np.linalg.norm(np.diff(centers.reshape(-1, 2), axis=0), axis=1) * INCH_MM / dpi
    wanted = np.linalg.norm(np.diff(pattern.center_mm, axis=0), axis=1)
    # a quarter of a pixel of OpenCV's blobs
    assert np.abs(steps - wanted).max() < 0.25 * INCH_MM / dpi


@needs_poppler
@pytest.mark.parametrize(("marks", "dictionary"), [("aruco", cv2.aruco.DICT_4X4_50), ("apriltag", cv2.aruco.DICT_APRILTAG_36h11)])
def test_corner_marks_are_found_where_the_list_says(marks: str, dictionary: int, tmp_path: Path) -> None:
    out, dpi = make(tmp_path, "plate", "--rows", 3, "--columns", 3, "--pitch-mm", 40, "--corner-marks", marks, "--paper", "A3"), 150
    listing = json.loads((out / "sheets.json").read_text())
    (image,) = rendered(out / "sheets.pdf", dpi)
    corners, ids, _ = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(dictionary)).detectMarkers(image)
    assert ids is not None
    assert sorted(ids.ravel().tolist()) == [0, 1, 2, 3]
    for number, corner in zip(ids.ravel(), corners, strict=True):
        mark = listing["corner_marks"][number]
        at = on_paper_mm(corner.reshape(4, 2), dpi, listing["paper_mm"][1]) - listing["placed"][0]["shift_mm"]
        half = mark["side_mm"] / 2
        wanted = np.array(mark["center_mm"]) + np.array([[-half, half], [half, half], [half, -half], [-half, -half]])
        # corners of OpenCV's marks are whole pixels unless refined
        assert np.abs(at - wanted).max() < 1.5 * INCH_MM / dpi
