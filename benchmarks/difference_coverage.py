"""Are the sigmas of a difference true, and how near does it come to the bound? Hundreds of deformed dishes without photographs.

    scripts/bench difference_coverage [--quick]

Deformations are drawn from six families and made 0.06 to 1.6 times as large, so that some drown in the noise. Each dish (0.6 m, f/D 0.5,
its centre of curvature 600 mm from the vertex) is measured twice, as photographs of contrast 60 and blur 0.8 px would show it: true poses
of the deformed prints, their stretch included, with the noise of the Fisher information. The simulator (`dishmap.simulate.deform`)
moves the points. The camera shifts by some 0.2 mm and 0.02 degrees in between; prints have normals and ink spread of their own, the
same in both states. Coverage is the share of 95 % intervals that hold the truth; its +- is the standard error over dishes, as the
targets of one dish are not independent. Efficiency: variance of `joint_bound`, for the true amplitude, length and way of following,
over the mean squared error; polynomials are smoother than the bound's random field of the same slopes, so that they exceed 1.
"""

from __future__ import annotations

import os

# one core, whatever the machine has; before numpy is loaded
os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from _common import QUICK, Z95, print_table, rms
from numpy.random import Generator
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.difference.bound import joint_bound
from dishmap.difference.difference_map import Considered, joint_difference
from dishmap.difference.response import pose_response
from dishmap.quality import Quality
from dishmap.simulate.deform import Bump, Crease, Deformation, Gores, ZernikeTerm, deform, displacement_mm
from dishmap.simulate.scene import facing_pose
from dishmap.surface.zernike import zernike_terms
from dishmap.targets.bound import pattern_information
from dishmap.targets.builders import dish
from dishmap.targets.pattern import Pattern, bent_print_mm
from dishmap.targets.pose import TargetPoses
from dishmap.targets.scene_noise import NoiseModel
from dishmap.targets.stages import Assumptions
from dishmap.transforms import Pose, rotation_from_vector

Array = NDArray[Any]

DISHES = 3 if QUICK else 16
CONTRAST, PSF_PX = 60.0, 0.8
NORMAL_SIGMA_RAD = 2e-4
SHIFT_MM, SHIFT_RAD = 0.2, np.radians(0.02)
# Central differences on the surface: far above rounding, far below a target.
STEP_MM = 0.05
# What the project asks for.
GOAL_COVERAGE, GOAL_EFFICIENCY, GOAL_STILL_MM = (92.0, 98.0), 0.7, 0.01
# Coverage outside the goal by less than this many standard errors may be chance.
CHANCE = 2.0
SLIDES = ("least_strain", "normal")
# Deformations are scaled by ten to a power between these; groups by the rms of the true shape, in mm.
POWERS = (-1.2, 0.2)
SIZES = (0.0, 1e-6, 0.01, 0.03, 0.1, np.inf)


@dataclass(frozen=True)
class Bench:
    """A dish in front of a camera: what does not depend on its state."""

    name: str
    camera: Camera
    pattern: Pattern
    pose: Pose
    information: Array

    @property
    def rim_mm(self) -> float:
        """Radius of the rim, or of the outermost ink."""
        return self.pattern.rim_radius_mm


def bench(name: str, camera: Camera, pattern: Pattern, distance_mm: float) -> Bench:
    """A dish that the camera sees tilted by 2 degrees."""
    pose = facing_pose(distance_mm, np.radians(2.0))
    return Bench(name, camera, pattern, pose, pattern_information(camera, pattern, np.arange(len(pattern)), pose, CONTRAST, PSF_PX))


@lru_cache(maxsize=1)
def benches() -> tuple[Bench, ...]:
    """One dish from half the radius of curvature, near the centre of curvature and from far."""
    pattern = dish(600.0, 300.0, spacing_mm=52.0)
    focal = {350.0: 1200.0, 600.0: 2200.0, 1000.0: 3600.0}
    return tuple(
        bench(f"{d:.0f} mm", Camera(3000, 3000, np.full(2, f), np.full(2, 1499.5), np.array([-0.03, 0.004, 0.0, 0.0, 0.0])), pattern, d)
        for d, f in focal.items()
    )


def true_poses(at: Bench, state: Deformation, pose: Pose) -> tuple[Array, Array, Array]:
    """Positions (N, 3), rotations (N, 3, 3) in the camera frame, and stretch of the prints (N, 3: xx, yy, xy)."""
    pattern = at.pattern
    steps = STEP_MM * np.array([[0.0, 0.0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    local = bent_print_mm(np.broadcast_to(steps, (len(pattern), 5, 2)), pattern.curvature_per_mm)
    nominal = pattern.center_mm[:, None] + local @ np.swapaxes(pattern.axes, 1, 2)
    now = pose.apply(deform(state, pattern.surface, nominal, at.rim_mm))
    tangent = np.stack([now[:, 1] - now[:, 2], now[:, 3] - now[:, 4]], axis=-1) / (2 * STEP_MM)
    u, stretch, vt = np.linalg.svd(tangent, full_matrices=False)
    flat = u @ vt
    strain = np.swapaxes(vt, 1, 2) @ ((stretch - 1)[:, :, None] * vt)
    rotation = np.concatenate([flat, np.cross(flat[..., 0], flat[..., 1])[..., None]], axis=-1)
    return now[:, 0], rotation, np.stack([strain[:, 0, 0], strain[:, 1, 1], strain[:, 0, 1]], axis=-1)


@dataclass(frozen=True)
class Print:
    """What is the same in all states: turns (N, 3) of prints against the nominal surface, ink spread (N,) in mm; precision (N, 7)."""

    turn: Array
    ink_mm: Array
    prior: Array


def printed(at: Bench, rng: Generator) -> Print:
    """A dish printed as the priors of the measurement say."""
    n = len(at.pattern)
    largest = np.array([at.pattern.kind_of(i).radius_mm.max() for i in range(n)])
    ink = Assumptions().ink_spread_fraction * largest
    prior = np.zeros((n, 7))
    prior[:, 3:5], prior[:, 6] = NORMAL_SIGMA_RAD**-2, ink**-2
    turn = np.concatenate([rng.normal(0, NORMAL_SIGMA_RAD, (n, 2)), np.zeros((n, 1))], axis=1)
    return Print(turn, rng.normal(0, ink), prior)


def measured(at: Bench, ink: Print, state: Deformation, pose: Pose, rng: Generator) -> TargetPoses:
    """What a photograph of this state would give."""
    n, lam = len(at.pattern), at.information
    position, rotation, strain = true_poses(at, state, pose)
    _, by_strain = pose_response(at.camera, at.pattern, np.arange(n), pose)
    # of the truth (own turn, ink) from the surface's nominal normal and no ink spread, to which the priors hold
    own = np.concatenate([np.zeros((n, 3)), ink.turn, ink.ink_mm[:, None]], axis=1)
    own[:, :6] += np.einsum("nij,nj->ni", by_strain, strain)
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(lam), rng.standard_normal((n, 7)))
    posterior = lam + ink.prior[:, :, None] * np.eye(7)
    found = np.linalg.solve(posterior, (np.einsum("nij,nj->ni", lam, own) + noise)[..., None])[..., 0]
    covariance = np.linalg.inv(posterior)[:, :6, :6]
    at_mm = position + found[:, :3]
    center, by_point = at.camera.project_with_point_jacobian(at_mm)
    rotation = rotation @ rotation_from_vector(found[:, 3:6])
    return TargetPoses(
        index=np.arange(n),
        ids=at.pattern.ids,
        position_mm=at_mm,
        normal=rotation[..., 2],
        rotation=rotation,
        covariance=covariance,
        information=lam,
        pull=ink.prior * found,
        prior=ink.prior,
        center_px=center,
        covariance_px2=by_point @ covariance[:, :3, :3] @ np.swapaxes(by_point, 1, 2),
        sigma_normal_rad=np.sqrt(covariance[:, 3, 3] + covariance[:, 4, 4]),
        calibration_jacobian=np.zeros((n, 3, len(at.camera.parameters))),
        blur_px=np.full(n, PSF_PX),
        offset_mm=found[:, 6],
        contrast=np.full(n, 150.0),
        noise=np.full(n, 150.0 / CONTRAST),
        kept=np.ones(n),
        quality=np.zeros(n, np.int64),
        camera_from_dish=pose,
        normal_sigma_rad=NORMAL_SIGMA_RAD,
        noise_model=NoiseModel((150.0 / CONTRAST) ** 2, 0.0, 1.0),
        log_gamma=0.0,
        rejected=(),
    )


def shifted(pose: Pose, rng: Generator) -> Pose:
    """The pose after the camera's mount has given way a little."""
    return Pose.from_rotation_vector(rng.normal(0, SHIFT_RAD, 3), rng.normal(0, SHIFT_MM, 3)) @ pose


def shape_of(move_mm: Array, points_mm: Array, normal: Array) -> Array:
    """Displacements (N, 3) of points (N, 3) along normals, their best rigid motion (Kabsch) taken out."""
    now = points_mm + move_mm
    a, b = points_mm.mean(axis=0), now.mean(axis=0)
    u, _, vt = np.linalg.svd((points_mm - a).T @ (now - b))
    turn = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    return np.asarray((((now - b) @ turn + a - points_mm) * normal).sum(axis=1))


def bumps(rng: Generator) -> Deformation:
    def one() -> Bump:
        x, y = rng.uniform(-180, 180, 2)
        return Bump((float(x), float(y)), float(rng.uniform(40, 120)), float(rng.normal(0, 0.5)))

    return Deformation(bumps=tuple(one() for _ in range(rng.integers(1, 4))))


def crease(rng: Generator) -> Deformation:
    x, y = (float(v) for v in rng.uniform(-150, 150, 2))
    return Deformation(creases=(Crease((x, y), float(rng.uniform(0, np.pi)), float(rng.uniform(30, 60)), float(rng.normal(0, 0.3))),))


def gores(rng: Generator) -> Deformation:
    return Deformation(gores=(Gores(int(rng.integers(4, 10)), float(rng.normal(0, 0.5))),))


def saddle(rng: Generator) -> Deformation:
    return Deformation(zernike=(ZernikeTerm(2, 2, float(rng.normal(0, 1.0))), ZernikeTerm(2, -2, float(rng.normal(0, 0.5)))))


def zernike(rng: Generator) -> Deformation:
    terms = [t for t in zernike_terms(5) if t[0] > 1]
    return Deformation(zernike=tuple(ZernikeTerm(*terms[k], float(rng.normal(0, 0.3))) for k in rng.choice(len(terms), 3, replace=False)))


def nothing(rng: Generator) -> Deformation:
    del rng
    return Deformation()


FAMILIES: dict[str, Callable[[Generator], Deformation]] = {
    "none": nothing,
    "zernike": zernike,
    "saddle": saddle,
    "bumps": bumps,
    "crease": crease,
    "gores": gores,
}


def scaled(state: Deformation, factor: float, slide: str) -> Deformation:
    """The same deformation, `factor` times as large."""
    return Deformation(
        zernike=tuple(replace(z, size_mm=factor * z.size_mm) for z in state.zernike),
        bumps=tuple(replace(b, height_mm=factor * b.height_mm) for b in state.bumps),
        creases=tuple(replace(c, height_mm=factor * c.height_mm) for c in state.creases),
        gores=tuple(replace(g, depth_mm=factor * g.depth_mm) for g in state.gores),
        slide=slide,
    )


@dataclass(frozen=True)
class Trial:
    """One dish: what was drawn, errors and sigmas (N,) of shape and displacement, true shape, the bound's variance, what was thought.

    considered: the hypotheses; aside: number of targets put aside; open_expansion: a change of scale was taken for a possible expansion.
    """

    family: str
    slide: str
    camera: str
    shape_error: Array
    shape_sigma: Array
    error: Array
    sigma: Array
    true_shape: Array
    bound_mm2: Array
    considered: tuple[Considered, ...]
    aside: int
    noise_factor: float
    converged: bool
    open_expansion: bool
    changed: bool

    @property
    def size(self) -> str:
        """Group by the rms of the true shape."""
        group = int(np.searchsorted(SIZES, rms(self.true_shape), side="right"))
        return f"{SIZES[group - 1]:g} to {SIZES[group]:g} mm"


def trial(at: Bench, family: str, slide: str, rng: Generator) -> Trial:
    state = scaled(FAMILIES[family](rng), 10 ** float(rng.uniform(*POWERS)), slide)
    ink, later = printed(at, rng), shifted(at.pose, rng)
    found = joint_difference(measured(at, ink, Deformation(), at.pose, rng), measured(at, ink, state, later, rng), at.camera, at.pattern)
    points, normal = at.pattern.center_mm, at.pattern.normal
    move = at.pose.inverse().apply(true_poses(at, state, later)[0]) - points
    shape = shape_of(move, points, normal)
    size, length = own_size(at, state)
    bound = joint_bound(at.camera, at.pattern, at.pose, CONTRAST, PSF_PX, size, length, slide)[0] ** 2 if size > 0 else 0 * shape
    return Trial(
        family,
        slide,
        at.name,
        found.shape_mm - shape,
        found.sigma_shape_mm,
        found.displacement_mm - (move * normal).sum(axis=1),
        found.sigma_displacement_mm,
        shape,
        bound,
        found.considered,
        int((found.quality & Quality.OUTLIER > 0).sum()),
        found.noise_factor,
        found.converged,
        found.expansion_assumed[1] > 0,
        found.significance.changed,
    )


def own_size(at: Bench, state: Deformation) -> tuple[float, float]:
    """Standard deviation and length in mm of the displacement along the normal, piston and tilt taken out.

    A Matern 5/2 field of standard deviation s and length l has slopes of variance 5 s^2 / (3 l^2) along each axis.
    """
    xy = at.pattern.center_mm[:, :2]
    steps = STEP_MM * np.eye(2)
    rise = displacement_mm(state, xy, at.rim_mm)
    slope = [(displacement_mm(state, xy + s, at.rim_mm) - displacement_mm(state, xy - s, at.rim_mm)) / (2 * STEP_MM) for s in steps]
    flat = np.column_stack([np.ones(len(xy)), xy])
    fitted = np.linalg.lstsq(flat, rise, rcond=None)[0]
    size = rms(rise - flat @ fitted)
    if size < 1e-9:
        return 0.0, 1.0
    steep = np.sqrt(0.5 * sum(rms(s - g) ** 2 for s, g in zip(slope, fitted[1:], strict=True)))
    return size, float(np.sqrt(5 / 3) * size / steep)


def coverage(scores: Sequence[Array]) -> tuple[float, float]:
    """Percentage of scores within 95 % intervals over dishes (D, N), and its standard error."""
    each = np.array([100 * np.mean(np.abs(s) < Z95) for s in scores])
    return float(each.mean()), float(each.std(ddof=1) / np.sqrt(len(each))) if len(each) > 1 else np.nan


def row_of(trials: Sequence[Trial]) -> tuple[object, ...]:
    shape = [t.shape_error / t.shape_sigma for t in trials]
    whole = [t.error / t.sigma for t in trials]
    (in_shape, shape_by), (in_whole, whole_by) = coverage(shape), coverage(whole)
    error = rms(np.concatenate([t.shape_error for t in trials]))
    bound = rms(np.sqrt(np.concatenate([t.bound_mm2 for t in trials])))
    misses = [name for name, value, by in (("shape", in_shape, shape_by), ("displacement", in_whole, whole_by)) if outside(value, by)]
    efficiency = (bound / error) ** 2
    if 0 < efficiency < GOAL_EFFICIENCY:
        misses.append("efficiency")
    if all(t.family == "none" for t in trials) and error > GOAL_STILL_MM:
        misses.append("no change")
    return (
        len(trials),
        rms(np.concatenate([t.true_shape for t in trials])),
        error,
        rms(np.concatenate([t.shape_sigma for t in trials])),
        round(in_shape, 1),
        round(shape_by, 1),
        max(rms(s) for s in shape),
        rms(np.concatenate([t.error for t in trials])),
        rms(np.concatenate([t.sigma for t in trials])),
        round(in_whole, 1),
        round(whole_by, 1),
        *((round(efficiency, 2), round(float(np.median([efficiency_of(t) for t in trials])), 2)) if bound > 0 else ("", "")),
        ", ".join(misses),
    )


def efficiency_of(t: Trial) -> float:
    return float(t.bound_mm2.mean() / (t.shape_error**2).mean())


def outside(value: float, by: float) -> bool:
    """Whether a coverage misses the goal by more than chance."""
    low, high = GOAL_COVERAGE
    return value + CHANCE * np.nan_to_num(by) < low or value - CHANCE * np.nan_to_num(by) > high


def learnt_row(trials: Sequence[Trial]) -> tuple[object, ...]:
    """What the estimate thought: mean weights of the ways, medians of length and sizes under the best hypothesis, targets put aside."""
    weights = {way: np.mean([sum(c.weight for c in t.considered if c.way == way) for t in trials]) for way in WAYS}
    best = [max(t.considered, key=lambda c: c.weight) for t in trials]
    sizes = [float(np.median([b.sizes[name] for b in best])) for name in ("normal_mm", "rough_mm", "slide_strain", "print_strain")]
    aside = sum(t.aside for t in trials)
    changed = 100 * float(np.mean([t.changed for t in trials]))
    noisy = max(t.noise_factor for t in trials)
    unsettled = sum(not t.converged for t in trials)
    grown = sum(t.open_expansion for t in trials)
    ways = (round(w, 2) for w in weights.values())
    moved = [t for t in trials if t.family != "none"]
    true = round(float(np.mean([sum(c.weight for c in t.considered if c.way == t.slide) for t in moved])), 2) if moved else ""
    return (*ways, true, np.median([b.length_mm for b in best]), *sizes, aside, noisy, unsettled, grown, changed)


WAYS = ("least_strain", "normal", "axial", "any")
HEADER = (
    *("of", "dishes", "true mm", "shape mm", "sigma", "in 95 %", "+-", "worst rms z"),
    *("total mm", "sigma", "in 95 %", "+-", "efficiency", "of the median", "missed"),
)
LEARNT = (
    *("of", *WAYS, "true way", "length mm", "size mm", "rough mm", "slide strain", "print strain"),
    *("put aside", "noise factor", "unsettled", "expansion open", "changed %"),
)


def main() -> None:
    trials = []
    for family in FAMILIES:
        for at in benches():
            for slide in SLIDES if family != "none" else SLIDES[:1]:
                number = [*FAMILIES].index(family), [b.name for b in benches()].index(at.name), SLIDES.index(slide)
                trials += [trial(at, family, slide, np.random.default_rng([2018, *number, seed])) for seed in range(DISHES)]
    low, high = GOAL_COVERAGE
    print(f"{len(trials)} dishes of {len(benches()[0].pattern)} targets; asked: coverage {low:.0f} to {high:.0f} %, efficiency over")
    print(f"{GOAL_EFFICIENCY}, no change below {GOAL_STILL_MM} mm; a miss is named where chance is unlikely to be the reason")

    def table(
        header: Sequence[str],
        row: Callable[[Sequence[Trial]], tuple[object, ...]],
        names: Sequence[str],
        title: str,
        among: Sequence[Trial],
    ) -> None:
        groups: dict[str, list[Trial]] = {}
        for t in among:
            groups.setdefault(", ".join(str(getattr(t, name)) for name in names) or "all", []).append(t)
        print_table(header, [(name, *row(group)) for name, group in groups.items()], title)

    by_size = sorted(trials, key=lambda t: rms(t.true_shape))
    for names in ((), ("family",), ("camera",), ("slide",)):
        table(HEADER, row_of, names, f"Errors and coverage by {names[0]}" if names else "All", trials)
    table(HEADER, row_of, ("size",), "Errors and coverage by the rms of the true shape", by_size)
    table(LEARNT, learnt_row, ("size",), "What was learnt: mean weights of the ways, medians under the best hypothesis", by_size)
    each = ("family", "camera", "slide")
    table(HEADER, row_of, each, "Errors and coverage of each group", trials)
    table(LEARNT, learnt_row, each, "What was learnt in each group", trials)


if __name__ == "__main__":
    main()
