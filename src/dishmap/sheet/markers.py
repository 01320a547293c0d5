"""ArUco and AprilTag marks as ink: the squares of OpenCV's dictionaries."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError

Array = NDArray[np.float64]

DICTIONARIES = {
    "aruco": cv2.aruco.DICT_4X4_50,
    "apriltag": cv2.aruco.DICT_APRILTAG_36h11,
    "4x4_50": cv2.aruco.DICT_4X4_50,
    "4x4_250": cv2.aruco.DICT_4X4_250,
    "5x5_100": cv2.aruco.DICT_5X5_100,
    "5x5_1000": cv2.aruco.DICT_5X5_1000,
    "6x6_250": cv2.aruco.DICT_6X6_250,
}


def marker_polygons(dictionary: str, number: int, corner_mm: Array, side_mm: float) -> tuple[Array, ...]:
    """Rectangles (4, 2) of the black squares of a mark whose upper left corner is at corner_mm (2,), y up.

    dictionary: a key of DICTIONARIES. Raises InputError when the dictionary has no mark of that number.
    """
    words = cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary])
    if not 0 <= number < len(words.bytesList):
        raise InputError(f"the dictionary {dictionary} has marks 0 to {len(words.bytesList) - 1}, not {number}; take a smaller board")
    cells = words.markerSize + 2
    dark = np.asarray(cv2.aruco.generateImageMarker(words, number, cells)) == 0
    cell = side_mm / cells
    found = []
    for row in range(cells):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], dark[row], [False]]).astype(int))).reshape(-1, 2)
        for a, b in edges:
            x, y = corner_mm[0] + cell * np.array([a, b]), corner_mm[1] - cell * np.array([row, row + 1])
            found.append(np.array([[x[0], y[1]], [x[1], y[1]], [x[1], y[0]], [x[0], y[0]]]))
    return tuple(found)
