"""The one table of quality bits: what each flag in a `quality` column means.

A target with no bit set is clean. `REJECTED` lists the bits with which a target is not used at all: it is reported
among the rejected ones with the reason, and never appears in a point cloud.
"""

from __future__ import annotations

from enum import IntFlag

import numpy as np
from numpy.typing import NDArray


class Quality(IntFlag):
    """Quality bits of one measured target."""

    CLEAN = 0
    CLIPPED = 1
    OCCLUDED = 2
    GLARE = 4
    POOR_FIT = 8
    TOO_SMALL = 16
    AMBIGUOUS_NORMAL = 32
    OFF_SURFACE = 64
    NOT_CONVERGED = 128
    WEAK_DEPTH = 256
    NO_CONTRAST = 512
    OUTLIER = 1024


MEANING: dict[Quality, str] = {
    Quality.CLIPPED: "part of the target lies outside the image",
    Quality.OCCLUDED: "part of the target is hidden, overprinted or too near its neighbour; the rest was measured",
    Quality.GLARE: "saturated pixels, which were left out, or light that bends across the target, which was fitted; sigmas are wider",
    Quality.POOR_FIT: "the pixels differ from the model by more than the image's noise explains; sigmas are scaled up",
    Quality.TOO_SMALL: "the smallest printed circle is under 2 px in radius, a line under 1 px wide or a square under 4 px",
    Quality.AMBIGUOUS_NORMAL: "a mirrored normal fits nearly as well; the one that pixels and the pattern's surface make likelier is given",
    Quality.OFF_SURFACE: "the target lies, or moved, far from the surface through its neighbours",
    Quality.NOT_CONVERGED: "the fit to the pixels did not converge",
    Quality.WEAK_DEPTH: "depth rests on the assumed ink spread (a lone disc), not on the image alone",
    Quality.OUTLIER: "its place fits no smooth surface, or its change no smooth motion of it; the value is what its neighbours say",
    Quality.NO_CONTRAST: "too little contrast between ink and ground for a measurement",
}

REJECTED: Quality = Quality.CLIPPED | Quality.NOT_CONVERGED | Quality.NO_CONTRAST


def names(bits: int) -> str:
    """Return the flags in `bits` as lower-case names joined by `|`; empty when clean."""
    return "|".join(str(flag.name).lower() for flag in Quality if flag and flag & bits)


def is_rejected(bits: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return where `bits` (N,) hold a flag with which a target must not be used."""
    return np.asarray((np.asarray(bits) & int(REJECTED)) != 0)
