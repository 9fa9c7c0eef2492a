"""What the commands of studies over many logs share: options, reading of the logs, storing of the results."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from terrafusion.datasets.core.errors import TerrafusionError
from tests.studies.opponents.drives import Drive, drives_of, longest
from tests.studies.parts import Task, add_options, result_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ENVIRONMENT = "TERRAFUSION_LOGS"
"""Paths of further logs, separated as in PATH."""
Prepared = TypeVar("Prepared")


def parser_of(module: str, description: str | None) -> argparse.ArgumentParser:
    """Options of every such command; a study adds its own."""
    parser = argparse.ArgumentParser(
        prog=f"python -m tests.studies.{module}",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for parts, tables and figure")
    parser.add_argument("--logs", nargs="+", metavar="LOG", help="by default all at hand")
    parser.add_argument("--runs", type=int, default=1, help="of a file with many runs, the longest")
    add_options(parser)
    return parser


def further_logs() -> list[str]:
    """The paths in TERRAFUSION_LOGS."""
    return [path for path in os.environ.get(ENVIRONMENT, "").split(os.pathsep) if path]


def prepared(names: Sequence[str], runs: int, prepare: Callable[[Drive], Prepared | None]) -> list[Prepared]:
    """What `prepare` makes of each drive of the logs, None apart; unreadable logs are named and left out."""
    found = []
    for name in names:
        try:
            for drive in longest(drives_of(name), runs):
                one = prepare(drive)
                if one is not None:
                    found.append(one)
        except TerrafusionError as error:
            print(f"{name}: left out, {error}", file=sys.stderr)
    return found


def missing(tasks: Sequence[Task], folder: Path) -> int:
    """How many tasks have no result yet."""
    return sum(result_of(task, folder) is None for task in tasks)


def store(folder: Path, name: str, text: str, figure: Figure) -> None:
    """Write the page and the figure, and print the page."""
    (folder / f"{name}.md").write_text(text + "\n", encoding="utf-8")
    figure.savefig(folder / f"{name}.png", dpi=110)
    print(text)
