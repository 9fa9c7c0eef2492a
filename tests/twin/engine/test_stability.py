"""Integration of stiff robots on hard ground."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.twin.engine.chebyshev import coefficients, reach
from terrafusion.twin.engine.lanes import integrate_many
from terrafusion.twin.engine.stability import stable_stages
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


def wheels_after_a_stop(of: Plant, steps: int, stages: int) -> np.ndarray:
    """Wheel speeds (N, 4) of a robot that starts, stops and stands."""
    inputs = np.zeros((400, len(INPUTS)))
    inputs[50:200, :2] = 3.0
    inputs[49:199, 2:4], inputs[199:201, 2:4] = 0.0, 0.0
    x0 = np.zeros(len(STATES))
    states = integrate_many(x0, inputs, DT_S, [of], substeps=steps, stages=stages)
    return states[0, 250:, state_slice("wheel_speed")]


def amplification(count: int, z: complex) -> complex:
    """Of a step on x' = z x."""
    c, slope = coefficients(count), [z]
    d = [0.0, c[0, 2] * z]
    for mu, nu, own, start, _ in c[1:]:
        slope.append(z * (1.0 + d[-1]))
        d.append(mu * d[-1] + nu * d[-2] + own * slope[-1] + start * z)
    return 1.0 + d[-1]


@pytest.mark.parametrize("count", [3, 4, 5, 8, 20, 40])
def test_a_chebyshev_step_is_of_second_order_and_stable_as_far_as_it_says(count: int) -> None:
    for z in (-0.02, 0.02j):
        assert abs(amplification(count, z) - np.exp(z)) < 0.15 * abs(z) ** 3
    inside = -reach(count) * np.linspace(0.01, 1.0, 500)
    assert max(abs(amplification(count, z)) for z in inside) < 1.0
    assert abs(amplification(count, -1.5 * reach(count))) > 1.0


def test_a_chebyshev_step_is_stable_beside_the_real_axis() -> None:
    """As far as the shear of hard ground swings with a wheel, by .47 of the rate at which it is damped."""
    for count in range(4, 20):
        along = np.linspace(0.05, 0.8, 100) * reach(count)
        assert max(abs(amplification(count, complex(-x, 0.3 * min(x, 8.0)))) for x in along) < 1.0


@pytest.mark.parametrize("vehicle", ["elevate", "husky", "warthog"])
@pytest.mark.parametrize("terrain", ["loose_sand", "grass", "asphalt", "mud"])
def test_robots_of_the_library_need_few_stages(vehicle: str, terrain: str) -> None:
    assert stable_stages(DT_S / 2, plant(terrain, vehicle)) == 3


def test_wheels_at_rest_on_hard_ground_do_not_shake() -> None:
    hard = plant("grass", give_m=2e-4)
    stages = stable_stages(DT_S / 2, hard)
    right = wheels_after_a_stop(hard, 32, 0)
    shaken = np.abs(wheels_after_a_stop(hard, 2, stages - 2) - right).max()
    assert np.abs(wheels_after_a_stop(hard, 2, stages) - right).max() < 1e-4 < 0.1 * shaken
