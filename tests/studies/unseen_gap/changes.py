"""Robots of the study and what is changed on them; both were fixed before a judged robot was diagnosed.

Stiffness of the motors, inertia of the rotors, wheelbase and size of the friction were set on how robots turn
and follow their commands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SIZES: dict[str, tuple[float, float]] = {
    "wheel_radius": (0.03, 0.08),
    "wheel_radius_asymmetry": (0.02, 0.06),
    "encoder_scale": (0.03, 0.08),
    "mass": (0.2, 0.6),
    "cg_lateral": (0.04, 0.1),
    "left_right_friction": (0.3, 0.6),
    "soil_strength": (0.3, 0.6),
    "slope": (0.03, 0.08),
    "track_width": (0.05, 0.15),
    "drivetrain_friction": (0.2, 0.5),
    "dead_time": (0.05, 0.15),
    "actuator_lag": (0.1, 0.3),
    "gyro_bias": (0.003, 0.01),
    "gyro_scale": (0.03, 0.1),
    "accel_bias": (0.1, 0.4),
    "imu_yaw_misalignment": (0.05, 0.17),
    "imu_time_offset": (0.03, 0.1),
    "gnss_latency": (0.1, 0.3),
    "gnss_lever_arm": (0.15, 0.4),
}
"""Small and large size of each change: shares of the number, s, m, rad, rad/s or m/s2."""
FOREIGN = ("free_wheel", "dragged_load")
"""Changes outside the catalogue: the motor of one wheel is off; a load is dragged behind on the left."""


@dataclass(frozen=True)
class Change:
    """One change of a robot, by the name of the effect; "" is none."""

    name: str = ""
    size: float = 0.0

    def of(self, name: str) -> float:
        """The size, if it is this change; 0 otherwise."""
        return self.size if name == self.name else 0.0


@dataclass(frozen=True)
class Machine:
    """A skid-steered robot and its site. Lengths in m, rates in Hz.

    Attributes:
        friction, patches: of the ground: mean, and share by which it varies from place to place.
        bumps_m: height of the ground, root mean square.
        antenna_m, imu_m: forward, left, up of the body's centre.
    """

    seed: int
    mass_kg: float
    radius_m: float
    track_m: float
    wheelbase_m: float
    speed_mps: float
    friction: float
    patches: float
    bumps_m: float
    antenna_m: tuple[float, float, float]
    imu_m: tuple[float, float, float]
    wheels_hz: float
    counts: int


def machine(seed: int) -> Machine:
    """The robot of a seed."""
    rng = np.random.default_rng([seed, 20261127])

    def between(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    size = float(np.exp(rng.uniform(np.log(0.5), np.log(1.1))))
    return Machine(
        seed=seed,
        mass_kg=between(80.0, 140.0) * size**2,
        radius_m=between(0.15, 0.2) * max(size, 0.7),
        track_m=between(0.8, 1.0) * size,
        wheelbase_m=between(0.5, 0.75) * size,
        speed_mps=between(0.8, 1.4) * size**0.5,
        friction=between(0.6, 0.9),
        patches=between(0.05, 0.15),
        bumps_m=between(0.0, 0.02),
        antenna_m=(between(-0.2, 0.2), between(-0.1, 0.1), between(0.3, 0.6)),
        imu_m=(between(-0.1, 0.1), between(-0.1, 0.1), between(0.0, 0.1)),
        wheels_hz=float(rng.choice([20.0, 50.0])),
        counts=int(rng.choice([2000, 8000])),
    )
