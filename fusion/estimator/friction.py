"""Estimates friction with a bank of models, each scored against the displacement between GNSS fixes.

Without an accelerometer only the wheels measure speed, and on ice they are wrong: friction limits how fast
the robot follows them. `FrictionEstimator` propagates a velocity for each of `FRICTION_MPS2` from wheels
and gyro (`graph.coulomb`), compares the paths with fixes a second apart and weighs the models by their
likelihood (multiple models: Bar-Shalom, Li and Kirubarajan 2001, sec. 11.6). The planar graph then takes
displacement and acceleration from the friction model instead of the wheels.
"""

import dataclasses
import math
from collections import deque
from collections.abc import Callable

import gtsam
import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.estimate import WeightChange
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.coulomb import skid_motion
from terrafusion.fusion.graph.factors import imu_factor
from terrafusion.fusion.graph.key_state import ICR_X, SIDE_SLIP, VELOCITY, KeyState
from terrafusion.fusion.graph.planar import ACCEL_DENSITY_MPS2
from terrafusion.fusion.graph.preintegration import Preintegrator
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.grounds.ground import FRICTION_MPS2, SLIPPERY_MODELS
from terrafusion.fusion.inputs.streams import ImuSegment
from terrafusion.fusion.inputs.validation import GnssFix
from terrafusion.fusion.noise.policy import SensorNoise

SLIPPERY = FRICTION_MPS2[:SLIPPERY_MODELS]
"""Limits (ice, wet or snowy ground) at which friction may lead; above them wheels do nearly as well."""
LEAD_PROBABILITY = 0.9999
"""Probability of friction, at any limit, from which it leads on dry ground too: other causes of a bent path
(soft ground, a hill, a jump of fixes) resemble friction sooner than rolling. Chosen on field logs."""
PRIOR_MPS2, PRIOR_SPREAD = 1.0, 0.7
"""Median friction limit of a skidding robot before any fix, and standard deviation of its logarithm
(assumed)."""
ROLLING_PRIOR = 0.9
"""Prior probability that the wheels hold: half rolling, half the limits of dry ground (assumed)."""
LATE_S, LATE = (0.25, 0.5, 1.0, 1.5), 0.2
"""Delays of the fixes of wheels that hold, and their prior share (assumed): in turns and starts late fixes
look like a skid."""
LEAST_INTERVAL_S, LONGEST_INTERVAL_S = 0.9, 1.6
"""Interval between the fixes that are compared."""
PATH_SHARE, PATH_SIGMA_M = 0.1, 0.05
"""Error of the displacement of the right model: a share of it, and a constant (1 sigma, assumed)."""
FREEDOM = 4.0
"""Degrees of freedom of Student's t for the displacement error: outliers of a receiver decide nothing."""
MEMORY_S = 30.0
"""Time constant of the scores (assumed: a stretch of ground)."""
SKID_DENSITY_MPS2 = 0.3
"""White acceleration of a skidding robot, m/s2/sqrt(Hz) (assumed): a limit of 1 m/s2, wrong by a third, for 1
s."""
SKID_S = 1.0
"""Duration of a skid in one direction (assumed), over which the error of a wrong limit accumulates."""
KEPT_S = 5.0
"""Paths and links are kept for longer than the interval between fixes and their delay."""
REPORT_STEP = 0.2
"""Relative change of the friction limit that is reported."""
_STEP_MPS = 0.01


class FrictionEstimator:
    """Friction limit of the ground, and the motion of the robot under it.

    Args:
        rig: track of the wheels and lever arm of the receiver.
        preintegrator: makes the planar link.
        report: called with every change.
    """

    def __init__(
        self, rig: Rig, preintegrator: Preintegrator, report: Callable[[WeightChange], None]
    ) -> None:
        self.track_m = rig.track_m
        self.antenna_m = np.array(rig.sensors.gnss.antenna_m)
        self._preintegrator = preintegrator
        self._report = report
        self._reported_mps2 = math.inf
        self._linked: deque[tuple[int, list[ImuSegment]]] = deque()
        prior = np.exp(-0.5 * (np.log(SLIPPERY / PRIOR_MPS2) / PRIOR_SPREAD) ** 2)
        dry = np.full(
            len(FRICTION_MPS2) - len(SLIPPERY), 0.5 * ROLLING_PRIOR / (len(FRICTION_MPS2) - len(SLIPPERY))
        )
        late = np.full(len(LATE_S), LATE / len(LATE_S))
        rolling = 0.5 * ROLLING_PRIOR * np.append(1.0 - LATE, late)
        self._base = np.log([*(1.0 - ROLLING_PRIOR) * prior / prior.sum(), *dry, *rolling])
        self._score = np.zeros(len(self._base))
        self._velocity: Array | None = None
        self._paths: deque[tuple[int, Array]] = deque()
        self._fixes: deque[tuple[int, Array, Array]] = deque()

    @property
    def leads(self) -> bool:
        """Whether the fixes favour the friction model over rolling wheels."""
        return self._leading() is not None

    def probabilities(self) -> Array:
        """Probabilities (K + 1,) of the friction models and, last, of rolling wheels."""
        log_weight = self._base + self._score
        weight, k = np.exp(log_weight - log_weight.max()), len(FRICTION_MPS2)
        return np.append(weight[:k], weight[k:].sum()) / weight.sum()

    def _leading(self) -> slice | None:
        """The leading models: of slippery ground where likely, all where friction is nearly certain."""
        weight = self.probabilities()
        if float(weight[: len(SLIPPERY)].sum()) > 0.5:
            return slice(len(SLIPPERY))
        return slice(len(FRICTION_MPS2)) if float(weight[:-1].sum()) > LEAD_PROBABILITY else None

    @property
    def mps2(self) -> float:
        """Friction limit, m/s2, of a skidding robot."""
        return self._moments()[0]

    def _moments(self) -> tuple[float, float]:
        """Mean and standard deviation of the friction limit, m/s2."""
        leading = self._leading() or slice(len(SLIPPERY))
        weight, frictions = self.probabilities()[leading], FRICTION_MPS2[leading]
        mean = float(weight @ frictions / weight.sum())
        return mean, math.sqrt(float(weight @ (frictions - mean) ** 2 / weight.sum()))

    def restart(self) -> None:
        """Forget the paths, but not the friction: the position was reset, or wheel samples are missing."""
        self._velocity = None
        self._paths.clear()
        self._fixes.clear()

    def score_fix(self, fix: GnssFix, scale: float = 1.0) -> None:
        """Score the models by a fix that the paths have passed; one older than the newest is ignored.

        `scale` is the scatter of the fixes over their reported sigma.
        """
        here = self._places_at(fix.t_ns)
        if here is None or (self._fixes and fix.t_ns <= self._fixes[-1][0]):
            return
        sigma_m = scale * np.asarray(fix.sigma_m[:2])
        for t_ns, enu_m, there in reversed(self._fixes):
            apart_s = (fix.t_ns - t_ns) * 1e-9
            if apart_s < LEAST_INTERVAL_S:
                continue
            if apart_s <= LONGEST_INTERVAL_S:
                self._update_scores(fix.enu_m[:2] - enu_m, here - there, sigma_m)
            break
        self._fixes.append((fix.t_ns, fix.enu_m[:2].copy(), here))
        while (self._fixes[-1][0] - self._fixes[0][0]) * 1e-9 > LONGEST_INTERVAL_S:
            self._fixes.popleft()

    def _update_scores(self, moved_m: Array, predicted_m: Array, sigma_m: Array) -> None:
        error_m = moved_m - predicted_m
        variance = 2.0 * sigma_m**2 + (PATH_SHARE * float(np.hypot(*moved_m))) ** 2 + PATH_SIGMA_M**2
        square = np.sum(error_m**2 / variance, axis=1)
        # At high fix rates the compared intervals overlap; each counts by 1/n.
        fixes = 1 + sum(1 for t_ns, *_ in self._fixes if self._fixes[-1][0] - t_ns < LEAST_INTERVAL_S * 1e9)
        self._score -= 0.5 * (FREEDOM + 2.0) * np.log1p(square / FREEDOM) / fixes
        self._score -= self._score.max()

    def _places_at(self, t_ns: int) -> Array | None:
        """Where each model, and rolling wheels with late fixes, expect a fix, (K + 1 + len(LATE_S), 2).

        None outside the kept paths, before which the robot is taken to stand.
        """
        on_time = self._paths_at(t_ns)
        if on_time is None:
            return None
        begin_ns = self._paths[0][0]
        late = (self._paths_at(max(t_ns - round(late_s * 1e9), begin_ns)) for late_s in LATE_S)
        return np.vstack([on_time, *(places[-1:] for places in late if places is not None)])

    def _paths_at(self, t_ns: int) -> Array | None:
        """Antenna paths (K + 1, 2) at a time; None outside the kept interval."""
        paths = self._paths
        if not paths or not paths[0][0] <= t_ns <= paths[-1][0]:
            return None
        i = next(i for i in range(len(paths) - 1, -1, -1) if paths[i][0] <= t_ns)
        if i + 1 == len(paths):
            return paths[i][1]
        (a_ns, a), (b_ns, b) = paths[i], paths[i + 1]
        return a + (b - a) * ((t_ns - a_ns) / (b_ns - a_ns))

    def step(
        self,
        t_ns: int,
        dt_s: float,
        segments: list[ImuSegment],
        wheels: WheelIncrement | None,
        before: KeyState,
        covariance: Array,
        skid_m2ps: float,
    ) -> tuple[list[ImuSegment], WheelIncrement | None]:
        """Segments and wheel increment of the link into a keyframe: as given, or by friction where it leads.

        Args:
            t_ns, dt_s: end and length of the keyframe interval.
            segments: of the gyro, with the specific force of a rolling robot.
            wheels: as they rolled; None where samples are missing.
            before: state at the start.
            covariance: (dim, dim) of it.
            skid_m2ps: extra variance rate of the displacement that the skid detector has found.
        """
        if wheels is None:
            self.restart()
            return segments, wheels
        motion = self._wheel_motion(wheels, before, dt_s)
        self._carry_paths(t_ns, dt_s, motion, wheels, before)
        self._report_change(t_ns)
        if self.leads:
            segments, wheels = self._friction_link(
                motion, segments, wheels, before, covariance, dt_s, skid_m2ps
            )
            self._linked.append((t_ns, segments))
            if len(self._linked) > len(self._paths):
                self._linked.popleft()
        return segments, wheels

    def _carry_paths(
        self,
        t_ns: int,
        dt_s: float,
        motion: tuple[float, float, float],
        wheels: WheelIncrement,
        before: KeyState,
    ) -> None:
        R = before.rotation
        if self._velocity is None:
            self._velocity = np.tile((R.T @ before.velocity)[:2], (len(FRICTION_MPS2), 1))
            here = np.tile((R @ self.antenna_m)[:2], (len(FRICTION_MPS2) + 1, 1))
            self._paths.append((t_ns - round(dt_s * 1e9), here))
        self._velocity, moved_m = skid_motion(self._velocity, *motion, FRICTION_MPS2, self.track_m, dt_s)
        rolled = before.rolling * wheels.displacement_m[:2] + [0.0, _lateral_m(wheels, before)]
        moved_m = np.vstack([moved_m, rolled])
        turned = R @ (gtsam.Rot3.Rz(wheels.yaw_rad).matrix() - np.eye(3)) @ self.antenna_m
        self._paths.append((t_ns, self._paths[-1][1] + moved_m @ R[:2, :2].T + turned[:2]))
        while t_ns - self._paths[0][0] > KEPT_S * 1e9:
            self._paths.popleft()
        driven_s = dt_s * min(abs(wheels.distance_m) / dt_s, 1.0)
        self._score *= math.exp(-driven_s / MEMORY_S)

    def _report_change(self, t_ns: int) -> None:
        now, reported = self.mps2 if self.leads else math.inf, self._reported_mps2
        if now != reported and (math.isinf(reported) or abs(now - reported) > REPORT_STEP * reported):
            best = "friction" if self.leads else "rolling of the wheels"
            why = f"friction: {best} explains the displacement between fixes best"
            self._report(WeightChange(t_ns, "wheels", reported, now, "m/s2", why))
            self._reported_mps2 = now

    def _wheel_motion(
        self, wheels: WheelIncrement, before: KeyState, dt_s: float
    ) -> tuple[float, float, float]:
        """Ground speed of left and right wheels without friction, m/s, and yaw rate, rad/s."""
        half = 0.5 * wheels.turn_rad * self.track_m
        scale = before.rolling / dt_s
        return scale * (wheels.distance_m - half), scale * (wheels.distance_m + half), wheels.yaw_rad / dt_s

    def _friction_link(
        self,
        motion: tuple[float, float, float],
        segments: list[ImuSegment],
        wheels: WheelIncrement,
        before: KeyState,
        covariance: Array,
        dt_s: float,
        skid_m2ps: float,
    ) -> tuple[list[ImuSegment], WheelIncrement]:
        """Specific force and displacement under friction.

        Where the wheels hold, the displacement is as accurate as the wheels; where they skid, the
        acceleration has `SKID_DENSITY_MPS2` and the displacement the accuracy of the speed.
        """
        R = before.rotation
        start = (R.T @ before.velocity)[:2]
        starts = start + np.array([[0.0, 0.0], [_STEP_MPS, 0.0], [0.0, _STEP_MPS]])
        friction, spread = self._moments()
        ends, paths = skid_motion(starts, *motion, np.full(3, friction), self.track_m, dt_s)
        kept = (ends[1:] - ends[0]).T / _STEP_MPS
        carried_s = (paths[1:] - paths[0]).T / _STEP_MPS
        variance = np.diag(carried_s @ (R.T @ covariance[VELOCITY, VELOCITY] @ R)[:2, :2] @ carried_s.T)
        half = 0.5 * wheels.yaw_rad
        force = (_rotation(half) @ ends[0] - _rotation(-half) @ start) / dt_s
        free = np.clip(1.0 - np.diag(kept), 0.0, 1.0)
        skidding = math.sqrt(SKID_DENSITY_MPS2**2 + spread**2 * SKID_S + _density2(skid_m2ps))
        density = np.minimum(np.hypot((1.0 - free) * skidding, free * ACCEL_DENSITY_MPS2), ACCEL_DENSITY_MPS2)
        segments = [
            dataclasses.replace(
                segment,
                accel_mps2=np.append(force, segment.accel_mps2[2]),
                accel_density_mps2=(float(density[0]), float(density[1])),
            )
            for segment in segments
        ]
        sigma = wheels.sigma.copy()
        sigma[:2] = np.sqrt(sigma[:2] ** 2 + variance)
        # The factor will slip it, and carry it to the side, as it does with wheels that roll.
        moved_m = np.append((paths[0] - [0.0, _lateral_m(wheels, before)]) / before.rolling, 0.0)
        skid_m = wheels.displacement_m[0] - moved_m[0]
        return segments, dataclasses.replace(
            wheels, displacement_m=moved_m, sigma=sigma, skid_m=float(skid_m)
        )

    def inflated_link(
        self, chain: Chain, k: int, more_m2ps: float, noise: SensorNoise
    ) -> gtsam.NonlinearFactorGraph | None:
        """The link into keyframe k with `more_m2ps` more variance rate; None where the link is not a friction
        link.
        """
        node, before = chain.node(k), chain.node(k - 1)
        made = next((s for t_ns, s in self._linked if t_ns == node.t_ns), None)
        if made is None or not _is_friction_link(node.link):
            return None
        x, y = made[0].accel_density_mps2 or (ACCEL_DENSITY_MPS2, ACCEL_DENSITY_MPS2)
        more = _density2(more_m2ps)
        loose = math.sqrt(x * x + more), math.sqrt(y * y + more)
        segments = [dataclasses.replace(segment, accel_density_mps2=loose) for segment in made]
        link = gtsam.NonlinearFactorGraph()
        link.add(imu_factor(k, self._preintegrator.integrate(segments, before.point.bias, noise)))
        return link


def friction_estimator(
    config: EstimatorConfig, preintegrator: Preintegrator, report: Callable[[WeightChange], None]
) -> FrictionEstimator | None:
    """The friction estimator; None unless planar with gyro and both sides, and adaptive."""
    inputs = config.inputs
    usable = inputs.planar and inputs.sides and inputs.yaw == "gyro" and not config.calibrate
    return (
        FrictionEstimator(config.rig, preintegrator, report) if usable and config.mode == "adaptive" else None
    )


def _density2(rate_m2ps: float) -> float:
    """Squared density of an acceleration that is as uncertain after `SKID_S` as a walk of `rate_m2ps`."""
    return 3.0 * rate_m2ps / SKID_S**2


def _lateral_m(wheels: WheelIncrement, before: KeyState) -> float:
    """Lateral displacement of a rolling robot by the wheel factor."""
    return float(before.of(SIDE_SLIP) * wheels.distance_m - before.of(ICR_X) * wheels.yaw_rad)


def _is_friction_link(link: gtsam.NonlinearFactorGraph) -> bool:
    """Whether the link is a single IMU factor: no bridged gap of the gyro, no zero-velocity update."""
    return link.size() == 1 and isinstance(link.at(0), gtsam.CombinedImuFactor)


def _rotation(angle_rad: float) -> Array:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s], [s, c]])
