"""What a printer would put on paper: pages rendered by poppler, and SVG files read as the geometry that they hold."""

from __future__ import annotations

import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result
from numpy.typing import NDArray

from dishmap.cli.app import program

Array = NDArray[np.float64]

INCH_MM = 25.4
needs_poppler = pytest.mark.skipif(shutil.which("pdftoppm") is None, reason="needs pdftoppm of poppler-utils to render PDF files")


def dishmap(*words: object) -> Result:
    """Run `dishmap` with these words; what it says on standard error is kept apart."""
    try:
        runner = CliRunner(mix_stderr=False)  # type: ignore[call-arg]
    except TypeError:  # click 8.2 and newer always keep it apart
        runner = CliRunner()
    return runner.invoke(program, [str(word) for word in words])


def rendered(pdf: Path, dpi: int, snapped: bool = True) -> list[NDArray[np.uint8]]:
    """Every page of a PDF file as a grey picture; snapped: poppler's own renderer, which moves upright rectangles to whole pixels."""
    folder = pdf.parent / f"rendered-{dpi}"
    folder.mkdir()
    program = ["pdftoppm"] if snapped else ["pdftocairo", "-png"]
    subprocess.run([*program, "-r", str(dpi), "-gray", str(pdf), str(folder / "page")], check=True)
    return [np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in sorted(folder.iterdir())]


def on_paper_mm(pixels: Array, dpi: int, height_mm: float) -> Array:
    """Pixels (N, 2) of a rendered page in millimetres from its lower left corner."""
    mm = (np.asarray(pixels) + 0.5) * INCH_MM / dpi
    return np.stack([mm[..., 0], height_mm - mm[..., 1]], axis=-1)


class SvgPage:
    """The geometry of an SVG page in mm from the lower left corner: circles and polygons of every named ink, lines, words."""

    def __init__(self, path: Path) -> None:
        root = ElementTree.parse(path).getroot()
        space = "{http://www.w3.org/2000/svg}"
        self.size_mm = tuple(float(root.attrib[side].removesuffix("mm")) for side in ("width", "height"))
        assert root.attrib["viewBox"] == f"0 0 {root.attrib['width'][:-2]} {root.attrib['height'][:-2]}"
        height = self.size_mm[1]
        self.circles: dict[str, Array] = {}
        self.polygons: dict[str, list[Array]] = {}
        self.lines: list[Array] = []
        for shape in root.iter(f"{space}path"):
            d = shape.attrib["d"]
            if shape.attrib.get("fill") == "none":
                points = np.array([[float(v) for v in pair.split(",")] for pair in d[1:].split()])
                self.lines.append(np.stack([points[:, 0], height - points[:, 1]], axis=1))
            elif " A" in d:
                found = re.findall(r"M([\d.-]+),([\d.-]+) A([\d.]+),", d)
                rows = [(float(x) + float(r), height - float(y), float(r)) for x, y, r in found]
                self.circles[shape.attrib["id"]] = np.array(rows)
            elif "id" in shape.attrib:
                for part in d.split("Z")[:-1]:
                    points = np.array([[float(v) for v in pair.split(",")] for pair in part.strip()[1:].split()])
                    self.polygons.setdefault(shape.attrib["id"], []).append(np.stack([points[:, 0], height - points[:, 1]], axis=1))
        self.words = [str(text.text) for text in root.iter(f"{space}text")]


def placed_shifts(listing: dict[str, Any]) -> dict[int, list[dict[str, Any]]]:
    """What lies on each page, counted from 1."""
    pages: dict[int, list[dict[str, Any]]] = {}
    for entry in listing["placed"]:
        pages.setdefault(entry["page"], []).append(entry)
    return pages
