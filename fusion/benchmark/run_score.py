"""Score of one replay: its errors, and on each ground their components."""

import dataclasses
import itertools
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.fusion.benchmark.field_logs import UNFORESEEN
from terrafusion.fusion.benchmark.methods import Method, replay_options
from terrafusion.fusion.benchmark.twin_runs import BenchmarkRun
from terrafusion.fusion.metrics.baselines import rms
from terrafusion.fusion.metrics.consistency import estimated_ground_at, position, summarise
from terrafusion.fusion.metrics.error_series import Errors
from terrafusion.fusion.metrics.health import examine_estimate
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.fusion.terrain.classifier import UNKNOWN

Rows = NDArray[np.bool_]


@dataclass(frozen=True)
class GroundScore:
    """Errors of one replay on one true ground, inside the outage.

    Attributes:
        forward_mps, side_mps: rms of the velocity error along and across the robot.
        heading_mps: rms of speed times heading error, the velocity error that a wrong heading causes.
        recognised: share of the time in which the estimated ground was the true one ("unknown" if the policy
            does not know it).
        nees, effective: of the position per dimension over the whole run, and its effective samples.
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
    """One run with one method.

    Attributes:
        error_m: rms position error inside the outage, or over a whole log; None without a reference.
        end_m, percent: error at the end of the outage, absolute and as percent of the distance in it.
        nees: mean in the outage, per dimension.
        switch_s: mean time from a change of the true ground in the outage to its detection, or to the next
            change.
        diverged: why the estimate is implausible, "" if it is not.
        failed: why there is no estimate.
    """

    family: str
    plant: str
    unit: str
    drive: str
    method: str
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
    def read(cls, raw: dict[str, Any]) -> Self:
        """A score from its JSON object."""
        return cls(**{**raw, "grounds": tuple(GroundScore(**ground) for ground in raw["grounds"])})


def score_run(run: BenchmarkRun, method: Method) -> RunScore | None:
    """Replay a run with a method; None if the method needs labels that the run does not have."""
    score = RunScore(run.family, run.plant, run.unit, run.name, method.name)
    options = replay_options(method, run.labels, run.seed)
    if options is None:
        return None
    try:
        result = replay(run.recording, outages=[run.outage] if run.outage else [], **options)
    except TerrafusionError as error:
        return dataclasses.replace(score, failed=str(error))
    except UNFORESEEN as error:
        return dataclasses.replace(score, failed=f"{type(error).__name__}: {error}")
    return _with_errors(score, run, result)


def _with_errors(score: RunScore, run: BenchmarkRun, result: ReplayResult) -> RunScore:
    recording, errors = run.recording, result.scores.errors
    assert recording.wheels is not None
    health = examine_estimate(result.estimate, recording.wheels, result.vehicle.rig().wheel_radius_m)
    score = dataclasses.replace(score, diverged=health.why, seconds=result.seconds, distance_m=health.path_m)
    if errors is None:
        return score
    distance = errors.distance_m()
    inside = np.ones(len(distance), bool)
    if run.outage is not None:
        inside, outage = run.outage.covers(errors.t_ns, recording.start_ns), result.scores.outages[0]
        score = dataclasses.replace(
            score,
            outage_s=outage.seconds,
            distance_m=outage.distance_m,
            end_m=outage.end_error_m,
            percent=outage.percent,
            nees=outage.nees_mean,
            heading_rad=outage.end_yaw_error_rad,
        )
    score = dataclasses.replace(score, error_m=rms(distance[inside]))
    if run.labels is None:
        return score
    # Labels, not the terrain channel: they include the terrain name of a whole log.
    true = np.array([run.labels.at(t) for t in errors.t_ns.tolist()])
    known = np.where(np.isin(true, load_policy().names()), true, UNKNOWN)
    right = known == estimated_ground_at(result.estimate, errors.t_ns)
    return dataclasses.replace(
        score,
        switch_s=switch_delay_s(errors.t_ns[inside], true[inside], right[inside]),
        grounds=tuple(_by_ground(errors, true, right, inside, recording.start_ns)),
    )


def switch_delay_s(t_ns: NDArray[np.int64], true: NDArray[Any], right: Rows) -> float | None:
    """Mean time from a change of `true` (N,) until `right`, limited by the next change; None without one."""
    changes = np.flatnonzero(true[1:] != true[:-1]) + 1
    delays = []
    for first, end in itertools.pairwise([*changes, len(true)]):
        seen = np.flatnonzero(right[first:end])
        last = first + seen[0] if len(seen) else end - 1
        delays.append((t_ns[last] - t_ns[first]) * 1e-9)
    return float(np.mean(delays)) if delays else None


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
                forward_mps=rms(errors.velocity_error_mps[lost, 0]),
                side_mps=rms(errors.velocity_error_mps[lost, 1]),
                heading_mps=rms((speed * errors.yaw_error_rad())[lost]),
                recognised=float(right[lost].mean()) if lost.any() else None,
                nees=whole.mean if whole else None,
                effective=whole.effective if whole else None,
                nees_outage=outage.mean if outage else None,
                effective_outage=outage.effective if outage else None,
            )
        )
    return rows
