"""`dishmap diff`: what changed between a reference and later photographs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dishmap.cli.difference_outcome import REPORT, brief, outcome_files, print_difference
from dishmap.cli.options import PATH, camera_option, hint_for, hint_of, hint_options, out_folder
from dishmap.cli.prior_options import prior_options, priors_of
from dishmap.cli.terminal import progress, say
from dishmap.errors import DishmapError, InputError, MeasurementError

if TYPE_CHECKING:
    from dishmap.camera.model import Camera
    from dishmap.compare import Difference, State
    from dishmap.difference.priors import Priors
    from dishmap.surface.fit import Basis
    from dishmap.targets.identify import Hint
    from dishmap.targets.pattern import Pattern

Tell = Callable[[int, int], None]
# Parts of the progress bar for each photograph measured and each pair compared.
STEPS = 100


@dataclass(frozen=True)
class Job:
    """One state to compare with the reference: its name, its photographs, and the folder of its results."""

    name: str
    photographs: tuple[Path, ...]
    folder: Path


@dataclass(frozen=True)
class Setup:
    """What all comparisons of a run share."""

    camera: Camera
    pattern: Pattern
    hint: Hint
    priors: Priors
    method: str
    surface: Basis | None
    inputs: dict[str, Path]


@dataclass(frozen=True)
class Reference:
    """The measured reference: its state, its files, and digests of the photographs it was measured in."""

    state: State
    files: tuple[Path, ...]
    digests: tuple[str, ...]


class Bar:
    """The progress of a run: every photograph measured and every pair compared is one step of `total`."""

    def __init__(self, tell: Tell, total: int) -> None:
        self.tell, self.total, self.done = tell, total, 0

    def step(self) -> Tell:
        """Begin the next step: a function that tells how far it is."""
        begin, self.done = self.done, self.done + 1
        return lambda part, whole: self.tell(round(STEPS * (begin + part / max(whole, 1))), STEPS * self.total)


@click.command("diff")
@click.argument("reference", type=PATH)
@click.argument("current", type=PATH, nargs=-1, required=True)
@camera_option
@click.option("--pattern", "pattern_file", type=PATH, required=True, help="Pattern file (JSON).")
@out_folder
@hint_options
@click.option(
    "--method",
    type=click.Choice(["joint", "paper", "all"]),
    default="joint",
    show_default=True,
    help="One estimate of all that may have moved, the paper's Algorithm 3, or both side by side.",
)
@click.option("--surface", metavar="BASIS", help="plane, polynomial:DEGREE or zernike:DEGREE.  [default: up to degree 4]")
@click.option("--reference-frame", type=PATH, metavar="FILE", multiple=True, help="A further photograph of the reference; may be repeated.")
@click.option("--same-state", is_flag=True, help="The current photographs show one state, and are averaged.")
@prior_options
def diff_command(
    reference: Path,
    current: tuple[Path, ...],
    camera_file: Path,
    pattern_file: Path,
    out: Path,
    pose_guess: Path | None,
    upright: bool,
    anchors: tuple[tuple[int, float, float], ...],
    method: str,
    surface: str | None,
    reference_frame: tuple[Path, ...],
    same_state: bool,
    **given: Any,
) -> None:
    """What changed between REFERENCE and each CURRENT photograph, by one camera that stayed where it was.

    REFERENCE is a photograph, or the measurement.npz that `dishmap map` wrote of one. Several CURRENT photographs are several
    states, each with its own folder in DIR, unless --same-state says that they show one.
    """
    from dishmap.compare import check_method
    from dishmap.io.atomic import output_folder
    from dishmap.io.camera_file import read_camera
    from dishmap.io.pattern_file import read_pattern
    from dishmap.surface.fit import parse_basis

    priors = priors_of(method, **given)
    hint = hint_of(pose_guess, upright, anchors)
    basis = None if surface is None else parse_basis(surface)
    check_method(method, basis)
    jobs = jobs_of(current, out, same_state)
    before = (reference, *reference_frame)
    check_files(before, jobs)
    inputs = {"camera": camera_file, "pattern": pattern_file}
    inputs |= {} if pose_guess is None else {"pose_guess": pose_guess}
    setup = Setup(read_camera(camera_file), read_pattern(pattern_file), hint, priors, method, basis, inputs)
    with output_folder(out):
        run(setup, before, jobs, out)


def jobs_of(current: tuple[Path, ...], out: Path, same_state: bool) -> list[Job]:
    """The states to compare. Raises InputError when two would have the same folder, or --same-state has one photograph."""
    if same_state:
        if len(current) < 2:
            raise InputError("--same-state averages several photographs of one state, and only one was given; give more, or leave it out")
        return [Job(current[0].stem, current, out)]
    if len(current) == 1:
        return [Job(current[0].stem, current, out)]
    stems = [path.stem for path in current]
    twice = sorted({stem for stem in stems if stems.count(stem) > 1})
    if twice:
        raise InputError(
            f"two current photographs are called {twice[0]!r}, and their results would go to one folder; rename one, "
            "or say --same-state if they show one state"
        )
    return [Job(path.stem, (path,), out / path.stem) for path in current]


def check_files(reference: tuple[Path, ...], jobs: list[Job]) -> None:
    """Refuse before long work what cannot be right: files that are missing, one frame given twice, a measurement as a photograph."""
    from dishmap.io.measurement_file import is_measurement
    from dishmap.io.results import sha256_of

    for photographs in (reference, *(job.photographs for job in jobs)):
        digests: dict[str, Path] = {}
        for path in photographs:
            if not path.exists():
                raise InputError(f"cannot read {path}: there is no such file; check the name")
            if not path.is_file():
                raise InputError(f"cannot read {path}: it is not a file; name a photograph")
            digest = sha256_of(path) if len(photographs) > 1 else ""
            if digest in digests:
                raise InputError(
                    f"{digests[digest]} and {path} are the same photograph, whose noise would count as that of two; give different ones"
                )
            digests[digest] = path
            if photographs is not reference and is_measurement(path):
                raise InputError(f"{path} is no photograph; a saved measurement can only be the REFERENCE, so give the photograph")


def run(setup: Setup, before: tuple[Path, ...], jobs: list[Job], out: Path) -> None:
    """Measure the reference once, compare every state with it, write and print. Raises MeasurementError when some states failed."""
    from dishmap.io.atomic import write_files
    from dishmap.io.difference_results import STATES_FILE, failed_row, format_states

    rows: list[dict[str, Any]] = []
    told: list[str] = []
    failed: list[str] = []
    total = len(before) + sum(len(job.photographs) + 1 for job in jobs)
    with progress("comparing") as tell:
        bar = Bar(tell, total)
        reference = measure_reference(setup, before, bar)
        for job in jobs:
            end = bar.done + len(job.photographs) + 1
            try:
                result, seconds = compare(setup, reference, job, bar)
            except DishmapError as error:
                if len(jobs) == 1:
                    raise
                failed.append(str(error))
                rows.append(failed_row(job.name, job.photographs, setup.method, str(error)))
                bar.done = end
                continue
            rows.append(leave(setup, reference, job, result, seconds, alone=len(jobs) == 1))
            told.append(f"{job.name}: {brief(result)}")
    if not told:
        raise MeasurementError(f"none of the {len(jobs)} states could be compared; the first: {failed[0]}")
    if len(jobs) == 1:
        print_difference(result, title_of(before, jobs[0]), out)
        return
    write_files(out, {STATES_FILE: format_states(rows)})
    for line in told:
        say(line)
    say(f"reports: {out / '*' / REPORT}; all states: {out / STATES_FILE}")
    if failed:
        raise MeasurementError(f"{len(failed)} of {len(jobs)} states could not be compared ({'; '.join(failed)}); the others are in {out}")


def measure_reference(setup: Setup, before: tuple[Path, ...], bar: Bar) -> Reference:
    """The reference, from its photographs or saved measurements."""
    from dishmap.compare import State, combine_states, later_hint
    from dishmap.io.measurement_file import is_measurement, read_measurement
    from dishmap.io.results import sha256_of

    frames: list[State] = []
    digests = []
    for path in before:
        saved = read_measurement(path, setup.camera, setup.pattern) if is_measurement(path) else None
        digest = sha256_of(path) if saved is None else saved.photograph_sha256
        if digest and digest in digests:
            raise InputError(
                f"{path} is another measurement of a photograph that is there already, whose noise would count twice; leave it out"
            )
        digests.append(digest)
        if saved is not None:
            frames.append(State(saved.poses))
            bar.step()(1, 1)
            continue
        hint = later_hint(setup.hint, frames[0]) if frames else setup.hint
        frames.append(measure(setup, path, hint, bar))
    return Reference(combine_states(frames), before, tuple(digests))


def measure(setup: Setup, path: Path, hint: Hint, bar: Bar) -> State:
    """One photograph measured; errors name it."""
    from dishmap.compare import measure_state
    from dishmap.io.images import read_gray

    tell = bar.step()
    image = read_gray(path)
    with naming(path):
        return measure_state(image, setup.camera, setup.pattern, hint_for(hint, path), with_centers=setup.method != "joint", progress=tell)


def compare(setup: Setup, reference: Reference, job: Job, bar: Bar) -> tuple[Difference, dict[str, float]]:
    """A state against the reference, and how long that took."""
    from dishmap.compare import combine_states, compare_states, later_hint
    from dishmap.io.results import sha256_of

    begin = time.perf_counter()
    shared = [path for path in job.photographs if sha256_of(path) in reference.digests]
    if shared and not len(reference.files) == len(job.photographs) == 1:
        raise InputError(f"{shared[0]} is also a photograph of the reference, and an average with it would hide a change; leave it out")
    hint = later_hint(setup.hint, reference.state)
    current = combine_states([measure(setup, path, hint, bar) for path in job.photographs])
    measured = time.perf_counter()
    with naming(*job.photographs):
        result = compare_states(
            reference.state, current, setup.camera, setup.pattern, setup.priors, setup.method, setup.surface, bar.step()
        )
    seconds = {"measure": measured - begin, "compare": time.perf_counter() - measured}
    return replace(result, same=result.same or bool(shared)), seconds


def leave(setup: Setup, reference: Reference, job: Job, result: Difference, seconds: dict[str, float], alone: bool) -> dict[str, Any]:
    """Write the files of a state, all or none; the only state's with the table of states beside them. Returns its row of that table."""
    from dishmap.io.atomic import output_folder
    from dishmap.io.difference_results import STATES_FILE, DifferenceProvenance, format_states, state_row, write_difference

    inputs: dict[str, str | Path] = {**numbered("reference", reference.files), **numbered("current", job.photographs), **setup.inputs}
    provenance = DifferenceProvenance(inputs, len(reference.files), len(job.photographs), setup.hint, seconds)
    row = state_row(job.name, job.photographs, result)
    with output_folder(job.folder):
        files = outcome_files(result, title_of(reference.files, job), provenance)
        write_difference(job.folder, {**files, **({STATES_FILE: format_states([row])} if alone else {})})
    return row


def title_of(before: tuple[Path, ...], job: Job) -> str:
    """Which photographs a comparison is of."""
    current = ", ".join(path.name for path in job.photographs)
    return f"{current} against {', '.join(path.name for path in before)}"


def numbered(what: str, files: tuple[Path, ...]) -> dict[str, Path]:
    """Names for input files: `current`, or `current_1`, `current_2` where there are several."""
    return {what: files[0]} if len(files) == 1 else {f"{what}_{k}": path for k, path in enumerate(files, start=1)}


@contextmanager
def naming(*paths: Path) -> Iterator[None]:
    """Errors of the block begin with the names of the photographs."""
    try:
        yield
    except DishmapError as error:
        raise type(error)(f"{', '.join(map(str, paths))}: {error}") from error
