"""Masks of a beam: a CSV table of directions with the lowest and highest gain that is wanted there."""

from __future__ import annotations

import csv
import io
import math
import os
from pathlib import Path

import numpy as np

from dishmap.errors import InputError
from dishmap.rf.goals import Mask, Steer

COLUMNS = ("theta_deg", "phi_deg", "lowest", "highest")
UNITS = ("dbi", "db")
LARGEST_FILE_BYTES, MOST_DIRECTIONS = 1_000_000, 5000


def read_mask(path: str | os.PathLike[str]) -> Mask:
    """Read a mask: columns theta_deg, phi_deg, and lowest_dbi, highest_dbi, or lowest_db, highest_db relative to the boresight.

    Cells of gains may be empty where there is no bound. Raises InputError, naming the line.
    """
    try:
        if os.path.getsize(path) > LARGEST_FILE_BYTES:
            raise InputError(f"{path} is larger than {LARGEST_FILE_BYTES // 10**6} MB, so it is no mask")
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the mask {path}: {getattr(error, 'strerror', None) or error}") from error
    return parse_mask(text, str(path))


def parse_mask(text: str, source: str = "the mask") -> Mask:
    """The mask of the text of a table; `source` stands in messages. Raises InputError."""
    lines = csv.reader(line for line in io.StringIO(text) if not line.startswith("#"))
    head = [cell.strip() for cell in next(lines, [])]
    unit = next((unit for unit in UNITS if head == [*COLUMNS[:2], *(f"{name}_{unit}" for name in COLUMNS[2:])]), None)
    if unit is None:
        wanted = " or ".join(",".join([*COLUMNS[:2], *(f"{name}_{unit}" for name in COLUMNS[2:])]) for unit in UNITS)
        raise InputError(f"{source} must begin with the columns {wanted}, not {','.join(head)[:80]!r}")
    rows = [_row(cells, f"{source}, row {count}") for count, cells in enumerate((c for c in lines if c), start=1)]
    if not 0 < len(rows) <= MOST_DIRECTIONS:
        raise InputError(f"{source} has {len(rows)} directions; 1 to {MOST_DIRECTIONS} are needed")
    towards = [Steer.degrees(theta, phi) for theta, phi, _, _ in rows]
    uv = np.array([[one.u, one.v] for one in towards])
    return Mask(uv, np.array([row[2] for row in rows]), np.array([row[3] for row in rows]), relative=unit == "db")


def _row(cells: list[str], where: str) -> tuple[float, float, float, float]:
    if len(cells) != len(COLUMNS):
        raise InputError(f"{where} has {len(cells)} cells, and a mask has {len(COLUMNS)}")
    values = []
    for cell, empty in zip(cells, (None, None, -math.inf, math.inf), strict=True):
        if not cell.strip() and empty is not None:
            values.append(empty)
            continue
        try:
            values.append(float(cell))
        except ValueError:
            values.append(math.nan)
        if not math.isfinite(values[-1]):
            raise InputError(f"{where}: {cell.strip()[:30]!r} is not a number")
    theta, phi, low, high = values
    if not -90 < theta < 90:
        raise InputError(f"{where}: theta must lie within 90 degrees of the boresight, not {theta:g}")
    return theta, phi, low, high
