"""What drivers do: refill buffers, send twice, late or without numbers, pause, and change what they get."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.messages import GnssSample
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.inputs.streams import WheelStream
from terrafusion.twin.simulate import simulate

GRAVITY = np.array([0.0, 0.0, 9.81])


@pytest.fixture
def husky() -> Estimator:
    return Estimator.for_vehicle("husky")


@pytest.fixture(scope="module")
def drive() -> Recording:
    return simulate("figure_eight", vehicle="husky", terrain="asphalt", seed=5)


def test_a_buffer_may_be_filled_again(husky: Estimator) -> None:
    buffer = np.zeros(3)
    for k in range(3):
        buffer[0] = k
        husky.add_gnss(10**9 * (k + 1), buffer, 0.02)
    assert [float(fix.enu_m[0]) for fix in husky.gnss.waiting] == [0.0, 1.0, 2.0]


def test_a_state_belongs_to_the_caller(husky: Estimator) -> None:
    husky.set_start([0.0, 0.0, 0.0], 0.0)
    for k in range(300):
        husky.add_wheels(k * 10**7, 1.0, 1.0)
        husky.add_imu(k * 10**7, np.zeros(3), GRAVITY)
    state, key = husky.latest(), husky.chain.state(husky.chain.last)
    assert state is not None
    before = key.velocity.copy(), key.linear.copy()
    state.velocity_mps[:] = 99.0
    state.linear[:] = 99.0
    np.testing.assert_array_equal(key.velocity, before[0])
    np.testing.assert_array_equal(key.linear, before[1])


def test_a_caller_may_reset_it_on_a_state() -> None:
    """Where the estimate is doubtful, say; the next keyframe was looked for in an empty graph."""
    states: list[State] = []

    def took(state: State) -> None:
        states.append(state)
        if len(states) == 40:
            husky.reset()
            husky.set_start([5.0, 0.0, 0.0], 0.0)

    husky = Estimator(Estimator.for_vehicle("husky").config, on_state=took)
    husky.set_start([0.0, 0.0, 0.0], 0.0)
    for k in range(1000):
        husky.add_wheels(k * 10**7, 1.0, 1.0)
        husky.add_imu(k * 10**7, np.zeros(3), GRAVITY)
    assert len(states) > 60
    assert states[39].position_m[0] > 2.0
    assert 5.0 < states[40].position_m[0] < 6.5  # after the second in which it aligns
    husky.finish()


def test_a_fix_that_comes_twice_counts_once(husky: Estimator) -> None:
    for _ in range(2):
        husky.add_gnss(10**9, np.zeros(3), 0.02)
        husky.add_gnss(2 * 10**9, np.zeros(3), 0.02)
    assert [fix.t_ns for fix in husky.gnss.waiting] == [10**9, 2 * 10**9]


def test_what_waits_for_imu_and_wheels_that_do_not_come_is_bounded(husky: Estimator) -> None:
    for t_ns in range(10**9, 10**9 + 10_050 * 10**7, 10**7):
        husky.add_gnss(t_ns, np.array([1e-9 * t_ns, 0.0, 0.0]), 0.02)
        husky.add_steering(t_ns, 0.0)
        husky.add_pressure(t_ns, 1e5)
        husky.add_magnetic_field(t_ns, [2e-5, 0.0, -4e-5])
    aids, waiting = husky.aids, husky.gnss.waiting
    held = [waiting, husky.steering.t_ns, aids.height._samples, aids.heading._samples]
    assert all(1_000 < len(samples) <= 10_000 for samples in held)
    assert waiting[-1].t_ns == t_ns
    assert husky.gnss.too_late == 50


@pytest.mark.parametrize("per_s", [1, 1_000, 1_000_000])
def test_times_that_are_no_nanoseconds_are_refused(husky: Estimator, per_s: int) -> None:
    """The estimator waited for ever, and held all samples."""
    for k in range(1000):
        husky.add_imu(k * per_s // 100, np.zeros(3), GRAVITY)
    for k in range(1000, 2000):
        with pytest.raises(DataError, match="give times in nanoseconds"):
            husky.add_imu(k * per_s // 100, np.zeros(3), GRAVITY)
    husky.add_imu(10**9, np.zeros(3), GRAVITY)  # a clock that stood still goes on
    assert husky.imu.t_ns[-1] == 10**9


def test_a_fix_without_a_sigma_has_that_of_its_class(husky: Estimator) -> None:
    husky.add(GnssSample(10**9, np.zeros(3), np.full(3, np.nan), 4, None, float("nan")))
    (fix,) = husky.gnss.waiting
    assert np.isfinite(fix.sigma_m).all()


def test_a_late_command_does_not_replace_a_newer_one(husky: Estimator) -> None:
    husky.add_command(10**9, 0.0)
    husky.add_command(7 * 10**8, 0.5)
    assert husky.monitor._commanded(10**9) == 0.0


def counted(first: int, late: bool = False) -> WheelStream:
    """1 m/s for 4 s; counters from sample `first` on that begin at 1 km."""
    stream = WheelStream()
    order = [*range(40)]
    if late:
        order[25], order[26] = order[26], order[25]
    for k in order:
        stream.add(k * 10**8, 1.0, 1.0, *([1000.0 + 0.1 * k] * 2 if k >= first else []))
    return stream


@pytest.mark.parametrize("first", [0, 1, 20])
@pytest.mark.parametrize("late", [False, True])
def test_counters_that_begin_later_are_no_jump_of_the_robot(first: int, late: bool) -> None:
    assert counted(first, late).travelled(0, 39 * 10**8) == pytest.approx((3.9, 3.9), abs=0.01)


def test_a_late_sample_from_before_a_reset_of_the_counters() -> None:
    stream = WheelStream()
    for k in [*range(20), 21, 20, *range(22, 40)]:
        stream.add(k * 10**8, 1.0, 1.0, *([500.0 * (k <= 20) + 0.1 * k] * 2))
    steps = np.diff([stream.travelled(0, k * 10**8) for k in range(40)], axis=0)
    np.testing.assert_allclose(steps, 0.1, atol=1e-6)


def test_a_pause_before_the_start_has_no_keyframes() -> None:
    estimator, rng, made, t_ns, x_m = (
        Estimator.for_vehicle("husky"),
        np.random.default_rng(0),
        [0],
        10**18,
        0.0,
    )
    keyframe = estimator._keyframe

    def counting(at_ns: int) -> None:
        made[0] += 1
        keyframe(at_ns)

    estimator._keyframe = counting  # type: ignore[method-assign]
    for pause_s, v_mps in ((0, 0.0), (100, 0.5)):
        t_ns += pause_s * 10**9
        for k in range(500):
            t_ns, x_m = t_ns + 10**7, x_m + 0.01 * v_mps
            estimator.add_wheels(t_ns, v_mps, v_mps)
            if k % 20 == 0:
                estimator.add_gnss(t_ns, [*rng.normal([x_m, 0.0], 0.02), 0.0], 0.02)
            estimator.add_imu(t_ns, rng.normal(0.0, 1e-3, 3), rng.normal(0.0, 1e-2, 3) + GRAVITY)
    assert 40 < made[0] < 200


def test_an_hour_without_fixes_or_wheels_fills_no_memory(husky: Estimator) -> None:
    learning = husky.learned.calibration
    assert learning is not None
    for k in range(36_000):
        learning.drive(k * 10**8, 0.1, 0.0, np.array([0.1 * k, 0.0]), 0.0)
        learning.advance()
    assert len(learning._samples) < 5000
    waiting = Estimator.for_vehicle("husky")
    for k in range(20_000):
        waiting.add_imu(k * 10**7, np.zeros(3), GRAVITY)
    assert len(waiting.imu.t_ns) < 1000


def test_odometry_is_the_same_whenever_it_is_asked_for(drive: Recording) -> None:
    """Restored from a dump it is computed for the first time; the running one has carried its state on."""
    running, compared = Estimator.for_vehicle("husky"), 0
    for i, message in enumerate(until(drive, 40.0).messages()):
        running.add(message)
        now = running.odometry()
        if now is not None and i % 127 == 0:
            fresh = Estimator.restore(running.config, running.dump()).odometry()
            assert fresh is not None
            compared += 1
            for name in ("position_m", "quaternion", "covariance", "twist_covariance"):
                np.testing.assert_array_equal(getattr(now, name), getattr(fresh, name), err_msg=f"{i} {name}")
    assert compared > 20


def test_odometry_asked_for_twice_is_computed_once_and_belongs_to_the_caller(
    husky: Estimator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As for the frames "map" and "odom" at each sample; integration of nothing more costs as much."""
    husky.set_start([0.0, 0.0, 0.0], 0.0)
    for k in range(305):
        husky.add_wheels(k * 10**7, 1.0, 1.0)
        husky.add_imu(k * 10**7, np.zeros(3), GRAVITY)
    first = husky.odometry()
    assert first is not None
    kept = {name: value.copy() for name, value in vars(first).items() if isinstance(value, np.ndarray)}
    for name in kept:
        getattr(first, name)[...] = 99.0
    monkeypatch.setattr(husky._propagator, "_carried", pytest.fail)
    again = husky.odometry()
    assert again is not None
    for name, value in kept.items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)


@pytest.mark.parametrize("started", [True, False])
def test_what_comes_while_the_imu_is_silent_is_held_for_a_while_only(husky: Estimator, started: bool) -> None:
    if started:
        husky.set_start([0.0, 0.0, 0.0], 0.0)
    for t_ns in range(0, 90 * 10**9, 2 * 10**7):
        husky.add_wheels(t_ns, 1.0, 1.0)
        if t_ns < 3 * 10**9 or t_ns > 85 * 10**9:
            husky.add_imu(t_ns, np.zeros(3), GRAVITY)
        if t_ns % 10**8 == 0:
            husky.add_gnss(t_ns, [1e-9 * t_ns, 0.0, 0.0], 1.0)
            husky.add_pressure(t_ns, 1e5)
        held = len(husky.wheels.t_ns), len(husky.gnss.waiting), len(husky.aids.height._samples)
        assert max(held) < 35 * 50
        assert max(held[1:]) < 35 * 10
    state = husky.latest()
    assert state is not None
    assert state.t_ns > 89 * 10**9


def test_wheels_go_on_without_an_imu_that_died_and_with_one_that_comes_back(husky: Estimator) -> None:
    husky.set_start([0.0, 0.0, 0.0], 0.0)
    states: list[State] = []
    husky._on_state = states.append
    t_ns, x_m = 0, 0.0
    for wait_s, imu in ((0, True), (0, False), (100, False), (0, True)):
        t_ns, known = t_ns + wait_s * 10**9, len(states)
        for _ in range(1000):
            t_ns, x_m, before = t_ns + 2 * 10**7, x_m + 0.02, len(states)
            husky.add_wheels(t_ns, 1.0, 1.0)
            if imu or wait_s == 0:  # a driver that has lost its sensor may send zeros
                husky.add_imu(t_ns, np.zeros(3), GRAVITY if imu else np.zeros(3))
            assert len(states) - before < 60, "no call catches up with a pause"
        newest = states[-1]
        assert t_ns - newest.t_ns < 10**9
        assert 180 < len(states) - known < 260
        assert husky.status == ("outage" if imu else "stalled")
        off_m, sigma_m = abs(newest.position_m[0] - x_m), newest.covariance[0, 0] ** 0.5
        assert off_m < 3.0 * sigma_m
        assert off_m < (2.0 if t_ns < 10**11 else 110.0)
