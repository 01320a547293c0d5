"""Which corners and views a calibration leaves out or weighs down, by name and with the reason."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dishmap.camera import adjustment as ba
from dishmap.camera.board import BoardView
from dishmap.camera.bundle import Bundle
from dishmap.camera.problem import Problem
from dishmap.errors import MeasurementError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FEWEST_VIEWS = 3
# A view is left out when its rms is this many times the median view's, or when so many of its corners are outliers.
BAD_VIEW_RATIO, BAD_VIEW_OUTLIERS = 4.0, 0.25
# A view whose noise is over this many times that of the typical view is weighed down by the square of what is beyond. Views of one
# noise scatter by some 8 % (54 corners), so they keep their weight.
WEAK_VIEW_RATIO = 1.2
# A corner is an outlier beyond this many robust sigmas of its own view: Gaussian noise gets there once in 6e7 corners.
OUTLIER_SIGMAS = 6.0
MOST_ROUNDS = 20
CHECK_INPUT = "are corners and board in the same order, and all photographs by one camera with fixed focus and zoom?"


def screened(problem: Problem, bundle: Bundle, near: bool = False) -> tuple[Problem, Bundle, tuple[Mask, ...], Array, dict[str, str]]:
    """Least squares over what fits: views and corners that do not are left out, until the choice no longer changes.

    Returns the problem and bundle of the views kept, which corners of each are used, the weight of each view (V,), and name and
    reason of the views left out. near: the bundle is near the answer. Raises MeasurementError when fewer than 3 views fit together.
    """
    rejected: dict[str, str] = {}
    used: list[Mask] = []
    weight = np.ones(len(problem.views))
    for _ in range(MOST_ROUNDS):
        parts = residual_parts(problem, bundle)
        bad = _bad_views([view.name for view in problem.views], parts)
        keep = np.array([view.name not in bad for view in problem.views])
        rejected |= bad
        if keep.sum() < FEWEST_VIEWS:
            name, reason = next(iter(rejected.items()))
            raise MeasurementError(f"fewer than {FEWEST_VIEWS} of the views fit together (first left out: {name}, {reason}); {CHECK_INPUT}")
        before, used = used, [_inliers(part) for part, k in zip(parts, keep, strict=True) if k]
        weight = _view_weights([part for part, k in zip(parts, keep, strict=True) if k])
        problem = problem.of_views([view for view, k in zip(problem.views, keep, strict=True) if k])
        if not bad and len(before) == len(used) and all((a == b).all() for a, b in zip(before, used, strict=True)):
            break
        bundle = problem.solve(bundle.of_views(keep), corner_weights(used, weight), near=near)
    # the prior is only as weak as the noise is small, and the noise is known now
    return problem, problem.solve(bundle, corner_weights(used, weight), near=near), tuple(used), weight, rejected


def corner_weights(used: Sequence[Mask], view_weight: Array) -> Array:
    """Weight of each corner of all views (M,)."""
    return np.concatenate([u * w for u, w in zip(used, view_weight, strict=True)]).astype(float)


def residual_parts(problem: Problem, bundle: Bundle) -> list[Array]:
    """Residuals (N, 2) of each view."""
    corners = problem.corners(bundle)
    residuals = bundle.residuals(corners)
    return [residuals[s] for s in corners.slices]


def outlier_names(view: BoardView, used: Mask, residuals: Array) -> list[str]:
    """The corners of a view that were left out, in words: where on the board, and how far off."""
    return [
        f"({x:g}, {y:g}) mm, {np.hypot(*residuals[i]):.2g} px off"
        for i, (x, y) in ((i, view.board_mm[i, :2]) for i in np.flatnonzero(~used))
    ]


def _view_weights(parts: Sequence[Array]) -> Array:
    scales = np.array([ba.scale_px(part) for part in parts])
    weak = WEAK_VIEW_RATIO * np.median(scales)
    return np.asarray(np.minimum(1.0, (weak / scales) ** 2))


def _bad_views(names: Sequence[str], parts: Sequence[Array]) -> dict[str, str]:
    """Views that do not fit, with the reason, worst first; only the worst of them, as it spoils the others."""
    scales = np.array([ba.scale_px(part) for part in parts])
    outliers = np.array([1 - _inliers(part).mean() for part in parts])
    worst = int(np.argmax(scales))
    if scales[worst] > BAD_VIEW_RATIO * np.median(scales) or np.isinf(scales[worst]):
        size = f"{scales[worst]:.2g} px" if np.isfinite(scales[worst]) else "beyond all bounds"
        return {names[worst]: f"its residuals ({size}) are over {BAD_VIEW_RATIO:g} times those of the typical view"}
    worst = int(np.argmax(outliers))
    if outliers[worst] > BAD_VIEW_OUTLIERS:
        return {names[worst]: f"{outliers[worst]:.0%} of its corners are outliers"}
    return {}


def _inliers(residuals: Array) -> Mask:
    length = np.linalg.norm(residuals, axis=1)
    return np.asarray(np.isfinite(length) & (length <= OUTLIER_SIGMAS * ba.scale_px(residuals)))
