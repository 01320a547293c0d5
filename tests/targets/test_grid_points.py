"""Crossings and squares fitted to raw pixels: exact without noise, honest with it, on flat and curved sheets through a bending lens."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from grid_drawing import Drawing, Lift, bowl, cylinder, facing, flat, line_grid, square_grid
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from dishmap.camera.model import Camera
from dishmap.errors import ImageError, InputError, MeasurementError, PatternError
from dishmap.quality import Quality
from dishmap.targets.builders import disc, plate
from dishmap.targets.grid_points import GridPoints, measure_grid
from dishmap.targets.pattern import Pattern

Array = NDArray[np.float64]

# A lens of 30 degrees that moves the corners by 8 px.
CAMERA = Camera(480, 480, [900.0, 900.0], [239.5, 239.5], [-0.4, 0.1, 0.001, -0.0005, 0.0])
PITCH_MM, DISTANCE_MM, PSF_PX = 12.0, 290.0, 0.8
# A thousandth of what noise leaves: rms and largest error of nodes that have all 24 neighbours. What is left are the pixels' square shape
# (0.1 % of the contrast) and neighbours at the border.
EXACT_PX, FARTHEST_PX = 1e-4, 3e-4
# A crossing that lost an arm leans on the slope that its neighbours give the other one.
LOST_ARM_PX = 2e-3
# Nodes with neighbours on one side only are led by a map that is extrapolated: the fifth power of a step on a cylinder of 100 mm.
BORDER_PX = 8e-3
# 80 nodes with two coordinates each: chi-square over its expectation is known to 11 %; three of that.
CHI_SQUARE_PART = 0.33
START_PX = 0.3


@cache
def drawn(pattern_name: str, shape: str, turn_deg: tuple[float, float, float], wider_mm: float = 0.0) -> tuple[Pattern, Drawing]:
    light_mm = 2.0 if pattern_name == "open" else 0.0
    pattern = line_grid(9, 9, PITCH_MM, 1.0) if pattern_name == "lines" else square_grid(9, 9, PITCH_MM, 5.0, light_mm)
    lift: Lift = {"flat": flat, "bowl": bowl(150.0), "cylinder": cylinder(100.0)}[shape]
    drawing = Drawing(CAMERA, facing(DISTANCE_MM, turn_deg), lift, PSF_PX)
    drawing.add_pattern(pattern, wider_mm)
    return pattern, drawing


def measured(pattern: Pattern, drawing: Drawing, image: Array, rng: np.random.Generator) -> GridPoints:
    place = drawing.place_px(pattern.center_mm[:, :2])
    index = np.flatnonzero(CAMERA.contains(place, margin_px=8.0))
    return measure_grid(image, pattern, index, place[index] + rng.uniform(-START_PX, START_PX, (len(index), 2)))


def truth(pattern: Pattern, drawing: Drawing, points: GridPoints, wider_mm: float = 0.0) -> Array:
    """Measured vectors (N, 2) or (N, 6) without error; of squares, whose edges lie outwards by `wider_mm`."""
    center = pattern.center_mm[points.index, :2]
    if pattern.lines:
        return drawing.place_px(center)
    corners_mm = pattern.kind_of(0).polygons[0].corners_mm
    corners = drawing.place_px(center[:, None] + corners_mm + wider_mm * np.sign(corners_mm))
    low_left, low_right, high_right, high_left = np.moveaxis(corners, 1, 0)
    half_x, half_y = (low_right + high_right - low_left - high_left) / 4, (high_left + high_right - low_left - low_right) / 4
    return np.concatenate([corners.mean(axis=1), half_x, half_y], axis=1)


def vector(points: GridPoints) -> Array:
    if points.half_px is None:
        return points.center_px
    return np.concatenate([points.center_px, points.half_px[..., 0], points.half_px[..., 1]], axis=1)


def inner(pattern: Pattern, points: GridPoints, ring: int = 1) -> NDArray[np.bool_]:
    assert pattern.lattice is not None
    lattice = pattern.lattice[points.index]
    return np.asarray(((lattice > lattice.min(axis=0) + ring) & (lattice < lattice.max(axis=0) - ring)).all(axis=1))


TILTED, IN_BOWL = ("flat", (25.0, 20.0, 10.0)), ("bowl", (15.0, 20.0, 30.0))
SHEETS = [("flat", (0.0, 0.0, 0.0)), TILTED, IN_BOWL, ("cylinder", (10.0, 10.0, 10.0))]


SCENES = [*(("lines", *sheet) for sheet in SHEETS), *(("squares", *sheet) for sheet in SHEETS), ("open", *IN_BOWL)]


@pytest.mark.parametrize(("name", "shape", "turn_deg"), SCENES)
def test_exact_without_noise(name: str, shape: str, turn_deg: tuple[float, float, float]) -> None:
    pattern, drawing = drawn(name, shape, turn_deg)
    points = measured(pattern, drawing, drawing.image(), np.random.default_rng(1))
    error = (vector(points) - truth(pattern, drawing, points))[:, :2]
    assert len(points) >= 75
    whole = error[inner(pattern, points)]
    assert np.sqrt(np.mean(whole**2)) < EXACT_PX
    assert np.abs(whole).max() < FARTHEST_PX
    assert np.abs(error).max() < BORDER_PX
    assert np.median(points.blur_px) == pytest.approx(np.hypot(PSF_PX, 12**-0.5), rel=0.01)


@pytest.mark.parametrize("name", ["lines", "squares"])
def test_sigmas_are_true(name: str) -> None:
    pattern, drawing = drawn(name, *IN_BOWL)
    rng = np.random.default_rng(2)
    image = drawing.image() + 4 * rng.standard_normal(drawing.cover.shape)
    points = measured(pattern, drawing, image, rng)
    error = vector(points) - truth(pattern, drawing, points)
    square = np.einsum("ni,nij,nj->n", error, points.information, error) / error.shape[1]
    assert abs(square.mean() - 1) < CHI_SQUARE_PART
    assert np.median(points.noise) == pytest.approx(4.0, rel=0.05)
    # 2.6 edges' lengths of 18 px each way: see `targets.bound.edge_sigma_px`
    assert np.sqrt(np.mean(error[:, :2] ** 2)) < 0.02


@pytest.mark.parametrize("name", ["lines", "squares"])
@pytest.mark.parametrize(("gamma", "spread_px"), [(1.0, (0.1, 0.2)), (2.2, (-0.3, -0.05))])
def test_ink_spread_and_tone_curve_leave_places(name: str, gamma: float, spread_px: tuple[float, float]) -> None:
    pattern, drawing = drawn(name, *TILTED, 0.05)
    rng = np.random.default_rng(3)
    image = 255 * (drawing.image(200.0, 20.0) / 255) ** (1 / gamma)
    points = measured(pattern, drawing, image, rng)
    error = (vector(points) - truth(pattern, drawing, points, 0.05))[:, :2]
    # a tenth of what noise of 4 grey levels does
    assert np.sqrt(np.mean(error[inner(pattern, points)] ** 2)) < 0.1 * 0.006
    # 0.05 mm at 2.8 px/mm; a tone curve that lifts dark greys moves edges inwards
    assert spread_px[0] < np.median(points.spread_px) < spread_px[1]


def test_a_line_that_is_broken_or_hidden() -> None:
    pattern, drawing = drawn("lines", "flat", (15.0, 20.0, 30.0))
    image = drawing.image()
    places = drawing.place_px(pattern.center_mm[:, :2])
    # rub out the arm to the upper column of each fifth node, from one line's edge to half way
    rows = np.arange(20, 61, 4)
    gone = Drawing(CAMERA, drawing.pose, flat, PSF_PX)
    for x, y in pattern.center_mm[rows, :2]:
        gone.add_box((x - 0.5, x + 0.5), (y + 0.5, y + PITCH_MM / 2))
    image = image + 170.0 * gone.cover
    points = measured(pattern, drawing, image, np.random.default_rng(4))
    hit = np.isin(points.index, rows)
    error = points.center_px - places[points.index]
    assert hit.sum() == len(rows)
    assert np.abs(error[inner(pattern, points)]).max() < LOST_ARM_PX
    assert (points.quality[hit] & int(Quality.OCCLUDED | Quality.GLARE) > 0).all()
    assert points.kept[hit].max() < 0.9 < np.median(points.kept[~hit & inner(pattern, points)])


def test_lines_in_one_direction_are_no_crossing() -> None:
    pattern, drawing = drawn("lines", "flat", (0.0, 0.0, 0.0))
    rows = np.flatnonzero((pattern.lattice == [4, 4]).all(axis=1)) if pattern.lattice is not None else np.zeros(0)
    gone = Drawing(CAMERA, drawing.pose, flat, PSF_PX)
    x, y = pattern.center_mm[rows[0], :2]
    gone.add_box((x - 0.5, x + 0.5), (y + 0.5, y + PITCH_MM / 2))
    gone.add_box((x - 0.5, x + 0.5), (y - PITCH_MM / 2, y - 0.5))
    points = measured(pattern, drawing, drawing.image() + 170 * gone.cover, np.random.default_rng(5))
    assert rows[0] not in points.index
    assert (int(pattern.ids[rows[0]]), "lines are seen in one direction only") in points.rejected


def test_bad_input_is_named() -> None:
    pattern, drawing = drawn("lines", "flat", (0.0, 0.0, 0.0))
    image, place = drawing.image(), drawing.place_px(pattern.center_mm[:, :2])
    every = np.arange(len(pattern))
    with pytest.raises(ImageError, match="one grey picture"):
        measure_grid(np.zeros((4, 4, 3)), pattern, every, place)
    with pytest.raises(PatternError, match="is no grid"):
        measure_grid(image, plate(3, 3, 45.0, disc()), every[:9], place[:9])
    with pytest.raises(InputError, match="given twice"):
        measure_grid(image, pattern, np.array([0, 0]), place[:2])
    with pytest.raises(InputError, match="not finite"):
        measure_grid(image, pattern, every[:2], np.array([[1.0, np.nan], [2.0, 2.0]]))
    with pytest.raises(InputError, match="one place in the image for each"):
        measure_grid(image, pattern, every[:2], place[:3])
    with pytest.raises(MeasurementError, match="neighbours in two directions"):
        measure_grid(image, pattern, every[:3], place[:3])
    with pytest.raises(MeasurementError, match="no node of the grid could be measured"):
        measure_grid(np.full(image.shape, 128.0), pattern, every, place)


def test_things_in_front_are_left_out_or_named() -> None:
    """Dark, grey and bright discs over the grid, two to ten line widths across: none is taken for a crossing, and sigmas hold."""
    pattern, drawing = drawn("lines", *IN_BOWL)
    places = drawing.place_px(pattern.center_mm[:, :2])
    square, total = [], 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        cover, level = np.zeros(drawing.cover.shape), np.zeros(drawing.cover.shape)
        v, u = np.mgrid[: cover.shape[0], : cover.shape[1]]
        for _ in range(12):
            inside = (u - rng.uniform(60, 420)) ** 2 + (v - rng.uniform(60, 420)) ** 2 < rng.uniform(3, 14) ** 2
            cover[inside], level[inside] = 1.0, rng.choice([20.0, 100.0, 240.0])
        image = drawing.image() * (1 - gaussian_filter(cover, PSF_PX)) + gaussian_filter(level, PSF_PX)
        points = measured(pattern, drawing, np.clip(image + 4 * rng.standard_normal(image.shape), 0, 255), rng)
        error = points.center_px - places[points.index]
        square.append(np.einsum("ni,nij,nj->n", error, points.information, error) / 2)
        total += len(points)
        assert (points.quality > 0).sum() >= 5
    assert total > 0.95 * 3 * len(pattern)
    # 4.5 sigmas in two coordinates, which one of 25 000 exceeds
    assert np.concatenate(square).max() < 10.2
