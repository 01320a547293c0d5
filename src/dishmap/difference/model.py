"""How a surface may move between two photographs, as linear columns that every target feels.

Unknowns, in the order of the columns: rigid motion (3 moves in mm, 3 turns in rad, in the dish frame), uniform expansion, focal drift,
error of the calibration, displacement along the normal (a smooth random field), slide within the surface beyond the least-strain one.
Each column is scaled so that its coefficient has unit variance before the photographs are seen, up to the factor of its block.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from dishmap.camera.model import Camera
from dishmap.difference.changes import TargetChanges, rigid_columns, small_turn
from dishmap.surface.membrane import Fields, Membrane, Motion, bent, disc_points, membrane, sliding, zernike_values
from dishmap.targets.pattern import Pattern
from dishmap.transforms import Pose

Array = NDArray[Any]

# Wide enough to say nothing of the rigid motion left over after the alignment (micrometres), narrow enough for double precision.
FREE_MOVE_MM, FREE_TURN_RAD = 10.0, 0.03
# How points may follow a displacement along the normal: with the least strain (a membrane), staying on their normals, along the boresight
# (as axial deformations are often given), or in any smooth way. The number is the degree of the slide beyond that, if targets can show it.
WAYS = {"least_strain": 4, "normal": 4, "axial": 4, "any": 8}
# Degree of the displacement along the normal: what the targets can resolve, and a limit for the cost.
SMALLEST_DEGREE, LARGEST_DEGREE = 4, 14
# Terms that a surface may have besides its smooth random field: a rise as a whole, and those of the second degree.
COMMON = np.array([0, 3, 4, 5])
# Local unknowns of a target: rise and its two slopes, strain of its print xx, yy, xy.
LOCAL = 6
# Variance of a mode of the smooth field, relative to the largest, below which it is not followed.
LEAST_MODE = 1e-7
BLOCKS = ("rigid", "expansion", "focal", "calibration", "normal", "slide")


@dataclass(frozen=True)
class Surfaces:
    """What a set of targets has in common for all photographs: fields, their strain energy, the least-strain slide.

    motion: of the fields at the targets; value (N, terms) and slope (N, 2, terms) of the normal terms there, per radius; points (Q, 2) and
    projection (terms, Q) with which a function over the disc becomes normal terms.
    """

    fields: Fields
    form: Membrane
    slide: Array
    axes: Array
    xy_mm: Array
    motion: Motion
    value: Array
    slope: Array
    points: Array
    projection: Array

    @property
    def normal_count(self) -> int:
        """Number of normal terms; tangential coefficients follow them."""
        return len(self.fields.normal_terms)


def surfaces_of(pattern: Pattern, index: NDArray[np.int64]) -> Surfaces:
    """Fields over the pattern's disc, as fine as targets number `index` can resolve."""
    radius = pattern.rim_radius_mm
    degree = int(np.clip(np.floor(np.sqrt(2 * len(index)) - 1.5), SMALLEST_DEGREE, LARGEST_DEGREE))
    fields = Fields(pattern.surface, radius, degree)
    form = membrane(fields)
    axes, xy = pattern.axes[index], pattern.center_mm[index, :2]
    value, slope = zernike_values(fields.normal_terms, xy / radius)
    points, weight = disc_points(radius, 2 * degree)
    over, _ = zernike_values(fields.normal_terms, points / radius)
    projection = np.linalg.solve((over * weight[:, None]).T @ over, (over * weight[:, None]).T)
    slide = sliding(form, len(fields.normal_terms))
    return Surfaces(fields, form, slide, axes, xy, fields.at(xy, axes[..., :2]), value, slope, points, projection)


@dataclass(frozen=True)
class Columns:
    """Columns of all unknowns for N targets.

    change (N, 6, K): what the photographs see (move along camera axes, turn about target axes, the print's strain included);
    move (N, 3, K): true move in the dish frame, and gradient (N, 3, 2, K) its derivatives along the target's x and y axes; block (K,):
    index into BLOCKS; local (N, 6, 6): as change, for a target's own rise, slopes and strain; local_move (N, 3, 6); unexplained (N, 2):
    variance of rise and of each slope that a normal field of unit variance has beyond its columns; mean (K,): what is expected.
    """

    change: Array
    move: Array
    gradient: Array
    block: NDArray[np.int64]
    local: Array
    local_move: Array
    unexplained: Array
    mean: Array


@dataclass(frozen=True)
class Kernel:
    """Columns of a smooth random normal field of unit variance: Matern 5/2 with length `length_mm`.

    root (terms, modes): coefficients of independent unit parts; unexplained at the targets (N, 2).
    """

    length_mm: float
    root: Array
    unexplained: Array


def smooth_kernel(surfaces: Surfaces, length_mm: float) -> Kernel:
    """Project a smooth random field on the normal terms.

    A Matern 5/2 field (Rasmussen and Williams 2006, 4.2) and a mean, a defocus and both astigmatisms, all of unit variance.
    """
    points = surfaces.points
    distance = cdist(points, points) * (np.sqrt(5) / length_mm)
    kernel = (1 + distance + distance**2 / 3) * np.exp(-distance)
    covariance = surfaces.projection @ kernel @ surfaces.projection.T
    # a field that changes over short lengths has hardly any mean or broad bend of its own, and nothing says that the surface did not rise
    # as a whole; heat and gravity bend dishes as a whole first
    covariance[COMMON, COMMON] += 1.0
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    # what is left out counts as unexplained
    keep = values > LEAST_MODE * values.max()
    root = vectors[:, keep] * np.sqrt(values[keep])
    rise = 1 + (surfaces.value[:, COMMON] ** 2).sum(axis=1) - ((surfaces.value @ root) ** 2).sum(axis=1)
    # slopes of the field, mean of the two directions; a Matern 5/2 field has 5 / (3 length^2)
    broad = (surfaces.slope[..., COMMON] ** 2).sum(axis=(1, 2)) - ((surfaces.slope @ root) ** 2).sum(axis=(1, 2))
    slopes = 5 / (3 * length_mm**2) + 0.5 * broad / surfaces.fields.radius_mm**2
    return Kernel(length_mm, root, np.maximum(np.stack([rise, slopes], axis=-1), 0))


def columns_of(
    changes: TargetChanges, pattern: Pattern, camera: Camera, camera_from_dish: Pose, surfaces: Surfaces, kernel: Kernel, way: str
) -> Columns:
    """Columns of all unknowns at the targets of `changes` when points follow in one of WAYS.

    camera_from_dish: of the reference; the rigid motion taken out of the changes is put on it.
    """
    axes, motion = surfaces.axes, surfaces.motion
    count, terms = surfaces.normal_count, motion.move.shape[-1]
    along = np.zeros((terms, count))
    along[:count] = np.eye(count)
    if way == "least_strain":
        along[count:] = surfaces.slide
    moved = surfaces.fields.axial(surfaces.xy_mm, axes[..., :2]) if way == "axial" else motion
    coefficients = kernel.root if way == "axial" else along @ kernel.root
    parts = [
        _rigid(pattern.center_mm[changes.index], axes),
        _expansion(pattern.center_mm[changes.index], axes),
        moved.combined(coefficients),
        motion.combined(_free_slides(surfaces, min(WAYS[way], _slide_degree(len(axes))))),
    ]
    every = Motion(np.concatenate([p.move for p in parts], axis=-1), np.concatenate([p.gradient for p in parts], axis=-1))
    to_camera = (changes.moved @ camera_from_dish).rotation
    change = _felt(every, axes, to_camera, changes.by_strain)
    shared = np.concatenate([changes.by_focal[..., None], changes.by_calibration @ _root(camera)], axis=-1)
    change = np.concatenate([change[..., :7], shared, change[..., 7:]], axis=-1)
    # focal drift and calibration move nothing
    move, gradient = (
        np.concatenate([v[..., :7], np.zeros((*v.shape[:-1], shared.shape[-1])), v[..., 7:]], axis=-1) for v in (every.move, every.gradient)
    )
    modes = kernel.root.shape[1]
    sizes = [6, 1, 1, shared.shape[-1] - 1, modes, every.move.shape[-1] - 7 - modes]
    local, local_move = _local(axes, to_camera, changes.by_strain)
    block = np.repeat(np.arange(len(BLOCKS)), sizes)
    return Columns(change, move, gradient, block, local, local_move, kernel.unexplained, np.zeros(change.shape[-1]))


def curved_change(columns: Columns, pattern: Pattern, index: NDArray[np.int64], to_camera: Array, by_strain: Array, at: Array) -> Array:
    """What the photographs see (N, 6) at coefficients (K,), with turns and stretch exact, less the linear `change @ at`.

    A slope of s shortens a print by s^2 / 2 where it is seen from above; at 1 mm over 100 mm that is 0.05 mm of depth at 1 m.
    """
    axes = pattern.axes[index]
    gradient = columns.gradient @ at
    turn, strain = bent(gradient, axes[..., :2])
    exact = np.concatenate([(columns.move @ at) @ to_camera.T, small_turn(turn)], axis=1)
    flat = np.stack([strain[:, 0, 0], strain[:, 1, 1], strain[:, 0, 1]], axis=1)
    exact += np.einsum("nij,nj->ni", by_strain, flat)
    shared = columns.block == BLOCKS.index("focal")
    shared |= columns.block == BLOCKS.index("calibration")
    return np.asarray(exact - columns.change[..., ~shared] @ at[~shared])


def rigid_coefficients(coefficients: Array) -> Array:
    """Moves (mm) and turns (rad) of the rigid motion from rows of coefficients (K, ...)."""
    return np.asarray(coefficients[:6] * np.array([FREE_MOVE_MM] * 3 + [FREE_TURN_RAD] * 3)[:, None])


def _rigid(points: Array, axes: Array) -> Motion:
    """Moves (mm) and turns (rad) about the dish frame's origin, scaled to say nothing."""
    move = rigid_columns(points) * np.array([FREE_MOVE_MM] * 3 + [FREE_TURN_RAD] * 3)
    gradient = np.zeros((len(points), 3, 2, 6))
    for k in range(3):
        gradient[..., 3 + k] = np.cross(np.eye(3)[k], axes[..., :2], axisb=1, axisc=1) * FREE_TURN_RAD
    return Motion(move, gradient)


def _expansion(points: Array, axes: Array) -> Motion:
    return Motion(points[..., None], axes[..., :2][..., None])


def _slide_degree(targets: int) -> int:
    """Degree of slides that leaves half of what the targets show across the line of sight to check them: terms <= targets / 2."""
    return max(1, int(np.floor((np.sqrt(1 + 4 * targets) - 3) / 2)))


def _free_slides(surfaces: Surfaces, degree: int) -> Array:
    """Coefficients (K, S) of slides of unit mean squared strain each, broad ones only, whole slides left out."""
    count, fields = surfaces.normal_count, surfaces.fields
    broad = np.array([n <= degree for n, _ in fields.tangent_terms])
    rows = count + np.flatnonzero(np.tile(broad, 2))
    energy, held = surfaces.form.energy[np.ix_(rows, rows)], surfaces.form.held[:, rows]
    # slides that stay in place on the whole: the null space of `held`
    free = np.linalg.svd(held)[2][3:].T
    values, vectors = np.linalg.eigh(free.T @ energy @ free)
    out = np.zeros((surfaces.form.energy.shape[0], free.shape[1]))
    out[rows] = free @ (vectors / np.sqrt(np.maximum(values, values.max() * 1e-12)))
    return out / np.sqrt(free.shape[1])


def _felt(motion: Motion, axes: Array, to_camera: Array, by_strain: Array) -> Array:
    """Change of the measured poses (N, 6, K): move along camera axes, turn about target axes, and what strain looks like."""
    within = np.einsum("nia,nibk->nabk", axes, motion.gradient)
    turn = np.stack([within[:, 2, 1], -within[:, 2, 0], 0.5 * (within[:, 1, 0] - within[:, 0, 1])], axis=1)
    strain = np.stack([within[:, 0, 0], within[:, 1, 1], 0.5 * (within[:, 0, 1] + within[:, 1, 0])], axis=1)
    return np.concatenate([to_camera @ motion.move, turn], axis=1) + by_strain @ strain


def _local(axes: Array, to_camera: Array, by_strain: Array) -> tuple[Array, Array]:
    local, move = np.zeros((len(axes), 6, LOCAL)), np.zeros((len(axes), 3, LOCAL))
    move[..., 0] = axes[..., 2]
    local[:, :3, 0] = axes[..., 2] @ to_camera.T
    local[:, 4, 1], local[:, 3, 2] = -1.0, 1.0
    local[..., 3:] = by_strain
    return local, move


def _root(camera: Camera) -> Array:
    """A square root (P, R) of the camera's covariance; without columns when it has none."""
    if camera.covariance is None:
        return np.zeros((len(camera.parameters), 0))
    values, vectors = np.linalg.eigh(np.asarray(camera.covariance))
    keep = values > values.max(initial=0.0) * 1e-12
    return np.asarray(vectors[:, keep] * np.sqrt(values[keep]))
