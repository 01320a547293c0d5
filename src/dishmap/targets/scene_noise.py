"""What all targets together say of the photograph: its noise, and how far normals stray from the pattern's surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.adjust import Adjusted, Priors
from dishmap.targets.solve import inverse_each, inverse_scaled

Array = NDArray[Any]

LEVELS = 12
# So many pixels are enough: they give a sigma to half a percent.
NOISE_PIXELS = 30000
# Grey levels between which the variance must differ clearly before a slope is used (2 = photon noise over 4:1 in light).
LEAST_RATIO = 1.3
ROBUST_TO_SIGMA = 1.4826
# A correlation under this is what white noise shows by chance in the pixels of a few targets.
LEAST_CORRELATION = 0.01
# A normal that the pixels pull farther than this from the surface, in sigmas of the prior, is left to the pixels.
STRAY_SIGMAS = 4.0
LEAST_NORMAL_SIGMA_RAD = np.radians(0.02)
SPREADS = 60


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


def noise_model(grey: list[Array], residual: list[Array], used: list[NDArray[Any]]) -> NoiseModel:
    """Fit the noise model to residuals of rings (M, n), as if noise were white: see `inflation_of`."""
    step = _odd_step(sum(g.size for g in grey), NOISE_PIXELS)
    kept = [(g.ravel()[::step], r.ravel()[::step], u.ravel()[::step]) for g, r, u in zip(grey, residual, used, strict=True)]
    kept = [(g, r, u & np.isfinite(r)) for g, r, u in kept]
    base, slope = _variance_line(np.concatenate([(g - r)[u] for g, r, u in kept]), np.concatenate([r[u] for _, r, u in kept]))
    return NoiseModel(base, slope, 1.0)


def _odd_step(size: int, most: int) -> int:
    """Every so many of `size` pixels are `most` or a few more; odd, as pixels come in blocks of four."""
    return max(1, size // most) | 1 if size > 2 * most else 1


def inflation_of(residual: list[Array], used: list[NDArray[Any]]) -> float:
    """Inflation of `NoiseModel` from residuals of rings (M, n) whose pixels come in 2x2 blocks of neighbours (see window)."""
    return _inflation([_correlations(r, u) for r, u in zip(residual, used, strict=True)])


def _variance_line(values: Array, errors: Array) -> tuple[float, float]:
    if not len(values):
        return 1.0, 0.0
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
    step = _odd_step(residual.size, NOISE_PIXELS)
    some = np.abs(residual.ravel()[::step][used.ravel()[::step]])
    scale = ROBUST_TO_SIGMA * np.median(some) if len(some) else 1.0
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


def free_tilt(fit: Adjusted, priors: Priors, expected: Array) -> tuple[Array, Array]:
    """Tilt (T, 2) of targets from the expected normals (T, 3), about their own axes, and its covariance from data alone.

    `priors` are those of the fit: what they say of the normals is taken out again.
    """
    posterior = inverse_scaled(fit.information)[:, 3:5, 3:5]
    tilt = _tilt(fit, expected)
    precision = priors.normal_sigma_rad[:, None, None] ** -2.0
    data = inverse_each(posterior) - precision * np.eye(2)
    data += 1e-9 * np.eye(2) * np.maximum(np.trace(data, axis1=1, axis2=2), 1e-3)[:, None, None]
    covariance = inverse_each(data)
    shift = (covariance @ _tilt(fit, priors.normal)[..., None])[..., 0] * precision[:, 0]
    return tilt + shift, covariance


def _tilt(fit: Adjusted, normal: Array) -> Array:
    """Turns (T, 2) about the targets' own x and y axes that take the given normals (T, 3) to the fitted ones."""
    tips = np.einsum("tji,tj->ti", fit.poses.rotation, normal)
    return np.stack([tips[:, 1], -tips[:, 0]], axis=1)


def normal_spread(tilt: Array, covariance: Array, widest_rad: float) -> float:
    """Standard deviation (rad, per axis) of true tilts about the surface, root mean square over all that the targets allow.

    Tilts (T, 2) are normal with covariance (T, 2, 2) (data) + spread^2; the few that stray far are held at 4 sigma, so that one bent
    corner does not loosen the whole surface. Where the data cannot tell a small spread from none, the likeliest one may be nothing
    while normals stray by more than the sigma that follows from it. So the variance is averaged over the likelihood, every spread up
    to `widest_rad` being as likely beforehand (Gelman 2006, Bayesian Analysis 1, 515).
    """
    good = np.isfinite(covariance).all(axis=(1, 2)) & (np.abs(tilt) < 2 * widest_rad).all(axis=1)
    if good.sum() < 4:
        return widest_rad
    values, vectors = np.linalg.eigh(covariance[good])
    along = np.einsum("tji,tj->ti", vectors, tilt[good])
    grid = np.geomspace(LEAST_NORMAL_SIGMA_RAD, widest_rad, SPREADS)
    variance = np.maximum(values[None], 1e-14) + grid[:, None, None] ** 2
    square = np.minimum(along[None] ** 2 / variance, STRAY_SIGMAS**2)
    likelihood = -0.5 * (square + np.log(variance)).sum(axis=(1, 2))
    # steps of the grid grow with the spread
    weight = np.exp(likelihood - likelihood.max()) * grid
    return float(np.sqrt((weight * grid**2).sum() / weight.sum()))
