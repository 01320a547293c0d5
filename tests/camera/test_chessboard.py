"""Chessboard corners: against exactly known ones in drawn boards, numbered alike whichever way the board lies."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dishmap.camera.board import BoardView
from dishmap.camera.chessboard import chessboard_mm, find_boards, find_chessboard, fit_corners
from dishmap.errors import ImageError, InputError, MeasurementError
from dishmap.transforms import rotation_from_vector

Array = NDArray[np.float64]

# px rms of one coordinate on noiseless drawn boards: what the drawing's 8x8 sub-samples leave
FIT_PX = 0.01
# px rms with noise of 2 levels of 255 at a contrast of 170 and squares of 30 px
NOISY_FIT_PX = 0.02
DARK, LIGHT = 25.0, 195.0
CORNERS = (9, 6)


def homography(turn_rad: float, square_px: float = 30.0, tilt: tuple[float, float] = (0.3, -0.25)) -> tuple[Array, tuple[int, int]]:
    """Map from squares (first inner corner at 0, 0) to pixels of a board turned and tilted, and the picture's height and width."""
    size = int(16 * square_px)
    rotation = rotation_from_vector([tilt[0], tilt[1], 0.0]) @ rotation_from_vector([0.0, 0.0, turn_rad])
    focal = 40.0 * square_px
    camera = np.array([[focal, 0, size / 2 + 0.3], [0, focal, size / 2 - 0.2], [0, 0, 1]])
    middle = np.array([(CORNERS[0] - 1) / 2, (CORNERS[1] - 1) / 2, 0.0])
    translation = np.array([0, 0, 40.0]) - rotation @ middle
    return camera @ np.column_stack([rotation[:, :2], translation]), (size, size)


def drawn(matrix: Array, shape: tuple[int, int], samples: int = 8, noise: float = 0.0, dark_first: bool = False) -> NDArray[np.uint8]:
    """A board seen through a homography: mean over sub-pixels, blurred by 0.7 px."""
    inverse = np.linalg.inv(matrix)
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(float)
    picture = np.zeros(shape)
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    for du in offsets:
        for dv in offsets:
            x, y, w = np.einsum("ij,jrc->irc", inverse, np.stack([columns + du, rows + dv, np.ones(shape)]))
            x, y = np.floor(x / w).astype(int), np.floor(y / w).astype(int)
            on_board = (x >= -1) & (x < CORNERS[0]) & (y >= -1) & (y < CORNERS[1])
            # the square beyond corner (0, 0) is light unless asked for otherwise
            picture += np.where(on_board & ((x + y) % 2 == (0 if dark_first else 1)), DARK, LIGHT)
    picture = cv2.GaussianBlur(picture / samples**2, (0, 0), 0.7)
    picture += np.random.default_rng(0).normal(size=shape) * noise
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def true_corners(matrix: Array) -> Array:
    board = np.stack(np.meshgrid(np.arange(CORNERS[0]), np.arange(CORNERS[1])), axis=-1).reshape(-1, 1, 2).astype(float)
    return np.asarray(cv2.perspectiveTransform(board, matrix)).reshape(-1, 2)


def rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).mean()))


@pytest.fixture(scope="module")
def board() -> tuple[NDArray[np.uint8], Array]:
    matrix, shape = homography(0.2)
    return drawn(matrix, shape), true_corners(matrix)


def test_corners_are_where_they_were_drawn(board: tuple[NDArray[np.uint8], Array]) -> None:
    picture, truth = board
    found = find_chessboard(picture, CORNERS)
    assert rms(found - truth) < FIT_PX
    assert np.abs((found - truth).mean(axis=0)).max() < FIT_PX / 3
    # the same corners by OpenCV, for scale
    theirs = cv2.cornerSubPix(picture, truth.astype(np.float32).reshape(-1, 1, 2), (9, 9), (-1, -1), (3, 50, 1e-4)).reshape(-1, 2)
    assert rms(found - truth) < 0.6 * rms(theirs - truth)


def test_with_noise() -> None:
    matrix, shape = homography(-0.3)
    found = find_chessboard(drawn(matrix, shape, noise=2.0), CORNERS)
    assert rms(found - true_corners(matrix)) < NOISY_FIT_PX


@pytest.mark.parametrize("turn_deg", [0, 70, 90, 160, 180, 250, 270])
def test_corners_are_numbered_alike_whichever_way_the_board_lies(turn_deg: float) -> None:
    # 9x6: one even, one odd number, so the colours tell the two ends apart
    matrix, shape = homography(np.radians(turn_deg))
    found = find_chessboard(drawn(matrix, shape, samples=3), CORNERS)
    assert np.abs(found - true_corners(matrix)).max() < 0.3


def test_a_board_of_the_other_colouring_is_numbered_from_its_other_end() -> None:
    matrix, shape = homography(0.1)
    found = find_chessboard(drawn(matrix, shape, samples=3, dark_first=True), CORNERS)
    assert np.abs(found - true_corners(matrix)[::-1]).max() < 0.3


def test_large_pictures_are_searched_small_and_measured_whole() -> None:
    matrix, shape = homography(0.2, square_px=80.0)
    found = find_chessboard(drawn(matrix, shape, samples=3), CORNERS)
    assert rms(found - true_corners(matrix)) < 0.05  # 3x3 sub-samples are a coarser drawing


def test_16_bit_pictures(board: tuple[NDArray[np.uint8], Array]) -> None:
    picture, truth = board
    dim = picture.astype(np.uint16) * 12 + 300
    assert rms(find_chessboard(dim, CORNERS) - truth) < FIT_PX


def test_hidden_corners_are_nan(board: tuple[NDArray[np.uint8], Array]) -> None:
    picture, truth = board
    spoilt = picture.copy()
    for k in (12, 40):
        column, row = np.rint(truth[k]).astype(int)
        spoilt[row - 4 : row + 5, column + 1 : column + 12] = 110
    found = fit_corners(spoilt, truth, np.tile([1.0, 0.1], (54, 1)), np.tile([-0.1, 1.0], (54, 1)), 9)
    assert np.flatnonzero(np.isnan(found[:, 0])).tolist() == [12, 40]
    good = np.isfinite(found[:, 0])
    assert rms(found[good] - truth[good]) < 2 * FIT_PX


def test_a_start_pixels_away_is_enough(board: tuple[NDArray[np.uint8], Array]) -> None:
    picture, truth = board
    start = truth + np.random.default_rng(1).uniform(-2, 2, truth.shape)
    found = fit_corners(picture, start, np.tile([1.0, 0.2], (54, 1)), np.tile([-0.2, 1.0], (54, 1)), 9)
    assert rms(found - truth) < FIT_PX


def test_corners_at_the_border_of_the_picture(board: tuple[NDArray[np.uint8], Array]) -> None:
    picture, truth = board
    cut = int(np.floor(truth[:, 0].max())) + 3  # 2 px beyond the last corner
    found = fit_corners(picture[:, :cut].copy(), truth, np.tile([1.0, 0.2], (54, 1)), np.tile([-0.2, 1.0], (54, 1)), 9)
    last = int(truth[:, 0].argmax())
    assert np.isnan(found[last]).any() or np.abs(found[last] - truth[last]).max() < 0.1
    inner = truth[:, 0] < cut - 12
    assert rms(found[inner] - truth[inner]) < FIT_PX


@pytest.mark.parametrize("corners", [(9, 7), (8, 6), (5, 5), (14, 19)])
def test_another_number_of_corners_is_not_found(board: tuple[NDArray[np.uint8], Array], corners: tuple[int, int]) -> None:
    with pytest.raises(MeasurementError, match=f"no chessboard of {corners[0]}x{corners[1]} inner corners found.* counted, not squares"):
        find_chessboard(board[0], corners)


def test_both_ways_of_counting_find_the_board(board: tuple[NDArray[np.uint8], Array]) -> None:
    picture, truth = board
    found = find_chessboard(picture, (6, 9))
    # the same corners in another order
    assert rms(np.sort(found, axis=0) - np.sort(truth, axis=0)) < FIT_PX


def test_pictures_without_a_board() -> None:
    with pytest.raises(MeasurementError, match="the photograph is blank; it needs to show the board"):
        find_chessboard(np.full((300, 400), 128, np.uint8), CORNERS)
    noise = np.random.default_rng(0).integers(0, 255, (300, 400)).astype(np.uint8)
    with pytest.raises(MeasurementError, match="no chessboard of 9x6 inner corners found"):
        find_chessboard(noise, CORNERS)


@pytest.mark.parametrize("picture", [np.zeros((50, 50), np.float64), np.zeros((50, 50, 3), np.uint8)])
def test_what_is_no_grey_picture(picture: NDArray[np.generic]) -> None:
    with pytest.raises(ImageError, match="looked for in 8 or 16-bit grey pictures"):
        find_chessboard(picture, CORNERS)  # type: ignore[arg-type]


def test_board_positions() -> None:
    board = chessboard_mm((4, 3), 12.5)
    assert board.shape == (12, 3)
    assert board[1].tolist() == [12.5, 0, 0]
    assert board[4].tolist() == [0, 12.5, 0]
    printed = chessboard_mm((4, 3), (12.4, 12.6))
    assert printed[5].tolist() == [12.4, 12.6, 0]


def test_a_square_board_of_uneven_squares_is_refused(board: tuple[NDArray[np.uint8], Array]) -> None:
    with pytest.raises(InputError, match=r"a chessboard of 6x6 corners looks the same .* print one with more corners"):
        find_boards([("a", board[0])], (6, 6), (19.9, 20.1))


@pytest.mark.parametrize(
    ("corners", "square_mm", "message"),
    [
        ((14, 19), 0.01, "squares of 0.01 mm make a board of 14x19 corners 0.18 mm long.*is it in millimetres?"),
        ((14, 19), 1300.0, "squares of 1300 mm make a board of 14x19 corners 23400 mm long"),
        ((11, 8), 1000.0, "boards up to 5 m are taken: is it in millimetres?"),
        ((9, 6), -10.0, "is it in millimetres"),
        ((9, 6), float("nan"), "is it in millimetres"),
        ((2, 6), 10.0, "a board needs 3 to 200 inner corners a side .where four squares meet., not 2x6"),
        ((9, 2000), 10.0, "a board needs 3 to 200"),
    ],
)
def test_impossible_boards(corners: tuple[int, int], square_mm: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        chessboard_mm(corners, square_mm)


def test_find_boards_names_what_it_leaves_out(board: tuple[NDArray[np.uint8], Array]) -> None:
    picture, truth = board
    asked: list[str] = []

    def photographs() -> Iterator[tuple[str, NDArray[np.uint8]]]:
        for name, gray in (("a", picture), ("blank", np.full_like(picture, 9)), ("b", picture)):
            asked.append(name)
            yield name, gray

    seen: list[tuple[int, int]] = []
    search = find_boards(photographs(), CORNERS, 25.0, total=3, progress=lambda done, total: seen.append((done, total)))
    assert [view.name for view in search.views] == ["a", "b"]
    assert (search.width_px, search.height_px) == picture.shape[::-1]
    assert list(search.rejected) == ["blank"]
    assert search.rejected["blank"].startswith("the photograph is blank")
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert search.views[0].board_mm[1].tolist() == [25.0, 0, 0]
    assert rms(search.views[1].pixels - truth) < FIT_PX


def test_photographs_of_two_sizes_are_refused(board: tuple[NDArray[np.uint8], Array]) -> None:
    picture, _ = board
    with pytest.raises(
        InputError, match="photographs of one camera have one size, but a has 480x480 px and b 470x480: calibrate each size apart"
    ):
        find_boards([("a", picture), ("b", picture[:, :-10])], CORNERS, 25.0)


def test_no_photographs_and_no_boards() -> None:
    with pytest.raises(InputError, match="no photographs were given; at least 3"):
        find_boards([], CORNERS, 25.0)
    blank = np.zeros((100, 100), np.uint8)
    with pytest.raises(MeasurementError, match="no photograph shows the board: x: the photograph is blank"):
        find_boards([("x", blank), ("y", blank)], CORNERS, 25.0)


def test_an_error_while_reading_stops_the_search(board: tuple[NDArray[np.uint8], Array]) -> None:
    def photographs() -> Iterator[tuple[str, NDArray[np.uint8]]]:
        yield "a", board[0]
        raise ImageError("cut short")

    with pytest.raises(ImageError, match="cut short"):
        find_boards(photographs(), CORNERS, 25.0)


@pytest.mark.parametrize(
    ("pixels", "board_mm", "message"),
    [
        (np.zeros((5, 2)), np.zeros((4, 3)), r"view v needs pixels \(N, 2\) and board_mm \(N, 3\)"),
        (np.full((5, 2), np.nan), np.zeros((5, 3)), "view v holds NaN"),
    ],
)
def test_views_hold_pairs_of_numbers(pixels: Array, board_mm: Array, message: str) -> None:
    with pytest.raises(InputError, match=message):
        BoardView("v", pixels, board_mm)


def test_real_boards(shared_data: Path) -> None:
    for name in ("board_08.jpg", "board_18.jpg"):  # one near and level, one turned
        picture = cv2.imread(str(shared_data / "cylinder" / "boards" / name), cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        found = find_chessboard(picture.astype(np.uint8), (14, 19)).reshape(19, 14, 2)
        assert np.isfinite(found).all()
        # neighbours on a smooth surface: second differences are small beside the squares of some 70 px
        assert np.abs(np.diff(found, 2, axis=0)).max() < 4
        assert np.abs(np.diff(found, 2, axis=1)).max() < 4
