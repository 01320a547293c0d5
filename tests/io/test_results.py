"""Result files: what is written is read back, by us and by an independent reader, and wrong files are refused."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dishmap.camera.model import Camera
from dishmap.errors import InputError
from dishmap.io.points_file import COLUMNS, PointTable, format_ply, format_points, parse_points, read_points, table_of
from dishmap.io.pose_file import format_pose, parse_pose, read_pose, write_pose
from dishmap.io.results import SPACECRAFT_FILE, Provenance, result_files, shared_calibration, write_results
from dishmap.pipeline import Map, map_photograph
from dishmap.quality import Quality
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.surface.cloud import PointCloud, transform_cloud
from dishmap.surface.fit import Basis
from dishmap.targets.builders import plate
from dishmap.targets.identify import PoseGuess, Upright
from dishmap.transforms import Pose

# What a file keeps: positions and pixels to 1e-6, normals to 1e-9, sigmas to 6 digits, angles to 1e-9 degrees.
FILE_MM, FILE_NORMAL, FILE_SIGMA = 0.6e-6, 0.6e-9, 1e-5
CAMERA = Camera(640, 480, np.array([800.0, 800.0]), np.array([319.5, 239.5]), np.array([-0.1, 0.02, 0.0, 0.0, 0.0]))


def cloud(n: int = 4, seed: int = 1) -> PointCloud:
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(n, 3))
    root, root2 = rng.normal(size=(n, 3, 3)), rng.normal(size=(n, 2, 2))
    return PointCloud(
        ids=np.arange(n) * 3,
        position_mm=rng.normal(scale=300, size=(n, 3)),
        normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
        center_px=rng.uniform(0, 4000, (n, 2)),
        covariance_mm2=root @ np.swapaxes(root, 1, 2),
        sigma_normal_rad=rng.uniform(0, 0.1, n),
        covariance_px2=root2 @ np.swapaxes(root2, 1, 2),
        calibration_jacobian=rng.normal(size=(n, 3, 9)),
        quality=np.array([0, int(Quality.GLARE), int(Quality.GLARE | Quality.OFF_SURFACE), 0][:n]),
        frame="camera",
    )


@pytest.fixture(scope="module")
def photograph() -> tuple[np.ndarray, Map]:
    scene = Scene(plate(4, 5, 40.0), CAMERA, facing_pose(420.0, 0.2), sensor=Sensor(noise_grey=1.0))
    image = simulate(scene, np.random.default_rng(1)).image
    return image, map_photograph(image, CAMERA, scene.pattern, Upright())


def test_points_are_read_back() -> None:
    points = cloud()
    text = format_points(table_of(points))
    assert text.splitlines()[0] == (
        "id,x_mm,y_mm,z_mm,nx,ny,nz,u_px,v_px,sigma_x_mm,sigma_y_mm,sigma_z_mm,sigma_normal_deg,sigma_u_px,sigma_v_px,quality"
    )
    assert [line.rpartition(",")[2] for line in text.splitlines()[1:]] == ["", "glare", "glare|off_surface", ""]
    back = parse_points(text)
    assert back.ids.tolist() == points.ids.tolist()
    assert np.abs(back.position_mm - points.position_mm).max() < FILE_MM
    assert np.abs(back.normal - points.normal).max() < FILE_NORMAL
    assert np.abs(back.center_px - points.center_px).max() < FILE_MM
    assert back.sigma_mm == pytest.approx(np.sqrt(points.covariance_mm2[:, [0, 1, 2], [0, 1, 2]]), rel=FILE_SIGMA)
    assert back.sigma_px == pytest.approx(np.sqrt(points.covariance_px2[:, [0, 1], [0, 1]]), rel=FILE_SIGMA)
    assert back.sigma_normal_rad == pytest.approx(points.sigma_normal_rad, rel=FILE_SIGMA)
    assert back.quality.tolist() == points.quality.tolist()
    # in the file the angle is in degrees
    assert float(text.splitlines()[1].split(",")[12]) == pytest.approx(np.degrees(points.sigma_normal_rad[0]), rel=FILE_SIGMA)


@given(st.lists(st.floats(-1e5, 1e5), min_size=5, max_size=5), st.integers(0, 2**31 - 1), st.integers(0, 1023))
def test_any_point_survives(numbers: list[float], ident: int, bits: int) -> None:
    one = PointTable(
        ids=np.array([ident]),
        position_mm=np.array([numbers[:3]]),
        normal=np.array([[0.0, 0.6, -0.8]]),
        center_px=np.array([numbers[3:]]),
        sigma_mm=np.abs(np.array([numbers[:3]])),
        sigma_normal_rad=np.array([np.nan]),
        sigma_px=np.abs(np.array([numbers[3:]])),
        quality=np.array([bits]),
    )
    back = parse_points(format_points(one))
    assert np.abs(back.position_mm - one.position_mm).max() < FILE_MM
    assert back.sigma_mm == pytest.approx(one.sigma_mm, rel=FILE_SIGMA)
    assert np.isnan(back.sigma_normal_rad[0])
    assert (back.ids[0], back.quality[0]) == (ident, bits)


def test_unknown_sigmas_are_empty() -> None:
    text = format_points(table_of(cloud(), with_sigmas=False))
    assert all(",,,,,," in line for line in text.splitlines()[1:])
    assert np.isnan(parse_points(text).sigma_mm).all()
    assert len(parse_points(",".join(COLUMNS) + "\n")) == 0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("id,x_mm", "id,x_m", "its first line must be id,x_mm"),
        ("\n0,", "\n3,", "the id 3 stands in it twice"),
        ("\n0,", "\n-1,", "line 2: an id must be a whole number, not '-1'"),
        ("\n0,", "\n0,1.0,", "line 2: 16 columns are needed, not 17"),
        ("glare|off_surface", "glare|off", "line 4: unknown quality flag 'off'; known are clipped"),
        ("glare|off_surface", "glare|", "line 4: unknown quality flag ''"),
    ],
)
def test_other_tables_are_refused(old: str, new: str, message: str) -> None:
    text = format_points(table_of(cloud()))
    assert old in text
    with pytest.raises(InputError, match=re.escape(message)):
        parse_points(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        (1, "nan", "line 2: x_mm must be a finite number, not 'nan'"),
        (3, "inf", "z_mm must be a finite number"),
        (7, "", "u_px must be a number, not ''"),
        (4, "2.0", "line 2: nx, ny, nz are not a unit vector"),
        (9, "-0.1", "sigma_x_mm must not be negative, as -0.1 is"),
        (12, "NaN", "sigma_normal_deg must be a finite number"),
    ],
)
def test_impossible_values_are_named(column: int, value: str, message: str) -> None:
    lines = format_points(table_of(cloud())).splitlines()
    cells = lines[1].split(",")
    cells[column] = value
    with pytest.raises(InputError, match=message):
        parse_points("\n".join([lines[0], ",".join(cells), *lines[2:]]))


def test_tables_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot read the table of points .*gone\.csv: No such file"):
        read_points(tmp_path / "gone.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not text in UTF-8"):
        read_points(tmp_path / "binary.csv")


def read_ply(text: str) -> dict[str, np.ndarray]:
    """An ASCII PLY by its definition: types and names from the header, then the rows."""
    head, _, body = text.partition("end_header\n")
    lines = head.splitlines()
    assert lines[:2] == ["ply", "format ascii 1.0"]
    (count,) = (int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    types = {"double": np.float64, "float": np.float32, "int": np.int32}
    properties = [line.split()[1:] for line in lines if line.startswith("property")]
    rows = [line.split() for line in body.splitlines()]
    assert len(rows) == count
    assert all(len(row) == len(properties) for row in rows)
    return {name: np.array([row[k] for row in rows]).astype(types[kind]) for k, (kind, name) in enumerate(properties)}


def test_ply_holds_points_and_normals() -> None:
    points = cloud()
    ply = read_ply(format_ply(table_of(points)))
    assert list(ply)[:6] == ["x", "y", "z", "nx", "ny", "nz"]
    assert np.abs(np.column_stack([ply["x"], ply["y"], ply["z"]]) - points.position_mm).max() < FILE_MM
    assert np.abs(np.column_stack([ply["nx"], ply["ny"], ply["nz"]]) - points.normal).max() < FILE_NORMAL
    assert ply["id"].tolist() == points.ids.tolist()
    assert ply["quality"].tolist() == points.quality.tolist()
    assert ply["sigma_z_mm"] == pytest.approx(np.sqrt(points.covariance_mm2[:, 2, 2]), rel=FILE_SIGMA)
    assert read_ply(format_ply(table_of(points, with_sigmas=False)))["sigma_z_mm"].tolist() == [0.0] * 4


@given(st.lists(st.floats(-100, 100), min_size=3, max_size=3), st.lists(st.floats(-1e5, 1e5), min_size=3, max_size=3))
def test_poses_survive(turn_deg: list[float], move_mm: list[float]) -> None:
    pose = Pose.from_rotation_vector(np.radians(turn_deg), move_mm)
    back = parse_pose(format_pose(pose, "camera_from_dish"), "camera_from_dish")
    assert np.abs(back.rotation - pose.rotation).max() < 1e-10
    assert np.abs(back.translation_mm - pose.translation_mm).max() < 1e-8


def test_poses_are_in_degrees(tmp_path: Path) -> None:
    path = tmp_path / "pose.json"
    path.write_text('{"camera_from_dish": {"rotation_vector_deg": [0, 0, 90], "translation_mm": [0, 0, 1000]}}')
    assert read_pose(path, "camera_from_dish").apply([1, 0, 0]) == pytest.approx([0, 1, 1000])
    write_pose(path, read_pose(path, "camera_from_dish"), "spacecraft_from_camera")
    assert read_pose(path, "spacecraft_from_camera").translation_mm.tolist() == [0, 0, 1000]
    with pytest.raises(
        InputError, match=r"pose\.json: unknown key 'spacecraft_from_camera' in the file; the nearest valid one is 'camera_"
    ):
        read_pose(path, "camera_from_dish")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": {"rotation_vector_deg": [0, 0, NaN], "translation_mm": [0, 0, 1]}}', "NaN is not a number that can be used"),
        ('{"a": {"rotation_vector_deg": [0, 0, -Infinity], "translation_mm": [0, 0, 1]}}', "-Infinity is not a number"),
        ('{"a": {"rotation_vector_deg": [0, 0, 1e999], "translation_mm": [0, 0, 1]}}', "needs three numbers within 720 degrees"),
        ('{"a": {"rotation_vector_deg": [0, 0, true], "translation_mm": [0, 0, 1]}}', "three numbers within 720 degrees, not .*true"),
        ('{"a": {"rotation_vector_deg": [0, 0, "1"], "translation_mm": [0, 0, 1]}}', "three numbers"),
        ('{"a": {"rotation_vector_deg": [0, 0, 1, 2], "translation_mm": [0, 0, 1]}}', "three numbers"),
        ('{"a": {"rotation_vector_deg": [0, 0, 900], "translation_mm": [0, 0, 1]}}', "within 720 degrees"),
        ('{"a": {"rotation_vector_deg": [0, 0, 1], "translation_mm": [0, 0, 1e9]}}', "within 1e.08 mm"),
        (f'{{"a": {{"rotation_vector_deg": [0, 0, 1], "translation_mm": [0, 0, 1{"0" * 400}]}}}}', "within 1e.08 mm"),
        ('{"a": {"rotation_vector_deg": [0, 0, 1]}}', "a lacks the key 'translation_mm'; a pose file is "),
        ('{"a": {"rotation_vector": [0, 0, 1]}}', "unknown key 'rotation_vector' in a; the nearest valid one is 'rotation_vector_deg'"),
        ('{"a": 1}', "a must be an object"),
        ("{}", "the file lacks the key 'a'"),
        ("[]", "the file must be an object with 'a'"),
        ('{"a": 1, "a": 2}', "the key 'a' stands in it twice"),
        ("{", "not valid JSON"),
        ("[" * 100_000, "nested too deeply"),
    ],
)
def test_other_poses_are_refused(text: str, message: str) -> None:
    with pytest.raises(InputError, match=f"^my.json.*{message}"):
        parse_pose(text, "a", "my.json")


def test_pose_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot read the pose file .*gone\.json: No such file"):
        read_pose(tmp_path / "gone.json", "a")
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not text in UTF-8"):
        read_pose(tmp_path / "binary.json", "a")
    (tmp_path / "large.json").write_bytes(b" " * 100_001)
    with pytest.raises(InputError, match="larger than 100 kB"):
        read_pose(tmp_path / "large.json", "a")


def test_shared_calibration_is_that_of_the_camera() -> None:
    points = cloud()
    covariance = np.diag(np.arange(1.0, 10.0))
    camera = Camera(4000, 3000, CAMERA.focal_px, CAMERA.principal_px, CAMERA.distortion, covariance=covariance)
    shared = shared_calibration(points, camera)
    jacobian = points.calibration_jacobian
    assert jacobian is not None
    full = np.einsum("aip,pq,bjq->aibj", jacobian, covariance, jacobian)
    sigma = np.sqrt(np.einsum("aiai->ai", full))
    assert [[t["sigma_x_mm"], t["sigma_y_mm"], t["sigma_z_mm"]] for t in shared["targets"]] == [pytest.approx(row) for row in sigma]
    assert shared["sigma_rms_mm"] == pytest.approx(np.sqrt((sigma**2).mean(axis=0)))
    # the covariance of the mean of all points
    assert np.array(shared["common_covariance_mm2"]) == pytest.approx(full.mean(axis=(0, 2)))
    together = np.square(shared["common_sigma_mm"]) + np.square(shared["apart_rms_mm"])
    assert together == pytest.approx(np.square(shared["sigma_rms_mm"]))
    assert shared_calibration(points, CAMERA)["known"] is False


def test_files_of_a_map(photograph: tuple[np.ndarray, Map], tmp_path: Path) -> None:
    _, result = photograph
    source = tmp_path / "photo.png"
    source.write_bytes(b"abc")
    craft = Pose.from_rotation_vector([0.1, 0.2, 0.3], [1.0, 2.0, 3.0])
    guess = PoseGuess(Pose.from_rotation_vector([np.pi, 0, 0], [0.0, 0.0, 420.0]))
    files = result_files(result, Provenance(CAMERA, {"photograph": source}, guess, spacecraft_from_camera=craft, seconds={"map": 0.1}))
    assert set(files) == {"points.csv", "points.ply", "surface.json", "summary.json", "measurement.npz", SPACECRAFT_FILE}
    summary, surface = json.loads(files["summary.json"]), json.loads(files["surface.json"])
    # of the text `abc`, from FIPS 180-2
    assert summary["inputs"]["photograph"]["sha256"] == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert summary["hint"]["camera_from_dish"]["rotation_vector_deg"] == pytest.approx([180, 0, 0])
    assert summary["spacecraft_from_camera"]["translation_mm"] == [1, 2, 3]
    assert summary["camera"]["parameters"]["fx"] == 800
    assert summary["seconds"] == {"map": 0.1}
    assert summary["photograph"]["median_blur_px"] == pytest.approx(np.hypot(0.8, 12**-0.5), rel=0.05)
    assert result.surface is not None
    assert [c["value"] for c in surface["coefficients"]] == result.surface.coefficients.tolist()
    assert [c["sigma"] ** 2 for c in surface["coefficients"]] == pytest.approx(np.diag(surface["covariance"]))
    assert [r["id"] for r in surface["residuals"]] == result.cloud.ids.tolist()
    assert (surface["fitted"], surface["problem"], surface["frame"]) == (True, "", "dish")
    moved = transform_cloud(result.cloud, craft, "spacecraft")
    assert np.abs(parse_points(files[SPACECRAFT_FILE]).position_mm - moved.position_mm).max() < FILE_MM


def test_a_surface_that_cannot_be_fitted_is_told(photograph: tuple[np.ndarray, Map]) -> None:
    image, before = photograph
    result = map_photograph(image, CAMERA, before.pattern, Upright(), surface=Basis("zernike", 8))
    surface = json.loads(result_files(result, Provenance(CAMERA))["surface.json"])
    assert surface["fitted"] is False
    assert "20 targets are too few" in surface["problem"]


def test_inputs_that_have_gone_are_told(photograph: tuple[np.ndarray, Map], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.png can no longer be read"):
        result_files(photograph[1], Provenance(CAMERA, {"photograph": tmp_path / "gone.png"}))


def test_old_points_of_another_frame_do_not_stay(tmp_path: Path) -> None:
    write_results(tmp_path, {"points.csv": "new", SPACECRAFT_FILE: "new", "measurement.npz": b"new"})
    (tmp_path / "mine.txt").write_text("mine")
    write_results(tmp_path, {"points.csv": "newer"})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.txt", "points.csv"]
