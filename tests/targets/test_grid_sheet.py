"""The joint estimate of a sheet: exact without noise, honest with it, and what does not fit is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sheets import CAMERA, PITCH_MM, TILTED, flat, on_cylinder, seen_places, sheet_of

from dishmap.errors import MeasurementError
from dishmap.simulate.deform import Deformation, ZernikeTerm, deform
from dishmap.targets.grid_builders import grid
from dishmap.targets.grid_sheet import estimate_sheet
from dishmap.targets.grid_spline import spline_over
from dishmap.targets.grid_start import start_control
from dishmap.targets.grid_system import Sizes, State, priors_at, system_at
from dishmap.targets.grid_terms import rough_rows, seen, strain_rows, terms_of
from dishmap.targets.pattern import Surface

# The splines follow a cylinder of 57 mm over cells of 12 mm to 0.0003 mm, and places are believed to 1e-4 px (0.00002 mm).
EXACT_MM = 1e-3
NOISE_PX = 0.01


def normal_error_deg(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    return np.degrees(np.arcsin(np.clip(np.linalg.norm(np.cross(found, true), axis=1), 0, 1)))


def chi2_per_number(error: np.ndarray, covariance: np.ndarray) -> float:
    return float(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error).mean() / error.shape[1])


def test_a_flat_pattern_comes_out_flat() -> None:
    pattern = flat()
    sheet = sheet_of(pattern, seen_places(pattern.center_mm), 1e-4)
    assert np.abs(sheet.place_mm - TILTED.apply(pattern.center_mm)).max() < EXACT_MM
    # 12 mm of lattice with 1e-4 px of trust: far below a thousandth of a degree would be the noise, the rest is the floor of learning
    assert normal_error_deg(sheet.normal, TILTED.rotate(pattern.normal)).max() < 0.002


@pytest.mark.parametrize("radius_mm", [57.0, -90.0])
def test_a_flat_pattern_on_a_cylinder_comes_out_as_one(radius_mm: float) -> None:
    """Nothing says that it is a cylinder; the lengths printed along it do."""
    pattern = flat()
    points = TILTED.apply(on_cylinder(pattern, radius_mm))
    sheet = sheet_of(pattern, CAMERA.project(points), 1e-4)
    assert np.abs(sheet.place_mm - points).max() < 20 * EXACT_MM
    inner = np.abs(pattern.center_mm[:, 0]) < 50
    angle = pattern.center_mm[:, 0] / radius_mm
    true = TILTED.rotate(np.column_stack([np.sin(angle), np.zeros(len(points)), np.cos(angle)]))
    # the surface ends within half a pitch of the outermost targets: their normals rest on one side only
    assert normal_error_deg(sheet.normal, true)[inner].max() < 0.1
    assert normal_error_deg(sheet.normal, true).max() < 1.0


def test_a_dish_comes_out_as_it_is_and_as_it_is_bent() -> None:
    pattern = grid(26, 26, 24.0, line_width_mm=1.0, surface=Surface("paraboloid", 600.0, 300.0))
    bent = deform(Deformation(zernike=(ZernikeTerm(2, 2, 1.0),)), pattern.surface, pattern.center_mm, 300.0)
    for points, most_mm in ((pattern.center_mm, 0.001), (bent, 0.03)):
        sheet = sheet_of(pattern, seen_places(points), 1e-3)
        error = sheet.place_mm - TILTED.apply(points)
        # astigmatism of 1 mm stretches a membrane by some 1e-5, and what is stretched looks nearer
        assert np.sqrt((error**2).mean(axis=0)).max() < most_mm


@pytest.mark.parametrize("case", ["plate", "cylinder", "print"])
def test_claimed_covariances_are_those_of_the_errors(case: str) -> None:
    pattern, rng = flat(), np.random.default_rng(5)
    points = on_cylinder(pattern, 80.0) if case == "cylinder" else pattern.center_mm
    scores, outside = [], []
    for _ in range(8):
        printed = points + (0.02 * rng.normal(size=points.shape) * [1, 1, 0] if case == "print" else 0.0)
        measured = seen_places(printed) + NOISE_PX * rng.normal(size=(len(points), 2))
        sheet = sheet_of(pattern, measured, NOISE_PX)
        error = sheet.place_mm - TILTED.apply(printed)
        scores.append(chi2_per_number(error, sheet.covariance[:, :3, :3]))
        outside.append(float((np.abs(error[:, 2]) > 1.96 * np.sqrt(sheet.covariance[:, 2, 2])).mean()))
    # errors of neighbours go together, so that a sheet is worth a few dozen numbers: +-0.3 over eight of them
    assert 0.2 < np.mean(scores) < 1.6
    assert np.mean(outside) < 0.12


def test_depth_comes_near_the_bound() -> None:
    """Of a plate that is known to be rigid and flat the bound is that of its six numbers; not knowing it may cost no more than twice."""
    pattern, rng = flat(), np.random.default_rng(7)
    points = TILTED.apply(pattern.center_mm)
    _, by_point = CAMERA.project_with_point_jacobian(points)
    arm = points - points.mean(axis=0)
    cross = np.zeros((len(points), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 0], cross[:, 1, 2], cross[:, 2, 0], cross[:, 2, 1] = (
        *(arm[:, 2], -arm[:, 1]),
        *(-arm[:, 2], arm[:, 0]),
        *(arm[:, 1], -arm[:, 0]),
    )
    moves = np.concatenate([np.broadcast_to(np.eye(3), (len(points), 3, 3)), cross], axis=2)
    rows = (by_point @ moves).reshape(-1, 6) / NOISE_PX
    bound = np.sqrt(np.einsum("nj,jk,nk->n", moves[:, 2], np.linalg.inv(rows.T @ rows), moves[:, 2]))
    error = []
    for _ in range(8):
        sheet = sheet_of(pattern, CAMERA.project(points) + NOISE_PX * rng.normal(size=(len(points), 2)), NOISE_PX)
        error.append(sheet.place_mm[:, 2] - points[:, 2])
    assert np.sqrt(np.mean(np.square(error))) < 2 * np.sqrt(np.mean(bound**2))


def test_targets_off_the_surface_are_put_aside_and_do_no_harm() -> None:
    pattern, rng = flat(), np.random.default_rng(3)
    points = on_cylinder(pattern, 80.0)
    measured = seen_places(points) + NOISE_PX * rng.normal(size=(len(points), 2))
    wrong = rng.permutation(len(points))[:5]
    spoilt = measured.copy()
    spoilt[wrong] += 1.5 * np.sign(rng.normal(size=(5, 2)))
    clean, sheet = sheet_of(pattern, measured, NOISE_PX), sheet_of(pattern, spoilt, NOISE_PX)
    assert sorted(np.flatnonzero(~sheet.used)) == sorted(wrong)
    good = sheet.used
    error = [np.sqrt(((s.place_mm - TILTED.apply(points))[good] ** 2).sum(axis=1).mean()) for s in (clean, sheet)]
    assert error[1] < 1.3 * error[0]


def test_squares_measure_their_own_spread() -> None:
    """Corners 0.1 mm outside of their printed places: found, and no depth is lost to it."""
    pattern = grid(10, 8, PITCH_MM, square_mm=5.0)
    half = 2.5 + 0.1
    corners = half * np.array([[1.0, 1], [-1, 1], [-1, -1], [1, -1]])
    points = pattern.center_mm[:, None] + np.pad(corners, ((0, 0), (0, 1)))
    pixels = CAMERA.project(TILTED.apply(points))
    measured = np.concatenate([pixels.mean(axis=1), *((pixels * s[:, None]).sum(axis=1) / 4 for s in np.sign(corners).T)], axis=1)
    sheet = sheet_of(pattern, measured + 1e-3 * np.random.default_rng(1).normal(size=measured.shape), 1e-3)
    assert abs(sheet.spread_mm - 0.1) < 4 * sheet.sigma_spread_mm
    assert sheet.sigma_spread_mm < 1e-3
    assert np.abs(sheet.place_mm - TILTED.apply(pattern.center_mm)).max() < 0.01


def test_what_the_camera_does_is_what_another_camera_gives() -> None:
    pattern = flat(8, 7)
    measured = seen_places(on_cylinder(pattern, 120.0)) + NOISE_PX * np.random.default_rng(2).normal(size=(len(pattern), 2))
    sheet = sheet_of(pattern, measured, NOISE_PX)
    for number, step in ((0, 0.3), (2, 0.3), (4, 1e-3)):
        parameters = CAMERA.parameters.copy()
        parameters[number] += step
        other = sheet_of(pattern, measured, NOISE_PX, camera=CAMERA.with_parameters(parameters))
        change = other.place_mm - sheet.place_mm
        # sizes are learnt anew with the other camera, which moves places by a part of their sigma
        room = 0.05 * np.abs(change).max() + 0.1 * np.sqrt(sheet.covariance[:, 2, 2].max())
        assert np.abs(change - step * sheet.by_camera[:, :3, number]).max() < room


def test_rows_are_the_derivatives_of_their_terms() -> None:
    """Every row of the normal equations against central differences, on a bent sheet of squares."""
    pattern = grid(6, 5, PITCH_MM, square_mm=5.0)
    rng, index = np.random.default_rng(0), np.arange(len(pattern))
    measured = np.tile(np.eye(6)[0], (len(pattern), 1))
    measured[:, :2] = seen_places(on_cylinder(pattern, 60.0))
    spline, covariance = spline_over(pattern.lattice.astype(float), 4), np.tile(np.eye(6), (len(pattern), 1, 1))
    terms = terms_of(CAMERA, pattern, spline, index, measured, covariance)
    control = start_control(terms)
    move, step = rng.normal(size=control.shape), 1e-4
    cells = move[terms.spline.controls].reshape(terms.spline.cells, -1)
    up, down = control + step * move, control - step * move
    slope = (seen(terms, up, 0.1).value - seen(terms, down, 0.1).value) / (2 * step)
    view = seen(terms, control, 0.1)
    assert np.abs(np.einsum("nmk,nk->nm", view.by_cell, cells[terms.cell]) - slope).max() < 1e-6 * np.abs(slope).max()
    slope = (seen(terms, control, 0.1 + step).value - seen(terms, control, 0.1 - step).value) / (2 * step)
    assert np.abs(view.by_spread - slope).max() < 1e-6 * np.abs(slope).max()
    for rows in (strain_rows, rough_rows):
        slope = (rows(terms, up)[0] - rows(terms, down)[0]) / (2 * step)
        assert np.abs(np.einsum("crk,ck->cr", rows(terms, control)[1], cells) - slope).max() < 1e-5 * np.abs(slope).max()


def test_the_gradient_is_that_of_the_cost() -> None:
    pattern, rng = flat(6, 5), np.random.default_rng(4)
    measured = seen_places(on_cylinder(pattern, 100.0)) + 0.05 * rng.normal(size=(len(pattern), 2))
    covariance = np.tile(1e-4 * np.eye(2), (len(pattern), 1, 1))
    terms = terms_of(CAMERA, pattern, spline_over(pattern.lattice.astype(float), 8), np.arange(len(pattern)), measured, covariance)
    used, sizes = np.ones(len(pattern), bool), Sizes(1e-3, 1e-3, 1e-4, 0.02)
    state = State(start_control(terms), 1e-4 * rng.normal(size=terms.strain_shapes.shape[2]))
    system = system_at(terms, state, sizes, used)
    move, shared, step = rng.normal(size=state.control_mm.shape), 1e-4 * rng.normal(size=len(state.shared)), 1e-4

    def cost(part: float) -> float:
        # the weights of places go with the surface; they are held where the gradient is taken
        at = State(state.control_mm + part * move, state.shared + part * shared)
        residual = terms.measured - seen(terms, at.control_mm, 0.0).value
        strain, rough = priors_at(terms, at)
        own = np.einsum("ni,nij,nj->", residual, system.weight, residual) + (at.shared**2).sum() / sizes.smooth_strain**2
        return float(own + (strain.value**2).sum() / sizes.strain**2 + (rough.value**2).sum() / sizes.rough_mm**2)

    slope = (cost(step) - cost(-step)) / (2 * step)
    vector = np.zeros(terms.spline.unknowns)
    vector[: move.size] = move.ravel()
    assert -2 * (system.right @ vector + system.right_shared @ shared) == pytest.approx(slope, rel=1e-5)


def test_learning_finds_the_size_of_printing_errors() -> None:
    pattern, rng = flat(16, 14), np.random.default_rng(6)
    points = pattern.center_mm + 0.05 * rng.normal(size=pattern.center_mm.shape) * [1, 1, 0]
    measured = seen_places(points) + NOISE_PX * rng.normal(size=(len(pattern), 2))
    sheet = sheet_of(pattern, measured, NOISE_PX)
    # 448 numbers give a size to 3 %, of which the surface takes a share
    assert sheet.sizes.print_mm == pytest.approx(0.05, rel=0.15)


def test_holes_and_a_ragged_border_are_no_hindrance() -> None:
    pattern, rng = flat(), np.random.default_rng(8)
    index = np.flatnonzero(rng.uniform(size=len(pattern)) < 0.6)
    points = TILTED.apply(on_cylinder(pattern, 80.0))[index]
    sheet = sheet_of(pattern, CAMERA.project(points) + NOISE_PX * rng.normal(size=(len(index), 2)), NOISE_PX, index)
    assert chi2_per_number(sheet.place_mm - points, sheet.covariance[:, :3, :3]) < 2.0


def test_too_little_or_nonsense_is_refused() -> None:
    pattern, rng = flat(), np.random.default_rng(9)
    measured = seen_places(pattern.center_mm)
    row = np.flatnonzero(pattern.lattice[:, 1] == 3)
    with pytest.raises(MeasurementError, match="12 targets in 12 columns and 1 rows of the grid were measured; a surface needs at least 6"):
        sheet_of(pattern, measured[row], 0.01, row)
    with pytest.raises(MeasurementError, match=r"off any smooth surface|did not settle"):
        sheet_of(pattern, measured[rng.permutation(len(pattern))], 0.01)


def test_progress_is_told() -> None:
    pattern, told = flat(6, 5), []
    covariance = np.tile(1e-4 * np.eye(2), (len(pattern), 1, 1))
    measured = seen_places(pattern.center_mm)
    estimate_sheet(CAMERA, pattern, np.arange(len(pattern)), measured, covariance, lambda done, total: told.append((done, total)))
    assert told
    assert all(0 < done <= total for done, total in told)


def test_a_larger_camera_scale_moves_the_sheet_nearer() -> None:
    """A photograph scaled about the camera's centre is that of a sheet that is nearer: nothing printed says otherwise."""
    pattern = flat()
    measured = seen_places(pattern.center_mm)
    near = sheet_of(pattern, measured, 0.001)
    smaller = replace(pattern, center_mm=pattern.center_mm * 0.99, lines=pattern.lines)
    other = sheet_of(smaller, measured, 0.001)
    assert np.median(other.place_mm[:, 2] / near.place_mm[:, 2]) == pytest.approx(0.99, abs=1e-5)
