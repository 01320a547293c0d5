"""Places of a grid's crossings or squares from the raw pixels, with covariance.

The chain: places of nodes good to a few tenths of a pixel -> the lattice's map around each node -> coarse fit to every fourth pixel -> what
the whole photograph says of blur, noise and of how smoothly nodes lie -> maps again, full fit to all pixels along the edges. No camera is
needed: the map around a node carries lens and surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from dishmap.errors import InputError, MeasurementError
from dishmap.quality import Quality, is_rejected, names
from dishmap.targets.grid_fit import BLUR, HALF, LIGHT
from dishmap.targets.grid_outcome import information_of, measured_vector
from dishmap.targets.grid_shapes import NodeShapes, node_shapes
from dishmap.targets.grid_stages import (
    FARTHEST_MOVE,
    FIRST_LOG_BLUR,
    FIRST_LOG_HALF,
    FIRST_REACH_PX,
    Stage,
    coarse_stage,
    first_guess,
    full_stage,
    learn,
    with_lines,
)
from dishmap.targets.lattice_map import LatticeMaps, lattice_maps, lines_by, place_sigma_px, strays
from dishmap.targets.pattern import Pattern
from dishmap.targets.pose import (
    HIDDEN_BELOW,
    LEAST_CONTRAST_PART,
    LEAST_CONTRAST_SIGMAS,
    MOST_SATURATED,
    POOR_FIT_RATIO,
    allowance,
    check_pixels,
)
from dishmap.targets.scene_noise import NoiseModel
from dishmap.targets.solve import inverse_each
from dishmap.targets.stages import OCCLUDED_BELOW

Array = NDArray[Any]
Bool = NDArray[Any]
Index = NDArray[np.int64]

# How well places are known before the fit, and at best lie on a smooth map.
FIRST_SIGMA_PX, LEAST_SIGMA_PX = 0.2, 1e-3
# What nodes may stray by through other things than noise: in the coarse fit, and in the end.
COARSE_SIGMA_PX, MODEL_SIGMA_PX = 0.05, 0.01
# A photograph more blurred than this is fitted coarsely once more, for its own blur.
BLURRED_PX = 1.6
# Widths below which the model of edges says little: a line, and the side of a rectangle.
THIN_LINE_PX, SMALL_SIDE_PX = 1.0, 4.0
# Chi-square over its expectation scales covariances up beyond this many of its own sigmas.
CHANCE_SIGMAS = 3.0


@dataclass(frozen=True)
class GridPoints:
    """Measured nodes (N,) of a grid.

    index: place in the pattern; center_px (N, 2): image of the crossing, or mean of the images of the rectangle's four corners; half_px
    (N, 2, 2), None for crossings: columns are half the differences of the mean images of opposite sides' corners, along x and y of the
    target. The measured vector is y = (center), or y = (center, first, second column of half), and information (N, 2, 2) or (N, 6, 6) its
    inverse covariance from this photograph's noise with all nuisances eliminated. Edges lie outwards by ink spread and tone curve, which
    lengthens both halves by as much: spread_px (N,) is how far they seem to, by the lattice's own scale. blur_px (N,) total blur;
    contrast, noise (N,) grey levels; kept (N,) share of the edges' length that was used; quality (N,) bits of `Quality`. noise_model: of
    the photograph; place_sigma_px: how far nodes stray from the smooth map through their neighbours; rejected: (id, reason) of nodes that
    could not be measured.
    """

    index: Index
    center_px: Array
    half_px: Array | None
    information: Array
    spread_px: Array
    blur_px: Array
    contrast: Array
    noise: Array
    kept: Array
    quality: Index
    noise_model: NoiseModel
    place_sigma_px: float
    rejected: tuple[tuple[int, str], ...]

    def __len__(self) -> int:
        return len(self.index)


def measure_grid(image: NDArray[Any], pattern: Pattern, index: Index, place_px: Array) -> GridPoints:
    """Measure the nodes `index` (K,) of a grid pattern in the grey `image` (H, W), from places (K, 2) good to some tenths of a pixel.

    Nodes that cannot be measured are listed in `rejected` with the reason. Raises ImageError for an image that is not grey or holds NaN,
    InputError if a node is named twice or a place is not finite, PatternError if the pattern is no grid that can be measured,
    MeasurementError if no node can be.
    """
    check_pixels(image)
    index, place = np.asarray(index, np.int64).reshape(-1), np.asarray(place_px, dtype=float).reshape(-1, 2)
    check_nodes(pattern, index, place)
    with threadpool_limits(limits=1, user_api="blas"), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return _measure(image, pattern, node_shapes(pattern).take(index), index, place)


def check_nodes(pattern: Pattern, index: Index, place: Array) -> None:
    """Raise InputError unless nodes `index` (K,) are different ones of the pattern, with finite places (K, 2)."""
    if len(index) != len(place):
        raise InputError(f"{len(index)} nodes but {len(place)} places were given; give one place in the image for each node")
    if len(index) and not (index.min() >= 0 and index.max() < len(pattern)):
        raise InputError(f"a node's number must lie between 0 and {len(pattern) - 1}, the last of the pattern")
    if len(np.unique(index)) < len(index):
        raise InputError("a node of the grid is given twice; give one place for each")
    if not np.isfinite(place).all():
        raise InputError("a node's place in the image is not finite; leave out nodes that were not found")


def _measure(image: NDArray[Any], pattern: Pattern, shapes: NodeShapes, index: Index, place: Array) -> GridPoints:
    assert pattern.lattice is not None
    lattice = pattern.lattice[index]
    rejected: list[tuple[int, str]] = []
    maps = lattice_maps(lattice, place, np.ones(len(index), bool), FIRST_SIGMA_PX) if len(index) else None
    if maps is None or not maps.known.any():
        raise MeasurementError("no node of the grid has neighbours in two directions; more of the grid must be seen and found")
    rejected += _named(pattern, index[~maps.known], "too few of its neighbours were found")
    index, lattice, shapes, maps = index[maps.known], lattice[maps.known], shapes.take(maps.known), maps.take(maps.known)
    stage, noise = coarse_stage(image, maps, shapes, first_guess(image, maps, shapes), FIRST_REACH_PX)
    learnt = learn(stage, shapes, _good(stage), noise)
    if learnt.blur_px > BLURRED_PX:
        stage, noise = coarse_stage(image, maps, shapes, replace(learnt, log_blur=FIRST_LOG_BLUR, log_half=FIRST_LOG_HALF), learnt.reach_px)
        learnt = learn(stage, shapes, _good(stage), noise)
    good = _good(stage)
    moved = measured_vector(maps, stage.x, shapes.crossing)[0][:, :2]
    moved = np.where(good[:, None], moved, maps.origin_px)
    sigma = place_sigma_px(lattice, moved, good, LEAST_SIGMA_PX)
    # what stands in the way may have led a node astray: it is looked for again where its neighbours say
    astray, expected = strays(lattice, moved, good, sigma, np.full(len(moved), COARSE_SIGMA_PX))
    moved[astray] = expected[astray]
    measurable, good = good, good & ~astray
    maps = lattice_maps(lattice, moved, good, sigma)
    rejected += _named(pattern, index[measurable & ~maps.known], "too few of its neighbours could be measured")
    rejected += [(int(pattern.ids[i]), _why_lost(stage, shapes, row)) for row, i in enumerate(index) if not measurable[row]]
    rows = np.flatnonzero(measurable & maps.known)
    if not len(rows):
        raise MeasurementError(
            "no node of the grid could be measured: no such lines or squares are seen there; give a sharper photograph or the right pattern"
        )
    index, lattice, shapes, maps = index[rows], lattice[rows], shapes.take(rows), maps.take(rows)
    stage, noise = full_stage(image, maps, shapes, stage.take(rows), learnt)
    # lines once more by where the neighbours are now
    places, usable = measured_vector(maps, stage.x, shapes.crossing)[0][:, :2], stage.converged & _good(stage)
    sigma = place_sigma_px(lattice, places, usable, LEAST_SIGMA_PX)
    stage = with_lines(stage, shapes, *lines_by(maps, lattice, places, usable, sigma))
    return _collect(image.shape, pattern, index, shapes, maps, stage, noise, sigma, rejected)


def _named(pattern: Pattern, index: Index, why: str) -> list[tuple[int, str]]:
    return [(int(pattern.ids[i]), why) for i in index]


def _good(stage: Stage) -> Bool:
    """Nodes whose coarse fit may be gone on from."""
    near = np.abs(stage.x[:, :2]).max(axis=1) < FARTHEST_MOVE
    finite = np.isfinite(stage.x).all(axis=1)
    return np.asarray(near & finite & (stage.light[:, 0] > stage.light[:, 3]) & np.all(stage.there.any(axis=2), axis=1))


def _why_lost(stage: Stage, shapes: NodeShapes, row: int) -> str:
    if shapes.crossing and not stage.there[row].any(axis=1).all():
        return "lines are seen in one direction only"
    if not stage.light[row, 0] > stage.light[row, 3]:
        return "no contrast"
    return "its pixels do not look like the printed node"


def _collect(
    size: tuple[int, ...],
    pattern: Pattern,
    index: Index,
    shapes: NodeShapes,
    maps: LatticeMaps,
    stage: Stage,
    noise: NoiseModel,
    sigma_px: float,
    rejected: list[tuple[int, str]],
) -> GridPoints:
    y, by_x = measured_vector(maps, stage.x, shapes.crossing)
    freedom = np.maximum(stage.weight - stage.x.shape[1] - LIGHT, 1.0)
    misfit = stage.square / freedom
    scale = np.maximum(misfit / (1 + CHANCE_SIGMAS * np.sqrt(2 / freedom)), 1.0)
    enlarged = scale * allowance(misfit, stage.whole) * noise.inflation
    information = information_of(stage.normal, stage.prior, by_x) / enlarged[:, None, None]
    contrast = stage.light[:, 0] - stage.light[:, 3]
    sigma = np.sqrt(noise.variance(stage.light[:, 0]) * scale)
    # band 0 is across b
    step = np.linalg.norm(maps.step_px, axis=1)[:, ::-1]
    spread = ((stage.x[:, HALF] - shapes.half) * step).mean(axis=1)
    width = (2 * stage.x[:, HALF] * step).min(axis=1)
    finite = np.isfinite(y).all(axis=1) & np.isfinite(information).all(axis=(1, 2))
    near = np.abs(stage.x[:, :2]).max(axis=1) < FARTHEST_MOVE
    bits = np.zeros(len(index), np.int64)
    bits[~(stage.converged & finite & near)] |= int(Quality.NOT_CONVERGED)
    bits[contrast < np.maximum(LEAST_CONTRAST_SIGMAS * sigma, LEAST_CONTRAST_PART * stage.light[:, 0])] |= int(Quality.NO_CONTRAST)
    bits[misfit > POOR_FIT_RATIO] |= int(Quality.POOR_FIT)
    bits[width < (THIN_LINE_PX if shapes.crossing else SMALL_SIDE_PX)] |= int(Quality.TOO_SMALL)
    bits[_clipped(size, y, shapes.crossing)] |= int(Quality.CLIPPED)
    lost, bright = stage.kept < OCCLUDED_BELOW, stage.brighter | (stage.saturated > MOST_SATURATED)
    bits[(lost & bright) | (stage.saturated > MOST_SATURATED)] |= int(Quality.GLARE)
    bits[lost & ~bright] |= int(Quality.OCCLUDED)
    covariance = inverse_each(np.where(finite[:, None, None], information, 0.0))
    own = np.sqrt(np.maximum(covariance[:, 0, 0] + covariance[:, 1, 1], 0.0) / 2 + MODEL_SIGMA_PX**2)
    assert pattern.lattice is not None
    astray, expected = strays(pattern.lattice[index], y[:, :2], ~is_rejected(bits), sigma_px, own)
    for i in np.flatnonzero(astray):
        apart = float(np.linalg.norm(expected[i] - y[i, :2]))
        rejected.append((int(pattern.ids[index[i]]), f"it lies {apart:.2g} px from where its neighbours say; something hides it"))
    out = is_rejected(bits) | (stage.kept < HIDDEN_BELOW * (0.5 if shapes.crossing else 1.0))
    for i in np.flatnonzero(out & ~astray):
        why = names(int(bits[i])) if is_rejected(bits[i : i + 1])[0] else "most of its edges are hidden"
        rejected.append((int(pattern.ids[index[i]]), why.replace("|", ", ").replace("_", " ")))
    some = ~(out | astray)
    half = None if shapes.crossing else np.stack([y[some, 2:4], y[some, 4:6]], axis=2)
    return GridPoints(
        index=index[some],
        center_px=y[some, :2],
        half_px=half,
        information=information[some],
        spread_px=spread[some],
        blur_px=stage.x[some, BLUR],
        contrast=contrast[some],
        noise=sigma[some],
        kept=stage.kept[some],
        quality=bits[some],
        noise_model=noise,
        place_sigma_px=sigma_px,
        rejected=tuple(sorted(rejected)),
    )


def _clipped(size: tuple[int, ...], y: Array, crossing: bool) -> Bool:
    """Where the node, or a corner of it, lies outside the image or on its very border."""
    places = y[:, None, :2]
    if not crossing:
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        places = places + signs[:, :1] * y[:, None, 2:4] + signs[:, 1:] * y[:, None, 4:6]
    last = np.array(size[::-1]) - 1.0
    return ~np.asarray(((places >= 1) & (places <= last - 1)).all(axis=(1, 2)))
