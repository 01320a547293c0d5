"""`dishmap map` on a small simulated photograph: its files, its words, and every kind of picture."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from cli_words import dishmap, map_words, refused
from click.testing import Result
from PIL import Image

from dishmap.io.points_file import read_points
from dishmap.io.truth_file import read_truth

# 5 sigma: of 20 targets with 3 coordinates none comes so far by chance.
FARTHEST_SIGMAS = 5.0
# The same pixels in another file give the same points; only 16 bits are measured with finer numbers.
SAME_SIGMAS = 0.02


def apart_in_sigmas(folder: Path, other: Path) -> float:
    one, two = read_points(folder / "points.csv"), read_points(other / "points.csv")
    assert one.ids.tolist() == two.ids.tolist()
    return float(np.abs((one.position_mm - two.position_mm) / one.sigma_mm).max())


def test_points_are_where_the_truth_has_them(shot: Path, mapped: tuple[Path, Result]) -> None:
    folder, said = mapped
    assert (said.exit_code, said.stderr) == (0, "")
    made = {"points.csv", "points.ply", "surface.json", "summary.json", "report.html", "measurement.npz"}
    assert {path.name for path in folder.iterdir()} == made
    points, truth = read_points(folder / "points.csv"), read_truth(shot / "truth.csv")["ref.png"]
    assert points.ids.tolist() == truth.ids.tolist()
    assert np.abs((points.position_mm - truth.center_mm) / points.sigma_mm).max() < FARTHEST_SIGMAS
    assert np.abs((points.center_px - truth.center_px) / points.sigma_px).max() < FARTHEST_SIGMAS
    # a wrong table would be seen: neighbours lie thousands of sigmas apart
    assert np.abs((np.roll(points.position_mm, 1, axis=0) - truth.center_mm) / points.sigma_mm).max() > 1000


def test_summary_says_what_was_done(shot: Path, mapped: tuple[Path, Result]) -> None:
    folder, said = mapped
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["inputs"]["photograph"]["sha256"] == hashlib.sha256((shot / "ref.png").read_bytes()).hexdigest()
    assert summary["counts"]["measured"] == summary["counts"]["in_pattern"] == 20
    assert summary["hint"] == {"kind": "upright"}
    assert summary["camera_from_dish"]["translation_mm"] == pytest.approx([0, 0, 420], abs=0.1)
    assert summary["shared_calibration"]["known"] is False
    assert "20 of 20 targets measured, 0 rejected, 0 not seen" in said.stdout
    assert "surface (plane): rms" in said.stdout
    assert f"report: {folder / 'report.html'}" in said.stdout
    # what the summary calls camera_from_dish is what --pose-guess reads
    guess = folder.parent / "guess.json"
    guess.write_text(json.dumps({"camera_from_dish": summary["camera_from_dish"]}))
    from dishmap.io.pose_file import read_pose

    assert read_pose(guess, "camera_from_dish").translation_mm == pytest.approx(summary["camera_from_dish"]["translation_mm"])


@pytest.mark.usefixtures("short_report")
@pytest.mark.parametrize("kind", ["bits16", "colour", "alpha"])
def test_any_kind_of_picture_gives_the_same_points(kind: str, shot: Path, mapped: tuple[Path, Result], tmp_path: Path) -> None:
    image = np.asarray(Image.open(shot / "ref.png"))
    photo = tmp_path / "photo.png"
    if kind == "bits16":
        cv2.imwrite(str(photo), image.astype(np.uint16) * 257)
    else:
        alpha = [np.random.default_rng(1).integers(0, 256, image.shape).astype(np.uint8)] if kind == "alpha" else []
        cv2.imwrite(str(photo), cv2.merge([image, image, image, *alpha]))
    done = dishmap(*map_words(shot, photo), "--upright", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    assert apart_in_sigmas(mapped[0], tmp_path / "out") < SAME_SIGMAS


@pytest.mark.usefixtures("short_report")
@pytest.mark.parametrize("orientation", [1, 3])
def test_pixels_are_the_sensors_and_upright_is_as_viewers_show_it(
    orientation: int, shot: Path, mapped: tuple[Path, Result], tmp_path: Path
) -> None:
    """The same pixels, which a phone held upside down says to turn by half: the same points, named from the other end."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    photo = tmp_path / "photo.png"
    Image.open(shot / "ref.png").save(photo, exif=exif)
    done = dishmap(*map_words(shot, photo), "--upright", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    before, after = read_points(mapped[0] / "points.csv"), read_points(tmp_path / "out" / "points.csv")
    order = slice(None) if orientation == 1 else slice(None, None, -1)
    # the plate's ids run row by row, so that half a turn reverses them
    assert after.center_px[order] == pytest.approx(before.center_px, abs=1e-3)
    assert after.position_mm[order] == pytest.approx(before.position_mm, abs=0.02)
    said = json.loads((tmp_path / "out" / "summary.json").read_text())["hint"]
    assert said == ({"kind": "upright"} if orientation == 1 else {"kind": "upright", "turn_deg": 180})


@pytest.mark.usefixtures("short_report")
def test_pose_guess_and_surface_and_spacecraft(shot: Path, mapped: tuple[Path, Result], tmp_path: Path) -> None:
    guess, craft, out = tmp_path / "guess.json", tmp_path / "craft.json", tmp_path / "out"
    guess.write_text('{"camera_from_dish": {"rotation_vector_deg": [-175, 0, -5], "translation_mm": [20, -20, 450]}}')
    craft.write_text('{"spacecraft_from_camera": {"rotation_vector_deg": [0, 0, 90], "translation_mm": [0, 0, 1000]}}')
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    words = [*map_words(shot), "--pose-guess", guess, "--surface", "polynomial:2", "--spacecraft", craft, "--out", out]
    assert dishmap(*words).exit_code == 0
    camera, moved = read_points(out / "points.csv"), read_points(out / "points_spacecraft.csv")
    assert apart_in_sigmas(mapped[0], out) < SAME_SIGMAS
    x, y, z = camera.position_mm.T
    assert moved.position_mm == pytest.approx(np.column_stack([-y, x, z + 1000]), abs=2e-6)
    assert moved.sigma_mm == pytest.approx(camera.sigma_mm[:, [1, 0, 2]], rel=1e-5)
    assert moved.center_px == pytest.approx(camera.center_px)
    surface = json.loads((out / "surface.json").read_text())
    assert surface["basis"]["kind"] == "polynomial"
    assert len(surface["coefficients"]) == 6
    # the next map without that frame leaves no points of this one beside its own, and other files alone
    assert dishmap(*map_words(shot), "--upright", "--out", out).exit_code == 0
    assert not (out / "points_spacecraft.csv").exists()
    assert (out / "notes.txt").read_text() == "mine"


@pytest.mark.usefixtures("short_report")
def test_paper_method_gives_places_in_the_photograph_and_no_sigmas(shot: Path, tmp_path: Path) -> None:
    done = dishmap(*map_words(shot), "--upright", "--method", "paper", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    assert "gives no uncertainty" in done.stdout
    points, truth = read_points(tmp_path / "out" / "points.csv"), read_truth(shot / "truth.csv")["ref.png"]
    assert np.isnan(points.sigma_mm).all()
    assert np.isnan(points.sigma_normal_rad).all()
    # the lens moves corners of the photograph by 5 px: had u, v stayed undistorted, this would be seen
    error = points.center_px - truth.center_px[np.searchsorted(truth.ids, points.ids)]
    assert np.abs(error).max() < 0.3


def test_a_pattern_that_could_be_turned_is_refused_with_its_poses(shot: Path, tmp_path: Path) -> None:
    done = dishmap(*map_words(shot), "--out", tmp_path / "out")
    said = refused(done)
    assert "could sit in 2 ways" in said
    assert "--upright" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("short_report")
def test_shared_part_is_given_for_a_calibrated_camera(shot: Path, tmp_path: Path) -> None:
    from dishmap.camera.model import Camera
    from dishmap.io.camera_file import read_camera, write_camera

    camera = read_camera(shot / "camera.yaml")
    # a focal length known to 1 part in 800: depth of a plate at 420 mm is shared to 420 / 800 mm
    covariance = 1e-18 * np.eye(9)
    covariance[:2, :2] = 1.0
    write_camera(tmp_path / "camera.yaml", Camera(640, 480, camera.focal_px, camera.principal_px, camera.distortion, covariance=covariance))
    words = ["map", shot / "ref.png", "--camera", tmp_path / "camera.yaml", "--pattern", shot / "pattern.json", "--upright"]
    done = dishmap(*words, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    shared = json.loads((tmp_path / "out" / "summary.json").read_text())["shared_calibration"]
    assert shared["known"] is True
    assert len(shared["targets"]) == 20
    assert shared["sigma_rms_mm"][2] == pytest.approx(420 / 800, rel=0.2)
    assert shared["common_sigma_mm"][2] == pytest.approx(420 / 800, rel=0.2)
    assert shared["apart_rms_mm"][2] < 0.2 * shared["common_sigma_mm"][2]
    assert "shared by all targets through the calibration: x" in done.stdout
