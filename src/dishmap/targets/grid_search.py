"""The nodes of a photograph laid on a grid in one way or another: which targets they are then, and the rigid pose that follows."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.camera.model import Camera
from dishmap.camera.planar import planar_poses
from dishmap.errors import IdentityError
from dishmap.targets.grid_detect import GridDetections
from dishmap.targets.grid_ways import Ways, all_ways, printed_lattice, seen_lattice
from dishmap.targets.identify import DECISIVE, roll_rad
from dishmap.targets.pattern import Pattern
from dishmap.targets.rigid import RigidFit, other_tilt, robust_pose, sights_of
from dishmap.transforms import Pose

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# More nodes than this and this part of them beyond the pattern: it is not the pattern. Marks likewise, against those that agree.
FEW_OFF, LARGEST_OFF_PART = 3, 0.05
# A curved surface rules a way out when its rigid misfit is this many times the best way's, and larger by this part of a step. A misfit of
# that part says that the surface is bent, so that the turn of its rigid pose says little.
WORSE_TIMES, WORSE_STEPS = 3.0, 0.1
MOST_FITTED = 24
# A place belongs to the lattice within so many steps of a node.
NEAR_STEPS = 1.5
# Nodes in the first patch that a pose starts from, in steps about its middle.
PATCH_STEPS = 3
# A further component joins if its nodes lie within this part of a step of where pose and bend of the first put them, whether the bend is
# extrapolated by planes or by polynomials of second degree.
JOIN_STEPS = 0.25


class GridSearch:
    """The nodes of the largest component, the pattern, and what follows from them.

    node (N,): indices into the detections; lattice (N, 2) and place_px (N, 2) theirs; step_px: typical step.
    """

    def __init__(self, found: GridDetections, pattern: Pattern, camera: Camera) -> None:
        assert pattern.lattice is not None
        self.found, self.pattern, self.camera = found, pattern, camera
        self.node = np.flatnonzero(found.component == 0)
        self.lattice, self.place_px = found.lattice[self.node], found.place_px[self.node]
        self.sights = sights_of(camera, self.place_px)
        self.step_px = float(np.median(np.linalg.norm(found.step_px[self.node], axis=1)))
        self.usable = np.isfinite(self.sights.ray).all(axis=1) & np.isfinite(self.sights.px_per_tangent).all(axis=(1, 2))
        low, high = pattern.lattice.min(axis=0), pattern.lattice.max(axis=0)
        self.low = low
        self.table = np.full(high - low + 1, -1)
        self.table[tuple((pattern.lattice - low).T)] = np.arange(len(pattern))

    @cached_property
    def ways(self) -> Ways:
        """All ways, the best of which makes sense. Raises IdentityError if none does."""
        seen, printed = seen_lattice(self.found, 0), printed_lattice(self.pattern)
        ways = all_ways(seen, printed)
        name, size = f"the grid {self.pattern.name!r}", np.ptp(self.lattice, axis=0) + 1
        shown = f"{len(self.node)} nodes of a lattice of {size[0]} x {size[1]}"
        columns, rows = self.table.shape
        if not len(ways) or ways.off.min() > FEW_OFF + LARGEST_OFF_PART * len(self.node):
            raise IdentityError(
                f"the photograph shows {shown}, which do not fit on {name} of {columns} x {rows}; check that it is the printed pattern"
            )
        best = ways.take(np.array([np.argmin(ways.cost)]))
        if best.contradict[0] > FEW_OFF + best.agree[0]:
            behind = all_ways(seen, printed, mirrored=True)
            turned = len(behind) and behind.cost.min() <= FEW_OFF
            why = "they fit when it is mirrored: turn the photograph over" if turned else "check that it is the printed pattern"
            raise IdentityError(f"{best.contradict[0]} orientation marks contradict {name} however its {shown} are laid on it; {why}")
        return ways

    def index(self, ways: Ways, way: int, lattice: Ints | None = None) -> Ints:
        """Index (N,) into the pattern of each node, -1 beyond it."""
        at = ways.lattice(way, self.lattice if lattice is None else lattice).astype(np.int64) - self.low
        inside = ((at >= 0) & (at < self.table.shape)).all(axis=1)
        out = np.full(len(at), -1)
        out[inside] = self.table[tuple(at[inside].T)]
        return out

    def fit(self, ways: Ways, way: int) -> RigidFit | None:
        """The rigid pose of one way."""
        index = self.index(ways, way)
        used = np.flatnonzero((index >= 0) & self.usable)
        if len(used) < 4:
            return None
        target, sights = index[used], self.sights.take(used)
        middle = np.median(self.lattice[used], axis=0)
        patch = np.flatnonzero((np.abs(self.lattice[used] - middle) <= PATCH_STEPS).all(axis=1))
        if len(patch) < 4:
            patch = np.arange(len(used))
        # a curved surface's patch is nearly flat in the axes of the target at its middle
        center = target[patch[np.argmin(np.abs(self.lattice[used][patch] - middle).sum(axis=1))]]
        axes, origin = self.pattern.axes[center], self.pattern.center_mm[center]
        local = (self.pattern.center_mm[target[patch]] - origin) @ axes
        rotation, shift = planar_poses(sights.ray[patch], local, np.zeros(1, dtype=np.int64))
        start = Pose(rotation[0] @ axes.T, shift[0] - rotation[0] @ axes.T @ origin)
        points = self.pattern.center_mm[target]
        starts = (start, other_tilt(start, origin, self.pattern.normal[center]))
        fits = [f for f in (robust_pose(s, points, sights) for s in starts) if f is not None]
        return min(fits, key=lambda f: f.cost, default=None)

    def is_stiff(self, fit: RigidFit) -> bool:
        """Whether a rigid pose explains the nodes, so that its turn says something."""
        return fit.sigma_px < WORSE_STEPS * self.step_px

    def fitting(self, ways: Ways) -> Ways:
        """Ways without those that a curved surface, plainly of its nominal shape, rules out by their misfit."""
        if self.pattern.surface.kind == "plane" or not 1 < len(ways) <= MOST_FITTED:
            return ways
        fits = [self.fit(ways, way) for way in range(len(ways))]
        sigma = np.array([np.inf if f is None else f.sigma_px for f in fits])
        worse = (sigma > WORSE_TIMES * sigma.min()) & (sigma > sigma.min() + WORSE_STEPS * self.step_px)
        return ways.take(np.flatnonzero(~worse))

    def rolls_rad(self, ways: Ways) -> Array:
        """Roll (H,) of each way; those that differ by a shift only have the same to within the surface's curvature."""
        out = np.full(len(ways), np.nan)
        for quarter in np.unique(ways.quarter):
            same = np.flatnonzero(ways.quarter == quarter)
            fit = self.fit(ways, int(same[len(same) // 2]))
            out[same] = np.nan if fit is None else roll_rad(fit.pose)
        return out

    def lattice_at(self, pixels: Array) -> Array:
        """Fractional lattice place (N, 2) of pixels (N, 2), in the walk's frame; NaN away from its nodes."""
        distance, nearest = cKDTree(self.place_px).query(np.where(np.isfinite(pixels), pixels, 1e9))
        step = self.found.step_px[self.node[nearest]]
        away = np.linalg.solve(step, (pixels - self.place_px[nearest])[..., None])[..., 0]
        near = np.isfinite(distance) & (np.abs(away) < NEAR_STEPS).all(axis=1)
        return np.asarray(np.where(near[:, None], self.lattice[nearest] + away, np.nan))

    def joined(self, component: int, pose: Pose, detection: Ints, target: Ints) -> Ints | None:
        """Index (N,) of a further component's nodes, where pose and bend of those named so far put them, or None if that is not clear."""
        assert self.pattern.lattice is not None
        node = np.flatnonzero(self.found.component == component)
        predicted = self.camera.project(pose.apply(self.pattern.center_mm))
        off = self.found.place_px[detection] - predicted[target]
        used = np.isfinite(off).all(axis=1)
        answers = []
        for degree in (1, 2):
            basis = _polynomials(self.pattern.lattice, self.pattern.lattice[target], degree)
            bend = np.linalg.lstsq(basis[target[used]], off[used], rcond=None)[0]
            at = predicted + basis @ bend
            seen = np.flatnonzero(np.isfinite(at).all(axis=1))
            _, nearest = cKDTree(at[seen]).query(self.found.place_px[node])
            index = seen[nearest]
            away = np.linalg.solve(self.found.step_px[node], (self.found.place_px[node] - at[index])[..., None])[..., 0]
            answers.append(np.where(np.abs(away).max(axis=1) < JOIN_STEPS, index, -1))
        if (answers[0] != answers[1]).any() or (answers[0] < 0).mean() > LARGEST_OFF_PART or np.isin(answers[0], target).any():
            return None
        return self._one_way(component, node, answers[0])

    def _one_way(self, component: int, node: Ints, index: Ints) -> Ints | None:
        """The index if one turn and shift of the component's lattice gives it, and its marks do not contradict."""
        assert self.pattern.lattice is not None
        ways = all_ways(seen_lattice(self.found, component), printed_lattice(self.pattern))
        for way in range(len(ways)):
            if ways.contradict[way] < DECISIVE:
                same = self.index(ways, way, self.found.lattice[node])
                if (same == index)[index >= 0].all():
                    return same
        return None


def _polynomials(lattice: Ints, about: Ints, degree: int) -> Array:
    """Monomials (N, M) up to a degree in columns and rows, scaled to those `about`."""
    middle, half = about.mean(axis=0), np.maximum(np.ptp(about, axis=0) / 2, 1)
    x, y = ((lattice - middle) / half).T
    return np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)
