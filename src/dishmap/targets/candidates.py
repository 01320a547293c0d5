"""Which detected ellipses could be marks of a pattern, and of which type, before anything is known about their place.

A mark is an outermost dark circle with what is nested in it; its type is told by the nested circles' sizes relative to
its own. Geometry is kept in the plane at right angles to each candidate's own ray, so it holds for any lens.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.targets.detect import Detections
from dishmap.targets.ellipses import ellipse_matrices, invert_2x2
from dishmap.targets.pattern import Marks
from dishmap.targets.rigid import Sights, sights_of

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Index = NDArray[np.int64]

# Tolerance of a nested circle's relative radius: ink spread, and what blur and threshold do to each of two edges (px). A
# blurred hole in a thin ring shrinks.
RATIO_TOLERANCE = 0.08
RATIO_TOLERANCE_PX = 1.2
# A nested circle of at least this radius, and so far from those around and in it (px), cannot go unseen by blur, but only by
# glare or dirt.
VISIBLE_RADIUS_PX, VISIBLE_GAP_PX = 4.5, 4.0
# Something light in a mark counts as a printed circle from this radius relative to the mark's, and this contrast relative to
# the mark's own; less is dirt or a thin spot in the ink.
STRAY_RATIO = 0.15
STRAY_CONTRAST = 0.4
DEEPEST_NESTING = 12


@dataclass(frozen=True)
class Candidates:
    """N ellipses that could be marks.

    detection (N,): index into the detections; center_px (N, 2); size_px (N,): root of the product of the half axes.
    ray (N, 3) unit, tangent (N, 3, 2): axes at right angles to it, like image x and y; shape (N, 2, 2): maps the unit
    circle to the ellipse, in tangents of angles along these axes; px_per_tangent (N, 2, 2). is_type (N, T): all printed circles are there;
    may_be_type (N, T): some are not seen, but nothing contradicts, and it is no whole mark of another type; has_more (N, T):
    there is something printed inside that the type does not have.
    """

    detection: Index
    center_px: Array
    size_px: Array
    ray: Array
    tangent: Array
    shape: Array
    px_per_tangent: Array
    is_type: Flags
    may_be_type: Flags
    has_more: Flags

    def __len__(self) -> int:
        return len(self.detection)

    @property
    def sights(self) -> Sights:
        """The centres as rays, for a pose."""
        return Sights(self.ray, self.tangent, self.px_per_tangent)

    def take(self, index: NDArray[np.int64]) -> Candidates:
        """The candidates at `index`."""
        return Candidates(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def mark_candidates(detections: Detections, marks: Marks, camera: Camera) -> Candidates:
    """Find the ellipses that could be marks of the pattern.

    Dark ellipses that hold what one of the pattern's types holds; those that are part of another candidate are left out, and
    those where the lens model does not hold.
    """
    size = np.sqrt(detections.semi_axes_px.prod(axis=1))
    is_type, may_be, has_more = _types(detections, size, marks)
    index = np.flatnonzero(detections.dark & (is_type | may_be).any(axis=1) & ~_inside_another(detections, is_type))
    sights = sights_of(camera, detections.center_px[index])
    ray, tangent, px_per_tangent = sights.ray, sights.tangent, sights.px_per_tangent
    with np.errstate(invalid="ignore", divide="ignore"):
        shape = invert_2x2(px_per_tangent) @ ellipse_matrices(detections.semi_axes_px[index], detections.angle_rad[index])
    center, types = detections.center_px[index], (is_type[index], may_be[index], has_more[index])
    found = Candidates(index, center, size[index], ray, tangent, shape, px_per_tangent, *types)
    return found.take(np.flatnonzero(np.isfinite(ray).all(axis=1) & np.isfinite(shape).all(axis=(1, 2))))


def _inside_another(detections: Detections, is_type: Flags) -> Flags:
    """Ellipses within a dark one that is a whole mark by itself."""
    whole = np.append(detections.dark & is_type.any(axis=1), False)
    inside = np.zeros(len(detections), dtype=bool)
    above = detections.parent
    for _ in range(DEEPEST_NESTING):
        if (above < 0).all():
            break
        inside |= whole[above]
        above = np.append(detections.parent, -1)[above]
    return inside


def _types(detections: Detections, size: Array, marks: Marks) -> tuple[Flags, Flags, Flags]:
    """For each ellipse and type (M, T): `is_type`, `may_be_type` and `has_more` of `Candidates`."""
    holder, held = _nested_pairs(detections.parent)
    relevant = detections.dark[holder]
    holder, held = holder[relevant], held[relevant]
    ratio = size[held] / size[holder]
    strong = (ratio >= STRAY_RATIO) & (detections.contrast[held] >= STRAY_CONTRAST * detections.contrast[holder])
    count = len(detections)
    is_type = np.zeros((count, len(marks.type_ratios)), dtype=bool)
    has_more = np.zeros_like(is_type)
    tolerance = RATIO_TOLERANCE + RATIO_TOLERANCE_PX / size[holder]
    for column, wanted in enumerate(marks.type_ratios):
        explained = np.zeros(len(held), dtype=bool)
        lacking = np.zeros(count, dtype=bool)
        for value, times in zip(*np.unique(wanted, return_counts=True), strict=True) if wanted else ():
            # what blur can close it can also shrink to any size
            others = np.abs(np.array([1.0, *wanted]) - value)
            faint = (value * size < VISIBLE_RADIUS_PX) | (others[others > 0].min() * size < VISIBLE_GAP_PX)
            near = (ratio - value <= tolerance) & ((value - ratio <= tolerance) | faint[holder])
            explained |= near
            lacking |= ~faint & (np.bincount(holder[near], minlength=count) < times)
        stray = np.bincount(holder[strong & ~explained], minlength=count) > 0
        is_type[:, column] = ~stray & ~lacking
        has_more[:, column] = stray
    return is_type, ~has_more & ~is_type.any(axis=1, keepdims=True), has_more


def _nested_pairs(parent: Index) -> tuple[Index, Index]:
    """All pairs (outer, inner) of ellipses, over all depths of nesting."""
    outer, inner = [], []
    index, above = np.arange(len(parent)), parent
    for _ in range(DEEPEST_NESTING):
        index, above = index[above >= 0], above[above >= 0]
        if not len(index):
            break
        outer.append(above)
        inner.append(index)
        above = parent[above]
    none = np.zeros(0, dtype=np.int64)
    return np.concatenate([none, *outer]), np.concatenate([none, *inner])
