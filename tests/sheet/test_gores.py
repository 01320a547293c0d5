"""Gores laid back on the dish: by an integrator of its own for geodesics, from the numbers in the SVG files alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from printing import SvgPage, dishmap, needs_poppler, on_paper_mm, placed_shifts, rendered
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq
from scipy.spatial import cKDTree

from dishmap.errors import PatternError
from dishmap.io.pattern_file import read_pattern, write_pattern
from dishmap.sheet.flatten import AlongMeridian, AroundVertex
from dishmap.sheet.gores import cut_targets, dish_pieces
from dishmap.sheet.outline import inside
from dishmap.sheet.pieces import ink_places
from dishmap.targets.builders import disc, dish, multi_circular
from dishmap.targets.detect import find_ellipses
from dishmap.targets.flat import meridian_mm, radius_mm
from dishmap.targets.identify import identify
from dishmap.targets.pattern import Pattern, Surface

Array = NDArray[np.float64]

FOCAL = 300.0
DISH = ["dish", "--diameter-mm", 600, "--focal-length-mm", FOCAL, "--orientation-marks"]
# What is asked of a gore laid back; numbers in the SVG are rounded to a nanometre, which paper millimetres away do not feel.
LAID_MM = 0.05
EXACT_MM = 1e-4


def way_mm(radius: float, focal: float) -> float:
    """Length of a meridian from the vertex, by quadrature."""
    return float(quad(lambda r: np.hypot(1, r / (2 * focal)), 0, radius, epsabs=1e-11)[0])


def radius_at(way: float, focal: float) -> float:
    return float(brentq(lambda r: way_mm(r, focal) - way, 0, way + 1e-9, xtol=1e-11)) if way > 0 else 0.0


def laid(flat: Array, azimuth: float, focal: float) -> Array:
    """The point (3,) of the dish onto which a point of a gore goes: up the meridian, then straight to the side.

    Geodesics by Christoffel's symbols of a surface of revolution in (r, azimuth), another way than the program's.
    """
    t, s = flat
    start = radius_at(s, focal)

    def change(_: float, y: Array) -> list[float]:
        r, _phi, dr, dphi = y
        stretch = 1 + r**2 / (4 * focal**2)
        return [dr, dphi, (r * dphi**2 - r / (4 * focal**2) * dr**2) / stretch, -2 * dr * dphi / r]

    # the printed side faces the focus, so x runs against the azimuth
    done = solve_ivp(change, (0, abs(t)), [start, azimuth, 0.0, -np.sign(t) / start], rtol=1e-11, atol=1e-11, method="DOP853")
    r, phi = done.y[:2, -1]
    return np.array([r * np.cos(phi), r * np.sin(phi), r**2 / (4 * focal)])


def laid_cap(flat: Array, focal: float) -> Array:
    way = float(np.hypot(*flat))
    r = radius_at(way, focal)
    return np.array([*(flat / way * r if way else flat), r**2 / (4 * focal)])


@pytest.fixture(scope="module")
def gores(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("gores") / "out"
    done = dishmap("sheet", *DISH, "--out", out)
    assert done.exit_code == 0, (done.output, done.stderr, done.exception)
    assert "longer than it is on the dish" in done.stdout
    return out


def test_printed_gores_laid_back_on_the_dish_put_every_circle_in_its_place(gores: Path) -> None:
    pattern, listing = read_pattern(gores / "pattern.json"), json.loads((gores / "sheets.json").read_text())
    azimuth = {piece["name"]: piece["azimuth_deg"] for piece in listing["pieces"]}
    marks, seen, circle_errors = pattern.marks, [], []
    for number, entries in placed_shifts(listing).items():
        page = SvgPage(gores / listing["pages"][number - 1])
        for entry in entries:
            for row in entry["targets"]:
                circles = page.circles[f"target-{row['id']}"]
                # the four rings stand around the target's middle
                on_page = np.concatenate([[circles[:, :2].mean(axis=0)], circles[:: len(circles) // 4, :2]])
                flat, degrees = on_page - entry["shift_mm"], azimuth[entry["piece"]]
                points = np.array([laid_cap(p, FOCAL) if degrees is None else laid(p, np.radians(degrees), FOCAL) for p in flat])
                index = int(np.flatnonzero(pattern.ids == row["id"])[0])
                assert np.linalg.norm(points[0] - pattern.center_mm[index]) < EXACT_MM
                circle_errors.append(np.linalg.norm(points[1:] - marks.center_mm[marks.target == index], axis=1).max())
                seen.append(index)
    assert sorted(seen) == list(range(len(pattern)))
    # 0.2 % of the 10 mm from a target's middle to its rings
    assert max(circle_errors) < 0.02 < LAID_MM


def test_the_strain_that_is_stated_is_that_of_the_paper(gores: Path) -> None:
    pattern, listing = read_pattern(gores / "pattern.json"), json.loads((gores / "sheets.json").read_text())
    azimuth = {piece["name"]: piece["azimuth_deg"] for piece in listing["pieces"]}
    reach, step, compared = float(ink_places(pattern)[1].max()), 0.05, 0
    for entry in listing["placed"]:
        for row in entry["targets"][:1]:
            flat = np.array(row["at_mm"]) - entry["shift_mm"]
            degrees = azimuth[entry["piece"]]
            if degrees is None:
                continue
            worst = flat + [np.copysign(reach, flat[0]), 0.0]
            for direction, wanted in (((0.0, step), 1 - row["strain"]), ((step, 0.0), 1.0)):
                ends = [laid(worst + sign * np.array(direction), np.radians(degrees), FOCAL) for sign in (1, -1)]
                # the length over 0.1 mm is known to 1e-8
                assert float(np.linalg.norm(ends[0] - ends[1])) / (2 * step) == pytest.approx(wanted, abs=2e-6)
            assert 0 < row["strain"] < 0.002
            compared += 1
    assert compared > 30


@pytest.mark.parametrize(
    ("pattern", "limit"),
    [
        (dish(600, 300, kind=multi_circular(), orientation_marks=True), 0.002),
        (dish(600, 300), 0.004),
        (dish(300, 150, spacing_mm=20, kind=disc(4.0)), 0.002),
        (dish(300, 90, spacing_mm=25, kind=disc(3.0), center_target=False), 0.003),
        (dish(1000, 4000, spacing_mm=60), 0.002),
    ],
)
def test_gores_keep_the_limit_and_cut_no_target(pattern: Pattern, limit: float) -> None:
    pieces = dish_pieces(pattern, limit)
    assert sorted(np.concatenate([piece.target for piece in pieces]).tolist()) == list(range(len(pattern)))
    assert max(piece.strain for piece in pieces) <= limit
    assert cut_targets(pieces) == []
    for piece in pieces:
        assert piece.outline_mm is not None
        around = np.linspace(0, 2 * np.pi, 60)
        circle = np.stack([np.cos(around), np.sin(around)], axis=1)
        for x, y, radius in piece.keep_mm:
            assert inside(np.array([x, y]) + radius * circle, piece.outline_mm).all()


def test_gores_cover_the_dish_once() -> None:
    pattern = dish(600, 300)
    pieces = dish_pieces(pattern, 0.004)
    rng = np.random.default_rng(1)
    # no gore of this dish is without a target, so that all of it is covered
    radius, angle = 299.5 * np.sqrt(rng.uniform(size=4000)), rng.uniform(0, 2 * np.pi, 4000)
    xy = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    holding = np.zeros(len(xy), dtype=int)
    for piece in pieces:
        # a gore's own part of the dish only: far from it no paper can be laid
        if isinstance(piece.map, AlongMeridian):
            turn = np.angle(np.exp(1j * (angle - piece.map.azimuth_rad)))
            near = np.abs(turn) < 0.6
        else:
            near = radius < 200
        holding[np.flatnonzero(near)[inside(piece.map.to_flat(xy[near]), piece.outline_mm)]] += 1
    # chords of 2 mm along curved edges leave or share slivers of 5 micrometres
    assert (holding == 1).mean() > 0.998


def scattered(seed: int) -> Pattern:
    """Targets all over a dish, without circles or meridians that are free of them."""
    rng = np.random.default_rng(seed)
    kind, xy = disc(6.0), np.zeros((0, 2))
    for point in rng.uniform(-150, 150, (4000, 2)):
        if np.hypot(*point) < 143 and (not len(xy) or np.linalg.norm(xy - point, axis=1).min() > 17):
            xy = np.vstack([xy, point])
    surface, n = Surface("paraboloid", 300.0, 300.0), len(xy)
    normal = surface.normal(xy)
    x_axis = np.cross([0.0, 1.0, 0.0], normal)
    x_axis /= np.linalg.norm(x_axis, axis=1, keepdims=True)
    center = np.column_stack([xy, surface.height_mm(xy)])
    return Pattern("scattered", surface, {"disc": kind}, np.arange(n), ("disc",) * n, center, x_axis, normal)


def test_targets_that_an_edge_cannot_avoid_are_whole_and_said(tmp_path: Path) -> None:
    pattern = scattered(3)
    write_pattern(tmp_path / "scattered.json", pattern)
    done = dishmap("sheet", tmp_path / "scattered.json", "--largest-strain-percent", 0.1, "--out", tmp_path / "out")
    assert done.exit_code == 0, (done.output, done.stderr, done.exception)
    cut = cut_targets(dish_pieces(pattern, 0.001))
    assert f"{len(cut)} target" in done.stdout
    assert 0 < len(cut) < len(pattern) / 4
    listing = json.loads((tmp_path / "out" / "sheets.json").read_text())
    printed = [name for page in listing["pages"] for name in SvgPage(tmp_path / "out" / page).circles]
    assert sorted(printed) == sorted(f"target-{k}" for k in pattern.ids)


@needs_poppler
def test_rendered_gores_measure_as_the_list_says(tmp_path: Path) -> None:
    out, dpi = tmp_path / "out", 400
    done = dishmap("sheet", "dish", "--diameter-mm", 200, "--focal-length-mm", 260, "--spacing-mm", 40, "--out", out)
    assert done.exit_code == 0, (done.output, done.stderr, done.exception)
    pattern, listing = read_pattern(out / "pattern.json"), json.loads((out / "sheets.json").read_text())
    images, compared = rendered(out / "sheets.pdf", dpi), 0
    for number, entries in placed_shifts(listing).items():
        found = find_ellipses(images[number - 1])
        at, size = on_paper_mm(found.center_px, dpi, listing["paper_mm"][1]), np.sqrt(found.semi_axes_px.prod(axis=1)) * 25.4 / dpi
        for row in (row for entry in entries for row in entry["targets"]):
            kind, angle = pattern.kind_of(int(row["id"])), np.radians(row["angle_deg"])
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            for dark in (True, False):
                tree = np.flatnonzero((found.dark == dark) & (size > 2))
                off, index = cKDTree(at[tree]).query(row["at_mm"] + kind.center_mm[kind.dark == dark] @ turn.T)
                assert off.max() < 0.02
                assert np.abs(size[tree[index]] - kind.radius_mm[kind.dark == dark]).max() < 0.02
            compared += 1
    assert compared == len(pattern)


def test_a_printed_dish_with_orientation_marks_needs_no_hint(gores: Path) -> None:
    from dishmap.camera.model import Camera
    from dishmap.simulate.render import simulate
    from dishmap.simulate.scene import Scene, facing_pose

    pattern = read_pattern(gores / "pattern.json")
    camera = Camera(1600, 1600, focal_px=[1500.0, 1500.0], principal_px=[799.5, 799.5])
    shot = simulate(Scene(pattern, camera, facing_pose(750.0, 0.1, 0.4)), np.random.default_rng(5))
    identity = identify(find_ellipses(shot.image), pattern, camera)
    assert identity.residual_px.max() < 2.0
    assert len(np.unique(pattern.marks.target[identity.mark])) > 0.95 * len(pattern)


@pytest.mark.parametrize("focal", [80.0, 300.0, 5000.0])
def test_maps_and_their_inverses(focal: float) -> None:
    rng = np.random.default_rng(2)
    flat = np.column_stack([rng.uniform(-60, 60, 40), rng.uniform(40, 200, 40)])
    for surface in (AlongMeridian(focal, 0.7), AroundVertex(focal)):
        assert np.abs(surface.to_flat(surface.to_surface(flat)) - flat).max() < 1e-6
        x, y = surface.axes(flat)
        assert np.abs((x * y).sum(axis=1)).max() < 1e-9
        normal = Surface("paraboloid", None, focal).normal(surface.to_surface(flat))
        assert np.abs(np.cross(x, y) - normal).max() < 1e-6
    way = meridian_mm(np.array([0.0, 50.0, 200.0]), focal)
    assert way.tolist() == pytest.approx([way_mm(r, focal) for r in (0.0, 50.0, 200.0)], abs=1e-8)
    assert radius_mm(way, focal).tolist() == pytest.approx([0.0, 50.0, 200.0], abs=1e-8)


def test_targets_too_large_for_the_dish_are_refused() -> None:
    with pytest.raises(PatternError, match=r"a target of radius 14.9 mm shrinks by .* take smaller targets, or allow"):
        dish_pieces(dish(300, 60), 0.002)
    with pytest.raises(PatternError, match="a plane"):
        dish_pieces(scattered_plane(), 0.002)


def scattered_plane() -> Pattern:
    from dishmap.targets.builders import plate

    return plate(2, 2, 40.0)
