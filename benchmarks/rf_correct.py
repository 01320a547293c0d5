"""What corrections win back, and how long they take: a 0.6 m Kapton dish of f/D 0.5 that is heated from one side.

    scripts/bench rf_correct

The deformation: a radial gradient (defocus and spherical), twelve gores, a tilted gradient (coma, astigmatism), in mm at the rim. Gain at
the beam's peak, pointed anew, -12 dB taper, before and after; one set of values for 12.5 and 30 GHz together. Time is that of one
processor for the whole correction, checks included (goal for a rigid one: under 2 s).
"""

from __future__ import annotations

import time

import numpy as np
from _common import print_table

from dishmap.rf.antenna import Actuators, Antenna, Blockage, Feed, Reflector, Subreflector
from dishmap.rf.correct import best_correction
from dishmap.rf.deformation import Deformation

FREQUENCIES_GHZ, GOAL_S = (12.5, 30.0), 2.0
MAIN, FEED = Reflector(600.0, 300.0), Feed("aperture", 12.0)
SUB = Subreflector("cassegrain", 220.0, 4.0)
# mm at the rim, for a heating that gives 1 mm of defocus
THERMAL = {(2, 0): 1.0, (4, 0): 0.15, (12, 12): 0.1, (3, 1): 0.3, (2, 2): 0.4, (2, -2): 0.15, (3, 3): 0.1, (1, 1): 0.5}


def main() -> None:
    antennas = {
        "prime focus": Antenna(MAIN, FEED),
        "Cassegrain": Antenna(MAIN, FEED, SUB),
        "Cassegrain, bent": Antenna(MAIN, FEED, SUB, Blockage(), Actuators(shape_degree=4, shape_stroke_mm=3.0)),
    }
    rows = []
    for heat in (1.0, 3.0):
        deformation = Deformation(tuple(THERMAL), heat * np.array(list(THERMAL.values())), np.zeros(2), 300.0)
        for name, antenna in antennas.items():
            start = time.process_time()
            found = best_correction(antenna, deformation, FREQUENCIES_GHZ)
            spent = time.process_time() - start
            gains = [value for pair in zip(found.before_dbi, found.after_dbi, strict=True) for value in pair]
            values = " ".join(f"{v:.2f}" for v in found.correction.values[:5])
            rows.append([f"{heat:g} mm", name, *(f"{g:.2f}" for g in gains), values, ",".join(found.limits) or "-", found.starts, spent])
    header = ["defocus", "antenna", "12.5 GHz", "after", "30 GHz", "after", "shift mm, tilt deg", "limits", "starts", "s"]
    print_table(header, rows, "gain in dBi before and after")
    slow = [row for row in rows if "bent" not in row[1] and row[-1] > GOAL_S]
    print(f"\nrigid corrections in under {GOAL_S:g} s: {'missed' if slow else 'reached'}")


if __name__ == "__main__":
    main()
