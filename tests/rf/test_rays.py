"""Rays: stationary paths, reflection, power, derivatives, and the limits of plane and spherical waves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from dishmap.errors import InputError
from dishmap.rf.antenna import Actuators, Antenna, Feed, Reflector, Subreflector
from dishmap.rf.aperture import aperture_nodes
from dishmap.rf.correction import Correction, correction_of, no_correction, shape_terms
from dishmap.rf.deformation import undeformed
from dishmap.rf.rays import Rays, feed_place, trace
from dishmap.rf.sources import sources
from dishmap.rf.subreflector import local_xy, patch, sub_surface

Array = NDArray[np.float64]

# rounding of paths of a few hundred mm
PATH_MM = 1e-9
# central differences with steps of 1e-5 mm or degrees: rounding of 1e-13 mm over 2e-5, and third derivatives, up to
# 1000 where bent subreflectors gather rays, times 1e-10 / 6
BY_DIFFERENCE = 1e-7
# power by a Gauss rule over smooth fields
POWER = 1e-8
KINDS: list[str | None] = [None, "cassegrain", "gregorian"]


def antenna(kind: str | None, offset_mm: float = 0.0, degree: int = 0, polarization: str = "x", feed: str = "gaussian") -> Antenna:
    sub = None if kind is None else Subreflector(kind, 220.0, 4.0)
    actuators = Actuators(shape_degree=degree, shape_stroke_mm=3.0) if degree and kind else Actuators()
    return Antenna(Reflector(600, 300, offset_mm), Feed(feed, 12.0, polarization=polarization), sub, actuators=actuators)


def moved(whole: Antenna, bent_mm: float = 0.03) -> Correction:
    bend = np.random.default_rng(4).normal(0, bent_mm, len(shape_terms(whole.actuators)))
    return Correction(np.array([1.0, -0.6, 0.8]), np.array([0.6, -0.4]), bend)


def points_of(whole: Antenna, rings: int = 6, spokes: int = 13) -> Array:
    x, y = aperture_nodes(whole, rings, spokes, 0.0).xy_mm.T
    return np.stack([x, y, (x**2 + y**2) / (4 * whole.reflector.focal_length_mm)], axis=1)


def traced(whole: Antenna, correction: Correction, points: Array | None = None) -> Rays:
    return trace(whole, feed_place(whole), points_of(whole) if points is None else points, correction)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("offset", [0.0, 380.0])
def test_perfect_antennas_make_a_plane_wave(kind: str | None, offset: float) -> None:
    """From the focus to a plane across the axis all paths are equal, f + 2 a more or less, and arrive with the field of one wave."""
    whole = antenna(kind, offset)
    points = points_of(whole)
    rays = traced(whole, no_correction(whole), points)
    path = rays.path_mm - points[:, 2]
    # by hand: f; the hyperboloid adds r2 - r1 = 132 (2 a), the ellipsoid 2 a = 1100/3
    expected = {None: 300.0, "cassegrain": 432.0, "gregorian": 300 + 1100 / 3}[kind]
    assert np.abs(path - expected).max() < PATH_MM
    assert not rays.lost.any()
    toward = points - whole.reflector.focus_mm
    assert np.abs(rays.direction - toward / np.linalg.norm(toward, axis=1)[:, None]).max() < 1e-11
    # reflected at the paraboloid, everything goes along the axis and, from a Huygens feed on it, lies along x
    x, y = points[:, :2].T
    normal = np.stack([-x / 600, -y / 600, np.ones_like(x)], axis=1)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    out = rays.direction - 2 * (rays.direction * normal).sum(axis=1)[:, None] * normal
    assert np.abs(out - [0, 0, 1]).max() < 1e-11
    if offset == 0:
        field = 2 * (normal * rays.field).sum(axis=1)[:, None] * normal - rays.field
        assert np.abs(field[:, 1:]).max() < 1e-12 * np.abs(field).max()


@pytest.mark.parametrize("kind", ["cassegrain", "gregorian"])
def test_a_perfect_subreflector_makes_a_spherical_wave_about_the_focus(kind: str) -> None:
    """Off a conic the path is one constant plus the way from F1, wherever it ends, and the field falls as one over that."""
    whole = antenna(kind)
    way = points_of(whole) - whole.reflector.focus_mm
    near = traced(whole, no_correction(whole), whole.reflector.focus_mm + 0.8 * way)
    far = traced(whole, no_correction(whole), whole.reflector.focus_mm + way)
    length = np.linalg.norm(way, axis=1)
    assert np.abs(far.path_mm - near.path_mm - 0.2 * length).max() < PATH_MM
    assert np.ptp(far.path_mm - length) < PATH_MM
    assert np.abs(near.field * 0.8 - far.field).max() < 1e-10 * np.abs(far.field).max()


@pytest.mark.parametrize("kind", ["cassegrain", "gregorian"])
@pytest.mark.parametrize("offset", [0.0, 380.0])
def test_paths_off_a_moved_and_bent_subreflector_are_stationary(kind: str, offset: float) -> None:
    whole = antenna(kind, offset, degree=4)
    correction = moved(whole)
    points = points_of(whole, 2, 4)
    rays, feed = traced(whole, correction, points), feed_place(whole)
    surface = sub_surface(whole, correction)
    assert not rays.lost.any()
    sign = 1.0 if kind == "cassegrain" else -1.0
    for p, q, path in zip(points, rays.reflection_mm, rays.path_mm, strict=True):

        def length(xy: Array, p: Array = p) -> float:
            at = patch(surface, np.asarray(xy)[None]).point_mm[0]
            return sign * float(np.linalg.norm(at - feed.center_mm) + np.linalg.norm(p - at))

        start = local_xy(surface, q[None])[0] + [0.5, -0.7]
        best = minimize(length, start, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-12})
        assert sign * best.fun == pytest.approx(path, abs=1e-8)
        assert np.abs(best.x - local_xy(surface, q[None])[0]).max() < 1e-3
    # and obey the law of reflection
    here = patch(surface, local_xy(surface, rays.reflection_mm))
    assert np.abs(here.point_mm - rays.reflection_mm).max() < PATH_MM
    normal = np.cross(here.first[:, :, 0], here.first[:, :, 1])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    a = rays.reflection_mm - feed.center_mm
    a /= np.linalg.norm(a, axis=1)[:, None]
    assert np.abs(a - 2 * (a * normal).sum(axis=1)[:, None] * normal - rays.direction).max() < 1e-11
    assert np.abs((rays.direction * rays.field).sum(axis=1)).max() < 1e-14


def caught(whole: Antenna, edge_rad: float) -> float:
    """Share of the feed's power within an angle of its axis, by the trapezoid over many thin cones."""
    from dishmap.rf.feed import radiated

    theta = np.linspace(0, edge_rad, 20001)
    rays = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=1)
    density = (np.abs(radiated(feed_place(whole).field, rays)) ** 2).sum(axis=1)
    return float(2 * np.pi * np.trapezoid(density * np.sin(theta), theta))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("feed", ["gaussian", "cosine", "aperture"])
@pytest.mark.parametrize("polarization", ["y", "right"])
def test_the_dish_receives_the_power_in_the_cone(kind: str | None, feed: str, polarization: str) -> None:
    whole = antenna(kind, feed=feed, polarization=polarization)
    nodes = aperture_nodes(whole, 30, 40, 0.0)
    made = sources(whole, undeformed(whole.reflector), no_correction(whole), nodes)
    psi = 2 * np.arctan(600 / (4 * 300))
    edge = psi if kind is None else 2 * np.arctan(np.tan(psi / 2) / 4)
    assert made.arriving.sum() == pytest.approx(caught(whole, edge), abs=POWER)


@pytest.mark.parametrize("kind", ["cassegrain", "gregorian"])
@pytest.mark.parametrize("offset", [0.0, 380.0])
def test_moving_and_bending_carries_power_but_loses_none(kind: str, offset: float) -> None:
    """Power in a narrow tube of rays at the dish is what the feed sent into it: cones between three neighbouring rays."""
    whole = antenna(kind, offset, degree=4)
    correction, feed, step = moved(whole), feed_place(whole), 0.02
    base = points_of(whole, 4, 7)
    corners = [traced(whole, correction, base + np.array(d)) for d in ((0, 0, 0), (step, 0, 0), (0, step, 0), (-step, 0, 0), (0, -step, 0))]
    sent = [(r.reflection_mm - feed.center_mm) / np.linalg.norm(r.reflection_mm - feed.center_mm, axis=1)[:, None] for r in corners]
    solid = np.abs((sent[0] * np.cross(sent[1] - sent[3], sent[2] - sent[4])).sum(axis=1)) / (4 * step**2)
    from dishmap.rf.feed import radiated

    density = (np.abs(radiated(feed.field, sent[0] @ feed.rotation)) ** 2).sum(axis=1)
    arriving = (np.abs(corners[0].field) ** 2).sum(axis=1) * np.abs(corners[0].direction[:, 2])
    # differences over 0.02 mm: 1e-6 of their size
    assert np.abs(arriving / (density * solid) - 1).max() < 1e-5


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("offset", [0.0, 380.0])
def test_derivatives_by_what_can_be_moved(kind: str | None, offset: float) -> None:
    whole = antenna(kind, offset, degree=4)
    values, step = moved(whole).values, 1e-5
    by = traced(whole, correction_of(values)).by_values
    for i, d in enumerate(step * np.eye(len(values))):
        after, before = (traced(whole, correction_of(values + sign * d)).path_mm for sign in (1, -1))
        assert np.abs((after - before) / (2 * step) - by[:, i]).max() < BY_DIFFERENCE


def test_a_feed_moves_as_it_is_told() -> None:
    whole = antenna(None)
    still = traced(whole, no_correction(whole))
    up = traced(whole, Correction(np.array([0, 0, 2.0]), np.zeros(2), np.zeros(0)))
    points = points_of(whole)
    assert np.abs(up.path_mm - np.linalg.norm(points - [0, 0, 302.0], axis=1)).max() < PATH_MM
    # turned about y, its axis (down) swings to -x: the dish is brighter there
    turned = traced(whole, Correction(np.zeros(3), np.array([0, 3.0]), np.zeros(0)))
    brighter = np.linalg.norm(turned.field, axis=1) > np.linalg.norm(still.field, axis=1)
    steep = np.abs(points[:, 0]) > 30
    assert (brighter == (points[:, 0] < 0))[steep].all()
    assert np.array_equal(turned.path_mm, still.path_mm)


def test_crossing_rays_are_lost_not_counted() -> None:
    """Bent by 2 mm over a radius of 47, a subreflector throws several rays to some places: no single one can stand for them."""
    whole = antenna("cassegrain", degree=6)
    shape = np.zeros(len(shape_terms(whole.actuators)))
    shape[shape_terms(whole.actuators).index((6, 0))] = 2.0
    assert traced(whole, Correction(np.zeros(3), np.zeros(2), shape)).lost.any()
    slightly = traced(whole, Correction(np.zeros(3), np.zeros(2), shape / 100))
    assert not slightly.lost.any()


def test_a_subreflector_cannot_enter_the_dish_or_pass_the_feed() -> None:
    whole = antenna("cassegrain")
    with pytest.raises(InputError, match=r"would reach [\d.]+ mm into the dish"):
        traced(whole, Correction(np.array([0, 0, -300.0]), np.zeros(2), np.zeros(0)))
    short = replace(whole, subreflector=Subreflector("cassegrain", 60.0, 4.0))
    with pytest.raises(InputError, match=r"behind the feed's phase centre"):
        traced(short, Correction(np.array([0, 0, -60.0]), np.zeros(2), np.zeros(0)))
