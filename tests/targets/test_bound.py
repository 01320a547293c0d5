"""The Cramer-Rao bound against the closed form of an edge, its scaling, and the sigmas that the fit claims."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CLEAR, PLAIN, facing_towards, measured

from dishmap.camera.model import Camera
from dishmap.errors import InputError
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.targets.bound import Bound, edge_sigma_px, pattern_bound, target_bound
from dishmap.targets.builders import disc, multi_circular, plate, ring
from dishmap.targets.edges import Poses
from dishmap.targets.pattern import Pattern, TargetKind
from dishmap.targets.pose import Assumptions
from dishmap.targets.start import nominal_poses

Array = NDArray[np.float64]

# The closed form knows no unknown light; across a ring its slopes and bend take a little of the edge's information.
CLOSED_FORM_PART = 0.12
# The design page's example, which knows nothing of the light's bend.
DESIGN_PART = 0.2
KNOWN_RAD = 1e-4
# Claimed sigmas come from residuals: a target of 600 pixels knows its noise to 3 %.
CLAIMED_PART = 0.10
# What the priors still say at a contrast of 400 times the noise.
PRIOR_PART = 0.02
DISTANCE_MM = 1000.0
CAMERA = Camera(400, 300, [3000.0, 3000.0], [199.5, 149.5])


def facing(tilt_deg: float = 0.0, distance_mm: float = DISTANCE_MM, camera: Camera = CAMERA) -> Poses:
    pose = facing_towards(camera, (199.5, 149.5), distance_mm, np.radians(tilt_deg), 0.3)
    return Poses(pose.rotation[None], pose.translation_mm[None])


def center_sigma_px(bound: Bound) -> Array:
    return np.sqrt(bound.covariance_px2[0].diagonal())


def test_straight_edge() -> None:
    """sqrt(2 sqrt(pi) s) / C: the Fisher information of one row of samples across a blurred step, summed."""
    x = np.linspace(-20, 20, 40_001)
    blur, contrast = 0.85, 40.0
    slope = np.exp(-0.5 * (x / blur) ** 2) / (blur * np.sqrt(2 * np.pi))
    information = contrast**2 * (slope**2).sum() * (x[1] - x[0])
    assert edge_sigma_px(blur, contrast) == pytest.approx(information**-0.5, rel=1e-6)


@pytest.mark.parametrize("psf_px", [0.8, 1.5])
@pytest.mark.parametrize("outer_px", [20.0, 35.0])
def test_center_of_a_facing_ring_is_the_closed_form(psf_px: float, outer_px: float) -> None:
    """Of the edges' length half counts for each coordinate: sigma = edge sigma / sqrt(length / 2)."""
    scale = DISTANCE_MM / 3000.0
    kind = ring(outer_px * scale, 0.6 * outer_px * scale)
    # a normal that is not known at all would add its own share: tilt moves a circle's centre within its ellipse
    bound = target_bound(CAMERA, kind, facing(), 40.0, psf_px, normal_sigma_rad=KNOWN_RAD)
    length = 2 * np.pi * outer_px * 1.6
    expected = edge_sigma_px(float(np.hypot(psf_px, 12**-0.5)), 40.0) / np.sqrt(length / 2)
    np.testing.assert_allclose(center_sigma_px(bound), expected, rtol=CLOSED_FORM_PART)
    # no bound is below what light that is known would give
    assert (center_sigma_px(bound) > 0.99 * expected).all()


@pytest.mark.parametrize("kind", [ring(2.4, 1.4), multi_circular(4, 2.4, 1.4, 6.8)], ids=["ring", "four rings"])
def test_bounds_shrink_with_the_noise_down_to_none(kind: TargetKind) -> None:
    """Face on, what tells ink spread from blooming is the priors alone, a millionth of the information of a clean photograph."""
    some, clean = (target_bound(CAMERA, kind, facing(), contrast, 1.2) for contrast in (400.0, 40_000.0))
    np.testing.assert_allclose(100 * center_sigma_px(clean), center_sigma_px(some), rtol=PRIOR_PART)
    np.testing.assert_allclose(100 * clean.depth_mm, some.depth_mm, rtol=PRIOR_PART)


def test_the_design_page_example() -> None:
    """Four rings of 5 and 3 mm on a 14 mm square at 1 m, f 3000 px, psf 0.8 px, C 40: centre 0.0025 px, depth 0.10 mm."""
    bound = target_bound(CAMERA, multi_circular(), facing(5.0), 40.0, 0.8)
    np.testing.assert_allclose(center_sigma_px(bound), 0.0025, rtol=DESIGN_PART)
    assert bound.depth_mm[0] == pytest.approx(0.10, rel=DESIGN_PART)
    tilted = target_bound(CAMERA, multi_circular(), facing(20.0), 40.0, 0.8)
    assert np.degrees(tilted.normal_rad[0]) < 0.5 * np.degrees(bound.normal_rad[0])


@pytest.mark.parametrize("factor", [2.0, 3.5])
def test_sigmas_scale_with_noise_and_with_the_target(factor: float) -> None:
    kind = multi_circular()
    one, quiet = (target_bound(CAMERA, kind, facing(20.0), c, 0.8) for c in (40.0, 40.0 * factor))
    np.testing.assert_allclose(center_sigma_px(one) / center_sigma_px(quiet), factor, rtol=0.01)
    # the priors on ink and tone are fixed, so depth gains a little less
    assert 0.9 * factor < one.depth_mm[0] / quiet.depth_mm[0] < 1.01 * factor
    # twice as near and half as large: the same picture
    near = TargetKind(kind.center_mm / 2, kind.radius_mm / 2, kind.dark)
    same = target_bound(CAMERA, near, facing(20.0, DISTANCE_MM / 2), 40.0, 0.8)
    np.testing.assert_allclose(same.covariance_px2, one.covariance_px2, rtol=0.01)
    assert same.depth_mm[0] == pytest.approx(one.depth_mm[0] / 2, rel=0.01)


def test_a_lone_disc_rests_on_the_assumed_ink() -> None:
    """Its depth is as uncertain as its radius: 2 % of the distance, and the tone's 0.3 px on top; a ring's is not."""
    radius_px = 30.0
    radius = radius_px * DISTANCE_MM / 3000
    lone = target_bound(CAMERA, disc(radius), facing(), 80.0, 0.8)
    assert lone.depth_mm[0] == pytest.approx(DISTANCE_MM * np.hypot(0.02, 0.3 / radius_px), rel=0.1)
    surer = target_bound(CAMERA, disc(radius), facing(), 80.0, 0.8, assumptions=Assumptions(ink_spread_fraction=0.001, tone_shift_px=0.01))
    assert surer.depth_mm[0] < 0.1 * lone.depth_mm[0]
    assert target_bound(CAMERA, ring(radius, 0.6 * radius), facing(), 80.0, 0.8).depth_mm[0] < 0.02 * lone.depth_mm[0]


def test_a_prior_on_normals_helps_where_tilt_is_weak() -> None:
    free = target_bound(CAMERA, ring(), facing(2.0), 40.0, 0.8)
    held = target_bound(CAMERA, ring(), facing(2.0), 40.0, 0.8, normal_sigma_rad=np.radians(0.1))
    assert np.degrees(held.normal_rad[0]) < 0.15
    assert free.normal_rad[0] > 3 * held.normal_rad[0]
    assert free.depth_mm[0] > held.depth_mm[0]


def test_bounds_of_a_pattern_are_those_of_its_targets_in_order() -> None:
    kinds = {"a": ring(4.0, 2.4), "b": multi_circular(4, 1.5, 0.9, 4.2)}
    place = [[-15.0, 0, 0], [0.0, 3, 0], [15.0, -4, 0]]
    pattern = Pattern("mixed", plate(1, 1, 9.0, ring()).surface, kinds, [3, 1, 2], ["b", "a", "b"], place, [[1, 0, 0]] * 3, [[0, 0, 1]] * 3)
    poses = nominal_poses(pattern, np.arange(3), facing_pose(400.0, 0.3))
    together = pattern_bound(PLAIN, pattern, poses, 40.0, 0.8)
    for i, name in enumerate(pattern.kind_names):
        alone = target_bound(PLAIN, kinds[name], poses.take(np.array([i])), 40.0, 0.8)
        assert together.depth_mm[i] == pytest.approx(alone.depth_mm[0], rel=1e-3)
        np.testing.assert_allclose(together.covariance_px2[i], alone.covariance_px2[0], rtol=0.01, atol=1e-9)


@pytest.mark.parametrize("numbers", [(0.0, 0.8, 1.0), (40.0, -1.0, 1.0), (40.0, 0.8, 0.0), (np.nan, 0.8, 1.0)])
def test_impossible_numbers(numbers: tuple[float, float, float]) -> None:
    with pytest.raises(InputError, match="a bound needs a positive contrast-to-noise ratio, blur and normal sigma"):
        target_bound(CAMERA, ring(), facing(), numbers[0], numbers[1], normal_sigma_rad=numbers[2])


@pytest.mark.parametrize(("kind", "tilt_deg"), [(ring(6.0, 3.6), 5.0), (ring(6.0, 3.6), 35.0), (multi_circular(4, 4.0, 2.4, 11.2), 20.0)])
def test_claimed_sigmas_are_the_bound(kind: TargetKind, tilt_deg: float) -> None:
    camera = Camera(400, 330, [1500.0, 1500.0], [199.5, 164.5])
    noise, contrast = 2.0, CLEAR.ground_grey - CLEAR.ink_grey
    pattern = plate(3, 4, 28.0, kind)
    scene = Scene(pattern, camera, facing_pose(500.0, np.radians(tilt_deg), 0.7), light=CLEAR, sensor=Sensor(0.8, noise_grey=noise))
    found = measured(scene, np.random.default_rng(5))
    assert len(found.poses) == len(pattern)
    poses = nominal_poses(pattern, np.arange(len(pattern)), scene.camera_from_dish)
    # rounding to 8 bits is noise too
    ratio = contrast / np.hypot(noise, 12**-0.5)
    bound = target_bound(camera, kind, poses, ratio, 0.8, normal_sigma_rad=found.poses.normal_sigma_rad)
    assert np.median(found.sigma_depth_mm / bound.depth_mm) == pytest.approx(1, abs=CLAIMED_PART)
    assert np.median(found.sigma_center_px[:, 0] / np.sqrt(bound.covariance_px2[:, 0, 0])) == pytest.approx(1, abs=CLAIMED_PART)
    assert np.median(found.poses.sigma_normal_rad / bound.normal_rad) == pytest.approx(1, abs=CLAIMED_PART)
