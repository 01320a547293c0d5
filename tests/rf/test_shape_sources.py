"""Shapes from differences, tables and maps: what was bent comes back, and what is no such reflector is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from differences import joint_of

from dishmap.compare import joint_table
from dishmap.difference.saved import saved_difference
from dishmap.errors import InputError
from dishmap.quality import Quality
from dishmap.rf.antenna import Reflector
from dishmap.rf.deformation import displacement
from dishmap.rf.shape_field import ShapeField, deformation_of, sigma_at
from dishmap.rf.shape_sources import shape_field_of_difference, shape_field_of_points, shape_field_of_table
from dishmap.simulate.deform import Deformation, ZernikeTerm, deform, displacement_mm
from dishmap.surface.cloud import PointCloud
from dishmap.surface.membrane import disc_points
from dishmap.targets.builders import dish, plate
from dishmap.transforms import Pose

DISH = dish(diameter_mm=600, focal_length_mm=300, spacing_mm=70)
REFLECTOR = Reflector(600.0, 300.0)
SADDLE = Deformation(zernike=(ZernikeTerm(2, 2, 0.4), ZernikeTerm(3, 1, 0.1)), slide="normal")
INSIDE = disc_points(240.0, 16)[0]
# Numbers without noise, inside the outermost targets.
EXACT_MM = 1e-4
SIGMA_MM = 0.004


def values_mm(state: Deformation, xy_mm: np.ndarray) -> np.ndarray:
    return displacement_mm(state, xy_mm, 300.0)


def found_mm(field: ShapeField, xy_mm: np.ndarray = INSIDE) -> np.ndarray:
    return displacement(deformation_of(field), xy_mm)[0]


def a_joint(**changes: object):  # type: ignore[no-untyped-def]
    shape = values_mm(SADDLE, DISH.center_mm[:, :2])
    n = len(DISH)
    sigma = np.full(n, SIGMA_MM)
    given = {"shape_mm": shape, "displacement_mm": shape + 0.3, "sigma_shape_mm": sigma, "sigma_displacement_mm": 3 * sigma}
    given |= {"shape_own_mm2": np.full(n, 1e-12), "displacement_factor": np.full((n, 1), 0.2), "displacement_own_mm2": np.full(n, 1e-12)}
    return joint_of(DISH, **{**given, **changes})


def test_a_difference_comes_back_with_its_covariance() -> None:
    saved = saved_difference(a_joint(), DISH)
    shape, whole = (shape_field_of_difference(saved, REFLECTOR, quantity) for quantity in ("shape", "displacement"))
    assert np.abs(found_mm(shape) - values_mm(SADDLE, INSIDE)).max() < EXACT_MM
    assert np.abs(found_mm(whole) - values_mm(SADDLE, INSIDE) - 0.3).max() < EXACT_MM
    # an error that all targets share is one of the piston, and stays as large
    assert np.abs(sigma_at(whole, INSIDE) - 0.2).max() < 1e-3
    assert sigma_at(shape, INSIDE).max() < 1e-3


def test_targets_that_moved_on_their_own_are_left_out() -> None:
    quality = np.zeros(len(DISH), np.int64)
    quality[[3, 8]] = int(Quality.OFF_SURFACE), int(Quality.OUTLIER)
    shape = values_mm(SADDLE, DISH.center_mm[:, :2])
    shape[3] += 2.0
    field = shape_field_of_difference(saved_difference(a_joint(shape_mm=shape, quality=quality), DISH), REFLECTOR)
    assert field.left_out == (int(DISH.ids[3]),)
    assert np.abs(found_mm(field) - values_mm(SADDLE, INSIDE)).max() < 10 * EXACT_MM


def test_a_table_has_sigmas_only() -> None:
    rng = np.random.default_rng(1)
    table = joint_table(a_joint())
    noisy = replace(table, shape_mm=table.shape_mm + rng.normal(0, SIGMA_MM, len(table)))
    field = shape_field_of_table(noisy, REFLECTOR)
    error = found_mm(field) - values_mm(SADDLE, INSIDE)
    assert np.abs(error / sigma_at(field, INSIDE)).max() < 3.5
    assert 0.1 * SIGMA_MM < np.median(sigma_at(field, INSIDE)) < SIGMA_MM
    # without sigmas the scatter about a smooth surface says how far to trust it
    unknown = shape_field_of_table(replace(noisy, sigma_shape_mm=np.full(len(table), np.nan)), REFLECTOR)
    error = found_mm(unknown) - values_mm(SADDLE, INSIDE)
    assert np.abs(error / sigma_at(unknown, INSIDE)).max() < 3.5
    assert 0.1 * SIGMA_MM < np.median(sigma_at(unknown, INSIDE)) < SIGMA_MM
    assert found_mm(shape_field_of_table(table, REFLECTOR, "displacement")).mean() == pytest.approx(0.3, abs=0.005)


def cloud(state: Deformation, sigma_mm: float, rng: np.random.Generator, motion: Pose | None = None) -> PointCloud:
    """Points in the dish frame, noisier along z as a camera above sees them."""
    n = len(DISH)
    moved = deform(state, DISH.surface, DISH.center_mm, 300.0)
    sigma = sigma_mm * np.array([0.1, 0.1, 1.0])
    return PointCloud(
        ids=DISH.ids,
        position_mm=moved + rng.normal(0, 1, (n, 3)) * sigma,
        normal=DISH.normal,
        center_px=np.zeros((n, 2)),
        covariance_mm2=np.tile(np.diag(sigma**2), (n, 1, 1)),
        sigma_normal_rad=np.zeros(n),
        covariance_px2=np.zeros((n, 2, 2)),
        calibration_jacobian=None,
        quality=np.zeros(n, np.int64),
        frame="dish",
    )


def test_a_map_is_measured_from_the_nominal_paraboloid() -> None:
    rng = np.random.default_rng(2)
    exact = shape_field_of_points(cloud(SADDLE, 1e-6, rng), REFLECTOR)
    # a displacement along the normal is an exact distance, at the foot that it rose from
    assert np.abs(found_mm(exact) - values_mm(SADDLE, INSIDE)).max() < EXACT_MM
    assert np.allclose(exact.places_mm, DISH.center_mm[:, :2], atol=1e-4)
    noisy = cloud(SADDLE, 0.02, rng)
    field = shape_field_of_points(noisy, REFLECTOR)
    assert np.abs((found_mm(field) - values_mm(SADDLE, INSIDE)) / sigma_at(field, INSIDE)).max() < 3.5
    # the calibration's error is common and does not average out: one that looks like 0.1 mm of astigmatism is as large
    x, y = DISH.center_mm[:, :2].T / 300.0
    jacobian = np.zeros((len(DISH), 3, 2))
    jacobian[:, 2, 0], jacobian[:, 2, 1] = (x**2 - y**2) / DISH.normal[:, 2], 1.0
    doubtful = replace(noisy, calibration_jacobian=jacobian)
    shared = shape_field_of_points(doubtful, REFLECTOR, np.diag([0.1, 0.0]) ** 2)
    astigmatism = shared.terms.index((2, 2))
    assert np.linalg.norm(shared.factor_mm[astigmatism]) == pytest.approx(0.1, rel=0.1)
    # but a rigid motion is none, as the dish's pose was found with the same camera
    rigid = shape_field_of_points(doubtful, REFLECTOR, np.diag([0.0, 10.0]) ** 2)
    assert np.allclose(sigma_at(rigid, INSIDE), sigma_at(field, INSIDE), rtol=0.01)
    # slides of the same points are none of its business
    slid = shape_field_of_points(cloud(replace(SADDLE, slide="least_strain"), 1e-6, rng), REFLECTOR)
    assert np.abs(found_mm(slid) - values_mm(SADDLE, INSIDE)).max() < 0.01


def test_another_reflector_is_refused() -> None:
    saved, table = saved_difference(a_joint(), DISH), joint_table(a_joint())
    for source in (lambda r: shape_field_of_difference(saved, r), lambda r: shape_field_of_table(table, r)):
        source(Reflector(600.0, 302.0))
        with pytest.raises(InputError, match=r"focal length 300 mm, and that of the antenna is 310 mm; give the antenna"):
            source(Reflector(600.0, 310.0))
        with pytest.raises(InputError, match="from the centre"):
            source(Reflector(400.0, 300.0))
        with pytest.raises(InputError, match="from the centre"):
            source(Reflector(600.0, 300.0, offset_mm=200.0))
    flat = plate(6, 6, 60.0)
    with pytest.raises(InputError, match="the targets lie on a plane"):
        shape_field_of_difference(saved_difference(joint_of(flat), flat), REFLECTOR)
    with pytest.raises(InputError, match="lie on no paraboloid that opens"):
        shape_field_of_table(joint_table(joint_of(flat)), REFLECTOR)
    bent = table.nominal_mm + np.where(table.nominal_mm[:, :1] > 100, [0.0, 0.0, 3.0], 0.0)
    with pytest.raises(InputError, match=r"no paraboloid about the z axis|focal length"):
        shape_field_of_table(replace(table, nominal_mm=bent), REFLECTOR)
    with pytest.raises(InputError, match="unknown quantity 'depth'; use one of shape, displacement"):
        shape_field_of_difference(saved, REFLECTOR, "depth")


def test_points_elsewhere_are_refused() -> None:
    points = cloud(SADDLE, 0.01, np.random.default_rng(3))
    with pytest.raises(InputError, match="must be in the dish frame, not in the camera frame"):
        shape_field_of_points(replace(points, frame="camera"), REFLECTOR)
    with pytest.raises(InputError, match="mm from the paraboloid of focal length 100 mm"):
        shape_field_of_points(points, Reflector(600.0, 100.0))
