"""`rf.nc`: a NetCDF 4 file of named arrays, as xarray and other programs read them.

Any array with named axes can stand in it. Complex ones are kept as two, NAME_real and NAME_imag, since NetCDF has no complex numbers;
`units` and `long_name` are attributes as the CF conventions have them. Equal content gives equal bytes.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap import __version__
from dishmap.errors import InputError
from dishmap.io.atomic import write_bytes
from dishmap.rf.pattern import Cut, PatternGrid

Attribute = str | int | float

CONVENTIONS = "CF-1.11"
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
REAL, IMAGINARY = "_real", "_imag"
LARGEST_FILE_BYTES = 2_000_000_000
GAIN = "the square of its size is the gain over isotropic, a ratio"
# Smaller arrays are not worth compressing.
COMPRESSED_FROM, LEVEL = 1000, 4


@dataclass(frozen=True)
class Variable:
    """An array of numbers or text with named axes.

    dims: names of the axes of `values`; units: as CF writes them (`mm`, `degree`, `GHz`, `1`), empty for text; long_name: what it is;
    coordinate: whether it says where values lie; that named as its only axis always does; attributes: whatever else is to be said.
    """

    dims: tuple[str, ...]
    values: NDArray[Any]
    units: str = ""
    long_name: str = ""
    coordinate: bool = False
    attributes: Mapping[str, Attribute] = field(default_factory=dict)


def netcdf_bytes(variables: Mapping[str, Variable], attributes: Mapping[str, Attribute] | None = None) -> bytes:
    """The content of a NetCDF file of these variables; attributes: of the whole file (title, inputs, and so on).

    Raises InputError when names cannot stand in such a file, or axes of one name have different lengths.
    """
    import xarray

    _check(variables)
    data: dict[str, Any] = {}
    for name, variable in variables.items():
        for suffix, values in _real_parts(variable.values):
            said = {"units": variable.units, "long_name": variable.long_name, **variable.attributes}
            data[name + suffix] = xarray.Variable(variable.dims, values, {key: value for key, value in said.items() if value != ""})
    own = {"Conventions": CONVENTIONS, "source": f"dishmap {__version__}"}
    dataset = xarray.Dataset(data, attrs={**own, **(attributes or {})})
    places = [name for name, variable in variables.items() if variable.coordinate and name not in dataset.dims]
    encoding: dict[str, dict[str, Any]] = {}
    for key, one in dataset.variables.items():
        name, own_encoding = str(key), encoding.setdefault(str(key), {})
        if one.dtype.kind in "fiu" and one.size >= COMPRESSED_FROM:
            own_encoding |= {"zlib": True, "complevel": LEVEL}
        if one.dtype.kind == "f" and (name in dataset.dims or name in places):
            # places are never missing
            own_encoding["_FillValue"] = None
    return bytes(dataset.set_coords(places).to_netcdf(engine="h5netcdf", encoding=encoding))


def write_netcdf(path: str | Path, variables: Mapping[str, Variable], attributes: Mapping[str, Attribute] | None = None) -> None:
    """Write a NetCDF file, all of it or nothing. Raises InputError."""
    write_bytes(path, netcdf_bytes(variables, attributes))


def read_netcdf(path: str | os.PathLike[str]) -> tuple[dict[str, Variable], dict[str, Attribute]]:
    """The variables and attributes of a file that `write_netcdf` wrote. Raises InputError when it cannot be read."""
    try:
        if os.path.getsize(path) > LARGEST_FILE_BYTES:
            raise InputError(f"{path} is larger than {LARGEST_FILE_BYTES // 10**9} GB, so it is not read")
        data = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the NetCDF file {path}: {getattr(error, 'strerror', None) or error}") from error
    return parse_netcdf(data, str(path))


def parse_netcdf(data: bytes, source: str = "the NetCDF file") -> tuple[dict[str, Variable], dict[str, Attribute]]:
    """The variables and attributes of the content of a NetCDF file of `netcdf_bytes`; `source` stands in messages. Raises InputError."""
    import xarray

    try:
        dataset = xarray.load_dataset(io.BytesIO(data), engine="h5netcdf", decode_times=False)
    except Exception as error:  # whatever a broken file makes of the libraries below
        raise InputError(f"{source} is no NetCDF 4 file that can be read: {type(error).__name__}") from error
    variables: dict[str, Variable] = {}
    for name in map(str, dataset.variables):
        stem = name.removesuffix(REAL)
        if stem != name and stem + IMAGINARY in dataset.variables:
            values = np.empty(dataset[name].shape, dtype=complex)
            values.real, values.imag = dataset[name].values, dataset[stem + IMAGINARY].values
            variables[stem] = _variable(dataset, name, values)
        elif not (name.endswith(IMAGINARY) and name.removesuffix(IMAGINARY) + REAL in dataset.variables):
            variables[name] = _variable(dataset, name, dataset[name].values)
    return variables, {str(key): _plain(value) for key, value in dataset.attrs.items()}


def grid_variables(states: Sequence[str], frequencies_ghz: Sequence[float], grids: Sequence[Sequence[PatternGrid]]) -> dict[str, Variable]:
    """Variables of far fields over u and v: one grid for each state (`design`, `measured`, ...) and, within it, each frequency.

    All have as many directions, and those of one frequency the same ones. Raises InputError when they differ.
    """
    _check_table("grids", grids, states, frequencies_ghz)
    first = grids[0]
    pairs = [(grid, one) for row in grids for grid, one in zip(row, first, strict=True)]
    if not all(grid.co.shape == first[0].co.shape and _same(grid.u, one.u) and _same(grid.v, one.v) for grid, one in pairs):
        raise InputError("grids of one file need the same number of directions, and the same ones before and after")
    axes = ("state", "frequency_ghz", "v_index", "u_index")
    return {
        **_table_axes(states, frequencies_ghz),
        "u": Variable(("frequency_ghz", "u_index"), np.array([grid.u for grid in grids[0]]), "1", "direction cosine along x", True),
        "v": Variable(("frequency_ghz", "v_index"), np.array([grid.v for grid in grids[0]]), "1", "direction cosine along y", True),
        "grid_co": Variable(axes, np.array([[grid.co for grid in row] for row in grids]), "1", f"co-polar far field; {GAIN}"),
        "grid_cross": Variable(axes, np.array([[grid.cross for grid in row] for row in grids]), "1", f"cross-polar far field; {GAIN}"),
    }


def cut_variables(states: Sequence[str], frequencies_ghz: Sequence[float], cuts: Sequence[Sequence[Sequence[Cut]]]) -> dict[str, Variable]:
    """Variables of cuts: for each state and each frequency one for every azimuth.

    All have as many angles, those of one frequency the same ones, and the azimuths are the same everywhere. Raises InputError otherwise.
    """
    _check_table("cuts", cuts, states, frequencies_ghz)
    first = [one[0] for one in cuts[0]]
    phi = np.array([cut.phi_deg for cut in cuts[0][0]], dtype=float)
    pairs = [(one, known) for row in cuts for one, known in zip(row, first, strict=True)]
    same = all(_same(np.array([cut.phi_deg for cut in one]), phi) for one, _ in pairs)
    angles = all(_same(cut.theta_deg, known.theta_deg) and len(cut.co) == len(first[0].co) for one, known in pairs for cut in one)
    if not (same and angles):
        raise InputError("cuts of one file need the same azimuths and number of angles, and the same angles at each frequency")
    axes = ("state", "frequency_ghz", "phi_deg", "theta_index")
    theta = np.array([cut.theta_deg for cut in first])
    co, cross = (np.array([[[getattr(cut, name) for cut in one] for one in row] for row in cuts]) for name in ("co", "cross"))
    return {
        **_table_axes(states, frequencies_ghz),
        "phi_deg": Variable(("phi_deg",), phi, "degree", "azimuth of the cut's plane", True),
        "theta_deg": Variable(("frequency_ghz", "theta_index"), theta, "degree", "angle from the boresight", True),
        "cut_co": Variable(axes, co, "1", f"co-polar far field; {GAIN}"),
        "cut_cross": Variable(axes, cross, "1", f"cross-polar far field; {GAIN}"),
    }


def _same(one: NDArray[Any], two: NDArray[Any]) -> bool:
    return one.shape == two.shape and bool((one == two).all())


def _table_axes(states: Sequence[str], frequencies_ghz: Sequence[float]) -> dict[str, Variable]:
    return {
        "state": Variable(("state",), np.array(states, dtype=str), "", "state of the antenna", True),
        "frequency_ghz": Variable(("frequency_ghz",), np.array(frequencies_ghz, dtype=float), "GHz", "frequency", True),
    }


def _check_table(what: str, table: Sequence[Sequence[Any]], states: Sequence[str], frequencies_ghz: Sequence[float]) -> None:
    if not states or not frequencies_ghz or len(table) != len(states) or any(len(row) != len(frequencies_ghz) for row in table):
        raise InputError(f"{what} are needed for each of {len(states)} states and, within it, each of {len(frequencies_ghz)} frequencies")


def _check(variables: Mapping[str, Variable]) -> None:
    lengths: dict[str, int] = {}
    taken: set[str] = set()
    for name, variable in variables.items():
        names = {name + suffix for suffix, _ in _real_parts(variable.values)}
        if not all(NAME.fullmatch(one) for one in (name, *variable.dims)) or names & taken:
            raise InputError(f"{name!r} over {variable.dims} cannot stand in a NetCDF file: names are letters, digits and _, each once")
        taken |= names
        if len(variable.dims) != variable.values.ndim or len(set(variable.dims)) != len(variable.dims):
            raise InputError(f"{name} has {variable.values.ndim} axes, and its dims are {variable.dims}")
        for dim, length in zip(variable.dims, variable.values.shape, strict=True):
            if lengths.setdefault(dim, length) != length:
                raise InputError(f"the axis {dim} has {length} values in {name}, and {lengths[dim]} in another variable")


def _real_parts(values: NDArray[Any]) -> list[tuple[str, NDArray[Any]]]:
    """Values as a NetCDF file can hold them, each with what its name ends in."""
    if np.iscomplexobj(values):
        return [(REAL, values.real), (IMAGINARY, values.imag)]
    return [("", values)]


def _variable(dataset: Any, name: str, values: NDArray[Any]) -> Variable:
    one = dataset[name]
    said = {str(key): _plain(value) for key, value in one.attrs.items()}
    units, long_name = str(said.pop("units", "")), str(said.pop("long_name", ""))
    return Variable(tuple(map(str, one.dims)), values, units, long_name, name in dataset.coords, said)


def _plain(value: Any) -> Attribute:
    """An attribute without numpy's type."""
    plain = value.item() if isinstance(value, np.generic) else value
    return plain if isinstance(plain, str | int | float) else str(plain)
