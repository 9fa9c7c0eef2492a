"""What the robot's sensors report of its motion; each sensor has a module in `sensing`.

Every sensor draws from a stream of its own, named and seeded, so that a change
of one leaves the others' noise as it was. With `noiseless` the numbers are
exact at the integrator's accuracy: no noise, bias, quantisation or vibration.

Rates and increments are means over the interval that ends at the time stamp:
a gyro sample times the interval is the exact rotation, an accelerometer sample
times the interval the exact change of velocity less gravity, in the axes the
body had at the start of the interval (what strapdown preintegration expects).
"""

from __future__ import annotations

from terrafusion.twin.sensors.current import motor_channel
from terrafusion.twin.sensors.encoders import wheels_channel
from terrafusion.twin.sensors.environment import barometer_channel, magnetometer_channel
from terrafusion.twin.sensors.gnss import best_fix, gnss_channel
from terrafusion.twin.sensors.imu import imu_channel
from terrafusion.twin.sensors.noise import NoiseStreams, rows_at_rate

__all__ = [
    "NoiseStreams",
    "barometer_channel",
    "best_fix",
    "gnss_channel",
    "imu_channel",
    "magnetometer_channel",
    "motor_channel",
    "rows_at_rate",
    "wheels_channel",
]
