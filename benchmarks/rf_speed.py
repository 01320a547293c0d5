"""Time of a far field of 400 x 400 directions at 30 GHz for a dish of 0.6 m: ours beside a plain sum, in seconds of one core's time.

The plain sum is timed over a few hundred directions and scaled up: the whole of it takes minutes.
"""

from __future__ import annotations

import time

import numpy as np
from _common import print_table

from dishmap.rf.antenna import Antenna, Feed, Reflector, Subreflector
from dishmap.rf.correction import no_correction
from dishmap.rf.deformation import Deformation
from dishmap.rf.farfield import pattern_grid
from dishmap.rf.sources import Sources, sampled, sources, wavelength_of
from dishmap.surface.zernike import zernike_terms

SIDE, WIDEST = 400, 0.15
PLAIN_DIRECTIONS = 400
GOAL_S = 0.3


def main() -> None:
    rows = []
    feed, dish = Feed("gaussian", 12.0), Reflector(600, 300)
    antennas = {
        "prime focus": Antenna(dish, feed),
        "cassegrain": Antenna(dish, feed, Subreflector("cassegrain", 220.0, 4.0)),
        "offset": Antenna(Reflector(600, 300, 350.0), feed),
    }
    for name, antenna in antennas.items():
        wavelength = wavelength_of(antenna, 30.0)
        terms = zernike_terms(8)[3:]
        shape = np.random.default_rng(3).normal(0, 0.3, len(terms))
        deformation = Deformation(terms, shape, antenna.reflector.center_mm, 300.0)
        nodes = sampled(antenna, deformation, wavelength, WIDEST)
        begin = time.process_time()
        made = sources(antenna, deformation, no_correction(antenna), nodes)
        currents_s = time.process_time() - begin
        side = np.linspace(-WIDEST / np.sqrt(2), WIDEST / np.sqrt(2), SIDE)
        ours_s = min(timed(made, wavelength, side) for _ in range(5))
        plain_s, worst = plain(made, wavelength, side)
        rows.append([name, len(nodes.xy_mm), currents_s, ours_s, plain_s, plain_s / ours_s, worst, "yes" if ours_s < GOAL_S else "NO"])
    print_table(
        ["antenna", "nodes", "currents s", "far field s", "plain sum s", "ratio", "error / peak", f"under {GOAL_S} s"],
        rows,
        f"{SIDE} x {SIDE} directions at 30 GHz, D 600 mm",
    )


def timed(made: Sources, wavelength: float, side: np.ndarray) -> float:
    begin = time.process_time()
    pattern_grid(made, wavelength, side, side, "x")
    return time.process_time() - begin


def plain(made: Sources, wavelength: float, side: np.ndarray) -> tuple[float, float]:
    """Seconds of a plain sum over all directions, and the largest difference of ours from it over the peak."""
    grid = pattern_grid(made, wavelength, side, side, "x")
    rows, columns = np.random.default_rng(1).integers(0, SIDE, (2, PLAIN_DIRECTIONS))
    u, v = side[columns], side[rows]
    direction = np.stack([u, v, np.sqrt(1 - u**2 - v**2)], axis=1)
    k = 2 * np.pi / wavelength
    begin = time.process_time()
    total = np.concatenate(
        [np.exp(1j * k * (part @ made.point_mm.T - made.rays.path_mm)) @ made.moment for part in np.array_split(direction, 40)]
    )
    seconds = (time.process_time() - begin) * SIDE**2 / PLAIN_DIRECTIONS
    size = k / np.sqrt(4 * np.pi) * np.linalg.norm(total - direction * (total * direction).sum(axis=1)[:, None], axis=1)
    ours = np.sqrt(np.abs(grid.co[rows, columns]) ** 2 + np.abs(grid.cross[rows, columns]) ** 2)
    return seconds, float(np.abs(size - ours).max() / np.abs(grid.co).max())


if __name__ == "__main__":
    main()
