"""Pictures written as files: PNG, TIFF, BMP, JPEG or WebP, 8 bits, and the first two 16 bits as well."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.io.atomic import write_bytes

# largest number of bits by the end of the name
FORMATS = {".png": 16, ".tif": 16, ".tiff": 16, ".bmp": 8, ".jpg": 8, ".jpeg": 8, ".webp": 8}
QUALITY = {".jpg": [cv2.IMWRITE_JPEG_QUALITY, 95], ".jpeg": [cv2.IMWRITE_JPEG_QUALITY, 95], ".webp": [cv2.IMWRITE_WEBP_QUALITY, 101]}


def check_picture_name(path: str | Path) -> None:
    """Raise InputError unless the name ends in a format that can be written."""
    suffix = Path(path).suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"cannot write {path}: a picture's name must end in one of {', '.join(FORMATS)}")


def picture_bytes(image: NDArray[np.generic], suffix: str = ".png") -> bytes:
    """A grey picture (H, W) or a coloured one (H, W, 3; blue, green, red), uint8 or uint16, as the bytes of a file.

    Raises InputError for a type or number of bits that the format does not hold.
    """
    suffix = suffix.lower()
    check_picture_name(f"picture{suffix}")
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3):
        raise InputError(f"a picture to be written must be uint8 or uint16 with 2 or 3 axes, not {image.dtype} {image.shape}")
    if image.dtype.itemsize * 8 > FORMATS[suffix]:
        raise InputError(f"{suffix} files hold {FORMATS[suffix]} bits and the picture has 16; write .png or .tif")
    try:
        done, data = cv2.imencode(suffix, image, QUALITY.get(suffix, []))  # type: ignore[arg-type]  # uint8 or uint16 by now
    except cv2.error as error:
        raise InputError(f"a picture of {image.shape[1]}x{image.shape[0]} px cannot be written as {suffix}: {error.err}") from error
    if not done:
        raise InputError(f"a picture of {image.shape[1]}x{image.shape[0]} px cannot be written as {suffix}; write .png")
    return data.tobytes()


def write_picture(path: str | Path, image: NDArray[np.generic]) -> None:
    """Write a picture in the format of its name's end, all of it or nothing. Raises InputError when that cannot be done."""
    check_picture_name(path)
    write_bytes(path, picture_bytes(image, Path(path).suffix))
