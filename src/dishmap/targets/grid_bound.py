"""The Cramer-Rao bound of a grid's nodes in the image: what no unbiased fit can beat for given contrast, noise and blur.

`grid_information` says what it means for places, turns and the ink's spread, of targets where the undeformed pattern lies.
It comes from the same model and pixels as the fit: white noise, and light, widths and blur unknown at every node. Directions and curvatures
of lines count as known, as they are but for a few per cent where neighbours are seen.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.errors import InputError, MeasurementError
from dishmap.targets.bound import PIXEL_VARIANCE_PX2
from dishmap.targets.grid_arms import clear_of_ends
from dishmap.targets.grid_fit import BEND, BLUR, HALF, HELD, INNER, LIGHT, NESTED, PLAIN, coverage, light_rows
from dishmap.targets.grid_outcome import information_of, measured_vector
from dishmap.targets.grid_pixels import node_pixels
from dishmap.targets.grid_shapes import node_shapes
from dishmap.targets.grid_sheet import by_own_motion
from dishmap.targets.grid_stages import FULL_AT_ONCE, REACH_BLURS, REACH_EXTRA_PX, chunks
from dishmap.targets.grid_terms import CORNERS, MEASURED
from dishmap.targets.lattice_map import lattice_maps
from dishmap.targets.pattern import Pattern
from dishmap.transforms import Pose

Array = NDArray[Any]
Index = NDArray[np.int64]

# Ink over ground, which hardly matters.
INK_SHARE = 0.15
# Knowing next to nothing, and knowing all, of a parameter.
FREE, FIXED = 1e-9, 1e12
SMOOTH_PX = 1e-3


def grid_bound(
    pattern: Pattern, index: Index, place_px: Array, size_px: tuple[int, int], contrast_to_noise: float, psf_sigma_px: float
) -> Array:
    """Least inverse covariance (K, 2, 2) of crossings' places, or (K, 6, 6) of rectangles' measured vectors as in `GridPoints`.

    Nodes `index` (K,) of a grid pattern are seen at places (K, 2) of an image of `size_px` (width, height); contrast_to_noise: ground
    minus ink over the noise of a pixel; psf_sigma_px: blur of the optics. Zeros where no edge is in the image or neighbours do not show
    the lattice. Raises InputError for impossible numbers, PatternError if the pattern is no grid, MeasurementError without neighbours.
    """
    if not (contrast_to_noise > 0 and psf_sigma_px > 0):
        raise InputError("a bound needs a positive contrast-to-noise ratio and blur")
    shapes, index = node_shapes(pattern).take(index), np.asarray(index)
    assert pattern.lattice is not None
    maps = lattice_maps(pattern.lattice[index], np.asarray(place_px, dtype=float), np.ones(len(index), bool), SMOOTH_PX)
    if not maps.known.any():
        raise MeasurementError("no node of the grid has neighbours in two directions; more of the grid must be in the image")
    blur = float(np.sqrt(psf_sigma_px**2 + PIXEL_VARIANCE_PX2))
    reach = REACH_BLURS * blur + REACH_EXTRA_PX
    size = HELD if shapes.crossing else NESTED if shapes.inner.any() else PLAIN
    dark = np.zeros(size_px[::-1], np.uint8)
    out = np.zeros((len(index), *((2, 2) if shapes.crossing else (6, 6))))
    for rows in chunks(maps, FULL_AT_ONCE):
        some, print_ = maps.take(rows), shapes.take(rows)
        x = np.zeros((len(rows), size))
        x[:, HALF], x[:, BLUR] = print_.half, blur
        if size == NESTED:
            x[:, INNER] = print_.inner
        pixels = node_pixels(dark, some, clear_of_ends(print_, some, reach), print_.half, reach)
        columns = np.zeros((len(rows), size + LIGHT, pixels.s.shape[1]), np.float32)
        cover = coverage(pixels, x, shapes.crossing, columns[:, :size])
        columns[:, :size] *= -contrast_to_noise
        light_rows(pixels, cover, np.full(len(rows), INK_SHARE), columns[:, size:])
        columns *= pixels.used[:, None]
        normal = (columns @ np.swapaxes(columns, 1, 2)).astype(float)
        prior = np.tile(np.diag(_precision(size)), (len(rows), 1, 1))
        padded = x if size > HELD else np.pad(x, ((0, 0), (0, PLAIN - HELD)))
        by_x = measured_vector(some, padded, shapes.crossing)[1][:, :, :size]
        out[rows] = information_of(normal, prior, by_x)
    out[~(maps.known & np.isfinite(out).all(axis=(1, 2)))] = 0.0
    return out


def grid_information(
    camera: Camera, pattern: Pattern, index: Index, camera_from_dish: Pose, contrast_to_noise: float, psf_sigma_px: float
) -> Array:
    """Fisher information (K, 7, 7) of one photograph on (move along camera axes in mm, turn about target axes in rad, edge offset in mm).

    Of targets `index` (K,) of a grid, each on its own, where the undeformed pattern lies: `grid_bound` carried by what each of the seven
    does to the measured vector, as the measurement itself has it. Crossings show two of them. Raises what `grid_bound` raises.
    """
    place, rotation = camera_from_dish.apply(pattern.center_mm[index]), camera_from_dish.rotation @ pattern.axes[index]
    size = camera.width_px, camera.height_px
    seen = grid_bound(pattern, index, camera.project(place), size, contrast_to_noise, psf_sigma_px)
    corner, spread = None, np.zeros((len(index), seen.shape[1], 1))
    if not pattern.lines:
        half = np.array([np.abs(pattern.kind_of(int(i)).polygons[0].corners_mm).max() for i in index])
        outward = CORNERS @ np.swapaxes(rotation[..., :2], 1, 2)
        corner = half[:, None, None] * outward
        _, by_point = camera.project_with_point_jacobian(place[:, None] + corner)
        spread = (MEASURED @ (by_point @ outward[..., None])[..., 0]).reshape(len(index), 6, 1)
    by = np.concatenate([*by_own_motion(camera, place, rotation, corner), spread], axis=2)
    return np.asarray(np.swapaxes(by, 1, 2) @ seen @ by)


def _precision(size: int) -> Array:
    precision = np.full(size, FREE)
    if size > HELD:
        precision[BEND] = FIXED
    return precision
