"""Truth tables: what is written is read back, and other people's tables are understood."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dishmap.errors import InputError
from dishmap.io.truth_file import COLUMNS, format_truth, read_truth
from dishmap.simulate.truth import Truth

# Nine digits behind the point
ROUNDING = 5e-10


def truth(count: int, seed: int) -> Truth:
    rng = np.random.default_rng(seed)
    numbers = rng.normal(size=(count, 10)) * 100
    return Truth(np.arange(count) * 3, numbers[:, :3], numbers[:, 3:6], numbers[:, 6:8], numbers[:, 8], numbers[:, 9])


def test_round_trip(tmp_path: Path) -> None:
    first, second = truth(4, 1), truth(2, 2)
    first.center_px[2] = np.nan
    first.displacement_mm[0] = -0.0
    text = format_truth([("a.png", first), ("b.png", second)])
    path = tmp_path / "truth.csv"
    path.write_text(text)
    found = read_truth(path)
    assert list(found) == ["a.png", "b.png"]
    for name, expected in (("a.png", first), ("b.png", second)):
        assert (found[name].ids == expected.ids).all()
        for field in ("center_mm", "normal", "center_px", "visible_fraction", "displacement_mm"):
            np.testing.assert_allclose(getattr(found[name], field), getattr(expected, field), atol=ROUNDING, rtol=0)
    assert "nan" not in text
    assert "-0.000000000" not in text


def test_the_shared_table_is_understood(shared_data: Path) -> None:
    found = read_truth(shared_data / "dish" / "truth.csv")
    assert len(found) == 6
    assert len(found["ref.png"]) == 130
    assert found["cur_defocus_1.0.png"].displacement_mm[129] == 0.619484


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no truth table: its first line must be image,id,x_mm"),
        ("a,b\n1,2\n", "no truth table"),
        (",".join(COLUMNS) + "\na.png,1,2\n", "line 2: needs an image name, an id and 10 numbers"),
        (",".join(COLUMNS) + "\na.png,x,1,2,3,4,5,6,7,8,9,10\n", "line 2: needs"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "truth.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_truth(path)
    with pytest.raises(InputError, match="cannot read the truth table"):
        read_truth(tmp_path / "none.csv")
