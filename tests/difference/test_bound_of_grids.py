"""The bound of a change for grids: against what measured photographs carry, and as it must behave."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.difference.bound import blank_changes, change_information, joint_bound
from dishmap.difference.joint import Evidence, Sizes, misfit, posterior
from dishmap.difference.model import columns_of, smooth_kernel, surfaces_of
from dishmap.errors import MeasurementError
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.targets.grid_bound import grid_information
from dishmap.targets.grid_builders import grid
from dishmap.targets.grid_points import measure_grid
from dishmap.targets.grid_poses import measured_of, poses_of
from dishmap.targets.grid_sheet import estimate_sheet
from dishmap.targets.pattern import Pattern
from dishmap.targets.pose import TargetPoses

Array = NDArray[np.float64]

CAMERA = Camera(640, 480, [900.0, 900.0], [319.5, 239.5], [-0.1, 0.02, 0.0, 0.0, 0.0])
AT = facing_pose(350.0, np.radians(15.0))
LINES, SQUARES = grid(9, 7, 15.0, line_width_mm=1.2), grid(7, 5, 20.0, square_mm=9.0)
NOISE_GREY, PSF_PX = 3.0, 0.8
# The fit learns light and noise from the photograph, widths of lines from all of it.
PART = 0.15


def photographed(pattern: Pattern) -> tuple[TargetPoses, float]:
    """The targets of a simulated photograph, and its contrast over noise in the middle."""
    rng = np.random.default_rng(7)
    shot = simulate(Scene(pattern, CAMERA, AT, sensor=Sensor(noise_grey=NOISE_GREY, psf_sigma_px=PSF_PX)), rng)
    points = measure_grid(shot.image, pattern, np.arange(len(pattern)), shot.truth.center_px)
    sheet = estimate_sheet(CAMERA, pattern, points.index, measured_of(points), np.linalg.inv(points.information))
    return poses_of(CAMERA, pattern, points, sheet, AT), float(np.median(points.contrast)) / NOISE_GREY


@pytest.mark.parametrize(("pattern", "shown"), [(LINES, 2), (SQUARES, 7)], ids=["crossings", "squares"])
def test_information_is_that_of_a_photograph(pattern: Pattern, shown: int) -> None:
    poses, contrast = photographed(pattern)
    assert len(poses) == len(pattern)
    expected = grid_information(CAMERA, pattern, poses.index, AT, contrast, PSF_PX)
    # at the border neighbours are missing that would show where lines and edges point, which the bound takes as known
    assert pattern.lattice is not None
    inner = ((pattern.lattice > 0) & (pattern.lattice < pattern.lattice.max(axis=0))).all(axis=1)
    for k in range(shown):
        ratio = np.median(poses.information[inner, k, k] / expected[inner, k, k])
        assert abs(ratio - 1) < PART, (k, ratio)
    # crossings tell nothing but their place across the line of sight
    assert (np.linalg.matrix_rank(expected, tol=1e-6 * expected.max(), hermitian=True) <= shown).all()
    if shown == 2:
        assert not expected[:, 3:].any()


def test_change_has_twice_the_variance_of_a_place() -> None:
    """Two equal photographs, nothing known beforehand."""
    every = np.arange(len(LINES))
    one = grid_information(CAMERA, LINES, every, AT, 40.0, PSF_PX)
    change = change_information(CAMERA, LINES, every, AT, 40.0, PSF_PX)
    # 1e-5: what keeps matrices regular
    np.testing.assert_allclose(change[:, :2, :2], 0.5 * one[:, :2, :2], rtol=1e-5, atol=1e-5 * one.max())


@pytest.mark.parametrize("pattern", [LINES, SQUARES], ids=["crossings", "squares"])
def test_shape_bound_falls_with_contrast(pattern: Pattern) -> None:
    poor, good = (joint_bound(CAMERA, pattern, AT, contrast, PSF_PX, 0.5, 60.0) for contrast in (20.0, 60.0))
    for weak, strong in zip(poor, good, strict=True):
        assert (strong > 0).all()
        assert (strong < weak).all()
    # a size of 0.5 mm beforehand, and the photograph tells far more
    assert np.median(poor[0]) < 0.1


def test_lone_crossings_are_refused() -> None:
    with pytest.raises(MeasurementError, match="neighbours in two directions"):
        change_information(CAMERA, LINES, np.arange(3), AT, 40.0, PSF_PX)


def test_misfit_of_crossings_seen_from_near() -> None:
    """What a crossing does not show stays regular beside what it shows very well: 1e-4 mm."""
    every = np.arange(len(LINES))
    information = change_information(CAMERA, LINES, every, AT, 40.0, PSF_PX)
    information *= 1e8 / np.diagonal(information, axis1=1, axis2=2).max()
    move = np.random.default_rng(3).normal(0, 1e-3, (len(LINES), 6))
    surfaces = surfaces_of(LINES, every)
    columns = columns_of(
        blank_changes(CAMERA, LINES, every, AT, information), LINES, CAMERA, AT, surfaces, smooth_kernel(surfaces, 60.0), "least_strain"
    )
    score = np.einsum("nij,nj->ni", information, move)
    evidence = Evidence(information, score, 0.0, columns, 7.5, np.zeros(0, np.int64), np.zeros(len(LINES), bool))
    found = posterior(evidence, Sizes(0.0, 0.0, 0.0, 0.0))
    left = move - columns.change @ found.mean
    # the sigma of the prior that keeps the matrix regular is 1e-5 of what is seen
    np.testing.assert_allclose(misfit(evidence, found), np.einsum("ni,nij,nj->n", left, information, left), rtol=1e-4)
