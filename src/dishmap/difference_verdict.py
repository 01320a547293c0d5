"""What a difference says, in numbers and in plain sentences: for the top of its report and for the terminal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from dishmap.compare import PAPER, Difference, DifferenceTable
from dishmap.difference.difference_map import DifferenceMap
from dishmap.quality import MEANING, Quality, names
from dishmap.verdict import Fact, Verdict, common_reasons, id_list, number, targets

Array = NDArray[Any]
Bools = NDArray[np.bool_]

# A rigid motion is spoken of when chance would show it this rarely.
RIGID_SIGNIFICANCE = 0.01
# A value this many sigmas from zero or more is told from none (95 %).
TOLD_SIGMAS = 1.96
# Decimals written of a value: two digits of its sigma, within what a table can hold.
SIGMA_DIGITS, MOST_DECIMALS = 2, 7
# Below this a length in mm, or a sigma, is the rounding of an exact zero: far less than any photograph shows.
ROUNDING = 1e-6
# ... and what a tile can hold.
TILE_DECIMALS = 4
# Sigmas that had to be enlarged by this hide what the photographs cannot explain.
DOUBTFUL_NOISE = 2.0
# p values below this are written as a bound: the tail of a chi-square is not known to such depths.
SMALLEST_P = 1e-12
PPM = 1e6


@dataclass(frozen=True)
class Rigid:
    """The best-fit rigid motion: move_mm, turn_deg (3,) and their sigmas; lengths with sigma along them; whether it is significant."""

    move_mm: Array
    sigma_move_mm: Array
    turn_deg: Array
    sigma_turn_deg: Array
    moved_mm: tuple[float, float]
    turned_deg: tuple[float, float]
    significant: bool


def difference_verdict(result: Difference) -> Verdict:
    """The headline, the facts and the warnings of a difference."""
    return Verdict(_headline(result), tuple(_facts(result)), tuple(_warnings(result)))


def with_sigma(value: float, sigma: float, unit: str, sign: bool = False) -> str:
    """`0.340 ± 0.005 mm`: the value to two digits of its sigma; without a known sigma three digits of the value alone.

    The unit brings its own space.
    """
    if not (np.isfinite(sigma) and sigma > ROUNDING):
        return f"{'+' if sign and value > 0 else ''}{number(value)}{unit}"
    decimals = int(np.clip(SIGMA_DIGITS - 1 - np.floor(np.log10(sigma)), 0, MOST_DECIMALS))
    # + 0.0 turns what rounds to minus zero into zero
    shown = f"{round(value, decimals) + 0.0:{'+' if sign else ''}.{decimals}f}"
    return f"{shown} ± {sigma:.{decimals}f}{unit}"


def rms_with_sigma(value_mm: Array, factor: Array, own_mm2: Array) -> tuple[float, float]:
    """Root mean square of estimates (N,) and the root mean square error of it as an estimate of the truth's.

    Covariance is factor factor^T + diag(own), factor (N, R). The truth's mean square is a quadratic form of a Gaussian with the known
    mean and variance (Mathai and Provost 1992, section 3.2); noise alone makes the truth's rms differ from that of a map near zero.
    """
    n = len(value_mm)
    covariance = factor @ factor.T + np.diag(own_mm2)
    square = float(value_mm @ value_mm) / n
    expected = square + float(np.trace(covariance)) / n
    if expected == 0:
        return 0.0, 0.0
    variance = float(4 * value_mm @ covariance @ value_mm + 2 * (covariance**2).sum()) / n**2
    spread = variance / (4 * expected)
    mean = max(expected - spread, 0.0) ** 0.5
    return square**0.5, max(expected + square - 2 * mean * square**0.5, 0.0) ** 0.5


def shape_rms(joint: DifferenceMap) -> tuple[float, float]:
    """Root mean square of the change of shape, mm, over the targets that were used, with its error."""
    used = (joint.quality & int(Quality.OUTLIER)) == 0
    used |= not used.any()
    return rms_with_sigma(joint.shape_mm[used], joint.shape_factor[used], joint.shape_own_mm2[used])


def set_aside(table: DifferenceTable) -> Bools:
    """Rows (N,) whose own change was not used."""
    return np.asarray((table.quality & int(Quality.OUTLIER)) != 0)


def largest_row(table: DifferenceTable) -> int:
    """The row with the largest change of shape, among those that were used."""
    used = ~set_aside(table)
    return int(np.argmax(np.where(used | ~used.any(), np.abs(table.shape_mm), -1.0)))


def rigid_of(joint: DifferenceMap) -> Rigid:
    """The rigid motion with its sigmas, about the origin of the dish frame."""
    move, turn = joint.rigid_motion.translation_mm, joint.rigid_motion.rotation_vector_rad
    sigma = np.sqrt(np.diag(joint.rigid_covariance))
    scale = np.where(sigma > 0, sigma, 1.0)
    unit = np.concatenate([move, turn]) / scale
    chi_square = float(unit @ np.linalg.pinv(joint.rigid_covariance / np.outer(scale, scale), hermitian=True) @ unit)
    return Rigid(
        move,
        sigma[:3],
        np.degrees(turn),
        np.degrees(sigma[3:]),
        _length(move, joint.rigid_covariance[:3, :3]),
        _length(np.degrees(turn), np.degrees(np.degrees(joint.rigid_covariance[3:, 3:]))),
        bool(chi2.sf(chi_square, 6) < RIGID_SIGNIFICANCE),
    )


def _length(vector: Array, covariance: Array) -> tuple[float, float]:
    """Length of a vector (3,) and its sigma along it; of a vector of no length the largest sigma."""
    length = float(np.linalg.norm(vector))
    if length == 0:
        return 0.0, float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))
    return length, max(float(vector @ covariance @ vector), 0.0) ** 0.5 / length


def p_words(p_value: float) -> str:
    """`p = 0.61`, or a bound where it is tiny."""
    return f"p = {p_value:.2g}" if p_value >= SMALLEST_P else f"p < {SMALLEST_P:g}"


def scale_open(joint: DifferenceMap) -> bool:
    """Whether the scale of the whole picture changed, nothing is known of expansion, and so motion and expansion are not told apart."""
    return joint.priors.expansion_ppm is None and joint.expansion_assumed[1] > 0


def unused_targets(result: Difference) -> list[tuple[int, str]]:
    """(id, reason) of targets of either state that have no row, or whose own change was not used."""
    if result.joint is not None:
        return list(result.joint.rejected)
    said = dict((*result.reference.rejected, *result.current.rejected))
    absent = np.setdiff1d(np.union1d(result.reference.ids, result.current.ids), result.table.ids)
    said |= {int(i): "not measured in both photographs" for i in absent if int(i) not in said}
    return sorted(said.items())


def _headline(result: Difference) -> str:
    joint, table = result.joint, result.table
    if result.same:
        return "Both states are the same photograph, pixel by pixel, so nothing can have changed between them."
    if joint is None:
        rms, shape = _rms(table.displacement_mm), _rms(table.shape_mm)
        return (
            f"By the paper's method the surface was displaced by {number(rms)} mm rms; without the best-fit rigid motion "
            f"{number(shape)} mm rms are left. Whether that is significant the method does not say."
        )
    test = joint.significance
    if joint.priors.still:
        against = f" But the photographs contradict a rigid body ({p_words(test.p_value)})." if test.changed else ""
        return f"Taken as a rigid body, as was given, the surface {_motion(joint)}.{_doubt(joint) or against}"
    size = with_sigma(*shape_rms(joint), " mm")
    whole = f"as a whole the surface {_motion(joint)}.{_doubt(joint)}"
    if not test.changed:
        return f"No significant change of shape: {size} rms, {p_words(test.p_value)}; {whole}"
    row = largest_row(table)
    most = with_sigma(table.shape_mm[row], table.sigma_shape_mm[row], " mm", sign=True)
    return f"The shape changed by {size} rms, most at target {table.ids[row]} ({most}); {whole}"


def _doubt(joint: DifferenceMap) -> str:
    """What must stand beside any verdict when the targets do not fit it."""
    times = float(np.sqrt(joint.noise_factor))
    if times < DOUBTFUL_NOISE:
        return ""
    return f" But the targets scatter {number(times)} times more than their sigmas allow: trust none of this before that is explained."


def _motion(joint: DifferenceMap) -> str:
    rigid = rigid_of(joint)
    if scale_open(joint):
        percent = f"{100 * joint.expansion_assumed[1]:.2g} %"
        return f"moved along the line of sight or changed its size, which one camera cannot tell apart (scale changed by {percent})"
    if not rigid.significant:
        return "did not move significantly"
    both = (("moved", rigid.moved_mm, " mm"), ("turned", rigid.turned_deg, "°"))
    # together they may be certain where neither is alone
    told = [part for part in both if part[1][0] >= TOLD_SIGMAS * part[1][1]] or both
    return " and ".join(f"{verb} by {with_sigma(*size, unit)}" for verb, size, unit in told)


def _facts(result: Difference) -> list[Fact]:
    table, joint = result.table, result.joint
    aside = int(set_aside(table).sum())
    lost = len(result.pattern) - len(table)
    facts = [Fact("Targets compared", f"{len(table)} of {len(result.pattern)}", f"{aside} put aside, {lost} not in both states")]
    row = largest_row(table)
    x, y, _ = table.nominal_mm[row]
    side = "towards" if table.shape_mm[row] >= 0 else "away from"
    at = Fact(
        "Largest change of shape",
        _brief(abs(table.shape_mm[row]), table.sigma_shape_mm[row], " mm"),
        f"{_give_or_take(table.sigma_shape_mm[row], ' mm')}{side} the camera's side, target {table.ids[row]} at x {x:.0f}, y {y:.0f} mm",
    )
    if joint is None:
        return [*facts, Fact("Change of shape, rms", _brief(_rms(table.shape_mm), np.nan, " mm"), "best-fit rigid motion removed"), at]
    if joint.priors.still:
        return [*facts, *_joint_facts(joint)]
    size, sigma = shape_rms(joint)
    by = "motion of the rigid parts" if joint.priors.rigid_ids else "best-fit rigid motion"
    median = number(float(np.median(table.sigma_shape_mm)))
    return [
        *facts,
        Fact(
            "Change of shape, rms",
            _brief(size, sigma, " mm"),
            f"{_give_or_take(sigma, ' mm')}{by} removed; sigma of one target {median} mm (median)",
        ),
        at,
        *_joint_facts(joint),
    ]


def _joint_facts(joint: DifferenceMap) -> list[Fact]:
    test, rigid = joint.significance, rigid_of(joint)
    best = max(joint.considered, key=lambda c: c.weight)
    given = "assumed" if joint.expansion_assumed[1] == 0 else f"beforehand {ppm(joint.expansion_assumed)}"
    drift = "assumed" if joint.priors.focal_drift == 0 else f"beforehand 0 ± {number(PPM * joint.priors.focal_drift)} ppm"
    return [
        Fact(
            "p value",
            p_words(test.p_value).removeprefix("p ").removeprefix("= "),
            f"of no change of shape: chi-square {number(test.chi_square)}, {test.degrees} degrees of freedom",
        ),
        Fact("Rigid motion", _brief(*rigid.moved_mm, " mm"), _components(rigid.move_mm, rigid.sigma_move_mm, " mm")),
        Fact("Rigid turn", _brief(*rigid.turned_deg, "°"), _components(rigid.turn_deg, rigid.sigma_turn_deg, "°")),
        _share("Uniform expansion", joint.expansion, given),
        _share("Focal drift", joint.focal_drift, drift),
        Fact("Ways of moving that count", str(len(joint.considered)), f"the best has {best.weight:.0%} of the weight"),
        Fact("Noise / claimed noise", number(float(np.sqrt(joint.noise_factor))), "sigmas were enlarged by this"),
    ]


def _share(name: str, value: tuple[float, float], before: str) -> Fact:
    return Fact(name, _brief(PPM * value[0], PPM * value[1], " ppm"), f"{_give_or_take(PPM * value[1], ' ppm')}{before}")


def _brief(value: float, sigma: float, unit: str) -> str:
    """A value short enough for a tile: three digits, or fewer where its sigma says that they mean nothing."""
    known = [float(size) for size in (abs(value) / 10, sigma) if np.isfinite(size) and size > 0]
    decimals = int(np.clip(SIGMA_DIGITS - 1 - np.floor(np.log10(float(max(known, default=10.0)))), 0, TILE_DECIMALS))
    return f"{round(float(value), decimals) + 0.0:.{decimals}f}{unit}"


def _give_or_take(sigma: float, unit: str) -> str:
    return f"± {number(float(sigma))}{unit}; " if np.isfinite(sigma) and sigma > ROUNDING else ""


def _components(values: Array, sigmas: Array, unit: str) -> str:
    return ", ".join(f"{axis} {with_sigma(float(v), float(s), unit)}" for axis, v, s in zip("xyz", values, sigmas, strict=True))


def ppm(value: tuple[float, float]) -> str:
    """A share (mean, sigma) per unit in parts per million."""
    return with_sigma(PPM * value[0], PPM * value[1], " ppm")


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _warnings(result: Difference) -> list[str]:
    joint, table, out = result.joint, result.table, []
    if joint is None:
        out.append(
            "The paper's method was asked for alone. Its sigmas, where it has any, hold the noise of centres but not what the method "
            "leaves out; the method `joint` gives sigmas of everything."
        )
    else:
        out += _joint_warnings(joint)
    if result.camera.covariance is None:
        out.append(
            "The calibration's covariance is unknown (the camera file holds none), so that sigmas leave out what an error of the "
            "calibration does to a difference. `dishmap calibrate` writes a camera with it."
        )
    if lost := unused_targets(result):
        usual, others = common_reasons(lost)
        for why in usual:
            ids = [i for i, r in lost if r == why]
            out.append(f"{targets(len(ids))} not used ({id_list(ids)}){', for each' if len(ids) > 1 else ''}: {why}.")
        if others:
            out.append(f"{targets(len(others))} not used for other reasons ({id_list(others)}); they are listed under outliers and flags.")
    for flag in Quality:
        ids = table.ids[(table.quality & int(flag)) != 0] if flag else []
        # what was put aside is told above, with the reason
        if len(ids) and not (flag is Quality.OUTLIER and joint is not None):
            out.append(f"{targets(len(ids))} flagged {names(int(flag))} ({id_list(ids)}): {MEANING[flag]}.")
    return out + [f"No surface through the {name}: {why.rstrip('.')}." for name, why in result.surface_problems.items()]


def _joint_warnings(joint: DifferenceMap) -> list[str]:
    out = []
    if scale_open(joint):
        depth = float(joint.camera_from_dish.translation_mm[2])
        part = joint.expansion_assumed[1]
        out.append(
            f"The scale of the whole picture changed by {number(100 * part)} %. A motion of {number(depth * part)} mm along the line of "
            f"sight and an expansion of {number(PPM * part)} ppm look the same to one camera, and nothing was said of expansion, so that "
            "either may be true and the sigmas of displacement, shape and rigid motion hold both. Say how much the surface may have "
            "expanded (`--expansion-ppm`) to tell them apart."
        )
    if not joint.converged:
        out.append("Not every way of moving that was weighed converged; its numbers are those of the last step.")
    if joint.noise_factor > 1:
        out.append(
            f"The targets' changes differ from a smooth motion by {number(float(np.sqrt(joint.noise_factor)))} times what their claimed "
            "sigmas allow; all sigmas here were enlarged by this."
        )
    if not joint.zernike_terms:
        out.append(f"{targets(len(joint))} are too few to report Zernike terms from.")
    return out


def paper_facts(result: Difference) -> list[Fact]:
    """Numbers of the paper's method, and how far it is from the joint estimate where there is one."""
    paper, table = result.paper, result.tables[PAPER]
    if paper is None:
        return []
    common = f"{number(paper.common_depth_change_mm)} mm"
    facts = [
        Fact("Displacement, rms", _brief(_rms(table.displacement_mm), np.nan, " mm"), f"{targets(len(table))}, along the normal"),
        Fact("Change of shape, rms", _brief(_rms(table.shape_mm), np.nan, " mm"), "best-fit rigid motion removed"),
        Fact("Scale of the registration", f"{paper.registration.scale:.6f}", f"by itself a depth change of {common}"),
        Fact("Pairs used", f"{int((paper.confidence > 0).sum())} of {len(paper.ratios)}", f"up to {number(paper.reach_mm)} mm apart"),
    ]
    if result.joint is not None:
        _, ours, theirs = np.intersect1d(result.joint.ids, table.ids, return_indices=True)
        gap = _rms(result.joint.shape_mm[ours] - table.shape_mm[theirs])
        facts.append(Fact("From the joint estimate, rms", _brief(gap, np.nan, " mm"), "of the two changes of shape"))
    return facts
