"""A camera from photographs of a flat board: Zhang's method (the paper's 4.1), with the covariance of its parameters.

A start without distortion is searched over focal lengths; a robust bundle adjustment brings it near; views and corners that
do not fit are then left out or weighed down by name, and least squares over the rest gives the answer, with the bends of the board.
The covariance has poses and bends marginalised out and is enlarged where residuals are correlated within a view: a board bent
by hand or a moved camera shifts neighbouring corners together, so that more corners do not help as much as plain least
squares believes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dishmap.camera import elimination as el
from dishmap.camera.adjustment import ROUNDING_PX
from dishmap.camera.board import SHAPE_TERMS, BoardShape, BoardView
from dishmap.camera.bundle import Bundle
from dishmap.camera.learning import learnt
from dishmap.camera.model import Camera
from dishmap.camera.planar import planar_poses
from dishmap.camera.problem import READOUTS, Problem, problem_of
from dishmap.camera.screening import CHECK_INPUT, FEWEST_VIEWS, corner_weights, outlier_names, screened
from dishmap.errors import FitError, InputError, MeasurementError
from dishmap.transforms import Pose, angle_between_rad

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Screened = tuple[Problem, Bundle, tuple[Mask, ...], Array, dict[str, str]]

# name -> lens model and number of coefficients
LENSES = {
    "opencv4": ("opencv", 4),
    "opencv5": ("opencv", 5),
    "opencv8": ("opencv", 8),
    "opencv12": ("opencv", 12),
    "fisheye": ("fisheye", 4),
}
FEWEST_CORNERS = 12
# A planar start needs a board that is flat to this part of its size.
FLATNESS = 0.1
# Focal lengths tried for the start, in units of the longer side: from 120 degrees across to a long lens.
START_FOCAL = {"opencv": np.geomspace(0.3, 20.0, 11), "fisheye": np.geomspace(0.2, 3.0, 8)}
# Views must show the board in directions that differ by this much, or focal length and distance cannot be told apart. Where they differ
# by less than WEAK_TURN_RAD curves of the print look like perspective, and are estimated, so that sigmas know of them.
SMALLEST_TURN_RAD = np.radians(3.0)
WEAK_TURN_RAD = np.radians(15.0)
# Beyond this part of the focal length the sigma of focal length or principal point makes a camera useless. The noise is
# taken as at least what real photographs have, so that copies of one sharp view do not pass.
LARGEST_SIGMA, LEAST_NOISE_PX = 0.02, 0.05
# A camera that misses by more than this part of the picture's side is none: corners and board do not belong together.
LARGEST_SIGMA_OF_SIDE = 0.005
# Convergence: a remaining step under a tenth of the smallest error that could matter.
LARGEST_STEP_SIGMAS = 0.1
WEAK_VIEWS, WEAK_COVERAGE = 8, 0.4
# A focal length that changes by half a percent from view to view explains this part of the residuals; of noise, one parameter of
# 100 explains 1 %, and of boards bent anew in each view some 5 %.
UNSTABLE_PART = 0.2
COVERAGE_CELLS = 8
# Noise is taken as independent until views' scores are this many sigmas larger or smaller than independent noise makes them: to enlarge
# sigmas by chance whenever scores happen to be large would make them 3 % too large on average.
CLUSTERED_SIGMAS = 2.0


@dataclass(frozen=True)
class Calibration:
    """A calibrated camera, and what it was made from.

    camera: with covariance; lens: one of LENSES. views: those used, with all their corners; poses: camera_from_board of each;
    used: which corners of each view took part (N,); view_weight (V,): 1, or less where a view is noisier than the others;
    residuals_px: measured minus projected (N, 2) of each view; view_rms_px (V,) and rms_px: root mean square of the 2D residual over
    used corners, as OpenCV's. sigma_px: noise of one coordinate. inflation: factor by which sigmas were enlarged, on
    average, for correlation within views. coverage: part of the picture where corners were seen. rejected: name and reason of
    views left out. notes: sentences on what makes this calibration weak. board: how the board is bent. expected (P,): what the
    prior on the camera is about. independent: part of the noise that was taken as independent from corner to corner. readout: how a
    picture was read; motion (V, 6): by how much the board turned about its middle (radians) and moved (mm) meanwhile, in the camera's
    frame; motion_sigma_mm: how far it typically moved.
    """

    camera: Camera
    views: tuple[BoardView, ...]
    poses: tuple[Pose, ...]
    used: tuple[NDArray[np.bool_], ...]
    residuals_px: tuple[Array, ...]
    view_rms_px: Array
    rms_px: float
    sigma_px: float
    inflation: float
    coverage: float
    rejected: dict[str, str]
    notes: tuple[str, ...]
    lens: str
    view_weight: Array
    board: BoardShape
    expected: Array
    independent: float
    readout: str
    motion: Array
    motion_sigma_mm: float

    @property
    def view_names(self) -> tuple[str, ...]:
        """Names of the views that were used."""
        return tuple(view.name for view in self.views)

    @property
    def outliers(self) -> dict[str, list[str]]:
        """Corners that were left out, in words, of each view that has any."""
        rows = zip(self.views, self.used, self.residuals_px, strict=True)
        return {view.name: outlier_names(view, used, residual) for view, used, residual in rows if not used.all()}

    @property
    def problem(self) -> Problem:
        """The least-squares problem that this calibration solves."""
        size, board = (self.camera.width_px, self.camera.height_px), self.board
        frame = (board.middle_mm, board.half_mm, board.points_mm, self.expected, not board.free, self.readout)
        return Problem(self.views, size, *frame, self.sigma_px, board.print_sigma_mm, self.motion_sigma_mm, board.curved)

    @property
    def bundle(self) -> Bundle:
        """Its solution."""
        rotation, translation = np.stack([p.rotation for p in self.poses]), np.stack([p.translation_mm for p in self.poses])
        return Bundle(replace(self.camera, covariance=None), rotation, translation, self.board.shape_mm, self.board.print_mm, self.motion)

    @property
    def weights(self) -> Array:
        """Weight of each corner of all views (M,)."""
        return corner_weights(self.used, self.view_weight)


def calibrate(
    views: Sequence[BoardView], width_px: int, height_px: int, lens: str = "opencv5", flat: bool = False, readout: str = "global"
) -> Calibration:
    """Calibrate a camera from views of a board.

    views: corners and where they are printed, at least 3 views in different directions. width_px, height_px: size of the
    photographs. lens: one of LENSES (`opencv5` has k1, k2, p1, p2, k3). flat: the board is flat and its print exact (glass); otherwise
    its bends, stretch and printed errors are learnt. readout: "rows" or "columns" where a picture is read line by line while the board
    may move, in which case a motion is learnt for each view. Raises InputError for impossible input; MeasurementError (or FitError) when
    the views do not determine a camera.
    """
    if lens not in LENSES:
        raise InputError(f"unknown lens {lens!r}; use one of {', '.join(LENSES)}")
    if readout not in READOUTS:
        raise InputError(f"unknown readout {readout!r}; use one of {', '.join(READOUTS)}")
    model, count = LENSES[lens]
    camera = Camera(width_px, height_px, np.full(2, float(width_px)), np.array([width_px - 1, height_px - 1]) / 2, np.zeros(count), model)
    _check_views(views, camera)
    problem = problem_of(views, camera, flat, readout)
    bundle = _start(camera, problem)
    problem = replace(problem, expected=bundle.camera.parameters)
    first = np.zeros(len(bundle.shared), dtype=bool)
    first[[0, 1, 4, 5]] = True  # first what bends most: focal lengths and two radial terms
    for free in (first, problem.free(bundle)):
        bundle = problem.solve(bundle, free=free, robust=True)
    problem = replace(problem, curved=largest_turn_rad(bundle) < WEAK_TURN_RAD)
    return _result(*_learnt(*screened(problem, bundle)), lens)


def _learnt(problem: Problem, bundle: Bundle, used: tuple[Mask, ...], weight: Array, rejected: dict[str, str]) -> Screened:
    """Learn noise, print errors and motions, then screen again: against what is left, outliers stand out more."""
    problem, bundle = learnt(problem, bundle, corner_weights(used, weight))
    problem, bundle, used, weight, more = screened(problem, bundle, near=True)
    problem, bundle = learnt(problem, bundle, corner_weights(used, weight))
    return problem, bundle, used, weight, rejected | more


def _check_views(views: Sequence[BoardView], camera: Camera) -> None:
    if len(views) < FEWEST_VIEWS:
        raise InputError(
            f"{len(views)} view(s) of the board were given; at least {FEWEST_VIEWS} in different directions are needed, better 10 to 20"
        )
    if len({view.name for view in views}) < len(views):
        raise InputError("two views of the board have the same name; give each its own")
    for view in views:
        if len(view.pixels) < FEWEST_CORNERS:
            raise InputError(f"view {view.name} has {len(view.pixels)} corners; at least {FEWEST_CORNERS} are needed")
        if not camera.contains(view.pixels).all():
            raise InputError(
                f"view {view.name} has corners outside a picture of {camera.width_px}x{camera.height_px} px; is it of another size?"
            )
        spread = np.ptp(view.board_mm, axis=0)
        if min(spread[:2]) < FLATNESS * max(spread[:2]) or spread[2] > FLATNESS * max(spread[:2]):
            raise InputError(f"the corners of view {view.name} are not spread over a flat board in x and y (z = 0)")


def _start(camera: Camera, problem: Problem) -> Bundle:
    """The focal length, of a list, with which planar poses fit the typical corner best, and these poses."""
    corners = problem.joined
    best: tuple[float, Bundle] | None = None
    for ratio in START_FOCAL[camera.model]:
        focal = np.full(2, ratio * max(camera.width_px, camera.height_px))
        trial = camera.with_parameters(np.concatenate([focal, camera.parameters[2:]]))
        rays = trial.unproject(corners.pixels)
        if not np.isfinite(rays).all():
            continue
        bundle = problem.start(trial, *planar_poses(rays, corners.board_mm, corners.bounds[:-1]))
        length = np.linalg.norm(bundle.residuals(corners), axis=1)
        score = float(np.median(np.where(np.isfinite(length), length, np.inf)))
        if best is None or score < best[0]:
            best = (score, bundle)
    if best is None or not np.isfinite(best[0]):
        raise FitError("no focal length fits the views; do corners and board belong together, row by row?")
    # where single poses put corners behind the camera there is nothing to adjust from
    return best[1]


def _result(problem: Problem, bundle: Bundle, used: tuple[Mask, ...], weight: Array, rejected: dict[str, str], lens: str) -> Calibration:
    corners, weights, free = problem.corners(bundle), corner_weights(used, weight), problem.free(bundle)
    residuals = bundle.residuals(corners)
    square = (residuals**2).sum(axis=1)
    good, sigma = weights > 0, problem.noise_px
    if sigma > LARGEST_SIGMA_OF_SIDE * max(bundle.camera.width_px, bundle.camera.height_px):
        raise MeasurementError(f"the best camera misses the corners by {sigma:.3g} px; {CHECK_INPUT}")
    equations = el.normal_equations(bundle, corners, free, weights, problem.prior(bundle, corners))
    _check_turn(bundle)
    covariance, inflation, independent = shared_covariance(bundle.camera, equations, sigma)
    if el.step_in_sigmas(equations, max(sigma, LEAST_NOISE_PX)) > LARGEST_STEP_SIGMAS:
        raise FitError("the calibration did not reach its best fit; use more views, or a lens with fewer coefficients")
    parts = [residuals[s] for s in corners.slices]
    coverage = _coverage(bundle.camera, corners.pixels[good])
    count, terms = len(bundle.camera.parameters), len(SHAPE_TERMS)
    shape = np.zeros((terms, terms))
    shape[np.ix_(free[count:], free[count:])] = covariance[count:, count:]
    return Calibration(
        camera=replace(bundle.camera, covariance=covariance[:count, :count]),
        views=problem.views,
        poses=tuple(Pose(r, t) for r, t in zip(bundle.rotation, bundle.translation_mm, strict=True)),
        used=used,
        residuals_px=tuple(parts),
        view_rms_px=np.array([np.sqrt((part[u] ** 2).sum(axis=1).mean()) for part, u in zip(parts, used, strict=True)]),
        rms_px=float(np.sqrt(square[good].mean())),
        sigma_px=sigma,
        inflation=inflation,
        coverage=coverage,
        rejected=rejected,
        notes=(*_notes(bundle, coverage), *_unstable_focal(bundle, equations, float((weights * square)[good].sum()))),
        lens=lens,
        view_weight=weight,
        board=BoardShape(
            *(problem.middle_mm, problem.half_mm, bundle.shape_mm, shape, problem.points_mm, bundle.print_mm),
            *(problem.print_mm, not problem.flat),
        ),
        expected=problem.expected,
        independent=independent,
        readout=problem.readout,
        motion=bundle.motion,
        motion_sigma_mm=problem.motion_mm,
    )


def largest_turn_rad(bundle: Bundle) -> float:
    """The largest angle between the board's normals in any two views."""
    normals = bundle.rotation[:, :, 2]
    return float(angle_between_rad(normals[:, None], normals[None]).max())


def _check_turn(bundle: Bundle) -> None:
    turn = largest_turn_rad(bundle)
    if turn < SMALLEST_TURN_RAD:
        raise MeasurementError(
            f"all views show the board in one direction (within {np.degrees(turn):.1f} degrees), so focal length and distance cannot "
            "be told apart; tilt the board by 20 to 40 degrees to different sides"
        )


def shared_covariance(camera: Camera, equations: el.NormalEquations, sigma_px: float) -> tuple[Array, float, float]:
    """Covariance of camera parameters and bends with the poses marginalised out; factor of its sigmas; independent part of the noise.

    The factor is by how much clustering of the noise within views enlarges sigmas on average.
    In coordinates where independent noise gives the unit matrix, each view adds the outer product of its score, adjusted for
    its leverage (CR2 of Bell and McCaffrey 2002: unbiased if corners are independent). With 10 to 20 views the sum is noisy, so it is
    shrunk towards a multiple of the unit matrix by the amount that its own scatter calls for (Ledoit and Wolf 2004). Where its trace is
    what independent noise makes it, nothing is enlarged.
    """
    known = el.marginals(equations)
    scale = np.sqrt(np.diag(known.covariance))
    values, vectors = np.linalg.eigh(known.covariance / np.outer(scale, scale))
    values = np.maximum(values, 1e-30)
    root = scale[:, None] * vectors * np.sqrt(values)  # root @ root.T is the covariance for noise of 1 px
    _check_determined(camera, root, max(sigma_px, LEAST_NOISE_PX))
    if sigma_px < LEAST_NOISE_PX * 1e-6:  # simulated corners without noise: there is nothing to learn about correlation
        return sigma_px**2 * root @ root.T, 1.0, 1.0
    influence = known.influence / scale @ vectors / np.sqrt(values)
    views = range(len(equations.shared))
    scores = (
        np.stack([np.einsum("mij,mi->j", influence[at], equations.residual[at]) for at in (equations.view == v for v in views)]) / sigma_px
    )
    weighed = np.stack([np.einsum("mij,mik->jk", influence[at], influence[at]) for at in (equations.view == v for v in views)])
    leverage, axes = np.linalg.eigh(weighed)
    scores = np.einsum("vij,vj,vkj,vk->vi", axes, 1 / np.sqrt(np.maximum(1 - leverage, 1e-6)), axes, scores)
    spread = scores.T @ scores
    count, size = scores.shape
    mean = float(np.trace(spread)) / size
    if abs(mean - 1) < CLUSTERED_SIGMAS * np.sqrt(2 * (leverage**2).sum()) / size:
        return sigma_px**2 * (root @ root.T), 1.0, 1.0
    distance = float(((spread - mean * np.eye(size)) ** 2).sum())
    scatter = sum(float(((np.outer(s, s) * count - spread) ** 2).sum()) for s in scores) / count**2
    part = min(1.0, scatter / max(distance, 1e-300))
    shrunk = ((1 - part) * spread + part * mean * np.eye(size)) * max(1.0, 1 / mean)
    covariance = sigma_px**2 * root @ shrunk @ root.T
    return (covariance + covariance.T) / 2, float(np.sqrt(max(1.0, mean))), part


def _check_determined(camera: Camera, root: Array, noise_px: float) -> None:
    sigma = noise_px * np.linalg.norm(root[:4], axis=1)
    worst = int(np.argmax(sigma))
    if not sigma[worst] <= LARGEST_SIGMA * camera.focal_px.min():
        raise MeasurementError(
            f"the views do not determine {camera.parameter_names[worst]} (sigma {sigma[worst]:.3g} px at a focal length of "
            f"{camera.focal_px.min():.4g} px); add views with the board tilted by 20 to 40 degrees to different sides and filling the "
            "picture, or use a lens with fewer coefficients"
        )


def _unstable_focal(bundle: Bundle, equations: el.NormalEquations, cost_px2: float) -> tuple[str, ...]:
    """A note if a focal length of its own for each view would explain much of what is left: autofocus does that."""
    matrices, sides, _, _ = el.reduced(equations)
    along = np.zeros(matrices.shape[-1])
    along[:2] = bundle.camera.focal_px / bundle.camera.focal_px.mean()
    side, information = sides @ along, np.maximum(along @ matrices @ along, 1e-300)
    explained = float((side**2 / information).sum() / max(cost_px2, 1e-300))
    if explained < UNSTABLE_PART or cost_px2 < len(sides) * ROUNDING_PX:
        return ()
    spread = float(np.std(side / information) / bundle.camera.focal_px.mean())
    return (
        f"the focal length seems to differ from view to view by {spread:.1%}; switch off autofocus, zoom and image stabilisation "
        "and photograph again",
    )


def _coverage(camera: Camera, pixels: Array) -> float:
    """Part of the picture's 8x8 cells in which a corner was seen."""
    cell = np.floor((pixels + 0.5) / np.array([camera.width_px, camera.height_px]) * COVERAGE_CELLS).astype(int)
    return len(np.unique(np.clip(cell, 0, COVERAGE_CELLS - 1), axis=0)) / COVERAGE_CELLS**2


def _notes(bundle: Bundle, coverage: float) -> tuple[str, ...]:
    notes = []
    if len(bundle.rotation) < WEAK_VIEWS:
        notes.append(f"only {len(bundle.rotation)} views were used; 10 to 20 make the uncertainty itself trustworthy")
    if (turn := largest_turn_rad(bundle)) < WEAK_TURN_RAD:
        notes.append(
            f"the board's directions differ by {np.degrees(turn):.0f} degrees at most; 40 or more fix the focal length better (from nearly "
            "one side a curved print looks like perspective)"
        )
    if coverage < WEAK_COVERAGE:
        notes.append(f"corners cover {coverage:.0%} of the picture; the camera is extrapolated elsewhere")
    width, height = bundle.camera.width_px, bundle.camera.height_px
    whole = np.stack(np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 9)), axis=-1)
    lost = float(np.isnan(bundle.camera.unproject(whole)[..., 0]).mean())
    if lost:
        notes.append(
            f"the lens model ends inside the picture ({lost:.0%} of it has no direction); add views there or use fewer coefficients"
        )
    return tuple(notes)
