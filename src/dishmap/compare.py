"""What changed between two states, as one short chain: photographs -> measured states -> differences, tables and surfaces."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from dishmap.camera.model import Camera
from dishmap.camera.undistort import pinhole_camera
from dishmap.difference.changes import combine_frames
from dishmap.difference.difference_map import DifferenceMap, joint_difference
from dishmap.difference.paper import Centers, PaperDifference, paper_difference
from dishmap.difference.priors import Priors
from dishmap.errors import FitError, InputError, MeasurementError
from dishmap.pipeline import cloud_of, map_photograph
from dishmap.surface.cloud import PointCloud
from dishmap.surface.fit import Basis, SurfaceFit, fit_surface, surface_heights
from dishmap.targets.identify import Anchors, Hint, PoseGuess
from dishmap.targets.paper import PaperPoses
from dishmap.targets.pattern import Pattern
from dishmap.targets.pose import TargetPoses
from dishmap.targets.stages import Assumptions

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Tell = Callable[[int, int], None]

DIFFERENCE_METHODS = ("joint", "paper", "all")
JOINT, PAPER = "joint", "paper"
# Names of the surfaces of a difference: through the joint estimate's displacement and shape, and the paper's own.
DISPLACEMENT, SHAPE = "displacement", "shape"
# Surfaces have this degree by default, less where that leaves fewer targets than this for each coefficient.
DEFAULT_DEGREE, TARGETS_PER_COEFFICIENT = 4, 3
# Central differences through the lens: far above rounding, far below what bends it.
LENS_STEP_PX = 0.1


@dataclass(frozen=True)
class State:
    """One measured state of the surface.

    poses: its targets; image (H, W): a photograph of it, None for a saved measurement; centers: the paper's centres in the
    undistorted photograph, None where they were not asked for or there is no photograph.
    """

    poses: TargetPoses
    image: NDArray[np.generic] | None = None
    centers: Centers | None = None


@dataclass(frozen=True)
class DifferenceTable:
    """What N targets did, in mm, as `difference.csv` has it.

    ids (N,); nominal_mm (N, 3) in the dish frame; displacement_mm (N,): along the nominal normal, towards the focus; depth_change_mm:
    along the camera's z; shape_mm: displacement without the best-fit rigid motion; their sigmas, NaN where unknown; du_dv_px (N, 2):
    motion in the photograph; quality (N,): bits.
    """

    ids: Ints
    nominal_mm: Array
    displacement_mm: Array
    depth_change_mm: Array
    shape_mm: Array
    sigma_displacement_mm: Array
    sigma_depth_change_mm: Array
    sigma_shape_mm: Array
    du_dv_px: Array
    quality: Ints

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class Difference:
    """What two states differ in.

    method: one of DIFFERENCE_METHODS; joint, paper: the records of the methods that were asked for; tables: method -> its rows, the
    main method's first; surfaces: robust surfaces over x, y of the dish frame through `displacement` and `shape` of the joint
    estimate and through `paper`; surface_problems: why one of them is missing (of `paper`: the whole method). reference, current:
    the measured targets; image (H, W): the current photograph; same: both states are the same photograph.
    """

    method: str
    camera: Camera
    pattern: Pattern
    reference: TargetPoses
    current: TargetPoses
    joint: DifferenceMap | None
    paper: PaperDifference | None
    tables: Mapping[str, DifferenceTable]
    surfaces: Mapping[str, SurfaceFit]
    surface_problems: Mapping[str, str]
    image: NDArray[np.generic] | None = None
    same: bool = False

    @property
    def table(self) -> DifferenceTable:
        """The rows of the main method: the joint estimate's where it was asked for."""
        return next(iter(self.tables.values()))


def measure_state(
    image: NDArray[np.generic],
    camera: Camera,
    pattern: Pattern,
    hint: Hint = None,
    assumptions: Assumptions | None = None,
    with_centers: bool = False,
    progress: Tell | None = None,
) -> State:
    """Measure one photograph (H, W) of a state; with_centers: by the paper's method too. Raises what `map_photograph` does."""
    poses = map_photograph(image, camera, pattern, hint, assumptions=assumptions, progress=progress).poses
    assert isinstance(poses, TargetPoses)
    centers = None
    if with_centers:
        found = map_photograph(image, camera, pattern, hint, "paper").poses
        assert isinstance(found, PaperPoses)
        centers = Centers(found.ids, found.center_px)
    return State(poses, image, centers)


def combine_states(frames: Sequence[State]) -> State:
    """One state from several frames of it, by the same fixed camera. Raises MeasurementError when there are none."""
    if len(frames) == 1:
        return frames[0]
    known = [frame.centers for frame in frames if frame.centers is not None]
    centers = _averaged(known) if len(known) == len(frames) else None
    image = next((frame.image for frame in frames if frame.image is not None), None)
    return State(combine_frames([frame.poses for frame in frames]), image, centers)


def later_hint(hint: Hint, reference: State) -> Hint:
    """How photographs after the reference are named: as the hint says, or else from the reference's pose, as the camera is fixed.

    Anchors are places in the reference.
    """
    return PoseGuess(reference.poses.camera_from_dish) if hint is None or isinstance(hint, Anchors) else hint


def compare_photographs(
    reference: NDArray[np.generic],
    current: NDArray[np.generic],
    camera: Camera,
    pattern: Pattern,
    hint: Hint = None,
    priors: Priors | None = None,
    method: str = JOINT,
    surface: Basis | None = None,
) -> Difference:
    """What changed between two grey photographs (H, W) of one surface by one fixed camera.

    hint: as for `map_photograph`; without one the current photograph is named from the reference's pose. priors: what is known
    beforehand. Raises what `map_photograph` and `compare_states` raise.
    """
    check_method(method, surface)
    before = measure_state(reference, camera, pattern, hint, with_centers=method != JOINT)
    after = measure_state(current, camera, pattern, later_hint(hint, before), with_centers=method != JOINT)
    return compare_states(before, after, camera, pattern, priors, method, surface)


def check_method(method: str, surface: Basis | None) -> None:
    """Raise InputError for an unknown method, or a surface that no difference can have."""
    if method not in DIFFERENCE_METHODS:
        raise InputError(f"unknown method {method!r}; use one of {', '.join(DIFFERENCE_METHODS)}")
    if surface is not None and surface.along_normal:
        raise InputError(f"a difference is a height over x, y: use a plane, polynomial or zernike surface, not a {surface.kind}")


def compare_states(
    reference: State,
    current: State,
    camera: Camera,
    pattern: Pattern,
    priors: Priors | None = None,
    method: str = JOINT,
    surface: Basis | None = None,
    progress: Tell | None = None,
) -> Difference:
    """What changed between two measured states.

    surface: basis of the surfaces, see `default_basis`. The method `paper` uses the paper's
    centres when both states have them, else those of the fitted targets. Raises MeasurementError when too few targets
    are common, InputError for priors that name an unknown target, FitError when the paper's method alone is asked for and fails; a
    surface that cannot be fitted, or that method beside the joint one, is told in `surface_problems`.
    """
    check_method(method, surface)
    # matrices of some hundred rows: threads would cost more than they bring, far more on a busy machine
    with threadpool_limits(limits=1, user_api="blas"):
        return _compared(reference, current, camera, pattern, priors, method, surface, progress)


def _compared(
    reference: State,
    current: State,
    camera: Camera,
    pattern: Pattern,
    priors: Priors | None,
    method: str,
    surface: Basis | None,
    progress: Tell | None,
) -> Difference:
    common = np.intersect1d(reference.poses.ids, current.poses.ids)
    if not len(common):
        raise MeasurementError(
            "the reference and the current photograph have no target in common; photograph the same part of the pattern in both"
        )
    basis = surface or default_basis(pattern, len(common))
    joint = joint_difference(reference.poses, current.poses, camera, pattern, priors, progress) if method != PAPER else None
    tables, surfaces, problems = {}, {}, {}
    if joint is not None:
        tables[JOINT] = joint_table(joint)
        for name in (DISPLACEMENT, SHAPE):
            try:
                surfaces[name] = _joint_surface(joint, name, basis)
            except FitError as error:
                problems[name] = str(error)
    paper = None
    if method != JOINT:
        before, after = _centers(reference, current, camera)
        lab = cloud_of(reference.poses)
        try:
            paper = paper_difference(before, after, lab, pinhole_camera(camera), reference.poses.camera_from_dish, basis=basis)
            tables[PAPER] = paper_table(paper, before, after, camera, pattern, reference.poses)
            surfaces[PAPER] = paper.surface
        except FitError as error:
            if method == PAPER:
                raise
            problems[PAPER] = str(error)
    same = reference.image is not None and current.image is not None and np.array_equal(reference.image, current.image)
    return Difference(
        method, camera, pattern, reference.poses, current.poses, joint, paper, tables, surfaces, problems, current.image, same
    )


def default_basis(pattern: Pattern, targets: int) -> Basis:
    """Polynomial terms for a plate and Zernike terms for a dish, of the highest degree that so many targets carry, up to the fourth."""
    kind = "polynomial" if pattern.surface.kind == "plane" else "zernike"
    for degree in range(DEFAULT_DEGREE, 1, -1):
        if targets >= TARGETS_PER_COEFFICIENT * (degree + 1) * (degree + 2) // 2:
            return Basis(kind, degree)
    return Basis()


def joint_table(joint: DifferenceMap) -> DifferenceTable:
    """The rows of the joint estimate."""
    return DifferenceTable(**{column.name: getattr(joint, column.name) for column in fields(DifferenceTable)})


def paper_table(
    paper: PaperDifference, before: Centers, after: Centers, camera: Camera, pattern: Pattern, reference: TargetPoses
) -> DifferenceTable:
    """The rows of the paper's difference; before, after: the centres it was made from; reference: holds all its targets.

    The paper knows displacements along normals only, so the rigid motion taken out of the shape is the one that fits those best.
    """
    at_reference, index = _rows(reference.ids, paper.ids), reference.index[_rows(reference.ids, paper.ids)]
    place, normal = pattern.center_mm[index], pattern.normal[index]
    rigid = np.concatenate([normal, np.cross(place, normal)], axis=1)
    rest = np.eye(len(index)) - rigid @ np.linalg.pinv(rigid)
    spread = _design(paper.surface, paper.place_mm)
    factor = rest @ spread
    variance = np.einsum("ni,ij,nj->n", factor, paper.surface.covariance, factor)
    pinhole = pinhole_camera(camera)
    seen = [camera.project(pinhole.unproject(c.center_px[_rows(c.ids, paper.ids)])) for c in (before, after)]
    return DifferenceTable(
        ids=paper.ids,
        nominal_mm=place,
        displacement_mm=paper.displacement_mm,
        depth_change_mm=paper.depth_change_mm,
        shape_mm=rest @ paper.displacement_mm,
        sigma_displacement_mm=paper.sigma_displacement_mm,
        sigma_depth_change_mm=paper.sigma_displacement_mm * np.abs(reference.normal[at_reference, 2]),
        sigma_shape_mm=np.sqrt(np.maximum(variance, 0.0)),
        du_dv_px=seen[1] - seen[0],
        quality=reference.quality[at_reference],
    )


def _rows(ids: Ints, wanted: Ints) -> Ints:
    """Where each of `wanted` stands in `ids`, which holds them all."""
    order = np.argsort(ids)
    return np.asarray(order[np.searchsorted(ids, wanted, sorter=order)])


def _averaged(frames: Sequence[Centers]) -> Centers:
    """Mean centre of each target over the frames that show it."""
    ids, where = np.unique(np.concatenate([frame.ids for frame in frames]), return_inverse=True)
    total = np.zeros((len(ids), 2))
    np.add.at(total, where, np.concatenate([frame.center_px for frame in frames]))
    return Centers(ids, total / np.bincount(where)[:, None])


def _centers(reference: State, current: State, camera: Camera) -> tuple[Centers, Centers]:
    """The centres that the paper's method compares: of one kind in both states, since the kinds differ by their biases."""
    if reference.centers is not None and current.centers is not None:
        return reference.centers, current.centers
    return _fitted_centers(reference.poses, camera), _fitted_centers(current.poses, camera)


def _fitted_centers(poses: TargetPoses, camera: Camera) -> Centers:
    """Centres of the fitted targets in the undistorted photograph, with covariance."""
    pinhole = pinhole_camera(camera)

    def flat(pixels: Array) -> Array:
        return pinhole.project(camera.unproject(pixels))

    steps = LENS_STEP_PX * np.eye(2)
    by = np.stack([(flat(poses.center_px + s) - flat(poses.center_px - s)) / (2 * LENS_STEP_PX) for s in steps], axis=-1)
    return Centers(poses.ids, flat(poses.center_px), by @ poses.covariance_px2 @ np.swapaxes(by, 1, 2))


def _joint_surface(joint: DifferenceMap, name: str, basis: Basis) -> SurfaceFit:
    """Robust surface (the paper's Algorithm 4, unweighted) through displacement or shape over x, y.

    Neighbouring values share their errors, so the covariance of the coefficients comes from that of all values together.
    """
    of_shape = name == SHAPE
    value = joint.shape_mm if of_shape else joint.displacement_mm
    fit = fit_surface(_over_dish(joint, value), basis, weighted=False)
    design = _design(fit, joint.nominal_mm[:, :2])
    heavy = fit.weights[:, None] * design
    by = np.linalg.solve(heavy.T @ design, heavy.T)
    shared = by @ (joint.shape_factor if of_shape else joint.displacement_factor)
    own = joint.shape_own_mm2 if of_shape else joint.displacement_own_mm2
    return replace(fit, covariance=shared @ shared.T + (by * own) @ by.T)


def _over_dish(joint: DifferenceMap, value_mm: Array) -> PointCloud:
    """Values (N,) as heights over x, y of the dish frame, without weights."""
    n = len(joint)
    zero = np.zeros((n, 3, 3))
    return PointCloud(
        ids=joint.ids,
        position_mm=np.column_stack([joint.nominal_mm[:, :2], value_mm]),
        normal=np.tile([0.0, 0.0, 1.0], (n, 1)),
        center_px=np.zeros((n, 2)),
        covariance_mm2=zero,
        sigma_normal_rad=np.zeros(n),
        covariance_px2=zero[:, :2, :2],
        calibration_jacobian=None,
        quality=joint.quality,
        frame="dish",
    )


def _design(fit: SurfaceFit, xy_mm: Array) -> Array:
    """Columns (K, P) of a surface that is linear in its coefficients: its heights with each coefficient 1 and the others 0."""
    units = np.eye(len(fit.coefficients))
    return np.stack([surface_heights(replace(fit, coefficients=one), *xy_mm.T).height_mm for one in units], axis=1)
