"""How measured poses follow when the print is stretched or the camera is a little different from what was assumed.

The fit sees edges only, so the answer comes from points along the printed outlines: each change moves them in the photograph, and the
pose that follows is the weighted least-squares one (edges move across themselves only).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.targets.edges import Poses, project_printed
from dishmap.targets.pattern import Pattern, bent_print_mm
from dishmap.targets.sensitivity import edge_normals, outline_samples
from dishmap.targets.start import nominal_poses
from dishmap.transforms import Pose

Array = NDArray[Any]

# Turns and moves that nothing shows (about a ring's own axis; the depth of a crossing) are held by these, so weakly that nothing else
# changes.
FREE_TURN_RAD, FREE_MOVE_MM = 10.0, 1e4
# Edge information against which that counts, per px of edge: what an ordinary photograph gives (0.05 px per pixel of edge).
EDGE_INFORMATION = 400.0


def pose_response(camera: Camera, pattern: Pattern, index: NDArray[np.int64], camera_from_dish: Pose) -> tuple[Array, Array]:
    """Change of the measured pose (move along camera axes in mm, turn about target axes in rad) of targets number `index` (N,).

    Returns by camera parameters (N, 6, P), by which the assumed camera is larger than the true one; and by the strain of the print
    (N, 6, 3): xx, yy and xy in the target's axes. Both are taken where the undeformed pattern lies: measured places would carry their noise
    into the columns, and noise times noise is a bias.
    """
    by_camera = np.zeros((len(index), 6, len(camera.parameters)))
    by_strain = np.zeros((len(index), 6, 3))
    poses = nominal_poses(pattern, index, camera_from_dish)
    names = np.array(pattern.kind_names)[index]
    for name in np.unique(names):
        rows = np.flatnonzero(names == name)
        by_camera[rows], by_strain[rows] = _response(camera, pattern, poses.take(rows), index[rows])
    return by_camera, by_strain


def _response(camera: Camera, pattern: Pattern, poses: Poses, index: NDArray[np.int64]) -> tuple[Array, Array]:
    kind, curvature = pattern.kind_of(int(index[0])), pattern.curvature_per_mm[index]
    if pattern.is_grid:
        xy = kind.polygons[0].corners_mm if not pattern.lines else np.zeros((1, 2))
    else:
        xy, _ = outline_samples(kind)
    pixels, motion = project_printed(camera, poses, curvature, xy)
    points = poses.in_camera(bent_print_mm(np.broadcast_to(xy, (len(poses), *xy.shape)), curvature))
    _, by_point, by_camera = camera.project_with_jacobians(points)
    # a stretch of the print moves its points within the surface
    x, y = xy[:, 0], xy[:, 1]
    zero = np.zeros_like(x)
    stretch = np.stack([np.stack([x, zero, zero], -1), np.stack([zero, y, zero], -1), np.stack([y, x, zero], -1)], axis=-1)
    strained = by_point @ (poses.rotation[:, None] @ stretch)
    if pattern.is_grid:
        # corners and crossings show both of their coordinates
        seen, weight = np.broadcast_to(np.eye(2), (*pixels.shape[:2], 2, 2)), np.ones(pixels.shape[:2])
    else:
        normals, weight = edge_normals(pixels, kind)
        seen = normals[:, :, None]
    columns = (seen @ motion).reshape(len(poses), -1, 6)
    weighted = np.swapaxes(
        (columns.reshape(*seen.shape[:3], 6) * (EDGE_INFORMATION * weight)[..., None, None]).reshape(columns.shape), 1, 2
    )
    information = weighted @ columns
    information[:, range(6), range(6)] += [*(FREE_MOVE_MM**-2,) * 3, *(FREE_TURN_RAD**-2,) * 3]
    turn = np.zeros((len(poses), 6, 6))
    turn[:, :3, :3], turn[:, 3:, 3:] = poses.steps, np.eye(3)

    def follow(effect: Array) -> Array:
        return turn @ np.linalg.solve(information, weighted @ (seen @ effect).reshape(len(poses), columns.shape[1], -1))

    return -follow(by_camera), follow(strained)
