"""What the paper's on-board difference (Algorithm 3) reaches: simulated stills and tilts, data/plate and data/dish.

    scripts/bench paper_difference [--quick]

The reference's own map is by the method `pose`, standing for the map from the laboratory. Errors are rms over targets, in mm along the
nominal normal; `none`, `reference`, `turned` say what a ratio is taken to mean (docs/method-paper.md). Columns: surface by its level 1 over
neighbours (default), level 0 and 1 themselves, and the surface through the ratio map of all pairs, as Algorithm 3 is printed. Level
values are compared at their targets, though they hold at their averaged places.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _common import QUICK, data_folder, print_table, rms
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.camera.undistort import pinhole_camera, undistort_points
from dishmap.difference.paper import NORMALS, Centers, Normals, PaperDifference, paper_difference
from dishmap.errors import FitError
from dishmap.io.camera_file import read_camera
from dishmap.io.images import read_gray
from dishmap.io.pattern_file import read_pattern
from dishmap.io.truth_file import read_truth
from dishmap.pipeline import Map, map_photograph
from dishmap.simulate.deform import Deformation
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Light, Scene, Sensor, facing_pose
from dishmap.surface.fit import Basis
from dishmap.targets.builders import plate
from dishmap.targets.identify import Upright
from dishmap.targets.paper import PaperPoses
from dishmap.targets.pattern import Pattern
from dishmap.transforms import Pose, rotation_from_vector

Gray = NDArray[np.generic]

HEADER = ("state", "centres", "normals", "targets", "true rms", "surface", "surface, mean", "level 0", "level 1", "all pairs")
CONTRAST = 40
STILLS = 3 if QUICK else 10


@dataclass(frozen=True)
class Photograph:
    """One image as both methods see it."""

    pose: Map
    camera: Camera
    centers: dict[str, Centers]


def photograph(image: Gray, camera: Camera, pattern: Pattern) -> Photograph:
    ours, paper = (map_photograph(image, camera, pattern, Upright(), method) for method in ("pose", "paper"))
    assert isinstance(paper.poses, PaperPoses)
    # covariances are not turned with the lens: the table asks for errors, not for sigmas
    raw = Centers(ours.cloud.ids, undistort_points(camera, ours.cloud.center_px))
    return Photograph(ours, pinhole_camera(camera), {"paper": Centers(paper.poses.ids, paper.poses.center_px), "pose": raw})


def rows(
    name: str, before: Photograph, after: Photograph, truth: dict[int, float], basis: Basis, kinds: tuple[str, ...]
) -> list[list[object]]:
    out: list[list[object]] = []
    for kind in kinds:
        for normals in NORMALS:

            def run(normals: Normals = normals, kind: str = kind, **options: Any) -> PaperDifference:
                lab, pose = before.pose.cloud, before.pose.camera_from_dish
                return paper_difference(
                    before.centers[kind], after.centers[kind], lab, before.camera, pose, basis=basis, normals=normals, **options
                )

            found = run()
            true = np.array([truth[int(i)] for i in found.ids])
            error = found.displacement_mm - true
            whole = run(reach_mm=np.inf, surface_level=None).displacement_mm - true
            levels = [rms((lev.value - true)[np.isfinite(lev.value)]) for lev in found.levels]
            out.append([name, kind, normals, len(true), rms(true), rms(error), float(error.mean()), *levels, rms(whole)])
    return out


def stills(rng: np.random.Generator) -> None:
    """The paper's figure 18: two photographs with no movement; f 3000 px, 1 m, 30 targets."""
    pattern, camera, pose = plate(6, 5, 45.0), Camera(900, 1000, [3000.0, 3000.0], [449.5, 499.5]), facing_pose(1000.0, 0.03, 0.5)
    light = Light(background_grey=190.0)
    sensor = Sensor(0.8, noise_grey=(light.ground_grey - light.ink_grey) / CONTRAST)

    def shot(state: Deformation) -> Photograph:
        return photograph(simulate(Scene(pattern, camera, pose, state, light, sensor), rng).image, camera, pattern)

    table = []
    pairs = [(shot(Deformation()), shot(Deformation())) for _ in range(STILLS)]
    for kind in ("paper", "pose"):
        for basis in (Basis("plane"), Basis("polynomial", 3)):
            found = [paper_difference(a.centers[kind], b.centers[kind], a.pose.cloud, camera, pose, basis=basis) for a, b in pairs]
            moved = np.array([f.registration.residual_px for f in found])
            values = [np.array([f.levels[k].value for f in found]) for k in (0, 1)]
            surface = np.array([f.displacement_mm for f in found])
            apart = np.array([f.registration.scale - 1 for f in found])
            table.append(
                [kind, f"{basis.kind}:{basis.degree}", rms(moved), np.abs(moved).max(), rms(1000 * apart), *map(rms, values), rms(surface)]
            )
    head = ("centres", "surface", "shift rms px", "largest px", "common mm", "level 0 mm", "level 1 mm", "surface mm")
    print_table(head, table, f"No movement, {STILLS} pairs of photographs, f 3000 px, 1 m, psf 0.8 px, C = {CONTRAST}; true change 0")

    # figures 20 and 21: the top goes back by 1.2 mm, the lower end by 0.3 mm
    y = pattern.center_mm[:, 1]
    turn = rotation_from_vector([np.arctan2(-0.45, y.max()), 0.0, 0.0])
    tilted = Deformation(motion=Pose(turn, np.array([0.0, 0.0, -0.75])))
    truth = dict(zip(pattern.ids.tolist(), (-0.75 - 0.45 * y / y.max()).tolist(), strict=True))
    found_rows = rows("0.3 to 1.2 mm", shot(Deformation()), shot(tilted), truth, Basis("plane"), ("paper", "pose"))
    print_table(HEADER, found_rows, "A plate that tilts (the paper's figures 20 and 21), surface: plane")


def shared(name: str, reference: str, states: tuple[str, ...], basis: Basis, true: Callable[[Path, str], dict[int, float]]) -> None:
    folder = data_folder(name)
    if folder is None:
        return
    camera, pattern = read_camera(folder / "camera.yaml"), read_pattern(folder / "pattern.json")
    before = photograph(read_gray(folder / reference), camera, pattern)
    table = []
    for state in states[: 2 if QUICK else None]:
        after = photograph(read_gray(folder / state), camera, pattern)
        try:
            table += rows(state, before, after, true(folder, state), basis, ("paper", "pose"))
        except FitError as error:
            print(f"{state}: {error}")
    print_table(HEADER, table, f"data/{name}, surface: {basis.kind}:{basis.degree}")


def plate_truth(folder: Path, state: str) -> dict[int, float]:
    """Along the normal of the reference, in mm."""
    table = read_truth(folder / "truth.csv")
    before, after = table["ref.png"], table[state]
    along = ((after.center_mm - before.center_mm) * before.normal).sum(axis=1)
    return dict(zip(before.ids.tolist(), along.tolist(), strict=True))


def dish_truth(folder: Path, state: str) -> dict[int, float]:
    truth = read_truth(folder / "truth.csv")[state]
    return dict(zip(truth.ids.tolist(), truth.displacement_mm.tolist(), strict=True))


def main() -> None:
    stills(np.random.default_rng(2018))
    shared("plate", "ref.png", tuple(f"cur_z{z}.png" for z in ("0.0", "0.2", "1.8", "2.0")), Basis("plane"), plate_truth)
    dish_states = ("defocus_0.1", "defocus_1.0", "astig_0.5", "coma_0.3", "mixed")
    shared("dish", "ref.png", tuple(f"cur_{s}.png" for s in dish_states), Basis("zernike", 4), dish_truth)


if __name__ == "__main__":
    main()
