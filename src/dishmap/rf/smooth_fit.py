"""The smooth surface through uncertain values at places: Zernike terms with their covariance.

Values are a smooth field plus what each target does on its own. The field is a sum of a few broad terms, of which nothing is assumed, and
of a smooth random field; its amplitude and the size of the targets' own parts are learnt from the values by restricted marginal likelihood
(Patterson and Thompson 1971), and what several kinds of fields say is averaged with the weight of their likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize

from dishmap.errors import InputError
from dishmap.rf.smooth_terms import Terms, candidate_roots
from dishmap.surface.zernike import zernike_matrix

Array = NDArray[np.float64]

# What is never held back: rise and tilt, then also defocus, astigmatism and coma where targets are enough; each with the least number of
# targets for each of its terms, and the largest condition at which places tell them apart.
BROAD: tuple[Terms, ...] = (
    ((0, 0), (1, -1), (1, 1), (2, -2), (2, 0), (2, 2), (3, -1), (3, 1)),
    ((0, 0), (1, -1), (1, 1), (2, -2), (2, 0), (2, 2)),
    ((0, 0), (1, -1), (1, 1)),
)
TARGETS_PER_TERM, LARGEST_CONDITION = 2, 300.0
# Directions of the field that the places see less than this, relative to the best seen, are taken as unseen.
LEAST_SEEN = 1e-7
# Ranges of the logarithms of amplitude and own size, relative to the size of the values, and where the search starts.
AMPLITUDES, OWN = (-9.0, 5.0), (-12.0, 1.0)
STARTS = ((0.0, -2.0), (-1.0, -5.0))
# Hundredths of a nat do not matter.
PRECISION = {"ftol": 1e-5, "gtol": 0.03}
# Values that are all zero have this size in mm.
SMALLEST_MM = 1e-9
# Kinds of fields less likely than the best by this many nats do not count.
LEAST_LOG_WEIGHT = 7.0


@dataclass(frozen=True)
class Values:
    """Values (N,) in mm at places xy (N, 2) in radii, their errors with covariance factor factor^T + diag(own).

    factor (N, R) and own (N,) in mm^2; settled: they are what is thought of the values after all that was seen (a posterior), so that their
    mean is smoother than they are; otherwise measured values, which scatter by their errors.
    """

    xy: Array
    mean_mm: Array
    factor_mm: Array
    own_mm2: Array
    settled: bool


@dataclass(frozen=True)
class SmoothFit:
    """Coefficients (T,) of the field in mm and their covariance (T, T), with all that was learnt counted as known.

    own_mm: rms of what targets do on their own; response (T, N): of the coefficients to the values.
    """

    mean_mm: Array
    covariance_mm2: Array
    own_mm: float
    response: Array


def fit_smooth(values: Values, terms: Terms, finest: float) -> SmoothFit:
    """The field through values; terms: all up to some degree; finest: distance in radii over which places can tell anything.

    Raises InputError for places that do not tell a tilt from a rise.
    """
    broad = _broad(values.xy, terms)
    at = zernike_matrix(terms, *values.xy.T)
    views = [_View(values, at, broad, root) for root in candidate_roots(terms, finest)]
    fits: list[tuple[float, float, float]] = []
    start = STARTS[0]
    for view in views:
        found, start = view.fit(start)
        fits.append(found)
    evidence = np.array([fit[0] for fit in fits])
    weight = np.where(evidence > evidence.max() - LEAST_LOG_WEIGHT, np.exp(evidence - evidence.max()), 0.0)
    weight /= weight.sum()
    parts = [(w, *view.field(a, v), v) for w, view, (_, a, v) in zip(weight, views, fits, strict=True) if w > 0]
    mean = np.sum([w * m for w, m, _, _, _ in parts], axis=0)
    covariance = np.sum([w * (c + np.outer(m - mean, m - mean)) for w, m, c, _, _ in parts], axis=0)
    response = np.sum([w * r for w, _, _, r, _ in parts], axis=0)
    return SmoothFit(mean, covariance, float(np.sqrt(sum(w * v for w, _, _, _, v in parts))), response)


def _broad(xy: Array, terms: Terms) -> list[int]:
    """Places in `terms` of the broad terms that these places tell apart."""
    for some in BROAD:
        matrix = zernike_matrix(some, *xy.T)
        if len(xy) >= TARGETS_PER_TERM * len(some) and np.linalg.cond(matrix) < LARGEST_CONDITION:
            return [terms.index(term) for term in some]
    raise InputError(
        f"{len(xy)} targets lie so that they do not show a tilt of the surface; a shape needs at least {TARGETS_PER_TERM * len(BROAD[-1])} "
        "that are spread over the aperture"
    )


class _View:
    """One kind of field as the places see it, apart from the broad terms.

    The field is `spread @ (broad part, seen part) + unseen @ rest`, where the broad part is along an orthonormal basis of the broad
    terms at the places, and the seen part (variance a^2 each) is seen as `u * s` in what is left.
    """

    def __init__(self, values: Values, at: Array, broad: list[int], root: Array) -> None:
        self.values = values
        self.q, r = np.linalg.qr(at[:, broad])
        seen = at @ root
        along = self.q.T @ seen
        u, s, vt = np.linalg.svd(seen - self.q @ along, full_matrices=False)
        keep = (s > LEAST_SEEN * s[0]) & (np.arange(len(s)) < len(at) - len(broad))
        self.u, self.s, self.v = u[:, keep], s[keep], vt[keep].T
        back = np.zeros((len(root), len(broad)))
        back[broad] = np.linalg.inv(r)
        apart = root - back @ along
        seen_part = apart @ self.v
        self.spread = np.concatenate([back, seen_part], axis=1)
        self.unseen = apart - seen_part @ self.v.T
        self.rest = len(at) - len(broad) - len(self.s)
        inside = values.factor_mm - self.q @ (self.q.T @ values.factor_mm)
        left = values.mean_mm - self.q @ (self.q.T @ values.mean_mm)
        free = 1 - (self.q**2).sum(axis=1)
        whole = (left**2).sum() + (inside**2).sum() * values.settled + (free * values.own_mm2).sum() * values.settled
        self.power = (self.u.T @ left) ** 2
        if values.settled:
            self.power += ((self.u.T @ inside) ** 2).sum(axis=1) + (self.u**2).T @ values.own_mm2
        self.rest_power = max(float(whole - self.power.sum()), 0.0) if self.rest else 0.0
        self.size_mm = max(float(np.sqrt(whole / len(at))), SMALLEST_MM)

    def fit(self, start: tuple[float, float]) -> tuple[tuple[float, float, float], tuple[float, float]]:
        """The most probable sizes: their log likelihood, amplitude in mm and variance of the targets' own parts in mm^2; and their logs.

        start: logs to begin with, such as those of a like kind of field.
        """
        loss = self._settled_loss if self.values.settled else self._measured_loss
        # a step costs nothing for settled values, so a second start guards against a lesser maximum
        starts = {start, *STARTS} if self.values.settled else {start}
        found = [minimize(loss, one, jac=True, method="L-BFGS-B", bounds=[AMPLITUDES, OWN], options=PRECISION) for one in sorted(starts)]
        best = min(found, key=lambda one: float(one.fun))
        amplitude, own = self._sizes(best.x)
        return (-float(best.fun), amplitude, own), (float(best.x[0]), float(best.x[1]))

    def _sizes(self, logs: Array) -> tuple[float, float]:
        return self.size_mm * float(np.exp(logs[0])), (self.size_mm * float(np.exp(logs[1]))) ** 2

    def _settled_loss(self, logs: Array) -> tuple[float, Array]:
        """Minus the expected log likelihood over all that the values may be, and its derivatives."""
        amplitude, own = self._sizes(logs)
        field = (amplitude * self.s) ** 2
        variance = field + own
        loss = 0.5 * float((self.power / variance + np.log(variance)).sum() + self.rest_power / own + self.rest * np.log(own))
        slope = (1 - self.power / variance) / variance
        by_own = float(slope.sum()) * own + self.rest - self.rest_power / own
        return loss, np.array([float((slope * field).sum()), by_own])

    def _measured_loss(self, logs: Array) -> tuple[float, Array]:
        """Minus the log likelihood of measured values, and its derivatives (by Fisher's identity)."""
        amplitude, own = self._sizes(logs)
        design, weight, root, mean = self._posterior(amplitude, own)
        inverse = solve_triangular(root, np.eye(len(root)), lower=True)
        seen = slice(self.q.shape[1], self.spread.shape[1])
        left = self.values.mean_mm - design @ mean
        prior = (mean[seen] ** 2).sum() / amplitude**2 + (mean[self.spread.shape[1] :] ** 2).sum()
        log_det = 2 * np.log(np.diag(root)).sum() - np.log(weight).sum() + 2 * len(self.s) * np.log(amplitude)
        loss = 0.5 * float((weight * left**2).sum() + prior + log_det)
        scatter = left**2 + ((inverse @ design.T) ** 2).sum(axis=0)
        by_own = own * float((weight - weight**2 * scatter).sum())
        power = float((mean[seen] ** 2).sum() + (inverse[:, seen] ** 2).sum())
        return loss, np.array([len(self.s) - power / amplitude**2, by_own])

    def _posterior(self, amplitude: float, own: float) -> tuple[Array, Array, Array, Array]:
        """Design (N, K) and weights (N,) of measured values; root of the precision (K, K) and mean (K,) of what they measure.

        That is the broad part, the seen part, and the errors that values share.
        """
        design = np.concatenate([self.q, self.u * self.s, self.values.factor_mm], axis=1)
        weight = 1 / (self.values.own_mm2 + own)
        prior = np.ones(design.shape[1])
        prior[: self.spread.shape[1]] = amplitude**-2
        prior[: self.q.shape[1]] = 0
        root = cholesky(design.T @ (design * weight[:, None]) + np.diag(prior), lower=True)
        return design, weight, root, cho_solve((root, True), design.T @ (weight * self.values.mean_mm))

    def field(self, amplitude: float, own: float) -> tuple[Array, Array, Array]:
        """Mean (T,) and covariance (T, T) of the coefficients for given sizes, and the response (T, N) of the mean to the values."""
        count = self.spread.shape[1]
        if self.values.settled:
            # of the field for given values, then over what the values may be
            share = (amplitude * self.s) ** 2 / ((amplitude * self.s) ** 2 + own)
            gain = np.concatenate([self.q, self.u * (share / self.s)], axis=1).T
            inner = np.diag(np.concatenate([np.full(self.q.shape[1], own), own * share / self.s**2]))
            shared = gain @ self.values.factor_mm
            inner += shared @ shared.T + (gain * self.values.own_mm2) @ gain.T
        else:
            design, weight, root, _ = self._posterior(amplitude, own)
            whole = cho_solve((root, True), np.eye(len(root)))[:count]
            inner, gain = whole[:, :count], whole @ (design * weight[:, None]).T
        unseen, response = amplitude * self.unseen, self.spread @ gain
        return response @ self.values.mean_mm, self.spread @ inner @ self.spread.T + unseen @ unseen.T, response
