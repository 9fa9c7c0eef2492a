"""The ROS 2 package without ROS: its parameters, launch file and calls agree with the library."""

from __future__ import annotations

import ast
import inspect
import json
import runpy
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from terrafusion.datasets.readers.ros.arriving import KINDS
from terrafusion.datasets.readers.ros.streams import DEFINITIONS
from terrafusion.datasets.readers.ros.topics import TYPES as CHANNEL_TYPES
from terrafusion.fusion.live.node import LiveNode
from terrafusion.fusion.live.options import LiveOptions
from terrafusion.fusion.live.published import TYPES, Frames

ROS2 = Path(__file__).parents[3] / "docs" / "ros2"
PACKAGE = ROS2 / "terrafusion_ros"
NODE = ast.parse((PACKAGE / "terrafusion_ros" / "node.py").read_text(encoding="utf-8"))


def constant(name: str) -> Any:
    """A value that the node's module assigns."""
    for statement in NODE.body:
        if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == name:
            return ast.literal_eval(statement.value)
    raise AssertionError(name)


def test_the_parameter_file_has_the_parameters_of_the_node() -> None:
    written = YAML(typ="safe").load(PACKAGE / "config" / "terrafusion.yaml")
    assert written["terrafusion"]["ros__parameters"] == constant("DEFAULTS")


def test_parameters_have_the_names_of_robot_localization() -> None:
    shared = {
        "frequency",
        "map_frame",
        "odom_frame",
        "base_link_frame",
        "publish_tf",
        "imu0",
        "odom0",
        "datum",
    }
    assert shared <= set(constant("DEFAULTS"))
    assert set(constant("CHANNELS").values()) <= set(KINDS)


def test_the_node_calls_what_the_library_has() -> None:
    calls = [call for call in ast.walk(NODE) if isinstance(call, ast.Call)]
    options = next(call for call in calls if ast.unparse(call.func) == "LiveOptions")
    assert {word.arg for word in options.keywords} <= set(inspect.signature(LiveOptions).parameters)
    assert len(next(call for call in calls if ast.unparse(call.func) == "Frames").args) == len(Frames())
    used = {
        ast.unparse(call.func).removeprefix("self.live.").removeprefix("node.live."): len(call.args)
        for call in calls
        if ".live." in ast.unparse(call.func)
    }
    assert set(used) == {"wants", "receive", "tick", "reset", "set_datum", "toggle", "close"}
    assert used["receive"] == len(inspect.signature(LiveNode.receive).parameters) - 1


@pytest.mark.parametrize("vehicle", ["husky", "no_robot"])
def test_a_terminated_node_keeps_what_it_learned_and_one_without_a_vehicle_says_so(
    monkeypatch: pytest.MonkeyPatch, vehicle: str
) -> None:
    """In place of rclpy: a signal shuts the context down, then `spin` raises and publishers do."""
    rclpy, closed = MagicMock(), list[str]()
    rclpy.executors.ExternalShutdownException = type("Shutdown", (Exception,), {})
    rclpy.spin.side_effect = rclpy.executors.ExternalShutdownException

    class Node:
        def __init__(self, name: str) -> None:
            self.context, self.create_publisher = MagicMock(), MagicMock()
            self.context.ok.return_value = False
            self.create_publisher.return_value.publish.side_effect = RuntimeError("context is invalid")
            self.get_logger = self.create_timer = self.create_service = self.destroy_node = MagicMock()

        def declare_parameter(self, name: str, value: Any) -> Any:
            return SimpleNamespace(value=vehicle if name == "vehicle" else value)

        def get_parameter(self, name: str) -> Any:
            return SimpleNamespace(value=[0.0])

    def close(live: LiveNode) -> None:
        live._publish("/odometry", TYPES["/odometry"], b"")
        closed.append("saved")

    rclpy.node.Node = Node
    for name in ("rclpy", "rclpy.executors", "rclpy.node", "rclpy.qos"):
        monkeypatch.setitem(sys.modules, name, getattr(rclpy, name.removeprefix("rclpy."), rclpy))
    for name in ("rosidl_runtime_py", "rosidl_runtime_py.utilities", "std_srvs", "std_srvs.srv"):
        monkeypatch.setitem(sys.modules, name, MagicMock())
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    monkeypatch.setattr(LiveNode, "close", close)
    main = runpy.run_path(str(PACKAGE / "terrafusion_ros" / "node.py"))["main"]
    if vehicle == "husky":
        main()
    else:
        with pytest.raises(SystemExit, match="no_robot"):
            main()
    assert closed == (["saved"] if vehicle == "husky" else [])


def test_the_launch_file_starts_the_node_of_the_package() -> None:
    launch = ast.parse((PACKAGE / "launch" / "terrafusion.launch.py").read_text(encoding="utf-8"))
    (node,) = [c for c in ast.walk(launch) if isinstance(c, ast.Call) and ast.unparse(c.func) == "Node"]
    words = {word.arg: word.value for word in node.keywords}
    assert ast.literal_eval(words["package"]) == PACKAGE.name
    setup = (PACKAGE / "setup.py").read_text(encoding="utf-8")
    assert f"{ast.literal_eval(words['executable'])} = terrafusion_ros.node:main" in setup
    assert any(
        isinstance(f, ast.FunctionDef) and f.name == "generate_launch_description" for f in launch.body
    )


def test_every_package_of_a_message_is_a_dependency() -> None:
    manifest = ElementTree.parse(PACKAGE / "package.xml").getroot()
    depends = {element.text for element in manifest.iter("exec_depend")}
    taken = {msgtype for kind in KINDS for msgtype in CHANNEL_TYPES[kind]}
    taken -= {msgtype for msgtype in taken if msgtype.startswith("gps_common/")}  # `gps_msgs` in ROS 1
    assert {msgtype.split("/")[0] for msgtype in taken | set(TYPES.values())} <= depends
    known = set(get_typestore(Stores.ROS2_HUMBLE).fielddefs) | set(DEFINITIONS)
    assert taken | set(TYPES.values()) <= known
    assert (PACKAGE / "resource" / PACKAGE.name).exists()


def test_the_foxglove_layout_shows_topics_that_are_published() -> None:
    layout = json.loads((ROS2 / "foxglove_layout.json").read_text(encoding="utf-8"))
    text = json.dumps(layout["configById"])
    shown = [topic for topic in TYPES if f'"{topic}' in text]
    assert len(shown) >= 5
    panels = set(layout["configById"])
    assert {panel for panel in panels if f'"{panel}"' in json.dumps(layout["layout"])} == panels


def test_foxglove_gets_what_is_published() -> None:
    import socket

    pytest.importorskip("foxglove")
    from terrafusion.fusion.live.foxglove import FoxgloveView

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    view = FoxgloveView(port)
    try:
        view.publish("/terrafusion/slip", TYPES["/terrafusion/slip"], b"\0\1\0\0" + bytes(8))
        with socket.create_connection(("127.0.0.1", port), timeout=5) as client:
            client.sendall(
                b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
                b"Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
            )
            client.settimeout(5)
            got = b""
            while b"/terrafusion/slip" not in got:
                got += client.recv(65536)
        assert got.startswith(b"HTTP/1.1 101")
        assert b"std_msgs/msg/Float64" in got
    finally:
        view.close()
