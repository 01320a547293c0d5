"""The forward map of the simulator: printed position -> nominal surface -> this state -> camera frame -> pixel.

Pixels and truth both come from here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.camera.model import Camera
from dishmap.simulate.deform import Deformation, deform, displacement_mm
from dishmap.simulate.scene import Ribs, Scene
from dishmap.targets.flat import from_flat_mm, to_flat_mm
from dishmap.targets.gridlines import GridLines
from dishmap.targets.pattern import bent_print_mm

Array = NDArray[np.float64]

# Central differences of the printed position: over 0.01 mm the truncation and the rounding of the normal stay under 1e-8.
NORMAL_STEP_MM = 0.01
OUTLINE_COARSE = 512
# Chords of half a pixel cut 1e-4 px off a rim of 300 px radius.
OUTLINE_STEP_PX = 0.5
# An outline of more steps reaches far beyond any image
OUTLINE_LONGEST = 400_000
# Outlines are drawn in to this part of the lens's field
FIELD_PART = 0.999


def rim_radius_mm(scene: Scene) -> float:
    """The radius at which a Zernike term is 1: the surface's rim, or the outermost ink of a pattern without one."""
    return scene.pattern.rim_radius_mm


def printed_points(scene: Scene, index: ArrayLike, xy_mm: ArrayLike) -> Array:
    """Points (..., 3) in the camera frame of printed positions (..., 2) of targets number `index`, which broadcasts to (...)."""
    pattern = scene.pattern
    i, xy = np.asarray(index), np.asarray(xy_mm, dtype=float)
    local = bent_print_mm(xy[..., None, :], pattern.curvature_per_mm[i])[..., 0, :]
    nominal = pattern.center_mm[i] + np.einsum("...ij,...j->...i", pattern.axes[i], local)
    return scene.camera_from_dish.apply(deform(scene.deformation, pattern.surface, nominal, rim_radius_mm(scene)))


def centers_and_normals(scene: Scene) -> tuple[Array, Array]:
    """Centres and unit normals (N, 3) of all targets in the camera frame; the normal is that of the printed side."""
    return _points_and_normals(scene, np.arange(len(scene.pattern)), np.zeros(2))


def _points_and_normals(scene: Scene, index: ArrayLike, xy_mm: ArrayLike) -> tuple[Array, Array]:
    """Points and unit normals (K, 3) in the camera frame of printed positions (K, 2) of targets number `index`."""
    index, xy = np.broadcast_arrays(np.asarray(index)[..., None], np.asarray(xy_mm, dtype=float))
    steps = NORMAL_STEP_MM * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    points = printed_points(scene, index[:, :1], xy[:, None] + steps)
    normal = np.cross(points[:, 1] - points[:, 2], points[:, 3] - points[:, 4])
    return points[:, 0], normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def line_points(scene: Scene, lines: GridLines, line: ArrayLike, t: ArrayLike, across_mm: ArrayLike = 0.0) -> Array:
    """Points (..., 3) in the camera frame of places on a grid's lines, as `GridLines.points_mm` takes them."""
    nominal = lines.points_mm(line, t, across_mm)
    return scene.camera_from_dish.apply(deform(scene.deformation, scene.pattern.surface, nominal, rim_radius_mm(scene)))


def facing(scene: Scene) -> NDArray[np.bool_]:
    """Which targets (N,) show their printed side to the camera, and are not behind the near rim of the dish."""
    center, normal = centers_and_normals(scene)
    return _shown(scene, scene.pattern.center_mm, center, normal)


def print_facing(scene: Scene, index: int, xy_mm: ArrayLike) -> NDArray[np.bool_]:
    """Which printed positions (K, 2) of target number `index` show their printed side, as `facing` says it of targets."""
    pattern, xy = scene.pattern, np.asarray(xy_mm, dtype=float)
    nominal = pattern.center_mm[index] + bent_print_mm(xy, pattern.curvature_per_mm[index]) @ pattern.axes[index].T
    return _shown(scene, nominal, *_points_and_normals(scene, index, xy))


def line_facing(scene: Scene, lines: GridLines, line: ArrayLike, t: ArrayLike) -> NDArray[np.bool_]:
    """Which places (K,) on the middles of lines show their printed side, as `facing` says it of targets."""
    line, t = np.broadcast_arrays(np.asarray(line), np.asarray(t, dtype=float))
    moves = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    along = NORMAL_STEP_MM / np.linalg.norm(lines.tangent_mm(line, t), axis=-1)
    points = line_points(scene, lines, line[:, None], t[:, None] + along[:, None] * moves[:, 0], NORMAL_STEP_MM * moves[:, 1])
    normal = np.cross(points[:, 1] - points[:, 2], points[:, 3] - points[:, 4])
    return _shown(scene, lines.points_mm(line, t), points[:, 0], normal)


def _shown(scene: Scene, nominal: Array, center: Array, normal: Array) -> NDArray[np.bool_]:
    """Which points (K, 3) of the nominal surface, at `center` with `normal` (K, 3) in the camera frame, the camera sees."""
    shown = np.asarray((center * normal).sum(axis=1) < 0)
    surface = scene.pattern.surface
    if surface.kind != "paraboloid" or surface.focal_length_mm is None:
        return shown
    # The line of sight meets the nominal paraboloid at the target (t = 0) and once more: x, y are rho(t) = start + t along.
    along = (scene.camera_from_dish @ scene.deformation.motion).inverse().translation_mm - nominal
    across = (along[:, :2] ** 2).sum(axis=1)
    t = (4 * surface.focal_length_mm * along[:, 2] - 2 * (nominal * along)[:, :2].sum(axis=1)) / np.maximum(across, 1e-12)
    rho = np.linalg.norm(nominal[:, :2] + t[:, None] * along[:, :2], axis=1)
    return np.asarray(shown & ~((t > 0) & (t < 1) & (rho < rim_radius_mm(scene))))


def target_displacement_mm(scene: Scene) -> Array:
    """Displacement (N,) of the targets' centres along their nominal normals, without expansion and rigid motion."""
    return displacement_mm(scene.deformation, scene.pattern.center_mm[:, :2], rim_radius_mm(scene))


def outline_px(scene: Scene) -> Array:
    """Outline of the whole surface in the image: a closed polyline (K, 2) with steps of half a pixel.

    The rim of the surface; for a pattern without a diameter, a circle (paraboloid) or a rectangle (plane; cylinder: as unrolled)
    around all ink with the scene's margin. A cylinder ends where it turns away from the camera. What lies outside the lens's field
    is drawn in to its border.
    """
    coarse = _outline_at(scene, np.arange(OUTLINE_COARSE) / OUTLINE_COARSE)
    longest = np.linalg.norm(np.roll(coarse, -1, axis=0) - coarse, axis=1).max()
    count = int(np.clip(OUTLINE_COARSE * longest / OUTLINE_STEP_PX, OUTLINE_COARSE, OUTLINE_LONGEST))
    return _outline_at(scene, np.arange(count) / count)


def rib_outlines_px(scene: Scene, ribs: Ribs) -> list[Array]:
    """Outlines of ribs in the image: closed polylines (K, 2) with steps of half a pixel.

    Beyond the rim a rib goes on as the nominal surface would, moved as the rim beside it is: a deformation means nothing there.
    """
    # counter-clockwise about the boresight, as the surface's outline
    across = np.array([-0.5, -0.5, 0.5, 0.5, -0.5]) * ribs.width_mm
    along = np.array([0.0, 1.0, 1.0, 0.0, 0.0]) * (ribs.outer_radius_mm - ribs.inner_radius_mm) + ribs.inner_radius_mm
    outlines = []
    for angle in ribs.first_rad + 2 * np.pi * np.arange(ribs.count) / ribs.count:
        out, side = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        corners = along[:, None] * out + across[:, None] * side
        ends = _rib_px(scene, corners)
        cuts = np.clip(np.linalg.norm(np.diff(ends, axis=0), axis=1) / OUTLINE_STEP_PX, 8, OUTLINE_LONGEST).astype(np.int64)
        steps = [a + (b - a) * (np.arange(n) / n)[:, None] for a, b, n in zip(corners[:-1], corners[1:], cuts, strict=True)]
        outlines.append(_rib_px(scene, np.concatenate(steps)))
    return outlines


def _outline_at(scene: Scene, t: Array) -> Array:
    """Outline (K, 2) in pixels at parameters (K,) from 0 to 1."""
    pattern = scene.pattern
    if pattern.surface.kind == "cylinder" or (pattern.surface.kind == "plane" and pattern.surface.diameter_mm is None):
        xy = _rectangle(scene, t)
    else:
        radius = rim_radius_mm(scene) + (scene.margin_mm if pattern.surface.diameter_mm is None else 0.0)
        xy = radius * np.stack([np.cos(2 * np.pi * t), np.sin(2 * np.pi * t)], axis=-1)
    return _surface_px(scene, xy)


def _surface_px(scene: Scene, xy_mm: Array) -> Array:
    """Image (K, 2) of points of the surface at nominal positions (K, 2)."""
    return scene.camera.project(_drawn_in(scene.camera, _surface_points(scene, xy_mm)))


def _rib_px(scene: Scene, xy_mm: Array) -> Array:
    """Image (K, 2) of points of ribs at nominal positions (K, 2), on the surface or beyond its rim."""
    radius = rim_radius_mm(scene)
    inner = xy_mm * np.minimum(1.0, radius / np.maximum(np.linalg.norm(xy_mm, axis=1), 1e-9))[:, None]
    rigid = replace(scene, deformation=Deformation(expansion_ppm=scene.deformation.expansion_ppm, motion=scene.deformation.motion))
    moved = _surface_points(scene, inner) - _surface_points(rigid, inner)
    return scene.camera.project(_drawn_in(scene.camera, _surface_points(rigid, xy_mm) + moved))


def _surface_points(scene: Scene, xy_mm: Array) -> Array:
    """Points (K, 3) in the camera frame of the surface at nominal positions (K, 2)."""
    surface = scene.pattern.surface
    nominal = np.concatenate([xy_mm, surface.height_mm(xy_mm)[..., None]], axis=-1)
    return scene.camera_from_dish.apply(deform(scene.deformation, surface, nominal, rim_radius_mm(scene)))


def _rectangle(scene: Scene, t: Array) -> Array:
    """X and y (K, 2) in mm along the edge of a plate or an unrolled cylinder, counter-clockwise, the four sides equal in t."""
    low, high = _ink_box(scene)
    low, high = low - scene.margin_mm, high + scene.margin_mm
    if scene.pattern.surface.kind == "cylinder":
        nearest, farthest = _cylinder_in_view(scene)
        low[0], high[0] = max(low[0], nearest), min(high[0], farthest)
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    side = np.minimum((4 * t).astype(np.int64), 3)
    part = (4 * t - side)[:, None]
    return from_flat_mm(scene.pattern.surface, corners[side] * (1 - part) + corners[(side + 1) % 4] * part)


def _ink_box(scene: Scene) -> tuple[Array, Array]:
    """Least and greatest flat coordinates (2,) of a pattern's ink."""
    pattern = scene.pattern
    extent = np.array([kind.extent_mm for kind in map(pattern.kind_of, range(len(pattern)))])[:, None]
    flat = to_flat_mm(pattern.surface, pattern.center_mm[:, :2])
    low, high = (flat - extent).min(axis=0), (flat + extent).max(axis=0)
    if pattern.lines:
        lines = GridLines(pattern)
        every, half = np.arange(len(pattern.lines)), lines.width_mm / 2
        ends = [lines.points_mm(every, t, a) for t in (lines.start_t, lines.stop_t) for a in (-half, half)]
        flat = to_flat_mm(pattern.surface, np.concatenate(ends)[:, :2])
        low, high = np.minimum(low, flat.min(axis=0)), np.maximum(high, flat.max(axis=0))
    return low, high


def _cylinder_in_view(scene: Scene) -> tuple[float, float]:
    """The way round a cylinder (mm, from its middle) from where to where its nominal surface shows its printed side to the camera."""
    radius = scene.pattern.surface.radius_mm
    assert radius is not None
    quarter = FIELD_PART * np.pi / 2
    eye = (scene.camera_from_dish @ scene.deformation.motion).inverse().translation_mm
    # the axis lies at z = -radius; the normal (sin a, cos a), a = way / radius, faces the eye where (eye - axis) . normal > radius
    away, middle = np.hypot(eye[0], eye[2] + radius), np.sign(radius) * np.arctan2(eye[0], eye[2] + radius)
    half = np.arccos(np.clip(radius / away, -1.0, 1.0))
    return abs(radius) * max(middle - half, -quarter), abs(radius) * min(middle + half, quarter)


def _drawn_in(camera: Camera, points_mm: Array) -> Array:
    """Points (K, 3), those outside the lens's field turned towards the axis until they are just inside."""
    widest = FIELD_PART * (np.arctan(camera.widest) if camera.model == "opencv" else camera.widest)
    across = np.hypot(points_mm[:, 0], points_mm[:, 1])
    angle = np.minimum(np.arctan2(across, points_mm[:, 2]), widest)
    unit = points_mm[:, :2] / np.where(across > 0, across, 1.0)[:, None]
    return np.concatenate([unit * np.sin(angle)[:, None], np.cos(angle)[:, None]], axis=-1)
