"""The subreflector as a surface: a conic with the foci of the antenna, moved and bent, with derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.rf.antenna import Antenna, Reflector, Subreflector, sub_vertex_z_mm
from dishmap.rf.correction import Correction, shape_terms
from dishmap.surface.zernike import zernike_gradient, zernike_matrix
from dishmap.transforms import rotation_from_vector

Array = NDArray[np.float64]

# Step of the second derivatives of Zernike terms, from their gradients, in radii.
STEP = 1e-4


@dataclass(frozen=True)
class SubSurface:
    """A subreflector in place: vertex (3,) and rotation (3, 3) after the correction, a and b of the conic, its rim, and its shape.

    The rim is a disc in its own x and y, of `radius_mm` about (center_mm, 0); `limited`: whether rays beyond it are lost (a subreflector
    whose diameter is not given is as large as it has to be).
    """

    subreflector: Subreflector
    vertex_mm: Array
    rotation: Array
    a_mm: float
    b_mm: float
    center_mm: float
    radius_mm: float
    limited: bool
    terms: tuple[tuple[int, int], ...]
    shape_mm: Array


@dataclass(frozen=True)
class Patch:
    """Points (N, 3) of a subreflector in the dish frame, with derivatives over its own x, y.

    first (N, 3, 2); the second ones are bend (N, 2, 2) along its axis (3,).
    """

    point_mm: Array
    first: Array
    bend: Array
    axis: Array


def sub_surface(antenna: Antenna, correction: Correction) -> SubSurface:
    """The subreflector of an antenna that has one, after a correction."""
    sub = antenna.subreflector
    assert sub is not None
    c = sub.foci_distance_mm / 2
    a = c / sub.eccentricity
    center, radius = rim_disc(antenna.reflector, sub)
    vertex = np.array([0.0, 0.0, sub_vertex_z_mm(antenna.reflector, sub)])
    return SubSurface(
        subreflector=sub,
        vertex_mm=vertex + correction.shift_mm,
        rotation=rotation_from_vector([*np.radians(correction.tilt_deg), 0.0]),
        a_mm=a,
        b_mm=float(np.sqrt(abs(c**2 - a**2))),
        center_mm=center,
        radius_mm=radius,
        limited=sub.diameter_mm is not None,
        terms=shape_terms(antenna.actuators),
        shape_mm=correction.shape_mm,
    )


def rim_disc(reflector: Reflector, sub: Subreflector) -> tuple[float, float]:
    """Middle (on x) and radius of the subreflector's rim; without a diameter, the one that the rays to the main rim need."""
    edges = reflector.offset_mm + np.array([-0.5, 0.5]) * reflector.diameter_mm
    points = np.stack([edges, np.zeros(2), edges**2 / (4 * reflector.focal_length_mm)], axis=1)
    x = nominal_reflection(reflector, sub, points)[:, 0]
    radius = float(np.ptp(x)) / 2 if sub.diameter_mm is None else sub.diameter_mm / 2
    return float(x.mean()), radius


def nominal_reflection(reflector: Reflector, sub: Subreflector, points_mm: Array) -> Array:
    """Where the undisturbed subreflector reflects rays to points (N, 3) of the dish: on the line through F1, at the conic's distance.

    r = l / (1 + e cos psi) from the focus, psi counted from the vertex, l = a |1 - e^2| (any text on conics).
    """
    e, focus = sub.eccentricity, reflector.focus_mm
    way = points_mm - focus
    way = way / np.linalg.norm(way, axis=1, keepdims=True)
    latus = sub.foci_distance_mm / 2 / e * abs(1 - e**2)
    distance = latus / (1 - e * way[:, 2])
    return np.asarray(focus + (distance if sub.kind == "cassegrain" else -distance)[:, None] * way)


def local_xy(surface: SubSurface, points_mm: Array) -> Array:
    """Own x and y (N, 2) of points (N, 3) near the subreflector."""
    return np.asarray(((points_mm - surface.vertex_mm) @ surface.rotation)[:, :2])


def patch(surface: SubSurface, xy_mm: Array) -> Patch:
    """Points and derivatives at the subreflector's own x, y (N, 2)."""
    height, slope, bend = _conic(surface, xy_mm)
    if surface.terms and surface.shape_mm.any():
        for own, extra in zip((height, slope, bend), _shape(surface, xy_mm), strict=True):
            own += extra
    local = np.concatenate([xy_mm, height[:, None]], axis=1)
    turn = surface.rotation
    first = turn[None, :, :2] + turn[None, :, 2:] * slope[:, None, :]
    return Patch(surface.vertex_mm + local @ turn.T, first, bend, turn[:, 2])


def shape_heights(surface: SubSurface, xy_mm: Array) -> Array:
    """Heights (N, T) of unit shape terms at own x, y (N, 2), along the subreflector's axis."""
    return zernike_matrix(surface.terms, *_disc_xy(surface, xy_mm))


def beyond_rim(surface: SubSurface, xy_mm: Array) -> NDArray[np.bool_]:
    """Where rays (N,) pass the subreflector."""
    x, y = _disc_xy(surface, xy_mm)
    return np.asarray(x**2 + y**2 > 1.0) if surface.limited else np.zeros(len(xy_mm), bool)


def _conic(surface: SubSurface, xy: Array) -> tuple[Array, Array, Array]:
    """Height above the vertex, slope (N, 2), second derivatives (N, 2, 2): z = a sqrt(1 +- r^2 / b^2) - a."""
    sign = 1.0 if surface.subreflector.kind == "cassegrain" else -1.0
    a, b = surface.a_mm, surface.b_mm
    root = np.sqrt(np.maximum(1 + sign * (xy**2).sum(axis=1) / b**2, 1e-12))
    slope = sign * a / b**2 * xy / root[:, None]
    bend = sign * a / b**2 / root[:, None, None] * np.eye(2) - a / b**4 / root[:, None, None] ** 3 * xy[:, :, None] * xy[:, None, :]
    # height without taking the difference of two large numbers
    return sign * a * (xy**2).sum(axis=1) / b**2 / (root + 1), slope, bend


def _shape(surface: SubSurface, xy: Array) -> tuple[Array, Array, Array]:
    x, y = _disc_xy(surface, xy)
    height = zernike_matrix(surface.terms, x, y) @ surface.shape_mm
    slope, bend = np.zeros((len(xy), 2)), np.zeros((len(xy), 2, 2))

    def gradient(px: Array, py: Array) -> Array:
        total = np.zeros((len(px), 2))
        for (n, m), value in zip(surface.terms, surface.shape_mm, strict=True):
            if value:
                total += value * np.stack(zernike_gradient(n, m, px, py), axis=1)
        return total

    slope = gradient(x, y) / surface.radius_mm
    for k, (dx, dy) in enumerate(((STEP, 0.0), (0.0, STEP))):
        bend[:, :, k] = (gradient(x + dx, y + dy) - gradient(x - dx, y - dy)) / (2 * STEP * surface.radius_mm**2)
    return height, slope, (bend + np.swapaxes(bend, 1, 2)) / 2


def _disc_xy(surface: SubSurface, xy: Array) -> tuple[Array, Array]:
    return (xy[:, 0] - surface.center_mm) / surface.radius_mm, xy[:, 1] / surface.radius_mm
