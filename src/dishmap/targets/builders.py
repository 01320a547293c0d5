"""Ready-made target kinds and patterns: plates and dishes, with or without orientation marks.

Every kind is a set of circles (`TargetKind`), so a kind that is not here needs no code: it is written into a pattern file.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve
from scipy.spatial import cKDTree

from dishmap.errors import PatternError
from dishmap.targets.pattern import Pattern, Surface, TargetKind
from dishmap.targets.symmetry import symmetry_poses

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Inner over outer diameter of the marker of the WhyCon localisation system (its default 50 mm in 122 mm).
WHYCON_RATIO = 50 / 122
# The paper's multi-circular target: four rings on a square.
MULTI_COUNT, MULTI_OUTER_MM, MULTI_INNER_MM, MULTI_SIDE_MM = 4, 5.0, 3.0, 14.0
# Above this many targets a pattern is a mistake in the units.
LARGEST_COUNT = 20000
# Orientation marks: every wrong turn or shift of the pattern that keeps two thirds of the targets on targets shows at least
# this many of them with the wrong look. A hidden target takes away two of these at most, so any two may be hidden.
WANTED_MISMATCHES = 6
SMALLEST_OVERLAP = 2 / 3
TRIALS_PER_COUNT = 40


def disc(radius_mm: float = 5.0) -> TargetKind:
    """A dark disc. Its size in an image cannot be told from ink spread, so alone it gives a weak depth."""
    return concentric((radius_mm,))


def ring(outer_radius_mm: float = MULTI_OUTER_MM, inner_radius_mm: float = MULTI_INNER_MM) -> TargetKind:
    """A dark ring."""
    return concentric((outer_radius_mm, inner_radius_mm))


def concentric(radii_mm: Sequence[float] = (10.0, 8.0, 6.0, 4.0)) -> TargetKind:
    """Circles about one centre, dark inside the largest and alternating inwards: two radii make a ring, four make two rings."""
    radii = np.sort(np.asarray(radii_mm, dtype=float).reshape(-1))[::-1]
    if not radii.size or (np.diff(radii) == 0).any():
        raise PatternError(f"concentric circles need one or more different radii in mm, not {list(radii_mm)}")
    return TargetKind(np.zeros((radii.size, 2)), radii, np.arange(radii.size) % 2 == 0)


def whycon(outer_radius_mm: float = 6.0, ratio: float = WHYCON_RATIO) -> TargetKind:
    """A dark disc with a light disc in its middle, of `ratio` times its radius, as the WhyCon system uses."""
    if not 0 < ratio < 1:
        raise PatternError(f"the inner disc of a WhyCon ring is smaller than the outer: its ratio lies between 0 and 1, not {ratio}")
    return concentric((outer_radius_mm, outer_radius_mm * ratio))


def multi_circular(
    count: int = MULTI_COUNT,
    outer_radius_mm: float = MULTI_OUTER_MM,
    inner_radius_mm: float = MULTI_INNER_MM,
    side_mm: float = MULTI_SIDE_MM,
) -> TargetKind:
    """A group of rings on the corners of a regular polygon with sides of `side_mm`: the paper's four on a square by default.

    An inner radius of 0 makes discs of the rings. Corners run counter-clockwise from the lower left.
    """
    if not 1 <= count <= 12:
        raise PatternError(f"a group of rings has 1 to 12 of them, not {count}")
    if not (np.isfinite(side_mm) and side_mm > 0):
        raise PatternError(f"the side of a group of rings must be a positive number of mm, not {side_mm}")
    angle = -np.pi / 2 - np.pi / count + 2 * np.pi * np.arange(count) / count
    around = 0.0 if count == 1 else side_mm / (2 * np.sin(np.pi / count))
    # rounded to a picometre, so that the corners of a square are written as such
    corner = np.round(around * np.stack([np.cos(angle), np.sin(angle)], axis=1), 9)
    if inner_radius_mm == 0:
        return TargetKind(corner, np.full(count, outer_radius_mm), np.ones(count, dtype=bool))
    radii = np.tile([outer_radius_mm, inner_radius_mm], count)
    return TargetKind(np.repeat(corner, 2, axis=0), radii, np.tile([True, False], count))


KIND_BUILDERS: dict[str, Callable[..., TargetKind]] = {
    "disc": disc,
    "ring": ring,
    "concentric": concentric,
    "multi": multi_circular,
    "whycon": whycon,
}


def odd_kind(kind: TargetKind) -> TargetKind:
    """The kind that stands out among targets of `kind`: the same outlines, with circles inside left out, or put in if there are none."""
    outer = kind.parent < 0
    if not outer.all():
        return TargetKind(kind.center_mm[outer], kind.radius_mm[outer], kind.dark[outer])
    radii = np.stack([kind.radius_mm, kind.radius_mm * WHYCON_RATIO], axis=1).ravel()
    return TargetKind(np.repeat(kind.center_mm, 2, axis=0), radii, np.tile([True, False], len(kind.radius_mm)))


def plate(
    rows: int,
    columns: int,
    pitch_mm: float,
    kind: TargetKind | None = None,
    kind_name: str = "multi4",
    orientation_marks: bool = False,
    name: str = "",
) -> Pattern:
    """A flat plate of targets on a square lattice about its middle; ids run row by row from the top left, y up.

    kind: by default the paper's four rings. orientation_marks: see `with_orientation_marks`.
    Raises PatternError for impossible sizes, targets that overlap, and when no marks can break the symmetry.
    """
    check_counts(rows=rows, columns=columns)
    check_lengths(pitch_mm=pitch_mm)
    kind = kind or multi_circular()
    row, column = np.divmod(np.arange(rows * columns), columns)
    xy = pitch_mm * np.stack([column - (columns - 1) / 2, (rows - 1) / 2 - row], axis=1)
    center = np.column_stack([xy, np.zeros(len(xy))])
    up, along = np.tile([0.0, 0.0, 1.0], (len(xy), 1)), np.tile([1.0, 0.0, 0.0], (len(xy), 1))
    pattern = _pattern(name or f"plate-{rows}x{columns}", Surface(), kind, kind_name, center, along, up)
    _check_gaps(pattern, f"a pitch of {pitch_mm:g} mm")
    return with_orientation_marks(pattern, kind_name, _lattice_moves(rows, columns)) if orientation_marks else pattern


def dish(
    diameter_mm: float,
    focal_length_mm: float,
    spacing_mm: float = 45.0,
    kind: TargetKind | None = None,
    kind_name: str = "multi4",
    orientation_marks: bool = False,
    margin_mm: float | None = None,
    center_target: bool = True,
    name: str = "",
) -> Pattern:
    """A paraboloid with targets on concentric circles, `spacing_mm` apart in radius and at least so far along each circle.

    The outermost circle keeps `margin_mm` from the rim (default: the target's own radius). Every second circle is turned by
    half a step. x_axis points outwards along the surface. Distances are those seen along the boresight. ids run from the middle
    outwards, counter-clockwise from the x axis. Raises PatternError as `plate` does.
    """
    check_lengths(diameter_mm=diameter_mm, focal_length_mm=focal_length_mm, spacing_mm=spacing_mm)
    kind = kind or multi_circular()
    surface = Surface("paraboloid", diameter_mm, focal_length_mm)
    room = diameter_mm / 2 - (kind.extent_mm if margin_mm is None else margin_mm)
    circles = int(np.floor(room / spacing_mm + 1e-9)) if room >= 0 else -1
    if circles < (0 if center_target else 1):
        raise PatternError(
            f"no target of radius {kind.extent_mm:.4g} mm fits on a dish of {diameter_mm:g} mm at a spacing of {spacing_mm:g} mm"
        )
    counts = [1] * center_target + [int(np.floor(2 * np.pi * i + 1e-9)) for i in range(1, circles + 1)]
    check_counts(targets=sum(counts))
    numbers = np.arange(len(counts)) + (not center_target)
    angle = np.concatenate([2 * np.pi * (np.arange(n) + 0.5 * (i > 0 and i % 2 == 0)) / n for i, n in zip(numbers, counts, strict=True)])
    radius = spacing_mm * np.repeat(numbers, counts).astype(float)
    xy = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    slope = radius / (2 * focal_length_mm)
    x_axis = np.column_stack([np.cos(angle), np.sin(angle), slope]) / np.hypot(1, slope)[:, None]
    center = np.column_stack([xy, surface.height_mm(xy)])
    pattern = _pattern(name or f"dish-{diameter_mm:g}", surface, kind, kind_name, center, x_axis, surface.normal(xy))
    _check_gaps(pattern, f"a spacing of {spacing_mm:g} mm")
    return with_orientation_marks(pattern, kind_name, _circle_moves(counts)) if orientation_marks else pattern


Moves = Callable[[Flags], int]


def with_orientation_marks(pattern: Pattern, kind_name: str, moves: Moves) -> Pattern:
    """Give a few targets of one kind a look of their own (`odd_kind`), so that no turn or shift maps the pattern onto itself.

    moves(odd) gives the number of targets that would show the wrong look under the most similar wrong turn or shift. The
    first of a fixed series of scattered places that reaches WANTED_MISMATCHES is taken, few odd targets first. They
    stay targets like the others, with outlines of the same size. Raises PatternError when the pattern is too small for it.
    """
    n = len(pattern)
    best, best_score = np.zeros(n, dtype=bool), 0
    # a fixed seed: the same call always prints the same pattern
    rng = np.random.default_rng(20180917)
    for trial in range(TRIALS_PER_COUNT * max(1, n // 2)):
        count = min(max(3, n // 24) + trial // TRIALS_PER_COUNT, n // 2)
        odd = np.isin(np.arange(n), rng.permutation(n)[:count])
        score = moves(odd)
        if score > best_score:
            best, best_score = odd, score
        if best_score >= WANTED_MISMATCHES:
            break
    odd_name = f"{kind_name}-odd"
    kinds = {**pattern.kinds, odd_name: odd_kind(pattern.kinds[kind_name])}
    names = tuple(odd_name if odd else kind for odd, kind in zip(best, pattern.kind_names, strict=True))
    marked = Pattern(pattern.name, pattern.surface, kinds, pattern.ids, names, pattern.center_mm, pattern.x_axis, pattern.normal)
    if not best.any() or symmetry_poses(marked):
        raise PatternError(f"{n} targets are too few for orientation marks; print more targets, or give a pose guess when mapping")
    return marked


def _lattice_moves(rows: int, columns: int) -> Moves:
    """Count wrong looks on a whole lattice by `lattice_mismatches`."""
    whole = np.ones((rows, columns), dtype=bool)
    return lambda odd: lattice_mismatches(odd.reshape(rows, columns), whole, SMALLEST_OVERLAP)


def lattice_mismatches(odd: Flags, present: Flags, smallest_overlap: float) -> int:
    """Count the wrong looks under the most similar wrong turn by quarters and shift of a lattice.

    odd and present (R, C): which places have the odd look, and which exist at all; only moves that keep this part of the places on places
    count. Gives the number of places when there is no such move.
    """
    grid, ones = (odd & present).astype(float), present.astype(float)
    count = score = int(present.sum())
    for quarter in range(4):
        turned, whole = np.rot90(grid, quarter), np.rot90(ones, quarter)
        # correlations over all shifts: targets on targets, odd ones there from either side, odd ones on odd ones
        overlap, here, there, both = (np.round(_correlate(a, b)) for a, b in ((ones, whole), (grid, whole), (ones, turned), (grid, turned)))
        wrong = here + there - 2 * both
        if quarter == 0:
            wrong[odd.shape[0] - 1, odd.shape[1] - 1] = count
        score = min(score, int(wrong[overlap >= max(1.0, smallest_overlap * count)].min(initial=count)))
    return score


def _correlate(a: Array, b: Array) -> Array:
    return np.asarray(fftconvolve(a, b[::-1, ::-1]))


def _circle_moves(counts: Sequence[int]) -> Moves:
    """Count, for concentric circles, the wrong looks and missing partners under the most similar turn."""
    start = np.cumsum([0, *counts])

    def fewest(odd: Flags) -> int:
        turns = {(k, n) for n in counts for k in range(1, n)}
        wrong: dict[float, int] = {}
        rings = [odd[a:b] for a, b in itertools.pairwise(start)]
        agreeing = [np.array([(ring != np.roll(ring, k)).sum() for k in range(len(ring))]) for ring in rings]
        for k, n in turns:
            part = round(k / n, 12)
            if part not in wrong:
                wrong[part] = sum(int(a[k * len(a) // n]) if k * len(a) % n == 0 else len(a) for a in agreeing)
        return min(wrong.values(), default=0)

    return fewest


def _pattern(name: str, surface: Surface, kind: TargetKind, kind_name: str, center: Array, x_axis: Array, normal: Array) -> Pattern:
    n = len(center)
    return Pattern(name, surface, {kind_name: kind}, np.arange(n), (kind_name,) * n, center, x_axis, normal)


def _check_gaps(pattern: Pattern, what: str) -> None:
    """Raise PatternError when circles of two targets touch."""
    marks = pattern.marks
    i, j = cKDTree(marks.center_mm).query_pairs(2 * float(marks.radius_mm.max()), output_type="ndarray").T
    gap = np.linalg.norm(marks.center_mm[i] - marks.center_mm[j], axis=1) - marks.radius_mm[i] - marks.radius_mm[j]
    touching = (gap <= 0) & (marks.target[i] != marks.target[j])
    if touching.any():
        first, second = min(
            tuple(sorted(pair)) for pair in zip(marks.target[i[touching]].tolist(), marks.target[j[touching]].tolist(), strict=True)
        )
        extent = max(kind.extent_mm for kind in pattern.kinds.values())
        raise PatternError(f"{what} is too small: targets {first} and {second} touch; their radius is {extent:.4g} mm")


def check_lengths(**lengths: float) -> None:
    """Raise PatternError for a length, by its name, that is not a positive number."""
    for name, value in lengths.items():
        if not (np.isfinite(value) and value > 0):
            raise PatternError(f"{name} must be a positive number, not {value}")


def check_counts(**counts: int) -> None:
    """Raise PatternError for a count, by its name, below 1, or when their product is more than any pattern has."""
    for name, value in counts.items():
        if value < 1:
            raise PatternError(f"{name} must be 1 or more, not {value}")
    if np.prod([float(value) for value in counts.values()]) > LARGEST_COUNT:
        raise PatternError(f"{' x '.join(f'{name} {value}' for name, value in counts.items())} is more than {LARGEST_COUNT} targets")
