"""What the actuators do to the subreflector, or to the feed at the prime focus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.rf.antenna import Actuators, Antenna
from dishmap.surface.zernike import zernike_terms

Array = NDArray[np.float64]

RIGID = ("shift_x", "shift_y", "shift_z", "tilt_x", "tilt_y")


@dataclass(frozen=True)
class Correction:
    """A pose and a shape of the subreflector, or a pose of the feed at the prime focus, as changes from the nominal one.

    shift_mm (3,), in dish axes; tilt_deg (2,): rotation vector about x and y, through the subreflector's vertex or the feed's phase centre,
    before the shift; shape_mm (T,): Zernike terms (`shape_terms`) over the subreflector's disc, of its height along z.
    """

    shift_mm: Array
    tilt_deg: Array
    shape_mm: Array

    @property
    def values(self) -> Array:
        """All of it as one vector (5 + T,): mm, degrees, mm."""
        return np.concatenate([self.shift_mm, self.tilt_deg, self.shape_mm])


def shape_terms(actuators: Actuators) -> tuple[tuple[int, int], ...]:
    """The Zernike terms (n, m) into which the subreflector can be bent: from the second degree to the highest that it allows."""
    return tuple(t for t in zernike_terms(actuators.shape_degree) if t[0] > 1) if actuators.shape_degree else ()


def bent_degree(actuators: Actuators, correction: Correction) -> int:
    """The highest degree of the terms into which the subreflector is bent, 0 where it is not."""
    return max((n for (n, _), size in zip(shape_terms(actuators), correction.shape_mm, strict=True) if size), default=0)


def correction_of(values: Array) -> Correction:
    """The correction of a vector (5 + T,) as `Correction.values` gives it."""
    return Correction(values[:3], values[3:5], values[5:])


def no_correction(antenna: Antenna) -> Correction:
    """Everything in its nominal place."""
    return correction_of(np.zeros(5 + len(shape_terms(antenna.actuators))))
