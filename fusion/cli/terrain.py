"""`terrafusion terrain train|eval`: trains and scores the model of the terrain detector."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.fusion.cli.common import progress_bar
from terrafusion.fusion.cli.usage import CommandGroup

if TYPE_CHECKING:
    from terrafusion.fusion.training.detector_scores import DetectorScores

app = typer.Typer(help="The terrain detector: train its model, score it.", cls=CommandGroup)


@app.command("train")
def train(
    out: Annotated[Path, typer.Option("--out", help="Model file (YAML) to write.")],
    logs: Annotated[
        list[str] | None, typer.Argument(help="Labelled logs of one robot; none: simulated runs.")
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(min=1, max=1000, help="Seeds of the simulated runs (3).", show_default=False),
    ] = None,
) -> None:
    """Train the terrain model on simulated runs, or a classifier of one robot's grounds on its labelled logs.

    Without logs the twin drives over soils, slopes, payloads and speeds; one
    more seed calibrates the probabilities and one scores the model.

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
    with progress("runs", plan.runs()) as tick:
        model, scores = run(plan, tick)
    write_model(model, out)
    print_scores("held-out seed", scores)
    print(f"temperature {model.temperature:g}; inputs {model.inputs_sha256[:16]}; written to {out}")


def train_on_logs(logs: list[str], out: Path) -> None:
    """Fit, calibrate and write a classifier of labelled logs."""
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
        list[str] | None, typer.Argument(help="Labelled logs of one robot; none: new simulated runs.")
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            "--model",
            help="Model file: with logs of `train LOGS`, else of the detector (default: the shipped one).",
        ),
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(min=1, max=1000, help="New seeds of simulated runs (1).", show_default=False),
    ] = None,
    test: Annotated[
        list[str] | None, typer.Option("--test", help="Labelled logs of another robot (may be given again).")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="JSON file for the scores of the logs.")] = None,
) -> None:
    """Score a terrain model on new simulated runs, or a classifier on labelled logs, cross-validated by run.

    With logs: five folds of whole runs; delay of detecting changes of ground,
    ablation of feature groups, unseen grounds, and a leaking split for
    comparison. With logs and a model: its scores on these logs, which must not
    be those of its training.

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
            raise TerrafusionError("--test needs a model trained by this command", remedy="leave out --model")
        else:
            evaluate_model(model, logs, out)
        return
    if test or out is not None:
        raise TerrafusionError("--test and --out need labelled logs", remedy="name the logs to train on")
    from terrafusion.fusion.terrain.classifier import load_terrain_model
    from terrafusion.fusion.training import detector_trials as trials

    loaded = load_terrain_model(model)
    with progress("runs", trials.count(seeds or 1)) as tick:
        results = trials.run(loaded, seeds or 1, tick)
    for name, scores in results.items():
        print_scores(name, scores)
        print()


def evaluate_logs(logs: list[str], test: list[str], out: Path | None) -> None:
    """Cross-validate labelled logs; print and write the scores."""
    from terrafusion.fusion.training.cross_validation import hashes_of, open_runs
    from terrafusion.fusion.training.surface_report import STEPS, lines_of, report_on

    runs, others = open_runs(logs), open_runs(test) if test else []
    with progress("steps", STEPS) as tick:
        report = report_on(runs, others, tick)
    print("\n".join(lines_of(report)))
    write_scores(report | {"inputs": hashes_of([*logs, *test])}, out)


def evaluate_model(model: Path, logs: list[str], out: Path | None) -> None:
    """Score a model on labelled logs that it was not trained on; print and write the scores."""
    from terrafusion.fusion.training.cross_validation import hashes_of, open_runs
    from terrafusion.fusion.training.softmax import read_softmax
    from terrafusion.fusion.training.surface_report import figures_lines, score

    classifier, inputs = read_softmax(model), hashes_of(logs)
    known = sorted(name for name, sha256 in inputs.items() if sha256 in classifier.inputs.values())
    if known:
        raise TerrafusionError(
            f"was trained on {len(known)} of these files, such as {known[0]}",
            file=model,
            remedy="give other logs; without --model they are left out in turn",
        )
    report = score(classifier, open_runs(logs))
    print("\n".join(figures_lines(report)))
    write_scores(report | {"inputs": inputs}, out)


def write_scores(report: dict[str, Any], out: Path | None) -> None:
    """Write scores as JSON if `out` is given."""
    from terrafusion.datasets.core.json_text import to_json

    if out is not None:
        out.write_text(to_json(report, indent=1) + "\n", encoding="utf-8")


def no_seeds(seeds: int | None) -> None:
    """Refuse `--seeds` together with logs."""
    if seeds is not None:
        raise TerrafusionError("--seeds is for simulated runs", remedy="leave it out, or the logs")


def print_scores(name: str, scores: DetectorScores) -> None:
    """Print the scores as a table."""
    median, p95, largest = scores.switch_delay_s
    print(f"{name}: {scores.windows} windows")
    print(f"{'true ground':13s} " + " ".join(f"{c:>12s}" for c in scores.classes))
    for truth, row in zip(scores.classes, scores.confusion, strict=False):
        if any(row):
            print(f"{truth:13s} " + " ".join(f"{share:12.3f}" for share in row))
    print(f"macro-F1 {scores.macro_f1:.3f}; ECE {scores.ece:.3f}; unknown {scores.unknown_share:.3f}")
    print(
        f"ground change detected after {median:.1f} s (median), {p95:.1f} s (95 %), {largest:.1f} s (max); "
        f"missed {scores.switches_missed:.1%}; false changes {scores.false_switches_per_min:.2f}/min"
    )
    print(f"one update {scores.update_ms:.2f} ms")


def checked_output(path: Path) -> None:
    """Refuse an output file that cannot be written, before the long work starts."""
    folder = path.absolute().parent
    if path.is_dir() or not folder.is_dir() or not os.access(path if path.exists() else folder, os.W_OK):
        raise TerrafusionError("cannot be written", file=path, remedy="give a file in an existing folder")


@contextlib.contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[], None]]:
    """A progress bar of `total` steps on a terminal; call the value after each step."""
    with progress_bar(what) as report:
        steps = itertools.count(1)
        yield (lambda: report(next(steps) / total)) if report is not None else lambda: None
