"""Clock steps and rows out of order are distinguished."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.clock import in_order, repair_together
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import ClockJump

START_NS = 1_600_000_000_000_000_000
MS, S = 10**6, 10**9


def ticks(n: int = 1000, period_ns: int = 10 * MS, jitter: float = 0.0, seed: int = 0) -> np.ndarray:
    """Times (n,) of an even clock whose every tick is off by up to `jitter` periods."""
    noise = np.random.default_rng(seed).uniform(-jitter, jitter, n) * period_ns
    return START_NS + np.arange(n) * period_ns + noise.astype(np.int64)


def stepped(t_ns: np.ndarray, *steps: tuple[int, float]) -> np.ndarray:
    """The clock set by so many seconds before each of these rows."""
    t_ns = t_ns.copy()
    for row, step_s in steps:
        t_ns[row:] += round(step_s * S)
    return t_ns


def repair(t_ns: np.ndarray, channel: str) -> tuple[np.ndarray, tuple[ClockJump, ...]]:
    """The repaired times of one channel, and its steps."""
    fixed, jumps = repair_together({channel: t_ns})
    return fixed[channel], jumps


def test_a_good_clock_is_left_alone() -> None:
    t = ticks(jitter=0.4)
    repaired, jumps = repair(t, "imu")
    assert repaired is t
    assert jumps == ()
    assert in_order(t) is None
    together, jumps = repair_together({"imu": t, "gnss": t[::50]})
    assert together["imu"] is t
    assert jumps == ()


@pytest.mark.parametrize("turn_s", [2**32 / 1e3, 2**32 / 1e6, 604_800.0, 3600.0])
def test_a_counter_that_wraps_is_repaired_exactly(turn_s: float) -> None:
    true = ticks(jitter=0.4)
    true[500:] += 200 * MS  # it wraps in a gap
    repaired, jumps = repair(stepped(true, (500, -turn_s)), "imu")
    assert repaired.tolist() == true.tolist()
    assert [jump.step_s for jump in jumps] == [-turn_s]


@pytest.mark.parametrize("n", [0, 1, 2])
def test_short_channels(n: int) -> None:
    t = ticks(n)
    assert repair(t, "imu") == (t, ())


@settings(max_examples=200, deadline=None)
@example(steps={999: 0.5}, jitter=0.1)  # about as many rows back as may come out of order
@given(
    steps=st.dictionaries(st.integers(1, 999), st.floats(0.02, 1e6), min_size=1, max_size=5),
    jitter=st.sampled_from([0.0, 0.1]),
)
def test_steps_back_are_taken_out(steps: dict[int, float], jitter: float) -> None:
    """Any rows, the first and the last too: each step is right to within a period."""
    t = ticks(jitter=jitter)
    rows = sorted(steps)
    repaired, jumps = repair(stepped(t, *((row, -steps[row]) for row in rows)), "imu")
    assert [jump.t_ns for jump in jumps] == repaired[rows].tolist()
    for jump, row in zip(jumps, rows, strict=True):
        assert jump.channel == "imu"
        assert abs(jump.step_s + steps[row]) < 0.01 * (1 + jitter)
    assert np.abs(repaired - t).max() <= len(rows) * 10 * MS
    assert (np.diff(repaired) > 0).all()


def test_steps_of_an_even_clock_are_taken_out_exactly() -> None:
    t = ticks()
    repaired, jumps = repair(stepped(t, (300, -5.0), (301, -0.5), (999, -0.02)), "wheels")
    np.testing.assert_array_equal(repaired, t)
    assert jumps == (
        ClockJump("wheels", int(t[300]), -5.0),
        ClockJump("wheels", int(t[301]), -0.5),
        ClockJump("wheels", int(t[999]), -0.02),
    )


def test_leaps_ahead_only_beside_a_clock_without_them() -> None:
    t = ticks()
    leapt = stepped(t, (400, 3600.0), (700, -3600.0))
    kept, jumps = repair(stepped(t, (400, 3600.0)), "imu")
    assert jumps == ()
    assert kept[-1] - t[-1] == 3600 * S
    repaired, jumps = repair_together({"imu": leapt}, beside={"imu": t})
    np.testing.assert_array_equal(repaired["imu"], t)
    assert [jump.step_s for jump in jumps] == [3600.0, -3600.0]


def test_the_period_is_that_of_the_place() -> None:
    """The nominal interval is a running one: this clock ticks at 100 Hz, then at 10 Hz."""
    t = np.concatenate([ticks(500), ticks(500, 100 * MS) + 5 * S])
    repaired, _ = repair(stepped(t, (200, -1.0), (800, -1.0)), "imu")
    np.testing.assert_array_equal(repaired, t)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), reach=st.integers(1, 20), share=st.sampled_from([0.05, 1.0]))
@example(seed=0, reach=5, share=1.0)
def test_disorder_is_sorted_not_shifted(seed: int, reach: int, share: float) -> None:
    """A share of the rows arrives up to `reach` periods late, the others in time."""
    rng = np.random.default_rng(seed)
    t = ticks()
    late = np.arange(len(t)) + np.where(rng.random(len(t)) < share, rng.uniform(0, reach, len(t)), 0)
    arrived = t[np.argsort(late, kind="stable")]
    repaired, jumps = repair(arrived, "imu")
    assert jumps == ()
    assert repaired is arrived
    order = in_order(repaired)
    assert np.array_equal(repaired if order is None else repaired[order], t)


@pytest.mark.parametrize("swap", [0, 500, 998])
def test_two_swapped_rows_anywhere(swap: int) -> None:
    t = ticks()
    t[[swap, swap + 1]] = t[[swap + 1, swap]]
    assert repair(t, "imu")[1] == ()


def test_disorder_beside_a_step() -> None:
    t = ticks()
    mixed = stepped(t, (500, -2.0))
    mixed[[100, 101]] = mixed[[101, 100]]
    mixed[[900, 901]] = mixed[[901, 900]]
    repaired, jumps = repair(mixed, "imu")
    assert [jump.t_ns for jump in jumps] == [t[500]]
    np.testing.assert_array_equal(repaired[in_order(repaired)], t)


def test_equal_times_keep_their_order() -> None:
    order = in_order(np.array([3, 1, 1, 2]))
    assert order is not None
    assert order.tolist() == [1, 2, 3, 0]


@pytest.mark.parametrize("step_s", [0.3, 5.0])
def test_channels_of_one_clock_step_together(step_s: float) -> None:
    """GNSS at 1 Hz does not show a step of 0.3 s, yet is on the same clock."""
    truth = {"imu": ticks(6000), "wheels": ticks(1200, 50 * MS, 0.1), "gnss": ticks(60, S)}
    at = START_NS + 30 * S + 5 * MS
    recorded = {name: np.where(t >= at, t - round(step_s * S), t) for name, t in truth.items()}
    repaired, jumps = repair_together(recorded)
    for name, t in truth.items():
        np.testing.assert_array_equal(repaired[name], t)
    assert {jump.channel for jump in jumps} == set(truth)
    assert {jump.step_s for jump in jumps} == {-step_s}


def test_a_clock_of_its_own_steps_alone() -> None:
    truth = {"imu": ticks(6000), "gnss": ticks(60, S, 0.01), "wheels": ticks(1200, 50 * MS)}
    repaired, jumps = repair_together({**truth, "imu": stepped(truth["imu"], (3000, -5.0))})
    assert {jump.channel for jump in jumps} == {"imu"}
    np.testing.assert_array_equal(repaired["imu"], truth["imu"])
    assert repaired["gnss"] is truth["gnss"]


def test_another_clock_distinguishes_a_jump_from_a_gap() -> None:
    t = np.delete(ticks(3000), range(1000, 1500))
    leapt = stepped(t, (2000, 60.0))
    repaired, jumps = repair_together({"imu": leapt}, beside={"imu": t + 3 * MS})
    np.testing.assert_array_equal(repaired["imu"], t)
    assert jumps == (ClockJump("imu", int(t[2000]), 60.0),)


def test_no_clock_at_all_is_refused() -> None:
    noise = np.random.default_rng(0).integers(0, 2**60, 100_000)
    with pytest.raises(DataError, match=r"imu: time jumps more than 1000 times.*receipt"):
        repair(noise, "imu")
    far = np.concatenate([start + np.arange(100) for start in (0, 4 * 10**18, 0, 4 * 10**18, 0)])
    with pytest.raises(DataError, match="larger than a time can be"):
        repair(far, "imu")
