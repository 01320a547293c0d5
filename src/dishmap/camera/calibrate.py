"""A camera from photographs of a flat board: Zhang's method (the paper's 4.1), with the covariance of its parameters.

A start without distortion is searched over focal lengths; a robust bundle adjustment brings it near; views and corners that
do not fit are then left out by name, and least squares over the rest gives the answer. The covariance has the poses
marginalised out and is enlarged where residuals are correlated within a view: a bent board or a moved camera shifts
neighbouring corners together, so that more corners do not help as much as plain least squares believes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dishmap.camera import bundle as ba
from dishmap.camera.bundle import BoardCorners, Bundle, Prior
from dishmap.camera.chessboard import BoardView
from dishmap.camera.model import Camera
from dishmap.errors import FitError, InputError, MeasurementError
from dishmap.transforms import Pose, angle_between_rad

Array = NDArray[np.float64]

# name -> lens model and number of coefficients
LENSES = {
    "opencv4": ("opencv", 4),
    "opencv5": ("opencv", 5),
    "opencv8": ("opencv", 8),
    "opencv12": ("opencv", 12),
    "fisheye": ("fisheye", 4),
}
FEWEST_VIEWS, FEWEST_CORNERS = 3, 12
# A planar start needs a board that is flat to this part of its size.
FLATNESS = 0.1
# Focal lengths tried for the start, in units of the longer side: from 120 degrees across to a long lens.
START_FOCAL = {"opencv": np.geomspace(0.3, 20.0, 11), "fisheye": np.geomspace(0.2, 3.0, 8)}
# A view is left out when its rms is this many times the median view's, or when so many of its corners are outliers.
BAD_VIEW_RATIO, BAD_VIEW_OUTLIERS = 4.0, 0.25
# A corner is an outlier beyond this many robust sigmas of its own view: Gaussian noise gets there once in 6e7 corners.
OUTLIER_SIGMAS = 6.0
MOST_ROUNDS = 20
# Views must show the board in directions that differ by this much, or focal length and distance cannot be told apart.
SMALLEST_TURN_RAD = np.radians(3.0)
WEAK_TURN_RAD = np.radians(15.0)
# Beyond this part of the focal length the sigma of focal length or principal point makes a camera useless. The noise is
# taken as at least what real photographs have, so that copies of one sharp view do not pass.
LARGEST_SIGMA, LEAST_NOISE_PX = 0.02, 0.05
# A camera that misses by more than this part of the picture's side is none: corners and board do not belong together.
LARGEST_SIGMA_OF_SIDE = 0.005
CHECK_INPUT = "are corners and board in the same order, and all photographs by one camera with fixed focus and zoom?"
# Convergence: a remaining step under a tenth of the smallest error that could matter.
LARGEST_STEP_SIGMAS = 0.1
WEAK_VIEWS, WEAK_COVERAGE = 8, 0.4
COVERAGE_CELLS = 8


@dataclass(frozen=True)
class Calibration:
    """A calibrated camera, and what it was made from.

    camera: with covariance. views: those used, with all their corners; poses: camera_from_board of each; used: which corners
    of each view took part (N,); residuals_px: measured minus projected (N, 2) of each view; view_rms_px (V,) and rms_px: root mean
    square of the 2D residual over used corners, as OpenCV's. sigma_px: noise of one coordinate. inflation: factor by which
    sigmas were enlarged, on average, for correlation within views. coverage: part of the picture where corners were seen.
    rejected: name and reason of views left out. notes: sentences on what makes this calibration weak.
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

    @property
    def view_names(self) -> tuple[str, ...]:
        """Names of the views that were used."""
        return tuple(view.name for view in self.views)


def calibrate(views: Sequence[BoardView], width_px: int, height_px: int, lens: str = "opencv5") -> Calibration:
    """Calibrate a camera from views of a flat board.

    views: corners and where they are printed, at least 3 views in different directions. width_px, height_px: size of the
    photographs. lens: one of LENSES (`opencv5` has k1, k2, p1, p2, k3).
    Raises InputError for impossible input; MeasurementError (or FitError) when the views do not determine a camera.
    """
    if lens not in LENSES:
        raise InputError(f"unknown lens {lens!r}; use one of {', '.join(LENSES)}")
    model, count = LENSES[lens]
    camera = Camera(width_px, height_px, np.full(2, float(width_px)), np.array([width_px - 1, height_px - 1]) / 2, np.zeros(count), model)
    _check_views(views, camera)
    corners = _joined(views)
    bundle = _start(camera, corners)
    expected = bundle.camera.parameters
    free = np.zeros(len(camera.parameters), dtype=bool)
    free[[0, 1, 4, 5]] = True  # first what bends most: focal lengths and two radial terms
    bundle = ba.adjust(bundle, corners, free, _prior(expected, bundle, corners), robust=True)
    free[:] = True
    bundle = ba.adjust(bundle, corners, free, _prior(expected, bundle, corners), robust=True)
    bundle, kept, used, rejected = _without_outliers(bundle, list(views), expected)
    return _result(bundle, kept, used, rejected, expected)


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


def _joined(views: Sequence[BoardView]) -> BoardCorners:
    bounds = np.cumsum([0, *(len(view.pixels) for view in views)])
    return BoardCorners(np.concatenate([v.pixels for v in views]), np.concatenate([v.board_mm for v in views]), bounds)


def _start(camera: Camera, corners: BoardCorners) -> Bundle:
    """The focal length, of a list, with which planar poses fit the typical corner best, and these poses."""
    best: tuple[float, Bundle] | None = None
    for ratio in START_FOCAL[camera.model]:
        focal = np.full(2, ratio * max(camera.width_px, camera.height_px))
        trial = camera.with_parameters(np.concatenate([focal, camera.parameters[2:]]))
        rays = trial.unproject(corners.pixels)
        if not np.isfinite(rays).all():
            continue
        bundle = Bundle(trial, *_planar_poses(rays, corners))
        length = np.linalg.norm(bundle.residuals(corners), axis=1)
        score = float(np.median(np.where(np.isfinite(length), length, np.inf)))
        if best is None or score < best[0]:
            best = (score, bundle)
    if best is None or not np.isfinite(best[0]):
        raise FitError("no focal length fits the views; do corners and board belong together, row by row?")
    # where single poses put corners behind the camera there is nothing to adjust from
    return best[1]


def _prior(expected: Array, bundle: Bundle, corners: BoardCorners) -> Prior:
    camera = bundle.camera
    radius = float((np.linalg.norm(corners.pixels - camera.principal_px, axis=1) / camera.focal_px.min()).max())
    return Prior(expected, radius, ba.scale_px(bundle.residuals(corners)))


def _planar_poses(rays: Array, corners: BoardCorners) -> tuple[Array, Array]:
    """Rotations (V, 3, 3) and translations (V, 3) of planes from unit rays (M, 3) of their corners.

    By the homography from board to rays (Zhang 2000, section 3.1 and appendix C).
    """
    starts, counts = corners.bounds[:-1], np.diff(corners.bounds)
    middle = np.add.reduceat(corners.board_mm, starts) / counts[:, None]
    plane = corners.board_mm - middle[corners.view]
    size = np.sqrt(np.add.reduceat((plane**2).sum(axis=1), starts) / counts)
    plane = np.concatenate([plane[:, :2] / size[corners.view, None], np.ones((len(rays), 1))], axis=1)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    products = across[:, :, None, :, None] * (plane[:, :, None] * plane[:, None, :])[:, None, :, None, :]
    system = np.add.reduceat(products.reshape(-1, 81), starts).reshape(-1, 9, 9)
    homography = np.linalg.eigh(system)[1][:, :, 0].reshape(-1, 3, 3)
    ahead = np.add.reduceat((rays * np.einsum("mij,mj->mi", homography[corners.view], plane)).sum(axis=1), starts)
    homography *= np.where(ahead < 0, -1.0, 1.0)[:, None, None]
    first, second, third = np.moveaxis(homography, 2, 0)
    scale = np.sqrt(np.maximum(np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1), 1e-300))[:, None]
    u, _, vt = np.linalg.svd(np.stack([first, second, np.cross(first, second) / scale], axis=-1) / scale[..., None])
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    rotation = u @ vt
    return rotation, size[:, None] * third / scale - np.einsum("vij,vj->vi", rotation, middle)


def _without_outliers(
    bundle: Bundle, views: list[BoardView], expected: Array
) -> tuple[Bundle, list[BoardView], list[NDArray[np.bool_]], dict[str, str]]:
    """Least squares over what fits: views and corners that do not are left out, until the choice no longer changes."""
    rejected: dict[str, str] = {}
    free = np.ones(len(bundle.camera.parameters), dtype=bool)
    used: list[NDArray[np.bool_]] = []
    for _ in range(MOST_ROUNDS):
        residuals = bundle.residuals(_joined(views))
        parts = [residuals[s] for s in _joined(views).slices]
        bad = _bad_views([view.name for view in views], parts)
        keep = [view.name not in bad for view in views]
        rejected |= bad
        if sum(keep) < FEWEST_VIEWS:
            name, reason = next(iter(rejected.items()))
            raise MeasurementError(f"fewer than {FEWEST_VIEWS} of the views fit together (first left out: {name}, {reason}); {CHECK_INPUT}")
        before, used = used, [_inliers(part) for part, k in zip(parts, keep, strict=True) if k]
        views = [view for view, k in zip(views, keep, strict=True) if k]
        if not bad and len(before) == len(used) and all((a == b).all() for a, b in zip(before, used, strict=True)):
            break
        bundle = Bundle(bundle.camera, bundle.rotation[keep], bundle.translation_mm[keep])
        corners = _joined(views)
        bundle = ba.adjust(bundle, corners, free, _prior(expected, bundle, corners), np.concatenate(used).astype(float))
    # the prior is only as weak as the noise is small, and the noise is known now
    bundle = ba.adjust(bundle, corners, free, _prior(expected, bundle, corners), np.concatenate(used).astype(float))
    return bundle, views, used, rejected


def _bad_views(names: Sequence[str], parts: Sequence[Array]) -> dict[str, str]:
    """Views that do not fit, with the reason, worst first; only the worst of them, as it spoils the others."""
    scales = np.array([ba.scale_px(part) for part in parts])
    outliers = np.array([1 - _inliers(part).mean() for part in parts])
    worst = int(np.argmax(scales))
    if scales[worst] > BAD_VIEW_RATIO * np.median(scales) or np.isinf(scales[worst]):
        size = f"{scales[worst]:.2g} px" if np.isfinite(scales[worst]) else "beyond all bounds"
        return {names[worst]: f"its residuals ({size}) are over {BAD_VIEW_RATIO:g} times those of the typical view"}
    worst = int(np.argmax(outliers))
    if outliers[worst] > BAD_VIEW_OUTLIERS:
        return {names[worst]: f"{outliers[worst]:.0%} of its corners are outliers"}
    return {}


def _inliers(residuals: Array) -> NDArray[np.bool_]:
    length = np.linalg.norm(residuals, axis=1)
    return np.asarray(np.isfinite(length) & (length <= OUTLIER_SIGMAS * ba.scale_px(residuals)))


def _result(
    bundle: Bundle, views: list[BoardView], used: list[NDArray[np.bool_]], rejected: dict[str, str], expected: Array
) -> Calibration:
    corners, weights = _joined(views), np.concatenate(used).astype(float)
    free = np.ones(len(bundle.camera.parameters), dtype=bool)
    residuals = bundle.residuals(corners)
    square = (residuals**2).sum(axis=1)
    degrees_of_freedom = 2 * weights.sum() - free.sum() - ba.POSE * len(views)
    sigma = float(np.sqrt(square[weights > 0].sum() / degrees_of_freedom))
    if sigma > LARGEST_SIGMA_OF_SIDE * max(bundle.camera.width_px, bundle.camera.height_px):
        raise MeasurementError(f"the best camera misses the corners by {sigma:.3g} px; {CHECK_INPUT}")
    equations = ba.normal_equations(bundle, corners, free, weights, _prior(expected, bundle, corners))
    _check_turn(bundle)
    covariance, inflation = _covariance(bundle.camera, equations, sigma)
    if ba.step_in_sigmas(equations, max(sigma, LEAST_NOISE_PX)) > LARGEST_STEP_SIGMAS:
        raise FitError("the calibration did not reach its best fit; use more views, or a lens with fewer coefficients")
    parts = [residuals[s] for s in corners.slices]
    view_rms = np.array([np.sqrt((part[u] ** 2).sum(axis=1).mean()) for part, u in zip(parts, used, strict=True)])
    coverage = _coverage(bundle.camera, corners.pixels[weights > 0])
    return Calibration(
        camera=replace(bundle.camera, covariance=covariance),
        views=tuple(views),
        poses=tuple(Pose(r, t) for r, t in zip(bundle.rotation, bundle.translation_mm, strict=True)),
        used=tuple(used),
        residuals_px=tuple(parts),
        view_rms_px=view_rms,
        rms_px=float(np.sqrt(square[weights > 0].mean())),
        sigma_px=sigma,
        inflation=inflation,
        coverage=coverage,
        rejected=rejected,
        notes=_notes(bundle, coverage),
    )


def _largest_turn_rad(bundle: Bundle) -> float:
    """The largest angle between the board's normals in any two views."""
    normals = bundle.rotation[:, :, 2]
    return float(angle_between_rad(normals[:, None], normals[None]).max())


def _check_turn(bundle: Bundle) -> None:
    turn = _largest_turn_rad(bundle)
    if turn < SMALLEST_TURN_RAD:
        raise MeasurementError(
            f"all views show the board in one direction (within {np.degrees(turn):.1f} degrees), so focal length and distance cannot "
            "be told apart; tilt the board by 20 to 40 degrees to different sides"
        )


def _covariance(camera: Camera, equations: ba.NormalEquations, sigma_px: float) -> tuple[Array, float]:
    """Covariance of the camera parameters with the poses marginalised out, and the mean factor of its sigmas for clustering.

    In coordinates where independent noise gives the unit matrix, each view adds the outer product of its score, adjusted for
    its leverage (CR2 of Bell and McCaffrey 2002: unbiased if corners are independent). With 10 to 20 views the sum is noisy, so it is
    shrunk towards a multiple of the unit matrix by the amount that its own scatter calls for (Ledoit and Wolf 2004).
    """
    matrices, sides, _, _ = ba.reduced(equations)
    information = matrices.sum(axis=0) + np.diag(equations.prior)
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    root = scale[:, None] * vectors / np.sqrt(np.maximum(values, 1e-30))  # root @ root.T inverts the information
    _check_determined(camera, root, max(sigma_px, LEAST_NOISE_PX))
    if sigma_px < LEAST_NOISE_PX * 1e-6:  # simulated corners without noise: there is nothing to learn about correlation
        return sigma_px**2 * root @ root.T, 1.0
    scores = sides @ root / sigma_px
    leverage, axes = np.linalg.eigh(np.swapaxes(root, 0, 1) @ matrices @ root)
    scores = np.einsum("vij,vj,vkj,vk->vi", axes, 1 / np.sqrt(np.maximum(1 - leverage, 1e-6)), axes, scores)
    spread = scores.T @ scores
    count, size = scores.shape
    mean = float(np.trace(spread)) / size
    distance = float(((spread - mean * np.eye(size)) ** 2).sum())
    scatter = sum(float(((np.outer(s, s) * count - spread) ** 2).sum()) for s in scores) / count**2
    part = min(1.0, scatter / max(distance, 1e-300))
    shrunk = ((1 - part) * spread + part * mean * np.eye(size)) * max(1.0, 1 / mean)
    covariance = sigma_px**2 * root @ shrunk @ root.T
    return (covariance + covariance.T) / 2, float(np.sqrt(max(1.0, mean)))


def _check_determined(camera: Camera, root: Array, noise_px: float) -> None:
    sigma = noise_px * np.linalg.norm(root[:4], axis=1)
    worst = int(np.argmax(sigma))
    if not sigma[worst] <= LARGEST_SIGMA * camera.focal_px.min():
        raise MeasurementError(
            f"the views do not determine {camera.parameter_names[worst]} (sigma {sigma[worst]:.3g} px at a focal length of "
            f"{camera.focal_px.min():.4g} px); add views with the board tilted by 20 to 40 degrees to different sides and filling the "
            "picture, or use a lens with fewer coefficients"
        )


def _coverage(camera: Camera, pixels: Array) -> float:
    """Part of the picture's 8x8 cells in which a corner was seen."""
    cell = np.floor((pixels + 0.5) / np.array([camera.width_px, camera.height_px]) * COVERAGE_CELLS).astype(int)
    return len(np.unique(np.clip(cell, 0, COVERAGE_CELLS - 1), axis=0)) / COVERAGE_CELLS**2


def _notes(bundle: Bundle, coverage: float) -> tuple[str, ...]:
    notes = []
    if len(bundle.rotation) < WEAK_VIEWS:
        notes.append(f"only {len(bundle.rotation)} views were used; 10 to 20 make the uncertainty itself trustworthy")
    if (turn := _largest_turn_rad(bundle)) < WEAK_TURN_RAD:
        notes.append(f"the board's directions differ by {np.degrees(turn):.0f} degrees at most; 40 or more fix the focal length better")
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
