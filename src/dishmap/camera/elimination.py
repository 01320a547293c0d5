"""Normal equations of a bundle, solved by elimination: poses view by view, and before them the board's printed points one by one.

Without print errors the poses leave one small system, a sum over the views (`reduced`). Print errors tie the views together: each point's
two numbers are eliminated first, and camera, shape and all poses remain, some hundred unknowns whatever the number of points
(Triggs et al. 2000, section 6: the reduced camera system).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.bundle import POSE, BoardCorners, Bundle, Mask, Prior
from dishmap.transforms import cross_matrix

Array = NDArray[np.float64]

LEAST_DAMPING = 1e-13


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of J^T W J and J^T W r for each view: shared (V, S, S), mixed (V, S, Q), pose (V, Q, Q), and both right sides.

    Q is 6, or 12 with motions. prior (S,), prior_side (S,): what `Prior` adds to the shared block, once for all views; what it adds to
    motions is
    in their blocks. rows (M, 2, S + Q): J with the root of the weight; residual (M, 2): r with it; view (M,). points: print errors, if any.
    """

    shared: Array
    mixed: Array
    pose: Array
    shared_side: Array
    pose_side: Array
    prior: Array
    prior_side: Array
    rows: Array
    residual: Array
    view: NDArray[np.int64]
    points: PointEquations | None


@dataclass(frozen=True)
class PointEquations:
    """Blocks of the board's N points: inverse (N, 2, 2) of their own block, right side (N, 2), and what ties them to the rest.

    to_shared (N, 2, S), to_pose (M, 2, Q): rows of the mixed blocks, of each corner with the pose of its view; rows (M, 2, 2): their part
    of J; point (M,): which point each corner is.
    """

    inverse: Array
    side: Array
    to_shared: Array
    to_pose: Array
    rows: Array
    point: NDArray[np.int64]


@dataclass(frozen=True)
class Step:
    """A step of the free shared parameters (S,), of poses with motions (V, Q), and of print errors (N, 2) where they are estimated."""

    shared: Array
    poses: Array
    prints: Array | None


def normal_equations(bundle: Bundle, corners: BoardCorners, free: Mask, weights: Array, prior: Prior) -> NormalEquations:
    """Linearise the projections of a bundle; weights (M,), free (P + F,) tells which shared parameters are estimated."""
    turned = bundle.turned(corners)
    pixels, by_point, by_camera = bundle.camera.project_with_jacobians(bundle.points(corners))
    by_turn, by_board = -by_point @ cross_matrix(turned), by_point @ bundle.rotation[corners.view]
    motions = []
    if prior.motion is not None:
        when, across = corners.when[:, None, None], cross_matrix(bundle.arms(corners, turned))
        motions = [-by_point @ across * when, by_point * when]
        # what the board turns while it is read turns its pose and shape too
        by_rest = by_point @ cross_matrix(bundle.motion[corners.view, :3]) * when
        by_turn, by_board = by_turn - by_rest @ across, by_board + by_rest @ bundle.rotation[corners.view]
    parts = [np.concatenate([by_camera, by_board @ corners.shapes], axis=-1)[..., free], by_turn, by_point, *motions]
    rows = np.concatenate([*parts, by_board[..., :2], (corners.pixels - pixels)[..., None]], axis=-1)
    rows *= np.sqrt(weights)[:, None, None]
    rows[weights == 0] = 0.0  # where the lens model ends they are NaN
    rows, by_print, residual = rows[..., :-3], rows[..., -3:-1], rows[..., -1]
    n, width = int(free.sum()), rows.shape[-1]
    blocks = np.empty((len(corners.bounds) - 1, width, width + 1))
    for block, s in zip(blocks, corners.slices, strict=True):
        flat = rows[s].reshape(-1, width)
        block[:, :width], block[:, width] = flat.T @ flat, flat.T @ residual[s].ravel()
    own, motion = prior.pose_precision, np.concatenate([np.zeros((len(blocks), POSE)), bundle.motion], axis=1)[:, : width - n]
    precision = prior.precision(bundle)[free]
    return NormalEquations(
        shared=blocks[:, :n, :n],
        mixed=blocks[:, :n, n:width],
        pose=blocks[:, n:, n:width] + np.diag(own),
        shared_side=blocks[:, :n, width],
        pose_side=blocks[:, n:, width] - own * motion,
        prior=precision,
        prior_side=-precision * prior.pull(bundle)[free],
        rows=rows,
        residual=residual,
        view=corners.view,
        points=_point_equations(bundle, corners, rows, by_print, residual, n, prior) if prior.print_mm else None,
    )


def _point_equations(
    bundle: Bundle, corners: BoardCorners, rows: Array, by_print: Array, residual: Array, shared: int, prior: Prior
) -> PointEquations:
    across = np.swapaxes(by_print, 1, 2)
    mixed = across @ rows
    count, point = len(bundle.print_mm), corners.point
    terms = np.concatenate([across @ by_print, mixed[..., :shared], across @ residual[..., None]], axis=-1)
    order = np.argsort(point, kind="stable")
    present, first = np.unique(point[order], return_index=True)
    sums = np.zeros((count, 2, shared + 3))
    sums[present] = np.add.reduceat(terms[order], first, axis=0)
    own, to_shared, side = sums[..., :2], sums[..., 2:-1], sums[..., -1]
    inverse = np.asarray(np.linalg.inv(own + prior.print_precision * np.eye(2)), dtype=float)
    return PointEquations(inverse, side - prior.print_precision * bundle.print_mm, to_shared, mixed[..., shared:], by_print, point)


def reduced(equations: NormalEquations, damping: float = 0.0) -> tuple[Array, Array, Array, Array]:
    """Eliminate the poses, print errors held: shared matrices (V, S, S), right sides (V, S), the poses' answers (V, Q, S), (V, Q).

    Their sums over the views, with the prior, are the shared system; a view's pose step is `answer - by_shared @ shared_step`.
    """
    diagonal = np.einsum("vii->vi", equations.pose)
    size = diagonal.shape[1]
    pose = equations.pose + (damping * diagonal)[:, :, None] * np.eye(size)
    both = np.concatenate([np.swapaxes(equations.mixed, 1, 2), equations.pose_side[..., None]], axis=-1)
    # units differ (radians, mm), so the system is solved with a unit diagonal
    scale = 1 / np.sqrt(np.maximum(diagonal, 1e-300))[..., None]
    system = pose * scale * np.swapaxes(scale, 1, 2) + LEAST_DAMPING * np.eye(size)  # a view without weight stays where it is
    answer = scale * np.linalg.solve(system, scale * both)
    by_shared, plain = answer[..., :-1], answer[..., -1]
    matrix = equations.shared - equations.mixed @ by_shared
    side = equations.shared_side - np.einsum("vpk,vk->vp", equations.mixed, plain)
    return matrix, side, by_shared, plain


def best_step(equations: NormalEquations, damping: float = 0.0) -> tuple[Step, float]:
    """The damped step of all parameters, and by how much it should lower the sum of squares (inf if there is no step)."""
    count = equations.shared.shape[-1]
    try:
        step = _arrow_step(equations, damping) if equations.points is None else _tied_step(equations, equations.points, damping)
    except np.linalg.LinAlgError:
        return Step(np.zeros(count), np.zeros_like(equations.pose_side), None), np.inf
    gain = (equations.shared_side.sum(axis=0) + equations.prior_side) @ step.shared + (equations.pose_side * step.poses).sum()
    if equations.points is not None and step.prints is not None:
        gain += (equations.points.side * step.prints).sum()
    return step, float(gain) if np.isfinite(gain) else np.inf


def _arrow_step(equations: NormalEquations, damping: float) -> Step:
    matrix, side, by_shared, plain = reduced(equations, damping)
    diagonal = np.einsum("vii->i", equations.shared) + equations.prior
    system = matrix.sum(axis=0) + np.diag(damping * diagonal + equations.prior)
    scale = 1 / np.sqrt(np.maximum(diagonal, 1e-300))
    shared = scale * np.linalg.solve(system * np.outer(scale, scale), scale * (side.sum(axis=0) + equations.prior_side))
    return Step(shared, plain - by_shared @ shared, None)


def _tied_step(equations: NormalEquations, points: PointEquations, damping: float) -> Step:
    matrix, side, ties = tied_system(equations, damping)
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    answer = scale * np.linalg.solve(matrix * np.outer(scale, scale) + LEAST_DAMPING * np.eye(len(scale)), scale * side)
    count = equations.shared.shape[-1]
    prints = (points.inverse @ (points.side - ties @ answer)[..., None])[..., 0]
    return Step(answer[:count], answer[count:].reshape(equations.pose_side.shape), prints)


def tied_system(equations: NormalEquations, damping: float = 0.0) -> tuple[Array, Array, Array]:
    """The system of shared parameters and all poses (T, T), print errors eliminated; its right side (T,); points' ties (N, 2, T)."""
    views, count, own = equations.mixed.shape
    size = count + views * own
    matrix = np.zeros((size, size))
    matrix[:count, :count] = equations.shared.sum(axis=0) + np.diag(equations.prior)
    for v in range(views):
        at = slice(count + v * own, count + (v + 1) * own)
        matrix[:count, at], matrix[at, :count], matrix[at, at] = equations.mixed[v], equations.mixed[v].T, equations.pose[v]
    matrix[np.diag_indices(size)] *= 1 + damping
    side = np.concatenate([equations.shared_side.sum(axis=0) + equations.prior_side, equations.pose_side.ravel()])
    points = equations.points
    if points is None:
        return matrix, side, np.zeros((0, 2, size))
    ties = np.zeros((len(points.side), 2, size))
    ties[..., :count] = points.to_shared
    columns = count + own * equations.view[:, None] + np.arange(own)
    ties[points.point[:, None, None], np.arange(2)[:, None], columns[:, None, :]] = points.to_pose
    flat = ties.reshape(-1, size)
    solved = (points.inverse @ ties).reshape(-1, size)
    return matrix - flat.T @ solved, side - solved.T @ points.side.ravel(), ties


@dataclass(frozen=True)
class Marginals:
    """What the equations say of errors when the noise of a coordinate with weight one has variance one.

    covariance (S, S): of the shared parameters, all else marginalised out. influence (M, 2, S): how far they follow each (weighted)
    residual. motion (V, Q - 6), prints (N, 2): variances.
    """

    covariance: Array
    influence: Array
    motion: Array
    prints: Array


def marginals(equations: NormalEquations) -> Marginals:
    """Invert the whole system; raises LinAlgError where it is singular."""
    matrix, _, ties = tied_system(equations)
    views, count, own = equations.mixed.shape
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    inverse = np.linalg.inv(matrix * np.outer(scale, scale) + LEAST_DAMPING * np.eye(len(scale))) * np.outer(scale, scale)
    shared = inverse[:count]
    by_pose = shared[:, count:].reshape(count, views, own)
    influence = equations.rows[..., :count] @ shared[:, :count].T
    influence += equations.rows[..., count:] @ np.transpose(by_pose, (1, 2, 0))[equations.view]
    prints = np.zeros((0, 2))
    if (points := equations.points) is not None:
        solved = points.inverse @ ties
        influence -= points.rows @ (solved @ shared.T)[points.point]
        prints = np.einsum("nii->ni", points.inverse) + ((solved @ inverse) * solved).sum(axis=-1)
    motion = np.diag(inverse)[count:].reshape(views, own)[:, POSE:]
    return Marginals((shared[:, :count] + shared[:, :count].T) / 2, influence, motion, prints)


def step_in_sigmas(equations: NormalEquations, sigma_px: float, rounding_px: float = 1e-11) -> float:
    """How far the minimum still is by a Gauss-Newton step, in standard deviations of all parameters together."""
    _, gain = best_step(equations)
    return float(np.sqrt(max(gain, 0.0)) / max(sigma_px, rounding_px))
