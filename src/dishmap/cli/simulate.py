"""`dishmap simulate`: photographs with truth, from a scenario file."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dishmap.cli.options import CAMERA_KEY, PATH, out_folder
from dishmap.cli.terminal import Tell, progress, say
from dishmap.errors import InputError

if TYPE_CHECKING:
    from dishmap.simulate.scenario import Scenario
    from dishmap.simulate.truth import Truth

TRUTH, CAMERA, PATTERN, POSE = "truth.csv", "camera.yaml", "pattern.json", "pose.json"


class Shots(Mapping[str, str | bytes]):
    """The files of a scenario, each made when it is asked for, so that one photograph at a time is in memory; the truth comes last."""

    def __init__(self, scenario: Scenario, tell: Tell) -> None:
        self.scenario, self.tell = scenario, tell
        self.numbers = {f"{state.name}.png": number for number, state in enumerate(scenario.states)}
        self.truths: list[tuple[str, Truth]] = []

    def __iter__(self) -> Iterator[str]:
        return iter([CAMERA, PATTERN, POSE, *self.numbers, TRUTH])

    def __len__(self) -> int:
        return len(self.numbers) + 4

    def __getitem__(self, name: str) -> str | bytes:
        from dishmap.io.camera_file import camera_text
        from dishmap.io.pattern_file import format_pattern
        from dishmap.io.pose_file import format_pose
        from dishmap.io.truth_file import format_truth

        scene = self.scenario.states[0].scene
        if name == CAMERA:
            return camera_text(scene.camera)
        if name == PATTERN:
            return format_pattern(scene.pattern)
        if name == POSE:
            return format_pose(scene.camera_from_dish, CAMERA_KEY)
        if name == TRUTH:
            return format_truth(self.truths)
        return self._photograph(name)

    def _photograph(self, name: str) -> bytes:
        import numpy as np

        from dishmap.io.picture_file import picture_bytes
        from dishmap.simulate.render import simulate

        number = self.numbers[name]
        # the random numbers of `simulate_states`, so that one state can be made without the others
        shot = simulate(self.scenario.states[number].scene, np.random.default_rng([self.scenario.seed, number]))
        self.truths.append((name, shot.truth))
        self.tell(len(self.truths), len(self.numbers))
        return picture_bytes(shot.image)


@click.command("simulate")
@click.argument("scenario", type=PATH)
@out_folder
def simulate_command(scenario: Path, out: Path) -> None:
    """Photograph a simulated surface in each state of a SCENARIO file (TOML), with the truth of every target."""
    from dishmap.io.atomic import output_folder, write_files
    from dishmap.io.scenario_file import read_scenario

    shots = read_scenario(scenario)
    if os.path.realpath(out) == os.path.realpath(scenario.parent):
        raise InputError(f"--out {out} is the scenario's own folder, whose files could be overwritten; give another folder")
    with output_folder(out), progress("photographing") as tell:
        files = Shots(shots, tell)
        write_files(out, files)
    for name, truth in files.truths:
        whole = int((truth.visible_fraction > 0.999).sum())
        moved = float((truth.displacement_mm**2).mean()) ** 0.5
        say(f"{out / name}: {whole} of {len(truth)} targets wholly visible, displacement {moved:.3g} mm rms")
    say(f"truth: {out / TRUTH}")
    first = files.truths[0][0]
    say(f"try: dishmap map {out / first} --camera {out / CAMERA} --pattern {out / PATTERN} --pose-guess {out / POSE} --out {out / 'map'}")
