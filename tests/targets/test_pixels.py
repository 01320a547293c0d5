"""The model of the pixels against the simulator's exact areas, analytic discs, and differences of itself."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import FISHEYE, PLAIN, WIDE, facing_towards, group_of, moved, noiseless, one_target
from scipy.special import ndtr
from scipy.stats import ncx2

from dishmap.camera.model import Camera
from dishmap.simulate.render import render_light
from dishmap.targets.adjust import Batch
from dishmap.targets.bound import PIXEL_VARIANCE_PX2
from dishmap.targets.builders import concentric, disc, multi_circular, ring
from dishmap.targets.edges import MISFIT_PX, Poses
from dishmap.targets.light import LIGHT, light_columns, solve_light, toned
from dishmap.targets.pattern import TargetKind
from dishmap.targets.pixels import (
    BAND_BLURS,
    BLUR,
    GEOMETRY,
    LARGEST_CURVED,
    OFFSET_MM,
    OFFSET_PX,
    TONE,
    RingPixels,
    RingSums,
    Weighting,
    coverage_columns,
    normal_distribution,
    ring_sums,
    rings_of,
    without_light,
)
from dishmap.targets.stages import Group, layout

Array = NDArray[np.float64]

DISTANCE_MM = 500.0
VIEWS = {
    "axis": (PLAIN, (200.3, 150.2), 3000.0),
    "edge of 90 degrees": (WIDE, (920.0, 660.0), 400.0),
    "fisheye": (FISHEYE, (760.0, 250.0), 270.0),
}
KINDS = {
    "ring": lambda r: ring(r, 0.6 * r),
    "four rings": lambda r: multi_circular(4, r, 0.6 * r, 2.8 * r),
    "concentric": lambda r: concentric((r, 0.8 * r, 0.6 * r, 0.4 * r)),
    "disc": disc,
}
# Four blurs away a circle has 3e-5 of its edge left; its weight, at the edge 0.4 / blur, is 3e-4 of that there.
FAR_PART = 4e-4
# A pixel is a square, the model's is a Gaussian of the same variance: under a blur of 0.5, 0.8 and 2 px that differs by so much of
# the contrast. At 2 px what is left of the lens's change of scale over the blur is as large as at 0.8.
AREA_ERROR = {0.5: 3e-3, 0.8: 1.6e-3, 2.0: 1.6e-3}
# ... and with the signs of the edge's two sides, so that edges and centres stay where they are.
EDGE_PX, CENTER_PX = 5e-4, 1e-3
# What is left of a centre seen through a very wide lens, where the model had 0.001 to 0.007 px without its second derivatives.
WIDE_CENTER_PX = 3e-4
# What the series of the band path leaves of a curved edge at its limit, and clearly passes at twice that.
CURVED_EDGE_PX = 1e-3
# Band and fine grid, where the series is far from its limit: the fine grid's sampling and the series' next term.
PATHS_AGREE = 5e-4
# Coverage is in single precision; a difference over 0.02 px loses 6e-8 / 0.02 and (0.02 / blur)^2 / 6 of the derivative.
DIFFERENCE_PART = 2e-3
# A pixel's motion is taken where it is, not at the foot of its edge point: blur over radius of it is wrong, with opposite signs on
# the two sides of the edge, so that the edge as a whole follows rightly. The series for curved edges is held fixed: (k s)^2 / 2.
PIXEL_PART, EDGE_PART = 0.06, 0.008
SINGLE = 1e-4


@dataclass(frozen=True)
class Seen:
    """A target at its true pose, with its exact coverage (0 to 1) as the photograph."""

    group: Group
    batch: Batch
    pixels: RingPixels

    def columns(self, group: Group | None = None) -> tuple[Array, Array, Array]:
        """Coverage, geometry derivatives and edge weights, zero outside the pixels used, in double precision."""
        at = group or self.group
        maps = self.batch.maps(at.poses, self.pixels.patches)
        parts = coverage_columns(slice(0, len(self.pixels.ring)), self.pixels, self.batch.rings, maps, at.state)
        cover, geometry, edges = (np.asarray(p, dtype=float) for p in parts)
        used = self.pixels.used
        return cover * used, geometry * used[:, None], edges * used[:, None]

    def sums(self, group: Group | None = None, weighting: Weighting | None = None) -> tuple[RingSums, NDArray[np.float32]]:
        at = group or self.group
        maps = self.batch.maps(at.poses, self.pixels.patches)
        return ring_sums(self.pixels, self.batch.rings, maps, at.state, weighting or Weighting(1.0, 0.0, None))


def seen(view: str, kind_name: str, radius_px: float, tilt_deg: float, psf_px: float) -> Seen:
    camera, pixel, focal_px = VIEWS[view]
    kind = KINDS[kind_name](radius_px * DISTANCE_MM / focal_px)
    pose = facing_towards(camera, pixel, DISTANCE_MM, np.radians(tilt_deg), 0.7)
    scene = noiseless(one_target(kind), camera, pose, psf_px)
    blur = float(np.hypot(psf_px, PIXEL_VARIANCE_PX2**0.5))
    group = group_of(camera, kind, Poses(pose.rotation[None], pose.translation_mm[None]), blur)
    light = render_light(scene)[0].astype(float)
    ground, ink = scene.light.ground_grey, scene.light.ink_grey
    return Seen(group, *layout(((ground - light) / (ground - ink)).astype(np.float32), group, blur, blur))


def least_squares_shift(error: Array, columns: Array) -> Array:
    """The change of some parameters that explains an error best: columns (M, K, n), error (M, n)."""
    flat = np.concatenate(list(columns), axis=1).T
    return np.linalg.lstsq(flat, error.reshape(-1), rcond=None)[0]


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize(("kind", "radius_px", "tilt_deg"), [("ring", 6.0, 0.0), ("ring", 6.0, 50.0), ("concentric", 12.0, 30.0)])
@pytest.mark.parametrize("psf_px", AREA_ERROR)
def test_coverage_is_the_exact_area(view: str, kind: str, radius_px: float, tilt_deg: float, psf_px: float) -> None:
    target = seen(view, kind, radius_px, tilt_deg, psf_px)
    cover, geometry, _ = target.columns()
    error = cover - target.pixels.grey * target.pixels.used
    assert np.abs(error).max() < AREA_ERROR[psf_px]
    px_per_mm = VIEWS[view][2] / DISTANCE_MM
    assert np.linalg.norm(least_squares_shift(error, geometry[:, :2])) * px_per_mm < CENTER_PX
    assert abs(least_squares_shift(error, geometry[:, [OFFSET_PX]])[0]) < EDGE_PX


def center_error_px(target: Seen, px_per_mm: float) -> float:
    """By how much a fit of place, depth, offsets, blur and light would move the centre of a one-ring target."""
    cover, geometry, _ = target.columns()
    p = target.pixels
    light = light_columns(p.s, p.t, cover.astype(np.float32)) * p.used[:, None]
    columns = np.concatenate([geometry[:, [0, 1, 2, OFFSET_MM, OFFSET_PX, BLUR]], light], axis=1)
    columns /= np.linalg.norm(columns, axis=2, keepdims=True) + 1e-30
    scale = np.linalg.norm(geometry[0, :2], axis=1)
    return float(np.linalg.norm(least_squares_shift(cover - p.grey * p.used, columns)[:2] / scale) * px_per_mm)


@pytest.mark.parametrize(
    ("view", "radius_px", "tilt_deg", "psf_px"),
    [
        ("fisheye", 12.0, 30.0, 0.8),
        ("fisheye", 25.0, 0.0, 2.0),
        ("fisheye", 25.0, 40.0, 2.0),
        ("edge of 90 degrees", 25.0, 0.0, 2.0),
        ("edge of 90 degrees", 40.0, 20.0, 2.0),
    ],
)
def test_a_wide_lens_does_not_move_the_centre(
    view: str, radius_px: float, tilt_deg: float, psf_px: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    px_per_mm = VIEWS[view][2] / DISTANCE_MM
    target = seen(view, "ring", radius_px, tilt_deg, psf_px)
    assert center_error_px(target, px_per_mm) < WIDE_CENTER_PX
    # with the plane taken as affine about each pixel, and as the fifth degree has it over the ring
    monkeypatch.setattr("dishmap.targets.pixels.LARGEST_SHIFT_PX", np.inf)
    monkeypatch.setattr("dishmap.targets.edges.MISFITS_PX", (MISFIT_PX, np.inf, np.inf, np.inf))
    assert center_error_px(target, px_per_mm) > 3 * WIDE_CENTER_PX


def test_a_slightly_wrong_blur_or_place_is_not_the_exact_area() -> None:
    target = seen("axis", "ring", 8.0, 20.0, 0.8)
    cover = target.columns()[0]
    truth = target.pixels.grey * target.pixels.used
    for column, amount in ((BLUR, 0.01), (0, 0.001), (OFFSET_PX, 0.005)):
        shifted = target.columns(moved(target.group, column, amount))[0]
        assert np.abs(shifted - truth).max() > 1.5 * np.abs(cover - truth).max()


def disc_edge_error_px(radius_px: float, blur_px: float) -> float:
    """How far the band path puts the edge of a disc wrong: its coverage against the exact one, as a shift of the edge.

    Exact: the chance that a normal deviate of standard deviation `blur_px` about the pixel falls into the disc, a non-central
    chi-square of two degrees of freedom.
    """
    rho = np.linspace(max(radius_px - 3 * blur_px, 0.1), radius_px + 3 * blur_px, 400)
    exact = ncx2.cdf((radius_px / blur_px) ** 2, 2, (rho / blur_px) ** 2)
    camera = Camera(200, 200, [1000.0, 1000.0], [100.0, 100.0])
    group = group_of(camera, disc(radius_px), Poses(np.diag([1.0, -1.0, -1.0])[None], np.array([[0.0, 0.0, 1000.0]])), blur_px)
    batch, pixels = layout(np.zeros((200, 200), np.float32), group, 0.01 * blur_px, 3 * blur_px)
    assert pixels.shape is None, "this is about the band path"
    s, t = ((rho + camera.principal_px[0] - pixels.patches.anchor_px[0, 0]) / pixels.patches.scale_px[0])[None], 0 * rho[None]
    line = replace(pixels, s=s.astype(np.float32), t=t.astype(np.float32), grey=np.zeros_like(s), used=np.ones(s.shape, bool))
    maps = batch.maps(group.poses, pixels.patches)
    cover, geometry, _ = coverage_columns(slice(0, 1), line, batch.rings, maps, group.state)
    slope = geometry[0, OFFSET_PX]
    return float(((cover[0] - exact) * slope * rho).sum() / (slope * slope * rho).sum())


def test_the_series_for_curved_edges_holds_up_to_its_limit() -> None:
    blur = 1.0
    at_limit = abs(disc_edge_error_px(blur / LARGEST_CURVED, blur))
    assert at_limit < CURVED_EDGE_PX
    assert abs(disc_edge_error_px(0.5 * blur / LARGEST_CURVED, blur)) > 2 * CURVED_EDGE_PX
    # without the series the edge would be off by curvature * blur^2 / 2, a hundred times more
    assert 0.5 * LARGEST_CURVED * blur > 50 * at_limit


@pytest.mark.parametrize("tilt_deg", [0.0, 40.0])
def test_the_fine_grid_agrees_with_the_band_where_both_hold(tilt_deg: float) -> None:
    target = seen("axis", "ring", 25.0, tilt_deg, 0.8)
    band = target.columns()
    assert target.pixels.shape is None
    # the same pixels as one whole window
    p, reach = target.pixels.patches, (25 + 8)
    dv, du = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, 1, -1)
    s, t = ((d / p.scale_px[0]).astype(np.float32) for d in (du, dv))
    side = 2 * reach + 1
    whole = RingPixels(target.pixels.ring, p, s, t, np.zeros_like(s), np.ones(s.shape, bool), (side, side))
    fine = replace(target, pixels=whole).columns()
    used = target.pixels.used[0]
    place = [np.rint(x[0][used] * p.scale_px[0]).astype(int) + reach for x in (target.pixels.t, target.pixels.s)]
    flat = place[0] * side + place[1]
    np.testing.assert_allclose(fine[0][0, flat], band[0][0, used], atol=PATHS_AGREE)
    for column in (c for c in range(BLUR + 1) if c != 5):
        scale = np.abs(band[1][0, column]).max()
        np.testing.assert_allclose(fine[1][0, column, flat], band[1][0, column, used], atol=PIXEL_PART * scale)


@pytest.mark.parametrize(
    ("view", "kind", "radius_px", "psf_px", "fine"),
    [
        ("axis", "ring", 25.0, 0.8, False),
        ("axis", "ring", 6.0, 1.2, True),
        ("axis", "four rings", 12.0, 0.8, False),
        ("edge of 90 degrees", "ring", 15.0, 0.8, False),
        ("fisheye", "ring", 6.0, 1.2, True),
    ],
)
def test_derivatives_of_the_coverage_against_differences(view: str, kind: str, radius_px: float, psf_px: float, fine: bool) -> None:
    target = seen(view, kind, radius_px, 25.0, psf_px)
    assert (target.pixels.shape is not None) == fine
    px_per_mm, extent = VIEWS[view][2] / DISTANCE_MM, target.group.kind.extent_mm
    # each step moves the edges by about 0.02 px
    across, turn = 0.02 / px_per_mm, 0.02 / (px_per_mm * extent)
    step = [across, across, across * DISTANCE_MM / extent, 2 * turn, 2 * turn, turn, across, 0.02, 0.02]
    analytic = target.columns()[1]
    for column in range(BLUR + 1):
        if column == 5 and target.group.kind.turns_freely:
            continue
        # the maps are made anew at either pose: this tests the motion fields too
        plus, minus = (target.columns(moved(target.group, column, sign * step[column]))[0] for sign in (1, -1))
        difference = (plus - minus) / (2 * step[column])
        largest = np.abs(difference).max()
        part = DIFFERENCE_PART if column == OFFSET_PX else PIXEL_PART
        np.testing.assert_allclose(analytic[:, column], difference, atol=part * largest, err_msg=f"column {column}")
        assert (analytic[:, column] * difference).sum() / (difference**2).sum() == pytest.approx(1, abs=EDGE_PART), f"column {column}"


@pytest.mark.parametrize("cut", [None, np.full(4, 60.0)], ids=["plain", "robust"])
def test_normal_equations_hold_the_gradient_of_chi_square_with_light_eliminated(cut: Array | None) -> None:
    target = seen("axis", "four rings", 12.0, 25.0, 0.8)
    target = replace(target, pixels=replace(target.pixels, grey=200 - 170 * target.pixels.grey))
    weighting = Weighting(4.0, 0.0, cut)
    # away from the best fit
    group = moved(moved(target.group, 0, 0.02), BLUR, 0.05)
    sums, _ = target.sums(group, weighting)
    _, right = without_light(sums)
    analytic = -2 * right.sum(axis=0)
    step = {5: 1e-4, OFFSET_MM: 1e-3, OFFSET_PX: 5e-3, BLUR: 5e-3, TONE: 5e-3}
    for column in range(GEOMETRY):
        h = step.get(column, 1e-3)
        plus, minus = (target.sums(moved(group, column, sign * h), weighting)[0].square.sum() for sign in (1, -1))
        scale = np.sqrt(sums.normal[:, column, column].sum() * sums.square.sum())
        # robust weights are held fixed in a Gauss-Newton step; here nothing is beyond half of the cut
        assert (plus - minus) / (2 * h) == pytest.approx(analytic[column], abs=0.02 * scale), f"column {column}"


def test_elimination_of_light_is_the_schur_complement() -> None:
    target = seen("axis", "four rings", 10.0, 30.0, 0.8)
    target = replace(target, pixels=replace(target.pixels, grey=200 - 170 * target.pixels.grey))
    sums, _ = target.sums(moved(target.group, 0, 0.02))
    normal, right = without_light(sums)
    damped = sums.normal + 1e-3 * np.eye(GEOMETRY + LIGHT)
    whole = np.linalg.inv(damped)[:, :GEOMETRY, :GEOMETRY]
    np.testing.assert_allclose(np.linalg.inv(whole) - 1e-3 * np.eye(GEOMETRY), normal, rtol=0.01, atol=1e-4 * np.abs(normal).max())
    # what eliminates the light also makes the light's own equations hold
    assert np.abs(right).max() > 100 * np.abs(sums.right[:, GEOMETRY:]).max()


def test_light_levels_are_found_exactly() -> None:
    rng = np.random.default_rng(1)
    s, t, cover = (rng.uniform(-1, 1, (3, 400)).astype(np.float32) for _ in range(3))
    columns = light_columns(s, t, np.abs(cover))
    levels = np.array([190.0, 10, -5, 25, 3, 1, 8, 4, -6])[:LIGHT] * rng.uniform(0.2, 1.2, (3, LIGHT))
    rows = np.concatenate([columns, np.einsum("ml,mln->mn", levels, columns)[:, None]], axis=1).astype(np.float32)
    np.testing.assert_allclose(solve_light(rows), levels, atol=0.01)
    # pixels without weight say nothing
    rows[:, -1, ::3] = 999
    rows[..., ::3] *= 0
    np.testing.assert_allclose(solve_light(rows), levels, atol=0.01)


def test_normal_distribution_against_scipy() -> None:
    z = np.concatenate([np.linspace(-9, 9, 2001), [-300.0, 0.0, 300.0]]).astype(np.float32)
    np.testing.assert_allclose(normal_distribution(z, np.exp(-0.5 * z * z)), ndtr(z.astype(float)), atol=2e-7)


@pytest.mark.parametrize(
    ("kind", "radius_px", "tilt_deg", "alone"), [("ring", 30.0, 40.0, 1), ("concentric", 60.0, 0.0, 1), ("ring", 12.0, 0.0, 2)]
)
def test_far_circles_are_left_out_and_not_missed(kind: str, radius_px: float, tilt_deg: float, alone: int) -> None:
    target = seen("axis", kind, radius_px, tilt_deg, 0.8)
    blur = float(target.group.state.blur_px[0])
    parts = target.pixels.parts(slice(0, 1), blur)
    assert {int(near.sum()) for _, _, near in parts} == {alone}
    assert target.pixels.clear_px is not None
    every = replace(target, pixels=replace(target.pixels, clear_px=np.full_like(target.pixels.clear_px, -1)))
    for few, all_of_them in zip(target.columns(), every.columns(), strict=True):
        scale = np.abs(all_of_them).max(axis=-1, keepdims=True)
        assert (np.abs(few - all_of_them) <= FAR_PART * scale).all()
    # a wider blur than the pixels were chosen for brings the other circles back
    assert all(near.all() for _, _, near in target.pixels.parts(slice(0, 1), 10 * blur * radius_px / 12))


def test_pixels_are_in_the_order_of_the_circles_they_are_at() -> None:
    target = seen("axis", "ring", 30.0, 0.0, 0.8)
    p, blur = target.pixels, float(target.group.state.blur_px[0])
    assert p.ends[-1] == p.s.shape[1]
    reach = BAND_BLURS * blur + 2
    for thin in (p, p.every(8)):
        rho = np.hypot(thin.s, thin.t) * p.patches.scale_px[0]
        for (columns, _, _), radius in zip(thin.parts(slice(0, 1), blur), (30, 18), strict=True):
            assert thin.used[:, columns].any()
            # anchors are whole pixels
            assert np.abs(rho - radius)[:, columns][thin.used[:, columns]].max() < reach + 0.75


@pytest.mark.parametrize("gamma", [0.45, 1.0, 2.2])
@pytest.mark.parametrize("ratio", [0.1, 0.6])
def test_tone_curve(gamma: float, ratio: float) -> None:
    cover = np.linspace(0, 1, 50)[None]
    dark, log_gamma = np.array([[ratio]]), np.array([[np.log(gamma)]])
    level, slope, by_gamma = toned(cover, dark, log_gamma)
    # by the simulator's own words: recorded = light^(1 / gamma), of the mean of light and dark
    recorded = (1 - cover + cover * ratio**gamma) ** (1 / gamma)
    np.testing.assert_allclose(level, (1 - recorded) / (1 - ratio), atol=1e-12)
    h = 1e-5
    inner = (cover > h) & (cover < 1 - h)
    by_cover = (toned(cover + h, dark, log_gamma)[0] - toned(cover - h, dark, log_gamma)[0]) / (2 * h)
    np.testing.assert_allclose(slope[inner], by_cover[inner], rtol=1e-6)
    by_tone = (toned(cover, dark, log_gamma + h)[0] - toned(cover, dark, log_gamma - h)[0]) / (2 * h)
    np.testing.assert_allclose(by_gamma, by_tone, atol=1e-8)


def test_an_outlier_is_left_out_and_ordinary_noise_is_not() -> None:
    target = seen("axis", "ring", 15.0, 20.0, 0.8)
    rng = np.random.default_rng(2)
    clean = 200 - 170 * target.pixels.grey + 2 * rng.standard_normal(target.pixels.grey.shape).astype(np.float32)
    dirty = clean.copy()
    dirty[0, 40:80] = 250
    weighting = Weighting(4.0, 0.0, np.array([20.0]))
    noisy = replace(target, pixels=replace(target.pixels, grey=clean)).sums(weighting=weighting)[0]
    count = target.pixels.used.sum()
    assert noisy.weight[0] == pytest.approx(count)
    assert noisy.kept.min() == pytest.approx(1)
    spotted = replace(target, pixels=replace(target.pixels, grey=dirty)).sums(weighting=weighting)[0]
    # those of the forty pixels that lie on the ground near 200 stay within the cut's reach of their level
    assert count - 40 <= spotted.weight[0] < count - 20
    assert spotted.kept.min() < 0.99
    np.testing.assert_allclose(spotted.light[:, [0, 3]], noisy.light[:, [0, 3]], atol=4)


def test_rings_of_a_kind() -> None:
    four = multi_circular()
    rings = rings_of(four)
    assert len(rings) == 4
    np.testing.assert_array_equal(rings.sign, [[1, -1]] * 4)
    np.testing.assert_allclose(rings.radius_mm, [[5, 3]] * 4)
    together = rings_of(four, together=True)
    assert together.sign.shape == (1, 8)
    assert together.sign.sum() == 0
    # a disc beside a ring leaves a place unused
    mixed = rings_of(TargetKind([[0, 0], [0, 0], [12, 0]], [5, 3, 4], [True, False, True]))
    np.testing.assert_array_equal(mixed.sign, [[1, -1], [1, 0]])


def test_the_band_holds_every_pixel_near_an_edge_and_few_others() -> None:
    target = seen("axis", "ring", 20.0, 30.0, 0.8)
    p, blur = target.pixels, target.group.state.blur_px[0]
    u, v = (
        np.rint(x[0][p.used[0]] * p.patches.scale_px[0]).astype(int) + a
        for x, a in ((p.s, p.patches.anchor_px[0, 0]), (p.t, p.patches.anchor_px[0, 1]))
    )
    chosen = set(zip(u.tolist(), v.tolist(), strict=True))
    assert len(chosen) == p.used.sum(), "no pixel twice"
    camera, pixel, focal = VIEWS["axis"]
    pose = facing_towards(camera, pixel, DISTANCE_MM, np.radians(30.0), 0.7)
    radius = 20 * DISTANCE_MM / focal
    light = render_light(noiseless(one_target(ring(radius, 0.6 * radius)), camera, pose, 0.8))[0]
    # 2 blurs from an edge 2 % of the contrast are left
    share = (180 - light) / 160
    rows, columns = np.nonzero((share > ndtr(-BAND_BLURS + 0.3)) & (share < ndtr(BAND_BLURS - 0.3)))
    near = set(zip(columns.tolist(), rows.tolist(), strict=True))
    assert near <= chosen
    around = 2 * np.pi * 20 * 1.6 * (1 + np.cos(np.radians(30))) / 2
    assert len(chosen) < around * (2 * BAND_BLURS * blur + 4)


def test_every_step_keeps_pixels_and_geometry_together() -> None:
    target = seen("axis", "ring", 20.0, 30.0, 0.8)
    thin = target.pixels.every(4)
    np.testing.assert_array_equal(thin.grey, target.pixels.grey[:, ::4])
    np.testing.assert_array_equal(thin.s, target.pixels.s[:, ::4])
    assert target.pixels.every(1) is target.pixels


def test_single_precision_is_enough() -> None:
    """The same target twice, anchored 3000 px apart: the coverage agrees to the last digits of single precision."""
    near, far = Camera(120, 120, [3000.0, 3000.0], [60.0, 60.0]), Camera(4000, 4000, [3000.0, 3000.0], [3060.0, 3060.0])
    covers = []
    for camera in (near, far):
        group = group_of(camera, ring(3.0, 1.8), Poses(np.diag([1.0, -1.0, -1.0])[None], np.array([[0.0, 0.0, 500.0]])), 0.85)
        batch, pixels = layout(np.zeros((camera.height_px, camera.width_px), np.uint8), group, 0.85, 0.85)
        maps = batch.maps(group.poses, pixels.patches)
        covers.append(coverage_columns(slice(0, 1), pixels, batch.rings, maps, group.state)[0])
    np.testing.assert_allclose(covers[0], covers[1], atol=SINGLE)
