"""Where the gain goes: the factors between the gain of a uniform aperture and what is left at the beam's peak.

Also the path error that does it, and Ruze's estimate from its rms, as a cross-check.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.rf.pattern import direction_of
from dishmap.rf.sources import Sources, illumination

Array = NDArray[np.float64]

# 10 log10(e) (4 pi)^2 (Ruze 1966, equation 1)
RUZE_DB = 10 * np.log10(np.e) * (4 * np.pi) ** 2


@dataclass(frozen=True)
class Budget:
    """Shares of the gain (pi D / wavelength)^2 of a uniform aperture, whose product is `total`.

    spillover: power that meets the reflector; illumination: evenness of the field over the aperture; blockage: what shadows leave; phase:
    what path errors leave at the beam's peak; rest: polarisation and what is not so simple.
    """

    spillover: float
    illumination: float
    blockage: float
    phase: float
    rest: float
    total: float


@dataclass(frozen=True)
class PathError:
    """Half-path error over the aperture, piston and pointing taken out.

    xy_mm (N, 2): places; weight (N,): field amplitude times area; half_path_mm (N,): half of what the path is too short; rms_mm: over the
    area alone; weighted_rms_mm: with the illumination; ruze_db: loss for that rms by Ruze's formula.
    """

    xy_mm: Array
    weight: Array
    area_mm2: Array
    half_path_mm: Array
    rms_mm: float
    weighted_rms_mm: float
    ruze_db: float


def budget(sources: Sources, wavelength_mm: float, diameter_mm: float, u: float, v: float, gain_dbi: float) -> Budget:
    """The factors of a co-polar gain at direction (u, v)."""
    weight, lit = sources.nodes.weight_mm2, sources.nodes.lit
    amplitude = np.sqrt(np.maximum(sources.arriving / weight, 0.0))
    through = amplitude * weight
    whole = through[:lit].sum()
    area = np.pi * diameter_mm**2 / 4
    spillover = float(sources.arriving[:lit].sum())
    illumination = float(whole**2 / (area * (amplitude[:lit] ** 2 * weight[:lit]).sum()))
    blockage = float((through.sum() / whole) ** 2)
    wave = through * np.exp(-2j * np.pi / wavelength_mm * path_towards(sources, u, v))
    phase = float(np.abs(wave.sum()) ** 2 / through.sum() ** 2)
    total = float(10 ** (gain_dbi / 10) / (np.pi * diameter_mm / wavelength_mm) ** 2)
    return Budget(spillover, illumination, blockage, phase, total / (spillover * illumination * blockage * phase), total)


def path_towards(sources: Sources, u: float, v: float) -> Array:
    """Path (N,) from the feed over each source to a plane across the direction (u, v), less a constant."""
    path = sources.rays.path_mm - sources.point_mm @ direction_of((u, v))
    return np.asarray(path - path[0])


def path_error(sources: Sources, wavelength_mm: float, u: float, v: float) -> PathError:
    """The half-path error at the beam's peak (u, v): what is left of the path there after its weighted mean."""
    lit = slice(0, sources.nodes.lit)
    area = sources.nodes.weight_mm2[lit]
    weight = illumination(sources)
    half = -0.5 * path_towards(sources, u, v)[lit]
    half = half - (weight @ half) / weight.sum()
    plain = float(np.sqrt((area @ (half - (area @ half) / area.sum()) ** 2) / area.sum()))
    weighted = float(np.sqrt((weight @ half**2) / weight.sum()))
    return PathError(sources.nodes.xy_mm[lit], weight, area, half, plain, weighted, ruze_loss_db(weighted, wavelength_mm))


def ruze_loss_db(half_path_rms_mm: float, wavelength_mm: float) -> float:
    """Loss of gain in dB for an rms half-path error (Ruze 1966): 685.81 (eps / wavelength)^2, for small or uncorrelated errors."""
    return float(RUZE_DB * (half_path_rms_mm / wavelength_mm) ** 2)
