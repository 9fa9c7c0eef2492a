"""`Estimator`: sensor messages in, pose, twist, slip and terrain out, live.

est = Estimator.for_vehicle("husky")
est.add_imu(t_ns, gyro, accel)
est.add_wheels(t_ns, left_mps, right_mps)
est.add_gnss(t_ns, enu_m, sigma_m)
state = est.latest()
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Self

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from terrafusion.datasets.core.arrays import Array, Stamp
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.messages import Message
from terrafusion.datasets.core.printable import counted
from terrafusion.datasets.core.robot import SKIDDING
from terrafusion.datasets.core.tables import text_html
from terrafusion.fusion.config.estimator_config import EstimatorConfig, checked_config
from terrafusion.fusion.config.sensor_config import Sensors, sensors_of
from terrafusion.fusion.estimate.estimate import STATUS, Innovation, State
from terrafusion.fusion.estimator import snapshot
from terrafusion.fusion.estimator.aiding import AidingSensors
from terrafusion.fusion.estimator.alignment import Start, checked_start, initial_state
from terrafusion.fusion.estimator.breakdown import call_back, starts_anew
from terrafusion.fusion.estimator.friction import friction_estimator
from terrafusion.fusion.estimator.gates import WheelGate, wheel_innovation
from terrafusion.fusion.estimator.gnss import GnssUpdater
from terrafusion.fusion.estimator.key_states import state_fields
from terrafusion.fusion.estimator.keyframe_motion import KeyframeMotion, MotionInput
from terrafusion.fusion.estimator.learned_numbers import LearnedNumbers
from terrafusion.fusion.estimator.mean_motion import MeanMotion
from terrafusion.fusion.estimator.messages import arguments_of, count_left_out
from terrafusion.fusion.estimator.odometry import Propagator
from terrafusion.fusion.estimator.odometry_frame import OdometryFrame, in_map
from terrafusion.fusion.estimator.place_doubt import PlaceDoubt
from terrafusion.fusion.estimator.skid import SkidDetector
from terrafusion.fusion.estimator.slip_monitor import MotionMonitor
from terrafusion.fusion.estimator.starting import StartSearch
from terrafusion.fusion.estimator.stationarity import StationarityDetector
from terrafusion.fusion.estimator.steering import policy_of
from terrafusion.fusion.estimator.stuck_gyro import StuckGyro
from terrafusion.fusion.graph import imu_gap, slow_states
from terrafusion.fusion.graph.body_twist import gyro_sigma_radps
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.factors import imu_factor
from terrafusion.fusion.graph.key_state import VELOCITY, KeyState
from terrafusion.fusion.graph.planar import level_factor, yaw_of_wheels
from terrafusion.fusion.graph.wheel_factor import WheelIncrement, slip_of
from terrafusion.fusion.inputs.sample_stream import MOST_LATE_S
from terrafusion.fusion.inputs.steering import SteeringStream
from terrafusion.fusion.inputs.streams import ImuStream, WheelStream, forget_in_pause, usual_interval_s
from terrafusion.fusion.inputs.time_jumps import EarlyFixes, Newest
from terrafusion.fusion.inputs.validation import as_number, as_numbers, checked_fix
from terrafusion.fusion.noise.policy import SensorNoise
from terrafusion.fusion.weighting.adaptive import TerrainNoise
from terrafusion.fusion.weighting.weighting import wheel_innovation_test
from terrafusion.twin.model.vehicle import VehicleParams, as_vehicle

LONGEST_STEP_S, SMOOTH_EVERY, SMOOTH_WINDOW = 1.0, 5, 50
LAG_MARGIN = 5
"""Keyframes held beyond the lag: a fix that is exactly so late belongs to a keyframe still there."""
SEEN_LATE_NS, SWITCHED = 2_000_000_000, 0.1
"""A change of ground is detected after at most so long (docs/explanation/terrain.md: the 95 % of delays);
smaller shifts are ignored."""
KEPT_NS = 2_000_000_000
"""Samples are kept for so long after their keyframe."""
UNKNOWN = np.full(3, np.nan)


class Estimator:
    """Fixed-lag factor-graph estimator over wheels, IMU and GNSS.

    Samples may come late and out of order (see `sample_stream`); keyframes are made as soon as the IMU
    and the wheels (or their waiting time) cover them. `on_state` is called with every new `State`,
    `on_innovation` with every tested measurement; `archive` keeps all factors for a batch solution.
    Calls of several threads need one lock around each.
    """

    def __init__(
        self,
        config: EstimatorConfig,
        on_state: Callable[[State], None] | None = None,
        on_innovation: Callable[[Innovation], None] | None = None,
        archive: Chain | None = None,
    ) -> None:
        inputs = checked_config(config).inputs
        rig, policy = inputs.rig(config.rig), policy_of(config.rig, config.policy, inputs.yaw)
        self.config = dataclasses.replace(config, rig=rig, policy=policy)
        self._on_state, self._on_innovation, self.breakdowns = on_state, on_innovation, 0
        self.reset(archive)

    def __repr__(self) -> str:
        held, waiting = len(self.chain.nodes), len(self.gnss.waiting)
        lines = [
            f"Estimator ({self.config.vehicle or 'unnamed vehicle'}, {self.config.mode}): {self.status}",
            f"  {STATUS[self.status]}",
            f"  {counted(held, 'keyframe')} held, {counted(waiting, 'fix', 'fixes')} waiting",
            f"  rejected: {self.gnss.rejected} GNSS, {self.wheels_rejected} wheels",
        ]
        return "\n".join(lines if self._state is None else [*lines, f"  {self._state!r}"])

    def _repr_html_(self) -> str:
        return text_html(repr(self))

    def reset(self, archive: Chain | None = None) -> None:
        """Back to before the first sample; configuration and callbacks stay."""
        config, rig = self.config, self.config.rig
        self.chain = Chain(archive, config.calibrate)
        self.newest = newest = Newest()
        self.imu, self.wheels = ImuStream(not config.inputs.planar, newest), WheelStream(newest)
        self.steering, self.fixes = SteeringStream(rig, newest), EarlyFixes(newest)
        self.gyro, self.weights = StuckGyro(rig, config.inputs), TerrainNoise(config)
        self._preintegrator = config.inputs.preintegrator(rig.sensors.imu, rig.drive in SKIDDING)
        self._skid = SkidDetector(friction_estimator(config, self._preintegrator, self.weights.record))
        self.gnss = GnssUpdater(config, self._report, self.weights.per_measurement, self._skid)
        self.aids = AidingSensors(config.rig, config.declination_rad, self._report)
        self._wheel_gate = WheelGate(config.wheel_gate_sigma)
        self._silent, self.wheels_rejected = False, 0
        self._search = StartSearch(config, self.aids, self.gnss)
        self._set_step(config.keyframe_s)
        self._state: State | None = None
        self._carried: tuple[Array, SensorNoise] | None = None
        self._fresh: tuple[State, MeanMotion] | None = None
        self._stationarity, self.monitor = StationarityDetector(rig), MotionMonitor(rig)
        self._propagator, self._frame = Propagator(self._preintegrator), OdometryFrame()
        self._place_doubt = PlaceDoubt()
        self.learned = LearnedNumbers(config, self.imu, self.gnss, self.weights)
        streams = self.imu, self.wheels, self.steering
        self._motion = MotionInput(config, streams, self._skid, self.learned)

    @classmethod
    def for_vehicle(
        cls, vehicle: str | Path | VehicleParams, mode: str = "adaptive", sensors: Sensors = None
    ) -> Self:
        """For a vehicle, given by name, YAML file or itself, with the `sensors` of `sensors_of`."""
        params = as_vehicle(vehicle)
        return cls(EstimatorConfig(params.rig(), params.name, mode, inputs=sensors_of(sensors)))

    def add(self, message: Message) -> None:
        """One message of `Recording.messages()` or of a driver; see `messages.arguments_of`."""
        if (read := arguments_of(message, self.config)) is None:
            count_left_out(message, self.config, self.imu, self.weights)
            return
        method, arguments = read
        getattr(self, method)(message.t_ns, *arguments)

    def add_imu(self, t_ns: Stamp, gyro_radps: ArrayLike, accel_mps2: ArrayLike = UNKNOWN) -> None:
        """Angular rate (3,) rad/s and specific force (3,) m/s2, body axes, mean since the last sample.

        Where `config.inputs` declares no more than gyro z, all but the yaw rate may be NaN.
        """
        if self.config.inputs.imu == "none":
            raise DataError(
                "the estimator is configured without an IMU", channel="imu", remedy="change `inputs`"
            )
        self.imu.add(t_ns, self.gyro.checked(t_ns, gyro_radps, self.wheels), accel_mps2)
        if self._fresh is not None or not self.chain.nodes or self._due() is not None:
            self._advance()

    def add_wheels(
        self,
        t_ns: Stamp,
        left_mps: float,
        right_mps: float,
        left_m: float | None = None,
        right_m: float | None = None,
    ) -> None:
        """Circumferential speed of each side, m/s, and its travelled distance, m, where encoders count it."""
        self.wheels.add(t_ns, left_mps, right_mps, left_m, right_m)
        forget_in_pause(self.imu, self.wheels, self.steering, self.aids, self.gnss)
        if self.config.inputs.imu == "none":  # the wheels are the clock, and their difference the yaw rate
            steering = self.steering if self.config.inputs.yaw == "steering" else None
            self.imu.add(t_ns, yaw_of_wheels(self.wheels, self.config.rig.track_m, steering), UNKNOWN)
            self._advance()
            return
        self.imu.go_on_without(self.wheels.t_ns)
        if self.imu.silent_ns and self.chain.nodes and self._due() is not None:
            self._advance()

    def add_steering(self, t_ns: Stamp, front_rad: float, rear_rad: float = 0.0) -> None:
        """Mean angle of the front and of the rear wheels, rad, positive to the left; of a steered robot."""
        self.steering.add(t_ns, front_rad, rear_rad)

    def add_gnss(
        self,
        t_ns: Stamp,
        enu_m: ArrayLike,
        sigma_m: ArrayLike | None,
        velocity_mps: ArrayLike | None = None,
        sigma_v_mps: float = float("nan"),
        fix: Fix | int | str | None = None,
    ) -> None:
        """Antenna position (3,) and 1 sigma, one or (3,), ENU m (NaN height: unknown); velocity (3,) ENU m/s.

        `fix` is the class of fix ("single" to "fixed"); it gives the sigma where none is sensible.
        """
        for one in self.fixes.admitted(checked_fix(t_ns, enu_m, sigma_m, velocity_mps, sigma_v_mps, fix)):
            self.gnss.queue(one)
            self.learned.fix(one)

    def set_start(
        self,
        position_m: ArrayLike,
        yaw_rad: float,
        position_sigma_m: float = 0.1,
        yaw_sigma_rad: float = 0.05,
    ) -> None:
        """Start at a known position (3,) and heading, ENU, with 1 sigmas, instead of waiting for motion.

        A wrong heading is corrected from the motion. Must come before the start.
        """
        self._search.known = checked_start(position_m, yaw_rad, position_sigma_m, yaw_sigma_rad)

    def add_terrain(self, t_ns: Stamp, probabilities: Mapping[str, float]) -> None:
        """Class probabilities of an external source, such as a camera, fused with those of the detector."""
        if (t := self.newest.admitted(t_ns, "terrain", round(MOST_LATE_S * 1e9))) is not None:
            self.weights.external(t, probabilities)

    def add_command(self, t_ns: Stamp, v_mps: float) -> None:
        """Commanded forward speed; it distinguishes a stalled robot from a waiting one."""
        if (t := self.newest.admitted(t_ns, "command")) is not None:
            self.monitor.command(t, as_number(v_mps, "speed", "command"))

    def add_pressure(self, t_ns: Stamp, pressure_pa: float) -> None:
        """Static pressure of a barometer, Pa; it holds the height of GNSS or of the start."""
        if (t := self.newest.admitted(t_ns, "barometer")) is not None:
            self.aids.height.add(t, as_number(pressure_pa, "pressure", "barometer"))

    def add_magnetic_field(self, t_ns: Stamp, field_t: ArrayLike) -> None:
        """Magnetic flux density (3,), body axes, tesla; see `magnetometer`."""
        if (t := self.newest.admitted(t_ns, "magnetometer")) is not None:
            self.aids.heading.add(t, as_numbers(field_t, "field", "magnetometer"))

    def latest(self) -> State | None:
        """The newest state, or None before the start."""
        return self._state

    def odometry(self, frame: str = "map") -> State | None:
        """The newest state carried to the newest IMU sample, in the frame "map", or "odom" in which no fix
        makes the path jump (`OdometryFrame`); None before the start.
        """
        as_in_map = in_map(frame)
        if self._state is None or self._carried is None:
            return None
        covariance, noise = self._carried
        now = self._propagator.carry(self._state, covariance, self.imu, noise)
        return now if as_in_map else self._frame.of(self._state, now)

    def dump(self) -> bytes:
        """The state of a running estimator, for `restore`; see `snapshot`."""
        return snapshot.dump(self)

    @classmethod
    def restore(cls, config: EstimatorConfig, data: bytes, **callbacks: Any) -> Self:
        """An estimator that continues from `dump` with the same bits; see `snapshot.restore`."""
        return snapshot.restore(cls(config, **callbacks), data)

    @property
    def status(self) -> str:
        """A key of `STATUS`, also before the first state, and where samples no longer make states."""
        if self._state is not None:
            return "stalled" if self.imu.stalled else self._state.status
        return "waiting" if self._search.level is None else "aligning"

    def finish(self) -> None:
        """No more data come: keyframes no longer wait for late samples."""
        self.imu.late.wait_ns = self.wheels.late.wait_ns = 0
        self._advance(last=True)

    @starts_anew
    def _advance(self, last: bool = False) -> None:
        if not self.chain.nodes:
            start = self._search.find(self.imu, self.wheels, self.steering, last)
            if start is None:
                return
            self._begin(start)
        chain, newest = self.chain, self.chain.last
        while self.chain is chain and (t_ns := self._due(last)) is not None:
            self._keyframe(t_ns)
        if self.chain is chain and (chain.last == newest or last):  # a callback may have reset it
            self._upkeep()

    def _due(self, last: bool = False) -> int | None:
        """Time of the next keyframe, once the samples cover it or the wheels have been waited for."""
        t_ns, covers = self.imu.next_ns(self.chain.nodes[-1].t_ns, self._step_ns), self.imu.covers
        if covers(t_ns) and (last or self.wheels.covers(t_ns)):
            return t_ns
        waited = covers(t_ns + round(self.config.wheel_wait_s * 1e9))
        return t_ns if waited and covers(t_ns + round(1.5e9 * usual_interval_s(self.wheels.t_ns))) else None

    def _begin(self, start: Start) -> None:
        slowest_s = max(usual_interval_s(self.imu.t_ns), usual_interval_s(self.wheels.t_ns))
        self._set_step(max(self.config.keyframe_s, min(slowest_s, LONGEST_STEP_S)))
        # The fixes that gave the heading enter the graph again: the prior must not count them twice.
        from_fixes = not self.gnss.local and self._search.known is None
        spec, drift_m = self.config.rig.sensors.imu, self.gnss.fix_noise.drift.sigma_m
        point, sigmas = initial_state(start, self.weights.noise, spec, drift_m, from_fixes)
        point, sigmas = self.learned.with_known(point, sigmas, start)
        self.chain.append(start.t_ns, point, gyro_radps=np.asarray(point.bias.gyroscope()))
        for chain in filter(None, (self.chain, self.chain.archive)):
            chain.set_prior(sigmas[: chain.dim])
        self.chain.solve(SMOOTH_WINDOW)
        self.weights.begin(start.t_ns)
        newest = min(s.t_ns[-1] - s.late.wait_ns for s in (self.imu, self.wheels))
        # Live, keyframes before the start are not reported; in a batch they are.
        self._silent = self.chain.archive is None
        next_ns, step_ns = self.imu.next_ns, self._step_ns
        while (t_ns := next_ns(self.chain.nodes[-1].t_ns, step_ns)) + step_ns <= newest:
            self._keyframe(t_ns)
        self._silent = False
        self.chain.smooth(len(self.chain.nodes), iterations=5)

    def _set_step(self, step_s: float) -> None:
        """Time between keyframes: at least that between samples of the slower stream."""
        self._step_ns = round(step_s * 1e9)
        self._keep = round(self.config.lag_s / step_s) + LAG_MARGIN

    def _keyframe(self, t_ns: int) -> None:
        """Append the keyframe at `t_ns`, and use the fixes that it has passed."""
        self._upkeep()
        self.gyro.doubt_heading(self.chain)
        before, switch = self.chain.state(self.chain.last), self._renewed_slip(t_ns)
        motion = self._motion.up_to(t_ns, self.chain, self.weights.noise)
        mean, planar = motion.mean, self.config.inputs.planar
        point, link, wheels = self._linked(t_ns, motion, before, switch)
        up, drift = before.rotation[2], self.gnss.fix_noise.drift.process
        markov = slow_states.step(mean.dt_s, motion.noise, up, *drift, switch, wheels)
        for stream in (self.imu, self.wheels, self.steering):
            stream.late.used_ns = t_ns
        preintegrated = not (planar or motion.in_gap or motion.in_pause)
        readings = mean.gyro_radps, mean.accel_mps2
        chain = self.chain
        k = chain.append(t_ns, point, link, markov, wheels, *readings, preintegrated)
        if planar:
            chain.add(k, level_factor(k))
        aided = not self.gnss.is_outage(t_ns)
        self._stationarity.update(chain, link, self.imu, self.wheels, before, aided)
        fresh = self._finish_keyframe(t_ns, mean.gyro_radps, motion.rolled_m), mean
        self._fresh = fresh if self.chain is chain else None

    def _renewed_slip(self, t_ns: int) -> float:
        """Share of the ground that changed before a keyframe at `t_ns`; the slip of the window follows it."""
        switch, dt_s = self.weights.take_switch(), (t_ns - self.chain.nodes[-1].t_ns) * 1e-9
        if switch > SWITCHED:
            noise, drift = self.weights.noise, self.gnss.fix_noise.drift.process
            slow_states.inflate_slip_covariance(self.chain, t_ns - SEEN_LATE_NS, dt_s, noise, *drift, switch)
        return switch

    def _linked(
        self, t_ns: int, motion: KeyframeMotion, before: KeyState, switch: float
    ) -> tuple[KeyState, gtsam.NonlinearFactorGraph, WheelIncrement | None]:
        """First state of a keyframe at `t_ns`, the link to it, and the wheels as far as they are believed."""
        k, mean, wheels, config = self.chain.last + 1, motion.mean, motion.wheels, self.config
        if motion.in_pause:
            return *imu_gap.pause(k, before, mean.dt_s), None
        if motion.in_gap:
            return imu_gap.bridge(k, before, wheels, motion.turn_rad, mean.dt_s)
        measured = self._preintegrator.integrate(motion.segments, before.bias, self.gyro.noise(motion.noise))
        seen = before.bias_seen(mean.gyro_radps, mean.accel_mps2) if config.calibrate else before.bias
        nav = measured.predict(gtsam.NavState(before.pose, before.velocity), seen)
        point = KeyState(nav.pose(), nav.velocity(), before.bias, before.linear)
        link = gtsam.NonlinearFactorGraph()
        link.add(imu_factor(k, measured))
        if not config.inputs.planar:  # the planar link does not test the wheels
            wheels = self._gated(t_ns, wheels, before, point, switch)
        return point, link, wheels

    def _finish_keyframe(self, t_ns: int, gyro: Array, rolled_m: float | None) -> State:
        chain = self.chain
        chain.solve(SMOOTH_WINDOW)
        before = chain.covariance
        if chain.archive is None:  # a batch needs no odometry frame
            self._frame.step(chain)
        if self.gnss.update(chain, self.weights.noise):
            chain.solve(SMOOTH_WINDOW)
        if self.aids.update(chain, self.imu.t_ns[-1], before, self.chain.covariance, self.gnss):
            chain.solve(SMOOTH_WINDOW)
        chain.forget(self._keep)
        self.monitor.watch(t_ns, chain.state(chain.last), self.chain.covariance[VELOCITY, VELOCITY], rolled_m)
        return self._emitted(t_ns, gyro)

    def _upkeep(self) -> None:
        """Heading check, smoothing, terrain, learning: a call after a keyframe, or before the next one."""
        fresh, self._fresh = self._fresh, None
        if fresh is None:
            return
        state, mean = fresh
        self._propagator = Propagator(self._preintegrator)  # learning may correct samples that it has taken
        self.learned.keyframe(self.chain, mean)
        for stream in (self.imu, self.wheels, self.steering):
            stream.forget(state.t_ns - KEPT_NS)
        turned = self.gnss.correct_heading(self.chain, self.weights.noise)
        if turned:
            self.learned.heading_turned()
        if turned or self.chain.last % SMOOTH_EVERY == 0:
            self.chain.smooth(SMOOTH_WINDOW)
        self.weights.update(state, self.imu, self.wheels, self._skid.friction)
        self.learned.advance(self.chain)

    def _gated(
        self, t_ns: int, wheels: WheelIncrement | None, before: KeyState, point: KeyState, switch: float
    ) -> WheelIncrement | None:
        if wheels is None:
            return None
        gate, dt = self._wheel_gate, self._step_ns * 1e-9
        wheels = gate.rejoined(wheels, dt)
        innovation, variance = wheel_innovation(
            wheels, before, point, self.chain.covariance, self.weights.noise, dt, switch
        )
        robot = before.forward_mps, point.forward_mps
        accepted, nis = gate.test(innovation, float(np.sqrt(variance)), wheels, robot, dt)
        self._report(Innovation(t_ns, "wheels", np.array([innovation]), nis, 1, accepted))
        if accepted:
            test = wheel_innovation_test(t_ns, wheels, innovation, variance, dt)
            return self.weights.per_measurement.wheels(wheels, test)
        self.wheels_rejected += not self._silent
        return wheels.doubted(variance, gate.doubt(nis))

    def _emitted(self, t_ns: int, gyro: Array) -> State:
        key, wheels = self.chain.state(self.chain.last), self.chain.nodes[-1].wheels
        gyro_sigma = gyro_sigma_radps(self.config.rig.sensors.imu, self._step_ns * 1e-9, self.weights.noise)
        aided = not (self.gnss.local or self.gnss.is_outage(t_ns))
        self._place_doubt.step(t_ns, key, float(key.rate(gyro)[2]), aided)
        moments = self.learned.place_moments()
        covariance = self._place_doubt.widened(self.chain.covariance, key.rotation, moments)
        state = State(
            t_ns=t_ns,
            slip=key.slip if wheels is None else slip_of(key.linear, wheels),
            terrain=self.weights.posterior(),
            status="running" if aided else ("no_gnss" if self.gnss.unplaced else "outage"),
            slipping=self.monitor.slipping,
            immobilised=self.monitor.immobilised,
            **state_fields(key, covariance, gyro, gyro_sigma),
        )
        self._state, self._carried = self.gnss.widened(state), (covariance, self.weights.noise)
        if not self._silent:
            call_back(self._on_state, self._state)
        return self._state

    def _report(self, innovation: Innovation) -> None:
        if not self._silent:
            call_back(self._on_innovation, innovation)
