"""`report.html`: one file with the numbers, the plots and the reasons, for one run or several of one drive.

Nothing in it points outside: plots are SVG inside the file, there is no
script. Everything that comes from a log is escaped.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
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
from terrafusion.fusion.reports import replay_text as words
from terrafusion.fusion.reports.page import bullets, figure, table, where_from, write_page
from terrafusion.fusion.reports.plots import replay as plots
from terrafusion.fusion.reports.plots import replay_filter as plots_filter
from terrafusion.fusion.reports.plots import replay_map as plots_map
from terrafusion.fusion.reports.plots import replay_states as plots_states
from terrafusion.fusion.reports.plots import style

MOST_REASONS = 20
"""How many of the changes of weight the report lists; `weights.jsonl` has them all."""
MOST_MARKS = 45
"""So many numbers fit side by side above a plot."""


@dataclass(frozen=True, eq=False)
class ReportRun:
    """One run of the drive: its name in the report, the content of `metrics.json`, and what is plotted."""

    name: str
    metrics: Mapping[str, Any]
    estimate: Estimate
    scores: Scores


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
) -> Path:
    """Write the report to `path`.

    Args:
        runs: at least one; of several, the adaptive one (else the first) is shown in detail.
        recording: the drive they all estimate.
        held_out: the fixes kept back from all of them.
        outages: the stretches without GNSS.
        wheel_radius_m: to show the speed of wheels logged in rad/s.
        provenance: further lines for the last section, such as the command line and hashes of inputs.

    Raises:
        TerrafusionError: the file cannot be written.
    """
    if not runs:
        raise ValueError("a report needs at least one run")
    ours, theirs = words.pick_pair([run.metrics for run in runs])
    shown = runs[ours]
    marked = plots.important_changes(
        shown.estimate.changes, MOST_REASONS, max(2.0, recording.duration_s() / MOST_MARKS)
    )
    body = [
        _head(title, runs, ours, theirs),
        _numbers(runs, ours, theirs),
        _maps(runs, shown, recording, held_out, outages),
        _errors(runs, shown, recording, outages),
        _ground(shown, recording, outages),
        _calibration(runs),
        _weights(shown, recording, marked),
        _sensors(shown, recording, outages, wheel_radius_m),
        _notes(runs),
        _provenance(recording, provenance or {}),
    ]
    return write_page(path, title, body)


def write_replay(out: Path, result: ReplayResult, provenance: Mapping[str, object] | None = None) -> None:
    """All files of one replay in the folder `out`, numbers first, so that they stay if a plot fails.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    write_outputs(out, result.estimate, metrics_of(result), result.recording)
    write_comparison(out / "report.html", f"Replay of {result.recording.name}", [result], provenance)


def write_comparison(
    path: Path, title: str, results: Sequence[ReplayResult], provenance: Mapping[str, object] | None = None
) -> None:
    """One report over several replays of the same drive."""
    first = results[0]
    runs = [ReportRun(r.mode, metrics_of(r), r.estimate, r.scores) for r in results]
    write_report(
        path,
        title,
        runs,
        first.recording,
        held_out=first.held_out,
        outages=first.outages,
        wheel_radius_m=first.vehicle.odometry.wheel_radius_m,
        provenance={"policy": first.policy.name, "policy inputs": first.policy.inputs_sha256}
        | dict(provenance or {}),
    )


def _head(title: str, runs: Sequence[ReportRun], ours: int, theirs: int) -> str:
    every = [run.metrics for run in runs]
    if len(runs) == 1:
        sentences = words.head_of_one(every[0])
    else:
        sentences = words.head_of_many([run.name for run in runs], every, ours, theirs)
    return f'<h1>{escape(title)}</h1>\n<p class="lead">{escape(" ".join(sentences))}</p>'


def _numbers(runs: Sequence[ReportRun], ours: int, theirs: int) -> str:
    compared = len(runs) > 1
    head = ["<th></th>", *(f'<th class="n">{escape(run.name)}</th>' for run in runs)]
    if compared:
        head.append(f"<th>{escape(runs[ours].name)} against {escape(runs[theirs].name)}</th>")
    lines = []
    for row in words.table_rows([run.metrics for run in runs]):
        best = row.best()
        about = f'<span class="about">{escape(row.about)}</span>' if row.about else ""
        cells = [f"<th>{escape(row.label)}{about}</th>"]
        cells += [
            f'<td class="n{" best" if i == best else ""}">{escape(row.text(i))}</td>'
            for i in range(len(runs))
        ]
        if compared:
            verdict, side = row.verdict(ours, theirs)
            cells.append(f'<td><span class="{side}">{escape(verdict)}</span></td>')
        lines.append(f"<tr>{''.join(cells)}</tr>")
    key = (
        '<p class="dim">★ best of the runs; a dash means that it could not be scored.</p>' if compared else ""
    )
    return (
        f'<h2>Numbers</h2>\n<div class="scroll"><table><thead><tr>{"".join(head)}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>{key}"
    )


def _maps(
    runs: Sequence[ReportRun],
    shown: ReportRun,
    recording: Recording,
    held_out: Gnss | None,
    outages: Sequence[Outage],
) -> str:
    parts = []
    if len(runs) > 1:
        fig, _ = plots_map.plot_map_runs(
            {run.name: run.estimate for run in runs},
            recording,
            colours=_colours(runs),
            held_out=held_out,
            outages=outages,
        )
        parts.append(figure(fig, "The paths of all runs, from above."))
    fig, _ = plots_map.plot_map(
        shown.estimate, recording, errors=shown.scores.errors, held_out=held_out, outages=outages
    )
    parts.append(
        figure(
            fig,
            f"The path as estimated ({shown.name}), coloured by the most probable ground. The rings hold "
            "the true position with 86 % probability (two sigma in two dimensions), if the claimed "
            "uncertainty is right: one each ten seconds, one each two seconds without GNSS.",
        )
    )
    return "<h2>Map</h2>\n" + "\n".join(parts)


def _errors(
    runs: Sequence[ReportRun], shown: ReportRun, recording: Recording, outages: Sequence[Outage]
) -> str:
    scored = {run.name: run.scores.errors for run in runs if run.scores.errors is not None}
    if not scored:
        return "<h2>Errors</h2>\n<p>There was nothing to score against.</p>"
    parts = []
    if len(runs) > 1:
        fig, _ = plots_map.plot_error_runs(
            scored, recording.start_ns, colours=_colours(runs), outages=outages
        )
        parts.append(figure(fig, "Horizontal distance between estimate and reference."))
    if shown.scores.errors is not None:
        fig, _ = plots.plot_errors(shown.scores.errors, recording.start_ns, outages=outages)
        reference = words.REFERENCE[shown.scores.against or "truth"]
        parts.append(
            figure(
                fig,
                f"Errors of {shown.name} against {reference}. "
                "An honest estimate stays inside its band about 95 % of the time.",
            )
        )
    return "<h2>Errors</h2>\n" + "\n".join(parts)


def _ground(shown: ReportRun, recording: Recording, outages: Sequence[Outage]) -> str:
    terrain, _ = plots.plot_terrain(shown.estimate, recording.start_ns, recording=recording)
    slip, _ = plots.plot_slip(shown.estimate, recording.start_ns, outages=outages)
    strip = " The strip on top is the log's own label." if recording.terrain is not None else ""
    return "\n".join(
        [
            "<h2>Ground and slip</h2>",
            figure(terrain, f"Probability of each class of ground ({shown.name}).{strip}"),
            figure(slip, "Slip as estimated, with two sigma; the background is the most probable ground."),
            *_skid_steering(shown, recording, outages),
        ]
    )


def _skid_steering(shown: ReportRun, recording: Recording, outages: Sequence[Outage]) -> list[str]:
    if not plots_states.drawn(shown.estimate):
        return []
    fig, _ = plots_states.plot_skid_steering(shown.estimate, recording.start_ns, outages=outages)
    caption = (
        "How the robot turns and drifts sideways, with two sigma. Yaw scale: true over wheel yaw rate, less "
        "one; the effective track is the track over one plus it. Side-slip: lateral over forward speed. "
        "Centre of rotation: ahead of the body's origin."
    )
    return [figure(fig, caption)]


def _calibration(runs: Sequence[ReportRun]) -> str:
    parts = []
    heads = ("state", "value", "sigma", "sigma before", "verdict")
    for run in runs:
        rows = run.metrics.get("calibration", ())
        if rows:
            parts.append(f'<p class="dim">{escape(run.name)}</p>' if len(runs) > 1 else "")
            parts.append(table(heads, [[escape(c) for c in cells(row)] for row in rows], numbers=(1, 2, 3)))
    if not parts:
        return ""
    about = (
        "What the drive tells of the vehicle file, at its end: add the value to the file's. Observed: the "
        "drive has at least halved the sigma the file was trusted with before."
    )
    return "\n".join(["<h2>Calibration</h2>", f"<p>{about}</p>", *parts])


def _weights(shown: ReportRun, recording: Recording, marked: Sequence[WeightChange]) -> str:
    fig, _ = plots.plot_weights(shown.estimate, recording.start_ns, marked=marked)
    caption = f"The noise each sensor was given ({shown.name}): above as 1 sigma, below as a factor."
    if marked:
        caption += " The numbers are those of the table."
    parts = ["<h2>Weights and their reasons</h2>", figure(fig, caption), _reasons(shown, recording, marked)]
    return "\n".join(parts)


def _reasons(shown: ReportRun, recording: Recording, marked: Sequence[WeightChange]) -> str:
    total = len(shown.estimate.changes)
    if not marked:
        return f"<p>No weight changed ({escape(shown.name)}).</p>"
    rows = []
    numbers, told = plots.moments(marked), 0
    for change in marked:
        order = numbers[change.t_ns]
        t_s = (change.t_ns - recording.start_ns) * 1e-9
        when = (f"{order}", f"{t_s:.1f}") if order != told else ("", "")
        told = order
        name, _, why = change.reason.partition(": ")
        if name not in shown.estimate.weights:
            name, why = change.sensor, change.reason
        before, after = (number(float(value)) for value in (change.before, change.after))
        rows.append(
            f'<tr><td class="n">{when[0]}</td><td class="n">{when[1]}</td><td>{escape(name)}</td>'
            f'<td class="n">{before} → {after} {escape(change.unit)}</td><td>{escape(why)}</td></tr>'
        )
    some = "" if total == len(marked) else f" The {len(marked)} largest of {total}; weights.jsonl has all."
    return (
        f'<p class="dim">Changes of weight, in order of time.{some}</p>'
        '<div class="scroll"><table><thead><tr><th class="n">no.</th><th class="n">time, s</th>'
        '<th>weight</th><th class="n">from → to</th><th>reason</th></tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _sensors(
    shown: ReportRun, recording: Recording, outages: Sequence[Outage], wheel_radius_m: float | None
) -> str:
    start = recording.start_ns
    speeds, _ = plots.plot_speeds(shown.estimate, recording, wheel_radius_m=wheel_radius_m, outages=outages)
    biases, _ = plots_filter.plot_biases(shown.estimate, start)
    parts = [
        "<h2>Sensors</h2>",
        figure(speeds, "Forward speed. Where the wheels run ahead of the estimate, they slip."),
        figure(biases, f"Biases of the IMU as estimated ({shown.name}), with two sigma, in body axes."),
    ]
    if shown.estimate.innovations:
        innovations, _ = plots_filter.plot_innovations(shown.estimate, start, outages=outages)
        parts.append(
            figure(
                innovations,
                "Innovations: what each measurement differed from its prediction, over the sigma of that "
                "difference, and the mean of the squares in windows. With right weights 95 % of the dots "
                "and 95 % of the means lie in the grey bands; the bands of the means allow for the "
                "correlation of the samples. A mean above its band: too sure; below: too cautious. "
                "Dots at the edge lie beyond it.",
            )
        )
    return "\n".join(parts)


def _notes(runs: Sequence[ReportRun]) -> str:
    lists = [list(run.metrics.get("notes", ())) for run in runs]
    shared = [note for note in lists[0] if all(note in other for other in lists)]
    items = [escape(note) for note in dict.fromkeys(shared)]
    for run, notes in zip(runs, lists, strict=True):
        items += [
            f"{escape(run.name)}: {escape(note)}" for note in dict.fromkeys(notes) if note not in shared
        ]
    text = bullets(items) if items else "<p>Nothing was noted.</p>"
    return f"<h2>Notes of the run</h2>\n{text}"


def _provenance(recording: Recording, more: Mapping[str, object]) -> str:
    lines: dict[str, object] = {"log": recording.name}
    for label in ("source", "licence", "description"):
        if getattr(recording, label):
            lines[label] = getattr(recording, label)
    lines |= more
    return where_from(lines)


def _colours(runs: Sequence[ReportRun]) -> dict[str, str]:
    """A colour for each run: that of its mode, unless two runs share a mode."""
    modes = [str(run.metrics["mode"]) for run in runs]
    return {
        run.name: style.colour_of(mode if modes.count(mode) == 1 else run.name, style.MODE_COLOURS)
        for run, mode in zip(runs, modes, strict=True)
    }
