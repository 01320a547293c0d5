"""Far fields for GRASP: .cut files (polar cuts) and .grd files (grids over u and v), read and written.

Fields are scaled as everywhere here: |co|^2 + |cross|^2 is the gain (GRASP: total power 4 pi). A file holds E_theta and E_phi (ICOMP 1),
right- and left-hand circular (2) or Ludwig's third definition along x and y (3); a record holds co and cross of one polarisation. With
Ludwig 1973 and time as exp(+j w t), x = E_theta cos(phi) - E_phi sin(phi), y = E_theta sin(phi) + E_phi cos(phi), right = (x + j y)/sqrt 2,
left = (x - j y)/sqrt 2. These hold at negative theta too: theta's and phi's unit vectors both turn round, and so do sine and cosine.
Layouts: `docs/rf-files.md`.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.errors import InputError
from dishmap.io.grasp_text import Lines, grasp_text, joined, one_line, rows
from dishmap.rf.antenna import POLARIZATIONS, CutTable
from dishmap.rf.pattern import Cut, PatternGrid

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

THETA_PHI, CIRCULAR, LUDWIG = 1, 2, 3
# Numbers have 11 digits: steps, angles and direction cosines differ by no more from what was meant.
TOLERANCE = 1e-8
# Two cuts in one direction are of one field when they differ by less than this share of the greatest field.
SAME_FIELD = 1e-4
# A far field may have a third component in its file, along the ray, up to this share of the others.
RADIAL = 1e-3
# Grids may go beyond the horizon, but not by much.
LARGEST_COSINE = 10.0
LARGEST_NODES = 20_000_000


def format_cuts(cuts: Sequence[Cut], polarization: str = "x", text: str = "Field data in cuts") -> str:
    """The text of a .cut file of cuts of a field of this polarisation. Raises InputError when angles do not rise in equal steps."""
    lines = []
    for cut in cuts:
        start, step = _steps(cut.theta_deg, "theta of a cut")
        icomp, parts = _to_file(cut.co, cut.cross, polarization)
        if not all(np.isfinite(part).all() for part in parts):
            raise InputError(f"the cut at phi {cut.phi_deg:g} degrees has no field somewhere; a .cut file needs one at every angle")
        head = rows(np.array([[start, step]]))[0]
        lines.append(one_line(text))
        lines.append(f"{head} {len(cut.theta_deg):6d} {rows(np.array([[cut.phi_deg]]))[0]} {icomp:4d} {1:4d} {2:4d}")
        lines += rows(_reals(parts))
    return joined(lines)


def parse_cuts(text: str, source: str = "the cuts", polarization: str = "x") -> tuple[Cut, ...]:
    """The cuts of the text of a .cut file, in its order, with co and cross of this polarisation.

    Raises InputError, naming the line, when it holds anything but polar cuts of a far field (ICUT 1, ICOMP 1 to 3).
    """
    lines = Lines(text, source)
    cuts = []
    while lines:
        lines.line("a line of text")
        first, step, count, phi, icomp, icut, ncomp = lines.numbers("V_INI V_INC V_NUM C ICOMP ICUT NCOMP")
        if icut != 1:
            raise lines.error(f"ICUT is {icut:g}, and only polar cuts (1: theta runs, phi is fixed) are read")
        _check_components(lines, icomp, ncomp)
        if count != round(count) or count < 1 or (step == 0 and count > 1):
            raise lines.error(f"a cut needs one or more angles in steps other than zero, not V_NUM {count:g} and V_INC {step:g}")
        parts = _components(lines, int(count), int(ncomp))
        co, cross = _from_file(int(icomp), parts[0], parts[1], np.radians(phi), polarization)
        cuts.append(Cut(first + step * np.arange(int(count)), float(phi), co, cross))
    if not cuts:
        raise InputError(f"{source} holds no cut")
    return tuple(cuts)


def read_cuts(path: str | os.PathLike[str], polarization: str = "x") -> tuple[Cut, ...]:
    """Read a .cut file. Raises InputError."""
    return parse_cuts(grasp_text(path, "cut file"), str(path), polarization)


def cut_table(cuts: Sequence[Cut], source: str = "the cuts") -> CutTable:
    """The table of a feed: cuts of one field (co along Ludwig's x, cross along y) that together go round the axis.

    theta runs from 0 or from -T to T in all of them; what lies at negative theta is the field at phi + 180 degrees, whose Ludwig axes are
    the same. Raises InputError when angles differ, azimuths are missing, or two cuts give one direction different fields.
    """
    halves = [half for cut in cuts for half in _halves(cut, source)]
    if not halves:
        raise InputError(f"{source}: there is no cut")
    theta = halves[0].theta_deg
    if any(len(half.theta_deg) != len(theta) or np.abs(half.theta_deg - theta).max() > 1e-6 for half in halves):
        raise InputError(f"{source}: the cuts have different angles theta; a feed needs the same in all")
    largest = max(float(np.abs(half.co).max() + np.abs(half.cross).max()) for half in halves)
    azimuths: dict[float, Cut] = {}
    for half in halves:
        phi = round(half.phi_deg % 360, 6) % 360
        known = azimuths.setdefault(phi, half)
        if max(np.abs(known.co - half.co).max(), np.abs(known.cross - half.cross).max()) > SAME_FIELD * largest:
            raise InputError(f"{source}: two cuts give different fields at phi {phi:g} degrees; give the cuts of one frequency")
    phi_deg = np.array(sorted(azimuths))
    gap = np.diff(np.append(phi_deg, phi_deg[0] + 360))
    if len(phi_deg) < 3 or np.ptp(gap) > 1e-4:
        raise InputError(
            f"{source}: a feed needs three or more azimuths in equal steps all around, not phi {', '.join(f'{p:g}' for p in phi_deg[:6])}"
            f"{' ...' if len(phi_deg) > 6 else ''}; cuts from theta 0 need phi up to 360 degrees, those from -T to T up to 180"
        )
    ordered = [azimuths[phi] for phi in phi_deg.tolist()]
    return CutTable(theta, phi_deg, np.array([cut.co for cut in ordered]), np.array([cut.cross for cut in ordered]))


def cuts_of(table: CutTable) -> tuple[Cut, ...]:
    """The cuts of the table of a feed, one for each azimuth, theta from 0."""
    return tuple(Cut(table.theta_deg, float(phi), co, cross) for phi, co, cross in zip(table.phi_deg, table.co, table.cross, strict=True))


def format_grd(grids: Sequence[PatternGrid], frequencies_ghz: Sequence[float], polarization: str = "x") -> str:
    """The text of a .grd file of fields of this polarisation over u and v, one for each frequency.

    Directions that are none (NaN) are left out, row by row. Raises InputError when u or v do not rise in equal steps, or a row has gaps.
    """
    icomp = CIRCULAR if polarization in ("right", "left") else LUDWIG
    lines = ["VERSION: TICRA-EM-FIELD-V0.1", "Field data in grid", "SOURCE_FIELD_NAME: dishmap", "FREQUENCY_NAME: frequencies"]
    lines += ["FREQUENCIES [GHz]:", *rows(np.asarray(frequencies_ghz, dtype=float).reshape(-1, 1)), "++++", f"{1:6d}"]
    lines += [f"{len(grids):6d} {icomp:6d} {2:6d} {1:6d}", *[f"{0:6d} {0:6d}"] * len(grids)]
    if len(grids) != len(frequencies_ghz):
        raise InputError(f"{len(grids)} grids need as many frequencies, not {len(frequencies_ghz)}")
    for grid in grids:
        lines += _grid_lines(grid, polarization)
    return joined(lines)


def parse_grd(text: str, source: str = "the grid", polarization: str = "x") -> tuple[PatternGrid, ...]:
    """The fields of the text of a .grd file, one for each set in it, with co and cross of this polarisation.

    Raises InputError, naming the line, when it holds anything but grids over u and v (KTYPE 1, IGRID 1) of a far field (ICOMP 1 to 3).
    """
    lines = Lines(text, source)
    while not lines.line("a line ++++").startswith("++++"):
        pass
    (ktype,) = lines.integers("KTYPE")
    if ktype != 1:
        raise lines.error(f"KTYPE is {ktype}, and only 1 is read")
    count, icomp, ncomp, igrid = lines.integers("NSET ICOMP NCOMP IGRID")
    _check_components(lines, icomp, ncomp)
    if igrid != 1:
        raise lines.error(f"IGRID is {igrid}, and only 1 (a grid over u and v) is read")
    lines.fits(count, "NSET")
    centers = [lines.integers("IX IY") for _ in range(count)]
    grids = tuple(_read_set(lines, ix, iy, (icomp, ncomp), polarization) for ix, iy in centers)
    lines.finish()
    return grids


def read_grd(path: str | os.PathLike[str], polarization: str = "x") -> tuple[PatternGrid, ...]:
    """Read a .grd file. Raises InputError."""
    return parse_grd(grasp_text(path, "grid file"), str(path), polarization)


def _grid_lines(grid: PatternGrid, polarization: str) -> list[str]:
    """The lines of one set: limits, counts, and rows along u, each from its first to its last direction that is one."""
    for axis, name in ((grid.u, "u"), (grid.v, "v")):
        _steps(axis, name)
    _, parts = _to_file(grid.co, grid.cross, polarization)
    known = np.isfinite(parts[0]) & np.isfinite(parts[1])
    whole = bool(known.all())
    lines = rows(np.array([[grid.u[0], grid.v[0], grid.u[-1], grid.v[-1]]]))
    lines.append(f"{len(grid.u):6d} {len(grid.v):6d} {0 if whole else 1:6d}")
    for row, here in enumerate(known):
        columns = np.flatnonzero(here)
        if columns.size and columns[-1] - columns[0] >= columns.size:
            raise InputError(f"the field at v = {grid.v[row]:g} has a gap along u; a .grd file needs every direction between two others")
        start = int(columns[0]) if columns.size else 0
        if not whole:
            lines.append(f"{start + 1 if columns.size else 0:6d} {columns.size:6d}")
        part = slice(start, start + columns.size)
        lines += rows(_reals((parts[0][row, part], parts[1][row, part])))
    return lines


def _read_set(lines: Lines, ix: int, iy: int, components: tuple[int, int], polarization: str) -> PatternGrid:
    icomp, ncomp = components
    xs, ys, xe, ye = lines.numbers("XS YS XE YE")
    nx, ny, klimit = lines.integers("NX NY KLIMIT")
    if nx < 2 or ny < 2 or not (xe > xs and ye > ys) or klimit not in (0, 1):
        raise lines.error(f"a grid needs two or more nodes along rising u and v and KLIMIT 0 or 1, not {nx}, {ny} and {klimit}")
    # a row that is left out still has its line of two numbers
    lines.fits(2 * ncomp * nx * ny if klimit == 0 else 2 * ny, f"a grid of {nx} x {ny} nodes")
    if nx * ny > LARGEST_NODES:
        raise lines.error(f"a grid of {nx} x {ny} nodes is larger than {LARGEST_NODES} nodes")
    step = (xe - xs) / (nx - 1), (ye - ys) / (ny - 1)
    u, v = xs + step[0] * (ix + np.arange(nx)), ys + step[1] * (iy + np.arange(ny))
    if max(np.abs(u).max(), np.abs(v).max()) > LARGEST_COSINE:
        raise lines.error(f"u from {u[0]:g} to {u[-1]:g} and v from {v[0]:g} to {v[-1]:g} are no direction cosines")
    parts = np.full((2, ny, nx), np.nan + 0j)
    for row in range(ny):
        start, number = lines.integers("IS IN") if klimit else (1, nx)
        if number and not 1 <= start <= start + number - 1 <= nx:
            raise lines.error(f"columns {start} to {start + number - 1} do not lie within 1 to {nx}")
        parts[:, row, start - 1 : start - 1 + number] = _components(lines, number, ncomp)
    across, up = np.meshgrid(u, v)
    parts[:, across**2 + up**2 >= 1] = np.nan
    co, cross = _from_file(icomp, parts[0], parts[1], np.arctan2(up, across), polarization)
    return PatternGrid(u, v, co, cross)


def _halves(cut: Cut, source: str) -> list[Cut]:
    """A cut as one or two that start at theta 0: its positive half, and its negative one as that at phi + 180 degrees."""
    order = np.argsort(cut.theta_deg)
    theta, co, cross = cut.theta_deg[order], cut.co[order], cut.cross[order]
    zero = int(np.argmin(np.abs(theta)))
    symmetric = zero == 0 or (len(theta) == 2 * zero + 1 and np.abs(theta + theta[::-1]).max() < 1e-6)
    if len(theta) < 2 or abs(theta[zero]) > 1e-6 or theta[-1] > 180 + 1e-6 or not symmetric:
        raise InputError(
            f"{source}: theta of a feed's cuts must run from 0 to T or from -T to T (up to 180 degrees), "
            f"not from {theta[0]:g} to {theta[-1]:g} in {len(theta)} angles"
        )
    ahead = Cut(np.abs(theta[zero:]), cut.phi_deg, co[zero:], cross[zero:])
    if zero == 0:
        return [ahead]
    return [ahead, Cut(np.abs(theta[zero::-1]), cut.phi_deg + 180, co[zero::-1], cross[zero::-1])]


def _steps(values: Array, name: str) -> tuple[float, float]:
    """First value and step. Raises InputError when they do not rise in equal steps."""
    if len(values) == 1:
        return float(values[0]), 1.0
    step = np.diff(values)
    if not len(values) or not (step > 0).all() or np.ptp(step) > TOLERANCE * max(1.0, float(np.abs(values).max())):
        raise InputError(f"{name} must rise in equal steps to stand in a GRASP file")
    return float(values[0]), float((values[-1] - values[0]) / (len(values) - 1))


def _components(lines: Lines, number: int, ncomp: int) -> Complex:
    """The two components (2, N) across the ray of so many field values; a third, along it, must be next to nothing."""
    values = lines.block(2 * ncomp * number, f"{number} field values of {ncomp} components").reshape(number, 2 * ncomp)
    parts = (values[:, 0::2] + 1j * values[:, 1::2]).T
    if np.abs(parts[2:]).max(initial=0.0) > RADIAL * np.abs(parts[:2]).max(initial=0.0):
        raise lines.error("the third component, along the ray, is not small: this is a near field, and a far field is needed")
    return np.asarray(parts[:2])


def _check_components(lines: Lines, icomp: float, ncomp: float) -> None:
    if ncomp not in (2, 3):
        raise lines.error(f"NCOMP is {ncomp:g}, and fields of 2 components (or 3, for near fields) are read")
    if icomp not in (THETA_PHI, CIRCULAR, LUDWIG):
        raise lines.error(f"ICOMP is {icomp:g}; 1 (theta, phi), 2 (right, left circular) and 3 (Ludwig 3) are read: export one of these")


def _to_file(co: Complex, cross: Complex, polarization: str) -> tuple[int, tuple[Complex, Complex]]:
    """ICOMP and the two components of a field whose co is of this polarisation."""
    _check_polarization(polarization)
    icomp = CIRCULAR if polarization in ("right", "left") else LUDWIG
    return icomp, (co, cross) if polarization in ("x", "right") else (cross, co)


def _from_file(icomp: int, first: Complex, second: Complex, phi_rad: ArrayLike, polarization: str) -> tuple[Complex, Complex]:
    """Co and cross of this polarisation from the two components of a file at azimuths phi."""
    _check_polarization(polarization)
    circular = polarization in ("right", "left")
    if icomp == THETA_PHI:
        sine, cosine = np.sin(phi_rad), np.cos(phi_rad)
        first, second = first * cosine - second * sine, first * sine + second * cosine
    if icomp == CIRCULAR and not circular:
        first, second = (first + second) / np.sqrt(2), (first - second) / (1j * np.sqrt(2))
    if icomp != CIRCULAR and circular:
        first, second = (first + 1j * second) / np.sqrt(2), (first - 1j * second) / np.sqrt(2)
    return (first, second) if polarization in ("x", "right") else (second, first)


def _check_polarization(polarization: str) -> None:
    if polarization not in POLARIZATIONS:
        raise InputError(f"unknown polarization {polarization!r}; known are {', '.join(POLARIZATIONS)}")


def _reals(parts: tuple[Complex, Complex]) -> Array:
    """Re, Im, Re, Im (N, 4) of two components (N,)."""
    return np.stack([parts[0].real, parts[0].imag, parts[1].real, parts[1].imag], axis=1)
