"""Cameras as other programs write them: ROS camera_info, mrcal's .cameramodel with OpenCV's lenses, Kalibr's camchain.

All of them use OpenCV's formulas and count pixels from the centre of the first one, so numbers are taken over as they are. None has a place
for the covariance of the parameters.
"""

from __future__ import annotations

import ast
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.errors import CameraError, InputError

Array = NDArray[np.float64]

# What each format's files end in, after the camera file's own name.
SUFFIXES = {"ros": ".ros.yaml", "mrcal": ".cameramodel", "kalibr": ".kalibr.yaml"}
FORMATS = tuple(SUFFIXES)
MRCAL_COUNTS = {"LENSMODEL_PINHOLE": 0, **{f"LENSMODEL_OPENCV{n}": n for n in (4, 5, 8, 12)}}
KALIBR_LENSES = {"radtan": "opencv", "equidistant": "fisheye", "equi": "fisheye", "none": "opencv"}
# A model with the observations of 1,000 views is smaller; parsing more takes minutes.
LARGEST_MODEL_CHARACTERS = 20_000_000


def camera_in_format(camera: Camera, form: str, name: str = "camera") -> str:
    """The text of a camera file in one of FORMATS; the covariance is left out.

    Raises InputError when the format has no place for the camera's lens model.
    """
    writers = {"ros": _ros, "mrcal": _mrcal, "kalibr": _kalibr}
    if form not in writers:
        raise InputError(f"unknown camera format {form!r}; use one of {', '.join(FORMATS)}")
    return writers[form](camera, name)


def is_mrcal(text: str) -> bool:
    """Whether a file's text is a .cameramodel."""
    first = next((line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")
    return first.startswith("{") and "lensmodel" in text


def is_kalibr(text: str) -> bool:
    """Whether a file's text is Kalibr's."""
    return re.search(r"^cam\d+:[ \t]*$", text, re.MULTILINE) is not None


def read_mrcal(text: str) -> Camera:
    """The camera of a .cameramodel. Raises CameraError for lens models other than OpenCV's."""
    try:
        if len(text) > LARGEST_MODEL_CHARACTERS:
            raise ValueError("too long")
        model = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError, TypeError) as error:
        raise CameraError("it looks like mrcal's .cameramodel but cannot be parsed; write it again with mrcal") from error
    if not isinstance(model, dict):
        raise CameraError("it looks like mrcal's .cameramodel but holds no keys; write it again with mrcal")
    lens = str(model.get("lensmodel", ""))
    if lens not in MRCAL_COUNTS:
        raise CameraError(f"its lens model {lens[:40]!r} is not modelled here; use mrcal-convert-lensmodel to LENSMODEL_OPENCV8")
    values, size = _numbers(model.get("intrinsics"), "intrinsics"), _numbers(model.get("imagersize"), "imagersize")
    if len(values) != 4 + MRCAL_COUNTS[lens] or len(size) != 2:
        raise CameraError(f"{lens} needs {4 + MRCAL_COUNTS[lens]} intrinsics and an imagersize of 2, not {len(values)} and {len(size)}")
    return Camera(_pixels(size[0]), _pixels(size[1]), values[:2], values[2:4], values[4:])


def read_kalibr(text: str) -> Camera:
    """The camera of a Kalibr file, which must hold one. Raises CameraError for lens models that are not OpenCV's."""
    names = re.findall(r"^(cam\d+):[ \t]*$", text, re.MULTILINE)
    if len(names) != 1:
        raise CameraError(f"it holds {len(names)} cameras ({', '.join(names[:4])}); keep one of them")
    model, lens = _word(text, "camera_model"), _word(text, "distortion_model")
    if model != "pinhole" or lens not in KALIBR_LENSES:
        raise CameraError(f"its models {model}-{lens} are not modelled here; pinhole-radtan and pinhole-equi are")
    values, size = _list(text, "intrinsics"), _list(text, "resolution")
    if len(values) != 4 or len(size) != 2:
        raise CameraError(f"it needs 4 intrinsics and a resolution of 2 numbers, not {len(values)} and {len(size)}")
    distortion = np.zeros(0) if lens == "none" else _list(text, "distortion_coeffs")
    return Camera(_pixels(size[0]), _pixels(size[1]), values[:2], values[2:], distortion, KALIBR_LENSES[lens])


def _ros(camera: Camera, name: str) -> str:
    model, distortion = _ros_lens(camera)
    (fx, fy), (cx, cy) = camera.focal_px.tolist(), camera.principal_px.tolist()
    lines = [f"image_width: {camera.width_px}", f"image_height: {camera.height_px}", f"camera_name: {_plain(name)}"]
    for key, rows, columns, data in (
        ("camera_matrix", 3, 3, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        ("distortion_coefficients", 1, len(distortion), distortion),
        ("rectification_matrix", 3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        ("projection_matrix", 3, 4, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
    ):
        if key == "distortion_coefficients":
            lines.append(f"distortion_model: {model}")
        lines += [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: {_bracketed(data)}"]
    return "\n".join(lines) + "\n"


def _ros_lens(camera: Camera) -> tuple[str, list[float]]:
    values = camera.distortion.tolist()
    if camera.model == "fisheye":
        return "equidistant", values
    if len(values) == 8:
        return "rational_polynomial", values
    if len(values) <= 5:
        return "plumb_bob", values + [0.0] * (5 - len(values))
    raise InputError("ROS camera_info has no place for thin prism terms (12 coefficients); calibrate with --lens 8")


def _mrcal(camera: Camera, _: str) -> str:
    if camera.model != "opencv":
        raise InputError("mrcal has no lens model like OpenCV's fisheye; calibrate with --lens 8")
    lens = next(name for name, count in MRCAL_COUNTS.items() if count == camera.distortion.size)
    return (
        "{\n"
        f"    'lensmodel':  '{lens}',\n\n"
        "    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....\n"
        f"    'intrinsics': {_bracketed(camera.parameters.tolist())},\n\n"
        "    # extrinsics are rt_fromref\n"
        "    'extrinsics': [ 0, 0, 0, 0, 0, 0 ],\n\n"
        f"    'imagersize': [ {camera.width_px}, {camera.height_px} ],\n"
        "}\n"
    )


def _kalibr(camera: Camera, _: str) -> str:
    values = camera.distortion.tolist()
    if camera.model == "opencv" and any(values[4:]):
        raise InputError(f"Kalibr's radtan lens has 4 coefficients, and this camera {len(values)}; calibrate with --lens 4")
    lens = "equidistant" if camera.model == "fisheye" else "radtan"
    values = (values + [0.0] * 4)[:4]
    lines = [
        "cam0:",
        "  cam_overlaps: []",
        "  camera_model: pinhole",
        f"  distortion_coeffs: {_bracketed(values)}",
        f"  distortion_model: {lens}",
        f"  intrinsics: {_bracketed([*camera.focal_px.tolist(), *camera.principal_px.tolist()])}",
        f"  resolution: [{camera.width_px}, {camera.height_px}]",
    ]
    return "\n".join(lines) + "\n"


def _bracketed(values: list[float]) -> str:
    return f"[{', '.join(repr(float(v)) for v in values)}]"


def _plain(name: str) -> str:
    """A name that needs no quotes in YAML."""
    return re.sub(r"[^A-Za-z0-9_]+", "_", name) or "camera"


def _numbers(values: Any, key: str) -> Array:
    try:
        out = np.array([float(v) for v in values])
    except (TypeError, ValueError) as error:
        raise CameraError(f"its {key} must be a list of numbers") from error
    if not np.isfinite(out).all():
        raise CameraError(f"its {key} must be finite numbers")
    return out


def _pixels(value: float) -> int:
    if not (1 <= value <= 1_000_000 and value == int(value)):
        raise CameraError(f"its picture size must be whole numbers of pixels, not {value:g}")
    return int(value)


def _word(text: str, key: str) -> str:
    found = re.search(rf"^[ \t]+{key}:[ \t]*[\"']?([\w-]+)[\"']?[ \t]*$", text, re.MULTILINE)
    if not found:
        raise CameraError(f"it looks like Kalibr's but has no {key}")
    return found[1]


def _list(text: str, key: str) -> Array:
    """Numbers of a key, in brackets or one a line."""
    found = re.search(rf"^[ \t]+{key}:[ \t]*(\[[^\]]*\]|(?:\n[ \t]*-[ \t]*[^\n]+)+)", text, re.MULTILINE)
    if not found:
        raise CameraError(f"it looks like Kalibr's but has no {key}")
    return _numbers([token for token in re.split(r"[\s,\[\]]+", found[1]) if token not in ("", "-")], key)
