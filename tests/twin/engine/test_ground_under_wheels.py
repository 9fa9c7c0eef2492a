"""Every wheel has its own ground: axles meet a border one after the other, fields vary left and right."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.twin.engine.integrate import compiled, integrate
from terrafusion.twin.model.plant import Plant, RouteTable, SoilField
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import soil_vector, vehicle_vector
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import INDEX, SOIL_PARAMETERS, STATES
from terrafusion.twin.scenario.commands import delayed_inputs

RAMP = np.clip(np.arange(601) / 100.0, 0.0, 1.0)[:, None] * np.array([5.0, 5.0])


def field(log_gain: np.ndarray, patch: str = "asphalt", share: float = 0.0) -> SoilField:
    response = np.zeros(len(SOIL_PARAMETERS))
    response[SOIL_PARAMETERS.index("friction_cap")] = 1.0
    share_grid = np.full_like(log_gain, share)
    return SoilField(0.5, log_gain, response, share_grid, soil_vector(load_soil(patch)))


def drive(route: RouteTable, backend: str = "auto", dead_time_s: float = 0.0) -> np.ndarray:
    plant = Plant(vehicle_vector(load_vehicle("elevate"), slope_rad=0.1), route)
    return integrate(
        np.zeros(len(STATES)),
        delayed_inputs(RAMP, 0.01, dead_time_s),
        0.01,
        plant,
        substeps=3,
        backend=backend,
    )


def one(soil: str, of: SoilField | None = None) -> RouteTable:
    return RouteTable("travel", np.zeros(1), soil_vector(load_soil(soil))[None], of)


def test_a_flat_field_changes_nothing_and_a_full_patch_is_the_other_ground() -> None:
    plain = drive(one("loose_sand"))
    np.testing.assert_array_equal(drive(one("loose_sand", field(np.zeros((4, 4))))), plain)
    full = drive(one("loose_sand", field(np.zeros((4, 4)), "asphalt", 1.0)))
    np.testing.assert_allclose(full, drive(one("asphalt")), rtol=0, atol=1e-9)


def test_weak_ground_on_the_left_turns_the_robot_left_and_mirrors() -> None:
    """The field lies so that the wheels' tracks at y = +-0.25 m see different strength."""
    yaw = drive(one("loose_sand", field(np.array([[0.0, 0.0], [-0.6, -0.6], [0.0, 0.0], [0.0, 0.0]]))))
    mirrored = drive(one("loose_sand", field(np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [-0.6, -0.6]]))))
    assert yaw[-1, INDEX["yaw"]] > 1e-3
    np.testing.assert_allclose(yaw[:, INDEX["yaw"]], -mirrored[:, INDEX["yaw"]], atol=1e-9)


def test_the_front_axle_meets_a_border_first() -> None:
    soils = np.stack([soil_vector(load_soil(name)) for name in ("asphalt", "loose_sand")])
    states = drive(RouteTable("travel", np.array([1.0, 1.1]), soils))
    firm = drive(one("asphalt"))
    first = int(np.argmax(np.any(states != firm, axis=1)))
    half = 0.5 * load_vehicle("elevate").body.wheelbase_m
    assert states[first - 1, INDEX["travel"]] <= 1.0 - half <= states[first, INDEX["travel"]]


@pytest.mark.skipif(not compiled(), reason="no C compiler")
def test_both_backends_agree_on_a_field() -> None:
    rng = np.random.default_rng(3)
    soils = np.stack([soil_vector(load_soil(name)) for name in ("asphalt", "loose_sand")])
    varied = field(rng.normal(0.0, 0.3, (5, 6)), "mud", 0.3)
    route = RouteTable("travel", np.array([1.0, 1.3]), soils, varied)
    np.testing.assert_allclose(drive(route, "c", 0.123), drive(route, "vm", 0.123), rtol=0, atol=1e-9)


def test_a_late_command_is_the_same_command_later_and_its_rate_the_derivative() -> None:
    t = np.arange(401) * 0.01
    sides = np.stack([np.sin(t), np.cos(2 * t) - 1.0], axis=1)
    np.testing.assert_allclose(delayed_inputs(sides, 0.01, 0.2)[20:, :2], sides[:-20], atol=1e-12)
    np.testing.assert_array_equal(
        delayed_inputs(sides, 0.01, 0.2)[:20], np.repeat([[*sides[0], 0, 0, 0, 0]], 20, axis=0)
    )
    for dead_time in (0.0, 0.113):
        eps = 1e-7
        inputs, later = delayed_inputs(sides, 0.01, dead_time), delayed_inputs(sides, 0.01, dead_time + eps)
        moving = slice(round(dead_time * 100) + 2, None)
        change = (later[moving, :2] - inputs[moving, :2]) / eps
        np.testing.assert_allclose(change, -inputs[moving, 2:4], atol=1e-6)
