"""What a person sees in a terminal: progress of long work on standard error, and plain tables."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import click

# Work that ends sooner needs no bar.
QUIET_SECONDS = 1.0

Tell = Callable[[int, int], None]


@contextmanager
def progress(what: str) -> Iterator[Tell]:
    """Give a function `tell(done, total)` that shows a bar with the time left, once the work proves long, in a terminal only."""
    if not sys.stderr.isatty():
        yield lambda done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    begin = time.monotonic()
    task = bar.add_task(what, total=None)

    def tell(done: int, total: int) -> None:
        bar.update(task, completed=done, total=total)
        if not bar.live.is_started and done < total and time.monotonic() - begin > QUIET_SECONDS:
            bar.start()

    try:
        yield tell
    finally:
        # an error's sentence must not stand in the bar's line
        if bar.live.is_started:
            bar.stop()


def say(text: str = "") -> None:
    """Print a line on standard output."""
    click.echo(text)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Lines of columns: the first to the left, the others to the right."""
    cells = [list(head), *(list(row) for row in rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(head))]
    lines = [[c.ljust(w) if k == 0 else c.rjust(w) for k, (c, w) in enumerate(zip(row, widths, strict=True))] for row in cells]
    return "\n".join("  " + "  ".join(line).rstrip() for line in lines)
