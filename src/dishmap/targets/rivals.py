"""Other placements of a pattern that the same detections allow: turns and shifts of the pattern onto itself.

If a placement explains what is seen and another one does too, then the motion between them carries the marks that were
seen onto marks that look the same. So the rivals of a placement are all rigid motions of the pattern that do so, found in
the pattern alone, without noise; no search in the image can miss one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.targets.ellipses import invert_2x2, root_det
from dishmap.targets.growth import Embedding, Scene, is_clean
from dishmap.targets.layout import Layout
from dishmap.targets.markgrid import meet_surface
from dishmap.transforms import Pose

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Index = NDArray[np.int64]

# Motions are made from this many anchors, marks far from each other, and each one's nearest matched neighbour, whose distance
# may differ by this part. A rival that matters leaves at most two observations over, so one anchor of three finds it.
ANCHORS = 3
PAIR_TOLERANCE = 0.15
# A motion is looked at in full when it explains enough of a sample of this many matches: for a clean placement, all but some;
# for another, which may owe matches to a bent surface, a small part.
SAMPLE = 64
FIRST_LOOK, FIRST_ROOM = 12, 0.1
MOST_MOTIONS = 250
LEAST_EXPLAINED, LEAST_EXPLAINED_ROUGH = 0.3, 0.15
LEFT_OVER_PART, LEFT_OVER = 0.1, 12
# A match within this part of its radius, or these px, of where its neighbours put it has the greater weight.
EXACT_RADIUS, EXACT_PX, EXACT_WEIGHT = 0.1, 0.7, 1.5
# Candidates within this many spacings of a predicted mark are placed by its local map.
LOCAL_SPACINGS = 2.5
# Sizes that differ by less than this (log) could be the same circle.
SAME_LOG_SIZE = 0.2


@dataclass(frozen=True)
class Observations:
    """What was seen, in the dish frame under one placement: candidate (n,), place_mm (n, 3), radius_mm (n,), matched mark or -1.

    The place of a matched candidate is its mark's printed place.
    """

    candidate: Index
    place_mm: Array
    radius_mm: Array
    mark: Index


@dataclass(frozen=True)
class Rivals:
    """Motions dish_from_dish (H) that carry the printed pattern to where it explains the observations; the first is none.

    rotation (H, 3, 3), shift_mm (H, 3); mark (H, n): mark that each observation is under it, -1 if none; cost (H,):
    observations left over, plus marks where something else is seen; misfit (H,): rms distance of carried marks in
    parts of the spacing.
    """

    rotation: Array
    shift_mm: Array
    mark: Index
    cost: Array
    misfit: Array

    def motion(self, h: int) -> Pose:
        """Motion h as a transform."""
        return Pose(self.rotation[h], self.shift_mm[h])


def observe(scene: Scene, placement: Embedding) -> Observations:
    """All candidates that look like a mark of the pattern in type and size, where the placement puts them on the surface."""
    layout, candidates = scene.layout, scene.candidates
    marks = np.flatnonzero(placement.candidate >= 0)
    used = placement.candidate[marks]
    rest = np.setdiff1d(np.flatnonzero(candidates.is_type.any(axis=1)), used)
    place, radius = _on_surface(scene, placement, rest)
    seen = np.isfinite(place).all(axis=1) & np.isfinite(radius)
    near = np.abs(np.log(np.where(seen, radius, 1.0))[:, None] - np.log(np.unique(layout.radius_mm))).min(axis=1) < SAME_LOG_SIZE
    rest, place, radius = rest[seen & near], place[seen & near], radius[seen & near]
    own = layout.radius_mm[marks] * np.exp(np.nan_to_num(placement.prediction.log_size[marks]))
    return Observations(
        np.concatenate([used, rest]),
        np.concatenate([layout.center_mm[marks], place]),
        np.concatenate([own, radius]),
        np.concatenate([marks, np.full(len(rest), -1)]),
    )


def _on_surface(scene: Scene, placement: Embedding, index: Index) -> tuple[Array, Array]:
    """Where candidates lie in the dish frame (n, 3), NaN if nowhere, and the printed radius (n,) they would have there.

    Near a mark that is predicted from its neighbours, by the map of its own plane, which a bent surface does not disturb;
    elsewhere where the ray meets the nominal surface.
    """
    layout, candidates, prediction = scene.layout, scene.candidates, placement.prediction
    dish_from_camera = placement.fit.pose.inverse()
    origin = dish_from_camera.translation_mm
    ray = dish_from_camera.rotate(candidates.ray[index])
    t = meet_surface(layout.surface, origin, ray)
    place = origin + t[:, None] * ray
    known = np.flatnonzero(prediction.known)
    log_ratio = np.full(len(index), np.median(prediction.log_ratio))
    with np.errstate(invalid="ignore", divide="ignore"):
        facing = np.abs((layout.surface.normal(place[:, :2]) * ray).sum(axis=1))
        # a small circle's image shrinks with distance, and with the root of its foreshortening in mean radius
        radius = root_det(candidates.shape[index]) * t / np.sqrt(facing)
    if len(known) and len(index):
        _, nearest = cKDTree(prediction.predicted_px[known]).query(candidates.center_px[index])
        mark = known[nearest]
        away = candidates.center_px[index] - prediction.predicted_px[mark]
        in_plane = (invert_2x2(prediction.affine[mark]) @ away[:, :, None])[..., 0]
        near = np.linalg.norm(in_plane, axis=1) < LOCAL_SPACINGS * layout.spacing_mm[mark]
        local = layout.center_mm[mark] + (layout.axes[mark][:, :, :2] @ in_plane[:, :, None])[..., 0]
        place = np.where(near[:, None], local, place)
        radius = np.where(near, candidates.size_px[index] / root_det(prediction.affine[mark]), radius)
        log_ratio = np.where(near, prediction.log_ratio[mark], log_ratio)
    return place, radius / np.exp(log_ratio)


Preference = Callable[[Array, Array], Flags]


def find_rivals(scene: Scene, placement: Embedding, seen: Observations, prefer: Preference) -> Rivals:
    """Motions of the pattern that explain the observations about as well as the placement does.

    prefer: says of motions (H, 3, 3) and (H, 3) which matter most; where there are very many, these are kept.
    """
    layout = scene.layout
    matched = np.flatnonzero(seen.mark >= 0)
    least = max(LEAST_EXPLAINED, 1 - LEFT_OVER_PART - LEFT_OVER / len(matched)) if is_clean(layout, placement) else LEAST_EXPLAINED_ROUGH
    rotations, shifts = [np.eye(3)[None]], [np.zeros((1, 3))]
    for anchor in _anchors(layout, seen.mark[matched]):
        rotation, shift = _motions(scene, placement, seen.place_mm[matched], int(anchor), least, prefer)
        rotations.append(rotation)
        shifts.append(shift)
    rotation, shift = np.concatenate(rotations), np.concatenate(shifts)
    moved = seen.place_mm @ np.swapaxes(rotation, 1, 2) + shift[:, None]
    met, mark = _marks_at(scene, seen, moved)
    # motions that give all observations the same marks are one; the first of each stays
    _, first = np.unique(((mark + 2) * np.sin(1.0 + np.arange(mark.shape[1]))).sum(axis=1).round(6), return_index=True)
    first = np.sort(first)
    rotation, shift, mark, met, moved = rotation[first], shift[first], mark[first], met[first], moved[first]
    hit = mark >= 0
    square = np.where(hit, ((moved - layout.center_mm[mark]) ** 2).sum(axis=2), 0.0)
    misfit = np.sqrt(square.sum(axis=1) / np.maximum(hit.sum(axis=1), 1)) / layout.spacing_mm.min()
    # an observation that is no mark counts, and more where a mark should be that looks different: a missing circle could be
    # dirt or blur, but one that is seen must have been printed
    clash = ~hit & (met >= 0)
    printed = clash & scene.candidates.has_more[seen.candidate, layout.type_index[met]]
    cost = (~hit * _weights(placement, layout, seen)).sum(axis=1) + clash.sum(axis=1) + printed.sum(axis=1)
    return Rivals(rotation, shift, mark, cost, misfit)


def _weights(placement: Embedding, layout: Layout, seen: Observations) -> Array:
    """Weight (n,) of each observation: more for matches so close to their place that no stray circle lies there by chance."""
    residual = np.where(seen.mark >= 0, placement.prediction.residual_mm[seen.mark], np.inf)
    scale = root_det(np.nan_to_num(placement.prediction.affine[seen.mark]))
    limit = np.maximum(EXACT_RADIUS * layout.radius_mm[seen.mark], EXACT_PX / np.maximum(scale, 1e-9))
    with np.errstate(invalid="ignore"):
        return np.where(residual < limit, EXACT_WEIGHT, 1.0)


def _anchors(layout: Layout, marks: Index) -> Index:
    """Some matched marks far from each other, one of the rarest type first."""
    types = np.bincount(layout.type_index)
    chosen = [int(marks[np.argmin(types[layout.type_index[marks]])])]
    distance = np.linalg.norm(layout.center_mm[marks] - layout.center_mm[chosen[0]], axis=1)
    while len(chosen) < min(ANCHORS, len(marks)):
        chosen.append(int(marks[np.argmax(distance)]))
        distance = np.minimum(distance, np.linalg.norm(layout.center_mm[marks] - layout.center_mm[chosen[-1]], axis=1))
    return np.array(chosen)


def _motions(scene: Scene, placement: Embedding, places: Array, anchor: int, least: float, prefer: Preference) -> tuple[Array, Array]:
    """Motions that carry one matched mark and a matched neighbour onto others that could look so, and explain a fair sample."""
    layout = scene.layout
    pairs = layout.neighbour[anchor]
    matched = np.flatnonzero((pairs >= 0) & (placement.candidate[pairs] >= 0))
    if not len(matched):
        return np.zeros((0, 3, 3)), np.zeros((0, 3))
    second = matched[0]
    arm = layout.offset_mm[anchor, second]
    length = float(np.linalg.norm(arm))
    looks = (scene.candidates.is_type | scene.candidates.may_be_type)[:, layout.type_index]
    like = looks[placement.candidate[pairs[second]]][layout.neighbour] & (layout.neighbour >= 0)
    like &= looks[placement.candidate[anchor]][:, None]
    with np.errstate(invalid="ignore"):
        like &= np.abs(np.hypot(layout.offset_mm[..., 0], layout.offset_mm[..., 1]) - length) <= PAIR_TOLERANCE * length
    mark, column = np.nonzero(like)
    there = layout.offset_mm[mark, column]
    turn = np.arctan2(there[:, 1], there[:, 0]) - np.arctan2(arm[1], arm[0])
    rotation = _turned_frames(layout.axes[mark], turn) @ layout.axes[anchor].T
    # a fair sample of what is seen, a part of it around the anchor
    order = np.argsort(np.linalg.norm(places - layout.center_mm[anchor], axis=1))
    sample = np.unique(np.concatenate([order[: SAMPLE // 4], order[:: 1 + len(order) // SAMPLE]]))
    shift = layout.center_mm[mark] - rotation @ layout.center_mm[anchor]
    # a few of the sample first, to be rid of most motions
    for chosen, least_part in ((sample[:: 1 + len(sample) // FIRST_LOOK], least - FIRST_ROOM), (sample, least)):
        part = (scene.grid.nearest(places[chosen] @ np.swapaxes(rotation, 1, 2) + shift[:, None]) >= 0).mean(axis=1)
        good = np.flatnonzero(part >= least_part)
        rotation, shift, part = rotation[good], shift[good], part[good]
    best = np.lexsort((-part, ~prefer(rotation, shift)))[:MOST_MOTIONS]
    return rotation[best], shift[best]


def _turned_frames(axes: Array, turn: Array) -> Array:
    c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
    return np.stack([c * axes[:, :, 0] + s * axes[:, :, 1], -s * axes[:, :, 0] + c * axes[:, :, 1], axes[:, :, 2]], axis=-1)


def _marks_at(scene: Scene, seen: Observations, places_mm: Array) -> tuple[Index, Index]:
    """The mark at each observation's place (H, n, 3), and the same where it looks like the observation; -1 if none."""
    met = scene.grid.nearest(places_mm)
    looks = scene.candidates.is_type | scene.candidates.may_be_type
    alike = looks[seen.candidate, scene.layout.type_index[met]]
    alike &= np.abs(np.log(seen.radius_mm / scene.layout.radius_mm[met])) < SAME_LOG_SIZE
    return met, np.where(alike, met, -1)
