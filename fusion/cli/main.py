"""`terrafusion`: the command line, one file a command.

A command is a function whose docstring is its help and, in `Args`, describes its options (see
`command.add_command`). Heavy packages are imported inside the command that needs them, so that
`terrafusion --help` is fast.
"""

import errno
import io
import sys
from typing import Annotated

import typer

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.printable import printable
from terrafusion.fusion.cli import (
    allan,
    benchmark,
    calibrate,
    completion,
    convert,
    demo,
    fetch,
    gap,
    gap_blind,
    init,
    inspect,
    live,
    policy,
    replay,
    self_check,
    simulate,
    sweep,
    terrain,
)
from terrafusion.fusion.cli.command import INTERRUPTED, add_command
from terrafusion.fusion.cli.usage import CommandGroup, UsageError, usage_line

app = typer.Typer(
    name="terrafusion",
    help="Terrain-aware localisation of ground robots, and diagnosis of the gap to their twins.",
    cls=CommandGroup,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    add_completion=False,
)


def _print_version(value: bool) -> None:
    if value:
        from importlib.metadata import version

        print(f"terrafusion {version('terrafusion')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option("--version", help="Print the version and stop.", callback=_print_version, is_eager=True),
    ] = False,
) -> None:
    """Options of the program itself."""


add_command(app, "demo", demo.demo, output=demo.OUTPUT)
add_command(app, "self-check", self_check.self_check)
add_command(app, "init", init.init, files={"out": None})
add_command(app, "inspect", inspect.inspect, files={"report": "terrafusion inspect"})
add_command(app, "replay", replay.replay, output=replay.OUTPUT, files={"rerun": None})
add_command(app, "live", live.live, as_json=False)
add_command(
    app, "calibrate", calibrate.calibrate, output=calibrate.OUTPUT,
    instead=("sensors", calibrate.SENSORS_OUTPUT),
)  # fmt: skip
add_command(app, "gap", gap.gap, output=gap.OUTPUT, files={"write_vehicle": "gap diagnosis:"})
add_command(app, "simulate", simulate.simulate, output=simulate.OUTPUT)
add_command(app, "sweep", sweep.sweep, output=sweep.OUTPUT)
add_command(app, "convert", convert.convert, output=convert.OUTPUT)
add_command(app, "fetch", fetch.fetch)
add_command(app, "allan", allan.allan)
app.add_typer(terrain.app, name="terrain")
app.add_typer(policy.app, name="policy")
add_command(app, "benchmark", benchmark.benchmark, output=benchmark.OUTPUT)
add_command(app, "gap-blind", gap_blind.gap_blind, output=gap_blind.OUTPUT)
add_command(app, "completion", completion.completion, as_json=False)


def main() -> None:
    """Run the command line: 0 done, 1 a known error in one line, 2 wrong usage, 130 Ctrl-C."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a locale may lack what is printed
            stream.reconfigure(errors="backslashreplace")
    completion.answer_shells()
    try:
        try:
            status = app(prog_name="terrafusion", standalone_mode=False)
        except KeyboardInterrupt:
            status = INTERRUPTED
        if status == INTERRUPTED:  # before the command began
            print("error: interrupted; nothing was written", file=sys.stderr)
        sys.exit(status)
    except UsageError as error:
        print(f"error: {printable(usage_line(error))}", file=sys.stderr)
        sys.exit(2)
    except TerrafusionError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    except BrokenPipeError:
        sys.exit(1)
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        print("error: no space left on the device; free some, or write elsewhere", file=sys.stderr)
        sys.exit(1)
