"""Bad input: one sentence, exit code 2, and nothing written."""

from __future__ import annotations

import json
import re
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from cli_words import dishmap, map_words, refused

from dishmap.io.picture_file import picture_bytes


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def huge_png() -> bytes:
    """A PNG of some bytes that says it has 30,000 x 30,000 px."""
    header = struct.pack(">IIBBBBB", 30_000, 30_000, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 30_001)) + chunk(b"IEND", b"")


def grey(width: int, height: int, level: int = 128) -> bytes:
    return picture_bytes(np.full((height, width), level, np.uint8))


def noise() -> bytes:
    return picture_bytes(np.random.default_rng(1).integers(0, 256, (480, 640)).astype(np.uint8))


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("text.png", b"this is not a picture", "not a picture"),
        ("empty.png", b"", "the file is empty"),
        ("one.png", grey(1, 1), "it has 1x1 px; at least 16x16"),
        ("huge.png", huge_png(), "it has 30000x30000 px; up to 200 megapixels"),
        ("other.png", grey(320, 240), "the photograph is 320x240 px but the camera was calibrated at 640x480 px"),
        ("turned.png", grey(480, 640), "the photograph is 480x640 px but the camera was calibrated at 640x480 px"),
        ("blank.png", grey(640, 480), "0 of 0 ellipses"),
        ("noise.png", noise(), "circle|pattern"),
    ],
)
def test_photographs_that_show_nothing(name: str, data: bytes, message: str, shot: Path, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    said = refused(dishmap(*map_words(shot, tmp_path / name), "--upright", "--out", tmp_path / "out"))
    assert re.search(message, said), said
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_truncated_photographs(suffix: str, shot: Path, tmp_path: Path) -> None:
    image = cv2.imread(str(shot / "ref.png"), cv2.IMREAD_GRAYSCALE)
    data = picture_bytes(image, suffix)
    photo = tmp_path / f"photo{suffix}"
    photo.write_bytes(data[: len(data) * 2 // 3])
    assert "cut short" in refused(dishmap(*map_words(shot, photo), "--upright", "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_missing_files(shot: Path, tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    for flag in (None, "--camera", "--pattern", "--pose-guess", "--spacecraft"):
        words = map_words(shot, gone if flag is None else None)
        if flag in words:
            words[words.index(flag) + 1] = gone
        elif flag is not None:
            words += [flag, gone]
        said = refused(dishmap(*words, "--out", tmp_path / "out"))
        assert str(gone) in said
        assert "no such file" in said.lower()
    assert not (tmp_path / "out").exists()


def test_another_pattern(shot: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.json"
    words = ["pattern", "plate", "--rows", 4, "--columns", 5, "--pitch-mm", 60, "--kind", "ring", "--outer-radius-mm", 20]
    assert dishmap(*words, "--inner-radius-mm", 4, "--orientation-marks", "--out", other).exit_code == 0
    words = ["map", shot / "ref.png", "--camera", shot / "camera.yaml", "--pattern", other, "--out", tmp_path / "out"]
    said = refused(dishmap(*words))
    assert "pattern" in said


def simulated(tmp_path: Path, **changes: Any) -> Path:
    """A folder with a photograph by a plain camera."""
    values = {"rows": 4, "columns": 5, "distance": 420.0, "width": 640, **changes}
    (tmp_path / "scenario.toml").write_text(f"""
format = "dishmap-scenario/1"
pattern.plate = {{ rows = {values["rows"]}, columns = {values["columns"]}, pitch_mm = 40 }}
camera = {{ width_px = {values["width"]}, height_px = 480, focal_px = 800 }}
pose.distance_mm = {values["distance"]}
""")
    done = dishmap("simulate", tmp_path / "scenario.toml", "--out", tmp_path / "shot")
    assert done.exit_code == 0, done.stderr
    return tmp_path / "shot"


def test_two_copies_of_the_pattern(tmp_path: Path) -> None:
    shot = simulated(tmp_path, rows=3, columns=3, distance=500.0, width=800)
    image = cv2.imread(str(shot / "ref.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    two = np.hstack([image[:, 200:600], image[:, 200:600]])
    cv2.imwrite(str(shot / "two.png"), two)
    said = refused(dishmap(*map_words(shot, shot / "two.png"), "--upright", "--out", tmp_path / "out"))
    assert "2 ways" in said
    assert "copies" in said or "copy" in said or "mm" in said


def test_all_targets_clipped(tmp_path: Path) -> None:
    # each of four targets shows the inner corner of its four rings only
    shot = simulated(tmp_path, rows=2, columns=2, distance=500.0, width=640)
    image = cv2.imread(str(shot / "ref.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    edge = [(480 - 64) // 2, (640 - 64) // 2]
    cut = np.full_like(image, 200)
    cut[edge[0] : -edge[0], edge[1] : -edge[1]] = image[edge[0] : -edge[0], edge[1] : -edge[1]]
    cv2.imwrite(str(shot / "cut.png"), cut)
    refused(dishmap(*map_words(shot, shot / "cut.png"), "--upright", "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda p: p["target_kinds"]["multi"]["circles"][0].update(radius_mm=-5), "radius_mm"),
        (lambda p: p["target_kinds"]["multi"]["circles"][0].update(radius_mm=float("nan")), "must be a finite number, not nan"),
        (lambda p: p["targets"][3].update(center_mm=[1, 2, float("inf")]), "must be a finite number"),
        (lambda p: p["targets"][3].update(centre_mm=[1, 2, 3]), "unknown key 'centre_mm'.*'center_mm'"),
        (lambda p: p.update(targets=[]), "targets"),
    ],
)
def test_patterns_with_impossible_numbers(edit: Any, message: str, shot: Path, tmp_path: Path) -> None:
    content = json.loads((shot / "pattern.json").read_text())
    edit(content)
    bad = tmp_path / "bad.json"
    bad.write_text(json.dumps(content))
    words = ["map", shot / "ref.png", "--camera", shot / "camera.yaml", "--pattern", bad, "--upright", "--out", tmp_path / "out"]
    said = refused(dishmap(*words))
    assert str(bad) in said
    assert re.search(message, said), said


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("image_width: 640", "image_width: -640", "image_width"),
        ("800.0, 0.0", ".Nan, 0.0", "camera_matrix|focal"),
        ("800.0, 0.0", "-800.0, 0.0", "focal"),
        ("-0.1, 0.02", ".Nan, 0.02", "distortion"),
    ],
)
def test_cameras_with_impossible_numbers(old: str, new: str, message: str, shot: Path, tmp_path: Path) -> None:
    text = (shot / "camera.yaml").read_text()
    assert old in text
    bad = tmp_path / "bad.yaml"
    bad.write_text(text.replace(old, new, 1))
    words = ["map", shot / "ref.png", "--camera", bad, "--pattern", shot / "pattern.json", "--upright", "--out", tmp_path / "out"]
    said = refused(dishmap(*words))
    assert str(bad) in said
    assert re.search(message, said), said


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"camera_from_dish": {"rotation_vector_deg": [180, 0, NaN], "translation_mm": [0, 0, 420]}}', "NaN is not a number"),
        ('{"camera_from_dish": {"rotation_vector_deg": [180, 0], "translation_mm": [0, 0, 420]}}', "needs three numbers"),
        ('{"camera_from_dish": {"rotation_deg": [180, 0, 0], "translation_mm": [0, 0, 420]}}', "unknown key 'rotation_deg'"),
        ("180 0 0", "not valid JSON"),
    ],
)
def test_pose_guesses_that_are_none(text: str, message: str, shot: Path, tmp_path: Path) -> None:
    (tmp_path / "guess.json").write_text(text)
    said = refused(dishmap(*map_words(shot), "--pose-guess", tmp_path / "guess.json", "--out", tmp_path / "out"))
    assert message in said


@pytest.mark.parametrize("out", ["notes.txt", "notes.txt/out"], ids=["a file", "under a file"])
def test_output_that_cannot_be_written(out: str, shot: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    words = [
        [*map_words(shot), "--upright"],
        ["simulate", shot.parent / "scenario.toml"],
        ["demo"],
        ["pattern", "plate", "--rows", 2, "--columns", 3, "--pitch-mm", 40],
        ["undistort", shot / "ref.png", "--camera", shot / "camera.yaml"],
    ]
    for some in words:
        single = some[0] in ("pattern", "undistort")
        if single and out == "notes.txt":
            continue  # a file is what these write
        target = f"{tmp_path / out}{'/x.png' if single else ''}"
        assert "cannot write" in refused(dishmap(*some, "--out", target))
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_an_input_is_not_overwritten(shot: Path, tmp_path: Path) -> None:
    photo = tmp_path / "photo.png"
    photo.write_bytes((shot / "ref.png").read_bytes())
    said = refused(dishmap("undistort", photo, "--camera", shot / "camera.yaml", "--out", photo))
    assert "would overwrite the input" in said
    words = ["calibrate", photo, "--corners", "5x7", "--square-mm", 10, "--out", photo]
    assert "would overwrite the input" in refused(dishmap(*words))
    assert photo.read_bytes() == (shot / "ref.png").read_bytes()


def test_errors_of_the_system_become_sentences(shot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(error: BaseException) -> Any:
        def raise_it(*args: object, **options: object) -> None:
            raise error

        return raise_it

    words = [*map_words(shot), "--upright", "--out", tmp_path / "out"]
    monkeypatch.setattr("dishmap.pipeline.map_photograph", fail(MemoryError()))
    assert "not enough memory" in refused(dishmap(*words))
    monkeypatch.setattr("dishmap.pipeline.map_photograph", fail(OSError(28, "No space left on device", "/somewhere")))
    assert "/somewhere: No space left on device" in refused(dishmap(*words))
    monkeypatch.setattr("dishmap.pipeline.map_photograph", fail(KeyboardInterrupt()))
    done = dishmap(*words)
    assert (done.exit_code, done.stderr) == (130, "dishmap: stopped; no file was left half-written\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--upright", "--pose-guess", "x"], "give --pose-guess alone, or --upright and --anchor without it"),
        (["--anchor", "0@1,2", "--pose-guess", "x"], "give --pose-guess alone, or --upright and --anchor without it"),
        (["--anchor", "5,6"], "'5,6' is not of the form 17@1203.5,866"),
        (["--anchor", "1@5,nan"], "a finite number is needed, not nan"),
        (["--anchor", "0@400,300"], "anchors name targets of a grid, and"),
        (["--method", "paper", "--normal-sigma-deg", "1"], "mean nothing to --method paper"),
        (["--normal-sigma-deg", "nan"], "a finite number above 0 up to 90 is needed, not nan"),
        (["--ink-spread-percent", "-1"], "a finite number above 0 up to 100 is needed, not -1"),
        (["--method", "magic"], "'magic' is not one of"),
        (["--surfase", "plane"], "No such option"),
    ],
)
def test_options_that_make_no_sense(words: list[str], message: str, shot: Path, tmp_path: Path) -> None:
    done = dishmap(*map_words(shot), *words, "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert message in done.stderr
    assert not (tmp_path / "out").exists()


def test_surfaces_that_are_none(shot: Path, tmp_path: Path) -> None:
    words = [*map_words(shot), "--upright", "--out", tmp_path / "out"]
    assert "the nearest is 'zernike'" in refused(dishmap(*words, "--surface", "zernicke"))
