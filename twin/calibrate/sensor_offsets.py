"""Constant errors of the sensors of a log: offsets and gains, estimated as nuisance parameters.

Otherwise a current sensor that is 2 % off would pass for a heavier robot. Each has a Gaussian prior, its
width from the vehicle's file where that gives it.
"""

from __future__ import annotations

from dataclasses import dataclass

from terrafusion.twin.model.vehicle import VehicleParams

GYRO_OFFSET_RADPS, ACCEL_OFFSET_MPS2 = 0.02, 0.5
"""1 sigma of the offsets of an IMU (assumed): a warm MEMS gyro; an accelerometer tilted by 3 deg."""
LEAST_GAIN, LEAST_CURRENT_OFFSET_A = 1e-3, 0.02
"""Least 1 sigma of a gain and of a current sensor's offset (assumed)."""


@dataclass(frozen=True)
class SensorError:
    """Gain or offset of one channel, reading = (1 + gain) true + offset, with its prior 1 sigma."""

    channel: str
    kind: str
    sigma: float

    @property
    def name(self) -> str:
        """Channel and kind."""
        return f"{self.channel} {self.kind}"


def sensor_errors(vehicle: VehicleParams) -> tuple[SensorError, ...]:
    """The errors of all channels, always in the same order."""
    imu, current = vehicle.realism.imu, vehicle.realism.current
    gyro, accel = max(imu.gyro_scale_sigma, LEAST_GAIN), max(imu.accel_scale_sigma, LEAST_GAIN)
    offset, gain = max(current.offset_sigma_a, LEAST_CURRENT_OFFSET_A), max(current.gain_sigma, LEAST_GAIN)
    found = [
        ("yaw_rate_radps", GYRO_OFFSET_RADPS, gyro),
        ("accel_x_mps2", ACCEL_OFFSET_MPS2, accel),
        ("accel_y_mps2", ACCEL_OFFSET_MPS2, accel),
        ("current_left_a", offset, gain),
        ("current_right_a", offset, gain),
    ]
    return tuple(
        SensorError(channel, kind, sigma)
        for channel, *sigmas in found
        for kind, sigma in zip(("offset", "gain"), sigmas, strict=True)
    )
