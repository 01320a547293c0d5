"""Photographs with truth: `simulate(scene, rng)`.

Every printed circle, polygon and line is followed through the bent surface, the pose and the lens, and its coverage of each
pixel is computed exactly (`contour`, `grid_ink`). Regions are put together as light, shaded, and only then recorded: gamma,
noise, rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.fft import next_fast_len

from dishmap.simulate.contour import (
    STEP_SIGMAS,
    add_curve,
    circle,
    finish,
    panel_nodes,
    polyline,
    reach_px,
    signed_area,
    smooth_pieces,
    spectral_dv,
)
from dishmap.simulate.forward import facing, outline_px, print_facing, printed_points, rib_outlines_px
from dishmap.simulate.grid_ink import HALVINGS, crossing_ink, line_curves
from dishmap.simulate.scene import FULL_SCALE_GREY, Disc, Scene, Sensor, Shape, spread_corners_mm, spread_radius_mm
from dishmap.simulate.truth import Simulation, Truth, truth_of

Array = NDArray[np.float64]
Grey = NDArray[np.float32]

CIRCLE_COARSE = 64
# Rows recorded at a time: keeps the noise of a large image out of memory
ROWS_PER_BAND = 256


@dataclass(frozen=True)
class Patch:
    """Coverage of a rectangle of the image: `coverage` (h, w), whose pixel [0, 0] is the image's pixel [row, column]."""

    row: int
    column: int
    coverage: NDArray[Any]

    def of(self, image: NDArray[Any]) -> NDArray[Any]:
        """The part of an image (H, W) under this patch, as a view."""
        height, width = self.coverage.shape
        return image[self.row : self.row + height, self.column : self.column + width]


@dataclass(frozen=True)
class Ink:
    """The ink of target number `index`: its coverage in the image, and its whole area there or outside."""

    index: int
    patch: Patch
    whole_px2: float


def simulate(scene: Scene, rng: Generator) -> Simulation:
    """Photograph a scene: an image as the sensor records it, and the truth of its targets."""
    light, truth = render_light(scene)
    return Simulation(record(light, scene.sensor, rng), truth)


def render_light(scene: Scene) -> tuple[Grey, Truth]:
    """Light (height, width) in grey levels, before gamma, noise and rounding, and the truth; may exceed 255 in glare."""
    size = (scene.camera.height_px, scene.camera.width_px)
    light = np.full(size, scene.light.background_grey, dtype=np.float32)
    for shape in scene.background:
        patch = _shape_patch(shape, size, scene.sensor.psf_sigma_px)
        if patch is not None:
            _paint(light, patch, shape.grey)
    _ribs(light, scene, front=False)
    inks = _print(light, scene)
    hidden = _ribs(light, scene, front=True)
    _shade(light, scene)
    hidden = _occlude(light, scene, hidden)
    visible = np.zeros(len(scene.pattern))
    for ink in inks:
        clear = ink.patch.of(light) < FULL_SCALE_GREY
        open_ = clear if hidden is None else clear * (1 - ink.patch.of(hidden))
        visible[ink.index] = np.clip((ink.patch.coverage * open_).sum(dtype=float) / ink.whole_px2, 0.0, 1.0)
    if scene.pattern.lines:
        visible = _crossings_visible(scene, light, hidden)
    # of a square beyond the edge of sight some ink may show, but not what its truth is about
    visible[~facing(scene)] = 0.0
    return light, truth_of(scene, visible)


def _crossings_visible(scene: Scene, light: Grey, hidden: Grey | None) -> Array:
    """Share (N,) of the lines' ink within half a step of each crossing that is printed, in the image, not hidden and not saturated."""
    px, seen = crossing_ink(scene)
    height, width = light.shape
    u, v = np.moveaxis(np.rint(np.where(seen[..., None], px, -1.0)).astype(np.int64), -1, 0)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v = np.where(inside, u, 0), np.where(inside, v, 0)
    open_ = inside & (light[v, u] < FULL_SCALE_GREY)
    return np.asarray((open_ if hidden is None else open_ * (1.0 - hidden[v, u])).mean(axis=1))


def record(light: Grey, sensor: Sensor, rng: Generator) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """What a sensor records of light (H, W) in grey levels: shot noise, gamma, noise, rounding; uint8 or uint16."""
    kind = np.uint8 if sensor.bits == 8 else np.uint16
    step = (2**sensor.bits - 1) / FULL_SCALE_GREY
    image = np.empty(light.shape, dtype=kind)
    for start in range(0, len(light), ROWS_PER_BAND):
        band = light[start : start + ROWS_PER_BAND].copy()
        if sensor.electrons_per_grey is not None:
            spread = np.sqrt(np.maximum(band, 0) / np.float32(sensor.electrons_per_grey))
            band += spread * rng.standard_normal(band.shape, dtype=np.float32)
        if sensor.gamma != 1:
            np.maximum(band, 0, out=band)
            band = np.float32(FULL_SCALE_GREY) * (band / np.float32(FULL_SCALE_GREY)) ** np.float32(1 / sensor.gamma)
        if sensor.noise_grey > 0:
            band += np.float32(sensor.noise_grey) * rng.standard_normal(band.shape, dtype=np.float32)
        image[start : start + ROWS_PER_BAND] = np.clip(np.rint(band * np.float32(step)), 0, 2**sensor.bits - 1).astype(kind)
    return image


def _print(light: Grey, scene: Scene) -> list[Ink]:
    """Paint the surface, its targets and lines over the background, and return the targets' own ink as far as it is in the image."""
    surface = _surface(scene)
    _paint(light, Patch(0, 0, surface), scene.light.ground_grey)
    inks = [ink for index in _drawn(scene) if (ink := _ink(scene, index)) is not None]
    patches = [ink.patch for ink in inks]
    if scene.pattern.lines:
        patches.append(Patch(0, 0, _coverage(scene, *line_curves(scene))))
    for patch in patches:
        # ink is part of the surface: where the rim hides the surface there is none
        np.minimum(patch.coverage, patch.of(surface), out=patch.coverage)
        patch.of(light)[...] += patch.coverage * np.float32(scene.light.ink_grey - scene.light.ground_grey)
    return inks


def _drawn(scene: Scene) -> list[int]:
    """Targets with ink of their own that may be seen; of polygons a part may be, whichever way the target's middle faces."""
    kinds = [scene.pattern.kind_of(index) for index in range(len(scene.pattern))]
    shown = facing(scene)
    return [index for index, kind in enumerate(kinds) if kind.polygons or (shown[index] and len(kind.radius_mm))]


def _surface(scene: Scene) -> Grey:
    """Coverage (height, width) by the whole surface, nothing where its back is seen."""
    outline, dv = polyline(outline_px(scene), scene.sensor.psf_sigma_px)
    # the pattern's front has its y against the image's v: its outline has negative area
    return _coverage(scene, outline, -dv)


def _coverage(scene: Scene, points_px: Array, dv_px: Array) -> Grey:
    """Coverage (height, width) of the whole image by the region inside closed curves."""
    height, width = scene.camera.height_px, scene.camera.width_px
    image = np.empty((height, width), dtype=np.float32)
    for start in range(0, height, ROWS_PER_BAND):
        band = np.zeros((min(ROWS_PER_BAND, height - start), width))
        add_curve(band, (0, start), points_px, dv_px, scene.sensor.psf_sigma_px)
        image[start : start + ROWS_PER_BAND] = np.clip(finish(band), 0.0, 1.0)
    return image


def _ink(scene: Scene, index: int) -> Ink | None:
    """Exact coverage by one target's ink; None if it is outside the image or leaves the lens's field."""
    kind, sigma = scene.pattern.kind_of(index), scene.sensor.psf_sigma_px
    if kind.polygons:
        return _polygon_ink(scene, index)
    radius = spread_radius_mm(kind.radius_mm, kind.dark, scene.ink_spread_mm)
    coarse = _circles_px(scene, index, kind.center_mm, radius, CIRCLE_COARSE)
    if not np.isfinite(coarse).all():
        return None
    longest = np.linalg.norm(np.roll(coarse, -1, axis=1) - coarse, axis=-1).max()
    count = max(CIRCLE_COARSE, next_fast_len(int(np.ceil(CIRCLE_COARSE * longest / (STEP_SIGMAS * sigma))), real=True))
    points = _circles_px(scene, index, kind.center_mm, radius, count)
    dv = spectral_dv(points[..., 1])
    area = signed_area(points, dv)
    sign = np.where(kind.dark, 1.0, -1.0) * np.sign(area)
    points = points.reshape(-1, 2)
    patch = _region(points, (sign[:, None] * dv).reshape(-1), (scene.camera.height_px, scene.camera.width_px), sigma)
    return None if patch is None else Ink(index, patch, float((sign * area).sum()))


def _polygon_ink(scene: Scene, index: int) -> Ink | None:
    """`_ink` of a target made of polygons."""
    sides, sign = [], []
    for polygon in scene.pattern.kind_of(index).polygons:
        corners = _facing_part(scene, index, spread_corners_mm(polygon, scene.ink_spread_mm))
        ahead = np.roll(corners, -1, axis=0) - corners
        sides.append(corners[:, None] + panel_nodes()[:, None] * ahead[:, None])
        sign += [1.0 if polygon.dark else -1.0] * len(corners)
    pieces = scene.camera.project(printed_points(scene, index, np.concatenate(sides)))
    if not len(pieces) or not np.isfinite(pieces).all():
        return None
    points, dv, piece = smooth_pieces(pieces, scene.sensor.psf_sigma_px)
    # a printed side faces the camera with its outline turned against the image's axes
    dv = -dv * np.array(sign)[piece]
    patch = _region(points, dv, (scene.camera.height_px, scene.camera.width_px), scene.sensor.psf_sigma_px)
    return None if patch is None else Ink(index, patch, float(signed_area(points - points[0], dv)))


def _facing_part(scene: Scene, index: int, corners_mm: Array) -> Array:
    """Corners (K, 2) of what faces the camera of a printed polygon: cut straight where the surface turns away."""
    shown = print_facing(scene, index, corners_mm)
    if shown.all():
        return corners_mm
    kept: list[Array] = []
    for here, there, seen, seen_there in zip(corners_mm, np.roll(corners_mm, -1, axis=0), shown, np.roll(shown, -1), strict=True):
        if seen:
            kept.append(here)
        if seen != seen_there:
            low, high = (here, there) if seen else (there, here)
            for _ in range(HALVINGS):
                middle = 0.5 * (low + high)
                low, high = (middle, high) if print_facing(scene, index, middle[None])[0] else (low, middle)
            kept.append(low)
    return np.array(kept).reshape(-1, 2)


def _circles_px(scene: Scene, index: int, center_mm: Array, radius_mm: Array, count: int) -> Array:
    """Samples (C, count, 2) in the image of printed circles (C), evenly spaced in their angle."""
    t = np.arange(count) * (2 * np.pi / count)
    unit = np.stack([np.cos(t), np.sin(t)], axis=-1)
    xy = center_mm[:, None] + radius_mm[:, None, None] * unit
    return scene.camera.project(printed_points(scene, index, xy))


def _region(points_px: Array, dv_px: Array, size: tuple[int, int], sigma_px: float) -> Patch | None:
    """Coverage of the region inside closed curves, on the part of an image of `size` (height, width) that it touches."""
    reach = reach_px(sigma_px)
    low = np.maximum(np.floor(points_px.min(axis=0) - reach), 0).astype(np.int64)
    high = np.minimum(np.ceil(points_px.max(axis=0) + reach), [size[1] - 1, size[0] - 1]).astype(np.int64)
    if (high < low).any():
        return None
    buffer = np.zeros((high[1] - low[1] + 1, high[0] - low[0] + 1))
    add_curve(buffer, (int(low[0]), int(low[1])), points_px, dv_px, sigma_px)
    return Patch(int(low[1]), int(low[0]), finish(buffer).astype(np.float32))


def _shape_patch(shape: Shape, size: tuple[int, int], sigma_px: float) -> Patch | None:
    if isinstance(shape, Disc):
        points, dv = circle(shape.center_px, shape.radius_px, sigma_px)
    else:
        points, dv = polyline(np.asarray(shape.corners_px), sigma_px)
    return _region(points, dv * np.sign(signed_area(points, dv)), size, sigma_px)


def _paint(light: Grey, patch: Patch, grey: float) -> None:
    view = patch.of(light)
    view += patch.coverage * (np.float32(grey) - view)


def _shade(light: Grey, scene: Scene) -> None:
    """Apply gradient, vignetting and glare, in place."""
    height, width = light.shape
    u, v = np.arange(width, dtype=np.float32) - (width - 1) / 2, np.arange(height, dtype=np.float32) - (height - 1) / 2
    gradient, loss = scene.light.gradient, scene.light.vignetting / ((width / 2) ** 2 + (height / 2) ** 2)
    if any(gradient) or loss:
        across = (1 + gradient[0] / width * u - loss * u * u).astype(np.float32)
        down = (gradient[1] / height * v - loss * v * v).astype(np.float32)
        for start in range(0, height, ROWS_PER_BAND):
            light[start : start + ROWS_PER_BAND] *= across + down[start : start + ROWS_PER_BAND, None]
    for spot in scene.light.glare:
        # a product of two Gaussians, one along each axis
        along, up = (np.exp(-0.5 * ((np.arange(n) - c) / spot.sigma_px) ** 2) for n, c in zip((width, height), spot.center_px, strict=True))
        rows = np.flatnonzero(up > 1e-6)
        if rows.size:
            band = slice(int(rows[0]), int(rows[-1]) + 1)
            light[band] += (spot.peak_grey * up[band, None] * along).astype(np.float32)


def _ribs(light: Grey, scene: Scene, front: bool) -> Grey | None:
    """Paint the ribs in front of the surface, or those behind it, and return how much of each pixel they hide, None without ribs.

    As of the surface, nothing is drawn of ribs whose back is seen.
    """
    chosen = [ribs for ribs in scene.ribs if ribs.front == front]
    if not chosen:
        return None
    hidden = np.zeros_like(light)
    for ribs in chosen:
        for corners in rib_outlines_px(scene, ribs):
            points, dv = polyline(corners, scene.sensor.psf_sigma_px)
            if signed_area(points, dv) >= 0:
                continue
            patch = _region(points, -dv, light.shape, scene.sensor.psf_sigma_px)
            if patch is not None:
                _paint(light, patch, ribs.grey)
                _paint(hidden, patch, 1.0)
    return hidden


def _occlude(light: Grey, scene: Scene, hidden: Grey | None) -> Grey | None:
    """Paint the occluders over the light; return how much of each pixel they and what was `hidden` before hide, None for nothing."""
    if not scene.occluders:
        return hidden
    hidden = np.zeros_like(light) if hidden is None else hidden
    for shape in scene.occluders:
        patch = _shape_patch(shape, light.shape, scene.sensor.psf_sigma_px)
        if patch is not None:
            _paint(light, patch, shape.grey)
            _paint(hidden, patch, 1.0)
    return hidden
