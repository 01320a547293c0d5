"""What the actuators may do, as linear limits, and the best step within them.

Shift and tilt stay within boxes; a bent subreflector stays within its stroke at points spread over its rim's disc. A step minimises a
quadratic: it is a least-squares problem with linear inequalities, solved as a least-distance problem by non-negative least squares
(Lawson and Hanson, Solving Least Squares Problems, chapter 23), which ends on the exact set of active limits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from dishmap.rf.antenna import Actuators
from dishmap.rf.correction import RIGID, Correction, shape_terms
from dishmap.surface.zernike import term_name, zernike_matrix

Array = NDArray[np.float64]

# A value this near to its limit, as a share of the stroke, has reached it.
REACHED = 1e-4
# Points of the fan at which the stroke is a limit in a fit, and at which it is made sure of in the end.
FAN, FINE_FAN = 1, 4


@dataclass(frozen=True)
class Limits:
    """Limits of the P values that may move, of all that a correction has.

    used (P,): their places in the whole vector; scale (P,): full strokes, mm or degrees; heights (K, P): height of the subreflector at
    points of its disc for each of them (0 for shift and tilt); stroke_mm: how far those may go; size: of the whole vector.
    """

    used: NDArray[np.int64]
    scale: Array
    heights: Array
    stroke_mm: float
    size: int


def limits_of(actuators: Actuators, shape: bool) -> Limits:
    """The limits of an antenna's actuators; those without any stroke, and shape unless it is asked for, do not move."""
    terms = shape_terms(actuators)
    scale = np.array([*actuators.shift_mm, *actuators.tilt_deg, *[actuators.shape_stroke_mm] * len(terms)])
    moves = scale > 0
    moves[len(RIGID) :] &= shape
    used = np.flatnonzero(moves)
    heights = np.zeros((0, len(used)))
    if moves[len(RIGID) :].any():
        height = _fan(terms, FAN)
        heights = np.hstack([np.zeros((len(height), len(RIGID))), height])[:, used]
    return Limits(used, scale[used], heights, actuators.shape_stroke_mm, len(scale))


def limits_up_to(actuators: Actuators, degree: int) -> Limits:
    """The limits of a subreflector that is bent up to a degree only, 0 for none, for corrections with all its terms."""
    if not degree:
        return limits_of(actuators, False)
    lower = limits_of(replace(actuators, shape_degree=degree), True)
    return replace(lower, size=len(RIGID) + len(shape_terms(actuators)))


def value_names(actuators: Actuators) -> tuple[tuple[str, str], ...]:
    """Name and unit of each value of a correction."""
    rigid = [(name, "mm" if name.startswith("shift") else "deg") for name in RIGID]
    return (*rigid, *((f"shape_{term_name(*term)}", "mm") for term in shape_terms(actuators)))


def farthest_mm(actuators: Actuators, shape_mm: Array) -> float:
    """How far the farthest point of a subreflector's disc is bent, along z, by the terms of its shape (T,)."""
    terms = shape_terms(actuators)
    return float(np.abs(_fan(terms, FINE_FAN) @ shape_mm).max()) if terms else 0.0


def reached(actuators: Actuators, correction: Correction) -> tuple[str, ...]:
    """Names of limits that a correction has reached, `shape_stroke` for that of the subreflector's shape."""
    scale = np.array([*actuators.shift_mm, *actuators.tilt_deg])
    at = np.abs(correction.values[: len(RIGID)]) >= scale * (1 - REACHED)
    names = [name for name, full, there in zip(RIGID, scale, at, strict=True) if there and full > 0]
    stroke = actuators.shape_stroke_mm * (1 - 100 * REACHED)
    if shape_terms(actuators) and farthest_mm(actuators, correction.shape_mm) >= stroke:
        names.append("shape_stroke")
    return tuple(names)


def within(actuators: Actuators, values: Array) -> Array:
    """A correction's values held to their limits: boxes clipped, a shape beyond its stroke made smaller as a whole."""
    scale = np.array([*actuators.shift_mm, *actuators.tilt_deg])
    out = values.copy()
    out[: len(RIGID)] = np.clip(out[: len(RIGID)], -scale, scale)
    highest = farthest_mm(actuators, out[len(RIGID) :])
    if highest > actuators.shape_stroke_mm:
        out[len(RIGID) :] *= actuators.shape_stroke_mm / highest
    return out


def whole(limits: Limits, values: Array) -> Array:
    """The whole vector of a correction from the values (P,) that move."""
    out = np.zeros(limits.size)
    out[limits.used] = values
    return out


def best_step(slope: Array, bend: Array, limits: Limits, values: Array, turned: Array, scale: Array, reach: float) -> Array:
    """The step (Q,) that minimises slope . d + d . bend d / 2 within the limits, from a place inside them.

    values (P,): of the actuators; turned (Q - P,): all u and v there, which stay within +-reach; slope (Q,), bend (Q, Q), positive
    definite: per unit of `scale` (Q,).
    """
    root = np.linalg.cholesky(bend).T
    free = solve_triangular(root, solve_triangular(root, slope, trans="T"))
    rows, least = _inequalities(limits, values, turned / scale[len(values) :], reach / scale[len(values) :])
    if not len(rows) or (-(rows @ free) >= least).all():
        return -free * scale
    # y = R d + c, c = R^-T slope: the shortest y with (G R^-1) y >= h + G R^-1 c
    c = solve_triangular(root, slope, trans="T")
    turned = solve_triangular(root, rows.T, trans="T").T
    y = _least_distance(turned, least + turned @ c)
    return np.asarray(solve_triangular(root, y - c) * scale)


def _inequalities(limits: Limits, values: Array, turned: Array, reach: Array) -> tuple[Array, Array]:
    """G (M, Q) and h (M,) of G d >= h for steps d, everything in units of the scale."""
    box = np.flatnonzero(limits.used < len(RIGID))
    height = limits.heights * (limits.scale / limits.stroke_mm) if len(limits.heights) else np.zeros((0, len(values)))
    eye = np.eye(len(values) + len(turned))
    rows = np.concatenate([eye[box], np.hstack([height, np.zeros((len(height), len(turned)))]), eye[len(values) :]])
    room = np.concatenate([np.ones(len(box) + len(height)), reach])
    now = rows @ np.concatenate([values / limits.scale, turned])
    return np.concatenate([rows, -rows]), np.minimum(np.concatenate([-room - now, -room + now]), 0.0)


def _least_distance(rows: Array, least: Array) -> Array:
    """The shortest y with rows y >= least, which some y fulfils (Lawson and Hanson, algorithm LDP)."""
    # rows of one size keep the non-negative problem well scaled
    size = np.maximum(np.linalg.norm(rows, axis=1), 1e-300)
    longest = max(float(np.abs(least / size).max()), 1e-300)
    matrix = np.vstack([rows.T / size, least[None, :] / (size * longest)])
    right = np.zeros(len(matrix))
    right[-1] = 1.0
    share, _ = nnls(matrix, right, maxiter=30 * len(matrix))
    rest = matrix @ share - right
    return np.asarray(-rest[:-1] / rest[-1] * longest)


def _fan(terms: tuple[tuple[int, int], ...], finer: int) -> Array:
    """Terms (K, T) at points spread over the unit disc, rim included, so dense that a shape cannot rise unseen between them."""
    degree = max(n for n, _ in terms)
    rings, spokes = finer * (degree + 2), finer * (3 * degree + 3)
    rho = np.sin(np.pi / 2 * np.arange(1, rings + 1) / rings)
    phi = 2 * np.pi * np.arange(spokes) / spokes
    x, y = (np.concatenate([[0.0], np.outer(rho, way(phi)).ravel()]) for way in (np.cos, np.sin))
    return zernike_matrix(terms, x, y)
