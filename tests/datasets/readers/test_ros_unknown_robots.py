"""Bags of robots that do things their own way: wrapped angles, other names, other types."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import turned_by
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.ros.arriving import LIVE, ArrivingMessages, RawMessage
from terrafusion.datasets.readers.ros.topics import FIX, BagTopic
from terrafusion.datasets.writers.cdr import CdrTemplate, split
from terrafusion.fusion.cli.main import app
from terrafusion.twin.model.vehicle import load_vehicle
from tests.datasets.ros_bags import MAKE2, T0, Message, imu_messages, odometry_messages, write_ros2

JOINTS = "sensor_msgs/msg/JointState"
TURN = 2.0 * np.pi


def joint_bag(path: Path, angle: np.ndarray, speed: np.ndarray | None = None) -> Path:
    """JointState at 10 Hz: angles (N, 2) of left and right, and speeds where they are given."""
    messages: list[Message] = []
    for k, each in enumerate(angle):
        t = T0 + k * 10**8
        rates = [] if speed is None else speed[k].tolist()
        messages.append(("/base/joints", JOINTS, t, MAKE2.joints(t, ["left", "right"], each.tolist(), rates)))
    return write_ros2(path, messages)


@pytest.mark.parametrize("least", [0.0, -np.pi])
def test_angles_of_joints_that_start_again_count_turns(tmp_path: Path, least: float) -> None:
    true = np.outer(np.arange(100), [0.5, 0.7])
    wrapped = (true - least) % TURN + least
    wheels = open_recording(joint_bag(tmp_path / "bag", wrapped)).wheels
    assert wheels is not None
    np.testing.assert_allclose(wheels.speed, np.tile([5.0, 7.0], (99, 1)), atol=1e-6)
    assert wheels.angle_rad is not None
    np.testing.assert_allclose(np.diff(wheels.angle_rad, axis=0), np.tile([0.5, 0.7], (98, 1)), atol=1e-9)


def test_angles_that_do_not_tell_give_way_to_speeds(tmp_path: Path) -> None:
    true = np.outer(np.arange(100), [2.7, 2.9])
    recording = open_recording(joint_bag(tmp_path / "bag", true % TURN, np.full((100, 2), 28.0)))
    assert recording.wheels is not None
    assert recording.wheels.angle_rad is None
    assert any(note.endswith("only the speeds are used") for note in recording.notes)
    with pytest.raises(
        DataError, match=r"/base/joints: the angles of left lie in one turn.*log wheel speeds"
    ):
        open_recording(joint_bag(tmp_path / "alone", true % TURN))


@pytest.mark.parametrize("speeds", [True, False])
@pytest.mark.parametrize(
    ("topics", "joints"),
    [
        (("/left/joint_states", "/right/joint_states"), ("wheel", "wheel")),
        (("/wheel_a", "/wheel_b"), ("left_wheel_joint", "right_wheel_joint")),
        (("/joint_states", "/joint_states"), ("left_wheel_joint", "right_wheel_joint")),
    ],
)
def test_wheels_in_messages_of_their_own_are_brought_together(
    topics: tuple[str, str], joints: tuple[str, str], speeds: bool, tmp_path: Path
) -> None:
    messages = imu_messages(MAKE2, n=300)
    for k, (topic, joint) in enumerate(zip(topics, joints, strict=True)):
        for i in range(60):
            t, rate = T0 + i * 50_000_000 + k * 13_000_000, 3.0 + k
            angle = rate * (t - T0) * 1e-9
            one = MAKE2.joints(t, [joint], [angle], [rate] if speeds else [])
            messages.append((topic, JOINTS, t, one))
    recording = open_recording(write_ros2(tmp_path / "bag", sorted(messages, key=lambda one: one[2])))
    wheels = recording.wheels
    assert wheels is not None
    assert wheels.names == ("left", "right")
    assert len(wheels) >= 57
    assert wheels.angle_rad is not None
    np.testing.assert_allclose(wheels.speed, [[3.0, 4.0]] * len(wheels), rtol=1e-9)
    t_s = (wheels.t_ns - T0) * 1e-9
    np.testing.assert_allclose(wheels.angle_rad, np.outer(t_s, [3.0, 4.0]), atol=1e-9)
    assert any("each in messages of its own: left = " in note for note in recording.notes)


def test_wheels_in_messages_of_their_own_arrive_again_after_a_clock_was_set_back() -> None:
    topic = BagTopic("/left", JOINTS, 1, ("/right",))
    arriving = ArrivingMessages(Request(LIVE), {"wheels": topic})
    found = []
    for begin in (T0, T0 - 60_000_000_000):
        for i in range(40):
            t = begin + (i // 2) * 20_000_000 + i % 2 * 5_000_000
            name = topic.names[i % 2]
            layout = CdrTemplate().header("").strings(["wheel"]).constant("I", 0)
            layout.constant("I", 1).constant("d", 2.0 + i % 2).constant("I", 0)
            cdr = split(layout.stamped(np.array([t])))[0]
            found += arriving.samples(RawMessage(name, JOINTS, cdr, t))
    times = np.array([t for t, _, _ in found])
    assert ((times >= T0).sum(), (times < T0).sum()) == (19, 19)  # not the first, before any on the right
    for _, kind, sample in found:
        assert kind == "wheels"
        assert sample.names == ("left", "right")
        assert sample.speed.tolist() == [2.0, 3.0]
        assert sample.angle_rad is None


def test_joints_without_numbers_until_the_hardware_answers_are_left_out(tmp_path: Path) -> None:
    speed = np.full((20, 2), 2.0)
    speed[:3] = np.nan
    recording = open_recording(joint_bag(tmp_path / "bag", np.cumsum(np.full((20, 2), 0.2), axis=0), speed))
    assert recording.wheels is not None
    assert recording.wheels.speed.tolist() == [[2.0, 2.0]] * 17
    assert recording.wheels.t_ns[0] == T0 + 3 * 10**8
    assert any("/base/joints: the first 3 messages hold no number" in note for note in recording.notes)
    speed[10] = np.nan
    with pytest.raises(DataError, match=r"/base/joints, t = 1\.000 s: 1 of 17 messages have no finite wheel"):
        open_recording(joint_bag(tmp_path / "later", np.zeros((20, 2)), speed))


def test_seldom_wheels_without_numbers_are_left_out_as_of_an_imu(tmp_path: Path) -> None:
    speed = np.full((200, 2), 2.0)
    speed[90, 0] = np.nan
    recording = open_recording(
        joint_bag(tmp_path / "bag", np.cumsum(0.1 * np.nan_to_num(speed), axis=0), speed)
    )
    assert recording.wheels is not None
    assert recording.wheels.speed.tolist() == [[2.0, 2.0]] * 199
    assert any("1 of 200 messages of /base/joints hold no number" in note for note in recording.notes)


def two_robots(path: Path, a: str, b: str) -> Path:
    """Robot `a` has an IMU and joints, robot `b` an odometry and an IMU or fixes."""
    joints = [
        (
            f"{a}/joint_states",
            JOINTS,
            T0 + i * 10**8,
            MAKE2.joints(T0 + i * 10**8, ["left", "right"], [], [3.0, 4.0]),
        )
        for i in range(9)
    ]
    fixes = [(f"{b}/fix", FIX, T0 + i * 10**8, MAKE2.fix(T0 + i * 10**8, 46.0, 7.0)) for i in range(9)]
    own = [*imu_messages(MAKE2, f"{a}/imu"), *joints]
    return write_ros2(path, [*own, *odometry_messages(MAKE2, f"{b}/odom"), *fixes])


@pytest.mark.parametrize(("a", "b"), [("/alice", "/bob"), ("/fleet/husky_1", "/fleet/husky_2")])
def test_of_two_robots_in_a_bag_one_is_asked_for(tmp_path: Path, a: str, b: str) -> None:
    path = two_robots(tmp_path / "bag", a, b)
    with pytest.raises(DataError, match=f"--topic wheels={a}/joint_states or --topic wheels={b}/odom"):
        open_recording(path)
    first = open_recording(path, topics={"wheels": f"{a}/joint_states"})
    assert set(first.channels()) == {"imu", "wheels"}
    assert any(f"not used: {b}/" in note for note in first.notes)
    second = open_recording(path, topics={"wheels": f"{b}/odom"})
    assert set(second.channels()) == {"gnss", "wheels"}
    mixed = open_recording(path, topics={"wheels": f"{b}/odom", "imu": f"{a}/imu"})
    assert set(mixed.channels()) == {"imu", "gnss", "wheels"}


def test_wheels_of_one_robot_are_not_joined_with_the_imu_of_its_twin(tmp_path: Path) -> None:
    messages = [*imu_messages(MAKE2, "/robot_a/imu"), *odometry_messages(MAKE2, "/robot_b/odom")]
    path = write_ros2(tmp_path / "two", messages)
    with pytest.raises(DataError, match=r"boards of one robot.*--topic imu=/robot_a/imu .*wheels=/robot_b/o"):
        open_recording(path)
    topics = {"wheels": "/robot_b/odom"}
    assert set(open_recording(path, topics=topics).channels()) == {"wheels"}
    assert set(open_recording(path, topics=topics | {"imu": "/robot_a/imu"}).channels()) == {"imu", "wheels"}
    messages = [*imu_messages(MAKE2, "/sensors/imu"), *odometry_messages(MAKE2, "/base/odom")]
    assert set(open_recording(write_ros2(tmp_path / "one", messages)).channels()) == {"imu", "wheels"}


@pytest.mark.parametrize(
    ("imu", "wheels", "robots"),
    [
        ("/husky/imu", "/jackal/odom", 2),
        ("/husky/imu/data", "/jackal/wheel/odom", 2),
        ("/husky/imu", "/husky/odom", 1),
        ("/vectornav/imu", "/husky_velocity_controller/odom", 1),
        ("/imu/data", "/husky/odom", 1),
        ("/imu", "/husky/odom", 1),
    ],
)
def test_namespaces_that_name_no_sensor_may_be_robots(
    tmp_path: Path, imu: str, wheels: str, robots: int
) -> None:
    path = write_ros2(tmp_path / "bag", [*imu_messages(MAKE2, imu), *odometry_messages(MAKE2, wheels)])
    if robots == 2:
        with pytest.raises(
            DataError, match=f"of one robot: --topic imu={imu} --topic wheels={wheels}; of se"
        ):
            open_recording(path)
        alone = open_recording(path, topics={"wheels": wheels})
        assert set(alone.channels()) == {"wheels"}
        assert any("not used: /husky/, as of other robots" in note for note in alone.notes)
    both = open_recording(path, topics={"wheels": wheels, "imu": imu} if robots == 2 else None)
    assert set(both.channels()) == {"imu", "wheels"}


def bag_beside_imu(path: Path, topic: str, msgtype: str, *messages: Any) -> Path:
    """An IMU and another topic, at 20 Hz."""
    found = [(topic, msgtype, T0 + k * 50_000_000, message) for k, message in enumerate(messages)]
    return write_ros2(path, sorted([*imu_messages(MAKE2, n=100), *found], key=lambda one: one[2]))


def wheel_note(recording: Recording) -> str:
    """What the reader says of wheels."""
    return next(note for note in recording.notes if note.startswith("wheels: "))


def test_joints_that_name_no_side_are_listed_with_the_option_that_names_them(tmp_path: Path) -> None:
    messages = [MAKE2.joints(T0, ["j1", "j2"], [], [1.0, 2.0]) for _ in range(20)]
    bag = bag_beside_imu(tmp_path / "bag", "/base/joints", JOINTS, *messages)
    unnamed = open_recording(bag)
    assert unnamed.wheels is None
    assert "the joints of /base/joints (j1, j2) name no side" in wheel_note(unnamed)
    assert "--topic joint.left=NAME --topic joint.right=NAME" in wheel_note(unnamed)
    named = open_recording(bag, topics={"joint.left": "j1", "joint.right": "j2"})
    assert named.wheels is not None
    assert named.wheels.speed[0].tolist() == [1.0, 2.0]


def test_topics_of_other_types_are_named_as_not_used(tmp_path: Path) -> None:
    speeds = [MAKE2.new("std_msgs/msg/Float64", 1.0)] * 20
    note = wheel_note(
        open_recording(bag_beside_imu(tmp_path / "bag", "/left/vel", "std_msgs/msg/Float64", *speeds))
    )
    assert "not used are /left/vel (std_msgs/msg/Float64), of types that are not read" in note
    assert "record the speeds as sensor_msgs/msg/JointState" in note


def test_a_plain_twist_is_used_where_it_is_asked_for(tmp_path: Path) -> None:
    """It has no stamps and is a command mostly: the note names the option, and its times are of arrival."""
    twist = MAKE2.new("geometry_msgs/msg/Twist", MAKE2.vector(1.0, 0, 0), MAKE2.vector(0, 0, 0.5))
    bag = bag_beside_imu(tmp_path / "bag", "/speed", "geometry_msgs/msg/Twist", *[twist] * 20)
    unasked = open_recording(bag)
    assert unasked.wheels is None
    assert "--topic wheels=/speed uses this geometry_msgs/msg/Twist" in wheel_note(unasked)
    asked = open_recording(bag, topics={"wheels": "/speed"})
    assert asked.wheels is not None
    assert asked.wheels.speed[0].tolist() == [0.75, 1.25]
    assert asked.wheels.t_ns[0] == T0
    assert "wheels: /speed has no stamps; its times are those of arrival" in asked.notes
    command = open_recording(
        bag_beside_imu(tmp_path / "c", "/cmd_vel", "geometry_msgs/msg/Twist", *[twist] * 20)
    )
    assert "--topic" not in wheel_note(command)


@pytest.mark.parametrize(("frame", "noted"), [("odom", True), ("base_link", False)])
def test_a_twist_in_the_frame_of_the_pose_is_noted(tmp_path: Path, frame: str, noted: bool) -> None:
    messages = []
    for k in range(100):
        yaw = 0.05 * k if frame == "odom" else 0.0
        message = MAKE2.odometry(T0 + k * 50_000_000, np.cos(yaw), 1.0)
        message.twist.twist.linear.y = np.sin(yaw)
        messages.append(message)
    recording = open_recording(bag_beside_imu(tmp_path / "bag", "/odom", "nav_msgs/msg/Odometry", *messages))
    assert any("seems to be in the frame of its pose" in note for note in recording.notes) is noted


def test_inspect_and_init_say_what_a_bag_lacks(tmp_path: Path) -> None:
    messages = [MAKE2.joints(T0, ["j1", "j2"], [], [1.0, 2.0]) for _ in range(20)]
    bag = bag_beside_imu(tmp_path / "bag", "/base/joints", JOINTS, *messages)
    page = CliRunner().invoke(app, ["inspect", str(bag)])
    assert page.exit_code == 0
    assert "missing   wheels, which replay and init need" in page.output
    for command in ("init", "replay"):
        vehicle = [] if command == "init" else ["--vehicle", "husky"]
        done = CliRunner().invoke(app, [command, str(bag), *vehicle, "--out", str(tmp_path / "out.yaml")])
        assert done.exit_code == 1
        assert "no wheel speeds; " in str(done.exception)
        assert "--topic joint.left=NAME" in str(done.exception)


TF = "tf2_msgs/msg/TFMessage"
HALF = float(np.sqrt(0.5))
LEVEL = (0.0, 0.0, 0.0, 1.0)


def transform(parent: str, child: str, at: tuple[float, float, float], q: tuple[float, ...] = LEVEL) -> Any:
    turn = MAKE2.new("geometry_msgs/msg/Quaternion", *q)
    place = MAKE2.new("geometry_msgs/msg/Transform", MAKE2.vector(*at), turn)
    return MAKE2.new("geometry_msgs/msg/TransformStamped", MAKE2.header(T0, parent), child, place)


def mounted_bag(
    path: Path, base: str = "base_link", turn: tuple[float, ...] = (0.0, 0.0, HALF, HALF)
) -> Path:
    """An IMU turned to the left on a plate of the robot, an antenna, and where they are, in two messages."""
    plate = transform(base, "plate", (0.0, 0.0, 0.2))
    imu_box = transform("plate", "imu_box", (0.1, 0.0, 0.05), turn)
    both = [imu_box, transform(base, "gps", (-0.1, 0.0, 0.6))]
    static = [("/tf_static", TF, T0 + k, MAKE2.new(TF, one)) for k, one in enumerate(([plate], both))]
    imu = imu_messages(MAKE2, frame="imu_box", gyro=(0.3, 0.2, 0.5), accel=(1.0, 2.0, 9.81))
    fixes = [("/fix", "sensor_msgs/msg/NavSatFix", T0 + k, MAKE2.fix(T0 + k, 48.0, 11.0)) for k in range(3)]
    return write_ros2(path, sorted([*static, *imu, *fixes], key=lambda one: one[2]))


def test_fixed_frames_of_a_bag_turn_its_imu_and_place_its_sensors(tmp_path: Path) -> None:
    recording = open_recording(mounted_bag(tmp_path / "bag"))
    assert recording.imu is not None
    np.testing.assert_allclose(recording.imu.accel_mps2[0], (-2.0, 1.0, 9.81))  # its x is the robot's left
    np.testing.assert_allclose(recording.imu.gyro_radps[0], (-0.2, 0.3, 0.5))
    assert recording.overrides.imu_m == pytest.approx((0.1, 0.0, 0.25))
    assert recording.overrides.antenna_m == pytest.approx((-0.1, 0.0, 0.6))
    assert "imu: imu_box is at [0.1, 0.0, 0.25] m and turned, by /tf_static" in recording.notes
    assert "gnss: gps is at [-0.1, 0.0, 0.6] m, by /tf_static" in recording.notes


def test_frames_go_before_the_axes_of_a_vehicle_but_not_before_a_measured_antenna(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text(
        """robot:
  imu_axes: ["-z", "-x", "+y"]
  imu_frame: imu_box
  antenna_m: {value: [0.0, 0.0, 0.9], known: measured}
"""
    )
    recording = open_recording(mounted_bag(tmp_path / "bag"), rig=load_vehicle(file).rig())
    assert recording.imu is not None
    np.testing.assert_allclose(recording.imu.accel_mps2[0], (-2.0, 1.0, 9.81))
    assert recording.overrides.antenna_m is None
    assert recording.overrides.imu_m == pytest.approx((0.1, 0.0, 0.25))


def test_a_frame_without_a_turn_leaves_the_axes_of_the_vehicle_in_force(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text('robot:\n  imu_axes: ["-x", "-y", "+z"]\n  imu_frame: imu_box\n')
    bag = mounted_bag(tmp_path / "bag", turn=LEVEL)
    for rig, accel in ((None, (1.0, 2.0, 9.81)), (load_vehicle(file).rig(), (-1.0, -2.0, 9.81))):
        recording = open_recording(bag, rig=rig)
        assert recording.imu is not None
        np.testing.assert_allclose(recording.imu.accel_mps2[0], accel)
        assert recording.overrides.imu_m == pytest.approx((0.1, 0.0, 0.25))


def test_without_the_base_frame_nothing_changes(tmp_path: Path) -> None:
    recording = open_recording(mounted_bag(tmp_path / "bag", base="chassis"))
    assert recording.imu is not None
    assert recording.imu.accel_mps2[0].tolist() == [1.0, 2.0, 9.81]
    assert (recording.overrides.imu_m, recording.overrides.antenna_m) == (None, None)
    assert not any("/tf_static" in note for note in recording.notes)


@pytest.mark.parametrize("base", ["siblings", "sensor above", "prefix", "namespace"])
def test_fixed_frames_are_followed_wherever_the_base_is_in_their_tree(tmp_path: Path, base: str) -> None:
    """An IMU upside down, an antenna over two frames."""
    over, box, mast = (1.0, 0.0, 0.0, 0.0), ((0.1, 0.0, 0.25), (1.0, 0.0, 0.0, 0.0)), (-0.1, 0.0, 0.4)
    pre = "r1/" if base == "prefix" else ""
    root = f"{pre}base_footprint" if base == "siblings" else f"{pre}base_link"
    tree = [transform(root, f"{pre}mast", mast), transform(f"{pre}mast", f"{pre}gps", (0.0, 0.0, 0.2))]
    if base == "siblings":
        tree += [transform(root, "base_link", (0.0, 0.0, 0.15))]
    if base == "sensor above":
        tree += [transform("imu_box", "base_link", (-0.1, 0.0, 0.25), over)]
    else:
        tree += [transform(root, f"{pre}imu_box", *box)]
    topic = "/r1/tf_static" if base == "namespace" else "/tf_static"
    imu = imu_messages(MAKE2, frame=f"{pre}imu_box", gyro=(0.3, 0.2, 0.5), accel=(1.0, 2.0, -9.81))
    fixes = [("/fix", "sensor_msgs/msg/NavSatFix", T0 + k, MAKE2.fix(T0 + k, 48.0, 11.0)) for k in range(3)]
    for *_, fix in fixes:
        fix.header.frame_id = f"{pre}gps"
    bag = [(topic, TF, T0, MAKE2.new(TF, tree)), *imu, *fixes]
    recording = open_recording(write_ros2(tmp_path / "bag", sorted(bag, key=lambda one: one[2])))
    assert recording.imu is not None
    np.testing.assert_allclose(recording.imu.accel_mps2[0], (1.0, -2.0, 9.81))
    up = 0.15 if base == "siblings" else 0.0
    assert recording.overrides.imu_m == pytest.approx((0.1, 0.0, 0.25 - up))
    assert recording.overrides.antenna_m == pytest.approx((-0.1, 0.0, 0.6 - up))


def test_a_turn_of_any_angle_keeps_missing_axes_missing() -> None:
    c, s = np.cos(0.3), np.sin(0.3)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    assert turned_by(R, np.array([[1.0, 0.0, 2.0]]))[0] == pytest.approx(R @ (1.0, 0.0, 2.0))
    lone = turned_by(R, np.array([[np.nan, np.nan, 2.0]]))[0]
    assert np.isnan(lone[:2]).all()
    assert lone[2] == 2.0
