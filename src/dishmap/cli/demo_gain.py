"""The second half of `dishmap demo`: the dish deforms, is photographed again, and what that costs in gain is set beside the truth."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from dishmap.cli.difference_outcome import brief, outcome_files
from dishmap.cli.rf import leave, print_analysis
from dishmap.cli.terminal import progress, say, table

if TYPE_CHECKING:
    from dishmap.compare import Difference
    from dishmap.pipeline import Map
    from dishmap.rf.analysis import RfAnalysis
    from dishmap.rf.antenna import Antenna
    from dishmap.rf.correction import Correction
    from dishmap.rf.deformation import Deformation
    from dishmap.simulate.scene import Scene

ANTENNA, CHANGE, GAIN = "antenna.toml", "change", "gain"
FREQUENCIES_GHZ = (12.5, 30.0)
# The true shape in Zernike terms, as fine as its gores, from so many places on the dish.
TRUE_DEGREE, PLACES = 24, 4000


def deformed(scene: Scene) -> Scene:
    """The same dish later: out of focus, a saddle, sagging between eight ribs, and moved by a tenth of a millimetre."""
    import numpy as np

    from dishmap.simulate.deform import Deformation, Gores, ZernikeTerm
    from dishmap.transforms import Pose

    state = Deformation(
        zernike=(ZernikeTerm(2, 0, 0.7), ZernikeTerm(2, 2, 0.4), ZernikeTerm(3, 1, -0.3)),
        gores=(Gores(8, 0.6),),
        slide="least_strain",
        motion=Pose.from_rotation_vector(np.radians([0.02, -0.01, 0.0]), [0.05, 0.1, -0.1]),
    )
    return replace(scene, deformation=state)


def demo_antenna() -> Antenna:
    """A Cassegrain antenna around the dish of the demo, as the one in `examples`."""
    from dishmap.rf.antenna import Actuators, Antenna, Feed, Reflector, Subreflector

    return Antenna(
        Reflector(600.0, 300.0),
        Feed("gaussian", 12.0, polarization="right"),
        Subreflector("cassegrain", 220.0, 4.0),
        actuators=Actuators((5.0, 5.0, 8.0), (3.0, 3.0)),
    )


def compared(reference: Map, photograph: Path, inputs: dict[str, Path], out: Path) -> Difference:
    """The difference of the later photograph to the reference, as `dishmap diff` has it, with its files in a folder."""
    from dishmap.compare import State, compare_states, measure_state
    from dishmap.io.atomic import output_folder
    from dishmap.io.difference_results import DifferenceProvenance, write_difference
    from dishmap.io.images import read_gray
    from dishmap.targets.pose import TargetPoses

    begin = time.perf_counter()
    assert isinstance(reference.poses, TargetPoses)
    with progress("comparing") as tell:
        after = measure_state(read_gray(photograph), reference.camera, reference.pattern, progress=tell)
    result = compare_states(State(reference.poses), after, reference.camera, reference.pattern)
    provenance = DifferenceProvenance({**inputs, "current": photograph}, seconds={"compare": time.perf_counter() - begin})
    with output_folder(out):
        write_difference(out, outcome_files(result, "demo: the dish has deformed", provenance))
    return result


def gain(change: Path, antenna_file: Path, out: Path) -> RfAnalysis:
    """What the change costs in gain and what a correction wins back, as `dishmap rf --correct` has it, with its files in a folder."""
    from dishmap.io.antenna_file import read_antenna
    from dishmap.io.atomic import output_folder
    from dishmap.io.shape_input import read_shape_field, shape_file
    from dishmap.rf.analysis import RfOptions, analyse

    begin, antenna = time.perf_counter(), read_antenna(antenna_file)
    field = read_shape_field(change, antenna.reflector)
    with progress("from shape to gain") as tell:
        analysis = analyse(field, "shape", antenna, RfOptions(FREQUENCIES_GHZ, correct=True), lambda what, done, of: tell(done, of))
    inputs = {"shape": shape_file(change), "antenna": antenna_file}
    with output_folder(out):
        leave(analysis, inputs, {"analyse": time.perf_counter() - begin}, "demo: what the deformed dish costs in gain", out)
    return analysis


def show_gain(reference: Map, scene: Scene, photograph: Path, inputs: dict[str, Path], out: Path) -> None:
    """Compare, work out the gain, and print both beside the truth; scene: of the later photograph."""
    result = compared(reference, photograph, inputs, out / CHANGE)
    say(f"{photograph}: {brief(result)}")
    say()
    analysis = gain(out / CHANGE, out / ANTENNA, out / GAIN)
    print_analysis(analysis, "in the antenna", out / GAIN)
    say()
    say(against_truth(analysis, true_shape(scene)))


def true_shape(scene: Scene) -> Deformation:
    """The true change of shape of a simulated dish: what all targets do together taken out, as a difference has it."""
    import numpy as np

    from dishmap.difference.changes import kabsch
    from dishmap.rf.aperture import spread_evenly
    from dishmap.rf.deformation import Deformation
    from dishmap.simulate.deform import deform
    from dishmap.surface.zernike import zernike_matrix, zernike_terms

    pattern, surface = scene.pattern, scene.pattern.surface
    assert surface.focal_length_mm is not None
    assert surface.diameter_mm is not None
    radius = surface.diameter_mm / 2
    targets = pattern.center_mm
    moved = kabsch(targets, deform(scene.deformation, surface, targets, radius))
    xy = spread_evenly(PLACES, np.zeros(2), radius)
    nominal = np.column_stack([xy, (xy**2).sum(axis=1) / (4 * surface.focal_length_mm)])
    seen = moved.inverse().apply(deform(scene.deformation, surface, nominal, radius))
    terms = zernike_terms(TRUE_DEGREE)
    value = ((seen - nominal) * surface.normal(xy)).sum(axis=1)
    sizes = np.linalg.lstsq(zernike_matrix(terms, *(xy / radius).T), value, rcond=None)[0]
    return Deformation(terms, sizes, np.zeros(2), radius)


def against_truth(analysis: RfAnalysis, truth: Deformation) -> str:
    """A table of what was claimed beside what is true of the simulated dish, with the correction that was found."""
    from dishmap.difference_verdict import with_sigma
    from dishmap.rf.correction import no_correction

    still, found = no_correction(analysis.antenna), analysis.corrections["corrected"].correction
    rows = []
    for place, frequency in enumerate(analysis.options.frequencies_ghz):
        design = analysis.states[0].readings[place].beam.gain_dbi
        before, after = (true_gain_dbi(analysis.antenna, truth, moved, frequency) for moved in (still, found))
        lost, won = analysis.lost[place], analysis.recovered["corrected"][place]
        rows.append([f"lost at {frequency:g} GHz, dB", with_sigma(-lost.mean_db, lost.sigma_db, ""), f"{design - before:.3f}"])
        rows.append([f"won back at {frequency:g} GHz, dB", with_sigma(won.mean_db, won.sigma_db, ""), f"{after - before:.3f}"])
    return "against the truth (gain with the true shape):\n" + table(["", "claimed", "true"], rows)


def true_gain_dbi(antenna: Antenna, shape: Deformation, moved: Correction, frequency_ghz: float) -> float:
    """Gain at the beam's peak of an antenna with this shape and correction."""
    from dishmap.rf.beam import main_beam
    from dishmap.rf.sources import sampled, sources, wavelength_of

    wavelength = wavelength_of(antenna, frequency_ghz)
    currents = sources(antenna, shape, moved, sampled(antenna, shape, wavelength))
    return main_beam(currents, wavelength, antenna.reflector.diameter_mm, antenna.feed.polarization).gain_dbi
