"""The estimate in a bag: both covariances, frames and diagnostics, read by libraries that are not ours."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.writers import write_mcap
from terrafusion.datasets.writers.mcap_estimate import Level
from terrafusion.fusion.outputs.ros_estimate import diagnostic_rows, written_estimate
from tests.differences import differences


def with_outage(d: Any, first: int = 405, last: int = 705) -> Any:
    status = d.estimate.status.copy()
    status[first:last] = "outage"
    n = len(status)
    Q = np.tile(np.diag([0.01, 0.02, 0.03, 0.04, 0.05, 0.06]), (n, 1, 1))
    Q[:, 0, 5] = Q[:, 5, 0] = 0.001
    return dataclasses.replace(d.estimate, status=status, twist_covariance=Q)


def messages(path: Path) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


@pytest.fixture(scope="module")
def bag(drive: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any, dict[str, list[Any]], Path]:
    d = drive()
    estimate = with_outage(d)
    path = tmp_path_factory.mktemp("bag") / "a.mcap"
    write_mcap(d.recording, path, written_estimate(estimate))
    return d, estimate, messages(path), path


def test_odometry_has_pose_and_twist_with_their_covariances(bag: Any) -> None:
    _, estimate, found, _ = bag
    path = estimate.trajectory
    assert len(found["/odometry/filtered"]) == len(path)
    for i in (0, 500, len(path) - 1):
        t_ns, m = found["/odometry/filtered"][i]
        assert t_ns == path.t_ns[i] == m.header.stamp.sec * 10**9 + m.header.stamp.nanosec
        assert (m.header.frame_id, m.child_frame_id) == ("map", "base_link")
        p, q, v, w = (
            m.pose.pose.position,
            m.pose.pose.orientation,
            m.twist.twist.linear,
            m.twist.twist.angular,
        )
        np.testing.assert_array_equal([p.x, p.y, p.z], path.position_m[i])
        np.testing.assert_array_equal([q.x, q.y, q.z, q.w], path.quaternion[i])
        np.testing.assert_array_equal([v.x, v.y, v.z, w.x, w.y, w.z], path.twist_body[i])
        np.testing.assert_array_equal(np.reshape(m.pose.covariance, (6, 6)), path.covariance[i])
        np.testing.assert_array_equal(np.reshape(m.twist.covariance, (6, 6)), estimate.twist_covariance[i])


def test_the_transform_takes_the_body_to_the_map(bag: Any) -> None:
    """tf maps a point of base_link to where the pose of the odometry puts it."""
    _, estimate, found, _ = bag
    path = estimate.trajectory
    R = quaternion_to_matrix(path.quaternion)
    point = np.array([0.3, -0.2, 0.1])
    for i in (0, 700):
        (transform,) = found["/tf"][i][1].transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", "base_link")
        p, q = transform.transform.translation, transform.transform.rotation
        turned = quaternion_to_matrix(np.array([[q.x, q.y, q.z, q.w]]))[0]
        np.testing.assert_allclose(turned @ point + [p.x, p.y, p.z], R[i] @ point + path.position_m[i])


def statuses(message: Any) -> dict[str, Any]:
    return {status.name: status for status in message.status}


def test_diagnostics_come_each_second_and_at_each_change(bag: Any) -> None:
    _, estimate, found, _ = bag
    told = found["/diagnostics"]
    t_ns = np.array([t for t, _ in told])
    assert np.diff(t_ns).max() <= 1_000_000_000
    changes = {int(estimate.trajectory.t_ns[i]) for i in (405, 705)}
    assert changes <= set(t_ns.tolist())
    assert len(told) == len(diagnostic_rows(estimate)) < 0.12 * len(estimate.trajectory)
    for t, message in told:
        i = int(np.searchsorted(estimate.trajectory.t_ns, t))
        found_here = statuses(message)
        where, ground = found_here["terrafusion/localisation"], found_here["terrafusion/ground"]
        values = {pair.key: pair.value for pair in where.values}
        out = 405 <= i < 705
        assert (where.level, values["outage"]) == ((1, "true") if out else (0, "false"))
        assert values["status"] == estimate.status[i]
        if out:
            assert float(values["status_s"]) == pytest.approx((i - 405) * 0.1, abs=0.051)
        values = {pair.key: pair.value for pair in ground.values}
        assert values["terrain"] == estimate.dominant_terrain()[i]
        assert float(values["probability"]) == pytest.approx(estimate.terrain[i].max(), abs=5e-4)
        assert float(values["slip"]) == pytest.approx(estimate.slip[i], abs=5e-5)
        values = {pair.key: float(pair.value) for pair in found_here["terrafusion/weights"].values}
        assert values == pytest.approx({k: v[i] for k, v in estimate.weights.items()}, rel=1e-3)


def test_rejections_are_counted_up_to_then(bag: Any) -> None:
    _, estimate, found, _ = bag
    refused = np.array([i.t_ns for i in estimate.innovations if not i.accepted])
    assert len(refused) > 3
    for t, message in found["/diagnostics"]:
        gates = statuses(message)["terrafusion/gates"]
        values = {pair.key: int(pair.value) for pair in gates.values}
        assert values == {"rejected_gnss": int((refused <= t).sum()), "rejected_wheels": 0}


def test_slipping_is_warned_of_at_once(drive: Any) -> None:
    estimate = drive(seconds=10.0).estimate
    flag = np.zeros(len(estimate.status), dtype=bool)
    flag[33:37] = True
    told = dataclasses.replace(estimate, slipping=flag, immobilised=~flag & False)
    assert {33, 37} <= set(diagnostic_rows(told).tolist())
    ground = {
        i: found[1]
        for i, found in zip(diagnostic_rows(told), written_estimate(told).diagnostics, strict=True)
    }
    assert (ground[33].level, ground[33].values["slipping"]) == (Level.WARN, "true")
    assert (ground[37].level, ground[37].values["slipping"]) == (Level.OK, "false")
    assert ground[33].message.endswith(", slipping")


def test_a_local_path_is_in_odom(drive: Any) -> None:
    estimate = drive(seconds=10.0).estimate
    local = dataclasses.replace(estimate, status=np.full(len(estimate.status), "no_gnss", dtype=object))
    assert written_estimate(local).frame == "odom"
    assert written_estimate(estimate).frame == "map"


def test_our_reader_gets_the_log_back_and_no_estimate(bag: Any) -> None:
    d, _, _, path = bag
    back = open_recording(path)
    assert differences(back.truth, d.recording.truth) == []
    assert differences(back.wheels, d.recording.wheels) == []
    assert back.gnss is None


def test_rosbags_reads_every_message(bag: Any) -> None:
    _, _, found, path = bag
    with AnyReader([path]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)
    assert counts == {topic: len(some) for topic, some in found.items()}
    assert {"/odometry/filtered", "/tf", "/diagnostics"} <= counts.keys()


def test_a_log_before_1970_keeps_estimate_and_diagnostics_together(drive: Any, tmp_path: Path) -> None:
    """Stamps of a log without a date are shifted as one."""
    d = drive(seconds=10.0)
    shift = int(d.estimate.trajectory.t_ns[0]) + 5_000_000_000

    def earlier(part: Any) -> Any:
        return dataclasses.replace(part, t_ns=part.t_ns - shift)

    recording = dataclasses.replace(
        d.recording,
        start_ns=0,
        truth=earlier(d.recording.truth),
        wheels=earlier(d.recording.wheels),
    )
    estimate = dataclasses.replace(d.estimate, trajectory=earlier(d.estimate.trajectory), innovations=())
    write_mcap(recording, tmp_path / "a.mcap", written_estimate(estimate))
    found = messages(tmp_path / "a.mcap")
    first = {topic: some[0][0] for topic, some in found.items()}
    assert first["/odometry/filtered"] == first["/diagnostics"] == first["/tf"] == first["/ground_truth/odom"]
    assert min(first.values()) >= 0
