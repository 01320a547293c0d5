"""Changes of grids from places in photographs, without pixels: several frames of a still plate average as their noise does."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.difference.changes import TargetChanges, combine_frames, target_changes
from dishmap.targets.grid_builders import grid
from dishmap.targets.grid_points import GridPoints
from dishmap.targets.grid_poses import measured_of, poses_of
from dishmap.targets.grid_sheet import estimate_sheet
from dishmap.targets.pattern import Pattern
from dishmap.targets.pose import TargetPoses
from dishmap.targets.scene_noise import NoiseModel
from dishmap.transforms import Pose, rotation_from_vector

Array = NDArray[np.float64]

CAMERA = Camera(4608, 3456, np.array([3000.0, 3000]), np.array([2303.5, 1727.5]), np.array([-0.1, 0.02, 1e-4, -1e-4, 0]))
AT = Pose(np.diag([1.0, -1, -1]) @ rotation_from_vector(np.array([0.2, 0.1, 0.0])), np.array([10.0, 5.0, 700.0]))
NOISE_PX, PRINT_MM = 0.02, 0.02
LINES, SQUARES = grid(10, 8, 12.0, line_width_mm=1.0), grid(10, 8, 12.0, square_mm=5.0)
# chi-squares of some 450 numbers: 7 % of their expectation, twice that
SAMPLING = 0.15
CORNERS = 2.5 * np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def frame(pattern: Pattern, printed: Array, rng: np.random.Generator) -> TargetPoses:
    """One photograph of a still plate whose targets were printed a little off, the same in all."""
    index = np.arange(len(pattern))
    at = pattern.center_mm + printed
    if pattern.lines:
        center, half = CAMERA.project(AT.apply(at)), None
    else:
        corners = CAMERA.project(AT.apply(at[:, None] + np.pad(CORNERS, ((0, 0), (0, 1)))))
        center = corners.mean(axis=1) + NOISE_PX * rng.normal(size=(len(at), 2))
        half = np.stack([(corners * sign[:, None]).mean(axis=1) for sign in np.sign(CORNERS).T], axis=-1)
        half += NOISE_PX * rng.normal(size=half.shape)
    center = center + (NOISE_PX * rng.normal(size=center.shape) if pattern.lines else 0.0)
    ones, size = np.ones(len(pattern)), 2 if pattern.lines else 6
    information = np.tile(NOISE_PX**-2.0 * np.eye(size), (len(pattern), 1, 1))
    quality = np.zeros(len(pattern), dtype=np.int64)
    points = GridPoints(index, center, half, information, 0 * ones, ones, ones, ones, ones, quality, NoiseModel(1.0, 0.0, 1.0), 0.01, ())
    sheet = estimate_sheet(CAMERA, pattern, index, measured_of(points), np.linalg.inv(information))
    return poses_of(CAMERA, pattern, points, sheet, AT)


def chi_square(changes: TargetChanges) -> float:
    """How far changes are from none, in directions that the photographs show, over how many of them there are."""
    values, vectors = np.linalg.eigh(changes.information)
    seen = values > 1e-6 * values[:, -1:]
    along = np.einsum("nij,ni->nj", vectors, changes.score)
    return float((along**2 / np.where(seen, values, np.inf)).sum() / seen.sum())


@pytest.mark.parametrize("pattern", [LINES, SQUARES], ids=["lines", "squares"])
def test_two_frames_of_a_still_plate_halve_the_variance(pattern: Pattern) -> None:
    one, two, scatter = [], [], {1: 0.0, 2: 0.0}
    for seed in range(3):
        rng = np.random.default_rng(seed)
        printed = PRINT_MM * np.pad(rng.normal(size=(len(pattern), 2)), ((0, 0), (0, 1)))
        frames = [frame(pattern, printed, rng) for _ in range(4)]
        single = target_changes(frames[0], frames[2], CAMERA, pattern)
        double = target_changes(combine_frames(frames[:2]), combine_frames(frames[2:]), CAMERA, pattern)
        one.append(chi_square(single))
        two.append(chi_square(double))
        # across the line of sight, where every target shows its place
        for count, changes in ((1, single), (2, double)):
            scatter[count] += float((np.linalg.pinv(changes.information, rcond=1e-6) @ changes.score[..., None])[:, :2].var())
        assert np.trace(double.information, axis1=1, axis2=2) == pytest.approx(2 * np.trace(single.information, axis1=1, axis2=2), rel=0.06)
    # the alignment takes out six of some 160 or 480 directions
    assert np.mean(one) == pytest.approx(1.0, abs=SAMPLING)
    assert np.mean(two) == pytest.approx(1.0, abs=SAMPLING)
    assert scatter[2] / scatter[1] == pytest.approx(0.5, abs=0.1)


def test_an_averaged_estimate_lies_between_and_is_surer() -> None:
    rng = np.random.default_rng(1)
    frames = [frame(LINES, np.zeros((len(LINES), 3)), rng) for _ in range(2)]
    both = combine_frames(frames)
    for state in frames:
        assert np.linalg.norm(both.position_mm - state.position_mm, axis=1).max() < 0.2
        assert (np.trace(both.covariance[:, :3, :3], axis1=1, axis2=2) < np.trace(state.covariance[:, :3, :3], axis1=1, axis2=2)).all()
    assert (np.linalg.eigvalsh(both.covariance) > 0).all()
    # what the pixels say of the combined estimate is what they say of each, taken there
    expected = np.zeros_like(both.pull)
    for state in frames:
        shift = np.pad(state.position_mm - both.position_mm, ((0, 0), (0, 4)))
        expected += state.pull + np.einsum("nij,nj->ni", state.information, shift)
    assert both.pull == pytest.approx(expected, abs=1e-6 * np.abs(both.information).max())
