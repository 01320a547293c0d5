"""The joint estimate: one Gaussian posterior of everything that may have moved, from all targets of both photographs.

Linear model with Gaussian priors, so the posterior is exact for given sizes of the priors; the sizes that are not given (how far and how
smoothly the surface moved, how much it stretched) are those that make the photographs most probable (marginal likelihood), and what
several of them say is averaged with the weight of their probability (MacKay 1992, Bayesian interpolation).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky

from dishmap.difference.changes import LEAST_SHARE
from dishmap.difference.model import BLOCKS, LOCAL, Columns

Array = NDArray[Any]

# How far a target that moved on its own may rise, lean, and stretch with that.
LOOSE_MM, LOOSE_RAD, LOOSE_STRAIN = 10.0, 0.1, 2e-3
# How well targets on rigid parts keep their place on them.
STILL_MM = 1e-3
# Added to information that may be singular, as that on the turn of a lone ring: far below that of any photograph (per mm^2, per rad^2).
# On top comes LEAST_SHARE of what the pixels show best, below which there is only rounding.
LEAST_INFORMATION = 1e-9


@dataclass(frozen=True)
class Sizes:
    """Sigmas of the priors.

    normal_mm: smooth displacement along the normal; slide_strain: slide beyond what the way of following says, as a mean strain; rough_mm:
    rise of each target on its own; print_strain: of each print on its own; expansion (about its mean) and focal drift, per unit.
    """

    normal_mm: float
    slide_strain: float
    rough_mm: float
    print_strain: float
    expansion: float = 0.0
    focal: float = 0.0


@dataclass(frozen=True)
class Evidence:
    """Likelihoods of N targets, already weighted, and their columns.

    information (N, 6, 6) and score (N, 6) as in `TargetChanges`; constant: what the linearisation adds to the log-likelihood;
    rough_length_mm: size of local bumps; still (S,): places of targets on rigid parts; loose (N,): targets that may rise and lean on
    their own.
    """

    information: Array
    score: Array
    constant: float
    columns: Columns
    rough_length_mm: float
    still: Array
    loose: Array


@dataclass(frozen=True)
class Posterior:
    """Posterior of the coefficients for given sizes: mean (K,), covariance factor (K, K) with covariance = factor factor^T.

    log_evidence; local_mean (N, 6), local_by (N, 6, K): a target's own unknowns are local_mean + local_by (z - mean) with
    covariance local_covariance (N, 6, 6) on top.
    """

    sizes: Sizes
    mean: Array
    factor: Array
    log_evidence: float
    local_mean: Array
    local_by: Array
    local_covariance: Array


def _scales(columns: Columns, sizes: Sizes) -> Array:
    by_block = {
        "rigid": 1.0,
        "expansion": sizes.expansion,
        "focal": sizes.focal,
        "calibration": 1.0,
        "normal": sizes.normal_mm,
        "slide": sizes.slide_strain,
    }
    return np.array([by_block[name] for name in BLOCKS])[columns.block]


def _local_sigmas(evidence: Evidence, sizes: Sizes) -> Array:
    """Sigmas (N, 6) of each target's own rise, slopes and print strain."""
    unexplained = sizes.normal_mm**2 * evidence.columns.unexplained
    out = np.zeros((len(unexplained), LOCAL))
    out[:, 0] = unexplained[:, 0] + sizes.rough_mm**2
    out[:, 1:3] = (unexplained[:, 1] + (sizes.rough_mm / evidence.rough_length_mm) ** 2)[:, None]
    out[:, 3:] = sizes.print_strain**2
    out[:, 0] += np.where(evidence.loose, LOOSE_MM**2, 0.0)
    out[:, 1:3] += np.where(evidence.loose, LOOSE_RAD**2, 0.0)[:, None]
    out[:, 3:] += np.where(evidence.loose, LOOSE_STRAIN**2, 0.0)[:, None]
    out[evidence.still] = 0.0
    return np.sqrt(out)


@dataclass(frozen=True)
class _Reduced:
    """Normal equations of the coefficients with the targets' own unknowns eliminated; constants of the evidence."""

    normal: Array
    right: Array
    constant: float
    gain: Array
    inner: Array


def _reduce(evidence: Evidence, sizes: Sizes) -> _Reduced:
    half = _local_sigmas(evidence, sizes)
    scaled = evidence.columns.local * half[:, None]
    across = evidence.information @ scaled
    inner = np.eye(LOCAL) + np.swapaxes(scaled, 1, 2) @ across
    gain = np.linalg.solve(inner, np.swapaxes(across, 1, 2))
    pull = np.einsum("nij,ni->nj", scaled, evidence.score)
    own = np.linalg.solve(inner, pull[..., None])[..., 0]
    information = evidence.information - across @ gain
    score = evidence.score - np.einsum("nij,nj->ni", across, own)
    change = evidence.columns.change
    flat = change.reshape(-1, change.shape[-1])
    normal = flat.T @ (information @ change).reshape(flat.shape)
    normal += _held(evidence)
    constant = 0.5 * float((pull * own).sum()) - 0.5 * float(np.linalg.slogdet(inner)[1].sum())
    return _Reduced(
        normal, flat.T @ score.reshape(-1), constant, half[:, :, None] * gain, half[:, :, None] * np.linalg.inv(inner) * half[:, None]
    )


def _held(evidence: Evidence) -> Array | float:
    """Information (K, K) that targets on rigid parts do not leave their place on them."""
    if not len(evidence.still):
        return 0.0
    columns = evidence.columns
    own = columns.block >= BLOCKS.index("normal")
    flat = (columns.move[evidence.still] * own).reshape(-1, len(own)) / STILL_MM
    return np.asarray(flat.T @ flat)


def _log_evidence(evidence: Evidence, reduced: _Reduced, scale: Array) -> float:
    mean = evidence.columns.mean
    right = scale * (reduced.right - reduced.normal @ mean)
    system = scale[:, None] * reduced.normal * scale
    system[np.diag_indices_from(system)] += 1.0
    root = cholesky(system, lower=True, check_finite=False, overwrite_a=True)
    solved = cho_solve((root, True), right, check_finite=False)
    known = float(reduced.right @ mean - 0.5 * mean @ reduced.normal @ mean)
    return evidence.constant + reduced.constant + known + 0.5 * float(right @ solved) - float(np.log(np.diagonal(root)).sum())


def log_evidence(evidence: Evidence, sizes: Sizes) -> float:
    """Log of the probability of both photographs for given sizes, up to a constant that depends on the photographs alone."""
    return _log_evidence(evidence, _reduce(evidence, sizes), _scales(evidence.columns, sizes))


def posterior(evidence: Evidence, sizes: Sizes) -> Posterior:
    """Posterior of the coefficients and of each target's own unknowns for given sizes of the priors."""
    columns, scale = evidence.columns, _scales(evidence.columns, sizes)
    reduced = _reduce(evidence, sizes)
    system = np.eye(len(scale)) + scale[:, None] * reduced.normal * scale
    root = cholesky(system, lower=True, check_finite=False)
    right = scale * (reduced.right - reduced.normal @ columns.mean)
    mean = columns.mean + scale * cho_solve((root, True), right, check_finite=False)
    factor = scale[:, None] * np.linalg.solve(root, np.eye(len(scale))).T
    # own unknowns: l = D B^T (score - J change z) with D their posterior covariance
    by_score = reduced.inner @ np.swapaxes(columns.local, 1, 2)
    left = evidence.score - np.einsum("nij,njk,k->ni", evidence.information, columns.change, mean, optimize=True)
    return Posterior(
        sizes=sizes,
        mean=mean,
        factor=factor,
        log_evidence=_log_evidence(evidence, reduced, scale),
        local_mean=np.einsum("nij,nj->ni", by_score, left),
        local_by=-by_score @ (evidence.information @ columns.change),
        local_covariance=reduced.inner,
    )


# Sizes are learnt between these; the first number is where the search starts and where its broad prior has its middle.
RANGES = {
    "normal_mm": (0.05, 1e-5, 50.0),
    "slide_strain": (1e-6, 1e-8, 1e-1),
    "rough_mm": (3e-4, 1e-6, 10.0),
    "print_strain": (1e-6, 1e-8, 1e-1),
}
# Width of that prior and the largest step (e-folds).
PRIOR_FOLDS, LARGEST_FOLDS = 4.0, 2.0
# Settled: another step changes the log evidence by less than this, and no coefficient by more than this share of its sigma.
SETTLED_NATS, SETTLED_SIGMAS = 0.5, 0.15
LEARN_STEPS = 40
# Steps converge at least geometrically: what is left to gain is less than this many times the last gain.
STEPS_AHEAD = 20.0


@dataclass(frozen=True)
class Learnt:
    """Sizes that make the photographs most probable, the posterior there, log evidence with the sizes' prior, and whether it settled."""

    posterior: Posterior
    log_weight: float
    converged: bool


def learn_sizes(
    evidence_at: Callable[[Posterior | None], Evidence],
    start: Sizes,
    names: Sequence[str],
    largest: Mapping[str, float],
    beat: float = -np.inf,
) -> Learnt:
    """Learn the sizes called `names`, none larger than `largest` says.

    evidence_at gives the evidence linearised at a posterior, or at rest for None. The search is given up when it will not reach a log
    evidence of `beat`.

    With unit-variance coefficients z of a block of size s, d log evidence / d log s = sum of (E[z^2] - 1) and its second derivative is
    about -2 (number of coefficients that the photographs determine): Newton steps in log s (MacKay 1992). The columns are linearised
    anew in each step.
    """
    sizes, evidence = start, evidence_at(None)
    found, settled = posterior(evidence, sizes), False
    for _ in range(LEARN_STEPS):
        after = {n: getattr(sizes, n) * np.exp(step) for n, step in _steps(evidence, found, names).items()}
        sizes = replace(sizes, **{n: _clipped(n, value, largest) for n, value in after.items()})
        evidence = evidence_at(found)
        before, found = found, posterior(evidence, sizes)
        settled = abs(found.log_evidence - before.log_evidence) < SETTLED_NATS and _moved(before, found) < SETTLED_SIGMAS
        gain = found.log_evidence - before.log_evidence
        if settled or not np.isfinite(gain) or found.log_evidence + STEPS_AHEAD * abs(gain) < beat:
            break
    return Learnt(found, found.log_evidence - penalty(found.sizes, names), settled)


def penalty(sizes: Sizes, names: Sequence[str]) -> float:
    """What the broad log-normal prior of the learnt sizes takes off the log evidence."""
    return float(sum(0.5 * (np.log(getattr(sizes, n) / RANGES[n][0]) / PRIOR_FOLDS) ** 2 for n in names))


def _clipped(name: str, value: float, largest: Mapping[str, float]) -> float:
    _, low, high = RANGES[name]
    return float(np.clip(value, low, min(high, largest.get(name, high))))


def _moved(a: Posterior, b: Posterior) -> float:
    """Largest change of a coefficient, in its sigmas."""
    sigma = np.sqrt((b.factor**2).sum(axis=1))
    return float((np.abs(a.mean - b.mean) / np.maximum(sigma, 1e-300))[sigma > 0].max(initial=0.0))


def _steps(evidence: Evidence, at: Posterior, names: Sequence[str]) -> dict[str, float]:
    """Newton steps of the logarithms of the sizes."""
    sums = _second_moments(evidence, at, names)
    out = {}
    for name in names:
        gain, determined = sums[name]
        away = np.log(getattr(at.sizes, name) / RANGES[name][0])
        slope = gain - away / PRIOR_FOLDS**2
        out[name] = float(np.clip(slope / (2 * max(determined, 0.0) + PRIOR_FOLDS**-2), -LARGEST_FOLDS, LARGEST_FOLDS))
    return out


def misfit(evidence: Evidence, at: Posterior) -> Array:
    """Chi-square (N,) of each target's change against what the coefficients say, whatever rise and stretch of its own its prior allows.

    Targets that had no weight in the posterior are judged like the others.
    """
    left = evidence.score - np.einsum("nij,nj->ni", evidence.information, evidence.columns.change @ at.mean)
    half = _local_sigmas(evidence, at.sizes)
    scaled = evidence.columns.local * half[:, None]
    inner = np.eye(LOCAL) + np.swapaxes(scaled, 1, 2) @ evidence.information @ scaled
    pull = np.einsum("nij,ni->nj", scaled, left)
    least = LEAST_INFORMATION + LEAST_SHARE * np.diagonal(evidence.information, axis1=1, axis2=2).max(axis=1)
    regular = evidence.information + least[:, None, None] * np.eye(LOCAL)
    whole = np.einsum("ni,ni->n", left, np.linalg.solve(regular, left[..., None])[..., 0])
    return np.asarray(whole - np.einsum("ni,ni->n", pull, np.linalg.solve(inner, pull[..., None])[..., 0]))


def determined(evidence: Evidence, at: Posterior) -> float:
    """Number of coefficients that the photographs determine."""
    scale = _scales(evidence.columns, at.sizes)
    free = scale > 0
    return float((1 - (at.factor[free] ** 2).sum(axis=1) / scale[free] ** 2).sum())


def _second_moments(evidence: Evidence, at: Posterior, names: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Sum of E[z^2] - 1 and the number of determined coefficients, for each size that can be learnt."""
    columns, sizes = evidence.columns, at.sizes
    variance = (at.factor**2).sum(axis=1)
    away = at.mean - columns.mean
    out: dict[str, tuple[float, float]] = {}
    for name, block in (("normal_mm", "normal"), ("slide_strain", "slide")):
        rows, size = columns.block == BLOCKS.index(block), getattr(sizes, name)
        if name in names:
            second = (away[rows] ** 2 + variance[rows]).sum() / size**2
            out[name] = float(second - rows.sum()), float(rows.sum() - variance[rows].sum() / size**2)
    # one large product: many small ones would take three times as long
    by = at.local_by.reshape(-1, at.local_by.shape[-1]) @ at.factor
    spread = np.einsum("rk,rk->r", by, by).reshape(-1, LOCAL) + np.diagonal(at.local_covariance, axis1=1, axis2=2)
    prior = _local_sigmas(evidence, sizes) ** 2
    ratio = (at.local_mean**2 + spread) / np.maximum(prior, 1e-300) - 1
    known = 1 - spread / np.maximum(prior, 1e-300)
    own, smooth = np.zeros_like(prior), np.zeros_like(prior)
    own[:, 0] = sizes.rough_mm**2
    own[:, 1:3] = (sizes.rough_mm / evidence.rough_length_mm) ** 2
    smooth[:, :1], smooth[:, 1:3] = (sizes.normal_mm**2 * columns.unexplained[:, k : k + 1] for k in (0, 1))
    own[evidence.still] = smooth[evidence.still] = 0.0
    for name, part in (("rough_mm", own), ("normal_mm", smooth)):
        share = part / np.maximum(prior, 1e-300)
        before = out.get(name, (0.0, 0.0))
        out[name] = before[0] + float((ratio * share).sum()), before[1] + float((known * share**2).sum())
    out["print_strain"] = (float(ratio[:, 3:].sum()), float(known[:, 3:].sum()))
    return out
