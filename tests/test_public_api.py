"""The public names: they all exist, load on demand, and the tables of __init__.py agree."""

from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path

import pytest

import dishmap

ROOT = Path(__file__).resolve().parents[1]
INIT = ROOT / "src" / "dishmap" / "__init__.py"


@pytest.mark.parametrize("name", dishmap.__all__)
def test_name_exists_and_is_documented(name: str) -> None:
    value = getattr(dishmap, name)
    assert name == "__version__" or (inspect.getdoc(value) or "").strip()
    assert getattr(dishmap, name) is value


def test_the_tables_agree() -> None:
    for_type_checkers = {
        alias.asname or alias.name: node.module
        for node in ast.walk(ast.parse(INIT.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("dishmap.")
        for alias in node.names
    }
    assert for_type_checkers == dishmap._HOME
    assert set(dishmap.__all__) == {*dishmap._HOME, "__version__"}
    assert set(dishmap.__all__) <= set(dir(dishmap))


def test_a_wrong_name_is_answered_with_the_right_ones() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'Kamera'; the public names are Anchors, Antenna, Assumptions, "):
        _ = dishmap.Kamera


def test_version_is_the_installed_one() -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+", dishmap.__version__)
    assert f'version = "{dishmap.__version__}"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def test_packages_are_not_hidden_by_public_names() -> None:
    packages = {path.parent.name for path in INIT.parent.glob("*/__init__.py")} | {path.stem for path in INIT.parent.glob("*.py")}
    assert packages.isdisjoint(dishmap.__all__)


def python_blocks() -> list[tuple[str, str]]:
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    return [(page.name, code) for page in pages for code in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)]


@pytest.mark.parametrize(("page", "code"), python_blocks())
def test_names_in_the_pages_exist(page: str, code: str) -> None:
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "dishmap":
            assert node.attr in dishmap.__all__, f"{page} uses dishmap.{node.attr}"
