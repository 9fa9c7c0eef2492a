"""The study `opponents` as tables and a figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tests.studies.axes import format_axes
from tests.studies.opponents.estimators import MODES, OPPONENTS
from tests.studies.opponents.summary import geometric_mean, losses, median, ratio

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BEST = "best opponent"


@dataclass(frozen=True)
class Cell:
    """Outages of one length on one log with one estimator: errors and paths, m."""

    log: str
    seconds: float
    estimator: str
    known: str
    errors_m: tuple[float, ...]
    distances_m: tuple[float, ...]

    @property
    def median_m(self) -> float:
        return float(np.median(self.errors_m))

    @property
    def percent(self) -> float:
        return float(np.median(100.0 * np.array(self.errors_m) / np.array(self.distances_m)))


@dataclass(frozen=True)
class Compared:
    """A mode beside an opponent on one log."""

    log: str
    seconds: float
    ratio: float


def compared(cells: Sequence[Cell], mode: str, known: str, against: str = BEST) -> list[Compared]:
    """Ratios of medians on all logs and lengths that have both."""
    out = []
    for cell in cells:
        if (cell.estimator, cell.known) != (mode, known):
            continue
        wanted = OPPONENTS if against == BEST else (against,)
        here = [c for c in cells if (c.log, c.seconds) == (cell.log, cell.seconds)]
        theirs = [c.median_m for c in here if c.estimator in wanted]
        if len(theirs) == len(wanted):  # the best of some would flatter
            out.append(Compared(cell.log, cell.seconds, ratio(cell.median_m, min(theirs))))
    return out


def markdown(cells: Sequence[Cell], failures: Sequence[str], missing: int, tasks: int) -> str:
    """Summary, then a table for each state of knowledge and each length."""
    kinds = list(dict.fromkeys(c.known for c in cells if c.estimator in MODES))
    lengths = sorted({c.seconds for c in cells})
    parts = [f"Ratio of median errors to the {BEST}, geometric mean over logs with 95 % interval:"]
    parts += [_line(cells, mode, known, seconds) for known in kinds for mode in MODES for seconds in lengths]
    parts += ["", "The same rule for the opponents, each over the best of the others and a mode:"]
    parts += [
        line for mode in MODES for seconds in lengths for line in _others(cells, mode, kinds[:1], seconds)
    ]
    parts += ["", "The same, to each opponent, all lengths:"]
    parts += [line for known in kinds for mode in MODES for line in _each(cells, mode, known)]
    for known in kinds:
        for seconds in lengths:
            head = f"Outages of {seconds:g} s, {known}; median error in m [95 %], per cent of the distance"
            parts += ["", head, "", *_table(cells, known, seconds)]
    if failures:
        parts += ["", "Failed (counted with the whole distance):", *dict.fromkeys(failures)]
    if missing:
        parts += ["", f"{missing} of {tasks} parts not run yet"]
    return "\n".join(parts)


def _each(cells: Sequence[Cell], mode: str, known: str) -> list[str]:
    """A line an opponent."""
    lines = []
    for name in OPPONENTS:
        ratios = [c.ratio for c in compared(cells, mode, known, name)]
        if ratios:
            lost = f"lost {losses(ratios)} of {len(ratios)}"
            lines.append(f"{mode} / {name}, {known}: {geometric_mean(ratios).text()}, {lost}")
    return lines


def _others(cells: Sequence[Cell], mode: str, known: Sequence[str], seconds: float) -> list[str]:
    """A line an opponent: its ratio to the best of all others, the mode among them."""
    here = [c for c in cells if c.seconds == seconds and (c.estimator in OPPONENTS or c.known in known)]
    medians: dict[str, dict[str, float]] = {}
    for cell in here:
        if cell.estimator in (mode, *OPPONENTS):
            medians.setdefault(cell.log, {})[cell.estimator] = cell.median_m
    logs = [m for m in medians.values() if len(m) == len(OPPONENTS) + 1]
    lines = []
    for name in OPPONENTS if logs else ():
        ratios = [ratio(m[name], min(e for other, e in m.items() if other != name)) for m in logs]
        lost = f"lost {losses(ratios)} of {len(ratios)}"
        lines.append(
            f"{name} / best of the others and {mode}, {seconds:g} s: {geometric_mean(ratios).text()}, {lost}"
        )
    return lines


def _line(cells: Sequence[Cell], mode: str, known: str, seconds: float) -> str:
    ratios = [c.ratio for c in compared(cells, mode, known) if c.seconds == seconds]
    if not ratios:
        return f"{mode}, {known}, {seconds:g} s: not run"
    mean = geometric_mean(ratios)
    lost = f"lost {losses(ratios)} of {len(ratios)}, worst {max(ratios):.2f}"
    return f"{mode}, {known}, {seconds:g} s: {mean.text()}, {lost}"


def _table(cells: Sequence[Cell], known: str, seconds: float) -> list[str]:
    columns = [*OPPONENTS, *MODES]
    lines = [
        "| log | outages | " + " | ".join(columns) + " | " + " | ".join(f"{m} / best" for m in MODES) + " |"
    ]
    lines.append("|" + " --- |" * (2 + len(columns) + len(MODES)))
    here = [c for c in cells if c.seconds == seconds and (c.estimator in OPPONENTS or c.known == known)]
    for log in dict.fromkeys(c.log for c in here):
        mine = {c.estimator: c for c in here if c.log == log}
        count = max(len(c.errors_m) for c in mine.values())
        texts = [_text(mine.get(name)) for name in columns]
        ends = []
        for mode in MODES:
            ratios = {c.log: c.ratio for c in compared(here, mode, known)}
            ends.append(f"{ratios[log]:.2f}" if log in ratios else "")
        lines.append(f"| {log} | {count} | " + " | ".join([*texts, *ends]) + " |")
    return lines


def _text(cell: Cell | None) -> str:
    return "" if cell is None else f"{median(cell.errors_m).text()}, {cell.percent:.1f} %"


RATIOS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Marks of the axis of the picture."""


def picture(cells: Sequence[Cell]) -> Figure:
    """Ratio to the best opponent, a row a log, a panel a state of knowledge."""
    from matplotlib.figure import Figure

    kinds = list(dict.fromkeys(c.known for c in cells if c.estimator in MODES))
    logs = sorted({c.log for c in cells}, reverse=True)
    columns = max(len(kinds), 1)
    figure = Figure(figsize=(3.5 + 4.0 * columns, 1.5 + 0.25 * len(logs)), layout="constrained")
    axes = figure.subplots(1, columns, sharey=True, squeeze=False)
    for ax, known in zip(axes[0], kinds, strict=False):
        for mode, marker in zip(MODES, "os", strict=True):
            for seconds, colour in zip(sorted({c.seconds for c in cells}), ("C0", "C1", "C3"), strict=False):
                found = [c for c in compared(cells, mode, known) if c.seconds == seconds]
                if not found:
                    continue
                rows = [logs.index(c.log) for c in found]
                label = f"{mode}, {seconds:g} s"
                ax.scatter([c.ratio for c in found], rows, 22, colour, marker, alpha=0.75, label=label)
        ax.axvline(1.0, color="0.4", linewidth=1.0)
        ax.set_xscale("log")
        ax.set_xticks(RATIOS, [f"{ratio:g}" for ratio in RATIOS])
        ax.minorticks_off()
        format_axes(ax, x="median error / best opponent", title=known)
        ax.set_yticks(range(len(logs)), logs, fontsize=7)
    if kinds:
        figure.legend(
            *axes[0, 0].get_legend_handles_labels(), fontsize=7, loc="outside lower center", ncols=6
        )
    return figure
