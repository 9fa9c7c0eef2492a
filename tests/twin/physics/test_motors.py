"""Battery, motors and gearboxes: envelope, sag, and an energy balance that closes."""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.twin.analysis.summary import (
    MOTOR_STALLED,
    TRACTION_LOST,
    slip_ratios,
    summarise,
)
from terrafusion.twin.engine.integrate import integrate
from terrafusion.twin.model.vectors import vehicle_vector
from terrafusion.twin.model.vehicle import Battery, VehicleParams, load_vehicle
from terrafusion.twin.physics.layout import INDEX, INPUTS, STATES, VEHICLE_PARAMETERS, state_slice
from terrafusion.twin.physics.motors import battery, motor_current, motor_torque
from terrafusion.twin.run_setup import set_up
from terrafusion.twin.scenario.commands import DrivenStates, delayed_inputs
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate_run
from tests.twin.energy_balance import Energy, energy_of, gear_loss

ELEVATE = load_vehicle("elevate")
P = dict(zip(VEHICLE_PARAMETERS, vehicle_vector(ELEVATE).tolist(), strict=True))
AT_WHEEL = ELEVATE.drive.gear_ratio * ELEVATE.drive.gear_efficiency
QUICK = settings(max_examples=50, deadline=None, derandomize=True)
HEAT = ("battery_heat_j", "motor_heat_j", "gear_heat_j", "braking_heat_j")


def given_torque(
    speed: float, error: float, integral: float = 0.0, share: float = 1.0
) -> tuple[float, float]:
    torque, rate = motor_torque(P, ca.DM(speed), ca.DM(error), ca.DM(integral), share)
    return float(torque), float(rate)


def fed_by(battery: Battery | None) -> VehicleParams:
    return dataclasses.replace(ELEVATE, battery=battery)


def energy(scenario: str | Scenario, vehicle: VehicleParams | str = ELEVATE, **kw) -> Energy:
    setup = set_up(scenario, vehicle=vehicle, **kw)
    return energy_of(setup.t_s, setup.drive().states, setup.plant.vehicle)


@QUICK
@given(
    relative=st.floats(-1.0, 1.0),
    error=st.floats(-50.0, 50.0),
    integral=st.floats(-20.0, 20.0),
    share=st.floats(0.5, 1.1),
)
def test_torque_keeps_within_current_limit_and_torque_speed_line(relative, error, integral, share) -> None:
    """The line falls from the stall torque at rest to zero at the no-load speed; both follow the supply.

    A wheel that is driven beyond the no-load speed is braked by its back-EMF, whatever the current.
    """
    drive = ELEVATE.drive
    speed = relative * drive.no_load_speed_radps / drive.gear_ratio
    torque, _ = given_torque(speed, error, integral, share)
    limit, stall = drive.torque_limit_nm * AT_WHEEL, drive.stall_torque_nm * AT_WHEEL
    room = 0.1  # the clipping is smooth within 0.05 N m, twice
    if abs(relative) <= share:
        assert -min(limit, stall * (share + relative)) - room <= torque
        assert torque <= min(limit, stall * (share - relative)) + room
    else:
        assert torque * relative < room


def test_a_saturated_loop_winds_its_integral_back() -> None:
    _, free = given_torque(0.0, 1.0)
    _, saturated = given_torque(0.0, 10.0)
    _, wound = given_torque(0.0, 1.0, integral=50.0)
    assert free == pytest.approx(1.0, abs=0.01)
    assert saturated < 0.5 * 10.0
    assert wound < 0.0


@pytest.mark.parametrize("share", [0.6, 0.8, 1.0])
def test_top_speed_follows_the_supply(share) -> None:
    """At full command the loop gives no torque at the share of the no-load speed."""
    top = share * ELEVATE.drive.no_load_speed_radps / ELEVATE.drive.gear_ratio
    assert given_torque(0.98 * top, 50.0, share=share)[0] > 0.1
    assert given_torque(1.02 * top, 50.0, share=share)[0] < 0.0


@QUICK
@given(current=st.floats(0.0, 100.0), drawn=st.floats(0.0, 2e6), ohm=st.floats(0.0, 0.1))
def test_battery_solves_its_circuit(current, drawn, ohm) -> None:
    """At the steady current the store gives the open voltage times the current: terminals and own heat."""
    p = P | {"battery_ohm": ohm}
    charge = max(0.0, 1.0 - drawn / p["battery_j"])
    open_v = p["battery_empty_v"] + (p["battery_full_v"] - p["battery_empty_v"]) * charge
    power = (open_v - ohm * current) * current
    voltage, taken, rate = (float(x) for x in battery(p, ca.DM(power), ca.DM(drawn), ca.DM(current)))
    assert voltage == pytest.approx(open_v - ohm * current, abs=5e-3)
    assert taken == pytest.approx(open_v * current, rel=1e-3, abs=1e-9)
    assert rate == pytest.approx(0.0, abs=2.0)


@QUICK
@given(power=st.floats(0.0, 1e4), current=st.floats(0.0, 1e3), ohm=st.floats(0.0, 10.0))
def test_an_overloaded_battery_neither_reverses_nor_makes_energy(power, current, ohm) -> None:
    voltage, taken, _ = (float(x) for x in battery(P | {"battery_ohm": ohm}, power, ca.DM(0.0), current))
    assert voltage >= P["battery_full_v"] / 3.0
    assert taken >= power


def test_a_battery_that_rises_as_it_empties_is_refused() -> None:
    with pytest.raises(ValueError, match=r"empty_v 24 is above full_v 22"):
        Battery(22.0, 24.0, 0.05, 480.0, 1.0)


def test_without_a_battery_the_supply_is_stiff() -> None:
    p = dict(zip(VEHICLE_PARAMETERS, vehicle_vector(fed_by(None)).tolist(), strict=True))
    voltage, taken, _ = battery(p, ca.DM(800.0), ca.DM(1e6), ca.DM(30.0))
    assert float(voltage) == pytest.approx(ELEVATE.drive.supply_v, rel=1e-6)
    assert float(taken) == 800.0


@QUICK
@given(torque=st.floats(-20.0, 20.0), speed=st.floats(-12.0, 12.0))
def test_a_gearbox_only_loses_power(torque, speed) -> None:
    current = motor_current(P, np.array(torque), np.array(speed))
    assert gear_loss(P, current, np.array(torque), np.array(speed)) >= -1e-9


@pytest.mark.parametrize(
    ("scenario", "options"),
    [
        ("paper_profile", {}),
        ("paper_profile", {"terrain": "loose_sand", "slope_deg": 5.0}),
        ("chirp", {"terrain": "asphalt", "slope_deg": 10.0}),
        ("figure_eight", {"terrain": "mud"}),
        ("spin", {"payload_kg": 20.0, "payload_at_m": (0.1, -0.05, 0.3)}),
        ("circle", {"terrain": "medium_sand", "slope_deg": 8.0, "cross_slope_deg": 6.0}),
        ("straight", {"vehicle": "husky", "slope_deg": 10.0}),
        ("straight", {"vehicle": "warthog"}),
    ],
)
def test_the_energy_balance_closes(scenario, options) -> None:
    """Battery = heat + slip + resistance + height + speed; the heat is summed apart from the states."""
    found = energy(scenario, **options)
    assert abs(found.missing_j()) < 0.01 * found.battery_j
    assert all(getattr(found, name) >= -1e-6 for name in HEAT)
    assert found.slip_j > 0.0
    assert found.resistance_j > 0.0


def test_climbing_fills_the_potential_energy_and_descending_empties_it() -> None:
    turned = dataclasses.replace(load_scenario("straight"), heading_deg=180.0)
    up, down = energy("straight", slope_deg=10.0), energy(turned, slope_deg=10.0)
    weight = ELEVATE.body.mass_kg * 9.80665 * math.sin(math.radians(10.0))
    assert up.potential_j == pytest.approx(weight * 54.0, rel=0.03)
    assert down.potential_j == pytest.approx(-weight * 54.0, rel=0.03)
    assert down.braking_heat_j > 0.0
    assert down.battery_j < 0.2 * up.battery_j


def test_wasted_work_grows_with_slip() -> None:
    firm, loose = (
        simulate_run("straight", terrain=t, slope_deg=8.0, noiseless=True).summary
        for t in ("medium_sand", "loose_sand")
    )
    assert loose.slip_work_j / loose.distance_m > 5.0 * firm.slip_work_j / firm.distance_m
    assert loose.energy_per_m_j > firm.energy_per_m_j
    assert firm.energy_j == pytest.approx(firm.heat_j + firm.motor_work_j)
    assert firm.peak_power_w > firm.mean_power_w > 0.0


def test_a_flat_battery_sags_and_slows_the_robot() -> None:
    """At the end of its charge the robot no longer reaches its top speed."""
    fast = Scenario("fast", 20.0, drive=(DriveSegment(20.0, v_mps=2.0),), route=(RouteLeg("loose_sand"),))

    def top(battery: Battery) -> float:
        return float(simulate_run(fast, vehicle=fed_by(battery), noiseless=True).states[-1, INDEX["u"]])

    full = top(Battery(25.4, 21.0, 0.05, 480.0, 1.0))
    empty = top(Battery(25.4, 21.0, 0.05, 480.0, 0.0))
    worn = top(Battery(25.4, 21.0, 0.30, 480.0, 0.0))
    assert full > 1.1 * empty
    assert empty > 1.05 * worn > 0.0


def test_a_battery_that_gives_out_does_not_make_the_step_unstable() -> None:
    """Ten times the resistance: the step of the integrator still resolves the loop of voltage and torque."""
    weak = dataclasses.replace(ELEVATE.battery, resistance_ohm=0.5)
    setup = set_up("staircase", vehicle=fed_by(weak), terrain="loose_sand", slope_deg=5.0)
    sides = delayed_inputs(np.repeat([[0.0, 0.0], [11.0, 11.0]], [100, 900], axis=0), 0.01)
    x0 = np.zeros(len(STATES))
    coarse, fine = (integrate(x0, sides, 0.01, setup.plant, substeps=n) for n in (3, 12))
    assert np.abs(coarse[-1, :6] - fine[-1, :6]).max() < 1e-3


def test_the_charge_falls_with_the_energy_drawn() -> None:
    """A tiny battery is drained within the run; its voltage, and with it the speed, ends at the empty one."""
    tiny = Battery(25.4, 12.0, 0.05, 1.0, 1.0)
    climb = simulate_run("straight", vehicle=fed_by(tiny), slope_deg=10.0, noiseless=True)
    same = simulate_run("straight", slope_deg=10.0, noiseless=True)
    drained = climb.states[:, INDEX["electric_energy"]] > 3600.0
    assert drained.any()
    assert climb.states[-500, INDEX["u"]] < 0.95 * same.states[-500, INDEX["u"]]


def test_immobilisation_tells_when_where_and_why() -> None:
    mud = simulate_run("paper_profile", terrain="mud", noiseless=True).summary
    assert mud.immobilised_cause == MOTOR_STALLED
    assert mud.immobilised_x_m == pytest.approx(mud.distance_m, rel=0.05)
    assert mud.immobilised_y_m == pytest.approx(0.0, abs=1e-6)
    free = simulate_run("straight", noiseless=True).summary
    assert (free.immobilised_at_s, free.immobilised_x_m, free.immobilised_cause) == (None, None, None)


def test_a_robot_that_is_commanded_to_creep_moves() -> None:
    crept = Scenario("rover", 150.0, drive=(DriveSegment(150.0, v_mps=0.04),))
    summary = simulate_run(crept, noiseless=True).summary
    assert summary.immobilised_at_s is None
    assert summary.distance_m == pytest.approx(6.0, rel=0.02)
    assert 0.0 < summary.mean_abs_slip < 0.05


@pytest.mark.parametrize(("wheel_radps", "cause"), [(5.0, TRACTION_LOST), (0.1, MOTOR_STALLED)])
def test_wheels_that_turn_under_a_standing_robot_have_lost_traction(wheel_radps, cause) -> None:
    setup = set_up("straight")
    states = np.zeros((len(setup.t_s), len(STATES)))
    states[:, state_slice("wheel_speed")] = wheel_radps
    driven = DrivenStates(setup.scenario.commanded(setup.t_s), np.zeros((len(states), len(INPUTS))), states)
    motion = setup.motion(driven)
    slip = slip_ratios(driven, motion, setup.vehicle, setup.plant)
    summary = summarise(driven, motion, setup.vehicle, slip)
    assert summary.immobilised_cause == cause
    assert summary.immobilised_at_s == pytest.approx(3.0)  # from its first command on


def test_the_no_load_current_flows_at_any_load_and_turns_to_heat() -> None:
    p = P | {"no_load_a": 0.5}
    speed, torque = np.array([-5.0, 0.0, 5.0]), np.zeros(3)
    current = motor_current(p, torque, speed)
    np.testing.assert_allclose(current, [-0.5, 0.0, 0.5], rtol=1e-3)
    back_emf = p["supply_v"] / p["no_load_radps"] * p["gear_ratio"] * speed
    np.testing.assert_allclose(gear_loss(p, current, torque, speed), np.abs(0.5 * back_emf), rtol=1e-3)


@pytest.mark.parametrize("ground", ["ASPHALT", "ICE"])
def test_a_husky_draws_the_current_of_the_field_logs(ground) -> None:
    """Straight on, above 0.5 m/s: the twin on asphalt within the logs' 10th and 90th percentile. Its
    no-load current is from the asphalt runs; a rink rolls as easily."""
    root = Path(os.environ.get("TERRAFUSION_DATA", "nowhere")) / "borealtc" / ground
    if not root.is_dir():
        pytest.skip("TERRAFUSION_DATA names no folder with borealtc: the field logs are not at hand")
    logs = [np.genfromtxt(path, delimiter=",", names=True) for path in sorted(root.glob("pro_*.csv"))]
    left, right, current = (np.concatenate([log[name] for log in logs]) for name in ("velL", "velR", "curL"))
    current = 0.5 * (current + np.concatenate([log["curR"] for log in logs]))
    straight = (np.abs(left - right) < 0.05) & (left > 0.5)
    low, high = np.percentile(current[straight], [10, 90])
    made = simulate_run("straight", vehicle="husky", terrain="asphalt", noiseless=True).recording.motor
    assert low < made.current_a[200:500].mean() < high


def test_a_stalled_motor_draws_its_current_limit() -> None:
    run = simulate_run("paper_profile", terrain="mud", noiseless=True)
    stuck = run.t_s > run.summary.immobilised_at_s + 20.0
    torque = run.states[stuck, state_slice("torque")]
    assert np.abs(torque).max() == pytest.approx(ELEVATE.drive.torque_limit_nm * AT_WHEEL, rel=0.02)
