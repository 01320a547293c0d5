"""Corners of a chessboard in photographs: found by OpenCV on a reduced picture, then fitted to the raw pixels.

The fit takes each corner as the product of two blurred edges, z = a + b erf(d1) erf(d2), with d1 and d2 the distances from
the edges in units of the blur, on a sloping ground. On synthetic boards its error is a third of that of cv2.cornerSubPix.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray

from dishmap.camera.board import BoardSearch, BoardView, check_same_size
from dishmap.errors import ImageError, InputError, MeasurementError

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Gray = NDArray[np.uint8] | NDArray[np.uint16]
Progress = Callable[[int, int], None]

# A board's corners along a side, and its size: outside these, a number is in other units or squares were counted wrongly.
CORNERS_RANGE = (3, 200)
SQUARE_RANGE_MM = (0.2, 1000.0)
LARGEST_BOARD_MM = 5_000.0
# The search goes from a small picture, where most boards are found at once, to larger ones (longer side, px).
SEARCH_SIDES_PX = (800, 1600, 3200)
THOROUGH_SIDE_PX = 1600
# Half window of the fit: part of the shortest square (so that no other corner is in it), and of the picture's longer side
# (so that a lens bends no edge by more than about 0.01 px inside it).
WINDOW_OF_SQUARE, WINDOW_OF_SIDE, WINDOW_RANGE_PX = 0.4, 1 / 300, (3, 10)
FIRST_WINDOW_PX = 6
FIT_STEPS = 15
FIT_TOLERANCE_PX = 1e-3
BLUR_RANGE_PX = (0.3, 5.0)
# A corner whose pixels differ from the model by this part of the contrast is not seen (a finger, a glint).
LARGEST_MISFIT = 0.25
FEWEST_FITTED = 0.8
LARGEST_LOST_SIDE = 0.5


def chessboard_mm(corners: tuple[int, int], square_mm: float | tuple[float, float]) -> Array:
    """Inner corners of a printed chessboard (columns * rows, 3) in mm, z = 0, row by row.

    square_mm: side of a square, or its sides along x and y as a printer made them. Raises InputError for odd sizes.
    """
    columns, rows = _check_corners(corners)
    sides = np.broadcast_to(np.asarray(square_mm, dtype=float), 2)
    longest = float(((np.array([columns, rows]) - 1) * sides).max())
    if not all(SQUARE_RANGE_MM[0] <= side <= SQUARE_RANGE_MM[1] for side in sides) or longest > LARGEST_BOARD_MM:
        size = "x".join(f"{side:g}" for side in np.unique(sides))
        raise InputError(
            f"squares of {size} mm make a board of {columns}x{rows} corners {longest:g} mm long; "
            f"squares of {SQUARE_RANGE_MM[0]} to {SQUARE_RANGE_MM[1]:g} mm and boards up to {LARGEST_BOARD_MM / 1000:g} m are taken: "
            "is it in millimetres?"
        )
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.asarray(np.stack([x.ravel() * sides[0], y.ravel() * sides[1], np.zeros(x.size)], axis=-1), dtype=float)


def _check_corners(corners: tuple[int, int]) -> tuple[int, int]:
    low, high = CORNERS_RANGE
    if not all(int(n) == n and low <= n <= high for n in corners):
        raise InputError(f"a board needs {low} to {high} inner corners a side (where four squares meet), not {'x'.join(map(str, corners))}")
    return int(corners[0]), int(corners[1])


def find_chessboard(gray: Gray, corners: tuple[int, int]) -> Array:
    """Find the inner corners of a chessboard in a photograph: pixels (columns * rows, 2), row by row as in `chessboard_mm`.

    gray: (height, width), uint8 or uint16. corners: inner corners (columns, rows), which must be all of the board's.
    The first corner is one with a light square towards the board's own corner, so that boards with one even and one odd
    number are numbered alike in all photographs. Corners that are hidden are NaN.
    Raises MeasurementError when there is no such board, ImageError for arrays that are no grey picture.
    """
    columns, rows = _check_corners(corners)
    if gray.ndim != 2 or gray.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"a chessboard is looked for in 8 or 16-bit grey pictures, not in {gray.dtype} {gray.shape}")
    rough = _search(_as_8bit(gray), (columns, rows)).reshape(rows, columns, 2)
    along_x, along_y = (np.asarray(np.gradient(rough, axis=axis)).reshape(-1, 2) for axis in (1, 0))
    square = min(np.linalg.norm(np.diff(rough, axis=axis), axis=-1).min() for axis in (0, 1))
    low, high = WINDOW_RANGE_PX
    half = int(np.clip(WINDOW_OF_SQUARE * square, low, max(high, WINDOW_OF_SIDE * max(gray.shape))))
    # a small window first: the start is only as good as the reduced picture
    found = rough.reshape(-1, 2)
    for window in {min(half, FIRST_WINDOW_PX): None, half: None}:
        start = np.where(np.isnan(found), rough.reshape(-1, 2), found)
        found = fit_corners(gray, start, along_x, along_y, window)
    found[np.linalg.norm(found - rough.reshape(-1, 2), axis=1) > max(WINDOW_OF_SQUARE * square, 1.0)] = np.nan
    _check_sides(np.isnan(found[:, 0]).reshape(rows, columns))
    fitted = np.isfinite(found[:, 0]).mean()
    if fitted < FEWEST_FITTED:
        raise MeasurementError(f"only {fitted:.0%} of the corners of the {columns}x{rows} board are sharp and free; photograph it again")
    return found


def _check_sides(lost: NDArray[np.bool_]) -> None:
    """Raise if a whole side is lost: OpenCV takes the outer edge of a board for a row of corners when told of one too many."""
    rows, columns = lost.shape
    if max(side.mean() for side in (lost[0], lost[-1], lost[:, 0], lost[:, -1])) > LARGEST_LOST_SIDE:
        raise MeasurementError(
            f"no chessboard of {columns}x{rows} inner corners found: along one side no four squares meet; inner corners are counted, "
            "not squares"
        )


def _as_8bit(gray: Gray) -> NDArray[np.uint8]:
    low, high = (float(v) for v in np.percentile(gray[::4, ::4], (0.5, 99.5)))
    if high - low < 1:
        raise MeasurementError("the photograph is blank; it needs to show the board")
    if gray.dtype == np.uint8:
        return np.ascontiguousarray(gray, dtype=np.uint8)
    return cv2.convertScaleAbs(np.clip(gray, low, high).astype(np.float32) - np.float32(low), alpha=255 / (high - low)).astype(np.uint8)


def _search(picture: NDArray[np.uint8], corners: tuple[int, int]) -> Array:
    longer = max(picture.shape)
    thorough = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    tries = [(min(side, longer), 0) for side in SEARCH_SIDES_PX] + [(min(THOROUGH_SIDE_PX, longer), thorough)]
    for side, flags in dict.fromkeys(tries):
        scale = side / longer
        reduced = picture if scale == 1 else cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        found, pixels = cv2.findChessboardCornersSB(reduced, corners, flags=flags)
        if found:
            # what was reduced is measured in its own pixels, whose sizes are whole numbers
            ratio = np.array(picture.shape[::-1]) / np.array(reduced.shape[::-1])
            return (np.asarray(pixels, dtype=float).reshape(-1, 2) + 0.5) * ratio - 0.5
    raise MeasurementError(
        f"no chessboard of {corners[0]}x{corners[1]} inner corners found; all of it must be in the picture, with a light border, "
        "and inner corners are counted, not squares"
    )


def fit_corners(gray: Gray, start: Array, along_x: Array, along_y: Array, half: int) -> Array:
    """Fit chessboard corners to raw pixels: positions (N, 2), NaN where the pixels do not look like a corner.

    start (N, 2): positions right to some pixels; along_x, along_y (N, 2): directions of the two edges through each;
    half: half the window's side, px. Gauss-Newton on position, edge directions, level, contrast, slope and blur.
    """
    base = np.rint(start).astype(int)
    offset = np.arange(-half, half + 1)
    dx, dy = (a.ravel().astype(np.float32) for a in np.meshgrid(offset, offset))
    column, row = base[:, :1] + dx.astype(int), base[:, 1:] + dy.astype(int)
    inside = (column >= 0) & (row >= 0) & (column < gray.shape[1]) & (row < gray.shape[0])
    values = gray[np.clip(row, 0, gray.shape[0] - 1), np.clip(column, 0, gray.shape[1] - 1)].astype(np.float32)
    # a round window with a soft rim weighs all directions alike
    weight = np.clip(3 * (1.1 - (dx**2 + dy**2) / (half + 0.5) ** 2), 0, 1).astype(np.float32) * inside
    p = _first_guess(values, start - base, along_x, along_y, dx, dy)
    for _ in range(FIT_STEPS):
        model, jacobian = _corner_model(p, dx, dy)
        weighted = jacobian * weight[..., None]
        normal = np.swapaxes(weighted, 1, 2) @ jacobian
        normal += 1e-6 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(9, dtype=np.float32) / 9
        step = np.linalg.solve(normal, np.swapaxes(weighted, 1, 2) @ (values - model)[..., None])[..., 0]
        p += np.clip(step, -_LIMITS, _LIMITS)
        p[:, 8] = np.clip(p[:, 8], *BLUR_RANGE_PX)
        if np.abs(step[:, :2]).max() < FIT_TOLERANCE_PX:
            break
    model, _ = _corner_model(p, dx, dy)
    misfit = np.sqrt((weight * (values - model) ** 2).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9))
    good = (misfit < LARGEST_MISFIT * np.abs(p[:, 5])) & (np.abs(p[:, :2]).max(axis=1) <= half) & (np.abs(step[:, :2]).max(axis=1) < 0.05)
    return np.where(good[:, None], base + p[:, :2].astype(float), np.nan)


# x, y, two angles, level, contrast, slopes in x and y, blur: the largest step of each
_LIMITS = np.array([1.0, 1.0, 0.2, 0.2, np.inf, np.inf, np.inf, np.inf, 0.5], dtype=np.float32)


def _first_guess(values: Float32, position: Array, along_x: Array, along_y: Array, dx: Float32, dy: Float32) -> Float32:
    p = np.zeros((len(values), 9), dtype=np.float32)
    p[:, :2] = position
    p[:, 2], p[:, 3] = np.arctan2(along_x[:, 1], along_x[:, 0]), np.arctan2(along_y[:, 1], along_y[:, 0])
    p[:, 8] = 1.0
    p[:, 5] = 1.0
    checks, _ = _corner_model(p, dx, dy)
    # level and contrast are linear, so the first guess of them is a regression on the bare pattern
    checks -= checks.mean(axis=1, keepdims=True)
    p[:, 4] = values.mean(axis=1)
    p[:, 5] = ((values - p[:, 4:5]) * checks).sum(axis=1) / np.maximum((checks**2).sum(axis=1), 1e-9)
    return p


def _corner_model(p: Float32, dx: Float32, dy: Float32) -> tuple[Float32, Float32]:
    """Grey values (N, M) of the corner model, and their derivatives (N, M, 9)."""
    from scipy.special import erf

    x, y = dx - p[:, 0:1], dy - p[:, 1:2]
    blur, contrast = p[:, 8:9], p[:, 5:6]
    edges, slopes, distances = [], [], []
    for angle in (p[:, 2:3], p[:, 3:4]):
        distance = np.cos(angle) * y - np.sin(angle) * x
        scaled = distance / (np.float32(np.sqrt(2)) * blur)
        edges.append(erf(scaled))
        slopes.append(np.float32(np.sqrt(2 / np.pi)) / blur * np.exp(-(scaled**2)))
        distances.append(distance)
    ones = np.ones_like(x)
    first, second = contrast * slopes[0] * edges[1], contrast * slopes[1] * edges[0]
    (s1, s2), (c1, c2) = (np.sin(p[:, k : k + 1]) for k in (2, 3)), (np.cos(p[:, k : k + 1]) for k in (2, 3))
    model = p[:, 4:5] + contrast * edges[0] * edges[1] + p[:, 6:7] * dx + p[:, 7:8] * dy
    jacobian = [
        *(first * s1 + second * s2, -first * c1 - second * c2),
        *(-first * (c1 * x + s1 * y), -second * (c2 * x + s2 * y)),
        *(ones, edges[0] * edges[1], ones * dx, ones * dy),
        -(first * distances[0] + second * distances[1]) / blur,
    ]
    return model, np.stack(jacobian, axis=-1)


def find_boards(
    photographs: Iterable[tuple[str, Gray]],
    corners: tuple[int, int],
    square_mm: float | tuple[float, float],
    total: int = 0,
    progress: Progress | None = None,
) -> BoardSearch:
    """Find a chessboard in each photograph (name, gray), given one after the other so that few are in memory at a time.

    square_mm: see `chessboard_mm`. progress(done, total) is called after each. Raises InputError for an impossible board or
    photographs of different sizes, MeasurementError when no photograph shows the board.
    """
    board = chessboard_mm(corners, square_mm)
    sides = np.broadcast_to(np.asarray(square_mm, dtype=float), 2)
    if corners[0] == corners[1] and sides[0] != sides[1]:
        raise InputError(
            f"a chessboard of {corners[0]}x{corners[1]} corners looks the same after a quarter turn, so nobody can tell along which side "
            f"its squares are {sides[0]:g} and along which {sides[1]:g} mm; print one with more corners one way, or a ChArUco board"
        )
    return search_photographs(photographs, board, lambda gray: find_chessboard(gray, corners), total, progress)


def search_photographs(
    photographs: Iterable[tuple[str, Gray]],
    board_mm: Array,
    find: Callable[[Gray], Array],
    total: int = 0,
    progress: Progress | None = None,
) -> BoardSearch:
    """Find a board's corners (N, 3) in each photograph with `find`, which gives pixels (N, 2), NaN where a corner is not seen.

    Raises as `find_boards` does.
    """
    views: list[BoardView] = []
    rejected: dict[str, str] = {}
    first: tuple[str, tuple[int, int]] | None = None
    for done, (name, shape, found) in enumerate(_in_parallel(photographs, find), start=1):
        first = first or (name, shape)
        check_same_size(first, name, shape)
        if isinstance(found, MeasurementError):
            rejected[name] = str(found)
        else:
            seen = np.isfinite(found[:, 0])
            views.append(BoardView(name, found[seen], board_mm[seen]))
        if progress:
            progress(done, max(total, done))
    if first is None:
        raise InputError("no photographs were given; at least 3 of the board are needed, better 10 to 20")
    if not views:
        raise MeasurementError(f"no photograph shows the board: {first[0]}: {rejected[first[0]]}")
    return BoardSearch(tuple(views), first[1][1], first[1][0], rejected)


def _in_parallel(
    photographs: Iterable[tuple[str, Gray]], find: Callable[[Gray], Array]
) -> Iterator[tuple[str, tuple[int, int], Array | MeasurementError]]:
    """Results in order, two photographs at a time: the corner fit is single-threaded."""

    def work(gray: Gray) -> Array | MeasurementError:
        try:
            return find(gray)
        except MeasurementError as error:
            return error

    waiting: deque[tuple[str, tuple[int, int], Future[Array | MeasurementError]]] = deque()
    with ThreadPoolExecutor(max_workers=2) as pool:
        try:
            for name, gray in photographs:
                waiting.append((name, (gray.shape[0], gray.shape[1]), pool.submit(work, gray)))
                if len(waiting) == 2:
                    name, shape, future = waiting.popleft()
                    yield name, shape, future.result()
            for name, shape, future in waiting:
                yield name, shape, future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
