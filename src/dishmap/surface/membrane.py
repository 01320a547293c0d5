"""Displacement fields on the nominal surface, and how a thin membrane slides within itself when it bends.

A field gives every point of the nominal surface X(x, y) a displacement d(x, y) in the dish frame. What a printed target feels is d and
its gradient along the surface: the target moves by d, turns, and its print is stretched by the membrane strain
E_ab = (X_a . d_b + X_b . d_a) / 2 (Ciarlet, Mathematical Elasticity III, 2.4; linear).

A membrane resists stretch far more than bending. Given how far each point moves along the normal, its points slide within the surface
so that the strain energy is least; nothing else holds a membrane between its supports. `sliding` gives that slide as a linear map.
The energy is the integral of the squared strain (Poisson's ratio 0; a ratio of 0.3 changes slides by a few per cent).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.surface.zernike import zernike_gradient, zernike_terms, zernike_xy
from dishmap.targets.pattern import Surface

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """What fields do at P points of the surface, per unit of each of K coefficients.

    move (P, 3, K): displacement in the dish frame; gradient (P, 3, 2, K): its derivative along two orthonormal tangent axes
    (P, 3, 2) given with the points, mm per mm.
    """

    move: Array
    gradient: Array

    def combined(self, matrix: Array) -> Motion:
        """The motion of fields that are combinations of these: columns of `matrix` (K, L)."""
        count = self.move.shape[-1]
        move, gradient = self.move.reshape(-1, count) @ matrix, self.gradient.reshape(-1, count) @ matrix
        return Motion(move.reshape(*self.move.shape[:-1], -1), gradient.reshape(*self.gradient.shape[:-1], -1))

    def strain(self, axes: Array) -> Array:
        """Membrane strain (P, 2, 2, K) in the tangent axes (P, 3, 2)."""
        within = np.einsum("pic,pibk->pcbk", axes, self.gradient)
        return np.asarray(0.5 * (within + np.swapaxes(within, 1, 2)))


@dataclass(frozen=True)
class Fields:
    """Polynomial displacement fields over the disc of `radius_mm`: Zernike terms up to `degree` times a direction.

    Coefficients, in order: displacement along the normal (one per term of `degree`), then along the two tangent directions dX/dx
    and dX/dy (one each per term of `degree + 1`).
    """

    surface: Surface
    radius_mm: float
    degree: int

    @property
    def normal_terms(self) -> tuple[tuple[int, int], ...]:
        """Zernike terms (n, m) of the displacement along the normal."""
        return zernike_terms(self.degree)

    @property
    def tangent_terms(self) -> tuple[tuple[int, int], ...]:
        """Zernike terms of each tangential component; one degree more, as strain holds their derivative."""
        return zernike_terms(self.degree + 1)

    def at(self, xy_mm: ArrayLike, axes: Array) -> Motion:
        """The fields at points (P, 2) with tangent axes (P, 3, 2) in the dish frame: columns for all coefficients."""
        xy = np.asarray(xy_mm, dtype=float)
        frame = _frame(self.surface, xy)
        value, slope = zernike_values(self.tangent_terms, xy / self.radius_mm)
        slope = slope / self.radius_mm
        # terms are in the order of their degree, so the normal ones come first
        few = len(self.normal_terms)
        parts = [_times(value[:, :few], slope[..., :few], frame.normal, frame.normal_by)]
        parts += [_times(value, slope, frame.tangent[..., k], frame.tangent_by[..., k, :]) for k in range(2)]
        move = np.concatenate([p[0] for p in parts], axis=-1)
        by_xy = np.concatenate([p[1] for p in parts], axis=-1)
        return Motion(move, _along(by_xy, frame, axes))

    def axial(self, xy_mm: ArrayLike, axes: Array) -> Motion:
        """As the displacements along the normal, but by motion along the boresight: as far along it as the normal part needs."""
        xy = np.asarray(xy_mm, dtype=float)
        frame = _frame(self.surface, xy)
        up, up_by = np.zeros_like(frame.normal), np.zeros_like(frame.normal_by)
        up[:, 2] = 1 / frame.normal[:, 2]
        up_by[:, 2] = -frame.normal_by[:, 2] / frame.normal[:, 2:] ** 2
        value, slope = zernike_values(self.normal_terms, xy / self.radius_mm)
        move, by_xy = _times(value, slope / self.radius_mm, up, up_by)
        return Motion(move, _along(by_xy, frame, axes))


def _times(value: Array, slope: Array, direction: Array, direction_by: Array) -> tuple[Array, Array]:
    """Displacement (P, 3, K) and derivatives by x and y (P, 3, 2, K) of terms (P, K) with slopes (P, 2, K) times a direction (P, 3)."""
    move = direction[:, :, None] * value[:, None, :]
    by = direction[:, :, None, None] * slope[:, None] + direction_by[..., None] * value[:, None, None, :]
    return move, by


def _along(by_xy: Array, frame: _Frame, axes: Array) -> Array:
    """Derivatives by x and y (P, 3, 2, K) as derivatives along tangent axes (P, 3, 2)."""
    to_axes = np.linalg.inv(np.swapaxes(axes, 1, 2) @ frame.tangent)
    return np.asarray(np.swapaxes(to_axes, 1, 2)[:, None] @ by_xy)


def zernike_values(terms: tuple[tuple[int, int], ...], xy: Array) -> tuple[Array, Array]:
    """Zernike terms (P, K) and their gradients (P, 2, K) at points (P, 2) in units of the radius."""
    value = np.stack([zernike_xy(n, m, xy[:, 0], xy[:, 1]) for n, m in terms], axis=-1)
    slope = np.stack([np.stack(zernike_gradient(n, m, xy[:, 0], xy[:, 1]), axis=-1) for n, m in terms], axis=-1)
    return value, slope


@dataclass(frozen=True)
class _Frame:
    """Tangents dX/dx, dX/dy (P, 3, 2), unit normal (P, 3) and their derivatives by x and y (last axis)."""

    tangent: Array
    tangent_by: Array
    normal: Array
    normal_by: Array


def _frame(surface: Surface, xy: Array) -> _Frame:
    count = len(xy)
    slope, bend = surface.slope(xy), surface.bend_per_mm(xy)
    tangent, tangent_by = np.zeros((count, 3, 2)), np.zeros((count, 3, 2, 2))
    tangent[:, 0, 0] = tangent[:, 1, 1] = 1
    tangent[:, 2] = slope
    tangent_by[:, 2] = bend
    upward = np.concatenate([-slope, np.ones((count, 1))], axis=1)
    length = np.linalg.norm(upward, axis=1)
    upward_by = np.zeros((count, 3, 2))
    upward_by[:, :2] = -bend
    length_by = np.einsum("ni,nij->nj", slope, bend) / length[:, None]
    normal = upward / length[:, None]
    normal_by = (upward_by - normal[:, :, None] * length_by[:, None]) / length[:, None, None]
    return _Frame(tangent, tangent_by, normal, normal_by)


def tangent_axes(surface: Surface, xy_mm: Array) -> Array:
    """Orthonormal tangent axes (P, 3, 2) at points (P, 2)."""
    return np.asarray(np.linalg.qr(_frame(surface, xy_mm).tangent)[0])


def disc_points(radius_mm: float, degree: int) -> tuple[Array, Array]:
    """Points (Q, 2) and weights (Q,) that integrate polynomials up to `degree` over the disc exactly (in x, y)."""
    rings, turns = degree // 2 + 2, degree + 2
    node, weight = np.polynomial.legendre.leggauss(rings)
    radius = radius_mm * np.sqrt(0.5 * (node + 1))
    angle = 2 * np.pi * (np.arange(turns) + 0.5) / turns
    xy = (radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).reshape(-1, 2)
    return xy, np.repeat(weight * np.pi * radius_mm**2 / 2 / turns, turns)


@dataclass(frozen=True)
class Membrane:
    """Forms over the disc of K coefficients: energy (K, K), the mean squared strain; held (3, K), mean moves in x and y and mean turn."""

    energy: Array
    held: Array


def membrane(fields: Fields) -> Membrane:
    """Strain energy and mean rigid slides of the fields, by exact quadrature over the disc."""
    xy, weight = disc_points(fields.radius_mm, 2 * fields.degree + 6)
    axes = tangent_axes(fields.surface, xy)
    motion = fields.at(xy, axes)
    strain = motion.strain(axes)
    area = weight * np.linalg.norm(np.cross(*np.moveaxis(_frame(fields.surface, xy).tangent, -1, 0)), axis=-1)
    share = area / area.sum()
    flat = (strain * np.sqrt(share)[:, None, None, None]).reshape(-1, strain.shape[-1])
    move = motion.move
    turn = (xy[:, :1] * move[:, 1] - xy[:, 1:] * move[:, 0]) / fields.radius_mm
    held = np.stack([share @ move[:, 0], share @ move[:, 1], share @ turn])
    return Membrane(flat.T @ flat, held)


def sliding(form: Membrane, normal_count: int) -> Array:
    """Tangential coefficients (K - normal_count, normal_count) that follow the normal ones with the least strain.

    The slide as a whole stays in place: a dish that turns about its centre of curvature hardly strains, but its hub holds it.
    """
    rest, held = slice(normal_count, None), form.held
    count = form.energy.shape[0] - normal_count
    scale = np.trace(form.energy[rest, rest]) / count
    system = np.zeros((count + 3, count + 3))
    system[:count, :count] = form.energy[rest, rest] / scale
    system[:count, count:], system[count:, :count] = held[:, rest].T, held[:, rest]
    right = np.zeros((count + 3, normal_count))
    right[:count] = -form.energy[rest, :normal_count] / scale
    return np.asarray(np.linalg.solve(system, right)[:count])


def bent(gradient: Array, axes: Array) -> tuple[Array, Array]:
    """Turn (P, 3, 3) and strain (P, 2, 2) of small pieces of surface under a displacement gradient (P, 3, 2), exactly.

    axes (P, 3, 2): orthonormal tangent axes. The piece's deformed axes are axes + gradient; their polar decomposition within the
    deformed tangent plane gives the rotation and the stretch (Ciarlet, Mathematical Elasticity I, 3.2).
    """
    deformed = axes + gradient
    u, stretch, vt = np.linalg.svd(deformed, full_matrices=False)
    nearest = u @ vt
    strain = np.swapaxes(vt, 1, 2) @ ((stretch - 1)[:, :, None] * vt)
    after = np.concatenate([nearest, np.cross(nearest[..., 0], nearest[..., 1])[..., None]], axis=-1)
    before = np.concatenate([axes, np.cross(axes[..., 0], axes[..., 1])[..., None]], axis=-1)
    return np.swapaxes(before, 1, 2) @ after, strain
