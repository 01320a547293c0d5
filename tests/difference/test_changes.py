"""From two measured states to likelihoods of change: exact without noise, true covariance with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from difference.states import AT, CAMERA, DISH, state, true_poses
from scipy.optimize import least_squares

from dishmap.difference.changes import TargetChanges, combine_frames, rigid_alignment, target_changes
from dishmap.difference.response import pose_response
from dishmap.errors import MeasurementError
from dishmap.simulate.deform import Deformation, ZernikeTerm
from dishmap.targets.edges import Poses, project_printed
from dishmap.targets.pattern import bent_print_mm
from dishmap.targets.pose import TargetPoses, select_targets
from dishmap.targets.sensitivity import edge_normals, outline_samples
from dishmap.transforms import Pose, rotation_from_vector

# Rounding of poses of a metre, after solving for changes that one direction hardly shows.
EXACT_MM, EXACT_RAD = 1e-6, 1e-8


def found_changes(changes: TargetChanges) -> np.ndarray:
    return np.linalg.solve(changes.information + 1e-12 * np.eye(6), changes.score[..., None])[..., 0]


def test_a_rigid_motion_leaves_no_change() -> None:
    moved = Pose.from_rotation_vector([0.01, -0.02, 0.03], [3.0, -2.0, 5.0]) @ AT
    changes = target_changes(state(), state(camera_from_dish=moved), CAMERA, DISH)
    assert np.abs(found_changes(changes)[:, :3]).max() < EXACT_MM
    assert np.abs(found_changes(changes)[:, 3:]).max() < EXACT_RAD
    assert (changes.moved @ AT).apply(DISH.center_mm) == pytest.approx(moved.apply(DISH.center_mm), abs=EXACT_MM)


def test_a_change_is_found_as_it_is_without_noise() -> None:
    bend = Deformation(zernike=(ZernikeTerm(2, 2, 0.3),))
    changes = target_changes(state(), state(bend), CAMERA, DISH)
    place, _, strain = true_poses(DISH, bend, AT)
    before, _, _ = true_poses(DISH, Deformation(), AT)
    seen = np.einsum("nij,nj->ni", changes.by_strain, strain)
    expected = place - changes.moved.apply(before) + seen[:, :3]
    # turns of 2 mrad and moves of the alignment multiply by 1e-6 of each other
    assert found_changes(changes)[:, :3] == pytest.approx(expected, abs=2e-5)


def test_changes_scatter_as_their_information_says() -> None:
    """Chi-square of the changes between states without change, 60 pairs: its mean is the number of directions."""
    total, count = 0.0, 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        changes = target_changes(state(rng=rng), state(rng=rng), CAMERA, DISH)
        x = found_changes(changes)
        total += float(np.einsum("ni,nij,nj->", x, changes.information, x))
        count += 6 * len(DISH) - 6
    # the mean square of some 11000 standard normals has a sigma of 0.013
    assert total / count == pytest.approx(1.0, abs=0.05)


def test_a_print_error_common_to_both_photographs_cancels() -> None:
    """A target printed 0.5 mm off and tilted has no change."""
    first, second = state(), state()
    tilt = rotation_from_vector(np.array([0.002, 0.001, 0.0]))

    def off(poses: TargetPoses) -> TargetPoses:
        position, rotation = poses.position_mm.copy(), poses.rotation.copy()
        position[3] += [0.5, -0.2, 0.3]
        rotation[3] = rotation[3] @ tilt
        return replace(poses, position_mm=position, rotation=rotation)

    changes = target_changes(off(first), off(second), CAMERA, DISH)
    assert np.abs(found_changes(changes)).max() < 1e-7


def test_the_response_to_strain_is_that_of_a_fit_to_outlines() -> None:
    """Strain the printed outlines of a target, fit its pose to them with SciPy, compare with the linear response."""
    index = np.array([7])
    poses = Poses(AT.rotation @ DISH.axes[index], AT.apply(DISH.center_mm[index]))
    _, by_strain = pose_response(CAMERA, DISH, index, AT)
    kind, curvature = DISH.kind_of(7), DISH.curvature_per_mm[index]
    xy, _ = outline_samples(kind)
    nominal, _ = project_printed(CAMERA, poses, curvature, xy)
    normals, length = edge_normals(nominal, kind)
    # small: a target seen nearly face on answers an unequal strain with a large turn, which is no longer linear beyond 1e-5
    strain = np.array([4e-6, -2e-6, 1e-6])
    local = bent_print_mm(xy[None], curvature)[0]
    stretched = local + np.stack(
        [strain[0] * xy[:, 0] + strain[2] * xy[:, 1], strain[2] * xy[:, 0] + strain[1] * xy[:, 1], np.zeros(len(xy))], axis=1
    )
    seen = CAMERA.project(poses.in_camera(stretched[None])[0])

    def gap(at: np.ndarray) -> np.ndarray:
        moved = poses.position_mm[0] + at[:3] + local @ (poses.rotation[0] @ rotation_from_vector(at[3:])).T
        across = ((CAMERA.project(moved) - seen) * normals[0]).sum(axis=1)
        return across * np.sqrt(length[0])

    fitted = least_squares(gap, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale=[0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-3]).x
    # what is not linear: 2 % of the response, which is 4e-4 mm and 1e-4 rad here
    assert by_strain[0] @ strain == pytest.approx(fitted, rel=0.03)


def test_frames_of_one_state_average() -> None:
    rng = np.random.default_rng(3)
    frames = [state(rng=rng) for _ in range(4)]
    both = combine_frames(frames)
    assert both.information == pytest.approx(4 * frames[0].information, rel=1e-9)
    each = np.stack([f.position_mm - state().position_mm for f in frames]).std()
    assert (both.position_mm - state().position_mm).std() == pytest.approx(each / 2, rel=0.25)
    with pytest.raises(MeasurementError, match="no photograph"):
        combine_frames([])


def test_frames_that_show_different_targets_are_joined() -> None:
    whole = state()
    joined = combine_frames([select_targets(whole, np.arange(20)), select_targets(whole, np.arange(10, len(whole)))])
    assert joined.ids.tolist() == whole.ids.tolist()
    assert joined.information[5] == pytest.approx(whole.information[5])
    assert joined.information[15] == pytest.approx(2 * whole.information[15])


def test_alignment_leaves_wild_points_aside() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-200, 200, (30, 3)) + [0, 0, 700]
    pose = Pose.from_rotation_vector([0.01, 0.02, -0.01], [1.0, 2.0, 3.0])
    after = pose.apply(points) + rng.normal(0, 0.01, points.shape)
    after[:4] += [5.0, -3.0, 8.0]
    found = rigid_alignment(points, after, np.tile(1e-4 * np.eye(3), (30, 1, 1)))
    # 26 points of 0.01 mm: the middle is known to 0.002 mm
    assert found.apply(points[4:]) == pytest.approx(pose.apply(points[4:]), abs=0.02)
    with pytest.raises(MeasurementError, match="at least 3"):
        rigid_alignment(points[:2], after[:2], np.tile(np.eye(3), (2, 1, 1)))
