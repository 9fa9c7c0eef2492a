"""What a wheel increment says of slip, and how its noise is raised."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.fusion.graph.factors import wheel_increment
from terrafusion.fusion.graph.key_state import LINEAR, NAV, SLIP, SURGE_SLIP
from terrafusion.fusion.graph.wheel_factor import MOVED_M, WheelIncrement, slip_of
from terrafusion.fusion.inputs.streams import ImuSegment
from terrafusion.fusion.noise.policy import load_policy

SIGMA = np.array([0.03, 0.05, 0.05, 0.01])


def increment(distance_m: float = 0.1, surge_m: float = 0.0, skid_m: float = 0.0) -> WheelIncrement:
    moved = np.array([distance_m, 0.0, 0.0])
    return WheelIncrement(moved, SIGMA, distance_m, 0.0, surge_m=surge_m, skid_m=skid_m, speed_change_mps=0.2)


@pytest.mark.parametrize("distance_m", [0.1, -0.1, 0.5 * MOVED_M])
def test_slip_is_the_share_of_the_rolled_distance_that_is_lost(distance_m: float) -> None:
    linear = np.zeros(len(LINEAR))
    linear[SLIP - NAV.stop], linear[SURGE_SLIP - NAV.stop] = 0.2, 0.5
    rolled, skid_m, surge_m = distance_m, 0.25 * distance_m, 0.1 * distance_m
    lost = 0.2 * (rolled - skid_m) + skid_m + 0.5 * surge_m
    expected = lost / rolled if abs(rolled) > MOVED_M else 0.2  # of hardly any distance, the state alone
    assert slip_of(linear, increment(distance_m, surge_m, skid_m)) == pytest.approx(expected)


def test_doubt_raises_the_variance_along_the_path_and_of_the_turn_by_its_factor() -> None:
    variance_m2, times = 0.03**2 + 0.02**2, 9.0  # of the innovation: the increment's and the state's
    doubted = increment().doubted(variance_m2, times)
    assert doubted.sigma[0] ** 2 + 0.02**2 == pytest.approx(times * variance_m2)
    assert doubted.sigma[3] / SIGMA[3] == pytest.approx(doubted.sigma[0] / SIGMA[0])
    np.testing.assert_array_equal(doubted.sigma[1:3], SIGMA[1:3])
    assert doubted.speed_change_mps == 0.2
    assert increment().doubted(variance_m2, np.inf).speed_change_mps == 0.0


def test_extra_variance_lies_in_the_plane() -> None:
    sigma = increment().with_extra_variance(0.04**2).sigma
    np.testing.assert_allclose(sigma, [0.05, np.hypot(0.05, 0.04), 0.05, 0.01])
    assert increment().without_turn().sigma.tolist() == [0.03, 0.05, 0.05, np.inf]


@given(st.floats(-2.0, 2.0), st.floats(-1.5, 1.5), st.floats(0.0, 0.3))
def test_a_course_that_lags_is_turned_outwards_by_the_lag_times_the_rate(
    speed_mps: float, rate_radps: float, lag_s: float
) -> None:
    dt = 0.1
    segment = ImuSegment(dt, np.array([0.0, 0.0, rate_radps]), np.zeros(3))
    rolled = (speed_mps * dt, speed_mps * dt)

    def moved(lag_s: float) -> np.ndarray:
        noise = load_policy().fixed
        return wheel_increment(
            rolled, [segment], 0.0, 1.0, 0.0, noise, course_lag_s=(lag_s, 0.2)
        ).displacement_m

    outwards_m = -lag_s * rate_radps * speed_mps * dt
    assert np.allclose(moved(lag_s) - moved(0.0), [0.0, outwards_m, 0.0], atol=1e-12)
    assert outwards_m * rate_radps * speed_mps <= 0.0  # against the acceleration towards the centre
