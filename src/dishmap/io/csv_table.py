"""CSV tables of rows that are mappings: one line for the columns, empty cells where a row says nothing."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def format_csv(columns: Sequence[str], rows: Iterable[Mapping[str, Any]], remarks: Sequence[str] = ()) -> str:
    """The text of a table: numbers to 9 digits, `yes` and `no`; remarks: lines before it, each marked with `# `."""
    out = io.StringIO()
    out.writelines(f"# {' '.join(remark.split())}\n" for remark in remarks)
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_cell(row.get(name)) for name in columns] for row in rows)
    return out.getvalue()


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        # + 0.0 writes 0 for -0
        return f"{value + 0.0:.9g}" if math.isfinite(value) else ""
    return "" if value is None else str(value)
