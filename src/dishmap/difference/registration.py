"""The paper's 2D registration (Algorithm 3, step 2): reference centres laid over the current ones.

A similarity takes the reference to the current image: turn, shift and scale are what a moved camera and a common change of
distance do, and what is left over is the surface's. It is fitted by Algorithm 4 (bisquare weights), so that a target that
moved on its own does not pull the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.errors import FitError, InputError
from dishmap.robust import robust_linear_fit

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Two points always fit a similarity exactly; the third is the first that can disagree.
FEWEST_TARGETS = 3


@dataclass(frozen=True)
class Registration:
    """A similarity p -> matrix p + shift_px from the reference to the current image; T common targets.

    ids (T,): common to both, ascending; reference_row, current_row (T,): where they stand in what was given; matrix (2, 2) =
    scale times a rotation by rotation_rad (from x towards y); shift_px (2,); covariance (4, 4): of (log scale, rotation_rad and
    the shift of the middle of the reference points, x and y), from the scatter of the residuals; registered_px (T, 2): the
    reference laid over the current image, the paper's P'; residual_px (T, 2): current minus registered; weights (T,): bisquare,
    the smaller of the two axes'; sigma_px: robust standard deviation of a residual coordinate; converged: of the reweighting.
    """

    ids: Ints
    reference_row: Ints
    current_row: Ints
    matrix: Array
    shift_px: Array
    scale: float
    rotation_rad: float
    covariance: Array
    registered_px: Array
    residual_px: Array
    weights: Array
    sigma_px: float
    converged: bool


def register(reference_ids: ArrayLike, reference_px: ArrayLike, current_ids: ArrayLike, current_px: ArrayLike) -> Registration:
    """Register reference centres (N, 2) to current ones (K, 2) by the ids (N,), (K,) they share.

    Any unit of length will do in place of pixels. Raises InputError for arrays that do not fit, ids given twice or numbers that are
    not finite; FitError for fewer than 3 common targets, or targets that all lie in one place.
    """
    ref_ids, ref = _checked("reference", reference_ids, reference_px)
    cur_ids, cur = _checked("current", current_ids, current_px)
    ids, row, current_row = np.intersect1d(ref_ids, cur_ids, assume_unique=True, return_indices=True)
    if len(ids) < FEWEST_TARGETS:
        raise FitError(
            f"the two images have {len(ids)} targets in common; a registration needs at least {FEWEST_TARGETS}: "
            "check that both show the same pattern under the same ids"
        )
    p, q = ref[row], cur[current_row]
    middle, reach = p.mean(axis=0), float(np.std(p))
    x, y = ((p - middle) / (reach or 1.0)).T
    one, zero = np.ones(len(ids)), np.zeros(len(ids))
    # q - middle = [[a, -b], [b, a]] (x, y) + shift: linear in a, b and the shift
    design = np.concatenate([np.stack([x, -y, one, zero], axis=1), np.stack([y, x, zero, one], axis=1)])
    fit = robust_linear_fit(design, (q - middle).T.ravel())
    a, b = fit.coefficients[:2] / (reach or 1.0)
    matrix = np.array([[a, -b], [b, a]])
    scale = float(np.hypot(a, b))
    # d(log scale, rotation) / d(a, b)
    polar = np.array([[a, b], [-b, a]]) / scale**2 / (reach or 1.0)
    by = np.block([[polar, np.zeros((2, 2))], [np.zeros((2, 2)), np.eye(2)]])
    shift = middle + fit.coefficients[2:] - matrix @ middle
    return Registration(
        ids=ids,
        reference_row=row.astype(np.int64),
        current_row=current_row.astype(np.int64),
        matrix=matrix,
        shift_px=shift,
        scale=scale,
        rotation_rad=float(np.arctan2(b, a)),
        covariance=by @ fit.covariance @ by.T,
        registered_px=p @ matrix.T + shift,
        residual_px=fit.residuals.reshape(2, -1).T,
        weights=fit.weights.reshape(2, -1).min(axis=0),
        sigma_px=fit.spread,
        converged=fit.converged,
    )


def _checked(which: str, ids: ArrayLike, points: ArrayLike) -> tuple[Ints, Array]:
    number, xy = np.asarray(ids, dtype=np.int64), np.asarray(points, dtype=float)
    if number.ndim != 1 or xy.shape != (len(number), 2):
        raise InputError(f"the {which} needs ids (N,) and as many centres (N, 2), not {number.shape} and {xy.shape}")
    if np.unique(number).size != len(number):
        raise InputError(f"the ids of the {which} must differ")
    if not np.isfinite(xy).all():
        raise InputError(f"the centres of the {which} hold NaN or infinity; leave those targets out")
    return number, xy
