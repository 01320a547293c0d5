"""Algorithm 2 of the paper: exact points give what its formulas say, photographs give nearly that, and EPnP fails as documented."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.errors import CameraError, InputError, PatternError
from dishmap.quality import Quality
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.targets.builders import plate
from dishmap.targets.grid_builders import grid
from dishmap.targets.grid_paper import (
    LARGEST_SQUARE_RAD,
    NO_PLACE,
    NO_SQUARE,
    Squares,
    paper_grid_poses,
    poses_from_level_0,
    weighted_points,
)
from dishmap.targets.pattern import Pattern, Surface
from dishmap.targets.plane_pose import epnp_normals, ippe_normals
from dishmap.transforms import Pose, angle_between_rad

Array = NDArray[np.float64]

FOCAL_PX, PITCH_MM, DISTANCE_MM, NOISE_PX = 3000.0, 12.0, 1000.0, 0.035
CAMERA = Camera(900, 780, np.full(2, FOCAL_PX), np.array([449.5, 389.5]))
# Half the diagonal of a square over its distance, squared: what formulas for small squares leave out, of the depth.
UNIT_PART = (PITCH_MM / np.sqrt(2) / DISTANCE_MM) ** 2
# The mean of four corners against the image of the middle: it drifts over the picture with the depth.
EXACT_NORMAL_RAD = 1e-4
# Of even squares four count, half a pitch off the axis in both directions, where the camera sees them from 0.5 degrees aside.
FACING_MM = 2e-3
# The mean over a few hundred squares of a scatter that theory gives to about a tenth.
SCATTER_PART = 0.15


def flat(columns: int = 17, rows: int = 15) -> Pattern:
    return grid(columns, rows, PITCH_MM, line_width_mm=1.0)


def seen(pattern: Pattern, pose: Pose) -> Array:
    return CAMERA.project(pose.apply(pattern.center_mm))


def points_of(pattern: Pattern, level_0_px: Array) -> list[Squares]:
    """P* of the whole pattern."""
    return weighted_points(level_0_px, np.arange(len(pattern)), CAMERA, pattern)


def expected_ratio(normal: Array, sight: Array, side: Array) -> float:
    """Distance by the paper's formula over the true one, of a small square: cos(delta alpha) where sqrt(cos tilt) would be right.

    normal, sight, side: unit vectors. delta alpha is the mean over two pairs of sides, and two diagonals, of 90 degrees less the angle
    between the line and the line of sight.
    """
    other = np.cross(normal, side)
    lines = [side, side, other, other, (side + other) / np.sqrt(2), (side - other) / np.sqrt(2)]
    delta = np.mean([np.arcsin(abs(line @ sight)) for line in lines])
    return float(np.cos(delta) / np.sqrt(abs(normal @ sight)))


@pytest.mark.parametrize(("tilt_deg", "direction_deg"), [(0, 0), (10, 0), (20, 30), (40, 90)])
def test_unit_squares_from_exact_points_lie_where_the_formula_puts_them(tilt_deg: float, direction_deg: float) -> None:
    pattern, pose = flat(), facing_pose(DISTANCE_MM, np.radians(tilt_deg), np.radians(direction_deg))
    unit = points_of(pattern, seen(pattern, pose))[0]
    some = np.isfinite(unit.area)
    assert some.sum() == 15 * 13
    assert angle_between_rad(unit.normal[some], pose.rotation[:, 2]).max() < EXACT_NORMAL_RAD
    true = pose.apply(unit.place_mm[some])
    distance = np.linalg.norm(true, axis=1)
    ratio = np.array([expected_ratio(pose.rotation[:, 2], p / d, pose.rotation[:, 0]) for p, d in zip(true, distance, strict=True)])
    error = np.linalg.norm(unit.point_mm[some], axis=1) / distance - ratio
    assert np.abs(error).max() < UNIT_PART
    if tilt_deg == 40:
        # the formula's own error is no small thing that this tolerance would hide
        assert np.abs(ratio - 1).max() > 100 * UNIT_PART


def test_a_square_that_faces_the_camera_gets_its_depth() -> None:
    pattern, pose = flat(), facing_pose(DISTANCE_MM)
    poses = poses_from_level_0(seen(pattern, pose), np.arange(len(pattern)), CAMERA, pattern)
    middle = np.flatnonzero((pattern.center_mm[poses.index] == 0).all(axis=1))
    assert len(middle) == 1
    assert abs(poses.depth_mm[middle[0]] - DISTANCE_MM) < FACING_MM
    assert poses.view == "target"
    assert poses.method == "paper"
    np.testing.assert_allclose(CAMERA.project(poses.position_mm), poses.center_px, atol=1e-9)


def test_targets_that_level_1_does_not_reach_are_said() -> None:
    pattern, pose = flat(), facing_pose(DISTANCE_MM, 0.1)
    places = seen(pattern, pose)
    assert pattern.lattice is not None
    hole = int(np.flatnonzero((pattern.lattice == [8, 7]).all(axis=1))[0])
    places[hole] = np.nan
    poses = poses_from_level_0(places, np.arange(len(pattern)), CAMERA, pattern)
    reasons = dict(poses.rejected)
    # the outermost ring, the hole and the eight around it, of which each unit square has the hole as a corner
    edge = (pattern.lattice == 0).any(axis=1) | (pattern.lattice == pattern.lattice.max(axis=0)).any(axis=1)
    assert reasons[hole] == NO_PLACE
    lost = {int(i) for i, reason in reasons.items() if reason == NO_SQUARE}
    assert set(np.flatnonzero(edge).tolist()) <= lost
    assert len(poses) + len(reasons) == len(pattern)


def test_squares_reach_up_to_ten_degrees_and_no_farther() -> None:
    pattern = flat()
    found = points_of(pattern, seen(pattern, facing_pose(700.0)))
    # 10 degrees at 700 mm are 122 mm
    assert [s.units for s in found] == list(range(1, 11))
    assert max(float(np.sqrt(np.nanmax(s.area))) for s in found) < LARGEST_SQUARE_RAD


@pytest.mark.parametrize("units", [1, 2, 4])
def test_the_scatter_of_a_square_goes_with_one_over_its_units(units: int) -> None:
    pattern, rng = flat(), np.random.default_rng(units)
    exact = seen(pattern, facing_pose(DISTANCE_MM, np.radians(20.0)))
    true = points_of(pattern, exact)[units - 1]
    errors = []
    for _ in range(12):
        noisy = points_of(pattern, exact + NOISE_PX * rng.normal(size=exact.shape))[units - 1]
        # the area alone: that of the normal comes on top
        errors.append(-0.5 * np.log(noisy.area / true.area)[np.isfinite(true.area)])
    side_px = FOCAL_PX * PITCH_MM / DISTANCE_MM
    # corners of a unit square share one place of level_0, at opposite ends of both diagonals
    shared = np.sqrt(3 / 4) if units == 1 else 1.0
    # foreshortened by the cosine of the tilt, to the middle between both of its sides
    expected = shared * NOISE_PX / (2 * np.sqrt(2) * units * side_px)
    side = np.cos(np.radians(20.0))
    expected *= np.sqrt((1 + side**-2) / 2)
    assert np.std(np.concatenate(errors)) == pytest.approx(expected, rel=SCATTER_PART)


def test_larger_squares_carry_the_weight() -> None:
    pattern, rng = flat(), np.random.default_rng(5)
    pose = facing_pose(DISTANCE_MM, np.radians(20.0))
    exact = seen(pattern, pose)
    noisy = exact + NOISE_PX * rng.normal(size=exact.shape)
    index = np.arange(len(pattern))
    clean, poses = (poses_from_level_0(px, index, CAMERA, pattern) for px in (exact, noisy))
    unit = points_of(pattern, noisy)[0], points_of(pattern, exact)[0]
    scatter_unit = np.nanstd(unit[0].point_mm[..., 2] - unit[1].point_mm[..., 2])
    assert pattern.lattice is not None
    lattice = pattern.lattice[poses.index]
    # at the border only the smallest squares are left
    inner = (np.minimum(lattice, pattern.lattice.max(axis=0) - lattice) >= 5).all(axis=1)
    assert np.std((poses.depth_mm - clean.depth_mm)[inner]) < 0.5 * scatter_unit
    assert [s.weight for s in points_of(pattern, exact)[:3]] == [1.0, 4.0, 9.0]


def test_epnp_fails_on_the_four_corners_of_a_square_and_ippe_does_not() -> None:
    rng = np.random.default_rng(3)
    pattern, pose = flat(), facing_pose(DISTANCE_MM, np.radians(17.5), 0.4)
    exact = seen(pattern, pose)
    noisy = exact + NOISE_PX * rng.normal(size=exact.shape)
    median_deg = {}
    for normals in ("ippe", "epnp"):
        poses = poses_from_level_0(noisy, np.arange(len(pattern)), CAMERA, pattern, normals=normals)  # type: ignore[arg-type]
        median_deg[normals] = float(np.degrees(np.median(angle_between_rad(poses.normal, pose.rotation[:, 2]))))
    assert median_deg["ippe"] < 0.1
    # the tilt's sign is wrong, so that the error is twice the tilt
    assert median_deg["epnp"] == pytest.approx(35.0, abs=1.0)
    assert poses.method == "paper-epnp"


def test_epnp_gives_a_pose_that_is_not_seen_so() -> None:
    corners = 60.0 * np.array([[[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]])
    pose = facing_pose(DISTANCE_MM, np.radians(20.0))
    point = pose.apply(np.concatenate([corners, np.zeros((1, 4, 1))], axis=2))
    image = point[..., :2] / point[..., 2:]
    assert np.degrees(angle_between_rad(epnp_normals(corners, image)[0], pose.rotation[:, 2])) == pytest.approx(40.0, abs=0.1)
    found = ippe_normals(corners, image)
    assert angle_between_rad(found.normal[0], pose.rotation[:, 2]) < 1e-6
    assert found.square[0] < 1e-20 < found.other[0]


def test_a_tilt_that_the_image_does_not_tell_is_flagged() -> None:
    pattern, rng = flat(5, 5), np.random.default_rng(1)
    exact = seen(pattern, facing_pose(DISTANCE_MM, np.radians(6.0)))
    index = np.arange(len(pattern))
    sure = poses_from_level_0(exact, index, CAMERA, pattern)
    unsure = poses_from_level_0(exact + 0.5 * rng.normal(size=exact.shape), index, CAMERA, pattern)
    assert (sure.quality == Quality.CLEAN).all()
    assert (unsure.quality == Quality.AMBIGUOUS_NORMAL).mean() > 0.5


def test_a_place_on_a_dish_gets_back_what_the_mean_of_four_takes() -> None:
    dish = grid(15, 15, PITCH_MM, line_width_mm=1.0, surface=Surface("paraboloid", 300.0, 150.0))
    pose = facing_pose(600.0)
    poses = poses_from_level_0(seen(dish, pose), np.arange(len(dish)), CAMERA, dish)
    true = pose.apply(dish.center_mm[poses.index])
    middle = np.linalg.norm(dish.center_mm[poses.index, :2], axis=1) < 18.0
    assert middle.sum() == 9
    error = poses.depth_mm[middle] - true[middle, 2]
    # squares of up to 8 units: their middles lie up to 7.7 mm above the dish
    assert np.abs(error).max() < 0.3


SCENES = [({"line_width_mm": 1.0}, 0.06), ({"square_mm": 6.0}, 0.04)]


@pytest.mark.parametrize(("ink", "noise_px"), SCENES)
def test_photographs_give_what_exact_points_give(ink: dict[str, float], noise_px: float) -> None:
    pattern = grid(11, 9, PITCH_MM, orientation_marks=True, **ink)  # type: ignore[arg-type]
    camera = Camera(520, 440, np.full(2, FOCAL_PX), np.array([259.5, 219.5]))
    pose, rng = facing_pose(DISTANCE_MM, np.radians(20.0), 0.5), np.random.default_rng(2)
    photograph = simulate(Scene(pattern, camera, pose, sensor=Sensor(psf_sigma_px=0.8, noise_grey=2.0)), rng).image
    true = camera.project(pose.apply(pattern.center_mm))
    index = np.arange(len(pattern))
    exact = poses_from_level_0(true, index, camera, pattern)
    poses = paper_grid_poses(photograph, camera, pattern, index, true + rng.uniform(-0.4, 0.4, true.shape))
    np.testing.assert_array_equal(poses.index, exact.index)
    assert np.sqrt(((poses.center_px - exact.center_px) ** 2).mean()) < noise_px
    # unit squares of this noise err by a third of a millimetre; larger ones, most of what counts, by less
    assert np.sqrt(((poses.depth_mm - exact.depth_mm) ** 2).mean()) < 0.3
    assert np.degrees(np.median(angle_between_rad(poses.normal, exact.normal))) < 0.3


def test_bad_input_is_said() -> None:
    pattern = flat(4, 4)
    image, index, place = np.full((780, 900), 200, np.uint8), np.arange(2), np.full((2, 2), 100.0)
    with pytest.raises(CameraError, match="undistorted"):
        paper_grid_poses(image, Camera(900, 780, [1000.0, 1000.0], [449.5, 389.5], [-0.1, 0, 0, 0, 0]), pattern, index, place)
    with pytest.raises(InputError, match="one place in the image for each"):
        paper_grid_poses(image, CAMERA, pattern, index, place[:1])
    with pytest.raises(InputError, match="ippe, or epnp"):
        paper_grid_poses(image, CAMERA, pattern, index, place, normals="dlt")  # type: ignore[arg-type]
    with pytest.raises(PatternError, match="no grid"):
        paper_grid_poses(image, CAMERA, plate(3, 3, 45.0), index, place)


def test_nothing_in_the_image_is_no_target() -> None:
    pattern = flat(4, 4)
    poses = paper_grid_poses(np.full((780, 900), 200, np.uint8), CAMERA, pattern, np.arange(16), seen(pattern, facing_pose(DISTANCE_MM)))
    assert len(poses) == 0
    assert len(paper_grid_poses(np.full((780, 900), 200, np.uint8), CAMERA, pattern, [], np.zeros((0, 2)))) == 0
