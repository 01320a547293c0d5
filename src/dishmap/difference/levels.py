"""The paper's levels of noise filtering (section 5.1): level_0 is measured, level_(i+1) averages neighbouring level_i.

"The center of neighboring target's centers": places are averaged as values are, so that a field that is linear in the
places stays as it is. Averages that share members share their noise; it is carried along as a factor F, covariance F F^T.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, eye_array
from scipy.spatial import Delaunay, QhullError

from dishmap.errors import FitError, InputError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# A Delaunay triangulation joins points along the outline that are no neighbours, by edges longer than this many medians.
LONGEST_EDGE = 1.8


@dataclass(frozen=True)
class Estimates:
    """K estimates of one level.

    place (K, D); value (K,): NaN for an average without members; weight (K,), zero or more: how much it counts in the next
    average; noise (K, Q), dense or sparse: a factor of the covariance, or None where the noise is unknown.
    """

    place: Array
    value: Array
    weight: Array
    noise: Any

    def __len__(self) -> int:
        return len(self.value)


def level_0(place: ArrayLike, value: ArrayLike, weight: ArrayLike | None = None, noise: Any = None) -> Estimates:
    """Direct measurements `value` (K,) at `place` (K, D); weight (K,): equal by default.

    noise: a factor (K, Q) of their covariance, or None when unknown; independent sigmas are the factor `np.diag(sigma)`.
    Raises InputError for arrays that do not fit, NaN values that count, or weights that are negative or not finite.
    """
    at, v = np.asarray(place, dtype=float), np.asarray(value, dtype=float)
    w = np.ones(len(v)) if weight is None else np.asarray(weight, dtype=float)
    if v.ndim != 1 or at.ndim != 2 or len(at) != len(v) or w.shape != v.shape or (noise is not None and noise.shape[0] != len(v)):
        raise InputError(f"estimates need place (K, D), value (K,), weight (K,) and noise (K, Q), not {at.shape}, {v.shape}, {w.shape}")
    if not (np.isfinite(w).all() and (w >= 0).all()):
        raise InputError("the weights of estimates must be finite and not negative")
    if not np.isfinite(v[w > 0]).all():
        raise InputError("an estimate that counts is NaN or infinite; give it weight zero or leave it out")
    return Estimates(at, v, w, noise)


def average(estimates: Estimates, members: Any) -> Estimates:
    """Weighted averages over groups: members (G, K), dense or sparse, how much each estimate belongs to each group (0 or 1).

    A group's place, value and noise are averaged alike; its weight is the mean weight of those of its members that count.
    A group without any has NaN place and value, weight 0.
    """
    share = csr_array(members, dtype=float)
    if share.shape[1] != len(estimates):
        raise InputError(f"members must have a column for each of the {len(estimates)} estimates, not shape {share.shape}")
    share = csr_array(share * estimates.weight[None, :])
    share.eliminate_zeros()
    total, count = np.asarray(share.sum(axis=1)), np.diff(share.indptr)
    empty = total <= 0
    mean = share * (1 / np.where(empty, 1.0, total))[:, None]
    counts = estimates.weight > 0
    place = mean @ np.where(counts[:, None], estimates.place, 0.0)
    value = mean @ np.where(counts, estimates.value, 0.0)
    place[empty], value[empty] = np.nan, np.nan
    noise = None if estimates.noise is None else mean @ estimates.noise
    return Estimates(place, value, total / np.maximum(count, 1), noise)


def next_level(estimates: Estimates, pairs: Ints) -> Estimates:
    """Each estimate averaged with its neighbours: pairs (E, 2) of rows that are neighbours."""
    i, j = np.asarray(pairs, dtype=np.int64).reshape(-1, 2).T
    n = len(estimates)
    graph = csr_array((np.ones(len(i)), (i, j)), shape=(n, n))
    # a pair that is given twice, or both ways, is one pair
    return average(estimates, ((graph + graph.T + eye_array(n)) > 0).astype(float))


def level(estimates: Estimates, pairs: Ints, number: int) -> tuple[Estimates, ...]:
    """Levels 0 to `number`, level 0 being the estimates given, all over the same neighbours. Raises InputError for number < 0."""
    if number < 0:
        raise InputError(f"a level is 0 or more, not {number}")
    found = [estimates]
    for _ in range(number):
        found.append(next_level(found[-1], pairs))
    return tuple(found)


def covariance(estimates: Estimates) -> Array:
    """Covariance (K, K) of the values, correlations between averages counted; NaN where the noise is unknown."""
    if estimates.noise is None:
        return np.full((len(estimates), len(estimates)), np.nan)
    product = estimates.noise @ estimates.noise.T
    return np.asarray(product if isinstance(product, np.ndarray) else product.toarray())


def sigma(estimates: Estimates) -> Array:
    """Standard deviations (K,) of the values; NaN where the noise, or the value, is unknown."""
    if estimates.noise is None:
        return np.full(len(estimates), np.nan)
    square = estimates.noise**2 if isinstance(estimates.noise, np.ndarray) else estimates.noise.power(2)
    return np.where(np.isfinite(estimates.value), np.sqrt(np.asarray(square.sum(axis=1))), np.nan)


def delaunay_pairs(points: ArrayLike) -> Ints:
    """Neighbours (E, 2) among points (K, 2): edges of their Delaunay triangulation, without the long ones along the outline.

    Raises FitError when the points span no triangle.
    """
    at = np.asarray(points, dtype=float)
    if len(at) < 3:
        raise FitError(f"neighbours by a Delaunay triangulation need at least 3 points, not {len(at)}")
    try:
        corners = Delaunay(at).simplices
    except QhullError as error:
        raise FitError("the points lie on one line, so they have no Delaunay triangulation; give the neighbours as pairs") from error
    edges = np.unique(np.sort(corners[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2), axis=1), axis=0)
    length = np.linalg.norm(at[edges[:, 0]] - at[edges[:, 1]], axis=1)
    return np.asarray(edges[length <= LONGEST_EDGE * np.median(length)], dtype=np.int64)
