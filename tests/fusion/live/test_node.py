"""The node fed with messages of a bag: the bits of `replay`, what it publishes, and what it survives."""

from __future__ import annotations

import dataclasses
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Imu, Wheels
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.writers import ros_messages as ros
from terrafusion.datasets.writers.cdr import CdrTemplate, split
from terrafusion.datasets.writers.mcap_file import TopicMessages
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.estimator.history import History
from terrafusion.fusion.grounds.file import read_grounds, save_grounds
from terrafusion.fusion.grounds.ground import Ground
from terrafusion.fusion.grounds.memory import GroundMemory
from terrafusion.fusion.grounds.signature import SIGNATURE
from terrafusion.fusion.replay import replay
from tests.fusion.live.conftest import VEHICLE
from tests.fusion.live.node_run import STORE, BagMessage, Run, error_m


@pytest.fixture(scope="module")
def run(messages: list[BagMessage]) -> Run:
    return Run(frequency=1000.0).feed(messages)


def same_bits(history: History, estimate: Estimate) -> int:
    """Asserts that all states are those of an estimate at their times; returns how many."""
    path = estimate.trajectory
    rows = {t: i for i, t in enumerate(path.t_ns.tolist())}
    for state in history.states:
        i = rows[state.t_ns]
        np.testing.assert_array_equal(state.position_m, path.position_m[i])
        np.testing.assert_array_equal(state.covariance, path.covariance[i])
        assert state.slip == estimate.slip[i]
    return len(history.states)


def test_a_node_gives_the_bits_of_replay(run: Run, replayed: Estimate) -> None:
    assert same_bits(run.history, replayed) == len(replayed.trajectory)
    assert run.node.counts["refused"] == 0


def test_the_order_of_arrival_does_not_matter(messages: list[BagMessage], replayed: Estimate) -> None:
    """Messages that overtake each other by less than the wait give the same bits."""
    chance = random.Random(3)
    late = sorted(messages, key=lambda one: one[0] + chance.uniform(0.0, 15e6))
    assert same_bits(Run().feed(late).history, replayed) == len(replayed.trajectory)


def test_a_late_joiner_estimates_the_rest_as_replay_does(
    messages: list[BagMessage], live_recording: Recording
) -> None:
    begin = messages[0][0] + 3_000_000_000
    parts = {n: c.between(begin, begin + 10**11) for n, c in live_recording.channels().items()}
    rest = replay(dataclasses.replace(live_recording, **parts), vehicle=VEHICLE).estimate
    late = [one for one in messages if one[0] >= begin or one[1] in ("/datum", "/tf_static")]
    assert same_bits(Run().feed(late).history, rest) == len(rest.trajectory) > 50


def test_odometry_and_transforms_belong_together(run: Run) -> None:
    """map -> odom times odom -> base_link is the pose in map; rosbags reads all of it."""
    in_odom, in_map = run.decoded("/odometry"), run.decoded("/odometry/map")
    corrections, motions = run.decoded("/tf")[0::2], run.decoded("/tf")[1::2]
    assert len(in_odom) == len(in_map) == len(corrections) == len(motions) > 700
    for o, m, c, b in list(zip(in_odom, in_map, corrections, motions, strict=True))[::97]:
        assert (o.header.frame_id, o.child_frame_id) == ("odom", "base_link")
        assert (m.header.frame_id, m.child_frame_id) == ("map", "base_link")
        (map_odom,), (odom_base,) = c.transforms, b.transforms
        assert (map_odom.header.frame_id, map_odom.child_frame_id) == ("map", "odom")
        assert o.header.stamp == m.header.stamp == odom_base.header.stamp
        R, p = pose(map_odom.transform.rotation, map_odom.transform.translation)
        R2, p2 = pose(odom_base.transform.rotation, odom_base.transform.translation)
        R3, p3 = pose(m.pose.pose.orientation, m.pose.pose.position)
        np.testing.assert_allclose(R @ p2 + p, p3, atol=1e-9)
        np.testing.assert_allclose(R @ R2, R3, atol=1e-9)
        for message in (o, m):
            assert np.isfinite(message.pose.covariance).all()
            assert np.isfinite(message.twist.covariance).all()
        assert o.pose.covariance[0] == 1e6


def pose(q: Any, p: Any) -> tuple[np.ndarray, np.ndarray]:
    return quaternion_to_matrix([q.x, q.y, q.z, q.w]), np.array([p.x, p.y, p.z])


def test_the_frame_odom_does_not_jump(run: Run) -> None:
    """From sample to sample the robot moves by its speed, and by no more; in map, fixes move it."""
    steps = {}
    for topic in ("/odometry", "/odometry/map"):
        found = run.decoded(topic)
        at = np.array([[m.pose.pose.position.x, m.pose.pose.position.y] for m in found])
        steps[topic] = float(np.linalg.norm(np.diff(at, axis=0), axis=1).max())
    assert steps["/odometry"] < 0.015 < steps["/odometry/map"]  # 0.9 m/s at 100 Hz


def test_diagnostics_name_the_status_and_count_what_came(run: Run) -> None:
    last = run.decoded("/diagnostics")[-1]
    found = {status.name: {pair.key: pair.value for pair in status.values} for status in last.status}
    assert found["terrafusion/localisation"]["status"] == "running"
    assert float(found["terrafusion/localisation"]["status_s"]) > 5.0
    assert found["terrafusion/input"]["refused"] == "0"
    assert int(found["terrafusion/input"]["received"]) > 2500
    first = run.decoded("/diagnostics")[0]
    assert first.status[0].values[0].value == "waiting"


def test_slip_and_ground_come_with_each_keyframe(run: Run) -> None:
    slips = [message.data for message in run.decoded("/terrafusion/slip")]
    assert set(slips) <= {state.slip for state in run.history.states}
    assert len(slips) > 0.9 * len(run.history.states)
    assert {message.data for message in run.decoded("/terrafusion/ground")} <= set(
        run.history.states[0].terrain
    )


@pytest.mark.parametrize(("every", "kind"), [(100, "gyro_z"), (10, "gyro_z"), (4, "six_axis")])
def test_a_slow_imu_gets_the_graph_of_replay(messages: list[BagMessage], every: int, kind: str) -> None:
    """Of 100 Hz every so many: accelerations that are too slow to integrate are not, and that is said."""
    imu = [one for one in messages if one[1] == "/imu/data"]
    left_out = {id(one) for i, one in enumerate(imu) if i % every}
    run = Run().feed(one for one in messages if id(one) not in left_out)
    assert run.node.estimator is not None
    assert run.node.estimator.config.inputs.imu == kind
    assert any("too few to integrate: a planar graph" in line for line in run.said) is (kind == "gyro_z")


def command(text: str) -> tuple[str, str, bytes, int]:
    return "/terrafusion/command", "std_msgs/msg/String", split(CdrTemplate().string(text).rows(1))[0], 0


def test_commands_reset_switch_and_move_the_datum(messages: list[BagMessage]) -> None:
    run = Run().feed(messages[: len(messages) // 2], close=False)
    assert run.node.estimator is not None
    before = run.node.estimator.latest()
    assert before is not None
    run.node.receive(*command("off"))
    run.feed(messages[len(messages) // 2 : len(messages) // 2 + 500], close=False)
    assert run.node.estimator.latest() is before
    run.node.receive(*command("on"))
    assert run.node.estimator.latest() is None
    run.node.receive(*command("datum 48.0 11.0 500"))
    assert run.node.options.datum == (48.0, 11.0, 500.0)
    for bad in ("datum 48.0 11.0", "datum 148 11 0", "datum nan 11 0", "stop", ""):
        run.node.receive(*command(bad))
    assert run.node.counts["refused"] == 5
    assert (
        "refused: /terrafusion/command: unknown command 'stop'; send reset, on, off, or datum"
        in "\n".join(run.said)
    )


def test_a_memory_of_grounds_is_kept_from_drive_to_drive(messages: list[BagMessage], tmp_path: Path) -> None:
    """Beginning anew does not lose it, and one of another robot is refused."""
    path = tmp_path / "grounds.yaml"
    ground = Ground.new("gravel")
    for _ in range(60):
        ground = ground.seen(np.full(len(SIGNATURE), 2.0), 1.0, "2026-11-01")
    save_grounds(GroundMemory([ground], VEHICLE), path)
    run = Run(grounds=path).feed(messages[: len(messages) // 2], close=False)
    run.node.receive(*command("reset"))
    run.feed(messages[len(messages) // 2 :])
    assert [g.name for g in read_grounds(path).grounds] == ["gravel"]
    save_grounds(GroundMemory([ground], "husky"), path)
    other = Run(grounds=path).feed(messages[:2000])
    assert other.node.estimator is None
    assert any("the memory of grounds is that of 'husky'" in line for line in other.said)


def first(topic: TopicMessages) -> bytes:
    return topic.encode(slice(0, 1))[0]


def with_mounting(messages: list[BagMessage], q: tuple[float, ...], turn: np.ndarray) -> list[BagMessage]:
    """The drive of a robot whose IMU is turned, as `/tf_static` tells."""
    out = []
    for t, topic, msgtype, cdr in messages:
        if topic == "/tf_static":
            layout = CdrTemplate().constant("I", 2)
            for frame, position, rotation in (
                ("imu_link", (0.0, 0.0, 0.2), q), ("gnss_antenna", (0.0, 0.0, 0.35), (0.0, 0.0, 0.0, 1.0))
            ):  # fmt: skip
                layout.constant("I", 0, 0).string("base_link").string(frame)
                layout.constant("d", *position, *rotation)
            cdr = split(layout.rows(1))[0]
        elif topic == "/imu/data":
            message = STORE.deserialize_cdr(cdr, msgtype)
            w, a = message.angular_velocity, message.linear_acceleration
            gyro, accel = (turn.T @ [v.x, v.y, v.z] for v in (w, a))
            cdr = first(ros.imu(Imu(np.array([t]), gyro[None], accel[None]), "imu_link"))
        out.append((t, topic, msgtype, cdr))
    return out


@pytest.mark.parametrize("exact", [True, False], ids=["right angles", "any angle"])
def test_the_imu_is_turned_as_tf_static_says(
    messages: list[BagMessage], replayed: Estimate, exact: bool
) -> None:
    half = np.pi / 2 if exact else 0.3
    q = (0.0, np.sin(half), 0.0, np.cos(half))
    turn = quaternion_to_matrix(q)
    turned = Run().feed(with_mounting(messages, q, np.rint(turn) if exact else turn)).history
    path = replayed.trajectory
    at = np.array([state.position_m for state in turned.states])
    np.testing.assert_allclose(at, path.position_m, atol=0.0 if exact else 1e-6)


def test_a_receiver_that_is_switched_on_later_joins(messages: list[BagMessage]) -> None:
    begin = messages[0][0] + 5_000_000_000
    late = [one for one in messages if one[1] not in ("/fix", "/fix_velocity", "/datum") or one[0] > begin]
    run = Run().feed(late)
    assert "gnss: /fix (sensor_msgs/msg/NavSatFix)" in run.said
    assert run.history.states[0].status == "no_gnss"
    assert run.history.states[-1].status == "running"


def wheels_as(kind: str, recording: Recording) -> dict[int, tuple[str, str, bytes]]:
    """The wheels of a drive as messages of another type, by time."""
    wheels = recording.wheels
    assert wheels is not None
    rig_track_m, radius_m = 0.55, 0.098
    sides = wheels.side_speeds_mps(radius_m)
    out = {}
    for t, (left, right), angle in zip(wheels.t_ns.tolist(), sides, wheels.angle_rad, strict=True):
        v, rate = 0.5 * (left + right), (right - left) / rig_track_m
        one = np.array([t])
        if kind == "nav_msgs/msg/Odometry":
            sample = Wheels(one, np.array([[left, right]]), ("left", "right"), "mps")
            cdr = first(ros.wheel_odometry(sample, rig_track_m))
        elif kind == "geometry_msgs/msg/TwistStamped":
            layout = CdrTemplate().header("base_link").constant("d", v, 0.0, 0.0, 0.0, 0.0, rate)
            cdr = split(layout.stamped(one))[0]
        elif kind == "ackermann_msgs/msg/AckermannDriveStamped":
            layout = CdrTemplate().header("").constant("f", 0.0, 0.0, v, 0.0, 0.0)
            cdr = split(layout.stamped(one))[0]
        else:  # joints without velocities
            layout = CdrTemplate().header("").strings([f"{name}_wheel_joint" for name in wheels.names])
            layout.constant("I", len(angle)).constant("d", *angle.tolist()).constant("I", 0, 0)
            cdr = split(layout.stamped(one))[0]
        out[t] = "/wheel/odom", kind, cdr
    return out


@pytest.mark.parametrize(
    "kind",
    [
        "nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped", "ackermann_msgs/msg/AckermannDriveStamped",
        "sensor_msgs/msg/JointState",
    ],
)  # fmt: skip
def test_wheels_of_every_type_carry_the_robot(
    kind: str, messages: list[BagMessage], live_recording: Recording
) -> None:
    other = wheels_as(kind, live_recording)
    found = [
        (t, *other[t]) if topic == "/joint_states" else (t, topic, *rest) for t, topic, *rest in messages
    ]
    run = Run().feed(found)  # type: ignore[arg-type]
    assert run.node.counts["refused"] == 0, run.said
    assert error_m(run.history, live_recording) < 1.0


def one_joint(t: int, name: str, angle: float) -> bytes:
    layout = CdrTemplate().header("").strings([name]).constant("I", 1).constant("d", angle)
    return split(layout.constant("I", 0, 0).stamped(np.array([t])))[0]


def test_joints_in_topics_of_their_own_whose_counters_roll_over_carry_the_robot(
    messages: list[BagMessage], live_recording: Recording
) -> None:
    wheels, kind, period = live_recording.wheels, "sensor_msgs/msg/JointState", 6.0 * np.pi
    assert wheels is not None
    assert wheels.angle_rad is not None
    found = [one for one in messages if one[1] != "/joint_states" and not one[2].endswith("/Odometry")]
    for t_ns, angles in zip(wheels.t_ns.tolist(), wheels.angle_rad % period, strict=True):
        for name, angle in zip(wheels.names, angles.tolist(), strict=True):
            found.append((t_ns, f"/{name}/joint_states", kind, one_joint(t_ns, "joint", angle)))
    run = Run(frequency=2.0).feed(sorted(found, key=lambda one: one[0]))
    assert run.node.counts["refused"] == 0, run.said
    assert run.node.estimator is not None
    assert (run.node.estimator.wheels.jumps, run.node.estimator.wheels.impossible) == (0, 0)
    assert error_m(run.history, live_recording) < 0.1


def test_time_is_that_of_the_simulator(messages: list[BagMessage]) -> None:
    run = Run(use_sim_time=True)
    assert run.node.wants("/clock", "rosgraph_msgs/msg/Clock")
    assert not Run().node.wants("/clock", "rosgraph_msgs/msg/Clock")
    clock = split(CdrTemplate().constant("I", 42, 500_000_000).rows(1))[0]
    run.node.receive("/clock", "rosgraph_msgs/msg/Clock", clock, 0)
    run.node.tick(run.begun_s)
    stamp = run.decoded("/diagnostics")[-1].header.stamp
    assert (stamp.sec, stamp.nanosec) == (42, 500_000_000)


def test_a_node_does_not_listen_to_itself() -> None:
    node = Run(prefix="/robot1").node
    assert not node.wants("/robot1/odometry", "nav_msgs/msg/Odometry")
    assert node.wants("/odometry", "nav_msgs/msg/Odometry")
    assert not node.wants("/camera/image", "sensor_msgs/msg/Image")


@pytest.mark.parametrize(
    "options",
    [
        {"frequency": 0.0},
        {"wait_s": 2.0},
        {"datum": (91.0, 0.0, 0.0)},
        {"datum": (-90.0, 0.0, 0.0)},
        {"datum": (47.0, 8.0)},
        {"vehicle": "no such"},
        {"mode": "adaptiv"},
        {"stamps": "recipt"},
    ],
)
def test_wrong_options_are_refused_at_once(options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        Run(**options)


def test_a_datum_that_is_no_number_is_refused() -> None:
    with pytest.raises(DataError, match="no numbers"):
        Run().node.set_datum("a", 8.0, 400.0)  # type: ignore[arg-type]


def test_two_imus_are_a_question_and_no_end(messages: list[BagMessage]) -> None:
    both = [
        two
        for t, topic, msgtype, cdr in messages[:3000]
        for two in [(t, topic, msgtype, cdr)] + [(t, "/other/imu", msgtype, cdr)] * (topic == "/imu/data")
    ]
    run = Run().feed(both)
    assert run.node.estimator is None
    assert any("choose with --topic imu=" in line for line in run.said)
    chosen = Run(topics={"imu": "/imu/data"}).feed(both)
    assert chosen.history.states
