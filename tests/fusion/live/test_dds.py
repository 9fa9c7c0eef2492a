"""Real DDS on the loopback: a process publishes a bag, the estimator runs beside it."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.live.dds import DdsBus, dds_type, raw_type, ros_type
from terrafusion.fusion.live.serve import serve
from tests.fusion.live.conftest import VEHICLE
from tests.fusion.live.node_run import Run, error_m
from tests.fusion.live.test_node import same_bits

pytest.importorskip("cyclonedds")

PLAYER = Path(__file__).with_name("bag_player.py")


@pytest.fixture
def domain() -> int:
    """A domain of this process alone."""
    return 1 + os.getpid() % 200


def played(bag: Path, domain: int, *options: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, str(PLAYER), str(bag), "--domain", str(domain), *options])


def serve_while(players: list[list[str]], bag: Path, domain: int, reliable: bool) -> Run:
    """Run a node while one player after the other publishes."""
    bus = DdsBus(domain, loopback=True, reliable=reliable)
    run = Run()
    publish = run.node._publish

    def both(*message: Any) -> None:
        publish(*message)
        bus.publish(*message)

    run.node._publish = both
    waiting, running = list(players), list[subprocess.Popen[bytes]]()

    def stopped() -> bool:
        if running and running[-1].poll() is None:
            return False
        assert all(player.returncode == 0 for player in running)
        if not waiting:
            return True
        running.append(played(bag, domain, *waiting.pop(0)))
        return False

    serve(bus, run.node, stopped)
    bus.close()
    return run


@pytest.mark.parametrize(("speed", "seconds"), [("5", "11"), ("1", "6")])
def test_a_run_without_loss_gives_the_bits_of_replay(
    speed: str, seconds: str, live_bag: Path, domain: int, replayed: Estimate
) -> None:
    run = serve_while([["--speed", speed, "--end", seconds]], live_bag, domain, reliable=True)
    last = (run.history.states[-1].t_ns - replayed.trajectory.t_ns[0]) * 1e-9
    assert same_bits(run.history, replayed) >= 10 * (last - 0.1) > 20
    assert run.node.counts["refused"] == 0


def test_loss_and_bad_messages_cost_little(live_bag: Path, domain: int, live_recording: Recording) -> None:
    players = [["--speed", "5", "--loss", "0.1", "--garbage"]]
    run = serve_while(players, live_bag, domain, reliable=False)
    assert run.node.counts["refused"] > 5
    assert error_m(run.history, live_recording) < 1.5


def test_a_publisher_that_dies_and_comes_back(live_bag: Path, domain: int) -> None:
    """It goes on three seconds later, and then begins from the start of the bag."""
    players = [
        ["--speed", "5", "--end", "5"],
        ["--speed", "5", "--begin", "8"],
        ["--speed", "5", "--end", "6"],
    ]
    run = serve_while(players, live_bag, domain, reliable=False)
    times = [state.t_ns for state in run.history.states]
    assert run.node.counts["resets"] == 1, run.said
    assert sum(b < a for a, b in itertools.pairwise(times)) == 1
    assert run.history.states[-1].status == "running"


def test_the_command_runs_beside_a_robot(live_bag: Path, domain: int) -> None:
    """A late joiner; the DDS library's own decoder reads what it publishes."""
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from terrafusion.fusion.live.dds import _struct

    player = played(live_bag, domain, "--speed", "1.5")
    code = "from terrafusion.fusion.cli.main import main; main()"
    options = ["--vehicle", VEHICLE, "--loopback", "--domain", str(domain), "--seconds", "11"]
    command = subprocess.Popen(
        [sys.executable, "-c", code, "live", *options], stdout=subprocess.PIPE, text=True
    )
    bus = DdsBus(domain, loopback=True)
    readers = {
        name: DataReader(
            bus._participant, Topic(bus._participant, f"rt{name}", _struct(msgtype)), bus._qos(False, True)
        )
        for name, msgtype in (("/odometry", "nav_msgs/msg/Odometry"), ("/tf", "tf2_msgs/msg/TFMessage"))
    }
    said, _ = command.communicate(timeout=60)
    player.wait(30)
    lines = said.splitlines()
    assert command.returncode == 0
    assert "running: position, heading and slip are estimated" in lines, said
    assert lines[-1].startswith("running: [")
    odometry = [sample for sample in readers["/odometry"].take(N=2000) if hasattr(sample, "pose")]
    assert len(odometry) > 50
    assert odometry[-1].header.frame_id == "odom"
    frames = {s.transforms[0].child_frame_id for s in readers["/tf"].take(N=2000) if hasattr(s, "transforms")}
    assert frames == {"odom", "base_link"}
    del readers
    bus.close()


def test_names_are_those_of_ros() -> None:
    assert dds_type("sensor_msgs/msg/Imu") == "sensor_msgs::msg::dds_::Imu_"
    assert ros_type("sensor_msgs::msg::dds_::Imu_") == "sensor_msgs/msg/Imu"
    assert ros_type("std_srvs::srv::dds_::Trigger_Request_") is None
    found = raw_type("ackermann_msgs/msg/AckermannDriveStamped").__idl_typename__
    assert found.replace(".", "::") == "ackermann_msgs::msg::dds_::AckermannDriveStamped_"
