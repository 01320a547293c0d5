"""What a printer made of a pattern, from the measured lengths of the scale bars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.sheet.pieces import Piece
from dishmap.targets.pattern import GridLine, Pattern, Polygon, TargetKind

Array = NDArray[np.float64]

# A bar that is off by more was measured wrongly, or of another sheet.
LARGEST_SCALE_ERROR = 0.25
# Circles that are ellipses by more than this part are no circles to measure with.
LARGEST_UNEVENNESS = 0.02
# Kinds whose circles move by less than this in mm are one.
SAME_MM = 1e-7


def print_scale(measured_mm: Sequence[float], bar_mm: float) -> Array:
    """Printed over intended length along x and y (2,) from the measured bars. Raises InputError for impossible lengths."""
    scale = np.asarray(measured_mm, dtype=float) / bar_mm
    if scale.shape != (2,) or not (np.isfinite(scale).all() and (np.abs(scale - 1) <= LARGEST_SCALE_ERROR).all()):
        raise InputError(
            f"measured bars of {' x '.join(f'{v:g}' for v in measured_mm)} mm do not belong to bars of {bar_mm:g} mm; measure along x and "
            "y between the middles of the ticks, in mm, and give the paper that was printed on"
        )
    if abs(scale[0] / scale[1] - 1) > LARGEST_UNEVENNESS:
        raise InputError(
            f"the print is {abs(scale[0] / scale[1] - 1):.1%} longer one way than the other, so its circles are ellipses; "
            f"measure again, and if it is so, print on another printer (up to {LARGEST_UNEVENNESS:.0%} is taken)"
        )
    return scale


def printed_pattern(pattern: Pattern, pieces: Sequence[Piece], scale: Array) -> Pattern:
    """The pattern as printed with errors of scale (2,) along the paper's x and y, each piece laid with its anchor in place.

    Places, and the circles' places in their targets, follow both scales; a circle that became an ellipse keeps its area. Polygons and
    lines follow both scales.
    """
    center, x_axis, normal = pattern.center_mm.copy(), pattern.x_axis.copy(), pattern.normal.copy()
    names = list(pattern.kind_names)
    kinds: dict[str, TargetKind] = {}
    for piece in pieces:
        flat = piece.anchor_mm + (piece.center_mm - piece.anchor_mm) * scale
        along, across = np.cos(piece.angle_rad) * scale[0], np.sin(piece.angle_rad) * scale[1]
        turned = np.arctan2(across, along)
        xy, (x, y) = piece.map.to_surface(flat), piece.map.axes(flat)
        index = piece.target
        shift = np.column_stack([xy, pattern.surface.height_mm(xy)]) - np.column_stack(
            [pattern.center_mm[index, :2], pattern.surface.height_mm(pattern.center_mm[index, :2])]
        )
        center[index] += shift
        tilted = pattern.normal[index] + pattern.surface.normal(xy) - pattern.surface.normal(pattern.center_mm[index, :2])
        normal[index] = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
        direction = np.cos(turned)[:, None] * x + np.sin(turned)[:, None] * y
        direction -= (direction * normal[index]).sum(axis=1, keepdims=True) * normal[index]
        x_axis[index] = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        for k, before, after in zip(index, piece.angle_rad, turned, strict=True):
            local = _turn(-after) @ np.diag(scale) @ _turn(before)
            names[k] = _add_kind(kinds, pattern.kind_names[k], _printed_kind(pattern.kind_of(int(k)), local))
    laid = replace(pattern, kinds=kinds, kind_names=tuple(names), center_mm=center, x_axis=x_axis, normal=normal)
    return replace(laid, name=f"{pattern.name} as printed", lines=_printed_lines(pattern, pieces, scale))


def _printed_kind(kind: TargetKind, local: Array) -> TargetKind:
    center = kind.center_mm @ local.T
    polygons = tuple(Polygon(np.round(polygon.corners_mm @ local.T, 9) + 0.0, polygon.dark) for polygon in kind.polygons)
    return TargetKind(np.round(center, 9) + 0.0, kind.radius_mm * np.sqrt(np.linalg.det(local)), kind.dark, polygons)


def _printed_lines(pattern: Pattern, pieces: Sequence[Piece], scale: Array) -> tuple[GridLine, ...]:
    """Lines with the widths and overhangs that they were printed with: over their targets, in the mean."""
    if not pattern.lines or pattern.lattice is None:
        return ()
    angle = np.zeros(len(pattern))
    for piece in pieces:
        angle[piece.target] = piece.angle_rad
    row = {int(i): k for k, i in enumerate(pattern.ids)}
    found = []
    for line in pattern.lines:
        of = [row[i] for i in line.ids]
        along_y = bool(np.abs(np.diff(pattern.lattice[of], axis=0)).sum(axis=0).argmax())
        way = angle[of] + along_y * np.pi / 2
        # a length along (cos, sin) grows by this, and a width across it by the area's growth over it
        longer = np.hypot(scale[0] * np.cos(way), scale[1] * np.sin(way))
        found.append(GridLine(line.ids, line.width_mm * float((scale.prod() / longer).mean()), line.overhang_mm * float(longer.mean())))
    return tuple(found)


def _add_kind(kinds: dict[str, TargetKind], name: str, kind: TargetKind) -> str:
    """The name under which a kind stands, a new one unless there is one like it."""
    number = 1
    while True:
        called = name if number == 1 else f"{name}~{number}"
        known = kinds.setdefault(called, kind)
        if known is kind or np.abs(_places(known) - _places(kind)).max(initial=0.0) < SAME_MM:
            return called
        number += 1


def _places(kind: TargetKind) -> Array:
    """Centres of circles and corners of polygons (K, 2)."""
    return np.concatenate([kind.center_mm, *(polygon.corners_mm for polygon in kind.polygons)])


def _turn(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
