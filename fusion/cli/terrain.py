"""`terrafusion terrain train|eval`: the terrain detector's model, and how well it does."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from terrafusion.datasets.core.errors import TerrafusionError

if TYPE_CHECKING:
    from terrafusion.fusion.training.detector_scores import DetectorScores

app = typer.Typer(help="The terrain detector: train its model, score it.", no_args_is_help=True)


@app.command("train")
def train(
    out: Annotated[Path, typer.Option("--out", help="Model file (YAML) to write.")],
    logs: Annotated[
        list[str] | None, typer.Argument(help="Labelled logs of one robot; none: drives of the twin.")
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(min=1, max=1000, help="Seeds of the twin's drives (3).", show_default=False),
    ] = None,
) -> None:
    """Train the terrain model on drives of the twin, or a learner of a robot's own grounds on its logs.

    Without logs it drives the twin over soils, slopes, payloads and speeds; one
    further seed calibrates the probabilities and one scores the model.

    Example: terrafusion terrain train --out model.yaml
    Example: terrafusion terrain train --out grounds.yaml borealtc/*/imu_*.csv
    """
    checked_output(out)
    if logs:
        no_seeds(seeds)
        train_on_logs(logs, out)
        return
    from terrafusion.fusion.training.train_detector import TrainingPlan, write_model
    from terrafusion.fusion.training.train_detector import train as run

    plan = TrainingPlan() if seeds is None else TrainingPlan(seeds=seeds)
    with progress("drives", plan.drives()) as tick:
        model, scores = run(plan, tick)
    write_model(model, out)
    print_scores("held-out seed", scores)
    print(f"temperature {model.temperature:g}; inputs {model.inputs_sha256[:16]}; written to {out}")


def train_on_logs(logs: list[str], out: Path) -> None:
    """Fit, calibrate and write a learner of labelled logs."""
    import dataclasses

    from terrafusion.fusion.training.cross_validation import check_runs, hashes_of, open_runs, train_on

    runs = open_runs(logs)
    check_runs(runs)
    made_by = f"terrafusion terrain train --out {out.name}, {len(runs)} runs"
    model = dataclasses.replace(train_on(runs), inputs=hashes_of(logs), made_by=made_by)
    model.write(out)
    windows = sum(len(r.x) for r in runs)
    print(f"{windows} windows of {len(runs)} runs on {', '.join(model.classes)}; written to {out}")


@app.command("eval")
def evaluate(
    logs: Annotated[
        list[str] | None, typer.Argument(help="Labelled logs of one robot; none: fresh drives of the twin.")
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            "--model",
            help="Model file: with logs a learner's, else the detector's; by default the shipped one.",
        ),
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(min=1, max=1000, help="Fresh seeds of the twin to score on (1).", show_default=False),
    ] = None,
    test: Annotated[
        list[str] | None, typer.Option("--test", help="Labelled logs of another robot (may be given again).")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="JSON file for all figures of the logs.")] = None,
) -> None:
    """Score a terrain model on fresh drives of the twin, or a learner on labelled logs, by run.

    With logs: five folds, no run in two of them; changes of ground, each input
    left out, grounds never seen, and the split that leaks beside it. With logs
    and a learner: how it does on these logs, none of which it may have seen.

    Example: terrafusion terrain eval
    Example: terrafusion terrain eval --out figures.json borealtc/*/imu_*.csv
    Example: terrafusion terrain eval --model grounds.yaml another_day/*/imu_*.csv
    """
    if out is not None:
        checked_output(out)
    if logs:
        no_seeds(seeds)
        if model is None:
            evaluate_logs(logs, test or [], out)
        elif test:
            raise TerrafusionError("--test is of a learner made here", remedy="leave out --model")
        else:
            evaluate_learner(model, logs, out)
        return
    if test or out is not None:
        raise TerrafusionError("--test and --out are of labelled logs", remedy="name the logs to train on")
    from terrafusion.fusion.terrain.classifier import load_terrain_model
    from terrafusion.fusion.training import detector_trials as trials

    loaded = load_terrain_model(model)
    with progress("drives", trials.count(seeds or 1)) as tick:
        results = trials.run(loaded, seeds or 1, tick)
    for name, scores in results.items():
        print_scores(name, scores)
        print()


def evaluate_logs(logs: list[str], test: list[str], out: Path | None) -> None:
    """Print the figures of labelled logs, and write them."""
    from terrafusion.fusion.training.cross_validation import hashes_of, open_runs
    from terrafusion.fusion.training.surface_report import STEPS, lines_of, report_on

    runs, others = open_runs(logs), open_runs(test) if test else []
    with progress("steps", STEPS) as tick:
        report = report_on(runs, others, tick)
    print("\n".join(lines_of(report)))
    write_figures(report | {"inputs": hashes_of([*logs, *test])}, out)


def evaluate_learner(model: Path, logs: list[str], out: Path | None) -> None:
    """Print how a learner does on labelled logs that it has not seen, and write it."""
    from terrafusion.fusion.training.cross_validation import hashes_of, open_runs
    from terrafusion.fusion.training.softmax import read_softmax
    from terrafusion.fusion.training.surface_report import figures_lines, score

    learner, inputs = read_softmax(model), hashes_of(logs)
    known = sorted(name for name, sha256 in inputs.items() if sha256 in learner.inputs.values())
    if known:
        raise TerrafusionError(
            f"was trained on {len(known)} of these files, such as {known[0]}",
            file=model,
            remedy="give other logs; without --model they are left out in turn",
        )
    report = score(learner, open_runs(logs))
    print("\n".join(figures_lines(report)))
    write_figures(report | {"inputs": inputs}, out)


def write_figures(report: dict[str, Any], out: Path | None) -> None:
    """Write figures as JSON where a file is asked for."""
    from terrafusion.datasets.core.json_text import to_json

    if out is not None:
        out.write_text(to_json(report, indent=1) + "\n", encoding="utf-8")


def no_seeds(seeds: int | None) -> None:
    """Refuse a number of seeds beside logs.

    Raises:
        TerrafusionError: there is one.
    """
    if seeds is not None:
        raise TerrafusionError("--seeds is of the twin's drives", remedy="leave it out, or the logs")


def print_scores(name: str, scores: DetectorScores) -> None:
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
