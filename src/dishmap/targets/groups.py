"""Which detected ellipse is which printed circle of which target, for methods that work on ellipses.

Identification names the outermost ellipses; the nested ones follow from their size and colour.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.errors import InputError
from dishmap.targets.pattern import Pattern, TargetKind

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
Skipped = tuple[tuple[int, str], ...]

# A nested detection is a printed circle if their sizes relative to the outer one agree this well.
SIZE_RATIO_GATE = 1.25
# How far the middle of a target's circles may lie off its origin, relative to its size: beyond, it is not the target's centre.
MIDDLE_TOLERANCE = 1e-6


class EllipseSet(Protocol):
    """What is read of detections: center_px (M, 2), semi_axes_px (M, 2) major first, angle_rad (M,), dark (M,), parent (M,)."""

    @property
    def center_px(self) -> Array: ...  # noqa: D102
    @property
    def semi_axes_px(self) -> Array: ...  # noqa: D102
    @property
    def angle_rad(self) -> Array: ...  # noqa: D102
    @property
    def dark(self) -> Flags: ...  # noqa: D102
    @property
    def parent(self) -> Ints: ...  # noqa: D102


@dataclass(frozen=True)
class CircleGroups:
    """Which detection is which printed circle, over the complete targets.

    detection, target, mark, circle (R,): indices into the detections, the pattern's targets, its marks, and its kind's circles;
    skipped: (index of the target, reason).
    """

    detection: Ints
    target: Ints
    mark: Ints
    circle: Ints
    skipped: Skipped


def group_circles(pattern: Pattern, detections: EllipseSet, mark: ArrayLike, detection: ArrayLike) -> CircleGroups:
    """Find the printed circle of each detection inside the identified outermost ones, target by target.

    mark, detection (K,): indices of matching marks and outermost detections. Targets that are incomplete, or whose circles are
    not arranged about the target's origin, are skipped. Raises InputError for indices that do not fit.
    """
    mark, detection = np.asarray(mark, dtype=np.int64).reshape(-1), np.asarray(detection, dtype=np.int64).reshape(-1)
    marks, total = pattern.marks, len(detections.angle_rad)
    if len(mark) != len(detection) or len(np.unique(mark)) != len(mark) or len(np.unique(detection)) != len(detection):
        raise InputError("mark and detection must be lists of equal length in which nothing stands twice")
    if len(mark) and not (mark.min() >= 0 and mark.max() < len(marks.target) and detection.min() >= 0 and detection.max() < total):
        raise InputError(f"mark must index the pattern's {len(marks.target)} marks and detection the {total} detections")
    children = _nested_in(detections, detection)
    seen = dict(zip(mark.tolist(), detection.tolist(), strict=True))
    rows: list[tuple[int, int, int, int]] = []
    skipped: list[tuple[int, str]] = []
    for t in np.unique(marks.target[mark]).tolist():
        kind, numbers = pattern.kind_of(t), np.flatnonzero(marks.target == t).tolist()
        outermost = np.flatnonzero(kind.parent < 0)
        if np.linalg.norm(kind.center_mm[outermost].mean(axis=0)) > MIDDLE_TOLERANCE * kind.extent_mm:
            skipped.append((t, "its circles do not lie evenly about its origin, so their K-means centre is not its own"))
            continue
        found: list[tuple[int, int, int, int]] = []
        for number, outer in zip(numbers, outermost, strict=True):
            if number in seen:
                matched = _match_nested(kind, int(outer), detections, seen[number], children[seen[number]])
                found += [(d, t, number, c) for d, c in matched]
        if len(found) == len(kind.radius_mm):
            rows += found
        else:
            skipped.append((t, f"only {len(found)} of its {len(kind.radius_mm)} circles were found"))
    table = np.array(rows, dtype=np.int64).reshape(-1, 4)
    return CircleGroups(table[:, 0], table[:, 1], table[:, 2], table[:, 3], tuple(skipped))


def _nested_in(detections: EllipseSet, outer: Ints) -> dict[int, list[int]]:
    """Detections inside each of the outer ones, at any depth."""
    inside: dict[int, list[int]] = {int(d): [] for d in outer}
    for index, parent in enumerate(detections.parent.tolist()):
        while parent >= 0 and parent not in inside:
            parent = int(detections.parent[parent])
        if parent >= 0:
            inside[parent].append(index)
    return inside


def _match_nested(kind: TargetKind, outer: int, detections: EllipseSet, found: int, children: list[int]) -> list[tuple[int, int]]:
    """Pairs (detection, circle) of one mark: the outer circle, then each nested one with the child of its size and colour."""
    size = np.log(np.asarray(detections.semi_axes_px).prod(axis=1)) / 2
    inside = np.linalg.norm(kind.center_mm - kind.center_mm[outer], axis=1) < kind.radius_mm[outer]
    inside[outer] = False
    pairs, free = [(found, outer)], list(children)
    for circle in np.flatnonzero(inside)[np.argsort(-kind.radius_mm[inside])].tolist():
        wanted = np.log(kind.radius_mm[circle] / kind.radius_mm[outer]) + size[found]
        fits = [c for c in free if detections.dark[c] == kind.dark[circle] and abs(size[c] - wanted) < np.log(SIZE_RATIO_GATE)]
        if fits:
            best = min(fits, key=lambda c: float(abs(size[c] - wanted)))
            free.remove(best)
            pairs.append((best, circle))
    return pairs
