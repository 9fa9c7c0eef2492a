"""Coulomb friction under four wheels: limits, signs, energy, and an exact solution to compare with."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from terrafusion.fusion.graph.coulomb import SLIP_SPEED_MPS, skid_motion

Array = NDArray[np.float64]

TRACK_M = 1.1
speeds = st.floats(-4.0, 4.0)
rates = st.floats(-1.5, 1.5)
grips = st.floats(0.3, 8.0)


def one(
    velocity: tuple[float, float], left: float, right: float, rate: float, grip: float, dt_s: float = 0.1
) -> tuple[Array, Array]:
    ends, ways = skid_motion(np.array([velocity]), left, right, rate, np.array([grip]), TRACK_M, dt_s)
    return ends[0], ways[0]


def exact(
    velocity: tuple[float, float], left: float, right: float, rate: float, grip: float, dt_s: float
) -> tuple[Array, Array]:
    """The law of the module's docstring in a frame that does not turn, by another integrator."""
    half = 0.5 * TRACK_M

    def change(t: float, x: Array) -> Array:
        c, s = np.cos(rate * t), np.sin(rate * t)
        forward, across = c * x[2] + s * x[3], c * x[3] - s * x[2]
        pull = np.zeros(2)
        for side, wheel in ((half, left), (-half, right)):
            for end in (half, -half):
                slip = np.array([forward - rate * side - wheel, across + rate * end])
                pull -= 0.25 * grip * slip / np.sqrt(slip @ slip + SLIP_SPEED_MPS**2)
        return np.array([x[2], x[3], c * pull[0] - s * pull[1], s * pull[0] + c * pull[1]])

    x = solve_ivp(change, (0.0, dt_s), [0.0, 0.0, *velocity], rtol=1e-9, atol=1e-9).y[:, -1]
    c, s = np.cos(rate * dt_s), np.sin(rate * dt_s)
    return np.array([c * x[2] + s * x[3], c * x[3] - s * x[2]]), x[:2]


@given(speeds, speeds, grips)
def test_locked_wheels_take_energy_and_never_turn_the_robot_round(u: float, v: float, grip: float) -> None:
    end, _ = one((u, v), 0.0, 0.0, 0.0, grip)
    assert np.hypot(*end) <= np.hypot(u, v) + 1e-12
    assert end @ np.array([u, v]) >= 0.0


@given(speeds, grips)
def test_a_robot_that_goes_as_its_wheels_roll_feels_no_force(speed: float, grip: float) -> None:
    end, way = one((speed, 0.0), speed, speed, 0.0, grip)
    assert end == pytest.approx([speed, 0.0], abs=1e-12)
    assert way == pytest.approx([0.1 * speed, 0.0], abs=1e-12)


@given(speeds, speeds, speeds, speeds, rates, grips)
def test_no_more_than_the_grip_changes_the_speed(
    u: float, v: float, left: float, right: float, rate: float, grip: float
) -> None:
    end, _ = one((u, v), left, right, rate, grip)
    c, s = np.cos(0.1 * rate), np.sin(0.1 * rate)
    carried = np.array([c * u + s * v, c * v - s * u])
    assert np.hypot(*(end - carried)) <= 0.1 * grip * (1.0 + 1e-9)


@given(speeds, speeds, speeds, speeds, rates, grips)
def test_the_law_knows_neither_left_from_right_nor_ahead_from_behind(
    u: float, v: float, left: float, right: float, rate: float, grip: float
) -> None:
    end, way = one((u, v), left, right, rate, grip)
    mirrored, mirrored_way = one((u, -v), right, left, -rate, grip)
    assert mirrored == pytest.approx(end * [1, -1], abs=1e-9)
    assert mirrored_way == pytest.approx(way * [1, -1], abs=1e-9)
    backward, backward_way = one((-u, v), -left, -right, -rate, grip)
    assert backward == pytest.approx(end * [-1, 1], abs=1e-9)
    assert backward_way == pytest.approx(way * [-1, 1], abs=1e-9)


@given(speeds, st.floats(-1.0, 1.0), speeds, speeds, rates, st.sampled_from([0.5, 1.0, 2.0]))
def test_a_step_of_a_keyframe_is_the_law_s_own(
    u: float, v: float, left: float, right: float, rate: float, grip: float
) -> None:
    """Two implicit steps of 0.05 s against an integrator that keeps 1e-9."""
    end, way = one((u, v), left, right, rate, grip)
    true_end, true_way = exact((u, v), left, right, rate, grip, 0.1)
    assert np.abs(way - true_way).max() < 0.003
    assert np.abs(end - true_end).max() < 0.06


def test_wheels_that_turn_the_robot_hold_less_against_a_slide_outwards() -> None:
    outwards = (2.0, 0.5)
    straight, _ = one(outwards, 2.0, 2.0, 0.0, 2.0)
    spun, _ = one(outwards, 0.5, 3.5, 0.0, 2.0)  # the sides slip against each other, the robot does not turn
    assert straight[1] < spun[1] < 0.5


def test_with_good_grip_the_robot_soon_goes_as_its_wheels() -> None:
    velocity = np.array([[0.0, 1.0]])
    for _ in range(10):
        velocity, _ = skid_motion(velocity, 1.0, 1.0, 0.0, np.array([6.0]), TRACK_M, 0.1)
    assert velocity[0] == pytest.approx([1.0, 0.0], abs=1e-3)
