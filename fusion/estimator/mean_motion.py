"""What wheels and IMU measured on average from one keyframe to the next."""

from dataclasses import dataclass

from terrafusion.datasets.core.arrays import Array


@dataclass(frozen=True, eq=False)
class MeanMotion:
    """Motion over `dt_s` up to a keyframe.

    Attributes:
        rolled_m: mean distance of the wheels; None where samples of wheels or IMU are missing.
        course_rad: of the wheels, as steered, from the body's x axis.
        gyro_radps, accel_mps2: (3,) mean readings, corrected.
    """

    dt_s: float
    rolled_m: float | None
    course_rad: float
    gyro_radps: Array
    accel_mps2: Array
