"""Encoders, IMU, GNSS and current sensors of the plant.

Each takes the history of one run (arrays (N,) or (N, 4) by name) and draws from streams of its own. With
`noiseless` the readings are exact.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Fix, Gnss, Imu, Motor, Wheels
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.twin.gap.blind.plant.machine import motor_current
from terrafusion.twin.gap.blind.plant.spec import RunSpec

Array = NDArray[np.float64]
TimesNs = NDArray[np.int64]
History = dict[str, Array]

START_NS = 1_767_225_600 * 10**9
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
SHAKE = np.array([0.8, 1.0, 1.1])
"""Vibration of the specific force along body x, y, z beside the soil's vertical figure (assumed)."""
SHAKE_YAW = 0.3
RING_HZ, RING_DAMPING = 6.0, 0.05
FIELD_M, FIELD_WAVES = 3.0, 16


def stamps(t_s: Array) -> TimesNs:
    return START_NS + np.round(t_s * 1e9).astype(np.int64)


def every(spec_hz: float, frame_hz: float, count: int) -> NDArray[np.int64]:
    """Rows of the frames nearest to a sensor's ticks."""
    ticks = np.round(np.arange(0.0, count, max(frame_hz / spec_hz, 1.0))).astype(np.int64)
    return ticks[ticks < count]


def wheels(spec: RunSpec, h: History) -> Wheels:
    """Counts of four encoders over the interval before the stamp."""
    k = spec.changes.get
    sensor, real = spec.vehicle.sensors.wheels, spec.vehicle.realism.encoder
    rows = every(sensor.rate_hz, 1.0 / float(h["t"][1]), len(h["t"]))
    t, angle = h["t"][rows], h["angle"][rows]
    angle = angle + 0.5 * (k("play_rad", 0.0) + k("gap_rad", 0.0)) * h["play"][rows]
    steps, interval = np.diff(angle, axis=0), np.diff(t)[:, None]
    pace = (steps / interval) ** 2
    scale = k("enc_scale", 0.0) + k("enc_scale_speed", 0.0) * (0.7 + 0.6 * pace / (pace + 16.0))
    strain = np.abs(h["torque"][rows][1:])
    lost = k("enc_loss", 0.0) + k("enc_loss_strain", 0.0) * 2.0 * strain / (strain + 2.0)
    steps = steps * (1.0 + scale) * (1.0 - np.minimum(lost, 1.0))
    left, right = steps[:, [0, 2]], steps[:, [1, 3]]
    steps = steps.copy()
    steps[:, [0, 2]] = left + k("enc_crosstalk", 0.0) * right
    angle = np.concatenate([angle[:1], angle[:1] + np.cumsum(steps, axis=0)])
    if not spec.noiseless:
        rng = spec.stream("encoders")
        turn = real.shaft_turns * angle + rng.uniform(0.0, 2.0 * np.pi, 4)
        angle = angle + real.position_error_rad / real.shaft_turns * np.sin(turn)
        if sensor.quantum_rad > 0.0:
            angle = np.floor(angle / sensor.quantum_rad + rng.uniform(size=4)) * sensor.quantum_rad
    speed = np.zeros_like(angle)
    speed[1:] = np.diff(angle, axis=0) / interval
    return Wheels(stamps(t), speed, WHEELS, "radps", angle)


def imu(spec: RunSpec, h: History) -> Imu:
    """Mean rates and specific forces over each frame, at the frame rate."""
    k, t = spec.changes.get, h["t"]
    dt = np.diff(t)
    rate = np.diff(h["yaw"]) / dt
    force = _specific_force(spec, h, rate)
    force = _on_its_mount(spec, force, float(dt[0]))
    pace = np.abs(h["speed"][1:]).mean(axis=1) * spec.vehicle.wheel.radius_m
    turn = k("imu_turn", 0.0) + k("imu_turn_flex", 0.0) * (1.0 + 0.5 * np.tanh(force[:, 0]))
    cos, sin = np.cos(turn), np.sin(turn)
    force[:, 0], force[:, 1] = cos * force[:, 0] + sin * force[:, 1], cos * force[:, 1] - sin * force[:, 0]
    grown = 0.5 + t[1:] / t[-1]
    rough = np.exp(0.5 * h["soil"][1:])
    for axis, name in enumerate("xy"):
        force[:, axis] += k(f"acc_bias_{name}", 0.0) + k(f"acc_drift_{name}", 0.0) * grown
        force[:, axis] += k(f"rect_{name}", 0.0) * pace**2 + k(f"rect_slow_{name}", 0.0) * pace**1.3 * rough
    measured = rate * (1.0 + k("gyro_scale", 0.0) + k("gyro_cubic", 0.0) * (0.5 + rate**2 / 0.36))
    phase = spec.stream("wave").uniform(0.0, 2.0 * np.pi)
    wave = 1.0 + 0.5 * np.sin(2.0 * np.pi * t[1:] / 90.0 + phase)
    measured = measured + k("gyro_bias", 0.0) + k("gyro_bias_wave", 0.0) * wave
    amps = h["current"][1:]
    measured = measured + k("gyro_crosstalk", 0.0) * (amps[:, 0] + amps[:, 2] - amps[:, 1] - amps[:, 3])
    gyro = np.stack([np.zeros_like(rate), np.zeros_like(rate), measured], axis=1)
    if not spec.noiseless:
        _shaken(spec, gyro, force, pace * rough, 1.0 / float(dt[0]))
    late = k("imu_late_s", 0.0) + k("imu_late_grown_s", 0.0) * grown
    return Imu(stamps(t[1:] + late), gyro, force)


def _specific_force(spec: RunSpec, h: History, rate: Array) -> Array:
    """Mean specific force (N - 1, 3) at the IMU: change of its velocity less gravity, old body axes."""
    k = spec.changes.get
    at = spec.vehicle.sensors.imu.position_m
    sway = 1.0 + np.abs(np.concatenate([[0.0], rate]))
    x = at[0] + k("imu_x_m", 0.0) + k("imu_flex_x_m", 0.0) * sway - h["cg_forward"]
    y = at[1] + k("imu_y_m", 0.0) + k("imu_flex_y_m", 0.0) * sway - h["cg_left"]
    u, v = h["u"] - h["r"] * y, h["v"] + h["r"] * x
    cos, sin = np.cos(h["yaw"]), np.sin(h["yaw"])
    change = np.stack([np.diff(cos * u - sin * v), np.diff(sin * u + cos * v)]) / np.diff(h["t"])
    cos, sin = cos[:-1], sin[:-1]
    ahead, aside = cos * change[0] + sin * change[1], cos * change[1] - sin * change[0]
    return np.stack([ahead - h["pull_u"][1:], aside - h["pull_v"][1:], h["normal"][1:]], axis=1)


def _on_its_mount(spec: RunSpec, force: Array, dt: float) -> Array:
    """A resonance of the IMU's mount, which the horizontal force itself excites."""
    gain = spec.changes.get("ring", 0.0)
    if gain == 0.0:
        return force
    from scipy.signal import lfilter

    pole = np.exp(2.0 * np.pi * RING_HZ * dt * (-RING_DAMPING + 1j * math.sqrt(1.0 - RING_DAMPING**2)))
    bottom = np.array([1.0, -2.0 * pole.real, abs(pole) ** 2])
    out = force.copy()
    shaken = force[:, :2] + spec.stream("mount").normal(0.0, 0.3, (len(force), 2)) * (not spec.noiseless)
    out[:, :2] += gain * lfilter(
        [bottom.sum(), 0.0], bottom, np.diff(shaken, axis=0, prepend=shaken[:1]), axis=0
    )
    return out


def _shaken(spec: RunSpec, gyro: Array, force: Array, level: Array, rate_hz: float) -> None:
    """Adds vibration, turn-on bias and noise to the readings."""
    sensor, soil = spec.vehicle.sensors.imu, spec.soil.vibration
    rng = spec.stream("imu")
    shake = _resonant(rng.normal(size=(len(level), 4)), math.sqrt(soil.low_hz * soil.high_hz), rate_hz)
    shake = shake * (spec.vehicle.realism.vibration_gain * level)[:, None]
    force += soil.accel_mps2_at_1mps * shake[:, :3] * SHAKE
    gyro[:, 2] += soil.gyro_radps_at_1mps * shake[:, 3] * SHAKE_YAW
    root = math.sqrt(rate_hz)
    gyro += rng.normal(0.0, sensor.gyro_bias_sigma_radps, 3)
    gyro += rng.normal(0.0, sensor.gyro_noise_radps_sqrthz * root, gyro.shape)
    gyro += np.cumsum(rng.normal(0.0, sensor.gyro_bias_walk_radps2_sqrthz / root, gyro.shape), axis=0)
    force += rng.normal(0.0, sensor.accel_bias_sigma_mps2, 3)
    force += rng.normal(0.0, sensor.accel_noise_mps2_sqrthz * root, force.shape)
    force += np.cumsum(rng.normal(0.0, sensor.accel_bias_walk_mps3_sqrthz / root, force.shape), axis=0)


def _resonant(white: Array, hz: float, rate_hz: float) -> Array:
    """White noise (N, k) through a damped resonance, zero mean, unit variance."""
    from scipy.signal import lfilter

    pole = np.exp(2.0 * np.pi * min(hz, 0.3 * rate_hz) / rate_hz * (-0.4 + 1j * math.sqrt(1.0 - 0.16)))
    bottom = [1.0, -2.0 * pole.real, abs(pole) ** 2]
    gain = lfilter([1.0, -1.0], bottom, np.eye(1, 512)[0])
    return np.asarray(lfilter([1.0, -1.0], bottom, white, axis=0) / math.sqrt(float(gain @ gain)))


def gnss(spec: RunSpec, h: History) -> Gnss:
    """Antenna position and velocity at the receiver's rate."""
    k, sensor = spec.changes.get, spec.vehicle.sensors.gnss
    rng = spec.stream("gnss")
    rows = every(sensor.rate_hz, 1.0 / float(h["t"][1]), len(h["t"]))
    position, velocity = _antenna(spec, h)
    position, velocity, t = position[rows], velocity[rows], h["t"][rows]
    wave = np.sin(2.0 * np.pi * h["x"][rows] / 10.0)
    shift = np.outer(wave, [k("mp_sine_e_m", 0.0), k("mp_sine_n_m", 0.0)])
    position[:, :2] += shift + k("mp_field_m", 0.0) * _place_field(spec.stream("multipath"), position[:, :2])
    sigma = np.array([sensor.sigma_horizontal_m, sensor.sigma_horizontal_m, sensor.sigma_vertical_m])
    if not spec.noiseless:
        white = spec.vehicle.realism.gnss_white_share
        slow = _wandering(rng, len(t), float(t[1]) / max(sensor.correlation_time_s, 1e-3))
        position += sigma * (math.sqrt(1.0 - white) * slow + math.sqrt(white) * rng.normal(size=slow.shape))
        velocity += rng.normal(0.0, sensor.sigma_velocity_mps, velocity.shape)
    late = k("gnss_late_s", 0.0) + k("gnss_late_jitter_s", 0.0) * spec.stream("late").uniform(
        0.5, 1.5, len(t)
    )
    stamped = np.maximum.accumulate(stamps(t + late + spec.vehicle.realism.gnss_latency_s))
    best = Fix.FIXED if sensor.sigma_horizontal_m <= 0.05 else Fix.SINGLE
    count = len(t)
    return Gnss(
        stamped, position, np.tile(sigma, (count, 1)), np.full(count, int(best), dtype=np.uint8),
        velocity, np.full(count, sensor.sigma_velocity_mps),
    )  # fmt: skip


def _antenna(spec: RunSpec, h: History) -> tuple[Array, Array]:
    """Position and velocity (N, 3) of the antenna, world."""
    k, at = spec.changes.get, spec.vehicle.sensors.gnss.antenna_m
    flex_x, flex_y = k("ant_flex_x_m", 0.0), k("ant_flex_y_m", 0.0)
    leans = 0.3 * bool(flex_x or flex_y) / GRAVITY_MPS2
    x = at[0] + k("ant_x_m", 0.0) + flex_x - leans * h["lean_x"]
    y = at[1] + k("ant_y_m", 0.0) + flex_y - leans * h["lean_y"]
    cos, sin = np.cos(h["yaw"]), np.sin(h["yaw"])
    place_x, place_y = h["x"] + cos * x - sin * y, h["y"] + sin * x + cos * y
    u = h["u"] + h["r"] * (h["cg_left"] - y)
    v = h["v"] + h["r"] * (x - h["cg_forward"])
    fast_x, fast_y = cos * u - sin * v, sin * u + cos * v
    rise = h["rise_x"] * fast_x + h["rise_y"] * fast_y
    return np.stack([place_x, place_y, h["z"] + at[2]], axis=1), np.stack([fast_x, fast_y, rise], axis=1)


def _place_field(rng: np.random.Generator, place: Array) -> Array:
    """Smooth random displacement (N, 2) of a place, unit rms."""
    waves = rng.normal(0.0, 1.0 / FIELD_M, (2, 2, FIELD_WAVES))
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, FIELD_WAVES))
    both = [np.cos(place @ w + p).sum(axis=1) for w, p in zip(waves, phase, strict=True)]
    return math.sqrt(2.0 / FIELD_WAVES) * np.stack(both, axis=1)


def _wandering(rng: np.random.Generator, count: int, share: float) -> Array:
    """First-order Gauss-Markov series (count, 3) of unit variance."""
    from scipy.signal import lfilter

    keep = math.exp(-share)
    drive = rng.normal(size=(count, 3)) * math.sqrt(1.0 - keep * keep)
    drive[0] /= math.sqrt(1.0 - keep * keep)
    return np.asarray(lfilter([1.0], [1.0, -keep], drive, axis=0))


def motor(spec: RunSpec, h: History) -> Motor:
    """Current of each side, sum of its two motors, A."""
    rows = every(spec.vehicle.sensors.wheels.rate_hz, 1.0 / float(h["t"][1]), len(h["t"]))
    amps = h["current"][rows]
    sides = np.stack([amps[:, 0] + amps[:, 2], amps[:, 1] + amps[:, 3]], axis=1)
    if not spec.noiseless:
        rng, real = spec.stream("current"), spec.vehicle.realism
        sides = sides * (1.0 + real.current.gain_sigma * rng.normal(size=2))
        sides = sides + real.current.offset_sigma_a * rng.normal(size=2)
        sides = sides + rng.normal(0.0, real.current_noise_a, sides.shape)
    return Motor(stamps(h["t"][rows]), sides)


def currents(n: dict[str, Array], torque: Array, speed: Array) -> Array:
    """Currents (N, 4) of one run from torque and speed (N, 4)."""
    return motor_current(n, torque.T, speed.T).T
