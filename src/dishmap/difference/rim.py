"""The dish's rim in a photograph, and the dish frame that it gives: `find_rim`.

The paper's outline (section 5, Fig. 10; `outline`) says where to look. The rim itself is measured in the raw pixels beside it
(`profile`), and the nominal rim, a circle of radius D/2 at the height D^2/16f of the paraboloid (or of a plane disc), is fitted to
these points through the full camera model (`rimfit`).

What a circle's image holds: five numbers. Position (3) and the direction of the boresight (2); the turn about the boresight leaves the
rim as it is and must come from elsewhere. Two directions of the boresight, mirrored about the line of sight to the rim's middle, give
the same image exactly. Only a prior pose tells them apart, so without one there are two rims (`find_rims`), and `find_rim` refuses to
choose. Seen straight on the two merge into one; there the boresight is known to second order only, to about sqrt(2 sigma / r) rad when
the rim's image of r px is known to sigma px.

Distance goes with the rim's size in the image: an offset of the edge (a tone curve's, a frayed or bevelled edge's) of 0.1 px at a radius
of 750 px is a part of 1.3e-4 of it, 0.1 mm at 800 mm. Position across the line of sight and boresight do not feel it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.camera.model import Camera
from dishmap.difference.circle import circle_pieces, circle_poses
from dishmap.difference.outline import Outline, dish_outline
from dishmap.difference.profile import Edges, Pieces, fit_edges
from dishmap.difference.rimfit import TILT, TURN_Z, PoseData, PoseFit, fit_pose, merged, misfit_inflation, rows, settled
from dishmap.errors import CameraError, InputError, MeasurementError
from dishmap.targets.pattern import Surface
from dishmap.transforms import Pose, angle_between_rad, rotation_from_vector

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Pieces of the rim: enough for any ribs between them, and no shorter than the blur and a rib's edge are wide.
MOST_PIECES = 1000
SHORTEST_PIECE_PX = 6.0
# The outline is off by a pixel or two of the reduced picture, and a bent rim by some px more.
WIDE_PX, WIDE_PER_REDUCTION = 7.0, 2.0
# Beyond this many blurs from the edge there is level grey.
NARROW_BLURS, NARROW_PX = 3.5, 1.5
LEAST_SHARE = 0.4
LARGEST_GAP_RAD = np.radians(100.0)
# Mirrored boresights nearer than this many sigmas are one distribution, not two.
MERGE_SIGMAS = 8.0
# A mirrored pose is ruled out by 5 sigmas; a prior that is so far off is a mistake (chi-square of 6 numbers, one case in 3e7).
EXCLUDED_BY, PRIOR_MISTAKE = 25.0, 45.0


@dataclass(frozen=True)
class RimAssumptions:
    """What is assumed of the rim.

    sigma_edge_px: how far the edge in the picture may lie off the rim all around (as for printed edges: a tone curve's shift);
    sigma_diameter_mm: how well the surface's diameter is known; sigma_bend_mm: how far the rim may be bent into two to four waves, each
    of cos and sin, across the surface and along it: two waves look like a tilt, and where a dish may be bent only this makes sigmas true;
    rib_width_px: width of the widest rib over the rim in the picture, 15 % of the dish's radius when None.
    """

    sigma_edge_px: float = 0.3
    sigma_diameter_mm: float = 0.0
    sigma_bend_mm: float = 0.0
    rib_width_px: float | None = None

    def __post_init__(self) -> None:
        for name in ("sigma_edge_px", "sigma_diameter_mm", "sigma_bend_mm"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InputError(f"{name} must be zero or more, not {getattr(self, name)}")
        if self.rib_width_px is not None and not 0 <= self.rib_width_px < np.inf:
            raise InputError(f"rib_width_px must be zero or more, not {self.rib_width_px}")


@dataclass(frozen=True)
class RimPrior:
    """A pose known from elsewhere.

    covariance (6, 6): of (move along the camera's axes in mm, turn about the dish's axes in rad).
    """

    camera_from_dish: Pose
    covariance: Array

    def __post_init__(self) -> None:
        covariance = np.asarray(self.covariance, dtype=float)
        if covariance.shape != (6, 6) or not np.isfinite(covariance).all() or not np.linalg.eigvalsh(covariance).min() > 0:
            raise InputError("the covariance of a prior pose must be 6x6 finite numbers and positive definite")
        object.__setattr__(self, "covariance", covariance)

    @staticmethod
    def within(camera_from_dish: Pose, sigma_mm: float, sigma_deg: float) -> RimPrior:
        """A pose known to `sigma_mm` along each axis and `sigma_deg` about each."""
        return RimPrior(camera_from_dish, np.diag(np.repeat([sigma_mm, np.radians(sigma_deg)], 3) ** 2))


@dataclass(frozen=True)
class Rim:
    """The rim of a dish in one photograph.

    camera_from_rim: the dish frame (origin at the vertex, z the boresight); its turn about z is the prior's, or has y up in the image.
    covariance (6, 6) of (move along the camera's axes in mm, turn about the dish's axes in rad); without a prior the turn about z has
    infinite variance. It holds the picture's noise and misfit and the assumptions, not the camera's calibration. Of a rim that is bent by
    more than `RimAssumptions` says, the pose is that of the circle which looks most like it; a bend of 0.5 mm into two waves looks like
    half a degree of tilt at a tilt of 3 degrees.
    outline_px (K, 2): the paper's convex outline; points_px (N, 2): edge of each piece of the rim, NaN where none was found;
    used (N,): pieces that the pose rests on; share: their part of the rim; rms_px: of the used ones about the fitted circle;
    blur_px: sigma of the edge's blur, the pixel's included.
    """

    camera: Camera
    surface: Surface
    camera_from_rim: Pose
    covariance: Array
    outline_px: Array
    points_px: Array
    used: Flags
    share: float
    rms_px: float
    blur_px: float


def find_rim(
    image: NDArray[Any],
    camera: Camera,
    surface: Surface,
    prior: RimPrior | None = None,
    assumptions: RimAssumptions | None = None,
) -> Rim:
    """Find the rim of `surface` in a grey photograph (H, W) by `camera`.

    Raises MeasurementError when there is no rim to be found, when two mirrored poses explain it equally, and when the prior
    disagrees with it; CameraError when the photograph is not of the camera's size; ImageError when it is no grey picture.
    """
    rims = find_rims(image, camera, surface, prior, assumptions)
    if len(rims) == 1:
        return rims[0]
    apart = np.degrees(angle_between_rad(rims[0].camera_from_rim.rotation[:, 2], rims[1].camera_from_rim.rotation[:, 2]))
    raise MeasurementError(
        f"two poses of the dish explain its rim equally, with boresights {apart:.3g} degrees apart; "
        "give a prior pose that tells them apart, from targets for instance, or take both from find_rims"
    )


def find_rims(
    image: NDArray[Any],
    camera: Camera,
    surface: Surface,
    prior: RimPrior | None = None,
    assumptions: RimAssumptions | None = None,
) -> tuple[Rim, ...]:
    """As `find_rim`, but return every pose that explains the rim: one, or two mirrored ones, the likelier first."""
    assumptions = assumptions or RimAssumptions()
    if surface.diameter_mm is None:
        raise MeasurementError("the pattern's surface has no diameter, so it has no rim to find; give the surface's diameter_mm")
    if image.shape[:2] != (camera.height_px, camera.width_px):
        raise CameraError(
            f"the photograph is {image.shape[1]}x{image.shape[0]} px but the camera's are {camera.width_px}x{camera.height_px} px"
        )
    radius, height = surface.diameter_mm / 2, float(surface.height_mm(np.array([surface.diameter_mm / 2, 0.0])))
    outline = dish_outline(image, assumptions.rib_width_px)
    starts = circle_poses(camera, outline.border_px, radius, height)
    pieces = circle_pieces(camera, starts[0], radius, height, MOST_PIECES, SHORTEST_PIECE_PX)
    if not camera.contains(pieces.middle_px).all():
        raise MeasurementError("part of the dish's rim lies outside the photograph; a photograph of the whole rim is needed")
    known = None if prior is None else (prior.camera_from_dish, prior.covariance)
    lean = float(np.arccos(surface.normal(np.array([radius, 0.0]))[2]))
    sigmas = assumptions.sigma_edge_px, assumptions.sigma_diameter_mm / 2, assumptions.sigma_bend_mm
    base = PoseData(camera, radius, height, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), known, *sigmas, lean)
    points, edges, data = _points(image, outline, pieces, base, starts[0])
    fits = _fits(data, tuple(_turned_to(start, prior) for start in starts))
    return tuple(_rim(surface, outline, points, edges, data, fit) for fit in fits)


def relative_to_rim(points_px: ArrayLike, rim: Rim) -> Array:
    """Positions x, y (..., 2) in mm, in the dish frame that the rim gives, of points of the surface seen at pixels (..., 2).

    This is the paper's antenna coordinate system: what moves the whole antenna against the camera moves its rim too and does not show.
    Points are taken to lie on the nominal surface. NaN where a line of sight misses it.
    """
    rays = rim.camera.unproject(points_px) @ rim.camera_from_rim.rotation
    eye = rim.camera_from_rim.inverse().translation_mm
    with np.errstate(invalid="ignore", divide="ignore"):
        if rim.surface.kind == "plane" or rim.surface.focal_length_mm is None:
            way = -eye[2] / rays[..., 2]
        else:
            # x^2 + y^2 = 4 f z along eye + way * ray; the farther crossing is the dish's front
            f4 = 4 * rim.surface.focal_length_mm
            a, b = (rays[..., :2] ** 2).sum(axis=-1), 2 * (rays[..., :2] @ eye[:2]) - f4 * rays[..., 2]
            c = eye[0] ** 2 + eye[1] ** 2 - f4 * eye[2]
            root = np.sqrt(b * b - 4 * a * c)
            way = np.where(b > 0, -2 * c / (b + root), (root - b) / (2 * a))
        way = np.where(way > 0, way, np.nan)
    return np.asarray(eye[:2] + way[..., None] * rays[..., :2])


def _points(image: NDArray[Any], outline: Outline, pieces: Pieces, base: PoseData, start: Pose) -> tuple[Array, Edges, PoseData]:
    """Edge points (N, 2), NaN where there is none, their edges, and the good ones as data for a pose.

    The first search is wide. In the second each piece looks near its own edge, or near the fitted circle if it found none there.
    """
    free = replace(base, prior=None)
    wide = fit_edges(image, pieces, WIDE_PX + WIDE_PER_REDUCTION * outline.reduction, outline.light)
    rough = _data(free, pieces, wide)
    fit = fit_pose(rough, start)
    shift = wide.shift_px.copy()
    good = np.flatnonzero(wide.good)
    away = np.setdiff1d(np.arange(len(shift)), good[fit.used])
    shift[away] = np.interp(away, good[fit.used], (shift[good] - fit.residual_px)[fit.used], period=len(shift))
    pieces = pieces.moved(shift)
    edges = fit_edges(image, pieces, NARROW_BLURS * wide.blur_px + NARROW_PX, outline.light)
    # the piece beside one that is no clean edge may hold the blurred end of what disturbs it
    clean = edges.good & np.roll(edges.good, 1) & np.roll(edges.good, -1)
    edges = replace(edges, good=clean)
    points = pieces.middle_px + edges.shift_px[:, None] * pieces.normal
    return np.where(edges.good[:, None], points, np.nan), edges, _data(base, pieces, edges)


def _data(base: PoseData, pieces: Pieces, edges: Edges) -> PoseData:
    if edges.good.mean() < LEAST_SHARE:
        raise MeasurementError(
            f"only {100 * edges.good.mean():.0f} % of the dish's outline is a clean edge, and {100 * LEAST_SHARE:.0f} % are needed; "
            "is there a rim in view, with another grey level beyond it?"
        )
    points = pieces.middle_px + edges.shift_px[:, None] * pieces.normal
    return replace(base, points_px=points[edges.good], normal=pieces.normal[edges.good], sigma_px=edges.sigma_px[edges.good])


def _fits(data: PoseData, starts: tuple[Pose, ...]) -> tuple[PoseFit, ...]:
    """The poses that explain the points: one or two, the likelier first."""
    fits = [fit_pose(data, start) for start in starts]
    inflation = misfit_inflation(data, min(fits, key=lambda fit: fit.cost))
    data = replace(data, sigma_px=data.sigma_px * np.sqrt(inflation))
    first, second = sorted((settled(data, fit.pose, fit.nuisance, fit.used) for fit in fits), key=lambda fit: fit.cost)
    apart = float(angle_between_rad(first.pose.rotation[:, 2], second.pose.rotation[:, 2]))
    sigma = float(np.sqrt(np.linalg.eigvalsh(first.covariance[TILT, TILT]).max() + np.linalg.eigvalsh(second.covariance[TILT, TILT]).max()))
    if apart < 1e-9 and data.prior is not None:
        found: tuple[PoseFit, ...] = (first,)
    elif apart < MERGE_SIGMAS * sigma:
        found = (merged(data, (first, second)),)
    else:
        found = (first,) if second.cost - first.cost > EXCLUDED_BY else (first, second)
    if data.prior is not None:
        residual = rows(data, found[0].pose, found[0].nuisance)[0][-6:]
        if residual @ residual > PRIOR_MISTAKE:
            raise MeasurementError(
                f"the rim lies {np.sqrt(residual @ residual):.1f} sigmas from the given pose; mend the pose or enlarge its covariance"
            )
    return found


def _rim(surface: Surface, outline: Outline, points: Array, edges: Edges, data: PoseData, fit: PoseFit) -> Rim:
    used = np.zeros(len(points), dtype=bool)
    used[np.flatnonzero(edges.good)[fit.used]] = True
    share = float(used.mean())
    gap = float(np.diff(np.flatnonzero(np.concatenate([used, used]))).max()) / len(used) * 2 * np.pi
    if share < LEAST_SHARE or gap > LARGEST_GAP_RAD:
        raise MeasurementError(
            f"the rim is not closed: {100 * share:.0f} % of the outline lies on one circle, with a gap of {np.degrees(gap):.0f} degrees; "
            f"{100 * LEAST_SHARE:.0f} % and gaps under {np.degrees(LARGEST_GAP_RAD):.0f} degrees are needed"
        )
    covariance = fit.covariance[:6, :6].copy()
    if data.prior is None:
        covariance[TURN_Z, TURN_Z] = np.inf
    rms = float(np.sqrt((fit.residual_px[fit.used] ** 2).mean()))
    return Rim(data.camera, surface, fit.pose, covariance, outline.hull_px, points, used, share, rms, edges.blur_px)


def _turned_to(pose: Pose, prior: RimPrior | None) -> Pose:
    """A pose turned about its own z to come as near as it can to the prior's turn."""
    if prior is None:
        return pose
    between = pose.rotation.T @ prior.camera_from_dish.rotation
    angle = float(np.arctan2(between[1, 0] - between[0, 1], between[0, 0] + between[1, 1]))
    return Pose(pose.rotation @ rotation_from_vector(np.array([0.0, 0.0, angle])), pose.translation_mm)
