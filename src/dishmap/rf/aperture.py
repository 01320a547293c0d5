"""Where the aperture is sampled: quadrature nodes, with what blocks it as nodes of negative weight.

Discs are integrated by Gauss-Legendre rules along the radius and equal steps in azimuth, which converges exponentially for smooth
fields; a shadow has sharp edges, so it is integrated on its own and taken away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.rf.antenna import Antenna

Array = NDArray[np.float64]

# Nodes across a strut and, for so many of the disc's rings, along it.
ACROSS_STRUT = 4


@dataclass(frozen=True)
class ApertureNodes:
    """Nodes of a quadrature over the aperture, in nominal x and y.

    xy_mm (N, 2); weight_mm2 (N,): negative in shadows; lit: how many of them, the first ones, cover the aperture as if nothing stood in it.
    """

    xy_mm: Array
    weight_mm2: Array
    lit: int


def aperture_nodes(antenna: Antenna, rings: int, spokes: int, shadow_radius_mm: float) -> ApertureNodes:
    """Nodes over the aperture of an antenna, less the shadows of a disc of this radius about the axis and of the struts."""
    main, blockage = antenna.reflector, antenna.blockage
    center, radius = main.center_mm, main.diameter_mm / 2
    parts = [_disc(center, radius, rings, spokes)]
    lit = rings * spokes
    if shadow_radius_mm > 0:
        xy, weight = _shadow(center, radius, shadow_radius_mm, rings, spokes)
        parts.append((xy, -weight))
    for k in range(blockage.struts):
        angle = np.radians(blockage.strut_angle_deg) + 2 * np.pi * k / blockage.struts
        xy, weight = _strut(center, radius, angle, blockage.strut_width_mm, _strut_start(antenna, shadow_radius_mm), rings)
        parts.append((xy, -weight))
    return ApertureNodes(np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]), lit)


def _disc(center: Array, radius: float, rings: int, spokes: int) -> tuple[Array, Array]:
    rho, step = _rule(rings, np.zeros(1), np.full(1, radius))
    phi = 2 * np.pi * (np.arange(spokes) + 0.5) / spokes
    xy = center + rho[0][:, None, None] * np.stack([np.cos(phi), np.sin(phi)], axis=-1)
    weight = np.repeat(rho[0] * step[0], spokes) * (2 * np.pi / spokes)
    return xy.reshape(-1, 2), weight


def _shadow(center: Array, radius: float, shadow: float, rings: int, spokes: int) -> tuple[Array, Array]:
    """The part of a disc about the axis that lies in the aperture, along its own spokes."""
    phi = 2 * np.pi * (np.arange(spokes) + 0.5) / spokes
    way = np.stack([np.cos(phi), np.sin(phi)], axis=-1)
    begin, end = _chord(center, radius, np.zeros((spokes, 2)), way)
    begin, end = np.maximum(begin, 0.0), np.minimum(end, shadow)
    rho, step = _rule(rings, begin, np.maximum(end, begin))
    xy = rho[..., None] * way[:, None]
    return xy.reshape(-1, 2), (rho * step).ravel() * (2 * np.pi / spokes)


def _strut(center: Array, radius: float, angle: float, width: float, start: float, rings: int) -> tuple[Array, Array]:
    """A strip from `start` off the axis to the rim."""
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    side, thick = _rule(ACROSS_STRUT, np.array([-width / 2]), np.array([width / 2]))
    foot = side[0][:, None] * across
    begin, end = _chord(center, radius, foot, np.tile(along, (len(foot), 1)))
    begin = np.maximum(begin, np.sqrt(np.maximum(start**2 - side[0] ** 2, 0.0)))
    rho, step = _rule(2 * rings, begin, np.maximum(end, begin))
    xy = foot[:, None] + rho[..., None] * along
    return xy.reshape(-1, 2), (step * thick[0][:, None]).ravel()


def _strut_start(antenna: Antenna, shadow: float) -> float:
    """Where struts begin: at the blocked disc, or where they no longer overlap."""
    count, width = antenna.blockage.struts, antenna.blockage.strut_width_mm
    return max(shadow, width / (2 * np.sin(np.pi / count)) if count > 1 else 0.0)


def _chord(center: Array, radius: float, foot: Array, way: Array) -> tuple[Array, Array]:
    """Where lines from feet (N, 2) along unit ways (N, 2) enter and leave a circle; both at zero for those that miss it."""
    middle = ((center - foot) * way).sum(axis=1)
    half2 = radius**2 - ((foot + middle[:, None] * way - center) ** 2).sum(axis=1)
    half = np.sqrt(np.maximum(half2, 0.0))
    return np.where(half2 > 0, middle - half, 0.0), np.where(half2 > 0, middle + half, 0.0)


def _rule(count: int, begin: Array, end: Array) -> tuple[Array, Array]:
    """Gauss-Legendre nodes and weights (M, count) on intervals (M,)."""
    x, w = np.polynomial.legendre.leggauss(count)
    half = (end - begin)[:, None] / 2
    return (begin + end)[:, None] / 2 + half * x, half * w
