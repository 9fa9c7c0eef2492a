"""Replaces a yaw gyro whose reading is stuck, while the wheels show another turn, by the wheels."""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from terrafusion.datasets.core.arrays import Array, Stamp
from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.config.sensor_config import SensorConfig, yaw_factor
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.inputs.gyro_unit import GyroUnit
from terrafusion.fusion.inputs.streams import WheelStream
from terrafusion.fusion.inputs.validation import as_numbers, checked_time
from terrafusion.fusion.noise.policy import SensorNoise

STUCK_NS, STUCK_SAMPLES = 500_000_000, 5
"""Time and samples of one reading to the last bit; noise changes that of a gyro in order."""
DISAGREE_RADPS, DISAGREE_LONG_RADPS, DISAGREE_SHARE = 0.2, 0.1, 0.5
"""Difference from the wheels beyond which the reading is wrong, the second where it has lasted four times as
long, and share of it: slip and track (assumed)."""
WHEEL_YAW_DENSITY = 0.2
"""Yaw from wheels, rad/s/sqrt(Hz), in place of the gyro's noise (assumed: .1 rad/s for some seconds)."""


class StuckGyro:
    """Watches the yaw rate.

    Attributes:
        stuck: the reading is wrong now.
        samples: number of readings replaced.
        doubt_rad: heading error since the reading was last right, to be taken into account.
        unit: whether the readings are in rad/s.
    """

    def __init__(self, rig: Rig, inputs: SensorConfig) -> None:
        self.stuck = False
        self.samples = 0
        self.doubt_rad = 0.0
        self._track_m, self._density = rig.track_m / yaw_factor(rig), rig.sensors.imu.gyro_noise_radps_sqrthz
        self._sides = inputs.sides
        self.unit = GyroUnit(rig.track_m)
        self._reading = float("nan")
        self._since_ns = 0
        self._count = 0

    def checked(self, t_ns: Stamp, gyro_radps: ArrayLike, wheels: WheelStream) -> Array:
        """A reading (3,), its yaw rate that of the wheels where the gyro is stuck.

        Raises:
            DataError: it is no reading, or in deg/s.
        """
        gyro = as_numbers(gyro_radps, "gyro", "imu")
        t_ns = checked_time(t_ns, "imu")
        if gyro.shape != (3,) or not self._sides:  # the stream refuses the first
            return gyro
        reading = float(gyro[2])
        self.unit.check(t_ns, reading, wheels)
        if reading != self._reading:
            self._reading, self._since_ns, self._count, self.stuck = reading, t_ns, 0, False
            return gyro
        self._count += 1
        lasts_ns = t_ns - self._since_ns
        if lasts_ns < STUCK_NS or self._count < STUCK_SAMPLES or not wheels.t_ns:
            return gyro
        newest = wheels.t_ns[-1]
        travelled = wheels.travelled(newest - STUCK_NS, newest)
        if travelled is None or abs(t_ns - newest) > STUCK_NS:
            return gyro
        turning = (travelled[1] - travelled[0]) / self._track_m / (STUCK_NS * 1e-9)
        off = abs(turning - reading)
        least = DISAGREE_RADPS if lasts_ns < 4 * STUCK_NS else DISAGREE_LONG_RADPS
        if not self.stuck and off > least + DISAGREE_SHARE * min(abs(turning), abs(reading)):
            self.stuck = True
            self.doubt_rad = 1e-9 * off * lasts_ns
        if not self.stuck:
            return gyro
        self.samples += 1
        return np.array([gyro[0], gyro[1], turning])

    def doubt_heading(self, chain: Chain) -> None:
        """Take the heading error into account that a stuck reading has made before it was found."""
        if self.doubt_rad:
            chain.restart(self.doubt_rad**2 * (np.arange(chain.dim) == 2))
            self.doubt_rad = 0.0

    def noise(self, noise: SensorNoise) -> SensorNoise:
        """Noise of the IMU, that of wheels about yaw while they stand in."""
        if not self.stuck:
            return noise
        inflation = max(noise.gyro_yaw_inflation, WHEEL_YAW_DENSITY / self._density)
        return dataclasses.replace(noise, gyro_yaw_inflation=inflation)
