"""Name the detected circles: which mark of the pattern is which ellipse, and from where the camera looks.

A wrong name is worse than a missing one. The pattern is placed once, by constellations of neighbours and growth; then every
turn or shift of the pattern that explains the detections nearly as well is found in the pattern itself, and unless
the user's hint leaves exactly one of them, all are listed and none is chosen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.camera.model import Camera
from dishmap.errors import IdentityError, InputError
from dishmap.targets.candidates import Candidates, mark_candidates
from dishmap.targets.detect import Detections
from dishmap.targets.ellipses import root_det
from dishmap.targets.growth import Embedding, Scene, clashes, fit_pose, grow, is_clean, misfit_of, misfit_part, strangers
from dishmap.targets.layout import Layout, layout_of
from dishmap.targets.pattern import Pattern
from dishmap.targets.rivals import Observations, Rivals, find_rivals, observe
from dishmap.targets.search import find_placement, rest_of, scene_of, seen_targets, worth
from dishmap.transforms import Pose

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# A placement beats another when it explains at least this many more observations (marks seen, or marks not contradicted), where
# one that lies exactly in its place counts for more (rivals.EXACT_WEIGHT): a stray circle of the right size in the
# right place must not decide.
DECISIVE = 3
# ... or when both explain the same, and the other leaves residuals this many times larger, over enough marks.
DECISIVE_MISFIT, FEWEST_FOR_MISFIT = 3.0, 8
# Rivals whose marks meet only roughly are grown in the image to see what they explain; so many at most.
ROUGH_MISFIT, MOST_REGROWN = 0.04, 6
MOST_CHANGES = 4
# Rivals that are looked at in full when they explain as much, and how many that do not are reported as ruled out; options that
# agree on this part of their marks are one.
MOST_OPTIONS, RULED_OUT_LISTED = 24, 3
SAME_PART = 0.5
# What the hints promise.
UPRIGHT_RAD = np.radians(45.0)
GUESS_TURN_RAD, GUESS_SHIFT_MM = np.radians(20.0), 100.0
# Room for poses that are not refined yet.
ROOM = 1.4
# The rotation camera_from_dish of a camera that looks straight at an upright pattern.
UPSIDE = np.diag([1.0, -1.0, -1.0])
# A find has at least this part of the targets that should be in view, this part of marks with all that is printed in them, not
# more than this part of look-alikes among its marks that fit nowhere, and circles of the printed size to this part (and px: ink
# spread and threshold).
LEAST_SEEN_PART, LEAST_WHOLE_PART, LARGEST_STRANGE_PART = 0.25, 0.5, 0.25
SIZE_TOLERANCE, SIZE_TOLERANCE_PX = 0.15, 0.7
# Marks off the places that their neighbours give them (as a part of the spacing, in the median), or off any bent surface (as a
# part of the distance between targets), by more than this were printed at other distances; the first only if a bent surface
# leaves more than the numbers behind it, since a strong bend shows there too.
LARGEST_OFF, CLEARLY_CLEAN, CLEARLY_CLEAN_PX = 0.04, 0.005, 0.4
# Places that show a mark of another type, more than a few and this part of the matches, are a wrong or mirrored pattern; two are
# if one of them has more printed in it than expected, which neither blur nor glare explains.
FEW_CLASHES, LARGEST_CLASH_PART = 3, 0.05
LISTED_POSES = 12
# A rejected circle is put down to a mark within this part of the spacing, and its size is named beyond this ratio.
NEAR_SPACING, ODD_SIZE = 0.5, 1.2
# A placement needs this many marks; a further copy also this part of the first one's.
FEWEST_MARKS = 4
COPY_PART = 0.3
MOST_COPIES = 4


@dataclass(frozen=True)
class Upright:
    """Hint: the camera looks along the pattern's -z with the pattern's y up in the image, turned by less than 45 degrees.

    turn_deg: how far clockwise the image is turned before it is looked at, as EXIF may ask (`read_turn_deg`).
    """

    turn_deg: float = 0.0

    def off_rad(self, roll_rad: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """How far rolls (see `roll_rad`) of any shape are from this."""
        return np.asarray(np.abs((roll_rad - np.radians(self.turn_deg) + np.pi) % (2 * np.pi) - np.pi))


@dataclass(frozen=True)
class PoseGuess:
    """Hint: the pose of the pattern, right to some degrees and centimetres (within 20 degrees and 100 mm)."""

    camera_from_dish: Pose


@dataclass(frozen=True)
class Anchors:
    """Hint, for grids: where some targets are in the photograph, within half of the distance to the next one.

    ids (A,); place_px (A, 2); upright: also that the camera looks so, or None.
    """

    ids: tuple[int, ...]
    place_px: Array
    upright: Upright | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "ids", tuple(int(i) for i in self.ids))
        object.__setattr__(self, "place_px", np.asarray(self.place_px, dtype=float).reshape(-1, 2))
        if not self.ids or len(self.ids) != len(self.place_px) or not np.isfinite(self.place_px).all():
            raise InputError(f"anchors need as many ids as places (u, v) in px, at least one, not {len(self.ids)} and {len(self.place_px)}")


Hint = Upright | PoseGuess | Anchors | None


@dataclass(frozen=True)
class Alternative:
    """A pose in which the pattern could sit too, and by how many observations it explains less."""

    camera_from_dish: Pose
    deficit: float


@dataclass(frozen=True)
class Rejection:
    """A detection that could be a mark but is not used, and why."""

    detection: int
    reason: str


@dataclass(frozen=True)
class Identity:
    """The pattern found in an image.

    camera_from_dish: robust rigid fit (a deformed surface follows it only roughly); mark (K,): indices into pattern.marks;
    detection (K,): the ellipse that each is; residual_px (K,): distance from where the rigid pose puts the mark; alternatives:
    next best placements that were ruled out; unmatched: number of detections that look like marks but are none;
    rejected: these with reasons.
    """

    camera_from_dish: Pose
    mark: Index
    detection: Index
    residual_px: Array
    alternatives: tuple[Alternative, ...]
    unmatched: int
    rejected: tuple[Rejection, ...]


@dataclass(frozen=True)
class _Option:
    """One way the pattern could sit: where it was searched, the placement it was made from, its pose and its pairs."""

    scene: Scene
    placement: Embedding
    pose: Pose
    pairs: tuple[Index, Index]
    deficit: float


def identify(detections: Detections, pattern: Pattern, camera: Camera, hint: Hint = None) -> Identity:
    """Find the pattern among detected ellipses.

    hint: None, Upright() or PoseGuess(camera_from_dish). Raises IdentityError when the pattern is not found, or could
    sit in more than one way that the hint does not tell apart; the message lists these ways. Raises InputError for Anchors.
    """
    if isinstance(hint, Anchors):
        raise InputError(f"anchors name targets of a grid, and {pattern.name!r} is made of circles; give --upright or a --pose-guess")
    candidates = mark_candidates(detections, pattern.marks, camera)
    _check_enough(detections, candidates, pattern)
    scene = scene_of(candidates, layout_of(pattern), camera)
    options: list[_Option] = []
    sound: list[Embedding] = []
    least = FEWEST_MARKS
    for _ in range(MOST_COPIES):
        placement = find_placement(scene, least)
        if placement is None:
            break
        found = _options(scene, placement, hint)
        problem = _problem(scene, pattern, found[0].placement)
        if problem and not options:
            raise IdentityError(problem)
        if not problem:
            options += found
            sound.append(found[0].placement)
        least = max(least, int(np.ceil(COPY_PART * found[0].placement.count)))
        scene = rest_of(scene, found[0].placement)
    if not options:
        raise IdentityError(
            f"the pattern {pattern.name!r} was not found among {len(candidates)} circles that look like its marks; "
            "check that pattern and camera belong to this photograph and that several neighbouring targets are in view"
        )
    chosen = _chosen([o for o in options if o.deficit < DECISIVE], hint, pattern, len(sound))
    final = _settled(chosen)
    problem = None if any(final is placement for placement in sound) else _problem(chosen.scene, pattern, final)
    if problem:
        raise IdentityError(problem)
    others = [Alternative(o.pose, o.deficit) for o in options if o is not chosen]
    return _identity(chosen.scene, final, others)


def _check_enough(detections: Detections, candidates: Candidates, pattern: Pattern) -> None:
    usable = int(candidates.is_type.any(axis=1).sum())
    if usable < FEWEST_MARKS:
        raise IdentityError(
            f"only {usable} of {len(detections)} ellipses in the image look like marks of the pattern {pattern.name!r}, and at least "
            f"{FEWEST_MARKS} are needed; check focus, exposure and that this is the printed pattern"
        )


def _options(scene: Scene, placement: Embedding, hint: Hint) -> list[_Option]:
    """The placement or a better rival of it first, then its rivals with their deficits against it."""
    for change in range(MOST_CHANGES + 1):
        seen = observe(scene, placement)
        prefer = partial(_about_agree, placement.fit.pose, hint)
        rivals = find_rivals(scene, placement, seen, prefer)
        order = np.argsort(rivals.cost[1:], kind="stable") + 1
        best = int(order[0]) if len(order) else 0
        moved = _moved(scene, placement, seen, rivals, best) if rivals.cost[best] < rivals.cost[0] else None
        clean = is_clean(scene.layout, placement)
        rough = [] if moved is not None or clean else _regrown(scene, placement, seen, rivals, order)
        moved = max([e for e in (moved, *rough) if e is not None], key=worth, default=None)
        if moved is None or worth(moved) <= worth(placement) or change == MOST_CHANGES:
            break
        placement = moved
    options = [_Option(scene, placement, placement.fit.pose, _pairs(placement), 0.0)]
    options += [_rough_option(scene, placement, other) for other in rough]
    exact = [int(h) for h in order if clean or not _is_rough(rivals, int(h))]
    close = [h for h in exact if rivals.cost[h] - rivals.cost[0] < DECISIVE]
    # those that the hint allows first: none of them may be overlooked
    allowed = prefer(rivals.rotation, rivals.shift_mm)
    kept = sorted(close, key=lambda h: not allowed[h])[:MOST_OPTIONS]
    for h in kept:
        option = _exact_option(scene, placement, seen, rivals, h, float(rivals.cost[h] - rivals.cost[0]))
        options += [option] if option is not None else []
    for h in [h for h in exact if h not in close][:RULED_OUT_LISTED]:
        pose = placement.fit.pose @ rivals.motion(h).inverse()
        options.append(_Option(scene, placement, pose, _relabelled(seen, rivals, h), float(rivals.cost[h] - rivals.cost[0])))
    return _distinct(options, scene.layout)


def _is_rough(rivals: Rivals, h: int) -> bool:
    return bool(rivals.misfit[h] > ROUGH_MISFIT)


def _regrown(scene: Scene, placement: Embedding, seen: Observations, rivals: Rivals, order: Index) -> list[Embedding]:
    """Rivals that carry marks only near marks: grown in the image, since a bent surface could make up for the difference."""
    chosen = [int(h) for h in order if _is_rough(rivals, int(h))][:MOST_REGROWN]
    grown = [_moved(scene, placement, seen, rivals, h) for h in chosen]
    return [e for e in grown if e is not None and e.count >= FEWEST_MARKS]


def _distinct(options: list[_Option], layout: Layout) -> list[_Option]:
    """Options without those that name the same candidates in the same way as an earlier one does."""
    kept: list[_Option] = []
    for option in options:
        if not any(_same(option, other, len(layout)) for other in kept):
            kept.append(option)
    return kept


def _same(a: _Option, b: _Option, marks: int) -> bool:
    first, second = np.full(marks, -1), np.full(marks, -2)
    first[a.pairs[0]], second[b.pairs[0]] = a.pairs[1], b.pairs[1]
    return int((first == second).sum()) > SAME_PART * min(len(a.pairs[0]), len(b.pairs[0]))


def _pairs(placement: Embedding) -> tuple[Index, Index]:
    marks = np.flatnonzero(placement.candidate >= 0)
    return marks, placement.candidate[marks]


def _relabelled(seen: Observations, rivals: Rivals, h: int) -> tuple[Index, Index]:
    """Marks and candidates that motion h pairs, each mark once."""
    hit = np.flatnonzero(rivals.mark[h] >= 0)
    _, first = np.unique(rivals.mark[h][hit], return_index=True)
    hit = hit[first]
    return rivals.mark[h][hit], seen.candidate[hit]


def _moved(scene: Scene, placement: Embedding, seen: Observations, rivals: Rivals, h: int) -> Embedding | None:
    """The placement grown anew from the pairs that motion h gives."""
    pose = placement.fit.pose @ rivals.motion(h).inverse()
    return grow(scene, pose, *_relabelled(seen, rivals, h))


def _exact_option(scene: Scene, placement: Embedding, seen: Observations, rivals: Rivals, h: int, deficit: float) -> _Option | None:
    """A rival that carries marks onto marks: what it explains is known without the image."""
    pairs = _relabelled(seen, rivals, h)
    match = np.full(len(scene.layout), -1)
    match[pairs[0]] = pairs[1]
    fit = fit_pose(scene, placement.fit.pose @ rivals.motion(h).inverse(), match, try_other=False)
    if fit is None:
        return None
    misfit = misfit_of(scene, fit.pose, *pairs)
    return _Option(scene, placement, fit.pose, pairs, max(deficit, _misfit_deficit(placement, misfit, len(pairs[0]))))


def _rough_option(scene: Scene, placement: Embedding, other: Embedding) -> _Option:
    deficit = max(float(placement.count - other.count), _misfit_deficit(placement, other.misfit_px, other.count))
    return _Option(scene, other, other.fit.pose, _pairs(other), deficit)


def _misfit_deficit(placement: Embedding, misfit_px: float, count: int) -> float:
    """Decisive when the rival fits its marks far worse than the placement does."""
    worse = misfit_px > DECISIVE_MISFIT * placement.misfit_px
    return float(DECISIVE) if worse and min(count, placement.count) >= FEWEST_FOR_MISFIT else 0.0


def _chosen(options: list[_Option], hint: Hint, pattern: Pattern, copies: int) -> _Option:
    """The one option that the hint allows."""
    allowed = [o for o in options if _agrees(o.pose, hint)]
    if len(allowed) == 1:
        return allowed[0]
    if not allowed:
        said = "upright" if isinstance(hint, Upright) else "where the pose guess has it"
        raise IdentityError(
            f"the pattern {pattern.name!r} was found, but not {said}: {_listing(options, hint)}; correct the hint, or turn the photograph"
        )
    many = f"{copies} copies of the pattern are in view and" if copies > 1 else "the pattern"
    ways = f"{len(allowed)} ways" if len(allowed) < MOST_OPTIONS else "very many ways"
    advice = "give --upright or a --pose-guess" if hint is None else "give a closer --pose-guess"
    raise IdentityError(
        f"{many} {pattern.name!r} could sit in {ways} that the photograph does not tell apart: {_listing(allowed, hint)}; "
        f"{advice}, show more of the pattern, or print it with orientation marks"
    )


def _agrees(pose: Pose, hint: Hint) -> bool:
    if isinstance(hint, Upright):
        return bool(hint.off_rad(roll_rad(pose)) < UPRIGHT_RAD)
    if isinstance(hint, PoseGuess):
        turn, shift = _difference(pose, hint.camera_from_dish)
        return turn < GUESS_TURN_RAD and shift < GUESS_SHIFT_MM
    return True


def _about_agree(pose: Pose, hint: Hint, rotation: Array, shift: Array) -> NDArray[np.bool_]:
    """Which motions (H, 3, 3), (H, 3) of the pattern bring a pose to about where the hint allows it."""
    turned = pose.rotation @ np.swapaxes(rotation, 1, 2)
    if isinstance(hint, Upright):
        relative = UPSIDE @ turned
        roll = np.arctan2(relative[:, 1, 0] - relative[:, 0, 1], relative[:, 0, 0] + relative[:, 1, 1])
        return hint.off_rad(roll) < ROOM * UPRIGHT_RAD
    if isinstance(hint, PoseGuess):
        moved = pose.translation_mm - (turned @ shift[:, :, None])[..., 0]
        cosine = (np.einsum("hij,ij->h", turned, hint.camera_from_dish.rotation) - 1) / 2
        far = np.linalg.norm(moved - hint.camera_from_dish.translation_mm, axis=1)
        return np.asarray((cosine > np.cos(ROOM * GUESS_TURN_RAD)) & (far < ROOM * GUESS_SHIFT_MM))
    return np.ones(len(rotation), dtype=bool)


def _difference(pose: Pose, other: Pose) -> tuple[float, float]:
    turn = np.linalg.norm((pose.inverse() @ other).rotation_vector_rad)
    return float(turn), float(np.linalg.norm(pose.translation_mm - other.translation_mm))


def roll_rad(pose: Pose) -> float:
    """Turn of the pattern about its boresight against upright, whatever its tilt, in (-pi, pi].

    The twist about z of dish_from_upright, the rest being a tilt about an axis at right angles to z (swing-twist
    decomposition): a turn of the pattern about its own z adds to it exactly.
    """
    relative = UPSIDE @ pose.rotation
    return float(np.arctan2(relative[1, 0] - relative[0, 1], relative[0, 0] + relative[1, 1]))


def _listing(options: list[_Option], hint: Hint) -> str:
    texts = []
    for option in sorted(options, key=lambda o: roll_rad(o.pose))[:LISTED_POSES]:
        x, y, z = option.pose.translation_mm
        text = f"turned by {np.degrees(roll_rad(option.pose)):+.0f} degrees about the boresight at ({x:.0f}, {y:.0f}, {z:.0f}) mm"
        if isinstance(hint, PoseGuess):
            turn, shift = _difference(option.pose, hint.camera_from_dish)
            text += f" ({np.degrees(turn):.0f} degrees and {shift:.0f} mm from the guess)"
        texts.append(text)
    more = f", and {len(options) - LISTED_POSES} more" if len(options) > LISTED_POSES else ""
    return "; ".join(texts) + more


def _settled(chosen: _Option) -> Embedding:
    """The chosen option as a placement."""
    if chosen.placement.fit.pose is chosen.pose:
        return chosen.placement
    final = grow(chosen.scene, chosen.pose, *chosen.pairs)
    return chosen.placement if final is None else final


def _problem(scene: Scene, pattern: Pattern, final: Embedding) -> str | None:
    """What is wrong when too little of the pattern was found for a find, or what was found is not as printed."""
    layout, candidates, prediction = scene.layout, scene.candidates, final.prediction
    marks, used = _pairs(final)
    name, advice = f"the pattern {pattern.name!r}", "check that it is the printed pattern"
    found, expected = seen_targets(scene, final)
    if len(marks) < FEWEST_MARKS or found < LEAST_SEEN_PART * expected:
        return f"only {found} of {expected} targets of {name} that should be in view were found; {advice}"
    whole = candidates.is_type[used, layout.type_index[marks]].mean()
    if whole < LEAST_WHOLE_PART:
        return f"{100 * (1 - whole):.0f} % of the circles found lack what {name} prints inside them; {advice}"
    scale = root_det(prediction.affine[marks])
    ratio = float(np.exp(np.median(prediction.log_ratio[marks])))
    if abs(np.log(ratio)) > np.log1p(SIZE_TOLERANCE + SIZE_TOLERANCE_PX / np.median(scale * layout.radius_mm[marks])):
        return f"circles in the places of {name} are {100 * (ratio - 1):+.0f} % off its size, compared with their distances; {advice}"
    bent, rough = misfit_part(layout, final), float(np.nanmedian(prediction.residual_mm[marks] / layout.spacing_mm[marks]))
    if bent > LARGEST_OFF or (rough > LARGEST_OFF and bent > CLEARLY_CLEAN and final.misfit_px > CLEARLY_CLEAN_PX):
        off = 100 * max(bent, rough)
        return f"circles are arranged like {name}, but their distances are off by {off:.0f} % and more; {advice}, and the camera"
    other, more = clashes(scene, prediction, final.candidate)
    if other > FEW_CLASHES + LARGEST_CLASH_PART * len(marks) or (more > 0 and other > 1):
        return (
            f"{len(marks)} circles fit {name}, but {other} of its places show a target of another kind; {advice}, and that the photograph "
            "is not mirrored"
        )
    strange = strangers(scene, prediction, final.candidate)
    if strange > 1 + LARGEST_STRANGE_PART * len(marks):
        return f"{len(marks)} circles fit {name}, but {strange} more among them look like its marks and fit nowhere; {advice}"
    return None


def _identity(scene: Scene, final: Embedding, others: list[Alternative]) -> Identity:
    candidates = scene.candidates
    marks, used = _pairs(final)
    predicted = scene.camera.project(final.fit.pose.apply(scene.layout.center_mm[marks]))
    residual = np.linalg.norm(candidates.center_px[used] - predicted, axis=1)
    left = np.setdiff1d(np.flatnonzero(candidates.is_type.any(axis=1)), used)
    reasons = _reasons(scene, final, left)
    rejected = tuple(Rejection(int(i), reason) for i, reason in zip(candidates.detection[left], reasons, strict=True))
    alternatives = tuple(sorted(others, key=lambda o: o.deficit))
    return Identity(final.fit.pose, marks, candidates.detection[used], residual, alternatives, len(left), rejected)


def _reasons(scene: Scene, final: Embedding, left: Index) -> list[str]:
    """Why each of the candidates `left` is no mark."""
    prediction, layout, candidates = final.prediction, scene.layout, scene.candidates
    seen = np.flatnonzero(np.isfinite(prediction.predicted_px).all(axis=1))
    distance, nearest = cKDTree(prediction.predicted_px[seen]).query(candidates.center_px[left])
    mark = seen[nearest]
    scale = root_det(prediction.affine[mark])
    ratio = candidates.size_px[left] / (scale * layout.radius_mm[mark] * np.exp(prediction.log_ratio[mark]))
    cases = (
        (distance > NEAR_SPACING * scale * layout.spacing_mm[mark], "no mark of the pattern is expected there"),
        (final.candidate[mark] >= 0, "the mark expected there was found beside it"),
        (~candidates.is_type[left, layout.type_index[mark]], "it looks unlike the mark expected there"),
    )
    reasons = []
    for i in range(len(left)):
        text = next((text for where, text in cases if where[i]), "")
        if not text and abs(np.log(ratio[i])) > np.log(ODD_SIZE):
            text = f"it is {100 * (ratio[i] - 1):+.0f} % off the size of the mark expected there"
        reasons.append(text or f"it lies {distance[i]:.1f} px from where its neighbours put the mark")
    return reasons
