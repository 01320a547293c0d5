"""The shape of a reflector from folders and files: the same from each, and clear words for what holds none."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from difference.states import CAMERA, DISH, RIM_MM, state

from dishmap.compare import joint_table
from dishmap.difference.difference_map import joint_difference
from dishmap.difference.saved import saved_difference
from dishmap.errors import InputError
from dishmap.io.camera_file import write_camera
from dishmap.io.difference_file import format_difference
from dishmap.io.difference_map_file import write_difference_map
from dishmap.io.measurement_file import write_measurement
from dishmap.io.pattern_file import read_pattern, write_pattern
from dishmap.io.shape_input import read_shape_field
from dishmap.rf.antenna import Reflector
from dishmap.rf.deformation import displacement
from dishmap.rf.shape_field import ShapeField, deformation_of, sigma_at
from dishmap.simulate.deform import Deformation, ZernikeTerm, displacement_mm
from dishmap.surface.membrane import disc_points

REFLECTOR = Reflector(600.0, 300.0)
# small, and points slide with the least strain, as a stretched print looks nearer in a single photograph
SADDLE = Deformation(zernike=(ZernikeTerm(2, 2, 0.2), ZernikeTerm(3, -1, 0.1)))
INSIDE = disc_points(250.0, 16)[0]
# 37 targets of one photograph.
SIGMAS = 4.0


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders `change` and `map` as the program leaves them, with what this module reads; camera and pattern beside."""
    folder = tmp_path_factory.mktemp("results")
    rng = np.random.default_rng(11)
    before, after = state(rng=rng), state(SADDLE, rng)
    joint = joint_difference(before, after, CAMERA, DISH)
    for name in ("change", "map"):
        (folder / name).mkdir()
    write_difference_map(folder / "change" / "difference.npz", saved_difference(joint, DISH))
    (folder / "change" / "difference.csv").write_text(format_difference(joint_table(joint)))
    write_camera(folder / "camera.yaml", CAMERA)
    write_pattern(folder / "pattern.json", DISH)
    # a pattern in a file is rounded
    write_measurement(folder / "map" / "measurement.npz", after, CAMERA, read_pattern(folder / "pattern.json"))
    inputs = {what: {"path": str(folder / name)} for what, name in (("camera", "camera.yaml"), ("pattern", "pattern.json"))}
    (folder / "map" / "summary.json").write_text(json.dumps({"inputs": inputs}))
    return folder


def values_mm(field: ShapeField) -> np.ndarray:
    return displacement(deformation_of(field), INSIDE)[0]


def without_rigid(values: np.ndarray) -> np.ndarray:
    """Less a rise and tilts: those of a change of shape are by its targets, not by these points."""
    flat = np.column_stack([np.ones(len(INSIDE)), INSIDE])
    return values - flat @ np.linalg.lstsq(flat, values, rcond=None)[0]


def test_a_folder_of_a_difference(results: Path) -> None:
    field = read_shape_field(results / "change", REFLECTOR)
    error = without_rigid(values_mm(field) - displacement_mm(SADDLE, INSIDE, RIM_MM))
    assert np.abs(error / sigma_at(field, INSIDE)).max() < SIGMAS
    assert np.median(sigma_at(field, INSIDE)) < 0.05
    # the folder is read by its file with covariance
    assert np.array_equal(read_shape_field(results / "change" / "difference.npz", REFLECTOR).factor_mm, field.factor_mm)
    whole = read_shape_field(results / "change", REFLECTOR, "displacement")
    assert not np.allclose(whole.mean_mm, field.mean_mm)


def test_a_table_alone(results: Path, tmp_path: Path) -> None:
    (tmp_path / "difference.csv").write_bytes((results / "change" / "difference.csv").read_bytes())
    table, whole = read_shape_field(tmp_path, REFLECTOR), read_shape_field(results / "change", REFLECTOR)
    assert np.abs((values_mm(table) - values_mm(whole)) / sigma_at(whole, INSIDE)).max() < 2.0


def test_a_folder_of_a_map(results: Path) -> None:
    field = read_shape_field(results / "map", REFLECTOR)
    error = without_rigid(values_mm(field) - displacement_mm(SADDLE, INSIDE, RIM_MM))
    assert np.abs(error / sigma_at(field, INSIDE)).max() < SIGMAS
    assert np.sqrt((error**2).mean()) < 0.03
    pattern = read_pattern(results / "pattern.json")
    given = read_shape_field(results / "map" / "measurement.npz", REFLECTOR, camera=CAMERA, pattern=pattern)
    assert np.array_equal(given.mean_mm, field.mean_mm)


def test_what_a_map_was_measured_with_must_be_there(results: Path, tmp_path: Path) -> None:
    (tmp_path / "measurement.npz").write_bytes((results / "map" / "measurement.npz").read_bytes())
    with pytest.raises(InputError, match=r"can only be read with the camera it was measured with; give the camera file"):
        read_shape_field(tmp_path, REFLECTOR)
    pattern = read_pattern(results / "pattern.json")
    assert len(read_shape_field(tmp_path, REFLECTOR, camera=CAMERA, pattern=pattern).places_mm) == len(DISH)
    for text in ("[]", "{", '{"inputs": {"camera": 3}}'):
        (tmp_path / "summary.json").write_text(text)
        with pytest.raises(InputError, match="give the camera file"):
            read_shape_field(tmp_path, REFLECTOR)
    (tmp_path / "summary.json").write_text(json.dumps({"inputs": {"camera": {"path": "gone.yaml"}}}))
    with pytest.raises(InputError, match=r"was measured with the camera gone\.yaml, which is no longer there; give the camera file"):
        read_shape_field(tmp_path, REFLECTOR)


def test_another_antenna_is_refused_from_every_file(results: Path) -> None:
    for path in ("change", "change/difference.csv", "map"):
        with pytest.raises(InputError, match=r"focal length 300 mm, and that of the antenna is 400 mm"):
            read_shape_field(results / path, Reflector(600.0, 400.0))


def test_what_holds_no_shape_is_told(results: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"the folder .* holds no difference.npz, difference.csv or measurement.npz .*map`$"):
        read_shape_field(tmp_path, REFLECTOR)
    with pytest.raises(InputError, match=r"holds no .*; give one of the folders in it \(change, map\)"):
        read_shape_field(results, REFLECTOR)
    with pytest.raises(InputError, match="there is no such file or folder; check the name"):
        read_shape_field(tmp_path / "gone", REFLECTOR)
    with pytest.raises(InputError, match=r"camera\.yaml is no shape; give a folder"):
        read_shape_field(results / "camera.yaml", REFLECTOR)
    (tmp_path / "noise.npz").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match=r"noise\.npz is no whole measurement"):
        read_shape_field(tmp_path / "noise.npz", REFLECTOR, camera=CAMERA, pattern=DISH)
