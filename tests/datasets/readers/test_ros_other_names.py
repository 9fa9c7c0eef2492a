"""Bags in which names decide: fused odometry, commands, joints of other robots; and IMUs as mounted."""

from __future__ import annotations

import dataclasses
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import get_types_from_msg

from terrafusion.datasets.checks import repair
from terrafusion.datasets.core.channels import Fix, Imu, Magnetometer
from terrafusion.datasets.core.conventions import turned_as_mounted
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.readers.logs import opened
from terrafusion.datasets.readers.ros.joints import wheel_joints, wheel_of_joint
from terrafusion.datasets.readers.ros.streams import DEFINITIONS
from terrafusion.datasets.readers.ros.topics import ACKERMANN_STAMPED, ODOMETRY, BagTopic, looks_fused
from terrafusion.datasets.writers import write_log_folder, write_mcap
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate
from tests.datasets.ros_bags import (
    MAKE1,
    MAKE2,
    ROS1,
    ROS2,
    T0,
    Message,
    imu_messages,
    odometry_messages,
    write_ros1,
    write_ros2,
)

JOINTS = "sensor_msgs/msg/JointState"
NAMES = ["left_wheel_joint", "right_wheel_joint"]
TIMES = [T0 + i * 50_000_000 for i in range(60)]


def driving(topic: str = "/odom") -> list[Message]:
    """IMU and odometry of some seconds."""
    return imu_messages(MAKE2, n=300) + odometry_messages(MAKE2, topic=topic, n=60)


@pytest.mark.parametrize(
    "topic",
    [
        "/vins_estimator/odometry", "/lio_sam/mapping/odometry", "/rtabmap/odom", "/zed/zed_node/odom",
        "/odometry/local", "/robot_localization/odom", "/mavros/local_position/odom",
        "/localization/kinematic_state",
    ],
)  # fmt: skip
def test_fused_odometry_is_no_wheel_sensor(topic: str, tmp_path: Path) -> None:
    made = open_recording(write_ros2(tmp_path / "bag", driving(topic)))
    assert made.wheels is None
    assert not any(note.endswith(": ") for note in made.notes)


@pytest.mark.parametrize(
    "topic",
    [
        "/odom", "/wheel/odom", "/husky_velocity_controller/odom", "/odom/wheel",
        "/diff_drive_controller/odom", "/platform/odom", "/realized/odom",
    ],
)  # fmt: skip
def test_odometry_of_the_wheels_is_not_taken_for_fused(topic: str) -> None:
    assert not looks_fused("wheels", BagTopic(topic, ODOMETRY, 1))


def test_commanded_joints_are_no_measurement(tmp_path: Path) -> None:
    commands = [("/joint_command", JOINTS, t, MAKE2.joints(t, NAMES, [], [9.0, 9.0])) for t in TIMES]
    wheels = open_recording(write_ros2(tmp_path / "bag", driving() + commands)).wheels
    assert wheels is not None
    assert wheels.unit == "mps"  # of the odometry


def test_steering_of_a_bag_without_definitions(tmp_path: Path) -> None:
    """SQLite bags before ROS 2 Iron have none."""
    ROS2.register(get_types_from_msg(DEFINITIONS[ACKERMANN_STAMPED], ACKERMANN_STAMPED))
    angle = ROS2.types["ackermann_msgs/msg/AckermannDrive"](0.1, 0.0, 1.0, 0.0, 0.0)
    stamped = ROS2.types[ACKERMANN_STAMPED]
    messages = [("/drive", ACKERMANN_STAMPED, t, stamped(MAKE2.header(t, ""), angle)) for t in TIMES]
    bag = tmp_path / "bag"
    with Writer2(bag, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topics = {(topic, kind) for topic, kind, _, _ in driving() + messages}
        made = {topic: writer.add_connection(topic, kind, typestore=ROS2) for topic, kind in sorted(topics)}
        for topic, kind, t_ns, message in driving() + messages:
            writer.write(made[topic], t_ns, ROS2.serialize_cdr(message, kind))
    connection = sqlite3.connect(next(bag.glob("*.db3")))
    connection.execute("DROP TABLE message_definitions")
    connection.commit()
    connection.close()
    recording = open_recording(bag)
    assert recording.steering is not None
    assert "an AckermannDriveStamped, to ROS a command; it is taken as measured" in " ".join(recording.notes)


def test_the_velocity_of_a_receiver_is_not_offered_for_wheels(tmp_path: Path) -> None:
    kind = "geometry_msgs/msg/TwistStamped"
    v = [np.nan, *[1.0] * (len(TIMES) - 1)]
    twists = [MAKE2.new("geometry_msgs/msg/Twist", MAKE2.vector(e, 0, 0), MAKE2.vector(0, 0, 0)) for e in v]
    made = [MAKE2.new(kind, MAKE2.header(t, "gps"), m) for t, m in zip(TIMES, twists, strict=True)]
    velocities = [("/gps/vel", kind, t, m) for t, m in zip(TIMES, made, strict=True)]
    fixes = [("/gps/fix", "sensor_msgs/msg/NavSatFix", t, MAKE2.fix(t, 48.0, 11.0)) for t in TIMES]
    bag = write_ros2(tmp_path / "bag", sorted([*velocities, *fixes], key=lambda one: one[2]))
    recording = open_recording(bag)
    assert recording.gnss is not None
    assert recording.gnss.velocity_enu_mps is not None
    assert not any("wheels=/gps/vel" in note for note in recording.notes)
    assert any("/gps/vel taken as east, north, up; 1 fixes without" in note for note in recording.notes)


def test_a_commanded_drive_is_no_wheel_speed(tmp_path: Path) -> None:
    """F1TENTH cars are commanded by /drive."""
    ROS2.register(get_types_from_msg(DEFINITIONS[ACKERMANN_STAMPED], ACKERMANN_STAMPED))
    drive = ROS2.types["ackermann_msgs/msg/AckermannDrive"](0.1, 0.0, 1.0, 0.0, 0.0)
    stamped = ROS2.types[ACKERMANN_STAMPED]
    messages = [("/drive", ACKERMANN_STAMPED, t, stamped(MAKE2.header(t, ""), drive)) for t in TIMES]
    bag = write_ros2(tmp_path / "bag", [*imu_messages(MAKE2, n=5), *messages])
    unasked = open_recording(bag)
    assert unasked.wheels is None
    assert "--topic wheels=/drive" in " ".join(unasked.notes)
    assert open_recording(bag, topics={"wheels": "/drive"}).wheels is not None


def test_odometry_without_numbers_until_the_hardware_answers_is_left_out(tmp_path: Path) -> None:
    messages = odometry_messages(MAKE2)
    for *_, message in messages[:3]:
        message.twist.twist.linear.x = message.twist.twist.angular.z = np.nan
    recording = open_recording(write_ros2(tmp_path / "bag", messages))
    assert recording.wheels is not None
    assert recording.wheels.t_ns.tolist() == [t for _, _, t, _ in messages[3:]]
    assert f"wheels: 3 of {len(messages)} messages of /odom hold no number; left out" in recording.notes


GPS_FIX = """std_msgs/Header header
{package}/GPSStatus status
float64 latitude
float64 longitude
float64 altitude
float64 track
float64 speed
float64 climb
float64 pitch
float64 roll
float64 dip
float64 time
float64 gdop
float64 pdop
float64 hdop
float64 vdop
float64 tdop
float64 err
float64 err_horz
float64 err_vert
float64 err_track
float64 err_speed
float64 err_climb
float64 err_time
float64 err_pitch
float64 err_roll
float64 err_dip
float64[9] position_covariance
uint8 position_covariance_type
"""
GPS_STATUS = """std_msgs/Header header
uint16 satellites_used
int32[] satellite_used_prn
uint16 satellites_visible
int32[] satellite_visible_prn
int32[] satellite_visible_z
int32[] satellite_visible_azimuth
int32[] satellite_visible_snr
int16 status
uint16 motion_source
uint16 orientation_source
uint16 position_source
"""


@pytest.mark.parametrize("kind", ["ROS 1", "mcap", "sqlite3 without definitions"])
def test_fixes_with_speed_and_track_are_read(kind: str, tmp_path: Path) -> None:
    package = "gps_common" if kind == "ROS 1" else "gps_msgs"
    store, make = (ROS1, MAKE1) if kind == "ROS 1" else (ROS2, MAKE2)
    fix, status = f"{package}/msg/GPSFix", f"{package}/msg/GPSStatus"
    for name, text in ((status, GPS_STATUS), (fix, GPS_FIX.format(package=package))):
        store.register(get_types_from_msg(text, name))
    messages = imu_messages(make, n=5)
    for k, t in enumerate(TIMES):
        seen, header = np.arange(k % 3, dtype=np.int32), make.header(t, "gps")
        about = make.new(status, header, 1, seen, 2, seen, seen, seen, seen, 20, 1, 1, 1)
        numbers = [48.0, 11.0 + 1e-5 * k, 500.0, 90.0, 1.5 * (k > 0), 0.0, *np.zeros(13), 0.392, *np.zeros(5)]
        covariance = np.diag([0.25, 0.36, 4.0]).ravel()
        messages.append(("/gps", fix, t, make.new(fix, header, about, *numbers, covariance, 2)))
    bag = (write_ros1 if kind == "ROS 1" else write_ros2)(
        tmp_path / "run.bag", messages, *([StoragePlugin.SQLITE3] if kind.startswith("sqlite3") else [])
    )
    if kind.startswith("sqlite3"):
        with closing(sqlite3.connect(next(bag.glob("*.db3")))) as database:
            database.execute("update message_definitions set encoded_message_definition = ''")
            database.commit()
    gnss = open_recording(bag).gnss
    messages += [("/fix", "sensor_msgs/msg/NavSatFix", t, make.fix(t, 48.0, 11.0)) for t in TIMES]
    both = (write_ros1 if kind == "ROS 1" else write_ros2)(tmp_path / "both.bag", messages)
    of_both = open_recording(both).gnss
    assert gnss is not None
    assert of_both is not None
    assert gnss.velocity_enu_mps is not None
    np.testing.assert_array_equal(of_both.velocity_enu_mps, gnss.velocity_enu_mps)
    np.testing.assert_array_equal(of_both.sigma_v_mps, gnss.sigma_v_mps)
    assert gnss.sigma_v_mps is not None
    np.testing.assert_allclose(gnss.velocity_enu_mps[1:, :2], [[1.5, 0.0]] * (len(TIMES) - 1), atol=1e-12)
    assert np.isnan(gnss.velocity_enu_mps[0]).all()  # live, nothing tells rest from a speed that is not set
    np.testing.assert_allclose(gnss.sigma_v_mps, 0.2)
    np.testing.assert_allclose(gnss.sigma_enu_m, [[0.5, 0.6, 2.0]] * len(TIMES))
    assert set(gnss.fix.tolist()) == {Fix.FLOAT}
    assert gnss.enu_m[-1, 0] == pytest.approx(74.56e-2 * (len(TIMES) - 1), rel=1e-3)


def test_fixes_of_a_type_that_is_not_read_are_named(tmp_path: Path) -> None:
    fixes = ("/gps/pvt", "std_msgs/msg/Float64", T0, MAKE2.new("std_msgs/msg/Float64", 1.0))
    bag = write_ros2(tmp_path / "bag", [*imu_messages(MAKE2, n=5), fixes])
    noted = " ".join(open_recording(bag).notes)
    assert "gnss: not used are /gps/pvt (std_msgs/msg/Float64), of types that are not read" in noted


@pytest.mark.parametrize(
    "names",
    [
        ["rear_left_wheel_joint", "rear_right_wheel_joint", "front_left_steer_joint"],
        ["front_left_wheel_joint", "front_right_wheel_joint", "rear_caster_wheel_joint"],
    ],
)
def test_one_driven_axle_is_two_sides(names: list[str]) -> None:
    assert wheel_joints(names, {}) == {"left": names[0], "right": names[1]}


@pytest.mark.parametrize(
    ("joint", "wheel"),
    [
        ("panther/fl_wheel_joint", "front_left"), ("farmbot/left_wheel_joint", "left"),
        ("swarm_1/left_wheel", "left"), ("company_left_wheel", "left"), ("arm_left_wheel", None),
        ("left_arm_joint", None), ("left_arm1_joint", None), ("arms_left", None), ("pan_left", None),
        ("LH_WHEEL", "rear_left"), ("rh", "rear_right"),
        ("leftFlipper", None), ("caster_left_wheel", None), ("front_left_steering_wheel", None),
    ],
)  # fmt: skip
def test_a_joint_is_known_by_whole_words(joint: str, wheel: str | None) -> None:
    assert wheel_of_joint(joint) == wheel


def test_joints_without_speed_until_the_hardware_answers(tmp_path: Path) -> None:
    speeds = [[] if t == T0 else [6.0, 6.5] for t in TIMES]
    joints = [
        ("/joint_states", JOINTS, t, MAKE2.joints(t, NAMES, [], speed))
        for t, speed in zip(TIMES, speeds, strict=True)
    ]
    wheels = open_recording(write_ros2(tmp_path / "bag", imu_messages(MAKE2, n=300) + joints)).wheels
    assert wheels is not None
    assert len(wheels) == len(TIMES) - 1
    np.testing.assert_array_equal(wheels.speed, np.tile([6.0, 6.5], (len(wheels), 1)))


def test_velocities_that_are_zero_while_the_angles_turn_are_differences_of_these(tmp_path: Path) -> None:
    """A driver that fills the field with zeros: the wheels were found dead, and left out."""
    names = [*NAMES, "left_wheel_2_joint"]
    joints = [
        ("/joint_states", JOINTS, t, MAKE2.joints(t, names, [0.1 * k, 0.2 * k, 0.0], [0.0, 0.0, 0.0]))
        for k, t in enumerate(TIMES)
    ]
    found = open_recording(write_ros2(tmp_path / "bag", imu_messages(MAKE2, n=300) + joints))
    assert found.wheels is not None
    rates = np.array([[0.1, 0.2]]) / (np.diff(TIMES)[:, None] * 1e-9)
    np.testing.assert_allclose(found.wheels.speed, rates)
    noted = " ".join(found.notes)
    assert "all velocities of /joint_states are zero, though its angles turn" in noted
    assert "; not used: left_wheel_2_joint" in noted


@pytest.fixture
def mounted(tmp_path: Path) -> Recording:
    """A Husky's bag: its IMU is mounted as the vehicle file says, and not turned yet."""
    R = load_vehicle("husky").rig().sensors.imu.base_from_sensor()
    gyro, accel = R.T @ [0.1, 0.2, 0.5], R.T @ [0.0, 0.0, 9.81]
    imu = imu_messages(MAKE2, n=600, gyro=tuple(gyro), accel=tuple(accel), frame="imu_link")
    return open_recording(write_ros2(tmp_path / "bag", imu + odometry_messages(MAKE2, n=120)))


@pytest.mark.parametrize("name", ["folder", "log.mcap"])
def test_a_conversion_keeps_that_the_imu_is_not_turned_yet(
    name: str, mounted: Recording, tmp_path: Path
) -> None:
    (write_mcap if name.endswith("mcap") else write_log_folder)(mounted, tmp_path / name)
    (found,) = opened(tmp_path / name, load_vehicle("husky").rig())
    assert found.imu is not None
    np.testing.assert_allclose(found.imu.accel_mps2, np.tile([0.0, 0.0, 9.81], (600, 1)), atol=1e-6)
    assert turned_as_mounted(found, load_vehicle("husky").rig()).imu is found.imu


def test_a_repaired_imu_is_not_turned_once_more(mounted: Recording) -> None:
    repaired, _ = repair(mounted)
    (found,) = opened(repaired, load_vehicle("husky").rig())
    assert found.imu is not None
    np.testing.assert_allclose(found.imu.accel_mps2[0], [0.0, 0.0, 9.81], atol=1e-6)


@pytest.mark.parametrize(("angle_deg", "left"), [(90.0, ()), (30.0, ("magnetometer",))])
def test_a_repair_leaves_to_the_vehicle_what_it_did_not_turn(angle_deg: float, left: tuple[str, ...]) -> None:
    """By a quarter the magnetometer is turned with the IMU, by another angle the IMU alone."""
    drive = simulate("figure_eight", terrain="asphalt", seed=1)
    assert drive.imu is not None
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    imu = Imu(drive.imu.t_ns, drive.imu.gyro_radps @ R.T, drive.imu.accel_mps2 @ R.T)
    field = Magnetometer(drive.imu.t_ns, np.tile([2e-5, 0.0, -4e-5], (len(drive.imu), 1)))
    unturned = ("imu", "magnetometer")
    repaired, findings = repair(dataclasses.replace(drive, imu=imu, magnetometer=field, unturned=unturned))
    assert "imu-forward" in {finding.code for finding in findings}
    assert repaired.unturned == left


def test_an_unknown_sigma_of_heights_stays_unknown(tmp_path: Path) -> None:
    drive = simulate("straight", vehicle="husky", terrain="asphalt")
    assert drive.gnss is not None
    gnss = dataclasses.replace(drive.gnss, sigma_enu_m=drive.gnss.sigma_enu_m * [1.0, 1.0, np.nan])
    write_mcap(dataclasses.replace(drive, gnss=gnss), tmp_path / "log.mcap")
    found = open_recording(tmp_path / "log.mcap", stamps="receipt").gnss
    assert found is not None
    assert np.isnan(found.sigma_enu_m[:, 2]).all()
    assert np.isfinite(found.sigma_enu_m[:, :2]).all()
