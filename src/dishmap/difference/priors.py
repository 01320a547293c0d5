"""What the user says before the photographs are compared: one record with plain names."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dishmap.errors import InputError

# Kapton over 1000 K, lead over 700 K: more is a mistake of units.
LARGEST_EXPANSION_PPM = 5e4
LARGEST_FOCAL_DRIFT = 0.1
LARGEST_STRAIN = 0.1
LARGEST_MM = 1e4
# How points follow a displacement along the normal: with the least strain (a membrane), staying on their normals, along the boresight
# (as axial deformations are often given), or in any smooth way.
SLIDES = ("least_strain", "normal", "axial", "any")


@dataclass(frozen=True)
class Priors:
    """Assumptions of a difference; None means: learn it from the photographs.

    still: the surface moves as a rigid body. amplitude_mm, length_mm: how far and how smoothly it moves along its normal (standard
    deviation and correlation length). strain: "rigid" (the surface does not stretch and prints keep their size), "free" (the size of
    prints says nothing), a standard deviation, or None. slide: how points follow a displacement along the normal, one of SLIDES, or
    None: all are weighed (with strain "free" nothing can tell them apart, and the least strain is assumed). expansion_ppm: mean and
    standard deviation of a uniform expansion; None takes it as zero unless the scale of the whole picture changed by more than 0.1 %.
    focal_drift: standard deviation of the relative change of the focal length. rigid_ids: targets on rigid parts (hub, rim); their motion
    is the camera's. Raises InputError for impossible values.
    """

    still: bool = False
    amplitude_mm: float | None = None
    length_mm: float | None = None
    strain: str | float | None = None
    slide: str | None = None
    expansion_ppm: tuple[float, float] | None = None
    focal_drift: float = 0.0
    rigid_ids: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        _within("smoothness amplitude", self.amplitude_mm, LARGEST_MM, "mm", zero=False)
        _within("smoothness length", self.length_mm, LARGEST_MM, "mm", zero=False)
        _within("focal drift", self.focal_drift, LARGEST_FOCAL_DRIFT, "(a relative change)")
        if isinstance(self.strain, str) and self.strain not in ("rigid", "free"):
            raise InputError(f"strain must be rigid, free or a standard deviation such as 1e-5, not {self.strain!r}")
        if self.slide is not None and self.slide not in SLIDES:
            raise InputError(f"unknown slide {self.slide!r}; use one of {', '.join(SLIDES)}")
        if not isinstance(self.strain, str):
            _within("strain", self.strain, LARGEST_STRAIN, "(a relative change of length)")
        if self.expansion_ppm is not None:
            mean, sigma = self.expansion_ppm
            if not abs(mean) <= LARGEST_EXPANSION_PPM:
                raise InputError(f"the mean expansion must lie within +-{LARGEST_EXPANSION_PPM:g} ppm, not {mean:g}")
            _within("standard deviation of the expansion", sigma, LARGEST_EXPANSION_PPM, "ppm")
        if self.still and (self.amplitude_mm is not None or self.length_mm is not None):
            raise InputError("a surface that only moves as a rigid body has no smoothness; leave out one of the two")


def _within(name: str, value: float | None, largest: float, unit: str, zero: bool = True) -> None:
    if value is None:
        return
    if not (np.isfinite(value) and 0 <= value <= largest) or (value == 0 and not zero):
        raise InputError(f"the {name} must lie between 0 and {largest:g} {unit}, not {value:g}")
