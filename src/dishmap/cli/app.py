"""The program's entry: its commands, and what becomes of errors.

Exit codes: 0 done; 2 the input cannot be used or nothing can be measured from it, said in one sentence on standard error;
130 stopped with Ctrl-C. Commands import what they need when they run, so that help comes at once.
"""

from __future__ import annotations

import errno
import signal
import sys
from typing import Any, NoReturn

import click

from dishmap.cli.calibrate import calibrate_command
from dishmap.cli.demo import demo_command
from dishmap.cli.diff import diff_command
from dishmap.cli.map import map_command
from dishmap.cli.pattern import pattern_group
from dishmap.cli.plan import plan_group
from dishmap.cli.rf import rf_command
from dishmap.cli.sheet import sheet_group
from dishmap.cli.simulate import simulate_command
from dishmap.cli.undistort import undistort_command
from dishmap.errors import DishmapError

FAILED, STOPPED = 2, 130
STOPPED_LINE = "dishmap: stopped; no file was left half-written"


class Failure(click.ClickException):
    """An error of the user's to mend: one sentence, and exit code 2."""

    exit_code = FAILED

    def show(self, file: Any = None) -> None:
        """Print the sentence on standard error."""
        click.echo(f"dishmap: {' '.join(self.message.split())}", err=True)


class Program(click.Group):
    """A group of commands whose errors become sentences and exit codes."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command."""
        try:
            return super().invoke(ctx)
        except DishmapError as error:
            raise Failure(str(error)) from error
        except MemoryError as error:
            raise Failure("there is not enough memory for this; use a smaller photograph or pattern, or close other programs") from error
        except OSError as error:
            if error.errno == errno.EPIPE:  # the reader of our output has gone (`dishmap ... | head`): not for the user to mend
                raise
            where = f" {error.filename}" if error.filename else ""
            raise Failure(
                f"the system refused to read or write{where}: {error.strerror or error}; free space or use another place"
            ) from error
        except KeyboardInterrupt:
            click.echo(STOPPED_LINE, err=True)
            ctx.exit(STOPPED)


def _version(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not ctx.resilient_parsing:
        from dishmap import __version__

        click.echo(f"dishmap {__version__}")
        ctx.exit()


@click.group(cls=Program, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.option("--version", is_flag=True, is_eager=True, expose_value=False, callback=_version, help="Show the version and exit.")
def program() -> None:
    """Measure the shape of a dish antenna, or of any printed surface, from photographs by one calibrated camera."""


for _command in (
    pattern_group,
    plan_group,
    sheet_group,
    calibrate_command,
    map_command,
    diff_command,
    rf_command,
    simulate_command,
    undistort_command,
    demo_command,
):
    program.add_command(_command)


def main() -> NoReturn:
    """Run the program with the words of the command line, and exit."""
    # a polite kill cleans up as Ctrl-C does
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        program.main(prog_name="dishmap")
    except KeyboardInterrupt:  # before or after the command itself
        click.echo(STOPPED_LINE, err=True)
        sys.exit(STOPPED)
    sys.exit(0)
