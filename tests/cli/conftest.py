"""A small simulated photograph with its files, and a map of it."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_words import dishmap, map_words
from click.testing import Result

SCENARIO = """
format = "dishmap-scenario/1"
seed = 3
pattern.plate = { rows = 4, columns = 5, pitch_mm = 40 }
camera = { width_px = 640, height_px = 480, focal_px = 800, distortion = [-0.1, 0.02, 0.0, 0.0, 0.0] }
pose = { distance_mm = 420, tilt_deg = 15, tilt_direction_deg = 30 }
sensor = { noise_grey = 1.0, psf_sigma_px = 0.7 }
states = [{ name = "ref" }]
"""


@pytest.fixture(scope="session")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ref.png, camera.yaml, pattern.json, pose.json and truth.csv."""
    folder = tmp_path_factory.mktemp("scenario")
    (folder / "scenario.toml").write_text(SCENARIO)
    done = dishmap("simulate", folder / "scenario.toml", "--out", folder / "shot")
    assert done.exit_code == 0, done.stderr
    return folder / "shot"


@pytest.fixture(scope="session")
def mapped(shot: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """The folder of a map of the photograph, and what the program said."""
    out = tmp_path_factory.mktemp("mapped") / "out"
    done = dishmap(*map_words(shot), "--upright", "--out", out)
    assert done.exit_code == 0, (done.output, done.exception)
    return out, done


@pytest.fixture
def short_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """A report of one line, for tests that look at the other files: drawing takes longer than measuring."""
    monkeypatch.setattr("dishmap.report.map_report", lambda result, image, title, inputs: f"<title>{title}</title>")


@pytest.fixture
def no_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """A calibration that is not checked and whose report has one line, for tests that look at the camera and at words."""
    from dishmap.calibration_report import Checks

    monkeypatch.setattr("dishmap.cli.calibrate._checks", lambda result, choice, working_mm: Checks(choice))
    monkeypatch.setattr("dishmap.calibration_report.calibration_report", lambda result, title, *others: f"<title>{title}</title>")
