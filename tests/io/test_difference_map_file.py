"""Difference files with covariance: exactly what was kept comes back, and nothing else is taken for it."""

from __future__ import annotations

import io
import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from differences import DISH, joint_of
from hypothesis import given, settings
from hypothesis import strategies as st

from dishmap.difference.difference_map import Significance
from dishmap.difference.saved import SavedDifference, saved_difference
from dishmap.errors import InputError
from dishmap.io.archive import HEADER
from dishmap.io.difference_map_file import (
    REAL,
    WHOLE,
    difference_bytes,
    parse_difference_map,
    read_difference_map,
    write_difference_map,
)
from dishmap.targets.pattern import Surface
from dishmap.transforms import Pose, rotation_from_vector

SURFACES = (Surface(), Surface("paraboloid", 300.0, 150.0), Surface("paraboloid", None, 123.4), Surface("cylinder", radius_mm=-80.0))


def random_difference(seed: int, count: int) -> SavedDifference:
    rng = np.random.default_rng(seed)
    normal = rng.standard_normal((count, 3))
    return SavedDifference(
        ids=rng.permutation(1000)[:count],
        nominal_mm=rng.standard_normal((count, 3)),
        normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
        displacement_mm=rng.standard_normal(count),
        shape_mm=rng.standard_normal(count),
        displacement_factor=rng.standard_normal((count, int(rng.integers(0, 9)))),
        displacement_own_mm2=rng.random(count),
        shape_factor=rng.standard_normal((count, int(rng.integers(0, 9)))),
        shape_own_mm2=rng.random(count),
        quality=rng.integers(0, 2048, count),
        surface=SURFACES[int(rng.integers(len(SURFACES)))],
        rigid_motion=Pose(rotation_from_vector(rng.standard_normal(3)), rng.standard_normal(3)),
        rigid_covariance=np.diag(rng.random(6)),
        significance=Significance(float(rng.random()), int(rng.integers(20)), float(rng.random())),
        converged=bool(rng.integers(2)),
    )


def same(one: SavedDifference, two: SavedDifference) -> bool:
    """Bit by bit, in every field there is: a field that the file forgets is seen here."""
    for field in fields(SavedDifference):
        a, b = getattr(one, field.name), getattr(two, field.name)
        if isinstance(a, np.ndarray):
            if a.shape != b.shape or a.dtype != b.dtype or a.tobytes() != b.tobytes():
                return False
        elif isinstance(a, Pose):
            if a.rotation.tobytes() + a.translation_mm.tobytes() != b.rotation.tobytes() + b.translation_mm.tobytes():
                return False
        elif a != b:
            return False
    return True


@given(seed=st.integers(0, 2**32), count=st.integers(1, 12))
@settings(max_examples=25, deadline=None)
def test_what_is_written_is_read(seed: int, count: int) -> None:
    saved = random_difference(seed, count)
    data = difference_bytes(saved)
    found = parse_difference_map(data)
    assert same(found, saved)
    assert not same(found, replace(saved, shape_mm=saved.shape_mm + 1e-12))
    assert not same(found, replace(saved, converged=not saved.converged))
    # the same difference is the same file
    assert difference_bytes(found) == data


def test_files(tmp_path: Path) -> None:
    saved = saved_difference(joint_of(DISH), DISH)
    write_difference_map(tmp_path / "difference.npz", saved)
    assert same(read_difference_map(tmp_path / "difference.npz"), saved)
    with pytest.raises(InputError, match=r"cannot read the difference .*gone\.npz: No such file"):
        read_difference_map(tmp_path / "gone.npz")
    with pytest.raises(InputError, match="cannot read the difference"):
        read_difference_map(tmp_path)


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_damage_is_told_or_harmless(data: st.DataObject) -> None:
    whole = difference_bytes(random_difference(3, 3))
    spoilt = bytearray(whole[: data.draw(st.integers(0, len(whole)))])
    for _ in range(data.draw(st.integers(0, 3)) if spoilt else 0):
        spoilt[data.draw(st.integers(0, len(spoilt) - 1))] = data.draw(st.integers(0, 255))
    problem = ""
    try:
        # only what an archive says of itself can change unseen, such as a file's date
        assert same(parse_difference_map(bytes(spoilt), "d.npz"), random_difference(3, 3))
    except InputError as error:
        problem = str(error)
    assert not problem or problem.startswith("d.npz ")
    assert "\n" not in problem


def changed(**arrays: object) -> bytes:
    """A difference of 5 targets with some arrays replaced, None for taken out; keys of the header begin with `header_`."""
    with np.load(io.BytesIO(difference_bytes(random_difference(4, 5)))) as loaded:
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
        ({"shape_mm": None}, "'shape_mm' is missing|shape_mm is not a file"),
        ({"ids": np.zeros(5, int)}, "a target stands in it twice"),
        ({"ids": np.int64(3)}, "damaged"),
        ({"ids": np.zeros(0, int)}, "has shape"),
        ({"normal": np.zeros((5, 3))}, "no unit vector"),
        ({"nominal_mm": np.full((5, 3), np.nan)}, "nominal_mm holds NaN"),
        ({"displacement_mm": np.zeros(5, complex)}, "displacement_mm has shape"),
        ({"shape_factor": np.zeros(5)}, "shape_factor has shape"),
        ({"shape_factor": np.zeros((4, 2))}, "shape_factor has shape"),
        ({"shape_own_mm2": np.full(5, -1.0)}, "a variance is negative"),
        ({"quality": np.full(5, 1 << 40)}, "quality flag is unknown"),
        ({"header_surface": {"kind": "sphere"}}, "unknown surface"),
        ({"header_surface": {"kind": "plane", "colour": 3}}, "damaged"),
        ({"header_surface": []}, "damaged"),
        ({"header_surface": {"kind": "paraboloid", "focal_length_mm": float("nan")}}, "a number is not finite"),
        ({"header_rigid_motion": {"rotation": [[2]], "mm": [0, 0, 0]}}, "damaged"),
        ({"header_rigid_covariance_mm_rad": [[1.0]]}, "covariance of the rigid motion is none"),
        ({"header_significance": {}}, "'chi_square' is missing"),
        ({"header_converged": "yes"}, "converged must be true or false"),
        (
            {"header_format": "dishmap-difference-map/9"},
            "has the format 'dishmap-difference-map/9', and 'dishmap-difference-map/1' is read",
        ),
        ({"header_format": 3}, "has the format '3'"),
    ],
)
def test_what_is_wrong_is_named(arrays: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        parse_difference_map(changed(**arrays), "d.npz")
    assert str(caught.value).startswith("d.npz ")
    assert len(parse_difference_map(changed())) == 5


def test_pickled_objects_and_bombs_are_not_opened() -> None:
    out = io.BytesIO()
    np.savez(out, **{HEADER: np.array([{"a": 1}], dtype=object)})
    with pytest.raises(InputError, match="no whole difference"):
        parse_difference_map(out.getvalue())
    out = io.BytesIO()
    np.savez_compressed(out, **{HEADER: np.zeros(50_000_000, np.uint8)})
    with pytest.raises(InputError, match="no whole difference"):
        parse_difference_map(out.getvalue())


def test_every_column_of_targets_is_kept() -> None:
    alone = {"surface", "rigid_motion", "rigid_covariance", "significance", "converged"}
    assert {field.name for field in fields(SavedDifference)} == {*WHOLE, *REAL, *alone}
