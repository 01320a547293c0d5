"""Pattern files: JSON of the format `dishmap-pattern/1`, checked strictly.

The models below are the format; `pattern_schema` turns them into the published JSON Schema (docs/pattern.schema.json).
"""

from __future__ import annotations

import difflib
import json
import os
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from dishmap.errors import PatternError
from dishmap.io.atomic import write_text
from dishmap.targets.pattern import AXIS_TOLERANCE, LARGEST_MM, SMALLEST_RADIUS_MM, GridLine, Pattern, Polygon, Surface, TargetKind

FORMAT = "dishmap-pattern/1"
# 5,000 targets take 1 MB; a file beyond this is no pattern.
LARGEST_FILE_BYTES = 64_000_000
# The largest printed circle or polygon (radius) or line (width) of any sensible pattern lies between these; outside, the file is in metres
# or micrometres.
LIKELY_SIZE_MM = (0.1, 500.0)
# Targets may stand off the nominal surface by this part of the pattern's size: more is a mistake in the file.
LARGEST_STAND_OFF = 0.05
# Normals may lean this far from those of the nominal surface (cosine): more is a wrong sign or order.
SMALLEST_COSINE = 0.5

Length = Annotated[float, Field(gt=-LARGEST_MM, lt=LARGEST_MM)]
Size = Annotated[float, Field(gt=0, lt=LARGEST_MM)]
Place = Annotated[int, Field(gt=-(2**31), lt=2**31)]
Direction = Annotated[list[Annotated[float, Field(ge=-1.001, le=1.001)]], Field(min_length=3, max_length=3)]


class _Model(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class CircleModel(_Model):
    """A printed circle in its target's plane."""

    center_mm: Annotated[list[Length], Field(min_length=2, max_length=2, description="x, y in the target's plane")]
    radius_mm: Annotated[float, Field(ge=SMALLEST_RADIUS_MM, lt=LARGEST_MM)]
    inside: Annotated[Literal["dark", "light"], Field(description="ink or ground; nested circles alternate, outermost are dark")]


class PolygonModel(_Model):
    """A printed polygon in its target's plane."""

    corners_mm: Annotated[
        list[Annotated[list[Length], Field(min_length=2, max_length=2)]],
        Field(min_length=3, max_length=100, description="x, y of each corner in the target's plane, in order"),
    ]
    inside: Annotated[Literal["dark", "light"], Field(description="ink or ground; nested polygons alternate, outermost are dark")]


class KindModel(_Model):
    """A kind of target: circles or polygons that are disjoint or nested; neither for a plain crossing of lines."""

    circles: Annotated[list[CircleModel], Field(max_length=100)] = []
    polygons: Annotated[list[PolygonModel], Field(max_length=100)] = []


class SurfaceModel(_Model):
    """The nominal surface: z = 0, z = (x^2 + y^2) / (4 focal_length_mm), or a cylinder along y that touches z = 0."""

    kind: Literal["plane", "paraboloid", "cylinder"]
    diameter_mm: Annotated[Size | None, Field(description="of the rim")] = None
    focal_length_mm: Annotated[Size | None, Field(description="needed by a paraboloid")] = None
    radius_mm: Annotated[Length | None, Field(description="needed by a cylinder: positive if it bulges towards the camera")] = None


class TargetModel(_Model):
    """A target on the surface, in the dish frame: origin at the vertex, z towards the focus and the camera."""

    id: Annotated[int, Field(ge=0, lt=2**31)]
    kind: Annotated[str, Field(description="a key of target_kinds")]
    center_mm: Annotated[list[Length], Field(min_length=3, max_length=3)]
    x_axis: Annotated[Direction, Field(description="unit vector of the target's own x")]
    normal: Annotated[Direction, Field(description="unit vector towards the camera's side, at right angles to x_axis")]
    lattice: Annotated[list[Place] | None, Field(min_length=2, max_length=2, description="[column, row] in a grid, along x and y")] = None


class LineModel(_Model):
    """A printed line of a grid."""

    targets: Annotated[list[Annotated[int, Field(ge=0, lt=2**31)]], Field(min_length=2, description="ids of its targets, in order")]
    width_mm: Annotated[float, Field(ge=SMALLEST_RADIUS_MM, lt=LARGEST_MM)]
    overhang_mm: Annotated[float, Field(ge=0, lt=LARGEST_MM, description="how far it goes on beyond its first and last target")] = 0.0


class PatternModel(_Model):
    """What is printed on a surface and where; lengths in millimetres."""

    format: Literal["dishmap-pattern/1"]
    name: str
    surface: SurfaceModel
    target_kinds: Annotated[dict[Annotated[str, Field(min_length=1)], KindModel], Field(min_length=1)]
    targets: Annotated[list[TargetModel], Field(min_length=1)]
    lines: Annotated[list[LineModel], Field(description="of a grid of lines: two through each target")] = []


def read_pattern(path: str | os.PathLike[str]) -> Pattern:
    """Read a pattern file. Raises PatternError, naming the file and what is wrong in it."""
    try:
        if os.path.getsize(path) > LARGEST_FILE_BYTES:
            raise PatternError(f"{path} is larger than {LARGEST_FILE_BYTES // 10**6} MB, so it is no pattern file")
        text = Path(path).read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise PatternError(f"cannot read the pattern file {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise PatternError(f"{path} is no pattern file: it is not text in UTF-8") from error
    return parse_pattern(text, str(path))


def parse_pattern(text: str, source: str = "the pattern") -> Pattern:
    """Make a Pattern of the text of a pattern file; `source` stands in messages. Raises PatternError."""
    content = load_json(text, source)
    _check_format(content, source)
    try:
        model = PatternModel.model_validate(content)
    except ValidationError as error:
        raise PatternError(f"{source}: {_sentence(error, content)}") from error
    try:
        return _pattern(model)
    except PatternError as error:
        raise PatternError(f"{source}: {error}") from error


def format_pattern(pattern: Pattern) -> str:
    """The text of a pattern file: one line a target, lengths to 1e-9 mm and axes to 1e-12."""
    surface: dict[str, Any] = {"kind": pattern.surface.kind}
    for key in ("diameter_mm", "focal_length_mm", "radius_mm"):
        if getattr(pattern.surface, key) is not None:
            surface[key] = float(getattr(pattern.surface, key))
    kinds = [f"  {json.dumps(name)}: {_kind_text(kind)}" for name, kind in pattern.kinds.items()]
    columns = (pattern.ids, pattern.kind_names, pattern.center_mm, pattern.x_axis, pattern.normal)
    targets: list[dict[str, Any]] = [
        {"id": int(i), "kind": kind, "center_mm": _rounded(c, 9), "x_axis": _rounded(x, 12), "normal": _rounded(n, 12)}
        for i, kind, c, x, n in zip(*columns, strict=True)
    ]
    if pattern.lattice is not None:
        targets = [{**target, "lattice": place} for target, place in zip(targets, pattern.lattice.tolist(), strict=True)]
    head = f' "format": {json.dumps(FORMAT)},\n "name": {json.dumps(pattern.name)},\n "surface": {json.dumps(surface)},\n'
    body = ",\n".join(kinds)
    lines = [
        {"targets": list(line.ids), "width_mm": round(float(line.width_mm), 9), "overhang_mm": round(float(line.overhang_mm), 9)}
        for line in pattern.lines
    ]
    tail = f',\n "lines": [\n{_lines(lines, "  ")}\n ]' if lines else ""
    return f'{{\n{head} "target_kinds": {{\n{body}\n }},\n "targets": [\n{_lines(targets, "  ")}\n ]{tail}\n}}\n'


def _kind_text(kind: TargetKind) -> str:
    """One line a circle or polygon, under the key of what the kind is made of."""
    rows: list[dict[str, Any]]
    if kind.polygons:
        key, rows = "polygons", [{"corners_mm": [_rounded(c, 9) for c in p.corners_mm], "inside": _inside(p.dark)} for p in kind.polygons]
    elif len(kind.radius_mm):
        key, rows = (
            "circles",
            [
                {"center_mm": _rounded(c, 9), "radius_mm": round(float(r), 9), "inside": _inside(bool(dark))}
                for c, r, dark in zip(kind.center_mm, kind.radius_mm, kind.dark, strict=True)
            ],
        )
    else:
        return "{}"
    return f"{{\n   {json.dumps(key)}: [\n{_lines(rows, '    ')}\n   ]\n  }}"


def _inside(dark: bool) -> str:
    return "dark" if dark else "light"


def write_pattern(path: str | os.PathLike[str], pattern: Pattern) -> None:
    """Write a pattern file, whole or not at all. Raises InputError when it cannot be written."""
    write_text(Path(path), format_pattern(pattern))


def pattern_schema() -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of pattern files."""
    schema = PatternModel.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": f"Pattern file, {FORMAT}"}


def schema_text() -> str:
    """The text of docs/pattern.schema.json."""
    return json.dumps(pattern_schema(), indent=2) + "\n"


def load_json(text: str, source: str) -> Any:
    """What a text of JSON holds; `source` stands in messages. Raises PatternError for what is none, or gives a key twice."""
    try:
        return json.loads(text, object_pairs_hook=_unique_keys)
    except json.JSONDecodeError as error:
        whole = text.rstrip()
        cut = error.pos >= len(whole) or not whole.endswith("}")
        hint = "; the file ends too early: was it cut off?" if cut else ""
        raise PatternError(f"{source} is not valid JSON: {error.msg} at line {error.lineno}, column {error.colno}{hint}") from error
    except PatternError as error:
        raise PatternError(f"{source}: {error}") from error
    except (ValueError, RecursionError) as error:
        raise PatternError(f"{source} is not usable JSON: a number has too many digits, or brackets are nested too deep") from error


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise PatternError(f"the key {twice!r} is given twice in one object; give it once")
    return found


def _check_format(content: Any, source: str) -> None:
    if not isinstance(content, dict):
        raise PatternError(f"{source} is no pattern file: it holds {_what(content)} where an object with a key 'format' is needed")
    if "format" not in content:
        raise PatternError(f"{source} is no pattern file: it needs the key 'format' with the value {FORMAT!r}")
    if content["format"] != FORMAT:
        raise PatternError(f"{source} has the format {_short(content['format'])}; this version reads {FORMAT!r}")


def _sentence(error: ValidationError, content: dict[str, Any]) -> str:
    """One sentence for the error a user should mend first: a misspelt key before the key it leaves missing."""
    errors = error.errors(include_url=False, include_context=True, include_input=True)
    first = min(errors, key=lambda e: (e["type"] != "extra_forbidden", e["type"] != "missing"))
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    return f"{_explain(first)}{_unit_hint(first, content)}{more}"


def _explain(error: ErrorDetails) -> str:
    place, key = _place(error["loc"][:-1]), error["loc"][-1]
    if error["type"] == "extra_forbidden":
        fields = list(_model_at(error["loc"]).model_fields)
        near = difflib.get_close_matches(str(key), fields, n=1, cutoff=0.0)[0]
        return f"unknown key {str(key)!r} in {place}; the nearest valid one is {near!r} (all: {', '.join(fields)})"
    if error["type"] == "missing":
        return f"{place} lacks the key {str(key)!r}"
    message = error["msg"].replace("Input should be", "must be").replace("List should have", "must have")
    return f"{_place(error['loc'])} {message[0].lower()}{message[1:]}, not {_short(error['input'])}"


def _unit_hint(error: ErrorDetails, content: dict[str, Any]) -> str:
    """What a size out of bounds suggests."""
    value = error["input"]
    if not isinstance(value, int | float) or not str(error["loc"][-1 if isinstance(error["loc"][-1], str) else -2]).endswith("_mm"):
        return ""
    if error["type"] == "greater_than_equal" and value > 0:
        return "; lengths are in millimetres: is the file in metres?"
    return "; lengths are in millimetres: is the file in micrometres?" if error["type"] == "less_than" else ""


def _model_at(loc: tuple[int | str, ...]) -> type[BaseModel]:
    """The model in which the last part of a location stands."""
    if len(loc) == 1:
        return PatternModel
    if loc[0] == "target_kinds":
        return KindModel if len(loc) == 3 else PolygonModel if loc[2] == "polygons" else CircleModel
    return SurfaceModel if loc[0] == "surface" else LineModel if loc[0] == "lines" else TargetModel


def _place(loc: tuple[int | str, ...]) -> str:
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc if part != "[key]").lstrip(".")
    return text or "the file"


def _what(value: Any) -> str:
    return {list: "a list", str: "a text", bool: "a truth value", int: "a number", float: "a number"}.get(type(value), "nothing")


def _short(value: Any) -> str:
    text = "an object" if isinstance(value, dict) else "a list" if isinstance(value, list) else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _pattern(model: PatternModel) -> Pattern:
    kinds = {name: _kind(name, kind) for name, kind in model.target_kinds.items()}
    largest = _check_size(kinds, model.lines)
    surface = Surface(model.surface.kind, model.surface.diameter_mm, model.surface.focal_length_mm, model.surface.radius_mm)
    center = np.array([t.center_mm for t in model.targets])
    x_axis, normal = np.array([t.x_axis for t in model.targets]), np.array([t.normal for t in model.targets])
    names = tuple(t.kind for t in model.targets)
    x_axis, normal = _exact_axes(x_axis, normal)
    try:
        ids, lattice = np.array([t.id for t in model.targets]), _lattice(model.targets)
        lines = tuple(GridLine(tuple(line.targets), line.width_mm, line.overhang_mm) for line in model.lines)
        pattern = Pattern(model.name, surface, kinds, ids, names, center, x_axis, normal, lattice, lines)
    except PatternError as error:
        small = np.ptp(center, axis=0).max() < largest and len(center) > 1 and "on top of" in str(error)
        raise PatternError(f"{error}{'; are the targets really in millimetres?' if small else ''}") from error
    _check_on_surface(pattern)
    return pattern


def _check_size(kinds: dict[str, TargetKind], lines: list[LineModel]) -> float:
    """The greatest size of what is printed at one place. Raises PatternError when it must be in another unit."""
    sizes = [(float(kind.radius_mm.max()), "circle has a radius") for kind in kinds.values() if len(kind.radius_mm)]
    sizes += [(kind.extent_mm, "polygon has a radius") for kind in kinds.values() if kind.polygons]
    sizes += [(line.width_mm, "line has a width") for line in lines]
    largest, what = max(sizes, default=(LIKELY_SIZE_MM[0], ""))
    if not LIKELY_SIZE_MM[0] <= largest <= LIKELY_SIZE_MM[1]:
        unit = "metres" if largest < LIKELY_SIZE_MM[0] else "micrometres"
        raise PatternError(f"the largest {what} of {largest:g} mm; lengths are in millimetres: is the file in {unit}?")
    return largest


def _lattice(targets: list[TargetModel]) -> NDArray[np.int64] | None:
    """Places (N, 2) of the targets of a grid, None when no target has one. Raises PatternError when only some have."""
    without = [t.id for t in targets if t.lattice is None]
    if len(without) == len(targets):
        return None
    if without:
        raise PatternError(f"target {without[0]} lacks its lattice, its place [column, row]; give one to all targets of a grid")
    return np.array([t.lattice for t in targets])


def _exact_axes(x_axis: NDArray[np.float64], normal: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Axes (N, 3) without what rounding in a file leaves, so that they make exact rotations; others are for Pattern to refuse."""
    lengths = np.stack([np.linalg.norm(x_axis, axis=1), np.linalg.norm(normal, axis=1)])
    if np.abs(lengths - 1).max() > AXIS_TOLERANCE or np.abs((x_axis * normal).sum(axis=1)).max() > AXIS_TOLERANCE:
        return x_axis, normal
    normal = normal / lengths[1][:, None]
    x_axis = x_axis - (x_axis * normal).sum(axis=1, keepdims=True) * normal
    return x_axis / np.linalg.norm(x_axis, axis=1, keepdims=True), normal


def _kind(name: str, model: KindModel) -> TargetKind:
    circles = model.circles
    try:
        return TargetKind(
            np.array([c.center_mm for c in circles]),
            np.array([c.radius_mm for c in circles]),
            np.array([c.inside == "dark" for c in circles]),
            tuple(Polygon(np.array(p.corners_mm), p.inside == "dark") for p in model.polygons),
        )
    except PatternError as error:
        raise PatternError(f"target kind {name!r}: {error}") from error


def _check_on_surface(pattern: Pattern) -> None:
    """Raise PatternError for targets outside the rim, off the nominal surface, or facing away from it."""
    surface, center = pattern.surface, pattern.center_mm
    rho = np.hypot(center[:, 0], center[:, 1])
    if surface.diameter_mm is not None and rho.max() > 0.5 * surface.diameter_mm * (1 + LARGEST_STAND_OFF):
        worst = int(np.argmax(rho))
        _refuse(pattern, worst, f"lies {rho[worst]:.6g} mm from the axis, outside the rim of diameter_mm {surface.diameter_mm:g}")
    off = np.abs(center[:, 2] - surface.height_mm(center[:, :2]))
    if np.isnan(off).any():
        _refuse(pattern, int(np.argmax(np.isnan(off))), f"lies beside {_surface_words(surface)}")
    size = float(np.ptp(center, axis=0).max()) + max(kind.extent_mm for kind in pattern.kinds.values())
    if off.max() > LARGEST_STAND_OFF * size:
        worst = int(np.argmax(off))
        _refuse(pattern, worst, f"is {off[worst]:.4g} mm off {_surface_words(surface)}")
    cosine = (pattern.normal * surface.normal(center[:, :2])).sum(axis=1)
    if cosine.min() < SMALLEST_COSINE:
        _refuse(pattern, int(np.argmin(cosine)), "has a normal that does not face as the surface does, towards the focus (z up)")


def _surface_words(surface: Surface) -> str:
    if surface.kind == "paraboloid":
        return f"the paraboloid of focal_length_mm {surface.focal_length_mm:g}"
    return "the plane z = 0" if surface.kind == "plane" else f"the cylinder of radius_mm {surface.radius_mm:g}"


def _refuse(pattern: Pattern, index: int, why: str) -> NoReturn:
    raise PatternError(f"target {pattern.ids[index]} {why}; check its center_mm and normal, and the surface (all in millimetres)")


def _rounded(values: NDArray[np.float64], digits: int) -> list[float]:
    # + 0.0 writes 0.0 for -0.0
    return [round(float(v), digits) + 0.0 for v in values]


def _lines(rows: list[dict[str, Any]], indent: str) -> str:
    return ",\n".join(indent + json.dumps(row) for row in rows)
