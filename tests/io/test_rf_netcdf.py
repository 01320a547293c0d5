"""NetCDF files: what is written is read, by us and by xarray, and equal content gives equal bytes."""

from __future__ import annotations

import io
import time
from pathlib import Path

import numpy as np
import pytest
import xarray
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dishmap.errors import InputError
from dishmap.io.rf_netcdf import Variable, cut_variables, grid_variables, netcdf_bytes, parse_netcdf, read_netcdf, write_netcdf
from dishmap.rf.pattern import Cut, PatternGrid

STATES, FREQUENCIES = ("before", "after"), (12.5, 30.0)


def grids() -> list[list[PatternGrid]]:
    """Fields that say where they stand: state, frequency, v, u; nothing beyond the horizon."""
    u, v = np.linspace(-1, 1, 5), np.linspace(-0.5, 0.5, 4)
    field = np.add.outer(v, 1j * u)
    field[np.add.outer(v**2, u**2) >= 1] = np.nan
    return [[PatternGrid(u / f, v / f, 10 * s + f * field, 1j * field) for f in (1, 2)] for s in (1, 2)]


def cuts() -> list[list[list[Cut]]]:
    theta = np.linspace(-3, 3, 7)
    return [
        [[Cut(theta / f, phi, s + f * phi * np.exp(1j * theta), 1j * phi - s * theta) for phi in (0.0, 45.0, 90.0)] for f in (1, 2)]
        for s in (1, 2)
    ]


def variables() -> dict[str, Variable]:
    x = np.linspace(-300.0, 300.0, 41)
    said = {"positive": "towards the focus"}
    return {
        **grid_variables(STATES, FREQUENCIES, grids()),
        **cut_variables(STATES, FREQUENCIES, cuts()),
        "x_mm": Variable(("x_mm",), x, "mm", "nominal x", True),
        "y_mm": Variable(("y_mm",), x, "mm", "nominal y", True),
        "displacement_mm": Variable(("y_mm", "x_mm"), np.hypot.outer(x, x), "mm", "along the normal", attributes=said),
        "gain_dbi": Variable(("state", "frequency_ghz"), np.array([[30.0, 37.5], [30.5, np.nan]]), "dB"),
        "wavelength_mm": Variable((), np.array(9.993), "mm"),
        "mode": Variable(("mode",), np.array(["defocus", "coma, α"])),
    }


def assert_equal(one: dict[str, Variable], two: dict[str, Variable]) -> None:
    assert set(one) == set(two)
    for name, a in one.items():
        b = two[name]
        assert (a.dims, a.units, a.long_name, dict(a.attributes)) == (b.dims, b.units, b.long_name, dict(b.attributes)), name
        assert a.coordinate == b.coordinate or a.dims == (name,), name
        assert a.values.shape == b.values.shape
        if a.values.dtype.kind in "US":
            assert a.values.tolist() == b.values.tolist()
        else:
            assert np.array_equal(a.values, b.values, equal_nan=True), name


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "rf.nc"
    write_netcdf(path, variables(), {"title": "a dish", "diameter_mm": 600.0, "struts": 3})
    back, attributes = read_netcdf(path)
    assert_equal(variables(), back)
    assert {key: attributes[key] for key in ("title", "diameter_mm", "struts")} == {"title": "a dish", "diameter_mm": 600.0, "struts": 3}
    assert str(attributes["source"]).startswith("dishmap ")
    assert [entry.name for entry in tmp_path.iterdir()] == ["rf.nc"]


def test_xarray_alone_reads_it() -> None:
    data = xarray.load_dataset(io.BytesIO(netcdf_bytes(variables())), engine="h5netcdf")
    assert data.attrs["Conventions"] == "CF-1.11"
    assert data["displacement_mm"].sel(x_mm=300, y_mm=0).item() == 300
    assert data["displacement_mm"].attrs == {"units": "mm", "long_name": "along the normal", "positive": "towards the focus"}
    gain = data["gain_dbi"].sel(state="after", frequency_ghz=12.5)
    assert gain.item() == 30.5
    after = data["grid_co_real"].sel(state="after", frequency_ghz=30.0) + 1j * data["grid_co_imag"].sel(state="after", frequency_ghz=30.0)
    assert np.array_equal(after.values, grids()[1][1].co, equal_nan=True)
    # where it lies comes along
    assert after["u"].values.tolist() == grids()[1][1].u.tolist()
    cut = data["cut_co_real"].sel(state="before", frequency_ghz=30.0, phi_deg=45.0)
    assert cut.values == pytest.approx(cuts()[0][1][1].co.real)
    crossed = data["cut_cross_imag"].sel(state="after", frequency_ghz=30.0, phi_deg=45.0)
    assert crossed.values.tolist() == cuts()[1][1][1].cross.imag.tolist()
    assert cut["theta_deg"].values == pytest.approx(cuts()[0][1][1].theta_deg)


def test_equal_content_gives_equal_bytes() -> None:
    first = netcdf_bytes(variables(), {"title": "a"})
    # HDF5 can keep times, in seconds
    time.sleep(1.1)
    assert netcdf_bytes(variables(), {"title": "a"}) == first
    assert netcdf_bytes(variables(), {"title": "b"}) != first


NUMBERS = [np.dtype(float), np.dtype(complex), np.dtype(np.int64)]
values = st.one_of(
    hnp.arrays(
        st.sampled_from([np.dtype(float), np.dtype(complex), np.dtype(np.int64)]), hnp.array_shapes(min_dims=0, max_dims=3, max_side=4)
    ),
    hnp.arrays(np.dtype("U5"), hnp.array_shapes(max_dims=1, max_side=4), elements=st.text("abcäß ", min_size=1, max_size=5)),
)


@settings(max_examples=25, deadline=None)
@given(values, st.text("abcÄ °/", max_size=9))
def test_any_array_reads_back(array: np.ndarray, text: str) -> None:
    one = {"a": Variable(tuple(f"axis_{i}" for i in range(array.ndim)), array, text, text)}
    back, _ = parse_netcdf(netcdf_bytes(one))
    assert_equal(one, back)


def test_what_cannot_be_written() -> None:
    one = Variable(("x",), np.zeros(3), "mm")
    for bad, message in [
        ({"a b": one}, "'a b' over .* cannot stand in a NetCDF file"),
        ({"a": Variable(("x", "y"), np.zeros(3))}, "a has 1 axes, and its dims are"),
        ({"a": Variable(("x", "x"), np.zeros((3, 3)))}, "a has 2 axes"),
        ({"a": one, "b": Variable(("x",), np.zeros(4))}, "the axis x has 4 values in b, and 3 in another variable"),
        ({"a": Variable(("x",), np.zeros(3, complex)), "a_real": one}, "'a_real' over"),
    ]:
        with pytest.raises(InputError, match=message):
            netcdf_bytes(bad)
    with pytest.raises(InputError, match="each of 2 states and, within it, each of 1 frequencies"):
        grid_variables(STATES, (30.0,), grids())
    other = grids()
    other[1][1] = PatternGrid(other[1][1].u * 1.1, other[1][1].v, other[1][1].co, other[1][1].cross)
    with pytest.raises(InputError, match="the same ones before and after"):
        grid_variables(STATES, FREQUENCIES, other)
    fewer = cuts()
    fewer[0][1] = fewer[0][1][:2]
    with pytest.raises(InputError, match="cuts of one file need the same azimuths"):
        cut_variables(STATES, FREQUENCIES, fewer)


def test_files_that_are_none(tmp_path: Path) -> None:
    path = tmp_path / "rf.nc"
    with pytest.raises(InputError, match=r"cannot read the NetCDF file .*No such file"):
        read_netcdf(path)
    whole = netcdf_bytes(variables())
    for data in (b"", b"text", whole[: len(whole) // 2]):
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"rf\.nc is no NetCDF 4 file that can be read"):
            read_netcdf(path)
