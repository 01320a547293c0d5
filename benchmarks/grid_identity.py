"""Grids found and rightly named, in random scenes: lines and squares on plates, dishes and cylinders, by marks, hints and anchors.

    scripts/bench grid_identity [--quick]

`whole`: targets that the truth shows wholly, within half a step about; `found`: those of them that were named; `wrong`: nodes named
other than the target whose true place they lie at (within 0.3 of a step; beyond it they are wrong too); `refused`: photographs that were
refused with a reason. Cameras see 60 to 110 degrees; plates are tilted by up to 60 degrees, lines are broken in 15 % of their pieces, and
glare, things in front, clutter behind, blur of 0.6 to 2.5 px and noise disturb. `wrapped`: the pattern given is flat, what is
photographed is wrapped round a cylinder. Without marks a photograph of a part, or of a whole square, must be refused: `no marks, no hint`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from _common import QUICK, print_table

from dishmap.camera.model import Camera
from dishmap.errors import DishmapError
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Disc, Glare, Light, Scene, Sensor, facing_pose, random_line_gaps, random_shapes
from dishmap.simulate.truth import Truth
from dishmap.targets.grid_builders import grid
from dishmap.targets.grid_detect import GridDetections, find_grid
from dishmap.targets.grid_identify import GridIdentity, identify_grid
from dishmap.targets.identify import Anchors, Hint, PoseGuess, Upright
from dishmap.targets.pattern import Pattern, Surface
from dishmap.transforms import Pose, rotation_from_vector

SEEDS = 3 if QUICK else 12
SIZE_PX = (1600, 1200)
PITCH_MM = 12.0
# A node belongs to a target within this part of a step; an anchor is as far off as its promise nearly allows, a guess a quarter step.
AT_TARGET, ANCHOR_OFF, GUESS_OFF = 0.3, 0.35, 0.2
WHOLE = 0.98


@dataclass(frozen=True)
class Case:
    """Scenes of one sort: the surface, squares or lines, marks, and the hint."""

    surface: str
    lines: bool
    marked: bool
    hint: str

    @property
    def name(self) -> str:
        return f"{self.surface}, {'lines' if self.lines else 'squares'}, {'marks' if self.marked else 'no marks'}, {self.hint}"


CASES = (
    *(Case(surface, lines, True, "no hint") for surface in ("plate", "dish", "cylinder", "wrapped") for lines in (True, False)),
    *(Case(surface, lines, False, "upright and anchor") for surface in ("plate", "dish", "wrapped") for lines in (True, False)),
    *(Case(surface, True, False, "guess") for surface in ("plate", "dish")),
    *(Case("plate", lines, False, "no hint") for lines in (True, False)),
)


def draw_camera(rng: np.random.Generator) -> Camera:
    width, height = SIZE_PX
    view = np.radians(rng.uniform(60, 110))
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    if view > np.radians(90):
        focal = width / 2 / (view / 2)
        return Camera(width, height, np.full(2, focal), middle, np.array([-0.01, 0.002, 0.0, 0.0]), "fisheye")
    focal = width / 2 / np.tan(view / 2)
    return Camera(width, height, np.full(2, focal), middle, np.array([rng.uniform(-0.15, 0.0), 0.03, 0.0, 0.0]))


def draw_pattern(case: Case, rng: np.random.Generator) -> tuple[Pattern, Pattern]:
    """The pattern that is photographed, and the one that is given."""
    columns, rows = (int(n) for n in rng.integers(12, 36, size=2))
    if case.surface == "dish":
        columns = rows = int(rng.integers(20, 36))
    ink = {"line_width_mm": rng.uniform(0.8, 1.5)} if case.lines else {"square_mm": rng.uniform(4.5, 6.5)}
    size = columns * PITCH_MM
    surfaces = {
        "plate": Surface(),
        "dish": Surface("paraboloid", diameter_mm=size, focal_length_mm=rng.uniform(0.4, 0.7) * size),
        "cylinder": Surface("cylinder", radius_mm=rng.choice([-1, 1]) * rng.uniform(0.4, 0.9) * size),
        "wrapped": Surface("cylinder", radius_mm=rng.choice([-1, 1]) * rng.uniform(0.4, 0.9) * size),
    }
    shown = grid(columns, rows, PITCH_MM, surface=surfaces[case.surface], orientation_marks=case.marked, **ink)
    given = grid(columns, rows, PITCH_MM, orientation_marks=case.marked, **ink) if case.surface == "wrapped" else shown
    return shown, given


def draw_scene(case: Case, rng: np.random.Generator) -> tuple[Scene, Pattern]:
    camera = draw_camera(rng)
    shown, given = draw_pattern(case, rng)
    step_px = np.exp(rng.uniform(np.log(18.0), np.log(60.0)))
    distance = max(float(camera.focal_px[0]) * PITCH_MM / step_px, 100.0)
    pose = facing_pose(distance, np.radians(rng.uniform(0, 60 if case.surface == "plate" else 20)), rng.uniform(0, 2 * np.pi))
    turn = rng.uniform(-35, 35) if "upright" in case.hint else rng.uniform(-180, 180)
    roll = Pose(rotation_from_vector(np.array([0.0, 0.0, np.radians(turn)])), np.zeros(3))
    side = Pose(np.eye(3), np.array([*rng.uniform(-0.1, 0.1, size=2) * distance, 0.0]))
    light = Light(
        ink_grey=rng.uniform(15, 80),
        gradient=(rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6)),
        vignetting=rng.uniform(0, 0.3),
        background_grey=rng.uniform(5, 180),
        glare=tuple(Glare(_place(rng), rng.uniform(20, 90), rng.uniform(60, 400)) for _ in range(rng.integers(0, 4))),
    )
    sensor = Sensor(psf_sigma_px=rng.uniform(0.6, min(2.5, step_px / 10)), noise_grey=rng.uniform(0.5, 4.0))
    gaps = random_line_gaps(rng, shown, 0.15) if case.lines else ()
    front = tuple(Disc(_place(rng), rng.uniform(15, 80), rng.uniform(10, 200)) for _ in range(rng.integers(0, 5)))
    behind = random_shapes(rng, camera, 10, 10, 20, (4.0, 60.0), (10.0, 200.0))
    scene = Scene(shown, camera, roll @ side @ pose, light=light, sensor=sensor, line_gaps=gaps, background=behind, occluders=front)
    return scene, given


def _place(rng: np.random.Generator) -> tuple[float, float]:
    u, v = rng.uniform([0, 0], SIZE_PX)
    return float(u), float(v)


def draw_hint(case: Case, scene: Scene, truth: Truth, found: GridDetections, rng: np.random.Generator) -> Hint:
    if case.hint == "guess":
        shift = rng.uniform(-1, 1, size=3) * GUESS_OFF * PITCH_MM / 2
        return PoseGuess(Pose(np.eye(3), shift) @ scene.camera_from_dish)
    if case.hint == "no hint":
        return None
    # a target that was found in the largest part, as a user would point at one that is well seen
    main = np.flatnonzero(found.component == 0)
    node = int(rng.choice(main))
    target = int(np.nanargmin(np.linalg.norm(truth.center_px - found.place_px[node], axis=1)))
    at = truth.center_px[target] + found.step_px[node] @ rng.uniform(-ANCHOR_OFF, ANCHOR_OFF, size=2)
    return Anchors((int(truth.ids[target]),), at[None], Upright() if "upright" in case.hint else None)


def wrong_nodes(found: GridDetections, identity: GridIdentity, truth: Truth) -> int:
    """How many named nodes do not lie at their target's true place."""
    off = found.place_px[identity.detection] - truth.center_px[identity.index]
    away = np.linalg.solve(found.step_px[identity.detection], off[..., None])[..., 0]
    return int((~(np.linalg.norm(away, axis=1) < AT_TARGET)).sum())


def run(case: Case) -> list[object]:
    whole = named = wrong = refused = photographs = 0
    reasons = []
    for seed in range(SEEDS):
        rng = np.random.default_rng([seed, CASES.index(case)])
        scene, given = draw_scene(case, rng)
        simulation = simulate(scene, rng)
        truth = simulation.truth
        shown = truth.visible_fraction > WHOLE
        photographs += 1
        try:
            found = find_grid(simulation.image, case.lines)
            identity = identify_grid(found, given, scene.camera, draw_hint(case, scene, truth, found, rng))
        except DishmapError as error:
            refused += 1
            reasons.append(f"  {case.name}, seed {seed}, {shown.sum()} whole: {str(error)[:150]}")
            continue
        whole += int(shown.sum())
        named += int(shown[identity.index].sum())
        wrong += wrong_nodes(found, identity, truth)
    print("\n".join(reasons), flush=True)
    return [case.name, photographs, refused, whole, named / max(whole, 1), wrong]


if __name__ == "__main__":
    rows = [run(case) for case in CASES]
    print_table(["scenes", "photographs", "refused", "whole", "found", "wrong"], rows)
