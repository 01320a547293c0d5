"""Antenna files: what they say is the antenna that is reckoned with, and mistakes are named."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dishmap.errors import InputError
from dishmap.io.antenna_file import AntennaModel, format_antenna, parse_antenna, read_antenna
from dishmap.io.grasp_pattern import cuts_of, format_cuts
from dishmap.rf.antenna import (
    FEED_KINDS,
    POLARIZATIONS,
    SUBREFLECTOR_KINDS,
    Actuators,
    Antenna,
    Blockage,
    CutTable,
    Feed,
    Reflector,
    Subreflector,
)

EXAMPLES = sorted((Path(__file__).resolve().parents[2] / "examples").glob("antenna-*.toml"))

SMALL = """
[reflector]
diameter_mm = 600
focal_length_mm = 300
[feed]
edge_taper_db = 12
[subreflector]
kind = "cassegrain"
foci_distance_mm = 220
magnification = 4
[blockage]
struts = 3
strut_width_mm = 4
[actuators]
shift_mm = 7
tilt_deg = [1, 2]
shape_degree = 4
shape_stroke_mm = 2.5
"""


def test_a_file_becomes_an_antenna() -> None:
    assert parse_antenna(SMALL) == Antenna(
        Reflector(600.0, 300.0),
        Feed("gaussian", 12.0),
        Subreflector("cassegrain", 220.0, 4.0),
        Blockage(None, 3, 4.0),
        Actuators((7.0, 7.0, 7.0), (1.0, 2.0), 4, 2.5),
    )


def test_what_is_left_out_is_as_the_records_have_it() -> None:
    short = parse_antenna(SMALL[: SMALL.index("[subreflector]")])
    assert short == Antenna(Reflector(600.0, 300.0), Feed(edge_taper_db=12.0))
    assert parse_antenna('format = "dishmap-antenna/1"\n' + SMALL) == parse_antenna(SMALL)


def test_the_examples_are_valid() -> None:
    by_name = {path.stem.removeprefix("antenna-"): read_antenna(path) for path in EXAMPLES}
    assert set(by_name) == {"prime-focus", "cassegrain", "gregorian", "offset", "shape-changing"}
    assert all(antenna.reflector.diameter_mm == 600 for antenna in by_name.values())
    assert by_name["prime-focus"].subreflector is None
    assert by_name["offset"].reflector.offset_mm - 300 == 40
    assert by_name["shape-changing"].actuators.shape_degree == 6
    kinds = [by_name[name].subreflector for name in SUBREFLECTOR_KINDS]
    assert [sub.kind for sub in kinds if sub] == list(SUBREFLECTOR_KINDS)


def test_the_page_names_every_key() -> None:
    page = (EXAMPLES[0].parents[1] / "docs" / "rf-files.md").read_text()
    for name, table in AntennaModel.model_fields.items():
        model = next((part for part in (table.annotation, *get_args(table.annotation)) if hasattr(part, "model_fields")), None)
        assert f"`[{name}]`" in page or (name == "format" and model is None)
        assert all(f"`{key}`" in page for key in (model.model_fields if model else []))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_the_examples_read_back(path: Path) -> None:
    antenna = read_antenna(path)
    assert parse_antenna(format_antenna(antenna)) == antenna


def horn() -> CutTable:
    """A feed that falls off, with some cross-polarisation between the axes."""
    theta, phi = np.arange(0.0, 91.0, 10.0), np.arange(0.0, 360.0, 45.0)
    co = np.tile(np.cos(np.radians(theta)) ** 3 * (1 + 0.5j), (len(phi), 1))
    return CutTable(theta, phi, co, 0.01 * np.sin(2 * np.radians(phi))[:, None] * co)


def test_a_feed_from_a_file_beside_it(tmp_path: Path) -> None:
    antenna = Antenna(Reflector(600.0, 300.0), Feed("cut", polarization="right", table=horn()))
    (tmp_path / "my horn.cut").write_text(format_cuts(cuts_of(horn())))
    (tmp_path / "antenna.toml").write_text(format_antenna(antenna, "my horn.cut"))
    back = read_antenna(tmp_path / "antenna.toml")
    assert back.feed.polarization == "right"
    assert back.feed.table is not None
    for name in ("theta_deg", "phi_deg", "co", "cross"):
        # 11 digits in the file
        assert np.abs(getattr(back.feed.table, name) - getattr(horn(), name)).max() < 1e-8
    (tmp_path / "my horn.cut").write_text(format_cuts(cuts_of(horn())[:1]))
    with pytest.raises(InputError, match=r"antenna\.toml: \[feed\] .*my horn\.cut: a feed needs three or more azimuths"):
        read_antenna(tmp_path / "antenna.toml")
    (tmp_path / "my horn.cut").unlink()
    with pytest.raises(InputError, match=r"antenna\.toml: \[feed\] cannot read the cut file .*my horn\.cut: No such file"):
        read_antenna(tmp_path / "antenna.toml")


def test_every_commented_key_of_the_example_is_valid(tmp_path: Path) -> None:
    text = next(path for path in EXAMPLES if "prime" in path.stem).read_text()
    (tmp_path / "feed.cut").write_text(format_cuts(cuts_of(horn())))
    without = text.replace("edge_taper_db = 12 ", "# edge_taper_db = 12 ")
    cosine = parse_antenna(without.replace('kind = "gaussian"', 'kind = "cosine"').replace("# exponent", "exponent"))
    assert (cosine.feed.kind, cosine.feed.exponent) == ("cosine", 4)
    cut = parse_antenna(without.replace('kind = "gaussian"', 'kind = "cut"').replace("# file", "file"), tmp_path)
    assert cut.feed.table is not None


lengths = st.floats(1e-3, 1e5)


@st.composite
def antennas(draw: st.DrawFn) -> Antenna:
    diameter = draw(st.floats(30, 5e4))
    reflector = Reflector(diameter, diameter * draw(st.floats(0.11, 19)), draw(st.floats(-1e5, 1e5)))
    kind = draw(st.sampled_from([kind for kind in FEED_KINDS if kind != "cut"]))
    value = draw(st.floats(0.1, 60))
    polarization = draw(st.sampled_from(POLARIZATIONS))
    cosine = kind == "cosine" and draw(st.booleans())
    feed = Feed(kind, exponent=value, polarization=polarization) if cosine else Feed(kind, value, polarization=polarization)
    # an ellipsoid fits every dish
    sub = draw(st.none() | st.builds(Subreflector, st.just("gregorian"), lengths, st.floats(1.01, 1000), st.none() | lengths))
    struts = draw(st.integers(0, 12))
    narrow = st.floats(1e-3, 0.99 * diameter)
    shade = Blockage(draw(st.none() | narrow), struts, draw(narrow) if struts else 0.0, draw(st.floats(-360, 360)))
    degree = draw(st.sampled_from([0, 2, 12])) if sub else 0
    tilt = st.floats(0, 30)
    moves = Actuators(draw(st.tuples(lengths, lengths, lengths)), draw(st.tuples(tilt, tilt)), degree, draw(lengths) if degree else 0.0)
    return Antenna(reflector, feed, sub, shade, moves)


@given(antennas())
def test_any_antenna_reads_back_equal(antenna: Antenna) -> None:
    assert parse_antenna(format_antenna(antenna)) == antenna


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "diameter_mm = 600",
            "diameter_m = 0.6",
            r"^dish\.toml: unknown key 'diameter_m' in reflector; the nearest valid one is 'diameter_mm'",
        ),
        ("strut_width_mm = 4", "strut_width_mm = 600", "a blocked strut of 600 mm leaves nothing of an aperture of 600 mm"),
        ("[feed]", "[fed]", r"unknown key 'fed' in the file; the nearest valid one is 'feed' \(all: format, reflector"),
        ("focal_length_mm = 300", "", "^dish.toml: reflector lacks the key 'focal_length_mm'$"),
        ("diameter_mm = 600", "diameter_mm = 0.6", "diameter_mm = 0.6 is no dish between 30 mm and 100 m; .* so 0.6 m is 600$"),
        ("diameter_mm = 600", "diameter_mm = 6e5", "diameter_mm = 600000 is no dish"),
        ("focal_length_mm = 300", "focal_length_mm = 0.3", r"focal_length_mm = 0.3 is 0.0005 times diameter_mm = 600, and 0.1 to 20 times"),
        ("diameter_mm = 600", "diameter_mm = nan", "reflector.diameter_mm must be a finite number, not nan$"),
        ("diameter_mm = 600", 'diameter_mm = "600"', "reflector.diameter_mm must be a valid number, not '600'$"),
        ("diameter_mm = 600", "diameter_mm = -600", r"^dish.toml: \[reflector\] the diameter of the reflector must be a positive number"),
        ('"cassegrain"', '"casegrain"', r"\[subreflector\] unknown subreflector 'casegrain'; the nearest is 'cassegrain'"),
        ("edge_taper_db = 12", "", r"\[feed\] a gaussian feed needs edge_taper_db and nothing else, not nothing"),
        ("edge_taper_db = 12", 'kind = "cut"', r"\[feed\] kind = 'cut' and file .* go together"),
        ("edge_taper_db = 12", 'edge_taper_db = 12\nfile = "a.cut"', r"\[feed\] kind = 'cut' and file .* go together"),
        ("edge_taper_db = 12", "edge_taper_db = -12", r"\[feed\] the edge taper must be a positive number of dB"),
        ("magnification = 4", "magnification = 0.5", r"\[subreflector\] the magnification"),
        ("foci_distance_mm = 220", "foci_distance_mm = 2200", "^dish.toml: the subreflector's vertex would lie at z = .* behind"),
        ("struts = 3", "struts = 3.5", "blockage.struts must be a valid integer"),
        ("strut_width_mm = 4", "", r"\[blockage\] struts need a number and a width"),
        ("shift_mm = 7", "shift_mm = [7, 7]", "actuators.shift_mm must have at least 3 items"),
        ("shift_mm = 7", "shift_mm = true", "actuators.shift_mm.* must be a valid number, not True"),
        ("tilt_deg = [1, 2]", "tilt_deg = 90", r"\[actuators\] tilts about x and y must lie between 0 and 30 degrees, not 90"),
        ("[feed]", "[feed", "^dish.toml is not valid TOML"),
        ("[reflector]", 'format = "dishmap-antenna/2"\n[reflector]', "format must be 'dishmap-antenna/1', not 'dishmap-antenna/2'"),
    ],
)
def test_mistakes_are_named(old: str, new: str, message: str) -> None:
    assert old in SMALL
    with pytest.raises(InputError, match=message) as caught:
        parse_antenna(SMALL.replace(old, new), source="dish.toml")
    assert "\n" not in str(caught.value) or "TOML" in str(caught.value)


def test_files_that_are_no_text_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot read the antenna file .*none\.toml: No such file"):
        read_antenna(tmp_path / "none.toml")
    path = tmp_path / "a.toml"
    path.write_bytes(b"\xff\x00")
    with pytest.raises(InputError, match="no antenna file: it is not text"):
        read_antenna(path)
    path.write_bytes(b"#" * 1_000_001)
    with pytest.raises(InputError, match="larger than 1 MB, so it is no antenna file"):
        read_antenna(path)
