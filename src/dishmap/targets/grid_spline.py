"""Smooth maps over a lattice: tensor products of uniform cubic B-splines, taken cell by cell.

Over one cell of knots the map is a polynomial of its 4 x 4 control points, so every term of a least-squares problem belongs to one cell
and its normal matrix is made of cells' 48 x 48 blocks (three coordinates), as in finite elements.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from dishmap.targets.grid_blocks import Blocks

Array = NDArray[Any]
Index = NDArray[np.int64]

# Rows: control points of a cell; columns: powers of the place in the cell, 0 to 1 (de Boor, A Practical Guide to Splines, X).
BASIS = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6
# Control points that a row of cells touches along one direction, and the rows of control points in a block of the normal matrix.
REACH = 4
BLOCK_ROWS = REACH - 1
# Unknowns of a cell.
CELL = 3 * REACH * REACH
# Gauss's points of a cell along each direction.
GAUSS = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3)
FIRST, SECOND, THIRD = ((1, 0), (0, 1)), ((2, 0), (1, 1), (0, 2)), ((3, 0), (2, 1), (1, 2), (0, 3))


@dataclass(frozen=True)
class Spline:
    """The layout of a tensor spline: `count` cells along both directions, `knot` lattice steps wide, the first from `low` (2,) on."""

    low: Array
    knot: float
    count: tuple[int, int]

    @property
    def shape(self) -> tuple[int, int]:
        """Control points along both directions."""
        return self.count[0] + BLOCK_ROWS, self.count[1] + BLOCK_ROWS

    @property
    def cells(self) -> int:
        """Number of cells."""
        return self.count[0] * self.count[1]

    def cell_of(self, lattice: Array) -> Index:
        """Number (P,) of the cell that holds each place (P, 2), the nearest one outside."""
        place = np.clip(np.floor((lattice - self.low) / self.knot).astype(np.int64), 0, np.array(self.count) - 1)
        return np.asarray(place[:, 0] * self.count[1] + place[:, 1])

    def corner(self, cell: Index) -> Array:
        """Where cells (P,) begin (P, 2), in lattice coordinates."""
        return self.low + self.knot * np.stack(np.divmod(cell, self.count[1]), axis=-1)

    def weights(self, cell: Index, lattice: Array, by: tuple[int, int]) -> Array:
        """Weights (P, ..., 16) of the cell's control points in the derivative `by` (times along each direction) at places (P, ..., 2).

        Places may lie a little outside their cell (P,): its polynomial goes on.
        """
        corner = self.corner(cell).reshape(len(cell), *(1,) * (lattice.ndim - 2), 2)
        t = (lattice - corner) / self.knot
        one, other = (_basis(t[..., k], by[k]) / self.knot ** by[k] for k in range(2))
        return (one[..., :, None] * other[..., None, :]).reshape(*t.shape[:-1], REACH * REACH)

    def same_in_all(self, place: Array, by: tuple[tuple[int, int], ...]) -> Array:
        """Weights (len(by), Q, 16) of derivatives at places (Q, 2) within a cell, 0 to 1: the same in every cell."""
        first = np.zeros(len(place), dtype=np.int64)
        at = self.corner(first) + self.knot * place
        return np.stack([self.weights(first, at, d) for d in by])

    @cached_property
    def at_gauss(self) -> Array:
        """Weights (2, 4, 16) of both first derivatives at Gauss's points of any cell."""
        return self.same_in_all(gauss_points(), FIRST)

    @cached_property
    def at_middle(self) -> tuple[Array, Array]:
        """Weights (2, 16) of the first and (4, 16) of the third derivatives in the middle of any cell."""
        middle = np.full((1, 2), 0.5)
        return self.same_in_all(middle, FIRST)[:, 0], self.same_in_all(middle, THIRD)[:, 0]

    @cached_property
    def controls(self) -> Index:
        """Control points (cells, 16) of every cell."""
        i, j = np.divmod(np.arange(self.cells), self.count[1])
        along, across = np.divmod(np.arange(REACH * REACH), REACH)
        return (i[:, None] + along) * self.shape[1] + j[:, None] + across

    @cached_property
    def _homes(self) -> tuple[Index, Index, Index, int, int]:
        """Where a cell's 48 x 48 entries go: in the diagonal blocks, in the blocks below (or one past the end), and the layout."""
        size = BLOCK_ROWS * self.shape[1] * 3
        blocks = -(-self.shape[0] // BLOCK_ROWS)
        unknown = (3 * self.controls[:, :, None] + np.arange(3)).reshape(self.cells, CELL)
        block, place = np.divmod(unknown, size)
        row, column = block[:, :, None], block[:, None, :]
        flat = place[:, :, None] * size + place[:, None, :]
        inside = np.where(row == column, row * size * size + flat, blocks * size * size)
        below = np.where(row == column + 1, column * size * size + flat, (blocks - 1) * size * size)
        return unknown, inside.ravel(), below.ravel(), size, blocks

    @property
    def unknowns(self) -> int:
        """Rows of the normal matrix: three a control point, filled up to whole blocks."""
        _, _, _, size, blocks = self._homes
        return size * blocks

    def grouped(self, cell: Index) -> Index:
        """Rows (cells, most) of what lies in each cell, given the cell (N,) of each; filled up with N, one past the last."""
        order = np.argsort(cell, kind="stable")
        count = np.bincount(cell, minlength=self.cells)
        out = np.full((self.cells, max(int(count.max()), 1)), len(cell))
        place = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
        out[cell[order], place] = order
        return out

    @cached_property
    def _gathering(self) -> csr_array:
        """The sum over cells of what stands for each unknown (unknowns, cells * 48)."""
        home = self._homes[0].ravel()
        return csr_array((np.ones(len(home)), (home, np.arange(len(home)))), shape=(self.unknowns, len(home)))

    def assembled(self, cells: Array, ridge: float) -> Blocks:
        """The normal matrix from those of all cells (cells, 48, 48), with `ridge` on its diagonal (1 where no control point is)."""
        _, inside, below, size, blocks = self._homes
        whole = np.bincount(inside, cells.ravel(), blocks * size * size + 1)[:-1].reshape(blocks, size, size)
        under = np.bincount(below, cells.ravel(), (blocks - 1) * size * size + 1)[:-1].reshape(blocks - 1, size, size)
        extra = np.full(size * blocks, ridge)
        extra[3 * self.shape[0] * self.shape[1] :] = 1.0
        whole[:, range(size), range(size)] += extra.reshape(blocks, size)
        return Blocks(whole, under)

    def gathered(self, cells: Array) -> Array:
        """Right-hand sides (unknowns, K) from those of all cells (cells, 48, K)."""
        return np.asarray(self._gathering @ cells.reshape(-1, cells.shape[-1]))

    def of_cells(self, vector: Array) -> Array:
        """What vectors (unknowns, ...) hold for each cell (cells, 48, ...)."""
        return np.asarray(vector[self._homes[0]])

    def control_points(self, vector: Array) -> Array:
        """Control points (shape[0] * shape[1], 3) of a vector (unknowns,)."""
        return np.asarray(vector[: 3 * self.shape[0] * self.shape[1]].reshape(-1, 3))

    @cached_property
    def _places(self) -> Index:
        """Where a cell's 48 x 48 entries lie in a matrix's diagonal blocks and those below, one after the other (cells, 48, 48)."""
        unknown, _, _, size, blocks = self._homes
        block, place = np.divmod(unknown, size)
        row, column = block[:, :, None], block[:, None, :]
        i, j = place[:, :, None], place[:, None, :]
        # above the diagonal the block below it is read the other way
        below = blocks * size * size + np.minimum(row, column) * size * size + np.where(row > column, i * size + j, j * size + i)
        return np.asarray(np.where(row == column, row * size * size + i * size + j, below))

    def inverse_of_cells(self, inverse: Blocks) -> Array:
        """Covariances (cells, 48, 48) of the unknowns of each cell from the inverse of a normal matrix."""
        return np.concatenate([inverse.diagonal.ravel(), inverse.below.ravel()])[self._places]


def _basis(t: Array, by: int) -> Array:
    """Weights (..., 4) of the control points in the derivative `by` at places (...) within the cell."""
    power = np.arange(4)
    factor, rest = np.ones(4), power.astype(float)
    for k in range(by):
        factor *= np.maximum(power - k, 0)
        rest = np.maximum(rest - 1, 0)
    return np.asarray((factor * t[..., None] ** rest) @ BASIS.T)


def gauss_points() -> Array:
    """Gauss's points (4, 2) of the unit square."""
    return np.stack(np.meshgrid(GAUSS, GAUSS), axis=-1).reshape(-1, 2)


def fit_spline(spline: Spline, lattice: Array, values: Array, weight: Array, smooth: float) -> Array:
    """Control points (K, D) of the smoothest spline near values (N, D) at places (N, 2).

    weight (N,) of each value; `smooth` of the integral of squared second derivatives over the lattice.
    """
    cell = spline.cell_of(lattice)
    rows, mine = spline.weights(cell, lattice, (0, 0)), spline.controls[cell]
    bend = spline.same_in_all(gauss_points(), SECOND) * np.sqrt([1.0, 2.0, 1.0])[:, None, None]
    bend = bend.reshape(-1, REACH * REACH)
    count = spline.shape[0] * spline.shape[1]
    matrix, right = np.zeros((count, count)), np.empty((count, values.shape[1]))
    every = spline.controls
    np.add.at(matrix, (every[:, :, None], every[:, None, :]), smooth * spline.knot**2 / 4 * (bend.T @ bend))
    home = (mine[:, :, None] * count + mine[:, None, :]).ravel()
    matrix += np.bincount(home, ((weight[:, None] * rows)[:, :, None] * rows[:, None, :]).ravel(), count * count).reshape(count, count)
    for k in range(values.shape[1]):
        right[:, k] = np.bincount(mine.ravel(), ((weight * values[:, k])[:, None] * rows).ravel(), count)
    matrix[range(count), range(count)] += 1e-12 * np.trace(matrix) / count
    return np.asarray(np.linalg.solve(matrix, right))


def spline_over(lattice: Array, most_cells: int) -> Spline:
    """The layout over nodes (N, 2): nodes in the middles of cells, which are whole steps wide, `most_cells` at most along a side.

    The first direction is given the rows of the normal matrix, so the caller lets it be the longer one for speed.
    """
    low, high = lattice.min(axis=0), lattice.max(axis=0)
    steps = high - low + 1
    knot = float(max(1, np.ceil(steps.max() / most_cells)))
    count = np.ceil(steps / knot).astype(int)
    # centred, so that both borders have the same room
    return Spline(low - 0.5 - 0.5 * (count * knot - steps), knot, (int(count[0]), int(count[1])))
