"""Current and voltage sensors of the motor controllers."""

import numpy as np

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.channels import Motor
from terrafusion.twin.model.motion import BodyMotion
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.physics.layout import state_slice
from terrafusion.twin.physics.motors import motor_current, motor_voltage
from terrafusion.twin.sensors.noise import NoiseStreams, rows_at_rate, sample_rate_hz, stepped


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
