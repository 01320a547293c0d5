"""The files of plans: `plan.csv`, one row a target of each case, and `summary.json`."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from dishmap.io.pose_file import pose_content
from dishmap.io.results import camera_content, json_text, sha256_of, shared_calibration, versions
from dishmap.planning import Plan, PlannedCase
from dishmap.planning_verdict import figures_of_plan, plan_verdict
from dishmap.quality import names

PLAN_FORMAT = "dishmap-plan/1"
PLACE = ("x_mm", "y_mm", "z_mm", "u_px", "v_px")
SIGMAS = (
    *("sigma_across_mm", "sigma_px", "sigma_depth_mm", "sigma_normal_deg", "sigma_displacement_mm", "sigma_shape_mm"),
    "calibration_depth_mm",
)
VIEW = ("view_deg", "smallest_radius_px", "narrowest_px")
COLUMNS = ("case", "id", *PLACE, *SIGMAS, *VIEW, "quality", "problem")


def format_plans(cases: list[PlannedCase]) -> str:
    """The text of `plan.csv`: every target of every case that has a plan; cells are empty where a target cannot be measured."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for case in cases:
        if case.plan is not None:
            writer.writerows(_rows(case.name, case.plan))
    return out.getvalue()


def _rows(name: str, plan: Plan) -> list[list[str]]:
    pattern, why = plan.pattern, dict(plan.lost)
    center = plan.camera.project(plan.camera_from_dish.apply(pattern.center_mm))
    place = np.column_stack([pattern.center_mm, center])
    figures = {figure.key: figure.values for figure in figures_of_plan(plan)}
    numbers = np.full((len(pattern), len(SIGMAS) + len(VIEW)), np.nan)
    for k, key in enumerate(SIGMAS):
        numbers[plan.index, k] = figures.get(key, np.nan)
    numbers[plan.index, len(SIGMAS) :] = np.column_stack([np.degrees(plan.view_rad), plan.smallest_radius_px, plan.narrowest_px])
    flags = np.zeros(len(pattern), np.int64)
    flags[plan.index] = plan.cloud.quality
    rows = []
    for i, ident in enumerate(pattern.ids.tolist()):
        cells = ["" if np.isnan(v) else f"{v:.6g}" for v in [*place[i], *numbers[i]]]
        rows.append([name, str(ident), *cells, names(int(flags[i])), why.get(ident, "")])
    return rows


def plans_text(cases: list[PlannedCase], inputs: Mapping[str, Path]) -> str:
    """The text of `summary.json`. inputs: what each file is -> its path. Raises InputError when one cannot be read again."""
    content = {
        "format": PLAN_FORMAT,
        "versions": versions(),
        "inputs": {what: {"path": str(path), "sha256": sha256_of(path)} for what, path in inputs.items()},
        "cases": [{"name": case.name, "problem": case.problem, **({} if case.plan is None else _content(case.plan))} for case in cases],
    }
    return json_text(content)


def _content(plan: Plan) -> dict[str, Any]:
    given = plan.conditions
    return {
        "image": {"width_px": plan.camera.width_px, "height_px": plan.camera.height_px},
        "camera": camera_content(plan.camera),
        "camera_from_dish": pose_content(plan.camera_from_dish),
        "assumed": {**asdict(given), "length_mm": plan.length_mm, "normal_prior_sigma_deg": float(np.degrees(plan.normal_sigma_rad))},
        "counts": {"in_pattern": len(plan.pattern), "measurable": len(plan.cloud)},
        "sigmas": {figure.key: {"median": figure.median, "worst": figure.worst} for figure in figures_of_plan(plan)},
        "shared_calibration": shared_calibration(plan.cloud, plan.camera),
        "lost": [{"id": ident, "reason": why} for ident, why in plan.lost],
        "warnings": list(plan_verdict(plan).warnings),
    }
