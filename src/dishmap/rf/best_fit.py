"""The paraboloid that fits a deformed dish best, as the antenna sees it: half-path errors weighed by the illumination."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import FitError
from dishmap.rf.antenna import Antenna
from dishmap.rf.deformation import Deformation
from dishmap.rf.sources import Sources, deformed_surface, illumination
from dishmap.surface.paraboloid import Placement, distances
from dishmap.surface.zernike import zernike_matrix

Array = NDArray[np.float64]

STEPS, STILL = 30, 1e-12
NAMES = ("vertex_x_mm", "vertex_y_mm", "vertex_z_mm", "axis_x_deg", "axis_y_deg", "focal_length_mm")
# Step of the fit's response to the shape, in mm: far above rounding, far below any curvature of it.
RESPONSE_STEP_MM = 1e-3


@dataclass(frozen=True)
class BestFit:
    """The best-fit paraboloid.

    values (6,), in the units of NAMES: vertex, turn of the axis about x and y, focal length; sigma (6,); xy_mm (N, 2) and residual_mm
    (N,): distance of the deformed surface from it, along the normal, positive towards the focus; half_path_rms_mm and
    weighted_half_path_rms_mm: of the residuals' half-path error.
    """

    values: Array
    sigma: Array
    xy_mm: Array
    residual_mm: Array
    half_path_rms_mm: float
    weighted_half_path_rms_mm: float


def best_fit(antenna: Antenna, deformation: Deformation, sources: Sources, factor_mm: Array) -> BestFit:
    """Fit a paraboloid to the deformed dish at the nodes of sources that were made of it.

    factor_mm (T, R): of the covariance of the deformation's coefficients. Raises FitError when the fit does not converge.
    """
    lit = slice(0, sources.nodes.lit)
    points = deformed_surface(antenna, deformation, sources.nodes)[0][lit]
    area, normal = sources.nodes.weight_mm2[lit], sources.normal[lit]
    weight = illumination(sources)
    start = Placement(np.zeros(3), np.eye(3))
    parameters, residual, columns = _fitted(points, normal[:, 2], weight, start, antenna.reflector.focal_length_mm)
    # how the fit follows a displacement along the normal at each node
    half = np.sqrt(weight) * normal[:, 2]
    response = -np.linalg.pinv(half[:, None] * columns) * half
    x, y = ((sources.nodes.xy_mm[lit] - deformation.center_mm) / deformation.radius_mm).T
    spread = response @ (zernike_matrix(deformation.terms, x, y) @ factor_mm)
    unit = np.concatenate([np.ones(3), np.degrees(np.ones(2)), [-0.25 / parameters[5] ** 2]])
    values = np.concatenate([parameters[:3], np.degrees(parameters[3:5]), [0.25 / parameters[5]]])
    error = residual * normal[:, 2]
    return BestFit(
        values=values,
        sigma=np.abs(unit) * np.sqrt((spread**2).sum(axis=1)),
        xy_mm=sources.nodes.xy_mm[lit],
        residual_mm=residual,
        half_path_rms_mm=float(np.sqrt((area @ error**2) / area.sum())),
        weighted_half_path_rms_mm=float(np.sqrt((weight @ error**2) / weight.sum())),
    )


def _fitted(points: Array, cosine: Array, weight: Array, placement: Placement, focal: float) -> tuple[Array, Array, Array]:
    """Parameters (6,) by Gauss-Newton, distances (N,) left, and their derivatives (N, 6)."""
    parameters = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.25 / focal])
    scale = np.array([1.0, 1.0, 1.0, 1 / focal, 1 / focal, 1 / focal**2])
    half = np.sqrt(weight) * cosine
    for _ in range(STEPS):
        gap, by, _ = distances(points, placement, parameters)
        step = scale * np.linalg.lstsq(half[:, None] * by * scale, -half * gap, rcond=None)[0]
        parameters = parameters + step
        if (np.abs(step) < STILL * scale * focal).all():
            gap, by, _ = distances(points, placement, parameters)
            return parameters, gap, by
    raise FitError("the best-fit paraboloid did not converge; the deformation may be larger than a paraboloid can follow")
