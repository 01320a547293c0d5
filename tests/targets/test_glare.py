"""Smooth light beside a ring is seen in its residuals, flagged, and no longer moves the target by many claimed sigmas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import measured

from dishmap.camera.model import Camera
from dishmap.quality import Quality
from dishmap.simulate.scene import Glare, Light, Scene, Sensor, facing_pose
from dishmap.targets.builders import plate, ring

CAMERA = Camera(460, 360, [1500.0, 1500.0], [229.5, 179.5])
RADIUS_PX = 15.0
SCENE = Scene(
    plate(3, 4, 27.0, ring(5.0, 3.0)),
    CAMERA,
    facing_pose(500.0, np.radians(15.0), 0.7),
    light=Light(ink_grey=25.0, ground_grey=170.0, background_grey=170.0, gradient=(0.25, -0.2), vignetting=0.3),
    sensor=Sensor(0.8, noise_grey=2.5),
)
LIT = 5
# Farther off than this, in claimed sigmas, would be a lie even with a flag.
LIE_SIGMAS = 5.0


def with_glare(angle_rad: float, part: float, peak_grey: float) -> Scene:
    """A blob of light 1.3 radii beside one target."""
    center = CAMERA.project(SCENE.camera_from_dish.apply(SCENE.pattern.center_mm[LIT]))
    place = center + 1.3 * RADIUS_PX * np.array([np.cos(angle_rad), np.sin(angle_rad)])
    blob = Glare((float(place[0]), float(place[1])), part * RADIUS_PX, peak_grey)
    return replace(SCENE, light=replace(SCENE.light, glare=(blob,)))


@pytest.mark.parametrize("peak_grey", [15.0, 40.0])
@pytest.mark.parametrize(("angle_rad", "part"), [(0.0, 0.6), (2.0, 0.8), (4.0, 1.0)])
def test_light_beside_a_ring_is_flagged_and_taken_out(angle_rad: float, part: float, peak_grey: float) -> None:
    found = measured(with_glare(angle_rad, part, peak_grey), np.random.default_rng(3))
    assert (np.abs(found.center_error_px / found.sigma_center_px) < LIE_SIGMAS).all()
    assert (np.abs(found.position_error_mm[:, 2] / found.sigma_depth_mm) < LIE_SIGMAS).all()
    if peak_grey > 20:
        assert found.poses.quality[LIT] & Quality.GLARE
        # it pays with a larger sigma than its neighbours have
        assert found.sigma_center_px[LIT].max() > 1.05 * np.median(found.sigma_center_px)


def test_even_shading_is_no_glare() -> None:
    """48 targets under a gradient and vignetting; of clean ones 0.2 % may be flagged."""
    found = [measured(SCENE, np.random.default_rng(seed)) for seed in range(4)]
    assert sum(int((m.poses.quality & Quality.GLARE != 0).sum()) for m in found) <= 1
    depth = np.concatenate([m.position_error_mm[:, 2] / m.sigma_depth_mm for m in found])
    assert np.sqrt((depth**2).mean()) < 1.3
