"""Find a grid in a photograph: its squares or the crossings of its lines, numbered by column and row of a lattice.

The numbers are those of a walk: right up to a shift and a quarter turn, which `grid_identify` finds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.errors import IdentityError, ImageError
from dishmap.targets.grid_crossings import Level, find_crossings, levels_of
from dishmap.targets.grid_map import LocalMap, local_map
from dishmap.targets.grid_mistaken import LINES, SQUARES, fine_period_px, kind_of
from dishmap.targets.grid_nodes import Nodes
from dishmap.targets.grid_refine import filled_cells, refine_crossings
from dishmap.targets.grid_skips import unskipped
from dishmap.targets.grid_squares import find_squares, open_squares
from dishmap.targets.grid_walk import FEWEST_NODES, SURE, Walked, empty_places, table_of, walk, without_misfits

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

# Lines are searched at a reduction that leaves no more than this many pixels, and at half of it where steps between crossings are
# below so many pixels there.
FINEST_PX, FINE_STEP_PX = 1_500_000, 7.5
LEAST_STEP_PX = 5.0
COARSER = "go nearer, take a longer lens, or print a coarser grid"
# Crossings that were not seen as such are looked for at predicted places, so many rows of them, up to this distance from known ones
# and with at least this many arms of ink; refined ones lie within this part of a step of the prediction.
LOOKS, LOOK_REACH, LOOK_ARMS, LOOK_OFF = 8, 2, 3, 0.15


@dataclass(frozen=True)
class GridDetections:
    """Nodes of a lattice found in an image; (0, 0) is the centre of the top-left pixel.

    place_px (M, 2): crossings, or middles of squares, to some tenths of a pixel; lattice (M, 2): column and row of each in a frame of
    its component's own (right-handed: det[d px/d column, d px/d row] < 0; origin and quarter turn are arbitrary); component (M,), the
    largest is 0; step_px (M, 2, 2): columns are d place / d column and d place / d row; marked (M,): an open square, or a crossing
    whose cell towards (+column, +row) in that frame is filled; cell_marked (K, 3): component, column and row of the lower corner of
    each filled cell, whatever the frame's turn (none for squares); lines: whether these are crossings of lines.
    """

    place_px: Array
    lattice: Ints
    component: Ints
    step_px: Array
    marked: Flags
    cell_marked: Ints
    lines: bool

    def __len__(self) -> int:
        return len(self.place_px)


def find_grid(image: NDArray[Any], lines: bool) -> GridDetections:
    """Find the nodes of a grid of dark squares, or of dark lines, on light ground.

    image: (H, W) uint8 or uint16. Raises ImageError when it is not such an array, and IdentityError when it shows no lattice of at least
    three by three nodes.
    """
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16) or not image.size:
        raise ImageError(
            f"a grid is searched in a grey image (H, W) of uint8 or uint16, not in {image.dtype} {image.shape}; convert it first"
        )
    return _lines(image) if lines else _squares(image)


def _squares(image: NDArray[Any]) -> GridDetections:
    nodes = find_squares(image)
    components = walk(nodes, sized=True)
    if not components:
        other, levels, _ = _crossings(image)
        kind = kind_of(levels[0], table_of(other[0].place_px, other[0].lattice, 0)[0]) if other else SQUARES
        if kind != SQUARES:
            raise IdentityError(f"the photograph shows {kind}, and the pattern is one of squares; give the pattern that was photographed")
        raise _nothing(image, f"{len(nodes)} dark squares", "square")
    parts = []
    for c in components:
        squares = nodes.take(c.node)
        table, low = table_of(squares.place_px, c.lattice, 0)
        step_px = local_map(table, c.lattice - low, itself=True).step_px
        parts.append(_Part(squares.place_px, c.lattice, open_squares(image, squares, step_px), np.zeros((0, 2), dtype=np.int64)))
    return _detections(parts, lines=False)


def _nothing(image: NDArray[Any], found: str, what: str) -> IdentityError:
    """What was found that is no grid, and what to do."""
    period = fine_period_px(image)
    if period:
        return IdentityError(f"the photograph shows something with a period of {period:.1f} px, too fine to be measured; {COARSER}")
    return IdentityError(
        f"{found} were found, but no lattice of three by three or more; check that this is the photograph of the grid, that it is "
        f"sharp, and that more than two rows of it are in view, each {what} several pixels from the next"
    )


@dataclass(frozen=True)
class _Part:
    """One component: places (K, 2), lattice (K, 2), marked (K,), and lower corners of filled cells (F, 2)."""

    place_px: Array
    lattice: Ints
    marked: Flags
    filled: Ints


def _detections(parts: list[_Part], lines: bool) -> GridDetections:
    steps = []
    for part in parts:
        table, low = table_of(part.place_px, part.lattice, 0)
        steps.append(local_map(table, part.lattice - low, itself=True).step_px)
    cells = [np.column_stack([np.full(len(p.filled), i), p.filled]) for i, p in enumerate(parts)]
    return GridDetections(
        np.concatenate([p.place_px for p in parts]),
        np.concatenate([p.lattice for p in parts]),
        np.concatenate([np.full(len(p.lattice), i) for i, p in enumerate(parts)]),
        np.concatenate(steps),
        np.concatenate([p.marked for p in parts]),
        np.concatenate(cells).reshape(-1, 3).astype(np.int64),
        lines,
    )


def _lines(image: NDArray[Any]) -> GridDetections:
    """Crossings of lines that are lines."""
    parts, levels, candidates = _crossings(image)
    if not parts:
        raise _nothing(image, f"{candidates} places that look like crossings of dark lines", "crossing")
    kind = kind_of(levels[0], table_of(parts[0].place_px, parts[0].lattice, 0)[0])
    if kind != LINES:
        raise IdentityError(f"the photograph shows {kind}, and the pattern is a grid of lines; give the pattern that was photographed")
    found = _detections(parts, lines=True)
    step = float(np.median(np.linalg.norm(found.step_px[found.component == 0], axis=1).min(axis=1)))
    if step < LEAST_STEP_PX:
        raise IdentityError(f"the grid's lines are {step:.1f} px apart, and {LEAST_STEP_PX:.0f} are needed; {COARSER}")
    return found


def _crossings(image: NDArray[Any]) -> tuple[list[_Part], list[Level], int]:
    """Components of crossings, searched at the reduction that is fine enough for them; its levels; and how many candidates there were."""
    finest = 1
    while image.size > FINEST_PX * finest**2:
        finest *= 2
    while True:
        levels = levels_of(image, finest)
        nodes, reduction = find_crossings(levels)
        components = walk(nodes, sized=False)
        if finest == 1 or (components and _smallest_step(nodes, components[0]) > FINE_STEP_PX * finest):
            break
        finest //= 2
    parts = [_completed(levels, nodes, reduction, c) for c in components]
    parts = sorted((p for p in parts if len(p.place_px) >= FEWEST_NODES), key=lambda p: -len(p.place_px))
    return parts, levels, len(nodes)


def _smallest_step(nodes: Nodes, walked: Walked) -> float:
    """The fifth percentile of the shorter step at the nodes of a walk, px."""
    table, low = table_of(nodes.place_px[walked.node], walked.lattice, 0)
    steps = local_map(table, walked.lattice - low, itself=True).step_px
    return float(np.percentile(np.linalg.norm(steps, axis=1).min(axis=1), 5))


def _completed(levels: list[Level], nodes: Nodes, reduction: Ints, walked: Walked) -> _Part:
    """A component with its crossings refined, and with those that were not seen at first but show ink where they are predicted."""
    place, lattice, size = nodes.place_px[walked.node], walked.lattice, reduction[walked.node]
    place, lattice, size = _refined(levels, place, lattice, size)
    for _ in range(LOOKS):
        if len(place) < FEWEST_NODES:
            break
        table, low = table_of(place, lattice, LOOK_REACH)
        at = empty_places(table, LOOK_REACH)
        there = local_map(table, at)
        sure = there.sigma < SURE
        at, there = at[sure], there.take(sure)
        if not len(at):
            break
        near = size[cKDTree(place).query(there.place_px)[1]]
        seen, arms = refine_crossings(levels, near, there)
        good = (arms.sum(axis=1) >= LOOK_ARMS) & (np.linalg.norm(np.nan_to_num(there.offset(seen), nan=np.inf), axis=1) < LOOK_OFF)
        if not good.any():
            break
        count = len(place)
        place, lattice, size = (np.concatenate(pair) for pair in ((place, seen[good]), (lattice, at[good] + low), (size, near[good])))
        sound = without_misfits(place, Walked(np.arange(len(place)), lattice)).node
        place, lattice, size = place[sound], lattice[sound], size[sound]
        if len(place) <= count:
            break
    if len(place) >= FEWEST_NODES:
        joined = unskipped(levels, size, place, lattice)
        place, lattice = place[joined], lattice[joined]
    if len(place) < FEWEST_NODES:
        return _Part(place, lattice, np.zeros(len(place), dtype=bool), np.zeros((0, 2), dtype=np.int64))
    table, low = table_of(place, lattice, 0)
    filled = filled_cells(levels[0], table) + low
    marked = (lattice[:, None] == filled[None]).all(axis=2).any(axis=1)
    return _Part(place, lattice, marked, filled)


def _refined(levels: list[Level], place: Array, lattice: Ints, size: Ints) -> tuple[Array, Ints, Ints]:
    """Crossings where ink of both lines is seen, to a fraction of a pixel, that go with their neighbours."""
    table, low = table_of(place, lattice, 0)
    there = local_map(table, lattice - low, itself=True)
    there = LocalMap(place, there.step_px, there.bend_px, there.sigma)
    refined, _ = refine_crossings(levels, size, there)
    off = np.linalg.norm(np.nan_to_num(there.offset(refined), nan=np.inf), axis=1)
    kept = np.flatnonzero(off < LOOK_OFF)
    sound = without_misfits(refined, Walked(kept, lattice[kept])).node
    return refined[sound], lattice[sound], size[sound]
