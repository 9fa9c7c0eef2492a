"""`report.html` of a replay, or of several replays of one drive, and all files of a replay."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.tables import number
from terrafusion.fusion.estimate.estimate import Estimate, WeightChange
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


def write_replay(out: Path, result: ReplayResult, provenance: Mapping[str, object] | None = None) -> None:
    """All files of one replay in the folder `out`, numbers first, so that they stay if a plot fails.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    write_outputs(out, result.estimate, metrics_of(result), result.recording)
    write_report(out / "report.html", f"Replay of {result.recording.name}", [result], provenance)


def write_report(
    path: Path,
    title: str,
    results: Sequence[ReplayResult],
    provenance: Mapping[str, object] | None = None,
    more: Callable[[Sheet], None] = lambda _: None,
) -> Path:
    """Write the report of one replay, or of replays of one drive in several modes, to `path`.

    Args:
        results: at least one; of several, the adaptive one (else the first) is shown in detail.
        provenance: further lines for the last section, such as the command line.
        more: adds the figure "drives" of several drives, to stand first.

    Raises:
        TerrafusionError: the file cannot be written.
    """
    first, compared = results[0], len(results) > 1
    recording, names = first.recording, [result.mode for result in results]
    metrics = [metrics_of(result) for result in results]
    pair = replay_text.pick_pair(metrics)
    shown = results[pair[0]]
    if compared:
        lead = replay_text.summary_of_many(names, metrics, *pair)
    else:
        lead = replay_text.summary_of_one(metrics[0])
    apart_s = max(2.0, recording.duration_s() / MOST_MARKS)
    marked = plots.important_changes(shown.estimate.changes, MOST_CHANGES, apart_s)
    rows = replay_text.score_rows(metrics)
    sheet, innovations = _draw(results, shown, marked)
    more(sheet)
    calibrations = {m["mode"]: [cells(row) for row in m["calibration"]] for m in metrics}
    return write_page(
        path, "replay.html.j2", title, lead=" ".join(lead), provenance=_provenance(first, provenance),
        grounds_known=style.grounds_known(shown.estimate),
        names=names, shown=shown, other=names[pair[1]], pair=pair, compared=compared,
        scores=rows, baselines=replay_text.shown_baselines(rows),
        tiles=replay_text.tiles(rows, names, pair[0]), **sheet.parts(), innovations=innovations,
        verdicts=replay_text.verdicts(names, metrics), assumed=_assumed(metrics[0]),
        reference=replay_text.REFERENCE[shown.scores.against or "truth"],
        label_strip=" The strip on top is the log's own label." if recording.terrain is not None else "",
        calibrations={name: rows for name, rows in calibrations.items() if rows},
        changes=_change_rows(shown.estimate, recording.start_ns, marked),
        changes_total=len(shown.estimate.changes), notes=_notes(metrics),
    )  # fmt: skip


def _draw(
    results: Sequence[ReplayResult], shown: ReplayResult, marked: Sequence[WeightChange]
) -> tuple[Sheet, list[str]]:
    """All figures, and the keys of those of the innovations."""
    first, estimate = results[0], shown.estimate
    recording = first.recording
    estimates = {result.mode: result.estimate for result in results}
    colours = {mode: style.colour_of(mode, style.MODE_COLOURS) for mode in estimates}
    scored = {result.mode: errors for result in results if (errors := result.scores.errors) is not None}
    sheet = Sheet(_duration_s(estimates, recording), first.outages, recording.start_ns)
    replay_map.plot_map(
        sheet, estimates, shown.mode, recording, colours, errors=scored, held_out=first.held_out
    )
    if scored:
        plots.plot_error_runs(sheet, scored, colours)
    plots.plot_slip(sheet, estimates, shown.mode, colours)
    if shown.mode in scored:
        plots.plot_errors(sheet, scored[shown.mode])
    plots.plot_terrain(sheet, estimate, recording)
    plots.plot_skid_steering(sheet, estimate)
    plots.plot_weights(sheet, estimate, marked=marked)
    plots.plot_speeds(sheet, estimate, recording, first.vehicle.odometry.wheel_radius_m)
    replay_filter.plot_biases(sheet, estimate)
    return sheet, replay_filter.plot_innovations(sheet, estimate)


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


def _assumed(metrics: Mapping[str, Any]) -> list[list[str]]:
    """Name, value, sigma and unit of each number that was assumed."""
    return [
        [one["name"], _short(one["value"]), "" if one["sigma"] is None else _short(one["sigma"]), one["unit"]]
        for one in metrics["assumed"]
    ]


def _short(value: object) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(_short, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _notes(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """The notes that all runs share, then those of single runs with their mode."""
    lists = {metrics["mode"]: list(dict.fromkeys(metrics["notes"])) for metrics in runs}
    shared = [note for note in lists[runs[0]["mode"]] if all(note in notes for notes in lists.values())]
    return shared + [
        f"{name}: {note}" for name, notes in lists.items() for note in notes if note not in shared
    ]


def _provenance(result: ReplayResult, more: Mapping[str, object] | None) -> dict[str, object]:
    facts = {label: getattr(result.recording, label) for label in ("source", "licence", "description")}
    policy = {"policy": result.policy.name, "policy inputs": result.policy.inputs_sha256}
    return {"log": result.recording.name} | {k: v for k, v in facts.items() if v} | policy | dict(more or {})
