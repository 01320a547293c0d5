"""The report of a difference: one HTML page that works offline, can be printed, and says first what changed and how sure that is.

The same input gives the same page, byte for byte, with the same versions of the libraries that are listed at its end.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.compare import PAPER, SHAPE, Difference, DifferenceTable
from dishmap.difference.difference_map import Considered, DifferenceMap
from dishmap.difference_assumptions import SIZES, assumptions, way_words
from dishmap.difference_verdict import difference_verdict, paper_facts, set_aside, unused_targets, with_sigma
from dishmap.page import bullet_list, charts, fact_grid, figure, page, paragraph, script_json, section, table, verdict_box
from dishmap.plot.difference import change_map, misfit_histogram, misfit_map, ratio_map_chart, zernike_bars
from dishmap.plot.difference_photograph import Arrows, arrows_of, arrows_svg
from dishmap.plot.difference_scene import difference_scene, exaggeration
from dishmap.plot.maps import sigma_map
from dishmap.plot.outlines import check_picture
from dishmap.quality import MEANING, Quality, names
from dishmap.report import inputs_section
from dishmap.surface.zernike import term_name
from dishmap.verdict import Fact, id_list, number, rows_of_reasons, targets

Array = NDArray[Any]

UNKNOWN = "not known"
MM_DECIMALS, PX_DECIMALS = 4, 3
ALONG = "along the nominal normal, positive towards the camera's side"


def difference_report(result: Difference, image: NDArray[np.generic] | None, title: str, inputs: dict[str, str]) -> str:
    """The report of a difference as one HTML page.

    image: the current photograph (H, W), grey, or None where only a saved measurement is left of it. title: the page's heading;
    inputs: what the difference was made from, by name, listed at its end. Raises ImageError when the picture does not have
    the size of `result.camera`.
    """
    if image is not None:
        check_picture(image, result.camera)
    verdict = difference_verdict(result)
    body = [
        verdict_box(verdict.headline, bool(verdict.warnings)),
        _facts(verdict.facts),
        section("What to know", bullet_list(verdict.warnings)) if verdict.warnings else "",
        _assumed(result),
        _shape(result),
        _scene(result),
        _motion(result, image),
        _terms(result),
        _surface(result),
        _misfits(result),
        _paper(result),
        _hypotheses(result),
        _quality(result),
        _table(result),
        inputs_section(inputs),
    ]
    return page(title, body, _scripts(result))


def _facts(facts: tuple[Fact, ...] | list[Fact]) -> str:
    return fact_grid((fact.name, fact.value, fact.detail) for fact in facts)


def _shape(result: Difference) -> str:
    """Maps of the change of shape and of its sigma."""
    if _still(result):
        return ""
    rows, aside = result.table, set_aside(result.table)
    xy = rows.nominal_mm[:, :2]
    what = "the motion of the rigid parts" if result.joint is not None and result.joint.priors.rigid_ids else "the best-fit rigid motion"
    shape = figure(
        change_map(xy, rows.shape_mm, rows.sigma_shape_mm, aside, rows.ids, "change of shape (mm)"),
        f"Change of shape: displacement {ALONG}, with {what} taken out. Dish frame, seen from that side. "
        f"The scale of colours reaches at least 3 sigma.{_aside_words(rows)}",
        f"Map of the change of shape, {number(_rms(rows.shape_mm))} mm rms.",
    )
    if not np.isfinite(rows.sigma_shape_mm).all():
        return section("Change of shape", paragraph("The sigma of the change of shape is not known."), charts(shape))
    used = ~aside if (~aside).any() else aside
    left_out = " Targets put aside are left out." if aside.any() else ""
    sigma = figure(
        sigma_map(xy[used], rows.sigma_shape_mm[used], "sigma of the change of shape (mm)"),
        f"Sigma of each target's change of shape. Errors of neighbours go together.{left_out}",
        f"Map of its sigma, median {number(float(np.median(rows.sigma_shape_mm)))} mm.",
    )
    return section("Change of shape", charts(shape, sigma))


def _aside_words(rows: DifferenceTable) -> str:
    return " Crosses: targets that were put aside; what is drawn around them comes from their neighbours." if set_aside(rows).any() else ""


def _surface(result: Difference) -> str:
    """Coefficients of the robust surface through the change of shape, or through the paper's displacement."""
    name = next((name for name in (SHAPE, PAPER) if name in result.surfaces), None)
    if name is None or _still(result):
        return ""
    fit = result.surfaces[name]
    sigma = np.sqrt(np.diag(fit.covariance))
    rows = [
        (coefficient, f"{value:.6g}", number(float(s)) if np.isfinite(s) else UNKNOWN, unit)
        for coefficient, value, s, unit in zip(fit.names, fit.coefficients, sigma, fit.units, strict=True)
    ]
    kind = {"zernike": "Zernike terms", "polynomial": "polynomial"}.get(fit.basis.kind, fit.basis.kind)
    kind += f" up to degree {fit.basis.degree}" if fit.basis.kind in ("zernike", "polynomial") else ""
    # its disc ends at the outermost target, not at the rim as that of the terms above
    kind += f" on a disc of {fit.basis.radius_mm:.4g} mm radius" if fit.basis.kind == "zernike" else ""
    through = "change of shape" if name == SHAPE else "paper's displacement"
    off = int(fit.off_surface.sum())
    rest = f", {targets(off)} off it ({id_list(fit.ids[fit.off_surface])})" if off else ""
    left = paragraph(f"Basis: {kind}, over x and y of the dish frame; {number(fit.rms_mm)} mm rms are left over{rest}.")
    return section(f"Robust surface through the {through}", left, table(("coefficient", "value", "sigma", "unit"), rows, (0, 3)))


def _still(result: Difference) -> bool:
    """Whether the shape was taken not to change, so that there is nothing to show of it."""
    return result.joint is not None and result.joint.priors.still


def _scene(result: Difference) -> str:
    if _still(result):
        return ""
    space = '<div id="difference3d" class="plot3d" role="img" aria-label="Interactive picture of the change of shape."></div>'
    caption = (
        f"The change of shape in space, along the nominal normals, drawn {exaggeration(result.table):g} times enlarged or at true scale, "
        "as chosen above it; grey lines: the nominal surface. Turn it with the mouse; hovering tells id, position and sigma."
    )
    return section("In space", f"<figure>{space}<figcaption>{caption}</figcaption></figure>")


def _motion(result: Difference, image: NDArray[np.generic] | None) -> str:
    """Arrows over the photograph, and the map of the whole displacement."""
    rows, aside = result.table, set_aside(result.table)
    arrows = _arrows(result)
    longest = number(float(np.hypot(*rows.du_dv_px.T).max()))
    over = "over the current photograph" if image is not None else "in the picture's frame"
    which = "each target's centre" if len(arrows.titles) == arrows.of else f"the centres of {len(arrows.titles)} of {targets(arrows.of)}"
    size = f"{arrows.factor:g} times enlarged" if arrows.factor > 1 else "at true scale"
    first, last = arrows.frame.columns, arrows.frame.rows
    picture = figure(
        arrows_svg(image, arrows, f"Arrows of the motion of {targets(len(arrows.titles))} in the picture, at most {longest} px."),
        f"How {which} moved in the picture (du, dv), {over}, from the place in the reference, {size}; "
        f"the rigid motion is part of it. Columns {first[0]} to {first[1] - 1}, rows {last[0]} to {last[1] - 1}. "
        "Hovering over an arrow tells its numbers.",
    )
    moved = figure(
        change_map(rows.nominal_mm[:, :2], rows.displacement_mm, rows.sigma_displacement_mm, aside, rows.ids, "displacement (mm)"),
        f"Displacement {ALONG}, the rigid motion included. Its sigmas hold what is shared by all targets.{_aside_words(rows)}",
        f"Map of the displacement, {number(_rms(rows.displacement_mm))} mm rms.",
    )
    deep = figure(
        change_map(rows.nominal_mm[:, :2], rows.depth_change_mm, rows.sigma_depth_change_mm, aside, rows.ids, "change of depth (mm)"),
        "Change of depth, along the camera's axis, positive away from the camera, the rigid motion included.",
        f"Map of the change of depth, {number(_rms(rows.depth_change_mm))} mm rms.",
    )
    return section("Motion in the picture and displacement", picture, charts(moved, deep))


def _arrows(result: Difference) -> Arrows:
    rows, camera = result.table, result.camera
    start = result.reference.center_px[_rows_of(result.reference.ids, rows.ids)]
    titles = tuple(
        f"target {i}: du {_signed(u, PX_DECIMALS)}, dv {_signed(v, PX_DECIMALS)} px; displacement {with_sigma(d, s, ' mm', sign=True)}"
        for i, (u, v), d, s in zip(
            rows.ids.tolist(), rows.du_dv_px.tolist(), rows.displacement_mm.tolist(), rows.sigma_displacement_mm.tolist(), strict=True
        )
    )
    return arrows_of((camera.width_px, camera.height_px), start, rows.du_dv_px, titles)


def _rows_of(ids: Array, wanted: Array) -> Array:
    """Where each of `wanted` stands in `ids`, which holds them all."""
    order = np.argsort(ids)
    return np.asarray(order[np.searchsorted(ids, wanted, sorter=order)])


def _terms(result: Difference) -> str:
    joint = result.joint
    if joint is None or not joint.zernike_terms or joint.priors.still:
        return ""
    sigma = np.sqrt(np.diag(joint.zernike_covariance_mm2))
    labels = [f"{term_name(n, m).replace('_', ' ')} ({n}, {m})" for n, m in joint.zernike_terms]
    chart = figure(
        zernike_bars(labels, joint.zernike_mm, sigma),
        "Zernike terms (n, m) of the displacement along the normal, piston and tilt left to the rigid motion. Unnormalised: a size is the "
        "largest displacement of that term at the rim.",
        "Bars of the Zernike terms with their sigmas.",
    )
    rows = [
        (label, _signed(value, MM_DECIMALS), number(float(s)), _signed(value / s, 1) if s > 0 else UNKNOWN)
        for label, value, s in zip(labels, joint.zernike_mm, sigma, strict=True)
    ]
    return section("Zernike terms", chart, table(("term (n, m)", "size (mm)", "sigma (mm)", "size / sigma"), rows, (0,)))


def _misfits(result: Difference) -> str:
    joint = result.joint
    if joint is None:
        return ""
    aside = set_aside(result.table)
    where = figure(
        misfit_map(joint.nominal_mm[:, :2], joint.misfit, aside, joint.ids),
        "Misfit of each target: root of the mean square of its residuals in sigmas, over three moves and three turns, after all that "
        "may have moved was fitted. Where it stands out, a target was disturbed or the surface bent too sharply to be followed.",
        f"Map of misfits, median {number(float(np.median(joint.misfit)))}.",
    )
    count = figure(
        misfit_histogram(joint.misfit, aside),
        "The same misfits counted. Fitting makes them smaller than the curve, which is that of noise alone before any fit; a tail "
        "beyond it is worth a look. The last bar holds what lies beyond.",
        "Histogram of misfits.",
    )
    return section("Residuals", charts(where, count))


def _paper(result: Difference) -> str:
    paper = result.paper
    if paper is None:
        return ""
    rows = result.tables[PAPER]
    ratios = figure(
        ratio_map_chart(paper.place_mm, paper.ratios.pair, paper.ratios.ratio, paper.confidence > 0),
        "Ratio of the distances of pairs of targets in the current picture to those in the registered reference, less one. "
        "Red: farther apart, so nearer to the camera. Dotted grey: pairs not used.",
        "Map of ratios of pairs of targets.",
    )
    moved = figure(
        change_map(rows.nominal_mm[:, :2], rows.shape_mm, rows.sigma_shape_mm, set_aside(rows), rows.ids, "change of shape (mm)"),
        "Change of shape by the paper's method (Algorithm 3): its surface through the displacements, best-fit rigid motion taken out.",
        f"Map of the paper's change of shape, {number(_rms(rows.shape_mm))} mm rms.",
    )
    # without a joint estimate this map already stands on top
    both = (ratios, moved) if result.joint is not None else (ratios,)
    return section("By the paper's method", _facts(paper_facts(result)), charts(*both))


def _assumed(result: Difference) -> str:
    if result.joint is None:
        return ""
    return section("What was assumed, and what one camera cannot see", bullet_list(assumptions(result.joint, _flat(result))))


def _flat(result: Difference) -> bool:
    return result.pattern.surface.kind == "plane"


def _hypotheses(result: Difference) -> str:
    """The ways of moving that were weighed."""
    joint = result.joint
    if joint is None:
        return ""
    weighed = sorted(joint.considered, key=lambda c: -c.weight)
    shown = [name for name in SIZES if any(c.sizes.get(name, 0.0) > 0 or name in joint.learnt for c in weighed)]
    heads = ["the surface moved", "over (mm)", "weight", "log evidence below the best"]
    heads += [f"{SIZES[name][0]} ({SIZES[name][2]}), {'learnt' if name in joint.learnt else 'given'}" for name in shown]
    top = max(c.log_evidence for c in weighed)
    rows = [_hypothesis(joint, c, shown, _flat(result), top) for c in weighed]
    about = paragraph(
        "Each row is one way in which the surface may have moved, with the sizes (standard deviations) that make the photographs most "
        "probable. Results are averaged over the rows with their weights; ways that count for less than a thousandth are left out."
    )
    return section("Ways of moving that were weighed", about, table(heads, rows, (0,)))


def _hypothesis(joint: DifferenceMap, one: Considered, shown: list[str], flat: bool, top: float) -> list[str]:
    sizes = [number(SIZES[name][1] * one.sizes[name]) for name in shown]
    way = way_words(joint, one, flat) + ("" if one.converged else " (not converged)")
    return [way, number(one.length_mm), f"{one.weight:.1%}", number(top - one.log_evidence), *sizes]


def _quality(result: Difference) -> str:
    rows = result.table
    bits = rows.quality
    flags = [(names(int(flag)), id_list(rows.ids[(bits & int(flag)) != 0]), meaning) for flag, meaning in MEANING.items()]
    flags = [row for row in flags if row[1]]
    clean = paragraph(f"{int((bits == 0).sum())} of {targets(len(bits))} compared are clean in both states, that is without a flag.")
    lost = rows_of_reasons(unused_targets(result))
    return section(
        "Outliers and flags",
        clean,
        table(("flag", "targets", "meaning"), flags, (0, 1, 2)) if flags else "",
        table(("target", "not used, because"), lost, (0, 1)) if lost else "",
    )


def _table(result: Difference) -> str:
    rows, joint = result.table, result.joint
    heads = ["id", "x (mm)", "y (mm)", "z (mm)", "displacement (mm)", "σ", "depth change (mm)", "σ", "change of shape (mm)", "σ"]
    columns = [[str(i) for i in rows.ids.tolist()]]
    columns += [[f"{value:.1f}" for value in rows.nominal_mm[:, i]] for i in range(3)]
    for value, sigma in (
        (rows.displacement_mm, rows.sigma_displacement_mm),
        (rows.depth_change_mm, rows.sigma_depth_change_mm),
        (rows.shape_mm, rows.sigma_shape_mm),
    ):
        columns += [_fixed(value, MM_DECIMALS), [number(float(s)) if np.isfinite(s) else UNKNOWN for s in sigma]]
    heads += ["du (px)", "dv (px)"]
    columns += [_fixed(rows.du_dv_px[:, i], PX_DECIMALS) for i in range(2)]
    if joint is not None:
        heads.append("misfit")
        columns.append([f"{value:.2f}" for value in joint.misfit])
    heads.append("flags")
    columns.append([names(int(q)).replace("|", ", ") for q in rows.quality])
    about = paragraph(
        f"Nominal places in the dish frame; displacement and change of shape {ALONG}; depth along the camera's axis, away from the camera; "
        f"du, dv: motion of the centre in the picture; each σ is one standard deviation. A target flagged {names(int(Quality.OUTLIER))} "
        "holds what its neighbours say."
    )
    return section("All targets", about, table(heads, zip(*columns, strict=True), (len(heads) - 1,)))


def _signed(value: float, decimals: int) -> str:
    # + 0.0 turns what rounds to minus zero into zero
    return f"{round(float(value), decimals) + 0.0:+.{decimals}f}"


def _fixed(values: Array, decimals: int) -> list[str]:
    return [f"{value:.{decimals}f}" for value in (np.round(values, decimals) + 0.0).tolist()]


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _scripts(result: Difference) -> list[str]:
    """The library plotly.js and the call that draws the 3D picture, where there is one."""
    if _still(result):
        return []
    from plotly.offline import get_plotlyjs

    rows = result.table
    data, layout = difference_scene(rows, result.pattern.normal[_rows_of(result.pattern.ids, rows.ids)])
    config = {"displaylogo": False, "responsive": True, "modeBarButtons": [["zoom3d", "pan3d", "orbitRotation", "resetCameraDefault3d"]]}
    call = f'Plotly.newPlot("difference3d",{script_json(data)},{script_json(layout)},{script_json(config)});'
    return [get_plotlyjs(), call]
