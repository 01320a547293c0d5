"""What a difference leaves behind: its files, and a short summary for the eye."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dishmap.cli.terminal import say, table

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from dishmap.compare import Difference
    from dishmap.difference.difference_map import DifferenceMap
    from dishmap.io.difference_results import DifferenceProvenance

REPORT = "report.html"
MOST_LINES = 8
# Hypotheses with less weight than this are not told; the largest is.
LEAST_WEIGHT = 0.05
PPM = 1e6
EXAMPLE_PPM = 100.0


def outcome_files(result: Difference, title: str, provenance: DifferenceProvenance) -> dict[str, str | bytes]:
    """All files of a difference: name -> text or bytes."""
    from dishmap.difference_report import difference_report
    from dishmap.io.difference_results import difference_files

    files = difference_files(result, provenance)
    shown = {what: str(path) for what, path in provenance.inputs.items()}
    assert result.image is not None
    return {**files, REPORT: difference_report(result, result.image, title, shown)}


def print_difference(result: Difference, title: str, folder: Path) -> None:
    """Print what changed and how sure that is."""
    from dishmap.compare import PAPER
    from dishmap.difference_verdict import difference_verdict

    say(f"{title}: {len(result.table)} of {len(result.pattern)} targets compared")
    say(f"  {difference_verdict(result).headline}")
    if result.joint is not None:
        _print_joint(result, result.joint)
    if result.paper is not None:
        say(_methods(result))
    _print_left_out(result)
    for name, why in result.surface_problems.items():
        say(f"  the paper's method failed: {why}" if name == PAPER else f"  no surface through the {name}: {why}")
    say(f"report: {folder / REPORT}")


def brief(result: Difference) -> str:
    """What changed in one sentence, and the methods side by side where there are two."""
    from dishmap.difference_verdict import difference_verdict

    headline = difference_verdict(result).headline
    return headline if len(result.tables) < 2 else f"{headline}\n{_methods(result)}"


def _print_joint(result: Difference, joint: DifferenceMap) -> None:
    from dishmap.compare import JOINT
    from dishmap.difference_verdict import rigid_of, with_sigma
    from dishmap.figures import figures_of

    numbers = figures_of(result.tables[JOINT])
    say(
        f"  rms over the targets (sigma of one): displacement {_with(numbers.displacement_rms_mm, numbers.sigma_displacement_rms_mm)}, "
        f"depth {_with(numbers.depth_change_rms_mm, numbers.sigma_depth_change_rms_mm)}, "
        f"shape {_with(numbers.shape_rms_mm, numbers.sigma_shape_rms_mm)} mm"
    )
    rigid = rigid_of(joint)
    move, turn = _axes(rigid.move_mm, rigid.sigma_move_mm), _axes(rigid.turn_deg, rigid.sigma_turn_deg)
    say(f"  rigid motion in the dish frame: {move} mm; turn {turn} deg")
    say(f"  {_expansion(result, joint)}")
    if joint.priors.focal_drift > 0:
        say(f"  focal length: changed by {with_sigma(PPM * joint.focal_drift[0], PPM * joint.focal_drift[1], ' ppm')}")
    for line in _hypotheses(joint):
        say(line)
    if joint.noise_factor > 1:
        say(f"  sigmas were enlarged {joint.noise_factor**0.5:.3g} times: targets differ from a smooth motion by more than they claim")
    if not joint.converged:
        say("  not every way of moving converged; take its numbers with care")


def _expansion(result: Difference, joint: DifferenceMap) -> str:
    """What was assumed of expansion, and what a wrong assumption would do."""
    from dishmap.difference_verdict import scale_open, with_sigma
    from dishmap.figures import distance_mm

    each = f"each {EXAMPLE_PPM:g} ppm would be {distance_mm(result) * EXAMPLE_PPM / PPM:.2g} mm of distance"
    cannot = f"one camera cannot tell expansion from distance: {each}"
    if scale_open(joint):
        return (
            f"expansion: the scale of the picture changed by {100 * joint.expansion_assumed[1]:.2g} % and nothing was said of expansion, "
            f"so any up to that was allowed; {cannot}; say with --expansion-ppm what is known"
        )
    if joint.priors.expansion_ppm is None:
        return f"expansion: none assumed; {cannot}"
    given, found = (with_sigma(PPM * mean, PPM * sigma, " ppm") for mean, sigma in (joint.expansion_assumed, joint.expansion))
    return f"expansion: {given} given, {found} found; {cannot}"


def _hypotheses(joint: DifferenceMap) -> list[str]:
    ranked = sorted(joint.considered, key=lambda one: -one.weight)
    told = [one for one in ranked if one.weight >= LEAST_WEIGHT]
    if len(told) < 2:
        return []
    lines = [f"    {one.weight:.0%} {one.way.replace('_', ' ')}, smooth over {one.length_mm:.0f} mm" for one in told[:MOST_LINES]]
    return ["  ways in which the surface may have moved, by probability:", *lines]


def _methods(result: Difference) -> str:
    """A table of the methods side by side, and how far they are apart."""
    from dishmap.compare import JOINT, PAPER
    from dishmap.figures import apart, figures_of

    columns = [("displacement rms mm", "displacement_rms_mm"), ("depth rms mm", "depth_change_rms_mm"), ("shape rms mm", "shape_rms_mm")]
    rows = []
    for method, rows_of in result.tables.items():
        numbers = figures_of(rows_of)
        cells = [f"{getattr(numbers, name):.4f}" for _, name in columns]
        sigma = numbers.sigma_shape_rms_mm
        rows.append([method, str(numbers.targets), *cells, "not known" if sigma != sigma else f"{sigma:.4f}"])
    if len(result.tables) == 2:
        between = apart(result.tables[JOINT], result.tables[PAPER])
        rows.append(["apart", str(between.targets), *(f"{getattr(between, name):.4f}" for _, name in columns), ""])
    return table(["", "targets", *(head for head, _ in columns), "sigma of shape"], rows)


def _print_left_out(result: Difference) -> None:
    from dishmap.difference_verdict import unused_targets
    from dishmap.quality import MEANING
    from dishmap.verdict import id_list

    lost = unused_targets(result)
    reasons = Counter(why for _, why in lost)
    for why, count in reasons.most_common(MOST_LINES):
        say(f"  left out: {count} ({id_list([ident for ident, reason in lost if reason == why])}): {why}")
    if len(reasons) > MOST_LINES:
        say(f"  ... and {len(reasons) - MOST_LINES} more reasons, see summary.json")
    for flag, meaning in MEANING.items():
        count = int((result.table.quality & int(flag) != 0).sum())
        if count:
            say(f"  flagged {str(flag.name).lower()}: {count} ({meaning})")


def _axes(values: NDArray[Any], sigmas: NDArray[Any]) -> str:
    from dishmap.difference_verdict import with_sigma

    return ", ".join(f"{axis} {with_sigma(float(v), float(s), '')}" for axis, v, s in zip("xyz", values, sigmas, strict=True))


def _with(value: float, sigma: float) -> str:
    return f"{value:.4f} ({sigma:.2g})"
