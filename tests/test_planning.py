"""What a plan predicts, against simulated photographs, closed forms and limits; what it refuses.

Predictions stand beside errors against the truth of photographs whose prints stray from the nominal surface as the plan assumes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CLEAR, WIDE, Measured, measured

from dishmap.camera.model import Camera
from dishmap.difference.difference_map import joint_difference
from dishmap.difference.model import smooth_kernel, surfaces_of
from dishmap.errors import CameraError, InputError
from dishmap.pipeline import cloud_of
from dishmap.planning import Conditions, camera_of_lens, narrowest_mm, plan, print_bend_mm
from dishmap.planning_verdict import plan_verdict
from dishmap.quality import Quality
from dishmap.simulate.deform import Deformation, ZernikeTerm
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.surface.cloud import calibration_covariance_mm2
from dishmap.targets.bound import edge_sigma_px
from dishmap.targets.builders import concentric, disc, dish, multi_circular, plate, ring
from dishmap.targets.pattern import Pattern, Polygon, TargetKind
from dishmap.targets.stages import Assumptions
from dishmap.transforms import Pose, angle_between_rad, rotation_from_vector

Array = NDArray[np.float64]

# What the project asks of a prediction.
PREDICTED_PART = 0.2
# So many targets are measured for each figure: their rms error is known to 1 / sqrt(2 * 100) = 7 %, a third of that.
MEASURED_TARGETS = 100
# Pairs of photographs for a shape: some ten independent numbers each, 8 %.
PAIRS = 8
STRAY_DEG = 0.1
# The closed forms know the light and the blur: of the centre's information these take a little, of the size's more.
CLOSED_CENTER_PART, CLOSED_DEPTH_PART = 0.12, 0.2
KNOWN = Assumptions(ink_spread_fraction=1e-6, tone_shift_px=1e-6, normal_sigma_deg=0.02)
CAMERA = Camera(640, 480, [1500.0, 1500.0], [319.5, 239.5])
PLATE = plate(4, 5, 40.0)


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def strayed(pattern: Pattern, sigma_deg: float, rng: np.random.Generator) -> Pattern:
    """The pattern with each print tilted on its own."""
    tilt = np.zeros((len(pattern), 3))
    tilt[:, :2] = np.radians(sigma_deg) * rng.standard_normal((len(pattern), 2))
    axes = pattern.axes @ rotation_from_vector(tilt)
    return replace(pattern, x_axis=axes[..., 0], normal=axes[..., 2])


def photographed(scene: Scene, given: Conditions, nominal: Pattern, rng: np.random.Generator) -> Measured:
    noise = (CLEAR.ground_grey - CLEAR.ink_grey) / given.contrast_to_noise
    scene = replace(scene, light=CLEAR, sensor=Sensor(given.psf_sigma_px, noise_grey=noise, bits=16))
    return measured(scene, rng, given.assumptions, nominal=nominal)


@pytest.mark.parametrize(
    ("pattern", "camera", "distance_mm", "tilt_deg", "contrast", "psf_px"),
    [
        (PLATE, CAMERA, 650.0, 0.0, 40.0, 0.8),
        (plate(4, 5, 40.0, ring(8.0, 4.8)), CAMERA, 650.0, 25.0, 75.0, 1.2),
        (plate(4, 5, 40.0, concentric((9.0, 5.0))), WIDE, 200.0, 30.0, 40.0, 0.7),
        (dish(160.0, 80.0, 30.0, multi_circular(4, 3.5, 2.0, 9.0)), CAMERA, 600.0, 10.0, 60.0, 0.8),
    ],
    ids=["four rings, face on", "rings, tilted", "concentric, wide lens", "dish"],
)
def test_errors_of_photographs_are_as_predicted(
    pattern: Pattern, camera: Camera, distance_mm: float, tilt_deg: float, contrast: float, psf_px: float
) -> None:
    """Position, depth and normal; the prior on normals is given to plan and measurement, and true of the prints."""
    given = Conditions(contrast, psf_px, assumptions=Assumptions(normal_sigma_deg=STRAY_DEG))
    pose = facing_pose(distance_mm, np.radians(tilt_deg), 0.5)
    made = plan(camera, pattern, pose, given)
    assert len(made.cloud) == len(pattern)
    assert not made.lost
    depth, normal, center = [], [], []
    for seed in range(-(-MEASURED_TARGETS // len(pattern))):
        rng = np.random.default_rng([1, seed])
        found = photographed(Scene(strayed(pattern, STRAY_DEG, rng), camera, pose), given, pattern, rng)
        depth.append(found.position_error_mm[:, 2])
        normal.append(angle_between_rad(found.poses.normal, found.true_normal))
        center.append(found.center_error_px)
    assert rms(made.sigma_depth_mm) == pytest.approx(rms(np.concatenate(depth)), rel=PREDICTED_PART)
    assert rms(made.cloud.sigma_normal_rad) == pytest.approx(rms(np.concatenate(normal)), rel=PREDICTED_PART)
    assert rms(made.sigma_px) == pytest.approx(rms(np.concatenate(center)), rel=PREDICTED_PART)


@pytest.mark.parametrize(("amplitude_mm", "tilt_deg"), [(0.05, 15.0), (0.01, 0.0)], ids=["tilts show", "tilts hardly show"])
def test_errors_with_a_learnt_prior_on_normals_are_as_predicted(amplitude_mm: float, tilt_deg: float) -> None:
    """The surface strays by the slope of the plan's smoothness; what a map claims then is wider where tilts hardly show."""
    length_mm = 40.0
    given = Conditions(40.0, 0.8, amplitude_mm, length_mm)
    pose = facing_pose(650.0, np.radians(tilt_deg), 0.5)
    made = plan(CAMERA, PLATE, pose, given)
    slope_deg = np.degrees(np.sqrt(5 / 3) * amplitude_mm / length_mm)
    rng = np.random.default_rng(3)
    found = [photographed(Scene(strayed(PLATE, slope_deg, rng), CAMERA, pose), given, PLATE, rng) for _ in range(5)]
    depth = rms(np.concatenate([f.position_error_mm[:, 2] for f in found]))
    normal = rms(np.concatenate([angle_between_rad(f.poses.normal, f.true_normal) for f in found]))
    claimed = rms(np.concatenate([f.poses.sigma_normal_rad for f in found]))
    assert rms(made.sigma_depth_mm) == pytest.approx(depth, rel=PREDICTED_PART)
    assert rms(made.cloud.sigma_normal_rad) == pytest.approx(normal, rel=PREDICTED_PART)
    assert rms(made.cloud.sigma_normal_rad) < 1.1 * claimed
    # 40 tilts teach the spread to 1 / sqrt(2 * 40) = 11 % in each of five photographs
    assert made.normal_sigma_rad == pytest.approx(np.mean([f.poses.normal_sigma_rad for f in found]), rel=0.15)


def test_the_error_of_a_change_of_shape_is_as_predicted() -> None:
    """Pairs of photographs of a dish that moves by the plan's own random field, drawn as Zernike terms, and of a camera that shifts."""
    # the plan takes the sizes of the field as known; from twice the targets that a field needs they are learnt nearly as well
    pattern = dish(200.0, 100.0, 28.0, ring(6.0, 3.6))
    given = Conditions(60.0, 0.8, 0.05, 100.0)
    pose = facing_pose(700.0, np.radians(10.0), 0.5)
    made = plan(CAMERA, pattern, pose, given)
    # as many terms as 30 targets could show: beyond degree 6 such a field has nothing
    surfaces = surfaces_of(pattern, np.arange(30) % len(pattern))
    root = given.amplitude_mm * smooth_kernel(surfaces, made.length_mm).root
    scene = Scene(pattern, CAMERA, pose)
    errors = []
    for seed in range(PAIRS):
        rng = np.random.default_rng([2, seed])
        size = root @ rng.standard_normal(root.shape[1])
        terms = tuple(ZernikeTerm(n, m, float(s)) for (n, m), s in zip(surfaces.fields.normal_terms, size, strict=True))
        later = Pose.from_rotation_vector(rng.normal(0, 2e-4, 3), rng.normal(0, 0.05, 3)) @ pose
        bent = replace(scene, deformation=Deformation(zernike=terms), camera_from_dish=later)
        before, after = (photographed(one, given, pattern, rng) for one in (scene, bent))
        found = joint_difference(before.poses, after.poses, CAMERA, pattern)
        assert len(found) == len(pattern)
        errors.append(found.shape_mm - shape_of(pose.inverse().apply(after.truth.center_mm), pattern))
    assert rms(made.shape_mm) == pytest.approx(rms(np.concatenate(errors)), rel=PREDICTED_PART)


def shape_of(now_mm: Array, pattern: Pattern) -> Array:
    """Displacement along the normals of targets now at (N, 3), their best rigid motion (Kabsch) taken out."""
    points = pattern.center_mm
    a, b = points.mean(axis=0), now_mm.mean(axis=0)
    u, _, vt = np.linalg.svd((points - a).T @ (now_mm - b))
    turn = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    return np.asarray((((now_mm - b) @ turn + a - points) * pattern.normal).sum(axis=1))


def test_closed_forms_of_the_design_page() -> None:
    """Centre and depth of four rings seen face on, all else known: docs/design.md, The physical limit."""
    kind, distance, contrast, psf = multi_circular(), 500.0, 50.0, 0.8
    made = plan(CAMERA, plate(1, 1, 40.0, kind), facing_pose(distance), Conditions(contrast, psf, assumptions=KNOWN))
    px = CAMERA.focal_px[0] / distance
    radius, aside = kind.radius_mm * px, np.linalg.norm(kind.center_mm, axis=1) * px
    edge = edge_sigma_px(float(np.hypot(psf, 12**-0.5)), contrast)
    assert made.sigma_px[0] == pytest.approx(edge / np.sqrt(np.pi * radius.sum()), rel=CLOSED_CENTER_PART)
    assert made.sigma_px[0] > 0.99 * edge / np.sqrt(np.pi * radius.sum())
    size = edge / np.sqrt(np.pi * (2 * radius**3 + radius * aside**2).sum())
    assert made.sigma_depth_mm[0] == pytest.approx(distance * size, rel=CLOSED_DEPTH_PART)
    # across the line of sight a pixel is distance over focal length
    assert made.sigma_across_mm[0] == pytest.approx(made.sigma_px[0] / px, rel=0.01)
    # one target shows no change of shape
    assert np.isnan(made.shape_mm).all()
    assert np.isnan(made.displacement_mm).all()


def test_sigmas_grow_with_noise_and_distance() -> None:
    given = Conditions(40.0, 0.8, assumptions=KNOWN)
    one, quiet = (plan(CAMERA, PLATE, facing_pose(650.0), replace(given, contrast_to_noise=c)) for c in (40.0, 120.0))
    np.testing.assert_allclose(one.sigma_px / quiet.sigma_px, 3.0, rtol=0.01)
    # seen face on, as the middle ones nearly are, depth does not hang on the tilt, whose prior stays as it is
    np.testing.assert_allclose((one.sigma_depth_mm / quiet.sigma_depth_mm).max(), 3.0, rtol=0.02)
    far = plan(CAMERA, PLATE, facing_pose(900.0), given)
    assert (far.sigma_depth_mm > one.sigma_depth_mm).all()
    assert np.median(far.shape_mm) > np.median(one.shape_mm)
    # circles keep their proportions: half the size at half the distance is the same picture, and half the sigma
    small = plan(CAMERA, plate(4, 5, 20.0, multi_circular(4, 2.5, 1.5, 7.0)), facing_pose(325.0), given)
    np.testing.assert_allclose(small.sigma_px, one.sigma_px, rtol=0.01)
    np.testing.assert_allclose(small.sigma_depth_mm, one.sigma_depth_mm / 2, rtol=0.01)


def test_a_change_too_small_to_be_seen_is_known_no_better_than_stated() -> None:
    tiny, large = (plan(CAMERA, PLATE, facing_pose(650.0), Conditions(40.0, 0.8, amplitude)) for amplitude in (1e-5, 1.0))
    # the prior alone: the field's variance, less the rigid motion that is taken out of it
    assert 0.3e-5 < np.median(tiny.shape_mm) < 1e-5
    assert np.median(large.shape_mm) < 0.05


def test_a_lone_disc_is_said_to_rest_on_its_ink() -> None:
    made = plan(CAMERA, plate(4, 5, 40.0, disc(8.0)), facing_pose(650.0), Conditions(80.0))
    assert (made.cloud.quality & Quality.WEAK_DEPTH).all()
    radius_px = 8.0 * CAMERA.focal_px[0] / 650.0
    assert np.median(made.sigma_depth_mm) == pytest.approx(650.0 * np.hypot(0.02, 0.3 / radius_px), rel=0.1)
    assert not plan(CAMERA, PLATE, facing_pose(650.0)).cloud.quality.any()


def test_the_calibrations_part_is_that_of_the_measurement() -> None:
    covariance = np.diag([1.0, 1.0, 4.0, 4.0])
    covariance[0, 1] = covariance[1, 0] = 1.0
    camera = replace(CAMERA, covariance=covariance)
    pose = facing_pose(650.0, 0.2, 0.5)
    given = Conditions(80.0, assumptions=Assumptions(normal_sigma_deg=STRAY_DEG))
    made = plan(camera, PLATE, pose, given)
    found = photographed(Scene(PLATE, camera, pose), given, PLATE, np.random.default_rng(4)).poses
    mine = np.sqrt(calibration_covariance_mm2(made.cloud, covariance)[:, 2, 2])
    theirs = np.sqrt(calibration_covariance_mm2(cloud_of(found), covariance)[:, 2, 2])
    np.testing.assert_allclose(mine, theirs, rtol=0.05)
    # a focal length that is a pixel in 1500 too long puts all of it that much too far
    assert np.median(mine) > 0.9 * 650.0 / 1500.0


def test_targets_that_cannot_be_measured_are_named() -> None:
    pattern = dish(600.0, 300.0, 60.0)
    made = plan(camera_of_lens(1600, 1200, 75.0), pattern, facing_pose(400.0))
    lost = dict(made.lost)
    assert set(lost.values()) == {"not wholly in the picture"}
    assert set(lost) | set(made.cloud.ids.tolist()) == set(pattern.ids.tolist())
    # the outermost are lost, none of the innermost
    reach = np.linalg.norm(pattern.center_mm[:, :2], axis=1)
    is_lost = np.isin(pattern.ids, list(lost))
    assert reach[is_lost].min() > 0.4 * reach.max()
    assert is_lost[reach == reach.max()].any()
    # seen from aside, the near rim stands before the targets behind it
    aside = plan(camera_of_lens(1600, 1200, 75.0), dish(600.0, 150.0, 60.0), facing_pose(900.0, np.radians(70.0)))
    assert "printed side hidden from the camera" in dict(aside.lost).values()


def test_prints_bend_with_the_surface() -> None:
    """Mean height of a ring's edges above its tangent plane over random curvatures, E[kx ky] = E[kx^2] / 3 as in any isotropic field."""
    kind, amplitude, length = ring(6.0, 3.0), 0.1, 50.0
    rng = np.random.default_rng(6)
    curvature = rng.standard_normal((20_000, 2)) @ np.linalg.cholesky([[1.0, 1 / 3], [1 / 3, 1.0]]).T * 5 * amplitude / length**2
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    square = np.stack([np.cos(angle) ** 2, np.sin(angle) ** 2])
    height = sum(r * r * r * 0.5 * (curvature @ square).mean(axis=1) for r in kind.radius_mm) / kind.radius_mm.sum()
    assert print_bend_mm(kind, amplitude, length) == pytest.approx(np.std(height), rel=0.02)
    made = plan(CAMERA, PLATE, facing_pose(650.0, np.radians(45.0)), Conditions(150.0, 0.8, 0.2, 60.0))
    assert any("bends the prints themselves" in warning for warning in plan_verdict(made).warnings)


def test_narrowest_strokes() -> None:
    assert narrowest_mm(disc(5.0)) == pytest.approx(10.0)
    assert narrowest_mm(ring(5.0, 3.0)) == pytest.approx(2.0)
    assert narrowest_mm(ring(5.0, 0.5)) == pytest.approx(1.0)
    # rings of 5 mm on a square of 10.5 mm leave half a millimetre between them
    assert narrowest_mm(multi_circular(4, 5.0, 3.0, 10.5)) == pytest.approx(0.5)


def test_a_lens_by_its_field_of_view() -> None:
    camera = camera_of_lens(4608, 3456, 75.0)
    edge = np.tan(np.radians(37.5))
    np.testing.assert_allclose(camera.project([[edge, 0.0, 1.0], [-edge, 0.0, 1.0]])[:, 0], [4607.5, -0.5], atol=1e-9)
    np.testing.assert_allclose(camera.principal_px, [2303.5, 1727.5])


@pytest.mark.parametrize(
    ("distance_mm", "tilt_deg", "words"),
    [
        (1.0, 0.0, "not wholly in the picture.*is the distance really in mm"),
        (100.0, 0.0, "not wholly in the picture.*go farther away, use a wider lens"),
        (1e6, 0.0, "too small to be found.*go nearer, use a longer lens"),
        (700.0, 180.0, "printed side hidden.*on the side of the dish's focus"),
        (-700.0, 0.0, "not wholly in the picture"),
    ],
)
def test_nothing_to_be_measured(distance_mm: float, tilt_deg: float, words: str) -> None:
    with pytest.raises(InputError, match=words):
        plan(camera_of_lens(640, 480, 50.0), plate(4, 5, 60.0), facing_pose(distance_mm, np.radians(tilt_deg)))


@pytest.mark.parametrize("fov_deg", [0.0, -10.0, 151.0, 180.0, 400.0, np.nan])
def test_impossible_lenses(fov_deg: float) -> None:
    with pytest.raises(CameraError, match=r"a field of view of .* degrees is no pinhole's; give one of up to 150 degrees"):
        camera_of_lens(640, 480, fov_deg)


def test_a_sensor_of_no_pixels() -> None:
    with pytest.raises(CameraError, match="image size must be positive, not 0x0"):
        camera_of_lens(0, 0, 75.0)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"contrast_to_noise": 0.0}, "a contrast of 0 times the noise shows no targets"),
        ({"contrast_to_noise": np.nan}, "shows no targets"),
        ({"psf_sigma_px": 0.0}, "the blur must lie between 0.1 and 20.0 px"),
        ({"psf_sigma_px": 100.0}, "the blur must lie between"),
        ({"amplitude_mm": 0.0}, "amplitude and length of a smooth surface must be positive"),
        ({"length_mm": -1.0}, "amplitude and length of a smooth surface must be positive"),
    ],
)
def test_impossible_conditions(numbers: dict[str, float], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Conditions(**numbers)  # type: ignore[arg-type]


def test_grids_are_refused() -> None:
    square = TargetKind(np.zeros((0, 2)), np.zeros(0), np.zeros(0, bool), (Polygon(np.array([[-2.0, -2], [2, -2], [2, 2], [-2, 2]])),))
    line = plate(1, 2, 12.0, disc(2.0))
    grid = replace(line, kinds=dict.fromkeys(line.kinds, square), lattice=np.array([[0, 0], [1, 0]]))
    with pytest.raises(InputError, match="a grid of squares or lines cannot be planned"):
        plan(CAMERA, grid, facing_pose(650.0))


def test_an_unknown_way_of_following() -> None:
    with pytest.raises(InputError, match="unknown slide 'sideways'"):
        plan(CAMERA, PLATE, facing_pose(650.0), Conditions(slide="sideways"))
