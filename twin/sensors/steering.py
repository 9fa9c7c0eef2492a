"""Steering angle sensors, of vehicles that steer."""

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Steering
from terrafusion.twin.model.motion import BodyMotion
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.scenario.commands import wheel_angles
from terrafusion.twin.sensors.noise import NoiseStreams, rows_at_rate, sample_rate_hz


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
