"""Integration steps of stiff robots on hard ground."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.twin.engine.integrate import integrate
from terrafusion.twin.engine.lanes import integrate_many
from terrafusion.twin.engine.stability import stable_steps, steps_a_sample
from terrafusion.twin.model.plant import Plant, RouteTable
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import soil_vector, vehicle_vector
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import INPUTS, STATES, VEHICLE_PARAMETERS, state_slice

DT_S = 0.01


def plant(terrain: str, vehicle: str = "elevate", give_m: float | None = None) -> Plant:
    """A robot, and ground of another shear modulus than the library's."""
    soil = load_soil(terrain)
    if give_m is not None:
        soil = dataclasses.replace(soil, shear=dataclasses.replace(soil.shear, shear_modulus_m=give_m))
    route = RouteTable("travel", np.zeros(1), soil_vector(soil)[None])
    return Plant(vehicle_vector(load_vehicle(vehicle)), route, {})


def wheels_after_a_stop(of: Plant, steps: int) -> np.ndarray:
    """Wheel speeds (N, 4) of a robot that starts, stops and stands."""
    inputs = np.zeros((400, len(INPUTS)))
    inputs[50:200, :2] = 3.0
    inputs[49:199, 2:4], inputs[199:201, 2:4] = 0.0, 0.0
    states = integrate_many(np.zeros(len(STATES)), inputs, DT_S, [of], substeps=steps, order=3)
    return states[0, 250:, state_slice("wheel_speed")]


@pytest.mark.parametrize("vehicle", ["elevate", "husky", "warthog"])
@pytest.mark.parametrize("terrain", ["loose_sand", "grass", "asphalt", "mud"])
def test_robots_of_the_library_need_no_further_steps(vehicle: str, terrain: str) -> None:
    assert stable_steps(DT_S, plant(terrain, vehicle), 3) == 3


def test_wheels_at_rest_on_hard_ground_do_not_shake() -> None:
    hard = plant("grass", give_m=2e-4)
    steps = stable_steps(DT_S, hard, 3)
    assert steps > 3
    right = wheels_after_a_stop(hard, 8 * steps)
    shaken = np.abs(wheels_after_a_stop(hard, 3) - right).max()
    assert np.abs(wheels_after_a_stop(hard, steps) - right).max() < 1e-4 < 0.1 * shaken


def test_longer_lag_allows_longer_steps_and_shorter_lag_asks_for_shorter() -> None:
    vehicle = np.ones(len(VEHICLE_PARAMETERS))
    lag = VEHICLE_PARAMETERS.index("lag_s")
    vehicle[lag] = 0.002
    assert steps_a_sample(0.01, vehicle) == 3
    vehicle[lag] = 0.001
    assert steps_a_sample(0.01, vehicle) == 6


def light_wheeled(inertia_kgm2: float) -> Plant:
    """A robot of 3 kg whose wheels weigh little, on asphalt."""
    vehicle = load_vehicle("generic")
    body = dataclasses.replace(vehicle.body, mass_kg=3.0, yaw_inertia_kgm2=0.03)
    wheel = dataclasses.replace(vehicle.wheel, radius_m=0.05, width_m=0.04, inertia_kgm2=inertia_kgm2)
    drive = dataclasses.replace(
        vehicle.drive, gear_ratio=50.0, stall_torque_nm=0.02, torque_limit_nm=0.012,
        no_load_speed_radps=1000.0, speed_loop_p_nms=0.1, speed_loop_i_nm=0.5,
    )  # fmt: skip
    small = dataclasses.replace(vehicle, body=body, wheel=wheel, drive=drive)
    return dataclasses.replace(plant("asphalt"), vehicle=vehicle_vector(small))


def test_light_wheels_are_integrated_with_steps_that_hold_them() -> None:
    light = light_wheeled(5e-5)
    inputs = np.zeros((400, len(INPUTS)))
    inputs[50:200, 0], inputs[50:200, 1] = 10.0, 12.0
    states = integrate(np.zeros(len(STATES)), inputs, DT_S, light)
    right = integrate(np.zeros(len(STATES)), inputs, DT_S, light, substeps=60)
    assert np.abs(states - right)[:, state_slice("wheel_speed")].max() < 0.05
    assert np.abs(states - right)[-1, :3].max() < 1e-4
    many = integrate_many(np.zeros(len(STATES)), inputs, DT_S, [light, light])
    np.testing.assert_array_equal(many, np.stack([states, states]))


def test_a_robot_that_is_too_stiff_is_refused() -> None:
    with pytest.raises(TerrafusionError, match="too stiff"):
        stable_steps(DT_S, light_wheeled(1e-9), 4)
