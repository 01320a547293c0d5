"""Where a target's printed circles fall in the photograph: the smooth maps between its plane and the pixels around it.

Over one small target the whole chain (bent print, pose, perspective, lens) is smooth, so it is carried by low-degree
polynomials made afresh from exact projections at every step of a fit: pixel -> target plane, and the motion of the image
under each pose parameter. That makes the model of the pixels the same few lines for every lens and every surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.transforms import cross_matrix

Array = NDArray[np.float64]

# Degree of the pixel -> plane polynomial; at 5 a target 0.1 rad wide, tilted 60 degrees, leaves under 1e-4 px.
PLANE_DEGREE = 5
# Degree of the motion fields: they only steer the fit and give its Fisher information.
MOTION_DEGREE = 2
NODES_PER_SIDE = 8


def _powers(degree: int) -> list[tuple[int, int]]:
    return [(total - j, j) for total in range(degree + 1) for j in range(total + 1)]


POWERS = _powers(PLANE_DEGREE)
MOTION_TERMS = len(_powers(MOTION_DEGREE))


def _derivative_matrix(axis: int) -> Array:
    """D with (D @ c) the coefficients of the derivative of the polynomial with coefficients c."""
    out = np.zeros((len(POWERS), len(POWERS)))
    for column, power in enumerate(POWERS):
        if power[axis]:
            lower = (power[0] - 1, power[1]) if axis == 0 else (power[0], power[1] - 1)
            out[POWERS.index(lower), column] = power[axis]
    return out


BY_U, BY_V = _derivative_matrix(0), _derivative_matrix(1)


def monomials(s: NDArray[np.floating], t: NDArray[np.floating], degree: int = PLANE_DEGREE) -> NDArray[np.floating]:
    """Monomials (..., K) of s, t up to `degree`, in the order of their total degree."""
    out = np.empty((*s.shape, len(_powers(degree))), dtype=s.dtype)
    out[..., 0] = 1
    start = 1
    for total in range(1, degree + 1):
        before = start - total
        np.multiply(out[..., before : before + total], s[..., None], out=out[..., start : start + total])
        np.multiply(out[..., start - 1], t, out=out[..., start + total])
        start += total + 1
    return out


@dataclass(frozen=True)
class Poses:
    """Poses of T targets in the camera frame: camera_from_target rotation (T, 3, 3) and position_mm (T, 3)."""

    rotation: Array
    position_mm: Array

    def __len__(self) -> int:
        return len(self.position_mm)

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_] | slice) -> Poses:
        """Return the poses at `index`."""
        return Poses(self.rotation[index], self.position_mm[index])

    @property
    def steps(self) -> Array:
        """Axes (T, 3, 3) for small moves: two columns across the line of sight, the third along it.

        Across and along are then nearly uncorrelated; along the camera's z they would not be, off the axis.
        """
        ray = self.position_mm / np.linalg.norm(self.position_mm, axis=1, keepdims=True)
        helper = np.where(np.abs(ray[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        across = np.cross(ray, helper)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        return np.stack([np.cross(across, ray), across, ray], axis=-1)


@dataclass(frozen=True)
class LocalMaps:
    """Polynomials around each of T targets, in s = (u - anchor_u) / scale, t = (v - anchor_v) / scale.

    plane (T, K, 6): x, y in mm and their derivatives by u and v (mm/px), so that `monomials @ plane` gives all six;
    motion (T, L, 2, 6): pixel motion (u, v) by the six pose parameters; anchor_px (T, 2); scale_px (T,);
    misfit_px (T,): largest error of the plane polynomial at its nodes.
    """

    anchor_px: Array
    scale_px: Array
    plane: Array
    motion: Array
    misfit_px: Array


def printed_points(xy_mm: Array, curvature_per_mm: Array) -> Array:
    """Points (T, Q, 3) in target axes of printed positions (Q, 2) or (T, Q, 2) on surfaces with curvature (T, 2, 2).

    A print keeps its lengths along the surface, so a position is followed along its geodesic, to third order:
    v + (v K v) / 2 normal - (v K v) K v / 6 (do Carmo, Differential Geometry, 4.4). The last term is 0.5 micrometres
    at 10 mm on a 0.6 m dish of f/D 0.5, which is 0.03 mm in depth.
    """
    xy = np.broadcast_to(xy_mm, (len(curvature_per_mm), *xy_mm.shape[-2:]))
    bent = np.einsum("tij,tqj->tqi", curvature_per_mm, xy)
    twice_sag = (xy * bent).sum(axis=-1, keepdims=True)
    return np.concatenate([xy - twice_sag * bent / 6, 0.5 * twice_sag], axis=-1)


def project_printed(camera: Camera, poses: Poses, curvature_per_mm: Array, xy_mm: Array) -> tuple[Array, Array]:
    """Pixels (T, Q, 2) of printed positions, and their derivative by the six pose parameters (T, Q, 2, 6).

    The parameters are three moves in mm along `poses.steps` and three turns in rad about the target's own axes.
    """
    local = printed_points(xy_mm, curvature_per_mm)
    points = poses.position_mm[:, None] + np.einsum("tij,tqj->tqi", poses.rotation, local)
    pixels, by_point, _ = camera.project_with_jacobians(points)
    moves = by_point @ poses.steps[:, None]
    turns = by_point @ (poses.rotation[:, None] @ -cross_matrix(local))
    return pixels, np.concatenate([moves, turns], axis=-1)


def local_maps(camera: Camera, poses: Poses, curvature_per_mm: Array, reach_mm: float, anchor_px: Array, scale_px: Array) -> LocalMaps:
    """Fit the polynomial maps of T targets over printed positions within `reach_mm` of their origins."""
    # Chebyshev nodes keep the fit's error even up to the border
    axis = reach_mm * np.cos(np.pi * (np.arange(NODES_PER_SIDE) + 0.5) / NODES_PER_SIDE)
    nodes = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    pixels, motion = project_printed(camera, poses, curvature_per_mm, nodes)
    st = (pixels - anchor_px[:, None]) / scale_px[:, None, None]
    basis = monomials(st[..., 0], st[..., 1])
    lost = ~np.isfinite(basis).all(axis=(1, 2))
    basis[lost] = 0.0
    plane = _least_squares(basis, np.broadcast_to(nodes, (len(poses), *nodes.shape)))
    few = basis[..., :MOTION_TERMS]
    fields = _least_squares(few, np.nan_to_num(motion).reshape(len(poses), len(nodes), 12))
    by_u, by_v = BY_U @ plane / scale_px[:, None, None], BY_V @ plane / scale_px[:, None, None]
    error_mm = np.linalg.norm(basis @ plane - nodes, axis=-1).max(axis=1)
    per_mm = scale_px / reach_mm
    all_six = np.concatenate([plane, by_u, by_v], axis=-1)[..., [0, 1, 2, 4, 3, 5]]
    misfit = np.where(lost, np.inf, error_mm * per_mm)
    return LocalMaps(anchor_px, scale_px, all_six, fields.reshape(len(poses), MOTION_TERMS, 2, 6), misfit)


def _least_squares(basis: Array, values: Array) -> Array:
    """Batched least squares (T, Q, K), (T, Q, V) -> (T, K, V); the monomials' condition is mild on [-1, 1]."""
    normal = np.swapaxes(basis, -1, -2) @ basis
    normal += 1e-14 * np.eye(basis.shape[-1])
    return np.linalg.solve(normal, np.swapaxes(basis, -1, -2) @ values)


def edge_distance(
    six: NDArray[np.floating], center_mm: NDArray[np.floating], radius_mm: NDArray[np.floating]
) -> tuple[NDArray[np.floating], ...]:
    """Signed distance in pixels from points to one projected circle, positive inside.

    six (..., 6): x, y, dx/du, dx/dv, dy/du, dy/dv at each point; center_mm (..., 2) and radius_mm broadcast to its shape
    without the last axis. Returns distance_px, unit outward normal u and v, px of edge motion per mm of radius, and the
    curvature of the projected circle at the foot point (1/px, positive for a convex inside).

    Second order in the distance: along the outward normal n, rho(t) = rho + m t + (tau^2 / rho) t^2 / 2 with m = |grad rho|
    and tau the sideways part of J n, solved for rho(t) = R. Level lines of rho are not parallel where the target is tilted;
    the plain ratio (R - rho) / m would shift the edge by up to curvature * blur^2.
    """
    dx, dy = six[..., 0] - center_mm[..., 0], six[..., 1] - center_mm[..., 1]
    rho = np.sqrt(dx * dx + dy * dy)
    inverse = 1 / np.maximum(rho, 1e-6)
    ex, ey = dx * inverse, dy * inverse
    gu = ex * six[..., 2] + ey * six[..., 4]
    gv = ex * six[..., 3] + ey * six[..., 5]
    px_per_mm = 1 / np.sqrt(gu * gu + gv * gv)
    nu, nv = gu * px_per_mm, gv * px_per_mm
    hu = ex * six[..., 4] - ey * six[..., 2]
    hv = ex * six[..., 5] - ey * six[..., 3]
    sideways = hu * nu + hv * nv
    tangential = hv * nu - hu * nv
    first = (radius_mm - rho) * px_per_mm
    distance = first - 0.5 * sideways * sideways * inverse * px_per_mm * first * first
    curvature = tangential * tangential * px_per_mm / radius_mm
    return distance, nu, nv, px_per_mm, curvature
