"""Which rigid motions map a pattern onto itself: the poses between which a photograph of it cannot decide.

Only what a detector sees counts, `Pattern.marks` with their types; ids and x axes are not printed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.targets.pattern import Marks, Pattern
from dishmap.transforms import Pose

Array = NDArray[np.float64]

# A flexible surface moves by millimetres, so marks that differ from symmetry by less than this part of the smallest
# mark's radius do not tell two poses apart.
TOLERANCE_OF_RADIUS = 0.2
# A grid's places differ from symmetry by less than this part of the pitch.
GRID_TOLERANCE_OF_PITCH = 0.1
# Normals closer than this are the same: far above rounding, far below what tells two targets on a dish apart.
NORMAL_TOLERANCE_RAD = 0.05
# Marks looked at before all others: enough to refuse almost every wrong motion.
FIRST_LOOK = 16


def symmetry_poses(pattern: Pattern, tolerance_mm: float | None = None) -> list[Pose]:
    """All rigid motions `dish_from_dish`, without the identity, that map the pattern's marks onto marks of the same type.

    tolerance_mm: how far a mark may land from its partner; by default 0.2 of the smallest mark's radius. For a plate and a
    whole dish the motions are turns about z (through the marks' centroid); those of other shapes are found as well. A
    pattern whose marks all lie on one normal (a lone disc) turns freely: that changes no identity and gives no pose here.
    Sorted by the angle turned. A grid's lattice and looks are compared instead of marks.
    """
    if pattern.is_grid:
        return _grid_poses(pattern, tolerance_mm)
    marks = pattern.marks
    tolerance = TOLERANCE_OF_RADIUS * float(marks.radius_mm.min()) if tolerance_mm is None else tolerance_mm
    centroid = marks.center_mm.mean(axis=0)
    frames = _frames(marks, centroid, tolerance)
    if frames is None:
        return []
    partners, leader, axes = frames
    tree = cKDTree(marks.center_mm)
    order = np.argsort(-np.linalg.norm(marks.center_mm - centroid, axis=1), kind="stable")
    found: dict[bytes, Pose] = {}
    for partner in partners:
        turn = axes[partner] @ axes[leader].T
        if _differs(turn, centroid, marks, tree, order[:FIRST_LOOK], tolerance):
            continue
        image = _images(turn, centroid, marks, tree, tolerance)
        if image is not None and not (image[1] == np.arange(len(image[1]))).all():
            found.setdefault(image[1].tobytes(), image[0])
    return sorted(found.values(), key=lambda pose: float(np.linalg.norm(pose.rotation_vector_rad)))


def _grid_poses(pattern: Pattern, tolerance_mm: float | None) -> list[Pose]:
    """Quarter turns that map a grid's lattice and looks onto themselves, as rigid motions which also map its surface."""
    assert pattern.lattice is not None
    # twice the places, about the middle of their box
    place = 2 * pattern.lattice - pattern.lattice.min(axis=0) - pattern.lattice.max(axis=0)
    row = {tuple(p): k for k, p in enumerate(place.tolist())}
    marked = [bool(pattern.lines) and bool(pattern.kind_of(k).polygons) for k in range(len(pattern))]
    looks = {(x, y, "" if pattern.lines else name) for (x, y), name in zip(place.tolist(), pattern.kind_names, strict=True)}
    # the mark of a crossing stands in the cell to its upper right
    looks |= {(x + 1, y + 1, "mark") for (x, y), mark in zip(place.tolist(), marked, strict=True) if mark}
    pitch = float(cKDTree(pattern.center_mm).query(pattern.center_mm, k=[2])[0].min())
    centroid = pattern.center_mm.mean(axis=0)
    centered = pattern.center_mm - centroid
    found = []
    for cosine, sine in ((0, 1), (0, -1), (-1, 0)):
        if {(cosine * x - sine * y, sine * x + cosine * y, look) for x, y, look in looks} != looks:
            continue
        image = [row[cosine * x - sine * y, sine * x + cosine * y] for x, y in place.tolist()]
        turn = _best_turn(centered, centered[image], pattern.normal, pattern.normal[image])
        off = np.linalg.norm(centered @ turn.T - centered[image], axis=1).max()
        if off <= (GRID_TOLERANCE_OF_PITCH * pitch if tolerance_mm is None else tolerance_mm):
            found.append(Pose(turn, centroid - turn @ centroid))
    return found


def _frames(marks: Marks, centroid: Array, tolerance: float) -> tuple[NDArray[np.int64], int, Array] | None:
    """The smallest class of marks that can stand for each other, one of them, and a right-handed frame (M, 3, 3) at each mark.

    A frame is spanned by the normal and the way to the centroid; a motion that maps the pattern onto itself keeps the
    centroid and maps a frame onto a frame. None when no mark has such a frame.
    """
    arm = marks.center_mm - centroid
    across = arm - (arm * marks.normal).sum(axis=1, keepdims=True) * marks.normal
    lever = np.linalg.norm(across, axis=1)
    if lever.max() <= tolerance:
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        x_axis = across / lever[:, None]
    axes = np.stack([x_axis, np.cross(marks.normal, x_axis), marks.normal], axis=-1)
    # a long lever keeps the turn exact; from among those, the rarest kind gives the fewest motions to try
    feature = np.stack([lever, (arm * marks.normal).sum(axis=1)], axis=1)
    best: tuple[int, int, NDArray[np.int64]] | None = None
    for leader in _representatives(marks, feature, lever >= 0.5 * lever.max(), tolerance):
        same = (np.abs(feature - feature[leader]) <= 2 * tolerance).all(axis=1) & (marks.type_index == marks.type_index[leader])
        members = np.flatnonzero(same & (lever > 0.5 * lever[leader]))
        if best is None or len(members) < best[0]:
            best = (len(members), int(leader), members)
    if best is None:
        return None
    return best[2], best[1], axes


def _representatives(marks: Marks, feature: Array, usable: NDArray[np.bool_], tolerance: float) -> NDArray[np.int64]:
    """One mark (K,) of each cell of features, among the usable ones."""
    cells = np.column_stack([marks.type_index, np.round(feature / (4 * tolerance))])
    cells[~usable] = -1
    _, first = np.unique(cells, axis=0, return_index=True)
    return np.asarray(first[usable[first]])


def _differs(turn: Array, centroid: Array, marks: Marks, tree: cKDTree, chosen: NDArray[np.int64], tolerance: float) -> bool:
    """Whether some of the chosen marks land where no mark of their type is; loose, since the turn comes from one mark alone."""
    moved = (marks.center_mm[chosen] - centroid) @ turn.T + centroid
    distance, index = tree.query(moved, distance_upper_bound=8 * tolerance)
    if not np.isfinite(distance).all():
        return True
    return bool((marks.type_index[index] != marks.type_index[chosen]).any())


def _images(turn: Array, centroid: Array, marks: Marks, tree: cKDTree, tolerance: float) -> tuple[Pose, NDArray[np.int64]] | None:
    """The motion refined over all marks and the mark (M,) on which each lands, or None if it is no symmetry."""
    centered = marks.center_mm - centroid
    _, index = tree.query(centered @ turn.T + centroid)
    refined = _best_turn(centered, centered[index], marks.normal, marks.normal[index])
    distance = np.linalg.norm(centered @ refined.T - centered[index], axis=1)
    good = (distance <= tolerance).all() and (marks.type_index[index] == marks.type_index).all()
    same_normal = np.linalg.norm(marks.normal @ refined.T - marks.normal[index], axis=1) <= NORMAL_TOLERANCE_RAD
    if not good or not same_normal.all() or len(np.unique(index)) != len(index):
        return None
    return Pose(refined, centroid - refined @ centroid), np.asarray(index)


def _best_turn(start: Array, stop: Array, normal: Array, normal_there: Array) -> Array:
    """The rotation (3, 3) that best takes centred points (M, 3) and normals to where they go (Kabsch)."""
    u, _, vt = np.linalg.svd(stop.T @ start + normal_there.T @ normal * float((start**2).sum(axis=1).mean()))
    return np.asarray(u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt)
