"""Rigid transforms against scipy's rotations and their own group laws."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dishmap.errors import InputError
from dishmap.transforms import Pose, angle_between_rad, cross_matrix, rotation_from_vector, vector_from_rotation

# products of a few matrices with entries up to 1, and of lengths up to 1000 mm
ROUNDING = 1e-12
ROUNDING_MM = 1e-9

vectors = st.tuples(*[st.floats(-1.8, 1.8)] * 3).map(np.array)
shifts = st.tuples(*[st.floats(-1000, 1000)] * 3).map(np.array)
poses = st.builds(Pose.from_rotation_vector, vectors, shifts)


@given(vectors)
def test_rotation_equals_scipys(vector: np.ndarray) -> None:
    np.testing.assert_allclose(rotation_from_vector(vector), Rotation.from_rotvec(vector).as_matrix(), atol=ROUNDING)


@given(vectors)
def test_rotation_vector_there_and_back(vector: np.ndarray) -> None:
    # shorter than half a turn, a vector is the only one of its rotation
    vector = vector / max(1.0, np.linalg.norm(vector) / 3.1)
    np.testing.assert_allclose(vector_from_rotation(rotation_from_vector(vector)), vector, atol=1e-9)


def test_rotation_is_exact_through_zero() -> None:
    for size in (0.0, 1e-300, 1e-12, 1e-8, 1e-4):
        vector = size * np.array([0.6, 0.0, 0.8])
        turned = rotation_from_vector(vector) @ [0.0, 1.0, 0.0]
        np.testing.assert_allclose(turned, [-0.8 * np.sin(size), np.cos(size), 0.6 * np.sin(size)], rtol=1e-14, atol=0)
    # a quarter turn about z carries x to y, not to -y
    np.testing.assert_allclose(rotation_from_vector([0, 0, np.pi / 2]) @ [1, 0, 0], [0, 1, 0], atol=ROUNDING)


def test_rotations_of_many_vectors_at_once() -> None:
    many = np.random.default_rng(0).normal(size=(2, 5, 3))
    expected = Rotation.from_rotvec(many.reshape(-1, 3)).as_matrix().reshape(2, 5, 3, 3)
    np.testing.assert_allclose(rotation_from_vector(many), expected, atol=ROUNDING)


@given(vectors, vectors)
def test_cross_matrix_is_the_cross_product(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(cross_matrix(a) @ b, np.cross(a, b), atol=ROUNDING)


@given(poses, poses, shifts)
def test_chained_poses_apply_inner_first(outer: Pose, inner: Pose, point: np.ndarray) -> None:
    np.testing.assert_allclose((outer @ inner).apply(point), outer.apply(inner.apply(point)), atol=ROUNDING_MM)
    np.testing.assert_allclose((outer @ inner).rotate(point), outer.rotate(inner.rotate(point)), atol=ROUNDING_MM)


@given(poses, shifts, shifts)
def test_inverse_undoes_and_distances_stay(pose: Pose, a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(pose.inverse().apply(pose.apply(a)), a, atol=ROUNDING_MM)
    np.testing.assert_allclose((pose @ pose.inverse()).rotation, np.eye(3), atol=ROUNDING)
    np.testing.assert_allclose((pose @ pose.inverse()).translation_mm, 0, atol=ROUNDING_MM)
    assert np.linalg.norm(pose.apply(a) - pose.apply(b)) == pytest.approx(np.linalg.norm(a - b), abs=ROUNDING_MM)


@given(poses, poses, poses)
def test_chaining_is_associative(a: Pose, b: Pose, c: Pose) -> None:
    left, right = (a @ b) @ c, a @ (b @ c)
    np.testing.assert_allclose(left.rotation, right.rotation, atol=ROUNDING)
    np.testing.assert_allclose(left.translation_mm, right.translation_mm, atol=ROUNDING_MM)


def test_pose_moves_points_as_its_formula_says() -> None:
    pose = Pose.from_rotation_vector([0, 0, np.pi / 2], [10.0, 20.0, 30.0])
    np.testing.assert_allclose(pose.apply([[1, 2, 3], [0, 0, 0]]), [[8, 21, 33], [10, 20, 30]], atol=ROUNDING_MM)
    np.testing.assert_allclose(pose.rotate([1, 2, 3]), [-2, 1, 3], atol=ROUNDING_MM)
    np.testing.assert_allclose(pose.rotation_vector_rad, [0, 0, np.pi / 2], atol=ROUNDING)
    np.testing.assert_array_equal(Pose.identity().apply([1, 2, 3]), [1, 2, 3])


@given(vectors, st.floats(-3.1, 3.1))
def test_angle_is_the_one_turned_by(direction: np.ndarray, angle: float) -> None:
    axis = direction / (np.linalg.norm(direction) or 1.0) if np.linalg.norm(direction) > 1e-6 else np.array([0.0, 0.0, 1.0])
    across = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    assert angle_between_rad(across, rotation_from_vector(angle * axis) @ across) == pytest.approx(abs(angle), abs=1e-12)


def test_small_angles_keep_their_digits() -> None:
    # arccos of the dot product would give 0 or 1.5e-8
    assert angle_between_rad([1, 0, 0], [1, 1e-9, 0]) == pytest.approx(1e-9, rel=1e-9)
    assert angle_between_rad([1, 0, 0], [-2, 0, 0]) == pytest.approx(np.pi)


@pytest.mark.parametrize(
    ("rotation", "translation", "text"),
    [
        (np.eye(2), np.zeros(3), r"3x3 rotation and 3 numbers of translation, not \(2, 2\) and \(3,\)"),
        (np.eye(3), np.zeros(2), r"not \(3, 3\) and \(2,\)"),
        (np.eye(3), [0, np.nan, 0], "finite numbers; it holds NaN or infinity"),
        (np.eye(3) * 1.0001, np.zeros(3), "not orthonormal and right-handed"),
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3), "not orthonormal and right-handed"),
    ],
)
def test_what_is_no_pose_is_refused(rotation, translation, text: str) -> None:
    with pytest.raises(InputError, match=text):
        Pose(rotation, np.asarray(translation))


def test_a_rotation_rounded_in_a_file_is_accepted() -> None:
    rotation = np.round(rotation_from_vector([0.3, 0.2, -0.5]), 6)
    assert np.abs(Pose(rotation, np.zeros(3)).rotation - rotation).max() == 0
