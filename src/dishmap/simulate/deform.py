"""How a surface differs from its nominal shape: a displacement field along the nominal normal, expansion, rigid motion.

A printed point P of the nominal surface moves to
`motion.apply((1 + expansion_ppm * 1e-6) * P + displacement_mm(P) * normal(P) + slide(P))`, all in the nominal dish frame; the
displacement is positive towards the focus and is evaluated at the nominal x, y of the point. The slide lies within the surface: a membrane
slides so that it strains the least (`surface.membrane`), unless the deformation says that points stay on their normals.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyval2d
from numpy.typing import ArrayLike, NDArray

from dishmap.errors import InputError
from dishmap.surface.membrane import Fields, disc_points, membrane, sliding, zernike_values
from dishmap.surface.zernike import zernike_xy
from dishmap.targets.pattern import Surface
from dishmap.transforms import Pose

Array = NDArray[np.float64]

# Aluminium over 800 K expands by 2 %; more is a mistake of units.
LARGEST_EXPANSION_PPM = 5e4
SLIDES = ("least_strain", "normal")
# Degree of the polynomials in which slides are found: a slide is the integral of a strain, and so smoother than what causes it.
SLIDE_DEGREE = 16


@dataclass(frozen=True)
class ZernikeTerm:
    """`size_mm` times the unnormalised Zernike term (n, m), which is 1 at the rim; m > 0 cosine, m < 0 sine."""

    n: int
    m: int
    size_mm: float

    def __post_init__(self) -> None:
        _finite("a Zernike term", size_mm=self.size_mm)
        zernike_xy(self.n, self.m, 0.0, 0.0)


@dataclass(frozen=True)
class Bump:
    """A Gaussian bump of `height_mm` and width `sigma_mm` at `center_mm` (x, y) of the dish frame."""

    center_mm: tuple[float, float]
    sigma_mm: float
    height_mm: float

    def __post_init__(self) -> None:
        _finite("a bump", center_x_mm=self.center_mm[0], center_y_mm=self.center_mm[1], height_mm=self.height_mm)
        _positive("a bump", sigma_mm=self.sigma_mm)


@dataclass(frozen=True)
class Crease:
    """A straight ridge through `point_mm` (x, y): `height_mm exp(-d^2 / 2 sigma_mm^2)`, d the distance from the line.

    The line runs in `direction_rad` from the x axis towards y.
    """

    point_mm: tuple[float, float]
    direction_rad: float
    sigma_mm: float
    height_mm: float

    def __post_init__(self) -> None:
        _finite("a crease", x_mm=self.point_mm[0], y_mm=self.point_mm[1], direction_rad=self.direction_rad, height_mm=self.height_mm)
        _positive("a crease", sigma_mm=self.sigma_mm)


@dataclass(frozen=True)
class Gores:
    """Cloth between `count` ribs: `depth_mm rho^2 (1 - cos(count theta)) / 2`, zero on the ribs, rho = 1 at the rim."""

    count: int
    depth_mm: float

    def __post_init__(self) -> None:
        _finite("gores", depth_mm=self.depth_mm)
        if self.count < 2:
            raise InputError(f"gores need a count of at least 2 ribs, not {self.count}")


@dataclass(frozen=True)
class Deformation:
    """One state of the surface; the default is the nominal shape.

    slide is one of SLIDES: how points follow a displacement along the normal (on a plane it makes no difference); motion moves the
    whole dish rigidly within its own nominal frame, after everything else.
    """

    zernike: tuple[ZernikeTerm, ...] = ()
    bumps: tuple[Bump, ...] = ()
    creases: tuple[Crease, ...] = ()
    gores: tuple[Gores, ...] = ()
    expansion_ppm: float = 0.0
    slide: str = "least_strain"
    motion: Pose = field(default_factory=Pose.identity)

    def __post_init__(self) -> None:
        for name in ("zernike", "bumps", "creases", "gores"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if self.slide not in SLIDES:
            raise InputError(f"unknown slide {self.slide!r}; use one of {', '.join(SLIDES)}")
        if not abs(self.expansion_ppm) <= LARGEST_EXPANSION_PPM:
            raise InputError(f"expansion_ppm must lie within +-{LARGEST_EXPANSION_PPM:g} parts per million, not {self.expansion_ppm}")


def displacement_mm(deformation: Deformation, xy_mm: ArrayLike, rim_radius_mm: float) -> Array:
    """Displacement (...) along the nominal normal at nominal positions (..., 2); without expansion and rigid motion."""
    xy = np.asarray(xy_mm, dtype=float)
    x, y = xy[..., 0] / rim_radius_mm, xy[..., 1] / rim_radius_mm
    out = np.zeros(xy.shape[:-1])
    for term in deformation.zernike:
        out += term.size_mm * zernike_xy(term.n, term.m, x, y)
    for bump in deformation.bumps:
        square = ((xy - np.asarray(bump.center_mm)) ** 2).sum(axis=-1)
        out += bump.height_mm * np.exp(-0.5 * square / bump.sigma_mm**2)
    for crease in deformation.creases:
        across = np.array([-np.sin(crease.direction_rad), np.cos(crease.direction_rad)])
        distance = (xy - np.asarray(crease.point_mm)) @ across
        out += crease.height_mm * np.exp(-0.5 * (distance / crease.sigma_mm) ** 2)
    for gore in deformation.gores:
        out += gore.depth_mm * (x * x + y * y) * 0.5 * (1 - np.cos(gore.count * np.arctan2(y, x)))
    return out


def deform(deformation: Deformation, surface: Surface, points_mm: ArrayLike, rim_radius_mm: float) -> Array:
    """Move points (..., 3) of the nominal surface to where they are in this state, in the nominal dish frame."""
    points = np.asarray(points_mm, dtype=float)
    xy = points[..., :2]
    rise = displacement_mm(deformation, xy, rim_radius_mm)
    moved = points * (1 + 1e-6 * deformation.expansion_ppm) + rise[..., None] * surface.normal(xy)
    if deformation.slide == "least_strain" and surface.kind == "paraboloid":
        moved += _slide_mm(deformation, surface, xy, rim_radius_mm)
    return deformation.motion.apply(moved)


def _slide_mm(deformation: Deformation, surface: Surface, xy: Array, rim_radius_mm: float) -> Array:
    """Slide (..., 3) with the least strain under the displacement along the normal."""
    shapes = (deformation.zernike, deformation.bumps, deformation.creases, deformation.gores)
    if not any(shapes):
        return np.zeros((*xy.shape[:-1], 3))
    along_x, along_y = _slide_polynomials(shapes, surface, rim_radius_mm)
    x, y = xy[..., 0] / rim_radius_mm, xy[..., 1] / rim_radius_mm
    by_x, by_y = polyval2d(x, y, along_x), polyval2d(x, y, along_y)
    bend = 0.0 if surface.focal_length_mm is None else 0.5 / surface.focal_length_mm
    # along the tangents dX/dx and dX/dy
    return np.stack([by_x, by_y, bend * (xy[..., 0] * by_x + xy[..., 1] * by_y)], axis=-1)


@lru_cache(maxsize=32)
def _slide_polynomials(shapes: tuple[tuple[Any, ...], ...], surface: Surface, rim_radius_mm: float) -> tuple[Array, Array]:
    """Coefficients c[i, j] of x^i y^j (in rim radii) of the slide along dX/dx and dX/dy."""
    zernike, bumps, creases, gores = shapes
    following, points = _membrane_of(surface, rim_radius_mm)
    bare = Deformation(zernike=zernike, bumps=bumps, creases=creases, gores=gores)
    found = following @ displacement_mm(bare, points, rim_radius_mm)
    return found[0], found[1]


@lru_cache(maxsize=4)
def _membrane_of(surface: Surface, rim_radius_mm: float) -> tuple[Array, Array]:
    """A map (2, D, D, Q) from displacements at points (Q, 2) of the disc to the slide's polynomial coefficients; and those points."""
    fields = Fields(surface, rim_radius_mm, SLIDE_DEGREE)
    points, weight = disc_points(rim_radius_mm, 2 * SLIDE_DEGREE + 2)
    unit = points / rim_radius_mm
    value, _ = zernike_values(fields.normal_terms, unit)
    projection = np.linalg.solve((value * weight[:, None]).T @ value, (value * weight[:, None]).T)
    found = sliding(membrane(fields), len(fields.normal_terms)) @ projection
    value, _ = zernike_values(fields.tangent_terms, unit)
    top = fields.degree + 1
    powers = [(i, n - i) for n in range(top + 1) for i in range(n + 1)]
    to_powers = np.linalg.pinv(np.stack([unit[:, 0] ** i * unit[:, 1] ** j for i, j in powers], axis=1)) @ value
    out = np.zeros((2, top + 1, top + 1, len(points)))
    half = len(fields.tangent_terms)
    out[:, [i for i, _ in powers], [j for _, j in powers]] = np.stack([to_powers @ found[:half], to_powers @ found[half:]])
    return out, points


def _finite(what: str, **values: float) -> None:
    for name, value in values.items():
        if not np.isfinite(value):
            raise InputError(f"{what} needs a finite {name}, not {value}")


def _positive(what: str, **values: float) -> None:
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"{what} needs a positive {name}, not {value}")
