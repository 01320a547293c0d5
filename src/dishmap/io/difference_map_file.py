"""Difference files with covariance, `difference.npz`: what each target did, and how the errors of all of them go together.

A NumPy archive without pickled objects: one array for each column of `SavedDifference`, and `header`, JSON text with the format's name
and what is common to all targets. `difference.csv` holds the same values for people, with sigmas only.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.difference.difference_map import Significance
from dishmap.difference.saved import SavedDifference
from dishmap.errors import InputError
from dishmap.io.archive import archive_bytes, archive_file, finite, reason_of, unpacked
from dishmap.io.atomic import write_bytes
from dishmap.quality import Quality
from dishmap.targets.pattern import Surface
from dishmap.transforms import Pose

Array = NDArray[Any]

DIFFERENCE_FILE = "difference.npz"
FORMAT = "dishmap-difference-map/1"
WHAT, AGAIN = "difference", "make it again with `dishmap diff`"
# Within which the header's first key stands.
BEGINNING_BYTES = 1024
# Columns: name -> shape of one target's value; None: any number.
WHOLE = {"ids": (), "quality": ()}
REAL: dict[str, tuple[int | None, ...]] = {
    "nominal_mm": (3,),
    "normal": (3,),
    "displacement_mm": (),
    "shape_mm": (),
    "displacement_factor": (None,),
    "displacement_own_mm2": (),
    "shape_factor": (None,),
    "shape_own_mm2": (),
}
# Unit vectors and symmetric matrices are so to this, relative to their size.
ROUNDING = 1e-6


def difference_bytes(saved: SavedDifference) -> bytes:
    """The bytes of a difference file."""
    motion = saved.rigid_motion
    header = {
        "format": FORMAT,
        "surface": asdict(saved.surface),
        "rigid_motion": {"rotation": motion.rotation.tolist(), "mm": motion.translation_mm.tolist()},
        "rigid_covariance_mm_rad": np.asarray(saved.rigid_covariance, dtype=float).tolist(),
        "significance": {name: float(value) for name, value in asdict(saved.significance).items()},
        "converged": bool(saved.converged),
    }
    return archive_bytes(header, {name: getattr(saved, name) for name in WHOLE}, {name: getattr(saved, name) for name in REAL})


def write_difference_map(path: str | Path, saved: SavedDifference) -> None:
    """Write a difference file, whole or not at all. Raises InputError when it cannot be written."""
    write_bytes(path, difference_bytes(saved))


def is_difference_map(path: str | Path) -> bool:
    """Whether a file begins as a difference file does; False when it cannot be read."""
    try:
        with Path(path).open("rb") as stream:
            # the header comes first, and nothing in the archive is compressed
            return FORMAT.partition("/")[0].encode() in stream.read(BEGINNING_BYTES)
    except (OSError, ValueError):
        return False


def read_difference_map(path: str | Path) -> SavedDifference:
    """Read `difference.npz`. Raises InputError, in one sentence, for a file that is no such difference or is damaged."""
    return parse_difference_map(archive_file(path, WHAT), str(path))


def parse_difference_map(data: bytes, source: str = "the difference") -> SavedDifference:
    """Make a SavedDifference of the bytes of a file; `source` stands in messages. Raises InputError."""
    header, arrays = unpacked(data, source, WHAT, FORMAT, AGAIN)
    try:
        return _saved(header, arrays)
    except (InputError, ValueError, KeyError, TypeError, IndexError, OverflowError, AttributeError) as error:
        raise InputError(f"{source} is damaged ({reason_of(error)}); {AGAIN}") from error


def _saved(header: dict[str, Any], arrays: dict[str, Array]) -> SavedDifference:
    columns = _columns(arrays)
    motion, significance = header["rigid_motion"], header["significance"]
    covariance = np.asarray(header["rigid_covariance_mm_rad"], dtype=float)
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise InputError("the covariance of the rigid motion is none")
    if not isinstance(header["converged"], bool):
        raise InputError("converged must be true or false")
    sizes: dict[str, Any] = {name: value if name == "kind" or value is None else finite(value) for name, value in header["surface"].items()}
    return SavedDifference(
        **columns,
        surface=Surface(**sizes),
        rigid_motion=Pose(np.asarray(motion["rotation"], dtype=float), np.asarray(motion["mm"], dtype=float)),
        rigid_covariance=covariance,
        significance=Significance(
            finite(significance["chi_square"]), int(finite(significance["degrees"])), finite(significance["p_value"])
        ),
        converged=header["converged"],
    )


def _columns(arrays: dict[str, Array]) -> dict[str, Array]:
    """The arrays of N targets, checked. Raises InputError, or KeyError for one that is missing."""
    count = len(arrays["ids"])
    out: dict[str, Array] = {}
    for name, shape in {**WHOLE, **REAL}.items():
        values, kind = arrays[name], "i" if name in WHOLE else "f"
        fits = values.ndim == 1 + len(shape) and all(a in (None, b) for a, b in zip((count, *shape), values.shape, strict=True))
        if not fits or values.dtype.kind != kind:
            raise InputError(f"{name} has shape {values.shape}")
        if not np.isfinite(values).all():
            raise InputError(f"{name} holds NaN")
        out[name] = values.astype(np.int64 if kind == "i" else float)
    if not count:
        raise InputError("it holds no target")
    if len(np.unique(out["ids"])) < count:
        raise InputError("a target stands in it twice")
    if np.abs(np.linalg.norm(out["normal"], axis=1) - 1).max() > ROUNDING:
        raise InputError("a normal is no unit vector")
    if min(out["displacement_own_mm2"].min(), out["shape_own_mm2"].min()) < 0:
        raise InputError("a variance is negative")
    if (out["quality"] & ~sum(int(bit) for bit in Quality)).any():
        raise InputError("a quality flag is unknown")
    return out
