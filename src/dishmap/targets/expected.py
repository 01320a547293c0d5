"""What a photograph that was not taken yet would tell of each target: the standard deviations of its measurement's errors.

From the same Fisher information as the bound and the fit, with the priors that the fit would have: on ink, tone and blur as assumed,
and on normals the spread that it would learn from such a photograph. Where that comes out wider than normals truly stray, errors are
smaller than the sigmas that the measurement claims, which hold for normals that stray as far as learnt.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.quality import Quality
from dishmap.targets.adjust import POSE_AND_OFFSET, on_pose_and_offset, prior_terms
from dishmap.targets.bound import edge_sigma_px, group_information, pattern_groups
from dishmap.targets.pattern import Pattern
from dishmap.targets.pose import SMALLEST_RADIUS_PX, rests_on_offset
from dishmap.targets.scene_noise import LEAST_NORMAL_SIGMA_RAD, normal_spread
from dishmap.targets.sensitivity import calibration_jacobian
from dishmap.targets.solve import inverse_scaled
from dishmap.targets.stages import FIRST_NORMAL_SIGMA_RAD, Assumptions, Group, printed_ink
from dishmap.targets.window import minor_radius_px
from dishmap.transforms import Pose

Array = NDArray[Any]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Expected:
    """What is expected of T targets on the undeformed pattern, in the order of `index`; names and meaning as in `TargetPoses`.

    information (T, 7, 7) of the pixels alone on (move along camera axes in mm, turn about target axes in rad, edge offset in mm);
    covariance (T, 6, 6) of the errors of move and turn; covariance_px2 (T, 2, 2) of the centre's image; sigma_normal_rad (T,);
    calibration_jacobian (T, 3, P); quality (T,): the bits `too_small` and `weak_depth`; normal_sigma_rad: the spread of normals that
    serves as prior; smallest_radius_px (T,): of any circle, at its narrowest.
    """

    index: Index
    information: Array
    covariance: Array
    covariance_px2: Array
    sigma_normal_rad: Array
    calibration_jacobian: Array
    quality: Index
    normal_sigma_rad: float
    smallest_radius_px: Array


def expected_targets(
    camera: Camera,
    pattern: Pattern,
    index: Index,
    camera_from_dish: Pose,
    contrast_to_noise: float,
    psf_sigma_px: float,
    stray_rad: float,
    assumptions: Assumptions,
) -> Expected:
    """What a photograph would tell of targets number `index` (T,), rising, which must lie wholly within the picture.

    stray_rad: how far true normals stray from the pattern's surface, standard deviation per axis. The prior on normals is the spread
    that would be learnt from such targets. The assumptions may give both: their normal_sigma_deg is what normals stray by, too.
    """
    groups = pattern_groups(camera, pattern, index, camera_from_dish, psf_sigma_px, assumptions)
    ink = printed_ink(camera, pattern, groups, camera_from_dish)
    full = [group_information(group, contrast_to_noise, ink) for group in groups]
    if assumptions.normal_sigma_deg is not None:
        spread = stray_rad = max(float(np.radians(assumptions.normal_sigma_deg)), LEAST_NORMAL_SIGMA_RAD)
    else:
        spread = learnt_spread(np.concatenate([_tilt_covariance(g, f) for g, f in zip(groups, full, strict=True)]), stray_rad)
    edge_information = edge_sigma_px(float(groups[0].state.blur_px[0]), contrast_to_noise) ** -2.0
    parts = [_columns(camera, group, data, spread, stray_rad, edge_information) for group, data in zip(groups, full, strict=True)]
    order = np.argsort(np.concatenate([group.index for group in groups]))
    columns = {name: np.concatenate([part[name] for part in parts])[order] for name in parts[0]}
    return Expected(index=index, normal_sigma_rad=spread, **columns)


def learnt_spread(tilt_covariance: Array, stray_rad: float) -> float:
    """The spread of normals that the fit would learn from tilts of covariance (T, 2, 2) and true spread `stray_rad`.

    Its likelihood goes with the squares of the tilts along the covariances' axes; each stands here at its expectation.
    """
    values, vectors = np.linalg.eigh(tilt_covariance)
    along = np.sqrt(np.maximum(values, 0.0) + stray_rad**2)
    return normal_spread(np.einsum("tij,tj->ti", vectors, along), tilt_covariance, FIRST_NORMAL_SIGMA_RAD)


def _tilt_covariance(group: Group, full: Array) -> Array:
    """Covariance (T, 2, 2) of the tilts from the pixels alone, without a prior on normals."""
    # the group's own prior is wide enough to say nothing
    precision, _ = prior_terms(group.poses, group.state, group.batch.priors)
    return inverse_scaled(full + precision[:, :, None] * np.eye(precision.shape[1]))[:, 3:5, 3:5]


def _columns(camera: Camera, group: Group, full: Array, spread_rad: float, stray_rad: float, edge_information: float) -> dict[str, Array]:
    """Columns of Expected for one group, keyed by field name."""
    count, poses = len(group.index), group.poses
    priors = replace(group.batch.priors, normal_sigma_rad=np.full(count, spread_rad))
    precision, _ = prior_terms(poses, group.state, priors)
    information, axes = on_pose_and_offset(full, precision, poses.steps)
    posterior = full + precision[:, :, None] * np.eye(precision.shape[1])
    claimed = inverse_scaled(posterior)
    # the prior's own part of the error is that of true normals: P^-1 (P - L + L S L) P^-1 for a prior L and true variances S
    excess = (1 - (stray_rad / spread_rad) ** 2) / spread_rad**2
    errors = claimed - excess * claimed[:, :, 3:5] @ claimed[:, 3:5]
    fitted = errors[:, POSE_AND_OFFSET][:, :, POSE_AND_OFFSET]
    covariance = (axes @ fitted @ np.swapaxes(axes, 1, 2))[:, :6, :6]
    _, by_point = camera.project_with_point_jacobian(poses.position_mm)
    radius = minor_radius_px(group.outlines()).min(axis=1)
    quality = np.where(radius < SMALLEST_RADIUS_PX, int(Quality.TOO_SMALL), 0)
    quality |= np.where(rests_on_offset(posterior), int(Quality.WEAK_DEPTH), 0)
    return {
        "information": information,
        "covariance": covariance,
        "covariance_px2": by_point @ covariance[:, :3, :3] @ np.swapaxes(by_point, 1, 2),
        "sigma_normal_rad": np.sqrt(covariance[:, 3, 3] + covariance[:, 4, 4]),
        "calibration_jacobian": calibration_jacobian(
            replace(group.batch, priors=priors), group.kind, poses, np.full(count, edge_information)
        ),
        "quality": quality,
        "smallest_radius_px": radius,
    }
