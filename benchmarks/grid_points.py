"""Crossings and squares fitted to raw pixels: error against claim and bound over blur, width, size, pitch and tilt; and the time it takes.

`--quick`: fewer photographs of each case.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from statistics import median

import numpy as np
from _common import QUICK, Z95, print_table, rms
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.targets.grid_bound import grid_bound
from dishmap.targets.grid_points import measure_grid
from dishmap.targets.pattern import Pattern

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from grid_drawing import Drawing, bowl, facing, flat, line_grid, square_grid

Array = NDArray[np.float64]

PITCH_MM, SIDE = 12.0, 9
# A step of the lattice is seen under 2.3 degrees.
FOCAL_PITCHES = 25.0
CONTRAST, NOISE = 170.0, 4.0
PHOTOGRAPHS = 2 if QUICK else 8
TURN, STEEP, FACING = (15.0, 20.0, 30.0), (60.0, 0.0, 20.0), (0.0, 0.0, 0.0)
# kind, psf, width or side (px), pitch (px), turn (degrees)
CASES = [
    ("lines", 0.5, 3.0, 36.0, TURN),
    ("lines", 0.8, 3.0, 36.0, TURN),
    ("lines", 1.5, 3.0, 36.0, TURN),
    ("lines", 2.5, 3.0, 36.0, TURN),
    ("lines", 0.8, 1.5, 36.0, TURN),
    ("lines", 0.8, 6.0, 36.0, TURN),
    ("lines", 0.8, 12.0, 48.0, TURN),
    ("lines", 0.8, 1.5, 12.0, TURN),
    ("lines", 0.8, 3.0, 36.0, FACING),
    ("lines", 0.8, 3.0, 36.0, STEEP),
    ("squares", 0.8, 10.0, 24.0, TURN),
    ("squares", 0.8, 15.0, 36.0, TURN),
    ("squares", 0.8, 15.0, 36.0, STEEP),
    ("squares", 2.0, 15.0, 36.0, TURN),
    ("squares", 0.8, 40.0, 80.0, TURN),
    ("squares", 0.8, 100.0, 160.0, TURN),
]


def scene(kind: str, psf_px: float, size_px: float, pitch_px: float, turn_deg: tuple[float, float, float]) -> tuple[Pattern, Drawing]:
    size_mm = size_px / pitch_px * PITCH_MM
    pattern = line_grid(SIDE, SIDE, PITCH_MM, size_mm) if kind == "lines" else square_grid(SIDE, SIDE, PITCH_MM, size_mm)
    width = int(SIDE * pitch_px * 1.35 + 40)
    camera = Camera(width, width, [FOCAL_PITCHES * pitch_px] * 2, [0.5 * (width - 1)] * 2, [-0.25, 0.06, 0.001, -0.0005, 0.0])
    drawing = Drawing(camera, facing(FOCAL_PITCHES * PITCH_MM, turn_deg), flat, psf_px)
    drawing.add_pattern(pattern)
    return pattern, drawing


def row(number: int, kind: str, psf_px: float, size_px: float, pitch_px: float, turn_deg: tuple[float, float, float]) -> list[object]:
    pattern, drawing = scene(kind, psf_px, size_px, pitch_px, turn_deg)
    place = drawing.place_px(pattern.center_mm[:, :2])
    truth = place
    if not pattern.lines:
        truth = drawing.place_px(pattern.center_mm[:, None, :2] + pattern.kind_of(0).polygons[0].corners_mm).mean(axis=1)
    index = np.flatnonzero(drawing.camera.contains(place, margin_px=6.0))
    size = (drawing.camera.width_px, drawing.camera.height_px)
    bound = np.full((len(pattern), 2), np.nan)
    information = grid_bound(pattern, index, place[index], size, CONTRAST / NOISE, psf_px)
    bound[index] = np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)[:, :2])
    assert pattern.lattice is not None
    whole = ((pattern.lattice > 1) & (pattern.lattice < SIDE - 2)).all(axis=1)
    errors, claims, bounds, inner, named = [], [], [], [], 0
    for seed in range(PHOTOGRAPHS):
        rng = np.random.default_rng([number, seed])
        image = drawing.image() + NOISE * rng.standard_normal(drawing.cover.shape)
        points = measure_grid(image, pattern, index, place[index] + rng.uniform(-0.3, 0.3, (len(index), 2)))
        errors.append(points.center_px - truth[points.index])
        claims.append(np.sqrt(np.diagonal(np.linalg.inv(points.information), axis1=1, axis2=2)[:, :2]))
        bounds.append(bound[points.index])
        inner.append(whole[points.index])
        named += len(points)
    error, claim, least = (np.concatenate(values) for values in (errors, claims, bounds))
    inside = float(np.mean(np.abs(error) < Z95 * claim))
    # each error over its own bound, as bounds differ over a tilted grid; of nodes with all neighbours, whose lines' directions are known
    efficiency = 1 / rms((error / least)[np.concatenate(inner)])
    tilt = f"{turn_deg[0]:.0f}, {turn_deg[1]:.0f}, {turn_deg[2]:.0f}"
    share = f"{named}/{PHOTOGRAPHS * len(index)}"
    return [kind, psf_px, size_px, pitch_px, tilt, share, rms(error), rms(claim), rms(least), round(efficiency, 2), f"{100 * inside:.0f} %"]


def speed() -> None:
    """2,000 crossings of pitch 36 px and lines of 3 px in a photograph of 16 MP."""
    camera = Camera(4608, 3456, [2700.0, 2700.0], [2303.5, 1727.5], [-0.1, 0.02, 0.0, 0.0, 0.0])
    pattern = line_grid(50, 40, PITCH_MM, 1.0)
    drawing = Drawing(camera, facing(900.0, (8.0, 5.0, 7.0)), bowl(600.0), 0.8)
    drawing.add_pattern(pattern)
    rng = np.random.default_rng(1)
    image = np.clip(np.round(drawing.image() + NOISE * rng.standard_normal(drawing.cover.shape)), 0, 255).astype(np.uint8)
    place = drawing.place_px(pattern.center_mm[:, :2])
    start = place + rng.uniform(-0.3, 0.3, place.shape)
    times = []
    for _ in range(5):
        before = time.process_time()
        points = measure_grid(image, pattern, np.arange(len(pattern)), start)
        times.append(time.process_time() - before)
    error = points.center_px - place[points.index]
    print(f"\n{len(points)} of {len(pattern)} crossings, error {rms(error):.4f} px: {median(times):.2f} s of one processor (goal 0.25 s)")


if __name__ == "__main__":
    header = ["kind", "psf px", "size px", "pitch px", "turned by", "measured", "error px", "claimed", "bound", "efficiency*", "in 95 %"]
    rows = (row(number, *case) for number, case in enumerate(CASES))
    print_table(header, rows, f"Error of one coordinate, contrast over noise {CONTRAST / NOISE:.0f}")
    print("* of nodes with all 24 neighbours")
    speed()
