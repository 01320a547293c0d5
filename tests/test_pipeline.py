"""The whole chain on small simulated photographs: names, points, surface, what is rejected and what is missing."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CLEAR, WIDE

from dishmap.camera.model import Camera
from dishmap.errors import CameraError, IdentityError, ImageError, InputError
from dishmap.pipeline import Map, cloud_of, map_photograph
from dishmap.quality import Quality
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Disc, Glare, Polygon, Scene, Sensor, facing_pose
from dishmap.simulate.truth import Simulation
from dishmap.surface.fit import Basis
from dishmap.targets.builders import dish, multi_circular, plate, ring
from dishmap.targets.identify import PoseGuess, Upright
from dishmap.targets.pattern import Pattern, TargetKind
from dishmap.transforms import Pose, rotation_from_vector

Array = NDArray[np.float64]

CAMERA = Camera(520, 420, [1500.0, 1500.0], [259.5, 209.5])
FOUR = multi_circular(4, 4.0, 2.4, 11.2)
RING = ring(6.0, 3.6)
# Beyond this an unflagged target is wrong: one in 150,000 right ones.
LIE_SIGMAS = 4.5
# A flagged target may be pulled by what is in front of it; it may not be somewhere else.
FLAGGED_PART = 0.01
# JPEG at quality 85 and below joins the noise of neighbouring pixels; white noise shows under 1 % of correlation by chance.
JOINED, WHITE = 1.2, 1.05


def photographed(
    kind: TargetKind = FOUR, tilt_deg: float = 12.0, seed: int = 1, rows: int = 3, columns: int = 4, **changes: object
) -> tuple[Scene, Simulation]:
    sensor = Sensor(0.8, noise_grey=2.0)
    scene = Scene(plate(rows, columns, 30.0, kind), CAMERA, facing_pose(500.0, np.radians(tilt_deg), 0.7), light=CLEAR, sensor=sensor)
    scene = replace(scene, **changes)
    return scene, simulate(scene, np.random.default_rng(seed))


@cache
def plain() -> tuple[Scene, Simulation, Map]:
    scene, simulation = photographed()
    return scene, simulation, map_photograph(simulation.image, CAMERA, scene.pattern, Upright())


def errors(found: Map, simulation: Simulation) -> tuple[Array, Array]:
    """Position errors (N, 3) in mm and the depth's in claimed sigmas (N,)."""
    error = found.cloud.position_mm - simulation.truth.center_mm[np.searchsorted(simulation.truth.ids, found.cloud.ids)]
    # the paper's method claims nothing
    return error, error[:, 2] / np.maximum(np.sqrt(found.cloud.covariance_mm2[:, 2, 2]), 1e-12)


def pixel_of(scene: Scene, target: int) -> tuple[float, float]:
    u, v = scene.camera.project(scene.camera_from_dish.apply(scene.pattern.center_mm[target]))
    return float(u), float(v)


def test_a_clean_plate() -> None:
    scene, simulation, found = plain()
    np.testing.assert_array_equal(found.cloud.ids, scene.pattern.ids)
    assert found.missing == ()
    assert found.rejected == ()
    assert (found.cloud.quality == 0).all()
    assert (np.abs(errors(found, simulation)[1]) < LIE_SIGMAS).all()
    assert found.surface is not None
    assert found.surface_problem == ""
    assert found.surface.converged
    assert found.method == "pose"
    assert found.cloud.frame == "camera"
    # the rigid pose is where the plate is
    np.testing.assert_allclose(found.camera_from_dish.translation_mm, scene.camera_from_dish.translation_mm, atol=0.3)


def test_the_cloud_holds_what_was_measured() -> None:
    _, _, found = plain()
    cloud = cloud_of(found.poses)  # type: ignore[arg-type]
    np.testing.assert_array_equal(cloud.position_mm, found.cloud.position_mm)
    np.testing.assert_array_equal(cloud.covariance_mm2, found.poses.covariance[:, :3, :3])  # type: ignore[union-attr]
    assert cloud.calibration_jacobian is not None
    assert cloud.calibration_jacobian.shape == (12, 3, 4)


def test_a_guess_of_the_pose_does_as_well_as_an_upright_camera() -> None:
    scene, simulation, found = plain()
    off = Pose(rotation_from_vector(np.radians([4.0, -5.0, 6.0])), np.array([20.0, -15.0, 25.0]))
    guess = Pose(scene.camera_from_dish.rotation @ off.rotation, scene.camera_from_dish.translation_mm + off.translation_mm)
    other = map_photograph(simulation.image, CAMERA, scene.pattern, PoseGuess(guess))
    np.testing.assert_array_equal(other.cloud.ids, found.cloud.ids)
    np.testing.assert_allclose(other.cloud.position_mm, found.cloud.position_mm, atol=0.01)


def test_a_plate_that_looks_the_same_upside_down_needs_a_hint() -> None:
    scene, simulation, _ = plain()
    with pytest.raises(IdentityError):
        map_photograph(simulation.image, CAMERA, scene.pattern)


def test_the_method_of_the_paper_takes_the_same_way() -> None:
    scene, simulation, _ = plain()
    found = map_photograph(simulation.image, CAMERA, scene.pattern, Upright(), method="paper")
    assert found.method == "paper"
    np.testing.assert_array_equal(found.cloud.ids, scene.pattern.ids)
    error, _ = errors(found, simulation)
    # its depths are good to some tenths of a percent; it claims nothing
    assert np.abs(error[:, 2]).max() < 5
    assert (found.cloud.covariance_mm2 == 0).all()


def test_a_dish_through_a_wide_lens() -> None:
    pattern = dish(300.0, 150.0, 60.0, ring(11.0, 6.6), orientation_marks=True)
    scene = Scene(pattern, WIDE, facing_pose(190.0, 0.15, 0.4), light=CLEAR, sensor=Sensor(0.8, noise_grey=2.0))
    simulation = simulate(scene, np.random.default_rng(3))
    found = map_photograph(simulation.image, WIDE, pattern)
    np.testing.assert_array_equal(found.cloud.ids, pattern.ids)
    strong = found.cloud.quality & Quality.WEAK_DEPTH == 0
    assert strong.sum() > len(pattern) / 2
    assert (np.abs(errors(found, simulation)[1]) < LIE_SIGMAS).all()
    # a paraboloid is fitted to a paraboloid without being asked
    assert found.surface is not None
    assert found.surface.rms_mm < 1


def test_another_surface_can_be_asked_for() -> None:
    scene, simulation, found = plain()
    flat = map_photograph(simulation.image, CAMERA, scene.pattern, Upright(), surface=Basis("polynomial", degree=2))
    assert flat.surface is not None
    assert found.surface is not None
    assert len(flat.surface.coefficients) > len(found.surface.coefficients)


def test_a_surface_that_cannot_be_fitted_is_told_and_the_points_are_kept() -> None:
    scene, simulation = photographed(rows=2, columns=2)
    found = map_photograph(simulation.image, CAMERA, scene.pattern, Upright(), surface=Basis("polynomial", degree=3))
    assert found.surface is None
    assert found.surface_problem
    assert len(found.cloud) == 4


def test_a_target_off_the_surface_is_flagged_alone() -> None:
    scene, _ = photographed(rows=4, columns=4)
    flat, raised = scene.pattern, 5
    center = flat.center_mm + np.where(np.arange(len(flat))[:, None] == raised, [0.0, 0.0, 3.0], 0.0)
    bent = Pattern(flat.name, flat.surface, flat.kinds, flat.ids, flat.kind_names, center, flat.x_axis, flat.normal)
    simulation = simulate(replace(scene, pattern=bent), np.random.default_rng(4))
    found = map_photograph(simulation.image, CAMERA, flat, Upright())
    assert found.cloud.ids[found.cloud.quality & Quality.OFF_SURFACE != 0].tolist() == [raised]
    assert (np.abs(errors(found, simulation)[1]) < LIE_SIGMAS).all()


def half(scene: Scene, target: int, part: float, grey: float) -> Polygon:
    """A rectangle over the left part of a target."""
    (u, v), r = pixel_of(scene, target), 3.2 * scene.pattern.kind_of(target).extent_mm
    right = u - r + 2 * r * part
    return Polygon(((u - r - 3, v - r - 4), (right, v - r - 4), (right, v + r + 4), (u - r - 3, v + r + 4)), grey)


def spot(scene: Scene, target: int, radius_px: float, grey: float) -> Disc:
    """A disc over the right of a target."""
    (u, v), r = pixel_of(scene, target), 3.0 * scene.pattern.kind_of(target).extent_mm
    return Disc((u + 0.7 * r, v + 0.4 * r), radius_px, grey)


def assert_nothing_is_invented(found: Map, simulation: Simulation, hit: int, flagged: bool = True) -> None:
    """Unflagged targets are right; the one that was hit is flagged, rejected or missing; no flagged one is elsewhere."""
    error, z = errors(found, simulation)
    clean = found.cloud.quality == 0
    assert (np.abs(z[clean]) < LIE_SIGMAS).all()
    assert (np.abs(error[:, 2]) < FLAGGED_PART * found.cloud.position_mm[:, 2]).all()
    others = [i for i in simulation.truth.ids.tolist() if i != hit]
    assert set(others) <= set(found.cloud.ids.tolist())
    if flagged and hit in found.cloud.ids:
        assert not clean[found.cloud.ids == hit].any()
    gone = [ident for ident, _ in found.rejected if ident is not None]
    assert sorted([*found.cloud.ids.tolist(), *gone, *found.missing]) == simulation.truth.ids.tolist(), "every target is accounted for once"


@pytest.mark.parametrize("kind", [FOUR, RING], ids=["four rings", "ring"])
@pytest.mark.parametrize(("part", "grey"), [(0.2, 20.0), (0.2, 180.0), (0.2, 250.0), (0.6, 100.0)])
def test_something_over_a_part_of_a_target(kind: TargetKind, part: float, grey: float) -> None:
    scene, _, hit = *photographed(kind)[:2], 5
    scene = replace(scene, occluders=(half(scene, hit, part, grey),))
    simulation = simulate(scene, np.random.default_rng(2))
    found = map_photograph(simulation.image, CAMERA, scene.pattern, PoseGuess(scene.camera_from_dish))
    # a hidden ring of four leaves three that are whole: then there is nothing to say against them
    assert_nothing_is_invented(found, simulation, hit, flagged=kind is RING)


@pytest.mark.parametrize("kind", [FOUR, RING], ids=["four rings", "ring"])
@pytest.mark.parametrize(("radius_px", "grey"), [(6.0, 20.0), (6.0, 250.0), (10.0, 100.0)])
def test_dirt_on_an_edge(kind: TargetKind, radius_px: float, grey: float) -> None:
    scene, _ = photographed(kind)
    scene = replace(scene, occluders=(spot(scene, 5, radius_px, grey),))
    simulation = simulate(scene, np.random.default_rng(2))
    found = map_photograph(simulation.image, CAMERA, scene.pattern, PoseGuess(scene.camera_from_dish))
    assert_nothing_is_invented(found, simulation, 5)


@pytest.mark.parametrize("grey", [20.0, 250.0])
def test_a_small_spot_is_left_out_and_costs_little(grey: float) -> None:
    """The pixels of the spot are no part of the fit: what is left of the target is right, and nearly as sure as its neighbours."""
    scene, _ = photographed(FOUR)
    scene = replace(scene, occluders=(spot(scene, 5, 3.0, grey),))
    simulation = simulate(scene, np.random.default_rng(2))
    found = map_photograph(simulation.image, CAMERA, scene.pattern, PoseGuess(scene.camera_from_dish))
    hit = int(np.flatnonzero(found.cloud.ids == 5)[0])
    sigma_mm = np.sqrt(found.cloud.covariance_mm2[:, 2, 2])
    assert found.cloud.quality[hit] & (Quality.OCCLUDED | Quality.GLARE)
    assert abs(errors(found, simulation)[1][hit]) < LIE_SIGMAS
    assert sigma_mm[hit] < 4 * np.median(sigma_mm)
    error_px = np.linalg.norm(found.cloud.center_px[hit] - simulation.truth.center_px[5])
    # one of eight edges lost a tenth of its length
    assert error_px < 0.008


@pytest.mark.parametrize("kind", [FOUR, RING], ids=["four rings", "ring"])
@pytest.mark.parametrize(("sigma_px", "peak_grey"), [(4.0, 80.0), (10.0, 300.0), (20.0, 200.0), (40.0, 60.0)])
def test_glare_over_a_target(kind: TargetKind, sigma_px: float, peak_grey: float) -> None:
    scene, _ = photographed(kind)
    u, v = pixel_of(scene, 5)
    glare = Glare((u + 1.8 * kind.extent_mm, v), sigma_px, peak_grey)
    scene = replace(scene, light=replace(scene.light, glare=(glare,)))
    simulation = simulate(scene, np.random.default_rng(2))
    found = map_photograph(simulation.image, CAMERA, scene.pattern, PoseGuess(scene.camera_from_dish))
    # wide and weak glare is shading, which the fit follows
    assert_nothing_is_invented(found, simulation, 5, flagged=sigma_px < 40)


def test_a_target_over_the_border_is_rejected_or_missing() -> None:
    scene, _ = photographed(FOUR)
    moved = Pose(scene.camera_from_dish.rotation, scene.camera_from_dish.translation_mm + np.array([42.0, 0.0, 0.0]))
    scene = replace(scene, camera_from_dish=moved)
    simulation = simulate(scene, np.random.default_rng(2))
    found = map_photograph(simulation.image, CAMERA, scene.pattern, Upright())
    clipped = set(simulation.truth.ids[simulation.truth.visible_fraction < 0.999].tolist())
    assert clipped
    assert clipped == {i for i, _ in found.rejected if i is not None} | set(found.missing)
    assert all("beyond the image" in reason for i, reason in found.rejected if i is not None)


def test_correlated_noise_is_seen_and_white_noise_is_not_suspected() -> None:
    scene, simulation, found = plain()
    assert found.poses.noise_model.inflation < WHITE  # type: ignore[union-attr]
    packed = cv2.imencode(".jpg", simulation.image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    image = np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE))
    joined = map_photograph(image, CAMERA, scene.pattern, Upright())
    assert joined.poses.noise_model.inflation > JOINED  # type: ignore[union-attr]
    # the variance of what was measured grows with that of the pixels, and with the inflation on top
    pixels = np.median((joined.poses.noise / found.poses.noise) ** 2)  # type: ignore[union-attr]
    growth = np.median(joined.cloud.covariance_px2[:, 0, 0] / found.cloud.covariance_px2[:, 0, 0])
    assert growth / pixels == pytest.approx(joined.poses.noise_model.inflation, rel=0.1)  # type: ignore[union-attr]
    assert (np.abs(errors(joined, simulation)[1]) < LIE_SIGMAS).all()


def test_sixteen_bits_and_eight_say_the_same() -> None:
    scene, simulation, found = plain()
    words = map_photograph(simulation.image.astype(np.uint16) * 257, CAMERA, scene.pattern, Upright())
    np.testing.assert_allclose(words.cloud.position_mm, found.cloud.position_mm, atol=0.01)


def test_the_same_photograph_gives_the_same_numbers() -> None:
    scene, simulation, found = plain()
    again = map_photograph(simulation.image, CAMERA, scene.pattern, Upright())
    np.testing.assert_array_equal(again.cloud.position_mm, found.cloud.position_mm)
    np.testing.assert_array_equal(again.cloud.covariance_mm2, found.cloud.covariance_mm2)


def test_the_image_is_not_changed() -> None:
    scene, simulation, _ = plain()
    before = simulation.image.copy()
    map_photograph(simulation.image, CAMERA, scene.pattern, Upright())
    np.testing.assert_array_equal(simulation.image, before)


def test_wrong_input_is_refused_in_words() -> None:
    scene, simulation, _ = plain()
    image, pattern = simulation.image, scene.pattern
    with pytest.raises(InputError, match="unknown method 'poses'; use one of pose, paper"):
        map_photograph(image, CAMERA, pattern, Upright(), method="poses")
    with pytest.raises(CameraError, match="the photograph is 520x419 px but the camera was calibrated at 520x420 px"):
        map_photograph(image[1:], CAMERA, pattern, Upright())
    with pytest.raises(ImageError, match="one grey picture"):
        map_photograph(np.stack([image] * 3, axis=-1), CAMERA, pattern, Upright())
    with pytest.raises(ImageError, match="NaN"):
        map_photograph(np.full(image.shape, np.nan), CAMERA, pattern, Upright())
    with pytest.raises(IdentityError):
        map_photograph(np.full_like(image, 128), CAMERA, pattern, Upright())


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_upright_follows_the_turn_that_viewers_make(quarters: int) -> None:
    """A picture is stored turned to the left, and viewers turn it back to the right: names are those of the picture as it is shown."""
    camera, pattern = Camera(480, 480, [600.0, 600.0], [239.5, 239.5]), plate(3, 4, 40.0)
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([5.0, -3.0, 350.0]))
    shown = simulate(Scene(pattern, camera, pose), np.random.default_rng(0)).image
    upright = map_photograph(shown, camera, pattern, Upright()).poses
    stored = map_photograph(np.ascontiguousarray(np.rot90(shown, quarters)), camera, pattern, Upright(90.0 * quarters)).poses
    assert stored.ids.tolist() == upright.ids.tolist()
    u, v = (upright.center_px - 239.5).T
    for _ in range(quarters):
        u, v = v, -u
    assert stored.center_px == pytest.approx(np.column_stack([u, v]) + 239.5, abs=0.02)
