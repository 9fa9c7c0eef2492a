"""Kinematic models of skid steering: what a twin has to beat.

The general one has instantaneous centres of rotation of the two treads (Martinez et al. 2005, Mandow et
al. 2007): five numbers say where each tread and the body turn about and how much of its travel each tread
makes. With symmetric centres at half the track it is the plain differential drive.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.model.vehicle import VehicleParams
from tests.studies.joined_windows import DT_S
from tests.studies.twin_field.fitting import Bounded, fit
from tests.studies.twin_field.forks import N_FUTURE, N_PAST, Forks

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Icr:
    """Centres of rotation, and the actuation in front of them.

    Attributes:
        radius_m: of the wheels as the log counts it.
        x_m: how far ahead of the origin the body's centre lies (sideways speed = -x_m yaw rate).
        left_m, right_m: sideways places of the treads' centres (left positive, right negative).
        left_gain, right_gain: travel over rolled distance of each tread.
        dead_time_s: the inputs act so much later.
        lag_s, turn_lag_s: time constants with which forward speed and yaw rate follow, 0 for at once.
    """

    radius_m: float
    x_m: float
    left_m: float
    right_m: float
    left_gain: float = 1.0
    right_gain: float = 1.0
    dead_time_s: float = 0.0
    lag_s: float = 0.0
    turn_lag_s: float = 0.0

    def predict(self, forks: Forks) -> Array:
        """(F, N_FUTURE + 1, 3) forward speed, sideways speed, yaw rate from each fork on."""
        sides = _delayed(forks.inputs_radps, self.dead_time_s)[:, N_PAST:] * self.radius_m
        left, right = self.left_gain * sides[..., 0], self.right_gain * sides[..., 1]
        wide = self.left_m - self.right_m
        turn = (right - left) / wide
        forward = (right * self.left_m - left * self.right_m) / wide
        if forks.given_turn:
            turn = forks.motion[:, N_PAST:, 2]
        else:
            turn = _lagged(turn, forks.start()[:, 2], self.turn_lag_s)
        forward = _lagged(forward, forks.start()[:, 0], self.lag_s)
        return np.stack([forward, -self.x_m * turn, turn], axis=2)


def plain(vehicle: VehicleParams) -> Icr:
    """Differential drive by the radius and track of the robot's own odometry."""
    radius, half = vehicle.odometry.wheel_radius_m, 0.5 * vehicle.odometry.track_m
    return Icr(radius, 0.0, half, -half)


def radius_and_track(start: Icr, forks: Forks) -> Icr:
    """Differential drive with one gain (a radius) and one effective track, fitted."""

    def model(p: Array) -> Icr:
        return dataclasses.replace(
            start, left_gain=p[0], right_gain=p[0], left_m=0.5 * p[1], right_m=-0.5 * p[1]
        )

    found = fit(
        [*_GAIN, Bounded(start.left_m - start.right_m, 0.2, 8.0)], lambda p: model(p).predict(forks), forks
    )
    return model(found)


def icr(start: Icr, forks: Forks) -> Icr:
    """All five numbers, fitted."""

    def model(p: Array) -> Icr:
        return dataclasses.replace(
            start, left_gain=p[0], right_gain=p[1], left_m=p[2], right_m=-p[3], x_m=p[4]
        )

    wide = 0.5 * (start.left_m - start.right_m)
    starts = [
        Bounded(start.left_gain, 0.2, 2.0), Bounded(start.right_gain, 0.2, 2.0),
        Bounded(wide, 0.1, 4.0), Bounded(wide, 0.1, 4.0), Bounded(start.x_m, -1.0, 1.0),
    ]  # fmt: skip
    return model(fit(starts, lambda p: model(p).predict(forks), forks))


def lags(start: Icr, forks: Forks) -> Icr:
    """The model as it is behind a fitted dead time and one fitted lag each for speed and turn."""

    def model(p: Array) -> Icr:
        return dataclasses.replace(start, dead_time_s=p[0], lag_s=p[1], turn_lag_s=p[2])

    return model(fit(_LAGS, lambda p: model(p).predict(forks), forks))


def lagged(start: Icr, forks: Forks) -> Icr:
    """The model behind a dead time and one lag each for speed and turn, everything fitted together."""

    def model(p: Array) -> Icr:
        return dataclasses.replace(
            start, left_gain=p[0], right_gain=p[1], left_m=p[2], right_m=-p[3], x_m=p[4],
            dead_time_s=p[5], lag_s=p[6], turn_lag_s=p[7],
        )  # fmt: skip

    starts = [
        Bounded(start.left_gain, 0.2, 2.0), Bounded(start.right_gain, 0.2, 2.0),
        Bounded(start.left_m, 0.1, 4.0), Bounded(-start.right_m, 0.1, 4.0), Bounded(start.x_m, -1.0, 1.0),
        *_LAGS,
    ]  # fmt: skip
    return model(fit(starts, lambda p: model(p).predict(forks), forks))


_GAIN = (Bounded(1.0, 0.2, 2.0),)
_LAGS = (Bounded(0.1, 0.0, 0.9), Bounded(0.3, 0.0, 5.0), Bounded(0.3, 0.0, 5.0))


def _delayed(inputs: Array, dead_time_s: float) -> Array:
    """Inputs (F, T, 2) that act later, linear between samples, the first one held before."""
    steps = dead_time_s / DT_S
    whole = int(np.floor(steps))
    share = steps - whole
    padded = np.concatenate([np.repeat(inputs[:, :1], whole + 1, axis=1), inputs], axis=1)
    count = inputs.shape[1]
    return (1.0 - share) * padded[:, 1 : 1 + count] + share * padded[:, :count]


def _lagged(target: Array, start: Array, lag_s: float) -> Array:
    """First-order response (F, T) to a target (F, T), exact for one that is linear between samples.

    From an unknown start (NaN) it begins on the target.
    """
    ratio = DT_S / max(lag_s, 1e-6)
    decay = float(np.exp(-ratio))
    if ratio > 50.0:
        return target
    # x' = (u - x) / T with u linear: x1 = e x0 + (m - e) u0 + (1 - m) u1, m = (1 - e) / ratio.
    mean = (1.0 - decay) / ratio
    out = np.empty_like(target)
    out[:, 0] = np.where(np.isfinite(start), start, target[:, 0])
    for k in range(N_FUTURE):
        out[:, k + 1] = decay * out[:, k] + (mean - decay) * target[:, k] + (1.0 - mean) * target[:, k + 1]
    return out
