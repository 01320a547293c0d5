"""Targets that stand within a few blurs of each other: measured without bias, for neighbours' ink is left out."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import CLEAR, group_of, measured

from dishmap.camera.model import Camera
from dishmap.quality import Quality
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.targets.builders import plate, ring
from dishmap.targets.edges import Poses
from dishmap.targets.neighbours import LEAST_FREE, Ink, clear_of_neighbours, ink_of
from dishmap.targets.pattern import Pattern, TargetKind
from dishmap.targets.stages import layout

DISTANCE_MM, FOCAL_PX = 500.0, 1500.0
CAMERA = Camera(420, 340, [FOCAL_PX, FOCAL_PX], [209.5, 169.5])
RING = ring(8.0, 4.8)
PSF_PX = 1.2
BLUR_PX = float(np.hypot(PSF_PX, 12**-0.5))
# Standard errors of a mean of 40 scores.
MEAN_SIGMAS = 4.0


def crowded(gap_blurs: float, kind: TargetKind = RING) -> Scene:
    pitch = 2 * kind.extent_mm + gap_blurs * BLUR_PX * DISTANCE_MM / FOCAL_PX
    sensor = Sensor(PSF_PX, noise_grey=1.5)
    return Scene(plate(4, 5, pitch, kind), CAMERA, facing_pose(DISTANCE_MM, np.radians(12.0), 0.7), light=CLEAR, sensor=sensor)


@pytest.mark.parametrize("gap_blurs", [1.5, 2.0, 3.0, 4.0, 5.0, 8.0])
def test_depth_among_close_neighbours_is_as_good_as_claimed(gap_blurs: float) -> None:
    """At 3 and 4 blurs depths would be 1.3 to 2 sigma too long."""
    found = [measured(crowded(gap_blurs), np.random.default_rng(seed)) for seed in range(2)]
    depth = np.concatenate([m.position_error_mm[:, 2] / m.sigma_depth_mm for m in found])
    center = np.concatenate([m.center_error_px / m.sigma_center_px for m in found])
    assert len(depth) == 40
    assert abs(depth.mean()) < MEAN_SIGMAS / np.sqrt(len(depth))
    assert np.sqrt((depth**2).mean()) < 1.4
    assert np.sqrt((center**2).mean()) < 1.3
    # nothing is hidden of what was left out on purpose
    assert not (np.concatenate([m.poses.quality for m in found]) & (Quality.OCCLUDED | Quality.POOR_FIT)).any()


def two_rings(gap_px: float) -> tuple[Pattern, Poses]:
    """Two rings side by side, seen face on in the middle of the image."""
    apart = 2 * RING.extent_mm + gap_px * DISTANCE_MM / FOCAL_PX
    position = np.array([[-apart / 2, 0.0, DISTANCE_MM], [apart / 2, 0.0, DISTANCE_MM]])
    poses = Poses(np.tile(np.diag([1.0, -1.0, -1.0]), (2, 1, 1)), position)
    return plate(1, 2, apart, RING), poses


@pytest.mark.parametrize("gap_px", [1.0, 3.0, 6.0])
def test_pixels_near_a_neighbour_are_left_out_and_no_others(gap_px: float) -> None:
    pattern, poses = two_rings(gap_px)
    _, pixels = layout(np.zeros((340, 420), np.uint8), group_of(CAMERA, RING, poses, BLUR_PX), BLUR_PX, BLUR_PX)
    ink = ink_of(CAMERA, pattern, [(RING, np.arange(2), poses)])
    left = clear_of_neighbours(pixels, np.arange(2), ink, np.full(2, BLUR_PX))
    u = pixels.patches.anchor_px[:, :1] + pixels.s * pixels.patches.scale_px[:, None]
    v = pixels.patches.anchor_px[:, 1:] + pixels.t * pixels.patches.scale_px[:, None]
    other = CAMERA.project(poses.position_mm)[::-1]
    away = np.hypot(u - other[:, :1], v - other[:, 1:]) - RING.extent_mm * FOCAL_PX / DISTANCE_MM
    gone = pixels.used & ~left.used
    assert gone.any()
    assert away[left.used].min() > 3 * BLUR_PX
    assert away[gone].max() < 3.5 * BLUR_PX
    assert left.blocked is None or not left.blocked.any()


def test_far_neighbours_cost_nothing() -> None:
    pattern, poses = two_rings(30.0)
    _, pixels = layout(np.zeros((340, 420), np.uint8), group_of(CAMERA, RING, poses, BLUR_PX), BLUR_PX, BLUR_PX)
    assert clear_of_neighbours(pixels, np.arange(2), ink_of(CAMERA, pattern, [(RING, np.arange(2), poses)]), np.full(2, BLUR_PX)) is pixels


def test_a_ring_of_which_little_is_left_counts_as_occluded() -> None:
    pattern, poses = two_rings(1.0)
    _, pixels = layout(np.zeros((340, 420), np.uint8), group_of(CAMERA, RING, poses, BLUR_PX), BLUR_PX, BLUR_PX)
    # a neighbour ten times as large, up to the ring's middle: its edge is nearly straight
    ink, middle = ink_of(CAMERA, pattern, [(RING, np.arange(2), poses)]), CAMERA.project(poses.position_mm)
    away = 10 * float(ink.reach_px[0]) + 1
    wide = Ink(ink.target, middle[::-1] + [[-away, 0.0], [away, 0.0]], ink.metric / 100, 10 * ink.reach_px)
    left = clear_of_neighbours(pixels, np.arange(2), wide, np.full(2, BLUR_PX))
    assert left.blocked is not None
    np.testing.assert_array_equal(left.used, pixels.used)
    assert (left.blocked.sum(axis=1) > (1 - LEAST_FREE) * pixels.used.sum(axis=1)).all()
