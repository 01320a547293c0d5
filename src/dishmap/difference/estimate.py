"""From target changes to what the surface did: hypotheses weighed, outliers put aside, sizes learnt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.camera.model import Camera
from dishmap.difference.changes import LEAST_TARGETS, TargetChanges, move_of_pixels
from dishmap.difference.joint import RANGES, Evidence, Posterior, Sizes, determined, learn_sizes, misfit, penalty, posterior
from dishmap.difference.model import BLOCKS, WAYS, Columns, Kernel, Surfaces, columns_of, curved_change, smooth_kernel, surfaces_of
from dishmap.difference.priors import Priors
from dishmap.errors import InputError, MeasurementError
from dishmap.targets.pattern import Pattern
from dishmap.transforms import Pose

Array = NDArray[Any]
Bool = NDArray[Any]

# Correlation lengths of the normal displacement that are weighed, in radii of the surface.
LENGTHS = (0.3, 0.6, 1.2)
# Hypotheses whose evidence is lower than the best one's by this many nats do not count.
LEAST_LOG_WEIGHT = 7.0
# Strain with which the size of prints says nothing.
FREE_STRAIN = 0.05
# A change of scale of the whole picture beyond this may as well be an expansion, when nothing is said of it.
NOTED_SCALE = 1e-3
# Passes of learning and of taking curvature into account.
PASSES = 3
# Screening: sizes wide enough for any surface, and how much worse than most targets (this quantile) one may fit, in chi-square; first
# coarsely, then under the best hypothesis. Six degrees of freedom have chi-square 7.8 at that quantile, 39 once in a million.
SCREEN = Sizes(normal_mm=1.0, slide_strain=1e-3, rough_mm=1.0, print_strain=1e-3)
# Directions of a target of which no more than its place in the photograph is seen: the crossing of two lines.
PLACE_ONLY = 2
SCREEN_ROUNDS, SCREEN_STEP, SCREEN_RATIO, FIT_RATIO = 20, 4.0, 30.0, 5.0
LIKE_MOST, USUAL_MISFIT = 0.75, 7.8
# The search for the size of the displacement starts at what the screening saw, within these.
START_MM = (0.005, 2.0)
# When more targets than this share would have to go, it is the surface that is strange, not they.
LEAST_KEPT = 0.7
OUTLIER_ROUNDS = 5
# A way that will fall this far short of the best is not followed to its end.
HOPELESS_NATS = 200.0
# Residuals count as larger than claimed from this many standard deviations of their mean square; with this many degrees of freedom or more.
NOTED_MISFIT, LEAST_FREEDOM, SETTLED_SCALE = 4.0, 12.0, 0.05
# Sizes tried beside the learnt ones, as factors.
SPREAD: tuple[dict[str, float], ...] = ({"normal_mm": 2.5}, {"rough_mm": 5.0}, {"rough_mm": 20.0}, {"normal_mm": 2.5, "rough_mm": 5.0})
# How points are screened to follow: at first in any smooth way; then, when targets fit worse than claimed by this factor in variance, with
# the least strain. The second estimate is taken when its targets fit better by that factor.
SCREEN_WAY, STRICT_WAY, STRANGE_NOISE, BETTER_NOISE = "any", "least_strain", 2.0, 1.5
# Slide beyond what a way says, as a mean strain: more than this is another way of moving.
LARGEST_SLIDE = 5e-6
# A surface that is rougher than this from target to target, or prints that stretch more on their own, are outliers in disguise.
LARGEST = {"rough_mm": 0.1, "print_strain": 3e-4}
# How far the surface may have moved when its slides say nothing of it.
FREE_NORMAL_MM = 1.0


@dataclass(frozen=True)
class Hypothesis:
    """One way in which the surface may have moved, fitted: slides, correlation length, columns, posterior, curvature and log weight."""

    way: str
    length_mm: float
    columns: Columns
    posterior: Posterior
    log_weight: float
    converged: bool


@dataclass(frozen=True)
class JointEstimate:
    """Hypotheses that count, with weights (H,) that sum to one, and what was found on the way.

    kept (N,): 1 for targets that were used, 0 for outliers; loose (N,): targets that moved on their own; misfit (N,): chi-square of each
    target under the best hypothesis; noise_factor: variance of the residuals over the claimed one, by which covariances were enlarged (at
    least 1); expansion: mean and sigma assumed, per unit; learnt: names of the sizes that were learnt; parts_named: rigid parts define
    the rigid motion.
    """

    hypotheses: tuple[Hypothesis, ...]
    weights: Array
    kept: Array
    loose: Array
    misfit: Array
    noise_factor: float
    expansion: tuple[float, float]
    learnt: tuple[str, ...]
    parts_named: bool
    surfaces: Surfaces


def joint_estimate(
    changes: TargetChanges,
    pattern: Pattern,
    camera: Camera,
    camera_from_dish: Pose,
    priors: Priors,
    progress: Callable[[int, int], None] | None = None,
) -> JointEstimate:
    """Weigh all ways in which the surface may have moved. camera_from_dish is that of the reference.

    Outliers that pass the first screening bend every way until targets fit badly all over. When they do, the screening is made again by the
    least strain alone, and that estimate is taken if its targets fit better.
    """
    tell = progress or (lambda done, total: None)
    first = _Problem(changes, pattern, camera, camera_from_dish, priors).solve(tell)
    if first.noise_factor < STRANGE_NOISE or priors.still or priors.slide not in (None, STRICT_WAY):
        return first
    second = _Problem(changes, pattern, camera, camera_from_dish, priors).solve(tell, STRICT_WAY)
    return second if second.noise_factor < first.noise_factor / BETTER_NOISE and second.kept.mean() >= LEAST_KEPT else first


class _Problem:
    """The parts of one estimate that its steps share."""

    def __init__(self, changes: TargetChanges, pattern: Pattern, camera: Camera, camera_from_dish: Pose, priors: Priors) -> None:
        self.changes, self.pattern, self.camera, self.priors = changes, pattern, camera, priors
        self.camera_from_dish = camera_from_dish
        self.to_camera = (changes.moved @ camera_from_dish).rotation
        self.xy = pattern.center_mm[changes.index, :2]
        self.surfaces = surfaces_of(pattern, changes.index)
        near = cKDTree(self.xy).query(self.xy, k=2)[0][:, 1] if len(self.xy) > 1 else np.array([1.0])
        self.rough_length_mm = 0.5 * float(np.median(near))
        self.expansion = _expansion(changes, camera_from_dish, pattern, priors)
        self.start, self.learnt = _start_sizes(priors, self.expansion[1])
        self.kept = np.ones(len(changes))
        self.loose = np.zeros(len(changes), bool)
        self.scale = 1.0
        self.place_only = np.flatnonzero(changes.directions <= PLACE_ONLY)
        self.hub = self._hub()
        # one for each length, the same for all ways
        self.kernels: dict[float, Kernel] = {}

    def columns(self, way: str, length: float) -> Columns:
        """Columns of all unknowns for one way of following and one correlation length."""
        if length not in self.kernels:
            self.kernels[length] = smooth_kernel(self.surfaces, length)
        kernel = self.kernels[length]
        out = columns_of(self.changes, self.pattern, self.camera, self.camera_from_dish, self.surfaces, kernel, way)
        mean = out.mean.copy()
        mean[out.block == BLOCKS.index("expansion")] = self.expansion[0]
        return replace(out, mean=mean)

    def evidence(self, columns: Columns, at: Posterior | None = None, everything: bool = False) -> Evidence:
        """The weighted likelihoods, linearised at a posterior; with `everything`, outliers too."""
        weight = (np.ones(len(self.changes)) if everything else self.kept) / self.scale
        information, score = self.changes.information * weight[:, None, None], self.changes.score * weight[:, None]
        constant = 0.0
        if at is not None:
            curved = curved_change(columns, self.pattern, self.changes.index, self.to_camera, self.changes.by_strain, at.mean)
            curved[:, :3] += self.perspective((columns.move @ at.mean) @ self.to_camera.T)
            shift = np.einsum("nij,nj->ni", information, curved)
            constant = float((curved * (score - 0.5 * shift)).sum())
            score = score - shift
        return Evidence(information, score, constant, columns, self.rough_length_mm, self.hub, self.loose)

    def perspective(self, move: Array) -> Array:
        """What moves (N, 3) in camera axes do in the photograph beyond the linear, as moves, for targets of which only places are seen."""
        out, rows = np.zeros_like(move), self.place_only
        if len(rows):
            at = self.changes.position_mm[rows]
            before, by_point = self.camera.project_with_point_jacobian(at)
            more = self.camera.project(at + move[rows]) - before - np.einsum("nij,nj->ni", by_point, move[rows])
            out[rows] = (move_of_pixels(by_point) @ more[..., None])[..., 0]
        return out

    def _hub(self) -> Array:
        """Places in `changes` of the targets on rigid parts."""
        if not self.priors.rigid_ids:
            return np.zeros(0, np.int64)
        unknown = sorted(set(self.priors.rigid_ids) - set(self.pattern.ids.tolist()))
        if unknown:
            raise InputError(f"target {unknown[0]} is named as part of a rigid part, but the pattern has no such target")
        hub = np.flatnonzero(np.isin(self.changes.ids, self.priors.rigid_ids))
        if len(hub) < LEAST_TARGETS:
            raise MeasurementError(
                f"only {len(hub)} targets on rigid parts were measured in both photographs; at least {LEAST_TARGETS} are needed"
            )
        return hub

    def screen(self, way: str) -> None:
        """Put aside targets that no surface could have carried along in this way, before anything is learnt.

        An outlier drags its neighbours along at first, so the limit is lowered step by step from the worst misfit to the final one,
        and every target is judged anew at each (Blake and Zisserman 1987, graduated non-convexity).
        """
        # a surface that is stiff in how it slides and in how it bends is no cover for outliers
        slide, length = (SCREEN.slide_strain, LENGTHS[0]) if way == SCREEN_WAY else (LARGEST_SLIDE, LENGTHS[1])
        columns = self.columns(way, length * self.surfaces.fields.radius_mm)
        wide = replace(SCREEN, slide_strain=slide, expansion=self.expansion[1], focal=self.priors.focal_drift)
        found, limit, floor = posterior(self.evidence(columns), wide), np.inf, SCREEN_RATIO * USUAL_MISFIT
        for _ in range(SCREEN_ROUNDS):
            values = misfit(self.evidence(columns, found, everything=True), found)
            # outliers spoil the fit to all, so what most targets show is no guide before they are gone
            limit = max(min(limit, float(values.max())) / SCREEN_STEP, floor)
            kept = np.where(values < limit, 1.0, 0.0)
            if kept.mean() < LEAST_KEPT or (limit == floor and np.array_equal(kept, self.kept)):
                break
            self.kept = kept
            found = posterior(self.evidence(columns, found), wide)
        if "normal_mm" in self.learnt:
            own = columns.block == BLOCKS.index("normal")
            rise = np.einsum("ni,nik,k->n", self.pattern.normal[self.changes.index], columns.move[..., own], found.mean[own], optimize=True)
            self.start = replace(self.start, normal_mm=float(np.clip(rise.std(), *START_MM)))

    def put_aside(self, best: Hypothesis) -> bool:
        """Judge every target by the best hypothesis; True when that changed the judgement of any.

        A target that fits once it may rise and lean on its own is kept as loose: a bump of its own, or a label that came off. One that
        does not fit even so (it moved within the surface, as no surface carries it) is an outlier.
        """
        evidence = replace(self.evidence(best.columns, best.posterior, everything=True), loose=np.zeros(len(self.changes), bool))
        bound = misfit(evidence, best.posterior)
        free = misfit(replace(evidence, loose=np.ones(len(self.changes), bool)), best.posterior)
        limit = FIT_RATIO * _like_most(bound)
        kept, loose = np.where(free < limit, 1.0, 0.0), (bound >= limit) & (free < limit)
        changed = not (np.array_equal(kept, self.kept) and np.array_equal(loose, self.loose))
        self.kept, self.loose = kept, loose
        return changed

    def fit(self, way: str, length: float, start: Sizes | None = None, beat: float = -np.inf) -> Hypothesis:
        """Fit one way of moving; given up when it will fall far short of a log evidence `beat`."""
        columns, sizes = self.columns(way, length), start or self.start
        names = list(self.learnt)
        if way == "any":
            # what cannot be told from slides is not smoothed away
            names = [n for n in names if n != "normal_mm"]
            sizes = replace(sizes, normal_mm=max(sizes.normal_mm, FREE_NORMAL_MM))
        bounds = LARGEST if way == "any" else {**LARGEST, "slide_strain": LARGEST_SLIDE}
        found = learn_sizes(lambda at: self.evidence(columns, at), sizes, names, bounds, beat - HOPELESS_NATS)
        return Hypothesis(way, length, columns, found.posterior, found.log_weight, found.converged)

    def solve(self, tell: Callable[[int, int], None], screened_by: str = SCREEN_WAY) -> JointEstimate:
        """Fit all ways that are left open, first at the middle length, and weigh them."""
        self.screen(screened_by)
        ways, lengths = self._ways(), self._lengths()
        middle = lengths[len(lengths) // 2]
        total = len(ways) + len(lengths)
        every: list[Hypothesis] = []
        for way in ways:
            every.append(self.fit(way, middle, beat=max((h.log_weight for h in every), default=-np.inf)))
            tell(len(every), total)
        every = self._without_outliers(_finite(every), middle)
        best = max(h.log_weight for h in every)
        for length in lengths:
            near = [h for h in every if h.length_mm == middle and h.way != "any" and h.log_weight > best - 3 * LEAST_LOG_WEIGHT]
            every += [self.fit(h.way, length, h.posterior.sizes) for h in near if length != middle]
            tell(len(ways) + lengths.index(length) + 1, total)
        every = _finite(every)
        top = max(h.log_weight for h in every)
        every = self._spread([h for h in every if h.log_weight > top - LEAST_LOG_WEIGHT])
        top = max(h.log_weight for h in every)
        every = [h for h in every if h.log_weight > top - LEAST_LOG_WEIGHT]
        weights = np.exp([h.log_weight - top for h in every])
        one = max(every, key=lambda h: h.log_weight)
        return JointEstimate(
            hypotheses=tuple(every),
            weights=weights / weights.sum(),
            kept=self.kept,
            loose=self.loose,
            misfit=misfit(self.evidence(one.columns, one.posterior, everything=True), one.posterior),
            noise_factor=self.scale,
            expansion=self.expansion,
            learnt=self.learnt,
            parts_named=bool(self.priors.rigid_ids),
            surfaces=self.surfaces,
        )

    def _spread(self, every: list[Hypothesis]) -> list[Hypothesis]:
        """The hypotheses, and the same with larger sizes: a size learnt from little is not known, and too small a one is overconfident."""
        out = list(every)
        for h in every:
            for changes in SPREAD:
                known = {
                    name: factor for name, factor in changes.items() if name in self.learnt and not (h.way == "any" and name == "normal_mm")
                }
                if len(known) < len(changes):
                    continue
                sizes = replace(h.posterior.sizes, **{n: getattr(h.posterior.sizes, n) * f for n, f in known.items()})
                found = posterior(self.evidence(h.columns, h.posterior), sizes)
                out.append(replace(h, posterior=found, log_weight=found.log_evidence - penalty(sizes, self.learnt)))
        return out

    def _without_outliers(self, every: list[Hypothesis], length: float) -> list[Hypothesis]:
        """Put targets aside that do not fit the best hypothesis, and enlarge the noise where the rest do not fit as claimed."""
        for _ in range(OUTLIER_ROUNDS):
            best = max(every, key=lambda h: h.log_weight)
            # the noise is judged once the outliers are gone
            if not (self.put_aside(best) or self.enlarge(best)):
                break
            every = _finite([self.fit(h.way, length, h.posterior.sizes) for h in every])
        return every

    def enlarge(self, best: Hypothesis) -> bool:
        """Scale the noise to the residuals where they are larger than claimed; True when that changed anything."""
        evidence = self.evidence(best.columns, best.posterior)
        freedom = float(self.changes.directions @ self.kept) - determined(evidence, best.posterior)
        if freedom < LEAST_FREEDOM:
            return False
        factor = float((misfit(evidence, best.posterior) * self.kept).sum()) / freedom
        scale = self.scale * factor
        if scale < 1 + NOTED_MISFIT * np.sqrt(2 / freedom):
            scale = 1.0
        changed = abs(scale / self.scale - 1) > SETTLED_SCALE
        self.scale = scale if changed else self.scale
        return changed

    def _lengths(self) -> list[float]:
        radius = self.surfaces.fields.radius_mm
        if self.priors.still:
            return [radius]
        return [self.priors.length_mm] if self.priors.length_mm is not None else [r * radius for r in LENGTHS]

    def _ways(self) -> tuple[str, ...]:
        if self.priors.still:
            return ("normal",)
        if self.priors.slide is not None:
            return (self.priors.slide,)
        if self.priors.strain == "free" or self.changes.directions.max() <= PLACE_ONLY:
            # where prints do not show their own size, nothing tells how points slide: they do what a membrane does
            return ("least_strain",)
        # on a plane the slide does not depend on the displacement along the normal
        return tuple(WAYS) if self.pattern.surface.kind == "paraboloid" else ("normal", "any")


def _finite(hypotheses: list[Hypothesis]) -> list[Hypothesis]:
    """Those with a finite evidence, or all when none has."""
    good = [h for h in hypotheses if np.isfinite(h.log_weight)]
    return good or hypotheses


def _like_most(values: Array) -> float:
    """Misfit that most targets do not exceed."""
    return max(float(np.quantile(values, LIKE_MOST)), USUAL_MISFIT)


def _start_sizes(priors: Priors, expansion: float) -> tuple[Sizes, tuple[str, ...]]:
    values = {name: RANGES[name][0] for name in RANGES}
    learnt = set(RANGES)

    def fixed(name: str, value: float) -> None:
        values[name] = value
        learnt.discard(name)

    if priors.still:
        for name in ("normal_mm", "slide_strain", "rough_mm"):
            fixed(name, 0.0)
    if priors.amplitude_mm is not None:
        fixed("normal_mm", priors.amplitude_mm)
    if priors.strain == "rigid":
        fixed("slide_strain", 0.0)
        fixed("print_strain", 0.0)
    elif priors.strain == "free":
        fixed("print_strain", FREE_STRAIN)
    elif priors.strain is not None:
        fixed("slide_strain", float(priors.strain))
        fixed("print_strain", float(priors.strain))
    if priors.still and priors.strain is None:
        fixed("print_strain", 0.0)
    return Sizes(**values, expansion=expansion, focal=priors.focal_drift), tuple(n for n in RANGES if n in learnt)


def _expansion(changes: TargetChanges, camera_from_dish: Pose, pattern: Pattern, priors: Priors) -> tuple[float, float]:
    """Mean and sigma of the expansion, per unit: as given, or what the change of scale of the whole picture leaves open."""
    if priors.expansion_ppm is not None:
        return priors.expansion_ppm[0] * 1e-6, priors.expansion_ppm[1] * 1e-6
    if priors.still:
        # a rigid body does not grow
        return 0.0, 0.0
    before = camera_from_dish.apply(pattern.center_mm[changes.index])
    after = changes.moved.apply(before)
    scale = float(np.mean(np.linalg.norm(after, axis=1) / np.linalg.norm(before, axis=1))) - 1
    return 0.0, abs(scale) if abs(scale) > NOTED_SCALE else 0.0
