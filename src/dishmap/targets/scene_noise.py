"""What the residuals of all targets together say of the photograph's noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

LEVELS = 12
# Grey levels between which the variance must differ clearly before a slope is used (2 = photon noise over 4:1 in light).
LEAST_RATIO = 1.3
ROBUST_TO_SIGMA = 1.4826
# A correlation under this is what white noise shows by chance in the pixels of a few targets.
LEAST_CORRELATION = 0.01


@dataclass(frozen=True)
class NoiseModel:
    """Noise of a photograph: variance = base + slope * grey level, in grey levels squared.

    inflation: how much correlation between neighbouring pixels (JPEG, demosaicing, resampling) enlarges the variance of
    anything that averages over many pixels; 1 for white noise.
    """

    base: float
    slope: float
    inflation: float

    def variance(self, grey: Array) -> Array:
        """Variance (grey levels squared) of one pixel at grey level `grey`."""
        return np.maximum(self.base + self.slope * np.maximum(grey, 0), 1e-6)


def noise_model(grey: list[Array], residual: list[Array], used: list[NDArray[Any]], blocks: list[bool]) -> NoiseModel:
    """Fit the noise model to residuals of rings (M, n); `blocks`: pixels come in 2x2 blocks of neighbours (see window)."""
    values = np.concatenate([(g - r)[u] for g, r, u in zip(grey, residual, used, strict=True)])
    errors = np.concatenate([r[u] for r, u in zip(residual, used, strict=True)])
    keep = slice(None, None, max(1, len(values) // 60000))
    base, slope = _variance_line(values[keep], errors[keep])
    pairs = [_correlations(r, u) for r, u, b in zip(residual, used, blocks, strict=True) if b]
    return NoiseModel(base, slope, _inflation(pairs))


def _variance_line(values: Array, errors: Array) -> tuple[float, float]:
    edges = np.quantile(values, np.linspace(0, 1, LEVELS + 1))
    which = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, LEVELS - 1)
    level, variance = [], []
    for k in range(LEVELS):
        inside = which == k
        if inside.sum() >= 30:
            level.append(values[inside].mean())
            variance.append((ROBUST_TO_SIGMA * np.median(np.abs(errors[inside]))) ** 2)
    overall = max(float((ROBUST_TO_SIGMA * np.median(np.abs(errors))) ** 2), 1e-3)
    if len(level) < 4:
        return overall, 0.0
    # the lowest and highest levels are flat ink and ground; those between are edges, where misfit adds to noise
    dark, light = float(np.median(variance[:2])), float(np.median(variance[-2:]))
    low, high = float(np.mean(level[:2])), float(np.mean(level[-2:]))
    if not (light > LEAST_RATIO * dark and high > low):
        return overall, 0.0
    slope = (light - dark) / (high - low)
    base = max(dark - slope * low, 0.05 * dark)
    return max(base, 1e-3), slope


def _correlations(residual: Array, used: NDArray[Any]) -> tuple[float, float, float]:
    """Correlation of residuals between horizontal, vertical and diagonal neighbours within blocks of 2x2."""
    scale = ROBUST_TO_SIGMA * np.median(np.abs(residual[used])) if used.any() else 1.0
    clipped = np.where(used & (np.abs(residual) < 4 * scale), residual, 0.0).reshape(len(residual), -1, 4)
    whole = (clipped != 0).all(axis=2)
    r = clipped[whole]
    square = max(float((r * r).mean()), 1e-30) if len(r) else 1.0
    if len(r) < 100:
        return 0.0, 0.0, 0.0
    horizontal = 0.5 * ((r[:, 0] * r[:, 1]).mean() + (r[:, 2] * r[:, 3]).mean()) / square
    vertical = 0.5 * ((r[:, 0] * r[:, 2]).mean() + (r[:, 1] * r[:, 3]).mean()) / square
    diagonal = 0.5 * ((r[:, 0] * r[:, 3]).mean() + (r[:, 1] * r[:, 2]).mean()) / square
    return float(horizontal), float(vertical), float(diagonal)


def _inflation(pairs: list[tuple[float, float, float]]) -> float:
    """Sum of the autocorrelation over all lags, for correlations that fall off geometrically along each axis."""
    if not pairs:
        return 1.0
    horizontal, vertical, _ = np.mean(pairs, axis=0)
    factor = 1.0
    for rho in (horizontal, vertical):
        rho = min(max(rho, 0.0), 0.8)
        if rho > LEAST_CORRELATION:
            factor *= (1 + rho) / (1 - rho)
    return float(factor)
