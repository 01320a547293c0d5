"""Pages as a PDF file (ISO 32000-1): vector paths in millimetres, the standard font Helvetica, and no scaling asked of the printer.

Written here because a dozen operators are all that is needed and because the bytes then are the same in every run.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dishmap.sheet.shapes import Group, Ink, Line, Page, Words

Array = NDArray[np.float64]

POINTS_PER_MM = 72 / 25.4
# PDF knows no circles. Eight Bezier arcs follow one to 4e-6 of its radius, 0.04 micrometres at 10 mm (four: 2.7e-4).
ARCS = 8
HANDLE = 4 / 3 * np.tan(np.pi / (2 * ARCS))
# Height of Helvetica's capitals over the size of the font.
CAPITALS = 0.72


def pdf_bytes(pages: Sequence[Page], title: str) -> bytes:
    """The PDF file of pages, the same bytes for the same pages."""
    kids = " ".join(f"{4 + 2 * k} 0 R" for k in range(len(pages)))
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        f"<< /Type /Pages /Kids [{kids}] /Count {len(pages)} >>".encode(),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    for k, page in enumerate(pages):
        box = f"0 0 {_number(page.width_mm * POINTS_PER_MM)} {_number(page.height_mm * POINTS_PER_MM)}"
        content = zlib.compress("\n".join(_content(page)).encode("cp1252", "replace"), 9)
        resources = "<< /Font << /F1 3 0 R >> >>"
        objects.append(f"<< /Type /Page /Parent 2 0 R /MediaBox [{box}] /Resources {resources} /Contents {5 + 2 * k} 0 R >>".encode())
        objects.append(f"<< /Length {len(content)} /Filter /FlateDecode >>\nstream\n".encode() + content + b"\nendstream")
    objects.append(b"<< /Producer (dishmap) /Title (" + _escaped(title).encode("cp1252", "replace") + b") >>")
    return _file(objects)


def _file(objects: Sequence[bytes]) -> bytes:
    """Objects with their table of places; the first is the catalog, the last the information."""
    out = bytearray(b"%PDF-1.7\n%\xe2\xe3\xcf\xd3\n")
    places = []
    for number, content in enumerate(objects, start=1):
        places.append(len(out))
        out += f"{number} 0 obj\n".encode() + content + b"\nendobj\n"
    table = len(out)
    out += f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n".encode()
    out += b"".join(f"{place:010d} 00000 n \n".encode() for place in places)
    out += f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R /Info {len(objects)} 0 R >>\nstartxref\n{table}\n%%EOF\n".encode()
    return bytes(out)


def _content(page: Page) -> Iterator[str]:
    yield f"{_number(POINTS_PER_MM, 9)} 0 0 {_number(POINTS_PER_MM, 9)} 0 0 cm"
    for group in page.groups:
        yield "q"
        yield from _clip(group)
        for shape in group.shapes:
            if isinstance(shape, Ink):
                yield from _ink(shape)
            elif isinstance(shape, Line):
                yield from _line(shape)
            else:
                yield _words(shape)
        yield "Q"


def _clip(group: Group) -> Iterator[str]:
    if group.clip_mm is not None:
        left, bottom, right, top = group.clip_mm
        yield f"{_numbers(left, bottom, right - left, top - bottom)} re W n"
    if group.outline_mm is not None:
        yield f"{_polygon(group.outline_mm)} W n"


def _ink(ink: Ink) -> Iterator[str]:
    for center, radius in zip(ink.center_mm, ink.radius_mm, strict=True):
        yield from _circle(center, float(radius))
    for polygon in ink.polygons_mm:
        yield _polygon(polygon)
    yield "f*"


def _polygon(points: Array) -> str:
    return f"{_numbers(*points[0])} m " + " ".join(f"{_numbers(*point)} l" for point in points[1:]) + " h"


def _circle(center: Array, radius: float) -> Iterator[str]:
    angle = 2 * np.pi * np.arange(ARCS + 1) / ARCS
    outward, along = np.stack([np.cos(angle), np.sin(angle)], axis=1), np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    at, after, before = (center + radius * (outward + k * HANDLE * along) for k in (0, 1, -1))
    yield f"{_numbers(*at[0])} m"
    for k in range(ARCS):
        yield f"{_numbers(*after[k], *before[k + 1], *at[k + 1])} c"
    yield "h"


def _line(line: Line) -> Iterator[str]:
    first, *others = line.points_mm
    yield f"{_number(line.width_mm)} w {_numbers(*first)} m " + " ".join(f"{_numbers(*point)} l" for point in others) + " S"


def _words(words: Words) -> str:
    turn = "0 1 -1 0" if words.upwards else "1 0 0 1"
    return f"BT /F1 {_number(words.height_mm / CAPITALS)} Tf {turn} {_numbers(*words.at_mm)} Tm ({_escaped(words.text)}) Tj ET"


def _escaped(text: str) -> str:
    kept = "".join(c if c.isprintable() else " " for c in text)
    return kept.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")


def _numbers(*values: float) -> str:
    return " ".join(_number(value) for value in values)


def _number(value: float, digits: int = 6) -> str:
    """To a nanometre, without an exponent, which PDF does not know."""
    return f"{value + 0.0:.{digits}f}".rstrip("0").rstrip(".")
