"""Symmetric block-tridiagonal systems: factor, solve, log-determinant, and the blocks of the inverse beside the diagonal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

Array = NDArray[Any]


@dataclass(frozen=True)
class Blocks:
    """A symmetric matrix of M x M blocks: diagonal (M, S, S), and below (M - 1, S, S), block (k + 1, k)."""

    diagonal: Array
    below: Array

    @property
    def size(self) -> int:
        """Rows of the whole matrix."""
        return self.diagonal.shape[0] * self.diagonal.shape[1]


@dataclass(frozen=True)
class Factor:
    """The lower Cholesky factor of `Blocks`, in the same layout: diagonal blocks are lower triangular."""

    diagonal: Array
    below: Array

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the factored matrix."""
        return float(2 * np.log(np.diagonal(self.diagonal, axis1=1, axis2=2)).sum())

    def solve(self, right: Array) -> Array:
        """The solution (M * S, K) for right-hand sides (M * S, K) or (M * S,)."""
        m, s = self.diagonal.shape[:2]
        x = right.reshape(m, s, -1).copy()
        for k in range(m):
            if k:
                x[k] -= self.below[k - 1] @ x[k - 1]
            x[k] = solve_triangular(self.diagonal[k], x[k], lower=True, check_finite=False)
        for k in reversed(range(m)):
            if k + 1 < m:
                x[k] -= self.below[k].T @ x[k + 1]
            x[k] = solve_triangular(self.diagonal[k], x[k], lower=True, trans=1, check_finite=False)
        return x.reshape(right.shape)

    def inverse(self) -> Blocks:
        """The blocks of the inverse on and beside the diagonal (Takahashi, Fagan and Chen 1973, by blocks)."""
        m, s = self.diagonal.shape[:2]
        diagonal, below = np.empty_like(self.diagonal), np.empty_like(self.below)
        for k in reversed(range(m)):
            own = solve_triangular(self.diagonal[k], np.eye(s), lower=True, check_finite=False)
            diagonal[k] = own.T @ own
            if k + 1 < m:
                ahead = self.below[k] @ own
                below[k] = -diagonal[k + 1] @ ahead
                diagonal[k] -= ahead.T @ below[k]
            diagonal[k] = 0.5 * (diagonal[k] + diagonal[k].T)
        return Blocks(diagonal, below)


def factor(matrix: Blocks) -> Factor:
    """Cholesky factor. Raises numpy.linalg.LinAlgError when the matrix is not positive definite."""
    diagonal, below = np.empty_like(matrix.diagonal), np.empty_like(matrix.below)
    for k in range(len(diagonal)):
        own = matrix.diagonal[k]
        if k:
            own = own - below[k - 1] @ below[k - 1].T
        diagonal[k] = cholesky(own, lower=True, check_finite=False)
        if k + 1 < len(diagonal):
            below[k] = solve_triangular(diagonal[k], matrix.below[k].T, lower=True, check_finite=False).T
    return Factor(diagonal, below)
