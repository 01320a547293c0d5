"""Simulated targets for the tests of the measuring core, with detections and names taken from truth.

The core is tested on its own: what `find_ellipses` and `identify` would hand over is made from truth, with an error of
a few tenths of a pixel, so that a fit never starts at the answer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.camera.model import Camera
from dishmap.simulate.forward import printed_points
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Light, Scene, Sensor
from dishmap.simulate.truth import Truth
from dishmap.targets.detect import Detections
from dishmap.targets.edges import Poses
from dishmap.targets.identify import Identity
from dishmap.targets.pattern import Pattern, Surface, TargetKind
from dishmap.targets.pixels import BLUR, OFFSET_MM, OFFSET_PX, TONE
from dishmap.targets.pose import Assumptions, TargetPoses, measure_targets
from dishmap.targets.stages import Group, regroup, start_groups
from dishmap.transforms import Pose, rotation_from_vector

Array = NDArray[np.float64]

PLAIN = Camera(400, 300, [3000.0, 3000.0], [199.5, 149.5])
# About 90 degrees across, strong distortion with tangential terms.
WIDE = Camera(1000, 750, [500.0, 503.0], [503.2, 368.1], [-0.25, 0.08, 0.001, -0.0007, -0.01])
FISHEYE = Camera(900, 900, [280.0, 281.0], [451.0, 448.5], [0.03, -0.01, 0.003, -0.0005], "fisheye")
# The ground goes on beyond the plate.
CLEAR = Light(ink_grey=20.0, ground_grey=180.0, background_grey=180.0)
# Error of the ellipses that a fit starts from, and of their axes.
ELLIPSE_ERROR_PX, AXIS_ERROR_PX = 0.2, 0.1
OUTLINE_POINTS = 64
# Where the geometry's columns beyond the pose live.
STATE_FIELDS = {OFFSET_MM: "offset_mm", OFFSET_PX: "offset_px", BLUR: "blur_px", TONE: "log_gamma"}


def facing_towards(camera: Camera, pixel: tuple[float, float], distance_mm: float, tilt_rad: float, turn_rad: float) -> Pose:
    """camera_from_target of a target seen at `pixel`, tilted from the line of sight about the axis at `turn_rad`, y up in the image."""
    ray = camera.unproject(np.array(pixel, dtype=float))
    right = np.cross([0.0, 1.0, 0.0], ray)
    right /= np.linalg.norm(right)
    facing = np.stack([right, np.cross(-ray, right), -ray], axis=1)
    tilt = rotation_from_vector(tilt_rad * np.array([np.cos(turn_rad), np.sin(turn_rad), 0.0]))
    return Pose(facing @ tilt, distance_mm * ray)


def one_target(kind: TargetKind, surface: Surface | None = None) -> Pattern:
    """A pattern of one target at the vertex."""
    return Pattern("one", surface or Surface(), {"k": kind}, [7], ["k"], [[0, 0, 0]], [[1, 0, 0]], [[0, 0, 1]])


def noiseless(pattern: Pattern, camera: Camera, camera_from_dish: Pose, psf_sigma_px: float = 0.8) -> Scene:
    """A scene whose only error is the rounding of 16 bits."""
    return Scene(pattern, camera, camera_from_dish, light=CLEAR, sensor=Sensor(psf_sigma_px, bits=16))


def named_ellipses(
    scene: Scene, rng: np.random.Generator, only: ArrayLike | None = None, nominal: Pattern | None = None
) -> tuple[Detections, Identity]:
    """Every circle of the scene's targets number `only` (all by default) as a detected ellipse with its right name.

    nominal: the pattern that the measurement will be given, when what is photographed is another one.
    """
    pattern, marks = nominal or scene.pattern, (nominal or scene.pattern).marks
    center, axes, angle, dark, parent, mark, detection = [], [], [], [], [], [], []
    for index in np.arange(len(pattern)) if only is None else np.asarray(only):
        kind, first = pattern.kind_of(int(index)), len(center)
        t = 2 * np.pi * np.arange(OUTLINE_POINTS) / OUTLINE_POINTS
        xy = kind.center_mm[:, None] + kind.radius_mm[:, None, None] * np.stack([np.cos(t), np.sin(t)], axis=-1)
        for points in scene.camera.project(printed_points(scene, index, xy)):
            middle = points.mean(axis=0)
            squares, vectors = np.linalg.eigh(2 * np.cov(points - middle, rowvar=False, bias=True))
            center.append(middle + ELLIPSE_ERROR_PX * rng.standard_normal(2))
            axes.append(np.sqrt(squares[::-1]) + AXIS_ERROR_PX * rng.standard_normal(2))
            angle.append(np.arctan2(vectors[1, 1], vectors[0, 1]))
        dark += kind.dark.tolist()
        parent += [first + p if p >= 0 else -1 for p in kind.parent.tolist()]
        mine = np.flatnonzero(marks.target == index)
        mark += mine.tolist()
        detection += (first + marks.circle[mine]).tolist()
    found = len(center)
    detections = Detections(
        np.array(center), np.array(axes), np.array(angle), np.array(dark), np.array(parent), np.full(found, 100.0), np.zeros(found)
    )
    named = np.array(mark), np.array(detection)
    return detections, Identity(scene.camera_from_dish, *named, np.zeros(len(mark)), (), 0, ())


@dataclass(frozen=True)
class Measured:
    """Targets as measured and as they are: rows of `truth` are those of `poses`."""

    poses: TargetPoses
    truth: Truth

    @property
    def rows(self) -> NDArray[np.int64]:
        """Which target of the truth each measured one is."""
        return np.searchsorted(self.truth.ids, self.poses.ids)

    @property
    def position_error_mm(self) -> Array:
        return self.poses.position_mm - self.truth.center_mm[self.rows]

    @property
    def center_error_px(self) -> Array:
        return self.poses.center_px - self.truth.center_px[self.rows]

    @property
    def true_normal(self) -> Array:
        return self.truth.normal[self.rows]

    @property
    def sigma_depth_mm(self) -> Array:
        return np.sqrt(self.poses.covariance[:, 2, 2])

    @property
    def sigma_center_px(self) -> Array:
        return np.sqrt(self.poses.covariance_px2[:, [0, 1], [0, 1]])


def measured(
    scene: Scene,
    rng: np.random.Generator,
    assumptions: Assumptions | None = None,
    image: NDArray[Any] | None = None,
    nominal: Pattern | None = None,
) -> Measured:
    """Photograph a scene and measure it; `image` replaces the photograph, `nominal` the pattern that the measurement is given."""
    simulation = simulate(scene, rng)
    shown = simulation.image if image is None else image
    poses = measure_targets(shown, scene.camera, nominal or scene.pattern, *named_ellipses(scene, rng, nominal=nominal), assumptions)
    return Measured(poses, simulation.truth)


def group_of(camera: Camera, kind: TargetKind, poses: Poses, blur_px: float) -> Group:
    """Flat targets of one kind at known poses, as the first stage hands them to the pixels, with the true blur."""
    count = len(poses)
    pattern = Pattern(
        "some", Surface(), {"k": kind}, np.arange(count), ["k"] * count, poses.position_mm, poses.rotation[..., 0], poses.rotation[..., 2]
    )
    scene = Scene(pattern, camera, Pose.identity())
    (group,), rejected = start_groups(camera, pattern, *named_ellipses(scene, np.random.default_rng(0)), Assumptions())
    assert not rejected
    order = np.argsort(group.index)
    group = regroup(group, order)
    return replace(group, poses=poses, state=replace(group.state, blur_px=np.full(count, blur_px)))


def moved(group: Group, column: int, amount: float) -> Group:
    """A group with one geometry parameter of all targets changed by a small amount."""
    if column in STATE_FIELDS:
        name = STATE_FIELDS[column]
        return replace(group, state=replace(group.state, **{name: getattr(group.state, name) + amount}))
    delta = amount * np.eye(6)[column]
    position = group.poses.position_mm + np.einsum("tij,j->ti", group.poses.steps, delta[:3])
    return replace(group, poses=Poses(group.poses.rotation @ rotation_from_vector(delta[3:]), position))
