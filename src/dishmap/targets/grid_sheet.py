"""The joint estimate of a printed sheet: one smooth surface from the places of all targets of a grid in one photograph.

The unknown is a map from lattice coordinates (a, b) to the camera frame, a tensor spline. Three kinds of evidence hold it:

- the places of the targets in the photograph, with the covariance of the fit to the raw pixels and a size of printing errors;
- printed lengths: the metric of the map is that of the nominal surface, but for a strain E = (J^T J - G0) / 2 in orthonormal axes;
- smoothness: curvature changes little from place to place; the third derivatives along the normal are the nominal ones but for a roughness.

A strain has two parts, of single cells and smooth over the sheet. The four sizes (printing error, both strains, roughness) are learnt by
maximum marginal likelihood (MacKay 1992). Nothing is assumed of the shape: a flat pattern wrapped on a cylinder comes out as one. To one
camera a sheet that grew is one that came nearer, so where a sheet shows smooth strains its depths carry what a like strain of the whole
would do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.errors import MeasurementError
from dishmap.targets.grid_learn import STEPS, descend, learn, screened
from dishmap.targets.grid_spline import spline_over
from dishmap.targets.grid_system import Sizes, State, System
from dishmap.targets.grid_terms import MEASURED, Terms, by_unknowns, normal_of, of_cells, seen_by_camera, terms_of
from dishmap.targets.pattern import Pattern

Array = NDArray[Any]
Index = NDArray[np.int64]
Flags = NDArray[np.bool_]

# Cells of the spline along the longer side: 24 over a 0.6 m dish are 25 mm wide, over which a deformation of 1 mm of degree 6 is followed
# to 0.0002 mm.
MOST_CELLS = 24
SCREENINGS = 3
# Fewest targets and fewest rows and columns of them: a lattice's size shows in both directions only then.
FEWEST_TARGETS, FEWEST_LINES = 6, 2


@dataclass(frozen=True)
class Sheet:
    """The sheet through N targets.

    index (N,): places in the pattern; place_mm (N, 3); tangent (N, 3, 2): d surface / d lattice; covariance (N, 9, 9) of (place, tangent
    along columns, along rows) from noise, printing errors and the learnt sizes; by_camera (N, 9, P): their change with the camera's
    parameters; by_place (N, m, 3), by_turn (N, m, 3), by_spread (N, m): what a change of each target alone (place in the camera's axes,
    turn about the target's, edges moved outwards by 1 mm) does to what is measured of it; residual (N, m): measured less predicted, px;
    off_px (N, 2): places measured less those of the smooth surface, printing errors included;
    used (N,): targets that shaped the surface; spread_mm and its sigma: how far edges of squares lie outside their printed place;
    sizes: what was learnt.
    """

    index: Index
    place_mm: Array
    tangent: Array
    covariance: Array
    by_camera: Array
    by_place: Array
    by_turn: Array
    by_spread: Array
    residual: Array
    off_px: Array
    used: Flags
    spread_mm: float
    sigma_spread_mm: float
    sizes: Sizes

    @property
    def normal(self) -> Array:
        """Unit normals (N, 3) on the printed side."""
        return normal_of(self.tangent)


def estimate_sheet(
    camera: Camera, pattern: Pattern, index: Index, measured: Array, covariance: Array, progress: Callable[[int, int], None] | None = None
) -> Sheet:
    """The surface through targets `index` (N,) of a grid.

    measured (N, m) in px: places (m = 2), or for squares place, half along x and half along y (m = 6); covariance (N, m, m) of the noise
    in them. `progress(done, total)` is called after each round of learning. Raises MeasurementError for too few targets, for a lattice
    that no smooth surface explains and for an estimate that does not settle.
    """
    _check_enough(pattern, index)
    tell = progress or (lambda done, total: None)
    assert pattern.lattice is not None
    terms = terms_of(camera, pattern, spline_over(pattern.lattice[index].astype(float), MOST_CELLS), index, measured, covariance)
    state, sizes, used = learn(terms, tell)
    for _ in range(SCREENINGS):
        state, system, settled = descend(terms, state, sizes, used, STEPS)
        before, used = used, screened(terms, system, sizes, used)
        if (used == before).all():
            break
    if not settled:
        raise MeasurementError(
            "the surface through the grid did not settle; part of the lattice may be wrongly named, or the camera file be of another camera"
        )
    return outcome(terms, state, system, sizes, used, index)


def _check_enough(pattern: Pattern, index: Index) -> None:
    assert pattern.lattice is not None
    columns, rows = (len(np.unique(pattern.lattice[index, k])) for k in range(2))
    if len(index) < FEWEST_TARGETS or min(columns, rows) < FEWEST_LINES:
        raise MeasurementError(
            f"{len(index)} targets in {columns} columns and {rows} rows of the grid were measured; a surface needs at least "
            f"{FEWEST_TARGETS} targets in {FEWEST_LINES} columns and {FEWEST_LINES} rows: bring more of the grid into view"
        )


def outcome(terms: Terms, state: State, system: System, sizes: Sizes, used: Flags, index: Index) -> Sheet:
    """What a settled state says of the targets.

    A target lies on the smooth surface but for its own printing error e, of which the photograph says
    e = K (measured - predicted), K = s^2 G^T (C + s^2 G G^T)^-1, G its motion in the photograph (Rasmussen and Williams 2006, eq. 2.25).
    """
    own, weights = of_cells(terms.spline, state.control_mm)[terms.cell], terms.at_targets
    values = weights @ own
    place, tangent = values[:, 0], np.swapaxes(values[:, 1:], 1, 2)
    along = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    view, variance = system.view, sizes.print_mm**2
    gain = variance * (np.swapaxes(view.by_move, 1, 2) @ system.weight[:, :2])
    shift = along @ gain
    place = place + (shift @ system.residual[..., None])[..., 0]
    rows = by_unknowns(weights).reshape(len(place), 9, -1)
    rows[:, :3] -= shift @ view.by_cell
    shared = np.zeros((len(place), 9, len(system.matrix.corner)))
    if terms.squares:
        shared[:, :3, -1] = -(shift @ view.by_spread[..., None])[..., 0]
    covariance = system.matrix.covariance(terms.cell, rows, shared)
    left = variance * (np.eye(2) - gain @ np.pad(view.by_move, ((0, 0), (0, system.residual.shape[1] - 2), (0, 0))))
    covariance[:, :3, :3] += along @ left @ np.swapaxes(along, 1, 2)
    by_place, by_turn = _by_own_motion(terms, place, tangent, state.spread_mm(terms))
    by_camera = seen_by_camera(terms, state.control_mm, state.spread_mm(terms))
    turned = np.swapaxes(view.by_cell, 1, 2) @ system.weight
    cells = np.zeros((terms.spline.cells, turned.shape[1], by_camera.shape[2]))
    np.add.at(cells, terms.cell, turned @ by_camera)
    right_shared = np.zeros((len(system.matrix.corner), by_camera.shape[2]))
    if terms.squares:
        right_shared[-1] = np.einsum("ni,nij,njp->p", view.by_spread, system.weight, by_camera)
    moved, moved_shared = system.matrix.solve(terms.spline.gathered(cells), right_shared)
    response = -rows @ terms.spline.of_cells(moved)[terms.cell] - shared @ moved_shared
    response[:, :3] -= shift @ by_camera
    sigma = float(np.sqrt(system.matrix.shared_covariance[-1, -1])) if terms.squares else 0.0
    predicted_move = np.zeros_like(system.residual)
    predicted_move[:, :2] = (view.by_move @ (gain @ system.residual[..., None]))[..., 0]
    return Sheet(
        index,
        place,
        tangent,
        covariance,
        response,
        by_place,
        by_turn,
        view.by_spread,
        system.residual - predicted_move,
        system.residual[:, :2],
        used,
        state.spread_mm(terms),
        sigma,
        sizes,
    )


def _by_own_motion(terms: Terms, place: Array, tangent: Array, spread_mm: float) -> tuple[Array, Array]:
    """`by_own_motion` of targets with tangents (N, 3, 2) whose edges lie `spread_mm` outside their printed place."""
    corner = None
    if terms.squares:
        corner = (tangent @ np.swapaxes((terms.half_mm + spread_mm)[:, None, None] * terms.nominal.offset, 1, 2)).swapaxes(1, 2)
    return by_own_motion(terms.camera, place, target_axes(tangent), corner)


def by_own_motion(camera: Camera, place_mm: Array, rotation: Array, corner_mm: Array | None) -> tuple[Array, Array]:
    """Change (N, m, 3) of what is measured of each target by its own moves along the camera's axes, and by turns about its own axes.

    place_mm (N, 3) in the camera frame, rotation (N, 3, 3) camera_from_target; corner_mm (N, 4, 3): corners of squares from their middles,
    in camera axes; None for crossings, whose turns do not show.
    """
    if corner_mm is None:
        _, by_point = camera.project_with_point_jacobian(place_mm)
        return by_point, np.zeros_like(by_point)
    _, by_point = camera.project_with_point_jacobian(place_mm[:, None] + corner_mm)
    turns = np.cross(np.swapaxes(rotation, 1, 2)[:, None], corner_mm[:, :, None])
    both = (
        np.einsum("mk,nkij->nmij", MEASURED, rows).reshape(len(place_mm), 6, 3) for rows in (by_point, by_point @ np.swapaxes(turns, 2, 3))
    )
    return tuple(both)


def target_axes(tangent: Array) -> Array:
    """Rotations (N, 3, 3) camera_from_target of tangents (N, 3, 2): x along columns, z the normal."""
    x = tangent[..., 0] / np.linalg.norm(tangent[..., 0], axis=1, keepdims=True)
    normal = normal_of(tangent)
    return np.stack([x, np.cross(normal, x), normal], axis=-1)
