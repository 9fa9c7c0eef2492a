"""Replay a recording through the estimator as it would have run live, and score it."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from terrafusion.datasets.checks import Finding, run_checks
from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Gnss
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.config.assumptions import Assumption, assumptions
from terrafusion.fusion.config.estimator_config import EstimatorConfig, EstimatorOptions
from terrafusion.fusion.config.sensor_config import sensor_config_of
from terrafusion.fusion.estimate.estimate import Estimate, State
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.feed import feed, never_started, split_fixes, wheels_of, with_usable_samples
from terrafusion.fusion.estimator.history import History
from terrafusion.fusion.estimator.imu_level import ImuLevel
from terrafusion.fusion.estimator.learned_numbers import NumberAfterDrive
from terrafusion.fusion.estimator.notes import notes_of
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.grounds.memory import GroundMemory, after_drive, drive_mark
from terrafusion.fusion.metrics.baselines import Baselines, baselines
from terrafusion.fusion.metrics.judged_run import Run
from terrafusion.fusion.metrics.scores import Outage, Scores, score
from terrafusion.fusion.metrics.verdict import Verdict, judge
from terrafusion.fusion.noise.policy import Policy, load_policy
from terrafusion.twin.model.choose import choose_vehicle
from terrafusion.twin.model.vehicle import VehicleParams


@dataclass(frozen=True, eq=False)
class ReplayResult:
    """One replayed run.

    Attributes:
        estimate, scores: what was estimated, and how well.
        used, held_out: the fixes the estimator was given and was not given.
        seconds: computing time of the estimation alone.
        latencies_ms: computing time of each keyframe (live mode).
        rejected_gnss, rejected_wheels: measurements refused by a gate.
        baselines: plain dead reckoning and the receiver alone on the same log, scored alike.
        verdict: whether the result is good, and why.
        assumed: numbers that neither log nor vehicle file tells.
        learned: numbers of the robot as self-calibration knows them at the end.
        grounds: ground memory after the drive; None where the terrain model knows the robot.
        found_shares: of the time on unknown ground, the share of each ground that the robot found.
    """

    recording: Recording
    vehicle: VehicleParams
    mode: str
    policy: Policy
    estimate: Estimate
    scores: Scores
    used: Gnss | None
    held_out: Gnss | None
    outages: tuple[Outage, ...]
    seconds: float
    latencies_ms: Array
    rejected_gnss: int
    rejected_wheels: int
    baselines: Baselines
    verdict: Verdict
    assumed: tuple[Assumption, ...]
    learned: tuple[NumberAfterDrive, ...] = ()
    grounds: GroundMemory | None = None
    found_shares: dict[str, float] = field(default_factory=dict)

    def realtime_factor(self) -> float:
        """Seconds of recording per second of computing."""
        return self.recording.duration_s() / max(self.seconds, 1e-9)


def replay(
    recording: Recording,
    *,
    vehicle: str | Path | VehicleParams | None = None,
    mode: str = "adaptive",
    policy: str | Path | Policy | None = None,
    outages: Sequence[Outage] = (),
    batch: bool = False,
    progress: Callable[[float], None] | None = None,
    magnetometer: bool = False,
    settings: EstimatorOptions | None = None,
    grounds: GroundMemory | None = None,
    findings: Sequence[Finding] | None = None,
    watch: Callable[[Estimator], None] | None = None,
) -> ReplayResult:
    """Estimate and score one run.

    Args:
        vehicle: name, YAML file or vehicle; by default what the log says.
        mode: "adaptive", "fixed", "robust" or "innovation".
        policy: weighting policy, or its file; by default the shipped one.
        outages: intervals in which the estimator gets no fix.
        batch: smooth the whole run at once, instead of a fixed lag as live.
        progress: called with the share done, 0 to 1.
        magnetometer: use the log's magnetometer, too; a barometer is used wherever there is one.
        settings: fields of `EstimatorConfig` that are not its defaults.
        grounds: what the robot learned of its grounds on earlier drives.
        findings: of the log checks, where they are known already.
        watch: called with the estimator after every keyframe.

    Raises:
        TerrafusionError: the recording or the vehicle cannot be used; the message tells why.
    """
    wheels = wheels_of(recording)  # refused before a vehicle is asked for
    params, vehicle_notes = choose_vehicle(recording, vehicle)
    used, held_out = split_fixes(recording, outages)
    noise = policy if isinstance(policy, Policy) else load_policy(policy)
    inputs = sensor_config_of(recording, used)
    given = with_usable_samples(recording, inputs, used, magnetometer)
    config = EstimatorConfig(
        params.rig(), params.name, mode, noise, inputs=inputs, grounds=grounds, **(settings or {})
    )
    assumed = assumptions(recording, vehicle or recording.vehicle, params, inputs, used)
    notes = (*recording.notes, *vehicle_notes, *inputs.notes(recording, config.rig))

    estimator, history, run_notes, seconds, latencies_ms = _run_estimator(
        config, given, batch, progress, watch
    )
    notes += (*run_notes, *notes_of(estimator))
    if magnetometer and recording.magnetometer is None:
        notes += ("the log has no magnetometer: none is used",)
    if recording.magnetometer is not None and not magnetometer:
        notes += ("the log has a magnetometer; it is not used unless asked for (--magnetometer)",)
    learned, mark = estimator.weights.learned_grounds(), drive_mark(wheels)
    if learned is not None:
        learned = after_drive(grounds, learned, mark)
    if grounds is not None and mark in grounds.drives:
        notes += (
            "the ground memory has learned from this drive before: it is not counted again, and outages are "
            "bridged as on ground that is known",
        )
    changes = [*history.changes, *estimator.weights.take_changes()]
    estimate = history.estimate(estimator.weights.detector.classes, changes, notes, recording.start_ns)

    outages = tuple(outages)
    scores, alone, verdict = judged(
        recording, estimate, estimator, config.rig, used, held_out, outages, findings,
        frozenset(one.name for one in assumed),
    )  # fmt: skip
    return ReplayResult(
        recording, params, mode, config.policy, estimate, scores, used, held_out, outages, seconds,
        latencies_ms, estimator.gnss.rejected, estimator.wheels_rejected, alone, verdict, assumed,
        estimator.learned.table(), learned, estimator.weights.found_shares(),
    )  # fmt: skip


def judged(
    recording: Recording,
    estimate: Estimate,
    estimator: Estimator,
    rig: Rig,
    used: Gnss | None,
    held_out: Gnss | None = None,
    outages: Sequence[Outage] = (),
    findings: Sequence[Finding] | None = None,
    assumed: frozenset[str] = frozenset(),
) -> tuple[Scores, Baselines, Verdict]:
    """Errors of an estimate against the truth or the fixes held out, those of wheels and gyro, and of the
    receiver, alone, and the verdict; `findings` are those of the log checks, where they are known already,
    `assumed` the names of numbers that nobody gave."""
    local = estimator.gnss.unplaced
    scores = score(
        estimate, recording, held_out=held_out, outages=outages, antenna_m=estimator.gnss.antenna_places,
        aligned=local,
    )  # fmt: skip
    alone = baselines(recording, estimate, scores, used, outages, rig=rig, aligned=local)
    found = run_checks(recording, rig) if findings is None else findings
    corrections = estimator.learned.corrections()
    imu = estimator.config.inputs.imu
    run = Run(recording, estimate, scores, alone, used, found, rig, corrections, imu, assumed)
    return scores, alone, judge(run)


def _run_estimator(
    config: EstimatorConfig,
    given: Recording,
    batch: bool,
    progress: Callable[[float], None] | None,
    watch: Callable[[Estimator], None] | None,
    level: ImuLevel | None = None,
) -> tuple[Estimator, History, tuple[str, ...], float, Array]:
    """Feed complete samples as live; for a batch, then smooth the whole run.

    Gives notes on the alignment, and computing time in all, s, and by keyframe, ms, too. A batch in which the
    IMU proves tilted begins again with its samples levelled, by `level`.
    """
    archive, history = Chain(calibrate=config.calibrate) if batch else None, History()

    def keyframe(state: State) -> None:
        weights = estimator.weights
        history.add(state, weights.noise, weights.take_changes(), weights.found_ground)
        if watch is not None:
            watch(estimator)

    estimator = Estimator(
        config, on_state=keyframe, on_innovation=history.innovations.append, archive=archive
    )
    if level is not None:
        estimator.learned.mounting.level.hold(level.known, level.corrects)
    started = time.perf_counter()
    latencies_ms = feed(estimator, given, progress)
    found = estimator.learned.mounting.level
    if batch and level is None and any(found.corrects):
        return _run_estimator(config, given, batch, None, watch, found)
    alignment_notes = history.align(estimator.gnss.alignment, batch)
    if archive is not None and history.states:
        history.smooth(archive, estimator.config, estimator.gnss, estimator.learned)
    seconds = time.perf_counter() - started
    if not history.states:
        raise never_started(given, config.rig.wheel_radius_m)
    return estimator, history, alignment_notes, seconds, latencies_ms
