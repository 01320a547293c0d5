"""The report of plans: one HTML page that compares the cases and draws, for each, what the camera will see and how well it will measure."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dishmap.page import bullet_list, charts, fact_grid, figure, page, paragraph, section, table, verdict_box
from dishmap.planning import Plan, PlannedCase
from dishmap.planning_verdict import calibration_depth_mm, figures_of_plan, plan_verdict, rough
from dishmap.plot.maps import sigma_map
from dishmap.plot.outlines import nominal_ellipses
from dishmap.plot.photograph import Outline, frame_of, photograph_svg
from dishmap.report import inputs_section
from dishmap.verdict import Verdict

Array = NDArray[np.float64]

# The picture that is not taken yet.
BLANK_GREY = 214


def plan_report(cases: list[PlannedCase], title: str, inputs: Mapping[str, str]) -> str:
    """The report of plans as one HTML page; at least one case must have a plan.

    title: the page's heading; inputs: what the plans were made from, by name, listed at its end.
    """
    made = [(case.name, case.plan, plan_verdict(case.plan)) for case in cases if case.plan is not None]
    body: list[str] = []
    if len(cases) == 1:
        name, only, verdict = made[0]
        body += [paragraph(name), verdict_box(verdict.headline, bool(verdict.warnings)), *_parts(only, verdict)]
    else:
        body.append(section("Comparison", paragraph("Median over the targets, and the worst in brackets."), _comparison(cases)))
        for name, plan, verdict in made:
            box = verdict_box(verdict.headline, bool(verdict.warnings))
            body.append(section(name[:1].upper() + name[1:], box, *_parts(plan, verdict)))
    return page(title, [*body, _assumed(made[0][1]), inputs_section(dict(inputs))])


def comparison_rows(cases: list[PlannedCase]) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of the table of all cases: medians over targets, and the worst in brackets."""
    known = [(case, figures_of_plan(case.plan)) for case in cases if case.plan is not None]
    heads = ["case", "targets", *(f"{f.words} ({f.unit})" for f in known[0][1])]
    rows = {case.name: _row(case, [f"{rough(f.median)} ({rough(f.worst)})" for f in figures]) for case, figures in known}
    nothing = ["-"] * len(known[0][1])
    return heads, [rows.get(case.name) or [case.name, "0", *nothing] for case in cases]


def _row(case: PlannedCase, cells: list[str]) -> list[str]:
    assert case.plan is not None
    return [case.name, f"{len(case.plan.cloud)} of {len(case.plan.pattern)}", *cells]


def _comparison(cases: list[PlannedCase]) -> str:
    heads, rows = comparison_rows(cases)
    problems = [f"{case.name}: {case.problem}." for case in cases if case.plan is None]
    return table(heads, rows, (0,)) + (bullet_list(problems) if problems else "")


def _parts(plan: Plan, verdict: Verdict) -> list[str]:
    parts = [fact_grid((f.name, f.value, f.detail) for f in verdict.facts)]
    if verdict.warnings:
        parts.append(bullet_list(verdict.warnings))
    return [*parts, _picture(plan), _maps(plan)]


def _picture(plan: Plan) -> str:
    camera, ids = plan.camera, plan.pattern.ids
    ellipses = nominal_ellipses(camera, plan.pattern, plan.camera_from_dish)
    center = camera.project(plan.camera_from_dish.apply(plan.pattern.center_mm))
    sigma = dict(zip(plan.cloud.ids.tolist(), plan.sigma_depth_mm.tolist(), strict=True))
    why = dict(plan.lost)
    outlines = []
    for i, ident in enumerate(ids.tolist()):
        if ident in sigma:
            told = f"target {ident}: sigma of depth {rough(sigma[ident])} mm"
            outlines.append(Outline(ellipses[i], center[i], str(ident), told, sigma[ident], "good"))
        elif camera.contains(center[i]):
            outlines.append(Outline(ellipses[i], center[i], str(ident), f"target {ident}: {why[ident]}", np.nan, "rejected"))
    blank = np.full((camera.height_px, camera.width_px), BLANK_GREY, np.uint8)
    crossed = " Red with a cross: cannot be measured." if any(o.state == "rejected" for o in outlines) else ""
    caption = (
        f"What the camera will see: the outermost circles of all targets in the whole picture of {camera.width_px}x{camera.height_px} px, "
        f"coloured by the sigma of their depth.{crossed} Hovering over a target tells more."
    )
    alt = f"The picture with the outlines of {len(plan.cloud)} targets that can be measured."
    frame = frame_of(camera.width_px, camera.height_px)
    return figure(photograph_svg(blank, frame, outlines, "sigma of depth (mm)", alt), caption)


def _maps(plan: Plan) -> str:
    xy = plan.pattern.center_mm[plan.index, :2]
    shown = [
        ("depth", "mm", plan.sigma_depth_mm, "Sigma of depth (along the camera's axis) in one photograph, from its noise alone."),
        ("normal", "deg", np.degrees(plan.cloud.sigma_normal_rad), "Sigma of the normal in one photograph (rms angle)."),
        ("shape", "mm", plan.shape_mm, "Sigma of the change of shape (rigid motion removed) between two photographs."),
    ]
    return charts(
        *(
            figure(sigma_map(xy, values, f"sigma of {what} ({unit})"), caption, f"Map of the sigma of {what}.")
            for what, unit, values, caption in shown
            if np.isfinite(values).all()
        )
    )


def _assumed(plan: Plan) -> str:
    given = plan.conditions
    how = "as given" if given.assumptions.normal_sigma_deg is not None else "learnt from a photograph of such a surface"
    told = [
        f"Contrast between ground and ink {given.contrast_to_noise:g} times the noise of a pixel; blur of the optics "
        f"{given.psf_sigma_px:g} px (sigma), to which the pixels' own area is added.",
        f"The surface strays from its nominal shape, and moves between two photographs, by {rough(given.amplitude_mm)} mm (sigma) that "
        f"change over {rough(plan.length_mm)} mm; points follow a displacement by the way `{given.slide}`. The camera may move too.",
        f"How far normals stray from the pattern's surface is {how}.",
        f"Printed edges lie outwards by {100 * given.assumptions.ink_spread_fraction:g} % of a target's largest radius, the tone curve "
        f"shifts them by {given.assumptions.tone_shift_px:g} px (both sigma).",
        "Each target keeps its printed size: where the surface stretches by 1e-4, single photographs put a target wrong by as much of its "
        "distance, which no sigma here holds.",
    ]
    if calibration_depth_mm(plan) is None:
        told.append("The calibration's part is not known: it comes with a camera file made by `dishmap calibrate`.")
    return section("What was assumed", bullet_list(told))
