"""Steered drives of the twin: the kinematic limit, symmetry, energy, limits of the steering, the log."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Overrides
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.writers import write_log_folder
from terrafusion.twin.calibrate.inputs import twin_input
from terrafusion.twin.engine.lanes import integrate_many
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle, with_overrides
from terrafusion.twin.physics.layout import INDEX, INPUTS, WHEELS, state_slice
from terrafusion.twin.run_setup import set_up
from terrafusion.twin.scenario.commands import open_loop, steering_angles
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate, simulate_run
from tests.twin.energy_balance import energy_of

STEERED = ("ackermann", "four_wheel_steer")
FRONT = INPUTS.index("steer_front_rad")


def steered(drive: str) -> VehicleParams:
    return with_overrides(load_vehicle("elevate"), Overrides(drive=drive))


def bend(v: float, curvature: float, seconds: float = 10.0, terrain: str = "asphalt") -> Scenario:
    segment = DriveSegment(seconds, v_mps=v, curvature_per_m=curvature)
    return Scenario("bend", seconds - 0.01, drive=(segment,), route=(RouteLeg(terrain),))


@pytest.mark.parametrize("drive", STEERED)
@pytest.mark.parametrize("angle_rad", [0.1, -0.4])
@pytest.mark.parametrize("v", [0.3, -0.3])
def test_the_kinematic_limit_on_firm_ground(drive: str, angle_rad: float, v: float) -> None:
    """Yaw rate = v (tan front - tan rear) / wheelbase; rear axle, or the middle, has no side-slip."""
    vehicle, ends = steered(drive), 2 if drive == "four_wheel_steer" else 1
    length = vehicle.body.wheelbase_m
    curvature = ends * np.tan(angle_rad) / length
    run = simulate_run(bend(v, curvature), vehicle=vehicle, noiseless=True)
    assert run.recording.truth is not None
    assert run.recording.truth.twist_body is not None
    u, side, rate = run.recording.truth.twist_body[-200:, [0, 1, 5]].mean(axis=0)
    assert u == pytest.approx(v, rel=0.02)
    assert rate == pytest.approx(u * curvature, rel=0.02)
    rear = side - rate * 0.5 * length
    assert (rear if ends == 1 else side) == pytest.approx(0.0, abs=0.02 * abs(v))
    assert np.abs(run.slip[-200:]).max() < 0.02


@pytest.mark.parametrize("drive", STEERED)
@pytest.mark.parametrize("terrain", ["asphalt", "loose_sand"])
def test_mirrored_commands_mirror_the_drive(drive: str, terrain: str) -> None:
    runs = [
        simulate_run(bend(0.8, k, 6.0, terrain), vehicle=steered(drive), noiseless=True).states
        for k in (0.6, -0.6)
    ]
    other = runs[1].copy()
    for name in ("y", "yaw", "v", "r", *(f"shear_y_{w}" for w in WHEELS)):
        other[:, INDEX[name]] *= -1.0
    for prefix in ("wheel_speed", "shear_x", "shear_y", "torque", "speed_error", "brake", "wheel_angle"):
        part = state_slice(prefix)
        other[:, part] = other[:, part][:, [1, 0, 3, 2]]
    np.testing.assert_allclose(other, runs[0], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("drive", STEERED)
@pytest.mark.parametrize("terrain", ["asphalt", "loose_sand", "grass"])
def test_energy_is_never_created(drive: str, terrain: str) -> None:
    """The motors' work is in speed, slip and resistance; neither of the latter gives back over a second."""
    wave = DriveSegment(12.0, v_mps=0.7, yaw_rate_amplitude_radps=0.8, period_s=3.0)
    scenario = Scenario("wave", 11.9, drive=(wave,), route=(RouteLeg(terrain),))
    setup = set_up(scenario, vehicle=steered(drive))
    states = setup.drive().states
    energy = energy_of(setup.t_s, states, setup.plant.vehicle)
    assert abs(energy.missing_j()) < 0.005 * energy.battery_j
    for name in ("slip_work", "resistance_work"):
        spent = states[::100, INDEX[name]]
        assert np.diff(spent).min() > -1e-3 * spent[-1]


@pytest.mark.parametrize("drive", STEERED)
def test_a_coasting_robot_loses_speed_in_a_bend(drive: str) -> None:
    """Without torque the kinetic energy falls, whatever the steering does."""
    vehicle = steered(drive)
    setup = set_up(bend(1.0, 0.5, 4.0), vehicle=vehicle)
    inputs = setup.drive().inputs
    start = setup.drive().states[-1]
    plant = dataclasses.replace(setup.plant, vehicle=setup.plant.vehicle.copy())
    from terrafusion.twin.engine.integrate import integrate
    from terrafusion.twin.physics.layout import VEHICLE_PARAMETERS

    for name in ("stall_torque_nm", "torque_limit_nm"):
        plant.vehicle[VEHICLE_PARAMETERS.index(name)] = 1e-9
    start = start.copy()
    start[state_slice("torque")] = 0.0
    turning = inputs[-200:].copy()
    turning[:, FRONT] = 0.5 * np.sin(0.1 * np.arange(200))
    states = integrate(start, turning, 0.01, plant)
    p = dict(zip(VEHICLE_PARAMETERS, plant.vehicle.tolist(), strict=True))
    body = p["mass_kg"] * (states[:, INDEX["u"]] ** 2 + states[:, INDEX["v"]] ** 2)
    body += p["yaw_inertia_kgm2"] * states[:, INDEX["r"]] ** 2
    wheels = p["wheel_inertia_kgm2"] * (states[:, state_slice("wheel_speed")] ** 2).sum(axis=1)
    kinetic = 0.5 * (body + wheels)
    assert kinetic[-1] < 0.9 * kinetic[0]
    assert kinetic.max() <= kinetic[0] * 1.001


@pytest.mark.parametrize("drive", STEERED)
def test_backends_and_lanes_agree(drive: str) -> None:
    setup = set_up(bend(0.8, 0.5, 3.0, "grass"), vehicle=steered(drive))
    fast, slow = setup.drive("auto"), setup.drive("vm")
    np.testing.assert_allclose(fast.states, slow.states, rtol=1e-6, atol=1e-8)
    many = integrate_many(
        np.stack([fast.states[0]] * 3), np.stack([fast.inputs] * 3), 0.01, [setup.plant] * 3
    )
    for states in many:
        np.testing.assert_allclose(states, fast.states, rtol=1e-6, atol=1e-8)


def test_the_angle_follows_within_its_limits() -> None:
    vehicle = steered("ackermann")
    spec, length = vehicle.steered(), vehicle.body.wheelbase_m
    assert spec is not None
    twist = np.tile([1.0, 50.0], (400, 1))
    twist[200:] = [1.0, 0.0]
    angle = steering_angles(twist, 0.01, vehicle)
    assert np.abs(np.diff(angle, prepend=0.0)).max() <= spec.max_rate_radps * 0.01 + 1e-12
    assert angle.max() <= spec.max_angle_rad + 1e-12
    assert np.tan(angle.max()) / length * vehicle.body.track_m <= 1.6 + 1e-9
    assert angle[-1] == 0.0
    held = steering_angles(np.array([[1.0, 0.2], [0.0, 0.9]]), 10.0, vehicle)
    assert held[1] == held[0]  # a car cannot turn on the spot


@pytest.mark.parametrize("drive", STEERED)
def test_a_car_that_sets_off_or_brakes_keeps_to_its_curve(drive: str) -> None:
    """The speed follows slowly, the curvature is the commanded one from the start to the end."""
    vehicle = steered(drive)
    slow = dataclasses.replace(vehicle, drive=dataclasses.replace(vehicle.drive, max_accel_mps2=0.3))
    segments = (DriveSegment(6.0, v_mps=1.0, yaw_rate_radps=0.2), DriveSegment(4.0))
    scenario = Scenario("start", 10.0, drive=segments, route=(RouteLeg("asphalt"),))
    states = simulate_run(scenario, vehicle=slow, noiseless=True).states
    assert states[-1, INDEX["yaw"]] == pytest.approx(0.2 * states[-1, INDEX["travel"]], rel=0.03)


def test_the_log_of_a_steered_drive(tmp_path: Path) -> None:
    """steering.csv holds the angle, with noise, scale and zero of the vehicle; other drives have none."""
    assert simulate(bend(0.8, 0.3, 3.0)).steering is None
    exact, noisy = (
        simulate(bend(0.8, 0.3, 5.0), vehicle=steered("ackermann"), noiseless=exact, seed=4)
        for exact in (True, False)
    )
    assert exact.steering is not None
    assert noisy.steering is not None
    assert exact.steering.names == ("angle",)
    assert exact.steering.angle_rad[-1, 0] == pytest.approx(np.arctan(0.3 * 0.42), rel=0.01)
    off = noisy.steering.angle_rad[-20:] - exact.steering.angle_rad[-20:]
    assert 1e-4 < np.abs(off).mean() < 0.1
    folder = write_log_folder(noisy, tmp_path / "log")
    assert (folder / "steering.csv").is_file()
    back = open_recording(folder)
    assert back.steering is not None
    np.testing.assert_array_equal(back.steering.angle_rad, noisy.steering.angle_rad)
    both = simulate(bend(0.8, 0.3, 2.0), vehicle=steered("four_wheel_steer"), noiseless=True).steering
    assert both is not None
    assert both.names == ("front", "rear")
    np.testing.assert_allclose(both.angle_rad[:, 0], -both.angle_rad[:, 1])


def test_effects_act_on_a_steered_robot() -> None:
    plain = simulate_run(bend(0.8, 0.3, 6.0), vehicle=steered("ackermann"), noiseless=True).states
    pulled = simulate_run(
        bend(0.8, 0.3, 6.0), vehicle=steered("ackermann"), noiseless=True, effects={"slope": 0.1}
    ).states
    assert np.abs(pulled[-1, :2] - plain[-1, :2]).max() > 0.01


def test_waypoints_are_reached() -> None:
    points = ((4.0, 0.0), (6.0, 3.0), (0.0, 4.0))
    scenario = Scenario("round", 30.0, waypoints=points, waypoint_speed_mps=0.6)
    states = simulate_run(scenario, vehicle=steered("ackermann"), noiseless=True).states
    for point in points:
        assert np.hypot(*(states[:, :2] - point).T).min() < 0.6


def test_many_runs_drive_as_one() -> None:
    from terrafusion.twin.sweep.rows import drive_many

    setups = [set_up(bend(0.5, k, 3.0), vehicle=steered("ackermann")) for k in (0.1, 0.4)]
    for setup, driven in zip(setups, drive_many(setups), strict=True):
        assert not isinstance(driven, Exception)
        np.testing.assert_allclose(driven.states, setup.drive().states, rtol=1e-9, atol=1e-9)
        assert driven.inputs[-1, FRONT] == open_loop(setup.scenario, setup.t_s, setup.vehicle)[1][-1, FRONT]


def test_the_twin_is_not_held_against_logs_of_steered_robots() -> None:
    vehicle = steered("ackermann")
    with pytest.raises(DataError, match="drive type ackermann"):
        twin_input(simulate(bend(0.8, 0.3, 3.0), vehicle=vehicle), vehicle, "auto")
