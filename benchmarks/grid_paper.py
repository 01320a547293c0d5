"""What Algorithm 2 of the paper reaches on grids: plates at 800 mm and 1 m, f 3000 px, pitch 12 mm. The paper states 0.3 to 0.5 mm.

    scripts/bench grid_paper

Scatter: of a target's depth between photographs of one plate; move: error of a 1 mm move as two photographs show it, rms over targets;
error: depth less the truth, its mean and rms over targets, where the formula's own bias is. EPnP, which the paper names, beside IPPE.
"""

from __future__ import annotations

import time

import numpy as np
from _common import QUICK, Array, print_table, rms

from dishmap.camera.model import Camera
from dishmap.simulate.render import record, render_light
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.targets.grid_builders import grid
from dishmap.targets.grid_paper import Normals, Squares, paper_grid_poses, poses_from_level_0, weighted_points
from dishmap.targets.paper import PaperPoses
from dishmap.targets.pattern import Pattern, Surface
from dishmap.transforms import Pose, angle_between_rad

FOCAL_PX, PITCH_MM, MOVE_MM = 3000.0, 12.0, 1.0
CAMERA = Camera(1280, 1000, np.full(2, FOCAL_PX), np.array([639.5, 499.5]))
SENSOR = Sensor(psf_sigma_px=0.8, noise_grey=2.0)
# What the paper's figure 14 gives as the noise of places.
PAPER_NOISE_PX = 0.035
START_PX = 0.3
PHOTOGRAPHS = 2 if QUICK else 4


def photographed(scene: Scene, rng: np.random.Generator, normals: Normals) -> list[PaperPoses]:
    """The same plate in several photographs, which differ by their noise and by where it was first found."""
    light, _ = render_light(scene)
    place = CAMERA.project(scene.camera_from_dish.apply(scene.pattern.center_mm))
    index = np.arange(len(place))
    found = []
    for _ in range(PHOTOGRAPHS):
        start = place + rng.uniform(-START_PX, START_PX, place.shape)
        found.append(paper_grid_poses(record(light, scene.sensor, rng), CAMERA, scene.pattern, index, start, normals=normals))
    return found


def common(poses: list[PaperPoses]) -> tuple[Array, Array]:
    """Targets in all of the photographs (T,), and their depths (P, T)."""
    index = np.array(sorted(set.intersection(*(set(p.index.tolist()) for p in poses))), dtype=np.int64)
    return index, np.array([p.depth_mm[np.searchsorted(p.index, index)] for p in poses])


def row(name: str, pattern: Pattern, distance_mm: float, tilt_deg: float, normals: Normals) -> list[object]:
    rng = np.random.default_rng(2018)
    poses = [facing_pose(d, np.radians(tilt_deg), 0.4) for d in (distance_mm, distance_mm + MOVE_MM)]
    start = time.perf_counter()
    before, after = (photographed(Scene(pattern, CAMERA, pose, sensor=SENSOR), rng, normals) for pose in poses)
    seconds = (time.perf_counter() - start) / (2 * PHOTOGRAPHS)
    index, depth = common(before + after)
    true = poses[0].apply(pattern.center_mm[index])[:, 2]
    error = depth[:PHOTOGRAPHS] - true
    place = CAMERA.project(poses[0].apply(pattern.center_mm))
    level_0 = np.concatenate([p.center_px - place[p.index] for p in before])
    normal = np.concatenate([angle_between_rad(p.normal, poses[0].rotation[:, 2]) for p in before])
    move = depth[PHOTOGRAPHS:] - depth[:PHOTOGRAPHS] - MOVE_MM
    scatter = float(np.sqrt(depth[:PHOTOGRAPHS].var(axis=0, ddof=1).mean()))
    cells = [name, distance_mm, tilt_deg, normals, f"{len(index)}/{len(pattern)}", rms(level_0), scatter, rms(move)]
    return [*cells, error.mean(), rms(error), float(np.degrees(np.median(normal))), seconds]


def points_of(pattern: Pattern, level_0_px: Array) -> list[Squares]:
    """P* of the whole pattern."""
    return weighted_points(level_0_px, np.arange(len(pattern)), CAMERA, pattern)


def size_table(pattern: Pattern, pose: Pose) -> None:
    """Scatter of the distance by the size of squares, all of them over places with the paper's noise."""
    rng, exact = np.random.default_rng(2018), CAMERA.project(pose.apply(pattern.center_mm))
    true = points_of(pattern, exact)
    draws = [points_of(pattern, exact + PAPER_NOISE_PX * rng.normal(size=exact.shape)) for _ in range(PHOTOGRAPHS)]
    rows = []
    for number in (1, 2, 3, 4, 6, 8, 10, 12):
        if number > len(true):
            break
        depth = [draw[number - 1].point_mm[..., 2] - true[number - 1].point_mm[..., 2] for draw in draws]
        side_px = FOCAL_PX * PITCH_MM / pose.translation_mm[2]
        theory = PAPER_NOISE_PX / (2 * np.sqrt(2) * number * side_px) * pose.translation_mm[2]
        rows.append([number, float(np.nanstd(depth)), theory])
    title = f"Exact places with noise of {PAPER_NOISE_PX} px, plate at {pose.translation_mm[2]:g} mm tilted by 20 degrees: scatter, mm"
    print_table(["units", "scatter", "of the area alone"], rows, title)


def epnp_table(pattern: Pattern) -> None:
    """Normals by EPnP and by IPPE on the same exact places, by tilt."""
    rows = []
    for tilt in (0.5, 5.0, 10.0, 17.5, 30.0):
        pose = facing_pose(1000.0, np.radians(tilt), 0.4)
        place = CAMERA.project(pose.apply(pattern.center_mm))
        index = np.flatnonzero(CAMERA.contains(place))
        found = [poses_from_level_0(place[index], index, CAMERA, pattern, normals=n) for n in ("epnp", "ippe")]
        rows.append([tilt, *(float(np.degrees(np.median(angle_between_rad(p.normal, pose.rotation[:, 2])))) for p in found)])
    print_table(["tilt", "epnp", "ippe"], rows, "Exact places, plate at 1000 mm: median error of the normal, degrees")


def bent_table() -> None:
    """Depths on cylinders, of which the pattern tells, or which it gives as a flat sheet; from exact places."""
    rows: list[list[object]] = []
    for radius in (1000.0, 300.0, 100.0):
        bent = grid(15, 15, PITCH_MM, line_width_mm=1.0, surface=Surface("cylinder", radius_mm=radius))
        sheet, pose = grid(15, 15, PITCH_MM, line_width_mm=1.0), facing_pose(800.0)
        place = CAMERA.project(pose.apply(bent.center_mm))
        for name, given in (("its cylinder", bent), ("flat sheet", sheet)):
            found = poses_from_level_0(place, np.arange(len(place)), CAMERA, given)
            depth = found.depth_mm - pose.apply(bent.center_mm[found.index])[:, 2]
            normal = np.degrees(angle_between_rad(found.normal, pose.rotate(bent.normal[found.index])))
            rows.append([radius, name, rms(depth), float(np.median(normal)), float(np.percentile(normal, 90))])
    head = ["radius mm", "pattern given as", "depth rms mm", "normal median deg", "90 %"]
    print_table(head, rows, "Exact places on cylinders at 800 mm")


def main() -> None:
    lines = grid(24, 18, PITCH_MM, line_width_mm=1.0, orientation_marks=True)
    squares = grid(24, 18, PITCH_MM, square_mm=6.0, orientation_marks=True)
    cases = [(n, p, d, t) for d in (800.0, 1000.0) for t in (0.0, 10.0, 20.0) for n, p in (("lines", lines), ("squares", squares))]
    rows = [row(*case, normals="ippe") for case in cases]
    rows += [row("lines", lines, 1000.0, tilt, normals="epnp") for tilt in (0.0, 10.0, 20.0)]
    head = ["grid", "mm", "tilt", "normals", "targets", "level_0 px", "scatter", "move", "error mean", "error rms", "normal deg", "s"]
    print_table(head, rows, f"Algorithm 2 on photographs, psf 0.8 px, contrast 80 times the noise, {PHOTOGRAPHS} photographs each; mm")
    size_table(lines, facing_pose(1000.0, np.radians(20.0), 0.4))
    epnp_table(lines)
    bent_table()


if __name__ == "__main__":
    main()
