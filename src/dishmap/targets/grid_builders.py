"""Ready-made grids: crossings of lines or separate squares on plates, dishes and cylinders, with or without orientation marks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import PatternError
from dishmap.targets.builders import WANTED_MISMATCHES, check_counts, check_lengths, lattice_mismatches
from dishmap.targets.flat import from_flat_mm, meridian_mm
from dishmap.targets.pattern import GridLine, Pattern, Polygon, Surface, TargetKind

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Index = NDArray[np.int64]

# An open square's light middle, and the square in a marked cell, as parts of the square's side and of the pitch.
OPEN_PART = 0.5
MARK_PART = 0.5
# Lines that take more of the pitch leave no room for the mark in a cell; squares that do leave no ground between them.
WIDEST_PART = 0.4
LARGEST_SQUARE_PART = 0.9
# Marks tell two answers apart that have this part of the grid in common.
SMALLEST_OVERLAP = 1 / 3
# One place in so many is marked at least: a view of six by six shows three.
PLACES_PER_MARK = 12
TRIALS_PER_COUNT = 20
# Around a cylinder nothing is printed beyond this part of the half that faces the camera.
LARGEST_TURN = 0.95 * np.pi / 2
# Surfaces of grids by name, and the sizes that each has.
SURFACE_NAMES: dict[str, tuple[str, ...]] = {"plane": (), "dish": ("diameter_mm", "focal_length_mm"), "cylinder": ("cylinder_radius_mm",)}
# Half of this step of the lattice gives the direction of a column.
AXIS_STEP = 1e-3


def crossing() -> TargetKind:
    """Two lines that cross: no ink of its own."""
    return TargetKind(np.zeros((0, 2)), np.zeros(0), np.zeros(0, dtype=bool))


def marked_crossing(pitch_mm: float) -> TargetKind:
    """A crossing with a dark square of half the pitch in the middle of the cell to its upper right."""
    return _of_polygons((_square(MARK_PART * pitch_mm, pitch_mm / 2),))


def square(side_mm: float) -> TargetKind:
    """A dark square."""
    return _of_polygons((_square(side_mm),))


def open_square(side_mm: float) -> TargetKind:
    """A dark square with a light square of half its side in its middle."""
    return _of_polygons((_square(side_mm), _square(OPEN_PART * side_mm, dark=False)))


def grid_surface(
    kind: str = "plane", diameter_mm: float | None = None, focal_length_mm: float | None = None, cylinder_radius_mm: float | None = None
) -> Surface:
    """The surface of a grid by one of SURFACE_NAMES and its sizes.

    Raises PatternError when a size is lacking or belongs to another surface.
    """
    if kind not in SURFACE_NAMES:
        raise PatternError(f"unknown surface {kind!r}; use one of {', '.join(SURFACE_NAMES)}")
    given = {"diameter_mm": diameter_mm, "focal_length_mm": focal_length_mm, "cylinder_radius_mm": cylinder_radius_mm}
    needs = SURFACE_NAMES[kind]
    for name, value in given.items():
        if value is None and name in needs:
            raise PatternError(f"the surface {kind!r} needs {name}")
        if value is not None and name not in needs:
            raise PatternError(f"{name} is no size of the surface {kind!r}; it takes {' and '.join(needs) or 'none'}")
    if kind == "dish":
        return Surface("paraboloid", diameter_mm, focal_length_mm)
    return Surface(kind, radius_mm=cylinder_radius_mm)


def grid(
    columns: int,
    rows: int,
    pitch_mm: float,
    line_width_mm: float | None = None,
    square_mm: float | None = None,
    surface: Surface | None = None,
    orientation_marks: bool = False,
    name: str = "",
) -> Pattern:
    """A grid of lines of `line_width_mm`, or of separate squares with sides of `square_mm`, about the surface's vertex.

    Distances are those along the surface. On a cylinder (axis along y) all of them are true; on a dish those from the vertex along the
    meridians: place (i, j) from the middle lies at pitch hypot(i, j) in the direction atan2(j, i). Places whose ink would reach over a
    dish's rim are left out. Lines go on by half a pitch beyond their last crossings. Places are (column, row), column 0 at the left and
    row 0 at the bottom; ids run row by row from the top left. x_axis points along the columns' direction.

    orientation_marks: a few squares are open, or a few cells between lines hold a square, so that no quarter turn and no shift that
    keeps a third of the grid on itself looks alike. Raises PatternError for impossible sizes, and when the grid is too small for marks.
    """
    check_counts(columns=columns, rows=rows)
    if (line_width_mm is None) == (square_mm is None):
        raise PatternError("a grid is made of lines or of squares: give line_width_mm or square_mm, and not both")
    check_lengths(pitch_mm=pitch_mm, **({"square_mm": square_mm} if square_mm is not None else {"line_width_mm": line_width_mm or 0.0}))
    surface = surface or Surface()
    half_ink = _half_ink_mm(pitch_mm, line_width_mm, square_mm)
    place = _kept_places(columns, rows, pitch_mm, surface, half_ink, 2 if line_width_mm is not None else 1)
    center, x_axis, normal = _frames(surface, pitch_mm, place - 0.5 * np.array([columns - 1, rows - 1]))
    ids = np.arange(len(place))
    if line_width_mm is not None:
        kinds = {"crossing": crossing(), "crossing-marked": marked_crossing(pitch_mm)}
        lines = _lines(place, line_width_mm, pitch_mm / 2)
    else:
        kinds, lines = {"square": square(square_mm or 0.0), "square-open": open_square(square_mm or 0.0)}, ()
    plain, odd = kinds
    names = [plain] * len(place)
    if orientation_marks:
        marked = _marked(place, columns, rows, cells=line_width_mm is not None)
        names = [odd if mark else plain for mark in marked]
    kinds = {kind: kinds[kind] for kind in dict.fromkeys(sorted(names))}
    ink = "lines" if line_width_mm is not None else "squares"
    return Pattern(name or f"grid-{ink}-{columns}x{rows}", surface, kinds, ids, tuple(names), center, x_axis, normal, place, lines)


def _half_ink_mm(pitch_mm: float, line_width_mm: float | None, square_mm: float | None) -> float:
    """How far a place's own ink reaches from it along the lattice."""
    if line_width_mm is not None:
        if line_width_mm > WIDEST_PART * pitch_mm:
            raise PatternError(f"lines of {line_width_mm:g} mm are too wide for a pitch of {pitch_mm:g} mm; up to 0.4 of it is possible")
        return pitch_mm / 2
    assert square_mm is not None
    if square_mm > LARGEST_SQUARE_PART * pitch_mm:
        raise PatternError(f"squares of {square_mm:g} mm nearly touch at a pitch of {pitch_mm:g} mm; up to 0.9 of it is possible")
    return square_mm / 2


def _kept_places(columns: int, rows: int, pitch_mm: float, surface: Surface, half_ink_mm: float, least: int) -> Index:
    """Places (N, 2) (column, row) that fit on the surface, row by row from the top left; `least` of them in every row and column."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    place = np.stack([column, rows - 1 - row], axis=1)
    if surface.kind == "cylinder" and surface.radius_mm is not None:
        half = (columns - 1) / 2 * pitch_mm + half_ink_mm
        if half > LARGEST_TURN * abs(surface.radius_mm):
            most = int(2 * (LARGEST_TURN * abs(surface.radius_mm) - half_ink_mm) / pitch_mm) + 1
            raise PatternError(
                f"{columns} columns at {pitch_mm:g} mm do not fit on the half of a cylinder of radius {abs(surface.radius_mm):g} mm "
                f"that faces the camera; {max(most, 0)} do"
            )
    if surface.diameter_mm is not None:
        reach = np.abs(place - 0.5 * np.array([columns - 1, rows - 1])) * pitch_mm
        # the far corner of a square, or the end of a line
        far = np.hypot(*(reach + half_ink_mm).T) if least == 1 else np.hypot(reach.max(axis=1) + half_ink_mm, reach.min(axis=1))
        rim = np.array(surface.diameter_mm / 2)
        place = place[far <= (rim if surface.focal_length_mm is None else meridian_mm(rim, surface.focal_length_mm))]
    # a line needs two targets
    while len(place):
        few = [np.bincount(place[:, k])[place[:, k]] < least for k in (0, 1)]
        if not (few[0] | few[1]).any():
            break
        place = place[~(few[0] | few[1])]
    if not len(place):
        raise PatternError(f"no grid of {columns} x {rows} places at a pitch of {pitch_mm:g} mm fits on this surface; take a smaller pitch")
    return place


def _frames(surface: Surface, pitch_mm: float, steps: Array) -> tuple[Array, Array, Array]:
    """Centres, x axes and normals (N, 3) of places so many steps (N, 2) of the lattice from the vertex."""
    ahead, behind, here = (_on_surface(surface, pitch_mm * (steps + d * np.array([AXIS_STEP, 0.0]))) for d in (1, -1, 0))
    normal = surface.normal(here[:, :2])
    along = ahead - behind
    along -= (along * normal).sum(axis=1, keepdims=True) * normal
    return here, along / np.linalg.norm(along, axis=1, keepdims=True), normal


def _on_surface(surface: Surface, flat: Array) -> Array:
    xy = from_flat_mm(surface, flat)
    return np.column_stack([xy, surface.height_mm(xy)])


def _lines(place: Index, width_mm: float, overhang_mm: float) -> tuple[GridLine, ...]:
    """Lines along the rows from left to right, from the top one, then those along the columns upwards, from the left one."""
    lines = []
    for axis, order in ((1, -1), (0, 1)):
        for number in np.unique(place[:, axis])[::order]:
            on = np.flatnonzero(place[:, axis] == number)
            lines.append(GridLine(tuple(on[np.argsort(place[on, 1 - axis])].tolist()), width_mm, overhang_mm))
    return tuple(lines)


def _marked(place: Index, columns: int, rows: int, cells: bool) -> Flags:
    """Which places (N,) carry an orientation mark: scattered evenly, and such that wrong turns and shifts show.

    cells: marks stand in the cells to the upper right, and only in those with all four corners.
    """
    present = np.zeros((columns, rows), dtype=bool)
    present[tuple(place.T)] = True
    if cells:
        present = present[:-1, :-1] & present[1:, :-1] & present[:-1, 1:] & present[1:, 1:]
    free = np.argwhere(present)
    best, best_score = np.zeros_like(present), 0
    # a fixed seed: the same call always prints the same grid
    rng = np.random.default_rng(20180917)
    least = max(3, len(free) // PLACES_PER_MARK)
    for trial in range(TRIALS_PER_COUNT * max(1, len(free) // 2 - least + 1)):
        odd = _scattered(free, least + trial // TRIALS_PER_COUNT, present, rng)
        score = lattice_mismatches(odd, present, SMALLEST_OVERLAP)
        if score > best_score:
            best, best_score = odd, score
        if best_score >= WANTED_MISMATCHES:
            break
    if best_score == 0:
        raise PatternError(f"{len(place)} places are too few for orientation marks; print a larger grid, or give a pose guess when mapping")
    marked = np.zeros((columns, rows), dtype=bool)
    marked[: best.shape[0], : best.shape[1]] = best
    return np.asarray(marked[tuple(place.T)])


def _scattered(free: Index, count: int, present: Flags, rng: np.random.Generator) -> Flags:
    """About `count` of the free places (K, 2), one drawn from each of as many square blocks of the lattice."""
    odd = np.zeros_like(present)
    if count and len(free):
        side = np.sqrt(len(free) / count)
        block = np.floor(free / side + rng.uniform(size=2)).astype(np.int64)
        mixed = rng.permutation(len(free))
        _, first = np.unique(block[mixed], axis=0, return_index=True)
        odd[tuple(free[mixed[first]].T)] = True
    return odd


def _square(side_mm: float, middle_mm: float = 0.0, dark: bool = True) -> Polygon:
    return Polygon(middle_mm + side_mm / 2 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]), dark)


def _of_polygons(polygons: tuple[Polygon, ...]) -> TargetKind:
    return TargetKind(np.zeros((0, 2)), np.zeros(0), np.zeros(0, dtype=bool), polygons)
