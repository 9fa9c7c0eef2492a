"""`terrafusion terrain train|eval`: trains and scores the model of the terrain detector."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.fusion.cli import common
from terrafusion.fusion.cli.command import Result, add_command
from terrafusion.fusion.cli.outputs import Output, parts_of
from terrafusion.fusion.cli.usage import CommandGroup

if TYPE_CHECKING:
    from terrafusion.fusion.training.detector_scores import DetectorScores

app = typer.Typer(help="The terrain detector: train its model, score it.", cls=CommandGroup)


def train(
    out: Path,
    logs: Annotated[
        list[str] | None, typer.Argument(help="Labelled logs of one robot; none: simulated runs.")
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(min=1, max=1000, help="Seeds of the simulated runs (3).", show_default=False)
    ] = None,
    jobs: common.JobsOption = None,
    backend: common.BackendOption = "loky",
    address: common.AddressOption = None,
) -> Result:
    """Train the terrain model on simulated runs, or a classifier of one robot's grounds on its labelled logs.

    Without logs the twin drives over soils, slopes, payloads and speeds; one
    more seed calibrates the probabilities and one scores the model. Stopped,
    the same command continues.

    Example: terrafusion terrain train --out model.yaml

    Example: terrafusion terrain train --out grounds.yaml borealtc/*/imu_*.csv
    """
    common.check_backend(backend, address)
    if logs:
        no_seeds(seeds)
        return train_on_logs(logs, out)
    from terrafusion.fusion.training.train_detector import TrainingPlan, write_model
    from terrafusion.fusion.training.train_detector import train as run

    plan = TrainingPlan() if seeds is None else TrainingPlan(seeds=seeds)
    with progress("runs", plan.runs()) as tick:
        model, scores = run(
            plan, tick, jobs=common.processes(jobs), backend=backend, address=address, parts=parts_of(out)
        )
    write_model(model, out)
    done = f"temperature {model.temperature:g}; inputs {model.inputs_sha256[:16]}; written to {out}"
    return Result(score_lines("held-out seed", scores), done, {"out": str(out), **dataclasses.asdict(scores)})


def train_on_logs(logs: list[str], out: Path) -> Result:
    """Fit, calibrate and write a classifier of labelled logs."""
    from terrafusion.fusion.training.cross_validation import check_runs, hashes_of, open_runs, train_on

    runs = open_runs(logs)
    check_runs(runs)
    made_by = f"terrafusion terrain train --out {out.name}, {len(runs)} runs"
    model = dataclasses.replace(train_on(runs), inputs=hashes_of(logs), made_by=made_by)
    model.write(out)
    windows = sum(len(r.x) for r in runs)
    done = f"{windows} windows of {len(runs)} runs on {', '.join(model.classes)}; written to {out}"
    document = {"out": str(out), "runs": len(runs), "windows": windows, "classes": list(model.classes)}
    return Result((), done, document)


def evaluate(
    logs: Annotated[
        list[str] | None, typer.Argument(help="Labelled logs of one robot; none: new simulated runs.")
    ] = None,
    model: Path | None = None,
    seeds: Annotated[
        int | None, typer.Option(min=1, max=1000, help="New seeds of simulated runs (1).", show_default=False)
    ] = None,
    test: list[str] | None = None,
    out: Path | None = None,
) -> Result:
    """Score a terrain model on new simulated runs, or a classifier on labelled logs, cross-validated by run.

    With logs: five folds of whole runs. With logs and a model: its scores on
    these logs, which must not be those of its training.

    Example: terrafusion terrain eval

    Example: terrafusion terrain eval --out figures.json borealtc/*/imu_*.csv

    Example: terrafusion terrain eval --model grounds.yaml another_day/*/imu_*.csv

    Args:
        model: Model file: with logs of `train LOGS`, else of the detector (default: the shipped one).
        test: Labelled logs of another robot (may be given again).
        out: JSON file for the scores of the logs.
    """
    if logs:
        no_seeds(seeds)
        if model is None:
            return evaluate_logs(logs, test or [], out)
        if test:
            raise TerrafusionError("--test needs a model trained by this command", remedy="leave out --model")
        return evaluate_model(model, logs, out)
    if test or out is not None:
        raise TerrafusionError("--test and --out need labelled logs", remedy="name the logs to train on")
    from terrafusion.fusion.terrain.classifier import load_terrain_model
    from terrafusion.fusion.training import detector_trials as trials

    loaded = load_terrain_model(model)
    with progress("runs", trials.count(seeds or 1)) as tick:
        results = trials.run(loaded, seeds or 1, tick)
    lines = [line for name, scores in results.items() for line in [*score_lines(name, scores), ""]]
    return Result(lines, "", {name: dataclasses.asdict(scores) for name, scores in results.items()})


def evaluate_logs(logs: list[str], test: list[str], out: Path | None) -> Result:
    """Cross-validate labelled logs; write the scores where asked for."""
    from terrafusion.fusion.training.cross_validation import hashes_of, open_runs
    from terrafusion.fusion.training.surface_report import lines_of, report_on

    report = report_on(open_runs(logs), open_runs(test) if test else [])
    return scored(report | {"inputs": hashes_of([*logs, *test])}, lines_of(report), out)


def evaluate_model(model: Path, logs: list[str], out: Path | None) -> Result:
    """Score a model on labelled logs that it was not trained on; write the scores where asked for."""
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
    return scored(report | {"inputs": inputs}, figures_lines(report), out)


def scored(report: dict[str, Any], lines: list[str], out: Path | None) -> Result:
    """Scores as the result of the command, also written as JSON if `out` is given."""
    from terrafusion.datasets.core.json_text import finite, to_json
    from terrafusion.fusion.reports.page import write_text

    if out is not None:
        write_text(out, to_json(report, indent=1) + "\n")
    return Result(lines, "" if out is None else f"written to {out}", finite(report))


def no_seeds(seeds: int | None) -> None:
    """Refuse `--seeds` together with logs."""
    if seeds is not None:
        raise TerrafusionError("--seeds is for simulated runs", remedy="leave it out, or the logs")


def score_lines(name: str, scores: DetectorScores) -> list[str]:
    """The scores as a table."""
    from terrafusion.fusion.training.detector_scores import confusion_lines

    median, p95, largest = scores.switch_delay_s
    return [
        f"{name}: {scores.windows} windows",
        *confusion_lines(scores.classes, scores.confusion),
        f"macro-F1 {scores.macro_f1:.3f}; ECE {scores.ece:.3f}; unknown {scores.unknown_share:.3f}",
        f"ground change detected after {median:.1f} s (median), {p95:.1f} s (95 %), {largest:.1f} s (max); "
        f"missed {scores.switches_missed:.1%}; false changes {scores.false_switches_per_min:.2f}/min",
        f"one update {scores.update_ms:.2f} ms",
    ]


@contextlib.contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[], None]]:
    """A progress bar of `total` steps on a terminal; call the value after each step."""
    with common.progress_bar(what) as report:
        steps = itertools.count(1)
        yield (lambda: report(next(steps) / total)) if report is not None else lambda: None


MODEL = Output(
    "Model file (YAML) to write.", suffix=".yaml", mark="made_by: terrafusion terrain train", goes_on=True
)
add_command(app, "train", train, output=MODEL)
add_command(app, "eval", evaluate, files={"out": None})
