"""One wheel on soil: signs, limits, symmetry, monotonicity, energy, smoothness; terms absent at zero."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.twin.model.library import known_names
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import soil_vector
from terrafusion.twin.physics import terramechanics as tm
from terrafusion.twin.physics.layout import SOIL_PARAMETERS
from terrafusion.twin.physics.terramechanics import WheelShape
from terrafusion.twin.physics.wheel import (
    RESISTANCE_SPEED_MPS,
    Contact,
    WheelSoil,
    clog_rate,
    contact,
    footprint,
    steady_contact,
)

LOAD_N = 80.0
SMOOTH = WheelShape(0.175, 0.145)
SPIKED = WheelShape(0.175, 0.145, 0.02, 18.0)
SPEEDS = st.floats(-2.0, 2.0)
LOADS = st.floats(5.0, 500.0)
SOILS = st.sampled_from(known_names("soils"))
FEW = settings(max_examples=60, deadline=None)


def ground(name: str, **changed: float) -> WheelSoil:
    return WheelSoil(*soil_vector(load_soil(name)))._replace(**changed)


def steady(
    on: WheelSoil, rim: float, hub: tuple[float, float], load: float = LOAD_N, shape: WheelShape = SMOOTH
) -> Contact:
    """The steady contact in plain numbers."""
    return Contact(*(float(value) for value in steady_contact(on, load, rim, hub, shape)))


@pytest.mark.parametrize("name", known_names("soils"))
@pytest.mark.parametrize("speed", [-1.5, -0.1, 0.3, 2.0])
def test_no_traction_without_slip(name, speed) -> None:
    wheel = steady(ground(name), speed, (speed, 0.0))
    assert abs(wheel.traction_x_n) < 1e-9
    assert wheel.force_y_n == 0.0
    assert wheel.force_x_n * speed <= 0.0


@FEW
@given(name=SOILS, rim=SPEEDS, u=SPEEDS, v=SPEEDS, load=LOADS)
def test_traction_goes_with_the_slip_and_stays_below_its_limits(name, rim, u, v, load) -> None:
    on = ground(name)
    wheel = steady(on, rim, (u, v), load)
    assert wheel.traction_x_n * (rim - u) >= -1e-12
    assert wheel.traction_y_n * -v >= -1e-12
    z, length = (float(x) for x in footprint(on, load, rim, (u, v), 0.0, SMOOTH)[:2])
    strength = on.cohesion_pa * SMOOTH.width_m * length + load * on.tan_friction
    assert abs(wheel.traction_x_n) <= min(strength, on.friction_cap * load) * (1.0 + 1e-9)
    assert 0.0 < z <= 1.5 * SMOOTH.radius_m


@FEW
@given(name=SOILS, rim=SPEEDS, u=SPEEDS, v=SPEEDS, load=LOADS)
def test_left_and_right_forward_and_backward_are_alike(name, rim, u, v, load) -> None:
    on = ground(name)
    wheel, mirrored = steady(on, rim, (u, v), load), steady(on, rim, (u, -v), load)
    backward = steady(on, -rim, (-u, v), load)
    assert mirrored.force_x_n == pytest.approx(wheel.force_x_n, abs=1e-9)
    assert mirrored.force_y_n == pytest.approx(-wheel.force_y_n, abs=1e-9)
    assert backward.force_x_n == pytest.approx(-wheel.force_x_n, abs=1e-9)
    assert backward.force_y_n == pytest.approx(wheel.force_y_n, abs=1e-9)
    assert backward.drag_torque_nm == pytest.approx(-wheel.drag_torque_nm, abs=1e-9)


@FEW
@given(name=SOILS, rim=SPEEDS, u=SPEEDS, v=SPEEDS, load=LOADS, spiked=st.booleans())
def test_a_wheel_never_gives_more_than_its_motor(name, rim, u, v, load, spiked) -> None:
    """In steady motion the torque's power covers the power given to the body, whatever the slip."""
    shape = SPIKED if spiked else SMOOTH
    on = ground(name, bulldozing=8.0, suction_pa=3000.0, multipass=0.7)
    wheel = steady(on, rim, (u, v), load, shape)
    taken = wheel.traction_x_n * rim + wheel.drag_torque_nm * rim / shape.radius_m
    given_to_body = wheel.force_x_n * u + wheel.force_y_n * v
    assert taken - given_to_body >= -1e-9


@FEW
@given(name=SOILS, rim=SPEEDS, u=SPEEDS, v=SPEEDS)
def test_the_closed_form_is_the_steady_state(name, rim, u, v) -> None:
    wheel = steady(ground(name), rim, (u, v))
    assert abs(wheel.shear_rate_x) < 1e-9
    assert abs(wheel.shear_rate_y) < 1e-9
    assert abs(wheel.brake_rate) < 1e-9


@pytest.mark.parametrize("name", known_names("soils"))
def test_traction_grows_with_slip(name) -> None:
    on = ground(name)
    pulls = [steady(on, 1.0, (1.0 - s, 0.0)).traction_x_n for s in np.linspace(0.0, 0.95, 20)]
    assert (np.diff(pulls) > 0.0).all()


@pytest.mark.parametrize("name", [name for name in known_names("soils") if name != "asphalt"])
def test_sinkage_grows_with_load_slip_and_skid_and_shrinks_with_width(name) -> None:
    on = ground(name)
    z = [steady(on, 1.0, (1.0, 0.0), load).sinkage_m for load in (20.0, 80.0, 200.0)]
    assert z == sorted(z)
    z = [steady(on, 1.0, (1.0 - s, 0.0)).sinkage_m for s in (0.1, 0.3, 0.6, 0.9)]
    assert z == sorted(z)
    z = [steady(on, 1.0 - s, (1.0, 0.0)).sinkage_m for s in (0.1, 0.3, 0.6, 1.0)]
    assert z == sorted(z)
    z = [steady(on, np.cos(a), (np.cos(a), np.sin(a))).sinkage_m for a in (0.2, 0.6, 1.0, 1.5)]
    assert z == sorted(z)
    narrow, wide = (steady(on, 1.0, (1.0, 0.0), LOAD_N, WheelShape(0.175, b)).sinkage_m for b in (0.08, 0.2))
    assert wide < narrow


@pytest.mark.parametrize("number", ["cohesion_pa", "tan_friction"])
def test_strength_of_the_soil_pulls_more(number) -> None:
    on = ground("loose_sand", friction_cap=5.0)
    stronger = on._replace(**{number: 1.5 * getattr(on, number)})
    assert steady(stronger, 1.0, (0.8, 0.0)).traction_x_n > steady(on, 1.0, (0.8, 0.0)).traction_x_n


DEAR = {
    "bulldozing": 8.0, "suction_pa": 5e3, "skid_sinkage": 5.0, "slip_sinkage": 3.0, "viscous_ns_per_m": 20.0
}  # fmt: skip


@pytest.mark.parametrize("number", DEAR)
def test_a_term_takes_power_and_is_absent_at_zero(number) -> None:
    """More of it costs more at the same motion; at zero, numbers that only it uses do not matter."""
    base = ground("mud", **{number: 0.0})
    with_it = base._replace(**{number: DEAR[number]})

    def power(on: WheelSoil) -> float:
        rim, u = (0.6, 1.0) if number == "skid_sinkage" else (1.0, 0.7)
        wheel = steady(on, rim, (u, 0.2))
        drag = wheel.drag_torque_nm / SMOOTH.radius_m
        return (wheel.traction_x_n + drag) * rim - wheel.force_x_n * u - wheel.force_y_n * 0.2

    assert power(with_it) > power(base) + 1e-3
    if number == "bulldozing":
        assert power(base._replace(unit_weight_n_per_m3=9e3)) == power(base)


def test_bulldozing_pushes_back_on_skidding_and_side_slipping_wheels_only() -> None:
    without, with_it = (ground("loose_sand", bulldozing=gain) for gain in (0.0, 6.0))
    rolling, rolling_too = (steady(on, 1.0, (0.9, 0.0)).force_x_n for on in (without, with_it))
    assert rolling_too == pytest.approx(rolling, abs=0.5)
    assert steady(with_it, 0.0, (1.0, 0.0)).force_x_n < steady(without, 0.0, (1.0, 0.0)).force_x_n - 5.0
    assert steady(with_it, 1.0, (1.0, 0.5)).force_y_n < steady(without, 1.0, (1.0, 0.5)).force_y_n - 5.0


def test_a_following_wheel_sinks_and_resists_less() -> None:
    on = ground("loose_sand")
    fresh, rut = (
        contact(on, LOAD_N, 1.0, (1.0, 0.0), (0.0, 0.0), 0.0, 0.0, SMOOTH, share) for share in (0.0, 1.0)
    )
    assert float(rut.sinkage_m) == pytest.approx((1.0 - on.multipass) * float(fresh.sinkage_m), rel=1e-6)
    saved = np.sqrt(1.0 - on.multipass)
    assert float(rut.force_x_n) + on.viscous_ns_per_m == pytest.approx(
        saved * (float(fresh.force_x_n) + on.viscous_ns_per_m), rel=5e-3
    )
    bare = on._replace(multipass=0.0)
    same = [footprint(bare, LOAD_N, 1.0, (1.0, 0.0), 0.0, SMOOTH, share) for share in (0.0, 1.0)]
    assert float(same[0].sinkage_m) == float(same[1].sinkage_m)


def test_the_wall_of_a_rut_holds_a_wheel_sideways_as_fresh_ground_does() -> None:
    def wall_n(following: float) -> float:
        with_it, without = (
            contact(on, LOAD_N, 1.0, (1.0, -0.1), (0.0, 0.01), 0.0, 0.0, SMOOTH, following).traction_y_n
            for on in (ground("loose_sand", bulldozing=6.0), ground("loose_sand", bulldozing=0.0))
        )
        return float(with_it) - float(without)

    assert wall_n(1.0) == pytest.approx(wall_n(0.0), rel=1e-3)


def test_grousers_pull_more_and_do_nothing_without_height_or_number() -> None:
    on = ground("ploughed_soil", friction_cap=5.0)
    plain = steady(on, 1.0, (0.5, 0.0)).traction_x_n
    assert steady(on, 1.0, (0.5, 0.0), shape=SPIKED).traction_x_n > 1.05 * plain
    for idle in (SPIKED._replace(grouser_height_m=0.0), SPIKED._replace(grouser_count=0.0)):
        assert steady(on, 1.0, (0.5, 0.0), shape=idle).traction_x_n == plain


def _graph() -> tuple[Any, Any]:
    """All inputs of a contact as one vector, and its outputs."""
    x = ca.SX.sym("x", 8)
    soil = ca.SX.sym("soil", len(SOIL_PARAMETERS))
    on = WheelSoil(*(soil[i] for i in range(len(SOIL_PARAMETERS))))
    c = contact(on, x[7], x[0], (x[1], x[2]), (x[3], x[4]), x[5], x[6], SPIKED, 0.5)
    return ca.vertcat(x, soil), ca.vertcat(*c)


@pytest.mark.parametrize("name", known_names("soils"))
@pytest.mark.parametrize("state", [np.zeros(7), np.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])])
def test_second_derivatives_are_finite_at_rest_and_at_zero_slip(name, state) -> None:
    inputs, outputs = _graph()
    total = ca.sum1(outputs)
    hessian = ca.Function("h", [inputs], [ca.hessian(total, inputs)[0], ca.jacobian(outputs, inputs)])
    at = np.concatenate([state, [LOAD_N], soil_vector(load_soil(name))])
    for derivative in hessian(at):
        assert np.isfinite(np.asarray(derivative)).all()


@settings(max_examples=25, deadline=None)
@given(name=SOILS, state=st.tuples(*[st.floats(-1.0, 1.0)] * 6), clog=st.floats(0.0, 1.0), load=LOADS)
def test_derivatives_are_those_of_finite_differences(name, state, clog, load) -> None:
    inputs, outputs = _graph()
    function = ca.Function("f", [inputs], [outputs, ca.jacobian(outputs, inputs)])
    scale = np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])
    at = np.concatenate([np.array(state) * scale, [clog, load], soil_vector(load_soil(name))])
    exact = np.asarray(function(at)[1])[:, :8]
    for k, step in enumerate(1e-6 * np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01, 1.0, load])):
        change = np.zeros(len(at))
        change[k] = step
        up, down = (np.asarray(function(at + sign * change)[0]).ravel() for sign in (1.0, -1.0))
        close = 1e-3 * (1.0 + np.abs(exact[:, k]).max())
        np.testing.assert_allclose((up - down) / (2.0 * step), exact[:, k], rtol=1e-3, atol=close)


def test_a_rolling_wheel_is_braked_by_its_load_and_by_suction_at_their_arms() -> None:
    """Rolling resistance at the radius, suction on the contact's area at half its length."""
    on = ground("asphalt", rolling=0.02, suction_pa=0.0)
    wheel = steady(on, 1.0, (1.0, 0.0))
    assert wheel.drag_torque_nm == pytest.approx(0.02 * LOAD_N * SMOOTH.radius_m, rel=1e-4)
    length = float(footprint(on, LOAD_N, 1.0, (1.0, 0.0), 0.0, SMOOTH).length_m)
    sticky = steady(on._replace(suction_pa=4e3), 1.0, (1.0, 0.0)).drag_torque_nm - wheel.drag_torque_nm
    assert sticky == pytest.approx(4e3 * SMOOTH.width_m * length * 0.5 * length, rel=1e-4)


def test_clogging_brakes_and_sinks_with_its_fourth_power() -> None:
    on = ground("mud", clog_torque_nm=3.0, clog_sinkage_m=0.01)
    clean, half, full = (
        contact(on, LOAD_N, 1.0, (1.0, 0.0), (0.0, 0.0), 0.01, clog, SMOOTH) for clog in (0.0, 0.5, 1.0)
    )
    base = on._replace(clog_sinkage_m=0.0)
    torques = [
        float(contact(base, LOAD_N, 1.0, (1.0, 0.0), (0.0, 0.0), 0.01, q, SMOOTH).drag_torque_nm)
        for q in (0.0, 0.5, 1.0)
    ]
    assert torques[1] - torques[0] == pytest.approx(3.0 / 16.0)
    assert torques[2] - torques[0] == pytest.approx(3.0)
    z = [float(one.sinkage_m) for one in (clean, half, full)]
    assert z[1] - z[0] == pytest.approx(0.01 / 16.0, rel=1e-3)
    assert z[2] - z[0] == pytest.approx(0.01, rel=1e-2)


def test_mud_is_picked_up_and_shed_with_travel() -> None:
    """Clean: pickup x travel. In balance pickup (1 + churn q s^2) (1 - q) = shed q. At rest nothing."""
    on = ground("mud", pickup_per_m=0.3, churn_gain=2.0, shed_per_m=0.1)
    far = np.hypot(1.0, RESISTANCE_SPEED_MPS) - RESISTANCE_SPEED_MPS
    assert float(clog_rate(on, 0.0, 1.0, 0.5)) == pytest.approx(0.3 * far)
    assert float(clog_rate(on, 0.5, -1.0, 0.5)) == pytest.approx((0.3 * 1.25 * 0.5 - 0.05) * far)
    assert float(clog_rate(on, 1.0, 1.0, 0.9)) == pytest.approx(-0.1 * far)
    assert float(clog_rate(on, 0.2, 0.0, 1.0)) == 0.0


def test_soil_held_at_rest_damps_and_a_rolling_wheel_meets_fresh_soil() -> None:
    """The shear that pushes is j + c v_s, c .03 s at rest and half of it at .05 m/s."""
    on = ground("loose_sand", bulldozing=0.0, slip_sinkage=0.0)
    for transport, damping in ((1e-4, 0.03), (0.05, 0.015)):
        rim = transport
        j = 1e-3 + damping * rim
        moving, same = (
            contact(on, LOAD_N, r, (0.0, 0.0), (x, 0.0), 0.0, 0.0, SMOOTH) for r, x in ((rim, 1e-3), (0.0, j))
        )
        assert float(moving.traction_x_n) == pytest.approx(float(same.traction_x_n), rel=2e-3)
    aside = contact(on, LOAD_N, 0.0, (0.0, 1e-4), (0.0, -1e-3), 0.0, 0.0, SMOOTH)
    held = contact(on, LOAD_N, 0.0, (0.0, 0.0), (0.0, -1e-3 - 0.03e-4), 0.0, 0.0, SMOOTH)
    assert float(aside.traction_y_n) == pytest.approx(float(held.traction_y_n), rel=1e-4)


def test_a_bristle_deflects_within_a_centimetre_of_travel() -> None:
    on = ground("asphalt", suction_pa=0.0)
    at = [contact(on, LOAD_N, 1.0, (1.0, 0.0), (0.0, 0.0), b, 0.0, SMOOTH) for b in (0.0, 0.005, 0.01)]
    assert [float(one.brake_rate) for one in at] == pytest.approx([1.0, 0.5, 0.0], abs=1e-6)
    torque = [float(one.drag_torque_nm) for one in at]
    assert torque == pytest.approx([0.0, 0.5 * torque[2], on.rolling * LOAD_N * SMOOTH.radius_m])


def test_resistance_opposes_the_path_of_the_hub() -> None:
    """Compaction and viscous drag, without bulldozing and without shear; at walking pace all of it."""
    on = ground("loose_sand", bulldozing=0.0, slip_sinkage=0.0, skid_sinkage=0.0, viscous_ns_per_m=7.0)
    u, v = 0.6, 0.8
    wheel = contact(on, LOAD_N, 0.6, (u, v), (0.0, 0.025), 0.0, 0.0, SMOOTH)
    z = float(wheel.sinkage_m)
    pushed = float(tm.compaction_resistance(on.exponent, LOAD_N, z, SMOOTH.radius_m))
    drag = pushed / np.hypot(1.0, RESISTANCE_SPEED_MPS) + 7.0
    assert float(wheel.force_x_n) - float(wheel.traction_x_n) == pytest.approx(-drag * u)
    assert float(wheel.force_y_n) - float(wheel.traction_y_n) == pytest.approx(-drag * v)


def test_traction_is_mohr_coulombs_mobilised_by_janosi_and_hanamotos_shear() -> None:
    """A long way sheared, far from the cap: c b l + W tan(phi) times the mean of 1 - exp(-j / K)."""
    on = ground("loose_sand", friction_cap=50.0, slip_sinkage=0.0, bulldozing=0.0)
    wheel = contact(on, LOAD_N, 0.0, (0.0, 0.0), (0.03, 0.04), 0.0, 0.0, SMOOTH)
    length = float(footprint(on, LOAD_N, 0.0, (0.0, 0.0), 0.0, SMOOTH).length_m)
    x = 0.05 / on.shear_modulus_m
    thrust = on.cohesion_pa * SMOOTH.width_m * length + LOAD_N * on.tan_friction
    mean = 1.0 - (1.0 - np.exp(-x)) / x
    pulls = float(wheel.traction_x_n), float(wheel.traction_y_n)
    assert pulls == pytest.approx((0.6 * thrust * mean, 0.8 * thrust * mean), rel=2e-3)
    capped = contact(on._replace(friction_cap=0.1), LOAD_N, 0.0, (0.0, 0.0), (0.05, 0.0), 0.0, 0.0, SMOOTH)
    assert float(capped.traction_x_n) == pytest.approx(0.1 * LOAD_N, rel=0.01)
