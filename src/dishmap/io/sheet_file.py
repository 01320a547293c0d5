"""Sheets as files: `sheets.pdf`, an SVG file a page, `pattern.json` or `board.json`, and `sheets.json` that says what lies where."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.io.atomic import write_files
from dishmap.io.board_file import LIST_FORMAT, format_board
from dishmap.io.pattern_file import format_pattern
from dishmap.sheet.boards import CornerBoard
from dishmap.sheet.flatten import AlongMeridian
from dishmap.sheet.pdf import pdf_bytes
from dishmap.sheet.sheets import Sheets
from dishmap.sheet.svg import svg_text
from dishmap.targets.pattern import Pattern

PDF_NAME, LIST_NAME = "sheets.pdf", "sheets.json"


def drawn_name(what: Pattern | CornerBoard, printed: bool = False) -> str:
    """Name of the file that says what was drawn, or what came out of the printer."""
    return f"{'board' if isinstance(what, CornerBoard) else 'pattern'}{'-printed' if printed else ''}.json"


def page_name(number: int) -> str:
    """Name of the SVG file of a page, counted from 1."""
    return f"sheet-{number:03d}.svg"


def format_drawn(what: Pattern | CornerBoard) -> str:
    """The text of a pattern file or a board file."""
    return format_pattern(what) if isinstance(what, Pattern) else format_board(what)


def write_sheets(folder: str | os.PathLike[str], sheets: Sheets) -> list[str]:
    """Write the sheets into an existing folder, all files or none; gives their names. Raises InputError when that cannot be done."""
    title = sheets.pieces[0].name if isinstance(sheets.what, CornerBoard) else sheets.what.name
    files: dict[str, str | bytes] = {PDF_NAME: pdf_bytes(sheets.pages, title), drawn_name(sheets.what): format_drawn(sheets.what)}
    files |= {page_name(number): svg_text(page) for number, page in enumerate(sheets.pages, start=1)}
    files[LIST_NAME] = json.dumps(sheets_list(sheets), indent=1) + "\n"
    write_files(Path(folder), files)
    return list(files)


def sheets_list(sheets: Sheets) -> dict[str, Any]:
    """What lies where: paper, scale bars, pieces with their strain, and every target's place on its page in mm from the lower left."""
    placed = []
    for place in sheets.placements:
        piece = sheets.pieces[place.piece]
        own = place.own[place.own < len(piece.target)]
        entry: dict[str, Any] = {"piece": piece.name, "tile": place.tile, "page": place.page + 1, "shift_mm": _rounded(place.shift_mm)}
        if isinstance(sheets.what, Pattern):
            entry["targets"] = [
                {
                    "id": int(sheets.what.ids[piece.target[k]]),
                    "at_mm": _rounded(piece.center_mm[k] + place.shift_mm),
                    "angle_deg": round(float(np.degrees(piece.angle_rad[k])), 6) + 0.0,
                    "strain": round(float(1 - piece.stretch[k]), 7) + 0.0,
                }
                for k in own
            ]
        placed.append(entry)
    paper = sheets.paper
    return {
        "format": LIST_FORMAT,
        "drawn": drawn_name(sheets.what),
        "paper_mm": [paper.width_mm, paper.height_mm],
        "margin_mm": paper.margin_mm,
        "bar_mm": paper.bar_mm,
        "pages": [page_name(number) for number in range(1, len(sheets.pages) + 1)],
        "pieces": [
            {
                "name": piece.name,
                "place": piece.note,
                "azimuth_deg": round(float(np.degrees(piece.map.azimuth_rad)), 6) if isinstance(piece.map, AlongMeridian) else None,
                "anchor_mm": _rounded(piece.anchor_mm),
                "strain": round(piece.strain, 7),
            }
            for piece in sheets.pieces
        ],
        "placed": placed,
        "corner_marks": [
            {"dictionary": mark.dictionary, "number": mark.number, "center_mm": _rounded(mark.center_mm), "side_mm": mark.side_mm}
            for mark in sheets.corner_marks
        ],
    }


def _rounded(values: NDArray[Any]) -> list[float]:
    return [round(float(v), 6) + 0.0 for v in values]
