"""What docs/conventions.md says of axes, signs, pixels and flags is what the program does."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from dishmap.camera.model import Camera
from dishmap.quality import MEANING, REJECTED, Quality, names
from dishmap.simulate.deform import Deformation, ZernikeTerm
from dishmap.simulate.render import render_light
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.simulate.truth import truth_of
from dishmap.surface.zernike import term_name, zernike_terms, zernike_xy
from dishmap.targets.builders import disc, dish, plate
from dishmap.targets.pattern import Surface
from dishmap.transforms import Pose

PAGE = Path(__file__).resolve().parents[1] / "docs" / "conventions.md"

CAMERA = Camera(200, 160, np.array([500.0, 400.0]), np.array([90.0, 70.0]))
UPRIGHT = facing_pose(1000.0)

# Light is summed over pixels exactly; what is left is the float32 image (1e-7 of 190 grey, summed over 5,000 pixels).
CENTROID_TOLERANCE_PX = 1e-4
# Half a pixel is the size of the mistake that this guards against.
HALF_PIXEL = 0.5
# Exact up to rounding of numbers near 1000.
ROUNDING = 1e-9


def table_rows(heading: str) -> Iterator[list[str]]:
    """Rows of the first table under a heading of the page, without its header, cells stripped of backquotes."""
    text = PAGE.read_text(encoding="utf-8").split(f"{heading}\n", 1)[1]
    lines = [line for line in text.split("\n#", 1)[0].splitlines() if line.startswith("|")]
    for line in lines[2:]:
        yield [cell.strip().strip("`") for cell in line.replace("\\|", "&#124;").strip("|").split("|")]


def disc_centroid(at_px: tuple[float, float]) -> np.ndarray:
    """Centroid (u, v) of the darkness of a simulated disc that faces the camera and is centred at a pixel position."""
    depth_mm = 1000.0
    x, y = (np.array(at_px) - CAMERA.principal_px) / CAMERA.focal_px * depth_mm
    pose = Pose(UPRIGHT.rotation, np.array([x, y, depth_mm]))
    # ground over the whole image, so that nothing but the disc is dark
    scene = Scene(plate(1, 1, 100.0, disc(20.0), "disc"), CAMERA, pose, margin_mm=1000.0, sensor=Sensor(psf_sigma_px=0.8))
    darkness = scene.light.ground_grey - render_light(scene)[0].astype(float)
    v, u = np.indices(darkness.shape)
    return np.array([(u * darkness).sum(), (v * darkness).sum()]) / darkness.sum()


@pytest.mark.parametrize("at_px", [(100.0, 80.0), (100.5, 79.5), (61.25, 93.125)])
def test_pixel_zero_is_the_centre_of_the_first_pixel(at_px: tuple[float, float]) -> None:
    error = np.abs(disc_centroid(at_px) - at_px).max()
    assert error < CENTROID_TOLERANCE_PX < HALF_PIXEL


def test_the_image_reaches_half_a_pixel_beyond_its_outer_pixel_centres() -> None:
    inside = CAMERA.contains([[-0.5, -0.5], [199.5, 159.5], [-0.51, 0], [0, -0.51], [199.51, 0], [0, 159.51]])
    assert inside.tolist() == [True, True, False, False, False, False]


def test_camera_axes_are_opencv_s() -> None:
    right, down, behind = [10.0, 0.0, 1000.0], [0.0, 10.0, 1000.0], [0.0, 0.0, -1000.0]
    pixels = CAMERA.project([right, down, behind])
    np.testing.assert_allclose(pixels[:2], [[95.0, 70.0], [90.0, 74.0]], atol=ROUNDING)
    assert np.isnan(pixels[2]).all()
    points = np.array([[12.0, -34.0, 500.0], right, down])
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA.matrix, np.zeros(5))[0][:, 0]
    np.testing.assert_allclose(CAMERA.project(points), theirs, atol=ROUNDING)


def test_a_pose_is_named_outer_from_inner() -> None:
    camera_from_dish = Pose.from_rotation_vector([0.0, 0.0, np.pi / 2], [0.0, 0.0, 1000.0])
    # a quarter turn about z takes the dish's x axis to the camera's y axis
    np.testing.assert_allclose(camera_from_dish.apply([1.0, 0.0, 0.0]), [0.0, 1.0, 1000.0], atol=ROUNDING)
    dish_from_target = Pose(np.eye(3), np.array([5.0, 0.0, 0.0]))
    np.testing.assert_allclose((camera_from_dish @ dish_from_target).apply([0.0, 0.0, 0.0]), [0.0, 5.0, 1000.0], atol=ROUNDING)


def test_upright_has_the_pattern_s_x_to_the_right_and_y_up() -> None:
    pattern = plate(2, 2, 100.0)
    pixels = CAMERA.project(UPRIGHT.apply(pattern.center_mm))
    assert np.all(np.sign(pixels[:, 0] - CAMERA.principal_px[0]) == np.sign(pattern.center_mm[:, 0]))
    assert np.all(np.sign(pixels[:, 1] - CAMERA.principal_px[1]) == -np.sign(pattern.center_mm[:, 1]))


def test_the_dish_opens_towards_z_and_normals_point_to_the_focus_s_side() -> None:
    pattern = dish(600.0, 300.0)
    rho2 = (pattern.center_mm[:, :2] ** 2).sum(axis=1)
    np.testing.assert_allclose(pattern.center_mm[:, 2], rho2 / 1200.0, atol=ROUNDING)
    to_focus = np.array([0.0, 0.0, 300.0]) - pattern.center_mm
    # a paraboloid's normal halves the angle between the axis and the line to the focus
    halfway = to_focus / np.linalg.norm(to_focus, axis=1, keepdims=True) + [0.0, 0.0, 1.0]
    np.testing.assert_allclose(pattern.normal, halfway / np.linalg.norm(halfway, axis=1, keepdims=True), atol=ROUNDING)


def test_y_axis_of_a_target_is_normal_cross_x_axis() -> None:
    axes = dish(600.0, 300.0).axes
    np.testing.assert_allclose(np.cross(axes[..., 2], axes[..., 0]), axes[..., 1], atol=ROUNDING)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=ROUNDING)


def test_displacement_is_positive_towards_the_camera_and_normals_face_it() -> None:
    size_mm = 0.5
    pattern = dish(600.0, 300.0)
    nominal = Scene(pattern, CAMERA, UPRIGHT)
    lifted = nominal.with_state(Deformation(zernike=(ZernikeTerm(0, 0, size_mm),)))
    before, after = (truth_of(scene, np.ones(len(pattern))) for scene in (nominal, lifted))
    np.testing.assert_allclose(after.displacement_mm, size_mm, atol=ROUNDING)
    # the vertex target moves along its normal, which is the line of sight, by that much: nearer
    vertex = int(np.argmin((pattern.center_mm**2).sum(axis=1)))
    np.testing.assert_allclose(after.center_mm[vertex, 2] - before.center_mm[vertex, 2], -size_mm, atol=1e-6)
    assert (before.normal[:, 2] < 0).all()


def test_truth_of_other_people_s_renders_has_our_signs(shared_data: Path) -> None:
    with (shared_data / "dish" / "truth.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    states = {name: [row for row in rows if row["image"] == name] for name in ("ref.png", "cur_defocus_1.0.png")}
    reference, current = (np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in state]) for state in states.values())
    normal = np.array([[float(row[axis]) for axis in ("nx", "ny", "nz")] for row in states["ref.png"]])
    displacement = np.array([float(row["displacement_mm"]) for row in states["cur_defocus_1.0.png"]])
    assert (normal[:, 2] < 0).all()
    along = ((current - reference) * normal).sum(axis=1)
    # material also slides along the surface, whose normal turns by some mrad: 0.02 mm; a wrong sign would be off by 2 mm
    assert np.abs(along - displacement).max() < 0.02 < np.abs(along + displacement).max()


def test_zernike_terms_are_one_at_the_rim_cosine_for_positive_m() -> None:
    for n, m in zernike_terms(6):
        best = 0.0 if m >= 0 else np.pi / (2 * abs(m))
        assert abs(zernike_xy(n, m, np.cos(best), np.sin(best)) - 1) < ROUNDING, (n, m)
    assert zernike_xy(2, 0, 0.0, 0.0) == pytest.approx(-1.0)
    assert zernike_xy(1, 1, 0.5, 0.3) == pytest.approx(0.5)
    assert zernike_xy(1, -1, 0.5, 0.3) == pytest.approx(0.3)
    assert zernike_xy(2, -2, 0.5, 0.3) == pytest.approx(2 * 0.5 * 0.3)


def test_the_page_names_zernike_terms_as_the_program_does() -> None:
    page = PAGE.read_text(encoding="utf-8")
    terms = {"piston": (0, 0), "tip": (1, 1), "tilt": (1, -1), "defocus": (2, 0), "astigmatism_cos": (2, 2), "coma_sin": (3, -1)}
    for name, (n, m) in {**terms, "trefoil_cos": (3, 3)}.items():
        assert term_name(n, m) == name
        assert f"`{name}`" in page


def test_the_page_lists_the_quality_flags_as_the_program_has_them() -> None:
    listed = {row[0]: (row[1], row[2] == "rejected") for row in table_rows("## Quality flags")}
    expected = {names(flag): (meaning, bool(flag & REJECTED)) for flag, meaning in MEANING.items()}
    assert listed == expected
    assert set(MEANING) == {flag for flag in Quality if flag}


def test_surface_height_and_normal_agree() -> None:
    surface, xy, step = Surface("paraboloid", 600.0, 300.0), np.array([120.0, -80.0]), 1e-3
    slope = [(surface.height_mm(xy + step * axis) - surface.height_mm(xy - step * axis)) / (2 * step) for axis in np.eye(2)]
    normal = surface.normal(xy)
    np.testing.assert_allclose(-normal[:2] / normal[2], slope, atol=ROUNDING)
