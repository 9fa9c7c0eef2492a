"""`terrafusion`: the command line, one file a command.

Heavy packages are imported inside the command that needs them, so that
`terrafusion --help` is fast.
"""

from __future__ import annotations

import errno
import sys
from typing import Annotated

import typer

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.fusion.cli import (
    allan,
    benchmark,
    calibrate,
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
    simulate,
    study,
    sweep,
    terrain,
)
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


app.command("demo")(demo.demo)
app.command("init")(init.init)
app.command("inspect")(inspect.inspect)
app.command("fetch")(fetch.fetch)
app.command("convert")(convert.convert)
app.command("simulate")(simulate.simulate)
app.command("sweep")(sweep.sweep)
app.command("benchmark")(benchmark.benchmark)
app.command("calibrate")(calibrate.calibrate)
app.command("gap")(gap.gap)
app.command("gap-blind")(gap_blind.gap_blind)
app.command("allan")(allan.allan)
app.command("study")(study.study)
app.command("replay")(replay.replay)
app.command("live")(live.live)
app.add_typer(terrain.app, name="terrain")
app.add_typer(policy.app, name="policy")


def main() -> None:
    """Run the command line: exit status 0 done, 1 a known error in one line, 2 wrong usage."""
    try:
        sys.exit(app(prog_name="terrafusion", standalone_mode=False))
    except UsageError as error:
        print(f"error: {usage_line(error)}", file=sys.stderr)
        sys.exit(2)
    except TerrafusionError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    except (KeyboardInterrupt, typer.Abort):
        print("error: interrupted; results already written are kept", file=sys.stderr)
        sys.exit(1)
    except BrokenPipeError:
        sys.exit(1)
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        print("error: no space left on the device; free some, or write elsewhere", file=sys.stderr)
        sys.exit(1)
