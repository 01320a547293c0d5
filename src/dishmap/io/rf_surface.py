"""The deformed reflector for other programs: GRASP surfaces with the objects that name them, and fields over a regular grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dishmap.io.grasp_surface import (
    SurfaceGrid,
    SurfacePoints,
    SurfaceRim,
    format_grid,
    format_points,
    format_rim,
    grid_object,
    points_object,
    rim_object,
)
from dishmap.io.rf_netcdf import Variable
from dishmap.rf.antenna import Reflector
from dishmap.rf.deformation import Deformation, displacement
from dishmap.rf.shape_field import ShapeField, deformation_of, extrapolated, sigma_at

Array = NDArray[np.float64]

SURFACE_FILE, POINTS_FILE, RIM_FILE, OBJECTS_FILE = "surface_deformed.sfc", "points.xyz", "aperture.rim", "surface.tor"
SIDE, RIM_COUNT = 121, 180
# Steps of the search for the nominal place from which a point was moved: each gains the slope of the deformation, well under 1/100.
STEPS = 6


def surface_files(deformation: Deformation, reflector: Reflector, places_mm: Array) -> dict[str, str]:
    """The deformed surface on a regular grid and at the targets' nominal places (N, 2), its rim, and the objects of a .tor file."""
    x, y = (c + np.linspace(-1.0, 1.0, SIDE) * deformation.radius_mm for c in reflector.center_mm)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    z = deformed_height_mm(deformation, reflector, xy).reshape(SIDE, SIDE)
    turn = 2 * np.pi * np.arange(RIM_COUNT) / RIM_COUNT
    rim = reflector.center_mm + reflector.diameter_mm / 2 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    objects = [
        grid_object("dish.surface", SURFACE_FILE),
        points_object("dish.points", POINTS_FILE),
        rim_object("dish.rim", RIM_FILE, RIM_COUNT),
    ]
    told = "deformed reflector, dish frame, vertex of the nominal paraboloid at the origin"
    return {
        SURFACE_FILE: format_grid(SurfaceGrid(x, y, z, f"{told}; beyond the aperture the displacement is that at its rim")),
        POINTS_FILE: format_points(SurfacePoints(_moved(deformation, reflector, places_mm), f"{told}, at the targets")),
        RIM_FILE: format_rim(SurfaceRim(rim, "rim of the aperture")),
        OBJECTS_FILE: "\n".join(objects),
    }


def deformed_height_mm(deformation: Deformation, reflector: Reflector, xy_mm: Array) -> Array:
    """Height z (N,) of the deformed surface over places (N, 2), where points moved along their normals have come to."""
    start = xy_mm
    for _ in range(STEPS):
        start = start + xy_mm - _moved(deformation, reflector, start)[:, :2]
    return _moved(deformation, reflector, start)[:, 2]


def regular_fields(field: ShapeField) -> dict[str, Variable]:
    """Variables of the displacement, its sigma and where it is extrapolated, over a regular grid; NaN beyond the aperture."""
    x, y = (c + np.linspace(-1.0, 1.0, SIDE) * field.radius_mm for c in field.center_mm)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    inside = np.linalg.norm(xy - field.center_mm, axis=1) <= field.radius_mm * (1 + 1e-12)
    value, sigma = np.full(len(xy), np.nan), np.full(len(xy), np.nan)
    value[inside] = displacement(deformation_of(field), xy[inside])[0]
    sigma[inside] = sigma_at(field, xy[inside])
    axes = ("y_mm", "x_mm")
    along = "displacement along the nominal normal, positive towards the focus"
    return {
        "x_mm": Variable(("x_mm",), x, "mm", "nominal x in the dish frame", True),
        "y_mm": Variable(("y_mm",), y, "mm", "nominal y in the dish frame", True),
        "displacement_mm": Variable(axes, value.reshape(SIDE, SIDE), "mm", along),
        "sigma_displacement_mm": Variable(axes, sigma.reshape(SIDE, SIDE), "mm", f"standard deviation of the {along}"),
        "extrapolated": Variable(axes, extrapolated(field, xy).astype(np.int8).reshape(SIDE, SIDE), "1", "1 far from any target"),
    }


def _moved(deformation: Deformation, reflector: Reflector, xy_mm: Array) -> Array:
    """Deformed points (N, 3) of nominal places (N, 2); beyond the disc the displacement is that at its rim."""
    away = xy_mm - deformation.center_mm
    radius = np.linalg.norm(away, axis=1, keepdims=True)
    held = deformation.center_mm + away * np.minimum(1.0, deformation.radius_mm / np.maximum(radius, 1e-300))
    value, _ = displacement(deformation, held)
    f = reflector.focal_length_mm
    normal = np.column_stack([-xy_mm / (2 * f), np.ones(len(xy_mm))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.column_stack([xy_mm, (xy_mm**2).sum(axis=1) / (4 * f)]) + value[:, None] * normal
