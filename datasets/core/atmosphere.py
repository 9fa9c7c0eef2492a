"""The International Standard Atmosphere up to 11 km: pressure and height.

p = p_0 (1 - L h / T_0)^(g / (R L)) (ISO 2533:1975, the troposphere; the same as ICAO Doc 7488). Heights
are geopotential, which on the ground is a height above sea level to 0.02 % a kilometre. In air
warmer than the standard a computed height difference is the true one times T_standard / T, 3.5 % less for
each 10 K; the weather shifts all heights by 0.083 m/Pa at sea level.
"""

from typing import TypeVar

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import GRAVITY_MPS2

F = TypeVar("F", float, Array)

PRESSURE_PA = 101_325.0
TEMPERATURE_K = 288.15
LAPSE_KPM = 0.0065
GAS_JPKGK = 287.05287
EXPONENT = GRAVITY_MPS2 / (GAS_JPKGK * LAPSE_KPM)


def pressure_at(height_m: F) -> F:
    """Standard pressure, Pa, at heights up to 11 km."""
    return PRESSURE_PA * (1.0 - LAPSE_KPM / TEMPERATURE_K * height_m) ** EXPONENT


def height_of(pressure_pa: F) -> F:
    """Height in the standard atmosphere, m, of a positive pressure."""
    return TEMPERATURE_K / LAPSE_KPM * (1.0 - (pressure_pa / PRESSURE_PA) ** (1.0 / EXPONENT))


def height_per_pa(pressure_pa: F) -> F:
    """Derivative of `height_of`, m/Pa: negative."""
    return (
        -TEMPERATURE_K
        / (LAPSE_KPM * EXPONENT)
        * (pressure_pa / PRESSURE_PA) ** (1.0 / EXPONENT)
        / pressure_pa
    )
