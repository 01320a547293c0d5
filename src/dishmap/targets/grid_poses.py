"""Targets of a grid as `TargetPoses`: from the photograph's places and the sheet through them to what all later steps read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from dishmap.camera.model import Camera
from dishmap.quality import Quality
from dishmap.targets.grid_detect import GridDetections
from dishmap.targets.grid_identify import GridIdentity
from dishmap.targets.grid_points import GridPoints, measure_grid
from dishmap.targets.grid_sheet import Sheet, estimate_sheet, target_axes
from dishmap.targets.pattern import Pattern
from dishmap.targets.pose import SheetSummary, TargetPoses, check_image
from dishmap.targets.start import rigid_pose
from dishmap.transforms import Pose

Array = NDArray[Any]


def measure_grid_targets(
    image: NDArray[Any],
    camera: Camera,
    pattern: Pattern,
    detections: GridDetections,
    identity: GridIdentity,
    progress: Callable[[int, int], None] | None = None,
) -> TargetPoses:
    """Measure every named target of a grid in the raw pixels of `image` (H, W), and the surface through all of them.

    Raises ImageError if the image holds NaN, CameraError if its size is not the camera's, MeasurementError if too few targets can be
    measured or no smooth surface explains them. `progress(done, total)` is called as the surface is learnt.
    """
    check_image(image, camera)
    points = measure_grid(image, pattern, identity.index, detections.place_px[identity.detection])
    with threadpool_limits(limits=1, user_api="blas"):
        sheet = estimate_sheet(camera, pattern, points.index, measured_of(points), np.linalg.inv(points.information), progress)
        return poses_of(camera, pattern, points, sheet, identity.camera_from_dish)


def measured_of(points: GridPoints) -> Array:
    """What the pixels gave of all targets (N, 2), or of squares (N, 6): place, half along x, half along y."""
    if points.half_px is None:
        return points.center_px
    return np.concatenate([points.center_px, points.half_px[..., 0], points.half_px[..., 1]], axis=1)


def poses_of(camera: Camera, pattern: Pattern, points: GridPoints, sheet: Sheet, start: Pose) -> TargetPoses:
    """The targets of a sheet; start: a rigid pose of the nominal pattern, to be refined.

    A target that fits no smooth surface carries the flag `outlier`: its place is what its neighbours say.
    """
    rotation = target_axes(sheet.tangent)
    covariance = _pose_covariance(sheet, rotation)
    center, by_point = camera.project_with_point_jacobian(sheet.place_mm)
    information, pull = _own_likelihood(points, sheet)
    quality = points.quality | np.where(sheet.used, 0, int(Quality.OUTLIER))
    count = len(points)
    rigid = rigid_pose(pattern, points.index[sheet.used], camera, center[sheet.used], start)
    off_rigid = center + sheet.residual[:, :2] - camera.project(rigid.apply(pattern.center_mm[points.index]))
    return TargetPoses(
        index=points.index,
        ids=pattern.ids[points.index],
        position_mm=sheet.place_mm,
        normal=rotation[..., 2],
        rotation=rotation,
        covariance=covariance,
        information=information,
        pull=pull,
        prior=np.zeros((count, 7)),
        center_px=center,
        covariance_px2=by_point @ covariance[:, :3, :3] @ np.swapaxes(by_point, 1, 2),
        sigma_normal_rad=np.sqrt(covariance[:, 3, 3] + covariance[:, 4, 4]),
        calibration_jacobian=sheet.by_camera[:, :3],
        blur_px=points.blur_px,
        offset_mm=np.full(count, sheet.spread_mm),
        contrast=points.contrast,
        noise=points.noise,
        kept=points.kept,
        quality=quality,
        camera_from_dish=rigid,
        normal_sigma_rad=0.0,
        noise_model=points.noise_model,
        log_gamma=0.0,
        rejected=points.rejected,
        sheet=_summary(pattern, points, sheet, rotation, off_rigid),
    )


def _summary(pattern: Pattern, points: GridPoints, sheet: Sheet, rotation: Array, off_rigid: Array) -> SheetSummary:
    """What was learnt, and how far places lie from the smooth surface and (N, 2) from the rigid pattern."""
    sizes = sheet.sizes
    noise = np.linalg.inv(points.information)[:, range(2), range(2)]
    by_print = sizes.print_mm * (sheet.by_place[:, :2] @ rotation[..., :2])
    clean = sheet.used & (points.quality == 0)
    off, expected, printed, rigid = (
        float(np.sqrt(per_target[clean if clean.any() else sheet.used].mean()))
        for per_target in (
            (sheet.off_px**2).sum(axis=1),
            noise.sum(axis=1),
            (by_print**2).sum(axis=(1, 2)),
            (off_rigid**2).sum(axis=1),
        )
    )
    side = 0.0 if pattern.lines else 2 * float(np.median([np.abs(pattern.kind_of(i).polygons[0].corners_mm).max() for i in points.index]))
    return SheetSummary(
        print_mm=sizes.print_mm,
        strain=sizes.strain,
        smooth_strain=sizes.smooth_strain,
        rough_mm=sizes.rough_mm,
        side_mm=side,
        spread_mm=sheet.spread_mm,
        sigma_spread_mm=sheet.sigma_spread_mm,
        fit_rms_px=off,
        noise_rms_px=expected,
        print_rms_px=printed,
        rigid_rms_px=rigid,
    )


def _pose_covariance(sheet: Sheet, rotation: Array) -> Array:
    """Covariance (N, 6, 6) of (move along camera axes in mm, turn about target axes in rad).

    A small change d of the tangents turns the normal by -sum_a g_a (n . d_a), g the dual tangents, and the x axis within the surface by
    y . d_1 / |t_1|. A turn w about the target's axes moves the normal by (w_y, -w_x) in them.
    """
    tangent, count = sheet.tangent, len(sheet.tangent)
    dual = tangent @ np.linalg.inv(np.swapaxes(tangent, 1, 2) @ tangent)
    x, y, normal = (rotation[..., k] for k in range(3))
    rows = np.zeros((count, 6, 9))
    rows[:, :3, :3] = np.eye(3)
    for a in range(2):
        columns = slice(3 + 3 * a, 6 + 3 * a)
        rows[:, 3, columns] = (dual[..., a] * y).sum(axis=1)[:, None] * normal
        rows[:, 4, columns] = -(dual[..., a] * x).sum(axis=1)[:, None] * normal
    rows[:, 5, 3:6] = y / np.linalg.norm(tangent[..., 0], axis=1)[:, None]
    return rows @ sheet.covariance @ np.swapaxes(rows, 1, 2)


def _own_likelihood(points: GridPoints, sheet: Sheet) -> tuple[Array, Array]:
    """What the pixels alone say of (move, turn, edge offset): information (N, 7, 7) and pull (N, 7) at the sheet's estimate."""
    by = np.concatenate([sheet.by_place, sheet.by_turn, sheet.by_spread[..., None]], axis=2)
    turned = np.swapaxes(by, 1, 2) @ points.information
    return turned @ by, (turned @ sheet.residual[..., None])[..., 0]
