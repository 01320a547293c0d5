"""Grids are found and numbered: against exact drawings, through lens, tilt, bent surfaces, breaks and holes."""

from __future__ import annotations

import numpy as np
import pytest

from dishmap.errors import IdentityError, ImageError
from dishmap.targets.grid_detect import find_grid
from tests.grids import GridScene, box, camera, line_photograph, look, matched, photograph, square_photograph

# What the record promises of places is some tenths of a pixel; a node one step off would be 20 px off.
PLACE_RMS_PX, PLACE_WORST_PX = 0.15, 0.8
SMALL = {"columns": 14, "rows": 11}


def dish(xy_mm: np.ndarray) -> np.ndarray:
    return np.asarray((xy_mm**2).sum(axis=-1) / (4 * 60.0))


def cylinder(xy_mm: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(110.0**2 - xy_mm[..., 0] ** 2) - 110.0)


@pytest.mark.parametrize(
    ("tilt", "roll", "distance", "surface", "blur"),
    [(0.0, 0.0, 250.0, None, 0.8), (55.0, 20.0, 260.0, None, 0.8), (20.0, 130.0, 220.0, dish, 0.8), (10.0, -70.0, 240.0, cylinder, 2.2)],
)
def test_crossings_are_found_and_numbered(tilt: float, roll: float, distance: float, surface: object, blur: float) -> None:
    scene = GridScene(camera(), look(tilt, 40.0, roll, distance), **SMALL, **({"height_mm": surface} if surface else {}))
    cells = [(3, 2), (9, 7), (5, 4)]
    found = find_grid(line_photograph(scene, np.random.default_rng(1), blur, broken=0.15, marked=cells), lines=True)
    place = scene.pixels(scene.lattice())
    inside = ((place > 6) & (place < [633, 473])).all(axis=1).sum()
    main = found.component == 0
    away, nearest, wrong = matched(scene, found.place_px[main], found.lattice[main])
    assert wrong == 0
    assert main.sum() >= 0.97 * inside
    assert np.sqrt((away**2).mean() / 2) < PLACE_RMS_PX * max(1.0, blur)
    assert away.max() < PLACE_WORST_PX * max(1.0, blur)
    # marked cells are found, whatever the frame's quarter turn: the mean of a cell's corners is in its middle
    middles = [
        nearest[(np.abs(found.lattice[main] - cell[1:] - 0.5) < 1).all(axis=1)].mean(axis=0) for cell in found.cell_marked if cell[0] == 0
    ]
    shown = [c for c in cells if all((nearest == [c[0] + i, c[1] + j]).all(axis=1).any() for i in (0, 1) for j in (0, 1))]
    assert sorted(tuple(m - 0.5) for m in middles) == sorted(shown)
    assert len(shown) >= 2


@pytest.mark.parametrize(("tilt", "roll", "surface"), [(0.0, 0.0, None), (55.0, 20.0, None), (10.0, 130.0, cylinder)])
def test_squares_are_found_and_numbered(tilt: float, roll: float, surface: object) -> None:
    scene = GridScene(camera(), look(tilt, 40.0, roll, 260.0), **SMALL, **({"height_mm": surface} if surface else {}))
    missing = [(6, 5), (7, 5), (2, 8)]
    image = square_photograph(scene, np.random.default_rng(2), opened=[(5, 5), (8, 3), (4, 6)], missing=missing)
    found = find_grid(image, lines=False)
    away, nearest, wrong = matched(scene, found.place_px, found.lattice)
    assert wrong == 0
    assert (found.component == 0).all()
    place = scene.pixels(scene.lattice())
    # a square of 14 px must be whole in the picture
    inside = ((place > 20) & (place < [619, 459])).all(axis=1).sum() - len(missing)
    assert len(found) >= inside
    assert np.sqrt((away**2).mean() / 2) < PLACE_RMS_PX
    assert sorted(map(tuple, nearest[found.marked].tolist())) == [(4, 6), (5, 5), (8, 3)]


def test_axes_are_right_handed_and_steps_are_those_of_the_places() -> None:
    scene = GridScene(camera(), look(30.0, 10.0, 75.0), **SMALL)
    found = find_grid(line_photograph(scene, np.random.default_rng(3)), lines=True)
    assert (np.linalg.det(found.step_px) < 0).all()
    numbers = {tuple(at): i for i, at in enumerate(found.lattice.tolist())}
    pairs = np.array([(i, numbers[c + 1, r]) for (c, r), i in numbers.items() if (c + 1, r) in numbers])
    difference = found.place_px[pairs[:, 1]] - found.place_px[pairs[:, 0]]
    mean = found.step_px[pairs].mean(axis=1)[..., 0]
    # the mean of the slopes at both ends is the step, but for third derivatives and the places' noise
    assert np.abs(mean - difference).max() < 0.5


def test_a_reader_of_16_bits_finds_the_same() -> None:
    scene = GridScene(camera(), look(15.0), **SMALL)
    image = line_photograph(scene, np.random.default_rng(4))
    eight, sixteen = find_grid(image, lines=True), find_grid(image.astype(np.uint16) * 16, lines=True)
    assert len(eight) == len(sixteen)
    assert np.abs(eight.place_px - sixteen.place_px).max() < 0.1


def test_two_halves_that_a_wide_strip_hides_are_not_joined_by_guessing() -> None:
    scene = GridScene(camera(), look(0.0), **SMALL)
    image = line_photograph(scene, np.random.default_rng(5))
    image[:, 260:380] = 90
    found = find_grid(image, lines=True)
    # five of the lattice's steps are hidden: too far for a prediction
    assert found.component.max() == 1
    for part in range(2):
        main = found.component == part
        assert matched(scene, found.place_px[main], found.lattice[main])[2] == 0


def test_a_narrow_strip_is_bridged() -> None:
    scene = GridScene(camera(), look(0.0), **SMALL)
    image = line_photograph(scene, np.random.default_rng(5))
    image[:, 300:345] = 90
    found = find_grid(image, lines=True)
    assert (found.component == 0).all()
    assert matched(scene, found.place_px, found.lattice)[2] == 0


def test_one_row_or_no_grid_is_refused() -> None:
    row = GridScene(camera(), look(0.0), columns=14, rows=1)
    with pytest.raises(IdentityError, match="more than two rows of it are in view"):
        find_grid(square_photograph(row, np.random.default_rng(6)), lines=False)
    noise = np.random.default_rng(7).normal(120, 20, (480, 640)).clip(0, 255).astype(np.uint8)
    for lines in (False, True):
        with pytest.raises(IdentityError, match="no lattice of three by three"):
            find_grid(noise, lines)


@pytest.mark.parametrize("lines", [True, False])
def test_a_chessboard_is_none_of_both(lines: bool) -> None:
    scene = GridScene(camera(), look(15.0, roll_deg=20.0), **SMALL)
    fields = [box((c - 0.5, r - 0.5), (c + 0.5, r + 0.5)) for c, r in scene.lattice().tolist() if (c + r) % 2 == 0]
    image = photograph(scene.coverage(fields, 1.0), np.random.default_rng(8), 1.0)
    with pytest.raises(IdentityError, match="the photograph shows a chessboard, and the pattern is"):
        find_grid(image, lines)


def test_the_other_kind_of_grid_is_named() -> None:
    scene = GridScene(camera(), look(15.0), **SMALL)
    with pytest.raises(IdentityError, match="shows a grid of lines, and the pattern is one of squares"):
        find_grid(line_photograph(scene, np.random.default_rng(9)), lines=False)
    with pytest.raises(IdentityError, match="shows separate squares, and the pattern is a grid of lines"):
        find_grid(square_photograph(scene, np.random.default_rng(9)), lines=True)


TOO_FINE = [(1800.0, r"lines are 4\.\d px apart, and 5 are needed"), (3100.0, r"with a period of 2\.7 px, too fine")]


@pytest.mark.parametrize(("distance", "message"), TOO_FINE)
def test_a_grid_too_fine_is_refused(distance: float, message: str) -> None:
    scene = GridScene(camera(480, 360), look(5.0, 40.0, 20.0, distance), columns=60, rows=60)
    with pytest.raises(IdentityError, match=message):
        find_grid(line_photograph(scene, np.random.default_rng(10), blur_px=0.6), lines=True)


def test_other_arrays_are_refused() -> None:
    with pytest.raises(ImageError, match="searched in a grey image"):
        find_grid(np.zeros((5, 5, 3), dtype=np.uint8), lines=True)
