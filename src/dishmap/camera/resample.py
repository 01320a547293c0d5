"""Does the claimed projection error hold? The calibration is made again many times from corners with new noise.

The new noise has the make-up that the claim assumes: a part that is independent from corner to corner, and a part that whole views
have in common, for which each view keeps its residuals but draws their sign (the wild cluster bootstrap of Cameron, Gelbach
and Miller 2008). Each refit is a full one, so that it also sees what a linear propagation leaves out.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.board import BoardView
from dishmap.camera.calibrate import Calibration
from dishmap.camera.compare_cameras import camera_difference, working_distance_mm
from dishmap.camera.model import Camera
from dishmap.camera.uncertainty import GRID, covered_area, picture_grid, projection_error

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

SAMPLES = 60


@dataclass(frozen=True)
class Resampled:
    """Claimed and sampled projection error on one grid.

    pixels (R, C, 2); predicted_px, sampled_px (R, C): rms length of the error of shapes at distance_mm; covered (R, C). ratio: sampled over
    predicted, rms over the covered area. samples: how many refits.
    """

    pixels: Array
    predicted_px: Array
    sampled_px: Array
    covered: NDArray[np.bool_]
    distance_mm: float
    samples: int

    @property
    def ratio(self) -> float:
        """Sampled over predicted, both rms over the covered area."""
        good = self.covered & np.isfinite(self.sampled_px) & np.isfinite(self.predicted_px)
        return float(np.sqrt((self.sampled_px[good] ** 2).mean() / (self.predicted_px[good] ** 2).mean()))

    @property
    def covered_rms_px(self) -> float:
        """Predicted error, rms over the covered area, px."""
        return float(np.sqrt(np.nanmean(self.predicted_px[self.covered] ** 2)))


def resample(
    calibration: Calibration,
    rng: np.random.Generator,
    samples: int = SAMPLES,
    progress: Progress | None = None,
    distance_mm: float | None = None,
) -> Resampled | None:
    """Refit `samples` times and compare the scatter of projections with the claimed one; None where the claim is of no error at all.

    distance_mm: where shapes are to be measured, by default where the boards were.
    """
    if calibration.sigma_px * calibration.inflation <= 0:
        return None
    camera, distance = calibration.camera, distance_mm or working_distance_mm(calibration)
    seen = np.concatenate([view.pixels[used] for view, used in zip(calibration.views, calibration.used, strict=True)])
    covered = covered_area(picture_grid(camera.width_px, camera.height_px), seen)
    square = np.zeros(covered.shape)
    count = np.zeros(covered.shape)

    def apart(own: np.random.Generator) -> Array:
        return camera_difference(camera, refit(calibration, own), distance, seen).length_px

    # a generator for each refit, so that the answer is the same in whatever order they end
    with ThreadPoolExecutor(max_workers=2) as pool:
        for done, length in enumerate(pool.map(apart, rng.spawn(samples)), start=1):
            good = np.isfinite(length)
            square[good] += length[good] ** 2
            count += good
            if progress:
                progress(done, samples)
    predicted = projection_error(camera, GRID, distance_mm=distance, covered=covered)
    sampled = np.sqrt(np.where(count > 0.5 * samples, square / np.maximum(count, 1), np.nan))
    return Resampled(predicted.pixels, predicted.sigma_px, sampled, covered, distance, samples)


def refit(calibration: Calibration, rng: np.random.Generator) -> Camera:
    """The camera that new noise on the fitted corners would have given."""
    problem, bundle = calibration.problem, calibration.bundle
    # residuals are smaller than the noise, as parameters were fitted to them
    square = np.concatenate([(residual**2).sum(axis=1) for residual in calibration.residuals_px])
    good = calibration.weights > 0
    grow = calibration.sigma_px * np.sqrt(2 * good.sum() / (calibration.weights * square)[good].sum())
    grow *= np.sqrt(len(problem.views) / (len(problem.views) - 1))
    common = np.sqrt(1 - calibration.independent) * grow
    own = np.sqrt(calibration.independent) * calibration.sigma_px * calibration.inflation
    views = [
        _drawn(view, residual, common * rng.choice([-1.0, 1.0]), own / np.sqrt(weight), rng)
        for view, residual, weight in zip(calibration.views, calibration.residuals_px, calibration.view_weight, strict=True)
    ]
    return problem.of_views(views).solve(bundle, calibration.weights, near=True).camera


def _drawn(view: BoardView, residual: Array, sign: float, sigma_px: float, rng: np.random.Generator) -> BoardView:
    known = np.where(np.isfinite(residual), residual, 0.0)
    return replace(view, pixels=view.pixels - known + sign * known + rng.normal(size=known.shape) * sigma_px)
