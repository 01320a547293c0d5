"""Photographs that show anything but the targets: each target is refused with a reason, none is made up, and nothing crashes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CLEAR, named_ellipses

from dishmap.camera.model import Camera
from dishmap.errors import ImageError, MeasurementError
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.targets.builders import concentric, disc, multi_circular, plate, ring
from dishmap.targets.pattern import TargetKind
from dishmap.targets.pose import TargetPoses, measure_targets

Image = NDArray[Any]

CAMERA = Camera(320, 240, [900.0, 900.0], [159.5, 119.5], [-0.1, 0.02, 0.0, 0.0])
KINDS = {"ring": ring(1.0, 0.6), "four": multi_circular(4, 1.0, 0.6, 2.8), "nested": concentric((1.0, 0.75, 0.5)), "disc": disc(1.0)}
V, U = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
COIN = np.random.default_rng(1).random(U.shape)


def level(grey: int) -> Callable[[Image], Image]:
    return lambda image: np.full(image.shape, grey, np.uint8)


# Nothing of the targets is left in these.
EMPTY: dict[str, Callable[[Image], Image]] = {
    "black": level(0),
    "grey": level(90),
    "white": level(255),
    "noise": lambda image: (255 * COIN).astype(np.uint8),
    "two levels": lambda image: np.where(COIN < 0.5, 0, 255).astype(np.uint8),
    "ramp": lambda image: np.minimum(U, 255).astype(np.uint8),
    "one pixel": lambda image: np.where((U == 160) & (V == 120), 255, 0).astype(np.uint8),
    "negative": lambda image: 255 - image,
    "below zero": lambda image: -image.astype(float),
}
# And these show some of them, or what may pass for one.
SPOILT: dict[str, Callable[[Image], Image]] = {
    "stripes": lambda image: (U // 3 % 2 * 200).astype(np.uint8),
    "half black": lambda image: np.where(U < 160, 0, image).astype(np.uint8),
    "half white": lambda image: np.where(U < 160, 255, image).astype(np.uint8),
    "salt": lambda image: np.where(COIN < 0.4, 255, image).astype(np.uint8),
    "elsewhere": lambda image: np.roll(image, (7, -9), (0, 1)),
    "no half tones": lambda image: image > 100,
    "half of it lit": lambda image: np.clip(image + 250 * np.exp(-((U - 160) ** 2 + (V - 120) ** 2) / 3200), 0, 255).astype(np.uint8),
}


def shown(kind: TargetKind, seed: int, change: Callable[[Image], Image]) -> TargetPoses | None:
    """Targets of 2 to 15 px radius measured in a changed photograph, or None where all of them were refused at once."""
    rng = np.random.default_rng(seed)
    radius = float(np.exp(rng.uniform(np.log(2.0), np.log(15.0))))
    pose = facing_pose(CAMERA.focal_px[0] / radius, rng.uniform(0, 1.0), rng.uniform(0, 6))
    sensor = Sensor(rng.uniform(0.3, 3.0), noise_grey=rng.uniform(0, 4))
    scene = Scene(plate(2, 2, 2.6 * kind.extent_mm, kind), CAMERA, pose, light=CLEAR, sensor=sensor)
    try:
        return measure_targets(change(simulate(scene, rng).image), CAMERA, scene.pattern, *named_ellipses(scene, rng))
    except MeasurementError:
        return None


@pytest.mark.parametrize("name", EMPTY)
@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_measured_where_nothing_is_shown(kind: str, name: str) -> None:
    found = shown(KINDS[kind], 0, EMPTY[name])
    assert found is None or (not len(found) and all(reason for _, reason in found.rejected))


@pytest.mark.parametrize("name", SPOILT)
@pytest.mark.parametrize("kind", KINDS)
def test_whatever_is_measured_has_finite_numbers(kind: str, name: str) -> None:
    found = shown(KINDS[kind], 0, SPOILT[name])
    if found is None:
        return
    for values in (found.position_mm, found.covariance, found.covariance_px2, found.information, found.pull, found.calibration_jacobian):
        assert np.isfinite(values).all()
    assert (np.diagonal(found.covariance, axis1=1, axis2=2) > 0).all()


def test_levels_out_of_range_are_refused() -> None:
    with pytest.raises(ImageError, match="grey level of"):
        shown(KINDS["ring"], 0, lambda image: image * 1e30)
