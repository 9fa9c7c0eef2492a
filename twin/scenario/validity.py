"""Validity ranges of soils: what lies outside is refused, not extrapolated.

Each number of a soil file has its own range `valid`, checked on loading (`datasets.core.config`). What
depends on the run is checked here: ground pressure, wheel diameter and moisture before the drive, slip after
it.
"""

import math

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.twin.model.ground import patch_share
from terrafusion.twin.model.plant import SoilField
from terrafusion.twin.model.soil import SoilParams
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.physics.layout import INDEX, state_slice
from terrafusion.twin.scenario.route import Route
from terrafusion.twin.scenario.scenario import Scenario

MOVING_MPS = 0.1
TURNING_RADPS = 0.5
"""A robot that stands while a wheel turns faster than this is digging: its slip counts as well."""
SLIP_SHARE = 0.01
"""Slip may lie outside its range for this share of the time it moves: corners of a command."""


def ground_pressure_pa(soil: SoilParams, radius_m: float, width_m: float, load_n: float) -> float:
    """Mean pressure W / (b l) under a wheel at its static sinkage, Pa; l is the model's contact length."""
    from terrafusion.twin.physics.terramechanics import WheelShape, static_sinkage

    p = soil.pressure
    z = float(
        static_sinkage(
            p.k_c_n_per_m_n1, p.k_phi_n_per_m_n2, p.exponent, load_n, WheelShape(radius_m, width_m)
        )
    )
    z = min(z, radius_m)
    length = math.sqrt(2.0 * radius_m * z - z * z + p.contact_length_floor_m**2)
    return load_n / (width_m * length)


def check_wheel(soil: SoilParams, radius_m: float, width_m: float, load_n: float) -> None:
    """Refuses a wheel that is too small or large, or presses too little or much, for a soil.

    Raises:
        ConfigError: the number and what is allowed.
    """
    _check(soil, "wheel_diameter_m", 2.0 * radius_m, "wheel diameter", "m")
    pressure = ground_pressure_pa(soil, radius_m, width_m, load_n)
    _check(soil, "ground_pressure_pa", pressure, f"pressure under a wheel with {load_n:.0f} N", "Pa")


def check_ground(route: Route, scenario: Scenario, vehicle: VehicleParams) -> None:
    """Refuses a vehicle (with its payload) or a moisture that the soils of a drive were not measured for.

    Raises:
        ConfigError: the number, the soil and what is allowed.
    """
    load_n = 0.25 * vehicle.body.mass_kg * GRAVITY_MPS2
    wetness = [leg.moisture_percent for leg in scenario.route]
    grounds = [*zip(route.soils, wetness, strict=True)]
    if route.patch_soil is not None:
        grounds.append((route.patch_soil, None))
    for soil, moisture in grounds:
        check_wheel(soil, vehicle.wheel.radius_m, vehicle.wheel.width_m, load_n)
        if moisture is None:
            continue
        if soil.validity.moisture_percent is None:
            raise ConfigError(
                f"'{soil.name}' has no range of moisture", remedy="leave out 'moisture_percent' there"
            )
        _check(soil, "moisture_percent", moisture, "moisture", "%")


def check_slip(route: Route, field: SoilField | None, t_s: Array, states: Array, slip: Array) -> None:
    """Refuses a run whose wheels slipped where a soil's laws were not measured.

    Args:
        route: soils of the drive, and their field.
        field: of the plane, None where there is none.
        t_s: (N,) times.
        states: (N, X) in the order of `STATES`.
        slip: (N, 4) slip ratios.

    Raises:
        ConfigError: the ground, the slip and what is allowed.
    """
    turning = np.abs(states[:, state_slice("wheel_speed")]).max(axis=1) > TURNING_RADPS
    moving = turning | (np.abs(states[:, INDEX["u"]]) > MOVING_MPS)
    patch = patch_share(field, states[:, INDEX["x"]], states[:, INDEX["y"]])
    labels = route.labels(route.along(t_s, states[:, INDEX["travel"]]), patch)
    for soil in {soil.name: soil for soil in (*route.soils, route.patch_soil) if soil is not None}.values():
        low, high = soil.validity.slip
        there = slip[moving & (labels == soil.name)]
        outside = (there < low) | (there > high)
        if there.size and outside.mean() > SLIP_SHARE:
            worst = float(there[outside][np.argmax(np.abs(there[outside]))])
            raise ConfigError(
                f"slip reached {worst:.2f} on '{soil.name}', {100.0 * outside.mean():.0f} % of the time",
                channel="validity.slip",
                remedy=f"its numbers hold from {low:g} to {high:g}: drive more gently or take another soil",
            )


def _check(soil: SoilParams, key: str, value: float, what: str, unit: str) -> None:
    low, high = getattr(soil.validity, key)
    if not low <= value <= high:
        raise ConfigError(
            f"{what} is {value:.4g} {unit}, outside the validity range of '{soil.name}'",
            channel=f"validity.{key}",
            remedy=f"its numbers hold from {low:g} to {high:g} {unit}",
        )
