"""The table [pattern] of a scenario file: a pattern file, or what is to be built."""

from __future__ import annotations

import difflib
import inspect
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel

from dishmap.errors import InputError
from dishmap.io.pattern_file import read_pattern
from dishmap.io.toml_file import STRICT
from dishmap.targets.builders import KIND_BUILDERS, dish, plate
from dishmap.targets.grid_builders import grid, grid_surface
from dishmap.targets.pattern import Pattern, TargetKind

KindName = Literal["disc", "ring", "concentric", "multi", "whycon"]


class _Model(BaseModel):
    model_config = STRICT


class PlateModel(_Model):
    """A flat plate of targets."""

    rows: int
    columns: int
    pitch_mm: float
    kind: KindName = "multi"
    kind_options: dict[str, int | float | list[float]] = {}
    orientation_marks: bool = False


class DishModel(_Model):
    """Targets on concentric circles of a paraboloid."""

    diameter_mm: float
    focal_length_mm: float
    spacing_mm: float = 45.0
    kind: KindName = "multi"
    kind_options: dict[str, int | float | list[float]] = {}
    orientation_marks: bool = False
    margin_mm: float | None = None
    center_target: bool = True


class GridModel(_Model):
    """A grid of lines (line_mm) or squares (square_mm) on a plane, a dish or a cylinder."""

    columns: int
    rows: int
    pitch_mm: float
    line_mm: float | None = None
    square_mm: float | None = None
    surface: Literal["plane", "dish", "cylinder"] = "plane"
    diameter_mm: float | None = None
    focal_length_mm: float | None = None
    cylinder_radius_mm: float | None = None
    orientation_marks: bool = False


class PatternSource(_Model):
    """What is printed: a pattern file, or a plate, a dish or a grid to be built."""

    file: str | None = None
    plate: PlateModel | None = None
    dish: DishModel | None = None
    grid: GridModel | None = None


def pattern_of(model: PatternSource, folder: Path) -> Pattern:
    """The pattern that a scenario in this folder names or describes. Raises InputError and PatternError."""
    given = [name for name in ("file", "plate", "dish", "grid") if getattr(model, name) is not None]
    if len(given) != 1:
        raise InputError(f"[pattern] needs one of file, plate, dish and grid, not {' and '.join(given) or 'none'}")
    if model.file is not None:
        return read_pattern(folder / model.file)
    if model.grid is not None:
        return _grid(model.grid)
    source = model.plate or model.dish
    assert source is not None
    numbers = source.model_dump(exclude={"kind", "kind_options"})
    kind = _kind(source.kind, source.kind_options)
    build = plate if model.plate is not None else dish
    return build(**numbers, kind=kind, kind_name=source.kind)


def _grid(model: GridModel) -> Pattern:
    surface = grid_surface(model.surface, model.diameter_mm, model.focal_length_mm, model.cylinder_radius_mm)
    if (model.line_mm is None) == (model.square_mm is None):
        raise InputError("the grid of [pattern] is made of lines or of squares: give line_mm or square_mm, and not both")
    return grid(model.columns, model.rows, model.pitch_mm, model.line_mm, model.square_mm, surface, model.orientation_marks)


def _kind(name: str, options: dict[str, Any]) -> TargetKind:
    known = list(inspect.signature(KIND_BUILDERS[name]).parameters)
    for option, value in options.items():
        if option not in known:
            near = difflib.get_close_matches(option, known, n=1, cutoff=0.0)[0]
            raise InputError(f"unknown option {option!r} of kind {name!r}; the nearest valid one is {near!r} (all: {', '.join(known)})")
        wanted = {"radii_mm": list, "count": int}.get(option, (int, float))
        if not isinstance(value, wanted):
            raise InputError(f"kind_options of {name!r} need numbers (radii_mm a list of them, count a whole one), not {options}")
    return KIND_BUILDERS[name](**options)
