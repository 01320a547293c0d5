"""Walk a lattice: give each node its column and row, by cells of four nodes first and by prediction from there.

Nodes linked into cells are numbered breadth first, starting where cells are densest. Where the numbers of two ways round do not agree, or a
node lies off the local map of its neighbours, it is dropped. What remains grows over gaps: the local map predicts each
place around, and a node is taken there only if it lies there, unlike any other. A wrong number is worse than a missing node.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, maximum_filter
from scipy.spatial import cKDTree

from dishmap.targets.grid_links import Links, find_cells, find_links
from dishmap.targets.grid_map import local_map
from dishmap.targets.grid_nodes import Nodes

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

# A component needs so many nodes: a three by three lattice.
FEWEST_NODES = 9
# Places up to so many columns and rows from known nodes are predicted; a prediction must be this sure (sigma in steps).
BRIDGE, SURE = 3, 0.12
# A node is taken within this distance of its predicted place, in steps (and sigmas of the prediction), if the next one is this much
# farther away and its axes are turned by less than this (tangent).
NEAREST, NEAREST_SIGMAS, CLEAR, LARGEST_TURN = 0.1, 2.5, 0.3, 0.5
# A node farther off the local map of its neighbours than this, in steps (and sigmas), is dropped.
LARGEST_MISFIT, MISFIT_SIGMAS = 0.12, 4.0
ROUNDS, RENUMBERINGS = 60, 12
# Squares have the same size in steps to this ratio.
SAME_SIZE = 1.35


@dataclass(frozen=True)
class Walked:
    """One component of a lattice: node (K,) indices into the nodes, lattice (K, 2) columns and rows from 0."""

    node: Ints
    lattice: Ints


def walk(nodes: Nodes, sized: bool) -> list[Walked]:
    """Components of a lattice among nodes, the largest first; each is one walk that prediction could not join to the others."""
    links = find_links(nodes, sized)
    good = find_cells(links)
    links = Links(np.where(good, links.neighbour, -1), links.turn)
    free = np.ones(len(nodes), dtype=bool)
    components: list[Walked] = []
    for seed in sorted(_sound(nodes.place_px, links), key=lambda seed: -len(seed.node)):
        kept = free[seed.node]
        start = Walked(seed.node[kept], seed.lattice[kept])
        if len(start.node) < FEWEST_NODES:
            continue
        grown = _grown(nodes, start, free)
        if sized:
            grown = _of_one_size(nodes, grown)
        if len(grown.node) >= FEWEST_NODES:
            components.append(grown)
            free[grown.node] = False
    return sorted(components, key=lambda c: -len(c.node))


def _sound(place_px: Array, links: Links) -> list[Walked]:
    """Numbered components in which all ways agree.

    A link over a missing node puts all beyond it one off. Where it is, nodes are off the local map: without them, all are numbered
    again. Only where two ways still disagree are the nodes themselves dropped on which they do.
    """
    for _ in range(RENUMBERINGS):
        walks, doubtful = _numbered(links)
        kept = [without_misfits(place_px, walked) for walked in walks if len(walked.node) >= FEWEST_NODES]
        alive = np.zeros(len(place_px), dtype=bool)
        alive[np.concatenate([k.node for k in kept] + [np.zeros(0, dtype=np.int64)])] = True
        lost = sum(len(walked.node) for walked in walks if len(walked.node) >= FEWEST_NODES) - int(alive.sum())
        if not lost and not doubtful:
            return kept
        if not lost:
            alive[list(doubtful)] = False
        bad = ~alive[:, None] | ~alive[links.neighbour]
        links = Links(np.where(bad, -1, links.neighbour), links.turn)
    return []


def _numbered(links: Links) -> tuple[list[Walked], set[int]]:
    """Columns and rows of all nodes that links join, breadth first; and the nodes on which two ways disagree."""
    neighbour, turn = links.neighbour.tolist(), links.turn.tolist()
    degree = (links.neighbour >= 0).sum(axis=1)
    place: dict[int, tuple[int, int]] = {}
    frame: dict[int, int] = {}
    walks: list[Walked] = []
    doubtful: set[int] = set()
    ways = ((1, 0), (0, 1), (-1, 0), (0, -1))
    for first in np.argsort(-degree, kind="stable").tolist():
        if first in place or degree[first] == 0:
            continue
        place[first], frame[first] = (0, 0), 0
        queue, members = deque([first]), [first]
        taken = {(0, 0): first}
        while queue:
            i = queue.popleft()
            for side in range(4):
                j = neighbour[i][side]
                if j < 0:
                    continue
                way = ways[(side + frame[i]) % 4]
                at = (place[i][0] + way[0], place[i][1] + way[1])
                if j in place:
                    doubtful |= {i, j} if place[j] != at else set()
                elif at in taken:
                    doubtful |= {i, j, taken[at]}
                else:
                    place[j], frame[j], taken[at] = at, (frame[i] + turn[i][side]) % 4, j
                    queue.append(j)
                    members.append(j)
        walks.append(Walked(np.array(members, dtype=np.int64), np.array([place[m] for m in members], dtype=np.int64).reshape(-1, 2)))
    return walks, doubtful


def _grown(nodes: Nodes, start: Walked, free: Flags) -> Walked:
    """The walk without misfits, and with the nodes that it predicts."""
    current = without_misfits(nodes.place_px, start)
    for _ in range(ROUNDS):
        if len(current.node) < FEWEST_NODES:
            break
        new = _predicted(nodes, current, free)
        if not len(new.node):
            break
        joined = Walked(np.concatenate([current.node, new.node]), np.concatenate([current.lattice, new.lattice]))
        checked = without_misfits(nodes.place_px, joined)
        if len(checked.node) <= len(current.node):
            break
        current = checked
    return current


def _of_one_size(nodes: Nodes, walked: Walked) -> Walked:
    """The walk without squares of another size: figures and other things that happen to stand in line with the lattice."""
    if len(walked.node) < FEWEST_NODES:
        return walked
    table, low = table_of(nodes.place_px[walked.node], walked.lattice, 0)
    steps = local_map(table, walked.lattice - low, itself=True).step_px
    # half sides in steps, the one along columns first
    size = np.abs(np.linalg.solve(steps, np.swapaxes(nodes.axes[walked.node], 1, 2))).max(axis=2)
    same = (np.abs(np.log(size / np.median(size, axis=0))) < np.log(SAME_SIZE)).all(axis=1)
    return without_misfits(nodes.place_px, Walked(walked.node[same], walked.lattice[same]))


def table_of(place_px: Array, lattice: Ints, margin: int) -> tuple[Array, Ints]:
    """Places by column and row (C, R, 2), NaN where none is, with a margin around; and the lattice place of its first cell."""
    low = lattice.min(axis=0) - margin
    size = lattice.max(axis=0) + margin + 1 - low
    table = np.full((*size, 2), np.nan)
    table[lattice[:, 0] - low[0], lattice[:, 1] - low[1]] = place_px
    return table, low


def empty_places(table: Array, reach: int) -> Ints:
    """Empty cells (T, 2) of a table of places within `reach` columns and rows of a known one."""
    known = np.isfinite(table[..., 0])
    near = binary_dilation(known, np.ones((2 * reach + 1,) * 2, dtype=bool))
    return np.argwhere(near & ~known)


def _predicted(nodes: Nodes, current: Walked, free: Flags) -> Walked:
    """Free nodes that lie, unlike any other, where the local map predicts one."""
    left = free.copy()
    left[current.node] = False
    candidates = np.flatnonzero(left)
    nothing = Walked(np.zeros(0, dtype=np.int64), np.zeros((0, 2), dtype=np.int64))
    if not len(candidates):
        return nothing
    table, low = table_of(nodes.place_px[current.node], current.lattice, BRIDGE)
    at = empty_places(table, BRIDGE)
    there = local_map(table, at)
    sure = there.sigma < SURE
    at, there = at[sure], there.take(sure)
    if not len(at):
        return nothing
    tree = cKDTree(nodes.place_px[candidates])
    _, near = tree.query(there.place_px, k=min(4, len(candidates)))
    near = near.reshape(len(at), -1)
    offsets = np.stack([np.linalg.norm(there.offset(nodes.place_px[candidates[near[:, k]]]), axis=1) for k in range(near.shape[1])], axis=1)
    offsets = np.nan_to_num(offsets, nan=np.inf)
    order = np.argsort(offsets, axis=1)
    rows = np.arange(len(at))
    chosen = candidates[near[rows, order[:, 0]]]
    best = offsets[rows, order[:, 0]]
    second = offsets[rows, order[:, 1]] if offsets.shape[1] > 1 else np.full(len(at), np.inf)
    good = (best < NEAREST + NEAREST_SIGMAS * there.sigma) & (second > best + CLEAR) & along_lattice(nodes.axes[chosen], there.step_px)
    at, chosen, best = at[good], chosen[good], best[good]
    # a node that two places claim belongs to neither
    _, inverse, counts = np.unique(chosen, return_inverse=True, return_counts=True)
    single = counts[inverse] == 1
    return Walked(chosen[single], at[single] + low)


def along_lattice(axes: Array, step_px: Array) -> Flags:
    """Whether axes (T, 2, 2) run along the steps (T, 2, 2) of a lattice, in any quarter turn."""
    determinant = np.linalg.det(step_px)
    sound = np.abs(determinant) > 1e-9
    steps = np.where(sound[:, None, None], step_px, np.eye(2))
    inside = np.linalg.solve(steps, np.swapaxes(axes, 1, 2))
    small, large = np.sort(np.abs(inside), axis=1).transpose(1, 0, 2)
    # one axis along columns, the other along rows
    apart = np.argmax(np.abs(inside), axis=1)
    return np.asarray(sound & (small < LARGEST_TURN * large).all(axis=1) & (apart[:, 0] != apart[:, 1]))


def without_misfits(place_px: Array, walked: Walked) -> Walked:
    """The walk without nodes that lie off the local map of their neighbours, the worst of each neighbourhood first.

    place_px (M, 2): of all nodes. Nodes that lose the neighbours which would confirm them go too.
    """
    node, lattice = walked.node, walked.lattice
    while len(node) >= FEWEST_NODES:
        table, low = table_of(place_px[node], lattice, 0)
        there = local_map(table, lattice - low)
        off = np.linalg.norm(there.offset(place_px[node]), axis=1)
        bad = (off > LARGEST_MISFIT + MISFIT_SIGMAS * there.sigma) | (there.sigma > 3 * SURE) | ~np.isfinite(off)
        if not bad.any():
            break
        score = np.where(bad, np.nan_to_num(off / (LARGEST_MISFIT + there.sigma), nan=np.inf), 0.0)
        worst = score >= _largest_around(score, lattice - low)
        node, lattice = node[~(bad & worst)], lattice[~(bad & worst)]
    return Walked(node, lattice)


def _largest_around(score: Array, at: Ints) -> Array:
    """Largest score among a node and its eight neighbours."""
    table = np.zeros(at.max(axis=0) + 1)
    table[at[:, 0], at[:, 1]] = score
    return np.asarray(maximum_filter(table, size=3)[at[:, 0], at[:, 1]])
