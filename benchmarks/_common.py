"""What the benchmarks share: where the data lies, tables, and scores of predicted against measured errors."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.pipeline import Map
from dishmap.simulate.truth import Truth
from dishmap.transforms import angle_between_rad

Array = NDArray[np.float64]

DATA = Path(os.environ.get("DISHMAP_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
QUICK = "--quick" in sys.argv
# A normal variable stays within this many sigmas with a probability of 95 %.
Z95 = 1.959964

cv2.setNumThreads(1)


def data_folder(name: str) -> Path | None:
    """The folder DATA/name, or None after a sentence about its absence."""
    folder = DATA / name
    if folder.is_dir():
        return folder
    print(f"skipped: there is no folder {folder}; set DISHMAP_DATA to the folder that holds {name}")
    return None


def print_table(header: Sequence[str], rows: Iterable[Sequence[object]], title: str = "") -> None:
    """Print rows under a header, columns as wide as their widest cell; numbers to the right."""
    cells = [[_cell(value) for value in row] for row in rows]
    widths = [max(len(head), *(len(row[i]) for row in cells)) if cells else len(head) for i, head in enumerate(header)]
    if title:
        print(f"\n{title}")
    print("  ".join(head.rjust(width) for head, width in zip(header, widths, strict=True)))
    for row in cells:
        print("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)), flush=True)


def _cell(value: object) -> str:
    if isinstance(value, float | np.floating):
        return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"
    return str(value)


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if np.size(values) else np.nan


@dataclass(frozen=True)
class Errors:
    """Measured minus true of N targets, with the sigmas that were claimed.

    ids (N,); position_mm (N, 3); center_px (N, 2); normal_rad (N,) angle; the three claimed sigmas alike; quality (N,).
    """

    ids: NDArray[np.int64]
    position_mm: Array
    center_px: Array
    normal_rad: Array
    sigma_mm: Array
    sigma_px: Array
    sigma_normal_rad: Array
    quality: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.normal_rad)

    @property
    def scores(self) -> Array:
        """Errors over claimed sigmas (N, 5): x, y, z, u, v."""
        return np.concatenate([self.position_mm / self.sigma_mm, self.center_px / self.sigma_px], axis=1)


def errors_of(result: Map, truth: Truth) -> Errors:
    """Errors of all measured targets; `truth` in any order."""
    cloud = result.cloud
    row = {int(ident): i for i, ident in enumerate(truth.ids)}
    index = np.array([row[int(ident)] for ident in cloud.ids], dtype=np.int64)
    return Errors(
        cloud.ids,
        cloud.position_mm - truth.center_mm[index],
        cloud.center_px - truth.center_px[index],
        angle_between_rad(cloud.normal, truth.normal[index]),
        np.sqrt(np.einsum("nii->ni", cloud.covariance_mm2)),
        np.sqrt(np.einsum("nii->ni", cloud.covariance_px2)),
        cloud.sigma_normal_rad,
        cloud.quality,
    )


def nothing() -> Errors:
    """Errors of no target."""
    none = np.zeros(0)
    flags = np.zeros(0, np.int64)
    return Errors(flags, np.zeros((0, 3)), np.zeros((0, 2)), none, np.zeros((0, 3)), np.zeros((0, 2)), none, flags)


def select(errors: Errors, keep: NDArray[np.bool_]) -> Errors:
    return Errors(*(getattr(errors, name)[keep] for name in Errors.__dataclass_fields__))


def join(parts: Sequence[Errors]) -> Errors:
    return Errors(*(np.concatenate([getattr(part, name) for part in parts]) for name in Errors.__dataclass_fields__))


def covered(scores: Array) -> float:
    """Percentage of errors within their 95 % interval."""
    return 100 * float(np.mean(np.abs(scores) < Z95))


def wrong_names(result: Map, truth: Truth, camera: Camera) -> int:
    """Number of named targets that lie nearer to another target's true place than to their own."""
    place = camera.project(truth.center_mm)
    place = np.where(np.isfinite(place), place, np.inf)
    own = {int(ident): i for i, ident in enumerate(truth.ids)}
    wrong = 0
    for ident, center in zip(result.cloud.ids, result.cloud.center_px, strict=True):
        distance = np.linalg.norm(place - center, axis=1)
        wrong += int(np.argmin(distance) != own[int(ident)])
    return wrong
