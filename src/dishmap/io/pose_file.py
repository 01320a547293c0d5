"""Pose files: JSON of one rigid transform whose key names both frames.

    {"camera_from_dish": {"rotation_vector_deg": [180, 0, 0], "translation_mm": [0, 0, 1000]}}

The rotation vector is axis times angle. The same form is read for `--pose-guess` and `--spacecraft`, and written in summaries.
"""

from __future__ import annotations

import difflib
import json
import os
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.io.atomic import write_text
from dishmap.transforms import Pose

ROTATION, TRANSLATION = "rotation_vector_deg", "translation_mm"
LARGEST_FILE_BYTES = 100_000
# Twice a whole turn, so that angles may be written from -360 to 360; and 100 km: more is a mistake in the units.
LARGEST_ANGLE_DEG, LARGEST_TRANSLATION_MM = 720.0, 1e8


def read_pose(path: str | os.PathLike[str], key: str) -> Pose:
    """Read the pose called `key` (such as `camera_from_dish`), the only one in the file.

    Raises InputError, naming the file and what is wrong in it.
    """
    try:
        if os.path.getsize(path) > LARGEST_FILE_BYTES:
            raise InputError(f"{path} is larger than {LARGEST_FILE_BYTES // 1000} kB, so it is no pose file")
        text = Path(path).read_bytes().decode("utf-8-sig")
    except (OSError, ValueError) as error:
        if isinstance(error, UnicodeDecodeError):
            raise InputError(f"{path} is no pose file: it is not text in UTF-8") from error
        raise InputError(f"cannot read the pose file {path}: {getattr(error, 'strerror', None) or error}") from error
    return parse_pose(text, key, str(path))


def parse_pose(text: str, key: str, source: str = "the pose") -> Pose:
    """Make a Pose of the text of a pose file; `source` stands in messages. Raises InputError."""
    try:
        content = json.loads(text, parse_constant=_no_constant, object_pairs_hook=_without_repeats)
    except json.JSONDecodeError as error:
        raise InputError(f"{source} is not valid JSON: {error}") from error
    except RecursionError as error:
        raise InputError(f"{source} is nested too deeply for a pose file") from error
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    try:
        pose = _only(content, (key,), "the file")[key]
        parts = _only(pose, (ROTATION, TRANSLATION), key)
        turn = _three(parts[ROTATION], f"{key}.{ROTATION}", LARGEST_ANGLE_DEG, "degrees")
        move = _three(parts[TRANSLATION], f"{key}.{TRANSLATION}", LARGEST_TRANSLATION_MM, "mm")
    except InputError as error:
        raise InputError(
            f'{source}: {error}; a pose file is {{"{key}": {{"{ROTATION}": [0, 0, 0], "{TRANSLATION}": [0, 0, 0]}}}}'
        ) from error
    return Pose.from_rotation_vector(np.radians(turn), move)


def pose_content(pose: Pose) -> dict[str, list[float]]:
    """A pose as it stands in files, in degrees and mm."""
    return {
        ROTATION: [round(float(v), 9) + 0.0 for v in np.degrees(pose.rotation_vector_rad)],
        TRANSLATION: [round(float(v), 9) + 0.0 for v in pose.translation_mm],
    }


def format_pose(pose: Pose, key: str) -> str:
    """The text of a pose file."""
    return json.dumps({key: pose_content(pose)}, indent=1) + "\n"


def write_pose(path: str | os.PathLike[str], pose: Pose, key: str) -> None:
    """Write a pose file, whole or not at all. Raises InputError when it cannot be written."""
    write_text(Path(path), format_pose(pose, key))


def _no_constant(name: str) -> NoReturn:
    raise InputError(f"{name} is not a number that can be used; give finite numbers")


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    for key in keys:
        if keys.count(key) > 1:
            raise InputError(f"the key {key!r} stands in it twice")
    return dict(pairs)


def _only(content: Any, keys: tuple[str, ...], where: str) -> dict[str, Any]:
    """`content` if it is an object with exactly these keys."""
    if not isinstance(content, dict):
        raise InputError(f"{where} must be an object with {' and '.join(map(repr, keys))}")
    for given in content:
        if given not in keys:
            near = difflib.get_close_matches(given, keys, n=1, cutoff=0.0)[0]
            raise InputError(f"unknown key {given!r} in {where}; the nearest valid one is {near!r}")
    for key in keys:
        if key not in content:
            raise InputError(f"{where} lacks the key {key!r}")
    return content


def _three(values: Any, name: str, largest: float, unit: str) -> NDArray[np.float64]:
    numbers = isinstance(values, list) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    # comparing, not converting: an integer may be too long for a float
    if not numbers or len(values) != 3 or not all(-largest <= v <= largest for v in values):
        shown = json.dumps(values)
        raise InputError(f"{name} needs three numbers within {largest:g} {unit}, not {shown if len(shown) <= 60 else f'{shown[:57]}...'}")
    return np.asarray(values, dtype=float)
