"""Ellipses in a grey image to a fraction of a pixel, from interpolated edge points: what the paper's method starts from.

The paper (section 4.2, step 1) refines its ellipses "by using a subpixel resolution algorithm in the grayscale image" without
naming one. Here the edge is where profiles across the ellipse cross the middle between the grey levels on both sides, and the
ellipse is a least-squares fit through those points. A blurred edge of radius R seen so lies s^2 / 2R inside the true one
(s: standard deviation of the blur), which makes circles look small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from dishmap.targets import ellipses

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

# Half length of a profile across an edge: half way to the next edge, within these limits.
PROFILE_PX = (1.0, 6.0)
PROFILE_STEP_PX = 0.5
# About one profile per pixel of the edge, within these limits, as a power of two so that ellipses go in batches.
PROFILES = (32, 512)
# Profiles closer than this share pixels, so that their errors are not independent (measured: scatter against residuals).
SHARED_PX = 2.0
# What sampling with interpolation leaves in a radius even without noise (measured on rings of 4 to 15 px).
INTERPOLATION_PX = 0.01
# Share of an ellipse's profiles that must show its edge.
LEAST_SHARE = 0.5
LEAST_POINTS = 6
# Points that lie off their ellipse by more than this share of its minor semi-axis are on none.
LARGEST_RMS = 0.25


@dataclass(frozen=True)
class Ellipses:
    """Ellipses in an image.

    center_px (M, 2); semi_axes_px (M, 2), major first; angle_rad (M,) of the major axis from +u towards +v; radius_sigma_px (M,)
    standard error of the mean radius (0: exact); good (M,): false where the edge was not found or is no ellipse.
    """

    center_px: Array
    semi_axes_px: Array
    angle_rad: Array
    radius_sigma_px: Array
    good: Flags

    def __len__(self) -> int:
        return len(self.angle_rad)

    def __getitem__(self, index: Ints | Flags) -> Ellipses:
        return Ellipses(
            self.center_px[index], self.semi_axes_px[index], self.angle_rad[index], self.radius_sigma_px[index], self.good[index]
        )

    @staticmethod
    def exact(center_px: ArrayLike, semi_axes_px: ArrayLike, angle_rad: ArrayLike) -> Ellipses:
        """Ellipses (M, 2), (M, 2), (M,) without error."""
        angle = np.asarray(angle_rad, dtype=float).reshape(-1)
        center, axes = (np.asarray(value, dtype=float).reshape(-1, 2) for value in (center_px, semi_axes_px))
        return Ellipses(center, axes, angle, np.zeros(len(angle)), np.ones(len(angle), dtype=bool))

    @property
    def area_px2(self) -> Array:
        """Areas (M,)."""
        return np.asarray(np.pi * self.semi_axes_px.prod(axis=1))

    @property
    def major(self) -> Array:
        """Unit vectors (M, 2) along the major axes."""
        return np.stack([np.cos(self.angle_rad), np.sin(self.angle_rad)], axis=1)

    @property
    def minor(self) -> Array:
        """Unit vectors (M, 2) along the minor axes, a quarter turn from +u towards +v after the major ones."""
        return np.stack([-np.sin(self.angle_rad), np.cos(self.angle_rad)], axis=1)


def refine_ellipses(image: NDArray[np.generic], start: Ellipses, half_width_px: ArrayLike | None = None) -> Ellipses:
    """Fit ellipses to the sub-pixel edges near those of `start`, in a grey image (H, W).

    half_width_px (M,): how far to either side the edge is looked for; by default up to half the minor semi-axis. Where less than
    half of an edge is found, or it lies farther away than that, the start is returned with `good` false.
    """
    size = len(start)
    width = np.array(np.broadcast_to(half_width_px, size) if half_width_px is not None else profile_half_width_px(start, np.full(size, -1)))
    center, axes, angle = start.center_px.copy(), start.semi_axes_px.copy(), start.angle_rad.copy()
    sigma, good = np.full(size, np.inf), np.zeros(size, dtype=bool)
    perimeter = np.pi * start.semi_axes_px.sum(axis=1)
    profiles = (2 ** np.ceil(np.log2(np.clip(perimeter, *PROFILES)))).astype(int)
    for number in np.unique(profiles):
        rows = np.flatnonzero(profiles == number)
        near = start[rows]
        for _ in range(2):
            points, valid = _edge_points(image, near, width[rows], int(number))
            fit = fit_ellipses(points, valid)
            close = fit.good & (np.linalg.norm(fit.center_px - start.center_px[rows], axis=1) < width[rows])
            near = _where(close, fit, near)
        done = close & (valid.mean(axis=1) >= LEAST_SHARE)
        take = rows[done]
        center[take], axes[take], angle[take], good[take] = fit.center_px[done], fit.semi_axes_px[done], fit.angle_rad[done], True
        shared = np.maximum(SHARED_PX * number / perimeter[take], 1.0)
        sigma[take] = np.hypot(fit.radius_sigma_px[done] * np.sqrt(shared), INTERPOLATION_PX)
    return Ellipses(center, axes, angle, sigma, good)


def _where(choose: Flags, first: Ellipses, second: Ellipses) -> Ellipses:
    rows = np.where(choose, np.arange(len(first)), len(first) + np.arange(len(second)))
    names = ("center_px", "semi_axes_px", "angle_rad", "radius_sigma_px", "good")
    return Ellipses(*(np.concatenate([getattr(first, name), getattr(second, name)])[rows] for name in names))


def profile_half_width_px(found: Ellipses, parent: Ints) -> Array:
    """Half way from each ellipse to the nearest of its parent and children, or to its centre (M,); parent (M,): index or -1."""
    minor = found.semi_axes_px[:, 1]
    gap = minor.copy()
    child = np.flatnonzero(parent >= 0)
    around = parent[child]
    distance = minor[around] - minor[child] - np.linalg.norm(found.center_px[around] - found.center_px[child], axis=1)
    np.minimum.at(gap, child, distance)
    np.minimum.at(gap, around, distance)
    return np.asarray(np.clip(0.5 * gap, *PROFILE_PX))


def _edge_points(image: NDArray[np.generic], found: Ellipses, half_width: Array, number: int) -> tuple[Array, Flags]:
    """Points (M, number, 2) where profiles across the ellipses cross the middle grey level, and where they do."""
    phi = 2 * np.pi * np.arange(number) / number
    along, across = found.major[:, None], found.minor[:, None]
    a, b = found.semi_axes_px[:, :1, None], found.semi_axes_px[:, 1:, None]
    c, s = np.cos(phi)[:, None], np.sin(phi)[:, None]
    on = found.center_px[:, None] + a * c * along + b * s * across
    outward = b * c * along + a * s * across
    return edge_points(image, on, outward / np.linalg.norm(outward, axis=-1, keepdims=True), half_width)


def edge_points(image: NDArray[np.generic], on: Array, outward: Array, half_width: Array) -> tuple[Array, Flags]:
    """Points (M, N, 2) where profiles cross the middle grey level, and where they do (M, N).

    Profiles go through `on` along unit vectors `outward` (M, N, 2), half_width (M,) px to both sides; the levels of both sides are
    those of all N profiles of an edge together.
    """
    steps = int(np.ceil(half_width.max() / PROFILE_STEP_PX))
    t = np.linspace(-1, 1, 2 * steps + 1) * half_width[:, None]
    uv = on[:, :, None] + t[:, None, :, None] * outward[:, :, None]
    inside_image = ((uv >= 0) & (uv <= np.array(image.shape[::-1]) - 1)).all(axis=(2, 3))
    grey = map_coordinates(image, [uv[..., 1], uv[..., 0]], output=np.float64, order=1, mode="nearest")
    ends = max(1, steps // 4)
    inner, outer = np.median(grey[..., :ends], axis=(1, 2)), np.median(grey[..., -ends:], axis=(1, 2))
    side = (grey - 0.5 * (inner + outer)[:, None, None]) * np.sign(outer - inner)[:, None, None]
    rise = (side[..., :-1] < 0) & (side[..., 1:] >= 0)
    # of several crossings, the one nearest to the ellipse
    far = np.abs(t[:, :-1] + t[:, 1:])[:, None]
    at = np.argmin(np.where(rise, far, np.inf), axis=-1)
    valid = np.take_along_axis(rise, at[..., None], axis=-1)[..., 0] & inside_image
    low, high = (np.take_along_axis(side, at[..., None] + k, axis=-1)[..., 0] for k in (0, 1))
    share = low / np.where(valid, low - high, 1.0)
    crossing = np.take_along_axis(t, at, axis=1) + share * (t[:, 1:2] - t[:, :1])
    return on + np.where(valid, crossing, 0.0)[..., None] * outward, valid


def fit_ellipses(points_px: ArrayLike, valid: Flags | None = None) -> Ellipses:
    """Least-squares ellipses through points (M, N, 2), of which valid (M, N) count; points far off lose their weight.

    `good` is false where fewer than 6 points count or no ellipse goes through them.
    """
    points = np.asarray(points_px, dtype=float)
    size, number = points.shape[:2]
    weight = np.ones((size, number)) if valid is None else np.asarray(valid, dtype=float)
    fits = ellipses.fit_ellipses(points.reshape(-1, 2), np.arange(size) * number, weight.reshape(-1))
    count = weight.sum(axis=1)
    # comparisons with NaN, where no ellipse fits, are false
    good = (count >= LEAST_POINTS) & (fits.rms < LARGEST_RMS * fits.semi_axes[:, 1])
    sigma = fits.rms * np.sqrt(1 / np.maximum(count - 5, 1))
    return Ellipses(fits.center, fits.semi_axes, fits.angle_rad, np.where(good, sigma, np.inf), good)


def transform_ellipses(found: Ellipses, homography: Array) -> Ellipses:
    """Images of the ellipses under a homography (3, 3) of the image plane, exact: C' = H^-T C H^-1 for their conics."""
    back = np.linalg.inv(homography)
    frame = np.stack([found.major, found.minor], axis=2)
    shape = (frame / found.semi_axes_px[:, None] ** 2) @ np.swapaxes(frame, 1, 2)
    conic = np.empty((len(found), 3, 3))
    pull = (shape @ found.center_px[..., None])[..., 0]
    conic[:, :2, :2], conic[:, :2, 2], conic[:, 2, :2] = shape, -pull, -pull
    conic[:, 2, 2] = (pull * found.center_px).sum(axis=1) - 1
    conic = back.T @ conic @ back
    center = -np.linalg.solve(conic[:, :2, :2], conic[:, :2, 2:])[..., 0]
    size = -(conic[:, 2, 2] + (conic[:, 2, :2] * center).sum(axis=1))
    center, axes, angle = _from_shape(np.asarray(center), conic[:, :2, :2] / size[:, None, None])
    larger = np.sqrt(axes.prod(axis=1) / found.semi_axes_px.prod(axis=1))
    return Ellipses(center, axes, angle, found.radius_sigma_px * larger, found.good & np.isfinite(axes).all(axis=1))


def _from_shape(center: Array, shape: Array) -> tuple[Array, Array, Array]:
    """Centre, semi-axes (NaN where it is no ellipse) and angle of {(x - c)^T shape (x - c) = 1}."""
    values, vectors = np.linalg.eigh(shape)
    axes = np.where(values[:, :1] > 0, 1 / np.sqrt(np.where(values > 0, values, 1.0)), np.nan)
    return center, axes, np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0])
