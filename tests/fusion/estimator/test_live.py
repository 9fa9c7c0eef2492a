"""Live use: odometry between keyframes, the message loop, and the ROS 2 node."""

from __future__ import annotations

import dataclasses
import sys
import types
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest

from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.odometry import transition
from terrafusion.fusion.live import run
from terrafusion.fusion.replay import replay
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.run_recording import DATUM
from terrafusion.twin.simulate import simulate

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "integration.md"


@pytest.fixture(scope="module")
def drive() -> Recording:
    return until(simulate("figure_eight", terrain="asphalt", seed=5), 50.0)


@pytest.fixture(scope="module")
def odometry(drive: Recording) -> tuple[list[State], list[bool]]:
    """All odometry of the drive, and whether a keyframe had just been made."""
    estimator = Estimator.for_vehicle("elevate")
    states: list[State] = []
    keyframes: list[State | None] = []

    def publish(state: State) -> None:
        states.append(state)
        keyframes.append(estimator.latest())

    run(estimator, drive.messages(), publish)
    fresh = [a is not b for a, b in zip(keyframes[1:], keyframes[:-1], strict=True)]
    return states, fresh


def test_odometry_comes_with_every_imu_sample(drive: Recording, odometry: Any) -> None:
    times = [s.t_ns for s in odometry[0]]
    assert drive.imu is not None
    assert times == drive.imu.t_ns[-len(times) :].tolist()


def test_live_gives_what_replay_gives(drive: Recording) -> None:
    """Encoder angles, velocity and class of the fixes, commands: the same bits at every keyframe."""
    assert drive.wheels is not None
    assert drive.wheels.angle_rad is not None
    assert drive.gnss is not None
    assert drive.gnss.velocity_enu_mps is not None
    first = replay(drive).estimate.trajectory
    config = EstimatorConfig(load_vehicle("elevate").rig(), "elevate")
    states: list[State] = []
    estimator = Estimator(config, on_state=states.append)
    run(estimator, drive.messages(), lambda _: None)
    estimator.finish()
    np.testing.assert_array_equal(first.t_ns, [s.t_ns for s in states])
    np.testing.assert_array_equal(first.position_m, [s.position_m for s in states])
    np.testing.assert_array_equal(first.covariance, [s.covariance for s in states])


def test_odometry_is_continuous_between_keyframes(odometry: Any) -> None:
    """Between keyframes a step is velocity times time; at a keyframe its correction, some centimetres."""
    states, fresh = odometry
    p, v = (np.array([getattr(s, name) for s in states]) for name in ("position_m", "velocity_mps"))
    dt = np.diff([s.t_ns for s in states]) * 1e-9
    jump = np.linalg.norm(np.diff(p, axis=0) - 0.5 * (v[1:] + v[:-1]) * dt[:, None], axis=1)
    at = np.array(fresh)
    assert at.any()
    assert jump[~at].max() < 1e-5
    assert jump[at].max() < 0.1


def test_odometry_follows_the_truth(drive: Recording, odometry: Any) -> None:
    states, _ = odometry
    assert drive.truth is not None
    truth = drive.truth.positions_at(np.array([s.t_ns for s in states]))
    off = np.array([s.position_m for s in states]) - truth
    assert np.sqrt((off[:, :2] ** 2).sum(axis=1).mean()) < 0.3
    for state in states[::50]:
        assert np.linalg.eigvalsh(state.covariance).min() > 0.0
        assert np.linalg.eigvalsh(state.twist_covariance).min() > 0.0


def test_the_transition_is_the_derivative_of_the_motion() -> None:
    """Against central differences of R_j = R_i dR, p_j = p_i + v dt + R_i dp, v_j = v + R_i dv."""
    import gtsam

    rng = np.random.default_rng(1)
    start, turn = (gtsam.Rot3.Expmap(rng.normal(0.0, s, 3)) for s in (1.0, 0.05))
    dp, dv, v, dt = rng.normal(0.0, 0.1, 3), rng.normal(0.0, 1.0, 3), rng.normal(0.0, 1.0, 3), 0.2

    def end(x: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
        R = start.compose(gtsam.Rot3.Expmap(x[:3]))
        p, speed = start.matrix() @ x[3:6], v + x[6:9]
        return R.compose(turn), p + speed * dt + R.matrix() @ dp, speed + R.matrix() @ dv

    R_j = end(np.zeros(9))[0]
    F, _ = transition(start.matrix(), R_j.matrix(), dp, dv, dt)
    for i in range(9):
        step = np.zeros(9)
        step[i] = 1e-6
        (Ra, pa, va), (Rb, pb, vb) = end(step), end(-step)
        column = [gtsam.Rot3.Logmap(Rb.between(Ra)), R_j.matrix().T @ (pa - pb), va - vb]
        np.testing.assert_allclose(F[:9, i], np.concatenate(column) / 2e-6, atol=1e-6)


class Anything(types.SimpleNamespace):
    """A ROS message: fields are there once they are looked at."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        value = Anything()
        setattr(self, name, value)
        return value


class Node:
    """As much of `rclpy.node.Node` as the page uses."""

    def __init__(self, name: str) -> None:
        self.heard: dict[str, Any] = {}
        self.told: dict[str, list[Any]] = defaultdict(list)

    def declare_parameter(self, name: str, default: Any) -> Any:
        return types.SimpleNamespace(value={"vehicle": "elevate"}.get(name, default))

    def create_publisher(self, _: type, topic: str, __: Any) -> Any:
        return types.SimpleNamespace(publish=self.told[topic].append)

    def create_subscription(self, _: type, topic: str, callback: Any, __: Any) -> None:
        self.heard[topic] = callback

    def create_timer(self, _: float, callback: Any) -> None:
        self.second = callback

    def get_logger(self) -> Any:
        return types.SimpleNamespace(warning=self.told["log"].append)

    def get_clock(self) -> Any:
        return Anything(now=lambda: Anything(to_msg=lambda: None))


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The node of the page, among stand-ins for ROS."""
    status = type("DiagnosticStatus", (Anything,), {"OK": b"\0", "WARN": b"\1"})
    stubs = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": "best effort"},
        "nav_msgs.msg": {"Odometry": Anything},
        "sensor_msgs.msg": {"Imu": Anything, "NavSatFix": Anything},
        "diagnostic_msgs.msg": {
            "DiagnosticArray": Anything,
            "DiagnosticStatus": status,
            "KeyValue": Anything,
        },
    }
    for name, content in stubs.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    session: dict[str, Any] = {}
    code = PAGE.read_text(encoding="utf-8").split("```python\n")[1].split("```")[0]
    exec(compile(code, str(PAGE), "exec"), session)
    return session["make_node"]()


def stamped(t_ns: int) -> Anything:
    message = Anything()
    message.header.stamp = types.SimpleNamespace(sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    return message


def xyz(values: Any) -> Any:
    return types.SimpleNamespace(**dict(zip("xyz", np.asarray(values).tolist(), strict=True)))


def as_ros(recording: Recording, track_m: float, radius_m: float) -> list[tuple[int, str, Anything]]:
    """The recording's samples as messages of their topics."""
    imu, wheels, gnss = recording.imu, recording.wheels, recording.gnss
    assert imu is not None
    assert wheels is not None
    assert gnss is not None
    out = []
    for t, (left, right) in zip(wheels.t_ns.tolist(), wheels.side_speeds_mps(radius_m).tolist(), strict=True):
        message = stamped(t)
        message.twist.twist.linear.x = 0.5 * (left + right)
        message.twist.twist.angular.z = (right - left) / track_m
        out.append((t, "wheel_odom", message))
    for t, enu, sigma in zip(gnss.t_ns.tolist(), gnss.enu_m, gnss.sigma_enu_m, strict=True):
        message = stamped(t)
        message.latitude, message.longitude, message.altitude = pymap3d.enu2geodetic(*enu, *DATUM)
        message.status.status, message.position_covariance_type = 0, 2
        message.position_covariance = np.diag(sigma**2).ravel().tolist()
        out.append((t, "fix", message))
    for t, gyro, accel in zip(imu.t_ns.tolist(), imu.gyro_radps, imu.accel_mps2, strict=True):
        message = stamped(t)
        message.angular_velocity, message.linear_acceleration = xyz(gyro), xyz(accel)
        out.append((t, "imu", message))
    return sorted(out, key=lambda one: one[0])


def heard(recording: Recording) -> Recording:
    """What the node hears of a drive: no encoder angles, no velocities of the fixes, no commands."""
    assert recording.wheels is not None
    assert recording.gnss is not None
    gnss = dataclasses.replace(recording.gnss, velocity_enu_mps=None, sigma_v_mps=None)
    wheels = dataclasses.replace(recording.wheels, angle_rad=None)
    return dataclasses.replace(recording, wheels=wheels, gnss=gnss, command=None)


def test_the_ros_node_publishes_what_the_estimator_says(drive: Recording, node: Any) -> None:
    """The origin is the first fix there and the simulation's here; the path is the same within 5 mm."""
    rig = node.estimator.config.rig
    for _, topic, message in as_ros(drive, rig.track_m, rig.wheel_radius_m):
        node.heard[topic](message)
    node.second()
    estimator, states = Estimator.for_vehicle("elevate"), list[State]()
    run(estimator, heard(drive).messages(), states.append)
    published = node.told["odometry/terrafusion"]
    assert len(published) == len(states)
    assert drive.gnss is not None
    for state, message in zip(states[::100], published[::100], strict=True):
        at, twist = message.pose.pose.position, message.twist.twist
        here = np.array([at.x, at.y, at.z]) + drive.gnss.enu_m[0]
        np.testing.assert_allclose(here, state.position_m, atol=5e-3)
        forward = quaternion_to_matrix(state.quaternion).T @ state.velocity_mps
        np.testing.assert_allclose([twist.linear.x, twist.linear.y], forward[:2], atol=1e-3)
        np.testing.assert_allclose(np.diag(state.covariance), message.pose.covariance[::7], rtol=0.02)
        assert (message.header.frame_id, message.child_frame_id) == ("map", "base_link")
    assert node.told["/diagnostics"][0].status[0].message == states[-1].status


def test_the_ros_node_goes_on_after_a_bad_sample(node: Any) -> None:
    message = stamped(10**9)
    message.angular_velocity, message.linear_acceleration = xyz([0.0, 0.0, np.nan]), xyz([0.0, 0.0, 9.8])
    node.heard["imu"](message)
    assert node.refused == 1
    assert "six finite numbers" in node.told["log"][0]
