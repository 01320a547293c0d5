"""Camera files: what OpenCV writes is read, what we write OpenCV reads, to the last bit; what is spoilt gets one sentence."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from dishmap.camera.board import SHAPE_TERMS, BoardShape, BoardView
from dishmap.camera.calibrate import Calibration
from dishmap.camera.model import Camera
from dishmap.errors import CameraError, InputError
from dishmap.io.camera_file import camera_text, read_camera, read_views, write_camera
from dishmap.transforms import Pose

READ_LIMIT_S = 1.0
finite = st.floats(-1e3, 1e3, allow_subnormal=True)


def saved(folder: Path, text: str, name: str = "camera.yaml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def with_covariance(camera: Camera, seed: int = 0) -> Camera:
    root = (
        np.random.default_rng(seed).normal(size=(len(camera.parameters), 30)) * np.maximum(np.abs(camera.parameters), 1e-3)[:, None] * 1e-4
    )
    covariance = root @ root.T
    return Camera(
        camera.width_px,
        camera.height_px,
        camera.focal_px,
        camera.principal_px,
        camera.distortion,
        camera.model,
        (covariance + covariance.T) / 2,
    )


LENS5 = Camera(2304, 1728, np.array([1674.3, 1676.2]), np.array([1158.83, 858.37]), np.array([-0.215, 0.072, 0.0006, -0.0004, -0.009]))
FISHEYE = Camera(1000, 800, np.array([310.1, 311.7]), np.array([500.3, 401.1]), np.array([0.05, -0.01, 0.003, -0.0005]), "fisheye")


def assert_same(a: Camera, b: Camera) -> None:
    assert (a.width_px, a.height_px, a.model, a.parameter_names) == (b.width_px, b.height_px, b.model, b.parameter_names)
    assert a.parameters.tolist() == b.parameters.tolist()
    if a.covariance is None or b.covariance is None:
        assert a.covariance is b.covariance
    else:
        assert a.covariance.tolist() == b.covariance.tolist()


@given(
    st.integers(1, 100_000),
    st.integers(1, 100_000),
    st.floats(0.06, 900.0),
    st.floats(0.06, 900.0),
    npst.arrays(float, 2, elements=finite),
    st.sampled_from([0, 4, 5, 8, 12]).flatmap(lambda n: npst.arrays(float, n, elements=finite)),
    st.booleans(),
)
def test_round_trip_is_exact(
    tmp_path_factory: pytest.TempPathFactory,
    width: int,
    height: int,
    fx: float,
    fy: float,
    principal: np.ndarray,
    distortion: np.ndarray,
    covariance: bool,
) -> None:
    side = max(width, height)
    camera = Camera(width, height, np.array([fx, fy]) * side, principal, distortion)
    camera = with_covariance(camera) if covariance else camera
    path = tmp_path_factory.getbasetemp() / "round.yaml"
    write_camera(path, camera)
    assert_same(read_camera(path), camera)


def test_fisheye_round_trip(tmp_path: Path) -> None:
    camera = with_covariance(FISHEYE)
    write_camera(tmp_path / "a.yaml", camera)
    assert_same(read_camera(tmp_path / "a.yaml"), camera)


@pytest.mark.parametrize("camera", [with_covariance(LENS5), FISHEYE], ids=["opencv", "fisheye"])
def test_opencv_reads_what_we_write(tmp_path: Path, camera: Camera) -> None:
    write_camera(tmp_path / "a.yaml", camera)
    storage = cv2.FileStorage(str(tmp_path / "a.yaml"), cv2.FILE_STORAGE_READ)
    assert (int(storage.getNode("image_width").real()), int(storage.getNode("image_height").real())) == (camera.width_px, camera.height_px)
    assert (storage.getNode("camera_matrix").mat() == camera.matrix).all()
    assert (storage.getNode("distortion_coefficients").mat().ravel() == camera.distortion).all()
    assert storage.getNode("model").string() == camera.model
    if camera.covariance is not None:
        assert (storage.getNode("parameter_covariance").mat() == camera.covariance).all()
        names = storage.getNode("parameter_names")
        assert tuple(names.at(k).string() for k in range(names.size())) == camera.parameter_names


@pytest.mark.parametrize("shape", ["row", "column", "flat"])
@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_we_read_what_opencv_writes(tmp_path: Path, count: int, shape: str) -> None:
    k = np.zeros(count)
    k[: min(count, 12)] = np.random.default_rng(count).normal(size=min(count, 12)) / 7
    stored = {"row": k[None, :], "column": k[:, None], "flat": k}[shape]
    path = str(tmp_path / "theirs.yml")
    storage = cv2.FileStorage(path, cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Fri Nov 22 03:00:00 2024")
    storage.write("nframes", 20)
    storage.write("image_width", 2304)
    storage.write("image_height", 1728)
    storage.write("board_width", 9)
    storage.write("flags", 0)
    storage.write("camera_matrix", LENS5.matrix / 3 * 3)
    storage.write("distortion_coefficients", stored)
    storage.write("avg_reprojection_error", 0.31)
    storage.startWriteStruct("views", cv2.FileNode_SEQ)
    storage.write("", "a.jpg")
    storage.write("", "b: c.jpg")
    storage.endWriteStruct()
    storage.write("per_view_reprojection_errors", np.linspace(0.1, 0.4, 20)[:, None])
    storage.release()
    camera = read_camera(path)
    assert (camera.matrix == LENS5.matrix / 3 * 3).all()
    assert camera.distortion.tolist() == k[:12].tolist()
    assert camera.covariance is None


def test_a_14_coefficient_file_of_a_rational_lens_is_an_8_coefficient_one(tmp_path: Path) -> None:
    k = np.array([[0.1, 0.2, 0.001, 0.002, 0.3, 0.4, 0.5, 0.6, 0, 0, 0, 0, 0, 0]])
    storage = cv2.FileStorage(str(tmp_path / "a.yml"), cv2.FILE_STORAGE_WRITE)
    for key, value in (("image_width", 2304), ("image_height", 1728), ("camera_matrix", LENS5.matrix), ("distortion_coefficients", k)):
        storage.write(key, value)
    storage.release()
    assert read_camera(tmp_path / "a.yml").distortion.tolist() == k[0, :8].tolist()


OLD_SAMPLE = """%YAML:1.0
# written by an old sample of OpenCV's
calibration_Time: "Sat 01 Jan 2011"
image_Width: 2304
image_Height: 1728
Camera_Matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1.6743e+03, 0., 1.15883e+03, 0.,
       1676.2, 858.37, 0., 0., 1. ]
Distortion_Coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.215, 0.072, 6.0e-04, -4.0e-04,
       -9.0e-03 ]
"""
SHORT_KEYS = """width: 2304   # don't care: "px"
height: 1728
camera_matrix: [[1674.3, 0.0, 1158.83], [0.0, 1676.2, 858.37], [0.0, 0.0, 1.0]]
distortion_coefficients: [-0.215, 0.072, 0.0006, -0.0004, -0.009]
"""
ROS = """image_width: 2304
image_height: 1728
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [1674.3, 0, 1158.83, 0, 1676.2, 858.37, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.215, 0.072, 0.0006, -0.0004, -0.009]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [1674.3, 0, 1158.83, 0, 0, 1676.2, 858.37, 0, 0, 0, 1, 0]
"""
BLOCKS = """image_width: 2304
image_height: 1728
camera_matrix:
- - 1674.3
  - 0.0
  - 1158.83
- - 0.0
  - 1676.2
  - 858.37
- - 0.0
  - 0.0
  - 1.0
distortion_coefficients:
- -0.215
- 0.072
- 0.0006
- -0.0004
- -0.009
"""


@pytest.mark.parametrize("text", [OLD_SAMPLE, SHORT_KEYS, ROS, BLOCKS, "\ufeff" + ROS, ROS.replace("\n", "\r\n")])
def test_other_programs_files(tmp_path: Path, text: str) -> None:
    assert_same(read_camera(saved(tmp_path, text)), LENS5)


@pytest.mark.parametrize("hint", ["model: fisheye", "distortion_model: equidistant", 'distortion_model: "fisheye"', "fisheye_model: 1"])
def test_hints_of_a_fisheye_lens(tmp_path: Path, hint: str) -> None:
    text = camera_text(FISHEYE).replace("model: fisheye", hint)
    assert_same(read_camera(saved(tmp_path, text)), FISHEYE)
    assert read_camera(saved(tmp_path, text.replace(hint, "fisheye_model: 0"))).model == "opencv"


GOOD = camera_text(with_covariance(LENS5))


def without(key: str) -> str:
    lines, skip = [], False
    for line in GOOD.splitlines():
        skip = line.startswith(f"{key}:") or (skip and line.startswith(" "))
        lines += [] if skip else [line]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "it has no image_width; image_width, image_height, camera_matrix and distortion_coefficients are needed"),
        (without("image_width"), "it has no image_width"),
        (without("image_height"), "it has no image_height"),
        (without("camera_matrix"), "it has no camera_matrix"),
        (without("distortion_coefficients"), "it has no distortion_coefficients"),
        (GOOD.replace("image_width: 2304", "image_width: 2304.5"), "must be a whole number of pixels up to 1000000, not 2304.5"),
        (GOOD.replace("image_width: 2304", "image_width: -3"), "image_width must be a whole number"),
        (GOOD.replace("image_width: 2304", "image_width: 1e300"), "image_width must be a whole number"),
        (GOOD.replace("image_width: 2304", "image_width: .Nan"), "image_width must be a whole number"),
        (GOOD.replace("image_width: 2304", "image_width: wide"), "'wide' in image_width is not a number"),
        (GOOD.replace("1674.3", ".Nan"), "camera_matrix and distortion_coefficients must be finite"),
        (GOOD.replace("-0.215", ".Inf"), "camera_matrix and distortion_coefficients must be finite"),
        (GOOD.replace("-0.215", "1e999"), "camera_matrix and distortion_coefficients must be finite"),
        (GOOD.replace("[ 1674.3, 0.0", "[ 1674.3, 0.5"), r"skew \(0.5\), which is not modelled here"),
        (GOOD.replace("0.0, 0.0, 1.0 ]", "0.0, 0.0, 2.0 ]"), "not of the form"),
        (GOOD.replace("1674.3", "4.2"), "focal length of 4.2, 1676.2 px does not fit 2304 px pictures; it must be in pixels, not mm"),
        (GOOD.replace("1674.3", "-1674.3"), "focal length of -1674.3"),
        (GOOD.replace("1674.3", "zwölf"), "'zwölf' in camera_matrix is not a number"),
        (GOOD.replace("   rows: 3", "   rows: 4", 1), "camera_matrix says 4x3 but holds 9 numbers"),
        (GOOD.replace(", -0.009 ]", " ]").replace("cols: 5", "cols: 4").replace("k3", "k4"), "parameter_names must be fx, fy"),
        (GOOD.replace(", -0.009 ]", ", -0.009, 1 ]").replace("cols: 5", "cols: 6"), "takes 0 or 4 or 5 or 8 or 12 coefficients"),
        (GOOD.replace("model: opencv", "model: omnidirectional"), "its model 'omnidirectional' is not modelled here; opencv, plumb_bob"),
        (GOOD.replace("model: opencv", "model: fisheye"), "fisheye lens model takes 4 coefficients, not 5"),
        (GOOD.replace("k3 ]", "k9 ]"), "parameter_names must be fx, fy, cx, cy, k1, k2, p1, p2, k3 for its covariance"),
        (without("parameter_names"), "not missing"),
        (GOOD.replace("image_height: 1728", "image_width: 1728"), "image_width stands in it twice"),
        (GOOD + "\x00", "is not `key: value`"),
        ("{ \"image_width\": 3 }", "it is JSON; OpenCV's YAML is needed"),
        ("<?xml version='1.0'?>", "it is XML; OpenCV's YAML is needed"),
        ("just some words\n", "line 1 is not `key: value`"),
        ("[" * 100_000, "line 1 is not `key: value`"),
        ("image_width: " + "[" * 100_000, "image_width"),
    ],
)  # fmt: skip
def test_spoilt_files(tmp_path: Path, text: str, message: str) -> None:
    assert text != GOOD
    path = saved(tmp_path, text)
    with pytest.raises(CameraError, match=message) as error:
        read_camera(path)
    assert str(error.value).startswith(f"cannot use {path} as a camera file: ")
    assert "\n" not in str(error.value)


def spoilt_covariance(change: str) -> str:
    camera = with_covariance(LENS5)
    assert camera.covariance is not None
    covariance = camera.covariance.copy()
    if change == "nan":
        covariance[0, 0] = np.nan
    elif change == "asymmetric":
        covariance[0, 1] *= 1.01
    else:
        covariance[0, 0] *= -1
    text = camera_text(camera)
    # Camera refuses NaN itself, so the numbers are put into the text
    for a, b in zip(camera.covariance.ravel(), covariance.ravel(), strict=True):
        text = text if a == b else text.replace(repr(float(a)), ".Nan" if np.isnan(b) else repr(float(b)), 1)
    return text


@pytest.mark.parametrize(
    ("change", "message"),
    [("nan", "9x9 finite numbers"), ("asymmetric", "not symmetric and positive"), ("negative", "not symmetric and positive")],
)
def test_spoilt_covariance(tmp_path: Path, change: str, message: str) -> None:
    with pytest.raises(CameraError, match=message):
        read_camera(saved(tmp_path, spoilt_covariance(change)))


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="there is no such file"):
        read_camera(tmp_path / "none.yaml")
    with pytest.raises(CameraError, match="it is not a file"):
        read_camera(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x80\x00" * 10)
    with pytest.raises(CameraError, match="it is not text"):
        read_camera(tmp_path / "binary.yaml")
    with pytest.raises(CameraError, match=r"it cannot be read|no such file"):
        read_camera("nul\0.yaml")
    with (tmp_path / "huge.yaml").open("wb") as stream:
        stream.truncate(200_000_000)
    with pytest.raises(CameraError, match="it has 200 MB; a camera file has some kilobytes"):
        read_camera(tmp_path / "huge.yaml")


def test_an_unwritable_place_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot write"):
        write_camera(tmp_path / "none" / "camera.yaml", LENS5)


@settings(max_examples=300)
@given(st.data())
def test_any_change_of_bytes_gives_a_camera_or_one_error(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    spoilt = bytearray(GOOD.encode())
    for _ in range(data.draw(st.integers(1, 8))):
        at = data.draw(st.integers(0, len(spoilt) - 1))
        spoilt[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    path = tmp_path_factory.getbasetemp() / "spoilt.yaml"
    path.write_bytes(bytes(spoilt))
    try:
        assert np.isfinite(read_camera(path).parameters).all()
    except CameraError:
        return


def calibration(count: int) -> Calibration:
    rng = np.random.default_rng(4)
    views = tuple(
        BoardView(name, rng.uniform(0, 1000, (20, 2)), rng.uniform(0, 100, (20, 3))) for name in ("a b.jpg", 'ü "x".jpg', "c/d.jpg")[:count]
    )
    return Calibration(
        camera=with_covariance(LENS5),
        views=views,
        poses=tuple(Pose.identity() for _ in views),
        used=tuple(np.ones(20, dtype=bool) for _ in views),
        residuals_px=tuple(np.zeros((20, 2)) for _ in views),
        view_rms_px=rng.uniform(0.1, 1, count),
        rms_px=0.3,
        sigma_px=0.2,
        inflation=1.7,
        coverage=0.5,
        rejected={"e.jpg": "no chessboard: found, or so"},
        notes=(),
        lens="opencv5",
        view_weight=np.ones(count),
        board=BoardShape(np.zeros(2), 50.0, np.zeros(len(SHAPE_TERMS)), np.eye(len(SHAPE_TERMS)), np.zeros((1, 3)), np.ones((1, 2)), 0.1),
        expected=LENS5.parameters,
        independent=1.0,
        readout="rows",
        motion=np.ones((count, 6)),
        motion_sigma_mm=0.2,
    )


def test_views_round_trip(tmp_path: Path) -> None:
    made = calibration(3)
    write_camera(tmp_path / "a.yaml", made.camera, made)
    assert_same(read_camera(tmp_path / "a.yaml"), made.camera)
    views = read_views(tmp_path / "a.yaml")
    assert tuple(view.name for view in views) == made.view_names
    for ours, theirs in zip(views, made.views, strict=True):
        assert ours.pixels.tolist() == theirs.pixels.tolist()
        assert ours.board_mm.tolist() == theirs.board_mm.tolist()
    storage = cv2.FileStorage(str(tmp_path / "a.yaml"), cv2.FILE_STORAGE_READ)
    assert storage.getNode("corners").mat().shape == (60, 5)
    assert storage.getNode("view_names").at(1).string() == 'ü "x".jpg'
    assert storage.getNode("calibration_rms_px").real() == 0.3


def test_a_file_without_views_has_none(tmp_path: Path) -> None:
    assert read_views(saved(tmp_path, GOOD)) == ()


def test_views_that_do_not_belong_together(tmp_path: Path) -> None:
    made = calibration(2)
    text = camera_text(made.camera, made).replace('view_names: [ "a b.jpg", ', "view_names: [ ")
    with pytest.raises(CameraError, match="corners, corner_view and view_names do not belong together"):
        read_views(saved(tmp_path, text))


@pytest.mark.parametrize("name", ["plate", "dish"])
def test_shared_cameras(shared_data: Path, name: str) -> None:
    camera = read_camera(shared_data / name / "camera.yaml")
    storage = cv2.FileStorage(str(shared_data / name / "camera.yaml"), cv2.FILE_STORAGE_READ)
    assert (camera.matrix == storage.getNode("camera_matrix").mat()).all()
    assert (camera.distortion == storage.getNode("distortion_coefficients").mat().ravel()).all()


def test_a_hostile_file_takes_no_time(tmp_path: Path) -> None:
    path = saved(tmp_path, GOOD + "".join(f"key{k}: [ {'1, ' * 50}1 ]\n" for k in range(20_000)))
    start = time.process_time()
    read_camera(path)
    assert time.process_time() - start < READ_LIMIT_S
