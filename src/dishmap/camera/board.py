"""A calibration board: what was seen of it in each photograph, how it may deform, and where its circles' outlines lie.

Boards are a sheet on a plate: they bow. A bend is a smooth height over the flat board that is the same in all views; without
it a bow of half a millimetre goes into the lens (mrcal measures it as a parabola along two sides; here it may also be twisted).
Printers stretch: one side by a part in a thousand against the other; and each printed point has a small error of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.errors import InputError

Array = NDArray[np.float64]

# x^i y^j of the bends by name; degree 2 is what bowing and twisting look like
BENDS = {"bow_x": (2, 0), "twist": (1, 1), "bow_y": (0, 2)}
# Terms in the plane: x longer and y shorter, and the right angle lost. How large all of it is printed, no photograph can tell.
STRETCHES = ("stretch", "skew")
# Lines of the print that curve, and squares that grow from side to side: x^i y^j along x, and along y. Seen from nearly one side they look
# like perspective.
CURVES = {
    f"curve_{along}_{term}": (axis, powers)
    for axis, along in enumerate("xy")
    for term, powers in (("xx", (2, 0)), ("xy", (1, 1)), ("yy", (0, 2)))
}
SHAPE_TERMS = (*BENDS, *STRETCHES, *CURVES)
# A circle's outline is followed through the lens at so many points: its centre is then right to 1e-5 of its radius.
OUTLINE_POINTS = 24


@dataclass(frozen=True)
class BoardView:
    """What one photograph shows of a board: pixels (N, 2) and where they are printed, board_mm (N, 3), in the board's frame.

    radius_mm (N,): for circles, their printed radius; pixels are then centres of outlines in the picture, which are not the
    images of the circles' centres. None for corners.
    """

    name: str
    pixels: Array
    board_mm: Array
    radius_mm: Array | None = None

    def __post_init__(self) -> None:
        pixels, board = np.asarray(self.pixels, dtype=float), np.asarray(self.board_mm, dtype=float)
        if pixels.ndim != 2 or pixels.shape[1:] != (2,) or board.shape != (len(pixels), 3):
            raise InputError(f"view {self.name} needs pixels (N, 2) and board_mm (N, 3), not {pixels.shape} and {board.shape}")
        if not (np.isfinite(pixels).all() and np.isfinite(board).all()):
            raise InputError(f"view {self.name} holds NaN or infinity; leave out corners that were not found")
        object.__setattr__(self, "pixels", pixels)
        object.__setattr__(self, "board_mm", board)
        if self.radius_mm is not None:
            radius = np.asarray(self.radius_mm, dtype=float)
            if radius.shape != (len(pixels),) or not (radius >= 0).all():
                raise InputError(f"view {self.name} needs a radius_mm of 0 or more for each circle, not an array {radius.shape}")
            object.__setattr__(self, "radius_mm", radius)


@dataclass(frozen=True)
class BoardSearch:
    """What was found of a board: views, image size, and for each photograph without a board its name and the reason."""

    views: tuple[BoardView, ...]
    width_px: int
    height_px: int
    rejected: dict[str, str]


def check_same_size(first: tuple[str, tuple[int, int]], name: str, shape: tuple[int, int]) -> None:
    """Raise InputError for photographs of different sizes."""
    if shape != first[1]:
        raise InputError(
            f"photographs of one camera have one size, but {first[0]} has {first[1][1]}x{first[1][0]} px and {name} "
            f"{shape[1]}x{shape[0]}: calibrate each size apart, all turned the same way"
        )


def board_frame(views: Sequence[BoardView]) -> tuple[Array, float]:
    """Middle of the board (2,) and half of its longer side, mm, over all that was seen of it."""
    xy = np.concatenate([view.board_mm[:, :2] for view in views])
    low, high = xy.min(axis=0), xy.max(axis=0)
    return (low + high) / 2, float((high - low).max() / 2)


def bends_of(board_mm: Array, middle_mm: Array, half_mm: float) -> Array:
    """Height (N, F) over the flat board for a bend of size 1 each, at board_mm (N, 3): x^i y^j with x, y in units of half the side.

    A bend of size b mm so lifts the ends of the longer side by b over its middle.
    """
    x, y = ((board_mm[:, :2] - middle_mm) / half_mm).T
    return np.stack([x**i * y**j for i, j in BENDS.values()], axis=-1)


def shapes_of(board_mm: Array, middle_mm: Array, half_mm: float) -> Array:
    """How far points board_mm (N, 3) move for each term of SHAPE_TERMS of size 1 mm (N, 3, F): heights by `bends_of`, then in the plane.

    A stretch of size b mm makes the half side longer by b along x and shorter along y; a skew moves the end of the half side by b sideways;
    a curve moves the ends by b over the middle.
    """
    out = np.zeros((len(board_mm), 3, len(SHAPE_TERMS)))
    out[:, 2, : len(BENDS)] = bends_of(board_mm, middle_mm, half_mm)
    x, y = ((board_mm[:, :2] - middle_mm) / half_mm).T
    out[:, :2, len(BENDS)] = np.stack([x, -y], axis=-1)
    out[:, :2, len(BENDS) + 1] = np.stack([y, x], axis=-1)
    for k, (axis, (i, j)) in enumerate(CURVES.values(), start=len(BENDS) + len(STRETCHES)):
        out[:, axis, k] = x**i * y**j
    return out


def point_index(points_mm: Array, board_mm: Array) -> NDArray[np.int64]:
    """Which of a board's points (N, 3) each of board_mm (M, 3) is."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(points_mm).query(board_mm)[1], dtype=np.int64)


def outline_shift(camera: Camera, points: Array, axes: Array, radius_mm: Array) -> Array:
    """How far the centre of a circle's outline lies from the image of its centre (N, 2), px.

    points (N, 3): centres in the camera frame; axes (N, 3, 2): two unit vectors in each circle's plane; radius_mm (N,).
    The centre of an outline is that of its area, by Green's theorem over the outline's image through the whole lens.
    """
    phi = 2 * np.pi * np.arange(OUTLINE_POINTS) / OUTLINE_POINTS
    circle = np.stack([np.cos(phi), np.sin(phi)])
    ring = points[:, None] + radius_mm[:, None, None] * np.swapaxes(axes @ circle, 1, 2)
    center = camera.project(points)
    # small numbers, so that the areas keep their digits
    x, y = np.moveaxis(camera.project(ring) - center[:, None], -1, 0)
    # derivatives along the outline by Fourier series, exact for ellipses; a polygon's area would be 1 % small
    order = 1j * np.fft.rfftfreq(OUTLINE_POINTS, 1 / OUTLINE_POINTS)
    along_x, along_y = (np.fft.irfft(order * np.fft.rfft(v), OUTLINE_POINTS) for v in (x, y))
    area = (x * along_y - y * along_x).sum(axis=1)
    safe = np.where(radius_mm > 0, area, 1.0)[:, None]
    moment = np.stack([(x * x * along_y).sum(axis=1), -(y * y * along_x).sum(axis=1)], axis=-1)
    return np.asarray(np.where(radius_mm[:, None] > 0, moment / safe, 0.0))


@dataclass(frozen=True)
class BoardShape:
    """How a board is deformed, as learnt from all views together.

    middle_mm (2,), half_mm: see `board_frame`; shape_mm (F,) and covariance_mm2 (F, F) in the order of SHAPE_TERMS. points_mm (N, 3): the
    board's points; print_mm (N, 2): how far each was printed off its place, none or all zero where that is not seen; print_sigma_mm:
    how far a point of this print typically is off. free: false where the board was taken as exact.
    """

    middle_mm: Array
    half_mm: float
    shape_mm: Array
    covariance_mm2: Array
    points_mm: Array
    print_mm: Array
    print_sigma_mm: float = 0.0
    free: bool = True

    @property
    def curved(self) -> bool:
        """Whether curves of the print were estimated."""
        return bool(self.covariance_mm2[-1, -1] > 0)

    @property
    def bend_mm(self) -> Array:
        """Sizes of the bends (3,) in the order of BENDS."""
        return self.shape_mm[: len(BENDS)]

    @property
    def sigma_mm(self) -> Array:
        """Standard deviations of the bends (3,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance_mm2)))[: len(BENDS)]

    def bent(self, board_mm: Array) -> Array:
        """Points (N, 3) of the board as designed as they lie on the real one."""
        out = np.array(board_mm, dtype=float)
        out += shapes_of(out, self.middle_mm, self.half_mm) @ self.shape_mm
        out[:, :2] += self.print_mm[point_index(self.points_mm, board_mm)]
        return out

    @property
    def sag_mm(self) -> float:
        """From the lowest to the highest point of the board, over a square of side 2 half_mm about its middle."""
        x, y = np.meshgrid(*[np.linspace(-1, 1, 21)] * 2)
        square = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1) * self.half_mm
        return float(np.ptp(bends_of(square, np.zeros(2), self.half_mm) @ self.bend_mm))
