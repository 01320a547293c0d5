"""Masks of a beam: read as written, and refused with the row that is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dishmap.errors import InputError
from dishmap.io.mask_file import parse_mask, read_mask

HEAD = "theta_deg,phi_deg,lowest_dbi,highest_dbi\n"


def test_absolute_and_relative(tmp_path: Path) -> None:
    path = tmp_path / "mask.csv"
    path.write_text(f"# a beam\n{HEAD}0,0,30,\n\n-3,90,,10.5\n")
    mask = read_mask(path)
    assert not mask.relative
    assert mask.uv == pytest.approx(np.array([[0.0, 0.0], [0.0, -np.sin(np.radians(3.0))]]))
    assert mask.lowest_db.tolist() == [30.0, -np.inf]
    assert mask.highest_db.tolist() == [np.inf, 10.5]
    assert parse_mask(f"{HEAD.replace('dbi', 'db')}0,0,-3,\n").relative


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "must begin with the columns"),
        ("theta,phi\n1,2\n", "must begin with the columns"),
        (HEAD, "0 directions"),
        (f"{HEAD}1,2,3\n", "row 1 has 3 cells"),
        (f"{HEAD}1,2,3,4\n1,x,3,4\n", "row 2: 'x' is not a number"),
        (f"{HEAD},2,3,4\n", "'' is not a number"),
        (f"{HEAD}1,2,nan,4\n", "'nan' is not a number"),
        (f"{HEAD}90,2,3,4\n", "within 90 degrees"),
    ],
)
def test_what_is_refused(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        parse_mask(text)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read the mask"):
        read_mask(tmp_path / "none.csv")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="cannot read the mask"):
        read_mask(tmp_path / "bytes.csv")
