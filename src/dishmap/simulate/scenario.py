"""Several photographs of one thing: a surface in named states, with one seed for all."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dishmap.errors import InputError
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene
from dishmap.simulate.truth import Simulation


@dataclass(frozen=True)
class State:
    """A named photograph to be made."""

    name: str
    scene: Scene


@dataclass(frozen=True)
class Scenario:
    """Named photographs and the seed of their noise. Raises InputError when there are none, or names repeat."""

    name: str
    seed: int
    states: tuple[State, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "states", tuple(self.states))
        names = [state.name for state in self.states]
        if not names:
            raise InputError("a scenario needs at least one state")
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(f"the state {twice[0]!r} is given twice; names of states must differ")
        if self.seed < 0:
            raise InputError(f"a seed must be zero or more, not {self.seed}")


def simulate_states(scenario: Scenario) -> Iterator[tuple[str, Simulation]]:
    """Photograph each state in turn: its name, image and truth.

    The noise of a state depends on the seed and on its place in the list only, so that each can be made alone.
    """
    for number, state in enumerate(scenario.states):
        yield state.name, simulate(state.scene, np.random.default_rng([scenario.seed, number]))
