"""Photographs of a chessboard for tests of the program."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from dishmap.simulate.render import record
from dishmap.simulate.scene import Sensor


def board_photographs(folder: Path) -> list[Path]:
    """Eight photographs of a chessboard, painted square by square by OpenCV's warp of a large picture."""
    squares = 40 * np.kron((np.add.outer(np.arange(8), np.arange(10)) % 2), np.ones((40, 40))) * 4.5 + 40
    board = np.pad(squares, 40, constant_values=220).astype(np.uint8)
    matrix = np.array([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]])
    names = []
    for number, (tilt, turn) in enumerate([(0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5), (0.4, 0.4), (-0.4, 0.4), (0.4, -0.4), (-0.4, -0.4)]):
        rotation = cv2.Rodrigues(np.array([tilt, turn, 0.1 * number]))[0]
        # the board's picture has 4 px a mm and its middle at (240, 200)
        to_mm = np.array([[0.25, 0, -60], [0, 0.25, -50], [0, 0, 1]])
        homography = matrix @ np.column_stack([rotation[:, :2], [0, 0, 230]]) @ to_mm
        # four times as many pixels both ways, then their means: no aliasing
        finer = np.array([[4.0, 0, 1.5], [0, 4.0, 1.5], [0, 0, 1]])
        view = cv2.warpPerspective(board, finer @ homography, (2560, 1920), flags=cv2.INTER_LINEAR, borderValue=220)
        view = cv2.resize(view, (640, 480), interpolation=cv2.INTER_AREA)
        light = cv2.GaussianBlur(view, (0, 0), 0.8).astype(np.float32)
        names.append(folder / f"view{number}.png")
        cv2.imwrite(str(names[-1]), record(light, Sensor(noise_grey=1.0), np.random.default_rng(number)))
    return names
