"""Sensors of the drive: wheel encoders, motor currents and voltages, steering angles."""

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.channels import Motor, Steering, Wheels
from terrafusion.twin.model.motion import BodyMotion
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.physics.layout import WHEELS, state_slice
from terrafusion.twin.physics.motors import motor_current, motor_voltage
from terrafusion.twin.scenario.commands import wheel_angles
from terrafusion.twin.sensors.noise import NoiseStreams, rows_at_rate, sample_rate_hz, stepped


def wheels_channel(
    t_ns: TimesNs, motion: BodyMotion, states: Array, vehicle: VehicleParams, noise: NoiseStreams
) -> Wheels:
    """Four encoders: counted angle, and speed as counts over the controller's interval before the stamp.

    The controller reads its counters on its own clock; a message may be stamped later (see
    `realism.EncoderRealism`), but none overtakes another.
    """
    spec = vehicle.sensors.wheels
    rows = rows_at_rate(len(t_ns), sample_rate_hz(motion.t_s), spec.rate_hz)
    angle, stamps = states[rows, state_slice("wheel_angle")], t_ns[rows]
    if not noise.noiseless:
        angle = counted(angle, vehicle, noise)
        jitter_s = vehicle.realism.encoder.stamp_jitter_s
        late_ns = noise.stream("encoder stamp").uniform(0.0, jitter_s * 1e9, len(rows))
        stamps = np.maximum.accumulate(stamps + np.round(late_ns).astype(np.int64))
    speed = np.zeros_like(angle)
    speed[1:] = np.diff(angle, axis=0) / np.diff(motion.t_s[rows])[:, None]
    return Wheels(stamps, speed, WHEELS, "radps", angle)


def counted(angle_rad: Array, vehicle: VehicleParams, noise: NoiseStreams) -> Array:
    """Wheel angles (N, 4) as the counters have them: with the error of the code wheel, in whole quanta."""
    real, quantum = vehicle.realism.encoder, vehicle.sensors.wheels.quantum_rad
    if real.position_error_rad > 0.0:
        phase = noise.stream("encoder eccentricity").uniform(0.0, 2.0 * np.pi, 4)
        error_rad = np.sin(real.shaft_turns * angle_rad + phase) - np.sin(phase)
        angle_rad = angle_rad + real.position_error_rad / real.shaft_turns * error_rad
    if quantum > 0.0:
        offset = noise.stream("encoder phase").uniform(0.0, quantum, 4)
        angle_rad = np.floor((angle_rad + offset) / quantum) * quantum
    return angle_rad


def motor_channel(
    t_ns: TimesNs,
    motion: BodyMotion,
    states: Array,
    parameters: dict[str, float],
    vehicle: VehicleParams,
    noise: NoiseStreams,
) -> Motor:
    """Current of each side (sum of its two motors, A) and their mean voltage (V), at the wheels' rate.

    The current carries a gain and an offset of its sensor, white noise and the converter's steps; the
    voltage is exact.
    """
    rows = rows_at_rate(len(t_ns), sample_rate_hz(motion.t_s), vehicle.sensors.wheels.rate_hz)
    torque, speed = states[rows, state_slice("torque")], states[rows, state_slice("wheel_speed")]
    current = motor_current(parameters, torque, speed)
    voltage = motor_voltage(parameters, current, speed)
    sides = np.stack([current[:, 0] + current[:, 2], current[:, 1] + current[:, 3]], axis=1)
    volts = 0.5 * np.stack([voltage[:, 0] + voltage[:, 2], voltage[:, 1] + voltage[:, 3]], axis=1)
    if not noise.noiseless:
        real = vehicle.realism.current
        gain, offset = noise.stream("current sensor").normal(size=(2, 2))
        sides = (1.0 + real.gain_sigma * gain) * sides + real.offset_sigma_a * offset
        sides = sides + noise.stream("current").normal(0.0, vehicle.realism.current_noise_a, sides.shape)
        sides = stepped(sides, real.quantum_a)
    return Motor(t_ns[rows], sides, volts)


def steering_channel(
    t_ns: NDArray[np.int64], motion: BodyMotion, inputs: Array, vehicle: VehicleParams, noise: NoiseStreams
) -> Steering | None:
    """Mean angle of the front wheels, or of each axle where both steer, at the rate of the encoders.

    It has white noise, and a zero and a scale that are off, drawn once a run by the sigmas of the vehicle's
    `steering`. None for a vehicle that does not steer.
    """
    spec = vehicle.steered()
    if spec is None:
        return None
    rows = rows_at_rate(len(t_ns), sample_rate_hz(motion.t_s), vehicle.sensors.wheels.rate_hz)
    wheels = wheel_angles(inputs[rows], vehicle)
    both = vehicle.drive.type == "four_wheel_steer"
    names = ("front", "rear") if both else ("angle",)
    angle = np.stack([wheels[:, :2].mean(axis=1), wheels[:, 2:].mean(axis=1)], axis=1)[:, : len(names)]
    if not noise.noiseless:
        rng = noise.stream("steering")
        scale, offset = (
            np.exp(spec.scale_sigma * rng.normal()),
            spec.offset_sigma_rad * rng.normal(size=len(names)),
        )
        angle = angle * scale + offset + spec.noise_rad * rng.normal(size=angle.shape)
    return Steering(t_ns[rows], angle, names)
