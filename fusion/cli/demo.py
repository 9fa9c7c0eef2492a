"""`terrafusion demo`: the main job, end to end, on a drive the twin makes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from terrafusion.fusion.cli.common import progress_bar


def demo(
    out: Annotated[
        Path, typer.Option("--out", help="Folder for the log, the results and report.html.")
    ] = Path("demo-out"),
    seed: Annotated[int, typer.Option(help="Seed of the simulated sensors.")] = 0,
) -> None:
    """Simulate a drive over firm ground, loose sand and mud, and localise it with fixed and adaptive weights.

    One GNSS outage covers the change of ground. Prints the comparison and writes report.html.

    Example: terrafusion demo --out demo-out
    """
    from terrafusion.fusion.cli.demo_run import run_demo

    with progress_bar("demo") as progress:
        lines = run_demo(out, seed, progress)
    for line in lines:
        print(line)
