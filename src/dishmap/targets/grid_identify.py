"""Name the nodes of a grid: which target of the pattern is which, and from where the camera looks.

A uniform grid looks the same after a shift or a quarter turn. Every way in which the nodes could lie on the pattern is looked at; ways
that put nodes beyond the pattern, or marks where it has none, are ruled out; of the others the hint must leave exactly one, else all are
listed and none is chosen. No shape is assumed: a flat pattern may be wrapped round anything, so a misfit of the rigid
pose rules a way out only on a surface that plainly has its nominal shape.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.camera.model import Camera
from dishmap.errors import IdentityError, InputError
from dishmap.targets.grid_detect import GridDetections
from dishmap.targets.grid_search import GridSearch
from dishmap.targets.grid_ways import Ways
from dishmap.targets.identify import (
    DECISIVE,
    GUESS_SHIFT_MM,
    GUESS_TURN_RAD,
    UPRIGHT_RAD,
    Alternative,
    Anchors,
    Hint,
    PoseGuess,
    Rejection,
    Upright,
)
from dishmap.targets.pattern import Pattern
from dishmap.targets.rigid import RigidFit
from dishmap.transforms import Pose

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# An anchor lies within this part of a step of its target; of a pose guess, the nearest way must be nearer by this much than the next.
HALF_STEP = 0.5
# Nodes about the one nearest to the camera that a pose guess is compared at.
GUESS_NODES = 9
LISTED_WAYS, ALTERNATIVES = 12, 3


@dataclass(frozen=True)
class GridIdentity:
    """A grid found in an image.

    camera_from_dish: robust rigid fit to nominal places (rough on bent surfaces); index (K,) into the pattern, rising; detection (K,) into
    the detections; residual_px (K,): distance from where the rigid pose puts the target; alternatives: next best ways that were ruled
    out, with the contradictions that each has more; rejected: detections that are not used, with reasons.
    """

    camera_from_dish: Pose
    index: Ints
    detection: Ints
    residual_px: Array
    alternatives: tuple[Alternative, ...]
    rejected: tuple[Rejection, ...]


def identify_grid(detections: GridDetections, pattern: Pattern, camera: Camera, hint: Hint = None) -> GridIdentity:
    """Find which target of a grid each detected node is.

    hint: None, Upright(), PoseGuess(camera_from_dish) or Anchors(ids, place_px). Raises InputError when the pattern is no grid or an
    anchor names no target of it, and IdentityError when the nodes do not fit the pattern, or do in more than one way that the hint does not
    tell apart; the message lists these ways.
    """
    if not pattern.is_grid:
        raise InputError(f"the pattern {pattern.name!r} is made of circles, not a grid; use identify for it")
    if detections.lines != bool(pattern.lines):
        raise InputError(f"the pattern {pattern.name!r} and the search must both be of lines or both of squares; search again")
    search = GridSearch(detections, pattern, camera)
    ways = search.ways
    left = ways.take(np.flatnonzero(ways.cost - ways.cost.min() < DECISIVE))
    left = search.fitting(left)
    chosen = _chosen(search, left, hint)
    fit = search.fit(left, chosen)
    if fit is None:
        raise IdentityError(f"the nodes fit the grid {pattern.name!r}, but in no pose of this camera; check that it is the camera's file")
    return _identity(search, left, chosen, fit)


def _identity(search: GridSearch, ways: Ways, chosen: int, fit: RigidFit) -> GridIdentity:
    """The record of the chosen way."""
    index = search.index(ways, chosen)
    parts = [(search.node[index >= 0], index[index >= 0])]
    rejected = [Rejection(int(i), "it lies in line with the grid, but beyond its border") for i in search.node[index < 0]]
    for component in range(1, int(search.found.component.max()) + 1):
        node = np.flatnonzero(search.found.component == component)
        joined = search.joined(component, fit.pose, *(np.concatenate(p) for p in zip(*parts, strict=True)))
        if joined is None:
            reason = "it belongs to a part of the grid that no prediction joins to the rest"
            rejected += [Rejection(int(i), reason) for i in node]
        else:
            parts.append((node[joined >= 0], joined[joined >= 0]))
            rejected += [Rejection(int(i), "it lies in line with the grid, but beyond its border") for i in node[joined < 0]]
    detection, target = (np.concatenate(p) for p in zip(*parts, strict=True))
    order = np.argsort(target)
    detection, target = detection[order], target[order]
    predicted = search.camera.project(fit.pose.apply(search.pattern.center_mm[target]))
    residual = np.linalg.norm(search.found.place_px[detection] - predicted, axis=1)
    return GridIdentity(fit.pose, target, detection, residual, _alternatives(search, ways, chosen), tuple(rejected))


def _alternatives(search: GridSearch, ways: Ways, chosen: int) -> tuple[Alternative, ...]:
    """The next best ways, by their contradictions."""
    mine = (ways.quarter[chosen], *ways.shift[chosen])
    every = search.ways
    order = np.argsort(every.cost, kind="stable")
    out = []
    for way in order[: ALTERNATIVES + 1]:
        if (every.quarter[way], *every.shift[way]) == mine:
            continue
        fit = search.fit(every, int(way))
        if fit is not None:
            out.append(Alternative(fit.pose, float(every.cost[way] - ways.cost[chosen])))
    return tuple(out[:ALTERNATIVES])


def _chosen(search: GridSearch, ways: Ways, hint: Hint) -> int:
    """The one way that the hint allows. Raises IdentityError for none or several."""
    allowed = np.arange(len(ways))
    if isinstance(hint, Anchors):
        allowed = _at_anchors(search, ways, hint)
    upright = hint.upright if isinstance(hint, Anchors) else hint if isinstance(hint, Upright) else None
    if upright is not None:
        rolls = search.rolls_rad(ways)
        kept = allowed[upright.off_rad(rolls[allowed]) < UPRIGHT_RAD]
        if not len(kept):
            raise IdentityError(
                f"the grid {search.pattern.name!r} was found, but not upright: {_listing(search, ways.take(allowed))}; correct the hint, "
                "or turn the photograph"
            )
        allowed = kept
    if isinstance(hint, PoseGuess):
        return _nearest(search, ways, hint)
    if len(allowed) > 1:
        raise _ambiguous(search, ways.take(allowed), hint)
    return int(allowed[0])


def _at_anchors(search: GridSearch, ways: Ways, hint: Anchors) -> Ints:
    """Ways that put each anchor's target within half a step of its place."""
    assert search.pattern.lattice is not None
    known = {int(i): k for k, i in enumerate(search.pattern.ids)}
    unknown = [i for i in hint.ids if i not in known]
    if unknown:
        raise InputError(f"the anchor {unknown[0]} is no target of {search.pattern.name!r}; its ids are {min(known)} to {max(known)}")
    at = search.lattice_at(hint.place_px)
    lost = np.flatnonzero(~np.isfinite(at).all(axis=1))
    if len(lost):
        u, v = hint.place_px[lost[0]]
        raise IdentityError(f"the anchor {hint.ids[lost[0]]} at ({u:.0f}, {v:.0f}) px lies off the nodes found; name one among them")
    wanted = search.pattern.lattice[[known[i] for i in hint.ids]]
    fits = np.array([(np.abs(ways.lattice(way, at) - wanted) < HALF_STEP).all() for way in range(len(ways))])
    if not fits.any():
        raise IdentityError(
            f"the grid {search.pattern.name!r} was found, but in no way that has all anchors within half a step of their places: "
            f"{_listing(search, ways)}; correct the anchors"
        )
    return np.flatnonzero(fits)


def _nearest(search: GridSearch, ways: Ways, hint: PoseGuess) -> int:
    """The way nearest to a pose guess, in the lattice about the place that the guess has nearest to the camera."""
    pattern, guess = search.pattern, hint.camera_from_dish
    assert pattern.lattice is not None
    in_camera = guess.apply(pattern.center_mm)
    at = search.lattice_at(search.camera.project(in_camera))
    known = np.flatnonzero(np.isfinite(at).all(axis=1))
    if not len(known):
        raise IdentityError(f"the grid {pattern.name!r} was found, but nowhere near where the pose guess has it; correct the guess")
    near = known[np.argsort(np.linalg.norm(in_camera[known], axis=1), kind="stable")[:GUESS_NODES]]
    pitch = float(np.median(cKDTree(pattern.center_mm).query(pattern.center_mm, k=2)[0][:, 1]))
    off = np.array([np.linalg.norm(np.median(ways.lattice(w, at[near]) - pattern.lattice[near], axis=0)) for w in range(len(ways))])
    for quarter in np.unique(ways.quarter):
        same = np.flatnonzero(ways.quarter == quarter)
        fit = search.fit(ways, int(same[np.argmin(off[same])]))
        if fit is None or (search.is_stiff(fit) and np.linalg.norm((fit.pose.inverse() @ guess).rotation_vector_rad) > GUESS_TURN_RAD):
            off[same] = np.inf
    off[off * pitch > GUESS_SHIFT_MM] = np.inf
    order = np.argsort(off, kind="stable")
    if not np.isfinite(off[order[0]]):
        raise IdentityError(
            f"the grid {pattern.name!r} was found, but not within {np.degrees(GUESS_TURN_RAD):.0f} degrees and {GUESS_SHIFT_MM:.0f} mm "
            f"of the pose guess: {_listing(search, ways)}; correct the guess"
        )
    if len(order) > 1 and off[order[1]] - off[order[0]] < HALF_STEP:
        raise _ambiguous(search, ways.take(order[off[order] - off[order[0]] < HALF_STEP]), hint)
    return int(order[0])


def _ambiguous(search: GridSearch, ways: Ways, hint: Hint) -> IdentityError:
    """Which ways remain, in words, and what would tell them apart."""
    quarters = np.unique(ways.quarter)
    halves = len(quarters) == 2 and quarters[1] - quarters[0] == 2
    turns = [] if len(quarters) == 1 else ["after half a turn" if halves else "after quarter turns"]
    shifts = ["when shifted"] if len(ways) > len(quarters) else []
    advice = {
        type(None): "give --upright, --anchor ID@U,V or a --pose-guess",
        Upright: "name a target in view with --anchor ID@U,V beside --upright",
        Anchors: "give --upright too, or a further --anchor ID@U,V",
        PoseGuess: "give a closer --pose-guess, or --anchor ID@U,V",
    }[type(hint)]
    same = " and ".join(turns + shifts)
    return IdentityError(
        f"the grid {search.pattern.name!r} could lie in {len(ways)} ways that the photograph does not tell apart, since it looks the same "
        f"{same}: {_listing(search, ways)}; {advice}, show its border, or print it with orientation marks"
    )


def _listing(search: GridSearch, ways: Ways) -> str:
    """Ways in words: the turn, and which columns and rows are in view."""
    # whole degrees, and no minus before a zero
    rolls = np.rint(np.degrees(search.rolls_rad(ways))) + 0.0
    texts = []
    for way in np.lexsort((ways.shift[:, 1], ways.shift[:, 0], rolls))[:LISTED_WAYS]:
        at = ways.lattice(int(way), search.lattice)
        (c0, r0), (c1, r1) = at.min(axis=0), at.max(axis=0)
        texts.append(f"turned by {rolls[way]:+.0f} degrees with columns {c0} to {c1} and rows {r0} to {r1} in view")
    more = f", and {len(ways) - LISTED_WAYS} more" if len(ways) > LISTED_WAYS else ""
    return "; ".join(texts) + more
