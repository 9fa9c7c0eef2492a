"""Samples at the door: what is refused, what is left out, and that the next valid one is used."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import time
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.messages import GnssSample, ImuSample, Message, WheelSample
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.notes import notes_of
from terrafusion.fusion.inputs.streams import ImuStream, WheelStream
from terrafusion.fusion.inputs.time_jumps import Newest, TimeJump
from terrafusion.fusion.inputs.validation import checked_fix, checked_time
from terrafusion.twin.scenario.scenario import DriveSegment, Scenario
from terrafusion.twin.simulate import simulate

HOUR_NS = 3600 * 10**9
G = [0.0, 0.0, 9.8]


@dataclasses.dataclass(frozen=True)
class Running:
    """An estimator in the middle of a drive, as a dump, and the messages that follow."""

    first: Estimator
    dump: bytes
    now_ns: int
    rest: list[Message]
    end_m: np.ndarray

    def again(self) -> Estimator:
        return Estimator.restore(self.first.config, self.dump)


@pytest.fixture(scope="module")
def running() -> Running:
    drive = (DriveSegment(2.0), DriveSegment(10.0, v_mps=1.0, yaw_rate_radps=0.1))
    messages = list(simulate(Scenario("short", 10.0, drive=drive), seed=1, vehicle="elevate").messages())
    cut = int(0.8 * len(messages))
    estimator = Estimator.for_vehicle("elevate")
    for message in messages[:cut]:
        estimator.add(message)
    dump = estimator.dump()
    for message in messages[cut:]:
        estimator.add(message)
    state = estimator.latest()
    assert state is not None
    return Running(estimator, dump, messages[cut - 1].t_ns, messages[cut:], state.position_m)


def finished(running: Running, estimator: Estimator) -> float:
    """Distance of the end from that of the clean drive, m."""
    for message in running.rest:
        estimator.add(message)
    state = estimator.latest()
    assert state is not None
    assert np.isfinite(state.covariance).all()
    return float(np.linalg.norm(state.position_m - running.end_m))


# --- times ---------------------------------------------------------------------------------------------


def test_times_are_integers_or_datetimes() -> None:
    assert checked_time(np.int64(5), "imu") == 5
    assert checked_time(np.datetime64("1970-01-01T00:00:01"), "imu") == 10**9


@pytest.mark.parametrize(
    "t", [None, 1.5, float("nan"), np.array([5]), "5", True, np.datetime64("NaT"), 2**70]
)
def test_what_is_no_time_is_refused(t: Any) -> None:
    fresh = Estimator.for_vehicle("elevate")
    for call in (
        lambda: fresh.add_imu(t, np.zeros(3), G),
        lambda: fresh.add_wheels(t, 0.0, 0.0),
        lambda: fresh.add_gnss(t, np.zeros(3), [0.1] * 3),
        lambda: fresh.add_command(t, 0.0),
        lambda: fresh.add_pressure(t, 1e5),
        lambda: fresh.add_magnetic_field(t, np.zeros(3)),
        lambda: fresh.add_terrain(t, {"asphalt": 1.0}),
    ):
        with pytest.raises(DataError, match="time"):
            call()


@pytest.mark.parametrize("ahead_ns", [HOUR_NS, 365 * 24 * HOUR_NS])
@pytest.mark.parametrize("channel", ["imu", "wheels", "gnss"])
def test_a_stamp_far_ahead_is_left_out_and_the_stream_goes_on(
    running: Running, channel: str, ahead_ns: int
) -> None:
    estimator, t = running.again(), running.now_ns + ahead_ns
    begun = time.process_time()
    if channel == "imu":
        estimator.add_imu(t, np.zeros(3), G)
    elif channel == "wheels":
        estimator.add_wheels(t, 1.0, 1.0)
    else:
        estimator.add_gnss(t, np.zeros(3), [0.02] * 3)
    assert time.process_time() - begun < 0.5
    assert finished(running, estimator) < 1e-9
    assert any(f" of {channel} left out" in note for note in notes_of(estimator))


@pytest.mark.parametrize("ahead_ns", [10 * 10**9, HOUR_NS])
@pytest.mark.parametrize("kind", [ImuSample, WheelSample])
def test_a_clock_that_leaps_for_a_while_is_not_followed_while_the_other_goes_on(
    running: Running, kind: type, ahead_ns: int
) -> None:
    estimator, until_ns = running.again(), running.now_ns + 10**9
    for message in running.rest:
        jumps = isinstance(message, kind) and message.t_ns < until_ns
        estimator.add(message._replace(t_ns=message.t_ns + ahead_ns) if jumps else message)
    state = estimator.latest()
    assert state is not None
    assert abs(state.t_ns - running.rest[-1].t_ns) < 10**9
    assert np.linalg.norm(state.position_m - running.end_m) < 0.1
    assert any("ahead of all others" in note for note in notes_of(estimator))


@pytest.mark.parametrize("back", [True, False])
@pytest.mark.parametrize("ahead_ns", [4 * 10**9, HOUR_NS])
def test_clocks_that_leap_together_are_not_followed_while_the_fixes_go_on(
    running: Running, ahead_ns: int, back: bool
) -> None:
    """As after a step of the clock of the computer: for a second, or for good."""
    estimator, until_ns = running.again(), running.now_ns + (10**9 if back else HOUR_NS)
    for message in running.rest:
        jumps = isinstance(message, (ImuSample, WheelSample)) and message.t_ns < until_ns
        estimator.add(message._replace(t_ns=message.t_ns + ahead_ns) if jumps else message)
    state = estimator.latest()
    assert state is not None
    if back:
        assert np.linalg.norm(state.position_m - running.end_m) < 0.1
    else:
        assert state.t_ns <= running.now_ns
    assert any("of imu left out: more than 1 s ahead" in note for note in notes_of(estimator))


def test_clocks_that_stay_ahead_of_the_fixes_are_an_error(running: Running) -> None:
    estimator, refused = running.again(), []
    for i, (message, again) in enumerate([(m, k) for k in range(4) for m in running.rest]):
        later_ns = again * (running.rest[-1].t_ns - running.now_ns)
        jumps = isinstance(message, (ImuSample, WheelSample))
        try:
            estimator.add(message._replace(t_ns=message.t_ns + later_ns + jumps * HOUR_NS))
        except DataError as error:
            refused.append((i, str(error)))
    assert refused
    assert refused[0][0] > len(running.rest), "not at once: it may come back"
    assert re.search(r"360\d\.\d s ahead of the fixes, .* start anew", refused[0][1])


@pytest.mark.parametrize("fixes", ["jump, too", "are missing"])
def test_clocks_that_leap_together_are_followed_where_no_fix_contradicts(
    running: Running, fixes: str
) -> None:
    estimator = running.again()
    for message in running.rest:
        if fixes == "jump, too" or not isinstance(message, GnssSample):
            estimator.add(message._replace(t_ns=message.t_ns + HOUR_NS))
    state = estimator.latest()
    assert state is not None
    assert state.t_ns > running.now_ns + HOUR_NS


@pytest.mark.parametrize("ahead_s", [1.5, 4.0, 9.0])
def test_a_fix_with_a_stamp_some_seconds_ahead_is_left_out(running: Running, ahead_s: float) -> None:
    """It would be used as soon as the robot is there in time, and believed where sigma has grown."""
    estimator, plain = running.again(), running.again()
    ahead_ns = running.now_ns + round(ahead_s * 1e9)
    fixes = iter([m for m in running.rest if isinstance(m, GnssSample)][:1])
    for message in running.rest:
        if isinstance(message, GnssSample):  # an outage but for one fix
            message = next(fixes, None)
            if message is not None:
                estimator.add(message._replace(t_ns=ahead_ns))
                estimator.add(message)
                plain.add(message)
            continue
        estimator.add(message)
        plain.add(message)
    a, b = estimator.latest(), plain.latest()
    assert a is not None
    assert b is not None
    np.testing.assert_array_equal(a.position_m, b.position_m)
    assert any(note.startswith("1 GNSS fix left out: more than 1 s ahead") for note in notes_of(estimator))


def test_fixes_of_a_receiver_whose_clock_is_ahead_are_used(running: Running) -> None:
    estimator, count = running.again(), 0
    for message in running.rest:
        if isinstance(message, GnssSample):
            message = message._replace(t_ns=message.t_ns + 15 * 10**8)
            count += 1
        estimator.add(message)
    assert count > 5
    assert estimator.fixes.dropped == 0
    assert len(estimator.fixes.held) < 3


@pytest.mark.parametrize("wrong", [1, 3, 7])
def test_a_wrong_stamp_among_the_first_opens_the_door_to_no_other(wrong: int) -> None:
    """Until some steps of time are known, any would do: one that is wrong would permit all after it."""
    wheels = WheelStream()
    imu = ImuStream(newest=wheels.late.jump.newest)
    for i in range(400):
        ahead_ns = 2_640_000_000 if i == wrong or i % 100 == 50 else 0
        imu.add(i * 10**7 + ahead_ns, np.zeros(3), G)
        if i % 2 == 0:
            wheels.add(i * 10**7, 1.0, 1.0)
    assert imu.late.jump.dropped == 5
    assert imu.t_ns == [i * 10**7 for i in range(400) if i != wrong and i % 100 != 50]
    assert len(wheels.t_ns) == 200


@pytest.mark.parametrize("ahead_s", [1.5, 4.0, 6.0, 9.0])
@pytest.mark.parametrize("channel", ["imu", "wheels"])
def test_a_stamp_some_seconds_ahead_costs_nothing(running: Running, channel: str, ahead_s: float) -> None:
    estimator, t = running.again(), running.now_ns + round(ahead_s * 1e9)
    if channel == "imu":
        estimator.add_imu(t, np.zeros(3), G)
    else:
        estimator.add_wheels(t, 1.0, 1.0)
    assert finished(running, estimator) < 1e-9
    assert any(f"1 sample of {channel} left out: more than" in note for note in notes_of(estimator))


def test_one_sample_that_is_seconds_old_delays_nothing(running: Running) -> None:
    estimator = running.again()
    estimator.add_imu(running.now_ns - 4 * 10**9, np.zeros(3), G)
    assert finished(running, estimator) < 1e-9


def test_a_slow_stream_has_no_leaps() -> None:
    """Of samples 2 s apart, as of the only sensor of a log, none is lost, and few wait for another."""
    jump = TimeJump(Newest())
    admitted = [jump.admitted((i * 2 * 10**9,)) for i in range(30)]
    assert [len(some) for some in admitted[:4]] == [1, 0, 0, 3]
    assert sum(map(len, admitted)) == 30
    assert jump.dropped == 0


def test_a_pause_of_an_hour_takes_no_longer_than_a_second_and_its_sigma_covers_it(running: Running) -> None:
    estimator = running.again()
    widest, slowest, count = 0.0, 0.0, 0
    for message in running.rest:
        begun, before = time.process_time(), estimator.latest()
        estimator.add(message._replace(t_ns=message.t_ns + HOUR_NS))
        slowest = max(slowest, time.process_time() - begun)
        state = estimator.latest()
        assert state is not None
        count += state is not before
        widest = max(widest, float(np.sqrt(state.covariance[0, 0])))
    assert slowest < 1.0
    assert count < 40
    assert widest > 1000.0, "an hour at walking speed"
    assert estimator.latest().covariance[0, 0] < 0.1, "the fixes place it again"  # type: ignore[union-attr]


@pytest.mark.parametrize("ahead_ns", [2 * 10**9, 10 * HOUR_NS])
def test_a_first_stamp_that_was_wrong_does_not_lock_a_stream(ahead_ns: int) -> None:
    wheels, imu = WheelStream(), ImuStream()
    wheels.add(ahead_ns, 1.0, 1.0)
    imu.add(ahead_ns, np.zeros(3), G)
    for i in range(5):
        wheels.add(i * 10**8, 1.0, 1.0)
        imu.add(i * 10**8, np.zeros(3), G)
    assert wheels.t_ns == imu.t_ns == [i * 10**8 for i in range(5)]
    assert wheels.late.jump.dropped == imu.late.jump.dropped == 1


@given(st.lists(st.tuples(st.integers(0, 3), st.booleans()), max_size=40))
def test_lone_leaps_are_dropped_and_a_pause_loses_nothing(pattern: list[tuple[int, bool]]) -> None:
    """Samples a tenth apart, of which some are an hour ahead, never three in a row."""
    jump, admitted, t, in_a_row, lone = TimeJump(Newest()), [], 0, 0, 0
    jump.admitted((0,))
    for step, ahead in pattern:
        t += step * 10**8
        in_a_row = in_a_row + 1 if ahead and in_a_row < 2 else 0
        lone += in_a_row > 0
        admitted += jump.admitted((t + HOUR_NS if in_a_row else t,))
    admitted += jump.admitted((t,))
    assert all(one[0] < HOUR_NS for one in admitted)
    assert jump.dropped == lone
    resumed = [one for i in range(8) for one in jump.admitted((2 * HOUR_NS + i * 10**8,))]
    assert len(resumed) == 8


# --- values --------------------------------------------------------------------------------------------

NUMBERS = st.one_of(
    st.floats(),
    st.sampled_from([1e300, -1e300, 1e-300, 9000.0, 1e6, float("inf"), float("nan"), None, "x", [1.0], True]),
)
TIMES = st.one_of(st.integers(-(10**10), 10**10), st.sampled_from([None, 0.5, HOUR_NS, -HOUR_NS, 2**80]))
THREE = st.one_of(st.lists(NUMBERS, min_size=3, max_size=3), NUMBERS)
CALLS = st.one_of(
    st.tuples(st.just("add_imu"), THREE, THREE),
    st.tuples(st.just("add_wheels"), NUMBERS, NUMBERS, NUMBERS, NUMBERS),
    st.tuples(
        st.just("add_gnss"), THREE, THREE, THREE, NUMBERS, st.sampled_from([None, "fixed", 1, 99, "?", 1.5])
    ),
    st.tuples(st.just("add_command"), NUMBERS),
    st.tuples(st.just("add_pressure"), NUMBERS),
    st.tuples(st.just("add_magnetic_field"), THREE),
    st.tuples(st.just("add_terrain"), st.just({"asphalt": 1.0})),
)


@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(st.tuples(CALLS, TIMES), min_size=1, max_size=3))
def test_whatever_comes_is_used_left_out_or_a_data_error(
    running: Running, calls: list[tuple[tuple[Any, ...], Any]]
) -> None:
    """And the estimator goes on with the valid samples that follow."""
    estimator = running.again()
    for (method, *values), t in calls:
        at = running.now_ns + t if isinstance(t, int) else t
        with contextlib.suppress(DataError):
            getattr(estimator, method)(at, *values)
    for message in running.rest[:60]:
        with contextlib.suppress(DataError):  # a stream whose clock was set on waits for it
            estimator.add(message)
    state = estimator.latest()
    assert state is not None
    assert np.isfinite(state.position_m).all()
    assert np.isfinite(state.covariance).all()


@pytest.mark.parametrize("gyro", [1e6, 1e300])
def test_rates_beyond_any_gyro_are_left_out(running: Running, gyro: float) -> None:
    estimator = running.again()
    estimator.add_imu(running.now_ns + 10**6, [0.0, 0.0, gyro], G)
    assert finished(running, estimator) < 1e-9
    assert "1 sample of imu beyond 100 rad/s or 2000 m/s2 left out: no robot moves so" in notes_of(estimator)


def test_wheels_beyond_any_robot_are_left_out(running: Running) -> None:
    estimator = running.again()
    estimator.add_wheels(running.now_ns + 10**6, 1e300, 1e300)
    estimator.add_wheels(running.now_ns + 10**6, 1.0, 1.0, 1e300, 1e300)
    assert finished(running, estimator) < 1e-9
    assert any(note.startswith("2 samples of wheels beyond") for note in notes_of(estimator))


@pytest.mark.parametrize("probabilities", [None, "asphalt", {"asphalt": "x"}, {"asphalt": None}, {1: 1.0}])
def test_what_names_no_grounds_is_a_data_error(running: Running, probabilities: Any) -> None:
    with pytest.raises(DataError, match="terrain"):
        running.again().add_terrain(running.now_ns, probabilities)


def test_pictures_of_ground_passed_seconds_ago_are_left_out(running: Running) -> None:
    """A network that was down passes on what it held."""
    estimator = running.again()
    before = estimator.weights.posterior()
    for k in range(30):
        estimator.add_terrain(running.now_ns - (40 - k) * 10**9, {"mud": 1.0})
    assert estimator.weights.posterior() == before
    assert "30 samples of terrain left out: too far from the time of IMU and wheels" in notes_of(estimator)
    estimator.add_terrain(running.now_ns - 10**9, {"mud": 1.0})
    assert estimator.weights.posterior() != before


@pytest.mark.parametrize("at", [0.02, 0.9])
@pytest.mark.parametrize("off_m", [1e8, -3000.0])
def test_counters_that_are_reset_or_leap_cost_nothing(at: float, off_m: float) -> None:
    drive = (DriveSegment(2.0), DriveSegment(10.0, v_mps=1.0, yaw_rate_radps=0.1))
    log = simulate(Scenario("short", 10.0, drive=drive), seed=1, vehicle="elevate")
    wheels = log.wheels
    assert wheels is not None
    assert wheels.angle_rad is not None
    angle = wheels.angle_rad.copy()
    angle[int(at * len(angle)) :] += off_m / 0.1
    reset = dataclasses.replace(log, wheels=dataclasses.replace(wheels, angle_rad=angle))
    ends = []
    for one in (log, reset):
        estimator = Estimator.for_vehicle("elevate")
        for message in one.messages():
            estimator.add(message)
        state = estimator.latest()
        assert state is not None
        ends.append(state.position_m)
        assert any("counters jumped once" in note for note in notes_of(estimator)) == (one is reset)
    assert np.linalg.norm(ends[1] - ends[0]) < 0.02


def test_the_numbers_of_a_fix() -> None:
    endless = checked_fix(0, [1.0, 2.0, np.inf], [0.1, 0.1, 0.1], None, np.nan, None)
    assert endless is not None
    assert np.isnan(endless.enu_m[2]), "a height that is none is free"
    plain = checked_fix(0, np.zeros(3), 0.02, None, np.nan, "fixed")
    assert plain is not None
    assert plain.sigma_m.tolist() == [0.02] * 3, "one number is that of all axes"
    with pytest.raises(DataError, match="neither one number nor three"):
        checked_fix(0, np.zeros(3), [0.1, 0.1], None, np.nan, "fixed")
    tiny = checked_fix(0, np.zeros(3), [1e-300] * 3, None, np.nan, None)
    assert tiny is not None
    assert tiny.sigma_m.tolist() == [1e-3] * 3
    assert checked_fix(0, np.zeros(3), [1e300] * 3, None, np.nan, None) is None
    with pytest.raises(DataError, match="beyond the earth"):
        checked_fix(0, [1e300, 0.0, 0.0], [0.1] * 3, None, np.nan, None)
