"""Targets of an earlier photograph measured again where they were, without search and naming."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from dishmap.camera.model import Camera
from dishmap.errors import InputError, MeasurementError
from dishmap.targets.edges import Poses
from dishmap.targets.pattern import Pattern, bent_print_mm
from dishmap.targets.pose import TargetPoses, check_image, measure_groups, select_targets
from dishmap.targets.stages import Assumptions, tracked_groups

Array = NDArray[Any]
Index = NDArray[np.int64]
Bool = NDArray[Any]

# How far a tracked target may have moved in the image, and the share of targets that must be found again.
TRACKED_PX, TRACKED_SHARE = 3.0, 0.5
# Before any fit, the two sides of a target's edges must still differ by this share of the reference's contrast. Looked at this many
# blurs from the edge: a target that moved by TRACKED_PX keeps half of it.
LEAST_CONTRAST_SHARE, SIDES_BLURS, LOOKS = 0.3, 2.5, 24


def track_targets(
    image: NDArray[Any], camera: Camera, pattern: Pattern, reference: TargetPoses, assumptions: Assumptions | None = None
) -> TargetPoses:
    """Measure the targets of an earlier photograph of the same scene again, each looked for where it was.

    No search and no naming: a target may have moved by up to TRACKED_PX in the image and keeps its name. Targets that moved farther are
    listed in `rejected`; when fewer than half are found again, the whole is refused. Raises as `measure_targets`,
    and InputError for a grid.
    """
    if pattern.is_grid:
        raise InputError(f"the pattern {pattern.name!r} is a grid, which is found anew in every photograph: map it instead of tracking it")
    check_image(image, camera)
    assumptions = assumptions or Assumptions()
    there = _still_there(image, camera, pattern, reference)
    _check_share(int(there.sum()), len(reference))
    rows = np.flatnonzero(there)
    gone = [(int(i), "it is no longer where it was") for i in reference.ids[~there]]
    with threadpool_limits(limits=1, user_api="blas"):
        before = Poses(reference.rotation[rows], reference.position_mm[rows])
        groups, rejected = tracked_groups(camera, pattern, reference.index[rows], before, reference.blur_px[rows], assumptions)
        found = measure_groups(
            image, camera, pattern, groups, rejected + gone, reference.camera_from_dish, assumptions, lambda done, total: None
        )
    return _found_again(found, reference)


def _still_there(image: NDArray[Any], camera: Camera, pattern: Pattern, reference: TargetPoses) -> Bool:
    """Where (N,) the picture is still dark and light as printed on both sides of a target's edges; nearest pixels, no fit."""
    out = np.zeros(len(reference), bool)
    names = np.array(pattern.kind_names)[reference.index]
    angle = 2 * np.pi * np.arange(LOOKS) / LOOKS
    turn = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    for name in np.unique(names):
        rows, kind = np.flatnonzero(names == name), pattern.kinds[str(name)]
        poses, curvature = Poses(reference.rotation[rows], reference.position_mm[rows]), pattern.curvature_per_mm[reference.index[rows]]
        step = SIDES_BLURS * reference.blur_px[rows] * poses.position_mm[:, 2] / camera.parameters[:2].mean()
        step = np.minimum(step, 0.45 * float(kind.radius_mm.min()))[:, None, None]
        sides = []
        for sign in (-1.0, 1.0):
            radius = kind.radius_mm[None, :, None] + sign * step
            xy = (kind.center_mm[None, :, None] + radius[..., None] * turn).reshape(len(rows), -1, 2)
            sides.append(_looked_up(image, camera.project(poses.in_camera(bent_print_mm(xy, curvature)))))
        expected = np.repeat(np.where(kind.dark, 1.0, -1.0), LOOKS)
        contrast = np.nanmean((sides[1] - sides[0]) * expected, axis=1)
        out[rows] = contrast > LEAST_CONTRAST_SHARE * reference.contrast[rows]
    return out


def _looked_up(image: NDArray[Any], pixels: Array) -> Array:
    """Grey levels (T, Q) of the nearest pixels (T, Q, 2); the border's where they lie outside."""
    near = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(np.int64)
    u, v = np.clip(near[..., 0], 0, image.shape[1] - 1), np.clip(near[..., 1], 0, image.shape[0] - 1)
    return np.asarray(image[v, u], dtype=float)


def _found_again(found: TargetPoses, reference: TargetPoses) -> TargetPoses:
    """Without the targets that are no longer where they were: what was measured there may be something else."""
    at = np.searchsorted(reference.index, found.index)
    motion = np.linalg.norm(found.center_px - reference.center_px[at], axis=1)
    near = motion < TRACKED_PX
    _check_share(int(near.sum()), len(reference))
    lost = tuple((int(i), f"it moved by more than {TRACKED_PX:g} px, or something else lies where it was") for i in found.ids[~near])
    return replace(select_targets(found, np.flatnonzero(near)), rejected=tuple(sorted(found.rejected + lost)))


def _check_share(found: int, of: int) -> None:
    if found < TRACKED_SHARE * of:
        raise MeasurementError(
            f"only {found} of {of} targets were found again within {TRACKED_PX:g} px of their places in the reference; the camera or the "
            "surface moved too far to track: measure the photograph on its own"
        )
