"""The whole chain, as one short function: a photograph in, points and a surface out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.camera.undistort import undistort_image, undistort_points
from dishmap.errors import FitError, InputError, MeasurementError
from dishmap.surface.cloud import PointCloud, transform_cloud
from dishmap.surface.fit import Basis, SurfaceFit, fit_surface, flag_off_surface
from dishmap.targets.detect import Detections, find_ellipses
from dishmap.targets.grid_detect import GridDetections, find_grid
from dishmap.targets.grid_identify import GridIdentity, identify_grid
from dishmap.targets.grid_paper import paper_grid_poses
from dishmap.targets.grid_poses import measure_grid_targets
from dishmap.targets.identify import Anchors, Hint, Identity, identify
from dishmap.targets.paper import PaperPoses, paper_poses
from dishmap.targets.pattern import Pattern
from dishmap.targets.pose import TargetPoses, check_image, measure_targets
from dishmap.targets.stages import Assumptions
from dishmap.transforms import Pose

METHODS = ("pose", "paper")


@dataclass(frozen=True)
class Map:
    """What one photograph says.

    cloud: measured targets in the camera frame; surface: robust fit in the dish frame (camera_from_dish is the rigid pose of
    the undeformed pattern), or None with the reason in surface_problem; rejected: (id or None, reason) of everything seen
    and not used; missing: ids of the pattern that were not seen; detections and identity as found; poses: the record
    of the method that was used.
    """

    method: str
    camera: Camera
    pattern: Pattern
    cloud: PointCloud
    camera_from_dish: Pose
    surface: SurfaceFit | None
    surface_problem: str
    rejected: tuple[tuple[int | None, str], ...]
    missing: tuple[int, ...]
    detections: Detections | GridDetections
    identity: Identity | GridIdentity
    poses: TargetPoses | PaperPoses


def map_photograph(
    image: NDArray[np.generic],
    camera: Camera,
    pattern: Pattern,
    hint: Hint = None,
    method: str = "pose",
    surface: Basis | None = None,
    assumptions: Assumptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Map:
    """Measure all targets of `pattern` in one grey photograph (height, width) and fit a robust surface through them.

    hint: Upright(), PoseGuess(...), Anchors(...) or None, see `identify` and `identify_grid`. method: `pose` (raw pixels, with
    covariance) or `paper` (Algorithm 1, for grids Algorithm 2). surface: default is the pattern's own kind: plane, paraboloid or
    cylinder. Raises ImageError, CameraError, IdentityError and MeasurementError, each with what to do; a surface that cannot be
    fitted is told in `surface_problem`.
    """
    if method not in METHODS:
        raise InputError(f"unknown method {method!r}; use one of {', '.join(METHODS)}")
    check_image(image, camera)
    if method == "paper":
        if isinstance(hint, Anchors):
            hint = replace(hint, place_px=undistort_points(camera, hint.place_px))
        image, camera = undistort_image(camera, image)
    detections, identity, poses = (_of_grid if pattern.is_grid else _of_circles)(
        image, camera, pattern, hint, method, assumptions, progress
    )
    if isinstance(poses, PaperPoses):
        if not len(poses):
            raise MeasurementError("the paper's method could measure none of the named targets; try --method pose")
        cloud, camera_from_dish = _paper_cloud(poses), identity.camera_from_dish
    else:
        if not len(poses):
            raise MeasurementError("every named target was rejected: " + "; ".join(sorted({reason for _, reason in poses.rejected})))
        cloud, camera_from_dish = cloud_of(poses), poses.camera_from_dish
    fitted, problem = _surface(cloud, camera_from_dish, surface or Basis(pattern.surface.kind), camera, method == "pose")
    if fitted is not None:
        cloud = flag_off_surface(cloud, fitted)
    seen = set(cloud.ids.tolist()) | {ident for ident, _ in poses.rejected}
    rejected = (*poses.rejected, *((None, r.reason) for r in identity.rejected))
    missing = tuple(int(i) for i in pattern.ids if int(i) not in seen)
    return Map(method, camera, pattern, cloud, camera_from_dish, fitted, problem, rejected, missing, detections, identity, poses)


def _of_circles(
    image: NDArray[np.generic],
    camera: Camera,
    pattern: Pattern,
    hint: Hint,
    method: str,
    assumptions: Assumptions | None,
    progress: Callable[[int, int], None] | None,
) -> tuple[Detections, Identity, TargetPoses | PaperPoses]:
    detections = find_ellipses(image)
    identity = identify(detections, pattern, camera, hint)
    if method == "paper":
        return detections, identity, paper_poses(image, camera, pattern, detections, identity.mark, identity.detection)
    return detections, identity, measure_targets(image, camera, pattern, detections, identity, assumptions, progress)


def _of_grid(
    image: NDArray[np.generic],
    camera: Camera,
    pattern: Pattern,
    hint: Hint,
    method: str,
    assumptions: Assumptions | None,
    progress: Callable[[int, int], None] | None,
) -> tuple[GridDetections, GridIdentity, TargetPoses | PaperPoses]:
    if assumptions is not None and assumptions != Assumptions():
        raise InputError(
            "a grid learns what ink and surface do; leave out assumptions on ink, tone and normals "
            "(--ink-spread-percent, --tone-shift-px, --normal-sigma-deg)"
        )
    detections = find_grid(image, bool(pattern.lines))
    identity = identify_grid(detections, pattern, camera, hint)
    if method == "paper":
        places = detections.place_px[identity.detection]
        return detections, identity, paper_grid_poses(image, camera, pattern, identity.index, places)
    return detections, identity, measure_grid_targets(image, camera, pattern, detections, identity, progress)


def cloud_of(poses: TargetPoses) -> PointCloud:
    """The measured targets as points in the camera frame."""
    return PointCloud(
        ids=poses.ids,
        position_mm=poses.position_mm,
        normal=poses.normal,
        center_px=poses.center_px,
        covariance_mm2=poses.covariance[:, :3, :3],
        sigma_normal_rad=poses.sigma_normal_rad,
        covariance_px2=poses.covariance_px2,
        calibration_jacobian=poses.calibration_jacobian,
        quality=poses.quality,
        frame="camera",
    )


def _paper_cloud(poses: PaperPoses) -> PointCloud:
    """Points of the paper's method, which gives no uncertainty: covariances are zero and mean `unknown`."""
    n = len(poses)
    zero = np.zeros((n, 3, 3))
    return PointCloud(
        poses.ids, poses.position_mm, poses.normal, poses.center_px, zero, np.zeros(n), zero[:, :2, :2], None, poses.quality, "camera"
    )


def _surface(cloud: PointCloud, camera_from_dish: Pose, basis: Basis, camera: Camera, weighted: bool) -> tuple[SurfaceFit | None, str]:
    in_dish = transform_cloud(cloud, camera_from_dish.inverse(), "dish")
    try:
        return fit_surface(in_dish, basis, weighted=weighted, camera_covariance=camera.covariance if weighted else None), ""
    except FitError as error:
        return None, str(error)
