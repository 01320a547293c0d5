"""The lattice seen in the photograph: around each node a polynomial map from lattice coordinates to pixels, and back.

Directions and curvatures of what is printed at a node come from where its neighbours lie, through whatever lens and surface. The map
is a polynomial of fourth degree through the up to 24 nodes within two steps; terms that the neighbours do not determine are held near
zero by a prior on smoothness, and the posterior says how well the slope and bend of a line through the node are known. The node itself
is left out, so that its own error does not bend its map.

Lattice coordinates (a, b) are relative to the node: a grows with the column, b with the row. A *band* is what lies between two level
lines: band 0 of b (a line along the columns' direction), band 1 of a.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.edges import derivative_matrix, least_squares, monomials, powers
from dishmap.targets.solve import inverse_each, solve_each

Array = NDArray[Any]
Bool = NDArray[Any]
Index = NDArray[np.int64]

DEGREE = 4
POWERS = powers(DEGREE)
BY_FIRST, BY_SECOND = derivative_matrix(0, DEGREE), derivative_matrix(1, DEGREE)
# Sigma of derivatives by lattice coordinates beforehand, by their order, in steps of the lattice: a cylinder of five steps' radius seen
# from aside and a plate at 60 degrees that a step shrinks by a fifteenth stay within. Place and first derivatives are free.
PRIOR_STEPS = (100.0, 100.0, 0.3, 0.06, 0.02)
REACH = 2
# A map is known if the error of its first derivatives is less than this part of a step.
KNOWN_PART = 0.1
# Lattice coordinates over which the map is turned round, and nodes along each side for that.
INVERSE_REACH, INVERSE_NODES = 0.56, 6
OFFSETS = np.array([(i, j) for i in range(-REACH, REACH + 1) for j in range(-REACH, REACH + 1) if i or j])
# A coefficient of the second power is half a derivative.
DERIVATIVE = np.array([1.0, 2.0])
SIGMA_GUESS_PX = 0.02
# A node this far from where its neighbours say, in sigmas, shows something else than the print.
STRAY_SIGMAS, STRAY_ROUNDS = 8.0, 4
# Places of a, aa and of b, bb among the monomials.
ALONG = (
    np.array([POWERS.index((1, 0)), POWERS.index((2, 0))]),
    np.array([POWERS.index((0, 1)), POWERS.index((0, 2))]),
)


@dataclass(frozen=True)
class LatticeMaps:
    """Maps around N nodes.

    origin_px (N, 2): where (a, b) = 0; forward (N, 2, 15): coefficients of the pixel offset from there by `monomials` of a, b, without a
    constant; inverse (N, 2, 15): of a and b by monomials of s, t = (offset / scale_px); scale_px (N,).
    along (N, 2, 2, 2): covariance, for band 0 and 1, of the error of (slope, second derivative) of the level line through the node, in
    lattice units, as far as the neighbours leave it open. known (N,): false where neighbours do not even give the steps.
    """

    origin_px: Array
    forward: Array
    inverse: Array
    scale_px: Array
    along: Array
    known: Bool

    @property
    def step_px(self) -> Array:
        """Derivative (N, 2, 2) of the pixel by a (first column) and b at the node."""
        return np.asarray(self.forward[:, :, 1:3])

    def place_px(self, ab: Array) -> Array:
        """Pixels (N, Q, 2) of lattice coordinates (N, Q, 2)."""
        offset = self.forward @ monomials(ab[..., 0], ab[..., 1], DEGREE)
        return self.origin_px[:, None] + np.swapaxes(offset, 1, 2)

    def jacobian_px(self, ab: Array) -> Array:
        """Derivative (N, Q, 2, 2) of the pixel by a (first column) and b at lattice coordinates (N, Q, 2)."""
        basis = monomials(ab[..., 0], ab[..., 1], DEGREE)
        return np.stack([np.swapaxes(self.forward @ by @ basis, 1, 2) for by in (BY_FIRST, BY_SECOND)], axis=-1)

    def take(self, rows: Index | Bool | slice) -> LatticeMaps:
        """The maps of some nodes."""
        return LatticeMaps(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class _Smoothed:
    """What neighbours say: forward (N, 2, 15) with the constant, its posterior (N, 15, 15) in steps, and the usual step (px)."""

    forward: Array
    posterior: Array
    step_px: float


def _smoothed(lattice: Index, place_px: Array, usable: Bool, sigma_px: float) -> _Smoothed:
    neighbours = _neighbours(lattice, usable)
    there = neighbours >= 0
    step = _step_px(place_px, neighbours)
    # nodes with the same neighbours share their matrices
    _, first, which = np.unique(there @ (1 << np.arange(len(OFFSETS))), return_index=True, return_inverse=True)
    gain, posterior = _gains(there[first], sigma_px / step)
    offsets = np.where(there[..., None], place_px[neighbours] - place_px[:, None], 0.0)
    return _Smoothed(np.swapaxes(gain[which] @ offsets, 1, 2), posterior[which], step)


def lattice_maps(lattice: Index, place_px: Array, usable: Bool, sigma_px: float) -> LatticeMaps:
    """Maps around all nodes (N,) with lattice (N, 2) and places (N, 2), from those neighbours that are `usable` (N,).

    sigma_px: how well places lie on a smooth map, print and measurement together.
    """
    smoothed = _smoothed(lattice, place_px, usable, sigma_px)
    forward, posterior, step = smoothed.forward.copy(), smoothed.posterior, smoothed.step_px
    forward[:, :, 0] = 0.0
    known = np.asarray(np.diagonal(posterior, axis1=1, axis2=2)[:, 1:3].max(axis=1) < KNOWN_PART**2)
    # a map that is not known is that of a plain lattice, so that nothing divides by zero
    forward[~known] = 0.0
    forward[~known, 0, 1], forward[~known, 1, 2] = step, -step
    scale = 1.5 * INVERSE_REACH * np.linalg.norm(forward[:, :, 1:3], axis=1).max(axis=1)
    inverse = _inverse(forward, scale)
    return LatticeMaps(place_px, forward, inverse, scale, _along(inverse / scale[:, None, None], smoothed), known)


def _along(inverse: Array, smoothed: _Smoothed) -> Array:
    """`LatticeMaps.along`; inverse: by px."""
    # an error of the image of a line moves it across by its part along the other coordinate's gradient
    square = (inverse[:, ::-1, 1:3] ** 2).sum(axis=2)[:, :, None, None] * smoothed.step_px**2
    return np.stack([smoothed.posterior[:, k[:, None], k] for k in ALONG], axis=1) * square * DERIVATIVE[:, None] * DERIVATIVE


def lines_by(maps: LatticeMaps, lattice: Index, place_px: Array, usable: Bool, sigma_px: float) -> tuple[Array, Array]:
    """What other places say of level lines, in the coordinates of `maps`.

    Mean (N, 2, 2) of (slope, second derivative) of band 0 and 1, and its covariance (N, 2, 2, 2) as in `LatticeMaps.along`.
    """
    smoothed = _smoothed(lattice, place_px, usable, sigma_px)
    inverse = maps.inverse / maps.scale_px[:, None, None]
    change = smoothed.forward - maps.forward
    mean = [np.einsum("nu,nuk->nk", inverse[:, 1 - band, 1:3], change[:, :, k]) * DERIVATIVE for band, k in enumerate(ALONG)]
    return np.stack(mean, axis=1), _along(inverse, smoothed)


def strays(lattice: Index, place_px: Array, usable: Bool, sigma_px: float, own_px: Array) -> tuple[Bool, Array]:
    """Nodes (N,) that lie far from where their neighbours say, and where that is (N, 2).

    own_px (N,): sigma of each place besides `sigma_px`. One that is astray makes its neighbours look so: the worst among them goes first.
    """
    astray = np.zeros(len(place_px), bool)
    for _ in range(STRAY_ROUNDS):
        good = usable & ~astray
        smoothed = _smoothed(lattice, place_px, good, sigma_px)
        variance = smoothed.posterior[:, 0, 0] * smoothed.step_px**2 + sigma_px**2 + own_px**2
        far = np.linalg.norm(smoothed.forward[:, :, 0], axis=1) / np.sqrt(variance)
        known = variance < (KNOWN_PART * smoothed.step_px) ** 2 + sigma_px**2 + own_px**2
        far = np.where(good & known, far, 0.0)
        neighbours = _neighbours(lattice, good)
        worst = far >= np.where(neighbours >= 0, far[neighbours], 0.0).max(axis=1)
        new = (far > STRAY_SIGMAS) & worst
        if not new.any():
            break
        astray |= new
    return astray, place_px + _smoothed(lattice, place_px, usable & ~astray, sigma_px).forward[:, :, 0]


def place_sigma_px(lattice: Index, place_px: Array, usable: Bool, least_px: float) -> float:
    """How far places stray from the smooth map through their neighbours, one standard deviation per axis."""
    smoothed = _smoothed(lattice, place_px, usable, SIGMA_GUESS_PX)
    # the place that neighbours say has an error of its own; where they extrapolate they hardly say
    factor = smoothed.posterior[:, 0, 0] * (smoothed.step_px / SIGMA_GUESS_PX) ** 2
    good = usable & (factor < 1.0)
    if good.sum() < 4:
        return least_px
    strays = smoothed.forward[good, :, 0] / np.sqrt(1 + factor[good])[:, None]
    return max(float(1.4826 * np.median(np.abs(strays))), least_px)


def _neighbours(lattice: Index, usable: Bool) -> Index:
    """Rows (N, 24) of the neighbours at OFFSETS, -1 where there is none."""
    corner = lattice.min(axis=0) - REACH
    size = lattice.max(axis=0) + REACH - corner + 1
    table = np.full(tuple(size), -1)
    some = np.flatnonzero(usable)
    table[tuple((lattice[some] - corner).T)] = some
    at = lattice[:, None] - corner + OFFSETS
    return np.asarray(table[at[..., 0], at[..., 1]])


def _step_px(place_px: Array, neighbours: Index) -> float:
    """The usual distance of next neighbours."""
    near = np.flatnonzero(np.abs(OFFSETS).sum(axis=1) == 1)
    rows, which = np.nonzero(neighbours[:, near] >= 0)
    if not len(rows):
        return 1.0
    return float(np.median(np.linalg.norm(place_px[neighbours[rows, near[which]]] - place_px[rows], axis=1)))


def _gains(patterns: Bool, sigma_steps: float) -> tuple[Array, Array]:
    """Coefficients by neighbours' offsets (U, 15, 24) and their covariance in steps (U, 15, 15), for each pattern of neighbours."""
    order = np.sum(POWERS, axis=1)
    prior = np.array(PRIOR_STEPS)[order] / [factorial(i) * factorial(j) for i, j in POWERS]
    a, b = OFFSETS.T.astype(float)
    design = monomials(a, b, DEGREE)
    some = design * patterns[:, None] / sigma_steps
    normal = some @ np.swapaxes(some, 1, 2) + np.diag(prior**-2.0)
    return solve_each(normal, some / sigma_steps), inverse_each(normal)


def _inverse(forward: Array, scale_px: Array) -> Array:
    axis = INVERSE_REACH * np.cos(np.pi * (np.arange(INVERSE_NODES) + 0.5) / INVERSE_NODES)
    a, b = (x.ravel() for x in np.meshgrid(axis, axis))
    offset = forward @ monomials(a, b, DEGREE) / scale_px[:, None, None]
    basis = monomials(offset[:, 0], offset[:, 1], DEGREE)
    return least_squares(basis, np.broadcast_to(np.stack([a, b]), (len(forward), 2, len(a))))
