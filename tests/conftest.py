"""What all tests share: settings of hypothesis, and the folder of other people's photographs and renders."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# No deadline: a shared machine's speed says nothing about correctness. The same examples in every run, so that a failure
# seen once is seen again; `HYPOTHESIS_PROFILE=search` looks for new ones.
settings.register_profile("same", deadline=None, derandomize=True)
settings.register_profile("search", deadline=None, max_examples=1000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of test photographs: DISHMAP_DATA, or shared/data beside the project; the test is skipped without it."""
    folder = Path(os.environ.get("DISHMAP_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"needs the test photographs: no folder {folder} (set DISHMAP_DATA to one)")
    return folder
