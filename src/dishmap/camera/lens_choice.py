"""Which lens model the photographs call for: the leanest whose error on views that were left out is as small as any.

More coefficients always fit the views better that they were fitted to. Whether they describe the lens shows on views that they
never saw: the camera and the board's bends are fitted to the others, and only the pose of each held-out view is its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.board import BoardView
from dishmap.camera.calibrate import WEAK_TURN_RAD, Calibration, calibrate, largest_turn_rad
from dishmap.errors import CameraError, MeasurementError

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

# From lean to rich.
CANDIDATES = ("opencv5", "fisheye", "opencv8", "opencv12")
FOLDS = 4
# Fewer views leave too few to fit to.
FEWEST_VIEWS = 8
# A leaner lens is as good when it is worse by less than one standard error over the views, or by less than this part.
SAME_PART = 0.01


@dataclass(frozen=True)
class Trial:
    """One lens model: rms over the views it was fitted to, and typical rms over views held out, px (NaN where it failed, with why)."""

    lens: str
    rms_px: float
    held_out_px: float
    problem: str = ""


@dataclass(frozen=True)
class LensChoice:
    """The lens chosen, every trial from lean to rich, and the reason in a sentence."""

    lens: str
    trials: tuple[Trial, ...]
    reason: str


def choose_lens(
    views: Sequence[BoardView], width_px: int, height_px: int, flat: bool = False, progress: Progress | None = None
) -> tuple[Calibration, LensChoice]:
    """Calibrate with each lens model and return the calibration of the one chosen.

    Raises InputError for impossible input, and the leanest lens's error when none can be fitted.
    """
    if len(views) < FEWEST_VIEWS:
        only = calibrate(views, width_px, height_px, CANDIDATES[0], flat)
        why = f"{len(views)} views are too few to hold some out ({FEWEST_VIEWS} are needed), so the leanest lens model was taken"
        return only, LensChoice(only.lens, (Trial(only.lens, only.rms_px, np.nan),), why)
    leanest = _if_alike(views, width_px, height_px, flat)
    if leanest is not None:
        return leanest
    made: dict[str, Calibration] = {}
    problems: dict[str, MeasurementError | CameraError] = {}
    errors: dict[str, Array] = {}
    for done, lens in enumerate(CANDIDATES, start=1):
        try:
            made[lens] = calibrate(views, width_px, height_px, lens, flat)
            errors[lens] = held_out_errors(made[lens], [view.name for view in views])
        except (MeasurementError, CameraError) as error:
            problems[lens] = error
        if progress:
            progress(done, len(CANDIDATES))
    if not errors:
        raise problems[CANDIDATES[0]]
    lens, reason = _chosen(errors)
    trials = tuple(
        Trial(name, made[name].rms_px, float(np.exp(np.nanmean(np.log(errors[name])))))
        if name in errors
        else Trial(name, np.nan, np.nan, str(problems[name]))
        for name in CANDIDATES
    )
    return made[lens], LensChoice(lens, trials, reason)


def _if_alike(views: Sequence[BoardView], width_px: int, height_px: int, flat: bool) -> tuple[Calibration, LensChoice] | None:
    """The leanest lens where all views show the board from nearly one side.

    Errors of the print then lie at the same places of all pictures, and a richer lens would learn them, held-out views or not.
    """
    try:
        only = calibrate(views, width_px, height_px, CANDIDATES[0], flat)
    except (MeasurementError, CameraError):
        return None
    turn = largest_turn_rad(only.bundle)
    if turn >= WEAK_TURN_RAD:
        return None
    why = (
        f"the board's directions differ by {np.degrees(turn):.0f} degrees only, so that a richer lens model would learn the errors of the "
        "print; the leanest was taken"
    )
    return only, LensChoice(only.lens, (Trial(only.lens, only.rms_px, np.nan),), why)


def held_out_errors(calibration: Calibration, names: Sequence[str]) -> Array:
    """Rms residual (V,), px, of each view named when camera and bends come from views of other folds; NaN for views not used."""
    problem, bundle = calibration.problem, calibration.bundle
    number = {name: i for i, name in enumerate(names)}
    fold = np.array([number[name] % FOLDS for name in calibration.view_names])
    used = calibration.used
    out = np.full(len(names), np.nan)
    for k in range(FOLDS):
        held = np.flatnonzero(fold == k)
        if not len(held):
            continue
        train = [i for i in range(len(fold)) if fold[i] != k]
        weights = np.concatenate([used[i] * calibration.view_weight[i] for i in train])
        fitted = problem.of_views([problem.views[i] for i in train]).solve(bundle.of_views(fold != k), weights)
        rest = problem.of_views([problem.views[i] for i in held])
        start = bundle.of_views(fold == k).with_shared(fitted.shared)
        inside = np.concatenate([used[i] for i in held]).astype(float)
        posed = rest.solve(start, inside, rest.free(start, camera=False))
        corners = rest.corners(posed)
        square = (posed.residuals(corners) ** 2).sum(axis=1)
        for i, s in zip(held, corners.slices, strict=True):
            rms = float(np.sqrt(square[s][used[i]].mean()))
            out[number[calibration.view_names[i]]] = rms if np.isfinite(rms) else np.inf
    return out


def _chosen(errors: dict[str, Array]) -> tuple[str, str]:
    """The leanest lens that is as good as the best, and why. Ratios of errors view by view do not let one bad view decide."""
    logs = {lens: np.log(np.maximum(e, 1e-12)) for lens, e in errors.items()}
    best = min(logs, key=lambda lens: float(np.nanmean(logs[lens])))
    level = float(np.exp(np.nanmean(logs[best])))
    for lens, log in logs.items():
        worse = log - logs[best]
        worse = worse[~np.isnan(worse)]
        if not np.isfinite(worse).all():
            continue
        mean, error = float(worse.mean()), float(worse.std(ddof=1) / np.sqrt(len(worse)))
        if lens == best:
            near = "" if lens == next(iter(logs)) else ", and no leaner lens model comes near it"
            return lens, f"{lens} has the smallest error on views held out ({level:.3g} px){near}"
        if mean <= max(error, SAME_PART):
            by = f"{100 * np.expm1(mean):.2g} %, standard error {100 * error:.2g} %"
            return lens, f"{lens} is the leanest lens model whose error on views held out equals that of the best ({best}; worse by {by})"
    raise AssertionError("the best lens is among the lenses")
