"""Time and memory of mapping a 4608x3456 photograph with 130 four-ring targets, one core, beside OpenCV in the same run.

    scripts/bench speed [--quick]

The photograph is simulated and in memory before the clock starts. Times are medians: by the clock, and of the processor, which is what
counts on a machine that others use too. Peak memory is how much a fresh process grows beyond what it held before its first call, image and
libraries loaded (Linux: the high-water mark of its resident memory). Import is that of a fresh process.
"""

from __future__ import annotations

import gc
import pickle
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from _common import QUICK, errors_of, print_table
from shared_data import blobs, solve

from dishmap.camera.model import Camera
from dishmap.pipeline import map_photograph
from dishmap.simulate.deform import Deformation
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.targets.builders import dish, plate
from dishmap.targets.detect import find_ellipses
from dishmap.targets.identify import Upright, identify
from dishmap.targets.pose import measure_targets
from dishmap.targets.track import track_targets
from dishmap.transforms import Pose

REPEATS = 3 if QUICK else 9
GOAL_S, GOAL_MB, GOAL_IMPORT_S = 0.35, 250, 0.25
WIDTH_PX, HEIGHT_PX = 4608, 3456
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def large_scene() -> Scene:
    """A 0.6 m dish, f/D 0.5, 130 targets or a few less, 700 mm away: the whole picture is used."""
    camera = Camera(WIDTH_PX, HEIGHT_PX, np.full(2, 3350.0), np.array([2310.0, 1720.0]), np.array([-0.2, 0.07, 5e-4, -4e-4, -0.01]))
    pattern = dish(600.0, 300.0, spacing_mm=44.0)
    return Scene(pattern, camera, facing_pose(680.0, np.radians(4.0)), sensor=Sensor(psf_sigma_px=0.8, noise_grey=2.0))


def paper_plate() -> tuple[Scene, Scene]:
    """The paper's plate of 30 targets at 1 m, f 3000 px, and the same moved by half a millimetre."""
    camera = Camera(WIDTH_PX, HEIGHT_PX, np.full(2, 3000.0), np.array([2303.5, 1727.5]))
    scene = Scene(plate(5, 6, 45.0), camera, facing_pose(1000.0, 0.02), sensor=Sensor(psf_sigma_px=0.8, noise_grey=2.0))
    return scene, scene.with_state(Deformation(motion=Pose(np.eye(3), np.array([0.1, 0.1, 0.5]))))


def seconds(call: Callable[[], object], repeats: int = REPEATS) -> tuple[float, float]:
    """Medians by the clock and of the processor."""
    call()
    clock, processor = [], []
    for _ in range(repeats):
        start, busy = time.perf_counter(), time.process_time()
        call()
        clock.append(time.perf_counter() - start)
        processor.append(time.process_time() - busy)
    return statistics.median(clock), statistics.median(processor)


def peak_mb(what: str, given: Path) -> float:
    """Growth of the resident memory at its highest, in MB, while a fresh process does `what`; NaN where the system does not tell."""
    run = subprocess.run([sys.executable, __file__, what, str(given)], capture_output=True, text=True, check=False)
    return float(run.stdout.split()[-1]) if run.returncode == 0 and run.stdout.strip() else float("nan")


def child(what: str, given: str) -> None:
    """Do `what` once and print by how many MB memory grew."""
    image, camera, pattern = pickle.loads(Path(given).read_bytes())
    cv2.setNumThreads(1)
    gc.collect()
    CLEAR.write_text("5")
    before = _status_mb("VmRSS")
    if what == "map":
        map_photograph(image, camera, pattern, Upright())
    else:
        blobs(image)
    print(_status_mb("VmHWM") - before)


def _status_mb(name: str) -> float:
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) / 1024


def import_seconds(what: str) -> tuple[float, float]:
    code = f"from time import perf_counter as t, process_time as p; a, b = t(), p(); import {what}; print(t() - a, p() - b)"
    runs = [subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split() for _ in range(REPEATS)]
    return statistics.median(float(run[0]) for run in runs), statistics.median(float(run[1]) for run in runs)


def main() -> None:
    cv2.setNumThreads(1)
    scene = large_scene()
    picture = simulate(scene, np.random.default_rng(2018))
    image, camera, pattern, truth = picture.image, scene.camera, scene.pattern, picture.truth
    with tempfile.TemporaryDirectory() as folder:
        given = Path(folder) / "given.pickle"
        given.write_bytes(pickle.dumps((image, camera, pattern)))
        peaks = {what: round(peak, 1) if np.isfinite(peak := peak_mb(what, given)) else "unknown" for what in ("map", "blobs")}
    result = map_photograph(image, camera, pattern, Upright())
    errors = errors_of(result, truth)
    few = paper_plate()
    first, later = (simulate(scene, np.random.default_rng(30 + k)).image for k, scene in enumerate(few))
    before = map_photograph(first, few[0].camera, few[0].pattern, Upright()).poses
    found = find_ellipses(image)
    named = identify(found, pattern, camera, Upright())
    centers = blobs(image)
    index, position, _ = solve(centers, camera, pattern, truth)
    rows: list[tuple[object, ...]] = [
        ("find_ellipses", *seconds(lambda: find_ellipses(image)), "", ""),
        ("identify", *seconds(lambda: identify(found, pattern, camera, Upright())), "", ""),
        ("measure_targets", *seconds(lambda: measure_targets(image, camera, pattern, found, named)), "", ""),
        ("track_targets (reference known)", *seconds(lambda: track_targets(image, camera, pattern, result.poses)), "", ""),
        ("the same, the paper's 30 targets", *seconds(lambda: track_targets(later, few[0].camera, few[0].pattern, before)), "0.05 s", ""),
        ("map_photograph, all of it", *seconds(lambda: map_photograph(image, camera, pattern, Upright())), f"{GOAL_S} s", peaks["map"]),
        ("OpenCV SimpleBlobDetector", *seconds(lambda: blobs(image), 3), "", peaks["blobs"]),
        ("OpenCV solvePnP", *seconds(lambda: solve(centers, camera, pattern, truth), 3), "", ""),
        ("import dishmap", *import_seconds("dishmap"), f"{GOAL_IMPORT_S} s", ""),
        ("import dishmap.pipeline", *import_seconds("dishmap.pipeline"), "", ""),
        ("import cv2", *import_seconds("cv2"), "", ""),
    ]
    whole = int((truth.visible_fraction > 0.999).sum())
    print(f"{WIDTH_PX}x{HEIGHT_PX} px, {whole} of {len(pattern)} targets wholly in view")
    theirs = np.abs(position[:, 2] - truth.center_mm[index, 2])
    print(f"dishmap measured {len(errors)}, median depth error {np.median(np.abs(errors.position_mm[:, 2])):.3f} mm")
    print(f"OpenCV measured {len(index)}, median depth error {np.median(theirs):.3f} mm")
    print_table(
        ("step", "seconds", "of processor", "goal", "peak MB"), rows, f"Medians of {REPEATS}, one core (goal for memory: {GOAL_MB} MB)"
    )


if __name__ == "__main__":
    if len(sys.argv) == 3 and sys.argv[1] in ("map", "blobs"):
        child(*sys.argv[1:])
    else:
        main()
