"""Found and rightly named, in random scenes: by hint, by marks, and with clutter, glare and things in front.

    scripts/bench identity [--quick]

`whole`: targets whose ink is wholly visible by the truth; `found`: those of them that were measured; `invented`: targets measured of
which the truth shows less than a tenth; `wrong`: measured targets that lie nearer to another's true place; `refused`: photographs that
were refused with a reason. Plates look the same after half a turn, so `no hint` must refuse them unless they carry orientation marks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from _common import QUICK, print_table, wrong_names

from dishmap.camera.model import Camera
from dishmap.errors import DishmapError
from dishmap.pipeline import Map, map_photograph
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Disc, Glare, Light, Polygon, Scene, Sensor, facing_pose, random_shapes
from dishmap.simulate.truth import Truth
from dishmap.targets.builders import concentric, dish, multi_circular, plate, ring, whycon
from dishmap.targets.identify import Hint, PoseGuess, Upright
from dishmap.targets.pattern import Pattern, TargetKind
from dishmap.transforms import Pose, rotation_from_vector

SEEDS = 4 if QUICK else 24
SIZE_PX = (1200, 900)
GUESS_DEG, GUESS_MM = 10.0, 50.0
HIDDEN = 0.1
KINDS: dict[str, Callable[[float], TargetKind]] = {
    "four rings": lambda r: multi_circular(4, r, 0.6 * r, 2.8 * r),
    "ring": lambda r: ring(r, 0.6 * r),
    "concentric": lambda r: concentric((1.5 * r, 1.1 * r, 0.7 * r)),
    "whycon": whycon,
}


@dataclass(frozen=True)
class Case:
    """Scenes of one sort: marked patterns or not, the hint, and what disturbs."""

    name: str
    marked: bool
    hint: str
    disturbed: bool


CASES = (
    Case("upright", False, "upright", False),
    Case("guess 10 deg, 50 mm off", False, "guess", False),
    Case("marks, no hint", True, "none", False),
    Case("no marks, no hint", False, "none", False),
    Case("upright, disturbed", False, "upright", True),
    Case("guess, disturbed", False, "guess", True),
    Case("marks, no hint, disturbed", True, "none", True),
)


def draw_pattern(rng: np.random.Generator, distance: float, focal: float, marked: bool) -> Pattern:
    name = str(rng.choice(list(KINDS)))
    scale = distance / focal
    kind = KINDS[name](rng.uniform(6.0, 11.0 if name == "four rings" else 18.0) * scale)
    pitch = rng.uniform(2.4, 3.2) * kind.extent_mm
    count = int(np.clip(0.8 * SIZE_PX[1] * scale / pitch, 4, 12))
    if rng.random() < 0.5:
        return plate(count, count + 1, pitch, kind, orientation_marks=marked)
    return dish(count * pitch, 0.7 * count * pitch, spacing_mm=1.1 * pitch, kind=kind, orientation_marks=marked)


def draw_scene(case: Case, rng: np.random.Generator) -> tuple[Scene, Hint]:
    width, height = SIZE_PX
    distance, focal = rng.uniform(500, 1500), rng.uniform(0.8, 1.6) * width
    lens = np.array([rng.uniform(-0.2, 0.0), 0.05, 0.0, 0.0])
    camera = Camera(width, height, np.full(2, focal), np.array([(width - 1) / 2, (height - 1) / 2]), lens)
    pattern = draw_pattern(rng, distance, focal, case.marked)
    pose = facing_pose(distance, rng.uniform(0, np.radians(30)), rng.uniform(0, 2 * np.pi))
    turn = rng.uniform(-35, 35) if case.hint == "upright" else rng.uniform(-180, 180)
    spin = rotation_from_vector(np.array([0.0, 0.0, np.radians(turn)]))
    pose = Pose(spin @ pose.rotation, pose.translation_mm + np.append(rng.uniform(-0.08, 0.08, 2) * distance, 0.0))
    light = Light(gradient=tuple(rng.uniform(-0.3, 0.3, 2)), vignetting=rng.uniform(0, 0.3))
    scene = Scene(pattern, camera, pose, light=light, sensor=Sensor(rng.uniform(0.6, 1.2), noise_grey=rng.uniform(1.0, 4.0)))
    if case.disturbed:
        scene = disturb(scene, rng)
    return scene, draw_hint(case, pose, rng)


def disturb(scene: Scene, rng: np.random.Generator) -> Scene:
    """Clutter behind, one or two glares, and a bar and some discs in front."""
    width, height = SIZE_PX
    clutter = random_shapes(rng, scene.camera, 25, 25, 15, (4.0, 40.0), (20.0, 220.0))
    glare = tuple(Glare(_place(rng), rng.uniform(20, 90), rng.uniform(80, 400)) for _ in range(int(rng.integers(1, 3))))
    middle, angle, half = np.array(_place(rng)), rng.uniform(0, np.pi), rng.uniform(8, 30)
    along, across = np.array([np.cos(angle), np.sin(angle)]) * (width + height), np.array([-np.sin(angle), np.cos(angle)]) * half
    corners = [tuple(map(float, middle + i * along + j * across)) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    discs = [Disc(_place(rng), float(rng.uniform(5, 60)), float(rng.uniform(0, 255))) for _ in range(6)]
    return replace(
        scene,
        background=clutter,
        occluders=(Polygon(tuple(corners), float(rng.uniform(0, 255))), *discs),
        light=replace(scene.light, glare=glare),
    )


def _place(rng: np.random.Generator) -> tuple[float, float]:
    u, v = rng.uniform([0, 0], SIZE_PX)
    return float(u), float(v)


def draw_hint(case: Case, pose: Pose, rng: np.random.Generator) -> Hint:
    if case.hint == "none":
        return None
    if case.hint == "upright":
        return Upright()
    axis, shift = rng.normal(size=3), rng.normal(size=3)
    turn = rotation_from_vector(np.radians(GUESS_DEG) * axis / np.linalg.norm(axis))
    return PoseGuess(Pose(turn @ pose.rotation, pose.translation_mm + GUESS_MM * shift / np.linalg.norm(shift)))


def counts(result: Map, truth: Truth, scene: Scene) -> tuple[int, int, int]:
    """Wholly visible targets found, targets invented, wrong names."""
    visible = dict(zip(truth.ids.tolist(), truth.visible_fraction, strict=True))
    shares = np.array([visible[int(i)] for i in result.cloud.ids])
    return int((shares > 0.999).sum()), int((shares < HIDDEN).sum()), wrong_names(result, truth, scene.camera)


def main() -> None:
    rows, notes = [], []
    for number, case in enumerate(CASES):
        total = np.zeros(4, int)
        refused = refused_whole = crashed = 0
        for seed in range(SEEDS):
            rng = np.random.default_rng([2018, number, seed])
            scene, hint = draw_scene(case, rng)
            picture = simulate(scene, rng)
            whole = int((picture.truth.visible_fraction > 0.999).sum())
            try:
                result = map_photograph(picture.image, scene.camera, scene.pattern, hint)
            except DishmapError as error:
                refused += 1
                refused_whole += whole
                if case.name != "no marks, no hint":
                    notes.append(f"refused: {case.name}, seed {seed}, {scene.pattern.name}: {error}")
                continue
            except Exception as error:  # a crash is a result here, and must not hide the others
                crashed += 1
                notes.append(f"crashed: {case.name}, seed {seed}, {scene.pattern.name}: {type(error).__name__}: {error}")
                continue
            found, invented, wrong = counts(result, picture.truth, scene)
            total += [whole, found, invented, wrong]
            if found < whole or invented or wrong:
                missing = np.setdiff1d(picture.truth.ids[picture.truth.visible_fraction > 0.999], result.cloud.ids).tolist()
                told = {i: reason for i, reason in result.rejected if i in missing}
                said = "; ".join(f"{i}: {told.get(i, 'not seen')}" for i in missing)
                notes.append(f"{case.name}, seed {seed}, {scene.pattern.name}: invented {invented}, wrong {wrong}, missing {said}")
        share = 100 * total[1] / max(total[0], 1)
        rows.append(
            (case.name, SEEDS, crashed, refused, refused_whole, *map(int, total[:2]), share, int(total[0] - total[1]), *map(int, total[2:]))
        )
    header = ("case", "photographs", "crashed", "refused", "their targets", "whole", "found", "found %", "missed", "invented", "wrong")
    print_table(header, rows, "Identity in random scenes")
    if notes:
        print("\nwhat was missed or refused:")
        print("\n".join(notes))


if __name__ == "__main__":
    main()
