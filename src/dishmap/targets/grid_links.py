"""Neighbours on a lattice: which node is the next one along each axis of a node, and the cells that four such links close.

Each node has its own two axes, in any of four quarter turns. Its neighbour along an axis is the nearest node that lies in that
direction and has much the same axes; both must choose each other. Links count only as sides of cells of four nodes, so a
stray node, or a row of figures beside the grid, joins nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.targets.grid_nodes import Nodes

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

NEIGHBOURS = 24
# A neighbour lies within this slope of an axis, and its axes differ from the node's by no more than these parts of them.
LARGEST_SLOPE, LARGEST_TURN, LARGEST_RATIO = 0.4, 0.5, 2.2
# Steps in units of squares' sides agree to this ratio over the picture; successive steps between crossings to the other.
SAME_STEP, NEXT_STEP = 1.35, 1.6


@dataclass(frozen=True)
class Links:
    """Neighbours along the axes of M nodes.

    neighbour (M, 4): the node next in directions +first, +second, -first, -second axis, or -1; turn (M, 4): by how many
    quarter turns that node's axes are turned against the node's own.
    """

    neighbour: Ints
    turn: Ints

    def without(self, bad: Flags) -> Links:
        """The links without those that are bad (M, 4), from both sides."""
        neighbour = self.neighbour.copy()
        node, side = np.nonzero(bad & (neighbour >= 0))
        other = neighbour[node, side]
        neighbour[other, (side + 2 - self.turn[node, side]) % 4] = -1
        neighbour[node, side] = -1
        return Links(neighbour, self.turn)


def find_links(nodes: Nodes, sized: bool) -> Links:
    """Links of nodes; sized: the axes have the size of what was printed, so that steps can be compared over the picture."""
    count = len(nodes)
    none = np.full((count, 4), -1)
    if count < 4:
        return Links(none, np.zeros((count, 4), dtype=np.int64))
    _, near = cKDTree(nodes.place_px).query(nodes.place_px, k=min(NEIGHBOURS + 1, count))
    near = near[:, 1:]
    # of a node's axes as columns: offsets and axes of its neighbours in them
    inverse = np.linalg.inv(np.swapaxes(nodes.axes, 1, 2))
    offset = np.einsum("nij,nkj->nki", inverse, nodes.place_px[near] - nodes.place_px[:, None])
    theirs = inverse[:, None] @ np.swapaxes(nodes.axes[near], 2, 3)
    turn, alike = _turns(theirs)
    picked, steps, turns = none.copy(), np.full((count, 4), np.nan), np.zeros((count, 4), dtype=np.int64)
    rows = np.arange(count)
    for side in range(4):
        sign = 1.0 if side < 2 else -1.0
        along, across = sign * offset[..., side % 2], np.abs(offset[..., 1 - side % 2])
        distance = np.where(alike & (along > 0) & (across < LARGEST_SLOPE * along), along, np.inf)
        best = np.argmin(distance, axis=1)
        found = np.isfinite(distance[rows, best])
        picked[found, side] = near[found, best[found]]
        steps[:, side], turns[:, side] = distance[rows, best], turn[rows, best]
    back = (np.arange(4) + 2 - turns) % 4
    mutual = (picked >= 0) & (picked[picked, back] == rows[:, None])
    links = Links(np.where(mutual, picked, -1), turns)
    return links.without(_odd_steps(links, np.where(mutual, steps, np.nan), back, sized))


def _turns(theirs: Array) -> tuple[Ints, Flags]:
    """Quarter turns (...) of axes (..., 2, 2), given as columns in a node's own axes, and whether that leaves them much alike."""
    first = np.stack([theirs[..., 0, 0], theirs[..., 1, 0], -theirs[..., 0, 0], -theirs[..., 1, 0]], axis=-1)
    turn = np.argmax(first, axis=-1)
    odd = turn % 2 == 1
    same = np.where(odd, theirs[..., 1, 0], theirs[..., 0, 0]), np.where(odd, -theirs[..., 0, 1], theirs[..., 1, 1])
    other = np.where(odd, theirs[..., 0, 0], theirs[..., 1, 0]), np.where(odd, theirs[..., 1, 1], theirs[..., 0, 1])
    sign = np.where(turn >= 2, -1.0, 1.0)
    a, b = same[0] * sign, same[1] * sign
    alike = (np.minimum(a, b) > 1 / LARGEST_RATIO) & (np.maximum(a, b) < LARGEST_RATIO)
    alike &= (np.abs(other[0]) < LARGEST_TURN * a) & (np.abs(other[1]) < LARGEST_TURN * b)
    return turn, alike


def _odd_steps(links: Links, steps: Array, back: Ints, sized: bool) -> Flags:
    """Links (M, 4) whose steps do not go with the others': across a missing node, or to a stray one."""
    if not np.isfinite(steps).any():
        return np.zeros(steps.shape, dtype=bool)
    with np.errstate(invalid="ignore"):
        if sized:
            mean = np.sqrt(steps * steps[links.neighbour, back])
            return np.asarray(np.abs(np.log(mean / np.nanmedian(mean))) > np.log(SAME_STEP))
        before = steps[:, [2, 3, 0, 1]]
        return np.asarray(steps > NEXT_STEP * before)


def find_cells(links: Links) -> Flags:
    """Links (M, 4) that are sides of a cell of four nodes."""
    neighbour, turn = links.neighbour, links.turn
    good = np.zeros(neighbour.shape, dtype=bool)
    for side in range(4):
        left = (side + 1) % 4
        a, b = neighbour[:, side], neighbour[:, left]
        a_side, b_side = (left - turn[:, side]) % 4, (side - turn[:, left]) % 4
        over, other = neighbour[a, a_side], neighbour[b, b_side]
        whole = np.flatnonzero((a >= 0) & (b >= 0) & (over >= 0) & (over == other))
        good[whole, side] = good[whole, left] = True
        for node, way in ((a[whole], a_side[whole]), (b[whole], b_side[whole])):
            good[node, way] = True
            end, back = neighbour[node, way], (way + 2 - turn[node, way]) % 4
            good[end, back] = True
        for node, way in ((a[whole], (side + 2 - turn[whole, side]) % 4), (b[whole], (left + 2 - turn[whole, left]) % 4)):
            good[node, way] = True
    return good & (neighbour >= 0)
