"""Far fields in GRASP's files: layouts, polarisations against vectors, feeds around the axis, and files that are not what they seem."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.io.grasp_pattern import cut_table, cuts_of, format_cuts, format_grd, parse_cuts, parse_grd
from dishmap.rf.antenna import POLARIZATIONS, Feed
from dishmap.rf.feed import feed_field, ludwig_axes, radiated
from dishmap.rf.pattern import Cut, PatternGrid

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Numbers stand in files with 11 digits.
DIGITS = 2e-10

# The layout of a file as GRASP writes it, with what Fortran does to small numbers.
SAMPLE = """\
Field data in cuts                                                                          
 -0.1000000000E+01  0.1000000000E+01    3  0.0000000000E+00    3    1    2
  0.5000000000E+00  0.2500000000E+00  0.1234000000-101  0.0000000000E+00
  0.1000000000E+01  0.0000000000E+00 -0.7488560580E-15  0.7837224872E-15
  0.5000000000D+00 -0.2500000000E+00  0.0000000000E+00  0.1000000000E-02
Field data in cuts
  0.0000000000E+00  0.2500000000E+01    1  0.9000000000E+02    3    1    2
  0.1000000000E+01  0.0000000000E+00  0.0000000000E+00  0.0000000000E+00
"""  # noqa: W291


def directions(theta_deg: Array, phi_deg: float) -> tuple[Array, Array, Array]:
    """Unit vectors (T, 3) to theta and phi, and those along rising theta and phi, all also where theta is negative."""
    t, p = np.radians(theta_deg)[:, None], np.radians(phi_deg)
    radial = np.sin(t) * [np.cos(p), np.sin(p), 0.0] + np.cos(t) * [0.0, 0.0, 1.0]
    return radial, np.cos(t) * [np.cos(p), np.sin(p), 0.0] - np.sin(t) * [0.0, 0.0, 1.0], np.tile([-np.sin(p), np.cos(p), 0.0], (len(t), 1))


def dipole(direction: Array, moment: Complex) -> Complex:
    """Far field (N, 3) of a short dipole: what of it lies across the direction."""
    return np.asarray(moment - (direction @ moment)[:, None] * direction)


def file_of(theta_deg: Array, azimuths: list[float], moment: Complex, icomp: int) -> str:
    """A .cut file of a dipole, its components by the dot products of vectors."""
    lines = []
    for phi in azimuths:
        radial, along_theta, along_phi = directions(theta_deg, phi)
        field = dipole(radial, moment)
        along_x, along_y = ludwig_axes(radial)
        axes = {
            1: (along_theta, along_phi),
            2: ((along_x - 1j * along_y) / np.sqrt(2), (along_x + 1j * along_y) / np.sqrt(2)),
            3: (along_x, along_y),
        }[icomp]
        first, second = ((field * axis.conj()).sum(axis=1) for axis in axes)
        lines += ["a dipole", f"{theta_deg[0]} {theta_deg[1] - theta_deg[0]} {len(theta_deg)} {phi} {icomp} 1 2"]
        lines += [f"{a.real!r} {a.imag!r} {b.real!r} {b.imag!r}" for a, b in zip(first.tolist(), second.tolist(), strict=True)]
    return "\n".join(lines)


MOMENTS = {
    "x": np.array([1, 0, 0], complex),
    "y": np.array([0, 1, 0], complex),
    "right": np.array([1, -1j, 0]) / np.sqrt(2),
    "tilted": np.array([0.3 + 0.2j, -0.5j, 0.4]),
}


def test_a_file_as_grasp_writes_it() -> None:
    first, second = parse_cuts(SAMPLE)
    assert first.theta_deg.tolist() == [-1, 0, 1]
    assert first.co.tolist() == [0.5 + 0.25j, 1, 0.5 - 0.25j]
    assert first.cross.tolist() == [1.234e-102, -7.488560580e-16 + 7.837224872e-16j, 1e-3j]
    assert (second.theta_deg.tolist(), second.phi_deg, second.co.tolist()) == ([0], 90, [1])


def test_what_is_written_has_that_layout() -> None:
    cut = Cut(np.array([-0.5, 0.0, 0.5]), 45.0, np.array([1 + 2j, 3, 4]), np.array([0, 1j, 0]))
    lines = format_cuts([cut], text="two\nlines ").splitlines()
    assert lines[0] == "two lines"
    assert [float(word) for word in lines[1].split()] == [-0.5, 0.5, 3, 45, 3, 1, 2]
    assert [float(word) for word in lines[2].split()] == [1, 2, 0, 0]
    assert len(lines) == 5


@pytest.mark.parametrize("icomp", [1, 2, 3])
@pytest.mark.parametrize("moment", MOMENTS.values(), ids=MOMENTS)
def test_components_are_those_of_vectors(icomp: int, moment: Complex) -> None:
    # at theta -180 Ludwig's axes are not defined
    theta = np.arange(-170.0, 171.0, 10.0)
    for phi, cut in zip((0.0, 30.0, 135.0), parse_cuts(file_of(theta, [0.0, 30.0, 135.0], moment, icomp)), strict=True):
        radial, *_ = directions(theta, phi)
        field = dipole(radial, moment)
        for found, axis in zip((cut.co, cut.cross), ludwig_axes(radial), strict=True):
            assert found == pytest.approx((field * axis).sum(axis=1), abs=1e-12)


def test_a_third_component_is_that_of_a_near_field() -> None:
    text = "both\n0 1 2 0 3 1 3\n1 2 3 4 {} 0\n5 6 7 8 0 1e-12\n"
    (cut,) = parse_cuts(text.format("1e-6"))
    assert cut.co.tolist() == [1 + 2j, 5 + 6j]
    assert cut.cross.tolist() == [3 + 4j, 7 + 8j]
    with pytest.raises(InputError, match="line 4: the third component, along the ray, is not small: this is a near field"):
        parse_cuts(text.format("0.5"), "c")


def test_a_huygens_source_has_no_cross_polarisation() -> None:
    theta = np.arange(-90.0, 91.0, 15.0)
    lines = []
    for phi in (0.0, 50.0):
        amplitude = (1 + np.cos(np.radians(theta))) / 2
        lines += ["Huygens", f"-90 15 {len(theta)} {phi} 1 1 2"]
        lines += [f"{a * np.cos(np.radians(phi))} 0 {-a * np.sin(np.radians(phi))} 0" for a in amplitude]
    for cut in parse_cuts("\n".join(lines)):
        assert cut.co == pytest.approx((1 + np.cos(np.radians(theta))) / 2, abs=1e-12)
        assert np.abs(cut.cross).max() < 1e-12


def test_a_right_handed_wave_turns_from_x_to_y() -> None:
    # x first and y a quarter of a period later, seen along the way it goes: the right hand, with time as exp(+j w t)
    moment = MOMENTS["right"]
    now, later = moment.real, (moment * np.exp(1j * np.pi / 2)).real
    assert np.cross(now, later)[2] > 0
    text = file_of(np.array([0.0, 1.0]), [0.0], moment, 3)
    (right,), (left,) = (parse_cuts(text, polarization=hand) for hand in ("right", "left"))
    assert abs(right.co[0]) == pytest.approx(1)
    assert abs(right.cross[0]) < 1e-12
    assert abs(left.cross[0]) == pytest.approx(1)


@pytest.mark.parametrize("moment", MOMENTS.values(), ids=MOMENTS)
@pytest.mark.parametrize("icomp", [1, 2, 3])
def test_cuts_both_ways_are_completed_around_the_axis(icomp: int, moment: Complex) -> None:
    both = np.arange(-120.0, 121.0, 20.0)
    half = cut_table(parse_cuts(file_of(both, [0.0, 45.0, 90.0, 135.0], moment, icomp)))
    azimuths = [45.0 * i for i in range(8)]
    full = cut_table(parse_cuts(file_of(both[6:], azimuths, moment, icomp)))
    doubled = cut_table(parse_cuts(file_of(both, [*azimuths, 360.0], moment, icomp)))
    for table in (half, full, doubled):
        assert table.theta_deg.tolist() == [0, 20, 40, 60, 80, 100, 120]
        assert table.phi_deg.tolist() == azimuths
        for row, phi in enumerate(azimuths):
            radial, *_ = directions(table.theta_deg, phi)
            field = dipole(radial, moment)
            for found, axis in zip((table.co[row], table.cross[row]), ludwig_axes(radial), strict=True):
                assert found == pytest.approx((field * axis).sum(axis=1), abs=1e-12)


@pytest.mark.parametrize("polarization", POLARIZATIONS)
def test_a_table_radiates_what_it_holds(polarization: str) -> None:
    table = cut_table(parse_cuts(file_of(np.arange(0.0, 171.0, 5.0), [30.0 * i for i in range(12)], MOMENTS["tilted"], 1)))
    field = feed_field(Feed("cut", polarization=polarization, table=table), 1.0, 1)
    direction = np.array([np.r_[0.6, 0.0, 0.8], np.r_[-0.36, 0.48, 0.8], np.r_[0.0, -0.8, 0.6]])
    found, wanted = radiated(field, direction), dipole(direction, MOMENTS["tilted"])
    # splines over 5 degrees
    assert found / np.linalg.norm(found[0]) == pytest.approx(wanted / np.linalg.norm(wanted[0]), abs=1e-4)


def test_the_cuts_of_a_table_give_it_back() -> None:
    table = cut_table(parse_cuts(file_of(np.arange(0.0, 91.0, 10.0), [0.0, 120.0, 240.0], MOMENTS["tilted"], 2)))
    again = cut_table(parse_cuts(format_cuts(cuts_of(table))))
    assert again.phi_deg.tolist() == table.phi_deg.tolist()
    assert np.abs(again.co - table.co).max() < DIGITS
    assert np.abs(again.cross - table.cross).max() < DIGITS


parts = st.floats(-1e150, 1e150)
fields = st.builds(complex, parts, parts)


@given(
    hnp.arrays(complex, st.tuples(st.just(2), st.integers(2, 9)), elements=fields),
    st.floats(-180, 0),
    st.floats(0.01, 20),
    st.floats(0, 360),
    st.sampled_from(POLARIZATIONS),
)
def test_any_cut_reads_back(field: Complex, start: float, step: float, phi: float, polarization: str) -> None:
    cut = Cut(start + step * np.arange(field.shape[1]), phi, *field)
    (back,) = parse_cuts(format_cuts([cut], polarization), polarization=polarization)
    assert back.theta_deg == pytest.approx(cut.theta_deg, abs=1e-6)
    assert back.phi_deg == pytest.approx(phi, rel=DIGITS)
    scale = np.abs(field).max()
    assert np.abs([back.co, back.cross] - field).max() <= DIGITS * scale


@given(
    hnp.arrays(complex, (2, 3), elements=st.builds(complex, st.floats(-9, 9), st.floats(-9, 9))),
    st.sampled_from([1, 2, 3]),
    st.floats(0, 360),
)
def test_gain_does_not_depend_on_the_polarisation_read(field: Complex, icomp: int, phi: float) -> None:
    lines = ["any", f"0 1 3 {phi} {icomp} 1 2", *(f"{a.real} {a.imag} {b.real} {b.imag}" for a, b in field.T)]
    for polarization in POLARIZATIONS:
        (cut,) = parse_cuts("\n".join(lines), polarization=polarization)
        assert np.abs(cut.co) ** 2 + np.abs(cut.cross) ** 2 == pytest.approx((np.abs(field) ** 2).sum(axis=0), abs=1e-9)


def grid_of(edge: float, nodes: int, generator: np.random.Generator) -> PatternGrid:
    u, v = np.linspace(-edge, edge, nodes), np.linspace(-edge, edge, nodes + 1)
    co, cross = (_noise(generator, nodes) for _ in range(2))
    co[np.add.outer(v**2, u**2) >= 1] = cross[np.add.outer(v**2, u**2) >= 1] = np.nan
    return PatternGrid(u, v, co, cross)


def _noise(generator: np.random.Generator, nodes: int) -> Complex:
    return np.asarray(generator.normal(size=(nodes + 1, nodes)) + 1j * generator.normal(size=(nodes + 1, nodes)))


@settings(max_examples=40)
@given(st.floats(0.01, 1.5), st.integers(2, 12), st.integers(0, 2**31), st.sampled_from(POLARIZATIONS))
def test_any_grid_reads_back(edge: float, nodes: int, seed: int, polarization: str) -> None:
    generator = np.random.default_rng(seed)
    grids = [grid_of(edge, nodes, generator), grid_of(edge / 2, nodes + 1, generator)]
    back = parse_grd(format_grd(grids, [12.5, 30.0], polarization), polarization=polarization)
    for one, two in zip(grids, back, strict=True):
        assert two.u == pytest.approx(one.u, abs=1e-9)
        assert two.v == pytest.approx(one.v, abs=1e-9)
        assert (np.isnan(one.co) == np.isnan(two.co)).all()
        assert np.nanmax(np.abs(one.co - two.co), initial=0.0) < 1e-9
        assert np.nanmax(np.abs(one.cross - two.cross), initial=0.0) < 1e-9


GRID = """\
VERSION: TICRA-EM-FIELD-V0.1
Field data in grid
FREQUENCIES [GHz]:
  0.3000000000E+02
++++
   1
   1   3   2   1
   1   0
 -0.1000000000E+00 -0.2000000000E+00  0.1000000000E+00  0.2000000000E+00
   3   2   0
  0.1000000000E+01  0.0000000000E+00  0.0000000000E+00  0.0000000000E+00
  0.2000000000E+01  0.0000000000E+00  0.0000000000E+00  0.0000000000E+00
  0.3000000000E+01  0.0000000000E+00  0.0000000000E+00  0.0000000000E+00
  0.4000000000E+01  0.0000000000E+00  0.0000000000E+00  0.1000000000-100
  0.5000000000E+01  0.0000000000E+00  0.0000000000E+00  0.0000000000E+00
  0.6000000000E+01  0.5000000000E+00  0.0000000000E+00  0.0000000000E+00
"""


def test_a_grid_as_grasp_writes_it() -> None:
    (grid,) = parse_grd(GRID)
    # x runs fastest, and the centre lies one step along it
    assert grid.u == pytest.approx([0.0, 0.1, 0.2])
    assert grid.v == pytest.approx([-0.2, 0.2])
    assert grid.co.tolist() == [[1, 2, 3], [4, 5, 6 + 0.5j]]
    assert grid.cross[1, 0] == 1e-101j


def test_whole_grids_are_written_without_limits_of_rows() -> None:
    grid = grid_of(0.1, 3, np.random.default_rng(0))
    assert format_grd([grid], [30.0]).splitlines()[11].split() == ["3", "4", "0"]
    wide = grid_of(1.2, 3, np.random.default_rng(0))
    lines = format_grd([wide], [30.0]).splitlines()
    assert lines[11].split() == ["3", "4", "1"]
    assert lines[12].split() == ["0", "0"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("   1   3   2   1", "   1   3   2   7", "^g.grd, line 7: IGRID is 7, and only 1"),
        ("   1   3   2   1", "   1   9   2   1", "ICOMP is 9; 1 "),
        ("   1   3   2   1", "   1   3   4   1", "NCOMP is 4, and fields of 2 components"),
        ("   1   3   2   1", "   2000000000   3   2   1", "line 7: 2000000000 numbers .NSET. are announced, and the rest"),
        ("++++\n   1\n", "++++\n   2\n", "KTYPE is 2"),
        ("++++", "----", "^g.grd ends after 16 lines, where a line .* should follow"),
        ("   3   2   0", "   300000   200000   0", "line 10: 240000000000 numbers .* are announced"),
        ("   3   2   0", "   2000000000   2   1", "larger than 20000000 nodes"),
        ("   3   2   0", "   3   2   5", "KLIMIT 0 or 1, not 3, 2 and 5"),
        ("   3   2   0", "   3   2.5   0", "must be whole numbers"),
        ("   3   2   0", "   3   2   1", "line 13: more follows than the file announces"),
        ("   1   0\n", "   1000   0\n", "line 10: u from 99.9 to 100.1 and v from -0.2 to 0.2 are no direction cosines"),
        ("0.2000000000E+01", "NaN", "line 12: 'NaN' is no finite number"),
        ("0.2000000000E+01", "abc", "line 12: 'abc' is no number"),
        ("0.6000000000E+01  0.5000000000E+00  0.0000000000E+00  0.0000000000E+00\n", "", "ends after 16 lines, where 4 more of 12 numbers"),
    ],
)
def test_grids_that_are_not_read(old: str, new: str, message: str) -> None:
    assert old in GRID
    with pytest.raises(InputError, match=message):
        parse_grd(GRID.replace(old, new), "g.grd")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("3    1    2", "3    2    2", "^c.cut, line 2: ICUT is 2, and only polar cuts"),
        ("3    1    2", "5    1    2", "line 2: ICOMP is 5"),
        ("3    1    2", "3    1    1", "line 2: NCOMP is 1"),
        ("3    1    2", "3    1", "line 2: V_INI V_INC V_NUM C ICOMP ICUT NCOMP are needed .7 numbers., not"),
        ("E+01    3 ", "E+01    3000000000 ", "12000000000 numbers .* are announced"),
        ("E+01    3 ", "E+01    -3 ", "V_NUM -3"),
        ("E+01    3 ", "E+01    4 ", "line 6: 'Field' is no number"),
        ("0.1000000000E+01    3 ", "0.0000000000E+00    3 ", "V_INC 0"),
        ("0.2500000000E+00", "inf", "line 3: 'inf' is no finite number"),
    ],
)
def test_cuts_that_are_not_read(old: str, new: str, message: str) -> None:
    assert old in SAMPLE
    with pytest.raises(InputError, match=message):
        parse_cuts(SAMPLE.replace(old, new, 1), "c.cut")
    with pytest.raises(InputError, match="holds no cut"):
        parse_cuts("\n \n", "c.cut")


def test_feeds_that_are_none() -> None:
    theta, both = np.arange(0.0, 61.0, 20.0), np.arange(-60.0, 61.0, 20.0)
    x = MOMENTS["x"]
    for angles, azimuths, message in [
        (
            theta,
            [0.0, 45.0, 90.0, 135.0],
            "three or more azimuths in equal steps all around, not phi 0, 45, 90, 135; cuts",
        ),
        (theta, [0.0], "not phi 0;"),
        (both, [0.0], "not phi 0, 180;"),
        (both, [0.0, 30.0], "not phi 0, 30, 180, 210;"),
        (theta + 5, [0.0, 120.0, 240.0], "must run from 0 to T or from -T to T .* not from 5 to 65 in 4 angles"),
        (np.arange(-60.0, 81.0, 20.0), [0.0, 90.0], "not from -60 to 80"),
        (np.arange(0.0, 361.0, 20.0), [0.0, 90.0, 180.0, 270.0], "not from 0 to 360"),
    ]:
        with pytest.raises(InputError, match=message):
            cut_table(parse_cuts(file_of(angles, azimuths, x, 3)), "f.cut")
    cuts = parse_cuts(file_of(theta, [0.0, 120.0, 240.0], x, 3))
    other = Cut(theta, 120.0, 2 * cuts[1].co, cuts[1].cross)
    with pytest.raises(InputError, match="different fields at phi 120 degrees; give the cuts of one frequency"):
        cut_table([*cuts, other])
    with pytest.raises(InputError, match="different angles theta"):
        cut_table([*cuts, Cut(theta[:-1], 120.0, cuts[1].co[:-1], cuts[1].cross[:-1])])
    with pytest.raises(InputError, match="there is no cut"):
        cut_table([])


def test_what_cannot_be_written() -> None:
    cut = Cut(np.array([0.0, 1.0, 3.0]), 0.0, np.ones(3, complex), np.ones(3, complex))
    with pytest.raises(InputError, match="theta of a cut must rise in equal steps"):
        format_cuts([cut])
    with pytest.raises(InputError, match="no field somewhere"):
        format_cuts([Cut(np.arange(3.0), 0.0, np.array([1, np.nan, 1], complex), np.ones(3, complex))])
    with pytest.raises(InputError, match="unknown polarization 'z'"):
        format_cuts([Cut(np.arange(3.0), 0.0, cut.co, cut.cross)], "z")
    grid = grid_of(0.1, 4, np.random.default_rng(0))
    grid.co[1, 1] = np.nan
    with pytest.raises(InputError, match="has a gap along u"):
        format_grd([grid], [30.0])
    with pytest.raises(InputError, match="1 grids need as many frequencies, not 2"):
        format_grd([grid], [30.0, 12.5])


def test_a_large_grid_is_quick() -> None:
    grid = grid_of(0.2, 400, np.random.default_rng(0))
    start = time.process_time()
    (back,) = parse_grd(format_grd([grid], [30.0]))
    # 0.8 s here; a hundred times slower if the rest of the file were looked through for every line
    assert time.process_time() - start < 8
    assert np.abs(back.co - grid.co).max() < DIGITS * 10
