"""ROS bags: what is read, how topics and clocks are chosen, and every broken bag told in one line."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import DataError, TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.readers.ros.joints import wheel_of_joint
from tests.datasets.ros_bags import (
    MAKE1,
    MAKE2,
    T0,
    Message,
    imu_messages,
    odometry_messages,
    write_ros1,
    write_ros2,
)


def notes_of(recording: Recording) -> str:
    return "\n".join(recording.notes)


@pytest.mark.parametrize("kind", ["bag", "mcap folder", "mcap file", "db3 folder", "db3 file"])
def test_every_kind_of_bag(tmp_path: Path, kind: str) -> None:
    make = MAKE1 if kind == "bag" else MAKE2
    messages = imu_messages(make, gyro=(0.1, 0.2, 0.3)) + odometry_messages(make)
    if kind == "bag":
        path = write_ros1(tmp_path / "a.bag", messages)
    else:
        plugin = StoragePlugin.MCAP if kind.startswith("mcap") else StoragePlugin.SQLITE3
        path = write_ros2(tmp_path / "a", messages, plugin)
        if kind.endswith("file"):
            path = next(path.glob(f"*.{kind[:-5]}"))
            (path.parent / "metadata.yaml").unlink()
    recording = open_recording(path)
    assert recording.imu is not None
    assert recording.wheels is not None
    assert recording.start_ns == T0
    np.testing.assert_array_equal(recording.imu.gyro_radps, np.tile([0.1, 0.2, 0.3], (20, 1)))
    assert recording.overrides.track_m == 1.0
    np.testing.assert_allclose(recording.wheels.speed, np.tile([0.75, 1.25], (20, 1)), rtol=1e-15)
    assert "no vehicle given" in notes_of(recording)


def test_imu_turns_only_in_the_rigs_frame(tmp_path: Path, husky_rig: Rig) -> None:
    for frame, turned in (("imu_link", True), ("/imu_link", True), ("base_link", False)):
        name = f"{frame.strip('/')}{len(frame)}.bag"
        path = write_ros1(tmp_path / name, imu_messages(MAKE1, gyro=(1.0, 2.0, 3.0), frame=frame))
        recording = open_recording(path, rig=husky_rig)
        assert recording.imu is not None
        assert recording.imu.gyro_radps[0].tolist() == ([-3.0, -1.0, 2.0] if turned else [1.0, 2.0, 3.0])
        assert ("not rotated" in notes_of(recording)) is not turned


def test_rig_gives_the_track(tmp_path: Path, husky_rig: Rig) -> None:
    recording = open_recording(write_ros1(tmp_path / "a.bag", odometry_messages(MAKE1)), rig=husky_rig)
    assert recording.wheels is not None
    np.testing.assert_allclose(recording.wheels.speed[0], [1 - 0.25 * 0.555, 1 + 0.25 * 0.555])
    assert recording.overrides.track_m is None


def test_absent_axes_are_absent(tmp_path: Path) -> None:
    recording = open_recording(write_ros1(tmp_path / "a.bag", imu_messages(MAKE1, gyro_known=False)))
    assert recording.imu is not None
    assert not recording.imu.has_gyro()
    assert recording.imu.has_accel()


def _fixes(topic: str, status: int = 0) -> list[Message]:
    times = [T0 + i * 10**9 for i in range(5)]
    return [(topic, "sensor_msgs/msg/NavSatFix", t, MAKE1.fix(t, 46.0, 7.0, status=status)) for t in times]


TWO_SENSORS = {
    "imu": imu_messages(MAKE1, "/a/imu", n=5) + imu_messages(MAKE1, "/b/imu", n=9),
    "wheels": odometry_messages(MAKE1, "/odom", n=5) + odometry_messages(MAKE1, "/wheel_odom", n=9),
    "gnss": _fixes("/front/fix") + _fixes("/rear/fix"),
}


@pytest.mark.parametrize("kind", TWO_SENSORS)
def test_two_sensors_of_a_kind_are_not_chosen_between(tmp_path: Path, kind: str) -> None:
    messages = TWO_SENSORS[kind]
    path = write_ros1(tmp_path / "a.bag", messages)
    one, other = sorted({message[0] for message in messages})
    with pytest.raises(DataError) as caught:
        open_recording(path)
    for words in (one, other, "5 messages", "Hz", f"--topic {kind}="):
        assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    for topic in (one, other):
        recording = open_recording(path, topics={kind: topic})
        count = sum(message[0] == topic for message in messages)
        assert len(recording.channels()[kind]) == count
        assert f"took {topic}" in notes_of(recording)


def test_one_of_two_sensors_is_taken_where_it_alone_has_data_or_the_frame_of_the_robot(
    tmp_path: Path, husky_rig: Rig
) -> None:
    empty = imu_messages(MAKE1, "/b/imu", n=9, accel=(0.0, 0.0, 0.0))
    without_fix = _fixes("/rear/fix", status=-1)
    messages = TWO_SENSORS["imu"][:5] + empty + _fixes("/front/fix") + without_fix
    recording = open_recording(write_ros1(tmp_path / "a.bag", messages))
    assert "took /a/imu" in notes_of(recording)
    assert "took /front/fix" in notes_of(recording)
    frame = husky_rig.sensors.imu.frame_id
    messages = TWO_SENSORS["imu"][:5] + imu_messages(MAKE1, "/b/imu", n=9, frame=frame)
    recording = open_recording(write_ros1(tmp_path / "b.bag", messages), rig=husky_rig)
    assert "took /b/imu" in notes_of(recording)


def test_topics_of_the_vehicle_count_when_there(tmp_path: Path, husky_rig: Rig) -> None:
    messages = imu_messages(MAKE1, "/a/imu", n=5) + imu_messages(MAKE1, "/b/imu", n=9)
    path = write_ros1(tmp_path / "a.bag", messages)
    imu = open_recording(path, rig=dataclasses.replace(husky_rig, topics={"imu": "/a/imu"})).imu
    assert imu is not None
    assert len(imu) == 5
    with pytest.raises(DataError, match="2 sensors of one kind"):
        open_recording(path, rig=dataclasses.replace(husky_rig, topics={"imu": "/not/here"}))


def test_fused_odometry_is_no_wheel_sensor(tmp_path: Path) -> None:
    messages = imu_messages(MAKE1) + odometry_messages(MAKE1, "/odometry/filtered")
    recording = open_recording(write_ros1(tmp_path / "a.bag", messages))
    assert recording.wheels is None
    assert "/odometry/filtered looks like a fused estimate" in notes_of(recording)
    asked = open_recording(tmp_path / "a.bag", topics={"wheels": "/odometry/filtered"})
    assert asked.wheels is not None


def test_truth_by_name(tmp_path: Path) -> None:
    times = [T0 + i * 10**8 for i in range(5)]
    truth = [
        ("/ground_truth/odom", "nav_msgs/msg/Odometry", t, MAKE1.odometry(t, 1.0, 0.1, x=float(i)))
        for i, t in enumerate(times)
    ]
    recording = open_recording(write_ros1(tmp_path / "a.bag", truth + odometry_messages(MAKE1)))
    assert recording.truth is not None
    assert recording.wheels is not None
    assert recording.truth.position_m[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert recording.truth_channels == ("position", "yaw", "velocity")


def test_joint_states(tmp_path: Path) -> None:
    names = ["arm_left", "front_left_wheel", "rear_left_wheel", "front_right_wheel", "rear_right_wheel"]
    speeds, angles = [9.0, 1.0, 2.0, 3.0, 4.0], [9.0, 5.0, 6.0, 7.0, 8.0]
    path = write_ros1(
        tmp_path / "a.bag",
        [
            ("/joint_states", "sensor_msgs/msg/JointState", t, MAKE1.joints(t, names, angles, speeds))
            for t in (T0, T0 + 10**8)
        ],
    )
    wheels = open_recording(path).wheels
    assert wheels is not None
    assert wheels.names == ("front_left", "front_right", "rear_left", "rear_right")
    assert wheels.unit == "radps"
    assert wheels.speed[0].tolist() == [1.0, 3.0, 2.0, 4.0]
    assert wheels.angle_rad is not None
    assert wheels.angle_rad[0].tolist() == [5.0, 7.0, 6.0, 8.0]
    said = open_recording(path, topics={"joint.left": "arm_left", "joint.right": "front_right_wheel"}).wheels
    assert said is not None


def test_joint_angles_alone_give_speeds(tmp_path: Path) -> None:
    path = write_ros1(
        tmp_path / "a.bag",
        [
            (
                "/js",
                "sensor_msgs/msg/JointState",
                t,
                MAKE1.joints(t, ["left", "right"], [k * 0.2, k * 0.4], []),
            )
            for k, t in enumerate((T0, T0 + 10**8, T0 + 2 * 10**8))
        ],
    )
    recording = open_recording(path)
    assert recording.wheels is not None
    np.testing.assert_allclose(recording.wheels.speed, [[2.0, 4.0], [2.0, 4.0]])
    assert "differences of the angles" in notes_of(recording)


@pytest.mark.parametrize(
    ("joint", "wheel"),
    [
        ("front_left_wheel_joint", "front_left"),
        ("rear_right_wheel", "rear_right"),
        ("back_left", "rear_left"),
        ("wheel_fl", "front_left"),
        ("rl_wheel", "rear_left"),
        ("wheel_left_joint", "left"),
        ("FrontRightWheel", "front_right"),
        ("right", "right"),
        ("front_left_steer_joint", None),
        ("middle_left_wheel", None),
        ("gripper_left", None),
        ("torso", None),
    ],
)
def test_joint_names(joint: str, wheel: str | None) -> None:
    assert wheel_of_joint(joint) == wheel


def test_fixes(tmp_path: Path, husky_rig: Rig) -> None:
    rows = [
        MAKE1.fix(T0, 0.0, 0.0, status=-1),
        MAKE1.fix(T0 + 10**9, 48.0, 11.0, 500.0),
        MAKE1.fix(T0 + 2 * 10**9, np.nan, 11.0),
        MAKE1.fix(T0 + 3 * 10**9, 48.001, 11.0, 510.0, status=1),
        MAKE1.fix(T0 + 4 * 10**9, 48.001, 11.0, np.nan, status=2, kind=0),
    ]
    path = write_ros1(
        tmp_path / "a.bag",
        [("/fix", "sensor_msgs/msg/NavSatFix", T0 + i * 10**9, m) for i, m in enumerate(rows)],
    )
    recording = open_recording(path, rig=husky_rig)
    gnss = recording.gnss
    assert gnss is not None
    assert recording.datum == (48.0, 11.0, 500.0)
    assert gnss.fix.tolist() == [Fix.SINGLE, Fix.DGPS, Fix.FIXED]
    np.testing.assert_allclose(gnss.enu_m[1], [0.0, 111.2, 10.0], atol=0.1)
    assert np.isnan(gnss.enu_m[2, 2])
    np.testing.assert_allclose(gnss.sigma_enu_m, [[0.5, 0.6, 2.0], [0.5, 0.6, 2.0], [0.02, 0.02, 0.04]])
    assert "2 of 5 messages of /fix hold no fix" in notes_of(recording)


def test_a_status_that_no_driver_sets_is_no_lack_of_a_fix(tmp_path: Path) -> None:
    """STATUS_UNKNOWN, -2, is the default of NavSatFix since ROS 2 Iron."""
    places = [(48.0, 11.0), (0.0, 0.0), (48.001, 11.0)]
    fixes = [MAKE2.fix(T0 + i * 10**9, *place, status=-2) for i, place in enumerate(places)]
    messages = [("/fix", "sensor_msgs/msg/NavSatFix", T0 + i * 10**9, m) for i, m in enumerate(fixes)]
    recording = open_recording(write_ros2(tmp_path / "bag", messages))
    assert recording.gnss is not None
    assert recording.gnss.fix.tolist() == [Fix.SINGLE, Fix.SINGLE]
    assert "/fix leaves the status of 3 of 3 fixes unset; taken as single" in notes_of(recording)


def test_messages_of_an_imu_without_numbers_are_left_out_and_counted(tmp_path: Path) -> None:
    """Until the hardware answers, and seldom later; more of them are refused (`test_bad_bag`)."""
    messages = imu_messages(MAKE2, n=200, gyro=(0.0, 0.0, 0.5))
    for i in (0, 1, 90):
        messages[i][3].angular_velocity.z = np.nan
    messages[120][3].linear_acceleration_covariance[0] = -1.0
    recording = open_recording(write_ros2(tmp_path / "bag", messages))
    assert recording.imu is not None
    assert recording.imu.t_ns.tolist() == [T0 + i * 10**7 for i in range(200) if i not in (0, 1, 90, 120)]
    assert set(recording.imu.gyro_radps[:, 2]) == {0.5}
    assert np.isfinite(recording.imu.accel_mps2).all()
    assert "imu: 4 of 200 messages of /imu/data hold no number; left out" in notes_of(recording)


@pytest.mark.parametrize(
    ("status", "sigma_m"), [(0, (3.0, 3.0, 6.0)), (1, (1.0, 1.0, 2.0)), (2, (0.02, 0.02, 0.04))]
)
def test_fixes_without_a_covariance_have_the_sigma_of_their_class(
    tmp_path: Path, status: int, sigma_m: tuple[float, ...]
) -> None:
    """As in tables (`with_assumed_sigma`)."""
    message = MAKE1.fix(T0, 48.0, 11.0, 500.0, status=status, kind=0)
    recording = open_recording(
        write_ros1(tmp_path / "a.bag", [("/fix", "sensor_msgs/msg/NavSatFix", T0, message)])
    )
    assert recording.gnss is not None
    assert recording.gnss.sigma_enu_m.tolist() == [list(sigma_m)]
    assert "1 fixes have no sigma; taken from their class" in notes_of(recording)


def stamped(stamps: list[int], topic: str = "/imu") -> list[Message]:
    return [(topic, "sensor_msgs/msg/Imu", T0 + i * 10**7, MAKE1.imu(t)) for i, t in enumerate(stamps)]


def test_header_stamps_unless_asked(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "a.bag", stamped([T0 - 5, T0 + 9, T0 + 2 * 10**7]))
    imu, late = open_recording(path).imu, open_recording(path, stamps="receipt").imu
    assert imu is not None
    assert late is not None
    assert imu.t_ns.tolist() == [T0 - 5, T0 + 9, T0 + 2 * 10**7]
    assert late.t_ns.tolist() == [T0, T0 + 10**7, T0 + 2 * 10**7]


def test_zero_stamps_fall_back(tmp_path: Path) -> None:
    recording = open_recording(write_ros1(tmp_path / "a.bag", stamped([0, 0, 0])))
    assert recording.imu is not None
    assert recording.start_ns == T0
    assert "all zero" in notes_of(recording)


def test_clocks_that_disagree_fall_back(tmp_path: Path) -> None:
    uptime = [(t, m, r, MAKE1.imu(r - T0 + 47 * 10**9)) for t, m, r, _ in imu_messages(MAKE1)]
    recording = open_recording(write_ros1(tmp_path / "a.bag", uptime + odometry_messages(MAKE1)))
    assert recording.imu is not None
    assert recording.imu.t_ns[0] == T0
    assert "header clocks differ" in notes_of(recording)


def test_one_uptime_clock_is_kept(tmp_path: Path) -> None:
    uptime = [(t, m, r, MAKE1.imu(r - T0 + 47 * 10**9)) for t, m, r, _ in imu_messages(MAKE1)]
    recording = open_recording(write_ros1(tmp_path / "a.bag", uptime))
    assert recording.start_ns == 47 * 10**9


def nan_imu() -> list[Message]:
    messages = imu_messages(MAKE1)
    topic, msgtype, t, _ = messages[7]
    messages[7] = (topic, msgtype, t, MAKE1.imu(t, gyro=(0.0, np.nan, 0.0)))
    return messages


def far_fix() -> list[Message]:
    return [("/fix", "sensor_msgs/msg/NavSatFix", T0, MAKE1.fix(T0, 4237.5, 11.0))]


def text_only() -> list[Message]:
    return [("/chatter", "std_msgs/msg/String", T0, MAKE1.new("std_msgs/msg/String", "hello"))]


def strange_joints() -> list[Message]:
    return [("/js", "sensor_msgs/msg/JointState", T0, MAKE1.joints(T0, ["torso"], [0.0], [0.0]))]


BAD: dict[str, tuple[Callable[[], list[Message]], dict[str, str], list[str]]] = {
    "backwards": (lambda: stamped([T0, T0 + 5, T0 - 3]), {}, ["/imu", "backwards", "t = 0.020 s", "receipt"]),
    "zero in part": (lambda: stamped([T0, 0, T0 + 3]), {}, ["/imu", "1 of 3", "zero", "receipt"]),
    "nan": (nan_imu, {}, ["/imu/data", "angular velocity", "t = 0.070 s"]),
    "latitude": (far_fix, {}, ["/fix", "4237.5", "degrees"]),
    "no such topic": (lambda: imu_messages(MAKE1), {"imu": "/imu"}, ["imu", "no topic /imu ", "/imu/data"]),
    "unfit type": (lambda: imu_messages(MAKE1), {"gnss": "/imu/data"}, ["gnss", "sensor_msgs/msg/Imu"]),
    "no such channel": (
        lambda: imu_messages(MAKE1),
        {"weels": "/odom"},
        ["'weels'", "did you mean 'wheels'"],
    ),
    "nothing usable": (text_only, {}, ["/chatter", "--topic"]),
    "joints": (strange_joints, {"wheels": "/js"}, ["/js", "torso", "joint.left"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_bag(tmp_path: Path, case: str) -> None:
    messages, topics, words = BAD[case]
    path = write_ros1(tmp_path / "bad.bag", messages())
    with pytest.raises(TerrafusionError) as caught:
        open_recording(path, topics=topics)
    message = str(caught.value)
    assert "\n" not in message
    for word in ["bad.bag", *words]:
        assert word in message, message


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_garbled_bag_never_escapes(tmp_path: Path, suffix: str, seed: int) -> None:
    """Flipped bytes give a recording or a known error, never another exception."""
    make = MAKE1 if suffix == ".bag" else MAKE2
    messages = imu_messages(make) + odometry_messages(make)
    if suffix == ".bag":
        path = write_ros1(tmp_path / "a.bag", messages)
    else:
        path = next(write_ros2(tmp_path / "a", messages).glob("*.mcap"))
    rng = np.random.default_rng(seed)
    content = bytearray(path.read_bytes())
    for at in rng.integers(0, len(content), 40):
        content[at] = rng.integers(256)
    path.write_bytes(bytes(content))
    with contextlib.suppress(TerrafusionError):
        open_recording(path)


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [("a.bag", b"", "empty"), ("a.mcap", b"", "empty"), ("a.bag", b"#ROSBAG V2.0\n", "cannot be read"),
     ("a.xyz", b"x", "unknown kind"), ("meta.yaml", b"start_ns: 1\n", "unknown kind")],
)  # fmt: skip
def test_other_files(tmp_path: Path, name: str, content: bytes, word: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(TerrafusionError) as caught:
        open_recording(tmp_path / name)
    assert name in str(caught.value)
    assert word in str(caught.value)


def test_missing_path_and_wrong_stamps(tmp_path: Path) -> None:
    with pytest.raises(TerrafusionError, match=r"nowhere\.bag: no such file"):
        open_recording(tmp_path / "nowhere.bag")
    with pytest.raises(TerrafusionError, match="header, receipt"):
        open_recording(tmp_path, stamps="arrival")


def test_folder_with_broken_metadata(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    with pytest.raises(TerrafusionError, match="cannot be read as a ROS bag"):
        open_recording(tmp_path)
