"""Effects on a drive: signs and sizes, no energy from nowhere, and forms that can be distinguished."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.twin.engine.integrate import integrate
from terrafusion.twin.engine.sensitivity import Directions, integrate_with_sensitivity
from terrafusion.twin.model.dynamics import rhs
from terrafusion.twin.physics.layout import (
    INDEX,
    INPUTS,
    OUTPUTS,
    SOIL_PARAMETERS,
    STATES,
    VEHICLE_PARAMETERS,
    state_slice,
)
from terrafusion.twin.scenario.commands import delayed_inputs
from tests.twin.effects.effect_cases import (
    DT_S,
    ELEVATE,
    FORMS,
    RADIUS_M,
    at,
    derivatives,
    drive,
    exciting,
    plant,
    samples,
    soil,
)

Y = {name: i for i, name in enumerate(OUTPUTS)}
SIGMAS = {
    "radps": 0.05, "yaw_rate_radps": 0.003, "mps2": 0.1, "m": 0.03, "mps": 0.05, "a": 0.3,
}  # fmt: skip
"""Typical noise by unit, to weigh channels against each other."""
BODY = ("u", "v", "r")
PASSIVE = (
    "motion_resistance/rolling", "motion_resistance/ploughing", "motion_resistance/viscous",
    "mud_adhesion/suction", "mud_adhesion/build_up", "drivetrain_friction/coulomb",
    "drivetrain_friction/viscous", "backlash/torque_gap", "aerodynamic_drag/still_air",
    "lateral_anisotropy/strength", "rate_dependent_shear/logarithmic", "soil_strength/shear",
)  # fmt: skip
"""Forms that can only take energy out of the robot."""


DRAGGING = (
    "motion_resistance/ploughing", "motion_resistance/viscous", "mud_adhesion/build_up",
    "drivetrain_friction/coulomb", "drivetrain_friction/viscous", "aerodynamic_drag/still_air",
    "backlash/torque_gap",
)  # fmt: skip
"""Of these, the forms without a memory: they take power at every instant."""


def ramped(left_mps: float, right_mps: float, seconds: float = 8.0) -> np.ndarray:
    """Side speeds (N, 2), rad/s, that rise from rest within a second."""
    ramp = np.clip(np.arange(round(seconds / DT_S) + 1) * DT_S, 0.0, 1.0)
    return ramp[:, None] * np.array([left_mps, right_mps]) / RADIUS_M


DRIVES = {
    "straight": ramped(0.8, 0.8),
    "turn": ramped(0.5, 0.9),
    "fast": ramped(1.9, 1.9),
    "reverse": ramped(-0.8, -0.8),
    "step": np.repeat([[0.0, 0.0], [9.0, 9.0]], [50, 150], axis=0),
}


@functools.cache
def plain(name: str, terrain: str) -> tuple[np.ndarray, ...]:
    return drive({}, DRIVES[name], terrain)


SIGNS = [
    ("soil_strength/shear", "straight", "speed_mps", 1.0),
    ("soil_strength/bearing", "straight", "current_left_a", -1.0),
    ("slip_sinkage/linear", "straight", "current_left_a", 1.0),
    ("slip_sinkage/exponent", "straight", "current_left_a", 1.0),
    ("rate_dependent_shear/logarithmic", "turn", "current_right_a", 1.0),
    ("rate_dependent_shear/linear", "turn", "current_right_a", 1.0),
    ("motion_resistance/rolling", "straight", "current_left_a", 1.0),
    ("motion_resistance/ploughing", "straight", "current_left_a", 1.0),
    ("motion_resistance/viscous", "straight", "current_left_a", 1.0),
    ("motion_resistance/viscous", "reverse", "current_left_a", -1.0),
    ("grousers/track_law", "straight", "speed_mps", 1.0),
    ("grousers/passive_pressure", "straight", "speed_mps", 1.0),
    ("soil_drift/over_travel", "straight", "speed_mps", 1.0),
    ("soil_drift/over_place", "straight", "speed_mps", 1.0),
    ("soil_drift/over_time", "straight", "speed_mps", 1.0),
    ("multipass_compaction/rut", "straight", "current_left_a", -1.0),
    ("multipass_compaction/stiffening", "straight", "current_left_a", -1.0),
    ("mud_adhesion/suction", "straight", "current_left_a", 1.0),
    ("mud_adhesion/build_up", "straight", "current_left_a", 1.0),
    ("lateral_anisotropy/strength", "turn", "yaw_rate_radps", -1.0),
    ("left_right_friction/sides", "straight", "yaw_rate_radps", -1.0),
    ("left_right_friction/lane", "straight", "yaw_rate_radps", -1.0),
    ("mass/at_cg", "straight", "current_left_a", 1.0),
    ("mass/rear_axle", "straight", "current_left_a", 1.0),
    ("cg_lateral/shift", "straight", "current_left_a", 1.0),
    ("cg_lateral/shift", "straight", "current_right_a", -1.0),
    ("cg_longitudinal/shift", "turn", "side_speed_mps", -1.0),
    ("cg_lateral/transfer", "turn", "current_right_a", 1.0),
    ("wheel_radius/scale", "straight", "speed_mps", 1.0),
    ("wheel_radius/build_up", "straight", "speed_mps", 1.0),
    ("wheel_radius_asymmetry/sides", "straight", "yaw_rate_radps", -1.0),
    ("wheel_radius_asymmetry/one_wheel", "straight", "yaw_rate_radps", -1.0),
    ("wheel_radius_asymmetry/left", "straight", "yaw_rate_radps", -1.0),
    ("wheel_radius_asymmetry/right", "straight", "yaw_rate_radps", 1.0),
    ("track_width/scale", "turn", "yaw_rate_radps", -1.0),
    ("track_width/turning", "turn", "yaw_rate_radps", -1.0),
    ("torque_limit/scale", "step", "wheel_left_radps", -1.0),
    ("torque_limit/heating", "step", "wheel_left_radps", -1.0),
    ("torque_limit/weak_motors", "straight", "current_left_a", 1.0),
    ("torque_limit/weak_left", "straight", "current_left_a", 1.0),
    ("torque_limit/weak_right", "straight", "current_right_a", 1.0),
    ("battery_sag/resistance", "fast", "wheel_left_radps", -1.0),
    ("battery_sag/discharge", "fast", "wheel_left_radps", -1.0),
    ("drivetrain_friction/coulomb", "straight", "current_left_a", 1.0),
    ("drivetrain_friction/coulomb", "reverse", "current_left_a", -1.0),
    ("drivetrain_friction/viscous", "straight", "current_left_a", 1.0),
    ("drivetrain_friction/efficiency", "straight", "current_left_a", 1.0),
    ("encoder_scale/reading", "straight", "wheel_left_radps", 1.0),
    ("encoder_scale/in_loop", "straight", "speed_mps", -1.0),
    ("encoder_scale/left_in_loop", "straight", "yaw_rate_radps", 1.0),
    ("encoder_scale/right_in_loop", "straight", "yaw_rate_radps", -1.0),
    ("encoder_dropout/share", "straight", "wheel_left_radps", -1.0),
    ("encoder_dropout/with_speed", "straight", "wheel_left_radps", -1.0),
    ("gyro_bias/constant", "straight", "yaw_rate_radps", 1.0),
    ("gyro_bias/warm_up", "straight", "yaw_rate_radps", 1.0),
    ("gyro_scale/scale", "turn", "yaw_rate_radps", 1.0),
    ("gyro_scale/asymmetry", "turn", "yaw_rate_radps", 1.0),
    ("accel_bias/constant", "straight", "accel_x_mps2", 1.0),
    ("accel_bias/warm_up", "straight", "accel_y_mps2", 1.0),
    ("imu_yaw_misalignment/rotation", "turn", "accel_x_mps2", 1.0),
    ("imu_lever_arm/offset", "turn", "accel_x_mps2", -1.0),
    ("imu_lever_arm/size_effect", "turn", "accel_y_mps2", -1.0),
    ("vibration_rectification/power", "straight", "accel_x_mps2", 1.0),
    ("vibration_rectification/resonance", "straight", "accel_x_mps2", 1.0),
    ("gnss_latency/both", "straight", "gnss_east_m", -1.0),
    ("gnss_lever_arm/offset", "straight", "gnss_east_m", 1.0),
    ("slope/uniform", "straight", "accel_x_mps2", 1.0),
    ("slope/along_track", "straight", "current_left_a", 1.0),
    ("cross_slope/uniform", "straight", "accel_y_mps2", 1.0),
    ("cross_slope/camber", "straight", "accel_y_mps2", 1.0),
    ("aerodynamic_drag/still_air", "straight", "current_left_a", 1.0),
    ("aerodynamic_drag/still_air", "reverse", "current_left_a", -1.0),
    ("aerodynamic_drag/wind", "straight", "current_left_a", -1.0),
]
"""Form, drive, output and the sign of its change at the end (of a step: over all of it)."""

RESTATED = [
    ("mass/at_cg", {"mass_kg": "scale", "yaw_inertia_kgm2": "scale"}),
    ("cg_lateral/shift", {"cg_left_m": "add"}),
    ("cg_longitudinal/shift", {"cg_forward_m": "add"}),
    ("wheel_radius/scale", {"radius_m": "scale"}),
    ("track_width/scale", {"track_m": "scale"}),
    ("torque_limit/scale", {"torque_limit_nm": "less"}),
    ("drivetrain_friction/efficiency", {"gear_efficiency": "less"}),
    ("dead_time/transport", {"dead_time_s": "add"}),
    ("actuator_lag/torque", {"lag_s": "add"}),
    ("slip_sinkage/linear", {"slip_sinkage": "add"}),
    ("motion_resistance/rolling", {"rolling": "add"}),
    ("motion_resistance/viscous", {"viscous_ns_per_m": "add"}),
    ("mud_adhesion/suction", {"suction_pa": "add"}),
]
"""Forms that restate numbers of the model: the value scales them (1 + e), lowers them (1 - e) or is added."""


def typical(key: str) -> dict[str, float]:
    return at(next(form for form in FORMS if form.key == key), "scale")


@pytest.mark.parametrize(("key", "name", "output", "sign"), SIGNS)
def test_an_effect_acts_in_the_direction_it_should(key, name, output, sign) -> None:
    # On loose sand the longer arm of the thrust makes up for what a wider track turns more slowly.
    terrain = "medium_sand" if key.startswith("track_width") else "loose_sand"
    change = drive(typical(key), DRIVES[name], terrain)[2] - plain(name, terrain)[2]
    window = slice(None) if name == "step" else slice(-100, None)
    assert sign * change[window, Y[output]].mean() > 1e-6


@pytest.mark.parametrize(("key", "numbers"), RESTATED)
def test_a_form_that_restates_a_number_equals_the_model_with_that_number(key, numbers) -> None:
    states, inputs = samples()
    e = typical(key)[key]
    vehicle, ground = plant("mud", slope_rad=0.08).vehicle, soil("mud").reshape(4, -1).copy()
    for name, how in numbers.items():
        at_ = VEHICLE_PARAMETERS.index(name) if name in VEHICLE_PARAMETERS else SOIL_PARAMETERS.index(name)
        table = vehicle if name in VEHICLE_PARAMETERS else ground[:, at_ : at_ + 1]
        row = at_ if name in VEHICLE_PARAMETERS else slice(None)
        table[row] = {"scale": table[row] * (1 + e), "less": table[row] * (1 - e), "add": table[row] + e}[how]
    expected = rhs()(states.T, inputs.T, vehicle, ground.ravel(), []).full().T
    own = [i for name, i in INDEX.items() if not name.startswith(("command", "play"))]
    got = derivatives({key: e}, states, inputs)
    np.testing.assert_allclose(got[:, own], expected[:, own], rtol=1e-9, atol=1e-9)


def test_a_larger_wheel_goes_faster_and_a_false_encoder_slower_by_its_share() -> None:
    y = {e: drive(v, DRIVES["straight"], "asphalt")[2][-1] for e, v in (
        ("none", {}), ("wheel", {"wheel_radius/scale": 0.05}), ("loop", {"encoder_scale/in_loop": 0.05})
    )}  # fmt: skip
    speed = {name: row[Y["speed_mps"]] for name, row in y.items()}
    assert speed["wheel"] / speed["none"] == pytest.approx(1.05, rel=2e-3)
    assert speed["loop"] / speed["none"] == pytest.approx(1.0 / 1.05, rel=2e-3)
    assert y["loop"][Y["wheel_left_radps"]] == pytest.approx(y["none"][Y["wheel_left_radps"]], rel=2e-3)


def test_ground_stiffer_sideways_lets_the_robot_slide_less_for_good() -> None:
    on = plant("medium_sand", effects={"lateral_anisotropy/stiffness": 1.0}), plant("medium_sand")
    inputs, aside = delayed_inputs(np.full((1001, 2), 5.0), DT_S), VEHICLE_PARAMETERS.index("gravity_y_mps2")
    slides = []
    for ground in on:
        ground.vehicle[aside] = -1.0
        slides.append(integrate(np.zeros(len(STATES)), inputs, DT_S, ground)[-1, INDEX["v"]])
    assert slides[0] == pytest.approx(0.5 * slides[1], rel=0.03)


@pytest.mark.parametrize("terrain", ["snow", "mud"])
def test_no_form_leaves_its_law_where_wheels_turn_against_their_way(terrain) -> None:
    against = np.zeros(len(STATES))
    against[INDEX["u"]], against[state_slice("wheel_speed")] = 1.0, -6.0
    for form in FORMS:
        for end in ("low", "high"):
            values = at(form, end)
            dx = rhs(tuple(values))(
                against, np.zeros(len(INPUTS)), plant().vehicle, soil(terrain), np.array([*values.values()])
            )
            assert np.isfinite(dx.full()).all(), form.key


def test_a_false_encoder_leaves_the_motors_limits_at_the_speed_the_wheel_has() -> None:
    fast, inputs = np.zeros(len(STATES)), np.array([-50.0, -50.0, 0.0, 0.0, 0.0, 0.0])
    fast[state_slice("wheel_speed")], ground = 9.0, soil("asphalt")
    rate = [
        rhs(names)(fast, inputs, plant().vehicle, ground, values).full()[state_slice("torque"), 0]
        for names, values in (((), []), (("encoder_scale/in_loop",), [0.2]))
    ]
    np.testing.assert_allclose(rate[0], rate[1], rtol=1e-3)


def test_dead_time_delays_the_whole_drive() -> None:
    now, later = (drive(v, exciting())[0] for v in ({}, {"dead_time/transport": 0.1}))
    own = [i for name, i in INDEX.items() if not name.startswith(("command", "elapsed", "electric"))]
    np.testing.assert_allclose(later[1010:2000, own], now[1000:1990, own], atol=1e-6)


@pytest.mark.parametrize("key", ["dead_time/all_pass", "actuator_lag/command"])
def test_lags_of_the_command_delay_a_long_ramp_as_dead_time_does(key) -> None:
    sides = np.repeat(np.linspace(0.0, 5.0, 501)[:, None], 2, axis=1)
    speed = [
        drive({k: 0.1}, sides)[0][-50:, state_slice("wheel_speed")] for k in (key, "dead_time/transport")
    ]
    without = drive({}, sides)[0][-50:, state_slice("wheel_speed")]
    assert np.abs(speed[0] - speed[1]).max() < 0.02 * np.abs(speed[1] - without).min()


def test_all_effects_at_once_run_in_both_backends() -> None:
    values = {key: value for form in FORMS for key, value in at(form, "scale").items()}
    own, inputs = plant(effects=values), delayed_inputs(exciting()[:1001], DT_S)
    c, vm = (integrate(np.zeros(len(STATES)), inputs, DT_S, own, backend=name) for name in ("auto", "vm"))
    np.testing.assert_allclose(c, vm, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize(
    "key", ["soil_strength/shear", "wheel_radius/scale", "backlash/torque_gap", "dead_time/transport"]
)
def test_sensitivities_of_a_run_to_an_effect_meet_finite_differences(key) -> None:
    """At zero; a smooth command, so that its delay has a derivative."""
    t = np.arange(0.0, 6.0, DT_S)
    sides = np.stack([3.0 - 3.0 * np.cos(t), 3.5 - 3.5 * np.cos(1.3 * t)], axis=1)
    step, rest = 1e-3 * typical(key)[key], np.zeros(len(STATES))
    ends = [drive({key: sign * step}, sides)[0] for sign in (1.0, -1.0)]
    directions = Directions.zeros(plant(), 1, [key])
    directions.effects[key][0] = 1.0
    tangent = integrate_with_sensitivity(rest, delayed_inputs(sides, DT_S), DT_S, plant(), directions)[1][
        :, :, 0
    ]
    for name in ("x", "y", "yaw", "u", "r"):
        expected = (ends[0] - ends[1])[:, INDEX[name]] / (2.0 * step)
        got = tangent[:, INDEX[name]]
        assert np.abs(got - expected).max() < 0.02 * np.abs(expected).max()


def test_gear_losses_cost_the_battery() -> None:
    before, after = (
        drive(v, DRIVES["straight"])[0][-1] for v in ({}, {"drivetrain_friction/efficiency": 0.2})
    )
    assert after[INDEX["electric_energy"]] > 1.1 * before[INDEX["electric_energy"]]
    assert after[INDEX["motor_work"]] == pytest.approx(before[INDEX["motor_work"]], rel=1e-3)


@pytest.mark.parametrize("which", ["scale", "high"])
@pytest.mark.parametrize("key", PASSIVE)
def test_passive_effects_create_no_energy(key, which) -> None:
    """Work of the motors >= change of kinetic energy from any start; soil springs start unloaded."""
    form = next(form for form in FORMS if form.key == key)
    rng = np.random.default_rng(4)
    for _ in range(4):
        start = np.zeros(len(STATES))
        start[[INDEX[name] for name in BODY]] = rng.uniform(-1.0, 1.0, 3) * [1.5, 0.5, 1.0]
        start[state_slice("wheel_speed")] = rng.uniform(-1.5, 1.5, 4) / RADIUS_M
        x = drive(at(form, which), np.zeros((301, 2)), start=start)[0]
        gained = kinetic_j(x) - kinetic_j(x)[0] - x[:, INDEX["motor_work"]]
        assert gained.max() < 1e-6


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    key=st.sampled_from(DRAGGING),
    share=st.floats(0.0, 1.0),
    body=st.tuples(st.floats(-2.0, 2.0), st.floats(-1.0, 1.0), st.floats(-2.0, 2.0)),
    wheels=st.tuples(*[st.floats(-12.0, 12.0)] * 4),
    torques=st.tuples(*[st.floats(-15.0, 15.0)] * 4),
    play=st.floats(-1.0, 1.0),
)
def test_drag_takes_power_whatever_the_robot_does(key, share, body, wheels, torques, play) -> None:
    """The change of the rate of kinetic energy, less that of the motors' work, is no gain."""
    x = np.zeros((1, len(STATES)))
    x[0, [INDEX[name] for name in BODY]] = body
    x[0, state_slice("wheel_speed")], x[0, state_slice("torque")] = wheels, torques
    x[0, state_slice("play")], x[0, INDEX["travel"]] = play, 3.0
    value = share * next(p.high for form in FORMS if form.key == key for p in form.parameters)
    change = (
        derivatives({key: value}, x, np.zeros((1, len(INPUTS))))
        - derivatives({}, x, np.zeros((1, len(INPUTS))))
    )[0]
    u, v, r = (change[INDEX[name]] * own for name, own in zip(BODY, body, strict=True))
    power = ELEVATE.body.mass_kg * (u + v) + ELEVATE.body.yaw_inertia_kgm2 * r
    power += ELEVATE.wheel.inertia_kgm2 * (change[state_slice("wheel_speed")] @ np.array(wheels))
    assert power - change[INDEX["motor_work"]] < 1e-9


def kinetic_j(x: np.ndarray) -> np.ndarray:
    """Kinetic energy (N,) of body and wheels."""
    u, v, r = (x[:, INDEX[name]] for name in BODY)
    moving = ELEVATE.body.mass_kg * (u**2 + v**2) + ELEVATE.body.yaw_inertia_kgm2 * r**2
    return 0.5 * (moving + ELEVATE.wheel.inertia_kgm2 * (x[:, state_slice("wheel_speed")] ** 2).sum(axis=1))


def signature(values: dict[str, float], sides: np.ndarray, plain: np.ndarray) -> np.ndarray:
    """What an effect changes in the `plain` readings of a drive, every 5th row, in units of noise.

    Positions less the integral of the velocities: the rest of a motion's change is in these.
    """
    change = drive(values, sides, every=5)[2] - plain
    moved = np.zeros((len(change), 2))
    velocity = change[:, [Y["gnss_v_e_mps"], Y["gnss_v_n_mps"]]]
    moved[1:] = np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * 5 * DT_S, axis=0)
    change[:, [Y["gnss_east_m"], Y["gnss_north_m"]]] -= moved
    sigma = [SIGMAS.get(name, SIGMAS[name.rsplit("_", 1)[1]]) for name in OUTPUTS]
    return (change / sigma)[:, : Y["speed_mps"]].ravel()


@pytest.mark.parametrize("effect", sorted({form.effect for form in FORMS}))
def test_the_forms_of_an_effect_differ_beyond_their_size(effect) -> None:
    """Correlation of their signatures below 0.999, each of them seen; torque is limited in steps only."""
    sides = np.tile(DRIVES["step"], (10, 1)) if effect == "torque_limit" else exciting()
    without = drive({}, sides, every=5)[2]
    forms = [signature(at(form, "scale"), sides, without) for form in FORMS if form.effect == effect]
    for one, other in itertools.combinations(forms, 2):
        sizes = np.linalg.norm(one), np.linalg.norm(other)
        assert min(sizes) > 0.5
        assert abs(one @ other) < 0.999 * sizes[0] * sizes[1]
