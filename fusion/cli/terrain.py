"""`terrafusion terrain train|eval`: the terrain detector's model, and how well it does."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from terrafusion.datasets.errors import TerrafusionError

if TYPE_CHECKING:
    from terrafusion.fusion.terrain.evaluate import Scores

app = typer.Typer(help="The terrain detector: train its model, score it.", no_args_is_help=True)


@app.command("train")
def train(
    out: Annotated[Path, typer.Option("--out", help="Model file (YAML) to write.")],
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Seeds of the drives it learns from.")] = 3,
) -> None:
    """Drive the twin over soils, slopes, payloads and speeds, and train the terrain model.

    One further seed calibrates the probabilities and one scores the model; both
    are kept from the training.

    Example: terrafusion terrain train --out model.yaml
    """
    from terrafusion.fusion.terrain.train import Plan, write_model
    from terrafusion.fusion.terrain.train import train as run

    checked_output(out)
    plan = Plan(seeds=seeds)
    with progress("drives", plan.drives()) as tick:
        model, scores = run(plan, tick)
    write_model(model, out)
    print_scores("held-out seed", scores)
    print(f"temperature {model.temperature:g}; inputs {model.inputs_sha256[:16]}; written to {out}")


@app.command("eval")
def evaluate(
    model: Annotated[
        Path | None, typer.Option("--model", help="Model file; the shipped one if left out.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Fresh seeds to score on.")] = 1,
) -> None:
    """Score a terrain model on fresh drives of the twin, with and without slip, and on a ground it never saw.

    Example: terrafusion terrain eval
    """
    from terrafusion.fusion.terrain import trials
    from terrafusion.fusion.terrain.classifier import load_terrain_model

    loaded = load_terrain_model(model)
    with progress("drives", trials.count(seeds)) as tick:
        results = trials.run(loaded, seeds, tick)
    for name, scores in results.items():
        print_scores(name, scores)
        print()


def print_scores(name: str, scores: Scores) -> None:
    """The scores as a small table."""
    median, p95, largest = scores.switch_delay_s
    print(f"{name}: {scores.windows} windows")
    print(f"{'true ground':13s} " + " ".join(f"{c:>12s}" for c in scores.classes))
    for truth, row in zip(scores.classes, scores.confusion, strict=False):
        if any(row):
            print(f"{truth:13s} " + " ".join(f"{share:12.3f}" for share in row))
    print(f"macro-F1 {scores.macro_f1:.3f}; ECE {scores.ece:.3f}; called unknown {scores.unknown_share:.3f}")
    print(
        f"change of ground seen after {median:.1f} s (median), {p95:.1f} s (95 %), {largest:.1f} s (worst); "
        f"never {scores.switches_missed:.1%}; false changes {scores.false_switches_per_min:.2f}/min"
    )
    print(f"one update {scores.update_ms:.2f} ms")


def checked_output(path: Path) -> None:
    """Refuse an output file that cannot be written before the long work starts.

    Raises:
        TerrafusionError: its folder does not exist, it is a folder itself, or it may not be written.
    """
    folder = path.absolute().parent
    if path.is_dir() or not folder.is_dir() or not os.access(path if path.exists() else folder, os.W_OK):
        raise TerrafusionError("cannot be written", file=path, remedy="give a file in an existing folder")


@contextlib.contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[], None]]:
    """A bar on standard error when that is a terminal, nothing otherwise; call the value after each step."""
    if not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task(what, total=total)
        yield lambda: bar.advance(task)
