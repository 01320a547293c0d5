"""Targets measured again where an earlier photograph had them: the same numbers as a measurement from scratch, and no confident mistake."""

from __future__ import annotations

import numpy as np
import pytest

from dishmap.camera.model import Camera
from dishmap.errors import CameraError, MeasurementError
from dishmap.pipeline import map_photograph
from dishmap.simulate.deform import Deformation, ZernikeTerm
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.targets.builders import dish
from dishmap.targets.identify import Upright
from dishmap.targets.pose import TargetPoses
from dishmap.targets.track import track_targets
from dishmap.transforms import Pose

CAMERA = Camera(1000, 1000, np.full(2, 900.0), np.full(2, 499.5))
DISH = dish(300.0, 150.0, spacing_mm=60.0)
SCENE = Scene(DISH, CAMERA, facing_pose(340.0, 0.03), sensor=Sensor(psf_sigma_px=0.8, noise_grey=1.5))


@pytest.fixture(scope="module")
def reference() -> TargetPoses:
    result = map_photograph(simulate(SCENE, np.random.default_rng(1)).image, CAMERA, DISH, Upright())
    assert isinstance(result.poses, TargetPoses)
    return result.poses


def moved(motion_mm: tuple[float, float, float], bend_mm: float = 0.0) -> Scene:
    bend = (ZernikeTerm(2, 2, bend_mm),) if bend_mm else ()
    return SCENE.with_state(Deformation(zernike=bend, motion=Pose(np.eye(3), np.array(motion_mm))))


def test_tracking_finds_what_a_search_finds(reference: TargetPoses) -> None:
    # 0.5 mm is 1.3 px
    picture = simulate(moved((0.5, -0.3, 0.4), 0.5), np.random.default_rng(2))
    tracked = track_targets(picture.image, CAMERA, DISH, reference)
    searched = map_photograph(picture.image, CAMERA, DISH, Upright()).poses
    assert isinstance(searched, TargetPoses)
    assert tracked.ids.tolist() == searched.ids.tolist()
    # two starts of one fit differ by what convergence leaves, a tenth of a sigma
    sigma = np.sqrt(np.diagonal(searched.covariance[:, :3, :3], axis1=1, axis2=2))
    assert np.abs((tracked.position_mm - searched.position_mm) / sigma).max() < 0.3
    error = tracked.center_px - picture.truth.center_px[tracked.index]
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.02


@pytest.mark.parametrize("motion_mm", [(15.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.0, 0.0, 60.0)])
def test_too_large_a_motion_is_refused_or_right(reference: TargetPoses, motion_mm: tuple[float, float, float]) -> None:
    picture = simulate(moved(motion_mm), np.random.default_rng(3))
    try:
        tracked = track_targets(picture.image, CAMERA, DISH, reference)
    except MeasurementError:
        return
    error = np.linalg.norm(tracked.center_px - picture.truth.center_px[tracked.index], axis=1)
    assert error.max() < 0.1


def test_another_camera_is_refused(reference: TargetPoses) -> None:
    with pytest.raises(CameraError, match="calibrated at"):
        track_targets(np.zeros((500, 500), np.uint8), CAMERA, DISH, reference)


def test_an_empty_picture_is_refused(reference: TargetPoses) -> None:
    with pytest.raises(MeasurementError):
        track_targets(np.full((1000, 1000), 120, np.uint8), CAMERA, DISH, reference)
