"""What is drawn over the photograph of a map: one outline a target, measured, rejected or not seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.errors import ImageError
from dishmap.pipeline import Map
from dishmap.plot.photograph import Outline
from dishmap.quality import names
from dishmap.targets.pattern import Pattern
from dishmap.transforms import Pose
from dishmap.verdict import Numbers, number, rejected_targets

Array = NDArray[np.float64]

NOTHING = np.empty((0, 3, 2))


def outlines_of(result: Map, numbers: Numbers) -> list[Outline]:
    """Outlines of all targets of a map, in pixels of the picture that was measured."""
    ellipses, owner = _ellipses_px(result, result.identity.detection), result.pattern.marks.target[result.identity.mark]
    sigma = np.full(len(result.cloud), np.nan) if numbers.sigma_depth_mm is None else numbers.sigma_depth_mm
    out = []
    for n, index in enumerate(result.poses.index.tolist()):
        out.append(
            Outline(
                ellipses[owner == index],
                result.cloud.center_px[n],
                str(result.cloud.ids[n]),
                _told(result, n, sigma[n]),
                float(sigma[n]),
                "good",
            )
        )
    place = {int(ident): i for i, ident in enumerate(result.pattern.ids.tolist())}
    nominal = result.camera.project(result.camera_from_dish.apply(result.pattern.center_mm))
    visible = result.camera.contains(nominal)
    printed = nominal_ellipses(result.camera, result.pattern, result.camera_from_dish)
    for state, listed in (("rejected", rejected_targets(result)), ("missing", [(i, "not seen") for i in result.missing])):
        for ident, reason in listed:
            index = place[ident]
            own = ellipses[owner == index]
            own = own if len(own) else printed[index]
            if visible[index]:
                out.append(Outline(own, nominal[index], str(ident), f"target {ident}: {reason}", np.nan, state))
    return out


def unused_outlines(result: Map) -> list[Outline]:
    """Outlines of what looks like a mark and was not used, with the reasons."""
    listed = result.identity.rejected
    ellipses = _ellipses_px(result, np.array([r.detection for r in listed], dtype=np.int64))
    return [Outline(e[None], e[0], "", f"not used: {r.reason}", np.nan, "unused") for e, r in zip(ellipses, listed, strict=True)]


def _told(result: Map, n: int, sigma_mm: float) -> str:
    x, y, z = result.cloud.position_mm[n]
    flags = names(int(result.cloud.quality[n])).replace("|", ", ")
    known = f", depth sigma {number(float(sigma_mm))} mm" if np.isfinite(sigma_mm) else ""
    return f"target {result.cloud.ids[n]}: x {x:.2f}, y {y:.2f}, z {z:.2f} mm (camera frame){known}{', flags: ' + flags if flags else ''}"


def _ellipses_px(result: Map, which: NDArray[np.int64]) -> Array:
    """Centre and ends of both semi-axes (K, 3, 2) of detections."""
    found = result.detections
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
