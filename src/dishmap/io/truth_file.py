"""Truth tables of simulated photographs: CSV, one row per image and target."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from dishmap.errors import InputError
from dishmap.simulate.truth import Truth

COLUMNS = ("image", "id", "x_mm", "y_mm", "z_mm", "nx", "ny", "nz", "u_px", "v_px", "visible_fraction", "displacement_mm")


def format_truth(images: Iterable[tuple[str, Truth]]) -> str:
    """The text of a truth table for named images: lengths and pixels to 1e-9, an empty u_px and v_px where there is no image."""
    lines = [",".join(COLUMNS)]
    for name, truth in images:
        for row in range(len(truth)):
            values = [
                *truth.center_mm[row],
                *truth.normal[row],
                *truth.center_px[row],
                truth.visible_fraction[row],
                truth.displacement_mm[row],
            ]
            lines.append(",".join([name, str(truth.ids[row]), *(_number(float(value)) for value in values)]))
    return "\n".join(lines) + "\n"


def read_truth(path: str | os.PathLike[str]) -> Mapping[str, Truth]:
    """Truth of every image named in a truth table. Raises InputError when the file is not one."""
    try:
        rows = list(csv.reader(Path(path).read_text(encoding="utf-8").splitlines()))
    except OSError as error:
        raise InputError(f"cannot read the truth table {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no truth table: it is not text in UTF-8") from error
    if not rows or tuple(rows[0]) != COLUMNS:
        raise InputError(f"{path} is no truth table: its first line must be {','.join(COLUMNS)}")
    images: dict[str, list[tuple[int, list[float]]]] = {}
    for number, row in enumerate(rows[1:], start=2):
        try:
            name, identity, *values = row
            if len(values) != len(COLUMNS) - 2:
                raise ValueError
            images.setdefault(name, []).append((int(identity), [float(value) if value else math.nan for value in values]))
        except ValueError as error:
            raise InputError(f"{path}, line {number}: needs an image name, an id and {len(COLUMNS) - 2} numbers") from error
    return {name: _truth(found) for name, found in images.items()}


def _truth(rows: list[tuple[int, list[float]]]) -> Truth:
    table = np.array([values for _, values in rows])
    ids = np.array([identity for identity, _ in rows], dtype=np.int64)
    return Truth(ids, table[:, 0:3], table[:, 3:6], table[:, 6:8], table[:, 8], table[:, 9])


def _number(value: float) -> str:
    # + 0.0 writes 0 for -0
    return "" if math.isnan(value) else f"{round(value, 9) + 0.0:.9f}"
