"""The difference map: what moved between two states, target by target and as a whole, with covariance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from dishmap.camera.model import Camera
from dishmap.difference.changes import TargetChanges, rigid_columns, target_changes
from dishmap.difference.estimate import Hypothesis, JointEstimate, joint_estimate
from dishmap.difference.model import BLOCKS, rigid_coefficients
from dishmap.difference.priors import Priors
from dishmap.quality import Quality
from dishmap.surface.membrane import Fields, Motion, membrane, sliding
from dishmap.surface.zernike import zernike_terms
from dishmap.targets.pattern import Pattern
from dishmap.targets.pose import TargetPoses
from dishmap.transforms import Pose

Array = NDArray[Any]
Index = NDArray[np.int64]

# Zernike terms up to this degree are reported, fewer where targets are few (this many coordinates for each unknown).
ZERNIKE_DEGREE, COORDINATES_PER_TERM = 6, 3
# A change is called significant when chance alone would show it this rarely.
SIGNIFICANCE = 0.01
# Broadest modes of the field in which significance is looked for, and the least information on one, relative to the best seen.
TESTED_MODES, LEAST_SEEN = 20, 1e-9
EXPANSION, FOCAL, NORMAL = (BLOCKS.index(name) for name in ("expansion", "focal", "normal"))


@dataclass(frozen=True)
class Significance:
    """Whether the shape changed at all: chi-square of its broad modes against no change, its degrees of freedom, p value."""

    chi_square: float
    degrees: int
    p_value: float

    @property
    def changed(self) -> bool:
        """True when chance would show such a change in fewer than one of a hundred pairs."""
        return self.p_value < SIGNIFICANCE


@dataclass(frozen=True)
class Considered:
    """One way in which the surface may have moved: how points slide, correlation length, weight, log evidence, sizes of its priors."""

    way: str
    length_mm: float
    weight: float
    log_evidence: float
    sizes: dict[str, float]
    converged: bool


@dataclass(frozen=True)
class DifferenceMap:
    """What N targets did between two states, in mm.

    index, ids (N,); nominal_mm, normal (N, 3) in the dish frame. displacement_mm: total, along the nominal normal, positive towards
    the focus; depth_change_mm: total, along the camera's z; shape_mm: displacement with the best-fit rigid motion (or that of the rigid
    parts) removed; each with its standard deviation. du_dv_px (N, 2); misfit (N,): root of chi-square per degree of freedom of each target;
    quality (N,). shape_factor (N, R) and shape_own_mm2 (N,): covariance of the shape is factor factor^T + diag(own), and so for the
    displacement.
    rigid_motion: dish_from_dish, of the surface in the reference's dish frame, and its covariance (6, 6) of (move mm, turn rad).
    expansion, focal_drift: (mean, sigma), per unit; expansion_assumed: its prior; learnt: names of the sizes learnt;
    noise_factor: variance of the residuals over the claimed one, by which sigmas were enlarged; zernike_terms (n, m), zernike_mm (T,)
    and zernike_covariance_mm2 (T, T) of the displacement along the normal. rejected: (id, reason).
    """

    index: Index
    ids: Index
    nominal_mm: Array
    normal: Array
    displacement_mm: Array
    depth_change_mm: Array
    shape_mm: Array
    sigma_displacement_mm: Array
    sigma_depth_change_mm: Array
    sigma_shape_mm: Array
    du_dv_px: Array
    misfit: Array
    quality: Index
    displacement_factor: Array
    displacement_own_mm2: Array
    shape_factor: Array
    shape_own_mm2: Array
    rigid_motion: Pose
    rigid_covariance: Array
    expansion: tuple[float, float]
    expansion_assumed: tuple[float, float]
    focal_drift: tuple[float, float]
    zernike_terms: tuple[tuple[int, int], ...]
    zernike_mm: Array
    zernike_covariance_mm2: Array
    significance: Significance
    considered: tuple[Considered, ...]
    learnt: tuple[str, ...]
    noise_factor: float
    converged: bool
    priors: Priors
    camera_from_dish: Pose
    rejected: tuple[tuple[int, str], ...]

    def __len__(self) -> int:
        return len(self.ids)


def joint_difference(
    reference: TargetPoses,
    current: TargetPoses,
    camera: Camera,
    pattern: Pattern,
    priors: Priors | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> DifferenceMap:
    """Compare two measured states of one surface, seen by one camera (`combine_frames` averages several photographs of a state).

    Raises MeasurementError when fewer than three targets are common, InputError for a rigid target that the pattern does not have.
    """
    priors = priors or Priors()
    # matrices are small: threads would cost more than they bring, far more on a busy machine
    with threadpool_limits(limits=1, user_api="blas"):
        changes = target_changes(reference, current, camera, pattern)
        estimate = joint_estimate(changes, pattern, camera, reference.camera_from_dish, priors, progress)
        return _assembled(changes, estimate, pattern, reference, current, priors)


class _Frame:
    """What turns coefficients into outputs: the rigid alignment that was taken out, and linear functionals of the rest.

    With v (N, 3) the displacement left over, in the carried dish axes, a point goes to carry(X + v) in the reference's dish frame.
    """

    def __init__(self, changes: TargetChanges, pattern: Pattern, estimate: JointEstimate, camera_from_dish: Pose, way: str) -> None:
        self.points, self.normal = pattern.center_mm[changes.index], pattern.normal[changes.index]
        self.carry = camera_from_dish.inverse() @ changes.moved @ camera_from_dish
        self.carried = self.carry.apply(self.points) - self.points
        self.depth_axis = camera_from_dish.rotation[2]
        self.rigid = rigid_columns(self.points)
        self.parts_named = estimate.parts_named
        fields = estimate.surfaces.fields
        self.terms = _reported_terms(len(changes))
        modes = _mode_columns(fields, self.terms, pattern, changes.index, way)
        flat = np.concatenate([self.rigid, modes], axis=2).reshape(3 * len(self.points), -1)
        self.to_zernike = np.linalg.pinv(flat)[6:]
        self.to_rigid = np.linalg.pinv(self.rigid.reshape(-1, 6))

    def motion(self, small: Array) -> Pose:
        """The whole rigid motion (dish_from_dish) for a small one (6,) on top of the alignment."""
        return self.carry @ Pose.from_rotation_vector(small[3:], small[:3])

    def outputs(self, h: Hypothesis) -> _Outputs:
        """Displacement, depth change, shape (N each), rigid motion (6), Zernike terms, expansion and focal drift, stacked."""
        n, p, c = len(self.points), h.posterior, h.columns
        own_mm2 = p.local_covariance[:n, 0, 0]
        local = c.local_move[:n]
        mean = c.move[:n] @ p.mean + np.einsum("nij,nj->ni", local, p.local_mean[:n])
        factor = (c.move[:n] + local @ p.local_by[:n]) @ p.factor
        stacked = np.concatenate([mean[..., None], factor], axis=2)
        turned = self.carry.rotation.T
        small = self.to_rigid @ stacked.reshape(3 * n, -1)
        small_own = (self._along(self.to_rigid) ** 2) @ own_mm2
        if self.parts_named:
            small = rigid_coefficients(np.concatenate([p.mean[:, None], p.factor], axis=1))
            small_own = np.zeros(6)
        shape = stacked - self.rigid @ small
        shared = [np.concatenate([p.mean[rows, None], p.factor[rows]], axis=1) for rows in (c.block == EXPANSION, c.block == FOCAL)]
        across, deep = self.normal @ turned.T, turned @ self.depth_axis
        rows = [
            np.einsum("ni,nik->nk", across, stacked),
            np.einsum("i,nik->nk", deep, stacked),
            np.einsum("ni,nik->nk", self.normal, shape),
            small,
            self.to_zernike @ stacked.reshape(3 * n, -1),
            *shared,
        ]
        own = [
            (across * self.normal).sum(axis=1) ** 2 * own_mm2,
            (self.normal @ deep) ** 2 * own_mm2,
            own_mm2,
            small_own,
            (self._along(self.to_zernike) ** 2) @ own_mm2,
            np.zeros(2),
        ]
        every = np.concatenate(rows)
        return _Outputs(every[:, 0], every[:, 1:], np.concatenate(own))

    def _along(self, rows: Array) -> Array:
        """How functionals (Q, 3 N) of the displacement take a rise of each target along its normal (Q, N)."""
        return np.einsum("qni,ni->qn", rows.reshape(len(rows), len(self.points), 3), self.normal)


@dataclass(frozen=True)
class _Outputs:
    """Means (Q,), factors (Q, R) of the covariance and own variances (Q,) of stacked outputs."""

    mean: Array
    factor: Array
    own: Array


def _mixture(parts: list[_Outputs], weights: Array) -> _Outputs:
    """Mean and covariance of a mixture; the spread of the means is one column of the factor for each part."""
    mean = sum(w * p.mean for w, p in zip(weights, parts, strict=True))
    columns = [np.sqrt(w) * p.factor for w, p in zip(weights, parts, strict=True)]
    columns += [np.sqrt(w) * (p.mean - mean)[:, None] for w, p in zip(weights, parts, strict=True)]
    return _Outputs(
        np.asarray(mean), np.concatenate(columns, axis=1), np.asarray(sum(w * p.own for w, p in zip(weights, parts, strict=True)))
    )


def _reported_terms(targets: int) -> tuple[tuple[int, int], ...]:
    """Zernike terms beyond piston and tilt that this many targets carry."""
    for degree in range(ZERNIKE_DEGREE, 1, -1):
        terms = tuple(t for t in zernike_terms(degree) if t[0] > 1)
        if COORDINATES_PER_TERM * (len(terms) + 6) <= 3 * targets:
            return terms
    return ()


def _mode_columns(fields: Fields, terms: tuple[tuple[int, int], ...], pattern: Pattern, index: Index, way: str) -> Array:
    """Displacement (N, 3, T) of unit Zernike terms along the normal, with the slide that goes with them."""
    if not terms:
        return np.zeros((len(index), 3, 0))
    own = Fields(fields.surface, fields.radius_mm, max(n for n, _ in terms))
    axes, xy = pattern.axes[index][..., :2], pattern.center_mm[index, :2]
    motion = own.axial(xy, axes) if way == "axial" else _following(own, own.at(xy, axes), way)
    rows = [own.normal_terms.index(t) for t in terms]
    return np.asarray(motion.move[..., rows])


def _following(fields: Fields, motion: Motion, way: str) -> Motion:
    count = len(fields.normal_terms)
    along = np.zeros((motion.move.shape[-1], count))
    along[:count] = np.eye(count)
    if way == "least_strain":
        along[count:] = sliding(membrane(fields), count)
    return motion.combined(along)


def _significance(changes: TargetChanges, estimate: JointEstimate, best: Hypothesis) -> Significance:
    """Score test of the broad modes of the normal displacement, with rigid motion and what is shared left free (Rao 1948)."""
    columns, n = best.columns, len(changes)
    weight = estimate.kept / estimate.noise_factor
    test = np.flatnonzero(columns.block == NORMAL)[-TESTED_MODES:]
    rest = np.flatnonzero(columns.block < NORMAL)
    scale = np.ones(len(columns.block))
    scale[columns.block == EXPANSION], scale[columns.block == FOCAL] = best.posterior.sizes.expansion, best.posterior.sizes.focal
    rows = np.concatenate([rest, test])
    change = columns.change[:n][..., rows] * scale[rows]
    score = changes.score - np.einsum("nij,njk,k->ni", changes.information, columns.change[:n], columns.mean, optimize=True)
    information = changes.information * weight[:, None, None]
    flat = change.reshape(-1, len(rows))
    normal, right = flat.T @ (information @ change).reshape(flat.shape), flat.T @ (score * weight[:, None]).reshape(-1)
    k = len(rest)
    normal[range(k), range(k)] += 1.0
    solved = np.linalg.solve(normal[:k, :k], np.concatenate([normal[:k, k:], right[:k, None]], axis=1))
    left, spread = right[k:] - normal[k:, :k] @ solved[:, -1], normal[k:, k:] - normal[k:, :k] @ solved[:, :-1]
    values, vectors = np.linalg.eigh(spread)
    seen = values > values.max(initial=0.0) * LEAST_SEEN
    chi_square = float((((vectors.T @ left)[seen]) ** 2 / values[seen]).sum())
    degrees = int(seen.sum())
    return Significance(chi_square, degrees, float(chi2.sf(chi_square, degrees)) if degrees else 1.0)


def _considered(h: Hypothesis, weight: float) -> Considered:
    sizes = {name: float(value) for name, value in asdict(h.posterior.sizes).items()}
    return Considered(h.way, h.length_mm, float(weight), h.log_weight, sizes, h.converged)


def _rejected(changes: TargetChanges, estimate: JointEstimate, reference: TargetPoses, current: TargetPoses) -> tuple[tuple[int, str], ...]:
    """(id, reason) of all targets of the two states that have no row, and of those whose change was not used."""
    out = [(i, f"reference: {why}") for i, why in reference.rejected] + [(i, f"current: {why}") for i, why in current.rejected]
    told = {i for i, _ in out}
    for name, here, there in (("reference", reference, current), ("current", current, reference)):
        only = np.setdiff1d(here.ids, there.ids)
        out += [(int(i), f"measured in the {name} photograph only") for i in only if int(i) not in told]
    aside = changes.ids[estimate.kept <= 0]
    out += [(int(i), "its change fits no smooth motion of the surface; its row holds what its neighbours say") for i in aside]
    return tuple(sorted(out))


def _assembled(
    changes: TargetChanges, estimate: JointEstimate, pattern: Pattern, reference: TargetPoses, current: TargetPoses, priors: Priors
) -> DifferenceMap:
    n = len(changes)
    best = estimate.hypotheses[int(np.argmax(estimate.weights))]
    frame = _Frame(changes, pattern, estimate, reference.camera_from_dish, best.way)
    mixed = _mixture([frame.outputs(h) for h in estimate.hypotheses], estimate.weights)
    variance = (mixed.factor**2).sum(axis=1) + mixed.own
    ends = np.cumsum([n, n, n, 6, len(frame.terms), 1, 1])
    moved, deep, shape, rigid, zernike, expansion, focal = (slice(int(a), int(b)) for a, b in zip([0, *ends], ends, strict=False))

    def covariance(rows: slice) -> Array:
        return np.asarray(mixed.factor[rows] @ mixed.factor[rows].T + np.diag(mixed.own[rows]))

    def with_sigma(rows: slice) -> tuple[float, float]:
        return float(mixed.mean[rows][0]), float(np.sqrt(variance[rows][0]))

    return DifferenceMap(
        index=changes.index,
        ids=changes.ids,
        nominal_mm=frame.points,
        normal=frame.normal,
        displacement_mm=mixed.mean[moved] + (frame.carried * frame.normal).sum(axis=1),
        depth_change_mm=mixed.mean[deep] + frame.carried @ frame.depth_axis,
        shape_mm=mixed.mean[shape],
        sigma_displacement_mm=np.sqrt(variance[moved]),
        sigma_depth_change_mm=np.sqrt(variance[deep]),
        sigma_shape_mm=np.sqrt(variance[shape]),
        du_dv_px=changes.du_dv_px,
        misfit=np.sqrt(np.maximum(estimate.misfit, 0.0) / np.maximum(changes.directions, 1)),
        quality=changes.quality
        | np.where(estimate.kept > 0, 0, int(Quality.OUTLIER))
        | np.where(estimate.loose, int(Quality.OFF_SURFACE), 0),
        displacement_factor=mixed.factor[moved],
        displacement_own_mm2=mixed.own[moved],
        shape_factor=mixed.factor[shape],
        shape_own_mm2=mixed.own[shape],
        rigid_motion=frame.motion(mixed.mean[rigid]),
        rigid_covariance=covariance(rigid),
        expansion=with_sigma(expansion),
        expansion_assumed=estimate.expansion,
        focal_drift=with_sigma(focal),
        zernike_terms=frame.terms,
        zernike_mm=mixed.mean[zernike],
        zernike_covariance_mm2=covariance(zernike),
        significance=_significance(changes, estimate, best),
        considered=tuple(_considered(h, w) for h, w in zip(estimate.hypotheses, estimate.weights, strict=True)),
        learnt=estimate.learnt,
        noise_factor=estimate.noise_factor,
        converged=all(h.converged for h in estimate.hypotheses),
        priors=priors,
        camera_from_dish=reference.camera_from_dish,
        rejected=_rejected(changes, estimate, reference, current),
    )
