"""From a node's fitted bands to its place: the vector that is measured, its information, and what is wrong with it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.grid_fit import BEND, HALF, LIGHT, OFFSET, SLOPE
from dishmap.targets.lattice_map import LatticeMaps
from dishmap.targets.solve import inverse_each, inverse_scaled

Array = NDArray[Any]

# Two level lines are brought to their meeting by so many substitutions; each gains the factor of their slopes.
MEETING_STEPS = 5
CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
CROSSING = np.zeros((1, 2))


def measured_vector(maps: LatticeMaps, x: Array, crossing: bool) -> tuple[Array, Array]:
    """Measured vectors (N, V) in px and their derivative (N, V, G) by the parameters x (N, G).

    V = 2, the place, for crossings; V = 6 for rectangles: mean of the corners' images, and half the differences of the mean images of
    opposite sides' corners, along x and along y of the target.
    """
    signs = CROSSING if crossing else CORNERS
    ab, by_x = _meeting(x, signs)
    places = maps.place_px(ab)
    moved = maps.jacobian_px(ab) @ by_x
    if crossing:
        return places[:, 0], moved[:, 0]
    mean, half_x, half_y = np.full(4, 0.25), 0.25 * signs[:, 0], 0.25 * signs[:, 1]
    combine = np.stack([mean, half_x, half_y])
    count = len(x)
    return (combine @ places).reshape(count, 6), np.einsum("vq,nqug->nvug", combine, moved).reshape(count, 6, -1)


def _meeting(x: Array, signs: Array) -> tuple[Array, Array]:
    """Where (N, Q, 2) the level lines or edges with `signs` (Q, 2) of a and b meet in the lattice; derivative (N, Q, 2, G) of that."""
    offset, slope, bend, half = (x[:, None, part] for part in (OFFSET, SLOPE, BEND, HALF))
    ab = np.zeros((len(x), len(signs), 2))
    # band 0 is across b
    side = half * signs[:, ::-1]
    for _ in range(MEETING_STEPS):
        across = offset + slope * ab + 0.5 * bend * ab**2 + side
        ab = across[..., ::-1]
    by_x = np.zeros((*ab.shape, x.shape[1]))
    for k in (0, 1):
        along = ab[..., k]
        for part, value in ((OFFSET, 1.0), (SLOPE, along), (BEND, 0.5 * along**2), (HALF, signs[:, 1 - k])):
            by_x[..., 1 - k, part.start + k] = value
    # a moves with b along its edge and b with a
    turn = np.zeros((*ab.shape, 2))
    turn[..., [0, 1], [0, 1]] = 1.0
    lean = slope + bend * ab
    turn[..., 1, 0], turn[..., 0, 1] = -lean[..., 0], -lean[..., 1]
    return ab, inverse_each(turn.reshape(-1, 2, 2)).reshape(turn.shape) @ by_x


def information_of(normal: Array, prior: Array, by_x: Array) -> Array:
    """Information (N, V, V) on the measured vector, all else eliminated; NaN where there is none."""
    full = normal.copy()
    size = prior.shape[1]
    full[:, :size, :size] += prior
    light = range(size, size + LIGHT)
    full[:, light, light] *= 1 + 1e-9
    covariance = inverse_scaled(full)[:, :size, :size]
    spread = by_x @ covariance @ np.swapaxes(by_x, 1, 2)
    return inverse_scaled(spread)
