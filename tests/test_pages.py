"""The Python code in README.md and docs/ runs as it stands and gives what the text says."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import dishmap

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
    assert np.abs(result.cloud.position_mm - truth.center_mm)[:, 2].max() < DEPTH_MM


def test_readme_maps_a_file(tutorial: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    dishmap.write_camera("camera.yaml", tutorial["camera"])
    dishmap.write_pattern("pattern.json", tutorial["pattern"])
    assert cv2.imwrite("photo.jpg", tutorial["shot"].image, [cv2.IMWRITE_JPEG_QUALITY, 100])
    names: dict[str, Any] = {}
    exec(compile(python_code("README.md"), "README.md", "exec"), names)
    truth = tutorial["shot"].truth
    assert names["result"].cloud.ids.tolist() == truth.ids.tolist()
    assert np.abs(names["result"].cloud.position_mm - truth.center_mm)[:, 2].max() < JPEG_DEPTH_MM
