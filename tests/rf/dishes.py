"""Antennas and deformed dishes that the tests of corrections share: 0.6 m, f/D 0.5, -12 dB over the aperture."""

from __future__ import annotations

import numpy as np

from dishmap.rf.antenna import Actuators, Antenna, Blockage, Feed, Reflector, Subreflector
from dishmap.rf.correction import correction_of, no_correction
from dishmap.rf.deformation import Deformation, undeformed
from dishmap.rf.sources import sampled, sources
from dishmap.surface.zernike import zernike, zernike_matrix, zernike_terms

MAIN, FEED = Reflector(600.0, 300.0), Feed("aperture", 12.0)
SMALL_SUB = Subreflector("cassegrain", 220.0, 4.0)
PRIME = Antenna(MAIN, FEED)
CASSEGRAIN = Antenna(MAIN, FEED, SMALL_SUB, Blockage(0.0))
SHAPED = Antenna(MAIN, FEED, SMALL_SUB, Blockage(0.0), Actuators(shape_degree=4, shape_stroke_mm=2.0))
RADIUS_MM = MAIN.diameter_mm / 2


def bent(**terms: float) -> Deformation:
    """A dish bent by terms such as z20=0.5 (mm), z2m2 for (2, -2)."""
    named = {(int(key[1]), int(key[2:].replace("m", "-"))): value for key, value in terms.items()}
    return Deformation(tuple(named), np.array(list(named.values()), float), MAIN.center_mm, RADIUS_MM)


def half_path_mode(n: int, m: int, rms_mm: float) -> Deformation:
    """A dish whose half-path error is one Zernike term of this rms over the aperture: displacement times cos(theta/2) is the term."""
    rho = np.linspace(0, 1, 2001)
    degrees = range(m, m + 13, 2)
    columns = np.stack([zernike(k, m, rho, 0.0) for k in degrees], axis=1)
    size = rms_mm * np.sqrt((n + 1) * (1 if m == 0 else 2))
    wanted = size * zernike(n, m, rho, 0.0) * np.sqrt(1 + (RADIUS_MM * rho / (2 * MAIN.focal_length_mm)) ** 2)
    coefficients = np.linalg.lstsq(columns, wanted, rcond=None)[0]
    return Deformation(tuple((k, m) for k in degrees), coefficients, MAIN.center_mm, RADIUS_MM)


def undone_by(values: np.ndarray, antenna: Antenna, degree: int = 8) -> Deformation:
    """The dish that a displaced subreflector fits: the surface on which its rays have equal paths, to the first order.

    A rise d along the normal changes the path by d n . (b - z), b the arriving ray; found at nodes and fitted by Zernike terms.
    """
    flat = undeformed(antenna.reflector)
    nodes = sampled(antenna, flat, 10.0)
    moved = sources(antenna, flat, correction_of(values), nodes)
    still = sources(antenna, flat, no_correction(antenna), nodes)
    path = moved.rays.path_mm - still.rays.path_mm
    rise = -(path - path.mean()) / ((still.rays.direction - [0.0, 0.0, 1.0]) * still.normal).sum(axis=1)
    terms = tuple(t for t in zernike_terms(degree) if t[0] > 0)
    x, y = (nodes.xy_mm - antenna.reflector.center_mm).T / (antenna.reflector.diameter_mm / 2)
    # piston too is fitted, and left out: it changes no gain
    columns = zernike_matrix(((0, 0), *terms), x, y)
    coefficients = np.linalg.lstsq(columns, rise, rcond=None)[0][1:]
    return Deformation(terms, coefficients, antenna.reflector.center_mm, antenna.reflector.diameter_mm / 2)
