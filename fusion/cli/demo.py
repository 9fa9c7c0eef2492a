"""`terrafusion demo`: simulate a drive, replay it with fixed and adaptive weights, compare."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from terrafusion.datasets.core.tables import text_table
from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.common import progress_bar, read_json
from terrafusion.fusion.cli.outputs import Output

if TYPE_CHECKING:
    from terrafusion.fusion.replay import ReplayResult

OUTPUT = Output(
    "Folder for the log, the results and report.html.",
    ("config.json", "log", "fixed", "adaptive", "report.html"),
    ("log/meta.yaml", "fixed/metrics.json"),
)
OUTAGE_START_S, OUTAGE_S = 75.0, 60.0
"""GNSS is lost on loose sand and comes back on mud."""
TITLE = "Firm ground, loose sand and mud: fixed against adaptive weights"


def demo(
    out: Path,
    seed: Annotated[int, typer.Option(help="Seed of the simulated sensors.")] = 0,
) -> Result:
    """Simulate a drive over firm ground, loose sand and mud, and localise it with fixed and adaptive weights.

    One GNSS outage covers the change of terrain. Prints the comparison and writes report.html.

    Example: terrafusion demo --out demo-out
    """
    from terrafusion.datasets.readers import open_recording
    from terrafusion.datasets.writers.log_folder import write_log_folder
    from terrafusion.fusion.metrics.scores import Outage
    from terrafusion.fusion.replay import replay
    from terrafusion.fusion.reports.replay import write_comparison, write_replay
    from terrafusion.twin.simulate import simulate

    with progress_bar("demo") as progress:
        log = write_log_folder(simulate("demo", seed=seed), out / "log")
        recording = open_recording(log)
        results = []
        for i, mode in enumerate(("fixed", "adaptive")):
            share = None if progress is None else lambda done, i=i: progress(0.5 * (i + done))
            outages = [Outage(OUTAGE_START_S, OUTAGE_S)]
            result = replay(recording, mode=mode, outages=outages, progress=share)
            write_replay(out / mode, result)
            results.append(result)
        write_comparison(out / "report.html", TITLE, results)
    document = {result.mode: read_json(out / result.mode / "metrics.json") for result in results}
    return Result(
        _comparison(results), f"report: {out / 'report.html'}", document, vehicle=results[0].vehicle
    )


def _comparison(results: list[ReplayResult]) -> list[str]:
    """A table of the replays, one column each."""
    scores = [r.scores for r in results]
    outages = [s.outages[0] for s in scores]
    yaw = [s.yaw_rmse_rad for s in scores]
    rows: list[tuple[str, list[float | None]]] = [
        ("position error, whole drive (m)", [s.ate_m for s in scores]),
        ("median error in the outage (m)", [o.median_m for o in outages]),
        ("error at the end of the outage (m)", [o.end_error_m for o in outages]),
        ("heading error (deg)", [None if x is None else math.degrees(x) for x in yaw]),
        ("real-time factor", [r.realtime_factor() for r in results]),
    ]
    recording = results[0].recording
    labels = [] if recording.terrain is None else map(str, recording.terrain.label)
    cells = [[name, *("-" if v is None else f"{v:.2f}" for v in values)] for name, values in rows]
    return [
        f"{recording.duration_s():.0f} s over {', '.join(dict.fromkeys(labels))}; "
        f"no GNSS from {OUTAGE_START_S:.0f} to {OUTAGE_START_S + OUTAGE_S:.0f} s",
        *text_table(["", *(r.mode for r in results)], cells, right=(1, 2), gap=4),
        *(line for r in results for line in [f"{r.mode}, {r.verdict.lines()[0]}", *r.verdict.lines()[1:]]),
    ]
