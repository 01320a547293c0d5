"""Build site/: the pages of docs/ and the changelog as HTML, and the API reference from docstrings.

Run by scripts/docs. Fails when a page links to a file or a heading that is not there, or when no page links to it.
"""

from __future__ import annotations

import html
import inspect
import pkgutil
import re
import shutil
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import pdoc
from markdown_it import MarkdownIt
from numpy.typing import ArrayLike

import dishmap

ROOT = Path(__file__).resolve().parents[1]
SITE = ROOT / "site"
PAGES = {path: f"{path.stem.lower()}.html" for path in [*sorted((ROOT / "docs").glob("*.md")), ROOT / "CHANGELOG.md"]}

LONG_TYPE = inspect.formatannotation

FRAME = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title} - dishmap</title>
<style>
body {{ font: 16px/1.55 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222; background: #fff }}
nav {{ border-bottom: 1px solid #ccc; padding-bottom: .5rem }} nav a {{ margin-right: 1.2rem }} a {{ color: #0b5cad }}
pre, code {{ font: 14px/1.45 ui-monospace, monospace; background: #f4f4f2 }} pre {{ padding: .8rem; overflow-x: auto }}
table {{ border-collapse: collapse; display: block; overflow-x: auto }}
td, th {{ border: 1px solid #ccc; padding: .3rem .6rem; text-align: left; vertical-align: top }}
img {{ max-width: 100% }}
</style>
<nav><a href="index.html">dishmap</a><a href="tutorial.html">Tutorial</a><a href="conventions.html">Conventions</a>
<a href="design.html">Design</a><a href="api/dishmap.html">API</a><a href="changelog.html">Changes</a></nav>
{body}
</html>
"""


def page(source: Path) -> str:
    """Render one markdown file as a whole HTML page, its headings with ids and its links pointing into the site."""
    markdown = MarkdownIt("commonmark").enable("table")
    tokens = markdown.parse(source.read_text(encoding="utf-8"))
    title = source.stem
    for token, following in pairwise(tokens):
        if token.type == "heading_open":
            text = following.content.replace("`", "")
            token.attrSet("id", re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-"))
            title = text if token.tag == "h1" else title
    for token in tokens:
        for child in token.children or []:
            if child.type == "link_open":
                child.attrSet("href", site_link(source, str(child.attrGet("href"))))
            elif child.type == "image":
                child.attrSet("src", site_link(source, str(child.attrGet("src"))))
    return FRAME.format(title=html.escape(title), body=markdown.renderer.render(tokens, markdown.options, {}))


def site_link(source: Path, link: str) -> str:
    """Where a link of a page leads in the site: another page by its HTML name, any other file of the project by a copy."""
    path, _, anchor = link.partition("#")
    if "://" in link or not path or path.startswith("api/"):
        return link
    target = (source.parent / path).resolve()
    if target not in PAGES and target.is_file():
        shutil.copy(target, SITE / target.name)
    return PAGES.get(target, target.name) + (f"#{anchor}" if anchor else "")


def broken_links() -> list[str]:
    """Links of the site's own pages that lead nowhere, and pages that no other page links to."""
    found = []
    linked = {"index.html"}
    for name in PAGES.values():
        text = (SITE / name).read_text(encoding="utf-8")
        for link in re.findall(r'(?:href|src)="([^"]+)"', text):
            path, _, anchor = html.unescape(link).partition("#")
            if "://" in link:
                continue
            if path != name:
                linked.add(path)
            target = SITE / (path or name)
            if not target.is_file():
                found.append(f"{name} links to {link}, which does not exist")
            elif anchor and f'id="{anchor}"' not in target.read_text(encoding="utf-8"):
                found.append(f"{name} links to {link}, which has no such heading")
    return found + [f"no page links to {name}" for name in sorted(set(PAGES.values()) - linked)]


def short_type(annotation: Any, *args: Any, **options: Any) -> str:
    """An annotation as it is written in the source: numpy's array types expand to several lines each."""
    if annotation == ArrayLike:
        return "ArrayLike"
    text = LONG_TYPE(annotation, *args, **options)
    return re.sub(r"numpy\.ndarray\[tuple\[(?:typing\.)?Any, \.\.\.\], numpy\.dtype\[(?:numpy\.)?(\w+)\]\]", r"NDArray[\1]", text)


def api() -> None:
    """Write the API reference: the public names first, then every module."""
    for name in dishmap.__all__:
        getattr(dishmap, name)  # they load when first used, and pdoc shows only what is loaded
    dishmap.__all__ += [module.name for module in pkgutil.iter_modules(dishmap.__path__) if not module.name.startswith("_")]
    inspect.formatannotation = pdoc.doc.formatannotation = short_type  # type: ignore[assignment]
    pdoc.render.configure(docformat="markdown", footer_text=f"dishmap {dishmap.__version__}")
    pdoc.pdoc("dishmap", output_directory=SITE / "api")


def main() -> int:
    shutil.rmtree(SITE, ignore_errors=True)
    SITE.mkdir()
    for source, name in PAGES.items():
        (SITE / name).write_text(page(source), encoding="utf-8")
    api()
    problems = broken_links()
    print("\n".join(problems) or f"{SITE / 'index.html'}: {len(PAGES)} pages and the API reference")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
