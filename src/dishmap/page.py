"""The shell of a report: one HTML page that needs nothing but itself. All text that enters is escaped here."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterable, Sequence
from html import escape

STYLE = """
:root{color-scheme:light}
*{box-sizing:border-box}
body{margin:0;background:#fff;color:#1a1a1a;font:16px/1.5 system-ui,"Segoe UI",Roboto,"DejaVu Sans",Arial,sans-serif}
main{max-width:1180px;margin:0 auto;padding:28px 28px 60px}
h1{font-size:27px;line-height:1.25;margin:0 0 4px;overflow-wrap:anywhere}
h2{font-size:20px;margin:44px 0 12px;padding-bottom:4px;border-bottom:1px solid #d0d0d0}
h3{font-size:17px;margin:24px 0 8px}
p{margin:8px 0;max-width:80ch}
.verdict{border-left:6px solid #0072b2;background:#f3f7fa;padding:14px 20px;margin:18px 0;font-size:20px;font-weight:600}
.verdict.look{border-color:#d55e00;background:#fdf5ef}
.facts{display:grid;grid-template-columns:repeat(auto-fit,minmax(205px,1fr));gap:12px;margin:18px 0;padding:0}
.facts div{border:1px solid #d0d0d0;border-radius:6px;padding:10px 14px}
.facts dt{font-size:13.5px;color:#505050}
.facts dd{margin:0}
.facts .value{font-size:23px;font-weight:600;white-space:nowrap}
.facts .detail{font-size:13.5px;color:#505050}
ul.warnings{padding-left:22px;margin:8px 0}
ul.warnings li{margin:6px 0;max-width:100ch;overflow-wrap:anywhere}
.charts{display:grid;grid-template-columns:repeat(auto-fit,minmax(440px,1fr));gap:28px 32px;align-items:start}
figure{margin:12px 0;break-inside:avoid}
figure>svg,figure>img{display:block;max-width:100%;height:auto;margin:0 auto}
figcaption{font-size:14.5px;color:#333;margin-top:6px;max-width:90ch}
.plot3d{width:100%;height:620px}
.wide{overflow-x:auto}
table{border-collapse:collapse;font-size:14px;font-variant-numeric:tabular-nums}
th,td{padding:3px 12px 3px 0;text-align:right;vertical-align:top;border-bottom:1px solid #e4e4e4}
th{border-bottom:1.5px solid #888;font-weight:600;vertical-align:bottom}
td.text,th.text{text-align:left;overflow-wrap:anywhere;min-width:11ch}
thead{display:table-header-group}
tr{break-inside:avoid}
@media print{
 *{print-color-adjust:exact;-webkit-print-color-adjust:exact}
 body{font-size:11pt}
 main{max-width:none;padding:0}
 h2{break-after:avoid}
 .charts{grid-template-columns:1fr 1fr;gap:12px}
 table{font-size:8.5pt}
 th,td{padding-right:8px}
 .wide{overflow:visible}
}
"""
# Nothing is fetched, whatever the page holds; plotly compiles its drawing routines at run time, hence unsafe-eval.
POLICY = "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src 'unsafe-inline' 'unsafe-eval'"


def page(title: str, body: Iterable[str], scripts: Iterable[str] = ()) -> str:
    """A whole page from sections of HTML; scripts (JavaScript) stand at its end."""
    code = "".join(f"<script>{script}</script>\n" for script in scripts)
    head = (
        '<meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(title)}</title>",
        f"<style>{STYLE}</style>",
    )
    main = "\n".join([f"<h1>{escape(title)}</h1>", *(part for part in body if part)])
    lines = [
        "<!DOCTYPE html>",
        '<html lang="en">',
        "<head>",
        *head,
        "</head>",
        "<body>",
        "<main>",
        main,
        "</main>",
        f"{code}</body>",
        "</html>",
        "",
    ]
    return "\n".join(lines)


def section(heading: str, *parts: str) -> str:
    """A section under a heading."""
    return f"<section>\n<h2>{escape(heading)}</h2>\n{chr(10).join(part for part in parts if part)}\n</section>"


def paragraph(text: str) -> str:
    """A paragraph of plain text; what stands in `backquotes` is set as code."""
    return f"<p>{_prose(text)}</p>"


def verdict_box(text: str, look: bool) -> str:
    """The headline; `look` marks one with something to look at below."""
    return f'<p class="verdict{" look" if look else ""}">{escape(text)}</p>'


def fact_grid(facts: Iterable[tuple[str, str, str]]) -> str:
    """Tiles of (name, value, detail)."""
    tiles = (
        f'<div><dt>{escape(name)}</dt><dd class="value">{escape(value)}</dd><dd class="detail">{escape(detail)}</dd></div>'
        for name, value, detail in facts
    )
    return f'<dl class="facts">{"".join(tiles)}</dl>'


def bullet_list(items: Iterable[str]) -> str:
    """A list of sentences."""
    return '<ul class="warnings">' + "".join(f"<li>{_prose(item)}</li>" for item in items) + "</ul>"


def figure(svg: str, caption: str, alt: str = "") -> str:
    """A picture with its caption.

    With `alt`, the SVG becomes an image of its own, so that names and styles inside it cannot meet those of others; without, it
    stands in the page and must describe itself.
    """
    if alt:
        data = base64.b64encode(svg.encode("utf-8")).decode("ascii")
        svg = f'<img src="data:image/svg+xml;base64,{data}" alt="{escape(alt)}">'
    return f"<figure>{svg}<figcaption>{_prose(caption)}</figcaption></figure>"


def charts(*figures: str) -> str:
    """Figures side by side where the page is wide enough."""
    return f'<div class="charts">{"".join(figure for figure in figures if figure)}</div>'


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], text_columns: Iterable[int] = ()) -> str:
    """A table of ready texts; numbers to the right, the columns of `text_columns` to the left."""
    kind = dict.fromkeys(text_columns, ' class="text"')
    head = "".join(f'<th scope="col"{kind.get(i, "")}>{escape(h)}</th>' for i, h in enumerate(heads))
    lines = ("<tr>" + "".join(f"<td{kind.get(i, '')}>{escape(cell)}</td>" for i, cell in enumerate(row)) + "</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>\n{chr(10).join(lines)}\n</tbody></table></div>'


def script_json(value: object) -> str:
    """JSON that may stand inside a script element, whatever it holds."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"), sort_keys=True)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _prose(text: str) -> str:
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))
