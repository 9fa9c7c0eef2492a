"""Clocks of a bag: which is taken, what is measured of it, and steps, leaps, disorder and simulated time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import ClockJump, Recording
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.readers.ros.contents import bag_contents
from tests.datasets.ros_bags import MAKE1, MAKE2, T0, Message, write_ros1, write_ros2

MS, S = 10**6, 10**9
SECONDS = 20
PERIODS = {"/imu": 10 * MS, "/odom": 50 * MS, "/cmd_vel": 100 * MS, "/fix": S}
KINDS = {"/imu": "imu", "/odom": "wheels", "/cmd_vel": "command", "/fix": "gnss"}
TYPES = {
    "/imu": "sensor_msgs/msg/Imu",
    "/odom": "nav_msgs/msg/Odometry",
    "/cmd_vel": "geometry_msgs/msg/Twist",
    "/fix": "sensor_msgs/msg/NavSatFix",
}
Clock = Sequence[tuple[float, float]]
"""Steps of a clock: when (s after the start), and by how much it was set (s)."""


def shown(t_ns: np.ndarray, clock: Clock) -> np.ndarray:
    """What a clock shows that was set at these moments."""
    return t_ns + sum((t_ns >= T0 + round(at * S)) * round(by * S) for at, by in clock)


def drive(
    tmp_path: Path, header: Clock = (), receipt: Clock = (), rate: float = 1.0, since: int = T0
) -> Path:
    """A bag of four topics; commands have no header. Messages are received 3 ms after their stamp.

    `rate` is that of the header clock against the recorder's, `since` what it shows at the start.
    """
    rows: list[tuple[int, Message]] = []
    for topic, period in PERIODS.items():
        true_ns = T0 + np.arange(SECONDS * S // period) * period + period // 3
        stamps = since + np.rint((shown(true_ns, header) - T0) * rate).astype(np.int64)
        received = shown(true_ns + 3 * MS, receipt)
        for true, stamp, got in zip(true_ns.tolist(), stamps.tolist(), received.tolist(), strict=True):
            rows.append((true, (topic, TYPES[topic], got, message(topic, stamp))))
    return write_ros1(tmp_path / "a.bag", [row for _, row in sorted(rows, key=lambda row: row[0])])


def message(topic: str, stamp: int) -> object:
    if topic == "/imu":
        return MAKE1.imu(stamp)
    if topic == "/odom":
        return MAKE1.odometry(stamp, 1.0, 0.1)
    if topic == "/fix":
        return MAKE1.fix(stamp, 48.0, 11.0)
    return MAKE1.new(TYPES[topic], MAKE1.vector(1.0, 0.0, 0.0), MAKE1.vector(0.0, 0.0, 0.1))


def times(recording: Recording) -> dict[str, np.ndarray]:
    return {name: channel.t_ns for name, channel in recording.channels().items()}


def true_times(late_ns: int = 0) -> dict[str, np.ndarray]:
    return {KINDS[t]: T0 + np.arange(SECONDS * S // p) * p + p // 3 + late_ns for t, p in PERIODS.items()}


def refused(path: Path, *words: str, **options: object) -> None:
    with pytest.raises(TerrafusionError) as caught:
        open_recording(path, **options)
    for word in words:
        assert word in str(caught.value), str(caught.value)


def test_the_latency_is_told(tmp_path: Path) -> None:
    path = drive(tmp_path)
    recording = open_recording(path)
    assert "times are header stamps; received later by (median, 95 %): /imu 3 and 3 ms" in recording.notes[0]
    assert times(recording)["imu"].tolist() == true_times()["imu"].tolist()
    assert times(recording)["command"].tolist() == true_times(3 * MS)["command"].tolist()
    late = open_recording(path, stamps="receipt")
    assert "as asked; received later by (median, 95 %): /imu 3 and 3 ms" in late.notes[0]
    assert recording.clock_jumps == late.clock_jumps == ()
    assert recording.imu_frame_id == "base_link"


def test_a_good_clock_is_not_repaired(tmp_path: Path) -> None:
    path = drive(tmp_path)
    plain, repaired = open_recording(path), open_recording(path, repair_clock=True)
    assert plain.notes == repaired.notes
    assert repaired.clock_jumps == ()
    for name, t_ns in times(plain).items():
        np.testing.assert_array_equal(times(repaired)[name], t_ns)


@pytest.mark.parametrize("step_s", [-0.3, -7.0])
def test_header_clock_set_back(tmp_path: Path, step_s: float) -> None:
    """All topics of that clock are shifted by one step, also fixes whose times do not run back."""
    path = drive(tmp_path, header=[(12.2, step_s)])
    refused(path, "header stamps run backwards", "--stamps receipt", "--repair-clock")
    assert open_recording(path, stamps="receipt").clock_jumps == ()
    recording = open_recording(path, repair_clock=True)
    assert {(jump.channel, jump.step_s) for jump in recording.clock_jumps} == {
        (name, step_s) for name in ("imu", "wheels", "gnss")
    }
    for name in ("imu", "wheels", "gnss"):
        np.testing.assert_array_equal(times(recording)[name], true_times()[name])


def test_both_clocks_set_back(tmp_path: Path) -> None:
    """The computer's own clock was set: receipt stamps are no way out."""
    path = drive(tmp_path, header=[(12.2, -5.0)], receipt=[(12.2, -5.0)])
    refused(path, "run backwards by", "--repair-clock")
    refused(path, "receipt stamps run backwards by", "--repair-clock", stamps="receipt")
    for stamps, late_ns in (("header", 0), ("receipt", 3 * MS)):
        recording = open_recording(path, stamps=stamps, repair_clock=True)
        assert {jump.channel for jump in recording.clock_jumps} == set(KINDS.values())
        for name, t_ns in times(recording).items():
            late = 3 * MS if name == "command" else late_ns
            assert np.abs(t_ns - true_times(late)[name]).max() <= 10 * MS
    assert recording.clock_jumps[0] == ClockJump("imu", int(times(recording)["imu"][1220]), -5.0)


def test_recorder_clock_set_back_matters_only_where_it_is_used(tmp_path: Path) -> None:
    path = drive(tmp_path, receipt=[(12.2, -5.0)])
    refused(path, "/cmd_vel", "receipt stamps run backwards")
    recording = open_recording(path, repair_clock=True)
    assert {jump.channel for jump in recording.clock_jumps} == {"command"}
    np.testing.assert_array_equal(times(recording)["imu"], true_times()["imu"])
    np.testing.assert_array_equal(times(recording)["command"], true_times(3 * MS)["command"])


@pytest.mark.parametrize("stamps", ["header", "receipt"])
def test_receipt_stamps_that_vary_by_the_time_on_the_way_are_no_steps(tmp_path: Path, stamps: str) -> None:
    """A recorder of several threads stamps a fast topic 10 to 30 ms after its header: out of order."""
    rng = np.random.default_rng(3)
    rows: list[Message] = []
    for topic, period in PERIODS.items():
        if topic != "/cmd_vel":
            true_ns = T0 + np.arange(SECONDS * S // period) * period
            got = true_ns + rng.uniform(10 * MS, 30 * MS, len(true_ns)).astype(np.int64)
            both = zip(true_ns.tolist(), got.tolist(), strict=True)
            rows += [(topic, TYPES[topic], late, message(topic, stamp)) for stamp, late in both]
    path = write_ros1(tmp_path / "a.bag", rows)
    plain = open_recording(path)
    recording = open_recording(path, stamps=stamps, repair_clock=True)
    assert recording.clock_jumps == ()
    for name, t_ns in times(recording).items():
        late_ns = t_ns - times(plain)[name]
        assert late_ns.min() >= 0
        assert late_ns.max() <= 30 * MS if stamps == "receipt" else not late_ns.any()
        assert (np.diff(t_ns) >= 0).all()


def test_header_clock_that_leaps_ahead(tmp_path: Path) -> None:
    """Against the recorder's clock a leap is told from a gap; it is noted, and repaired where asked."""
    path = drive(tmp_path, header=[(12.2, 0.8)])
    assert any("leaps ahead by 0.800 s" in note for note in open_recording(path).notes)
    recording = open_recording(path, repair_clock=True)
    assert {jump.step_s for jump in recording.clock_jumps} == {0.8}
    np.testing.assert_array_equal(times(recording)["imu"], true_times()["imu"])


@pytest.mark.parametrize("rate", [1.0, 0.5, 4.0])
def test_simulated_time(tmp_path: Path, rate: float) -> None:
    """Header stamps since the start of a simulation, faster or slower than the wall clock."""
    recording = open_recording(drive(tmp_path, rate=rate, since=5 * S))
    assert "on another clock" in recording.notes[0]
    for name, t_ns in times(recording).items():
        truth = 5 * S + (true_times(3 * MS if name == "command" else 0)[name] - T0) * rate
        assert np.abs(t_ns - truth).max() <= 3 * MS * rate + 2 + (0.1 * S * rate if name == "command" else 0)


def test_messages_out_of_order_are_sorted(tmp_path: Path) -> None:
    """Their times are right: no clock was set back, and nothing is to be asked of the user."""
    stamps = [T0 + i * 10 * MS for i in range(200)]
    stamps[100], stamps[101] = stamps[101], stamps[100]
    rows: list[Message] = [
        ("/imu", TYPES["/imu"], T0 + i * 10 * MS, MAKE1.imu(t, gyro=(float(t - T0), 0.0, 0.0)))
        for i, t in enumerate(stamps)
    ]
    path = write_ros1(tmp_path / "a.bag", rows)
    for repair_clock in (False, True):
        recording = open_recording(path, repair_clock=repair_clock)
        assert recording.clock_jumps == ()
        assert "imu: 2 messages out of order were sorted" in recording.notes
    assert recording.imu is not None
    assert recording.imu.t_ns.tolist() == sorted(stamps)
    np.testing.assert_array_equal(recording.imu.gyro_radps[:, 0], recording.imu.t_ns - T0)


def test_a_merged_bag_is_read_in_the_order_of_receipt(tmp_path: Path) -> None:
    """The second half was written first: no clock was set, and nothing is to be repaired."""
    rows: list[Message] = [
        ("/imu", TYPES["/imu"], T0 + i * 10 * MS + MS, MAKE2.imu(T0 + i * 10 * MS)) for i in range(400)
    ]
    recording = open_recording(write_ros2(tmp_path / "a", [*rows[200:], *rows[:200]]))
    assert recording.imu is not None
    assert recording.imu.t_ns.tolist() == [T0 + i * 10 * MS for i in range(400)]


def test_the_contents_of_a_bag_are_by_the_clock_of_the_recorder(tmp_path: Path) -> None:
    """An IMU stamps the time since it was switched on; its rows stand beside those of the others."""
    rows: list[Message] = []
    for k in range(20):
        rows.append(("/imu", TYPES["/imu"], T0 + k * 10 * MS, MAKE1.imu(500 * S + k * 10 * MS)))
        rows.append(("/fix", TYPES["/fix"], T0 + k * 10 * MS, MAKE1.fix(T0 + k * 10 * MS, 48.0, 11.0)))
    contents = bag_contents(str(write_ros1(tmp_path / "a.bag", rows)))
    assert contents is not None
    assert [int(t_ns[0]) for t_ns in contents.times_ns.values()] == [T0, T0]


def test_a_simulated_clock_may_start_at_zero(tmp_path: Path) -> None:
    kind = TYPES["/imu"]
    messages = [("/imu", kind, T0 + k * 10 * MS, MAKE1.imu(k * 10 * MS)) for k in range(100)]
    recording = open_recording(write_ros1(tmp_path / "a.bag", messages))
    assert recording.imu is not None
    assert recording.imu.t_ns.tolist() == [k * 10 * MS for k in range(100)]


def test_stamps_that_stand_still_give_way_to_those_of_receipt(tmp_path: Path) -> None:
    recording = open_recording(drive(tmp_path, rate=0.0))
    for name, t_ns in true_times(late_ns=3 * MS).items():
        np.testing.assert_array_equal(times(recording)[name], t_ns)
    assert "/imu: header stamps are all the same; receipt stamps are used" in recording.notes
