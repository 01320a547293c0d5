from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import named_ellipses

from dishmap.camera.model import Camera
from dishmap.errors import IdentityError
from dishmap.io.camera_file import read_camera
from dishmap.io.pattern_file import read_pattern
from dishmap.io.truth_file import read_truth
from dishmap.simulate.deform import Deformation, ZernikeTerm
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Disc, Glare, Light, Scene, Sensor, random_shapes
from dishmap.targets.builders import concentric, disc, dish, multi_circular, plate, ring, whycon
from dishmap.targets.detect import Detections, find_ellipses
from dishmap.targets.ellipses import enclosing
from dishmap.targets.identify import Hint, Identity, PoseGuess, Upright, identify, roll_rad
from dishmap.targets.pattern import Pattern, Surface, TargetKind
from dishmap.transforms import Pose, angle_between_rad, rotation_from_vector

Array = NDArray[np.float64]

NARROW = Camera(1600, 1200, [1500.0, 1500.0], [801.0, 597.0])
WIDE = Camera(2000, 1500, [1000.0, 1003.0], [1003.2, 748.1], [-0.25, 0.08, 0.001, -0.0007, -0.01])
FISHEYE = Camera(1800, 1800, [760.0, 761.0], [901.0, 898.5], [0.03, -0.01, 0.003, -0.0005], "fisheye")
UP = np.diag([1.0, -1.0, -1.0])
# What the hints are said to stand: their own limits are twice as wide.
GUESS_TURN_RAD, GUESS_SHIFT_MM = np.radians(10.0), 50.0
# Ellipses of the helper are 0.2 px off; of a hundred marks the pose is far better than this.
POSE_TURN_RAD, POSE_SHIFT_PART = np.radians(1.0), 0.01
# A name is right when the ellipse lies nearer to its mark than half of the mark's radius.
NEAR_RADIUS = 0.5
# A stray circle this far from a hidden mark, in radii, is beside it.
BESIDE_RADII = 0.8


def looking(pattern: Pattern, camera: Camera, roll: float = 0.1, tilt: float = 0.3, fill: float = 0.75) -> Scene:
    """A camera that sees all of a pattern, turned by `roll` about the boresight and tilted."""
    size = float(np.linalg.norm(pattern.center_mm[:, :2], axis=1).max())
    half = 0.5 * min(camera.width_px, camera.height_px) * fill
    edge = camera.unproject(camera.principal_px + [half, 0.0])
    distance = max(size * edge[2] / edge[0], 0.5 * size)
    rotation = UP @ rotation_from_vector([tilt, 0.4 * tilt, 0.0]) @ rotation_from_vector([0.0, 0.0, roll])
    middle = np.array([0.0, 0.0, pattern.center_mm[:, 2].mean()])
    return Scene(pattern, camera, Pose(rotation, np.array([0.01, -0.02, 1.0]) * distance - rotation @ middle))


@dataclass(frozen=True)
class Seen:
    """Ellipses of a scene, and the ellipse that each mark truly is."""

    detections: Detections
    truth: dict[int, int]


def see(scene: Scene, hidden: Iterable[int] = (), seed: int = 3) -> Seen:
    """Every circle of the targets that are not hidden, as far as it lies in the image."""
    hidden = set(hidden)
    shown = [t for t in range(len(scene.pattern)) if t not in hidden]
    detections, identity = named_ellipses(scene, np.random.default_rng(seed), shown)
    inside = scene.camera.contains(detections.center_px, 3.0) & np.isfinite(detections.semi_axes_px).all(axis=1)
    return kept(Seen(detections, dict(zip(identity.mark.tolist(), identity.detection.tolist(), strict=True))), inside)


def kept(seen: Seen, keep: NDArray[np.bool_]) -> Seen:
    """The ellipses where `keep`; a circle in one that is gone keeps its place."""
    index = np.flatnonzero(keep)
    new = np.full(len(keep), -1)
    new[index] = np.arange(len(index))
    d = seen.detections
    columns = (d.center_px, d.semi_axes_px, d.angle_rad, d.dark)
    center, axes, angle, dark = (c[index] for c in columns)
    detections = Detections(center, axes, angle, dark, enclosing(center, axes, angle), d.contrast[index], d.residual_px[index])
    return Seen(detections, {m: int(new[k]) for m, k in seen.truth.items() if keep[k]})


def with_more(seen: Seen, other: Detections) -> Seen:
    """The ellipses with those of another picture behind them."""
    d = seen.detections
    parts = [np.concatenate([getattr(d, n), getattr(other, n)]) for n in ("center_px", "semi_axes_px", "angle_rad", "dark")]
    count = len(d) + len(other)
    return replace(seen, detections=Detections(*parts, enclosing(*parts[:3]), np.full(count, 100.0), np.zeros(count)))


def circles(center: Array, radius: Array, dark: bool = True) -> Detections:
    n = len(center)
    return Detections(
        center, np.stack([radius, radius], axis=1), np.zeros(n), np.full(n, dark), np.full(n, -1), np.full(n, 100.0), np.zeros(n)
    )


def check(found: Identity, seen: Seen, missing: int = 0) -> None:
    """No name is wrong, and not more than `missing` marks lack theirs."""
    wrong = {m: d for m, d in zip(found.mark.tolist(), found.detection.tolist(), strict=True) if seen.truth.get(m) != d}
    assert not wrong
    assert len(found.mark) >= len(seen.truth) - missing


def guess_near(pose: Pose, seed: int, turn_rad: float = GUESS_TURN_RAD, shift_mm: float = GUESS_SHIFT_MM) -> PoseGuess:
    turn, shift = np.random.default_rng(seed).normal(size=(2, 3))
    off = rotation_from_vector(turn_rad * turn / np.linalg.norm(turn))
    return PoseGuess(Pose(off @ pose.rotation, pose.translation_mm + shift_mm * shift / np.linalg.norm(shift)))


PATTERNS = {
    "groups": plate(5, 6, 45.0),
    "rings": plate(6, 5, 30.0, ring()),
    "discs": plate(5, 7, 25.0, disc()),
    "whycon": plate(4, 7, 30.0, whycon()),
    "concentric": plate(4, 5, 45.0, concentric()),
    "triples": plate(4, 6, 45.0, multi_circular(3)),
    "dish": dish(400.0, 200.0),
    "ring dish": dish(400.0, 180.0, 30.0, ring()),
    "marked": plate(5, 6, 40.0, ring(), orientation_marks=True),
    "marked dish": dish(400.0, 200.0, 40.0, ring(), orientation_marks=True),
}


CAMERAS = {"narrow": NARROW, "wide": WIDE, "fisheye": FISHEYE}
CASES = [(n, "narrow") for n in PATTERNS] + [(n, c) for n in ("groups", "discs", "marked dish") for c in ("wide", "fisheye")]


@pytest.mark.parametrize(("name", "lens"), CASES)
def test_every_mark_gets_its_name_with_a_hint(name: str, lens: str) -> None:
    camera = CAMERAS[lens]
    scene = looking(PATTERNS[name], camera)
    seen = see(scene)
    truth = scene.camera_from_dish
    for hint in (Upright(), guess_near(truth, 1)):
        found = identify(seen.detections, scene.pattern, camera, hint)
        check(found, seen)
        turn = float(np.linalg.norm((found.camera_from_dish @ truth.inverse()).rotation_vector_rad))
        assert turn < POSE_TURN_RAD
        assert np.linalg.norm(found.camera_from_dish.translation_mm - truth.translation_mm) < POSE_SHIFT_PART * truth.translation_mm[2]
        assert found.unmatched == 0


@given(st.floats(-np.pi, np.pi), st.floats(0, 0.8), st.integers(0, 1000))
@settings(max_examples=12)
def test_orientation_marks_need_no_hint(roll: float, tilt: float, seed: int) -> None:
    pattern = PATTERNS["marked dish" if seed % 2 else "marked"]
    scene = looking(pattern, NARROW, roll, tilt)
    seen = see(scene, seed=seed)
    found = identify(seen.detections, pattern, NARROW)
    check(found, seen)
    assert np.cos(roll_rad(found.camera_from_dish) - roll_rad(scene.camera_from_dish)) > np.cos(POSE_TURN_RAD)


@pytest.mark.parametrize(("pattern", "ways"), [(plate(5, 6, 45.0), 2), (plate(5, 5, 45.0), 4), (dish(200.0, 100.0, 40.0, ring()), 6)])
def test_symmetric_pattern_without_a_hint_is_refused_with_all_its_poses(pattern: Pattern, ways: int) -> None:
    seen = see(looking(pattern, NARROW, roll=0.1))
    with pytest.raises(IdentityError, match=f"could sit in {ways} ways that the photograph does not tell apart") as caught:
        identify(seen.detections, pattern, NARROW)
    for turn in np.degrees(0.1) + 360 / ways * np.arange(ways):
        assert f"turned by {(turn + 180) % 360 - 180:+.0f} degrees about the boresight" in str(caught.value)
    assert "--upright or a --pose-guess" in str(caught.value)


def test_upright_leaves_one_turn_or_says_which_are_left() -> None:
    pattern = dish(200.0, 100.0, 40.0, ring())
    near = see(looking(pattern, NARROW, roll=np.radians(10.0)))
    check(identify(near.detections, pattern, NARROW, Upright()), near)
    between = see(looking(pattern, NARROW, roll=np.radians(31.0)))
    with pytest.raises(IdentityError, match=r"2 ways .* turned by -29 degrees .* turned by \+31 degrees .* closer --pose-guess"):
        identify(between.detections, pattern, NARROW, Upright())


def test_hint_that_the_photograph_contradicts_is_said_so() -> None:
    pattern = PATTERNS["marked"]
    scene = looking(pattern, NARROW, roll=np.radians(100.0))
    seen = see(scene)
    with pytest.raises(IdentityError, match=r"found, but not upright: turned by \+100 degrees"):
        identify(seen.detections, pattern, NARROW, Upright())
    with pytest.raises(IdentityError, match=r"not where the pose guess has it: .* mm from the guess"):
        identify(seen.detections, pattern, NARROW, guess_near(scene.camera_from_dish, 1, shift_mm=250.0))


@pytest.mark.parametrize("hint", [Upright(), "guess"])
def test_lattice_that_could_be_shifted_is_refused(hint: Hint | str) -> None:
    pattern = plate(5, 6, 30.0, ring())
    scene = looking(pattern, NARROW)
    asked = guess_near(scene.camera_from_dish, 5) if isinstance(hint, str) else hint
    column = np.flatnonzero(pattern.center_mm[:, 0] > 70)
    with pytest.raises(IdentityError, match=r"2 ways .* show more of the pattern"):
        identify(see(scene, hidden=column).detections, pattern, NARROW, asked)
    # two marks of the column, each exactly in its place, decide
    seen = see(scene, hidden=column[2:])
    check(identify(seen.detections, pattern, NARROW, asked), seen)


def test_lattice_cut_by_the_border_is_refused() -> None:
    pattern = plate(5, 6, 30.0, ring())
    scene = looking(pattern, NARROW, roll=0.0, tilt=0.1)
    moved = replace(scene, camera_from_dish=Pose(scene.camera_from_dish.rotation, scene.camera_from_dish.translation_mm + [130.0, 0, 0]))
    seen = see(moved)
    assert 10 < len(seen.truth) < 25
    with pytest.raises(IdentityError, match="ways that the photograph does not tell apart"):
        identify(seen.detections, pattern, NARROW, Upright())


@pytest.mark.parametrize("name", ["groups", "rings", "dish", "marked"])
def test_what_is_hidden_is_not_invented(name: str) -> None:
    """A third is hidden, and a circle that looks right lies beside each hidden mark."""
    pattern = PATTERNS[name]
    scene = looking(pattern, NARROW)
    rng = np.random.default_rng(8)
    hidden = rng.permutation(len(pattern))[: len(pattern) // 4]
    seen = see(scene, hidden)
    lost = np.flatnonzero(np.isin(pattern.marks.target, hidden))[::4]
    place = NARROW.project(scene.camera_from_dish.apply(pattern.marks.center_mm[lost]))
    radius = NARROW.focal_px[0] * pattern.marks.radius_mm[lost] / scene.camera_from_dish.apply(pattern.marks.center_mm[lost])[:, 2]
    angle = rng.uniform(0, 2 * np.pi, len(lost))
    beside = place + BESIDE_RADII * radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    strays = with_more(Seen(circles(beside, radius), {}), circles(beside, 0.6 * radius, dark=False))
    found = identify(with_more(seen, strays.detections).detections, pattern, NARROW, Upright())
    check(found, seen)
    assert not np.isin(found.mark, lost).any()
    assert found.unmatched == len(found.rejected) >= 1
    assert all(r.reason for r in found.rejected)


def test_group_is_named_by_some_of_its_circles() -> None:
    scene = looking(PATTERNS["groups"], NARROW)
    seen = see(scene)
    rng = np.random.default_rng(2)
    # of each ring in three the outer circle is lost
    lost = rng.permutation(list(seen.truth.values()))[:40]
    part = kept(seen, ~np.isin(np.arange(len(seen.detections)), lost))
    assert len(part.truth) == 80
    check(identify(part.detections, scene.pattern, NARROW, Upright()), part)


def test_ring_that_lost_its_hole_must_lie_better() -> None:
    pattern = PATTERNS["rings"]
    scene = looking(pattern, NARROW)
    seen = see(scene)
    holes = np.flatnonzero(~seen.detections.dark)
    filled = kept(seen, ~np.isin(np.arange(len(seen.detections)), holes[:3]))
    check(identify(filled.detections, pattern, NARROW, Upright()), filled)
    # a whole ring may be off its neighbours' prediction by a third of its radius, one without its hole by half of that
    mark = next(m for m, d in filled.truth.items() if not (filled.detections.parent == d).any())
    for part, expected in ((0.05, True), (0.28, False)):
        center = filled.detections.center_px.copy()
        center[filled.truth[mark]] += [part * filled.detections.semi_axes_px[filled.truth[mark], 0], 0.0]
        found = identify(replace(filled.detections, center_px=center), pattern, NARROW, Upright())
        assert (mark in found.mark) == expected


def test_two_copies_are_refused_unless_the_guess_tells_them_apart() -> None:
    pattern = PATTERNS["groups"]
    pose = Pose(UP, np.array([190.0, 0.0, 1100.0]))
    first = see(Scene(pattern, NARROW, pose))
    second = see(Scene(pattern, NARROW, Pose(UP @ rotation_from_vector([0.1, 0.2, 0.2]), np.array([-190.0, 20.0, 1200.0]))))
    both = with_more(first, second.detections)
    with pytest.raises(IdentityError, match="2 copies of the pattern are in view"):
        identify(both.detections, pattern, NARROW, Upright())
    check(identify(both.detections, pattern, NARROW, guess_near(pose, 4)), first)


def test_lattice_of_a_larger_pattern_is_refused() -> None:
    seen = see(looking(plate(5, 12, 45.0), NARROW, tilt=0.1))
    with pytest.raises(IdentityError, match="ways that the photograph does not tell apart"):
        identify(seen.detections, PATTERNS["groups"], NARROW, Upright())


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (plate(5, 6, 40.0), "distances are off by .* check that it is the printed pattern|was not found among"),
        (plate(5, 6, 45.0, multi_circular(side_mm=16.0)), "distances are off by"),
        (plate(5, 6, 45.0, multi_circular(inner_radius_mm=0)), "only 0 of .* ellipses in the image look like marks"),
        (plate(5, 6, 45.0, ring()), "was not found among"),
        (plate(5, 6, 45.0, multi_circular(3)), "was not found among"),
        (dish(400.0, 200.0), "was not found among|targets of the pattern .* were found"),
    ],
)
def test_another_pattern_is_refused(wrong: Pattern, message: str) -> None:
    seen = see(looking(PATTERNS["groups"], NARROW))
    with pytest.raises(IdentityError, match=message):
        identify(seen.detections, wrong, NARROW, Upright())


@pytest.mark.parametrize("name", ["marked", "marked dish"])
def test_mirrored_photograph_is_refused(name: str) -> None:
    scene = looking(PATTERNS[name], NARROW, roll=0.4)
    d = see(scene).detections
    mirrored = replace(d, center_px=d.center_px * [-1, 1] + [NARROW.width_px - 1, 0], angle_rad=-d.angle_rad)
    with pytest.raises(IdentityError, match="check that it is the printed pattern"):
        identify(mirrored, scene.pattern, NARROW)


def test_photograph_without_the_pattern_is_refused() -> None:
    pattern = PATTERNS["discs"]
    none = circles(np.zeros((0, 2)), np.zeros(0))
    with pytest.raises(IdentityError, match=r"only 0 of 0 ellipses in the image look like marks .* at least 4 are needed"):
        identify(none, pattern, NARROW)
    rng = np.random.default_rng(1)
    strewn = circles(rng.uniform([20, 20], [1580, 1180], (80, 2)), rng.uniform(14, 16, 80))
    with pytest.raises(IdentityError, match=r"was not found among 80 circles .* check that pattern and camera belong"):
        identify(strewn, pattern, NARROW, Upright())


@pytest.mark.parametrize("size_mm", [1.0, 4.0])
def test_bent_surface_keeps_its_names(size_mm: float) -> None:
    terms = tuple(ZernikeTerm(n, m, size_mm * s) for n, m, s in ((2, 0, 1.0), (2, 2, -0.7), (3, 1, 0.5), (3, -3, 0.6)))
    for name in ("dish", "ring dish", "groups"):
        scene = replace(looking(PATTERNS[name], NARROW, tilt=0.5), deformation=Deformation(zernike=terms))
        seen = see(scene)
        check(identify(seen.detections, scene.pattern, NARROW, Upright()), seen)


def test_sheet_bent_round_keeps_its_names() -> None:
    """A lattice of 84 mm whose edges stand 12 mm, a spacing, off the plane that was printed."""
    pattern = plate(8, 8, 12.0, disc(3.0))
    bend = Deformation(zernike=(ZernikeTerm(2, 0, -6.0), ZernikeTerm(2, 2, -6.0)))
    scene = replace(looking(pattern, NARROW, tilt=0.4), deformation=bend)
    seen = see(scene)
    found = identify(seen.detections, pattern, NARROW, Upright())
    check(found, seen)
    spacing_px = 12.0 * NARROW.focal_px[0] / found.camera_from_dish.translation_mm[2]
    # no rigid pose could have named them
    assert found.residual_px.max() > 0.25 * spacing_px


def test_large_lattice_is_named_from_three_odd_dots() -> None:
    """750 dots, a part of them in view, three with a light middle."""
    xy = np.stack(np.meshgrid(np.arange(-10, 15), np.arange(-13, 17)), axis=-1).reshape(-1, 2)
    names = ["odd" if (x, y) in ((0, 0), (5, 0), (0, 3)) else "dot" for x, y in xy.tolist()]
    kinds = {"dot": disc(0.7), "odd": TargetKind([[0, 0], [0, 0]], [0.7, 0.25], [True, False])}
    n = len(xy)
    center = np.column_stack([3.5 * xy, np.zeros(n)])
    pattern = Pattern("dots", Surface(), kinds, np.arange(n), names, center, np.tile([1.0, 0, 0], (n, 1)), np.tile([0, 0, 1.0], (n, 1)))
    rotation = UP @ rotation_from_vector([0.2, -0.1, 0.0]) @ rotation_from_vector([0, 0, 2.0])
    scene = Scene(pattern, NARROW, Pose(rotation, np.array([-2.0, 6.0, 45.0])))
    seen = see(scene)
    assert 60 < len(seen.truth) < 250
    check(identify(seen.detections, pattern, NARROW), seen)
    # without them nothing tells one dot from another
    plain = kept(seen, seen.detections.dark)
    with pytest.raises(IdentityError, match="ways that the photograph does not tell apart"):
        identify(plain.detections, pattern, NARROW, Upright())


@pytest.mark.parametrize("hint", [None, Upright(), "guess"])
def test_few_dots_of_a_large_plain_lattice_are_never_named(hint: Hint | str) -> None:
    """Thousands of placements explain the dots; those that the hint allows are a few of them, and must not be overlooked."""
    pattern = plate(30, 30, 20.0, disc(5.0))
    pose = Pose(UP @ rotation_from_vector([0.2, -0.1, 0.1]), np.array([35.0, -60.0, 120.0]))
    seen = see(Scene(pattern, NARROW, pose))
    assert 10 < len(seen.truth) < 50
    with pytest.raises(IdentityError, match="ways that the photograph does not tell apart"):
        identify(seen.detections, pattern, NARROW, guess_near(pose, 3) if isinstance(hint, str) else hint)


def test_a_thousand_targets() -> None:
    pattern = plate(32, 33, 25.0, disc(), orientation_marks=True)
    camera = Camera(4608, 3456, [4000.0, 4000.0], [2303.5, 1727.5])
    seen = see(looking(pattern, camera, roll=2.0))
    check(identify(seen.detections, pattern, camera), seen)


@given(st.floats(-3, 3), st.floats(0, 1.2), st.floats(-3, 3), st.floats(-3, 3))
def test_roll_counts_turns_about_the_boresight(roll: float, tilt: float, about: float, turn: float) -> None:
    tilted = UP @ rotation_from_vector(tilt * np.array([np.cos(about), np.sin(about), 0.0]))
    pose = Pose(tilted @ rotation_from_vector([0, 0, roll]), np.zeros(3))
    assert np.exp(1j * roll_rad(pose)) == pytest.approx(np.exp(1j * roll), abs=1e-9)
    turned = Pose(pose.rotation @ rotation_from_vector([0, 0, turn]), np.zeros(3))
    assert np.exp(1j * (roll_rad(turned) - roll_rad(pose))) == pytest.approx(np.exp(1j * turn), abs=1e-9)


def test_photographs_with_clutter_glare_and_obstacles() -> None:
    """From pixels: half of the picture is clutter, an eighth of the targets is covered, glare drowns some."""
    rng = np.random.default_rng(21)
    for name in ("groups", "ring dish"):
        scene = looking(PATTERNS[name], NARROW, tilt=0.5, fill=0.7)
        centers = NARROW.project(scene.camera_from_dish.apply(scene.pattern.center_mm))
        covered = rng.permutation(len(centers))[: len(centers) // 8]
        occluders = [
            Disc((float(u), float(v)), 45.0, float(g)) for (u, v), g in zip(centers[covered], rng.uniform(0, 220, 20), strict=False)
        ]
        strays = rng.uniform([0, 0], [1600, 1200], (12, 2))
        for u, v in strays.tolist():
            occluders += [Disc((u, v), 12.0, 25.0), Disc((u, v), 7.0, 190.0)]
        light = Light(gradient=(0.9, -0.5), glare=(Glare((700.0, 500.0), 60.0, 200.0),))
        background = random_shapes(rng, NARROW, 20, 20, 20, (8, 60), (0, 200))
        scene = replace(scene, light=light, background=background, occluders=tuple(occluders), sensor=Sensor(1.0, noise_grey=2.0))
        picture = simulate(scene, rng)
        detections = find_ellipses(picture.image)
        found = identify(detections, scene.pattern, NARROW, Upright())
        marks = scene.pattern.marks
        at = scene.camera_from_dish.apply(marks.center_mm[found.mark])
        off = np.linalg.norm(detections.center_px[found.detection] - NARROW.project(at), axis=1)
        assert (off < NEAR_RADIUS * NARROW.focal_px[0] * marks.radius_mm[found.mark] / at[:, 2]).all()
        whole = picture.truth.visible_fraction > 0.99
        assert np.isin(np.flatnonzero(whole), marks.target[found.mark]).mean() > 0.97


@pytest.mark.parametrize(("name", "photographs"), [("plate", ["ref", "cur_z2.0"]), ("dish", ["ref", "cur_mixed", "cur_defocus_1.0"])])
def test_shared_renders_are_named_like_their_truth(shared_data: Path, name: str, photographs: list[str]) -> None:
    folder = shared_data / name
    pattern, camera = read_pattern(folder / "pattern.json"), read_camera(folder / "camera.yaml")
    for photograph in photographs:
        image = cv2.imread(str(folder / f"{photograph}.png"), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        detections = find_ellipses(image)
        truth = read_truth(folder / "truth.csv")[f"{photograph}.png"]
        upright = identify(detections, pattern, camera, Upright())
        for found in (upright, identify(detections, pattern, camera, guess_near(upright.camera_from_dish, 7))):
            assert len(found.mark) == len(pattern.marks.radius_mm)
            target = pattern.marks.target[found.mark]
            middle = np.stack([np.bincount(target, detections.center_px[found.detection, k]) for k in (0, 1)], axis=1) / 4
            rows = np.searchsorted(truth.ids, pattern.ids)
            assert np.abs(middle - truth.center_px[rows]).max() < 1.0
        if name == "plate":
            with pytest.raises(IdentityError, match="2 ways"):
                identify(detections, pattern, camera)
        else:
            # circles of 25, 31 and 37 targets share no turn
            assert (identify(detections, pattern, camera).mark == upright.mark).all()


def test_normals_face_the_camera() -> None:
    scene = looking(PATTERNS["dish"], WIDE, tilt=0.4)
    found = identify(see(scene).detections, scene.pattern, WIDE, Upright())
    at, normal = found.camera_from_dish.apply(scene.pattern.center_mm), found.camera_from_dish.rotate(scene.pattern.normal)
    assert (angle_between_rad(normal, -at) < np.pi / 2).all()
