"""The field table as files: CSV of runs and of lines, markdown, and one figure."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from terrafusion.datasets.core.files import write_atomically
from terrafusion.fusion.reports.plots import style
from tests.studies.axes import format_axes
from tests.studies.field_table.summary import (
    OWN,
    BaselineComparison,
    Line,
    compare_with_baselines,
    condense,
    in_order,
    verdicts,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from terrafusion.fusion.benchmark.field_logs import Refusal
    from tests.studies.field_table.table import Run

LEAST_SHOWN_M = 0.01


def write(out: Path, runs: Sequence[Run], refusals: Sequence[Refusal]) -> str:
    """Write `runs.csv`, `lines.csv`, `refused.csv`, `field_table.md` and, with errors, `field_table.png`.

    Returns the markdown.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    lines = condense(runs)
    text = markdown(lines, refusals, compare_with_baselines(runs))
    for name, rows in (("runs", runs), ("lines", lines), ("refused", refusals)):
        write_atomically(out / f"{name}.csv", lambda path, rows=rows: _csv(path, rows))  # type: ignore[misc]
    write_atomically(out / "field_table.md", lambda path: path.write_text(text, encoding="utf-8"))
    if any(line.error_m is not None for line in lines):
        figure = plot_lines(lines)
        write_atomically(out / "field_table.png", lambda path: figure.savefig(path, format="png", dpi=110))
    return text


def markdown(
    lines: Sequence[Line], refusals: Sequence[Refusal], compared: Sequence[BaselineComparison] = ()
) -> str:
    """Four tables (verdicts, each baseline, scored logs, logs without reference) and the refused logs."""
    scored = [line for line in lines if line.error_m is not None]
    others = [line for line in lines if line.error_m is None]
    parts = []
    if any(line.mode == OWN and line.ratio is not None for line in lines):
        parts.append(f"## {OWN.capitalize()} against the best baseline\n\n{_verdict_table(lines)}")
    if compared:
        head = [field.name.replace("_", " ") for field in dataclasses.fields(BaselineComparison)]
        rows = [dataclasses.astuple(row) for row in compared]
        parts.append(f"## {OWN.capitalize()} against each baseline\n\n{_table(head, rows)}")
    if scored:
        parts.append(f"## Scored logs\n\n{_scored_table(scored)}")
    if others:
        parts.append(f"## Logs without a reference\n\n{_health_table(others)}")
    if refusals:
        parts.append("## Not run\n\n" + "".join(f"- {refusal.line}\n" for refusal in refusals))
    return "\n".join(parts)


def plot_lines(lines: Sequence[Line]) -> Figure:
    """Error of each mode in each log: a panel a test, a row a log, logarithmic."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    scored = [line for line in lines if line.error_m is not None]
    tests = sorted({line.test for line in scored}, key=in_order)
    logs = list(dict.fromkeys(line.log for line in scored))
    modes = list(dict.fromkeys(line.mode for line in scored))
    figure = Figure(figsize=(3.2 + 2.0 * len(tests), 1.4 + 0.42 * len(logs)), layout="constrained")
    panels = figure.subplots(1, len(tests), sharex=True, sharey=True, squeeze=False)[0]
    for ax, test in zip(panels, tests, strict=True):
        for number, mode in enumerate(modes):
            found = [line for line in scored if line.test == test and line.mode == mode]
            height = [logs.index(line.log) + 0.16 * (number - 0.5 * (len(modes) - 1)) for line in found]
            error = [max(line.error_m or 0.0, LEAST_SHOWN_M) for line in found]
            colour = style.colour_of(mode, style.MODE_COLOURS)
            ax.plot(error, height, "o", color=colour, markersize=5, label=mode)
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(LogLocator())
        ax.xaxis.set_major_formatter(FuncFormatter(lambda metres, _: f"{metres:g}"))
        ax.xaxis.set_minor_formatter(NullFormatter())
        for row in np.arange(len(logs) - 1) + 0.5:
            ax.axhline(row, color="#eeeeee", linewidth=0.6)
        format_axes(ax, x="error, m", title=test)
    panels[0].set_yticks(range(len(logs)), [f"{log} ({_ground(scored, log)})" for log in logs], fontsize=7)
    panels[0].set_ylim(len(logs) - 0.5, -0.5)
    errors = [max(line.error_m or 0.0, LEAST_SHOWN_M) for line in scored]
    panels[0].set_xlim(10.0 ** np.floor(np.log10(min(errors))), 10.0 ** np.ceil(np.log10(1.01 * max(errors))))
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=len(modes), frameon=False, fontsize=9)
    return figure


def _ground(lines: Sequence[Line], log: str) -> str:
    return next(line.ground for line in lines if line.log == log) or "no label"


def _verdict_table(lines: Sequence[Line]) -> str:
    head = (
        "ground",
        "test",
        "logs",
        "better",
        "worse",
        "significantly worse",
        "mean ratio to the best baseline",
        "largest",
        "% of distance",
    )
    keys = (
        "ground",
        "test",
        "logs",
        "better",
        "worse",
        "significantly_worse",
        "mean_ratio",
        "worst",
        "percent",
    )
    return _table(head, [[row[key] for key in keys] for row in verdicts(lines)])


def _scored_table(lines: Sequence[Line]) -> str:
    """A row a log and test, a column a mode."""
    modes = list(dict.fromkeys(line.mode for line in lines))
    head = ["log", "ground", "reference", "test", "runs", "distance, m", *(f"{mode}, m" for mode in modes),
            f"{OWN} over the best baseline", f"NEES of {OWN}", "diverged"]  # fmt: skip
    rows = []
    for by_mode in _by_test(lines):
        first, own = next(iter(by_mode.values())), by_mode.get(OWN)
        ratio = (
            "-" if own is None or own.ratio is None else f"{own.ratio:.2f}{_interval(own)} ({own.baseline})"
        )
        errors = [by_mode[mode].error_m if mode in by_mode else None for mode in modes]
        rows.append(
            [first.log, first.ground or "-", first.reference, first.test, first.runs, first.distance_m,
             *errors, ratio, own and own.nees, _diverged(by_mode)]
        )  # fmt: skip
    return _table(head, rows)


def _health_table(lines: Sequence[Line]) -> str:
    """A row a log, a column a mode: the path over that of the wheels."""
    modes = list(dict.fromkeys(line.mode for line in lines))
    head = ["log", "ground", "path, m", *(f"{mode}: path over wheels'" for mode in modes),
            "top speed, m/s", "diverged"]  # fmt: skip
    rows = []
    for by_mode in _by_test(lines):
        first = next(iter(by_mode.values()))
        ratios = [by_mode[mode].path_ratio if mode in by_mode else None for mode in modes]
        fastest = max(line.top_speed_mps for line in by_mode.values())
        rows.append([first.log, first.ground or "-", first.distance_m, *ratios, fastest, _diverged(by_mode)])
    return _table(head, rows)


def _by_test(lines: Sequence[Line]) -> list[dict[str, Line]]:
    """The lines of each log and test by mode."""
    groups: dict[tuple[str, str], dict[str, Line]] = {}
    for line in lines:
        groups.setdefault((line.log, line.test), {})[line.mode] = line
    return list(groups.values())


def _interval(line: Line) -> str:
    return "" if line.ratio_low is None else f" [{line.ratio_low:.2f}, {line.ratio_high:.2f}]"


def _diverged(by_mode: dict[str, Line]) -> str:
    """The modes that diverged, and how often where it is not once; "none"."""
    found = [(mode, line.diverged) for mode, line in by_mode.items() if line.diverged]
    return ", ".join(mode if count == 1 else f"{mode} {count}" for mode, count in found) or "none"


def _table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    ruled = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return "\n".join(ruled + ["| " + " | ".join(map(_cell, row)) + " |" for row in rows]) + "\n"


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.2f}"
    return str(value)


def _csv(path: Path, rows: Sequence[Any]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        if rows:
            writer = csv.DictWriter(file, fieldnames=[f.name for f in dataclasses.fields(rows[0])])
            writer.writeheader()
            writer.writerows(dataclasses.asdict(row) for row in rows)
