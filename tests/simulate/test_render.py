"""Simulated photographs against independent projections (OpenCV), counting, and analytic light."""

from __future__ import annotations

import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from dishmap.camera.model import Camera
from dishmap.errors import InputError
from dishmap.simulate.deform import Bump, Deformation, ZernikeTerm
from dishmap.simulate.render import render_light, simulate
from dishmap.simulate.scene import Disc, Glare, Light, Polygon, Scene, Sensor, facing_pose, random_shapes
from dishmap.targets.pattern import Pattern, Surface, TargetKind
from dishmap.transforms import Pose, rotation_from_vector

Array = NDArray[np.float64]

# Single precision of the light and 4000-point polygons; the promise is 1e-3 px.
CENTROID_PX = 5e-5
RADIUS_PX = 5e-5
# Counting 64 x 64 points per pixel, in single pixels.
COUNTED_COVERAGE = 2e-3
# Rounding of grey levels in single precision.
LIGHT_GREY = 1e-4

DISC = TargetKind([[0.0, 0.0]], [5.0], [True])
RING = TargetKind([[0.0, 0.0], [0.0, 0.0]], [5.0, 3.0], [True, False])
FOUR = TargetKind(np.repeat([[-7, -7], [7, -7], [7, 7], [-7, 7]], 2, axis=0), [5.0, 3.0] * 4, [True, False] * 4)

PLAIN = Camera(400, 300, [500.0, 500.0], [199.5, 149.5])
# About 90 degrees across, with strong distortion
WIDE = Camera(1000, 750, [500.0, 503.0], [503.2, 368.1], [-0.25, 0.08, 0.001, -0.0007, -0.01])
FISHEYE = Camera(900, 900, [280.0, 281.0], [451.0, 448.5], [0.03, -0.01, 0.003, -0.0005], "fisheye")
# The ground goes on beyond the plate
CLEAR = Light(ink_grey=0.0, ground_grey=200.0, background_grey=200.0)


def one_target(kind: TargetKind, surface: Surface | None = None) -> Pattern:
    return Pattern("one", surface or Surface(), {"k": kind}, [7], ["k"], [[0, 0, 0]], [[1, 0, 0]], [[0, 0, 1]])


def scene_of(kind: TargetKind, camera: Camera, pose: Pose, psf_sigma_px: float = 0.8) -> Scene:
    """One target, and nothing else."""
    return Scene(one_target(kind), camera, pose, light=CLEAR, sensor=Sensor(psf_sigma_px=psf_sigma_px))


def pose_towards(camera: Camera, pixel: tuple[float, float], distance_mm: float, tilt_rad: float, turn_rad: float) -> Pose:
    """A target seen at a pixel, its normal tilted from the line of sight."""
    ray = camera.unproject(np.array(pixel))
    side = np.cross(ray, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    facing = np.stack([side * -1, np.cross(-ray, side * -1), -ray], axis=1)
    tilted = rotation_from_vector(tilt_rad * (np.cos(turn_rad) * facing[:, 0] + np.sin(turn_rad) * facing[:, 1]))
    return Pose(tilted @ facing, distance_mm * ray)


def cv2_project(camera: Camera, points: Array) -> Array:
    zero = np.zeros(3)
    if camera.model == "fisheye":
        return np.asarray(cv2.fisheye.projectPoints(points.reshape(-1, 1, 3), zero, zero, camera.matrix, camera.distortion)[0]).reshape(
            -1, 2
        )
    return np.asarray(cv2.projectPoints(points, zero, zero, camera.matrix, camera.distortion)[0]).reshape(-1, 2)


def polygon_moments(corners: Array) -> tuple[float, Array]:
    """Area and centroid of a polygon (N, 2) by the shoelace formulas."""
    origin = corners.mean(axis=0)
    a, b = corners - origin, np.roll(corners, -1, axis=0) - origin
    twice = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return abs(float(twice.sum()) / 2), origin + ((a + b) * twice[:, None]).sum(axis=0) / (3 * twice.sum())


def image_moments(scene: Scene) -> tuple[float, Array]:
    """Area and centroid of the dark in a rendered image, from the pixels alone, around the only target."""
    light, truth = render_light(scene)
    u, v = np.round(truth.center_px[0]).astype(int)
    half = int(1.5 * np.ptp(disc_px(scene), axis=0).max() / 2 + 8 * scene.sensor.psf_sigma_px + 4)
    rows, columns = np.arange(v - half, v + half + 1), np.arange(u - half, u + half + 1)
    dark = 1 - light[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].astype(float) / scene.light.ground_grey
    area = dark.sum()
    return float(area), np.array([(dark.sum(axis=0) @ columns) / area, (dark.sum(axis=1) @ rows) / area])


def disc_px(scene: Scene, radius_mm: float = 5.0, count: int = 4000) -> Array:
    """Outline of a 5 mm circle about the origin of a plane, projected by OpenCV."""
    t = np.arange(count) * 2 * np.pi / count
    points = radius_mm * np.stack([np.cos(t), np.sin(t), 0 * t], axis=-1)
    return cv2_project(scene.camera, scene.camera_from_dish.apply(points))


def assert_moments(scene: Scene, outline: Array) -> None:
    area, center = image_moments(scene)
    expected_area, expected_center = polygon_moments(outline)
    assert np.abs(center - expected_center).max() < CENTROID_PX
    assert abs(area - expected_area) / np.sqrt(4 * np.pi * expected_area) < RADIUS_PX


@pytest.mark.parametrize("psf_sigma_px", [0.8, 1.5, 3.0])
@pytest.mark.parametrize("radius_px", [2.0, 9.3, 40.0])
def test_fronto_parallel_disc_has_its_analytic_area_and_centre(psf_sigma_px: float, radius_px: float) -> None:
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.31, -0.17, 1.0]) * 5 * 500 / radius_px)
    area, center = image_moments(scene_of(DISC, Camera(900, 700, [500.0, 500.0], [440.0, 460.0]), pose, psf_sigma_px))
    assert np.sqrt(area / np.pi) == pytest.approx(radius_px, abs=RADIUS_PX)
    assert center == pytest.approx([440 + 0.31 * 500, 460 - 0.17 * 500], abs=CENTROID_PX)


@pytest.mark.parametrize("camera", [PLAIN, WIDE, FISHEYE], ids=["plain", "wide", "fisheye"])
@pytest.mark.parametrize("tilt_deg", [0.0, 30.0, 70.0])
def test_disc_equals_the_polygon_that_opencv_projects(camera: Camera, tilt_deg: float) -> None:
    corner = (0.85 * camera.width_px, 0.2 * camera.height_px)
    scene = scene_of(DISC, camera, pose_towards(camera, corner, 100.0, np.radians(tilt_deg), 0.7))
    assert_moments(scene, disc_px(scene))
    # a printed radius that is 0.1 % larger, or a hundredth of a pixel to the side, would be seen
    with pytest.raises(AssertionError):
        assert_moments(scene, disc_px(scene, radius_mm=5.005))
    with pytest.raises(AssertionError):
        assert_moments(scene, disc_px(scene) + np.array([0.001, 0.0]))


def test_large_and_small_discs_seen_obliquely() -> None:
    for distance_mm, psf_sigma_px in ((14.0, 0.8), (1250.0, 0.8), (1250.0, 3.0)):
        scene = scene_of(DISC, WIDE, pose_towards(WIDE, (550.0, 350.0), distance_mm, 1.2, 0.3), psf_sigma_px)
        assert_moments(scene, disc_px(scene))


@settings(max_examples=15)
@given(
    lens=st.sampled_from([WIDE, FISHEYE]),
    u=st.floats(0.25, 0.75),
    v=st.floats(0.25, 0.75),
    distance_mm=st.floats(50, 300),
    tilt_deg=st.floats(0, 65),
    turn_deg=st.floats(0, 360),
    psf_sigma_px=st.floats(0.7, 3),
)
def test_any_pose_agrees_with_opencv(
    lens: Camera, u: float, v: float, distance_mm: float, tilt_deg: float, turn_deg: float, psf_sigma_px: float
) -> None:
    pixel = (u * lens.width_px, v * lens.height_px)
    pose = pose_towards(lens, pixel, distance_mm, np.radians(tilt_deg), np.radians(turn_deg))
    scene = scene_of(DISC, lens, pose, psf_sigma_px)
    assert_moments(scene, disc_px(scene))


@pytest.mark.parametrize(("camera", "psf_sigma_px"), [(WIDE, 0.3), (FISHEYE, 1.0)], ids=["wide", "fisheye"])
def test_pixels_equal_counting_along_rays(camera: Camera, psf_sigma_px: float) -> None:
    # the other way round: pixel -> ray -> plane -> inside or not, 64 x 64 times per pixel
    fine, half = 64, 7
    scene = scene_of(RING, camera, pose_towards(camera, (0.8 * camera.width_px, 0.75 * camera.height_px), 550.0, 0.9, 2.0), psf_sigma_px)
    light, truth = render_light(scene)
    u, v = np.round(truth.center_px[0]).astype(int)
    steps = (np.arange((2 * half + 1) * fine) + 0.5) / fine - 0.5 - half
    rays = camera.unproject(np.stack(np.meshgrid(u + steps, v + steps), axis=-1))
    normal, origin = scene.camera_from_dish.rotation[:, 2], scene.camera_from_dish.translation_mm
    points = rays * ((origin @ normal) / (rays @ normal))[..., None]
    rho = np.linalg.norm(points - origin, axis=-1)
    ink = ((rho < 5) & (rho > 3)).astype(float)
    size = 2 * half + 1
    counted = gaussian_filter(ink, psf_sigma_px * fine, truncate=6).reshape(size, fine, size, fine).mean(axis=(1, 3))
    drawn = 1 - light[v - half : v + half + 1, u - half : u + half + 1] / 200.0
    assert counted.max() > 0.3
    assert np.abs(drawn - counted).max() < COUNTED_COVERAGE


def test_deformed_disc_and_its_truth() -> None:
    # a disc on a plate bent by 3 mm of coma (20 mm beyond the pattern's rim) and a bump, against points moved by hand
    state = Deformation(
        zernike=(ZernikeTerm(2, 0, 0.8), ZernikeTerm(2, -2, -0.5)),
        bumps=(Bump((2.0, 1.0), 6.0, 0.9),),
        expansion_ppm=400.0,
        motion=Pose.from_rotation_vector([0.01, -0.02, 0.05], [0.4, -0.3, 1.2]),
    )
    pose = pose_towards(WIDE, (650.0, 250.0), 60.0, 0.5, 1.0)
    scene = replace(scene_of(DISC, WIDE, pose), deformation=state, pattern=one_target(DISC, Surface("plane", diameter_mm=100.0)))

    def height(x: Array, y: Array) -> Array:
        waves = 0.8 * (2 * (x**2 + y**2) / 2500 - 1) - 0.5 * (2 * x * y / 2500)
        return np.asarray(waves + 0.9 * np.exp(-((x - 2) ** 2 + (y - 1) ** 2) / 72))

    t = np.arange(4000) * 2 * np.pi / 4000
    x, y = 5 * np.cos(t), 5 * np.sin(t)
    bent = np.stack([1.0004 * x, 1.0004 * y, height(x, y)], axis=-1)
    assert_moments(scene, cv2_project(WIDE, pose.apply(state.motion.apply(bent))))
    truth = render_light(scene)[1]
    center = pose.apply(state.motion.apply([0, 0, height(np.array(0.0), np.array(0.0))]))
    step = 1e-4
    slope = [(height(np.array(step), np.array(0.0)) - height(np.array(-step), np.array(0.0))) / (2 * step * 1.0004)]
    slope += [(height(np.array(0.0), np.array(step)) - height(np.array(0.0), np.array(-step))) / (2 * step * 1.0004)]
    normal = pose.rotate(state.motion.rotate(np.array([-slope[0], -slope[1], 1.0])))
    assert truth.center_mm[0] == pytest.approx(center, abs=1e-9)
    assert truth.normal[0] == pytest.approx(normal / np.linalg.norm(normal), abs=1e-7)
    assert truth.center_px[0] == pytest.approx(cv2_project(WIDE, center[None])[0], abs=1e-9)
    assert truth.displacement_mm[0] == pytest.approx(-0.8 + 0.9 * np.exp(-5 / 72), abs=1e-12)
    assert truth.ids.tolist() == [7]


def dish_pattern(kind: TargetKind = FOUR) -> Pattern:
    """Nine targets on a 300 mm dish, f/D 0.5, out to 0.87 of its radius."""
    surface = Surface("paraboloid", 300.0, 150.0)
    angle = np.arange(8) * np.pi / 4
    xy = np.concatenate([[[0.0, 0.0]], 130 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)])
    normal = surface.normal(xy)
    x_axis = np.cross([0.0, 1.0, 0.0], normal)
    x_axis /= np.linalg.norm(x_axis, axis=1, keepdims=True)
    return Pattern("dish", surface, {"k": kind}, np.arange(9), ["k"] * 9, np.column_stack([xy, surface.height_mm(xy)]), x_axis, normal)


DISH_CAMERA = Camera(800, 600, [560.0, 560.0], [399.5, 299.5], [-0.2, 0.05, 0.0, 0.0])
DISH = Scene(dish_pattern(), DISH_CAMERA, facing_pose(400.0), sensor=Sensor(psf_sigma_px=0.7))


def test_dish_shows_all_its_targets_and_its_rim() -> None:
    light, truth = render_light(replace(DISH, light=Light(ink_grey=190.0, background_grey=0.0)))
    assert truth.visible_fraction == pytest.approx(1.0, abs=1e-6)
    assert (truth.normal[:, 2] < 0).all()
    assert truth.displacement_mm == pytest.approx(0.0)
    # invisible ink: what is left is the rim, a circle that OpenCV projects
    t = np.arange(8000) * 2 * np.pi / 8000
    rim = np.stack([150 * np.cos(t), 150 * np.sin(t), 0 * t + 150**2 / 600], axis=-1)
    area, center = polygon_moments(cv2_project(DISH_CAMERA, DISH.camera_from_dish.apply(rim)))
    assert light.sum(dtype=float) / 190 == pytest.approx(area, rel=1e-5)
    assert light.sum(axis=0, dtype=float) @ np.arange(800) / light.sum(dtype=float) == pytest.approx(center[0], abs=1e-3)


def test_facing_pose_shows_y_up_and_tilts_about_the_named_axis() -> None:
    pose = facing_pose(500.0, np.radians(20), 0.0)
    assert pose.apply([0, 0, 0]) == pytest.approx([0, 0, 500])
    right, up = DISH_CAMERA.project(pose.apply([[10, 0, 0], [0, 10, 0]])) - DISH_CAMERA.project(pose.apply([0, 0, 0]))
    assert right[0] > 5
    assert up[1] < -5
    # turned about x: the upper half (y > 0) comes up out of the dish's plane, towards the camera
    assert pose.apply([0, 100, 0])[2] == pytest.approx(500 - 100 * np.sin(np.radians(20)))


def test_what_faces_away_or_hides_behind_the_rim_is_not_drawn() -> None:
    scene = replace(DISH, camera_from_dish=facing_pose(700.0, np.radians(68)))
    truth = render_light(scene)[1]
    inside = np.array([target_is_seen(scene, point) for point in scene.pattern.center_mm])
    assert not inside.all()
    assert (truth.visible_fraction[~inside] < 0.5).all()
    assert (truth.visible_fraction[inside] > 0.5).all()
    from_behind = replace(DISH, camera_from_dish=facing_pose(700.0, np.pi))
    light, truth = render_light(from_behind)
    assert (truth.visible_fraction == 0).all()
    assert light.max() == light.min()


def target_is_seen(scene: Scene, point: Array) -> bool:
    """Whether the segment from a dish point to the camera meets the paraboloid again inside its rim."""
    eye = scene.camera_from_dish.inverse().translation_mm
    along = np.linspace(0.001, 1, 20000)[:, None]
    places = point + along * (eye - point)
    below = places[:, 2] < (places[:, :2] ** 2).sum(axis=1) / 600
    within = np.hypot(places[:, 0], places[:, 1]) < 150
    return not bool((below & within).any())


def test_visible_fraction_of_half_hidden_clipped_and_glared_targets() -> None:
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 100.0]))
    camera = Camera(401, 301, [500.0, 500.0], [200.0, 150.0])
    scene = scene_of(DISC, camera, pose)
    left = Polygon(((0.0, 0.0), (200.0, 0.0), (200.0, 300.0), (0.0, 300.0)), 90.0)
    light, truth = render_light(replace(scene, occluders=(left,)))
    assert truth.visible_fraction[0] == pytest.approx(0.5, abs=1e-6)
    assert light[150, 100] == pytest.approx(90.0, abs=1e-3)
    assert light[150, 210] == pytest.approx(0.0, abs=LIGHT_GREY)
    half_disc = replace(scene, occluders=(Disc((200.0, 150.0), 25.0 / np.sqrt(2), 60.0),))
    assert render_light(half_disc)[1].visible_fraction[0] == pytest.approx(0.5, abs=1e-6)
    # the image's border through the middle: pixel 200's centre is its last, so half a pixel more than half is seen
    cut = replace(scene, camera=Camera(201, 301, [500.0, 500.0], [200.0, 150.0]))
    assert render_light(cut)[1].visible_fraction[0] == pytest.approx(0.5 + 0.5 * 50 / (np.pi * 25**2), abs=1e-4)
    glared = replace(scene, light=replace(CLEAR, glare=(Glare((200.0, 150.0), 10.0, 510.0),)))
    # saturated where 510 exp(-d^2/200) > 255: within sqrt(200 ln 2) px
    assert render_light(glared)[1].visible_fraction[0] == pytest.approx(1 - 200 * np.log(2) / 625, abs=0.02)
    outside = replace(scene, camera_from_dish=Pose(pose.rotation, np.array([200.0, 0.0, 100.0])))
    assert render_light(outside)[1].visible_fraction[0] == 0


def test_light_shading_and_gamma() -> None:
    flat = replace(scene_of(DISC, PLAIN, facing_pose(100.0)), light=Light(ink_grey=100, ground_grey=100, background_grey=100))
    shaded = replace(flat, light=replace(flat.light, gradient=(0.2, -0.1), vignetting=0.3))
    light = render_light(shaded)[0]
    for u, v in ((0, 0), (399, 299), (120, 40)):
        x, y = u - 199.5, v - 149.5
        expected = 100 * (1 + 0.2 * x / 400 - 0.1 * y / 300 - 0.3 * (x * x + y * y) / (200**2 + 150**2))
        assert light[v, u] == pytest.approx(expected, abs=1e-3)
    image = simulate(replace(flat, sensor=Sensor(gamma=2.2, bits=16)), np.random.default_rng(0)).image
    assert image.dtype == np.uint16
    assert (image == round(65535 * (100 / 255) ** (1 / 2.2))).all()
    spot = render_light(replace(flat, light=replace(flat.light, glare=(Glare((30.0, 40.0), 8.0, 77.0),))))[0]
    assert spot[40, 30] == pytest.approx(177.0, abs=1e-3)
    assert spot[44, 36] == pytest.approx(100 + 77 * np.exp(-52 / 128), abs=1e-3)


def test_noise_is_as_asked_and_repeats_with_the_seed() -> None:
    flat = replace(scene_of(DISC, PLAIN, facing_pose(100.0)), light=Light(ink_grey=120, ground_grey=120, background_grey=120))
    noisy = replace(flat, sensor=Sensor(noise_grey=2.0, bits=16))
    first, again, other = (simulate(noisy, np.random.default_rng(seed)).image for seed in (1, 1, 2))
    assert (first == again).all()
    assert (first != other).any()
    # 120,000 pixels: the standard deviation is known to 0.2 %
    assert np.std(first / 257) == pytest.approx(2.0, rel=0.01)
    shot = simulate(replace(flat, sensor=Sensor(electrons_per_grey=30.0, bits=16)), np.random.default_rng(1)).image
    assert np.std(shot / 257) == pytest.approx(np.sqrt(120 / 30), rel=0.01)
    assert np.mean(shot / 257) == pytest.approx(120.0, abs=0.03)
    assert simulate(noisy, np.random.default_rng(1)).image.shape == (300, 400)


def test_ink_spread_moves_dark_edges_out() -> None:
    scene = scene_of(RING, PLAIN, Pose(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 100.0])))
    area, _ = image_moments(replace(scene, ink_spread_mm=0.1))
    assert area == pytest.approx(25 * np.pi * (5.1**2 - 2.9**2), rel=1e-6)
    with pytest.raises(InputError, match=r"an ink spread of 3\.5 mm closes a circle of target kind 'k'; make it smaller"):
        replace(scene, ink_spread_mm=3.5)


def test_clutter_stays_behind_the_dish() -> None:
    shapes = random_shapes(np.random.default_rng(3), DISH_CAMERA, 10, 10, 10, (5.0, 40.0), (30.0, 200.0))
    assert len(shapes) == 40
    light = render_light(replace(DISH, background=shapes))[0]
    clean = render_light(DISH)[0]
    v, u = np.mgrid[:600, :800]
    dish = np.hypot(u - 399.5, v - 299.5) < 190
    assert np.abs(light - clean)[dish].max() < 1e-3
    assert np.abs(light - clean)[~dish].max() > 20


def test_a_dish_around_the_camera_fills_the_image() -> None:
    # the rim lies behind the camera: its outline is drawn in to the border of the lens's field
    scene = replace(DISH, camera_from_dish=facing_pose(20.0), light=replace(CLEAR, background_grey=10.0))
    light = render_light(scene)[0]
    assert light.min() == pytest.approx(0.0, abs=LIGHT_GREY)
    assert np.median(light) == pytest.approx(200.0, abs=LIGHT_GREY)


def test_scene_agrees_with_an_image_of_another_program(shared_data) -> None:  # type: ignore[no-untyped-def]
    """The shared Mitsuba render of a plate: the same scene, drawn by us, registers to it within its own error."""
    rows = np.genfromtxt(shared_data / "plate" / "truth.csv", delimiter=",", skip_header=1, dtype=None, encoding="utf-8")
    rows = [row for row in rows if row[0] == "ref.png"]
    other = cv2.imread(str(shared_data / "plate" / "ref.png"), cv2.IMREAD_GRAYSCALE).astype(float)
    storage = cv2.FileStorage(str(shared_data / "plate" / "camera.yaml"), cv2.FILE_STORAGE_READ)
    matrix = storage.getNode("camera_matrix").mat()
    camera = Camera(other.shape[1], other.shape[0], np.diag(matrix)[:2], matrix[:2, 2])
    center = np.array([[row[2], row[3], row[4]] for row in rows])
    normal = np.array([rows[0][5], rows[0][6], rows[0][7]])
    along = center[1] - center[0]
    along -= normal * (along @ normal)
    along /= np.linalg.norm(along)
    pattern = Pattern("p", Surface(), {"k": FOUR}, [0], ["k"], [[0, 0, 0]], [[1, 0, 0]], [[0, 0, 1]])
    worst = 0.0
    for number in (0, 14, 29):
        pose = Pose(np.stack([along, np.cross(normal, along), normal], axis=1), center[number])
        light, truth = render_light(Scene(pattern, camera, pose, sensor=Sensor(psf_sigma_px=0.7)))
        u, v = np.round(truth.center_px[0]).astype(int)
        window = np.s_[v - 22 : v + 23, u - 22 : u + 23]
        ours = light[window].astype(float)
        y, x = np.mgrid[-1:1:45j, -1:1:45j]
        gradient = np.gradient(ours)
        terms = [ours, ours * x, ours * y, np.ones_like(ours), gradient[1], gradient[0]]
        fit = np.linalg.lstsq(np.stack([term.ravel() for term in terms], axis=1), other[window].ravel(), rcond=None)[0]
        worst = max(worst, float(np.abs(fit[4:] / fit[0]).max()))
    assert worst < 0.02


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda: Sensor(psf_sigma_px=0.0), "psf_sigma_px must lie between 0.1 and 20.0, not 0.0"),
        (lambda: Sensor(bits=12), "bits must be 8 or 16, not 12"),
        (lambda: Sensor(noise_grey=-1.0), "noise_grey must be zero or more, not -1.0"),
        (lambda: Sensor(gamma=0.0), "gamma must lie between 0.2 and 5, not 0.0"),
        (lambda: Sensor(electrons_per_grey=0.0), "electrons_per_grey must be positive, not 0.0"),
        (lambda: Light(ink_grey=300.0), "the grey of ink_grey must lie between 0 and 255, not 300.0"),
        (lambda: Light(vignetting=1.0), "leave no light in some corner"),
        (lambda: Disc((1.0, 2.0), -3.0, 10.0), "a positive radius_px"),
        (lambda: Polygon(((0.0, 0.0), (1.0, 1.0)), 10.0), "at least three corners_px"),
        (lambda: Glare((0.0, 0.0), 0.0, 10.0), "a positive sigma_px"),
        (lambda: replace(DISH, margin_mm=-1.0), "margin_mm must be zero or more, not -1.0"),
        (lambda: replace(DISH, ink_spread_mm=float("nan")), "ink_spread_mm must be a finite number, not nan"),
        (lambda: random_shapes(np.random.default_rng(0), PLAIN, 1, 0, 0, (5.0, 2.0), (0.0, 9.0)), "rising positive sizes"),
    ],
)
def test_impossible_scenes_are_refused(change, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match=message):
        change()


def test_a_large_photograph_takes_seconds() -> None:
    angle = np.arange(121) * 2.4
    xy = 24 * np.sqrt(angle)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    center = np.column_stack([xy, np.zeros(121)])
    pattern = Pattern("many", Surface(), {"k": FOUR}, np.arange(121), ["k"] * 121, center, [[1, 0, 0]] * 121, [[0, 0, 1]] * 121)
    scene = Scene(pattern, Camera(4608, 3456, [3000.0, 3000.0], [2303.5, 1727.5]), facing_pose(1000.0), sensor=Sensor(noise_grey=1.0))
    start = time.process_time()
    truth = simulate(scene, np.random.default_rng(0)).truth
    # about 2 s on one core; generous for a busy machine
    assert time.process_time() - start < 15
    assert truth.visible_fraction.min() > 0.999
