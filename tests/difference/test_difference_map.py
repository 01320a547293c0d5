"""The whole estimate: known displacement in and out, true sigmas, what must not enter the shape, what must be flagged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from difference.states import AT, CAMERA, DISH, RIM_MM, state, true_poses
from scipy.stats import kstest

from dishmap.difference.bound import joint_bound, without_rigid
from dishmap.difference.difference_map import DifferenceMap, joint_difference
from dishmap.difference.priors import Priors
from dishmap.errors import InputError, MeasurementError
from dishmap.quality import Quality
from dishmap.simulate.deform import Bump, Crease, Deformation, ZernikeTerm
from dishmap.targets.pose import TargetPoses, select_targets
from dishmap.transforms import Pose

# Largest of 37 standard normals: 4.2 sigma is exceeded once in a thousand draws.
SIGMAS = 4.2


def truth(bend: Deformation, now: Pose = AT) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Displacement along the normal, depth change and shape of every target."""
    before, after = (AT.inverse().apply(true_poses(DISH, b, p)[0]) for b, p in ((Deformation(), AT), (bend, now)))
    move = after - before
    left = without_rigid(move[..., None], DISH.center_mm)[..., 0]
    return (move * DISH.normal).sum(axis=1), move @ AT.rotation[2], (left * DISH.normal).sum(axis=1)


def compared(bend: Deformation, seed: int, priors: Priors | None = None, now: Pose = AT) -> DifferenceMap:
    rng = np.random.default_rng(seed)
    return joint_difference(state(rng=rng), state(bend, rng, now), CAMERA, DISH, priors)


BENDS = {
    "astigmatism": Deformation(zernike=(ZernikeTerm(2, 2, 0.3),)),
    "coma and trefoil": Deformation(zernike=(ZernikeTerm(3, 1, 0.2), ZernikeTerm(3, -3, 0.1))),
    "bump": Deformation(bumps=(Bump((90.0, -60.0), 80.0, 0.3),)),
    "on its normals": Deformation(zernike=(ZernikeTerm(2, -2, 0.4),), slide="normal"),
}


@pytest.mark.parametrize("name", list(BENDS))
def test_what_went_in_comes_out(name: str) -> None:
    bend = BENDS[name]
    found = compared(bend, 5)
    displacement, depth, shape = truth(bend)
    assert found.converged
    assert np.abs((found.displacement_mm - displacement) / found.sigma_displacement_mm).max() < SIGMAS
    assert np.abs((found.depth_change_mm - depth) / found.sigma_depth_change_mm).max() < SIGMAS
    assert np.abs((found.shape_mm - shape) / found.sigma_shape_mm).max() < SIGMAS
    # a tenth of what happened
    assert np.sqrt((found.sigma_shape_mm**2).mean()) < 0.1 * np.abs(shape).max()
    assert found.significance.changed
    best = max(found.considered, key=lambda c: c.weight)
    assert best.way == bend.slide


def test_zernike_terms_come_back_with_their_sigma() -> None:
    found = compared(Deformation(zernike=(ZernikeTerm(2, 2, 0.3), ZernikeTerm(4, 0, 0.1))), 11)
    sigma = np.sqrt(np.diag(found.zernike_covariance_mm2))
    for (n, m), value, s in zip(found.zernike_terms, found.zernike_mm, sigma, strict=True):
        expected = {(2, 2): 0.3, (4, 0): 0.1}.get((n, m), 0.0)
        assert abs(value - expected) < SIGMAS * s, (n, m)
        # the finest terms of 37 targets
        assert s < 0.04


def test_the_sigma_of_the_shape_is_true() -> None:
    """Coverage over 40 pairs of random shapes; 37 targets of a smooth shape are some 10 independent numbers each."""
    inside, total = 0, 0
    for seed in range(40):
        rng = np.random.default_rng(1000 + seed)
        bend = Deformation(
            zernike=tuple(ZernikeTerm(n, m, float(rng.normal(0, 0.15))) for n, m in ((2, 0), (2, 2), (3, 1))),
            bumps=(Bump((float(rng.uniform(-150, 150)), float(rng.uniform(-150, 150))), 90.0, float(rng.normal(0, 0.2))),),
        )
        found = compared(bend, seed)
        error = found.shape_mm - truth(bend)[2]
        inside += int((np.abs(error) < 1.96 * found.sigma_shape_mm).sum())
        total += len(error)
    # some 400 independent numbers: 1.1 % of sampling
    assert 0.91 < inside / total < 0.99


def test_without_change_the_p_value_is_uniform() -> None:
    values = [compared(Deformation(), seed).significance.p_value for seed in range(40)]
    # a wrong test is seen at once; a right one fails once in 200 choices of seeds
    assert kstest(values, "uniform").pvalue > 0.005


def test_a_move_of_the_camera_does_not_enter_the_shape() -> None:
    bend = BENDS["astigmatism"]
    moved = Pose.from_rotation_vector(np.radians([0.03, -0.03, 0.03]), [0.3, 0.2, -0.3]) @ AT
    still, shifted = compared(bend, 3), compared(bend, 3, now=moved)
    # the same noise, so only the linearisation differs
    assert shifted.shape_mm == pytest.approx(still.shape_mm, abs=0.2 * float(still.sigma_shape_mm.min()))
    displacement = truth(bend, moved)[0]
    assert np.abs((shifted.displacement_mm - displacement) / shifted.sigma_displacement_mm).max() < SIGMAS


def test_a_rigid_body_has_no_shape_and_a_smaller_sigma() -> None:
    moved = Pose.from_rotation_vector([1e-4, 2e-4, 0.0], [0.1, 0.0, 0.4]) @ AT
    free, still = (compared(Deformation(), 2, p, moved) for p in (Priors(), Priors(still=True)))
    assert np.abs(still.shape_mm).max() < 1e-9
    assert still.sigma_displacement_mm.max() < free.sigma_displacement_mm.max()
    displacement = truth(Deformation(), moved)[0]
    assert np.abs((still.displacement_mm - displacement) / still.sigma_displacement_mm).max() < SIGMAS


def wild(poses: TargetPoses, rows: list[int], by_mm: float) -> TargetPoses:
    """Targets moved within the surface by some tenths of a millimetre: what no smooth motion does to one alone."""
    position = poses.position_mm.copy()
    rng = np.random.default_rng(9)
    angle = rng.uniform(0, 2 * np.pi, len(rows))
    axes = poses.rotation[rows]
    position[rows] += by_mm * (np.cos(angle)[:, None] * axes[..., 0] + np.sin(angle)[:, None] * axes[..., 1])
    return replace(poses, position_mm=position)


def test_wild_targets_are_put_aside_and_said() -> None:
    bend = BENDS["bump"]
    rng = np.random.default_rng(7)
    reference, current = state(rng=rng), state(bend, rng)
    rows = [4, 20]
    clean = joint_difference(reference, current, CAMERA, DISH)
    # a pixel is 0.4 mm here
    found = joint_difference(reference, wild(current, rows, 0.4), CAMERA, DISH)
    flagged = np.flatnonzero(found.quality & int(Quality.OUTLIER))
    assert flagged.tolist() == rows
    assert {i for i, why in found.rejected if "fits no smooth motion" in why} == {int(DISH.ids[r]) for r in rows}
    others = np.setdiff1d(np.arange(len(DISH)), rows)
    shape = truth(bend)[2]
    rms = [np.sqrt(((f.shape_mm - shape)[others] ** 2).mean()) for f in (clean, found)]
    assert rms[1] < 1.3 * rms[0]


@pytest.mark.parametrize(("seed", "rows"), [(13, [1, 7, 30]), (31, [2, 3, 20])])
def test_outliers_that_a_bent_surface_seems_to_explain_are_put_aside(seed: int, rows: list[int]) -> None:
    """Three wild targets of 37 look like a surface that moves in some strange way, until they are screened by the least strain."""
    bend = Deformation(zernike=(ZernikeTerm(2, 0, 0.4), ZernikeTerm(2, 2, -0.6), ZernikeTerm(3, 1, 0.25)), slide="least_strain")
    rng = np.random.default_rng(seed)
    reference, current = state(rng=rng), state(bend, rng)
    assert sorted(rng.choice(len(DISH), 3, replace=False).tolist()) == rows
    found = joint_difference(reference, wild(current, rows, 0.4), CAMERA, DISH)
    assert np.flatnonzero(found.quality & int(Quality.OUTLIER)).tolist() == rows
    # by the first screening alone residuals were 6 and 30 times as large as claimed
    assert found.noise_factor < 1.5
    others = np.setdiff1d(np.arange(len(DISH)), rows)
    error = (found.shape_mm - truth(bend)[2])[others]
    assert np.sqrt((error**2).mean()) < 1.3 * np.sqrt((found.sigma_shape_mm[others] ** 2).mean()) < 0.02


def test_a_bump_that_one_target_sees_is_kept_and_said() -> None:
    """Narrower than the targets' spacing: its target moved unlike its neighbours, and may well be right."""
    bend = Deformation(bumps=(Bump((float(DISH.center_mm[12, 0]), float(DISH.center_mm[12, 1])), 25.0, 0.5),), slide="normal")
    found = compared(bend, 4)
    assert found.quality[12] == int(Quality.OFF_SURFACE)
    assert found.shape_mm[12] == pytest.approx(0.5, abs=0.1)
    assert np.flatnonzero(found.quality).tolist() == [12]


def test_an_expansion_is_never_a_confident_wrong_depth() -> None:
    grown = Deformation(expansion_ppm=2000.0)
    displacement, depth, _ = truth(grown)
    for priors in (Priors(), Priors(expansion_ppm=(2000.0, 100.0))):
        found = compared(grown, 1, priors)
        assert np.abs((found.depth_change_mm - depth) / found.sigma_depth_change_mm).max() < 3
        assert np.abs((found.displacement_mm - displacement) / found.sigma_displacement_mm).max() < 3
    # with the prior the depth is known to 100 ppm of 0.7 m
    assert found.sigma_depth_change_mm.max() < 0.08
    assert found.expansion[0] == pytest.approx(2000e-6, abs=3 * 100e-6)


def test_rigid_parts_take_the_motion_of_the_camera() -> None:
    """A hub of seven targets stays; the rest of the dish bends about it: shape is relative to the hub."""
    hub = DISH.ids[np.argsort(np.linalg.norm(DISH.center_mm, axis=1))[:7]]
    # half a micrometre at the hub's edge
    bend = Deformation(zernike=(ZernikeTerm(5, 5, 0.3),), slide="normal")
    moved = Pose.from_rotation_vector(np.radians([0.02, 0.01, 0.0]), [0.1, -0.1, 0.2]) @ AT
    found = compared(bend, 8, Priors(rigid_ids=tuple(int(i) for i in hub)), moved)
    on_hub = np.isin(found.ids, hub)
    assert np.abs(found.shape_mm[on_hub]).max() < 0.005
    expected = truth(bend)[0]
    assert np.abs((found.shape_mm - expected)[~on_hub] / found.sigma_shape_mm[~on_hub]).max() < SIGMAS
    with pytest.raises(InputError, match="no such target"):
        compared(bend, 8, Priors(rigid_ids=(99999,)))
    with pytest.raises(MeasurementError, match="rigid parts were measured"):
        compared(bend, 8, Priors(rigid_ids=(int(hub[0]),)))


def test_strain_said_to_be_free_costs_sigma_and_stays_true() -> None:
    bend = BENDS["astigmatism"]
    learnt, free = compared(bend, 4), compared(bend, 4, Priors(strain="free"))
    shape = truth(bend)[2]
    assert (free.sigma_shape_mm**2).sum() >= 0.98 * (learnt.sigma_shape_mm**2).sum()
    assert np.abs((free.shape_mm - shape) / free.sigma_shape_mm).max() < SIGMAS


def test_a_crease_is_followed() -> None:
    bend = Deformation(creases=(Crease((40.0, 0.0), 1.0, 40.0, 0.3),))
    found = compared(bend, 6)
    assert np.abs((found.shape_mm - truth(bend)[2]) / found.sigma_shape_mm).max() < SIGMAS


def test_the_error_comes_near_the_bound() -> None:
    """Efficiency of the shape over 30 shapes drawn from a smooth random field of known size: bound variance over error variance."""
    rng = np.random.default_rng(12)
    terms = [(2, 0), (2, 2), (2, -2), (3, 1), (3, -1), (3, 3)]
    errors = []
    for seed in range(30):
        bend = Deformation(zernike=tuple(ZernikeTerm(n, m, float(rng.normal(0, 0.1))) for n, m in terms))
        errors.append(compared(bend, seed).shape_mm - truth(bend)[2])
    measured = np.mean(np.square(errors))
    bound, _ = joint_bound(CAMERA, DISH, AT, 75.0, 0.8, 0.2, 1.2 * RIM_MM)
    # 30 draws of some ten numbers: 8 %; the states carry their own prior on normals, which the bound does not
    assert (bound**2).mean() / measured > 0.7


def test_too_few_common_targets_are_refused() -> None:
    whole = state()

    def part(rows: slice) -> TargetPoses:
        return select_targets(whole, np.arange(len(whole))[rows])

    with pytest.raises(MeasurementError, match="at least 3"):
        joint_difference(part(slice(0, 20)), part(slice(18, None)), CAMERA, DISH)
    few = joint_difference(part(slice(0, 5)), part(slice(0, 5)), CAMERA, DISH)
    assert len(few) == 5
    assert np.isfinite(few.sigma_shape_mm).all()
