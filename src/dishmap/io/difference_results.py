"""The files of a difference beside its tables: surface.json, summary.json, and summary.csv over several states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dishmap.compare import DISPLACEMENT, JOINT, PAPER, SHAPE, Difference
from dishmap.difference.difference_map import DifferenceMap
from dishmap.difference.paper import PaperDifference
from dishmap.difference.saved import saved_difference
from dishmap.figures import apart, distance_mm, figures_of
from dishmap.io.atomic import write_files
from dishmap.io.csv_table import format_csv
from dishmap.io.difference_file import format_difference, format_difference_ply
from dishmap.io.difference_map_file import DIFFERENCE_FILE, difference_bytes
from dishmap.io.pose_file import pose_content
from dishmap.io.results import SURFACE_FORMAT, camera_content, hint_content, json_text, sha256_of, surface_content, versions
from dishmap.quality import Quality
from dishmap.surface.zernike import term_name
from dishmap.targets.identify import Hint

SUMMARY_FORMAT = "dishmap-difference/1"
STATES_FILE = "summary.csv"
# Beside the main method's files, those of the paper's method when both were asked for.
BESIDE = {"difference.csv": "difference_paper.csv", "difference.ply": "difference_paper.ply", "surface.json": "surface_paper.json"}
PPM = 1e6
STATE_COLUMNS = (
    *("state", "photographs", "method", "targets", "displacement_rms_mm", "sigma_displacement_rms_mm", "depth_change_rms_mm"),
    *("sigma_depth_change_rms_mm", "shape_rms_mm", "sigma_shape_rms_mm", "largest_shape_mm", "largest_shape_id"),
    *("p_value", "changed", "move_x_mm", "move_y_mm", "move_z_mm", "turn_x_deg", "turn_y_deg", "turn_z_deg"),
    *("expansion_ppm", "sigma_expansion_ppm", "converged", "paper_displacement_rms_mm", "paper_shape_rms_mm", "problem"),
)


@dataclass(frozen=True)
class DifferenceProvenance:
    """What a difference was made from.

    inputs: what each file is -> its path; reference_frames, current_frames: photographs averaged for each state; hint: as given;
    seconds: name of a step -> time it took.
    """

    inputs: Mapping[str, str | Path] = field(default_factory=dict)
    reference_frames: int = 1
    current_frames: int = 1
    hint: Hint = None
    seconds: Mapping[str, float] = field(default_factory=dict)


def difference_files(result: Difference, provenance: DifferenceProvenance) -> dict[str, str | bytes]:
    """All files of a difference but its report: name -> text. Raises InputError when an input file cannot be read again."""
    files: dict[str, str | bytes] = {}
    for place, (method, table) in enumerate(result.tables.items()):
        own = {
            "difference.csv": format_difference(table),
            "difference.ply": format_difference_ply(table),
            "surface.json": _surface_text(result, method),
        }
        files |= {BESIDE[name] if place else name: text for name, text in own.items()}
    if result.joint is not None:
        files[DIFFERENCE_FILE] = difference_bytes(saved_difference(result.joint, result.pattern))
    return {**files, "summary.json": difference_summary(result, provenance)}


def write_difference(folder: str | Path, files: Mapping[str, str | bytes]) -> None:
    """Write the files of a difference into an existing folder, all or none.

    What another method left there of an earlier difference is removed when this one has none. Raises InputError when a file cannot be
    written.
    """
    write_files(folder, files)
    for name in (*BESIDE.values(), DIFFERENCE_FILE):
        if name not in files:
            with suppress(FileNotFoundError):
                (Path(folder) / name).unlink()


def difference_summary(result: Difference, provenance: DifferenceProvenance) -> str:
    """The text of `summary.json` of a difference. Raises InputError when an input file cannot be read again."""
    camera = result.camera
    content: dict[str, Any] = {
        "format": SUMMARY_FORMAT,
        "versions": versions(),
        "inputs": {what: {"path": str(path), "sha256": sha256_of(path)} for what, path in provenance.inputs.items()},
        "image": {"width_px": camera.width_px, "height_px": camera.height_px},
        "method": result.method,
        "hint": hint_content(provenance.hint),
        "camera": camera_content(camera),
        "camera_from_dish": pose_content(result.reference.camera_from_dish),
        "frames": {"reference": provenance.reference_frames, "current": provenance.current_frames},
        "same_photograph": result.same,
        "counts": {
            "in_pattern": len(result.pattern),
            "reference": len(result.reference),
            "current": len(result.current),
            "compared": len(result.table),
            "flagged": int((result.table.quality != 0).sum()),
        },
        "joint": None if result.joint is None else _joint(result, result.joint),
        "paper": None if result.paper is None else _paper(result, result.paper),
        "apart": asdict(apart(result.tables[JOINT], result.tables[PAPER])) if len(result.tables) == 2 else None,
        "problems": dict(result.surface_problems),
        "seconds": {name: round(value, 3) for name, value in provenance.seconds.items()},
    }
    return json_text(content)


def _joint(result: Difference, joint: DifferenceMap) -> dict[str, Any]:
    sigma = np.sqrt(np.diag(joint.rigid_covariance))
    given = joint.priors.expansion_ppm is not None
    return {
        **asdict(figures_of(result.tables[JOINT])),
        "significance": {**asdict(joint.significance), "changed": bool(joint.significance.changed)},
        "rigid_motion": {
            "dish_from_dish": pose_content(joint.rigid_motion),
            "sigma_translation_mm": sigma[:3].tolist(),
            "sigma_rotation_deg": np.degrees(sigma[3:]).tolist(),
            "covariance_mm_rad": joint.rigid_covariance.tolist(),
        },
        "expansion": {
            "mean_ppm": PPM * joint.expansion[0],
            "sigma_ppm": PPM * joint.expansion[1],
            "assumed_mean_ppm": PPM * joint.expansion_assumed[0],
            "assumed_sigma_ppm": PPM * joint.expansion_assumed[1],
            "assumption": "given" if given else "default",
            "distance_mm_per_100_ppm": 100 / PPM * distance_mm(result),
        },
        "focal_drift": {"mean": joint.focal_drift[0], "sigma": joint.focal_drift[1]},
        "zernike": [
            {"name": term_name(n, m), "n": n, "m": m, "value_mm": float(value), "sigma_mm": float(spread)}
            for (n, m), value, spread in zip(
                joint.zernike_terms, joint.zernike_mm, np.sqrt(np.diag(joint.zernike_covariance_mm2)), strict=True
            )
        ],
        "zernike_covariance_mm2": joint.zernike_covariance_mm2.tolist(),
        "priors": asdict(joint.priors),
        "considered": [asdict(one) for one in joint.considered],
        "learnt": list(joint.learnt),
        "noise_factor": joint.noise_factor,
        "converged": bool(joint.converged),
        "outliers": joint.ids[(joint.quality & int(Quality.OUTLIER)) != 0].tolist(),
        "rejected": [{"id": int(ident), "reason": why} for ident, why in joint.rejected],
    }


def _paper(result: Difference, paper: PaperDifference) -> dict[str, Any]:
    """The paper's method; `centers`: whose it used, the paper's own or (for a saved measurement) those of the fitted targets."""
    return {
        **asdict(figures_of(result.tables[PAPER])),
        "centers": "paper" if paper.ratios.noise is None else "fitted",
        "normals": paper.normals,
        "reach_mm": paper.reach_mm,
        "pairs": len(paper.ratios),
        "pairs_used": int((paper.confidence > 0).sum()),
        "registration_scale": float(paper.registration.scale),
        "common_depth_change_mm": paper.common_depth_change_mm,
        "extrapolated": paper.ids[paper.extrapolated].tolist(),
    }


def _surface_text(result: Difference, method: str) -> str:
    """The text of `surface.json`: the surface through the displacement, for the joint estimate also the one through the shape."""
    main = PAPER if method == PAPER else DISPLACEMENT
    content = {"format": SURFACE_FORMAT, "quantity": "displacement_mm", **_surface(result, main)}
    if method == JOINT:
        content["shape"] = {"quantity": "shape_mm", **_surface(result, SHAPE)}
    content["camera_from_dish"] = pose_content(result.reference.camera_from_dish)
    return json_text(content)


def _surface(result: Difference, name: str) -> dict[str, Any]:
    fit = result.surfaces.get(name)
    head = {"fitted": fit is not None, "problem": result.surface_problems.get(name, "")}
    return head if fit is None else {**head, **surface_content(fit)}


def state_row(state: str, photographs: Sequence[str | Path], result: Difference) -> dict[str, Any]:
    """One row of `summary.csv`."""
    figures = asdict(figures_of(result.table))
    row = {"state": state, "photographs": "|".join(map(str, photographs)), "method": result.method, **figures}
    if result.joint is not None:
        joint = result.joint
        move, turn = joint.rigid_motion.translation_mm, np.degrees(joint.rigid_motion.rotation_vector_rad)
        row |= {"p_value": joint.significance.p_value, "changed": bool(joint.significance.changed)}
        row |= {f"move_{axis}_mm": float(value) for axis, value in zip("xyz", move, strict=True)}
        row |= {f"turn_{axis}_deg": float(value) for axis, value in zip("xyz", turn, strict=True)}
        row |= {"expansion_ppm": PPM * joint.expansion[0], "sigma_expansion_ppm": PPM * joint.expansion[1]}
        row["converged"] = bool(joint.converged)
    if result.paper is not None:
        paper = figures_of(result.tables[PAPER])
        row |= {"paper_displacement_rms_mm": paper.displacement_rms_mm, "paper_shape_rms_mm": paper.shape_rms_mm}
    return row


def failed_row(state: str, photographs: Sequence[str | Path], method: str, problem: str) -> dict[str, Any]:
    """The row of `summary.csv` of a state that could not be compared."""
    return {"state": state, "photographs": "|".join(map(str, photographs)), "method": method, "problem": problem}


def format_states(rows: Sequence[Mapping[str, Any]]) -> str:
    """The text of `summary.csv`: one row a state; a cell is empty where a method does not give it."""
    return format_csv(STATE_COLUMNS, rows)
