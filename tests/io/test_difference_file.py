"""Difference tables: numbers survive the file to its last digit, and what is no such table is refused."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dishmap.compare import DifferenceTable
from dishmap.errors import InputError
from dishmap.io.difference_file import (
    BACK,
    COLUMNS,
    FRONT,
    SIGMAS,
    STILL,
    colour_scale_mm,
    format_difference,
    format_difference_ply,
    parse_difference,
    read_difference,
)
from dishmap.io.difference_results import STATE_COLUMNS, failed_row, format_states
from dishmap.quality import Quality

# Values are rounded to 1e-6 mm, sigmas to 6 digits.
DIGITS_MM = 0.5000001e-6
SIGMA_DIGITS = 5.000001e-6

finite = st.floats(-1e4, 1e4)
sigma = st.one_of(st.just(float("nan")), st.floats(0, 1e3, allow_subnormal=False))


@st.composite
def tables(draw: st.DrawFn) -> DifferenceTable:
    n = draw(st.integers(0, 6))
    columns = {name: draw(arrays(float, n, elements=finite)) for name in ("displacement_mm", "depth_change_mm", "shape_mm")}
    columns |= {name: draw(arrays(float, n, elements=sigma)) for name in SIGMAS}
    return DifferenceTable(
        ids=np.array(draw(st.lists(st.integers(0, 2**31 - 1), min_size=n, max_size=n, unique=True)), dtype=np.int64),
        nominal_mm=draw(arrays(float, (n, 3), elements=finite)),
        **columns,
        du_dv_px=draw(arrays(float, (n, 2), elements=finite)),
        quality=draw(arrays(np.int64, n, elements=st.integers(0, 2 * int(max(Quality)) - 1))),
    )


@given(tables())
@settings(max_examples=60, deadline=None)
def test_what_is_written_is_read(table: DifferenceTable) -> None:
    found = parse_difference(format_difference(table))
    assert found.ids.tolist() == table.ids.tolist()
    assert found.quality.tolist() == table.quality.tolist()
    for name in ("nominal_mm", "displacement_mm", "depth_change_mm", "shape_mm", "du_dv_px"):
        assert np.abs(getattr(found, name) - getattr(table, name)).max(initial=0.0) <= DIGITS_MM
    for name in SIGMAS:
        ours, theirs = getattr(found, name), getattr(table, name)
        assert np.array_equal(np.isnan(ours), np.isnan(theirs))
        known = ~np.isnan(ours)
        assert (np.abs(ours - theirs)[known] <= SIGMA_DIGITS * theirs[known]).all()
    assert format_difference(found) == format_difference(parse_difference(format_difference(found)))


def a_table(shape_mm: list[float], sigma_mm: float = 0.01) -> DifferenceTable:
    n = len(shape_mm)
    zero, sigmas = np.zeros(n), np.full(n, sigma_mm)
    place = np.column_stack([np.arange(n), zero, zero])
    shape = np.array(shape_mm)
    return DifferenceTable(np.arange(n), place, shape, -shape, shape, sigmas, sigmas, sigmas, np.zeros((n, 2)), np.arange(n))


def ply_rows(text: str) -> tuple[list[str], list[list[str]]]:
    head, _, body = text.partition("end_header\n")
    return [line.split()[-1] for line in head.splitlines() if line.startswith("property")], [line.split() for line in body.splitlines()]


def test_a_ply_has_the_values_and_the_colours_of_the_shape() -> None:
    names, rows = ply_rows(format_difference_ply(a_table([-0.5, 0.0, 0.25, 0.5])))
    assert names[:7] == ["x", "y", "z", "red", "green", "blue", "id"]
    assert [float(row[names.index("shape_mm")]) for row in rows] == [-0.5, 0.0, 0.25, 0.5]
    assert [float(row[names.index("depth_change_mm")]) for row in rows] == [0.5, 0.0, -0.25, -0.5]
    colours = [[int(cell) for cell in row[3:6]] for row in rows]
    assert colours[0] == list(BACK)
    assert colours[1] == list(STILL)
    assert colours[3] == list(FRONT)
    # half of the way between
    assert np.abs(np.array(colours[2]) - (np.array(STILL) + FRONT) / 2).max() <= 0.5
    assert all(len(row) == len(names) for row in rows)


def test_noise_alone_stays_pale_and_unknown_sigmas_are_zero() -> None:
    assert colour_scale_mm(a_table([0.01, -0.02], sigma_mm=0.01)) == pytest.approx(0.06)
    assert colour_scale_mm(a_table([0.01, -0.02], sigma_mm=float("nan"))) == pytest.approx(0.02)
    assert colour_scale_mm(a_table([0.0], sigma_mm=0.0)) > 0
    names, rows = ply_rows(format_difference_ply(a_table([0.1], sigma_mm=float("nan"))))
    assert rows[0][names.index("sigma_shape_mm")] == "0"


ROW = dict(zip(COLUMNS, ["7", *["1.0"] * 6, *["0.1"] * 3, "0.5", "0.5", "glare"], strict=True))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"id": "-1"}, "line 2: an id must be a whole number"),
        ({"id": "9" * 40}, "line 2: an id must be a whole number"),
        ({"shape_mm": ""}, "line 2: shape_mm must be a number"),
        ({"shape_mm": "nan"}, "line 2: shape_mm must be a finite number"),
        ({"sigma_shape_mm": "-1"}, "line 2: sigma_shape_mm must not be negative"),
        ({"sigma_shape_mm": "nan"}, "line 2: sigma_shape_mm must be a finite number"),
        ({"quality": "shiny"}, "line 2: unknown quality flag 'shiny'"),
    ],
)
def test_what_is_wrong_in_a_row_is_named(change: dict[str, str], message: str) -> None:
    text = ",".join(COLUMNS) + "\n" + ",".join({**ROW, **change}.values()) + "\n"
    with pytest.raises(InputError, match=message):
        parse_difference(text)
    assert parse_difference(text.splitlines()[0] + "\n" + ",".join({**ROW, "sigma_shape_mm": ""}.values())).ids.tolist() == [7]


@pytest.mark.parametrize("text", ["", "id,x_mm\n", ",".join(COLUMNS[:-1]) + "\n", '"'])
def test_other_tables_are_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"is no (table of differences|CSV)"):
        parse_difference(text)


def test_repeated_ids_short_rows_and_files() -> None:
    row = ",".join(ROW.values())
    with pytest.raises(InputError, match="the id 7 stands in it twice"):
        parse_difference("\n".join([",".join(COLUMNS), row, row]))
    with pytest.raises(InputError, match="13 columns are needed, not 12"):
        parse_difference("\n".join([",".join(COLUMNS), row.rpartition(",")[0]]))
    with pytest.raises(InputError, match="cannot read the table of differences gone"):
        read_difference("gone")


def test_the_table_of_states_quotes_what_it_must() -> None:
    rows = [
        {"state": "a,b", "changed": True, "p_value": float("nan"), "targets": 3},
        failed_row("c", ["c.png"], "joint", 'no "dish", sorry'),
    ]
    found = list(csv.DictReader(io.StringIO(format_states(rows))))
    assert tuple(found[0]) == STATE_COLUMNS
    assert (found[0]["state"], found[0]["changed"], found[0]["p_value"], found[0]["targets"]) == ("a,b", "yes", "", "3")
    assert (found[1]["problem"], found[1]["shape_rms_mm"]) == ('no "dish", sorry', "")
