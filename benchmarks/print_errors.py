"""What ink spread and a camera's gamma do to a target's depth, beside the sigma that is claimed.

    scripts/bench print_errors [--quick]

The same plate is photographed as printed to size, with its ink spread outwards by 2 % of the largest radius, and recorded
through a gamma of 2.2, each in several poses. A ring's edges move against each other, so its depth stays; a lone disc only looks
larger, and its sigma must say so. Shift: mean of depth errors over all targets, which share the print error; largest: the worst
photograph's mean.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from _common import QUICK, Errors, covered, errors_of, join, print_table, rms

from dishmap.camera.model import Camera
from dishmap.pipeline import map_photograph
from dishmap.quality import Quality
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Light, Scene, Sensor, facing_pose
from dishmap.targets.builders import concentric, disc, multi_circular, plate, ring, whycon
from dishmap.targets.identify import Upright
from dishmap.targets.pattern import TargetKind
from dishmap.transforms import Pose

CAMERA = Camera(1100, 900, np.full(2, 2000.0), np.array([549.5, 449.5]))
DISTANCE_MM = 1000.0
RADIUS_MM = 7.5
SPREAD = 0.02
GAMMA = 2.2
CONTRAST = 40.0
SEEDS = 2 if QUICK else 8
KINDS: dict[str, TargetKind] = {
    "four rings": multi_circular(4, RADIUS_MM, 0.6 * RADIUS_MM, 2.8 * RADIUS_MM),
    "ring": ring(RADIUS_MM, 0.6 * RADIUS_MM),
    "concentric": concentric((1.3 * RADIUS_MM, RADIUS_MM, 0.7 * RADIUS_MM, 0.4 * RADIUS_MM)),
    "whycon": whycon(RADIUS_MM),
    "disc": disc(RADIUS_MM),
}


def scene_of(kind: TargetKind, rng: np.random.Generator) -> Scene:
    """A plate about 12 degrees tilted that fills the picture; noise is that of the recorded levels."""
    pitch = 2.4 * kind.extent_mm
    size = int(300 / pitch)
    pose = facing_pose(DISTANCE_MM, np.radians(12.0), rng.uniform(0, 2 * np.pi))
    pose = Pose(pose.rotation, pose.translation_mm + rng.uniform(-2, 2, 3))
    light = Light(ink_grey=25.0, ground_grey=190.0, background_grey=150.0)
    return Scene(plate(size, min(size + 1, 6), pitch, kind), CAMERA, pose, light=light, sensor=Sensor(noise_grey=165.0 / CONTRAST))


def variants(scene: Scene) -> dict[str, Scene]:
    return {
        "as printed": scene,
        f"ink spread {100 * SPREAD:.0f} %": replace(scene, ink_spread_mm=SPREAD * RADIUS_MM),
        f"gamma {GAMMA}": replace(scene, sensor=replace(scene.sensor, gamma=GAMMA)),
        "both": replace(scene, ink_spread_mm=SPREAD * RADIUS_MM, sensor=replace(scene.sensor, gamma=GAMMA)),
    }


def measure(scene: Scene, rng: np.random.Generator) -> Errors:
    picture = simulate(scene, rng)
    return errors_of(map_photograph(picture.image, scene.camera, scene.pattern, Upright()), picture.truth)


def main() -> None:
    rows = []
    for name, kind in KINDS.items():
        found: dict[str, list[Errors]] = {}
        for seed in range(SEEDS):
            rng = np.random.default_rng([2018, seed])
            for what, scene in variants(scene_of(kind, rng)).items():
                found.setdefault(what, []).append(measure(scene, np.random.default_rng([2018, seed, 1])))
        for what, parts in found.items():
            e = join(parts)
            z, sigma = e.position_mm[:, 2], float(np.median(e.sigma_mm[:, 2]))
            largest = max(np.abs(part.position_mm[:, 2].mean()) for part in parts)
            weak = 100 * float(np.mean((e.quality & Quality.WEAK_DEPTH) > 0))
            uv = rms(e.scores[:, 3:])
            rows.append(
                (name, what, len(e), z.mean(), largest, rms(z), sigma, abs(z.mean()) / sigma, round(covered(e.scores[:, 2]), 1), uv, weak)
            )
    header = (
        "kind",
        "print and camera",
        "targets",
        "shift mm",
        "largest",
        "rms mm",
        "sigma mm",
        "shift/sigma",
        "z in 95 %",
        "uv rms/sigma",
        "weak %",
    )
    print_table(header, rows, f"Depth at {DISTANCE_MM:.0f} mm, f 2000 px, outer radius 15 px, C {CONTRAST:.0f}, {SEEDS} photographs each")


if __name__ == "__main__":
    main()
