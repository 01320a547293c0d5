"""A real photograph: squares printed on a flat sheet and wrapped round a cylinder, its pattern given flat.

The truth is that sheet's squares on the cylinder (points.csv), put into the photograph by a pose through eight of them that were read
off the picture by eye, by the column numbers printed above. The camera is roughly the one that its board's photographs give: names must
not hang on the last pixel.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dishmap.camera.model import Camera
from dishmap.errors import IdentityError
from dishmap.io.images import read_gray
from dishmap.targets.grid_builders import grid
from dishmap.targets.grid_detect import GridDetections, find_grid
from dishmap.targets.grid_identify import identify_grid
from dishmap.targets.identify import Anchors, Upright

CAMERA = Camera(2464, 3280, [2604.0, 2604.0], [1273.0, 1607.0], [0.158, -0.042, -0.002, 0.0, -0.95])
# (row from the bottom, column by its printed number): where its middle is, px, by eye
BY_EYE = {
    (20, 6): (1217, 445),
    (20, 2): (843, 523),
    (1, 6): (1217, 2603),
    (1, 2): (838, 2560),
    (11, 4): (1000, 1463),
    (20, 10): (1594, 530),
    (1, 10): (1596, 2553),
    (11, 8): (1430, 1465),
}
FLAT = grid(14, 20, 12.0, square_mm=5.0)
RADIUS_MM = 57.0
WANTED = 160


@pytest.fixture(scope="module")
def found(shared_data: Path) -> GridDetections:
    return find_grid(read_gray(shared_data / "cylinder" / "grid.jpg"), lines=False)


def test_squares_on_a_cylinder_are_named_rightly(found: GridDetections, shared_data: Path) -> None:
    # the square of the top row in the sixth column
    hint = Anchors((5,), np.array([[1216.0, 446.0]]), Upright())
    identity = identify_grid(found, FLAT, CAMERA, hint)
    assert len(identity.index) >= WANTED
    assert FLAT.lattice is not None
    names = FLAT.lattice[identity.index][:, ::-1] + 1

    table = np.loadtxt(shared_data / "cylinder" / "points.csv", delimiter=",", skiprows=1)
    true_names, points = table[:, :2].astype(int), table[:, 2:]
    chosen = [int(np.flatnonzero((true_names == at).all(axis=1))[0]) for at in BY_EYE]
    pixels = np.array(list(BY_EYE.values()), dtype=float)
    _, turn, shift = cv2.solvePnP(points[chosen], pixels, CAMERA.matrix, CAMERA.distortion, flags=cv2.SOLVEPNP_SQPNP)
    turn, shift = cv2.solvePnPRefineLM(points[chosen], pixels, CAMERA.matrix, CAMERA.distortion, turn, shift)
    rotation = cv2.Rodrigues(turn)[0]
    out = points * [1 / RADIUS_MM, 1 / RADIUS_MM, 0.0]
    facing = ((-rotation.T @ shift.ravel() - points) * out).sum(axis=1) > 0
    place = CAMERA.project(points @ rotation.T + shift.ravel())
    place[~facing] = 1e6
    nearest = np.argmin(np.linalg.norm(found.place_px[identity.detection][:, None] - place, axis=2), axis=1)
    np.testing.assert_array_equal(true_names[nearest], names)
    assert not found.marked.any()


def test_without_a_named_square_the_columns_are_left_open(found: GridDetections) -> None:
    with pytest.raises(IdentityError, match=r"3 ways .* looks the same when shifted: .*columns 0 to 11 .*columns 2 to 13"):
        identify_grid(found, FLAT, CAMERA, Upright())
