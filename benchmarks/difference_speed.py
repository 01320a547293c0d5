"""Cost of the joint estimate of a difference: processor seconds on one core, by the number of targets.

    scripts/bench difference_speed [--quick]

A bent dish is measured twice without photographs, as in difference_coverage; dish, distance and focal length grow with the number of
targets, so that each target looks the same. `joint_estimate` weighs all hypotheses; `joint_difference` is the whole way from two measured
states to the map with covariances. One run each, after one that loads what is loaded once.
"""

from __future__ import annotations

import os

# one core, whatever the machine has; before numpy is loaded
os.environ.setdefault("OMP_NUM_THREADS", "1")

import resource
import time

import numpy as np
from _common import QUICK, print_table, rms
from difference_coverage import Bench, bench, measured, printed, shape_of, true_poses

from dishmap.camera.model import Camera
from dishmap.difference.changes import target_changes
from dishmap.difference.difference_map import joint_difference
from dishmap.difference.estimate import joint_estimate
from dishmap.difference.priors import Priors
from dishmap.simulate.deform import Bump, Deformation, ZernikeTerm
from dishmap.targets.builders import dish

SPACING_MM = 45.0
COUNTS = (30, 100, 200, 500) if QUICK else (30, 100, 200, 500, 1000, 2000, 5000)
# Asked of this many targets.
GOAL_TARGETS, GOAL_S = 200, 0.3


def large(count: int) -> Bench:
    """A dish with about `count` targets, seen from 1.1 diameters, some 10 px to a ring."""
    # the outermost circle keeps a distance from the rim
    diameter = SPACING_MM * (np.sqrt(4 * count / np.pi) + 1.1)
    focal = 3.0 * diameter
    size = int(4.0 * focal)
    camera = Camera(size, size, np.full(2, focal), np.full(2, (size - 1) / 2))
    return bench(f"{count}", camera, dish(diameter, 0.5 * diameter, spacing_mm=SPACING_MM), 1.1 * diameter)


def main() -> None:
    table = []
    for count in (COUNTS[0], *COUNTS):
        at = large(count)
        rim = at.rim_mm
        state = Deformation(
            zernike=(ZernikeTerm(2, 2, 0.3), ZernikeTerm(3, 1, 0.1)), bumps=(Bump((0.3 * rim, -0.2 * rim), 0.3 * rim, 0.2),)
        )
        rng = np.random.default_rng([2018, count])
        ink = printed(at, rng)
        before, after = measured(at, ink, Deformation(), at.pose, rng), measured(at, ink, state, at.pose, rng)
        changes = target_changes(before, after, at.camera, at.pattern)
        start = time.process_time()
        joint_estimate(changes, at.pattern, at.camera, before.camera_from_dish, Priors())
        middle = time.process_time()
        found = joint_difference(before, after, at.camera, at.pattern)
        end = time.process_time()
        move = at.pose.inverse().apply(true_poses(at, state, at.pose)[0]) - at.pattern.center_mm
        error = found.shape_mm - shape_of(move, at.pattern.center_mm, at.pattern.normal)
        asked = ""
        if count == GOAL_TARGETS:
            asked = f"{'met' if middle - start < GOAL_S else 'MISSED'} (< {GOAL_S:g} s)"
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        table.append((len(found), middle - start, end - middle, round(peak), rms(error), rms(found.sigma_shape_mm), asked))
    header = ("targets", "joint_estimate s", "joint_difference s", "process peak MB", "shape error mm", "sigma", "asked")
    print_table(header, table[1:], "Processor seconds of one core")


if __name__ == "__main__":
    main()
