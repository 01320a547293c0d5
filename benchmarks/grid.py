"""Maps of grids: how far off are places, depths and normals, and are the sigmas true?

    scripts/bench grid [--quick] [PART ...]      parts: plates, dishes, broken, coverage, cylinder, time

Simulated photographs of line grids (pitch 12 mm, lines of 1 mm), 4608x3456 px, f 3000 px, noise 4 grey levels of a contrast of 165; the
whole chain, found and named without a pose. The bound of a plate is that of its six numbers, known to be rigid and flat. Real: the
squares on the cylinder of data/cylinder, mapped with the pattern given as a flat sheet and given on its cylinder.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from _common import QUICK, Z95, Array, data_folder, errors_of, print_table, rms, wrong_names
from numpy.random import Generator
from scipy.optimize import least_squares

from dishmap.camera.calibrate import Calibration
from dishmap.camera.chessboard import find_boards
from dishmap.camera.lens_choice import choose_lens
from dishmap.camera.model import Camera
from dishmap.io.images import read_gray
from dishmap.pipeline import Map, map_photograph
from dishmap.simulate.deform import Bump, Deformation, ZernikeTerm
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Glare, Light, Polygon, Scene, Sensor, random_line_gaps
from dishmap.simulate.truth import Truth
from dishmap.surface.cloud import PointCloud
from dishmap.targets.grid_builders import grid
from dishmap.targets.grid_detect import find_grid
from dishmap.targets.grid_identify import identify_grid
from dishmap.targets.grid_points import measure_grid
from dishmap.targets.grid_poses import measure_grid_targets
from dishmap.targets.identify import Anchors, Hint, Upright
from dishmap.targets.pattern import Pattern, Surface
from dishmap.targets.pose import TargetPoses
from dishmap.transforms import Pose, cross_matrix, rotation_from_vector

CAMERA = Camera(4608, 3456, [3000.0, 3000.0], [2303.5, 1727.5], [-0.1, 0.02, 1e-4, -1e-4, 0.0])
PITCH_MM, LINE_MM, NOISE_GREY = 12.0, 1.0, 4.0
DISH = Surface("paraboloid", 600.0, 300.0)
# Of data/cylinder (its README): radius and pitch; the printed side is not documented, 4.15 mm is what the photograph shows.
RADIUS_MM, SIDE_MM, COLUMNS, ROWS = 57.0, 4.15, 14, 20
BROKEN_PART = 0.15


def looking(distance_mm: float, tilt_deg: tuple[float, float]) -> Pose:
    return Pose(np.diag([1.0, -1, -1]) @ rotation_from_vector(np.radians([*tilt_deg, 0.0])), np.array([3.0, 5.0, distance_mm]))


def photographed(scene: Scene, seed: int, hint: Hint = None) -> tuple[Map, Truth]:
    shot = simulate(scene, np.random.default_rng(seed))
    return map_photograph(shot.image, scene.camera, scene.pattern, hint), shot.truth


def scene_of(pattern: Pattern, pose: Pose, deformation: Deformation | None = None) -> Scene:
    return Scene(pattern, CAMERA, pose, deformation=deformation or Deformation(), sensor=Sensor(noise_grey=NOISE_GREY))


def rigid_bound_mm(result: Map) -> float:
    """Least rms error of depth for somebody who knows that the plate is rigid and flat, from the information in the pixels."""
    poses = result.poses
    assert isinstance(poses, TargetPoses)
    arm = poses.position_mm - poses.position_mm.mean(axis=0)
    moves = np.concatenate([np.broadcast_to(np.eye(3), (len(arm), 3, 3)), -cross_matrix(arm)], axis=2)
    information = np.einsum("nki,nkl,nlj->ij", moves, poses.information[:, :3, :3], moves)
    depth = moves[:, 2]
    return rms(np.sqrt(np.einsum("ni,ij,nj->n", depth, np.linalg.inv(information), depth)))


def _row(name: str, result: Map, truth: Truth) -> tuple[object, ...]:
    errors = errors_of(result, truth)
    visible = int((truth.visible_fraction > 0.98).sum())
    depth, sigma = errors.position_mm[:, 2], errors.sigma_mm[:, 2]
    held = 100 * float((np.abs(depth) < Z95 * sigma).mean())
    normal = np.degrees(errors.normal_rad)
    named = f"{len(errors)}/{visible}"
    across = rms(errors.position_mm[:, :2])
    return name, named, wrong_names(result, truth, result.camera), across, rms(depth), rms(sigma), held, float(np.median(normal))


HEADS = ("scene", "named", "wrong", "across mm", "depth mm", "claimed", "held %", "normal deg")


def plates() -> None:
    pattern, rows = grid(30, 24, PITCH_MM, line_width_mm=LINE_MM), []
    for distance in (600.0, 800.0, 1000.0):
        for tilt in ((0.0, 0.0), (10.0, 5.0), (35.0, 20.0)):
            pose = looking(distance, tilt)
            result, truth = photographed(scene_of(pattern, pose), int(distance), Upright())
            fitted = np.linalg.svd(result.cloud.position_mm - result.cloud.position_mm.mean(axis=0))[2][2]
            true = pose.rotation[:, 2]
            off = float(np.degrees(np.arcsin(np.linalg.norm(np.cross(fitted, true)))))
            row = _row(f"{distance:.0f} mm, {tilt[0]:.0f}/{tilt[1]:.0f} deg", result, truth)
            rows.append((*row, row[4] / rigid_bound_mm(result), off))
    print_table((*HEADS, "times the rigid bound", "plate's tilt deg"), rows, "Plates, 30 x 24 crossings")


def dishes() -> None:
    pattern = grid(60, 60, PITCH_MM, line_width_mm=LINE_MM, surface=DISH, orientation_marks=True)
    states = {
        "nominal": Deformation(),
        "astigmatism 1 mm": Deformation(zernike=(ZernikeTerm(2, 2, 1.0),)),
        "defocus 0.1 mm": Deformation(zernike=(ZernikeTerm(2, 0, 0.1),)),
        "bump 0.5 mm": Deformation(bumps=(Bump((80.0, 50.0), 50.0, 0.5),)),
        "defocus 1 mm": Deformation(zernike=(ZernikeTerm(2, 0, 1.0),)),
    }
    rows = []
    for name, state in states.items():
        for distance in (650.0, 1000.0):
            result, truth = photographed(scene_of(pattern, looking(distance, (3.0, 2.0)), state), int(distance))
            rows.append(_row(f"{name}, {distance:.0f} mm", result, truth))
    print_table(HEADS, rows, "Dish of 600 mm, f 300 mm, 2,000 crossings; a membrane that stretches (bump, defocus) looks nearer or farther")


def broken() -> None:
    """Every sixth piece of line broken, glare, and things in front of the grid."""
    rows = []
    for seed in range(2 if QUICK else 6):
        rng = np.random.default_rng(seed)
        pattern = grid(30, 24, PITCH_MM, line_width_mm=LINE_MM, orientation_marks=True)
        pose = looking(rng.uniform(650, 950), (rng.uniform(-25, 25), rng.uniform(-25, 25)))
        scene = scene_of(pattern, pose)
        spots = [Glare(tuple(rng.uniform([1000, 800], [3600, 2600])), rng.uniform(60, 200), rng.uniform(40, 300)) for _ in range(4)]
        scene = replace(scene, light=Light(glare=tuple(spots)), occluders=tuple(_shade(rng) for _ in range(3)))
        result, truth = photographed(replace(scene, line_gaps=random_line_gaps(rng, pattern, BROKEN_PART)), seed)
        clean = errors_of(result, truth)
        score = clean.position_mm / clean.sigma_mm
        rows.append((*_row(f"seed {seed}", result, truth), float(np.abs(score[:, 2]).max()), float(np.abs(clean.position_mm[:, 2]).max())))
    print_table((*HEADS, "worst sigmas", "worst mm"), rows, "Plates with 15 % of the pieces of lines broken, glare and obstacles")


def _shade(rng: Generator) -> Polygon:
    corner = rng.uniform([900, 700], [3500, 2500])
    return Polygon(
        tuple(tuple(corner + shift) for shift in 160 * np.array([[0, 0], [1, 0.2], [0.9, 1], [0.1, 0.8]])), float(rng.uniform(20, 120))
    )


def coverage() -> None:
    """Intervals over many sheets: plates, cylinders and dishes, printed unevenly or not, from places with the noise of such photographs."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "targets"))
    from sheets import on_cylinder, sheet_of

    kinds: dict[str, Callable[[Generator], tuple[Pattern, Array]]] = {
        "plate": lambda rng: _placed(grid(20, 16, PITCH_MM, line_width_mm=LINE_MM)),
        "plate, print 0.02 mm": lambda rng: _printed(rng, *_placed(grid(20, 16, PITCH_MM, line_width_mm=LINE_MM))),
        "flat sheet on a cylinder": lambda rng: _on(grid(20, 16, PITCH_MM, line_width_mm=LINE_MM), on_cylinder, rng.uniform(100, 400)),
        "dish": lambda rng: _bent(rng, grid(26, 26, 24.0, line_width_mm=LINE_MM, surface=DISH)),
    }
    rows = []
    for name, make in kinds.items():
        scores, ratio = [], []
        for seed in range(6 if QUICK else 25):
            rng = np.random.default_rng(seed)
            pattern, points = make(rng)
            pose = looking(rng.uniform(600, 1000), (rng.uniform(-20, 20), rng.uniform(-20, 20)))
            true, sigma_px = pose.apply(points), 10 ** rng.uniform(-2.3, -1.5)
            pixels = CAMERA.project(true) + sigma_px * rng.normal(size=(len(true), 2))
            seen = np.flatnonzero(CAMERA.contains(pixels))
            sheet = sheet_of(pattern, pixels[seen], sigma_px, seen, CAMERA)
            error, sigma = sheet.place_mm - true[seen], np.sqrt(np.einsum("nii->ni", sheet.covariance[:, :3, :3]))
            scores.append(error / sigma)
            ratio.append(rms(error[:, 2]) / rms(sigma[:, 2]))
        held = [100 * float((np.abs(s) < Z95).mean()) for s in scores]
        depth = [100 * float((np.abs(s[:, 2]) < Z95).mean()) for s in scores]
        spread = np.std(depth) / np.sqrt(len(depth))
        rows.append((name, len(scores), np.mean(held), np.mean(depth), spread, np.median(ratio), np.max(ratio)))
    heads = ("sheets", "number", "all three held %", "depth held %", "+-", "depth error/claimed, median", "worst")
    print_table(heads, rows, "95 % intervals of places")


def _placed(pattern: Pattern) -> tuple[Pattern, Array]:
    return pattern, pattern.center_mm


def _printed(rng: Generator, pattern: Pattern, points: Array) -> tuple[Pattern, Array]:
    return pattern, points + 0.02 * rng.normal(size=points.shape) * [1.0, 1.0, 0.0]


def _on(pattern: Pattern, wrap: Callable[[Pattern, float], Array], radius_mm: float) -> tuple[Pattern, Array]:
    return pattern, wrap(pattern, radius_mm)


def _bent(rng: Generator, pattern: Pattern) -> tuple[Pattern, Array]:
    from dishmap.simulate.deform import deform

    terms = tuple(ZernikeTerm(n, m, rng.normal() * 0.2) for n, m in ((2, -2), (2, 0), (2, 2), (3, 1), (3, 3)))
    return pattern, deform(Deformation(zernike=terms), pattern.surface, pattern.center_mm, 300.0)


def cylinder() -> None:
    folder = data_folder("cylinder")
    if folder is None:
        return
    boards = sorted((folder / "boards").glob("*.jpg"))
    search = find_boards(((file.name, read_gray(file)) for file in boards), (14, 19), 10.0)
    made: Calibration = choose_lens(search.views, search.width_px, search.height_px)[0]
    image, table = read_gray(folder / "grid.jpg"), np.loadtxt(folder / "points.csv", delimiter=",", skiprows=1)
    flat = grid(COLUMNS, ROWS, PITCH_MM, square_mm=SIDE_MM)
    bent = grid(COLUMNS, ROWS, PITCH_MM, square_mm=SIDE_MM, surface=Surface("cylinder", radius_mm=RADIUS_MM))
    hint = _anchor(image, flat)
    rows = []
    for name, pattern in (("flat sheet", flat), ("on its cylinder", bent)):
        for method in ("pose", "paper"):
            result = map_photograph(image, made.camera, pattern, hint, method)
            rows.append((name, method, *_against(result, table)))
    heads = ("pattern given", "method", "squares", "radius mm", "off it, mm rms", "normal deg median", "90 %", "places mm rms", "largest")
    print_table(heads, rows, f"data/cylinder/grid.jpg against points.csv (radius {RADIUS_MM:g} mm), camera {made.camera.model}")
    poses = map_photograph(image, made.camera, bent, hint).poses
    assert isinstance(poses, TargetPoses)
    assert poses.sheet is not None
    print(f"on its cylinder: learnt {poses.sheet}")


def _anchor(image: Array, pattern: Pattern) -> Anchors:
    """What a user says who sees the number 6 printed above a column: which target its uppermost square is."""
    found = find_grid(image, False)
    top = found.place_px[np.abs(found.place_px - [1213.0, 447.0]).sum(axis=1).argmin()]
    ident = pattern.ids[(pattern.lattice == [5, ROWS - 1]).all(axis=1)][0]
    return Anchors((int(ident),), top[None], Upright())


def _against(result: Map, table: Array) -> tuple[float, ...]:
    """Best-fit cylinder of the points, and places and normals against the table moved onto them rigidly."""
    cloud: PointCloud = result.cloud
    lattice = result.pattern.lattice[result.poses.index]
    row = {(int(r), int(c)): p for r, c, *p in table}
    # its z points up, as the numbers on the photograph stand
    true = np.array([row[b + 1, a + 1] for a, b in lattice.tolist()])
    radial = true * [1.0, 1.0, 0.0] / RADIUS_MM
    middle = true.mean(axis=0), cloud.position_mm.mean(axis=0)
    u, _, vt = np.linalg.svd((true - middle[0]).T @ (cloud.position_mm - middle[1]))
    turn = vt.T @ np.diag([1.0, 1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    gap = cloud.position_mm - ((true - middle[0]) @ turn.T + middle[1])
    angle = np.degrees(np.arccos(np.clip((cloud.normal * (radial @ turn.T)).sum(axis=1), -1, 1)))
    radius, off = _best_cylinder(cloud.position_mm)
    size = np.linalg.norm(gap, axis=1)
    return len(cloud), radius, off, float(np.median(angle)), float(np.quantile(angle, 0.9)), rms(size), float(size.max())


def _best_cylinder(points: Array) -> tuple[float, float]:
    """Radius of the least-squares cylinder and the rms distance from it: written anew here, not the program's own fit."""

    def off(q: Array) -> Array:
        axis = np.array([q[0], 1.0, q[1]])
        axis /= np.linalg.norm(axis)
        arm = points - np.array([q[2], 0.0, q[3]])
        return np.asarray(np.linalg.norm(arm - np.outer(arm @ axis, axis), axis=1) - q[4])

    middle = points.mean(axis=0)
    found = least_squares(off, [0.0, 0.0, middle[0], middle[2] + 50.0, 57.0], loss="soft_l1", f_scale=0.1)
    return float(found.x[4]), rms(off(found.x))


def times() -> None:
    pattern = grid(60, 60, PITCH_MM, line_width_mm=LINE_MM, surface=DISH, orientation_marks=True)
    image = simulate(scene_of(pattern, looking(650.0, (3.0, 2.0))), np.random.default_rng(1)).image
    rows = []
    for _ in range(3):
        marks = [time.process_time()]
        found = find_grid(image, True)
        marks.append(time.process_time())
        named = identify_grid(found, pattern, CAMERA)
        marks.append(time.process_time())
        measure_grid(image, pattern, named.index, found.place_px[named.detection])
        marks.append(time.process_time())
        measure_grid_targets(image, CAMERA, pattern, found, named)
        marks.append(time.process_time())
        find, name, pixels, whole = np.diff(marks)
        rows.append((len(named.index), find, name, pixels, whole - pixels, find + name + whole))
    print_table(("crossings", "find s", "name", "pixels", "surface", "all"), rows, "Processor time, 4608x3456 px")


PARTS = {"plates": plates, "dishes": dishes, "broken": broken, "coverage": coverage, "cylinder": cylinder, "time": times}


def main() -> None:
    wanted = [word for word in sys.argv[1:] if not word.startswith("-")]
    for name, part in PARTS.items():
        if not wanted or name in wanted:
            part()


if __name__ == "__main__":
    main()
