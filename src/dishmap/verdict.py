"""What a map says, in numbers beside each other and in plain sentences: the first thing a report shows."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.figures import reprojection_of
from dishmap.pipeline import Map
from dishmap.quality import MEANING, Quality
from dishmap.surface.cloud import PointCloud, calibration_covariance_mm2, transform_cloud
from dishmap.surface.fit import SurfaceFit, radius_of, surface_heights
from dishmap.targets.pose import TargetPoses
from dishmap.transforms import angle_between_rad

Array = NDArray[np.float64]

# Above this, what is left over the surface is not explained by the targets' noise; below its inverse, sigmas are too large.
LARGE_FACTOR = 1.5
# From so few targets the factor itself is too uncertain to speak of.
FEWEST_FOR_FACTOR = 20
# A slope is taken over this part of the cloud's size.
SLOPE_STEP = 1e-4
# So many ids are written out in a sentence.
MOST_IDS = 12
# So many reasons are told in a list of what to know.
MOST_REASONS = 6
# Edges of squares that lie outside their printed place by more than this part of the side are not where the pattern file has them.
WRONG_SIDE_PART = 0.05
LIMITS = {
    "noise": "the photograph's noise",
    "printing": "printing",
    "calibration": "the calibration",
    "shape": "the surface's own shape",
}
# Flags that say something about the measurement's trust, in the order in which they are told.
TOLD = (
    Quality.WEAK_DEPTH,
    Quality.AMBIGUOUS_NORMAL,
    Quality.OFF_SURFACE,
    Quality.OUTLIER,
    Quality.POOR_FIT,
    Quality.GLARE,
    Quality.OCCLUDED,
    Quality.TOO_SMALL,
)


@dataclass(frozen=True)
class Numbers:
    """What the charts of a map show; N targets, in the order of its cloud.

    dish: the cloud in the dish frame; sigma_depth_mm (N,): along the camera's axis, from the photograph's noise, or None for a method
    without sigmas; calibration_depth_mm (N,): the shared part of the calibration, or None if unknown; ratio (N,): residual
    to the surface over its claimed sigma, or None; lean_rad (N, 2): x, y of the measured normal minus the surface's (the
    nominal one where there is no fit), lean_angle_rad (N,): the angle between them.
    """

    dish: PointCloud
    sigma_depth_mm: Array | None
    calibration_depth_mm: Array | None
    ratio: Array | None
    lean_rad: Array
    lean_angle_rad: Array


@dataclass(frozen=True)
class Fact:
    """One number of the headline: what it is, the value with unit, and what stands beside it."""

    name: str
    value: str
    detail: str


@dataclass(frozen=True)
class Verdict:
    """A headline in words, the facts, and sentences about what deserves attention."""

    headline: str
    facts: tuple[Fact, ...]
    warnings: tuple[str, ...]


def numbers_of(result: Map) -> Numbers:
    """The arrays behind a report's charts."""
    cloud, fit = result.cloud, result.surface
    dish = transform_cloud(cloud, result.camera_from_dish.inverse(), "dish")
    known = result.method == "pose"
    calibration = None
    if known and result.camera.covariance is not None and cloud.calibration_jacobian is not None:
        calibration = np.sqrt(calibration_covariance_mm2(cloud, result.camera.covariance)[:, 2, 2])
    nominal = np.asarray(result.pattern.normal[result.poses.index])
    normal = nominal if fit is None else _surface_normals(fit, dish, nominal)
    ratio = None
    if known and fit is not None:
        along = normal if fit.basis.along_normal else normal / normal[:, 2:]
        ratio = fit.residual_mm / np.sqrt(np.einsum("ni,nij,nj->n", along, dish.covariance_mm2, along))
    return Numbers(
        dish=dish,
        sigma_depth_mm=np.sqrt(cloud.covariance_mm2[:, 2, 2]) if known else None,
        calibration_depth_mm=calibration,
        ratio=ratio,
        lean_rad=(dish.normal - normal)[:, :2],
        lean_angle_rad=angle_between_rad(dish.normal, normal),
    )


def _surface_normals(fit: SurfaceFit, dish: PointCloud, nominal: Array) -> Array:
    """Unit normals of the fitted surface under the points, the nominal ones where it has no height."""
    x, y, _ = dish.position_mm.T
    step = SLOPE_STEP * float(np.ptp(dish.position_mm[:, :2], axis=0).max())
    around = surface_heights(fit, x + step * np.array([[1], [-1], [0], [0]]), y + step * np.array([[0], [0], [1], [-1]])).height_mm
    slope_x, slope_y = (around[0] - around[1]) / (2 * step), (around[2] - around[3]) / (2 * step)
    normal = np.column_stack([-slope_x, -slope_y, np.ones_like(slope_x)])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.asarray(np.where(np.isfinite(normal).all(axis=1, keepdims=True), normal, nominal))


def verdict_of(result: Map, numbers: Numbers) -> Verdict:
    """The headline, the facts and the warnings of a map."""
    return Verdict(_headline(result), tuple(_facts(result, numbers)), tuple(_warnings(result, numbers)))


def number(value: float) -> str:
    """Three digits, without an exponent where a reader does not need one."""
    if value == 0 or not np.isfinite(value):
        return f"{value:g}"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.2e}"
    return f"{value:.{max(0, 2 - int(np.floor(np.log10(abs(value)))))}f}"


def spread(values: ArrayLike, unit: str) -> str:
    """Range of values in words; the unit brings its own space."""
    v = np.asarray(values, dtype=float)
    return f"{number(float(v.min()))} to {number(float(v.max()))}{unit}"


def targets(count: int) -> str:
    """`1 target`, `2 targets`."""
    return f"{count} target" if count == 1 else f"{count} targets"


def id_list(ids: ArrayLike) -> str:
    """Ids in words: all of a few, the first of many."""
    values = [str(i) for i in np.asarray(ids).tolist()]
    return ", ".join(values) if len(values) <= MOST_IDS else ", ".join(values[:MOST_IDS]) + f" and {len(values) - MOST_IDS} more"


def common_reasons(lost: list[tuple[int, str]]) -> tuple[list[str], list[int]]:
    """The reasons of (id, reason) that are told one by one: all of a few, else the commonest; and the ids of the others."""
    reasons = Counter(reason for _, reason in lost)
    if len(reasons) <= MOST_REASONS:
        return list(reasons), []
    usual = [reason for reason, _ in reasons.most_common(MOST_REASONS - 1)]
    told = {ident for ident, reason in lost if reason in usual}
    return usual, sorted({ident for ident, _ in lost} - told)


def rows_of_reasons(lost: list[tuple[int, str]]) -> list[tuple[str, str]]:
    """Rows (id, reason) of a table: one a target, or of many targets one a reason, with all of its ids."""
    if len(lost) <= MOST_IDS:
        return [(str(ident), reason) for ident, reason in lost]
    reasons = dict.fromkeys(reason for _, reason in lost)
    return [(", ".join(str(ident) for ident, other in lost if other == reason), reason) for reason in reasons]


def rejected_targets(result: Map) -> list[tuple[int, str]]:
    """Named targets that were not used, with the reason."""
    return [(ident, reason) for ident, reason in result.rejected if ident is not None]


def unused_marks(result: Map) -> Counter[str]:
    """How many things that look like marks were not used, by reason."""
    return Counter(reason for ident, reason in result.rejected if ident is None)


def _headline(result: Map) -> str:
    found, total, lost = len(result.cloud), len(result.pattern), len(rejected_targets(result))
    count = f"All {targets(total)} measured" if found == total else f"{found} of {targets(total)} measured"
    parts = [f"{lost} seen but rejected" if lost else "", f"{len(result.missing)} not seen" if result.missing else ""]
    rest = ", ".join(part for part in parts if part)
    surface = (
        f"the {_surface_name(result)} fits to {number(result.surface.rms_mm)} mm rms" if result.surface else "no surface could be fitted"
    )
    return f"{count}{'; ' + rest if rest else ''}; {surface}."


def _surface_name(result: Map) -> str:
    assert result.surface is not None
    basis = result.surface.basis
    return f"{basis.kind} surface of degree {basis.degree}" if basis.kind in ("polynomial", "zernike") else basis.kind


def _facts(result: Map, numbers: Numbers) -> list[Fact]:
    found, total = len(result.cloud), len(result.pattern)
    lost = len(rejected_targets(result))
    facts = [Fact("Targets measured", f"{found} of {total}", f"{lost} rejected, {len(result.missing)} not seen")]
    if numbers.sigma_depth_mm is not None:
        sigma = numbers.sigma_depth_mm
        facts.append(
            Fact("Depth sigma, median", f"{number(float(np.median(sigma)))} mm", f"{spread(sigma, ' mm')}; photograph's noise alone")
        )
        sigma_deg = np.degrees(result.cloud.sigma_normal_rad)
        facts.append(Fact("Normal sigma, median", f"{number(float(np.median(sigma_deg)))}°", spread(sigma_deg, "°")))
    if numbers.calibration_depth_mm is not None:
        shared = numbers.calibration_depth_mm
        facts.append(Fact("Calibration's part of depth", f"{number(float(np.median(shared)))} mm", "median; common to all targets"))
    reprojection = reprojection_of(result)
    if reprojection is not None:
        to = f"to the smooth surface; {LIMITS[reprojection.smooth_limit]} limits it"
        facts.append(Fact("Reprojection, rms", f"{number(reprojection.smooth_rms_px)} px", to))
    fit = result.surface
    if fit is not None:
        off = int(fit.off_surface.sum())
        kept = f"{targets(len(fit.ids) - off)}{f', {off} off the surface' if off else ''}"
        facts.append(Fact(f"Rms to the {_surface_name(result)}", f"{number(fit.rms_mm)} mm", kept))
        if (radius := radius_of(fit)) is not None:
            beside = radius.calibration_sigma_radius_mm
            more = f"; calibration ± {number(beside)} mm" if np.isfinite(beside) else ""
            side = "bulges towards the camera's side" if radius.radius_mm > 0 else "hollow on the camera's side"
            own = f"± {number(radius.sigma_radius_mm)} mm from noise{more}; {side}"
            facts.append(Fact("Radius of the cylinder", f"{abs(radius.radius_mm):.3f} mm", own))
        if fit.noise_factor is not None:
            facts.append(Fact("Residual / claimed sigma", number(fit.noise_factor), "1 if noise is all there is"))
    return facts


def sheet_words(result: Map) -> list[tuple[str, str, str]]:
    """What the joint estimate of a grid learnt: (what, value with unit, what it means); nothing for other maps."""
    reprojection = reprojection_of(result)
    if reprojection is None or not isinstance(result.poses, TargetPoses) or result.poses.sheet is None:
        return []
    sheet, r = result.poses.sheet, reprojection
    edges = [
        (
            "Edges outside their printed place",
            f"{number(sheet.spread_mm)} ± {number(sheet.sigma_spread_mm)} mm",
            f"squares have sides of {sheet.measured_side_mm:.3f} mm, {sheet.side_mm:g} mm by the pattern file; ink spreads, or dries up",
        )
    ]
    shared = "" if not np.isfinite(r.calibration_px) else f", an error of the calibration {number(r.calibration_px)} px"
    return [
        ("Printing error", f"{number(sheet.print_mm)} mm", "of a target's place on the sheet, per axis"),
        ("Strain of single cells", percent(sheet.strain), "how far printed distances between neighbours differ from the pattern file's"),
        ("Smooth strain", percent(sheet.smooth_strain), "the same, of a kind that whole parts of the sheet share"),
        ("Roughness", f"{number(sheet.rough_mm)} mm", "third derivatives along the normal, per step of the grid cubed"),
        *(edges if sheet.side_mm else []),
        (
            "Reprojection to the smooth surface",
            f"{number(r.smooth_rms_px)} px rms",
            f"the photograph's noise would leave {number(r.noise_px)} px, printing errors {number(r.printing_px)} px; "
            f"{LIMITS[r.smooth_limit]} limits it",
        ),
        (
            "Reprojection of the undeformed pattern",
            f"{number(r.rigid_rms_px)} px rms",
            f"in its best rigid pose; noise and printing errors as above{shared}; {LIMITS[r.rigid_limit]} limits it",
        ),
    ]


def percent(share: float) -> str:
    """A share in percent."""
    return f"{number(100 * share)} %"


def side_warning(result: Map) -> str:
    """A sentence where squares are so much larger or smaller than the pattern file says that ink cannot be why; else nothing."""
    sheet = result.poses.sheet if isinstance(result.poses, TargetPoses) else None
    if sheet is None or not sheet.side_mm or abs(sheet.spread_mm) <= WRONG_SIDE_PART * sheet.side_mm:
        return ""
    return (
        f"The pattern file's side of squares seems wrong: it says {sheet.side_mm:g} mm, and they measure {sheet.measured_side_mm:.3f} ± "
        f"{2 * sheet.sigma_spread_mm:.1g} mm by the printed pitch. Places do not rest on it."
    )


def _warnings(result: Map, numbers: Numbers) -> list[str]:
    out = []
    if result.method == "paper":
        out.append("The paper's method gives no uncertainty, so sigmas are left out; the method `pose` gives them.")
    elif result.camera.covariance is None:
        out.append(
            "The calibration's covariance is unknown (the camera file holds none): the sigmas are those of the photograph's noise "
            "alone, and what the calibration adds to positions and shape is not known. `dishmap calibrate` writes a camera with it."
        )
    if lost := rejected_targets(result):
        usual, others = common_reasons(lost)
        said = "; ".join(f"{reason} ({id_list([i for i, r in lost if r == reason])})" for reason in usual)
        said += f"; other reasons, listed below ({id_list(others)})" if others else ""
        out.append(f"{targets(len(lost))} seen but rejected: {said}.")
    if wrong := side_warning(result):
        out.append(wrong)
    if result.missing:
        out.append(f"{targets(len(result.missing))} not seen: {id_list(result.missing)}.")
    if result.surface is None:
        out.append(f"No surface: {result.surface_problem}.")
    out += [f"{_flag_words(result, flag)}." for flag in TOLD if ((result.cloud.quality & int(flag)) != 0).any()]
    return out + _surface_warnings(result)


def _flag_words(result: Map, flag: Quality) -> str:
    ids = result.cloud.ids[(result.cloud.quality & int(flag)) != 0]
    return f"{targets(len(ids))} flagged {str(flag.name).lower()} ({id_list(ids)}): {MEANING[flag]}"


def _surface_warnings(result: Map) -> list[str]:
    fit, out = result.surface, []
    if fit is None:
        return []
    if not fit.converged:
        out.append("The surface fit did not converge; its coefficients are those of the last step.")
    if fit.noise_factor is not None and fit.noise_factor > LARGE_FACTOR:
        out.append(
            f"Residuals are {number(fit.noise_factor)} times what the claimed sigmas allow: the surface has a shape that this "
            f"{_surface_name(result)} does not follow (see the residual map)."
        )
    if fit.noise_factor is not None and fit.noise_factor * LARGE_FACTOR < 1 and len(fit.ids) >= FEWEST_FOR_FACTOR:
        shared = (
            "as those of one sheet do, of which the surface takes up the broadest"
            if result.pattern.is_grid
            else "such as the ink spread of lone discs, or they are too large"
        )
        out.append(
            f"Residuals are only {number(fit.noise_factor)} of the claimed sigmas: these hold a part that neighbours share, {shared}."
        )
    return out
