"""What a plan says, in numbers beside each other and in plain sentences: for the top of its report and for the terminal."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.difference.changes import LEAST_TARGETS
from dishmap.planning import Plan, print_bend_mm
from dishmap.quality import MEANING, Quality
from dishmap.surface.cloud import calibration_covariance_mm2
from dishmap.targets.bound import PIXEL_VARIANCE_PX2
from dishmap.verdict import Fact, Verdict, id_list, spread, targets

Array = NDArray[np.float64]

# A stroke as wide as a blurred line at half its height can just be told from its neighbours.
RESOLVED_BLURS = 2.355
# What the benchmarks of single targets reach to.
STEEPEST_DEG = 50.0
# Detection takes targets for clutter below this.
FAINT = 8.0
# The calibration's part of depth is worth a word above so many sigmas of the photograph's noise.
DOMINATING = 3.0
# A sigma of shape above this part of the stated amplitude says little more than the statement did.
HARDLY_SEEN = 0.5


@dataclass(frozen=True)
class Figure:
    """One quantity of a plan over its targets: key as in files, words, unit, values (N,)."""

    key: str
    words: str
    unit: str
    values: Array

    @property
    def median(self) -> float:
        """Over the targets."""
        return float(np.median(self.values))

    @property
    def worst(self) -> float:
        """The largest over the targets."""
        return float(np.max(self.values))


def rough(value: float) -> str:
    """Two digits, which is what a prediction deserves, without an exponent where a reader does not need one."""
    if not np.isfinite(value) or value == 0 or not 1e-4 <= abs(value) < 1e4:
        return f"{value:.1e}" if np.isfinite(value) and value else f"{value:g}"
    return f"{value:.{max(0, 1 - int(np.floor(np.log10(abs(value)))))}f}"


def figures_of_plan(plan: Plan) -> list[Figure]:
    """The standard deviations that a plan gives: of single photographs, then of the difference of two."""
    known = [
        Figure("sigma_across_mm", "across the line of sight", "mm", plan.sigma_across_mm),
        Figure("sigma_px", "centre in the picture", "px", plan.sigma_px),
        Figure("sigma_depth_mm", "depth", "mm", plan.sigma_depth_mm),
        Figure("sigma_normal_deg", "normal", "deg", np.degrees(plan.cloud.sigma_normal_rad)),
        Figure("sigma_displacement_mm", "displacement", "mm", plan.displacement_mm),
        Figure("sigma_shape_mm", "change of shape", "mm", plan.shape_mm),
    ]
    shared = calibration_depth_mm(plan)
    return known if shared is None else [*known, Figure("calibration_depth_mm", "calibration's part of depth", "mm", shared)]


def calibration_depth_mm(plan: Plan) -> Array | None:
    """How far the camera's own uncertainty moves each target (N,) along its axis, for all alike; None if that is not known."""
    if plan.camera.covariance is None:
        return None
    return np.asarray(np.sqrt(calibration_covariance_mm2(plan.cloud, plan.camera.covariance)[:, 2, 2]))


def plan_verdict(plan: Plan) -> Verdict:
    """The headline, the facts and the warnings of a plan."""
    total, found = len(plan.pattern), len(plan.cloud)
    count = f"All {targets(total)} can be measured" if found == total else f"{found} of {targets(total)} can be measured"
    figures = {figure.key: figure for figure in figures_of_plan(plan)}
    depth, shape = figures["sigma_depth_mm"].median, figures["sigma_shape_mm"].median
    change = f", a change of shape to {rough(shape)} mm" if np.isfinite(shape) else ""
    headline = f"{count}: depth to {rough(depth)} mm{change} (one sigma, median over targets)."
    facts = [Fact("Targets that can be measured", f"{found} of {total}", f"smallest circle {spread(plan.smallest_radius_px, ' px')}")]
    held = "as given" if plan.conditions.assumptions.normal_sigma_deg is not None else "as learnt from such a photograph"
    facts.append(Fact("Normals held to the surface by", f"{rough(float(np.degrees(plan.normal_sigma_rad)))}°", held))
    facts += [
        Fact(f"Sigma: {f.words}" if f.key.startswith("sigma") else f.words.capitalize(), f"{rough(f.median)} {f.unit}", _detail(f))
        for f in figures.values()
        if np.isfinite(f.median)
    ]
    return Verdict(headline, tuple(facts), tuple(_warnings(plan, figures)))


def _detail(figure: Figure) -> str:
    return f"median; worst {rough(figure.worst)} {figure.unit}"


def _warnings(plan: Plan, figures: dict[str, Figure]) -> list[str]:
    out = []
    reasons = Counter(why for _, why in plan.lost)
    for reason in reasons:
        lost = [ident for ident, why in plan.lost if why == reason]
        out.append(f"{targets(len(lost))} cannot be measured: {reason} ({id_list(lost)}).")
    ids = plan.cloud.ids
    for flag in (Quality.TOO_SMALL, Quality.WEAK_DEPTH):
        these = ids[(plan.cloud.quality & int(flag)) != 0]
        if len(these):
            out.append(f"{targets(len(these))} flagged {str(flag.name).lower()} ({id_list(these)}): {MEANING[flag]}.")
    blur = float(np.hypot(plan.conditions.psf_sigma_px, PIXEL_VARIANCE_PX2**0.5))
    thin = plan.narrowest_px < RESOLVED_BLURS * blur
    if thin.any():
        out.append(
            f"{targets(int(thin.sum()))} not resolved ({id_list(ids[thin])}): strokes or holes are as narrow as "
            f"{rough(float(plan.narrowest_px.min()))} px, and this blur needs {rough(RESOLVED_BLURS * blur)} px. "
            "They may not be found; print them wider or go nearer."
        )
    steep = np.degrees(plan.view_rad) > STEEPEST_DEG
    if steep.any():
        out.append(
            f"{targets(int(steep.sum()))} seen at more than {STEEPEST_DEG:g}° from their normals, up to "
            f"{np.degrees(plan.view_rad.max()):.0f}° ({id_list(ids[steep])}): beyond what the method was tried at."
        )
    if plan.conditions.contrast_to_noise < FAINT:
        out.append(f"A contrast of {plan.conditions.contrast_to_noise:g} times the noise is faint: some targets may not be found.")
    return out + _limits(plan, figures)


def _limits(plan: Plan, figures: dict[str, Figure]) -> list[str]:
    """Sentences on what the sigmas rest on rather than on the photograph."""
    out = []
    shared = figures.get("calibration_depth_mm")
    if shared is not None and shared.median > DOMINATING * figures["sigma_depth_mm"].median:
        out.append(
            f"Absolute depth is limited by the calibration: {rough(shared.median)} mm for all targets alike, where the photograph's noise "
            f"gives {rough(figures['sigma_depth_mm'].median)} mm. Differences between photographs by this camera do not feel it."
        )
    if len(plan.cloud) < LEAST_TARGETS:
        out.append(f"A difference needs at least {LEAST_TARGETS} targets, so none is predicted.")
    elif (shape := figures["sigma_shape_mm"].median) > HARDLY_SEEN * plan.conditions.amplitude_mm:
        out.append(
            f"Two photographs hardly show a change of {rough(plan.conditions.amplitude_mm)} mm: the sigma of {rough(shape)} mm rests "
            "on that stated size."
        )
    bend = max(print_bend_mm(plan.pattern.kind_of(int(i)), plan.conditions.amplitude_mm, plan.length_mm) for i in plan.index)
    if figures["sigma_shape_mm"].median < bend:
        out.append(
            f"A change of {rough(plan.conditions.amplitude_mm)} mm over {rough(plan.length_mm)} mm bends the prints themselves by about "
            f"{rough(bend)} mm, which the estimate does not follow: expect errors of shape of that size; smaller targets bend less."
        )
    return out
