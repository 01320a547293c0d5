"""Which circle of a flat board is which ellipse, with nothing known of the camera.

A mark and two of its neighbours give an affine map from board to picture near them; from there the labels grow from neighbour to
neighbour, each predicted by an affine map through the nearest labels, so that perspective and any lens are followed. A lattice of
equal circles looks the same after a shift: every other way to lay the board over what was labelled is then counted out, and unless
one of them is clearly the best, none is chosen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.camera.model import Camera
from dishmap.errors import IdentityError
from dishmap.targets.candidates import Candidates, mark_candidates
from dishmap.targets.detect import Detections
from dishmap.targets.ellipses import ellipse_matrices, invert_2x2
from dishmap.targets.pattern import Pattern

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Neighbours that are looked at around a mark and around an ellipse.
MARK_NEIGHBOURS, IMAGE_NEIGHBOURS = 8, 9
# An ellipse is where it is predicted within this part of the distance between marks, at the start and from good neighbours.
START_TOLERANCE, GROW_TOLERANCE = 0.25, 0.2
# A local map is through so many labels; the half axes of circles agree with it to this part.
LOCAL_LABELS, SIZE_TOLERANCE = 6, 0.3
# Labels that others surround (their middle is nearer than a part of the distance between marks) lie where these say, to another part.
SURROUNDED, FEWEST_INNER, FIT_TOLERANCE = 0.4, 3, 0.06
# A seed explains this part of a mark's neighbours; so many seeds are grown before the board is given up.
SEED_PART, MOST_SEEDS, SEED_ELLIPSES = 0.7, 12, 24
FEWEST_LABELS = 12
MOST_ROUNDS = 200
# Another way to lay the board must explain this many labels less: one that is hidden or stained must not decide.
DECISIVE = 3
# Two circles may be stained; more that are of another kind than the mark of their place tell of a wrong or mirrored board.
MOST_CLASHES = 2
# Ways that carry this part of the labels onto marks are grown, so many at most, and again as long as more is labelled.
MOVE_PART, MOST_MOVES, MOST_LAYINGS = 0.6, 48, 6
# Half angle of a nominal camera, for what depends on one hardly: which ellipses have what inside.
NOMINAL_FOCAL = 1.2


@dataclass(frozen=True)
class Labels:
    """Marks of the board (K,), as indices into `pattern.marks`, and the ellipse that each is (K,), as indices into the detections."""

    mark: Index
    detection: Index


def label_board(detections: Detections, pattern: Pattern, width_px: int, height_px: int) -> Labels:
    """Label the ellipses of one photograph of a flat pattern.

    Raises IdentityError when the pattern is not found or could lie in more than one way.
    """
    nominal = Camera(width_px, height_px, np.full(2, NOMINAL_FOCAL * max(width_px, height_px)), np.array([width_px - 1, height_px - 1]) / 2)
    candidates = mark_candidates(detections, pattern.marks, nominal)
    usable = np.flatnonzero(candidates.is_type.any(axis=1))
    if len(usable) < FEWEST_LABELS:
        raise IdentityError(
            f"only {len(usable)} of {len(detections)} ellipses look like marks of the board {pattern.name!r}, and at least {FEWEST_LABELS} "
            "are needed; check focus and exposure, and that this is the printed board"
        )
    board = _Board(pattern, detections, candidates.take(usable))
    match = board.best_growth()
    if (match >= 0).sum() < FEWEST_LABELS:
        raise IdentityError(
            f"the board {pattern.name!r} was not found among {len(usable)} circles that look like its marks; "
            "check that this is the printed board, and that it is not mirrored"
        )
    match = board.settled(match)
    strange = board.clashes(match)
    if strange > MOST_CLASHES:
        raise IdentityError(
            f"circles are arranged like the board {pattern.name!r}, but {strange} of them look unlike the marks of their places; check "
            "that this is the printed board, and that the photograph is not mirrored"
        )
    mark = np.flatnonzero(match >= 0)
    return Labels(mark, board.candidates.detection[match[mark]])


class _Board:
    """Marks and ellipses of one search; labels are an array with the ellipse of each mark, or -1."""

    def __init__(self, pattern: Pattern, detections: Detections, candidates: Candidates) -> None:
        marks = pattern.marks
        self.name, self.candidates = pattern.name, candidates
        self.xy, self.radius, self.type = marks.center_mm[:, :2], marks.radius_mm, marks.type_index
        self.uv, self.size, self.is_type = candidates.center_px, candidates.size_px, candidates.is_type
        half = ellipse_matrices(detections.semi_axes_px, detections.angle_rad)[candidates.detection]
        self.shape = invert_2x2(half @ np.swapaxes(half, 1, 2))
        self.tree = cKDTree(self.uv)
        count = min(MARK_NEIGHBOURS + 1, len(self.xy))
        distance, self.near = cKDTree(self.xy).query(self.xy, k=count)
        self.spacing = distance[:, 1]

    def best_growth(self) -> Index:
        """The labels that grow largest, over seeds about ellipses in the thick of things."""
        middle = np.argsort(self.tree.query(self.uv, k=min(IMAGE_NEIGHBOURS, len(self.uv)))[0][:, -1])
        chosen = middle[np.linspace(0, len(middle) - 1, min(SEED_ELLIPSES, len(middle))).astype(int)]
        best, grown = np.full(len(self.xy), -1), 0
        enough = min(len(self.xy), len(self.uv))
        for ellipse in chosen:
            for seed in self._seeds(int(ellipse)):
                match = self._grown(seed)
                grown += 1
                if (match >= 0).sum() > (best >= 0).sum() and self._fits(match):
                    best = match
                if (best >= 0).sum() > 0.8 * enough or grown >= MOST_SEEDS:
                    return best
        return best

    def _seeds(self, ellipse: int) -> list[Index]:
        """Labels about one ellipse, for the mark of the pattern that explains its surroundings best, if any does."""
        _, around = self.tree.query(self.uv[ellipse], k=min(IMAGE_NEIGHBOURS, len(self.uv)))
        around = around[1:]
        first, second = (a.ravel() for a in np.meshgrid(around, around, indexing="ij"))
        image = np.stack([self.uv[first] - self.uv[ellipse], self.uv[second] - self.uv[ellipse]], axis=-1)
        scores: list[tuple[float, int, Array]] = []
        for mark in self._representatives(ellipse):
            pair = self._axes(mark)
            if pair is None:
                continue
            local = np.linalg.inv((self.xy[pair] - self.xy[mark]).T)
            maps = image @ local
            # a board seen from its printed side: its y is up, the picture's down
            sound = np.linalg.det(maps) < 0
            if not sound.any():
                continue
            maps = maps[sound]
            targets = self.xy[self.near[mark][1:]] - self.xy[mark]
            predicted = self.uv[ellipse] + np.einsum("mij,nj->mni", maps, targets)
            scale = np.sqrt(np.abs(np.linalg.det(maps)))
            off, hit = self.tree.query(predicted)
            fits = off < START_TOLERANCE * self.spacing[mark] * scale[:, None]
            fits &= self.is_type[hit, self.type[self.near[mark][1:]]]
            fits &= self._same_shape(ellipse, self.radius[mark] * maps)[:, None]
            part = fits.mean(axis=1)
            i = int(np.argmax(part - 1e-3 * np.where(fits, off, 0).mean(axis=1) / (scale * self.spacing[mark])))
            if part[i] >= SEED_PART:
                scores.append((float(part[i]), mark, maps[i]))
        return [self._seed(ellipse, mark, local) for _, mark, local in sorted(scores, key=lambda s: -s[0])[:2]]

    def _same_shape(self, ellipse: int, maps: Array) -> NDArray[np.bool_]:
        """Whether maps (M, 2, 2) make the ellipse of the unit circle. A lattice looks the same after a shear; its circles do not."""
        ratio = self.shape[ellipse] @ (maps @ np.swapaxes(maps, 1, 2))
        half, product = 0.5 * np.trace(ratio, axis1=1, axis2=2), np.linalg.det(ratio)
        largest = half + np.sqrt(np.maximum(half**2 - product, 0.0))
        return np.asarray(np.maximum(largest, largest / np.maximum(product, 1e-9)) < np.exp(2 * SIZE_TOLERANCE))

    def _representatives(self, ellipse: int) -> Index:
        """Marks to try for an ellipse: those of its type, one for each arrangement of neighbours that is unlike the others."""
        mine = np.flatnonzero(self.is_type[ellipse][self.type])
        arrangement = np.round((self.xy[self.near[mine][:, 1:]] - self.xy[mine][:, None]) / self.spacing[mine, None, None], 2)
        order = np.lexsort((arrangement[..., 1], arrangement[..., 0]), axis=1)
        key = np.take_along_axis(arrangement, order[..., None], axis=1).reshape(len(mine), -1) + 0.0
        key = np.column_stack([key, np.take_along_axis(self.type[self.near[mine][:, 1:]], order, axis=1)])
        _, first = np.unique(key, axis=0, return_index=True)
        return mine[first]

    def _axes(self, mark: int) -> Index | None:
        """The nearest two neighbours of a mark that do not lie in one line with it."""
        near = self.near[mark][1:]
        offset = (self.xy[near] - self.xy[mark]) / self.spacing[mark]
        area = np.abs(offset[0, 0] * offset[:, 1] - offset[0, 1] * offset[:, 0])
        good = np.flatnonzero(area > 0.5)
        return np.array([near[0], near[good[0]]]) if len(good) else None

    def _seed(self, ellipse: int, mark: int, local: Array) -> Index:
        match = np.full(len(self.xy), -1)
        predicted = self.uv[ellipse] + (self.xy[self.near[mark]] - self.xy[mark]) @ local.T
        off, hit = self.tree.query(predicted)
        near = off < START_TOLERANCE * self.spacing[mark] * np.sqrt(np.abs(np.linalg.det(local)))
        near &= self.is_type[hit, self.type[self.near[mark]]]
        match[self.near[mark][near]] = hit[near]
        return _each_once(match)

    def _grown(self, match: Index) -> Index:
        """Labels grown from neighbour to neighbour until nothing is added."""
        for _ in range(MOST_ROUNDS):
            known = np.flatnonzero(match >= 0)
            if len(known) < 3:
                return match
            open_ = np.flatnonzero((match < 0) & (match[self.near] >= 0).any(axis=1))
            predicted, scale = self._predicted(match, known, open_)
            off, hit = self.tree.query(np.where(np.isfinite(predicted), predicted, -1e9))
            taken = np.isin(hit, match[known])
            good = (off < GROW_TOLERANCE * self.spacing[open_] * scale) & ~taken & self.is_type[hit, self.type[open_]]
            good &= np.abs(np.log(self.size[hit] / np.maximum(scale * self.radius[open_], 1e-9))) < SIZE_TOLERANCE
            if not good.any():
                return match
            match = match.copy()
            match[open_[good]] = hit[good]
            match = _each_once(match)
        return match

    def _fits(self, match: Index) -> bool:
        """Whether labels lie where their neighbours say: groups of rings one ring further do so only roughly."""
        known = np.flatnonzero(match >= 0)
        if len(known) <= LOCAL_LABELS:
            return False
        _, near = cKDTree(self.xy[known]).query(self.xy[known], k=LOCAL_LABELS + 1)
        around = self.xy[known][near[:, 1:]].mean(axis=1) - self.xy[known]
        inner = known[np.linalg.norm(around, axis=1) < SURROUNDED * self.spacing[known]]
        if len(inner) < FEWEST_INNER:
            return False
        predicted, scale = self._predicted(match, known, inner, skip=1)
        off = np.linalg.norm(predicted - self.uv[match[inner]], axis=1) / (scale * self.spacing[inner])
        return bool(np.nanmedian(off) < FIT_TOLERANCE)

    def _predicted(self, match: Index, known: Index, marks: Index, skip: int = 0) -> tuple[Array, Array]:
        """Where marks (N,) should be seen, (N, 2), and the scale there, by affine maps through the nearest labels (skip=1: others)."""
        count = min(LOCAL_LABELS, len(known) - skip)
        _, near = cKDTree(self.xy[known]).query(self.xy[marks], k=count + skip)
        near = known[near.reshape(len(marks), count + skip)[:, skip:]]
        local = np.concatenate([self.xy[near] - self.xy[marks][:, None], np.ones((len(marks), count, 1))], axis=-1)
        # units of the spacing, and a touch of damping for labels in one line
        local[..., :2] /= self.spacing[marks][:, None, None]
        normal = np.swapaxes(local, 1, 2) @ local
        spread = np.linalg.eigvalsh(normal[:, :2, :2] - normal[:, :2, 2:] @ normal[:, 2:, :2] / count)[:, 0]
        good = spread > 0.1
        solved = np.linalg.solve(normal + 1e-9 * np.eye(3), np.swapaxes(local, 1, 2) @ self.uv[match[near]])
        scale = np.sqrt(np.abs(np.linalg.det(solved[:, :2]))) / self.spacing[marks]
        return np.where(good[:, None], solved[:, 2], np.nan), scale

    def settled(self, match: Index) -> Index:
        """The labels laid the one best way over the board. Raises IdentityError when there is no such way."""
        for _ in range(MOST_LAYINGS):
            marks = np.flatnonzero(match >= 0)
            moves = self._moves(marks)
            worth = np.array([self._explained(match, marks, *move) for move in moves])
            order = [int(i) for i in np.argsort(-worth, kind="stable")[:MOST_MOVES] if worth[i] >= MOVE_PART * worth.max()]
            # what lies beyond the part labelled so far decides between moves that carry all of it onto marks
            grown = [self._grown(self._laid(match, marks, *moves[i])) for i in order]
            count = np.array([(g >= 0).sum() if self._fits(g) else 0 for g in grown])
            close = [k for k in np.argsort(-count, kind="stable") if count[k] > count.max() - DECISIVE]
            best = min(close, key=lambda k: self._turn(match, marks, *moves[order[k]]))
            settled = count[best] <= len(marks)
            if settled and not all(self._is_symmetry(*moves[order[k]], *moves[order[best]]) for k in close):
                raise IdentityError(
                    f"the board {self.name!r} could lie in {len(close)} ways over the {len(marks)} circles seen; show all of it, "
                    "or print it with orientation marks"
                )
            match = grown[best]
            if settled:
                break
        return match

    def clashes(self, match: Index) -> int:
        """Places without a label that show a circle which cannot be the mark of that place."""
        known, open_ = np.flatnonzero(match >= 0), np.flatnonzero(match < 0)
        if not len(open_):
            return 0
        predicted, scale = self._predicted(match, known, open_)
        off, hit = self.tree.query(np.where(np.isfinite(predicted), predicted, -1e9))
        there = (off < GROW_TOLERANCE * self.spacing[open_] * scale) & ~np.isin(hit, match[known])
        return int((there & ~self.candidates.may_be_type[hit, self.type[open_]]).sum())

    def _laid(self, match: Index, marks: Index, turn: Array, shift: Array) -> Index:
        """The labels after a move, without those that do not look like their new marks."""
        moved = np.full(len(self.xy), -1)
        hit, onto = self._onto(turn, shift, marks)
        hit &= self.is_type[match[marks], self.type[onto]]
        moved[onto[hit]] = match[marks[hit]]
        return moved

    def _moves(self, marks: Index) -> list[tuple[Array, Array]]:
        """Turns (2, 2) and shifts (2,) of the board's plane that carry a labelled mark and its nearest neighbour onto marks."""
        middle = marks[np.argmin(np.linalg.norm(self.xy[marks] - self.xy[marks].mean(axis=0), axis=1))]
        arm = self.xy[self.near[middle][1]] - self.xy[middle]
        moves: dict[tuple[float, ...], tuple[Array, Array]] = {}
        for other in range(len(self.xy)):
            arms = self.xy[self.near[other][1:]] - self.xy[other]
            for end in arms[np.abs(np.linalg.norm(arms, axis=1) - np.linalg.norm(arm)) < 0.02 * np.linalg.norm(arm)]:
                cos, sin = arm @ end, arm[0] * end[1] - arm[1] * end[0]
                turn = np.array([[cos, -sin], [sin, cos]]) / np.hypot(cos, sin)
                shift = self.xy[other] - turn @ self.xy[middle]
                moves.setdefault(tuple(np.round([*turn[0], *(shift / self.spacing[middle])], 2) + 0.0), (turn, shift))
        return list(moves.values())

    def _onto(self, turn: Array, shift: Array, marks: Index) -> tuple[NDArray[np.bool_], Index]:
        """Which marks a move carries onto marks, and onto which."""
        off, onto = cKDTree(self.xy).query(self.xy[marks] @ turn.T + shift)
        return off < 0.1 * self.spacing[marks], onto

    def _explained(self, match: Index, marks: Index, turn: Array, shift: Array) -> int:
        hit, onto = self._onto(turn, shift, marks)
        return int((hit & self.is_type[match[marks], self.type[onto]]).sum())

    def _is_symmetry(self, turn: Array, shift: Array, first_turn: Array, first_shift: Array) -> bool:
        """Whether one move differs from another by a turn that leaves the whole board as it was."""
        marks = np.arange(len(self.xy))
        between = turn @ first_turn.T
        hit, onto = self._onto(between, shift - between @ first_shift, marks)
        return bool(hit.all() and (self.type[onto] == self.type).all())

    def _turn(self, match: Index, marks: Index, turn: Array, shift: Array) -> float:
        """How far the board's y is turned from up in the picture after a move, rad."""
        moved = self.xy[marks] @ turn.T + shift
        design = np.column_stack([moved, np.ones(len(marks))])
        up = np.linalg.lstsq(design, self.uv[match[marks]], rcond=None)[0][1]
        return float(abs(np.arctan2(up[0], -up[1])))


def _each_once(match: Index) -> Index:
    """Labels without ellipses that two marks claim."""
    ellipses, counts = np.unique(match[match >= 0], return_counts=True)
    return np.where(np.isin(match, ellipses[counts > 1]), -1, match)
