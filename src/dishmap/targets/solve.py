"""Many small linear systems at once, made from columns and solved; any may be singular: that one gets no answer, the others theirs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
# Of a square in single precision: smaller ones are nothing.
LEAST_SQUARE = 1e-30


def products(columns: NDArray[Any], alike: Sequence[int] = ()) -> Array:
    """Products (M, K, K) of columns (M, K, n) with each other, in single precision but for columns that are nearly multiples of each other.

    What tells such columns apart, data or a prior, may be less than the rounding of their products, and the normal matrix then not be
    positive. So of those numbered `alike` each is set apart from the ones before it (modified Gram-Schmidt, in place: `columns` are not to
    be used afterwards), and the products are put together again in double precision.
    """
    taken = []
    for place, later in enumerate(alike):
        for first in alike[:place]:
            one, other = columns[:, first], columns[:, later]
            factor = np.einsum("mn,mn->m", one, other) / np.maximum(np.einsum("mn,mn->m", one, one), LEAST_SQUARE)
            other -= factor[:, None] * one
            taken.append((later, first, factor[:, None].astype(float)))
    out = np.empty((len(columns), columns.shape[1], columns.shape[1]))
    # not a product of one array with itself, for which a routine is called that is several times slower on small matrices
    out[:, :-1] = columns[:, :-1] @ np.swapaxes(columns, 1, 2)
    out[:, -1, :-1] = out[:, :-1, -1]
    out[:, -1, -1] = np.einsum("mn,mn->m", columns[:, -1], columns[:, -1])
    for later, first, factor in reversed(taken):
        out[:, later] += factor * out[:, first]
        out[:, :, later] += factor * out[:, :, first]
    return out


def solve_each(matrix: Array, right: Array) -> Array:
    """Solve (M, G, G) x = (M, G, V); zeros where a system is singular or its answer is not finite."""
    out = _solved(matrix, right)
    # a sum tells of any NaN or infinity in one pass
    return out if np.isfinite(out.sum()) else np.where(np.isfinite(out).all(axis=(1, 2), keepdims=True), out, 0.0)


def _solved(matrix: Array, right: Array) -> Array:
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        if len(matrix) == 1:
            return np.zeros_like(right)
        # halves, down to the singular ones
        half = len(matrix) // 2
        return np.concatenate([_solved(matrix[:half], right[:half]), _solved(matrix[half:], right[half:])])


def inverse_each(matrix: Array) -> Array:
    """Inverse (M, G, G) of matrices; zeros where a matrix is singular or not finite."""
    return solve_each(matrix, np.broadcast_to(np.eye(matrix.shape[-1]), matrix.shape))


def solve_scaled(matrix: Array, right: Array) -> Array:
    """Solve (T, G, G) x = (T, G) after scaling to unit diagonal; a singular or NaN system gives zeros."""
    scaled, scale = _scaled(matrix)
    answer = solve_each(scaled + 1e-12 * np.eye(matrix.shape[-1]), (right * scale)[..., None])[..., 0] * scale
    return np.asarray(np.where(np.isfinite(answer).all(axis=1, keepdims=True), answer, 0.0))


def inverse_scaled(matrix: Array) -> Array:
    """Inverse (T, G, G) of positive definite matrices after scaling to unit diagonal; NaN where singular or not finite."""
    scaled, scale = _scaled(matrix)
    out = inverse_each(scaled + 1e-13 * np.eye(matrix.shape[-1])) * scale[:, :, None] * scale[:, None, :]
    # a variance is positive: zeros stand for no answer
    out[~(np.diagonal(out, axis1=1, axis2=2) > 0).all(axis=1)] = np.nan
    return out


def _scaled(matrix: Array) -> tuple[Array, Array]:
    """Matrices scaled to unit diagonal, and the scale (T, G) of their rows and columns."""
    scale = 1 / np.sqrt(np.maximum(np.diagonal(matrix, axis1=1, axis2=2), 1e-300))
    return matrix * scale[:, :, None] * scale[:, None, :], scale
