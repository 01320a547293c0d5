"""Find placements of a pattern among candidates: seeds, their constellations, growth; and further copies in what is left."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.camera.model import Camera
from dishmap.targets.beam import sort_out
from dishmap.targets.candidates import Candidates
from dishmap.targets.constellations import NEAREST_IN_IMAGE, Hypotheses, match_neighbourhood
from dishmap.targets.growth import Embedding, Scene, grow, is_clean
from dishmap.targets.layout import Layout
from dishmap.targets.markgrid import MarkGrid

Index = NDArray[np.int64]

# A mark is met within this part of the smallest spacing of marks.
MEETS = 0.25
# Seeds tried at most, and hypotheses grown.
MOST_SEEDS = 30
# Seeds looked at before any ambiguous one is grown; a clear one has a single hypothesis with so many votes.
FIRST_SEEDS, CLEAR_VOTES = 3, 6
# Hypotheses agree about as well as the best when their misfit is below this many times the best one plus this much.
CLEAR_MISFIT = (4.0, 0.002)
MOST_GROWN = 36
# A clean placement that takes in this part of all candidates, or of the pattern's marks, ends the search.
ENOUGH = 0.5
# A placement that is not clean may be a wrong one, bent to fit: it ends the search only when so many were found.
ENOUGH_BENT = 3
ABOUT_EQUAL = 3


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
            placement = grow(scene, start.pose, start.marks, start.candidates)
            grown += 1
            if placement is None:
                continue
            if best is None or worth(placement) > worth(best):
                best = placement
            large = placement.count >= ENOUGH * min(len(scene.candidates), len(scene.layout))
            enough += large
            if large and is_clean(scene.layout, placement):
                return best
        if grown >= MOST_GROWN or enough >= ENOUGH_BENT:
            break
    return best if best is not None and best.count >= least else None


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
        if number >= FIRST_SEEDS or (guesses.votes[0] >= CLEAR_VOTES and _equally_good(guesses) == 1):
            yield guesses
            continue
        first.append(guesses)
        if number == FIRST_SEEDS - 1:
            yield from sorted(first, key=_ambiguity)
            first = []
    yield from sorted(first, key=_ambiguity)


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
