"""Photographs as grey arrays.

A photograph may be PNG, JPEG, TIFF, BMP, WebP or binary PGM or PPM, with 8 or 16 bits, grey, coloured, with alpha or turned
by EXIF. Colour becomes grey as 0.299 R + 0.587 G + 0.114 B of the stored values (ITU-R BT.601, as OpenCV); alpha is left
out of account. Pixels stay as the sensor gave them: a lens and its principal point are those of the sensor, whichever way a phone
thought it was held, so the turn that EXIF asks of viewers is not made (`read_turn_deg` tells it).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dishmap.errors import ImageError
from dishmap.io.image_header import ImageHeader, read_header

Gray = NDArray[np.uint8] | NDArray[np.uint16]

# Checked in the header, before any memory is asked for: 200 megapixels are twice what the largest cameras give.
LARGEST_PX = 200_000_000
SMALLEST_SIDE_PX = 16
LARGEST_FILE_BYTES = 2_000_000_000
# What takes the pixels that EXIF's orientation made back to how they are stored.
UNDO: dict[int, Callable[[Gray], Gray]] = {
    2: lambda gray: gray[:, ::-1],
    3: lambda gray: gray[::-1, ::-1],
    4: lambda gray: gray[::-1],
    5: lambda gray: gray.T,
    6: lambda gray: gray.T[::-1],
    7: lambda gray: gray.T[::-1, ::-1],
    8: lambda gray: gray.T[:, ::-1],
}


def read_gray(path: str | Path) -> Gray:
    """Read a photograph as grey values (height, width), uint8 or uint16 as stored.

    Raises ImageError, in one sentence, when the file is missing, empty, cut short, damaged, no picture, of a format or
    depth that is not read here, smaller than 16 px on a side or larger than 200 megapixels.
    """
    try:
        data = _read(Path(path))
        header = read_header(data)
        _check(header)
        return _decode(data, header)
    except ImageError as error:
        raise ImageError(f"cannot use {path} as a photograph: {error}") from error


def read_turn_deg(path: str | Path) -> int:
    """How far viewers turn a photograph clockwise, as its EXIF asks: 0, 90, 180 or 270 degrees. Raises ImageError as `read_gray` does."""
    try:
        return read_header(_read(Path(path))).turn_deg
    except ImageError as error:
        raise ImageError(f"cannot use {path} as a photograph: {error}") from error


def _read(path: Path) -> bytes:
    try:
        if path.is_dir():
            raise ImageError("it is a folder; name a picture in it")
        if path.exists() and not path.is_file():
            raise ImageError("it is a device or pipe, not a file")
        size = os.stat(path).st_size
        if size == 0:
            raise ImageError("the file is empty; copy it again")
        if size > LARGEST_FILE_BYTES:
            raise ImageError(f"the file has {size / 1e9:.1f} GB; photographs up to {LARGEST_FILE_BYTES / 1e9:g} GB are read")
        return path.read_bytes()
    except FileNotFoundError as error:
        raise ImageError("there is no such file; check the name") from error
    except (OSError, ValueError) as error:
        raise ImageError(f"it cannot be read ({getattr(error, 'strerror', None) or error}); check the name and its permissions") from error


def _check(header: ImageHeader) -> None:
    width, height = header.width_px, header.height_px
    if min(width, height) < SMALLEST_SIDE_PX:
        raise ImageError(f"it has {width}x{height} px; at least {SMALLEST_SIDE_PX}x{SMALLEST_SIDE_PX} are needed")
    if width * height > LARGEST_PX:
        raise ImageError(f"it has {width}x{height} px; up to {LARGEST_PX // 1_000_000} megapixels are read, so crop or scale it")
    if header.missing:
        raise ImageError(f"it is cut short ({header.missing} is missing); copy it again")


def _decode(data: bytes, header: ImageHeader) -> Gray:
    buffer = np.frombuffer(data, dtype=np.uint8)
    # libpng would mix colours in linear light where a file names its gamma, so PNG colours are mixed here
    mixed_here = header.kind == "PNG" and header.coloured
    mode = cv2.IMREAD_COLOR if mixed_here else cv2.IMREAD_GRAYSCALE
    try:
        with _quiet():
            image = cv2.imdecode(buffer, mode | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise ImageError(f"the {header.kind} cannot be decoded ({error.err}); save it again as PNG") from error
    if image is None:
        raise ImageError(f"the {header.kind} is damaged, cut short or of a rare kind; copy it again or save it as PNG")
    if image.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"its pixels are {image.dtype}; 8 or 16-bit whole numbers are needed, so convert it")
    gray: Gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if mixed_here else image  # type: ignore[assignment]
    if header.kind == "TIFF" and header.orientation in UNDO:  # OpenCV turns a TIFF whatever it is asked
        gray = UNDO[header.orientation](gray).copy()
    return gray


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep OpenCV's log away: what goes wrong is said once, in our sentence."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)
