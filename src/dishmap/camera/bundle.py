"""Bundle adjustment of one camera, the board's shape and its poses: Levenberg-Marquardt, poses eliminated view by view.

Each view's pose touches only its own residuals, so the normal equations are an arrow: with the poses eliminated (Schur
complement) there is one small system for camera and board, whatever the number of views (Triggs et al. 2000, section 6).
Camera parameters and the board's bends are called *shared* here: each view has them in common.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.errors import CameraError
from dishmap.transforms import cross_matrix, rotation_from_vector

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

POSE = 6
# Powers of the radius with which k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 act, relative to the radius itself.
OPENCV_POWERS, FISHEYE_POWERS = (2, 4, 1, 1, 6, 2, 4, 6, 1, 3, 1, 3), (2, 4, 6, 8)
STIFFNESS = 0.5
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-13, 1e12
MOST_STEPS = 100
# A step that is expected to lower the sum of squares by less than this part of it changes no parameter by 1e-5 sigma.
RELATIVE_GAIN = 1e-12
# Below this rms the residuals are rounding errors of the projection.
ROUNDING_PX = 1e-11
# Half weight at this many sigmas in the robust start: what fits keeps its say, what is far off loses it.
CAUCHY_SIGMAS = 3.0
# rms of one coordinate from the median length of 2D residuals: sqrt(2 ln 2)
MEDIAN_OF_RAYLEIGH = 1.1774
SMALLEST_SCALE_PX = 0.002


@dataclass(frozen=True)
class BoardCorners:
    """Corners of all views in one run: pixels (M, 2), board_mm (M, 3), where each view starts (V + 1,), how the board can bend.

    bends (M, F): height in mm of each corner over the flat board when a bend has size 1 mm (`board.bends_of`).
    """

    pixels: Array
    board_mm: Array
    bounds: NDArray[np.int64]
    bends: Array

    @property
    def slices(self) -> list[slice]:
        """The rows of each view."""
        return [slice(a, b) for a, b in zip(self.bounds[:-1], self.bounds[1:], strict=True)]

    @property
    def view(self) -> NDArray[np.int64]:
        """Index of the view of each corner (M,)."""
        return np.repeat(np.arange(len(self.bounds) - 1), np.diff(self.bounds))


@dataclass(frozen=True)
class Bundle:
    """A camera, the board's pose in each view, camera from board: rotation (V, 3, 3), translation_mm (V, 3), and its bends (F,) in mm."""

    camera: Camera
    rotation: Array
    translation_mm: Array
    bend_mm: Array

    @property
    def shared(self) -> Array:
        """Camera parameters, then bends (P + F,)."""
        return np.concatenate([self.camera.parameters, self.bend_mm])

    def residuals(self, corners: BoardCorners) -> Array:
        """Measured minus projected (M, 2), px; NaN where the lens model does not reach."""
        return corners.pixels - self.camera.project(self.turned(corners) + self.translation_mm[corners.view])

    def turned(self, corners: BoardCorners) -> Array:
        """Corners of the bent board (M, 3), turned as the camera sees them but not yet shifted."""
        board = corners.board_mm.copy()
        board[:, 2] += corners.bends @ self.bend_mm
        return np.einsum("mij,mj->mi", self.rotation[corners.view], board)

    def moved(self, free: Mask, shared_step: Array, pose_steps: Array) -> Bundle:
        """Return the bundle after a step: shared parameters added, rotations turned on the left, translations added."""
        shared = self.shared
        shared[free] += shared_step
        rotation = rotation_from_vector(pose_steps[:, :3]) @ self.rotation
        return replace(self.with_shared(shared), rotation=rotation, translation_mm=self.translation_mm + pose_steps[:, 3:])

    def with_shared(self, shared: Array) -> Bundle:
        """The bundle with other camera parameters and bends (P + F,)."""
        count = len(self.camera.parameters)
        return replace(self, camera=self.camera.with_parameters(shared[:count]), bend_mm=shared[count:])

    def of_views(self, keep: Mask) -> Bundle:
        """The bundle of some of the views (V,)."""
        return Bundle(self.camera, self.rotation[keep], self.translation_mm[keep], self.bend_mm)


@dataclass(frozen=True)
class Prior:
    """How freely shared parameters may move: it decides only what the corners leave open.

    About `expected` (P,), the focal lengths may move by themselves and the principal point by the half picture; at `radius` (tangent
    off the axis, of the farthest corner), each lens term may move a point by STIFFNESS of its distance from the axis.
    Without this the terms of a rational lens, which can stand in for each other, run away, and so does the focal length when
    all views are alike. Bends may be bend_mm large (sigma), about none. noise_px: sigma of one coordinate, which says what a
    corner weighs against the prior.
    """

    expected: Array
    radius: float
    noise_px: float
    bend_mm: float

    def precision(self, bundle: Bundle) -> Array:
        """Precision of each shared parameter times the noise's variance (P + F,), in px^2 over the parameter's unit squared."""
        camera = bundle.camera
        powers = (FISHEYE_POWERS if camera.model == "fisheye" else OPENCV_POWERS)[: camera.distortion.size]
        lens = STIFFNESS / self.radius ** np.array(powers, dtype=float)
        bends = np.full(len(bundle.bend_mm), self.bend_mm)
        return (self.noise_px / np.concatenate([self.expected[:2], [camera.width_px / 2, camera.height_px / 2], lens, bends])) ** 2

    def pull(self, bundle: Bundle) -> Array:
        """Distance of the parameters from what is expected (P + F,)."""
        return np.concatenate([bundle.camera.parameters - self.expected, bundle.bend_mm])

    def cost(self, bundle: Bundle) -> float:
        """What it adds to the sum of squares, px^2."""
        return float(self.precision(bundle) @ self.pull(bundle) ** 2)


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of J^T W J and J^T W r for each view: shared (V, S, S), mixed (V, S, 6), pose (V, 6, 6), and both right sides.

    prior (S,), prior_side (S,): what `Prior` adds to the shared block, once for all views.
    """

    shared: Array
    mixed: Array
    pose: Array
    shared_side: Array
    pose_side: Array
    prior: Array
    prior_side: Array


def normal_equations(bundle: Bundle, corners: BoardCorners, free: Mask, weights: Array, prior: Prior) -> NormalEquations:
    """Linearise the projections of a bundle; weights (M,), free (P + F,) tells which shared parameters are estimated."""
    turned = bundle.turned(corners)
    pixels, by_point, by_camera = bundle.camera.project_with_jacobians(turned + bundle.translation_mm[corners.view])
    residual = corners.pixels - pixels
    upwards = (by_point @ bundle.rotation[corners.view][..., 2:]) * corners.bends[:, None]
    by_shared = np.concatenate([by_camera, upwards], axis=-1)[..., free]
    rows = np.concatenate([by_shared, -by_point @ cross_matrix(turned), by_point, residual[..., None]], axis=-1)
    rows *= np.sqrt(weights)[:, None, None]
    rows[weights == 0] = 0.0  # where the lens model ends they are NaN
    n = int(free.sum())
    blocks = np.stack([(part := rows[s].reshape(-1, n + POSE + 1)).T @ part for s in corners.slices])
    p = slice(n, n + POSE)
    precision = prior.precision(bundle)[free]
    sides = blocks[:, :n, -1], blocks[:, p, -1]
    return NormalEquations(blocks[:, :n, :n], blocks[:, :n, p], blocks[:, p, p], *sides, precision, -precision * prior.pull(bundle)[free])


def reduced(equations: NormalEquations, damping: float = 0.0) -> tuple[Array, Array, Array, Array]:
    """Eliminate the poses. Returns shared matrices (V, S, S), right sides (V, S), and the poses' answers (V, 6, S), (V, 6).

    Their sums over the views, with the prior, are the shared system; a view's pose step is `answer - by_shared @ shared_step`.
    """
    diagonal = np.einsum("vii->vi", equations.pose)
    pose = equations.pose + (damping * diagonal)[:, :, None] * np.eye(POSE)
    both = np.concatenate([np.swapaxes(equations.mixed, 1, 2), equations.pose_side[..., None]], axis=-1)
    # units differ (radians, mm), so the system is solved with a unit diagonal
    scale = 1 / np.sqrt(np.maximum(diagonal, 1e-300))[..., None]
    system = pose * scale * np.swapaxes(scale, 1, 2) + LEAST_DAMPING * np.eye(POSE)  # a view without weight stays where it is
    answer = scale * np.linalg.solve(system, scale * both)
    by_shared, plain = answer[..., :-1], answer[..., -1]
    matrix = equations.shared - equations.mixed @ by_shared
    side = equations.shared_side - np.einsum("vpk,vk->vp", equations.mixed, plain)
    return matrix, side, by_shared, plain


def adjust(start: Bundle, corners: BoardCorners, free: Mask, prior: Prior, weights: Array | None = None, robust: bool = False) -> Bundle:
    """Fit a bundle to corners by Levenberg-Marquardt.

    free (P + F,): shared parameters to estimate; poses always are. weights (M,): of the corners, 1 by default. robust: weigh by
    Cauchy's function of the residual in units of the overall scale instead, again at every step.
    Returns the best bundle reached; `step_in_sigmas` tells whether that is the minimum.
    """
    bundle, damping = start, FIRST_DAMPING
    fixed = np.ones(len(corners.pixels)) if weights is None else weights
    residuals = bundle.residuals(corners)
    for _ in range(MOST_STEPS):
        weight = _cauchy(residuals) if robust else fixed
        cost = _cost(residuals, weight) + prior.cost(bundle)
        if not np.isfinite(cost):
            break
        equations = normal_equations(bundle, corners, free, weight, prior)
        accepted = False
        while damping < MOST_DAMPING and not accepted:
            step, gain = _step(equations, damping)
            # in the robust start the weights move too, and finer convergence is left to the fit after it
            if gain <= (1e-6 if robust else RELATIVE_GAIN) * cost + len(fixed) * ROUNDING_PX**2:
                return bundle
            trial = _try_move(bundle, free, step) if gain < np.inf else bundle
            moved = trial.residuals(corners)
            accepted = _cost(moved, weight) + prior.cost(trial) < cost
            damping = max(damping / 10, LEAST_DAMPING) if accepted else damping * 10
        if not accepted:
            return bundle
        bundle, residuals = trial, moved
    return bundle


def _step(equations: NormalEquations, damping: float) -> tuple[tuple[Array, Array], float]:
    """The damped step of shared parameters and poses, and by how much it should lower the sum of squares (inf if there is no step)."""
    count = equations.shared.shape[-1]
    try:
        matrix, side, by_shared, plain = reduced(equations, damping)
        diagonal = np.einsum("vii->i", equations.shared) + equations.prior
        system = matrix.sum(axis=0) + np.diag(damping * diagonal + equations.prior)
        scale = 1 / np.sqrt(np.maximum(diagonal, 1e-300))
        shared = scale * np.linalg.solve(system * np.outer(scale, scale), scale * (side.sum(axis=0) + equations.prior_side))
    except np.linalg.LinAlgError:
        return (np.zeros(count), np.zeros_like(equations.pose_side)), np.inf
    poses = plain - by_shared @ shared
    gain = float((equations.shared_side.sum(axis=0) + equations.prior_side) @ shared + (equations.pose_side * poses).sum())
    return (shared, poses), gain if np.isfinite(gain) else np.inf


def _try_move(bundle: Bundle, free: Mask, step: tuple[Array, Array]) -> Bundle:
    """The bundle after a step; the same bundle, which lowers nothing, when no camera has such parameters."""
    try:
        return bundle.moved(free, *step)
    except CameraError:
        return bundle


def step_in_sigmas(equations: NormalEquations, sigma_px: float) -> float:
    """How far the minimum still is by a Gauss-Newton step, in standard deviations of all parameters together."""
    _, gain = _step(equations, 0.0)
    return float(np.sqrt(max(gain, 0.0)) / max(sigma_px, ROUNDING_PX))


def _cost(residuals: Array, weights: Array) -> float:
    """Weighted sum of squares; infinite when a point with weight is beyond the lens model."""
    square = (residuals**2).sum(axis=1)
    total = float((weights * square)[weights > 0].sum())
    return total if np.isfinite(total) else np.inf


def scale_px(residuals: Array) -> float:
    """Robust sigma of one coordinate of 2D residuals (M, 2), px, never below two thousandths of a pixel."""
    length = np.linalg.norm(residuals, axis=-1)
    length = np.where(np.isfinite(length), length, np.inf)
    return max(float(np.median(length)) / MEDIAN_OF_RAYLEIGH, SMALLEST_SCALE_PX)


def _cauchy(residuals: Array) -> Array:
    length = np.linalg.norm(residuals, axis=-1)
    return np.where(np.isfinite(length), 1 / (1 + (length / (CAUCHY_SIGMAS * scale_px(residuals))) ** 2), 0.0)
