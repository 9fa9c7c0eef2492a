"""Stamps far ahead of all others: what is held, what confirms it, and what contradicts it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.fusion.inputs.sample_stream import Lateness
from terrafusion.fusion.inputs.time_jumps import ClockJumpError, EarlyFixes, Newest, TimeJump
from terrafusion.fusion.inputs.validation import GnssFix

MS, S = 1_000_000, 1_000_000_000
NOW = 2 * S
"""Time of the newest sample of `running`."""


def running(step_ns: int = 100 * MS, count: int = 21) -> Newest:
    """Of a stream that goes on by equal steps and has come to `NOW`."""
    newest = Newest()
    for k in range(count):
        newest.advance(NOW - (count - 1 - k) * step_ns)
    return newest


def times(samples: list[tuple[Any, ...]]) -> list[int]:
    return [sample[0] for sample in samples]


@pytest.mark.parametrize(
    ("step_ns", "jump_ns"),
    [(10 * MS, S), (100 * MS, S), (200 * MS, 2 * S), (999 * MS, 9990 * MS), (2 * S, 10 * S)],
)
def test_a_leap_is_a_second_ten_steps_or_ten_seconds(step_ns: int, jump_ns: int) -> None:
    newest = running(step_ns)
    assert newest.jump_ns() == jump_ns
    assert not newest.is_jump(NOW + jump_ns)
    assert newest.is_jump(NOW + jump_ns + 1)
    assert not newest.is_jump(NOW - 50 * S)


def test_one_leap_among_the_last_steps_does_not_permit_another() -> None:
    newest = running()
    newest.advance(NOW + 5 * S)
    assert newest.jump_ns() == S
    newest.advance(NOW + 9 * S)
    assert newest.jump_ns() == 10 * S


def test_before_eight_steps_any_second_ahead_leaps() -> None:
    assert not Newest().is_jump(10**18)
    newest = running(S, count=8)
    assert newest.jump_ns() == 10 * S
    assert newest.is_jump(NOW + S + 1)
    assert not newest.is_jump(NOW + S)
    newest = running(S, count=9)
    assert not newest.is_jump(NOW + S + 1)


def test_an_older_sample_is_counted_and_moves_nothing() -> None:
    newest = running()
    taken, steps = newest.used_count, list(newest.steps_ns)
    newest.advance(NOW - S)
    newest.advance(NOW)
    assert (newest.t_ns, newest.used_count, list(newest.steps_ns)) == (NOW, taken + 2, steps)


@pytest.mark.parametrize(
    ("fixes_s", "wait_s"),
    [
        ((), 0.0), ((0.0,), 0.0), ((0.0, 1.0), 0.0), ((0.0, 1.0, 2.0), 2.0), ((0.0, 2.5, 5.0), 5.0),
        ((0.0, 2.6, 5.2), 0.0), ((0.0, 1.0, 2.0, 7.0), 2.0), ((0.0, 0.0, 0.0), 0.0),
        ((0.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 16.0), 2.0),
    ],
)  # fmt: skip
def test_fixes_have_a_say_within_two_of_their_intervals(fixes_s: tuple[float, ...], wait_s: float) -> None:
    newest = Newest()
    for t_s in fixes_s:
        newest.fix(round(t_s * S))
    assert newest.fix_wait_ns() == round(wait_s * S)
    assert newest.fix_count == len(fixes_s)


def test_other_channels_are_refused_ten_seconds_ahead() -> None:
    newest = running()
    assert newest.admitted(NOW + 10 * S, "terrain") == NOW + 10 * S
    assert newest.admitted(NOW - 99 * S, "terrain") == NOW - 99 * S
    assert [newest.admitted(NOW + 10 * S + k, "terrain") for k in (1, 2)] == [None, None]
    assert newest.refused == {"terrain": 2}
    assert Newest().admitted(10**18, "terrain") == 10**18
    assert [newest.admitted(NOW - k * S, "terrain", 5 * S) for k in (5, 6)] == [NOW - 5 * S, None]
    assert newest.refused == {"terrain": 3}
    with pytest.raises(DataError, match="no integer"):
        newest.admitted(1.5, "terrain")


def test_the_next_sample_is_used_at_once() -> None:
    jump = TimeJump(running())
    for t_ns in (NOW + 100 * MS, NOW + 100 * MS + S, NOW - S):
        assert jump.admitted((t_ns, "imu")) == [(t_ns, "imu")]
    assert (jump.newest.t_ns, jump.held, jump.dropped) == (NOW + 100 * MS + S, [], 0)
    assert TimeJump(Newest()).admitted((NOW,)) == [(NOW,)]


@pytest.mark.parametrize(("step_ns", "needed"), [(100 * MS, 6), (250 * MS, 3), (400 * MS, 3), (50 * MS, 11)])
def test_a_pause_is_confirmed_by_three_samples_over_half_a_second(step_ns: int, needed: int) -> None:
    jump = TimeJump(running())
    ahead = [NOW + 60 * S + k * step_ns for k in range(needed)]
    for t_ns in ahead[:-1]:
        assert jump.admitted((t_ns,)) == []
    assert times(jump.admitted((ahead[-1],))) == ahead
    assert (jump.newest.t_ns, jump.held, jump.dropped) == (ahead[-1], [], 0)
    assert times(jump.admitted((ahead[-1] + step_ns,))) == [ahead[-1] + step_ns]


def test_samples_behind_a_pause_are_used_in_the_order_of_their_times() -> None:
    jump = TimeJump(running())
    ahead = [NOW + 60 * S + t for t in (200 * MS, 0, 400 * MS)]
    assert [jump.admitted((t,)) for t in ahead] == [[], [], []]
    assert times(jump.admitted((NOW + 61 * S,))) == [*sorted(ahead), NOW + 61 * S]


def test_a_wrong_stamp_is_dropped_by_the_next_right_one() -> None:
    jump = TimeJump(running())
    assert jump.admitted((NOW + 60 * S,)) == []
    assert times(jump.admitted((NOW + 100 * MS,))) == [NOW + 100 * MS]
    assert (jump.held, jump.dropped, jump.newest.t_ns) == ([], 1, NOW + 100 * MS)


@pytest.mark.parametrize(("apart_ns", "dropped"), [(S, 0), (S + 1, 1), (-S - 1, 1), (60 * S, 1)])
def test_wrong_stamps_that_disagree_do_not_confirm_each_other(apart_ns: int, dropped: int) -> None:
    jump = TimeJump(running())
    jump.admitted((NOW + 60 * S,))
    assert jump.admitted((NOW + 60 * S + apart_ns,)) == []
    assert (jump.dropped, len(jump.held)) == (dropped, 2 - dropped)


def test_another_stream_that_goes_on_contradicts() -> None:
    jump = TimeJump(running())
    for k in range(20):
        assert jump.admitted((NOW + 60 * S + k * 100 * MS,)) == []
        jump.newest.advance(NOW + (k + 1) * 100 * MS)
    assert (jump.dropped, len(jump.held)) == (19, 1)


def test_another_stream_that_has_leapt_confirms() -> None:
    jump = TimeJump(running())
    jump.admitted((NOW + 60 * S,))
    jump.newest.advance(NOW + 60 * S)
    assert times(jump.admitted((NOW + 60 * S + 100 * MS,))) == [NOW + 60 * S, NOW + 60 * S + 100 * MS]
    assert (jump.held, jump.dropped) == ([], 0)


@pytest.mark.parametrize(("fix_ns", "samples"), [(59 * S, 6), (59 * S - 1, 21), (None, 21)])
def test_fixes_that_come_confirm_and_are_waited_for(fix_ns: int | None, samples: int) -> None:
    """Fixes once a second: without one, it takes two seconds."""
    jump = TimeJump(running())
    for k in range(4):
        jump.newest.fix(NOW - (4 - k) * S)
    found: list[tuple[Any, ...]] = []
    for k in range(40):
        found = jump.admitted((NOW + 60 * S + k * 100 * MS,))
        if found:
            break
        if k == 0 and fix_ns == 59 * S:
            jump.newest.fix(NOW + fix_ns)
    assert len(found) == samples


@pytest.mark.parametrize(
    ("fix_ns", "dropped"), [(0, 0), (1, 1), (30 * S, 1), (59 * S - 1, 1), (59 * S, 0), (-S, 0)]
)
def test_fixes_between_contradict(fix_ns: int, dropped: int) -> None:
    jump = TimeJump(running())
    jump.admitted((NOW + 60 * S,))
    jump.newest.fix(NOW + fix_ns)
    jump.admitted((NOW + 60 * S + 100 * MS,))
    assert jump.dropped == dropped


def test_fixes_that_contradict_for_five_seconds_are_an_error() -> None:
    jump = TimeJump(running(), "imu")
    jump.admitted((NOW + 60 * S,))
    for k in range(1, 52):
        jump.newest.fix(NOW + k * 100 * MS)
        assert jump.admitted((NOW + 60 * S + k * 100 * MS,)) == []
    assert jump.refuted_ns == NOW + 60 * S + 100 * MS
    dropped = jump.dropped
    jump.newest.fix(NOW + 5100 * MS + 1)
    with pytest.raises(DataError, match=r"60\.0 s ahead of the fixes, which go on as before"):
        jump.admitted((NOW + 65100 * MS + 1,))
    assert jump.dropped == dropped + 2  # the one that was held, and this one


def test_a_clock_that_jumps_alone_is_no_reason_to_start_anew() -> None:
    jump = TimeJump(running(), "wheels")
    for k in range(52):
        assert jump.admitted((NOW + 60 * S + k * 100 * MS,)) == []
        jump.newest.advance(NOW + (k + 1) * 100 * MS)
    with pytest.raises(DataError, match=r"60\.0 s ahead of other sensors") as found:
        jump.admitted((NOW + 65200 * MS,))
    assert not isinstance(found.value, ClockJumpError)


def set_back(by_ns: int, alone: bool, late: int = 60) -> int:
    """How many of the `late` samples in order after a set-back are accepted, until one is refused."""
    stream = Lateness("imu", Newest())
    times = [k * 10 * MS for k in range(1000)]
    for t_ns in times:
        stream.jump.newest.advance(t_ns)
    for k in range(late):
        if alone:
            stream.jump.newest.advance(times[-1] + k * 10 * MS)
        try:
            assert stream.place(times[-1] - by_ns + k * 10 * MS, times) is not None
        except ClockJumpError:
            assert not alone
            return k
        except DataError:
            assert alone
            return k
    return late


@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize(("by_ns", "accepted"), [(1500 * MS, 50), (4 * S, 50), (990 * MS, 60)])
def test_a_clock_that_is_set_back_is_an_error_after_half_a_second(
    by_ns: int, accepted: int, alone: bool
) -> None:
    assert set_back(by_ns, alone) == accepted


def test_samples_of_a_clock_far_behind_the_keyframes_are_refused() -> None:
    stream = Lateness("wheels", Newest())
    stream.used_ns = NOW
    assert stream.place(NOW - S, [NOW - 2 * S]) == 1
    with pytest.raises(DataError, match=r"1\.500 s after its time has been estimated"):
        stream.place(NOW - 1500 * MS, [NOW - 2 * S])


def test_a_clock_that_returns_is_no_error() -> None:
    jump = TimeJump(running())
    for k in range(1, 100):
        jump.newest.fix(NOW + k * 100 * MS)
        jump.admitted((NOW + k * 100 * MS + (0 if k % 9 == 0 else 60 * S),))
    assert jump.newest.t_ns == NOW + 9900 * MS


def fix_at(t_ns: int) -> GnssFix:
    return GnssFix(t_ns, np.zeros(3), np.ones(3), None, 0.0, None)


def test_a_fix_that_is_not_ahead_is_used() -> None:
    ahead = EarlyFixes(running())
    assert ahead.admitted(None) == []
    for t_ns in (NOW - 5 * S, NOW, NOW + S):
        assert [fix.t_ns for fix in ahead.admitted(fix_at(t_ns))] == [t_ns]
    assert ahead.newest.fix_count == 3
    assert [fix.t_ns for fix in EarlyFixes(Newest()).admitted(fix_at(NOW))] == [NOW]


def test_fixes_ahead_are_used_when_three_are_in_order() -> None:
    ahead = EarlyFixes(running())
    first = [NOW + 2 * S, NOW + 3 * S]
    assert [ahead.admitted(fix_at(t)) for t in first] == [[], []]
    assert [fix.t_ns for fix in ahead.admitted(fix_at(NOW + 3 * S))] == [*first, NOW + 3 * S]
    assert (ahead.held, ahead.dropped) == ([], 0)


def test_an_earlier_fix_drops_those_ahead() -> None:
    ahead = EarlyFixes(running())
    for t_ns in (NOW + 5 * S, NOW + 6 * S):
        ahead.admitted(fix_at(t_ns))
    assert [fix.t_ns for fix in ahead.admitted(fix_at(NOW + 200 * MS))] == [NOW + 200 * MS]
    assert (ahead.held, ahead.dropped) == ([], 2)


def test_fixes_ahead_are_used_when_the_others_have_nearly_come_there() -> None:
    ahead = EarlyFixes(running())
    assert ahead.reached() == []
    ahead.admitted(fix_at(NOW + 1500 * MS))
    ahead.newest.advance(NOW + 499 * MS)
    assert ahead.reached() == []
    ahead.newest.advance(NOW + 500 * MS)
    assert times(ahead.reached()) == [NOW + 1500 * MS]
    assert ahead.held == []


def test_a_fix_ten_seconds_ahead_is_refused_and_counted() -> None:
    ahead = EarlyFixes(running())
    assert ahead.admitted(fix_at(NOW + 10 * S + 1)) == []
    assert (ahead.held, ahead.newest.refused, ahead.newest.fix_count) == ([], {"gnss": 1}, 1)
