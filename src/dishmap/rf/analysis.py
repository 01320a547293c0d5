"""The whole of it in one short function: a shape and an antenna in, gain and correction with their uncertainty out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError
from dishmap.rf.antenna import Antenna
from dishmap.rf.best_fit import BestFit, best_fit
from dishmap.rf.correct import POINTINGS, CorrectionFound, best_correction
from dishmap.rf.correction import Correction, no_correction
from dishmap.rf.deformation import undeformed
from dishmap.rf.goals import Goal
from dishmap.rf.margin import Margin, gain_margin
from dishmap.rf.modes import Mode, modes_of
from dishmap.rf.shape_field import ShapeField, deformation_of, draws, extrapolated, response_to_noise
from dishmap.rf.sources import illumination, sampled, sources, wavelength_of
from dishmap.rf.spread import FLOOR_DB
from dishmap.rf.state import Reading, State, antenna_state
from dishmap.rf.target_beam import BeamShaped, target_beam

Array = NDArray[np.float64]
Tell = Callable[[str, int, int], None]

DESIGN, MEASURED, CORRECTED, SHAPED, BEAM = "design", "measured", "corrected", "shaped", "target beam"
MOST_DRAWS = 10_000
# Errors of the map (sigma of each target, mm) at which the gain left on the table is computed, and from how many maps each.
MAP_ERRORS_MM, MARGIN_DRAWS = (0.01, 0.03, 0.1, 0.3, 1.0), 30


@dataclass(frozen=True)
class RfOptions:
    """What to compute.

    frequencies_ghz; correct: also look for the best pose of the subreflector or feed (and its best shape, where it can change it);
    pointing: `free` (the antenna is pointed anew, gain counts at the beam's peak) or `fixed` (at the boresight); goal: a beam to make with
    the same actuators, or None; draws, seed: surfaces drawn from the map for uncertainties. Raises InputError for impossible values.
    """

    frequencies_ghz: tuple[float, ...]
    correct: bool = False
    pointing: str = "free"
    goal: Goal | None = None
    draws: int = 200
    seed: int = 1

    def __post_init__(self) -> None:
        if not self.frequencies_ghz:
            raise InputError("at least one frequency in GHz is needed")
        if self.pointing not in POINTINGS:
            raise InputError(f"unknown pointing {self.pointing!r}; use one of {', '.join(POINTINGS)}")
        if not 2 <= self.draws <= MOST_DRAWS:
            raise InputError(f"the number of draws must lie between 2 and {MOST_DRAWS}, not {self.draws}")

    @property
    def counting(self) -> str:
        """The gain of a beam that counts with this pointing: `gain_dbi` at its peak, or `boresight_dbi`."""
        return "gain_dbi" if self.pointing == "free" else "boresight_dbi"


@dataclass(frozen=True)
class Change:
    """Gain of one state over another at one frequency in dB: at the mean surface, with sigma and the middle 95 % over the map's draws."""

    mean_db: float
    sigma_db: float
    low_db: float
    high_db: float


@dataclass(frozen=True)
class RfAnalysis:
    """What a shape does to an antenna.

    quantity: what the field is of (`shape`: without rigid motion, `displacement`: with it, `surface`: of one photograph); states: `design`,
    `measured`, then `corrected` (a rigid pose), `shaped` (pose and shape) and `target beam`, as asked for; modes: state -> rows for each
    frequency; corrections: state -> how it was found; lost: measured over design, recovered: state -> corrected over measured, for each
    frequency; margins: state -> gain that map errors leave on the table; target_beam: at the highest frequency; extrapolated_share: of the
    aperture's field, where the map says little.
    """

    antenna: Antenna
    field: ShapeField
    quantity: str
    options: RfOptions
    best_fit: BestFit
    states: tuple[State, ...]
    modes: Mapping[str, tuple[tuple[Mode, ...], ...]]
    corrections: Mapping[str, CorrectionFound]
    lost: tuple[Change, ...]
    recovered: Mapping[str, tuple[Change, ...]]
    margins: Mapping[str, Margin]
    target_beam: BeamShaped | None
    extrapolated_share: float

    def state(self, name: str) -> State:
        """A state by its name. Raises KeyError when it was not asked for."""
        return next(state for state in self.states if state.name == name)


def analyse(field: ShapeField, quantity: str, antenna: Antenna, options: RfOptions, progress: Tell | None = None) -> RfAnalysis:
    """Gain, beam and correction of an antenna with a measured shape; progress(step, done, of all).

    Raises InputError for frequencies that are too low or impossible goals, FitError when there is no main beam near the boresight.
    """
    run = _Run(field, antenna, options, progress or (lambda what, done, total: None))
    return run.all(quantity)


class _Run:
    """The parts of one analysis that its steps share."""

    def __init__(self, field: ShapeField, antenna: Antenna, options: RfOptions, tell: Tell) -> None:
        for frequency in options.frequencies_ghz:
            wavelength_of(antenna, frequency)
        self.field, self.antenna, self.options, self.tell = field, antenna, options, tell
        self.shape = deformation_of(field)
        self.drawn = draws(field, np.random.default_rng(options.seed), options.draws)
        self.bends = bool(antenna.actuators.shape_degree)
        self.steps = 3 + 3 * (1 + self.bends) * options.correct + (options.goal is not None)
        self.done = 0

    def step(self, what: str) -> None:
        self.tell(what, self.done, self.steps)
        self.done += 1

    def all(self, quantity: str) -> RfAnalysis:
        self.step("the antenna as designed")
        states = [antenna_state(DESIGN, self.antenna, undeformed(self.antenna.reflector), self.still, self.options.frequencies_ghz)]
        self.step("the antenna as measured")
        states.append(self.made(MEASURED, self.still))
        corrections: dict[str, CorrectionFound] = {}
        for name, bend in ((CORRECTED, False), (SHAPED, True))[: 1 + self.bends] if self.options.correct else ():
            self.step("best pose and shape" if bend else "best pose")
            corrections[name] = best_correction(self.antenna, self.shape, self.options.frequencies_ghz, self.options.pointing, bend)
            self.step("the antenna as corrected")
            states.append(self.made(name, corrections[name].correction))
        target = self.shaped_beam(states)
        margins = {name: self.margin(found) for name, found in corrections.items()}
        self.step("modes")
        by_name = {state.name: state for state in states}
        fit, share = self.fitted()
        self.tell("done", self.steps, self.steps)
        return RfAnalysis(
            antenna=self.antenna,
            field=self.field,
            quantity=quantity,
            options=self.options,
            best_fit=fit,
            states=tuple(states),
            modes={name: tuple(self.modes(r) for r in s.readings) for name, s in by_name.items() if name != DESIGN},
            corrections=corrections,
            lost=self.changes(by_name[MEASURED], by_name[DESIGN]),
            recovered={name: self.changes(by_name[name], by_name[MEASURED]) for name in corrections},
            margins=margins,
            target_beam=target,
            extrapolated_share=share,
        )

    @property
    def still(self) -> Correction:
        return no_correction(self.antenna)

    def shaped_beam(self, states: list[State]) -> BeamShaped | None:
        """The beam that was asked for; its state joins the others."""
        if self.options.goal is None:
            return None
        self.step("target beam")
        found = target_beam(self.antenna, self.shape, max(self.options.frequencies_ghz), self.options.goal)
        states.append(self.made(BEAM, found.correction))
        return found

    def margin(self, found: CorrectionFound) -> Margin:
        self.step("how good the map must be")
        rng = np.random.default_rng(self.options.seed)
        terms, factor = self.field.terms, self.field.factor_mm
        responses = [response_to_noise(self.field, sigma) for sigma in MAP_ERRORS_MM]
        return gain_margin(self.antenna, self.shape, found, terms, responses, factor, MAP_ERRORS_MM, rng, MARGIN_DRAWS)

    def modes(self, reading: Reading) -> tuple[Mode, ...]:
        path, main = reading.path, self.antenna.reflector
        return modes_of((path.xy_mm - main.center_mm) / (main.diameter_mm / 2), path.half_path_mm, path.weight, reading.wavelength_mm)

    def made(self, name: str, correction: Correction) -> State:
        return antenna_state(name, self.antenna, self.shape, correction, self.options.frequencies_ghz, self.drawn)

    def changes(self, after: State, before: State) -> tuple[Change, ...]:
        return tuple(self.change(a, b) for a, b in zip(after.readings, before.readings, strict=True))

    def change(self, after: Reading, before: Reading) -> Change:
        """Gain of one reading over another, drawn surface by drawn surface; the design has no spread."""
        name = self.options.counting
        assert after.spread is not None
        drawn = after.spread.of(name) - (getattr(before.beam, name) if before.spread is None else before.spread.of(name))
        low, high = np.percentile(drawn, [2.5, 97.5])
        sigma = float(np.hypot(drawn.std(), FLOOR_DB))
        return Change(getattr(after.beam, name) - getattr(before.beam, name), sigma, float(low) - FLOOR_DB, float(high) + FLOOR_DB)

    def fitted(self) -> tuple[BestFit, float]:
        """The best-fit paraboloid, and the share of the aperture's field where the map is extrapolated."""
        wavelength = wavelength_of(self.antenna, max(self.options.frequencies_ghz))
        currents = sources(self.antenna, self.shape, self.still, sampled(self.antenna, self.shape, wavelength))
        fit = best_fit(self.antenna, self.shape, currents, self.field.factor_mm)
        lit = slice(0, currents.nodes.lit)
        weight = illumination(currents)
        outside = extrapolated(self.field, currents.nodes.xy_mm[lit])
        return fit, float(weight[outside].sum() / weight.sum())
