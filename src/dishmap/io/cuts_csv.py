"""`cuts.csv`: cuts through far fields as a table for spreadsheets, one row an angle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dishmap.io.csv_table import format_csv
from dishmap.rf.pattern import Cut, decibels

COLUMNS = ("state", "frequency_ghz", "phi_deg", "theta_deg", "co_dbi", "co_phase_deg", "cross_dbi", "cross_phase_deg")


def format_cuts_csv(states: Sequence[str], frequencies_ghz: Sequence[float], cuts: Sequence[Sequence[Sequence[Cut]]]) -> str:
    """The text of `cuts.csv`: for each state and each frequency, cuts at some azimuths; no number where there is no field."""
    rows = [
        {
            **dict(zip(COLUMNS, (state, frequency, float(cut.phi_deg), theta), strict=False)),
            **dict(zip(COLUMNS[4:], (*co, *cross), strict=True)),
        }
        for state, by_frequency in zip(states, cuts, strict=True)
        for frequency, one in zip(frequencies_ghz, by_frequency, strict=True)
        for cut in one
        for theta, co, cross in zip(cut.theta_deg.tolist(), _polar(cut.co), _polar(cut.cross), strict=True)
    ]
    return format_csv(COLUMNS, rows)


def _polar(field: NDArray[np.complex128]) -> list[list[float]]:
    """Gain in dBi and phase in degrees (T, 2)."""
    size = np.abs(field) ** 2
    phase = np.where(size > 0, np.degrees(np.angle(field)), np.nan)
    return [list(pair) for pair in zip(decibels(size).tolist(), phase.tolist(), strict=True)]
