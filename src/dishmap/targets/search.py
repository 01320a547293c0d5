"""Find placements of a pattern among candidates: seeds, their constellations, growth; and further copies in what is left."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.camera.model import Camera
from dishmap.targets.beam import sort_out
from dishmap.targets.candidates import Candidates
from dishmap.targets.constellations import NEAREST_IN_IMAGE, Hypotheses, match_neighbourhood
from dishmap.targets.ellipses import root_det
from dishmap.targets.growth import Embedding, Scene, grow, is_clean
from dishmap.targets.layout import Layout
from dishmap.targets.markgrid import MarkGrid

Index = NDArray[np.int64]

# A mark is met within this part of the smallest spacing of marks.
MEETS = 0.25
# Seeds tried at most, and hypotheses grown.
MOST_SEEDS = 30
# Seeds looked at before any ambiguous one is grown; a clear one has a single hypothesis with so many votes.
FIRST_SEEDS, CLEAR_VOTES = 2, 6
# Hypotheses that are looked at further: this many times as many as agree about equally well, and at least so many.
SORTED_PART, FEWEST_SORTED = 3, 24
# Hypotheses agree about as well as the best when their misfit is below this many times the best one plus this much.
CLEAR_MISFIT = (4.0, 0.002)
MOST_GROWN = 15
# A clean placement that takes in this part of all candidates, or of the pattern's marks, ends the search.
ENOUGH = 0.5
# A placement that is not clean may be a wrong one, bent to fit: it ends the search only when so many were found.
ENOUGH_BENT = 3
ABOUT_EQUAL = 3
# A start is grown when it explains this part of what is asked for, before any bending is allowed for.
RIGID_COUNT_PART = 0.4
# A first placement takes in at least this part of the targets that should be in view (its rivals may take in more), and
# it is no find when circles strewn at random would give one as good more often than this.
LEAST_FIRST_PART = 0.12
LARGEST_LOG10_CHANCE = -3.0
SMALLEST_REACH_PX, TURNS_TRIED = 0.5, 8


def scene_of(candidates: Candidates, layout: Layout, camera: Camera) -> Scene:
    """A scene to search in."""
    return Scene(candidates, cKDTree(candidates.center_px), layout, MarkGrid(layout, MEETS * float(layout.spacing_mm.min())), camera)


def rest_of(scene: Scene, placement: Embedding) -> Scene:
    """The scene without the candidates that a placement takes."""
    free = np.setdiff1d(np.arange(len(scene.candidates)), placement.candidate)
    candidates = scene.candidates.take(free)
    return replace(scene, candidates=candidates, tree=cKDTree(candidates.center_px))


def find_placement(scene: Scene, least: int) -> Embedding | None:
    """The placement of the pattern that takes in most candidates, None if fewer than `least`."""
    if scene.candidates.is_type.any(axis=1).sum() < least:
        return None
    best: Embedding | None = None
    grown, enough = 0, 0
    for guesses in _clearest_first(scene):
        for start in sort_out(scene, guesses):
            if start.count < RIGID_COUNT_PART * least:
                continue
            placement = grow(scene, start.pose, start.marks, start.candidates)
            grown += 1
            if placement is None or placement.count < least or not _is_credible(scene, placement):
                continue
            if best is None or worth(placement) > worth(best):
                best = placement
            large = placement.count >= ENOUGH * min(len(scene.candidates), len(scene.layout))
            enough += large
            if large and is_clean(scene.layout, placement):
                return best
        if grown >= MOST_GROWN or enough >= ENOUGH_BENT:
            break
    return best


def seen_targets(scene: Scene, placement: Embedding) -> tuple[int, int]:
    """Number of targets with a match, and of targets that should be in view."""
    found = placement.candidate >= 0
    expected = scene.camera.contains(placement.prediction.predicted_px) | found
    return len(np.unique(scene.layout.target[found])), len(np.unique(scene.layout.target[expected]))


def _is_credible(scene: Scene, placement: Embedding) -> bool:
    found, expected = seen_targets(scene, placement)
    return found >= LEAST_FIRST_PART * expected and log10_chance(scene, placement) <= LARGEST_LOG10_CHANCE


def log10_chance(scene: Scene, placement: Embedding) -> float:
    """Logarithm of the number of placements as good that circles strewn at random would give.

    Each mark in view finds one of N circles of density d within the largest residual r with probability p = pi r^2 d;
    three matches define the placement, and N circles times K marks times some turns are tried. d is the density of the
    circles that are no marks, in the image or around the pattern, whichever is greater.
    """
    marks = np.flatnonzero(placement.candidate >= 0)
    predicted = placement.prediction.predicted_px
    inside = scene.camera.contains(predicted)
    inside[marks] = True
    n, m = len(marks), int(inside.sum())
    low, high = predicted[inside].min(axis=0), predicted[inside].max(axis=0)
    usable = np.flatnonzero(scene.candidates.is_type.any(axis=1))
    center = scene.candidates.center_px[np.setdiff1d(usable, placement.candidate)]
    near = ((center >= low) & (center <= high)).all(axis=1).sum() / float(np.prod(np.maximum(high - low, 1.0)))
    density = max(near, (len(center) + 1) / (scene.camera.width_px * scene.camera.height_px))
    # the residual in px: that in mm times the scale of the map
    scale = root_det(placement.prediction.affine[marks])
    reach = max(float((np.nan_to_num(placement.prediction.residual_mm[marks]) * scale).max()), SMALLEST_REACH_PX)
    choices = (math.lgamma(m + 1) - math.lgamma(n + 1) - math.lgamma(m - n + 1)) / math.log(10)
    return math.log10(len(usable) * len(scene.layout) * TURNS_TRIED) + choices + (n - 3) * math.log10(min(0.5, np.pi * reach**2 * density))


def worth(placement: Embedding) -> tuple[int, float]:
    """Placements with more marks are better; among about equal numbers the one that needs less bending."""
    return placement.count // ABOUT_EQUAL, -placement.misfit_px


def _clearest_first(scene: Scene) -> Iterator[Hypotheses]:
    """Hypotheses of one seed after the other; of the first few seeds, the least ambiguous first."""
    first: list[Hypotheses] = []
    for number, seed in enumerate(_seeds(scene.candidates)):
        _, near = scene.tree.query(scene.candidates.center_px[seed], k=min(NEAREST_IN_IMAGE + 1, len(scene.candidates)))
        near = np.setdiff1d(near, seed, assume_unique=True)
        guesses = match_neighbourhood(scene.candidates, int(seed), near, scene.layout)
        if not len(guesses.mark):
            continue
        few = _clear_ones(guesses)
        if number >= FIRST_SEEDS or (guesses.votes[0] >= CLEAR_VOTES and _equally_good(guesses) == 1):
            yield few
            continue
        first.append(few)
        if number == FIRST_SEEDS - 1:
            yield from sorted(first, key=_ambiguity)
            first = []
    yield from sorted(first, key=_ambiguity)


def _clear_ones(guesses: Hypotheses) -> Hypotheses:
    """The hypotheses that agree best; more of them when many agree about equally well."""
    few = slice(0, max(SORTED_PART * _equally_good(guesses), FEWEST_SORTED))
    return Hypotheses(guesses.seed, guesses.mark[few], guesses.turn_rad[few], guesses.votes[few], guesses.misfit[few])


def _ambiguity(guesses: Hypotheses) -> tuple[int, int]:
    """Number of hypotheses that agree about equally well, after seeds with few votes."""
    return -int(guesses.votes[0]), _equally_good(guesses)


def _seeds(candidates: Candidates) -> Index:
    """Candidates to start from: the rarest types first, spread over the image."""
    types = candidates.is_type
    rarity = np.where(types, types.sum(axis=0), len(candidates) + 1).min(axis=1)
    usable = np.flatnonzero(types.any(axis=1))
    # a golden-ratio stride through the order of detection (top to bottom) spreads any number of seeds
    spread = (np.arange(len(usable)) * 0.618034) % 1.0
    coarse = np.ceil(np.log2(rarity[usable]))
    return np.asarray(usable[np.lexsort((spread, coarse))][:MOST_SEEDS])


def _equally_good(guesses: Hypotheses) -> int:
    """Number of hypotheses that agree about as well as the best."""
    good = (guesses.votes >= guesses.votes[0] - 1) & (guesses.misfit <= CLEAR_MISFIT[0] * guesses.misfit[0] + CLEAR_MISFIT[1])
    return int(good.sum())
