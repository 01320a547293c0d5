"""Are the claimed sigmas true? Share of errors within their 95 % intervals over a few thousand simulated targets.

    scripts/bench coverage [--quick]

Every photograph draws its own camera (focal length, distortion or fisheye), pose, kind and size of target, blur, noise (with shot noise
in half of them), shading, 8 or 16 bits, and plate, bent plate or dish. In a fifth of them the targets stand so close that the blur of
one reaches into the next, which the fit does not know: these have a row of their own and are left out of the others. Rejected targets
are left out too; flagged ones are told apart: a flag warns.
An interval of 95 % that is true covers 95 % within the +- given, which is chance alone (targets of one photograph share a little more).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from _common import QUICK, Errors, covered, errors_of, join, nothing, print_table, rms, select, wrong_names

from dishmap.camera.model import Camera
from dishmap.errors import DishmapError
from dishmap.pipeline import map_photograph
from dishmap.quality import Quality
from dishmap.simulate.deform import Deformation, ZernikeTerm
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Light, Scene, Sensor, facing_pose
from dishmap.targets.builders import concentric, dish, multi_circular, plate, ring, whycon
from dishmap.targets.identify import Upright
from dishmap.targets.pattern import Pattern, TargetKind
from dishmap.transforms import Pose

SEEDS = 12 if QUICK else 120
SIZE_PX = (1000, 800)
RADIUS_PX = (6.0, 22.0)
MOST_ACROSS = 8
# Gaps between neighbouring targets, in blurs (sigma, the pixel's area included).
GAP_BLURS, CROWDED_BLURS, CROWDED_PART = (7.0, 16.0), (3.0, 6.0), 0.2
KINDS: dict[str, Callable[[float], TargetKind]] = {
    "four rings": lambda r: multi_circular(4, r, 0.6 * r, 2.8 * r),
    "ring": lambda r: ring(r, 0.6 * r),
    "concentric": lambda r: concentric((1.4 * r, 1.1 * r, 0.8 * r, 0.5 * r)),
    "whycon": whycon,
}


@dataclass(frozen=True)
class Shot:
    """What was drawn for one photograph, and the errors found in it."""

    kind: str
    lens: str
    bits: int
    shot_noise: bool
    surface: str
    crowded: bool
    errors: Errors


def draw_camera(rng: np.random.Generator) -> tuple[Camera, str]:
    """A camera of 40 to 100 degrees across, its principal point off the middle."""
    width, height = SIZE_PX
    lens = str(rng.choice(["none", "distorted", "fisheye"]))
    focal = rng.uniform(0.55 if lens == "fisheye" else 0.75, 1.4) * width
    focal_px = focal * np.array([1.0, rng.uniform(0.995, 1.005)])
    principal = np.array([(width - 1) / 2, (height - 1) / 2]) + rng.uniform(-15, 15, 2)
    if lens == "distorted":
        k = np.array([rng.uniform(-0.25, 0.05), rng.uniform(0.0, 0.08), *rng.uniform(-5e-4, 5e-4, 2), 0.0])
        return Camera(width, height, focal_px, principal, k), lens
    if lens == "fisheye":
        return Camera(width, height, focal_px, principal, np.array([rng.uniform(-0.03, 0.03), 0.005, -0.002, 0.0]), "fisheye"), lens
    return Camera(width, height, focal_px, principal), lens


def draw_pattern(kind: TargetKind, gap_mm: float, width_mm: float, rng: np.random.Generator) -> tuple[Pattern, str]:
    """A plate, a plate to be bent, or a dish, of up to this width and MOST_ACROSS targets across, with gaps between targets."""
    pitch = 2 * kind.extent_mm + gap_mm
    count = int(np.clip(width_mm / pitch, 3, MOST_ACROSS))
    surface = str(rng.choice(["plate", "bent plate", "dish"]))
    if surface == "dish":
        return dish(count * pitch, 0.6 * count * pitch, spacing_mm=1.05 * pitch, kind=kind), surface
    return plate(max(3, int(0.75 * count)), count, pitch, kind), surface


def bend(pattern: Pattern, rng: np.random.Generator) -> Deformation:
    """A plate bent by up to 0.3 degrees: more would stretch it, and its targets, by slope^2 / 2, which no sigma knows of."""
    slope = np.radians(rng.uniform(0.05, 0.3))
    reach = float(np.linalg.norm(pattern.center_mm, axis=1).max())
    return Deformation(zernike=(ZernikeTerm(2, 2, 0.5 * slope * reach), ZernikeTerm(3, -1, 0.1 * slope * reach)))


def photograph(rng: np.random.Generator) -> tuple[Scene, Shot]:
    camera, lens = draw_camera(rng)
    name = str(rng.choice(list(KINDS)))
    distance = rng.uniform(400, 1500)
    scale = distance / camera.focal_px[0]
    kind = KINDS[name](rng.uniform(*RADIUS_PX) * scale)
    psf, crowded = rng.uniform(0.5, 1.6), bool(rng.random() < CROWDED_PART)
    gap = rng.uniform(*(CROWDED_BLURS if crowded else GAP_BLURS)) * np.hypot(psf, 12**-0.5)
    pattern, surface = draw_pattern(kind, gap * scale, 0.75 * SIZE_PX[1] * scale, rng)
    pose = facing_pose(distance, rng.uniform(0, np.radians(35)), rng.uniform(0, 2 * np.pi))
    pose = Pose(pose.rotation, pose.translation_mm + np.append(rng.uniform(-0.05, 0.05, 2) * distance, 0.0))
    ink, ground = rng.uniform(15, 40), rng.uniform(120, 220)
    bits, shot_noise = int(rng.choice([8, 16])), bool(rng.random() < 0.5)
    noise = (ground - ink) / rng.uniform(30, 90)
    light = Light(ink, ground, rng.uniform(10, 60), tuple(rng.uniform(-0.3, 0.3, 2)), rng.uniform(0, 0.3))
    # shot noise is as large at the ground's level as the noise of a photograph without it
    electrons = ground / noise**2 if shot_noise else None
    sensor = Sensor(psf, 1.0, 0.3 * noise if shot_noise else noise, electrons, bits)
    deformation = bend(pattern, rng) if surface == "bent plate" else Deformation()
    scene = Scene(pattern, camera, pose, deformation, light, sensor)
    return scene, Shot(name, lens, bits, shot_noise, surface, crowded, nothing())


def row_of(errors: Errors) -> tuple[object, ...]:
    """Coverage of x, y, z, u, v, then what the scores' spread and mean are, and the normals'."""
    scores = errors.scores
    return (
        len(errors),
        100 * float(np.sqrt(0.95 * 0.05 / max(len(errors), 1))),
        *(round(covered(scores[:, k]), 1) for k in range(5)),
        *(rms(scores[:, k]) for k in (2, 3)),
        scores[:, 2].mean(),
        np.abs(scores[:, 3:].mean(axis=0)).max(),
        rms(np.degrees(errors.normal_rad)),
        rms(np.degrees(errors.sigma_normal_rad)),
        rms(errors.normal_rad / errors.sigma_normal_rad),
    )


def main() -> None:
    shots: list[Shot] = []
    asked = wrong = refused = 0
    for seed in range(SEEDS):
        rng = np.random.default_rng([2018, seed])
        scene, drawn = photograph(rng)
        picture = simulate(scene, rng)
        whole = picture.truth.visible_fraction > 0.999
        asked += int(whole.sum())
        try:
            result = map_photograph(picture.image, scene.camera, scene.pattern, Upright())
        except DishmapError as error:
            refused += int(whole.sum())
            size = scene.pattern.kind_of(0).radius_mm.min() * scene.camera.focal_px[0] / scene.camera_from_dish.translation_mm[2]
            print(f"not mapped: seed {seed}, {drawn.kind}, smallest circle {size:.1f} px, blur {scene.sensor.psf_sigma_px:.1f} px: {error}")
            continue
        wrong += wrong_names(result, picture.truth, scene.camera)
        shots.append(
            Shot(drawn.kind, drawn.lens, drawn.bits, drawn.shot_noise, drawn.surface, drawn.crowded, errors_of(result, picture.truth))
        )
        _tell_outliers(seed, shots[-1])
    crowd, shots = [s.errors for s in shots if s.crowded], [s for s in shots if not s.crowded]
    every = join([s.errors for s in shots])
    print(f"{SEEDS} photographs, {asked} targets wholly in view, {len(every)} measured, {wrong} wrong names")
    print(f"{sum(map(len, crowd))} more measured that stand crowded")
    print(f"{refused} targets in photographs that were refused")
    header = ("targets", "+-", "x %", "y %", "z %", "u %", "v %", "rms z/s", "rms u/s", "bias z/s", "bias uv/s")
    header = ("of", *header, "normal deg", "claimed", "rms n/s")
    rows = [("all", *row_of(every)), ("no flag", *row_of(select(every, every.quality == 0)))]
    flagged = {str(flag.name).lower(): (every.quality & flag) > 0 for flag in Quality if flag}
    rows += [(name, *row_of(select(every, has))) for name, has in flagged.items() if has.any()]
    for name in ("kind", "lens", "surface", "bits", "shot_noise"):
        for value in sorted({getattr(s, name) for s in shots}):
            rows.append((f"{name} {value}", *row_of(join([s.errors for s in shots if getattr(s, name) == value]))))
    if crowd:
        rows.append(("crowded", *row_of(join(crowd))))
    print_table(header, rows, "Coverage of 95 % intervals; rms of error over sigma should be 1")


def _tell_outliers(seed: int, shot: Shot) -> None:
    far = np.abs(shot.errors.scores).max(axis=1)
    for i in np.flatnonzero(far > 5):
        scores = " ".join(f"{s:.1f}" for s in shot.errors.scores[i])
        what = f"{shot.kind}, {shot.lens}, {shot.surface}"
        print(f"beyond 5 sigma: seed {seed}, {what}, id {shot.errors.ids[i]}, flags {int(shot.errors.quality[i])}, errors/sigma {scores}")


if __name__ == "__main__":
    main()
