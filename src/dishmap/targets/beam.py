"""Sort out many hypotheses at once: rigid poses refined on ever larger neighbourhoods of the seed, the worst dropped each time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.candidates import Candidates
from dishmap.targets.constellations import Hypotheses
from dishmap.targets.growth import Scene
from dishmap.targets.layout import Layout
from dishmap.targets.markgrid import meet_surface
from dishmap.transforms import Pose, cross_matrix, rotation_from_vector

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Neighbours of the seed looked at in each stage, and hypotheses kept after it.
STAGES = ((12, 100), (40, 25), (120, 6), (400, 3))
STEPS = 2
HANDED_ON = 3
# Neighbours of the seed whose matches are handed on; all matches are if this part of them lies within a fifth of the soft part.
SURE = 30
EXACT_PART, EXACT_WEIGHT = 0.9, 1 / (1 + 0.2**2)
# Residuals well above this part of the spacing of marks have little weight.
SOFT_PART = 0.1
# Poses that put the seed on the same mark and are turned alike to this step are one; weights that make a number of the key.
SAME_TURN_RAD = 0.05
KEY_WEIGHTS = np.array([1e8, 1.0, 1e2, 1e4, 1e6])


@dataclass(frozen=True)
class Ranked:
    """A pose camera_from_dish, the marks and candidates that it pairs near the seed, and how many it pairs in all."""

    pose: Pose
    marks: Index
    candidates: Index
    count: int


def sort_out(scene: Scene, guesses: Hypotheses) -> list[Ranked]:
    """The best few of the hypotheses about one seed."""
    candidates, layout = scene.candidates, scene.layout
    usable = np.flatnonzero(candidates.is_type.any(axis=1))
    order = usable[np.argsort(-(candidates.ray[usable] @ candidates.ray[guesses.seed]), kind="stable")]
    rotation, shift = seed_poses(candidates, layout, guesses)
    if not len(order) or order[0] != guesses.seed:
        order = np.append(guesses.seed, order[order != guesses.seed])
    for count, kept in STAGES:
        near = order[:count]
        for _ in range(STEPS):
            mark = _marks_met(scene, rotation, shift, near)
            rotation, shift = _improved(scene, rotation, shift, near, mark)
        mark = _marks_met(scene, rotation, shift, near)
        best = _best(scene, rotation, shift, near, mark, kept)
        rotation, shift, mark = rotation[best], shift[best], mark[best]
        if count >= len(order):
            break
    few = slice(0, HANDED_ON)
    _, weight, _, _ = _residual(scene, rotation[few], shift[few], near, mark[few])
    return [_ranked(Pose(rotation[h], shift[h]), mark[h], near, weight[h]) for h in range(len(weight))]


def _ranked(pose: Pose, mark: Index, near: Index, weight: Array) -> Ranked:
    """What a pose pairs: all of it if it lies exactly, else only what is near the seed.

    Far from the seed a bent surface may have led to the wrong marks; growth finds these anew.
    """
    hit = np.flatnonzero(mark >= 0)
    exact = len(hit) > 0 and (weight[hit] > EXACT_WEIGHT).mean() > EXACT_PART
    sure = hit[weight[hit] > EXACT_WEIGHT] if exact else hit[hit < SURE]
    marks, first = np.unique(mark[sure], return_index=True)
    return Ranked(pose, marks, near[sure[first]], len(hit))


def seed_poses(candidates: Candidates, layout: Layout, guesses: Hypotheses) -> tuple[Array, Array]:
    """Rotations (2H, 3, 3) and shifts (2H, 3) camera_from_dish under which the hypotheses' marks look like the seed.

    The affine map A of the mark's plane has a larger singular value 1/distance and a smaller one cos(tilt)/distance
    (weak perspective); the tilt's sign stays open, so there are two poses for each hypothesis.
    """
    seed, mark = guesses.seed, guesses.mark
    c, s = np.cos(guesses.turn_rad), np.sin(guesses.turn_rad)
    mirrored_turn = np.stack([np.stack([c, s], axis=-1), np.stack([s, -c], axis=-1)], axis=-2)
    affine = candidates.shape[seed] @ mirrored_turn / layout.radius_mm[mark, None, None]
    _, singular, vt = np.linalg.svd(affine)
    distance = 1 / singular[:, 0]
    sine = np.sqrt(np.maximum(0.0, 1 - (singular[:, 1] / singular[:, 0]) ** 2))
    view = np.column_stack([candidates.tangent[seed], candidates.ray[seed]])
    rotations = []
    for sign in (1.0, -1.0):
        columns = np.concatenate([affine * distance[:, None, None], (sign * sine[:, None] * vt[:, 1])[:, None, :]], axis=1)
        u, v = columns[:, :, 0], columns[:, :, 1]
        u = u / np.linalg.norm(u, axis=1, keepdims=True)
        v = v - (v * u).sum(axis=1, keepdims=True) * u
        v = v / np.linalg.norm(v, axis=1, keepdims=True)
        local = np.stack([u, v, np.cross(u, v)], axis=-1)
        rotations.append(view @ local @ np.swapaxes(layout.axes[mark], 1, 2))
    rotation = np.concatenate(rotations)
    at = np.tile(distance, 2)[:, None] * candidates.ray[seed]
    return rotation, at - (rotation @ np.tile(layout.center_mm[mark], (2, 1))[:, :, None])[..., 0]


def _marks_met(scene: Scene, rotation: Array, shift: Array, near: Index) -> Index:
    """The mark (H, n) that each candidate's ray meets under each pose, -1 for none or one of another type."""
    origin = -(shift[:, None, :] @ rotation)
    ray = scene.candidates.ray[near] @ rotation
    t = meet_surface(scene.layout.surface, origin, ray)
    mark = scene.grid.nearest(origin + t[..., None] * ray)
    fits = scene.candidates.is_type[near[None, :], scene.layout.type_index[mark]]
    return np.where(fits, mark, -1)


def _residual(scene: Scene, rotation: Array, shift: Array, near: Index, mark: Index) -> tuple[Array, Array, Array, Array]:
    """Seen less predicted (H, n, 2) px, its weight (H, n), the derivative by the camera point (H, n, 2, 3), and arms (H, n, 3)."""
    sights = scene.candidates.sights.take(near)
    across = sights.px_per_tangent @ np.swapaxes(sights.tangent, 1, 2)
    arm = scene.layout.center_mm[mark] @ np.swapaxes(rotation, 1, 2)
    moved = arm + shift[:, None, :]
    along = (moved * sights.ray).sum(axis=2)
    good = (mark >= 0) & (along > 0)
    along = np.where(good, along, 1.0)
    residual = -(across @ moved[..., None])[..., 0] / along[..., None]
    by_point = (across + residual[..., None] * sights.ray[:, None, :]) / along[..., None, None]
    # px per mm at the seed, for all: it only scales the weights
    soft = SOFT_PART * scene.layout.spacing_mm.min() * np.sqrt(np.abs(np.linalg.det(across[0] @ across[0].T))) ** 0.5 / along[:, :1]
    return residual, good / (1 + (residual**2).sum(axis=2) / soft**2), by_point, arm


def _improved(scene: Scene, rotation: Array, shift: Array, near: Index, mark: Index) -> tuple[Array, Array]:
    """The poses after one Gauss-Newton step, turning about each one's own seed point."""
    residual, weight, by_point, arm = _residual(scene, rotation, shift, near, mark)
    middle = arm[:, :1]
    jacobian = np.concatenate([-by_point @ cross_matrix(arm - middle), by_point], axis=3)
    weighted = jacobian * weight[..., None, None]
    h = len(rotation)
    rows, seen = jacobian.reshape(h, -1, 6), residual.reshape(h, -1, 1)
    normal = np.swapaxes(weighted.reshape(h, -1, 6), 1, 2) @ rows
    diagonal = np.einsum("hii->hi", normal)
    # few matches leave directions open: those must not move
    diagonal += 1e-6 * diagonal + 1e-9 * diagonal.sum(axis=1, keepdims=True) + 1e-12
    step = np.linalg.solve(normal, np.swapaxes(weighted.reshape(h, -1, 6), 1, 2) @ seen)[..., 0]
    enough = (weight > 0).sum(axis=1) >= 4
    step = np.where(enough[:, None] & (np.linalg.norm(step[:, :3], axis=1, keepdims=True) < 0.5), step, 0.0)
    turn = rotation_from_vector(step[:, :3])
    pivot = shift + middle[:, 0]
    turned = turn @ rotation
    moved = pivot + step[:, 3:] - (turn @ middle[:, 0, :, None])[..., 0]
    return turned, moved


def _best(scene: Scene, rotation: Array, shift: Array, near: Index, mark: Index, kept: int) -> Index:
    """The poses that explain most candidates, near ones exactly, without repetitions, best first."""
    _, weight, _, _ = _residual(scene, rotation, shift, near, mark)
    order = np.argsort(-weight.sum(axis=1), kind="stable")
    # the two tilts of one hypothesis often come to the same pose; a pair split by rounding does no harm
    key = np.column_stack([mark[:, 0], np.round(rotation[:, :2, :2].reshape(-1, 4) / SAME_TURN_RAD)])[order]
    _, first = np.unique(key @ KEY_WEIGHTS, return_index=True)
    return np.asarray(order[np.sort(first)[:kept]])
