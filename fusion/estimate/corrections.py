"""What an estimator that calibrates itself changed during a drive."""

from dataclasses import dataclass

from terrafusion.fusion.estimate.antenna import AntennaPlaces


@dataclass(frozen=True)
class Corrections:
    """Numbers of the robot that the drive refuted.

    Attributes:
        numbers: names of those that correct a sensor at the end.
        imu_since_ns: when the samples of a turned IMU began to be turned back; None for one that is not.
        imu_sigma_rad: 1 sigma of the angle of the IMU about z at the end; None where it is not learned.
        antenna: lever arms and delays of the fixes as they were used.
        uncorrected_delay_s: lateness of the fixes beyond what was known, and its 1 sigma with what skidding
            wheels imitate; None where it was corrected or not learned.
    """

    numbers: frozenset[str] = frozenset()
    imu_since_ns: int | None = None
    imu_sigma_rad: float | None = None
    antenna: AntennaPlaces | None = None
    uncorrected_delay_s: tuple[float, float] | None = None
