"""Normal equations of a sheet: its control points, cell by cell, bordered by a few numbers that all cells share. See `grid_sheet`.

The shared numbers are smooth strains over the whole sheet and, for squares, how far their edges lie outside their printed places.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.grid_blocks import Factor, factor
from dishmap.targets.grid_spline import Spline
from dishmap.targets.grid_terms import Seen, Terms, rough_rows, seen, strain_rows

Array = NDArray[Any]
Index = NDArray[np.int64]

# A square's edges may lie outwards by this part of half its side: the pitch measures the side, so it may be poorly known.
SPREAD_PART = 0.2
# On the diagonal, relative to what the photograph says, and to everything (rounding): neither may hold what the priors leave free.
RIDGE, ROUNDING = 1e-9, 1e-14
# The same for the priors alone, which leave rigid motions free.
LOOSE = 1e-11


@dataclass(frozen=True)
class Sizes:
    """What is learnt of a sheet.

    print_mm: printing errors of a target's place, per axis; strain: of single lattice cells, per component; smooth_strain: of each smooth
    strain; rough_mm: third derivatives along the normal, in mm per lattice step cubed, per lattice cell.
    """

    print_mm: float
    strain: float
    smooth_strain: float
    rough_mm: float

    @property
    def values(self) -> Array:
        """All of them (4,)."""
        return np.array([self.print_mm, self.strain, self.smooth_strain, self.rough_mm])


@dataclass(frozen=True)
class State:
    """control_mm (K, 3); shared (B,): smooth strains, and for squares the spread of their edges in mm as the last."""

    control_mm: Array
    shared: Array

    def spread_mm(self, terms: Terms) -> float:
        """How far edges lie outside their printed places."""
        return float(self.shared[-1]) if terms.squares else 0.0


@dataclass(frozen=True)
class Rows:
    """Rows of a prior: value (cells, R), by_cell (cells, R, 48), by_shared (cells, R, B) or None."""

    value: Array
    by_cell: Array
    by_shared: Array | None


@dataclass(frozen=True)
class Bordered:
    """A normal matrix: factored, of the control points' own part; column (unknowns, B) and corner (B, B): the shared numbers' border."""

    spline: Spline
    factored: Factor
    column: Array
    corner: Array

    @cached_property
    def answered(self) -> Array:
        """The own part's inverse times the border (unknowns, B)."""
        return self.factored.solve(self.column)

    @cached_property
    def shared_covariance(self) -> Array:
        """Covariance (B, B) of the shared numbers."""
        return np.asarray(np.linalg.inv(self.corner - self.column.T @ self.answered))

    def solve(self, right: Array, right_shared: Array) -> tuple[Array, Array]:
        """Solutions (unknowns, K) and (B, K) for right-hand sides of these shapes."""
        own = self.factored.solve(right)
        shared = self.shared_covariance @ (right_shared - self.column.T @ own)
        return own - self.answered @ shared, shared

    @cached_property
    def covariance_of_cells(self) -> Array:
        """Covariance (cells, 48, 48) of each cell's unknowns."""
        own = self.spline.inverse_of_cells(self.factored.inverse())
        answered = self.spline.of_cells(self.answered)
        return np.asarray(own + answered @ self.shared_covariance @ np.swapaxes(answered, 1, 2))

    def uncertainty_of(self, rows: Rows) -> float:
        """The sum of the variances that are left to rows."""
        out = np.vdot(rows.by_cell @ self.covariance_of_cells, rows.by_cell)
        if rows.by_shared is not None:
            answered = self.spline.of_cells(self.answered)
            out -= 2 * np.vdot(rows.by_cell @ (answered @ self.shared_covariance), rows.by_shared)
            out += np.vdot(rows.by_shared @ self.shared_covariance, rows.by_shared)
        return float(out)

    def covariance(self, cell: Index, by_cell: Array, by_shared: Array) -> Array:
        """Covariance (N, R, R) of combinations by_cell (N, R, 48) of the unknowns of cells (N,) and by_shared (N, R, B)."""
        own = by_cell @ self.covariance_of_cells[cell] @ np.swapaxes(by_cell, 1, 2)
        cross = by_cell @ (-self.spline.of_cells(self.answered)[cell] @ self.shared_covariance) @ np.swapaxes(by_shared, 1, 2)
        return np.asarray(own + cross + np.swapaxes(cross, 1, 2) + by_shared @ self.shared_covariance @ np.swapaxes(by_shared, 1, 2))


@dataclass(frozen=True)
class System:
    """Normal equations at a state.

    matrix; right (unknowns,), right_shared (B,): gradients; cost; and what they were made of: view, residual (N, m), weight (N, m, m),
    by_print (N, m, m): covariance of 1 mm of printing error; strain, rough: rows of the priors.
    """

    matrix: Bordered
    right: Array
    right_shared: Array
    cost: float
    view: Seen
    residual: Array
    weight: Array
    by_print: Array
    strain: Rows
    rough: Rows


def priors_at(terms: Terms, state: State) -> tuple[Rows, Rows]:
    """Rows of strain and roughness at a state."""
    value, by = strain_rows(terms, state.control_mm)
    shapes = terms.strain_shapes
    if terms.squares:
        shapes = np.concatenate([shapes, np.zeros((*shapes.shape[:2], 1))], axis=2)
    strain = Rows(value - shapes @ state.shared, by, -shapes)
    return strain, Rows(*rough_rows(terms, state.control_mm), None)


def shared_precision(terms: Terms, sizes: Sizes) -> Array:
    """Prior precision (B,) of the shared numbers."""
    count = terms.strain_shapes.shape[2]
    strains = np.full(count, sizes.smooth_strain**-2)
    return np.append(strains, (SPREAD_PART * float(np.median(terms.half_mm))) ** -2) if terms.squares else strains


def system_at(terms: Terms, state: State, sizes: Sizes, used: NDArray[np.bool_]) -> System:
    """The normal equations at a state; used (N,): which targets count. Raises numpy.linalg.LinAlgError."""
    view = seen(terms, state.control_mm, state.spread_mm(terms))
    residual = terms.measured - view.value
    by_print = _by_print(view)
    weight = np.linalg.inv(terms.covariance + sizes.print_mm**2 * by_print) * used[:, None, None]
    cells, right, spread = _from_photograph(terms, view, residual, weight)
    ridge = RIDGE * float(np.trace(cells, axis1=1, axis2=2).max())
    precision = shared_precision(terms, sizes)
    corner, right_shared = np.diag(precision), -precision * state.shared
    border = np.zeros((*spread.shape, len(precision)))
    cost = float(np.einsum("ni,nij,nj->", residual, weight, residual)) + float(precision @ state.shared**2)
    if terms.squares:
        border[..., -1] = spread
        corner[-1, -1] += np.einsum("ni,nij,nj->", view.by_spread, weight, view.by_spread)
        right_shared[-1] += np.einsum("ni,nij,nj->", view.by_spread, weight, residual)
    priors = priors_at(terms, state)
    for rows, size in zip(priors, (sizes.strain, sizes.rough_mm), strict=True):
        own, beside, shared = _normal(rows, size)
        cells, border, corner = cells + own, border + beside, corner + shared
        right = right - (np.swapaxes(rows.by_cell, 1, 2) @ rows.value[..., None])[..., 0] / size**2
        cost += float((rows.value**2).sum()) / size**2
        if rows.by_shared is not None:
            right_shared = right_shared - rows.by_shared.reshape(-1, len(corner)).T @ rows.value.ravel() / size**2
    gathered = terms.spline.gathered(right[..., None])[:, 0]
    matrix = _bordered(terms.spline, cells, border, corner, ridge)
    return System(matrix, gathered, right_shared, cost, view, residual, weight, by_print, *priors)


def priors_alone(terms: Terms, system: System, sizes: Sizes) -> Bordered:
    """The normal matrix of the priors at a system's state, without the photograph."""
    corner = np.diag(shared_precision(terms, sizes))
    parts = [_normal(rows, size) for rows, size in ((system.strain, sizes.strain), (system.rough, sizes.rough_mm))]
    cells = parts[0][0] + parts[1][0]
    return _bordered(terms.spline, cells, parts[0][1], corner + parts[0][2], LOOSE * float(np.trace(cells, axis1=1, axis2=2).max()))


def _normal(rows: Rows, size: float) -> tuple[Array, Array | float, Array | float]:
    """What rows of a prior add to the cells' matrices, to the border and to its corner."""
    turned = np.swapaxes(rows.by_cell, 1, 2) / size**2
    if rows.by_shared is None:
        return turned @ rows.by_cell, 0.0, 0.0
    flat = rows.by_shared.reshape(-1, rows.by_shared.shape[2])
    return turned @ rows.by_cell, turned @ rows.by_shared, flat.T @ flat / size**2


def _bordered(spline: Spline, cells: Array, border: Array | float, corner: Array, ridge: float) -> Bordered:
    ridge = max(ridge, ROUNDING * float(np.trace(cells, axis1=1, axis2=2).max()))
    return Bordered(spline, factor(spline.assembled(cells, ridge)), spline.gathered(np.asarray(border)), corner)


def _by_print(view: Seen) -> Array:
    """Covariance (N, m, m) in px^2 of 1 mm of printing error along both tangents of each measured pair."""
    count, m = view.value.shape
    out = np.zeros((count, m, m))
    own = view.by_move @ np.swapaxes(view.by_move, 1, 2)
    for k in range(0, m, 2):
        out[:, k : k + 2, k : k + 2] = own
    return out


def _from_photograph(terms: Terms, view: Seen, residual: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Cells' matrices (cells, 48, 48), right-hand sides (cells, 48) and columns of the spread (cells, 48) from the photograph."""
    turned = np.swapaxes(_root(weight), 1, 2)
    # by_cell, residual and spread side by side, so that one product per cell gives all three
    rows = turned @ np.concatenate([view.by_cell, residual[..., None], view.by_spread[..., None]], axis=2)
    padded = np.concatenate([rows, np.zeros((1, *rows.shape[1:]))])[terms.in_cells]
    padded = padded.reshape(terms.spline.cells, -1, rows.shape[2])
    product = np.swapaxes(padded[..., :-2], 1, 2) @ padded
    return product[..., :-2].copy(), product[..., -2].copy(), product[..., -1].copy()


def _root(weight: Array) -> Array:
    """Square roots (N, m, m) of weights, of which some are zero."""
    out = np.zeros_like(weight)
    some = weight[:, 0, 0] > 0
    out[some] = np.linalg.cholesky(weight[some])
    return out
