"""GNSS fixes on their way into the chain: timing, gates, weights."""

from __future__ import annotations

import bisect
import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from terrafusion.datasets.frames import GRAVITY_MPS2
from terrafusion.fusion.chain import POSE, Chain
from terrafusion.fusion.config import EstimatorConfig
from terrafusion.fusion.estimate import Innovation
from terrafusion.fusion.factors import antenna_lever, gnss_position, gnss_velocity
from terrafusion.fusion.gates import GnssGate
from terrafusion.fusion.streams import GnssFix
from terrafusion.fusion.weighting import SensorNoise

Array = NDArray[np.float64]

LEAST_SIGMA_M = 0.005
UNKNOWN_HEIGHT_SIGMA_M = 100.0


class GnssUpdater:
    """Holds fixes until a keyframe has passed them, tests position and height apart (a wrong
    height must not cost a good position) them and adds their factors.

    Attributes:
        waiting: fixes not yet used, oldest first.
        local: the graph was started without GNSS; fixes are rejected.
        rejected, too_late: how many fixes the gate refused, or came after their keyframe was dropped.
        last_used_ns: time of the newest fix in the graph.
    """

    def __init__(self, config: EstimatorConfig, report: Callable[[Innovation], None]) -> None:
        self.antenna_m = np.array(config.rig.sensors.gnss.antenna_m)
        self.gate = GnssGate(float(chi2.ppf(config.gnss_gate, 2)))
        self.height_gate = GnssGate(float(chi2.ppf(config.gnss_gate, 1)))
        spec = config.rig.sensors.gnss
        # Heights are wrong for minutes at a time: a white error of this size has their spectrum at low
        # frequency (Gauss-Markov: 2 sigma^2 tau), so that many fixes do not pretend to average them out.
        repeated = float(np.sqrt(1.0 + 2.0 * spec.correlation_time_s * spec.rate_hz))
        self._correlated = np.array([1.0, 1.0, repeated])
        self.waiting: list[GnssFix] = []
        self.local = False
        self.rejected = 0
        self.too_late = 0
        self.last_used_ns: int | None = None
        self._report = report
        self._seen = 0

    def queue(self, fix: GnssFix) -> None:
        """Take a fix in; order of arrival need not be order of time."""
        self.waiting.append(fix)
        if len(self.waiting) > 1 and fix.t_ns < self.waiting[-2].t_ns:
            self.waiting.sort(key=lambda f: f.t_ns)

    def news(self) -> bool:
        """Whether fixes came since the last call."""
        changed = len(self.waiting) != self._seen
        self._seen = len(self.waiting)
        return changed

    def update(
        self,
        chain: Chain,
        times_ns: list[int],
        means: list[tuple[Array, Array]],
        covariance: Array,
        row: SensorNoise,
    ) -> bool:
        """Use every waiting fix that some keyframe has passed; True when a factor was added.

        A fix belongs to the first keyframe after it. `times_ns` and `means`
        (rate (3,), specific force (3,) of the interval before) run along the
        chain's keyframes; `covariance` (16, 16) is that of the newest one.
        """
        used = False
        while self.waiting and self.waiting[0].t_ns <= times_ns[-1]:
            fix = self.waiting.pop(0)
            i = bisect.bisect_left(times_ns, fix.t_ns)
            if self.local:
                self.rejected += 1
            elif i == 0 and fix.t_ns != times_ns[0]:
                self.too_late += 1
            else:
                k = chain.first + i
                if k < chain.last:
                    chain.smooth(chain.last - k + 2)
                offset_s = (fix.t_ns - times_ns[i]) * 1e-9
                used |= self._add(chain, k, fix, offset_s, covariance, *means[i], row)
        return used

    def _add(
        self,
        chain: Chain,
        k: int,
        fix: GnssFix,
        offset_s: float,
        covariance: Array,
        gyro_radps: Array,
        accel_mps2: Array,
        row: SensorNoise,
    ) -> bool:
        state = chain.state(k)
        R = state.pose.rotation().matrix()
        rate = gyro_radps - state.bias.gyroscope()
        accel_world = R @ (accel_mps2 - state.bias.accelerometer()) - np.array([0.0, 0.0, GRAVITY_MPS2])
        lever = antenna_lever(state, offset_s, rate, accel_world, self.antenna_m)
        predicted = np.asarray(state.pose.translation()) + R @ lever
        sigma = np.maximum(fix.sigma_m * row.gnss_inflation * self._correlated, LEAST_SIGMA_M)
        innovation = fix.enu_m - predicted
        P = _antenna_covariance(covariance[POSE, POSE], R, lever)
        P[[0, 1], [0, 1]] += sigma[:2] ** 2
        accepted, nis = self.gate.test(innovation[:2], P[:2, :2])
        self._report(Innovation(fix.t_ns, "gnss", innovation, nis, 2, accepted))
        if not accepted:
            self.rejected += 1
            return False
        known = bool(np.isfinite(innovation[2] + sigma[2]))
        if not (known and self.height_gate.test(innovation[2:], P[2:, 2:] + sigma[2] ** 2)[0]):
            fix = dataclasses.replace(fix, enu_m=np.append(fix.enu_m[:2], predicted[2]))
            sigma[2] = UNKNOWN_HEIGHT_SIGMA_M
        chain.add(k, gnss_position(k, fix, lever, sigma), "X")
        if fix.velocity_mps is not None and np.isfinite(fix.velocity_mps.sum() + fix.sigma_v_mps):
            body_velocity = fix.velocity_mps - R @ np.cross(rate, self.antenna_m) - accel_world * offset_s
            sigma_v = round(max(fix.sigma_v_mps * row.gnss_inflation, 1e-3), 4)
            chain.add(k, gnss_velocity(k, body_velocity, sigma_v), "V")
        self.last_used_ns = fix.t_ns
        return True


def _antenna_covariance(P_pose: Array, R: Array, lever: Array) -> Array:
    """Covariance (3, 3) of the antenna position in the world from that of the pose (GTSAM order)."""
    J = np.zeros((3, 6))
    J[:, :3] = -R @ np.array(
        [[0.0, -lever[2], lever[1]], [lever[2], 0.0, -lever[0]], [-lever[1], lever[0], 0.0]]
    )
    J[:, 3:] = R
    return np.asarray(J @ P_pose @ J.T)
