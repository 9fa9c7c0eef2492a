"""Wheel encoders."""

import numpy as np

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.channels import Wheels
from terrafusion.twin.model.motion import BodyMotion
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.physics.layout import WHEELS, state_slice
from terrafusion.twin.sensors.noise import NoiseStreams, rows_at_rate, sample_rate_hz


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
