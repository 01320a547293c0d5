"""Camera files: YAML as `cv2.FileStorage` writes it, with the covariance and the observations of a calibration beside it.

Keys that OpenCV's calibration programs write: image_width, image_height, camera_matrix, distortion_coefficients. Ours beside
them: model (`opencv` or `fisheye`), parameter_names and parameter_covariance, and of a calibration its rms, the rms and weight of
each view, the board's shape and print, motions during the readout, the corners it was made from, and what was left out. Other keys are
passed over, since OpenCV's files have many.

The parser is our own: it reads no more than such files need, exactly, and a hostile file meets Python instead of C++.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.camera.board import SHAPE_TERMS, BoardView
from dishmap.camera.calibrate import Calibration
from dishmap.camera.model import Camera
from dishmap.errors import CameraError, InputError
from dishmap.io.atomic import write_text
from dishmap.io.camera_formats import is_kalibr, is_mrcal, read_kalibr, read_mrcal

Array = NDArray[np.float64]

# 100 views of 1,000 corners take 10 MB.
LARGEST_FILE_BYTES = 100_000_000
LARGEST_SIDE_PX = 1_000_000
# What programs call the same thing, in lower case; the first name is the one we write.
WIDTH, HEIGHT = ("image_width", "width", "imagewidth"), ("image_height", "height", "imageheight")
MATRIX, DISTORTION = ("camera_matrix", "cameramatrix"), ("distortion_coefficients", "distcoeffs", "dist_coeffs")
LENS_NAMES = {"opencv": "opencv", "plumb_bob": "opencv", "rational_polynomial": "opencv", "fisheye": "fisheye", "equidistant": "fisheye"}
# A focal length outside these parts of the longer side is in mm, or of another picture.
FOCAL_OF_SIDE = (0.05, 1000.0)
# Off-diagonal rounding that a matrix may carry, relative to the focal length or the largest covariance.
ROUNDING = 1e-9
VALUES_PER_LINE = 5
SPECIAL = {".nan": np.nan, ".inf": np.inf, "+.inf": np.inf, "-.inf": -np.inf}

_KEY = re.compile(r"([A-Za-z_][\w.-]*)[ \t]*:(?:[ \t]+(.*))?$")
_STRING = re.compile(r'"(?:[^"\\]|\\.)*"')


def read_camera(path: str | Path) -> Camera:
    """Read a camera from OpenCV's YAML, with the covariance if the file has it; or as ROS, mrcal and Kalibr write it.

    Takes 0, 4, 5, 8 or 12 lens coefficients (14 without tilt), and ROS's distortion_model names.
    Raises CameraError, in one sentence, when the file cannot be read, lacks a key, or describes no possible camera.
    """
    try:
        text = _read(Path(path))
        if is_mrcal(text):
            return _checked(read_mrcal(text))
        if is_kalibr(text):
            return _checked(read_kalibr(text))
        return _camera(_sections(_yaml(text)))
    except CameraError as error:
        raise CameraError(f"cannot use {path} as a camera file: {error}") from error


def read_views(path: str | Path) -> tuple[BoardView, ...]:
    """Read the views of a board that a camera was calibrated from, all their corners; none if the file does not hold them.

    `calibrate` gives the same camera from them again. Raises CameraError as `read_camera`.
    """
    try:
        text = _read(Path(path))
        sections = {} if is_mrcal(text) or is_kalibr(text) else _sections(_yaml(text))
        if "corners" not in sections:
            return ()
        names = [str(json.loads(text)) for text in _STRING.findall(sections.get("view_names", ""))]
        view, corners = _matrix(sections, ("corner_view",))[:, 0], _matrix(sections, ("corners",))
        if corners.shape != (len(view), 5) or not np.isin(view, np.arange(len(names))).all():
            raise CameraError("corners, corner_view and view_names do not belong together; write the file again")
        radius = _matrix(sections, ("corner_radius_mm",)).ravel() if "corner_radius_mm" in sections else None
        if radius is not None and len(radius) != len(view):
            raise CameraError("corners and corner_radius_mm do not belong together; write the file again")
        rows = [view == k for k in range(len(names))]
        return tuple(
            BoardView(name, corners[row, :2], corners[row, 2:], None if radius is None else radius[row])
            for name, row in zip(names, rows, strict=True)
        )
    except (CameraError, InputError, ValueError) as error:
        raise CameraError(f"cannot read the views of {path}: {error}") from error


def write_camera(path: str | Path, camera: Camera, calibration: Calibration | None = None) -> None:
    """Write a camera file, all of it or nothing; with a calibration also its views. Raises InputError when that cannot be done."""
    write_text(path, camera_text(camera, calibration))


def camera_text(camera: Camera, calibration: Calibration | None = None) -> str:
    """Return the text of a camera file. Numbers have as many digits as it takes to read back the same ones."""
    lines = [
        *("%YAML:1.0", "---"),
        *(f"image_width: {camera.width_px}", f"image_height: {camera.height_px}"),
        *_matrix_lines("camera_matrix", camera.matrix),
        *_matrix_lines("distortion_coefficients", camera.distortion[None, :]),
        f"model: {camera.model}",
    ]
    if camera.covariance is not None:
        lines += [f"parameter_names: [ {', '.join(camera.parameter_names)} ]", *_matrix_lines("parameter_covariance", camera.covariance)]
    if calibration is not None:
        lines += _calibration_lines(calibration)
    return "\n".join(lines) + "\n"


def _calibration_lines(calibration: Calibration) -> list[str]:
    corners = [np.concatenate([view.pixels, view.board_mm], axis=1) for view in calibration.views]
    index = np.repeat(np.arange(len(corners)), [len(part) for part in corners])
    board = calibration.board
    radius = [np.zeros(len(view.pixels)) if view.radius_mm is None else view.radius_mm for view in calibration.views]
    circles = _matrix_lines("corner_radius_mm", np.concatenate(radius)[:, None]) if any(r.any() for r in radius) else []
    return [
        f"calibration_lens: {calibration.lens}",
        f"calibration_rms_px: {_number(calibration.rms_px)}",
        f"calibration_inflation: {_number(calibration.inflation)}",
        _strings("view_names", calibration.view_names),
        *_matrix_lines("view_rms_px", calibration.view_rms_px[None, :]),
        _strings("rejected_views", (f"{name}: {reason}" for name, reason in calibration.rejected.items())),
        *_matrix_lines("view_weight", calibration.view_weight[None, :]),
        f"board_shape_names: [ {', '.join(SHAPE_TERMS)} ]",
        *_matrix_lines("board_shape_mm", board.shape_mm[None, :]),
        *_matrix_lines("board_shape_sigma_mm", np.sqrt(np.diag(board.covariance_mm2))[None, :]),
        f"board_print_sigma_mm: {_number(board.print_sigma_mm)}",
        *(_matrix_lines("board_print_mm", np.concatenate([board.points_mm, board.print_mm], axis=1)) if board.print_sigma_mm else []),
        f"calibration_readout: {calibration.readout}",
        *(_matrix_lines("view_motion", calibration.motion) if calibration.motion_sigma_mm else []),
        *_matrix_lines("corner_view", index[:, None], "i"),
        *_matrix_lines("corner_used", np.concatenate(calibration.used)[:, None], "i"),
        *_matrix_lines("corners", np.concatenate(corners)),
        *circles,
    ]


def _strings(key: str, values: Iterable[str]) -> str:
    quoted = [json.dumps(value, ensure_ascii=False) for value in values]
    return f"{key}: [ {', '.join(quoted)} ]" if quoted else f"{key}: []"


def _number(value: float) -> str:
    text = repr(float(value))
    return {"nan": ".Nan", "inf": ".Inf", "-inf": "-.Inf"}.get(text, text)


def _matrix_lines(key: str, values: ArrayLike, kind: str = "d") -> list[str]:
    """A matrix as OpenCV writes it; kind `d` for doubles, `i` for integers."""
    matrix = np.asarray(values)
    numbers = [str(int(v)) if kind == "i" else _number(v) for v in matrix.ravel()]
    rows = [", ".join(numbers[k : k + VALUES_PER_LINE]) for k in range(0, len(numbers), VALUES_PER_LINE)]
    data = "[ " + ",\n       ".join(rows) + " ]" if rows else "[]"
    return [f"{key}: !!opencv-matrix", f"   rows: {matrix.shape[0]}", f"   cols: {matrix.shape[1]}", f"   dt: {kind}", f"   data: {data}"]


def _read(path: Path) -> str:
    try:
        if path.exists() and not path.is_file():
            raise CameraError("it is not a file")
        size = path.stat().st_size
        if size > LARGEST_FILE_BYTES:
            raise CameraError(f"it has {size / 1e6:.0f} MB; a camera file has some kilobytes")
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError as error:
        raise CameraError("there is no such file; check the name") from error
    except UnicodeDecodeError as error:
        raise CameraError("it is not text; OpenCV's YAML is needed") from error
    except (OSError, ValueError) as error:
        raise CameraError(f"it cannot be read ({getattr(error, 'strerror', None) or error})") from error
    return text


def _yaml(text: str) -> str:
    """The text, if it is not plainly something else."""
    start = text.lstrip()[:1]
    if start in ("{", "<"):
        raise CameraError(f"it is {'JSON' if start == '{' else 'XML'}; OpenCV's YAML is needed, so write it with a name that ends in .yaml")
    return text


def _sections(text: str) -> dict[str, str]:
    """Top-level keys in lower case, each with the text that belongs to it."""
    blocks: dict[str, list[str]] = {}
    current: list[str] | None = None
    for number, raw in enumerate(text.splitlines(), start=1):
        bare = re.split(r"(?:^|\s)#", raw, maxsplit=1)[0]
        line = raw if '"' in bare or "'" in bare else bare  # a # inside quotes is no comment
        if not line.strip() or line.startswith(("%", "---", "...")):
            continue
        if line[0] in " \t-]" and current is not None:
            current.append(line)
        elif match := _KEY.match(line):
            key = match[1].lower()
            if key in blocks:
                raise CameraError(f"{match[1]} stands in it twice (line {number})")
            current = blocks[key] = [match[2] or ""]
        else:
            raise CameraError(f"line {number} is not `key: value`; OpenCV's YAML is needed")
    return {key: "\n".join(lines) for key, lines in blocks.items()}


def _find(sections: dict[str, str], names: tuple[str, ...]) -> str:
    for name in names:
        if name in sections:
            return sections[name]
    raise CameraError(f"it has no {names[0]}; image_width, image_height, camera_matrix and distortion_coefficients are needed")


def _value(token: str, key: str) -> float:
    try:
        return SPECIAL[token.lower()] if token.lower() in SPECIAL else float(token)
    except ValueError as error:
        raise CameraError(f"{token[:30]!r} in {key} is not a number") from error


def _size(sections: dict[str, str], names: tuple[str, ...]) -> int:
    value = _value(_find(sections, names).strip(), names[0])
    if not (1 <= value <= LARGEST_SIDE_PX and value == int(value)):
        raise CameraError(f"{names[0]} must be a whole number of pixels up to {LARGEST_SIDE_PX}, not {value:g}")
    return int(value)


def _matrix(sections: dict[str, str], names: tuple[str, ...]) -> Array:
    """A matrix, of OpenCV's or ROS's form (rows, cols, data) or as plain lists (one row)."""
    key, block = names[0], _find(sections, names)
    data = re.search(r"\bdata[ \t]*:(.*?)(?=\n\s*[A-Za-z_]\w*[ \t]*:|\Z)", block, re.DOTALL)
    body = data[1] if data else block
    tokens = [token for token in re.split(r"[\s,\[\]]+", body) if token not in ("", "-")]
    values = np.array([_value(token, key) for token in tokens])
    shape = [int(m[1]) for m in (re.search(rf"\b{side}[ \t]*:[ \t]*(\d{{1,9}})\b", block) for side in ("rows", "cols")) if m and data]
    if len(shape) != 2:
        return values[None, :]
    if shape[0] * shape[1] != values.size:
        raise CameraError(f"{key} says {shape[0]}x{shape[1]} but holds {values.size} numbers")
    return values.reshape(shape)


def _camera(sections: dict[str, str]) -> Camera:
    width, height = _size(sections, WIDTH), _size(sections, HEIGHT)
    matrix, distortion = _matrix(sections, MATRIX), _matrix(sections, DISTORTION).ravel()
    if matrix.size != 9:
        raise CameraError(f"camera_matrix must be 3x3, not {matrix.shape[0]}x{matrix.shape[1]}")
    matrix = matrix.reshape(3, 3)
    if not (np.isfinite(matrix).all() and np.isfinite(distortion).all()):
        raise CameraError("camera_matrix and distortion_coefficients must be finite numbers; calibrate again")
    focal = matrix[[0, 1], [0, 1]]
    _check_matrix(matrix, focal, max(width, height))
    if distortion.size == 14:  # OpenCV's tilted sensor: the tilt has no place here, and its zeros say nothing
        if distortion[12:].any():
            raise CameraError("its lens has a tilted sensor (14 coefficients), which is not modelled here; calibrate without it")
        distortion = distortion[: 12 if distortion[8:].any() else 8]
    camera = Camera(width, height, focal, matrix[:2, 2], distortion, _lens_model(sections))
    return camera if "parameter_covariance" not in sections else replace(camera, covariance=_covariance(sections, camera))


def _checked(camera: Camera) -> Camera:
    """The camera, if its focal length is one in pixels."""
    _check_matrix(camera.matrix, camera.focal_px, max(camera.width_px, camera.height_px))
    return camera


def _check_matrix(matrix: Array, focal: Array, side: int) -> None:
    if abs(matrix[0, 1]) > ROUNDING * abs(focal[0]):
        raise CameraError(f"its camera_matrix has skew ({matrix[0, 1]:g}), which is not modelled here; calibrate without it")
    if np.abs(np.append(matrix[1, 0], matrix[2] - (0, 0, 1))).max() > ROUNDING:
        raise CameraError("its camera_matrix is not of the form [fx 0 cx; 0 fy cy; 0 0 1]")
    low, high = FOCAL_OF_SIDE
    if not ((focal > low * side) & (focal < high * side)).all():
        raise CameraError(
            f"its focal length of {focal[0]:g}, {focal[1]:g} px does not fit {side} px pictures; it must be in pixels, not mm"
        )


def _lens_model(sections: dict[str, str]) -> str:
    found = {"opencv"}
    for key in ("model", "distortion_model"):
        if key in sections:
            name = sections[key].strip().strip("\"'")
            if name not in LENS_NAMES:
                raise CameraError(f"its {key} {name[:30]!r} is not modelled here; {', '.join(LENS_NAMES)} are")
            found.add(LENS_NAMES[name])
    if "fisheye_model" in sections and _value(sections["fisheye_model"].strip(), "fisheye_model") != 0:
        found.add("fisheye")
    return "fisheye" if "fisheye" in found else "opencv"


def _covariance(sections: dict[str, str], camera: Camera) -> Array:
    names = tuple(token for token in re.split(r"[\s,\[\]\"'-]+", sections.get("parameter_names", "")) if token)
    if names != camera.parameter_names:
        raise CameraError(
            f"parameter_names must be {', '.join(camera.parameter_names)} for its covariance, not {', '.join(names) or 'missing'}"
        )
    covariance = _matrix(sections, ("parameter_covariance",))
    size = len(names)
    if covariance.shape != (size, size) or not np.isfinite(covariance).all():
        raise CameraError(f"parameter_covariance must be {size}x{size} finite numbers")
    sigma = np.sqrt(np.abs(np.diag(covariance)))
    scaled = covariance / np.outer(np.maximum(sigma, 1e-300), np.maximum(sigma, 1e-300))
    if np.abs(scaled - scaled.T).max() > 1e-6 or np.linalg.eigvalsh((scaled + scaled.T) / 2).min() < -1e-6:
        raise CameraError("parameter_covariance is not symmetric and positive; calibrate again")
    return covariance
