"""The stages of the measurement of a grid: a coarse fit to every fourth pixel, what all nodes say of the photograph, the full fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.targets.grid_arms import arms_there, clear_of_ends, without_arms
from dishmap.targets.grid_fit import (
    BEND,
    BLUR,
    HALF,
    HELD,
    INNER,
    LIGHT,
    NESTED,
    OFFSET,
    PLAIN,
    SLOPE,
    NodeFit,
    NodePriors,
    Weights,
    levels_at,
    one_step,
)
from dishmap.targets.grid_pixels import NodePixels, node_pixels
from dishmap.targets.grid_shapes import NodeShapes
from dishmap.targets.lattice_map import LatticeMaps
from dishmap.targets.scene_noise import NoiseModel, inflation_of, noise_model
from dishmap.targets.solve import inverse_each, solve_scaled
from dishmap.targets.stages import OBSTACLE_BLURS, OCCLUDED_BELOW

Array = NDArray[Any]
Bool = NDArray[Any]
Index = NDArray[np.int64]

# Nodes whose pixels together stay in the processor's cache.
COARSE_AT_ONCE, FULL_AT_ONCE = 160, 48
NOISE_CHUNKS = 8
# Nodes that lie closer have too few pixels to leave any out, or more than three of four; so have thin lines.
COARSE_STEPS_PX, THIN_PX = (16.0, 26.0), (1.6, 2.2)
# Edges are felt this far, in blurs and px; what is looked at before the blur is known.
REACH_BLURS, REACH_EXTRA_PX = 2.5, 0.5
FIRST_BLUR_PX, FIRST_REACH_PX = 1.2, 3.5
FIRST_LOG_BLUR, FIRST_LOG_HALF = 0.7, 0.3
# What one node may differ from the photograph's usual blur and width at least, as a share.
LEAST_LOG_BLUR, LEAST_LOG_HALF = 0.1, 0.1
# Slope and bend of the level line of each band.
LINE = (np.array([SLOPE.start, BEND.start]), np.array([SLOPE.start + 1, BEND.start + 1]))
# A pixel of less weight is lost to what is in front.
LOST_BELOW = 0.5
# A rectangle's own turn and shear, in radians or so.
FREE_SLOPE = 0.2
COARSE_STEPS, FULL_STEPS, FREE_STEPS, COARSE_ENOUGH = 7, 6, 2, 0.9
FIRST_INK_SHARE = 0.2
# Widths over the printed ones that are tried, at so many nodes.
GUESS_RATIOS, GUESS_NODES = np.geomspace(0.6, 1.5, 10), 32
CUT = (8.0, 0.1)
ROBUST_TO_SIGMA = 1.4826
# A node that moves farther, in lattice units, went astray.
FARTHEST_MOVE = 0.2


@dataclass(frozen=True)
class Learnt:
    """What all nodes share: usual blur and its spread (log), half widths over the printed ones and their spread (log), noise."""

    blur_px: float
    log_blur: float
    half_ratio: Array
    log_half: float
    noise: NoiseModel

    @property
    def reach_px(self) -> float:
        """How far from an edge pixels are looked at."""
        return REACH_BLURS * self.blur_px + REACH_EXTRA_PX


@dataclass(frozen=True)
class Stage:
    """All nodes after a stage.

    x (N, G), ink_share (N,), light (N, LIGHT), normal (N, G + LIGHT, G + LIGHT), prior (N, G, G), mean (N, G), converged, weight, square,
    kept, whole (N,): as in NodeFit; there (N, 2, 2): arms; saturated (N,): share of pixels; brighter (N,): what differs from the model
    most is brighter.
    """

    x: Array
    ink_share: Array
    light: Array
    normal: Array
    prior: Array
    mean: Array
    there: Bool
    converged: Bool
    weight: Array
    square: Array
    kept: Array
    whole: Array
    saturated: Array
    brighter: Bool

    def take(self, rows: Any) -> Stage:
        """Some nodes of the stage."""
        return Stage(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def chunks(maps: LatticeMaps, at_once: int) -> list[Index]:
    """Rows of nodes to be worked on together: those of like size in the image, so that padding wastes little."""
    order = np.argsort(np.linalg.norm(maps.step_px, axis=(1, 2)))
    count = max(1, -(-len(order) // at_once))
    return np.array_split(order, count)


def priors_of(maps: LatticeMaps, shapes: NodeShapes, learnt: Learnt, held: bool = False) -> NodePriors:
    """Priors of n nodes: lines as their neighbours say, widths and blur as all nodes say; held: lines run exactly as neighbours say."""
    count, size = len(shapes.half), NESTED if shapes.inner.any() else HELD if held and shapes.crossing else PLAIN
    mean, precision = np.zeros((count, size)), np.zeros((count, size, size))
    mean[:, HALF], mean[:, BLUR] = shapes.half * learnt.half_ratio, learnt.blur_px
    diagonal = np.full((count, size), 1e-9)
    diagonal[:, HALF] = (learnt.log_half * mean[:, HALF]) ** -2.0
    diagonal[:, BLUR] = (learnt.log_blur * learnt.blur_px) ** -2.0
    if size == NESTED:
        mean[:, INNER] = shapes.inner
        diagonal[:, INNER] = (FIRST_LOG_HALF * np.where(shapes.inner > 0, shapes.inner, 1.0)) ** -2.0
    precision[:, range(size), range(size)] = diagonal
    if size == HELD:
        return NodePriors(mean, precision)
    along = maps.along.copy()
    if not shapes.crossing:
        along[:, :, 0] = along[:, :, :, 0] = 0.0
        along[:, :, 0, 0] = FREE_SLOPE**2
    known = inverse_each(along + 1e-14 * np.eye(2))
    for k in (0, 1):
        precision[:, LINE[k][:, None], LINE[k]] = known[:, k]
    return NodePriors(mean, precision)


def with_lines(stage: Stage, shapes: NodeShapes, mean: Array, covariance: Array) -> Stage:
    """A stage as it would have been with other knowledge of slope and bend (`lines_by`), from its normal equations alone."""
    size = stage.x.shape[1]
    prior, pull = stage.prior.copy(), (stage.prior @ (stage.x - stage.mean)[..., None])[..., 0]
    new_mean = stage.mean.copy()
    for k in (0, 1):
        part = BEND.start + k if not shapes.crossing else LINE[k]
        rows = np.atleast_1d(part)
        pick = [1] if not shapes.crossing else [0, 1]
        prior[:, rows[:, None], rows] = inverse_each(covariance[:, k][:, pick][:, :, pick] + 1e-14 * np.eye(len(rows)))
        new_mean[:, rows] = mean[:, k][:, pick]
    normal = stage.normal.copy()
    normal[:, :size, :size] += prior
    right = np.zeros((len(stage.x), size + LIGHT))
    right[:, :size] = pull - (prior @ (stage.x - new_mean)[..., None])[..., 0]
    return replace(stage, x=stage.x + solve_scaled(normal, right)[:, :size], prior=prior, mean=new_mean)


def _start(priors: NodePriors) -> Array:
    x = priors.mean.copy()
    x[:, [OFFSET.start, OFFSET.start + 1]] = 0.0
    return x


def coarse_stage(image: NDArray[Any], maps: LatticeMaps, shapes: NodeShapes, first: Learnt, reach_px: float) -> tuple[Stage, NoiseModel]:
    """Fit every fourth pixel of a wide band, first all of them, then without outliers; and the noise that is left."""
    rows, parts, left = chunks(maps, COARSE_AT_ONCE), [], []
    for some in rows:
        part, fit, pixels = _coarse_chunk(image, maps.take(some), shapes.take(some), first, reach_px)
        parts.append(part)
        left.append((pixels.grey, fit.residual, part.converged[:, None] & (fit.robust > 0)))
    noise = noise_model(*([part[i] for part in left] for i in range(3)))
    stage = _together(parts, rows)
    # as many degrees of freedom as a node has parameters went into the fit
    size = fit.x.shape[1] + LIGHT
    good = stage.converged & (stage.weight > 2 * size)
    freedom = float(np.median(stage.weight[good] / (stage.weight[good] - size))) if good.any() else 1.0
    return stage, replace(noise, base=noise.base * freedom, slope=noise.slope * freedom)


def first_guess(image: NDArray[Any], maps: LatticeMaps, shapes: NodeShapes) -> Learnt:
    """Widths over the printed ones that suit some of the nodes best: ink spreads, and a pattern file may be a little wrong."""
    some = np.linspace(0, len(maps.known) - 1, min(GUESS_NODES, len(maps.known))).astype(np.int64)
    maps, shapes = maps.take(some), shapes.take(some)
    step = np.linalg.norm(maps.step_px, axis=1)[:, ::-1]
    reach = FIRST_REACH_PX + (1 - GUESS_RATIOS[0]) * float(np.median(shapes.half * step))
    pixels = node_pixels(image, maps, clear_of_ends(shapes, maps, reach), shapes.half, reach, 4)
    left = []
    for ratio in GUESS_RATIOS:
        guess = Learnt(FIRST_BLUR_PX, FIRST_LOG_BLUR, np.full(2, ratio), FIRST_LOG_HALF, NoiseModel(1.0, 0.0, 1.0))
        x = _start(priors_of(maps, shapes, guess, held=True))
        _, _, residual = levels_at(pixels, x, np.full(len(some), FIRST_INK_SHARE), shapes.crossing)
        left.append((guess, float(np.median((residual**2 * pixels.used).sum(axis=1)))))
    return min(left, key=lambda guess: guess[1])[0]


def _every(maps: LatticeMaps, x: Array) -> int:
    """Each how many-th pixel the coarse fit needs of nodes at x (n, G)."""
    step = np.linalg.norm(maps.step_px, axis=1)
    step_px, width_px = float(np.median(step.min(axis=1))), float(np.median((2 * x[:, HALF] * step[:, ::-1]).min(axis=1)))
    few, some = (step_px < step or width_px < thin for step, thin in zip(COARSE_STEPS_PX, THIN_PX, strict=True))
    return 1 if few else 4 if some else 8


def _coarse_chunk(
    image: NDArray[Any], maps: LatticeMaps, shapes: NodeShapes, first: Learnt, reach_px: float
) -> tuple[Stage, NodeFit, NodePixels]:
    priors = priors_of(maps, shapes, first, held=True)
    x, share = _start(priors), np.full(len(shapes.half), FIRST_INK_SHARE)
    pixels = node_pixels(image, maps, clear_of_ends(shapes, maps, reach_px), x[:, HALF], reach_px, _every(maps, x))
    weights = Weights(1.0, 0.0, None, known=False)
    there = np.ones((len(x), 2, 2), bool)
    if shapes.crossing:
        # one step brings lines under the model; what misled it is then seen and left out
        nearer = one_step(pixels, x, share, priors, weights, shapes.crossing).x
        levels, cover, _ = levels_at(pixels, nearer, share, shapes.crossing)
        there = arms_there(pixels, levels, cover, nearer, first.blur_px)
        whole = there.all(axis=(1, 2))
        x[whole] = nearer[whole]
        pixels = without_arms(pixels, x, there, reach_px)
    light = None
    for step in range(COARSE_STEPS):
        fit = one_step(pixels, x, share, priors, weights, shapes.crossing, light)
        x, share, light = fit.x, fit.ink_share, fit.light
        if step >= FREE_STEPS - 1:
            some = np.abs(fit.residual[fit.robust > 0])
            sigma = ROBUST_TO_SIGMA * float(np.median(some)) if len(some) else 1.0
            weights = Weights(max(sigma, 0.05) ** 2, 0.0, CUT)
            if x.shape[1] == HELD:
                # near enough for lines to find their own direction, as far as the neighbours leave it open
                x, priors = np.pad(x, ((0, 0), (0, PLAIN - HELD))), priors_of(maps, shapes, first)
            # the full fit goes on with the few that are left
            if step > FREE_STEPS and fit.converged.mean() > COARSE_ENOUGH:
                break
    return _stage(fit, there, pixels), fit, pixels


def _stage(fit: NodeFit, there: Bool, pixels: NodePixels) -> Stage:
    odd = np.where(pixels.used, fit.residual, 0.0)
    brighter = (odd.max(axis=1) > -odd.min(axis=1)) if odd.shape[1] else np.zeros(len(odd), bool)
    columns = (fit.x, fit.ink_share, fit.light, fit.normal, fit.prior, fit.mean, there, fit.converged, fit.weight, fit.square)
    return Stage(*columns, fit.kept, fit.whole, pixels.saturated, brighter)


def _together(parts: list[Stage], rows: list[Index]) -> Stage:
    """Parts in the order of their rows."""
    order = np.argsort(np.concatenate(rows))
    return Stage(*(np.concatenate([getattr(part, name) for part in parts])[order] for name in Stage.__dataclass_fields__))


def learn(stage: Stage, shapes: NodeShapes, good: Bool, noise: NoiseModel) -> Learnt:
    """What the good nodes say together."""
    if not good.any():
        return Learnt(FIRST_BLUR_PX, FIRST_LOG_BLUR, np.ones(2), FIRST_LOG_HALF, noise)
    blur, ratio = np.log(stage.x[good, BLUR]), np.log(stage.x[good, HALF] / shapes.half[good])
    usual, usual_ratio = np.median(blur), np.median(ratio, axis=0)
    spread, spread_ratio = (ROBUST_TO_SIGMA * float(np.median(np.abs(v - m))) for v, m in ((blur, usual), (ratio, usual_ratio)))
    # a rectangle's size is measured, not assumed
    log_half = max(spread_ratio, LEAST_LOG_HALF) if shapes.crossing else FIRST_LOG_HALF
    return Learnt(float(np.exp(usual)), max(spread, LEAST_LOG_BLUR), np.exp(usual_ratio), log_half, noise)


def full_stage(image: NDArray[Any], maps: LatticeMaps, shapes: NodeShapes, coarse: Stage, learnt: Learnt) -> tuple[Stage, NoiseModel]:
    """Fit all pixels near the edges, from the coarse stage, in the maps through its places; and the noise of the photograph."""
    rows, parts, white = chunks(maps, FULL_AT_ONCE), [], []
    for some in rows:
        part, seen = _full_chunk(image, maps.take(some), shapes.take(some), coarse.take(some), learnt)
        parts.append(part)
        white.append(seen)
    stage = _together(parts, rows)
    size = stage.x.shape[1] + LIGHT
    good = stage.converged & (stage.weight > 2 * size)
    ratio = float(np.median(stage.square[good] / (stage.weight[good] - size))) if good.any() else 1.0
    # some of them know it well enough
    white = white[:: max(1, len(white) // NOISE_CHUNKS)]
    inflation = inflation_of([w for w, _ in white], [u for _, u in white])
    noise = NoiseModel(learnt.noise.base * ratio, learnt.noise.slope * ratio, inflation)
    return replace(stage, normal=stage.normal / ratio, square=stage.square / ratio), noise


def _full_chunk(
    image: NDArray[Any], maps: LatticeMaps, shapes: NodeShapes, coarse: Stage, learnt: Learnt
) -> tuple[Stage, tuple[Array, Bool]]:
    priors = priors_of(maps, shapes, learnt)
    x = _start(priors)
    x[:, [*range(HALF.start, HALF.stop), BLUR]] = coarse.x[:, [*range(HALF.start, HALF.stop), BLUR]]
    if not shapes.crossing:
        x[:, SLOPE], x[:, INNER] = coarse.x[:, SLOPE], coarse.x[:, INNER]
    pixels = node_pixels(image, maps, clear_of_ends(shapes, maps, learnt.reach_px), x[:, HALF], learnt.reach_px)
    if shapes.crossing:
        pixels = without_arms(pixels, x, coarse.there, learnt.reach_px)
    weights = Weights(learnt.noise.base, learnt.noise.slope, CUT)
    fit = one_step(pixels, x, coarse.ink_share, priors, weights, shapes.crossing, coarse.light)
    stage, white, used = _stage(fit, coarse.there, pixels), fit.white, fit.robust > 0
    before = fit.robust.copy()
    rest = np.flatnonzero(~fit.converged)
    for _ in range(FULL_STEPS):
        if not len(rest):
            break
        some = pixels.take(np.isin(np.arange(len(x)), rest))
        own = NodePriors(priors.mean[rest], priors.precision[rest])
        fit = one_step(some, stage.x[rest], stage.ink_share[rest], own, weights, shapes.crossing, stage.light[rest])
        part = _stage(fit, coarse.there[rest], some)
        for name in Stage.__dataclass_fields__:
            getattr(stage, name)[rest] = getattr(part, name)
        white[rest], used[rest], before[rest] = fit.white, fit.robust > 0, fit.robust
        rest = rest[~fit.converged]
    return _clear_of_obstacles(pixels, stage, priors, weights, shapes.crossing, before), (white, used)


def _clear_of_obstacles(
    pixels: NodePixels, stage: Stage, priors: NodePriors, weights: Weights, crossing: bool, robust: NDArray[Any]
) -> Stage:
    """Fit nodes that lost part of their edges once more, without the pixels beside the lost ones.

    At the border of whatever is in front, pixels are a mixture that passes for noise but pulls on the edge.
    """
    rows = np.flatnonzero((stage.whole < OCCLUDED_BELOW) & stage.converged)
    if not len(rows):
        return stage
    chosen = np.isin(np.arange(len(stage.x)), rows)
    some = pixels.take(chosen)
    used = some.used.copy()
    for k, row in enumerate(rows):
        place = np.stack([some.s[k], some.t[k]], axis=1) * some.unit_px[k]
        lost = some.used[k] & (robust[row] < LOST_BELOW)
        if lost.any():
            far, _ = cKDTree(place[lost]).query(place)
            used[k] &= far > OBSTACLE_BLURS * stage.x[row, BLUR] + 1.0
    clear = replace(some, used=used)
    own = NodePriors(priors.mean[rows], priors.precision[rows])
    x, share, light = stage.x[rows], stage.ink_share[rows], None
    for _ in range(FREE_STEPS + 1):
        fit = one_step(clear, x, share, own, weights, crossing, light)
        x, share, light = fit.x, fit.ink_share, fit.light
    part = _stage(fit, stage.there[rows], clear)
    for name in Stage.__dataclass_fields__:
        if name not in ("kept", "whole", "saturated", "brighter"):
            getattr(stage, name)[rows] = getattr(part, name)
    return stage
