"""Camera files of other programs: written and read back, read by the program itself where it is installed, refused in a sentence."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from dishmap.camera.model import Camera
from dishmap.errors import CameraError, InputError
from dishmap.io.camera_file import read_camera, read_views
from dishmap.io.camera_formats import FORMATS, camera_in_format

TERMS = [-0.21, 0.08, 0.0011, -0.0007, -0.013, 0.02, -0.01, 0.003, 0.0004, -0.0003, 0.0002, 0.0001]
CAMERAS = {
    **{str(n): Camera(1280, 960, np.array([1100.25, 1101.5]), np.array([639.1, 480.7]), np.array(TERMS[:n])) for n in (0, 4, 5, 8, 12)},
    "fisheye": Camera(1280, 960, np.array([550.0, 551.0]), np.array([639.1, 480.7]), np.array([0.02, -0.01, 0.003, -0.001]), "fisheye"),
}
HOLDS = {"ros": ("0", "4", "5", "8", "fisheye"), "mrcal": ("0", "4", "5", "8", "12"), "kalibr": ("0", "4", "fisheye")}
PYTHON_OF_MRCAL = "/usr/bin/python3"
POINTS = np.random.default_rng(0).uniform([-0.5, -0.4, 0.9], [0.5, 0.4, 1.4], (200, 3))


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("name", CAMERAS)
def test_round_trip(tmp_path: Path, form: str, name: str) -> None:
    camera, path = CAMERAS[name], tmp_path / "camera.txt"
    if name not in HOLDS[form]:
        with pytest.raises(InputError, match="calibrate with --lens"):
            camera_in_format(camera, form)
        return
    path.write_text(camera_in_format(camera, form, "left: # camera"))
    again = read_camera(path)
    assert (again.width_px, again.height_px, again.model) == (camera.width_px, camera.height_px, camera.model)
    # numbers are written with all their digits; a lens may gain coefficients of zero
    assert again.parameters[: len(camera.parameters)].tolist() == camera.parameters.tolist()
    assert not again.parameters[len(camera.parameters) :].any()
    assert np.array_equal(again.project(POINTS), camera.project(POINTS))
    assert read_views(path) == ()


@pytest.mark.parametrize("name", HOLDS["mrcal"])
def test_mrcal_projects_the_same(tmp_path: Path, name: str) -> None:
    script = (
        "import sys, json, numpy, mrcal\n"
        "model = mrcal.cameramodel(sys.argv[1])\n"
        "points = numpy.array(json.load(sys.stdin))\n"
        "print(json.dumps(mrcal.project(points, *model.intrinsics()).tolist()))\n"
    )
    path = tmp_path / "camera.cameramodel"
    path.write_text(camera_in_format(CAMERAS[name], "mrcal"))
    try:
        probe = subprocess.run([PYTHON_OF_MRCAL, "-c", "import mrcal"], capture_output=True, check=False)
    except OSError:
        pytest.skip(f"there is no {PYTHON_OF_MRCAL}")
    if probe.returncode:
        pytest.skip("mrcal is not installed (Debian: python3-mrcal)")
    done = subprocess.run(
        [PYTHON_OF_MRCAL, "-c", script, str(path)], input=json.dumps(POINTS.tolist()), capture_output=True, text=True, check=True
    )
    theirs = np.array(json.loads(done.stdout))
    assert np.abs(theirs - CAMERAS[name].project(POINTS)).max() < 1e-6
    # and what mrcal writes is read
    model = "import sys, mrcal; mrcal.cameramodel(sys.argv[1]).write(sys.argv[2])"
    subprocess.run([PYTHON_OF_MRCAL, "-c", model, str(path), str(tmp_path / "b.cameramodel")], capture_output=True, check=True)
    assert np.abs(read_camera(tmp_path / "b.cameramodel").project(POINTS) - theirs).max() < 1e-6


def test_ros_is_read_by_opencv(tmp_path: Path) -> None:
    camera = CAMERAS["8"]
    (tmp_path / "a.yaml").write_text("%YAML:1.0\n---\n" + camera_in_format(camera, "ros", "left"))
    storage = cv2.FileStorage(str(tmp_path / "a.yaml"), cv2.FILE_STORAGE_READ)
    data = storage.getNode("camera_matrix").getNode("data")
    assert [data.at(i).real() for i in range(9)] == camera.matrix.ravel().tolist()
    assert storage.getNode("distortion_model").string() == "rational_polynomial"


KALIBR = """cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 0.00002]
  distortion_model: radtan
  intrinsics: [458.6, 457.3, 367.2, 248.4]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
"""
MRCAL = "# made by hand\n{ 'lensmodel': 'LENSMODEL_OPENCV4', 'intrinsics': [500,500,320,240,0,0,0,0], 'imagersize': [640,480] }\n"


def test_files_as_others_write_them(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(KALIBR)
    camera = read_camera(path)
    assert camera.parameters.tolist() == [458.6, 457.3, 367.2, 248.4, -0.28, 0.07, 0.0002, 0.00002]
    path.write_text(KALIBR.replace("[458.6, 457.3, 367.2, 248.4]", "\n  - 458.6\n  - 457.3\n  - 367.2\n  - 248.4"))
    assert read_camera(path).parameters.tolist() == camera.parameters.tolist()
    path.write_text(MRCAL)
    assert read_camera(path).focal_px.tolist() == [500, 500]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (KALIBR.replace("pinhole", "omni"), "its models omni-radtan are not modelled here"),
        (KALIBR + KALIBR.replace("cam0:", "cam1:"), r"it holds 2 cameras \(cam0, cam1\); keep one"),
        (KALIBR.replace("intrinsics: [458.6, ", "intrinsics: ["), "needs 4 intrinsics"),
        (KALIBR.replace("458.6", "x"), "its intrinsics must be a list of numbers"),
        (KALIBR.replace("458.6", "4.586"), "it must be in pixels, not mm"),
        (KALIBR.replace("  resolution: [752, 480]\n", ""), "has no resolution"),
        (KALIBR.replace("752", "752.5"), "whole numbers of pixels"),
        (MRCAL.replace("OPENCV4", "SPLINED_STEREOGRAPHIC_order=3"), "use mrcal-convert-lensmodel"),
        (MRCAL.replace("[500,", "["), "LENSMODEL_OPENCV4 needs 8 intrinsics and an imagersize of 2, not 7"),
        (MRCAL.replace("}", ""), "cannot be parsed"),
        (MRCAL.replace("[640,480]", "open('x')"), "cannot be parsed"),
        ("{ 'lensmodel', 1 }", "holds no keys"),
        ("{ 'lensmodel': 1, " + "[" * 5000, "cannot be parsed"),
    ],
)
def test_what_is_no_camera_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(CameraError, match=message) as caught:
        read_camera(path)
    assert "\n" not in str(caught.value)


def test_unknown_format() -> None:
    with pytest.raises(InputError, match="unknown camera format 'xml'; use one of ros, mrcal, kalibr"):
        camera_in_format(CAMERAS["5"], "xml")
