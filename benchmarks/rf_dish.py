"""From photographs to gain: data/dish (rendered by another program), each deformed state against the undeformed one.

    scripts/bench rf_dish [--quick]

Gain at 12.5 and 30 GHz of a 0.6 m Cassegrain antenna with the shape that two photographs show, and what a moved and a bent subreflector win
back, each beside the same computed from the renderer's true displacements (their rigid motion taken out; the states are Zernike terms up
to degree 5). "Left" is the gain that the correction made from the photographs leaves on the table on the true dish, against the one made
from the truth.
"""

from __future__ import annotations

import os

# one core, whatever the machine has; before numpy is loaded
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from _common import QUICK, data_folder, print_table
from difference import true_change, true_pose
from numpy.typing import NDArray

from dishmap.compare import compare_states, measure_state
from dishmap.difference.saved import saved_difference
from dishmap.io.camera_file import read_camera
from dishmap.io.images import read_gray
from dishmap.io.pattern_file import read_pattern
from dishmap.io.truth_file import read_truth
from dishmap.rf.analysis import CORRECTED, DESIGN, MEASURED, SHAPED, RfOptions, analyse
from dishmap.rf.antenna import Actuators, Antenna, Feed, Reflector, Subreflector
from dishmap.rf.correct import best_correction, judged
from dishmap.rf.correction import Correction, no_correction
from dishmap.rf.deformation import Deformation
from dishmap.rf.shape_sources import shape_field_of_difference
from dishmap.rf.sources import wavelength_of
from dishmap.surface.zernike import zernike_matrix, zernike_terms
from dishmap.targets.identify import Upright

Array = NDArray[np.float64]

FREQUENCIES_GHZ = (12.5, 30.0)
ANTENNA = Antenna(
    Reflector(600.0, 300.0),
    Feed("gaussian", 12.0),
    Subreflector("cassegrain", 220.0, 4.0),
    actuators=Actuators((10.0, 10.0, 10.0), (5.0, 5.0), shape_degree=5, shape_stroke_mm=5.0),
)
TRUE_DEGREE = 5


def true_shape(xy_mm: Array, shape_mm: Array) -> Deformation:
    """Zernike terms of true displacements (N,) of targets at (N, 2)."""
    terms = zernike_terms(TRUE_DEGREE)
    matrix = zernike_matrix(terms, *(xy_mm / 300.0).T)
    return Deformation(terms, np.linalg.lstsq(matrix, shape_mm, rcond=None)[0], np.zeros(2), 300.0)


def gains(shape: Deformation, correction: Correction) -> Array:
    """Gain at the peak (F,) in dBi."""
    return judged(ANTENNA, shape, correction, np.array([wavelength_of(ANTENNA, f) for f in FREQUENCIES_GHZ]), free=True)[0]


def main() -> None:
    folder = data_folder("dish")
    if folder is None:
        return
    camera, pattern, truths = read_camera(folder / "camera.yaml"), read_pattern(folder / "pattern.json"), read_truth(folder / "truth.csv")
    pose = true_pose(truths["ref.png"], pattern)
    before = measure_state(read_gray(folder / "ref.png"), camera, pattern, Upright())
    names = [name for name in truths if name != "ref.png"]
    lost, won = [], []
    for name in names[-2:] if QUICK else names:
        found = compare_states(before, measure_state(read_gray(folder / name), camera, pattern, Upright()), camera, pattern)
        assert found.joint is not None
        field = shape_field_of_difference(saved_difference(found.joint, pattern), ANTENNA.reflector)
        result = analyse(field, "shape", ANTENNA, RfOptions(FREQUENCIES_GHZ, correct=True))
        moved = true_change(truths["ref.png"], truths[name], pattern, pose)
        truth = true_shape(pattern.center_mm[:, :2], moved.shape_mm(np.arange(len(pattern))))
        design, bent = gains(Deformation((), np.zeros(0), np.zeros(2), 300.0), no_correction(ANTENNA)), gains(truth, no_correction(ANTENNA))
        for k, reading in enumerate(result.state(MEASURED).readings):
            change, ideal = result.lost[k], result.state(DESIGN).readings[k].beam.gain_dbi
            ruze = reading.path.ruze_db
            lost.append([name, FREQUENCIES_GHZ[k], design[k] - bent[k], ideal - reading.beam.gain_dbi, change.sigma_db, ruze])
        for state in (CORRECTED, SHAPED):
            ours = gains(truth, result.corrections[state].correction)
            best = gains(truth, best_correction(ANTENNA, truth, FREQUENCIES_GHZ, shape=state == SHAPED).correction)
            for k, change in enumerate(result.recovered[state]):
                won.append(
                    [
                        name,
                        state,
                        FREQUENCIES_GHZ[k],
                        ours[k] - bent[k],
                        change.mean_db,
                        change.sigma_db,
                        design[k] - ours[k],
                        best[k] - ours[k],
                    ]
                )
    head = ("state", "GHz", "true loss dB", "found", "sigma", "Ruze")
    print_table(head, lost, "Loss of gain through the shape")
    head = ("state", "correction", "GHz", "truly won back dB", "found", "sigma", "still lost", "left")
    print_table(head, won, "Gain won back by the subreflector")


if __name__ == "__main__":
    main()
