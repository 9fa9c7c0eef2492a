"""`report.html` of a replay, or of several replays of one drive, and all files of a replay."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.channels import Gnss
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.tables import number
from terrafusion.fusion.estimate.estimate import Estimate, WeightChange
from terrafusion.fusion.metrics.scores import Outage, Scores
from terrafusion.fusion.outputs.linear_states import cells
from terrafusion.fusion.outputs.replay_files import metrics_of, write_outputs
from terrafusion.fusion.replay import ReplayResult
from terrafusion.fusion.reports import replay_text
from terrafusion.fusion.reports.page import write_page
from terrafusion.fusion.reports.plots import replay as plots
from terrafusion.fusion.reports.plots import replay_filter, replay_map, style
from terrafusion.fusion.reports.plots.sheet import Sheet

MOST_CHANGES = 20
"""How many of the weight changes the report lists; `weights.jsonl` has them all."""
MOST_MARKS = 45
"""So many numbers fit side by side above a plot."""


@dataclass(frozen=True, eq=False)
class ReportRun:
    """One run of the drive: its name in the report, the content of `metrics.json`, and what is plotted."""

    name: str
    metrics: Mapping[str, Any]
    estimate: Estimate
    scores: Scores


def write_replay(out: Path, result: ReplayResult, provenance: Mapping[str, object] | None = None) -> None:
    """All files of one replay in the folder `out`, numbers first, so that they stay if a plot fails.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    write_outputs(out, result.estimate, metrics_of(result), result.recording)
    write_comparison(out / "report.html", f"Replay of {result.recording.name}", [result], provenance)


def write_comparison(
    path: Path,
    title: str,
    results: Sequence[ReplayResult],
    provenance: Mapping[str, object] | None = None,
    more: Callable[[Sheet], None] = lambda _: None,
) -> None:
    """One report over several replays of the same drive; see `write_report`."""
    first = results[0]
    policy = {"policy": first.policy.name, "policy inputs": first.policy.inputs_sha256}
    write_report(
        path,
        title,
        [ReportRun(r.mode, metrics_of(r), r.estimate, r.scores) for r in results],
        first.recording,
        held_out=first.held_out,
        outages=first.outages,
        wheel_radius_m=first.vehicle.odometry.wheel_radius_m,
        provenance=policy | dict(provenance or {}),
        more=more,
    )


def write_report(
    path: Path,
    title: str,
    runs: Sequence[ReportRun],
    recording: Recording,
    *,
    held_out: Gnss | None = None,
    outages: Sequence[Outage] = (),
    wheel_radius_m: float | None = None,
    provenance: Mapping[str, object] | None = None,
    more: Callable[[Sheet], None] = lambda _: None,
) -> Path:
    """Write the report to `path`.

    Args:
        runs: at least one; of several, the adaptive one (else the first) is shown in detail.
        recording: the drive they all estimate.
        held_out: the fixes held out of all of them.
        outages: the stretches without GNSS.
        wheel_radius_m: to show the speed of wheels logged in rad/s.
        provenance: further lines for the last section, such as the command line and hashes of inputs.
        more: adds the figure "drives" of several drives, to stand first.

    Raises:
        TerrafusionError: the file cannot be written.
    """
    if not runs:
        raise ValueError("a report needs at least one run")
    names, metrics = [run.name for run in runs], [run.metrics for run in runs]
    pair = replay_text.pick_pair(metrics)
    shown, compared = runs[pair[0]], len(runs) > 1
    if compared:
        lead = replay_text.summary_of_many(names, metrics, *pair)
    else:
        lead = replay_text.summary_of_one(metrics[0])
    apart_s = max(2.0, recording.duration_s() / MOST_MARKS)
    marked = plots.important_changes(shown.estimate.changes, MOST_CHANGES, apart_s)
    rows = replay_text.score_rows(metrics)
    sheet, innovations = _draw(runs, shown, recording, held_out, outages, wheel_radius_m, marked)
    more(sheet)
    labelled = recording.terrain is not None
    calibrations = {run.name: [cells(row) for row in run.metrics.get("calibration", ())] for run in runs}
    return write_page(
        path, "replay.html.j2", title, lead=" ".join(lead), provenance=_provenance(recording, provenance),
        runs=runs, shown=shown, other=runs[pair[1]], pair=pair, compared=compared,
        scores=rows, baselines=replay_text.shown_baselines(rows),
        tiles=replay_text.tiles(rows, names, pair[0]), **sheet.parts(), innovations=innovations,
        verdicts=replay_text.verdicts(names, metrics), assumed=_assumed(runs),
        reference=replay_text.REFERENCE[shown.scores.against or "truth"],
        label_strip=" The strip on top is the log's own label." if labelled else "",
        calibrations={name: rows for name, rows in calibrations.items() if rows},
        changes=_change_rows(shown.estimate, recording.start_ns, marked),
        changes_total=len(shown.estimate.changes), notes=_notes(runs),
    )  # fmt: skip


def _draw(
    runs: Sequence[ReportRun],
    shown: ReportRun,
    recording: Recording,
    held_out: Gnss | None,
    outages: Sequence[Outage],
    wheel_radius_m: float | None,
    marked: Sequence[WeightChange],
) -> tuple[Sheet, list[str]]:
    """All figures, and the keys of those of the innovations."""
    estimate = shown.estimate
    estimates = {run.name: run.estimate for run in runs}
    colours = _colours(runs)
    scored = {run.name: run.scores.errors for run in runs if run.scores.errors is not None}
    sheet = Sheet(_duration_s(estimates, recording), outages, recording.start_ns)
    replay_map.plot_map(sheet, estimates, shown.name, recording, colours, errors=scored, held_out=held_out)
    if scored:
        plots.plot_error_runs(sheet, scored, colours)
    plots.plot_slip(sheet, estimates, shown.name, colours)
    if shown.name in scored:
        plots.plot_errors(sheet, scored[shown.name])
    plots.plot_terrain(sheet, estimate, recording)
    plots.plot_skid_steering(sheet, estimate)
    plots.plot_weights(sheet, estimate, marked=marked)
    plots.plot_speeds(sheet, estimate, recording, wheel_radius_m=wheel_radius_m)
    replay_filter.plot_biases(sheet, estimate)
    return sheet, replay_filter.plot_innovations(sheet, estimate)


def _colours(runs: Sequence[ReportRun]) -> dict[str, str]:
    """The colour of each run: that of its mode, unless two runs share a mode."""
    modes = [str(run.metrics["mode"]) for run in runs]
    keys = [mode if modes.count(mode) == 1 else run.name for run, mode in zip(runs, modes, strict=True)]
    return {run.name: style.colour_of(key, style.MODE_COLOURS) for run, key in zip(runs, keys, strict=True)}


def _duration_s(estimates: Mapping[str, Estimate], recording: Recording) -> float:
    """From the start of the recording to the end of it and of all estimates."""
    ends = [int(one.trajectory.t_ns[-1]) for one in estimates.values() if len(one.trajectory)]
    return max([recording.duration_s(), *((end - recording.start_ns) * 1e-9 for end in ends)])


def _change_rows(estimate: Estimate, start_ns: int, marked: Sequence[WeightChange]) -> list[list[str]]:
    """Number and time (once for changes at the same time), weight, values and reason of each change."""
    rows: list[list[str]] = []
    numbers, previous = plots.change_numbers(marked), 0
    for change in marked:
        k = numbers[change.t_ns]
        when = [str(k), f"{(change.t_ns - start_ns) * 1e-9:.1f}"] if k != previous else ["", ""]
        previous = k
        name, _, reason = change.reason.partition(": ")
        if name not in estimate.weights:
            name, reason = change.sensor, change.reason
        before, after = number(float(change.before)), number(float(change.after))
        rows.append([*when, name, f"{before} → {after} {change.unit}".rstrip(), reason])
    return rows


def _assumed(runs: Sequence[ReportRun]) -> list[list[str]]:
    """Name, value, sigma and unit of each number that was assumed; the runs of one report share them."""
    return [
        [one["name"], _short(one["value"]), "" if one["sigma"] is None else _short(one["sigma"]), one["unit"]]
        for one in runs[0].metrics.get("assumed", ())
    ]


def _short(value: object) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(_short, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _notes(runs: Sequence[ReportRun]) -> list[str]:
    """The notes that all runs share, then those of single runs with the name of the run."""
    lists = {run.name: list(dict.fromkeys(run.metrics.get("notes", ()))) for run in runs}
    shared = [note for note in lists[runs[0].name] if all(note in notes for notes in lists.values())]
    return shared + [
        f"{name}: {note}" for name, notes in lists.items() for note in notes if note not in shared
    ]


def _provenance(recording: Recording, more: Mapping[str, object] | None) -> dict[str, object]:
    facts = {label: getattr(recording, label) for label in ("source", "licence", "description")}
    return {"log": recording.name} | {k: v for k, v in facts.items() if v} | dict(more or {})
