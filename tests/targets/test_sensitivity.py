"""How poses follow the camera, and what tells a pose from its mirrored twin, against actual fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import FISHEYE, WIDE, facing_towards, group_of, named_ellipses, noiseless, one_target

from dishmap.camera.model import Camera
from dishmap.simulate.render import simulate
from dishmap.targets.adjust import adjust
from dishmap.targets.builders import multi_circular, ring
from dishmap.targets.edges import Poses
from dishmap.targets.pattern import TargetKind
from dishmap.targets.pixels import Weighting
from dishmap.targets.pose import measure_targets
from dishmap.targets.sensitivity import mirror_evidence, mirrored_normals
from dishmap.targets.stages import layout
from dishmap.transforms import angle_between_rad, rotation_from_vector

Array = NDArray[np.float64]

# The Jacobian samples the outline; the fit weighs pixels. Differences of two fits have their stopping error on top.
JACOBIAN_PART = 0.02
# Light levels of each ring are free in the fit: they take up to half of what tells the mirrored pose of a single ring, and an
# eighth with four rings. The evidence leaves them out, so it may not be less than the fit's rise, nor much more than twice.
EVIDENCE_LEAST, EVIDENCE_MOST = 0.9, 2.6
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


@pytest.mark.parametrize("kind", [ring(6.0, 3.6), multi_circular(4, 2.5, 1.5, 7.0)], ids=["ring", "four rings"])
@pytest.mark.parametrize("tilt_deg", [8.0, 15.0, 30.0])
def test_mirror_evidence_is_the_rise_of_chi_square_at_the_mirrored_fit(kind: TargetKind, tilt_deg: float) -> None:
    camera = Camera(400, 300, [1500.0, 1500.0], [199.5, 149.5])
    pose = facing_towards(camera, (230.0, 170.0), 300.0, np.radians(tilt_deg), 0.7)
    poses = Poses(pose.rotation[None], pose.translation_mm[None])
    image = simulate(noiseless(one_target(kind), camera, pose), np.random.default_rng(0)).image / np.float32(257)
    blur, sigma, contrast = float(np.hypot(0.8, 12**-0.5)), 4.0, 160.0
    group = group_of(camera, kind, poses, blur)
    # print and camera are known, normals are free: geometry alone must tell
    known = replace(
        group.batch.priors,
        normal_sigma_rad=np.array([10.0]),
        log_gamma_sigma=1e-3,
        offset_mm_sigma=1e-4,
        offset_px_sigma=1e-4,
        log_blur_sigma=1e-3,
        blur_px=blur,
    )
    batch, pixels = layout(image, replace(group, batch=replace(group.batch, priors=known)), blur, blur)
    normal, mirrored = poses.rotation[0, :, 2], mirrored_normals(poses)[0]
    axis = np.cross(normal, mirrored)
    turn = rotation_from_vector(axis / np.linalg.norm(axis) * angle_between_rad(normal, mirrored))
    starts = (poses, Poses(turn[None] @ poses.rotation, poses.position_mm))
    here, there = (adjust(batch, pixels, start, group.state, Weighting(sigma**2, 0.0, None), 40) for start in starts)
    assert angle_between_rad(there.poses.rotation[0, :, 2], mirrored) < np.radians(1), "the mirrored start must stay mirrored"
    rise = float(there.sums.square.sum() - here.sums.square.sum())
    # a pixel of edge has contrast^2 / (2 sqrt(pi) noise^2 blur) of information
    evidence = mirror_evidence(batch, kind, poses, np.array([contrast**2 / (2 * np.sqrt(np.pi) * sigma**2 * blur)]))[0]
    assert EVIDENCE_LEAST * rise < evidence < EVIDENCE_MOST * rise
    # twice the distance and size: half the perspective, a quarter of the evidence
    far = Poses(poses.rotation, 2 * poses.position_mm)
    same = mirror_evidence(batch, kind, far, np.array([4 * contrast**2 / (2 * np.sqrt(np.pi) * sigma**2 * blur)]))[0]
    assert same < 0.5 * evidence
