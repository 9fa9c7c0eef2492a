"""The study `known_changes` as tables and a figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tests.studies.axes import format_axes
from tests.studies.opponents.summary import Interval, geometric_mean, ratio

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BEFORE = "before"
ALLOWED = 1.25
"""Largest ratio of median errors, after to before, that is aimed at."""


@dataclass(frozen=True)
class Found:
    """Outages of one log with one change: end errors, m, and shares of errors inside the ellipses."""

    set_name: str
    log: str
    change: str
    told: bool
    errors_m: list[float]
    inside: list[float | None]

    @property
    def median_m(self) -> float:
        return float(np.median(self.errors_m))

    @property
    def share(self) -> float | None:
        """Mean share inside, over outages."""
        known = [x for x in self.inside if x is not None]
        return float(np.mean(known)) if known else None


def ratios(found: Sequence[Found], change: str, told: bool) -> dict[str, float]:
    """Median error after over before, by log."""
    before = {f.log: f.median_m for f in found if f.change == BEFORE}
    mine = [f for f in found if (f.change, f.told) == (change, told) and f.log in before]
    return {f.log: ratio(f.median_m, before[f.log]) for f in mine}


def markdown(found: Sequence[Found], notes: Sequence[str], missing: int, tasks: int) -> str:
    """Over all logs, then by set, then log by log."""
    changes = list(dict.fromkeys(f.change for f in found if f.change != BEFORE))
    head = f"Error in outages, after over before: geometric mean over logs [95 %], aimed at {ALLOWED} or less"
    parts = [head, ""]
    parts += ["| change | logs | not told | told | worst log | inside 95 % ellipses: before | after | told |"]
    parts += ["|" + " --- |" * 8, *(_line(found, change) for change in changes)]
    every = [r for change in changes for r in ratios(found, change, False).values()]
    if every:
        above = f"above {ALLOWED} in {sum(r > ALLOWED for r in every)} of {len(every)}"
        parts += ["", f"all changes, not told: {geometric_mean(every).text()}, {above}"]
    parts += ["", "Errors inside 95 % ellipses by set, before and over all changes", ""]
    parts += ["| set | before | after |", "| --- | --- | --- |"]
    for name in dict.fromkeys(f.set_name for f in found):
        logs = {f.log for f in found if f.set_name == name}
        parts.append(
            f"| {name} | {_share(found, BEFORE, False, logs)} | {_share(found, None, False, logs)} |"
        )
    parts += ["", "Median error in m, log by log (told in brackets)", "", *_by_log(found, changes)]
    if notes:
        parts += ["", "Failed (counted with the whole distance) or not applicable:", *dict.fromkeys(notes)]
    if missing:
        parts += ["", f"{missing} of {tasks} parts not run yet"]
    return "\n".join(parts)


def _line(found: Sequence[Found], change: str) -> str:
    after, told = ratios(found, change, False), ratios(found, change, True)
    worst = max(after, key=lambda log: after[log], default="")
    shares = [_share(found, c, t, set(after)) for c, t in ((BEFORE, False), (change, False), (change, True))]
    where = f"{worst} {after[worst]:.2f}" if worst else ""
    return "| " + " | ".join([change, str(len(after)), _mean(after), _mean(told), where, *shares]) + " |"


def _by_log(found: Sequence[Found], changes: Sequence[str]) -> list[str]:
    logs = list(dict.fromkeys(f.log for f in found))
    table = {(f.log, f.change, f.told): f for f in found}
    lines = ["| change | " + " | ".join(logs) + " |", "|" + " --- |" * (1 + len(logs))]
    for change in (BEFORE, *changes):
        cells = []
        for log in logs:
            after, told = table.get((log, change, False)), table.get((log, change, True))
            cells.append(
                ("" if after is None else f"{after.median_m:.2f}")
                + ("" if told is None else f" ({told.median_m:.2f})")
            )
        lines.append(f"| {change} | " + " | ".join(cells) + " |")
    return lines


def _mean(by_log: dict[str, float]) -> str:
    return geometric_mean(list(by_log.values())).text() if by_log else ""


def _share(found: Sequence[Found], change: str | None, told: bool, logs: set[str]) -> str:
    """Mean share over logs; `change` None: over all changes."""
    shares = [
        f.share
        for f in found
        if f.log in logs
        and f.told == told
        and (f.change == change or (change is None and f.change != BEFORE))
    ]
    known = [x for x in shares if x is not None]
    return f"{100.0 * float(np.mean(known)):.0f} %" if known else ""


def picture(found: Sequence[Found]) -> Figure:
    """Ratio after over before, a row a change, a point a log; the bar is the interval of the mean."""
    from matplotlib.figure import Figure

    changes = list(dict.fromkeys(f.change for f in found if f.change != BEFORE))[::-1]
    figure = Figure(figsize=(7.5, 1.5 + 0.35 * len(changes)), layout="constrained")
    ax = figure.subplots()
    for row, change in enumerate(changes):
        after = list(ratios(found, change, False).values())
        told = list(ratios(found, change, True).values())
        ax.plot(
            after,
            [row] * len(after),
            "o",
            color="C0",
            alpha=0.5,
            markersize=4,
            label="_" if row else "not told",
        )
        ax.plot(
            told,
            [row + 0.2] * len(told),
            "s",
            color="C2",
            alpha=0.5,
            markersize=3,
            label="_" if row else "told",
        )
        mean: Interval | None = geometric_mean(after) if after else None
        if mean is not None and mean.low is not None and mean.high is not None:
            ax.plot([mean.low, mean.high], [row - 0.2] * 2, color="C0", linewidth=2.0)
    ax.axvline(ALLOWED, color="0.4", linewidth=1.0, linestyle="--")
    ax.set_xscale("log")
    ax.set_yticks(range(len(changes)), changes, fontsize=8)
    format_axes(ax, x="median error in outages, after / before")
    ax.legend(fontsize=7)
    return figure
