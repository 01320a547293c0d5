"""Difference files: `difference.csv`, one row a target, and `difference.ply` for 3D viewers, coloured by the change of shape."""

from __future__ import annotations

import math
import os

import numpy as np
from numpy.typing import NDArray

from dishmap.compare import DifferenceTable
from dishmap.io.points_file import fixed, table_rows, table_text
from dishmap.quality import names

Array = NDArray[np.float64]

NOMINAL = ("x_mm", "y_mm", "z_mm")
VALUES = ("displacement_mm", "depth_change_mm", "shape_mm")
SIGMAS = ("sigma_displacement_mm", "sigma_depth_change_mm", "sigma_shape_mm")
MOTION = ("du_px", "dv_px")
COLUMNS = ("id", *NOMINAL, *VALUES, *SIGMAS, *MOTION, "quality")
# Blue for towards the back, light grey for no change, red for towards the focus: told apart by colour-blind people too.
BACK, STILL, FRONT = (33.0, 102.0, 172.0), (235.0, 235.0, 235.0), (178.0, 24.0, 43.0)
# The scale of colours reaches at least so many median sigmas, so that noise alone stays pale.
LEAST_SCALE_SIGMAS = 6.0


def format_difference(table: DifferenceTable) -> str:
    """The text of `difference.csv`: lengths and pixels to 1e-6, sigmas to 6 digits, empty where not known."""
    places = np.column_stack([table.nominal_mm, *(getattr(table, name) for name in VALUES)])
    sigmas = np.column_stack([getattr(table, name) for name in SIGMAS])
    lines = [",".join(COLUMNS)]
    for row in range(len(table)):
        values = [
            *(fixed(v, 6) for v in places[row]),
            *("" if math.isnan(v) else f"{v:.6g}" for v in sigmas[row]),
            *(fixed(v, 6) for v in table.du_dv_px[row]),
        ]
        lines.append(",".join([str(table.ids[row]), *values, names(int(table.quality[row]))]))
    return "\n".join(lines) + "\n"


def format_difference_ply(table: DifferenceTable) -> str:
    """The text of `difference.ply` (ASCII): nominal x, y, z and colour, then id, values, sigmas and quality bits; an unknown sigma is 0."""
    sigmas = np.nan_to_num(np.column_stack([getattr(table, name) for name in SIGMAS]))
    values = np.column_stack([getattr(table, name) for name in VALUES])
    scale = colour_scale_mm(table)
    colours = _colours(table.shape_mm / scale)
    lines = [
        *("ply", "format ascii 1.0", "comment dishmap: lengths in mm; quality: bits, 0 when clean"),
        f"comment colour: shape_mm from {-scale:.4g} (blue) through 0 (grey) to {scale:.4g} (red)",
        f"element vertex {len(table)}",
        *(f"property double {name}" for name in ("x", "y", "z")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        *("property int id", *(f"property float {name}" for name in (*VALUES, *SIGMAS)), "property int quality", "end_header"),
    ]
    for row in range(len(table)):
        numbers = [*(fixed(v, 6) for v in table.nominal_mm[row]), *map(str, colours[row]), str(table.ids[row])]
        rest = [f"{v:.6g}" for v in (*values[row], *sigmas[row])]
        lines.append(" ".join([*numbers, *rest, str(table.quality[row])]))
    return "\n".join(lines) + "\n"


def colour_scale_mm(table: DifferenceTable) -> float:
    """The change of shape at the ends of the colours: the largest there is, and not less than noise makes."""
    sigma = table.sigma_shape_mm[np.isfinite(table.sigma_shape_mm)]
    least = LEAST_SCALE_SIGMAS * float(np.median(sigma)) if len(sigma) else 0.0
    return max(float(np.abs(table.shape_mm).max(initial=0.0)), least, 1e-6)


def read_difference(path: str | os.PathLike[str]) -> DifferenceTable:
    """Read `difference.csv`. Raises InputError, naming the file and the line, when it is not exactly such a table."""
    return parse_difference(table_text(path, "differences"), str(path))


def parse_difference(text: str, source: str = "the table of differences") -> DifferenceTable:
    """Make a DifferenceTable of the text of `difference.csv`; `source` stands in messages. Raises InputError."""
    ids, table, quality = table_rows(text, source, "differences", COLUMNS, SIGMAS)
    columns = {name: table[:, 3 + k] for k, name in enumerate((*VALUES, *SIGMAS))}
    return DifferenceTable(
        ids=np.asarray(ids, dtype=np.int64),
        nominal_mm=table[:, :3],
        **columns,
        du_dv_px=table[:, 9:],
        quality=np.asarray(quality, dtype=np.int64),
    )


def _colours(share: Array) -> NDArray[np.int64]:
    """Colours (N, 3), 0 to 255, of values from -1 to 1."""
    part = np.abs(np.clip(share, -1, 1))[:, None]
    end = np.where(share[:, None] < 0, np.array(BACK), np.array(FRONT))
    return np.asarray(np.rint(np.array(STILL) * (1 - part) + end * part), dtype=np.int64)
