"""How good must the map be? Gain that a correction leaves on the table because the map that it was made from has errors.

    scripts/bench rf_margin

The heated dish of `rf_correct` (0.6 m, f/D 0.5), mapped by 93 and by 130 targets with independent errors along the normal, carried to the
whole aperture as `dishmap rf` does it, the more smoothly the larger they are; corrections by the feed at the prime focus, by the pose of
a Cassegrain's subreflector, and by its pose and shape (degree 3), within their strokes. Mean loss in dB against the correction made from
the truth, over 40 maps (in pairs of opposite errors); what is below 0.0005 dB is rounding and sampling. Corrections are made for both
frequencies together, so that one of them may gain a little.
"""

from __future__ import annotations

import os

# one core, whatever the machine has; before numpy is loaded
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from _common import print_table
from rf_correct import CASSEGRAIN, FEED, FREQUENCIES_GHZ, MAIN, bends, heated

from dishmap.rf.antenna import Antenna
from dishmap.rf.correct import best_correction
from dishmap.rf.deformation import displacement
from dishmap.rf.margin import gain_margin
from dishmap.rf.shape_field import ShapeField, TargetValues, deformation_of, response_to_noise, shape_field
from dishmap.targets.builders import dish

ERRORS_MM, MAPS = (0.01, 0.03, 0.1, 0.3, 1.0), 40
ANTENNAS = {"prime focus": Antenna(MAIN, FEED), "Cassegrain": CASSEGRAIN, "Cassegrain, bent": bends(3)}
# The map of which the true shape is taken: far better than any of the errors.
EXACT_MM = 1e-3


def mapped(heat_mm: float, spacing_mm: float) -> ShapeField:
    """The heated dish as targets at this spacing show it."""
    pattern = dish(600.0, 300.0, spacing_mm)
    xy = pattern.center_mm[:, :2]
    n, none = len(xy), np.zeros((len(xy), 0))
    value, _ = displacement(heated(heat_mm), xy)
    return shape_field(TargetValues(pattern.ids, xy, value, none, np.full(n, EXACT_MM**2), np.zeros(n, np.int64), False), MAIN)


def main() -> None:
    rows = []
    for heat in (1.0, 3.0):
        for spacing in (52.0, 45.0):
            field = mapped(heat, spacing)
            shape = deformation_of(field)
            for name, antenna in ANTENNAS.items():
                found = best_correction(antenna, shape, FREQUENCIES_GHZ)
                known = field.terms, [response_to_noise(field, e) for e in ERRORS_MM], field.factor_mm
                margin = gain_margin(antenna, shape, found, *known, ERRORS_MM, np.random.default_rng(1), MAPS)
                for k, frequency in enumerate(FREQUENCIES_GHZ):
                    won = found.after_dbi[k] - found.before_dbi[k]
                    rows.append([heat, len(field.places_mm), name, frequency, won, *np.round(margin.mean_db[:, k], 4)])
                print(f"{heat:g} mm, {len(field.places_mm)} targets, {name}: done", flush=True)
    head = ("heat mm", "targets", "corrected by", "GHz", "won dB", *(f"{e:g} mm" for e in ERRORS_MM))
    print_table(head, rows, "Gain in dB left on the table for errors of each target of")


if __name__ == "__main__":
    main()
