"""`terrafusion demo`: simulate some drives, replay each with fixed and adaptive weights, compare."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from terrafusion.datasets.core.tables import text_table
from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.common import progress_bar, read_json
from terrafusion.fusion.cli.outputs import Output

if TYPE_CHECKING:
    from terrafusion.datasets.core.recording import Recording
    from terrafusion.fusion.replay import ReplayResult
    from terrafusion.fusion.reports.demo import DemoRun, Table

OUTPUT = Output(
    "Folder for the log, the results and report.html.",
    ("config.json", "log", "fixed", "adaptive", "report.html"),
    ("log/meta.yaml", "fixed/metrics.json"),
)
OUTAGE_START_S, OUTAGE_S = 75.0, 60.0
"""GNSS is lost on loose sand and comes back on mud."""
MODES = ("fixed", "adaptive")
TITLE = "Firm ground, loose sand and mud: fixed against adaptive weights"


def demo(
    out: Path,
    seed: int = 0,
    drives: Annotated[int, typer.Option(min=1, max=100, help="Number of simulated drives.")] = 5,
    jobs: Annotated[int, typer.Option(min=1, help="Processes that work at once.")] = 2,
) -> Result:
    """Simulate drives over firm ground, loose sand and mud; localise each with fixed and adaptive weights.

    The drives differ in the noise of the sensors. One GNSS outage covers the change of terrain. Prints the
    comparison and writes report.html with the errors of all drives and the details of the first.

    Example: terrafusion demo --out demo-out

    Args:
        seed: Seed of the first drive; the others count on.
    """
    from terrafusion.datasets.readers import open_recording
    from terrafusion.datasets.writers.log_folder import write_log_folder
    from terrafusion.fusion.reports.demo import plot_drives, table_of
    from terrafusion.fusion.reports.replay import write_replay, write_report
    from terrafusion.twin.executors import open_workers
    from terrafusion.twin.simulate import simulate

    recording = open_recording(write_log_folder(simulate("demo", seed=seed), out / "log"))
    work: list[tuple[Recording | None, int, str]] = [(recording, seed, mode) for mode in MODES]
    work += [(None, seed + i, mode) for i in range(1, drives) for mode in MODES]
    found: list[tuple[DemoRun, ReplayResult | None]] = []
    with progress_bar("demo") as progress, open_workers("loky", min(jobs, len(work))) as workers:
        for one in workers.results(_replayed, work):
            found.append(one)
            if progress is not None:
                progress(len(found) / len(work))
    runs = [run for run, _ in found]
    by_mode = {result.mode: result for _, result in found if result is not None}
    results = [by_mode[mode] for mode in MODES]
    for result in results:
        write_replay(out / result.mode, result)
    write_report(out / "report.html", TITLE, results, more=lambda sheet: plot_drives(sheet, runs))
    document: dict[str, Any] = {mode: read_json(out / mode / "metrics.json") for mode in MODES}
    table = table_of(runs, results[0].outages[0])
    document["drives"] = {"seeds": [seed + i for i in range(drives)], "errors_m": table}
    return Result(
        _comparison(results, runs, table),
        f"report: {out / 'report.html'}",
        document,
        vehicle=results[0].vehicle,
    )


def _replayed(recording: Recording | None, seed: int, mode: str) -> tuple[DemoRun, ReplayResult | None]:
    """A replay of `recording`, with its details, or of a drive simulated here, without."""
    import numpy as np

    from terrafusion.fusion.estimator.estimator import Estimator
    from terrafusion.fusion.metrics.scores import Outage
    from terrafusion.fusion.replay import replay
    from terrafusion.fusion.reports.demo import DemoRun
    from terrafusion.twin.simulate import simulate

    log = simulate("demo", seed=seed) if recording is None else recording
    odom: list[Any] = []

    def watch(estimator: Estimator) -> None:
        state = estimator.odometry("odom")
        assert state is not None
        odom.append(state.position_m[:2])

    result = replay(log, mode=mode, outages=[Outage(OUTAGE_START_S, OUTAGE_S)], watch=watch)
    errors = result.scores.errors
    assert errors is not None
    run = DemoRun(
        seed,
        mode,
        np.asarray((errors.t_ns - log.start_ns) * 1e-9, dtype=np.float64),
        errors.distance_m(),
        result.estimate.trajectory.position_m[:, :2],
        np.array(odom),
    )
    return run, None if recording is None else result


def _comparison(results: list[ReplayResult], runs: list[DemoRun], table: Table) -> list[str]:
    """Tables of all drives and of the first, one column a mode, and where adaptive does not help."""
    from terrafusion.fusion.reports.demo import cell, where_it_does_not_help

    recording = results[0].recording
    labels = [] if recording.terrain is None else map(str, recording.terrain.label)
    first = min(run.seed for run in runs)
    adaptive = next(run for run in runs if run.seed == first and run.mode == "adaptive")
    steps = [adaptive.largest_step_m(frame) for frame in ("map", "odom")]
    count = len(runs) // len(MODES)
    rows = [
        [f"position error {row} (m)", *(cell(errors[mode]) for mode in MODES)]
        for row, errors in table.items()
    ]
    return [
        f"{count} drives of {recording.duration_s():.0f} s over {', '.join(dict.fromkeys(labels))}; "
        f"no GNSS from {OUTAGE_START_S:.0f} to {OUTAGE_START_S + OUTAGE_S:.0f} s; median [least, largest]",
        *text_table(["", *MODES], rows, right=(1, 2), gap=4),
        where_it_does_not_help(table),
        f"Largest step between keyframes of the first drive, adaptive: {steps[0]:.2f} m in the frame map, "
        f"{steps[1]:.2f} m in odom.",
        "",
        f"The first drive (seed {first}):",
        *_first_drive(results),
    ]


def _first_drive(results: list[ReplayResult]) -> list[str]:
    scores = [r.scores for r in results]
    yaw = [s.yaw_rmse_rad for s in scores]
    rows: list[tuple[str, list[float | None]]] = [
        ("position error, whole drive (m)", [s.ate_m for s in scores]),
        ("heading error (deg)", [None if x is None else math.degrees(x) for x in yaw]),
        ("real-time factor", [r.realtime_factor() for r in results]),
    ]
    cells = [[name, *("-" if v is None else f"{v:.2f}" for v in values)] for name, values in rows]
    return [
        *text_table(["", *(r.mode for r in results)], cells, right=(1, 2), gap=4),
        *(line for r in results for line in [f"{r.mode}, {r.verdict.lines()[0]}", *r.verdict.lines()[1:]]),
    ]
