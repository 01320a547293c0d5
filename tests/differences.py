"""Records of differences for the tests of what is said and drawn of them: numbers chosen, nothing measured."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from dishmap.camera.model import Camera
from dishmap.compare import JOINT, SHAPE, Difference, default_basis, joint_table
from dishmap.difference.difference_map import Considered, DifferenceMap, Significance
from dishmap.difference.priors import Priors
from dishmap.quality import Quality
from dishmap.simulate.scene import facing_pose
from dishmap.surface.cloud import PointCloud
from dishmap.surface.fit import fit_surface
from dishmap.targets.builders import dish, plate
from dishmap.targets.pattern import Pattern
from dishmap.targets.pose import TargetPoses
from dishmap.targets.scene_noise import NoiseModel
from dishmap.transforms import Pose

CAMERA = Camera(800, 800, [900.0, 900.0], [399.5, 399.5], covariance=np.diag([0.3, 0.3, 0.2, 0.2]) ** 2)
CAMERA_FROM_DISH = facing_pose(450.0, 0.1, 0.4)
PLATE, DISH = plate(3, 4, 50), dish(diameter_mm=300, focal_length_mm=150, spacing_mm=45)
SIGMA_MM, RIGID_SIGMA = 0.004, np.array([0.002, 0.002, 0.01, 1e-4, 1e-4, 1e-5])
SIZES = {"normal_mm": 0.2, "slide_strain": 2e-6, "rough_mm": 3e-4, "print_strain": 4e-6, "expansion": 0.0, "focal": 0.0}
TERMS = ((2, -2), (2, 0), (2, 2))


def joint_of(pattern: Pattern, **changes: Any) -> DifferenceMap:
    """A dish or plate that bent by astigmatism of 0.2 mm at the outermost targets and moved by (0.1, 0, 0.3) mm; `changes` to fields."""
    n = len(pattern)
    x, y, _ = pattern.center_mm.T
    radius2 = float((x**2 + y**2).max())
    shape = 0.2 * (x**2 - y**2) / radius2
    rng = np.random.default_rng(5)
    whole = DifferenceMap(
        index=np.arange(n),
        ids=pattern.ids,
        nominal_mm=pattern.center_mm,
        normal=pattern.normal,
        displacement_mm=shape + 0.3,
        depth_change_mm=-shape - 0.3,
        shape_mm=shape,
        sigma_displacement_mm=np.full(n, 3 * SIGMA_MM),
        sigma_depth_change_mm=np.full(n, 4 * SIGMA_MM),
        sigma_shape_mm=np.full(n, SIGMA_MM),
        du_dv_px=0.01 * pattern.center_mm[:, :2],
        misfit=rng.uniform(0.5, 1.3, n),
        quality=np.zeros(n, dtype=np.int64),
        displacement_factor=np.zeros((n, 1)),
        displacement_own_mm2=np.zeros(n),
        shape_factor=np.zeros((n, 1)),
        shape_own_mm2=np.full(n, SIGMA_MM**2),
        rigid_motion=Pose.from_rotation_vector(np.radians([0.05, 0.0, 0.0]), [0.1, 0.0, 0.3]),
        rigid_covariance=np.diag(RIGID_SIGMA**2),
        expansion=(0.0, 0.0),
        expansion_assumed=(0.0, 0.0),
        focal_drift=(0.0, 0.0),
        zernike_terms=TERMS,
        zernike_mm=np.array([0.001, -0.02, 0.2]),
        zernike_covariance_mm2=np.diag([0.002, 0.003, 0.004]) ** 2,
        significance=Significance(400.0, 20, 1e-70),
        considered=(
            Considered("least_strain", 120.0, 0.75, -50.0, SIZES, True),
            Considered("axial", 60.0, 0.25, -51.1, {**SIZES, "normal_mm": 0.3}, True),
        ),
        learnt=("normal_mm", "slide_strain", "rough_mm", "print_strain"),
        noise_factor=1.0,
        converged=True,
        priors=Priors(),
        camera_from_dish=CAMERA_FROM_DISH,
        rejected=(),
    )
    return replace(whole, **changes)


def difference_of(pattern: Pattern, joint: DifferenceMap | None = None, **changes: Any) -> Difference:
    """The record around a joint estimate, with a surface through its shape; no photograph."""
    joint = joint or joint_of(pattern)
    poses = poses_of(pattern)
    zero = np.zeros((len(joint), 3, 3))
    heights = PointCloud(
        joint.ids,
        np.column_stack([joint.nominal_mm[:, :2], joint.shape_mm]),
        np.tile([0.0, 0.0, 1.0], (len(joint), 1)),
        np.zeros((len(joint), 2)),
        zero,
        np.zeros(len(joint)),
        zero[:, :2, :2],
        None,
        joint.quality,
        "dish",
    )
    whole = Difference(JOINT, CAMERA, pattern, poses, poses, joint, None, {JOINT: joint_table(joint)}, {}, {})
    if "surfaces" not in changes:
        changes["surfaces"] = {SHAPE: fit_surface(heights, default_basis(pattern, len(joint)), weighted=False)}
    return replace(whole, **changes)


def poses_of(pattern: Pattern) -> TargetPoses:
    """Targets of the undeformed pattern; what no report shows is zero."""
    n = len(pattern)
    position = CAMERA_FROM_DISH.apply(pattern.center_mm)
    zero = np.zeros(n)
    return TargetPoses(
        index=np.arange(n),
        ids=pattern.ids,
        position_mm=position,
        normal=CAMERA_FROM_DISH.rotate(pattern.normal),
        rotation=np.tile(np.eye(3), (n, 1, 1)),
        covariance=np.zeros((n, 6, 6)),
        information=np.zeros((n, 7, 7)),
        pull=np.zeros((n, 7)),
        prior=np.zeros((n, 7)),
        center_px=CAMERA.project(position),
        covariance_px2=np.zeros((n, 2, 2)),
        sigma_normal_rad=zero,
        calibration_jacobian=np.zeros((n, 3, 4)),
        blur_px=zero,
        offset_mm=zero,
        contrast=zero,
        noise=zero,
        kept=zero,
        quality=np.zeros(n, dtype=np.int64),
        camera_from_dish=CAMERA_FROM_DISH,
        normal_sigma_rad=0.0,
        noise_model=NoiseModel(1.0, 0.0, 1.0),
        log_gamma=0.0,
        rejected=(),
    )


def with_outliers(joint: DifferenceMap, rows: list[int]) -> DifferenceMap:
    """The same with some rows put aside."""
    quality = joint.quality.copy()
    quality[rows] |= int(Quality.OUTLIER)
    reason = "its change fits no smooth motion of the surface; its row holds what its neighbours say"
    return replace(joint, quality=quality, rejected=tuple((int(joint.ids[row]), reason) for row in rows))
