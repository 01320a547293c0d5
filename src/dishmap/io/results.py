"""The files of a map.

points.csv, points.ply, surface.json, summary.json, for the method `pose` measurement.npz, and points_spacecraft.csv when that frame is
given.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap import __version__
from dishmap.camera.model import Camera
from dishmap.errors import InputError
from dishmap.figures import reprojection_of
from dishmap.io.atomic import write_files
from dishmap.io.measurement_file import MEASUREMENT_FILE, measurement_bytes
from dishmap.io.points_file import SIGMA_MM, format_ply, format_points, table_of
from dishmap.io.pose_file import pose_content
from dishmap.pipeline import Map
from dishmap.surface.cloud import PointCloud, calibration_factor_mm, transform_cloud
from dishmap.surface.fit import SurfaceFit, radius_of
from dishmap.targets.grid_detect import GridDetections
from dishmap.targets.grid_identify import GridIdentity
from dishmap.targets.identify import Anchors, Hint, PoseGuess
from dishmap.targets.pose import TargetPoses
from dishmap.targets.stages import Assumptions
from dishmap.transforms import Pose

Array = NDArray[np.float64]

SUMMARY_FORMAT, SURFACE_FORMAT = "dishmap-summary/1", "dishmap-surface/1"
SPACECRAFT_FILE = "points_spacecraft.csv"
LIBRARIES = ("numpy", "scipy", "opencv-python-headless")


@dataclass(frozen=True)
class Provenance:
    """What a map was made from.

    camera: of the photograph, with its lens; inputs: what each file is -> its path; hint, assumptions: as given to
    `map_photograph`; spacecraft_from_camera: pose, if that frame is wanted; seconds: name of a step -> time it took.
    """

    camera: Camera
    inputs: Mapping[str, str | Path] = field(default_factory=dict)
    hint: Hint = None
    assumptions: Assumptions = field(default_factory=Assumptions)
    spacecraft_from_camera: Pose | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)


def photograph_cloud(result: Map, camera: Camera) -> PointCloud:
    """The points with u, v in the photograph itself: the paper's method measures in an undistorted copy of it."""
    if result.camera is camera:
        return result.cloud
    return replace(result.cloud, center_px=camera.project(result.camera.unproject(result.cloud.center_px)))


def result_files(result: Map, provenance: Provenance) -> dict[str, str | bytes]:
    """All files of a map but its report: name -> text or bytes. Raises InputError when an input file cannot be read again."""
    known = isinstance(result.poses, TargetPoses)
    cloud = photograph_cloud(result, provenance.camera)
    table = table_of(cloud, known)
    files: dict[str, str | bytes] = {
        "points.csv": format_points(table),
        "points.ply": format_ply(table),
        "surface.json": surface_text(result),
    }
    if isinstance(result.poses, TargetPoses):
        photograph = provenance.inputs.get("photograph")
        digest = "" if photograph is None else sha256_of(photograph)
        files[MEASUREMENT_FILE] = measurement_bytes(result.poses, provenance.camera, result.pattern, digest)
    if provenance.spacecraft_from_camera is not None:
        moved = transform_cloud(cloud, provenance.spacecraft_from_camera, "spacecraft")
        files[SPACECRAFT_FILE] = format_points(table_of(moved, known))
    return {**files, "summary.json": summary_text(result, provenance)}


def write_results(folder: str | Path, files: Mapping[str, str | bytes]) -> None:
    """Write the files of a map into an existing folder, all or none; what is there besides is left alone.

    What an earlier map left there and this one does not make (points in the spacecraft frame, a measurement) is removed, since it does
    not belong to the new files. Raises InputError when a file cannot be written.
    """
    write_files(folder, files)
    for name in (SPACECRAFT_FILE, MEASUREMENT_FILE):
        if name not in files:
            with suppress(FileNotFoundError):
                (Path(folder) / name).unlink()


def surface_text(result: Map) -> str:
    """The text of `surface.json`: the surface in the dish frame, or the reason why there is none."""
    fit = result.surface
    content: dict[str, Any] = {"format": SURFACE_FORMAT, "fitted": fit is not None, "problem": result.surface_problem}
    if fit is not None:
        content |= surface_content(fit)
    content["camera_from_dish"] = pose_content(result.camera_from_dish)
    return json_text(content)


def summary_text(result: Map, provenance: Provenance) -> str:
    """The text of `summary.json`. Raises InputError when an input file cannot be read again."""
    camera, cloud = provenance.camera, result.cloud
    rejected = _rejected(result, camera)
    spacecraft = provenance.spacecraft_from_camera
    content = {
        "format": SUMMARY_FORMAT,
        "versions": versions(),
        "inputs": {what: {"path": str(path), "sha256": sha256_of(path)} for what, path in provenance.inputs.items()},
        "image": {"width_px": camera.width_px, "height_px": camera.height_px},
        "method": result.method,
        "hint": hint_content(provenance.hint),
        "assumptions": asdict(provenance.assumptions) if isinstance(result.poses, TargetPoses) else None,
        "camera": camera_content(camera),
        "camera_from_dish": pose_content(result.camera_from_dish),
        "spacecraft_from_camera": None if spacecraft is None else pose_content(spacecraft),
        "counts": {
            "in_pattern": len(result.pattern),
            "measured": len(cloud),
            "flagged": int((cloud.quality != 0).sum()),
            "rejected_targets": len(result.poses.rejected),
            "rejected_detections": len(result.identity.rejected),
            "missing": len(result.missing),
        },
        "rejected": rejected,
        "missing": list(result.missing),
        "photograph": _photograph(result),
        "sheet": _sheet(result),
        "surface": _surface_summary(result),
        "shared_calibration": shared_calibration(cloud, camera) if isinstance(result.poses, TargetPoses) else None,
        "alternatives_ruled_out": [
            {"camera_from_dish": pose_content(other.camera_from_dish), "explains_fewer": other.deficit}
            for other in result.identity.alternatives
        ],
        "seconds": {name: round(value, 3) for name, value in provenance.seconds.items()},
    }
    return json_text(content)


def shared_calibration(cloud: PointCloud, camera: Camera) -> dict[str, Any]:
    """How far the camera's own uncertainty moves all points together, in mm along the camera's axes.

    sigma_rms_mm: over the targets; common_covariance_mm2: of the mean of all targets; apart_rms_mm: what is left of each
    target's error when that mean is taken away, which is what bends the shape. Only `known` when the camera has no covariance.
    """
    if camera.covariance is None or cloud.calibration_jacobian is None:
        return {"known": False, "reason": "the camera file holds no covariance; `dishmap calibrate` writes one"}
    factor = calibration_factor_mm(cloud, camera.covariance)
    mean = factor.mean(axis=0)
    sigma = np.sqrt((factor**2).sum(axis=2))
    apart = np.sqrt(((factor - mean) ** 2).sum(axis=2))
    return {
        "known": True,
        "sigma_rms_mm": _list(np.sqrt((sigma**2).mean(axis=0))),
        "common_covariance_mm2": _list(mean @ mean.T),
        "common_sigma_mm": _list(np.sqrt((mean**2).sum(axis=1))),
        "apart_rms_mm": _list(np.sqrt((apart**2).mean(axis=0))),
        "targets": [{"id": int(i), **dict(zip(SIGMA_MM, _list(row), strict=True))} for i, row in zip(cloud.ids, sigma, strict=True)],
    }


def surface_content(fit: SurfaceFit) -> dict[str, Any]:
    """A fitted surface as it stands in `surface.json`."""
    sigmas = np.sqrt(np.diag(fit.covariance))
    shared = fit.calibration_covariance
    columns = zip(fit.names, fit.units, fit.coefficients, sigmas, strict=True)
    points = zip(fit.ids, fit.residual_mm, fit.weights, fit.off_surface, strict=True)
    return {
        "frame": fit.frame,
        "basis": asdict(fit.basis),
        "coefficients": [{"name": n, "unit": u, "value": float(v), "sigma": float(s)} for n, u, v, s in columns],
        "covariance": _list(fit.covariance),
        "calibration_covariance": None if shared is None else _list(shared),
        "rms_mm": fit.rms_mm,
        "sigma_mm": fit.sigma_mm,
        "noise_factor": fit.noise_factor,
        "converged": bool(fit.converged),
        "iterations": fit.iterations,
        "residuals": [{"id": int(i), "residual_mm": float(r), "weight": float(w), "off_surface": bool(o)} for i, r, w, o in points],
        "off_surface": [int(i) for i in fit.ids[fit.off_surface]],
        "outline_mm": _list(fit.hull_mm),
    }


def _surface_summary(result: Map) -> dict[str, Any]:
    fit = result.surface
    if fit is None:
        return {"fitted": False, "problem": result.surface_problem}
    off = [int(i) for i in fit.ids[fit.off_surface]]
    return {
        "fitted": True,
        "kind": fit.basis.kind,
        "rms_mm": fit.rms_mm,
        "converged": bool(fit.converged),
        "off_surface": off,
        **({} if (radius := radius_of(fit)) is None else asdict(radius)),
    }


def _sheet(result: Map) -> dict[str, Any] | None:
    """What the joint estimate of a grid learnt; null for targets made of circles and for the paper's method."""
    poses = result.poses
    if not isinstance(poses, TargetPoses) or poses.sheet is None:
        return None
    sheet, reprojection = poses.sheet, reprojection_of(result)
    assert reprojection is not None
    learnt = {"print_mm": sheet.print_mm, "strain": sheet.strain, "smooth_strain": sheet.smooth_strain, "rough_mm": sheet.rough_mm}
    squares = {name: getattr(sheet, name) for name in ("side_mm", "measured_side_mm", "spread_mm", "sigma_spread_mm")}
    return {**learnt, **(squares if sheet.side_mm else {}), "reprojection": asdict(reprojection)}


def _photograph(result: Map) -> dict[str, Any] | None:
    """What the photograph says of itself; the paper's method does not ask."""
    poses = result.poses
    if not isinstance(poses, TargetPoses):
        return None
    noise = poses.noise_model
    return {
        "noise_variance_base_grey2": float(noise.base),
        "noise_variance_per_grey": float(noise.slope),
        "noise_inflation": float(noise.inflation),
        "median_noise_grey": float(np.median(poses.noise)),
        "median_contrast_grey": float(np.median(poses.contrast)),
        "median_blur_px": float(np.median(poses.blur_px)),
        "median_edge_offset_mm": float(np.median(poses.offset_mm)),
        "normal_prior_sigma_deg": math.degrees(poses.normal_sigma_rad),
    }


def _rejected(result: Map, camera: Camera) -> list[dict[str, Any]]:
    """Everything seen and not used: targets by id, those of circles where the pattern's pose puts them, and detections without a name."""
    found, identity = result.detections, result.identity
    nominal = result.camera.project(result.camera_from_dish.apply(result.pattern.center_mm))
    if isinstance(found, GridDetections) and isinstance(identity, GridIdentity):
        # a bent sheet follows no rigid pose, and a node stands for one target
        nominal[identity.index] = found.place_px[identity.detection]
    seen = found.place_px if isinstance(found, GridDetections) else found.center_px
    place_of = dict(zip(result.pattern.ids.tolist(), nominal, strict=True))
    listed: list[tuple[int | None, Array, str]] = [(int(i), place_of[int(i)], reason) for i, reason in result.poses.rejected]
    listed += [(None, seen[one.detection], one.reason) for one in identity.rejected]
    if result.camera is not camera:
        listed = [(ident, camera.project(result.camera.unproject(px)), reason) for ident, px, reason in listed]
    return [{"id": ident, **_place(px), "reason": reason} for ident, px, reason in listed]


def _place(pixel: Array) -> dict[str, float | None]:
    u, v = (round(float(value), 2) if np.isfinite(value) else None for value in pixel)
    return {"u_px": u, "v_px": v}


def hint_content(hint: Hint) -> dict[str, Any]:
    """A hint as it stands in summaries."""
    if hint is None:
        return {"kind": "none"}
    if isinstance(hint, PoseGuess):
        return {"kind": "pose_guess", "camera_from_dish": pose_content(hint.camera_from_dish)}
    if isinstance(hint, Anchors):
        places = [{"id": ident, **_place(px)} for ident, px in zip(hint.ids, hint.place_px, strict=True)]
        return {"kind": "anchors", "anchors": places, "upright": None if hint.upright is None else hint_content(hint.upright)}
    return {"kind": "upright", "turn_deg": hint.turn_deg} if hint.turn_deg else {"kind": "upright"}


def camera_content(camera: Camera) -> dict[str, Any]:
    """A camera as it stands in summaries."""
    return {
        "model": camera.model,
        "parameters": dict(zip(camera.parameter_names, map(float, camera.parameters), strict=True)),
        "covariance_known": camera.covariance is not None,
        "covariance": None if camera.covariance is None else _list(camera.covariance),
    }


def versions() -> dict[str, str]:
    """Of this program, Python and the libraries that numbers come from."""
    out = {"dishmap": __version__, "python": platform.python_version()}
    for name in LIBRARIES:
        with suppress(metadata.PackageNotFoundError):
            out[name] = metadata.version(name)
    return out


def sha256_of(path: str | Path) -> str:
    """Digest of an input file. Raises InputError when it cannot be read again."""
    try:
        with Path(path).open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path} can no longer be read ({error.strerror}); leave inputs in place until all is done") from error


def _list(values: Array) -> Any:
    return np.asarray(values, dtype=float).tolist()


def json_text(content: dict[str, Any]) -> str:
    """The text of a JSON file, with null where a number is not finite."""
    return json.dumps(_finite(content), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _finite(value: Any) -> Any:
    """The same with null for NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
