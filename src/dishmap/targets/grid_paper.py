"""The paper's method for grids, Algorithm 2, as printed (Asaly, Ben-Moshe, Shvalb 2018, section 4.3): method `paper`.

Level_0: crossings of lines, or centres of squares (`grid_corners`). Level_1: centres of the unit squares of Level_0. S: all squares of
one, two, ... units with corners in Level_1, up to 10 degrees as the camera sees them. Each has an area, a normal and so a distance, by
the steps of Algorithm 1 (`paper`). Where the text leaves a choice, this file takes (reasons and effects: docs/method-paper.md):

- Level_1 is the mean of four, in the image and in the pattern alike: `difference.levels` averages so too.
- Distance: "a distance of s_i from the camera, where the center of s_i is the angular coordinate": the area is that seen by a camera
  turned to the square's centre, and what it gives is the distance along that line of sight. Centre: where the diagonals meet.
- Nominal area: of the quadrilateral of the four places in the pattern, chords on a curved surface.
- Normal: EPnP, which the text names, fails on four points of a plane. Default is IPPE with refinement (`plane_pose`); `epnp` is there.
- Weights: the distance from an area errs by s / (2 sqrt(2) n p) of itself for Level_0 noise of s px and n units of p px, thus 1 / n^2
  in variance; a square counts n^2.
- One point per target: those of odd squares lie on a node of Level_0, those of even ones in the middle of a cell, so that the mean of
  the four around a node belongs to it. A mean of places on a curved surface lies off it, by as much as in the pattern; that is put back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.camera.model import Camera
from dishmap.errors import InputError
from dishmap.quality import Quality
from dishmap.targets.grid_corners import diagonals_meet, level_0_px
from dishmap.targets.grid_map import local_map
from dishmap.targets.grid_points import check_nodes
from dishmap.targets.grid_shapes import node_shapes
from dishmap.targets.grid_walk import table_of
from dishmap.targets.paper import EXACT_PX, METHOD, SIGN_SIGMAS, PaperPoses, check_undistorted, delta_alpha_rad, depth_from_area_mm
from dishmap.targets.pattern import Pattern
from dishmap.targets.plane_pose import epnp_normals, ippe_normals, sight_axes, turned

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
Normals = Literal["ippe", "epnp"]

EPNP_METHOD = "paper-epnp"
# "Usually smaller than the 10-degree angle"; unit squares are in S whatever their angle.
LARGEST_SQUARE_RAD = np.radians(10.0)
# Corners of a unit square, counter-clockwise in (column, row), and of the four cells around a node.
UNIT = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
NO_PLACE = "its crossing or square was not found in the undistorted image"
NO_SQUARE = "level_1 has no square about it: its neighbours on all sides are needed"


@dataclass(frozen=True)
class Squares:
    """All of S with n units: tables (C, R, ...) by the column and row of a square's lowest corner in Level_1, NaN where there is none.

    point_mm: the points p_i, and normal, both (C, R, 3) in the camera frame; place_mm (C, R, 3): where p_i lies in the pattern; area (C,
    R): as a camera turned to the square sees it, over the square of its focal length; delta_alpha_rad (C, R); sure (C, R): 1 where the
    image tells which way the square is tilted, else 0.
    """

    units: int
    point_mm: Array
    normal: Array
    place_mm: Array
    area: Array
    delta_alpha_rad: Array
    sure: Array

    @property
    def weight(self) -> float:
        """The weight of each of these points in P*: the inverse variance of the distance, but for a factor that all share."""
        return float(self.units**2)


def paper_grid_poses(
    image: NDArray[np.generic], camera: Camera, pattern: Pattern, index: ArrayLike, place_px: ArrayLike, *, normals: Normals = "ippe"
) -> PaperPoses:
    """Algorithm 2 on an undistorted image.

    image (H, W), grey; camera: pinhole; index (K,): targets of the grid pattern that were found at place_px (K, 2). Raises CameraError
    for a camera with distortion or of another size, ImageError for an image that is not grey, PatternError for a pattern that is no
    grid, InputError for arrays that do not fit.
    """
    check_undistorted(image, camera)
    rows, near = np.asarray(index, dtype=np.int64).reshape(-1), np.asarray(place_px, dtype=float).reshape(-1, 2)
    check_nodes(pattern, rows, near)
    shapes = node_shapes(pattern).take(rows)
    refined = near
    if len(rows):
        assert pattern.lattice is not None
        table, low = table_of(near, pattern.lattice[rows], 0)
        step = local_map(table, pattern.lattice[rows] - low, itself=True).step_px
        refined = level_0_px(image, shapes, near, step)
    return poses_from_level_0(refined, rows, camera, pattern, normals=normals)


def weighted_points(level_0_px: Array, index: Ints, camera: Camera, pattern: Pattern, normals: Normals = "ippe") -> list[Squares]:
    """P* of Level_0 (K, 2) in the pixels of a pinhole camera (NaN: not found), places of targets `index` (K,) of the pattern."""
    lattice = _lattice(pattern)
    image, place = (np.full((*lattice.max(axis=0) + 1, size), np.nan) for size in (2, 3))
    image[tuple(lattice[index].T)] = (level_0_px - camera.principal_px) / camera.focal_px
    place[tuple(lattice.T)] = pattern.center_mm
    return small_squares(means_of_four(image), means_of_four(place), normals, EXACT_PX / float(camera.focal_px.max()))


def poses_from_level_0(level_0_px: Array, index: Ints, camera: Camera, pattern: Pattern, *, normals: Normals = "ippe") -> PaperPoses:
    """Algorithm 2 on Level_0, as `weighted_points` takes it: one pose for each target that Level_1 reaches."""
    if normals not in ("ippe", "epnp"):
        raise InputError(f"unknown way to find normals {normals!r}; use ippe, or epnp as the paper has it")
    points = weighted_points(level_0_px, index, camera, pattern, normals)
    found = np.isfinite(level_0_px).all(axis=1)
    seen = (level_0_px[found] - camera.principal_px) / camera.focal_px
    combined = _of_targets(points, pattern, index[found])
    some = combined.weight > 0
    rows = index[found][some]
    skipped = [(int(i), NO_PLACE) for i in index[~found]] + [(int(i), NO_SQUARE) for i in index[found][~some]]
    return PaperPoses(
        index=rows,
        ids=pattern.ids[rows],
        center_px=level_0_px[found][some],
        position_mm=np.column_stack([seen[some], np.ones(len(rows))]) * combined.depth_mm[some, None],
        normal=combined.normal[some],
        depth_mm=combined.depth_mm[some],
        delta_alpha_rad=combined.delta_alpha_rad[some],
        area_px2=combined.area[some] * camera.focal_px.prod(),
        quality=np.where(combined.sure[some], int(Quality.CLEAN), int(Quality.AMBIGUOUS_NORMAL)).astype(np.int64),
        rejected=tuple((int(pattern.ids[i]), reason) for i, reason in sorted(skipped)),
        view="target",
        method=METHOD if normals == "ippe" else EPNP_METHOD,
    )


def means_of_four(table: Array) -> Array:
    """Level_1 of a table (C, R, ...): the means (C - 1, R - 1, ...) over its unit squares, NaN where a corner is."""
    return np.asarray((table[:-1, :-1] + table[1:, :-1] + table[1:, 1:] + table[:-1, 1:]) / 4)


def small_squares(level_1: Array, place_mm: Array, normals: Normals, exact: float) -> list[Squares]:
    """The points P* of all squares of one, two, ... units in Level_1.

    level_1 (C, R, 2): x/z, y/z, NaN where there is none; place_mm (C, R, 3): in the pattern; exact: a distance in the image that is
    below any noise.
    """
    found: list[Squares] = []
    for units in range(1, min(level_1.shape[:2])):
        squares = _squares(units, level_1, place_mm, normals, exact, LARGEST_SQUARE_RAD if units > 1 else np.inf)
        if squares is None:
            break
        found.append(squares)
    return found


def _squares(units: int, level_1: Array, place_mm: Array, normals: Normals, exact: float, largest_rad: float) -> Squares | None:
    """The squares of so many units; None where there is none."""
    size = tuple(np.array(level_1.shape[:2]) - units)
    corners, places = (
        np.stack([table[a : a + size[0], b : b + size[1]] for a, b in units * UNIT], axis=2).reshape(-1, 4, table.shape[2])
        for table in (level_1, place_mm)
    )
    whole = np.flatnonzero(np.isfinite(corners).all(axis=(1, 2)) & np.isfinite(places).all(axis=(1, 2)))
    whole = whole[_convex(corners[whole])]
    middle = np.concatenate([diagonals_meet(corners[whole]), np.ones((len(whole), 1))], axis=1)
    axes = sight_axes(middle)
    area = np.abs(_area(turned(axes, corners[whole])))
    small = np.sqrt(area) <= largest_rad
    rows, area, sight = whole[small], area[small], axes[small, 2]
    if not len(rows):
        return None
    seen, plane = corners[rows], _flat_mm(places[rows])
    normal, sure = _normals(plane, seen, normals, exact)
    delta = delta_alpha_rad(seen, normal)
    distance = depth_from_area_mm(area, np.abs(_area(plane)), delta, 1.0)
    columns = [sight * distance[:, None], normal, places[rows].mean(axis=1), area[:, None], delta[:, None], sure[:, None]]
    table = np.full((size[0] * size[1], 12), np.nan)
    table[rows] = np.concatenate(columns, axis=1)
    table = table.reshape(*size, 12)
    return Squares(units, table[..., :3], table[..., 3:6], table[..., 6:9], table[..., 9], table[..., 10], table[..., 11])


def _normals(plane_mm: Array, seen: Array, normals: Normals, exact: float) -> tuple[Array, Flags]:
    """Normals (K, 3) of squares, and where the image tells the way of the tilt (K,)."""
    if normals == "epnp":
        normal = epnp_normals(plane_mm, seen)
        return normal, np.asarray(np.isfinite(normal).all(axis=1))
    found = ippe_normals(plane_mm, seen)
    # eight numbers less six of the pose: the median of the sum of two squares is 2 ln 2 of the variance
    variance = max(float(np.median(found.square)) / (2 * np.log(2)), exact**2)
    return found.normal, np.asarray(found.other - found.square > SIGN_SIGMAS**2 * variance)


@dataclass(frozen=True)
class _Combined:
    """What P* says of K targets.

    weight (K,): 0 where it says nothing; depth_mm (K,), normal (K, 3): means by weight; area, delta_alpha_rad, sure (K,): those of the
    largest squares.
    """

    weight: Array
    depth_mm: Array
    normal: Array
    area: Array
    delta_alpha_rad: Array
    sure: Flags


def _lattice(pattern: Pattern) -> Ints:
    """Columns and rows (N, 2) from 0."""
    assert pattern.lattice is not None
    return pattern.lattice - pattern.lattice.min(axis=0)


def _of_targets(points: list[Squares], pattern: Pattern, index: Ints) -> _Combined:
    """The points of P* that belong to targets `index` (K,), one for each."""
    count, lattice = len(index), _lattice(pattern)
    weight, depth, normal = np.zeros(count), np.zeros(count), np.zeros((count, 3))
    area, delta, sure = np.full(count, np.nan), np.full(count, np.nan), np.zeros(count, dtype=bool)
    for squares in points:
        shares = [squares.point_mm, squares.normal, squares.place_mm, squares.area[..., None], squares.delta_alpha_rad[..., None]]
        table = np.concatenate([*shares, squares.sure[..., None]], axis=2)
        # odd squares lie about a node, even ones about a cell, four of which are around a node
        table = table if squares.units % 2 else means_of_four(table)
        row = lattice[index] - squares.units // 2 - 1
        inside = np.flatnonzero(((row >= 0) & (row < table.shape[:2])).all(axis=1))
        values = table[tuple(row[inside].T)]
        some = np.isfinite(values).all(axis=1)
        here, values = inside[some], values[some]
        facing = values[:, 3:6] / np.linalg.norm(values[:, 3:6], axis=1, keepdims=True)
        above = ((pattern.center_mm[index[here]] - values[:, 6:9]) * pattern.normal[index[here]]).sum(axis=1)
        weight[here] += squares.weight
        depth[here] += squares.weight * (values[:, 2] + above * facing[:, 2])
        normal[here] += squares.weight * facing
        area[here], delta[here], sure[here] = values[:, 9], values[:, 10], values[:, 11] == 1
    total = np.where(weight > 0, weight, 1.0)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return _Combined(weight, depth / total, normal / np.where(length > 0, length, 1.0), area, delta, sure)


def _convex(corners: Array) -> Flags:
    """Which quadrilaterals (K, 4, 2) turn the same way at every corner."""
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(ahead, 1, axis=1)
    turn = np.sign(behind[..., 0] * ahead[..., 1] - behind[..., 1] * ahead[..., 0])
    return np.asarray(np.abs(turn.sum(axis=1)) == 4)


def _area(corners: Array) -> Array:
    """Signed areas (K,) of quadrilaterals (K, 4, 2)."""
    first, second = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    return np.asarray(0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]))


def _flat_mm(places: Array) -> Array:
    """Corners (K, 4, 3) about their mean, in the plane of their diagonals (K, 4, 2)."""
    first, second = places[:, 2] - places[:, 0], places[:, 3] - places[:, 1]
    normal = np.cross(first, second)
    x = first / np.linalg.norm(first, axis=1, keepdims=True)
    y = np.cross(normal, x)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return np.asarray((places - places.mean(axis=1, keepdims=True)) @ np.stack([x, y], axis=2))
