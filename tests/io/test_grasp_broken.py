"""Whatever is done to a file of GRASP's or of ours: it is read, or refused in a sentence that names it, and quickly."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dishmap.errors import InputError
from dishmap.io.antenna_file import parse_antenna
from dishmap.io.grasp_pattern import cut_table, format_cuts, format_grd, parse_cuts, parse_grd
from dishmap.io.grasp_surface import (
    SurfaceGrid,
    SurfacePoints,
    SurfaceRim,
    format_grid,
    format_points,
    format_rim,
    parse_grid,
    parse_points,
    parse_rim,
)
from dishmap.rf.pattern import Cut, PatternGrid

AXIS = np.array([-1.0, 0.0, 1.0])
FIELD = np.arange(9.0).reshape(3, 3) + 1j
NEAR = np.where(np.add.outer(AXIS**2, AXIS**2) < 1, FIELD, np.nan)
CUTS = format_cuts([Cut(AXIS, 60.0 * i, FIELD[0], FIELD[1]) for i in range(3)])
ANTENNA = "[reflector]\ndiameter_mm = 600\nfocal_length_mm = 300\n[feed]\nedge_taper_db = 12\n[actuators]\nshift_mm = [1, 2, 3]\n"

# a text, and what reads it
FILES: dict[str, tuple[str, Callable[[str], object]]] = {
    "sfc": (format_grid(SurfaceGrid(AXIS, AXIS, FIELD.real)), lambda text: parse_grid(text, "a file")),
    "points": (format_points(SurfacePoints(FIELD.real)), lambda text: parse_points(text, "a file")),
    "rim": (format_rim(SurfaceRim(FIELD.real[:, :2])), lambda text: parse_rim(text, "a file")),
    "cut": (CUTS, lambda text: cut_table(parse_cuts(text, "a file"), "a file")),
    "grd": (format_grd([PatternGrid(AXIS / 2, AXIS / 2, FIELD, FIELD)], [30.0]), lambda text: parse_grd(text, "a file")),
    "grd with limits": (format_grd([PatternGrid(AXIS, AXIS, NEAR, NEAR)], [30.0]), lambda text: parse_grd(text, "a file")),
    "antenna": (ANTENNA, lambda text: parse_antenna(text, source="a file")),
}
PIECES = st.sampled_from(
    ["", " ", "\n", "-", "1e300", "1e999", "nan", "999999999999", "0", "1-400", "x", ".", "\x00", "1_0", "=", '"', "ß", "é\u2028"]
)


def test_the_texts_themselves_are_read() -> None:
    for text, read in FILES.values():
        read(text)


@pytest.mark.parametrize("kind", FILES)
@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_changed_text_is_read_or_refused(kind: str, data: st.DataObject) -> None:
    text, read = FILES[kind]
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(text)))
        stop = data.draw(st.integers(start, min(len(text), start + 25)))
        text = text[:start] + data.draw(PIECES) + text[stop:]
    start_s = time.process_time()
    said = ""
    try:
        read(text)
    except InputError as error:
        said = str(error)
    assert not said or (said.startswith("a file") and len(said) < 600)
    assert time.process_time() - start_s < 2
