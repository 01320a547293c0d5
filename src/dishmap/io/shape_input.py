"""The shape of a reflector from what `dishmap diff` or `dishmap map` left: a folder, or one of the files in it."""

from __future__ import annotations

import json
from pathlib import Path

from dishmap.camera.model import Camera
from dishmap.errors import InputError
from dishmap.io.camera_file import read_camera
from dishmap.io.difference_file import read_difference
from dishmap.io.difference_map_file import DIFFERENCE_FILE, is_difference_map, read_difference_map
from dishmap.io.measurement_file import MEASUREMENT_FILE, read_measurement
from dishmap.io.pattern_file import read_pattern
from dishmap.pipeline import cloud_of
from dishmap.rf.antenna import Reflector
from dishmap.rf.shape_field import ShapeField
from dishmap.rf.shape_sources import check_surface, shape_field_of_difference, shape_field_of_points, shape_field_of_table
from dishmap.surface.cloud import transform_cloud
from dishmap.targets.pattern import Pattern

TABLE_FILE, SUMMARY_FILE = "difference.csv", "summary.json"
# In this order: what holds the covariance comes first.
FILES = (DIFFERENCE_FILE, TABLE_FILE, MEASUREMENT_FILE)


def read_shape_field(
    path: str | Path, reflector: Reflector, quantity: str = "shape", camera: Camera | None = None, pattern: Pattern | None = None
) -> ShapeField:
    """The shape of a reflector from a folder of `dishmap diff` or `dishmap map`, or from one of the files in FILES.

    quantity: of a difference, `shape` or `displacement`; a map has the deviation from the nominal paraboloid. camera, pattern: with which a
    map was measured; where they are not given, the files that its summary.json names are read. Raises InputError for a path that holds no
    shape, or the shape of another reflector.
    """
    file = shape_file(path)
    if file.suffix.lower() == ".csv":
        return shape_field_of_table(read_difference(file), reflector, quantity)
    if is_difference_map(file):
        return shape_field_of_difference(read_difference_map(file), reflector, quantity)
    camera = camera or read_camera(_input_of(file, "camera"))
    pattern = pattern or read_pattern(_input_of(file, "pattern"))
    check_surface(pattern.surface, reflector)
    poses = read_measurement(file, camera, pattern).poses
    cloud = transform_cloud(cloud_of(poses), poses.camera_from_dish.inverse(), "dish")
    return shape_field_of_points(cloud, reflector, camera.covariance)


def shape_file(path: str | Path) -> Path:
    """The file that a path to a shape means: itself, or the one of FILES in a folder. Raises InputError when there is none."""
    place = Path(path)
    if place.is_dir():
        found = next((place / name for name in FILES if (place / name).is_file()), None)
        if found is None:
            inner = sorted(one.name for one in place.iterdir() if any((one / name).is_file() for name in FILES))
            states = f"; give one of the folders in it ({', '.join(inner[:5])})" if inner else ""
            raise InputError(
                f"the folder {path} holds no {', '.join(FILES[:-1])} or {FILES[-1]} of `dishmap diff` or `dishmap map`{states}"
            )
        return found
    if not place.is_file():
        raise InputError(f"cannot read the shape {path}: there is no such file or folder; check the name")
    if place.suffix.lower() not in (".csv", ".npz"):
        raise InputError(
            f"{path} is no shape; give a folder of `dishmap diff` or `dishmap map`, or its {', '.join(FILES[:-1])} or {FILES[-1]}"
        )
    return place


def _input_of(file: Path, what: str) -> Path:
    """The camera or pattern file with which the map beside `file` was made, from its summary. Raises InputError when it is not known."""
    summary = file.parent / SUMMARY_FILE
    try:
        place = Path(str(json.loads(summary.read_text(encoding="utf-8"))["inputs"][what]["path"]))
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{file} can only be read with the {what} it was measured with; give the {what} file") from error
    if not place.is_file():
        raise InputError(f"{file} was measured with the {what} {place}, which is no longer there; give the {what} file")
    return place
