"""Priors and processes of the linear states: limits and signs."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.fusion.graph import slow_states
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.gauss_markov import MarkovStep
from terrafusion.fusion.graph.key_state import LINEAR, KeyState
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.noise.policy import load_policy

ROWS = load_policy().classes
SAND = ROWS["loose_sand"]
SLIP, SIDE, SURGE, ICR = (LINEAR.index(name) for name in ("slip", "side_slip", "surge_slip", "icr_x_m"))
LEVEL = np.array([0.0, 0.0, 1.0])


def rolling(speed_mps: float, change_mps: float = 0.0) -> WheelIncrement:
    distance = 0.1 * speed_mps
    return WheelIncrement(
        np.array([distance, 0.0, 0.0]), np.ones(4), distance, 0.0, speed_change_mps=change_mps
    )


def step(
    wheels: WheelIncrement | None, up: np.ndarray = LEVEL, switch: float = 0.0, dt_s: float = 0.1
) -> MarkovStep:
    return slow_states.step(dt_s, SAND, up, 0.02, 100.0, switch, wheels)


def test_slip_lasts_while_the_wheels_keep_their_speed() -> None:
    steady = step(rolling(1.0))
    time_s = -0.1 / np.log(steady.decay[SLIP])
    assert time_s == pytest.approx(slow_states.SLIP_STEADY * SAND.slip_time_s)
    assert step(None).decay[SLIP] == steady.decay[SLIP]
    assert step(rolling(1.0, 0.01)).sigma[SLIP] < 1.3 * steady.sigma[SLIP]


def test_a_start_and_a_new_ground_renew_slip() -> None:
    for renewed in (step(rolling(0.05, 0.1)), step(rolling(1.0), switch=1.0)):
        assert renewed.decay[SLIP] == pytest.approx(0.0)
        assert renewed.sigma[SLIP] == pytest.approx(SAND.slip_sigma)
    assert step(rolling(0.05, 0.1)).decay[SIDE] == step(rolling(1.0)).decay[SIDE]


@given(speed=st.floats(-3, 3), change=st.floats(-3, 3), switch=st.floats(0, 1))
def test_a_step_keeps_the_stationary_spread(speed: float, change: float, switch: float) -> None:
    taken = step(rolling(speed, change), switch=switch)
    assert 0.0 <= taken.decay[SLIP] <= 1.0
    variance = taken.decay[SLIP] ** 2 * SAND.slip_sigma**2 + taken.sigma[SLIP] ** 2
    assert variance == pytest.approx(SAND.slip_sigma**2, rel=1e-6)
    assert taken.sigma[SLIP] == pytest.approx(step(rolling(-speed, -change), switch=switch).sigma[SLIP])


@given(speed=st.floats(-3, 3), lag_s=st.floats(0, 0.5))
def test_the_centre_of_rotation_of_wheels_that_skid_moves_with_the_speed(speed: float, lag_s: float) -> None:
    taken = step(dataclasses.replace(rolling(speed), course_lag_sigma_s=lag_s))
    variance = taken.sigma[ICR] ** 2 / (1.0 - taken.decay[ICR] ** 2)
    assert variance == pytest.approx(slow_states.ICR_SIGMA_M**2 + (lag_s * speed) ** 2)


def test_a_robot_that_backs_down_a_slope_slips_as_one_that_drives_down() -> None:
    up, down = np.array([0.1, 0.0, 0.995]), np.array([-0.1, 0.0, 0.995])
    assert step(rolling(-1.0), up).mean[SLIP] == step(rolling(1.0), down).mean[SLIP] == SAND.slip_at(-0.1)
    assert step(rolling(-1.0), down).mean[SLIP] == step(rolling(1.0), up).mean[SLIP] == SAND.slip_at(0.1)


@given(roll=st.floats(-0.4, 0.4))
def test_on_a_cross_slope_the_robot_slips_downhill_whichever_way_it_drives(roll: float) -> None:
    up = np.array([0.0, np.sin(roll), np.cos(roll)])  # the left side is up where roll is positive
    forwards, backwards = (step(rolling(v), up) for v in (1.0, -1.0))
    assert forwards.mean[SIDE] == -backwards.mean[SIDE]
    assert forwards.mean[SIDE] * roll <= 0.0
    mirrored = step(rolling(1.0), up * [1.0, -1.0, 1.0])
    assert forwards.mean[SIDE] == -mirrored.mean[SIDE]
    assert forwards.sigma[SIDE] == mirrored.sigma[SIDE] >= step(rolling(1.0)).sigma[SIDE]


@pytest.mark.parametrize("row", ROWS.values(), ids=ROWS)
def test_acceleration_is_expected_to_slip_as_a_grade_does_and_the_ground_to_change_it(row) -> None:
    mean, sigma = slow_states.prior(row, 0.0, 0.02)
    assert mean[SURGE] == row.slip_per_grade
    assert sigma[SURGE] == pytest.approx(slow_states.SURGE_DOUBT * abs(row.slip_per_grade), abs=2e-3)
    for switch, kept in ((0.0, np.exp(-0.1 / slow_states.SURGE_TIME_S)), (1.0, 0.0)):
        taken = slow_states.step(0.1, row, LEVEL, 0.02, 100.0, switch)
        assert taken.decay[SURGE] == pytest.approx(kept)
        assert taken.mean[SURGE] == row.slip_per_grade
        assert np.hypot(taken.sigma[SURGE], kept * sigma[SURGE]) == pytest.approx(sigma[SURGE])


def test_slip_is_expected_uphill_and_side_slip_is_not() -> None:
    pitch = 0.1
    uphill = step(rolling(1.0), np.array([np.sin(pitch), 0.0, np.cos(pitch)]))
    assert uphill.mean[SLIP] == pytest.approx(SAND.slip_at(np.sin(pitch)))
    assert uphill.mean[SIDE] == 0.0


@pytest.mark.parametrize("row", ROWS.values(), ids=ROWS)
def test_what_a_robot_keeps_hardly_moves_in_an_hour(row) -> None:
    _, prior = slow_states.prior(row, 0.0, 0.02)
    hour = slow_states.step(3600.0, row, LEVEL, 0.02, 100.0, 0.0)
    kept = slice(LINEAR.index("radius_scale"), LINEAR.index("surge_slip"))
    assert hour.decay[kept] == pytest.approx(1.0)
    assert np.all(hour.sigma[kept] < 0.02 * prior[kept])


def chain_of(keyframes: int, first_ns: int = 0) -> Chain:
    chain = Chain()
    point = KeyState(gtsam.Pose3(), np.zeros(3), gtsam.imuBias.ConstantBias(), np.zeros(len(LINEAR)))
    for k in range(keyframes):
        chain.append(first_ns + k * 10**8, point, markov=step(rolling(1.0)) if k else None)
    return chain


def test_a_change_seen_late_may_have_been_at_any_keyframe_since() -> None:
    chain, steady = chain_of(6), step(rolling(1.0)).decay[SLIP]
    drift = slice(1, 3)
    chain.revise(3, chain.nodes[3].markov.restarted(drift))  # another class of fix
    slow_states.inflate_slip_covariance(chain, 2 * 10**8, 0.1, SAND, 0.02, 100.0, 0.9)
    decays = np.array([node.markov.decay[SLIP] for node in chain.nodes[1:]])
    assert decays[0] == steady, "before the change nothing is new"
    assert np.ptp(decays[1:]) < 1e-12
    assert np.prod(decays[1:] / steady) == pytest.approx(0.1), "in all it forgets the share that switched"
    assert chain.nodes[3].markov.decay[drift].tolist() == [0.0, 0.0]
    slow_states.inflate_slip_covariance(chain, 2 * 10**8, 0.1, SAND, 0.02, 100.0, 0.2)
    again = [node.markov.decay[SLIP] for node in chain.nodes[2:]]
    assert again == decays[1:].tolist(), "a smaller change later closes nothing"


def test_a_change_older_than_what_is_held_is_spread_over_all_that_is() -> None:
    chain = chain_of(3, first_ns=5 * 10**8)
    slow_states.inflate_slip_covariance(chain, 0, 0.1, SAND, 0.02, 100.0, 1.0)
    for node in chain.nodes[1:]:
        assert node.markov.decay[SLIP] == pytest.approx(np.sqrt(1.0 - slow_states.MOST_SWITCH), rel=0.01)


def test_what_is_assumed_of_a_robot_before_any_data() -> None:
    """The priors of the vehicle file's numbers, as docs/explanation/calibration-states.md has them, and how
    long what a ground gives lasts."""
    mean, sigma = slow_states.prior(SAND, 0.1, 0.02)
    told = dict(zip(LINEAR, sigma.tolist(), strict=True))
    assert [told[name] for name in slow_states.CALIBRATION_SIGMA] == [
        0.02,
        0.05,
        0.05,
        *[0.02] * 3,
        0.03,
        0.1,
    ]
    assert mean[SLIP] == SAND.slip_at(0.1)
    assert mean[LINEAR.index("yaw_scale")] == SAND.yaw_scale_mean
    assert told["yaw_scale"] == pytest.approx(np.hypot(SAND.yaw_scale_sigma, 0.2))
    assert (told["icr_x_m"], told["side_slip"]) == (0.1, pytest.approx(0.3 * SAND.side_slip_sigma))
    assert np.count_nonzero(sigma == 0.02) == 2 + 4  # the receiver's drift east and north
    taken = step(rolling(1.0))
    lasting_s = -0.1 / np.log(taken.decay[[LINEAR.index(n) for n in ("yaw_scale", "icr_x_m", "side_slip")]])
    assert lasting_s == pytest.approx([60.0, 60.0, 5.0])


def test_side_slip_and_renewal_are_in_proportion() -> None:
    """Downhill by .7 of what a grade as steep costs, doubted by .3; x of the speed renews 1.1 x^2 of slip."""
    up = np.array([0.0, 0.1, np.sqrt(0.99)])
    taken, level = step(rolling(1.0), up), step(rolling(1.0))
    downhill = -0.7 * SAND.slip_per_grade * 0.1
    assert taken.mean[SIDE] == pytest.approx(downhill)
    kept = level.decay[SIDE]
    spread = [np.sqrt(one.sigma[SIDE] ** 2 / (1.0 - kept**2)) for one in (taken, level)]
    assert spread[0] == pytest.approx(np.hypot(spread[1], 0.3 * downhill))
    changed = step(rolling(2.0, 0.2))
    assert changed.decay[SLIP] / level.decay[SLIP] == pytest.approx(1.0 - 1.1 * 0.1**2)
    crawling = step(rolling(0.05, 0.02))  # as of .1 m/s
    assert crawling.decay[SLIP] / level.decay[SLIP] == pytest.approx(1.0 - 1.1 * 0.2**2)
    both = step(rolling(2.0, 0.2), switch=0.5)
    assert both.decay[SLIP] / level.decay[SLIP] == pytest.approx(0.5 * (1.0 - 0.011))
