"""Which robots there are: geometry, ground, drive and sensors of one robot, drawn from a seed.

The ranges were written down before any robot was replayed. They hold what users bring: unknown antenna,
turned IMU, late fixes, tyres that are not as the data sheet says, slow logs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

DRIVES = ("skid_steer", "differential", "ackermann")
RECEIVERS = ("rtk", "dgps", "consumer")


@dataclass(frozen=True)
class Receiver:
    """Fixes: rate, white noise, slow noise (Gauss-Markov, 60 s), and the sigma that is reported."""

    name: str
    rate_hz: float
    white_m: float
    slow_m: float
    sigma_m: float


KINDS = {
    "rtk": Receiver("rtk", 5.0, 0.012, 0.004, 0.02),
    "dgps": Receiver("dgps", 2.0, 0.25, 0.3, 0.5),
    "consumer": Receiver("consumer", 1.0, 0.4, 1.2, 1.5),
}


@dataclass(frozen=True)
class Robot:
    """One robot on one site. Lengths in m, angles in rad, times in s.

    Attributes:
        wheel_error: true wheel radius over the one that the log states.
        friction, slick, slick_share: of the ground, of its slick patches, and the share of those.
        bumps_m: height of the ground, root mean square.
        route_m: way points lie within so much of the centre, east and north.
        antenna_m, imu_m: from the centre of the body; the log tells neither.
        imu_yaw_rad, imu_tilt_rad: how the IMU is turned in its mount.
        gyro_scale, gyro_bias_radps: of its yaw axis.
        fix_delay_s: by which fixes are stamped late.
    """

    seed: int
    drive: str
    mass_kg: float
    radius_m: float
    track_m: float
    wheelbase_m: float
    wheel_error: float
    friction: float
    slick: float
    slick_share: float
    bumps_m: float
    route_m: float
    speed_mps: float
    duration_s: float
    wheels_hz: float
    imu_hz: float
    counts: int
    antenna_m: tuple[float, float, float]
    imu_m: tuple[float, float, float]
    imu_yaw_rad: float
    imu_tilt_rad: tuple[float, float]
    gyro_scale: float
    gyro_bias_radps: float
    receiver: Receiver
    fix_delay_s: float

    @property
    def name(self) -> str:
        """Kind of drive, seed and receiver."""
        return f"{self.drive} {self.seed} {self.receiver.name}"


def draw(seed: int) -> Robot:
    """The robot of a seed: drives in turn, receivers in turn of three, all else at random."""
    rng = np.random.default_rng([seed, 20261126])

    def between(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def one_of(*values: Any) -> Any:
        return values[int(rng.integers(len(values)))]

    size = float(np.exp(rng.uniform(np.log(0.4), np.log(1.1))))
    turned = one_of(0.0, 0.0, 0.0, 0.5 * np.pi, np.pi) + float(np.radians(rng.normal(0.0, 1.5)))
    return Robot(
        seed=seed,
        drive=DRIVES[seed % 3],
        mass_kg=between(80.0, 160.0) * size**2,
        radius_m=between(0.14, 0.2) * max(size, 0.6),
        track_m=between(0.8, 1.1) * size,
        wheelbase_m=between(0.9, 1.3) * size,
        wheel_error=1.0 + float(rng.normal(0.0, 0.03)),
        friction=between(0.6, 0.9),
        slick=between(0.1, 0.3),
        slick_share=one_of(0.0, 0.0, 0.2, 0.4),
        bumps_m=one_of(0.0, 0.05, 0.15),
        route_m=one_of(10.0, 25.0),
        speed_mps=between(0.6, 2.0) * size**0.5,
        duration_s=between(240.0, 360.0),
        wheels_hz=one_of(5.0, 10.0, 20.0, 50.0),
        imu_hz=one_of(5.0, 20.0, 50.0, 100.0, 100.0),
        counts=one_of(500, 2000, 8000),
        antenna_m=(between(-0.4, 0.4) * size, between(-0.15, 0.15) * size, between(0.3, 0.8)),
        imu_m=(between(-0.15, 0.15), between(-0.1, 0.1), between(-0.05, 0.1)),
        imu_yaw_rad=turned,
        imu_tilt_rad=(float(np.radians(rng.normal(0.0, 1.0))), float(np.radians(rng.normal(0.0, 1.0)))),
        gyro_scale=1.0 + float(rng.normal(0.0, 0.01)),
        gyro_bias_radps=float(rng.normal(0.0, 0.004)),
        receiver=KINDS[RECEIVERS[(seed // 3) % 3]],
        fix_delay_s=one_of(0.0, 0.0, 0.1, 0.3, 1.0),
    )
