"""The catalogue of effects; each form in the graph: absent at zero, in its place, smooth, symmetric."""

from __future__ import annotations

import functools
from collections import Counter

import numpy as np
import pytest

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.effects.catalogue import effect_names
from terrafusion.twin.effects.form import SENSOR_STAGES, STAGES, Form, one
from terrafusion.twin.engine.stability import MAX_STEP_S
from terrafusion.twin.model.dynamics import rhs
from terrafusion.twin.model.measurement import correction, measured, measurement
from terrafusion.twin.physics.layout import INDEX, OUTPUTS, STATES, VEHICLE_PARAMETERS
from tests.twin.effects.effect_cases import (
    FORMS,
    KEYS,
    MOUNTING,
    all_effects,
    at,
    derivatives,
    named,
    plant,
    readings,
    samples,
    soil,
    vector,
)

EFFECTS = """
slip_sinkage rate_dependent_shear motion_resistance grousers soil_drift multipass_compaction mud_adhesion
lateral_anisotropy left_right_friction soil_strength
mass cg_lateral cg_longitudinal wheel_radius wheel_radius_asymmetry track_width torque_limit battery_sag
drivetrain_friction backlash dead_time actuator_lag
encoder_scale encoder_dropout gyro_bias gyro_scale accel_bias imu_yaw_misalignment imu_lever_arm
vibration_rectification imu_time_offset gnss_latency gnss_lever_arm gnss_multipath
slope cross_slope aerodynamic_drag
"""
CONTRACT = EFFECTS.split()

BODY = ("u", "v", "r")
REACH = {
    "command": ("torque", "speed_error", "command"),
    "supply": ("torque", "speed_error"),
    "loads": (*BODY, "wheel_speed", "shear", "brake", "clog", "slip_work", "resistance_work"),
    "corner": (*BODY, "wheel_speed", "shear", "brake", "clog", "slip_work", "resistance_work"),
    "ground": (*BODY, "wheel_speed", "shear", "brake", "clog", "slip_work", "resistance_work"),
    "motor": ("torque", "speed_error", "play"),
    "wheel": (*BODY, "wheel_speed", "motor_work", "slip_work", "resistance_work"),
    "shafts": ("wheel_speed",),
    "body": (*BODY, "resistance_work"),
} | dict.fromkeys(SENSOR_STAGES, ())
"""States whose derivative a term at a stage can change at once; what lies upstream it cannot."""

ODD = {
    "left_right_friction/sides", "left_right_friction/lane", "left_right_friction/turning_centre",
    "cg_lateral/shift", "cg_lateral/turning_centre",
    "wheel_radius_asymmetry/sides", "gyro_bias/constant", "gyro_bias/warm_up", "gyro_scale/asymmetry",
    "accel_bias/constant/y",
    "accel_bias/warm_up/y", "imu_yaw_misalignment/rotation", "imu_yaw_misalignment/cross_axis",
    "imu_lever_arm/offset/y", "imu_lever_arm/size_effect/y", "vibration_rectification/power/y",
    "vibration_rectification/resonance/y", "gnss_lever_arm/offset/y", "gnss_multipath/slow/north",
    "cross_slope/uniform", "cross_slope/camber",
}  # fmt: skip
"""Parameters that change their sign where left and right are exchanged."""
LOPSIDED = {
    "wheel_radius_asymmetry/one_wheel", "wheel_radius_asymmetry/left", "wheel_radius_asymmetry/right",
    "torque_limit/weak_left", "torque_limit/weak_right",
    "encoder_scale/left_in_loop", "encoder_scale/right_in_loop",
}  # fmt: skip

ENDS = [(f, end) for f in FORMS for end in ("low", "scale", "high") if any(at(f, end).values())]
each_form = pytest.mark.parametrize("form", FORMS, ids=named)


def test_every_effect_of_the_contract_is_there_in_two_forms_or_more() -> None:
    assert len(CONTRACT) == 37
    causes = Counter(form.effect for form in FORMS if form.candidate)
    assert set(causes) == set(CONTRACT)
    assert min(causes.values()) >= 2
    assert set(effect_names()) >= set(CONTRACT)


def test_every_parameter_has_one_key_and_a_range_that_holds_its_typical_size() -> None:
    assert len(KEYS) == len(set(KEYS))
    for form in FORMS:
        for p in form.parameters:
            assert p.low <= 0.0 <= p.scale <= p.high, form.parameter_key(p)
        assert form.equation
        assert form.source


def test_an_unknown_name_makes_no_graph() -> None:
    for graph in (rhs, measurement):
        with pytest.raises(ConfigError, match="did you mean wheel_radius/scale"):
            graph(("wheel_radius/skale",))


def test_a_mast_bends_with_what_it_feels_not_with_what_an_accelerometer_reads() -> None:
    states, inputs = samples()
    bent, biased = {"gnss_lever_arm/mast": 0.1}, {"accel_bias/constant/x": 1.0}
    both, alone = (
        readings(v, states, inputs)[:, OUTPUTS.index("gnss_east_m")] for v in (bent | biased, bent)
    )
    assert np.array_equal(both, alone)


def test_every_stage_is_used_and_tells_what_may_be_set() -> None:
    assert {stage for form in FORMS for stage in form.terms} == set(STAGES)


def test_effects_that_are_named_and_zero_change_nothing_but_rounding() -> None:
    states, inputs = samples()
    vehicle, ground = plant("mud", slope_rad=0.08).vehicle, soil("mud")
    own = [i for name, i in INDEX.items() if not name.startswith(("command", "play"))]
    plain = rhs()(states.T, inputs.T, vehicle, ground, []).full().T
    np.testing.assert_allclose(derivatives({}, states, inputs)[:, own], plain[:, own], rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(
        readings({}, states, inputs),
        measured(states, inputs, vehicle, ground, MOUNTING),
        rtol=1e-11,
        atol=1e-11,
    )


def test_effects_of_value_zero_are_not_in_the_graph() -> None:
    assert plant(effects=dict.fromkeys(KEYS, 0.0)).effect_names() == ()
    assert rhs(()).n_instructions() < all_effects().n_instructions()


@each_form
def test_a_form_reaches_what_lies_behind_its_stage_and_nothing_before(form) -> None:
    states, inputs = samples()
    values = at(form, "scale")
    plain, other = derivatives({}, states, inputs), derivatives(values, states, inputs)
    moved = {STATES[i] for i in np.flatnonzero((plain != other).any(axis=0))}
    if "vehicle" not in form.terms:
        reach = tuple(name for stage in form.terms for name in REACH[stage])
        assert all(name.startswith(reach) for name in moved)
        assert not (form.senses_only() and moved)
    assert moved or (readings(values, states, inputs) != readings({}, states, inputs)).any()


@each_form
def test_a_form_alone_equals_itself_among_all_others(form) -> None:
    states, inputs = samples()
    values = at(form, "scale")
    names = tuple(sorted(values))
    vehicle, ground, numbers = plant("mud", slope_rad=0.08).vehicle, soil("mud"), [values[n] for n in names]
    alone = measurement(names)(states.T, inputs.T, vehicle, ground, numbers, MOUNTING).full().T
    np.testing.assert_allclose(alone, readings(values, states, inputs), rtol=1e-9, atol=1e-9)
    if form.senses_only():
        plain = rhs()(states.T, inputs.T, vehicle, ground, []).full()
        assert np.array_equal(rhs(names)(states.T, inputs.T, vehicle, ground, numbers).full(), plain)


@pytest.mark.parametrize("form", [form for form in FORMS if not form.senses_only()], ids=named)
def test_a_law_that_is_not_fixed_to_the_plane_turns_with_the_robot(form) -> None:
    states, inputs = samples()
    east, north, yaw = (STATES.index(name) for name in ("x", "y", "yaw"))
    turned, turn = states.copy(), 0.7
    turned[:, yaw] += turn
    first, there = (derivatives(at(form, "scale"), x, inputs, slope_rad=0.0) for x in (states, turned))
    back = there.copy()
    back[:, east] = np.cos(turn) * there[:, east] + np.sin(turn) * there[:, north]
    back[:, north] = -np.sin(turn) * there[:, east] + np.cos(turn) * there[:, north]
    same = np.allclose(back, first, rtol=1e-7, atol=1e-9 * np.abs(first).max())
    assert same or form.world_fixed()
    assert not same or form.key not in ("slope/uniform", "cross_slope/uniform", "aerodynamic_drag/wind")


def test_laws_that_are_fixed_to_the_plane() -> None:
    """Along the track and camber turn with the robot, and are named all the same: they set its gravity."""
    slopes = {"slope/uniform", "slope/along_track", "cross_slope/uniform", "cross_slope/camber"}
    places = {"soil_drift/over_place", "left_right_friction/lane"}
    assert {f.key for f in FORMS if f.world_fixed()} == slopes | places | {"aerodynamic_drag/wind"}
    sided = Form(
        "rut", "left", one("", 0.1, -1.0, 1.0),
        {"ground": lambda q, e: {"shear_x_m": e * q["x"]} if (0, 1, 2)[q["side"] + 1] else {}},
        "a law that acts on one side of the robot, by place",
    )  # fmt: skip
    assert sided.world_fixed()


@pytest.mark.parametrize(("form", "which"), ENDS, ids=lambda x: x if isinstance(x, str) else x.key)
def test_numbers_and_derivatives_are_finite_everywhere(form, which) -> None:
    states, inputs = samples()
    for column in jets()(*arguments(states, inputs, at(form, which))):
        assert np.isfinite(column.full()).all()


@each_form
def test_derivatives_at_zero_meet_finite_differences(form) -> None:
    states, inputs = samples()
    _, by_effect, outputs_by_effect, _ = jets_at_zero()
    for p in form.parameters:
        key, step = form.parameter_key(p), 1e-5 * p.scale
        column = KEYS.index(key)
        for evaluate, jacobian in ((derivatives, by_effect), (readings, outputs_by_effect)):
            ends = [evaluate({key: sign * step}, states, inputs) for sign in (1.0, -1.0)]
            expected = (ends[0] - ends[1]) / (2.0 * step)
            got = jacobian.full().reshape(expected.shape[1], len(states), len(KEYS))[:, :, column].T
            tolerance = 1e-6 * np.abs(ends[0]).max(axis=0) / step * 1e-3 + 1e-4 * np.abs(expected).max(axis=0)
            assert (np.abs(got - expected) <= tolerance + 1e-9).all(), key


def arguments(states: np.ndarray, inputs: np.ndarray, values: dict[str, float]) -> list[np.ndarray]:
    return [states.T, inputs.T, plant("mud", slope_rad=0.08).vehicle, soil("mud"), vector(values), MOUNTING]


@functools.cache
def jets_at_zero():
    return jets()(*arguments(*samples(), {}))


@functools.cache
def jets():
    """f and h, both by effects, and a second derivative of a weighted sum of both by states and effects."""
    import casadi as ca

    f, h = all_effects(), measurement(KEYS)
    a = [ca.SX.sym(name, h.size1_in(i)) for i, name in enumerate(h.name_in())]
    dx, y = f(*a[:5]), h(*a)
    by_effect = [ca.densify(ca.jacobian(values, a[4])) for values in (dx, y)]
    rng = np.random.default_rng(0)
    total = ca.dot(rng.uniform(0.5, 1.0, len(STATES)), dx) + ca.dot(rng.uniform(0.5, 1.0, len(OUTPUTS)), y)
    way = rng.uniform(-1.0, 1.0, len(STATES) + len(KEYS))
    both = ca.vertcat(a[0], a[4])
    bend = ca.jtimes(ca.gradient(total, both), both, way)
    return ca.Function("jets", a, [ca.vertcat(dx, y), *by_effect, bend])


@pytest.mark.parametrize("which", ["scale", "high"])
@pytest.mark.parametrize("form", [form for form in FORMS if not form.senses_only()], ids=named)
def test_no_form_is_stiffer_than_the_integrator_allows(form, which) -> None:
    """RK4 is stable to 2.78 / step on the real axis, RK3 to 2.51."""
    states, inputs = samples()
    for x, u in zip(states[::4], inputs[::4], strict=True):
        jacobian = by_state()(x, u, plant().vehicle, soil(), vector(at(form, which))).full()
        assert np.abs(np.linalg.eigvals(jacobian)).max() < 2.51 / MAX_STEP_S


@functools.cache
def by_state():
    import casadi as ca

    f = all_effects()
    a = [ca.SX.sym(name, f.size1_in(i)) for i, name in enumerate(f.name_in())]
    return ca.Function("by_state", a, [ca.jacobian(f(*a), a[0])])


def mirror(names: tuple[str, ...], flipped: tuple[str, ...]) -> tuple[list[int], np.ndarray]:
    """Where each entry comes from when left and right are exchanged, and its sign."""
    swapped = [
        n.replace("left", "#").replace("right", "left").replace("#", "right")
        if "left" in n or "right" in n
        else n
        for n in (n if n != "cg_left_m" else "cg" for n in names)
    ]
    known = [n if n != "cg_left_m" else "cg" for n in names]
    return [known.index(n) for n in swapped], np.array(
        [-1.0 if n.startswith(flipped) else 1.0 for n in names]
    )


@each_form
def test_exchanging_left_and_right_gives_the_mirrored_motion(form) -> None:
    states, inputs = samples()
    rows, signs = mirror(STATES, ("y", "v", "r", "shear_y"))
    signs[INDEX["yaw"]], signs[INDEX["resistance_work"]] = -1.0, 1.0
    seen, seen_signs = mirror(OUTPUTS, ("yaw_rate", "accel_y", "gnss_north", "gnss_v_n", "side_speed"))
    _, vehicle_signs = mirror(VEHICLE_PARAMETERS, ("cg_left", "gravity_y"))
    vehicle, ground = plant("mud", slope_rad=0.08).vehicle, soil("mud")
    mounted = MOUNTING * [1.0, -1.0, 1.0, -1.0, 1.0]
    values = at(form, "scale")
    names = tuple(sorted(values))
    plain = np.array([values[n] for n in names])
    turned = plain * [-1.0 if n in ODD else 1.0 for n in names]
    here = (states.T, inputs.T, vehicle, ground)
    there = (
        (states[:, rows] * signs).T,
        (inputs[:, [1, 0, 3, 2, 4, 5]] * [1.0, 1.0, 1.0, 1.0, -1.0, -1.0]).T,
        vehicle * vehicle_signs,
        ground,
    )
    moving = rhs(names)(*here, plain).full().T[:, rows] * signs
    mirrored = rhs(names)(*there, turned).full().T
    reading = measurement(names)(*here, plain, MOUNTING).full().T[:, seen] * seen_signs
    mirrored_reading = measurement(names)(*there, turned, mounted).full().T
    same = np.allclose(moving, mirrored, rtol=1e-8, atol=1e-8)
    same &= np.allclose(reading, mirrored_reading, rtol=1e-8, atol=1e-8)
    assert same != (form.key in LOPSIDED)


def test_corrections_are_what_an_effect_adds_to_the_readings_of_a_motion() -> None:
    """A sensor effect adds what it changes; an effect of the motion nothing but what a sensor cannot know."""
    states, inputs = samples()
    common = (states.T, inputs.T, plant("mud", slope_rad=0.08).vehicle, soil("mud"))
    for key, touched in (
        ("gyro_bias/constant", {"yaw_rate_radps"}),
        ("soil_strength/shear", set()),
        ("cg_lateral/shift", set()),
        ("cross_slope/uniform", {"accel_x_mps2", "accel_y_mps2"}),
        ("drivetrain_friction/efficiency", {"current_left_a", "current_right_a"}),
    ):
        added = correction((key,))(*common, [0.02], MOUNTING).full()
        assert {OUTPUTS[i] for i in np.flatnonzero(np.abs(added).max(axis=1) > 1e-9)} == touched, key
