"""What is kept of one replay: its errors, and on each ground where they come from."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.fusion.benchmark.field_logs import UNFORESEEN
from terrafusion.fusion.benchmark.methods import Method, replay_options
from terrafusion.fusion.benchmark.twin_runs import BenchmarkRun
from terrafusion.fusion.metrics.consistency import estimated_ground_at, position, summarise
from terrafusion.fusion.metrics.error_series import Errors
from terrafusion.fusion.metrics.health import examine_estimate
from terrafusion.fusion.metrics.scores import OutageScore
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.fusion.terrain.classifier import UNKNOWN

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]


@dataclass(frozen=True)
class GroundScore:
    """One replay on one true ground, inside the outage.

    Attributes:
        seconds: spent there.
        forward_mps, side_mps: root mean square of the velocity error along and across the robot.
        heading_mps: that of speed times heading error: how fast a wrong heading moves the position.
        recognised: share of the time in which the ground in force was the true one, or "unknown" where the
            policy does not know the true one.
        nees, effective: of the position per dimension, over the whole drive; independent samples it is worth.
        nees_outage, effective_outage: the same inside the outage.
    """

    ground: str
    seconds: float
    forward_mps: float | None
    side_mps: float | None
    heading_mps: float | None
    recognised: float | None
    nees: float | None
    effective: float | None
    nees_outage: float | None
    effective_outage: float | None


@dataclass(frozen=True)
class RunScore:
    """One drive with one arm.

    Attributes:
        error_m: root mean square of the position error inside the outage (of a whole log without one:
            over all of it); None without a reference.
        end_m, percent: error at the outage's end, and over the way driven in it.
        nees: mean in the outage, per dimension.
        switch_s: mean time from a change of the true ground in the outage until the ground in force is the
            new one, or changes again.
        diverged: why the estimate cannot be of the drive, "" where it can.
        failed: why there is no estimate.
    """

    family: str
    plant: str
    unit: str
    drive: str
    arm: str
    outage_s: float | None = None
    distance_m: float | None = None
    error_m: float | None = None
    end_m: float | None = None
    percent: float | None = None
    nees: float | None = None
    heading_rad: float | None = None
    switch_s: float | None = None
    seconds: float | None = None
    diverged: str = ""
    failed: str = ""
    grounds: tuple[GroundScore, ...] = ()

    @classmethod
    def read(cls, raw: dict[str, Any]) -> RunScore:
        """A row from its JSON object."""
        return cls(**{**raw, "grounds": tuple(GroundScore(**ground) for ground in raw["grounds"])})


def measure(drive: BenchmarkRun, arm: Method) -> RunScore | None:
    """Replay a drive with an arm; None where the arm needs labels that the drive does not have."""
    empty = RunScore(drive.family, drive.plant, drive.unit, drive.name, arm.name)
    options = replay_options(arm, drive.labels, drive.seed)
    if options is None:
        return None
    try:
        result = replay(drive.recording, outages=[drive.outage] if drive.outage else [], **options)
    except TerrafusionError as error:
        return dataclasses.replace(empty, failed=str(error))
    except UNFORESEEN as error:
        return dataclasses.replace(empty, failed=f"{type(error).__name__}: {error}")
    return _measured(empty, drive, result)


def _measured(row: RunScore, drive: BenchmarkRun, result: ReplayResult) -> RunScore:
    assert drive.recording.wheels is not None
    radius_m = result.vehicle.rig().wheel_radius_m
    health = examine_estimate(result.estimate, drive.recording.wheels, radius_m)
    row = dataclasses.replace(row, diverged=health.why, seconds=result.seconds, distance_m=health.path_m)
    errors = result.scores.errors
    if errors is None:
        return row
    distance = errors.distance_m()
    inside = np.ones(len(distance), bool)
    if drive.outage is not None:
        inside = drive.outage.covers(errors.t_ns, drive.recording.start_ns)
        row = _with_outage(row, result.scores.outages[0])
    row = dataclasses.replace(row, error_m=_rms(distance[inside]))
    if drive.labels is None:
        return row
    # The labels, not the channel: a log's own name of its terrain counts as one, too.
    true = np.array([drive.labels.at(t) for t in errors.t_ns.tolist()])
    known = load_policy().names()
    right = np.where(np.isin(true, known), true, UNKNOWN) == estimated_ground_at(result.estimate, errors.t_ns)
    return dataclasses.replace(
        row,
        switch_s=switch_delay_s(errors.t_ns[inside], true[inside], right[inside]),
        grounds=tuple(_by_ground(errors, true, right, inside, drive.recording.start_ns)),
    )


def switch_delay_s(t_ns: NDArray[np.int64], true: NDArray[Any], right: Rows) -> float | None:
    """Mean time from a change of `true` (N,) until `right`, at most to the next change; None without one."""
    changes = np.flatnonzero(true[1:] != true[:-1]) + 1
    delays = []
    for first, end in itertools.pairwise([*changes, len(true)]):
        seen = np.flatnonzero(right[first:end])
        last = first + seen[0] if len(seen) else end - 1
        delays.append((t_ns[last] - t_ns[first]) * 1e-9)
    return float(np.mean(delays)) if delays else None


def _with_outage(row: RunScore, outage: OutageScore) -> RunScore:
    return dataclasses.replace(
        row,
        outage_s=outage.seconds,
        distance_m=outage.distance_m,
        end_m=outage.end_error_m,
        percent=outage.percent,
        nees=outage.nees_mean,
        heading_rad=outage.end_yaw_error_rad,
    )


def _by_ground(
    errors: Errors, true: NDArray[Any], right: Rows, inside: Rows, start_ns: int
) -> list[GroundScore]:
    whitened = position(errors)
    speed = np.gradient(errors.path_m(), errors.t_ns * 1e-9) if len(errors.t_ns) > 1 else np.zeros(1)
    step_s = float(np.median(np.diff(errors.t_ns))) * 1e-9 if len(errors.t_ns) > 1 else 0.0
    rows = []
    for ground in dict.fromkeys(true.tolist()):
        here = true == ground
        lost = here & inside
        whole = summarise(whitened, here, start_ns)
        outage = summarise(whitened, lost, start_ns)
        rows.append(
            GroundScore(
                ground=ground,
                seconds=step_s * float(lost.sum()),
                forward_mps=_rms(errors.velocity_error_mps[lost, 0]),
                side_mps=_rms(errors.velocity_error_mps[lost, 1]),
                heading_mps=_rms((speed * errors.yaw_error_rad())[lost]),
                recognised=float(right[lost].mean()) if lost.any() else None,
                nees=whole.mean if whole else None,
                effective=whole.effective if whole else None,
                nees_outage=outage.mean if outage else None,
                effective_outage=outage.effective if outage else None,
            )
        )
    return rows


def _rms(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else None
