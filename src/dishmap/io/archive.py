"""NumPy archives of arrays with a JSON header, as measurements and differences are kept: no pickles, nothing unpacked unseen."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError

Array = NDArray[Any]

HEADER = "header"
# 10,000 targets take 30 MB.
LARGEST_FILE_BYTES = 200_000_000
# What an archive may unpack to, relative to its size: arrays are stored as they are, so there is only the header of the archive.
LARGEST_UNPACKED = 1.5


def archive_bytes(header: Mapping[str, Any], whole: Mapping[str, Array], real: Mapping[str, Array]) -> bytes:
    """The bytes of an archive with a header, arrays of whole numbers and of real ones."""
    arrays = {name: np.asarray(values, dtype="<i8") for name, values in whole.items()}
    arrays |= {name: np.asarray(values, dtype="<f8") for name, values in real.items()}
    out = io.BytesIO()
    np.savez(out, **{HEADER: np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)}, **arrays)  # type: ignore[arg-type]
    return out.getvalue()


def archive_file(path: str | Path, what: str) -> bytes:
    """The bytes of a file that should be an archive; `what` it is of stands in messages. Raises InputError."""
    try:
        if os.path.getsize(path) > LARGEST_FILE_BYTES:
            raise InputError(f"{path} is larger than {LARGEST_FILE_BYTES // 10**6} MB, so it is no {what}")
        return Path(path).read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the {what} {path}: {getattr(error, 'strerror', None) or error}") from error


def unpacked(data: bytes, source: str, what: str, form: str, again: str) -> tuple[dict[str, Any], dict[str, Array]]:
    """Header and arrays of an archive in the format `form`; source, what it is and how to make it again stand in messages.

    Raises InputError.
    """
    try:
        arrays = _arrays(data)
        header = json.loads(bytes(arrays.pop(HEADER).astype(np.uint8)).decode())
        found = header["format"]
    except (zipfile.BadZipFile, OSError, ValueError, KeyError, TypeError, EOFError, RecursionError, NotImplementedError) as error:
        raise InputError(f"{source} is no whole {what} of dishmap; {again}") from error
    if found != form:
        raise InputError(f"{source} has the format {str(found)[:40]!r}, and {form!r} is read; {again}")
    return header, arrays


def finite(value: Any) -> float:
    """A number of a header. Raises InputError when it is not finite."""
    number = float(value)
    if not np.isfinite(number):
        raise InputError("a number is not finite")
    return number


def reason_of(error: Exception) -> str:
    """What is wrong, in a few words."""
    return f"{error} is missing" if isinstance(error, KeyError) else " ".join(str(error).split())[:100]


def _arrays(data: bytes) -> dict[str, Array]:
    """All arrays of an archive, without unpacking more than is in it."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(item.file_size for item in archive.infolist()) > LARGEST_UNPACKED * len(data):
            raise ValueError("it unpacks to more than it holds")
    with np.load(io.BytesIO(data), allow_pickle=False) as loaded:
        return {name: loaded[name] for name in loaded.files}
