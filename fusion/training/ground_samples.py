"""Samples of slip and sensor errors on one ground, to which the policy's sensor noise is fitted.

Against the truth of a simulated run, only while the wheels turn:

- slip: 1 - v / (omega R) of 0.5 s means above 0.15 m/s. Of every immobilised spell only the first second
  counts: a policy must cover its onset, while its length is arbitrary. `policy_fit` fits a line over the
  grade (sine of the pitch) and the correlation time of an Ornstein-Uhlenbeck process, tau = -2 s / ln(rho),
  rho the autocorrelation at a lag of 2 s. The error of the rolling radius, about 1 %, is added to both: the
  twin has none.
- wheel sigma: speed over 0.1 s not explained by the slip averaged over 1 s, in quadrature with the vehicle
  file's `speed_sigma_mps` (mounting, backlash, uneven ground: the twin's encoders are only quantised).
- yaw scale: true over wheel yaw rate less one, 0.5 s means, while the wheels turn the robot faster than 0.1
  rad/s.
- side-slip: lateral over forward speed of the body origin above 0.2 m/s, less the part proportional to the
  yaw rate (the centre of rotation is a state of the estimator).
- IMU: mean error over tau less its 60 s running mean (the bias), as a multiple of the data sheet's density /
  sqrt(tau). Vibration is band-limited, so the multiple falls with tau; tau is the time over which the
  estimator integrates the sensor: 2 s for the specific force, 5 s for the rate.
- GNSS: horizontal error over the reported sigma.

Recorded runs give slip, yaw scale and side-slip only, see `policy_logs`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.frames import GRAVITY_MPS2, quaternion_to_matrix
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import ImuSpec
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.fusion.training.simulated_runs import WheelSamples, seconds, wheel_samples
from terrafusion.twin.model.vehicle import load_vehicle

SHORT_S, SLIP_S, LAG_S = 0.1, 0.5, 2.0
GYRO_S, ACCEL_S = 5.0, 2.0
TURNING_MPS, SIDE_SLIP_FROM_MPS, STUCK_MPS = 0.15, 0.2, 0.05
STUCK_COUNTS_S = 1.0
YAWING_RADPS = 0.1
BIAS_S = 60.0


@dataclass(frozen=True, eq=False)
class GroundSamples:
    """Samples (n,) of each quantity on one ground, of one run or several.

    `slip_pairs` and `grade_pairs` (n, 2) are slips and grades `LAG_S` apart; `gyro` (roll and pitch),
    `gyro_yaw` and `accel` are errors over those of the data sheet, `gnss` over the reported sigma.
    """

    slip: Array
    grade: Array
    slip_pairs: Array
    grade_pairs: Array
    wheel_mps: Array
    yaw_scale: Array
    side_slip: Array
    gyro: Array
    gyro_yaw: Array
    accel: Array
    gnss: Array

    @staticmethod
    def joined(parts: Iterable[GroundSamples]) -> GroundSamples:
        """The samples of several runs together."""
        listed = list(parts)
        names = [f.name for f in dataclasses.fields(GroundSamples)]
        return GroundSamples(**{n: np.concatenate([getattr(p, n) for p in listed]) for n in names})


def samples_of(recording: Recording) -> GroundSamples:
    """The samples of a simulated run on one ground."""
    truth, wheels = recording.truth, wheel_samples(recording)
    assert truth is not None
    assert truth.twist_body is not None
    assert truth.quaternion is not None
    vehicle = load_vehicle(recording.vehicle or "elevate")
    R = quaternion_to_matrix(truth.quaternion)
    grade = np.interp(wheels.t_s, seconds(truth.t_ns, recording), R[:, 2, 0])  # uphill positive
    side_slip = side_slips_of(*truth.twist_body[:, [0, 1, 5]].T)
    slip = _slip_samples(wheels, grade, vehicle.sensors.wheels.speed_sigma_mps)
    imu = _imu_samples(recording, wheels, R, truth.twist_body, vehicle.sensors.imu)
    gnss = _gnss_samples(recording.gnss, truth, vehicle.sensors.gnss.antenna_m)
    yaw_scale = _yaw_scales(wheels, vehicle.rig().track_m)
    return GroundSamples(**slip, yaw_scale=yaw_scale, side_slip=side_slip, **imu, gnss=gnss)


def _slip_samples(samples: WheelSamples, grade: Array, encoder_mps: float) -> dict[str, Array]:
    """`slips_of` and `wheel_mps`, the speed errors (k,) not explained by slip."""
    wheel, forward = samples.sides_mps.mean(axis=1), samples.forward_mps
    step = float(np.median(np.diff(samples.t_s)))
    short = max(round(SHORT_S / step), 1)
    wheel, forward, grade = (_block_means(x, short) for x in (wheel, forward, grade))
    width = round(1.0 / SHORT_S)
    kernel = np.full(width, 1.0 / width)
    smooth_wheel, smooth = np.convolve(wheel, kernel, "same"), np.convolve(forward, kernel, "same")
    turning = np.abs(smooth_wheel) > TURNING_MPS
    share = np.divide(smooth, smooth_wheel, out=np.ones_like(smooth), where=turning)
    residual = (forward - share * wheel)[turning]
    blocks = round(SLIP_S / SHORT_S)
    slips = slips_of(*(_block_means(x, blocks) for x in (wheel, forward, grade)))
    return slips | {"wheel_mps": np.hypot(residual, encoder_mps)}


def slips_of(wheel_mps: Array, forward_mps: Array, grade: Array) -> dict[str, Array]:
    """`slip` and `grade` (n,), and their pairs (m, 2), as in `GroundSamples`, of speeds (k,) every `SLIP_S`.

    Unknown speeds are NaN.
    """
    wheel, forward = wheel_mps, forward_mps
    counted = (np.abs(wheel) > TURNING_MPS) & np.isfinite(forward)
    counted &= _spell_age_s(counted & (np.abs(forward) < STUCK_MPS)) <= STUCK_COUNTS_S
    slip = np.full(len(wheel), np.nan)
    slip[counted] = np.clip(1.0 - forward[counted] / wheel[counted], -1.0, 1.0)
    lag = round(LAG_S / SLIP_S)
    pairs = np.stack([slip[:-lag], slip[lag:]], axis=1)
    grade_pairs = np.stack([grade[:-lag], grade[lag:]], axis=1)
    both = np.isfinite(pairs).all(axis=1)
    return {
        "slip": slip[counted],
        "grade": grade[counted],
        "slip_pairs": pairs[both],
        "grade_pairs": grade_pairs[both],
    }


def _spell_age_s(stuck: NDArray[np.bool_]) -> Array:
    """Time (n,), s, since the robot got stuck, at each half second; 0 if it is not stuck."""
    age, out = 0.0, np.zeros(len(stuck))
    for i, now in enumerate(stuck.tolist()):
        age = age + SLIP_S if now else 0.0
        out[i] = age
    return out


def _yaw_scales(samples: WheelSamples, track_m: float) -> Array:
    count = max(round(SLIP_S / float(np.median(np.diff(samples.t_s)))), 1)
    left, right = _block_means(samples.sides_mps, count).T
    return yaw_scales_of((right - left) / track_m, _block_means(samples.yaw_rate_radps, count))


def yaw_scales_of(wheel_radps: Array, true_radps: Array) -> Array:
    """True over wheel yaw rate (n,), less one, while the wheels turn the robot."""
    turning = (np.abs(wheel_radps) > YAWING_RADPS) & np.isfinite(true_radps)
    return np.asarray(np.clip(true_radps[turning] / wheel_radps[turning] - 1.0, -1.0, 1.0))


def side_slips_of(forward_mps: Array, lateral_mps: Array, rate_radps: Array) -> Array:
    """Lateral over forward speed (n,), less the effect of a centre of rotation off the body origin."""
    moving = np.abs(forward_mps) > SIDE_SLIP_FROM_MPS  # never so where it is NaN
    known = np.isfinite(forward_mps)
    lateral, rate = lateral_mps[known], rate_radps[known]
    icr = -float(lateral @ rate) / max(float(rate @ rate), 1e-9)
    return np.asarray((lateral_mps + icr * rate_radps)[moving] / forward_mps[moving])


def _imu_samples(
    recording: Recording, samples: WheelSamples, R: Array, twist: Array, spec: ImuSpec
) -> dict[str, Array]:
    """Errors of means over the data sheet's: `gyro` (2 n,), `gyro_yaw` (n,), `accel` (m,).

    A sample is compared with the rotation and change of velocity over the interval that it ends, by true
    rotations (k, 3, 3) and body twists (k, 6).
    """
    imu, truth = recording.imu, recording.truth
    assert imu is not None
    assert truth is not None
    imu_t, truth_t = seconds(imu.t_ns, recording), seconds(truth.t_ns, recording)
    step = float(np.median(np.diff(imu_t)))
    rows = np.searchsorted(truth_t, np.append(imu_t[0] - step, imu_t) - 0.5 * step)
    rows = np.minimum(rows, len(truth_t) - 1)
    R, twist = R[rows], twist[rows]
    velocity = np.einsum("nij,nj->ni", R, twist[:, :3] + np.cross(twist[:, 3:], spec.position_m))  # the IMU's
    change = np.diff(velocity, axis=0) / step + np.array([0.0, 0.0, GRAVITY_MPS2])
    gyro = imu.gyro_radps - _rotation_vectors(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / step
    accel = imu.accel_mps2 - np.einsum("nji,nj->ni", R[:-1], change)
    speed = np.interp(imu_t, samples.t_s, np.abs(samples.sides_mps).mean(axis=1))
    return {
        "gyro": _relative(gyro[:, :2], speed, step, GYRO_S, spec.gyro_noise_radps_sqrthz),
        "gyro_yaw": _relative(gyro[:, 2:], speed, step, GYRO_S, spec.gyro_noise_radps_sqrthz),
        "accel": _relative(accel, speed, step, ACCEL_S, spec.accel_noise_mps2_sqrthz),
    }


def _relative(error: Array, speed_mps: Array, step_s: float, tau_s: float, density: float) -> Array:
    """Means over `tau_s` of errors (n, axes) less bias, over density / sqrt(tau): (m,), while wheels turn."""
    count = max(round(tau_s / step_s), 1)
    means = _unbiased(_block_means(error, count), count * step_s)
    rolling = _block_means(speed_mps, count) > TURNING_MPS
    return np.asarray((means[rolling] * np.sqrt(count * step_s) / density).ravel())


def _rotation_vectors(R: Array) -> Array:
    """Rotation vectors (n, 3), rad, of rotations (n, 3, 3) by less than a quarter turn."""
    twice = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine = np.maximum(0.5 * np.linalg.norm(twice, axis=1, keepdims=True), 1e-12)
    return np.asarray(0.5 * twice * np.arcsin(np.minimum(sine, 1.0)) / sine)


def _unbiased(error: Array, tau_s: float) -> Array:
    """Errors (n, axes) less their running mean over `BIAS_S`."""
    width = min(max(round(BIAS_S / tau_s), 1), len(error))
    count = np.convolve(np.ones(len(error)), np.ones(width), "same")
    slow = np.stack([np.convolve(e, np.ones(width), "same") / count for e in error.T], axis=1)
    return np.asarray(error - slow)


def _gnss_samples(gnss: Gnss | None, truth: Trajectory, antenna_m: tuple[float, ...]) -> Array:
    """Horizontal errors of the fixes over their reported sigma, east and north together (n,)."""
    if gnss is None:
        return np.empty(0)
    error = (gnss.enu_m - truth.points_at(gnss.t_ns, antenna_m))[:, :2] / gnss.sigma_enu_m[:, :2]
    return np.asarray(error[(gnss.fix > Fix.NONE) & np.isfinite(error).all(axis=1)].ravel())


def _block_means(x: Array, count: int) -> Array:
    """Means of blocks of `count` rows; an incomplete last block is left out."""
    blocks = len(x) // count
    return np.asarray(x[: blocks * count].reshape(blocks, count, *x.shape[1:]).mean(axis=1))
