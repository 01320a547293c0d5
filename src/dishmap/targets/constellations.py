"""Local matches of detected circles with a pattern: which mark could one circle be, judged by its neighbours.

Seen along its own ray a small circle is an affine image of the printed one. Dividing by the ellipse turns its neighbourhood
back into the printed one, in units of the circle's radius, up to a turn; a mirror image would need a reflection, which
is never tried. So one pair of neighbours gives the turn, and the others vote.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.candidates import Candidates
from dishmap.targets.ellipses import invert_2x2, root_det
from dishmap.targets.layout import Layout

Array = NDArray[np.float64]
Complex = NDArray[np.complex64]
Index = NDArray[np.int64]

# Detected neighbours that vote, out of the nearest in the image; the nearest of them are tried as the one that gives the turn.
VOTERS = 12
NEAREST_IN_IMAGE = 24
ANCHORS = 3
# Room for errors of the ellipse (a part of the distance), of the circle's own centre (in radii), and of sizes.
DISTANCE_TOLERANCE = 0.15
CENTER_TOLERANCE = 0.35
SIZE_TOLERANCE = 0.3
FEWEST_VOTES, LEAST_VOTES = 3, 0.4
# The best of the hypotheses that agree about as well are kept.
KEPT_PER_SEED, MOST_SORTED = 400, 1200


@dataclass(frozen=True)
class Hypotheses:
    """H guesses of what one candidate is: mark (H,), turn_rad (H,) of the whitened neighbourhood, votes (H,), misfit (H,)."""

    seed: int
    mark: Index
    turn_rad: Array
    votes: Index
    misfit: Array


def neighbourhood(candidates: Candidates, seed: int, near: Index) -> Array:
    """Candidates `near` (N,) in the tangent plane of candidate `seed` (N, 2): tangents of angles off its ray."""
    along = candidates.ray[near] @ candidates.ray[seed]
    across = candidates.ray[near] @ candidates.tangent[seed]
    return np.where(along[:, None] > 0.1, across / np.maximum(along, 0.1)[:, None], np.nan)


def match_neighbourhood(candidates: Candidates, seed: int, near: Index, layout: Layout) -> Hypotheses:
    """Compare the neighbourhood of candidate `seed` with that of each mark.

    near: candidates close to the seed, without it. Returns the hypotheses with the most votes, best first.
    """
    q, near = _whitened(candidates, seed, near[candidates.is_type[near].any(axis=1)])
    none = Hypotheses(seed, np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64), np.zeros(0))
    if len(q) < FEWEST_VOTES - 1:
        return none
    size = root_det(candidates.shape[near]) / root_det(candidates.shape[seed])
    marks = np.flatnonzero(candidates.is_type[seed, layout.type_index])
    if not len(marks):
        return none
    neighbour = layout.neighbour[marks]
    printed = layout.offset_mm[marks] / layout.radius_mm[marks, None, None]
    # the pattern's y points up in the image of its front, the image's y down
    w = (printed[..., 0] - 1j * printed[..., 1]).astype(np.complex64)
    relative_size = layout.radius_mm[neighbour] / layout.radius_mm[marks, None]
    # (voter, mark, neighbour): could be the same circle by type and size
    fits = candidates.is_type[near][:, layout.type_index[neighbour]] & (neighbour >= 0)
    fits &= np.abs(np.log(size)[:, None, None] - np.log(relative_size)) < SIZE_TOLERANCE
    row, turn = _turns(q, w, fits)
    if not len(row):
        return none
    votes, misfit = _vote(q, w, fits, row, turn)
    good = np.flatnonzero(votes >= max(min(FEWEST_VOTES, len(q)), int(LEAST_VOTES * len(q))))
    order = good[np.lexsort((misfit[good], -votes[good]))][:MOST_SORTED]
    kept = order[_distinct(marks[row[order]], turn[order])][:KEPT_PER_SEED]
    return Hypotheses(seed, marks[row[kept]], np.angle(turn[kept]).astype(float), votes[kept], misfit[kept])


def _whitened(candidates: Candidates, seed: int, near: Index) -> tuple[Complex, Index]:
    """The nearest candidates in units of the seed's circle radius, as complex numbers, nearest first."""
    q = neighbourhood(candidates, seed, near) @ invert_2x2(candidates.shape[seed]).T
    z = (q[:, 0] + 1j * q[:, 1]).astype(np.complex64)
    order = np.argsort(np.abs(z))
    order = order[np.isfinite(z[order])][:VOTERS]
    return z[order], near[order]


def _turns(q: Complex, w: Complex, fits: NDArray[np.bool_]) -> tuple[Index, Complex]:
    """Turns (H,) as unit complex numbers, and the row of `w` each belongs to, that bring a neighbour onto an anchor."""
    rows, turns = [], []
    length = np.abs(w)
    for anchor in range(min(ANCHORS, len(q))):
        tolerance = _tolerance(np.abs(q[anchor : anchor + 1]))[0]
        row, column = np.nonzero(fits[anchor] & (np.abs(length - np.abs(q[anchor])) < tolerance))
        turn = q[anchor] / w[row, column]
        rows.append(row)
        turns.append(turn / np.abs(turn))
    return np.concatenate(rows), np.concatenate(turns)


def _tolerance(distance: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(DISTANCE_TOLERANCE * distance + CENTER_TOLERANCE, dtype=np.float32)


def _vote(q: Complex, w: Complex, fits: NDArray[np.bool_], row: Index, turn: Complex) -> tuple[Index, Array]:
    """Number of detected neighbours (H,) that find a printed one, and their mean squared misfit in tolerances (H,)."""
    votes, misfit = np.zeros(len(row), dtype=np.int64), np.zeros(len(row))
    # compare in the detected frame turned back, so that the table of printed neighbours is only looked up
    alive = np.arange(len(row))
    for k, (z, tolerance) in enumerate(zip(q, _tolerance(np.abs(q)), strict=True)):
        difference = w[row[alive]] - (z * np.conj(turn[alive]))[:, None]
        square = np.where(fits[k][row[alive]], difference.real**2 + difference.imag**2, np.inf).min(axis=1) / tolerance**2
        hit = square < 1
        votes[alive] += hit
        misfit[alive] += np.where(hit, square, 0.0)
        # the anchor and one more of the nearest four, and another one of the nearest six, must agree
        if k in (3, 5):
            alive = alive[votes[alive] >= FEWEST_VOTES - 1 + (k > 3)]
    return votes, misfit / np.maximum(votes, 1)


def _distinct(mark: Index, turn: Complex) -> Index:
    """Indices of the first of each group of equal marks and turns within ten degrees."""
    step = np.round(np.angle(turn) / np.radians(10.0)).astype(np.int64)
    _, first = np.unique(mark * 36 + step % 36, return_index=True)
    return np.sort(first)
