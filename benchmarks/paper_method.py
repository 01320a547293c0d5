"""What the paper's method reaches: its errors on exact ellipses, on rendered photographs, and on data/plate.

    PYTHONPATH=src python benchmarks/paper_method.py

Depth errors are in thousandths of the depth (mm at 1 m), normals in degrees. Camera f 3003 px, four rings of 5/3 mm on a
14 mm square, 1 m along the optical axis.
"""

from __future__ import annotations

import csv
import os
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from table1 import CONTRAST_GREY, FLIP, FOCAL_PX, POINTS, edge_points, photographed, pose_with_normal, whole_target

from dishmap.camera.model import Camera
from dishmap.io.pattern_file import read_pattern
from dishmap.simulate.scene import Scene, Sensor
from dishmap.targets.builders import multi_circular, plate
from dishmap.targets.detect import find_ellipses
from dishmap.targets.identify import Upright, identify
from dishmap.targets.paper import PaperPoses, View, paper_poses, poses_from_ellipses
from dishmap.targets.pattern import Pattern
from dishmap.targets.pose import TargetPoses, measure_targets
from dishmap.targets.subpixel import fit_ellipses
from dishmap.transforms import Pose, angle_between_rad, rotation_from_vector

Array = NDArray[np.float64]
VIEWS: tuple[View, View] = ("camera", "target")
WIDTH_PX, HEIGHT_PX = 4608, 3456
ONE = plate(1, 1, 45.0, multi_circular())
TRUTH = ("x_mm", "y_mm", "z_mm", "nx", "ny", "nz", "u_px", "v_px")
DATA = Path(os.environ.get("DISHMAP_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")


def wide() -> Camera:
    return Camera(WIDTH_PX, HEIGHT_PX, np.full(2, FOCAL_PX), np.array([(WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2]))


def placed(tilt_deg: float, off_axis_deg: float, facing: bool) -> Pose:
    """A target 1 m along the axis, off it to the right, tilted up from fronto-parallel, or from facing the camera."""
    position = np.array([1000.0 * np.tan(np.radians(off_axis_deg)), 0.0, 1000.0])
    normal = -position / np.linalg.norm(position) if facing else FLIP[2]
    return pose_with_normal(rotation_from_vector(np.radians([tilt_deg, 0.0, 0.0])) @ normal, position)


def errors(found: PaperPoses, pose: Pose, cam: Camera) -> tuple[float, float, float]:
    """Depth in thousandths, normal in degrees (of the better sign), centre in px, of the pattern's only target."""
    sight = pose.translation_mm / np.linalg.norm(pose.translation_mm) if found.view == "target" else FLIP[2]
    mirrored = 2 * (found.normal[0] @ sight) * sight - found.normal[0]
    normal = min(float(angle_between_rad(n, pose.rotation[:, 2])) for n in (found.normal[0], mirrored))
    center = float(np.linalg.norm(found.center_px[0] - cam.project(pose.translation_mm)))
    return 1000 * (found.depth_mm[0] / pose.translation_mm[2] - 1), float(np.degrees(normal)), center


def exact_tables() -> None:
    cam, group = wide(), whole_target(ONE.kind_of(0))
    print("On the axis, exact ellipses, tilt in degrees: the depth with cos(delta alpha) as chosen, and with the formula's other reading")
    print("  tilt  delta alpha  depth error  other reading  centre px")
    for tilt in (0, 5, 10, 20, 30, 40, 50):
        pose = placed(tilt, 0.0, False)
        found = poses_from_ellipses(fit_ellipses(edge_points(ONE, cam, pose, POINTS)), group, cam, ONE, view="camera")
        depth, _, center = errors(found, pose, cam)
        delta = float(found.delta_alpha_rad[0])
        other = 1000 * ((1 + depth / 1000) / np.cos(delta) ** 2 - 1)
        print(f"{tilt:6d}{np.degrees(delta):13.2f}{depth:13.2f}{other:15.2f}{center:11.4f}")
    print("\nOff the axis, exact ellipses, by view (camera: as the text; target: the same steps, camera turned to the target)")
    print("                                 depth error          normal error, degrees")
    print("target                off axis   camera    target     camera    target")
    for name, tilt, facing in (("fronto-parallel", 0, False), ("facing the camera", 0, True), ("tilted 20 from it", 20, True)):
        for off in (0, 5, 10, 20, 30):
            pose = placed(tilt, off, facing)
            ellipses = fit_ellipses(edge_points(ONE, cam, pose, POINTS))
            row = [errors(poses_from_ellipses(ellipses, group, cam, ONE, view=view), pose, cam) for view in VIEWS]
            print(f"{name:22s}{off:8d}" + "".join(f"{r[k]:10.2f}" for k in (0, 1) for r in row))


def photograph_table(rng: np.random.Generator, draws: int = 25) -> None:
    print(f"\nRendered photographs on the axis, psf 0.8 px, C = 40, {draws} draws: mean and standard deviation")
    print("  tilt  view      depth error          normal error (mean)  sign not sure")
    cam = Camera(320, 320, np.full(2, FOCAL_PX), np.full(2, 159.5))
    group = whole_target(ONE.kind_of(0))
    for tilt in (0, 5, 10, 20, 40):
        pose = placed(tilt, 0.0, False)
        scene = Scene(ONE, cam, pose, sensor=Sensor(psf_sigma_px=0.8, bits=16, noise_grey=CONTRAST_GREY / 40))
        exact = edge_points(ONE, cam, pose, POINTS)
        ellipses = [photographed(scene, exact, rng) for _ in range(draws)]
        for view in VIEWS:
            found = [poses_from_ellipses(e, group, cam, ONE, view=view) for e in ellipses]
            table = np.array([errors(f, pose, cam) for f in found])
            unsure = np.mean([f.quality[0] > 0 for f in found])
            print(
                f"{tilt:6d}  {view:7s}{table[:, 0].mean():10.2f} ±{table[:, 0].std():6.2f}{table[:, 1].mean():20.2f}{100 * unsure:13.0f} %"
            )


def plate_table() -> None:
    """data/plate, f 1500 px: both methods from the same detections and identities."""
    if not (DATA / "plate").is_dir():
        print(f"\nno data/plate in {DATA}; set DISHMAP_DATA to see it")
        return
    cam = Camera(2304, 1728, np.full(2, 1500.0), np.array([1151.5, 863.5]))
    pattern = read_pattern(DATA / "plate" / "pattern.json")
    with (DATA / "plate" / "truth.csv").open() as file:
        rows = list(csv.DictReader(file))
    print(f"\ndata/plate, {len(pattern)} targets at 1 m, f 1500 px, both methods from the same detections")
    print("image         method         targets  depth error: mean mm   sd mm   normal error: median deg   centre: rms px   seconds")
    for name in dict.fromkeys(row["image"] for row in rows):
        truth = np.array([[float(row[k]) for k in TRUTH] for row in rows if row["image"] == name])
        image = cv2.imread(str(DATA / "plate" / name), cv2.IMREAD_GRAYSCALE)
        for method, (poses, seconds) in both_methods(image, cam, pattern).items():
            depth = poses.position_mm[:, 2] - truth[poses.index, 2]
            normal = np.median(np.degrees(angle_between_rad(poses.normal, truth[poses.index, 3:6])))
            center = np.sqrt(((poses.center_px - truth[poses.index, 6:]) ** 2).sum(axis=1).mean())
            print(f"{name:14s}{method:15s}{len(poses):7d}{depth.mean():22.3f}{depth.std():8.3f}{normal:27.3f}{center:17.4f}{seconds:10.2f}")


def both_methods(image: NDArray[np.generic], cam: Camera, pattern: Pattern) -> dict[str, tuple[PaperPoses | TargetPoses, float]]:
    """Poses and seconds by name of the method, for an upright photograph without distortion."""
    found = find_ellipses(image)
    identity = identify(found, pattern, cam, Upright())
    expected = identity.camera_from_dish.rotate(pattern.normal)
    results: dict[str, tuple[PaperPoses | TargetPoses, float]] = {}
    for view in VIEWS:
        start = time.perf_counter()
        poses = paper_poses(image, cam, pattern, found, identity.mark, identity.detection, expected_normal=expected, view=view)
        results[f"paper, {view}"] = poses, time.perf_counter() - start
    start = time.perf_counter()
    ours = measure_targets(image, cam, pattern, found, identity)
    results["pose"] = ours, time.perf_counter() - start
    return results


def main() -> None:
    exact_tables()
    photograph_table(np.random.default_rng(2018))
    plate_table()


if __name__ == "__main__":
    main()
