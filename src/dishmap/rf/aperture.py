"""Where the aperture is sampled: quadrature nodes, with what blocks it as nodes of negative weight.

Discs are integrated by Gauss-Legendre rules along the radius and equal steps in azimuth, which converges exponentially for smooth
fields; a shadow has sharp edges, so it is integrated on its own and taken away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.rf.antenna import Antenna, Blockage
from dishmap.rf.subreflector import lit_disc

Array = NDArray[np.float64]

# Nodes across a strut and, for so many of the disc's rings, along it.
ACROSS_STRUT = 4
# Rings and spokes of a small shadow, spokes of one that the rim cuts: its error falls as their number to the power of -1.5.
LEAST_SHADOW, CUT_SPOKES = (4, 12), 800


@dataclass(frozen=True)
class ApertureNodes:
    """Nodes of a quadrature over the aperture, in nominal x and y.

    xy_mm (N, 2); weight_mm2 (N,): negative in shadows; lit: how many of them, the first ones, cover the part of the aperture that the
    subreflector lights, as if nothing stood in it.
    """

    xy_mm: Array
    weight_mm2: Array
    lit: int


def aperture_nodes(antenna: Antenna, rings: int, spokes: int, shadow_radius_mm: float, shadow_x_mm: float = 0.0) -> ApertureNodes:
    """Nodes over the lit disc of the aperture, less the shadows of a disc of this radius about (shadow_x_mm, 0) and of the struts."""
    blockage = antenna.blockage
    center, radius = lit_disc(antenna)
    shadow = np.array([shadow_x_mm, 0.0])
    parts = [_disc(center, radius, rings, spokes)]
    lit = rings * spokes
    if shadow_radius_mm > 0:
        xy, weight = _shadow(center, radius, shadow, shadow_radius_mm, *_fewer(center, radius, shadow, shadow_radius_mm, rings, spokes))
        parts.append((xy, -weight))
    for k in range(blockage.struts):
        angle = np.radians(blockage.strut_angle_deg) + 2 * np.pi * k / blockage.struts
        foot, way, thick = _strips(angle, blockage.strut_width_mm)
        begin = np.maximum(_apart(foot, blockage), _chord(shadow, shadow_radius_mm, foot, way)[1])
        xy, weight = _strut(center, radius, foot, way, thick, begin, rings)
        parts.append((xy, -weight))
    return ApertureNodes(np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]), lit)


def spread_evenly(count: int, center_mm: Array, radius_mm: float) -> Array:
    """Places (count, 2) spread over a disc as the seeds of a sunflower are: each has the same area around it."""
    k = np.arange(count) + 0.5
    turn = np.pi * (1 + np.sqrt(5)) * k
    return np.asarray(center_mm + radius_mm * np.sqrt(k / count)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1))


def _disc(center: Array, radius: float, rings: int, spokes: int) -> tuple[Array, Array]:
    rho, step = _rule(rings, np.zeros(1), np.full(1, radius))
    phi = 2 * np.pi * (np.arange(spokes) + 0.5) / spokes
    xy = center + rho[0][:, None, None] * np.stack([np.cos(phi), np.sin(phi)], axis=-1)
    weight = np.repeat(rho[0] * step[0], spokes) * (2 * np.pi / spokes)
    return xy.reshape(-1, 2), weight


def _fewer(center: Array, radius: float, shadow: Array, shadow_radius: float, rings: int, spokes: int) -> tuple[int, int]:
    """Rings and spokes for a shadow: phases vary over it as its size; one that the rim cuts has spokes whose length has a kink."""
    if np.linalg.norm(shadow - center) + shadow_radius > radius:
        return rings, max(spokes, CUT_SPOKES)
    share = shadow_radius / radius
    return min(rings, LEAST_SHADOW[0] + int(np.ceil(share * rings))), min(spokes, LEAST_SHADOW[1] + int(np.ceil(share * spokes)))


def _shadow(center: Array, radius: float, shadow: Array, shadow_radius: float, rings: int, spokes: int) -> tuple[Array, Array]:
    """The part of a disc about `shadow` that lies in the aperture, along its own spokes."""
    phi = 2 * np.pi * (np.arange(spokes) + 0.5) / spokes
    way = np.stack([np.cos(phi), np.sin(phi)], axis=-1)
    begin, end = _chord(center, radius, np.tile(shadow, (spokes, 1)), way)
    begin, end = np.maximum(begin, 0.0), np.minimum(end, shadow_radius)
    rho, step = _rule(rings, begin, np.maximum(end, begin))
    xy = shadow + rho[..., None] * way[:, None]
    return xy.reshape(-1, 2), (rho * step).ravel() * (2 * np.pi / spokes)


def _strips(angle: float, width: float) -> tuple[Array, Array, Array]:
    """Lines along a strut, from beside the axis: feet (A, 2), unit ways (A, 2), and how thick a strip each stands for (A,)."""
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    side, thick = _rule(ACROSS_STRUT, np.array([-width / 2]), np.array([width / 2]))
    return side[0][:, None] * across, np.tile(along, (ACROSS_STRUT, 1)), thick[0]


def _strut(center: Array, radius: float, foot: Array, way: Array, thick: Array, start: Array, rings: int) -> tuple[Array, Array]:
    """The strips of a strut from `start` (A,) to the rim."""
    begin, end = _chord(center, radius, foot, way)
    begin = np.maximum(begin, start)
    rho, step = _rule(2 * rings, begin, np.maximum(end, begin))
    xy = foot[:, None] + rho[..., None] * way[:, None]
    return xy.reshape(-1, 2), (step * thick[:, None]).ravel()


def _apart(foot: Array, blockage: Blockage) -> Array:
    """How far along (A,) from the axis struts no longer overlap their neighbours."""
    if blockage.struts < 3:
        return np.zeros(len(foot))
    reach = blockage.strut_width_mm / (2 * np.sin(np.pi / blockage.struts))
    return np.asarray(np.sqrt(np.maximum(reach**2 - (foot**2).sum(axis=1), 0.0)))


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
