"""First poses from detected ellipses, when a target shows only some of its circles."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import PLAIN, facing_towards

from dishmap.targets.adjust import Batch, Priors
from dishmap.targets.builders import multi_circular
from dishmap.targets.edges import Poses, project_printed
from dishmap.targets.pixels import rings_of
from dishmap.targets.start import ELLIPSE_POINTS, EllipsePoints, fit_ellipses
from dishmap.targets.window import patches_around
from dishmap.transforms import angle_between_rad, rotation_from_vector

Array = NDArray[np.float64]

KIND = multi_circular()
FLAT = np.zeros((1, 2, 2))
PLACE_PX, DISTANCE_MM = (210.0, 160.0), 500.0
# A detected ellipse of a blurred ring is larger by this, px.
TOO_LARGE_PX = 0.8


def seen(poses: Poses, circles: list[int]) -> EllipsePoints:
    """Points on the projected circles, as a detection of a blurred ring would give them."""
    phase = 2 * np.pi * np.arange(ELLIPSE_POINTS) / ELLIPSE_POINTS
    unit = np.stack([np.cos(phase), np.sin(phase)], axis=1)
    pixels = []
    for circle in circles:
        image, _ = project_printed(PLAIN, poses, FLAT, KIND.center_mm[circle] + KIND.radius_mm[circle] * unit)
        middle = image[0].mean(axis=0)
        out = image[0] - middle
        pixels.append(middle + out * (1 + TOO_LARGE_PX / np.linalg.norm(out, axis=1, keepdims=True)))
    return EllipsePoints(np.array(pixels), np.zeros(len(circles), dtype=np.int64), np.array(circles))


def fitted(start: Poses, points: EllipsePoints) -> Poses:
    priors = Priors(start.rotation[..., 2], np.full(1, np.radians(12.0)), 0.1, 0.3, 0.85, 0.4, 0.0, 0.1, False)
    batch = Batch(PLAIN, FLAT, rings_of(KIND), priors)
    whole = np.zeros((1, 2)), np.array([KIND.extent_mm])
    return fit_ellipses(batch, KIND, start, patches_around(PLAIN, start, FLAT, whole, 2.0), points)


def turned(poses: Poses, spin_rad: float) -> Poses:
    return Poses(poses.rotation @ rotation_from_vector(np.array([0.0, 0.0, spin_rad])), poses.position_mm)


def spin_rad(poses: Poses, other: Poses) -> float:
    return float(angle_between_rad(poses.rotation[0, :, 0], other.rotation[0, :, 0]))


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0])
@pytest.mark.parametrize("circle", range(0, 8, 2))
def test_one_circle_of_a_group_does_not_turn_the_target(circle: int, tilt_deg: float) -> None:
    truth = facing_towards(PLAIN, PLACE_PX, DISTANCE_MM, np.radians(tilt_deg), 0.3)
    poses = Poses(truth.rotation[None], truth.translation_mm[None])
    found = fitted(poses, seen(poses, [circle]))
    # one circle says nothing about the turn; a tenth of the step that is allowed is numbers only
    assert spin_rad(found, poses) < 0.15
    # the size is off by 0.8 px of 30, so the depth by some per cent
    assert np.linalg.norm(found.position_mm - poses.position_mm) < 0.08 * DISTANCE_MM


def test_four_circles_turn_the_target_back() -> None:
    truth = facing_towards(PLAIN, PLACE_PX, DISTANCE_MM, np.radians(20.0), 0.3)
    poses = Poses(truth.rotation[None], truth.translation_mm[None])
    found = fitted(turned(poses, 0.05), seen(poses, [0, 2, 4, 6]))
    assert spin_rad(found, poses) < 0.002
