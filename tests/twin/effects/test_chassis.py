"""Terms of the chassis: load transfer, leaning body, coupled wheels of a side, scrubbing contacts."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.twin.engine.integrate import integrate
from terrafusion.twin.model.dynamics import graph, rhs
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import INDEX, OUTPUTS, STATES, VEHICLE_PARAMETERS, state_slice
from terrafusion.twin.run_setup import set_up
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from tests.twin.effects.effect_cases import DT_S, ELEVATE, RADIUS_M, drive, plant, samples, soil

TRANSFER, SCRUB, COUPLED = "chassis/load_transfer", "chassis/scrub", "chassis/coupled_sides"
BODY = ELEVATE.body
WEIGHT_N = BODY.mass_kg * GRAVITY_MPS2


def loads(states: np.ndarray, inputs: np.ndarray, slope_rad: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Wheel loads (N, 4) with load transfer, and force on the body (N, 2), on firm ground."""
    import casadi as ca

    g = graph((TRANSFER,))
    out = ca.vertcat(*(w["load_n"] for w in g.wheels), g.quantities["body_force_x_n"])
    out = ca.vertcat(out, g.quantities["body_force_y_n"])
    function = ca.Function("loads", list(g.arguments), [out])
    vehicle = plant(slope_rad=slope_rad).vehicle
    values = function(states.T, inputs.T, vehicle, soil("asphalt"), [1.0]).full().T
    return values[:, :4], values[:, 4:]


def driven(left_mps: float, right_mps: float, seconds: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """States and inputs on asphalt: speeding up for a second, then steady, with load transfer."""
    ramp = np.clip(np.arange(round(seconds / DT_S) + 1) * DT_S, 0.0, 1.0)
    sides = ramp[:, None] * np.array([left_mps, right_mps]) / RADIUS_M
    states, inputs, _ = drive({TRANSFER: 1.0}, sides, "asphalt")
    return states, inputs


def test_speeding_up_loads_the_rear_by_the_moment_of_the_push() -> None:
    """Both sides: h F_x / wheelbase moves from the front axle to the rear one."""
    states, inputs = driven(1.5, 1.5)
    load, force = loads(states[[50]], inputs[[50]])
    moved = 0.5 * (load[0, 2:].sum() - load[0, :2].sum())
    assert force[0, 0] > 0.1 * WEIGHT_N
    assert moved == pytest.approx(BODY.cg_height_m * force[0, 0] / BODY.wheelbase_m, rel=0.03)
    assert load.sum() == pytest.approx(WEIGHT_N, rel=1e-3)


def test_a_left_turn_loads_the_right_wheels() -> None:
    states, inputs = driven(0.9, 1.5)
    load, force = loads(states[[-1]], inputs[[-1]])
    moved = 0.5 * (load[0, 1::2].sum() - load[0, ::2].sum())
    assert force[0, 1] > 0.02 * WEIGHT_N, "centripetal force to the left"
    assert moved == pytest.approx(BODY.cg_height_m * force[0, 1] / BODY.track_m, rel=0.03)


def test_at_steady_speed_on_a_slope_the_loads_are_the_static_ones() -> None:
    straight = np.ones((600, 2)) * 0.5 / RADIUS_M
    for values in ({TRANSFER: 1.0}, {}):
        own = plant("asphalt", {TRANSFER: 1.0} if values else {}, slope_rad=0.15)
        inputs = np.hstack([straight, np.zeros((600, 4))])
        states = integrate(np.zeros(len(STATES)), inputs, DT_S, own)
        assert states[-1, INDEX["u"]] > 0.4
        load, _ = loads(states[[-1]], inputs[[-1]], slope_rad=0.15)
        lean = BODY.cg_height_m * np.tan(0.15) / BODY.wheelbase_m
        assert load[0, 2:].sum() == pytest.approx(WEIGHT_N * np.cos(0.15) * (0.5 + lean), rel=0.01)


def test_a_body_that_leans_reads_gravity_along_what_it_feels() -> None:
    states, inputs = samples()
    pitch, roll = 0.004, 0.006
    values = {"chassis/tilt/pitch": pitch, "chassis/tilt/roll": roll}
    own = plant()
    level, leaning = (read(states, inputs, own, e) for e in ({}, values))
    for axis, compliance in (("x", pitch), ("y", roll)):
        column = OUTPUTS.index(f"accel_{axis}_mps2")
        felt = level[:, column]
        angle = compliance * felt
        expected = felt * np.cos(angle) + GRAVITY_MPS2 * np.sin(angle)
        np.testing.assert_allclose(leaning[:, column], expected, rtol=1e-9, atol=1e-9)
        small = np.abs(felt) < 10.0
        assert (np.abs(leaning[small, column]) >= np.abs(felt[small])).all()


def read(states: np.ndarray, inputs: np.ndarray, own, effects: dict[str, float]) -> np.ndarray:
    from terrafusion.twin.model.measurement import measured

    mounting = np.zeros(5)  # the IMU at the body origin, which is below the centre of gravity
    return measured(states, inputs, own.vehicle, soil(), mounting, effects)


@pytest.mark.parametrize("name", ["husky", "warthog"])
def test_coupled_wheels_of_a_side_turn_as_one_and_create_no_energy(name: str) -> None:
    """Front wheels on asphalt, rear wheels still on mud: free wheels would turn at different speeds."""
    turn = DriveSegment(8.0, v_mps=0.5, yaw_rate_radps=0.4)
    scenario = Scenario("turn", 7.9, drive=(turn,), route=(RouteLeg("mud", 1.5), RouteLeg("asphalt")))
    vehicle = load_vehicle(name)
    assert vehicle.effects == {COUPLED: 1.0}
    free = dataclasses.replace(vehicle, effects={})
    apart = []
    for robot in (vehicle, free):
        states = set_up(scenario, vehicle=robot).drive().states
        speed = states[:, state_slice("wheel_speed")]
        apart.append(np.abs(speed[:, :2] - speed[:, 2:]).max())
        work = states[:, [INDEX[e] for e in ("motor_work", "slip_work", "resistance_work")]]
        inertia, body = robot.wheel.inertia_kgm2, robot.body
        kinetic = 0.5 * inertia * (speed**2).sum(axis=1)
        for mass, axis in ((body.mass_kg, "u"), (body.mass_kg, "v"), (body.yaw_inertia_kgm2, "r")):
            kinetic = kinetic + 0.5 * mass * states[:, INDEX[axis]] ** 2
        balance = work[:, 0] - work[:, 1] - work[:, 2] - kinetic
        assert np.abs(balance).max() < 1e-3 * np.abs(work[:, 0]).max()
    assert apart[0] < 1e-9
    assert apart[1] > 1e-3


def test_a_scrubbing_contact_resists_turning_takes_energy_and_does_nothing_straight_ahead() -> None:
    states, inputs = samples()
    vehicle, ground = plant("asphalt").vehicle, soil("asphalt")
    plain, scrubbed = (rhs((SCRUB,))(states.T, inputs.T, vehicle, ground, [e]).full().T for e in (0.0, 0.7))
    change = scrubbed - plain
    rate, inertia = states[:, INDEX["r"]], vehicle[VEHICLE_PARAMETERS.index("yaw_inertia_kgm2")]
    moment = change[:, INDEX["r"]] * inertia
    assert (moment * rate <= 1e-12).all()
    assert moment[rate == 0.0] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(change[:, INDEX["resistance_work"]], -moment * rate, atol=1e-9)
    assert np.abs(moment).max() < 0.7 * WEIGHT_N * 1.2 * 0.4 * np.hypot(0.145, 0.35)
    assert np.abs(change[:, INDEX["u"]]).max() == pytest.approx(0.0, abs=1e-12)


def test_scrubbing_slows_a_turn() -> None:
    spin = np.repeat([[-3.0, 3.0]], 400, axis=0)
    rates = [drive({SCRUB: e}, spin, "asphalt")[0][-1, INDEX["r"]] for e in (0.0, 0.5, 1.0)]
    assert rates[0] > rates[1] > rates[2] > 0.5 * rates[0]
