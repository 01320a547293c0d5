"""What a difference says in words: the numbers are those of the record, and nothing is claimed that the record does not hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from differences import CAMERA, DISH, PLATE, RIGID_SIGMA, SIGMA_MM, difference_of, joint_of, with_outliers

from dishmap.compare import JOINT, joint_table
from dishmap.difference.difference_map import Significance
from dishmap.difference.priors import Priors
from dishmap.difference_assumptions import assumptions, way_words
from dishmap.difference_verdict import difference_verdict, largest_row, rigid_of, rms_with_sigma, shape_rms, unused_targets, with_sigma
from dishmap.transforms import Pose

QUIET = Significance(18.0, 20, 0.59)
STILL_POSE = Pose.identity()
# Draws of the truth, and the error of a standard deviation from so many, with room for four of its own.
DRAWS, DRAW_ERROR = 20_000, 4 / np.sqrt(2 * 20_000)


def facts_of(result):
    return {fact.name: fact for fact in difference_verdict(result).facts}


@pytest.mark.parametrize("size_mm", [0.0, 0.002, 0.01, 0.3])
def test_error_of_the_rms_is_that_of_drawn_truths(size_mm: float) -> None:
    # truths are drawn about the estimate; their rms differs from the estimate's by what is claimed, also where noise is all there is
    rng = np.random.default_rng(7)
    value = size_mm * rng.standard_normal(30)
    factor, own = 0.003 * rng.standard_normal((30, 4)), np.full(30, 0.004**2)
    truth = value + rng.standard_normal((DRAWS, 4)) @ factor.T + 0.004 * rng.standard_normal((DRAWS, 30))
    rms, sigma = rms_with_sigma(value, factor, own)
    assert rms == pytest.approx(np.sqrt(np.mean(value**2)), abs=1e-15)
    drawn = np.sqrt((truth**2).mean(axis=1)) - rms
    # a quarter: the mean of a root is taken from two moments only
    assert sigma == pytest.approx(np.sqrt((drawn**2).mean()), rel=DRAW_ERROR + 0.25 * (size_mm < 0.01))


def test_rms_of_an_exact_zero() -> None:
    assert rms_with_sigma(np.zeros(3), np.zeros((3, 1)), np.zeros(3)) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (0.34062, 0.0046, "0.3406 ± 0.0046 mm"),
        (-2.0, 1.949, "-2.0 ± 1.9 mm"),
        (-1e-9, 0.1, "0.00 ± 0.10 mm"),
        (1234.5, 120.0, "1234 ± 120 mm"),
        (0.25, 0.0, "0.250 mm"),
        (0.25, np.nan, "0.250 mm"),
        (0.25, 1e-17, "0.250 mm"),
    ],
)
def test_values_are_written_to_two_digits_of_their_sigma(value: float, sigma: float, text: str) -> None:
    assert with_sigma(value, sigma, " mm") == text


def test_a_change_is_told_with_its_largest_target() -> None:
    result = difference_of(DISH)
    row = int(np.argmax(np.abs(result.table.shape_mm)))
    said = difference_verdict(result)
    rms, sigma = shape_rms(result.joint)
    assert said.headline.startswith(f"The shape changed by {with_sigma(rms, sigma, ' mm')} rms, most at target {DISH.ids[row]} (")
    # by hand: length of (0.1, 0, 0.3) and its sigma along it
    along = np.hypot(0.1 * RIGID_SIGMA[0], 0.3 * RIGID_SIGMA[2]) / np.hypot(0.1, 0.3)
    assert f"moved by {with_sigma(np.hypot(0.1, 0.3), along, ' mm')} and turned by 0.0500 ± 0.0057°" in said.headline
    facts = facts_of(result)
    assert facts["Change of shape, rms"].value == f"{rms:.3f} mm"
    assert facts["Largest change of shape"].value == f"{abs(result.table.shape_mm[row]):.3f} mm"
    assert f"target {DISH.ids[row]} " in facts["Largest change of shape"].detail
    assert facts["p value"].value == "< 1e-12"
    assert facts["Ways of moving that count"].value == "2"
    assert not said.warnings


def test_no_change_is_not_called_one() -> None:
    n = len(PLATE)
    quiet = joint_of(
        PLATE, shape_mm=np.full(n, 1e-4), significance=QUIET, rigid_motion=Pose.from_rotation_vector(np.zeros(3), [1e-3, 0.0, 5e-3])
    )
    headline = difference_verdict(difference_of(PLATE, quiet)).headline
    assert headline.startswith("No significant change of shape: 0.0001 ± ")
    assert "p = 0.59" in headline
    assert "did not move significantly" in headline


def test_only_the_part_of_a_rigid_motion_that_is_certain_is_told() -> None:
    turned = joint_of(PLATE, rigid_motion=Pose.from_rotation_vector([1e-3, 0.0, 0.0], [1e-4, 0.0, 0.0]))
    assert rigid_of(turned).significant
    headline = difference_verdict(difference_of(PLATE, turned)).headline
    assert "as a whole the surface turned by 0.0573 ± 0.0057°." in headline
    assert "moved" not in headline


def test_a_rigid_motion_of_exactly_nothing() -> None:
    rigid = rigid_of(joint_of(PLATE, rigid_motion=STILL_POSE))
    assert rigid.moved_mm == (0.0, pytest.approx(RIGID_SIGMA[2]))
    assert not rigid.significant


def test_motion_and_expansion_that_one_camera_cannot_tell_apart() -> None:
    ppm = 1985.0
    joint = joint_of(PLATE, significance=QUIET, expansion=(0.0, 1.9e-3), expansion_assumed=(0.0, 1e-6 * ppm))
    said = difference_verdict(difference_of(PLATE, joint))
    assert "cannot tell apart (scale changed by 0.2 %)" in said.headline
    depth = float(joint.camera_from_dish.translation_mm[2])
    warning = next(w for w in said.warnings if w.startswith("The scale of the whole picture"))
    assert f"{depth * ppm * 1e-6:.3f} mm along the line of sight" in warning
    assert "1985 ppm" in warning
    # when it was given beforehand, there is nothing to warn of
    known = replace(joint, priors=Priors(expansion_ppm=(0.0, ppm)))
    told = difference_verdict(difference_of(PLATE, known))
    assert "tell apart" not in told.headline
    assert not told.warnings
    assert any("0 ± 1985 ppm was given beforehand" in line for line in assumptions(known, True))


def test_scatter_beyond_the_sigmas_stands_in_the_headline() -> None:
    doubt = "the targets scatter 5.00 times more than their sigmas allow"
    for joint in (joint_of(PLATE), joint_of(PLATE, significance=QUIET), joint_of(PLATE, priors=Priors(still=True))):
        assert doubt in difference_verdict(difference_of(PLATE, replace(joint, noise_factor=25.0))).headline
        assert doubt not in difference_verdict(difference_of(PLATE, joint)).headline


def test_a_rigid_body_that_was_given_and_is_contradicted() -> None:
    n = len(PLATE)
    still = joint_of(PLATE, shape_mm=np.zeros(n), sigma_shape_mm=np.full(n, 2e-17), shape_own_mm2=np.zeros(n), priors=Priors(still=True))
    result = difference_of(PLATE, still)
    assert difference_verdict(result).headline.startswith("Taken as a rigid body, as was given, the surface moved by 0.31")
    assert "contradict a rigid body (p < 1e-12)" in difference_verdict(result).headline
    calm = difference_of(PLATE, replace(still, significance=QUIET))
    assert "contradict" not in difference_verdict(calm).headline
    assert "Change of shape, rms" not in facts_of(result)


def test_what_was_put_aside_does_not_count() -> None:
    joint = joint_of(DISH)
    row = int(np.argmax(np.abs(joint.shape_mm)))
    other = with_outliers(replace(joint, shape_mm=np.where(np.arange(len(joint)) == row, 9.0, joint.shape_mm)), [row])
    result = difference_of(DISH, other)
    assert largest_row(result.table) != row
    assert shape_rms(other)[0] < np.abs(joint.shape_mm).max()
    assert facts_of(result)["Targets compared"].detail.startswith("1 put aside")
    (warning,) = difference_verdict(result).warnings
    assert (
        warning
        == f"1 target not used ({DISH.ids[row]}): its change fits no smooth motion of the surface; its row holds what its neighbours say."
    )


def test_all_targets_put_aside_still_gives_words() -> None:
    joint = with_outliers(joint_of(PLATE), list(range(len(PLATE))))
    said = difference_verdict(difference_of(PLATE, joint))
    assert "nan" not in said.headline
    assert f"{len(PLATE)} targets not used" in said.warnings[0]


def test_the_same_photograph_twice_is_told() -> None:
    assert difference_verdict(difference_of(PLATE, same=True)).headline.startswith("Both states are the same photograph")


def test_an_unknown_calibration_is_told() -> None:
    bare = replace(CAMERA, covariance=None)
    assert any("calibration's covariance is unknown" in w for w in difference_verdict(difference_of(PLATE, camera=bare)).warnings)


def test_no_zernike_terms_and_no_convergence_are_told() -> None:
    joint = joint_of(PLATE, zernike_terms=(), zernike_mm=np.zeros(0), zernike_covariance_mm2=np.zeros((0, 0)), converged=False)
    said = " ".join(difference_verdict(difference_of(PLATE, joint)).warnings)
    assert "too few to report Zernike terms" in said
    assert "converged" in said


def test_targets_that_only_one_state_has() -> None:
    joint = replace(joint_of(PLATE), rejected=((3, "reference: part of the target lies outside the image"),))
    assert unused_targets(difference_of(PLATE, joint)) == [(3, "reference: part of the target lies outside the image")]
    # the paper's record holds no reasons: they come from the two states
    rows = joint_table(joint_of(PLATE))
    short = replace(rows, **{name: getattr(rows, name)[1:] for name in rows.__dataclass_fields__})
    result = difference_of(PLATE, joint=None, tables={JOINT: short})
    assert unused_targets(replace(result, joint=None)) == [(int(PLATE.ids[0]), "not measured in both photographs")]


@pytest.mark.parametrize(
    ("priors", "words"),
    [
        (Priors(), "Expansion: none was assumed"),
        (Priors(), "Focal length: taken as unchanged"),
        (Priors(), "learnt from the photographs. Prints stretched by 4.00 ppm each on its own, and the slide added 2.00 ppm"),
        (Priors(), "displacement of 0.200 mm (learnt) that changes over 120 mm (weighed"),
        (Priors(), "One camera cannot tell a motion of the surface from one of the camera"),
        (Priors(focal_drift=1e-4), "a drift of 0 ± 100 ppm was allowed for"),
        (Priors(strain="free"), "prints may have stretched by any amount"),
        (Priors(strain="rigid"), "prints to keep their size"),
        (Priors(strain=2e-6), "a standard deviation of 2.00 ppm was given"),
        (Priors(amplitude_mm=0.2, length_mm=120.0), "0.200 mm (given) that changes over 120 mm (given"),
        (Priors(slide="axial"), "was taken to move as a membrane does"),
        (Priors(still=True), "taken to move as a rigid body, as was given"),
        (Priors(rigid_ids=(0, 1, 2)), "Targets 0, 1, 2 were taken to sit on rigid parts"),
    ],
)
def test_assumptions_are_told(priors: Priors, words: str) -> None:
    assert words in " ".join(assumptions(joint_of(DISH, priors=priors), flat=False))


def test_what_an_expansion_would_do_is_told_in_mm() -> None:
    # 10 ppm of the distance to the dish
    depth = 1e-5 * float(joint_of(DISH).camera_from_dish.translation_mm[2])
    assert f"{depth:.5f} mm towards the camera" in assumptions(joint_of(DISH), flat=False)[0]


def test_ways_of_moving_in_words() -> None:
    joint = joint_of(PLATE)
    assert "membrane" in way_words(joint, joint.considered[0], flat=False)
    assert "boresight" in way_words(joint, joint.considered[1], flat=False)
    assert "plane" in way_words(joint, joint.considered[0], flat=True)
    assert way_words(replace(joint, priors=Priors(still=True)), joint.considered[0], flat=True) == "as a rigid body"


def test_sigma_of_one_target_is_the_records() -> None:
    assert f"sigma of one target {SIGMA_MM:.5f} mm" in facts_of(difference_of(DISH))["Change of shape, rms"].detail
