"""What an analysis of gain says, in numbers and in plain sentences: for the top of its report and for the terminal."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dishmap.difference_verdict import TOLD_SIGMAS, with_sigma
from dishmap.rf.analysis import BEAM, CORRECTED, DESIGN, MEASURED, Change, RfAnalysis
from dishmap.rf.goals import Broaden, Mask
from dishmap.rf.shape_field import sigma_at
from dishmap.rf.state import Reading, State
from dishmap.verdict import Fact, Verdict, id_list, number, targets

QUANTITIES = {
    "shape": "the change of shape between two states, without the rigid motion of the dish",
    "displacement": "the displacement between two states, the rigid motion of the dish included",
    "surface": "the surface of one photograph against the nominal paraboloid",
}
WHO = {"shape": "the change of shape", "displacement": "the displacement", "surface": "the shape"}
LIMIT_WORDS = {
    "shift_x": "shift along x",
    "shift_y": "shift along y",
    "shift_z": "shift along z",
    "tilt_x": "tilt about x",
    "tilt_y": "tilt about y",
    "shape_stroke": "stroke of the subreflector's shape",
}
# A share of the aperture's field that is extrapolated is told from here on.
TOLD_SHARE = 0.005
# What targets do on their own is told where it is so many times the map's sigma.
LOUD_OWN = 3.0
# Below this many wavelengths across, rays off a subreflector are a coarse picture.
SMALL_SUB_WAVELENGTHS = 10.0
# A share of the power that a correction makes miss the dish is told from here on, and stands in the report from the second on.
MUCH_LIGHT, LEAST_LIGHT = 0.01, 5e-4
# A mask that is missed by less is kept.
LEAST_MISSED_DB = 0.005
# Of the nodes of the aperture, every so many-th shows the map's sigma well enough.
EVERY = 7
# Beyond this loss in dB a beam is in pieces, and gain alone says little.
BROKEN_DB = 10.0


def rf_verdict(analysis: RfAnalysis) -> Verdict:
    """The headline, the facts and the warnings of an analysis."""
    return Verdict(_headline(analysis), tuple(_facts(analysis)), tuple(_warnings(analysis)))


def gain_of(analysis: RfAnalysis, reading: Reading) -> tuple[float, float]:
    """Gain in dBi of a reading, where the pointing has it count, and its sigma (NaN for the design)."""
    name = analysis.options.counting
    return float(getattr(reading.beam, name)), float("nan") if reading.spread is None else reading.spread.sigma(name)


def loss_of(analysis: RfAnalysis, state: State, place: int) -> tuple[float, float]:
    """What a state loses against the design at the frequency at `place`, in dB, and its sigma."""
    design, _ = gain_of(analysis, analysis.state(DESIGN).readings[place])
    gain, sigma = gain_of(analysis, state.readings[place])
    return design - gain, sigma


def map_sigma_mm(analysis: RfAnalysis) -> float:
    """Sigma of the displacement: root mean square over the aperture, weighed by the illumination."""
    path = analysis.state(MEASURED).readings[0].path
    some = slice(None, None, EVERY)
    weight = path.weight[some]
    return float(np.sqrt((sigma_at(analysis.field, path.xy_mm[some]) ** 2 @ weight) / weight.sum()))


def target_sigma_mm(analysis: RfAnalysis) -> float:
    """Median sigma of the displacement at the targets."""
    return float(np.median(sigma_at(analysis.field, analysis.field.places_mm)))


def what_moves(analysis: RfAnalysis) -> str:
    """`subreflector`, or `feed` at the prime focus."""
    return "feed" if analysis.antenna.subreflector is None else "subreflector"


def highest(analysis: RfAnalysis) -> int:
    """Place of the highest frequency, which suffers most."""
    return int(np.argmax(analysis.options.frequencies_ghz))


def _headline(analysis: RfAnalysis) -> str:
    place = highest(analysis)
    frequency, lost = analysis.options.frequencies_ghz[place], analysis.lost[place]
    costs = f"At {frequency:g} GHz {WHO[analysis.quantity]} costs"
    told = -lost.mean_db >= TOLD_SIGMAS * lost.sigma_db
    text = f"{costs} {_db(lost, -1)}" if told else f"{costs} nothing that the map can tell from zero: {_db(lost, -1)}"
    parts = [text, *(_wins(analysis, name, place) for name in analysis.recovered)]
    return f"{'; '.join(parts)}.{'' if analysis.target_beam is None else f' {beam_words(analysis)}'}"


def beam_words(analysis: RfAnalysis) -> str:
    """What was asked of the beam and what came of it, in one sentence."""
    beam, goal = analysis.target_beam, analysis.options.goal
    assert beam is not None
    at = f"at {beam.frequency_ghz:g} GHz"
    if isinstance(goal, Mask):
        kept = "is kept" if beam.met else f"is missed by {-beam.after_db:.2f} dB at worst"
        before = f"missed by {-beam.before_db:.2f} dB" if beam.before_db < -LEAST_MISSED_DB else "kept as well"
        return f"Target beam {at}: the mask {kept} (before: {before})."
    if isinstance(goal, Broaden):
        bound = f"; no antenna could pass {beam.bound_dbi:.1f} dBi"
        what = f"the lowest gain within {goal.radius_deg:g}° of the boresight"
    else:
        u, v = beam.directions_uv[0]
        bound, what = "", f"the gain towards θ {np.degrees(np.arcsin(np.hypot(u, v))):.2f}°, φ {np.degrees(np.arctan2(v, u)) % 360:.0f}°"
    return f"Target beam {at}: {what} goes from {beam.before_db:.2f} to {beam.after_db:.2f} dBi{bound}."


def light_words(lost_share: float) -> str:
    """What a correction does to the power that meets the dish, in one sentence."""
    if abs(lost_share) < LEAST_LIGHT:
        return "As much power meets the dish as before."
    if lost_share < 0:
        return f"The dish receives {-100 * lost_share:.2g} % more power than before."
    return f"Of the power that met the dish before, {100 * lost_share:.2g} % now misses it; the gain has that in it."


def _wins(analysis: RfAnalysis, name: str, place: int) -> str:
    verb = "moving" if name == CORRECTED else "bending it as well" if CORRECTED in analysis.recovered else "moving and bending"
    what = f" the {what_moves(analysis)}" if verb != "bending it as well" else ""
    if not analysis.corrections[name].improved:
        return f"{verb}{what} wins nothing back"
    return f"{verb}{what} wins back {_db(analysis.recovered[name][place])}"


def _facts(analysis: RfAnalysis) -> list[Fact]:
    facts = []
    for place, frequency in enumerate(analysis.options.frequencies_ghz):
        lost, design = analysis.lost[place], gain_of(analysis, analysis.state(DESIGN).readings[place])[0]
        facts.append(Fact(f"Loss at {frequency:g} GHz", _tile(lost, -1), f"± {number(lost.sigma_db)} dB; design {design:.2f} dBi"))
        for name, changes in analysis.recovered.items():
            won = changes[place]
            what = f"Won back at {frequency:g} GHz, {name}"
            facts.append(Fact(what, _tile(won), f"± {number(won.sigma_db)} dB; 95 % within {won.low_db:.2f} to {won.high_db:.2f} dB"))
    return [*facts, *_surface_facts(analysis)]


def _surface_facts(analysis: RfAnalysis) -> list[Fact]:
    fit, path = analysis.best_fit, analysis.state(MEASURED).readings[0].path
    nominal = analysis.antenna.reflector.focal_length_mm
    away = with_sigma(float(fit.values[5]) - nominal, float(fit.sigma[5]), " mm", sign=True)
    return [
        Fact(
            "Half-path error, rms",
            f"{number(path.weighted_rms_mm)} mm",
            f"illumination-weighted, at the beam's peak; {number(fit.weighted_half_path_rms_mm)} mm from the best-fit paraboloid",
        ),
        Fact("Best-fit focal length", f"{fit.values[5]:.2f} mm", f"{away} from the nominal {nominal:g} mm"),
        Fact(
            "Sigma of the map", f"{number(map_sigma_mm(analysis))} mm", "of the displacement, illumination-weighted rms over the aperture"
        ),
    ]


def _warnings(analysis: RfAnalysis) -> list[str]:
    return [*_map_warnings(analysis), *_beam_warnings(analysis), *_correction_warnings(analysis)]


def _map_warnings(analysis: RfAnalysis) -> Iterator[str]:
    field, share = analysis.field, analysis.extrapolated_share
    if share > TOLD_SHARE:
        yield (
            f"{100 * share:.2g} % of the aperture's field falls on parts farther from any target than their spacing allows: the surface "
            f"there "
            "is extrapolated, with sigmas that grow; the map of sigma shows where."
        )
    if field.own_mm > LOUD_OWN * map_sigma_mm(analysis):
        yield (
            f"Targets move on their own by {number(field.own_mm)} mm rms beyond the smooth surface that was fitted: wrinkles between "
            f"them, if "
            "there are any, are not in the gain."
        )
    if field.left_out:
        yield f"{targets(len(field.left_out))} moved apart from the surface and were left out ({id_list(np.array(field.left_out))})."
    if analysis.quantity == "surface":
        yield (
            "The shape is that of one photograph: an error of the calibration, or of the pattern, looks like a deformation. A difference "
            "of two "
            "photographs has neither."
        )


def _beam_warnings(analysis: RfAnalysis) -> Iterator[str]:
    for state in analysis.states[1:]:
        for place, reading in enumerate(state.readings):
            wraps = float(2 * np.ptp(reading.path.half_path_mm) / reading.wavelength_mm)
            if wraps > 1:
                yield (
                    f"`{state.name}` at {reading.frequency_ghz:g} GHz: path errors span {wraps:.2g} wavelengths, so that phases wrap; "
                    f"they are "
                    "unwrapped by the geometry, but Ruze's estimate means nothing there."
                )
            if state.name != BEAM and loss_of(analysis, state, place)[0] > BROKEN_DB:
                yield (
                    f"`{state.name}` at {reading.frequency_ghz:g} GHz: the beam has broken up; its peak is the strongest of several "
                    f"lobes, and "
                    "direction and width are those of that lobe."
                )


def _correction_warnings(analysis: RfAnalysis) -> Iterator[str]:
    beam = analysis.target_beam
    if beam is not None and beam.limits:
        what = ", ".join(LIMIT_WORDS.get(limit, limit) for limit in beam.limits)
        yield f"`{BEAM}`: the limit is reached of {what}; a longer stroke would come nearer."
    if beam is not None and not beam.converged:
        yield f"`{BEAM}`: the search did not come to rest; there may be a better command."
    for name, found in analysis.corrections.items():
        if found.limits:
            what = ", ".join(LIMIT_WORDS.get(limit, limit) for limit in found.limits)
            yield f"`{name}`: the limit is reached of {what}; a longer stroke would win more."
        if found.lost_share > MUCH_LIGHT:
            yield f"`{name}`: {light_words(found.lost_share)}"
        if not found.converged:
            yield f"`{name}`: the search for the best correction did not come to rest; there may be a better one."
        if not found.improved:
            yield f"`{name}`: no move within the strokes raises the mean gain, so the {what_moves(analysis)} stays where it is."


def _db(change: Change, sense: int = 1) -> str:
    return with_sigma(sense * change.mean_db + 0.0, change.sigma_db, " dB")


def _tile(change: Change, sense: int = 1) -> str:
    value = sense * change.mean_db + 0.0
    return f"{value:.2f} dB" if abs(value) >= 0.1 else f"{value:.3f} dB"
