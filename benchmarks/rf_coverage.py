"""Are the sigmas of gain, beam and path error true? Deformed dishes measured as photographs would show them, without photographs.

    scripts/bench rf_coverage [--quick]

Dishes, deformations and measurements are those of `difference_coverage`: 0.6 m, f/D 0.5, six families of deformations, 0.06 to 1.6 times
as large, cameras at 350, 600 and 1000 mm. The joint difference of each becomes a shape field, and that the gain, direction, widths and
path error at 12.5 and 30 GHz with their 95 % intervals, from 200 surfaces drawn from the map. The truth is the same computation with
the true shape (its rigid motion taken out at the targets, as the difference does it, in Zernike terms of degree 28). Coverage is the share
of intervals that hold the truth; its +- is binomial. A dish that did not move is no draw of any field: its losses are as small as can be.
"""

from __future__ import annotations

import os

# one core, whatever the machine has; before numpy is loaded
os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from _common import QUICK, print_table, rms
from difference_coverage import FAMILIES, POWERS, Bench, benches, measured, printed, scaled, shifted
from numpy.random import Generator
from numpy.typing import NDArray

from dishmap.difference.changes import kabsch
from dishmap.difference.difference_map import joint_difference
from dishmap.difference.saved import saved_difference
from dishmap.rf.antenna import Antenna, Feed, Reflector
from dishmap.rf.beam import main_beam
from dishmap.rf.correction import no_correction
from dishmap.rf.deformation import Deformation
from dishmap.rf.gain import path_error
from dishmap.rf.shape_field import deformation_of, draws
from dishmap.rf.shape_sources import shape_field_of_difference
from dishmap.rf.sources import sampled, sources, wavelength_of
from dishmap.rf.spread import Spread, spread
from dishmap.simulate.deform import Deformation as State
from dishmap.simulate.deform import deform
from dishmap.surface.zernike import zernike_matrix, zernike_terms
from dishmap.transforms import Pose

Array = NDArray[Any]

DISHES = 1 if QUICK else 8
FREQUENCIES_GHZ = (12.5, 30.0)
DRAWS = 200
ANTENNA = Antenna(Reflector(600.0, 300.0), Feed("aperture", 12.0))
# The truth in Zernike terms, from so many places on the dish.
TRUE_DEGREE, PLACES = 28, 6000
FIGURES = ("gain_dbi", "boresight_dbi", "u", "v", "width_0_deg", "width_90_deg", "sidelobe_0_db", "sidelobe_90_db", "weighted_rms_mm")


def true_shape(at: Bench, state: State, later: Pose) -> Deformation:
    """The shape as a difference has it: what the targets seem to do together, by the camera that shifted too, taken out."""

    def seen(places: Array) -> Array:
        return at.pose.inverse().apply(later.apply(deform(state, surface, places, at.rim_mm)))

    points, surface = at.pattern.center_mm, at.pattern.surface
    back = kabsch(seen(points), points)
    k = np.arange(PLACES) + 0.5
    r, phi = 300.0 * np.sqrt(k / PLACES), np.pi * (1 + np.sqrt(5)) * k
    xy = np.column_stack([r * np.cos(phi), r * np.sin(phi)])
    nominal = np.column_stack([xy, (xy**2).sum(axis=1) / (4 * ANTENNA.reflector.focal_length_mm)])
    value = ((back.apply(seen(nominal)) - nominal) * surface.normal(xy)).sum(axis=1)
    terms = zernike_terms(TRUE_DEGREE)
    coefficients = np.linalg.lstsq(zernike_matrix(terms, *(xy / 300.0).T), value, rcond=None)[0]
    return Deformation(terms, coefficients, np.zeros(2), 300.0)


def figures(shape: Deformation, frequency_ghz: float, drawn_mm: Array | None = None) -> tuple[dict[str, float], Spread | None]:
    """The figures of one shape, and those of surfaces drawn about it."""
    wavelength, diameter, wanted = wavelength_of(ANTENNA, frequency_ghz), ANTENNA.reflector.diameter_mm, ANTENNA.feed.polarization
    currents = sources(ANTENNA, shape, no_correction(ANTENNA), sampled(ANTENNA, shape, wavelength))
    beam = main_beam(currents, wavelength, diameter, wanted)
    path = path_error(currents, wavelength, beam.u, beam.v)
    values = (beam.gain_dbi, beam.boresight_dbi, beam.u, beam.v, *beam.width_deg, *beam.sidelobe_db, path.weighted_rms_mm)
    some = None if drawn_mm is None else spread(currents, shape, drawn_mm, beam, wavelength, diameter, wanted)
    return dict(zip(FIGURES, values, strict=True)), some


@dataclass(frozen=True)
class Trial:
    """One figure of one dish at one frequency: what it is, its error and claimed sigma, and whether the interval held it."""

    family: str
    camera: str
    frequency_ghz: float
    figure: str
    error: float
    sigma: float
    inside: bool


def trials_of(at: Bench, family: str, rng: Generator) -> list[Trial]:
    state = scaled(FAMILIES[family](rng), 10 ** float(rng.uniform(*POWERS)), "least_strain")
    ink, later = printed(at, rng), shifted(at.pose, rng)
    found = joint_difference(measured(at, ink, State(), at.pose, rng), measured(at, ink, state, later, rng), at.camera, at.pattern)
    field = shape_field_of_difference(saved_difference(found, at.pattern), ANTENNA.reflector)
    mean, drawn = deformation_of(field), draws(field, rng, DRAWS)
    shape = true_shape(at, state, later)
    out = []
    for frequency in FREQUENCIES_GHZ:
        claimed, some = figures(mean, frequency, drawn)
        assert some is not None
        for name, value in figures(shape, frequency)[0].items():
            low, high = some.interval(name)
            out.append(Trial(family, at.name, frequency, name, claimed[name] - value, some.sigma(name), low <= value <= high))
    return out


def row(trials: Sequence[Trial]) -> tuple[object, ...]:
    share = float(np.mean([t.inside for t in trials]))
    by = 100 * np.sqrt(max(share * (1 - share), 0.25 / len(trials)) / len(trials))
    error, sigma = rms(np.array([t.error for t in trials])), rms(np.array([t.sigma for t in trials]))
    score = np.array([t.error / t.sigma for t in trials if t.sigma > 0])
    return len(trials), error, sigma, float(np.median(score)), rms(score), round(100 * share, 1), round(float(by), 1)


def main() -> None:
    every = []
    for f, family in enumerate(FAMILIES):
        for b, at in enumerate(benches()):
            for seed in range(DISHES):
                every += trials_of(at, family, np.random.default_rng([30, f, b, seed]))
    header = ("of", "figures", "rms error", "rms sigma", "median z", "rms z", "in 95 %", "+-")
    kinds = [*dict.fromkeys(t.figure for t in every)]
    print_table(header, [(name, *row([t for t in every if t.figure == name])) for name in kinds], "Each figure, both frequencies")
    moved = [t for t in every if t.family != "none"]
    print_table(header, [(name, *row([t for t in moved if t.figure == name])) for name in kinds], "Of dishes that moved")
    gains = [t for t in every if t.figure == "gain_dbi"]
    for what in ("frequency_ghz", "family", "camera"):
        groups = [*dict.fromkeys(getattr(t, what) for t in gains)]
        rows = [(value, *row([t for t in gains if getattr(t, what) == value])) for value in groups]
        print_table(header, rows, f"Gain at the peak in dB, by {what}")


if __name__ == "__main__":
    main()
