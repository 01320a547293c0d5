"""Sub-pixel points of a smooth edge: a blurred step fitted to the raw pixels beside each short piece of a known curve.

A piece's pixels are those within half its length along the curve and `half_px` across it. Their grey is modelled as
`outside + (inside - outside) * Phi((shift - d) / blur)`, d the pixel centre's signed distance outwards from the curve; nothing is
interpolated. A square pixel widens the blur to blur^2 = psf^2 + 1/12. Light that changes over the picture tilts both grey levels; a slope
of 1e-3 per px would move an edge by 1e-3 px, so the light's slopes are learnt from the levels of all pieces together. Where the curve
bends by k per px the blurred edge lies blur^2 k / 2 inside the true one (the radial Laplacian's drift), which is put back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from dishmap.errors import FitError
from dishmap.robust import robust_linear_fit

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

FIT_STEPS = 12
# A blur outside of this is no lens's, or no edge.
SMALLEST_BLUR_PX, LARGEST_BLUR_PX = 0.3, 5.0
# The start is searched with a ramp of this width, in steps of a pixel.
RAMP_PX = 3.0
# A piece counts when its step is at least this part of the median one and has at least this part of its pixels.
LEAST_CONTRAST_PART = 0.35
LEAST_PIXELS_PART = 0.7
# The step must be this many sigmas of the noise of one pixel.
LEAST_CONTRAST_SIGMAS = 3.0
# Square of residuals over that of the noise: 1 +- 0.2 for 60 pixels; and what the model may miss, as a part of the step (a square
# pixel seen as a Gaussian leaves 0.4 %).
LARGEST_MISFIT = 2.2
# From here on a piece's own misfit counts as its noise; below, it is chance and the noise common to all is the better word.
CLEAR_MISFIT = 1.5
MODEL_PART = 0.01
ROUNDING_GREY2 = 1 / 12
# What the model of an edge leaves in a picture without noise, and more: nothing is to be learnt from less.
MODEL_SIGMA_PX = 1e-3
# Fewer pieces do not tell the light's slope from their own disturbances.
FEWEST_FOR_LIGHT = 50
LIGHT_SCALE_PX = 1000.0


@dataclass(frozen=True)
class Pieces:
    """Pieces of a curve: middle_px (N, 2), unit normal (N, 2) outwards, curvature_per_px (N,) (positive where convex), length_px."""

    middle_px: Array
    normal: Array
    curvature_per_px: Array
    length_px: float

    def moved(self, shift_px: Array) -> Pieces:
        """The same pieces, each moved outwards by a shift (N,)."""
        return Pieces(self.middle_px + shift_px[:, None] * self.normal, self.normal, self.curvature_per_px, self.length_px)


@dataclass(frozen=True)
class Edges:
    """Edges of N pieces: shift_px (N,) outwards from the curve with its sigma_px (N,), contrast (N,) (inside less outside, grey levels).

    good (N,): a single clean step was found; blur_px: common to all; noise: standard deviation of one pixel, grey levels.
    """

    shift_px: Array
    sigma_px: Array
    contrast: Array
    good: Flags
    blur_px: float
    noise: float


def fit_edges(gray: NDArray[Any], pieces: Pieces, half_px: float, light_inside: bool) -> Edges:
    """Fit the edge beside each piece in a grey image (H, W), searched up to `half_px` on either side less two blurs.

    light_inside: the side that the normals point away from is the lighter one; steps the other way are not good.
    """
    d, grey, used = _pixels(gray, pieces, half_px)
    sign = 1.0 if light_inside else -1.0
    flat, one = np.zeros(len(d)), np.ones(len(d))
    enough = used.sum(axis=1) >= LEAST_PIXELS_PART * 2 * half_px * pieces.length_px
    fitted = _fit(d, grey, used, _start(d, grey, used, half_px, sign), one, flat, free_blur=True)
    slope = _light_slope(pieces, fitted, _plain(fitted, sign, enough))
    fitted = _fit(d, grey, used, fitted.shift_px, fitted.blur_px, slope, free_blur=True)
    plain = _plain(fitted, sign, enough)
    blur = float(np.median(fitted.blur_px[plain])) if plain.any() else 1.0
    fitted = _fit(d, grey, used, fitted.shift_px, blur * one, slope, free_blur=False)
    mean_square = fitted.square / np.maximum(used.sum(axis=1) - 3, 1)
    plain = _plain(fitted, sign, enough)
    noise2 = float(np.median(mean_square[plain])) if plain.any() else 0.0
    contrast = sign * fitted.contrast
    good = plain & (contrast > LEAST_CONTRAST_SIGMAS * np.sqrt(noise2)) & (np.abs(fitted.shift_px) <= half_px - 2 * blur)
    good &= mean_square <= LARGEST_MISFIT * noise2 + (MODEL_PART * contrast) ** 2
    bend = 0.5 * blur**2 * pieces.curvature_per_px
    # rounding to whole grey levels is noise too, even where it shows none
    noisy = np.where(mean_square > CLEAR_MISFIT * noise2, mean_square, noise2)
    variance = fitted.unit_variance * np.maximum(noisy, ROUNDING_GREY2) + MODEL_SIGMA_PX**2
    return Edges(fitted.shift_px + bend, np.sqrt(variance), contrast, good, blur, float(np.sqrt(noise2)))


def _plain(fitted: _Fit, sign: float, enough: Flags) -> Flags:
    """Pieces (N,) whose fit settled on a step of the right sign that is not much smaller than most."""
    contrast, settled = sign * fitted.contrast, enough & fitted.settled & (sign * fitted.contrast > 0)
    return settled & (contrast >= LEAST_CONTRAST_PART * (np.median(contrast[settled]) if settled.any() else 0.0))


def _light_slope(pieces: Pieces, fitted: _Fit, plain: Flags) -> Array:
    """Relative slope of the light outwards (N,) per px, from the course of the lighter side's grey level along the curve.

    The logarithm of the level is taken for a harmonic polynomial of second degree in u and v. What is the same all around the
    curve's middle (vignetting about it) does not show in these levels; it moves all edges alike.
    """
    if plain.sum() < FEWEST_FOR_LIGHT:
        return np.zeros(len(plain))
    (x, y), (nu, nv) = (pieces.middle_px - pieces.middle_px.mean(axis=0)).T / LIGHT_SCALE_PX, pieces.normal.T
    design = np.stack([np.ones(len(x)), x, y, x * x - y * y, 2 * x * y], axis=1)
    level = np.log(np.maximum(np.maximum(fitted.outside, fitted.outside + fitted.contrast), 1.0))
    try:
        _, a, b, c, e = robust_linear_fit(design[plain], level[plain]).coefficients
    except FitError:  # pieces along a line say nothing of the light across it
        return np.zeros(len(plain))
    return np.asarray((nu * (a + 2 * c * x + 2 * e * y) + nv * (b - 2 * c * y + 2 * e * x)) / LIGHT_SCALE_PX)


def _pixels(gray: NDArray[Any], pieces: Pieces, half_px: float) -> tuple[Array, Array, Flags]:
    """Signed distance outwards (N, M), grey level (N, M), and which of the M entries are pixels of the piece; saturated ones are not."""
    reach = int(np.ceil(np.hypot(half_px, pieces.length_px / 2))) + 1
    dv, du = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    corner = np.rint(pieces.middle_px).astype(np.int64)
    u, v = corner[:, :1] + du, corner[:, 1:] + dv
    x, y = u - pieces.middle_px[:, :1], v - pieces.middle_px[:, 1:]
    nu, nv = pieces.normal[:, :1], pieces.normal[:, 1:]
    along = nu * y - nv * x
    d = nu * x + nv * y + 0.5 * pieces.curvature_per_px[:, None] * along**2
    height, width = gray.shape
    # half-open, so that no pixel on the border between two pieces counts twice
    used = (along >= -pieces.length_px / 2) & (along < pieces.length_px / 2) & (np.abs(d) <= half_px)
    used &= (u >= 0) & (u < width) & (v >= 0) & (v < height)
    # the used entries first, so that the rest can be dropped
    order = np.argsort(~used, axis=1, kind="stable")[:, : max(int(used.sum(axis=1).max(initial=1)), 1)]
    d, used = np.take_along_axis(d, order, axis=1), np.take_along_axis(used, order, axis=1)
    u, v = np.take_along_axis(u, order, axis=1), np.take_along_axis(v, order, axis=1)
    grey = gray[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
    if gray.dtype.kind in "ui":
        used &= grey < np.iinfo(gray.dtype).max
    return d, grey.astype(float), used


def _start(d: Array, grey: Array, used: Flags, half_px: float, sign: float) -> Array:
    """Shift (N,), in whole pixels, of the ramp of the right sign that explains most."""
    weight = used.astype(float)
    count = np.maximum(weight.sum(axis=1), 1.0)
    centered = (grey - (weight * grey).sum(axis=1, keepdims=True) / count[:, None]) * weight
    best, gain = np.zeros(len(d)), np.full(len(d), -np.inf)
    for shift in np.arange(-np.floor(half_px - 2), half_px - 1.5):
        ramp = np.clip(0.5 + (shift - d) / RAMP_PX, 0.0, 1.0)
        ramp = (ramp - (weight * ramp).sum(axis=1, keepdims=True) / count[:, None]) * weight
        pull = sign * (ramp * centered).sum(axis=1)
        explained = pull * np.abs(pull) / np.maximum((ramp**2).sum(axis=1), 1e-9)
        best, gain = np.where(explained > gain, shift, best), np.maximum(gain, explained)
    return best


@dataclass(frozen=True)
class _Fit:
    """Per piece (N,): shift, blur, grey level outside, contrast, squared residuals, variance of the shift at noise 1, whether settled."""

    shift_px: Array
    blur_px: Array
    outside: Array
    contrast: Array
    square: Array
    unit_variance: Array
    settled: Flags


def _fit(d: Array, grey: Array, used: Flags, shift: Array, blur: Array, slope: Array, free_blur: bool) -> _Fit:
    """Gauss-Newton on (shift, blur or not) with the two grey levels solved for at every step; light of a given relative slope (N,)."""
    light = used * (1 + slope[:, None] * d)
    step = np.zeros(len(d))
    for number in range(FIT_STEPS + 1):
        z = (shift[:, None] - d) / blur[:, None]
        cover, density = ndtr(z) * light, np.exp(-0.5 * z * z) * light / (np.sqrt(2 * np.pi) * blur[:, None])
        level = _solve(np.stack([light, cover], axis=1), grey * used)
        model = level[:, :1] * light + level[:, 1:] * cover
        residual = grey * used - model
        columns = [light, cover, level[:, 1:] * density]
        columns += [-level[:, 1:] * density * z] if free_blur else []
        if number == FIT_STEPS:
            break
        delta = _solve(np.stack(columns, axis=1), residual)
        step = np.clip(delta[:, 2], -1.0, 1.0)
        shift = shift + step
        if free_blur:
            blur = np.clip(blur + np.clip(delta[:, 3], -0.4, 0.4), SMALLEST_BLUR_PX, LARGEST_BLUR_PX)
    settled = (np.abs(step) < 1e-2) & (blur > SMALLEST_BLUR_PX) & (blur < LARGEST_BLUR_PX)
    variance = np.asarray(np.linalg.inv(_normal(np.stack(columns, axis=1)))[:, 2, 2], dtype=float)
    return _Fit(shift, blur, level[:, 0], level[:, 1], (residual**2).sum(axis=1), variance, settled)


def _normal(design: Array) -> Array:
    """Normal matrices (N, P, P) of designs (N, P, M), with a trace of stiffness where nothing is determined."""
    normal = design @ np.swapaxes(design, 1, 2)
    size = np.trace(normal, axis1=1, axis2=2)
    return np.asarray(normal + (1e-12 * size + 1e-12)[:, None, None] * np.eye(design.shape[1]))


def _solve(design: Array, values: Array) -> Array:
    """Least-squares coefficients (N, P) of values (N, M) by designs (N, P, M)."""
    return np.asarray(np.linalg.solve(_normal(design), design @ values[..., None])[..., 0])
