"""A bare fixed-lag smoother of GTSAM: preintegrated IMU, fixes with lever arm, wheel odometry."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import NDArray

from tests.studies.opponents.inertial import (
    ABSENT_ACCEL,
    GRAVITY_MPS2,
    HEADING_SIGMA_RAD,
    LEVEL_SIGMA_RAD,
    Inertial,
)
from tests.studies.opponents.protocol import Blocked

Array = NDArray[np.float64]

STEP_S = 0.2
"""Between keyframes; of faster fixes one a step is used."""
NEAREST_S = 0.05
YAW_OF_WHEELS_RAD, TILT_RAD = 10.0, 0.1
"""Between factor: yaw is left to the gyro; roll and pitch change slowly."""
HUBER_SIGMA = 1.345
GYRO_BIAS_RADPS, ACCEL_BIAS_MPS2 = 0.01, 0.3


@dataclass(frozen=True)
class Noise:
    """Fixed noise.

    Attributes:
        along: of the wheels' way, share of it (0.01 m/s are added).
        across: sideways and up, share of the way.
        gyro: density, rad/s/sqrt(Hz).
        accel: density, m/s2/sqrt(Hz).
        fix_factor: on the reported sigma of fixes.
        lag_s: of the smoother.
    """

    along: float = 0.05
    across: float = 0.05
    gyro: float = 3e-3
    accel: float = 0.1
    fix_factor: float = 1.0
    lag_s: float = 10.0


def run(inputs: Inertial, blocked: Blocked, noise: Noise) -> tuple[Array, Array]:
    """Times (K,) of the keyframes and the newest position (K, 2) at each."""
    times, fix_of = _keyframes(inputs)
    smoother, state = _started(inputs, times[0], noise)
    params = _imu_params(inputs, noise)
    out = np.empty((len(times), 2))
    out[0] = inputs.start[:2]
    for k in range(1, len(times)):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        state = _between(inputs, graph, params, state, k, times, noise)
        fix = fix_of.get(k)
        if fix is not None and not blocked(float(fix[0])):
            sigma = noise.fix_factor * fix[4]
            graph.push_back(
                gtsam.GPSFactorArm(X(k), fix[1:4], inputs.antenna_m, _huber([sigma, sigma, 2 * sigma]))
            )
        pose, velocity, bias = state
        values.insert(X(k), pose)
        values.insert(V(k), velocity)
        values.insert(B(k), bias)
        smoother.update(graph, values, dict.fromkeys((X(k), V(k), B(k)), float(times[k])))
        state = (
            smoother.calculateEstimatePose3(X(k)),
            smoother.calculateEstimateVector(V(k)),
            smoother.calculateEstimateConstantBias(B(k)),
        )
        out[k] = state[0].transformFrom(inputs.point_m)[:2]
    return times, out


def _keyframes(inputs: Inertial) -> tuple[Array, dict[int, Array]]:
    """Times of keyframes, from the first fix on, and the fix at each that has one."""
    first, last = inputs.fixes[0, 0], min(inputs.streams.t_s[-1], inputs.imu_s[-1])
    fixes = inputs.fixes[(inputs.fixes[:, 0] > first) & (inputs.fixes[:, 0] <= last)]
    slot = ((fixes[:, 0] - first) / STEP_S + 1e-6).astype(np.int64)
    fixes = fixes[np.unique(slot, return_index=True)[1]]
    grid = np.arange(first + STEP_S, last, STEP_S)
    grid = grid[np.abs(fixes[np.searchsorted(fixes[:-1, 0], grid), 0] - grid) > NEAREST_S]
    grid = grid[np.abs(fixes[np.maximum(np.searchsorted(fixes[:, 0], grid) - 1, 0), 0] - grid) > NEAREST_S]
    times = np.unique(np.r_[first, grid, fixes[:, 0]])
    return times, {int(np.searchsorted(times, fix[0])): fix for fix in fixes}


def _started(inputs: Inertial, t: float, noise: Noise) -> tuple[Any, tuple[Any, Array, Any]]:
    """The smoother with its first keyframe."""
    x, y, heading = inputs.start
    attitude = gtsam.Rot3.Ypr(heading, inputs.level[1], inputs.level[0])
    pose = gtsam.Pose3(attitude, np.array([x, y, inputs.fixes[0, 3]]))
    velocity = attitude.rotate(np.array([inputs.speed_at(t), 0.0, 0.0]))
    bias = gtsam.imuBias.ConstantBias()
    sigma = noise.fix_factor * inputs.fixes[0, 4] + 0.3
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    level = [LEVEL_SIGMA_RAD, LEVEL_SIGMA_RAD, HEADING_SIGMA_RAD]
    graph.push_back(gtsam.PriorFactorPose3(X(0), pose, _diagonal([*level, sigma, sigma, 2.0 * sigma])))
    graph.push_back(gtsam.PriorFactorVector(V(0), velocity, _diagonal([0.5, 0.5, 0.5])))
    sigmas = [ACCEL_BIAS_MPS2] * 3 + [GYRO_BIAS_RADPS] * 3
    graph.push_back(gtsam.PriorFactorConstantBias(B(0), bias, _diagonal(sigmas)))
    values.insert(X(0), pose)
    values.insert(V(0), velocity)
    values.insert(B(0), bias)
    isam = gtsam.ISAM2Params()
    isam.setFactorization("QR")  # Cholesky fails where an IMU is precise over a short interval
    smoother = gtsam.IncrementalFixedLagSmoother(noise.lag_s, isam)
    smoother.update(graph, values, dict.fromkeys((X(0), V(0), B(0)), float(t)))
    return smoother, (pose, velocity, bias)


def _between(
    inputs: Inertial,
    graph: Any,
    params: Any,
    state: tuple[Any, Array, Any],
    k: int,
    times: Array,
    noise: Noise,
) -> tuple[Any, Array, Any]:
    """IMU and odometry from one keyframe to the next; returns the predicted state."""
    begin, end = float(times[k - 1]), float(times[k])
    pose, velocity, bias = state
    integrated = gtsam.PreintegratedCombinedMeasurements(params, bias)
    first, last = np.searchsorted(inputs.imu_s, [begin, end])
    edges = np.r_[begin, inputs.imu_s[first:last], end]
    for i, (a, b) in enumerate(itertools.pairwise(edges.tolist()), first):
        if b - a > 1e-6:
            sample = min(i, len(inputs.imu_s) - 1)
            integrated.integrateMeasurement(inputs.accel_mps2[sample], inputs.gyro_radps[sample], b - a)
    graph.push_back(gtsam.CombinedImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), B(k), integrated))
    v, dt = inputs.speed_at(0.5 * (begin + end)), end - begin
    turned = integrated.deltaRij()
    half = 0.5 * turned.yaw()
    way = v * dt * np.array([np.cos(half), np.sin(half), 0.0])
    along, across = (s * abs(v) * dt + 0.01 * dt for s in (noise.along, noise.across))
    model = _diagonal([TILT_RAD, TILT_RAD, YAW_OF_WHEELS_RAD, along, across, across])
    graph.push_back(gtsam.BetweenFactorPose3(X(k - 1), X(k), gtsam.Pose3(turned, way), model))
    predicted = integrated.predict(gtsam.NavState(pose, velocity), bias)
    return gtsam.Pose3(predicted.attitude(), pose.transformFrom(way)), predicted.velocity(), bias


def _imu_params(inputs: Inertial, noise: Noise) -> Any:
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY_MPS2)
    accel = noise.accel if inputs.has_accel else ABSENT_ACCEL
    params.setGyroscopeCovariance(np.eye(3) * noise.gyro**2)
    params.setAccelerometerCovariance(np.eye(3) * accel**2)
    params.setIntegrationCovariance(np.eye(3) * 1e-6)
    params.setBiasOmegaCovariance(np.eye(3) * 1e-5**2)
    params.setBiasAccCovariance(np.eye(3) * 1e-3**2)
    return params


def _diagonal(sigmas: list[float]) -> Any:
    return gtsam.noiseModel.Diagonal.Sigmas(np.array(sigmas))


def _huber(sigmas: list[float]) -> Any:
    return gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(HUBER_SIGMA), _diagonal(sigmas)
    )
