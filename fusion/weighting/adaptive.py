"""Sensor noise in force by the detected terrain, with a reason for every change."""

import dataclasses
import math
from collections import deque
from collections.abc import Mapping

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.estimate import State, WeightChange
from terrafusion.fusion.grounds.learner import FrictionBank, GroundLearner
from terrafusion.fusion.grounds.memory import GroundMemory
from terrafusion.fusion.grounds.signature import STANDS
from terrafusion.fusion.inputs.streams import ImuStream, WheelStream
from terrafusion.fusion.inputs.validation import as_numbers
from terrafusion.fusion.noise.policy import Policy, SensorNoise
from terrafusion.fusion.terrain.classifier import FOREIGN_SLIP, UNKNOWN, load_terrain_model
from terrafusion.fusion.terrain.detector import TerrainDetector
from terrafusion.fusion.terrain.features import MIN_SPEED_MPS, Window, slip_without_prior
from terrafusion.fusion.weighting.driven_slip import DrivenSlip
from terrafusion.fusion.weighting.ground_slip import GroundSlip
from terrafusion.fusion.weighting.innovation import InnovationWeighting
from terrafusion.fusion.weighting.robust import RobustWeighting
from terrafusion.fusion.weighting.weighting import NOTEWORTHY, NoiseInForce, Weighting

UPDATE_NS = 500_000_000
WINDOW_NS = 1_000_000_000
BELIEVED = 0.5
"""Credit from which the label, and not the detector, is taken for the ground."""
STANDING_NS = 2_000_000_000
"""A robot that stands sees the same ground in all pictures: those of so long count as evidence (assumed)."""
ROUNDING = 0.01
"""By so much probabilities may miss 1, as rounded ones do (assumed)."""
MOST_CHANGES = 1000
"""Records kept where nobody takes them: memory must not grow over days."""

_RECORDED = {
    "slip_mean": ("wheels", ""),
    "slip_sigma": ("wheels", ""),
    "wheel_sigma_mps": ("wheels", "m/s"),
    "side_slip_sigma": ("wheels", ""),
    "gyro_inflation": ("imu", ""),
    "gyro_yaw_inflation": ("imu", ""),
    "accel_inflation": ("imu", ""),
    "gnss_inflation": ("gnss", ""),
}


class TerrainNoise:
    """Runs the terrain detector and blends the policy by its posterior.

    In the other modes the terrain is still detected and reported, but the noise stays the policy's fixed
    one, as tuned ("innovation" adapts it from there).

    Attributes:
        noise: the noise in force.
        per_measurement: what the mode makes of single measurements.
        changes: what changed since `take_changes` was last called, the newest `MOST_CHANGES` of it.
        window: the newest window that the detector was given.
        found_ground: the found ground that the robot is on, "" on a class or on new ground.
        left_out: number of messages of another source that held no probabilities.
    """

    def __init__(self, config: EstimatorConfig) -> None:
        self.policy = config.tuning.adaptive.applied_to_policy(config.policy)
        self.adaptive = config.mode == "adaptive"
        model = (config.terrain_model or load_terrain_model()).for_vehicle(config.vehicle)
        self.detector = TerrainDetector(model, config.policy.names())
        self._unknown = self.detector.classes.index(UNKNOWN)
        self._labels = config.labels
        self._claimed: Array | None = None
        fixed = config.tuning.fixed.applied(config.policy.fixed)
        self._starts_pooled = model.slip_only
        learns = config.grounds is not None or (self.adaptive and self._starts_pooled)
        self.grounds = GroundLearner(config.grounds) if learns else None
        if self._starts_pooled:
            self.policy = _for_another_robot(self.policy, fixed)
        self._driven = DrivenSlip.of_policy(self.policy)
        self._slips, self._slip_times_s = self._driven.posterior(), self.policy.slips()[3].copy()
        own, known = self.policy.classes[UNKNOWN], config.grounds.grounds if config.grounds else ()
        self._ground_slip = GroundSlip(
            own.slip_mean, own.slip_sigma, own.slip_per_grade, own.slip_time_s, known
        )
        self.noise = self.policy.blend(self._shares) if self.adaptive else fixed
        self.changes: deque[WeightChange] = deque(maxlen=MOST_CHANGES)
        self._recorded: SensorNoise | None = None
        self._rig, self._vehicle = config.rig, config.vehicle or ""
        # Yaw slip needs both gyro and wheels as yaw sources.
        self._has_yaw_slip = config.inputs.sides and config.inputs.yaw == "gyro"
        self.per_measurement = _weighting_for(config, self)
        self._before = self._shares
        self._next_ns = self._updated_ns = 0
        self._grade = 0.0
        self._on_found_s: dict[str, float] = {}
        self.found_ground = ""
        self.window: Window | None = None
        self._last_speed = np.nan
        self._source = "detector"
        self._external_ns: int | None = None
        self.left_out = 0
        self._seen_standing_ns = 0

    def learn_slip(self, mean: float, sigma: float, time_s: float, t_ns: int) -> None:
        """Take over the slip that the robot itself shows: mean and sigma for the ground that no class
        describes, and on all grounds how long slip lasts.

        `time_s`: correlation time of the slip of whole runs; none is longer than the policy's.
        """
        if not self.adaptive:
            time_s = min(time_s, self.policy.fixed.slip_time_s)
            self.noise = dataclasses.replace(self.noise, slip_mean=mean, slip_sigma=sigma, slip_time_s=time_s)
            return
        self._slip_times_s = np.minimum(self.policy.slips()[3], time_s)
        if self._starts_pooled:
            self._ground_slip.expect(mean, sigma, float(self._slip_times_s[self._unknown]))
        self._reweight(t_ns)

    def learn_grade_slip(self, per_grade: float) -> None:
        """Take over the slope of the slip over the grade, on ground that no class describes."""
        if not self.adaptive:
            self.noise = dataclasses.replace(self.noise, slip_per_grade=per_grade)
        else:
            self._ground_slip.per_grade = per_grade

    def learned_grounds(self) -> GroundMemory | None:
        """What the ground memory of the robot holds by now, condensed; None where there is none."""
        if self.grounds is None:
            return None
        learned = self.grounds.memory.condensed()
        learned.robot = learned.robot or self._vehicle
        return learned

    def found_grounds(self) -> list[str]:
        """Names and slip of the grounds whose own slip the estimate expects, where there are several that
        differ by more than their sigmas; the others are named together.
        """
        if self.grounds is None or not (self.adaptive and self._starts_pooled):
            return []
        slips, alike = self._ground_slip.known(), list[list[int]]()
        for i in sorted(slips, key=lambda i: slips[i][0]):
            (first, sigma), (mean, own) = slips[alike[-1][0]] if alike else (-math.inf, 0.0), slips[i]
            if mean - first > math.hypot(sigma, own):
                alike.append([])
            alike[-1].append(i)
        names = [ground.name for ground in self.grounds.memory.grounds]
        lines = [
            f"{' and '.join(names[i] for i in sorted(some))} {np.mean([slips[i][0] for i in some]):.2f}"
            for some in alike
        ]
        return lines if len(lines) > 1 else []

    def found_shares(self) -> dict[str, float]:
        """Share of each found ground in the time on ground that no class describes; the rest was new."""
        total_s = sum(self._on_found_s.values())
        return {name: s / total_s for name, s in self._on_found_s.items() if name and total_s > 0.0}

    def record(self, change: WeightChange) -> None:
        """Record a change that another part made."""
        self.changes.append(change)

    def take_changes(self) -> list[WeightChange]:
        """The changes since the last call."""
        taken = list(self.changes)
        self.changes.clear()
        return taken

    def take_switch(self) -> float:
        """Share that changed class since the last call (total variation); 0 with fixed weights."""
        if not self.adaptive:
            return 0.0
        p = self._shares
        moved = 0.5 * float(np.abs(p - self._before).sum())
        self._before = p
        found = self._ground_slip.take_switch() if self._starts_pooled else 0.0
        return max(moved, found * float(p[self._unknown]))

    def begin(self, t_ns: int) -> None:
        """Start the clock; the first noise is a change from the policy's fixed one."""
        self._next_ns, self._updated_ns = t_ns + WINDOW_NS, t_ns
        self._recorded = self.policy.fixed
        self._take_label(t_ns)
        self._reweight(t_ns)

    def posterior(self) -> dict[str, float]:
        """Class name -> probability now."""
        return dict(zip(self.detector.classes, self._probabilities.tolist(), strict=True))

    @property
    def _probabilities(self) -> Array:
        return self._with_label(self.detector.probabilities)

    def _believes_label(self) -> bool:
        return self._claimed is not None and self.detector.credit.value > BELIEVED

    def _with_label(self, found: Array) -> Array:
        """The label in place of the probabilities found (k,), as far as it has credit."""
        if self._claimed is None:
            return found
        return np.asarray(self._claimed + (1.0 - self.detector.credit.value) * (found - self._claimed))

    def external(self, t_ns: int, probabilities: Mapping[str, float]) -> None:
        """Fuse the class probabilities of another source; what is missing to 1 is that of `unknown`.

        Raises:
            DataError: a class the policy does not know, or numbers that are no probabilities.
        """
        if not isinstance(probabilities, Mapping):
            raise DataError(
                f"{probabilities!r} names no classes", channel="terrain", remedy="give {class: probability}"
            )
        unknown = sorted(set(map(str, probabilities)) - set(self.detector.classes))
        if unknown:
            raise DataError(
                f"unknown class '{unknown[0]}'",
                channel="terrain",
                remedy=f"the policy knows {', '.join(self.detector.classes)}",
            )
        given = [probabilities.get(name, 0.0) for name in self.detector.classes]
        q = as_numbers(given, "probabilities", "terrain")
        if 0.0 < (total := float(q.sum())) < 1.0 - ROUNDING:
            q[self._unknown] += 1.0 - total
        since_ns = UPDATE_NS if self._external_ns is None else min(abs(t_ns - self._external_ns), UPDATE_NS)
        if self.window is not None and self.window.ground_speed_mps() < STANDS:
            since_ns = min(since_ns, STANDING_NS - self._seen_standing_ns)
            self._seen_standing_ns += since_ns
        else:
            self._seen_standing_ns = 0
        self.detector.fuse(q, since_ns / UPDATE_NS)
        self._external_ns = t_ns
        self._source = "external source"
        self._reweight(t_ns)

    def update(
        self, state: State, imu: ImuStream, wheels: WheelStream, friction: FrictionBank | None = None
    ) -> None:
        """Evaluate the last second, twice a second."""
        if state.t_ns < self._next_ns:
            return
        before_ns, self._updated_ns = self._updated_ns, state.t_ns
        self._next_ns = state.t_ns + UPDATE_NS
        self.window = window = self._window(state, imu, wheels, (state.t_ns - before_ns) * 1e-9)
        self.detector.update(window)
        ahead = -1.0 if window.wheel_speed_mps < 0.0 else 1.0
        self._grade = ahead * float(quaternion_to_matrix(state.quaternion)[2, 0])
        if self.grounds is not None:
            rolled = wheels.travelled(before_ns, state.t_ns)
            rolled_m = np.nan if rolled is None else 0.5 * (rolled[0] + rolled[1])
            replaced = self.grounds.update(self._on_the_level(window), state, rolled_m, friction)
            if replaced is not None:
                self._ground_slip.clear(replaced)
            if self._ground_slip.remembers and self.grounds.memory.contradicted():
                self._ground_slip.distrust()
            self._ground_slip.recognise(self.grounds.memory.belief)
            self.found_ground = ""
            if int(self._probabilities.argmax()) == self._unknown:
                self.found_ground = name = self.grounds.memory.most_probable()
                self._on_found_s[name] = self._on_found_s.get(name, 0.0) + window.dt_s
        self._learn_driven_slip(window)
        self._source = "detector"
        self._take_label(state.t_ns)
        self._reweight(state.t_ns)

    def _on_the_level(self, window: Window) -> Window:
        """The window without the slip that the grade makes."""
        if window.slip is None:
            return window
        return dataclasses.replace(window, slip=window.slip - self.noise.slip_per_grade * self._grade)

    def _learn_driven_slip(self, window: Window) -> None:
        """Take the slip of the window for that of its ground."""
        if not self.adaptive or window.slip is None or window.slip_sigma is None:
            return
        if not window.ground_speed_mps() > MIN_SPEED_MPS:
            return
        if self._starts_pooled and self.grounds is not None:
            for place in self._ground_slip.learn(window.slip, window.slip_sigma, self._grade, window.dt_s):
                self.grounds.memory.forget_slip(place)
        self._driven.add(self._shares, window.slip, window.slip_sigma, self._grade, window.dt_s)
        self._slips = self._driven.posterior()

    def _take_label(self, t_ns: int) -> None:
        """Take the ground from the labels, where there are some."""
        if self._labels is not None:
            self._claimed = self._labels.probabilities(t_ns, self.detector.classes)
            self.detector.credit.claim(self._claimed)
            if self._believes_label():
                self._source = "label"

    def _window(self, state: State, imu: ImuStream, wheels: WheelStream, dt_s: float) -> Window:
        """The last second up to `state`, `dt_s` after the last update: slow wheels make rare keyframes."""
        start_ns, rig = state.t_ns - WINDOW_NS, self._rig
        t, gyro, accel = imu.window(start_ns, state.t_ns + 1)
        rolled = wheels.travelled(start_ns, state.t_ns)
        left, right = rolled if rolled is not None else (np.nan, np.nan)
        speed = 0.5 * (left + right) / (WINDOW_NS * 1e-9)
        rate = (speed - self._last_speed) / max(dt_s, UPDATE_NS * 1e-9)
        self._last_speed = speed
        prior = self.noise.slip_at(self._grade), self.noise.slip_sigma
        observed = state.status == "running"  # without fixes the slip is what its prior says
        measured = slip_without_prior(state.slip, state.slip_sigma, *prior) if observed else None
        slip, slip_sigma = measured if measured is not None else (None, None)
        return Window(
            dt_s=dt_s,
            imu_t_s=t,
            gyro_radps=gyro,
            accel_mps2=accel,
            wheel_speed_mps=speed,
            wheel_speed_rate_mps2=0.0 if np.isnan(rate) else rate,
            speed_mps=float(np.hypot(*state.velocity_mps[:2])),
            yaw_rate_wheels_radps=None
            if rolled is None or not self._has_yaw_slip
            else (right - left) / rig.track_m / (WINDOW_NS * 1e-9),
            yaw_rate_gyro_radps=float(gyro[:, 2].mean() - state.gyro_bias_radps[2]) if len(gyro) else np.nan,
            slip=slip,
            slip_sigma=slip_sigma,
        )

    @property
    def _shares(self) -> Array:
        """Weight of each class (k,): its probability.

        For a robot that the terrain model does not know, a class that the detector finds counts as far as
        it is more likely than not: until then the pooled noise holds, which was fitted to all grounds and
        includes the doubt between them.
        """
        p = self.detector.probabilities
        if self._starts_pooled:
            p = np.maximum(2.0 * p - 1.0, 0.0)
            p[self._unknown] = 0.0
            p[self._unknown] = 1.0 - p.sum()
        return self._with_label(p)

    def _reweight(self, t_ns: int) -> None:
        if not self.adaptive:
            return
        p, (mean, sigma), slope = self._probabilities, self._slips, self.policy.slips()[2]
        if self._starts_pooled:
            unknown, own = np.arange(len(mean)) == self._unknown, self._ground_slip
            mean, sigma = np.where(unknown, own.mean, mean), np.where(unknown, own.sigma, sigma)
            slope = np.where(unknown, own.per_grade, slope)
        self.noise = self.policy.blend(self._shares, self._grade, (mean, sigma, slope, self._slip_times_s))
        if self._recorded is None:  # not started yet: nothing to change from
            return
        before, now = vars(self._recorded), vars(self.noise)
        why = self._ground_now(p)
        for name, (sensor, unit) in _RECORDED.items():
            scale = max(abs(before[name]), 0.02)
            if abs(now[name] - before[name]) > NOTEWORTHY * scale:
                reason = f"{name}: {why}"
                self.changes.append(WeightChange(t_ns, sensor, before[name], now[name], unit, reason))
                self._recorded = dataclasses.replace(self._recorded, **{name: now[name]})

    def _ground_now(self, p: Array) -> str:
        """The most probable ground: a class, by their probabilities (k,), or one that the robot has found."""
        best = int(p.argmax())
        found = self.grounds.memory if self.grounds and self._starts_pooled else GroundMemory()
        own, by_label = found.most_probable(), self._believes_label()
        if own and not by_label and best == self._unknown:
            return f"{own} p = {found.belief.max():.2f} (found while driving)"
        return f"terrain {self.detector.classes[best]} p = {p[best]:.2f} ({self._source})"


def _for_another_robot(policy: Policy, pooled: SensorNoise) -> Policy:
    """The policy for a robot on which it was not fitted.

    It is usually on `unknown` ground, which gets the `pooled` noise, not the wider one. Its rolling radius is
    less well known, which looks like slip on every ground. How much its IMU shakes depends on tyres, chassis
    and mount more than on the ground: weighted as the robot of the policy on asphalt, the accelerometers of
    a Warthog turned its heading by 2 to 3 deg.
    """
    doubted = {
        name: dataclasses.replace(
            noise,
            slip_sigma=math.hypot(noise.slip_sigma, FOREIGN_SLIP),
            gyro_inflation=pooled.gyro_inflation,
            gyro_yaw_inflation=pooled.gyro_yaw_inflation,
            accel_inflation=pooled.accel_inflation,
        )
        for name, noise in policy.classes.items()
    }
    return dataclasses.replace(policy, classes={**doubted, UNKNOWN: pooled})


def _weighting_for(config: EstimatorConfig, noise: NoiseInForce) -> Weighting:
    """The weighting of the mode asked for; what it changes is recorded in `noise`."""
    if config.mode == "robust":
        return RobustWeighting(config, noise)
    if config.mode == "innovation":
        return InnovationWeighting(config, noise)
    return Weighting()
