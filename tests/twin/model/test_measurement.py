"""The measurement graph: it reads what noiseless sensors read, and its derivatives are right."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.twin.model.measurement import corrections, measured, measured_jacobians
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import mounting_vector, soil_vector, vehicle_vector
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle
from terrafusion.twin.physics.layout import INDEX, INPUTS, OUTPUTS, SOIL_PARAMETERS, STATES
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import SimulatedRun, simulate_run

SLOPE_DEG, ASPECT_DEG = 8.0, 35.0
Y = {name: i for i, name in enumerate(OUTPUTS)}


def off_centre() -> VehicleParams:
    """The nominal robot with every lever arm and offset different from zero."""
    vehicle = load_vehicle("elevate")
    imu = dataclasses.replace(vehicle.sensors.imu, position_m=(0.12, -0.07, 0.2))
    gnss = dataclasses.replace(vehicle.sensors.gnss, antenna_m=(-0.15, 0.1, 0.4))
    body = dataclasses.replace(vehicle.body, cg_forward_m=0.03, cg_left_m=-0.02)
    sensors = dataclasses.replace(vehicle.sensors, imu=imu, gnss=gnss)
    return dataclasses.replace(vehicle, body=body, sensors=sensors)


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    """40 s of turns on a slope that faces askew, with exact sensors."""
    plan = dataclasses.replace(load_scenario("figure_eight"), duration_s=40.0, aspect_deg=ASPECT_DEG)
    return simulate_run(
        plan, vehicle=off_centre(), terrain="medium_sand", slope_deg=SLOPE_DEG, noiseless=True
    )


@pytest.fixture(scope="module")
def known(run) -> tuple[np.ndarray, ...]:
    """States, inputs and parameters of the run; no output depends on the inputs at once."""
    slope, aspect = np.radians(SLOPE_DEG), np.radians(ASPECT_DEG)
    return (
        run.states,
        np.zeros((len(run.states), len(INPUTS))),
        vehicle_vector(off_centre(), slope_rad=slope, aspect_rad=aspect),
        np.tile(soil_vector(load_soil("medium_sand")), 4),
        mounting_vector(off_centre()),
    )


@pytest.fixture(scope="module")
def y(known) -> np.ndarray:
    return measured(*known)


def columns(y: np.ndarray, *names: str) -> np.ndarray:
    return y[:, [Y[name] for name in names]]


def test_antenna_reads_as_the_noiseless_receiver(run, y) -> None:
    gnss = run.recording.gnss
    rows = np.searchsorted(run.recording.truth.t_ns, gnss.t_ns)
    position = columns(y, "gnss_east_m", "gnss_north_m")[rows]
    velocity = columns(y, "gnss_v_e_mps", "gnss_v_n_mps")[rows]
    np.testing.assert_allclose(position, gnss.enu_m[:, :2], atol=1e-9)
    np.testing.assert_allclose(velocity, gnss.velocity_enu_mps[:, :2], atol=1e-9)


def test_body_velocity_and_current_read_as_the_truth(run, y) -> None:
    np.testing.assert_allclose(
        columns(y, "speed_mps", "side_speed_mps"), run.recording.truth.twist_body[:, :2], atol=1e-12
    )
    motor = run.recording.motor
    rows = np.searchsorted(run.recording.truth.t_ns, motor.t_ns)
    current = columns(y, "current_left_a", "current_right_a")[rows]
    np.testing.assert_allclose(current, motor.current_a, atol=1e-9)


def test_means_over_intervals_are_those_of_the_noiseless_imu_and_encoders(run, y) -> None:
    """Sums over half a second: both integrate the same motion, one by trapezoids at 100 Hz."""
    imu, block = run.recording.imu, 50
    rates = columns(y, "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2")
    trapezoid = 0.5 * (rates[1:] + rates[:-1])[: len(imu.t_ns) // block * block]
    read = np.column_stack([imu.gyro_radps[:, 2], imu.accel_mps2[:, :2]])[: len(trapezoid)]
    means = [a.reshape(-1, block, 3).mean(axis=1) for a in (trapezoid, read)]
    assert np.abs(means[0] - means[1])[:, 0].max() < 1e-5
    assert np.abs(means[0] - means[1])[:, 1:].max() < 2e-2
    assert np.ptp(means[1], axis=0).min() > 0.3
    speed = columns(y, "wheel_left_radps", "wheel_right_radps")
    angle = np.stack([run.recording.wheels.angle_rad[:, i::2].mean(axis=1) for i in (0, 1)], axis=1)
    turned = np.cumsum(0.5 * (speed[1:] + speed[:-1]), axis=0)[1::2] * 0.01
    np.testing.assert_allclose(turned, angle[1:], atol=2e-3)


def test_no_output_depends_on_the_inputs_at_once(known, y) -> None:
    states, inputs, *others = known
    rng = np.random.default_rng(0)
    assert np.array_equal(measured(states, rng.normal(size=inputs.shape), *others), y)


def test_many_samples_are_the_single_ones_and_take_a_soil_each(known, y) -> None:
    states, inputs, vehicle, soil, mounting = known
    one = measured(states[700:701], inputs[700:701], vehicle, soil, mounting)
    assert np.array_equal(one[0], y[700])
    soft = np.tile(soil_vector(load_soil("loose_sand")), 4)
    mixed = np.array([soil, soft, soil])
    rows = measured(states[700:703], inputs[700:703], vehicle, mixed, mounting)
    assert np.array_equal(rows[[0, 2]], y[[700, 702]])
    assert not np.array_equal(rows[1], y[701])


def test_imu_reads_nothing_in_free_fall_and_gravity_when_held() -> None:
    """10 deg uphill along x, heading across: gravity pulls the body to its right."""
    vehicle, soil = load_vehicle("elevate"), np.tile(soil_vector(load_soil("asphalt")), 4)
    slope = np.radians(10.0)
    x = np.zeros((1, len(STATES)))
    x[0, INDEX["yaw"]] = -np.pi / 2.0  # an unloaded spring under each wheel: nothing holds the robot yet
    parked = Scenario(
        "parked", 5.0, drive=(DriveSegment(5.0),), heading_deg=-90.0, route=(RouteLeg("asphalt"),)
    )
    settled = simulate_run(parked, slope_deg=10.0, noiseless=True).states[-1:]
    falls, stands = (
        columns(
            measured(
                state, np.zeros((1, len(INPUTS))), vehicle_vector(vehicle, slope_rad=slope), soil, np.zeros(5)
            ),
            "accel_x_mps2",
            "accel_y_mps2",
        )[0]
        for state in (x, settled)
    )
    np.testing.assert_allclose(falls, 0.0, atol=1e-12)
    np.testing.assert_allclose(stands, [0.0, GRAVITY_MPS2 * np.sin(slope)], atol=1e-4)


def test_jacobians_meet_finite_differences(known) -> None:
    """Central differences along random directions of each argument, at samples all over the run."""
    rows = slice(500, 3500, 499)
    states, inputs, vehicle, soil, mounting = known
    at = (states[rows], inputs[rows])
    jacobians = measured_jacobians(*at, vehicle, soil, mounting)
    assert jacobians.soil.shape == (len(at[0]), len(OUTPUTS), 4 * len(SOIL_PARAMETERS))
    rng = np.random.default_rng(1)
    for k, base, jacobian in (
        (0, at[0], jacobians.states),
        (2, vehicle, jacobians.vehicle),
        (3, soil, jacobians.soil),
    ):
        scale = np.maximum(np.abs(base), 1e-3 if k else 1e-2)
        way = rng.normal(size=base.shape) * scale
        arguments = [*at, vehicle, soil, mounting]
        ends = []
        for step in (1e-6, -1e-6):
            arguments[k] = base + step * way
            ends.append(measured(*arguments))
        expected = (ends[0] - ends[1]) / 2e-6
        got = np.einsum("nyx,nx->ny", jacobian, np.broadcast_to(way, (len(at[0]), base.shape[-1])))
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


def test_without_effects_there_is_nothing_to_correct(known) -> None:
    states, inputs, *others = known
    assert (corrections(states[::100], inputs[::100], *others, {}) == 0.0).all()
