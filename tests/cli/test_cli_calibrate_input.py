"""What people give to `dishmap calibrate` by mistake or from a phone: a clear sentence or a remark, and nothing half-written."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from board_shots import board_photographs
from cli_words import dishmap, refused
from numpy.typing import NDArray
from PIL import Image

from dishmap.io.camera_file import read_camera

pytestmark = pytest.mark.usefixtures("no_checks")

Picture = NDArray[Any]
BOARD = ["--corners", "9x7", "--square-mm", 10, "--lens", 4]
ORIENTATION = 0x112
# Focal length of the photographs, px, and how far a camera from eight of them may be from it.
FOCAL_PX, FOCAL_TOLERANCE_PX = 700.0, 5.0


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> list[Picture]:
    """Eight photographs of a chessboard of 9x7 corners."""
    photos = board_photographs(tmp_path_factory.mktemp("boards"))
    return [np.asarray(cv2.imread(str(photo), cv2.IMREAD_GRAYSCALE)) for photo in photos]


def saved(folder: Path, pictures: list[Picture], ending: str = "png") -> list[Path]:
    names = [folder / f"view{number}.{ending}" for number in range(len(pictures))]
    for name, picture in zip(names, pictures, strict=True):
        cv2.imwrite(str(name), picture)
    return names


def same_noise(pictures: list[Picture]) -> list[Picture]:
    """One view again and again, with new noise."""
    rng = np.random.default_rng(0)
    return [np.clip(pictures[0] + rng.normal(size=pictures[0].shape), 0, 255).astype(np.uint8) for _ in pictures]


REFUSED: list[tuple[str, Callable[[list[Picture]], list[Picture]], list[object], str]] = [
    ("all blank", lambda p: [np.full_like(p[0], 90 + k) for k in range(4)], BOARD, "no photograph shows the board: view0.png: the photo"),
    ("one", lambda p: p[:1], BOARD, "1 view(s) of the board were given; at least 3 in different directions are needed, better 10 to 20"),
    ("alike", same_noise, BOARD, "all views show the board in one direction (within 0.0 degrees), so focal length and distance cannot be"),
    ("count", lambda p: p[:3], ["--corners", "10x8", "--square-mm", 10], "no chessboard of 10x8 inner corners found; all of it must be in"),
    ("10 m", lambda p: p[:3], ["--corners", "9x7", "--square-mm", 1250], "squares of 1250 mm make a board of 9x7 corners 10000 mm long; "),
    ("metres", lambda p: p[:3], ["--corners", "9x7", "--square-mm", 0.01], "is it in millimetres?"),
    ("sizes", lambda p: [*p[:3], p[3][:-20]], BOARD, "photographs of one camera have one size, but view0.png has 640x480 px and view3.png"),
    ("the same", lambda p: [*p, p[2]], BOARD, "view2.png and view8.png are the same photograph; give each once"),
]


@pytest.mark.parametrize(("change", "words", "message"), [r[1:] for r in REFUSED], ids=[r[0] for r in REFUSED])
def test_refused(
    change: Callable[[list[Picture]], list[Picture]], words: list[object], message: str, pictures: list[Picture], tmp_path: Path
) -> None:
    shots = tmp_path / "shots"
    shots.mkdir()
    photos = saved(shots, change(pictures))
    said = refused(dishmap("calibrate", *photos, *words, "--out", tmp_path / "new" / "camera.yaml"))
    assert message in said
    assert [path.name for path in tmp_path.iterdir()] == ["shots"]


def test_too_few_boards_say_why(pictures: list[Picture], tmp_path: Path) -> None:
    photos = saved(tmp_path, [*pictures[:2], np.full_like(pictures[0], 128), np.full_like(pictures[0], 140)])
    said = refused(dishmap("calibrate", *photos, *BOARD, "--out", tmp_path / "camera.yaml"))
    assert "only 2 of 4 photographs show the board well enough, and at least 3 are needed; left out: view2.png: the photo" in said


def test_mirrored_photographs_of_a_board_that_tells(tmp_path: Path) -> None:
    board = cv2.aruco.CharucoBoard((10, 8), 20.0, 15.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000))
    picture = np.asarray(board.generateImage((640, 480), marginSize=30))
    photos = saved(tmp_path, [np.ascontiguousarray(picture[:, ::-1]), picture[::-1] // 2])
    said = refused(dishmap("calibrate", *photos, "--board", "charuco", "--corners", "9x7", "--square-mm", 20, "--out", tmp_path / "c.yaml"))
    assert "that the photograph is not mirrored" in said


def test_a_photograph_that_was_cut_short(pictures: list[Picture], tmp_path: Path) -> None:
    photos = saved(tmp_path, pictures[:4], "jpg")
    photos[1].write_bytes(photos[1].read_bytes()[:-3000])
    said = refused(dishmap("calibrate", *photos, *BOARD, "--out", tmp_path / "camera.yaml"))
    assert "view1.jpg as a photograph: it is cut short (the end marker of the JPEG is missing); copy it again" in said


def test_files_that_may_not_be_read(pictures: list[Picture], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = saved(tmp_path, pictures[:3])
    photos[1].chmod(0)
    plain = Path.read_bytes

    def read_bytes(path: Path) -> bytes:
        if path == photos[1]:  # root may read anything
            raise PermissionError(13, "Permission denied")
        return plain(path)

    monkeypatch.setattr(Path, "read_bytes", read_bytes)
    said = refused(dishmap("calibrate", *photos, *BOARD, "--out", tmp_path / "camera.yaml"))
    assert "view1.png as a photograph: it cannot be read (Permission denied); check the name and its permissions" in said


@pytest.mark.parametrize("kind", ["16 bits", "colour with alpha", "turned by EXIF"])
def test_all_kinds_of_files_give_the_same_camera(kind: str, pictures: list[Picture], tmp_path: Path) -> None:
    if kind == "16 bits":
        photos = saved(tmp_path, [picture.astype(np.uint16) * 200 for picture in pictures])
    elif kind == "colour with alpha":
        photos = saved(tmp_path, [cv2.merge([p, p, p, np.full_like(p, 80 + k)]) for k, p in enumerate(pictures)])
    else:
        # a phone that looks down thinks that it is held now this way, now that; its sensor's pixels are those of one camera
        photos = [tmp_path / f"view{number}.png" for number in range(len(pictures))]
        for number, (photo, picture) in enumerate(zip(photos, pictures, strict=True)):
            exif = Image.Exif()
            exif[ORIENTATION] = [1, 3, 6, 8][number % 4]
            Image.fromarray(picture).save(photo, exif=exif)
    done = dishmap("calibrate", *photos, *BOARD, "--out", tmp_path / "camera.yaml")
    assert done.exit_code == 0, done.stderr
    assert "8 of 8 photographs used" in done.stdout
    assert "the board measures 80x60 mm over its corners and stood 2" in done.stdout
    camera = read_camera(tmp_path / "camera.yaml")
    assert (camera.width_px, camera.height_px) == (640, 480)
    assert np.abs(camera.focal_px - FOCAL_PX).max() < FOCAL_TOLERANCE_PX


def test_inches_are_noticed(pictures: list[Picture], tmp_path: Path) -> None:
    words = ["--corners", "9x7", "--square-mm", 0.394, "--lens", 4, "--out", tmp_path / "camera.yaml"]
    done = dishmap("calibrate", *saved(tmp_path, pictures), *words)
    assert done.exit_code == 0, done.stderr
    assert "The board would be 3.15x2.36 mm, 9.0" in done.stdout
    assert "its size was not given in millimetres" in done.stdout


def test_outputs_that_would_take_the_place_of_something(pictures: list[Picture], tmp_path: Path) -> None:
    photos = saved(tmp_path, pictures[:3])
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    (tmp_path / "folder").mkdir()
    for out, message in (
        (photos[1], "would overwrite the input"),
        (tmp_path / "camera.html", "is the name of another file that is written; give one that ends in .yaml"),
        (tmp_path / "folder", "it is a folder, and a file is to be written"),
        (photos[0] / "camera.yaml", "a file of that name stands in the way; give another folder"),
    ):
        assert message in refused(dishmap("calibrate", *photos, *BOARD, "--out", out)), out
    shutil.rmtree(tmp_path / "folder")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_the_board_file_is_not_overwritten(pictures: list[Picture], tmp_path: Path) -> None:
    assert dishmap("sheet", "board", "--kind", "chessboard", "--corners", "9x7", "--square-mm", 10, "--out", tmp_path).exit_code == 0
    before, board = (tmp_path / "board.json").read_bytes(), tmp_path / "board.json"
    said = refused(dishmap("calibrate", *saved(tmp_path, pictures[:3]), "--board", board, "--out", board))
    assert "would overwrite the input" in said
    assert board.read_bytes() == before
