"""Aligns a path that was begun without GNSS with the map.

Until fixes come the path is local: its start and heading are arbitrary. Wheels and gyro trace its shape
(`DeadReckoning`); once the fixes of the last half minute show how that shape lies on the map, the window
is turned and shifted as a whole. States already reported stay as they are.
"""

import dataclasses
from dataclasses import dataclass

import gtsam
import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.estimator.dead_reckoning import DeadReckoning
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.key_state import DRIFT, quaternion_of
from terrafusion.fusion.graph.node import Node
from terrafusion.fusion.inputs.validation import GnssFix

PLACE = (2, 3, 4, 5)
"""Tangent of heading and position: what a local frame leaves open; the last is the height."""
YAW_SIGMA_RAD = 0.25
"""What the window's linearisation bears; further fixes reduce it (assumed)."""
UPRIGHT = 0.99
"""Least vertical part of a direction that is the same in every frame: a level robot's up."""
OPEN_YAW_RAD, OPEN_M = np.pi, 1e4
"""Prior sigmas of heading and position of the first keyframe in a batch, once aligned."""


@dataclass(frozen=True, eq=False)
class MapAlignment:
    """The turn `yaw_rad` about the vertical and the shift that brings `from_m` (3,) to `to_m` (3,), ENU, from
    the keyframe at `t_ns` on.
    """

    t_ns: int
    yaw_rad: float
    from_m: Array
    to_m: Array

    def moved(self, state: State) -> State:
        """A local state on the map."""
        turn = gtsam.Rot3.Rz(self.yaw_rad)
        R = turn.matrix()
        both = np.kron(np.eye(2), R)
        x, y, z, w = state.quaternion
        return dataclasses.replace(
            state,
            position_m=self.to_m + R @ (state.position_m - self.from_m),
            quaternion=quaternion_of(gtsam.Pose3(turn * gtsam.Rot3.Quaternion(w, x, y, z), np.zeros(3))),
            velocity_mps=R @ state.velocity_mps,
            covariance=both @ state.covariance @ both.T,
            velocity_covariance=R @ state.velocity_covariance @ R.T,
        )


def align_to_map(
    chain: Chain, track: DeadReckoning, fix: GnssFix, antenna_m: Array, drift_sigma_m: float
) -> MapAlignment | None:
    """Align the window with the map once the heading on it is known to `YAW_SIGMA_RAD`; else None."""
    fit = track.fit(1.0, YAW_SIGMA_RAD)
    if fit is None:
        return None
    chain.smooth(len(chain.nodes))
    antenna = chain.state(chain.last).place_of(antenna_m)
    there = fit.at(track.antenna())
    known = bool(np.isfinite(fix.enu_m[2] + fix.sigma_m[2]))
    to_m = np.array([there.real, there.imag, fix.enu_m[2] if known else antenna[2]])
    away_m = abs(track.antenna() - fit.middle)
    reported_m = fix.horizontal_sigma_m
    doubt = np.zeros(chain.dim)
    doubt[2] = fit.sigma_rad**2
    doubt[3:5] = reported_m**2 + fit.residual_m**2 + (fit.sigma_rad * away_m) ** 2
    doubt[5] = float(fix.sigma_m[2]) ** 2 if known else 0.0
    doubt[DRIFT] = drift_sigma_m**2
    opened = PLACE if known else PLACE[:3]  # fixes without height leave that of the start as it is
    alignment = MapAlignment(chain.nodes[-1].t_ns, track.error_of(fit), antenna, to_m)
    drop_local_factors(chain.nodes)
    chain.restart(doubt, chain.first, opened)
    chain.turn(alignment.yaw_rad, alignment.from_m, alignment.to_m)
    chain.smooth(len(chain.nodes))
    if chain.archive is not None:
        drop_local_factors(chain.archive.nodes)
        chain.archive.turn(alignment.yaw_rad, alignment.from_m, alignment.to_m)
        prior = chain.archive.nodes[0].prior
        prior[opened, :] = 0.0
        prior[opened, opened] = 1.0 / np.array([OPEN_YAW_RAD, OPEN_M, OPEN_M, OPEN_M])[: len(opened)]
    track.restart()
    return alignment


def turn_window(
    chain: Chain, k: int, fix: GnssFix, turn_rad: float, antenna_m: Array, scale: float, doubt: Array
) -> None:
    """Turn the whole window, whose heading was wrong, and shift the antenna at keyframe k to a fix.

    All that the wrong heading may have bent is in `doubt` (dim,) again, variances, and the place by how far
    it moves and by the fix, sigma times `scale`.
    """
    chain.smooth(len(chain.nodes))
    antenna = chain.state(k).place_of(antenna_m)
    off = float(np.hypot(*(fix.enu_m - antenna)[:2]))
    doubt[3:6] = off**2 + (fix.horizontal_sigma_m * scale) ** 2
    chain.restart(doubt, chain.first)
    chain.turn(turn_rad, antenna, np.append(fix.enu_m[:2], antenna[2]))
    chain.smooth(len(chain.nodes))


def drop_local_factors(nodes: list[Node]) -> None:
    """Drop headings and heights of aiding sensors in a local frame.

    Their sigmas are relative to an arbitrary start: turned along they would make the map's heading as
    certain.
    """
    for node in nodes:
        factors = [node.unary.at(i) for i in range(node.unary.size())]
        stays = [factor for factor in factors if not _is_local(factor)]
        if len(stays) < len(factors):
            node.unary = gtsam.NonlinearFactorGraph()
            for factor in stays:
                node.unary.add(factor)


def _is_local(factor: gtsam.NonlinearFactor) -> bool:
    """Whether a factor of one pose is a height, or a direction other than the vertical."""
    if isinstance(factor, gtsam.AttitudeFactorPose3):
        return abs(float(factor.nRef().point3()[2])) < UPRIGHT
    return isinstance(factor, gtsam.GPSFactorArm)
