"""`terrafusion gap`: where a robot and its twin disagree, why, and how far the gap shrinks."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from terrafusion.fusion.cli import common
from terrafusion.fusion.cli.calibrate import parse_terrain, split
from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.outputs import Output

if TYPE_CHECKING:
    from terrafusion.datasets.core.recording import Recording
    from terrafusion.datasets.core.sensors import Rig
    from terrafusion.fusion.benchmark.estimator_gap import Compared

OUTPUT = Output(
    "Folder for diagnosis.json and report.html.",
    ("config.json", "diagnosis.json", "judge.json", "report.html"),
    ("diagnosis.json",),
)
RunsArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="RUN...",
        help="Runs of the robot as it is now: folders, bags, names; "
        "LOG@60-105 is a piece of one, LOG@/45 all of its pieces of 45 s.",
    ),
]


def _explained(effect: str | None) -> None:
    """Print what an effect is, and stop."""
    if effect is None:
        return
    from terrafusion.fusion.reports.gap_text import explanation

    for line in explanation(effect):
        print(line)
    raise typer.Exit


ExplainOption = Annotated[
    str | None,
    typer.Option(
        "--explain", metavar="EFFECT", callback=_explained, is_eager=True,
        help="Say what an effect is and how to check it on the robot, and stop.",
    ),
]  # fmt: skip


def gap(
    runs: RunsArgument,
    out: Path,
    reference: list[str] | None = None,
    vehicle: str | None = None,
    terrain: list[str] | None = None,
    effects: str | None = None,
    significance: float = 0.05,
    source: Annotated[
        str, typer.Option("--input", help="What drives the twin: auto, command, wheels.")
    ] = "auto",
    write_vehicle: Path | None = None,
    judge: bool = False,
    seed: Annotated[int, typer.Option(min=0, help="Of replicates.")] = 0,
    explain: ExplainOption = None,
    *,
    how: common.HowRead,
) -> Result:
    """Diagnose where runs differ from reference runs, which effect causes it, and how far the gap shrinks.

    Writes diagnosis.json and report.html. No truth channel is read.

    Example: terrafusion gap today/a today/b --reference may/1 --reference may/2 --vehicle elevate --out gap

    Args:
        reference (REF): Runs that count as normal; repeat for more. None: twin.
        vehicle: The twin's vehicle, by name or YAML file. Default: the logs'.
        terrain (SOIL|LABEL=SOIL): Ground of all logs, or of one label.
        effects: Candidates by name, with commas. Default: the whole catalogue.
        significance: False alarms accepted, 0.001 to 0.5.
        write_vehicle (FILE): Write the vehicle's file with the effect in it.
        judge: Also compare the estimator on these logs and on the twin's.
    """
    from terrafusion.fusion.reports.gap import write_diagnosis
    from terrafusion.fusion.reports.gap_text import answer, details, verdict_line
    from terrafusion.twin.gap.answer.corrected import write_corrected
    from terrafusion.twin.gap.diagnose import diagnose
    from terrafusion.twin.model.choose import vehicle_of_logs
    from terrafusion.twin.model.vehicle import load_vehicle

    rig = common.load_rig(vehicle)
    judged, normal = (_opened_by_name(names, how, rig) for names in (runs, reference or []))
    named, assumed = vehicle_of_logs([*judged, *normal], vehicle)
    robot = str(named)
    with common.progress_bar("comparing") as progress:
        found = diagnose(
            judged, normal, load_vehicle(robot), parse_terrain(terrain),
            effects=None if effects is None else split(effects), significance=significance, source=source,
            seed=seed, progress=progress,
        )  # fmt: skip
    found = dataclasses.replace(found, notes=(*assumed, *found.notes))
    scores = None
    if judge:
        from terrafusion.fusion.benchmark.estimator_gap import estimator_gap, estimator_scorer

        scores = estimator_gap(found, judged, normal, estimator_scorer(robot), seed)
    compared = [] if scores is None else [_line(score) for score in scores[0]]
    write_diagnosis(out, found, {"command": common.command_line()}, scores)
    changes = [] if write_vehicle is None else write_corrected(found, robot, write_vehicle)
    written = write_vehicle if changes and found.verdict.named else None
    lines = answer(found, out, written)
    if write_vehicle is not None and written is None:
        lines.append(f"No effect was named, so {write_vehicle} was not written.")
    document = common.read_json(out / "diagnosis.json")
    more, short = [*changes, *details(found)], f"{verdict_line(found)} Written to {out}"
    return Result([*compared, *lines], "", document, details=more, short=short)


def _opened_by_name(names: list[str], how: common.HowRead, rig: Rig | None) -> list[Recording]:
    """The logs, each called as it was given: drives of one scenario share the name in their files."""
    found: list[Recording] = []
    for name in names:
        logs = how.open_all([name], rig)
        called = [name] if len(logs) == 1 else [f"{name}#{i}" for i in range(len(logs))]
        found += [dataclasses.replace(log, name=own) for log, own in zip(logs, called, strict=True)]
    return found


def _line(compared: Compared) -> str:
    values = {
        "references": compared.references, "runs": compared.runs, "their twin": compared.twin,
        "twin with the effect": compared.corrected,
    }  # fmt: skip
    listed = [f"{name} {value:.3g}" for name, value in values.items() if value is not None]
    return f"{compared.score}: {', '.join(listed)}"
