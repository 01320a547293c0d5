"""How a sheet is solved: steps down to the best surface, and the sizes of printing errors, strain and roughness learnt on the way."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import MeasurementError
from dishmap.targets.grid_start import start_control
from dishmap.targets.grid_system import Sizes, State, System, priors_alone, system_at
from dishmap.targets.grid_terms import Terms

Array = NDArray[Any]
Flags = NDArray[np.bool_]

# What the rest of the way may lower chi-square by, the smallest part of a step that is tried, and the change of a size's logarithm at which
# learning ends.
SETTLED, LEAST_PART, LEARNT = 0.1, 1e-3, 0.15
# Width of the prior on smooth strains; most that a size changes by at a time. A step of learning goes only part of the way, so it
# is made so much longer.
USUAL_STRAIN, LARGEST_CHANGE, RELAXATION = 1e-4, 10.0, 1.4
# Least part of what a prior speaks of that is taken to be seen.
FEWEST_FREE = 0.02
# Sizes as learning begins; where that does not settle, looser ones before.
LOOSE_SIZES, FIRST_SIZES = Sizes(0.1, 1e-2, 1e-4, 0.1), Sizes(0.01, 1e-3, 1e-4, 0.02)
# Less than any photograph shows, and what rounding allows; a film that stretched smoothly by more than the largest would not stay smooth.
LEAST_SIZES, LARGEST_SIZES = Sizes(1e-5, 1e-5, 1e-7, 1e-5), Sizes(10.0, 0.1, 1e-3, 1e3)
FIRST_STEPS, STEPS, LEARN_ROUNDS = 12, 40, 20
# A target farther off than this many sigmas (of its noise, printing errors and what is left of the misfit of the others) is put aside.
OUTLIER_SIGMAS = 5.0
MOST_OUTLIERS = 0.3
# Median of chi-square with 2 and 6 degrees of freedom.
MEDIAN_CHI2 = {2: 1.386, 6: 5.348}


def learn(terms: Terms, tell: Callable[[int, int], None]) -> tuple[State, Sizes, Flags]:
    """A surface from scratch, the learnt sizes, and which targets fit."""
    shared = terms.strain_shapes.shape[2] + terms.squares
    start, sizes, used = State(start_control(terms), np.zeros(shared)), FIRST_SIZES, np.ones(len(terms.cell), bool)
    state, system, settled = descend(terms, start, sizes, used, FIRST_STEPS)
    if not settled:
        # a rough start: let it find its shape before it is held to its lengths
        state, _, _ = descend(terms, start, LOOSE_SIZES, used, STEPS)
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


def descend(terms: Terms, state: State, sizes: Sizes, used: Flags, steps: int) -> tuple[State, System, bool]:
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


def _tried(terms: Terms, state: State, sizes: Sizes, used: Flags) -> System | None:
    """The system at a state, None where there is none: points behind the camera, or out of the lens's field."""
    try:
        with np.errstate(all="ignore"):
            found = system_at(terms, state, sizes, used)
    except np.linalg.LinAlgError:
        return None
    return found if np.isfinite(found.cost) else None


def relearnt(terms: Terms, state: State, system: System, sizes: Sizes) -> Sizes:
    """Better sizes: one step towards the maximum of the marginal likelihood of the linearised problem.

    For a prior precision sum_k P_k / s_k^2 the maximum lies where s_k^2 = S_k / (n_k - g_k), S_k the sum of squares, n_k = tr(P^+ P_k) /
    s_k^2 the numbers that the prior speaks of and g_k = tr(H^-1 P_k) / s_k^2 those that the photograph leaves to it (MacKay 1992, eq.
    4.10). The printing error is stepped by Fisher's scoring of the restricted likelihood.
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
