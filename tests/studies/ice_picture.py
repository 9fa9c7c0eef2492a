"""Picture of the README: a real robot on ice without GNSS, with fixed and with adaptive weights.

A Warthog on an indoor ice rink (`norlab_drive`); fixes are made from the truth of its lidar. Of each
drive the first outage of 30 s; shown is the drive at which the ratio of the two errors is the median.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import median

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from terrafusion.fusion.benchmark.field_logs import outages_of
from terrafusion.fusion.benchmark.outage_plan import aided_by_truth, until
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.fusion.reports.plots import style
from tests.studies.axes import format_axes
from tests.studies.field_runs import read_runs

LOG = "norlab_drive/ice_2024_7_30_16h30s21/windows"
OUTAGE_S, SEED = 30.0, 1
MODES = ("fixed", "adaptive")
Pair = tuple[Outage, tuple[ReplayResult, ...]]


def pairs() -> list[Pair]:
    """Each drive that has an outage of that length, replayed with both modes."""
    found = []
    for recording in read_runs(LOG)[0]:
        aided = aided_by_truth(recording, SEED)
        for outage in [one for one in outages_of(aided, 1) if one.seconds == OUTAGE_S][:1]:
            part = until(aided, outage.start_s + outage.seconds + 0.5)
            found.append((outage, tuple(replay(part, mode=mode, outages=[outage]) for mode in MODES)))
    return found


def end_error_m(result: ReplayResult) -> float:
    """Position error at the end of the outage, m."""
    error = result.scores.outages[0].end_error_m
    assert error is not None
    return error


def draw(shown: Pair, every: list[Pair]) -> Figure:
    """The paths of one drive, and the errors at the end of the outage of all."""
    fig = Figure(figsize=(9.0, 4.2), layout="constrained")
    left, right = fig.subplots(1, 2, width_ratios=(1.6, 1.0))
    _draw_paths(left, shown)
    for _, results in every:
        bold = results is shown[1]
        errors = [end_error_m(result) for result in results]
        right.plot(
            MODES, errors, "o-", color=style.TRUTH if bold else "#b0b0b0", linewidth=2.0 if bold else 1.0
        )
    right.set_xlim(-0.4, 1.4)
    right.set_ylim(bottom=0.0)
    format_axes(right, y="error after 30 s without GNSS, m", title=f"all {len(every)} drives")
    return fig


def _draw_paths(ax: Axes, shown: Pair) -> None:
    outage, results = shown
    errors = results[0].scores.errors
    assert errors is not None
    ax.plot(*errors.reference_m.T, color=style.TRUTH, linestyle="--", label="true path (lidar)")
    for mode, result in zip(MODES, results, strict=True):
        path = result.estimate.trajectory
        inside = outage.covers(path.t_ns, result.recording.start_ns)
        x, y = path.position_m[:, 0], path.position_m[:, 1]
        colour = style.MODE_COLOURS[mode]
        ax.plot(x, y, color=colour, linewidth=1.0)
        ax.plot(x[inside], y[inside], color=colour, linewidth=3.0, label=f"{mode}, thick: no GNSS")
        ax.plot(x[inside][-1], y[inside][-1], "o", color=colour, markersize=8)
    ax.set_aspect("equal", adjustable="datalim")
    format_axes(ax, x="east, m", y="north, m", title="Warthog on an ice rink")
    ax.legend(loc="best", fontsize=8, frameon=False)


def main() -> None:
    """Print the errors, draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of ice_picture.png")
    given = parser.parse_args()
    every = pairs()
    print("drive  fixed, m  adaptive, m")
    for number, (_, results) in enumerate(every):
        print(f"{number:5d} {end_error_m(results[0]):9.2f} {end_error_m(results[1]):12.2f}")
    middle = [median(end_error_m(results[i]) for _, results in every) for i in range(2)]
    won = sum(end_error_m(b) < end_error_m(a) for _, (a, b) in every)
    found = f"fixed {middle[0]:.2f} m, adaptive {middle[1]:.2f} m; adaptive better in {won}"
    print(f"median of {len(every)}: {found}")
    ranked = sorted(every, key=lambda pair: end_error_m(pair[1][1]) / end_error_m(pair[1][0]))
    given.out.mkdir(parents=True, exist_ok=True)
    draw(ranked[len(ranked) // 2], every).savefig(given.out / "ice_picture.png", dpi=110)


if __name__ == "__main__":
    main()
