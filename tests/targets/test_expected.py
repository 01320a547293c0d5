"""What is expected of targets: the spread of normals that would be learnt, neighbours' ink, and the bound at the same prior."""

from __future__ import annotations

import numpy as np
import pytest

from dishmap.camera.model import Camera
from dishmap.simulate.scene import facing_pose
from dishmap.targets.bound import target_bound
from dishmap.targets.builders import multi_circular, plate, ring
from dishmap.targets.expected import Expected, expected_targets, learnt_spread
from dishmap.targets.pattern import Pattern
from dishmap.targets.stages import Assumptions
from dishmap.targets.start import nominal_poses

CAMERA = Camera(640, 480, [1500.0, 1500.0], [319.5, 239.5])
AT = facing_pose(650.0, 0.3, 0.5)


def expected(pattern: Pattern, normal_sigma_deg: float | None = 0.1, stray_rad: float = 0.0) -> Expected:
    assumptions = Assumptions(normal_sigma_deg=normal_sigma_deg)
    return expected_targets(CAMERA, pattern, np.arange(len(pattern)), AT, 40.0, 0.8, stray_rad, assumptions)


def test_the_spread_that_is_learnt() -> None:
    """Tilts that are well seen show their true spread; tilts that are not leave it nearly as wide as their own sigma."""
    seen = np.tile(1e-10 * np.eye(2), (50, 1, 1))
    # averaged over the likelihood, 100 tilts give it to a few percent
    assert learnt_spread(seen, 0.002) == pytest.approx(0.002, rel=0.05)
    unseen = np.tile(0.01**2 * np.eye(2), (50, 1, 1))
    assert 0.002 < learnt_spread(unseen, 0.0) < 0.01
    # the fewer the targets, the less is learnt
    assert learnt_spread(unseen[:10], 0.0) > learnt_spread(unseen, 0.0)


def test_the_prior_on_normals_is_the_given_or_the_learnt_one() -> None:
    pattern = plate(4, 5, 40.0)
    given, learnt = expected(pattern), expected(pattern, None, np.radians(0.1))
    assert given.normal_sigma_rad == pytest.approx(np.radians(0.1))
    # 40 tilts, each known to a fraction of the spread
    assert learnt.normal_sigma_rad == pytest.approx(np.radians(0.1), rel=0.15)
    assert expected(pattern, None).normal_sigma_rad < 0.5 * learnt.normal_sigma_rad


def test_sigmas_are_the_bound_at_the_same_prior() -> None:
    pattern, rows = plate(4, 5, 40.0), np.array([0, 7, 19])
    found = expected(pattern)
    for row in rows:
        poses = nominal_poses(pattern, np.array([row]), AT)
        bound = target_bound(CAMERA, multi_circular(), poses, 40.0, 0.8, normal_sigma_rad=np.radians(0.1))
        np.testing.assert_allclose(found.covariance[row, :3, :3], bound.covariance_mm2[0], rtol=0.02, atol=1e-6)
        np.testing.assert_allclose(found.covariance_px2[row], bound.covariance_px2[0], rtol=0.02, atol=1e-7)
        assert found.sigma_normal_rad[row] == pytest.approx(bound.normal_rad[0], rel=0.02)


def test_neighbours_cost_information() -> None:
    """Rings whose neighbours' ink comes within a few blurs lose the pixels beside it, as in a measurement."""
    radius_mm = 8.0
    free, crowded = (expected(plate(3, 3, pitch, ring(radius_mm, 4.8))) for pitch in (40.0, 2 * radius_mm + 0.8))
    # 0.8 mm are 1.8 px or two blurs: the middle target has neighbours on four sides
    assert np.trace(crowded.covariance_px2[4]) > 1.05 * np.trace(free.covariance_px2[4])
