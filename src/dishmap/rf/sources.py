"""Currents on the deformed dish, by physical optics: J = 2 n x H, H the magnetic field of the arriving ray.

A source is a current times its area, with the path that its ray has come. Everything is relative to the feed's whole power, so that
sums over sources give gain. Fields are in units in which power density is |E|^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.antenna import Antenna
from dishmap.rf.aperture import ApertureNodes, aperture_nodes
from dishmap.rf.correction import Correction
from dishmap.rf.deformation import Deformation, displacement
from dishmap.rf.rays import FeedPlace, Rays, feed_place, trace
from dishmap.rf.subreflector import rim_disc

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

LIGHT_MM_GHZ = 299.792458
# Under so many wavelengths across, currents by physical optics are no longer those of the dish.
LEAST_WAVELENGTHS = 3.0
# Rings and spokes of the quadrature: for the illumination, for each radian of phase at the rim (towards the widest direction wanted, plus
# what the steepest part of the deformation adds), and for each degree of the deformation.
RINGS, SPOKES = (24, 0.6, 1), (64, 1.3, 3)
SEARCH_RINGS, SEARCH_SPOKES = (7, 0.6, 0.5), (18, 1.3, 2)
# A subreflector that can be bent is taken for a deformation of this degree at least.
BENT_DEGREE = 6
# More nodes than these come of a mistake in the input: a dish of 1 m at 30 GHz, several mm out of shape, takes a hundredth of them.
MOST_NODES = 2_000_000
# Half the angular width of the beam is about this over the diameter in wavelengths.
BEAM = 0.6


@dataclass(frozen=True)
class Sources:
    """N currents times areas on the dish.

    nodes: where they are, in nominal x and y; normal (N, 3): nominal unit normals; point_mm (N, 3); moment (N, 3): 2 n x H times area,
    in mm^2 over distance; rays: that make them; arriving (N,): power that arrives at each, as a share of the feed's.
    """

    nodes: ApertureNodes
    normal: Array
    point_mm: Array
    moment: Complex
    rays: Rays
    arriving: Array


@dataclass(frozen=True)
class Illuminated:
    """What stays as it is while the actuators move: the deformed dish at its nodes, and the feed.

    point_mm, area_mm2, normal (N, 3), as `deformed_surface` gives them.
    """

    nodes: ApertureNodes
    point_mm: Array
    area_mm2: Array
    normal: Array
    feed: FeedPlace


def wavelength_of(antenna: Antenna, frequency_ghz: float) -> float:
    """Wavelength in mm. Raises InputError where the aperture is under 3 wavelengths across."""
    if not (np.isfinite(frequency_ghz) and frequency_ghz > 0):
        raise InputError(f"the frequency must be a positive number of GHz, not {frequency_ghz:g}")
    wavelength = LIGHT_MM_GHZ / frequency_ghz
    across = antenna.reflector.diameter_mm / wavelength
    if across < LEAST_WAVELENGTHS:
        lowest = LEAST_WAVELENGTHS * LIGHT_MM_GHZ / antenna.reflector.diameter_mm
        raise InputError(
            f"at {frequency_ghz:g} GHz the aperture is {across:.2g} wavelengths across, and physical optics needs {LEAST_WAVELENGTHS:g}; "
            f"ask for {lowest:.3g} GHz or more"
        )
    return wavelength


def sampled(antenna: Antenna, deformation: Deformation, wavelength_mm: float, widest: float = 0.0) -> ApertureNodes:
    """Nodes fine enough for directions up to `widest` (sine of the angle from the boresight), at least for the main beam.

    Raises InputError when that takes more than MOST_NODES.
    """
    return _nodes(antenna, deformation, wavelength_mm, widest, (RINGS, SPOKES))


def search_nodes(antenna: Antenna, deformation: Deformation, wavelength_mm: float, widest: float = 0.0) -> ApertureNodes:
    """A fifth of the nodes of `sampled`, for searches: gains near the main beam to 1e-4 dB, to be judged again on those of `sampled`.

    Raises InputError as that does.
    """
    return _nodes(antenna, deformation, wavelength_mm, widest, (SEARCH_RINGS, SEARCH_SPOKES))


def _nodes(
    antenna: Antenna, deformation: Deformation, wavelength_mm: float, widest: float, needs: tuple[tuple[float, float, float], ...]
) -> ApertureNodes:
    widest = max(widest, 3 * BEAM * wavelength_mm / antenna.reflector.diameter_mm)
    wavenumber, degree = 2 * np.pi / wavelength_mm, max((n for n, _ in deformation.terms), default=0)
    if antenna.actuators.shape_degree:
        # the same nodes for all but the highest degrees, so that their searches see the same gain
        degree = max(degree, BENT_DEGREE, antenna.actuators.shape_degree)
    phase = wavenumber * antenna.reflector.diameter_mm / 2 * widest
    steep = 2 * wavenumber * _steepest(antenna, deformation)
    counts = [base + slope * (phase + extra) + bent * degree for (base, slope, bent), extra in zip(needs, steep, strict=True)]
    rings, spokes = (int(np.ceil(count)) for count in counts)
    if rings * spokes > MOST_NODES:
        raise InputError(
            f"phases over the aperture reach {max(phase, *steep):.3g} radians, which would take {rings * spokes:.2g} currents to sum; "
            "check the units of the shape and of the antenna, or ask for a lower frequency or a narrower pattern"
        )
    return aperture_nodes(antenna, rings, spokes, *shadow_mm(antenna))


def shadow_mm(antenna: Antenna) -> tuple[float, float]:
    """The disc that is blocked: its radius and where its middle lies on x; as given (about the axis), or the subreflector's own."""
    if antenna.blockage.diameter_mm is not None:
        return antenna.blockage.diameter_mm / 2, 0.0
    if antenna.subreflector is None:
        return 0.0, 0.0
    center, radius = rim_disc(antenna.reflector, antenna.subreflector)
    return radius, center


def _steepest(antenna: Antenna, deformation: Deformation) -> Array:
    """Steepest slopes (2,) of the deformation in mm: for each aperture radius outwards, and for each radian around.

    The slope outwards counts less towards the middle and the rim, where a Gauss rule is denser: 2 sqrt(rho (1 - rho)).
    """
    degree = max((n for n, _ in deformation.terms), default=0)
    rings, spokes = degree + 4, 4 * degree + 8
    away = aperture_nodes(antenna, rings, spokes, 0.0).xy_mm - antenna.reflector.center_mm
    gradient = displacement(deformation, away + antenna.reflector.center_mm)[1]
    radius = antenna.reflector.diameter_mm / 2
    rho = np.linalg.norm(away, axis=1) / radius
    outwards = np.abs((gradient * away).sum(axis=1)) / rho * 2 * np.sqrt(rho * (1 - rho))
    around = np.abs(gradient[:, 1] * away[:, 0] - gradient[:, 0] * away[:, 1])
    return np.array([outwards.max(), around.max()])


def illuminated(antenna: Antenna, deformation: Deformation, nodes: ApertureNodes) -> Illuminated:
    """The deformed dish and the feed, ready for `sources_after` any correction."""
    return Illuminated(nodes, *deformed_surface(antenna, deformation, nodes), feed_place(antenna))


def sources(antenna: Antenna, deformation: Deformation, correction: Correction, nodes: ApertureNodes) -> Sources:
    """Currents on the deformed dish, after a correction. Raises InputError when the subreflector would reach the dish or the feed."""
    return sources_after(antenna, illuminated(antenna, deformation, nodes), correction)


def sources_after(antenna: Antenna, dish: Illuminated, correction: Correction, near_mm: Array | None = None) -> Sources:
    """Currents on a dish that was prepared, after a correction; near_mm as in `trace`. Raises InputError as `sources` does."""
    rays = trace(antenna, dish.feed, dish.point_mm, correction, near_mm)
    # A x (b x E) = b (A . E) - E (A . b)
    facing, along = -(rays.direction * dish.area_mm2).sum(axis=1), (dish.area_mm2 * rays.field).sum(axis=1)
    moment = 2 * (rays.direction * along[:, None] + rays.field * facing[:, None])
    arriving = facing * (np.abs(rays.field) ** 2).sum(axis=1)
    return Sources(dish.nodes, dish.normal, dish.point_mm, moment, rays, arriving)


def illumination(sources: Sources) -> Array:
    """Amplitude of the field times area (N,) at the lit nodes, those that cover the aperture as if nothing stood in it."""
    lit = slice(0, sources.nodes.lit)
    return np.asarray(np.sqrt(np.maximum(sources.arriving[lit] * sources.nodes.weight_mm2[lit], 0.0)))


def deformed_surface(antenna: Antenna, deformation: Deformation, nodes: ApertureNodes) -> tuple[Array, Array, Array]:
    """Points (N, 3), area vectors (N, 3) and nominal unit normals (N, 3) at the nodes: x0 + d n0, and the product of its derivatives."""
    f = antenna.reflector.focal_length_mm
    x, y = nodes.xy_mm.T
    value, gradient = displacement(deformation, nodes.xy_mm)
    stretch = np.sqrt(1 + (x**2 + y**2) / (4 * f**2))
    normal = np.stack([-x / (2 * f), -y / (2 * f), np.ones_like(x)], axis=1) / stretch[:, None]
    sides = []
    for k, along in enumerate((x, y)):
        side = np.zeros((len(x), 3))
        side[:, k], side[:, 2] = 1.0, along / (2 * f)
        turn = -normal * (along / (4 * f**2 * stretch**2))[:, None]
        turn[:, k] -= 1 / (2 * f * stretch)
        sides.append(side + gradient[:, k, None] * normal + value[:, None] * turn)
    point = np.stack([x, y, (x**2 + y**2) / (4 * f)], axis=1) + value[:, None] * normal
    return point, np.cross(sides[0], sides[1]) * nodes.weight_mm2[:, None], normal
