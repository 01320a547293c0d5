"""The paper's method for circular targets, as printed: the baseline that the name `paper` stands for.

Asaly, Ben-Moshe, Shvalb, "Accurate 3D Mapping Algorithm for Flexible Antennas" (2018), section 4.2: Algorithm 1, its list
(1)-(4) for the angular difference, the list (1)-(4) for multi-circular targets and its steps (a)-(f) for the normal. Where
the text leaves a choice, this file takes (reasons and measured effects: docs/method-paper.md):

- "Average center" of a pair: the mean of the centres of an outer ellipse and of all that are nested in it.
- p1, p2: one end of the major and one of the minor axis of the largest ellipse. Two opposite ends, which step (d) also
  mentions, have a cross product of zero; they serve to fix signs. r is the major semi-axis in pixels.
- Signs: circles farther off look smaller, and the centre of a large ellipse lies nearer to the camera's side than that of a
  small one inside it. Where both together are below `SIGN_SIGMAS` the expected normal decides, and the target is flagged.
- View: the text puts the camera's view on the yz plane, so by default its x is the optical axis, for every target ("camera").
  Away from the image's middle that is not the line of sight; "target" runs the same steps after turning the camera to the largest ellipse.
- Vertices w: both ends of both axes of the largest ellipse, all six pairs. alpha is the angle between lines, at most 90 degrees;
  with a sign its mean would be 90 degrees for any tilt. The mean of 90 degrees - alpha over these pairs is about 0.64 of the tilt.
- area: the areas of all ellipses of the target added up, outer and inner.
- z = sqrt(area) C_camera / cos(delta alpha) cannot itself be a depth, since it grows with the image. With C_camera "the angular
  resolution" in rad/px it is the angle under which the target would be seen frontally; the depth is the printed size, the
  square root of the printed area, over that angle. So cos(delta alpha) shortens the depth of a tilted target, as it must.
- A target with a circle missing is left out: the mean of the others is not its centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.cluster.vq import ClusterError, kmeans2

from dishmap.camera.model import Camera
from dishmap.errors import CameraError, FitError, ImageError, InputError
from dishmap.quality import Quality
from dishmap.targets.groups import CircleGroups, EllipseSet, Skipped, group_circles
from dishmap.targets.pattern import Pattern, TargetKind
from dishmap.targets.subpixel import Ellipses, profile_half_width_px, refine_ellipses, transform_ellipses
from dishmap.transforms import rotation_from_vector

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
View = Literal["camera", "target"]

METHOD = "paper"
# The sign of a tilt is taken from the image when this sure: one wrong in about 700.
SIGN_SIGMAS = 3.0
# Stands for a standard error of zero, far below any image's.
EXACT_PX = 1e-9
KMEANS_STEPS = 100
KMEANS_STARTS = 5


@dataclass(frozen=True)
class PaperPoses:
    """Targets measured by the paper's method, in the camera frame; the method gives no uncertainty.

    index: place in the pattern; ids (T,); center_px (T, 2): the K-means centre C_p in the undistorted image (of grids: level_0);
    position_mm, normal (T, 3), the normal towards the camera; depth_mm (T,) along the camera's z; delta_alpha_rad, area_px2 (T,), of
    grids those of the largest squares about the target; quality (T,) bits; rejected: (id, reason) of named targets that could not be
    measured; view: the view the steps were taken in; method: its name.
    """

    index: Ints
    ids: Ints
    center_px: Array
    position_mm: Array
    normal: Array
    depth_mm: Array
    delta_alpha_rad: Array
    area_px2: Array
    quality: Ints
    rejected: Skipped
    view: View
    method: str = METHOD

    def __len__(self) -> int:
        return len(self.ids)


def paper_poses(
    image: NDArray[np.generic],
    camera: Camera,
    pattern: Pattern,
    detections: EllipseSet,
    mark: ArrayLike,
    detection: ArrayLike,
    *,
    expected_normal: Array | None = None,
    view: View = "camera",
) -> PaperPoses:
    """Algorithm 1 on an undistorted image.

    image (H, W), grey; camera: pinhole; detections: ellipses of this undistorted image; mark, detection (K,): which mark of the
    pattern each outermost detection is; expected_normal (N, 3): the pattern's normals in the camera frame as far as known, used
    only where the image does not tell the sign of a tilt. Raises CameraError for a camera with distortion or of another size,
    ImageError for an image that is not grey, InputError for arrays that do not fit.
    """
    check_undistorted(image, camera)
    group = group_circles(pattern, detections, mark, detection)
    angle = np.asarray(detections.angle_rad, dtype=float)
    start = Ellipses.exact(detections.center_px, detections.semi_axes_px, angle)
    refined = refine_ellipses(image, start[group.detection], profile_half_width_px(start, detections.parent)[group.detection])
    return poses_from_ellipses(refined, group, camera, pattern, expected_normal=expected_normal, view=view)


def poses_from_ellipses(
    ellipses: Ellipses,
    group: CircleGroups,
    camera: Camera,
    pattern: Pattern,
    *,
    expected_normal: Array | None = None,
    view: View = "camera",
) -> PaperPoses:
    """Algorithm 1 on refined ellipses (R,), one for each row of `group`, in the pixels of a pinhole camera."""
    if view not in ("camera", "target"):
        raise InputError(f"unknown view {view!r}; use camera (as the paper has it) or target")
    if expected_normal is not None and np.shape(expected_normal) != (len(pattern), 3):
        raise InputError(f"expected_normal needs one row per target of the pattern, {(len(pattern), 3)}, not {np.shape(expected_normal)}")
    expected = np.full((len(pattern), 3), np.nan) if expected_normal is None else np.asarray(expected_normal, dtype=float)
    blurred = np.unique(group.target[~ellipses.good])
    keep = ~np.isin(group.target, blurred)
    focal = float(np.sqrt(camera.focal_px.prod()))
    # square pixels about the principal point
    to_square = np.diag([focal, focal, 1.0]) @ np.linalg.inv(camera.matrix)
    square, rows, circle = transform_ellipses(ellipses[keep], to_square), group.target[keep], group.circle[keep]
    target, center, mixed = _target_centers(square.center_px, group.mark[keep], pattern)
    measured = [
        _measure(square[rows == t], circle[rows == t], pattern.kind_of(t), c, focal, expected[t], view)
        for t, c in zip(target, center, strict=True)
    ]
    position, normal, delta, area, quality = list(zip(*measured, strict=True)) or [()] * 5
    skipped = list(group.skipped)
    skipped += [(int(t), "the edge of one of its circles is not sharp or not whole") for t in blurred]
    skipped += [(int(t), "K-means mixes its circles with a neighbour's") for t in mixed]
    return PaperPoses(
        index=target,
        ids=pattern.ids[target],
        center_px=center * camera.focal_px / focal + camera.principal_px,
        position_mm=np.reshape(position, (-1, 3)).astype(float),
        normal=np.reshape(normal, (-1, 3)).astype(float),
        depth_mm=np.reshape(position, (-1, 3)).astype(float)[:, 2],
        delta_alpha_rad=np.array(delta, dtype=float),
        area_px2=np.array(area, dtype=float),
        quality=np.array(quality, dtype=np.int64),
        rejected=tuple((int(pattern.ids[t]), reason) for t, reason in sorted(skipped)),
        view=view,
    )


def check_undistorted(image: NDArray[np.generic], camera: Camera) -> None:
    """Raise CameraError or ImageError unless this is a grey image and the pinhole camera that could have taken it."""
    if camera.model != "opencv" or camera.distortion.any():
        raise CameraError("the paper's method works on an undistorted image: give that image and its pinhole camera, without distortion")
    if image.ndim != 2:
        raise ImageError(f"the paper's method needs one grey image (height, width), not an array of shape {image.shape}")
    if image.shape != (camera.height_px, camera.width_px):
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise CameraError(f"the image is {size} but the camera {camera.width_px}x{camera.height_px}; give the camera of this image")
    if image.dtype.kind == "f" and not np.isfinite(image).all():
        raise ImageError("the image holds NaN or infinite pixels; give finite grey levels")


def _target_centers(center_px: Array, mark: Ints, pattern: Pattern) -> tuple[Ints, Array, Ints]:
    """Targets (T,), their K-means centres (T, 2), and the targets whose circles K-means gave to another one."""
    pair, mark = pair_centers(center_px, mark)
    owner = pattern.marks.target[mark]
    target, label = np.unique(owner, return_inverse=True)
    if not len(target):
        return target, np.zeros((0, 2)), target
    count = np.bincount(label)
    means = np.stack([np.bincount(label, weights=pair[:, axis]) / count for axis in (0, 1)], axis=1)
    center, found = kmeans_centers(pair, initial_px=means)
    wrong = found != label
    mixed = np.isin(np.arange(len(target)), np.concatenate([label[wrong], found[wrong]]))
    return target[~mixed], center[~mixed], target[mixed]


def _measure(
    circles: Ellipses, circle: Ints, kind: TargetKind, center: Array, focal: float, expected: Array, view: View
) -> tuple[Array, Array, float, float, int]:
    """Position, normal, delta alpha, area and quality of one target; its ellipses in square pixels about the principal point."""
    turn, most = np.eye(3), np.array([np.argmax(circles.semi_axes_px[:, 0])])
    sight = np.array([*center / focal, 1.0])
    if view == "target":
        turn, scale = _turn_to(np.array([*circles.center_px[most[0]] / focal, 1.0])), np.diag([focal, focal, 1.0])
        circles = transform_ellipses(circles, scale @ turn @ np.linalg.inv(scale))
        sight = turn @ sight / (turn[2] @ sight)
    largest = circles[most]
    both = normal_candidates(largest.semi_axes_px[0], float(largest.angle_rad[0]))
    look = np.unique(np.column_stack([kind.radius_mm, kind.dark])[circle], axis=0, return_inverse=True)[1]
    place = np.unique(np.round(kind.center_mm[circle], 9), axis=0, return_inverse=True)[1]
    slope, sigma = nearer_per_px(circles, look, place, largest.minor[0])
    nearer, sure = slope > 0, abs(slope) > SIGN_SIGMAS * sigma
    if not sure and np.isfinite(expected).all():
        nearer = bool((both[1] - both[0]) @ (turn @ expected) > 0)
    normal = both[int(nearer)]
    normal = -normal if normal @ sight > 0 else normal
    delta = float(delta_alpha_rad(axis_ends_px(largest)[0] / focal, normal))
    area = float(circles.area_px2.sum())
    printed = float(np.pi * (kind.radius_mm[circle] ** 2).sum())
    z = float(depth_from_area_mm(area, printed, delta, 1 / focal))
    quality = Quality.CLEAN if sure else Quality.AMBIGUOUS_NORMAL
    return turn.T @ sight * z, turn.T @ normal, delta, area, int(quality)


def _turn_to(ray: Array) -> Array:
    """The smallest rotation that puts a ray (3,) on the z axis."""
    axis = np.cross(ray, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    return rotation_from_vector(axis * (np.arctan2(sine, ray[2]) / sine if sine > 0 else 0.0))


# ---- step (1): centres of pairs; step (2): K-means ----


def pair_centers(center_px: Array, mark: Ints) -> tuple[Array, Ints]:
    """The average centre (P, 2) of the ellipses of each mark (outer and inner), and the marks (P,), from rows (R, 2), (R,)."""
    number, row = np.unique(mark, return_inverse=True)
    count = np.bincount(row, minlength=len(number))[:, None]
    total = np.stack([np.bincount(row, weights=center_px[:, axis], minlength=len(number)) for axis in (0, 1)], axis=1)
    return total / np.maximum(count, 1), number


def kmeans_centers(
    centers_px: Array, count: int | None = None, *, initial_px: Array | None = None, rng: np.random.Generator | None = None
) -> tuple[Array, Ints]:
    """K-means over ellipse centres (P, 2): the targets' centres C_p (K, 2) and the target of each ellipse (P,).

    Starts from initial_px (K, 2), or else from `count` points far apart, the first drawn from `rng`, best of several draws. Raises
    InputError without a start, FitError when there are fewer ellipses than targets or a target gets no ellipse.
    """
    points = np.asarray(centers_px, dtype=float)
    if initial_px is None and (count is None or rng is None):
        raise InputError("K-means needs initial_px, or the number of targets and a random generator")
    wanted = len(initial_px) if initial_px is not None else int(count or 0)
    if not 1 <= wanted <= len(points):
        raise FitError(f"K-means needs at least one ellipse for each target: there are {len(points)} ellipses for {wanted} targets")
    if initial_px is not None:
        starts = [np.asarray(initial_px, dtype=float)]
    else:
        assert rng is not None
        starts = [_spread_out(points, wanted, rng) for _ in range(KMEANS_STARTS)]
    best, least = None, np.inf
    for start in starts:
        try:
            center, label = kmeans2(points, start, iter=KMEANS_STEPS, minit="matrix", missing="raise")
        except ClusterError:
            continue
        cost = float(((points - center[label]) ** 2).sum())
        if cost < least:
            best, least = (center, label.astype(np.int64)), cost
    if best is None:
        raise FitError(f"K-means left a target without ellipses: check that {wanted} targets stand behind these {len(points)} ellipses")
    return best


def _spread_out(points: Array, count: int, rng: np.random.Generator) -> Array:
    """Initial centres: a random point, then always the one farthest from those chosen: one in each target if gaps are wide."""
    chosen = [points[rng.integers(len(points))]]
    square = np.full(len(points), np.inf)
    while len(chosen) < count:
        square = np.minimum(square, ((points - chosen[-1]) ** 2).sum(axis=1))
        chosen.append(points[np.argmax(square)])
    return np.array(chosen)


# ---- step (4), (a)-(e): the normal ----


def axis_ends_px(ellipses: Ellipses) -> Array:
    """Where the axes meet the ellipses (M, 4, 2): p1 (major), p2 (minor, a quarter turn on), and their opposites."""
    p1 = ellipses.semi_axes_px[:, :1] * ellipses.major
    p2 = ellipses.semi_axes_px[:, 1:] * ellipses.minor
    return ellipses.center_px[:, None] + np.stack([p1, p2, -p1, -p2], axis=1)


def normal_candidates(semi_axes_px: Array, angle_rad: float) -> Array:
    """Steps (a)-(e): the two unit normals (2, 3) of an ellipse, towards the camera, in the frame of its camera.

    Row 0: p2, the minor axis' end a quarter turn from the major one, is farther from the camera than the centre; row 1: nearer.
    """
    a, b = (float(value) for value in semi_axes_px)
    r = max(a, b)
    p1, p2 = a * np.array([np.cos(angle_rad), np.sin(angle_rad)]), b * np.array([-np.sin(angle_rad), np.cos(angle_rad)])
    # (c): the unknown depths; x1 is zero but for rounding, as p1 is at the distance r
    x1, x2 = (float(np.sqrt(max(r * r - float(p @ p), 0.0))) for p in (p1, p2))
    normals = []
    for sign in (1.0, -1.0):
        # (e), in the text's axes: x along the view, away from the camera, then u and v
        n = np.cross([x1, *p1], [sign * x2, *p2])
        n = -n if n[0] > 0 else n
        normals.append(np.array([n[1], n[2], n[0]]) / np.linalg.norm(n))
    return np.array(normals)


def nearer_per_px(circles: Ellipses, look: Ints, place: Ints, direction: Array) -> tuple[float, float]:
    """Step (d): relative growth of 1/depth per pixel along a direction (2,) of the image, and its standard error.

    circles (R,) of one target; look (R,): equal for circles printed with one radius and colour; place (R,): equal for
    concentric ones. On a plane 1/depth is linear in the image; a small circle's area goes with its cube, and the centre of an
    ellipse with shape matrix M (eigenvalues a^2, b^2) lies M g off the image of the circle's centre, g being the gradient. Only
    circles of one look are compared, so that ink spread cancels. Without information the error is infinite.
    """
    radius = np.sqrt(circles.semi_axes_px.prod(axis=1))
    sigma = np.maximum(circles.radius_sigma_px, EXACT_PX)
    along = circles.center_px @ direction
    cosine = circles.major @ direction
    spread = (circles.semi_axes_px**2 * np.stack([cosine**2, 1 - cosine**2], axis=1)).sum(axis=1)
    top = bottom = 0.0
    for group, arm, value, error in (
        (look, along, 2 / 3 * np.log(radius), 2 / 3 * sigma / radius),
        (place, spread, along, np.sqrt(2) * sigma),
    ):
        weight = 1 / error**2
        total = np.bincount(group, weights=weight)
        arm, value = (x - (np.bincount(group, weights=weight * x) / total)[group] for x in (arm, value))
        top += float((weight * arm * value).sum())
        bottom += float((weight * arm * arm).sum())
    return (top / bottom, float(1 / np.sqrt(bottom))) if bottom > 0 else (0.0, np.inf)


# ---- list (1)-(4) and Algorithm 1, step (4): angular difference and depth ----


def delta_alpha_rad(vertices: Array, normal: Array) -> Array:
    """The angular difference (...): 90 degrees minus the mean angle between a target's lines and the lines of sight.

    vertices (..., W, 2): x/z, y/z of the target's vertices; normal (..., 3) of its plane, whose distance does not matter.
    """
    rays = np.concatenate([vertices, np.ones((*vertices.shape[:-1], 1))], axis=-1)
    on_plane = rays / (rays @ normal[..., None])
    first, second = np.triu_indices(rays.shape[-2], 1)
    # (a) the plane through the camera and w1, w2 cuts the target's plane in l1; (b) l2 goes to the middle between them
    l1 = np.cross(normal[..., None, :], np.cross(rays[..., first, :], rays[..., second, :]))
    l2 = on_plane[..., first, :] + on_plane[..., second, :]
    alpha = np.arctan2(np.linalg.norm(np.cross(l1, l2), axis=-1), np.abs((l1 * l2).sum(axis=-1)))
    return np.asarray(np.pi / 2 - alpha.mean(axis=-1))


def depth_from_area_mm(area_px2: ArrayLike, printed_area_mm2: ArrayLike, delta_alpha_rad: ArrayLike, c_camera_rad_per_px: float) -> Array:
    """Depth from the image's area: the printed size over the angle sqrt(area) C_camera / cos(delta alpha) it fills frontally."""
    angle = np.sqrt(np.asarray(area_px2, dtype=float)) * c_camera_rad_per_px / np.cos(delta_alpha_rad)
    return np.asarray(np.sqrt(printed_area_mm2) / angle)
