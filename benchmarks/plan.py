"""What `dishmap plan` predicts against what simulated photographs then show: depth, normal, position, and the shape of a change.

    scripts/bench plan [--quick]

Each case is a camera, a distance, a tilt and a pattern. Its photographs come in pairs. In the first the surface is nominal but for the
normals of the prints, which stray from it by the slope that the plan assumes; in the second it has moved by a random field of the plan's
amplitude and length (Matern 5/2, drawn as Zernike terms), and the camera's mount has given way by some 0.05 mm and 0.01 degrees. Both are
mapped as a user would: find_ellipses, identify with a rough pose, pixels; then compared.

The figures are rms errors against truth over all targets and pairs, the plan's prediction over that error (asked: 0.8 to 1.2), and the
standard error of that ratio from the scatter over the pairs. `claimed` is what the map or the difference itself said. The first photograph
is mapped with the prior on normals learnt from it, as by default, and with the true one given (`--normal-sigma-deg`); the pair is compared
with all learnt, and with smoothness, slide and strain given, which the plan's shape takes as known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from _common import QUICK, Array, errors_of, print_table, rms
from difference_coverage import shape_of
from numpy.random import Generator

from dishmap.camera.model import Camera
from dishmap.difference.difference_map import joint_difference
from dishmap.difference.model import smooth_kernel, surfaces_of
from dishmap.difference.priors import Priors
from dishmap.pipeline import map_photograph
from dishmap.planning import Conditions, Plan, camera_of_lens, plan
from dishmap.simulate.deform import Deformation, ZernikeTerm
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Light, Scene, Sensor, facing_pose
from dishmap.simulate.truth import Simulation
from dishmap.targets.builders import concentric, dish, multi_circular, plate, ring, whycon
from dishmap.targets.identify import PoseGuess
from dishmap.targets.pattern import Pattern
from dishmap.targets.stages import Assumptions
from dishmap.transforms import Pose, rotation_from_vector

PAIRS = 3 if QUICK else 8
# The field that a surface moves by is drawn as if so many targets could show it: Zernike terms to degree 8.
FIELD_TARGETS = 46
GOAL = (0.8, 1.2)
LIGHT = Light(ink_grey=25.0, ground_grey=190.0, background_grey=190.0)
GUESS_DEG, GUESS_MM = 2.0, 5.0
SHIFT_MM, SHIFT_RAD = 0.05, np.radians(0.01)
WIDE = np.array([-0.12, 0.015, 0.0003, -0.0002, 0.0])


@dataclass(frozen=True)
class Case:
    """One thing to plan."""

    name: str
    camera: Camera
    pattern: Pattern
    distance_mm: float
    tilt_deg: float
    conditions: Conditions

    @property
    def pose(self) -> Pose:
        """Where the camera stands."""
        return facing_pose(self.distance_mm, np.radians(self.tilt_deg), 0.5)


def cases() -> list[Case]:
    """Plates and dishes, groups of rings and lone rings, near and far, sharp and blurred, tilted and not."""
    pinhole = camera_of_lens(1280, 960, 46.0)
    wide = replace(camera_of_lens(1600, 1200, 80.0), distortion=WIDE)
    square = camera_of_lens(2400, 2400, 48.0)
    near = camera_of_lens(2000, 2000, 85.0)
    four = plate(5, 6, 45.0)
    usual = Conditions(40.0, 0.8, 0.05)
    return [
        Case("four rings, face on", pinhole, four, 500.0, 0.0, usual),
        Case("four rings, 25 deg", pinhole, four, 500.0, 25.0, usual),
        Case("four rings, 45 deg, C 75", pinhole, four, 550.0, 45.0, replace(usual, contrast_to_noise=75.0)),
        Case("four rings, far, blur 1.2", pinhole, four, 1000.0, 25.0, replace(usual, psf_sigma_px=1.2)),
        Case("rings, 20 deg", pinhole, plate(5, 6, 45.0, ring(8.0, 4.8)), 500.0, 20.0, usual),
        Case("concentric, 80 deg lens", wide, plate(5, 6, 45.0, concentric()), 300.0, 25.0, usual),
        Case("whycon, 30 deg", pinhole, plate(5, 6, 45.0, whycon(8.0)), 500.0, 30.0, usual),
        Case("dish 0.6 m at 750 mm", square, dish(600.0, 300.0, 55.0), 750.0, 0.0, usual),
        Case("dish 0.6 m at 750 mm, 20 deg", square, dish(600.0, 300.0, 55.0), 750.0, 20.0, usual),
        Case("dish 0.6 m near, 85 deg lens", near, dish(600.0, 300.0, 55.0), 420.0, 0.0, usual),
        Case("dish of rings, blur 1.5", square, dish(600.0, 300.0, 50.0, ring(10.0, 5.0)), 800.0, 10.0, replace(usual, psf_sigma_px=1.5)),
        Case("dish 0.3 m, small rings", pinhole, dish(300.0, 150.0, 30.0, multi_circular(4, 2.5, 1.5, 7.0)), 450.0, 5.0, usual),
    ]


Field = tuple[list[tuple[int, int]], Array]


def field_of(made: Plan) -> Field:
    """The plan's random field: Zernike terms, and their coefficients for independent unit parts."""
    surfaces = surfaces_of(made.pattern, np.arange(FIELD_TARGETS) % len(made.pattern))
    return list(surfaces.fields.normal_terms), made.conditions.amplitude_mm * smooth_kernel(surfaces, made.length_mm).root


def moved(field: Field, rng: Generator) -> Deformation:
    """A change of the surface drawn from a field."""
    terms, root = field
    size = root @ rng.standard_normal(root.shape[1])
    return Deformation(zernike=tuple(ZernikeTerm(n, m, float(s)) for (n, m), s in zip(terms, size, strict=True)))


def strayed(pattern: Pattern, slope_rad: float, rng: Generator) -> Pattern:
    """The pattern with each print tilted on its own."""
    tilt = np.zeros((len(pattern), 3))
    tilt[:, :2] = slope_rad * rng.standard_normal((len(pattern), 2))
    axes = pattern.axes @ rotation_from_vector(tilt)
    return replace(pattern, x_axis=axes[..., 0], normal=axes[..., 2])


@dataclass(frozen=True)
class Pair:
    """Errors, by name, of the first photograph's targets and of the change of shape; rms of the sigmas that were claimed."""

    error: dict[str, Array]
    claimed: dict[str, float]


def photographed(made: Plan, scene: Scene, rng: Generator) -> tuple[Simulation, PoseGuess]:
    """A photograph of a scene, and a rough pose."""
    given = made.conditions
    sensor = Sensor(given.psf_sigma_px, noise_grey=(LIGHT.ground_grey - LIGHT.ink_grey) / given.contrast_to_noise, bits=16)
    shot = simulate(replace(scene, light=LIGHT, sensor=sensor), rng)
    turn = rotation_from_vector(np.radians(GUESS_DEG) * _unit(rng))
    pose = scene.camera_from_dish
    return shot, PoseGuess(Pose(turn @ pose.rotation, pose.translation_mm + GUESS_MM * _unit(rng)))


def _unit(rng: Generator) -> Array:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def pair_of(made: Plan, field: Field, slope_rad: float, rng: Generator) -> Pair:
    """Two photographs, mapped and compared."""
    pattern, camera = made.pattern, made.camera
    scene = Scene(strayed(pattern, slope_rad, rng), camera, made.camera_from_dish)
    later = Pose.from_rotation_vector(rng.normal(0, SHIFT_RAD, 3), rng.normal(0, SHIFT_MM, 3)) @ made.camera_from_dish
    first, guess = photographed(made, scene, rng)
    second, other_guess = photographed(made, replace(scene, deformation=moved(field, rng), camera_from_dish=later), rng)
    before = map_photograph(first.image, camera, pattern, guess)
    known = map_photograph(first.image, camera, pattern, guess, assumptions=Assumptions(normal_sigma_deg=float(np.degrees(slope_rad))))
    after = map_photograph(second.image, camera, pattern, other_guess)
    change = joint_difference(before.poses, after.poses, camera, pattern)
    priors = Priors(amplitude_mm=made.conditions.amplitude_mm, length_mm=made.length_mm, strain="rigid", slide=made.conditions.slide)
    sure = joint_difference(before.poses, after.poses, camera, pattern, priors)
    assert (sure.ids == change.ids).all()
    rows = np.searchsorted(pattern.ids, change.ids)
    points, normal = pattern.center_mm[rows], pattern.normal[rows]
    move = made.camera_from_dish.inverse().apply(second.truth.center_mm[rows]) - points
    shape = shape_of(move, points, normal)
    plain, told = errors_of(before, first.truth), errors_of(known, first.truth)
    error = {
        "position": plain.center_px,
        "depth": plain.position_mm[:, 2],
        "normal": plain.normal_rad,
        "normal, prior given": told.normal_rad,
        "shape": change.shape_mm - shape,
        "shape, priors given": sure.shape_mm - shape,
    }
    sigmas = plain.sigma_px, plain.sigma_mm[:, 2], plain.sigma_normal_rad, told.sigma_normal_rad, change.sigma_shape_mm, sure.sigma_shape_mm
    return Pair(error, {name: rms(sigma) for name, sigma in zip(error, sigmas, strict=True)})


def rows_of(case: Case, seed: int) -> list[tuple[object, ...]]:
    """One row of figures for each thing predicted."""
    made = plan(case.camera, case.pattern, case.pose, case.conditions)
    slope = float(np.sqrt(5 / 3) * case.conditions.amplitude_mm / made.length_mm)
    told = replace(case.conditions, assumptions=Assumptions(normal_sigma_deg=float(np.degrees(slope))))
    held, field = plan(case.camera, case.pattern, case.pose, told), field_of(made)
    pairs = [pair_of(made, field, slope, np.random.default_rng([2018, seed, n])) for n in range(PAIRS)]
    degrees = np.degrees(1.0)
    expected = {
        "position": (rms(made.sigma_px), "px", 1.0),
        "depth": (rms(made.sigma_depth_mm), "mm", 1.0),
        "normal": (rms(made.cloud.sigma_normal_rad), "deg", degrees),
        "normal, prior given": (rms(held.cloud.sigma_normal_rad), "deg", degrees),
        "shape": (rms(made.shape_mm), "mm", 1.0),
        "shape, priors given": (rms(made.shape_mm), "mm", 1.0),
    }
    out = []
    for what, (predicted, unit, scale) in expected.items():
        squares = np.array([np.mean(np.square(pair.error[what])) for pair in pairs])
        measured = float(np.sqrt(squares.mean()))
        ratio = predicted / measured
        # half the relative error of the mean square
        by = ratio * 0.5 * float(squares.std(ddof=1) / squares.mean()) / np.sqrt(PAIRS)
        claimed = rms(np.array([pair.claimed[what] for pair in pairs]))
        numbers = (scale * value for value in (predicted, claimed, measured))
        out.append((what, case.name, unit, len(made.cloud), *numbers, round(ratio, 3), round(by, 3), "*" if outside(ratio) else ""))
    return out


def outside(ratio: float) -> bool:
    return not GOAL[0] <= ratio <= GOAL[1]


def main() -> None:
    header = ("case", "unit", "targets", "predicted", "claimed", "rms error", "pred./error", "+-", "outside")
    every = []
    for seed, case in enumerate(cases()):
        every += rows_of(case, seed)
        print(f"{case.name}: done", flush=True)
    for what in dict.fromkeys(row[0] for row in every):
        rows = [row[1:] for row in every if row[0] == what]
        print_table(header, rows, f"{what}; {PAIRS} pairs of photographs a case; * outside {GOAL[0]} to {GOAL[1]}")
        ratios = np.array([float(str(row[6])) for row in rows])
        inside = len(ratios) - sum(map(outside, ratios))
        print(f"{what}: {inside} of {len(ratios)} within 20 %; {ratios.min():.2f} to {ratios.max():.2f}, median {np.median(ratios):.2f}")


if __name__ == "__main__":
    main()
