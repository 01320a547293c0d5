"""Exact pixel coverage of regions bounded by smooth curves, seen through a Gaussian blur and square pixels.

The value of pixel (u0, v0) is the integral over the region of k(u0 - u) k(v0 - v), where k is the unit box convolved with
the Gaussian. By Green's theorem that is a contour integral, -oint c(u0 - u) k(v0 - v) dv with c the antiderivative of
k. On a closed smooth curve the trapezoid rule converges exponentially (Trefethen & Weideman, SIAM Review 56, 2014), so
a step of one sigma along the curve leaves an error near 1e-9; there is no supersampling, and so no aliasing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]

# exp(-2 pi^2 / step^2) for a step in sigmas: 3e-9 at one
STEP_SIGMAS = 1.0
# On a straight piece of one sigma Gauss's rule with four nodes leaves 3e-8 of the Gaussian's peak.
POLYLINE_NODES = 4
# Smooth pieces of a curve are polynomials through the images of Gauss's nodes; 8 leave 1e-7 px on half a pitch of a bent grid.
PANEL_NODES = 8
# On a smooth step of two sigmas Gauss's rule with five nodes leaves 3e-7 of the Gaussian's peak.
SMOOTH_STEP_SIGMAS, SMOOTH_NODES = 2.0, 5
# The Gaussian's tail beyond: 2e-9
REACH_SIGMAS = 6.0
ENTRIES_PER_CHUNK = 1 << 20


def reach_px(sigma_px: float) -> float:
    """How far an edge is felt: half a pixel and the reach of the blur."""
    return 0.5 + REACH_SIGMAS * sigma_px


def add_curve(buffer: NDArray[Any], corner_px: tuple[int, int], points_px: Array, dv_px: Array, sigma_px: float) -> None:
    """Add a closed curve's contributions to `buffer` (H, W), whose pixel [0, 0] is the image's pixel `corner_px` (u, v).

    points_px (K, 2): samples along the curve; dv_px (K,): the change of v that each stands for. The inside of a curve of
    positive `signed_area` counts 1, of a negative one -1. `finish` turns the buffer into coverage.
    """
    height, width = buffer.shape
    reach = reach_px(sigma_px)
    u, v = points_px[:, 0] - corner_px[0], points_px[:, 1] - corner_px[1]
    near = (v > -reach) & (v < height - 1 + reach) & (u < width - 1 + reach)
    u, v, dv = u[near], v[near], dv_px[near]
    window = int(np.ceil(2 * reach)) + 1
    step = max(1, ENTRIES_PER_CHUNK // window**2)
    flat = buffer.reshape(-1)
    offsets = np.arange(window)
    for start in range(0, len(u), step):
        part = slice(start, start + step)
        rows = np.ceil(v[part] - reach).astype(np.int64)[:, None] + offsets
        columns = np.ceil(u[part] - reach).astype(np.int64)[:, None] + offsets
        down = _blurred_box(rows - v[part, None], sigma_px) * -dv[part, None]
        rise = _blurred_step(columns[:, :-1] - u[part, None], sigma_px)
        across = np.diff(rise, axis=1, prepend=0.0, append=1.0)
        down[(rows < 0) | (rows >= height)] = 0.0
        # what lies left of the buffer still fills all of the row; what lies right of it fills nothing
        across[columns >= width] = 0.0
        index = np.clip(rows, 0, height - 1)[:, :, None] * width + np.clip(columns, 0, width - 1)[:, None, :]
        np.add.at(flat, index.ravel(), (down[:, :, None] * across[:, None, :]).ravel().astype(buffer.dtype))


def finish(buffer: NDArray[Any]) -> NDArray[Any]:
    """Turn summed contributions (H, W) into coverage, in place."""
    return np.cumsum(buffer, axis=1, out=buffer)


def signed_area(points_px: Array, dv_px: Array) -> Array:
    """Area (...) inside closed curves (..., K, 2) with changes of v (..., K): positive when u turns towards v."""
    return np.asarray((points_px[..., 0] * dv_px).sum(axis=-1))


def spectral_dv(v_px: Array) -> Array:
    """Changes of v (..., K) per sample of closed smooth curves sampled evenly in their parameter (..., K)."""
    count = v_px.shape[-1]
    frequency = np.fft.rfftfreq(count, 1.0 / count)
    if count % 2 == 0:
        frequency[-1] = 0.0
    turned = np.fft.rfft(v_px, axis=-1) * (1j * frequency)
    return np.asarray(np.fft.irfft(turned, count, axis=-1) * (2 * np.pi / count))


def circle(center_px: tuple[float, float], radius_px: float, sigma_px: float) -> tuple[Array, Array]:
    """Samples (K, 2) of a circle in the image plane and their changes of v (K,), with positive area."""
    count = max(32, int(np.ceil(2 * np.pi * radius_px / (STEP_SIGMAS * sigma_px))))
    t = np.arange(count) * (2 * np.pi / count)
    points = np.asarray(center_px) + radius_px * np.stack([np.cos(t), np.sin(t)], axis=-1)
    return points, radius_px * np.cos(t) * (2 * np.pi / count)


def polyline(corners_px: Array, sigma_px: float) -> tuple[Array, Array]:
    """Samples (K, 2) of a closed polyline (N, 2) and the changes of v (K,) they stand for: Gauss's rule on steps up to sigma."""
    sides = np.roll(corners_px, -1, axis=0) - corners_px
    cuts = np.maximum(1, np.ceil(np.linalg.norm(sides, axis=1) / (STEP_SIGMAS * sigma_px))).astype(np.int64)
    side = np.repeat(np.arange(len(sides)), cuts)
    first = np.arange(len(side)) - np.repeat(np.cumsum(cuts) - cuts, cuts)
    nodes, weights = np.polynomial.legendre.leggauss(POLYLINE_NODES)
    place = (first[:, None] + 0.5 * (nodes + 1)) / cuts[side, None]
    points = corners_px[side, None] + sides[side, None] * place[..., None]
    dv = (sides[side, 1] / cuts[side])[:, None] * (0.5 * weights)
    return points.reshape(-1, 2), dv.reshape(-1)


def panel_nodes() -> Array:
    """Where on a piece of a curve, from 0 to 1, `smooth_pieces` wants its samples (PANEL_NODES,)."""
    return np.asarray(0.5 * (np.polynomial.legendre.leggauss(PANEL_NODES)[0] + 1))


def smooth_pieces(pieces_px: Array, sigma_px: float) -> tuple[Array, Array, NDArray[np.int64]]:
    """Samples (K, 2) of smooth pieces of curves, the changes of v (K,) they stand for, and the piece (K,) that each is on.

    pieces_px (P, PANEL_NODES, 2): the images of the pieces' `panel_nodes`. Pieces are joined to closed curves by the caller.
    """
    x, _ = np.polynomial.legendre.leggauss(PANEL_NODES)
    coefficients = np.einsum("ij,pjk->pik", np.linalg.inv(np.polynomial.legendre.legvander(x, PANEL_NODES - 1)), pieces_px)
    slope = np.polynomial.legendre.legder(np.eye(PANEL_NODES), axis=0)
    length = np.linalg.norm(np.diff(pieces_px, axis=1), axis=-1).sum(axis=1) * 2 / (x[-1] - x[0])
    cuts = np.maximum(1, np.ceil(length / (SMOOTH_STEP_SIGMAS * sigma_px))).astype(np.int64)
    nodes, weights = np.polynomial.legendre.leggauss(SMOOTH_NODES)
    points, dv, piece = [], [], []
    for count in np.unique(cuts):
        chosen = np.flatnonzero(cuts == count)
        at = ((np.arange(count)[:, None] + 0.5 * (nodes + 1)) * (2 / count) - 1).ravel()
        value = np.polynomial.legendre.legvander(at, PANEL_NODES - 1)
        change = np.polynomial.legendre.legvander(at, PANEL_NODES - 2) @ slope * np.tile(weights / count, count)[:, None]
        points.append(np.einsum("qi,pik->pqk", value, coefficients[chosen]).reshape(-1, 2))
        dv.append((coefficients[chosen, :, 1] @ change.T).ravel())
        piece.append(np.repeat(chosen, len(at)))
    return np.concatenate(points), np.concatenate(dv), np.concatenate(piece)


def _blurred_box(x: Array, sigma_px: float) -> Array:
    return np.asarray(ndtr((x + 0.5) / sigma_px) - ndtr((x - 0.5) / sigma_px))


def _blurred_step(x: Array, sigma_px: float) -> Array:
    """Integral of the blurred box from -infinity to x."""
    return _ramp((x + 0.5) / sigma_px, sigma_px) - _ramp((x - 0.5) / sigma_px, sigma_px)


def _ramp(t: Array, sigma_px: float) -> Array:
    return np.asarray(sigma_px * (t * ndtr(t) + np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi)))
