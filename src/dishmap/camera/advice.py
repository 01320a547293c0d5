"""What to photograph next: the views that would lower the expected projection error most, in words.

Each candidate view shows the board at one of nine places, facing the camera or tilted to one of four sides. What a view adds to the
information on camera and bends is computed as in the calibration itself, so the choice is that of an optimal design, made one
view at a time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dishmap.camera import elimination as el
from dishmap.camera.board import shapes_of
from dishmap.camera.bundle import BoardCorners, Prior
from dishmap.camera.calibrate import Calibration
from dishmap.camera.compare_cameras import working_distance_mm
from dishmap.camera.model import Camera
from dishmap.camera.uncertainty import projection_error
from dishmap.transforms import rotation_from_vector

Array = NDArray[np.float64]

# The board's longer side takes this part of the picture's shorter side, so that it can go into a corner.
FILL = 0.55
TILT_RAD = np.radians(35.0)
TILTS = {
    "facing the camera": (0.0, 0.0),
    "its upper side tilted away": (-1.0, 0.0),
    "its lower side tilted away": (1.0, 0.0),
    "its left side tilted away": (0.0, 1.0),
    "its right side tilted away": (0.0, -1.0),
}
PLACES = {
    "the upper left corner": (0.0, 0.0),
    "the middle of the upper edge": (0.5, 0.0),
    "the upper right corner": (1.0, 0.0),
    "the middle of the left edge": (0.0, 0.5),
    "the middle": (0.5, 0.5),
    "the middle of the right edge": (1.0, 0.5),
    "the lower left corner": (0.0, 1.0),
    "the middle of the lower edge": (0.5, 1.0),
    "the lower right corner": (1.0, 1.0),
}
SUGGESTIONS = 3
GRID = (9, 12)
# The board must lie in the picture with at least this part of its corners.
FEWEST_VISIBLE = 0.5


@dataclass(frozen=True)
class Suggestion:
    """A view to take: what it shows, in words, and the expected projection error over the whole picture before and after it, rms px."""

    words: str
    before_px: float
    after_px: float


def suggestions(calibration: Calibration, count: int = SUGGESTIONS, distance_mm: float | None = None) -> tuple[Suggestion, ...]:
    """The views that lower the expected error of shapes most, each on top of those before it; none where nothing is to be gained.

    distance_mm: where shapes are to be measured, by default where the boards were.
    """
    bundle, problem = calibration.bundle, calibration.problem
    noise = calibration.sigma_px * calibration.inflation
    if noise <= 0:
        return ()
    corners = problem.corners(bundle)
    free, prior = problem.free(bundle), problem.prior(bundle, corners, calibration.weights)
    known = el.marginals(el.normal_equations(bundle, corners, free, calibration.weights, prior)).covariance
    scale = 1 / np.sqrt(np.diag(known))
    information = np.linalg.inv(known * np.outer(scale, scale)) * np.outer(scale, scale)
    candidates = {words: _information(calibration, pose, free, prior) for words, pose in _candidate_poses(calibration).items()}
    distance = distance_mm or working_distance_mm(calibration)
    out: list[Suggestion] = []
    before = _error(bundle.camera, information, noise, distance)
    for _ in range(count):
        after = {words: _error(bundle.camera, information + added, noise, distance) for words, added in candidates.items()}
        if not after or not np.isfinite(before):
            break
        best = min(after, key=lambda words: after[words])
        if after[best] >= before:
            break
        out.append(Suggestion(best, before, after[best]))
        information, before = information + candidates.pop(best), after[best]
    return tuple(out)


def _candidate_poses(calibration: Calibration) -> dict[str, tuple[Array, Array]]:
    """Rotation and translation of the board for each candidate, in words."""
    camera, board = calibration.camera, calibration.board
    width, height = camera.width_px, camera.height_px
    distance = 2 * board.half_mm * float(camera.focal_px.mean()) / (FILL * min(width, height))
    inset = FILL / 2 * min(width, height)
    poses = {}
    for place, (x, y) in PLACES.items():
        pixel = np.array([inset + x * (width - 2 * inset), inset + y * (height - 2 * inset)])
        ray = camera.unproject(pixel)
        if not np.isfinite(ray).all():
            continue
        for tilt, (about_x, about_y) in TILTS.items():
            rotation = rotation_from_vector(TILT_RAD * np.array([[about_x, about_y, 0.0]]))[0]
            middle = ray / ray[2] * distance
            poses[f"the board in {place} of the picture, about {float(f'{distance:.2g}'):g} mm away, {tilt}"] = (
                rotation,
                middle - rotation @ np.append(board.middle_mm, 0.0),
            )
    return poses


def _information(calibration: Calibration, pose: tuple[Array, Array], free: NDArray[np.bool_], prior: Prior) -> Array:
    """What one more view of the whole board adds to the information on the shared parameters."""
    known, board = calibration.bundle, calibration.board
    bundle = replace(known, rotation=pose[0][None], translation_mm=pose[1][None], motion=np.zeros((1, 6)))
    points = board.points_mm
    corners = BoardCorners(
        *(np.zeros((len(points), 2)), points, np.array([0, len(points)]), shapes_of(points, board.middle_mm, board.half_mm)),
        *(np.arange(len(points)), np.zeros(len(points)), board.middle_mm),
    )
    pixels = -bundle.residuals(corners)
    seen = np.isfinite(pixels).all(axis=1) & bundle.camera.contains(pixels)
    size = int(free.sum())
    if seen.mean() < FEWEST_VISIBLE:
        return np.zeros((size, size))
    at_rest = replace(prior, print_mm=0.0, motion=None)
    return np.asarray(el.reduced(el.normal_equations(bundle, corners, free, seen.astype(float), at_rest))[0][0])


def _error(camera: Camera, information: Array, noise_px: float, distance_mm: float) -> float:
    """Expected error of shapes, rms over the whole picture, px."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    covariance = noise_px**2 * np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    count = len(camera.parameters)
    return projection_error(replace(camera, covariance=covariance[:count, :count]), GRID, distance_mm=distance_mm).rms_px
