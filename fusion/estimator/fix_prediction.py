"""A fix against its prediction by the state of its keyframe."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.estimator.fix_keyframe import AntennaMotion
from terrafusion.fusion.estimator.gates import GateDecision
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.gnss_factor import GnssPosition, linearised
from terrafusion.fusion.graph.key_state import NAV, POSE, VELOCITY, KeyState
from terrafusion.fusion.inputs.validation import GnssFix
from terrafusion.fusion.weighting.weighting import InnovationTest

LARGE_TURN_RAD = 0.05
UNKNOWN_HEIGHT_SIGMA_M = 1e6
"""1 sigma of an unknown height: even many such fixes must not determine it."""


@dataclass(frozen=True, eq=False)
class PredictedFix:
    """A fix of keyframe k and what the estimate says of it.

    Attributes:
        state, covariance: of the keyframe; (dim, dim).
        motion: of the antenna.
        position: its factor.
        innovation_m: (3,) fix less prediction, ENU.
        jacobian, predicted_m2: of the prediction, (3, dim) and (3, 3).
        own_m2: (2,) variance of the fix itself for the gate, east and north.
        S_m2: (2, 2) covariance of the innovation, east and north.
    """

    k: int
    fix: GnssFix
    state: KeyState
    covariance: Array
    motion: AntennaMotion
    position: GnssPosition
    innovation_m: Array
    jacobian: Array
    predicted_m2: Array
    own_m2: Array
    S_m2: Array

    @classmethod
    def of(
        cls, chain: Chain, k: int, fix: GnssFix, antenna_m: Array, white_m: Array, share: float, all_m: Array
    ) -> Self:
        """By the estimate of the chain; `antenna_m` without what that estimates of it.

        `white_m` and `all_m` are 1 sigma (3,) of the white errors and of all, `share` is that of the drift.
        """
        state, covariance = chain.state(k), chain.covariance_at(k)
        at = AntennaMotion.of(chain, k, fix, antenna_m)
        # The fix is carried to its keyframe by the speed as it is known now.
        east, north = VELOCITY.start, VELOCITY.start + 1
        carried_m = abs(at.offset_s) * math.sqrt(0.5 * (covariance[east, east] + covariance[north, north]))
        sigma = np.hypot(white_m, carried_m)
        position = GnssPosition(fix.enu_m, at.lever_m, sigma, share, at.velocity_mps, delay_s=at.delay_s)
        left, by_pose, by_linear = linearised(position, state)
        J = np.zeros((3, chain.dim))
        J[:, POSE], J[:, NAV.stop :] = by_pose, by_linear[:, : chain.dim - NAV.stop]
        predicted_m2 = J @ covariance @ J.T
        # The gate allows for all that the receiver reports, whatever share of it is taken to be white.
        own_m2 = np.maximum(sigma[:2], all_m[:2]) ** 2
        S_m2 = predicted_m2[:2, :2] + np.diag(own_m2)
        return cls(k, fix, state, covariance, at, position, -left, J, predicted_m2, own_m2, S_m2)

    def innovation_test(self, scale: float, drift_sigma_m: float, white_share: float) -> InnovationTest:
        """Its horizontal part for a `Weighting`; the reported sigma counts `scale` times."""
        return InnovationTest(
            self.fix.t_ns,
            self.innovation_m[:2],
            self.predicted_m2.diagonal()[:2],
            self.position.sigma_m[:2] ** 2,
            self.fix.sigma_m[:2] * scale,
            (self.position.drift_share * drift_sigma_m) ** 2,
            white_share,
        )

    def weighted(self, scale: float, weight: float) -> Self:
        """With `scale` times the horizontal sigma, and the weight of a robust loss."""
        sigma = self.position.sigma_m
        S_m2 = self.S_m2 + np.diag((scale**2 - 1.0) * sigma[:2] ** 2)
        sigma = sigma * np.array([scale, scale, 1.0])
        position = dataclasses.replace(self.position, sigma_m=sigma, weight=weight)
        return dataclasses.replace(self, position=position, S_m2=S_m2)


def cut_past(chain: Chain, used: PredictedFix, verdict: GateDecision) -> bool:
    """Cut the past off before a fix that would turn it far, or that shows the estimate to be wrong.

    A fix after a long outage can turn the heading by more than the window's linearisation bears;
    applied to its keyframe alone it is a Kalman update, which cannot diverge.
    """
    doubt, innovation_m = np.zeros(chain.dim), used.innovation_m[:2]
    if verdict is GateDecision.REACQUIRE:
        doubt[3:6] = float(innovation_m @ innovation_m)
    else:
        (a, b), (c, d) = used.S_m2.tolist()
        x, y = innovation_m.tolist()
        solved = np.array([d * x - b * y, a * y - c * x]) / (a * d - b * c)
        turn = used.covariance[:3] @ (used.jacobian[:2].T @ solved)
        if max(map(abs, turn.tolist())) < LARGE_TURN_RAD:
            return False
    chain.restart(doubt, used.k)
    return True


def without_height(fix: GnssPosition, state: KeyState) -> GnssPosition:
    """A fix whose height is that of the keyframe's `state`, and of no weight."""
    enu_m = np.append(fix.enu_m[:2], state.place_of(fix.lever_m)[2])
    sigma = np.append(fix.sigma_m[:2], UNKNOWN_HEIGHT_SIGMA_M)
    return dataclasses.replace(fix, enu_m=enu_m, sigma_m=sigma)
