"""What a replay leaves behind: the machine-readable files and one report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from terrafusion.fusion.replay import Replay
from terrafusion.fusion.reports.replay.linear_states import calibration
from terrafusion.fusion.reports.replay.outputs import (
    build_metrics,
    final_status,
    terrain_shares,
    write_outputs,
)
from terrafusion.fusion.reports.replay.page import ReportRun, write_report


def metrics_of(result: Replay) -> dict[str, Any]:
    """The content of `metrics.json` (docs/schemas/metrics.schema.json) for one replay."""
    estimate = result.estimate
    return build_metrics(
        log=result.recording.name,
        vehicle=result.vehicle.name,
        mode=result.mode,
        duration_s=result.recording.duration_s(),
        distance_m=estimate.trajectory.path_length_m(),
        realtime_factor=result.realtime_factor(),
        updates=len(estimate.trajectory),
        latencies_ms=result.latencies_ms,
        terrain=terrain_shares(estimate),
        changes=len(estimate.changes),
        rejected={"gnss": result.rejected_gnss, "wheels": result.rejected_wheels},
        scores=result.scores,
        status=final_status(estimate),
        notes=estimate.notes,
        calibration=calibration(estimate),
    )


def write_replay(out: Path, result: Replay, provenance: Mapping[str, object] | None = None) -> None:
    """All files of one replay in the folder `out`, numbers first, so that they stay if a plot fails.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    write_outputs(out, result.estimate, metrics_of(result), result.recording)
    write_comparison(out / "report.html", f"Replay of {result.recording.name}", [result], provenance)


def write_comparison(
    path: Path, title: str, results: Sequence[Replay], provenance: Mapping[str, object] | None = None
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
