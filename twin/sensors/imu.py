"""Inertial measurement unit."""

import math

import numpy as np

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.channels import Imu
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.twin.model.motion import BodyMotion
from terrafusion.twin.model.soil import SoilParams
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.sensors.noise import NoiseStreams, band_noise, flicker, stepped, white_and_walk

ACCEL_SHAPE = (0.9, 1.0, 1.0)
"""Vibration of the specific force along body x, y, z relative to vertical (assumed)."""
GYRO_SHAPE = (1.0, 0.8, 0.35)
"""Vibration of the angular rate about body x, y, z relative to roll (assumed)."""


def imu_channel(
    t_ns: TimesNs,
    motion: BodyMotion,
    vehicle: VehicleParams,
    shares: dict[str, tuple[SoilParams, Array]],
    rim_speed_mps: Array,
    noise: NoiseStreams,
) -> Imu:
    """IMU at every sample but the first (N - 1 rows): increments over intervals, stamped at their ends.

    A sample is clip(M (truth + vibration) + bias + white noise), rounded; M holds scale factors and
    misalignments, bias is turn-on bias, random walk and bias instability.
    """
    gyro, accel = _truth(motion, vehicle.sensors.imu.position_m)
    if noise.noiseless:
        return Imu(t_ns[1:], gyro, accel)
    rate_hz = len(gyro) / float(motion.t_s[-1] - motion.t_s[0])
    for soil, share in shares.values():
        level = vehicle.realism.vibration_gain * (share * np.abs(rim_speed_mps))[1:, None]
        band = soil.vibration.low_hz, soil.vibration.high_hz
        shake = band_noise(noise.stream(f"vibration {soil.name}"), len(gyro), rate_hz, *band)
        accel += level * soil.vibration.accel_mps2_at_1mps * shake[:, :3] * ACCEL_SHAPE
        gyro += level * soil.vibration.gyro_radps_at_1mps * shake[:, 3:] * GYRO_SHAPE
    return Imu(t_ns[1:], *_measured(gyro, accel, rate_hz, vehicle, noise))


def _truth(motion: BodyMotion, position_m: tuple[float, ...]) -> tuple[Array, Array]:
    """Mean angular rate and specific force (N - 1, 3) of the IMU's point over the intervals."""
    dt = np.diff(motion.t_s)
    gravity = np.array([0.0, 0.0, -GRAVITY_MPS2])
    change = np.diff(motion.point_velocity_mps(position_m), axis=0) / dt[:, None] - gravity
    accel = np.einsum("nji,nj->ni", motion.rotation[:-1], change)
    gyro = np.zeros_like(accel)
    gyro[:, 2] = np.diff(motion.yaw_rad) / dt
    return gyro, accel


def _measured(
    gyro: Array, accel: Array, rate_hz: float, vehicle: VehicleParams, noise: NoiseStreams
) -> tuple[Array, Array]:
    """Readings of the triads for the angular rate and specific force (N, 3)."""
    spec, real = vehicle.sensors.imu, vehicle.realism.imu
    gyro = gyro @ triad(noise.stream("gyro triad"), real.gyro_scale_sigma, real.misalignment_sigma_rad).T
    accel = accel @ triad(noise.stream("accel triad"), real.accel_scale_sigma, real.misalignment_sigma_rad).T
    gyro += white_and_walk(
        noise.stream("gyro"), len(gyro), rate_hz, spec.gyro_noise_radps_sqrthz,
        spec.gyro_bias_walk_radps2_sqrthz, spec.gyro_bias_sigma_radps,
    )  # fmt: skip
    accel += white_and_walk(
        noise.stream("accel"), len(accel), rate_hz, spec.accel_noise_mps2_sqrthz,
        spec.accel_bias_walk_mps3_sqrthz, spec.accel_bias_sigma_mps2,
    )  # fmt: skip
    if real.gyro_bias_instability_radps > 0.0:
        gyro += flicker(noise.stream("gyro flicker"), len(gyro), rate_hz, real.gyro_bias_instability_radps)
    if real.accel_bias_instability_mps2 > 0.0:
        accel += flicker(noise.stream("accel flicker"), len(accel), rate_hz, real.accel_bias_instability_mps2)
    return (
        _digitised(gyro, real.gyro_range_radps, real.gyro_quantum_radps),
        _digitised(accel, real.accel_range_mps2, real.accel_quantum_mps2),
    )


def triad(rng: np.random.Generator, scale_sigma: float, misalignment_sigma_rad: float) -> Array:
    """Matrix (3, 3) of a unit's triad: scale factors on the diagonal, misaligned axes beside it."""
    errors = rng.normal(size=(3, 3))
    beside = ~np.eye(3, dtype=bool)
    return np.eye(3) + errors * np.where(beside, misalignment_sigma_rad, scale_sigma)


def _digitised(values: Array, limit: float, quantum: float) -> Array:
    return stepped(np.clip(values, -limit, limit) if math.isfinite(limit) else values, quantum)


def at_rest(vehicle: VehicleParams, count: int, seed: int) -> tuple[Array, Array]:
    """Gyro and accelerometer (count, 3) of an IMU that stands level, without vibration."""
    rest = np.tile([0.0, 0.0, GRAVITY_MPS2], (count, 1))
    return _measured(np.zeros((count, 3)), rest, vehicle.sensors.imu.rate_hz, vehicle, NoiseStreams(seed))
