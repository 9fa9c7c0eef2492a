"""GNSS fixes on their way into the chain: timing, gates, weights."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from terrafusion.datasets.frames import GRAVITY_MPS2
from terrafusion.fusion.config import EstimatorConfig
from terrafusion.fusion.estimate import Innovation
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.factors import antenna_lever, gnss_velocity
from terrafusion.fusion.graph.gnss_factor import GnssPosition, jacobians, residual
from terrafusion.fusion.graph.key_state import ANTENNA, DIM, MARKOV, POSE
from terrafusion.fusion.inputs.gates import GnssGate, Verdict
from terrafusion.fusion.inputs.streams import GnssFix
from terrafusion.fusion.weights.policy import SensorNoise

Array = NDArray[np.float64]

LEAST_SIGMA_M = 0.005
UNKNOWN_HEIGHT_SIGMA_M = 100.0
LARGE_TURN_RAD = 0.05
WHITE_SHARE = 0.2
"""Share of a fix's variance that is new at every fix; the rest drifts slowly."""
OPTIMISM = 3.0
"""A stand-alone receiver may claim so many times less than its data sheet and drift all the same; one
that claims even less has fixes of a better class (RTK), which drift in proportion to what they claim."""


class GnssUpdater:
    """Holds fixes until a keyframe has passed them, tests position and height apart (a wrong
    height must not cost a good position) and adds their factors.

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
        self.sheet_sigma_m = spec.sigma_horizontal_m
        self.drift_sigma_m = spec.sigma_horizontal_m * float(np.sqrt(1.0 - WHITE_SHARE))
        self.drift_time_s = max(spec.correlation_time_s, 0.1)
        # Heights are wrong for minutes at a time and of little use on the ground: no state is spent on them,
        # they are held to the whole Gauss-Markov spectrum at low frequency (2 sigma^2 tau) instead.
        self._height_factor = float(np.sqrt(1.0 + 2.0 * spec.correlation_time_s * spec.rate_hz))
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

    def update(self, chain: Chain, covariance: Array, row: SensorNoise) -> bool:
        """Use every waiting fix that the newest keyframe has passed; True when a factor was added.

        A fix belongs to the first keyframe after it. `covariance` (DIM, DIM) is
        that of the newest keyframe.
        """
        used = False
        while self.waiting and self.waiting[0].t_ns <= chain.nodes[-1].t_ns:
            fix = self.waiting.pop(0)
            k = chain.at_or_after(fix.t_ns)
            if self.local:
                self.rejected += 1
            elif k is None:
                self.too_late += 1
            else:
                if k < chain.last:
                    chain.smooth(chain.last - k + 2)
                used |= self._add(chain, k, fix, covariance, row)
        return used

    def _add(self, chain: Chain, k: int, fix: GnssFix, covariance: Array, row: SensorNoise) -> bool:
        node, state = chain.nodes[k - chain.first], chain.state(k)
        offset_s = (fix.t_ns - node.t_ns) * 1e-9
        R = state.pose.rotation().matrix()
        rate = node.gyro_radps - state.bias.gyroscope()
        accel_world = R @ (node.accel_mps2 - state.bias.accelerometer()) - np.array([0.0, 0.0, GRAVITY_MPS2])
        antenna = self.antenna_m + np.append(state.of(ANTENNA), 0.0)
        lever = antenna_lever(state, offset_s, rate, accel_world, antenna) - (antenna - self.antenna_m)
        velocity = state.velocity + accel_world * offset_s + R @ np.cross(rate, antenna)
        share = self._drift_share(fix, row)
        sigma = self._white_sigma(fix, row, share)
        position = GnssPosition(fix.enu_m, lever, sigma, share, velocity)
        innovation = -residual(position, state.pose, state.linear)
        J = np.zeros((3, DIM))
        J[:, POSE], J[:, MARKOV] = jacobians(position, state.pose, state.linear)
        P = J @ covariance @ J.T
        # The gate allows for all that the receiver reports, whatever share of it is taken to be white.
        P[[0, 1], [0, 1]] += np.maximum(sigma[:2], fix.sigma_m[:2] * row.gnss_inflation) ** 2
        verdict, nis = self.gate.test(innovation[:2], P[:2, :2])
        self._report(Innovation(fix.t_ns, "gnss", innovation, nis, 2, verdict is not Verdict.REJECT))
        if verdict is Verdict.REJECT:
            self.rejected += 1
            return False
        cut = k == chain.last and self._prepare(chain, covariance, innovation[:2], P[:2, :2], J[:2], verdict)
        known = bool(np.isfinite(innovation[2] + sigma[2]))
        if not known or self.height_gate.test(innovation[2:], P[2:, 2:] + sigma[2] ** 2)[0] is Verdict.REJECT:
            height = (np.asarray(state.pose.translation()) + R @ lever)[2]
            sigma = np.append(sigma[:2], UNKNOWN_HEIGHT_SIGMA_M)
            position = dataclasses.replace(position, enu_m=np.append(fix.enu_m[:2], height), sigma_m=sigma)
        chain.add_fix(k, position)
        if fix.velocity_mps is not None and np.isfinite(fix.velocity_mps.sum() + fix.sigma_v_mps):
            body_velocity = fix.velocity_mps - R @ np.cross(rate, self.antenna_m) - accel_world * offset_s
            sigma_v = round(max(fix.sigma_v_mps * row.gnss_inflation, 1e-3), 4)
            chain.add(k, gnss_velocity(k, body_velocity, sigma_v), "V")
        if cut:
            chain.smooth(1)
            chain.restart(np.zeros(DIM))
        self.last_used_ns = fix.t_ns
        return True

    def _drift_share(self, fix: GnssFix, row: SensorNoise) -> float:
        """How much of the receiver's drift is in this fix, 0 to 1."""
        claimed = float(np.max(fix.sigma_m[:2])) * row.gnss_inflation
        return min(1.0, OPTIMISM * claimed / self.sheet_sigma_m)

    def _white_sigma(self, fix: GnssFix, row: SensorNoise, share: float) -> Array:
        """1 sigma (3,) of what is new in a fix, beyond the drift that is a state."""
        reported = fix.sigma_m * row.gnss_inflation
        drift_m = share * self.drift_sigma_m
        level = np.sqrt(np.maximum(reported[:2] ** 2 - drift_m**2, WHITE_SHARE * reported[:2] ** 2))
        return np.maximum(np.append(level, reported[2] * self._height_factor), LEAST_SIGMA_M)

    @staticmethod
    def _prepare(
        chain: Chain, covariance: Array, innovation_m: Array, S: Array, jacobian: Array, verdict: Verdict
    ) -> bool:
        """Cut the past off before a fix that would turn it far, or that shows the estimate to be wrong.

        A fix after a long outage can turn the heading by more than the window's
        linearisation bears; applied to the newest keyframe alone it is a Kalman
        update, which cannot diverge.
        """
        gain = covariance @ jacobian.T @ np.linalg.inv(S)
        doubt = np.zeros(DIM)
        if verdict is Verdict.REACQUIRE:
            doubt[3:6] = float(innovation_m @ innovation_m)
        elif float(np.abs(gain[:3] @ innovation_m).max()) < LARGE_TURN_RAD:
            return False
        chain.restart(doubt)
        return True
