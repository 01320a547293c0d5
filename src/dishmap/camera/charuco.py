"""Corners of a ChArUco board: found and named by OpenCV through its marks, then fitted to the raw pixels as those of a chessboard.

Its marks tell every corner from the others, so any part of the board will do, and a mirrored photograph shows none.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dishmap.camera.board import BoardSearch
from dishmap.camera.chessboard import Gray, Progress, chessboard_mm, fit_corners, search_photographs
from dishmap.errors import InputError, MeasurementError

Array = NDArray[np.float64]

# As in the sheets we print: dictionaries by name, and the side of a mark over that of a square.
DICTIONARIES = ("4x4_50", "4x4_250", "5x5_100", "5x5_1000", "6x6_250")
MARKER_PART = 0.75
# Marks are looked for in a reduced picture first (longer side, px).
SEARCH_SIDES_PX = (1600, 3200)
FEWEST_CORNERS = 12
# At this part of all corners a larger picture is not tried.
ENOUGH_PART = 0.9
# Half window of the fit, as a part of the shortest square: marks must stay out of it. The largest shift it may make.
WINDOW_OF_SQUARE, WINDOW_RANGE_PX, FARTHEST_PX = 0.16, (2, 10), 3.0


def find_charuco_boards(
    photographs: Iterable[tuple[str, Gray]],
    corners: tuple[int, int],
    square_mm: float | tuple[float, float],
    marker_mm: float | None = None,
    dictionary: str = "5x5_1000",
    total: int = 0,
    progress: Progress | None = None,
) -> BoardSearch:
    """Find a ChArUco board in each photograph (name, gray).

    corners: inner corners along x and y (squares less one); square_mm: side of a square, or its sides along x and y as a printer made
    them; marker_mm: side of a mark, three quarters of a square by default.
    Raises InputError for an impossible board, and as `find_boards` does.
    """
    board_mm = chessboard_mm(corners, square_mm)
    if dictionary not in DICTIONARIES:
        raise InputError(f"unknown dictionary {dictionary!r}; use one of {', '.join(DICTIONARIES)}")
    square = float(np.mean(square_mm))  # for naming the corners only, which are measured without it
    side = MARKER_PART * square if marker_mm is None else marker_mm
    if not 0 < side < square:
        raise InputError(f"the marks of a ChArUco board are smaller than its squares of {square:g} mm, not {side:g} mm")
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary.upper()}"))
    marks = (corners[0] + 1) * (corners[1] + 1) // 2
    if marks > len(words.bytesList):
        raise InputError(f"a board of {corners[0]}x{corners[1]} corners has {marks} marks, and {dictionary} only {len(words.bytesList)}")
    board = cv2.aruco.CharucoBoard((corners[0] + 1, corners[1] + 1), square, side, words)
    return search_photographs(photographs, board_mm, lambda gray: _find(gray, board, board_mm), total, progress)


def _find(gray: Gray, board: cv2.aruco.CharucoBoard, board_mm: Array) -> Array:
    """Pixels (N, 2) of the board's corners, NaN where one is not seen."""
    picture = gray if gray.dtype == np.uint8 else cv2.convertScaleAbs(gray, alpha=255.0 / max(float(gray.max()), 1.0))
    detector = cv2.aruco.CharucoDetector(board)
    longer = max(picture.shape)
    best = np.full((len(board_mm), 2), np.nan)
    for side in dict.fromkeys([*(min(s, longer) for s in SEARCH_SIDES_PX), longer]):
        scale = side / longer
        reduced = picture if scale == 1 else cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        result: tuple[Any, ...] = detector.detectBoard(reduced)
        pixels, ids = result[:2]
        if ids is None or len(ids) <= np.isfinite(best[:, 0]).sum():
            continue
        ratio = np.array(picture.shape[::-1]) / np.array(reduced.shape[::-1])
        best = np.full((len(board_mm), 2), np.nan)
        best[np.ravel(ids)] = (np.asarray(pixels, dtype=float).reshape(-1, 2) + 0.5) * ratio - 0.5
        if np.isfinite(best[:, 0]).mean() > ENOUGH_PART:
            break
    seen = np.flatnonzero(np.isfinite(best[:, 0]))
    if len(seen) < FEWEST_CORNERS:
        raise MeasurementError(
            f"only {len(seen)} corners of the ChArUco board were found, and at least {FEWEST_CORNERS} are needed; check dictionary, "
            "counts of corners, focus, and that the photograph is not mirrored"
        )
    return _refined(gray, board_mm, best, seen)


def _refined(gray: Gray, board_mm: Array, start: Array, seen: NDArray[np.int64]) -> Array:
    """The corners seen, fitted to the raw pixels; directions of edges come from a homography through all of them."""
    square = float(board_mm[1, 0] - board_mm[0, 0])
    homography = np.asarray(cv2.findHomography(board_mm[seen, :2], start[seen], 0)[0], dtype=float)
    along_x, along_y = (_through(homography, board_mm[seen, :2], np.array(step)) for step in ((0.1 * square, 0.0), (0.0, 0.1 * square)))
    shortest = 10 * min(np.linalg.norm(along_x, axis=1).min(), np.linalg.norm(along_y, axis=1).min())
    half = int(np.clip(WINDOW_OF_SQUARE * shortest, *WINDOW_RANGE_PX))
    fitted = fit_corners(gray, start[seen], along_x, along_y, half)
    fitted[np.linalg.norm(fitted - start[seen], axis=1) > FARTHEST_PX * max(1.0, max(gray.shape) / SEARCH_SIDES_PX[0])] = np.nan
    out = np.full_like(start, np.nan)
    out[seen] = fitted
    if np.isfinite(fitted[:, 0]).sum() < FEWEST_CORNERS:
        raise MeasurementError("the corners of the ChArUco board are not sharp enough to be measured; photograph it again")
    return out


def _through(homography: Array, xy: Array, step: Array) -> Array:
    """How a step on the board looks in the picture at (N, 2)."""
    ends = [cv2.perspectiveTransform((xy + part * step)[None], homography)[0] for part in (-0.5, 0.5)]
    return np.asarray(ends[1] - ends[0])
