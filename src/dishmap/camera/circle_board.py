"""A board of circles: any flat pattern of ours, found without a camera and then measured in the raw pixels with one.

At first the centre of each outermost circle's outline is used, through `board.outline_shift`, which knows that it is not the image of
the circle's centre. With the camera that follows, whole targets are measured in the raw pixels as in a map; their centres are exact through
perspective and lens, and some times more precise than outlines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.board import BoardSearch, BoardView, check_same_size
from dishmap.camera.board_labels import Labels, label_board
from dishmap.camera.calibrate import FEWEST_CORNERS, Calibration
from dishmap.errors import IdentityError, InputError, MeasurementError
from dishmap.quality import Quality
from dishmap.targets.detect import Detections, find_ellipses
from dishmap.targets.identify import Identity
from dishmap.targets.pattern import Pattern
from dishmap.targets.pose import measure_targets

Array = NDArray[np.float64]
Gray = NDArray[np.uint8] | NDArray[np.uint16]
Progress = Callable[[int, int], None]

# A target with one of these is not used: part of what it shows is not print.
SPOILT = Quality.OCCLUDED | Quality.GLARE


@dataclass(frozen=True)
class CircleSearch:
    """What was found of a board of circles: `found` as for any board, and of each view its ellipses and their labels, by name."""

    found: BoardSearch
    detections: dict[str, Detections]
    labels: dict[str, Labels]


def find_circle_boards(
    photographs: Iterable[tuple[str, Gray]], pattern: Pattern, total: int = 0, progress: Progress | None = None
) -> CircleSearch:
    """Find a flat pattern in each photograph (name, gray), given one after the other.

    Raises InputError for a grid, a pattern that is not flat or photographs of different sizes, MeasurementError when no photograph shows
    the board.
    """
    if pattern.is_grid:
        raise InputError(
            f"the pattern {pattern.name!r} is a grid, and a calibration board is a chessboard, a ChArUco board or a plate of circles: "
            "photograph one of those"
        )
    if pattern.surface.kind != "plane" or np.ptp(pattern.center_mm[:, 2]) > 0:
        raise InputError(f"the pattern {pattern.name!r} is not flat; a calibration board is a plane")
    views: list[BoardView] = []
    rejected: dict[str, str] = {}
    detections: dict[str, Detections] = {}
    labels: dict[str, Labels] = {}
    first: tuple[str, tuple[int, int]] | None = None
    for done, (name, gray) in enumerate(photographs, start=1):
        shape = (gray.shape[0], gray.shape[1])
        first = first or (name, shape)
        check_same_size(first, name, shape)
        found = find_ellipses(gray)
        try:
            labels[name] = label_board(found, pattern, gray.shape[1], gray.shape[0])
            views.append(outline_view(name, pattern, found, labels[name]))
            detections[name] = found
        except IdentityError as error:
            rejected[name] = str(error)
        if progress:
            progress(done, max(total, done))
    if first is None:
        raise InputError("no photographs were given; at least 3 of the board are needed, better 10 to 20")
    if not views:
        raise MeasurementError(f"no photograph shows the board: {first[0]}: {rejected[first[0]]}")
    return CircleSearch(BoardSearch(tuple(views), first[1][1], first[1][0], rejected), detections, labels)


def outline_view(name: str, pattern: Pattern, detections: Detections, labels: Labels) -> BoardView:
    """The outlines of the labelled circles as a view."""
    marks = pattern.marks
    return BoardView(name, detections.center_px[labels.detection], marks.center_mm[labels.mark], marks.radius_mm[labels.mark])


def measured_views(
    photographs: Iterable[tuple[str, Gray]],
    pattern: Pattern,
    search: CircleSearch,
    calibration: Calibration,
    total: int = 0,
    progress: Progress | None = None,
) -> tuple[tuple[BoardView, ...], dict[str, str]]:
    """The same views with the targets' centres measured in the raw pixels; name and reason of those that cannot be.

    photographs: those of the search, in any order; calibration: from its outlines.
    """
    poses = dict(zip(calibration.view_names, calibration.poses, strict=True))
    views: list[BoardView] = []
    rejected: dict[str, str] = {}
    for done, (name, gray) in enumerate(photographs, start=1):
        if name in poses:
            labels = search.labels[name]
            identity = Identity(poses[name], labels.mark, labels.detection, np.zeros(len(labels.mark)), (), 0, ())
            try:
                views.append(_measured(name, gray, pattern, search.detections[name], identity, calibration))
            except MeasurementError as error:
                rejected[name] = str(error)
        if progress:
            progress(done, max(total, done))
    return tuple(views), rejected


def _measured(name: str, gray: Gray, pattern: Pattern, detections: Detections, identity: Identity, calibration: Calibration) -> BoardView:
    poses = measure_targets(gray, calibration.camera, pattern, detections, identity)
    good = (poses.quality & int(SPOILT)) == 0
    if good.sum() < FEWEST_CORNERS:
        raise MeasurementError(f"only {good.sum()} targets of the board can be measured; at least {FEWEST_CORNERS} are needed")
    place = {int(ident): center for ident, center in zip(pattern.ids, pattern.center_mm, strict=True)}
    return BoardView(name, poses.center_px[good], np.array([place[int(i)] for i in poses.ids[good]]))
