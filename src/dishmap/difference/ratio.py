"""The paper's ratio map (Algorithm 3, steps 3 to 5): how much nearer together two targets stand in the current image.

A pair at depth z with a length L across the line of sight is f L / z px long in the image, so d(p*) / d(p') = z' / z*. Pairs
are the entries of the map; each sits at its mid-point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from dishmap.errors import InputError
from dishmap.robust import TUNING, bisquare_weights, mad_scale

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bool = NDArray[np.bool_]

# The gate on a ratio: 2 % of the distance between two targets, 20 mm of depth at 1 m, is no change of one surface but a
# wrong name or a wrong centre.
EPSILON = 0.02
# Consistency is not judged below this: exact centres differ by rounding only.
SMALLEST_SCALE_PX = 1e-6


@dataclass(frozen=True)
class RatioMap:
    """Ratios of M pairs among T targets.

    pair (M, 2): rows of the two targets, the smaller first; mid_px (M, 2): mid-point in the registered reference; mid_mm
    (M, 2): mid-point on the nominal surface, or None; step_reference_px, step_current_px (M, 2): from the first target to
    the second; ratio (M,): d(p*) / d(p'); epsilon, used (M,): whether the ratio is within 1 - epsilon to 1 + epsilon; noise
    (M, 4T), sparse: d log ratio by independent unit normal variables, two for each target in the reference and then two for
    each in the current image, or None where the centres' noise is unknown; sigma_ratio (M,): NaN then.
    """

    pair: Ints
    mid_px: Array
    mid_mm: Array | None
    step_reference_px: Array
    step_current_px: Array
    ratio: Array
    epsilon: float
    used: Bool
    noise: Any
    sigma_ratio: Array

    def __len__(self) -> int:
        return len(self.pair)

    @property
    def distance_px(self) -> Array:
        """d(p') (M,), in the registered reference."""
        return np.hypot(*self.step_reference_px.T)


def pairs_within(points: ArrayLike, reach: float | None = None) -> Ints:
    """Pairs (M, 2) of points (T, D) no farther apart than `reach`; all pairs, as Algorithm 3 is written, without it."""
    at = np.asarray(points, dtype=float)
    if reach is not None:
        return np.unique(np.sort(cKDTree(at).query_pairs(reach, output_type="ndarray").astype(np.int64), axis=1), axis=0)
    return np.stack(np.triu_indices(len(at), 1), axis=1).astype(np.int64)


def ratio_map(
    registered_px: ArrayLike,
    current_px: ArrayLike,
    pair: Ints,
    *,
    place_mm: ArrayLike | None = None,
    reference_covariance_px2: ArrayLike | None = None,
    current_covariance_px2: ArrayLike | None = None,
    epsilon: float = EPSILON,
) -> RatioMap:
    """Ratios of pairs (M, 2) between registered reference centres and current ones, both (T, 2).

    place_mm (T, 2): where the targets sit on the nominal surface. Covariances (T, 2, 2) of the centres in the frames given; both
    or none. Raises InputError for arrays that do not fit, an epsilon outside (0, 1) or two targets in one place.
    """
    p, q = np.asarray(registered_px, dtype=float), np.asarray(current_px, dtype=float)
    if p.shape != q.shape or p.ndim != 2 or p.shape[1] != 2:
        raise InputError(f"a ratio map needs reference and current centres of one shape (T, 2), not {p.shape} and {q.shape}")
    if not 0 < epsilon < 1:
        raise InputError(f"the gate epsilon on a ratio must lie between 0 and 1, not {epsilon}")
    i, j = np.asarray(pair, dtype=np.int64).reshape(-1, 2).T
    before, now = p[j] - p[i], q[j] - q[i]
    length, length_now = np.hypot(*before.T), np.hypot(*now.T)
    if not (length > 0).all() or not np.isfinite(length_now).all():
        raise InputError("two targets of a pair lie in one place, or a centre is not finite; leave them out")
    ratio = length_now / length
    noise = _noise(i, j, before, now, reference_covariance_px2, current_covariance_px2, len(p))
    place = None if place_mm is None else np.asarray(place_mm, dtype=float)
    return RatioMap(
        pair=np.stack([i, j], axis=1),
        mid_px=(p[i] + p[j]) / 2,
        mid_mm=None if place is None else (place[i] + place[j]) / 2,
        step_reference_px=before,
        step_current_px=now,
        ratio=ratio,
        epsilon=epsilon,
        used=np.abs(ratio - 1) <= epsilon,
        noise=noise,
        sigma_ratio=np.full(len(i), np.nan) if noise is None else ratio * np.sqrt(noise.power(2).sum(axis=1)),
    )


def _noise(i: Ints, j: Ints, before: Array, now: Array, reference: ArrayLike | None, current: ArrayLike | None, count: int) -> Any:
    """Rows of d log ratio = e*.(dq_j - dq_i) / d* - e'.(dp_j - dp_i) / d', e being directions, times roots of the covariances."""
    if (reference is None) != (current is None):
        raise InputError("the noise of a ratio needs the covariances of both images, or of neither")
    if reference is None:
        return None
    entries, columns = [], []
    for step, covariance, first, sign in ((before, reference, 0, -1.0), (now, current, 2 * count, 1.0)):
        matrix = np.asarray(covariance, dtype=float)
        if matrix.shape != (count, 2, 2) or not np.isfinite(matrix).all():
            raise InputError(f"the centres' covariances must be finite and of shape {(count, 2, 2)}, not {matrix.shape}")
        values, vectors = np.linalg.eigh(matrix)
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        by = sign * step / (step**2).sum(axis=1)[:, None]
        for end, side in ((j, 1.0), (i, -1.0)):
            entries.append(side * np.einsum("mk,mkc->mc", by, root[end]))
            columns.append(first + 2 * end[:, None] + np.arange(2))
    row = np.repeat(np.arange(len(i)), 8)
    return csr_array((np.hstack(entries).ravel(), (row, np.hstack(columns).ravel())), shape=(len(i), 4 * count))


def depth_sensitivity_per_mm(position_mm: Array, normal: Array, pair: Ints) -> Array:
    """Change of log d(p') by each end's displacement along the pair's mean normal (M, 2), by the text's d = f L / z.

    position_mm, normal (T, 3) in the camera frame. The depth is the mean of both ends', and both ends count alike.
    """
    i, j = pair.T
    depth = (position_mm[i, 2] + position_mm[j, 2]) / 2
    return np.repeat((-_mean_normal(normal, pair)[:, 2] / depth / 2)[:, None], 2, axis=1)


def normal_sensitivity_per_mm(position_mm: Array, normal: Array, pair: Ints) -> Array:
    """Change of log d(p') by each end's displacement along the pair's mean normal (M, 2), exact to first order.

    position_mm, normal (T, 3) in the camera frame. With q = (X / Z, Y / Z) of an end, e the pair's direction and d its length in
    those units, an end that moves by w along n moves in the image by w (n_xy - q n_z) / Z, and the distance by e times that.
    The sum of both ends is what a common displacement does; it is -n_z / Z for a pair of one depth. A pair in a tilted plane
    is foreshortened, and as it comes nearer its two ends also change their share: the sum holds both. Moving along one
    normal, and not each end along its own, keeps the printed distance: a foil bends far more easily than it stretches.
    """
    i, j = pair.T
    q = position_mm[:, :2] / position_mm[:, 2:]
    step = q[j] - q[i]
    n = _mean_normal(normal, pair)
    by = step / (step**2).sum(axis=1)[:, None]
    ends = [(by * (n[:, :2] - q[end] * n[:, 2:])).sum(axis=1) / position_mm[end, 2] for end in (i, j)]
    return np.stack([-ends[0], ends[1]], axis=1)


def _mean_normal(normal: Array, pair: Ints) -> Array:
    n = normal[pair].sum(axis=1)
    return np.asarray(n / np.linalg.norm(n, axis=1, keepdims=True))


def consistency(found: RatioMap) -> Array:
    """How well each ratio agrees with the pairs around it (M,): a bisquare weight, 0 outside the gate.

    A ratio is compared with the mean of two medians: those of all pairs that share its first, and its second, target. The
    deviation, times the pair's length, is in pixels and so the same for short and long pairs; it is judged against the MAD
    of all of them, with the constants of Algorithm 4.
    """
    weight = np.zeros(len(found))
    if not found.used.any():
        return weight
    value, pair, length = np.log(found.ratio[found.used]), found.pair[found.used], found.distance_px[found.used]
    middle = np.full(int(found.pair.max()) + 1, np.nan)
    owner, both = pair.ravel(), np.repeat(value, 2)
    order = np.argsort(owner, kind="stable")
    target, first = np.unique(owner[order], return_index=True)
    for number, group in zip(target, np.split(both[order], first[1:]), strict=True):
        middle[number] = np.median(group)
    deviation = (value - middle[pair].mean(axis=1)) * length
    weight[found.used] = bisquare_weights(deviation / (TUNING * max(mad_scale(deviation), SMALLEST_SCALE_PX)))
    return weight
