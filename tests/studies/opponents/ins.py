"""A strapdown INS with feedback: error-state Kalman filter over fixes and the wheels' body velocity.

The model is that of the usual packages for inertial navigation (pyins among them, which is on no package
index and so is not run here): errors of position, velocity, attitude and both biases; wheels measure the body
velocity (v, 0, 0), which is a non-holonomic constraint too. Flat, non-rotating earth.
Equations: Sola 2017, "Quaternion kinematics for the error-state Kalman filter", sec. 5, errors local.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.studies.opponents.inertial import (
    ABSENT_ACCEL,
    GRAVITY_MPS2,
    HEADING_SIGMA_RAD,
    LEVEL_SIGMA_RAD,
    Inertial,
)
from tests.studies.opponents.protocol import Blocked

Array = NDArray[np.float64]

GRAVITY = np.array([0.0, 0.0, -GRAVITY_MPS2])
STEP_S = 0.1
"""Longest step of the covariance, as for the keyframes of others."""
POSITION, VELOCITY, ATTITUDE, GYRO, ACCEL = (slice(3 * i, 3 * i + 3) for i in range(5))
GATE_SIGMA = 3.0
"""A larger innovation raises the noise of its fix."""
BIAS_WALK = (1e-5, 1e-3)


@dataclass(frozen=True)
class Noise:
    """Fixed noise: body velocity of the wheels (m/s), IMU densities as for GTSAM, factor on fixes' sigma."""

    wheels_mps: float = 0.1
    gyro: float = 3e-3
    accel: float = 0.1
    fix_factor: float = 1.0


class _Filter:
    """State and covariance."""

    def __init__(self, inputs: Inertial, noise: Noise) -> None:
        x, y, heading = inputs.start
        self.R = np.asarray(
            Rotation.from_euler("ZYX", [heading, inputs.level[1], inputs.level[0]]).as_matrix()
        )
        self.p = np.array([x, y, inputs.fixes[0, 3]])
        self.v = self.R @ np.array([inputs.speed_at(inputs.fixes[0, 0]), 0.0, 0.0])
        self.bg, self.ba = np.zeros(3), np.zeros(3)
        sigma = noise.fix_factor * inputs.fixes[0, 4]
        level = [LEVEL_SIGMA_RAD, LEVEL_SIGMA_RAD, HEADING_SIGMA_RAD]
        self.P = np.diag(np.square([sigma, sigma, 2 * sigma, 0.5, 0.5, 0.5, *level, *[0.01] * 3, *[0.3] * 3]))
        accel = noise.accel if inputs.has_accel else ABSENT_ACCEL
        walk = [BIAS_WALK[0]] * 3 + [BIAS_WALK[1]] * 3
        self.q = np.square([0.0, 0.0, 0.0, *[accel] * 3, *[noise.gyro] * 3, *walk])

    def move(self, gyro: Array, accel: Array, dt: Array) -> None:
        """Through samples (n, 3) that last dt (n,); the covariance in one step."""
        mean, begin = np.zeros(3), self.R
        for w, f, step in zip(gyro, accel, dt, strict=True):
            force = self.R @ (f - self.ba)
            a = force + GRAVITY
            self.p = self.p + self.v * step + 0.5 * a * step**2
            self.v = self.v + a * step
            self.R = self.R @ _exp((w - self.bg) * step)
            mean += force * step
        total = float(dt.sum())
        F = np.eye(15)
        F[POSITION, VELOCITY] = np.eye(3) * total
        F[VELOCITY, ATTITUDE] = -_cross(mean) @ begin
        F[VELOCITY, ACCEL] = -begin * total
        F[ATTITUDE, ATTITUDE] = self.R.T @ begin
        F[ATTITUDE, GYRO] = -np.eye(3) * total
        self.P = F @ self.P @ F.T + np.diag(self.q * total)

    def correct(self, r: Array, H: Array, sigma: Array, gate: bool) -> None:
        """By a measurement with residual r (3,) and Jacobian H (3, 15)."""
        S = H @ self.P @ H.T + np.diag(sigma**2)
        if gate:
            S = S + np.eye(3) * max(0.0, (r[:2] @ r[:2]) / GATE_SIGMA**2 - 0.5 * (S[0, 0] + S[1, 1]))
        K = np.linalg.solve(S, H @ self.P).T
        d = K @ r
        self.P = self.P - K @ H @ self.P
        self.P = 0.5 * (self.P + self.P.T)
        self.p, self.v = self.p + d[POSITION], self.v + d[VELOCITY]
        self.R = self.R @ _exp(d[ATTITUDE])
        self.bg, self.ba = self.bg + d[GYRO], self.ba + d[ACCEL]

    def fix(self, position: Array, arm: Array, sigma: float) -> None:
        H = np.zeros((3, 15))
        H[:, POSITION], H[:, ATTITUDE] = np.eye(3), -self.R @ _cross(arm)
        self.correct(position - self.p - self.R @ arm, H, sigma * np.array([1.0, 1.0, 2.0]), True)

    def wheels(self, speed: float, sigma: float) -> None:
        H, body = np.zeros((3, 15)), self.R.T @ self.v
        H[:, VELOCITY], H[:, ATTITUDE] = self.R.T, _cross(body)
        self.correct(np.array([speed, 0.0, 0.0]) - body, H, np.full(3, sigma), False)


def run(inputs: Inertial, blocked: Blocked, noise: Noise) -> tuple[Array, Array]:
    """Times (K,) of the events and the position (K, 2) at each."""
    first, last = inputs.fixes[0, 0], min(inputs.streams.t_s[-1], inputs.imu_s[-1])
    times = np.unique(np.r_[inputs.streams.t_s, inputs.fixes[:, 0], np.arange(first, last, STEP_S)])
    times = times[(times >= first) & (times <= last)]
    fixes = {fix[0]: fix for fix in inputs.fixes}
    speeds = dict(zip(inputs.streams.t_s.tolist(), inputs.streams.v_mps.tolist(), strict=True))
    state, out = _Filter(inputs, noise), np.empty((len(times), 2))
    for k, t in enumerate(times.tolist()):
        if k:
            state.move(*_samples(inputs, float(times[k - 1]), t))
        if t in speeds:
            state.wheels(speeds[t], noise.wheels_mps)
        fix = fixes.get(t)
        if fix is not None and not blocked(t):
            state.fix(fix[1:4], inputs.antenna_m, noise.fix_factor * float(fix[4]))
        out[k] = (state.p + state.R @ inputs.point_m)[:2]
    return times, out


def _samples(inputs: Inertial, begin: float, end: float) -> tuple[Array, Array, Array]:
    """Rates, forces and durations from one time to the next; a sample holds for the time before it."""
    first, last = np.searchsorted(inputs.imu_s, [begin, end], side="right")
    edges = np.r_[begin, inputs.imu_s[first:last], end]
    rows = np.minimum(np.arange(first, last + 1), len(inputs.imu_s) - 1)
    dt = np.diff(edges)
    used = dt > 0.0
    return inputs.gyro_radps[rows[used]], inputs.accel_mps2[rows[used]], dt[used]


def _cross(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _exp(v: Array) -> Array:
    """Rotation of a small vector, to third order."""
    K = _cross(v)
    return np.asarray(np.eye(3) + K + 0.5 * K @ K + K @ K @ K / 6.0)
