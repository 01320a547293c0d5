"""Point files: `points.csv`, one row a target, and `points.ply` for 3D viewers."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.quality import Quality, names
from dishmap.surface.cloud import NORMAL_TOLERANCE, PointCloud

Array = NDArray[np.float64]

POSITION = ("x_mm", "y_mm", "z_mm")
NORMAL = ("nx", "ny", "nz")
PIXEL = ("u_px", "v_px")
SIGMA_MM = ("sigma_x_mm", "sigma_y_mm", "sigma_z_mm")
SIGMA_PX = ("sigma_u_px", "sigma_v_px")
COLUMNS = ("id", *POSITION, *NORMAL, *PIXEL, *SIGMA_MM, "sigma_normal_deg", *SIGMA_PX, "quality")
SIGMAS = (*SIGMA_MM, "sigma_normal_deg", *SIGMA_PX)
LARGEST_FILE_BYTES = 100_000_000


@dataclass(frozen=True)
class PointTable:
    """What a point file holds, N points.

    ids (N,), position_mm, normal (N, 3), center_px (N, 2), sigma_mm (N, 3), sigma_normal_rad (N,), sigma_px (N, 2), quality (N,)
    bits. Sigmas are NaN where the file gives none (the paper's method).
    """

    ids: NDArray[np.int64]
    position_mm: Array
    normal: Array
    center_px: Array
    sigma_mm: Array
    sigma_normal_rad: Array
    sigma_px: Array
    quality: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.ids)


def table_of(cloud: PointCloud, with_sigmas: bool = True) -> PointTable:
    """The table of a point cloud; with_sigmas: False when its covariances stand for `unknown`."""
    n = len(cloud)
    return PointTable(
        ids=cloud.ids,
        position_mm=cloud.position_mm,
        normal=cloud.normal,
        center_px=cloud.center_px,
        sigma_mm=_sigmas(cloud.covariance_mm2) if with_sigmas else np.full((n, 3), np.nan),
        sigma_normal_rad=cloud.sigma_normal_rad if with_sigmas else np.full(n, np.nan),
        sigma_px=_sigmas(cloud.covariance_px2) if with_sigmas else np.full((n, 2), np.nan),
        quality=cloud.quality,
    )


def format_points(table: PointTable) -> str:
    """The text of `points.csv`: lengths and pixels to 1e-6, normals to 1e-9, sigmas to 6 digits, empty where not known."""
    sigmas = np.column_stack([table.sigma_mm, np.degrees(table.sigma_normal_rad), table.sigma_px])
    lines = [",".join(COLUMNS)]
    for row in range(len(table)):
        values = [
            *(fixed(v, 6) for v in table.position_mm[row]),
            *(fixed(v, 9) for v in table.normal[row]),
            *(fixed(v, 6) for v in table.center_px[row]),
            *("" if math.isnan(v) else f"{v:.6g}" for v in sigmas[row]),
        ]
        lines.append(",".join([str(table.ids[row]), *values, names(int(table.quality[row]))]))
    return "\n".join(lines) + "\n"


def format_ply(table: PointTable) -> str:
    """The text of `points.ply` (ASCII): x, y, z, nx, ny, nz, then id, sigmas and quality bits; a sigma that is not known is 0."""
    sigmas = np.nan_to_num(np.column_stack([table.sigma_mm, np.degrees(table.sigma_normal_rad)]))
    doubles = ("x", "y", "z", *NORMAL)
    floats = (*SIGMA_MM, "sigma_normal_deg")
    head = [
        *("ply", "format ascii 1.0", "comment dishmap: lengths in mm; quality: bits, 0 when clean", f"element vertex {len(table)}"),
        *(f"property double {name}" for name in doubles),
        *("property int id", *(f"property float {name}" for name in floats), "property int quality", "end_header"),
    ]
    for row in range(len(table)):
        numbers = [*(fixed(v, 6) for v in table.position_mm[row]), *(fixed(v, 9) for v in table.normal[row])]
        rest = [str(table.ids[row]), *(f"{v:.6g}" for v in sigmas[row]), str(table.quality[row])]
        head.append(" ".join([*numbers, *rest]))
    return "\n".join(head) + "\n"


def table_text(path: str | os.PathLike[str], what: str) -> str:
    """Text of a table of `what`. Raises InputError when the file cannot be read or is no text."""
    try:
        if os.path.getsize(path) > LARGEST_FILE_BYTES:
            raise InputError(f"{path} is larger than {LARGEST_FILE_BYTES // 10**6} MB, so it is no table of {what}")
        text = Path(path).read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no table of {what}: it is not text in UTF-8") from error
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the table of {what} {path}: {getattr(error, 'strerror', None) or error}") from error
    return text


def table_rows(
    text: str, source: str, what: str, columns: tuple[str, ...], sigmas: Collection[str]
) -> tuple[list[int], NDArray[np.float64], list[int]]:
    """Ids, numbers (N, columns but the first and last) and quality bits of a table of `what`; cells of `sigmas` may be empty.

    Raises InputError, naming the line, when the text is not exactly such a table.
    """
    try:
        rows = list(csv.reader(io.StringIO(text), strict=True))
    except csv.Error as error:
        raise InputError(f"{source} is no CSV: {error}") from error
    if not rows or tuple(rows[0]) != columns:
        raise InputError(f"{source} is no table of {what}: its first line must be {','.join(columns)}")
    ids, values, quality = [], [], []
    for number, row in enumerate(rows[1:], start=2):
        try:
            if len(row) != len(columns):
                raise InputError(f"{len(columns)} columns are needed, not {len(row)}")
            ids.append(id_of(row[0]))
            values.append([value_of(name, cell, name in sigmas) for name, cell in zip(columns[1:-1], row[1:-1], strict=True)])
            quality.append(bits_of(row[-1]))
        except InputError as error:
            raise InputError(f"{source}, line {number}: {error}") from error
    if len(set(ids)) < len(ids):
        raise InputError(f"{source}: the id {next(i for i in ids if ids.count(i) > 1)} stands in it twice")
    table = np.asarray(values, dtype=float).reshape(len(ids), len(columns) - 2)
    return ids, table, quality


def read_points(path: str | os.PathLike[str]) -> PointTable:
    """Read `points.csv`. Raises InputError, naming the file and the line, when it is not exactly such a table."""
    return parse_points(table_text(path, "points"), str(path))


def parse_points(text: str, source: str = "the table of points") -> PointTable:
    """Make a PointTable of the text of `points.csv`; `source` stands in messages. Raises InputError."""
    ids, table, quality = table_rows(text, source, "points", COLUMNS, SIGMAS)
    normal = table[:, 3:6]
    off = np.flatnonzero(np.abs(np.linalg.norm(normal, axis=1) - 1) > NORMAL_TOLERANCE)
    if off.size:
        raise InputError(f"{source}, line {off[0] + 2}: nx, ny, nz are not a unit vector")
    return PointTable(
        ids=np.asarray(ids, dtype=np.int64),
        position_mm=table[:, 0:3],
        normal=normal,
        center_px=table[:, 6:8],
        sigma_mm=table[:, 8:11],
        sigma_normal_rad=np.radians(table[:, 11]),
        sigma_px=table[:, 12:14],
        quality=np.asarray(quality, dtype=np.int64),
    )


def _sigmas(covariance: Array) -> Array:
    return np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))


def fixed(value: float, digits: int) -> str:
    """A number with so many decimals."""
    # + 0.0 writes 0 for -0
    return f"{round(float(value), digits) + 0.0:.{digits}f}"


def id_of(cell: str) -> int:
    """The id in a cell of a table. Raises InputError."""
    if not (cell.isascii() and cell.isdecimal() and len(cell) < 11 and int(cell) < 2**31):
        raise InputError(f"an id must be a whole number, not {cell[:30]!r}")
    return int(cell)


def value_of(name: str, cell: str, sigma: bool) -> float:
    """The finite number in a cell of the column `name`; a sigma is not negative, and NaN where the cell is empty. Raises InputError."""
    if not cell and sigma:
        return math.nan
    try:
        value = float(cell)
    except ValueError as error:
        raise InputError(f"{name} must be a number, not {cell[:30]!r}") from error
    if not math.isfinite(value):
        raise InputError(f"{name} must be a finite number, not {cell!r}")
    if sigma and value < 0:
        raise InputError(f"{name} must not be negative, as {cell} is")
    return value


def bits_of(cell: str) -> int:
    """The quality bits in a cell of a table. Raises InputError."""
    bits = 0
    for name in cell.split("|") if cell else []:
        if name != name.lower() or name.upper() not in Quality.__members__ or name == "clean":
            known = ", ".join(str(flag.name).lower() for flag in Quality if flag)
            raise InputError(f"unknown quality flag {name[:30]!r}; known are {known}")
        bits |= int(Quality[name.upper()])
    return bits
