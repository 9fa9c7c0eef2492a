"""Odometry between keyframes: the newest state propagated to the newest IMU sample.

A keyframe is made every 0.1 s and waits for the wheels; a controller needs the pose at the rate of the IMU.
From the newest keyframe on, samples are integrated as between keyframes (`Preintegrator`), bias removed.
The error of that state, (rotation, position: body axes; velocity: world axes; biases), is propagated to
first order (Forster, Carlone, Dellaert, Scaramuzza 2017, IEEE T-RO 33(1), eq. 37 and appendix A.2)::

    d theta_j = dR' d theta_i - dt d b_g
    d p_j     = R_j' (R_i d p_i + dt d v_i - R_i [dp]x d theta_i - dt^2/2 R_i d b_a)
    d v_j     = d v_i - R_i [dv]x d theta_i - dt R_i d b_a

with the preintegrated dR, dp, dv, whose own covariance is added. Wheels take no part: a keyframe is at
most `wheel_wait_s` and one step behind the IMU.
"""

import bisect
import dataclasses
import math
from typing import Any

import gtsam
import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.estimator.key_states import covariance_fields, key_state_of
from terrafusion.fusion.graph.key_state import DIM, NAV, quaternion_of, skew
from terrafusion.fusion.graph.planar import with_centripetal_force
from terrafusion.fusion.graph.preintegration import Preintegrator
from terrafusion.fusion.inputs.streams import ImuStream
from terrafusion.fusion.noise.policy import SensorNoise


class Propagator:
    """Propagates one keyframe's state; each sample is integrated once."""

    def __init__(self, preintegrator: Preintegrator) -> None:
        self._preintegrator = preintegrator
        self._state: State | None = None
        self._until_ns = 0
        self._count = 0
        self._measured: gtsam.PreintegratedCombinedMeasurements
        self._now: State

    def carry(self, state: State, covariance: Array, imu: ImuStream, noise: SensorNoise) -> State:
        """The state at the newest IMU sample, with `covariance` (dim, dim) of the keyframe propagated.

        Slip, terrain, status and biases stay those of the keyframe, the angular velocity is that of the
        newest sample. With no sample after the keyframe this is `state` itself. Asked again before anything
        new has come, as for the other frame, it is a copy.
        """
        newest_ns = imu.t_ns[-1]
        if newest_ns <= state.t_ns:
            return state
        if self._state is not state or self._taken(imu) != self._count:
            self._begin(state, covariance, noise)
        elif newest_ns == self._until_ns:
            return _copied(self._now)
        segments = imu.segments(self._until_ns, newest_ns)
        if not imu.six_axis:
            segments = with_centripetal_force(segments, self._key)
        for segment in segments:
            self._measured.integrateMeasurement(segment.accel_mps2, segment.gyro_radps, segment.dt_s)
            self._readings += segment.dt_s * np.array([segment.gyro_radps, segment.accel_mps2])
        self._until_ns = newest_ns
        self._count = self._taken(imu)
        density = np.array(noise.gyro_axes()) * self._preintegrator.spec.gyro_noise_radps_sqrthz
        interval_s = max(newest_ns - imu.t_ns[-2], 1) * 1e-9 if len(imu.t_ns) > 1 else 1.0
        if segments:
            self._gyro = segments[-1].gyro_radps
        self._now = self._carried(state, self._gyro, density / math.sqrt(interval_s))
        return _copied(self._now)

    def _taken(self, imu: ImuStream) -> int:
        """Number of samples between keyframe and `_until_ns`: it changes when a late one comes."""
        assert self._state is not None
        return bisect.bisect_right(imu.t_ns, self._until_ns) - bisect.bisect_right(imu.t_ns, self._state.t_ns)

    def _begin(self, state: State, covariance: Array, noise: SensorNoise) -> None:
        self._state, self._until_ns = state, state.t_ns
        self._key = key = key_state_of(state)
        self._from = gtsam.NavState(key.pose, key.velocity)
        self._covariance, self._count, self._readings = covariance, 0, np.zeros((2, 3))
        self._measured = self._preintegrator.integrate([], key.bias, noise)

    def _carried(self, state: State, gyro_radps: Array, gyro_sigma_radps: Array) -> State:
        measured = self._measured
        seconds = max(measured.deltaTij(), 1e-9)
        now = measured.predict(self._from, self._key.bias_seen(*(self._readings / seconds)))
        R, velocity = now.attitude().matrix(), np.asarray(now.velocity())
        moved = measured.deltaPij(), measured.deltaVij(), measured.deltaTij()
        F, G = transition(self._key.rotation, R, *moved, len(self._covariance))
        P = F @ self._covariance @ F.T
        P[NAV, NAV] += G @ measured.preintMeasCov() @ G.T
        return dataclasses.replace(
            state,
            t_ns=self._until_ns,
            position_m=np.asarray(now.position()),
            quaternion=quaternion_of(now.pose()),
            velocity_mps=velocity,
            angular_velocity_radps=self._key.rate(gyro_radps),
            **covariance_fields(P, R, velocity, gyro_sigma_radps),
        )


def _copied(state: State) -> State:
    """With arrays of its own: they belong to the caller."""
    arrays: dict[str, Any] = {
        name: value.copy() for name, value in vars(state).items() if isinstance(value, np.ndarray)
    }
    return dataclasses.replace(state, **arrays)


def transition(
    R_i: Array, R_j: Array, dp_m: Array, dv_mps: Array, dt_s: float, dim: int = DIM
) -> tuple[Array, Array]:
    """Derivatives of a keyframe's tangent at j by that at i (dim, dim) and by dR, dp, dv, biases (15, 15).

    `R_i`, `R_j` (3, 3) are body to world; `dp_m`, `dv_mps` (3,) preintegrated, in body axes of i.
    States beyond the biases stay as they are.
    """
    F, G = np.eye(dim), np.eye(15)
    back = R_j.T @ R_i
    F[0:3, 0:3] = F[3:6, 3:6] = G[3:6, 3:6] = back
    F[0:3, 12:15] = -dt_s * np.eye(3)
    F[3:6, 0:3] = -back @ skew(dp_m)
    F[3:6, 6:9] = dt_s * R_j.T
    F[3:6, 9:12] = -0.5 * dt_s**2 * back
    F[6:9, 0:3] = -R_i @ skew(dv_mps)
    F[6:9, 9:12] = -dt_s * R_i
    G[6:9, 6:9] = R_i
    return F, G
