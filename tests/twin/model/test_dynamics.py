"""The model keeps to physics: no slip without force, no energy from nowhere, symmetry, rest."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.twin.model.dynamics import wheel_loads
from terrafusion.twin.model.library import known_names
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import vehicle_vector
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import INDEX, STATES, VEHICLE_PARAMETERS, state_slice
from terrafusion.twin.physics.motors import motor_current
from terrafusion.twin.physics.terramechanics import WheelShape
from terrafusion.twin.physics.wheel import WheelSoil, footprint

ELEVATE = load_vehicle("elevate")
RADIUS_M = ELEVATE.wheel.radius_m
QUICK = settings(
    max_examples=15,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


def constant(left: float, right: float, seconds: float) -> np.ndarray:
    """Side speeds that rise from rest within a second and then stay."""
    ramp = np.clip(np.arange(round(seconds * 100) + 1) / 100.0, 0.0, 1.0)
    return ramp[:, None] * np.array([left, right])


def kinetic_j(x: np.ndarray) -> np.ndarray:
    """Kinetic energy (N,) of body and wheels."""
    body, wheels = ELEVATE.body, x[:, state_slice("wheel_speed")]
    u, v, r = (x[:, INDEX[name]] for name in ("u", "v", "r"))
    moving = body.mass_kg * (u**2 + v**2) + body.yaw_inertia_kgm2 * r**2
    return 0.5 * (moving + ELEVATE.wheel.inertia_kgm2 * (wheels**2).sum(axis=1))


def test_no_slip_without_force(run, frictionless) -> None:
    x = run(frictionless, constant(1.0 / RADIUS_M, 1.0 / RADIUS_M, 20.0))[-1]
    rim = x[state_slice("wheel_speed")] * RADIUS_M
    assert np.abs(rim / x[INDEX["u"]] - 1.0).max() < 1e-6


@pytest.mark.parametrize("terrain", known_names("soils"))
def test_steady_traction_meets_the_resistance(run, terrain) -> None:
    """Constant speed on the flat: the motors' power goes into slip and resistance, never below them."""
    x = run(terrain, constant(0.8 / RADIUS_M, 0.8 / RADIUS_M, 8.0))
    assert (x[-1, state_slice("wheel_speed")] * RADIUS_M >= x[-1, INDEX["u"]]).all()
    assert x[-1, state_slice("torque")].min() > 0.0


@QUICK
@given(
    terrain=st.sampled_from(known_names("soils")),
    u=st.floats(-1.5, 1.5),
    v=st.floats(-0.5, 0.5),
    r=st.floats(-1.0, 1.0),
    rims=st.tuples(*[st.floats(-1.5, 1.5)] * 4),
)
def test_energy_is_never_created(run, terrain, u, v, r, rims) -> None:
    """Work of the motors >= change of kinetic energy, whatever the start; soil springs start unloaded."""
    start = np.zeros(len(STATES))
    start[[INDEX["u"], INDEX["v"], INDEX["r"]]] = u, v, r
    start[state_slice("wheel_speed")] = np.array(rims) / RADIUS_M
    x = run(terrain, np.zeros((301, 2)), start=start)
    gained = kinetic_j(x) - kinetic_j(x)[0] - x[:, INDEX["motor_work"]]
    assert gained.max() < 1e-6
    assert (np.diff(x[:, INDEX["electric_energy"]]) >= 0.0).all()


@QUICK
@given(terrain=st.sampled_from(known_names("soils")), left=st.floats(-8.0, 8.0), right=st.floats(-8.0, 8.0))
def test_driving_costs_at_least_the_energy_gained(run, terrain, left, right) -> None:
    x = run(terrain, constant(left, right, 3.0))
    work = x[:, INDEX["motor_work"]]
    assert (kinetic_j(x) <= work + 1e-6).all()
    assert x[-1, INDEX["electric_energy"]] >= work[-1]


def test_climbing_stores_no_more_than_the_work_done(run) -> None:
    slope = np.radians(10.0)
    x = run("medium_sand", constant(1.0 / RADIUS_M, 1.0 / RADIUS_M, 10.0), slope_rad=slope)
    potential = ELEVATE.body.mass_kg * GRAVITY_MPS2 * np.sin(slope) * x[:, INDEX["x"]]
    assert (kinetic_j(x) + potential <= x[:, INDEX["motor_work"]] + 0.05).all()
    assert potential[-1] > 0.5 * x[-1, INDEX["motor_work"]]


@pytest.mark.parametrize("terrain", ["asphalt", "medium_sand", "loose_sand"])
def test_parked_robot_does_not_creep(run, terrain) -> None:
    """On 5 deg, after settling, below 0.1 mm/s."""
    x = run(terrain, np.zeros((3001, 2)), slope_rad=np.radians(5.0))
    creep = np.abs(np.diff(x[[1000, 3000], INDEX["x"]])[0]) / 20.0
    assert creep < 1e-4
    assert x[-1, INDEX["y"]] == 0.0


@pytest.mark.parametrize("terrain", known_names("soils"))
def test_mirrored_commands_give_the_mirrored_path(run, terrain) -> None:
    sides = constant(3.0, 6.0, 10.0)
    x, mirrored = run(terrain, sides), run(terrain, sides[:, ::-1])
    assert np.abs(x[:, INDEX["x"]] - mirrored[:, INDEX["x"]]).max() < 1e-9
    assert np.abs(x[:, INDEX["y"]] + mirrored[:, INDEX["y"]]).max() < 1e-9
    assert np.abs(x[:, INDEX["yaw"]] + mirrored[:, INDEX["yaw"]]).max() < 1e-9


@QUICK
@given(x=st.floats(-50, 50), y=st.floats(-50, 50), yaw=st.floats(-3, 3))
def test_flat_ground_has_no_preferred_place_or_heading(run, x, y, yaw) -> None:
    sides = constant(3.0, 5.0, 4.0)
    base = run("loose_sand", sides)[-1]
    start = np.zeros(len(STATES))
    start[:3] = x, y, yaw
    moved = run("loose_sand", sides, start=start)[-1]
    c, s = np.cos(yaw), np.sin(yaw)
    expected = [x + c * base[0] - s * base[1], y + s * base[0] + c * base[1], yaw + base[2]]
    np.testing.assert_allclose(moved[:3], expected, atol=1e-9)
    np.testing.assert_allclose(moved[3:], base[3:], atol=1e-9)


def test_skid_steering_turns_less_than_its_odometry_says(run) -> None:
    x = run("asphalt", constant(3.0, 6.0, 20.0))[-1]
    assumed = 3.0 * RADIUS_M / ELEVATE.odometry.track_m
    assert 0.2 * assumed < x[INDEX["r"]] < 0.95 * assumed


def test_states_of_absent_effects_rest_and_time_passes(run) -> None:
    x = run("medium_sand", constant(3.0, 5.0, 4.0))
    resting = [i for name, i in INDEX.items() if name.startswith(("command", "play"))]
    assert len(resting) == 8
    assert (x[:, resting] == 0.0).all()
    np.testing.assert_allclose(x[:, INDEX["elapsed"]], np.arange(len(x)) * 0.01, atol=1e-9)


def test_wheel_loads_carry_the_weight_and_lean_downhill() -> None:
    p = dict(zip(VEHICLE_PARAMETERS, vehicle_vector(ELEVATE, slope_rad=0.2).tolist(), strict=True))
    front_left, front_right, rear_left, rear_right = (
        float(load) for load in wheel_loads(p, p["gravity_x_mps2"], p["gravity_y_mps2"])
    )
    weight = ELEVATE.body.mass_kg * GRAVITY_MPS2 * np.cos(0.2)
    assert front_left + front_right + rear_left + rear_right == pytest.approx(weight, rel=1e-3)
    assert front_left == pytest.approx(front_right)
    moment = (rear_left - front_left) * ELEVATE.body.wheelbase_m
    expected = ELEVATE.body.mass_kg * GRAVITY_MPS2 * np.sin(0.2) * ELEVATE.body.cg_height_m
    assert moment == pytest.approx(expected, rel=1e-3)


def test_sinkage_is_bekkers_where_nothing_saturates() -> None:
    soil = load_soil("loose_sand")
    k_c, k_phi, n = soil.pressure.k_c_n_per_m_n1, soil.pressure.k_phi_n_per_m_n2, soil.pressure.exponent
    ground = WheelSoil(k_c, k_phi, n, *[0.0] * 18)
    bekker = (3 * 78.5 / ((3 - n) * (k_c + 0.145 * k_phi) * np.sqrt(0.35))) ** (2 / (2 * n + 1))
    z = footprint(ground, 78.5, 1.0, (1.0, 0.0), 0.0, WheelShape(0.175, 0.145)).sinkage_m
    assert float(z) == pytest.approx(bekker, rel=1e-4)


def test_gearbox_takes_power_both_ways() -> None:
    p = dict(zip(VEHICLE_PARAMETERS, vehicle_vector(ELEVATE).tolist(), strict=True))
    k_t = ELEVATE.drive.supply_v / ELEVATE.drive.no_load_speed_radps
    driving, braking = (motor_current(p, np.array(tau), 8.0) for tau in (5.0, -5.0))
    assert driving == pytest.approx(5.0 / (107.2 * 0.75 * k_t), rel=1e-3)
    assert braking == pytest.approx(-5.0 * 0.75 / (107.2 * k_t), rel=1e-3)
