"""Grids in simulated photographs, against counting along rays with surfaces and ink by their equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from dishmap.camera.model import Camera
from dishmap.errors import InputError
from dishmap.simulate.deform import Bump, Deformation
from dishmap.simulate.render import render_light, simulate
from dishmap.simulate.scene import Disc, Glare, Light, LineGap, Scene, Sensor, facing_pose, random_line_gaps, spread_corners_mm
from dishmap.targets.grid_builders import grid
from dishmap.targets.pattern import Pattern, Polygon, Surface
from dishmap.transforms import Pose

Array = NDArray[np.float64]

CAMERA = Camera(640, 480, [520.0, 523.0], [321.2, 236.1], [-0.25, 0.08, 0.001, -0.0007, -0.01])
LIGHT = Light(ink_grey=0.0, ground_grey=200.0, background_grey=200.0)
PITCH_MM, LINE_MM, SQUARE_MM, RADIUS_MM = 12.0, 1.5, 8.0, 57.0
# Points counted per pixel and axis, and what that leaves of a blurred edge at most and in the mean: with 64 points a fifth.
FINE, COUNTED, COUNTED_RMS = 16, 1e-2, 8e-4
# Patches of pixels: around the middle, over a corner of the grid, and where the cylinder turns away
PATCH, CORNERS = 36, ((310, 230), (180, 180), (380, 225))
# No edge along a row of pixels: counting is poor there
TILTED = facing_pose(200.0, 0.5, 0.6) @ Pose.from_rotation_vector([0.0, 0.0, 0.45], [0.0, 0.0, 0.0])
# Single precision of coverage and light.
EXACT = 2e-6
BENT = Surface("cylinder", radius_mm=RADIUS_MM)


def scene_of(pattern: Pattern, pose: Pose | None = None, **changes: object) -> Scene:
    fields: dict = {"light": LIGHT, "sensor": Sensor(psf_sigma_px=0.8), **changes}
    return Scene(pattern, CAMERA, pose or TILTED, **fields)


def coverage(scene: Scene) -> Array:
    return 1 - render_light(scene)[0].astype(float) / 200.0


def flat_places(scene: Scene, u: Array, v: Array) -> Array:
    """Flat coordinates (..., 2) where rays through pixels meet the surface's front, by the equations of plane and cylinder."""
    rays = CAMERA.unproject(np.stack([u, v], axis=-1))
    to_dish = scene.camera_from_dish.inverse()
    eye, ray = to_dish.translation_mm, to_dish.rotate(rays)
    if scene.pattern.surface.kind == "plane":
        return (eye - ray * (eye[2] / ray[..., 2])[..., None])[..., :2]
    # x^2 + (z + R)^2 = R^2, the nearer of the two
    x, z, dx, dz = eye[0], eye[2] + RADIUS_MM, ray[..., 0], ray[..., 2]
    a, b, c = dx**2 + dz**2, x * dx + z * dz, x**2 + z**2 - RADIUS_MM**2
    with np.errstate(invalid="ignore"):
        step = (-b - np.sqrt(b**2 - a * c)) / a
    return np.stack([RADIUS_MM * np.arctan2(x + step * dx, z + step * dz), eye[1] + step * ray[..., 1]], axis=-1)


def counted(scene: Scene, ink, corner: tuple[int, int]) -> Array:
    """Coverage of a patch of pixels from `corner` (u, v), from points on rays: ink says which flat places (..., 2) are printed."""
    edge, size = 6, PATCH
    steps = (np.arange((size + 2 * edge) * FINE) + 0.5) / FINE - 0.5 - edge
    u, v = np.meshgrid(corner[0] + steps, corner[1] + steps)
    blurred = gaussian_filter(ink(flat_places(scene, u, v)).astype(float), scene.sensor.psf_sigma_px * FINE, truncate=6)
    return blurred.reshape(size + 2 * edge, FINE, -1, FINE).mean(axis=(1, 3))[edge:-edge, edge:-edge]


def difference(drawn: Array, scene: Scene, ink, corner: tuple[int, int]) -> tuple[float, float]:
    """Greatest and rms difference of a patch of the picture from counting."""
    expected = counted(scene, ink, corner)
    assert expected.max() > 0.5
    off = drawn[corner[1] : corner[1] + PATCH, corner[0] : corner[0] + PATCH] - expected
    return float(np.abs(off).max()), float(np.sqrt((off**2).mean()))


def lattice_ink(pattern: Pattern, columns: int, rows: int, width_mm: float = LINE_MM):
    """Whether flat places (..., 2) lie on whole lines or in marked cells' squares, in coordinates of the lattice."""
    assert pattern.lattice is not None
    marked = pattern.lattice[[name == "crossing-marked" for name in pattern.kind_names]]
    middle, half = np.array([columns - 1, rows - 1]) / 2, width_mm / 2 / PITCH_MM

    def ink(flat: Array) -> NDArray[np.bool_]:
        c, r = np.moveaxis(flat / PITCH_MM + middle, -1, 0)
        within = [(x > -0.5) & (x < n - 0.5) for x, n in ((c, columns), (r, rows))]
        near = [(np.abs(x - np.clip(np.rint(x), 0, n - 1)) < half) for x, n in ((c, columns), (r, rows))]
        out = (near[0] & within[1]) | (near[1] & within[0])
        for place in marked:
            out |= (np.abs(c - place[0] - 0.5) < 0.25) & (np.abs(r - place[1] - 0.5) < 0.25)
        return out

    return ink


@pytest.mark.parametrize("surface", [Surface(), BENT], ids=["plate", "cylinder"])
def test_lines_and_marks_equal_counting_along_rays(surface: Surface) -> None:
    pattern = grid(8, 6, PITCH_MM, line_width_mm=LINE_MM, surface=surface, orientation_marks=True)
    scene = scene_of(pattern)
    drawn = coverage(scene)
    # around the middle, over a corner of the grid, and where the cylinder turns away
    for corner in CORNERS:
        most, rms = difference(drawn, scene, lattice_ink(pattern, 8, 6), corner)
        assert most < COUNTED
        assert rms < COUNTED_RMS
    # lines wider by two hundredths of a millimetre would be noticed
    assert difference(drawn, scene, lattice_ink(pattern, 8, 6, LINE_MM + 0.02), CORNERS[0])[1] > COUNTED_RMS


def test_spread_ink_is_a_wider_line_and_a_larger_mark() -> None:
    pattern = grid(8, 6, PITCH_MM, line_width_mm=LINE_MM)
    wide = grid(8, 6, PITCH_MM, line_width_mm=LINE_MM + 0.2)
    wide = replace(wide, lines=[replace(line, overhang_mm=line.overhang_mm + 0.1) for line in wide.lines])
    assert np.abs(coverage(scene_of(pattern, ink_spread_mm=0.1)) - coverage(scene_of(wide))).max() < EXACT
    squares = [grid(8, 6, PITCH_MM, square_mm=side, orientation_marks=True) for side in (SQUARE_MM, SQUARE_MM + 0.2)]
    plain = [replace(one, kind_names=("square",) * 48) for one in squares]
    assert np.abs(coverage(scene_of(plain[0], ink_spread_mm=0.1)) - coverage(scene_of(plain[1]))).max() < EXACT
    # an open square's light middle shrinks
    inner = spread_corners_mm(Polygon([[0.0, 0], [0, 4], [4, 4], [4, 0]], dark=False), 0.1)
    assert np.array(sorted(inner.tolist())) == pytest.approx(np.array([[0.1, 0.1], [0.1, 3.9], [3.9, 0.1], [3.9, 3.9]]))


@pytest.mark.parametrize("surface", [Surface(), BENT], ids=["plate", "cylinder"])
def test_squares_equal_counting_along_rays(surface: Surface) -> None:
    pattern = grid(9, 6, PITCH_MM, square_mm=SQUARE_MM, surface=surface, orientation_marks=True)
    assert pattern.lattice is not None
    opened = {tuple(place) for place, name in zip(pattern.lattice.tolist(), pattern.kind_names, strict=True) if name == "square-open"}
    hole = np.array([[(c, r) in opened for r in range(6)] for c in range(9)])

    def ink(flat: Array) -> NDArray[np.bool_]:
        places = flat / PITCH_MM + np.array([4, 2.5])
        with np.errstate(invalid="ignore"):
            nearest = np.clip(np.nan_to_num(np.rint(places)), 0, [8, 5]).astype(int)
            off = PITCH_MM * np.abs(places - nearest).max(axis=-1)
            return (off < SQUARE_MM / 2) & ~(hole[nearest[..., 0], nearest[..., 1]] & (off < SQUARE_MM / 4))

    scene = scene_of(pattern)
    drawn = coverage(scene)
    for corner in CORNERS:
        most, rms = difference(drawn, scene, ink, corner)
        assert most < COUNTED
        assert rms < COUNTED_RMS


def test_crossing_lines_darken_once_and_join_without_a_seam() -> None:
    """Two lines as one outline: the union's area is that of both less their crossing, and nothing is darker than ink."""
    pattern = grid(2, 2, PITCH_MM, line_width_mm=LINE_MM)
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 200.0]))
    camera = Camera(300, 240, [1000.0, 1000.0], [150.3, 120.4])
    for spread in (0.0, 0.2):
        drawn = 1 - render_light(replace(scene_of(pattern, pose), camera=camera, ink_spread_mm=spread))[0].astype(float) / 200
        width, length = LINE_MM + 2 * spread, 2 * PITCH_MM + 2 * spread
        # 5 px a millimetre
        assert drawn.sum() == pytest.approx(25 * (4 * width * length - 4 * width**2), rel=1e-6)
        assert drawn.max() < 1 + EXACT


def test_lines_that_end_within_a_crossing_make_a_whole_corner() -> None:
    """Without overhang four lines end in the middle of their corner crossings: three quarters of each corner is ink."""
    pattern = grid(2, 2, PITCH_MM, line_width_mm=LINE_MM)
    pattern = replace(pattern, lines=[replace(line, overhang_mm=0.0) for line in pattern.lines])
    camera = Camera(300, 240, [1000.0, 1000.0], [150.3, 120.4])
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 200.0]))
    drawn = 1 - render_light(replace(scene_of(pattern, pose), camera=camera))[0].astype(float) / 200
    assert drawn.sum() == pytest.approx(25 * (4 * LINE_MM * PITCH_MM - 4 * (LINE_MM / 2) ** 2), rel=1e-6)
    assert drawn.min() > -EXACT


def test_gaps_are_ground() -> None:
    pattern = grid(5, 4, PITCH_MM, line_width_mm=LINE_MM)
    camera = Camera(500, 400, [1000.0, 1000.0], [250.3, 200.4])
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 200.0]))
    scene = replace(scene_of(pattern, pose), camera=camera)
    whole = coverage_of(scene)
    # between two crossings, over a crossing (where the other line stays), off the end, and two that overlap
    gaps = (LineGap(0, 1.25, 1.75), LineGap(1, 1.75, 2.25), LineGap(4, -2.0, -0.25), LineGap(2, 0.3, 0.6), LineGap(2, 0.5, 0.7))
    broken = coverage_of(replace(scene, line_gaps=gaps))
    missing = PITCH_MM * (0.5 + 0.5 + 0.25 + 0.4) - LINE_MM
    assert (whole - broken).sum() == pytest.approx(25 * LINE_MM * missing, rel=1e-5)
    assert (broken - whole).max() < EXACT
    # ink spreads into a gap from both sides
    spread = coverage_of(replace(scene, line_gaps=gaps[:1], ink_spread_mm=0.1))
    expected = 25 * (LINE_MM + 0.2) * (0.5 * PITCH_MM - 0.2)
    assert (coverage_of(replace(scene, ink_spread_mm=0.1)) - spread).sum() == pytest.approx(expected, rel=1e-5)


def coverage_of(scene: Scene) -> Array:
    return 1 - render_light(scene)[0].astype(float) / 200


def test_random_gaps_lie_between_crossings() -> None:
    pattern = grid(20, 15, PITCH_MM, line_width_mm=1.0)
    gaps = random_line_gaps(np.random.default_rng(4), pattern, 0.15)
    assert len(gaps) == round(0.15 * (15 * 19 + 20 * 14))
    assert all(np.floor(gap.start_t) == np.floor(gap.stop_t) and 0.2 <= gap.stop_t - gap.start_t <= 0.6 for gap in gaps)
    assert len({(gap.line, int(gap.start_t)) for gap in gaps}) == len(gaps)
    assert gaps == random_line_gaps(np.random.default_rng(4), pattern, 0.15)
    with pytest.raises(InputError, match="share from 0 to 1"):
        random_line_gaps(np.random.default_rng(4), pattern, 1.5)


def test_truth_of_crossings() -> None:
    pattern = grid(5, 4, PITCH_MM, line_width_mm=LINE_MM)
    camera = Camera(500, 400, [1000.0, 1000.0], [250.0, 200.0])
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 200.0]))
    scene = replace(scene_of(pattern, pose), camera=camera)
    truth = simulate(scene, np.random.default_rng(0)).truth
    assert truth.visible_fraction.tolist() == [1.0] * 20
    assert truth.center_mm == pytest.approx(pattern.center_mm * [1, -1, -1] + [0, 0, 200], abs=1e-9)
    assert truth.center_px[0] == pytest.approx([250 - 24 * 5, 200 - 18 * 5])
    # a quarter of the second crossing's ink is missing, the fourth is glared, the last one hidden
    hidden = replace(
        scene,
        line_gaps=(LineGap(0, 1.0, 1.5),),
        occluders=(Disc((250 + 120.0, 200 + 90.0), 35.0, 50.0),),
        light=replace(LIGHT, glare=(Glare((250 + 60.0, 200 - 90.0), 300.0, 400.0),)),
    )
    visible = render_light(hidden)[1].visible_fraction
    assert visible[3] == 0
    visible = render_light(replace(hidden, light=LIGHT))[1].visible_fraction
    assert visible[[1, 2]].tolist() == [0.75, 1.0]
    assert visible[19] == pytest.approx(0.0, abs=1e-6)
    # the picture's border through the left column: half of its rows' ink, all of its own
    cut = replace(scene, camera=Camera(500 - 130, 400, [1000.0, 1000.0], [120.0, 200.0]))
    assert render_light(cut)[1].visible_fraction[0] == pytest.approx(0.75)


def test_a_cylinder_hides_its_far_side() -> None:
    pattern = grid(13, 6, PITCH_MM, line_width_mm=LINE_MM, surface=BENT, orientation_marks=True)
    scene = scene_of(pattern, facing_pose(250.0, np.radians(40), np.pi / 2))
    light, truth = render_light(replace(scene, light=Light(ink_grey=20.0, ground_grey=200.0, background_grey=0.0)))
    shown = (truth.center_mm * truth.normal).sum(axis=1) < 0
    assert 0 < shown.sum() < len(pattern)
    assert (truth.visible_fraction[~shown] == 0).all()
    assert (truth.visible_fraction[shown] > 0.4).all()
    # no ink counts twice or less than nothing, and none lies beside the cylinder
    assert light.min() > -200 * EXACT
    assert light.max() < 200 * (1 + EXACT)
    far = ~np.isfinite(flat_places(scene, *np.meshgrid(np.arange(640.0), np.arange(480.0)))).all(axis=-1)
    assert light[far].mean() < 0.5


def test_lines_follow_a_bent_dish() -> None:
    """Dark places along a line, found as its minimum of light, are where points of the deformed surface are imaged."""
    surface = Surface("paraboloid", 400.0, 200.0)
    pattern = grid(25, 25, PITCH_MM, line_width_mm=LINE_MM, surface=surface)
    state = Deformation(bumps=(Bump((30.0, 20.0), 60.0, 5.0),), slide="normal")
    scene = scene_of(pattern, facing_pose(330.0, 0.2, 1.0), deformation=state)
    drawn = coverage(scene)
    unmoved = coverage(replace(scene, deformation=Deformation()))
    # half way between crossings (13, 12) and (14, 12) near the bump's top, from the vertex to the right
    way = 1.5 * PITCH_MM
    radius = way - way**3 / (24 * 200.0**2)
    point = np.array([radius, 0, radius**2 / 800])
    normal = np.array([-radius / 400, 0, 1]) / np.hypot(1, radius / 400)
    moved = point + 5 * np.exp(-((radius - 30) ** 2 + 400) / 7200) * normal
    for picture, place in ((drawn, moved), (unmoved, point)):
        u, v = CAMERA.project(scene.camera_from_dish.apply(place))
        rows = np.arange(int(v) - 5, int(v) + 7)
        patch = picture[rows, round(u)]
        assert (patch @ rows) / patch.sum() == pytest.approx(v + slope(picture, u, v) * (round(u) - u), abs=0.02)


def slope(picture: Array, u: float, v: float) -> float:
    """How fast the dark middle near (u, v) falls from column to column."""
    rows = np.arange(int(v) - 5, int(v) + 7)
    middle = [(picture[rows, round(u) + k] @ rows) / picture[rows, round(u) + k].sum() for k in (-2, 2)]
    return float((middle[1] - middle[0]) / 4)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"line_gaps": (LineGap(11, 0.0, 1.0),)}, "a gap is in line 11, but the pattern has 9 lines"),
        ({"ink_spread_mm": -0.8}, "closes a line of 1.5 mm"),
    ],
)
def test_impossible_lines(change: dict, text: str) -> None:
    with pytest.raises(InputError, match=text):
        scene_of(grid(5, 4, PITCH_MM, line_width_mm=LINE_MM), **change)


def test_impossible_gaps_and_squares() -> None:
    with pytest.raises(InputError, match="closes a polygon"):
        scene_of(grid(5, 4, PITCH_MM, square_mm=SQUARE_MM), ink_spread_mm=-4.0)
    with pytest.raises(InputError, match="start_t below its stop_t"):
        LineGap(0, 1.0, 1.0)
