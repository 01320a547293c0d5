"""Which lens model the photographs call for: the leanest whose error on views that were left out is as small as any.

More coefficients always fit the views better that they were fitted to. Whether they describe the lens shows on views that they
never saw: the camera and the board are fitted to the others, and only the pose of each held-out view is its own. Whether pictures were
read line by line while the board moved shows in the residuals: a motion in each view then explains much of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dishmap.camera import elimination as el
from dishmap.camera.board import BoardView
from dishmap.camera.calibrate import WEAK_TURN_RAD, Calibration, calibrate, largest_turn_rad
from dishmap.camera.problem import READOUTS
from dishmap.errors import CameraError, MeasurementError

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

# From lean to rich.
CANDIDATES = ("opencv5", "fisheye", "opencv8", "opencv12")
FOLDS = 4
# Fewer views leave too few to fit to.
FEWEST_VIEWS = 8
# Motions that explain less than this part of the squared residuals, over what they would of pure noise, are not looked for.
MOTION_PART = 0.2
# A leaner lens is as good when it is worse by less than one standard error over the views, or by less than this part: then its own error
# is under a quarter of a corner's noise, less than what loosely determined coefficients do elsewhere in the picture.
SAME_PART = 0.03


@dataclass(frozen=True)
class Trial:
    """One lens model: rms over the views it was fitted to, and typical rms over views held out, px (NaN where it failed, with why)."""

    lens: str
    rms_px: float
    held_out_px: float
    problem: str = ""


@dataclass(frozen=True)
class LensChoice:
    """The lens chosen, every trial from lean to rich, and the reason in a sentence; for the readout too, where it was looked for."""

    lens: str
    trials: tuple[Trial, ...]
    reason: str
    readout_reason: str = ""


def choose_lens(
    views: Sequence[BoardView], width_px: int, height_px: int, flat: bool = False, readout: str = "auto", progress: Progress | None = None
) -> tuple[Calibration, LensChoice]:
    """Calibrate with each lens model and return the calibration of the one chosen.

    readout: as for `calibrate`, or "auto" to see whether motions explain the residuals. Raises InputError for impossible input, and the
    leanest lens's error when none can be fitted.
    """
    first = "global" if readout == "auto" else readout
    if len(views) < FEWEST_VIEWS:
        only = calibrate(views, width_px, height_px, CANDIDATES[0], flat, first)
        why = f"{len(views)} views are too few to hold some out ({FEWEST_VIEWS} are needed), so the leanest lens model was taken"
        return only, LensChoice(only.lens, (Trial(only.lens, only.rms_px, np.nan),), why)
    leanest = _leanest(views, width_px, height_px, flat, first)
    if leanest is not None and (turn := largest_turn_rad(leanest.bundle)) < WEAK_TURN_RAD:
        return leanest, _because_alike(leanest, turn)
    if readout == "auto" and leanest is not None:
        first, _ = likely_readout(leanest)
    steps = len(CANDIDATES) * (2 if readout == "auto" and first == "global" else 1)

    def tell(done: int) -> None:
        if progress:
            progress(done, steps)

    made, choice = _tried(views, width_px, height_px, flat, first, leanest, tell)
    if readout != "auto":
        return made, choice
    before = leanest or made
    # a lens that is too lean can hide motions
    if first == "global" and (second := likely_readout(made)[0]) != "global":
        before, (made, choice) = made, _tried(views, width_px, height_px, flat, second, leanest, lambda done: tell(len(CANDIDATES) + done))
    tell(steps)
    return made, replace(choice, readout_reason=_why_readout(made, before))


def _why_readout(made: Calibration, before: Calibration) -> str:
    """How pictures were read, in words; before: a calibration without motions."""
    if made.motion_sigma_mm:
        return (
            f"pictures were read by {made.readout} while board or camera moved: with a motion in each view the noise of a coordinate is "
            f"{made.sigma_px:.2g} px, without {before.sigma_px:.2g} px"
        )
    part = 0.0 if made.readout != "global" else max(likely_readout(made)[1], 0.0)
    return f"pictures were taken at once, or nothing moved: motions meanwhile would explain {part:.0%} of the squared residuals"


def _tried(
    views: Sequence[BoardView],
    width_px: int,
    height_px: int,
    flat: bool,
    readout: str,
    leanest: Calibration | None,
    tell: Callable[[int], None],
) -> tuple[Calibration, LensChoice]:
    """Every lens model with one readout; leanest: that of the leanest, where it was made before."""
    made: dict[str, Calibration] = {}
    problems: dict[str, MeasurementError | CameraError] = {}
    errors: dict[str, Array] = {}

    def tried(lens: str) -> tuple[Calibration, Array] | MeasurementError | CameraError:
        try:
            known = leanest is not None and (leanest.lens, leanest.readout) == (lens, readout)
            calibration = leanest if leanest and known else calibrate(views, width_px, height_px, lens, flat, readout)
            return calibration, held_out_errors(calibration, [view.name for view in views])
        except (MeasurementError, CameraError) as error:
            return error

    with ThreadPoolExecutor(max_workers=2) as pool:
        for done, (lens, result) in enumerate(zip(CANDIDATES, pool.map(tried, CANDIDATES), strict=True), start=1):
            if isinstance(result, tuple):
                made[lens], errors[lens] = result
            else:
                problems[lens] = result
            tell(done)
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


def likely_readout(made: Calibration) -> tuple[str, float]:
    """How pictures were read, judged by a calibration without motions, and what part of its squared residuals motions explain."""
    parts = {readout: motion_part(made, readout) for readout in READOUTS[1:]}
    best = max(parts, key=lambda readout: parts[readout])
    return best if parts[best] > MOTION_PART else "global", parts[best]


def motion_part(made: Calibration, readout: str) -> float:
    """Part of the squared residuals that a motion in each view would explain, to first order, over what it would of pure noise."""
    problem, bundle = replace(made.problem, readout=readout, motion_mm=0.1 * made.board.half_mm), made.bundle
    corners = problem.corners(bundle)
    equations = el.normal_equations(bundle, corners, problem.free(bundle), made.weights, problem.prior(bundle, corners))
    _, gain = el.best_step(equations)
    cost, count = float((equations.residual**2).sum()), 2 * float((made.weights > 0).sum())
    return (gain / cost if cost > 0 else 0.0) - bundle.motion.size / count


def _leanest(views: Sequence[BoardView], width_px: int, height_px: int, flat: bool, readout: str) -> Calibration | None:
    try:
        return calibrate(views, width_px, height_px, CANDIDATES[0], flat, readout)
    except (MeasurementError, CameraError):
        return None


def _because_alike(only: Calibration, turn_rad: float) -> LensChoice:
    """Why the leanest lens is taken where all views show the board from nearly one side.

    Errors of the print then lie at the same places of all pictures, and a richer lens would learn them, held-out views or not.
    """
    why = (
        f"the board's directions differ by {np.degrees(turn_rad):.0f} degrees only, so that a richer lens model would learn the "
        "errors of the print; the leanest was taken"
    )
    return LensChoice(only.lens, (Trial(only.lens, only.rms_px, np.nan),), why)


def held_out_errors(calibration: Calibration, names: Sequence[str]) -> Array:
    """Rms residual (V,), px, of each view named when camera and board come from views of other folds; NaN for views not used.

    What the view's own pose and motion take out of its residuals is put back.
    """
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
        fitted = problem.of_views([problem.views[i] for i in train]).solve(bundle.of_views(fold != k), weights, near=True)
        rest = replace(problem.of_views([problem.views[i] for i in held]), print_mm=0.0)
        start = replace(bundle.of_views(fold == k).with_shared(fitted.shared), print_mm=fitted.print_mm)
        inside = np.concatenate([used[i] for i in held]).astype(float)
        posed = rest.solve(start, inside, rest.free(start, camera=False), near=True)
        corners = rest.corners(posed)
        square = (posed.residuals(corners) ** 2).sum(axis=1)
        for i, s in zip(held, corners.slices, strict=True):
            own = 12 if problem.motion_mm else 6
            rms = float(np.sqrt(square[s][used[i]].mean() / max(1 - own / (2 * used[i].sum()), 0.1)))
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
