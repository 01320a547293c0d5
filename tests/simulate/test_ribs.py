"""The dish's edge and the ribs that cross it, against polygons projected by OpenCV."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtri

from dishmap.camera.model import Camera
from dishmap.errors import InputError
from dishmap.simulate.deform import Deformation, ZernikeTerm
from dishmap.simulate.forward import outline_px, rib_outlines_px
from dishmap.simulate.render import render_light
from dishmap.simulate.scene import Light, Ribs, Scene, Sensor, facing_pose
from dishmap.targets.builders import dish
from dishmap.transforms import Pose

Array = NDArray[np.float64]

# The promise for the rim's edge; chords of half a pixel leave 1e-4 px.
EDGE_PX = 5e-3
# A rib's ends and sides, of 30 px and more
RIB_AREA_PX2 = 0.05

CAMERA = Camera(700, 640, [500.0, 502.0], [352.0, 317.0], [-0.2, 0.05, 0.0004, -0.0003])
SCENE = Scene(
    dish(300.0, 150.0, spacing_mm=45.0),
    CAMERA,
    facing_pose(400.0, 0.1, 0.6),
    light=Light(ink_grey=200.0, ground_grey=200.0, background_grey=0.0),
    sensor=Sensor(psf_sigma_px=0.7),
)
BESIDE = Ribs(3, 12.0, 160.0, 190.0, grey=100.0, first_rad=0.4)


def projected(points_mm: Array) -> Array:
    pixels = cv2.projectPoints(points_mm, np.zeros(3), np.zeros(3), CAMERA.matrix, CAMERA.distortion)[0]
    return np.asarray(pixels).reshape(-1, 2)


def polygon(corners: Array) -> tuple[float, Array]:
    """Area and centroid of a polygon (N, 2) by the shoelace formulas."""
    a, b = corners - corners.mean(axis=0), np.roll(corners, -1, axis=0) - corners.mean(axis=0)
    twice = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return abs(float(twice.sum()) / 2), corners.mean(axis=0) + ((a + b) * twice[:, None]).sum(axis=0) / (3 * twice.sum())


def moments(coverage: Array) -> tuple[float, Array]:
    v, u = np.mgrid[: coverage.shape[0], : coverage.shape[1]]
    total = coverage.sum(dtype=float)
    return total, np.array([(coverage * u).sum(dtype=float), (coverage * v).sum(dtype=float)]) / total


def test_the_rim_of_a_deformed_dish_is_where_its_points_went() -> None:
    motion = Pose.from_rotation_vector([0.01, -0.02, 0.3], [1.0, -2.0, 3.0])
    state = Deformation(zernike=(ZernikeTerm(2, 2, 0.8), ZernikeTerm(3, 3, 0.6)), expansion_ppm=500.0, slide="normal", motion=motion)
    light = render_light(SCENE.with_state(state))[0]
    t = np.arange(20000) * np.pi / 10000
    # by hand: the slope at the rim of f/D 0.5 is 1/2, so the normal leans inwards by 1 in 2
    lift = 0.8 * np.cos(2 * t) + 0.6 * np.cos(3 * t)
    radius = 150 * 1.0005 - lift / np.sqrt(5)
    rim = np.stack([radius * np.cos(t), radius * np.sin(t), 37.5 * 1.0005 + 2 * lift / np.sqrt(5)], axis=-1)
    outline = projected(SCENE.camera_from_dish.apply(motion.apply(rim)))
    area, center = polygon(outline)
    drawn, middle = moments(light / 200.0)
    assert abs(drawn - area) / np.sqrt(4 * np.pi * area) < EDGE_PX
    assert np.abs(middle - center).max() < EDGE_PX
    # the edge at single places, by the grey of the pixel there: a step blurred by 0.7 px and the pixel's square
    for angle in (0, 5100, 12345):
        u, v = np.rint(outline[angle]).astype(int)
        inwards = np.array([light[v, u + 1] - light[v, u - 1], light[v + 1, u] - light[v - 1, u]])
        inwards /= np.linalg.norm(inwards)
        along = np.array([inwards[1], -inwards[0]])
        nearest = outline[np.argmin(np.abs((outline - [u, v]) @ along) + 1e3 * (np.linalg.norm(outline - [u, v], axis=1) > 3))]
        assert np.hypot(0.7, 1 / np.sqrt(12)) * ndtri(light[v, u] / 200.0) == pytest.approx(
            (np.array([u, v]) - nearest) @ inwards, abs=0.01
        )


def test_ribs_beyond_the_rim_have_their_area_and_place() -> None:
    light = render_light(replace(SCENE, ribs=(BESIDE,)))[0] - render_light(SCENE)[0]
    for number in range(3):
        angle = 0.4 + 2 * np.pi * number / 3
        side = np.linspace(-6, 6, 200)
        out = np.linspace(160, 190, 200)
        edge = np.concatenate(
            [[[160.0, s] for s in side], [[r, 6.0] for r in out], [[190.0, -s] for s in side], [[r, -6.0] for r in out[::-1]]]
        )
        c, s = np.cos(angle), np.sin(angle)
        xy = edge @ np.array([[c, s], [-s, c]])
        points = np.column_stack([xy, (xy**2).sum(axis=1) / 600])
        area, center = polygon(projected(SCENE.camera_from_dish.apply(points)))
        u, v = np.rint(center).astype(int)
        part = light[v - 40 : v + 41, u - 40 : u + 41] / 100.0
        drawn, middle = moments(part)
        assert drawn == pytest.approx(area, abs=RIB_AREA_PX2)
        assert middle + [u - 40, v - 40] == pytest.approx(center, abs=EDGE_PX)


def test_ribs_in_front_hide_surface_and_ink_and_those_behind_do_not() -> None:
    printed = replace(SCENE, light=Light())
    ribs = Ribs(4, 16.0, 20.0, 180.0, grey=90.0)
    plain, truth = render_light(printed)
    front, hidden = render_light(replace(printed, ribs=(ribs,)))
    behind, shown = render_light(replace(printed, ribs=(replace(ribs, front=False),)))
    inside, outside = projected(SCENE.camera_from_dish.apply([[100.0, 0.0, 100**2 / 600], [170.0, 0.0, 170**2 / 600]])).round().astype(int)
    assert front[inside[1], inside[0]] == pytest.approx(90.0, abs=0.01)
    assert behind[inside[1], inside[0]] == pytest.approx(plain[inside[1], inside[0]], abs=0.01)
    assert plain[outside[1], outside[0]] == pytest.approx(12.0, abs=0.01)
    for light in (front, behind):
        assert light[outside[1], outside[0]] == pytest.approx(90.0, abs=0.01)
    assert (shown.visible_fraction == truth.visible_fraction).all()
    # the ribs run along the axes from 20 mm on: over the middles of targets on them, past those beyond 25 mm from them
    x, y = np.abs(printed.pattern.center_mm[:, 0]), np.abs(printed.pattern.center_mm[:, 1])
    across, along = np.minimum(x, y), np.maximum(x, y)
    on_ribs, clear = (across < 1) & (along > 40), across > 25
    assert on_ribs.sum() >= 4
    assert (hidden.visible_fraction[on_ribs] < 0.7).all()
    assert hidden.visible_fraction[clear] == pytest.approx(truth.visible_fraction[clear], abs=1e-6)


def test_ribs_move_with_the_dish_and_are_not_drawn_from_behind() -> None:
    turned = Deformation(motion=Pose.from_rotation_vector([0.0, 0.0, 0.4], [0.0, 0.0, 0.0]))
    start, end = replace(SCENE, ribs=(replace(BESIDE, first_rad=0.0),)), replace(SCENE, ribs=(BESIDE,))
    moved = render_light(start.with_state(turned))[0]
    assert np.abs(moved - render_light(end)[0]).max() < 0.05
    from_behind = replace(end, camera_from_dish=facing_pose(700.0, np.pi))
    assert render_light(from_behind)[0].max() < 1e-6


def test_ribs_stay_at_the_rim_of_a_bent_dish() -> None:
    bent = Deformation(zernike=(ZernikeTerm(2, 0, 3.0),))
    gap = []
    for state in (Deformation(), bent):
        scene = SCENE.with_state(state)
        corners = rib_outlines_px(scene, replace(BESIDE, inner_radius_mm=150.0))[0]
        rim = outline_px(scene)
        gap.append(np.linalg.norm(corners[:, None] - rim, axis=2).min(axis=1))
    # all of the rim moves in by over a millimetre, and the ribs with it
    assert np.abs(np.sort(gap[0])[:5] - np.sort(gap[1])[:5]).max() < 0.3
    assert gap[0].max() == pytest.approx(gap[1].max(), abs=1.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda: replace(BESIDE, count=0), "ribs need a count of at least 1, not 0"),
        (lambda: replace(BESIDE, width_mm=0.0), "ribs need a positive width_mm and a finite first_rad, not 0.0"),
        (lambda: replace(BESIDE, first_rad=np.nan), "a finite first_rad, not 12.0 and nan"),
        (lambda: replace(BESIDE, outer_radius_mm=100.0), "ribs run from inner_radius_mm out to outer_radius_mm, not 160.0 to 100.0"),
        (lambda: replace(BESIDE, grey=300.0), "the grey of ribs must lie between 0 and 255, not 300.0"),
    ],
)
def test_impossible_ribs_are_refused(change: Callable[[], Ribs], message: str) -> None:
    with pytest.raises(InputError, match=message):
        change()
