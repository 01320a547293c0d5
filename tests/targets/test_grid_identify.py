"""Nodes of a grid are named, or refused with the ways that remain: on exact lattices through a camera, and on simulated photographs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dishmap.camera.model import Camera
from dishmap.errors import IdentityError, InputError
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Disc, Glare, Light, Scene, Sensor, facing_pose, random_line_gaps
from dishmap.targets.builders import plate
from dishmap.targets.detect import find_ellipses
from dishmap.targets.grid_builders import grid
from dishmap.targets.grid_detect import GridDetections, find_grid
from dishmap.targets.grid_identify import identify_grid
from dishmap.targets.grid_ways import is_marked
from dishmap.targets.identify import Anchors, Hint, PoseGuess, Upright, identify
from dishmap.targets.pattern import Pattern, Surface
from dishmap.transforms import Pose, rotation_from_vector
from tests.grids import camera, look

PITCH = 12.0
RECTANGLE = grid(14, 11, PITCH, line_width_mm=1.0)
MARKED = grid(14, 11, PITCH, line_width_mm=1.0, orientation_marks=True)
POSE = look(20.0, 40.0, 15.0, 300.0)


def seen(pattern: Pattern, pose: Pose, keep: np.ndarray | None = None, quarter: int = 1, shown: Camera | None = None) -> GridDetections:
    """What an exact search would give: nodes of the kept targets in a lattice turned by quarter turns and shifted."""
    eye = shown or camera()
    assert pattern.lattice is not None
    keep = np.arange(len(pattern)) if keep is None else keep
    place = eye.project(pose.apply(pattern.center_mm))
    turn = np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), quarter)
    lattice = pattern.lattice @ turn.T + [40, -7]
    # steps by differences along the surface
    axes, ahead = pattern.axes, 1e-3
    columns, rows = ((eye.project(pose.apply(pattern.center_mm + ahead * axes[..., k])) - place) / ahead * PITCH for k in (0, 1))
    step = np.stack([columns, rows], axis=-1) @ np.linalg.inv(turn)
    cells = np.array([np.floor(turn @ (at + 0.5) + [40, -7]) for at in pattern.lattice[keep][is_marked(pattern)[keep]]], dtype=np.int64)
    cells = np.column_stack([np.zeros(len(cells), dtype=np.int64), cells.reshape(-1, 2)])
    zeros = np.zeros(len(keep), dtype=np.int64)
    return GridDetections(place[keep], lattice[keep], zeros, step[keep], zeros.astype(bool), cells, True)


def named(pattern: Pattern, found: GridDetections, pose: Pose, hint: Hint = None, shown: Camera | None = None) -> int:
    """How many nodes are named; all must be right."""
    identity = identify_grid(found, pattern, shown or camera(), hint)
    true = (shown or camera()).project(pose.apply(pattern.center_mm))[identity.index]
    np.testing.assert_allclose(found.place_px[identity.detection], true, atol=1e-6)
    return len(identity.index)


@pytest.mark.parametrize("quarter", range(4))
def test_marks_leave_one_way_whatever_the_walks_frame(quarter: int) -> None:
    assert named(MARKED, seen(MARKED, POSE, quarter=quarter), POSE) == len(MARKED)


def test_the_pose_is_exact_on_exact_places() -> None:
    identity = identify_grid(seen(MARKED, POSE), MARKED, camera())
    assert np.abs(identity.camera_from_dish.translation_mm - POSE.translation_mm).max() < 1e-4
    assert identity.residual_px.max() < 1e-4
    assert all(other.deficit >= 3 for other in identity.alternatives)


def test_upright_settles_half_a_turn_of_a_whole_grid() -> None:
    found = seen(RECTANGLE, POSE)
    with pytest.raises(IdentityError, match=r"could lie in 2 ways .* looks the same after half a turn: turned by -15 degrees .* --upright"):
        identify_grid(found, RECTANGLE, camera())
    assert named(RECTANGLE, found, POSE, Upright()) == len(RECTANGLE)
    with pytest.raises(IdentityError, match="was found, but not upright"):
        identify_grid(found, RECTANGLE, camera(), Upright(90.0))


def test_a_square_grid_looks_the_same_after_quarter_turns() -> None:
    square = grid(9, 9, PITCH, line_width_mm=1.0)
    with pytest.raises(IdentityError, match=r"4 ways .* since it looks the same after quarter turns: "):
        identify_grid(seen(square, POSE), square, camera())


def part_of(pattern: Pattern) -> np.ndarray:
    assert pattern.lattice is not None
    return np.flatnonzero((pattern.lattice[:, 0] >= 2) & (pattern.lattice[:, 0] < 12))


def test_a_part_needs_an_anchor() -> None:
    keep = part_of(RECTANGLE)
    found = seen(RECTANGLE, POSE, keep)
    place = camera().project(POSE.apply(RECTANGLE.center_mm))
    with pytest.raises(IdentityError, match=r"5 ways .* same when shifted: .*columns 2 to 11 and rows 0 to 10 in view.* --anchor ID@U,V"):
        identify_grid(found, RECTANGLE, camera(), Upright())
    at = place[keep[50]] + 0.4 * found.step_px[50] @ [1, -1]
    ident = int(RECTANGLE.ids[keep[50]])
    assert named(RECTANGLE, found, POSE, Anchors((ident,), at, Upright())) == len(keep)
    # two that are not in line tell turns too
    ids = RECTANGLE.ids[keep[[0, 57]]]
    assert named(RECTANGLE, found, POSE, Anchors(tuple(ids), place[keep[[0, 57]]])) == len(keep)


def test_anchors_that_cannot_be_are_refused() -> None:
    found, place = seen(RECTANGLE, POSE), camera().project(POSE.apply(RECTANGLE.center_mm))
    with pytest.raises(InputError, match=r"the anchor 999 is no target of .*; its ids are 0 to 153"):
        identify_grid(found, RECTANGLE, camera(), Anchors((999,), place[:1]))
    with pytest.raises(IdentityError, match=r"the anchor 3 at \(-500, 20\) px lies off the nodes found"):
        identify_grid(found, RECTANGLE, camera(), Anchors((3,), np.array([[-500.0, 20.0]])))
    with pytest.raises(IdentityError, match="in no way that has all anchors within half a step"):
        identify_grid(found, RECTANGLE, camera(), Anchors((3,), place[60:61]))
    with pytest.raises(InputError, match="as many ids as places"):
        Anchors((1, 2), place[:1])
    with pytest.raises(InputError, match="anchors name targets of a grid, and 'plate"):
        identify(find_ellipses(np.zeros((9, 9), dtype=np.uint8)), plate(5, 6, 45.0), camera(), Anchors((1,), place[:1]))


def test_a_pose_guess_takes_the_nearest_shift_only_if_it_is_clearly_nearest() -> None:
    keep = part_of(RECTANGLE)
    found = seen(RECTANGLE, POSE, keep)

    def guess(steps: float) -> PoseGuess:
        return PoseGuess(Pose(POSE.rotation, POSE.translation_mm + POSE.rotation @ np.array([steps * PITCH, 0.0, 0.0])))

    assert named(RECTANGLE, found, POSE, guess(0.2)) == len(keep)
    with pytest.raises(IdentityError, match=r"2 ways .*; give a closer --pose-guess"):
        identify_grid(found, RECTANGLE, camera(), guess(0.4))
    turned = PoseGuess(Pose(rotation_from_vector([0.0, 0.0, 1.5]) @ POSE.rotation, POSE.translation_mm))
    with pytest.raises(IdentityError, match="not within 20 degrees and 100 mm of the pose guess"):
        identify_grid(found, RECTANGLE, camera(), turned)


def test_nodes_in_line_beyond_the_border_do_not_shift_the_rest() -> None:
    larger = grid(15, 11, PITCH, line_width_mm=1.0)
    assert larger.lattice is not None
    # of the larger grid's last column two nodes: strays, as it were, beyond a grid of 14 columns
    keep = np.flatnonzero((larger.lattice[:, 0] < 14) | np.isin(larger.lattice[:, 1], (3, 4)))
    identity = identify_grid(seen(larger, POSE, keep), RECTANGLE, camera(), Upright())
    assert len(identity.index) == len(RECTANGLE)
    assert {r.reason for r in identity.rejected} == {"it lies in line with the grid, but beyond its border"}


def test_another_pattern_is_refused() -> None:
    with pytest.raises(IdentityError, match=r"154 nodes of a lattice of 11 x 14, which do not fit on the grid .* of 8 x 8"):
        identify_grid(seen(RECTANGLE, POSE), grid(8, 8, PITCH, line_width_mm=1.0), camera())
    found = seen(MARKED, POSE, quarter=0)
    mirrored = replace(
        found,
        lattice=found.lattice * [-1, 1],
        cell_marked=found.cell_marked * [1, -1, 1] - [0, 1, 0],
        step_px=found.step_px * [-1.0, 1.0],
    )
    with pytest.raises(IdentityError, match=r"orientation marks contradict .*; they fit when it is mirrored"):
        identify_grid(mirrored, MARKED, camera())
    with pytest.raises(InputError, match="must both be of lines or both of squares"):
        identify_grid(found, grid(14, 11, PITCH, square_mm=5.0), camera())
    with pytest.raises(InputError, match="made of circles, not a grid"):
        identify_grid(found, plate(5, 6, 45.0), camera())


def test_a_further_part_is_joined_only_where_it_is_clear() -> None:
    assert MARKED.lattice is not None
    found = seen(MARKED, POSE)
    column = MARKED.lattice[:, 0]
    second = np.flatnonzero(column > 9)
    component = np.where(column > 9, 1, 0)
    # the middle is hidden; the second part was walked in a frame of its own
    kept = np.flatnonzero((column < 7) | (column > 9))
    lattice = found.lattice.copy()
    lattice[second] += [5, 3]
    cells = found.cell_marked.copy()
    there = (cells[:, None, 1:] == found.lattice[second]).all(axis=2).any(axis=1)
    cells[there] += [1, 5, 3]
    parts = GridDetections(
        found.place_px[kept], lattice[kept], component[kept], found.step_px[kept], found.marked[kept], cells, found.lines
    )
    assert named(MARKED, parts, POSE) == len(kept)
    # a part that lies off by half a step belongs to nothing
    moved = parts.place_px + 0.5 * parts.step_px[..., 0] * (parts.component == 1)[:, None]
    identity = identify_grid(replace(parts, place_px=moved), MARKED, camera())
    assert len(identity.index) == int((parts.component == 0).sum())
    assert {r.reason for r in identity.rejected} == {"it belongs to a part of the grid that no prediction joins to the rest"}


@pytest.mark.parametrize(("lines", "surface"), [(True, "paraboloid"), (False, "cylinder")])
def test_photographs_of_bent_grids_are_named(lines: bool, surface: str) -> None:
    """Broken lines, glare, something in front; on the cylinder the pattern is given flat, as it was before it was wrapped."""
    rng = np.random.default_rng(8)
    eye = camera(800, 600, 640.0)
    bent = Surface("cylinder", radius_mm=110.0) if surface == "cylinder" else Surface(surface, diameter_mm=220.0, focal_length_mm=110.0)
    ink = {"line_width_mm": 1.0} if lines else {"square_mm": 5.0}
    shown = grid(16, 14, PITCH, surface=bent, orientation_marks=True, **ink)
    given = grid(16, 14, PITCH, orientation_marks=True, **ink) if surface == "cylinder" else shown
    spin = Pose(rotation_from_vector([0.0, 0.0, 2.0]), np.zeros(3))
    scene = Scene(
        shown,
        eye,
        spin @ facing_pose(260.0, 0.25, 1.0),
        light=Light(gradient=(0.3, -0.2), glare=(Glare((300.0, 200.0), 40.0, 300.0),)),
        sensor=Sensor(0.9, noise_grey=2.0),
        line_gaps=random_line_gaps(rng, shown, 0.15) if lines else (),
        occluders=(Disc((500.0, 380.0), 30.0, 60.0),),
    )
    picture = simulate(scene, rng)
    found = find_grid(picture.image, lines)
    identity = identify_grid(found, given, eye)
    off = found.place_px[identity.detection] - picture.truth.center_px[identity.index]
    away = np.linalg.solve(found.step_px[identity.detection], off[..., None])[..., 0]
    # the next target lies a whole step away
    assert np.linalg.norm(away, axis=1).max() < 0.3
    whole = np.flatnonzero(picture.truth.visible_fraction > 0.98)
    assert np.isin(whole, identity.index).mean() > 0.93
