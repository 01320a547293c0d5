"""What a camera, a lens, a distance and a pattern would give, before any of them is bought: sigmas per target, from the Fisher information.

The same information, priors and estimate of a change as in the measurement itself (`targets.expected`, `difference.bound`), at the
undeformed pattern.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from dishmap.camera.model import Camera
from dishmap.difference.bound import information_of_two, shape_bound
from dishmap.difference.changes import LEAST_TARGETS
from dishmap.errors import CameraError, InputError
from dishmap.simulate.forward import facing
from dishmap.simulate.scene import LARGEST_PSF_PX, SMALLEST_PSF_PX, Scene
from dishmap.surface.cloud import PointCloud
from dishmap.targets.bound import pattern_groups
from dishmap.targets.expected import Expected, expected_targets
from dishmap.targets.pattern import Pattern, TargetKind
from dishmap.targets.stages import Assumptions, wholly_inside
from dishmap.targets.window import minor_radius_px
from dishmap.transforms import Pose

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# A wider lens is no pinhole any more.
WIDEST_FOV_DEG = 150.0
# Of the rim's radius, the length over which a surface moves when nothing is said.
LENGTH_PART = 0.5
DEFAULT_AMPLITUDE_MM = 0.1
# A target is not found below this contrast over noise, nor when its largest circle is under so many px in radius.
LEAST_CONTRAST_TO_NOISE, LEAST_RADIUS_PX = 4.0, 1.2
OUTSIDE, HIDDEN, TOO_SMALL = "not wholly in the picture", "printed side hidden from the camera", "too small to be found"


@dataclass(frozen=True)
class Conditions:
    """What is assumed of a photograph and of the surface.

    contrast_to_noise: ground minus ink over the noise of a pixel; psf_sigma_px: Gaussian blur of the optics, the pixels' own area comes
    on top. amplitude_mm, length_mm: standard deviation of the surface about its nominal shape, and of its change between two photographs,
    and the length over which that changes (Matern 5/2); None for half of the rim's radius. slide: how points follow, one of
    `difference.model.WAYS`. assumptions: priors of the measurement. Raises InputError for impossible numbers.
    """

    contrast_to_noise: float = 40.0
    psf_sigma_px: float = 0.8
    amplitude_mm: float = DEFAULT_AMPLITUDE_MM
    length_mm: float | None = None
    slide: str = "least_strain"
    assumptions: Assumptions = field(default_factory=Assumptions)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.contrast_to_noise) and self.contrast_to_noise >= LEAST_CONTRAST_TO_NOISE):
            raise InputError(
                f"a contrast of {self.contrast_to_noise:g} times the noise shows no targets; {LEAST_CONTRAST_TO_NOISE:g} is the least: "
                "give more light or darker ink"
            )
        if not SMALLEST_PSF_PX <= self.psf_sigma_px <= LARGEST_PSF_PX:
            raise InputError(f"the blur must lie between {SMALLEST_PSF_PX} and {LARGEST_PSF_PX} px, not {self.psf_sigma_px}")
        if not (self.amplitude_mm > 0 and (self.length_mm is None or self.length_mm > 0)):
            raise InputError(f"amplitude and length of a smooth surface must be positive, not {self.amplitude_mm} and {self.length_mm} mm")


@dataclass(frozen=True)
class Plan:
    """What is expected of one photograph, and of the difference of two.

    cloud: the N targets that can be measured, on the undeformed pattern in the camera frame, with the covariances of their errors;
    normal_sigma_rad: spread of normals about the pattern's surface, as it would be learnt, their prior; shape_mm, displacement_mm
    (N,): standard deviations in mm of the change of shape (rigid motion removed) and of the displacement along the normal from two such
    photographs, NaN for fewer than LEAST_TARGETS targets; lost: (id, reason) of the others; view_rad (N,): angle between normal and line
    of sight; smallest_radius_px, narrowest_px (N,): smallest circle, and narrowest stroke of ink or ground within the target.
    """

    camera: Camera
    pattern: Pattern
    camera_from_dish: Pose
    conditions: Conditions
    length_mm: float
    cloud: PointCloud
    normal_sigma_rad: float
    shape_mm: Array
    displacement_mm: Array
    lost: tuple[tuple[int, str], ...]
    view_rad: Array
    smallest_radius_px: Array
    narrowest_px: Array

    @property
    def index(self) -> Index:
        """Place (N,) of the measurable targets in the pattern."""
        return np.flatnonzero(np.isin(self.pattern.ids, self.cloud.ids))

    @property
    def sigma_depth_mm(self) -> Array:
        """Standard deviation (N,) along the camera's axis."""
        return np.asarray(np.sqrt(self.cloud.covariance_mm2[:, 2, 2]))

    @property
    def sigma_across_mm(self) -> Array:
        """Standard deviation (N,) across the line of sight, root mean square of the two axes."""
        at = self.cloud.position_mm
        ray = at / np.linalg.norm(at, axis=1, keepdims=True)
        along = np.einsum("ni,nij,nj->n", ray, self.cloud.covariance_mm2, ray)
        return np.asarray(np.sqrt((np.trace(self.cloud.covariance_mm2, axis1=1, axis2=2) - along) / 2))

    @property
    def sigma_px(self) -> Array:
        """Standard deviation (N,) of the centre's image, root mean square of the two axes."""
        return np.asarray(np.sqrt(np.trace(self.cloud.covariance_px2, axis1=1, axis2=2) / 2))


@dataclass(frozen=True)
class PlannedCase:
    """One camera and place that were considered: its name, and its plan, or why there is none."""

    name: str
    plan: Plan | None
    problem: str = ""


def camera_of_lens(width_px: int, height_px: int, fov_deg: float) -> Camera:
    """A camera without distortion of this picture size, its axis in the middle, that sees `fov_deg` across the picture's width.

    Raises CameraError for a size of zero or an angle beyond WIDEST_FOV_DEG.
    """
    if not 0 < fov_deg <= WIDEST_FOV_DEG:
        raise CameraError(
            f"a field of view of {fov_deg:g} degrees is no pinhole's; give one of up to {WIDEST_FOV_DEG:g} degrees across the width, "
            "or the camera file of such a lens"
        )
    focal = 0.5 * width_px / np.tan(np.radians(0.5 * fov_deg))
    # a size of zero is for the camera to refuse
    return Camera(width_px, height_px, np.full(2, max(focal, 1.0)), np.array([width_px - 1.0, height_px - 1.0]) / 2)


def plan(camera: Camera, pattern: Pattern, camera_from_dish: Pose, conditions: Conditions | None = None) -> Plan:
    """What a photograph of `pattern` by `camera` would tell of every target, and what two would tell of a change.

    Raises InputError when no target can be measured, saying why, and for a grid of squares or lines.
    """
    # many small matrix products: threads would cost more than they bring
    with threadpool_limits(limits=1, user_api="blas"):
        return _plan(camera, pattern, camera_from_dish, conditions or Conditions())


def _plan(camera: Camera, pattern: Pattern, pose: Pose, given: Conditions) -> Plan:
    if pattern.is_grid:
        raise InputError("a grid of squares or lines cannot be planned; a plan is for targets made of circles")
    seen, lost, radius, narrow = _seen(camera, pattern, pose, given)
    if not len(seen):
        raise InputError(_why_nothing(pattern, pose, lost))
    length = LENGTH_PART * pattern.rim_radius_mm if given.length_mm is None else given.length_mm
    # slopes of a Matern 5/2 field (Rasmussen and Williams 2006, 4.2)
    stray = np.sqrt(5 / 3) * given.amplitude_mm / length
    numbers = camera, pattern, seen, pose, given.contrast_to_noise, given.psf_sigma_px
    found = expected_targets(*numbers, stray, given.assumptions)
    shape = whole = np.full(len(seen), np.nan)
    if len(seen) >= LEAST_TARGETS:
        change = information_of_two(pattern, seen, found.information, found.normal_sigma_rad, given.assumptions)
        shape, whole = shape_bound(camera, pattern, seen, pose, change, given.amplitude_mm, length, given.slide)
    cloud = _cloud(camera, pattern, pose, found)
    ray = cloud.position_mm / np.linalg.norm(cloud.position_mm, axis=1, keepdims=True)
    view = np.arccos(np.clip(-(ray * cloud.normal).sum(axis=1), -1, 1))
    return Plan(
        camera=camera,
        pattern=pattern,
        camera_from_dish=pose,
        conditions=given,
        length_mm=length,
        cloud=cloud,
        normal_sigma_rad=found.normal_sigma_rad,
        shape_mm=shape,
        displacement_mm=whole,
        lost=lost,
        view_rad=view,
        smallest_radius_px=radius[seen],
        narrowest_px=narrow[seen],
    )


def _seen(camera: Camera, pattern: Pattern, pose: Pose, given: Conditions) -> tuple[Index, tuple[tuple[int, str], ...], Array, Array]:
    """Which targets can be measured, (id, reason) of the others, and of all (N,) the smallest circle and narrowest stroke in px."""
    count = len(pattern)
    inside, found = np.zeros(count, bool), np.zeros(count, bool)
    radius, narrow = np.full(count, np.nan), np.full(count, np.nan)
    for group in pattern_groups(camera, pattern, np.arange(count), pose, given.psf_sigma_px, given.assumptions):
        inside[group.index] = wholly_inside(group)
        across = minor_radius_px(group.outlines())
        radius[group.index], found[group.index] = across.min(axis=1), across.max(axis=1) >= LEAST_RADIUS_PX
        narrow[group.index] = narrowest_mm(group.kind) * (across / group.kind.radius_mm).min(axis=1)
    shown = facing(Scene(pattern, camera, pose))
    # behind the camera there are no outlines, and no size
    reason = np.where(~inside, OUTSIDE, np.where(~shown, HIDDEN, np.where(~found, TOO_SMALL, "")))
    lost = tuple((int(i), str(why)) for i, why in zip(pattern.ids, reason, strict=True) if why)
    return np.flatnonzero(reason == ""), lost, radius, narrow


def narrowest_mm(kind: TargetKind) -> float:
    """Width of the narrowest stroke of ink or ground within a target: between nested circles, in a hole, between outermost circles."""
    nested = np.flatnonzero(kind.parent >= 0)
    outer = kind.parent[nested]
    aside = np.linalg.norm(kind.center_mm[nested] - kind.center_mm[outer], axis=1)
    strokes = kind.radius_mm[outer] - kind.radius_mm[nested] - aside
    return float(min([kind.gap_mm, 2 * float(kind.radius_mm.min()), *strokes.tolist()]))


def print_bend_mm(kind: TargetKind, amplitude_mm: float, length_mm: float) -> float:
    """How far the prints of a target leave its tangent plane, on average over their edges, when the surface moves: standard deviation.

    A Matern 5/2 field has curvatures of standard deviation 5 amplitude / length^2 along each axis, of correlation 1/3 between the two.
    """
    square = (np.linalg.norm(kind.center_mm, axis=1) ** 2 + kind.radius_mm**2) @ kind.radius_mm / kind.radius_mm.sum()
    return float(0.25 * square * 5 * amplitude_mm / length_mm**2 * np.sqrt(8 / 3))


def _cloud(camera: Camera, pattern: Pattern, pose: Pose, found: Expected) -> PointCloud:
    at = pose.apply(pattern.center_mm[found.index])
    return PointCloud(
        ids=pattern.ids[found.index],
        position_mm=at,
        normal=pose.rotate(pattern.normal[found.index]),
        center_px=camera.project(at),
        covariance_mm2=found.covariance[:, :3, :3],
        sigma_normal_rad=found.sigma_normal_rad,
        covariance_px2=found.covariance_px2,
        calibration_jacobian=found.calibration_jacobian,
        quality=found.quality,
        frame="camera",
    )


def _why_nothing(pattern: Pattern, pose: Pose, lost: tuple[tuple[int, str], ...]) -> str:
    """Why no target can be measured, and what to do."""
    reasons = [why for _, why in lost]
    usual = max(sorted(set(reasons)), key=reasons.count)
    distance = float(np.linalg.norm(pose.inverse().translation_mm))
    what = f"no target of the pattern can be measured from {distance:g} mm (most: {usual})"
    if usual == TOO_SMALL:
        return f"{what}; go nearer, use a longer lens or print larger targets"
    if usual == HIDDEN:
        return f"{what}; the camera must be on the side of the dish's focus, in front of its rim"
    if distance < pattern.rim_radius_mm / 10:
        return f"{what}; the pattern reaches {pattern.rim_radius_mm:g} mm from its middle, so is the distance really in mm?"
    return f"{what}; go farther away, use a wider lens, or turn the camera towards the pattern"
