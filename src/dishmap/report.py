"""The report of a map: one HTML page that works offline, can be printed, and says first what matters.

The same input gives the same page, byte for byte, with the same versions of the libraries that are listed at its end.
"""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

import numpy as np
from numpy.typing import NDArray

from dishmap import __version__
from dishmap.camera.model import Camera
from dishmap.camera.uncertainty import projection_error
from dishmap.page import bullet_list, charts, fact_grid, figure, page, paragraph, script_json, section, table, verdict_box
from dishmap.pipeline import Map
from dishmap.plot.maps import normals_map, ratio_histogram, residual_map, sigma_map
from dishmap.plot.outlines import check_picture, outlines_of, unused_outlines
from dishmap.plot.photograph import error_svg, photograph_frame, photograph_svg, shows_ids
from dishmap.plot.scene import exaggeration, scene_of
from dishmap.quality import MEANING, names
from dishmap.surface.fit import SurfaceFit
from dishmap.verdict import (
    Numbers,
    Verdict,
    number,
    numbers_of,
    rejected_targets,
    rows_of_reasons,
    sheet_words,
    targets,
    unused_marks,
    verdict_of,
)

Array = NDArray[np.float64]

LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "matplotlib", "plotly")
# Rows and columns of the circles of the paper's Fig. 1.
FIGURE_1_GRID = (9, 12)
COMMON_ERRORS = (
    "Errors of a grid's targets go together over the sheet, while sigmas of coefficients from noise are those of independent ones: they "
    "are too small, for the broadest shapes several times."
)


def map_report(result: Map, image: NDArray[np.generic], title: str, inputs: dict[str, str]) -> str:
    """The report of a map as one HTML page.

    image: the picture (H, W) that was measured, grey: the photograph, or for the method `paper` the undistorted one.
    title: the page's heading; inputs: what the map was made from, by name, listed at its end.
    Raises ImageError when the picture does not have the size of `result.camera`.
    """
    check_picture(image, result.camera)
    numbers = numbers_of(result)
    verdict = verdict_of(result, numbers)
    body = [
        *_verdict(verdict),
        _photograph(result, numbers, image),
        _surface(result, numbers),
        _targets(result, numbers),
        _sheet(result),
        calibration_error_section(result.camera, image),
        _quality(result),
        _table(result, numbers),
        inputs_section(inputs),
    ]
    return page(title, body, _scripts(result, numbers))


def _verdict(verdict: Verdict) -> list[str]:
    parts = [verdict_box(verdict.headline, bool(verdict.warnings)), fact_grid((f.name, f.value, f.detail) for f in verdict.facts)]
    return [*parts, section("What to know", bullet_list(verdict.warnings))] if verdict.warnings else parts


def _photograph(result: Map, numbers: Numbers, image: NDArray[np.generic]) -> str:
    outlines = [*unused_outlines(result), *outlines_of(result, numbers)]
    lost = rejected_targets(result)
    alt = f"The photograph with {targets(len(result.cloud))} outlined, {len(lost)} rejected and {len(result.missing)} not seen."
    how = "coloured by the sigma of its depth" if numbers.sigma_depth_mm is not None else "in blue, since the method gives no sigmas"
    rest = " Red and dashed with a cross: seen but rejected." if lost else ""
    where = "its neighbours have it" if result.pattern.is_grid else "it would be, were the surface undeformed"
    rest += f" White and dashed: a target that was not seen, where {where}." if result.missing else ""
    rest += " Thin dotted red: looks like a mark, but is not one of the pattern." if result.identity.rejected else ""
    frame = photograph_frame(image, outlines)
    part = f"Columns {frame.columns[0]} to {frame.columns[1] - 1}, rows {frame.rows[0]} to {frame.rows[1] - 1} of the photograph."
    named = "with its id" if shows_ids(frame, outlines) else "too many for ids to be written"
    caption = f"{part} Each measured target is outlined as it was found, {how}, {named}.{rest} Hovering over a target tells more."
    svg = photograph_svg(image, frame, outlines, "sigma of depth (mm)", alt)
    listed = rows_of_reasons(lost) + [(f"{count} without id", reason) for reason, count in unused_marks(result).items()]
    rejected = table(("target", "seen but not used, because"), listed, (0, 1)) if listed else ""
    return section("Photograph", figure(svg, caption), rejected)


def _surface(result: Map, numbers: Numbers) -> str:
    fit = result.surface
    if fit is None:
        return section("Surface", paragraph(f"No surface was fitted: {result.surface_problem}"))
    xy = numbers.dish.position_mm[:, :2]
    space = '<div id="surface3d" class="plot3d" role="img" aria-label="Interactive picture of the fitted surface with the targets."></div>'
    caption = (
        "The fitted surface with the targets, in the dish frame; turn it with the mouse. Residuals are drawn "
        f"{exaggeration(fit, xy):g} times enlarged, or at true scale, as chosen above it. Hovering tells id, position and sigma."
    )
    return section(
        "Surface",
        charts(_residual_figure(numbers, fit), _ratio_figure(numbers, fit)),
        f"<figure>{space}<figcaption>{caption}</figcaption></figure>",
        _coefficients(fit, result.pattern.is_grid),
    )


def _residual_figure(numbers: Numbers, fit: SurfaceFit) -> str:
    along = "the surface's normal" if fit.basis.along_normal else "z of the dish frame"
    return figure(
        residual_map(numbers.dish.position_mm[:, :2], fit.residual_mm, fit.off_surface, fit.ids, "residual (mm)"),
        f"Residual of each target: its distance from the fitted {fit.basis.kind} along {along}, positive towards the camera's side. "
        "Dish frame, seen from that side.",
        f"Map of residuals to the surface, {number(fit.rms_mm)} mm rms.",
    )


def _ratio_figure(numbers: Numbers, fit: SurfaceFit) -> str:
    if numbers.ratio is None or fit.noise_factor is None:
        return ""
    return figure(
        ratio_histogram(numbers.ratio, fit.noise_factor),
        f"Residuals over their claimed sigmas; their robust spread is {number(fit.noise_factor)}. Near 1, the targets' noise explains "
        "them; well above, the surface has shape that the fit does not follow. The outermost bars hold what lies beyond.",
        f"Histogram of residual over sigma, spread {number(fit.noise_factor)}.",
    )


def _targets(result: Map, numbers: Numbers) -> str:
    xy, first, why = numbers.dish.position_mm[:, :2], "", ""
    if numbers.sigma_depth_mm is None:
        why = paragraph("The paper's method gives no uncertainty, so there is no map of sigmas.")
    else:
        first = figure(
            sigma_map(xy, numbers.sigma_depth_mm, "sigma of depth (mm)"),
            "Sigma of each target's depth (along the camera's axis), from the photograph's noise alone.",
            f"Map of depth sigmas, median {number(float(np.median(numbers.sigma_depth_mm)))} mm.",
        )
    reference = "fitted surface's normal" if result.surface else "pattern's nominal normal"
    angle = np.degrees(numbers.lean_angle_rad)
    claimed = ""
    if numbers.sigma_depth_mm is not None:
        claimed = f", where the median claimed sigma is {number(float(np.degrees(np.median(result.cloud.sigma_normal_rad))))}°"
    second = figure(
        normals_map(xy, numbers.lean_rad, reference),
        f"Lean of each measured normal from the {reference}; median {number(float(np.median(angle)))}°{claimed}.",
        f"Arrows of normals against the {reference}, median {number(float(np.median(angle)))} degrees.",
    )
    return section("Depth and normals", why, charts(first, second))


def _sheet(result: Map) -> str:
    """What the joint estimate of a grid learnt of print and film."""
    rows = sheet_words(result)
    if not rows:
        return ""
    about = paragraph(
        "A grid is measured as one smooth sheet: places in the photograph, printed lengths along the surface and smoothness hold it "
        "together, and how far each may be off is learnt from the photograph. The sigmas of all targets hold these sizes."
    )
    return section("What the grid showed of its print", about, table(("what", "value", "meaning"), rows, (0, 1, 2)))


def _coefficients(fit: SurfaceFit, grid: bool) -> str:
    own = np.sqrt(np.diag(fit.covariance))
    shared = None if fit.calibration_covariance is None else np.sqrt(np.diag(fit.calibration_covariance))
    heads = ["coefficient", "value", "sigma, noise", *([] if shared is None else ["sigma, calibration"]), "unit"]
    rows = []
    for i, name in enumerate(fit.names):
        sigmas = [number(float(own[i])), *([] if shared is None else [number(float(shared[i]))])]
        rows.append([name, f"{fit.coefficients[i]:.6g}", *sigmas, fit.units[i]])
    title = f"<h3>Coefficients of the {fit.basis.kind} (dish frame)</h3>"
    return title + table(heads, rows, (0, len(heads) - 1)) + (paragraph(COMMON_ERRORS) if grid else "")


def calibration_error_section(camera: Camera, image: NDArray[np.generic] | None) -> str:
    """The paper's Fig. 1: circles of the expected projection error, over a photograph (H, W) if one is given."""
    heading = "Expected projection error of the camera"
    if camera.covariance is None:
        return section(heading, paragraph("Not known: the camera file carries no covariance. `dishmap calibrate` writes one that does."))
    error = projection_error(camera, FIGURE_1_GRID)
    shape = projection_error(camera, FIGURE_1_GRID, remove_rotation=True)
    summary = f"median {number(float(np.nanmedian(error.sigma_px)))} px, rms {number(error.rms_px)} px over the picture"
    svg = error_svg(error, camera.width_px, camera.height_px, f"Map of the expected projection error, {summary}.", image)
    caption = (
        "Radius of each circle: the error to be expected where a known direction is projected, from the calibration's covariance; "
        f"{summary}. Without the small turn of the camera that explains most of it, {number(shape.rms_px)} px rms are left. "
        "Orange and dashed: larger than drawn. No circle: the lens model does not reach there."
    )
    return section(heading, figure(svg, caption))


def _quality(result: Map) -> str:
    bits = result.cloud.quality
    rows = [(str(flag.name).lower(), str(int(((bits & int(flag)) != 0).sum())), meaning) for flag, meaning in MEANING.items()]
    rows = [row for row in rows if row[1] != "0"]
    clean = paragraph(f"{int((bits == 0).sum())} of {targets(len(bits))} measured are clean, that is without a flag.")
    return section("Quality", clean, table(("flag", "targets", "meaning"), rows, (0, 2)) if rows else "")


def _table(result: Map, numbers: Numbers) -> str:
    cloud, fit = result.cloud, result.surface
    heads = ["id", "x (mm)", "y (mm)", "z (mm)", "nx", "ny", "nz", "u (px)", "v (px)"]
    columns = [[str(i) for i in cloud.ids.tolist()]]
    columns += [[f"{value:.3f}" for value in cloud.position_mm[:, i]] for i in range(3)]
    columns += [[f"{value:.4f}" for value in cloud.normal[:, i]] for i in range(3)]
    columns += [[f"{value:.3f}" for value in cloud.center_px[:, i]] for i in range(2)]
    if numbers.sigma_depth_mm is not None:
        heads += ["σ z (mm)", "σ normal (°)"]
        columns += [[number(float(s)) for s in numbers.sigma_depth_mm], [number(float(s)) for s in np.degrees(cloud.sigma_normal_rad)]]
    if fit is not None:
        heads.append("residual (mm)")
        columns.append([f"{value:.4f}" for value in fit.residual_mm])
    heads.append("flags")
    columns.append([names(int(q)).replace("|", ", ") for q in cloud.quality])
    about = paragraph(
        "Positions and normals in the camera frame (x right, y down, z forward); u, v is the projection of the target's centre."
    )
    return section("All measured targets", about, table(heads, zip(*columns, strict=True), (len(heads) - 1,)))


def inputs_section(inputs: dict[str, str]) -> str:
    """What the page was made from, and by which versions."""
    versions = [("dishmap", __version__), ("Python", platform.python_version()), *((name, _version(name)) for name in LIBRARIES)]
    rows = [*inputs.items(), *((f"version of {name}", text) for name, text in versions)]
    return section("Inputs and versions", table(("what", "value"), rows, (0, 1)))


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "unknown"


def _scripts(result: Map, numbers: Numbers) -> list[str]:
    """The library plotly.js and the call that draws the 3D picture; nothing without a surface."""
    if result.surface is None:
        return []
    from plotly.offline import get_plotlyjs

    data, layout = scene_of(result, numbers, result.surface)
    config = {"displaylogo": False, "responsive": True, "modeBarButtons": [["zoom3d", "pan3d", "orbitRotation", "resetCameraDefault3d"]]}
    call = f'Plotly.newPlot("surface3d",{script_json(data)},{script_json(layout)},{script_json(config)});'
    return [get_plotlyjs(), call]
