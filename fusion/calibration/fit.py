"""A robot's numbers from drives with fixes: a planar smoother with a node every few seconds.

Unknown are pose, distance ratio and receiver drift of each node, and `NUMBERS`, which all nodes of all
drives share. Between nodes the path is dead reckoning with the numbers (`motion`); distance ratios spread
about the wheel scale, the receiver drifts as a Gauss-Markov process, and fixes have a robust loss (Cauchy;
iteratively reweighted, Holland and Welsch 1977, Commun. Stat. A6). Gauss-Newton; each drive is reduced to
the numbers by a Schur complement (`reduction`), so that the result's covariance is that of the numbers with
all else unknown. The spread and the correlation time of slip are estimated, too (`slip`).
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration.motion import MotionSegment, dead_reckoned
from terrafusion.fusion.calibration.numbers import WHEEL_SCALE, Knowledge
from terrafusion.fusion.calibration.reduction import NODE, RATIO, YAW, Nodes, Reduction, X, Y
from terrafusion.fusion.calibration.slip import slip_process


def combined(reduced: Sequence[Reduction], now: Knowledge, before: Knowledge) -> Knowledge:
    """The numbers by what drives say of them about `now`, and `before`; moves the nodes, too."""
    information = np.linalg.inv(before.covariance)
    right = information @ (before.mean - now.mean)
    for one in reduced:
        shown, pull = one.without_feigned()
        information = information + shown
        right = right + pull
    covariance = np.linalg.inv(information)
    mean, clipped_s = now.mean + covariance @ right, before.clipped_lag_s
    found = dataclasses.replace(now, mean=mean, covariance=covariance, clipped_lag_s=clipped_s).outwards()
    moments = [one.apply(found.mean - now.mean, found.mean) for one in reduced]
    spread, time_s = slip_process(moments, before.slip_spread, before.slip_time_s)
    misfit = max(one.misfit for one in reduced)
    return dataclasses.replace(found, slip_spread=spread, slip_time_s=time_s, misfit=misfit)


def started(drive: MotionSegment, start: complex, yaw_rad: float, numbers: Array) -> Nodes:
    """Nodes along dead reckoning from a position (east + i north) and yaw."""
    path, first = dead_reckoned(drive, numbers), drive.first
    state = np.zeros((len(first), NODE))
    at = start + np.exp(1j * yaw_rad) * path.z[first]
    state[:, X], state[:, Y] = at.real, at.imag
    state[:, YAW], state[:, RATIO] = yaw_rad + path.yaw_rad[first], numbers[WHEEL_SCALE]
    return Nodes(drive, state)


def information_gained(before: Knowledge, after: Knowledge) -> Array:
    """Information gained on each number (9,), nats: the logarithm of its sigma before over after."""
    return np.asarray(np.log(before.sigma / after.stated_sigma(before)))
