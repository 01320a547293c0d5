"""The local map of a lattice: where a node should be, from its neighbours, and how sure that is.

Steps of a lattice change smoothly over a photograph, through perspective, lens and bent surface. Near each place the map from
(column, row) to pixels is therefore a polynomial of second degree whose second derivatives are small against a step. That is a linear
Gaussian model: fitted to the known nodes around, it gives place and steps at any column and row, and the sigma of that place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Neighbours up to so many columns and rows away are used.
REACH = 3
# Sigma of a node against the local map, in steps: its own, and what third derivatives add with the square of the distance.
NODE_SIGMA, BEND_SIGMA = 0.02, 0.004
# Prior sigma of second derivatives, in steps; that of place and steps is wide, to keep the equations sound.
SECOND_SIGMA, FREE_SIGMA = 0.12, 1e3


@dataclass(frozen=True)
class LocalMap:
    """The map at T places of a lattice.

    place_px (T, 2); step_px (T, 2, 2): columns are d place / d column and d place / d row; bend_px (T, 2, 2): the second
    derivatives by column and by row, likewise; sigma (T,) of the place, in steps.
    """

    place_px: Array
    step_px: Array
    bend_px: Array
    sigma: Array

    def take(self, index: Ints | NDArray[np.bool_]) -> LocalMap:
        """The map at some of its places."""
        return LocalMap(self.place_px[index], self.step_px[index], self.bend_px[index], self.sigma[index])

    def offset(self, place_px: Array) -> Array:
        """How far places (T, 2) lie from the map's, in columns and rows (T, 2); NaN where there is no map."""
        determinant = np.linalg.det(self.step_px)
        sound = np.abs(determinant) > 1e-9
        steps = np.where(sound[:, None, None], self.step_px, np.eye(2))
        out = np.linalg.solve(steps, (place_px - self.place_px)[:, :, None])[..., 0]
        return np.asarray(np.where(sound[:, None], out, np.nan))


def local_map(nodes_px: Array, at: Ints, itself: bool = False) -> LocalMap:
    """The map at lattice places `at` (T, 2), from nodes_px (C, R, 2) by column and row (NaN where none is known).

    itself: the node at the place counts too; otherwise only its neighbours do.
    """
    known = np.isfinite(nodes_px[..., 0])
    layers = np.stack([known, *np.moveaxis(np.where(known[..., None], nodes_px, 0.0), 2, 0)])
    layers = np.pad(layers, ((0, 0), (REACH, REACH), (REACH, REACH)))
    d = np.stack(np.meshgrid(*[np.arange(-REACH, REACH + 1)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    if not itself:
        d = d[(d != 0).any(axis=1)]
    first = (at[:, 0] + REACH) * layers.shape[2] + at[:, 1] + REACH
    around = first[:, None] + d[:, 0] * layers.shape[2] + d[:, 1]
    column, row = d.T.astype(float)
    basis = np.stack([np.ones(len(d)), column, row, column**2 / 2, column * row, row**2 / 2], axis=1)
    weighted = basis / (NODE_SIGMA**2 + BEND_SIGMA**2 * (d**2).sum(axis=1) ** 2)[:, None]
    squares = (weighted[:, :, None] * basis[:, None, :]).reshape(len(d), 36)
    information = (layers[0].ravel()[around] @ squares).reshape(-1, 6, 6)
    information[:, range(6), range(6)] += np.array([FREE_SIGMA] * 3 + [SECOND_SIGMA] * 3) ** -2.0
    right = np.stack([layer.ravel()[around] @ weighted for layer in layers[1:]], axis=2)
    covariance = np.linalg.inv(information)
    solution = covariance @ right
    steps, bends = (np.swapaxes(solution[:, rows], 1, 2) for rows in ([1, 2], [3, 5]))
    return LocalMap(solution[:, 0], steps, bends, np.sqrt(covariance[:, 0, 0]))
