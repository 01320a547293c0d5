"""Measurement files, `measurement.npz`: the measured targets of one photograph, exactly, so that later ones can be compared with it.

A NumPy archive without pickled objects: one array for each field of `TargetPoses`, and `header`, JSON text with the format's name, what
is common to all targets, and fingerprints of camera and pattern, so that a measurement is not compared through other ones.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.errors import InputError
from dishmap.io.atomic import write_bytes
from dishmap.io.pattern_file import format_pattern
from dishmap.quality import Quality
from dishmap.targets.pattern import Pattern
from dishmap.targets.pose import SheetSummary, TargetPoses
from dishmap.targets.scene_noise import NoiseModel
from dishmap.transforms import Pose

Array = NDArray[Any]

MEASUREMENT_FILE = "measurement.npz"
FORMAT = "dishmap-measurement/1"
HEADER = "header"
# 10,000 targets take 30 MB.
LARGEST_FILE_BYTES = 200_000_000
# What an archive may unpack to, relative to its size: arrays are stored as they are, so there is only the header of the archive.
LARGEST_UNPACKED = 1.5
MAGIC = b"PK\x03\x04"
# Columns: name -> shape of one target's value; `P` stands for the number of the camera's parameters.
WHOLE = {"index": (), "ids": (), "quality": ()}
REAL: dict[str, tuple[int | str, ...]] = {
    "position_mm": (3,),
    "normal": (3,),
    "rotation": (3, 3),
    "covariance": (6, 6),
    "information": (7, 7),
    "pull": (7,),
    "prior": (7,),
    "center_px": (2,),
    "covariance_px2": (2, 2),
    "sigma_normal_rad": (),
    "calibration_jacobian": (3, "P"),
    "blur_px": (),
    "offset_mm": (),
    "contrast": (),
    "noise": (),
    "kept": (),
}
# Matrices that weigh: symmetric to this part of their largest element, and without negative eigenvalues beyond it.
WEIGHING = ("covariance", "covariance_px2", "information")
ROUNDING = 1e-6


@dataclass(frozen=True)
class Measurement:
    """A saved measurement: poses; photograph_sha256: of the file it was measured in."""

    poses: TargetPoses
    photograph_sha256: str


def camera_fingerprint(camera: Camera) -> str:
    """A digest of the camera's size, lens model and parameters; its covariance does not count."""
    numbers = np.array([camera.width_px, camera.height_px, *camera.parameters], dtype="<f8")
    return hashlib.sha256(camera.model.encode() + numbers.tobytes()).hexdigest()


def pattern_fingerprint(pattern: Pattern) -> str:
    """A digest of all that a pattern holds."""
    return hashlib.sha256(format_pattern(pattern).encode()).hexdigest()


def measurement_bytes(poses: TargetPoses, camera: Camera, pattern: Pattern, photograph_sha256: str = "") -> bytes:
    """The bytes of a measurement file."""
    noise = poses.noise_model
    header = {
        "format": FORMAT,
        "camera_sha256": camera_fingerprint(camera),
        "pattern_sha256": pattern_fingerprint(pattern),
        "photograph_sha256": photograph_sha256,
        "camera_from_dish": {"rotation": poses.camera_from_dish.rotation.tolist(), "mm": poses.camera_from_dish.translation_mm.tolist()},
        "normal_sigma_rad": float(poses.normal_sigma_rad),
        "noise": [float(noise.base), float(noise.slope), float(noise.inflation)],
        "log_gamma": float(poses.log_gamma),
        "rejected": [[int(ident), str(why)] for ident, why in poses.rejected],
        "sheet": None if poses.sheet is None else {name: float(value) for name, value in asdict(poses.sheet).items()},
    }
    whole = {name: np.asarray(getattr(poses, name), dtype="<i8") for name in WHOLE}
    real = {name: np.asarray(getattr(poses, name), dtype="<f8") for name in REAL}
    out = io.BytesIO()
    np.savez(out, **{HEADER: np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)}, **whole, **real)  # type: ignore[arg-type]
    return out.getvalue()


def write_measurement(path: str | Path, poses: TargetPoses, camera: Camera, pattern: Pattern) -> None:
    """Write a measurement file, whole or not at all. Raises InputError when it cannot be written."""
    write_bytes(path, measurement_bytes(poses, camera, pattern))


def is_measurement(path: str | Path) -> bool:
    """Whether a file looks like a measurement and not like a photograph: an archive, or named so. False when it cannot be read."""
    try:
        with Path(path).open("rb") as stream:
            return stream.read(len(MAGIC)) == MAGIC or Path(path).suffix.lower() == ".npz"
    except (OSError, ValueError):
        return False


def read_measurement(path: str | Path, camera: Camera, pattern: Pattern) -> Measurement:
    """Read a measurement that was made through this camera and pattern.

    Raises InputError, in one sentence, for a file that is no measurement, is damaged, or belongs to another camera or pattern.
    """
    try:
        if os.path.getsize(path) > LARGEST_FILE_BYTES:
            raise InputError(f"{path} is larger than {LARGEST_FILE_BYTES // 10**6} MB, so it is no measurement")
        data = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the measurement {path}: {getattr(error, 'strerror', None) or error}") from error
    return parse_measurement(data, camera, pattern, str(path))


def parse_measurement(data: bytes, camera: Camera, pattern: Pattern, source: str = "the measurement") -> Measurement:
    """Make a Measurement of the bytes of a file; `source` stands in messages. Raises InputError."""
    try:
        arrays = _arrays(data)
        header = json.loads(bytes(arrays.pop(HEADER).astype(np.uint8)).decode())
        found = header["format"]
        digests = {name: str(header[f"{name}_sha256"]) for name in ("camera", "pattern", "photograph")}
    except (zipfile.BadZipFile, OSError, ValueError, KeyError, TypeError, EOFError, RecursionError, NotImplementedError) as error:
        raise InputError(f"{source} is no whole measurement of dishmap; make it again with `dishmap map`") from error
    if found != FORMAT:
        raise InputError(f"{source} has the format {str(found)[:40]!r}, and {FORMAT!r} is read; make it again with `dishmap map`")
    _check_made_with(digests, camera, pattern, source)
    try:
        return Measurement(_poses(header, arrays, camera, pattern), digests["photograph"])
    except (InputError, ValueError, KeyError, TypeError, IndexError, OverflowError) as error:
        raise InputError(f"{source} is damaged ({_reason(error)}); make it again with `dishmap map`") from error


def _arrays(data: bytes) -> dict[str, Array]:
    """All arrays of an archive, without unpacking more than is in it."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(item.file_size for item in archive.infolist()) > LARGEST_UNPACKED * len(data):
            raise ValueError("it unpacks to more than it holds")
    with np.load(io.BytesIO(data), allow_pickle=False) as loaded:
        return {name: loaded[name] for name in loaded.files}


def _check_made_with(digests: dict[str, str], camera: Camera, pattern: Pattern, source: str) -> None:
    for name, own in (("camera", camera_fingerprint(camera)), ("pattern", pattern_fingerprint(pattern))):
        if digests[name] != own:
            raise InputError(
                f"{source} was measured with another {name} file than the one given; give that one, or measure the photograph again"
            )


def _poses(header: dict[str, Any], arrays: dict[str, Array], camera: Camera, pattern: Pattern) -> TargetPoses:
    count = len(arrays["ids"])
    columns: dict[str, Array] = {}
    for name, shape in {**WHOLE, **REAL}.items():
        kind = "i" if name in WHOLE else "f"
        values = arrays[name]
        whole_shape = (count, *(len(camera.parameters) if size == "P" else size for size in shape))
        if values.shape != whole_shape or values.dtype.kind != kind:
            raise InputError(f"{name} has shape {values.shape}")
        if not np.isfinite(values).all():
            raise InputError(f"{name} holds NaN")
        columns[name] = values.astype(np.int64 if kind == "i" else float)
    _check_columns(columns, pattern)
    pose = header["camera_from_dish"]
    base, slope, inflation = (_number(value) for value in header["noise"])
    return TargetPoses(
        **columns,
        camera_from_dish=Pose(np.asarray(pose["rotation"], dtype=float), np.asarray(pose["mm"], dtype=float)),
        normal_sigma_rad=_number(header["normal_sigma_rad"]),
        noise_model=NoiseModel(base, slope, inflation),
        log_gamma=_number(header["log_gamma"]),
        rejected=tuple((int(ident), str(why)) for ident, why in header["rejected"]),
        sheet=_sheet(header["sheet"]),
    )


def _sheet(content: dict[str, Any] | None) -> SheetSummary | None:
    return None if content is None else SheetSummary(**{name: _number(value) for name, value in content.items()})


def _check_columns(columns: dict[str, Array], pattern: Pattern) -> None:
    index, rotation = columns["index"], columns["rotation"]
    if not len(index):
        raise InputError("it holds no target")
    if not (index.min() >= 0 and index.max() < len(pattern) and np.array_equal(pattern.ids[index], columns["ids"])):
        raise InputError("its ids are not the pattern's")
    if not (np.diff(index) > 0).all():
        raise InputError("a target stands in it twice")
    if np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max() > ROUNDING:
        raise InputError("a rotation is none")
    if (columns["quality"] & ~sum(int(bit) for bit in Quality)).any():
        raise InputError("a quality flag is unknown")
    for name in WEIGHING:
        matrix = columns[name]
        scale = np.sqrt(np.maximum(np.diagonal(matrix, axis1=1, axis2=2), 0.0))
        unit = matrix / np.maximum(scale[:, :, None] * scale[:, None, :], np.finfo(float).tiny)
        if np.abs(unit - np.swapaxes(unit, 1, 2)).max() > ROUNDING or np.linalg.eigvalsh(unit).min() < -ROUNDING:
            raise InputError(f"{name} is no covariance")


def _number(value: Any) -> float:
    number = float(value)
    if not np.isfinite(number):
        raise InputError("a number is not finite")
    return number


def _reason(error: Exception) -> str:
    return f"{error} is missing" if isinstance(error, KeyError) else " ".join(str(error).split())[:100]
