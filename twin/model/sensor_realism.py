"""What the twin adds to the data-sheet figures of `SensorSuite`, for the sensors of one vehicle.

Every entry of the sections defaults to "absent", so that a vehicle file may
leave out what nobody knows.
"""

import math
from dataclasses import dataclass, field
from typing import Annotated

from terrafusion.datasets.core.quantity import Sourced


@dataclass(frozen=True)
class ImuRealism:
    """Errors of an IMU beyond white noise, bias walk and turn-on bias.

    Bias instability is the flat floor of the Allan deviation (IEEE Std 952).
    Scale factors and misalignments of the axes differ from unit to unit: they
    are drawn once a run. A sample is clipped to the range and then rounded to
    the quantum.
    """

    gyro_bias_instability_radps: Annotated[float, Sourced("rad/s", 0.0, 0.1)] = 0.0
    accel_bias_instability_mps2: Annotated[float, Sourced("m/s2", 0.0, 1.0)] = 0.0
    gyro_scale_sigma: Annotated[float, Sourced("", 0.0, 0.1)] = 0.0
    accel_scale_sigma: Annotated[float, Sourced("", 0.0, 0.1)] = 0.0
    misalignment_sigma_rad: Annotated[float, Sourced("rad", 0.0, 0.1)] = 0.0
    gyro_range_radps: Annotated[float, Sourced("rad/s", 0.1, 1000.0)] = math.inf
    accel_range_mps2: Annotated[float, Sourced("m/s2", 10.0, 10000.0)] = math.inf
    gyro_quantum_radps: Annotated[float, Sourced("rad/s", 0.0, 0.1)] = 0.0
    accel_quantum_mps2: Annotated[float, Sourced("m/s2", 0.0, 1.0)] = 0.0


@dataclass(frozen=True)
class EncoderRealism:
    """Errors of a wheel encoder beyond its quantum.

    `position_error_rad` is the largest angular error over a turn of the
    encoder's own shaft, which turns `shaft_turns` times a wheel turn; it comes
    once a turn (an eccentric code wheel). A message is stamped up to
    `stamp_jitter_s` after the counter was read.
    """

    position_error_rad: Annotated[float, Sourced("rad", 0.0, 1.0)] = 0.0
    shaft_turns: Annotated[float, Sourced("", 0.01, 1000.0)] = 1.0
    stamp_jitter_s: Annotated[float, Sourced("s", 0.0, 0.1)] = 0.0


@dataclass(frozen=True)
class GnssRealism:
    """How a receiver fares where it does not see the whole sky; see `sensors.gnss`.

    `reported_share` is the sigma the receiver reports over the true one of its
    random errors. A receiver that lost its signals finds a stand-alone fix again
    in `reacquire_s`, and climbs from there to its best class in `refix_s`, both on
    average under open sky. Under canopy of density 1 the signals are
    `canopy_attenuation_db` weaker, a step of fix class is lost `canopy_loss_per_s`
    times a second, and multipath displaces a stand-alone fix by
    `canopy_multipath_m` (1 sigma an axis), differently from place to place over
    `multipath_length_m`.
    """

    reported_share: Annotated[float, Sourced("", 0.05, 2.0)] = 1.0
    reacquire_s: Annotated[float, Sourced("s", 0.0, 3600.0)] = 0.0
    refix_s: Annotated[float, Sourced("s", 0.0, 3600.0)] = 0.0
    canopy_attenuation_db: Annotated[float, Sourced("dB", 0.0, 40.0)] = 0.0
    canopy_loss_per_s: Annotated[float, Sourced("1/s", 0.0, 100.0)] = 0.0
    canopy_multipath_m: Annotated[float, Sourced("m", 0.0, 100.0)] = 0.0
    multipath_length_m: Annotated[float, Sourced("m", 0.1, 100.0)] = 3.0


@dataclass(frozen=True)
class CurrentRealism:
    """Errors of a motor current sensor beyond white noise: gain and offset, drawn once a run, and steps."""

    gain_sigma: Annotated[float, Sourced("", 0.0, 0.5)] = 0.0
    offset_sigma_a: Annotated[float, Sourced("A", 0.0, 100.0)] = 0.0
    quantum_a: Annotated[float, Sourced("A", 0.0, 100.0)] = 0.0


@dataclass(frozen=True)
class BarometerRealism:
    """What the weather adds to a standard pressure: an offset and a trend, drawn once a run."""

    offset_sigma_pa: Annotated[float, Sourced("Pa", 0.0, 10000.0)] = 0.0
    trend_sigma_paps: Annotated[float, Sourced("Pa/s", 0.0, 10.0)] = 0.0


@dataclass(frozen=True)
class MagnetometerRealism:
    """What iron does to a field besides the hard iron of `MagnetometerSpec`, 1 sigma each.

    Soft iron of the robot mixes the axes, drawn once a run. Iron of the place disturbs each axis by a
    fixed field over `disturbance_length_m`.
    """

    soft_iron_sigma: Annotated[float, Sourced("", 0.0, 0.5)] = 0.0
    disturbance_t: Annotated[float, Sourced("T", 0.0, 1e-3)] = 0.0
    disturbance_length_m: Annotated[float, Sourced("m", 0.1, 1000.0)] = 5.0


@dataclass(frozen=True)
class SensorRealism:
    """What the twin adds to the data-sheet noise of `SensorSuite`.

    `vibration_gain` scales the soil's vibration for the IMU's mounting.
    A GNSS position error is white for `gnss_white_share` of its variance and
    Gauss-Markov for the rest; `gnss_single_sigma_m` and
    `gnss_single_correlation_s` hold for stand-alone fixes, the numbers of
    `GnssSpec` for the receiver's best mode.
    """

    vibration_gain: Annotated[float, Sourced("", 0.0, 100.0)]
    gnss_white_share: Annotated[float, Sourced("", 0.0, 1.0)]
    gnss_single_sigma_m: Annotated[float, Sourced("m", 0.01, 100.0)]
    gnss_single_correlation_s: Annotated[float, Sourced("s", 0.0, 3600.0)]
    gnss_latency_s: Annotated[float, Sourced("s", -5.0, 10.0)]
    current_noise_a: Annotated[float, Sourced("A", 0.0, 100.0)]
    imu: ImuRealism = field(default_factory=ImuRealism)
    encoder: EncoderRealism = field(default_factory=EncoderRealism)
    gnss: GnssRealism = field(default_factory=GnssRealism)
    current: CurrentRealism = field(default_factory=CurrentRealism)
    barometer: BarometerRealism = field(default_factory=BarometerRealism)
    magnetometer: MagnetometerRealism = field(default_factory=MagnetometerRealism)
