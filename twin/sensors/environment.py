"""Barometer and magnetometer, of vehicles whose file has them.

Pressure: the standard atmosphere at the sensor's height, plus the weather (an offset and a trend that are
drawn once a run, and a random walk), plus white noise.

Field: M (R^T b + disturbance of the place) + hard iron + white noise, in body axes. b is Earth's field at
the datum of simulated drives. M = I + E (soft iron), E symmetric, and the hard iron are drawn once a run.
"""

import math

import numpy as np

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.atmosphere import pressure_at
from terrafusion.datasets.core.channels import Barometer, Magnetometer
from terrafusion.twin.model.motion import BodyMotion
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.sensors.noise import (
    PLANE_WAVES,
    NoiseStreams,
    place_field,
    rows_at_rate,
    sample_rate_hz,
)

FIELD_SIZE_T, INCLINATION_RAD, DECLINATION_RAD = 49.54e-6, math.radians(67.35), math.radians(3.35)
"""World Magnetic Model 2020 at 52 deg N, 8 deg E, 100 m, for 2024-01-01. The declination is positive to the
east, the inclination downwards."""


def earth_field_t() -> Array:
    """Earth's field (3,) at the datum of simulated drives: east, north, up, tesla."""
    flat = FIELD_SIZE_T * math.cos(INCLINATION_RAD)
    up = -FIELD_SIZE_T * math.sin(INCLINATION_RAD)
    return np.array([flat * math.sin(DECLINATION_RAD), flat * math.cos(DECLINATION_RAD), up])


def barometer_channel(
    t_ns: TimesNs, motion: BodyMotion, datum_height_m: float, vehicle: VehicleParams, noise: NoiseStreams
) -> Barometer | None:
    """Static pressure at the sensor, `datum_height_m` + its ENU height above sea level."""
    spec, real = vehicle.sensors.barometer, vehicle.realism.barometer
    if spec is None:
        return None
    rows = rows_at_rate(len(t_ns), sample_rate_hz(motion.t_s), spec.rate_hz)
    pressure = pressure_at(datum_height_m + motion.point_position_m(spec.position_m)[rows, 2])
    if not noise.noiseless:
        t_s = motion.t_s[rows]
        offset, trend = noise.stream("weather").normal(size=2)
        pressure = pressure + real.offset_sigma_pa * offset + real.trend_sigma_paps * trend * t_s
        rng = noise.stream("barometer")
        steps = np.sqrt(np.diff(t_s, prepend=t_s[0])) * rng.normal(size=len(rows))
        pressure = pressure + spec.walk_paps_sqrthz * np.cumsum(steps)
        pressure = pressure + spec.noise_pa * rng.normal(size=len(rows))
    return Barometer(t_ns[rows], pressure)


def magnetometer_channel(
    t_ns: TimesNs, motion: BodyMotion, vehicle: VehicleParams, noise: NoiseStreams
) -> Magnetometer | None:
    """Magnetic flux density in body axes."""
    spec, real = vehicle.sensors.magnetometer, vehicle.realism.magnetometer
    if spec is None:
        return None
    rows = rows_at_rate(len(t_ns), sample_rate_hz(motion.t_s), spec.rate_hz)
    world = np.tile(earth_field_t(), (len(rows), 1))
    if not noise.noiseless:
        rng = noise.stream("magnetic place")
        place = place_field(motion.position_m[rows], real.disturbance_length_m, rng)
        world = world + real.disturbance_t * (math.sqrt(2.0 / PLANE_WAVES) * place)
    field = np.einsum("nji,nj->ni", motion.rotation[rows], world)
    if not noise.noiseless:
        rng = noise.stream("iron")
        hard, soft = rng.normal(size=3), rng.normal(size=(3, 3))
        mixing = np.eye(3) + real.soft_iron_sigma * 0.5 * (soft + soft.T)
        field = field @ mixing.T + spec.hard_iron_sigma_t * hard
        field = field + spec.noise_t * noise.stream("magnetometer").normal(size=field.shape)
    return Magnetometer(t_ns[rows], field)
