"""Several drives of the demo in one picture, one table and one sentence."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Plot, Sheet

FIXED, ADAPTIVE = "fixed", "adaptive"
ODOM = "#009e73"
EQUAL, EQUAL_M = 0.05, 0.005
"""Differences, relative and in metres, below which two errors count as equal: the table shows centimetres."""


@dataclass(frozen=True, eq=False)
class DemoRun:
    """One replay of one simulated drive.

    Attributes:
        seed, mode: which.
        t_s, error_m: (n,) seconds from the start, and horizontal distance to the truth.
        path_m, odom_m: (k, 2) path in the frames `map` and `odom` (REP-105), at the same keyframes.
    """

    seed: int
    mode: str
    t_s: Array
    error_m: Array
    path_m: Array
    odom_m: Array

    def errors(self, outage: Outage) -> dict[str, float]:
        """Median error with GNSS, median in the outage and error at its end, m."""
        end_s = outage.start_s + outage.seconds
        inside = (self.t_s >= outage.start_s) & (self.t_s <= end_s)
        last = int(np.flatnonzero(inside)[-1])
        return {
            "with GNSS": float(np.nanmedian(self.error_m[~inside])),
            "in the outage": float(np.nanmedian(self.error_m[inside])),
            "at the end of the outage": float(self.error_m[last]),
        }

    def largest_step_m(self, frame: str) -> float:
        """Largest step between keyframes in the frame "map" or "odom"."""
        path = self.path_m if frame == "map" else self.odom_m
        return float(np.hypot(*np.diff(path, axis=0).T).max())


Table = dict[str, dict[str, list[float]]]
"""Row (of `DemoRun.errors`) -> mode -> errors (m), a drive each, seeds in order."""


def table_of(runs: Sequence[DemoRun], outage: Outage) -> Table:
    """The errors of all drives."""
    found: Table = {}
    for run in sorted(runs, key=lambda run: run.seed):
        for row, error in run.errors(outage).items():
            found.setdefault(row, {}).setdefault(run.mode, []).append(error)
    return found


def cell(errors: Sequence[float]) -> str:
    """Median, and least to largest in brackets."""
    low, high = min(errors), max(errors)
    return f"{np.median(errors):.2f} [{low:.2f}, {high:.2f}]"


def where_it_does_not_help(table: Table) -> str:
    """One sentence: in which rows and drives adaptive weights are no better than fixed ones."""
    even, worse = [], []
    for row, errors in table.items():
        adaptive, fixed = (float(np.median(errors[mode])) for mode in (ADAPTIVE, FIXED))
        if abs(adaptive - fixed) <= max(EQUAL * fixed, EQUAL_M):
            even.append(row)
        elif adaptive > fixed:
            worse.append(row)
    end = table["at the end of the outage"]
    pairs = list(zip(end[ADAPTIVE], end[FIXED], strict=True))
    lost = sum(a > b for a, b in pairs)
    parts = [f"they equal fixed ones {' and '.join(even)}"] if even else []
    parts += [f"they are worse {' and '.join(worse)}"] if worse else []
    parts += [f"{lost} of {len(pairs)} drives end the outage with a larger error"] if lost else []
    if not parts:
        return "Adaptive weights help in every drive shown here; on firm ground they equal fixed ones."
    return f"Where adaptive weights do not help: {'; '.join(parts)}."


def plot_drives(sheet: Sheet, runs: Sequence[DemoRun]) -> None:
    """Position error of all drives over time, median and range of each mode, and onto the map the path of the
    first drive in the odometry frame.
    """
    plot = sheet.add_time("drives", f"position error of {len(runs) // 2} drives, m", 260)
    for mode in (FIXED, ADAPTIVE):
        own = [run for run in runs if run.mode == mode]
        t_s = own[0].t_s[style.thin(len(own[0].t_s))]
        errors = np.array([np.interp(t_s, run.t_s, run.error_m) for run in own])
        colour = style.colour_of(mode, style.MODE_COLOURS)
        band = {"x": t_s, "y1": np.nanmin(errors, 0), "y2": np.nanmax(errors, 0)}
        plot.glyph("varea", band, f"{mode}: range", colour, "area", alpha=0.2)
        plot.line(t_s, np.nanmedian(errors, 0), f"{mode}: median", colour)
    first = min((run for run in runs if run.mode == ADAPTIVE), key=lambda run: run.seed)
    label = f"{ADAPTIVE}, odometry frame"
    x, y = first.odom_m.T
    Plot("map", sheet.panels["map"]).line(x, y, label, ODOM, dash="dashed", width=1.0)
