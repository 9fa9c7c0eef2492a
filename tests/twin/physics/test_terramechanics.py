"""Each law of `terramechanics` against its published form, an integral, or a number worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.physics import terramechanics as tm
from terrafusion.twin.physics.layout import INDEX
from terrafusion.twin.physics.smooth import saturate
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate_run

SHAPE = tm.WheelShape(0.175, 0.145)
EXPONENTS = st.floats(0.1, 1.6)


@given(n=EXPONENTS, load=st.floats(5.0, 500.0), k_phi=st.floats(1e5, 1e7))
def test_compaction_is_bekkers_at_the_static_sinkage(n, load, k_phi) -> None:
    z = float(tm.static_sinkage(1e3, k_phi, n, load, SHAPE))
    stiffness = 1e3 + SHAPE.width_m * k_phi
    wheel = 3.0 * load / ((3.0 - n) * stiffness * np.sqrt(0.35))
    assert z == pytest.approx(wheel ** (2.0 / (2.0 * n + 1.0)), rel=1e-9)
    bekker = stiffness * z ** (n + 1) / (n + 1)
    assert float(tm.compaction_resistance(n, load, z, 0.175)) == pytest.approx(bekker, rel=1e-9)


@given(n=EXPONENTS, share=st.floats(0.0, 1.5))
def test_resistance_stays_below_the_load(n, share) -> None:
    assert 0.0 <= float(tm.compaction_resistance(n, 100.0, share * 0.175, 0.175)) < 90.0


def test_passive_pressure_is_rankines() -> None:
    """phi = 30 deg: flow value 3; c = 1 kPa gives 2 sqrt(3) kPa at the surface."""
    at_surface, gradient = tm.passive_pressures(1000.0, np.tan(np.radians(30.0)), 15_000.0)
    assert float(at_surface) == pytest.approx(2000.0 * np.sqrt(3.0))
    assert float(gradient) == pytest.approx(3.0 * 15_000.0)


@given(z=st.floats(0.001, 0.1), chord=st.floats(0.01, 0.2))
def test_bulldozed_force_is_the_integral_of_the_pressure(z, chord) -> None:
    a, g = 1500.0, 40_000.0
    front, side = (float(x) for x in tm.bulldozed((a, g), z, chord, 0.145))
    h = np.linspace(0.0, z, 2001)
    assert front == pytest.approx(0.145 * np.trapezoid(a + g * h, h), rel=1e-6)
    x = np.linspace(-chord, chord, 4001)
    deep = z * (1.0 - (x / chord) ** 2)
    assert side == pytest.approx(np.trapezoid(a * deep + 0.5 * g * deep**2, x), rel=1e-5)


@given(x=st.floats(0.02, 50.0))
def test_mean_shear_is_the_integral_of_janosi_and_hanamoto(x) -> None:
    j = np.linspace(0.0, x, 20_001)
    mean = np.trapezoid(1.0 - np.exp(-j), j) / x
    assert x * float(tm.shear_fraction_over_displacement(x)) == pytest.approx(mean, rel=1e-5)
    assert float(tm.mobilised(x, 1.0)) == pytest.approx(mean, abs=0.018)
    assert float(tm.mobilised(-x, 1.0)) == -float(tm.mobilised(x, 1.0))


@given(height=st.floats(0.0, 0.07))
def test_grousers_are_bekkers(height) -> None:
    shape = tm.WheelShape(0.175, 0.145, height, 40.0)
    cohesive, frictional = (float(x) for x in tm.grouser_gains(shape, 0.1))
    engaged = float(saturate(40.0 * 0.1 / (2.0 * np.pi * 0.175), 1.0))
    assert cohesive == pytest.approx(engaged * 2.0 * height / 0.145)
    arctan = np.arctan2(0.145, height)
    assert frictional == pytest.approx(engaged * 0.64 * height / 0.145 * arctan, rel=0.006)


def test_gain_of_grousers_grows_with_their_number_to_its_limit() -> None:
    wheels = [tm.WheelShape(0.175, 0.145, 0.02, count) for count in (0, 2, 6, 20, 200)]
    gains = [float(tm.grouser_gains(wheel, 0.1)[0]) for wheel in wheels]
    assert gains[0] == 0.0
    assert gains == sorted(gains)
    assert gains[-1] == pytest.approx(2.0 * 0.02 / 0.145, rel=1e-3)


@pytest.mark.parametrize("rim", [0.5, 1.0, 3.0])
def test_driven_slip_and_skid_are_the_usual_ratios(rim) -> None:
    assert float(tm.driven_slip(rim, 1.0, max(rim, 1.0))) == pytest.approx(max(0.0, 1 - 1 / rim), abs=0.01)
    assert float(tm.skid(rim, (1.0, 0.0))) == pytest.approx(max(0.0, 1.0 - rim), abs=0.01)
    assert float(tm.skid(rim, (0.0, 1.0))) == pytest.approx(1.0, abs=0.01)
    assert float(tm.skid(-10.0, (1.0, 0.0))) <= tm.SKID_LIMIT
    assert float(tm.skid(0.0, (0.0, 0.0))) < 0.01
    assert float(tm.driven_slip(0.0, 0.0, 1e-4)) < 0.01


def test_the_axle_behind_follows_and_which_one_that_is_turns_smoothly() -> None:
    def share(u: float, v: float, end: int) -> float:
        return float(tm.following(u, v, 0.42, 0.145, end))

    assert share(1.0, 0.0, -1) == pytest.approx(1.0, abs=0.01)
    assert share(1.0, 0.0, 1) < 1e-5
    assert share(-1.0, 0.0, 1) == pytest.approx(share(1.0, 0.0, -1))
    overlap = [0.145 * part / 0.42 for part in (0.25, 0.5, 0.75)]  # side speeds: tracks so many widths apart
    assert [share(1.0, v, -1) for v in overlap] == pytest.approx([0.75, 0.5, 0.25], abs=0.07)
    assert share(1.0, 0.3, -1) == share(1.0, -0.3, -1)
    speeds = np.linspace(-0.5, 0.5, 101)
    assert (np.diff([share(u, 0.0, -1) for u in speeds]) > 0.0).all()
    assert np.abs(np.diff([share(u, 0.0, -1) for u in speeds], 2)).max() < 0.05


@given(value=st.floats(0.0, 10.0))
def test_saturation_is_the_identity_below_and_the_limit_above(value) -> None:
    held = float(saturate(value, 1.0))
    assert held <= min(value, 1.0) + 1e-12
    assert held >= 0.91 * min(value, 1.0)


def test_a_cross_slope_makes_the_robot_slide_more_than_turn() -> None:
    """The rear wheels, in the rut, hold less than the front ones: it turns uphill, but slowly."""
    drive = Scenario("across", 8.0, drive=(DriveSegment(8.0, v_mps=1.0),), route=(RouteLeg("loose_sand"),))
    turned = []
    for cross in (10.0, -10.0):
        run = simulate_run(drive, cross_slope_deg=cross, noiseless=True)
        u, v, r = run.states[-1, 3:6]
        assert 0.06 < -np.sign(cross) * v / u < 0.15
        assert abs(r) < 0.03 * u
        turned.append(r)
    assert turned[0] == pytest.approx(-turned[1], rel=1e-6)


def test_rear_wheels_in_the_rut_save_energy_both_ways() -> None:
    sand = load_soil("loose_sand")
    bare = replace(sand, pressure=replace(sand.pressure, multipass=0.0))
    for speed in (0.8, -0.8):
        segment = DriveSegment(15.0, v_mps=speed)
        drive = Scenario("rut", 15.0, drive=(segment,), route=(RouteLeg("loose_sand"),))
        costs = [
            simulate_run(drive, soils={"loose_sand": soil}, noiseless=True).summary.energy_per_m_j
            for soil in (sand, bare)
        ]
        assert costs[0] < 0.95 * costs[1]


def test_a_skid_turn_in_sand_is_harder_with_bulldozing() -> None:
    sand = load_soil("loose_sand")
    turns = []
    for gain in (0.0, 8.0):
        soil = replace(sand, passive=replace(sand.passive, bulldozing=gain))
        spin = Scenario("spin", 10.0, drive=(DriveSegment(10.0, v_mps=0.6, yaw_rate_radps=0.5),),
                        route=(RouteLeg("loose_sand"),))  # fmt: skip
        turns.append(simulate_run(spin, soils={"loose_sand": soil}, noiseless=True).states[-1, INDEX["yaw"]])
    assert 0.0 < turns[1] < turns[0]
