"""The ROS 2 node: passes CDR bytes between rclpy and `terrafusion.fusion.live.node.LiveNode`."""

import time
from pathlib import Path

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosidl_runtime_py.utilities import get_message
from std_srvs.srv import SetBool, Trigger

from terrafusion import TerrafusionError
from terrafusion.fusion.live.node import LiveNode
from terrafusion.fusion.live.options import LiveOptions
from terrafusion.fusion.live.published import TYPES, Frames

DEFAULTS = {
    "vehicle": "husky", "mode": "adaptive", "frequency": 50.0, "map_frame": "map", "odom_frame": "odom",
    "base_link_frame": "base_link", "publish_tf": True, "imu0": "", "odom0": "", "gps0": "",
    "datum": [0.0], "wait": 0.02, "grounds": "",
}  # fmt: skip
CHANNELS = {"imu0": "imu", "odom0": "wheels", "gps0": "gnss"}
DISCOVER_S, TICK_S, DEPTH = 0.5, 0.01, 1000


class TerrafusionNode(Node):
    """Finds the robot's topics, and publishes odometry, transforms, slip, ground and diagnostics."""

    def __init__(self) -> None:
        super().__init__("terrafusion")
        given = {name: self.declare_parameter(name, value).value for name, value in DEFAULTS.items()}
        topics = {CHANNELS[name]: given[name] for name in CHANNELS if given[name]}
        frames = Frames(given["map_frame"], given["odom_frame"], given["base_link_frame"])
        options = LiveOptions(
            vehicle=given["vehicle"], mode=given["mode"], topics=topics, frames=frames,
            frequency=given["frequency"], publish_tf=given["publish_tf"], datum=self.datum(),
            wait_s=given["wait"], grounds=Path(given["grounds"]) if given["grounds"] else None,
        )  # fmt: skip
        self.publishers_of = {
            topic: self.create_publisher(get_message(msgtype), topic, 10) for topic, msgtype in TYPES.items()
        }
        self.live = LiveNode(options, self.send, self.get_logger().info)
        self.heard: set[str] = set()
        self.create_timer(DISCOVER_S, self.discover)
        self.create_timer(TICK_S, lambda: self.live.tick(time.monotonic()))
        self.create_service(Trigger, "~/reset", self.on_reset)
        self.create_service(Trigger, "~/set_datum", self.on_set_datum)
        self.create_service(SetBool, "~/toggle", self.on_toggle)

    def datum(self) -> tuple[float, float, float] | None:
        """The parameter `datum`; None where it has not three numbers."""
        values = self.get_parameter("datum").value
        return (values[0], values[1], values[2]) if len(values) == 3 else None

    def send(self, topic: str, msgtype: str, cdr: bytes) -> None:
        """Publish a serialised message; after a signal, which shuts rclpy down at once, no more."""
        if self.context.ok():
            self.publishers_of[topic].publish(cdr)

    def discover(self) -> None:
        """Subscribe to what the estimator can use."""
        for topic, types in self.get_topic_names_and_types():
            if topic not in self.heard and self.live.wants(topic, types[0]):
                self.heard.add(topic)
                latched = any(
                    info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
                    for info in self.get_publishers_info_by_topic(topic)
                )
                qos = QoSProfile(
                    depth=DEPTH,
                    reliability=ReliabilityPolicy.RELIABLE if latched else ReliabilityPolicy.BEST_EFFORT,
                    durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
                )
                self.create_subscription(
                    get_message(types[0]), topic, self.receiver(topic, types[0]), qos, raw=True
                )

    def receiver(self, topic: str, msgtype: str):
        """A callback that passes on the bytes of a topic."""
        return lambda cdr: self.live.receive(topic, msgtype, bytes(cdr), self.get_clock().now().nanoseconds)

    def on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Begin anew."""
        self.live.reset("as asked")
        response.success = True
        return response

    def on_set_datum(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Move the origin of the map to the parameter `datum`, and begin anew."""
        datum = self.datum()
        try:
            response.success = datum is not None
            if datum is None:
                response.message = "the parameter datum has not three numbers"
            else:
                self.live.set_datum(*datum)
        except TerrafusionError as error:
            response.success, response.message = False, str(error)
        return response

    def on_toggle(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Use messages, or leave them out."""
        self.live.toggle(request.data)
        response.success = True
        return response


def main() -> None:
    """Run the node until it is interrupted or terminated."""
    rclpy.init()
    try:
        node = TerrafusionNode()
    except TerrafusionError as error:
        raise SystemExit(str(error)) from None
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.live.close()
        node.destroy_node()
        rclpy.try_shutdown()
