"""`terrafusion terrain train|eval`: trains and scores the model of the terrain detector."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.printable import counted
from terrafusion.fusion.cli import common
from terrafusion.fusion.cli.command import Result, add_command
from terrafusion.fusion.cli.outputs import Output, parts_of
from terrafusion.fusion.cli.usage import CommandGroup

if TYPE_CHECKING:
    from terrafusion.fusion.terrain.classifier import TerrainModel
    from terrafusion.fusion.training.detector_scores import DetectorScores

app = typer.Typer(help="The terrain detector: train its model, score it.", cls=CommandGroup)


def train(
    out: Path,
    logs: Annotated[
        list[str] | None, typer.Argument(help="Labelled logs of one robot; none: simulated runs.")
    ] = None,
    vehicle: common.VehicleOption = None,
    seeds: Annotated[
        int | None, typer.Option(min=1, max=1000, help="Seeds of the simulated runs (3).", show_default=False)
    ] = None,
    jobs: common.JobsOption = None,
    backend: common.BackendOption = "loky",
    address: common.AddressOption = None,
) -> Result:
    """Train the terrain model of a robot on its labelled logs, or the shipped one on simulated runs.

    A model of logs takes two or more of each ground, and goes to `replay --terrain-model`. Without logs the
    twin drives over soils, slopes, payloads and speeds; one more seed calibrates the
    probabilities and one scores the model. Stopped, the same command continues.

    Example: terrafusion terrain train --out grounds.yaml monday.bag tuesday.bag --vehicle my_robot.yaml

    Example: terrafusion terrain train --out model.yaml
    """
    common.check_backend(backend, address)
    if logs:
        no_seeds(seeds)
        return train_on_logs(logs, vehicle, out)
    if vehicle is not None:
        raise TerrafusionError("--vehicle is for logs", remedy="name the logs, or leave it out")
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


def train_on_logs(logs: list[str], vehicle: str | None, out: Path) -> Result:
    """Fit, calibrate and write the model of a robot."""
    from terrafusion.fusion.training.logged_runs import open_runs
    from terrafusion.fusion.training.train_detector import write_model
    from terrafusion.fusion.training.train_on_logs import train_on

    inputs = inputs_of(logs)
    with progress("logs", len(logs)) as tick:
        runs = open_runs(logs, vehicle, tick)
    made_by = f"terrafusion terrain train --out {out.name}, {counted(len(runs), 'run')}"
    model = train_on(runs, inputs, made_by)
    write_model(model, out)
    windows = sum(len(r.route.windows) for r in runs)
    done = f"{windows} windows of {counted(len(runs), 'run')} on {', '.join(model.classes)}; written to {out}"
    document = {"out": str(out), "runs": len(runs), "windows": windows, "classes": list(model.classes)}
    return Result((), done, document)


def evaluate(
    logs: Annotated[
        list[str] | None, typer.Argument(help="Labelled logs of one robot; none: new simulated runs.")
    ] = None,
    model: Path | None = None,
    vehicle: common.VehicleOption = None,
    seeds: Annotated[
        int | None, typer.Option(min=1, max=1000, help="New seeds of simulated runs (1).", show_default=False)
    ] = None,
    out: Path | None = None,
) -> Result:
    """Score a terrain model on new simulated runs, or on labelled logs, cross-validated by run.

    With logs: five folds of whole runs. With logs and a model: its scores on
    these logs, which must not be those of its training.

    Example: terrafusion terrain eval

    Example: terrafusion terrain eval --out figures.json borealtc/*/imu_*.csv

    Example: terrafusion terrain eval --model grounds.yaml wednesday.bag

    Args:
        model: Model file (default without logs: the shipped one).
        out: JSON file for the scores of the logs.
    """
    if logs:
        no_seeds(seeds)
        return evaluate_logs(logs, vehicle, model, out)
    if vehicle is not None or out is not None:
        raise TerrafusionError("--vehicle and --out need labelled logs", remedy="name the logs")
    from terrafusion.fusion.terrain.classifier import load_terrain_model
    from terrafusion.fusion.training.detector_scores import evaluate as scores_of
    from terrafusion.fusion.training.train_detector import TrainingPlan, fresh_routes

    loaded, count = load_terrain_model(model), seeds or 1
    with progress("runs", count * len(TrainingPlan().grid(0).conditions())) as tick:
        scores = scores_of([(loaded, route) for route in fresh_routes(count, tick)])
    return Result(score_lines("new runs", scores), "", dataclasses.asdict(scores))


def evaluate_logs(logs: list[str], vehicle: str | None, model: Path | None, out: Path | None) -> Result:
    """Score models of the other folds, or the given one, on labelled logs; write the scores."""
    from terrafusion.datasets.core.json_text import finite, to_json
    from terrafusion.fusion.reports.page import write_text
    from terrafusion.fusion.training.logged_runs import open_runs
    from terrafusion.fusion.training.train_on_logs import cross_validated, scores_on

    inputs, loaded = inputs_of(logs), None if model is None else untrained_on(model, logs)
    with progress("logs", len(logs)) as tick:
        runs = open_runs(logs, vehicle, tick)
    scores, spliced = cross_validated(runs) if loaded is None else (scores_on(loaded, runs), None)
    report = {**dataclasses.asdict(scores), "inputs": inputs}
    lines = score_lines(counted(len(runs), "run"), scores)
    if spliced is not None:
        report["spliced"] = dataclasses.asdict(spliced)
        lines += score_lines("routes spliced from them", spliced)
    if out is not None:
        write_text(out, to_json(report, indent=1) + "\n")
    done = "" if out is None else f"written to {out}"
    return Result(lines, done, finite(report))


def inputs_of(logs: list[str]) -> dict[str, str]:
    """SHA-256 of the files of the logs, none of which is given twice: one would test the other."""
    from terrafusion.datasets.readers import hashes_of

    seen: dict[frozenset[str], str] = {}
    for log in logs:
        content = frozenset(hashes_of([log]).values())
        if content in seen:
            raise TerrafusionError(f"is the same log as {seen[content]}", file=log, remedy="give it once")
        seen[content] = log
    return hashes_of(logs)


def untrained_on(path: Path, logs: list[str]) -> TerrainModel:
    """A model that was trained on none of the logs; one is known where all of its files are."""
    from terrafusion.datasets.readers import hashes_of
    from terrafusion.fusion.terrain.classifier import load_terrain_model

    model = load_terrain_model(path)
    trained = set(model.inputs.values())
    known = [log for log in logs if set(hashes_of([log]).values()) <= trained]
    if known:
        raise TerrafusionError(
            f"was trained on {len(known)} of these logs, such as {known[0]}",
            file=path,
            remedy="give other logs; without --model they are left out in turn",
        )
    return model


def no_seeds(seeds: int | None) -> None:
    """Refuse `--seeds` together with logs."""
    if seeds is not None:
        raise TerrafusionError("--seeds is for simulated runs", remedy="leave it out, or the logs")


def score_lines(name: str, scores: DetectorScores) -> list[str]:
    """The scores as a table."""
    from terrafusion.fusion.training.detector_scores import confusion_lines

    median, p95, largest = scores.switch_delay_s
    changes = [
        f"ground change detected after {median:.1f} s (median), {p95:.1f} s (95 %), {largest:.1f} s (max); "
        f"within 2 s {scores.switches_in_time:.0%}; missed {scores.switches_missed:.1%}"
    ]
    return [
        f"{name}: {scores.windows} windows",
        *confusion_lines(scores.classes, scores.confusion),
        f"macro-F1 {scores.macro_f1:.3f}; ECE {scores.ece:.3f}; unknown {scores.unknown_share:.3f}",
        *([] if math.isnan(scores.switches_in_time) else changes),
        f"false changes {scores.false_switches_per_min:.2f}/min; one update {scores.update_ms:.2f} ms",
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
