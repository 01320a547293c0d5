"""Run the program inside a test."""

from __future__ import annotations

from pathlib import Path

from click.testing import CliRunner, Result

from dishmap.cli.app import program


def dishmap(*words: object) -> Result:
    """Run `dishmap` with these words; what it says on standard error is kept apart."""
    try:
        runner = CliRunner(mix_stderr=False)  # type: ignore[call-arg]
    except TypeError:  # click 8.2 and newer always keep it apart
        runner = CliRunner()
    return runner.invoke(program, [str(word) for word in words])


def map_words(shot: Path, photo: Path | None = None) -> list[object]:
    """`map` with the photograph, camera and pattern of a folder, or with another photograph."""
    return ["map", photo or shot / "ref.png", "--camera", shot / "camera.yaml", "--pattern", shot / "pattern.json"]


def refused(done: Result) -> str:
    """What a command said that has refused: one line on standard error and nothing else."""
    assert done.exit_code == 2, (done.exit_code, done.output, done.exception)
    assert done.stdout == ""
    assert done.stderr.startswith("dishmap: ")
    assert done.stderr.count("\n") == 1
    return done.stderr
