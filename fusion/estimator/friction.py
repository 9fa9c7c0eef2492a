"""FrictionEstimator of the ground, heard from fixes: a robot's way is told for many grips at once, and fixes choose.

Without an accelerometer nothing but the wheels tells the speed, and on ice they tell it wrong: the robot
follows them no faster than friction drags it. `FrictionEstimator` carries a velocity along for each of `FRICTION_MPS2` by the
wheels and the gyro alone (`graph.friction`), compares the ways with those between fixes a second apart, and
weighs the grips by how well they tell them (multiple models: Bar-Shalom, Li and Kirubarajan 2001, sec. 11.6).
The planar graph then takes the way and the change of speed that the grip allows in place of the wheels'.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable

import gtsam
import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.estimate import WeightChange
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.coulomb import skid_motion
from terrafusion.fusion.graph.key_state import ICR_X, SIDE_SLIP, VELOCITY, KeyState
from terrafusion.fusion.graph.link import imu_factor
from terrafusion.fusion.graph.planar import ACCEL_DENSITY_MPS2
from terrafusion.fusion.graph.preintegration import Preintegrator
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.inputs.streams import GnssFix, ImuSegment
from terrafusion.fusion.noise.policy import SensorNoise

Array = NDArray[np.float64]

FRICTION_MPS2 = np.array([0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6])
"""Grips that are told apart: mu g from ice to dry ground."""
SLIPPERY_MPS2 = 2.0
"""Up to this grip, of ice and wet or snowy ground, friction leads; with more, wheels lead nearly as well."""
SLIPPERY = FRICTION_MPS2[FRICTION_MPS2 <= SLIPPERY_MPS2]
SURE = 0.9999
"""Probability of friction, whatever the grip, from which it leads on dry ground, too: what else bends a way
(soft ground, a hill, a jump of fixes) passes for friction sooner than for rolling. Chosen on field logs."""
USUAL_MPS2, USUAL_SPREAD = 1.0, 0.7
"""FrictionEstimator of a robot that slides, before any fix, and standard deviation of its logarithm (assumed)."""
HOLDS = 0.9
"""Probability, before any fix, that the wheels hold: half of it that the robot goes as they roll, half that
it does as friction has it on ground that is not slippery (assumed)."""
APART_S, FURTHEST_S = 0.9, 1.6
"""Fixes so far apart are compared."""
WAY_SHARE, WAY_SIGMA_M = 0.1, 0.05
"""What the way of the right grip misses: a share of the way, and a rest (1 sigma, assumed)."""
FREEDOM = 4.0
"""Degrees of freedom of Student's t, by which a way is judged: the outlier of a receiver chooses nothing."""
MEMORY_S = 30.0
"""How long fixes are remembered (assumed: a stretch of ground)."""
SLIDING_DENSITY_MPS2 = 0.3
"""White acceleration of a robot that slides, m/s2/sqrt(Hz) (assumed): what a grip of 1 m/s2, wrong by a
third, misses in a second."""
LASTS_S = 1.0
"""How long a slide lasts in one direction (assumed): so long the error of a wrong grip adds up."""
HELD_S = 3.0
"""How long ways and links are held: longer than fixes lie apart."""
TELL_STEP = 0.2
"""Relative change of the grip that is told again."""
_STEP_MPS = 0.01


class FrictionEstimator:
    """Which grip the ground has, and what a robot does by it.

    Args:
        rig: track of the wheels and lever arm of the receiver.
        preintegrator: makes the planar link.
        tell: called with what changes.
    """

    def __init__(self, rig: Rig, preintegrator: Preintegrator, tell: Callable[[WeightChange], None]) -> None:
        self.track_m = rig.track_m
        self.antenna_m = np.array(rig.sensors.gnss.antenna_m)
        self._preintegrator = preintegrator
        self._tell = tell
        self._told_mps2 = math.inf
        self._linked: deque[tuple[int, list[ImuSegment]]] = deque()
        usual = np.exp(-0.5 * (np.log(SLIPPERY / USUAL_MPS2) / USUAL_SPREAD) ** 2)
        dry = np.full(len(FRICTION_MPS2) - len(SLIPPERY), 0.5 * HOLDS / (len(FRICTION_MPS2) - len(SLIPPERY)))
        self._prior = np.log([*(1.0 - HOLDS) * usual / usual.sum(), *dry, 0.5 * HOLDS])
        self._score = np.zeros(len(self._prior))
        self._velocity: Array | None = None
        self._paths: deque[tuple[int, Array]] = deque()
        self._fixes: deque[tuple[int, Array, Array]] = deque()

    @property
    def slides(self) -> bool:
        """Whether fixes have shown that friction tells the robot's way best."""
        return self._leading() is not None

    def _leading(self) -> slice | None:
        """The grips that lead: those of slippery ground where they are likely, all where friction is sure."""
        weight = self._weights()
        if float(weight[: len(SLIPPERY)].sum()) > 0.5:
            return slice(len(SLIPPERY))
        return slice(len(FRICTION_MPS2)) if float(weight[:-1].sum()) > SURE else None

    @property
    def mps2(self) -> float:
        """The grip, m/s2, of a robot that slides."""
        return self._known()[0]

    def _weights(self) -> Array:
        """Probabilities (K + 1,) of the grips and, last, of wheels that roll."""
        log_weight = self._prior + self._score
        weight = np.exp(log_weight - log_weight.max())
        return np.asarray(weight / weight.sum())

    def _known(self) -> tuple[float, float]:
        """Mean and standard deviation of the grip, m/s2."""
        leading = self._leading() or slice(len(SLIPPERY))
        weight, grips = self._weights()[leading], FRICTION_MPS2[leading]
        mean = float(weight @ grips / weight.sum())
        return mean, math.sqrt(float(weight @ (grips - mean) ** 2 / weight.sum()))

    def restart(self) -> None:
        """Forget the ways, not the grip: the robot was set elsewhere, or its wheels were silent."""
        self._velocity = None
        self._paths.clear()
        self._fixes.clear()

    def seen(self, fix: GnssFix, scale: float = 1.0) -> None:
        """Judge the ways by a fix that they have passed; one that comes after a newer one judges nothing.

        Args:
            fix: as the receiver gives it.
            scale: how many times more than it claims the receiver is seen to scatter.
        """
        here = self._at(fix.t_ns)
        if here is None or (self._fixes and fix.t_ns <= self._fixes[-1][0]):
            return
        sigma_m = scale * np.asarray(fix.sigma_m[:2])
        for t_ns, enu_m, there in reversed(self._fixes):
            apart_s = (fix.t_ns - t_ns) * 1e-9
            if apart_s < APART_S:
                continue
            if apart_s <= FURTHEST_S:
                self._judge(fix.enu_m[:2] - enu_m, here - there, sigma_m)
            break
        self._fixes.append((fix.t_ns, fix.enu_m[:2].copy(), here))
        while (self._fixes[-1][0] - self._fixes[0][0]) * 1e-9 > FURTHEST_S:
            self._fixes.popleft()

    def _judge(self, went_m: Array, told_m: Array, sigma_m: Array) -> None:
        missed = went_m - told_m
        variance = 2.0 * sigma_m**2 + (WAY_SHARE * float(np.hypot(*went_m))) ** 2 + WAY_SIGMA_M**2
        square = np.sum(missed**2 / variance, axis=1)
        # Ways overlap where fixes come faster than they are compared.
        fixes = 1 + sum(1 for t_ns, *_ in self._fixes if self._fixes[-1][0] - t_ns < APART_S * 1e9)
        self._score -= 0.5 * (FREEDOM + 2.0) * np.log1p(square / FREEDOM) / fixes
        self._score -= self._score.max()

    def _at(self, t_ns: int) -> Array | None:
        """Ways (K, 2) of the antenna at a time; None beyond what is remembered."""
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
        slide_m2ps: float,
    ) -> tuple[list[ImuSegment], WheelIncrement | None]:
        """What the link into the keyframe at `t_ns` is made of: as given, or as friction has it.

        Args:
            t_ns, dt_s: end and length of the keyframe.
            segments: of the gyro, with the force of a robot that rolls.
            wheels: as they rolled; None where they are silent.
            before: state at the start.
            covariance: (dim, dim) of it.
            slide_m2ps: how much less sure fixes have shown the way to be.
        """
        if wheels is None:
            self.restart()
            return segments, wheels
        motion = self._motion(wheels, before, dt_s)
        self._carry(t_ns, dt_s, motion, wheels, before)
        self._note(t_ns)
        if self.slides:
            segments, wheels = self._dragged(motion, segments, wheels, before, covariance, dt_s, slide_m2ps)
            self._linked.append((t_ns, segments))
            if len(self._linked) > len(self._paths):
                self._linked.popleft()
        return segments, wheels

    def _carry(
        self,
        t_ns: int,
        dt_s: float,
        motion: tuple[float, float, float],
        wheels: WheelIncrement,
        before: KeyState,
    ) -> None:
        """Carry the ways on to `t_ns`."""
        R = before.pose.rotation().matrix()
        if self._velocity is None:
            self._velocity = np.tile((R.T @ before.velocity)[:2], (len(FRICTION_MPS2), 1))
            here = np.tile((R @ self.antenna_m)[:2], (len(self._prior), 1))
            self._paths.append((t_ns - round(dt_s * 1e9), here))
        self._velocity, way = skid_motion(self._velocity, *motion, FRICTION_MPS2, self.track_m, dt_s)
        rolled = before.rolling * wheels.displacement_m[:2] + [0.0, _across_m(wheels, before)]
        way = np.vstack([way, rolled])
        turned = R @ (gtsam.Rot3.Rz(wheels.yaw_rad).matrix() - np.eye(3)) @ self.antenna_m
        self._paths.append((t_ns, self._paths[-1][1] + way @ R[:2, :2].T + turned[:2]))
        while t_ns - self._paths[0][0] > HELD_S * 1e9:
            self._paths.popleft()
        driven_s = dt_s * min(abs(wheels.distance_m) / dt_s, 1.0)
        self._score *= math.exp(-driven_s / MEMORY_S)

    def _note(self, t_ns: int) -> None:
        now, told = self.mps2 if self.slides else math.inf, self._told_mps2
        if now != told and (math.isinf(told) or abs(now - told) > TELL_STEP * told):
            best = "friction" if self.slides else "rolling of the wheels"
            why = f"grip: {best} tells the way between fixes best"
            self._tell(WeightChange(t_ns, "wheels", told, now, "m/s2", why))
            self._told_mps2 = now

    def _motion(self, wheels: WheelIncrement, before: KeyState, dt_s: float) -> tuple[float, float, float]:
        """Speeds of left and right wheels, m/s, what they slip without force removed, and yaw rate, rad/s."""
        half = 0.5 * wheels.turn_rad * self.track_m
        scale = before.rolling / dt_s
        return scale * (wheels.distance_m - half), scale * (wheels.distance_m + half), wheels.yaw_rad / dt_s

    def _dragged(
        self,
        motion: tuple[float, float, float],
        segments: list[ImuSegment],
        wheels: WheelIncrement,
        before: KeyState,
        covariance: Array,
        dt_s: float,
        slide_m2ps: float,
    ) -> tuple[list[ImuSegment], WheelIncrement]:
        """The force that drags the robot, and its way.

        Where the wheels hold, the way is worth what the wheels are, and the speed follows it; where they
        slide, the change of speed is worth `SLIDING_DENSITY_MPS2`, and the way what the speed is.
        """
        R = before.pose.rotation().matrix()
        start = (R.T @ before.velocity)[:2]
        starts = start + np.array([[0.0, 0.0], [_STEP_MPS, 0.0], [0.0, _STEP_MPS]])
        grip, spread = self._known()
        ends, ways = skid_motion(starts, *motion, np.full(3, grip), self.track_m, dt_s)
        kept = (ends[1:] - ends[0]).T / _STEP_MPS
        carried_s = (ways[1:] - ways[0]).T / _STEP_MPS
        variance = np.diag(carried_s @ (R.T @ covariance[VELOCITY, VELOCITY] @ R)[:2, :2] @ carried_s.T)
        half = 0.5 * wheels.yaw_rad
        force = (_turned(half) @ ends[0] - _turned(-half) @ start) / dt_s
        free = np.clip(1.0 - np.diag(kept), 0.0, 1.0)
        sliding = math.sqrt(SLIDING_DENSITY_MPS2**2 + spread**2 * LASTS_S + _density2(slide_m2ps))
        density = np.minimum(np.hypot((1.0 - free) * sliding, free * ACCEL_DENSITY_MPS2), ACCEL_DENSITY_MPS2)
        segments = [
            dataclasses.replace(
                piece,
                accel_mps2=np.append(force, piece.accel_mps2[2]),
                accel_density_mps2=(float(density[0]), float(density[1])),
            )
            for piece in segments
        ]
        sigma = wheels.sigma.copy()
        sigma[:2] = np.sqrt(sigma[:2] ** 2 + variance)
        # The factor will slip it, and carry it to the side, as it does with wheels that roll.
        way = np.append((ways[0] - [0.0, _across_m(wheels, before)]) / before.rolling, 0.0)
        skid_m = wheels.displacement_m[0] - way[0]
        return segments, dataclasses.replace(wheels, displacement_m=way, sigma=sigma, skid_m=float(skid_m))

    def loose_link(
        self, chain: Chain, k: int, more_m2ps: float, noise: SensorNoise
    ) -> gtsam.NonlinearFactorGraph | None:
        """The link into keyframe k with an acceleration less sure, so that the way is by `more_m2ps`."""
        node, before = chain.nodes[k - chain.first], chain.nodes[k - 1 - chain.first]
        made = next((s for t_ns, s in self._linked if t_ns == node.t_ns), None)
        if made is None or not _carries(node.link):
            return None
        x, y = made[0].accel_density_mps2 or (ACCEL_DENSITY_MPS2, ACCEL_DENSITY_MPS2)
        more = _density2(more_m2ps)
        loose = math.sqrt(x * x + more), math.sqrt(y * y + more)
        segments = [dataclasses.replace(piece, accel_density_mps2=loose) for piece in made]
        link = gtsam.NonlinearFactorGraph()
        link.add(imu_factor(k, self._preintegrator.integrate(segments, before.point.bias, noise)))
        return link


def friction_estimator(
    config: EstimatorConfig, preintegrator: Preintegrator, tell: Callable[[WeightChange], None]
) -> FrictionEstimator | None:
    """The `FrictionEstimator` of an estimator; None where weights are fixed, or where IMU or wheels do not allow it.

    A calibration asks what the wheels tell, and leaves friction out.
    """
    inputs = config.inputs
    heard = inputs.planar and inputs.sides and inputs.yaw == "gyro" and not config.calibrate
    return FrictionEstimator(config.rig, preintegrator, tell) if heard and config.mode == "adaptive" else None


def _density2(rate_m2ps: float) -> float:
    """Squared density of an acceleration whose way is after `LASTS_S` as unsure as a walk of `rate_m2ps`."""
    return 3.0 * rate_m2ps / LASTS_S**2


def _across_m(wheels: WheelIncrement, before: KeyState) -> float:
    """How far the wheel factor takes a robot that rolls to go sideways."""
    return float(before.of(SIDE_SLIP) * wheels.distance_m - before.of(ICR_X) * wheels.yaw_rad)


def _carries(link: gtsam.NonlinearFactorGraph) -> bool:
    """Whether the link is one of `_dragged` alone: no hole of the gyro was bridged, no rest held."""
    return link.size() == 1 and isinstance(link.at(0), gtsam.CombinedImuFactor)


def _turned(angle_rad: float) -> Array:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s], [s, c]])
