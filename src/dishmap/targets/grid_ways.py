"""The ways in which a walked lattice could lie on a grid: four quarter turns, and every shift.

A way is judged by what it makes of the nodes: one that falls beyond the grid, a mark where the grid has none, or none where it has
one, each counts as one contradiction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from dishmap.targets.grid_detect import GridDetections
from dishmap.targets.pattern import Pattern

Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

# Of a lattice (column, row): by a quarter turn from columns to rows.
QUARTER = np.array([[0, -1], [1, 0]])


@dataclass(frozen=True)
class Ways:
    """H ways to lay a lattice on a grid.

    quarter (H,): quarter turns; shift (H, 2): added to the turned lattice; off (H,): nodes beyond the grid; agree, contradict (H,): marks.
    """

    quarter: Ints
    shift: Ints
    off: Ints
    agree: Ints
    contradict: Ints

    def __len__(self) -> int:
        return len(self.quarter)

    @property
    def cost(self) -> Ints:
        """Contradictions (H,)."""
        return self.off + self.contradict

    def take(self, index: Ints | Flags) -> Ways:
        """The ways at `index`."""
        return Ways(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def lattice(self, way: int, lattice: NDArray[Any]) -> NDArray[Any]:
        """Where a way puts places (..., 2) of the lattice in the grid's."""
        return np.asarray(turned(lattice, int(self.quarter[way])) + self.shift[way])


@dataclass(frozen=True)
class MarkedLattice:
    """What is known at whole places (N, 2) of a lattice: which are nodes, and which of those that can be judged are marked.

    node (N, 2); judged, marked: places (J, 2) and (K, 2) where a mark would be seen and where one is, as `spot` of the node: its own
    place for squares, the middle of its cell, twice over to be whole, for crossings.
    """

    node: Ints
    judged: Ints
    marked: Ints


def turned(lattice: NDArray[Any], quarter: int) -> NDArray[Any]:
    """Lattice places (..., 2) after quarter turns."""
    return np.asarray(lattice @ np.linalg.matrix_power(QUARTER, quarter % 4).T)


def is_marked(pattern: Pattern) -> Flags:
    """Which targets (N,) of a grid are orientation marks: open squares, or crossings with ink of their own."""
    kinds = {n: any(not p.dark for p in k.polygons) or (bool(pattern.lines) and bool(k.polygons)) for n, k in pattern.kinds.items()}
    return np.array([kinds[name] for name in pattern.kind_names], dtype=bool)


def printed_lattice(pattern: Pattern) -> MarkedLattice:
    """What a grid prints."""
    assert pattern.lattice is not None
    # marks of crossings lie at the middle of the cell to the upper right: doubled, an odd place
    spot = 2 * pattern.lattice + (1 if pattern.lines else 0)
    return MarkedLattice(pattern.lattice, spot, spot[is_marked(pattern)])


def seen_lattice(found: GridDetections, component: int) -> MarkedLattice:
    """What a photograph shows of one component of a grid."""
    part = found.component == component
    lattice = found.lattice[part]
    if not found.lines:
        return MarkedLattice(lattice, 2 * lattice, 2 * lattice[found.marked[part]])
    known = set(map(tuple, lattice.tolist()))
    whole = [c for c in known if {(c[0] + 1, c[1]), (c[0], c[1] + 1), (c[0] + 1, c[1] + 1)} <= known]
    cells = found.cell_marked[found.cell_marked[:, 0] == component, 1:]
    return MarkedLattice(lattice, 2 * np.array(whole, dtype=np.int64).reshape(-1, 2) + 1, 2 * cells + 1)


def all_ways(seen: MarkedLattice, printed: MarkedLattice, mirrored: bool = False) -> Ways:
    """Every way that puts at least half of the seen nodes on printed ones; mirrored: for a lattice seen from behind."""
    parts = []
    flip = np.array([-1, 1]) if mirrored else np.array([1, 1])
    for quarter in range(4):
        node, judged, marked = (turned(flip * places, quarter) for places in (seen.node, seen.judged, seen.marked))
        origin, hits = _overlap(node, printed.node)
        # shifts of doubled places at every second of their own overlaps
        over = {
            name: _sample(_overlap(a, b), origin, hits.shape)
            for name, a, b in (
                ("both", marked, printed.marked),
                ("seen", marked, printed.judged),
                ("hidden", judged, printed.marked),
            )
        }
        shifts = np.argwhere(2 * hits >= len(seen.node))
        at = tuple(shifts.T)
        both = over["both"][at]
        contradict = (over["seen"][at] - both) + (over["hidden"][at] - both)
        parts.append(Ways(np.full(len(shifts), quarter), shifts + origin, len(seen.node) - hits[at], both, contradict))
    return Ways(*(np.concatenate([getattr(part, name) for part in parts]) for name in Ways.__dataclass_fields__))


def _overlap(a: Ints, b: Ints) -> tuple[Ints, Ints]:
    """How many places of `a` (N, 2), shifted, fall on places of `b` (M, 2): the first shift, and a table of counts from there on."""
    if not len(a) or not len(b):
        return np.zeros(2, dtype=np.int64), np.zeros((0, 0), dtype=np.int64)
    low_a, low_b = a.min(axis=0), b.min(axis=0)
    tables = []
    for places, low in ((a, low_a), (b, low_b)):
        table = np.zeros(places.max(axis=0) - low + 1)
        table[tuple((places - low).T)] = 1.0
        tables.append(table)
    counts = np.round(fftconvolve(tables[1], tables[0][::-1, ::-1])).astype(np.int64)
    return low_b - low_a - (np.array(tables[0].shape) - 1), counts


def _sample(overlap: tuple[Ints, Ints], origin: Ints, shape: tuple[int, ...]) -> Ints:
    """A table of doubled shifts at the whole shifts `origin` + (i, j); 0 beyond it."""
    start, counts = overlap
    out = np.zeros(shape, dtype=np.int64)
    index = 2 * (np.indices(shape) + origin[:, None, None]) - start[:, None, None]
    inside = ((index >= 0) & (index < np.array(counts.shape)[:, None, None])).all(axis=0)
    out[inside] = counts[index[0][inside], index[1][inside]]
    return out
