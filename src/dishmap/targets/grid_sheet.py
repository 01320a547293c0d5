"""The joint estimate of a printed sheet: one smooth surface from the places of all targets of a grid in one photograph.

The unknown is a map from lattice coordinates (a, b) to the camera frame, a tensor spline. Three kinds of evidence hold it:

- the places of the targets in the photograph, with the covariance of the fit to the raw pixels and a size of printing errors;
- printed lengths: the metric of the map is that of the nominal surface, but for a strain E = (J^T J - G0) / 2 in orthonormal axes;
- smoothness: curvature changes little from place to place; the third derivatives along the normal are the nominal ones but for a roughness.

The three sizes (printing error, strain, roughness) are learnt by maximum marginal likelihood (MacKay 1992). Nothing is assumed of the
shape: a flat pattern wrapped on a cylinder comes out as one. The mean strain is zero by convention: to one camera a sheet that grew is
one that came nearer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.errors import MeasurementError
from dishmap.targets.grid_spline import FIRST, fit_spline, spline_over
from dishmap.targets.grid_system import Sizes, State, System, priors_alone, system_at
from dishmap.targets.grid_terms import MEASURED, Terms, by_unknowns, normal_of, of_cells, seen_by_camera, terms_of
from dishmap.targets.pattern import Pattern

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Flags = NDArray[np.bool_]

START_SMOOTH, START_CUT, START_BEND, START_ROUNDS = 1e-3, 7.0, 0.05, 5
SETTLED, LEAST_PART, LEARNT = 0.1, 1e-3, 0.15
USUAL_STRAIN = 1e-4
LARGEST_CHANGE, FEWEST_FREE, RELAXATION = 10.0, 0.02, 1.4
LOOSE_SIZES, FIRST_SIZES = Sizes(0.1, 1e-2, 1e-4, 0.1), Sizes(0.01, 1e-3, 1e-4, 0.02)
# Less than any photograph shows, and what rounding allows; a film that stretched smoothly by more than the largest would not stay smooth.
LEAST_SIZES, LARGEST_SIZES = Sizes(1e-5, 1e-5, 1e-7, 1e-5), Sizes(10.0, 0.1, 1e-3, 1e3)
# Cells of the spline along the longer side: 24 over a 0.6 m dish are 25 mm wide, over which a deformation of 1 mm of degree 6 is followed
# to 0.0002 mm.
MOST_CELLS = 24
STEPS, LEARN_ROUNDS, SCREENINGS = 40, 20, 3
# Fewest targets and fewest rows and columns of them: a lattice's size shows in both directions only then.
FEWEST_TARGETS, FEWEST_LINES = 6, 2
# A target farther off than this many sigmas (of its noise, printing errors and what is left of the misfit of the others) is put aside.
OUTLIER_SIGMAS = 5.0
MOST_OUTLIERS = 0.3
# Median of chi-square with 2 and 6 degrees of freedom.
MEDIAN_CHI2 = {2: 1.386, 6: 5.348}


@dataclass(frozen=True)
class Sheet:
    """The sheet through N targets.

    index (N,): places in the pattern; place_mm (N, 3); tangent (N, 3, 2): d surface / d lattice; covariance (N, 9, 9) of (place, tangent
    along columns, along rows) from noise, printing errors and the learnt sizes; by_camera (N, 9, P): their change with the camera's
    parameters; by_place (N, m, 3), by_turn (N, m, 3), by_spread (N, m): what a change of each target alone (place in the camera's axes, turn
    about the target's, edges moved outwards by 1 mm) does to what is measured of it; residual (N, m): measured less predicted, px;
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
            "the surface through the grid did not settle; the lattice may be wrongly named in part, or the camera file is not of this camera"
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


def learn(terms: Terms, tell: Callable[[int, int], None]) -> tuple[State, Sizes, Flags]:
    """A surface from scratch, the learnt sizes, and which targets fit."""
    shared = terms.strain_shapes.shape[2] + terms.squares
    state, sizes, used = State(start_control(terms), np.zeros(shared)), FIRST_SIZES, np.ones(len(terms.cell), bool)
    state, _, _ = descend(terms, state, LOOSE_SIZES, used, STEPS)
    state, system, _ = descend(terms, state, sizes, used, STEPS)
    for number in range(LEARN_ROUNDS):
        used = screened(terms, system, sizes, used)
        before, sizes = sizes, relearnt(terms, state, system, sizes)
        state, system, _ = descend(terms, state, sizes, used, 1)
        tell(number + 1, LEARN_ROUNDS)
        if np.abs(np.log(sizes.values / before.values)).max() < LEARNT:
            break
    return state, sizes, used


def screened(terms: Terms, system: System, sizes: Sizes, used: Flags) -> Flags:
    """Which targets (N,) fit the surface. Raises MeasurementError when too few do."""
    spread = terms.covariance + sizes.print_mm**2 * system.by_print
    chi2 = np.einsum("ni,ni->n", system.residual, np.linalg.solve(spread, system.residual[..., None])[..., 0])
    usual = max(1.0, float(np.median(chi2[used])) / MEDIAN_CHI2[system.residual.shape[1]])
    fits = np.asarray(chi2 < usual * OUTLIER_SIGMAS**2)
    if fits.mean() < 1 - MOST_OUTLIERS:
        raise MeasurementError(
            f"{int((~fits).sum())} of {len(fits)} targets lie off any smooth surface through the others; the pattern file or the names do "
            "not fit the photograph: check pitch, --anchor and orientation"
        )
    return fits


def start_control(terms: Terms) -> Array:
    """Control points (K, 3) of a first surface, from the size of the lattice around each target.

    In the plane across the line of sight d the lattice's derivative M, per mm of the print, has the singular values 1 / r and cos(tilt) / r:
    the larger one gives the distance r whatever the tilt.
    """
    spline = terms.spline
    ray = terms.camera.unproject(terms.measured[:, :2])
    seen = np.isfinite(ray).all(axis=1).astype(float)
    ray = np.nan_to_num(ray)
    along = _slopes(terms, fit_spline(spline, terms.lattice, ray, seen, 1e-6))
    along = along - ray[:, :, None] * np.einsum("ni,nia->na", ray, along)[:, None]
    tangent = _slopes(terms, terms.nominal.control_mm)
    frame = np.swapaxes(np.linalg.inv(np.linalg.cholesky(np.swapaxes(tangent, 1, 2) @ tangent)), 1, 2)
    places = ray / np.maximum(np.linalg.svd(along @ frame, compute_uv=False)[:, :1], 1e-9)
    weight, smooth = seen, START_SMOOTH
    # a surface bends by less than a part of the pitch from target to target: the noisier the distances, the stiffer it is taken
    bend = START_BEND * float(np.median(np.linalg.norm(tangent, axis=1)))
    for _ in range(START_ROUNDS):
        control = fit_spline(spline, terms.lattice, places, weight, smooth)
        fitted = np.einsum("nk,nkd->nd", terms.at_targets[:, 0], of_cells(spline, control)[terms.cell])
        gap = np.linalg.norm(places - fitted, axis=1)
        usual = max(float(np.median(gap[seen > 0])), 1e-9)
        weight = seen * (np.clip(1 - (gap / (START_CUT * usual)) ** 2, 0, None) ** 2 + 1e-6)
        smooth = max(START_SMOOTH, (usual / bend) ** 2)
    return control


def _slopes(terms: Terms, control: Array) -> Array:
    """Derivatives (N, D, 2) by the lattice at the targets."""
    return np.swapaxes(terms.at_targets[:, 1:] @ of_cells(terms.spline, control)[terms.cell], 1, 2)


def descend(terms: Terms, state: State, sizes: Sizes, used: Array, steps: int) -> tuple[State, System, bool]:
    """Up to `steps` Gauss-Newton steps, halved where they do not lower the cost; whether the estimate has settled.

    It has when the rest of the way would lower the cost, a chi-square, by less than SETTLED (Boyd and Vandenberghe, 9.5).
    """
    system = system_at(terms, state, sizes, used)
    for _ in range(steps):
        own, shared = system.matrix.solve(system.right[:, None], system.right_shared[:, None])
        if float(own[:, 0] @ system.right + shared[:, 0] @ system.right_shared) < SETTLED:
            return state, system, True
        move, part = terms.spline.control_points(own[:, 0]), 1.0
        found = None
        while part > LEAST_PART:
            trial = State(state.control_mm + part * move, state.shared + part * shared[:, 0])
            found = _tried(terms, trial, sizes, used)
            if found is not None and found.cost < system.cost:
                break
            part, found = part / 2, None
        if found is None:
            return state, system, False
        state, system = trial, found
    return state, system, False


def _tried(terms: Terms, state: State, sizes: Sizes, used: Array) -> System | None:
    """The system at a state, None where there is none: points behind the camera, or out of the lens's field."""
    try:
        with np.errstate(all="ignore"):
            found = system_at(terms, state, sizes, used)
    except np.linalg.LinAlgError:
        return None
    return found if np.isfinite(found.cost) else None


def relearnt(terms: Terms, state: State, system: System, sizes: Sizes) -> Sizes:
    """Better sizes: one step towards the maximum of the marginal likelihood of the linearised problem.

    For a prior precision sum_k P_k / s_k^2 the maximum lies where s_k^2 = S_k / (n_k - g_k), S_k the sum of squares, n_k = tr(P^+ P_k) / s_k^2
    the numbers that the prior speaks of and g_k = tr(H^-1 P_k) / s_k^2 those that the photograph leaves to it (MacKay 1992, eq. 4.10). The
    printing error is stepped by Fisher's scoring of the restricted likelihood.
    """
    alone = priors_alone(terms, system, sizes)
    old, count = sizes.values, terms.strain_shapes.shape[2]
    squares = np.array([(system.strain.value**2).sum(), (state.shared[:count] ** 2).sum(), (system.rough.value**2).sum()])
    spoken, left = (
        np.array([m.uncertainty_of(system.strain), float(np.trace(m.shared_covariance[:count, :count])), m.uncertainty_of(system.rough)])
        for m in (alone, system.matrix)
    )
    free = np.maximum((spoken - left) / old[1:] ** 2, FEWEST_FREE * spoken / old[1:] ** 2)
    # few smooth strains show, so that their size needs a prior: half a Cauchy distribution (Gelman 2006)
    free[1] += 2 * old[2] ** 2 / (old[2] ** 2 + USUAL_STRAIN**2)
    new = np.sqrt(np.append(_print_variance(terms, system, sizes), squares / free))
    # each such step goes only part of the way
    new = np.clip(old * (new / old) ** RELAXATION, old / LARGEST_CHANGE, old * LARGEST_CHANGE)
    return Sizes(*(float(x) for x in np.clip(new, LEAST_SIZES.values, LARGEST_SIZES.values)))


def _print_variance(terms: Terms, system: System, sizes: Sizes) -> float:
    """The variance of printing errors after a step of Fisher's scoring (Patterson and Thompson 1971), in mm^2."""
    weight, m = system.weight, system.residual.shape[1]
    turned = weight @ system.by_print
    # cell by cell, as a copy of its covariance for every target would cost more than the sums
    padded = np.concatenate([system.view.by_cell, np.zeros((1, m, system.view.by_cell.shape[2]))])[terms.in_cells]
    half = padded.reshape(len(padded), -1, padded.shape[3]) @ system.matrix.covariance_of_cells
    own = half.reshape(padded.shape) @ np.swapaxes(padded, 2, 3)
    left = np.zeros((len(turned) + 1, m, m))
    left[terms.in_cells] = own
    left = left[:-1]
    pull = (weight @ system.residual[..., None])[..., 0]
    score = np.einsum("ni,nij,nj->", pull, system.by_print, pull) - np.trace(turned, axis1=1, axis2=2).sum()
    score += np.einsum("nij,njk,nki->", turned, weight, left)
    fisher = np.einsum("nij,nji->", turned, turned)
    return max(sizes.print_mm**2 + float(score / max(fisher, 1e-300)), (sizes.print_mm / LARGEST_CHANGE) ** 2)


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
        index, place, tangent, covariance, response, by_place, by_turn, view.by_spread, system.residual - predicted_move, used,
        state.spread_mm(terms), sigma, sizes,
    )


def _by_own_motion(terms: Terms, place: Array, tangent: Array, spread_mm: float) -> tuple[Array, Array]:
    """Change (N, m, 3) of what is measured of each target by its own moves along the camera's axes, and by turns about its own axes."""
    if not terms.squares:
        _, by_point = terms.camera.project_with_point_jacobian(place)
        return by_point, np.zeros_like(by_point)
    axes = target_axes(tangent)
    corner = (tangent @ np.swapaxes((terms.half_mm + spread_mm)[:, None, None] * terms.nominal.offset, 1, 2)).swapaxes(1, 2)
    _, by_point = terms.camera.project_with_point_jacobian(place[:, None] + corner)
    turns = np.cross(np.swapaxes(axes, 1, 2)[:, None], corner[:, :, None])
    both = (np.einsum("mk,nkij->nmij", MEASURED, rows).reshape(len(place), 6, 3) for rows in (by_point, by_point @ np.swapaxes(turns, 2, 3)))
    return tuple(both)  # type: ignore[return-value]


def target_axes(tangent: Array) -> Array:
    """Rotations (N, 3, 3) camera_from_target of tangents (N, 3, 2): x along columns, z the normal."""
    x = tangent[..., 0] / np.linalg.norm(tangent[..., 0], axis=1, keepdims=True)
    normal = normal_of(tangent)
    return np.stack([x, np.cross(normal, x), normal], axis=-1)
