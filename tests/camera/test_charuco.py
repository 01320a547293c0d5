"""ChArUco boards: drawn by OpenCV, blurred and tilted, found to a hundredth of a pixel; mirrored and wrong boards refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.camera.charuco import DICTIONARIES, MARKER_PART, find_charuco_boards
from dishmap.errors import InputError, MeasurementError
from dishmap.sheet import boards, markers

Array = NDArray[np.float64]
SQUARE_PX = 100
QUADS = {
    "face on": [[150, 120], [1050, 130], [1040, 780], [140, 770]],
    "tilted": [[250, 150], [1000, 230], [930, 700], [200, 780]],
    "cut off": [[-260, 100], [1000, 130], [980, 800], [-280, 760]],
}


def photograph(corners: list[list[int]], seed: int = 0) -> tuple[NDArray[np.uint8], Array]:
    """A photograph of a board of 8x5 corners with its outline at these pixels, and the homography from pixels of its drawing."""
    board = cv2.aruco.CharucoBoard((9, 6), 20.0, 15.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000))
    drawing = board.generateImage((9 * SQUARE_PX, 6 * SQUARE_PX), marginSize=0)
    outline = np.array([[0, 0], [9, 0], [9, 6], [0, 6]], dtype=np.float32) * SQUARE_PX - 0.5
    homography = cv2.getPerspectiveTransform(outline, np.array(corners, dtype=np.float32))
    finer = np.array([[4.0, 0, 1.5], [0, 4.0, 1.5], [0, 0, 1]])
    view = cv2.warpPerspective(drawing, finer @ homography, (4800, 3600), flags=cv2.INTER_LINEAR, borderValue=255).astype(np.float32)
    view = cv2.resize(cv2.GaussianBlur(view, (0, 0), 3.2), (1200, 900), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(seed).normal(size=view.shape) * 1.5
    return np.clip(30 + 0.75 * view + noise, 0, 255).astype(np.uint8), np.asarray(homography)


@pytest.mark.parametrize("name", QUADS)
def test_corners_are_where_they_are(name: str) -> None:
    gray, homography = photograph(QUADS[name])
    search = find_charuco_boards([(name, gray)], (8, 5), 20.0)
    view = search.views[0]
    truth = cv2.perspectiveTransform(((view.board_mm[:, :2] / 20 + 1) * SQUARE_PX - 0.5)[None], homography)[0]
    assert len(view.pixels) >= (25 if name == "cut off" else 40)
    error = view.pixels - truth
    assert np.sqrt((error**2).mean()) < 0.02
    assert np.abs(error).max() < 0.08


def test_sixteen_bits_are_read() -> None:
    gray, _ = photograph(QUADS["tilted"])
    assert len(find_charuco_boards([("a", gray.astype(np.uint16) * 200)], (8, 5), 20.0).views[0].pixels) >= 40


def test_mirrored_and_blank_photographs_are_refused() -> None:
    gray, _ = photograph(QUADS["face on"])
    for picture in (np.ascontiguousarray(gray[:, ::-1]), np.full_like(gray, 120)):
        with pytest.raises(MeasurementError, match="only 0 corners of the ChArUco board were found"):
            find_charuco_boards([("a", picture)], (8, 5), 20.0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"dictionary": "7x7_50"}, "unknown dictionary '7x7_50'; use one of 4x4_50"),
        ({"marker_mm": 20.0}, "are smaller than its squares of 20 mm, not 20 mm"),
        ({"corners": (14, 19), "dictionary": "4x4_50"}, "has 150 marks, and 4x4_50 only 50"),
        ({"square_mm": 5000.0}, "is it in millimetres"),
    ],
)
def test_impossible_boards(words: dict[str, object], message: str) -> None:
    given = {"corners": (8, 5), "square_mm": 20.0} | words
    with pytest.raises(InputError, match=message):
        find_charuco_boards([("a", np.full((90, 120), 9, np.uint8))], **given)  # type: ignore[arg-type]


def test_boards_are_those_that_are_printed() -> None:
    assert set(DICTIONARIES) <= set(markers.DICTIONARIES)
    assert MARKER_PART == boards.MARKER_PART
