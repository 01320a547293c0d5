"""The subreflector as a surface: a conic with the foci of the antenna, moved and bent, with derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dishmap.rf.antenna import Antenna, Reflector, Subreflector, sub_vertex_z_mm
from dishmap.rf.correction import Correction, no_correction, shape_terms
from dishmap.surface.zernike import zernike_monomials
from dishmap.transforms import rotation_from_vector

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SubSurface:
    """A subreflector in place: vertex (3,) and rotation (3, 3) after the correction, a and b of the conic, its rim, and its shape.

    The rim is a disc in its own x and y, of `radius_mm` about (center_mm, 0). The surface goes on beyond it: which part of the dish gets
    light is settled by `lit_disc`.
    """

    subreflector: Subreflector
    vertex_mm: Array
    rotation: Array
    a_mm: float
    b_mm: float
    center_mm: float
    radius_mm: float
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
    if surface.shape_mm.any():
        for own, extra in zip((height, slope, bend), _shape(surface, xy_mm), strict=True):
            own += extra
    local = np.concatenate([xy_mm, height[:, None]], axis=1)
    turn = surface.rotation
    first = np.empty((len(xy_mm), 3, 2))
    for k in range(2):
        first[:, :, k] = turn[:, k] + slope[:, k, None] * turn[:, 2]
    return Patch(surface.vertex_mm + local @ turn.T, first, bend, turn[:, 2])


def shape_heights(surface: SubSurface, xy_mm: Array) -> Array:
    """Heights (N, T) of unit shape terms at own x, y (N, 2), along the subreflector's axis."""
    powers, matrix = zernike_monomials(surface.terms)
    x, y = _powers(*_disc_xy(surface, xy_mm), int(powers.max(initial=0)))
    return np.asarray((x[:, powers[:, 0]] * y[:, powers[:, 1]]) @ matrix)


def lit_disc(antenna: Antenna) -> tuple[Array, float]:
    """Centre (2,) and radius of the disc of the aperture that the subreflector lights in its nominal place: all of it, or less.

    A rim given smaller than the rays to the dish need is carried to the aperture by its two rays in the plane of symmetry, and taken to
    light a disc (a plane rim does). The edge stays there while the subreflector moves, so that gain is smooth: what such a rim lets past
    on one side it takes on the other. Against an edge that moves along this leaves out 0.03 dB for 2 mm along z (0.6 m, 30 GHz, 80 mm
    for 94), and up to 0.15 dB for 2 mm aside and 1 degree where the rim is just as large as needed, which has nothing to spare on the
    other side. Diffraction at the edge is left out too.
    """
    main, sub = antenna.reflector, antenna.subreflector
    if sub is None or sub.diameter_mm is None or sub.diameter_mm >= 2 * rim_disc(main, replace(sub, diameter_mm=None))[1]:
        return main.center_mm, main.diameter_mm / 2
    surface = sub_surface(antenna, no_correction(antenna))
    edges = np.array([[surface.center_mm - surface.radius_mm, 0.0], [surface.center_mm + surface.radius_mm, 0.0]])
    way = patch(surface, edges).point_mm - main.focus_mm
    way *= (1.0 if sub.kind == "cassegrain" else -1.0) / np.linalg.norm(way, axis=1, keepdims=True)
    # a ray from the focus meets the paraboloid at the distance 2 f / (1 - cos)
    x = 2 * main.focal_length_mm * way[:, 0] / (1 - way[:, 2])
    return np.array([x.mean(), 0.0]), float(np.ptp(x)) / 2


def _conic(surface: SubSurface, xy: Array) -> tuple[Array, Array, Array]:
    """Height above the vertex, slope (N, 2), second derivatives (N, 2, 2): z = a sqrt(1 +- r^2 / b^2) - a."""
    sign = 1.0 if surface.subreflector.kind == "cassegrain" else -1.0
    a, b = surface.a_mm, surface.b_mm
    x, y = xy.T
    square = x**2 + y**2
    root = np.sqrt(np.maximum(1 + sign * square / b**2, 1e-12))
    steep = sign * a / b**2 / root
    less = a / b**4 / root**3
    bend = np.empty((len(xy), 2, 2))
    bend[:, 0, 0], bend[:, 1, 1] = steep - less * x**2, steep - less * y**2
    bend[:, 0, 1] = bend[:, 1, 0] = -less * x * y
    # height without taking the difference of two large numbers
    return sign * a * square / b**2 / (root + 1), steep[:, None] * xy, bend


def _shape(surface: SubSurface, xy: Array) -> tuple[Array, Array, Array]:
    powers, matrix = zernike_monomials(surface.terms)
    p, q = powers.T
    x, y = _powers(*_disc_xy(surface, xy), int(powers.max()))
    weight, r = matrix @ surface.shape_mm, surface.radius_mm

    def total(factor: NDArray[np.int64], less_x: int, less_y: int) -> Array:
        return np.asarray((x[:, np.maximum(p - less_x, 0)] * y[:, np.maximum(q - less_y, 0)]) @ (factor * weight))

    one = np.ones_like(p)
    slope, bend = np.empty((len(xy), 2)), np.empty((len(xy), 2, 2))
    slope[:, 0], slope[:, 1] = total(p, 1, 0) / r, total(q, 0, 1) / r
    bend[:, 0, 0], bend[:, 1, 1] = total(p * (p - 1), 2, 0) / r**2, total(q * (q - 1), 0, 2) / r**2
    bend[:, 0, 1] = bend[:, 1, 0] = total(p * q, 1, 1) / r**2
    return total(one, 0, 0), slope, bend


def _powers(x: Array, y: Array, degree: int) -> tuple[Array, Array]:
    """Powers 0 to degree (N, degree + 1) of x and y."""
    return np.vander(x, degree + 1, increasing=True), np.vander(y, degree + 1, increasing=True)


def _disc_xy(surface: SubSurface, xy: Array) -> tuple[Array, Array]:
    return (xy[:, 0] - surface.center_mm) / surface.radius_mm, xy[:, 1] / surface.radius_mm
