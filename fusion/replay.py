"""Replay a recording through the estimator as it would have run live, and score it."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Gnss, Imu, Wheels
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import gtsam_to_ros_covariance
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.config.sensor_config import SensorConfig, complete_samples, sensor_config_of
from terrafusion.fusion.estimate.estimate import Estimate, State
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.history import History
from terrafusion.fusion.estimator.map_alignment import MapAlignment
from terrafusion.fusion.graph.batch import BatchSmoother
from terrafusion.fusion.graph.body_twist import bias_sigma, gyro_sigma_radps, twist_covariance
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.key_state import (
    POSE,
    SLIP,
    VELOCITY,
    KeyState,
    linear_sigma,
    quaternion_of,
)
from terrafusion.fusion.inputs.streams import SHOCK_MPS2, SPIN_RADPS
from terrafusion.fusion.metrics.scores import Outage, Scores, score
from terrafusion.fusion.noise.policy import Policy, load_policy
from terrafusion.fusion.terrain.external import external_probabilities
from terrafusion.twin.model.vehicle import VehicleParams, as_vehicle, geometry_notes, with_overrides

Array = NDArray[np.float64]

HELD_OUT_EVERY = 5
"""Without truth every fifth fix is kept from the estimator and scored against."""


@dataclass(frozen=True, eq=False)
class ReplayResult:
    """One replayed drive.

    Attributes:
        estimate, scores: what was estimated, and how well.
        used, held_out: the fixes the estimator was given and was not given.
        seconds: computing time of the estimation alone.
        latencies_ms: computing time of each keyframe (live mode).
        rejected_gnss, rejected_wheels: measurements refused by a gate.
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

    def realtime_factor(self) -> float:
        """Seconds of recording per second of computing."""
        return self.recording.duration_s() / max(self.seconds, 1e-9)


def choose_vehicle(
    recording: Recording, vehicle: str | Path | VehicleParams | None
) -> tuple[VehicleParams, tuple[str, ...]]:
    """The vehicle asked for, or named by the log, or a generic one; with the log's own geometry on top.

    Raises:
        DataError: nothing tells the robot's geometry.
        ConfigError: an unknown vehicle name.
    """
    asked = vehicle or recording.vehicle
    overrides = recording.overrides
    loaded = as_vehicle(asked or "generic")
    notes = geometry_notes(loaded, overrides)
    if asked:
        return with_overrides(loaded, overrides), notes
    wheels = recording.wheels
    needs_radius = wheels is not None and wheels.unit == "radps"
    if overrides.track_m is None or (needs_radius and overrides.wheel_radius_m is None):
        raise DataError(
            "the log names no vehicle and not its geometry",
            remedy="give --vehicle NAME, or wheel_radius_m and track_m in meta.yaml",
        )
    notes += ("no vehicle is named: a generic one is used, with its assumed sensor noise",)
    return with_overrides(loaded, overrides), notes


def split_fixes(recording: Recording, outages: Sequence[Outage]) -> tuple[Gnss | None, Gnss | None]:
    """Fixes for the estimator, and fixes kept from it.

    All fixes inside an outage are kept back; without a truth channel every
    fifth of the others too.
    """
    gnss = recording.gnss
    if gnss is None or not len(gnss):
        return None, None
    held = np.zeros(len(gnss), dtype=bool)
    if recording.truth is None or not len(recording.truth):
        held[HELD_OUT_EVERY - 1 :: HELD_OUT_EVERY] = True
    for outage in outages:
        held |= outage.covers(gnss.t_ns, recording.start_ns)
    return gnss.select(~held), (gnss.select(held) if held.any() else None)


def replay(
    recording: Recording,
    *,
    vehicle: str | Path | VehicleParams | None = None,
    mode: str = "adaptive",
    policy: Path | Policy | None = None,
    outages: Sequence[Outage] = (),
    batch: bool = False,
    progress: Callable[[float], None] | None = None,
    magnetometer: bool = False,
    settings: Mapping[str, Any] | None = None,
) -> ReplayResult:
    """Estimate and score one drive.

    Args:
        vehicle: name, YAML file or `VehicleParams`; by default what the log says.
        mode: "adaptive", "fixed", "robust" or "innovation".
        policy: weighting policy, or its file; by default the shipped one.
        outages: stretches in which the estimator gets no fix.
        batch: smooth the whole drive at once, instead of a fixed lag as live.
        progress: called with the share done, 0 to 1.
        magnetometer: use the log's magnetometer, too; a barometer is used wherever there is one.
        settings: further fields of `EstimatorConfig`.

    Raises:
        TerrafusionError: the recording or the vehicle cannot be used; the message tells why.
    """
    params, notes = choose_vehicle(recording, vehicle)
    outages = tuple(outages)
    for outage in outages:
        if outage.start_s >= recording.duration_s():
            raise DataError(
                f"the outage starts at {outage.start_s:g} s, after the end of the log",
                remedy=f"the log lasts {recording.duration_s():.1f} s",
            )
    used, held_out = split_fixes(recording, outages)
    rows = policy if isinstance(policy, Policy) else load_policy(policy)
    inputs = sensor_config_of(recording, used)
    imu, wheels = _usable(recording, inputs)
    config = EstimatorConfig(params.rig(), params.name, mode, rows, inputs=inputs, **(settings or {}))
    archive = Chain(calibrate=config.calibrate) if batch else None
    history = History()
    estimator = Estimator(
        config,
        on_state=lambda state: history.add(state, estimator.weights.noise, estimator.weights.take_changes()),
        on_innovation=history.innovations.append,
        archive=archive,
    )
    started = time.perf_counter()
    latencies = _feed(
        estimator, imu, _side_motion(wheels, config.rig.wheel_radius_m), used,
        _others(recording, magnetometer, rows.names()), history, progress,
    )  # fmt: skip
    placed = estimator.gnss.placed
    late = () if placed is None else _laid_onto_the_map(history, placed, batch)
    if archive is not None and history.states:
        _smooth(archive, history, estimator.config, placed is not None)
    seconds = time.perf_counter() - started
    if not history.states:
        raise _never_started(recording, used)
    notes = (*recording.notes, *notes, *inputs.notes(recording), *late, *_said(estimator))
    if recording.magnetometer is not None and not magnetometer:
        notes += ("the log has a magnetometer; it is not used unless asked for (--magnetometer)",)
    changes = [*history.changes, *estimator.weights.take_changes()]
    estimate = history.estimate(estimator.weights.detector.classes, changes, notes)
    antenna = config.rig.sensors.gnss.antenna_m
    scores = score(
        estimate,
        recording,
        held_out=held_out,
        outages=outages,
        antenna_m=antenna,
        aligned=estimator.gnss.local,
    )
    return ReplayResult(
        recording, params, mode, rows, estimate, scores, used, held_out, outages, seconds, latencies,
        estimator.gnss.rejected, estimator.wheels_rejected,
    )  # fmt: skip


def _usable(recording: Recording, inputs: SensorConfig) -> tuple[Imu | None, Wheels]:
    """IMU, where one is used, and wheels, without rows that lack a value the graph needs."""
    imu, wheels = recording.imu, recording.wheels
    if wheels is None or not len(wheels):
        raise DataError(
            "the log has no wheel speeds",
            channel="wheels",
            remedy="name their topic, or add wheels.csv",
        )
    wheels = wheels.select(np.isfinite(wheels.speed.sum(axis=1)))
    if not len(wheels):
        raise DataError("no sample has all its values", channel="wheels")
    if inputs.imu == "none":
        if (wheels.t_ns[-1] - wheels.t_ns[0]) * 1e-9 < 2.0:
            raise DataError("the log is too short to start from", remedy="give at least two seconds")
        return None, wheels
    assert imu is not None
    imu = imu.select(complete_samples(imu, inputs.imu))
    overlap = (min(imu.t_ns[-1], wheels.t_ns[-1]) - max(imu.t_ns[0], wheels.t_ns[0])) * 1e-9
    if overlap < 2.0:
        raise DataError(
            f"IMU and wheels overlap for {overlap:.1f} s only",
            remedy="check their clocks; at least 2 s are needed",
        )
    return imu, wheels


def _side_motion(wheels: Wheels, radius_m: float) -> tuple[list[int], list[list[float]]]:
    """Times and rows [left m/s, right m/s (, left m, right m)] of the wheels."""
    speeds = wheels.side_speeds_mps(radius_m)
    if wheels.angle_rad is None or not np.isfinite(wheels.angle_rad).all():
        return wheels.t_ns.tolist(), speeds.tolist()
    turned = Wheels(wheels.t_ns, wheels.angle_rad, wheels.names, "radps").side_speeds_mps(radius_m)
    return wheels.t_ns.tolist(), np.hstack([speeds, turned]).tolist()


def _feed(
    estimator: Estimator,
    imu: Imu | None,
    wheels: tuple[list[int], list[list[float]]],
    gnss: Gnss | None,
    others: list[tuple[int, str, Any]],
    history: History,
    progress: Callable[[float], None] | None,
) -> Array:
    """Give all samples in time order; returns the computing time of each keyframe, ms.

    Keyframes are made as IMU samples come, or, without an IMU, as wheel samples do.
    """
    wheel_times, wheel_rows = wheels
    gnss_times = [] if gnss is None else gnss.t_ns.tolist()
    clock = wheel_times if imu is None else imu.t_ns.tolist()
    latencies: list[float] = []
    w = g = c = made = 0
    for i, t_ns in enumerate(clock):
        while imu is not None and w < len(wheel_times) and wheel_times[w] <= t_ns:
            estimator.add_wheels(wheel_times[w], *wheel_rows[w])
            w += 1
        while g < len(gnss_times) and gnss_times[g] <= t_ns:
            assert gnss is not None
            _give_fix(estimator, gnss, g)
            g += 1
        while c < len(others) and others[c][0] <= t_ns:
            at_ns, method, value = others[c]
            getattr(estimator, method)(at_ns, value)
            c += 1
        begun = time.perf_counter()
        if imu is None:
            estimator.add_wheels(t_ns, *wheel_rows[i])
        else:
            estimator.add_imu(t_ns, imu.gyro_radps[i], imu.accel_mps2[i])
        if len(history.states) != made:
            latencies.append((time.perf_counter() - begun) * 1e3)
            made = len(history.states)
            if progress is not None and made % 50 == 0:
                progress((i + 1) / len(clock))
    estimator.finish()
    if progress is not None:
        progress(1.0)
    return np.array(latencies)


def _others(recording: Recording, magnetometer: bool, grounds: tuple[str, ...]) -> list[tuple[int, str, Any]]:
    """What else the log has, in order of time: time, the estimator's method that takes it, and the value."""
    command, barometer, field = recording.command, recording.barometer, recording.magnetometer
    found: list[tuple[int, str, Any]] = [
        (t_ns, "add_terrain", p) for t_ns, p in external_probabilities(recording.terrain, grounds)
    ]
    if command is not None:
        known = np.isfinite(command.v_mps)
        rows = zip(command.t_ns[known].tolist(), command.v_mps[known].tolist(), strict=True)
        found += [(t_ns, "add_command", v) for t_ns, v in rows]
    if barometer is not None:
        rows = zip(barometer.t_ns.tolist(), barometer.pressure_pa.tolist(), strict=True)
        found += [(t_ns, "add_pressure", p) for t_ns, p in rows]
    if field is not None and magnetometer:
        fields = zip(field.t_ns.tolist(), field.field_t, strict=True)
        found += [(t_ns, "add_magnetic_field", b) for t_ns, b in fields]
    return sorted(found, key=lambda one: one[0])


def _give_fix(estimator: Estimator, gnss: Gnss, i: int) -> None:
    if not np.isfinite(gnss.enu_m[i, :2].sum() + gnss.sigma_enu_m[i, :2].sum()) or gnss.fix[i] == 0:
        return
    velocity = None if gnss.velocity_enu_mps is None else gnss.velocity_enu_mps[i]
    sigma_v = float("nan") if gnss.sigma_v_mps is None else float(gnss.sigma_v_mps[i])
    fix = int(gnss.fix[i])
    estimator.add_gnss(int(gnss.t_ns[i]), gnss.enu_m[i], gnss.sigma_enu_m[i], velocity, sigma_v, fix)


def _smooth(chain: Chain, history: History, config: EstimatorConfig, placed: bool) -> None:
    """Replace the live states by the batch solution over the whole drive, which starts from them.

    Where fixes have `placed` the path, no state of it is local any more.
    """
    batch = BatchSmoother(chain, [key_state_of(state) for state in history.states])
    batch.optimise()
    keys, covariances = batch.states(), batch.covariances()
    offset = len(keys) - len(history.states)
    history.states[:] = [
        _smoothed(state, key, P, gyro_sigma_radps(config.rig.sensors.imu, config.keyframe_s, noise))
        for state, key, P, noise in zip(
            history.states, keys[offset:], covariances[offset:], history.noises, strict=True
        )
    ]
    if placed:
        history.states[:] = [
            dataclasses.replace(state, status="outage") if state.status == "no_gnss" else state
            for state in history.states
        ]


def key_state_of(state: State) -> KeyState:
    """The state of a keyframe behind what the estimator told of it."""
    x, y, z, w = state.quaternion
    pose = gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), state.position_m)
    bias = gtsam.imuBias.ConstantBias(state.accel_bias_mps2, state.gyro_bias_radps)
    return KeyState(pose, state.velocity_mps, bias, state.linear)


def _smoothed(live: State, key: KeyState, P: Array, gyro_sigma: Array) -> State:
    R = key.pose.rotation().matrix()
    return dataclasses.replace(
        live,
        position_m=np.asarray(key.pose.translation()),
        quaternion=quaternion_of(key.pose),
        velocity_mps=key.velocity,
        angular_velocity_radps=key.rate(key_state_of(live).reading(live.angular_velocity_radps)),
        gyro_bias_radps=np.asarray(key.bias.gyroscope()),
        accel_bias_mps2=np.asarray(key.bias.accelerometer()),
        slip=key.slip + (live.slip - float(live.linear[0])),
        linear=key.linear,
        linear_sigma=linear_sigma(P),
        slip_sigma=float(np.sqrt(P[SLIP, SLIP])),
        covariance=gtsam_to_ros_covariance(P[POSE, POSE], R),
        velocity_covariance=P[VELOCITY, VELOCITY].copy(),
        twist_covariance=twist_covariance(P, R, key.velocity, gyro_sigma),
        bias_sigma=bias_sigma(P),
    )


def _laid_onto_the_map(history: History, placed: MapAlignment, batch: bool) -> tuple[str, ...]:
    """Put the local states before the first fixes where these show them to have been."""
    local = [i for i, state in enumerate(history.states) if state.status == "no_gnss"]
    for i in local:
        history.states[i] = placed.moved(history.states[i])
    if not local:
        return ()
    begun = (placed.t_ns - history.states[0].t_ns) * 1e-9
    told = f"{begun:.1f} s after the start GNSS laid the path onto the map, turned by "
    told += f"{np.degrees(placed.yaw_rad):.0f} degrees"
    return (told if batch else f"{told}; live, all before was in a local frame: it is not scored",)


def _said(estimator: Estimator) -> tuple[str, ...]:
    notes = []
    gnss = estimator.gnss
    if gnss.local and not gnss.unplaced:
        notes.append("no GNSS fix came: the path is local, its start and heading are arbitrary")
    elif gnss.local:
        notes.append(
            f"{gnss.unplaced} GNSS fixes came after a start without any and did not show the heading: "
            "the path is local, its start and heading are arbitrary"
        )
    if estimator.gnss.too_late:
        notes.append(f"{estimator.gnss.too_late} GNSS fixes came before the start or too late for the lag")
    if estimator.gnss.turned:
        notes.append(f"the heading was wrong and was set right from the motion {estimator.gnss.turned} times")
    if gnss.slide.refutations:
        notes.append(f"fixes showed {gnss.slide.refutations} times that the robot slid beside its wheels")
    grip = gnss.slide.grip
    if grip is not None and grip.slides:
        notes.append(f"at its end the robot slid, with a grip of {grip.mps2:.1f} m/s2")
    if estimator.imu.spikes:
        notes.append(
            f"{estimator.imu.spikes} IMU samples beyond {SPIN_RADPS:g} rad/s or {SHOCK_MPS2:g} m/s2 were not "
            "believed: the mean of those before stands for each"
        )
    for stream in (estimator.imu.late, estimator.wheels.late):
        if stream.too_late:
            notes.append(f"{stream.too_late} samples of {stream.channel} came after their keyframe was made")
    return (*notes, *estimator.aids.notes())


def _never_started(recording: Recording, used: Gnss | None) -> DataError:
    if used is not None and len(used):
        return DataError(
            "the robot never moved far enough for GNSS to show its heading",
            channel="gnss",
            remedy="replay a longer drive, or leave the GNSS channel out for a local path",
        )
    return DataError("the log is too short to start from", remedy="give at least two seconds")
