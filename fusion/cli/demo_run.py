"""The main job on a drive the twin makes: simulate, replay fixed and adaptive, compare."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.writers.log_folder import write_log_folder
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.fusion.reports.replay import write_comparison, write_replay
from terrafusion.twin.simulate import simulate

OUTAGE = Outage(75.0, 60.0)
"""GNSS is lost on loose sand and comes back on mud."""


def run_demo(out: Path, seed: int, progress: Callable[[float], None] | None = None) -> list[str]:
    """Simulate, replay twice, write everything into `out`; the comparison as lines of text."""
    log = write_log_folder(simulate("demo", seed=seed), out / "log")
    recording = open_recording(log)
    results = []
    for i, mode in enumerate(("fixed", "adaptive")):
        share = None if progress is None else lambda done, i=i: progress(0.5 * (i + done))
        result = replay(recording, mode=mode, outages=[OUTAGE], progress=share)
        write_replay(out / mode, result)
        results.append(result)
    write_comparison(
        out / "report.html", "Firm ground, loose sand and mud: fixed against adaptive weights", results
    )
    return [*comparison(results), f"report: {out / 'report.html'}"]


def comparison(results: list[ReplayResult]) -> list[str]:
    """A table of the replays, one column each."""
    first = results[0]
    yaw = [r.scores.yaw_rmse_rad for r in results]
    rows: list[tuple[str, list[float | None]]] = [
        ("position error, whole drive (m)", [r.scores.ate_m for r in results]),
        ("median error in the outage (m)", [r.scores.outages[0].median_m for r in results]),
        ("error at the end of the outage (m)", [r.scores.outages[0].end_error_m for r in results]),
        ("heading error (deg)", [None if x is None else math.degrees(x) for x in yaw]),
        ("real-time factor", [r.realtime_factor() for r in results]),
    ]
    lines = [
        f"{first.recording.duration_s():.0f} s over {', '.join(dict.fromkeys(_grounds(first)))}; "
        f"no GNSS from {OUTAGE.start_s:.0f} to {OUTAGE.start_s + OUTAGE.seconds:.0f} s",
        f"{'':36s}" + "".join(f"{r.mode:>12s}" for r in results),
    ]
    for name, values in rows:
        lines.append(f"{name:36s}" + "".join("           -" if v is None else f"{v:12.2f}" for v in values))
    return lines


def _grounds(result: ReplayResult) -> list[str]:
    terrain = result.recording.terrain
    return [] if terrain is None else [str(label) for label in terrain.label]
