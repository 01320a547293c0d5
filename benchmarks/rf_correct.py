"""What corrections win back, and how long they take: a 0.6 m Kapton dish of f/D 0.5 that is heated from one side.

    scripts/bench rf_correct

The deformation: a radial gradient (defocus and spherical), twelve gores, a tilted gradient (coma, astigmatism), in mm at the rim. Gain at
the beam's peak, pointed anew, -12 dB taper, before and after; one set of values for 12.5 and 30 GHz together. Time is that of one
processor for the whole correction, checks included. Then single modes (half-path error 0.5 mm rms) at 30 GHz, and bends of each degree.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from _common import print_table

from dishmap.rf.antenna import Actuators, Antenna, Feed, Reflector, Subreflector
from dishmap.rf.correct import CorrectionFound, best_correction
from dishmap.rf.deformation import Deformation, undeformed
from dishmap.rf.goals import Broaden, Goal, Steer
from dishmap.rf.target_beam import target_beam

FREQUENCIES_GHZ, RIGID_S, BENT_S, BEAM_S = (12.5, 30.0), 2.0, 15.0, 20.0
MAIN, FEED = Reflector(600.0, 300.0), Feed("aperture", 12.0)
SUB = Subreflector("cassegrain", 220.0, 4.0)
CASSEGRAIN = Antenna(MAIN, FEED, SUB)
# mm at the rim, for a heating that gives 1 mm of defocus
THERMAL = {(2, 0): 1.0, (4, 0): 0.15, (12, 12): 0.1, (3, 1): 0.3, (2, 2): 0.4, (2, -2): 0.15, (3, 3): 0.1, (1, 1): 0.5}
MODES = {"defocus": (2, 0), "coma": (3, 1), "spherical": (4, 0), "astigmatism": (2, 2), "trefoil": (3, 3)}


def bends(degree: int, antenna: Antenna = CASSEGRAIN) -> Antenna:
    return replace(antenna, actuators=Actuators(shape_degree=degree, shape_stroke_mm=3.0))


def heated(millimetres: float) -> Deformation:
    return Deformation(tuple(THERMAL), millimetres * np.array(list(THERMAL.values())), np.zeros(2), 300.0)


def timed(antenna: Antenna, deformation: Deformation, frequencies: tuple[float, ...]) -> tuple[CorrectionFound, float]:
    start = time.process_time()
    found = best_correction(antenna, deformation, frequencies)
    return found, time.process_time() - start


def thermal() -> None:
    """The heated dish, line by line as they come."""
    print("\nheated dish: gain in dBi before and after; goals: rigid under 2 s, bent under 15 s of one processor", flush=True)
    antennas = {"prime focus": Antenna(MAIN, FEED), "Cassegrain": CASSEGRAIN, "Cassegrain, bent to degree 4": bends(4)}
    for heat in (1.0, 2.0, 3.0):
        for name, antenna in antennas.items():
            found, spent = timed(antenna, heated(heat), FREQUENCIES_GHZ)
            gains = "  ".join(
                f"{f:g} GHz {b:.2f} -> {a:.2f}" for f, b, a in zip(FREQUENCIES_GHZ, found.before_dbi, found.after_dbi, strict=True)
            )
            goal = BENT_S if "bent" in name else RIGID_S
            pose = " ".join(f"{v:.2f}" for v in found.correction.values[:5])
            check, rest = np.abs(found.check_db).max(), "at rest" if found.converged else "not at rest"
            print(f"{heat:g} mm  {name:28}  {gains}  pose {pose}  limits {','.join(found.limits) or '-'}  starts {found.starts}  ", end="")
            print(f"check {check:.0e} dB  {rest}  {spent:.1f} s{'' if spent < goal else ' (goal missed)'}", flush=True)


def modes() -> None:
    """Loss in dB of single modes, and what is left of it."""
    rows = []
    antennas = {"prime focus": Antenna(MAIN, FEED), "Cassegrain": CASSEGRAIN, "bent to 4": bends(4)}
    ideal = {name: best_correction(a, undeformed(MAIN), (30.0,)).before_dbi[0] for name, a in antennas.items()}
    for mode, (n, m) in MODES.items():
        size = 0.5 * np.sqrt((n + 1) * (1 if m == 0 else 2)) / np.cos(np.arctan(0.35))
        row: list[object] = [mode]
        for name, antenna in antennas.items():
            found, _ = timed(antenna, Deformation(((n, m),), np.array([size]), np.zeros(2), 300.0), (30.0,))
            row += [f"{ideal[name] - found.before_dbi[0]:.2f}", f"{ideal[name] - found.after_dbi[0]:.2f}"]
        rows.append(row)
        print(f"  {mode} done", flush=True)
    print_table(
        ["mode", "prime", "after", "Cassegrain", "after", "bends", "after"], rows, "loss in dB at 30 GHz, 0.5 mm rms, before and after"
    )


def degrees() -> None:
    """The heated dish at 30 GHz against the degree of the bend."""
    rows = []
    for degree in (2, 3, 4, 5):
        found, spent = timed(bends(degree), heated(1.0), (30.0,))
        rows.append([degree, f"{found.after_dbi[0]:.3f}", f"{found.lost_share:.3f}", f"{np.abs(found.check_db).max():.0e}", spent])
        print(f"  degree {degree} done", flush=True)
    print_table(["degree", "dBi", "lost share", "check dB", "s"], rows, "1 mm of heating at 30 GHz, bends of more and more degrees")


def beams() -> None:
    """Beams made by the actuators on the heated dish."""
    rows = []
    goals: dict[str, Goal] = {"steered by 1 deg": Steer.degrees(1.0, 90.0), "broadened to 1 deg": Broaden(1.0)}
    for name, goal in goals.items():
        for degree in (0, 4, 6):
            antenna = bends(degree) if degree else CASSEGRAIN
            start = time.process_time()
            made = target_beam(antenna, heated(0.3), 30.0, goal)
            spent = time.process_time() - start
            rows.append([name, degree, f"{made.before_db:.2f}", f"{made.after_db:.2f}", "yes" if made.converged else "no", spent])
            print(f"  {name}, degree {degree}: {spent:.1f} s{'' if spent < BEAM_S else ' (goal of 20 s missed)'}", flush=True)
    print_table(["beam", "degree", "before dBi", "after", "at rest", "s"], rows, "beams at 30 GHz, 0.3 mm of heating")


def main() -> None:
    start = time.perf_counter()
    for part in (thermal, modes, degrees, beams):
        part()
    print(f"\nall of it: {time.perf_counter() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
