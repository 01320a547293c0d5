"""Board files: JSON of the format `dishmap-board/1`, a chessboard or ChArUco board as it is printed.

Boards of circles are patterns and have pattern files; `read_drawn` reads both, whatever `dishmap sheet` wrote.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dishmap.errors import InputError
from dishmap.io.pattern_file import LARGEST_FILE_BYTES, load_json, parse_pattern
from dishmap.sheet.boards import CornerBoard, charuco, chessboard
from dishmap.targets.pattern import Pattern

FORMAT, LIST_FORMAT = "dishmap-board/1", "dishmap-sheets/1"
# What six digits leave of a board's sides.
ROUNDING_MM = 1e-3
# Sides along x and y are those of one square: a printer that is uneven by more is refused when the board is printed.
LARGEST_UNEVENNESS = 0.03

Pair = Annotated[list[Annotated[float, Field(gt=0)]], Field(min_length=2, max_length=2)]


class BoardModel(BaseModel):
    """A board of corners: sides along x and y; corners_mm is for other programs, and must agree with the sides."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)

    format: Literal["dishmap-board/1"]
    board: Literal["chessboard", "charuco"]
    corners: Annotated[list[int], Field(min_length=2, max_length=2)]
    square_mm: Pair
    marker_mm: Pair | None = None
    dictionary: str | None = None
    corners_mm: list[Annotated[list[float], Field(min_length=2, max_length=2)]] | None = None


def format_board(board: CornerBoard) -> str:
    """The text of a board file; lengths to 1e-6 mm."""
    content: dict[str, Any] = {"format": FORMAT, "board": board.kind, "corners": list(board.corners)}
    content["square_mm"] = _rounded(board.square_mm)
    if board.marker_mm is not None:
        content |= {"marker_mm": _rounded(board.marker_mm), "dictionary": board.dictionary}
    content["corners_mm"] = [_rounded(corner) for corner in board.corners_mm]
    return json.dumps(content, indent=1).replace("[\n  ", "[").replace(",\n  ", ", ").replace("\n ]", "]") + "\n"


def read_drawn(path: str | os.PathLike[str]) -> Pattern | CornerBoard:
    """Read what `dishmap sheet` says it drew: a pattern file or a board file, as designed or as printed.

    Raises InputError (PatternError for a pattern file), naming the file and what is wrong in it.
    """
    try:
        if os.path.getsize(path) > LARGEST_FILE_BYTES:
            raise InputError(f"{path} is larger than {LARGEST_FILE_BYTES // 10**6} MB, so it is no board file")
        text = Path(path).read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no board file: it is not text in UTF-8") from error
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the board file {path}: {getattr(error, 'strerror', None) or error}") from error
    content = load_json(text, str(path))
    kind = content.get("format") if isinstance(content, dict) else None
    if kind == LIST_FORMAT:
        raise InputError(f"{path} lists the sheets; give {content.get('drawn', 'the board file')} beside it, which says what is printed")
    if kind != FORMAT:
        return parse_pattern(text, str(path))
    try:
        return _board(BoardModel.model_validate(content))
    except ValidationError as error:
        raise InputError(f"{path}: {_sentence(error)}") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _board(model: BoardModel) -> CornerBoard:
    corners, (x, y) = (model.corners[0], model.corners[1]), model.square_mm
    if abs(x / y - 1) > LARGEST_UNEVENNESS:
        raise InputError(f"square_mm [{x:g}, {y:g}] are no sides of a square; a printer is uneven by {LARGEST_UNEVENNESS:.0%} at most")
    if model.board == "chessboard":
        if model.marker_mm is not None or model.dictionary is not None:
            raise InputError("marker_mm and dictionary mean nothing to a chessboard; leave them out")
        made = chessboard(corners, min(x, y))
    else:
        if model.marker_mm is None or model.dictionary is None:
            raise InputError("a ChArUco board needs marker_mm and dictionary")
        made = replace(charuco(corners, min(x, y), min(model.marker_mm), model.dictionary), marker_mm=_pair(model.marker_mm))
    board = replace(made, square_mm=(x, y))
    said = model.corners_mm
    if said is not None and (len(said) != len(board.corners_mm) or np.abs(np.array(said) - board.corners_mm).max() > ROUNDING_MM):
        raise InputError("corners_mm does not agree with corners and square_mm; change both, or leave corners_mm out")
    return board


def _sentence(error: ValidationError) -> str:
    first, *more = error.errors(include_url=False)
    key = ".".join(str(part) for part in first["loc"])
    rest = f" (and {len(more)} more)" if more else ""
    if first["type"] == "extra_forbidden":
        return f"unknown key {key!r}; a board file has {', '.join(BoardModel.model_fields)}{rest}"
    if first["type"] == "missing":
        return f"the file lacks the key {key!r}{rest}"
    said = first["msg"].replace("Input should be", "must be").replace("List should have", "must have")
    return f"{key} {said[0].lower()}{said[1:]}, not {first['input']!r}{rest}"


def _pair(values: Sequence[float]) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _rounded(values: Sequence[float] | np.ndarray[Any, Any]) -> list[float]:
    return [round(float(v), 6) + 0.0 for v in values]
