"""Local maps and distances against exact projections, rays cut with the plane, and nearest points by brute force."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import FISHEYE, PLAIN, WIDE, facing_towards
from scipy.spatial import cKDTree

from dishmap.camera.model import Camera
from dishmap.targets.edges import (
    DERIVATIVES,
    MISFIT_PX,
    MOTION_DEGREE,
    PLANE_DEGREES,
    LocalMaps,
    Patches,
    Poses,
    edge_distance,
    local_maps,
    monomials,
    plane_at_offsets,
    project_printed,
)
from dishmap.targets.pattern import bent_print_mm
from dishmap.targets.window import patches_around
from dishmap.transforms import rotation_from_vector

Array = NDArray[np.float64]

# The largest error at random points may exceed that at the nodes a little: the border between them is not a node.
MAP_ERROR_PX = 3 * MISFIT_PX
# Derivatives of the maps: error of the map over a tenth of the patch, which is at least 10 px wide.
MAP_SLOPE = MAP_ERROR_PX
# Central differences of exact projections: rounding 1e-12 px over steps of 1e-4.
DIFFERENCE = 1e-6
# Second-degree motion fields leave the third-degree part: (patch / distance)^3 and the lens's share.
MOTION_PART = 0.02
# Within a quarter of a pixel the edge lies on a straight line over which scale does not change; beyond, the error grows with
# the square of the distance, by curvature and tilt and by the lens's change of scale (0.005 per px at the edge of WIDE).
AT_EDGE_PX, NEAR_EDGE_PX, PER_SQUARE_PX = 0.25, 2.0, 0.006
AT_EDGE_ERROR_PX = 4e-4
# With the map's second derivatives the lens's third are left, and the part of the square that comes with the edge's own curvature.
BENT_PER_SQUARE_PX, BENT_CURVATURE = 4e-4, 2.5e-4
ROUNDING = 1e-9
# Sums of ten terms in single precision.
SINGLE = 2e-6

VIEWS = {
    "axis": (PLAIN, (200.3, 150.2), 3000.0),
    "edge of 90 degrees": (WIDE, (920.0, 660.0), 400.0),
    "fisheye": (FISHEYE, (760.0, 250.0), 270.0),
}
DISTANCE_MM = 500.0
FLAT = np.zeros((1, 2, 2))
# A dish of 0.6 m and f/D 0.25, twice as curved as most.
BENT = np.array([[[1 / 300, 2e-4], [2e-4, 1 / 350]]])


def single(view: str, tilt_deg: float, turn_deg: float = 40.0) -> tuple[Camera, Poses, float]:
    """A camera, the pose of one target in it, and mm per px there."""
    camera, pixel, focal_px = VIEWS[view]
    pose = facing_towards(camera, pixel, DISTANCE_MM, np.radians(tilt_deg), np.radians(turn_deg))
    return camera, Poses(pose.rotation[None], pose.translation_mm[None]), DISTANCE_MM / focal_px


def patch_of(camera: Camera, poses: Poses, curvature: Array, radius_mm: float, blur_px: float = 0.85) -> Patches:
    return patches_around(camera, poses, curvature, (np.zeros((1, 2)), np.array([radius_mm])), blur_px)


def in_patch(patches: Patches, rng: np.random.Generator, count: int = 300) -> tuple[Array, Array, Array]:
    """Random places of the first patch: s, t (1, n) within its circle, and pixels (n, 2)."""
    angle, radius = rng.uniform(0, 2 * np.pi, count), np.sqrt(rng.uniform(0, 1, count))
    st_ = radius * np.cos(angle), radius * np.sin(angle)
    return st_[0][None], st_[1][None], patches.anchor_px[0] + patches.scale_px[0] * np.stack(st_, axis=1)


def cut_with_plane(camera: Camera, poses: Poses, pixels: Array) -> Array:
    """Where the rays through pixels (n, 2) meet the target's plane, in its axes (n, 2) mm."""
    rays, normal, origin = camera.unproject(pixels), poses.rotation[0, :, 2], poses.position_mm[0]
    points = rays * ((origin @ normal) / (rays @ normal))[:, None]
    return (points - origin) @ poses.rotation[0][:, :2]


@given(st.lists(st.floats(-1, 1), min_size=2, max_size=6), st.sampled_from([*PLANE_DEGREES, MOTION_DEGREE]))
def test_monomials_are_all_products_in_order_of_degree(values: list[float], degree: int) -> None:
    s, t = np.array(values), np.array(values)[::-1]
    expected = [s ** (total - j) * t**j for total in range(degree + 1) for j in range(total + 1)]
    np.testing.assert_allclose(monomials(s, t, degree), expected, atol=ROUNDING)


@pytest.mark.parametrize("degree", PLANE_DEGREES)
def test_derivative_matrices_differentiate(degree: int) -> None:
    rng = np.random.default_rng(1)
    s, t, step = rng.uniform(-1, 1, 20), rng.uniform(-1, 1, 20), 1e-5
    coefficients = rng.standard_normal(len(monomials(s, t, degree)))
    by_s, by_t = DERIVATIVES[degree]
    for matrix, (ds, dt) in ((by_s, (step, 0)), (by_t, (0, step))):
        difference = (monomials(s + ds, t + dt, degree) - monomials(s - ds, t - dt, degree)) / (2 * step)
        np.testing.assert_allclose((coefficients @ matrix) @ monomials(s, t, degree), coefficients @ difference, atol=1e-7)


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_steps_are_a_right_angled_frame_along_the_line_of_sight(direction: tuple[float, float, float]) -> None:
    position = 700 * np.array([direction]) / np.linalg.norm(direction)
    steps = Poses(np.eye(3)[None], position).steps[0]
    np.testing.assert_allclose(steps.T @ steps, np.eye(3), atol=ROUNDING)
    np.testing.assert_allclose(steps[:, 2], position[0] / 700, atol=ROUNDING)


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("curvature", [FLAT, BENT], ids=["flat", "bent"])
def test_motion_of_printed_points_against_differences(view: str, curvature: Array) -> None:
    camera, poses, scale = single(view, 35.0)
    xy = np.random.default_rng(2).uniform(-20, 20, (7, 2)) * scale
    _, motion = project_printed(camera, poses, curvature, xy)

    def moved(delta: Array) -> Array:
        position = poses.position_mm + np.einsum("tij,j->ti", poses.steps, delta[:3])
        return project_printed(camera, Poses(poses.rotation @ rotation_from_vector(delta[3:]), position), curvature, xy)[0]

    step = 1e-4
    difference = np.stack([(moved(step * e) - moved(-step * e)) / (2 * step) for e in np.eye(6)], axis=-1)
    np.testing.assert_allclose(motion, difference, atol=DIFFERENCE * np.abs(difference).max())


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("tilt_deg", [0.0, 30.0, 50.0])
@pytest.mark.parametrize("radius_px", [6.0, 15.0])
def test_map_to_the_plane_is_the_cut_of_ray_and_plane(view: str, tilt_deg: float, radius_px: float) -> None:
    camera, poses, scale = single(view, tilt_deg)
    patches = patch_of(camera, poses, FLAT, radius_px * scale)
    maps = local_maps(camera, poses, FLAT, patches)
    s, t, pixels = in_patch(patches, np.random.default_rng(3))
    six = (maps.plane @ monomials(s, t, maps.degree))[0]
    px_per_mm = patches.scale_px[0] / patches.reach_mm[0]
    error_px = np.linalg.norm(six[:2].T - cut_with_plane(camera, poses, pixels), axis=1) * px_per_mm
    assert maps.misfit_px[0] < MISFIT_PX
    assert error_px.max() < MAP_ERROR_PX
    # the derivatives, against the cut of rays through neighbouring pixels
    for row, shift in ((2, [1e-3, 0.0]), (3, [0.0, 1e-3])):
        difference = (cut_with_plane(camera, poses, pixels + shift) - cut_with_plane(camera, poses, pixels - shift)) / 2e-3
        np.testing.assert_allclose(six[[row, row + 2]].T * px_per_mm, difference * px_per_mm, atol=MAP_SLOPE)


@pytest.mark.parametrize("view", VIEWS)
def test_map_to_a_bent_surface_inverts_the_projection(view: str) -> None:
    camera, poses, scale = single(view, 30.0)
    patches = patch_of(camera, poses, BENT, 12 * scale)
    xy = np.random.default_rng(4).uniform(-12, 12, (200, 2)) * scale
    pixels = camera.project(poses.in_camera(bent_print_mm(xy[None], BENT)))[0]

    def error_px(maps: LocalMaps) -> float:
        s, t = ((pixels - patches.anchor_px[0]) / patches.scale_px[0]).T
        found = (maps.plane @ monomials(s[None], t[None], maps.degree))[0, :2].T
        return float(np.linalg.norm(found - xy, axis=1).max() * patches.scale_px[0] / patches.reach_mm[0])

    assert error_px(local_maps(camera, poses, BENT, patches)) < MAP_ERROR_PX
    assert error_px(local_maps(camera, poses, FLAT, patches)) > 10 * MAP_ERROR_PX


@pytest.mark.parametrize("view", VIEWS)
def test_motion_fields_follow_the_projection(view: str) -> None:
    camera, poses, scale = single(view, 30.0)
    patches = patch_of(camera, poses, FLAT, 12 * scale)
    maps = local_maps(camera, poses, FLAT, patches)
    xy = np.random.default_rng(5).uniform(-10, 10, (50, 2)) * scale
    pixels, motion = project_printed(camera, poses, FLAT, xy)
    s, t = ((pixels[0] - patches.anchor_px[0]) / patches.scale_px[0]).T
    field = np.einsum("kgl,ln->nkg", maps.motion[0], monomials(s, t, MOTION_DEGREE))
    largest = np.abs(motion[0]).max(axis=(0, 1))
    assert (np.abs(field - motion[0]).max(axis=(0, 1)) < MOTION_PART * largest).all()


def test_scales_and_bend_at_the_middle_of_a_patch() -> None:
    camera, poses, scale = single("fisheye", 35.0)
    patches = patch_of(camera, poses, FLAT, 12 * scale)
    maps = local_maps(camera, poses, FLAT, patches)
    jacobian, h = maps.plane[0, 2:, 0].reshape(2, 2), maps.second[0, :, 0]
    np.testing.assert_allclose([x[0] for x in maps.mm_per_px], np.linalg.svd(jacobian, compute_uv=False))
    # over one pixel in any direction the scale changes by no more than is said, and in some by a third of it at least
    angle = np.linspace(0, 2 * np.pi, 100)
    n = np.stack([np.cos(angle), np.sin(angle)])
    change = np.linalg.norm(h.reshape(2, 3) @ [n[0] ** 2, 2 * n[0] * n[1], n[1] ** 2], axis=0) / np.linalg.norm(jacobian @ n, axis=0)
    assert maps.bend_per_px[0] / 3 < change.max() < 1.42 * maps.bend_per_px[0]


def test_motion_fields_are_taken_over_when_given() -> None:
    camera, poses, scale = single("axis", 20.0)
    patches = patch_of(camera, poses, FLAT, 12 * scale)
    before = local_maps(camera, poses, FLAT, patches)
    moved = Poses(poses.rotation, poses.position_mm + 1.0)
    after = local_maps(camera, moved, FLAT, patches, before)
    assert after.motion is before.motion
    assert np.abs(after.plane - before.plane).max() > 0


def test_a_patch_beyond_the_lens_has_infinite_misfit() -> None:
    camera, poses, _ = single("edge of 90 degrees", 0.0)
    beyond = Poses(poses.rotation, np.array([[900.0, 0.0, 100.0]]))
    patches = Patches(np.array([0]), np.zeros((1, 2)), np.array([5.0]), np.array([[999.0, 368.0]]), np.array([10.0]))
    maps = local_maps(camera, beyond, FLAT, patches)
    assert np.isinf(maps.misfit_px).all()
    assert np.isfinite(maps.plane).all()


def test_a_target_that_a_bad_step_brought_beside_the_camera_has_finite_maps() -> None:
    turn = rotation_from_vector(np.array([[0.4116305, 1.0425134, -0.1285347]]))
    poses = Poses(turn, np.array([[134.1249, 161.7974, 7.4570]]))
    # of its points few have an image, and these lie thousands of pixels out
    patches = Patches(np.array([0]), np.zeros((1, 2)), np.array([34.0]), np.array([[395.0, 454.0]]), np.array([30.0]))
    maps = local_maps(PLAIN, poses, FLAT, patches)
    assert np.isinf(maps.misfit_px).all()
    assert np.isfinite(maps.plane).all()
    assert np.isfinite(maps.motion).all()


@pytest.mark.parametrize("view", VIEWS)
def test_the_plane_at_common_offsets_is_that_of_each_patch(view: str) -> None:
    camera, poses, scale = single(view, 30.0)
    both = Poses(np.repeat(poses.rotation, 2, axis=0), np.repeat(poses.position_mm, 2, axis=0))
    patches = patches_around(camera, both, np.repeat(FLAT, 2, axis=0), (np.zeros((2, 2)), scale * np.array([12.0, 20.0])), 0.85)
    maps = local_maps(camera, both, np.repeat(FLAT, 2, axis=0), patches)
    du, dv = np.random.default_rng(7).uniform(-10, 10, (2, 50))
    rows = slice(1, 4)
    six = plane_at_offsets(maps, patches, rows, du, dv)
    shrink = patches.scale_px[rows, None]
    expected = maps.plane[rows] @ monomials(du / shrink, dv / shrink, maps.degree)
    np.testing.assert_allclose(six, expected, atol=SINGLE * np.abs(expected).max())


@given(st.floats(0.1, 3), st.floats(-0.6, 0.6), st.floats(0.3, 1.0), st.floats(0, 6.3), st.floats(0.3, 1.7))
def test_edge_distance_leads_to_the_edge_where_the_map_is_affine(
    size: float, shear: float, squeeze: float, angle: float, part: float
) -> None:
    """Along the returned normal, at the returned distance, lies the circle; to rounding."""
    jacobian = size * np.array([[1.0, shear], [0.0, squeeze]])
    radius, center = 10.0, np.array([2.0, -1.0])
    start = center + part * radius * np.array([np.cos(angle), np.sin(angle)])
    six = np.concatenate([start, jacobian.reshape(-1)])[None, :, None]
    distance, nu, nv, px_per_mm, _ = (v[0, 0] for v in edge_distance(six, center[None], np.array([radius])))
    end = start + jacobian @ (distance * np.array([nu, nv]))
    # a line along the gradient can miss a strongly tilted circle from far outside; then no edge is claimed to be met
    meets = ((jacobian @ [nu, nv]) @ (start - center)) ** 2 + ((jacobian @ [nu, nv]) ** 2).sum() * (radius**2 - (part * radius) ** 2) >= 0
    if meets:
        assert np.linalg.norm(end - center) == pytest.approx(radius, abs=1e-7)
        assert (distance > 0) == (part < 1) or abs(distance) < ROUNDING
    assert np.hypot(nu, nv) == pytest.approx(1)
    assert px_per_mm == pytest.approx(1 / np.linalg.norm(jacobian.T @ (start - center) / np.linalg.norm(start - center)))


@dataclass(frozen=True)
class Outline:
    """Pixels (n,) near one projected circle: the model's six and second derivatives there, and what is true of the nearest edge point."""

    six: Array
    second: Array
    radius_mm: Array
    distance_px: Array
    curvature_per_px: Array


def traced(view: str, tilt_deg: float) -> Outline:
    """A circle traced by 8000 exact projections; its curvature from three of them at a time."""
    camera, poses, scale = single(view, tilt_deg)
    radius = 12 * scale
    patches = patch_of(camera, poses, FLAT, radius)
    maps = local_maps(camera, poses, FLAT, patches)
    angle = np.linspace(0, 2 * np.pi, 8001)[:-1]
    circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    edge = camera.project(poses.in_camera(bent_print_mm(circle[None], FLAT)))[0]
    s, t, pixels = in_patch(patches, np.random.default_rng(6), 1000)
    _, place = cKDTree(edge).query(pixels)
    before, here, after = edge[place - 40], edge[place], edge[(place + 40) % len(edge)]
    along = after - before
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    gap = pixels - here
    nearest = np.abs(along[:, 0] * gap[:, 1] - along[:, 1] * gap[:, 0])
    inside = np.linalg.norm(cut_with_plane(camera, poses, pixels), axis=1) < radius
    one, two = here - before, after - here
    area = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    curvature = 2 * area / np.prod([np.linalg.norm(x, axis=1) for x in (one, two, after - before)], axis=0)
    mono = monomials(s, t, maps.degree)
    return Outline(maps.plane @ mono, maps.second @ mono, np.array([radius]), np.where(inside, nearest, -nearest), curvature)


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("tilt_deg", [0.0, 30.0, 50.0])
def test_edge_distance_against_the_nearest_point_of_the_projected_circle(view: str, tilt_deg: float) -> None:
    edge = traced(view, tilt_deg)
    distance, *_ = edge_distance(edge.six, np.zeros((1, 2)), edge.radius_mm)
    error, nearest = np.abs(distance[0] - edge.distance_px), np.abs(edge.distance_px)
    at, near = nearest < AT_EDGE_PX, nearest < NEAR_EDGE_PX
    assert at.sum() > 10
    assert error[at].max() < AT_EDGE_ERROR_PX
    assert (error[near] < AT_EDGE_ERROR_PX + PER_SQUARE_PX * nearest[near] ** 2).all()


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("tilt_deg", [0.0, 30.0])
def test_second_derivatives_give_distance_and_curvature_through_a_wide_lens(view: str, tilt_deg: float) -> None:
    edge = traced(view, tilt_deg)
    nearest = np.abs(edge.distance_px)
    at, near = nearest < AT_EDGE_PX, nearest < NEAR_EDGE_PX
    worst = []
    for second in (edge.second, None):
        distance, _, _, _, curvature = edge_distance(edge.six, np.zeros((1, 2)), edge.radius_mm, second)
        away = np.abs(distance[0] - edge.distance_px)[near] / np.maximum(nearest[near], AT_EDGE_PX) ** 2
        worst.append((away.max(), np.abs(curvature[0] - edge.curvature_per_px)[at].max()))
    assert worst[0][0] < BENT_PER_SQUARE_PX
    assert worst[0][1] < BENT_CURVATURE
    if view != "axis":
        assert worst[1][0] > 2 * worst[0][0]
        assert worst[1][1] > 2 * BENT_CURVATURE


@pytest.mark.parametrize(("radius_px", "tilt_deg"), [(8.0, 0.0), (8.0, 40.0), (30.0, 60.0)])
def test_curvature_at_the_edge_is_that_of_the_ellipse(radius_px: float, tilt_deg: float) -> None:
    """From far away a circle is an ellipse with a / b^2 and b / a^2 as its extreme curvatures."""
    camera = Camera(400, 300, [3e5, 3e5], [199.5, 149.5])
    pose = facing_towards(camera, (199.5, 149.5), 1e5, np.radians(tilt_deg), 0.0)
    poses = Poses(pose.rotation[None], pose.translation_mm[None])
    radius = radius_px / 3
    patches = patch_of(camera, poses, FLAT, radius)
    maps = local_maps(camera, poses, FLAT, patches)
    minor = radius_px * np.cos(np.radians(tilt_deg))
    places = np.array([[radius_px, 0.0], [0.0, minor]]) + camera.principal_px
    s, t = ((places - patches.anchor_px[0]) / patches.scale_px[0]).T[:, None]
    *_, curvature = edge_distance(maps.plane @ monomials(s, t, maps.degree), np.zeros((1, 2)), np.array([radius]))
    np.testing.assert_allclose(curvature[0], [radius_px / minor**2, minor / radius_px**2], rtol=1e-3)
