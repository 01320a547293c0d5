"""Nodes: places in a photograph that could be targets of a grid, each with the directions of its lattice's two axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Nodes:
    """Middles of squares, or crossings of lines, before it is known which lie on a lattice.

    place_px (M, 2); axes (M, 2, 2): two vectors (axis, uv) along the lattice's axes, px, right-handed (`right_handed`) but in any of four
    quarter turns: half sides of a square, or unit directions of the lines of a crossing.
    """

    place_px: Array
    axes: Array

    def __len__(self) -> int:
        return len(self.place_px)

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> Nodes:
        """The nodes at `index`."""
        return Nodes(self.place_px[index], self.axes[index])

    @staticmethod
    def none() -> Nodes:
        """No nodes."""
        return Nodes(np.zeros((0, 2)), np.zeros((0, 2, 2)))


def right_handed(axes: Array) -> Array:
    """Axes (..., 2, 2) with the second one turned about so that, seen in the image (v down), it lies to the left of the first."""
    flip = axes[..., 0, 0] * axes[..., 1, 1] - axes[..., 0, 1] * axes[..., 1, 0] > 0
    out = axes.copy()
    out[..., 1, :] *= np.where(flip, -1.0, 1.0)[..., None]
    return out
