"""The dish's rim in simulated photographs: where it is, how well that is known, and when there is none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr

from dishmap.camera.model import Camera
from dishmap.difference.circle import circle_pieces, circle_points, circle_poses
from dishmap.difference.outline import binarise, clean_crossings, dish_component, dish_outline, hull_outline, join_sectors, reduced
from dishmap.difference.profile import fit_edges
from dishmap.difference.rim import Rim, RimAssumptions, RimPrior, find_rim, find_rims, relative_to_rim
from dishmap.difference.rimfit import NUISANCES, PoseData, rows
from dishmap.errors import CameraError, ImageError, InputError, MeasurementError
from dishmap.simulate.contour import add_curve, circle, finish
from dishmap.simulate.deform import Deformation, ZernikeTerm
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Light, Polygon, Ribs, Scene, Sensor, facing_pose, random_shapes
from dishmap.targets.builders import dish
from dishmap.targets.pattern import Surface
from dishmap.transforms import Pose, angle_between_rad, rotation_from_vector

Array = NDArray[np.float64]

# What is asked of the rim: position across the line of sight, and boresight.
ACROSS_MM, BORESIGHT_DEG = 0.05, 0.02
# Without noise and shading the model's own error is a few 1e-5 px; 16 bits round to less.
NOISELESS_PX = 5e-4

SMALL = Camera(520, 500, [600.0, 601.0], [262.0, 247.0], [-0.2, 0.06, 0.0005, -0.0003])
LARGE = Camera(1640, 1500, [1700.0, 1701.0], [815.0, 752.0], [-0.2, 0.06, 0.0005, -0.0003])
PATTERN = dish(600.0, 300.0, spacing_mm=90.0, margin_mm=20.0)
SURFACE = PATTERN.surface
DARK_RIBS = Ribs(9, 14.0, 280.0, 330.0, grey=50.0, first_rad=0.3)


def small_scene(rng: np.random.Generator, tilt_deg: float | None = None) -> Scene:
    """A dish of 150 to 200 px radius with ribs, clutter and shading, tilted by 4 to 12 degrees unless said otherwise."""
    tilt = np.radians(rng.uniform(4, 12) if tilt_deg is None else tilt_deg)
    pose = facing_pose(rng.uniform(950, 1150), tilt, rng.uniform(0, 2 * np.pi))
    front = bool(rng.integers(2))
    ribs = Ribs(
        count=int(rng.integers(8, 13)),
        width_mm=rng.uniform(8, 16),
        inner_radius_mm=rng.uniform(275, 290),
        outer_radius_mm=rng.uniform(315, 335),
        grey=float(rng.choice([40.0, 90.0, 170.0])),
        first_rad=rng.uniform(0, 6),
        front=front,
    )
    light = Light(gradient=(rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1)), vignetting=0.15, background_grey=rng.uniform(5, 50))
    return Scene(
        PATTERN,
        SMALL,
        Pose(pose.rotation, pose.translation_mm + [*rng.uniform(-10, 10, 2), 0.0]),
        light=light,
        sensor=Sensor(rng.uniform(0.5, 1.5), noise_grey=2.0),
        ribs=(ribs,),
        background=random_shapes(rng, SMALL, 2, 2, 2, (5.0, 20.0), (20.0, 120.0)),
    )


def plain_scene(tilt_deg: float = 6.0, camera: Camera = SMALL, **changes: Any) -> Scene:
    """No noise but the rounding of 16 bits."""
    return replace(Scene(PATTERN, camera, facing_pose(1000.0, np.radians(tilt_deg), 0.5), sensor=Sensor(0.8, bits=16)), **changes)


def shot(scene: Scene, seed: int = 0) -> NDArray[Any]:
    return simulate(scene, np.random.default_rng(seed)).image


def nearest(rims: tuple[Rim, ...], truth: Pose) -> Rim:
    return min(rims, key=lambda rim: float(angle_between_rad(rim.camera_from_rim.rotation[:, 2], truth.rotation[:, 2])))


def errors(rim: Rim, truth: Pose) -> Array:
    """Move (3) in mm and turn (2) about the dish's x and y in rad, estimate less truth."""
    axis = truth.rotation[:, 2] @ rim.camera_from_rim.rotation
    return np.array([*(rim.camera_from_rim.translation_mm - truth.translation_mm), axis[1], -axis[0]])


def across_mm(move_mm: Array, truth: Pose) -> float:
    sight = truth.translation_mm / np.linalg.norm(truth.translation_mm)
    return float(np.linalg.norm(move_mm - sight * (sight @ move_mm)))


# --- the paper's steps


def test_outline_step_by_step() -> None:
    v, u = np.mgrid[:200, :240]
    disc = np.hypot(u - 120, v - 100) < 70
    rib, ink = (np.abs(v - 100) < 4) & (u > 120) & (u < 215), np.hypot(u - 100, v - 90) < 6
    picture = np.where((disc & ~ink) | rib, 180, 20).astype(np.uint8)
    mask, light = binarise(picture)
    assert light
    assert (mask == (picture > 100)).all()
    inverse, light = binarise(255 - picture)
    assert not light
    assert (inverse == mask).all()
    clean = clean_crossings(mask, 8.0)
    assert not clean[100, 200]
    assert clean[90, 100]
    # of the rib a bump is left, lower than the disc of the opening reaches into it: 5.5 - sqrt(5.5^2 - 3.5^2) px
    assert np.count_nonzero(clean[100] & ~disc[100]) <= 2
    speck = clean.copy()
    speck[5:15, 5:15] = True
    assert (dish_component(speck) == dish_component(clean)).all()
    hull = hull_outline(dish_component(clean))
    assert np.abs(np.hypot(*(hull - [120, 100]).T) - 69.5).max() < 2.0
    cut = disc & ~(np.abs(u - 120) < 4)
    assert dish_component(cut).sum() < 0.6 * disc.sum()
    assert dish_component(join_sectors(cut, 8.0)).sum() > 0.97 * disc.sum()


def test_reduced_picture_is_the_mean_of_blocks() -> None:
    gray = np.arange(60, dtype=np.uint16).reshape(6, 10) * 1000
    small = reduced(gray, 2)
    assert small.shape == (3, 5)
    assert small[0, 0] == 0
    assert small[-1, -1] == 255


def test_hull_of_a_dish_with_ribs_lies_within_pixels_of_the_rim() -> None:
    scene = plain_scene(ribs=(DARK_RIBS,))
    outline = dish_outline(shot(scene))
    ray = SMALL.unproject(outline.border_px) @ scene.camera_from_dish.rotation
    eye = scene.camera_from_dish.inverse().translation_mm
    at = eye + ((75.0 - eye[2]) / ray[:, 2])[:, None] * ray
    # 1.7 mm to a pixel
    assert np.median(np.abs(np.hypot(at[:, 0], at[:, 1]) - 300)) < 1.7


# --- edges in raw pixels


@pytest.mark.parametrize("psf_px", [0.5, 0.8, 1.5])
def test_edge_of_an_exact_disc(psf_px: float) -> None:
    radius, center = 200.3, (220.2, 217.7)
    points, dv = circle(center, radius, psf_px)
    light = np.zeros((436, 440))
    add_curve(light, (0, 0), points, dv, psf_px)
    gray = np.rint(finish(light) * 30000 + 5000).astype(np.uint16)
    # the camera looks straight at a circle of 200.3 mm from 500 mm
    camera = Camera(440, 436, [500.0, 500.0], [*center])
    for guess in (radius, radius - 2.5):
        pieces = circle_pieces(camera, facing_pose(500.0), guess, 0.0, 200, 6.0)
        assert pieces.curvature_per_px == pytest.approx(1 / guess, rel=1e-3)
        edges = fit_edges(gray, pieces, 9.0, light_inside=True)
        assert edges.good.all()
        assert edges.blur_px == pytest.approx(np.hypot(psf_px, 1 / np.sqrt(12)), abs=0.01)
        assert guess + edges.shift_px.mean() == pytest.approx(radius, abs=NOISELESS_PX)
    assert not fit_edges(gray, pieces, 9.0, light_inside=False).good.any()


def test_sigma_of_an_edge_is_true() -> None:
    step = 20.0 + 140.0 * ndtr((29.7 - np.arange(60)) / 0.9)[None, :]
    gray = np.random.default_rng(1).normal(step, 4.0, (3000, 60)).clip(0, 255).astype(np.float32)
    camera = Camera(60, 3000, [1e6, 1e6], [-1e6 + 29.5, 1500.0])
    pieces = circle_pieces(camera, facing_pose(1e6), 1e6, 0.0, 8, 6.0)
    middle = np.stack([np.full(400, 29.5), 20.0 + 7 * np.arange(400)], axis=1)
    straight = replace(pieces, middle_px=middle, normal=np.tile([1.0, 0.0], (400, 1)), curvature_per_px=np.zeros(400), length_px=6.0)
    edges = fit_edges(gray, straight, 6.0, light_inside=True)
    assert edges.good.mean() > 0.97
    assert edges.noise == pytest.approx(4.0, rel=0.03)
    # 400 draws know their standard deviation to 3.5 %
    assert np.std((edges.shift_px / edges.sigma_px)[edges.good]) == pytest.approx(1.0, abs=0.12)


# --- the pose of a circle


@pytest.mark.parametrize("tilt_deg", [2.0, 25.0])
def test_an_exact_outline_gives_the_pose_and_its_mirror(tilt_deg: float) -> None:
    truth = Pose(facing_pose(1.0, np.radians(tilt_deg), 1.0).rotation, np.array([40.0, -25.0, 900.0]))
    angle = np.arange(720) * np.pi / 360
    seen = SMALL.project(truth.apply(circle_points(300.0, 75.0, angle)))
    # a third of it runs elsewhere
    seen[:240] += 15.0
    poses = circle_poses(SMALL, seen, 300.0, 75.0)
    best = min(poses, key=lambda pose: float(np.linalg.norm(pose.translation_mm - truth.translation_mm)))
    assert best.translation_mm == pytest.approx(truth.translation_mm, abs=1e-4)
    assert angle_between_rad(best.rotation[:, 2], truth.rotation[:, 2]) < 1e-6
    # the other one shows the same circle
    other = poses[1] if best is poses[0] else poses[0]
    again = SMALL.project(other.apply(circle_points(300.0, 75.0, angle[::20])))
    fine = SMALL.project(truth.apply(circle_points(300.0, 75.0, np.arange(36000) * np.pi / 18000)))
    # points of the fine circle are 0.04 px apart
    assert np.linalg.norm(again[:, None] - fine, axis=2).min(axis=1).max() < 0.03
    assert angle_between_rad(other.rotation[:, 2], truth.rotation[:, 2]) > np.radians(tilt_deg)


def test_derivatives_of_the_fit() -> None:
    pose = Pose(facing_pose(1.0, 0.1, 0.7).rotation, np.array([20.0, 10.0, 800.0]))
    pieces = circle_pieces(SMALL, pose, 300.0, 75.0, 400, 2.0)
    prior = (Pose(pose.rotation, pose.translation_mm + 0.1), np.diag([1, 1, 2, 1e-4, 1e-4, 1e-2]))
    data = PoseData(SMALL, 300.0, 75.0, pieces.middle_px, pieces.normal, np.full(400, 0.1), prior, 0.3, 0.2, 0.1, 0.46)
    nuisance = np.zeros(NUISANCES)
    _, jacobian = rows(data, pose, nuisance)
    for k in range(6 + NUISANCES):
        size = 1e-6 if 3 <= k < 6 else 1e-3
        values = []
        for step in (size * np.eye(6 + NUISANCES)[k], -size * np.eye(6 + NUISANCES)[k]):
            moved = Pose(pose.rotation @ rotation_from_vector(step[3:6]), pose.translation_mm + step[:3])
            values.append(rows(data, moved, nuisance + step[6:])[0])
        # the derivative holds the point's place on the circle, along which pieces of 3 px are not quite straight
        assert -(values[0] - values[1]) / (2 * size) == pytest.approx(jacobian[:, k], abs=1e-3 * np.abs(jacobian[:, k]).max())


# --- the rim


def test_noiseless_rim_is_exact() -> None:
    scene = plain_scene(ribs=(DARK_RIBS,))
    rims = find_rims(shot(scene), SMALL, SURFACE)
    assert len(rims) == 2
    rim = nearest(rims, scene.camera_from_dish)
    error = errors(rim, scene.camera_from_dish)
    assert across_mm(error[:3], scene.camera_from_dish) < 2e-3
    assert np.degrees(np.abs(error[3:]).max()) < 2e-3
    assert rim.rms_px < NOISELESS_PX
    # nine ribs of 14 mm hide 7 % of the rim, and a piece on either side of each is left out
    assert 0.75 < rim.share < 0.93
    assert rim.blur_px == pytest.approx(np.hypot(0.8, 1 / np.sqrt(12)), abs=0.01)
    assert np.isinf(rim.covariance[5, 5])
    assert rim.points_px.shape == (len(rim.used), 2)
    # 0.3 px of the rim's 184 px, 925 mm away: the edge's own offset is what limits the distance
    assert np.sqrt(rim.covariance[2, 2]) == pytest.approx(0.3 / 184 * 925, rel=0.03)
    # y is up in the image where nothing else says the turn
    assert rim.camera_from_rim.rotation[:, 1] @ [0.0, -1.0, 0.0] > 0.9


def test_claimed_sigmas_are_those_of_the_errors() -> None:
    # distance is left to its assumption, which these pictures do not make use of: four numbers remain
    chi = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        scene = small_scene(rng)
        rim = nearest(find_rims(shot(scene, seed), SMALL, SURFACE), scene.camera_from_dish)
        error, truth = errors(rim, scene.camera_from_dish), scene.camera_from_dish
        basis = np.linalg.svd(truth.translation_mm[None])[2][1:]
        turned = np.zeros((4, 5))
        turned[:2, :3], turned[2:, 3:] = basis, np.eye(2)
        covariance = turned @ rim.covariance[:5, :5] @ turned.T
        chi.append(float(turned @ error @ np.linalg.solve(covariance, turned @ error)))
    # the mean of 40 chi-squares of 4 has a standard deviation of 0.45; sigmas 15 % off would show
    assert np.mean(chi) == pytest.approx(4.0, abs=1.35)
    assert max(chi) < 23.5  # one case in 1e4 each


@pytest.mark.parametrize("front", [True, False])
def test_rim_is_found_as_well_as_asked(front: bool) -> None:
    rng = np.random.default_rng(3)
    pattern = dish(600.0, 300.0, spacing_mm=140.0, margin_mm=14.0)
    scene = plain_scene(
        3.0,
        LARGE,
        pattern=pattern,
        sensor=Sensor(1.2, noise_grey=2.0),
        light=Light(gradient=(0.15, -0.1), vignetting=0.2, background_grey=40.0),
        ribs=(Ribs(12, 12.0, 285.0, 330.0, 120.0, 0.1, front),),
        camera_from_dish=Pose(facing_pose(800.0, np.radians(3.0), 2.0).rotation, np.array([6.0, -4.0, 800.0])),
        background=random_shapes(rng, LARGE, 4, 4, 4, (10.0, 50.0), (20.0, 150.0)),
    )
    rough = Pose(scene.camera_from_dish.rotation @ rotation_from_vector([0.01, -0.005, 0.02]), scene.camera_from_dish.translation_mm + 2.0)
    rim = find_rim(shot(scene, 1), LARGE, SURFACE, RimPrior.within(rough, 5.0, 0.5))
    error = errors(rim, scene.camera_from_dish)
    assert across_mm(error[:3], scene.camera_from_dish) < ACROSS_MM / 5
    assert np.degrees(np.hypot(*error[3:])) < BORESIGHT_DEG / 3
    assert np.degrees(np.sqrt(rim.covariance[3, 3] + rim.covariance[4, 4])) < BORESIGHT_DEG / 3
    # the turn about the boresight is the prior's, and as well known as there
    x = rough.rotation[:, 0]
    assert angle_between_rad(rim.camera_from_rim.rotation[:, 0], x) < 0.02
    assert np.sqrt(rim.covariance[5, 5]) == pytest.approx(np.radians(0.5), rel=0.02)


def test_a_prior_tells_mirrored_poses_apart_and_none_is_chosen_without() -> None:
    scene = plain_scene()
    image, truth = shot(scene), scene.camera_from_dish
    with pytest.raises(MeasurementError, match=r"two poses of the dish explain its rim equally, with boresights 11\.\d* degrees apart"):
        find_rim(image, SMALL, SURFACE)
    assert find_rim(image, SMALL, SURFACE, RimPrior.within(truth, 5.0, 1.0)).share > 0.9
    # a prior that is no better than the poses are apart does not choose
    assert len(find_rims(image, SMALL, SURFACE, RimPrior.within(truth, 50.0, 10.0))) == 2
    wrong = Pose(truth.rotation @ rotation_from_vector([0.0, 0.3, 0.0]), truth.translation_mm)
    with pytest.raises(MeasurementError, match=r"the rim lies .* sigmas from the given pose"):
        find_rim(image, SMALL, SURFACE, RimPrior.within(wrong, 5.0, 1.0))


def test_straight_on_both_poses_are_one_with_a_sigma_that_says_so() -> None:
    for seed, tilt_deg in enumerate([0.0, 0.1, 0.2]):
        scene = plain_scene(tilt_deg, sensor=Sensor(0.8, noise_grey=2.0))
        (rim,) = find_rims(shot(scene, seed), SMALL, SURFACE)
        error, sigma = errors(rim, scene.camera_from_dish), np.sqrt(np.diag(rim.covariance))
        assert (np.abs(error) < 3 * sigma[:5]).all()
        # second order: sqrt(2 sigma / r), 0.1 to 0.3 degrees for some 0.002 px of 166 px
        assert 0.05 < np.degrees(sigma[3]) < 0.6


def test_a_bent_rim_needs_its_bend_assumed() -> None:
    bent = Deformation(zernike=(ZernikeTerm(2, 2, 0.2),), slide="normal")
    scene = plain_scene(deformation=bent)
    image, truth = shot(scene), scene.camera_from_dish
    stiff = nearest(find_rims(image, SMALL, SURFACE), truth)
    assert np.degrees(np.abs(errors(stiff, truth)[3:]).max()) > 0.05
    prior = RimPrior.within(truth, 5.0, 1.0)
    rims = find_rims(image, SMALL, SURFACE, prior, RimAssumptions(sigma_bend_mm=0.4))
    for rim in rims:
        error, sigma = errors(rim, truth), np.sqrt(np.diag(rim.covariance))[:5]
        assert (np.abs(error) < 2.5 * sigma).all()
        assert np.degrees(sigma[3:].max()) > 0.1


def test_ribs_right_across_the_dish_and_a_dark_dish() -> None:
    sectors = plain_scene(ribs=(Ribs(8, 16.0, 0.0, 330.0, grey=20.0),))
    dark = plain_scene(light=Light(ink_grey=10.0, ground_grey=70.0, background_grey=200.0), ribs=(replace(DARK_RIBS, grey=120.0),))
    for scene in (sectors, dark):
        error = errors(nearest(find_rims(shot(scene), SMALL, SURFACE), scene.camera_from_dish), scene.camera_from_dish)
        assert across_mm(error[:3], scene.camera_from_dish) < ACROSS_MM
        assert np.degrees(np.abs(error[3:]).max()) < BORESIGHT_DEG


def test_positions_relative_to_the_rim_do_not_move_with_the_dish() -> None:
    first = plain_scene(5.0)
    moved = replace(first, camera_from_dish=Pose(facing_pose(1.0, np.radians(7.0), 0.9).rotation, np.array([15.0, 8.0, 1020.0])))
    places = []
    for scene in (first, moved):
        simulation = simulate(scene, np.random.default_rng(0))
        prior = RimPrior.within(scene.camera_from_dish, 1.0, 0.05)
        rim = find_rim(simulation.image, SMALL, SURFACE, prior)
        # the prior's turn is off by nothing here: positions are those of the pattern
        places.append(relative_to_rim(simulation.truth.center_px, rim))
        assert places[-1] == pytest.approx(PATTERN.center_mm[:, :2], abs=0.05)
    assert np.isnan(relative_to_rim([[1e6, 1e6]], rim)).all()
    flat = replace(rim, surface=Surface("plane", 600.0))
    on_plane = SMALL.project(flat.camera_from_rim.apply([[30.0, -40.0, 0.0]]))
    assert relative_to_rim(on_plane, flat) == pytest.approx(np.array([[30.0, -40.0]]), abs=1e-6)


def test_a_flat_disc_has_a_rim_too() -> None:
    pattern = replace(PATTERN, surface=Surface("plane", 600.0), center_mm=PATTERN.center_mm * [1, 1, 0])
    scene = plain_scene(pattern=pattern)
    rim = nearest(find_rims(shot(scene), SMALL, pattern.surface), scene.camera_from_dish)
    assert across_mm(errors(rim, scene.camera_from_dish)[:3], scene.camera_from_dish) < 2e-3


# --- no rim


def test_where_there_is_no_rim() -> None:
    scene = plain_scene()
    image = shot(scene)
    with pytest.raises(MeasurementError, match=r"no rim to find; give the surface's diameter_mm"):
        find_rim(image, SMALL, Surface())
    with pytest.raises(MeasurementError, match="no dish stands out"):
        find_rim(np.full((500, 520), 90, np.uint8), SMALL, SURFACE)
    noise = np.random.default_rng(0).normal(90, 3, (500, 520)).astype(np.uint8)
    with pytest.raises(MeasurementError):
        find_rim(noise, SMALL, SURFACE)
    out_of_view = replace(scene, camera_from_dish=Pose(scene.camera_from_dish.rotation, np.array([150.0, 0.0, 1000.0])))
    with pytest.raises(MeasurementError, match="reaches the border of the photograph"):
        find_rim(shot(out_of_view), SMALL, SURFACE)
    # the ground goes on beyond the dish
    borderless = replace(scene, light=Light(background_grey=190.0))
    with pytest.raises(MeasurementError):
        find_rim(shot(borderless), SMALL, SURFACE)


def test_a_rim_that_is_not_closed() -> None:
    hidden = Polygon(((0.0, 300.0), (520.0, 300.0), (520.0, 500.0), (0.0, 500.0)), 12.0)
    with pytest.raises(MeasurementError, match=r"the rim is not closed: .* lies on one circle, with a gap of 1"):
        find_rim(shot(plain_scene(occluders=(hidden,))), SMALL, SURFACE)
    square = np.full((500, 520), 15, np.uint8)
    square[100:400, 110:410] = 190
    with pytest.raises(MeasurementError):
        find_rim(square, SMALL, SURFACE)


def test_unusable_input_is_named() -> None:
    with pytest.raises(CameraError, match="the photograph is 100x80 px but the camera's are 520x500 px"):
        find_rim(np.zeros((80, 100), np.uint8), SMALL, SURFACE)
    with pytest.raises(ImageError, match="grey image"):
        find_rim(np.zeros((500, 520, 3), np.uint8), SMALL, SURFACE)
    with pytest.raises(InputError, match="sigma_edge_px must be zero or more, not -1"):
        RimAssumptions(sigma_edge_px=-1.0)
    with pytest.raises(InputError, match="6x6 finite numbers and positive definite"):
        RimPrior(Pose.identity(), np.zeros((6, 6)))


def test_another_programs_dish(shared_data) -> None:  # type: ignore[no-untyped-def]
    """The shared Mitsuba render shows the rim and six of its ribs; its pose comes from the truth of its targets."""
    from dishmap.io.camera_file import read_camera
    from dishmap.io.images import read_gray

    camera = read_camera(shared_data / "dish" / "camera.yaml")
    rims = find_rims(read_gray(shared_data / "dish" / "ref.png"), camera, SURFACE)
    # the target at the vertex, in the camera frame
    vertex, normal = np.array([4.0, -3.0, 665.0]), np.array([0.052335956, 0.034851668, -0.998021197])
    truth = Pose(np.linalg.qr(np.column_stack([normal, np.eye(3)[:, :2]]))[0][:, [1, 2, 0]] * 1.0, vertex)
    axis = min((rim.camera_from_rim.rotation[:, 2] for rim in rims), key=lambda z: float(angle_between_rad(z, normal)))
    rim = next(rim for rim in rims if rim.camera_from_rim.rotation[:, 2] is axis or np.allclose(rim.camera_from_rim.rotation[:, 2], axis))
    assert np.degrees(angle_between_rad(axis, normal)) < BORESIGHT_DEG / 4
    assert across_mm(rim.camera_from_rim.translation_mm - vertex, truth) < ACROSS_MM / 5
    assert rim.share > 0.9
