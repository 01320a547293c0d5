"""Where the shape of a reflector comes from: a difference of two states, a map of one photograph, or a table."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.compare import DifferenceTable
from dishmap.difference.changes import rigid_columns
from dishmap.difference.saved import SavedDifference
from dishmap.errors import InputError
from dishmap.rf.antenna import Reflector
from dishmap.rf.shape_field import ShapeField, TargetValues, shape_field
from dishmap.surface.cloud import PointCloud, calibration_factor_mm
from dishmap.surface.paraboloid import Placement, distances
from dishmap.targets.pattern import Surface

Array = NDArray[np.float64]

QUANTITIES = ("shape", "displacement")
# Focal lengths of the pattern and of the antenna may differ by this share: that of a print's scale.
FOCAL_TOLERANCE = 0.01
# Points farther from the nominal paraboloid than this, in radii of the aperture, are in other units or in another frame.
LARGEST_DEVIATION = 0.1


def shape_field_of_difference(saved: SavedDifference, reflector: Reflector, quantity: str = "shape") -> ShapeField:
    """The change of the reflector between two states, with the covariance of the joint estimate.

    quantity: `shape`, without the rigid motion, or `displacement`, with it. Raises InputError for an unknown quantity, and when the
    reflector is not what the targets were printed on.
    """
    _check_quantity(quantity)
    check_surface(saved.surface, reflector)
    of_shape = quantity == "shape"
    targets = TargetValues(
        ids=saved.ids,
        places_mm=saved.nominal_mm[:, :2],
        value_mm=saved.shape_mm if of_shape else saved.displacement_mm,
        factor_mm=saved.shape_factor if of_shape else saved.displacement_factor,
        own_mm2=saved.shape_own_mm2 if of_shape else saved.displacement_own_mm2,
        quality=saved.quality,
        settled=True,
    )
    return shape_field(targets, reflector)


def shape_field_of_table(table: DifferenceTable, reflector: Reflector, quantity: str = "shape") -> ShapeField:
    """The change of the reflector from the rows of `difference.csv`.

    The table has no covariance: its errors are taken as independent, so that sigmas of broad terms come out too small where they are not,
    as in most differences; `difference.npz` has the covariance. Where the table has no sigmas (the paper's method), the scatter of its
    values about a smooth surface alone says how uncertain they are. Raises what `shape_field_of_difference` raises.
    """
    _check_quantity(quantity)
    _check_heights(table, reflector)
    sigma = table.sigma_shape_mm if quantity == "shape" else table.sigma_displacement_mm
    value = table.shape_mm if quantity == "shape" else table.displacement_mm
    none, known = np.zeros((len(table), 0)), bool(np.isfinite(sigma).all())
    own = np.nan_to_num(sigma, nan=0.0) ** 2
    return shape_field(TargetValues(table.ids, table.nominal_mm[:, :2], value, none, own, table.quality, settled=known), reflector)


def shape_field_of_points(cloud: PointCloud, reflector: Reflector, camera_covariance: ArrayLike | None = None) -> ShapeField:
    """The deviation of the reflector from its nominal paraboloid, from measured points in the dish frame.

    Values are exact distances from the paraboloid, at the points' feet on it. camera_covariance (P, P): of the calibration, whose error all
    points share; the dish frame was fitted to the same points, so what of that error is a rigid motion is not in the values. Raises
    InputError for another frame or points far from the reflector.
    """
    if cloud.frame != "dish":
        raise InputError(f"the points of a shape must be in the dish frame, not in the {cloud.frame} frame; use transform_cloud")
    placement = Placement(np.zeros(3), np.eye(3))
    nominal = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.25 / reflector.focal_length_mm])
    distance, _, normal = distances(cloud.position_mm, placement, nominal)
    if len(cloud) and np.median(np.abs(distance)) > LARGEST_DEVIATION * reflector.diameter_mm / 2:
        raise InputError(
            f"the measured points lie {np.median(np.abs(distance)):.4g} mm from the paraboloid of focal length "
            f"{reflector.focal_length_mm:g} mm; give the antenna on which the targets were printed"
        )
    foot = cloud.position_mm - distance[:, None] * normal
    shared = np.zeros((len(cloud), 3, 0)) if camera_covariance is None else calibration_factor_mm(cloud, camera_covariance)
    rigid = rigid_columns(cloud.position_mm)
    shared = shared - rigid @ (np.linalg.pinv(rigid.reshape(-1, 6)) @ shared.reshape(3 * len(cloud), -1))
    targets = TargetValues(
        ids=cloud.ids,
        places_mm=foot[:, :2],
        value_mm=distance,
        factor_mm=np.einsum("ni,nik->nk", normal, shared),
        own_mm2=np.maximum(np.einsum("ni,nij,nj->n", normal, cloud.covariance_mm2, normal), 0.0),
        quality=cloud.quality,
        settled=False,
    )
    return shape_field(targets, reflector)


def check_surface(surface: Surface, reflector: Reflector) -> None:
    """Raise InputError unless the nominal surface of a pattern is that of the reflector."""
    if surface.kind != "paraboloid" or surface.focal_length_mm is None:
        raise InputError(
            f"the targets lie on a {surface.kind}, and a reflector is a paraboloid; measure with a pattern printed on the dish"
        )
    _check_focal(surface.focal_length_mm, reflector)


def _check_focal(focal_length_mm: float, reflector: Reflector) -> None:
    if abs(focal_length_mm / reflector.focal_length_mm - 1) > FOCAL_TOLERANCE:
        raise InputError(
            f"the targets lie on a paraboloid of focal length {focal_length_mm:.5g} mm, and that of the antenna is "
            f"{reflector.focal_length_mm:.5g} mm; give the antenna on which they were printed, or correct focal_length_mm"
        )


def _check_heights(table: DifferenceTable, reflector: Reflector) -> None:
    """A table does not say what its targets lie on, but their nominal heights do: z = rho^2 / 4 f."""
    square, height = (table.nominal_mm[:, :2] ** 2).sum(axis=1), table.nominal_mm[:, 2]
    power = float((square**2).sum())
    curvature = float((square * height).sum()) / power if power > 0 else 0.0
    expected = 0.25 / reflector.focal_length_mm
    if curvature < 0.01 * expected:
        raise InputError(
            "the targets of the table lie on no paraboloid that opens to the focus; measure with a pattern printed on the dish"
        )
    _check_focal(0.25 / curvature, reflector)
    if np.abs(height - curvature * square).max() > FOCAL_TOLERANCE * np.abs(height).max():
        raise InputError("the targets of the table lie on no paraboloid about the z axis; measure with a pattern printed on the dish")


def _check_quantity(quantity: str) -> None:
    if quantity not in QUANTITIES:
        raise InputError(f"unknown quantity {quantity!r}; use one of {', '.join(QUANTITIES)}")
