"""Are the sigmas of a difference of two grids true, and how near does it come to the bound?

    scripts/bench difference_grid [--quick]

First without photographs, as `difference_coverage` does for circles, with its families of deformations: a dish of crossing lines (0.6 m,
f/D 0.5) from 350, 600 and 1000 mm, and plates of lines and of squares from 800 mm. The image places of the deformed grid get the noise of
`grid_bound` (contrast 60, blur 0.8 px); the surface through them, the poses and the difference are the program's own. Prints lie off their
places by 0.01 mm, alike in both states; the camera shifts by some 0.2 mm and 0.02 degrees in between. Points slide as a membrane's, which
is what the estimate takes for granted where crossings show no more than their places; a full run has a table for points that stay on their
normals instead. Then a few cases through the whole chain, with photographs: stills of a plate, and a dish with astigmatism, defocus and a
bump.
"""

from __future__ import annotations

import os

# one core, whatever the machine has; before numpy is loaded
os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from _common import QUICK, Z95, print_table, rms
from difference_coverage import CONTRAST, FAMILIES, HEADER, POWERS, PSF_PX, Bench, Trial, own_size, row_of, scaled, shape_of, shifted
from numpy.random import Generator
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.difference.bound import joint_bound
from dishmap.difference.difference_map import DifferenceMap, joint_difference
from dishmap.pipeline import map_photograph
from dishmap.quality import Quality
from dishmap.simulate.deform import Bump, Deformation, ZernikeTerm, deform
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.targets.grid_bound import grid_bound
from dishmap.targets.grid_builders import grid
from dishmap.targets.grid_points import GridPoints
from dishmap.targets.grid_poses import measured_of, poses_of
from dishmap.targets.grid_sheet import estimate_sheet
from dishmap.targets.grid_terms import CORNERS, MEASURED
from dishmap.targets.identify import Upright
from dishmap.targets.pattern import Pattern, Surface, bent_print_mm
from dishmap.targets.pose import TargetPoses
from dishmap.targets.scene_noise import NoiseModel
from dishmap.transforms import Pose

Array = NDArray[Any]

# of each family and scene
TRIALS = 1 if QUICK else 6
OTHER_SLIDE_TRIALS = 0 if QUICK else 3
STILLS = 2 if QUICK else 12
# wider in a quick run, whose dishes so have 213 crossings instead of 484
DISH_PITCH_MM = 36.0 if QUICK else 24.0
PHOTOGRAPHED_FROM_MM = (650.0,) if QUICK else (650.0, 1000.0)
PRINT_MM = 0.01
DISTORTION = np.array([-0.03, 0.004, 0.0, 0.0, 0.0])
NOISE_GREY = 4.0


def dish_of_lines() -> Pattern:
    """A dish of 0.6 m with crossings of lines 1 mm wide."""
    count = int(624 / DISH_PITCH_MM)
    return grid(count, count, DISH_PITCH_MM, line_width_mm=1.0, surface=Surface("paraboloid", 600.0, 300.0))


def bench(name: str, camera: Camera, pattern: Pattern, pose: Pose) -> Bench:
    """A grid before a camera; information (N, m, m) is that of the measured vectors."""
    places, size = camera.project(pose.apply(pattern.center_mm)), (camera.width_px, camera.height_px)
    return Bench(name, camera, pattern, pose, grid_bound(pattern, np.arange(len(pattern)), places, size, CONTRAST, PSF_PX))


@lru_cache(maxsize=1)
def benches() -> tuple[Bench, ...]:
    """A dish from half the radius of curvature, near its centre of curvature and from far; plates of lines and of squares."""

    def camera(focal: float) -> Camera:
        return Camera(3000, 3000, np.full(2, focal), np.full(2, 1499.5), DISTORTION)

    dish, tilt = dish_of_lines(), np.radians(2.0)
    lines, squares = grid(24, 20, 20.0, line_width_mm=1.0), grid(16, 14, 30.0, square_mm=12.0)
    dishes = {350.0: 1200.0, 600.0: 2200.0, 1000.0: 3600.0}
    plates, leaning = {"lines": lines, "squares": squares}, facing_pose(800.0, np.radians(12.0))
    return (
        *(bench(f"dish, {d:.0f} mm", camera(f), dish, facing_pose(d, tilt)) for d, f in dishes.items()),
        *(bench(f"plate of {what}", camera(3600.0), plate, leaning) for what, plate in plates.items()),
    )


def true_nodes(at: Bench, state: Deformation, pose: Pose, print_mm: Array) -> Array:
    """Corners of squares, or crossings, (N, 4 or 1, 3) in the camera frame; print_mm (N, 2): how far they are printed off their place."""
    pattern = at.pattern
    local = np.zeros((1, 2)) if pattern.lines else CORNERS * np.abs(pattern.kind_of(0).polygons[0].corners_mm).max()
    bent = bent_print_mm(local + print_mm[:, None], pattern.curvature_per_mm)
    nominal = pattern.center_mm[:, None] + bent @ np.swapaxes(pattern.axes, 1, 2)
    return np.asarray(pose.apply(deform(state, pattern.surface, nominal, pattern.rim_radius_mm)))


def measured(at: Bench, state: Deformation, pose: Pose, print_mm: Array, rng: Generator) -> TargetPoses:
    """What a photograph of this state would give."""
    pattern, count = at.pattern, len(at.pattern)
    corners = at.camera.project(true_nodes(at, state, pose, print_mm))
    seen = corners[:, 0] if pattern.lines else (MEASURED @ corners).reshape(count, 6)
    seen = seen + np.einsum("nij,nj->ni", np.linalg.cholesky(np.linalg.inv(at.information)), rng.standard_normal(seen.shape))
    points = GridPoints(
        index=np.arange(count),
        center_px=seen[:, :2],
        half_px=None if pattern.lines else np.swapaxes(seen[:, 2:].reshape(count, 2, 2), 1, 2),
        information=at.information,
        spread_px=np.zeros(count),
        blur_px=np.full(count, PSF_PX),
        contrast=np.full(count, 150.0),
        noise=np.full(count, 150.0 / CONTRAST),
        kept=np.ones(count),
        quality=np.zeros(count, np.int64),
        noise_model=NoiseModel((150.0 / CONTRAST) ** 2, 0.0, 1.0),
        place_sigma_px=0.0,
        rejected=(),
    )
    sheet = estimate_sheet(at.camera, pattern, points.index, measured_of(points), np.linalg.inv(points.information))
    return poses_of(at.camera, pattern, points, sheet, pose)


def trial(at: Bench, family: str, slide: str, rng: Generator) -> Trial:
    """One deformed grid, compared with itself before."""
    state = scaled(FAMILIES[family](rng), 10 ** float(rng.uniform(*POWERS)), slide)
    printed, later = rng.normal(0, PRINT_MM, (len(at.pattern), 2)), shifted(at.pose, rng)
    before, after = measured(at, Deformation(), at.pose, printed, rng), measured(at, state, later, printed, rng)
    found = joint_difference(before, after, at.camera, at.pattern)
    none = np.zeros_like(printed)
    move = at.pose.inverse().apply(true_nodes(at, state, later, none).mean(axis=1)) - at.pose.inverse().apply(
        true_nodes(at, Deformation(), at.pose, none).mean(axis=1)
    )
    shape = shape_of(move, at.pattern.center_mm, at.pattern.normal)
    size, length = own_size(at, state)
    bound = joint_bound(at.camera, at.pattern, at.pose, CONTRAST, PSF_PX, size, length, slide)[0] ** 2 if size > 0 else 0 * shape
    return scored(family, slide, at.name, found, shape, (move * at.pattern.normal).sum(axis=1), bound)


def scored(family: str, slide: str, name: str, found: DifferenceMap, shape: Array, displacement: Array, bound_mm2: Array) -> Trial:
    """Errors of a difference against true shape and displacement (N,)."""
    return Trial(
        family,
        slide,
        name,
        found.shape_mm - shape,
        found.sigma_shape_mm,
        found.displacement_mm - displacement,
        found.sigma_displacement_mm,
        shape,
        bound_mm2,
        found.considered,
        int((found.quality & Quality.OUTLIER > 0).sum()),
        found.noise_factor,
        found.converged,
        found.expansion_assumed[1] > 0,
        found.significance.changed,
    )


def photographed(name: str, pattern: Pattern, camera: Camera, pose: Pose, state: Deformation, seed: int) -> Trial:
    """One pair of photographs through the whole chain."""
    rng = np.random.default_rng([2018, 5, seed])
    later = shifted(pose, rng)
    shots = [
        simulate(Scene(pattern, camera, at, deformation=bend, sensor=Sensor(noise_grey=NOISE_GREY)), rng)
        for at, bend in ((pose, Deformation()), (later, state))
    ]
    maps = [map_photograph(shot.image, camera, pattern, Upright()) for shot in shots]
    found = joint_difference(maps[0].poses, maps[1].poses, camera, pattern)
    before, after = (pose.inverse().apply(shot.truth.center_mm[found.index]) for shot in shots)
    shape = shape_of(after - before, found.nominal_mm, found.normal)
    return scored(name, "least_strain", name, found, shape, ((after - before) * found.normal).sum(axis=1), 0 * shape)


def photographs() -> list[Trial]:
    """Stills of a plate, and three dishes that bent."""
    plate, dish = grid(20, 16, 12.0, line_width_mm=1.0), dish_of_lines()
    near = Camera(2304, 1728, np.full(2, 1500.0), np.array([1151.5, 863.5]), DISTORTION)
    far = Camera(4608, 3456, np.full(2, 3000.0), np.array([2303.5, 1727.5]), DISTORTION)
    bends = {
        "dish, astigmatism of 1 mm": Deformation(zernike=(ZernikeTerm(2, 2, 1.0),)),
        "dish, defocus of 1 mm": Deformation(zernike=(ZernikeTerm(2, 0, 1.0),)),
        "dish, bump of 0.5 mm": Deformation(bumps=(Bump((80.0, 50.0), 50.0, 0.5),)),
    }
    out = [photographed("plate, still", plate, near, facing_pose(800.0, np.radians(10.0)), Deformation(), k) for k in range(STILLS)]
    for name, bend in bends.items():
        out += [photographed(f"{name}, {d:.0f} mm", dish, far, facing_pose(d, np.radians(3.0)), bend, 100) for d in PHOTOGRAPHED_FROM_MM]
    return out


def photograph_row(trials: Sequence[Trial]) -> tuple[object, ...]:
    def together(name: str) -> Array:
        return np.concatenate([getattr(t, name) for t in trials])

    shape, sigma, whole, sigma_whole = (together(n) for n in ("shape_error", "shape_sigma", "error", "sigma"))
    within = [round(100 * float(np.mean(np.abs(e) < Z95 * s)), 1) for e, s in ((shape, sigma), (whole, sigma_whole))]
    return (
        *(len(trials), len(trials[0].error), rms(together("true_shape")), rms(shape), rms(sigma), within[0]),
        *(rms(whole), rms(sigma_whole), within[1], sum(t.changed for t in trials), sum(t.aside for t in trials)),
    )


PHOTOGRAPHED = ("of", "pairs", "targets", "true mm", "shape mm", "sigma", "in 95 %", "total mm", "sigma", "in 95 %", "changed", "put aside")


def tables(title: str, trials: list[Trial], names: Sequence[str]) -> None:
    """Errors and coverage of all, and by the attributes `names` of a trial."""
    print_table(HEADER, [("all", *row_of(trials))], title)
    for name in names:
        groups: dict[str, list[Trial]] = {}
        for t in trials:
            groups.setdefault(getattr(t, name), []).append(t)
        print_table(HEADER, [(key, *row_of(group)) for key, group in groups.items()], f"{title}, by {name}")


def main() -> None:
    def drawn(slide: str, count: int, every: Sequence[Bench], family: str) -> list[Trial]:
        number = [*FAMILIES].index(family), int(slide == "normal")
        return [
            trial(at, family, slide, np.random.default_rng([2018, *number, k, seed])) for k, at in enumerate(every) for seed in range(count)
        ]

    dishes = benches()[:3]
    trials = [t for family in FAMILIES for t in drawn("least_strain", TRIALS, benches(), family)]
    sizes = ", ".join(f"{b.name} {len(b.pattern)}" for b in benches())
    print(f"targets: {sizes}; asked: coverage 92 to 98 %, efficiency over 0.7")
    tables("Grids that slide as a membrane", trials, ("family", "camera"))
    moved = [f for f in FAMILIES if f != "none"]
    stay = [t for family in moved for t in drawn("normal", OTHER_SLIDE_TRIALS, dishes, family)]
    if stay:
        tables("Dishes whose points stay on their normals", stay, ("camera",))
    groups: dict[str, list[Trial]] = {}
    for t in photographs():
        groups.setdefault(t.family, []).append(t)
    print_table(PHOTOGRAPHED, [(name, *photograph_row(group)) for name, group in groups.items()], "Photographs, the whole chain")


if __name__ == "__main__":
    main()
