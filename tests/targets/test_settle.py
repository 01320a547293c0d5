"""Which of two mirrored normals is right: decided by the pixels, light levels free, and said where they cannot decide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CLEAR, facing_towards, group_of, measured, noiseless, one_target

from dishmap.camera.model import Camera
from dishmap.quality import Quality
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.targets.adjust import adjust
from dishmap.targets.builders import multi_circular, plate, ring
from dishmap.targets.edges import Poses
from dishmap.targets.pattern import Pattern, TargetKind
from dishmap.targets.pixels import Weighting
from dishmap.targets.scene_noise import NoiseModel
from dishmap.targets.sensitivity import mirrored
from dishmap.targets.settle import chi_square_rise
from dishmap.targets.stages import layout
from dishmap.transforms import angle_between_rad, rotation_from_vector

Array = NDArray[np.float64]

SIGMA_GREY, BLUR_PX = 4.0, float(np.hypot(0.8, 12**-0.5))
NOISE = NoiseModel(SIGMA_GREY**2, 0.0, 1.0)
PHOTOGRAPHS = 24
# Farther off than this a normal is on the wrong side, not merely noisy.
WRONG_SIGMAS = 5.0


def rises(kind: TargetKind, tilt_deg: float) -> Array:
    """Rise of chi-square from the true to the mirrored pose in PHOTOGRAPHS that differ by their noise."""
    camera = Camera(400, 300, [1500.0, 1500.0], [199.5, 149.5])
    pose = facing_towards(camera, (230.0, 170.0), 300.0, np.radians(tilt_deg), 0.7)
    poses = Poses(pose.rotation[None], pose.translation_mm[None])
    plain = simulate(noiseless(one_target(kind), camera, pose), np.random.default_rng(0)).image / np.float32(257)
    group = group_of(camera, kind, poses, BLUR_PX)
    priors = replace(group.batch.priors, normal_sigma_rad=np.array([10.0]), blur_px=BLUR_PX)
    group = replace(group, batch=replace(group.batch, priors=priors))
    rng, out = np.random.default_rng(1), []
    for _ in range(PHOTOGRAPHS):
        image = plain + np.float32(SIGMA_GREY) * rng.standard_normal(plain.shape, dtype=np.float32)
        batch, pixels = layout(image, group, BLUR_PX, BLUR_PX)
        weighting = Weighting(NOISE.base, 0.0, None)
        fits = [adjust(batch, pixels, start, group.state, weighting, 40) for start in (poses, mirrored(poses))]
        assert all(fit.converged.all() for fit in fits)
        out.append(float(chi_square_rise(priors, pixels, *fits, NOISE)[0]))
    return np.array(out)


@pytest.mark.parametrize(("kind", "tilt_deg"), [(ring(6.0, 3.6), 15.0), (ring(6.0, 3.6), 30.0), (multi_circular(4, 2.5, 1.5, 7.0), 8.0)])
def test_the_rise_of_chi_square_has_the_spread_that_3_sigma_rest_on(kind: TargetKind, tilt_deg: float) -> None:
    """The true pose is better by E, and noise makes that E +- 2 sqrt(E): then 9 the wrong way is 3 sigma or more for every E."""
    seen = rises(kind, tilt_deg)
    expected = float(seen.mean())
    assert expected > 4
    # a standard deviation from 24 values is known to 15 %
    assert 0.5 < seen.std() / (2 * np.sqrt(expected)) < 1.5


def bent(kind: TargetKind, tilt_deg: float, spread_deg: float, seed: int) -> tuple[Scene, Pattern]:
    """A plate whose targets are each turned in place by some degrees, and the flat one that the measurement is told of."""
    camera = Camera(420, 340, [1500.0, 1500.0], [209.5, 169.5])
    flat = plate(3, 4, 2 * kind.extent_mm + 10, kind)
    turns = np.zeros((len(flat), 3))
    turns[:, :2] = np.radians(spread_deg) * np.random.default_rng(seed).standard_normal((len(flat), 2))
    turn = rotation_from_vector(turns)
    axes = (np.einsum("nij,nj->ni", turn, a) for a in (flat.x_axis, flat.normal))
    turned = Pattern(flat.name, flat.surface, flat.kinds, flat.ids, flat.kind_names, flat.center_mm, *axes)
    pose = facing_pose(500.0, np.radians(tilt_deg), 0.7)
    return Scene(turned, camera, pose, light=CLEAR, sensor=Sensor(0.8, noise_grey=2.0)), flat


@pytest.mark.parametrize(("tilt_deg", "spread_deg"), [(10.0, 6.0), (3.0, 3.0), (20.0, 10.0)])
@pytest.mark.parametrize("kind", [ring(6.0, 3.6), ring(12.0, 7.2), multi_circular(4, 4.0, 2.4, 11.2)], ids=["small", "large", "four"])
def test_no_normal_of_a_bent_surface_is_mirrored_without_a_flag(kind: TargetKind, tilt_deg: float, spread_deg: float) -> None:
    doubtful = 0
    for seed in range(2):
        scene, flat = bent(kind, tilt_deg, spread_deg, seed)
        found = measured(scene, np.random.default_rng(seed), nominal=flat)
        flagged = found.poses.quality & Quality.AMBIGUOUS_NORMAL != 0
        score = angle_between_rad(found.poses.normal, found.true_normal) / found.poses.sigma_normal_rad
        assert (score[~flagged] < WRONG_SIGMAS).all()
        depth = found.position_error_mm[:, 2] / found.sigma_depth_mm
        assert (np.abs(depth[~flagged]) < WRONG_SIGMAS).all()
        doubtful += int(flagged.sum())
    # a flag that is always set says nothing
    assert doubtful < 12
