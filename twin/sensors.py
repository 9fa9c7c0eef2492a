"""What the robot's sensors report of its motion.

Every sensor draws from a stream of its own, named and seeded, so that a change
of one leaves the others' noise as it was. With `noiseless` the numbers are
exact at the integrator's accuracy: no noise, bias, quantisation or vibration.

Rates and increments are means over the interval that ends at the time stamp:
a gyro sample times the interval is the exact rotation, an accelerometer sample
times the interval the exact change of velocity less gravity, in the axes the
body had at the start of the interval (what strapdown preintegration expects).
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.frames import GRAVITY_MPS2
from terrafusion.datasets.recording import Fix, Gnss, Imu, Motor, Wheels
from terrafusion.datasets.sensors import GnssSpec
from terrafusion.twin.layout import WHEELS, state_slice
from terrafusion.twin.motion import Motion
from terrafusion.twin.motors import motor_current, motor_voltage
from terrafusion.twin.scenario import Interval
from terrafusion.twin.soil import SoilParams
from terrafusion.twin.vehicle import VehicleParams

Array = NDArray[np.float64]
TimesNs = NDArray[np.int64]

ACCEL_SHAPE = (0.9, 1.0, 1.0)
"""Vibration of the specific force along body x, y, z relative to vertical (assumed)."""
GYRO_SHAPE = (1.0, 0.8, 0.35)
"""Vibration of the angular rate about body x, y, z relative to roll (assumed)."""
RTK_SIGMA_M, DGPS_SIGMA_M = 0.05, 0.5
"""A receiver whose best sigma is at most this reports fixed, or differential, fixes."""


@dataclass(frozen=True)
class Noise:
    """Named random streams of one seed, or none of them when noiseless."""

    seed: int
    noiseless: bool = False

    def stream(self, name: str) -> np.random.Generator:
        """The generator of the stream `name`; the same seed and name give the same numbers."""
        entropy = np.random.SeedSequence([self.seed, zlib.crc32(name.encode())])
        return np.random.Generator(np.random.PCG64(entropy))


def rows_at_rate(count: int, sample_hz: float, rate_hz: float) -> NDArray[np.int64]:
    """Rows of a series at `sample_hz` nearest to the ticks of a sensor at `rate_hz`, the first at row 0."""
    ratio = max(sample_hz / rate_hz, 1.0)
    ticks = np.round(ratio * np.arange(int((count - 1) / ratio + 1e-9) + 1)).astype(np.int64)
    return ticks[ticks < count]


def imu_channel(
    t_ns: TimesNs,
    motion: Motion,
    vehicle: VehicleParams,
    shares: dict[str, tuple[SoilParams, Array]],
    rim_speed_mps: Array,
    noise: Noise,
) -> Imu:
    """IMU at every sample but the first (N - 1 rows): increments over intervals, stamped at their ends."""
    spec = vehicle.sensors.imu
    dt = np.diff(motion.t_s)
    gain = np.array([0.0, 0.0, -GRAVITY_MPS2])
    change = np.diff(motion.point_velocity_mps(spec.position_m), axis=0) / dt[:, None] - gain
    accel = np.einsum("nji,nj->ni", motion.rotation[:-1], change)
    gyro = np.zeros_like(accel)
    gyro[:, 2] = np.diff(motion.yaw_rad) / dt
    if not noise.noiseless:
        rate = 1.0 / float(np.mean(dt))
        gyro += _inertial_noise(
            noise.stream("gyro"), len(dt), rate, spec.gyro_noise_radps_sqrthz,
            spec.gyro_bias_walk_radps2_sqrthz, spec.gyro_bias_sigma_radps,
        )  # fmt: skip
        accel += _inertial_noise(
            noise.stream("accel"), len(dt), rate, spec.accel_noise_mps2_sqrthz,
            spec.accel_bias_walk_mps3_sqrthz, spec.accel_bias_sigma_mps2,
        )  # fmt: skip
        for soil, share in shares.values():
            level = vehicle.realism.vibration_gain * (share * np.abs(rim_speed_mps))[1:, None]
            shake = _vibration(noise.stream(f"vibration {soil.name}"), len(dt), rate, soil)
            accel += level * soil.vibration.accel_mps2_at_1mps * shake[:, :3] * ACCEL_SHAPE
            gyro += level * soil.vibration.gyro_radps_at_1mps * shake[:, 3:] * GYRO_SHAPE
    return Imu(t_ns[1:], gyro, accel)


def _inertial_noise(
    rng: np.random.Generator, count: int, rate_hz: float, density: float, walk: float, bias_sigma: float
) -> Array:
    """White noise, turn-on bias and bias random walk (count, 3) of a triad sampled at `rate_hz`."""
    white = rng.normal(0.0, density * math.sqrt(rate_hz), (count, 3))
    steps = rng.normal(0.0, walk / math.sqrt(rate_hz), (count, 3))
    return np.asarray(white + rng.normal(0.0, bias_sigma, 3) + np.cumsum(steps, axis=0))


def _vibration(rng: np.random.Generator, count: int, rate_hz: float, soil: SoilParams) -> Array:
    """Six series (count, 6) of unit variance in the soil's band (Butterworth), held below Nyquist."""
    from scipy.signal import butter, sosfilt

    top = 0.45 * rate_hz
    low, high = min(soil.vibration.low_hz, 0.5 * top), min(soil.vibration.high_hz, top)
    band = butter(2, [low, high], btype="bandpass", fs=rate_hz, output="sos")
    settle = int(3.0 * rate_hz / low) + 1
    series = sosfilt(band, rng.normal(size=(count + settle, 6)), axis=0)[settle:]
    impulse = sosfilt(band, np.eye(1, max(settle, 4096))[0])
    return np.asarray(series / math.sqrt(float(np.sum(impulse**2))))


def wheels_channel(
    t_ns: TimesNs, motion: Motion, states: Array, vehicle: VehicleParams, noise: Noise
) -> Wheels:
    """Four encoders: quantised angle, and speed as its difference over the interval before the stamp."""
    spec = vehicle.sensors.wheels
    rows = rows_at_rate(len(t_ns), _rate_hz(motion), spec.rate_hz)
    angle = states[rows, state_slice("wheel_angle")]
    if spec.quantum_rad > 0.0 and not noise.noiseless:
        offset = noise.stream("encoder phase").uniform(0.0, spec.quantum_rad, 4)
        angle = np.floor((angle + offset) / spec.quantum_rad) * spec.quantum_rad
    speed = np.zeros_like(angle)
    speed[1:] = np.diff(angle, axis=0) / np.diff(motion.t_s[rows])[:, None]
    return Wheels(t_ns[rows], speed, WHEELS, "radps", angle)


def motor_channel(
    t_ns: TimesNs,
    motion: Motion,
    states: Array,
    parameters: dict[str, float],
    vehicle: VehicleParams,
    noise: Noise,
) -> Motor:
    """Current of each side (sum of its two motors, A) and their mean voltage (V), at the wheels' rate."""
    rows = rows_at_rate(len(t_ns), _rate_hz(motion), vehicle.sensors.wheels.rate_hz)
    torque, speed = states[rows, state_slice("torque")], states[rows, state_slice("wheel_speed")]
    current = motor_current(parameters, torque, speed)
    voltage = motor_voltage(parameters, current, speed)
    sides = np.stack([current[:, 0] + current[:, 2], current[:, 1] + current[:, 3]], axis=1)
    volts = 0.5 * np.stack([voltage[:, 0] + voltage[:, 2], voltage[:, 1] + voltage[:, 3]], axis=1)
    if not noise.noiseless:
        sides = sides + noise.stream("current").normal(0.0, vehicle.realism.current_noise_a, sides.shape)
    return Motor(t_ns[rows], sides, volts)


def best_fix(spec: GnssSpec) -> Fix:
    """The fix class a receiver of this accuracy reports."""
    if spec.sigma_horizontal_m <= RTK_SIGMA_M:
        return Fix.FIXED
    return Fix.DGPS if spec.sigma_horizontal_m <= DGPS_SIGMA_M else Fix.SINGLE


def gnss_channel(
    t_ns: TimesNs,
    motion: Motion,
    vehicle: VehicleParams,
    fix: Fix | None,
    outages: tuple[Interval, ...],
    noise: Noise,
) -> Gnss:
    """Antenna position and velocity with the sigma the receiver reports; nothing is reported in an outage.

    The position error is white in part and Gauss-Markov in the rest (see
    `vehicle.SensorRealism`). A latency makes the stamp late against the motion.
    """
    spec, real = vehicle.sensors.gnss, vehicle.realism
    rows = rows_at_rate(len(t_ns), _rate_hz(motion), spec.rate_hz)
    best = best_fix(spec)
    fix = best if fix is None else fix
    sigma = np.array([spec.sigma_horizontal_m, spec.sigma_horizontal_m, spec.sigma_vertical_m])
    correlation_s = spec.correlation_time_s
    if fix < best:
        worst = real.gnss_single_sigma_m / spec.sigma_horizontal_m
        sigma = sigma * (worst if fix == Fix.SINGLE else math.sqrt(worst))
        correlation_s = real.gnss_single_correlation_s
    antenna = spec.antenna_m
    position, velocity = motion.point_position_m(antenna)[rows], motion.point_velocity_mps(antenna)[rows]
    if not noise.noiseless:
        interval = float(np.mean(np.diff(motion.t_s[rows]))) if len(rows) > 1 else 1.0
        share = real.gnss_white_share if correlation_s > 0.0 else 1.0
        white = noise.stream("gnss white").normal(size=position.shape)
        slow = _gauss_markov(noise.stream("gnss correlated"), len(rows), interval, correlation_s)
        position = position + sigma * (math.sqrt(share) * white + math.sqrt(1.0 - share) * slow)
        velocity = velocity + noise.stream("gnss velocity").normal(
            0.0, spec.sigma_velocity_mps, velocity.shape
        )
    seen = np.ones(len(rows), dtype=bool)
    for outage in outages:
        seen &= ~outage.covers(motion.t_s[rows])
    stamps = t_ns[rows] + (0 if noise.noiseless else round(real.gnss_latency_s * 1e9))
    n = len(rows)
    channel = Gnss(
        stamps, position, np.tile(sigma, (n, 1)), np.full(n, int(fix), dtype=np.uint8), velocity,
        np.full(n, spec.sigma_velocity_mps),
    )  # fmt: skip
    return channel.select(seen)


def _gauss_markov(rng: np.random.Generator, count: int, interval_s: float, correlation_s: float) -> Array:
    """First-order Gauss-Markov series (count, 3) of unit variance, stationary from the start."""
    from scipy.signal import lfilter

    keep = math.exp(-interval_s / correlation_s) if correlation_s > 0.0 else 0.0
    drive = rng.normal(size=(count, 3))
    drive[1:] *= math.sqrt(1.0 - keep * keep)
    return np.asarray(lfilter([1.0], [1.0, -keep], drive, axis=0))


def _rate_hz(motion: Motion) -> float:
    return (len(motion.t_s) - 1) / float(motion.t_s[-1] - motion.t_s[0])
