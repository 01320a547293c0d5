"""Measurement files: exactly what was measured comes back, and nothing else is taken for it."""

from __future__ import annotations

import io
import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dishmap.camera.model import Camera
from dishmap.errors import InputError
from dishmap.io.archive import HEADER
from dishmap.io.measurement_file import (
    REAL,
    WHOLE,
    is_measurement,
    measurement_bytes,
    parse_measurement,
    pattern_fingerprint,
    read_measurement,
    write_measurement,
)
from dishmap.targets.builders import disc, plate
from dishmap.targets.grid_builders import grid
from dishmap.targets.pattern import Surface
from dishmap.targets.pose import TargetPoses
from dishmap.targets.scene_noise import NoiseModel
from dishmap.transforms import Pose, rotation_from_vector

CAMERA = Camera(640, 480, [800.0, 801.0], [320.0, 240.0], [-0.1, 0.02, 0.0, 0.0])
PATTERN = plate(3, 4, 40.0)
REASONS = st.text(max_size=30)


def weighing(rng: np.random.Generator, count: int, size: int) -> np.ndarray:
    """Random covariances of sizes that differ by orders of magnitude."""
    factor = rng.standard_normal((count, size, size)) * 10.0 ** rng.uniform(-4, 2, (count, size, 1))
    return factor @ np.swapaxes(factor, 1, 2)


def random_poses(seed: int, count: int, rejected: tuple[tuple[int, str], ...] = ()) -> TargetPoses:
    rng = np.random.default_rng(seed)
    index = np.sort(rng.choice(len(PATTERN), count, replace=False))
    rotation = rotation_from_vector(rng.standard_normal((count, 3)))
    sizes = {name: (count, *(len(CAMERA.parameters) if size == "P" else size for size in shape)) for name, shape in REAL.items()}
    columns = {name: rng.standard_normal(shape) for name, shape in sizes.items()}
    columns |= {"rotation": rotation, "normal": rotation[..., 2]}
    columns |= {"covariance": weighing(rng, count, 6), "information": weighing(rng, count, 7), "covariance_px2": weighing(rng, count, 2)}
    return TargetPoses(
        index=index,
        ids=PATTERN.ids[index],
        quality=rng.integers(0, 2048, count),
        **columns,
        camera_from_dish=Pose(rotation_from_vector(rng.standard_normal(3)), rng.standard_normal(3)),
        normal_sigma_rad=float(rng.random()),
        noise_model=NoiseModel(*rng.random(3)),
        log_gamma=float(rng.standard_normal()),
        rejected=rejected,
    )


def same(one: TargetPoses, two: TargetPoses) -> bool:
    """Bit by bit, in every field there is: a field that the file forgets is seen here."""
    for field in fields(TargetPoses):
        a, b = getattr(one, field.name), getattr(two, field.name)
        if isinstance(a, np.ndarray):
            if a.dtype != b.dtype or a.tobytes() != b.tobytes():
                return False
        elif isinstance(a, Pose):
            if a.rotation.tobytes() + a.translation_mm.tobytes() != b.rotation.tobytes() + b.translation_mm.tobytes():
                return False
        elif a != b:
            return False
    return True


@given(seed=st.integers(0, 2**32), count=st.integers(1, 12), rejected=st.lists(st.tuples(st.integers(0, 11), REASONS), max_size=3))
@settings(max_examples=25, deadline=None)
def test_what_is_written_is_read(seed: int, count: int, rejected: list[tuple[int, str]]) -> None:
    poses = random_poses(seed, count, tuple(rejected))
    data = measurement_bytes(poses, CAMERA, PATTERN, "abc")
    found = parse_measurement(data, CAMERA, PATTERN)
    assert same(found.poses, poses)
    assert found.photograph_sha256 == "abc"
    assert not same(found.poses, replace(poses, log_gamma=poses.log_gamma + 1e-15 + 1e-12))
    # the same measurement is the same file
    assert measurement_bytes(found.poses, CAMERA, PATTERN, "abc") == data


def test_files(tmp_path: Path) -> None:
    poses = random_poses(1, 5)
    write_measurement(tmp_path / "m.npz", poses, CAMERA, PATTERN)
    assert same(read_measurement(tmp_path / "m.npz", CAMERA, PATTERN).poses, poses)
    (tmp_path / "photo.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (tmp_path / "empty.npz").write_bytes(b"")
    known = {name: is_measurement(tmp_path / name) for name in ("m.npz", "photo.png", "empty.npz", "gone.npz")}
    assert known == {"m.npz": True, "photo.png": False, "empty.npz": True, "gone.npz": False}
    with pytest.raises(InputError, match=r"cannot read the measurement .*gone\.npz: No such file"):
        read_measurement(tmp_path / "gone.npz", CAMERA, PATTERN)


def test_another_camera_or_pattern_is_refused() -> None:
    data = measurement_bytes(random_poses(2, 5), CAMERA, PATTERN)
    for camera in (CAMERA.with_parameters(CAMERA.parameters + 1e-9), Camera(641, 480, [800.0, 801.0], [320.0, 240.0], CAMERA.distortion)):
        with pytest.raises(InputError, match="measured with another camera file"):
            parse_measurement(data, camera, PATTERN)
    for pattern in (plate(3, 4, 40.001), plate(3, 4, 40.0, disc(10.0), "disc")):
        with pytest.raises(InputError, match="measured with another pattern file"):
            parse_measurement(data, CAMERA, pattern)
    # what else is known of the camera does not matter
    known = Camera(640, 480, CAMERA.focal_px, CAMERA.principal_px, CAMERA.distortion, covariance=np.eye(8))
    assert len(parse_measurement(data, known, PATTERN).poses) == 5


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_damage_is_told_or_harmless(data: st.DataObject) -> None:
    whole = measurement_bytes(random_poses(3, 3), CAMERA, PATTERN)
    spoilt = bytearray(whole[: data.draw(st.integers(0, len(whole)))])
    for _ in range(data.draw(st.integers(0, 3)) if spoilt else 0):
        spoilt[data.draw(st.integers(0, len(spoilt) - 1))] = data.draw(st.integers(0, 255))
    problem = ""
    try:
        # only what an archive says of itself can change unseen, such as a file's date
        assert same(parse_measurement(bytes(spoilt), CAMERA, PATTERN, "m.npz").poses, random_poses(3, 3))
    except InputError as error:
        problem = str(error)
    assert not problem or problem.startswith("m.npz ")
    assert "\n" not in problem


def changed(**arrays: object) -> bytes:
    """A measurement of 5 targets with some arrays replaced, None for taken out; keys of the header begin with `header_`."""
    with np.load(io.BytesIO(measurement_bytes(random_poses(4, 5), CAMERA, PATTERN))) as loaded:
        held = {name: loaded[name] for name in loaded.files}
    header = json.loads(held[HEADER].tobytes())
    for name, value in arrays.items():
        if name.startswith("header_"):
            header[name.removeprefix("header_")] = value
        elif value is None:
            del held[name]
        else:
            held[name] = np.asarray(value)
    out = io.BytesIO()
    np.savez(out, **{**held, HEADER: np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)})
    return out.getvalue()


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"pull": None}, "'pull' is missing|pull is not a file"),
        ({"ids": np.arange(5)[::-1]}, "ids are not the pattern's"),
        ({"ids": np.zeros((0,), int)}, "has shape"),
        ({"index": np.full(5, 99)}, "ids are not the pattern's"),
        ({"normal": np.zeros((5, 2))}, "normal has shape"),
        ({"position_mm": np.full((5, 3), np.nan)}, "position_mm holds NaN"),
        ({"position_mm": np.zeros((5, 3), complex)}, "position_mm has shape"),
        ({"rotation": np.zeros((5, 3, 3))}, "a rotation is none"),
        ({"quality": np.full(5, 1 << 40)}, "quality flag is unknown"),
        ({"covariance": -np.tile(np.eye(6), (5, 1, 1))}, "covariance is no covariance"),
        ({"information": np.triu(np.ones((5, 7, 7)))}, "information is no covariance"),
        ({"header_noise": [1.0, 2.0]}, "damaged"),
        ({"header_noise": [1.0, 2.0, "x"]}, "damaged"),
        ({"header_log_gamma": float("inf")}, "a number is not finite"),
        ({"header_rejected": [["x", "y"]]}, "damaged"),
        ({"header_camera_from_dish": {"rotation": [[2]], "mm": [0, 0, 0]}}, "damaged"),
        ({"header_format": "dishmap-measurement/9"}, "has the format 'dishmap-measurement/9', and 'dishmap-measurement/1' is read"),
        ({"header_format": 3}, "has the format '3'"),
    ],
)
def test_what_is_wrong_is_named(arrays: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        parse_measurement(changed(**arrays), CAMERA, PATTERN, "m.npz")
    assert str(caught.value).startswith("m.npz ")
    assert parse_measurement(changed(), CAMERA, PATTERN).poses.ids.size == 5


def test_pickled_objects_and_bombs_are_not_opened() -> None:
    out = io.BytesIO()
    np.savez(out, **{HEADER: np.array([{"a": 1}], dtype=object)})
    with pytest.raises(InputError, match="no whole measurement"):
        parse_measurement(out.getvalue(), CAMERA, PATTERN)
    out = io.BytesIO()
    np.savez_compressed(out, **{HEADER: np.zeros(50_000_000, np.uint8)})
    with pytest.raises(InputError, match="no whole measurement"):
        parse_measurement(out.getvalue(), CAMERA, PATTERN)


def test_every_field_with_rows_has_a_column() -> None:
    alone = {"camera_from_dish", "normal_sigma_rad", "noise_model", "log_gamma", "rejected", "sheet"}
    assert {field.name for field in fields(TargetPoses)} == {*WHOLE, *REAL, *alone}


def test_fingerprints_hold_all_of_a_grid() -> None:
    pattern = grid(8, 6, 12.0, line_width_mm=1.0, orientation_marks=True)
    assert pattern.lattice is not None
    others = [
        replace(pattern, lattice=pattern.lattice + 1),
        replace(pattern, lines=[replace(line, width_mm=1.1) for line in pattern.lines]),
        replace(pattern, lines=[replace(line, overhang_mm=5.0) for line in pattern.lines]),
        replace(pattern, lines=pattern.lines[::-1]),
        replace(pattern, kinds={**pattern.kinds, "crossing-marked": pattern.kinds["crossing"]}),
        grid(8, 6, 12.0, line_width_mm=1.0, orientation_marks=True, surface=Surface("cylinder", radius_mm=400.0), name=pattern.name),
    ]
    assert len({pattern_fingerprint(one) for one in [pattern, *others]}) == 7
    assert pattern_fingerprint(grid(8, 6, 12.0, line_width_mm=1.0, orientation_marks=True)) == pattern_fingerprint(pattern)
