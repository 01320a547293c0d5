"""What is printed and where: circles or polygons in target kinds, lines through targets, targets on a nominal surface.

A target is a small set of circles in its own plane; disc, ring, concentric rings, WhyCon-like ring and the paper's
multi-circular group are all instances of `TargetKind`. Circles are disjoint or nested, and nested ones alternate between
dark and light inside, so that the ink's coverage is the signed sum of discs.

A *grid* is a pattern whose targets lie on a lattice and look alike: separate squares (a kind with one polygon), or the crossings
of lines (`GridLine`; a kind without ink of its own, or with the ink of an orientation mark beside it). Each target of a grid has its
place (column, row) in the lattice. A pattern is made of circles or is a grid, not both.

Pattern (dish) frame: origin at the vertex of the nominal surface, z along the boresight towards the focus and the camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import PatternError

Array = NDArray[np.float64]

SURFACE_KINDS = ("plane", "paraboloid", "cylinder")
# Axes in a file may carry rounding; 1e-6 is what 7 digits leave.
AXIS_TOLERANCE = 1e-5
# Larger than any dish a camera looks at; a pattern in metres or micrometres falls outside.
SMALLEST_RADIUS_MM, LARGEST_MM = 0.01, 1e5


@dataclass(frozen=True)
class Surface:
    """The nominal surface: `plane` (z = 0), `paraboloid` (z = rho^2 / 4f) with its rim's diameter, or `cylinder`.

    A cylinder's axis is parallel to y and it touches z = 0 along x = 0; with a positive radius it bulges towards the camera
    (z <= 0), with a negative one it is hollow. Its height is one of the half that faces the camera.
    """

    kind: str = "plane"
    diameter_mm: float | None = None
    focal_length_mm: float | None = None
    radius_mm: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in SURFACE_KINDS:
            raise PatternError(f"unknown surface {self.kind!r}; use one of {', '.join(SURFACE_KINDS)}")
        if self.kind == "paraboloid" and self.focal_length_mm is None:
            raise PatternError("a paraboloid needs focal_length_mm")
        if self.kind == "cylinder" and self.radius_mm is None:
            raise PatternError("a cylinder needs radius_mm (positive: it bulges towards the camera; negative: it is hollow)")
        for name in ("diameter_mm", "focal_length_mm"):
            value = getattr(self, name)
            if value is not None and not 0 < value < LARGEST_MM:
                raise PatternError(f"the surface's {name} must lie between 0 and {LARGEST_MM:g} mm, not {value}")
        if self.radius_mm is not None and not 0 < abs(self.radius_mm) < LARGEST_MM:
            raise PatternError(f"the surface's radius_mm must not be 0 and lie within {LARGEST_MM:g} mm, not {self.radius_mm}")

    def height_mm(self, xy_mm: Array) -> Array:
        """Height z of the nominal surface at (..., 2); NaN beside a cylinder."""
        xy = np.asarray(xy_mm, dtype=float)
        if self.kind == "paraboloid" and self.focal_length_mm is not None:
            return np.asarray((xy**2).sum(axis=-1) / (4 * self.focal_length_mm))
        if self.kind == "cylinder" and self.radius_mm is not None:
            return np.asarray(np.sign(self.radius_mm) * (self._cylinder_root(xy) - abs(self.radius_mm)))
        return np.zeros(xy.shape[:-1])

    def _cylinder_root(self, xy: Array) -> Array:
        assert self.radius_mm is not None
        with np.errstate(invalid="ignore"):
            return np.asarray(np.sqrt(self.radius_mm**2 - xy[..., 0] ** 2))

    def slope(self, xy_mm: Array) -> Array:
        """Derivatives (..., 2) of the height by x and y at (..., 2)."""
        xy = np.asarray(xy_mm, dtype=float)
        if self.kind == "paraboloid" and self.focal_length_mm is not None:
            return np.asarray(xy * (0.5 / self.focal_length_mm))
        out = np.zeros(xy.shape)
        if self.kind == "cylinder" and self.radius_mm is not None:
            out[..., 0] = -np.sign(self.radius_mm) * xy[..., 0] / self._cylinder_root(xy)
        return out

    def bend_per_mm(self, xy_mm: Array) -> Array:
        """Second derivatives (..., 2, 2) of the height by x and y at (..., 2)."""
        xy = np.asarray(xy_mm, dtype=float)
        if self.kind == "paraboloid" and self.focal_length_mm is not None:
            return np.broadcast_to(0.5 / self.focal_length_mm * np.eye(2), (*xy.shape[:-1], 2, 2)).copy()
        out = np.zeros((*xy.shape[:-1], 2, 2))
        if self.kind == "cylinder" and self.radius_mm is not None:
            out[..., 0, 0] = -np.sign(self.radius_mm) * self.radius_mm**2 / self._cylinder_root(xy) ** 3
        return out

    def normal(self, xy_mm: Array) -> Array:
        """Unit normal (..., 3) towards the focus at (..., 2)."""
        xy = np.asarray(xy_mm, dtype=float)
        n = np.concatenate([-self.slope(xy), np.ones((*xy.shape[:-1], 1))], axis=-1)
        return np.asarray(n / np.linalg.norm(n, axis=-1, keepdims=True))

    def curvature_per_mm(self, xy_mm: Array, x_axis: Array, y_axis: Array) -> Array:
        """Second fundamental form (..., 2, 2) towards the normal, in tangent axes (..., 3) at (..., 2).

        A printed point at (x, y) of a target stands off its tangent plane by half of [x y] K [x y]^T along the normal.
        """
        axes = np.stack([x_axis, y_axis], axis=-2)[..., :2]
        nz = self.normal(xy_mm)[..., 2]
        return np.asarray(nz[..., None, None] * (axes @ self.bend_per_mm(xy_mm) @ np.swapaxes(axes, -1, -2)))


@dataclass(frozen=True)
class Polygon:
    """A closed polygon of a target kind: corners_mm (K, 2) in the target's plane; dark: its inside is ink, else ground."""

    corners_mm: Array
    dark: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "corners_mm", np.asarray(self.corners_mm, dtype=float).reshape(-1, 2))
        if len(self.corners_mm) < 3 or not (np.isfinite(self.corners_mm).all() and (np.abs(self.corners_mm) < LARGEST_MM).all()):
            raise PatternError(f"a polygon needs three or more corners_mm, finite and within {LARGEST_MM:g} mm")
        x, y = self.corners_mm.T
        area = 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))
        if area < SMALLEST_RADIUS_MM**2:
            raise PatternError(f"a polygon of {area:.3g} mm^2 holds no ink; its corners_mm must not lie on a line")


@dataclass(frozen=True)
class GridLine:
    """A printed line of uniform width through targets: their ids in the line's order, and how far it goes on beyond both ends."""

    ids: tuple[int, ...]
    width_mm: float
    overhang_mm: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "ids", tuple(int(i) for i in self.ids))
        if len(self.ids) < 2 or len(set(self.ids)) < len(self.ids):
            raise PatternError("a line goes through two or more different targets")
        if not SMALLEST_RADIUS_MM <= self.width_mm < LARGEST_MM:
            raise PatternError(f"a line's width_mm must lie between {SMALLEST_RADIUS_MM} and {LARGEST_MM:g}, not {self.width_mm}")
        if not 0 <= self.overhang_mm < LARGEST_MM:
            raise PatternError(f"a line's overhang_mm must lie between 0 and {LARGEST_MM:g}, not {self.overhang_mm}")


@dataclass(frozen=True)
class TargetKind:
    """The ink of one kind of target, in the target's plane: circles, or polygons, or none (the crossing of two lines).

    center_mm (C, 2); radius_mm (C,); dark (C,) is true where the circle's inside is ink, false where it is ground. Polygons follow the
    circles' rule: disjoint or nested, alternating between dark and light.
    """

    center_mm: Array
    radius_mm: Array
    dark: NDArray[np.bool_]
    polygons: tuple[Polygon, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "center_mm", np.asarray(self.center_mm, dtype=float).reshape(-1, 2))
        object.__setattr__(self, "radius_mm", np.asarray(self.radius_mm, dtype=float).reshape(-1))
        object.__setattr__(self, "dark", np.asarray(self.dark, dtype=bool).reshape(-1))
        object.__setattr__(self, "polygons", tuple(self.polygons))
        if not len(self.center_mm) == len(self.radius_mm) == len(self.dark):
            raise PatternError("each circle of a target kind needs center_mm, radius_mm and inside")
        if len(self.radius_mm) and self.polygons:
            raise PatternError("a target kind is made of circles or of polygons, not of both")
        if not (np.isfinite(self.center_mm).all() and (np.abs(self.center_mm) < LARGEST_MM).all()):
            raise PatternError("a circle's center_mm must be finite numbers in mm")
        good = (self.radius_mm >= SMALLEST_RADIUS_MM) & (self.radius_mm < LARGEST_MM)
        if not good.all():
            raise PatternError(
                f"a circle's radius_mm must lie between {SMALLEST_RADIUS_MM} and {LARGEST_MM:g}, not {self.radius_mm[~good][0]}"
            )
        self._check_nesting()

    def _check_nesting(self) -> None:
        """Raise PatternError unless circles are disjoint or nested, alternating in colour."""
        distance = np.linalg.norm(self.center_mm[:, None] - self.center_mm[None], axis=-1)
        for i in range(len(self.radius_mm)):
            for j in range(i):
                a, b = self.radius_mm[i], self.radius_mm[j]
                if abs(a - b) < distance[i, j] < a + b or (distance[i, j] == 0 and a == b):
                    raise PatternError(f"circles {j} and {i} of a target kind cross; they must be disjoint or nested")
        for i, parent in enumerate(self.parent):
            if self.dark[i] == (self.dark[parent] if parent >= 0 else False):
                raise PatternError(
                    f"circle {i} of a target kind has the colour of what surrounds it; nested circles alternate, outermost are dark"
                )
        self._check_polygons()

    def _check_polygons(self) -> None:
        """Raise PatternError unless polygons are disjoint or nested, alternating in colour."""
        for i, polygon in enumerate(self.polygons):
            depth = 0
            for j, other in enumerate(self.polygons):
                held = _inside(polygon.corners_mm, other.corners_mm) if i != j else np.zeros(1, dtype=bool)
                if held.any() != held.all():
                    raise PatternError(f"polygons {min(i, j)} and {max(i, j)} of a target kind cross; they must be disjoint or nested")
                depth += bool(held.all())
            if polygon.dark == bool(depth % 2):
                raise PatternError(
                    f"polygon {i} of a target kind has the colour of what surrounds it; nested polygons alternate, outermost are dark"
                )

    @cached_property
    def parent(self) -> NDArray[np.int64]:
        """Index of the smallest circle around each circle, -1 for the outermost (C,)."""
        parent = np.full(len(self.radius_mm), -1)
        for i, (center, radius) in enumerate(zip(self.center_mm, self.radius_mm, strict=True)):
            around = (np.linalg.norm(self.center_mm - center, axis=1) + radius <= self.radius_mm + 1e-9) & (self.radius_mm > radius)
            if around.any():
                parent[i] = np.flatnonzero(around)[np.argmin(self.radius_mm[around])]
        return parent

    @cached_property
    def outermost(self) -> NDArray[np.int64]:
        """Index of the outermost circle around each circle, its own where nothing is around it (C,)."""
        outer = np.arange(len(self.radius_mm))
        for _ in outer:
            outer = np.where(self.parent[outer] >= 0, self.parent[outer], outer)
        return outer

    @cached_property
    def gap_mm(self) -> float:
        """Smallest width of ground between two outermost circles; infinite for a single one."""
        top = np.flatnonzero(self.parent < 0)
        gaps = [
            np.linalg.norm(self.center_mm[i] - self.center_mm[j]) - self.radius_mm[i] - self.radius_mm[j] for i in top for j in top if i < j
        ]
        return float(min(gaps, default=np.inf))

    @cached_property
    def extent_mm(self) -> float:
        """Radius about the target's origin that holds all of its own ink; 0 for the crossing of two lines."""
        circles = np.linalg.norm(self.center_mm, axis=1) + self.radius_mm
        corners = [np.linalg.norm(polygon.corners_mm, axis=1).max() for polygon in self.polygons]
        return float(max([*circles, *corners], default=0.0))

    @property
    def turns_freely(self) -> bool:
        """True when all circles share the origin, so that a turn about the normal changes nothing."""
        return bool(np.abs(self.center_mm).max(initial=0.0) < 1e-9 and not self.polygons)

    @property
    def has_light_edges(self) -> bool:
        """True when it has edges of both senses, so that ink spread and size can be told apart."""
        return bool((~self.dark).any())


@dataclass(frozen=True)
class Pattern:
    """Targets on a nominal surface, in the dish frame.

    ids (N,); center_mm, x_axis, normal (N, 3); `kinds[kind_names[i]]` is a TargetKind. lattice (N, 2): column and row of each target of
    a grid, None for a pattern of circles; columns run along x_axis, rows along y; lines: of a grid of lines. Raises PatternError when
    arrays disagree, ids repeat, axes are not orthonormal, targets overlap, or a grid is not whole.
    """

    name: str
    surface: Surface
    kinds: dict[str, TargetKind]
    ids: NDArray[np.int64]
    kind_names: tuple[str, ...]
    center_mm: Array
    x_axis: Array
    normal: Array
    lattice: NDArray[np.int64] | None = None
    lines: tuple[GridLine, ...] = ()

    def __post_init__(self) -> None:
        for name in ("center_mm", "x_axis", "normal"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=float).reshape(-1, 3))
        object.__setattr__(self, "lines", tuple(self.lines))
        if self.lattice is not None:
            object.__setattr__(self, "lattice", np.asarray(self.lattice, dtype=np.int64).reshape(-1, 2))
        object.__setattr__(self, "ids", np.asarray(self.ids, dtype=np.int64).reshape(-1))
        object.__setattr__(self, "kind_names", tuple(self.kind_names))
        self._check()

    def _check(self) -> None:
        n = len(self.ids)
        if not n:
            raise PatternError("a pattern needs at least one target")
        if not (len(self.kind_names) == len(self.center_mm) == len(self.x_axis) == len(self.normal) == n):
            raise PatternError("each target needs id, kind, center_mm, x_axis and normal")
        unknown = sorted(set(self.kind_names) - set(self.kinds))
        if unknown:
            raise PatternError(f"target kind {unknown[0]!r} is used but not defined; defined are {', '.join(sorted(self.kinds))}")
        values, counts = np.unique(self.ids, return_counts=True)
        if (counts > 1).any():
            raise PatternError(f"target id {values[counts > 1][0]} is given twice; ids must differ")
        if not (np.isfinite(self.center_mm).all() and (np.abs(self.center_mm) < LARGEST_MM).all()):
            raise PatternError(f"a target's center_mm must be finite and within {LARGEST_MM:g} mm")
        lengths = np.linalg.norm(np.stack([self.x_axis, self.normal]), axis=-1)
        dot = (self.x_axis * self.normal).sum(axis=1)
        if not (np.isfinite(lengths).all() and np.abs(lengths - 1).max() < AXIS_TOLERANCE and np.abs(dot).max() < AXIS_TOLERANCE):
            bad = int(np.argmax(np.nan_to_num(np.abs(lengths - 1).max(axis=0) + np.abs(dot), nan=np.inf)))
            raise PatternError(f"x_axis and normal of target {self.ids[bad]} must be unit vectors at right angles")
        self._check_overlap()
        self._check_grid()

    def _check_grid(self) -> None:
        """Raise PatternError unless the pattern is all circles, or a whole grid."""
        round_ = np.array([len(self.kinds[name].radius_mm) > 0 for name in self.kind_names])
        if self.lattice is None:
            if not round_.all():
                first = self.ids[~round_][0]
                raise PatternError(f"target {first} has no circles, so it belongs to a grid and needs its place in the lattice")
            if self.lines:
                raise PatternError("lines go through the targets of a grid; give each target its place in the lattice")
            return
        if round_.any():
            raise PatternError(f"target {self.ids[round_][0]} is made of circles; a pattern is made of circles or is a grid, not both")
        if len(self.lattice) != len(self.ids):
            raise PatternError("each target of a grid needs its place (column, row) in the lattice")
        places, counts = np.unique(self.lattice, axis=0, return_counts=True)
        if (counts > 1).any():
            raise PatternError(f"two targets have the place {places[counts > 1][0].tolist()} in the lattice; places must differ")
        self._check_lines()

    def _check_lines(self) -> None:
        through = [i for line in self.lines for i in line.ids]
        unknown = sorted(set(through) - set(self.ids.tolist()))
        if unknown:
            raise PatternError(f"a line goes through target {unknown[0]}, which the pattern does not have")
        if self.lines and sorted(through) != sorted(2 * self.ids.tolist()):
            counts = {int(i): through.count(int(i)) for i in self.ids}
            bad = next(i for i, count in counts.items() if count != 2)
            raise PatternError(f"{counts[bad]} lines go through target {bad}; two cross at each target of a grid of lines")
        inkless = [name for name in self.kind_names if not self.kinds[name].polygons]
        if not self.lines and inkless:
            raise PatternError(f"targets of kind {inkless[0]!r} have no ink and no lines cross there; give the pattern lines or polygons")

    def _check_overlap(self) -> None:
        from scipy.spatial import cKDTree

        extent = np.array([self.kinds[k].extent_mm for k in self.kind_names])
        for i, j in cKDTree(self.center_mm).query_pairs(max(2 * extent.max(), 1e-6)):
            if np.linalg.norm(self.center_mm[i] - self.center_mm[j]) < 1e-6 + 0.5 * (extent[i] + extent[j]) * (not self.lines):
                raise PatternError(f"targets {self.ids[i]} and {self.ids[j]} lie on top of each other")

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def is_grid(self) -> bool:
        """True for squares or crossings on a lattice, False for targets made of circles."""
        return self.lattice is not None

    @cached_property
    def axes(self) -> Array:
        """Rotation dish_from_target of each target (N, 3, 3): columns x_axis, y_axis, normal."""
        return np.stack([self.x_axis, np.cross(self.normal, self.x_axis), self.normal], axis=-1)

    @cached_property
    def curvature_per_mm(self) -> Array:
        """Second fundamental form of the nominal surface in each target's axes (N, 2, 2)."""
        axes = self.axes
        return self.surface.curvature_per_mm(self.center_mm[:, :2], axes[..., 0], axes[..., 1])

    @cached_property
    def rim_radius_mm(self) -> float:
        """The radius at which a Zernike term is 1: the surface's rim, or the outermost ink of a pattern without one."""
        if self.surface.diameter_mm is not None:
            return self.surface.diameter_mm / 2
        extent = np.array([self.kinds[name].extent_mm for name in self.kind_names])
        return float((np.linalg.norm(self.center_mm[:, :2], axis=1) + extent).max())

    def kind_of(self, index: int) -> TargetKind:
        """The TargetKind of target number `index` (not its id)."""
        return self.kinds[self.kind_names[index]]

    @cached_property
    def marks(self) -> Marks:
        """Every outermost circle with what is nested in it, over all targets: what a detector can see one by one."""
        return _marks(self)


def _inside(points: Array, corners: Array) -> NDArray[np.bool_]:
    """Which points (P, 2) lie inside a polygon (K, 2): a ray from each crosses its sides an odd number of times."""
    x, y = points[:, :1], points[:, 1:]
    (ax, ay), (bx, by) = corners.T, np.roll(corners, -1, axis=0).T
    spans = (ay > y) != (by > y)
    at = ax + (y - ay) * (bx - ax) / np.where(ay == by, 1.0, by - ay)
    return np.asarray((spans & (x < at)).sum(axis=1) % 2 == 1)


def bent_print_mm(xy_mm: Array, curvature_per_mm: Array) -> Array:
    """Points (..., Q, 3) in target axes of printed positions (..., Q, 2) on surfaces with curvature (..., 2, 2).

    A print keeps its lengths along the surface, so a position is followed along its geodesic, to third order:
    v + (v K v) / 2 normal - (v K v) K v / 6 (do Carmo, Differential Geometry, 4.4). The last term is 0.5 micrometres
    at 10 mm on a 0.6 m dish of f/D 0.5; left out, it would shift depths by 0.04 mm.
    """
    bent = xy_mm @ curvature_per_mm
    twice_sag = (xy_mm * bent).sum(axis=-1, keepdims=True)
    return np.concatenate([xy_mm - twice_sag * bent / 6, 0.5 * twice_sag], axis=-1)


@dataclass(frozen=True)
class Marks:
    """Outermost circles of all targets, with their nested circles: the things a detector finds.

    target (M,): index of the target each belongs to; circle (M,): which circle of its kind; center_mm (M, 3) in the dish
    frame, on the surface; normal (M, 3);
    radius_mm (M,); type_index (M,): equal for marks that look alike; type_ratios: for each type, the radii of the circles
    nested in it divided by its own, largest first.
    """

    target: NDArray[np.int64]
    circle: NDArray[np.int64]
    center_mm: Array
    normal: Array
    radius_mm: Array
    type_index: NDArray[np.int64]
    type_ratios: tuple[tuple[float, ...], ...]


def _marks(pattern: Pattern) -> Marks:
    rows: list[tuple[int, int, Array, float, tuple[float, ...]]] = []
    for index, kind_name in enumerate(pattern.kind_names):
        kind = pattern.kinds[kind_name]
        for outer in np.flatnonzero(kind.parent < 0):
            inside = (kind.outermost == outer) & (kind.parent >= 0)
            ratios = tuple(sorted((round(float(r), 6) for r in kind.radius_mm[inside] / kind.radius_mm[outer]), reverse=True))
            rows.append((index, int(outer), kind.center_mm[outer], float(kind.radius_mm[outer]), ratios))
    target = np.array([row[0] for row in rows])
    local = np.array([row[2] for row in rows])
    # two marks are of one type only if their sizes agree too
    keys = [(round(row[3], 6), row[4]) for row in rows]
    types = sorted(set(keys))
    offset = bent_print_mm(local[:, None], pattern.curvature_per_mm[target])[:, 0]
    center = pattern.center_mm[target] + np.einsum("mij,mj->mi", pattern.axes[target], offset)
    return Marks(
        target=target,
        circle=np.array([row[1] for row in rows]),
        center_mm=center,
        normal=pattern.normal[target],
        radius_mm=np.array([row[3] for row in rows]),
        type_index=np.array([types.index(key) for key in keys]),
        type_ratios=tuple(ratios for _, ratios in types),
    )
