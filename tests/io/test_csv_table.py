"""CSV tables: what cells say, and cuts as a table."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest

from dishmap.io.csv_table import format_csv
from dishmap.io.cuts_csv import COLUMNS, format_cuts_csv
from dishmap.rf.pattern import Cut


def test_cells() -> None:
    rows = [{"a": 1.0 / 3, "b": True, "c": "x, y"}, {"a": float("nan"), "b": None}, {"a": -0.0, "b": 7, "c": float("inf")}]
    text = format_csv(("a", "b", "c"), rows, ["a: in mm,\npositive up"])
    assert text == '# a: in mm, positive up\na,b,c\n0.333333333,yes,"x, y"\n,,\n0,7,\n'


def test_cuts_as_a_table() -> None:
    theta = np.array([-1.0, 0.0])
    cut = Cut(theta, 45.0, np.array([10j, 100]), np.array([-1, 0]))
    text = format_cuts_csv(["before", "after"], [30.0], [[[cut]], [[cut, cut]]])
    rows = list(csv.DictReader(io.StringIO(text)))
    assert tuple(rows[0]) == COLUMNS
    assert [row["state"] for row in rows] == ["before"] * 2 + ["after"] * 4
    first = [float(rows[0][name]) for name in COLUMNS[1:]]
    assert first == pytest.approx([30, 45, -1, 20, 90, 0, 180])
    # no field: neither gain nor phase
    assert (rows[1]["co_dbi"], rows[1]["cross_dbi"], rows[1]["cross_phase_deg"]) == ("40", "", "")
    with pytest.raises(ValueError, match="zip"):
        format_cuts_csv(["before"], [12.5, 30.0], [[[cut]]])
