"""Where a target's printed circles fall in the photograph: the smooth maps between its plane and the pixels around it.

Over one small target the whole chain (bent print, pose, perspective, lens) is smooth, so it is carried by low-degree
polynomials made afresh from exact projections at every step of a fit: pixel -> target plane, and the motion of the image
under each pose parameter. That makes the model of the pixels the same few lines for every lens and every surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.targets.pattern import bent_print_mm
from dishmap.targets.solve import solve_each

Array = NDArray[Any]
Pair = tuple[NDArray[Any], NDArray[Any]]

# Degrees of the pixel -> plane polynomial: the next one is used where one leaves more than MISFIT_PX, its own, anywhere on its nodes.
# An odd misfit moves the centre by a tenth of it or less, so that more may be left where more terms would be dear.
PLANE_DEGREES = (3, 5, 7, 9)
MISFIT_PX = 2e-4
MISFITS_PX = (MISFIT_PX, 4e-3, 4e-3, np.inf)
# Square of d plane / d pixel (mm/px) below which there is no direction: only at a circle's very centre.
SMALLEST_SLOPE = 1e-20
# Degree of the motion fields: they only steer the fit and give its Fisher information.
MOTION_DEGREE = 2


def powers(degree: int) -> list[tuple[int, int]]:
    """Exponents of two variables up to `degree`, in the order of `monomials`."""
    return [(total - j, j) for total in range(degree + 1) for j in range(total + 1)]


MOTION_TERMS = len(powers(MOTION_DEGREE))


def derivative_matrix(axis: int, degree: int) -> Array:
    """D with (c @ D) the coefficients of the derivative of the polynomial with coefficients c."""
    order = powers(degree)
    out = np.zeros((len(order), len(order)))
    for row, power in enumerate(order):
        if power[axis]:
            lower = (power[0] - 1, power[1]) if axis == 0 else (power[0], power[1] - 1)
            out[row, order.index(lower)] = power[axis]
    return out


DERIVATIVES = {degree: (derivative_matrix(0, degree), derivative_matrix(1, degree)) for degree in PLANE_DEGREES}


def monomials(s: NDArray[Any], t: NDArray[Any], degree: int) -> NDArray[Any]:
    """Monomials (..., K, n) of s, t (..., n) up to `degree`, in the order of their total degree."""
    out = np.empty((*s.shape[:-1], len(powers(degree)), s.shape[-1]), dtype=s.dtype)
    out[..., 0, :] = 1
    start = 1
    for total in range(1, degree + 1):
        before = start - total
        np.multiply(out[..., before : before + total, :], s[..., None, :], out=out[..., start : start + total, :])
        np.multiply(out[..., start - 1, :], t, out=out[..., start + total, :])
        start += total + 1
    return out


@dataclass(frozen=True)
class Poses:
    """Poses of T targets in the camera frame: camera_from_target rotation (T, 3, 3) and position_mm (T, 3)."""

    rotation: Array
    position_mm: Array

    def __len__(self) -> int:
        return len(self.position_mm)

    def take(self, index: NDArray[np.int64] | NDArray[Any] | slice) -> Poses:
        """Return the poses at `index`."""
        return Poses(self.rotation[index], self.position_mm[index])

    def in_camera(self, local_mm: Array) -> Array:
        """Points (T, Q, 3) of target axes in the camera frame."""
        return self.position_mm[:, None] + local_mm @ np.swapaxes(self.rotation, 1, 2)

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
class Patches:
    """Small areas of targets over which maps are fitted.

    target (M,) index; center_mm (M, 2) and reach_mm (M,) in its plane; anchor_px (M, 2) and scale_px (M,) of the pixel
    coordinates s = (u - anchor_u) / scale, t = (v - anchor_v) / scale.
    """

    target: NDArray[np.int64]
    center_mm: Array
    reach_mm: Array
    anchor_px: Array
    scale_px: Array


@dataclass(frozen=True)
class LocalMaps:
    """Polynomials over M patches in their coordinates s, t.

    plane (M, 6, K): coefficients of x, y in mm and of dx/du, dx/dv, dy/du, dy/dv (mm/px), so `plane @ monomials` gives all six;
    second (M, 6, K): of the second derivatives of x and of y by uu, uv, vv (mm/px^2);
    motion (M, 2, 6, L): of the pixel motion (u, v) under the six pose parameters; misfit_px (M,): largest error at the nodes.
    """

    plane: Array
    second: Array
    motion: Array
    misfit_px: Array
    degree: int

    @property
    def mm_per_px(self) -> tuple[Array, Array]:
        """Largest and least scale (M,), (M,) at the middle of each patch: the singular values of d plane / d pixel."""
        xu, xv, yu, yv = self.plane[:, 2:, 0].T
        # of a matrix [[a, b], [c, d]] they are the half sum and half difference of |(a + d, b - c)| and |(a - d, b + c)|
        one, other = np.hypot(xu + yv, xv - yu), np.hypot(xu - yv, xv + yu)
        return 0.5 * (one + other), 0.5 * np.abs(one - other)

    @cached_property
    def bend_per_px(self) -> Array:
        """How much (M,) the scale changes from pixel to pixel at the middle of each patch, as a share of itself, at most."""
        return np.asarray(np.linalg.norm(self.second[:, :, 0], axis=1) / np.maximum(self.mm_per_px[1], SMALLEST_SLOPE))


def project_printed(camera: Camera, poses: Poses, curvature_per_mm: Array, xy_mm: Array) -> tuple[Array, Array]:
    """Pixels (T, Q, 2) of printed positions, and their derivative by the six pose parameters (T, Q, 2, 6).

    The parameters are three moves in mm along `poses.steps` and three turns in rad about the target's own axes.
    """
    local = bent_print_mm(np.broadcast_to(xy_mm, (len(poses), *xy_mm.shape[-2:])), curvature_per_mm)
    pixels, by_point = camera.project_with_point_jacobian(poses.in_camera(local))
    rows = by_point.reshape(len(poses), -1, 3)
    moves, turned = ((rows @ m).reshape(by_point.shape) for m in (poses.steps, poses.rotation))
    # a turn w of the target moves its point p by w x p, so a row r of the derivative by p gives p x r
    return pixels, np.concatenate([moves, np.cross(local[:, :, None], turned)], axis=-1)


def local_maps(
    camera: Camera, poses: Poses, curvature_per_mm: Array, patches: Patches, before: LocalMaps | None = None, still: bool = False
) -> LocalMaps:
    """Fit the polynomial maps of M patches of T targets at their present poses; motion fields are taken from `before` if given.

    `still`: without motion fields (zeros), where pixels are only chosen.
    """
    many, curvature = poses.take(patches.target), curvature_per_mm[patches.target]
    for degree, most_px in zip(PLANE_DEGREES, MISFITS_PX, strict=True):
        plane, second, misfit = _plane_maps(camera, many, curvature, patches, degree)
        if np.max(np.where(np.isfinite(misfit), misfit, 0.0), initial=0.0) < most_px:
            break
    if still:
        motion = np.zeros((len(many), 2, 6, MOTION_TERMS))
    else:
        motion = _motion_maps(camera, many, curvature, patches) if before is None else before.motion
    return LocalMaps(plane, second, motion, misfit, degree)


def _nodes(patches: Patches, per_side: int) -> Array:
    # Chebyshev nodes keep the fit's error even up to the border
    axis = np.cos(np.pi * (np.arange(per_side) + 0.5) / per_side)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return patches.center_mm[:, None] + patches.reach_mm[:, None, None] * grid


def _basis(pixels: Array, patches: Patches, degree: int) -> Array:
    st = (pixels - patches.anchor_px[:, None]) / patches.scale_px[:, None, None]
    return monomials(st[..., 0], st[..., 1], degree)


def _plane_maps(camera: Camera, poses: Poses, curvature: Array, patches: Patches, degree: int) -> tuple[Array, Array, Array]:
    nodes = _nodes(patches, degree + 2)
    basis = _basis(camera.project(poses.in_camera(bent_print_mm(nodes, curvature))), patches, degree)
    lost = ~np.isfinite(basis).all(axis=(1, 2))
    basis[lost] = 0.0
    plane = least_squares(basis, np.swapaxes(nodes, 1, 2))
    error = np.linalg.norm(plane @ basis - np.swapaxes(nodes, 1, 2), axis=1).max(axis=1)
    misfit = np.where(lost, np.inf, error * patches.scale_px / patches.reach_mm)
    by_u, by_v = (d / patches.scale_px[:, None, None] for d in DERIVATIVES[degree])
    first = [plane @ by_u, plane @ by_v]
    second = [first[0] @ by_u, first[0] @ by_v, first[1] @ by_v]
    six = [plane[:, 0], plane[:, 1], *(d[:, axis] for axis in (0, 1) for d in first)]
    return np.stack(six, axis=1), np.stack([d[:, axis] for axis in (0, 1) for d in second], axis=1), misfit


def _motion_maps(camera: Camera, poses: Poses, curvature: Array, patches: Patches) -> Array:
    pixels, motion = project_printed(camera, poses, curvature, _nodes(patches, MOTION_DEGREE + 1))
    basis = _basis(pixels, patches, MOTION_DEGREE)
    basis[~np.isfinite(basis).all(axis=(1, 2))] = 0.0
    values = np.nan_to_num(motion).reshape(len(poses), -1, 12)
    return least_squares(basis, np.swapaxes(values, 1, 2)).reshape(len(poses), 2, 6, MOTION_TERMS)


def least_squares(basis: Array, values: Array) -> Array:
    """Batched least squares (M, K, Q), (M, V, Q) -> (M, V, K); the monomials' condition is mild on [-1, 1]."""
    normal = basis @ np.swapaxes(basis, 1, 2)
    # relative to each normal's size: a patch far off the image has large monomials, and must not make a singular matrix
    size = np.trace(normal, axis1=1, axis2=2)
    normal += 1e-14 * (1 + size[:, None, None]) * np.eye(basis.shape[1])
    return np.swapaxes(solve_each(normal, basis @ np.swapaxes(values, 1, 2)), 1, 2)


def plane_at_offsets(maps: LocalMaps, patches: Patches, rows: slice, du_px: Array, dv_px: Array) -> NDArray[np.float32]:
    """The six of `LocalMaps.plane` (M, 6, n) of patches `rows`, at the same offsets (n,) in pixels from all of their anchors."""
    # one set of monomials serves all patches, which differ in scale only
    unit = max(float(np.abs(du_px).max()), float(np.abs(dv_px).max()), 1.0)
    mono = monomials((du_px / unit).astype(np.float32), (dv_px / unit).astype(np.float32), maps.degree)
    order = np.sum(powers(maps.degree), axis=1)
    plane = maps.plane[rows] * (unit / patches.scale_px[rows, None, None]) ** order
    return (plane.reshape(-1, len(order)).astype(np.float32) @ mono).reshape(len(plane), 6, -1)


def edge_distance(
    six: NDArray[Any], center_mm: NDArray[Any], radius_mm: NDArray[Any], second: NDArray[Any] | None = None
) -> tuple[NDArray[Any], ...]:
    """Signed distance in pixels from points to one projected circle, positive inside.

    six (M, 6, n): x, y, dx/du, dx/dv, dy/du, dy/dv at each point; center_mm (M, 2) and radius_mm (M,) of each row's circle;
    second (M, 6, n): xuu, xuv, xvv, yuu, yuv, yvv, where the map is not to be taken as affine.
    Returns distance_px, unit outward normal u and v, px of edge motion per mm of radius, and the curvature of the projected
    circle at the foot point (1/px, positive for a convex inside), each (M, n).

    The distance is along the gradient n of rho = |x - center|, to where x + t J n meets the circle (J = d plane / d pixel):
    exact for a locally affine map. Level lines of rho are not parallel where the target is tilted; the plain ratio
    (R - rho) / |grad rho| would shift the edge by up to curvature * blur^2. `second` adds the next terms of the map: along n it
    shortens the way by t^2 e.h(n, n) / 2 |grad rho|, along the edge it bends it by e.h(t, t) / |grad rho|, e the radial direction.
    """
    x, y, xu, xv, yu, yv = (six[:, k] for k in range(6))
    radius = radius_mm[:, None]
    dx, dy = x - center_mm[:, :1], y - center_mm[:, 1:]
    square = dx * dx
    square += dy * dy
    # rho grad rho, its length, and the unit normal along it
    nu, nv = dx * xu, dx * xv
    nu += np.multiply(dy, yu)
    nv += np.multiply(dy, yv)
    along = nu * nu
    along += nv * nv
    root = np.maximum(along, SMALLEST_SLOPE)
    np.sqrt(root, out=along)
    inverse = 1 / along
    nu *= inverse
    nv *= inverse
    px_per_mm = np.sqrt(square)
    px_per_mm *= inverse
    wx, wy = xu * nu, yu * nu
    wx += np.multiply(xv, nv, out=inverse)
    wy += np.multiply(yv, nv, out=inverse)
    wx *= wx
    wy *= wy
    wx += wy
    distance = np.subtract(radius * radius, square, out=square)
    wx *= distance
    root += wx
    np.maximum(root, 0, out=root)
    np.sqrt(root, out=root)
    root += along
    distance /= root
    # |J t| for the tangent t, which has no radial part: det J / |grad rho|
    tangential = np.multiply(xu, yv, out=wx)
    tangential -= np.multiply(xv, yu, out=wy)
    tangential *= px_per_mm
    tangential *= tangential
    tangential *= px_per_mm
    tangential /= radius
    if second is not None:
        _bend(distance, tangential, (nu, nv), (dx / along, dy / along), second)
    return distance, nu, nv, px_per_mm, tangential


def _bend(distance: NDArray[Any], curvature: NDArray[Any], normal: Pair, radial: Pair, second: NDArray[Any]) -> None:
    """Add to distance and curvature, in place, what the map's second derivatives do; radial: e / |grad rho|."""
    nu, nv = normal
    uu, uv, vv = (radial[0] * second[:, k] + radial[1] * second[:, k + 3] for k in range(3))
    along = uu * nu * nu + 2 * uv * nu * nv + vv * nv * nv
    # h(t, t) for t = (-nv, nu); the trace of h is the sum of both
    curvature += uu + vv - along
    distance -= np.float32(0.5) * distance * distance * along
