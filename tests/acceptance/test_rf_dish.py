"""Photographs of a deformed dish by another program in, decibels out: the loss of gain is that of the true shape.

Skipped where the folder of test photographs is not there.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dishmap.compare import compare_states, measure_state
from dishmap.difference.saved import saved_difference
from dishmap.io.camera_file import read_camera
from dishmap.io.images import read_gray
from dishmap.io.pattern_file import read_pattern
from dishmap.io.truth_file import read_truth
from dishmap.rf.analysis import MEASURED, RfOptions, analyse
from dishmap.rf.antenna import Antenna, Feed, Reflector
from dishmap.rf.correct import judged
from dishmap.rf.correction import no_correction
from dishmap.rf.deformation import Deformation
from dishmap.rf.shape_sources import shape_field_of_difference
from dishmap.rf.sources import wavelength_of
from dishmap.surface.zernike import zernike_matrix, zernike_terms
from dishmap.targets.identify import Upright

Array = NDArray[np.float64]

GHZ = 30.0
ANTENNA = Antenna(Reflector(600.0, 300.0), Feed("gaussian", 12.0))
# The renderer's own error of 0.01 px is 0.004 mm of depth here; it comes on top of what is claimed. A loss of 0.6 dB is that of 0.3 mm
# rms, so it changes by 0.016 dB.
RENDERER_DB = 0.016
# One claimed sigma of 95 % intervals, generously: 4 of them are one in 15,000.
SIGMAS = 4.0


def _fitted(places: Array, onto: Array) -> Callable[[Array], Array]:
    """The rigid motion that brings places (N, 3) nearest to others (Kabsch)."""
    a, b = places.mean(axis=0), onto.mean(axis=0)
    u, _, vt = np.linalg.svd((places - a).T @ (onto - b))
    turn = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    return lambda p: (p - a) @ turn.T + b


def test_the_loss_of_gain_is_that_of_the_true_shape(shared_data: Path) -> None:
    folder = shared_data / "dish"
    camera, pattern, truths = read_camera(folder / "camera.yaml"), read_pattern(folder / "pattern.json"), read_truth(folder / "truth.csv")
    before, after = (measure_state(read_gray(folder / name), camera, pattern, Upright()) for name in ("ref.png", "cur_mixed.png"))
    joint = compare_states(before, after, camera, pattern).joint
    assert joint is not None
    field = shape_field_of_difference(saved_difference(joint, pattern), ANTENNA.reflector)
    result = analyse(field, "shape", ANTENNA, RfOptions((GHZ,)))

    # the true motion without the rigid motion that fits it best (Kabsch), along the normal, in the terms that the states are made of
    old, new = (truths[name].center_mm for name in ("ref.png", "cur_mixed.png"))
    to_dish, back = (_fitted(places, pattern.center_mm) for places in (old, new))
    shape = ((back(new) - to_dish(old)) * pattern.normal).sum(axis=1)
    terms = zernike_terms(5)
    coefficients = np.linalg.lstsq(zernike_matrix(terms, *(pattern.center_mm[:, :2] / 300.0).T), shape, rcond=None)[0]
    wavelength = np.array([wavelength_of(ANTENNA, GHZ)])
    bent, flat = (
        judged(ANTENNA, Deformation(terms, c, np.zeros(2), 300.0), no_correction(ANTENNA), wavelength, free=True)[0][0]
        for c in (coefficients, 0 * coefficients)
    )
    lost = result.lost[0]
    assert bent - flat < -0.3
    assert abs(lost.mean_db - (bent - flat)) < SIGMAS * lost.sigma_db + RENDERER_DB
    assert lost.sigma_db < 0.02
    # what the exact sum says and what Ruze makes of the path error agree to a few percent at such a loss
    reading = result.state(MEASURED).readings[0]
    assert abs(reading.path.ruze_db + lost.mean_db) < 0.1 * -lost.mean_db
