"""What is said of an analysis of gain: its words hold its figures, and its page works offline for every kind of antenna."""

from __future__ import annotations

from dataclasses import replace
from html import escape
from html.parser import HTMLParser

import numpy as np
import pytest
from rf_analyses import OFFSET, PRIME, SHAPING, analysis_of, changed

from dishmap.rf.analysis import Change
from dishmap.rf.correction import correction_of
from dishmap.rf.limits import value_names
from dishmap.rf_assumptions import NOT_MODELLED, assumptions
from dishmap.rf_report import rf_report
from dishmap.rf_tables import beam_rows, best_fit_rows, brief_rows, budget_rows, correction_rows, gain_rows, mode_rows
from dishmap.rf_verdict import gain_of, loss_of, rf_verdict


class Tags(HTMLParser):
    """All tags of a page with what they point to."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.images = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.images += tag == "img"
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]


def tags_of(page: str) -> Tags:
    tags = Tags()
    tags.feed(page)
    return tags


def test_headline_says_what_it_costs_and_what_wins_it_back() -> None:
    assert rf_verdict(analysis_of(PRIME)).headline == (
        "At 20 GHz the change of shape costs 1.250 ± 0.030 dB; moving the feed wins back 0.750 ± 0.020 dB."
    )
    assert rf_verdict(analysis_of(SHAPING)).headline == (
        "At 20 GHz the change of shape costs 1.250 ± 0.030 dB; moving the subreflector wins back 0.750 ± 0.020 dB; "
        "bending it as well wins back 0.750 ± 0.020 dB."
    )
    assert rf_verdict(analysis_of(PRIME, correct=False)).headline == "At 20 GHz the change of shape costs 1.250 ± 0.030 dB."


def test_headline_takes_the_highest_frequency() -> None:
    plain = analysis_of(PRIME, correct=False)
    two = changed(
        plain,
        options=replace(plain.options, frequencies_ghz=(20.0, 15.0)),
        states=tuple(replace(state, readings=2 * state.readings) for state in plain.states),
        lost=(Change(-1.0, 0.1, -1.2, -0.8), Change(-0.5, 0.1, -0.7, -0.3)),
    )
    assert rf_verdict(two).headline.startswith("At 20 GHz the change of shape costs 1.00 ± 0.10 dB")


def test_a_loss_within_its_sigma_is_none() -> None:
    small = changed(analysis_of(PRIME, correct=False), lost=(Change(-0.01, 0.02, -0.05, 0.01),))
    assert "nothing that the map can tell from zero: 0.010 ± 0.020 dB" in rf_verdict(small).headline


def test_warnings() -> None:
    plain = analysis_of(SHAPING)
    found = plain.corrections["corrected"]
    told = "\n".join(rf_verdict(plain).warnings)
    assert "12 % of the aperture's field" in told
    assert "the limit is reached of shift along z" in told
    unsure = changed(
        plain,
        extrapolated_share=0.0,
        quantity="surface",
        corrections={"corrected": replace(found, limits=(), converged=False, improved=False)},
        recovered={"corrected": plain.recovered["corrected"]},
        field=replace(plain.field, left_out=(3, 7), own_mm=1.0),
    )
    told = "\n".join(rf_verdict(unsure).warnings)
    assert "extrapolated" not in told
    known = ("one photograph", "did not come to rest", "stays where it is", "2 targets moved apart", "on their own by 1.00 mm")
    for words in known:
        assert words in told
    assert "wins nothing back" in rf_verdict(unsure).headline


def test_power_that_a_correction_makes_miss_the_dish() -> None:
    plain = analysis_of(PRIME)
    for share, words, warned in (
        (0.004, "Of the power that met the dish before, 0.4 % now misses it; the gain has that in it.", False),
        (0.023, "Of the power that met the dish before, 2.3 % now misses it; the gain has that in it.", True),
        (-0.0061, "The dish receives 0.61 % more power than before.", False),
        (-0.023, "The dish receives 2.3 % more power than before.", False),
        (0.0, "As much power meets the dish as before.", False),
    ):
        one = changed(plain, corrections={"corrected": replace(plain.corrections["corrected"], lost_share=share)})
        assert words in rf_report(one, "title", {})
        assert (f"`corrected`: {words}" in rf_verdict(one).warnings) == warned


def test_wrapped_phases_and_broken_beams_are_told() -> None:
    plain = analysis_of(PRIME, correct=False)
    design, measured = plain.states
    reading = measured.readings[0]
    path = replace(reading.path, half_path_mm=20 * reading.path.half_path_mm)
    lost = replace(reading, path=path, beam=replace(reading.beam, gain_dbi=reading.beam.gain_dbi - 20))
    told = "\n".join(rf_verdict(changed(plain, states=(design, replace(measured, readings=(lost,))))).warnings)
    assert "phases wrap" in told
    assert "broken up" in told
    assert "wrap" not in "\n".join(rf_verdict(plain).warnings)


def test_fixed_pointing_counts_on_the_boresight() -> None:
    plain = analysis_of(PRIME)
    fixed = changed(plain, options=replace(plain.options, pointing="fixed"))
    reading = plain.states[2].readings[0]
    assert gain_of(plain, reading)[0] == reading.beam.gain_dbi
    assert gain_of(fixed, reading)[0] == reading.beam.boresight_dbi < reading.beam.gain_dbi
    assert loss_of(fixed, plain.states[2], 0)[0] > loss_of(plain, plain.states[2], 0)[0]
    assert "boresight" in assumptions(fixed)[2]


def test_what_a_bend_is_asked_for_is_said_where_there_is_one() -> None:
    assert any("held as designed" in words for words in assumptions(analysis_of(SHAPING)))
    assert not any("held as designed" in words for words in assumptions(analysis_of(PRIME)))
    assert "That of a bend is rough" in rf_report(analysis_of(SHAPING), "title", {})
    assert "That of a bend is rough" not in rf_report(analysis_of(PRIME), "title", {})


def test_tables_hold_every_state_and_frequency() -> None:
    analysis = analysis_of(SHAPING, (15.0, 20.0))
    wanted = [[f, s] for f in ("15", "20") for s in ("design", "measured", "corrected", "shaped")]
    for rows_of in (brief_rows, gain_rows, beam_rows, budget_rows):
        heads, rows = rows_of(analysis)
        assert [row[:2] for row in rows] == wanted
        assert {len(row) for row in rows} == {len(heads)}
    gain = analysis.states[1].readings[1].beam.gain_dbi
    assert gain_rows(analysis)[1][5][2].startswith(f"{gain:.2f}")
    assert float(best_fit_rows(analysis)[1][5][2].split()[0]) == pytest.approx(analysis.best_fit.values[5], abs=0.01)
    heads, rows = mode_rows(analysis, 0, 2)
    assert (heads.count("alone (dB)"), heads.count("won back (dB)")) == (1, 3)
    assert {len(row) for row in rows} == {len(heads)}
    assert [row[0] for row in rows] == ["defocus (2, 0)", "astigmatism (2, 2)"]


def test_correction_table_says_which_limit_is_reached() -> None:
    analysis = analysis_of(SHAPING)
    rigid, shaped = (correction_rows(analysis, name)[1] for name in ("corrected", "shaped"))
    assert [row[0] for row in rigid] == ["shift x", "shift y", "shift z", "tilt x", "tilt y"]
    assert [row[4] for row in rigid] == ["", "", "at its limit", "", ""]
    assert rigid[2][2:4] == ["+0.3000 ± 0.0040", "± 2"]
    assert [row[0] for row in shaped[5:]] == [
        "shape, astigmatism sin (2, -2)",
        "shape, defocus (2, 0)",
        "shape, astigmatism cos (2, 2)",
        "shape, farthest point",
    ]


def test_correction_table_says_how_far_a_shape_goes_and_which_degrees_it_does_without() -> None:
    antenna = replace(SHAPING, actuators=replace(SHAPING.actuators, shape_degree=3))
    found = analysis_of(SHAPING).corrections["shaped"]
    # defocus of 0.1 mm: 0.1 mm at the middle and at the rim
    values = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    names, units = zip(*value_names(antenna.actuators), strict=True)
    bent = replace(found, correction=correction_of(values), names=names, units=units)
    rows = correction_rows(changed(analysis_of(SHAPING), antenna=antenna, corrections={"shaped": bent}, margins={}), "shaped")[1]
    assert [row[0] for row in rows[5:8]] == ["shape, astigmatism sin (2, -2)", "shape, defocus (2, 0)", "shape, astigmatism cos (2, 2)"]
    assert rows[8] == ["shape, above degree 2", "mm", "not used", "", ""]
    assert rows[9] == ["shape, farthest point", "mm", "0.1000", "± 1", ""]
    assert len(rows) == 10


def test_what_a_beam_does_not_have_is_a_dash() -> None:
    plain = analysis_of(PRIME, correct=False)
    design, measured = plain.states
    reading = measured.readings[0]
    lost = replace(reading, beam=replace(reading.beam, sidelobe_db=(-20.0, float("nan")), width_deg=(float("nan"), 3.0)))
    row = brief_rows(changed(plain, states=(design, replace(measured, readings=(lost,)))))[1][1]
    assert row[-2:] == ["- x 3.000", "-20.0, -"]


def test_page_needs_no_network_and_escapes() -> None:
    analysis = analysis_of(SHAPING)
    page = rf_report(analysis, "Gain <b>&", {"shape": "<script>alert(1)</script>"})
    tags = tags_of(page)
    assert all(link.startswith("data:") for link in tags.links)
    assert "<b>" not in page
    assert "<script>alert" not in page
    assert rf_verdict(analysis).headline in page
    # gain curve, antenna, modes, margin, three maps of the surface, path errors; phase, cuts and pattern of the frequency
    assert tags.images == 11
    for words in NOT_MODELLED:
        assert escape(words.split(":")[0]) in page
    assert ">nan<" not in page


def test_page_of_an_offset_dish_at_two_frequencies_without_a_correction() -> None:
    tags = tags_of(rf_report(analysis_of(OFFSET, (15.0, 20.0), correct=False), "title", {}))
    # no curve of the margin, but phase, cuts and pattern twice
    assert tags.images == 13


def test_page_of_a_perfect_dish_twice() -> None:
    plain = analysis_of(PRIME, correct=False)
    still = replace(plain.states[1], deformation=replace(plain.states[1].deformation, coefficients_mm=np.zeros(4)))
    flat = changed(plain, states=(plain.states[0], still), lost=(Change(0.0, 0.0, 0.0, 0.0),))
    page = rf_report(flat, "title", {})
    assert "costs 0 dB" in page
    assert page == rf_report(flat, "title", {})
