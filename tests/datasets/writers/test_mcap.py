"""MCAP out and in again; the file must also open with the format's own library."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2._dynamic import generate_dynamic
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader as RosbagReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_typestore

from terrafusion.datasets.core.channels import Imu, Wheels
from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.core.sensors import Rig
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.writers import ros_messages, write_mcap
from terrafusion.datasets.writers.mcap_estimate import Level, Status, WrittenEstimate
from terrafusion.datasets.writers.tum import write_tum
from tests.differences import differences


def test_round_trip(drive: Recording, tmp_path: Path) -> None:
    unseen = write_mcap(drive, tmp_path / "a.mcap")
    assert [sentence.split(":")[0] for sentence in unseen] == ["terrain", "motor"]
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
    assert differences(drive, open_recording(tmp_path / "a.mcap")) == []


def test_standard_messages_alone_hold_the_drive_too(drive: Recording, tmp_path: Path) -> None:
    """What others see: the same file without the topics of this library."""
    write_mcap(drive, tmp_path / "a.mcap")
    back = open_recording(without_own_topics(tmp_path / "a.mcap", tmp_path / "b.mcap"))
    assert back.channels().keys() == drive.channels().keys() - {"motor"}
    for name in ("command", "wheels", "imu"):
        ours, theirs = drive.channels()[name], back.channels()[name]
        np.testing.assert_array_equal(ours.t_ns, theirs.t_ns)
        for column, values in ours.columns().items():
            np.testing.assert_array_equal(values, theirs.columns()[column])
    assert drive.gnss is not None
    assert back.gnss is not None
    assert back.datum == drive.datum
    np.testing.assert_array_equal(back.gnss.t_ns, drive.gnss.t_ns)
    np.testing.assert_array_equal(back.gnss.fix, drive.gnss.fix)
    np.testing.assert_allclose(back.gnss.enu_m, drive.gnss.enu_m, atol=1e-7)
    np.testing.assert_allclose(back.gnss.sigma_enu_m, drive.gnss.sigma_enu_m, rtol=1e-15)
    np.testing.assert_array_equal(back.gnss.velocity_enu_mps, drive.gnss.velocity_enu_mps)
    np.testing.assert_allclose(back.gnss.sigma_v_mps, drive.gnss.sigma_v_mps, rtol=1e-15)
    assert back.terrain is not None
    assert drive.terrain is not None
    assert back.terrain.label.tolist() == drive.terrain.label.tolist()
    assert differences(drive.truth, back.truth) == []
    assert back.truth_channels == drive.truth_channels


def without_own_topics(source: Path, target: Path) -> Path:
    """A copy of a bag made by another library, with the standard topics only."""
    with source.open("rb") as file, target.open("wb") as out:
        reader, writer = make_reader(file), Writer(out)
        writer.start("ros2", "copy")
        ids: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            if schema is None or channel.topic.startswith("/terrafusion/"):
                continue
            if channel.id not in ids:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, dict(channel.metadata)
                )
            writer.add_message(ids[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return target


def test_planar_truth_of_the_antenna(drive: Recording, tmp_path: Path) -> None:
    assert drive.truth is not None
    position = drive.truth.position_m.copy()
    position[:, 2] = np.nan
    truth = dataclasses.replace(drive.truth, position_m=position, quaternion=None)
    write_mcap(dataclasses.replace(drive, truth=truth, truth_frame="antenna"), tmp_path / "a.mcap")
    back = open_recording(tmp_path / "a.mcap")
    assert differences(truth, back.truth) == []
    assert back.truth_frame == "antenna"


def test_the_official_library_reads_it(drive: Recording, tmp_path: Path) -> None:
    assert drive.truth is not None
    covariance = np.tile(np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), (len(drive.truth), 1, 1))
    estimate = dataclasses.replace(drive.truth, covariance=covariance)
    write_mcap(drive, tmp_path / "a.mcap", estimate)
    counts: Counter[str] = Counter()
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            counts[channel.topic] += 1
            if channel.topic == "/odometry/filtered":
                stamp = decoded.header.stamp
                assert stamp.sec * 10**9 + stamp.nanosec == message.log_time
                assert (decoded.header.frame_id, decoded.child_frame_id) == ("map", "base_link")
                assert list(decoded.pose.covariance[::7]) == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert counts == {
        "/cmd_vel": 1200, "/joint_states": 1200, "/imu/data": 6000, "/datum": 1, "/fix": 300,
        "/fix_velocity": 300, "/terrain": 6, "/ground_truth/odom": 1200, "/odometry/filtered": 1200,
        "/tf": 1200,
        "/terrafusion/meta": 1, "/terrafusion/gnss": 300, "/terrafusion/motor": 1200,
        "/terrafusion/terrain": 6,
    }  # fmt: skip


def test_an_estimate_in_the_bag_is_not_read_as_wheels(drive: Recording, tmp_path: Path) -> None:
    write_mcap(dataclasses.replace(drive, wheels=None), tmp_path / "a.mcap", drive.truth)
    assert open_recording(tmp_path / "a.mcap").wheels is None


def test_side_speeds(drive: Recording, tmp_path: Path, husky_rig: Rig) -> None:
    """A track makes a yaw rate of them; without one the standard message has the speed alone."""
    assert drive.wheels is not None
    wheels = Wheels(drive.wheels.t_ns, drive.wheels.speed * 0.1651, ("left", "right"), "mps")
    recording = dataclasses.replace(drive, wheels=wheels)
    unseen = write_mcap(recording, tmp_path / "without.mcap")
    assert any("no track is known" in sentence for sentence in unseen)
    assert not any(
        "track" in sentence for sentence in write_mcap(recording, tmp_path / "a.mcap", rig=husky_rig)
    )
    others = {}
    for name in ("a", "without"):
        assert differences(open_recording(tmp_path / f"{name}.mcap").wheels, wheels) == []
        standard = without_own_topics(tmp_path / f"{name}.mcap", tmp_path / f"{name}_standard.mcap")
        others[name] = open_recording(standard, rig=husky_rig).wheels
    assert others["a"] is not None
    assert others["without"] is not None
    np.testing.assert_allclose(others["a"].speed, wheels.speed, rtol=1e-13, atol=1e-13)
    np.testing.assert_array_equal(others["without"].speed[:, 0], wheels.speed.mean(axis=1))
    assert others["without"].names == ("speed",)


def test_mean_speed_stays_mean_speed(drive: Recording, tmp_path: Path) -> None:
    assert drive.wheels is not None
    wheels = Wheels(drive.wheels.t_ns, drive.wheels.speed[:, :1], ("speed",), "mps")
    write_mcap(dataclasses.replace(drive, wheels=wheels), tmp_path / "a.mcap")
    back = open_recording(tmp_path / "a.mcap").wheels
    assert back is not None
    assert back.names == ("speed",)
    np.testing.assert_array_equal(back.speed, wheels.speed)


def test_gyro_alone(drive: Recording, tmp_path: Path) -> None:
    assert drive.imu is not None
    gyro, accel = np.full_like(drive.imu.gyro_radps, np.nan), np.full_like(drive.imu.accel_mps2, np.nan)
    gyro[:, 2] = drive.imu.gyro_radps[:, 2]
    imu = Imu(drive.imu.t_ns, gyro, accel)
    write_mcap(Recording("g", drive.start_ns, imu=imu), tmp_path / "a.mcap")
    back = open_recording(tmp_path / "a.mcap").imu
    assert back is not None
    np.testing.assert_array_equal(back.gyro_radps, gyro)
    assert not back.has_accel()


def test_without_datum_it_is_nominal_and_said(drive: Recording, tmp_path: Path) -> None:
    left_out = write_mcap(dataclasses.replace(drive, datum=None), tmp_path / "a.mcap")
    assert any("no datum" in sentence for sentence in left_out)
    back = open_recording(tmp_path / "a.mcap")
    assert back.gnss is not None
    assert drive.gnss is not None
    assert len(back.gnss) == len(drive.gnss)
    np.testing.assert_allclose(back.gnss.enu_m, drive.gnss.enu_m, atol=1e-7)


def test_existing_file_is_kept_unless_told(drive: Recording, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("precious")
    with pytest.raises(TerrafusionError, match="exists already"):
        write_mcap(drive, tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap").read_text() == "precious"
    write_mcap(drive, tmp_path / "a.mcap", overwrite=True)
    assert open_recording(tmp_path / "a.mcap").imu is not None


def test_a_path_that_cannot_be_written(drive: Recording, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(TerrafusionError, match=r"a\.mcap"):
        write_mcap(drive, tmp_path / "file" / "a.mcap")


def test_messages_are_those_of_another_serialiser(drive: Recording, tmp_path: Path, husky_rig: Rig) -> None:
    """Decoded and encoded again by rosbags every message has the same bytes: no field is out of place."""
    sides = Wheels(drive.imu.t_ns[:9], np.ones((9, 2)), ("left", "right"), "mps")
    assert drive.truth is not None
    statuses = [(Status("a/b", Level.WARN, "odd länge", {"k": "v" * n, "": "x"}),) * n for n in range(3)]
    written = WrittenEstimate(
        drive.truth,
        np.random.default_rng(1).normal(size=(len(drive.truth), 6, 6)),
        diagnostics_ns=drive.truth.t_ns[:3],
        diagnostics=statuses,
    )
    write_mcap(drive, tmp_path / "a.mcap", written, rig=husky_rig)
    write_mcap(dataclasses.replace(drive, wheels=sides), tmp_path / "b.mcap", rig=husky_rig)
    seen = set()
    for name in ("a.mcap", "b.mcap"):
        with AnyReader([tmp_path / name]) as reader:
            for connection, _, raw in reader.messages():
                message = reader.deserialize(raw, connection.msgtype)
                again = bytes(reader.typestore.serialize_cdr(message, connection.msgtype))
                assert again == raw, connection.topic
                seen.add(connection.topic)
    assert len(seen) == 18


def test_container(drive: Recording, tmp_path: Path) -> None:
    """Checksums, order, statistics, indices and QoS, as the format's own library reads them."""
    write_mcap(drive, tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        messages = [(channel.topic, m) for _, channel, m in reader.iter_messages(log_time_order=False)]
        metadata = list(reader.iter_metadata())
    assert summary is not None
    assert summary.statistics is not None
    times = [message.log_time for _, message in messages]
    assert times == sorted(times)
    assert messages[0][0] == "/terrafusion/meta"
    assert summary.statistics.message_count == len(messages)
    assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (
        times[0],
        times[-1],
    )
    counts = Counter(message.channel_id for _, message in messages)
    assert summary.statistics.channel_message_counts == counts
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count > 1
    assert [record.name for record in metadata] == ["rosbag2"]
    for channel in summary.channels.values():
        (qos,) = parse_qos(channel.metadata["offered_qos_profiles"])
        latched = channel.topic in ("/terrafusion/meta", "/datum", "/tf_static")
        assert qos.reliability.name == "RELIABLE"
        assert qos.durability.name == ("TRANSIENT_LOCAL" if latched else "VOLATILE")
        assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
    for schema in summary.schemas.values():
        assert schema.encoding == "ros2msg"
        assert generate_dynamic(schema.name, schema.data.decode())


def test_frames(drive: Recording, tmp_path: Path, husky_rig: Rig) -> None:
    """Sensors whose position is known have a frame of their own, in which their messages are."""
    write_mcap(drive, tmp_path / "a.mcap", rig=husky_rig)
    own = Overrides(antenna_m=(0.1, 0.2, 0.3))
    write_mcap(dataclasses.replace(drive, overrides=own), tmp_path / "b.mcap")
    found = {}
    for name in ("a.mcap", "b.mcap"):
        frames, transforms = {}, {}
        with (tmp_path / name).open("rb") as file:
            for _, channel, _, m in make_reader(
                file, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages():
                if channel.topic == "/tf_static":
                    for t in m.transforms:
                        p, q = t.transform.translation, t.transform.rotation
                        assert (t.header.frame_id, q.x, q.y, q.z, q.w) == ("base_link", 0.0, 0.0, 0.0, 1.0)
                        transforms[t.child_frame_id] = (p.x, p.y, p.z)
                elif hasattr(m, "header"):
                    frames[channel.topic] = (m.header.frame_id, getattr(m, "child_frame_id", ""))
        found[name] = frames, transforms
    assert found["a.mcap"] == (
        {
            "/cmd_vel": ("base_link", ""), "/joint_states": ("", ""), "/imu/data": ("imu_link", ""),
            "/datum": ("gnss_antenna", ""), "/fix": ("gnss_antenna", ""), "/fix_velocity": ("map", ""),
            "/ground_truth/odom": ("map", "base_link"),
        },
        {"imu_link": (0.2351, -0.0687, 0.1919), "gnss_antenna": (0.2475, 0.0, 0.2231)},
    )  # fmt: skip
    assert found["b.mcap"][0]["/imu/data"] == ("base_link", "")
    assert found["b.mcap"][1] == {"gnss_antenna": (0.1, 0.2, 0.3)}


def recorded_again(source: Path, folder: Path, storage: StoragePlugin) -> Path:
    """The bag in a rosbag2 folder and with later receipt times, as after `ros2 bag play` and `record`."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([source]) as reader, RosbagWriter(folder, version=8, storage_plugin=storage) as writer:
        ids = {
            c.topic: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in reader.connections
        }
        for c, t, raw in reader.messages():
            writer.write(ids[c.topic], t + 123_456_789_012, raw)
    return folder


@pytest.mark.parametrize("storage", StoragePlugin)
def test_a_bag_that_was_recorded_again(drive: Recording, tmp_path: Path, storage: StoragePlugin) -> None:
    write_mcap(drive, tmp_path / "drive.mcap")
    back = open_recording(recorded_again(tmp_path / "drive.mcap", tmp_path / "drive", storage))
    assert differences(drive, back) == []


def test_topics_that_are_asked_for_are_taken(drive: Recording, tmp_path: Path) -> None:
    write_mcap(drive, tmp_path / "a.mcap", drive.truth)
    asked = open_recording(tmp_path / "a.mcap", topics={"wheels": "/odometry/filtered"})
    assert asked.wheels is not None
    assert asked.wheels.unit == "mps"
    assert any("/terrafusion is not used" in note for note in asked.notes)


START_NS = 1_700_000_000_123_456_789

META_FAULTS = {
    "no JSON": lambda meta: "{",
    "no mapping": lambda meta: "[1]",
    "no tables": lambda meta: json.dumps({"start_ns": 0}),
    "numbers for names": lambda meta: json.dumps(meta | {"tables": {"motor": [1, 2]}}),
    "strange columns": lambda meta: json.dumps(meta | {"tables": {"motor": ["left_a", "weight_kg"]}}),
    "fewer columns": lambda meta: json.dumps(meta | {"tables": {"motor": ["left_a", "right_a"]}}),
    "twice a column": lambda meta: json.dumps(meta | {"tables": {"motor": ["left_a"] * 4}}),
    "no such word": lambda meta: json.dumps(meta | {"words": {"fix": ["none"], "label": []}}),
    "no shift": lambda meta: json.dumps(meta | {"shift_ns": "late"}),
    "unknown key": lambda meta: json.dumps(meta | {"colour": "red"}),
}


@pytest.mark.parametrize("fault", META_FAULTS)
def test_a_broken_account_of_the_tables_is_told(
    drive: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    text = ros_messages.text
    monkeypatch.setattr(
        ros_messages, "text", lambda name, t, content: text(name, t, META_FAULTS[fault](json.loads(content)))
    )
    write_mcap(drive, tmp_path / "a.mcap")
    with pytest.raises(TerrafusionError, match=r"a\.mcap.*; ") as caught:
        open_recording(tmp_path / "a.mcap")
    assert "\n" not in str(caught.value)


def test_a_time_that_ros_does_not_have(tmp_path: Path) -> None:
    imu = Imu(np.array([2**31 * 10**9]), np.ones((1, 3)), np.ones((1, 3)))
    with pytest.raises(TerrafusionError, match="1970 to 2038"):
        write_mcap(Recording("x", 0, imu=imu), tmp_path / "a.mcap")
    assert list(tmp_path.iterdir()) == []


def test_times_before_the_start_of_a_log_without_a_date(drive: Recording, tmp_path: Path) -> None:
    assert drive.imu is not None
    assert drive.motor is not None
    recording = Recording(
        "a",
        0,
        imu=dataclasses.replace(drive.imu, t_ns=drive.imu.t_ns - START_NS - 1),
        motor=dataclasses.replace(drive.motor, t_ns=drive.motor.t_ns - START_NS - 470_000_000),
    )
    unseen = write_mcap(recording, tmp_path / "a.mcap")
    assert any("stamps are 1 s later" in sentence for sentence in unseen)
    assert differences(recording, open_recording(tmp_path / "a.mcap")) == []


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_writer_that_fails_leaves_what_was_there(
    drive: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("mcap.writer.Writer.finish", fail)
    (tmp_path / "a.mcap").write_text("precious")
    for name in ("a.mcap", "new.mcap"):
        with pytest.raises((TerrafusionError, KeyboardInterrupt)):
            write_mcap(drive, tmp_path / name, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
    assert (tmp_path / "a.mcap").read_text() == "precious"


def test_evo_reads_the_truth(drive: Recording, tmp_path: Path) -> None:
    bags = pytest.importorskip("evo.tools.file_interface")
    assert drive.truth is not None
    write_mcap(drive, tmp_path / "a.mcap")
    with RosbagReader(tmp_path / "a.mcap") as reader:
        path = bags.read_bag_trajectory(reader, "/ground_truth/odom")
    np.testing.assert_array_equal(path.positions_xyz, drive.truth.position_m)
    write_tum(drive.truth, tmp_path / "truth.tum")
    again = bags.read_tum_trajectory_file(tmp_path / "truth.tum")
    np.testing.assert_allclose(again.positions_xyz, drive.truth.position_m, atol=1e-9)
    np.testing.assert_allclose(again.timestamps, path.timestamps, atol=1e-6)
