"""What is drawn over the photograph of a map: one outline a target, measured, rejected or not seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.errors import ImageError
from dishmap.pipeline import Map
from dishmap.plot.grid_outlines import grid_shapes, node_strokes
from dishmap.plot.photograph import Outline
from dishmap.quality import names
from dishmap.targets.detect import Detections
from dishmap.targets.grid_detect import GridDetections
from dishmap.targets.identify import Identity
from dishmap.targets.pattern import Pattern
from dishmap.transforms import Pose
from dishmap.verdict import Numbers, number, rejected_targets

Array = NDArray[np.float64]

NOTHING = np.empty((0, 3, 2))


@dataclass(frozen=True)
class _Shapes:
    """How the N targets of a pattern are drawn: ellipses or strokes of each; place_px (N, 2) of those not measured, NaN: not drawn."""

    ellipses: list[Array]
    strokes: list[tuple[Array, ...]]
    place_px: Array


def outlines_of(result: Map, numbers: Numbers) -> list[Outline]:
    """Outlines of all targets of a map, in pixels of the picture that was measured."""
    shapes = _shapes(result)
    sigma = np.full(len(result.cloud), np.nan) if numbers.sigma_depth_mm is None else numbers.sigma_depth_mm
    out = []
    for n, i in enumerate(result.poses.index.tolist()):
        name, told = str(result.cloud.ids[n]), _told(result, n, sigma[n])
        out.append(Outline(shapes.ellipses[i], result.cloud.center_px[n], name, told, float(sigma[n]), "good", shapes.strokes[i]))
    place = {int(ident): i for i, ident in enumerate(result.pattern.ids.tolist())}
    visible = result.camera.contains(shapes.place_px)
    for state, listed in (("rejected", rejected_targets(result)), ("missing", [(i, "not seen") for i in result.missing])):
        for ident, reason in listed:
            i = place[ident]
            if visible[i]:
                told = f"target {ident}: {reason}"
                out.append(Outline(shapes.ellipses[i], shapes.place_px[i], str(ident), told, np.nan, state, shapes.strokes[i]))
    return out


def unused_outlines(result: Map) -> list[Outline]:
    """Outlines of what looks like a mark and was not used, with the reasons."""
    listed, found = result.identity.rejected, result.detections
    which = np.array([r.detection for r in listed], dtype=np.int64)
    titles = [f"not used: {r.reason}" for r in listed]
    if isinstance(found, GridDetections):
        strokes = node_strokes(result, found.place_px[which], found.step_px[which])
        return [Outline(NOTHING, p, "", t, np.nan, "unused", s) for p, t, s in zip(found.place_px[which], titles, strokes, strict=True)]
    return [Outline(e[None], e[0], "", t, np.nan, "unused") for e, t in zip(_ellipses_px(found, which), titles, strict=True)]


def _shapes(result: Map) -> _Shapes:
    count = len(result.pattern)
    if result.pattern.is_grid:
        place, strokes = grid_shapes(result)
        return _Shapes([NOTHING] * count, strokes, place)
    found, identity = result.detections, result.identity
    assert isinstance(found, Detections)
    assert isinstance(identity, Identity)
    ellipses, owner = _ellipses_px(found, identity.detection), result.pattern.marks.target[identity.mark]
    printed = nominal_ellipses(result.camera, result.pattern, result.camera_from_dish)
    own = [ellipses[owner == i] for i in range(count)]
    nominal = result.camera.project(result.camera_from_dish.apply(result.pattern.center_mm))
    return _Shapes([seen if len(seen) else other for seen, other in zip(own, printed, strict=True)], [()] * count, nominal)


def _told(result: Map, n: int, sigma_mm: float) -> str:
    x, y, z = result.cloud.position_mm[n]
    flags = names(int(result.cloud.quality[n])).replace("|", ", ")
    known = f", depth sigma {number(float(sigma_mm))} mm" if np.isfinite(sigma_mm) else ""
    return f"target {result.cloud.ids[n]}: x {x:.2f}, y {y:.2f}, z {z:.2f} mm (camera frame){known}{', flags: ' + flags if flags else ''}"


def _ellipses_px(found: Detections, which: NDArray[np.int64]) -> Array:
    """Centre and ends of both semi-axes (K, 3, 2) of detections."""
    if not len(which):
        return NOTHING
    center, (major, minor) = found.center_px[which], found.semi_axes_px[which].T
    along = np.column_stack([np.cos(found.angle_rad[which]), np.sin(found.angle_rad[which])])
    across = np.column_stack([-along[:, 1], along[:, 0]])
    return np.stack([center, center + major[:, None] * along, center + minor[:, None] * across], axis=1)


def nominal_ellipses(camera: Camera, pattern: Pattern, camera_from_dish: Pose) -> list[Array]:
    """Where the outermost circles of each target (K, 3, 2) would be seen on the undeformed surface, but for those outside the lens."""
    marks, axes = pattern.marks, pattern.axes
    radius = marks.radius_mm[:, None, None]
    ends = marks.center_mm[:, None] + radius * np.stack([axes[marks.target][:, :, 0], axes[marks.target][:, :, 1]], axis=1)
    three = np.concatenate([marks.center_mm[:, None], ends], axis=1)
    pixels = camera.project(camera_from_dish.apply(three))
    seen = np.isfinite(pixels).all(axis=(1, 2))
    return [pixels[seen & (marks.target == i)] for i in range(len(pattern))]


def check_picture(image: NDArray[np.generic], camera: Camera) -> None:
    """Raise ImageError unless the picture (H, W) has the size of the camera it was measured with."""
    if image.shape != (camera.height_px, camera.width_px):
        raise ImageError(
            f"the picture for a report has shape {image.shape} but the map was made from one of {camera.width_px}x{camera.height_px} px; "
            "give the photograph that was measured (for the method `paper` the undistorted one)"
        )
