"""Effects in a simulated recording: each sensor shows what it should, the others stay as they are."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.cli.main import app
from terrafusion.fusion.cli.simulate import effect_lines, effect_values
from terrafusion.twin.effects import catalogue
from terrafusion.twin.effects.form import Form, Parameter, one
from terrafusion.twin.model.ground import Variation, under_wheels
from terrafusion.twin.model.measurement import measured
from terrafusion.twin.model.vectors import mounting_vector
from terrafusion.twin.physics.layout import OUTPUTS
from terrafusion.twin.run_setup import set_up
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.simulate import simulate, simulate_run

DOCS = Path(__file__).parents[3] / "docs" / "reference" / "effects.md"
SHORT = dataclasses.replace(load_scenario("figure_eight"), duration_s=20.0)


def same(a: Recording, b: Recording, *names: str) -> bool:
    """Whether the channels are equal bit for bit."""
    for name in names:
        one_, other = getattr(a, name), getattr(b, name)
        for key, column in {"t_ns": one_.t_ns, **one_.columns()}.items():
            if not np.array_equal(column, {"t_ns": other.t_ns, **other.columns()}[key]):
                return False
    return True


@pytest.fixture(scope="module")
def noisy() -> Recording:
    return simulate(SHORT, seed=3)


def test_effects_of_value_zero_leave_every_bit(noisy) -> None:
    zero = simulate(SHORT, seed=3, effects=dict.fromkeys(catalogue.parameters(), 0.0))
    assert same(noisy, zero, "wheels", "imu", "gnss", "motor", "command")
    assert np.array_equal(noisy.truth.position_m, zero.truth.position_m)
    assert noisy.description == zero.description


def test_a_gyro_effect_is_added_to_the_gyro_alone(noisy) -> None:
    biased = simulate(SHORT, seed=3, effects={"gyro_bias/constant": 0.01})
    added = biased.imu.gyro_radps - noisy.imu.gyro_radps
    np.testing.assert_allclose(added, [[0.0, 0.0, 0.01]] * len(added), atol=1e-12)
    assert np.array_equal(biased.imu.accel_mps2, noisy.imu.accel_mps2)
    assert same(noisy, biased, "wheels", "gnss", "motor")
    assert np.array_equal(noisy.truth.position_m, biased.truth.position_m)
    assert "gyro_bias/constant = 0.01" in biased.description


def test_encoders_count_and_report_the_same_scale(noisy) -> None:
    wrong = simulate(SHORT, seed=3, effects={"encoder_scale/reading": 0.05})
    turned, read = noisy.wheels.angle_rad[-1], wrong.wheels.angle_rad[-1]
    np.testing.assert_allclose(read, 1.05 * turned, rtol=2e-3)
    dt = np.diff(wrong.wheels.t_ns)[:, None] * 1e-9
    exact = simulate(SHORT, noiseless=True, effects={"encoder_scale/reading": 0.05}).wheels
    np.testing.assert_allclose(exact.speed[1:], np.diff(exact.angle_rad, axis=0) / dt, atol=1e-9)
    assert same(noisy, wrong, "imu", "gnss", "motor")


def test_delays_of_a_whole_sensor_shift_its_stamps(noisy) -> None:
    late = simulate(SHORT, seed=3, effects={"imu_time_offset/shift": 0.02, "gnss_latency/both": 0.25})
    assert (late.imu.t_ns - noisy.imu.t_ns == 20_000_000).all()
    assert (late.gnss.t_ns - noisy.gnss.t_ns == 250_000_000).all()
    assert np.array_equal(late.imu.accel_mps2, noisy.imu.accel_mps2)
    assert np.array_equal(late.gnss.enu_m, noisy.gnss.enu_m)


def test_a_late_gnss_velocity_is_the_velocity_of_before() -> None:
    now = simulate(SHORT, noiseless=True).gnss.velocity_enu_mps
    late = simulate(SHORT, noiseless=True, effects={"gnss_latency/velocity": 0.2}).gnss.velocity_enu_mps
    change = np.abs(late[1:, :2] - now[1:, :2]).mean()
    assert np.abs(late[1:, :2] - now[:-1, :2]).mean() < 0.2 * change
    long = simulate(SHORT, noiseless=True, effects={"gnss_latency/velocity": 1.0}).gnss.velocity_enu_mps
    np.testing.assert_allclose(long[5:, :2], now[:-5, :2], atol=1e-6)  # of any length


def test_the_stamps_of_a_clock_that_runs_slow_are_later_and_later(noisy) -> None:
    late = simulate(SHORT, seed=3, effects={"imu_time_offset/drift": 0.3})
    elapsed_ns = noisy.imu.t_ns - noisy.start_ns
    np.testing.assert_allclose(late.imu.t_ns - noisy.imu.t_ns, 0.3 / 60.0 * elapsed_ns, atol=1.0)
    assert np.array_equal(late.imu.gyro_radps, noisy.imu.gyro_radps)


def test_the_antenna_reads_from_where_it_really_is() -> None:
    recording = simulate(SHORT, noiseless=True, effects={"gnss_lever_arm/offset/y": 0.2})
    x, y, z = set_up(SHORT).vehicle.sensors.gnss.antenna_m
    expected = recording.truth.points_at(recording.gnss.t_ns, (x, y + 0.2, z))
    np.testing.assert_allclose(recording.gnss.enu_m, expected, atol=1e-9)


@pytest.mark.parametrize(
    "effects", [{"cg_lateral/shift": 0.05}, {"cg_longitudinal/shift": -0.04}, {"wheel_radius/scale": 0.1}]
)
def test_the_truth_of_a_robot_with_effects_is_one_motion(effects) -> None:
    """Body velocities, turned into the world, are the derivative of the positions."""
    truth = simulate(SHORT, noiseless=True, effects=effects).truth
    yaw = 2.0 * np.arctan2(truth.quaternion[:, 2], truth.quaternion[:, 3])
    u, v = truth.twist_body[:, 0], truth.twist_body[:, 1]
    world = np.stack([np.cos(yaw) * u - np.sin(yaw) * v, np.sin(yaw) * u + np.cos(yaw) * v], axis=1)
    moved = np.diff(truth.position_m[:, :2], axis=0) * 100.0
    assert np.abs(moved - 0.5 * (world[1:] + world[:-1])).max() < 2e-3


def test_a_slope_nobody_knows_of_shows_in_the_accelerometer() -> None:
    parked = dataclasses.replace(SHORT, drive=(), stops=(), duration_s=5.0)
    accel = simulate(parked, noiseless=True, effects={"slope/uniform": 0.1}).imu.accel_mps2[-1]
    assert accel[0] == pytest.approx(GRAVITY_MPS2 * np.sin(0.1), abs=1e-3)


def test_dead_time_reaches_the_driver_once() -> None:
    effect = simulate_run(SHORT, noiseless=True, effects={"dead_time/transport": 0.08}).states
    elevate = set_up(SHORT).vehicle
    slow = dataclasses.replace(elevate, drive=dataclasses.replace(elevate.drive, dead_time_s=0.08))
    np.testing.assert_allclose(effect, simulate_run(SHORT, vehicle=slow, noiseless=True).states, atol=1e-9)


def test_ground_under_the_wheels_is_that_of_the_integrator() -> None:
    """On patchy ground that changes on the way, the graph's accelerations are those driven."""
    varied = dataclasses.replace(
        load_scenario("mixed_terrain"), duration_s=40.0, variation=Variation(0.4, 1.0)
    )
    setup = set_up(varied, seed=2)
    driven = setup.drive()
    ground = under_wheels(setup.plant.route, setup.plant.vehicle, setup.t_s, driven.states)
    assert np.ptp(ground, axis=0).max() > 0.0
    mounting = mounting_vector(setup.vehicle)
    y = measured(driven.states, driven.inputs, setup.plant.vehicle, ground, mounting)
    even = measured(driven.states, driven.inputs, setup.plant.vehicle, ground[0], mounting)
    imu = simulate(varied, seed=2, noiseless=True).imu.accel_mps2[:, :2]
    accel = [OUTPUTS.index(name) for name in ("accel_x_mps2", "accel_y_mps2")]
    error, naive = (np.abs(0.5 * (a[1:, accel] + a[:-1, accel]) - imu).mean() for a in (y, even))
    assert error < 0.01
    assert naive > 5.0 * error


@pytest.mark.parametrize(
    ("effects", "said"),
    [
        ({"wheel_radus/scale": 0.1}, "did you mean wheel_radius/scale"),
        ({"wheel_radius/size": 0.1}, "did you mean wheel_radius/scale or wheel_radius/build_up"),
        ({"gnss": 1.0}, "did you mean gnss_"),
        ({"wheel_radius/scale": 0.5}, "give -0.3 to 0.3"),
        ({"gyro_bias/constant": float("nan")}, "give -0.2 to 0.2 rad/s"),
    ],
)
def test_wrong_effects_are_reported(effects, said) -> None:
    with pytest.raises(ConfigError, match=re.escape(said)):
        simulate(SHORT, effects=effects)


def test_words_of_the_command_line() -> None:
    assert effect_values(["mass/at_cg=0.1", "gyro_bias/constant=-1e-3"]) == {
        "mass/at_cg": 0.1,
        "gyro_bias/constant": -1e-3,
    }
    listed = CliRunner().invoke(app, ["simulate", "spin", "--effect", "help"])
    assert listed.exit_code == 0
    assert listed.output.splitlines() == [line.rstrip() for line in effect_lines()]
    assert len(effect_lines()) == 1 + len(catalogue.parameters())
    for words in (["mass/at_cg"], ["mass/at_cg=much"], ["mass/at_cg=1", "mass/at_cg=2"]):
        with pytest.raises(typer.BadParameter):
            effect_values(words)


def test_an_own_effect_of_the_docs_takes_part_in_everything() -> None:
    """The example of docs/reference/effects.md, as it stands there."""
    block = next(b for b in re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.S) if "register" in b)
    exec(block, {})
    key = "trailer/drag"
    assert key in catalogue.parameters()
    assert catalogue.effect_names()[-1] == "trailer"
    pulling, free = simulate_run(SHORT, effects={key: 30.0}), simulate_run(SHORT)
    assert pulling.summary.energy_j > 1.1 * free.summary.energy_j
    with pytest.raises(ConfigError, match="exists already"):
        exec(block, {})
    with pytest.raises(ConfigError, match="out of range"):
        simulate(SHORT, effects={key: -1.0})


def test_forms_that_cannot_work_are_refused() -> None:
    with pytest.raises(ConfigError, match="unknown stage 'tyre'"):
        Form("own", "a", one("", 1.0, 0.0, 1.0), {"tyre": lambda q, e: {}}, "")
    with pytest.raises(ConfigError, match="hold zero"):
        Form("own", "b", one("", 1.0, 1.0, 2.0), {"body": lambda q, e: {}}, "")
    twice = Parameter("", 1.0, 0.0, 1.0, "x")
    with pytest.raises(ConfigError, match="one name"):
        catalogue.register(Form("own", "c", (twice, twice), {"body": lambda q, x, y: {}}, ""))
    astray = Form("own", "d", one("", 1.0, 0.0, 1.0), {"body": lambda q, e: {"mass_kg": e}}, "")
    catalogue.register(astray)
    with pytest.raises(ConfigError, match=r"own/d: sets mass_kg in the stage 'body'"):
        simulate(SHORT, effects={"own/d": 0.5})
