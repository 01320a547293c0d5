"""The chain of a comparison from Python: what it hands on, what it averages, what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import dishmap
from dishmap.camera.model import Camera
from dishmap.compare import (
    State,
    combine_states,
    compare_photographs,
    compare_states,
    default_basis,
    later_hint,
    measure_state,
)
from dishmap.difference.paper import Centers
from dishmap.difference.priors import Priors
from dishmap.errors import FitError, InputError, MeasurementError
from dishmap.figures import apart, figures_of
from dishmap.simulate.deform import Deformation, ZernikeTerm
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.surface.fit import Basis
from dishmap.targets.builders import dish, plate
from dishmap.targets.identify import PoseGuess, Upright
from dishmap.targets.pose import TARGET_COLUMNS, TargetPoses

CAMERA = Camera(640, 480, [800.0, 800.0], [319.5, 239.5], [-0.1, 0.02, 0.0, 0.0])
PLATE = plate(4, 5, 40.0)
SCENE = Scene(PLATE, CAMERA, facing_pose(420.0, 0.2, 0.5), sensor=Sensor(noise_grey=1.0))
BEND = Deformation((ZernikeTerm(2, 2, 0.5),))


@pytest.fixture(scope="module")
def states() -> tuple[State, State]:
    """The plate before and after a bend, with the paper's centres."""
    out = []
    for seed, scene in enumerate((SCENE, replace(SCENE, deformation=BEND))):
        image = simulate(scene, np.random.default_rng(seed)).image
        out.append(measure_state(image, CAMERA, PLATE, Upright(), with_centers=True))
    return out[0], out[1]


def only(poses: TargetPoses, rows: np.ndarray) -> TargetPoses:
    return replace(poses, **{name: getattr(poses, name)[rows] for name in TARGET_COLUMNS})


def test_the_public_function_runs_the_same_chain(states: tuple[State, State]) -> None:
    before, after = (state.image for state in states)
    assert before is not None
    assert after is not None
    whole = dishmap.compare_photographs(before, after, CAMERA, PLATE, Upright(), method="all")
    parts = compare_states(*states, CAMERA, PLATE, method="all")
    for method in ("joint", "paper"):
        assert whole.tables[method].shape_mm.tolist() == parts.tables[method].shape_mm.tolist()
    assert whole.table is whole.tables["joint"]
    assert (whole.same, len(whole.table), set(whole.surfaces)) == (False, 20, {"displacement", "shape", "paper"})
    # without a hint the reference could sit in two ways, and is not guessed
    with pytest.raises(MeasurementError, match="could sit in 2 ways"):
        compare_photographs(before, after, CAMERA, PLATE)


def test_centres_of_one_kind_are_compared(states: tuple[State, State]) -> None:
    ours = compare_states(states[0], states[1], CAMERA, PLATE, method="paper")
    fitted = compare_states(replace(states[0], centers=None), states[1], CAMERA, PLATE, method="paper")
    assert np.isnan(ours.table.sigma_shape_mm).all()
    assert (fitted.table.sigma_shape_mm > 0).all()
    # the two kinds differ by their biases of some 0.01 px, which were they mixed would make depths of 0.1 mm
    assert np.abs(ours.table.displacement_mm - fitted.table.displacement_mm).max() < 0.03
    # du, dv are in the photograph: what the fit has there directly
    direct = states[1].poses.center_px - states[0].poses.center_px
    assert fitted.table.du_dv_px == pytest.approx(direct, abs=1e-6)


def test_sigma_of_the_paper_s_shape_is_that_of_repeated_noise(states: tuple[State, State]) -> None:
    rng = np.random.default_rng(3)
    still = replace(states[0], centers=None)
    noise_px = np.full((20, 2, 2), np.eye(2) * 0.004**2)
    made = []
    for _ in range(60):
        moved = replace(
            states[0].poses, center_px=states[0].poses.center_px + 0.004 * rng.standard_normal((20, 2)), covariance_px2=noise_px
        )
        sure = replace(states[0].poses, covariance_px2=1e-6 * noise_px)
        made.append(compare_states(State(sure), replace(still, poses=moved), CAMERA, PLATE, method="paper", surface=Basis()).table)
    spread = np.sqrt(np.mean([table.displacement_mm**2 for table in made], axis=0))
    claimed = np.mean([table.sigma_displacement_mm for table in made], axis=0)
    # 60 repeats know a standard deviation to 9 %, and all targets of a plane are three numbers
    assert np.sqrt(np.mean((spread / claimed) ** 2)) == pytest.approx(1.0, abs=0.3)
    # a plane has no shape
    assert max(float(table.sigma_shape_mm.max()) for table in made) < 0.1 * claimed.min()


def test_frames_are_averaged(states: tuple[State, State]) -> None:
    one = states[0]
    assert combine_states([one]) is one
    assert one.centers is not None
    moved = Centers(one.centers.ids[5:], one.centers.center_px[5:] + 0.5)
    both = combine_states([State(one.poses, centers=one.centers), State(one.poses, one.image, moved)])
    assert both.image is one.image
    assert both.centers is not None
    assert both.centers.ids.tolist() == one.centers.ids.tolist()
    assert both.centers.center_px == pytest.approx(one.centers.center_px + np.where(np.arange(20) < 5, 0, 0.25)[:, None])
    assert combine_states([one, replace(one, centers=None)]).centers is None


def test_later_photographs_are_named_from_the_reference(states: tuple[State, State]) -> None:
    guess = later_hint(None, states[0])
    assert isinstance(guess, PoseGuess)
    assert guess.camera_from_dish is states[0].poses.camera_from_dish
    assert later_hint(Upright(), states[0]) == Upright()


def test_too_few_common_targets_are_told(states: tuple[State, State]) -> None:
    before, after = states[0].poses, states[1].poses
    left, right = only(before, np.arange(0, 10)), only(after, np.arange(10, 20))
    with pytest.raises(MeasurementError, match="no target in common"):
        compare_states(State(left), State(right), CAMERA, PLATE)
    with pytest.raises(MeasurementError, match="only 2 targets were measured in both photographs"):
        compare_states(State(left), State(only(after, np.arange(8, 20))), CAMERA, PLATE)


def test_a_surface_that_cannot_be_fitted_is_told(states: tuple[State, State]) -> None:
    result = compare_states(*states, CAMERA, PLATE, surface=Basis("zernike", 6))
    assert set(result.surfaces) == set()
    assert "20 targets are too few" in result.surface_problems["shape"]
    both = compare_states(*states, CAMERA, PLATE, method="all", surface=Basis("zernike", 6))
    assert (set(both.tables), both.paper, set(both.surface_problems)) == ({"joint"}, None, {"displacement", "shape", "paper"})
    with pytest.raises(FitError, match="too few"):
        compare_states(*states, CAMERA, PLATE, method="paper", surface=Basis("zernike", 6))
    for method, surface, message in (("paper", Basis("paraboloid"), "not a paraboloid"), ("guess", None, "unknown method 'guess'")):
        with pytest.raises(InputError, match=message):
            compare_states(*states, CAMERA, PLATE, method=method, surface=surface)


def test_a_rigid_body_has_no_shape(states: tuple[State, State]) -> None:
    # what all values share is no covariance at all: the surface must still be fitted
    result = compare_states(*states, CAMERA, PLATE, Priors(still=True))
    assert np.abs(result.table.shape_mm).max() < 1e-6
    assert np.abs(result.surfaces["shape"].coefficients).max() < 1e-6


def test_default_surfaces_have_targets_to_spare() -> None:
    bowl = dish(600.0, 300.0, 45.0)
    assert [default_basis(bowl, n) for n in (3, 18, 30, 44, 45, 500)] == [
        *(Basis(), Basis("zernike", 2), Basis("zernike", 3), Basis("zernike", 3), Basis("zernike", 4), Basis("zernike", 4)),
    ]
    assert default_basis(PLATE, 20) == Basis("polynomial", 2)


def test_figures_and_how_far_tables_are_apart(states: tuple[State, State]) -> None:
    table = compare_states(*states, CAMERA, PLATE).table
    numbers = figures_of(table)
    assert numbers.shape_rms_mm == pytest.approx(np.sqrt((table.shape_mm**2).mean()))
    assert abs(numbers.largest_shape_mm) == np.abs(table.shape_mm).max()
    other = replace(table, ids=table.ids + 5, shape_mm=np.roll(table.shape_mm, -5) + 0.5)
    between = apart(table, other)
    # ids 5 to 19 are in both: rows 5 to 19 of the one, 0 to 14 of the other
    assert between.targets == 15
    assert between.shape_rms_mm == pytest.approx(np.sqrt(np.mean((table.shape_mm[5:] - other.shape_mm[:15]) ** 2)))
    with pytest.raises(MeasurementError, match="no target in common"):
        apart(table, replace(table, ids=table.ids + 100))
