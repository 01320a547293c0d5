"""What holds a sheet, as sums of squares: places in the photograph, printed lengths, smoothness. See `grid_sheet`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.targets.grid_blocks import factor
from dishmap.targets.grid_spline import CELL, FIRST, Spline, gauss_points
from dishmap.targets.pattern import Pattern

Array = NDArray[Any]
Index = NDArray[np.int64]

# Corners of a square in units of its half sides, counter-clockwise from the upper right, and how what is measured of it (middle,
# half along x, half along y) comes from their images.
CORNERS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
MEASURED = np.concatenate([np.ones((1, 4)), CORNERS.T]) / 4
# Each mixed third derivative counts as often as it occurs.
THIRD_WEIGHT = np.sqrt([1.0, 3.0, 3.0, 1.0])
# Strain has three components; the mixed one counts twice.
STRAIN_WEIGHT = np.array([1.0, 1.0, np.sqrt(2.0)])
# Degree of the smooth strains that a sheet may have besides those of single cells.
STRAIN_DEGREE = 3
# The part of a cell that counts as printed where nothing is.
NOTHING_PRINTED = 1e-4
# Fit of the nominal places, which are smooth: rounding is all that is smoothed.
NOMINAL_SMOOTH, NOMINAL_RIDGE = 1e-6, 1e-10


@dataclass(frozen=True)
class Nominal:
    """The nominal surface in the layout of the spline.

    control_mm (K, 3): control points in the dish frame; frame (cells, 4, 2, 2): T with T^T G0 T = 1 at Gauss's points; third (cells, 4):
    n . X_kkk in the middles of cells; offset (N, 4, 2): corners of squares about their nodes in lattice steps per mm of half a side;
    printed (cells,): the part of each cell that the pattern fills. Where nothing is printed there is no material that could resist.
    """

    control_mm: Array
    frame: Array
    third: Array
    offset: Array
    printed: Array


@dataclass(frozen=True)
class Terms:
    """What stays fixed while a sheet is estimated, of N targets.

    lattice (N, 2); cell (N,); half_mm (N,): half the side of squares, 0 for crossings; measured (N, m): what the pixels gave, px, m = 6
    for squares (middle, half along x, half along y) and 2 for crossings; covariance (N, m, m) of it.
    """

    camera: Camera
    spline: Spline
    nominal: Nominal
    lattice: Array
    cell: Index
    half_mm: Array
    measured: Array
    covariance: Array

    @property
    def squares(self) -> bool:
        """True for squares, False for crossings."""
        return self.measured.shape[1] == 6

    @cached_property
    def at_targets(self) -> Array:
        """Weights (N, 3, 16) of place and both first derivatives at the targets' nodes."""
        return np.stack([self.spline.weights(self.cell, self.lattice, by) for by in ((0, 0), *FIRST)], axis=1)

    @cached_property
    def in_cells(self) -> Index:
        """Targets of every cell (cells, most), filled up with N: one past the last."""
        return self.spline.grouped(self.cell)

    @cached_property
    def strain_shapes(self) -> Array:
        """Smooth strains (cells, 12, K), as `strain_rows` counts strain: Legendre products of each component."""
        spline = self.spline
        at = (np.stack(np.divmod(np.arange(spline.cells), spline.count[1]), axis=-1)[:, None] + gauss_points()) / np.array(spline.count)
        one, other = (legvander(2 * at[..., k] - 1, STRAIN_DEGREE) for k in range(2))
        pairs = [(i, j) for i in range(STRAIN_DEGREE + 1) for j in range(STRAIN_DEGREE + 1 - i)]
        value = np.stack([one[..., i] * other[..., j] * np.sqrt((2 * i + 1) * (2 * j + 1)) for i, j in pairs], axis=-1)
        alike = np.einsum("cqk,vw->cqvkw", value, np.diag(STRAIN_WEIGHT) * (0.5 * spline.knot))
        alike = alike * np.sqrt(self.nominal.printed)[:, None, None, None, None]
        return alike.reshape(spline.cells, 12, -1)


@dataclass(frozen=True)
class Seen:
    """The photograph as a sheet predicts it.

    value (N, m), px; by_cell (N, m, 48), by_spread (N, m): its derivatives; by_move (N, 2, 2): those of the target's middle by moves along
    both lattice directions, px/mm.
    """

    value: Array
    by_cell: Array
    by_spread: Array
    by_move: Array


def of_cells(spline: Spline, control_mm: Array) -> Array:
    """Control points (cells, 16, 3) of all cells."""
    return np.asarray(control_mm[spline.controls])


def normal_of(tangent: Array) -> Array:
    """Unit normals (..., 3) of tangents (..., 3, 2)."""
    normal = np.cross(tangent[..., 0], tangent[..., 1])
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def by_unknowns(weights: Array) -> Array:
    """Rows (..., 3, 48) that give three coordinates from a cell's unknowns by weights (..., 16) of its control points."""
    return np.asarray((weights[..., None, :, None] * np.eye(3)[:, None, :]).reshape(*weights.shape[:-1], 3, CELL))


def terms_of(camera: Camera, pattern: Pattern, spline: Spline, rows: Index, measured: Array, covariance: Array) -> Terms:
    """The terms for targets in `rows` (N,) of a grid pattern."""
    assert pattern.lattice is not None
    lattice = pattern.lattice.astype(float)
    mine = lattice[rows]
    half = np.zeros(len(rows))
    if measured.shape[1] == 6:
        half = np.array([np.abs(pattern.kind_of(i).polygons[0].corners_mm).max() for i in rows])
    return Terms(camera, spline, _nominal(pattern, spline, rows), mine, spline.cell_of(mine), half, measured, covariance)


def _nominal(pattern: Pattern, spline: Spline, rows: Index) -> Nominal:
    assert pattern.lattice is not None
    lattice = pattern.lattice.astype(float)
    control = _nominal_control(pattern, spline)
    own = of_cells(spline, control)
    tangent = np.moveaxis(spline.at_gauss[:, None] @ own, 0, -1)
    metric = np.swapaxes(tangent, -1, -2) @ tangent
    frame = np.swapaxes(np.linalg.inv(np.linalg.cholesky(metric)), -1, -2)
    first, third = spline.at_middle
    normal = normal_of(np.swapaxes(first @ own, -1, -2))
    cell = spline.cell_of(lattice[rows])
    at = np.stack([spline.weights(cell, lattice[rows], by) for by in FIRST], axis=1) @ own[cell]
    # lattice steps per mm along the target's own axes
    steps = np.linalg.inv(np.swapaxes(at @ pattern.axes[rows][..., :2], 1, 2))
    offset = CORNERS @ np.swapaxes(steps, 1, 2)
    return Nominal(control, frame, np.einsum("cd,ckd->ck", normal, third @ own), offset, _printed(spline, lattice))


def _printed(spline: Spline, lattice: Array) -> Array:
    """The part (cells,) of each cell with nodes of the pattern; hardly anything where there are none, so that the rest stays in reach."""
    inside = ((lattice > spline.low) & (lattice < spline.low + spline.knot * np.array(spline.count))).all(axis=1)
    nodes = np.bincount(spline.cell_of(lattice[inside]), minlength=spline.cells)
    return np.clip(nodes / spline.knot**2, NOTHING_PRINTED, 1.0)


def _nominal_control(pattern: Pattern, spline: Spline) -> Array:
    """Control points (K, 3) of the nominal surface: through the targets' places, at right angles to their normals."""
    assert pattern.lattice is not None
    lattice = pattern.lattice.astype(float)
    end = spline.low + spline.knot * np.array(spline.count)
    near = np.flatnonzero(((lattice >= spline.low - spline.knot) & (lattice <= end + spline.knot)).all(axis=1))
    cell = spline.cell_of(lattice[near])
    place = by_unknowns(spline.weights(cell, lattice[near], (0, 0)))
    slopes = np.stack([spline.weights(cell, lattice[near], by) for by in FIRST], axis=1)
    level = (slopes[..., None] * pattern.normal[near][:, None, None]).reshape(len(near), 2, CELL)
    rows = np.concatenate([place, level], axis=1)
    value = np.pad(pattern.center_mm[near], ((0, 0), (0, 2)))
    both = np.concatenate([np.concatenate([rows, value[..., None]], axis=2), np.zeros((1, 5, CELL + 1))])[spline.grouped(cell)]
    both = both.reshape(spline.cells, -1, CELL + 1)
    product = np.swapaxes(both[..., :CELL], 1, 2) @ both
    third = by_unknowns(spline.at_middle[1] * THIRD_WEIGHT[:, None]).reshape(-1, CELL)
    cells = product[..., :CELL] + NOMINAL_SMOOTH * spline.knot**2 * (third.T @ third)
    matrix = spline.assembled(cells, NOMINAL_RIDGE)
    return spline.control_points(factor(matrix).solve(spline.gathered(product[..., CELL:]))[:, 0])


def seen(terms: Terms, control_mm: Array, spread_mm: float) -> Seen:
    """What the photograph of a sheet would give for all targets."""
    own = of_cells(terms.spline, control_mm)[terms.cell]
    weights = terms.at_targets
    places = weights @ own
    _, by_point = terms.camera.project_with_point_jacobian(places[:, :1])
    by_move = by_point[:, 0] @ np.swapaxes(places[:, 1:], 1, 2)
    by_move = by_move / np.linalg.norm(places[:, 1:], axis=2)[:, None]
    if not terms.squares:
        pixels, by_point = terms.camera.project_with_point_jacobian(places[:, :1])
        return Seen(pixels[:, 0], by_point[:, 0] @ by_unknowns(weights[:, 0]), np.zeros((len(own), 2)), by_move)
    outward = terms.nominal.offset
    at = terms.lattice[:, None] + (terms.half_mm + spread_mm)[:, None, None] * outward
    corner = terms.spline.weights(terms.cell, at, (0, 0))
    pixels, by_point = terms.camera.project_with_point_jacobian(corner @ own)
    by_cell = by_point @ by_unknowns(corner)
    slopes = np.stack([terms.spline.weights(terms.cell, at, by) @ own for by in FIRST], axis=-1)
    by_spread = (by_point @ (slopes @ outward[..., None]))[..., 0]
    count = len(own)
    value = (MEASURED @ pixels).reshape(count, 6)
    return Seen(
        value,
        np.einsum("mk,nkij->nmij", MEASURED, by_cell).reshape(count, 6, CELL),
        (MEASURED @ by_spread).reshape(count, 6),
        by_move,
    )


def seen_by_camera(terms: Terms, control_mm: Array, spread_mm: float) -> Array:
    """Change (N, m, P) of what is seen of all targets with the camera's parameters."""
    own = of_cells(terms.spline, control_mm)[terms.cell]
    if not terms.squares:
        _, _, by_camera = terms.camera.project_with_jacobians((terms.at_targets[:, :1] @ own)[:, 0])
        return by_camera
    at = terms.lattice[:, None] + (terms.half_mm + spread_mm)[:, None, None] * terms.nominal.offset
    _, _, by_camera = terms.camera.project_with_jacobians(terms.spline.weights(terms.cell, at, (0, 0)) @ own)
    return np.asarray(np.einsum("mk,nkip->nmip", MEASURED, by_camera).reshape(len(own), 6, -1))


def strain_rows(terms: Terms, control_mm: Array) -> tuple[Array, Array]:
    """Strain (cells, 12) of all cells, three components at each of Gauss's points, counting a lattice cell once, and d / d unknowns."""
    spline, frame = terms.spline, terms.nominal.frame
    own = of_cells(spline, control_mm)
    tangent = np.moveaxis(spline.at_gauss[:, None] @ own, 0, -1) @ frame
    # weights of the derivative along each orthonormal direction
    along = np.einsum("aqw,cqai->cqiw", spline.at_gauss, frame)
    metric = np.swapaxes(tangent, -1, -2) @ tangent
    pairs = ((0, 0), (1, 1), (0, 1))
    value = np.stack([0.5 * (metric[..., i, j] - (i == j)) for i, j in pairs], axis=-1)
    rows = [
        0.5 * (along[:, :, i, :, None] * tangent[:, :, None, :, j] + along[:, :, j, :, None] * tangent[:, :, None, :, i]) for i, j in pairs
    ]
    by = np.stack(rows, axis=2).reshape(spline.cells, 4, 3, CELL)
    scale = STRAIN_WEIGHT * (0.5 * spline.knot) * np.sqrt(terms.nominal.printed)[:, None, None]
    return (value * scale).reshape(spline.cells, 12), (by * scale[..., None]).reshape(spline.cells, 12, CELL)


def rough_rows(terms: Terms, control_mm: Array) -> tuple[Array, Array]:
    """Third derivatives along the normal (cells, 4), less the nominal ones, weighted by the area of a cell, and d / d unknowns."""
    spline = terms.spline
    own = of_cells(spline, control_mm)
    first, third = spline.at_middle
    tangent, bend = np.swapaxes(first @ own, -1, -2), third @ own
    normal = normal_of(tangent)
    scale = THIRD_WEIGHT * spline.knot * np.sqrt(terms.nominal.printed)[:, None]
    value = np.einsum("cd,ckd->ck", normal, bend) - terms.nominal.third
    # a turn of the surface turns the normal: dn = - sum over tangents of (dual tangent) (n . d tangent)
    dual = tangent @ np.linalg.inv(np.swapaxes(tangent, -1, -2) @ tangent)
    weights = third[None] - (bend @ dual) @ first
    by = (weights * scale[..., None])[..., None] * normal[:, None, None, :]
    return value * scale, by.reshape(spline.cells, 4, CELL)
