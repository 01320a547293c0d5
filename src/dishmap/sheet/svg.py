"""A page as an SVG file at true scale: one user unit is a millimetre, circles are exact arcs, y points down as SVG has it."""

from __future__ import annotations

from collections.abc import Iterator
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import NDArray

from dishmap.sheet.shapes import Group, Ink, Line, Page, Shape, Words

Array = NDArray[np.float64]

# Height of Helvetica's capitals over the size of the font.
CAPITALS = 0.72


def svg_text(page: Page) -> str:
    """The SVG file of a page. Each `Ink` is one path whose id is its name."""
    width, height = _number(page.width_mm), _number(page.height_mm)
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" viewBox="0 0 {width} {height}">'
    body = [line for number, group in enumerate(page.groups) for line in _group(group, number, page.height_mm)]
    return "\n".join([head, f"<title>{escape(_printable(page.name))}</title>", *body, "</svg>", ""])


def _group(group: Group, number: int, height: float) -> Iterator[str]:
    clip = ""
    if group.clip_mm is not None:
        left, bottom, right, top = group.clip_mm
        box = f'x="{_number(left)}" y="{_number(height - top)}" width="{_number(right - left)}" height="{_number(top - bottom)}"'
        yield f'<clipPath id="clip{number}"><rect {box}/></clipPath>'
        clip = f' clip-path="url(#clip{number})"'
    yield f"<g{clip}>"
    if group.outline_mm is not None:
        # a clip within a clip: what lies in both is printed
        yield f'<clipPath id="outline{number}"><path d="M{_points(group.outline_mm, height)}Z"/></clipPath>'
        yield f'<g clip-path="url(#outline{number})">'
    for shape in group.shapes:
        yield _shape(shape, height)
    yield "</g>" if group.outline_mm is None else "</g></g>"


def _shape(shape: Shape, height: float) -> str:
    if isinstance(shape, Ink):
        circles = (_circle(c, float(r), height) for c, r in zip(shape.center_mm, shape.radius_mm, strict=True))
        polygons = (f"M{_points(p, height)}Z" for p in shape.polygons_mm)
        name = f" id={quoteattr(shape.name)}" if shape.name else ""
        return f'<path{name} fill="#000" fill-rule="evenodd" d="{" ".join([*circles, *polygons])}"/>'
    if isinstance(shape, Line):
        return f'<path fill="none" stroke="#000" stroke-width="{_number(shape.width_mm)}" d="M{_points(shape.points_mm, height)}"/>'
    return _words(shape, height)


def _words(words: Words, height: float) -> str:
    x, y = _number(words.at_mm[0]), _number(height - words.at_mm[1])
    turn = f' transform="rotate(-90 {x} {y})"' if words.upwards else ""
    size = _number(words.height_mm / CAPITALS)
    text = escape(_printable(words.text))
    return f'<text x="{x}" y="{y}" font-family="Helvetica, Arial, sans-serif" font-size="{size}"{turn}>{text}</text>'


def _circle(center: Array, radius: float, height: float) -> str:
    left, right, y = _number(center[0] - radius), _number(center[0] + radius), _number(height - center[1])
    r = _number(radius)
    return f"M{left},{y} A{r},{r} 0 0 1 {right},{y} A{r},{r} 0 0 1 {left},{y}Z"


def _points(points: Array, height: float) -> str:
    return " ".join(f"{_number(x)},{_number(height - y)}" for x, y in points)


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text)


def _number(value: float) -> str:
    """To a nanometre."""
    return f"{value + 0.0:.6f}".rstrip("0").rstrip(".")
