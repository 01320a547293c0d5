"""What is photographed: a marked surface in some state, the camera and its light, and what stands in the way.

Grey levels are on a scale of 0 to 255 whatever the bit depth; a 16-bit image holds 257 times as much. They are levels of
light: `Sensor.gamma` and the noise come after.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.errors import InputError
from dishmap.simulate.deform import Deformation
from dishmap.targets.gridlines import GridLines
from dishmap.targets.pattern import Pattern
from dishmap.targets.pattern import Polygon as PrintedPolygon
from dishmap.transforms import Pose, rotation_from_vector

Array = NDArray[np.float64]

FULL_SCALE_GREY = 255.0
# Below 0.1 px a lens is unphysical; far above 10 px nothing can be measured.
SMALLEST_PSF_PX, LARGEST_PSF_PX = 0.1, 20.0


@dataclass(frozen=True)
class Disc:
    """A disc in the image plane, of uniform grey."""

    center_px: tuple[float, float]
    radius_px: float
    grey: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.center_px).all() and np.isfinite(self.radius_px) and self.radius_px > 0):
            raise InputError(f"a disc needs a finite center_px and a positive radius_px, not {self.center_px} and {self.radius_px}")
        _check_grey("a disc", self.grey)


@dataclass(frozen=True)
class Polygon:
    """A simple polygon in the image plane, of uniform grey; corners_px are (u, v) pairs, in either sense of rotation."""

    corners_px: tuple[tuple[float, float], ...]
    grey: float

    def __post_init__(self) -> None:
        corners = np.asarray(self.corners_px, dtype=float)
        if corners.ndim != 2 or corners.shape[0] < 3 or corners.shape[1] != 2 or not np.isfinite(corners).all():
            raise InputError("a polygon needs at least three corners_px, each two finite numbers")
        object.__setattr__(self, "corners_px", tuple((float(u), float(v)) for u, v in corners))
        _check_grey("a polygon", self.grey)


Shape = Disc | Polygon


@dataclass(frozen=True)
class Glare:
    """Light added over the picture: `peak_grey exp(-d^2 / 2 sigma_px^2)` around `center_px`."""

    center_px: tuple[float, float]
    sigma_px: float
    peak_grey: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.center_px).all() and np.isfinite(self.sigma_px) and self.sigma_px > 0 and self.peak_grey >= 0):
            raise InputError("a glare needs a finite center_px, a positive sigma_px and a peak_grey of zero or more")


@dataclass(frozen=True)
class Light:
    """Grey levels and shading.

    gradient (x, y): relative change of the light over the image's width and height; vignetting: relative loss in the
    corners, growing with the square of the distance from the middle. Shading acts on everything but occluders.
    """

    ink_grey: float = 25.0
    ground_grey: float = 190.0
    background_grey: float = 12.0
    gradient: tuple[float, float] = (0.0, 0.0)
    vignetting: float = 0.0
    glare: tuple[Glare, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "glare", tuple(self.glare))
        for name in ("ink_grey", "ground_grey", "background_grey"):
            _check_grey(name, getattr(self, name))
        if not (
            np.isfinite(self.gradient).all() and np.abs(self.gradient).sum() / 2 + max(self.vignetting, 0.0) < 1 and self.vignetting >= 0
        ):
            raise InputError(f"gradient {self.gradient} and vignetting {self.vignetting} leave no light in some corner; make them smaller")


@dataclass(frozen=True)
class Ribs:
    """`count` straight struts, evenly spaced, that run outwards over the dish's rim.

    Each is `width_mm` wide and reaches from `inner_radius_mm` to `outer_radius_mm` (both seen along the boresight), the first
    towards `first_rad` from x. They lie on the nominal surface, carried on beyond its rim, and move with it.
    front: the ribs hide surface and ink; otherwise they stand behind the surface and show beyond its rim only.
    """

    count: int
    width_mm: float
    inner_radius_mm: float
    outer_radius_mm: float
    grey: float
    first_rad: float = 0.0
    front: bool = True

    def __post_init__(self) -> None:
        if self.count < 1:
            raise InputError(f"ribs need a count of at least 1, not {self.count}")
        if not (np.isfinite(self.width_mm) and self.width_mm > 0 and np.isfinite(self.first_rad)):
            raise InputError(f"ribs need a positive width_mm and a finite first_rad, not {self.width_mm} and {self.first_rad}")
        if not 0 <= self.inner_radius_mm < self.outer_radius_mm < np.inf:
            raise InputError(f"ribs run from inner_radius_mm out to outer_radius_mm, not {self.inner_radius_mm} to {self.outer_radius_mm}")
        _check_grey("ribs", self.grey)


@dataclass(frozen=True)
class LineGap:
    """Missing ink of line number `line` of a grid, from start_t to stop_t in steps of the lattice from the line's first target."""

    line: int
    start_t: float
    stop_t: float

    def __post_init__(self) -> None:
        if self.line < 0 or not (np.isfinite([self.start_t, self.stop_t]).all() and self.start_t < self.stop_t):
            raise InputError(
                f"a gap needs a line's number and a start_t below its stop_t, not line {self.line} from {self.start_t} to {self.stop_t}"
            )


@dataclass(frozen=True)
class Sensor:
    """Blur, tone curve, noise and quantisation.

    psf_sigma_px: Gaussian blur of the optics; the pixels' own square area comes on top. gamma: recorded level is
    `255 (light / 255)^(1 / gamma)`. noise_grey: standard deviation added after gamma, in recorded levels.
    electrons_per_grey: shot noise of the light, off when None. bits: 8 or 16.
    """

    psf_sigma_px: float = 0.8
    gamma: float = 1.0
    noise_grey: float = 0.0
    electrons_per_grey: float | None = None
    bits: int = 8

    def __post_init__(self) -> None:
        if not SMALLEST_PSF_PX <= self.psf_sigma_px <= LARGEST_PSF_PX:
            raise InputError(f"psf_sigma_px must lie between {SMALLEST_PSF_PX} and {LARGEST_PSF_PX}, not {self.psf_sigma_px}")
        if not 0.2 <= self.gamma <= 5:
            raise InputError(f"gamma must lie between 0.2 and 5, not {self.gamma}")
        if not (np.isfinite(self.noise_grey) and self.noise_grey >= 0):
            raise InputError(f"noise_grey must be zero or more, not {self.noise_grey}")
        if self.electrons_per_grey is not None and not (np.isfinite(self.electrons_per_grey) and self.electrons_per_grey > 0):
            raise InputError(f"electrons_per_grey must be positive, not {self.electrons_per_grey}")
        if self.bits not in (8, 16):
            raise InputError(f"bits must be 8 or 16, not {self.bits}")


@dataclass(frozen=True)
class Scene:
    """One photograph to be made.

    ink_spread_mm: every dark area grows by this much at its edges. line_gaps: where a grid's lines are broken. margin_mm: ground
    beyond the outermost ink of a pattern that has no rim. ribs: struts that cross the rim. background: shapes behind the dish
    and its ribs, painted in order; occluders: shapes in front of it.
    """

    pattern: Pattern
    camera: Camera
    camera_from_dish: Pose
    deformation: Deformation = field(default_factory=Deformation)
    light: Light = field(default_factory=Light)
    sensor: Sensor = field(default_factory=Sensor)
    ink_spread_mm: float = 0.0
    margin_mm: float = 20.0
    line_gaps: tuple[LineGap, ...] = ()
    ribs: tuple[Ribs, ...] = ()
    background: tuple[Shape, ...] = ()
    occluders: tuple[Shape, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "line_gaps", tuple(self.line_gaps))
        object.__setattr__(self, "ribs", tuple(self.ribs))
        object.__setattr__(self, "background", tuple(self.background))
        object.__setattr__(self, "occluders", tuple(self.occluders))
        if not (np.isfinite(self.margin_mm) and self.margin_mm >= 0):
            raise InputError(f"margin_mm must be zero or more, not {self.margin_mm}")
        if not np.isfinite(self.ink_spread_mm):
            raise InputError(f"ink_spread_mm must be a finite number, not {self.ink_spread_mm}")
        for name, kind in self.pattern.kinds.items():
            if (spread_radius_mm(kind.radius_mm, kind.dark, self.ink_spread_mm) <= 0).any():
                raise InputError(f"an ink spread of {self.ink_spread_mm} mm closes a circle of target kind {name!r}; make it smaller")
            for polygon in kind.polygons:
                spread_corners_mm(polygon, self.ink_spread_mm)
        for line in self.pattern.lines:
            if line.width_mm + 2 * self.ink_spread_mm <= 0:
                raise InputError(f"an ink spread of {self.ink_spread_mm} mm closes a line of {line.width_mm} mm; make it smaller")
        for gap in self.line_gaps:
            if gap.line >= len(self.pattern.lines):
                raise InputError(f"a gap is in line {gap.line}, but the pattern has {len(self.pattern.lines)} lines, counted from 0")

    def with_state(self, deformation: Deformation) -> Scene:
        """Return the same scene with the surface in another state."""
        return replace(self, deformation=deformation)


def spread_radius_mm(radius_mm: Array, dark: NDArray[np.bool_], ink_spread_mm: float) -> Array:
    """Radii (C,) on the print: the ink's outer edges move out and its inner edges in."""
    return np.asarray(radius_mm + np.where(dark, ink_spread_mm, -ink_spread_mm))


def spread_corners_mm(polygon: PrintedPolygon, ink_spread_mm: float) -> Array:
    """Corners (K, 2), counter-clockwise, of a printed polygon whose sides have moved: out where its inside is ink, else in.

    Raises InputError when that closes the polygon.
    """
    corners = polygon.corners_mm
    if _twice_area(corners) < 0:
        corners = corners[::-1]
    ahead = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(ahead, axis=1, keepdims=True)
    out = np.column_stack([ahead[:, 1], -ahead[:, 0]]) / length
    before = np.roll(out, 1, axis=0)
    # a corner moves along both of its sides' normals at once
    spread = ink_spread_mm if polygon.dark else -ink_spread_mm
    moved = corners + spread * (out + before) / (1 + (out * before).sum(axis=1, keepdims=True))
    if (((np.roll(moved, -1, axis=0) - moved) * ahead).sum(axis=1) <= 0).any():
        raise InputError(f"an ink spread of {ink_spread_mm} mm closes a polygon of a target; make it smaller")
    return np.asarray(moved)


def _twice_area(corners: Array) -> float:
    x, y = corners.T
    return float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


def random_line_gaps(rng: Generator, pattern: Pattern, share: float, length_steps: tuple[float, float] = (0.2, 0.6)) -> tuple[LineGap, ...]:
    """Gaps in this share of all pieces of lines between neighbouring crossings, each wholly between them.

    length_steps: the least and greatest length of a gap, in steps of the lattice. Raises InputError for other shares than 0 to 1.
    """
    if not 0 <= share <= 1 or not 0 < length_steps[0] <= length_steps[1] < 1:
        raise InputError(f"gaps take a share from 0 to 1 of the pieces and lengths within 0 to 1 step, not {share} and {length_steps}")
    pieces = [(line, a, b) for line, t in enumerate(GridLines(pattern).target_t) for a, b in itertools.pairwise(t.tolist())]
    gaps = []
    for number in sorted(rng.permutation(len(pieces))[: round(share * len(pieces))].tolist()):
        line, first, last = pieces[number]
        length = float(rng.uniform(*length_steps))
        start = float(rng.uniform(first, last - length))
        gaps.append(LineGap(line, start, start + length))
    return tuple(gaps)


def facing_pose(distance_mm: float, tilt_rad: float = 0.0, tilt_direction_rad: float = 0.0) -> Pose:
    """camera_from_dish of a camera that looks at the pattern's origin along its -z, with the pattern's y up in the image.

    The dish is then turned by `tilt_rad` about the axis in its own x-y plane at `tilt_direction_rad` from x.
    """
    axis = np.array([np.cos(tilt_direction_rad), np.sin(tilt_direction_rad), 0.0])
    rotation = np.diag([1.0, -1.0, -1.0]) @ rotation_from_vector(tilt_rad * axis)
    return Pose(rotation, np.array([0.0, 0.0, distance_mm]))


def random_shapes(
    rng: Generator, camera: Camera, discs: int, rings: int, rectangles: int, size_px: tuple[float, float], grey: tuple[float, float]
) -> tuple[Shape, ...]:
    """Clutter for a background: discs, light rings and rectangles at random places, sizes and greys.

    size_px and grey are the least and the greatest. A ring is light with a dark inside, the inverse of printed ink.
    """
    if not (0 < size_px[0] <= size_px[1] and 0 <= grey[0] <= grey[1] <= FULL_SCALE_GREY):
        raise InputError(f"clutter needs rising positive sizes and greys within 0 to 255, not {size_px} and {grey}")
    shapes: list[Shape] = []
    for number in range(discs + rings + rectangles):
        u, v = (float(x) for x in rng.uniform([0, 0], [camera.width_px, camera.height_px]))
        size, level = float(rng.uniform(*size_px)), float(rng.uniform(*grey))
        ratio, angle = float(rng.uniform(0.3, 0.7)), float(rng.uniform(0, np.pi))
        if number < discs + rings:
            shapes.append(Disc((u, v), size, level))
            if number >= discs:
                shapes[-1] = Disc((u, v), size, max(level, 0.5 * (grey[0] + grey[1])))
                shapes.append(Disc((u, v), ratio * size, grey[0]))
        else:
            along, across = np.array([np.cos(angle), np.sin(angle)]) * size, np.array([-np.sin(angle), np.cos(angle)]) * size * ratio
            corners = np.array([u, v]) + np.stack([along + across, along - across, -along - across, -along + across])
            shapes.append(Polygon(tuple(map(tuple, corners.tolist())), level))
    return tuple(shapes)


def _check_grey(what: str, grey: float) -> None:
    if not 0 <= grey <= FULL_SCALE_GREY:
        raise InputError(f"the grey of {what} must lie between 0 and 255, not {grey}")
