"""What a map leaves behind: its files, and a short summary for the eye."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from dishmap.cli.terminal import say

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from dishmap.io.results import Provenance
    from dishmap.pipeline import Map

REPORT = "report.html"
MOST_LINES = 8


def write_outcome(
    folder: Path,
    result: Map,
    image: NDArray[np.generic],
    title: str,
    provenance: Provenance,
    more: Mapping[str, str | bytes] | None = None,
) -> None:
    """Write all files of a map, and `more` beside them, into an existing folder: all or none."""
    from dishmap.camera.undistort import undistort_image
    from dishmap.io.results import result_files, write_results
    from dishmap.report import map_report

    if result.camera is not provenance.camera:
        # the paper's method measures in an undistorted copy, and its points belong on that
        image, _ = undistort_image(provenance.camera, image)
    files = result_files(result, provenance)
    shown = {what: str(path) for what, path in provenance.inputs.items()}
    write_results(folder, {**(more or {}), **files, REPORT: map_report(result, image, title, shown)})


def print_summary(result: Map, title: str, folder: Path) -> None:
    """Print what was found and how well."""
    from dishmap.surface.fit import radius_of

    cloud = result.cloud
    rejected = result.poses.rejected
    counts = f"{len(cloud)} of {len(result.pattern)} targets measured, {len(rejected)} rejected, {len(result.missing)} not seen"
    say(f"{title}: {counts}")
    _print_few([f"  rejected: target {ident}: {reason}" for ident, reason in rejected])
    if result.missing:
        some = ", ".join(map(str, result.missing[:20])) + (", ..." if len(result.missing) > 20 else "")
        say(f"  not seen: {some}")
    others = Counter(found.reason for found in result.identity.rejected)
    what = ("crossing" if result.pattern.lines else "square") if result.pattern.is_grid else "circle"
    _print_few([f"  passed over: {count} {what}{'s' * (count > 1)}: {reason}" for reason, count in others.most_common()])
    _print_flags(cloud.quality)
    _print_sigmas(result)
    _print_sheet(result)
    fit = result.surface
    if fit is None:
        say(f"  no surface: {result.surface_problem}")
    else:
        off = [int(i) for i in fit.ids[fit.off_surface]]
        said = (
            f", {len(off)} targets off it ({', '.join(map(str, off[:MOST_LINES]))}{', ...' if len(off) > MOST_LINES else ''})"
            if off
            else ""
        )
        radius = radius_of(fit)
        size = "" if radius is None else f", radius {radius.radius_mm:.3f} +- {radius.sigma_radius_mm:.2g} mm"
        if radius is not None and radius.calibration_sigma_radius_mm > 0:
            size += f" (calibration +- {radius.calibration_sigma_radius_mm:.2g} mm)"
        say(f"  surface ({_basis(result)}): rms {fit.rms_mm:.4g} mm{size}{said}{'' if fit.converged else ', not converged'}")
    say(f"report: {folder / REPORT}")


def _basis(result: Map) -> str:
    assert result.surface is not None
    basis = result.surface.basis
    return f"{basis.kind}, degree {basis.degree}" if basis.kind in ("polynomial", "zernike") else basis.kind


def _print_sigmas(result: Map) -> None:
    import numpy as np

    from dishmap.io.results import shared_calibration
    from dishmap.targets.pose import TargetPoses

    if not isinstance(result.poses, TargetPoses):
        say("  the paper's method gives no uncertainty")
        return
    cloud = result.cloud
    own = np.median(np.sqrt(np.diagonal(cloud.covariance_mm2, axis1=1, axis2=2)), axis=0)
    pixel = float(np.median(np.sqrt(np.trace(cloud.covariance_px2, axis1=1, axis2=2))))
    normal = float(np.degrees(np.median(cloud.sigma_normal_rad)))
    say(
        f"  sigma of a target (median): x {own[0]:.2g}, y {own[1]:.2g}, z {own[2]:.2g} mm; normal {normal:.2g} deg; "
        f"centre in the photograph {pixel:.2g} px"
    )
    shared = shared_calibration(cloud, result.camera)
    if shared["known"]:
        x, y, z = shared["sigma_rms_mm"]
        say(f"  besides, shared by all targets through the calibration: x {x:.2g}, y {y:.2g}, z {z:.2g} mm")
    else:
        say(f"  the part shared by all targets through the calibration is not known: {shared['reason']}")


def _print_sheet(result: Map) -> None:
    """What the joint estimate of a grid learnt."""
    from dishmap.verdict import sheet_words, side_warning

    words = [(f"{what[0].lower()}{what[1:]} {value}", meaning) for what, value, meaning in sheet_words(result)]
    if words:
        say(f"  learnt of the print: {', '.join(told for told, _ in words[:-2])}")
    for told, meaning in words[-2:]:
        say(f"  {told}: {meaning}")
    if wrong := side_warning(result):
        say(f"  {wrong}")


def _print_flags(quality: NDArray[np.int64]) -> None:
    from dishmap.quality import MEANING

    for flag, meaning in MEANING.items():
        count = int((quality & int(flag) != 0).sum())
        if count:
            say(f"  flagged {str(flag.name).lower()}: {count} ({meaning})")


def _print_few(lines: list[str]) -> None:
    for line in lines[:MOST_LINES]:
        say(line)
    if len(lines) > MOST_LINES:
        say(f"  ... and {len(lines) - MOST_LINES} more, see summary.json")
