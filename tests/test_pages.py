"""What README.md and docs/ tell people to type works: Python code runs as it stands, commands have the options given."""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path
from typing import Any

import click
import cv2
import numpy as np
import pytest

import dishmap
from dishmap.cli.app import program

ROOT = Path(__file__).resolve().parents[1]
# The plate of the tutorial at 1500 px focal length and one grey level of noise: about 0.06 mm in depth, at most 4 sigma of 30 targets.
DEPTH_MM = 0.25
# JPEG of the best quality adds its own noise.
JPEG_DEPTH_MM = 0.5


def python_code(page: str) -> str:
    return "\n".join(re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL))


@pytest.fixture(scope="module")
def tutorial() -> dict[str, Any]:
    names: dict[str, Any] = {}
    exec(compile(python_code("docs/tutorial.md"), "docs/tutorial.md", "exec"), names)
    return names


def test_tutorial_maps_the_simulated_plate(tutorial: dict[str, Any]) -> None:
    result, truth = tutorial["result"], tutorial["shot"].truth
    assert result.cloud.ids.tolist() == truth.ids.tolist()
    assert np.abs(tutorial["error_mm"])[:, 2].max() < DEPTH_MM


def test_readme_maps_a_file(tutorial: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    dishmap.write_camera("camera.yaml", tutorial["camera"])
    dishmap.write_pattern("pattern.json", tutorial["pattern"])
    again = dishmap.simulate_photograph(tutorial["scene"], np.random.default_rng(2))
    for name, image in (("photo.jpg", tutorial["shot"].image), ("later.jpg", again.image)):
        assert cv2.imwrite(name, image, [cv2.IMWRITE_JPEG_QUALITY, 100])
    names: dict[str, Any] = {}
    exec(compile(python_code("README.md"), "README.md", "exec"), names)
    truth = tutorial["shot"].truth
    assert names["result"].cloud.ids.tolist() == truth.ids.tolist()
    assert np.abs(names["result"].cloud.position_mm - truth.center_mm)[:, 2].max() < JPEG_DEPTH_MM
    # nothing moved between the two
    assert not names["change"].joint.significance.changed
    assert np.abs(names["change"].table.shape_mm).max() < JPEG_DEPTH_MM


def commands(page: str) -> list[str]:
    """Every `dishmap ...` line in the indented blocks of a page."""
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    return [line.strip().removeprefix(".venv/bin/") for line in lines if re.match(r"    (\.venv/bin/)?dishmap ", line)]


@pytest.mark.parametrize("line", [*commands("README.md"), *commands("docs/tutorial.md"), *commands("docs/rf.md")])
def test_commands_have_the_options_that_the_pages_give(line: str) -> None:
    command: click.Command = program
    words = shlex.split(line)[1:]
    while isinstance(command, click.Group):
        # a group may read its first word as a file; it says so itself
        name, found, words = command.resolve_command(click.Context(command), words)
        assert found is not None, f"there is no command {name!r} in: {line}"
        command = found
    # files that are not there are the command's own business, so parsing alone shows a wrong option or a missing one
    assert command.make_context("dishmap", words) is not None


def test_scripts_of_the_readme_are_there() -> None:
    named = set(re.findall(r"scripts/[\w-]+", (ROOT / "README.md").read_text(encoding="utf-8")))
    assert named >= {"scripts/demo", "scripts/test"}
    for name in named:
        assert os.access(ROOT / name, os.X_OK), f"README.md names {name}, which is not a program"
