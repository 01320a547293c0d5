"""The adjustment: priors, convergence, and a batch against its targets one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import PLAIN, facing_towards, group_of, moved

from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Light, Scene, Sensor, facing_pose
from dishmap.targets.adjust import (
    LARGEST_STEP_PX,
    STEP_SIGMAS,
    Adjusted,
    adjust,
    by_target,
    prior_terms,
)
from dishmap.targets.builders import multi_circular, plate, ring
from dishmap.targets.edges import Poses
from dishmap.targets.pixels import BLUR, GEOMETRY, OFFSET_MM, OFFSET_PX, TONE, RingPixels, Weighting
from dishmap.targets.solve import inverse_scaled
from dishmap.targets.stages import Group, layout
from dishmap.targets.start import nominal_poses
from dishmap.transforms import angle_between_rad, rotation_from_vector

Array = NDArray[np.float64]

# An adjustment stops when little is left to do in the mean square of all parameters; one of them may hold all of it.
STOPPED_SIGMAS = STEP_SIGMAS * GEOMETRY**0.5
# What two such fits of the same pixels from different sides differ by, root mean square.
EARLY_SIGMAS = 0.1
DISTANCE_MM = 500.0
NOISE_GREY = 2.0
RING = ring(2.0, 1.2)


def test_sums_by_target() -> None:
    values = np.arange(10.0).reshape(5, 2)
    np.testing.assert_array_equal(by_target(values, np.array([0, 2, 0, 2, 2]), 4), [[4, 6], [0, 0], [16, 19], [0, 0]])


def facing_group(count: int = 1, tilt_rad: float = 0.3, blur_px: float = 0.85) -> Group:
    poses = [facing_towards(PLAIN, (80.0 + 70 * i, 150.0), DISTANCE_MM, tilt_rad, 0.5 + i) for i in range(count)]
    return group_of(PLAIN, RING, Poses(np.array([p.rotation for p in poses]), np.array([p.translation_mm for p in poses])), blur_px)


def with_priors(group: Group, **values: object) -> Group:
    return replace(group, batch=replace(group.batch, priors=replace(group.batch.priors, **values)))


def test_priors_pull_towards_what_was_expected() -> None:
    group = facing_group()
    group = with_priors(group, normal=group.poses.rotation[..., 2], blur_px=0.85)

    def cost(at: Group) -> float:
        """Half the sum of squares of what the priors say, from their own words."""
        p, s = at.batch.priors, at.state
        tilt = angle_between_rad(at.poses.rotation[0, :, 2], p.normal[0]) / p.normal_sigma_rad[0]
        parts = [tilt, s.offset_mm[0] / p.offset_mm_sigma, s.offset_px[0] / p.offset_px_sigma]
        parts += [(s.blur_px[0] - p.blur_px) / (p.blur_px * p.log_blur_sigma), (s.log_gamma[0] - p.log_gamma) / p.log_gamma_sigma]
        return 0.5 * float(np.square(parts).sum())

    away = group
    for column, amount in ((3, 0.02), (4, -0.03), (OFFSET_MM, 0.01), (OFFSET_PX, 0.1), (BLUR, 0.2), (TONE, -0.1)):
        away = moved(away, column, amount)
    precision, pull = prior_terms(away.poses, away.state, away.batch.priors)
    for column in (3, 4, OFFSET_MM, OFFSET_PX, BLUR, TONE):
        h = 1e-5
        slope = (cost(moved(away, column, h)) - cost(moved(away, column, -h))) / (2 * h)
        assert pull[0, column] == pytest.approx(-slope, rel=0.01), f"column {column}"
        bend = (cost(moved(away, column, 1e-3)) + cost(moved(away, column, -1e-3)) - 2 * cost(away)) / 1e-6
        assert precision[0, column] == pytest.approx(bend, rel=0.01), f"column {column}"
    # nothing is assumed of the place
    np.testing.assert_allclose(pull[0, :3], 0)
    assert (precision[0, :3] < 1e-9).all()


def test_a_turn_about_the_normal_is_held_only_where_nothing_shows_it() -> None:
    one_center = facing_group()
    four = group_of(PLAIN, multi_circular(4, 1.0, 0.6, 2.8), one_center.poses, 0.85)
    held, free = (prior_terms(g.poses, g.state, g.batch.priors)[0][0, 5] for g in (one_center, four))
    assert held > 1e6
    assert free < 1e-6


def photographed(tilt_rad: float = 0.3, seed: int = 1, noise_grey: float = NOISE_GREY) -> tuple[NDArray[np.uint16], Group]:
    """A noisy photograph of six rings, and the group at their true poses."""
    pattern = plate(2, 3, 14.0, RING)
    scene = Scene(
        pattern,
        PLAIN,
        facing_pose(DISTANCE_MM, tilt_rad, 0.4),
        light=Light(ink_grey=20, ground_grey=180, background_grey=180),
        sensor=Sensor(0.8, noise_grey=noise_grey, bits=16),
    )
    poses = nominal_poses(pattern, np.arange(len(pattern)), scene.camera_from_dish)
    return simulate(scene, np.random.default_rng(seed)).image, group_of(PLAIN, RING, poses, float(np.hypot(0.8, 12**-0.5)))


def fitted(
    image: NDArray[np.uint16], group: Group, steps: int = 15, enough: float = 1.0, chosen_at: Group | None = None
) -> tuple[Adjusted, RingPixels]:
    batch, pixels = layout(image, chosen_at or group, 0.85, 0.85)
    noise = NOISE_GREY * 257
    return adjust(batch, pixels, group.poses, group.state, Weighting(noise**2, 0.0, None), steps, enough), pixels


def sigma(fit: Adjusted, column: int) -> Array:
    return np.sqrt(inverse_scaled(fit.information)[:, column, column])


def starts_apart(image: NDArray[np.uint16], group: Group) -> Array:
    """How far apart (6, 3), in sigmas, the fits from two starts end; the second start is as far off as a coarse fit leaves it."""
    there = group
    for column, amount in ((0, 0.02), (1, -0.02), (2, 1.0), (3, 0.05), (4, -0.04), (BLUR, 0.1)):
        there = moved(there, column, amount)
    # the priors are those of the first group: the same question is asked
    here, far = fitted(image, group, 40)[0], fitted(image, replace(there, batch=group.batch), 40, chosen_at=group)[0]
    assert here.converged.all()
    assert far.converged.all()
    gap = np.einsum("tji,tj->ti", here.poses.steps, far.poses.position_mm - here.poses.position_mm)
    return np.abs(gap) / np.stack([sigma(here, c) for c in range(3)], axis=1)


def test_different_starts_end_in_one_place(monkeypatch: pytest.MonkeyPatch) -> None:
    image, group = photographed()
    early = starts_apart(image, group)
    assert np.sqrt((early**2).mean()) < EARLY_SIGMAS
    monkeypatch.setattr("dishmap.targets.adjust.STEP_SIGMAS", 1e-4)
    monkeypatch.setattr("dishmap.targets.adjust.STEP_PX", 1e-6)
    assert starts_apart(image, group).max() < 0.02


def test_the_fit_is_a_minimum() -> None:
    """Chi-square with the priors rises to either side of the fit, by what its information says."""
    image, group = photographed()
    fit, pixels = fitted(image, group)
    batch, _ = layout(image, group, 0.85, 0.85)
    at = replace(group, poses=fit.poses, state=fit.state)

    def cost(g: Group) -> Array:
        once = adjust(batch, pixels, g.poses, g.state, Weighting((NOISE_GREY * 257) ** 2, 0.0, None), 1)
        precision, pull = prior_terms(g.poses, g.state, batch.priors)
        return by_target(once.sums.square, pixels.target, len(g.poses)) + (pull**2 / precision).sum(axis=1)

    for column in (0, 1, 2, 3, 4, BLUR):
        step = 1.0 / np.sqrt(fit.information[0, column, column])
        low, middle, high = (cost(moved(at, column, k * step)) for k in (-1, 0, 1))
        assert (low > middle).all()
        assert (high > middle).all()
        bend = 0.5 * (low + high) - middle
        # one sigma raises chi-square by one; the noise is known only to a few percent per target
        np.testing.assert_allclose(bend, fit.information[:, column, column] * step**2 * fit.noise_variance, rtol=0.15)


def test_a_batch_is_its_targets_one_by_one() -> None:
    """Targets do not influence each other, also when some need more steps than most and go on alone."""
    image, group = photographed()
    far = moved(group, 2, 6.0).poses
    poses = Poses(group.poses.rotation, np.where(np.arange(6)[:, None] == 2, far.position_mm, group.poses.position_mm))
    group = replace(group, poses=poses)
    together, pixels = fitted(image, group, 20)
    batch, _ = layout(image, group, 0.85, 0.85)
    for i in range(6):
        mine = pixels.target == i
        number = np.where(np.arange(6) == i, 0, -1)
        p = batch.priors
        single = replace(
            batch,
            curvature_per_mm=batch.curvature_per_mm[[i]],
            priors=replace(p, normal=p.normal[[i]], normal_sigma_rad=p.normal_sigma_rad[[i]]),
        )
        alone = adjust(
            single,
            pixels.only(mine, number),
            poses.take(np.array([i])),
            group.state.take(np.array([i])),
            Weighting((NOISE_GREY * 257) ** 2, 0.0, None),
            20,
        )
        assert together.converged[i]
        assert alone.converged[0]
        gap = alone.poses.position_mm[0] - together.poses.position_mm[i]
        assert np.abs(gap @ together.poses.steps[i] / [sigma(together, c)[i] for c in range(3)]).max() < 2 * STOPPED_SIGMAS
        np.testing.assert_allclose(alone.information[0], together.information[i], rtol=0.02, atol=1e-3 * np.abs(alone.information[0]).max())


def test_a_share_of_converged_targets_can_be_enough() -> None:
    image, group = photographed()
    far = replace(group, poses=moved(group, 2, 25.0).poses)
    assert not fitted(image, far, 1)[0].converged.any()
    assert fitted(image, group, 20, enough=0.3)[0].converged.mean() >= 0.3


def test_steps_are_limited() -> None:
    image, group = photographed()
    wrong = moved(group, 2, 60.0)
    fit, _ = fitted(image, wrong, 1)
    px = np.abs(PLAIN.project(fit.poses.position_mm) - PLAIN.project(wrong.poses.position_mm))
    radius = 3000 * 2.0 * np.abs(1 / fit.poses.position_mm[:, 2] - 1 / wrong.poses.position_mm[:, 2])
    assert (px < 1.01 * LARGEST_STEP_PX).all()
    assert (radius < 1.01 * LARGEST_STEP_PX).all()


def test_noise_is_what_the_photograph_holds() -> None:
    image, group = photographed()
    fit, pixels = fitted(image, group)
    # in units of the variance that was given; rounding of pixels to 1/257 grey adds nothing
    count = pixels.used.sum()
    assert fit.noise_variance.mean() == pytest.approx(1, abs=4 * np.sqrt(2 / count) + 0.01)
    assert fit.information.shape == (6, GEOMETRY, GEOMETRY)
    np.testing.assert_allclose(fit.information - np.swapaxes(fit.information, 1, 2), 0, atol=1e-4 * np.abs(fit.information).max())


@pytest.mark.parametrize("about", [(0.3, 0.0), (0.0, -0.4), (-0.5, 0.2)])
def test_normal_prior_measures_small_angles(about: tuple[float, float]) -> None:
    """The pull on the two tilts is the turn that brings the normal back, for small angles."""
    group = facing_group(1, 0.0)
    turn = np.radians(5) * np.array([*about, 0.0])
    expected = group.poses.rotation @ rotation_from_vector(turn) @ [0.0, 0.0, 1.0]
    group = with_priors(group, normal=expected, normal_sigma_rad=np.array([0.1]))
    _, pull = prior_terms(group.poses, group.state, group.batch.priors)
    np.testing.assert_allclose(pull[0, 3:5] * 0.1**2, turn[:2], atol=1e-4)
