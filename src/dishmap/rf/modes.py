"""Which modes of the path error are left, and what each costs.

The half-path error is fitted by Zernike terms, weighed by the illumination; terms of one degree and order make one mode with an
orientation. Costs come from the whole sum over the aperture, pointed anew each time, not from Ruze's rule, which is for small errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.beam import log_gain_slopes
from dishmap.surface.zernike import zernike_matrix, zernike_terms

Array = NDArray[np.float64]

# Degrees that are told apart.
DEGREE = 8
NEWTON_STEPS, STILL_RAD = 30, 1e-8


@dataclass(frozen=True)
class Mode:
    """One mode (n, |m|) of the half-path error.

    amplitude_mm: of the unnormalised Zernike term, 1 at the rim; orientation_deg: azimuth of its first maximum, 0 for m = 0 (there the
    amplitude has a sign); alone_db: what it would cost if it were the only one; removed_db: what its removal would win back now, negative
    where others are partly undone by it.
    """

    n: int
    m: int
    amplitude_mm: float
    orientation_deg: float
    alone_db: float
    removed_db: float


def modes_of(xy: Array, half_path_mm: Array, weight: Array, wavelength_mm: float, degree: int = DEGREE) -> tuple[Mode, ...]:
    """Modes of the second and higher degrees, those whose removal wins most first.

    xy (N, 2): nodes in the unit disc of the aperture; half_path_mm (N,); weight (N,): amplitude of the field times area. Raises InputError
    for too few nodes.
    """
    terms = zernike_terms(degree)
    if len(xy) <= len(terms):
        raise InputError(f"{len(terms)} Zernike terms need more nodes than {len(xy)}; ask for a lower degree")
    columns = zernike_matrix(terms, *xy.T)
    root = np.sqrt(np.abs(weight))[:, None]
    values = np.linalg.lstsq(columns * root, half_path_mm * root[:, 0], rcond=None)[0]
    own: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, (n, m) in enumerate(terms):
        if n > 1:
            own.setdefault((n, abs(m)), []).append((i, m))
    phase = 4 * np.pi / wavelength_mm
    now, perfect = _pointed_db(xy, phase * half_path_mm, weight), _pointed_db(xy, np.zeros(len(xy)), weight)
    rows = []
    for (n, m), members in own.items():
        part = columns[:, [i for i, _ in members]] @ values[[i for i, _ in members]]
        amplitude, turn = _amplitude({order: values[i] for i, order in members}, m)
        alone = perfect - _pointed_db(xy, phase * part, weight)
        removed = _pointed_db(xy, phase * (half_path_mm - part), weight) - now
        rows.append(Mode(n, m, amplitude, turn, alone, removed))
    return tuple(sorted(rows, key=lambda row: -row.removed_db))


def _amplitude(values: dict[int, float], m: int) -> tuple[float, float]:
    if m == 0:
        return float(values[0]), 0.0
    cosine, sine = values[m], values[-m]
    return float(np.hypot(cosine, sine)), float(np.degrees(np.arctan2(sine, cosine)) / m)


def _pointed_db(xy: Array, phase_rad: Array, weight: Array) -> float:
    """Gain in dB, up to a constant, at the peak next to the least-squares direction."""
    x, y = xy.T
    slopes = np.column_stack([np.ones(len(x)), x, y])
    root = np.sqrt(np.abs(weight))
    tilt = -np.linalg.lstsq(slopes * root[:, None], phase_rad * root, rcond=None)[0][1:]
    level = -np.inf
    for _ in range(NEWTON_STEPS):
        wave = weight * np.exp(1j * (phase_rad + xy @ tilt))
        level = 20 * np.log10(abs(wave.sum()))
        gradient, hessian = log_gain_slopes(wave, 1.0, x, y)
        values, vectors = np.linalg.eigh(hessian)
        step = vectors @ ((vectors.T @ gradient) / np.maximum(np.abs(values), 1e-12))
        while True:
            higher = 20 * np.log10(max(abs((weight * np.exp(1j * (phase_rad + xy @ (tilt + step)))).sum()), 1e-300))
            if higher >= level or np.abs(step).max() < STILL_RAD:
                break
            step = step / 4
        tilt = tilt + step
        if np.abs(step).max() < STILL_RAD:
            break
    return float(level)
