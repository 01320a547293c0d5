"""Point clouds: frames against sampled points, shared errors against a camera moved by hand, and refused input by text."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dishmap.errors import InputError
from dishmap.surface.cloud import PointCloud, calibration_covariance_mm2, calibration_factor_mm, select_points, transform_cloud
from dishmap.transforms import Pose

ROUNDING = 1e-9
# 20,000 samples estimate a covariance to about 1 %; four times that
SAMPLING = 0.04


def make_cloud(n: int = 7, parameters: int | None = 3, seed: int = 0) -> PointCloud:
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(n, 3))
    root = rng.normal(size=(n, 3, 3))
    return PointCloud(
        ids=np.arange(n) * 2,
        position_mm=rng.normal(size=(n, 3)) * 100,
        normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
        center_px=rng.uniform(0, 1000, (n, 2)),
        covariance_mm2=root @ np.swapaxes(root, 1, 2),
        sigma_normal_rad=rng.uniform(0.001, 0.01, n),
        covariance_px2=np.tile(np.eye(2) * 1e-4, (n, 1, 1)),
        calibration_jacobian=None if parameters is None else rng.normal(size=(n, 3, parameters)),
        quality=np.zeros(n, dtype=int),
        frame="camera",
    )


vectors = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))


@given(vectors, vectors)
def test_there_and_back_is_the_same_cloud(turn: tuple[float, ...], shift: tuple[float, ...]) -> None:
    cloud = make_cloud()
    pose = Pose.from_rotation_vector(turn, np.array(shift) * 100)
    moved = transform_cloud(cloud, pose, "dish")
    back = transform_cloud(moved, pose.inverse(), "camera")
    assert moved.frame == "dish"
    for name in ("position_mm", "normal", "covariance_mm2", "calibration_jacobian", "center_px"):
        np.testing.assert_allclose(getattr(back, name), getattr(cloud, name), atol=ROUNDING)
    # distances and the angles of normals to them do not depend on the frame
    inner = np.einsum("ni,nji->nj", cloud.normal, cloud.position_mm[None] - cloud.position_mm[:, None])
    inner_moved = np.einsum("ni,nji->nj", moved.normal, moved.position_mm[None] - moved.position_mm[:, None])
    np.testing.assert_allclose(inner_moved, inner, atol=1e-6)


def test_covariance_turns_as_sampled_points_do() -> None:
    cloud = make_cloud(1)
    pose = Pose.from_rotation_vector([0.3, -1.0, 0.5], [10.0, 20.0, 30.0])
    rng = np.random.default_rng(1)
    samples = pose.apply(rng.multivariate_normal(cloud.position_mm[0], cloud.covariance_mm2[0], 20000))
    moved = transform_cloud(cloud, pose, "spacecraft")
    scale = np.trace(moved.covariance_mm2[0])
    np.testing.assert_allclose(moved.covariance_mm2[0], np.cov(samples.T), atol=SAMPLING * scale)
    assert np.abs(cloud.covariance_mm2[0] - np.cov(samples.T)).max() > 2 * SAMPLING * scale
    np.testing.assert_allclose(moved.position_mm[0], samples.mean(axis=0), atol=SAMPLING * np.sqrt(scale))


def test_shared_covariance_is_that_of_sampled_cameras() -> None:
    cloud = make_cloud(3)
    rng = np.random.default_rng(2)
    root = rng.normal(size=(3, 2))
    # semi-definite: one combination of the parameters is fixed
    camera = root @ root.T
    factor = calibration_factor_mm(cloud, camera).reshape(9, -1)
    shifts = (cloud.calibration_jacobian @ (root @ rng.normal(size=(2, 20000)))).reshape(9, -1)
    sampled = np.cov(shifts)
    np.testing.assert_allclose(factor @ factor.T, sampled, atol=SAMPLING * np.trace(sampled) / 3)
    # points share it: off-diagonal blocks are as large as the diagonal ones
    assert np.abs((factor @ factor.T)[:3, 3:6]).max() > 0.1 * np.trace(sampled) / 9
    each = calibration_covariance_mm2(cloud, camera)
    np.testing.assert_allclose(each, [(factor @ factor.T)[i : i + 3, i : i + 3] for i in (0, 3, 6)], atol=ROUNDING)


def test_shared_covariance_turns_with_the_frame() -> None:
    cloud = make_cloud()
    pose = Pose.from_rotation_vector([1.0, 0.2, -0.4], [1.0, 2.0, 3.0])
    camera = np.diag([1.0, 2.0, 3.0])
    turned = pose.rotation @ calibration_covariance_mm2(cloud, camera) @ pose.rotation.T
    np.testing.assert_allclose(calibration_covariance_mm2(transform_cloud(cloud, pose, "dish"), camera), turned, atol=ROUNDING)


@pytest.mark.parametrize("parameters", [None, 3])
def test_selection_by_mask_and_by_index(parameters: int | None) -> None:
    cloud = make_cloud(parameters=parameters)
    by_mask, by_index = select_points(cloud, cloud.ids > 6), select_points(cloud, [4, 5, 6])
    assert by_mask.ids.tolist() == by_index.ids.tolist() == [8, 10, 12]
    np.testing.assert_array_equal(by_mask.position_mm, cloud.position_mm[4:])
    assert (by_mask.calibration_jacobian is None) == (parameters is None)


def test_an_empty_cloud_is_a_cloud() -> None:
    empty = select_points(make_cloud(), np.zeros(7, dtype=bool))
    assert len(transform_cloud(empty, Pose.identity(), "dish")) == 0


def test_without_jacobian_the_shared_error_is_unknown() -> None:
    with pytest.raises(InputError, match="carry no Jacobian"):
        calibration_factor_mm(make_cloud(parameters=None), np.eye(3))
    with pytest.raises(InputError, match=r"must be 3x3 finite numbers, not \(4, 4\)"):
        calibration_factor_mm(make_cloud(), np.eye(4))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"frame": "earth"}, "unknown frame 'earth'; use one of camera, dish, spacecraft"),
        ({"position_mm": np.zeros((6, 3))}, r"7 points needs position_mm of shape \(7, 3\), not \(6, 3\)"),
        ({"center_px": np.full((7, 2), np.nan)}, "center_px of a point cloud holds NaN"),
        ({"normal": np.ones((7, 3))}, "normals of a point cloud must be unit vectors"),
        ({"ids": np.zeros(7, dtype=int)}, "ids of a point cloud must differ"),
        ({"calibration_jacobian": np.zeros((7, 2, 3))}, "needs calibration_jacobian of shape"),
        ({"quality": np.zeros(3, dtype=int)}, r"needs quality of shape \(7,\), not \(3,\)"),
    ],
)
def test_arrays_that_disagree_are_refused(change: dict, text: str) -> None:
    with pytest.raises(InputError, match=text):
        replace(make_cloud(), **change)
