"""Antenna files: TOML that says what `dishmap rf` reckons with; the models below are the format, `docs/rf-files.md` describes it.

Lengths are in millimetres, angles in degrees, tapers in dB.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, Field

from dishmap.errors import InputError
from dishmap.io.grasp_pattern import cut_table, read_cuts
from dishmap.io.toml_file import STRICT, checked, toml_content, toml_text
from dishmap.rf.antenna import Actuators, Antenna, Blockage, Feed, Reflector, Subreflector

FORMAT = "dishmap-antenna/1"
# What lies outside is taken for a length in metres, or in micrometres.
SMALLEST_DIAMETER_MM, LARGEST_DIAMETER_MM = 30.0, 100e3
SMALLEST_F_OVER_D, LARGEST_F_OVER_D = 0.1, 20.0


def _for_each(axes: int) -> BeforeValidator:
    """One number stands for so many equal ones."""
    return BeforeValidator(lambda value: [value] * axes if isinstance(value, int | float) else value)


Pair = Annotated[list[float], Field(min_length=2, max_length=2), _for_each(2)]
Triple = Annotated[list[float], Field(min_length=3, max_length=3), _for_each(3)]


class _Model(BaseModel):
    model_config = STRICT


class ReflectorModel(_Model):
    """The main reflector, as `dishmap.rf.antenna.Reflector`."""

    diameter_mm: float
    focal_length_mm: float
    offset_mm: float = Reflector.offset_mm


class FeedModel(_Model):
    """The feed, as `dishmap.rf.antenna.Feed`."""

    kind: str = Feed.kind
    edge_taper_db: float | None = None
    exponent: float | None = None
    polarization: str = Feed.polarization
    file: str | None = None


class SubreflectorModel(_Model):
    """A subreflector, as `dishmap.rf.antenna.Subreflector`."""

    kind: str
    foci_distance_mm: float
    magnification: float
    diameter_mm: float | None = None


class BlockageModel(_Model):
    """What shades the aperture, as `dishmap.rf.antenna.Blockage`."""

    diameter_mm: float | None = None
    struts: int = Blockage.struts
    strut_width_mm: float = Blockage.strut_width_mm
    strut_angle_deg: float = Blockage.strut_angle_deg


class ActuatorsModel(_Model):
    """Strokes, as `dishmap.rf.antenna.Actuators`; one number holds for all axes."""

    shift_mm: Triple = list(Actuators.shift_mm)
    tilt_deg: Pair = list(Actuators.tilt_deg)
    shape_degree: int = Actuators.shape_degree
    shape_stroke_mm: float = Actuators.shape_stroke_mm


class AntennaModel(_Model):
    """The whole file."""

    format: Literal["dishmap-antenna/1"] = "dishmap-antenna/1"
    reflector: ReflectorModel
    feed: FeedModel
    subreflector: SubreflectorModel | None = None
    blockage: BlockageModel = BlockageModel()
    actuators: ActuatorsModel = ActuatorsModel()


def read_antenna(path: str | os.PathLike[str]) -> Antenna:
    """Read an antenna file and the file of its feed. Raises InputError, naming the file and what is wrong in it."""
    return parse_antenna(toml_text(path, "antenna file"), Path(path).parent, str(path))


def feed_path(path: str | os.PathLike[str]) -> Path | None:
    """The file of the feed that an antenna file names, or None. Raises InputError."""
    model = checked(toml_content(toml_text(path, "antenna file"), str(path)), AntennaModel, str(path))
    return None if model.feed.file is None else Path(path).parent / model.feed.file


def parse_antenna(text: str, folder: str | os.PathLike[str] = ".", source: str = "the antenna") -> Antenna:
    """Make an Antenna of the text of an antenna file, whose feed's file is found in `folder`. Raises InputError."""
    model = checked(toml_content(text, source), AntennaModel, source)
    try:
        return _antenna(model, Path(folder))
    except InputError as error:
        raise type(error)(f"{source}: {error}") from error


def format_antenna(antenna: Antenna, feed_file: str = "feed.cut") -> str:
    """The text of an antenna file, which reads back as the same antenna.

    feed_file: name, beside it, of the .cut file of a feed that is a table (`dishmap.io.grasp_pattern.cuts_of`), which is not written here.
    """
    feed = antenna.feed
    words = {"kind": feed.kind, "polarization": feed.polarization, **({} if feed.table is None else {"file": feed_file})}
    parts = [
        f'format = "{FORMAT}"\n',
        _table("reflector", **asdict(antenna.reflector)),
        _table("feed", **words, edge_taper_db=feed.edge_taper_db, exponent=feed.exponent),
        *([] if antenna.subreflector is None else [_table("subreflector", **asdict(antenna.subreflector))]),
        _table("blockage", **asdict(antenna.blockage)),
        _table("actuators", **asdict(antenna.actuators)),
    ]
    return "\n".join(parts)


Value = str | int | float | tuple[float, ...] | None


def _table(name: str, **values: Value) -> str:
    lines = [f"{key} = {_toml(value)}\n" for key, value in values.items() if value is not None]
    return f"[{name}]\n{''.join(lines)}"


def _toml(value: Value) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    # numpy's numbers print their type
    return repr(value if isinstance(value, int) else float(value or 0))


def _antenna(model: AntennaModel, folder: Path) -> Antenna:
    main, moves = model.reflector, model.actuators
    with _within("reflector"):
        reflector = Reflector(main.diameter_mm, main.focal_length_mm, main.offset_mm)
        _check_units(reflector)
    with _within("feed"):
        feed = _feed(model.feed, folder)
    with _within("subreflector"):
        subreflector = None if model.subreflector is None else Subreflector(**model.subreflector.model_dump())
    with _within("blockage"):
        blockage = Blockage(**model.blockage.model_dump())
    with _within("actuators"):
        x, y, z = moves.shift_mm
        about_x, about_y = moves.tilt_deg
        actuators = Actuators((x, y, z), (about_x, about_y), moves.shape_degree, moves.shape_stroke_mm)
    return Antenna(reflector, feed, subreflector, blockage, actuators)


def _feed(model: FeedModel, folder: Path) -> Feed:
    if (model.file is None) == (model.kind == "cut"):
        raise InputError("kind = 'cut' and file (a GRASP .cut file beside this one) go together, and no other kind has a file")
    table = None if model.file is None else cut_table(read_cuts(folder / model.file), str(folder / model.file))
    return Feed(model.kind, model.edge_taper_db, model.exponent, model.polarization, table)


@contextmanager
def _within(table: str) -> Iterator[None]:
    """Name the table in which something is wrong."""
    try:
        yield
    except InputError as error:
        raise type(error)(f"[{table}] {error}") from error


def _check_units(reflector: Reflector) -> None:
    """Raise InputError for sizes that only a mistake of units explains."""
    diameter, focal = reflector.diameter_mm, reflector.focal_length_mm
    if not SMALLEST_DIAMETER_MM <= diameter <= LARGEST_DIAMETER_MM:
        raise InputError(
            f"diameter_mm = {diameter:g} is no dish between {SMALLEST_DIAMETER_MM:g} mm and {LARGEST_DIAMETER_MM / 1000:g} m; "
            "lengths are in millimetres, so 0.6 m is 600"
        )
    if not SMALLEST_F_OVER_D <= focal / diameter <= LARGEST_F_OVER_D:
        raise InputError(
            f"focal_length_mm = {focal:g} is {focal / diameter:.3g} times diameter_mm = {diameter:g}, and {SMALLEST_F_OVER_D:g} to "
            f"{LARGEST_F_OVER_D:g} times is usual; lengths are in millimetres, so 0.3 m is 300"
        )
