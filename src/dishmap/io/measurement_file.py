"""Measurement files, `measurement.npz`: the measured targets of one photograph, exactly, so that later ones can be compared with it.

A NumPy archive without pickled objects: one array for each field of `TargetPoses`, and `header`, JSON text with the format's name, what
is common to all targets, and fingerprints of camera and pattern, so that a measurement is not compared through other ones.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.errors import InputError
from dishmap.io.archive import archive_bytes, archive_file, finite, reason_of, unpacked
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
WHAT, AGAIN = "measurement", "make it again with `dishmap map`"
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
    return archive_bytes(header, {name: getattr(poses, name) for name in WHOLE}, {name: getattr(poses, name) for name in REAL})


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
    return parse_measurement(archive_file(path, WHAT), camera, pattern, str(path))


def parse_measurement(data: bytes, camera: Camera, pattern: Pattern, source: str = "the measurement") -> Measurement:
    """Make a Measurement of the bytes of a file; `source` stands in messages. Raises InputError."""
    header, arrays = unpacked(data, source, WHAT, FORMAT, AGAIN)
    try:
        digests = {name: str(header[f"{name}_sha256"]) for name in ("camera", "pattern", "photograph")}
    except KeyError as error:
        raise InputError(f"{source} is no whole {WHAT} of dishmap; {AGAIN}") from error
    _check_made_with(digests, camera, pattern, source)
    try:
        return Measurement(_poses(header, arrays, camera, pattern), digests["photograph"])
    except (InputError, ValueError, KeyError, TypeError, IndexError, OverflowError) as error:
        raise InputError(f"{source} is damaged ({reason_of(error)}); {AGAIN}") from error


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
    base, slope, inflation = (finite(value) for value in header["noise"])
    return TargetPoses(
        **columns,
        camera_from_dish=Pose(np.asarray(pose["rotation"], dtype=float), np.asarray(pose["mm"], dtype=float)),
        normal_sigma_rad=finite(header["normal_sigma_rad"]),
        noise_model=NoiseModel(base, slope, inflation),
        log_gamma=finite(header["log_gamma"]),
        rejected=tuple((int(ident), str(why)) for ident, why in header["rejected"]),
        sheet=_sheet(header["sheet"]),
    )


def _sheet(content: dict[str, Any] | None) -> SheetSummary | None:
    return None if content is None else SheetSummary(**{name: finite(value) for name, value in content.items()})


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
