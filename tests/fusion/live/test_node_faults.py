"""The node on a bad day: broken messages, clocks that leap, and sensors that fall silent."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimate.estimate import Estimate
from tests.fusion.live.node_run import BagMessage, Run, error_m


def broken(messages: list[BagMessage]) -> Iterable[BagMessage]:
    """The messages, and beside them what a bad day of a robot sends."""
    nan = np.full(3, np.nan).tobytes()
    for i, (t, topic, msgtype, cdr) in enumerate(messages):
        yield t, topic, msgtype, cdr
        if i % 40 == 7:
            yield t, topic, msgtype, cdr[: len(cdr) // 2]  # cut off
        elif i % 40 == 17:
            yield t, topic, msgtype, b""
        elif i % 40 == 27:
            yield t, topic, msgtype, cdr[:8] + bytes(4) + cdr[12:]  # another length of a text, or stamp
        elif i % 40 == 37 and i > 1000 and topic == "/imu/data":
            yield t, topic, msgtype, cdr[:-96] + nan + cdr[-72:]
        elif i % 400 == 39 and topic == "/imu/data":
            year = int.from_bytes(cdr[4:8], "little") + 31_536_000
            yield t, topic, msgtype, cdr[:4] + year.to_bytes(4, "little") + cdr[8:]


def test_bad_messages_are_refused_and_reported(messages: list[BagMessage], live_recording: Recording) -> None:
    run = Run().feed(broken(messages))
    assert run.node.counts["refused"] > 100
    assert any(line.startswith("refused: /imu/data") for line in run.said)
    assert len(run.said) < 60  # a kind of line once
    assert error_m(run.history, live_recording) < 1.0


def test_a_bag_that_starts_again_starts_the_estimator_anew(messages: list[BagMessage]) -> None:
    run = Run().feed(messages[: len(messages) // 2], close=False)
    run.feed(messages[: len(messages) // 2])
    assert run.node.counts["resets"] == 1
    assert any("went back by 5" in line for line in run.said)
    times = np.array([state.t_ns for state in run.history.states])
    (again,) = np.flatnonzero(np.diff(times) < 0)
    assert abs(times[again + 1] - times[0]) < 200_000_000


def ahead(message: BagMessage, seconds: int) -> BagMessage:
    """A message of IMU, wheels or receiver whose stamp is ahead; the others as they are."""
    t, topic, msgtype, cdr = message
    if not msgtype.endswith(("/Imu", "/Odometry", "/JointState", "/NavSatFix")):
        return message
    stamp = int.from_bytes(cdr[4:8], "little") + seconds
    return t, topic, msgtype, cdr[:4] + stamp.to_bytes(4, "little") + cdr[8:]


def test_stamps_that_leap_without_a_pause_start_the_estimator_anew(messages: list[BagMessage]) -> None:
    half = len(messages) // 2
    run = Run().feed(messages[:half], close=False)
    run.feed([ahead(message, 3600) for message in messages[half:]])
    assert [line for line in run.said if "started anew" in line] == [
        "started anew: the stamps of the IMU went ahead by 3600.5 s"
    ]
    times = np.array([state.t_ns for state in run.history.states])
    assert np.diff(times).max() < 3610 * 10**9
    assert times[-1] - times[0] > 3600 * 10**9, "the new clock is used"


@pytest.mark.parametrize("nth", [1, 5])
def test_stamps_that_leave_those_of_the_fixes_start_the_estimator_anew(
    messages: list[BagMessage], nth: int
) -> None:
    """All are behind the time of receipt: fixes of 5 or 1 Hz show that no pause is passing."""
    run, begin, late_ns, fixes = Run(frequency=1.0), messages[0][0] + 3 * 10**9, 10**12, 0
    for jumps in (False, True):
        some = []
        for message in messages:
            t, topic, msgtype, cdr = message
            fixes += topic == "/fix"
            if (t >= begin) is jumps and topic != "/fix_velocity" and (topic != "/fix" or fixes % nth == 0):
                cdr = ahead(message, 100)[-1] if jumps and topic != "/fix" else cdr
                some.append((t + late_ns, topic, msgtype, cdr))
        run.feed(some, close=False)
    (line,) = [line for line in run.said if "started anew" in line]
    assert line.endswith("is 100.0 s ahead of the fixes, which go on as before")
    assert run.node.counts["refused"] == 0


def test_stamps_that_leap_for_a_moment_are_refused(messages: list[BagMessage], replayed: Estimate) -> None:
    few = [ahead(m, 3600) if i % 500 in (50, 51, 52) else m for i, m in enumerate(messages)]
    run = Run().feed(few)
    assert run.node.counts["resets"] == 0
    assert np.linalg.norm(run.history.states[-1].position_m - replayed.trajectory.position_m[-1]) < 0.1


def test_a_sample_without_numbers_does_not_delay_the_start(messages: list[BagMessage]) -> None:
    """One bad sample of the IMU each second from the first on: the others start the estimator."""
    nan = np.full(3, np.nan).tobytes()
    spoilt, seconds = [], set[int]()
    for t, topic, msgtype, cdr in messages:
        if topic == "/imu/data" and t // 10**9 not in seconds:
            seconds.add(t // 10**9)
            cdr = cdr[:-96] + nan + cdr[-72:]
        spoilt.append((t, topic, msgtype, cdr))
    run = Run().feed(spoilt)
    assert run.node.estimator is not None
    assert run.node.counts["refused"] == len(seconds)
    assert any(line.startswith("refused: imu: a sample lacks numbers") for line in run.said)
    assert run.history.states[0].t_ns - messages[0][0] < 4_000_000_000


def test_an_imu_without_any_usable_sample_is_waited_for(messages: list[BagMessage]) -> None:
    begin = messages[0][0] + 2_500_000_000
    infinite = np.full(3, np.inf).tobytes()
    late = [
        (t, topic, msgtype, cdr[:-96] + infinite + cdr[-72:] if topic == "/imu/data" and t < begin else cdr)
        for t, topic, msgtype, cdr in messages[: len(messages) // 2]
    ]
    run = Run().feed(late)
    assert any(line.startswith("waiting: live, /imu/data") for line in run.said)
    assert run.node.estimator is not None
    assert run.node.estimator.config.inputs.imu == "six_axis"
    assert run.history.states[0].t_ns > begin


def test_an_imu_that_falls_silent_is_reported(messages: list[BagMessage]) -> None:
    half = len(messages) // 2
    run = Run().feed(messages[:half], close=False)
    run.feed([one for one in messages[half:] if one[1] != "/imu/data"])
    (line,) = [line for line in run.said if "no sample of the IMU" in line]
    assert line == "no sample of the IMU for 3 s: nothing is estimated"
    status = {one.name: one for one in run.decoded("/diagnostics")[-1].status}["terrafusion/input"]
    assert status.message.startswith("no sample of the IMU for")
