"""What wrong antenna, delay of the fixes and course lag add to the reported covariance."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.robot import KnownNumber
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.place_doubt import HEADING_TIME_S, OpenHeading, PlaceDoubt, rounded
from terrafusion.fusion.graph.key_state import DIM, LINEAR, KeyState
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate

SPEED_MPS, DELAY_S, STEP_NS = 2.0, 0.1, 10**8
MOMENTS = np.array([0.0, 0.0, DELAY_S**2, 0.0])


def key(east_m: float = 0.0, yaw_rad: float = 0.5 * np.pi) -> KeyState:
    """A robot that drives east, whatever its heading."""
    pose = gtsam.Pose3(gtsam.Rot3.Rz(yaw_rad), [east_m, 0.0, 0.0])
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), np.zeros(3))
    return KeyState(pose, np.array([SPEED_MPS, 0.0, 0.0]), bias, np.zeros(len(LINEAR)))


def added(doubt: PlaceDoubt, state: KeyState, moments: np.ndarray = MOMENTS) -> np.ndarray:
    """What the doubt adds to the covariance (6, 6) of rotation and place, body axes."""
    return doubt.widened(np.zeros((DIM, DIM)), state.rotation, moments)[:6, :6]


def test_with_fixes_a_delay_moves_the_place_along_its_velocity() -> None:
    doubt = PlaceDoubt()
    doubt.step(STEP_NS, key(), 0.0, True)
    P = added(doubt, key())
    assert P[4, 4] == pytest.approx((SPEED_MPS * DELAY_S) ** 2)  # it heads north, and so drives to its right
    assert P.trace() == pytest.approx(P[4, 4])


def test_with_fixes_an_antenna_moves_the_place_in_body_axes() -> None:
    doubt = PlaceDoubt()
    doubt.step(STEP_NS, key(), 0.0, True)
    assert np.diag(added(doubt, key(), np.array([0.04, 0.01, 0.0, 0.0])))[3:5] == pytest.approx([0.04, 0.01])


@pytest.mark.parametrize("number", [2, 3])
def test_in_a_steady_turn_a_delay_or_a_course_lag_turns_the_heading(number: int) -> None:
    doubt, rate_radps, moments = PlaceDoubt(), 0.5, np.zeros(4)
    moments[number] = DELAY_S**2
    for i in range(1, 20):
        doubt.step(i * STEP_NS, key(), rate_radps, True)
    assert np.sqrt(added(doubt, key(), moments)[2, 2]) == pytest.approx(rate_radps * DELAY_S, rel=0.01)


def test_turns_to_both_sides_leave_the_heading() -> None:
    doubt = PlaceDoubt()
    for i in range(1, round(2.0 * HEADING_TIME_S * 1e9 / STEP_NS)):
        doubt.step(i * STEP_NS, key(), 0.5 if i % 100 < 50 else -0.5, True)
    assert np.sqrt(added(doubt, key())[2, 2]) < 0.1 * 0.5 * DELAY_S


def test_without_fixes_the_place_keeps_its_shift_and_moves_on_with_the_heading() -> None:
    doubt = PlaceDoubt()
    doubt.sensitivity = np.zeros((3, 4))
    doubt.sensitivity[[0, 2], 2] = -SPEED_MPS, -0.5
    doubt.step(STEP_NS, key(10.0, 0.0), 0.0, False)
    sigma = np.sqrt(np.diag(added(doubt, key(10.0, 0.0))))
    assert sigma[3:5] == pytest.approx([SPEED_MPS * DELAY_S, 10.0 * 0.5 * DELAY_S])


@pytest.fixture(scope="module")
def on_time() -> Recording:
    return until(simulate("figure_eight", terrain="asphalt", seed=300), 85.0)


def late(run: Recording, delay_s: float) -> Recording:
    assert run.gnss is not None
    gnss = dataclasses.replace(run.gnss, t_ns=run.gnss.t_ns + round(delay_s * 1e9))
    return dataclasses.replace(run, gnss=gnss)


def squares(result: ReplayResult, after_s: float = 30.0) -> np.ndarray:
    """Normalised squares of the position errors once the drive has shown the delay."""
    errors = result.scores.errors
    assert errors is not None
    return 2.0 * errors.nees()[errors.t_ns > result.recording.start_ns + round(after_s * 1e9)]


@pytest.mark.parametrize("batch", [False, True])
def test_the_ellipses_hold_where_fixes_of_rtk_are_late(on_time: Recording, batch: bool) -> None:
    """At one speed they are not corrected, as another antenna looks the same."""
    result = replay(late(on_time, 0.3), batch=batch)
    assert not any(n.corrects for n in result.learned if n.state == "gnss_delay_s")
    assert np.mean(squares(result) < 5.991) > 0.9


def test_fixes_on_time_stay_sharp(on_time: Recording) -> None:
    result = replay(on_time)
    assert result.estimate.trajectory.covariance is not None
    assert np.sqrt(result.estimate.trajectory.covariance[-1, :2, :2].trace()) < 0.04
    assert 0.7 < 0.5 * squares(result).mean() < 1.4


@pytest.mark.parametrize(("known", "inside"), [("assumed", True), ("measured", False)])
def test_the_ellipses_hold_an_antenna_that_is_only_assumed(
    on_time: Recording, known: str, inside: bool
) -> None:
    """Its place is 0.3 m off: the estimate is, too, until the drive shows it."""
    vehicle = load_vehicle("elevate")
    wrong = (vehicle.sensors.gnss.antenna_m[0] - 0.1, vehicle.sensors.gnss.antenna_m[1] - 0.3, 0.35)
    gnss = dataclasses.replace(vehicle.sensors.gnss, antenna_m=wrong)
    vehicle = dataclasses.replace(
        vehicle,
        sensors=dataclasses.replace(vehicle.sensors, gnss=gnss),
        robot=dataclasses.replace(vehicle.robot, antenna_m=KnownNumber(wrong, known)),
    )
    result = replay(until(on_time, 25.0), vehicle=vehicle)
    errors = result.scores.errors
    assert errors is not None
    begin = errors.t_ns < on_time.start_ns + 10_000_000_000
    share = float(np.mean(2.0 * errors.nees()[begin] < 5.991))
    assert (share > 0.9) is inside


def test_an_open_heading_turns_the_path_about_its_place() -> None:
    """The covariance of a turn by 1 sigma; where it is large, a circle that holds it for any turn."""
    states: list[State] = []
    estimator = Estimator(EstimatorConfig(load_vehicle("elevate").rig(), "elevate"), on_state=states.append)
    for message in simulate("straight", terrain="asphalt", seed=1).messages():
        estimator.add(message)
    state, place = states[-1], states[0].position_m
    away = state.position_m - place
    for sigma_rad in (0.05, 1.8):
        wider = OpenHeading(place, sigma_rad, 0).widened(state)
        more = wider.covariance - state.covariance
        assert more[5, 5] == pytest.approx(sigma_rad**2)
        assert more[:2, :2] @ away[:2] == pytest.approx([0.0, 0.0], abs=1e-9)
        assert more[:2, :2].trace() == pytest.approx(sigma_rad**2 * float(away[:2] @ away[:2]))
        circle = rounded(wider).covariance
        assert np.linalg.eigvalsh(circle).min() >= -1e-12
        assert (circle[0, 0] == circle[1, 1]) == (sigma_rad > 0.8)
