"""Leaving out the pixels of a target that see the ink of the targets beside it.

The model of a ring knows the ring alone. Where targets stand within a few blurs of each other a neighbour's ink darkens the ground
beside an edge, and the fit would take that for an edge farther out.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.camera.model import Camera
from dishmap.targets.edges import Poses
from dishmap.targets.pattern import Pattern, TargetKind
from dishmap.targets.pixels import RingPixels
from dishmap.targets.window import outline

Array = NDArray[Any]
Index = NDArray[np.int64]
Bool = NDArray[Any]

# Beyond this many blurs from an edge its ink adds under 0.1 % of the contrast; under 1.5 % beyond the second, which is for rings
# that the first would leave too little of.
INK_BLURS, LEAST_INK_BLURS = 3.2, 2.2
# Rings of which the neighbours leave less than this share of the band are said to be occluded: what is left may hang on one side.
LEAST_FREE = 0.5


@dataclass(frozen=True)
class Ink:
    """Ellipses about the ink of a picture: target (K,) that each belongs to, center_px (K, 2), and its axes.

    metric (K, 2, 2): points p of an ellipse have (p - center)' metric (p - center) = 1; reach_px (K,): longest semi-axis.
    """

    target: Index
    center_px: Array
    metric: Array
    reach_px: Array


def ink_of(camera: Camera, pattern: Pattern, parts: Iterable[tuple[TargetKind, Index, Poses]]) -> Ink:
    """Outermost circles of targets as the camera sees them; each part holds targets of a kind, their indices and poses."""
    targets, ends = [], []
    for kind, index, poses in parts:
        outer = kind.parent < 0
        ends.append(outline(camera, poses, pattern.curvature_per_mm[index], kind.center_mm[outer], kind.radius_mm[outer]))
        targets.append(np.repeat(index, outer.sum()))
    points = np.concatenate([e.reshape(-1, *e.shape[2:]) for e in ends])
    seen = np.isfinite(points).all(axis=(1, 2))
    center = points[seen].mean(axis=1)
    spokes = points[seen] - center[:, None]
    scatter = np.swapaxes(spokes, 1, 2) @ spokes * (2 / spokes.shape[1])
    values, vectors = np.linalg.eigh(scatter)
    metric = (vectors / np.maximum(values, 1e-3)[:, None]) @ np.swapaxes(vectors, 1, 2)
    return Ink(np.concatenate(targets)[seen], center, metric, np.sqrt(np.maximum(values[:, 1], 1e-3)))


def clear_of_neighbours(pixels: RingPixels, index: Index, ink: Ink, blur_px: Array) -> RingPixels:
    """`pixels` without those within INK_BLURS of other targets' ink; index (T,): which target of `ink` each is, blur_px (T,)."""
    blur = blur_px[pixels.target]
    row, other = _close_pairs(pixels, index, ink, INK_BLURS * blur)
    if not len(row):
        return pixels
    scale = pixels.patches.scale_px[row, None]
    du = pixels.s[row] * scale + (pixels.patches.anchor_px[row, :1] - ink.center_px[other, :1])
    dv = pixels.t[row] * scale + (pixels.patches.anchor_px[row, 1:] - ink.center_px[other, 1:])
    m = ink.metric[other]
    gu, gv = m[:, :1, 0] * du + m[:, :1, 1] * dv, m[:, 1:, 0] * du + m[:, 1:, 1] * dv
    rho = np.sqrt(du * gu + dv * gv)
    # distance outwards to first order, exact on the ellipse and for circles
    distance = (rho - 1) * rho / np.sqrt(np.maximum(gu * gu + gv * gv, 1e-12))
    nearest = np.full(pixels.s.shape, np.inf, np.float32)
    np.minimum.at(nearest, row, distance.astype(np.float32))
    nearest /= blur[:, None]
    covered = pixels.used & (nearest < INK_BLURS)
    if not covered.any():
        return pixels
    few = _few_left(pixels.used, covered)
    covered[few] = pixels.used[few] & (nearest[few] < LEAST_INK_BLURS)
    few = _few_left(pixels.used, covered)
    return replace(pixels, used=pixels.used & ~(covered & ~few[:, None]), blocked=covered & few[:, None])


def _few_left(used: Bool, covered: Bool) -> Bool:
    return np.asarray((used & ~covered).sum(axis=1) < LEAST_FREE * used.sum(axis=1))


def _close_pairs(pixels: RingPixels, index: Index, ink: Ink, reach_px: Array) -> tuple[Index, Index]:
    """Rings and ellipses of other targets that may come within reach_px (M,) of the rings' pixels."""
    anchor, half = pixels.patches.anchor_px, pixels.patches.scale_px
    near = cKDTree(ink.center_px).query_ball_point(anchor, half + ink.reach_px.max(initial=0.0) + reach_px)
    row = np.repeat(np.arange(len(near)), [len(n) for n in near])
    other = np.concatenate([np.asarray(n, dtype=np.int64) for n in near]) if len(row) else np.zeros(0, np.int64)
    gap = np.linalg.norm(anchor[row] - ink.center_px[other], axis=1)
    # an ellipse that holds the ring's middle is not beside it
    close = (
        (gap < half[row] + ink.reach_px[other] + reach_px[row])
        & (gap > ink.reach_px[other])
        & (ink.target[other] != index[pixels.target[row]])
    )
    return row[close], other[close]
