"""Rings hardly wider than the blur: their tone curve is not made up, their depth is as good as claimed, and few are refused."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import CLEAR, Measured, measured

from dishmap.camera.model import Camera
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.targets.builders import concentric, plate, ring
from dishmap.targets.pattern import TargetKind

FOCAL_PX, DISTANCE_MM = 3000.0, 500.0
CAMERA = Camera(320, 280, [FOCAL_PX, FOCAL_PX], [159.5, 139.5])
PX = DISTANCE_MM / FOCAL_PX


def photographed(kind: TargetKind, pitch_mm: float, psf_px: float, tilt_deg: float, seed: int) -> Measured:
    pose = facing_pose(DISTANCE_MM, np.radians(tilt_deg), 0.7)
    return measured(
        Scene(plate(5, 5, pitch_mm, kind), CAMERA, pose, light=CLEAR, sensor=Sensor(psf_px, noise_grey=1.0)), np.random.default_rng(seed)
    )


@pytest.mark.parametrize("tilt_deg", [20.0, 35.0])
@pytest.mark.parametrize("kind", [ring(6 * PX, 3.6 * PX), concentric((8 * PX, 6 * PX, 4 * PX))], ids=["ring", "concentric"])
def test_depth_of_rings_as_wide_as_the_blur(kind: TargetKind, tilt_deg: float) -> None:
    """A tone curve off by 0.3 in log gamma would put all depths off by 2 of their sigmas."""
    found = photographed(kind, 3.1 * kind.extent_mm, 2.0, tilt_deg, 1)
    assert len(found.poses) == 25
    score = found.position_error_mm[:, 2] / found.sigma_depth_mm
    # 25 depths share one tone curve, so they are not independent
    assert np.sqrt((score**2).mean()) < 1.6
    assert abs(found.poses.log_gamma) < 0.25


@pytest.mark.parametrize("seed", range(2))
def test_small_rings_close_together_are_not_refused(seed: int) -> None:
    """Their blurs are known to a few percent only; the ground between them is 3.5 blurs wide."""
    blur = float(np.hypot(1.2, 12**-0.5))
    found = photographed(ring(6 * PX, 3.6 * PX), (12 + 3.5 * blur) * PX, 1.2, 10.0, seed)
    assert len(found.poses) == 25
    assert not found.poses.rejected
    assert np.sqrt(((found.position_error_mm[:, 2] / found.sigma_depth_mm) ** 2).mean()) < 1.6
