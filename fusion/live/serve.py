"""A `LiveNode` on DDS until it is stopped."""

import time
from collections.abc import Callable

from terrafusion.datasets.core.heap import older_objects_unsearched
from terrafusion.datasets.readers.ros.static_frames import STATIC
from terrafusion.fusion.live import published
from terrafusion.fusion.live.dds import DdsBus
from terrafusion.fusion.live.node import CLOCK, COMMAND, LiveNode

WAIT_S = 0.02


def serve(bus: DdsBus, node: LiveNode, stopped: Callable[[], bool]) -> None:
    """Receive, estimate and publish until `stopped()`; then use what has come and leave.

    Args:
        bus: the domain of the robot.
        node: publishes on that bus.
        stopped: asked at least every 20 ms.
    """
    bus.subscribe(*STATIC, latched=True)
    for topic, msgtype in (COMMAND, CLOCK):
        if node.wants(topic, msgtype):
            bus.subscribe(topic, msgtype)
    for topic, msgtype in published.TYPES.items():
        bus.advertise(node.named(topic), msgtype)
    with older_objects_unsearched():
        while not stopped():
            for topic, msgtype, latched in bus.discovered():
                if node.wants(topic, msgtype):
                    bus.subscribe(topic, msgtype, latched)
            bus.poll(node.receive, WAIT_S)
            node.tick(time.monotonic())
    bus.poll(node.receive)
    node.close()
