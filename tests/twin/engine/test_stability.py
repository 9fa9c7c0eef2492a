"""Integration steps of stiff robots on hard ground."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.twin.engine.lanes import integrate_many
from terrafusion.twin.engine.stability import stable_steps
from terrafusion.twin.model.plant import Plant, RouteTable
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import soil_vector, vehicle_vector
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import INPUTS, STATES, state_slice

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
