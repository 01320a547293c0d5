"""The bound of a grid's nodes against the closed form of straight edges, and against what the fit reaches."""

from __future__ import annotations

import numpy as np
import pytest
from grid_drawing import Drawing, facing, flat, line_grid, square_grid
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.errors import InputError
from dishmap.targets.bound import edge_sigma_px
from dishmap.targets.grid_bound import grid_bound
from dishmap.targets.grid_points import measure_grid
from dishmap.targets.pattern import Pattern

Array = NDArray[np.float64]

CAMERA = Camera(300, 300, [900.0, 900.0], [149.5, 149.5])
PSF_PX, CONTRAST = 0.8, 40.0
# 12 mm seen as 36 px.
DISTANCE_MM, PITCH_PX = 300.0, 36.0
# What unknown light and the end of the band at 2.5 blurs cost, and whole pixels at both ends of an edge.
CLOSED_FORM_PART = 0.12
# A plane of light over a square alone can pass for a part of its move, levels of ground and ink for a part of its size.
SQUARE_PART, HALF_PART = 0.2, 0.3
# 25 nodes, two coordinates, eight photographs: an rms is known to 3.5 %; three of that, and what directions cost.
EFFICIENCY = 0.88


def places(pattern: Pattern) -> Array:
    return CAMERA.project(facing(DISTANCE_MM).apply(pattern.center_mm))


def middle_sigma_px(pattern: Pattern, contrast: float = CONTRAST) -> Array:
    every = np.arange(len(pattern))
    information = grid_bound(pattern, every, places(pattern), (300, 300), contrast, PSF_PX)
    return np.sqrt(np.diagonal(np.linalg.inv(information[len(every) // 2])))


def test_crossing_is_two_edges_of_each_line() -> None:
    """Each coordinate has two edges of a pitch less the other line's width and its blur."""
    width_px = 4.0
    sigma = middle_sigma_px(line_grid(7, 7, 12.0, width_px / 3))
    edge = edge_sigma_px(float(np.hypot(PSF_PX, 12**-0.5)), CONTRAST)
    np.testing.assert_allclose(sigma, edge / np.sqrt(2 * (PITCH_PX - width_px)), rtol=CLOSED_FORM_PART)


def test_square_is_two_edges_each_way() -> None:
    sigma = middle_sigma_px(square_grid(7, 7, 12.0, 6.0))
    edge = edge_sigma_px(float(np.hypot(PSF_PX, 12**-0.5)), CONTRAST)
    # the middle, and half the size, from the mean of two edges of 18 px
    np.testing.assert_allclose(sigma[:2], edge / np.sqrt(2 * 18.0), rtol=SQUARE_PART)
    np.testing.assert_allclose(sigma[[2, 5]], edge / np.sqrt(2 * 18.0), rtol=HALF_PART)


def test_sigma_is_inverse_to_contrast() -> None:
    pattern = line_grid(7, 7, 12.0, 1.0)
    np.testing.assert_allclose(middle_sigma_px(pattern) / middle_sigma_px(pattern, 3 * CONTRAST), 3.0, rtol=0.01)


@pytest.mark.parametrize("pattern", [line_grid(7, 7, 12.0, 1.0), square_grid(7, 7, 12.0, 5.0)], ids=["lines", "squares"])
def test_the_fit_reaches_the_bound(pattern: Pattern) -> None:
    drawing = Drawing(CAMERA, facing(DISTANCE_MM), flat, PSF_PX)
    drawing.add_pattern(pattern)
    place, every = places(pattern), np.arange(len(pattern))
    assert pattern.lattice is not None
    inner = ((pattern.lattice > 0) & (pattern.lattice < 6)).all(axis=1)
    information = grid_bound(pattern, every, place, (300, 300), CONTRAST, PSF_PX)
    square = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        image = drawing.image(200.0, 30.0) + 170.0 / CONTRAST * rng.standard_normal(drawing.cover.shape)
        points = measure_grid(image, pattern, every, place + rng.uniform(-0.3, 0.3, place.shape))
        assert len(points) == len(pattern)
        error = points.center_px - place
        least = np.linalg.inv(information)[:, :2, :2]
        square.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(least), error)[inner] / 2)
    # squares' corners have no perspective here: the mean of their images is the image of the middle
    assert 1 / np.sqrt(np.mean(square)) > EFFICIENCY


def test_nonsense_is_refused() -> None:
    pattern = line_grid(3, 3, 12.0, 1.0)
    with pytest.raises(InputError, match="positive contrast-to-noise"):
        grid_bound(pattern, np.arange(9), places(pattern), (300, 300), 0.0, 0.8)
