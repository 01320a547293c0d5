"""How poses follow the camera, against actual fits, and their mirrored twins."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import FISHEYE, WIDE, facing_towards, named_ellipses, noiseless, one_target

from dishmap.camera.model import Camera
from dishmap.simulate.render import simulate
from dishmap.targets.builders import multi_circular, ring
from dishmap.targets.edges import Poses
from dishmap.targets.pose import measure_targets
from dishmap.targets.sensitivity import mirrored, mirrored_normals

Array = NDArray[np.float64]

# The Jacobian samples the outline; the fit weighs pixels. Differences of two fits have their stopping error on top.
JACOBIAN_PART = 0.02
TINY_NOISE_GREY = 0.02

VIEWS = {
    "axis": (Camera(400, 300, [3000.0, 3000.0], [199.5, 149.5]), (240.0, 170.0), 3000.0),
    "edge of 90 degrees": (WIDE, (880.0, 640.0), 420.0),
    "fisheye": (FISHEYE, (740.0, 270.0), 270.0),
}
# Steps of the camera's parameters that move the picture by a few tenths of a pixel.
STEPS = {"fx": 0.3, "fy": 0.3, "cx": 0.2, "cy": 0.2, "p1": 1e-4, "p2": 1e-4}
OTHER_STEP = 3e-4


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("four", [False, True], ids=["ring", "four rings"])
def test_calibration_jacobian_is_how_the_fit_follows_the_camera(view: str, four: bool) -> None:
    camera, pixel, focal_px = VIEWS[view]
    scale = 500 / focal_px
    kind = multi_circular(4, 9 * scale, 5.4 * scale, 25 * scale) if four else ring(14 * scale, 8.4 * scale)
    scene = noiseless(one_target(kind), camera, facing_towards(camera, pixel, 500.0, np.radians(25), 0.7))
    rng = np.random.default_rng(1)
    image = simulate(scene, rng).image / np.float32(257)
    image += np.float32(TINY_NOISE_GREY) * rng.standard_normal(image.shape, dtype=np.float32)
    found = named_ellipses(scene, rng)
    jacobian = measure_targets(image, camera, scene.pattern, *found).calibration_jacobian[0]
    assert jacobian.shape == (3, len(camera.parameter_names))
    for column, name in enumerate(camera.parameter_names):
        step = STEPS.get(name, OTHER_STEP)
        ends = []
        for sign in (1, -1):
            parameters = camera.parameters + sign * step * np.eye(len(camera.parameters))[column]
            ends.append(measure_targets(image, camera.with_parameters(parameters), scene.pattern, *found).position_mm[0])
        difference = (ends[0] - ends[1]) / (2 * step)
        assert np.linalg.norm(jacobian[:, column] - difference) < JACOBIAN_PART * np.linalg.norm(difference), name


@given(st.floats(0.05, 1.2), st.floats(0, 6.28), st.floats(0, 300), st.floats(0, 300))
def test_mirrored_normals(tilt: float, turn: float, u: float, v: float) -> None:
    pose = facing_towards(VIEWS["axis"][0], (u, v), 500.0, tilt, turn)
    poses = Poses(pose.rotation[None], pose.translation_mm[None])
    mirrored, normal, ray = mirrored_normals(poses)[0], poses.rotation[0, :, 2], poses.position_mm[0] / 500
    assert np.linalg.norm(mirrored) == pytest.approx(1)
    # as far from the line of sight, on its other side
    assert mirrored @ ray == pytest.approx(normal @ ray)
    np.testing.assert_allclose(mirrored - (mirrored @ ray) * ray, -(normal - (normal @ ray) * ray), atol=1e-9)
    twice = mirrored_normals(Poses(np.stack([pose.rotation[:, 0], pose.rotation[:, 1], mirrored], axis=1)[None], poses.position_mm))
    np.testing.assert_allclose(twice[0], normal, atol=1e-9)


def test_mirrored_poses_turn_in_place_to_the_mirrored_normal() -> None:
    camera, pixel, _ = VIEWS["axis"]
    pose = facing_towards(camera, pixel, 500.0, 0.4, 0.7)
    poses = Poses(pose.rotation[None], pose.translation_mm[None])
    other = mirrored(poses)
    np.testing.assert_array_equal(other.position_mm, poses.position_mm)
    np.testing.assert_allclose(other.rotation[0, :, 2], mirrored_normals(poses)[0], atol=1e-12)
    # by twice the tilt, the least turn that does it
    assert np.trace(other.rotation[0].T @ poses.rotation[0]) == pytest.approx(1 + 2 * np.cos(0.8))
    facing = Poses(facing_towards(camera, pixel, 500.0, 0.0, 0.7).rotation[None], poses.position_mm)
    np.testing.assert_allclose(mirrored(facing).rotation, facing.rotation, atol=1e-12)
